"""`malta identify`: parameters of a machine from logs, with intervals."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.excitation import read_ends
from malta.cli.log_options import LogFiles, Reading, add_log_options
from malta.cli.options import (
    NUMBER,
    AsJson,
    GainFile,
    MachineFile,
    WholeTime,
    parameter_names,
    read_assignments,
    read_controller,
    require_suffixes,
)
from malta.cli.output import end_early, make_console, print_document, print_text, print_written, work_until
from malta.errors import CheckError, InputError
from malta.files import PICTURES
from malta.work import is_stopped

if TYPE_CHECKING:
    from malta.identification.realization import Realization
    from malta.synthesis.controller import Controller


@add_log_options
def identify(
    gains: GainFile,
    logs: LogFiles,
    reading: Reading,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            "-p",
            metavar="NAME",
            autocompletion=parameter_names,
            help="To identify: of the machine, or of its sensors' errors. Repeatable. [of the uncertain ones, "
            "else of all but masses and lengths, those that the log determines to 50 %]",
        ),
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="Weighed or measured, as m=0.36+-0.002kg (95 %). Repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DATA", help="Write a data file (.toml), or responses (.csv)."),
    ] = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Take outliers for missing (Student's t).")
    ] = False,
    loaded: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="A second log, with a known mass on it: that comes out."),
    ] = None,
    added: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What it adds to a parameter, as m=100g. Repeatable."),
    ] = None,
    drive: Annotated[
        bool, typer.Option("--drive", help="R, L and dead time of the drive, from voltages.")
    ] = False,
    fresh: Annotated[
        Path | None, typer.Option("--validate", metavar="LOG", help="A second log, to be predicted.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw responses, what is left, and S: .png or .svg.")
    ] = None,
    order: Annotated[
        str | None, typer.Option(metavar="N", help="A linear model alone: its number of states, or auto.")
    ] = None,
    record: Annotated[
        str | None, typer.Option(metavar="SPAN", help="Without an excitation: seconds 2..10 of it, or all.")
    ] = None,
    machine: MachineFile = None,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Identify parameters of the machine from a log under excitation, each with its 95 % interval.

    Maximum likelihood at the excited lines; feedback does not bias it. Prediction errors in time have to agree.
    What is known only so well widens the total intervals; imperfections of a bench may explain what parameters do not.
    A log that neither explains, or whose S is another one, is refused with exit code 1, and no file is written.
    Of one log masses are known; with --loaded and --added they come out.

    \b
    Example:  malta identify design/gains/robust.json log.npz -o found.toml
              malta identify design/gains/robust.json log.npz --order auto
    """
    from malta.identification.data_file import write_data
    from malta.identification.frequency_response import responses_of, write_responses
    from malta.identification.identify import GROUPS, identify as identify_parameters, weigh
    from malta.identification.imperfections import bench_units
    from malta.identification.log_files import read_log
    from malta.identification.records import identify_record
    from malta.identification.response import units_of_model
    from malta.identification.validation import validate
    from malta.identification.windings import identify_windings
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import (
        drive_table,
        explanation_table,
        identified_table,
        in_time_table,
        known_table,
        quality_table,
    )

    require_suffixes((out, (".csv",) if order else (".toml", ".csv")), (figure, PICTURES))
    alone = {"--record": record, "--loaded": loaded, "--robust": robust, "--drive": drive}
    for option, value in alone.items() if len(logs) > 1 else ():
        if value:
            raise InputError(option, "", f"{len(logs)} logs", "one log")
    log = ", ".join(map(str, logs))
    controller = read_controller(gains, machine)
    if order is not None:
        given = {"-p": parameters, "--known": known, "--added": added, "--figure": figure, **alone}
        for option in [option for option, value in given.items() if value][:1]:
            raise InputError("--order", "", f"{option} beside it", "one of them")
        with work_until(f"realizing from {log}", time):
            models = _realize(controller, order, logs, fresh, reading)
        _print_models(gains, models, out, as_json=as_json)
        return
    believed = plant_of(controller.parameters)
    values = read_known(known, units_of_model(believed) | bench_units(believed))
    more = read_assignments("--added", added, units_of_model(believed))
    if (loaded is None) != (not more):
        raise InputError(
            "--loaded", "", "--loaded or --added alone", "both, as --loaded log2.npz --added m=100g"
        )
    span = None if record is None else read_span("--record", record)
    for option, other in (("--loaded", loaded), ("--validate", fresh), ("--figure", figure)):
        if span is not None and other is not None:
            raise InputError("--record", "", f"{option} beside it", "one of them: both need an excitation")
    if loaded is not None and robust:
        raise InputError("--robust", "", "two logs", "one log: two are estimated at the lines alone")
    with work_until(f"identifying from {log}", time) as work:
        try:
            read, *others = [read_log(one, (*GROUPS, "u") if drive else GROUPS, **reading) for one in logs]
            windings = identify_windings(controller, read) if drive else None
            if span is not None:
                found = identify_record(
                    controller, read, parameters=parameters or (), known=values, part=span, robust=robust
                )
            elif loaded is not None:
                second = read_log(loaded, GROUPS, **reading)
                found = weigh(controller, read, second, more, parameters=parameters or (), known=values)
            else:
                box = _box_of(gains)
                found = identify_parameters(
                    controller,
                    [read, *others],
                    parameters=parameters or (),
                    box=box,
                    known=values,
                    robust=robust,
                )
            second_look = (
                None if fresh is None else validate(controller, found, read_log(fresh, GROUPS, **reading))
            )
        except CheckError as error:
            raise (
                CheckError(f"{log}: the time was up before a machine was found") if is_stopped() else error
            ) from None
        early = is_stopped()
    refusal = found.refusal or ("" if second_look is None else second_look.refusal)
    files = []
    if out is not None and not refusal and not early:
        files.append(
            write_data(found, out, gains=str(gains), known=values)
            if out.suffix.lower() == ".toml"
            else write_responses(responses_of(found), out)
        )
    if figure is not None:
        from malta.report.figures import identified_figure, save

        files.append(save(identified_figure(found), figure))
    if as_json:
        from malta.cli.documents.others import identify_output

        print_document(identify_output(gains, found, files, windings))
    else:
        console = make_console()
        print_text(console, f"{log}: {found.verdict}")
        if second_look is not None:
            print_text(console, f"{fresh}: {second_look.verdict}")
        console.print(identified_table(found))
        if found.explanation is not None and found.explanation.causes and found.chi2 > found.limit:
            console.print(explanation_table(found.explanation))
        console.print(quality_table(found))
        if found.in_time is not None:
            console.print(in_time_table(found, found.in_time))
        if windings is not None:
            console.print(drive_table(windings))
        if found.explanation is not None:
            console.print(known_table(found.explanation))
        if found.dropped:
            print_text(console, f"act, but are not told by themselves: {' '.join(found.dropped)}")
        print_written(console, files)
    if early:
        unwritten = "" if out is None else f"; {out} is not written"
        end_early(work.pressed, f"values and intervals are those of then{unwritten}")
        return
    refusal = refusal or (windings.refusal if windings is not None else "")
    if refusal:
        raise CheckError(f"{log}: {refusal}")


def _realize(
    controller: Controller, order: str, logs: list[Path], fresh: Path | None, reading: Reading
) -> list[Realization]:
    """A linear model of logs alone, and the same with its figures on a fresh log. Raises InputError for its order."""
    from malta.identification.log import in_order
    from malta.identification.log_files import read_log
    from malta.identification.realization import realize
    from malta.model.plants import plant_of

    if not (order == "auto" or order.isdecimal()):
        raise InputError("--order", "", repr(order), "a number of states, or auto")
    plant, groups = plant_of(controller.parameters), ("y", "v", "excitation")
    read = [in_order(read_log(one, groups, **reading), plant) for one in (*logs, *([fresh] if fresh else []))]
    found = realize(read[: len(logs)], None if order == "auto" else int(order))
    return [found, *(found.validate(log) for log in read[len(logs) :])]


def _print_models(gains: Path, found: list[Realization], out: Path | None, *, as_json: bool) -> None:
    """Print a model of logs alone, and write its responses. Raises CheckError where the fresh log refuses it."""
    from malta.cli.documents.others import RealizeOutput
    from malta.identification.frequency_response import write_responses

    model, fresh = found[0], found[1] if len(found) > 1 else None
    refusal, fit = ("", None) if fresh is None else (fresh.refusal, fresh.fit)
    files = [] if out is None or refusal else [write_responses(model.responses(), out)]
    if as_json:
        print_document(RealizeOutput.of(model, gains=gains, fresh_fit=fit, refusal=refusal, files=files))
    else:
        console = make_console()
        for one in found:
            console.print(str(one), soft_wrap=True)
        print_written(console, files)
    if refusal:
        raise CheckError(refusal)


def read_span(option: str, text: str) -> tuple[float, float]:
    """Read a span of seconds. Raises InputError for another form than FROM..UNTIL or all.

    >>> read_span("--record", "2..10"), read_span("--record", "all")
    ((2.0, 10.0), (0.0, inf))
    """
    if text == "all":
        return 0.0, math.inf
    expected = "FROM..UNTIL in s, as 2..10, or all"
    begin, end = read_ends(option, text, expected)
    if not 0 <= begin < end:
        raise InputError(option, "", repr(text), expected)
    return begin, end


def _box_of(gains: Path) -> dict[str, float]:
    """The uncertain parameters of a gain file with their shares; none where it names none."""
    from malta.gains.contents import uncertainty_of
    from malta.gains.encodings import decode

    return uncertainty_of(decode(gains), None)


def read_known(texts: list[str] | None, units: Mapping[str, str]) -> dict[str, float | tuple[float, float]]:
    """Read `NAME=VALUE`, or `NAME=VALUE+-HALF` with half of a 95 % interval, as numbers in SI.

    Raises InputError as `read_assignments`, and for a half that is below 0.

    >>> read_known(["m=0.36+-0.002kg", "l_B=45mm"], {"m": "kg", "l_B": "m"})
    {'m': (0.36, 0.002), 'l_B': 0.045}
    """
    parts = [text.replace("±", "+-").partition("+-") for text in texts or ()]
    names = [value.partition("=")[0].strip() for value, _, _ in parts]
    unit = [re.sub(NUMBER, r"\2", half.strip()) for _, _, half in parts]
    plain = r"[-+.\deE]+"  # a value whose unit is that of its half
    whole = [
        v + u if re.fullmatch(plain, v.partition("=")[2].strip()) else v
        for (v, _, _), u in zip(parts, unit, strict=True)
    ]
    values = read_assignments("--known", whole, units)
    halves = read_assignments(
        "--known", [f"{n}={half}" for n, (_, sign, half) in zip(names, parts, strict=True) if sign], units
    )
    for name, half in halves.items():
        if half < 0:
            raise InputError("--known", name, f"+-{half:g}", "half of an interval, at least 0")
    return {name: (value, halves[name]) if name in halves else value for name, value in values.items()}
