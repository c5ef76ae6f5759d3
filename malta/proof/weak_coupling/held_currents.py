"""Machines with currents held between samples, anywhere in their travel, as perturbed double integrators.

    q'' = Z(p, y) q - E(p, y) (q - r) + B(p, y) v,    r: the reading at which the currents were commutated

B is close to a diagonal of monomials b_i(p). Z and E are the stiffness of currents at another place than that of their
commutation; Z is the lower left block of A = [[0, 1], [Z, 0]] in `jacobians`. The matrices are enclosed for every y of
the travel at once (taylor.py), as sums of monomials of p with coefficients in intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from flint import arb

from malta.arrays import FloatArray
from malta.linear.expressions import NotAnalytic, program
from malta.proof.weak_coupling import taylor
from malta.proof.weak_coupling.taylor import Evaluation, Laurent, Monomial, Value

INTERVALS = 160  # pieces of the travel
REST_FORCE_TOLERANCE = 1e-5  # half width, relative to the largest force; checked over each box


class Ranged(NamedTuple):
    """A sum of monomials of p whose coefficients lie in intervals for every y."""

    terms: tuple[tuple[Monomial, float, float], ...]


class Lead(NamedTuple):
    """coefficient p^monomial."""

    coefficient: float
    monomial: Monomial


Table = Mapping[tuple[int, int], Ranged]
Balls = Mapping[tuple[int, int], list[tuple[Any, Monomial]]]  # of a Table: coefficients and monomials


class MatrixBounds(NamedTuple):
    """Entrywise bounds of matrices over a box."""

    Z: FloatArray
    beside: FloatArray  # of Z without the k_i
    E: FloatArray
    shares: FloatArray  # of B b^-1 - 1
    b: FloatArray


@dataclass(frozen=True, eq=False)
class HeldMachine:
    """A machine anywhere in an interval of positions, in n axes.

    lead : b_i of each axis
    stiff : the stiffness k_i of each axis for itself, as far as it is one monomial of sure sign for every y; else zero
    Z, E, shares : Z and E as above, B b^-1 - 1
    ratios, rest : of the forces at rest, v = v0 + (1 + K)^-1 x, K in `ratios` and x in `rest`, relative to the half
        width that was assumed of v
    """

    names: tuple[str, ...]
    nominal: FloatArray
    lead: tuple[Lead, ...]
    stiff: tuple[Lead, ...]
    Z: Table
    E: Table
    shares: Table
    ratios: Table
    rest: Table
    travel: tuple[float, float]
    models: tuple[Mapping[tuple[int, int], Laurent], ...]  # Z, E, shares, ratios and rest as functions of y

    @cached_property
    def _balls(self) -> tuple[Balls, ...]:
        """Z, Z without the k_i, E and the others, with balls for coefficients."""
        tables = self.Z, _without(self.Z, self.stiff), self.E, self.shares, self.ratios, self.rest
        return tuple(
            {at: [(arb(a).union(arb(b)), m) for m, a, b in entry.terms] for at, entry in table.items()}
            for table in tables
        )

    def bounds(self, p: Sequence[Any]) -> MatrixBounds:
        """Entrywise bounds over real balls p.

        Raises NotAnalytic when a bound is infinite, or when the forces at rest leave their assumed range.
        """
        n, known = len(self.lead), dict[Monomial, Any]()

        def monomial(m: Monomial) -> Any:
            if m not in known:
                total = arb(1)
                for x, e in zip(p, m, strict=True):
                    if e:
                        total *= x**e if e > 0 else 1 / x**-e
                known[m] = total
            return known[m]

        def size(table: Balls) -> FloatArray:
            found = np.zeros((n, n))
            for at, terms in table.items():
                total = sum((c * monomial(m) for c, m in terms), arb(0))
                found[at] = float(total.abs_upper()) * (1 + 1e-9)
            return found

        b = np.array([float((arb(c) * monomial(m)).abs_upper()) * (1 + 1e-9) for c, m in self.lead])
        return self._check(b, [size(t) for t in self._balls])

    def _check(self, b: FloatArray, sizes: Sequence[FloatArray]) -> MatrixBounds:
        """The bounds of these sizes. Raises NotAnalytic as `bounds` does."""
        Z, beside, E, shares, ratios, rest = sizes
        if not all(np.isfinite(M).all() for M in (Z, beside, E, shares, ratios, rest, b)):
            raise NotAnalytic("a parameter that divides reaches zero")
        if self.rest and not (dominating_solution(ratios, rest[:, :1]) <= 1).all():
            raise NotAnalytic("forces at rest that are not what they were taken for")
        return MatrixBounds(Z, beside, E, shares, b)

    @cached_property
    def _sums(self) -> tuple[FloatArray, FloatArray, tuple[tuple[list[Any], FloatArray, FloatArray], ...]]:
        """Of b the coefficients, exponents of all monomials, those of b first, and of each table of `_balls` the
        places, the middles of coefficients and their half widths: places x monomials."""
        tables = self.Z, _without(self.Z, self.stiff), self.E, self.shares, self.ratios, self.rest
        known = {
            m: k for k, m in enumerate(m for t in tables for entry in t.values() for m, _, _ in entry.terms)
        }
        column = {m: len(self.lead) + k for k, m in enumerate(known)}
        found = []
        for table in tables:
            ends = np.zeros((2, len(table), len(self.lead) + len(column)))
            for row, entry in enumerate(table.values()):
                for m, a, b in entry.terms:
                    ends[:, row, column[m]] += a, b
            found.append((list(table), ends.sum(axis=0) / 2, np.abs(ends[1] - ends[0]) / 2))
        exponents = np.array([*(m for _, m in self.lead), *column], dtype=float)
        return np.array([c for c, _ in self.lead]), exponents.reshape(-1, len(self.names)), tuple(found)

    def bounds_near(self, p: FloatArray) -> MatrixBounds:
        """The bounds at one p in doubles, to rounding: to choose by, not to prove with.

        Raises NotAnalytic as `bounds` does.
        """
        leads, exponents, tables = self._sums
        n, sizes = len(self.lead), []
        with np.errstate(all="ignore"):
            values = np.prod(p**exponents, axis=1)
            for places, middle, half in tables:
                found = np.zeros((n, n))
                if places:
                    i, j = np.array(places).T
                    found[i, j] = np.abs(middle @ values) + half @ np.abs(values)
                sizes.append(found)
            return self._check(np.abs(leads * values[:n]), sizes)

    def at(self, y: float) -> HeldMachine:
        """The machine at one position of the interval, enclosed as on the piece that holds it."""
        low, high = self.travel
        k = min(max(math.floor((y - low) / (high - low) * INTERVALS), 0), INTERVALS - 1)
        pieces = range(max(k - 1, 0), k + 2)  # k may be off by one from rounding
        Z, E, shares, ratios, rest = _tables(self.models, pieces)
        return replace(
            self,
            stiff=_stiffness(Z, self.nominal, len(self.lead)),
            Z=Z,
            E=E,
            shares=shares,
            ratios=ratios,
            rest=rest,
        )


def dominating_solution(M: FloatArray, right: FloatArray) -> FloatArray:
    """An upper bound of (1 + M + M^2 + ...) right, entrywise, for M and right without negative entries.

    Any S > M S + right is such a bound and shows that the sum is finite.

    Raises NotAnalytic when no such S is found.
    """
    floor = 1e-9 * right.max(axis=1, keepdims=True, initial=0.0) + 1e-290
    with np.errstate(all="ignore"):
        S: FloatArray = np.linalg.solve(np.eye(len(M)) - M, right + floor) * (1 + 1e-9)
        fine = np.isfinite(S).all() and (S > 0).all() and ((M @ S + right) * (1 + 1e-12) < S).all()
    if not fine:
        raise NotAnalytic("a coupling that may be singular")
    return S


def held_machine(
    of: ca.Function, names: Sequence[str], nominal: FloatArray, travel: tuple[float, float]
) -> HeldMachine:
    """Enclose a machine whose currents are held, for all positions of an interval.

    of : its design model as a function of parameters, position and commands, from loops.parametric_plants.model_of
    names, nominal : of the parameters

    Raises NotAnalytic when the model has not this form.
    """
    names, n, k = tuple(names), of.size1_in(2), len(names)
    q = ca.SX.sym("q", k + 1 + n)
    outputs = of(q[:k], q[k], q[k + 1 :])
    _require_linear(outputs, q[k + 1 :], of(q[:k], q[k], ca.SX.zeros(n))[4])
    wanted, room = _forces_at_rest(of, nominal, sum(travel) / 2, n)
    run = Evaluation(k, *travel, INTERVALS)
    v = [_interval_about(run, x, room) for x in wanted]
    model = program(ca.Function("model", [q], list(outputs)))
    entries = run.run(model, [*map(run.parameter, range(k)), run.y, *v])
    A, B, C, E, _, ratio, preload = ({(i, j): x for i, j, x in matrix} for matrix in entries)
    if {(i, i): 1.0 for i in range(n)} != C or of.size1_out(0) != 2 * n:
        raise NotAnalytic("outputs that are not the positions")
    upper = {at: x for at, x in A.items() if at[0] < n}
    if upper != {(i, i + n): 1.0 for i in range(n)} or any(i < n for i, _ in (*B, *E)):
        raise NotAnalytic("states that are not positions and their rates")
    if any(i >= n and j >= n for i, j in A):
        raise NotAnalytic("damping of the machine's own")

    def lower(matrix: dict[tuple[int, int], Value], columns: int) -> dict[tuple[int, int], Value]:
        return {(i - n, j): x for (i, j), x in matrix.items() if i >= n and j < columns}

    lead, shares = _relative_shares(run, lower(B, n), nominal, n)
    by, ratios = _relative_shares(run, ratio, nominal, n)
    rest = _residual_forces(run, ratio, preload, wanted, by)
    rest = {at: _divide(run, x, room) for at, x in rest.items()} if room.coefficient else {}
    models = tuple(
        {at: run.laurent(x) for at, x in table.items()}
        for table in (lower(A, n), lower(E, n), shares, ratios, rest)
    )
    tables = _tables(models)
    return HeldMachine(names, nominal, lead, _stiffness(tables[0], nominal, n), *tables, travel, models)


def _require_linear(outputs: Sequence[Any], v: Any, at_zero: Any) -> None:
    """Raise NotAnalytic unless forces are proportional to the commands v."""
    for k, order in ((0, 2), (3, 2), (4, 2), (1, 1), (5, 1)):
        if any(ca.which_depends(ca.vec(outputs[k]), v, order, False)):
            raise NotAnalytic("forces that are not proportional to what is wanted")
    if not at_zero.is_zero():
        raise NotAnalytic("forces where none are wanted")


def _forces_at_rest(of: ca.Function, nominal: FloatArray, y: float, n: int) -> tuple[list[Lead], Lead]:
    """The commands at which the preload acts, as approximate monomials of p, and the half width assumed of them."""

    def at(p: FloatArray) -> FloatArray:
        found = of(p, y, np.zeros(n))
        return np.linalg.solve(np.array(found[5]), np.array(found[6])).ravel()

    v = at(nominal)
    v[np.abs(v) < 1e-6 * np.abs(v).max(initial=0.0)] = 0.0
    powers = np.zeros((n, len(nominal)))
    for i, x in enumerate(nominal):
        moved = at(np.where(np.arange(len(nominal)) == i, 1.25 * x, nominal))
        with np.errstate(all="ignore"):
            powers[:, i] = np.where(v != 0, np.log(np.abs(moved / v)) / math.log(1.25), 0)
    found = []
    for x, own in zip(v, np.round(powers), strict=True):
        scale = float(np.prod(nominal**own)) if x else 1.0
        found.append(Lead(float(x / scale) if x else 0.0, tuple(int(e) for e in own)))
    top = found[int(np.abs(v).argmax())]
    return found, Lead(REST_FORCE_TOLERANCE * abs(top.coefficient), top.monomial)


def _interval_about(run: Evaluation, wanted: Lead, room: Lead) -> Value:
    if not room.coefficient:
        return 0.0
    none = taylor.constant(0.0, run.count)
    open_ = Laurent({room.monomial: taylor.Taylor(none.c, none.radius + room.coefficient)})
    value = Laurent({wanted.monomial: taylor.constant(wanted.coefficient, run.count)})
    return run.sum(value, open_) if wanted.coefficient else open_


def _relative_shares(
    run: Evaluation, matrix: dict[tuple[int, int], Value], nominal: FloatArray, n: int
) -> tuple[tuple[Lead, ...], dict[tuple[int, int], Value]]:
    """The largest monomial of each diagonal entry, and the matrix over these, column by column, less one."""
    leads = []
    for j in range(n):
        if (j, j) not in matrix:
            raise NotAnalytic("a force that does not act on its own axis")
        terms = run.laurent(matrix[j, j]).terms
        weights = {m: float(np.prod(np.abs(nominal) ** np.array(m))) for m in terms}
        m = max(terms, key=lambda m: weights[m] * float(np.abs(terms[m].c[0]).max()))
        leads.append(Lead(sum(terms[m].bounds()) / 2, m))
        if not leads[-1].coefficient:
            raise NotAnalytic("a force that does not act on its own axis")
    found: dict[tuple[int, int], Value] = {}
    for (i, j), x in matrix.items():
        over = _divide(run, x, leads[j])
        found[i, j] = run.sum(over, -1.0) if i == j else over
    return tuple(leads), found


def _stiffness(Z: Table, nominal: FloatArray, n: int) -> tuple[Lead, ...]:
    """The largest monomial of each diagonal entry, where its sign is sure; its coefficient is amid the interval."""
    found = []
    for i in range(n):
        terms = Z[i, i].terms if (i, i) in Z else ()
        surest = max(
            terms,
            key=lambda t: abs(t[1] + t[2]) * float(np.prod(np.abs(nominal) ** np.array(t[0]))),
            default=((0,) * len(nominal), 0.0, 0.0),
        )
        m, low, high = surest
        found.append(Lead((low + high) / 2 if low * high > 0 else 0.0, m))
    return tuple(found)


def _without(Z: Table, stiff: tuple[Lead, ...]) -> Table:
    """Z without k_i on its diagonal."""
    found = dict(Z)
    for i, (c, m) in enumerate(stiff):
        if c:
            terms = tuple((n, *((a - c, b - c) if n == m else (a, b))) for n, a, b in Z[i, i].terms)
            found[i, i] = Ranged(terms)
    return found


def _divide(run: Evaluation, x: Value, lead: Lead) -> Value:
    one = taylor.constant(lead.coefficient, run.count)
    return run.product(x, Laurent({tuple(-e for e in lead.monomial): taylor.inverse(one)}))


def _residual_forces(
    run: Evaluation,
    ratio: dict[tuple[int, int], Value],
    preload: dict[tuple[int, int], Value],
    wanted: list[Lead],
    by: tuple[Lead, ...],
) -> dict[tuple[int, int], Value]:
    """b^-1 (preload - ratio v0), b the diagonal of the ratio: the error of the commands v0 at rest."""
    found: dict[tuple[int, int], Value] = {(i, 0): x for (i, _), x in preload.items()}
    for (i, j), x in ratio.items():
        c, m = wanted[j]
        if c:
            made = run.product(x, Laurent({m: taylor.constant(-c, run.count)}))
            found[i, 0] = run.sum(found[i, 0], made) if (i, 0) in found else made
    return {(i, 0): _divide(run, x, by[i]) for (i, _), x in found.items()}


def _tables(
    models: Sequence[Mapping[tuple[int, int], Laurent]], pieces: range | None = None
) -> tuple[Table, Table, Table, Table, Table]:
    """The ranges of the coefficients on all pieces of the travel, or on some."""

    def ranges_of(x: Laurent) -> Ranged:
        return Ranged(tuple((m, *c.bounds(pieces)) for m, c in x.terms.items()))

    Z, E, shares, ratios, rest = ({at: ranges_of(x) for at, x in table.items()} for table in models)
    return Z, E, shares, ratios, rest
