"""Strokes of MALTA: the published one, and the fastest that the drive allows."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    QUIET,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    scenario_of,
)
from malta.simulation.references import Profile, Reference
from malta.simulation.scenario import Scenario
from malta.simulation.trajectory import Trajectory, stroke_figures
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.simulation.time_optimal import FastestStroke, SigmoidStroke

SETTLE = 0.3  # s at rest before the strokes of yields, as on the bench
DISTANCE, RISE = 10e-3, 16.2e-3  # m, s from 10 to 90 %: the published stroke, Fig. 12


def stroke(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = DISTANCE,
    rise: float = RISE,
    profile: Profile = "logistic",
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The published stroke: tracking, radial deviation, currents, and K_D as the ratio of force and current."""
    wanted = stroke_cases(plant, controller, distance=distance, rise=rise, profile=profile, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    return Experiment("stroke", "Does it follow the stroke?", cases, cases[0].merits, interrupted=cut)


def stroke_cases(
    _: Plant, __: Controller, *, distance: float, rise: float, profile: Profile, **options: Any
) -> list[PlannedRun]:
    """The run of `stroke`."""
    asked = {name: value for name, value in options.items() if name != "engine"}
    scenario = Scenario.stroke(distance, rise=rise, profile=profile, **asked)
    published = distance == DISTANCE and rise == RISE
    return [PlannedRun("stroke", scenario, partial(stroke_merits, published=published))]


def stroke_merits(run: Trajectory, *, published: bool = True) -> tuple[Merit, ...]:
    """Rise, overshoot, errors, drive constant, heat and efficiency of a stroke.

    published : the stroke is that of Figs 12 and 13, so published figures stand beside ours
    """
    f = stroke_figures(run)
    merits = [
        Merit("rise, 10-90 %", f.rise, "ms", "figure_12.rise_time"),
        Merit("overshoot", f.overshoot, "percent", "figure_12.overshoot", "at most"),
        Merit("axial error", f.axial_error, "mm", "figure_12.axial_error", "at most"),
    ]
    bound = "figure_13.radial_deviation"
    merits += [Merit(f"deviation {name}", value, "um", bound, "at most") for name, value in f.radial.items()]
    merits += [
        Merit("largest thrust", f.force, "N"),
        Merit("largest commanded current", f.current, "A"),
        Merit(
            "drive constant per module, f / i",
            drive_constant(run),
            "N/A",
            "figure_12.drive_constant",
            key="drive_constant",
            better="",
        ),
        Merit("heat in the windings", float(run.copper_loss.sum()) * run.controller.sample_time, "J"),
    ]
    if run.u.size:
        merits += [
            Merit("efficiency while it accelerates", efficiency(run), "percent", better="high"),
            Merit("largest voltage of an axis", float(np.abs(run.u).max()), "V"),
            Merit("lowest voltage of the DC link", float(run.link.min()), "V", better="high"),
        ]
    return tuple(merits) if published else tuple(merit._replace(published="") for merit in merits)


def drive_constant(run: Trajectory) -> float:
    """Thrust over thrust current of one winding, N/A: least squares over all samples."""
    plant = run.plant
    unit = np.zeros(len(plant.inputs))
    unit[plant.thrust_input] = 1.0
    shares = np.flatnonzero(np.array(ca.DM(plant.drive.command(ca.DM(unit)))).ravel())
    i, f = run.axis_currents[:, shares[0]], run.force[:, plant.thrust_input]
    return float(i @ f / (i @ i)) / len(shares)


def efficiency(run: Trajectory) -> float:
    """Mechanical over electrical energy while the thrust accelerates the mover and the windings draw power.

    At most K_D / (4.5 K_ind) on MALTA, 66 %, because the two measured constants do not balance.
    """
    speed = run.x[:, len(run.plant.states) // 2 + run.plant.stroke_state]
    mechanical, electrical = run.force[:, run.plant.thrust_input] * speed, run.electrical_power
    driving = (mechanical > 0) & (electrical > 0)
    drawn = float(electrical[driving].sum())
    return float(mechanical[driving].sum()) / drawn if drawn else math.nan


def delayed_stroke(plant: Plant, wait: float, distance: float = DISTANCE) -> Reference:
    """The published stroke with its middle 50 ms after `wait` (s); before it the mover rests at the start."""
    return references.stroke(plant, -distance / 2, distance / 2, RISE, wait + 0.05)


def drive_limits(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = DISTANCE,
    current_share: float = 0.8,
    voltage_share: float = 0.7,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The fastest stroke within shares of the current and voltage limits (the rest is the feedback's), and the sigmoid
    whose peak current is the same."""
    best, sigmoid = _limit_strokes(plant, distance, current_share, voltage_share)
    wanted = _limit_cases(best, sigmoid, distance, options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    merits = (
        Merit("current limit used", current_share * plant.actuator.current_limit, "A"),
        Merit("voltage limit used", voltage_share * plant.actuator.voltage_limit, "V"),
        Merit("fastest stroke, from rest to rest", best.duration, "ms"),
        Merit("rise, sigmoid over fastest", sigmoid.rise / best.rise, "1", better=""),
        Merit(
            "travel, sigmoid over fastest", sigmoid.travel_time(1e-3) / best.travel_time(1e-3), "1", better=""
        ),
    )
    curves = {"t": best.t, "z": best.z, "u": best.u, "i": best.i}
    return Experiment("drive-limits", "How fast could it be?", cases, merits, curves, interrupted=cut)


@lru_cache(maxsize=16)  # the optimum takes a second, and every design of a machine has the same
def _limit_strokes(
    plant: Plant, distance: float, current_share: float, voltage_share: float
) -> tuple[FastestStroke, SigmoidStroke]:
    """The fastest stroke within shares of current and voltage, and the sigmoid of the same peak current."""
    from malta.simulation.time_optimal import (
        fastest_stroke,  # with scipy's integrators, for these experiments alone
        sigmoid_at_peak_current,
    )

    shares: dict[str, Any] = {"voltage_share": voltage_share, "current_share": current_share}
    emf = induced_per_speed(plant)
    return (
        fastest_stroke(plant, distance, emf, **shares),
        sigmoid_at_peak_current(plant, distance, emf, **shares),
    )


def _limit_cases(
    best: FastestStroke, sigmoid: SigmoidStroke, distance: float, options: dict[str, Any]
) -> list[PlannedRun]:
    """The runs of `drive-limits` for these two strokes."""
    duration = max(0.1, 6 * sigmoid.rise)
    ends: dict[str, Any] = {"start": -distance / 2, "end": distance / 2}
    logistic = partial(references.stroke, **ends, rise=sigmoid.rise, centre=duration / 2)
    fast = partial(best.reference, centre=duration / 2)
    wanted: list[PlannedRun] = []
    for label, reference, found in (("fastest", fast, best), ("sigmoid", logistic, sigmoid)):
        scenario = scenario_of("drive-limits", duration, reference, QUIET | options)
        wanted.append(PlannedRun(label, scenario, partial(_limit_merits, found=found)))
    return wanted


def drive_limit_cases(
    plant: Plant,
    _: Controller,
    *,
    distance: float,
    current_share: float,
    voltage_share: float,
    **options: Any,
) -> list[PlannedRun]:
    """The runs of `drive-limits` for a campaign."""
    return _limit_cases(*_limit_strokes(plant, distance, current_share, voltage_share), distance, options)


def _limit_merits(run: Trajectory, found: FastestStroke | SigmoidStroke) -> tuple[Merit, ...]:
    """Rise and travel time of the reference, and the figures of the stroke."""
    return (
        Merit("reference: rise, 10-90 %", found.rise, "ms", better=""),
        Merit(
            "reference: 0.1 to 99.9 % of travel",
            found.travel_time(1e-3),
            "ms",
            key="reference_travel_time",
            better="",
        ),
        *stroke_merits(run, published=False),
    )


def induced_per_speed(plant: Plant) -> float:
    """Induced voltage of the thrust axes over the speed of the stroke, V s/m."""
    rate = plant.states[len(plant.states) // 2 + plant.stroke_state].name
    return float(np.abs(np.array(ca.evalf(plant.drive.emf(ca.SX(ca.DM(plant.at(**{rate: 1.0}).x)))))).max())
