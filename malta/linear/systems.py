"""Uncertain systems and compensators from functions, matrices and control.StateSpace.

      +---------+  u  +-----------+
+---->|    F    |---->|   P(p)    |----+--> y        u = F y: positive feedback, so that
|     +---------+     +-----------+    |             u = -K y is the compensator -K
+--------------------------------------+
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from malta.arguments import by_name, describe, interval, is_number, matrix, number, plural, positive
from malta.arrays import readonly
from malta.errors import InputError, require_known
from malta.linear.uncertain import UncertainSystem

# Algebraic equations of a descriptor system: zero rows of E, solved for the states of its zero columns.
#
#     E_1 x_1' = A_11 x_1 + A_12 x_2 + B_1 u
#            0 = A_21 x_1 + A_22 x_2 + B_2 u        x_2 = -A_22^-1 (A_21 x_1 + B_2 u)
#
# The zero rows and columns are read from the expressions. The finite poles do not change.


def eliminate_algebraic(matrices: list[ca.SX]) -> list[ca.SX]:
    """A, B, C, D, E without algebraic states; unchanged when E has no zero row.

    Raises InputError when the equations do not determine these states: E has more zero rows than zero columns or fewer,
    or A_22 is singular (an index above one).
    """
    if len(matrices) < 5:
        return matrices
    A, B, C, D, E = matrices
    n = E.shape[0]
    E = ca.sparsify(E)
    rows, columns = set(E.sparsity().row()), {j for j in range(n) if E[:, j].nnz()}
    algebraic, free = sorted(set(range(n)) - rows), sorted(set(range(n)) - columns)
    if not algebraic and not free:
        return matrices
    found = f"{plural(len(algebraic), 'row')} and {plural(len(free), 'column')} of zeros"
    if len(algebraic) != len(free):
        raise InputError(
            "uncertain", "E", found, "as many of one as of the other: algebraic states of index 1"
        )
    own, x = sorted(rows), sorted(columns)
    inner = A[algebraic, free]
    if ca.sprank(ca.sparsify(inner)) < len(free) or ca.sparsify(ca.simplify(ca.det(inner))).nnz() == 0:
        raise InputError("uncertain", "E", found, "equations that give their states: A_22 not singular")
    inverse = -ca.inv_minor(inner)
    from_x, from_u = inverse @ A[algebraic, x], inverse @ B[algebraic, :]
    return [
        A[own, x] + A[own, free] @ from_x,
        B[own, :] + A[own, free] @ from_u,
        C[:, x] + C[:, free] @ from_x,
        D + C[:, free] @ from_u,
        E[own, x],
    ]


LETTERS = "ABCDE"


def from_source(
    source: Any,
    nominal: Mapping[str, float],
    *,
    terms: Mapping[str, Sequence[Any]] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    sample_time: float | None = None,
) -> UncertainSystem:
    """The system of a function, a CasADi function or matrices, with what `uncertain` says of them.

    terms : None in the place of a matrix: zeros
    limits : infinite for parameters without
    """

    names = tuple(by_name("uncertain", "nominal", nominal, '{"k": 1.5}'))
    if not names:
        raise InputError("uncertain", "nominal", "no parameters", 'values by name, as {"k": 1.5}')
    values = np.array([number("uncertain", name, value) for name, value in nominal.items()])
    bounds = _limits(names, {} if limits is None else limits)
    period = None if sample_time is None else positive("uncertain", "sample_time", sample_time)
    p = ca.SX.sym("p", len(names))
    if not callable(source):
        found = _affine_matrices(source, p, names, {} if terms is None else terms)
    elif terms:
        raise InputError("uncertain", "terms", "beside a function", "matrices A0, B0, C0 as the source")
    else:
        found = _as_list(_evaluate(source, p, names, "uncertain"))
    matrices = ca.Function("matrices", [p], _check_matrices(found))
    return UncertainSystem(names, readonly(values), matrices, limits=bounds, sample_time=period)


def _limits(names: tuple[str, ...], limits: Mapping[str, Any]) -> tuple[tuple[float, float], ...]:
    given = by_name("uncertain", "limits", limits, '{"k": (0, 2)}')
    require_known(given, names, "uncertain", "limits.{}", "an unknown parameter")
    free = (-math.inf, math.inf)
    return tuple(interval("uncertain", f"limits.{name}", limits.get(name, free)) for name in names)


def _evaluate(source: Callable[..., Any], p: Any, names: tuple[str, ...], caller: str) -> Any:
    """Call a function of the parameters with symbols. Raises InputError when it cannot be traced."""
    return (_call if isinstance(source, ca.Function) else _trace)(source, p, names, caller)


def _call(source: ca.Function, p: Any, names: tuple[str, ...], caller: str) -> Any:
    if source.n_in() == 1 and source.numel_in(0) == len(names):
        return source(p)
    if source.n_in() == len(names) and all(source.numel_in(i) == 1 for i in range(len(names))):
        return source(*ca.vertsplit(p))
    found = " ".join(f"{source.name_in(i)} ({source.numel_in(i)})" for i in range(source.n_in()))
    wanted = f"one vector of {plural(len(names), 'parameter')}"
    raise InputError(caller, source.name(), f"inputs {found}" if found else "no inputs", wanted)


def _as_list(found: Any) -> list[Any]:
    if found is None or isinstance(found, str):
        raise InputError("uncertain", "source", f"a function that returns {describe(found)}", "A, B, C")
    return list(found) if isinstance(found, tuple | list) else [found]


def _trace(source: Callable[..., Any], p: Any, names: tuple[str, ...], caller: str) -> Any:
    symbols = dict(zip(names, ca.vertsplit(p), strict=True))
    try:
        own = inspect.signature(source).parameters.values()
    except (TypeError, ValueError) as error:
        found = "a function whose parameters cannot be read"
        raise InputError(caller, "source", found, "a function of " + " ".join(names)) from error
    named = [q for q in own if q.kind in (q.POSITIONAL_OR_KEYWORD, q.KEYWORD_ONLY)]
    # An argument with a default that is no parameter here keeps it.
    wanted = [q.name for q in named if q.default is q.empty or q.name in names]
    try:
        if set(wanted) == set(names):
            return source(**symbols)
        if len(wanted) == 1:
            return source(np.array(list(symbols.values()), dtype=object))
    except Exception as error:  # a function of numbers may raise anything for symbols
        first = f"{type(error).__name__}: {error}".strip().split("\n")[0]
        found = f"a function that cannot be traced ({first})"
        raise InputError(caller, "source", found, "numpy and CasADi operations") from error
    found = "a function of " + " ".join(wanted) if wanted else "a function without named parameters"
    raise InputError(caller, "source", found, "the parameters " + " ".join(names), names)


def _affine_matrices(source: Any, p: Any, names: tuple[str, ...], terms: Mapping[str, Any]) -> list[Any]:
    if not isinstance(source, Iterable) or isinstance(source, str | Mapping):
        raise InputError("uncertain", "source", describe(source), "a function, or matrices A, B, C")
    base = [
        matrix("uncertain", letter, M) for letter, M in zip(LETTERS, _check_count(list(source)), strict=False)
    ]
    found = [ca.SX(ca.DM(M)) for M in base]
    for name, parts in by_name("uncertain", "terms", terms, '{"k": (A1, B1, C1)}').items():
        require_known([name], names, "uncertain", "terms.{}", "an unknown parameter")
        if not isinstance(parts, tuple | list):
            raise InputError("uncertain", f"terms.{name}", describe(parts), "matrices (A1, B1, C1)")
        if len(parts) > len(base):
            most = f"at most {len(base)}"
            raise InputError("uncertain", f"terms.{name}", plural(len(parts), "matrix", "matrices"), most)
        for k, part in enumerate(parts):
            if part is None:
                continue
            M = matrix("uncertain", f"terms.{name}", part)
            if M.shape != base[k].shape:
                raise InputError(
                    "uncertain", f"terms.{name}", f"{LETTERS[k]} of shape {M.shape}", f"{base[k].shape}"
                )
            found[k] = found[k] + p[names.index(name)] * ca.sparsify(ca.DM(M))
    return found


def _check_count(found: list[Any]) -> list[Any]:
    if not 3 <= len(found) <= len(LETTERS):
        count = plural(len(found), "matrix", "matrices")
        raise InputError("uncertain", "source", count, "A, B, C, or with D, or with D and E")
    return found


def _check_matrices(found: list[Any]) -> list[Any]:
    """The matrices as SX. Raises InputError for shapes that do not fit."""
    matrices = [_matrix(M, LETTERS[k]) for k, M in enumerate(_check_count(found))]
    n, m, q = matrices[0].shape[0], matrices[1].shape[1], matrices[2].shape[0]
    shapes = [(n, n), (n, m), (q, n), (q, m), (n, n)]
    for letter, M, shape in zip(LETTERS, matrices, shapes, strict=False):
        if M.shape != shape:
            raise InputError("uncertain", letter, f"shape {M.shape}", f"{shape}")
    return eliminate_algebraic(matrices)


def _matrix(M: Any, letter: str) -> Any:
    if isinstance(M, ca.SX | ca.DM):
        return _check_finite(ca.SX(M), "uncertain", letter)
    try:
        array = np.array(M, dtype=object)
    except ValueError as error:
        raise InputError("uncertain", letter, "rows of different lengths", "a matrix") from error
    if array.ndim < 2:
        array = np.atleast_2d(array)
    if array.ndim != 2:
        raise InputError("uncertain", letter, plural(array.ndim, "dimension"), "a matrix")
    if any(isinstance(x, tuple | list) for x in array.flat):
        raise InputError("uncertain", letter, "rows of different lengths", "a matrix")
    rows = [ca.horzcat(*(_entry(x, "uncertain", letter) for x in row)) for row in array.tolist()]
    return ca.vertcat(*rows) if rows else ca.SX(*array.shape)


def _entry(x: Any, caller: str, field: str) -> Any:
    """One number or expression of the parameters as SX. Raises InputError."""
    if isinstance(x, ca.MX):
        raise InputError(caller, field, "a CasADi MX", "SX expressions, numbers, or a casadi.Function")
    if isinstance(x, ca.SX | ca.DM):
        return _check_finite(ca.SX(x), caller, field)
    if isinstance(x, bool | np.bool_) or is_number(x):
        return ca.SX(float(x))
    raise InputError(caller, field, describe(x), "finite numbers, and expressions of the parameters")


def _check_finite(M: Any, caller: str, field: str) -> Any:
    """The same matrix. Raises InputError when a constant entry is NaN or infinite."""
    for x in M.nonzeros():
        if x.is_constant() and not math.isfinite(float(x)):
            raise InputError(caller, field, "NaN or infinity", "finite numbers")
    return M


def polynomial_of(coefficients: Callable[..., Any], names: tuple[str, ...]) -> ca.Function:
    """The coefficients of s, lowest first, as a CasADi function of p.

    Raises InputError for anything but a function of the parameters that returns expressions of them.
    """
    caller, field = "margin_of_polynomial", "coefficients"
    if not callable(coefficients):
        raise InputError(caller, field, describe(coefficients), "a function of the parameters")
    p = ca.SX.sym("p", len(names))
    found = _evaluate(coefficients, p, names, caller)
    flat: list[Any] = []
    for entry in found if isinstance(found, tuple | list | np.ndarray) else [found]:
        for x in entry.flat if isinstance(entry, np.ndarray) else [entry]:
            flat += ca.vertsplit(ca.vec(ca.densify(_entry(x, caller, field))))
    while flat and flat[0].is_constant() and float(flat[0]) == 0:
        flat = flat[1:]
    if len(flat) < 2:
        found = plural(len(flat), "coefficient")
        raise InputError(caller, field, found, "a polynomial of degree 1 or more")
    return ca.Function("coefficients", [p], [ca.vertcat(*reversed(flat))])
