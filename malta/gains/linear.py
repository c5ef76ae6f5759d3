"""The table of a machine from plain matrices in a gain file, from and to its parameters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from malta.errors import InputError
from malta.files import require_plain_name
from malta.gains.schema import LinearTable, PlantTable
from malta.model.linear import LinearSystem, linear_machine
from malta.model.plant import Signal

if TYPE_CHECKING:
    from malta.model.plant import Parameters

LINEAR = "linear"  # the name of all such machines; their own names are their presets


def signal_tables(record: Any, *keys: str) -> dict[str, Any]:
    """Signals of a record, a table for each."""
    return {key: [s._asdict() for s in getattr(record, key)] for key in keys}


def linear_table(parameters: Any) -> dict[str, Any]:
    """The table plant.linear of such a machine's parameters."""
    s: LinearSystem = parameters.system
    matrices, terms = (
        [dict(zip("ABC", (np.array(M) for M in one), strict=True)) for one in several]
        for several in ([s.matrices], [found for _, found in s.terms])
    )
    return {
        **signal_tables(s, "states", "inputs", "outputs"),
        "matrices": matrices[0],
        "terms": dict(zip([name for name, _ in s.terms], terms, strict=True)),
        "limit": np.array(s.limit) if np.isfinite(s.limit).all() else None,
        "noise": np.array(s.noise),
        "dead_time": s.dead_time,
    }


def linear_parameters(plant: PlantTable, given: LinearTable, path: str | Path) -> Parameters:
    """The parameters of a machine from plain matrices."""
    if plant.name != LINEAR:
        raise InputError(path, "plant.linear", f"matrices of a {plant.name}", f"those of {LINEAR!r}")
    require_plain_name(plant.preset, path, "plant.preset")
    parameters, terms = plant.parameters or {}, given.terms or {}
    for key, q in parameters.items():
        if q.unit != "1":
            raise InputError(path, f"plant.parameters.{key}.unit", repr(q.unit), "'1'")
    signals = {
        key: [Signal(s.name, s.unit) for s in getattr(given, key)] for key in ("states", "inputs", "outputs")
    }
    try:
        return linear_machine(
            **given.matrices.model_dump(),
            **cast("Any", signals),
            name=plant.preset,
            nominal={key: q.value for key, q in parameters.items()},
            terms={key: (M.A, M.B, M.C) for key, M in terms.items()},
            limit=math.inf if given.limit is None else given.limit,
            noise=given.noise,
            dead_time=given.dead_time,
        ).parameters
    except InputError as error:
        raise InputError(path, f"plant.linear.{error.field}", error.found, error.expected) from error
