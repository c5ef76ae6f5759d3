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

import casadi as ca
import numpy as np
from flint import arb

from malta.arrays import FloatArray
from malta.errors import InputError, require_known
from malta.proof.expressions import KNOWN, POINTS, Arithmetic, NotAnalytic, Program, exact, program
from malta.proof.uncertain import LARGEST, by_name, describe, is_number, is_pair

FAR = 1e2  # search limit, in multiples of the modelled box
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
        """The largest t that a search tries: close to the limit of a parameter, FAR at most."""
        return min(self.most * (1 - EDGE), FAR)

    @property
    def searched(self) -> str:
        """How far a search goes, in words."""
        if self.most * (1 - EDGE) > FAR:
            return f"up to t = {FAR:g}"
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
        sides = (
            np.unique([c, low, (low + high) / 2, high])
            for c, (low, high) in zip(self.nominal, self.over, strict=True)
        )
        places = np.array(list(itertools.islice(itertools.product(*sides), 4096)))
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
    if max(-low, high) > LARGEST:
        raise InputError(caller, name, describe(value), f"values between -{LARGEST:g} and {LARGEST:g}")
    return low, high


# Branches of a model: which of them is active at the operating point, and a box on which they provably stay active.
#
# fmax(v, 0) is v as long as v > 0, fabs(x) is x, and sqrt(x)^2 is x. A model is written with the branches that are
# active at its nominal parameters, as expressions without branches; what has to stay above zero for that becomes a
# condition, and the box of parameters ends where the conditions are no longer proven. Derivatives are taken before,
# so that a branch of a derivative is resolved as well.


PARTS = 256  # parts of a box on which conditions are looked at
BISECTIONS = 30  # of the box in which they hold
ENDS = "a root or a branch of the model ends"
_OTHERS: dict[str, Any] = {name: getattr(ca, name) for name in KNOWN if hasattr(ca, name)}
SYMBOLS = Arithmetic(ca.SX, {**_OTHERS, "pow": ca.power})


class Interval:
    """Real numbers between two ends, rounded outwards: powers of positive ones stay positive, unlike those of balls."""

    __slots__ = ("high", "low")

    def __init__(self, low: float, high: float) -> None:
        if not -math.inf < low <= high < math.inf:
            raise NotAnalytic("numbers that overflow")
        self.low, self.high = low, high

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __add__(self, other: Interval) -> Interval:
        return _outward(self.low + other.low, self.high + other.high)

    def __sub__(self, other: Interval) -> Interval:
        return self + -other

    def __mul__(self, other: Interval) -> Interval:
        ends = [x * y for x in (self.low, self.high) for y in (other.low, other.high)]
        return _outward(min(ends), max(ends))

    def __rtruediv__(self, one: float) -> Interval:
        if self.low <= 0 <= self.high:
            raise NotAnalytic("a division by what may be zero")
        return _outward(one / self.high, one / self.low)

    def __truediv__(self, other: Interval) -> Interval:
        return self * (1.0 / other)

    def __pow__(self, k: int) -> Interval:
        found = Interval(1.0, 1.0)
        for _ in range(k):
            found = found * self
        return found


def _outward(low: float, high: float) -> Interval:
    return Interval(math.nextafter(low, -math.inf), math.nextafter(high, math.inf))


def _by_balls(function: Callable[..., Any]) -> Callable[..., Interval]:
    """A function of intervals by that of balls."""

    def found(*intervals: Interval) -> Interval:
        ball = function(*(arb(x.low).union(arb(x.high)) for x in intervals))
        return _outward(float(ball.lower()), float(ball.upper()))

    return found


INTERVALS = Arithmetic(lambda x: Interval(x, x), {name: _by_balls(f) for name, f in POINTS.others.items()})


class _Resolved:
    """The steps of a program so far, without branches, their values at nominal parameters, and what is above zero."""

    def __init__(self, nominal: Sequence[float]) -> None:
        self.nominal = nominal
        self.steps: list[tuple[str, int, tuple[int, ...], float]] = []
        self.values: list[Any] = []  # None: not known
        self.positive: list[int] = []

    def add(self, name: str, target: int, operands: tuple[int, ...], value: float) -> int:
        self.steps.append((name, target, operands, value))
        self.values.append(self._value(name, target, [self.values[k] for k in operands], value))
        return len(self.steps) - 1

    def _value(self, name: str, target: int, operands: list[Any], value: float) -> Any:
        if name == "input":
            return arb(self.nominal[target])
        if name == "const":
            return arb(value)
        try:
            return None if any(x is None for x in operands) else POINTS.apply(name, operands, value)
        except NotAnalytic:
            return None

    def constant(self, x: float) -> int:
        return self.add("const", 0, (), x)

    def sign(self, k: int) -> int:
        """1 or -1, the sign that a step has and is assumed to keep; 0 where it is not known."""
        x = self.values[k]
        if x is None or not (x > 0 or x < 0):
            return 0
        if self.steps[k][0] != "const":
            self.positive.append(k if x > 0 else self.add("neg", 0, (k,), 0.0))
        return 1 if x > 0 else -1

    def resolved(self, name: str, operands: tuple[int, ...]) -> int | None:
        """The step that stands for an operation with branches; None for any other, or where the branch is not known."""
        if name in ("fmax", "fmin", "lt", "le"):
            one, two = operands
            sign = self.sign(self.add("sub", 0, operands, 0.0))
            if not sign:
                return None
            if name in ("lt", "le"):
                return self.constant(float(sign < 0))
            return one if (sign > 0) == (name == "fmax") else two
        if name in ("fabs", "sign"):
            sign = self.sign(operands[0])
            if not sign or (name == "fabs" and sign > 0):
                return operands[0] if sign else None
            return self.constant(float(sign)) if name == "sign" else self.add("neg", 0, operands, 0.0)
        known = [self.steps[k][3] if self.steps[k][0] == "const" else None for k in operands]
        if name == "if_else_zero" and known[0] is not None:
            return operands[1] if known[0] else self.constant(0.0)
        if name in ("not", "and", "or") and None not in known:
            return self.constant(float({"not": lambda x: not x[0], "and": all, "or": any}[name](known)))
        return None


def resolve_branches(model: Program, nominal: Sequence[float]) -> tuple[Program, int]:
    """The program with the branches that are active at nominal parameters, and how many conditions these have.

    A last matrix of one column is added: first the conditions, which are above zero where the programs agree, then the
    arguments of all roots, which are above zero where sqrt(x)^2 is x.
    """
    found, place = _Resolved(nominal), list[int]()
    roots: dict[int, int] = {}
    for name, target, operands, value in model.steps:
        own = tuple(place[k] for k in operands)
        step = found.resolved(name, own)
        step = found.add(name, target, own, value) if step is None else step
        if name == "sqrt":
            roots[step] = own[0]
        place.append(step)
    positive = list(dict.fromkeys(found.positive))
    last = [*positive, *roots.values()]
    entries = tuple(tuple((i, j, place[k]) for i, j, k in matrix) for matrix in model.entries)
    column = tuple((i, 0, k) for i, k in enumerate(last))
    made = Program(tuple(found.steps), (*entries, column), (*model.shapes, (len(last), 1)), model.inputs)
    return made, len(positive)


def without_branches(
    function: ca.Function, nominal: Sequence[float]
) -> tuple[ca.Function, ca.Function | None]:
    """The function with the branches that are active at nominal parameters, and their conditions (p -> above zero).

    The function itself, without conditions, where it has no branches, or some that are not known.
    """
    model = program(function)
    if not model.foreign:
        return function, None
    resolved, count = resolve_branches(model, nominal)
    p = ca.SX.sym("p", model.inputs)
    try:
        *entries, above = resolved.run(ca.vertsplit(p), SYMBOLS)
    except NotAnalytic:
        return function, None
    matrices = [ca.SX(*shape) for shape in model.shapes]
    for matrix, own in zip(matrices, entries, strict=True):
        for i, j, x in own:
            matrix[i, j] = x
    positive = ca.vertcat(*(x for i, _, x in above if i < count))
    return ca.Function("matrices", [p], matrices), ca.Function("positive", [p], [positive]) if count else None


def within_branches(box: Box, positive: ca.Function | None) -> Box:
    """The box, ended where the conditions of a model (p -> values above zero) are no longer proven."""
    if positive is None:
        return box
    conditions, limit = program(positive), box.limit
    low, high = 0.0, limit
    if _hold(conditions, box.sides(high)):
        return box
    if not _hold(conditions, box.sides(0.0)):
        return replace(box, most=0.0, ends=ENDS)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if _hold(conditions, box.sides(middle)) else (low, middle)
    return replace(box, most=low, ends=ENDS)


def _hold(conditions: Program, sides: FloatArray) -> bool:
    """Whether the conditions are proven on a box (P x 2), or on all its parts."""
    todo, count = [sides], 0
    while todo:
        own = todo.pop()
        count += 1
        try:
            (values,) = conditions.run([Interval(a, b) for a, b in own.tolist()], INTERVALS)
            if len(values) == conditions.shapes[0][0] and all(x.low > 0 for _, _, x in values):
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
