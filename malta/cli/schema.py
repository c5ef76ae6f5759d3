"""`malta schema`: the JSON schemas of files, and of what commands print with --json."""

from __future__ import annotations

from typing import Annotated

import typer


def schema(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Which one; all names if none is given.")
    ] = None,
) -> None:
    """Print the JSON schema of a file, or of what a command prints with --json.

    \b
    Example:  malta schema verify-output
              malta schema design > design.schema.json
    """
    from malta.cli.documents.published import ALL_SCHEMAS, schema_of
    from malta.files import json_text

    print("\n".join(ALL_SCHEMAS) if name is None else json_text(schema_of(name)))
