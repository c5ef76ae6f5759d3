"""Multipliers of real parameters: proofs that 1 - N Delta is regular for every Delta in the unit box.

Delta = diag(delta_i 1, Psi) with real delta_i of at most 1, each repeated, and perhaps one complex block |Psi| <= 1.
With D = diag(D_i, d 1) > 0, G = diag(G_i, 0), all Hermitian,

    F = D - N* D N - j (G N - N* G) > 0

excludes it: with w = Delta z and z = N w, w* F w = w* D w - z* D z + j (z* G w - w* G z) <= 0. The smallest beta for
which beta^2 D - N* D N - j (G N - N* G) > 0 has a solution is computed by Newton's method, through analytic centres.

A pencil on an interval of frequency as N: det M(jx) = 0 on the box only where det(1 - N(x) Delta) = 0.

M = L + B Delta C with L at the middle of the box, and N = -C L^-1 B. On x = x0 + h t, |t| <= 1, with X about L(x0)^-1
and S = X L', L^-1 B = g_0 + t g_1 + t^2 g_2 + rest, where g_1 = X B' - S g_0, g_2 = -S g_1, and

    |rest| <= (1 - |S| - H)^-1 (|S g_2| + H (|g_0| + |g_1| + |g_2|)),   H: rounding, and all that M has beside.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.proof.multipliers.pencil import EPS, BoxTerms, Pencil
from malta.work import spend

STEPS = 60  # of the level, at most
NEWTON_STEPS = 5  # Newton steps for each
SHARE = 0.3  # of the way from the level reached to the one that stands
MIN_PROGRESS = 0.01  # relative progress below which the level is the best there is
STEP = 1e-6  # of N, for the slopes of a centre
SLACK = 1e-6  # what keeps G within thousands of D where nothing else does
NEWTON, COORDINATE = 1.5e-4, 8e-8  # work of a Newton step, and times the square of its coordinates


@dataclass(frozen=True)
class BlockSizes:
    """The sizes of the real blocks, and of a complex block at the end, which may be empty."""

    real: tuple[int, ...]
    other: int = 0

    @property
    def size(self) -> int:
        return sum(self.real) + self.other


class Multiplier(NamedTuple):
    """D and G at a frequency x, and their slopes along the frequency."""

    D: ComplexArray
    G: ComplexArray
    blocks: BlockSizes  # whose structure D and G have: it shows nothing of others
    x: float = 0.0
    slopes: tuple[ComplexArray, ComplexArray] | None = None  # none: constant

    def at(self, x: float) -> Multiplier:
        """The multiplier continued to another frequency by its slopes."""
        if self.slopes is None:
            return self._replace(x=x)
        D, G = (M + (x - self.x) * S for M, S in zip((self.D, self.G), self.slopes, strict=True))
        return self._replace(D=D, G=G, x=x)


class Basis(NamedTuple):
    """Entries (a, b), a <= b, that D and G may have; `own` of them in real blocks, the others, of D, all the same.

    Coordinates of G are the real parts of its own entries, then the imaginary parts of those off the diagonal;
    those of D the same, and one for the others.
    """

    a: Any
    b: Any
    own: int
    off: Any  # places of those off the diagonal
    weights: FloatArray  # 1 off the diagonal, 1/2 on it


@lru_cache(maxsize=64)
def _basis(blocks: BlockSizes) -> Basis:
    pairs: list[tuple[int, int]] = []
    at = 0
    for r in blocks.real:
        pairs += [(a, b) for a in range(at, at + r) for b in range(a, at + r)]
        at += r
    own = len(pairs)
    pairs += [(k, k) for k in range(at, at + blocks.other)]
    a, b = np.array(pairs, dtype=int).reshape(-1, 2).T
    return Basis(a, b, own, np.flatnonzero(a < b), np.where(a < b, 1.0, 0.5))


def units(N: ComplexArray, blocks: BlockSizes) -> FloatArray:
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
    N: ComplexArray,
    blocks: BlockSizes,
    first: Multiplier | None,
    wanted: float,
    flat: float = MIN_PROGRESS,
    along: ComplexArray | None = None,
    *,
    hasty: bool = False,
) -> tuple[Multiplier, float]:
    """D and G with the smallest beta found, and this beta; the centre for beta = 1 if beta is below `wanted`.

    along : slopes of N along frequency, for the slopes of D and G
    hasty : whether to stop at `first` when its beta is not below `wanted`

    Raises WorkUp within a work_limit.
    """
    scale = units(N, blocks)
    turn = scale[:, None] / scale
    back = scale[:, None] * scale
    start = (
        None
        if first is None or first.blocks != blocks
        else Multiplier(first.D / back, first.G / back, blocks)
    )
    centres = _Centres(N * turn, blocks)
    x, level = centres.lowest(start, wanted**2, flat, hasty and start is not None)
    D, G, _ = centres.matrices(x)
    slopes = None
    if along is not None and level < wanted**2:
        moved = centres.slopes(x, along * turn)
        slopes = None if moved is None else (moved[0] * back, moved[1] * back)
    return Multiplier(D * back, G * back, blocks, 0.0, slopes), float(np.sqrt(max(level, 0.0)))


class _Centres:
    """Analytic centres of b D - S(D, G) > 0, D > 0 with S = N* D N + j (G N - N* G), b = beta^2."""

    def __init__(self, N: ComplexArray, blocks: BlockSizes) -> None:
        self.N, self.H, self.blocks, self.basis = N, N.conj().T, blocks, _basis(blocks)
        self.own = self.basis.own + len(self.basis.off)  # coordinates of G
        self.count = self.own + (blocks.other > 0)  # of D
        self.trace = np.zeros(self.count + self.own)
        self.trace[: self.basis.own] = self.basis.weights[: self.basis.own] < 1
        self.trace[self.own : self.count] = blocks.other
        self.start = (self.trace > 0) * 1.0

    def _matrix(self, x: FloatArray) -> ComplexArray:
        """The matrix D or G from its coordinates."""
        a, b, own, off, _ = self.basis
        entries: ComplexArray = x[:own].astype(complex)
        entries[off] += 1j * x[own : self.own]
        found: ComplexArray = np.zeros(self.N.shape, dtype=complex)
        found[a[:own], b[:own]] = entries
        found[b[:own], a[:own]] = entries.conj()
        if len(x) > self.own:
            found[a[own:], a[own:]] = x[self.own]
        return found

    def matrices(self, x: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """D, G and S."""
        D, G = self._matrix(x[: self.count]), self._matrix(x[self.count :])
        turned = 1j * (G @ self.N)
        return D, G, self.H @ D @ self.N + turned + turned.conj().T

    def level(self, x: FloatArray) -> float:
        D, _, S = self.matrices(x)
        return float(linalg.eigh(S, D, eigvals_only=True, check_finite=False)[-1])

    def lowest(
        self, first: Multiplier | None, wanted: float, flat: float, hasty: bool
    ) -> tuple[FloatArray, float]:
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
        for _ in range(0 if hasty and level >= wanted else STEPS):
            if level < wanted:
                moved = self.centre(x, 1.0)  # with room to all sides, for intervals of frequency
                with suppress(np.linalg.LinAlgError):
                    x, level = moved, min(level, self.level(moved))
                break
            moved = self.centre(x, b)
            try:
                x, level = moved, self.level(moved)
            except np.linalg.LinAlgError:  # to rounding at the edge of D > 0
                break
            if b - level < flat * abs(level) + 1e-9:
                break
            b = level + SHARE * (b - level)
        return x, level

    def _coordinates(self, first: Multiplier) -> FloatArray:
        a, b, own, off, _ = self.basis

        def of(M: ComplexArray) -> list[Any]:
            entries = M[a[:own], b[:own]]
            return [entries.real, entries[off].imag]

        other = first.D[a[own:], a[own:]].real
        x = np.concatenate([*of(first.D), [other.mean()] if len(other) else [], *of(first.G)])
        return np.asarray(x * (self.trace @ self.start) / max(float(self.trace @ x), 1e-300))

    def slopes(self, x: FloatArray, along: ComplexArray) -> tuple[ComplexArray, ComplexArray] | None:
        """The approximate slopes of D and G of the centre for beta = 1 along those of N: its gradient stays zero."""
        step = STEP * float(np.abs(self.N).max()) / max(float(np.abs(along).max()), 1e-300)
        try:
            inverses = self._inverses(x, 1.0)
            other = _Centres(self.N + step * along, self.blocks)
            moved = other._gradient(x, 1.0, *other._inverses(x, 1.0)) - self._gradient(x, 1.0, *inverses)
            found = -np.linalg.solve(self._curvature(1.0, *inverses), moved) / step
        except np.linalg.LinAlgError:
            return None
        return self._matrix(found[: self.count]), self._matrix(found[self.count :])

    def _inverses(self, x: FloatArray, b: float) -> tuple[ComplexArray, ComplexArray]:
        """The inverses of b D - S and of D. Raises LinAlgError."""
        D, _, S = self.matrices(x)
        return np.linalg.inv(b * D - S), np.linalg.inv(D)

    def centre(self, x: FloatArray, b: float) -> FloatArray:
        """Newton steps towards the centre for b."""
        for _ in range(NEWTON_STEPS):
            spend(NEWTON + COORDINATE * len(x) ** 2)
            try:
                inverses = self._inverses(x, b)
                g = self._gradient(x, b, *inverses)
                move = -np.linalg.solve(self._curvature(b, *inverses), g)
            except np.linalg.LinAlgError:
                return x
            left = -float(g @ move)
            if not np.isfinite(left):
                return x
            x = x + (1.0 if left < 0.25 else 1 / (1 + np.sqrt(max(left, 0.0)))) * move
            if left < 0.1:
                break
        return x

    def _gradient(self, x: FloatArray, b: float, P: ComplexArray, V: ComplexArray) -> FloatArray:
        """The gradient of -log det (b D - S) - log det D, P and V their inverses; with the equation of the trace."""
        own, off, weights = self.basis.own, self.basis.off, 2 * self.basis.weights
        at = self.basis.a, self.basis.b
        Q = self.N @ P
        of_D, of_G = (b * P - Q @ self.H + V)[at], (1j * (Q.conj().T - Q))[at]
        g = np.concatenate([
            (weights * of_D.real)[:own], 2 * of_D.imag[off],
            [of_D.real[own:].sum()] if len(of_D) > own else [],
            (weights * of_G.real)[:own], 2 * of_G.imag[off],
        ])  # fmt: skip
        beside = float(self.trace @ x) - float(self.trace @ self.start)
        slack = np.where(np.arange(len(x)) < self.count, 0, SLACK) * x
        return np.asarray(beside * self.trace + slack - g)

    def _curvature(self, b: float, P: Any, V: Any) -> FloatArray:
        """The Hessian: by entries E_ij of D and G tr(P X_ij P X_kl), X = b E - N* E N of D, -j (E N - N* E) of G."""
        Q, fold = self.N @ P, _fold(self.blocks)
        parts = np.array([P, Q, Q.conj().T, Q @ self.H, V]).reshape(5, -1)
        (P, Q, R, W, V), (p, q, r, w, v) = np.asarray(parts[:, fold.one]), np.asarray(parts[:, fold.two])
        k, size = self.basis.own, len(self.basis.a)
        X: ComplexArray = np.zeros((2, size + k, size + k), dtype=complex)
        X[:, :size, :size] = b * b * P * p - b * (R * q + Q * r) + W * w + V * v
        X[:, :size, size:] = (-1j * (b * (P * q - R * p) - Q * w + W * r))[:, :, :k]
        X[:, size:, size:] = (W * p + P * w - Q * q - R * r)[:, :k, :k]
        if size > k + 1:  # the others are one coordinate
            X = np.asarray(np.add.reduceat(np.add.reduceat(X, fold.starts, axis=1), fold.starts, axis=2))
        (x, y), (u, v) = X.real, X.imag
        H: FloatArray = np.array([x + y, v - u, -u - v, y - x]).ravel()[fold.at] * fold.weights
        H[self.count :, : self.count] = H[: self.count, self.count :].T
        H += self.trace[:, None] * self.trace
        diagonal = np.einsum("ii->i", H)
        diagonal[self.count :] += SLACK
        diagonal *= 1 + 1e-11
        return H


class Fold(NamedTuple):
    """Where products by entries are: (a, b) of rows and (a, b) or (b, a) of columns; and coordinates among these."""

    one: Any
    two: Any
    starts: Any  # of entries that are summed
    at: Any
    weights: FloatArray


@lru_cache(maxsize=64)
def _fold(blocks: BlockSizes) -> Fold:
    a, b, own, off, w = _basis(blocks)
    n, size = blocks.size, len(a)
    across, right, left = b[:, None] * n + a, b[:, None] * n + b, a[:, None] * n + a
    shared = size > own  # entries of D beside those of blocks, together one
    starts = np.r_[np.arange(own + shared), size + np.arange(own)]
    entries = [np.arange(own), off, np.full(int(shared), own)]
    of_G = [own + shared + np.arange(own), own + shared + off]
    place = np.concatenate([*entries, *of_G]).astype(int)
    imaginary = np.concatenate([
        np.zeros(own), np.ones(len(off)), np.zeros(int(shared)), np.zeros(own), np.ones(len(off))
    ]).astype(int)  # fmt: skip
    weights = np.concatenate([w[:own], np.full(int(shared), 0.5), w[:own]])[place]
    kind = 2 * imaginary[:, None] + imaginary
    at = (kind * len(starts) + place[:, None]) * len(starts) + place
    return Fold(
        np.array([across, right]), np.array([across.T, left.T]), starts, at, 2 * weights[:, None] * weights
    )


SLOPE_TOLERANCE = 1e-11  # of the largest: what a slope has below that is no channel
HOLD_SLOPE_TOLERANCE = 3e-4  # where a hold curves the slopes
MAX_ROUNDED_REST = 1e-7  # of M: a rest below that is taken with the rounding
FACTOR_TOLERANCE = 1e-10  # where slopes are factored to the last digit
GUARD = 1e-13


class Slopes(NamedTuple):
    """Slopes factored, constant parts and those of jx: sum_i delta_i M_i = B Delta C, and the block of what is left."""

    B: tuple[FloatArray, FloatArray]
    C: tuple[FloatArray, FloatArray]
    blocks: BlockSizes
    owners: FloatArray  # parameter of each channel; -1: of the block


@dataclass(frozen=True, eq=False)
class Branch:
    """One branch of frequency of a pencil, rows and columns scaled about the frequency x."""

    pencil: Pencil
    branch: int
    x: float

    @cached_property
    def parts(self) -> tuple[BoxTerms, BoxTerms]:
        own = self.pencil.branch(self.branch)
        size = own[0].size + self.x * own[1].size
        rows, columns = np.ones(len(size)), np.ones(len(size))
        for _ in range(6):
            rows = 1 / np.maximum((size * columns).max(axis=1), 1e-300)
            columns = 1 / np.maximum((size * rows[:, None]).max(axis=0), 1e-300)
        rows, columns = (np.exp2(np.round(np.log2(v))) for v in (rows, columns))
        turn = rows[:, None] * columns
        return tuple(BoxTerms(p.middle * turn, p.slopes * turn, p.rest * turn) for p in own)  # type: ignore[return-value]

    @cached_property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(np.isfinite(M).all() for p in self.parts for M in (p.middle, p.slopes, p.rest))

    @cached_property
    def channels(self) -> tuple[Slopes, FloatArray, FloatArray]:
        """The channels, and the rest of the constant part and of the factor of x."""
        one, two = self.parts
        n = len(one.middle)
        rest = [one.rest.copy(), two.rest.copy()]
        coarse = HOLD_SLOPE_TOLERANCE if self.pencil.curved else SLOPE_TOLERANCE
        kept: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []
        sizes, owners = [], []
        for i, (a, b) in enumerate(zip(one.slopes, two.slopes, strict=True)):
            if not (a.any() or b.any()):
                continue
            parts = _factors(a, b, self.x, coarse)
            kept.append(parts)
            sizes.append(parts[0].shape[1])
            owners += [i] * sizes[-1]
            (B0, B1, C0, C1) = parts
            made = B0 @ C0, B0 @ C1 + B1 @ C0
            for k, (own, M) in enumerate(zip(made, (a, b), strict=True)):
                rest[k] += np.abs(own - M) + 8 * n * EPS * (np.abs(B0) + np.abs(B1)) @ (
                    np.abs(C0) + np.abs(C1)
                )
        other = 0
        whole = rest[0] + self.x * rest[1]
        whole = np.where(whole > (MAX_ROUNDED_REST if self.pencil.curved else FACTOR_TOLERANCE), whole, 0)
        if whole.any():
            rest = [np.where(whole > 0, 0, part) for part in rest]
            u, v = np.sqrt(whole.sum(axis=1)), np.sqrt(whole.sum(axis=0))
            r, c = np.flatnonzero(u), np.flatnonzero(v)
            other = max(len(r), len(c))
            B, C = np.zeros((n, other)), np.zeros((other, n))
            B[r, np.arange(len(r))], C[np.arange(len(c)), c] = u[r] * (1 + 1e-9), v[c] * (1 + 1e-9)
            kept.append((B, np.zeros_like(B), C, np.zeros_like(C)))
            owners += [-1] * other
        kept.append((np.zeros((n, 0)), np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, n))))
        B0, B1, C0, C1 = (
            (np.hstack if k < 2 else np.vstack)([part[k] for part in kept]) for k in range(4)
        )  # fmt: skip
        return Slopes((B0, B1), (C0, C1), BlockSizes(tuple(sizes), other), np.array(owners)), rest[0], rest[1]


def _factors(
    a: FloatArray, b: FloatArray, x: float, coarse: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """a + jx b = (B_0 + jx B_1) (C_0 + jx C_1), one of B_1 and C_1 zero, of the lower rank of both ways."""
    found = []
    for turned in (False, True):
        p, q = (a.T, b.T) if turned else (a, b)
        U, size, _ = np.linalg.svd(np.hstack([p, x * q]), full_matrices=False)
        r = int((size > coarse * size[0]).sum())
        U = U[:, : max(r, 1)]
        found.append((U, U.T @ p, U.T @ q))
    (U, p, q), (V, s, t) = found
    if U.shape[1] <= V.shape[1]:
        return U, np.zeros_like(U), p, q
    return s.T, t.T, V.T, np.zeros_like(V.T)


class Response(NamedTuple):
    """N = N_0 + t N_1 + t^2 N_2 + rest, |t| <= 1."""

    terms: tuple[ComplexArray, ...]
    rest: FloatArray


def response(branch: Branch, low: float, high: float) -> Response | None:
    """The response on an interval of frequency; None when the interval is too wide."""
    one, two = branch.parts
    channels, rest0, rest1 = branch.channels
    n, x, h = len(one.middle), (low + high) / 2, (high - low) / 2 + 4 * EPS * high
    L = one.middle + 1j * x * two.middle
    slope = 1j * h * two.middle
    size = np.abs(one.middle) + high * np.abs(two.middle)
    if not high <= branch.x:
        return None
    beside = 8 * EPS * size + rest0 + high * rest1
    try:
        X = np.linalg.inv(L)
    except np.linalg.LinAlgError:
        return None
    wide = np.abs(X)
    S = X @ slope
    H = np.abs(np.eye(n) - X @ L) + 8 * (n + 4) * EPS * (wide @ size) + wide @ beside
    B = channels.B[0] + 1j * x * channels.B[1], 1j * h * channels.B[1]
    C = channels.C[0] + 1j * x * channels.C[1], 1j * h * channels.C[1]
    g0 = X @ B[0]
    g1 = X @ B[1] - S @ g0
    g2 = -S @ g1
    bound = wide @ (np.abs(channels.B[0]) + high * np.abs(channels.B[1]))
    grown = np.abs(g0) + np.abs(g1) + np.abs(g2)
    y = np.abs(S @ g2) + H @ grown + 32 * n * EPS * (bound + np.abs(S) @ (bound + grown)) + 1e-280
    y = np.hstack([y, np.ones((n, 1))])  # that M is regular in the middle of the box
    K = np.abs(S) + H
    try:
        W = np.linalg.solve(np.eye(n) - K, y) * (1 + 1e-6)
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(W).all() and (W > 0).all() and (K @ W + y <= W * (1 - 1e-9)).all()):
        return None
    terms: Any = (-C[0] @ g0, -(C[0] @ g1 + C[1] @ g0), -(C[0] @ g2 + C[1] @ g1))
    W, reach = W[:, :-1], np.abs(channels.C[0]) + high * np.abs(channels.C[1])
    left = reach @ (W + 32 * n * EPS * grown) + np.abs(C[1]) @ np.abs(g2)
    return Response(terms, left * (1 + 1e-12))


def positive(M: Any, beside: float) -> bool:
    """Whether a Hermitian matrix minus `beside` times 1 is positive, by a Cholesky factor with room for rounding."""
    n = len(M)
    room = beside + 8 * (n + 4) * EPS * float(np.trace(M).real)
    try:
        np.linalg.cholesky(M - room * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(M).all())


def excludes_zero(r: Response, m: Multiplier, half: float = 0.0) -> bool:
    """Whether F > 0 for all |t| <= 1, and D > 0, where D and G move with t by `half` times their slopes."""
    N0, N1, N2 = r.terms
    n = len(m.D)
    D, G = m.D, m.G
    none = np.zeros_like(D)
    dD, dG = (none, none) if m.slopes is None else (half * m.slopes[0], half * m.slopes[1])

    def both(M: Any) -> Any:
        return M + M.conj().T

    H0, H1, H2 = (N.conj().T for N in r.terms)
    D0, D1, D2, E0, E1, E2 = (M @ N for M in (D, dD) for N in r.terms)
    F0 = D - H0 @ D0 - both(1j * (G @ N0))
    diagonal = np.diag(F0).real
    if not (diagonal > 0).all():
        return False
    F1 = dD - both(H0 @ D1 + 1j * (G @ N1 + dG @ N0)) - H0 @ E0
    F2 = -both(H0 @ D2 + H0 @ E1 + 1j * (G @ N2 + dG @ N1)) - H1 @ D1
    # beyond second order
    F3 = -both(H1 @ D2 + H0 @ E2 + 1j * (dG @ N2)) - H1 @ E1
    F4 = -both(H1 @ E2) - H2 @ D2
    size = np.abs(N0) + np.abs(N1) + np.abs(N2)
    d, g = np.abs(D) + np.abs(dD), np.abs(G) + np.abs(dG)
    left = np.abs(F3) + np.abs(F4) + np.abs(H2 @ E2)
    left = left + 2 * (size + r.rest).T @ d @ r.rest + 2 * g @ r.rest
    left = left + 64 * (n + 4) * EPS * (size.T @ d @ size + 2 * g @ size + d)
    scale = np.exp2(-np.round(np.log2(diagonal) / 2))
    turn = scale[:, None] * scale
    F0, F1, F2, left = F0 * turn, F1 * turn, F2 * turn, left * turn
    room = float(((left + left.T) / 2).sum(axis=1).max()) * (1 + 1e-12)
    values, vectors = np.linalg.eigh(both(F2) / 2)
    F2 = (vectors * np.minimum(values, 0)) @ vectors.conj().T
    room += GUARD * 100 * n * float(np.abs(values).max())
    middle, F1 = both(F0) / 2 + F2, both(F1) / 2
    D, dD = D * turn, dD * turn
    return (
        positive(middle + F1, room)
        and positive(middle - F1, room)
        and positive(D + dD, 0.0)
        and (m.slopes is None or positive(D - dD, 0.0))
    )
