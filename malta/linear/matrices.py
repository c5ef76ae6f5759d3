"""The matrix [A B; C D] of a system, and systems with more states: inputs that are held or follow, integrals."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError


def system_matrix(A: Any, B: Any = None, C: Any = None, D: Any = None) -> Any:
    """[A B; C D] of numbers, of stacks of them, or of CasADi expressions; None: zeros, in a square whole.

    >>> import numpy as np
    >>> from malta.linear.matrices import system_matrix
    >>> system_matrix(np.eye(1), None, 2 * np.eye(1)).tolist()
    [[1.0, 0.0], [2.0, 0.0]]
    """
    given = [M for M in (A, B, C, D) if M is not None]
    n, m = A.shape[-2:]
    rows, columns = (
        [M.shape[axis] for M in sides if M is not None] for axis, sides in ((-2, (C, D)), (-1, (B, D)))
    )
    k, p = (rows or columns)[0], (columns or rows)[0]
    if any(isinstance(M, ca.SX | ca.MX | ca.DM) for M in given):
        kind = next(type(M) for M in given if isinstance(M, ca.SX | ca.MX | ca.DM))
        shapes = ((n, m), (n, p), (k, m), (k, p))
        parts = [kind(*shape) if M is None else M for M, shape in zip((A, B, C, D), shapes, strict=True)]
        return ca.blockcat([parts[:2], parts[2:]])
    whole = np.zeros(
        (*np.broadcast_shapes(*(M.shape[:-2] for M in given)), n + k, m + p), np.result_type(*given)
    )
    for M, at in zip((A, B, C, D), ((0, 0), (0, m), (n, 0), (n, m)), strict=True):
        if M is not None:
            whole[..., at[0] : at[0] + M.shape[-2], at[1] : at[1] + M.shape[-1]] = M
    return whole


def balanced_units(A: FloatArray, B: FloatArray, C: FloatArray) -> FloatArray:
    """Powers of two t for states x = t xi, in which A t / t', B / t' and C t have rows and columns of like size."""
    n, size = len(A), len(A) + max(B.shape[1], len(C))
    whole = np.zeros((size, size))
    whole[: n + len(C), : n + B.shape[1]] = system_matrix(A, B, C)
    _, (units, _) = linalg.matrix_balance(whole, permute=False, separate=True)
    return np.asarray(units[:n])


def eigenvalues(M: FloatArray) -> ComplexArray:
    """Eigenvalues, complex even where they all are real. CheckError where numbers have overflowed."""
    if not np.isfinite(M).all():
        raise CheckError("the model's numbers overflow")
    return np.asarray(np.linalg.eigvals(M), dtype=complex)


def add_integrals(Ad: FloatArray, Bd: FloatArray, Cd: FloatArray, Ts: float) -> tuple[FloatArray, FloatArray]:
    """The sampled system with e+ = e - Ts y+ appended, the controller's own sums of the measured errors."""
    p = len(Cd)
    A = system_matrix(Ad, None, -Ts * Cd @ Ad, np.eye(p))
    return A, np.vstack([Bd, -Ts * Cd @ Bd])


def covariance(A: FloatArray, W: FloatArray) -> FloatArray:
    """Solve X = A X A' + W by doubling, for a stable A (n x n); slow poles next to 1 take some thirty steps."""
    X, A = W, A.copy()
    for _ in range(60):
        more = A @ X @ A.T
        X, A = X + more, A @ A
        if np.abs(np.diag(more)).max() <= 1e-12 * np.abs(np.diag(X)).max():
            break
    return X
