"""`malta identify`: parameters of a machine from a log, with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
    read_uncertainty,
    require_suffixes,
    verify_and_write,
)
from malta.cli.output import (
    make_console,
    print_document,
    print_text,
    print_written,
    progress_bar,
    progress_on,
)
from malta.errors import CheckError, InputError
from malta.files import PICTURES
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.identification.excite import ExcitationPlan
    from malta.model.plant import Plant, Signal
    from malta.proof.blocks.gain import Gain
    from malta.synthesis.controller import Controller

LogFile = Annotated[Path, typer.Argument(metavar="LOG", help="A log: .csv, .npz, .mat, .parquet or .dump.")]


def identify(
    gains: GainFile,
    log: LogFile,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            "-p",
            metavar="NAME",
            help="To identify: of the machine, or of its sensors' errors. Repeatable. [those that the log "
            "determines to 50 %, but for masses and lengths]",
        ),
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Weighed or measured otherwise, as m=0.36kg. Repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DATA", help="Write a data file, as robust-identified.toml."),
    ] = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Take outliers for missing (Student's likelihood in time).")
    ] = False,
    loaded: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="A second log, with a known mass on the machine: the mass comes out."
        ),
    ] = None,
    added: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What it adds to a parameter, as m=100g. Repeatable."),
    ] = None,
    drive: Annotated[
        bool, typer.Option("--drive", help="R, L and dead time of the drive too, from voltages in the log.")
    ] = False,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Identify parameters of the machine from a log under excitation, each with its 95 % interval.

    Maximum likelihood at the excited lines, from measured currents to measured outputs; feedback does not bias it. Then
    prediction errors in time, on the machine without linearization: both have to agree.
    A log that the machine's model does not explain is refused with exit code 1, and no file is written.
    Of one log masses are known, as forces and stiffness scale with them; with --loaded and --added they come out.

    \b
    Example:  malta identify design/gains/robust.json log.npz -o found.toml
    """
    from malta.identification.data_file import write_data
    from malta.identification.identify import GROUPS, identify as identify_parameters, weigh
    from malta.identification.log_files import read_log
    from malta.identification.response import units_of_model
    from malta.identification.windings import identify_windings
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import drive_table, identified_table, in_time_table, quality_table

    require_suffixes((out, (".toml",)))
    controller = read_controller(gains, machine)
    values = read_assignments("--known", known, units_of_model(plant_of(controller.parameters)))
    more = read_assignments("--added", added, units_of_model(plant_of(controller.parameters)))
    if (loaded is None) != (not more):
        raise InputError(
            "--loaded", "", "--loaded or --added alone", "both, as --loaded log2.npz --added m=100g"
        )
    if loaded is not None and robust:
        raise InputError("--robust", "", "two logs", "one log: two are estimated at the lines alone")
    with progress_on(f"identifying from {log}"):
        read = read_log(log, (*GROUPS, "u") if drive else GROUPS)
        windings = identify_windings(controller, read) if drive else None
        if loaded is not None:
            second = read_log(loaded, GROUPS)
            found = weigh(controller, read, second, more, parameters=parameters or (), known=values)
        else:
            found = identify_parameters(
                controller, read, parameters=parameters or (), known=values, robust=robust
            )
    files = []
    if out is not None and not found.refusal:
        files.append(write_data(found, out, gains=str(gains), known=values))
    if as_json:
        from malta.cli.documents.others import identify_output

        print_document(identify_output(gains, found, files, windings))
    else:
        console = make_console()
        console.print(identified_table(found))
        console.print(quality_table(found))
        if found.in_time is not None:
            console.print(in_time_table(found, found.in_time))
        if windings is not None:
            console.print(drive_table(windings))
        held = ", ".join(f"{name} = {value:.5g}" for name, value in found.held.items())
        print_text(console, f"taken as known, SI: {held or 'nothing'}")
        if found.dropped:
            print_text(console, f"act, but are not told by themselves: {' '.join(found.dropped)}")
        print_written(console, files)
    refusal = found.refusal or (windings.refusal if windings is not None else "")
    if refusal:
        raise CheckError(f"{log}: {refusal}")


# `malta excite`: an excitation of all axes, what it will do and find, and the log of its flight.


def excite(
    gains: GainFile,
    force: Annotated[
        str | None, typer.Option(metavar="QUANTITY", help="Largest force of each input, as 2N.")
    ] = None,
    current: Annotated[
        str | None,
        typer.Option(
            metavar="QUANTITY", help="Largest current beside that at rest, as 200mA. [10 % of its limit]"
        ),
    ] = None,
    motion: Annotated[
        str | None, typer.Option(metavar="QUANTITY", help="Largest motion of any output, as 20um.")
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Period of the multisine [s]. [two turns of the lowest line]"),
    ] = None,
    periods: Annotated[
        int, typer.Option(metavar="N", help="Periods that are logged, after one in which the loop settles.")
    ] = 10,
    band: Annotated[
        str | None,
        typer.Option(metavar="LOW..HIGH", help="Lowest and highest line [Hz]. [by the band of the loop]"),
    ] = None,
    lines: Annotated[int, typer.Option(metavar="N", help="Lines of each input.")] = 12,
    parameters: Annotated[
        list[str] | None,
        typer.Option("--parameter", "-p", metavar="NAME", help="Whose accuracy is predicted. Repeatable."),
    ] = None,
    change: Changes = None,
    seed: Seed = None,
    shift: Annotated[
        int,
        typer.Option(
            metavar="N", help="Inputs by which lines are dealt later; 0, 1, ... excite each line in each."
        ),
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write one period of the forces at the law's samples (.csv)."),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="Fly it on the simulated machine: its log: .csv, .npz, .mat, .parquet."
        ),
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Excite all axes at once, and say first what moves how far, what flows and what the log will tell.

    Each input has lines of its own (interleaved multisines of a low crest factor). The forces are added to the law's,
    whose filter knows them as sent. With --log they fly on the simulated machine, with --set as a machine that the gain
    file does not know.

    \b
    Example:  malta excite design/gains/robust.json --motion 20um --log log.npz
    """
    from malta.identification.excite import excite as plan_excitation
    from malta.identification.log_files import SUFFIXES
    from malta.loops.loop import loop
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import excitation_tables

    require_suffixes((out, (".csv",)), (log, SUFFIXES))
    controller = read_controller(gains, machine)
    plant = plant_of(controller.parameters)
    units = {"force": "N", "current": "A", "motion": "m"}
    given = {"force": force, "current": current, "motion": motion}
    sizes = {
        name: read_assignments(f"--{name}", [f"{name}={text}"], units)[name]
        for name, text in given.items()
        if text is not None
    }
    plan = plan_excitation(
        loop(plant, controller), **sizes,
        period=period, periods=periods, band=read_band(band), lines=lines, parameters=parameters or (),
        seed=seed or 0, shift=shift,
    )  # fmt: skip
    console, files = make_console(), []
    if out is not None:
        import numpy as np

        t = controller.sample_time * np.arange(round(plan.signal.period / controller.sample_time))
        forces = plan.signal(t)
        files.append(_write_forces(out, controller.sample_time, plant.inputs, forces))
    if not as_json:
        f, crest = plan.signal.frequencies, plan.signal.crest_factor
        print_text(
            console,
            f"{gains}: {len(f)} lines from {f[0]:g} to {f[-1]:g} Hz, crest factors {min(crest):.2f} to "
            f"{max(crest):.2f}, {plan.duration:g} s",
        )
        for table in excitation_tables(plan, plant):
            console.print(table)
    if log is not None:
        files.append(
            _fly(plan, plant_of(change_machine(controller.parameters, change)), controller, log, seed)
        )
    if as_json:
        from malta.cli.documents.others import ExciteOutput

        print_document(ExciteOutput.of(plan, gains=gains, files=files))
    else:
        print_written(console, files)


def read_band(text: str | None) -> tuple[float, float] | None:
    """The ends of a band, Hz; None for none. Raises InputError for another form than LOW..HIGH."""
    if text is None:
        return None
    low, dots, high = text.partition("..")
    try:
        return float(low), float(high)
    except ValueError:
        raise InputError("--band", "", repr(text if dots else low), "LOW..HIGH in Hz, as 2..400") from None


def _write_forces(path: Path, Ts: float, signals: Sequence[Signal], forces: FloatArray) -> Path:
    """Write forces beside the law's at its samples, a column for each name."""
    import numpy as np

    heading = ",".join(["t [s]", *(f"exc.{s.name} [{s.unit}]" for s in signals)])
    table = np.column_stack([Ts * np.arange(len(forces)), forces])
    rows = "\n".join(",".join(f"{x:.9g}" for x in row) for row in table.tolist())
    replace_files({path: f"{heading}\n{rows}\n".encode()})
    return path


def _fly(plan: ExcitationPlan, plant: Plant, controller: Controller, path: Path, seed: int | None) -> Path:
    """Fly an excitation and write its log. Raises CheckError when the flight ends early."""
    from malta.identification.log import log_of
    from malta.identification.log_files import write_log
    from malta.simulation.scenario import Scenario
    from malta.simulation.simulate import simulate

    scenario = Scenario.excited(plan.signal, plan.duration, seed=seed or 0)
    if plant.actuator.windings is None:
        scenario = scenario.replace(fidelity="force")
    with progress_bar("excited", insists=False) as progress:
        run = simulate(plant, controller, scenario, progress=progress)
    if not run.verdict.completed:
        raise CheckError(f"the excited machine: {run.verdict}")
    return write_log(log_of(run), path)


# `malta log`: what a log of a bench holds, and what is wrong with it.


def log(
    file: LogFile,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw it: a .png, .svg or .pdf file.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show a log: statistics of its signals, gaps, jitter, missing readings, stuck and clipped sensors, limits.

    \b
    Example:  malta log build/robust.npz --out build/log.png
    """
    from malta.identification.log_files import read_log
    from malta.report.tables.experiments import log_table

    require_suffixes((out, PICTURES))
    found = read_log(file)
    files = []
    if out is not None:
        from malta.report.figures import log_figure, save

        files.append(save(log_figure(found), out))
    if as_json:
        from malta.cli.documents.others import log_output

        print_document(log_output(found, files))
        return
    console, survey = make_console(), found.survey
    of = f"{found.machine or 'an unnamed machine'} under {found.controller or 'an unnamed law'}"
    length = (
        f"{found.samples} samples of {1e6 * found.sample_time:g} us, {found.samples * found.sample_time:g} s"
    )
    print_text(console, f"{file}: {of}, {length}")
    excited = (
        f"an excitation with a period of {found.period:g} s" if found.period else "no periodic excitation"
    )
    print_text(console, f"{excited}, jitter {1e6 * survey.jitter:.3g} us, {survey.gaps} gaps")
    console.print(log_table(found))
    for finding in survey.findings or ("nothing is missing, stuck, clipped or at a limit",):
        print_text(console, finding)
    print_written(console, files)


# `malta learn`: what the log of a stroke teaches about the next one.


def learn(
    gains: GainFile,
    log: Annotated[
        Path | None, typer.Argument(metavar="[LOG]", help="A log of a stroke: .csv, .npz, .mat or .parquet.")
    ] = None,
    parameter: Annotated[
        str, typer.Option(metavar="NAME", help="The force constant of the thrust. [found by its effect]")
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
    as_json: AsJson = False,
) -> None:
    """Learn the thrust of the drive from the log of one stroke, and write it into what the law believes.

    The new gain file commutates with the learned force constant, and its filter predicts with it: the next stroke needs
    no feedback to correct the thrust. With --next the thrust over time that was missing is written, which the next
    stroke is sent beside the law's; with --out too, that which the new gain file's own machine needs. With --v0 the log
    is of a slow stroke, and the thrust that holds the machine along it, against cogging and other loads, goes into the
    table v0(z) of the new gain file. --strokes learns the constant and the thrust over time on the simulated machine,
    with --set as another one, and proves by how much errors shrink over the box of the gain file.

    \b
    Example:  malta learn design/gains/robust.json build/stroke.npz --out build
              malta learn design/gains/robust.json build/slow.npz --v0 --out build
              malta learn design/gains/robust.json --strokes 6 --set K_D=4.68
    """
    controller = read_controller(gains, machine)
    if v0 and (strokes or parameter or following):
        other = "--strokes" if strokes else "--next" if following else "--parameter"
        raise InputError("learn", "--v0", f"--v0 and {other}", "one of them")
    if before and not following:
        raise InputError("learn", "--before", "--before alone", "--before LOG --next FILE")
    if (log is None) == (strokes == 0):
        raise InputError("learn", "LOG", "a log and --strokes" if log else "nothing", "a log, or --strokes N")
    if strokes:
        _learn_strokes(gains, controller, strokes, change, uncertain, out, as_json=as_json)
    elif log is not None and v0:
        _learn_v0(gains, controller, log, out, as_json=as_json)
    elif log is not None:
        logs = [*(before or ()), log]
        _learn_from(gains, controller, logs, parameter, following, out, as_json=as_json)


def _learn_from(
    gains: Path,
    controller: Controller,
    logs: list[Path],
    parameter: str,
    following: Path | None,
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    """Learn from the log of a stroke, the last one."""
    from malta.identification.learn import learn as learn_thrust
    from malta.identification.log_files import read_log
    from malta.identification.strokes import first_thrust, next_stroke
    from malta.model.plants import plant_of

    require_suffixes((following, (".csv",)))
    *earlier, log = logs
    read = read_log(log)
    found = learn_thrust(controller, read, parameter=parameter)
    files = _write_taught(found.controller, controller, gains, out, "its name: --parameter")
    if following is not None:
        plant, after = plant_of(controller.parameters), None
        for one in (*map(read_log, earlier), read):
            after = next_stroke(controller, one, before=after)
        thrust = after.thrust if after is not None and out is None else first_thrust(found.controller, read)
        sent = plant.inputs[plant.thrust_input :][:1], thrust[:, None]
        files.append(_write_forces(following, controller.sample_time, *sent))
    if as_json:
        from malta.cli.documents.others import LearnOutput

        print_document(LearnOutput.of(found, gains=gains, log=log, files=files))
        return
    console = make_console()
    half = 1.96 * found.deviation
    print_text(console, f"{log}: the stroke took {found.factor:.4f} +- {half:.4f} times the thrust expected")
    learned = f"{found.parameter}: {found.before:.5g} -> {found.after:.5g}, as the law believes it"
    alone = "no parameter scales the thrust alone: --parameter NAME learns one that scales other forces too"
    print_text(console, learned if found.parameter else alone)
    if following is not None and after is not None:
        print_text(
            console,
            f"the error, {1e6 * after.error:.3g} um rms, has {after.patterns} patterns above the noise of "
            f"{1e6 * after.noise:.3g} um: the next stroke is sent up to {abs(thrust).max():.3g} N too"
            + (f", which the machine of {found.controller.name} needs by itself" if out else ""),
        )
    print_written(console, files)


def _write_taught(
    taught: Controller, flown: Controller, gains: Path, out: Path | None, expected: str
) -> list[Path]:
    """Write a law with another force constant, if asked to. Raises InputError where none was learned."""
    if out is None:
        return []
    if taught is flown:
        raise InputError("learn", "--out", "no parameter that scales the thrust alone", expected)
    return verify_and_write(taught, gains, out)


def _learn_v0(gains: Path, controller: Controller, log: Path, out: Path | None, *, as_json: bool) -> None:
    """Learn v0(z) of the thrust from the log of a slow stroke."""
    from malta.identification.learn import learn_v0
    from malta.identification.log_files import read_log
    from malta.model.plants import plant_of

    found = learn_v0(controller, read_log(log))
    files = [] if out is None else verify_and_write(found.controller, gains, out)
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


def _learn_strokes(
    gains: Path,
    controller: Controller,
    strokes: int,
    change: list[str] | None,
    uncertain: list[str] | None,
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    """Fly strokes on the simulated machine, each taught by those before."""
    from malta.identification.convergence import contraction
    from malta.identification.strokes import learn_strokes
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import strokes_table

    plant = plant_of(change_machine(controller.parameters, change))
    with progress_on(f"{strokes} strokes"):
        found = learn_strokes(plant, controller, strokes=strokes)
    box = read_uncertainty(gains, uncertain, controller.parameters)
    with progress_on("proving that errors shrink"):
        shrinks = contraction(controller, box) if box else None
    files = _write_taught(
        found.controller, controller, gains, out, "no --out: the force constant is not learned"
    )
    if as_json:
        from malta.cli.documents.others import learned_strokes_output

        print_document(learned_strokes_output(gains, found, shrinks, files))
        return
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


# `malta replay`: the law of a gain file on the readings of a log.


def replay(gains: GainFile, log: LogFile, machine: MachineFile = None, as_json: AsJson = False) -> None:
    """Run a law on logged readings: does it command what was logged, and how large are its innovations?

    Commands that differ give exit code 1: another gain file flew, or another law. So do innovations that are larger, or
    less white, than those of the gain file's own machine on the same reference and excitation; the parameter that
    explains them is named. Of the .dump of exported C the same C computes the commands again, which have to agree to
    the bit.

    \b
    Example:  malta replay design/gains/robust.json build/stroke.npz
    """
    from malta.identification.dump import replay_dump
    from malta.identification.log_files import read_log
    from malta.identification.replay import replay_law
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import replay_table

    controller = read_controller(gains, machine)
    with progress_on(f"replaying {log}"):
        exact = replay_dump(controller, log) if log.suffix == ".dump" else None
    if exact is not None and not as_json:
        count = f"{exact.same} of {exact.samples} samples"
        print_text(make_console(), f"{log}: the exported C commands what is logged, to the bit, in {count}")
    if exact is not None and exact.first is not None:
        raise CheckError(
            f"{log}: from {exact.first:.6g} s on the exported C commands other bits: another export flew"
        )
    with progress_on(f"replaying {log}"):
        found = replay_law(controller, read_log(log), same=None if exact is None else True)
    if as_json:
        from malta.cli.documents.others import replay_output

        print_document(replay_output(gains, log, found, exact))
    else:
        console = make_console()
        console.print(replay_table(found, plant_of(controller.parameters)))
        same = "as logged, but for rounding" if found.same else "not those of the log"
        print_text(console, f"{log}: the commands of {controller.name} are {same}")
    if found.refusal:
        raise CheckError(f"{log}: {found.refusal}")
