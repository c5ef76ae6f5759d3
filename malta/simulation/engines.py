"""Engines that run control periods of one machine: compiled C, or CasADi's virtual machine where no compiler works."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.model.data import plant_of
from malta.model.parameters import acting_names, shape_parameters, twins_of
from malta.model.plant import Plant
from malta.simulation.compiled import address_of, feedforward_table, library
from malta.simulation.layout import Setup, electronics_of, ending_columns, flatten, numbers_of
from malta.simulation.period import Period, chain, columns_of, period_of, without_zeros
from malta.simulation.translate import source
from malta.simulation.working import with_working_state
from malta.synthesis.controller import Controller, gains_of

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

EngineChoice = Literal["auto", "compiled", "virtual machine"]
BLOCK = 250  # samples in one call of the virtual machine's chain


@dataclass(frozen=True, eq=False)
class Engine:
    """A function that simulates samples of one machine: (first, state, given, noise, fast noise) -> (state, rows).

    first : index of the first sample
    given, noise, rows : samples x size; fast noise : substeps x size
    The compiled engine's rows end with the first in which a contact ends the run.
    """

    kind: str  # "compiled" or "virtual machine"
    run: Callable[[int, FloatArray, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


@lru_cache(maxsize=32)  # building takes as long as a run; records compare by identity, so no hit is stale
def engine_of(
    plant: Plant,
    c: Controller,
    setup: Setup,
    substeps: float,
    errors: tuple[tuple[str, float], ...] = (),
    choice: EngineChoice = "auto",
) -> Engine:
    """The engine of a machine under a controller: compiled where possible, else CasADi's virtual machine.

    errors : of the sensors, (name, SI)

    Raises InputError for the choice "compiled" without a C compiler, or for a controller that looks up a table.
    """
    values = numbers_of(plant, c, substeps, dict(errors))
    if choice != "virtual machine":
        found = library_of(shape_of(plant, c, setup))
        if found is not None:
            lib, p = found
            ff = c.feedforward
            table = feedforward_table(ff.z_grid, ff.v0)
            return compiled_engine(
                lib.run, p, flatten(values), substeps, table, ending_columns(plant, c, setup)
            )
        if choice == "compiled":
            if plant_of(c.parameters).tabulated:
                raise InputError(
                    "simulate", "engine", "a controller that looks up a table", "virtual machine"
                )
            raise InputError("simulate", "engine", "no C compiler that works", "cc, gcc or clang, or $CC")
    p = period_of(plant, c, setup, values, constant=True)
    block = 1 if setup.outside or electronics_of(plant, setup) is not None else BLOCK
    return virtual_engine(cache(lambda count: chain(p, c, count, block)), substeps)


@dataclass(frozen=True)
class Shape:
    """The shape of a plant and a controller. Two shapes are equal where the same compiled text serves both."""

    key: tuple[Any, ...]
    plant: Plant = field(compare=False)
    controller: Controller = field(compare=False)
    setup: Setup


def shape_of(plant: Plant, c: Controller, setup: Setup) -> Shape:
    """The shape of a plant and a controller: all that their functions depend on, except numbers."""
    variant, par = plant.variant, plant.parameters
    kin = (variant.func, *sorted(variant.keywords.items())) if isinstance(variant, partial) else (variant,)
    twins = tuple(twins_of(par).items())
    patterns = tuple(
        (m.shape, *m.sparsity().get_triplet()[0], *m.sparsity().get_triplet()[1])
        for m in gains_of(c).values()
    )
    fixed = (*shape_parameters(par).items(), *acting_names(par))
    columns = columns_of(c)
    return Shape((type(par), kin, twins, fixed, patterns, columns, c.tracks, c.parameters), plant, c, setup)


@lru_cache(maxsize=32)
def library_of(
    shape: Shape, lanes: int = 1, digest: ca.Function | None = None, cruise: tuple[ca.Function, ...] = ()
) -> tuple[Any, Period] | None:
    """The library and the functions of a shape; None where it cannot be compiled.

    digest : the function that updates a run's digest; for several lanes
    cruise : see digest.cruise_functions
    """
    if plant_of(shape.controller.parameters).tabulated:
        return None
    lib = library(engine_text(shape, digest, cruise), lanes)
    return None if lib is None else (lib, compiled_period(shape))


@lru_cache(maxsize=32)
def engine_text(shape: Shape, digest: ca.Function | None = None, cruise: tuple[ca.Function, ...] = ()) -> str:
    """The C text of a shape's engine; digest and cruise as in `library_of`."""
    return source(compiled_period(shape), digest, cruise)


@lru_cache(maxsize=32)
def compiled_period(shape: Shape) -> Period:
    """The functions of a control period as they are compiled: with numbers as arguments, without what drops out."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    p = period_of(plant, c, setup, numbers_of(plant, c, 1), constant=False)
    return with_working_state(without_zeros(p, columns_of(c)), plant, c, setup)


def substeps_until(sample: int, substeps: float) -> int:
    """Number of substeps before a sample. `substeps` a sample may be no integer: a sample then begins with the first
    substep after it."""
    return math.ceil(sample * substeps - 1e-6)


def compiled_engine(
    run: Any, p: Period, theta: FloatArray, substeps: float, table: FloatArray, ending: Sequence[int] = ()
) -> Engine:
    """The engine of a library with one lane; `run` is the library's function.

    ending : columns of a row that end a run, see ending_columns; rows after such a row are not computed
    """
    width = p.decide.size1_out(2)
    ends, columns = ctypes.c_long(len(ending)), (ctypes.c_long * len(ending))(*ending)
    theta, table = (np.ascontiguousarray(a, dtype=float) for a in (theta, table))
    numbers, points, rows_of_table = (  # these addresses keep their arrays alive
        theta.ctypes.data_as(ctypes.c_void_p),
        ctypes.c_long(len(table)),
        table.ctypes.data_as(ctypes.c_void_p),
    )

    def call(
        first: int, state: FloatArray, given: FloatArray, noise: FloatArray, fast: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        after = np.array(state, dtype=float)
        given, noise, fast = (np.ascontiguousarray(a) for a in (given, noise, fast))
        rows = np.empty((len(given), width))
        done = run(
            ctypes.c_long(first),
            ctypes.c_long(len(given)),
            ctypes.c_double(substeps),
            numbers,
            points,
            rows_of_table,
            address_of(after),
            address_of(given),
            address_of(noise),
            address_of(fast),
            address_of(rows),
            ends,
            columns,
        )
        return after, rows[:done]

    return Engine("compiled", call)


def virtual_engine(chain_of: Callable[[int], ca.Function], substeps: float) -> Engine:
    """The engine of CasADi's virtual machine; the last samples of a run are padded to a whole block.

    chain_of : number of substeps -> the function `chain` of period.py for samples of so many substeps
    """

    def call(
        first: int, state: FloatArray, given: FloatArray, noise: FloatArray, fast: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        edges = np.array([substeps_until(first + k, substeps) for k in range(len(given) + 1)])
        edges, parts, k = edges - edges[0], [], 0
        while k < len(given):
            chain = chain_of(int(edges[k + 1] - edges[k]))
            block = chain.size2_in(1)
            alike = np.diff(edges[k : k + block + 1]) == edges[k + 1] - edges[k]
            end = k + (len(alike) if alike.all() else int(alike.argmin()))
            part = fast[edges[k] : edges[end]].reshape(end - k, -1)
            inputs = np.hstack([given[k:end], noise[k:end], part])
            padded = np.vstack([inputs, np.repeat(inputs[-1:], block - len(inputs), axis=0)])
            states, rows = evaluate(chain, state, padded)
            state = states[len(inputs) - 1]
            parts.append(rows[: len(inputs)])
            k = end
        return state, np.concatenate(parts)

    return Engine("virtual machine", call)


def evaluate(function: ca.Function, *arguments: FloatArray) -> list[FloatArray]:
    """Call a dense CasADi function on numpy arrays: a row of an array is a column of the function's argument or result.

    The function reads and writes the arrays' memory, which is faster than a conversion to DM.
    """
    results = [np.empty(function.size_out(i)[::-1]) for i in range(function.n_out())]
    buffer, run = function.buffer()
    inputs = [np.ascontiguousarray(array, dtype=float) for array in arguments]
    for i, array in enumerate(inputs):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    run()
    return results
