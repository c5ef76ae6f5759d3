"""Starting positions from which bounded forces can bring an unstable linear model back to rest.

In a mode with the real pole lambda > 0 and the left eigenvector w, the coordinate s = w x obeys s' = lambda s + w B u
+ w d. It can be brought back if, and only if, s lies in the set of -integral of e^(-lambda t) (w B u + w d) dt over all
forces |u_i| <= limit_i. No controller returns from beyond: stable modes and rates of force only take away from it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError

if TYPE_CHECKING:
    from malta.model.linearize import LinearModel
    from malta.model.plant import FloatArray

SLOW = 1.0  # rad/s: slower modes count as stable


def recoverable(
    model: LinearModel, plane: tuple[str, str], load: FloatArray, directions: int = 360
) -> FloatArray:
    """The boundary of the recoverable starts at rest in the plane of two positions, directions x 2, SI.

    plane : names of two positions; the others are zero, and so are all rates
    load : rates of change of the states by a constant load, n

    For each direction c the furthest point of the convex set, reached by u_i = -limit_i sign(c e^(-lambda t) w B_i),
    which changes its sign once at most.

    Raises CheckError unless two real unstable modes, and only two, move the plane's positions.

        recoverable(model, ("x", "beta"), np.zeros(10))[:, 0].max()
    """
    names = [s.name for s in model.plant.design_states]
    columns = [names.index(name) for name in plane]
    poles, W = _unstable_modes(model.A, columns)
    if len(poles) != 2 or abs(poles[0] - poles[1]) < 1e-9 * poles[0]:
        raise CheckError(
            f"{model.plant.name}: {' and '.join(plane)} have {len(poles)} separate unstable modes"
        )
    limits = np.array(model.plant.actuator.force_limit)
    W /= (np.abs(W @ model.B) @ limits / poles)[:, None]  # the set reaches from -1 to 1 in both coordinates
    b = W @ model.B  # 2 x m
    angle = np.linspace(0, 2 * math.pi, directions, endpoint=False)
    furthest = np.array([_furthest(np.array([math.cos(a), math.sin(a)]), poles, b, limits) for a in angle])
    boundary: FloatArray = np.linalg.solve(W[:, columns], (furthest - (W @ load) / poles).T).T
    return boundary


def _unstable_modes(A: FloatArray, columns: list[int]) -> tuple[FloatArray, FloatArray]:
    """Poles and left eigenvectors (rows) of the unstable modes that positions of these columns move."""
    values, vectors = np.linalg.eig(A.T)
    chosen = (values.real > SLOW) & (np.abs(vectors[columns]).max(axis=0) > 1e-9)
    return values[chosen].real, vectors[:, chosen].real.T


def _furthest(c: FloatArray, poles: FloatArray, b: FloatArray, limits: FloatArray) -> FloatArray:
    """The point of the set that is furthest along c: 2."""
    point = np.zeros(2)
    for b_i, limit in zip(b.T, limits, strict=True):
        first, second = c * b_i
        sign = np.sign(first + second) or 1.0
        ratio = -first / second if second else 0.0
        switch = math.log(ratio) / (poles[0] - poles[1]) if ratio > 0 else math.inf
        left = np.exp(-poles * switch) if switch > 0 else np.zeros(2)  # what comes after the switch
        point += limit * sign * b_i / poles * (1 - 2 * left)
    return point


def reach(boundary: FloatArray, direction: tuple[float, float]) -> float:
    """How far a boundary is from the centre along a direction, in multiples of it; NaN where the ray misses it."""
    along, across = np.array(direction), np.array([-direction[1], direction[0]])
    after = np.roll(boundary, -1, axis=0)
    side, next_side = boundary @ across, after @ across
    with np.errstate(divide="ignore", invalid="ignore"):
        share = side / (side - next_side)
        found = ((boundary + share[:, None] * (after - boundary)) @ along) / (along @ along)
    crossed = (side * next_side <= 0) & (found > 0) & np.isfinite(found)
    return float(found[crossed].max()) if crossed.any() else math.nan
