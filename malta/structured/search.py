"""The search of a law for some models: stabilized first, then its goals, from several starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError, InputError
from malta.structured.goals import Figure, Goal, stability
from malta.structured.loops import ClosedLoop, Model
from malta.structured.minimax import Effort, Look, Slope, by_x, minimize
from malta.synthesis.elements import CALLER
from malta.synthesis.structure import Structure

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

ROOM = 5e-3  # of hard bounds, and of the box of a margin: what a proof may need
LEAST = 1e-3  # of `rate`: how much poles have to decay
SPREAD = 1.0  # standard deviation of x of further starts
FIXED = 1e-7  # relative, within which a pole stays where it is


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
    models: tuple[Model, ...]
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
                if model.goals and not loop.growth < 0:
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

    def _stable(self, loop: ClosedLoop) -> list[Figure]:
        figures = [f._replace(value=f.value + LEAST) for f in stability(loop, self.rate)]
        top = max((f.value for f in figures), default=0.0)
        return [f for f in figures if f.value > min(top, 1.0) - 0.5]


def rate_of(model: Model) -> float:
    """A hundredth of the mean size of a model's poles, 1/s, or that of its unstable ones."""
    size = np.abs(np.linalg.eigvals(model.plane.A)) if len(model.plane.A) else np.zeros(0)
    size = size[size > 1e-6]
    return 0.03 * float(np.exp(np.log(size).mean())) if len(size) else 1.0


def search(task: Task, starts: Sequence[FloatArray]) -> Look:
    """The best law of several starts.

    Raises InputError for a structure that stabilizes the models from none of them, with a pole that no law of it moves
    where there is one.
    """
    bounds, best, slowest = task.structure.bounds, None, math.inf
    wanted = any(not goal.hard for goal in task.goals)
    for x in starts:
        first = task.look_stable(np.clip(x, bounds[:, 0], bounds[:, 1]))
        if first is None:
            continue
        stable = minimize(task.look_stable, first, bounds, Effort(120, 1.0 - 1e-6))
        slowest = min(slowest, stable.merit)
        here = task.look(stable.x)
        if here is None:
            continue
        found = minimize(task.look, here, bounds, Effort(enough=0.0 if wanted else 1e-12))
        if best is None or found.merit < best.merit:
            best = found
        if not wanted and best.hard <= 1:
            break
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
            poles = [s for s in poles if np.abs(closed - s).min() <= FIXED * max(abs(s), 1e-3)]
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
