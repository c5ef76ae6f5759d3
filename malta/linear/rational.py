"""Entries of matrices as exact rational functions of p: degrees, denominators, and bounds in which terms cancel.

Operations outside the field (a sine, a root) become further variables, so that their factors still cancel exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flint import Ordering, acb, fmpq_mpoly_ctx

from malta.linear.expressions import FIELD, MatrixProgram, NotAnalytic, exact, is_rational_step
from malta.work import check_clock

MAX_TERMS = 4000  # terms of an expression at most
MAX_PRODUCTS = 2_000_000  # products of terms that are added at once: more take seconds


class TooLarge(Exception):
    """A rational function has too many terms."""


class Ratio:
    """num / den, polynomials over the rationals; a constant den is one."""

    __slots__ = ("den", "num")

    def __init__(self, num: Any, den: Any = None) -> None:
        self.num, self.den = num, den
        if len(num) > MAX_TERMS:
            raise TooLarge
        check_clock()

    def __add__(self, other: Ratio) -> Ratio:
        if self.den is None and other.den is None:
            return Ratio(self.num + other.num)
        if self.den == other.den:
            return _lowest(self.num + other.num, self.den)
        one = self.num * other.den if other.den is not None else self.num
        two = other.num * self.den if self.den is not None else other.num
        den = self.den if other.den is None else other.den if self.den is None else self.den * other.den
        return _lowest(one + two, den)

    def __neg__(self) -> Ratio:
        return Ratio(-self.num, self.den)

    def __sub__(self, other: Ratio) -> Ratio:
        return self + (-other)

    def __mul__(self, other: Ratio) -> Ratio:
        if len(self.num) * len(other.num) > MAX_PRODUCTS:
            raise TooLarge
        if self.den is None and other.den is None:
            return Ratio(self.num * other.num)
        den = self.den if other.den is None else other.den if self.den is None else self.den * other.den
        return _lowest(self.num * other.num, den)

    def __truediv__(self, other: Ratio) -> Ratio:
        if other.num.is_zero():
            raise ZeroDivisionError
        if other.num.is_constant():
            inverse = 1 / other.num.leading_coefficient()
            num = self.num * inverse if other.den is None else self.num * other.den * inverse
            return Ratio(num) if self.den is None else _lowest(num, self.den)
        num = self.num if other.den is None else self.num * other.den
        return _lowest(num, other.num if self.den is None else self.den * other.num)

    def __rtruediv__(self, one: int) -> Ratio:
        return Ratio(self.num.context().constant(one)) / self

    def __pow__(self, k: int) -> Ratio:
        return Ratio(self.num**k, None if self.den is None else self.den**k)

    def is_zero(self) -> bool:
        return bool(self.num.is_zero())


def _lowest(num: Any, den: Any) -> Ratio:
    """num / den without common factors."""
    if den is None:
        return Ratio(num)
    if num.is_zero():
        return Ratio(num)
    common = num.gcd(den)
    if not common.is_constant():
        num, den = num / common, den / common
    if den.is_constant():
        return Ratio(num * (1 / den.leading_coefficient()))
    lead = den.leading_coefficient()
    return Ratio(num * (1 / lead), den * (1 / lead))


@dataclass(frozen=True, eq=False)
class Symbolic:
    """A program's matrices as rational functions of p and of its foreign operations."""

    entries: tuple[dict[tuple[int, int], Ratio], ...]
    context: Any
    inputs: int
    atoms: tuple[int, ...]  # steps of the program that are further variables
    program: MatrixProgram
    arguments: tuple[Ratio, ...] = ()  # of each atom, the first

    def constant(self, x: float) -> Ratio:
        return Ratio(self.context.constant(exact(x)))


def over_common_denominator(entries: Mapping[Any, Ratio]) -> tuple[dict[Any, Any], Any]:
    """The numerators of rational functions over their common denominator, and this; None for one."""
    common = None
    for r in entries.values():
        if r.den is not None:
            common = r.den if common is None else common * (r.den / common.gcd(r.den))
    return {
        at: r.num if common is None else r.num * (common if r.den is None else common / r.den)
        for at, r in entries.items()
    }, common


def value(polynomial: Mapping[Any, Any], p: Sequence[Any]) -> Any:
    """The value at complex balls of a polynomial, its coefficients by exponents."""
    check_clock()
    total = acb(0)
    for monomial, c in polynomial.items():
        term = acb(c)
        for i, e in enumerate(monomial):
            if e:
                term *= p[i] ** int(e)
        total += term
    return total


def symbolic(program: MatrixProgram) -> Symbolic:
    """The matrices of a program as rational functions.

    Raises TooLarge for too many terms, and NotAnalytic for a division by an expression that is identically zero.
    """
    atoms = tuple(
        k for k, (name, _, _, value) in enumerate(program.steps) if not is_rational_step(name, value)
    )
    names = [f"p{i}" for i in range(program.inputs)] + [f"a{k}" for k in atoms]
    context = fmpq_mpoly_ctx.get(names or ["p0"], Ordering.lex)
    gens, place = context.gens(), {k: i for i, k in enumerate(atoms)}
    cells: list[Ratio] = []
    for k, (name, target, operands, value) in enumerate(program.steps):
        if k in place:
            cells.append(Ratio(gens[program.inputs + place[k]]))
        elif name == "input":
            cells.append(Ratio(gens[target]))
        elif name == "const":
            cells.append(Ratio(context.constant(exact(value))))
        elif name == "constpow":
            base, power = cells[operands[0]], int(value)
            cells.append(base**power if power >= 0 else 1 / base ** (-power))
        else:
            try:
                cells.append(FIELD[name](*(cells[i] for i in operands)))
            except ZeroDivisionError as error:
                raise NotAnalytic("a division by zero") from error
    entries = tuple(
        {(i, j): cells[k] for i, j, k in matrix if not cells[k].is_zero()} for matrix in program.entries
    )
    arguments = tuple(cells[program.steps[k][2][0]] for k in atoms)
    return Symbolic(entries, context, program.inputs, atoms, program, arguments)


Table = dict[tuple[int, int], Ratio]


def product(one: Table, two: Table) -> Table:
    """The product of two matrices, without zeros."""
    found: Table = {}
    for (i, k), r in one.items():
        for (row, j), q in two.items():
            if k == row:
                found[i, j] = found[i, j] + r * q if (i, j) in found else r * q
    return {at: r for at, r in found.items() if not r.is_zero()}
