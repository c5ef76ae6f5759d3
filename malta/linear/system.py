"""One linear system: its matrices, sample time and names, and what is asked of it alone.

    E x' = A x + B u,   y = C x + D u          x+ in place of x' where it is sampled

Whatever is a linear system is this record: machines, laws, weights, filters and loops. Systems are connected in
`interconnection.py`, read from python-control in `conversion.py` and made smaller in `reduction.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import linalg, sparse

from malta.arguments import describe
from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.linear.matrices import balanced_units, eigenvalues
from malta.linear.sampling import sample

MIN_SCHUR_FREQUENCIES = 32  # frequencies from which on a Schur form is worth its time
SLOW_FREQUENCY = 1e-6  # of the norm of A: below, the Schur form has lost digits of slow poles
INFINITE = 1e8  # of the size of the matrices: zeros beyond it are at infinity, to rounding
RANK = 1e-11  # of the largest singular value: smaller ones count as zero


@dataclass(frozen=True, eq=False)
class System:
    """A linear system E x' = A x + B u, y = C x + D u; with a sample time x+ in place of x'.

    Iterating gives A, B, C and D of the same system solved for x'. Matrices are of numbers, or CasADi expressions of
    parameters. A system in differences has no sample time: (x+ - x) / T = A x + B u, so that s is (z - 1) / T.

    A : n x n
    B : n x m
    C : p x n
    D : p x m
    E : n x n; None: the identity
    dt : sample time, s; None: continuous
    states : names; (): none
    inputs : names; (): none
    outputs : names; (): none

    Raises InputError for shapes, names and a sample time that do not fit.

    >>> import numpy as np
    >>> from malta.linear.system import System
    >>> mass = System(np.diag([1.0], 1), np.array([[0.0], [2.0]]), np.eye(1, 2), np.zeros((1, 1)))
    >>> mass.poles.real.tolist(), mass.response(np.array([2j])).real.item()
    ([0.0, 0.0], -0.5)
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    E: FloatArray | None = None
    dt: float | None = None
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n, m, p = self.A.shape[0], self.B.shape[1], self.C.shape[0]
        shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "E": (n, n)}
        for letter, shape in shapes.items():
            M = getattr(self, letter)
            if M is not None and M.shape != shape:
                raise InputError("System", letter, f"shape {M.shape}", f"{shape}")
        if self.dt is not None and not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError("System", "dt", describe(self.dt), "a sample time above 0 s, or None")
        for field, size in (("states", n), ("inputs", m), ("outputs", p)):
            names = getattr(self, field)
            if names and len(names) != size:
                raise InputError("System", field, " ".join(names), f"{size} names, or none")

    def __iter__(self) -> Iterator[FloatArray]:
        return iter(self.matrices)

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A, B, C and D of the same system solved for x'."""
        own = self.explicit
        return own.A, own.B, own.C, own.D

    @cached_property
    def explicit(self) -> System:
        """The same system with E = 1. Raises CheckError where E is singular."""
        if self.E is None:
            return self
        try:
            A, B = (np.linalg.solve(self.E, M) for M in (self.A, self.B))
        except np.linalg.LinAlgError as error:
            raise CheckError("E is singular: the system is not solved for the rates of its states") from error
        return replace(self, A=A, B=B, E=None)

    @property
    def differences(self) -> System:
        """A sampled system in differences, ((x+ - x) / T), where slow poles keep their digits; else the system."""
        A, B, C, D = self
        T = self.dt
        return System(A, B, C, D) if T is None else System((A - np.eye(len(A))) / T, B / T, C, D)

    @property
    def balanced(self) -> System:
        """The same system with states in balanced units, powers of two."""
        return self.similar(np.diag(balanced_units(self.A, self.B, self.C))) if len(self.A) else self

    def similar(self, T: FloatArray) -> System:
        """The same system in states xi, x = T xi, which have no names. Raises CheckError for a singular T."""
        A, B, C, D = self
        t = np.diag(T)
        if t.all() and not (T - np.diag(t)).any():  # units: exact where they are powers of two
            A, B, C = A * t / t[:, None], B / t[:, None], C * t
        else:
            try:
                A, B, C = np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T
            except np.linalg.LinAlgError as error:
                raise CheckError("no states: the matrix of the new ones is singular") from error
        return System(A, B, C, D, None, self.dt, (), self.inputs, self.outputs)

    def to_control(self, name: str | None = None) -> Any:
        """Make a control.StateSpace: the same matrices and names, with E solved for.

        Where states are in unlike units hand over `balanced`: python-control's responses, by slycot's Hessenberg form,
        lose digits else. At 1 rad/s |S| of the planar motor's PID came out 1800 times too large.
        """
        import control  # imports matplotlib and takes a second: only where it is used

        A, B, C, D = self
        fields = ("states", "inputs", "outputs")
        names = {field: list(getattr(self, field)) for field in fields if getattr(self, field)}
        return control.ss(A, B, C, D, self.dt or 0, name=name, **names)

    def part(self, outputs: Sequence[int | str], inputs: Sequence[int | str]) -> System:
        """The system between some signals, by index or name. Raises InputError for unknown names."""
        rows, columns = _pick(outputs, self.outputs, "outputs"), _pick(inputs, self.inputs, "inputs")
        return replace(
            self,
            B=self.B[:, columns],
            C=self.C[rows, :],
            D=self.D[rows, :][:, columns],
            inputs=tuple(self.inputs[i] for i in columns) if self.inputs else (),
            outputs=tuple(self.outputs[i] for i in rows) if self.outputs else (),
        )

    @property
    def poles(self) -> ComplexArray:
        """The eigenvalues of E^-1 A, of each set of states that act on each other by itself."""
        A, _, _, _ = self
        if not len(A):
            return np.zeros(0, dtype=complex)
        count, label = sparse.csgraph.connected_components(A != 0, connection="strong")
        sets = (np.flatnonzero(label == k) for k in range(count))
        return np.concatenate([eigenvalues(A[np.ix_(i, i)]) for i in sets])

    @property
    def stable(self) -> bool:
        """Whether all poles decay."""
        s = self.poles
        return bool((s.real < 0).all() if self.dt is None else (np.abs(s) < 1).all())

    @property
    def zeros(self) -> ComplexArray:
        """The finite invariant zeros: where [A - s, B; C, D] has less than its normal rank.

        Of any number of inputs and outputs (Emami-Naeini and Van Dooren, Automatica 18(4), 1982).
        """
        A, B, C, D = _without_zeros_at_infinity(*_scale(*self.balanced))
        A, B, C, D = _without_zeros_at_infinity(A.T, C.T, B.T, D.T)  # of a D that is square and regular now
        n = len(A)
        if not n:
            return np.zeros(0, dtype=complex)
        *_, V = linalg.svd(np.hstack([C, D]), full_matrices=True)
        M, N = np.hstack([A, B]) @ V[len(D) :].T, V[len(D) :, :n].T
        found: Any = linalg.eigvals(M, N, homogeneous_eigvals=True)
        alpha, beta = found
        finite = np.abs(alpha) < INFINITE * max(float(np.abs(A).max()), 1e-300) * np.abs(beta)
        return np.asarray(alpha[finite] / beta[finite], dtype=complex)

    def response(self, s: ComplexArray) -> ComplexArray:
        """C (s E - A)^-1 B + D at k places s, or z of a sampled system: k x outputs x inputs.

        NaN at a place that no double number tells from a pole.
        """
        return self.response_function()(s)

    def response_function(self) -> Callable[[ComplexArray], ComplexArray]:
        """The function `response`, for several calls: what does not depend on the frequencies is computed once."""
        A, B, C, D = self.balanced
        label = sparse.csgraph.connected_components(A != 0, directed=False)[1] if len(A) else np.zeros(0)
        states = [np.flatnonzero(label == k) for k in np.unique(label)]  # sets that nothing joins
        parts = [_response_of_joined(A[np.ix_(i, i)], B[i], C[:, i]) for i in states]

        def response(s: ComplexArray) -> ComplexArray:
            through = np.tile(D.astype(complex), (len(s), 1, 1))
            return np.asarray(sum((part(s) for part in parts), through))

        return response

    def sampled(self, Ts: float, delay: float = 0.0) -> System:
        """The system under a zero-order hold every Ts seconds, its inputs `delay` seconds late: exact.

        A delay of d samples and a fraction of one stores d + 1 inputs; the oldest acts for that fraction of a sample.
        """
        A, B, C, D = self
        if self.dt is not None:
            raise InputError("sampled", "system", f"dt = {self.dt:g}", "a continuous system")
        if not (np.isfinite(Ts) and Ts > 0):
            raise InputError("sampled", "Ts", describe(Ts), "a sample time above 0 s")
        if not (np.isfinite(delay) and delay >= 0):
            raise InputError("sampled", "delay", describe(delay), "a time of 0 s or more")
        Ad, Bd = sample(A, B, Ts, delay / Ts)
        late = np.hstack([C, D, np.zeros((len(D), len(Ad)))])[:, : len(Ad)]
        through = D if len(Ad) == len(A) else 0 * D
        return System(Ad, Bd, late, through, None, Ts, (), self.inputs, self.outputs)


def _pick(wanted: Sequence[int | str], known: tuple[str, ...], field: str) -> list[int]:
    missing = [one for one in wanted if isinstance(one, str) and one not in known]
    if missing:
        raise InputError("System", field, repr(missing[0]), "one of " + " ".join(known))
    return [known.index(one) if isinstance(one, str) else one for one in wanted]


def _scale(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The system with inputs and outputs in units in which they are of the size of A: the zeros are the same."""
    size = float(np.abs(A).max(initial=0.0)) or 1.0
    rows = np.abs(np.hstack([C, D])).max(axis=1, initial=0.0, keepdims=True)
    rows = size / np.where(rows > 0, rows, size)
    columns = np.abs(np.vstack([B, rows * D])).max(axis=0, initial=0.0, keepdims=True)
    columns = size / np.where(columns > 0, columns, size)
    return A, B * columns, rows * C, rows * D * columns


def _without_zeros_at_infinity(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The system with its zeros at which outputs without D are held at zero: its D has full row rank."""
    size = max(float(np.abs(M).max(initial=0.0)) for M in (A, B, C, D)) or 1.0
    while True:
        U, rank = _compress(D, RANK * size)
        C, D = U.T @ C, U.T @ D
        free, C, D = C[rank:], C[:rank], D[:rank]
        V, held = _compress(free.T, RANK * size)
        if not held:
            return A, B, C, D
        V = np.hstack([V[:, held:], V[:, :held]])  # the states at which these outputs are zero come first
        A, B, C, n = V.T @ A @ V, V.T @ B, C @ V, len(A) - held
        A, B, C, D = A[:n, :n], B[:n], np.vstack([C[:, :n], A[n:, :n]]), np.vstack([D, B[n:]])


def _compress(M: FloatArray, least: float) -> tuple[FloatArray, int]:
    """An orthogonal U with U'M = 0 below the first rows, and their number."""
    if not M.size:
        return np.eye(len(M)), 0
    U, s, _ = linalg.svd(M)
    return U, int((s > least).sum())


def _response_of_joined(
    A: FloatArray, B: FloatArray, C: FloatArray
) -> Callable[[ComplexArray], ComplexArray]:
    """s -> C (s - A)^-1 B of states that are joined; NaN at a frequency that no double number tells from a pole."""
    used = np.flatnonzero(B.any(axis=0))
    forms: list[tuple[ComplexArray, ComplexArray, ComplexArray]] = []  # T, Z^H B, C Z of A = Z T Z^H, once

    def response(s: ComplexArray) -> ComplexArray:
        solved = np.empty((len(s), len(C), len(used)), dtype=complex)
        fast = np.zeros(len(s), dtype=bool)
        if len(s) >= MIN_SCHUR_FREQUENCIES:
            if not forms:
                T, Z = linalg.schur(A, output="complex")
                forms.append((T, Z.conj().T @ B, C @ Z))
            fast = np.abs(s) > SLOW_FREQUENCY * np.linalg.norm(A)
            fast &= np.abs(s[:, None] - np.diag(forms[0][0])).min(axis=1) > 0
            solved[fast] = _substitute(s[fast], *forms[0], used)
        if not fast.all():
            solved[~fast] = C @ _resolvent(s[~fast], A, B[:, used])
        found = np.zeros((len(s), len(C), B.shape[1]), dtype=complex)
        found[:, :, used] = solved
        return found

    return response


def _substitute(
    s: ComplexArray, T: ComplexArray, B: ComplexArray, C: ComplexArray, used: Any
) -> ComplexArray:
    """C (s - T)^-1 B of some inputs, T upper triangular, from its last row upwards, all frequencies at once."""
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
