"""`malta compare`: several gain files beside each other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, Changes, MachineFile, Uncertain
from malta.cli.output import make_console, print_document, print_written
from malta.cli.report import read_subject, unwritten_progress
from malta.files import locate, replace_files


def compare(
    gains: Annotated[
        list[Path], typer.Argument(metavar="GAINS...", help="2 to 8 gain files: .json, .npz or .mat.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a page (.html) with the curves over each other."),
    ] = None,
    uncertain: Uncertain = None,
    change: Changes = None,
    no_proof: Annotated[
        bool, typer.Option("--no-proof", help="Leave out the margins of the parameters, which take longest.")
    ] = False,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare gain files: what differs in the designs, and every figure of merit with the better one marked.

    Machines that differ are compared in what their loops have in common. An unstable loop gives exit code 1.

    \b
    Example:  malta compare design/gains/table2.json design/gains/robust.json
    """
    from malta.margins.loop_report import require_stable
    from malta.report.page.comparison import compare as compare_subjects
    from malta.report.page.comparison import require_count
    from malta.report.page.document import SUFFIXES, require_suffix
    from malta.report.tables.comparison import comparison_tables

    require_count(len(gains))
    page_file = None if out is None else require_suffix(out, *SUFFIXES)
    files = [locate(file) for file in gains]
    subjects = [read_subject(file, read_controller(file, machine), change, uncertain, None) for file in files]
    with unwritten_progress("compare") as progress:
        found = compare_subjects(subjects, proof=not no_proof, progress=progress)
        written = []
        if page_file is not None:
            from malta.report.page.compared import comparison_page

            replace_files({page_file: comparison_page(found).content})
            written.append(page_file)
    if as_json:
        from malta.cli.documents.pages import compare_output

        print_document(compare_output(found, written))
    else:
        console = make_console()
        console.print(comparison_tables(found, console.width))
        print_written(console, written)
    for file, design in zip(files, found.designs, strict=True):
        require_stable(design.report, str(file))
