"""The published steps of the planar motor as the paper commands them: jumps of the reference.

A jump saturates the forces in y and z. A linear law that is much faster than these limits allow then brakes too late
and swings about its end, and the error of the first sample alone charges its sums. What settles is a law that
approaches its end at a speed from which it can stop: by its `braking`, or, as a linear one, at a rate that is slow.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.machines.planar.experiments.motions import (
    CELLS,
    DISTANCE,
    DURATION,
    FORCES,
    GAP,
    LIFT,
    LIFT_AT,
    MODELS,
    MOVE_AT,
    PLACE,
    arrival,
    parameters_of,
    start_of_moves,
    with_coil_model,
)
from malta.model.linearize import linearize
from malta.model.plant import Plant
from malta.simulation.experiments import Experiment, Merit, PlannedRun, Progress, fly_all, scenario_of
from malta.simulation.references import Motion, Reference
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.lqg import lqg, weights_of

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

DESIGNED, LINEAR, SOFT = "as designed", "without braking", "soft"  # ends of the labels of cases
Y, Z = 1, 2  # the axes that jump
SMALLEST = 1e-6  # m: a smaller jump asks for no softer gains


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
    flights = [(plant, by_table, f"table, {DESIGNED}")]
    flights += [(plant, replace(by_table, braking=np.zeros(0)), f"table, {LINEAR}")]
    flights += [(plant, with_coil_model(soft, model, cells), f"{model}, {SOFT}") for model in MODELS]
    cases, cut = fly_all(
        [(p, c, PlannedRun(label, scenario, jump_merits)) for p, c, label in flights], progress, options
    )
    merits = tuple(
        Merit(f"rate of approach in {name}", value, "1/s") for name, value in zip("yz", rates, strict=True)
    )
    return Experiment("jump", "Who settles when the reference jumps?", cases, merits, interrupted=cut)


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
        return math.sqrt(1.5 * F / (par.m * max(abs(d), SMALLEST)))

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
    return lqg(model, softer, controller.sample_time, "sampled-data", controller.delay, name=controller.name)


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
