"""A damped Newton method for many small systems of equations at once, with as many unknowns as a machine has inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

    Equations = Callable[[FloatArray], tuple[FloatArray, FloatArray]]  # rows v -> rows r(v), dr/dv

STEPS = 60
HALVINGS = 30
LEAST_DECREASE = 1e-4  # of what a step of its length promises
ROUNDING = 1e-14  # of the terms of a residual


class Solution(NamedTuple):
    """Rows of unknowns, and what is left of each row's equations where these are not solved; else zeros."""

    values: FloatArray
    left: FloatArray


def solve(
    equations: Equations, starts: Sequence[FloatArray], scales: FloatArray, still: float, share: float
) -> Solution:
    """Solve r(v) = 0 in each row, from the first of several starts that leads to a solution.

    Each step solves the linearized equations in the least-squares sense, with the smallest change of v / scales, and
    is halved until the residual falls. Where nothing is solved, the values are those of the smallest residual.

    still : a residual that is zero, unless the scales of v make all of it small
    share : the same, of the sum of |dr/dv| |v|
    """
    values = np.array(starts[0])
    residual = np.full(equations(values)[0].shape, np.nan)
    open_rows = np.ones(len(values), dtype=bool)
    smallest = np.full(len(values), np.inf)
    for start in starts:
        found, r, J = _descend(equations, start, scales, open_rows)
        sizes = _sizes(J, scales)
        with np.errstate(invalid="ignore"):
            room = np.maximum(
                share * (np.abs(J) @ np.abs(found)[..., None])[..., 0], np.minimum(still, 1e-6 * sizes)
            )
            room = np.where(sizes > 0, room, still)
            solved = (np.abs(r) <= room).all(axis=1) | (r == 0).all(axis=1)
        merit = np.where(np.isfinite(r).all(axis=1), np.abs(r).max(axis=1, initial=0.0), np.inf)
        better = open_rows & (solved | (merit < smallest) | np.isnan(residual).all(axis=1))
        values[better], residual[better], smallest[better] = found[better], r[better], merit[better]
        residual[open_rows & solved] = 0.0
        open_rows &= ~solved
        if not open_rows.any():
            break
    return Solution(values, residual)


def _sizes(J: FloatArray, scales: FloatArray) -> FloatArray:
    """How much each residual changes where each unknown changes by its scale; k x rows."""
    return np.asarray(np.abs(J) @ scales)


def _descend(
    equations: Equations, start: FloatArray, scales: FloatArray, rows: np.typing.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Newton's method for some rows from one start, until no step makes the residual smaller."""
    v = np.array(start)
    r, J = equations(v)
    active = rows & np.isfinite(r).all(axis=1) & r.any(axis=1)
    for _ in range(STEPS):
        sizes = _sizes(J, scales)
        active &= np.isfinite(sizes).all(axis=1)
        terms = (np.abs(J) @ np.maximum(np.abs(v), scales)[..., None])[..., 0]
        active &= (np.abs(r) > ROUNDING * np.where(np.isfinite(terms), terms, 0.0)).any(axis=1)
        if not active.any():
            break
        weights = np.zeros_like(sizes)
        steps = np.zeros_like(v)
        for k in np.flatnonzero(active):
            floor = np.maximum(sizes[k], 1e-13 * sizes[k].max(initial=0.0))
            weights[k] = np.divide(1.0, floor, out=np.zeros_like(floor), where=floor > 0)
            weights[k, sizes[k] == 0] = 0.0
            weighted = weights[k][:, None] * J[k] * scales
            steps[k] = scales * np.linalg.lstsq(weighted, weights[k] * r[k], rcond=None)[0]
        v, r, J, moved = _search(equations, (v, r, J), steps, weights, active)
        active &= moved & r.any(axis=1)
    return v, r, J


def _search(
    equations: Equations,
    at: tuple[FloatArray, FloatArray, FloatArray],
    steps: FloatArray,
    weights: FloatArray,
    active: np.typing.NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray, FloatArray, np.typing.NDArray[np.bool_]]:
    """Halve the step of each active row until its weighted residual falls; rows that cannot improve stay."""
    v, r, J = (np.array(part) for part in at)
    moved, before = np.zeros_like(active), np.linalg.norm(weights * r, axis=1)
    length = 1.0
    for _ in range(HALVINGS):
        trying = active & ~moved
        if not trying.any():
            break
        tried = np.where(trying[:, None], v - length * steps, v)
        r_new, J_new = equations(tried)
        with np.errstate(invalid="ignore"):
            after = np.linalg.norm(weights * np.where(np.isfinite(r_new), r_new, np.inf), axis=1)
            falls = trying & (after < (1 - LEAST_DECREASE * length) * before)
        v[falls], r[falls], J[falls] = tried[falls], r_new[falls], J_new[falls]
        moved |= falls
        length /= 2
    return v, r, J, moved
