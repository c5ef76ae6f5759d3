"""PI current control of the drive's axes, with the limits of its half-bridges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from malta.model.data import plant_of
from malta.model.plant import Plant
from malta.simulation import inverter
from malta.simulation.layout import Setup
from malta.synthesis.controller import Controller


def control_currents(
    plant: Plant,
    c: Controller,
    s: Setup,
    g: Mapping[str, Any],
    machine: Mapping[str, Any],
    controller: Mapping[str, Any],
    given: Mapping[str, Any],
    current: Any,
    known: Any,
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """PI controllers of the axes, integrals by backward Euler, waiting where the half-bridges are at their limit.

    They run once a control period, as on the machine, where both have 50 us. known: the states that they believe in.
    """
    believed, drive = plant_of(c.parameters), plant.drive
    estimate = ca.SX.zeros(len(believed.states))  # where the controller takes the machine to be
    for k, index in enumerate(believed.controlled):
        estimate[index] = known[k]
    V = machine["link"] * (
        1 - given["sag"] if s.faulty else 1
    )  # measured: the modulators know of a sag at once
    if s.fidelity == "dq":
        i, i_phase = machine["i"], None
    else:
        i_phase = machine["i_phase"]
        i = believed.drive.to_axes(estimate) @ i_phase
    error = believed.drive.command(current) - i
    Q = believed.drive.turned(believed.forces(estimate, current)) if s.turning else ca.SX.eye(len(drive.axes))
    waiting = controller["u_limited"]
    integral = controller["u_integral"] + g["Ki_current"] * g["control_time"] * (1 - waiting) * (Q @ error)
    u = g["Kp"] * error + Q.T @ integral + believed.drive.emf(estimate)
    row: dict[str, Any] = {"link": V, "i": i}
    if s.fidelity == "dq":
        command, limited = inverter.modulation(drive, u, V)
        command = keep_if_missed(s, given, controller, command)
        row |= {"u": command * V, "force": drive.force(i)}
    else:
        u_phase = believed.drive.to_phases(estimate) @ u
        command, limits = inverter.duty_cycles(drive, u_phase, V, i_phase, real_pwm=s.real_pwm)
        limited = ca.vertcat(*_limited_axes(drive, limits))
        command = keep_if_missed(s, given, controller, command)
        T = drive.to_axes(machine["x"])  # where the machine is, whatever the controller takes it to be
        true, applied = T @ i_phase, T @ ((command - 0.5) * V)
        row |= {"u": applied, "force": drive.force(true), "i": true, "i_phase": i_phase, "duty": command}
    return command, {"u_integral": integral, "u_limited": limited}, row


def keep_if_missed(s: Setup, given: Mapping[str, Any], controller: Mapping[str, Any], command: Any) -> Any:
    return ca.if_else(given["missed"], controller["command"], command) if s.faulty else command


def _limited_axes(drive: Any, limits: Any) -> list[Any]:
    """An axis waits when any phase of its group is limited."""
    share = len(drive.phases) // len(drive.groups)
    flags: list[Any] = [0] * len(drive.axes)
    for k, group in enumerate(drive.groups):
        anyone = ca.mmax(limits[k * share : (k + 1) * share])
        for axis in group:
            flags[axis] = anyone
    return flags
