"""A pencil on an interval of frequency as N: det M(jx) = 0 on the box only where det(1 - N(x) Delta) = 0.

M = L + B Delta C with L at the middle of the box, and N = -C L^-1 B. On x = x0 + h t, |t| <= 1, with X about L(x0)^-1
and S = X L', L^-1 B = g_0 + t g_1 + t^2 g_2 + rest, where g_1 = X B' - S g_0, g_2 = -S g_1, and

    |rest| <= (1 - |S| - H)^-1 (|S g_2| + H (|g_0| + |g_1| + |g_2|)),   H: rounding, and all that M has beside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.proof.multipliers.multipliers import Blocks, Multiplier
from malta.proof.multipliers.pencil import EPS, Expansion

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray
    from malta.proof.multipliers.pencil import Pencil

FINE = 1e-11  # of the largest: what a slope has below that is no channel
COARSE = 3e-4  # where a hold curves the slopes
SMALL = 1e-7  # of M: a rest below that is taken with the rounding
SMALLEST = 1e-10  # where slopes are factored to the last digit
GUARD = 1e-13


class Channels(NamedTuple):
    """Slopes factored, constant parts and those of jx: sum_i delta_i M_i = B Delta C, and the block of what is left."""

    B: tuple[FloatArray, FloatArray]
    C: tuple[FloatArray, FloatArray]
    blocks: Blocks
    owners: FloatArray  # parameter of each channel; -1: of the block


@dataclass(frozen=True, eq=False)
class Branch:
    """One branch of frequency of a pencil, rows and columns scaled about the frequency x."""

    pencil: Pencil
    branch: int
    x: float

    @cached_property
    def parts(self) -> tuple[Expansion, Expansion]:
        own = self.pencil.branch(self.branch)
        size = own[0].size + self.x * own[1].size
        rows, columns = np.ones(len(size)), np.ones(len(size))
        for _ in range(6):
            rows = 1 / np.maximum((size * columns).max(axis=1), 1e-300)
            columns = 1 / np.maximum((size * rows[:, None]).max(axis=0), 1e-300)
        rows, columns = (np.exp2(np.round(np.log2(v))) for v in (rows, columns))
        turn = rows[:, None] * columns
        return tuple(Expansion(p.middle * turn, p.slopes * turn, p.rest * turn) for p in own)  # type: ignore[return-value]

    @cached_property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(np.isfinite(M).all() for p in self.parts for M in (p.middle, p.slopes, p.rest))

    @cached_property
    def channels(self) -> tuple[Channels, FloatArray, FloatArray]:
        """The channels, and the rest of the constant part and of the factor of x."""
        one, two = self.parts
        n = len(one.middle)
        rest = [one.rest.copy(), two.rest.copy()]
        coarse = COARSE if self.pencil.curved else FINE
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
        whole = np.where(whole > (SMALL if self.pencil.curved else SMALLEST), whole, 0)
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
        return Channels((B0, B1), (C0, C1), Blocks(tuple(sizes), other), np.array(owners)), rest[0], rest[1]


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
