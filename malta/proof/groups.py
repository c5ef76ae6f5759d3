"""The closed loop of a proof, checked and split into groups of states that close loops by themselves.

    E(p) x' = A(p) x + B(p) u,  y = C(p) x + D(p) u,  u = h F y          h: lag, hold and delay, equal for all inputs

Only couplings that are zero as exact expressions split the loop; small ones do not (closed_loop.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from flint import arb, arb_mat
from scipy import linalg, sparse

from malta.arguments import plural
from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.expressions import MatrixProgram, NotAnalytic, exact, program
from malta.linear.rational import Ratio, Symbolic, TooLarge, symbolic
from malta.linear.sampling import split_delay
from malta.linear.uncertain import Compensator, StateGroup, UncertainSystem

A, B, C, D, E = range(5)


@dataclass(frozen=True, eq=False)
class UncertainLoop:
    """A system and a compensator that fit each other, with the system's program."""

    system: UncertainSystem
    law: Compensator
    program: MatrixProgram

    @property
    def symbolic(self) -> Symbolic | None:
        """The matrices as exact rational functions; None when these are too large."""
        return _symbolic(self.program)

    @property
    def states(self) -> int:
        return self.program.shapes[A][0]

    @property
    def direct(self) -> bool:
        """Whether u acts on y at once."""
        return len(self.program.shapes) > D and bool(self.program.entries[D])

    @property
    def descriptor(self) -> bool:
        return len(self.program.shapes) > E

    @property
    def sampled(self) -> bool:
        """Whether a continuous system is held and sampled."""
        return self.law.sample_time is not None and self.system.sample_time is None


def loop_of(system: UncertainSystem, law: Compensator) -> UncertainLoop:
    """The loop of a system and a compensator.

    Raises InputError for shapes that do not fit, entries that are not finite, different sample times, and a loop
    without states.
    """
    f: ca.Function = system.matrices
    if f.n_out() < 3 or f.n_out() > 5:
        raise InputError(
            "uncertain", "matrices", f"{f.n_out()} outputs", "A, B, C, and D and E where there are"
        )
    n, m, p = f.size1_out(A), f.size2_out(B), f.size1_out(C)
    wanted = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "E": (n, n)}
    for i in range(f.n_out()):
        name = "ABCDE"[i]
        if tuple(f.size_out(i)) != wanted[name]:
            raise InputError("uncertain", name, f"shape {tuple(f.size_out(i))}", f"{wanted[name]}")
    k = len(law.A)
    shapes = {"A": (k, k), "B": (k, p), "C": (m, k), "D": (m, p)}
    for name, shape in shapes.items():
        matrix = getattr(law, name)
        if matrix.shape != shape:
            raise InputError(
                "compensator",
                name,
                f"shape {matrix.shape}",
                f"{shape}: {plural(p, 'output')}, {plural(m, 'input')}",
            )
        if not np.isfinite(matrix).all():
            raise InputError("compensator", name, "NaN or infinity", "finite numbers")
    if not n + k and law.lag is None and not law.delay:
        raise InputError("uncertain", "A", "no states but algebraic ones", "at least one state in the loop")
    if system.sample_time is not None and law.lag is not None:
        raise InputError("compensator", "lag", "a continuous lag", "none before a system in discrete time")
    if not (0 <= law.delay < math.inf) or (split_delay(law.delay)[1] and system.sample_time is not None):
        expected = "0 or more; whole samples before a system in discrete time"
        raise InputError("compensator", "delay", f"{law.delay:g} samples", expected)
    if law.sample_time is None and law.delay:
        raise InputError("compensator", "delay", "samples of delay without a sample time", "0")
    if system.sample_time is not None and law.sample_time != system.sample_time:
        found = "a continuous compensator" if law.sample_time is None else f"{law.sample_time:g} s"
        raise InputError("compensator", "sample_time", found, f"that of the system, {system.sample_time:g} s")
    return UncertainLoop(system, law, _program(system))


@lru_cache(maxsize=32)  # laws change, the system stays; records compare by identity
def _program(system: UncertainSystem) -> MatrixProgram:
    return program(system.matrices)


@lru_cache(maxsize=32)
def _symbolic(program: MatrixProgram) -> Symbolic | None:
    try:
        return symbolic(program)
    except (TooLarge, NotAnalytic):
        return None


@lru_cache(maxsize=32)  # records compare by identity
def groups(loop: UncertainLoop) -> list[StateGroup]:
    """The strongly connected parts of the closed loop: its characteristic polynomial is the product of theirs."""
    law, n = loop.law, loop.states
    if loop.direct:
        return [StateGroup(tuple(range(n)), tuple(range(len(law.A))), None)]
    s = loop.symbolic
    touch = _coupling_pattern(loop) if s is None else _nonzero_couplings(loop, s)
    if loop.descriptor:
        for i, j, _ in loop.program.entries[E]:
            touch[i, j] = touch[j, i] = True
    _, label = sparse.csgraph.connected_components(touch, directed=True, connection="strong")
    acting = sorted({i for i, _, _ in loop.program.entries[B]})
    found = []
    for k in dict.fromkeys(label.tolist()):
        mine = np.flatnonzero(label == k).tolist()
        states, own = tuple(i for i in mine if i < n), tuple(i - n for i in mine if i >= n)
        inputs = tuple(i for i in acting if i in states)
        found.append(StateGroup(states, own, inputs if len(inputs) < loop.program.shapes[B][1] else None))
    return found


def sensor_groups(loop: UncertainLoop) -> list[tuple[int, ...]]:
    """The sensors in groups without any coupling by the loop, in either direction.

    The loop's transfer from an error of the readings to the readings is block diagonal in them, at all parameters. Its
    largest singular value is that of the worst block, so that a full block of dynamics around all sensors does what it
    does around the worst group alone.
    """
    law, n, p = loop.law, loop.states, loop.program.shapes[C][0]
    if loop.direct:
        return [tuple(range(p))]
    s, k = loop.symbolic, len(law.A)
    touch = _coupling_pattern(loop) if s is None else _nonzero_couplings(loop, s)
    if loop.descriptor:
        for i, j, _ in loop.program.entries[E]:
            touch[i, j] = True
    whole = np.zeros((n + k + p,) * 2, dtype=bool)
    whole[: n + k, : n + k] = touch
    for i, j, _ in loop.program.entries[C]:
        whole[n + k + i, j] = True
    whole[n : n + k, n + k :] = law.B != 0
    for i, a, _ in loop.program.entries[B]:
        whole[i, n + k :] |= law.D[a] != 0
    _, label = sparse.csgraph.connected_components(whole, directed=False)
    own = label[n + k :]
    return [tuple(np.flatnonzero(own == one).tolist()) for one in dict.fromkeys(own.tolist())]


def _coupling_pattern(loop: UncertainLoop) -> Any:
    """The couplings by the patterns of the matrices alone; terms that cancel count as couplings."""
    law, (n, m), p = loop.law, loop.program.shapes[B], loop.program.shapes[C][0]
    a, b, c = np.zeros((n, n), dtype=bool), np.zeros((n, m), dtype=bool), np.zeros((p, n), dtype=bool)
    for matrix, entries in zip((a, b, c), loop.program.entries, strict=False):
        for i, j, _ in entries:
            matrix[i, j] = True
    own = law.A != 0
    return np.block([[a | (b @ (law.D != 0) @ c), b @ (law.C != 0)], [(law.B != 0) @ c, own]])


def _nonzero_couplings(loop: UncertainLoop, s: Symbolic) -> Any:
    """The couplings that are not zero as exact expressions."""
    law, n, k = loop.law, loop.states, len(loop.law.A)
    touch = np.zeros((n + k, n + k), dtype=bool)
    rows: dict[int, list[tuple[int, Ratio]]] = {}
    columns: dict[int, list[tuple[int, Ratio]]] = {}
    for i, j in s.entries[A]:
        touch[i, j] = True
    for (i, a), r in s.entries[B].items():
        rows.setdefault(i, []).append((a, r))
    for (b, j), r in s.entries[C].items():
        columns.setdefault(j, []).append((b, r))

    def is_nonzero(parts: list[Ratio]) -> bool:
        if len(parts) < 2:
            return bool(parts)
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return not total.is_zero()

    for i, row in rows.items():
        for j, column in columns.items():
            touch[i, j] |= is_nonzero(
                [r * s.constant(law.D[a, b]) * q for a, r in row for b, q in column if law.D[a, b]]
            )
        for j in range(k):
            touch[i, n + j] = is_nonzero([r * s.constant(law.C[a, j]) for a, r in row if law.C[a, j]])
    for j, column in columns.items():
        for i in range(k):
            touch[n + i, j] = is_nonzero([q * s.constant(law.B[i, b]) for b, q in column if law.B[i, b]])
    touch[n:, n:] = law.A != 0
    return touch


def hold_bounds(size: FloatArray, diagonal: FloatArray, T: float) -> tuple[FloatArray, FloatArray]:
    """Entrywise bounds of e^(A T) - I and of V, the integral of e^(A t) over a sample.

    |e^(A t)| <= e^(M t) with M the moduli of A beside the real parts of its diagonal, and e^(A T) - I = A V.

    size : bounds of |A|; diagonal : upper bounds of the diagonal's real parts
    Raises NotAnalytic when numbers overflow.
    """
    n = len(size)
    if not (np.isfinite(size).all() and np.isfinite(diagonal).all()):
        raise NotAnalytic("numbers that overflow")
    m = size.copy()
    np.fill_diagonal(m, diagonal)
    _, (units, _) = linalg.matrix_balance(m, permute=False, separate=True)  # powers of two
    turn = units / units[:, None]
    m = m * turn
    if not float(m.max(initial=0.0)) * T < 1e4:
        raise NotAnalytic("numbers that overflow")
    whole = np.block([[m, np.eye(n)], [np.zeros((n, 2 * n))]])
    both = (arb_mat(whole.tolist()) * arb(T)).exp()
    V = np.array([[float(both[i, n + j].upper()) for j in range(n)] for i in range(n)]).reshape(n, n) / turn
    if not np.isfinite(V).all():
        raise NotAnalytic("numbers that overflow")
    V = np.maximum(V, 0) * (1 + 1e-9)
    return size @ V * (1 + 1e-9), V


def upper(z: Any) -> float:
    """An upper bound of the real part of a ball."""
    x = float(z.real.upper())
    return x + 1e-9 * abs(x)


def divide_by_descriptor(loop: UncertainLoop, s: Symbolic) -> tuple[dict[tuple[int, int], Ratio], ...]:
    """The entries of A and B divided by a diagonal E; unchanged for another E."""
    if not loop.descriptor or any(i != j for i, j in s.entries[E]):
        return s.entries
    diagonal = {i: r for (i, _), r in s.entries[E].items()}
    if len(diagonal) < loop.states:
        raise NotAnalytic("a row of E that is zero")
    return tuple(
        {(i, j): r / diagonal[i] for (i, j), r in matrix.items()} if which in (A, B) else matrix
        for which, matrix in enumerate(s.entries)
    )


def rational(matrix: FloatArray) -> list[list[Any]]:
    return [[exact(float(x)) for x in row] for row in matrix]
