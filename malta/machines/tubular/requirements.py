"""Requirements on designs of MALTA, besides those of every machine: rest, strokes, tilts, payload and lift-off."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import get_args

import numpy as np

from malta.model.plant import Plant
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.scenario import ESTIMATORS, Scenario
from malta.simulation.simulate import fits_kalman_filter
from malta.synthesis.machine_requirements import (
    force_noise_of,
    mean_over_seeds,
    motion_of,
    reached_with_every_seed,
    worst_merit,
)
from malta.synthesis.requirements import SEEDS, Design, Figure, Requirement, TrialFigures
from malta.synthesis.spec import Law

DRIVE = "K_D"  # the force constant of the drive, which scales the thrust and no other force
DRIVE_ERROR = 0.05  # of the drive's force constant, in the strokes of tracking_error
TILT, TILTING = 200e-6, 2.0  # m, Hz: the tilt of the experiment
ANY_LAW: tuple[Law, ...] = get_args(Law)
SIGMAS = 4.5  # the largest of 10 000 normal samples, in standard deviations


def _radial(plant: Plant) -> list[int]:
    """Columns of the radial outputs."""
    return [k for k in range(len(plant.outputs)) if k != plant.stroke_output]


def _axial(plant: Plant) -> list[int]:
    """Column of the axial output."""
    return [plant.stroke_output]


def _bearings(plant: Plant) -> list[int]:
    """Columns of the bearing forces."""
    return [k for k in range(len(plant.inputs)) if k != plant.thrust_input]


def _thrust(plant: Plant) -> list[int]:
    """Column of the thrust."""
    return [plant.thrust_input]


@lru_cache(maxsize=SEEDS[-1])  # two requirements ask for it; designs compare by identity, so no hit is stale
def _strokes(design: Design, seed: int) -> tuple[float, float]:
    """The largest tracking error and radial deviation, m, of strokes with too weak and too strong a drive."""
    par, worst = design.plant.parameters, np.zeros(2)
    for share in (1 - DRIVE_ERROR, 1 + DRIVE_ERROR):
        other = replace(par, **{DRIVE: share * getattr(par, DRIVE)})
        run = design.simulate(other, Scenario.stroke(noise=1.0, quantize=True, seed=seed))
        if not run.verdict.completed:
            return math.inf, math.inf
        figures = stroke_figures(run)
        worst = np.maximum(worst, (figures.axial_error, max(figures.radial.values())))
    axial, radial = worst.tolist()
    return axial, radial


def _of_strokes(index: int) -> Callable[[Design, float, str], list[Figure]]:
    """The measurement of one figure of `_strokes`, its mean over seeds of the noise."""

    def measure(design: Design, asked: float, _signal: str) -> list[Figure]:
        source = f"strokes with {DRIVE} {100 * DRIVE_ERROR:g} % off"
        return [mean_over_seeds(lambda seed: _strokes(design, seed)[index], asked, source)]

    return measure


def _tilt_estimate(trial: TrialFigures, _signal: str) -> float | None:
    """Estimated deviation of the other sensor planes, m, while the first follows the circle of the tilt.

    The response of the linear loop, and SIGMAS times the motion at rest. None for a loop that is not the radial one.
    """
    if len(trial.outputs) == 1 or trial.plant.stroke_output in trial.outputs:
        return None
    half, motion = len(trial.model.A) // 2, SIGMAS * float(trial.noise.motion.max())
    C = trial.model.C[:, :half]
    if C.shape[0] != half:
        return motion
    p, rate = TILT * np.eye(half)[0], 2 * math.pi * TILTING
    q = np.linalg.solve(C, p)
    moved = trial.follow(rate, p, np.concatenate([q, 1j * rate * q]))
    return float(np.abs(moved[1:]).max()) + motion


def _tilt(design: Design, asked: float, _signal: str) -> list[Figure]:
    """Deviation of the sensor plane that is to stand still, m: without and with the attraction fed forward.

    Of a controller whose gain file feeds it forward, with it. The mean over seeds of the noise.
    """
    own = bool(design.controller.feedforward.position.size)
    options = {"feedforward": "own"} if own else {}
    source = "tilt, attraction fed forward" if own else "tilt, either feedforward"
    return [
        mean_over_seeds(lambda seed: worst_merit(design.fly("tilt", seed=seed, **options)), asked, source)
    ]


def _payload(design: Design, asked: float, _signal: str) -> list[Figure]:
    """The mass asked for if the mover carries it through a stroke with every seed of the noise, else 0, kg."""

    def carries(seed: int) -> bool:
        picked = design.fly("payload", masses=(asked,), seed=seed)
        return bool(picked.cases[0].run.verdict.completed)

    return [reached_with_every_seed(carries, asked, "hold and stroke")]


def _lift_off(design: Design, _asked: float, _signal: str) -> list[Figure]:
    """1 if every start-up estimator that fits the controller lifts the mover off with every seed, else 0."""
    every = fits_kalman_filter(design.controller)
    source = "every estimator" if every else f"{ESTIMATORS[0]} estimator"
    return [reached_with_every_seed(lambda seed: not design.fly("lift-off", seed=seed).failed, 1.0, source)]


REQUIREMENTS = (
    motion_of("radial_motion", _radial, "radial"),
    motion_of("axial_motion", _axial, "axial"),
    force_noise_of("force_noise", _bearings, "bearing force"),
    force_noise_of("thrust_noise", _thrust, "thrust"),
    Requirement(
        "tracking_error",
        _of_strokes(0),
        "m",
        laws=ANY_LAW,
        flown=True,
        meaning="axial error in the stroke with 5 % error of K_D, either way",
        error_of=("z",),
    ),
    Requirement(
        "radial_deviation",
        _of_strokes(1),
        "m",
        laws=ANY_LAW,
        flown=True,
        meaning="radial deviation in the same strokes",
        error_of=("x1", "y1", "x2", "y2"),
    ),
    Requirement(
        "tilt_deviation",
        _tilt,
        "m",
        laws=ANY_LAW,
        estimate=_tilt_estimate,
        flown=True,
        meaning="deviation of sensor plane 2 in the tilt",
    ),
    Requirement(
        "payload",
        _payload,
        "kg",
        at_least=True,
        laws=ANY_LAW,
        flown=True,
        meaning="mass that is picked up and carried through a stroke, at least",
    ),
    Requirement(
        "lift_off",
        _lift_off,
        at_least=True,
        laws=ANY_LAW,
        form="switch",
        flown=True,
        meaning="whether it lifts off from rest on the bearing",
    ),
)
