"""`malta export`: the controller of a gain file as C, or a part of the loop as an FMU."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_json, print_note, print_written
from malta.errors import InputError


def export(
    gains: GainFile,
    to: Annotated[str, typer.Option("--to", metavar="FORM", help="c: a folder of C99.")] = "c",
    precision: Annotated[str, typer.Option(help="float or double, of the C.")] = "double",
    until: Annotated[
        str | None,
        typer.Option(
            help="How far down the C goes: currents, or duty-cycles. [as far as the machine is modelled]"
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The folder, new or empty. [build/NAME_c]")] = None,
    proof: Annotated[
        bool, typer.Option(help="Prove the margin again with the coefficients that float holds.")
    ] = True,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Write the controller as C that computes the same bits on every processor, with its test and a report.

    \b
    Example:  malta export design/gains/robust.json --to c --precision float --out build/robust_c
    """
    from malta.firmware.elementary import Precision
    from malta.firmware.folder import Until, export_c

    if to != "c":
        raise InputError("--to", "", repr(to), "c")
    if precision not in get_args(Precision):
        raise InputError("--precision", "", repr(precision), "double or float")
    if until not in (None, *get_args(Until)):
        raise InputError("--until", "", repr(until), " or ".join(get_args(Until)))
    controller = read_controller(gains, machine)
    if proof and precision == "float" and not as_json:
        print_note("proving the margin with the coefficients that float holds; --no-proof leaves it out")
    folder = out or Path("build") / f"{controller.name}_c"
    chosen: Any = {"precision": precision, "until": until}
    files = export_c(gains, folder, proof=proof, **chosen)
    if as_json:
        print_json({"gains": str(gains), "to": to, "files": [str(file) for file in files]})
    else:
        print_written(make_console(), files)
