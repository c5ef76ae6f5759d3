"""The loss of stability along lines through a box, by the poles in floating point: estimates, no proofs."""

from __future__ import annotations

import itertools
import math
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError
from malta.proof.expressions import NotAnalytic
from malta.proof.time_limit import is_late

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.box import Box
    from malta.proof.problem import Problem

    Loss = tuple[float, float | None, FloatArray | None]  # t, w, p

STEP = 1e-6  # of a range, for slopes of the worst root
NARROW = 2.0**-40  # of a step of the grid, to which a loss is narrowed down
ROUNDS = 6  # from corner to corner


CORNERS = 64  # of a box that are looked at before its families are made


def corner_loss(problem: Problem, box: Box, reach: float) -> float | None:
    """The first t up to `reach` at which a corner of the box is unstable, by the poles.

    The estimate comes from above; infinite without a loss. None where the box has more than CORNERS, and where the time
    is up.
    """
    sides = [
        [rate for rate in (-down, up) if rate] or [0.0]
        for down, up in zip(box.down.tolist(), box.up.tolist(), strict=True)
    ]
    if math.prod(map(len, sides)) > CORNERS:
        return None
    corners = np.array(list(itertools.product(*sides)))
    rays = [(place, corner) for place in box.nominal_places()[:3] for corner in corners]
    low, high = 0.0, reach
    for steps in (np.geomspace(1e-2, 1, 10), *[np.linspace(0, 1, 6)[1:]] * 3):
        for t in (low + (high - low) * steps).tolist():
            if is_late():
                return None
            rows = np.array([place + t * corner for place, corner in rays])
            bad = _instability(problem, rows, -math.inf) >= 0
            if bad.any():
                break
            low = t
        else:
            return math.inf
        high = t
        rays = [ray for ray, lost in zip(rays, bad, strict=True) if lost]
    return high


def first_loss(problem: Problem, box: Box, reach: float) -> Loss:
    """The first loss of stability along the diagonals of the box, by the poles: t, w (rad/s) and p; else infinity.

    The nearest that is found by the time that is up.
    """
    free = [i for i in range(len(box.names)) if box.down[i] + box.up[i] > 0]
    signs = np.array(list(itertools.islice(itertools.product((-1, 1), repeat=len(free)), 256)))
    best: Loss = (math.inf, None, None)
    for place in box.nominal_places()[:27]:
        best = _nearer(problem, place, _uphill(problem, box, place), reach, best)
        best = _improve_corner(problem, box, place, best)
        for sign in signs:
            if is_late():
                return best
            d = np.zeros(len(box.names))
            d[free] = np.where(sign > 0, box.up[free], -box.down[free])
            best = _nearer(problem, place, d, reach, best)
        best = _improve_corner(problem, box, place, best)
    return best


def loss_beside(problem: Problem, box: Box, witness: FloatArray, proven: float, reach: float) -> Loss:
    """The first loss up to `reach` towards the witness of another loop, or at a corner near it; else infinity.

    proven : t up to which the box is known to be stable
    """
    place = box.nominal_places()[0]
    d = (witness - place) / max(float(box.margin(witness)), 1e-300)
    found = _nearer(problem, place, d, reach, (math.inf, None, None), proven)
    return _improve_corner(problem, box, place, found, proven)


def _nearer(
    problem: Problem, place: FloatArray, d: FloatArray, reach: float, best: Loss, proven: float = 0.0
) -> Loss:
    """The first loss along a direction if it is nearer than the best one, else that one."""
    t = _along(problem, place, d, min(reach, best[0]), proven)
    if not t < best[0]:
        return best
    p = place + t * d
    return t, _critical(problem, p, place), p


def _improve_corner(problem: Problem, box: Box, place: FloatArray, best: Loss, proven: float = 0.0) -> Loss:
    """Move a loss to the corner that the slopes of the worst root point to, as long as t decreases."""
    for _ in range(ROUNDS):
        t, _, p = best
        if p is None or not np.isfinite(t) or is_late():
            break
        d = _uphill(problem, box, p)
        nearer = _along(problem, place, d, t, proven)
        if not nearer < t * (1 - 1e-9):
            break
        there = place + nearer * d
        best = (nearer, _critical(problem, there, place), there)
    return best


def corner_of(problem: Problem, box: Box, p: FloatArray) -> FloatArray:
    """The corner that the slopes of the worst root point to, of the box with p on its edge; p when it is stable."""
    d = _uphill(problem, box, p)
    corner = np.where(box.down + box.up > 0, box.nominal + float(box.margin(p)) * d, p)
    return corner if float(_instability(problem, corner[None], -math.inf)[0]) > 0 else p


def _uphill(problem: Problem, box: Box, p: FloatArray) -> FloatArray:
    """The side of box(1), for each parameter, towards which the worst root moves outwards."""
    steps = STEP * (box.up + box.down)
    rows = p + np.diag(steps)[steps > 0]
    with np.errstate(all="ignore"):
        slopes = np.zeros(len(p))
        slopes[steps > 0] = _instability(problem, rows, 0.0) - _instability(problem, p[None], 0.0)
    return np.where(slopes > 0, box.up, -box.down)


def _critical(problem: Problem, p: FloatArray, place: FloatArray) -> float | None:
    """The frequency of the worst root (rad/s), just beyond p when the loop has none at p (a mass of zero)."""
    for share in (1.0, 1 + 1e-9, 1 + 1e-6):
        try:
            found = problem.critical_frequency(place + share * (p - place))
        except (CheckError, np.linalg.LinAlgError, NotAnalytic):
            continue
        if np.isfinite(found):
            return found
    return None


def _instability(problem: Problem, rows: FloatArray, unknown: float) -> FloatArray:
    """The distance of the worst root beyond the boundary; `unknown` for all rows when one of them has no loop."""
    try:
        return np.asarray(problem.instability(rows))
    except (CheckError, np.linalg.LinAlgError, NotAnalytic):
        return np.full(len(rows), unknown)


def _along(problem: Problem, p: FloatArray, d: FloatArray, reach: float, proven: float = 0.0) -> float:
    """The first t of a grid up to `reach` at which p + t d is unstable, narrowed down; infinite for none.

    proven : t up to which the line is known to be stable
    """

    def rates(t: FloatArray) -> FloatArray:
        return _instability(problem, p + t[:, None] * d, -math.inf)

    if proven:
        grid = np.linspace(min(proven, reach), reach, 4)
    else:
        grid = np.unique(np.concatenate([np.geomspace(1e-3, 1, 24) * reach, np.linspace(0, reach, 41)[1:]]))
    bad = rates(grid) >= 0
    if not bad.any():
        return math.inf
    k = int(bad.argmax())
    low, high = (float(grid[k - 1]) if k else 0.0), float(grid[k])
    width = NARROW * (high - low)

    def rate(t: float) -> float:
        nonlocal high
        found = float(rates(np.array([t]))[0])
        high = min(high, t) if found >= 0 else high
        return found if math.isfinite(found) else math.copysign(1.0, found)

    if is_late():
        return high
    from scipy import optimize  # which takes a while to read

    with suppress(ValueError):  # it is unstable at the lower end, too
        optimize.brentq(rate, low, high, xtol=width, maxiter=60, disp=False)
    return high
