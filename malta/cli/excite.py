"""`malta excite`: an excitation of all axes, what it will do and find, and the log of its flight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.assignments import read_assignments
from malta.cli.inputs import change_machine, read_controller
from malta.cli.options import AsJson, Changes, GainFile, MachineFile, Seed
from malta.cli.output import make_console, print_document, print_text, print_written, progress_bar
from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from malta.identification.excite import ExcitationPlan
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller


def excite(
    gains: GainFile,
    force: Annotated[str | None, typer.Option(help="Largest force of each input, as 2N.")] = None,
    current: Annotated[
        str | None, typer.Option(help="Largest current beside that at rest, as 200mA. [10 % of its limit]")
    ] = None,
    motion: Annotated[str | None, typer.Option(help="Largest motion of any output, as 20um.")] = None,
    period: Annotated[float, typer.Option(help="Of the multisine [s].")] = 1.0,
    periods: Annotated[int, typer.Option(help="That are logged, after one in which the loop settles.")] = 10,
    band: Annotated[str, typer.Option(metavar="LOW..HIGH", help="Lowest and highest line [Hz].")] = "2..400",
    lines: Annotated[int, typer.Option(help="Of each input.")] = 12,
    parameters: Annotated[
        list[str] | None,
        typer.Option("--parameter", "-p", metavar="NAME", help="Whose accuracy is predicted. Repeatable."),
    ] = None,
    change: Changes = None,
    seed: Seed = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write one period of the forces at the law's samples (.csv)."),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Fly it on the simulated machine: its log, .csv, .npz or .mat."),
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
    from malta.loops.loop import loop
    from malta.model.data import plant_of
    from malta.report.tables.identification import excitation_tables

    controller = read_controller(gains, machine)
    plant = plant_of(controller.parameters)
    units = {"force": "N", "current": "A", "motion": "m"}
    given = {"force": force, "current": current, "motion": motion}
    sizes = {
        name: read_assignments(f"--{name}", [f"{name}={text}"], units)[name]
        for name, text in given.items()
        if text is not None
    }
    low, high = _band(band)
    plan = plan_excitation(
        loop(plant, controller), **sizes,
        period=period, periods=periods, band=(low, high), lines=lines, parameters=parameters or (),
        seed=seed or 0,
    )  # fmt: skip
    console, files = make_console(), []
    if out is not None:
        files.append(_write_period(out, plan, plant, controller.sample_time))
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
        from malta.cli.documents.identification import excite_output

        print_document(excite_output(gains, plan, files))
    else:
        print_written(console, files)


def _band(text: str) -> tuple[float, float]:
    """The ends of a band, Hz."""
    low, dots, high = text.partition("..")
    try:
        return float(low), float(high)
    except ValueError:
        raise InputError("--band", "", repr(text if dots else low), "LOW..HIGH in Hz, as 2..400") from None


def _write_period(path: Path, plan: ExcitationPlan, plant: Plant, Ts: float) -> Path:
    """Write one period of the excitation at the samples of the law."""
    import numpy as np

    from malta.files import replace_files

    if path.suffix != ".csv":
        raise InputError(path, "", f"suffix {path.suffix!r}", ".csv")
    t = Ts * np.arange(round(plan.signal.period / Ts))
    heading = ",".join(["t [s]", *(f"exc.{s.name} [{s.unit}]" for s in plant.inputs)])
    rows = "\n".join(
        ",".join(f"{x:.9g}" for x in row) for row in np.column_stack([t, plan.signal(t)]).tolist()
    )
    replace_files({path: f"{heading}\n{rows}\n".encode()})
    return path


def _fly(plan: ExcitationPlan, plant: Plant, controller: Controller, path: Path, seed: int | None) -> Path:
    """Fly an excitation and write its log. Raises CheckError when the flight ends early."""
    from malta.identification.log import log_of, write_log
    from malta.simulation.scenario import Scenario
    from malta.simulation.simulate import simulate

    scenario = Scenario.excited(plan.signal, plan.duration, seed=seed or 0)
    if plant.windings is None:
        scenario = scenario.replace(fidelity="force")
    with progress_bar("excited", insists=False) as progress:
        run = simulate(plant, controller, scenario, progress=progress)
    if not run.verdict.completed:
        raise CheckError(f"the excited machine: {run.verdict.name} at {run.verdict.time:.4g} s")
    return write_log(log_of(run), path)
