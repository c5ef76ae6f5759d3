"""The characteristic polynomial of a group of states, at given parameters and bounded over complex balls of them.

Continuous loops:           a(s; p) = det(s I - A_cl(p)), times the denominators of the entries
Sampled and discrete ones:  a(v; p) = (1 - v)^N det(g I - (A_cl(p) - I)),  g = z - 1 = 2 v / (1 - v)

The bilinear map takes the unit circle to the imaginary axis, v = j tan(w T / 2), so that both are zero-free on
s = jw, w from 0 to infinity, or they are not. A continuous system under a hold is sampled exactly, by the exponential.
At given p the coefficients are exact rationals, or balls as narrow as wanted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from flint import acb, acb_mat, arb, arb_mat, ctx, fmpq, fmpq_mat

from malta.linear.balls import BALLS, POINTS, finite
from malta.linear.expressions import EXACT_ARITHMETIC, MatrixProgram, NotAnalytic
from malta.linear.rational import Ratio, Symbolic, over_common_denominator, value
from malta.linear.sampling import split_delay
from malta.linear.uncertain import StateGroup
from malta.proof.groups import A, B, C, D, E, UncertainLoop, divide_by_descriptor, rational
from malta.proof.polynomial.closed_loop import (
    closed_loop,
    coefficient_bounds,
    coefficients,
    dense,
    driven_group,
    majorant_matrix,
)
from malta.proof.polynomial.minors import Minors, Resolvent, minors

# Degrees of a characteristic polynomial in each parameter, upper bounds read from the entries of the matrices.


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
    return i in s.program.reach[s.atoms[atom]]


def clear_denominators(loop: UncertainLoop, g: StateGroup, s: Symbolic) -> list[dict[Any, Any]]:
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
    found, common = over_common_denominator(row)
    return found if common is None else found | {None: common}


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


MAX_KEPT_PLACES = 20_000  # places that are remembered
PLACE = 2.5e-4  # work of a place
STEP, STATES_WORK = 2e-6, 1e-6  # work of an operation of the model, and times the cube of the states


@dataclass(frozen=True, eq=False)
class Characteristic:
    """The characteristic polynomial of one group of a loop."""

    loop: UncertainLoop
    group: StateGroup

    @property
    def names(self) -> tuple[str, ...]:
        return self.loop.system.names

    @property
    def foreign(self) -> tuple[str, ...]:
        """The operations of the model without an enclosure."""
        return self.loop.program.foreign

    @property
    def implicit(self) -> bool:
        return self.loop.program.implicit

    @property
    def discrete(self) -> bool:
        return self.loop.law.sample_time is not None

    @cached_property
    def exact(self) -> bool:
        """Whether the coefficients are rational in p, so that their degrees are known."""
        return self.loop.symbolic is not None and self.loop.program.rational and not self.loop.sampled

    @property
    def _coupled_descriptor(self) -> bool:
        s = self.loop.symbolic
        return self.loop.descriptor and s is not None and any(i != j for i, j in s.entries[E])

    @cached_property
    def inverted(self) -> tuple[bool, ...]:
        """Whether a parameter enters a sampled loop as a polynomial of 1 / p, as a mass does."""
        s = self.loop.symbolic
        if self.exact or s is None:
            return (False,) * len(self.names)
        found, entries, g = [], divide_by_descriptor(self.loop, s), set(self.group.states)
        own = [r for (k, j), r in entries[A].items() if k in g and j in g]
        own += [r for (k, _), r in entries[B].items() if k in g]
        own += [r for (_, j), r in entries[C].items() if j in g]
        own += list(entries[D].values()) if self.loop.direct else []
        for i in range(len(self.names)):
            powers: list[tuple[int, int | None]] = [(degree(r.num, i), sole_power(r.den, i)) for r in own]
            below = any(den not in (0, None) for _, den in powers)
            hidden = any(depends(s, k, i) for k in range(len(s.atoms)))
            polynomial = all(den is not None and num <= den for num, den in powers)
            found.append(below and polynomial and not hidden and not self._coupled_descriptor)
        return tuple(found)

    @cached_property
    def degrees(self) -> tuple[int | None, ...]:
        """An upper bound of the degree in each parameter, read from the entries; None for no polynomial."""
        if self.exact:
            assert self.loop.symbolic is not None
            rows = clear_denominators(self.loop, self.group, self.loop.symbolic)
            return tuple(determinant_degree(rows, i) for i in range(len(self.names)))
        return tuple(self._degree_by_minors(i) for i in range(len(self.names)))

    def _degree_by_minors(self, i: int) -> int | None:
        """The degree in a parameter of B and C alone, by minors (Cauchy, Binet); 0 when it enters no matrix."""
        s, g, program = self.loop.symbolic, self.group, self.loop.program
        if not any(i in on for on in program.depends):
            return 0
        if s is None or i in program.depends[A] or self.loop.direct or self.loop.descriptor:
            return None if s is None or self._depends_on(s, i) else 0
        if any(depends(s, k, i) for k in range(len(s.atoms))):
            return None
        into = {at: r for at, r in s.entries[B].items() if at[0] in g.states}
        out = {at: r for at, r in s.entries[C].items() if at[1] in g.states}
        if any(r.den is not None and degree(r.den, i) for r in (*into.values(), *out.values())):
            return None
        total = 0
        for matrix in (into, out):
            rows = [[(degree(r.num, i), at) for at, r in matrix.items() if degree(r.num, i)]]
            if rows[0]:
                order = min(len({at[0] for _, at in rows[0]}), len({at[1] for _, at in rows[0]}))
                total += order * max(d for d, _ in rows[0])
        return total

    def _depends_on(self, s: Symbolic, i: int) -> bool:
        """Whether the group's own entries depend on a parameter, atoms included."""
        g = set(self.group.states)
        rows: list[tuple[int, int | None]] = [(A, 0), (B, 0), (C, 1)]
        if len(s.entries) > D:
            rows += [(which, None) for which in range(D, len(s.entries))]
        hidden = [s.inputs + k for k in range(len(s.atoms)) if depends(s, k, i)]
        for which, side in rows:
            for at, r in s.entries[which].items():
                if side is None or at[side] in g:
                    for var in (i, *hidden):
                        if degree(r.num, var) or (r.den is not None and degree(r.den, var)):
                            return True
        return False

    @cached_property
    def minors(self) -> Minors | None:
        return minors(self.loop, self.group)

    @cached_property
    def price(self) -> float:
        """The work of the coefficients at one place."""
        return PLACE + STEP * len(self.loop.program.steps) + STATES_WORK * len(self.group.states) ** 3

    # values

    def at(self, v: Sequence[Any]) -> list[Any]:
        """a_0 ... a_N at p = v (1 / v of inverted parameters), as exact rationals or balls.

        Raises NotAnalytic when the matrices have no value there.
        """
        p = [1 / x if inverted else x for x, inverted in zip(v, self.inverted, strict=True)]
        a = self._coefficients(p, fmpq_mat if self.exact else arb_mat)
        a = map_bilinear(a) if self.discrete else a
        if not self.exact:
            return a
        scale = _multiplier(self.loop, self.group, p)
        return [c * scale for c in a]

    def _coefficients(self, p: list[Any], matrix: Any) -> list[Any]:
        if self.minors is None:
            driven = driven_group(self.loop, self.group, self._entries(p), matrix)
            return [c * driven.det_E for c in coefficients(closed_loop(driven))]
        terms = [(x.p, x.q) for x in p]  # of which a hash takes an eighth of that of the quotient's
        known, place = self.minors.known, (ctx.prec, tuple(terms))
        if place not in known:
            for one in (known, self.minors.resolvents):
                if len(one) > MAX_KEPT_PLACES:
                    one.clear()
            known[place] = self._minors_at(p, terms, matrix)
        pi, beta = known[place]
        found = self.minors.combine(pi, beta, matrix)
        zero = 0 * found[0]
        return found + [zero] * (self.minors.degree + 1 - len(found))

    def _minors_at(self, p: list[Any], terms: list[Any], matrix: Any) -> tuple[Any, Any]:
        """pi and beta at given p, each remembered for the parameters that it depends on."""
        minors = self.minors
        assert minors is not None

        def remembered(known: dict[Any, Any], on: tuple[int, ...], made: Callable[[], Any]) -> Any:
            at = (ctx.prec, on, *(terms[i] for i in _parameters_of(self.loop.program, *on)))
            if at not in known:
                known[at] = made()
            return known[at]

        def resolvent() -> Resolvent:
            return minors.resolvent(self._entries(p, (A, E)), matrix)

        def plant() -> Any:
            made = remembered(minors.resolvents, (A, E), resolvent)
            return minors.plant(made, remembered(minors.known, (C,), lambda: self._entries(p, (C,))), matrix)

        pi = remembered(minors.known, (A, C, E), plant)
        return pi, remembered(minors.known, (B, E), lambda: minors.forces(self._entries(p, (B, E)), matrix))

    def _entries(self, p: list[Any], matrices: tuple[int, ...] = (A, B, C, D, E)) -> list[Any]:
        """The entries of these matrices at given p; none of the others."""
        program = self.loop.program.only(matrices)
        if not (self.exact or (self.loop.program.rational and self.loop.program.short)):
            return program.run([arb(x) for x in p], POINTS)
        return program.run(p, EXACT_ARITHMETIC)

    # bounds

    @cached_property
    def _polynomials(self) -> tuple[dict[tuple[int, int], tuple[dict[Any, Any], dict[Any, Any] | None]], ...]:
        """The entries as polynomials of v over polynomials without the inverted parameters."""
        assert self.loop.symbolic is not None
        picked = [i for i, inverted in enumerate(self.inverted) if inverted]
        found, g = [], set(self.group.states)
        for which, matrix in enumerate(divide_by_descriptor(self.loop, self.loop.symbolic)[: D + 1]):
            turned = {}
            for at, r in matrix.items():
                if (which in (A, B) and at[0] not in g) or (which in (A, C) and at[1] not in g):
                    continue
                powers = {i: sole_power(r.den, i) or 0 for i in picked}

                def flip(polynomial: Any, powers: dict[int, int]) -> dict[Any, Any]:
                    return {
                        tuple(powers[i] - e if i in powers else e for i, e in enumerate(m)): c
                        for m, c in polynomial.to_dict().items()
                    }

                den = None if r.den is None else flip(r.den, powers)
                turned[at] = flip(r.num, powers), den
            found.append(turned)
        return tuple(found)

    def _balls(self, v: Sequence[Any]) -> list[list[tuple[int, int, Any]]]:
        """The entries of the matrices over balls of v."""
        if not any(self.inverted):
            return self.loop.program.run(v, BALLS)
        s = self.loop.symbolic
        assert s is not None
        values = list(v)
        if s.atoms:  # none of them depends on an inverted parameter
            p = [acb(1) if inverted else x for x, inverted in zip(v, self.inverted, strict=True)]
            steps = self.loop.program.cells(p, BALLS)
            values += [steps[k] for k in s.atoms]
        return [
            [
                (*at, value(num, values) if den is None else finite(value(num, values) / value(den, values)))
                for at, (num, den) in matrix.items()
            ]
            for matrix in self._polynomials
        ]

    def coupling_bounds(
        self, moves: Sequence[Any], sides: Sequence[tuple[Any, Any]]
    ) -> list[tuple[float, int]] | None:
        """Bounds of the change of each coefficient by neglected couplings (closed_loop.py): (mantissa, exponent).

        moves : bounds by powers of s or g; sides : the box, ends of each parameter
        """
        if not moves:
            return None
        law, total = self.loop.law, list(moves)
        degree = len(self.group.states) + len(self.group.own)
        acting = self.minors.rows if self.minors is not None else self._acting
        lags = len(acting) if law.lag is not None else 0
        if self.discrete:  # |z - a| <= 2 of a lag, |z| = 1 of stored inputs
            whole, part = split_delay(law.delay)
            degree += lags + len(acting) * (part > 0)
            degree += whole * (self.minors.order if self.minors is not None else len(acting))
            scale = self._row_factors(sides)
            total = [c * 2**lags * scale for c in total] + [arb(0)] * (degree + 1 - len(total))
            return [pair(c) for c in map_bounds(total)]
        for _ in range(lags):
            rate = arb(law.lag)
            total = [
                (total[j - 1] if j else 0) + (total[j] * rate if j < len(total) else 0)
                for j in range(len(total) + 1)
            ]
        scale = self._row_factors(sides)
        total += [arb(0)] * (degree + lags + 1 - len(total))
        return [pair(c * scale) for c in total]

    def _row_factors(self, sides: Sequence[tuple[Any, Any]]) -> Any:
        """A bound of what multiplies the coefficients beside those of the divided matrices: denominators, and det E."""
        scale, p = arb(1), [acb(low).union(acb(high)) for low, high in sides]
        if self.exact:
            for den in _denominators(self.loop, self.group):
                scale *= abs(value(den.to_dict(), p))
        if self.loop.descriptor:
            scale *= self._descriptor_size(self.loop.program.run(p, BALLS)[E])
        return scale

    def _descriptor_size(self, entries: Sequence[tuple[int, int, Any]]) -> Any:
        """A bound of |det E| of the group."""
        x = {state: k for k, state in enumerate(self.group.states)}
        own = [(x[i], x[j], z) for i, j, z in entries if i in x and j in x]
        return abs(dense(acb_mat, len(x), len(x), own).det())

    def _factors(self, v: Sequence[Any]) -> Any:
        """A bound of the factors that `at` gives the coefficients beside the charpoly: det E, det(I - D_c D), and the
        denominators of exact rows."""
        size, p_of_v = (
            arb(1),
            [1 / x if inverted else x for x, inverted in zip(v, self.inverted, strict=True)],
        )
        entries = self.loop.program.run(p_of_v, BALLS) if self.loop.descriptor or self.loop.direct else []
        if self.loop.descriptor:
            size *= self._descriptor_size(entries[E])
        if self.loop.direct:
            m, p = self.loop.program.shapes[B][1], self.loop.program.shapes[C][0]
            w = acb_mat(rational(self.loop.law.D)) * dense(acb_mat, p, m, entries[D])
            size *= abs((dense(acb_mat, m, m, ((i, i, 1) for i in range(m))) - w).det()).max(arb(1))
        if self.exact and self.loop.symbolic is not None:
            for den in _denominators(self.loop, self.group):
                size *= abs(value(den.to_dict(), p_of_v)).max(arb(1))
        return size

    @property
    def _acting(self) -> tuple[int, ...]:
        """The inputs of the group's own matrix."""
        inputs = self.group.inputs
        return tuple(range(self.loop.program.shapes[B][1])) if inputs is None else inputs

    @np.errstate(over="ignore", invalid="ignore")  # bounds that overflow are refused
    def majorant(self, v: Sequence[Any]) -> list[tuple[float, int]]:
        """Upper bounds of |a_k| for all complex v in these balls: (mantissa, exponent) of each.

        Raises NotAnalytic when the matrices are not analytic on them.
        """
        if self.minors is None:
            size = majorant_matrix(self.loop, self.group, self._balls(v))
            product = coefficient_bounds(size, np.ones(len(size)))
        else:
            known, where = self.minors.known, tuple(_ends_of(x) for x in v)
            if where not in known:
                known[where] = self.minors.sizes(self._balls(v))
            product = self.minors.majorant(known[where])
        size = self._factors(v)
        product = [c * size for c in product]
        return [pair(c) for c in (map_bounds(product) if self.discrete else product)]


def map_bounds(product: list[Any]) -> list[Any]:
    """Bounds of the coefficients of v from those of g."""
    n = len(product) - 1
    return list((_absolute_bilinear(n, ctx.prec) * arb_mat(n + 1, 1, product)).entries())


def _ends_of(x: Any) -> tuple[Any, ...]:
    """A complex ball as exact numbers, which can be compared and hashed."""
    return tuple(part.man_exp() for one in (x.real, x.imag) for part in (one.mid(), one.rad()))


def pair(c: Any) -> tuple[float, int]:
    """An upper bound of |c|: mantissa and exponent. Raises NotAnalytic when c is not finite."""
    if not c.is_finite():
        raise NotAnalytic("numbers that overflow")
    m, e = (int(i) for i in c.abs_upper().man_exp())
    if m == 0:
        return 0.0, 0
    shift = max(m.bit_length() - 50, 0)
    return float((m >> shift) + 1), e + shift


@lru_cache(maxsize=256)
def _parameters_of(program: MatrixProgram, *matrices: int) -> tuple[int, ...]:
    return tuple(sorted(frozenset().union(*(on for k, on in enumerate(program.depends) if k in matrices))))


@lru_cache(maxsize=64)
def _denominators(loop: UncertainLoop, g: StateGroup) -> tuple[Any, ...]:
    assert loop.symbolic is not None
    return tuple(row[None] for row in clear_denominators(loop, g, loop.symbolic) if None in row)


def _multiplier(loop: UncertainLoop, g: StateGroup, p: Sequence[Any]) -> Any:
    found = fmpq(1)
    for den in _denominators(loop, g):
        found *= den(*p)
    return found


@lru_cache(maxsize=64)
def _bilinear(n: int) -> Any:
    """The matrix from the coefficients a_k of sum a_k g^k to those of (1 - v)^n sum a_k (2 v / (1 - v))^k."""
    table = [[fmpq(0)] * (n + 1) for _ in range(n + 1)]
    for k in range(n + 1):
        for j in range(n - k + 1):
            table[k + j][k] += fmpq(2**k * math.comb(n - k, j) * (-1) ** j)
    return fmpq_mat(table)


def bilinear_table(n: int) -> Any:
    """The matrix from coefficients of g to those of v, as balls."""
    return arb_mat(_bilinear(n))


def map_bilinear(a: list[Any]) -> list[Any]:
    table = _bilinear(len(a) - 1)
    if isinstance(a[-1], fmpq) or isinstance(a[0], fmpq):
        return list((table * fmpq_mat(len(a), 1, a)).entries())
    return list((_bilinear_balls(len(a) - 1, ctx.prec) * arb_mat(len(a), 1, a)).entries())


@lru_cache(maxsize=64)
def _bilinear_balls(n: int, bits: int) -> Any:
    del bits  # of the current precision
    return arb_mat(_bilinear(n))


@lru_cache(maxsize=64)
def _absolute_bilinear(n: int, bits: int) -> Any:
    return arb_mat(n + 1, n + 1, [abs(x) for x in _bilinear_balls(n, bits).entries()])
