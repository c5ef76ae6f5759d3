"""Systems side by side and in series, and the one connection that all others are: see diagrams.py.

    w = diag(G1, G2, ...) u,    u = M w + N r,    v = P w

All connections are this one, of matrices M, N and P of zeros and ones: r are the inputs of the whole, v its outputs.
Systems may be of numbers, or of CasADi expressions of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arguments import plural
from malta.errors import InputError
from malta.linear.system import System

MAX_LOOP_SIGNALS = 4  # signals of an algebraic loop of expressions, whose matrix is inverted by minors


def gain(D: Any) -> System:
    """A matrix of gains as a system without states."""
    p, m = D.shape
    A, B, C = (_of_kind(np.zeros(shape), D) for shape in ((0, 0), (0, m), (p, 0)))
    return System(A, B, C, D)


def append(*systems: System) -> System:
    """Systems side by side, each with inputs and outputs of its own: y = diag(G1, G2, ...) u.

    Raises InputError for sample times that differ; systems without states have any.

    >>> import numpy as np
    >>> from malta.linear.interconnection import append, gain
    >>> append(gain(np.eye(1)), gain(2 * np.eye(2))).D.diagonal().tolist()
    [1.0, 2.0, 2.0]
    """
    times = {one.dt for one in systems if one.A.shape[0]}
    if len(times) > 1:
        found = ", ".join(sorted("continuous" if T is None else f"{T:g} s" for T in times))
        raise InputError("append", "dt", found, "one for all systems")
    A, B, C, D = (_diagonal([getattr(one, letter) for one in systems]) for letter in "ABCD")
    plain = all(one.E is None for one in systems)
    E = None if plain else _diagonal([_one(one.A) if one.E is None else one.E for one in systems])
    sizes = {"states": A.shape[0], "inputs": B.shape[1], "outputs": C.shape[0]}
    names = {field: tuple(name for one in systems for name in getattr(one, field)) for field in sizes}
    kept = (names[field] if len(names[field]) == size else () for field, size in sizes.items())
    return System(A, B, C, D, E, times.pop() if times else None, *kept)


def connect(system: System, M: Any, N: Any, P: Any, caller: str = "connect") -> System:
    """Close a system around itself: its inputs are M w + N r, w its outputs; the outputs of the whole are P w.

    Raises InputError for an algebraic loop without a solution, and for one of expressions that is too large.

    >>> import numpy as np
    >>> from malta.linear.interconnection import connect, gain
    >>> one = np.eye(1)
    >>> connect(gain(2 * one), -3 * one, one, one).D.round(9).item()  # 2 / (1 + 6)
    0.285714286
    """
    M, N, P = (_of_kind(X, system.D) for X in (M, N, P))
    of_x, of_r = _passed_on(M @ system.D, M @ system.C, N, caller)
    A, B = system.A + system.B @ of_x, system.B @ of_r
    C, D = P @ (system.C + system.D @ of_x), P @ system.D @ of_r
    return System(A, B, C, D, system.E, system.dt, system.states)


def series(*systems: System) -> System:
    """Systems one after the other: the first takes u, the last gives y; states of the first come first.

    Raises InputError for numbers of signals that do not fit.

    >>> import numpy as np
    >>> from malta.linear.interconnection import gain, series
    >>> series(gain(np.ones((2, 1))), gain(np.array([[3.0, 4.0]]))).D.item()
    7.0
    """
    for k, (before, after) in enumerate(pairwise(systems), 2):
        p, m = before.D.shape[0], after.D.shape[1]
        if p != m:
            expected = f"as many as the {plural(p, 'output')} before"
            raise InputError("series", f"system {k}", plural(m, "input"), expected)
    ins, outs = ([one.D.shape[k] for one in systems] for k in (1, 0))
    M, N, P = (
        np.zeros((sum(ins), sum(outs))),
        np.eye(sum(ins), ins[0]),
        np.eye(outs[-1], sum(outs), sum(outs[:-1])),
    )
    M[ins[0] :, : sum(outs[:-1])] = np.eye(sum(outs[:-1]))
    found = connect(append(*systems), M, N, P)
    return replace(found, inputs=systems[0].inputs, outputs=systems[-1].outputs)


def _of_kind(M: Any, like: Any) -> Any:
    """A matrix of numbers as the other matrix is: numbers, or sparse expressions."""
    return ca.SX(ca.sparsify(ca.DM(M))) if isinstance(like, ca.SX) and not isinstance(M, ca.SX) else M


def _one(A: Any) -> Any:
    return _of_kind(np.eye(A.shape[0]), A)


def _diagonal(matrices: Sequence[Any]) -> Any:
    if any(isinstance(M, ca.SX) for M in matrices):
        return ca.diagcat(*(_of_kind(M, ca.SX()) for M in matrices))
    return linalg.block_diag(*matrices)


def _passed_on(T: Any, of_x: Any, of_r: Any, caller: str) -> tuple[Any, Any]:
    """v of v = T v + of_x x + of_r r: signals that do not feed themselves are replaced, the others solved for."""
    n, looped = T.shape[0], list[int]()
    symbolic = isinstance(T, ca.SX)
    for k in reversed(range(n)):
        T = ca.sparsify(T) if symbolic else T
        if T[k, k].nnz() if symbolic else T[k, k] != 0:
            looped.insert(0, k)
            continue
        column = T[:, [k]]
        T, of_x, of_r = (M + column @ M[[k], :] for M in (T, of_x, of_r))
        T[:, k] = 0
    if not looped:
        return of_x, of_r
    inverse = _inverse(_one(T[looped, :][:, looped]) - T[looped, :][:, looped], caller)
    through = T[:, looped] @ inverse
    return of_x + through @ of_x[looped, :], of_r + through @ of_r[looped, :]


def _inverse(Q: Any, caller: str) -> Any:
    unsolvable = InputError(
        caller, "D", "an algebraic loop without a solution", "I - sign D_K D_G that is not singular"
    )
    if not isinstance(Q, ca.SX):
        try:
            return np.linalg.inv(Q)
        except np.linalg.LinAlgError as error:
            raise unsolvable from error
    if Q.shape[0] > MAX_LOOP_SIGNALS:
        found = f"an algebraic loop of {Q.shape[0]} signals"
        raise InputError(caller, "D", found, f"at most {MAX_LOOP_SIGNALS}, or a system without a direct path")
    if ca.sparsify(ca.simplify(ca.det(Q))).nnz() == 0:
        raise unsolvable
    return ca.inv_minor(Q)
