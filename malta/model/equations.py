"""Equations of expressions by name: `note` says what a result is, and what writes firmware records it.

The expressions stay as they are: a note names values that are computed anyway, in the words of the gain file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError

T = TypeVar("T")


class Equation(NamedTuple):
    """A step of a computation."""

    block: str  # what the step does, as an identifier
    text: str  # the equation, in plain letters
    values: dict[str, Any]  # the results by name
    times: int = 1  # of equal computations, one after the other in each result


_recorded: ContextVar[list[Equation] | None] = ContextVar("_recorded", default=None)


@contextmanager
def recorded_equations() -> Iterator[list[Equation]]:
    """Within, notes are put into the list, in the order of the computation.

    >>> with recorded_equations() as found:
    ...     note("double", "y = 2 x", y=[2.0])
    >>> found[0].text
    'y = 2 x'
    """
    with _collect(_recorded) as found:
        yield found


@contextmanager
def _collect(variable: ContextVar[list[T] | None]) -> Iterator[list[T]]:
    """A new list in the variable, until the end of the block."""
    found: list[T] = []
    token = variable.set(found)
    try:
        yield found
    finally:
        variable.reset(token)


def is_recording() -> bool:
    """Whether notes are recorded."""
    return _recorded.get() is not None


def note(block: str, text: str, times: int = 1, /, **values: Any) -> None:
    """Say which equation gave these results; nothing happens where nobody records.

    block : what the step does, as an identifier; text : the equation; values : the results by name
    times : how often the same is done with other numbers, where each result is that many equal parts
    """
    known = _recorded.get()
    if known is not None:
        known.append(Equation(block, text, values, times))


# Tables in expressions: CasADi's MX interpolates them, and what writes firmware of SX records where they are read.


class LookUp(NamedTuple):
    """A reading of a table in an SX expression."""

    nodes: FloatArray  # rows x columns x values
    u: Any  # place along the rows, 0 to rows - 1
    v: Any  # along the columns
    values: Any  # symbols that stand for what is read there


_look_ups: ContextVar[list[LookUp] | None] = ContextVar("_look_ups", default=None)


@contextmanager
def recorded_look_ups() -> Iterator[list[LookUp]]:
    """Within, SX expressions may read tables; each reading is put into the list."""
    with _collect(_look_ups) as found:
        yield found


def look_up(nodes: FloatArray, u: Any, v: Any) -> Any:
    """The values of a table at (u, v), bilinear between its nodes: of MX interpolated, of SX symbols that are recorded.

    Raises CheckError for SX where nobody records.
    """
    rows, columns, count = nodes.shape
    if isinstance(u, ca.MX):
        grids = [list(map(float, range(size))) for size in (rows, columns)]
        values = nodes.transpose(1, 0, 2).ravel()  # CasADi counts the first axis fastest
        table = ca.interpolant("table", "linear", grids, values, {"lookup_mode": ["exact", "exact"]})
        return table(ca.vertcat(u, v))
    known = _look_ups.get()
    if known is None:
        raise CheckError("a table is looked up in an expression that has none: CasADi's SX")
    symbols = ca.SX.sym("table", count)
    known.append(LookUp(nodes, u, v, symbols))
    return symbols


def interpolate(nodes: Any, u: Any, v: Any) -> Any:
    """The values of a table at (u, v) in numpy, in the arithmetic of its numbers, as the exported C computes them."""
    real = nodes.dtype.type
    i, j = min(int(u), nodes.shape[0] - 2), min(int(v), nodes.shape[1] - 2)
    a, b = real(u) - real(i), real(v) - real(j)
    low = (real(1) - b) * nodes[i, j] + b * nodes[i, j + 1]
    high = (real(1) - b) * nodes[i + 1, j] + b * nodes[i + 1, j + 1]
    return np.asarray((real(1) - a) * low + a * high)
