"""`malta replay`: the law of a gain file on the readings of a log."""

from __future__ import annotations

import typer

from malta.cli.identify import LogFile
from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_document, print_text, working


def replay(gains: GainFile, log: LogFile, machine: MachineFile = None, as_json: AsJson = False) -> None:
    """Run a law on logged readings: does it command what was logged, and how large are its innovations?

    Commands that differ give exit code 1: another gain file flew, or another law. Innovations larger than the sensors'
    noise, or far from white, say that the machine is not the one that the filter believes in.

    \b
    Example:  malta replay design/gains/robust.json build/stroke.npz
    """
    from malta.identification.log import read_log
    from malta.identification.replay import replay_law
    from malta.model.data import plant_of
    from malta.report.tables.identification import replay_table

    controller = read_controller(gains, machine)
    with working(f"replaying {log}"):
        found = replay_law(controller, read_log(log))
    if as_json:
        from malta.cli.documents.identification import replay_output

        print_document(replay_output(gains, log, found))
    else:
        console = make_console()
        console.print(replay_table(found, plant_of(controller.parameters)))
        same = "as logged, but for rounding" if found.same else "not those of the log"
        print_text(console, f"{log}: the commands of {controller.name} are {same}")
    raise typer.Exit(0 if found.same else 1)
