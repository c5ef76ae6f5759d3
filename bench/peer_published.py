"""Published problems as the peers of peer_margin ask for them: which deviations are lost, and M of the blocks.

Deviations are rows of shares of the box; the size of unmodelled dynamics, a complex block, is one more of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from published_cases import Loop, Polynomial

import malta
from malta.linear.closed_loops import instability
from malta.proof.robust import law_of

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray

MOST = 16.0  # boxes that are looked at
FREQUENCIES = np.geomspace(1e-2, 1e4, 300)  # rad/s


def spanned(rows: FloatArray, box: Mapping[str, Any], nominal: Mapping[str, float] | None) -> FloatArray:
    """The parameters' values at rows of shares."""
    middle = np.array([nominal[k] if nominal else sum(box[k]) / 2 for k in box])
    sides = zip(middle.tolist(), box.values(), strict=True)
    low, high = np.array([s if isinstance(s, tuple) else (m * (1 - s), m * (1 + s)) for m, s in sides]).T
    rows = rows[:, : len(box)]
    return np.asarray(middle + np.where(rows.real > 0, high - middle, middle - low) * rows)


@dataclass(frozen=True)
class OfPolynomial:
    """Roots and values of a polynomial."""

    case: Polynomial
    most: float = MOST

    @property
    def kinds(self) -> list[int]:
        return [1] * len(self.case.box)

    def _coefficients(self, rows: FloatArray) -> FloatArray:
        values = spanned(rows, self.case.box, self.case.nominal)
        columns = self.case.coefficients(*values.T)
        return np.array([np.broadcast_to(column, len(rows)) for column in columns]).T

    def lost(self, rows: FloatArray) -> np.ndarray:
        """Whether a root is in the right half plane, or the degree is."""
        a = self._coefficients(rows)
        companion = np.zeros((len(a), a.shape[1] - 1, a.shape[1] - 1))
        companion[:, 1:, :-1] = np.eye(a.shape[1] - 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            companion[:, 0] = -a[:, 1:] / a[:, :1]
        bad = ~np.isfinite(companion).all(axis=(1, 2))
        companion[bad] = 0
        return np.asarray(bad | (np.linalg.eigvals(companion).real.max(axis=1) >= 0))

    def values(self, row: FloatArray) -> ComplexArray:
        """f(jw) on the grid of frequencies."""
        return np.asarray(np.polyval(self._coefficients(row[None])[0], 1j * FREQUENCIES))


@dataclass(frozen=True)
class OfLoop:
    """Poles of a loop, and det(I - P F) times what P divides by."""

    case: Loop

    @property
    def kinds(self) -> list[int]:
        return [1] * len(self.case.box) + [2] * bool(self.case.dynamics)

    @property
    def most(self) -> float:
        """Boxes; where the parameters are positive, almost to where the first one is zero."""
        if self.case.limits is None:
            return MOST
        nominal = [self.case.nominal[k] for k in self.case.box]
        (least,) = spanned(-np.ones((1, len(nominal))), self.case.box, self.case.nominal)
        return 0.98 / float((1 - least / nominal).max())

    @cached_property
    def system(self) -> malta.proof.UncertainSystem:
        return malta.uncertain(self.case.matrices, self.case.nominal)

    @cached_property
    def law(self) -> malta.proof.Compensator:
        return law_of(self.system, self.case.law)

    @cached_property
    def F(self) -> ComplexArray:
        """The law at the frequencies."""
        jw = 1j * FREQUENCIES[:, None, None]
        c = self.law
        return np.asarray(c.C @ np.linalg.solve(jw * np.eye(len(c.A)) - c.A, c.B + 0j) + c.D)

    def _parameters(self, rows: FloatArray) -> FloatArray:
        p = np.tile(self.system.nominal, (len(rows), 1))
        moved = [self.system.names.index(name) for name in self.case.box]
        p[:, moved] = spanned(rows, self.case.box, self.case.nominal)
        return p

    def _free(self, p: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """P F and det(jw - A) of the plant: rows x frequencies."""
        A, B, C = (M[:, None] for M in self.system.at(p))
        s = 1j * FREQUENCIES[:, None, None] * np.eye(A.shape[-1]) - A
        return C @ np.linalg.solve(s, B + 0j) @ self.F, np.linalg.det(s)

    def lost(self, rows: FloatArray) -> np.ndarray:
        """Whether a pole is in the right half plane, or the block times T reaches 1 at a frequency."""
        p = self._parameters(rows)
        bad = instability(self.system, self.law, p) >= 0
        if self.case.dynamics:
            L, _ = self._free(p)
            T = np.linalg.inv(np.eye(L.shape[-1]) - L)[..., 0, 0] - 1
            bad |= np.abs(rows[:, -1] * self.case.dynamics) * np.abs(T).max(axis=1) >= 1
        return np.asarray(bad)

    def values(self, row: FloatArray) -> ComplexArray:
        """The characteristic function on the grid of frequencies."""
        p = self._parameters(row[None])
        (L,), (free,) = self._free(p)
        if self.case.dynamics:
            L = L @ np.diag([1 + self.case.dynamics * row[-1], *np.ones(L.shape[-1] - 1)])
        named = dict(zip(self.system.names, p[0].tolist(), strict=True))
        return np.asarray(
            np.linalg.det(np.eye(L.shape[-1]) - L) * free * math.prod(named[k] for k in self.case.divides)
        )


Asked = OfPolynomial | OfLoop


class Unfit(ValueError):
    """Why a problem has no form in 1 x 1 blocks."""


def blocks(asked: Asked) -> list[ComplexArray]:
    """M at each frequency with f / f(nominal) = det(1 - M d) in 1 x 1 blocks d. Raises Unfit where there is none."""
    n = len(asked.kinds)
    if n == 1:
        raise Unfit("one real parameter")
    even = spanned(np.vstack([np.ones(n), np.zeros(n), -np.ones(n)]), asked.case.box, asked.case.nominal)
    if not np.allclose(even[0] - even[1], even[1] - even[2]):
        raise Unfit("uneven ranges")
    sets = [np.array(own) for own in itertools.product((0.0, 1.0), repeat=n)]
    found = np.array([asked.values(own) for own in sets])
    parts = {  # coefficient of the product of the parameters in each set
        tuple(np.flatnonzero(own).tolist()): sum(
            (-1) ** int((own - less).sum()) * f
            for less, f in zip(sets, found, strict=True)
            if (less <= own).all()
        )
        for own in sets
    }
    probe = np.array([0.5, -0.25, 0.75, -0.5, 0.25])[:n]
    exact = asked.values(probe)
    rebuilt = sum(part * math.prod(probe[list(own)]) for own, part in parts.items())
    if n > 3 or not np.allclose(rebuilt, exact, rtol=1e-6, atol=1e-9 * np.abs(exact).max()):
        raise Unfit("repeated blocks")
    minors = {own: (-1) ** len(own) * part / parts[()] for own, part in parts.items() if own}
    return [_matrix({own: complex(m[k]) for own, m in minors.items()}, n) for k in range(len(FREQUENCIES))]


def _matrix(minors: Mapping[tuple[int, ...], complex], n: int) -> ComplexArray:
    """A matrix of two or three rows with these principal minors."""
    M = np.diag([minors[(i,)] for i in range(n)])
    for i, j in itertools.combinations(range(n), 2):
        M[i, j] = M[j, i] = np.sqrt(M[i, i] * M[j, j] - minors[i, j])
    if n == 3:  # both products around the circle add up to what the determinant asks for
        a, b, c = M[0, 1] ** 2, M[0, 2] ** 2, M[1, 2] ** 2
        around = minors[0, 1, 2] - M[0, 0] * (M[1, 1] * M[2, 2] - c) + M[1, 1] * b + M[2, 2] * a
        one, other = np.roots([1, -around, a * b * c])
        M[1, 2], M[2, 1] = one / (M[0, 1] * M[0, 2]), other / (M[0, 1] * M[0, 2])
    return M
