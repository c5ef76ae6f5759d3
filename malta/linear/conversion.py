"""Systems of python-control: all states and all poles stay, whatever else is installed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from malta.arguments import describe
from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.system import System

WANTED = "a proper control.StateSpace or TransferFunction"


def is_transfer(source: Any) -> bool:
    """Whether this is a control.TransferFunction."""
    return hasattr(source, "num") and hasattr(source, "den")


def from_control(
    source: Any, where: str, field: str, *, step: float | None = None, differences: bool = False,
    expected: str = WANTED,
) -> System:  # fmt: skip
    """Read a control.StateSpace, a TransferFunction of any size or a System, with its names and all of its poles.

    where, field : the caller and its argument, for refusals
    step : s, what a sample time of True or None stands for; None: True is refused, and None is continuous
    differences : of a sampled system in differences, with its sample time in `dt` all the same
    expected : for refusals

    Raises InputError for anything else: improper transfer functions, responses without states, complex coefficients,
    NaN and infinity, and a sample time that is not in seconds.

    >>> import control
    >>> from malta.linear.conversion import from_control
    >>> hidden = from_control(control.tf([1, -1], [1, 1, -2]), "page", "plant")  # (s - 1) / (s - 1) / (s + 2)
    >>> sorted(hidden.poles.real.tolist())
    [-2.0, 1.0]
    """
    if isinstance(source, System):
        return source.differences if differences else source
    dt = getattr(source, "dt", None)
    if dt is True and step is None:
        raise InputError(where, "dt", "True", "0, or a sample time in seconds")
    T = step if dt is True or dt is None else float(dt) or None
    if is_transfer(source):
        found = _of_transfer(source, where, field, T, expected)
        if T is not None and not differences:
            found = replace(found, A=np.eye(len(found.A)) + T * found.A, B=T * found.B)
    elif all(hasattr(source, name) for name in ("A", "B", "C", "D", "dt")):
        found = System(*_numbers(source, where, field))
        if differences and T is not None:
            found = replace(found, A=(found.A - np.eye(len(found.A))) / T, B=found.B / T)
    else:
        plain = isinstance(source, float | int | str | None)
        kind = describe(source) if plain else f"a {type(source).__name__}"
        raise InputError(where, field, kind, expected)
    names = {
        f: tuple(getattr(source, f"{f[:-1]}_labels", None) or ()) for f in ("states", "inputs", "outputs")
    }
    states = names["states"] if len(names["states"]) == len(found.A) else ()
    return replace(found, dt=T, states=states, inputs=names["inputs"], outputs=names["outputs"])


def _of_transfer(source: Any, where: str, field: str, T: float | None, expected: str) -> System:
    from malta.linear.transfer import realize

    try:
        return realize(source.num, source.den, T)
    except InputError as error:
        found = f"a {type(source).__name__} with {error.found}"
        raise InputError(where, field, found, f"{expected}: {error.expected}") from error


def _numbers(source: Any, where: str, field: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A, B, C and D of a control.StateSpace. Raises InputError for complex numbers and those that are none."""
    given = [np.atleast_2d(np.asarray(getattr(source, letter))) for letter in "ABCD"]
    if any(M.dtype.kind not in "biuf" for M in given):
        complex_ones = any(np.iscomplexobj(M) for M in given)
        raise InputError(where, field, "complex matrices" if complex_ones else "no numbers", "real matrices")
    A, B, C, D = (np.array(M, dtype=float) for M in given)
    if not all(np.isfinite(M).all() for M in (A, B, C, D)):
        raise InputError(where, field, "NaN or infinity", "finite numbers")
    n = A.shape[0] if A.size else 0
    return A.reshape(n, n), B.reshape(n, D.shape[1]), C.reshape(len(D), n), D
