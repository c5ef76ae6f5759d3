"""The JSON schemas of the documents, made of their models, and of the files that malta reads."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from malta.cli.documents import campaigns, loads, loops, others, plots
from malta.cli.documents.loops import DocumentPart
from malta.errors import InputError
from malta.schemas import SCHEMAS
from malta.schemas.files import DRAFT

# Each stands for the document that `malta NAME --json` prints, or one of its subcommands.
NAMES = (
    "design", "verify", "loads", "check", "simulate", "campaign", "status", "rare", "sobol", "tolerance", "tune",
    "excite", "log", "identify", "learn", "learned-strokes", "learned-v0", "replay", "measure", "measure-plan",
    "response", "commission", "plot", "report", "compare", "export", "pil", "claims", "inspect",
)  # fmt: skip
_KINDS = {
    str(model.model_fields["kind"].default): model
    for module in (campaigns, loads, loops, others, plots)
    for model in vars(module).values()
    if isinstance(model, type) and issubclass(model, DocumentPart) and "kind" in model.model_fields
}
MODELS: dict[str, type[DocumentPart]] = {f"{name}-output": _KINDS[f"malta-{name}-output"] for name in NAMES}


def output_schema(name: str) -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a document; `name` is a key of MODELS.

    >>> output_schema("export-output")["properties"]["to"]["enum"]
    ['c', 'fmu']
    """
    return {"$schema": DRAFT} | MODELS[name].model_json_schema(mode="serialization")


# Of files and of documents, by name.
ALL_SCHEMAS: dict[str, Callable[[], dict[str, Any]]]
ALL_SCHEMAS = SCHEMAS | {name: partial(output_schema, name) for name in MODELS}


def schema_of(name: str) -> dict[str, Any]:
    """The JSON schema of a kind of file or of a document. Raises InputError for an unknown name.

    >>> schema_of("data")["required"]
    ['machine', 'parameters']
    """
    if name not in ALL_SCHEMAS:
        raise InputError("schema", "", repr(name), "one of " + ", ".join(ALL_SCHEMAS))
    return ALL_SCHEMAS[name]()
