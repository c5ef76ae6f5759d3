"""Uncertain systems and compensators from what an engineer has at hand: functions, matrices, control.StateSpace.

      +---------+  u  +-----------+
+---->|    F    |---->|   P(p)    |----+--> y        u = F y: positive feedback, so that
|     +---------+     +-----------+    |             u = -K y is the compensator -K
+--------------------------------------+
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.margins.algebraic import solved_algebraic
from malta.plant import Plant, readonly

if TYPE_CHECKING:
    from malta.uncertain import Compensator, UncertainSystem

LETTERS = "ABCDE"


def uncertain(source: Any, names: Any, **options: Any) -> UncertainSystem:
    """A linear system in parameters by name: of a plant (`of_plant`), or of functions and matrices (`from_source`).

    >>> import malta
    >>> motor = malta.uncertain(lambda J, b: ([[0, 1], [0, -b / J]], [[0], [1 / J]], [[1, 0]]), {"J": 2e-3, "b": 0.1})
    >>> motor.names
    ('J', 'b')
    """
    from malta.margins.plants import of_plant

    return (
        of_plant(source, names, **options)
        if isinstance(source, Plant)
        else from_source(source, names, **options)
    )


def from_source(
    source: Any,
    nominal: Mapping[str, float],
    *,
    terms: Mapping[str, Sequence[Any]] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    sample_time: float | None = None,
) -> UncertainSystem:
    """E(p) x' = A(p) x + B(p) u, y = C(p) x + D(p) u from a function, a CasADi function, or matrices.

    Parameters
    ----------
    source : a function of the parameters by name (or of one array p), of numpy and CasADi operations, that returns
        A, B, C, or with D, or with D and E (rows of zeros in E are algebraic equations); a casadi.Function of the
        vector p; or matrices A0, B0, C0[, D0[, E0]]
    nominal : values of the parameters by name
    terms : with matrices, what each parameter multiplies: {"k": (A1, B1, C1)}, None for a zero; A0 + sum p_i A_i
    limits : what a parameter can be at all, (above, below); infinite where none are given
    sample_time : s, where the matrices give x+ in place of x'

    Raises InputError for names, shapes and values that do not fit.
    """
    from malta.uncertain import UncertainSystem

    names = tuple(nominal)
    if not names:
        raise InputError("uncertain", "nominal", "no parameters", 'values by name, as {"k": 1.5}')
    values = np.array([_number(name, value) for name, value in nominal.items()])
    p = ca.SX.sym("p", len(names))
    if isinstance(source, ca.Function):
        found = _called(source, p, names)
    elif callable(source):
        found = _traced(source, p, names)
    else:
        found = _affine(source, p, names, terms or {})
    if terms and (callable(source) or isinstance(source, ca.Function)):
        raise InputError("uncertain", "terms", "beside a function", "matrices A0, B0, C0 as the source")
    for name in limits or {}:
        if name not in names:
            raise InputError(
                "uncertain", f"limits.{name}", "an unknown parameter", "one of " + " ".join(names)
            )
    if sample_time is not None and not (math.isfinite(sample_time) and sample_time > 0):
        raise InputError("uncertain", "sample_time", f"{sample_time}", "a time above zero")
    bounds = tuple((limits or {}).get(name, (-math.inf, math.inf)) for name in names)
    matrices = ca.Function("matrices", [p], _checked(found))
    return UncertainSystem(names, readonly(values), matrices, limits=bounds, sample_time=sample_time)


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError("uncertain", name, repr(value), "a finite number")
    return number


def _called(source: ca.Function, p: Any, names: tuple[str, ...]) -> list[Any]:
    if source.n_in() == 1 and source.numel_in(0) == len(names):
        return _several(source(p))
    if source.n_in() == len(names) and all(source.numel_in(i) == 1 for i in range(len(names))):
        return _several(source(*ca.vertsplit(p)))
    found = " ".join(f"{source.name_in(i)} ({source.numel_in(i)})" for i in range(source.n_in()))
    raise InputError("uncertain", source.name(), f"inputs {found}", f"one vector of {len(names)} parameters")


def _several(found: Any) -> list[Any]:
    return list(found) if isinstance(found, tuple | list) else [found]


def _traced(source: Callable[..., Any], p: Any, names: tuple[str, ...]) -> list[Any]:
    symbols = dict(zip(names, ca.vertsplit(p), strict=True))
    wanted = [
        q.name for q in inspect.signature(source).parameters.values()
        if q.kind in (q.POSITIONAL_OR_KEYWORD, q.KEYWORD_ONLY)
    ]  # fmt: skip
    try:
        if set(wanted) == set(names):
            return _several(source(**symbols))
        if len(wanted) == 1:
            return _several(source(np.array(list(symbols.values()), dtype=object)))
    except (TypeError, ValueError, NotImplementedError, RuntimeError) as error:
        first = str(error).strip().split("\n")[0]
        raise InputError(
            "uncertain",
            "source",
            f"a function that cannot be traced ({first})",
            "numpy and CasADi operations",
        ) from error
    raise InputError(
        "uncertain", "source", "a function of " + " ".join(wanted), "the parameters " + " ".join(names)
    )


def _affine(source: Any, p: Any, names: tuple[str, ...], terms: Mapping[str, Sequence[Any]]) -> list[Any]:
    try:
        base = [np.atleast_2d(np.asarray(M, dtype=float)) for M in source]
    except (TypeError, ValueError) as error:
        raise InputError(
            "uncertain", "source", type(source).__name__, "a function, or matrices A, B, C"
        ) from error
    found = [ca.SX(ca.DM(M)) for M in base]
    for name, parts in terms.items():
        if name not in names:
            raise InputError(
                "uncertain", f"terms.{name}", "an unknown parameter", "one of " + " ".join(names)
            )
        if len(parts) > len(base):
            raise InputError("uncertain", f"terms.{name}", f"{len(parts)} matrices", f"at most {len(base)}")
        for k, part in enumerate(parts):
            if part is None:
                continue
            M = np.atleast_2d(np.asarray(part, dtype=float))
            if M.shape != base[k].shape:
                raise InputError(
                    "uncertain", f"terms.{name}", f"{LETTERS[k]} of shape {M.shape}", f"{base[k].shape}"
                )
            if not np.isfinite(M).all():
                raise InputError("uncertain", f"terms.{name}", "NaN or infinity", "finite numbers")
            found[k] = found[k] + p[names.index(name)] * ca.sparsify(ca.DM(M))
    return found


def _checked(found: list[Any]) -> list[Any]:
    """SX matrices, D only where it is not zero."""
    if not 3 <= len(found) <= 5:
        raise InputError(
            "uncertain", "source", f"{len(found)} matrices", "A, B, C, or with D, or with D and E"
        )
    matrices = [_matrix(M, LETTERS[k]) for k, M in enumerate(found)]
    n, m, q = matrices[0].shape[0], matrices[1].shape[1], matrices[2].shape[0]
    shapes = [(n, n), (n, m), (q, n), (q, m), (n, n)]
    for letter, M, shape in zip(LETTERS, matrices, shapes, strict=False):
        if M.shape != shape:
            raise InputError("uncertain", letter, f"shape {M.shape}", f"{shape}")
        constants = ca.DM(M[:]) if M.is_constant() else ca.DM(0)
        if not np.isfinite(np.array(constants)).all():
            raise InputError("uncertain", letter, "NaN or infinity", "finite numbers")
    return solved_algebraic(matrices)


def _matrix(M: Any, letter: str) -> Any:
    if isinstance(M, ca.SX | ca.DM):
        return ca.SX(M)
    if isinstance(M, ca.MX):
        raise InputError("uncertain", letter, "a CasADi MX", "SX expressions, numbers, or a casadi.Function")
    try:
        array = np.array(M, dtype=object)
    except ValueError as error:
        raise InputError("uncertain", letter, "rows of different lengths", "a matrix") from error
    if array.ndim < 2:
        array = np.atleast_2d(array)
    if array.ndim != 2:
        raise InputError("uncertain", letter, f"{array.ndim} dimensions", "a matrix")
    rows = [ca.horzcat(*(ca.SX(x) for x in row)) for row in array.tolist()]
    return ca.vertcat(*rows) if rows else ca.SX(*array.shape)


def compensator_of(law: Any, outputs: int, inputs: int) -> Compensator:
    """A compensator from a control.StateSpace or TransferFunction, a gain matrix, or as it is.

    Raises InputError where it has another number of inputs and outputs than the system, or an unspecified sample time.
    """
    from malta.uncertain import Compensator

    if isinstance(law, Compensator):
        return law
    if hasattr(law, "num_list") or hasattr(law, "num_array"):
        import control

        law = control.ss(law)
    if all(hasattr(law, name) for name in ("A", "B", "C", "D", "dt")):
        if law.dt is True:
            raise InputError("compensator", "dt", "True", "0, or a sample time in seconds")
        T = None if not law.dt else float(law.dt)
        A, B, C, D = (np.asarray(M, dtype=float) for M in (law.A, law.B, law.C, law.D))
        found = Compensator(A, B.reshape(len(A), -1), C.reshape(-1, len(A)), D, sample_time=T)
    else:
        try:
            D = np.atleast_2d(np.asarray(law, dtype=float))
        except (TypeError, ValueError) as error:
            raise InputError(
                "compensator",
                "law",
                type(law).__name__,
                "a Compensator, a control.StateSpace or a gain matrix",
            ) from error
        found = Compensator(np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((len(D), 0)), D)
    if found.D.shape != (inputs, outputs):
        raise InputError(
            "compensator",
            "D",
            f"shape {found.D.shape}",
            f"{(inputs, outputs)}: {inputs} inputs u from {outputs} outputs y",
        )
    return found


def polynomial_system(coefficients: Callable[..., Any], names: tuple[str, ...]) -> tuple[ca.Function, int]:
    """Coefficients of s, lowest first, as a CasADi function of p; and the degree."""
    p = ca.SX.sym("p", len(names))
    found = (
        _called(coefficients, p, names)
        if isinstance(coefficients, ca.Function)
        else _traced(coefficients, p, names)
    )
    flat: list[Any] = []
    for entry in found:
        if isinstance(entry, ca.SX | ca.DM) and entry.numel() != 1:
            flat += ca.vertsplit(ca.vec(ca.densify(entry)))
        else:
            flat.append(ca.SX(entry))
    while flat and flat[0].is_constant() and float(flat[0]) == 0:
        flat = flat[1:]
    if len(flat) < 2:
        raise InputError(
            "margin_of_polynomial", "coefficients", f"{len(flat)} of them", "a polynomial of degree 1 or more"
        )
    return ca.Function("coefficients", [p], [ca.vertcat(*reversed(flat))]), len(flat) - 1
