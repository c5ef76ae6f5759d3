"""`malta claims`: every number that a machine's paper publishes beside ours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import AsJson, complete_designs, design_files
from malta.cli.output import make_console, print_document, print_written, progress_bar
from malta.errors import InputError

if TYPE_CHECKING:
    from malta.report.ledger import Ledger
    from malta.synthesis.spec import Spec


def claims(
    designs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[DESIGN]...",
            help="Design files; of design/ those meant to reproduce a paper if none is named.",
            autocompletion=complete_designs,
        ),
    ] = None,
    why: Annotated[
        bool, typer.Option("--why", help="Print below each line the whole verdict, with its reason.")
    ] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the tables as the pages of claims hold them.")
    ] = False,
    update: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Compute the tables of a Markdown file anew, each for the designs that its header names.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the ledger, a line a claim: what a machine's paper publishes, ours for each design, and a verdict.

    All of it is computed now: models, gains, margins, experiments on the simulated machine. A verdict is one word:
    reproduced, near (within 20 %), kept (a bound, by far), input, differs, partly (of some designs), beside (of
    another method), ours (the paper prints no such number) or other (no design that is meant to reproduce it).

    \b
    Example:  malta claims design/table2.toml
              malta claims --update docs/claims/tubular.md
    """
    from malta.synthesis.design_file import read_design

    if update is not None:
        _update(update, designs or [])
        return

    specs = [read_design(file) for file in design_files("claims", designs, reverse=True, or_shipped=True)]
    if not designs:
        specs = [spec for spec in specs if _is_meant(spec)] or specs
    with progress_bar("claims") as progress:
        ledgers = compute_ledgers(specs, progress)
    if as_json:
        from malta.cli.documents.others import claims_output

        print_document(claims_output(ledgers))
    elif markdown:
        print("\n".join(f"### {one.title}\n\n{one.markdown()}" for one in ledgers), end="")
    else:
        from malta import report

        for one in ledgers:
            make_console().print(report.claims_table(one, why=why))


def _is_meant(spec: Spec) -> bool:
    """Whether a design is meant to reproduce the paper on its machine."""
    from malta.model.machines import require_part

    return spec.name in getattr(require_part("claims", spec.plant.name), "REPRODUCING", (spec.name,))


def compute_ledgers(specs: Sequence[Spec], progress: Callable[[float], None] | None) -> list[Ledger]:
    """Compute the ledger of each machine, in the order in which the designs name the machines."""
    machines = dict.fromkeys(spec.plant.name for spec in specs)
    return _compute_each([[spec for spec in specs if spec.plant.name == name] for name in machines], progress)


def _compute_each(groups: Sequence[Sequence[Spec]], progress: Callable[[float], None] | None) -> list[Ledger]:
    """Compute the ledger of each group of designs of one machine."""
    from malta.model.data import published
    from malta.report.ledger import ledger
    from malta.simulation.experiments import progress_of_part

    return [
        ledger(group, published(group[0].machine_file), progress_of_part(progress, n, len(groups)))
        for n, group in enumerate(groups)
    ]


def _update(file: Path, designs: Sequence[Path]) -> None:
    """Compute the tables of a Markdown file anew.

    Raises InputError for designs beside the file, a table of a design that is not there, and a file without tables.
    """
    from malta.files import read_file, replace_files
    from malta.report.ledger import find_tables, replace_tables
    from malta.synthesis.design_file import read_design

    if designs:
        raise InputError("--update", "designs", str(designs[0]), "none: the file's tables name theirs")
    text = read_file(file, "Markdown file", lambda path: path.read_text(encoding="utf-8"))
    known = {path.stem: path for path in design_files("claims", None, or_shipped=True)}
    specs = []
    for place in find_tables(text, str(file)):
        for name in place.designs:
            if name not in known:
                raise InputError(file, place.machine, repr(name), "one of " + " ".join(sorted(known)))
        specs.append([read_design(known[name]) for name in place.designs])
    with progress_bar("claims") as progress:
        ledgers = _compute_each(specs, progress)
    replace_files({file: replace_tables(text, ledgers, str(file)).encode()})
    print_written(make_console(), [file])


# `malta schema`: the JSON schemas of files, and of what commands print with --json.


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
