"""Loops over samples of any equations, in C where there is a compiler; identification runs logs through them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, Protocol

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.simulation.engine.compiled import address_of, library
from malta.simulation.engine.engines import evaluate

SAMPLES_AT_ONCE = 1000  # samples in one call
SAMPLE_LOOP_FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared")
DRIVER = """
#include <string.h>
void run(long count, const casadi_real *given, const casadi_real *numbers, casadi_real *x, casadi_real *rows) {{
  casadi_real after[{states}], w[{work} + 1];
  casadi_int iw[{indices} + 1];
  for (long k = 0; k < count; ++k) {{
    const casadi_real *arg[] = {{x, given + k * {given}, numbers}};
    casadi_real *res[] = {{after, rows + k * {row}}};
    one(arg, res, iw, w, 0);
    memcpy(x, after, sizeof after);
  }}
}}
"""


class SampleLoop(Protocol):
    """(first state, tables of inputs with a line for each sample, numbers) -> rows, a line for each sample.

    `last` becomes the state behind the last sample, from which other samples may go on.
    """

    def __call__(
        self,
        first: FloatArray,
        tables: Sequence[FloatArray],
        constants: FloatArray,
        last: FloatArray | None = None,
    ) -> FloatArray:
        """Run through the samples."""


def loop_of(x: Any, given: Any, numbers: Any, after: Any, row: Any) -> SampleLoop:
    """The loop over samples of x_k+1 = after(x_k, given_k, numbers), with row(x_k, given_k, numbers) of each sample.

    All are columns of CasADi's SX: three of symbols, two expressions of them. The tables of a call stand side by side
    in `given`.

    >>> x, u, a = (ca.SX.sym(name) for name in "xua")
    >>> total = loop_of(x, u, a, a * x + u, x)
    >>> total(np.zeros(1), [np.ones((4, 1))], np.array([2.0])).ravel().tolist()
    [0.0, 1.0, 3.0, 7.0]
    """
    one = ca.Function("one", [x, given, numbers], ca.cse([ca.densify(after), ca.densify(row)]))
    made = ca.CodeGenerator("one")
    made.add(one)
    sizes = {"states": x.numel(), "given": given.numel(), "row": row.numel()}
    sizes |= {"work": one.sz_w(), "indices": one.sz_iw()}
    compiled = library(made.dump() + DRIVER.format(**sizes), 1, flags=SAMPLE_LOOP_FLAGS)
    chain = one.mapaccum("chain", SAMPLES_AT_ONCE) if compiled is None else None

    def fill(state: FloatArray, block: FloatArray, constants: FloatArray, rows: FloatArray) -> None:
        if compiled is not None:
            addresses = map(address_of, (block, constants, state, rows))
            compiled.run(ctypes.c_long(len(rows)), *addresses)
            return
        states, found = evaluate(chain, state, block, np.tile(constants, (SAMPLES_AT_ONCE, 1)))
        rows[:], state[:] = found[: len(rows)], states[len(rows) - 1]

    def loop(
        first: FloatArray, tables: Sequence[FloatArray], constants: FloatArray, last: FloatArray | None = None
    ) -> FloatArray:
        state, constants = np.array(first, dtype=float), np.ascontiguousarray(constants, dtype=float)
        rows = np.empty((len(tables[0]), row.numel()))
        block = np.zeros((SAMPLES_AT_ONCE, given.numel()))
        for k in range(0, len(rows), SAMPLES_AT_ONCE):
            part = rows[k : k + SAMPLES_AT_ONCE]
            np.concatenate(
                [table[k : k + SAMPLES_AT_ONCE] for table in tables], axis=1, out=block[: len(part)]
            )
            fill(state, block, constants, part)
        if last is not None:
            last[:] = state
        return rows

    return loop
