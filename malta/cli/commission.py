"""`malta commission`: the checklist of the first day, on the simulated machine or from a bench's logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import AsJson, Changes, GainFile, MachineFile, Seed, change_machine, read_controller
from malta.cli.output import make_console, print_document, print_note, print_text, print_written
from malta.errors import CheckError

if TYPE_CHECKING:
    from malta.identification.commission import Commissioning, Step


def commission(
    gains: GainFile,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Logs, journal and page. [build/commission/NAME]")
    ] = None,
    logs: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="A bench's logs, STEP.npz, .csv or .mat, are judged."),
    ] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="List the steps: what each needs, aborts at and writes.")
    ] = False,
    change: Changes = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="Error of a sensor of the simulated machine, as gain_x1=0.02."
        ),
    ] = None,
    seed: Seed = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Go through the checklist of the first day: each step records a log, judges it, and is kept in a journal.

    A step that fails ends the day with exit code 1; the next call goes on from there. With --set and --sensor the
    simulated machine is one that the gain file does not know. The page for the lab's binder is signed by the sha256 of
    gain file, logs and results.

    \b
    Example:  malta commission design/gains/robust.json --set K_A=9000
    """
    from malta.cli.options import read_sensor_errors
    from malta.files import replace_files
    from malta.gains.file import content_of
    from malta.identification.commission import JOURNAL, steps_of
    from malta.identification.commission import commission as commission_machine
    from malta.model.data import plant_of
    from malta.report.page.document import binder_page, binder_text

    controller = read_controller(gains, machine)
    plant = plant_of(controller.parameters)
    steps = steps_of(plant, content_of(gains)[0].uncertainty or {})
    if plan:
        _print_plan(steps)
        return
    folder = out or Path("build", "commission", controller.name)
    done = commission_machine(
        gains, controller, folder,
        truth=plant_of(change_machine(controller.parameters, change)), errors=read_sensor_errors(sensor, plant),
        logs=logs, steps=steps, seed=seed or 0, progress=lambda name: print_note(f"step {name}"),
    )  # fmt: skip
    page, text = folder / "binder.html", folder / "binder.txt"
    replace_files({page: binder_page(done).content, text: binder_text(done).encode()})
    files = [Path(entry.log) for entry in done.entries if entry.sha256 and logs is None]
    files += [folder / JOURNAL, page, text]
    if as_json:
        from malta.cli.documents.others import commission_output

        print_document(commission_output(done, files))
    else:
        _print(done, files)
    if not done.passed:
        last = done.entries[-1]
        bad = "; ".join(f"{one.name} is {one.found}" for one in last.findings if not one.holds)
        raise CheckError(f"step {last.name} failed: {last.refusal or bad}")


def _print_plan(steps: tuple[Step, ...]) -> None:
    """The checklist, as it stands before the first step."""
    from malta.report.tables.experiments import checklist_table

    make_console().print(checklist_table(steps))


def _print(done: Commissioning, files: list[Path]) -> None:
    """The findings of all steps, the signature and the files."""
    from malta.report.tables.experiments import findings_table

    console = make_console()
    console.print(findings_table(done))
    if done.kept:
        print_text(console, f"kept from an earlier call: {' '.join(done.kept)}")
    print_text(console, f"signature {done.signature}")
    print_written(console, files)
