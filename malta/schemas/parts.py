"""JSON schemas as nested tables, and what is changed in those that pydantic makes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pydantic import BaseModel

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
