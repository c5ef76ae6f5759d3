"""The characteristic polynomial by minors (Cauchy, Binet): factors that do not depend on p are computed once.

    d_P d_F det(I - F P) = sum_k (-1)^k sum_(S, R, T) pi_SR  beta_RT  kappa_TS        |S| = |R| = |T| = k

P = X B, X from forces on the rows R of the state equations to the outputs S; pi_SR = d_P det X[S, R] and
kappa_TS = d_F det F[T, S] are polynomials, beta_RT = det B[R, T] numbers. A delay of d whole samples is z^-d of P.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, cast

import numpy as np
from flint import arb, arb_mat, arb_poly, ctx, fmpq_mat, fmpq_poly
from scipy import sparse

from malta.arrays import FloatArray
from malta.linear.expressions import MatrixProgram, NotAnalytic, exact
from malta.linear.rational import Ratio, Symbolic
from malta.linear.sampling import split_delay
from malta.linear.uncertain import StateGroup
from malta.proof.groups import A, B, C, E, UncertainLoop, rational
from malta.proof.polynomial.closed_loop import (
    all_bounds,
    coefficient_bounds,
    dense,
    drive,
    driven_bounds,
    entry_bounds,
    join_columns,
    law_matrix,
    solve,
    zeros,
)

# Groups of states whose own dynamics are equal but for signs, as those of the two planes of a round body.
#
#     A' = S A S,  E' = S E S        S = diag(+-1)
#
# (s E - A)^-1 of minors.py is then S (s E' - A')^-1 S. The signs are read from the exact entries: numbers that differ
# in their last digit make no mirror image.


class MinorPlaces(NamedTuple):
    """A group's states by their numbers in the loop, and its rows with inputs by their own."""

    states: tuple[int, ...]
    rows: tuple[int, ...]

    def entries(self, s: Symbolic, which: int) -> dict[tuple[int, int], Ratio]:
        """The entries of A or E in the group, by row and column in the group."""
        at = {state: k for k, state in enumerate(self.states)}
        return {(at[i], at[j]): r for (i, j), r in s.entries[which].items() if i in at and j in at}


class Image(NamedTuple):
    """A group as the mirror image of the group `of`, and the signs of its states."""

    of: MinorPlaces
    signs: tuple[int, ...]


def first_alike(program: MatrixProgram, s: Symbolic | None, places: MinorPlaces) -> Image:
    """A group as an image of the first group of a program's system that it mirrors: of itself when there is none."""
    firsts = _firsts(program)
    if places not in firsts:
        others = [one for one, image in firsts.items() if image.of == one] if s is not None else []
        found = (image for one in others if s is not None and (image := image_of(s, one, places)) is not None)
        firsts[places] = next(found, Image(places, (1,) * len(places.states)))
    return firsts[places]


@lru_cache(maxsize=64)
def _firsts(program: MatrixProgram) -> dict[MinorPlaces, Image]:
    del program
    return {}


def image_of(s: Symbolic, one: MinorPlaces, two: MinorPlaces) -> Image | None:
    """The second group as an image of the first; None where they differ, as exact expressions, in more than signs."""
    if one.rows != two.rows or len(one.states) != len(two.states):
        return None
    related = list[tuple[int, int, int]]()
    for which in (k for k in (A, E) if k < len(s.entries)):
        own, other = one.entries(s, which), two.entries(s, which)
        if own.keys() != other.keys():
            return None
        related += [(i, j, _sign(r, other[i, j])) for (i, j), r in own.items()]
    signs = _signs(related, len(one.states))
    return None if signs is None else Image(one, signs)


def _sign(one: Ratio, two: Ratio) -> int:
    """1 for equal functions, -1 for opposite ones, else 0."""
    if one.den != two.den:
        return 0
    return 1 if one.num == two.num else -1 if one.num == -two.num else 0


def _signs(related: list[tuple[int, int, int]], count: int) -> tuple[int, ...] | None:
    """Signs s_i = +-1 with s_i s_j = sign for each (i, j, sign); None where there are none.

    Each place has two nodes, s_i = 1 and s_i = -1, and a relation joins those that imply each other.
    """
    if not all(sign for *_, sign in related):
        return None
    nodes = [(i, j + (sign < 0) * count) for i, j, sign in related]
    nodes += [(i + count, j + (sign > 0) * count) for i, j, sign in related]
    graph = sparse.coo_array((np.ones(len(nodes)), np.array(nodes).reshape(-1, 2).T), (2 * count,) * 2)
    _, label = sparse.csgraph.connected_components(graph, directed=False)
    plus, minus = label[:count], label[count:]
    return None if (plus == minus).any() else tuple(np.where(plus < minus, 1, -1).tolist())


MOST_WEIGHTS = 16  # sets of factors that are remembered
MAX_MINORS = 24  # minors beyond which the closed loop's own matrix is cheaper

Pair = tuple[tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True, eq=False)
class Minors:
    """The minors of a group: its rows with inputs, its inputs and outputs, and the compensator between these.

    R, S and T count in the group. Its resolvent is that of its first mirror image.
    """

    loop: UncertainLoop
    group: StateGroup
    rows: tuple[int, ...]  # states, by their number in the group
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]

    @cached_property
    def image(self) -> Image:
        """This group as an image of the one whose resolvent stands for its own (minors.py)."""
        own = MinorPlaces(self.group.states, self.rows)
        return first_alike(self.loop.program, self.loop.symbolic, own)

    @property
    def order(self) -> int:
        return min(len(self.rows), len(self.inputs), len(self.outputs))

    @property
    def count(self) -> int:
        """The number of polynomials to be computed at each place."""
        return sum(
            math.comb(len(self.rows), k) * math.comb(len(self.outputs), k) for k in range(self.order + 1)
        )

    @cached_property
    def kappa(self) -> dict[Pair, Any]:
        """d_F det F[T, S] of the compensator's own states, in s or g = z - 1: exact."""
        law, own = self.loop.law, list(self.group.own)
        f = fmpq_mat(law_matrix(self.loop, self.group)) if own else None
        d = fmpq_poly([1]) if f is None else fmpq_poly(f.charpoly())
        entries: dict[tuple[int, int], Any] = {}
        for i, t in enumerate(self.inputs):
            for j, s in enumerate(self.outputs):
                entry = d * exact(float(law.D[t, s]))
                if f is not None:
                    b = fmpq_mat(rational(law.B[own][:, [s]]))
                    c = fmpq_mat(rational(law.C[[t]][:, own]))
                    entry += fmpq_poly((f - b * c).charpoly()) - d
                entries[i, j] = entry
        found: dict[Pair, Any] = {((), ()): d}
        for k in range(1, self.order + 1):
            for T in itertools.combinations(range(len(self.inputs)), k):
                for S in itertools.combinations(range(len(self.outputs)), k):
                    det = _determinant([[entries[t, s] for s in S] for t in T])
                    found[T, S] = det if k == 1 else _quotient(det, d, k - 1)
        return found

    @cached_property
    def late(self) -> tuple[Any, ...]:
        """z^(d (K - k)) for k = 0 .. K."""
        z = fmpq_poly([1, 1])
        return tuple(
            z ** (split_delay(self.loop.law.delay)[0] * (self.order - k)) for k in range(self.order + 1)
        )

    @cached_property
    def balls(self) -> tuple[dict[Pair, Any], dict[Pair, Any]]:
        """kappa times the delay's power, signed, as exact polynomials and as balls."""
        signed = {pair: p * self.late[len(pair[0])] * (-1) ** len(pair[0]) for pair, p in self.kappa.items()}
        return signed, {pair: arb_poly(p) for pair, p in signed.items()}

    def resolvent(self, entries: list[list[tuple[int, int, Any]]], matrix: Any) -> Resolvent:
        """That of the first group of which this one is an image, at given p."""
        a = self._square(entries[A], matrix, self.image.of.states)
        b = _unit_columns(matrix, a.nrows(), self.rows)
        factor: Any = 1
        if self.loop.descriptor:
            e = self._square(entries[E], matrix, self.image.of.states)
            factor, a = e.det(), solve(e, a)
        a, b, _, _ = drive(self.loop, matrix, a, b, zeros(matrix, 0, a.nrows()), None)
        return _resolvent(a, b, factor)

    def plant(
        self, resolvent: Resolvent, entries: list[list[tuple[int, int, Any]]], matrix: Any
    ) -> dict[Pair, Any]:
        """pi_SR at given p, rows by their number in the group; signs of images are those of C and of `forces`."""
        x = {state: k for k, state in enumerate(self.group.states)}
        y, signs = {output: k for k, output in enumerate(self.outputs)}, self.image.signs
        own = [(y[i], x[j], r * signs[x[j]]) for i, j, r in entries[C] if i in y and j in x]
        found = _minors(resolvent, dense(matrix, len(y), resolvent.powers.nrows(), own), self.order)
        return {pair: p * resolvent.det_E for pair, p in found.items()}

    def _square(self, entries: list[tuple[int, int, Any]], matrix: Any, states: tuple[int, ...]) -> Any:
        """The entries of A or E between states."""
        x = {state: k for k, state in enumerate(states)}
        return dense(matrix, len(x), len(x), ((x[i], x[j], r) for i, j, r in entries if i in x and j in x))

    def forces(self, entries: list[list[tuple[int, int, Any]]], matrix: Any) -> dict[Pair, Any]:
        """beta_RT at given p, without structural zeros."""
        x, signs = {state: k for k, state in enumerate(self.group.states)}, self.image.signs
        n, u = len(x), {t: k for k, t in enumerate(self.inputs)}
        own = {(x[i], u[j]): r for i, j, r in entries[B] if i in x and j in u}
        if self.loop.descriptor:
            e = self._square(entries[E], matrix, self.group.states)
            b = solve(e, dense(matrix, n, len(u), ((*at, r) for at, r in own.items())))
            own = {(i, j): b[i, j] for i in range(n) for j in range(len(u))}
        own = {(i, j): r * signs[i] for (i, j), r in own.items()}
        found: dict[Pair, Any] = {}
        for k in range(1, self.order + 1):
            for R in itertools.combinations(range(len(self.rows)), k):
                for T in itertools.combinations(range(len(u)), k):
                    part = [[own.get((self.rows[i], t)) for t in T] for i in R]
                    det = _determinant(part)
                    if det is not None:
                        found[R, T] = det
        return found

    def combine(self, pi: dict[Pair, Any], beta: dict[Pair, Any], matrix: Any) -> list[Any]:
        """The coefficients a_0 ... a_N from the minors."""
        total: Any = 0
        for pair, weight in self._weights(beta, matrix).items():
            total = pi[pair] * weight + total
        return list(total.coeffs())

    def _weights(self, beta: dict[Pair, Any], matrix: Any) -> dict[Pair, Any]:
        """The factor of each pi_SR, remembered for these forces: many places have the same."""
        key = id(beta), matrix, ctx.prec
        if key not in self.weighted:
            kappa = self.balls[0 if matrix is fmpq_mat else 1]
            found: dict[Pair, Any] = {((), ()): kappa[(), ()]}
            for S, R in itertools.product(
                *([s for k in range(1, self.order + 1) for s in itertools.combinations(range(len(on)), k)]
                  for on in (self.outputs, self.rows))
            ):  # fmt: skip
                own = [T for T in itertools.combinations(range(len(self.inputs)), len(R)) if (R, T) in beta]
                if len(S) == len(R) and own:
                    found[S, R] = sum(
                        (kappa[T, S] * beta[R, T] for T in own[1:]), kappa[own[0], S] * beta[R, own[0]]
                    )
            if len(self.weighted) > MOST_WEIGHTS:
                self.weighted.clear()
            self.weighted[key] = beta, found  # which keeps the forces, and so their id
        return self.weighted[key][1]

    @cached_property
    def weighted(self) -> dict[Any, tuple[dict[Pair, Any], dict[Pair, Any]]]:
        """The factors of minors that are remembered."""
        return {}

    @cached_property
    def degree(self) -> int:
        law, (whole, part) = self.loop.law, split_delay(self.loop.law.delay)
        driven = len(self.rows) * ((law.lag is not None) + (part > 0))
        return len(self.group.states) + len(self.group.own) + driven + self.order * whole

    def sizes(self, entries: list[list[tuple[int, int, Any]]]) -> Sizes:
        """Bounds of the system's minors from balls of the entries.

        Raises NotAnalytic when numbers overflow.
        """
        a, b, c, diagonal = entry_bounds(entries, self.group.states, self.inputs, self.outputs)
        b = b[list(self.rows)]
        parts = a, b, c, diagonal
        known, key = self.resolvents, tuple((part.shape, part.tobytes()) for part in parts)
        if key in known:  # of an image
            return cast("Sizes", known[key])
        driven = ("driven", self.rows, a.tobytes(), diagonal.tobytes())
        if driven not in known:  # of other outputs
            none = np.zeros((0, len(a)))
            known[driven] = driven_bounds(
                self.loop, (a, np.eye(len(a))[:, list(self.rows)], none, None), diagonal
            )[:2]
        a, into = known[driven]
        c = np.hstack([c, np.zeros((len(c), len(a) - c.shape[1]))])
        pi: dict[Pair, Any] = {((), ()): coefficient_bounds(a, np.ones(len(a)))}
        for k in range(1, self.order + 1):
            places = [
                (S, R)
                for S in itertools.combinations(range(len(self.outputs)), k)
                for R in itertools.combinations(range(len(self.rows)), k)
            ]
            sides = {at: (into[:, list(at[1])], c[list(at[0])]) for at in places}
            keys = {at: (*driven, *(M.tobytes() for M in sides[at])) for at in places}
            new = {key: at for at, key in keys.items() if key not in known}
            known |= zip(new, _bounds(a, [sides[at] for at in new.values()]) if new else [], strict=True)
            pi |= {at: known[key] for at, key in keys.items()}
        beta = {
            (R, T): float(np.prod(b[np.ix_(R, T)].sum(axis=1))) * (1 + 1e-9)
            for k in range(1, self.order + 1)
            for R in itertools.combinations(range(len(self.rows)), k)
            for T in itertools.combinations(range(len(self.inputs)), k)
        }
        if not all(math.isfinite(size) for size in beta.values()):
            raise NotAnalytic("numbers that overflow")
        known[key] = made = Sizes(pi, beta)
        return made

    def majorant(self, sizes: Sizes) -> list[Any]:
        """Upper bounds of the coefficients of s or g."""
        result = arb_poly()
        for (S, R), pi in sizes.pi.items():
            weight = arb_poly() if R else self._absolute_kappa[(), ()]
            for T in itertools.combinations(range(len(self.inputs)), len(R)) if R else ():
                if sizes.beta[R, T]:
                    weight += self._absolute_kappa[T, S] * arb(sizes.beta[R, T])
            result += arb_poly(pi) * weight
        found = list(result.coeffs())
        return found + [arb(0)] * (self.degree + 1 - len(found))

    @cached_property
    def _absolute_kappa(self) -> dict[Pair, Any]:
        return {pair: arb_poly([abs(x) for x in p.coeffs()]) for pair, p in self.balls[0].items()}

    @cached_property
    def known(self) -> dict[Any, Any]:
        """The remembered minors of the system at places and on discs, which do not depend on the compensator."""
        return _kept_minors(
            self.loop.program, self._kind, self.group.states, self.rows, self.inputs, self.outputs
        )

    @cached_property
    def resolvents(self) -> dict[Any, Any]:
        """The remembered resolvents at places, those of images too."""
        return _kept_minors(self.loop.program, self._kind, self.image.of)

    @property
    def _kind(self) -> tuple[Any, ...]:
        law = self.loop.law
        return law.sample_time, law.lag, self.loop.sampled, split_delay(law.delay)[1]


@lru_cache(maxsize=64)  # laws change, the system stays
def _kept_minors(program: MatrixProgram, *of: Any) -> dict[Any, Any]:
    del program, of
    return {}


class Resolvent(NamedTuple):
    """(g - A)^-1 B as adj(g - A) B / d, d = det(g - A): the matrices of its powers of g side by side, lowest first."""

    d: Any
    powers: Any
    det_E: Any


class Sizes(NamedTuple):
    """Bounds of the coefficients of pi_SR, and of beta_RT."""

    pi: dict[Pair, Any]
    beta: dict[Pair, float]


@lru_cache(maxsize=64)
def _unit_columns(matrix: Any, n: int, rows: tuple[int, ...]) -> Any:
    return dense(matrix, n, len(rows), ((i, k, 1) for k, i in enumerate(rows)))


def minors(loop: UncertainLoop, g: StateGroup) -> Minors | None:
    """The minors of a group; None for direct feedthrough or too many minors, where the matrix itself is cheaper."""
    if loop.direct or not g.states:
        return None
    x = {state: k for k, state in enumerate(g.states)}
    own = list(g.own)
    rows = sorted({x[i] for i, _, _ in loop.program.entries[B] if i in x})
    inputs = sorted({j for i, j, _ in loop.program.entries[B] if i in x})
    if loop.descriptor:
        rows = list(range(len(x)))
    outputs = sorted({i for i, j, _ in loop.program.entries[C] if j in x})
    law = loop.law
    inputs = [t for t in inputs if law.C[t, own].any() or law.D[t, outputs].any()]
    outputs = [s for s in outputs if law.B[own, s].any() or law.D[inputs, s].any()]
    found = Minors(loop, g, tuple(rows), tuple(inputs), tuple(outputs))
    return found if found.count <= MAX_MINORS else None


def _determinant_by_row(row: list[Any], rest: list[Any]) -> Any:
    """The determinant from a first row and the minors of the others."""
    total = row[0] * rest[0]
    for n in range(1, len(row)):
        total = total - row[n] * rest[n] if n % 2 else total + row[n] * rest[n]
    return total


def _determinant(m: list[list[Any]]) -> Any:
    """The determinant by its first row; None stands for zero."""
    if len(m) == 1:
        return m[0][0]
    total = None
    for j, entry in enumerate(m[0]):
        rest = None if entry is None else _determinant([row[:j] + row[j + 1 :] for row in m[1:]])
        if rest is None:
            continue
        part = -(entry * rest) if j % 2 else entry * rest
        total = part if total is None else total + part
    return total


def _quotient(p: Any, d: Any, k: int) -> Any:
    for _ in range(k):
        q, rest = divmod(p, d)
        assert rest == 0
        p = q
    return p


def _resolvent(a: Any, b: Any, det_E: Any) -> Resolvent:
    """The resolvent by Horner's scheme (Leverrier, Faddeev), which loses few digits to cancellation."""
    own = a.charpoly()
    powers = [b]
    for k in range(a.nrows() - 1, 0, -1):
        powers.append(a * powers[-1] + b * own[k])
    kind = arb_poly if isinstance(a, arb_mat) else fmpq_poly
    return Resolvent(kind(own), join_columns(type(a), *powers[::-1]), det_E)


def _minors(resolvent: Resolvent, c: Any, order: int) -> dict[Pair, Any]:
    """d det X[S, R], X = C (g - A)^-1 B: d X has entries of C adj(g - A) B, and larger minors are their determinants
    by the first row, each divided by d."""
    d, p, wide = resolvent.d, c.nrows(), resolvent.powers.ncols()
    values, r = (c * resolvent.powers).entries(), wide // resolvent.powers.nrows()
    found: dict[Pair, Any] = {((), ()): d}
    for i, j in itertools.product(range(p), range(r)):
        found[(i,), (j,)] = type(d)(values[i * wide + j : (i + 1) * wide : r])
    for k in range(2, order + 1):
        for S in itertools.combinations(range(p), k):
            for R in itertools.combinations(range(r), k):
                minor = _determinant_by_row(
                    [found[S[:1], (j,)] for j in R], [found[S[1:], R[:n] + R[n + 1 :]] for n in range(k)]
                )
                found[S, R] = minor // d
    return found


def _bounds(a: FloatArray, sides: list[tuple[FloatArray, FloatArray]]) -> list[list[Any]]:
    """Upper bounds of the coefficients of det [[g - A, B], [C, 0]], from entrywise bounds of A and of each B and C."""
    n, k = len(a), len(sides[0][1])
    m = np.zeros((len(sides), n + k, n + k))
    m[:, :n, :n] = a
    m[:, :n, n:], m[:, n:, :n] = (np.array(part) for part in zip(*sides, strict=True))
    return all_bounds(m, np.where(np.arange(n + k) < n, 1.0, 0.0))
