"""Branches of a model: which of them is active at nominal parameters, and what is above zero while they stay so.

fmax(v, 0) is v as long as v > 0, fabs(x) is x, and sqrt(x)^2 is x. A model is written with the branches that are
active at its nominal parameters, as expressions without branches; what has to stay above zero for that becomes a
condition. Derivatives are taken before, so that a branch of a derivative is resolved as well.

Or it is written once for each case: with every choice of branches, and where each of them holds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
from flint import acb, arb

from malta.linear.balls import POINTS, root_enclosure
from malta.linear.expressions import KNOWN_OPERATIONS, Arithmetic, MatrixProgram, NotAnalytic, Step, program
from malta.linear.roots import RootEntry

_OTHER_SYMBOL_OPERATIONS: dict[str, Any] = {
    name: getattr(ca, name) for name in KNOWN_OPERATIONS if hasattr(ca, name)
}


SYMBOLS = Arithmetic(
    ca.SX, {**_OTHER_SYMBOL_OPERATIONS, "pow": ca.power, "root": lambda entry, p: entry.at_symbols(p)}
)


_TURNS = ("fabs", "fmax", "fmin")


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


def _root_of_intervals(entry: RootEntry, p: Sequence[Interval]) -> Interval:
    return _by_balls(lambda *z: root_enclosure(entry, [acb(x) for x in z], is_one=False).real)(*p)


INTERVALS = Arithmetic(
    lambda x: Interval(x, x),
    {**{name: _by_balls(f) for name, f in POINTS.others.items()}, "root": _root_of_intervals},
)


def _span(function: Callable[..., tuple[float, float]]) -> Callable[..., Interval]:
    return lambda *sides: Interval(*function(*sides))


def _root_of_span(x: Interval) -> tuple[float, float]:
    low, high = math.sqrt(max(x.low, 0.0)), math.sqrt(max(x.high, 0.0))
    return math.nextafter(low, -math.inf), math.nextafter(high, math.inf)


# Intervals with branches, which are enclosed where they turn, and roots down to zero.
SPANS = Arithmetic(
    INTERVALS.constant,
    {
        **INTERVALS.others,
        "sqrt": _span(_root_of_span),
        "fabs": _span(lambda x: (max(x.low, -x.high, 0.0), max(x.high, -x.low))),
        "fmax": _span(lambda x, y: (max(x.low, y.low), max(x.high, y.high))),
        "fmin": _span(lambda x, y: (min(x.low, y.low), min(x.high, y.high))),
    },
)


def is_identity_within(function: ca.Function, sides: Sequence[tuple[float, float]]) -> bool:
    """Whether a function of a vector is its argument in a box: by larger and smaller numbers that are apart in it.

    Raises NotAnalytic for operations without an enclosure.
    """
    model, p = program(function), ca.SX.sym("p", len(sides))
    cells: list[tuple[Any, Interval]] = []
    for name, target, operands, value in model.steps:
        own = [cells[k] for k in operands]
        if name == "input":
            cells.append((p[target], Interval(*sides[target])))
            continue
        if name == "const":
            cells.append((ca.SX(value), Interval(value, value)))
            continue
        span = SPANS.apply(name, [x for _, x in own], value)
        if name in ("fmax", "fmin") and not (
            own[0][1].low < own[1][1].high and own[1][1].low < own[0][1].high
        ):
            first = (own[0][1].low >= own[1][1].high) == (name == "fmax")
            cells.append((own[0 if first else 1][0], span))
        else:
            symbols = [x for x, _ in own]
            made = getattr(ca, name)(*symbols) if name in _TURNS else SYMBOLS.apply(name, symbols, value)
            cells.append((made, span))
    found = {i: cells[k][0] for i, _, k in model.entries[0]}
    return len(found) == len(sides) and all(ca.is_equal(x, p[i], 2) for i, x in found.items())


class _Undecided(Exception):
    """A case has another branch, whose sign is not given."""


class _Resolved:
    """The steps of a program so far, without branches, their values at nominal parameters, and what is above zero.

    signs : of what branches hang on, in the order in which they are met; None: those at nominal parameters
    """

    def __init__(self, nominal: Sequence[float], signs: Sequence[int] | None = None) -> None:
        self.nominal, self.signs = nominal, signs
        self.chosen: dict[Any, int] = {}
        self.steps: list[Step] = []
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
        if self.signs is not None and self.steps[k][0] != "const":
            return self._given_sign(k)
        x = self.values[k]
        if x is None or not (x > 0 or x < 0):
            return 0
        if self.steps[k][0] != "const":
            self.positive.append(k if x > 0 else self.add("neg", 0, (k,), 0.0))
        return 1 if x > 0 else -1

    def _given_sign(self, k: int) -> int:
        """The sign of a step in this case. Raises _Undecided where none is given."""
        assert self.signs is not None
        own = self.steps[k]
        if own not in self.chosen:
            if len(self.chosen) == len(self.signs):
                raise _Undecided
            sign = self.chosen[own] = self.signs[len(self.chosen)]
            self.positive.append(k if sign > 0 else self.add("neg", 0, (k,), 0.0))
        return self.chosen[own]

    def resolve(self, name: str, operands: tuple[int, ...]) -> int | None:
        """The step that stands for an operation with branches; None for any other, or where the branch is not known."""
        if name in ("fmax", "fmin", "lt", "le"):
            one, two = operands
            sign = self.sign(self.add("sub", 0, operands, 0.0))
            if not sign:
                return None
            if name in ("lt", "le"):
                return self.constant(float(sign < 0))
            return one if (sign > 0) == (name == "fmax") else two
        # A sign is zero at zero, where neither case is the function.
        if name == "fabs" or (name == "sign" and self.signs is None):
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


def resolve_branches(
    model: MatrixProgram, nominal: Sequence[float], signs: Sequence[int] | None = None
) -> tuple[MatrixProgram, int]:
    """The program with the branches that are active at nominal parameters, and how many conditions these have.

    signs : in place of those at nominal parameters, see _Resolved

    A last matrix of one column is added: first the conditions, which are above zero where the programs agree, then the
    arguments of all roots, which are above zero where sqrt(x)^2 is x.
    """
    found, place = _Resolved(nominal, signs), list[int]()
    roots: dict[int, int] = {}
    for name, target, operands, value in model.steps:
        own = tuple(place[k] for k in operands)
        step = found.resolve(name, own)
        step = found.add(name, target, own, value) if step is None else step
        if name == "sqrt":
            roots[step] = own[0]
        place.append(step)
    positive = list(dict.fromkeys(found.positive))
    last = [*positive, *roots.values()]
    entries = tuple(tuple((i, j, place[k]) for i, j, k in matrix) for matrix in model.entries)
    column = tuple((i, 0, k) for i, k in enumerate(last))
    made = MatrixProgram(
        tuple(found.steps), (*entries, column), (*model.shapes, (len(last), 1)), model.inputs
    )
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
    try:
        made = _functions(model, *resolve_branches(model, nominal))
    except NotAnalytic:
        return function, None
    return made.matrices, made.positive if made.positive.size1_out(0) else None


class BranchCase(NamedTuple):
    """A function with one choice of branches, and what is zero or above where it is the function."""

    matrices: ca.Function
    positive: ca.Function


def _functions(model: MatrixProgram, resolved: MatrixProgram, count: int) -> BranchCase:
    """The functions of a resolved program with its first conditions. Raises NotAnalytic for branches that stayed."""
    p = ca.SX.sym("p", model.inputs)
    *entries, above = resolved.run(ca.vertsplit(p), SYMBOLS)
    matrices = [ca.SX(*shape) for shape in model.shapes]
    for matrix, own in zip(matrices, entries, strict=True):
        for i, j, x in own:
            matrix[i, j] = x
    positive = ca.vertcat(ca.SX(0, 1), *(x for i, _, x in above if i < count))
    return BranchCase(ca.Function("matrices", [p], matrices), ca.Function("positive", [p], [positive]))


MAX_CASES = 64  # of a function, beyond which none is looked at: six switches


def branch_cases(function: ca.Function) -> list[BranchCase]:
    """A function with each choice of its branches; none where these are more than MAX_CASES, or are not known.

    At each p the function is that of a case whose conditions are zero or above there.
    """
    model, found, todo = program(function), list[BranchCase](), [tuple[int, ...]()]
    while todo:
        signs = todo.pop()
        if len(todo) + len(found) >= MAX_CASES:
            return []
        try:
            found.append(_functions(model, *resolve_branches(model, [0.0] * model.inputs, signs)))
        except _Undecided:
            todo += [(*signs, 1), (*signs, -1)]
        except NotAnalytic:
            return []
    return found if len(found) > 1 else []
