"""`malta campaign`: many machines that differ, in the same scenario."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from malta.cli.assignments import read_options, read_sensor_errors, read_shares
from malta.cli.completion import scenarios
from malta.cli.inputs import change_machine, design_of, print_scenarios, read_controller
from malta.cli.options import (
    MACHINE,
    RUN,
    SCENARIOS,
    AsJson,
    Changes,
    GainFileOrNone,
    MachineFile,
    OwnOptions,
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

STUDY = "A study in place of plain runs"  # a panel of the help


def campaign(
    ctx: typer.Context,
    gains: GainFileOrNone = None,
    samples: Annotated[int, typer.Option(help="How many.", rich_help_panel=MACHINE)] = 10_000,
    spread: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]SHARE",
            help="Of parameters: 20%, m=10%. [the gain file's]",
            rich_help_panel=MACHINE,
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="How far sensors err: gain_x1=2%, offset_y2=5um, ...",
            rich_help_panel=MACHINE,
        ),
    ] = None,
    sampler: Annotated[
        str, typer.Option(help="latin-hypercube or sobol.", rich_help_panel=MACHINE)
    ] = "latin-hypercube",
    seed: Annotated[int, typer.Option(help="Of machines and noise.", rich_help_panel=MACHINE)] = 0,
    change: Changes = None,
    machine: MachineFile = None,
    scenario: Annotated[
        str | None,
        typer.Option(help=f"Their job: {SCENARIOS}", autocompletion=scenarios, rich_help_panel=RUN),
    ] = None,
    case: Annotated[
        str | None, typer.Option(help="Of a scenario of several runs. [the first]", rich_help_panel=RUN)
    ] = None,
    option: OwnOptions = None,
    law: Annotated[
        str,
        typer.Option(
            "--controller",
            help="own; or c, c-float: the exported C flies.",
            show_default=False,
            rich_help_panel=RUN,
        ),
    ] = "own",
    study: Annotated[
        str | None,
        typer.Option(
            help="rare (probability), sensitivity (Sobol indices) or tolerances.",
            rich_help_panel=STUDY,
        ),
    ] = None,
    limit: Annotated[
        str | None,
        typer.Option(
            metavar="LIMIT",
            help="[touchdown] or deviation-y1=40um, ...: `help` lists them.",
            rich_help_panel=STUDY,
        ),
    ] = None,
    keep: Annotated[
        str | None, typer.Option(metavar="YIELD", help="Of tolerances: 99%.", rich_help_panel=STUDY)
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Threads. [one for each core]")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Workers of a Dask scheduler: tcp://host:8786."),
    ] = None,
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
    worst: Annotated[int, typer.Option(min=0, max=1000, help="Runs to list.")] = 5,
    status: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Show how far the campaign in a folder is.",
        ),
    ] = None,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Simulate many machines that differ, each with noise of its own: the yield, and what goes wrong where.

    The folder keeps every block of runs: the same command goes on where it was ended. Whatever the yield is, the exit
    code is 0. A study of the same box takes the place of plain runs.

    \b
    Example:  malta campaign design/gains/calibrated.json --spread 20%
              malta campaign --status build/campaigns/calibrated_stroke_1a2b3c4d
              malta campaign design/gains/table2.json --study rare
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
    asked = study_of(study, limit, keep, cluster)
    options = {"noise": 1.0} | read_options(option, scenario, plant)
    if study != "rare":
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
    if asked is not None:
        run_study(asked, Setting(gains, plan, bounds, folder, workers, as_json, yes))
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
