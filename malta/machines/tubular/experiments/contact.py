"""When and how fast the mover meets its touchdown bearings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from malta.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

    IntArray = NDArray[np.intp]

SOFT = 0.05  # m/s: a landing that meets its bearing faster is a touchdown; a fall by 33 um, pulled by the magnets


def contacts_of(run: Trajectory, since: float = 0.0) -> tuple[IntArray, FloatArray]:
    """Samples at which a touchdown bearing is met after `since`, s, and how fast, m/s.

    Every contact counts, also after a bounce, but that at the start; its speed is that of the sensor planes over the
    three samples before.
    """
    touching = np.atleast_1d((run.contact[:, np.array(run.plant.cushioned)] >= 1).any(axis=1))
    met = np.flatnonzero(touching[1:] & ~touching[:-1]) + 1
    met = met[run.t[met] >= since]
    others = [i for i in range(run.p.shape[1]) if i != run.plant.stroke_output]
    before = np.maximum(met - 3, 0)
    moved = np.abs(run.p[met][:, others] - run.p[before][:, others]).max(axis=1)
    return met, moved / (run.t[met] - run.t[before])


def contact_of(run: Trajectory, since: float = 0.0) -> tuple[float, float]:
    """When a touchdown bearing is met first after `since`, s, and how fast at worst, m/s; NaN where it is not."""
    met, speeds = contacts_of(run, since)
    if not len(met):
        return math.nan, math.nan
    return float(run.t[met[0]]), float(speeds.max())
