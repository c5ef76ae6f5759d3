"""Tables in expressions: CasADi's MX interpolates them, and what writes firmware of SX records where they are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.model.equations import collect


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
    with collect(_look_ups) as found:
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
