"""`malta identify`: parameters of a machine from a log, with intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from malta.cli.assignments import read_assignments
from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_document, print_text, print_written, working
from malta.errors import CheckError

LogFile = Annotated[Path, typer.Argument(metavar="LOG", help="A log: .csv, .npz or .mat.")]


def identify(
    gains: GainFile,
    log: LogFile,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            "-p",
            metavar="NAME",
            help="To identify: of the machine, or of its sensors' errors. Repeatable. [those told to 50 %, but for "
            "masses and lengths]",
        ),
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Weighed or measured otherwise, as m=0.36kg. Repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Write a data file, as robust-identified.toml."),
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Identify parameters of the machine from a log under excitation, each with its 95 % interval.

    Maximum likelihood at the excited lines, from measured currents to measured outputs; feedback does not bias it.
    A log that the machine's model does not explain is refused with exit code 1, and no file is written.

    \b
    Example:  malta identify design/gains/robust.json log.npz -o found.toml
    """
    from malta.identification.data_file import write_data
    from malta.identification.identify import identify as identify_parameters
    from malta.identification.log import read_log
    from malta.identification.response import units_of_model
    from malta.model.data import plant_of
    from malta.report.tables.identification import identified_table, quality_table

    controller = read_controller(gains, machine)
    values = read_assignments("--known", known, units_of_model(plant_of(controller.parameters)))
    with working(f"identifying from {log}"):
        found = identify_parameters(controller, read_log(log), parameters=parameters or (), known=values)
    files = []
    if out is not None and not found.refusal:
        files.append(write_data(found, out, gains=str(gains), known=values))
    if as_json:
        from malta.cli.documents.identification import identify_output

        print_document(identify_output(gains, found, files))
    else:
        console = make_console()
        console.print(identified_table(found))
        console.print(quality_table(found))
        held = ", ".join(f"{name} = {value:.5g}" for name, value in found.held.items())
        print_text(console, f"taken as known, SI: {held or 'nothing'}")
        if found.dropped:
            print_text(console, f"act, but are not told by themselves: {' '.join(found.dropped)}")
        print_written(console, files)
    if found.refusal:
        raise CheckError(f"{log}: {found.refusal}")
