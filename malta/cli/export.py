"""`malta export`: the controller of a gain file as C, or a part of the loop as an FMU."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_args

import typer

from malta.cli.options import NUMBER, AsJson, GainFile, MachineFile, offer, read_controller
from malta.cli.output import (
    make_console,
    print_document,
    print_line,
    print_note,
    print_written,
    progress_bar,
    progress_on,
)
from malta.errors import InputError
from malta.units import to_si

if TYPE_CHECKING:
    from malta.firmware.pil import Replay


def export(
    gains: GainFile,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="WORD",
            autocompletion=offer("c", "fmu"),
            help="c: a folder of C99; fmu: one file.",
        ),
    ] = "c",
    precision: Annotated[
        str,
        typer.Option(
            metavar="WORD", autocompletion=offer("float", "double"), help="Numbers of the C: float or double."
        ),
    ] = "double",
    until: Annotated[
        str | None,
        typer.Option(
            metavar="WORD",
            autocompletion=offer("currents", "duty-cycles"),
            help="How far down the C goes: currents, or duty-cycles. [as far as the machine is modelled]",
        ),
    ] = None,
    part: Annotated[
        str | None,
        typer.Option(
            metavar="WORD",
            autocompletion=offer("controller", "supervised", "machine", "loop"),
            help="What an FMU has: controller, supervised, machine, or loop of controller and machine. [controller]",
        ),
    ] = None,
    fmi: Annotated[
        int | None, typer.Option(metavar="N", help="Version of an FMU's interface: 2 or 3. [2]")
    ] = None,
    platforms: Annotated[
        str | None,
        typer.Option(
            metavar="WORD",
            help="Binaries of an FMU, by ziglang: all, or win64,aarch64-linux... [this computer]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|FOLDER",
            help="The folder, new or empty, or the .fmu file. [build/NAME_c, build/NAME_PART.fmu]",
        ),
    ] = None,
    proof: Annotated[
        bool, typer.Option(help="Prove the margin again with the coefficients of float, and other gains.")
    ] = True,
    clock: Annotated[
        str | None,
        typer.Option(
            metavar="QUANTITY", help="Of the processor, for the report's share of a sample: 168MHz. [667MHz]"
        ),
    ] = None,
    tunable: Annotated[
        bool, typer.Option("--tunable", help="Gains, limits and monitors as parameters, with an A2L file.")
    ] = False,
    excitation: Annotated[
        bool,
        typer.Option("--excitation", help="C reads forces beside the law's, as malta excite writes them."),
    ] = False,
    log: Annotated[
        str | None,
        typer.Option(metavar="QUANTITY", help="C keeps the last samples in a ring with a trigger, as 100ms."),
    ] = None,
    xcp: Annotated[
        str | None, typer.Option(metavar="ADDRESS:PORT", help="An XCP slave, as 127.0.0.1:5555.")
    ] = None,
    baud: Annotated[
        int | None, typer.Option(metavar="N", help="Of the XCP slave's serial line. [115200]")
    ] = None,
    wiring: Annotated[
        bool, typer.Option("--wiring", help="The C tries its wiring before it lifts off.")
    ] = False,
    fma: Annotated[bool, typer.Option("--fma", help="C of fused multiply-adds: other bits.")] = False,
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
    from malta.firmware.export import export_c
    from malta.firmware.export_fmu import export_fmu
    from malta.firmware.xcp import read_port

    _require_known(to, precision, until, part, fmi, platforms, clock)
    for option, given in (
        ("--excitation", excitation),
        ("--log", log),
        ("--wiring", wiring),
        ("--xcp", xcp),
        ("--fma", fma),
    ):
        if given and to == "fmu":
            raise InputError(option, "", "an FMU", "--to c")
    hertz = None if clock is None else _quantity("--clock", clock, "Hz", "a frequency, as 168MHz")
    seconds = None if log is None else _quantity("--log", log, "s", "a time, as 100ms")
    if baud is not None and xcp is None:
        raise InputError("--baud", "", "no --xcp", "--xcp ADDRESS:PORT beside it")
    port = None if xcp is None else read_port(xcp, baud)
    controller = read_controller(gains, machine)
    chosen: Any = {"until": until, "tunable": tunable}
    if to == "fmu":
        own = part or "controller"
        file = out or Path("build") / f"{controller.name}_{own}.fmu"
        with progress_on("exporting"):
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
        with progress_on("exporting"):
            files = export_c(
                gains,
                folder,
                precision=cast("Any", precision),
                proof=proof,
                clock=hertz,
                excitation=excitation,
                log=seconds,
                wiring=wiring,
                xcp=port,
                fma=fma,
                **chosen,
            )
    if as_json:
        from malta.cli.documents.others import ExportOutput

        names = [str(file) for file in files]
        print_document(ExportOutput(gains=str(gains), to=cast("Any", to), files=names))
    else:
        print_written(make_console(), files)


def _quantity(option: str, text: str, unit: str, expected: str) -> float:
    """A clock in Hz, or a time in s. Raises InputError for another text."""
    number = re.fullmatch(NUMBER, text.strip())
    if number is None:
        raise InputError(option, "", repr(text), expected)
    return to_si(float(number[1]), number[2] or unit, unit, option, option.strip("-"))


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
    from malta.firmware.export import Until
    from malta.firmware.fmu import Part
    from malta.firmware.program import Precision

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


# `malta pil`: processor in the loop, the recorded vectors on a target over a serial line.


def pil(
    gains: GainFile,
    port: Annotated[str, typer.Option(metavar="PORT", help="Of the serial line: /dev/ttyUSB0, COM3.")],
    baud: Annotated[int, typer.Option(metavar="N", help="Speed of the serial line, baud.")] = 115200,
    timeout: Annotated[
        float, typer.Option(metavar="SECONDS", help="How long to wait for each answer [s].")
    ] = 2.0,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Replay the recorded vectors on a target over a serial line, and compare every bit.

    The target runs NAME_pil.c of an exported folder, with the two functions of its serial port (get a byte, put a
    byte) and, if it has one, a timer's counter. Exit code 1 where a bit differs.

    \b
    Example:  malta export design/gains/robust.json --precision float
              malta pil design/gains/robust.json --port /dev/ttyUSB0 --baud 921600
    """
    from malta.firmware.pil import replay_on_target

    read_controller(gains, machine)
    with progress_bar(f"replaying on {port}") as tell:
        replay = replay_on_target(gains, port, baud=baud, seconds=timeout, tell=tell)
    if as_json:
        from malta.cli.documents.others import PilOutput, VectorPart

        vectors = [
            VectorPart.of(v, first_that_differs=None if v.differs < 0 else v.differs) for v in replay.vectors
        ]
        counts = replay.counts or None
        print_document(
            PilOutput.of(replay, gains=gains, port=port, vectors=vectors, slowest_step_counts=counts)
        )
    else:
        _print(port, replay)
    raise typer.Exit(0 if replay.agrees else 1)


def _print(port: str, replay: Replay) -> None:
    """Print a table of the vectors, how fast it was, and the verdict."""
    from malta.report.tables import add_row, new_table

    console = make_console()
    title = f"The target at {port} ({replay.precision}) against the recorded vectors"
    table: Any = new_table(title, "vector", "samples", "first that differs", "largest difference")
    for v in replay.vectors:
        add_row(table, v.name, str(v.samples), "" if v.differs < 0 else str(v.differs), f"{v.largest:.3g}")
    console.print(table)
    speed = f"{replay.samples_per_second:.0f} samples / s with the line"
    if replay.counts:
        speed += f"; slowest step {replay.counts} counts of the target's timer"
    if replay.repeated:
        speed += f"; {replay.repeated} requests sent again"
    print_line(console, speed)
    print_line(console, "pass: all bits agree" if replay.agrees else "fail: the target computes other bits")


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
    from malta.model.data import read
    from malta.model.plants import plant_of
    from malta.writing import json_text

    if name is None:
        print("\n".join(ALL_SCHEMAS))
    elif data is None:
        print(json_text(schema_of(name)))
    else:
        print(json_text(schemas.schema(name, plant_of(read(data)))))
