"""Systems without the states that no input moves or no output sees, and the poles that were dropped with them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.linear.system import System

RANK = 1e-10  # of the size of the balanced matrices: what reaches further states counts as zero below it


class Minimal(NamedTuple):
    """A system without hidden states, and the poles of these."""

    system: System
    uncontrollable: ComplexArray  # that no input moves
    unobservable: ComplexArray  # that inputs move and no output sees


def minimal(system: System) -> Minimal:
    """A minimal realization, with the poles that are hidden: first those without inputs, then those without outputs.

    States are split where what reaches the next ones is RANK of the size of the balanced matrices.

    >>> import numpy as np
    >>> from malta.linear.minimal import minimal
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
