"""Degrees of a characteristic polynomial in each parameter, upper bounds read from the entries of the matrices."""

from __future__ import annotations

from typing import Any

from flint import fmpq, fmpq_mat

from malta.proof.groups import A, B, C, D, E, UncertainLoop
from malta.proof.polynomial.rational import Ratio, Symbolic
from malta.proof.uncertain import Group


def degree(polynomial: Any, i: int) -> int:
    return int(polynomial.degrees()[i]) if len(polynomial) else 0


def sole_power(den: Any, i: int) -> int | None:
    """k when den is p_i^k times a factor without p_i, else None."""
    if den is None:
        return 0
    powers = {monomial[i] for monomial in den.monoms()}
    return powers.pop() if len(powers) == 1 else None


def depends(s: Symbolic, atom: int, i: int) -> bool:
    """Whether a further variable depends on p_i."""
    seen, stack = set(), [s.atoms[atom]]
    while stack:
        k = stack.pop()
        if k in seen:
            continue
        seen.add(k)
        name, target, operands, _ = s.program.steps[k]
        if name == "input" and target == i:
            return True
        stack += operands
    return False


def clear_denominators(loop: UncertainLoop, g: Group, s: Symbolic) -> list[dict[Any, Any]]:
    """The rows of the polynomial matrix with determinant a: first those of x, then those of y; columns x, u, y."""
    rows: list[dict[Any, Ratio]] = []
    for i in g.states:
        row: dict[Any, Ratio] = {("u", j): r for (k, j), r in s.entries[B].items() if k == i}
        for (k, j), r in s.entries[A].items():
            if k == i and j in g.states:
                row["x", j] = r
        if loop.descriptor:
            for (k, j), r in s.entries[E].items():
                if k == i and j in g.states:
                    row["e", j] = r
        rows.append(row)
    for i in range(loop.program.shapes[C][0]):
        row = {("x", j): r for (k, j), r in s.entries[C].items() if k == i and j in g.states}
        if loop.direct:
            row |= {("u", j): r for (k, j), r in s.entries[D].items() if k == i}
        rows.append(row)
    return [_row(row) for row in rows]


def _row(row: dict[Any, Ratio]) -> dict[Any, Any]:
    """The numerators of a row over its common denominator, which is the entry None."""
    common = None
    for r in row.values():
        if r.den is None:
            continue
        common = r.den if common is None else common * (r.den / common.gcd(r.den))
    found = {
        at: r.num if common is None else r.num * (common if r.den is None else common / r.den)
        for at, r in row.items()
    }
    if common is not None:
        found[None] = common
    return found


def determinant_degree(rows: list[dict[Any, Any]], i: int) -> int:
    """An upper bound of the degree in p_i: by rows, by columns, or by the rank of the factors of p_i."""
    by_row = [max((degree(entry, i) for entry in row.values()), default=0) for row in rows]
    columns: dict[Any, int] = {}
    for k, row in enumerate(rows):
        for at, entry in row.items():
            # a row's denominator stands in the column of its own s (or y)
            place = ("own", k) if at is None else at
            if place[0] == "e":
                place = ("x", place[1])
            columns[place] = max(columns.get(place, 0), degree(entry, i))
    bound = min(sum(by_row), sum(columns.values()))
    if max(by_row, default=0) <= 1 and bound > 1:
        bound = min(bound, _rank(rows, i))
    return bound


def _rank(rows: list[dict[Any, Any]], i: int) -> int:
    """The rank of the coefficients of p_i when these are numbers; else the number of rows that have them."""
    parts: list[dict[Any, Any]] = []
    constant = True
    for row in rows:
        part: dict[Any, Any] = {}
        for at, entry in row.items():
            if degree(entry, i):
                slope = entry.derivative(i)
                constant &= bool(slope.is_constant())
                part[("own", len(parts)) if at is None else at] = slope
        if part:
            parts.append(part)
    if not constant or len(parts) < 2:
        return len(parts)
    places = sorted({at for part in parts for at in part}, key=str)
    table = [[part[at].leading_coefficient() if at in part else fmpq(0) for at in places] for part in parts]
    return int(fmpq_mat(table).rank())
