"""Where stability is lost along lines through the box, by the poles in floating point: estimates, no proofs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError
from malta.margins.box import Box
from malta.margins.expressions import NotAnalytic
from malta.margins.problem import Problem

if TYPE_CHECKING:
    from malta.plant import FloatArray


def loss_of_one(problem: Problem, box: Box, reach: float) -> float | None:
    """About the first t up to `reach` at which the loop is unstable, where one parameter grows to one side alone.

    From above; infinite where there is none, None where several parameters grow.
    """
    ends = [(i, sign * rate[i]) for sign, rate in ((-1, box.down), (1, box.up)) for i in np.flatnonzero(rate)]
    if len(ends) != 1:
        return None
    d = np.zeros(len(box.names))
    d[ends[0][0]] = ends[0][1]
    places = box.standing()[:3]

    def unstable(t: FloatArray) -> FloatArray:
        rows = (places[None] + t[:, None, None] * d).reshape(-1, len(d))
        try:
            return np.asarray((problem.instability(rows) >= 0).reshape(len(t), -1).any(axis=1))
        except (CheckError, np.linalg.LinAlgError, NotAnalytic):
            return np.zeros(len(t), dtype=bool)

    high, low = reach, 0.0
    for steps in (np.geomspace(1e-2, 1, 15) * reach, *[np.linspace(0, 1, 6)[1:]] * 2):
        grid = low + (high - low) * steps if low or high < reach else steps
        bad = unstable(grid)
        if not bad.any():
            return math.inf
        k = int(bad.argmax())
        low, high = (float(grid[k - 1]) if k else low), float(grid[k])
    return high


def first_loss(problem: Problem, box: Box, reach: float) -> tuple[float, float | None, FloatArray | None]:
    """t, w, p at the first loss of stability along the diagonals of the box, by the poles; or infinity."""
    free = [i for i in range(len(box.names)) if box.down[i] + box.up[i] > 0]
    signs = np.array(list(itertools.islice(itertools.product((-1, 1), repeat=len(free)), 256)))
    best: tuple[float, float | None, FloatArray | None] = (math.inf, None, None)
    for place in box.standing()[:27]:
        for sign in signs:
            d = np.zeros(len(box.names))
            d[free] = np.where(sign > 0, box.up[free], -box.down[free])
            t = _along(problem, place, d, min(reach, best[0]))
            if t < best[0]:
                p = place + t * d
                best = (t, problem.critical(p), p)
    return best


def _along(problem: Problem, p: FloatArray, d: FloatArray, reach: float) -> float:
    """The first t of a grid up to reach at which p + t d is unstable, bisected; infinite where there is none."""

    def unstable(t: Sequence[float] | FloatArray) -> FloatArray:
        try:
            return np.asarray(problem.instability(p + np.asarray(t)[:, None] * d) >= 0)
        except (CheckError, np.linalg.LinAlgError, NotAnalytic):
            return np.zeros(len(t), dtype=bool)

    grid = np.unique(np.concatenate([np.geomspace(1e-3, 1, 24) * reach, np.linspace(0, reach, 41)[1:]]))
    bad = unstable(grid)
    if not bad.any():
        return math.inf
    k = int(bad.argmax())
    low, high = (grid[k - 1] if k else 0.0), grid[k]
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if unstable([middle])[0] else (middle, high)
    return float(high)
