"""What a flown stroke is worth: its times, its overshoot and what it moves beside itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from malta.arrays import FloatArray
from malta.display import display
from malta.merit_lists import merit_field, reported_merits
from malta.merits import Merit
from malta.simulation.trajectory import Trajectory


@display
@dataclass(frozen=True)
class StrokeFigures:
    """Figures of a stroke, as papers publish them. SI."""

    rise: float = merit_field("rise, 10-90 %", "ms")  # s, of the true position; NaN when it was not reached
    overshoot: float = merit_field("overshoot", "percent", "at most")  # NaN when the run ended early
    axial_error: float = merit_field("axial error", "mm", "at most")  # m, largest |z* - z|
    radial: Mapping[str, float] = merit_field("deviation {}", "um", "at most")  # m, largest, by radial output
    force: float = merit_field("largest thrust", "N")  # N, commanded
    current: float = merit_field("largest commanded current", "A")  # A, of any axis

    @property
    def figures(self) -> tuple[Merit, ...]:
        """Its figures of merit, with what each means and which way is better."""
        return tuple(reported_merits(self).values())


def stroke_figures(run: Trajectory) -> StrokeFigures:
    """Compute rise, overshoot, tracking error and deviations of a stroke.

    run : a run; of a machine without a stroke its leading output is taken

    Returns a StrokeFigures, in SI: rise (s, 10 to 90 %), overshoot (share of the stroke), axial_error (m), radial
    deviations (m) by output, largest commanded force (N) and current (A). NaN where a run ended early.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(10e-3))
    >>> figures = malta.simulation.stroke_figures(run)
    >>> f"{1e3 * figures.rise:.1f} ms, overshoot {figures.overshoot:.2%}"
    '15.8 ms, overshoot 0.00%'
    """
    names = [s.name for s in run.plant.outputs]
    axis = run.plant.leading_output
    z, z_ref = run.p[:, axis], run.reference[:, axis]
    start, end = z_ref[0], z_ref[-1]
    error = np.abs(run.p - run.reference)
    # A run that ended early did not reach the end of its reference.
    whole = run.verdict.completed and end != start
    share = (z - start) / (end - start) if whole else np.full(len(z), np.nan)
    return StrokeFigures(
        rise=_crossing_time(run.t, share, 0.9) - _crossing_time(run.t, share, 0.1) if whole else math.nan,
        overshoot=max(float(share.max()) - 1, 0.0) if whole else math.nan,
        axial_error=float(error[:, axis].max()),
        radial={name: float(error[:, i].max()) for i, name in enumerate(names) if i != axis},
        force=float(np.abs(run.v[:, run.plant.leading_input]).max()),
        current=float(np.abs(run.current).max()),
    )


def _crossing_time(t: FloatArray, share: FloatArray, level: float) -> float:
    """The time (s) at which a share first reaches a level, by linear interpolation; NaN if it never does."""
    k = int(np.argmax(np.asarray(share) >= level))
    if k == 0:
        return math.nan
    return float(np.interp(level, share[k - 1 : k + 1], t[k - 1 : k + 1]))
