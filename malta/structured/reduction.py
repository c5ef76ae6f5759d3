"""Laws of lower order: the states that matter least at input and output are left out, integrals are kept.

Source: B. C. Moore, Principal component analysis in linear systems, IEEE Trans. Automat. Contr. 26(1), 1981; the bound
of the error is that of D. F. Enns, CDC 1984, and K. Glover, Int. J. Control 39(6), 1984.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from malta.errors import InputError
from malta.synthesis.elements import CALLER
from malta.synthesis.state_space import System

SLOW = 1.0  # rad/s: a pole below counts as an integral


def split_integrals(law: System) -> tuple[System, System]:
    """Split a continuous law into its integrals, with their poles at 0, and the rest, with D.

    Poles below 1 rad/s count as integrals. The sum of both is the law, but for these poles.

    >>> from malta.synthesis.state_space import System
    >>> import numpy as np
    >>> law = System(np.diag([0.0, -10.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    >>> integrals, rest = split_integrals(law)
    >>> integrals.A.tolist(), rest.A.round(6).tolist()
    ([[0.0]], [[-10.0]])
    """
    A, B, C, D = law.balanced
    S, Z, k = linalg.schur(A, sort=lambda re, im: bool(np.hypot(re, im) < SLOW))
    V = Z.copy()
    V[:, k:] += Z[:, :k] @ linalg.solve_sylvester(S[:k, :k], -S[k:, k:], -S[:k, k:])
    A, B, C = np.linalg.solve(V, A @ V), np.linalg.solve(V, B), C @ V
    return System(0 * A[:k, :k], B[:k], C[:, :k], 0 * D), System(A[k:, k:], B[k:], C[:, k:], D)


def truncate(law: System, order: int) -> System:
    """Leave out states of a stable law, those of the smallest Hankel singular values sigma: balanced truncation.

        |G - G_r| <= 2 (sigma_(order+1) + ... + sigma_n)

    Raises InputError for an unstable law, and for an order that it does not have.

    >>> from malta.synthesis.state_space import System
    >>> import numpy as np
    >>> law = System(np.diag([-1.0, -100.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    >>> truncate(law, 1).A.round(2).tolist()
    [[-1.02]]
    """
    A, B, C, D = law
    if not 0 <= order <= len(A):
        raise InputError(CALLER, "order", str(order), f"0 to {len(A)}, of the law")
    if len(A) and not np.linalg.eigvals(A).real.max() < 0:
        raise InputError(CALLER, "law", "an unstable one", "a stable one: split off its integrals")
    P = linalg.cholesky(linalg.solve_continuous_lyapunov(A, -B @ B.T), lower=True)
    Q = linalg.cholesky(linalg.solve_continuous_lyapunov(A.T, -C.T @ C), lower=True)
    U, sizes, V = linalg.svd(Q.T @ P)
    left = (U[:, :order] / np.sqrt(sizes[:order])).T @ Q.T
    right = P @ V[:order].T / np.sqrt(sizes[:order])
    return System(left @ A @ right, left @ B, C @ right, D)
