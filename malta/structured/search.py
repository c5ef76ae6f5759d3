"""The search of a law for some models: stabilized first, then its goals, from several starts.

The smallest largest figure: sequential quadratic programs on peaks and their slopes, in a trust region.

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
from typing import NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.structured.goals import Goal, GoalFigure, stability
from malta.structured.loops import ClosedLoop, TunedPlant
from malta.synthesis.elements import CALLER
from malta.synthesis.structure import Structure
from malta.work import is_stopped

PENALTY = 30.0  # cost of a hard figure's excess over 1, in that of a soft one
RADIUS = 0.3  # of the first step, in x
MAX_RADIUS = 1.0
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
class DescentLimits:
    """How long a search goes on.

    steps : at most
    enough : largest hard figure at which a search without soft figures ends
    least : relative decrease of the merit below which steps count as none
    """

    steps: int = 80
    enough: float = 0.0
    least: float = 1e-5


Looker = Callable[["FloatArray"], "Look | None"]  # None: no figures, as of an unstable loop


def minimize(look: Looker, start: Look, bounds: FloatArray, effort: DescentLimits) -> Look:
    """Search from a place with figures to a local minimum of the largest soft one."""
    here, radius, still = start, RADIUS, 0
    H: FloatArray = FIRST_CURVATURE * np.eye(len(start.x))
    for _ in range(effort.steps):
        if here.merit <= effort.enough or radius < 1e-7 or is_stopped():
            break
        found = _program(here, H, bounds, radius)
        if found is None:
            radius /= 4
            continue
        d, expected, weights = found
        if not expected > 1e-9 * max(1.0, here.merit):
            if radius >= MAX_RADIUS / 4:
                break
            radius, still = min(4 * radius, MAX_RADIUS), still + 1
            if still > 2:
                break
            continue
        there = look(np.clip(here.x + d, bounds[:, 0], bounds[:, 1]))
        gained = -math.inf if there is None else (here.merit - there.merit) / expected
        if there is not None:
            H = _update_curvature(H, d, here, there, weights)
        if there is None or gained < 0.1:
            radius = 0.4 * min(radius, float(np.abs(d).max()))
            if gained <= 1e-3 or there is None:
                continue
        elif gained > 0.7:
            radius = min(max(radius, 2 * float(np.abs(d).max())), MAX_RADIUS)
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


def _update_curvature(
    H: FloatArray, d: FloatArray, here: Look, there: Look, weights: FloatArray
) -> FloatArray:
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


def by_x(figures: Sequence[GoalFigure], slope: FloatArray, model: str, *, hard: bool) -> list[Slope]:
    """Figures with their derivatives by x. slope: of [D C; B A], column by column, by x."""
    return [
        Slope((model, f.goal, f.channel), f.w, f.value, f.slope.ravel(order="F") @ slope, hard)
        for f in figures
    ]


ROOM = 5e-3  # of hard bounds, and of the box of a margin: what a proof may need
MIN_DECAY_RATE = 1e-3  # of `rate`: how much poles have to decay
SPREAD = 1.0  # standard deviation of x of further starts
FIXED_POLE_TOLERANCE = 1e-7  # relative, within which a pole stays where it is


@dataclass(frozen=True, eq=False)
class Task:
    """What a law is searched for.

    structure : of the law
    goals : what it shall reach on every model with goals
    models : plants, some of which only have to be stable
    rate : 1/s, in which growth of poles is counted
    """

    structure: Structure
    goals: tuple[Goal, ...]
    models: tuple[TunedPlant, ...]
    rate: float

    def look(self, x: FloatArray) -> Look | None:
        """All figures at x; None where a model with goals is unstable."""
        found: list[Slope] = []
        try:
            theta, slope = self.structure.theta(x)
        except CheckError:  # weights of an LQG so far apart that nothing solves its equations
            return None
        for model in self.models:
            loop = ClosedLoop(model, theta)
            try:
                if model.goals and not loop.stable:
                    return None
            except (CheckError, np.linalg.LinAlgError):
                return None
            found += by_x(self._stable(loop), slope, model.name, hard=True)
            for goal in self.goals if model.goals else ():
                factor = 1 + ROOM if goal.hard else 1.0
                figures = [
                    f._replace(value=factor * f.value, slope=factor * f.slope) for f in goal.figures(loop)
                ]
                found += by_x(figures, slope, model.name, hard=goal.hard)
        return Look(x, tuple(found)) if all(math.isfinite(f.value) for f in found) else None

    def look_stable(self, x: FloatArray) -> Look | None:
        """The growth of all models alone, which a first search makes small."""
        found: list[Slope] = []
        try:
            theta, slope = self.structure.theta(x)
            for model in self.models:
                figures = self._stable(ClosedLoop(model, theta))
                found += by_x(figures, slope, model.name, hard=False)
        except (CheckError, np.linalg.LinAlgError):
            return None
        return Look(x, tuple(found)) if all(math.isfinite(f.value) for f in found) else None

    def _stable(self, loop: ClosedLoop) -> list[GoalFigure]:
        figures = [f._replace(value=f.value + MIN_DECAY_RATE) for f in stability(loop, self.rate)]
        top = max((f.value for f in figures), default=0.0)
        return [f for f in figures if f.value > min(top, 1.0) - 0.5]


def rate_of(model: TunedPlant) -> float:
    """A hundredth of the mean size of a model's poles, 1/s, or that of its unstable ones."""
    size = np.abs(np.linalg.eigvals(model.plane.A)) if len(model.plane.A) else np.zeros(0)
    size = size[size > 1e-6]
    return 0.03 * float(np.exp(np.log(size).mean())) if len(size) else 1.0


def search(task: Task, starts: Sequence[FloatArray]) -> Look:
    """The best law of several starts.

    Raises InputError for a structure that stabilizes the models from none of them, with a pole that no law of it moves
    where there is one; CheckError where the clock ended the search before.
    """
    bounds, best, slowest = task.structure.bounds, None, math.inf
    wanted = any(not goal.hard for goal in task.goals)
    for x in starts:
        first = task.look_stable(np.clip(x, bounds[:, 0], bounds[:, 1]))
        if first is None:
            continue
        stable = minimize(task.look_stable, first, bounds, DescentLimits(120, 1.0 - 1e-6))
        slowest = min(slowest, stable.merit)
        here = task.look(stable.x)
        if here is None:
            continue
        found = minimize(task.look, here, bounds, DescentLimits(enough=0.0 if wanted else 1e-12))
        if best is None or found.merit < best.merit:
            best = found
        if not wanted and best.hard <= 1:
            break
    if best is None and is_stopped():
        raise CheckError(f"{CALLER}: the time was up before a stable law was found")
    if best is None:
        raise InputError(CALLER, "law", _unstable(task, slowest), "a structure that stabilizes every model")
    return best


def _unstable(task: Task, slowest: float) -> str:
    """Why no law was found, in words."""
    fixed = fixed_pole(task)
    if fixed is not None:
        name, pole = fixed
        return f"one that cannot move the pole {pole:.4g} rad/s of {name}"
    return f"one whose slowest pole still grows by {task.rate * (slowest - 1):.3g} 1/s after a search"


def fixed_pole(task: Task) -> tuple[str, complex] | None:
    """A pole with Re >= 0 of a model that stays where it is whatever the law: a fixed mode of the structure."""
    rng = np.random.default_rng(0)
    for model in task.models:
        A = model.plane.A
        poles = [s for s in np.linalg.eigvals(A) if s.real >= 0] if len(A) else []
        for _ in range(3):
            theta, _ = task.structure.theta(rng.normal(size=len(task.structure.parameters)))
            closed = np.linalg.eigvals(ClosedLoop(model, theta).whole[0].A)
            poles = [s for s in poles if np.abs(closed - s).min() <= FIXED_POLE_TOLERANCE * max(abs(s), 1e-3)]
        if poles:
            return model.name, complex(poles[0])
    return None


def random_starts(structure: Structure, count: int, seed: int) -> list[FloatArray]:
    """The elements' own values, and others about them."""
    rng, n = np.random.default_rng(seed), len(structure.parameters)
    return [np.zeros(n), *(SPREAD * rng.normal(size=n) for _ in range(count - 1))]


def contradiction(look: Look) -> tuple[str, str] | None:
    """Two hard goals that hold each other, by the directions of their slopes; None where no bound is broken."""
    if look.hard <= 1:
        return None
    active = sorted(
        (f for f in look.figures if f.hard and f.value > look.hard * 0.98), key=lambda f: -f.value
    )
    first = active[0]
    against = min(active, key=lambda f: float(f.slope @ first.slope) / (np.linalg.norm(f.slope) or 1.0))

    def words(f: Slope) -> str:
        model, goal, channel = f.key
        return f"{goal}{f' of {channel}' * bool(channel)} ({f.value:.3g} of its bound on {model})"

    return words(first), words(against)
