"""Smaller systems: without the states that no input moves or no output sees, or balanced and cut.

Both say what they leave out: the poles that were dropped, or the Hankel singular values and the error that they bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.linear.system import System

RANK = 1e-10  # of the size of the balanced matrices: what reaches further states counts as zero below it


class Minimal(NamedTuple):
    """A system without hidden states, and the poles of these."""

    system: System
    uncontrollable: ComplexArray  # that no input moves
    unobservable: ComplexArray  # that inputs move and no output sees


class Reduced(NamedTuple):
    """A balanced system of fewer states, and what it misses."""

    system: System
    hankel: FloatArray  # singular values of the whole, the largest first
    error: float  # bound of sigma_max(G - G_r) at every frequency: twice the sum of the dropped ones


def minimal(system: System) -> Minimal:
    """A minimal realization, with the poles that are hidden: first those without inputs, then those without outputs.

    States are split where what reaches the next ones is RANK of the size of the balanced matrices.

    >>> import numpy as np
    >>> from malta.linear.reduction import minimal
    >>> from malta.linear.system import System
    >>> one, b = np.zeros((1, 1)), np.array([[1.0], [0.0]])
    >>> found = minimal(System(np.diag([-1.0, 3.0]), b, np.ones((1, 2)), one))
    >>> found.system.poles.real.tolist(), found.uncontrollable.real.tolist()
    ([-1.0], [3.0])
    """
    A, B, C, D = system.balanced
    V, n = _reachable(A, B)
    uncontrollable = np.linalg.eigvals(V[:, n:].T @ A @ V[:, n:]).astype(complex)
    A, B, C = V[:, :n].T @ A @ V[:, :n], V[:, :n].T @ B, C @ V[:, :n]
    V, n = _reachable(A.T, C.T)
    unobservable = np.linalg.eigvals(V[:, n:].T @ A @ V[:, n:]).astype(complex)
    A, B, C = V[:, :n].T @ A @ V[:, :n], V[:, :n].T @ B, C @ V[:, :n]
    found = System(A, B, C, D, None, system.dt, (), system.inputs, system.outputs)
    return Minimal(found, uncontrollable, unobservable)


def _reachable(A: FloatArray, B: FloatArray) -> tuple[FloatArray, int]:
    """Orthogonal states of which the first n are those that inputs move, and n (a staircase of ranks)."""
    V, found = np.eye(len(A)), 0
    size = max(float(np.linalg.norm(A, 2)) if len(A) else 0.0, 1e-300)
    new, least = B, RANK * max(float(np.abs(B).max(initial=0.0)), 1e-300)
    while new.size:
        U, s, _ = linalg.svd(new)
        rank = int((s > least).sum())
        if not rank:
            break
        V[:, found:] = V[:, found:] @ U
        found += rank
        A_now = V.T @ A @ V
        new, least = A_now[found:, found - rank : found], RANK * size
    return V, found


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
