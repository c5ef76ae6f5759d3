"""The closed loop as a pencil in v that is linear in the parameters, with bounds of the nonlinear terms.

    M(v) = P_0 + sum_i delta_i P_0i + R_0 + v (P_1 + sum_i delta_i P_1i + R_1),   |delta_i| <= 1, |R_k| <= bounds

It is singular on v = jx, x from 0 to infinity, exactly where the loop is on the boundary of stability. Rows are
multiplied by their denominators, so that masses, springs and dampers enter linearly. v is s in continuous time,
(z - 1) / (z + 1) otherwise: a row z a - b becomes (a - b) + v (a + b).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.linear.rational import TooLarge
from malta.linear.sampling import split_delay
from malta.linear.uncertain import StateGroup
from malta.proof.groups import C, UncertainLoop
from malta.proof.polynomial.characteristic import clear_denominators

# Matrices over a box of parameters to first order: M(p) = M_0 + sum_i delta_i M_i + rest, with |delta_i| <= 1.


EPS = 2.0**-52


@dataclass(frozen=True, eq=False)
class BoxTerms:
    """The value in the middle of the box, slopes per half side, and an entrywise bound of the error with rounding."""

    middle: FloatArray  # n x m
    slopes: FloatArray  # P x n x m
    rest: FloatArray  # n x m

    @property
    def size(self) -> FloatArray:
        return np.asarray(np.abs(self.middle) + np.abs(self.slopes).sum(axis=0))

    def __add__(self, other: BoxTerms) -> BoxTerms:
        rest = self.rest + other.rest + 2 * EPS * (self.size + other.size)
        return BoxTerms(self.middle + other.middle, self.slopes + other.slopes, rest)

    def times(self, a: float) -> BoxTerms:
        rest = abs(a) * (self.rest + 2 * EPS * self.size)
        return BoxTerms(a * self.middle, a * self.slopes, rest * (1 + 4 * EPS))

    def columns(self, gains: FloatArray) -> BoxTerms:
        """The product with a constant matrix from the right."""
        rest = (self.rest + 4 * (len(gains) + 1) * EPS * self.size) @ np.abs(gains)
        return BoxTerms(self.middle @ gains, self.slopes @ gains, rest * (1 + 1e-12))

    def part(self, rows: slice, columns: slice) -> BoxTerms:
        return BoxTerms(self.middle[rows, columns], self.slopes[:, rows, columns], self.rest[rows, columns])


def constant(matrix: FloatArray, count: int) -> BoxTerms:
    """A matrix that depends on none of `count` parameters."""
    return BoxTerms(matrix, np.zeros((count, *matrix.shape)), np.zeros(matrix.shape))


def stack(rows: Sequence[Sequence[BoxTerms]]) -> BoxTerms:
    """A matrix from rows of blocks."""
    return BoxTerms(
        np.vstack([np.hstack([part.middle for part in row]) for row in rows]),
        np.concatenate([np.concatenate([part.slopes for part in row], axis=2) for row in rows], axis=1),
        np.vstack([np.hstack([part.rest for part in row]) for row in rows]),
    )


@dataclass(frozen=True, eq=False)
class PolynomialTable:
    """A matrix of polynomials in p: monomials, each with its place."""

    shape: tuple[int, int]
    places: Any  # row and column
    powers: Any
    gains: FloatArray

    def over(self, c: FloatArray, r: FloatArray) -> BoxTerms:
        """The expansion on |p - c| <= r."""
        e, count = self.powers, len(c)
        each = np.where(e > 0, c, 1.0) ** e
        middle = self.gains * each.prod(axis=1)
        size = np.abs(self.gains) * (np.where(e > 0, np.abs(c) + r, 1.0) ** e).prod(axis=1)
        slopes, linear = np.zeros((count, *self.shape)), np.abs(middle)
        for i in range(count):
            if r[i] > 0 and (e[:, i] > 0).any():
                rest = np.delete(each, i, axis=1).prod(axis=1)
                own = self.gains * rest * e[:, i] * c[i] ** np.maximum(e[:, i] - 1, 0) * r[i]
                slopes[i] = self._sum_terms(own)
                linear = linear + np.abs(own)
        # (|c| + r)^e less its value and slopes: terms of second order, none of them negative
        beyond = np.where(e.sum(axis=1) > 1, np.maximum(size - linear, 0), 0)
        rounding = 8 * (count + int(e.max(initial=1)) + 4) * EPS * size
        return BoxTerms(self._sum_terms(middle), slopes, self._sum_terms(beyond + rounding))

    def _sum_terms(self, values: FloatArray) -> FloatArray:
        found = np.zeros(self.shape)
        np.add.at(found, (self.places[:, 0], self.places[:, 1]), values)
        return found


def table(shape: tuple[int, int], entries: dict[tuple[int, int], Any], count: int) -> PolynomialTable:
    """The table of polynomials over the rationals in the first `count` of their variables."""
    places, powers, gains = [], [], []
    for at, polynomial in entries.items():
        for monomial, gain in polynomial.to_dict().items():
            places.append(at)
            powers.append([int(k) for k in monomial[:count]])
            gains.append(int(gain.p) / int(gain.q))
    k = len(gains)
    return PolynomialTable(
        shape,
        np.array(places, dtype=int).reshape(k, 2),
        np.array(powers, dtype=int).reshape(k, count),
        np.array(gains, dtype=float),
    )


# Matrix functions of a hold over a box of parameters, by power series: value, slopes, and a bound of what is left.
#
# With Y = T A, x+ - x = Phi_1(Y) T (A x + B u), so that multiplied by Y / (e^Y - 1) = 1 - Y / 2 + c(Y) the sampled
# loop holds A and B as they stand, and only c(Y) = Y^2 / 12 - Y^4 / 720 + ... is curved. Close to it is a continued
# fraction,
#
#     c = z^2 / (3 + z^2 / (5 + z^2 / (7 + ...))),    z = Y / 2,
#
# of which pencils hold the first levels by rows of their own. Where Y is too large for that series, e^Y itself is
# expanded. Beyond first order a function of Y_0 + E with coefficients b_k is bounded by the same function
# of moduli: f(|Y_0| + |E|) - f(|Y_0|) - f'(|Y_0|) |E|, with |b_k|.


BERNOULLI = 36  # terms of c
LEVELS = 3  # of the fraction: up to these, its coefficients have the sign of those of c and are not larger
MAX_SERIES_NORM = 4.8  # norm of Y up to which c is taken: its series ends at 2 pi
POWERS = 30  # of a matrix, towards its largest eigenvector
EXPONENTIAL = 80  # terms of e^Y
MAX_EXPONENTIAL_NORM = 16.0  # norm of Y up to which e^Y is


@lru_cache(maxsize=LEVELS + 1)
def gains_of_level(level: int) -> tuple[float, ...]:
    """Coefficients of c(Y), B_2k / (2 k)!, less those of its fraction, by powers of Y^2 from the first."""
    from flint import fmpq

    held = [fmpq(0)] * (BERNOULLI + 1)
    for k in range(level, 0, -1):  # Y^2 / 4 over 2 k + 1 + held
        inverse = [fmpq(1, 2 * k + 1)]
        for i in range(1, BERNOULLI):
            moved = sum((held[j] * inverse[i - j] for j in range(1, i + 1)), fmpq(0))
            inverse.append(-moved / (2 * k + 1))
        held = [fmpq(0), *(x / 4 for x in inverse)]
    found = []
    for k in range(1, BERNOULLI + 1):
        b = fmpq.bernoulli(2 * k) / math.factorial(2 * k) - held[k]
        found.append(int(b.p) / int(b.q))
    return tuple(found)


def quotient(A: BoxTerms, dens: BoxTerms) -> BoxTerms | None:
    """A over the diagonal of dens; None where that may vanish."""
    d0 = np.diag(dens.middle)[:, None]
    moved = np.diagonal(dens.slopes, axis1=1, axis2=2)[:, :, None]
    beside = np.diag(dens.rest)[:, None]
    share = (np.abs(moved).sum(axis=0) + beside) / np.abs(d0)
    if not (share < 0.98).all():
        return None
    middle = A.middle / d0
    slopes = (A.slopes - middle * moved) / d0
    rest = (A.rest + np.abs(middle) * beside) / np.abs(d0)
    size = np.abs(middle) + (np.abs(A.slopes / d0) + np.abs(middle * moved / d0)).sum(axis=0)
    rest = rest + 8 * EPS * size
    linear = np.abs(slopes).sum(axis=0)
    return BoxTerms(middle, slopes, (rest + (linear + rest) * share / (1 - share)) * (1 + 1e-12))


def square_hold_series(A: BoxTerms, dens: BoxTerms, T: float, *, level: int = 0) -> BoxTerms | None:
    """dens (1 + c(Y)) 2 + ... = 2 dens + 2 dens c(T A / dens); None where the series does not do.

    level : for c(Y) less its fraction up to this level, and no slopes of it but a bound
    """
    own = quotient(A, dens)
    if own is None:
        return None
    c = _function(own.times(T), gains_of_level(level), MAX_SERIES_NORM, even=True)
    if c is None:
        return None
    if level:
        moves = np.abs(c.slopes).sum(axis=0) * (1 + 1e-12)
        c = BoxTerms(c.middle, np.zeros_like(c.slopes), c.rest + moves)
    d0, moved = np.diag(dens.middle)[:, None], np.diagonal(dens.slopes, axis1=1, axis2=2)[:, :, None]
    beside, wide = np.diag(dens.rest)[:, None], np.abs(moved).sum(axis=0)
    linear = np.abs(c.slopes).sum(axis=0)
    whole = np.abs(c.middle) + linear + c.rest
    rest = (
        np.abs(d0) * c.rest
        + wide * (linear + c.rest)
        + beside * whole
        + 8 * EPS * (np.abs(d0) + wide) * whole
    )
    curved = BoxTerms(d0 * c.middle, d0 * c.slopes + moved * c.middle, rest)
    return (dens + curved).times(2.0)


def hold_series(A: BoxTerms, B: BoxTerms, dens: BoxTerms, T: float) -> tuple[BoxTerms, BoxTerms] | None:
    """e^(A T) - 1 and what u does over a sample, of A / dens and B / dens; None where they are too steep."""
    n, m, count = len(A.middle), B.middle.shape[1], len(A.slopes)
    one, two = quotient(A, dens), quotient(B, dens)
    if one is None or two is None:
        return None
    none = BoxTerms(np.zeros((m, n + m)), np.zeros((count, m, n + m)), np.zeros((m, n + m)))
    Y = stack([[one, two], [none]]).times(T)
    found = _function(
        Y, [1 / math.factorial(k) for k in range(1, EXPONENTIAL + 1)], MAX_EXPONENTIAL_NORM, even=False
    )
    if found is None:
        return None
    return found.part(slice(0, n), slice(0, n)), found.part(slice(0, n), slice(n, n + m))


def _function(Y: BoxTerms, b: Sequence[float], largest: float, *, even: bool) -> BoxTerms | None:
    """sum_k b_k Z^k, k from 1, with Z = Y, or Y^2 where even."""
    extra = np.abs(Y.slopes).sum(axis=0) + Y.rest
    size = np.abs(Y.middle)
    if not np.isfinite(extra + size).all():
        return None
    _, (units, _) = linalg.matrix_balance(size + extra, permute=False, separate=True)
    turn = units / units[:, None]
    size, extra, rest = size * turn, extra * turn, Y.rest * turn
    norm, weights = _norm(size + extra)
    if not norm < largest:
        return None
    middle, slopes = Y.middle * turn, Y.slopes * turn
    value, moved = _sum(middle, slopes, b, even)
    bound, linear = _sum(size, (extra - rest)[None], np.abs(b).tolist(), even)
    whole, _ = _sum(size + extra, np.zeros((0, *size.shape)), np.abs(b).tolist(), even)
    power = norm ** (2 if even else 1)
    ratio = power / (39.0 if even else len(b) + 1)
    last = gains_of_level(0)[-1] if even else b[-1]  # no smaller than with a level
    tail = abs(last) * power ** len(b) * ratio / (1 - ratio)
    rounding = 4 * len(b) * len(size) * EPS * whole
    tails = 2 * tail * weights[:, None] / weights
    left = np.maximum(whole - bound - linear[0], 0) + 4 * rounding + tails
    return BoxTerms(value / turn, moved / turn, left / turn)


def _norm(M: FloatArray) -> tuple[float, FloatArray]:
    """A norm of M and weights d for which M^k is at most norm^k d_i / d_j: M d <= norm d. M has no negative entries."""
    d: FloatArray = np.ones(len(M))
    shift = float(M.max(initial=0.0)) * np.eye(len(M))
    for _ in range(POWERS):
        d = np.maximum((M + shift) @ d, 1e-3)
        d = d / d.max(initial=1e-3)
    return float((M @ d / d).max(initial=0.0)) * (1 + 1e-12), d


def _sum(Y: FloatArray, slopes: FloatArray, b: Sequence[float], even: bool) -> tuple[FloatArray, FloatArray]:
    """The series at Y, and its derivatives along `slopes`."""
    Z, dZ = (Y @ Y, Y @ slopes + slopes @ Y) if even else (Y, slopes)
    power, moved = Z, dZ
    value, along = b[0] * Z, b[0] * dZ
    for gain in b[1:]:
        moved = moved @ Z + power @ dZ
        power = power @ Z
        value = value + gain * power
        along = along + gain * moved
    return value, along


TERMS = 20_000  # of all entries, beyond which they are not expanded
MAX_LIFTED_STATES = 8  # states up to which the fraction of a hold has rows of its own
MAX_LIFTED_ROWS = 40  # rows of a pencil with these, beyond the first level
# Largest ratio of bounds with and without these rows: where they cost little, and one level else.
MAX_BOUND_RATIOS = (0.2, 0.05)
MAX_COORDINATE_RATIO = 2  # times the coordinates of multipliers without these rows, that cost little


@dataclass(frozen=True, eq=False)
class Pencil:
    """M on a box. dynamic: rows with v, which are multiplied by 1 / v towards infinity."""

    constant: BoxTerms
    linear: BoxTerms
    dynamic: Any
    curved: bool  # whether a hold makes slopes of full rank and terms beyond them

    def branch(self, k: int) -> tuple[BoxTerms, BoxTerms]:
        """The constant part and the factor of jx (k = 1: of 1 / x) of M, for k = 1 of M / v in the dynamic rows."""
        if k == 0:
            return self.constant, self.linear
        d = self.dynamic

        def pick(one: BoxTerms, two: BoxTerms | None, sign: float) -> BoxTerms:
            zero = np.zeros_like(one.middle)
            return BoxTerms(
                np.where(d[:, None], sign * one.middle, zero if two is None else two.middle),
                np.where(d[:, None], sign * one.slopes, 0 if two is None else two.slopes),
                np.where(d[:, None], one.rest, zero if two is None else two.rest),
            )

        # P_1 + P_0 / (j x) = P_1 - j (1 / x) P_0
        return pick(self.linear, self.constant, 1.0), pick(self.constant, None, -1.0)


class Rows:
    """The rows of one group of a loop as polynomials in p, from which pencils over boxes are made.

    Raises TooLarge for more than TERMS.
    """

    def __init__(self, loop: UncertainLoop, group: StateGroup) -> None:
        s, law = loop.symbolic, loop.law
        assert s is not None
        self.loop, self.group, self.count = loop, group, loop.program.inputs
        n, p = len(group.states), self.count
        found, one = clear_denominators(loop, group, s), s.context.constant(1)
        if sum(len(polynomial) for row in found for polynomial in row.values()) > TERMS:
            raise TooLarge
        state = {j: k for k, j in enumerate(group.states)}
        self.inputs = sorted({at[1] for row in found for at in row if at is not None and at[0] == "u"})
        u = {j: k for k, j in enumerate(self.inputs)}
        self.reads = [
            k for k in range(loop.program.shapes[C][0])
            if any(at is not None for at in found[n + k])
            and (law.B[list(group.own), k].any() or law.D[self.inputs, k].any())
        ]  # fmt: skip
        y, m = len(self.reads), len(self.inputs)

        def pick(rows: list[dict[Any, Any]], kind: str, columns: dict[int, int]) -> PolynomialTable:
            entries = {
                (i, columns[at[1]]): polynomial
                for i, row in enumerate(rows)
                for at, polynomial in row.items()
                if at is not None and at[0] == kind
            }
            return table((len(rows), len(columns)), entries, p)

        def below(rows: list[dict[Any, Any]]) -> PolynomialTable:
            return table((len(rows),) * 2, {(i, i): row.get(None, one) for i, row in enumerate(rows)}, p)

        own, out = found[:n], [found[n + k] for k in self.reads]
        self.A, self.B, self.dens = pick(own, "x", state), pick(own, "u", u), below(own)
        self.E = pick(own, "e", state) if loop.descriptor else self.dens
        self.C, self.D, self.below = pick(out, "x", state), pick(out, "u", u), below(out)
        assert (self.C.shape, self.D.shape) == ((y, n), (y, m))

    @property
    def size(self) -> int:
        """The number of rows of the pencil."""
        late = len(self.inputs) * split_delay(self.loop.law.delay)[0]
        lifted = self.loop.sampled and len(self.group.states) <= MAX_LIFTED_STATES
        return self.driven * (2 if lifted else 1) + len(self.group.own) + late + len(self.reads)

    @property
    def driven(self) -> int:
        """The number of states of the machine with its lags."""
        law, n = self.loop.law, len(self.group.states)
        return n + (len(self.inputs) if law.lag is not None else 0)

    @property
    def cost(self) -> int:
        """The number of terms of all entries."""
        return sum(len(t.gains) for t in (self.A, self.B, self.C, self.D, self.E))

    def over(self, sides: FloatArray) -> Pencil | None:
        """The pencil on a box (P x 2); None when a denominator may vanish on it, or the sample is too long."""
        c = sides.mean(axis=1)
        r = np.where(
            sides[:, 1] > sides[:, 0], np.maximum(sides[:, 1] - c, c - sides[:, 0]) * (1 + 4 * EPS), 0
        )
        dens, below = self.dens.over(c, r), self.below.over(c, r)
        for d in (dens, below):
            least = np.abs(np.diag(d.middle)) - np.diag(np.abs(d.slopes).sum(axis=0) + d.rest)
            if not (least > 1e-9 * np.abs(np.diag(d.middle))).all():
                return None
        plant = self._plant(dens, c, r)
        return None if plant is None else self._join(plant, below, c, r)

    def _level(self, c: FloatArray) -> int:
        """The level up to which the fraction of c(Y) has rows of its own; with x_0 = x and z = Y / 2

            (2 k + 1) x_k + z x_k+1 = z x_k-1,    c(Y) x = z x_1 + what is beyond

        It has those when slopes of c(Y) alone have a much larger error over a tenth of the range of the parameters, and
        when the channels of the parameters, of which each level has its own, stay few.
        """
        T, r = self.loop.law.sample_time, 0.1 * np.abs(c)
        if T is None or not self.loop.sampled or len(self.group.states) > MAX_LIFTED_STATES:
            return 0
        A, dens = self.A.over(c, r), self.dens.over(c, r)
        whole = square_hold_series(A, dens, T)
        if whole is None:
            return 0
        with_rows, without = (
            sum(_rank(a, b) ** 2 for a, b in zip(A.slopes, other.slopes, strict=True))
            for other in (dens, whole)
        )
        for level in range(1, LEVELS + 1):
            if level > 1 and self.size + (level - 1) * self.driven > MAX_LIFTED_ROWS:
                break
            beyond = square_hold_series(A, dens, T, level=level)
            share = math.inf if beyond is None else beyond.rest.sum() / whole.rest.sum()
            cheap = (level + 1) ** 2 * with_rows <= MAX_COORDINATE_RATIO * without
            if (cheap and share < MAX_BOUND_RATIOS[0]) or (level == 1 and share < MAX_BOUND_RATIOS[1]):
                return level
        return 0

    def _plant(self, dens: BoxTerms, c: FloatArray, r: FloatArray) -> tuple[BoxTerms, ...] | None:
        """P_0 and P_1 of the rows of x and of the lags: the columns of these states, then of their inputs."""
        law, loop, T = self.loop.law, self.loop, self.loop.law.sample_time
        A, B = self.A.over(c, r), self.B.over(c, r)
        E = self.E.over(c, r) if loop.descriptor else dens
        if law.lag is not None:
            n, m = B.middle.shape
            own, none = constant(law.lag * np.eye(m), self.count), constant(np.zeros((m, n)), self.count)
            unit, beside = constant(np.eye(m), self.count), constant(np.zeros((n, m)), self.count)
            A = stack([[A, B], [none, own.times(-1)]])
            E, dens = (stack([[part, beside], [none, unit]]) for part in (E, dens))
            B = stack([[beside], [own]])
        if T is None:
            return A.times(-1), E, B.times(-1), B.times(0)
        if not loop.sampled:
            return E + A.times(-1), E + A, B.times(-1), B
        level = self._level(c)
        curved = square_hold_series(A, dens, T, level=level)
        if curved is not None:
            return A.times(-T), curved, B.times(-T), B.times(T), *[dens] * level
        found = hold_series(A, B, dens, T)
        if found is None:
            return None
        change, driven = found
        return (
            change.times(-1),
            change + constant(2 * np.eye(len(A.middle)), self.count),
            driven.times(-1),
            driven,
        )

    def _join(self, plant: tuple[BoxTerms, ...], below: BoxTerms, c: FloatArray, r: FloatArray) -> Pencil:
        """The whole pencil; its columns are x with lags, the compensator's states, stored inputs, y, and x_k of c."""
        law, own, late = self.loop.law, list(self.group.own), split_delay(self.loop.law.delay)[0]
        n, k, m, y = len(plant[0].middle), len(own), len(self.inputs), len(self.reads)
        dens = plant[4:]
        edges = np.cumsum([0, n, k, m * late, y, *[n] * len(dens)]).tolist()
        places = [slice(a, b) for a, b in pairwise(edges)]
        N, (x, w, _, z), levels = edges[-1], places[:4], places[4:]
        eye = np.eye(N)
        wanted = np.zeros((m, N))
        wanted[:, w], wanted[:, z] = law.C[np.ix_(self.inputs, own)], law.D[np.ix_(self.inputs, self.reads)]
        stored = [eye[n + k + m * d : n + k + m * (d + 1)] for d in range(late)]
        asked = np.zeros((k, N))
        asked[:, w], asked[:, z] = law.A[np.ix_(own, own)], law.B[np.ix_(own, self.reads)]
        P0, P1 = _PencilSum(N, self.count), _PencilSum(N, self.count)
        for P, of_x, of_u in ((P0, plant[0], plant[2]), (P1, plant[1], plant[3])):
            P.add(x, x, of_x)
            P.add(x, slice(0, N), of_u.columns([wanted, *stored][-1]))
        rows = [(w, asked)]
        for d, before in enumerate([wanted, *stored][:late]):
            rows.append((slice(n + k + m * d, n + k + m * (d + 1)), before))
        for at, given in rows:  # s w = a, or z w = a
            own_rows = constant(eye[at], self.count)
            part = constant(given, self.count)
            if law.sample_time is None:
                P0.add(at, slice(0, N), part.times(-1))
                P1.add(at, slice(0, N), own_rows)
            else:
                P0.add(at, slice(0, N), own_rows + part.times(-1))
                P1.add(at, slice(0, N), own_rows + part)
        P0.add(z, slice(0, len(self.group.states)), self.C.over(c, r).times(-1))
        P0.add(z, slice(0, N), self.D.over(c, r).columns(wanted).times(-1))
        P0.add(z, z, below)
        if levels:  # v 2 dens c(Y) x is about v T A x_1
            P1.add(x, levels[0], plant[0].times(-1))
        for i, (divisor, last, here) in enumerate(zip(dens, [x, *levels], levels, strict=False), 1):
            P0.add(here, last, plant[0].times(1 / 2))
            P0.add(here, here, divisor.times(2 * i + 1))
            if i < len(levels):
                P0.add(here, levels[i], plant[0].times(-1 / 2))
        curved = self.loop.sampled and len(plant) == 4
        return Pencil(P0.total, P1.total, np.arange(N) < n + k + m * late, curved)


def _rank(a: FloatArray, b: FloatArray) -> int:
    """The rank of [a b] or of a over b, the lower one."""
    return int(min(np.linalg.matrix_rank(np.hstack([a, b])), np.linalg.matrix_rank(np.vstack([a, b]))))


class _PencilSum:
    """A square matrix, made of parts."""

    def __init__(self, n: int, count: int) -> None:
        self.total = constant(np.zeros((n, n)), count)

    def add(self, rows: slice, columns: slice, part: BoxTerms) -> None:
        whole = self.total.part(rows, columns) + part
        self.total.middle[rows, columns] = whole.middle
        self.total.slopes[:, rows, columns] = whole.slopes
        self.total.rest[rows, columns] = whole.rest
