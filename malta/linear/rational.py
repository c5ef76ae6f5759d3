"""Entries of matrices as exact rational functions of p: degrees, denominators, and bounds in which terms cancel.

Operations outside the field (a sine, a root) become further variables, so that their factors still cancel exactly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from flint import Ordering, acb, fmpq_mpoly_ctx

from malta.arrays import FloatArray
from malta.linear.branches import resolve_branches
from malta.linear.expressions import FIELD, MatrixProgram, NotAnalytic, exact, is_rational_step, program
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


# Long expressions of p expanded to short rational functions.
#
# The matrices of a planar motor at a place are sums over many coils: ten thousand operations that equal polynomials
# of a few terms. They are expanded exactly, then rounded to doubles once. Entries that symmetry makes zero differ
# from zero by that rounding alone: terms below 1e-11 of the largest in their row and column are left out of the
# model. Branches and squares of roots are resolved before (box.py).


ROUNDING = 1e-11  # relative size below which a term is rounding of the model's arithmetic

Table = dict[tuple[int, int], Ratio]


def expand_matrices(function: ca.Function, nominal: FloatArray) -> tuple[Symbolic, list[Table], list[Ratio]]:
    """The matrices of a function of one vector as exact rational functions, without terms that are rounding.

    nominal : values at which the sizes of terms are compared, and branches chosen

    Returns them with their conditions, which are above zero where the matrices are those of the function.

    Raises TooLarge or NotAnalytic when the function has no short expansion.
    """
    resolved, conditions = resolve_branches(program(function), nominal.tolist())
    s = symbolic(resolved)
    *matrices, positive = s.entries
    scales = np.concatenate([nominal, np.ones(len(s.atoms))])
    circles, zero = _circles(s), Ratio(s.context.constant(0))
    above = [positive.get((k, 0), zero) for k in range(resolved.shapes[-1][0])]
    found = [s.inputs + k for k, step in enumerate(s.atoms) if s.program.steps[step][0] == "sqrt"]
    roots = dict(zip(found, above[conditions:], strict=True))

    def replace_roots(r: Ratio) -> Ratio:
        return replace_squares(s, _replace_cosines(s, r, circles), roots)

    tables = [drop_rounding(s, {at: replace_roots(r) for at, r in t.items()}, scales) for t in matrices]
    return s, tables, [replace_roots(r) for r in above]


def replace_squares(s: Symbolic, r: Ratio, roots: Mapping[int, Ratio]) -> Ratio:
    """Replace squares of roots by their arguments, of the last root first, as its argument may have others."""
    for i, argument in reversed(list(roots.items())):

        def turn(polynomial: Any, i: int = i, argument: Ratio = argument) -> Ratio:
            powers: dict[int, dict[Any, Any]] = {}
            for monomial, c in polynomial.to_dict().items():
                square, odd = divmod(int(monomial[i]), 2)
                powers.setdefault(square, {})[*monomial[:i], odd, *monomial[i + 1 :]] = c
            total = Ratio(s.context.constant(0))
            for square, terms in powers.items():
                total = total + Ratio(s.context.from_dict(terms)) * argument**square
            return total

        if any(p is not None and p.degrees()[i] > 1 for p in (r.num, r.den)):
            r = turn(r.num) if r.den is None else turn(r.num) / turn(r.den)
    return r


def _circles(s: Symbolic) -> list[tuple[int, int]]:
    """The pairs of variables that are sine and cosine of the same angle."""
    found: dict[tuple[int, ...], dict[str, int]] = {}
    for k, step in enumerate(s.atoms):
        name, _, operands, _ = s.program.steps[step]
        found.setdefault(operands, {})[name] = s.inputs + k
    return [(pair["sin"], pair["cos"]) for pair in found.values() if {"sin", "cos"} <= set(pair)]


def _replace_cosines(s: Symbolic, r: Ratio, circles: list[tuple[int, int]]) -> Ratio:
    """Replace cos^2 by 1 - sin^2 of the same angle, so that equal expressions have equal polynomials."""
    if not circles:
        return r

    def turn(polynomial: Any) -> Any:
        total = s.context.constant(0)
        gens = s.context.gens()
        for monomial, c in polynomial.to_dict().items():
            rest, factor = list(monomial), s.context.constant(1)
            for sine, cosine in circles:
                squares, rest[cosine] = divmod(int(rest[cosine]), 2)
                factor *= (1 - gens[sine] ** 2) ** squares
            total += s.context.from_dict({tuple(rest): c}) * factor
        return total

    return Ratio(turn(r.num), None if r.den is None else turn(r.den))


def is_free_of_functions(s: Symbolic, tables: Sequence[Table]) -> bool:
    """Whether the entries depend on p alone, without sines, roots and other functions."""
    for table in tables:
        for r in table.values():
            for polynomial in (r.num, r.den):
                if polynomial is not None and any(any(m[s.inputs :]) for m in polynomial.monoms()):
                    return False
    return True


def drop_rounding(s: Symbolic, table: Table, nominal: FloatArray, *beside: Table) -> Table:
    """A table without terms that are negligible against the largest in their row and column, of `beside` if given."""
    weights = [abs(float(x)) or 1.0 for x in nominal]
    rows: dict[int, float] = {}
    columns: dict[int, float] = {}
    for (i, j), r in (pair for one in (beside or (table,)) for pair in one.items()):
        size = max(_sizes(r, weights).values(), default=0.0)
        rows[i], columns[j] = max(rows.get(i, 0.0), size), max(columns.get(j, 0.0), size)
    found: Table = {}
    for (i, j), r in table.items():
        limit = ROUNDING * math.sqrt(rows.get(i, 0.0) * columns.get(j, 0.0))
        sizes = _sizes(r, weights)
        kept = {m: _double(c) for m, c in r.num.to_dict().items() if sizes[m] > limit}
        if kept:
            num = Ratio(s.context.from_dict(kept))
            found[i, j] = num if r.den is None else num / Ratio(_drop_rounding_terms(s, r.den, weights))
    return found


def _drop_rounding_terms(s: Symbolic, polynomial: Any, weights: list[float]) -> Any:
    """A polynomial without terms that are negligible against its largest."""
    sizes = _sizes(Ratio(polynomial), weights)
    limit = ROUNDING * max(sizes.values())
    return s.context.from_dict({m: _double(c) for m, c in polynomial.to_dict().items() if sizes[m] > limit})


def _sizes(r: Ratio, weights: list[float]) -> dict[Any, float]:
    """The size of each term of the numerator, relative to the denominator."""

    def weigh(monomial: Sequence[int], c: Any) -> float:
        size = abs(int(c.p) / int(c.q))
        for e, w in zip(monomial, weights, strict=False):
            size *= w ** int(e)
        return size

    below = 1.0 if r.den is None else sum(weigh(m, c) for m, c in r.den.to_dict().items()) or 1.0
    return {m: weigh(m, c) / below for m, c in r.num.to_dict().items()}


def product(one: Table, two: Table) -> Table:
    """The product of two matrices, without zeros."""
    found: Table = {}
    for (i, k), r in one.items():
        for (row, j), q in two.items():
            if k == row:
                found[i, j] = found[i, j] + r * q if (i, j) in found else r * q
    return {at: r for at, r in found.items() if not r.is_zero()}


def difference(one: Table, two: Table) -> Table:
    found = dict(one)
    for at, r in two.items():
        found[at] = found[at] - r if at in found else -r
    return found


def _double(c: Any) -> Any:
    """The double next to an exact number."""
    return exact(int(c.p) / int(c.q))


def substitute(s: Symbolic, r: Ratio, values: Mapping[int, Ratio]) -> Ratio:
    """Substitute rational functions for variables of r."""

    def turn(polynomial: Any) -> Ratio:
        total = Ratio(s.context.constant(0))
        for monomial, c in polynomial.to_dict().items():
            rest = tuple(0 if i in values else e for i, e in enumerate(monomial))
            term = Ratio(s.context.from_dict({rest: c}))
            for i, e in enumerate(monomial):
                if e and i in values:
                    term = term * values[i] ** int(e)
            total = total + term
        return total

    num = turn(r.num)
    return num if r.den is None else num / turn(r.den)


def solution(s: Symbolic, matrix: Table, right: Mapping[int, Ratio], n: int) -> list[Ratio]:
    """Solve M x = b by elimination in exact rational functions; pivots with the fewest terms first.

    Raises ZeroDivisionError when M is singular for all p.
    """
    zero = Ratio(s.context.constant(0))
    rows = [{j: matrix[i, j] for j in range(n) if (i, j) in matrix} for i in range(n)]
    b = [right.get(i, zero) for i in range(n)]
    order: list[tuple[int, int]] = []
    left = set(range(n))
    while left:
        choices = [(len(r.num), len(rows[i]), i, j) for i in left for j, r in rows[i].items()]
        if not choices:
            raise ZeroDivisionError
        _, _, i, j = min(choices)
        left.discard(i)
        order.append((i, j))
        for k in left:
            if j not in rows[k]:
                continue
            share = rows[k].pop(j) / rows[i][j]
            b[k] = b[k] - share * b[i]
            for at, r in rows[i].items():
                if at != j:
                    new = rows[k].get(at, zero) - share * r
                    rows[k].pop(at, None)
                    if not new.is_zero():
                        rows[k][at] = new
    x = [zero] * n
    for i, j in reversed(order):
        total = b[i]
        for at, r in rows[i].items():
            if at != j:
                total = total - r * x[at]
        x[j] = total / rows[i][j]
    return x


def expression(r: Ratio, p: Any) -> Any:
    """r as a CasADi expression of the vector p."""

    def turn(polynomial: Any) -> Any:
        total: Any = ca.SX(0)
        for monomial, c in polynomial.to_dict().items():
            term: Any = ca.SX(int(c.p) / int(c.q))
            for i, e in enumerate(monomial):
                for _ in range(int(e)):
                    term = term * p[i]
            total = total + term
        return total

    return turn(r.num) if r.den is None else turn(r.num) / turn(r.den)


def matrix_of(table: Table, shape: tuple[int, int], p: Any) -> Any:
    """The table as a CasADi matrix, structurally zero without an entry."""
    found = ca.SX(*shape)
    for (i, j), r in table.items():
        found[i, j] = expression(r, p)
    return found
