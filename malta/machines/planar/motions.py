"""The published steps of the planar motor with each coil model: as quintics, and as jumps that saturate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.machines.planar import commutation, plant as planar
from malta.machines.planar.parameters import COIL_ORDER
from malta.model.linearize import linearize
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    NO_NOISE,
    Case,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly_all,
    scenario_of,
)
from malta.simulation.references import Motion, Reference
from malta.simulation.scenario import Scenario
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.lqg import lqg
from malta.synthesis.weighting import weights_of

MODELS = ("exact", "table", "analytical")  # coil models of the controller
PLACE = (6e-3, 4e-3)  # m, x and y of a place without symmetry; the paper does not print its own
CELLS = 35  # of the table over tau_n, along x and along y; the paper does not print its number
# Sec. 4.2: sizes and beginnings of the steps. Ours are quintics of these durations: steps would saturate at 1000 N.
LIFT, LIFT_AT, LIFTING = 1e-3, 0.01, 0.02  # m, s, s
DISTANCE, MOVE_AT, MOVING = 10e-3, 0.03, 0.04
DURATION = 0.1  # s
GAP = 50e-6  # m, over the magnets at the start. NOTE: the paper starts on them, where this machine has touched down
ARRIVAL_DISTANCE = 10e-6  # m: y has arrived


def with_coil_model(controller: Controller, model: str, cells: int = CELLS) -> Controller:
    """The same controller with another coil model in its commutation: one of MODELS."""
    known: dict[str, dict[str, float]] = {
        "exact": {"order": COIL_ORDER, "cells": 0},
        "table": {"order": COIL_ORDER, "cells": cells},
        "analytical": {"order": 1, "cells": 0},
    }
    par: Any = controller.parameters
    return replace(controller, parameters=replace(par, **known[model]))


def parameters_of(of: Controller | Plant) -> planar.Parameters:
    """The parameters of a machine, or those that a controller is designed for."""
    par = of.parameters
    assert isinstance(par, planar.Parameters)
    return par


def step(
    plant: Plant,
    controller: Controller,
    *,
    place: tuple[float, ...] = PLACE,
    gap: float = GAP,
    lift: float = LIFT,
    distance: float = DISTANCE,
    cells: int = CELLS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The published steps: up by `lift` (m) from `gap` (m), then `distance` (m) along y, from `place` (m) and (0, 0).

    Once with each coil model in the controller; `cells` of the table over tau_n.
    """
    wanted = step_cases(plant, controller, place=place, gap=gap, lift=lift, distance=distance, **options)
    flights = [
        (plant, with_coil_model(controller, model, cells), one._replace(label=f"{model}, {one.label}"))
        for model in MODELS
        for one in wanted
    ]
    cases, cut = fly_all(flights, progress, options)
    merits = cases[0].merits if cut else _path_deviations(cases)
    return Experiment("step", "What does the coil model move?", cases, merits, interrupted=cut)


def step_cases(
    plant: Plant,
    _: Controller,
    *,
    place: tuple[float, ...],
    gap: float,
    lift: float,
    distance: float,
    cells: int = CELLS,  # noqa: ARG001 - the controller's own coil model flies
    **options: Any,
) -> list[PlannedRun]:
    """The runs of `step` with the controller's own coil model.

    Raises InputError for a place that is not two numbers, and for steps beyond the travel.
    """
    if len(place) != 2:
        raise InputError("simulate", "step: place", f"{len(place)} numbers", "x and y")
    wanted = []
    for x, y in ((place[0], place[1]), (0.0, 0.0)):
        reference = partial(steps_reference, place=(x, y), gap=gap, lift=lift, distance=distance)
        reference(plant)  # raises where it leaves the travel
        scenario = scenario_of("step", DURATION, reference, FORCES | options)
        wanted.append(PlannedRun(f"from ({x * 1e3:g}, {y * 1e3:g}) mm", scenario, step_merits))
    return wanted


FORCES: dict[str, Any] = NO_NOISE | {
    "fidelity": "force",
    "substeps": 1,
}  # the error of one substep is 1e-13 m


def start_of_moves(
    plant: Plant, place: tuple[float, float], gap: float, lift: float, distance: float
) -> FloatArray:
    """The position x, y, z, m, from which z rises and y moves. Raises InputError where either is outside the travel."""
    par = parameters_of(plant)
    first = np.array([*place, gap])
    for p in (first, first + np.array([0, distance, lift])):
        commutation.check_position(par, p)
    return np.asarray(first - [0, 0, par.h])


def steps_reference(
    plant: Plant, place: tuple[float, float], gap: float, lift: float, distance: float
) -> Reference:
    """Two quintics: z from `gap` (m) over the magnets up by `lift` (m), then y by `distance` (m).

    Raises InputError for a position outside the travel.
    """
    first = start_of_moves(plant, place, gap, lift, distance)
    moves = ((2, lift, LIFT_AT, LIFTING), (1, distance, MOVE_AT, MOVING))

    def at(t: FloatArray) -> Motion:
        motion = [np.zeros((len(t), 6)) for _ in range(3)]
        motion[0][:, :3] = first
        for axis, size, begin, duration in moves:
            rise = duration / references.QUINTIC_DURATION
            for column, s in zip(
                motion, references.quintic(np.asarray(t) - begin - duration / 2, rise), strict=True
            ):
                column[:, axis] += size * s
        return Motion(*motion)

    return at


def step_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Arrival and overshoot of y, error of z, deviations of the other outputs, forces and currents."""
    Ts, error = run.controller.sample_time, np.abs(run.p - run.reference)
    target = run.scenario.reference(run.plant)(np.array([run.scenario.duration])).p[0]
    late = run.t >= LIFT_AT + 0.02 - Ts / 2
    beyond = (run.p[:, 1] - target[1]) * np.sign(target[1] - run.reference[0, 1])
    return (
        Merit("y within 10 um after its step", arrival(run, target[1]), "ms", key="y_settled"),
        Merit("y, overshoot", max(float(beyond.max()), 0.0), "um"),
        Merit(
            "z, from 20 ms after its step", largest_of(np.abs(run.p[late, 2] - target[2])), "um", key="z_late"
        ),
        *(
            Merit(f"{signal.name}, deviation", float(error[:, k].max()), "um" if k < 3 else "urad")
            for k, signal in enumerate(run.plant.outputs)
            if signal.name not in "yz"
        ),
        Merit("largest force", float(np.abs(run.v[:, :3]).max()), "N", "steps.force_limit", "at most"),
        Merit("largest coil current", float(np.abs(run.current).max()), "A"),
    )


def arrival(run: Trajectory, target: float) -> float:
    """Time from the step in y until y stays within ARRIVAL_DISTANCE of the target, s; NaN if it does not."""
    off = np.flatnonzero(np.abs(run.p[:, 1] - target) > ARRIVAL_DISTANCE)
    if not len(off) or off[-1] + 1 == len(run.t):
        return math.nan
    return float(run.t[off[-1] + 1]) - MOVE_AT


def largest_of(values: FloatArray) -> float:
    """The largest value; NaN without any."""
    return float(values.max()) if values.size else math.nan


def _path_deviations(cases: Sequence[Case]) -> tuple[Merit, ...]:
    """Largest distance of the runs with each coil model from the run with the exact one, from the first place.

    The error of the run with the exact model comes from currents that are constant for a sample and a sample late; the
    paper's runs have neither.
    """
    exact = cases[0].run
    merits = []
    for case in cases[2::2]:
        size = min(len(exact.p), len(case.run.p))
        off = np.abs(case.run.p[:size] - exact.p[:size]).max(axis=0)
        model = case.label.split(",")[0]
        for k, signal in enumerate(exact.plant.outputs):
            if k != 1:
                merits.append(
                    Merit(f"{model} moves {signal.name} by", float(off[k]), "um" if k < 3 else "urad")
                )
    return tuple(merits)


# The published steps of the planar motor as the paper commands them: jumps of the reference.
#
# A jump saturates the forces in y and z. A linear law that is much faster than these limits allow then brakes too late
# and swings about its end, and the error of the first sample alone charges its sums. What settles is a law that
# approaches its end at a speed from which it can stop: by its `braking`, or, as a linear one, at a rate that is slow.


DESIGN_END, LINEAR_END, SOFT_END = "as designed", "without braking", "soft"  # ends of the labels of cases
Y, Z = 1, 2  # the axes that jump
MIN_JUMP = 1e-6  # m: a smaller jump asks for no softer gains


def jump(
    plant: Plant,
    controller: Controller,
    *,
    place: tuple[float, ...] = PLACE,
    gap: float = GAP,
    lift: float = LIFT,
    distance: float = DISTANCE,
    rate: float = 0.0,
    cells: int = CELLS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The published steps as jumps of the reference, Figs 9 to 12: up by `lift` (m), then `distance` (m) along y.

    Once as designed and once without the law's `braking`, with the table of `cells`; then, without it, with y and z
    softened (`soften`) and each coil model.

    rate : of approach in y and z, 1/s; 0: the fastest one that brakes within the limits of the forces

    Raises InputError for a place that is not two numbers, steps beyond the travel, and a law of errors.
    """
    if len(place) != 2:
        raise InputError("simulate", "jump: place", f"{len(place)} numbers", "x and y")
    reference = partial(jumps_reference, place=(place[0], place[1]), gap=gap, lift=lift, distance=distance)
    reference(plant)  # raises where it leaves the travel
    scenario = scenario_of("jump", DURATION, reference, FORCES | options)
    rates = (rate, rate) if rate else braking_rates(plant, distance, lift)
    soft = soften(controller, plant, rates)
    by_table = with_coil_model(controller, "table", cells)
    laws = {f"table, {DESIGN_END}": by_table, f"table, {LINEAR_END}": replace(by_table, braking=np.zeros(0))}
    laws |= {f"{model}, {SOFT_END}": with_coil_model(soft, model, cells) for model in MODELS}
    cases, cut = fly_all(jumps_of(plant, laws, scenario), progress, options)
    merits = tuple(
        Merit(f"rate of approach in {name}", value, "1/s") for name, value in zip("yz", rates, strict=True)
    )
    return Experiment("jump", "Who settles when the reference jumps?", cases, merits, interrupted=cut)


def jumps_of(
    plant: Plant, laws: Mapping[str, Controller], scenario: Scenario
) -> list[tuple[Plant, Controller, PlannedRun]]:
    """The jumps with laws by their labels."""
    return [(plant, law, PlannedRun(label, scenario, jump_merits)) for label, law in laws.items()]


def braking_rates(plant: Plant, distance: float, lift: float) -> tuple[float, float]:
    """The fastest rates of approach, 1/s, in y and z: sqrt(3 F / (2 m d)).

    From rest at the distance d the force limit F accelerates the mover until its speed is rate times what is left,
    v^2 = 2 (F / m) (d - v / rate); from there v falls with its distance, which takes m rate v, just F. Upwards
    gravity takes its part of F.

    Raises InputError where that is all of it.
    """
    par = parameters_of(plant)
    weight = par.m * par.g
    if weight >= par.F_max:
        raise InputError("simulate", "jump: F_max", f"{par.F_max} N", f"more than the weight, {weight:.4g} N")

    def rate(F: float, d: float) -> float:
        return math.sqrt(1.5 * F / (par.m * max(abs(d), MIN_JUMP)))

    return rate(par.F_max, distance), rate(par.F_max - weight, lift)


def soften(controller: Controller, plant: Plant, rates: tuple[float, float]) -> Controller:
    """The same controller, without braking, with gains in y and z that approach a distant end at these rates, 1/s.

    It is no faster than it was.

    A PID keeps its Kd and has Kp = rate Kd and no integral, which would sum the way up to the end. The regulator of an
    LQG has w_n = sqrt(2) rate, so that Kp = rate Kd too; its filter stays as it is.

    Raises InputError for a law of errors, which has neither.
    """
    if controller.tracks == "errors":
        raise InputError("simulate", "scenario", "'jump' with a law of errors", "an LQG or a PID")
    half = len(controller.A) // 2
    if controller.cost is None:
        K, Ki = controller.K.copy(), controller.Ki.copy()
        for k, rate in zip((Y, Z), rates, strict=True):
            K[k, k] = min(rate * K[k, half + k], K[k, k])
            Ki[k] = 0
        return replace(controller, K=K, Ki=Ki, braking=np.zeros(0))
    own = weights_of(controller)
    q = own.q.copy()
    for k, rate in zip((Y, Z), rates, strict=True):
        q[k] = min(own.r[k] * (2 * plant.inertia[k] * rate**2) ** 2, q[k])
    model = linearize(plant, plant.point(controller.operating_point[0]))
    softer = replace(own, q=q)
    Ts, delay = controller.sample_time, controller.delay
    return lqg(model, softer, Ts, "sampled-data", delay, name=controller.name, solver="scipy")


def jumps_reference(
    plant: Plant, place: tuple[float, float], gap: float, lift: float, distance: float
) -> Reference:
    """Two jumps: z from `gap` (m) over the magnets up by `lift` (m), then y by `distance` (m).

    Raises InputError for a position outside the travel.
    """
    first, T_s = start_of_moves(plant, place, gap, lift, distance), parameters_of(plant).T_s

    def at(t: FloatArray) -> Motion:
        p = np.zeros((len(t), 6))
        p[:, :3] = first
        for axis, size, begin in ((Z, lift, LIFT_AT), (Y, distance, MOVE_AT)):
            p[:, axis] += size * (np.asarray(t) > begin - T_s / 2)
        return Motion(p, np.zeros_like(p), np.zeros_like(p))

    return at


def jump_merits(run: Trajectory) -> tuple[Merit, ...]:
    """When y arrives, what is left in y and z at the end and how far they went beyond; forces, and time at limits."""
    moved = run.p[:, [Y, Z]] - run.reference[-1, [Y, Z]]
    past = moved * np.sign(run.reference[-1, [Y, Z]] - run.reference[0, [Y, Z]])
    return (
        Merit(
            "y within 10 um after its step", arrival(run, float(run.reference[-1, Y])), "ms", key="y_settled"
        ),
        *(Merit(f"{name}, left at the end", abs(float(moved[-1, k])), "um") for k, name in enumerate("yz")),
        *(
            Merit(f"{name}, overshoot", max(float(past[:, k].max()), 0.0), "um")
            for k, name in enumerate("yz")
        ),
        Merit("largest force", float(np.abs(run.v[:, :3]).max()), "N", "steps.force_limit", "at most"),
        Merit("largest torque", float(np.abs(run.v[:, 3:]).max()), "N m"),
        Merit(
            "forces at their limit for",
            float(run.saturated.any(axis=1).sum()) * run.controller.sample_time,
            "ms",
        ),
    )
