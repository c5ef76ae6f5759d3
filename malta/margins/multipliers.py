"""Multipliers of real parameters: what shows that 1 - N Delta is not singular, whatever Delta in the unit box is.

Delta = diag(delta_i 1, Psi) with real delta_i of at most 1, each repeated, and perhaps one complex block |Psi| <= 1.
With D = diag(D_i, d 1) > 0, G = diag(G_i, 0), all Hermitian,

    F = D - N* D N - j (G N - N* G) > 0

excludes it: with w = Delta z and z = N w, w* F w = w* D w - z* D z + j (z* G w - w* G z) <= 0. The smallest beta for
which beta^2 D - N* D N - j (G N - N* G) > 0 has a solution is sought by Newton's method, through analytic centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

STEPS = 60  # of the level, at most
INNER = 5  # Newton steps for each
SHARE = 0.3  # of the way from the level reached to the one that stands
FLAT = 0.01  # relative progress below which the level is the best there is
SLACK = 1e-6  # what keeps G within thousands of D where nothing else does


@dataclass(frozen=True)
class Blocks:
    """Sizes of the real blocks, and of a complex one at the end, which may be empty."""

    real: tuple[int, ...]
    other: int = 0

    @property
    def size(self) -> int:
        return sum(self.real) + self.other


class Multiplier(NamedTuple):
    D: ComplexArray
    G: ComplexArray
    blocks: Blocks  # whose structure D and G have: it shows nothing of others


class Basis(NamedTuple):
    """Entries (row, column) that D and G may have, and Hermitian basis elements as sums of these."""

    rows: Any
    columns: Any
    D: ComplexArray  # elements x entries
    G: ComplexArray


@lru_cache(maxsize=64)
def _basis(blocks: Blocks) -> Basis:
    rows: list[int] = []
    columns: list[int] = []
    elements: list[dict[int, complex]] = []
    at = 0
    for r in blocks.real:
        place = {}
        for a in range(at, at + r):
            for b in range(at, at + r):
                place[a, b] = len(rows)
                rows.append(a)
                columns.append(b)
        for (a, b), k in place.items():
            if a == b:
                elements.append({k: 1})
            elif a < b:
                elements += [{k: 1, place[b, a]: 1}, {k: 1j, place[b, a]: -1j}]
        at += r
    count = len(elements)
    if blocks.other:
        elements.append({len(rows) + k: 1 for k in range(blocks.other)})
        rows += range(at, at + blocks.other)
        columns += range(at, at + blocks.other)
    table: ComplexArray = np.zeros((len(elements), len(rows)), dtype=complex)
    for k, element in enumerate(elements):
        for entry, value in element.items():
            table[k, entry] = value
    return Basis(np.array(rows), np.array(columns), table, table[:count])


def units(N: ComplexArray, blocks: Blocks) -> FloatArray:
    """Scales of the channels that balance N, powers of two."""
    size = np.abs(N) + 1e-12 * np.abs(N).max(initial=0.0) + 1e-300
    right, left = np.ones(len(N)), np.ones(len(N))
    for _ in range(30):
        right, left = size @ right, left @ size
        right, left = right / right.max(), left / left.max()
    found = np.log2(np.maximum(left, 1e-200) / np.maximum(right, 1e-200)) / 2
    if blocks.other:
        found[-blocks.other :] = found[-blocks.other :].mean()
    return np.asarray(np.exp2(np.round(found)))


def multiplier(
    N: ComplexArray, blocks: Blocks, first: Multiplier | None, wanted: float, flat: float = FLAT
) -> tuple[Multiplier, float]:
    """D and G with the smallest beta found, and it; the centre for beta = 1 where beta is below `wanted`."""
    scale = units(N, blocks)
    turn = scale[:, None] / scale
    back = scale[:, None] * scale
    start = (
        None
        if first is None or first.blocks != blocks
        else Multiplier(first.D / back, first.G / back, blocks)
    )
    found, level = _Centres(N * turn, blocks).lowest(start, wanted**2, flat)
    return Multiplier(found.D * back, found.G * back, blocks), float(np.sqrt(max(level, 0.0)))


class _Centres:
    """Analytic centres of b D - S(D, G) > 0, D > 0 with S = N* D N + j (G N - N* G), b = beta^2."""

    def __init__(self, N: ComplexArray, blocks: Blocks) -> None:
        self.N, self.H, self.blocks, self.basis = N, N.conj().T, blocks, _basis(blocks)
        self.count = len(self.basis.D)
        on_diagonal = self.basis.rows == self.basis.columns
        traces = self.basis.D[:, on_diagonal].sum(axis=1).real
        self.trace = np.concatenate([traces, np.zeros(len(self.basis.G))])
        self.start = (self.trace > 0) * 1.0

    def _matrix(self, x: FloatArray, elements: ComplexArray) -> ComplexArray:
        found: ComplexArray = np.zeros(self.N.shape, dtype=complex)
        found[self.basis.rows, self.basis.columns] = x @ elements
        return found

    def matrices(self, x: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """D, G and S."""
        D, G = self._matrix(x[: self.count], self.basis.D), self._matrix(x[self.count :], self.basis.G)
        turned = 1j * (G @ self.N)
        return D, G, self.H @ D @ self.N + turned + turned.conj().T

    def level(self, x: FloatArray) -> float:
        D, _, S = self.matrices(x)
        return float(linalg.eigh(S, D, eigvals_only=True, check_finite=False)[-1])

    def lowest(self, first: Multiplier | None, wanted: float, flat: float) -> tuple[Multiplier, float]:
        x = self.start
        level = self.level(x)
        if first is not None:
            other = self._coordinates(first)
            try:
                if (at := self.level(other)) < level:
                    x, level = other, at
            except np.linalg.LinAlgError:
                pass
        b = level + 0.5 * abs(level) + 1e-6
        for _ in range(STEPS):
            if level < wanted:
                x = self.centre(x, 1.0)  # with room to all sides, for intervals of frequency
                break
            x = self.centre(x, b)
            level = self.level(x)
            if b - level < flat * abs(level) + 1e-9:
                break
            b = level + SHARE * (b - level)
        D, G, _ = self.matrices(x)
        return Multiplier(D, G, self.blocks), level

    def _coordinates(self, first: Multiplier) -> FloatArray:
        def of(M: ComplexArray, elements: ComplexArray) -> FloatArray:
            entries = M[self.basis.rows, self.basis.columns]
            return np.asarray((elements.conj() @ entries).real / (np.abs(elements) ** 2).sum(axis=1))

        x = np.concatenate([of(first.D, self.basis.D), of(first.G, self.basis.G)])
        return np.asarray(x * (self.trace @ self.start) / max(float(self.trace @ x), 1e-300))

    def centre(self, x: FloatArray, b: float) -> FloatArray:
        """Newton steps towards the centre for b."""
        total = float(self.trace @ self.start)
        for _ in range(INNER):
            D, _, S = self.matrices(x)
            try:
                g, H = self._slopes(np.linalg.inv(b * D - S), np.linalg.inv(D), b)
                g += (self.trace @ x - total) * self.trace
                g[self.count :] += SLACK * x[self.count :]
                H += np.outer(self.trace, self.trace)
                H[np.diag_indices(len(H))] += SLACK * (np.arange(len(H)) >= self.count)
                H[np.diag_indices(len(H))] *= 1 + 1e-11
                move = -np.linalg.solve(H, g)
            except np.linalg.LinAlgError:
                return x
            left = -float(g @ move)
            if not np.isfinite(left):
                return x
            x = x + (1.0 if left < 0.25 else 1 / (1 + np.sqrt(max(left, 0.0)))) * move
            if left < 0.1:
                break
        return x

    def _slopes(self, P: ComplexArray, V: ComplexArray, b: float) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of -log det (b D - S) - log det D, of whose matrices P and V are the inverses.

        By entries E_ij of D and G: tr(P X_ij P X_kl) with X = b E - N* E N of D, -j (E N - N* E) of G.
        """
        i, j, k = self.basis.rows, self.basis.columns, self.count
        Q, R = self.N @ P, P @ self.H
        W = Q @ self.H
        at = np.ix_(j, i)
        one = {name: M[at] for name, M in (("P", P), ("Q", Q), ("R", R), ("W", W), ("V", V))}
        two = {name: M[at].T for name, M in (("P", P), ("Q", Q), ("R", R), ("W", W), ("V", V))}
        DD = b * b * one["P"] * two["P"] - b * (one["R"] * two["Q"] + one["Q"] * two["R"])
        DD += one["W"] * two["W"] + one["V"] * two["V"]
        GG = one["W"] * two["P"] + one["P"] * two["W"] - one["Q"] * two["Q"] - one["R"] * two["R"]
        DG = b * (one["P"] * two["Q"] - one["R"] * two["P"]) - one["Q"] * two["W"] + one["W"] * two["R"]
        own, other = self.basis.D, self.basis.G
        H = np.empty((k + len(other),) * 2)
        H[:k, :k] = (own @ DD @ own.T).real
        H[k:, k:] = (other @ GG @ other.T).real
        H[:k, k:] = (own @ (-1j * DG) @ other.T).real
        H[k:, :k] = H[:k, k:].T
        g = np.concatenate([
            -(own @ (b * P[j, i] - W[j, i] + V[j, i])).real, -(other @ (-1j * (Q - R)[j, i])).real
        ])  # fmt: skip
        return g, H
