"""The error of the Halbach motor at rest, by source: Sec. 5.1."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from malta.machines.halbach import electronics
from malta.machines.halbach.electronics import IDEAL, IQ_BITS, Options
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    QUIET,
    REAL,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    scenario_of,
)
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller


class Source(NamedTuple):
    """A source of error: the electronics and the sensors that have it alone."""

    parts: Options
    sensors: dict[str, Any]
    aside: float = 0.0  # m, beside the place of the budget


SOURCES: Mapping[str, Source] = {
    "laser": Source(IDEAL, REAL),
    "current noise": Source(replace(IDEAL, adc_noise=True), QUIET),
    "current steps": Source(replace(IDEAL, adc_steps=True), QUIET),
    "PWM": Source(replace(IDEAL, pwm="plain"), QUIET),
    f"angle of {IQ_BITS} bits": Source(replace(IDEAL, angle_bits=IQ_BITS), QUIET, 0.3e-3),  # exact at x = 0
    "all": Source(electronics.REAL, REAL),
    "all, fine PWM": Source(replace(electronics.REAL, pwm="fine"), REAL),
}
LASTING, FIRST = 500, 40  # readings of a run, and the first of them that counts
ALONG = 7  # places along half a pitch, for current noise alone


def budget(
    plant: Plant,
    controller: Controller,
    *,
    place: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Rest at `place` (m) with each source of error alone, and with all; current noise along half a pitch.

    The fixed-point angle is not among all: the paper prints no format.
    """
    believed: Any = controller.parameters
    spots = np.linspace(0, math.pi / believed.k, ALONG)
    asked = [(name, *source[:2], place + source.aside) for name, source in SOURCES.items()]
    asked += [(f"current noise at {1e3 * x:.1f} mm", *SOURCES["current noise"][:2], float(x)) for x in spots]
    wanted = []
    for label, parts, sensors, x in asked:
        own = {"fidelity": "phase", "electronics": parts} | sensors
        reference = partial(references.hold, x=x)
        scenario = scenario_of("budget", LASTING * controller.sample_time, reference, own | options)
        wanted.append(PlannedRun(label, scenario, _rest_merits))
    flown, cut = fly(plant, controller, wanted, progress, options)
    shown, along = flown[: len(SOURCES)], flown[len(SOURCES) :]
    found = np.array([case.merits[0].value for case in along])
    ends = (("best", found.min(initial=math.inf)), ("worst", found.max(initial=0.0))) if len(found) else ()
    merits = tuple(Merit(f"current noise, at the {end} place", float(value), "um") for end, value in ends)
    curves = {"place": spots[: len(found)], "rms": found}
    return Experiment("budget", "What keeps it from standing still?", shown, merits, curves, interrupted=cut)


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Rms, mean and peak to peak of the position error after the first readings."""
    error = (run.p - run.reference)[FIRST:, 0]
    if len(error) == 0:
        error = np.array([math.nan])
    return (
        Merit("position, rms", float(error.std()), "um"),
        Merit("mean error", abs(float(error.mean())), "um"),
        Merit("peak to peak", float(np.ptp(error)), "um"),
    )
