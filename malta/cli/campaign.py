"""`malta campaign`: many machines that differ, in the same scenario."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from malta.cli.assignments import add_own_options, read_sensor_errors, read_shares, scenario_options
from malta.cli.completion import scenarios
from malta.cli.inputs import change_machine, design_of, print_scenarios, read_controller
from malta.cli.options import (
    SCENARIOS,
    SETTLE,
    AsJson,
    Bearing,
    BearingAxes,
    Changes,
    Delay,
    Distance,
    Feedforward,
    FidelityName,
    GainFileOrNone,
    MachineFile,
    OwnOptions,
    ProfileName,
    Quantize,
    RealPwm,
    Rise,
    Scheduled,
    Substeps,
    Yes,
)
from malta.cli.output import (
    NO_COMPILER,
    make_console,
    print_document,
    print_note,
    print_written,
    progress_bar,
)
from malta.cli.patience import limit_time
from malta.cli.status import StatusOptions, print_tables, show_status
from malta.cli.studies import Setting, run_study, study_of
from malta.errors import InputError

if TYPE_CHECKING:
    from malta.campaigns.plan import Law, Sampler
    from malta.campaigns.summary import Summary


def campaign(
    ctx: typer.Context,
    gains: GainFileOrNone = None,
    samples: Annotated[int, typer.Option(help="Machines; of --rare in each level.")] = 10_000,
    scenario: Annotated[
        str | None, typer.Option(help=f"What each one does: {SCENARIOS}", autocompletion=scenarios)
    ] = None,
    case: Annotated[str | None, typer.Option(help="Of a scenario of several runs. [the first]")] = None,
    spread: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]SHARE",
            help="Of parameters: 20%, m=10%. [the gain file's]",
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="How far sensors err: gain_x1=2%, offset_y2=5um, ...",
        ),
    ] = None,
    sampler: Annotated[str, typer.Option(help="latin-hypercube or sobol.")] = "latin-hypercube",
    change: Changes = None,
    distance: Distance = None,
    rise: Rise = None,
    settle: Annotated[
        float | None,
        typer.Option(help=f"{SETTLE} [300 where yields of MALTA's strokes are counted, else 0]"),
    ] = None,
    profile: ProfileName = None,
    option: OwnOptions = None,
    fidelity: FidelityName = None,
    noise: Annotated[float, typer.Option(help="Of the sensors, in multiples.")] = 1.0,
    quantize: Quantize = None,
    bearing: Bearing = None,
    scheduled: Scheduled = None,
    feedforward: Feedforward = None,
    bearing_axes: BearingAxes = None,
    real_pwm: RealPwm = None,
    delay: Delay = None,
    substeps: Substeps = None,
    seed: Annotated[int, typer.Option(help="Seed of machines and noise.")] = 0,
    law: Annotated[
        str,
        typer.Option("--controller", help="own; or c, c-float: the exported C flies."),
    ] = "own",
    workers: Annotated[int | None, typer.Option(help="Threads. [one for each core]")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Workers of a Dask scheduler: tcp://host:8786."),
    ] = None,
    rare: Annotated[
        str | None,
        typer.Option(
            metavar="LIMIT",
            help="Probability of a rare event: touchdown, deviation-y1=40um; `help` lists them.",
        ),
    ] = None,
    sobol: Annotated[
        bool, typer.Option("--sobol", help="Which parameter costs yield: Sobol indices.")
    ] = False,
    tolerance: Annotated[
        str | None,
        typer.Option(metavar="YIELD", help="The largest spreads that keep a yield: 99%."),
    ] = None,
    limit: Annotated[
        str | None,
        typer.Option(metavar="LIMIT", help="Of --sobol and --tolerance, as in --rare. [touchdown]"),
    ] = None,
    worst: Annotated[int, typer.Option(min=0, max=1000, help="Runs to list.")] = 5,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of blocks and figures. [build/campaigns/]"),
    ] = None,
    design: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Design file whose [specification] counts too.",
        ),
    ] = None,
    machine: MachineFile = None,
    yes: Yes = False,
    status: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Show how far the campaign in a folder is.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate many machines that differ, each with noise of its own: the yield, and what goes wrong where.

    The folder keeps every block of runs: the same command goes on where it was ended. Whatever the yield is, the exit
    code is 0. --rare, --sobol and --tolerance study the same box in place of plain runs.

    \b
    Example:  malta campaign design/gains/calibrated.json --spread 20%
              malta campaign --status build/campaigns/calibrated_stroke_1a2b3c4d
              malta campaign design/gains/table2.json --rare touchdown
    """
    if status is not None:
        show_status(ctx, status, gains, StatusOptions(design, machine, worst, as_json))
        return
    if gains is None:
        raise InputError("campaign", "GAINS", "nothing", "a gain file, or --status FOLDER")
    from malta.campaigns.plan import Plan
    from malta.campaigns.run import Session, campaign_folder
    from malta.campaigns.summary import Bounds
    from malta.campaigns.survey import summarize
    from malta.model.data import plant_of
    from malta.model.published import published_figures
    from malta.simulation.catalogue import main_job, settling

    controller = read_controller(gains, machine)
    parameters = change_machine(controller.parameters, change)
    plant = plant_of(parameters)
    if scenario == "help":
        print_scenarios(plant, campaigns=True)
        raise typer.Exit
    scenario = scenario or main_job(plant)
    published = published_figures(plant.name)
    study = study_of(rare, tolerance, limit, cluster, sobol=sobol)
    options = scenario_options(
        distance,
        rise,
        settle,
        profile=profile,
        fidelity=fidelity,
        noise=noise,
        quantize=quantize,
        bearing=bearing,
        scheduled=scheduled,
        feedforward=feedforward,
        bearing_axes=bearing_axes,
        real_pwm=real_pwm,
        delay=delay,
        substeps=substeps,
    )
    options = add_own_options(options, option, scenario, plant)
    if rare is None:
        options = settling(scenario, plant) | options
    plan = Plan(
        controller,
        scenario,
        read_shares(gains, spread, parameters, published),
        read_sensor_errors(sensor, plant),
        samples,
        seed,
        cast("Sampler", sampler),
        parameters,
        case,
        options,
        cast("Law", law),
    )
    bounds = Bounds(published, design_of(gains, controller, design))
    folder = out or Path("build") / "campaigns" / f"{controller.name}_{scenario}_{plan.identity[:8]}"
    if study is not None:
        run_study(study, Setting(gains, plan, bounds, folder, workers, as_json, yes))
        return
    session = Session(workers, cluster)
    with campaign_folder(plan, folder, session, gains), progress_bar(scenario, insists=False) as bar:
        progress = limit_time(bar, f"{scenario}, {samples} runs", agreed=yes)
        result = summarize(plan, folder, bounds, workers=workers, cluster=cluster, progress=progress)
    _report(gains, result, worst, as_json=as_json)


def _report(gains: Path, found: Summary, worst: int, *, as_json: bool) -> None:
    """Draw and print a campaign and note what went wrong; exit with code 130 after Ctrl-C."""
    from malta.model.data import plant_of

    for file in found.damaged:
        print_note(f"{file}: a damaged block, flown again")
    files = _draw(found)
    if as_json:
        from malta.cli.documents.campaigns import CampaignOutput, runs_fields

        names, fields = [str(file) for file in files], runs_fields(found, worst)
        print_document(CampaignOutput(gains=str(gains), folder=str(found.folder), files=names, **fields))
    else:
        print_tables(gains, found, worst)
        print_written(make_console(), files)
    plan = found.plan
    if "virtual machine" in found.engines and not plant_of(plan.controller.parameters).tabulated:
        print_note(NO_COMPILER)
    if found.interrupted:
        print_note(
            f"interrupted after {found.runs} of {plan.samples} runs, which {found.folder} keeps; "
            "the same command goes on"
        )
        raise typer.Exit(130)


def _draw(found: Summary) -> list[Path]:
    """Draw the figures of a campaign into its folder; none without runs."""
    if found.folder is None or not found.runs:
        return []
    from malta import report

    report.campaign(found, found.folder)
    return [found.folder / name for name in report.CAMPAIGN_FILES]
