"""Boxes of parameters: ranges that grow with the margin t, and intervals that do not.

What is claimed of a box is about the numbers that were asked for, so that its ends are rounded outwards, from exact
rationals. Rounding outwards crosses neither zero nor a limit, which are doubles themselves.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from malta.arguments import MAX_SIZE, by_name, describe, is_number, is_pair
from malta.arrays import FloatArray
from malta.errors import InputError, require_known
from malta.linear.branches import INTERVALS, Interval
from malta.linear.expressions import MatrixProgram, NotAnalytic, exact, program
from malta.linear.uncertain import DOMAIN_END_TEXT, UncertainSystem

SEARCH_LIMIT = 1e2  # search limit, in multiples of the modelled box
MOST_PLACES = 256  # nominal places of intervals that do not grow
EDGE = 1e-4  # relative distance of the search from the limits of parameters


def smallest_t(p: FloatArray, nominal: FloatArray, down: FloatArray, up: FloatArray) -> FloatArray:
    """The smallest t with nominal - t down <= p <= nominal + t up on the axes that grow: ... x P -> ..."""
    moved = p - nominal
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(moved > 0, moved / up, np.where(moved < 0, -moved / down, 0))
    return np.asarray(np.where(down + up > 0, t, 0).max(axis=-1, initial=0.0))


@dataclass(frozen=True, eq=False)
class Box:
    """Nominal values, how far each parameter moves down and up per unit of t, and intervals that do not grow."""

    names: tuple[str, ...]
    nominal: FloatArray
    down: FloatArray  # at least what was asked for, by less than a digit
    up: FloatArray
    over: FloatArray  # P x 2, ends of the intervals that do not grow; nominal values of the other parameters
    most: float  # t at which a parameter reaches its limit
    ends: str = ""  # what happens at `most`

    @property
    def limit(self) -> float:
        """The largest t that a search tries: close to the limit of a parameter, SEARCH_LIMIT at most."""
        return min(self.most * (1 - EDGE), SEARCH_LIMIT)

    @property
    def searched(self) -> str:
        """How far a search goes, in words."""
        if self.most * (1 - EDGE) > SEARCH_LIMIT:
            return f"up to t = {SEARCH_LIMIT:g}"
        return f"up to t = {self.most:.4g}, where {self.ends}"

    def margin(self, p: FloatArray) -> FloatArray:
        """The smallest t with p in box(t): ... -> ..."""
        return smallest_t(p, self.nominal, self.down, self.up)

    def sides(self, t: float) -> FloatArray:
        """The ends (low, high) of every parameter in box(t), rounded outwards: P x 2, for proofs."""
        rows, t = zip(self.nominal.tolist(), self.down.tolist(), self.up.tolist(), strict=True), exact(t)
        grown = [
            (below(exact(c) - t * exact(down)), -below(-exact(c) - t * exact(up))) for c, down, up in rows
        ]
        return np.where((self.down + self.up > 0)[:, None], np.array(grown).reshape(-1, 2), self.over)

    def near_sides(self, t: float) -> FloatArray:
        """The sides of box(t) to a digit, for the search of a witness: plain numbers stay plain."""
        grown = np.column_stack([self.nominal - t * self.down, self.nominal + t * self.up])
        return np.where((self.down + self.up > 0)[:, None], grown, self.over)

    def nominal_places(self) -> FloatArray:
        """The nominal values at the ends and the middle of the intervals that do not grow; rows, nominal first."""
        sides = [
            np.unique([c, low, (low + high) / 2, high])
            for c, (low, high) in zip(self.nominal, self.over, strict=True)
        ]
        if math.prod(map(len, sides)) > MOST_PLACES:
            sides = [side[[0, -1]] if len(side) > 1 else side for side in sides]
        rows = itertools.islice(itertools.product(*sides), MOST_PLACES)
        places = np.unique([tuple(self.nominal.tolist()), *rows], axis=0)
        order = np.argsort(np.abs(places - self.nominal).sum(axis=1), kind="stable")
        return np.asarray(places[order])

    def stretch(self, p: FloatArray, share: float) -> FloatArray:
        """The parameters p with `share` times their deviation on the axes that grow."""
        return np.where(self.down + self.up > 0, self.nominal + share * (p - self.nominal), p)


def box_of(
    names: tuple[str, ...],
    at: FloatArray,
    limits: Sequence[tuple[float, float]],
    ranges: Mapping[str, float | tuple[float, float] | list[float]],
    over: Mapping[str, tuple[float, float]],
    *,
    empty: bool = False,
    caller: str = "robust_margin",
) -> Box:
    """The box of ranges that grow with t and of intervals `over` that do not, about the nominal values `at`.

    empty : whether `ranges` may be empty
    caller : the function that an error names

    Raises InputError for unknown names and invalid ranges.
    """
    by_name(caller, "ranges", ranges, '{"k": 0.2} or {"k": (1, 2)}')
    by_name(caller, "over", over, '{"k": (1, 2)}')
    k = len(names)
    down, up, fixed = np.zeros(k), np.zeros(k), np.column_stack([at, at])
    most, ends = math.inf, ""
    for name, value in (*ranges.items(), *over.items()):
        require_known([name], names, caller, found="an unknown parameter")
        if name in ranges and name in over:
            raise InputError(caller, name, "in ranges and in over", "in one of them")
        i = names.index(name)
        nominal = float(at[i])
        if nominal == 0 and name in ranges and is_number(value) and value != 0:
            found = f"a share of {value:g} of its value, which is 0"
            raise InputError(caller, name, found, "an interval, as (-0.1, 0.1)")
        pair = _checked_sides(caller, name, value, nominal)
        low, high = limits[i] if limits else (-math.inf, math.inf)
        if not low < nominal < high or (name in over and not low < pair[0] < pair[1] < high):
            raise InputError(caller, name, f"{pair}", f"values within its limits ({low:g}, {high:g})")
        if name in over:
            fixed[i] = pair
            continue
        down[i], up[i] = (-below(-away) for away in rates_of(nominal, value))
        for limit, rate in ((low, down[i]), (high, up[i])):
            if rate > 0 and abs(limit - nominal) / rate < most:
                # the limit of what may be zero is the double below
                most, ends = (
                    abs(limit - nominal) / rate,
                    f"{name} reaches its limit {round(limit, 300) + 0.0:g}",
                )
    if not (down + up).any() and not empty:
        raise InputError(caller, "ranges", "no parameters", "at least one uncertain parameter")
    return Box(names, at, down, up, fixed, most, ends=ends)


def sides_of(nominal: float, value: float | Sequence[float]) -> tuple[Any, Any]:
    """The exact ends of a range about a nominal value: a share of that, or an interval (low, high), SI."""
    middle = exact(nominal)
    if not is_number(value):
        low, high = value  # type: ignore[misc]
        return exact(low), exact(high)
    width = abs(middle) * exact(value)
    return middle - width, middle + width


def rates_of(nominal: float, value: float | Sequence[float]) -> tuple[Any, Any]:
    """How far a range reaches below and above the nominal value, exactly."""
    low, high = sides_of(nominal, value)
    return exact(nominal) - low, high - exact(nominal)


def below(x: Any) -> float:
    """The largest double at or below an exact number."""
    found = int(x.p) / int(x.q)
    return found if exact(found) <= x else math.nextafter(found, -math.inf)


def _checked_sides(caller: str, name: str, value: Any, nominal: float) -> tuple[float, float]:
    """(low, high) of a range about the nominal value: a share of that, or an interval. Raises InputError."""
    low = high = math.nan
    if is_pair(value) and all(is_number(v) for v in value):
        low, high = (float(v) for v in value)
    elif is_number(value) and value >= 0:
        low, high = nominal - abs(nominal) * float(value), nominal + abs(nominal) * float(value)
    if not low <= nominal <= high:
        wanted = f"a share of 0 or more, or (low, high) about the nominal {nominal:g}"
        raise InputError(caller, name, describe(value), wanted)
    if max(-low, high) > MAX_SIZE:
        raise InputError(caller, name, describe(value), f"values between -{MAX_SIZE:g} and {MAX_SIZE:g}")
    return low, high


# The box of a model with branches, or of a machine that must have a rest, ends where its conditions
# (malta/linear/branches.py, malta/loops/rest.py) are no longer proven.


PARTS = 256  # parts of a box on which conditions are looked at
BISECTIONS = 30  # of the box in which they hold
# of where corners fail or poles are lost
SHARES_OF_END = (1.0, 0.999, 0.99, 0.97, 0.93, 0.85, 0.7, 0.5, 0.25, 0.1, 0.01)
NO_ONE_REST = "it is not proven that there is one rest"
BEYOND_LOSS = 1.01  # times the first loss that poles show, up to which a dear box is looked at
BEYOND_SHARE = 1e-3  # of a box: how far beyond its end a condition is looked for that fails there
MOST_CORNERS = 12  # parameters of whose corners all are looked at


def within_branches(
    box: Box, system: UncertainSystem, loss: Callable[[Box], float] = lambda _: math.inf
) -> Box:
    """The box, ended where the conditions of a model (`positive`, p -> values above zero) are no longer proven.

    loss : where poles show a loss in a box: roots of equations are not looked at much beyond it
    """
    if system.positive is None:
        return box
    conditions, limit = program(system.positive), box.limit

    def passes(t: float) -> bool:
        return _failing_corner(box, system, t) is None

    def hold(t: float) -> bool:
        return passes(t) and _hold(conditions, box.sides(t))

    if not conditions.implicit and hold(limit):
        return box
    if not hold(0.0):
        return replace(box, most=0.0, ends=_end_at(box, system, 0.0))
    if conditions.implicit:  # each look at roots of equations is dear
        last = limit if passes(limit) else last_passed(passes, 0.0, limit)
        near = min(last, BEYOND_LOSS * loss(replace(box, most=last)))
        low = next((t for share in SHARES_OF_END if hold(t := share * near)), 0.0)
        if low < near:
            return replace(box, most=low, ends=NO_ONE_REST)
    else:
        low = last_passed(hold, 0.0, limit)
    return replace(box, most=low, ends=_end_at(box, system, low))


def last_passed(test: Callable[[float], bool], low: float, high: float, steps: int = BISECTIONS) -> float:
    """The last number that passes a test on the way from `low`, which does, to `high`, which does not, by bisection."""
    for _ in range(steps):
        middle = (low + high) / 2
        low, high = (middle, high) if test(middle) else (low, middle)
    return low


def _end_at(box: Box, system: UncertainSystem, t: float) -> str:
    """What happens at the end t of a box, in words, with the parameters of the corner where it does."""
    failing = _failing_corner(box, system, t * (1 + BEYOND_SHARE))
    if failing is None or not system.ends or system.ends[failing[0]] == DOMAIN_END_TEXT:
        return DOMAIN_END_TEXT
    row, corner = failing
    grown = [f"{box.names[k]} = {corner[k]:.4g}" for k in np.flatnonzero(corner != box.nominal)]
    return f"{system.ends[row]} ({', '.join(grown)})" if grown else system.ends[row]


def _failing_corner(box: Box, system: UncertainSystem, t: float) -> tuple[int, FloatArray] | None:
    """A condition that fails at a corner of box(t), and this corner; None where none is found."""
    assert system.positive is not None
    moving = (box.down + box.up > 0) | (box.over[:, 0] < box.over[:, 1])
    used = np.isin(np.arange(len(box.names)), system.positive.jac_sparsity(0, 0).get_triplet()[1])
    moves = np.flatnonzero(moving & used)[:MOST_CORNERS]
    corners = np.repeat(box.nominal[None], 2 ** len(moves), axis=0)
    corners[:, moves] = list(itertools.product(*box.near_sides(t)[moves]))
    values = np.array(system.positive.map(len(corners))(corners.T))
    values = np.where(np.isfinite(values), values, -np.inf)
    if not (values <= 0).any():
        return None
    row = int((values <= 0).any(axis=1).argmax())
    return row, corners[int(values[row].argmin())]


def _hold(conditions: MatrixProgram, sides: FloatArray) -> bool:
    """Whether the conditions are proven on a box (P x 2), or on all its parts."""
    count = conditions.shapes[0][0]
    return every_part(
        conditions, sides, lambda values: len(values) == count and all(x.low > 0 for _, _, x in values)
    )


def every_part(
    conditions: MatrixProgram, sides: FloatArray, test: Callable[[list[tuple[int, int, Interval]]], bool]
) -> bool:
    """Whether a test of intervals of the conditions is passed on a box (P x 2), or on all parts of it.

    test : of (row, column, interval) of each condition that is not zero everywhere
    """
    todo, count = [sides], 0
    while todo:
        own = todo.pop()
        count += 1
        try:
            (values,) = conditions.run([Interval(a, b) for a, b in own.tolist()], INTERVALS)
            if test(values):
                continue
        except NotAnalytic:
            pass
        size = np.maximum(np.abs(own).max(axis=1), 1e-300)
        axis = int(((own[:, 1] - own[:, 0]) / size).argmax())
        middle = own[axis].mean()
        if count >= PARTS or not own[axis, 0] < middle < own[axis, 1]:
            return False
        for side in (0, 1):
            half = own.copy()
            half[axis, 1 - side] = middle
            todo.append(half)
    return True
