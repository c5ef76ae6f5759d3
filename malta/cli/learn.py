"""`malta learn`: what the log of a stroke teaches about the next one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from malta.cli.identify import LogFile
from malta.cli.inputs import read_controller, verify_and_write
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_document, print_text, print_written


def learn(
    gains: GainFile,
    log: LogFile,
    parameter: Annotated[
        str, typer.Option(metavar="NAME", help="The force constant of the thrust. [found by its effect]")
    ] = "",
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write NAME_learned as .json, .npz and .mat.")
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Learn the thrust of the drive from the log of one stroke, and write it into what the law believes.

    The new gain file commutates with the learned force constant, and its filter predicts with it: the next stroke needs
    no feedback to correct the thrust.

    \b
    Example:  malta learn design/gains/robust.json build/stroke.npz --out build
    """
    from malta.identification.learn import learn as learn_thrust
    from malta.identification.log import read_log

    found = learn_thrust(read_controller(gains, machine), read_log(log), parameter=parameter)
    files = [] if out is None else verify_and_write(found.controller, gains, out)
    if as_json:
        from malta.cli.documents.identification import learn_output

        print_document(learn_output(gains, log, found, files))
        return
    console = make_console()
    half = 1.96 * found.deviation
    print_text(console, f"{log}: the stroke took {found.factor:.4f} +- {half:.4f} times the thrust expected")
    print_text(console, f"{found.parameter}: {found.before:.5g} -> {found.after:.5g}, as the law believes it")
    print_written(console, files)
