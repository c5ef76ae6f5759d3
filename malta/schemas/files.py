"""The schemas of gain files, design files and data files, from the tables that their readers check with."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pydantic import BaseModel, StrictStr, create_model

from malta.errors import InputError
from malta.gains.schema import GainFile
from malta.model.data import MachineFile
from malta.model.parameters import units_of
from malta.model.plant import Plant
from malta.synthesis.design_file import EXCLUDED_TABLES, LQG, LQG_ONLY_KEYS
from malta.synthesis.design_tables import AnyBound, DesignFile, specification_record
from malta.synthesis.requirements import requirements_for

# JSON schemas as nested tables, and what is changed in those that pydantic makes.


DRAFT = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]


def schema_of(model: type[BaseModel], title: str) -> Schema:
    """Make the schema of a table; its title replaces those that pydantic derives from names of Python."""
    return {"$schema": DRAFT, "title": title} | change_nodes(
        model.model_json_schema(by_alias=True), _drop_title
    )


def change_nodes(node: Schema, change: Callable[[Schema], Schema]) -> Schema:
    """Apply a change to a schema and all schemas in it, the innermost first."""
    node = dict(node)
    for key in ("$defs", "properties"):
        if key in node:
            node[key] = {name: change_nodes(inner, change) for name, inner in node[key].items()}
    for key in ("additionalProperties", "items"):
        if isinstance(node.get(key), dict):
            node[key] = change_nodes(node[key], change)
    if "anyOf" in node:
        node["anyOf"] = [change_nodes(inner, change) for inner in node["anyOf"]]
    return change(node)


def without_null(node: Schema) -> Schema:
    """Remove null from the alternatives, as TOML has none: an entry is left out."""
    if "anyOf" not in node:
        return node
    rest: list[Schema] = [inner for inner in node["anyOf"] if inner != {"type": "null"}]
    node = {key: value for key, value in node.items() if (key, value) != ("default", None)}
    if len(rest) > 1:
        return node | {"anyOf": rest}
    del node["anyOf"]
    return rest[0] | node


def require_names(node: Schema, names: Iterable[str], *, all_of: bool = False) -> Schema:
    """Restrict the keys of a table with free keys to some names.

    all_of : each of the names has to stand in the table
    """
    if "anyOf" in node:
        return node | {"anyOf": [require_names(inner, names, all_of=all_of) for inner in node["anyOf"]]}
    if not isinstance(node.get("additionalProperties"), dict):
        return node
    properties = dict.fromkeys(names, node["additionalProperties"])
    needed = {"required": list(properties)} if all_of else {}
    return node | {"properties": properties, "additionalProperties": False} | needed


def _drop_title(node: Schema) -> Schema:
    """A schema without the title that repeats its name."""
    return {key: value for key, value in node.items() if key != "title"}


PUBLISHED_SCHEMA: Schema = {
    "type": "object",
    "description": "what the machine's paper prints under a name of its published figures",
    "properties": {"published": {"description": 'dotted name, as "table_II.state"'}},
    "required": ["published"],
    "additionalProperties": False,
}


def gain_schema() -> Schema:
    """Make the schema of a gain file; that of its tables in .npz and .mat is the same."""
    versions = {
        "if": {"required": ["law"]},
        "then": {"properties": {"version": {"const": 2}}},
        "else": {
            "properties": {
                "version": {"const": 1},
                "commutation": {"type": "null"},
                "plant": {"properties": {"linear": {"type": "null"}}},
            }
        },
    }
    return schema_of(GainFile, "malta gain file") | versions


def design_schema(plant: Plant | None = None) -> Schema:
    """Make the schema of a design file.

    plant : the machine whose signals, parameters and requirements the file names; None: any names
    """
    bounds: Any = dict[StrictStr, AnyBound]
    if plant is not None:
        bounds = specification_record(requirements_for(plant).values())
    known = DesignFile.model_fields["specification"]
    model = create_model("DesignFile", __base__=DesignFile, specification=(bounds | None, known))
    schema = change_nodes(schema_of(model, "malta design file"), without_null)
    if plant is not None:
        _name_signals(schema, plant)
    schema = change_nodes(schema, _or_published)
    schema["$defs"]["Published"] = PUBLISHED_SCHEMA
    laws: Schema = {"required": list(LQG)}
    for law, others in EXCLUDED_TABLES.items():
        alone = {"properties": dict.fromkeys((*LQG_ONLY_KEYS, *others), False)}
        laws = {"if": {"required": [law]}, "then": alone, "else": laws}
    return schema | {"allOf": [laws]}


def data_schema(plant: Plant | None = None) -> Schema:
    """Make the schema of a data file.

    plant : the machine whose parameters the file names; None: any names
    """
    schema = change_nodes(schema_of(MachineFile, "malta data file"), without_null)
    if plant is not None:
        units = units_of(plant.parameters)
        entries = {name: {"$ref": "#/$defs/Sourced", "unit": unit} for name, unit in units.items()}
        table = {"type": "object", "properties": entries, "additionalProperties": False}
        schema["properties"]["parameters"] |= table
        schema["properties"]["presets"]["additionalProperties"] = table
    return schema


def _name_signals(schema: Schema, plant: Plant) -> None:
    """Put the names of a machine in the place of free keys; tables of signals that every law has are complete."""
    states, inputs, outputs = (
        [s.name for s in signals] for signals in (plant.design_states, plant.inputs, plant.outputs)
    )
    positions = states[: plant.coordinates]
    integrals, axes = [*outputs, *positions], [*inputs, *positions]
    complete = {"state": states, "input": inputs, "sensor": outputs}
    some = {
        "WeightsTable": {"integral": integrals},
        "BasesTable": {"integral": integrals},
        "NoiseTable": dict.fromkeys(("process", "drift"), axes) | {"correlation": positions},
        "PidTable": dict.fromkeys(("Kp", "Ki", "Kd", "filters"), axes),
        "StructureTable": {"law": [*outputs, *positions]},
        "CostTable": {"load": inputs, "force_noise": inputs, "sensor_noise": outputs},
    }
    for table, partial in some.items():
        properties = schema["$defs"][table]["properties"]
        for key, allowed in (complete | partial).items():
            if key in properties:
                properties[key] = require_names(properties[key], allowed, all_of=key in complete)
    whole = schema["properties"]
    whole["operating_point"] = require_names(whole["operating_point"], states)
    for key in ("pause", "braking"):
        whole[key] = require_names(whole[key], outputs)
    limits = schema["$defs"]["ReferencesTable"]["properties"]
    for key in limits:
        limits[key] = require_names(limits[key], outputs)
    whole["uncertainty"] = require_names(whole["uncertainty"], units_of(plant.parameters))


def _or_published(node: Schema) -> Schema:
    """Allow a reference to a published figure in the place of a number, a quantity, or a table of them.

    Entries of lists are not looked up.
    """
    node = dict(node)
    if "properties" in node:
        node["properties"] = {
            name: _alternative(inner) if _is_numeric(inner) else inner
            for name, inner in node["properties"].items()
        }
    if isinstance(node.get("additionalProperties"), dict) and _is_numeric(node["additionalProperties"]):
        node["additionalProperties"] = _alternative(node["additionalProperties"])
    return node


# Tables of quantities, and quantities.
NUMERIC_TABLES = ("Quantity", "BoundsTable", "RecoveryTable", "Specification")


def _is_numeric(node: Schema) -> bool:
    """Whether a number, a quantity or a table of them may stand where this schema is."""
    inside = [*node.get("anyOf", ()), *node.get("properties", {}).values()]
    if isinstance(node.get("additionalProperties"), dict):
        inside.append(node["additionalProperties"])
    name = str(node.get("$ref", "")).rpartition("/")[2]
    return (
        node.get("type") in ("number", "integer") or name in NUMERIC_TABLES or any(map(_is_numeric, inside))
    )


def _alternative(node: Schema) -> Schema:
    """A schema, or a reference to a published figure in its place; what is said of it stands beside both."""
    said = {key: node[key] for key in ("description", "unit", "default") if key in node}
    bare = {key: value for key, value in node.items() if key not in said}
    kinds = bare["anyOf"] if list(bare) == ["anyOf"] else [bare]
    return said | {"anyOf": [*kinds, {"$ref": "#/$defs/Published"}]}


# Schemas by the names of what they describe.


SCHEMAS: dict[str, Callable[[], Schema]] = {"gain": gain_schema, "design": design_schema, "data": data_schema}
"""Functions that make the schemas of files, by the names that `malta.schemas.schema` takes.

>>> import malta
>>> sorted(malta.schemas.SCHEMAS)
['data', 'design', 'gain']
"""

MACHINE_SCHEMAS: dict[str, Callable[[Plant], Schema]] = {"design": design_schema, "data": data_schema}


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
    known = SCHEMAS if plant is None else MACHINE_SCHEMAS
    if name not in known:
        raise InputError("schema", "name", repr(name), "one of " + ", ".join(known))
    return SCHEMAS[name]() if plant is None else MACHINE_SCHEMAS[name](plant)
