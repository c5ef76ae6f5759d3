"""`malta simulate`: an experiment on the nonlinear machine with a gain file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from malta.cli.options import (
    MACHINE,
    RUN,
    SCENARIOS,
    AsJson,
    Changes,
    GainFile,
    MachineFile,
    OwnOptions,
    Seed,
    Yes,
    change_machine,
    offer,
    print_scenarios,
    read_controller,
    read_options,
    read_sensor_errors,
    scenarios,
    verify_and_write,
)
from malta.cli.output import (
    limit_time,
    make_console,
    print_document,
    print_note,
    print_text,
    print_written,
    progress_bar,
)
from malta.errors import CheckError, InputError
from malta.files import require_suffix

if TYPE_CHECKING:
    from malta.firmware.flight import SignalDifference
    from malta.firmware.program import Precision
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller


# What `--controller c` adds to `malta simulate`: the exported C flies, beside the simulation's law and in float.


CONTROLLERS = ("own", "c")


def require_controller(name: str, engine: str) -> None:
    """InputError for an unknown controller, and for an engine beside the C, which has its own."""
    if name not in CONTROLLERS:
        raise InputError("--controller", "", repr(name), "own, or c")
    if name == "c" and engine != "auto":
        raise InputError("--engine", "", f"{engine} beside --controller c", "one of the two")


def compare_flights(
    fly: Callable[[Any], Experiment], flown: Experiment
) -> dict[str, dict[Precision, list[SignalDifference]]]:
    """The differences of the C's flights to those of the simulation's law, by case and precision.

    fly : makes the experiment with an engine; flown : that of the C in double precision
    """
    from malta.firmware.flight import differences, engine_of_c

    own, single = fly("auto"), fly(engine_of_c("float"))
    found: dict[str, dict[Precision, list[SignalDifference]]] = {}
    for case, c, f in zip(own.cases, flown.cases, single.cases, strict=True):
        found[case.label] = {"double": differences(case.run, c.run), "float": differences(case.run, f.run)}
    return found


def comparison_table(title: str, found: dict[Precision, list[SignalDifference]]) -> Any:
    """A table of the largest difference of each signal, as a share of its range."""
    from malta.report.tables import add_row, new_table

    table = new_table(title, "signal", "largest", "C, double", "C, float")
    for double, single in zip(found["double"], found["float"], strict=True):
        add_row(table, double.name, f"{double.range:.3g}", f"{double.share:.1e}", f"{single.share:.1e}")
    return table


def titles(labels: Sequence[str]) -> list[str]:
    """A title for the table of each case."""
    text = "The exported C against the simulation's law: largest difference / range"
    return [text if len(labels) == 1 else f"{text}: {label}" for label in labels]


MAX_RUN_DIGITS = 20  # digits of a run; Python refuses thousands of them


class SimulatedScenario(NamedTuple):
    """A simulated scenario."""

    scenario: str
    experiment: Experiment
    stem: str  # of the names of its files


def simulate(
    gains: GainFile,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="SCENARIO",
            help=f"What to simulate: {SCENARIOS}",
            autocompletion=scenarios,
            rich_help_panel=RUN,
        ),
    ] = None,
    change: Changes = None,
    option: OwnOptions = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="An error of the sensors: gain_x1=0.02, offset_y2=5um, hall_amplitude=0.01, hall_phase=2deg, ...",
            rich_help_panel=MACHINE,
        ),
    ] = None,
    seed: Seed = None,
    engine: Annotated[
        str,
        typer.Option(
            metavar="WORD",
            help="auto, compiled or virtual-machine.",
            autocompletion=offer("auto", "compiled", "virtual-machine"),
            rich_help_panel=RUN,
        ),
    ] = "auto",
    law: Annotated[
        str,
        typer.Option(
            "--controller",
            metavar="WORD",
            autocompletion=offer("own", "c"),
            help="own; or c: the exported C flies, compared with the own law and in float.",
            rich_help_panel=RUN,
        ),
    ] = "own",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder for the figure (.png), the time series (.npz) and, of record-v0, the gain files.",
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="Write what a bench would log of the first run: .csv, .npz, .mat, .parquet."
        ),
    ] = None,
    replay: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER:RUN",
            help="One run of a campaign again, or a rare event's design point: its machine, sensors and noise.",
            rich_help_panel=RUN,
        ),
    ] = None,
    machine: MachineFile = None,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Simulate the nonlinear machine and its drive with a gain file.

    The machine is the one in the file, with the changes given by --set; the controller does not learn of them.

    \b
    Example:  malta simulate design/gains/calibrated.json --set m=0.56 --out build
    """
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures
    from malta.simulation.experiments.catalogue import experiment, main_job

    controller = read_controller(gains, machine)
    plant = plant_of(change_machine(controller.parameters, change))
    if scenario == "help":
        print_scenarios(plant)
        raise typer.Exit
    require_controller(law, engine)
    if log is not None:
        from malta.identification.log_files import SUFFIXES

        require_suffix(log, *SUFFIXES)
    chosen, choice = scenario or main_job(plant), _engine_choice(law, engine)
    errors = read_sensor_errors(sensor, plant)
    options = read_options(option, chosen, plant)
    options |= {"sensor_errors": errors} if errors else {}
    options |= {} if seed is None else {"seed": seed}
    substeps = options.get("substeps")
    times = (3.0 if substeps else 1.0) * (10.0 if law == "c" else 1.0)  # own law, double, float: simulate.py
    with progress_bar(chosen, insists=False) as bar:
        # With substeps a second run, with twice as many, follows for the estimate of the error.
        progress = limit_time(bar, chosen, agreed=yes, times=times)

        def fly(engine: Any) -> SimulatedScenario:
            if replay is None:
                result = experiment(chosen, plant, controller, progress=progress, engine=engine, **options)
                return SimulatedScenario(chosen, result, f"{controller.name}_{chosen}")
            given = {"--option": option, "--sensor": sensor, "--scenario": scenario, "--set": change}
            others = [name for name, value in given.items() if value]
            others += [] if seed is None else ["--seed"]
            return _replay(replay, controller, others, engine, progress)

        simulation = fly(choice)
        compared = compare_flights(lambda e: fly(e).experiment, simulation.experiment) if law == "c" else {}
    published = published_figures(plant.name)
    files = [] if out is None else _save(simulation, out, published) + _save_gains(simulation, gains, out)
    if log is not None:
        from malta.identification.log import log_of
        from malta.identification.log_files import write_log

        files.append(write_log(log_of(simulation.experiment.run), log))
    if as_json:
        from malta.cli.documents.campaigns import SimulateOutput, experiment_fields, flights

        names, fields = [str(file) for file in files], experiment_fields(simulation.experiment)
        print_document(
            SimulateOutput(
                gains=str(gains),
                scenario=simulation.scenario,
                files=names,
                exported=flights(compared),
                **fields,
            )
        )
    else:
        _print_tables(gains, simulation, change or (), published, estimate=substeps is not None)
        for title, found in zip(titles(list(compared)), compared.values(), strict=True):
            make_console().print(comparison_table(title, found))
        print_written(make_console(), files)
    _conclude(gains, simulation, engine)


def _engine_choice(law: str, engine: str) -> Any:
    """What `malta.simulate` takes as its engine."""
    if law == "own":
        return engine.replace("-", " ")
    from malta.firmware.flight import engine_of_c

    return engine_of_c()


def _replay(
    text: str,
    controller: Controller,
    others: Sequence[str],
    engine: Any,
    progress: Callable[[float], None] | None,
) -> SimulatedScenario:
    """Simulate one run of a campaign, `FOLDER:RUN`, or the design point of a rare event, `FOLDER:rare_LIMIT`, again.

    Raises InputError for another form, and for `others`, the names of options that the campaign decides.
    """
    from malta.campaigns.rare import read_design_point, replay_design_point
    from malta.campaigns.run import replay as simulate_run
    from malta.campaigns.store import read_plan

    folder, _, run = text.rpartition(":")
    event = run.startswith("rare_") and Path(run).name == run
    if not folder or not ((run.isdecimal() and len(run) <= MAX_RUN_DIGITS) or event):
        expected = "FOLDER:RUN, as build/campaigns/mine:17 or build/campaigns/mine:rare_touchdown"
        raise InputError("--replay", "", repr(text), expected)
    if others:
        raise InputError(
            "--replay", "", f"{', '.join(others)} too", "none of them: the campaign says how it runs"
        )
    plan = read_plan(folder, controller)
    if event:
        point = read_design_point(Path(folder) / f"{run}.json", plan)
        result, name = replay_design_point(plan, point, engine=engine, progress=progress), run
    else:
        result, name = simulate_run(plan, int(run), engine=engine, progress=progress), f"run_{int(run)}"
    return SimulatedScenario(plan.scenario, result, f"{controller.name}_{plan.scenario}_{name}")


def _save(simulation: SimulatedScenario, folder: Path, published: Mapping[str, Any] | None) -> list[Path]:
    """Write the time series of every run, and the figure."""
    from malta import report
    from malta.simulation.trajectory_file import save as save_series

    cases, stem = simulation.experiment.cases, simulation.stem
    stems = [stem] if len(cases) == 1 else [f"{stem}_{_slug(case.label)}" for case in cases]
    series = [save_series(case.run, folder / f"{name}.npz") for name, case in zip(stems, cases, strict=True)]
    picture = folder / f"{stem}.png"
    report.experiment_figure(simulation.experiment, published, picture)
    return [*series, picture]


def _save_gains(simulation: SimulatedScenario, gains: Path, folder: Path) -> list[Path]:
    """Verify the controller that an experiment has found, and write it."""
    controller = simulation.experiment.controller
    return [] if controller is None else verify_and_write(controller, gains, folder)


def _slug(label: str) -> str:
    """A label as a part of a file name: letters, digits and underscores."""
    return "_".join("".join(c if c.isalnum() else " " for c in label).split())


def _print_tables(
    gains: Path,
    simulation: SimulatedScenario,
    changes: Sequence[str],
    published: Mapping[str, Any] | None,
    *,
    estimate: bool,
) -> None:
    """Print the outcome of a simulation, its merits and limits, and an estimate of the integration error."""
    from malta import report
    from malta.simulation.simulate import integration_error
    from malta.simulation.steps import steps_of

    result = simulation.experiment
    run, console = result.run, make_console()
    what = " ".join([f"fidelity {run.scenario.fidelity}", *changes])
    print_text(console, f"{gains}: {simulation.scenario}, {what} -> {result.outcome}")
    console.print(report.experiment_table(result, published))
    for line in report.limits_text(result):
        print_text(console, line)
    units = "/".join(dict.fromkeys(signal.unit for signal in run.plant.outputs))
    if estimate:
        print_text(console, f"integration error, estimated: {integration_error(run):.1g} {units}")
    if run.scenario.accuracy is not None:
        count = steps_of(run.plant, run.controller, run.scenario)
        said = f"integration error below {run.integration_error:.1g} {units}, {count} steps a sample"
        print_text(console, said)


def _conclude(gains: Path, simulation: SimulatedScenario, engine: str) -> None:
    """Note a missing compiler; exit with code 130 after Ctrl-C, raise CheckError when a run ended early."""
    from malta.model.plants import plant_of

    result = simulation.experiment
    runs = [
        case.run for case in result.cases if not plant_of(case.run.controller.parameters).actuator.tabulated
    ]
    if engine == "auto" and any(run.engine == "virtual machine" for run in runs):
        print_note("no C compiler: simulated on CasADi's virtual machine, some ten times slower")
    if result.interrupted:
        print_note(f"interrupted: {result.outcome}; what was computed is shown")
        raise typer.Exit(130)
    if result.failed:
        raise CheckError(f"{gains}: {simulation.scenario}: {result.outcome}")
