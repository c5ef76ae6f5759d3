"""The experiments on the rotor, beside those of any machine: hold, step, disturbance.

unbalance  the response to the rotor's own unbalance, speed by speed, beside that of the linear loop
lift-off   from rest in the retainer bearings
drop       the power fails: the rotor falls on the retainer bearings, turning, and is caught when it is back
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.loops.loop import loop
from malta.model.equilibrium import trim
from malta.model.linearize import linearize
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    NO_NOISE,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    amplitude,
    catalogue as generic,
    fly,
    fly_all,
    scenario_of,
)
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray

SPEEDS = (200.0, 500.0, 800.0, 1200.0, 1600.0, 2094.0)  # rad/s
SETTLING = 0.1  # s, before amplitudes are read
FORCES: dict[str, Any] = {"fidelity": "force"}
DEAD = 1e-9  # share of its force that a magnet without power still makes


def unbalance(
    plant: Plant,
    controller: Controller,
    *,
    speeds: tuple[float, ...] = SPEEDS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The rotor at each of these speeds (rad/s) with its unbalance, and exact sensors."""
    machines = [at_speed(plant, speed) for speed in speeds]
    linear = np.abs(unbalance_response(plant, controller, np.array(speeds)))
    flights = [
        (machine, controller, _turning(machine, speed, expected, options))
        for machine, speed, expected in zip(machines, speeds, linear, strict=True)
    ]
    cases, cut = fly_all(flights, progress, options)
    question = "How far does its unbalance move the rotor?"
    curves = {"speed": np.array(speeds), "linear": linear}
    return Experiment("unbalance", question, cases, cases[0].merits, curves, interrupted=cut)


def at_speed(plant: Plant, speed: float) -> Plant:
    """The same rotor at another speed, rad/s. Raises InputError for one without a period to measure."""
    if not speed > 0:
        raise InputError("simulate", "unbalance: speeds", f"{speed:g} rad/s", "speeds above 0 rad/s")
    par: Any = plant.parameters
    return plant.variant(replace(par, Omega=speed, Omega_max=max(speed, par.Omega_max)))


def _turning(machine: Plant, speed: float, expected: FloatArray, options: Mapping[str, Any]) -> PlannedRun:
    duration = max(2 * SETTLING, SETTLING + 4 * 2 * math.pi / speed)
    given = FORCES | NO_NOISE | {"disturbance": partial(rotating, machine)} | dict(options)
    scenario = scenario_of("unbalance", duration, references.hold, given)
    return PlannedRun(
        f"{speed:g} rad/s", scenario, partial(_unbalance_merits, speed=speed, expected=expected)
    )


def rotating(machine: Plant, t: FloatArray) -> FloatArray:
    """The wrench of the unbalance at the times t, k x 4: forces and torques that turn with the rotor."""
    force, torque = unbalance_of(machine)
    angle = getattr(machine.parameters, "Omega") * np.asarray(t)  # noqa: B009
    x, y = np.cos(angle), np.sin(angle)
    return np.column_stack([force * x, force * y, -torque * y, torque * x])


def unbalance_of(machine: Plant) -> tuple[float, float]:
    """Amplitudes of the unbalance: force (N), and torque (N m) about the centre of gravity."""
    par: Any = machine.parameters
    force = par.m * par.e_u * par.Omega**2
    return force, force * par.l_u


def unbalance_response(plant: Plant, controller: Controller, speeds: FloatArray) -> ComplexArray:
    """Of the linear sampled loop: complex amplitudes at the sensors, speeds x 4, of cos(Omega t) as 1.

    S is the sensitivity at the sensors and G the open rotor's response to the wrench, which is held between samples;
    both with the currents that carry the weight.
    """
    found = []
    for speed in speeds:
        machine = at_speed(plant, float(speed))
        model, loaded = linearize(machine, machine.at()), linearize(machine, trim(machine))
        x, w = ca.SX.sym("x", 8), ca.SX.sym("w", 4)
        column = ca.Function("column", [x, w], [ca.jacobian(machine.f(x, ca.DM.zeros(4), w), w)])
        force, torque = unbalance_of(machine)
        wrench = np.array([force, -1j * force, 1j * torque, torque])
        half = speed * controller.sample_time / 2
        held = np.sin(half) / half * np.exp(-1j * half)
        inner = np.linalg.solve(1j * speed * np.eye(8) - loaded.A, np.array(column(0, 0)) @ wrench * held)
        S = loop(machine, controller).sensitivity(np.array([speed]))[0]
        found.append(S @ model.C @ inner)
    return np.array(found)


def _unbalance_merits(run: Trajectory, speed: float, expected: FloatArray) -> tuple[Merit, ...]:
    sensors = run.plant.outputs
    return (
        *(
            Merit(f"{s.name}, amplitude", amplitude(run, k, speed / (2 * math.pi)), "um")
            for k, s in enumerate(sensors)
        ),
        *(Merit(f"{s.name}, linear", float(expected[k]), "um") for k, s in enumerate(sensors)),
        Merit("largest current", float(np.abs(run.current).max()), "A"),
    )


def lift_off(
    plant: Plant,
    controller: Controller,
    *,
    time: float = 0.2,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """From rest in the retainer bearings, without speed; the filter takes the rotor to be in the middle."""
    still = plant.variant(replace(_parameters(plant), Omega=0.0))
    (wanted,) = lift_off_cases(still, controller, time=time, **options)
    cases, cut = fly(still, controller, [wanted], progress, options)
    return Experiment("lift-off", "Does it leave its bearings?", cases, cases[0].merits, interrupted=cut)


def lift_off_cases(plant: Plant, _: Controller, *, time: float, **options: Any) -> list[PlannedRun]:
    """The run of `lift_off`, at the machine's own speed."""
    par = _parameters(plant)
    lying = par.c_r + par.m * par.g / par.k_r  # a little more than the spring of both bearings gives
    start = {"x": -lying * math.sin(par.slope), "y": -lying * math.cos(par.slope)}
    given = FORCES | {"start": start, "cold": True, "bearing": True} | options
    return [
        PlannedRun("from its bearings", scenario_of("lift-off", time, references.hold, given), _lift_merits)
    ]


def _lift_merits(run: Trajectory) -> tuple[Merit, ...]:
    touching = np.flatnonzero((run.contact >= 1).any(axis=1))
    free = float(run.t[touching[-1]]) if len(touching) else 0.0
    return (
        Merit("leaves its bearings after", free, "ms"),
        Merit("off the middle at the end", float(np.abs(run.p[-1]).max()), "um"),
        Merit("largest current", float(np.abs(run.current).max()), "A"),
    )


def drop(
    plant: Plant,
    controller: Controller,
    *,
    off: float = 0.03,
    time: float = 0.2,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The power fails after a tenth of `time` (s), for `off` (s): no bias, no force, no negative stiffness."""
    wanted = _drop_cases(plant, off=off, time=time, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    question = "Does it come back from a fall on its retainer bearings?"
    return Experiment("drop", question, cases, cases[0].merits, interrupted=cut)


def _drop_cases(plant: Plant, *, off: float, time: float, **options: Any) -> list[PlannedRun]:
    """Raises InputError where the power would not be back before the end."""
    par, at = _parameters(plant), time / 10
    if not 0 < off < time - at:
        raise InputError("simulate", "drop: off", f"{off:g} s", f"a time above 0 s and below {time - at:g} s")
    changes = (
        (at, {"k_s": DEAD * par.k_s, "k_i": DEAD * par.k_i}),
        (at + off, {"k_s": par.k_s, "k_i": par.k_i}),
    )
    given = FORCES | {"changes": changes, "bearing": True} | options
    scenario = scenario_of("drop", time, references.hold, given)
    return [PlannedRun(f"{off * 1e3:g} ms without power", scenario, partial(_drop_merits, back=at + off))]


def _drop_merits(run: Trajectory, back: float) -> tuple[Merit, ...]:
    touching = np.flatnonzero((run.contact >= 1).any(axis=1))
    last = float(run.t[touching[-1]]) if len(touching) else math.nan
    par = _parameters(run.plant)
    return (
        Merit("deepest in a retainer bearing", (float(run.contact.max()) - 1) * par.c_r, "um"),
        Merit("off its bearings after power is back", max(0.0, last - back), "ms"),
        Merit("off the middle at the end", float(np.abs(run.p[-1]).max()), "um"),
    )


def _parameters(plant: Plant) -> Any:
    return plant.parameters


EXPERIMENTS = {**generic.EXPERIMENTS, "unbalance": unbalance, "lift-off": lift_off, "drop": drop}
CASES = {
    **generic.CASES,
    "lift-off": lift_off_cases,
}  # campaigns fly these; a drop changes the machine in flight
FINDINGS = ("drop",)  # it ends on the bearings by intent
OPTION_UNITS = {"speeds": "rad/s", "off": "s", "time": "s"}
WORDS = {"m": "radial", "N": "bearing force"}
