"""Taylor models of one variable y on many intervals at once: polynomials in floating point, and error bounds.

    f(middle + half u) = sum_k c_k u^k +- radius,    |u| <= 1        rows of c: powers; columns: intervals

Everything is vectorized over the intervals. Rounding is part of the radius: a sum of n products is off by at most
n + 2 units in the last place of the sum of their sizes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.linear.expressions import MatrixProgram, NotAnalytic
from malta.work import check_clock

ORDER = 6
EPS = 2.0**-52
UNDERFLOW_ERROR = 1e-300  # error of underflow


class Taylor(NamedTuple):
    """c: (ORDER + 1) x intervals; radius: intervals."""

    c: FloatArray
    radius: FloatArray

    def size(self) -> FloatArray:
        """An upper bound of |f| on each interval."""
        return np.asarray((np.abs(self.c).sum(axis=0) + self.radius) * (1 + 16 * EPS))

    def bounds(self, pieces: range | None = None) -> tuple[float, float]:
        """Bounds of f on all intervals, or on some."""
        c, radius = (x if pieces is None else x[..., pieces.start : pieces.stop] for x in self)
        beyond = (np.abs(c[1:]).sum(axis=0) + radius) * (1 + 16 * EPS) + 4 * EPS * np.abs(c[0])
        return float((c[0] - beyond).min()), float((c[0] + beyond).max())


def variable(low: float, high: float, count: int) -> Taylor:
    """y itself on `count` intervals that cover [low, high]."""
    edges = np.linspace(low, high, count + 1)
    edge = max(abs(low), abs(high)) if low < high else 0.0  # edges are off by a digit of it
    half = (high - low) / (2 * count) * (1 + 1e-9) + 4 * EPS * edge
    c = np.zeros((ORDER + 1, count))
    c[0], c[1] = (edges[1:] + edges[:-1]) / 2, half
    return Taylor(c, np.full(count, UNDERFLOW_ERROR))


def constant(x: float, count: int) -> Taylor:
    c = np.zeros((ORDER + 1, count))
    c[0] = x
    return Taylor(c, np.zeros(count))


def add(a: Taylor, b: Taylor) -> Taylor:
    c = a.c + b.c
    return Taylor(c, (a.radius + b.radius) * (1 + 2 * EPS) + EPS * np.abs(c).sum(axis=0))


def subtract(a: Taylor, b: Taylor) -> Taylor:
    c = a.c - b.c
    return Taylor(c, (a.radius + b.radius) * (1 + 2 * EPS) + EPS * np.abs(c).sum(axis=0))


def scale(a: Taylor, x: float) -> Taylor:
    c = a.c * x
    return Taylor(c, a.radius * abs(x) * (1 + EPS) + EPS * np.abs(c).sum(axis=0) + UNDERFLOW_ERROR)


@lru_cache(maxsize=1)
def _folds() -> FloatArray:
    """Products c_i d_j, flat -> the powers that stay."""
    n = ORDER + 1
    M = np.zeros((n, n * n))
    for i in range(n):
        for j in range(n - i):
            M[i + j, i * n + j] = 1
    return M


def multiply(a: Taylor, b: Taylor) -> Taylor:
    n = ORDER + 1
    x, y = np.abs(a.c), np.abs(b.c)
    c = _folds() @ (a.c[:, None] * b.c[None]).reshape(n * n, -1)
    below = np.cumsum(y, axis=0)[::-1]  # of y_0 .. y_(n - 1 - i), what stays beside x_i
    total = below[0]
    beyond = (x * (total - below)).sum(axis=0)
    left = a.radius * (total + b.radius) + x.sum(axis=0) * (b.radius + (3 * n + 8) * EPS * total)
    return Taylor(c, (beyond + left) * (1 + 32 * EPS) + UNDERFLOW_ERROR)


def divide(a: Taylor, b: Taylor) -> Taylor:
    return multiply(a, inverse(b))


def inverse(b: Taylor) -> Taylor:
    """1 / b by a polynomial g and the size of 1 - b g. Raises NotAnalytic where b may be zero."""
    c0 = b.c[0]
    if not (np.abs(c0) > 0).all():
        raise NotAnalytic("a division by what may be zero")
    g = np.zeros_like(b.c)
    g[0] = 1 / c0
    for k in range(1, ORDER + 1):
        g[k] = -(b.c[1 : k + 1] * g[k - 1 :: -1][:k]).sum(axis=0) / c0
    found = Taylor(g, np.zeros_like(b.radius))
    rest = subtract(constant(1.0, g.shape[1]), multiply(b, found)).size()
    if not (rest < 0.5).all():
        raise NotAnalytic("a division by what may be zero")
    return Taylor(g, found.size() * rest / (1 - rest) * (1 + 8 * EPS) + UNDERFLOW_ERROR)


def root(a: Taylor) -> Taylor:
    """The square root by a polynomial g and the size of a - g^2. Raises NotAnalytic where a may not be positive."""
    c0 = a.c[0]
    if not (c0 > 0).all():
        raise NotAnalytic("a root or logarithm at zero or below")
    g = np.zeros_like(a.c)
    g[0] = np.sqrt(c0)
    for k in range(1, ORDER + 1):
        g[k] = (a.c[k] - (g[1:k] * g[k - 1 : 0 : -1]).sum(axis=0)) / (2 * g[0])
    found = Taylor(g, np.zeros_like(a.radius))
    rest = subtract(a, multiply(found, found)).size()
    least = g[0] - np.abs(g[1:]).sum(axis=0) * (1 + 16 * EPS)  # of g, which then is the positive root of g^2
    if not ((least > 0) & (rest < 0.5 * least**2)).all():
        raise NotAnalytic("a root or logarithm at zero or below")
    return Taylor(
        g, rest / least * (1 + 8 * EPS) + UNDERFLOW_ERROR
    )  # |sqrt(a) - g| = |a - g^2| / (sqrt(a) + g)


def sine(a: Taylor) -> Taylor:
    return _wave(a, 0)


def cosine(a: Taylor) -> Taylor:
    return _wave(a, 1)


def _wave(a: Taylor, turn: int) -> Taylor:
    """sin(a + turn pi / 2) about the middle of each interval, by powers of what a adds there."""
    at = a.c[0]
    cycle = [np.sin(at), np.cos(at), -np.sin(at), -np.cos(at)]
    moved = Taylor(np.vstack([np.zeros_like(at)[None], a.c[1:]]), a.radius)
    count = len(at)
    total, power = constant(0.0, count), constant(1.0, count)
    for k in range(ORDER + 1):
        value = np.zeros_like(a.c)
        value[0] = cycle[(k + turn) % 4] / math.factorial(k)
        # sin and cos of libraries are off by 4 units in the last place of 1 at most, which are 4 EPS / 2
        total = add(total, multiply(Taylor(value, np.full(count, 4 * EPS)), power))
        power = multiply(power, moved)
    rest = power.size() / math.factorial(ORDER + 1) * (1 + 8 * EPS)
    return Taylor(total.c, total.radius + rest)


# Expressions of parameters p and of one variable y as Laurent polynomials of p, over an interval of y.
#
#     value = sum over monomials of p: c(y) p^m,    c by Taylor models on intervals that cover those of y
#
# Terms of y alone may be long (the coils of a planar motor at a position: ten thousand operations), because they are
# evaluated in floating point with a bound of the error. In p only products and quotients by monomials have this form.


Monomial = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Laurent:
    """A sum of monomials of p, with coefficients of y."""

    terms: Mapping[Monomial, Taylor]


Value = float | Taylor | Laurent  # a constant, of y alone, of p and y
FUNCTIONS: dict[str, Callable[[Taylor], Taylor]] = {"sin": sine, "cos": cosine, "sqrt": root}


class Evaluation:
    """A program's steps over `count` intervals of y from low to high; y is its input number `position`."""

    def __init__(self, parameters: int, low: float, high: float, count: int) -> None:
        self.count, self.none = count, (0,) * parameters
        self.y = variable(low, high, count)

    def parameter(self, i: int) -> Laurent:
        exponents = tuple(int(i == k) for k in range(len(self.none)))
        return Laurent({exponents: constant(1.0, self.count)})

    def run(self, program: MatrixProgram, inputs: Sequence[Value]) -> list[list[tuple[int, int, Value]]]:
        """The entries (row, column, value) of each matrix.

        Raises NotAnalytic for expressions without this form, WorkUp where the clock ends the question.
        """
        cells: list[Value] = []
        for name, target, operands, x in program.steps:
            check_clock()
            if name == "input":
                cells.append(inputs[target])
            elif name == "const":
                cells.append(float(x))
            else:
                cells.append(self._step(name, [cells[k] for k in operands], x))
        return [[(i, j, cells[k]) for i, j, k in entries] for entries in program.entries]

    def _step(self, name: str, args: list[Value], exponent: float) -> Value:
        a = args[0]
        if name in ("add", "sub"):
            return self.sum(a, args[1] if name == "add" else self.product(args[1], -1.0))
        if name in ("mul", "sq", "twice", "neg"):
            other = {"sq": a, "twice": 2.0, "neg": -1.0}.get(name)
            return self.product(a, args[1] if other is None else other)
        if name == "div":
            return self.product(a, self._inverse(args[1]))
        if name in ("inv", "assign"):
            return self._inverse(a) if name == "inv" else a
        if name == "constpow" and exponent == round(exponent):
            base, power = a if exponent >= 0 else self._inverse(a), self.laurent(1.0)
            for _ in range(abs(int(exponent))):
                power = self.laurent(self.product(power, base))
            return power if isinstance(a, Laurent) else power.terms[self.none]
        if name not in FUNCTIONS or isinstance(a, Laurent):
            raise NotAnalytic(name)
        return FUNCTIONS[name](self._model(a))

    def _model(self, a: float | Taylor) -> Taylor:
        return constant(a, self.count) if isinstance(a, float) else a

    def laurent(self, a: Value) -> Laurent:
        return a if isinstance(a, Laurent) else Laurent({self.none: self._model(a)})

    def sum(self, a: Value, b: Value) -> Value:
        if a == 0.0 or b == 0.0:
            return b if a == 0.0 else a
        if not isinstance(a, Laurent) and not isinstance(b, Laurent):
            return add(self._model(a), self._model(b))
        found = dict(self.laurent(a).terms)
        for m, c in self.laurent(b).terms.items():
            found[m] = add(found[m], c) if m in found else c
        return Laurent(found)

    def product(self, a: Value, b: Value) -> Value:
        if isinstance(a, float):
            a, b = b, a
        if isinstance(b, float):
            if isinstance(a, Laurent):
                return Laurent({m: scale(c, b) for m, c in a.terms.items()})
            return scale(self._model(a), b)
        if not isinstance(a, Laurent) and not isinstance(b, Laurent):
            return multiply(self._model(a), b)
        found: dict[Monomial, Taylor] = {}
        for m, c in self.laurent(a).terms.items():
            for n, d in self.laurent(b).terms.items():
                at, part = tuple(i + j for i, j in zip(m, n, strict=True)), multiply(c, d)
                found[at] = add(found[at], part) if at in found else part
        return Laurent(found)

    def _inverse(self, a: Value) -> Value:
        if not isinstance(a, Laurent):
            return inverse(self._model(a))
        if len(a.terms) != 1:
            raise NotAnalytic("a division by a sum of parameters")
        ((m, c),) = a.terms.items()
        return Laurent({tuple(-i for i in m): inverse(c)})
