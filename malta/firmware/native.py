"""The exported C, compiled on this computer and called from Python: `--controller c`, and tests."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.firmware.ctext import c_name
from malta.firmware.elementary import Precision
from malta.firmware.export import piece_records, sources
from malta.firmware.program import TYPES
from malta.firmware.signals import (
    Field,
    Target,
    input_fields,
    output_fields,
    reference_fields,
    state_fields,
)
from malta.firmware.step import programs_of
from malta.simulation.compiled import library

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

REALS: dict[Precision, Any] = {"double": ctypes.c_double, "float": ctypes.c_float}
EXTRA = ("_parameters.c",)  # of a controller that is tunable
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")


class Native(NamedTuple):
    """A compiled controller; its records are ctypes structures with arrays of the names in signals.py."""

    target: Target
    lib: Any
    name: str
    State: Any
    Reference: Any
    Inputs: Any
    Outputs: Any


@lru_cache(maxsize=16)
def compile_controller(t: Target) -> Native:
    """The controller's C, compiled. Raises InputError without a C compiler."""
    name = c_name(t.controller.name)
    files = sources(t, "", name)
    lib = compile_files(
        [files[f"{name}{end}"] for end in (".h", ".c", "_parts.c", *EXTRA) if f"{name}{end}" in files]
    )
    real = REALS[t.precision]

    def record(title: str, fields: list[Field], more: tuple[tuple[str, Any], ...] = ()) -> Any:
        return record_type(title, (*((f.name, real * f.size) for f in fields if f.size), *more))

    Reference = record("Reference", reference_fields(t))
    addresses = ("z", "v0", "parameters") if t.tunable else ("z", "v0")
    table = (*((key, ctypes.c_void_p) for key in addresses), ("points", ctypes.c_int32))
    return Native(
        t,
        lib,
        name,
        record("State", state_fields(t), (("reference", Reference), *table)),
        Reference,
        record("Inputs", input_fields(t)),
        record("Outputs", output_fields(t)),
    )


@cache
def record_type(title: str, fields: tuple[tuple[str, Any], ...]) -> Any:
    """The ctypes structure of these fields: one type, so a controller compiled again takes the records of before."""
    return type(title, (ctypes.Structure,), {"_fields_": fields})


def compile_files(texts: Sequence[str]) -> Any:
    """The library of C files in this order, headers first. Raises InputError without a C compiler."""
    lib = library(re.sub(r'#include "\w+\.h"\n', "", "".join(texts)), 1, flags=FLAGS)
    if lib is None:
        raise InputError("export", "C compiler", "none that works", "cc, gcc or clang, or $CC")
    return lib


def call(native: Native, function: str, *arguments: Any) -> int:
    """Call a function of the controller with records and numbers."""
    given = [ctypes.byref(a) if isinstance(a, ctypes.Structure) else a for a in arguments]
    return int(getattr(native.lib, f"{native.name}_{function}")(*given))


def call_piece(
    native: Native, piece: str, given: Mapping[str, FloatArray], sizes: Mapping[str, int]
) -> dict[str, Any]:
    """Call a piece with vectors; the results by name. sizes : of the results"""
    real = TYPES[native.target.precision]
    results = {name: np.zeros(size, dtype=real) for name, size in sizes.items()}
    vectors = [np.ascontiguousarray(value, dtype=real) for value in given.values()]
    function = getattr(native.lib, f"{native.name}_{piece}")
    if piece_records(
        programs_of(native.target)[piece]
    ):  # records have nothing but these arrays, in this order
        both = [np.concatenate(vectors), np.concatenate(list(results.values()))]
        function(*(v.ctypes.data_as(ctypes.c_void_p) for v in both))
        ends = np.cumsum([v.size for v in results.values()])[:-1]
        return dict(zip(results, np.split(both[1], ends), strict=True))
    # The C has no arguments without entries.
    function(*(v.ctypes.data_as(ctypes.c_void_p) for v in (*vectors, *results.values()) if v.size))
    return results


def new_state(native: Native) -> Any:
    """A state at rest."""
    state = native.State()
    call(native, "init", state)
    return state


def write(record: Any, values: Mapping[str, Any]) -> None:
    """Put vectors into the arrays of a record."""
    for name, value in values.items():
        array = getattr(record, name)
        array[:] = np.asarray(value, dtype=float).ravel().tolist()


def view(record: Any, name: str) -> Any:
    """The array of a record as numpy sees it, in place."""
    return np.ctypeslib.as_array(getattr(record, name))
