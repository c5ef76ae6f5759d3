"""`malta log`: what a log of a bench holds, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from malta.cli.options import AsJson
from malta.cli.output import make_console, print_document, print_text, print_written


def log(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A log: .csv, .npz or .mat.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw it: a .png, .svg or .pdf file.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show a log: statistics of its signals, gaps, jitter, missing readings, stuck and clipped sensors, limits.

    \b
    Example:  malta log build/robust.npz --out build/log.png
    """
    from malta.identification.log import read_log
    from malta.report.tables.identification import log_table

    found = read_log(file)
    files = []
    if out is not None:
        from malta.report.figures import save
        from malta.report.figures.logs import log_figure

        files.append(save(log_figure(found), out))
    if as_json:
        from malta.cli.documents.identification import log_output

        print_document(log_output(found, files))
        return
    console, survey = make_console(), found.survey
    of = f"{found.machine or 'an unnamed machine'} under {found.controller or 'an unnamed law'}"
    length = (
        f"{found.samples} samples of {1e6 * found.sample_time:g} us, {found.samples * found.sample_time:g} s"
    )
    print_text(console, f"{file}: {of}, {length}")
    excited = (
        f"an excitation with a period of {found.period:g} s" if found.period else "no periodic excitation"
    )
    print_text(console, f"{excited}, jitter {1e6 * survey.jitter:.3g} us, {survey.gaps} gaps")
    console.print(log_table(found))
    for finding in survey.findings or ("nothing is missing, stuck, clipped or at a limit",):
        print_text(console, finding)
    print_written(console, files)
