"""`malta learn`: what the log of a stroke teaches about the next one."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.excitation import write_forces
from malta.cli.log_options import Reading, add_log_options
from malta.cli.options import (
    AsJson,
    Changes,
    GainFile,
    MachineFile,
    Uncertain,
    WholeTime,
    change_machine,
    read_controller,
    read_uncertainty,
    require_suffixes,
    verify_and_write,
)
from malta.cli.output import (
    end_early,
    make_console,
    print_document,
    print_text,
    print_written,
    require_whole,
    work_until,
)
from malta.errors import InputError
from malta.work import WorkUp, is_stopped

if TYPE_CHECKING:
    from malta.identification.log import Log
    from malta.proof.blocks.gain import Gain
    from malta.synthesis.controller import Controller


@add_log_options
def learn(
    gains: GainFile,
    reading: Reading,
    log: Annotated[
        Path | None, typer.Argument(metavar="[LOG]", help="A log of a stroke: .csv, .npz, .mat or .parquet.")
    ] = None,
    parameter: Annotated[
        str, typer.Option(metavar="NAME", help="The thrust's force constant. [by its effect]")
    ] = "",
    following: Annotated[
        Path | None,
        typer.Option(
            "--next", metavar="FILE", help="Write the thrust that the next stroke is sent too (.csv)."
        ),
    ] = None,
    before: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG",
            help="Log of an earlier stroke under the same gain file, oldest first: --next weighs by it too.",
        ),
    ] = None,
    v0: Annotated[
        bool, typer.Option("--v0", help="Learn v0(z), what holds the machine, from the log of a slow stroke.")
    ] = False,
    strokes: Annotated[
        int,
        typer.Option(
            metavar="N", help="Fly so many strokes of the simulated machine, each taught by the last."
        ),
    ] = 0,
    change: Changes = None,
    uncertain: Uncertain = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write NAME_learned as .json, .npz and .mat.")
    ] = None,
    machine: MachineFile = None,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Learn the thrust of the drive from the log of one stroke, and write it into what the law believes.

    The law then commutates and predicts with it. With --next the thrust over time that was missing is written, which
    the next stroke is sent beside the law's; with --out too, that which the new gain file's own machine needs. With
    --v0 the log is of a slow stroke, and the thrust that holds the machine along it goes into the table v0(z).
    --strokes learns both on the simulated machine, with --set as another one, and proves by how much errors shrink
    over the box of the gain file.

    \b
    Example:  malta learn design/gains/robust.json build/stroke.npz --out build
              malta learn design/gains/robust.json build/slow.npz --v0 --out build
              malta learn design/gains/robust.json --strokes 6 --set K_D=4.68
    """
    from malta.identification.log_files import read_log

    controller = read_controller(gains, machine)
    if v0 and (strokes or parameter or following):
        other = "--strokes" if strokes else "--next" if following else "--parameter"
        raise InputError("learn", "--v0", f"--v0 and {other}", "one of them")
    if before and not following:
        raise InputError("learn", "--before", "--before alone", "--before LOG --next FILE")
    if (log is None) == (strokes == 0):
        raise InputError("learn", "LOG", "a log and --strokes" if log else "nothing", "a log, or --strokes N")
    if strokes:
        _learn_strokes(gains, controller, strokes, change, uncertain, out, time, as_json=as_json)
        return
    assert log is not None
    require_suffixes((following, (".csv",)))
    with work_until(f"learning from {log}", time) as work:
        logs = [read_log(one, **reading) for one in (*(before or ()), log)]
        show = (
            _learn_v0(gains, controller, logs[-1], out)
            if v0
            else _learn_from(gains, controller, logs, parameter, following, out)
        )
    show(as_json)
    require_whole(work)


Show = Callable[[bool], None]  # prints what was learned: as a JSON document, or in words


def _learn_from(
    gains: Path,
    controller: Controller,
    logs: list[Log],
    parameter: str,
    following: Path | None,
    out: Path | None,
) -> Show:
    """Learn from the log of a stroke, the last one."""
    from malta.identification.learn import learn as learn_thrust
    from malta.identification.strokes import first_thrust, next_stroke
    from malta.model.plants import plant_of

    *earlier, read = logs
    log = Path(read.source)
    found = learn_thrust(controller, read, parameter=parameter)
    files = _write_taught(found.controller, controller, gains, out, "its name: --parameter")
    if following is not None:
        plant, after = plant_of(controller.parameters), None
        for one in (*earlier, read):
            after = next_stroke(controller, one, before=after)
        thrust = after.thrust if after is not None and out is None else first_thrust(found.controller, read)
        sent = plant.inputs[plant.thrust_input :][:1], thrust[:, None]
        files.append(write_forces(following, controller.sample_time, *sent))

    def show(as_json: bool) -> None:
        if as_json:
            from malta.cli.documents.others import LearnOutput

            print_document(LearnOutput.of(found, gains=gains, log=log, files=files))
            return
        console = make_console()
        parts = f"{1.96 * found.deviation:.2g} by noise, {found.by_load:.2g} by up to {found.load:.2g} N that v0 lacks"
        took = f"{found.factor:.4f} +- {found.half:.2g} times the thrust expected ({parts})"
        print_text(console, f"{log}: the stroke took {took}")
        if found.limits:
            print_text(console, found.limits)
        value = f"{found.before:.5g} -> {found.after:.5g} +- {found.half_after:.2g}"
        learned = f"{found.parameter}: {value} with mass and gains of sensors as uncertain as usual"
        alone = (
            "no parameter scales the thrust alone: --parameter NAME learns one that scales other forces too"
        )
        print_text(console, learned if found.parameter else alone)
        if following is not None and after is not None:
            print_text(
                console,
                f"the error, {1e6 * after.error:.3g} um rms, has {after.patterns} patterns above the noise of "
                f"{1e6 * after.noise:.3g} um: the next stroke is sent up to {abs(thrust).max():.3g} N too"
                + (f", which the machine of {found.controller.name} needs by itself" if out else ""),
            )
        print_written(console, files)

    return show


def _write_taught(
    taught: Controller, flown: Controller, gains: Path, out: Path | None, expected: str
) -> list[Path]:
    """Write a law with another force constant, if asked to. Raises InputError where none was learned."""
    if out is None:
        return []
    if taught is flown:
        raise InputError("learn", "--out", "no parameter that scales the thrust alone", expected)
    return verify_and_write(taught, gains, out)


def _learn_v0(gains: Path, controller: Controller, read: Log, out: Path | None) -> Show:
    """Learn v0(z) of the thrust from the log of a slow stroke."""
    from malta.identification.learn import learn_v0
    from malta.model.plants import plant_of

    found, log = learn_v0(controller, read), Path(read.source)
    files = [] if out is None else verify_and_write(found.controller, gains, out)

    def show(as_json: bool) -> None:
        if as_json:
            from malta.cli.documents.others import LearnedV0Output

            print_document(LearnedV0Output.of(found, gains=gains, log=log, files=files))
            return
        console, plant = make_console(), plant_of(controller.parameters)
        low, high = 1e3 * found.z[0], 1e3 * found.z[-1]
        print_text(
            console,
            f"{log}: v0({plant.stroke.name}) of {plant.stroke.thrust} from {low:.3g} to {high:.3g} mm changes by "
            f"{found.change.min():.3g} to {found.change.max():.3g} N, each +- {1.96 * found.deviation.max():.2g} N",
        )
        print_written(console, files)

    return show


def _learn_strokes(
    gains: Path,
    controller: Controller,
    strokes: int,
    change: list[str] | None,
    uncertain: list[str] | None,
    out: Path | None,
    time: float | None,
    *,
    as_json: bool,
) -> None:
    """Fly strokes on the simulated machine, each taught by those before."""
    from malta.identification.convergence import contraction
    from malta.identification.strokes import learn_strokes
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import strokes_table

    plant = plant_of(change_machine(controller.parameters, change))
    box = read_uncertainty(gains, uncertain, controller.parameters)
    shrinks = None
    with work_until(f"{strokes} strokes", time) as work:
        found = learn_strokes(plant, controller, strokes=strokes, progress=work.report)
        work.step("proving that errors shrink")
        with suppress(WorkUp):
            shrinks = contraction(controller, box) if box and not is_stopped() else None
    files = _write_taught(
        found.controller, controller, gains, out, "no --out: the force constant is not learned"
    )
    if as_json:
        from malta.cli.documents.others import learned_strokes_output

        print_document(learned_strokes_output(gains, found, shrinks, files))
    else:
        console = make_console()
        console.print(strokes_table(found))
        print_text(
            console,
            f"the next stroke would be sent up to {abs(found.thrust).max():.3g} N beside the law's thrust, and without "
            f"noise of the sensors its largest axial error would be {1e6 * found.without_noise[-1]:.3g} um",
        )
        if shrinks is not None:
            print_text(console, _proven_contraction(shrinks))
        print_written(console, files)
    if len(found.axial_error) < strokes:
        end_early(work.pressed, f"{len(found.axial_error)} of {strokes} strokes were flown")
    require_whole(work)


def _proven_contraction(found: Gain) -> str:
    """By how much errors shrink over the box, in words."""
    if found.upper is None:
        return f"that errors shrink over the box is not proven: {found.reason}"
    at = ", ".join(f"{name} = {value:.4g}" for name, value in found.witness.items())
    left = f"a gain of 0.8 leaves at most {found.proven.percent()} of an error that thrust can make"
    if found.upper <= 1:
        left += ", and smaller gains of some patterns let the error, weighted by them, not grow"
    verdict = f"proven over the box: {left}" if found.upper < 1 else "errors may grow within the box"
    return (
        f"{verdict}; found: {found.reached.percent()} at {found.frequency / (2 * math.pi):.3g} Hz with {at}. Not "
        "covered: loads along the stroke and saturation (the loop is linear), noise that differs from stroke to "
        "stroke, and responses that outlast the log"
    )
