"""Requirements that machines make of their outputs, inputs and experiments, measured with several seeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

from malta.synthesis.requirements import (
    SEEDS,
    Figure,
    Indices,
    Requirement,
    Trade,
    judge_figure,
    noise_at_rest,
)

CONFIDENCE = 0.95  # of the intervals at all of SEEDS together


def mean_over_seeds(
    draw: Callable[[int], float], asked: float, source: str, *, at_least: bool = False
) -> Figure:
    """Average a simulated figure over seeds of the noise until its interval decides against the bound.

    After each number n of SEEDS the interval is mean -+ t s / sqrt(n), with Student's t (two sides) for a confidence of
    1 - (1 - CONFIDENCE) / len(SEEDS), so that all of them hold the expected value with CONFIDENCE (Bonferroni).
    Figures are taken as normal. No clock ends it, so that no verdict depends on the speed of a computer.

    draw : seed -> the figure of one run; infinite for a run that failed
    asked : the bound

    Returns a Figure with its interval, after the last of SEEDS whether or not that decides; of a failed run an
    infinite one.

    >>> mean_over_seeds(lambda seed: 2.0 + 0.1 * (seed % 2), 3.0, "a run").source
    'a run, 4 seeds'
    """
    found: list[float] = []
    for n in SEEDS:
        found += [draw(seed) for seed in range(len(found), n)]
        if not all(map(math.isfinite, found)):
            return Figure(math.inf, f"{source}, a run of {n} failed")
        mean, spread = float(np.mean(found)), float(np.std(found, ddof=1))
        t = float(special.stdtrit(n - 1, 1 - (1 - CONFIDENCE) / (2 * len(SEEDS))))
        half = t * spread / math.sqrt(n)
        figure = Figure(mean, f"{source}, {n} seeds", (mean - half, mean + half))
        if judge_figure(figure, asked, at_least=at_least) != "undecided":
            break
    return figure


def reached_with_every_seed(draw: Callable[[int], bool], reached: float, source: str) -> Figure:
    """Judge a flight that ends well or does not: the figure where it does with each of SEEDS[0] seeds, else 0.

    A yes or no has no mean that an interval could separate from a bound; the source says how many flights it was.

    draw : seed -> whether the flight ends well
    reached : the figure of flights that do

    >>> reached_with_every_seed(lambda seed: seed < 3, 0.2, "stroke")
    Figure(value=0.0, source='stroke, 3 of 4 seeds', interval=None)
    """
    count = sum(draw(seed) for seed in range(SEEDS[0]))
    well = count == SEEDS[0]
    return Figure(reached if well else 0.0, f"{source}, {'' if well else f'{count} of '}{SEEDS[0]} seeds")


def motion_of(name: str, outputs: Indices, heading: str) -> Requirement:
    """Bound the true motion of some outputs at rest, rms, from the sensors' noise and steps: the worst of them."""
    meaning = f"{heading} motion at rest, rms, from the sensors' noise and steps"
    return _noise_of(name, "motion", outputs, unit="m", heading=heading, meaning=meaning)


def force_noise_of(name: str, inputs: Indices, heading: str) -> Requirement:
    """Bound the noise of some commanded forces at rest, rms: the worst of them."""
    meaning = f"noise of the commanded {heading} at rest, rms"
    return _noise_of(name, "force", inputs, unit="N", heading=heading, meaning=meaning)


def _noise_of(name: str, kind: Trade, indices: Indices, **fields: Any) -> Requirement:
    """A bound of the noise at rest of the signals with these indices in the plant."""
    return noise_at_rest(name, kind, lambda plant, _: indices(plant), indices=indices, **fields)


def worst_merit(experiment: Any) -> float:
    """Take the largest of the first figure of merit over an experiment's cases; infinite where it failed."""
    worst = max(case.merits[0].value for case in experiment.cases)
    return math.inf if experiment.failed else float(worst)
