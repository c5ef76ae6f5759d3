"""Strokes of MALTA: the published one, and a slow one that records v0(z)."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.merit_lists import reported_merits
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import Merit, PlannedRun
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.references import Profile, Reference
from malta.simulation.scenario import Scenario
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    pass

SETTLE = 0.3  # s at rest before the strokes of yields, as on the bench
DISTANCE, RISE = 10e-3, 16.2e-3  # m, s from 10 to 90 %: the published stroke, Fig. 12


def stroke_cases(
    _: Plant,
    __: Controller,
    *,
    distance: float = DISTANCE,
    rise: float = RISE,
    profile: Profile = "logistic",
    **options: Any,
) -> list[PlannedRun]:
    """The published stroke: tracking, radial deviation, currents, and K_D as the ratio of force and current."""
    asked = {name: value for name, value in options.items() if name != "engine"}
    scenario = Scenario.stroke(distance, rise=rise, profile=profile, **asked)
    published = distance == DISTANCE and rise == RISE
    return [PlannedRun("stroke", scenario, partial(stroke_merits, published=published))]


def stroke_merits(run: Trajectory, *, published: bool = True) -> tuple[Merit, ...]:
    """Rise, overshoot, errors, drive constant, heat and efficiency of a stroke.

    published : the stroke is that of Figs 12 and 13, so published figures stand beside ours
    """
    printed = {
        "rise": "figure_12.rise_time",
        "overshoot": "figure_12.overshoot",
        "axial_error": "figure_12.axial_error",
        "radial": "figure_13.radial_deviation",
    }  # by fields of StrokeFigures
    found = reported_merits(stroke_figures(run)).items()
    merits = [merit._replace(published=printed.get(name.partition(".")[0], "")) for name, merit in found]
    merits += [
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
