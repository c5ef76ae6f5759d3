"""The closed loop as a pencil in v that is linear in the parameters, with bounds of the nonlinear terms.

    M(v) = P_0 + sum_i delta_i P_0i + R_0 + v (P_1 + sum_i delta_i P_1i + R_1),   |delta_i| <= 1, |R_k| <= bounds

It is singular on v = jx, x from 0 to infinity, exactly where the loop is on the boundary of stability. Rows are
multiplied by their denominators, so that masses, springs and dampers enter linearly. v is s in continuous time,
(z - 1) / (z + 1) otherwise: a row z a - b becomes (a - b) + v (a + b).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.proof.groups import C, UncertainLoop
from malta.proof.multipliers.expansion import (
    EPS,
    Expansion,
    constant,
    stack,
    table,
)
from malta.proof.multipliers.hold_series import LEVELS, hold_series, square_hold_series
from malta.proof.polynomial.degrees import clear_denominators
from malta.proof.polynomial.rational import TooLarge
from malta.proof.uncertain import Group

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.multipliers.expansion import Table

TERMS = 20_000  # of all entries, beyond which they are not expanded
LIFTED = 8  # states up to which the fraction of a hold has rows of its own
WIDEST = 40  # rows of a pencil with these, beyond the first level
LESS = (
    0.2,
    0.05,
)  # largest ratio of bounds with and without these rows: where they cost little, and one level else
MORE = 2  # times the coordinates of multipliers without these rows, that cost little


@dataclass(frozen=True, eq=False)
class Pencil:
    """M on a box. dynamic: rows with v, which are multiplied by 1 / v towards infinity."""

    constant: Expansion
    linear: Expansion
    dynamic: Any
    curved: bool  # whether a hold makes slopes of full rank and terms beyond them

    def branch(self, k: int) -> tuple[Expansion, Expansion]:
        """The constant part and the factor of jx (k = 1: of 1 / x) of M, for k = 1 of M / v in the dynamic rows."""
        if k == 0:
            return self.constant, self.linear
        d = self.dynamic

        def pick(one: Expansion, two: Expansion | None, sign: float) -> Expansion:
            zero = np.zeros_like(one.middle)
            return Expansion(
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

    def __init__(self, loop: UncertainLoop, group: Group) -> None:
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

        def pick(rows: list[dict[Any, Any]], kind: str, columns: dict[int, int]) -> Table:
            entries = {
                (i, columns[at[1]]): polynomial
                for i, row in enumerate(rows)
                for at, polynomial in row.items()
                if at is not None and at[0] == kind
            }
            return table((len(rows), len(columns)), entries, p)

        def below(rows: list[dict[Any, Any]]) -> Table:
            return table((len(rows),) * 2, {(i, i): row.get(None, one) for i, row in enumerate(rows)}, p)

        own, out = found[:n], [found[n + k] for k in self.reads]
        self.A, self.B, self.dens = pick(own, "x", state), pick(own, "u", u), below(own)
        self.E = pick(own, "e", state) if loop.descriptor else self.dens
        self.C, self.D, self.below = pick(out, "x", state), pick(out, "u", u), below(out)
        assert (self.C.shape, self.D.shape) == ((y, n), (y, m))

    @property
    def size(self) -> int:
        """The number of rows of the pencil."""
        law, m = self.loop.law, len(self.inputs)
        lifted = self.loop.sampled and len(self.group.states) <= LIFTED
        return self.driven * (2 if lifted else 1) + len(self.group.own) + m * law.delay + len(self.reads)

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
        if T is None or not self.loop.sampled or len(self.group.states) > LIFTED:
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
            if level > 1 and self.size + (level - 1) * self.driven > WIDEST:
                break
            beyond = square_hold_series(A, dens, T, level=level)
            share = math.inf if beyond is None else beyond.rest.sum() / whole.rest.sum()
            cheap = (level + 1) ** 2 * with_rows <= MORE * without
            if (cheap and share < LESS[0]) or (level == 1 and share < LESS[1]):
                return level
        return 0

    def _plant(self, dens: Expansion, c: FloatArray, r: FloatArray) -> tuple[Expansion, ...] | None:
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

    def _join(self, plant: tuple[Expansion, ...], below: Expansion, c: FloatArray, r: FloatArray) -> Pencil:
        """The whole pencil; its columns are x with lags, the compensator's states, stored inputs, y, and x_k of c."""
        law, own, late = self.loop.law, list(self.group.own), self.loop.law.delay
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
        P0, P1 = _Sum(N, self.count), _Sum(N, self.count)
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


class _Sum:
    """A square matrix, made of parts."""

    def __init__(self, n: int, count: int) -> None:
        self.total = constant(np.zeros((n, n)), count)

    def add(self, rows: slice, columns: slice, part: Expansion) -> None:
        whole = self.total.part(rows, columns) + part
        self.total.middle[rows, columns] = whole.middle
        self.total.slopes[:, rows, columns] = whole.slopes
        self.total.rest[rows, columns] = whole.rest
