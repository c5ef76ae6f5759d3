"""Curves that can be pulled: which number of a design moves a figure, and the value that gives the figure asked for.

A handle stands on a curve of the page: the gain crossover of a sensor's loop, its phase margin there, the largest of
its |S|, of an output's error in the run, or of what a load moves. The numbers that may change are the sliders of the
page's first group, one at a time; for a phase margin two, so that the crossover stays. Each trial is a synthesis:

    find u within the sliders' ends so that  log f(u) = log asked        u: logarithm of one number; secant, halving

What is found is a design like any other; where the figure cannot be had, the nearest that was seen, and a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from malta.app.fields import PageField
from malta.app.files import DesignFiles, Edit, Value
from malta.app.picture import PictureSubject, View, crossovers, largest_moved, run_document, solve
from malta.errors import CheckError, InputError

KINDS = {
    "crossover": "crossover of the loop",
    "phase": "phase margin",
    "peak": "largest |S|",
    "load": "largest answer to the load",
    "run": "largest error of the run",
}
NUDGE = 0.08  # of a logarithm: the step by which numbers are compared
LEAST_SLOPE = 0.02  # of logarithms, below which a number does not move a figure
TRIALS = 8  # of one pull, after the numbers were compared
GOAL_TOLERANCE = 5e-3  # of a figure that was asked for


class Handle(NamedTuple):
    """Where a curve is pulled: one of KINDS, and the signal of its curve."""

    kind: str
    signal: str


@dataclass(frozen=True)
class Pull:
    """A design that is pulled at a handle, and what is looked at beside it."""

    files: DesignFiles
    edit: Edit
    view: View
    handle: Handle

    @property
    def numbers(self) -> list[PageField]:
        """The numbers that may change: one field for each slider of the first group that has ends."""
        named = {f.tuning: f for f in self.files.fields.values() if f.tuning}
        return [f for f in named.values() if f.kind == "log" and self.value_of(f) > 0]

    def value_of(self, field: PageField) -> float:
        """The value that the design has."""
        return float(self.edit.values.get(field.key, field.value))

    def values(self, chosen: Mapping[str, float]) -> dict[str, Value]:
        """The values of the design with other logarithms of some numbers, by the key of their field."""
        fields, values = self.files.fields, dict(self.edit.values)
        for key, logarithm in chosen.items():
            for linked in fields[key].linked:
                factor = fields[linked].factor / fields[key].factor
                values[linked] = float(f"{math.exp(logarithm) * factor:.5g}")
        return values

    def figure(self, chosen: Mapping[str, float]) -> tuple[float, ...] | None:
        """Logarithms of the handle's figure, and of the crossover where that is kept; None for an unstable loop."""
        try:
            edit = self.files.edit(self.values(chosen), redesign=self.edit.redesign)
            problem = solve(self.files.apply(edit))
            if not problem.loop.stable:
                return None
            found = figures_of(problem, self.view, self.handle)
        except (InputError, CheckError):
            return None
        return tuple(math.log(max(one, 1e-300)) for one in found)


def figures_of(problem: PictureSubject, view: View, handle: Handle) -> tuple[float, ...]:
    """The figure at a handle of a stable design, SI; of a phase margin the crossover beside it.

    Raises InputError for a handle that the design does not have.
    """
    kind, signals = handle.kind, [s.name for s in problem.plant.outputs]
    if kind not in KINDS or handle.signal not in signals:
        raise InputError(
            "malta app", "handle", f"{kind!r} of {handle.signal!r}", "one of a curve of the page"
        )
    k, found = signals.index(handle.signal), None
    if kind in ("crossover", "phase"):
        found = crossovers(problem.curves)[k]
        figures = () if found is None else (found[0],) if kind == "crossover" else (found[1], found[0])
    elif kind == "peak":
        figures = (float(np.abs(problem.curves.responses.S[:, k, k]).max()),)
    elif kind == "load":
        largest = largest_moved(problem, view)
        figures = () if largest is None else (float(largest[k]),)
    else:
        run = run_document(problem, view)
        figures = () if run is None else (float(np.abs(np.array(run["p"][k]) - run["reference"][k]).max()),)
    if not figures:
        raise InputError(
            "malta app", "handle", f"no {KINDS[kind]} of {handle.signal}", "one that can be pulled"
        )
    return figures


def compare_numbers(pull: Pull) -> dict[str, tuple[float, ...]]:
    """Slopes of the figures' logarithms by the key of each number; none of numbers that do nothing or lose stability.

    Raises InputError where the design is unstable, or does not have the handle.
    """
    problem = solve(pull.files.apply(pull.edit))
    if not problem.loop.stable:
        raise InputError("malta app", "handle", "an unstable loop", "a stable one: its curves can be pulled")
    here = np.log(np.maximum(figures_of(problem, pull.view, pull.handle), 1e-300))
    slopes = {}
    for field in pull.numbers:
        u = math.log(pull.value_of(field))
        step = NUDGE if u + NUDGE <= math.log(field.high) else -NUDGE
        there = pull.figure({field.key: u + step})
        if there is not None:
            slopes[field.key] = tuple(float(d) for d in (np.array(there) - here) / step)
    return slopes


def choose_numbers(slopes: Mapping[str, tuple[float, ...]]) -> tuple[str, ...]:
    """The number that moves one figure most; of two figures the two numbers that move them most independently.

    >>> choose_numbers({"a": (0.1,), "b": (-2.0,)})
    ('b',)
    >>> choose_numbers({"a": (1.0, 1.0), "b": (1.0, 1.1), "c": (0.5, -1.0)})
    ('b', 'c')
    """
    count = max(map(len, slopes.values()), default=1)
    best, keys = LEAST_SLOPE**count, list(slopes)
    chosen: tuple[str, ...] = ()
    for group in (
        [(a,) for a in keys] if count == 1 else [(a, b) for i, a in enumerate(keys) for b in keys[i + 1 :]]
    ):
        size = abs(float(np.linalg.det(np.array([slopes[key] for key in group]))))
        if size > best:
            best, chosen = size, group
    return chosen


def pull_to(pull: Pull, asked: float, slopes: Mapping[str, tuple[float, ...]]) -> dict[str, Any]:
    """The values with which the figure at the handle is what was asked, or nearest to it, in at most TRIALS trials.

    asked : SI
    slopes : of `compare_numbers`, of this design or of one near it

    Raises InputError where no number moves the figure.
    """
    chosen = choose_numbers(slopes)
    words = KINDS.get(pull.handle.kind, "")
    if not chosen:
        found = f"no slider that moves the {words} of {pull.handle.signal}"
        raise InputError("malta app", "handle", found, "a number of the design that does")
    fields = [pull.files.fields[key] for key in chosen]
    ends = np.log([[f.low for f in fields], [f.high for f in fields]])
    start = np.log([pull.value_of(f) for f in fields])
    ends = np.array([np.minimum(ends[0], start), np.maximum(ends[1], start)])

    def look(u: Any) -> tuple[float, ...] | None:
        return pull.figure(dict(zip(chosen, u.tolist(), strict=True)))

    J = np.array([slopes[key] for key in chosen]).T
    u, logarithm = _solve(look, start, math.log(asked), J, ends)
    at_end = [
        f.tuning for f, x, low, high in zip(fields, u, *ends, strict=True) if min(x - low, high - x) < 1e-9
    ]
    values = pull.values(dict(zip(chosen, u.tolist(), strict=True)))
    return {
        "values": values, "asked": asked, "found": math.exp(logarithm),
        "reached": abs(logarithm - math.log(asked)) <= 4 * GOAL_TOLERANCE,
        "numbers": [f.tuning for f in fields], "at_end": at_end,
        "what": f"{words} of {pull.handle.signal}",
    }  # fmt: skip


Look = Callable[[Any], "tuple[float, ...] | None"]


def _solve(look: Look, start: Any, asked: float, J: Any, ends: Any) -> tuple[Any, float]:
    """Newton with Broyden's slopes within ends, from a start; a step into an unstable loop, or away, is halved.

    Returns the place that was nearest, and the logarithm of its figure.
    """
    first = look(start)
    if first is None:
        raise InputError("malta app", "handle", "an unstable loop", "a stable one: its curves can be pulled")
    here, at = start, np.array(first)
    target = np.array([asked, *first[1:]])
    radius = 1.0
    for _ in range(TRIALS):
        if abs(at - target).max() <= GOAL_TOLERANCE:
            break
        step = np.linalg.lstsq(J, target - at, rcond=1e-3)[0]
        step *= min(1.0, radius / max(float(np.abs(step).max()), 1e-300))
        there = np.clip(here + step, *ends)
        moved = there - here
        if np.abs(moved).max() < 1e-6:
            break
        seen = look(there)
        if seen is None:
            radius = 0.4 * float(np.abs(moved).max())
            continue
        change = np.array(seen) - at
        J = J + np.outer(change - J @ moved, moved) / float(moved @ moved)
        if np.abs(np.array(seen) - target).max() < np.abs(at - target).max():
            here, at = there, np.array(seen)
        else:
            radius = 0.4 * float(np.abs(moved).max())
    return here, float(at[0])
