"""PI current control of the drive's axes, with the limits of its half-bridges."""

from __future__ import annotations

import math
import operator
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.model.actuator import Actuator
from malta.model.drive import Drive
from malta.model.equations import note
from malta.model.places import place_states
from malta.model.plants import plant_of
from malta.simulation.layout import LoopPlan, Setup, Symbols
from malta.synthesis.linear_law import Add

# Half-bridges on a DC link: voltages and duty cycles within their limits, star points, the link voltage.


def open_loop_gain(actuator: Actuator, Kp: float, Ki: float, delay: float, w: FloatArray) -> Any:
    """(Kp + Ki / s) e^(-s delay) / (L s + R) at s = j w: the loop of one current axis, eq. (20)."""
    s = 1j * np.asarray(w, dtype=float)
    return (Kp + Ki / s) * np.exp(-s * delay) / (actuator.L * s + actuator.R)


def voltage_limit(*limits: Any) -> Any:
    """The smallest of the limits of a phase (V), of which infinite ones are none; None without any."""
    finite = [limit for limit in limits if not (isinstance(limit, float) and math.isinf(limit))]
    return reduce(ca.fmin, finite) if finite else None


def modulation(drive: Drive, u: Any, V: Any, limit: Any = None) -> tuple[Any, Any]:
    """Axis voltages u as shares of the link voltage V within the limits of the half-bridges, and 1 for limited axes.

    Where the largest phase voltage of a group of axes exceeds V/2 or the limit (V), the whole group is scaled: its
    direction stays.
    """
    most = V / 2 if limit is None else ca.fmin(V / 2, limit)
    peak = drive.peak(u)
    m, limited = ca.SX(u / V), ca.SX.zeros(len(drive.axes))
    for k, group in enumerate(drive.groups):
        fits = peak[k] <= most
        scale = ca.if_else(fits, 1, most / ca.fmax(peak[k], 1e-12))
        for axis in group:
            m[axis], limited[axis] = m[axis] * scale, ca.logic_not(fits)
    return m, limited


def duty_cycles(
    drive: Drive, u_phase: Any, V: Any, i_phase: Any, *, real_pwm: bool, limit: Any = None
) -> tuple[Any, Any]:
    """Duty cycles of the half-bridges, d = 1/2 + u / V within 0 and 1 and with |u| <= limit (V), and 1 for limited
    phases.

    real_pwm : with the resolution of the modulator's counter, and with the loss of voltage by dead time, dead_share V
        against the direction of the current
    """
    # Of V/2 the share is 1/2, never (V/2) / V: the engine multiplies by a reciprocal, and 0 and 1 are limits.
    wanted, share = 0.5 + u_phase / V, 0.5 if limit is None else ca.fmin(0.5, limit / V)
    d = ca.fmax(ca.fmin(wanted, 0.5 + share), 0.5 - share)
    limited = d != wanted
    if real_pwm:
        d = drive.pwm_step * ca.floor(d / drive.pwm_step + 0.5) - drive.dead_share * ca.sign(i_phase)
        d = ca.fmax(ca.fmin(d, 1), 0)  # a half-bridge that does not switch has no dead time
    return d, limited


def phase_voltages(drive: Drive, drop: Any, closed: Any) -> Any:
    """The voltage L i' of each winding: `drop` = u - R i - emf minus the potential of its star point.

    A star point floats so that the currents of its phases add up to zero.

    closed : 1 for every phase, 0 for an open one, whose voltage is zero
    """
    net = ca.SX(drop)
    for star in drive.stars:
        phases = list(star)
        count = ca.fmax(ca.sum1(closed[phases]), 1)
        net[phases] = closed[phases] * (drop[phases] - ca.dot(closed[phases], drop[phases]) / count)
    return net


def link_slope(drive: Drive, V: Any, power: Any) -> Any:
    """V' of the DC link, V/s: C V' = i_supply - power / V. The supply's current never reverses."""
    supply = ca.fmax(drive.link_voltage - V, 0) / drive.supply_resistance
    return (supply - power / V) / drive.link_capacitance


def link_voltage(V: float, C: float, energy: float) -> float:
    """Voltage of a link with capacitance C (F) at V (V) after it has absorbed `energy` (J) without loss."""
    return math.sqrt(V**2 + 2 * energy / C)


def control_currents(
    loop: LoopPlan, signals: Symbols, current: Any, known: Any, errors: Any, add: Add = operator.add
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
    estimate = place_states(believed, known[: len(believed.controlled)])
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
    forces = believed.actuator.forces
    Q = believed.drive.turned(forces(estimate, current)) if s.turning else ca.SX.eye(len(drive.axes))
    waiting = controller["u_limited"]
    step = g["Ki_current"] * g["control_time"] * (1 - waiting) * (Q @ error)
    integral = add(controller["u_integral"], step)
    u = g["Kp"] * error + Q.T @ integral + believed.drive.emf(estimate)
    note("current_law", "u = Kp epsilon + u_integral + emf, of the axes", u=u)
    limit = voltage_limit(plant.actuator.voltage_limit, g["voltage_limit"])
    row: dict[str, Any] = {"link": V, "i": i}
    if s.fidelity == "dq":
        command, limited = modulation(drive, u, V, limit)
        meaning = "command = u / link_last, scaled with its group where a phase would be beyond its limit"
        note("modulate", meaning, command=command, u_limited=limited)
        command = keep_if_missed(s, signals, command)
        row |= {"u": command * V, "force": drive.force(i)}
    else:
        u_phase = believed.drive.to_phases(estimate) @ u
        note("phase_voltages", "u_phase = T_phases u", u_phase=u_phase)
        command, limits = duty_cycles(drive, u_phase, V, i_phase, real_pwm=s.real_pwm, limit=limit)
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


def reading_errors(loop: LoopPlan, machine: Any, noise: Any) -> Any:
    """What the sensors of the phase currents read, less the currents, A. noise: of each sensor, A."""
    drive = loop.plant.drive
    if drive.sensors is None:
        return ca.SX.zeros(len(drive.phases))
    i = machine["i_phase"] if loop.setup.fidelity == "phase" else drive.to_phases(machine["x"]) @ machine["i"]
    read, step = i + ca.vertcat(*drive.sensors.offset) + noise, drive.sensors.step
    if not (isinstance(step, float) and step == 0):
        read = ca.if_else(step > 0, step * ca.floor(read / step + 0.5), read)
    return read - i


def keep_if_missed(s: Setup, signals: Symbols, command: Any) -> Any:
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
