"""Arguments of a caller, read as numbers, intervals, values by name or matrices. Raises InputError otherwise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError

MAX_SIZE = 1e150  # size of a parameter at most, so that squares of its multiples do not overflow
MAX_VALUE_LENGTH = 60  # characters of a value that a message shows


def describe(value: Any) -> str:
    """A value as a message shows it: its text when that is short, else its type."""
    text = repr(value) if isinstance(value, complex | float | int | str | tuple | list | dict) else ""
    if text and len(text) <= MAX_VALUE_LENGTH:
        return text
    return "None" if value is None else f"a value of type {type(value).__name__}"


def is_number(value: Any) -> bool:
    """Whether a value is one finite real number; strings and truth values are not."""
    if isinstance(value, bool | np.bool_ | str | bytes | complex | np.complexfloating):
        return False
    if isinstance(value, np.ndarray) and (value.ndim or value.dtype.kind not in "iuf"):
        return False
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError, OverflowError, NotImplementedError, RuntimeError):
        return False


def number(caller: str, name: str, value: Any) -> float:
    """A finite number. Raises InputError."""
    if not is_number(value):
        raise InputError(caller, name, describe(value), "a finite number")
    return float(value)


def positive(caller: str, name: str, value: Any, below: float = math.inf, *, endless: bool = False) -> float:
    """A number above zero and below a bound, or infinity when `endless`. Raises InputError."""
    if endless and isinstance(value, float) and value == math.inf:
        return value
    if not (is_number(value) and 0 < float(value) < below):
        wanted = "a number above zero" + ("" if math.isinf(below) else f" and below {below:g}")
        raise InputError(caller, name, describe(value), wanted)
    return float(value)


def is_pair(value: Any) -> bool:
    """Whether a value is a tuple or a list of two."""
    return isinstance(value, tuple | list) and len(value) == 2


def interval(caller: str, name: str, value: Any) -> tuple[float, float]:
    """An interval (low, high); either end may be infinite. Raises InputError."""
    if is_pair(value):
        low, high = (
            float(v) if is_number(v) or (isinstance(v, float) and math.isinf(v)) else math.nan for v in value
        )
        if low < high:
            return low, high
    raise InputError(caller, name, describe(value), "(low, high), two numbers, the lower one first")


def by_name(caller: str, name: str, value: Any, example: str) -> Mapping[str, Any]:
    """Values by name. Raises InputError."""
    if not isinstance(value, Mapping):
        raise InputError(caller, name, describe(value), f"values by name, as {example}")
    for key in value:
        if not isinstance(key, str):
            raise InputError(caller, name, f"{describe(key)} as a name", f"strings as names, as {example}")
    return value


def require_real(caller: str, name: str, value: Any) -> Any:
    """The same value. Raises InputError for complex numbers in it, whose imaginary parts numpy would leave out."""
    try:
        found = np.asarray(value)
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        return value  # what it is instead, its reader says
    some = [x for x in found.ravel().tolist() if isinstance(x, complex)] if found.dtype.kind in "cO" else []
    if some:
        worst = max(some, key=lambda x: abs(x.imag))
        raise InputError(caller, name, f"complex numbers, as {worst:g}", "real numbers")
    return value


def matrix(caller: str, name: str, value: Any, wanted: str = "a matrix of numbers") -> FloatArray:
    """A matrix of finite numbers; a number is 1 x 1, a row of them 1 x n. Raises InputError."""
    try:
        found = np.asarray(require_real(caller, name, value))
        read = np.atleast_2d(found.astype(float)) if found.dtype.kind in "biufO" else None
    except InputError:
        raise
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        read = None
    if read is None or read.ndim != 2:
        raise InputError(caller, name, describe(value), wanted)
    if not np.isfinite(read).all():
        raise InputError(caller, name, "NaN or infinity", "finite numbers")
    return read


def plural(count: int, one: str, many: str = "") -> str:
    """A count with its noun: "1 input", "2 inputs"; "1 matrix", "2 matrices"."""
    return f"{count} {one if count == 1 else many or one + 's'}"
