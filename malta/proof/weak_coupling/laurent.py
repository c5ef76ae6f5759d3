"""Expressions of parameters p and of one variable y as Laurent polynomials of p, over an interval of y.

    value = sum over monomials of p: c(y) p^m,    c by Taylor models on intervals that cover those of y

Terms of y alone may be long (the coils of a planar motor at a position: ten thousand operations), because they are
evaluated in floating point with a bound of the error. In p only products and quotients by monomials have this form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from malta.proof.expressions import NotAnalytic, Program
from malta.proof.time_limit import check_time
from malta.proof.weak_coupling import taylor
from malta.proof.weak_coupling.taylor import Taylor

Monomial = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Laurent:
    """A sum of monomials of p, with coefficients of y."""

    terms: Mapping[Monomial, Taylor]


Value = float | Taylor | Laurent  # a constant, of y alone, of p and y
FUNCTIONS: dict[str, Callable[[Taylor], Taylor]] = {
    "sin": taylor.sine,
    "cos": taylor.cosine,
    "sqrt": taylor.root,
}


class Evaluation:
    """A program's steps over `count` intervals of y from low to high; y is its input number `position`."""

    def __init__(self, parameters: int, low: float, high: float, count: int) -> None:
        self.count, self.none = count, (0,) * parameters
        self.y = taylor.variable(low, high, count)

    def parameter(self, i: int) -> Laurent:
        exponents = tuple(int(i == k) for k in range(len(self.none)))
        return Laurent({exponents: taylor.constant(1.0, self.count)})

    def run(self, program: Program, inputs: Sequence[Value]) -> list[list[tuple[int, int, Value]]]:
        """The entries (row, column, value) of each matrix.

        Raises NotAnalytic for expressions without this form, TimeUp within a time_limit.
        """
        cells: list[Value] = []
        for name, target, operands, x in program.steps:
            check_time()
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
        return taylor.constant(a, self.count) if isinstance(a, float) else a

    def laurent(self, a: Value) -> Laurent:
        return a if isinstance(a, Laurent) else Laurent({self.none: self._model(a)})

    def sum(self, a: Value, b: Value) -> Value:
        if a == 0.0 or b == 0.0:
            return b if a == 0.0 else a
        if not isinstance(a, Laurent) and not isinstance(b, Laurent):
            return taylor.add(self._model(a), self._model(b))
        found = dict(self.laurent(a).terms)
        for m, c in self.laurent(b).terms.items():
            found[m] = taylor.add(found[m], c) if m in found else c
        return Laurent(found)

    def product(self, a: Value, b: Value) -> Value:
        if isinstance(a, float):
            a, b = b, a
        if isinstance(b, float):
            if isinstance(a, Laurent):
                return Laurent({m: taylor.scaled(c, b) for m, c in a.terms.items()})
            return taylor.scaled(self._model(a), b)
        if not isinstance(a, Laurent) and not isinstance(b, Laurent):
            return taylor.multiply(self._model(a), b)
        found: dict[Monomial, Taylor] = {}
        for m, c in self.laurent(a).terms.items():
            for n, d in self.laurent(b).terms.items():
                at, part = tuple(i + j for i, j in zip(m, n, strict=True)), taylor.multiply(c, d)
                found[at] = taylor.add(found[at], part) if at in found else part
        return Laurent(found)

    def _inverse(self, a: Value) -> Value:
        if not isinstance(a, Laurent):
            return taylor.inverse(self._model(a))
        if len(a.terms) != 1:
            raise NotAnalytic("a division by a sum of parameters")
        ((m, c),) = a.terms.items()
        return Laurent({tuple(-i for i in m): taylor.inverse(c)})
