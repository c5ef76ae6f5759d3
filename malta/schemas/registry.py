"""Schemas by the names of what they describe."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from malta.errors import InputError
from malta.schemas.files import data_schema, design_schema, gain_schema
from malta.schemas.parts import Schema

if TYPE_CHECKING:
    from malta.model.plant import Plant

SCHEMAS: dict[str, Callable[[], Schema]] = {"gain": gain_schema, "design": design_schema, "data": data_schema}
"""Functions that make the schemas of files, by the names that `malta.schemas.schema` takes.

>>> import malta
>>> sorted(malta.schemas.SCHEMAS)
['data', 'design', 'gain']
"""

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
    >>> parameters = malta.schemas.schema("data", plant)["properties"]["parameters"]
    >>> parameters["properties"]["m"]["unit"]
    'kg'
    """
    known = SCHEMAS if plant is None else OF_MACHINES
    if name not in known:
        raise InputError("schema", "name", repr(name), "one of " + ", ".join(known))
    return SCHEMAS[name]() if plant is None else OF_MACHINES[name](plant)
