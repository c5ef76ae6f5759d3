"""Figures of a stable linear system with their exact derivatives: peaks of its gain, its noise, its poles.

    peak    max over w of sigma_max(G(jw)): a level is exceeded between frequencies at which a Hamiltonian matrix has
            eigenvalues jw (Boyd, Balakrishnan and Kabamba), so that no grid can miss a peak
    noise   sqrt(tr C X C'),  A X + X A' + B B' = 0
    poles   Re(lambda), with the left and right eigenvectors

All are differentiated by a matrix M that acts as A + B2 M C2 does: the output of each derivative has the shape of M.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg

from malta.errors import CheckError
from malta.synthesis.state_space import System

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

RISE = 1e-7  # relative, above the largest gain that was found, at which a search ends
NEAR = 1e-6  # |Re| of an eigenvalue over its size, up to which it may lie on the imaginary axis
ROUNDS = 9  # of the refinement of a peak
POINTS = 9  # in each of them
SHARES = (0.7, 0.85, 0.95, 0.99)  # of the largest gain: maxima are looked for between their crossings
LEVELS = 30  # at most


class Peak(NamedTuple):
    """A local maximum of the largest singular value, with the vectors that belong to it."""

    w: float  # rad/s, or infinite
    value: float
    left: ComplexArray
    right: ComplexArray


def response_at(system: System, w: FloatArray) -> ComplexArray:
    """G(jw) at k frequencies in rad/s, infinite ones among them: k x outputs x inputs."""
    found = np.broadcast_to(system.D.astype(complex), (len(w), *system.D.shape)).copy()
    finite = np.isfinite(w)
    if len(system.A) and finite.any():
        resolvent = 1j * w[finite, None, None] * np.eye(len(system.A)) - system.A
        found[finite] += system.C @ np.linalg.solve(resolvent, system.B.astype(complex))
    return found


def _sizes(system: System, w: FloatArray) -> FloatArray:
    G = response_at(system, w)
    if 1 in G.shape[1:]:
        return np.asarray(np.linalg.norm(G, axis=(1, 2)))
    return np.asarray(np.linalg.norm(G, 2, axis=(1, 2)))


def _crossings(system: System, level: float) -> FloatArray:
    """The frequencies at which a singular value of G may be equal to a level, in order: eigenvalues near jw."""
    A, B, C, D = system
    R = D.T @ D - level**2 * np.eye(B.shape[1])
    S = D @ D.T - level**2 * np.eye(len(C))
    own = A - B @ np.linalg.solve(R, D.T @ C)
    H = np.block([[own, -level * B @ np.linalg.solve(R, B.T)], [level * C.T @ np.linalg.solve(S, C), -own.T]])
    found = np.linalg.eigvals(H)
    on_axis = np.abs(found.real) <= NEAR * np.abs(found) + 1e-300
    return np.unique(np.abs(found[on_axis].imag))


def peak_gain(system: System) -> tuple[float, float]:
    """The largest gain of a stable system over all frequencies, and where it lies: (value, rad/s).

    Its levels rise from gains that were found, until the Hamiltonian matrix has no imaginary eigenvalues at RISE above
    the last one (Bruinsma and Steinbuch).
    """
    system = system.balanced
    w = np.array([0.0, np.inf])
    if len(system.A):
        poles = np.linalg.eigvals(system.A)
        w = np.concatenate([w, np.abs(poles), np.abs(poles.imag)])
    sizes = _sizes(system, w)
    if not np.isfinite(sizes).all():
        return math.inf, float(w[~np.isfinite(sizes)][0])
    k = int(sizes.argmax())
    best, where = float(sizes[k]), float(w[k])
    if not len(system.A) or best == 0.0:
        return best, where
    for _ in range(LEVELS):
        ends = _crossings(system, best * (1 + RISE))
        if not len(ends):
            return best, where
        w = np.concatenate([ends, np.sqrt(ends[1:] * ends[:-1]), ends[:1] / 2, 2 * ends[-1:]])
        sizes = _sizes(system, w)
        k = int(sizes.argmax())
        if not sizes[k] > best * (1 + RISE):
            return max(best, float(sizes[k])), where if best >= sizes[k] else float(w[k])
        best, where = float(sizes[k]), float(w[k])
    return best, where


def peaks_of(system: System) -> list[Peak]:
    """The local maxima of a stable system's gain that come near the largest one.

    One that rises above a share of the largest, between places where the gain is below it, is found for certain: these
    places are eigenvalues of a Hamiltonian matrix.
    """
    system = system.balanced
    best, where = peak_gain(system)
    if not math.isfinite(best) or best == 0.0:
        return []
    scale = where if 0 < where < math.inf else _middle_of(system)
    poles = np.linalg.eigvals(system.A) if len(system.A) else np.zeros(0)
    levels = [_crossings(system, share * best) for share in SHARES] if len(poles) else []
    w = np.concatenate([np.abs(poles), [where], *levels])
    at = np.unique(np.concatenate([[0.0, math.pi], 2 * np.arctan(w / scale)]))
    angle = np.unique(np.concatenate([at, (at[1:] + at[:-1]) / 2]))
    sizes = _sizes(system, _frequency(angle, scale))
    before, after = np.append(-np.inf, sizes[:-1]), np.append(sizes[1:], -np.inf)
    tops = np.flatnonzero((sizes >= before) & (sizes > after) & (sizes > SHARES[0] * best))
    low, high = angle[np.maximum(tops - 1, 0)], angle[np.minimum(tops + 1, len(angle) - 1)]
    found = [_peak_at(system, w) for w in _refined(system, low, high, scale).tolist()]
    if not found or max(peak.value for peak in found) < best * (1 - 1e-6):
        found.append(_peak_at(system, where))
    return found


def _middle_of(system: System) -> float:
    """A frequency amid those of a system's poles, rad/s."""
    sizes = np.abs(np.linalg.eigvals(system.A)) if len(system.A) else np.zeros(0)
    sizes = sizes[sizes > 0]
    return float(np.exp(np.log(sizes).mean())) if len(sizes) else 1.0


def _frequency(angle: FloatArray, scale: float) -> FloatArray:
    """The frequencies w = scale tan(angle / 2), rad/s; at pi infinite."""
    w = scale * np.tan(np.minimum(angle, math.pi) / 2)
    return np.where(angle >= math.pi - 1e-12, np.inf, w)


def _refined(system: System, low: FloatArray, high: FloatArray, scale: float) -> FloatArray:
    """The frequency of the largest gain between each two angles."""
    rows = np.arange(len(low))
    where = high
    for _ in range(ROUNDS):
        angle = np.linspace(low, high, POINTS, axis=1)
        sizes = _sizes(system, _frequency(angle.ravel(), scale)).reshape(angle.shape)
        k = sizes.argmax(axis=1)
        where = angle[rows, k]
        low, high = angle[rows, np.maximum(k - 1, 0)], angle[rows, np.minimum(k + 1, POINTS - 1)]
    return _frequency(where, scale)


def _peak_at(system: System, w: float) -> Peak:
    U, s, V = np.linalg.svd(response_at(system, np.array([w]))[0])
    return Peak(w, float(s[0]), U[:, 0], V[0].conj())


class Channels(NamedTuple):
    """How a matrix M acts on a system: A + B2 M C2, B1 + B2 M D21, C1 + D12 M C2, D11 + D12 M D21."""

    B2: FloatArray
    C2: FloatArray
    D12: FloatArray
    D21: FloatArray


def gain_slope(system: System, by: Channels, peak: Peak, weight: complex = 1.0) -> FloatArray:
    """The derivative of |weight| sigma_max(G(jw)) by M at a peak, whose frequency needs none: inputs of M x outputs."""
    into, out = by.D12.astype(complex), by.D21.astype(complex)
    if math.isfinite(peak.w) and len(system.A):
        resolvent = 1j * peak.w * np.eye(len(system.A)) - system.A
        into = into + system.C @ np.linalg.solve(resolvent, by.B2.astype(complex))
        out = out + by.C2 @ np.linalg.solve(resolvent, system.B.astype(complex))
    left = (peak.left.conj() * weight) @ into
    return np.real(np.outer(left, out @ peak.right))


def noise(system: System, by: Channels | None = None) -> tuple[float, FloatArray | None]:
    """The root of the sum of squares of a stable system's impulse responses (its H2 norm), and its derivative by M.

    Raises CheckError for a system with D, whose output has no variance under white noise.
    """
    if np.abs(system.D).max(initial=0.0) > 0:
        raise CheckError("white noise reaches an output at once: its variance is infinite")
    A, B, C, _ = system
    X = linalg.solve_continuous_lyapunov(A, -B @ B.T)
    value = math.sqrt(max(float(np.trace(C @ X @ C.T)), 0.0))
    if by is None or value == 0.0:
        return value, None if by is None else np.zeros((by.B2.shape[1], len(by.C2)))
    Y = linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    slope = (by.B2.T @ Y + by.D12.T @ C) @ X @ by.C2.T + by.B2.T @ Y @ B @ by.D21.T
    return value, np.asarray(slope / value)


class Pole(NamedTuple):
    """An eigenvalue of A + B2 M C2, and its derivative by M; of a pair the one with Im >= 0."""

    value: complex
    slope: ComplexArray


def poles_of(A: FloatArray, B2: FloatArray, C2: FloatArray, count: int = 0) -> list[Pole]:
    """The eigenvalues of A + B2 M C2 with their derivatives, those that decay slowest first; count: 0 for all."""
    found_eig: Any = linalg.eig(A, left=True, right=True)
    values, left, right = found_eig
    order = [k for k in np.argsort(-values.real) if values[k].imag >= 0]
    found = []
    for k in order[:count] if count else order:
        y, x = left[:, k].conj(), right[:, k]
        overlap = y @ x
        if abs(overlap) < 1e-14:  # a defective pair: its derivative is infinite
            overlap = 1e-14
        found.append(Pole(complex(values[k]), np.outer(y @ B2, C2 @ x) / overlap))
    return found
