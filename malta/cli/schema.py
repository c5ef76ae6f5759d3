"""`malta schema`: the JSON schemas of files, and of what commands print with --json."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def schema(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Which one; all names if none is given.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DATA]", help="Data file of a machine: a schema with the names of its signals."
        ),
    ] = None,
) -> None:
    """Print the JSON schema of a file, or of what a command prints with --json.

    \b
    Example:  malta schema verify-output
              malta schema design > design.schema.json
              malta schema design data/tubular.toml > tubular.schema.json
    """
    from malta import schemas
    from malta.cli.documents.published import ALL_SCHEMAS, schema_of
    from malta.files import json_text
    from malta.model.data import plant_of, read

    if name is None:
        print("\n".join(ALL_SCHEMAS))
    elif data is None:
        print(json_text(schema_of(name)))
    else:
        print(json_text(schemas.schema(name, plant_of(read(data)))))
