"""Systems that are balanced and cut, with the Hankel singular values that they miss and the error that these bound."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.linear.minimal import RANK
from malta.linear.system import System


class Reduced(NamedTuple):
    """A balanced system of fewer states, and what it misses."""

    system: System
    hankel: FloatArray  # singular values of the whole, the largest first
    error: float  # bound of sigma_max(G - G_r) at every frequency: twice the sum of the dropped ones


def balanced_reduction(system: System, order: int) -> Reduced:
    """The states of a stable system with the largest Hankel singular values, both Gramians diagonal and equal.

        sigma_max(G(jw) - G_r(jw)) <= 2 sum of the dropped Hankel singular values

    (Moore, IEEE Trans. Autom. Control 26(1), 1981; Glover, Int. J. Control 39(6), 1984). The order may come out lower
    where states are hidden.

    Raises CheckError for a system that is not stable, and InputError for an order that is no number of its states.

    >>> import numpy as np
    >>> from malta.linear.reduction import balanced_reduction
    >>> from malta.linear.system import System
    >>> two = System(np.diag([-1.0, -100.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    >>> found = balanced_reduction(two, 1)
    >>> len(found.system.A), found.error < 0.01
    (1, True)
    """
    if not 0 <= order <= len(system.A):
        raise InputError("balanced_reduction", "order", f"{order}", f"0 to {len(system.A)} states")
    if not system.stable:
        raise CheckError("balanced reduction wants a stable system: one pole or more does not decay")
    A, B, C, D = system.balanced
    solve = linalg.solve_continuous_lyapunov if system.dt is None else _discrete_lyapunov
    P, Q = _root(solve(A, -B @ B.T)), _root(solve(A.T, -C.T @ C))
    U, hankel, V = linalg.svd(Q.T @ P)
    r = min(order, int((hankel > RANK * hankel.max(initial=0.0)).sum()))
    scale = np.sqrt(hankel[:r])
    left, right = (U[:, :r] / scale).T @ Q.T, P @ V[:r].T / scale
    found = System(
        left @ A @ right, left @ B, C @ right, D, None, system.dt, (), system.inputs, system.outputs
    )
    return Reduced(found, hankel, 2 * float(hankel[r:].sum()))


def _discrete_lyapunov(A: FloatArray, Q: FloatArray) -> FloatArray:
    """X of A X A' - X = Q."""
    return np.asarray(linalg.solve_discrete_lyapunov(A, -Q))


def _root(X: FloatArray) -> FloatArray:
    """R of X = R R', for a covariance that rounding may have made indefinite."""
    values, vectors = linalg.eigh((X + X.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
