"""JSON schemas of the files that malta reads, made of the tables that the readers check with.

    malta.schemas.schema("gain")            a gain file: .json, and what .npz and .mat hold
    malta.schemas.schema("design")          a design file, as TOML holds it
    malta.schemas.schema("data")            a machine's data file
    malta.schemas.schema("design", plant)   with the names of this machine's signals, parameters and requirements

An editor that has the schema of a file completes its keys and marks what the reader would refuse. A schema sees one
file: what depends on other files or on arithmetic (dimensions of units, shapes of matrices, stability) the reader
checks alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from malta.errors import InputError
from malta.schemas.files import data_schema, design_schema, gain_schema
from malta.schemas.parts import Schema as Schema

if TYPE_CHECKING:
    from malta.model.plant import Plant

SCHEMAS: dict[str, Callable[[], Schema]] = {"gain": gain_schema, "design": design_schema, "data": data_schema}
OF_MACHINES: dict[str, Callable[[Plant], Schema]] = {"design": design_schema, "data": data_schema}


def schema(name: str, plant: Plant | None = None) -> Schema:
    """Return the JSON schema (draft 2020-12) of a kind of file.

    name : "gain", "design" or "data"
    plant : the machine whose names a design file or a data file may have; None: any names

    Raises InputError for an unknown name, and for a machine where the schema is the same for all machines.

    >>> import malta
    >>> malta.schemas.schema("data")["required"]
    ['machine', 'parameters']
    >>> plant = malta.plant_of(malta.read("data/halbach.toml"))
    >>> sorted(malta.schemas.schema("design", plant)["$defs"]["WeightsTable"]["properties"]["input"]["properties"])
    ['F_x']
    """
    known = SCHEMAS if plant is None else OF_MACHINES
    if name not in known:
        raise InputError("schema", "name", repr(name), "one of " + ", ".join(known))
    return SCHEMAS[name]() if plant is None else OF_MACHINES[name](plant)
