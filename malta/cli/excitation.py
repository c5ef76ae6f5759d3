"""`malta excite`: an excitation of all axes, what it will do and find, and the log of its flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import (
    AsJson,
    Changes,
    GainFile,
    MachineFile,
    Seed,
    WholeTime,
    change_machine,
    parameter_names,
    read_assignments,
    read_controller,
    require_suffixes,
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
from malta.errors import CheckError, InputError
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.identification.excite import ExcitationPlan
    from malta.model.plant import Plant, Signal
    from malta.simulation.trajectory import Trajectory
    from malta.synthesis.controller import Controller


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
        typer.Option(
            "--parameter",
            "-p",
            metavar="NAME",
            autocompletion=parameter_names,
            help="Whose accuracy is predicted. Repeatable.",
        ),
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
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Excite all axes at once, and say first what moves how far, what flows and what the log will tell.

    Each input has lines of its own (interleaved multisines of a low crest factor). The forces are added to the law's,
    whose filter knows them as sent. With --log they fly on the simulated machine, with --set as a machine that the gain
    file does not know.

    \b
    Example:  malta excite design/gains/robust.json --motion 20um --log log.npz
    """
    from malta.identification.excite import excite as plan_excitation, motion_unit
    from malta.identification.log_files import SUFFIXES
    from malta.loops.loop import loop
    from malta.model.plants import plant_of
    from malta.report.tables.experiments import excitation_tables

    require_suffixes((out, (".csv",)), (log, SUFFIXES))
    controller = read_controller(gains, machine)
    plant = plant_of(controller.parameters)
    units = {"force": "N", "current": "A", "motion": "m" if motion is None else motion_unit(plant)}
    given = {"force": force, "current": current, "motion": motion}
    sizes = {
        name: read_assignments(f"--{name}", [f"{name}={text}"], units)[name]
        for name, text in given.items()
        if text is not None
    }
    console, files, run = make_console(), list[Path](), None
    with work_until("excite", time) as work:
        work.step("plan")
        plan = plan_excitation(
            loop(plant, controller), **sizes,
            period=period, periods=periods, band=read_band(band), lines=lines, parameters=parameters or (),
            seed=seed or 0, shift=shift,
        )  # fmt: skip
        if log is not None:
            work.step("flight")
            machine_flown = plant_of(change_machine(controller.parameters, change))
            run = _fly(plan, machine_flown, controller, seed, work.report)
    if out is not None:
        import numpy as np

        t = controller.sample_time * np.arange(round(plan.signal.period / controller.sample_time))
        forces = plan.signal(t)
        files.append(write_forces(out, controller.sample_time, plant.inputs, forces))
    if not as_json:
        f, crest = plan.signal.frequencies, plan.signal.crest_factor
        print_text(
            console,
            f"{gains}: {len(f)} lines from {f[0]:g} to {f[-1]:g} Hz, crest factors {min(crest):.2f} to "
            f"{max(crest):.2f}, {plan.duration:g} s",
        )
        for table in excitation_tables(plan, plant):
            console.print(table)
    early = ""
    if log is not None and run is not None:
        written, early = _write_flight(log, run, plan)
        files += written
    if as_json:
        from malta.cli.documents.others import ExciteOutput

        print_document(ExciteOutput.of(plan, gains=gains, files=files))
    else:
        print_written(console, files)
    if early:
        end_early(work.pressed, early)
    require_whole(work)


def read_band(text: str | None) -> tuple[float, float] | None:
    """The ends of a band, Hz; None for none. Raises InputError for another form than LOW..HIGH."""
    return None if text is None else read_ends("--band", text, "LOW..HIGH in Hz, as 2..400")


def read_ends(option: str, text: str, expected: str) -> tuple[float, float]:
    """Read two numbers as "2..400". Raises InputError for another form."""
    low, _, high = text.partition("..")
    try:
        return float(low), float(high)
    except ValueError:
        raise InputError(option, "", repr(text), expected) from None


def write_forces(path: Path, Ts: float, signals: Sequence[Signal], forces: FloatArray) -> Path:
    """Write forces beside the law's at its samples, a column for each name."""
    import numpy as np

    heading = ",".join(["t [s]", *(f"exc.{s.name} [{s.unit}]" for s in signals)])
    table = np.column_stack([Ts * np.arange(len(forces)), forces])
    rows = "\n".join(",".join(f"{x:.9g}" for x in row) for row in table.tolist())
    replace_files({path: f"{heading}\n{rows}\n".encode()})
    return path


def _fly(
    plan: ExcitationPlan,
    plant: Plant,
    controller: Controller,
    seed: int | None,
    progress: Callable[[float], None],
) -> Trajectory:
    """Fly an excitation. Raises CheckError when the machine ends the flight."""
    from malta.simulation.experiments import end_in_time
    from malta.simulation.scenario import Scenario
    from malta.simulation.simulate import simulate

    scenario = Scenario.excited(plan.signal, plan.duration, seed=seed or 0)
    if plant.actuator.windings is None:
        scenario = scenario.replace(fidelity="force")
    run = simulate(plant, controller, scenario, progress=end_in_time(progress))
    if not run.verdict.completed and run.verdict.name != "interrupted":
        raise CheckError(f"the excited machine: {run.verdict}")
    return run


def _write_flight(path: Path, run: Trajectory, plan: ExcitationPlan) -> tuple[list[Path], str]:
    """Write the log of an excitation, of one that was cut short if a period after the first was flown; and say so."""
    from malta.identification.log import log_of
    from malta.identification.log_files import write_log

    if run.verdict.completed:
        return [write_log(log_of(run), path)], ""
    whole = int(len(run.t) * run.controller.sample_time / plan.signal.period + 1e-9) - 1
    end = f"the flight ended at {run.verdict.time:.4g} s"
    if whole < 1:
        return [], f"{end}, and {path} is not written"
    return [write_log(log_of(run), path)], f"{end}, and {path} has {whole} of {plan.periods} periods"
