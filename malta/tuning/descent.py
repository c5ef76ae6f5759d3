"""Descent by linear programs: the smallest worst ratio, or the least noise that bounds allow.

    minimize  f(u) + steep max(floor, max_i r_i(u))        over the unit cube

r_i are logarithms of the ratios of what is found to what is asked for, so 0 is a bound that is just reached. The
worst of them is as smooth as a roof: it has an edge where the best place is, which simplices and random members
only stumble on. Each step linearizes f and every r_i by differences and solves

    minimize  f' d + steep s      subject to  r_i + r_i' d <= s,  s >= floor,  |d_k| <= radius

The radius follows how well the last step was foretold.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize

from malta.arrays import FloatArray
from malta.work import is_stopped

DIFFERENCES = (0.02, 0.06, 0.007)  # steps of u, the next where one leads no further
TRIES = 5  # smaller radii with one linearization
MIN_RADIUS, MAX_RADIUS, FIRST_RADIUS = 2e-3, 0.5, 0.2  # of the radius
LEAST_GAIN = 1e-6  # of a step

Look = Callable[["FloatArray"], tuple[float, "FloatArray"] | None]  # (f, r) of a place; None: unstable


class Point(NamedTuple):
    """A place that was tried: f, and r of fixed length."""

    u: FloatArray
    f: float
    r: FloatArray


class BoundPenalty(NamedTuple):
    """How bounds count beside the objective."""

    steep: float = 1.0
    floor: float = -math.inf  # of the worst r, below which it counts no more

    def of(self, point: Point) -> float:
        """Return what is minimized at a point."""
        return point.f + self.steep * max(self.floor, float(point.r.max()))


def descend(look: Look, u: FloatArray, merit: BoundPenalty, trials: int) -> FloatArray:
    """Go down from a place until a number of trials or until no step leads further; an unstable place stays.

    Where the clock ends the search, the last step is where it ends.

    >>> import numpy as np
    >>> roof = lambda u: (0.0, np.array([u[0] - u[1], u[1] - 0.5, 0.3 - u[0]]))
    >>> bool(
    ...     np.allclose(
    ...         descend(roof, np.array([0.9, 0.1]), Merit(), 200),
    ...         [0.3667, 0.4333],
    ...         atol=1e-3,
    ...     )
    ... )
    True
    """
    start = look(u) if len(u) and trials > 0 and not is_stopped() else None
    if start is None:
        return u
    here, radius, stuck, used = Point(u, *start), FIRST_RADIUS, 0, 1
    while used < trials and stuck < len(DIFFERENCES) and not is_stopped():
        slopes = _slopes(look, here, DIFFERENCES[stuck])
        there, radius, tries = _advance(look, here, slopes, merit, radius)
        used += len(u) + tries
        here = there or here
        if radius < MIN_RADIUS:
            stuck, radius = stuck + 1, FIRST_RADIUS / 2
    return here.u


def _advance(
    look: Look, here: Point, slopes: tuple[FloatArray, FloatArray], merit: BoundPenalty, radius: float
) -> tuple[Point | None, float, int]:
    """The next place, or None, the next radius, and how many places were tried."""
    for tries in range(1, TRIES + 1):
        d, foretold = _step(here, slopes, merit, radius)
        found = look(here.u + d)
        there = None if found is None else Point(here.u + d, *found)
        gain = 0.0 if there is None else merit.of(here) - merit.of(there)
        if gain > LEAST_GAIN:
            share = gain / max(merit.of(here) - foretold, 1e-12)
            if share > 0.7:
                return there, min(radius * 1.5, MAX_RADIUS), tries
            return there, radius * (1.0 if share > 0.3 else 0.6), tries
        radius *= 0.4
        if radius < MIN_RADIUS:
            break
    return None, radius, tries


def _slopes(look: Look, here: Point, step: float) -> tuple[FloatArray, FloatArray]:
    """f' and r' by differences, towards the inside of the cube; zero along what makes the loop unstable."""
    slope, J = np.zeros(len(here.u)), np.zeros((len(here.r), len(here.u)))
    for k in range(len(here.u)):
        h = step if here.u[k] + step <= 1 else -step
        there = look(here.u + h * np.eye(len(here.u))[k])
        if there is not None:
            slope[k], J[:, k] = (there[0] - here.f) / h, (there[1] - here.r) / h
    return slope, J


def _step(
    here: Point, slopes: tuple[FloatArray, FloatArray], merit: BoundPenalty, radius: float
) -> tuple[FloatArray, float]:
    """The step of the linear program, and what it promises."""
    slope, J = slopes
    low, high = np.maximum(-radius, -here.u), np.minimum(radius, 1 - here.u)
    floor = None if math.isinf(merit.floor) else merit.floor
    found = optimize.linprog(
        np.append(slope, merit.steep),
        A_ub=np.hstack([J, -np.ones((len(J), 1))]),
        b_ub=-here.r,
        bounds=[*zip(low.tolist(), high.tolist(), strict=True), (floor, None)],
    )
    if found.x is None or found.fun is None:
        return np.zeros(len(here.u)), merit.of(here)
    return np.asarray(found.x[:-1]), here.f + float(found.fun)
