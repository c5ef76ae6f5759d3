"""The experiments on MALTA.

stroke        the published move, Figs 12 and 13
hold          2000 samples at rest with sensor noise, Fig. 14 and Table III
tilt          a circle in sensor plane 1, sensor plane 2 held, Fig. 16 and eq. (21)
lift-off      from rest on the touchdown bearing, by each start-up estimator that fits the controller
payload       masses picked during a hold, and a stroke with them
disturbance   force and torque steps, vibration of the housing, compliance over frequency
faults        of sensors, samples, a phase and the DC link: survival or touchdown
commissioning from the touchdown bearing to operation and back, by the supervisor of the exported C
supervised-faults  the faults with that supervisor and without it: which touchdowns it prevents
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from malta.errors import InputError
from malta.machines.tubular.experiments.commissioning import commissioning, supervised_faults
from malta.machines.tubular.experiments.disturbances import (
    disturbance,
    disturbance_cases,
    hold,
    hold_cases,
    tilt_cases,
)
from malta.machines.tubular.experiments.faults import faults
from malta.machines.tubular.experiments.lifting import lift_cases, lift_off, payload
from malta.machines.tubular.experiments.strokes import DISTANCE, RISE, SETTLE as SETTLE, stroke_cases
from malta.simulation.experiments import Experiment, PlannedRun, experiment_of, merits_of_first

if TYPE_CHECKING:
    from malta.identification.commission import Check

EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "stroke": experiment_of("stroke", "Does it follow the stroke?", stroke_cases, merits_of_first),
    "hold": hold,
    "tilt": experiment_of("tilt", "Does it tilt about sensor plane 2?", tilt_cases),
    "lift-off": lift_off,
    "payload": payload,
    "disturbance": disturbance,
    "faults": faults,
    "commissioning": commissioning,
    "supervised-faults": supervised_faults,
}
# Experiments that campaigns can run: nothing but the machine differs between the runs of a case.
CASES: dict[str, Callable[..., list[PlannedRun]]] = {
    "stroke": stroke_cases,
    "hold": hold_cases,
    "tilt": tilt_cases,
    "lift-off": lift_cases,
    "disturbance": disturbance_cases,
}
FINDINGS = ("payload", "disturbance", "faults", "supervised-faults")
ALONE = ("stroke", "hold", "tilt")
WORDS = {"stroke": "axial", "m": "radial", "thrust": "thrust", "N": "bearing force"}
STROKE_UNIT = "mm"
OPTION_UNITS = {"distance": "m", "rise": "s", "radius": "m", "frequency": "Hz", "masses": "kg"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number that is zero or not finite. Strokes check their own options."""
    if option in ("distance", "rise", "profile", "during", "only", "known"):
        return
    if not all(math.isfinite(v) and v for v in (value if option == "masses" else (value,))):
        raise InputError("simulate", f"{name}: {option}", repr(value), "finite, other than 0")


def bounds(scenario: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Keys of the published figures for a scenario, if it is the published stroke."""
    if not _is_published(scenario, options):
        return {}
    return {
        "rise": "figure_12.rise_time",
        "overshoot": "figure_12.overshoot",
        "stroke": "figure_12.axial_error",
        "m": "figure_13.radial_deviation",
    }


def bounds_in_specification(scenario: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Names in [specification] that bound the deviations in a scenario, if it is the published stroke."""
    return {"stroke": "tracking_error", "m": "radial_deviation"} if _is_published(scenario, options) else {}


def _is_published(scenario: str, options: Mapping[str, Any]) -> bool:
    """Whether a scenario is the stroke that the paper flies."""
    asked = {"distance": DISTANCE, "rise": RISE, "profile": "logistic"}
    return scenario == "stroke" and all(options.get(name, value) == value for name, value in asked.items())


def commissioning_steps(box: Mapping[str, float]) -> tuple[Check, ...]:
    """The checklist of `malta commission`."""
    from malta.machines.tubular.bench import steps

    return steps(box)
