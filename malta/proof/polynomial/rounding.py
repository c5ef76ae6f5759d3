"""Couplings of the size of rounding, as gains leave them that should cancel: taken as zero, and bounded.

On the boundary of stability the loop is M = diag(M_k) + e with small e. det M is not zero where the row sums of
|diag(M_k)^-1 e| are below one: where |det M_k| > sum_i |cofactor_ij| e_i for every k and column j, e_i row sums of e.
The sum is the determinant of M_k with e in column j. It is bounded like coefficients (closed_loop.py) and becomes
part of the radius of det M_k. Lag, hold and delay have |h| <= 1 there and are left out of M.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import acb, arb
from scipy import linalg, sparse

from malta.proof.expressions import BALLS, NotAnalytic, finite
from malta.proof.groups import (
    A,
    B,
    C,
    E,
    UncertainLoop,
    divide_by_descriptor,
    groups,
    hold_bounds,
    upper,
)
from malta.proof.polynomial.closed_loop import coefficient_bounds
from malta.proof.polynomial.rational import Ratio, Symbolic, value
from malta.proof.uncertain import Group

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

SMALL = 1e-11  # relative size below which a coupling may be rounding


@dataclass(frozen=True, eq=False)
class Couplings:
    """The couplings of a closed loop as exact expressions: x to x, commands to x, y to the compensator."""

    loop: UncertainLoop
    symbolic: Symbolic

    @cached_property
    def entries(self) -> tuple[dict[tuple[int, int], Ratio], ...]:
        """The entries of A, of B (D_c C, C_c) and of B_c C; sums are added before they are bounded."""
        loop, s, law = self.loop, self.symbolic, self.loop.law
        n, k = loop.states, len(law.A)
        own, into, out = divide_by_descriptor(loop, s)[A], divide_by_descriptor(loop, s)[B], s.entries[C]
        held: dict[tuple[int, int], Ratio] = {}
        measured: dict[tuple[int, int], Ratio] = {}

        def add(table: dict[tuple[int, int], Ratio], at: tuple[int, int], r: Ratio, gain: float) -> None:
            if gain:
                part = r * s.constant(gain)
                table[at] = table[at] + part if at in table else part

        for (i, a), r in into.items():
            for (b, j), q in out.items():
                add(held, (i, j), r * q, float(law.D[a, b]))
            for j in range(k):
                add(held, (i, n + j), r, float(law.C[a, j]))
        for (b, j), q in out.items():
            for i in range(k):
                add(measured, (i, j), q, float(law.B[i, b]))
        return own, held, measured

    @np.errstate(over="ignore", invalid="ignore")  # bounds that overflow are refused
    def bounds(self, p: Sequence[Any]) -> FloatArray:
        """Entrywise bounds of M without its diagonal s (or g) over real balls p; the states x come first."""
        loop, law = self.loop, self.loop.law
        n, k = loop.states, len(law.A)
        values = [acb(x) for x in p]
        if self.symbolic.atoms:
            steps = loop.program.cells(values, BALLS)
            values += [steps[i] for i in self.symbolic.atoms]
        size: FloatArray = np.zeros((n + k, n + k))
        own: FloatArray = np.zeros((n, n))
        diagonal = np.zeros(n)
        for table, matrix, row in zip(self.entries, (own, size, size), (0, 0, n), strict=True):
            for (i, j), r in table.items():
                z = _ratio(r, values)
                matrix[row + i, j] = float(abs(z).upper()) * (1 + 1e-9)
                if matrix is own and i == j:
                    diagonal[i] = upper(z)
        size[n:, n:] = np.abs(law.A - (0 if law.sample_time is None else np.eye(k)))
        if loop.sampled:
            assert law.sample_time is not None
            own, V = hold_bounds(own, diagonal, law.sample_time)
            size[:n] = V @ size[:n]
        elif law.sample_time is not None:
            own = own + np.eye(n)
        size[:n, :n] += own
        return size


def _ratio(r: Ratio, values: list[Any]) -> Any:
    top = value(r.num, values)
    return finite(top if r.den is None else top / value(r.den, values))


@dataclass(frozen=True, eq=False)
class Part:
    """A group, and bounds of the coefficients (of s or g) by which neglected couplings can move its determinant."""

    group: Group
    moves: tuple[Any, ...]


def parts(loop: UncertainLoop, couplings: Couplings | None, p: Sequence[Any]) -> list[Part]:
    """The groups of a loop over real balls p, split further at couplings of the size of rounding."""
    exact = groups(loop)
    if couplings is None or loop.direct or _is_coupled(loop) or not any(len(g.states) > 1 for g in exact):
        return [Part(g, ()) for g in exact]
    try:
        size = couplings.bounds(p)
    except NotAnalytic:
        return [Part(g, ()) for g in exact]
    if not np.isfinite(size).all():
        return [Part(g, ()) for g in exact]
    found: list[Part] = []
    for g in exact:
        members = [*g.states, *(loop.states + i for i in g.own)]
        found += _split(loop, g, members, size[np.ix_(members, members)])
    return found


def _is_coupled(loop: UncertainLoop) -> bool:
    """Whether E has entries beside its diagonal, by which the rows of the couplings are not divided."""
    return loop.descriptor and any(i != j for i, j, _ in loop.program.entries[E])


def _split(loop: UncertainLoop, g: Group, members: list[int], size: FloatArray) -> list[Part]:
    _, (units, _) = linalg.matrix_balance(size, permute=False, separate=True)
    size = size * units / units[:, None]
    rows, columns = size.max(axis=1), size.max(axis=0)
    touch = size > SMALL * np.sqrt(rows[:, None] * columns[None, :])
    n = loop.states
    if loop.sampled or loop.descriptor:  # couplings inside the exponential are all kept
        s = loop.symbolic
        assert s is not None
        place = {state: k for k, state in enumerate(members)}
        for i, j in s.entries[A]:
            if i in place and j in place:
                touch[place[i], place[j]] = True
    # a coupling above rounding in one direction joins two groups
    _, label = sparse.csgraph.connected_components(touch, directed=False)
    if label.max() == 0:
        return [Part(g, ())]
    acting = sorted({i for i, _, _ in loop.program.entries[B]})
    found = []
    for k in range(int(label.max()) + 1):
        mine = np.flatnonzero(label == k)
        states = tuple(members[i] for i in mine if members[i] < n)
        own = tuple(members[i] - n for i in mine if members[i] >= n)
        inputs = tuple(i for i in acting if i in states)
        group = Group(states, own, inputs if len(inputs) < loop.program.shapes[B][1] else None)
        outside = size[mine][:, label != k].sum(axis=1)
        found.append(Part(group, _moves(size[np.ix_(mine, mine)], outside)))
    return found


def _moves(size: FloatArray, outside: FloatArray) -> tuple[Any, ...]:
    """Bounds of the coefficients of det(g I + M) with `outside` in column j, the largest over all j."""
    n = len(size)
    if not outside.any():
        return ()
    most = [arb(0)] * n
    for j in range(n):
        m, roots = size.copy(), np.ones(n)
        m[:, j], roots[j] = outside, 0
        most = [x.max(y) for x, y in zip(most, coefficient_bounds(m, roots), strict=True)]
    return tuple(most)
