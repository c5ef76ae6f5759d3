"""`malta export`: the controller of a gain file as C, or a part of the loop as an FMU."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import typer

from malta.cli.assignments import NUMBER
from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_document, print_note, print_written, working
from malta.errors import InputError
from malta.units import to_si


def export(
    gains: GainFile,
    to: Annotated[str, typer.Option("--to", metavar="FORM", help="c: a folder of C99; fmu: one file.")] = "c",
    precision: Annotated[str, typer.Option(help="float or double, of the C.")] = "double",
    until: Annotated[
        str | None,
        typer.Option(
            help="How far down the C goes: currents, or duty-cycles. [as far as the machine is modelled]"
        ),
    ] = None,
    part: Annotated[
        str | None,
        typer.Option(
            help="Of an FMU: controller, supervised, machine, or loop of controller and machine. [controller]"
        ),
    ] = None,
    fmi: Annotated[int | None, typer.Option(help="Version of an FMU's interface: 2 or 3. [2]")] = None,
    platforms: Annotated[
        str | None,
        typer.Option(help="Binaries of an FMU, by ziglang: all, or win64,aarch64-linux... [this computer]"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The folder, new or empty, or the .fmu file. [build/NAME_c, build/NAME_PART.fmu]"),
    ] = None,
    proof: Annotated[
        bool, typer.Option(help="Prove the margin again with the coefficients of float, and other gains.")
    ] = True,
    clock: Annotated[
        str | None,
        typer.Option(help="Of the processor, for the report's share of a sample: 168MHz. [667MHz]"),
    ] = None,
    tunable: Annotated[
        bool, typer.Option("--tunable", help="Gains, limits and monitors as parameters, with an A2L file.")
    ] = False,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Write the controller as C that computes the same bits on every processor, or as an FMU.

    The folder of C has a test with recorded vectors and a report of cost, rounding and margin. An FMU is of the
    controller, alone or supervised, of its machine, or of the loop of both, for co-simulation.

    \b
    Example:  malta export design/gains/robust.json --precision float
              malta export design/gains/robust.json --to fmu --part loop --fmi 3
    """
    from malta.firmware.exports import export_c, export_fmu

    _require_known(to, precision, until, part, fmi, platforms, clock)
    hertz = None if clock is None else _frequency(clock)
    controller = read_controller(gains, machine)
    chosen: Any = {"until": until, "tunable": tunable}
    if to == "fmu":
        own = part or "controller"
        file = out or Path("build") / f"{controller.name}_{own}.fmu"
        with working("exporting"):
            chosen["platforms"] = None if platforms is None else platforms.replace(" ", "").split(",")
            note = export_fmu(gains, file, part=cast("Any", own), fmi=fmi or 2, **chosen)
        if note:
            print_note(f"{file}: {note}")
        files = [file]
    else:
        if proof and precision == "float" and not as_json:
            print_note("proving the margin with the coefficients that float holds; --no-proof leaves it out")
        if proof and tunable and not as_json:
            print_note(
                "proving the margin with other gains, minutes for some designs; --no-proof leaves it out"
            )
        folder = out or Path("build") / f"{controller.name}_c"
        with working("exporting"):
            files = export_c(
                gains, folder, precision=cast("Any", precision), proof=proof, clock=hertz, **chosen
            )
    if as_json:
        from malta.cli.documents.others import ExportOutput

        names = [str(file) for file in files]
        print_document(ExportOutput(gains=str(gains), to=cast("Any", to), files=names))
    else:
        print_written(make_console(), files)


def _frequency(text: str) -> float:
    """A clock in Hz. Raises InputError for another text."""
    number = re.fullmatch(NUMBER, text.strip())
    if number is None:
        raise InputError("--clock", "", repr(text), "a frequency, as 168MHz")
    return to_si(float(number[1]), number[2] or "Hz", "Hz", "--clock", "clock")


def _require_known(
    to: str,
    precision: str,
    until: str | None,
    part: str | None,
    fmi: int | None,
    platforms: str | None,
    clock: str | None,
) -> None:
    """Raise InputError for an option with a value that there is not, or that the form does not have."""
    from malta.firmware.elementary import Precision
    from malta.firmware.exports import Until
    from malta.firmware.unit import Part

    for name, value, known in (
        ("--to", to, ("c", "fmu")),
        ("--precision", precision, get_args(Precision)),
        ("--until", until, (None, *get_args(Until))),
        ("--part", part, (None, *get_args(Part))),
        ("--fmi", fmi, (None, 2, 3)),
    ):
        if value not in known:
            expected = " or ".join(str(one) for one in known if one is not None)
            raise InputError(name, "", repr(value), expected)
    if to == "fmu" and clock is not None:
        raise InputError("--clock", "", f"{clock} of an FMU", "--to c")
    if to == "fmu" and precision != "double":
        raise InputError("--precision", "", f"{precision} of an FMU", "double")
    for name, given in (("--part", part), ("--fmi", fmi), ("--platforms", platforms)):
        if to == "c" and given is not None:
            raise InputError(name, "", f"{given} of a folder of C", "--to fmu")
