"""`malta measure` and `malta commission`: what a bench shows of the machine and its loop.

`malta measure`: the loop as it is measured, with bands, beside what is predicted; or the plan to measure it.
`malta commission`: the checklist of the first day, on the simulated machine or from a bench's logs.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from malta.cli.identification import read_band
from malta.cli.options import (
    AsJson,
    Changes,
    GainFile,
    MachineFile,
    Seed,
    Uncertain,
    change_machine,
    read_assignments,
    read_controller,
    read_sensor_errors,
    read_uncertainty,
    require_suffixes,
)
from malta.cli.output import make_console, print_document, print_note, print_text, print_written, progress_on
from malta.errors import CheckError, InputError
from malta.files import PICTURES
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.identification.commission import Check, Commissioning
    from malta.identification.measure import Measurement
    from malta.synthesis.controller import Controller

PLAN = "Plan"  # a panel of the help


def measure(
    gains: GainFile,
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG]...", help="Logs under excitation: one, or one for each input.", show_default=False
        ),
    ] = None,
    uncertain: Uncertain = None,
    identified: Annotated[
        Path | None,
        typer.Option(metavar="DATA", help="A data file of malta identify: its machine and intervals."),
    ] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="What to fly, and what it will tell.", rich_help_panel=PLAN)
    ] = False,
    width: Annotated[
        str | None,
        typer.Option(
            metavar="SHARE", help="Half of the widest 95 % band of |S|, as 2%.", rich_help_panel=PLAN
        ),
    ] = None,
    separate: Annotated[
        bool,
        typer.Option(
            "--separate", help="A flight for each input: nothing is interpolated.", rich_help_panel=PLAN
        ),
    ] = False,
    motion: Annotated[
        str | None, typer.Option(metavar="QUANTITY", help="Largest motion, as 20um.", rich_help_panel=PLAN)
    ] = None,
    band: Annotated[
        str | None,
        typer.Option(
            metavar="LOW..HIGH",
            help="Lowest and highest line [Hz]. [by the band of the loop]",
            rich_help_panel=PLAN,
        ),
    ] = None,
    lines: Annotated[int, typer.Option(metavar="N", help="Lines of each input.", rich_help_panel=PLAN)] = 12,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw it: a .png, .svg or .pdf file.")
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure S, T, compliance and open loop at every sensor from logs, with 95 % bands, over what is predicted.

    The tube of the prediction is of machines of the uncertainty: corners and others at random, sampled, not proven.
    Exit code 0: within; 1: outside, another law, or a log that tells nothing.

    \b
    Example:  malta measure design/gains/robust.json --plan --width 2%
              malta measure design/gains/robust.json log.npz --out measured.png
    """
    require_suffixes((out, PICTURES))
    controller = read_controller(gains, machine)
    if plan:
        _require_no(logs, "a log beside --plan")
        sizes = {} if motion is None else read_assignments("--motion", [f"motion={motion}"], {"motion": "m"})
        wide = None if width is None else read_assignments("--width", [f"width={width}"], {"width": "1"})
        _plan(
            gains, controller, sizes | {"band": read_band(band), "lines": lines},
            None if wide is None else wide["width"], separate=separate, as_json=as_json,
        )  # fmt: skip
        return
    if not logs:
        raise InputError("malta measure", "LOG", "none", "a log, or --plan")
    with progress_on(f"measuring from {', '.join(map(str, logs))}"):
        found = _measure(gains, controller, logs, uncertain, identified)
    files = []
    if out is not None:
        from malta.report.figures import measured_figure, save

        files.append(save(measured_figure(found), out))
    if as_json:
        from malta.cli.documents.others import measure_output

        print_document(measure_output(gains, found, files))
    else:
        _print_measurement(found, files)
    if found.refusal:
        raise CheckError(f"{found.source}: {found.refusal}")


def _require_no(given: Any, what: str) -> None:
    """Raise InputError where something was given that does not go together."""
    if given:
        raise InputError("malta measure", "", what, "one of them")


def _measure(
    gains: Path,
    controller: Controller,
    logs: list[Path],
    uncertain: list[str] | None,
    identified: Path | None,
) -> Measurement:
    """The measurement over the gain file's box, or over the intervals of an identified machine."""
    from malta.gains.contents import uncertainty_of
    from malta.gains.encodings import decode
    from malta.identification.data_file import read_identified
    from malta.identification.log_files import read_log
    from malta.identification.measure import measure as measure_loop
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures

    read = [read_log(log) for log in logs]
    if identified is None:
        own = uncertainty_of(decode(gains), published_figures(plant_of(controller.parameters).name))
        box = read_uncertainty(gains, uncertain, controller.parameters) if own or uncertain else {}
        return measure_loop(controller, *read, uncertainty=box)
    _require_no(uncertain, "--uncertain beside --identified")
    data = read_identified(identified)
    if type(data.parameters) is not type(controller.parameters):
        raise InputError(identified, "machine", "another machine", "that of the gain file")
    box = {name: data.joint * share for name, share in data.shares.items()}
    return measure_loop(controller, *read, parameters=data.parameters, uncertainty=box)


def _print_measurement(found: Measurement, files: list[Path]) -> None:
    """The tables, and in words what was compared with what."""
    from malta.model.parameters import box_words
    from malta.report.tables.experiments import measured_tables

    console = make_console()
    for table in measured_tables(found):
        console.print(table)
    how = "each line in each input" if found.experiments > 1 else "columns interpolated between their lines"
    box = box_words(found.box) or "no uncertainty"
    print_text(
        console, f"{len(found.w)} lines, {how}; predicted: {found.machines} machines, sampled, of {box}"
    )
    if not found.refusal and found.box:
        print_text(console, "as predicted: |S| and |T| are within the tube at all lines")
    print_written(console, files)


def _plan(
    gains: Path,
    controller: Controller,
    options: dict[str, Any],
    width: float | None,
    *,
    separate: bool,
    as_json: bool,
) -> None:
    """Print what will be flown, how, and what it will tell."""
    from malta.identification.measure import plan_measurement
    from malta.loops.loop import loop
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import excitation_tables, measurement_plan_table

    plant = plant_of(controller.parameters)
    found = plan_measurement(loop(plant, controller), width=width, separate=separate, **options)
    if as_json:
        from malta.cli.documents.others import measure_plan_output

        print_document(measure_plan_output(gains, found))
        return
    first, console = found.excitations[0], make_console()
    flights = f"{len(found.excitations)} flights" if separate else "one flight"
    print_text(
        console,
        f"{gains}: {flights}, {first.periods} periods of {first.signal.period:g} s each and one to settle",
    )
    console.print(excitation_tables(first, plant)[0])
    console.print(measurement_plan_table(found))
    size = f" --motion {1e6 * options['motion']:g}um" if "motion" in options else ""
    if options["band"] is not None:
        size += " --band {:g}..{:g}".format(*options["band"])
    for k in range(len(found.excitations)):
        shift = f" --shift {k}" if separate else ""
        rest = f"--periods {first.periods} --lines {options['lines']}{size}{shift}"
        console.print(f"malta excite {gains} {rest} --log flown{k or ''}.npz", soft_wrap=True)


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
    from malta.gains.file import content_of
    from malta.identification.commission import (
        JOURNAL,
        commission as commission_machine,
        noise_of_design,
        steps_of,
    )
    from malta.model.plants import plant_of
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
    noise = noise_of_design(done, controller)
    if noise:
        replace_files({folder / "noise.toml": noise.encode()})
        files.append(folder / "noise.toml")
    if as_json:
        from malta.cli.documents.others import CommissionOutput

        left = done.steps[len(done.entries) :]
        print_document(CommissionOutput.of(done, steps=done.entries, left=left, files=files))
    else:
        _print_commissioning(done, files)
    if not done.passed:
        last = done.entries[-1]
        bad = "; ".join(f"{one.name} is {one.found}" for one in last.findings if not one.holds)
        raise CheckError(f"step {last.name} failed: {last.refusal or bad}")


def _print_plan(steps: tuple[Check, ...]) -> None:
    """The checklist, as it stands before the first step."""
    from malta.report.tables.experiments import checklist_table

    make_console().print(checklist_table(steps))


def _print_commissioning(done: Commissioning, files: list[Path]) -> None:
    """The findings of all steps, the signature and the files."""
    from malta.report.tables.experiments import findings_table

    console = make_console()
    console.print(findings_table(done))
    if done.kept:
        print_text(console, f"kept from an earlier call: {' '.join(done.kept)}")
    print_text(console, f"signature {done.signature}")
    print_written(console, files)
