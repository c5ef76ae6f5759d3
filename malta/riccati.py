"""Riccati equations, scaled before they are solved and checked after; and systems sampled exactly.

Positions in micrometres and sensor variances of 1e-13 m2 beside forces of newtons spread the Hamiltonian over
twenty decades, where unscaled solvers fail or, worse, answer wrongly. So R is made the identity, the states are
scaled until the Hamiltonian is balanced, and time is counted in its largest entry. Systems that do not touch each other
are solved one by one, so that gains between them are exactly zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import linalg, sparse

from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.plant import ComplexArray, FloatArray

RESIDUAL = 1e-9  # largest accepted relative residual of a Riccati equation


class Solution(NamedTuple):
    """X, the optimal gain, and the relative residual that X leaves."""

    X: FloatArray
    K: FloatArray
    residual: float


@np.errstate(all="ignore")  # what overflows fails its check below
def care(A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, what: str = "CARE") -> Solution:
    """Solve A'X + XA - X B R^-1 B' X + Q = 0 for the stabilizing X >= 0; K = R^-1 B' X.

    The Kalman filter is the dual: care(A.T, C.T, W, V).K.T with intensities W, V.

    A, Q : n x n, B : n x m, R : m x m
    Raises InputError (shapes, NaN, Q not >= 0, R not > 0) and CheckError (no stabilizing solution, residual
    above 1e-9, X not >= 0); `what` opens the message.
    """
    X, K, residual = np.zeros_like(A), np.zeros_like(B.T), 0.0
    for i, j in _parts(A, B, Q, R, what):
        part = _care(A[np.ix_(i, i)], B[np.ix_(i, j)], Q[np.ix_(i, i)], R[np.ix_(j, j)], what)
        X[np.ix_(i, i)], K[np.ix_(j, i)] = part.X, part.K
        residual = max(residual, part.residual)
    return Solution(X, K, residual)


def _care(A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, what: str) -> Solution:
    import control

    U, B0 = _normalize(B, R)
    t = _balance(A, B0 @ B0.T, Q)
    for last in (False, True):
        A1, B1, Q1 = A * t / t[:, None], B0 / t[:, None], (Q + Q.T) / 2 * np.outer(t, t)
        rate = np.abs(A1).max() or 1.0
        try:
            X, _, _ = control.care(
                A1 / rate, B1 / np.sqrt(rate), Q1 / rate, np.eye(B.shape[1]), method="scipy"
            )
        except (ValueError, np.linalg.LinAlgError, control.ControlArgument) as error:
            raise CheckError(f"{what}: no stabilizing solution ({_first_sentence(error)})") from error
        t = t if last else _unit_diagonal(t, X)
    X = (X + X.T) / 2
    K1 = B1.T @ X
    closed = A1 - B1 @ K1
    terms = [A1.T @ X, X @ A1, -K1.T @ K1, Q1]
    residual = _check(terms, X, eigenvalues(closed).real.max() / rate, what)
    return Solution(X / np.outer(t, t), linalg.solve_triangular(U.T, K1 / t, lower=False), residual)


@np.errstate(all="ignore")
def dare(
    A: FloatArray,
    B: FloatArray,
    Q: FloatArray,
    R: FloatArray,
    N: FloatArray | None = None,
    what: str = "DARE",
) -> Solution:
    """Solve the discrete Riccati equation for the cost sum x'Qx + 2 x'Nu + u'Ru; u = -Kx.

    A, Q : n x n, B, N : n x m, R : m x m. Raises as `care`.
    """
    N = np.zeros_like(B) if N is None else N
    X, K, residual = np.zeros_like(A), np.zeros_like(B.T), 0.0
    for i, j in _parts(A, B, Q, R, what, N):
        part = _dare(
            A[np.ix_(i, i)], B[np.ix_(i, j)], Q[np.ix_(i, i)], R[np.ix_(j, j)], N[np.ix_(i, j)], what
        )
        X[np.ix_(i, i)], K[np.ix_(j, i)] = part.X, part.K
        residual = max(residual, part.residual)
    return Solution(X, K, residual)


def _dare(A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, N: FloatArray, what: str) -> Solution:
    import control

    U, B0 = _normalize(B, R)
    S = linalg.solve_triangular(U, N.T, lower=True).T
    A0, Q0 = A - B0 @ S.T, Q - S @ S.T  # the cross term, absorbed into u + S'x
    t = _balance(A0 - np.eye(len(A)), B0 @ B0.T, Q0)
    for last in (False, True):
        A1, B1, Q1 = A0 * t / t[:, None], B0 / t[:, None], (Q0 + Q0.T) / 2 * np.outer(t, t)
        size = np.abs(Q1).max() or 1.0  # X counts in units of Q
        R1 = np.eye(B.shape[1]) / size
        try:
            X, _, _ = control.dare(A1, B1, Q1 / size, R1, method="scipy")
        except (ValueError, np.linalg.LinAlgError, control.ControlArgument) as error:
            raise CheckError(f"{what}: no stabilizing solution ({_first_sentence(error)})") from error
        t = t if last else _unit_diagonal(t, X * size)
    X = (X + X.T) / 2
    K1 = np.linalg.solve(R1 + B1.T @ X @ B1, B1.T @ X @ A1)
    closed = A1 - B1 @ K1
    terms = [A1.T @ X @ A1, -X, -(A1.T @ X @ B1) @ K1, Q1 / size]
    residual = _check(terms, X, np.abs(eigenvalues(closed)).max() - 1, what)
    K = linalg.solve_triangular(U.T, K1 / t + S.T, lower=False)
    return Solution(X * size / np.outer(t, t), K, residual)


def _parts(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, what: str, N: FloatArray | None = None
) -> list[tuple[NDArray[np.int_], NDArray[np.int_]]]:
    """Check the arguments; the states and inputs of each subsystem that nothing joins to the others."""
    n, m = B.shape
    named = {"A": (A, (n, n)), "B": (B, (n, m)), "Q": (Q, (n, n)), "R": (R, (m, m))}
    if N is not None:
        named["N"] = (N, (n, m))
    for name, (M, shape) in named.items():
        if M.shape != shape:
            raise InputError(what, name, f"shape {M.shape}", f"{shape}, as B is {B.shape}")
        if not np.isfinite(M).all():
            raise InputError(what, name, "NaN or infinity", "finite numbers")
    for name, M in (("Q", Q), ("R", R)):
        if np.abs(M - M.T).max() > 1e-12 * np.abs(M).max():
            raise InputError(what, name, "an unsymmetric matrix", "a symmetric one")
    if np.linalg.eigvalsh(Q).min() < -1e-12 * np.abs(Q).max():
        raise InputError(what, "Q", "a negative eigenvalue", "a positive semidefinite matrix")
    if np.linalg.eigvalsh(R).min() <= 0:
        raise InputError(what, "R", "a matrix that is not positive definite", "R > 0")
    touch = np.block([[(A != 0) | (Q != 0), B != 0], [np.zeros((m, n), bool), R != 0]])
    if N is not None:
        touch[:n, n:] |= N != 0
    count, label = sparse.csgraph.connected_components(touch, directed=False)
    parts = [(np.flatnonzero(label[:n] == k), np.flatnonzero(label[n:] == k)) for k in range(count)]
    if any(not len(i) or not len(j) for i, j in parts):  # a state without input, an input without state
        return [(np.arange(n), np.arange(m))]
    return parts


def _normalize(B: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """U of R = U U', and B U^-T, which makes the input weight the identity."""
    U = np.linalg.cholesky((R + R.T) / 2)
    return U, linalg.solve_triangular(U, B.T, lower=True).T


def _balance(A: FloatArray, G: FloatArray, Q: FloatArray) -> FloatArray:
    """State scales t (x = t x_scaled) that balance the Hamiltonian [[A, -G], [-Q, -A']].

    Osborne's iteration, restricted to the scalings that keep it Hamiltonian.
    """
    t = np.ones(len(A))
    A = A - np.diag(np.diag(A))
    for _ in range(100):
        a, g, q = (A * t / t[:, None]) ** 2, (G / np.outer(t, t)) ** 2, (Q * np.outer(t, t)) ** 2
        falls, grows = a.sum(1) + g.sum(1), a.sum(0) + q.sum(0)  # with t
        both = (falls > 0) & (grows > 0)
        # G_ii and Q_ii change with t_i^2, squared here: with the fourth root of off-diagonal entries they oscillate.
        t = t * np.where(both, falls / np.where(both, grows, 1), 1) ** 0.125
    return _powers_of_two(t)


def _unit_diagonal(t: FloatArray, X: FloatArray) -> FloatArray:
    """Scales on which X, solved on the scales t, has a diagonal of ones: it is then found to most digits.

    Balance alone leaves X large where weights are weak and the regulator only mirrors the unstable poles.
    """
    diagonal = np.diag(X)
    return _powers_of_two(t / np.sqrt(np.where(diagonal > 0, diagonal, 1)))


def _powers_of_two(t: FloatArray) -> FloatArray:
    return np.asarray(np.exp2(np.round(np.log2(t))))  # scaling by them adds no rounding


def _check(terms: list[FloatArray], X: FloatArray, instability: float, what: str) -> float:
    size = sum(np.linalg.norm(term) for term in terms)
    residual = float(np.linalg.norm(sum(terms)) / size) if size else 0.0
    if not residual <= RESIDUAL:
        raise CheckError(f"{what}: the relative residual is {residual:.1e}, allowed {RESIDUAL:.0e}")
    if not instability < 0:
        raise CheckError(f"{what}: the closed loop is not stable (excess {instability:.1e})")
    if np.linalg.eigvalsh(X).min() < -1e-9 * np.abs(X).max():
        raise CheckError(f"{what}: the solution is not positive semidefinite")
    return residual


def _first_sentence(error: Exception) -> str:
    return str(error).split(";")[0].split(". ")[0].rstrip(".")


def eigenvalues(M: FloatArray) -> ComplexArray:
    """Eigenvalues, complex even where they all are real. CheckError where numbers have overflowed."""
    if not np.isfinite(M).all():
        raise CheckError("the model's numbers overflow")
    return np.asarray(np.linalg.eigvals(M), dtype=complex)


def sample(A: FloatArray, B: FloatArray, Ts: float) -> tuple[FloatArray, FloatArray]:
    """Zero-order hold: Ad = e^(A Ts), Bd = integral of e^(A s) B over one sample."""
    n, m = B.shape
    E = _exponential(np.block([[A, B], [np.zeros((m, n + m))]]) * Ts)
    return E[:n, :n], E[:n, n:]


def delay_inputs(Ad: FloatArray, Bd: FloatArray, delay: int) -> tuple[FloatArray, FloatArray]:
    """The sampled system whose inputs act `delay` samples late; stored inputs follow x, the oldest first."""
    n, m = Bd.shape
    if delay == 0:
        return Ad, Bd
    stored = m * delay
    A = np.zeros((n + stored, n + stored))
    A[:n, :n], A[:n, n : n + m] = Ad, Bd
    A[n:, n:] = np.eye(stored, k=m)  # each stored input moves up one place
    return A, np.vstack([np.zeros((n + stored - m, m)), np.eye(m)])


def add_lags(A: FloatArray, B: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    """The continuous system whose inputs follow as first-order lags, rate / (s + rate); they are states after x."""
    m = B.shape[1]
    lagged = np.block([[A, B], [np.zeros((m, len(A))), -rate * np.eye(m)]])
    return lagged, np.vstack([np.zeros_like(B), rate * np.eye(m)])


def add_integrals(Ad: FloatArray, Bd: FloatArray, Cd: FloatArray, Ts: float) -> tuple[FloatArray, FloatArray]:
    """The sampled system with e+ = e - Ts y+ appended, the controller's own sums of the measured errors."""
    p = len(Cd)
    A = np.block([[Ad, np.zeros((len(Ad), p))], [-Ts * Cd @ Ad, np.eye(p)]])
    return A, np.vstack([Bd, -Ts * Cd @ Bd])


def sample_cost(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, Ts: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The integral of x'Qx + u'Ru over a sample, u held: Qd, Nd, Rd of x'Qd x + 2 x'Nd u + u'Rd u.

    Van Loan, IEEE Trans. Autom. Control 23(3), 1978; the weights of MATLAB's lqrd.
    """
    n, m = B.shape
    F = np.zeros((n + m, n + m))
    F[:n, :n], F[:n, n:] = A, B
    Wd = _gramian(F.T, linalg.block_diag(Q, R), Ts)
    return Wd[:n, :n], Wd[:n, n:], Wd[n:, n:]


def sample_noise(A: FloatArray, W: FloatArray, Ts: float) -> FloatArray:
    """Covariance that white noise of intensity W leaves in x after one sample (Van Loan)."""
    return _gramian(A, W, Ts)


def _gramian(A: FloatArray, W: FloatArray, Ts: float) -> FloatArray:
    """Integral of e^(A s) W e^(A' s) over a sample, from one exponential; W counts in its largest entry."""
    n, size = len(A), np.abs(W).max() or 1.0
    E = _exponential(np.block([[-A, W / size], [np.zeros((n, n)), A.T]]) * Ts)
    G = E[n:, n:].T @ E[:n, n:] * size
    return np.asarray((G + G.T) / 2)


def _exponential(M: FloatArray) -> FloatArray:
    with np.errstate(all="ignore"):
        E = linalg.expm(M) if np.abs(M).max() < 1e8 else np.array([np.inf])  # e^710 is past the largest float
    if not np.isfinite(E).all():
        raise CheckError(
            "the sampled model's numbers overflow: no sample time of this length for so fast a machine"
        )
    return np.asarray(E)
