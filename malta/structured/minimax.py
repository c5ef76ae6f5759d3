"""The smallest largest figure: sequential quadratic programs on peaks and their slopes, in a trust region.

    min over x  max of soft figures   where hard figures <= 1,  low <= x <= high

Figures are maxima over frequencies, channels and models: not smooth where two are as large. Each program knows all
local peaks that come near, not only the largest, so that it steps along their edge, as the bundle methods of Apkarian
and Noll do:

    min over d, t, q   t + PENALTY q + d' H d / 2,   f_i + g_i d <= t,   h_j + g_j d <= 1 + q,   |d| <= radius,   q >= 0

H follows the curvature of the figures weighted by their multipliers (Powell's damped BFGS).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from malta.structured.goals import Figure

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

PENALTY = 30.0  # cost of a hard figure's excess over 1, in that of a soft one
RADIUS = 0.3  # of the first step, in x
LARGEST = 1.0
FIRST_CURVATURE = 0.1
SAME_PEAK = 0.3  # of ln w: peaks that are closer are one peak that moved
WIDTH = 0.5  # figures that are smaller than the largest by this share are left out of a program


class Slope(NamedTuple):
    """A figure of one model, and its derivative by x."""

    key: tuple[str, ...]  # model, goal, channel
    w: float
    value: float
    slope: FloatArray
    hard: bool


class Look(NamedTuple):
    """What is known at x: the figures, the largest soft and the largest hard one."""

    x: FloatArray
    figures: tuple[Slope, ...]

    @property
    def soft(self) -> float:
        return max((f.value for f in self.figures if not f.hard), default=0.0)

    @property
    def hard(self) -> float:
        return max((f.value for f in self.figures if f.hard), default=0.0)

    @property
    def merit(self) -> float:
        return self.soft + PENALTY * max(0.0, self.hard - 1)


@dataclass(frozen=True)
class Effort:
    """How long a search goes on.

    steps : at most
    enough : largest hard figure at which a search without soft figures ends
    least : relative decrease of the merit below which steps count as none
    """

    steps: int = 80
    enough: float = 0.0
    least: float = 1e-5


Looker = Callable[["FloatArray"], "Look | None"]  # None: no figures, as of an unstable loop


def minimize(look: Looker, start: Look, bounds: FloatArray, effort: Effort) -> Look:
    """Search from a place with figures to a local minimum of the largest soft one."""
    here, radius, still = start, RADIUS, 0
    H: FloatArray = FIRST_CURVATURE * np.eye(len(start.x))
    for _ in range(effort.steps):
        if here.merit <= effort.enough or radius < 1e-7:
            break
        found = _program(here, H, bounds, radius)
        if found is None:
            radius /= 4
            continue
        d, expected, weights = found
        if not expected > 1e-9 * max(1.0, here.merit):
            if radius >= LARGEST / 4:
                break
            radius, still = min(4 * radius, LARGEST), still + 1
            if still > 2:
                break
            continue
        there = look(np.clip(here.x + d, bounds[:, 0], bounds[:, 1]))
        gained = -math.inf if there is None else (here.merit - there.merit) / expected
        if there is not None:
            H = _curved(H, d, here, there, weights)
        if there is None or gained < 0.1:
            radius = 0.4 * min(radius, float(np.abs(d).max()))
            if gained <= 1e-3 or there is None:
                continue
        elif gained > 0.7:
            radius = min(max(radius, 2 * float(np.abs(d).max())), LARGEST)
        still = still + 1 if here.merit - there.merit < effort.least * max(1.0, here.merit) else 0
        here = there
        if still > 3:
            break
    return here


def _program(
    here: Look, H: FloatArray, bounds: FloatArray, radius: float
) -> tuple[FloatArray, float, FloatArray] | None:
    """The step of a quadratic program, the decrease that it expects, and the multipliers of all figures."""
    n = len(here.x)
    soft_top, hard_top = here.soft, max(here.hard, 1.0)
    used = [
        k for k, f in enumerate(here.figures)
        if f.value >= ((hard_top if f.hard else soft_top) * (1 - WIDTH))
    ]  # fmt: skip
    figures = [here.figures[k] for k in used]
    hard = np.array([f.hard for f in figures])
    value = np.array([f.value for f in figures])
    G = np.array([f.slope for f in figures]).reshape(len(figures), n)
    A = np.hstack([G, -(~hard)[:, None].astype(float), -hard[:, None].astype(float)])
    most = np.where(hard, 1 - value, soft_top - value)  # t is counted from the largest soft figure
    low = np.concatenate([np.maximum(-radius, bounds[:, 0] - here.x), [-1e3, 0.0]])
    high = np.concatenate([np.minimum(radius, bounds[:, 1] - here.x), [1e3, 1e6]])
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n] = H
    cost = np.concatenate([np.zeros(n), [1.0 if (~hard).any() else 0.0, PENALTY]])
    if not (~hard).any():
        low[n] = high[n] = 0.0
    solver = _solver(n + 2, len(figures))
    try:
        out = solver(h=whole, g=cost, a=A, lba=-math.inf, uba=most, lbx=low, ubx=high)
    except RuntimeError:
        return None
    step = np.array(out["x"]).ravel()
    if not np.isfinite(step).all():
        return None
    d = step[:n]
    weights = np.zeros(len(here.figures))
    weights[used] = np.abs(np.array(out["lam_a"]).ravel())
    linear = value + G @ d
    after = max((v for v, h in zip(linear, hard, strict=True) if not h), default=0.0)
    excess = max((v for v, h in zip(linear, hard, strict=True) if h), default=0.0)
    return d, here.merit - (after + PENALTY * max(0.0, excess - 1)), weights


_SOLVERS: dict[tuple[int, int], ca.Function] = {}


def _solver(n: int, rows: int) -> ca.Function:
    if (n, rows) not in _SOLVERS:
        shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
        quiet = {"print_iter": False, "print_header": False, "print_info": False}
        _SOLVERS[n, rows] = ca.conic("program", "ipqp", shapes, quiet)  # CasADi's own interior points
    return _SOLVERS[n, rows]


def _curved(H: FloatArray, d: FloatArray, here: Look, there: Look, weights: FloatArray) -> FloatArray:
    """H with the curvature along d of the figures that bound the program."""
    change = np.zeros(len(d))
    for f, weight in zip(here.figures, weights, strict=True):
        if weight < 1e-9:
            continue
        same = [g for g in there.figures if g.key == f.key and _near(f.w, g.w)]
        if not same:
            return H
        match = min(same, key=lambda g: abs(g.value - f.value - f.slope @ d))
        change += weight * (match.slope - f.slope)
    Hd = H @ d
    size, bent = float(d @ Hd), float(d @ change)
    if not size > 0:
        return H
    if bent < 0.2 * size:
        share = 0.8 * size / (size - bent)
        change = share * change + (1 - share) * Hd
        bent = float(d @ change)
    new = H - np.outer(Hd, Hd) / size + np.outer(change, change) / bent
    return np.asarray((new + new.T) / 2) if np.linalg.norm(new) < 1e6 else FIRST_CURVATURE * np.eye(len(d))


def _near(a: float, b: float) -> bool:
    if not (0 < a < math.inf and 0 < b < math.inf):
        return True
    return abs(math.log(a / b)) < SAME_PEAK


def by_x(figures: Sequence[Figure], slope: FloatArray, model: str, *, hard: bool) -> list[Slope]:
    """Figures with their derivatives by x. slope: of [D C; B A], column by column, by x."""
    return [
        Slope((model, f.goal, f.channel), f.w, f.value, f.slope.ravel(order="F") @ slope, hard)
        for f in figures
    ]
