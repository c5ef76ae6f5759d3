"""How far rounding may move a solution: tolerances from the condition of what is solved, on any processor.

Kernels of linear algebra add in different orders, so two of them solve two problems whose entries differ by some EPS.
What they find then differs by EPS times the condition of the problem, whatever one processor printed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg

if TYPE_CHECKING:
    from malta.arrays import FloatArray

EPS = float(np.finfo(float).eps)
OPERATIONS = 10  # roundings that add up in an entry of a small problem


def of_gain(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, X: FloatArray, *, sampled: bool = False,
    residual: float = 0.0,
) -> FloatArray:  # fmt: skip
    """How far the gain K of a Riccati equation moves, a row for each input, as X is off by rounding or a residual.

    dX = L^-1 (dQ + dA'X + X dA - X dG X), L the Lyapunov operator of A - B K (Kenney, Hewer, SIAM J. Control Optim.
    28(1), 1990), whose norm is that of its answer to the identity; states are scaled so that X has a diagonal of ones.

    X : the solution; sampled : of x+ = A x + B u; residual : relative, of the equation; 0: rounding alone
    """
    t = 1 / np.sqrt(np.diag(X))
    A, B, Q, X = A * t / t[:, None], B / t[:, None], Q * np.outer(t, t), X * np.outer(t, t)
    H = R + sampled * B.T @ X @ B
    closed = A - B @ np.linalg.solve(H, B.T @ X @ (A if sampled else np.eye(len(A))))
    one, size = np.eye(len(A)), np.linalg.norm
    G = size(B @ np.linalg.solve(H, B.T), 2) * size(X, 2) ** 2
    if sampled:
        back = size(linalg.solve_discrete_lyapunov(closed.T, one), 2)
        terms = size(Q) + (1 + size(A, 2)) ** 2 * size(X, 2) + G * size(closed, 2) ** 2
    else:
        back = size(linalg.solve_continuous_lyapunov(closed.T, -one), 2)
        terms = size(Q) + 2 * size(A, 2) * size(X, 2) + G
    dX = back * terms * max(residual, OPERATIONS * EPS)
    moved = np.linalg.norm(np.linalg.solve(H, B.T), axis=1, keepdims=True)
    return np.asarray(dX * moved * (size(closed, 2) if sampled else 1.0) / t)
