"""`malta pil`: processor in the loop, the recorded vectors on a target over a serial line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_document, print_line, progress_bar

if TYPE_CHECKING:
    from malta.cli.documents.others import PilOutput
    from malta.firmware.pil import Replay


def pil(
    gains: GainFile,
    port: Annotated[str, typer.Option(metavar="PORT", help="Of the serial line: /dev/ttyUSB0, COM3.")],
    baud: Annotated[int, typer.Option(help="Its speed.")] = 115200,
    timeout: Annotated[float, typer.Option(help="To wait for each answer [s].")] = 2.0,
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
        print_document(_document(str(gains), port, replay))
    else:
        _print(port, replay)
    raise typer.Exit(0 if replay.agrees else 1)


def _print(port: str, replay: Replay) -> None:
    """Print a table of the vectors, how fast it was, and the verdict."""
    from malta.report.tables.parts import add_row, new_table

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


def _document(gains: str, port: str, replay: Replay) -> PilOutput:
    """The JSON document of a replay."""
    from malta.cli.documents.others import PilOutput, VectorPart

    return PilOutput(
        gains=gains,
        port=port,
        precision=replay.precision,
        agrees=replay.agrees,
        vectors=[
            VectorPart(
                name=v.name,
                samples=v.samples,
                first_that_differs=None if v.differs < 0 else v.differs,
                largest_difference=v.largest,
            )
            for v in replay.vectors
        ],
        samples_per_s=replay.samples_per_second,
        requests_sent_again=replay.repeated,
        slowest_step_counts=replay.counts or None,
    )
