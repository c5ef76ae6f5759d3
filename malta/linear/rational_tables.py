"""Long expressions of p expanded to matrices of short rational functions, and what is computed with these.

The matrices of a planar motor at a place are sums over many coils: ten thousand operations that equal polynomials
of a few terms. They are expanded exactly, then rounded to doubles once. Entries that symmetry makes zero differ
from zero by that rounding alone: terms below 1e-11 of the largest in their row and column are left out of the
model. Branches and squares of roots are resolved before (box.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.linear.branches import resolve_branches
from malta.linear.expressions import exact, program
from malta.linear.rational import Ratio, Symbolic, Table, symbolic

ROUNDING = 1e-11  # relative size below which a term is rounding of the model's arithmetic


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
