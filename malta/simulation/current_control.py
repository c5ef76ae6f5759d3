"""PI current control of the drive's axes, with the limits of its half-bridges."""

from __future__ import annotations

import operator
from typing import Any

import casadi as ca

from malta.model.data import plant_of
from malta.model.equations import note
from malta.simulation import inverter
from malta.simulation.layout import Loop, Setup, Signals
from malta.synthesis.controller import Add


def control_currents(
    loop: Loop, signals: Signals, current: Any, known: Any, errors: Any, add: Add = operator.add
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """PI control of the axis currents: u = Kp e + Q' I + emf(x), I' = Ki Q e, with the error e of the axis currents.

    x are the states `known` to the controller, `errors` those of the currents that it reads, and Q turns the axes with
    the forces where the setup says so. The integrals I follow backward Euler and wait while the half-bridges are at
    their limit. Current controllers and control law have the same period, as on the machine (50 us).

    The voltage of a phase is at most that of the half-bridges, V/2; the machine's own limit, as --set V_max changes it;
    and the smallest of limits.voltage in the gain file.

    add: how the integrals take what is added to them, see `controller.Add`.

    Returns the command to hold, the controller's states after this sample, and entries of the row.
    """
    plant, c, s, g = loop
    machine, controller, given = signals
    believed, drive = plant_of(c.parameters), plant.drive
    estimate = ca.SX.zeros(len(believed.states))
    for k, index in enumerate(believed.controlled):
        estimate[index] = known[k]
    # The link voltage is measured: the modulators know of a sag at once.
    V = machine["link"] * (1 - given["sag"] if s.faulty else 1)
    if s.fidelity == "dq":
        i, i_phase = machine["i"], None
        read = i + drive.to_axes(machine["x"]) @ errors if s.current_sensors else i
    else:
        i_phase = machine["i_phase"]
        read = believed.drive.to_axes(estimate) @ (i_phase + errors if s.current_sensors else i_phase)
        i = read
    error = believed.drive.command(current) - read
    note(
        "read_axes",
        "i_axes: measured currents of the axes, T_d i and -T_q i; where epsilon has them alone, left out",
        i_axes=read,
    )
    note("current_errors", "epsilon = commanded less measured currents of the axes", epsilon=error)
    Q = believed.drive.turned(believed.forces(estimate, current)) if s.turning else ca.SX.eye(len(drive.axes))
    waiting = controller["u_limited"]
    step = g["Ki_current"] * g["control_time"] * (1 - waiting) * (Q @ error)
    integral = add(controller["u_integral"], step)
    u = g["Kp"] * error + Q.T @ integral + believed.drive.emf(estimate)
    note("current_law", "u = Kp epsilon + u_integral + emf, of the axes", u=u)
    most = inverter.largest_voltage(V, plant.actuator.voltage_limit, g["voltage_limit"])
    row: dict[str, Any] = {"link": V, "i": i}
    if s.fidelity == "dq":
        command, limited = inverter.modulation(drive, u, V, most)
        meaning = "command = u / link_last, scaled with its group where a phase would be beyond its limit"
        note("modulate", meaning, command=command, u_limited=limited)
        command = keep_if_missed(s, signals, command)
        row |= {"u": command * V, "force": drive.force(i)}
    else:
        u_phase = believed.drive.to_phases(estimate) @ u
        note("phase_voltages", "u_phase = T_phases u", u_phase=u_phase)
        command, limits = inverter.duty_cycles(drive, u_phase, V, i_phase, real_pwm=s.real_pwm, most=most)
        limited = ca.vertcat(*_limited_axes(drive, limits))
        meaning = (
            "command = 1/2 + u_phase / link_last within 1/2 +- sigma; u_limited: its group has one at a limit"
        )
        note("duty_cycles", meaning, command=command, u_limited=limited)
        command = keep_if_missed(s, signals, command)
        T = drive.to_axes(machine["x"])  # at the true position, not at the estimate
        true, applied = T @ i_phase, T @ ((command - 0.5) * V)
        row |= {"u": applied, "force": drive.force(true), "i": true, "i_phase": i_phase, "duty": command}
    return command, {"u_integral": integral, "u_limited": limited}, row


def reading_errors(loop: Loop, machine: Any, noise: Any) -> Any:
    """What the sensors of the phase currents read, less the currents, A. noise: of each sensor, A."""
    drive = loop.plant.drive
    if drive.sensors is None:
        return ca.SX.zeros(len(drive.phases))
    i = machine["i_phase"] if loop.setup.fidelity == "phase" else drive.to_phases(machine["x"]) @ machine["i"]
    read, step = i + ca.vertcat(*drive.sensors.offset) + noise, drive.sensors.step
    if not (isinstance(step, float) and step == 0):
        read = ca.if_else(step > 0, step * ca.floor(read / step + 0.5), read)
    return read - i


def keep_if_missed(s: Setup, signals: Signals, command: Any) -> Any:
    """The command, or the last one where the controller misses this step (a fault)."""
    given, controller = signals.given, signals.controller
    return ca.if_else(given["missed"], controller["command"], command) if s.faulty else command


def _limited_axes(drive: Any, limits: Any) -> list[Any]:
    """1 for every axis of a group of which a phase is limited: the integrals of these axes wait."""
    share = len(drive.phases) // len(drive.groups)
    flags: list[Any] = [0] * len(drive.axes)
    for k, group in enumerate(drive.groups):
        any_limited = ca.mmax(limits[k * share : (k + 1) * share])
        for axis in group:
            flags[axis] = any_limited
    return flags
