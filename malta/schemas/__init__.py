"""JSON schemas of the files that malta reads, made of the tables that the readers check with.

    malta.schemas.schema("gain")      a gain file (.json, and what .npz and .mat hold)
    malta.schemas.schema("design")    a design file (.toml)
    malta.schemas.schema("data")      a machine's data file (.toml)

An editor that knows the schema of a file completes its keys and underlines what the reader would refuse. A schema sees
one file: what depends on the machine (names of signals and parameters, dimensions, whether a loop is stable) the
reader checks alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from malta.errors import InputError
from malta.gains.schema import GainFile
from malta.model.data import MachineFile
from malta.synthesis.design_tables import DesignFile

DRAFT = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]


def gain_schema() -> Schema:
    """The schema of a gain file."""
    return {"$schema": DRAFT} | GainFile.model_json_schema()


def design_schema() -> Schema:
    """The schema of a design file."""
    return {"$schema": DRAFT} | DesignFile.model_json_schema()


def data_schema() -> Schema:
    """The schema of a machine's data file."""
    return {"$schema": DRAFT} | MachineFile.model_json_schema()


SCHEMAS: dict[str, Callable[[], Schema]] = {"gain": gain_schema, "design": design_schema, "data": data_schema}


def schema(name: str) -> Schema:
    """Return the JSON schema (draft 2020-12) of a kind of file: "gain", "design" or "data".

    Raises InputError for an unknown name.

    >>> import malta
    >>> malta.schemas.schema("data")["required"]
    ['machine', 'parameters']
    """
    if name not in SCHEMAS:
        raise InputError("schema", "", repr(name), "one of " + ", ".join(SCHEMAS))
    return SCHEMAS[name]()
