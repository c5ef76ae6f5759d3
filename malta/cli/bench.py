"""`malta measure` and `malta commission`: what a bench shows of the machine and its loop.

`malta measure`: the loop as it is measured, with bands, beside what is predicted; or the plan to measure it.
`malta commission`: the checklist of the first day, on the simulated machine or from a bench's logs.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from malta.cli.excitation import read_band
from malta.cli.log_options import Reading, add_log_options
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
from malta.units import FINE_UNITS, in_unit
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.firmware.export import Until
    from malta.firmware.signals import Target
    from malta.firmware.xcp_master import XcpMaster
    from malta.identification.commission import Check, Commissioning
    from malta.identification.log import Log
    from malta.identification.measure import Measurement
    from malta.synthesis.controller import Controller

PLAN = "Plan"  # a panel of the help


@add_log_options
def measure(
    gains: GainFile,
    reading: Reading,
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
    response: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A response of an analyser (.csv) in place of logs.")
    ] = None,
    of: Annotated[
        str,
        typer.Option(metavar="NAME", help="Which one it is, as 'S x1' or 'SP x1/f'. [as its columns say]"),
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw it (.png, .svg, .pdf), or write all responses (.csv)."),
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
    from malta.identification.log_files import read_log

    require_suffixes((out, (*PICTURES, ".csv")))
    controller = read_controller(gains, machine)
    if response is not None:
        _require_no(logs or plan or out, "--response beside a log, --plan or --out")
        _compare(gains, controller, response, of, uncertain, identified, as_json=as_json)
        return
    _require_no(of, "--of without --response")
    if plan:
        _require_no(logs, "a log beside --plan")
        sizes = {} if motion is None else _read_motion(motion, controller)
        wide = None if width is None else read_assignments("--width", [f"width={width}"], {"width": "1"})
        _plan(
            gains, controller, sizes | {"band": read_band(band), "lines": lines},
            None if wide is None else wide["width"], separate=separate, as_json=as_json,
        )  # fmt: skip
        return
    if not logs:
        raise InputError("malta measure", "LOG", "none", "a log, or --plan")
    with progress_on(f"measuring from {', '.join(map(str, logs))}"):
        read = [read_log(log, **reading) for log in logs]
        found = _measure(gains, controller, read, uncertain, identified)
    files = []
    if out is not None and out.suffix == ".csv":
        from malta.identification.frequency_response import responses_of, write_responses

        files.append(write_responses(responses_of(found), out))
    elif out is not None:
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
    gains: Path, controller: Controller, read: list[Log], uncertain: list[str] | None, identified: Path | None
) -> Measurement:
    """The measurement over the gain file's box, or over the intervals of an identified machine."""
    from malta.identification.measure import measure as measure_loop

    parameters, box = _machine_and_box(gains, controller, uncertain, identified)
    return measure_loop(controller, *read, parameters=parameters, uncertainty=box)


def _machine_and_box(
    gains: Path, controller: Controller, uncertain: list[str] | None, identified: Path | None
) -> tuple[Any, dict[str, float]]:
    """The machine's parameters, None for the gain file's own, and the box: the gain file's, or the intervals."""
    from malta.gains.contents import uncertainty_of
    from malta.gains.encodings import decode
    from malta.identification.data_file import read_identified
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures

    if identified is None:
        own = uncertainty_of(decode(gains), published_figures(plant_of(controller.parameters).name))
        return None, read_uncertainty(gains, uncertain, controller.parameters) if own or uncertain else {}
    _require_no(uncertain, "--uncertain beside --identified")
    data = read_identified(identified)
    if type(data.parameters) is not type(controller.parameters):
        raise InputError(identified, "machine", "another machine", "that of the gain file")
    return data.parameters, {name: data.joint * share for name, share in data.shares.items()}


def _compare(
    gains: Path,
    controller: Controller,
    path: Path,
    of: str,
    uncertain: list[str] | None,
    identified: Path | None,
    *,
    as_json: bool,
) -> None:
    """Compare a response of an analyser with the machine under its law, and say where it misses."""
    from malta.identification.frequency_response import compare_response, read_response
    from malta.report.tables.experiments import response_table

    parameters, box = _machine_and_box(gains, controller, uncertain, identified)
    read = read_response(path, of)
    found = compare_response(controller, read, of, parameters=parameters, uncertainty=box)
    if as_json:
        from malta.cli.documents.others import response_output

        print_document(response_output(gains, path, found))
    else:
        console = make_console()
        console.print(response_table(found))
        tube = f"{found.machines} machines, sampled" if found.machines > 1 else "the machine"
        print_text(
            console, f"{path}: {len(read.w)} frequencies; predicted: {tube}. An analyser's file has no bands"
        )
    if found.refusal:
        raise CheckError(f"{path}: {found.refusal}")


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


def _read_motion(text: str, controller: Controller) -> dict[str, float]:
    """The option of `malta.excite` that `--motion` gives, in the unit of what moves."""
    from malta.identification.excite import motion_unit
    from malta.model.plants import plant_of

    unit = motion_unit(plant_of(controller.parameters))
    return read_assignments("--motion", [f"motion={text}"], {"motion": unit})


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
    from malta.identification.excite import motion_unit
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
    size = ""
    if "motion" in options:
        unit = motion_unit(plant)
        fine, largest = FINE_UNITS.get(unit, unit), options["motion"]
        size = f" --motion {quote(f'{in_unit(largest, fine):g}{fine}')}"
    if options["band"] is not None:
        size += " --band {:g}..{:g}".format(*options["band"])
    for k in range(len(found.excitations)):
        shift = f" --shift {k}" if separate else ""
        rest = f"--periods {first.periods} --lines {options['lines']}{size}{shift}"
        console.print(f"malta excite {gains} {rest} --log flown{k or ''}.npz", soft_wrap=True)


@add_log_options
def commission(
    gains: GainFile,
    reading: Reading,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Logs, journal and page. [build/commission/NAME]")
    ] = None,
    logs: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="A bench's logs, STEP.npz, .csv or .mat, are judged."),
    ] = None,
    step: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="This step alone; again for others.")
    ] = None,
    skip: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Leave this step out; again for others.")
    ] = None,
    wiring: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS:PORT", help="What the C of --wiring --xcp has found, by its XCP slave."
        ),
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
    from malta.report.page.binder import binder_page, binder_text, step_pictures

    controller = read_controller(gains, machine)
    if wiring is not None:
        if plan or logs or step or skip or out or as_json:
            raise InputError("--wiring", "", "other options beside it", "--wiring ADDRESS:PORT alone")
        _print_wiring(controller, wiring)
        return
    plant = plant_of(controller.parameters)
    box = content_of(gains)[0].uncertainty or {}
    steps = steps_of(plant, box)
    if plan:
        _print_plan(steps, _wiring_export(controller))
        return
    folder = out or Path("build", "commission", controller.name)
    done = commission_machine(
        gains, controller, folder,
        truth=plant_of(change_machine(controller.parameters, change)), errors=read_sensor_errors(sensor, plant),
        logs=logs, reading=reading, steps=steps, only=step or (), skip=skip or (), seed=seed or 0,
        progress=lambda name: print_note(f"step {name}"),
    )  # fmt: skip
    page, text = folder / "binder.html", folder / "binder.txt"
    with progress_on("drawing what was logged"):
        drawn = binder_page(done, step_pictures(done, controller, box, reading if logs is not None else None))
    replace_files({page: drawn.content, text: binder_text(done).encode()})
    files = [Path(entry.log) for entry in done.entries if entry.sha256 and logs is None]
    files += [folder / JOURNAL, page, text]
    noise = noise_of_design(done, controller)
    if noise:
        replace_files({folder / "noise.toml": noise.encode()})
        files.append(folder / "noise.toml")
    if as_json:
        from malta.cli.documents.others import CommissionOutput

        print_document(CommissionOutput.of(done, steps=done.entries, left=done.left, files=files))
    else:
        _print_commissioning(done, files)
    last = done.failed
    if last is not None:
        bad = "; ".join(f"{one.name} is {one.found}" for one in last.findings if not one.holds)
        raise CheckError(f"step {last.name} failed: {last.refusal or bad}")


def _print_wiring(controller: Controller, where: str) -> None:
    """What a supervisor has found of its wiring. Raises CheckError for a mistake, and where it was not tried."""
    from malta.firmware.wiring_words import wiring_sentences
    from malta.firmware.xcp_master import xcp_master

    with xcp_master(where) as master:
        t, found = _read_wiring(controller, where, master)
    if found["wired"] == 0 or not any(found["shows"]):
        raise CheckError(f"{where}: the wiring was not tried; set wired to 0 and request a start")
    said = wiring_sentences(t, found)
    if said:
        raise CheckError(f"{where}: " + "; ".join(said))
    print_text(
        make_console(), f"{where}: sensors, coils, current sensors and commutation are as the law believes"
    )


def _read_wiring(controller: Controller, where: str, master: XcpMaster) -> tuple[Target, dict[str, Any]]:
    """What was exported, and what its supervisor has found: down to duty cycles, or else to currents.

    Raises InputError for a slave of another law, and for one that does not try its wiring.
    """
    from malta.firmware.ctext import c_name
    from malta.firmware.export import target_of
    from malta.firmware.xcp_master import read_wiring

    if master.law != c_name(controller.name):
        raise InputError(where, "law", master.law, f"{c_name(controller.name)}, that of the gain file")
    depths: tuple[Until | None, ...] = (None, "currents")
    for until in depths:
        t = replace(target_of(controller, master.precision, until), tunable=True, wiring=True)
        with suppress(InputError):
            return t, read_wiring(master, t)
    raise InputError(where, "", "no results of a wiring", "the slave of an export with --wiring")


def _wiring_export(controller: Controller) -> str:
    """Options of an export that tries the wiring of this machine; "" where none can."""
    from malta.firmware.export import target_of
    from malta.firmware.wiring import wiring_table

    choices: tuple[tuple[Until | None, str], ...] = (
        (None, "--wiring"),
        ("currents", "--wiring --until currents"),
    )
    for until, words in choices:
        with suppress(InputError):
            wiring_table(replace(target_of(controller, "double", until), wiring=True))
            return words
    return ""


def _print_plan(steps: tuple[Check, ...], tries: str) -> None:
    """The checklist, as it stands before the first step, and which export can try its wiring, if any."""
    from malta.report.tables.experiments import checklist_table

    console = make_console()
    console.print(checklist_table(steps))
    if not tries:
        return
    before = (
        f"Before the first lift-off an export with {tries} tries sensors, coils and commutation at low force;"
    )
    print_text(console, f"{before} --wiring ADDRESS:PORT says here what it has found.")


def _print_commissioning(done: Commissioning, files: list[Path]) -> None:
    """The findings of all steps, the signature and the files."""
    from malta.report.tables.experiments import findings_table

    console = make_console()
    console.print(findings_table(done))
    if done.kept:
        print_text(console, f"kept from an earlier call: {' '.join(done.kept)}")
    print_text(console, f"signature {done.signature}")
    print_written(console, files)
