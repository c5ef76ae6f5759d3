"""A linear system by its matrices, and its frequency response."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg, sparse
from scipy.linalg import matrix_balance

from malta.arrays import ComplexArray, FloatArray


def balanced_units(A: FloatArray, B: FloatArray, C: FloatArray) -> FloatArray:
    """Powers of two t for states x = t xi, in which A t / t', B / t' and C t have rows and columns of like size."""
    n, size = len(A), len(A) + max(B.shape[1], len(C))
    whole = np.zeros((size, size))
    whole[: n + len(C), : n + B.shape[1]] = np.block([[A, B], [C, np.zeros((len(C), B.shape[1]))]])
    _, (units, _) = matrix_balance(whole, permute=False, separate=True)
    return np.asarray(units[:n])


class System(NamedTuple):
    """x' = A x + B u, y = C x + D u; of a sampled system (x+ - x) / T = A x + B u."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @classmethod
    def of(cls, source: Any) -> System:
        """The matrices of a control.StateSpace."""
        return cls(*(np.array(M, dtype=float) for M in (source.A, source.B, source.C, source.D)))

    @property
    def balanced(self) -> System:
        """The same system with states in balanced units."""
        if not len(self.A):
            return self
        t = balanced_units(self.A, self.B, self.C)
        return System(self.A * t / t[:, None], self.B / t[:, None], self.C * t, self.D)

    def response(self, s: ComplexArray) -> ComplexArray:
        """C (s - A)^-1 B + D at k complex frequencies s, in differences (z - 1) / T: k x outputs x inputs.

        NaN at a frequency that no double number tells from a pole.
        """
        return self.response_function()(s)

    def response_function(self) -> Callable[[ComplexArray], ComplexArray]:
        """The function `response`, for several calls: what does not depend on the frequencies is computed once."""
        A, B, C, D = self.balanced
        label = sparse.csgraph.connected_components(A != 0, directed=False)[1] if len(A) else np.zeros(0)
        states = [np.flatnonzero(label == k) for k in np.unique(label)]  # sets that nothing joins
        parts = [_JoinedStates(A[np.ix_(i, i)], B[i], C[:, i]) for i in states]

        def response(s: ComplexArray) -> ComplexArray:
            through = np.tile(D.astype(complex), (len(s), 1, 1))
            return np.asarray(sum((part.response(s) for part in parts), through))

        return response


MANY = 32  # frequencies from which on a Schur form is worth its time


SLOW = 1e-6  # of the norm of A: frequencies below it, where the Schur form has lost digits of slow poles


@dataclass(frozen=True, eq=False)
class _JoinedStates:
    """C (s - A)^-1 B of states that are joined."""

    A: FloatArray
    B: FloatArray
    C: FloatArray

    @cached_property
    def schur(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """T, Z^H B and C Z of A = Z T Z^H, T upper triangular."""
        T, Z = linalg.schur(self.A, output="complex")
        return T, Z.conj().T @ self.B, self.C @ Z

    def response(self, s: ComplexArray) -> ComplexArray:
        """At each s; NaN at a frequency that no double number tells from a pole."""
        used = np.flatnonzero(self.B.any(axis=0))
        solved = np.empty((len(s), len(self.C), len(used)), dtype=complex)
        fast = np.zeros(len(s), dtype=bool)
        if len(s) >= MANY:
            fast = np.abs(s) > SLOW * np.linalg.norm(self.A)
            fast &= np.abs(s[:, None] - np.diag(self.schur[0])).min(axis=1) > 0
            solved[fast] = self._substituted(s[fast], used)
        if not fast.all():
            solved[~fast] = self.C @ _resolvent(s[~fast], self.A, self.B[:, used])
        found = np.zeros((len(s), len(self.C), self.B.shape[1]), dtype=complex)
        found[:, :, used] = solved
        return found

    def _substituted(self, s: ComplexArray, used: Any) -> ComplexArray:
        """C Z (s - T)^-1 Z^H B of some inputs, from the last row of T upwards, all frequencies at once."""
        T, B, C = self.schur
        X = np.empty((len(T), len(used), len(s)), dtype=complex)
        for i in range(len(T) - 1, -1, -1):
            later = T[i, i + 1 :] @ X[i + 1 :].reshape(len(T) - i - 1, X[0].size)
            X[i] = (B[i, used, None] + later.reshape(X[0].shape)) / (s - T[i, i])
        return np.asarray(np.tensordot(C, X, 1).transpose(2, 0, 1))


def _resolvent(s: ComplexArray, A: FloatArray, B: FloatArray) -> ComplexArray:
    """(s - A)^-1 B at each s; NaN at a frequency that no double number tells from a pole."""
    matrices = s[:, None, None] * np.eye(len(A)) - A
    try:
        return np.asarray(np.linalg.solve(matrices, B.astype(complex)))
    except np.linalg.LinAlgError:  # a frequency on a pole: beside it
        beside = matrices + 1e-9 * s[:, None, None] * np.eye(len(A))
        found = np.full((len(s), *B.shape), np.nan, dtype=complex)
        for k, one in enumerate(beside):
            with suppress(np.linalg.LinAlgError):
                found[k] = np.linalg.solve(one, B)
        return found
