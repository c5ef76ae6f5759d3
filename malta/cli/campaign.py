"""`malta campaign`: many machines that differ, in the same scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import typer

from malta.cli.assignments import add_own_options, read_sensor_errors, read_shares, scenario_options
from malta.cli.documents import campaign_document
from malta.cli.inputs import change_machine, design_of, print_scenarios, read_controller
from malta.cli.options import (
    SCENARIOS,
    AsJson,
    Bearing,
    BearingAxes,
    Changes,
    Delay,
    Distance,
    Feedforward,
    FidelityName,
    GainFile,
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
from malta.cli.output import make_console, print_json, print_note, print_written, progress_bar
from malta.cli.patience import limit_time

if TYPE_CHECKING:
    from malta.campaigns.plan import Sampler
    from malta.campaigns.result import Campaign
    from malta.synthesis.spec import Spec


def campaign(
    gains: GainFile,
    samples: Annotated[int, typer.Option(help="Machines.")] = 10_000,
    scenario: Annotated[str | None, typer.Option(help=f"What each one does: {SCENARIOS}")] = None,
    case: Annotated[
        str | None, typer.Option(help="Of a scenario with several runs: which one. [the first]")
    ] = None,
    spread: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]SHARE",
            help="How far parameters vary, either way: 20% (those of the gain file's uncertainty), m=10%, ... "
            "[the gain file's own]",
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="How far an error of the sensors varies, either way: gain_x1=2%, offset_y2=5um, hall_phase=2deg, ...",
        ),
    ] = None,
    sampler: Annotated[str, typer.Option(help="latin-hypercube or sobol.")] = "latin-hypercube",
    change: Changes = None,
    distance: Distance = None,
    rise: Rise = None,
    profile: ProfileName = None,
    option: OwnOptions = None,
    fidelity: FidelityName = None,
    noise: Annotated[float, typer.Option(help="Sensor noise in multiples of the machine's.")] = 1.0,
    quantize: Quantize = None,
    bearing: Bearing = None,
    scheduled: Scheduled = None,
    feedforward: Feedforward = None,
    bearing_axes: BearingAxes = None,
    real_pwm: RealPwm = None,
    delay: Delay = None,
    substeps: Substeps = None,
    seed: Annotated[int, typer.Option(help="Seed of machines and noise.")] = 0,
    workers: Annotated[int | None, typer.Option(help="Threads. [one for each core]")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Fly on the workers of a Dask scheduler: tcp://host:8786."),
    ] = None,
    worst: Annotated[int, typer.Option(min=0, help="How many of the worst runs to list.")] = 5,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of blocks and figures. [build/campaigns/, one for each campaign]"),
    ] = None,
    design: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Design file whose [specification] bounds the runs too. [NAME.toml beside the gain file's folder]",
        ),
    ] = None,
    machine: MachineFile = None,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Simulate many machines that differ, each with noise of its own: the yield, and what goes wrong where.

    Every block of runs is kept in the folder. The same command goes on where it was ended, and reads what is done;
    `malta simulate GAINS --replay FOLDER:RUN` shows one of the runs. Whatever the yield is, the exit code is 0.

    Three yields: runs that were completed, those within what the machine's paper prints, and those within what
    [specification] asks of the same motion.

    \b
    Example:  malta campaign design/gains/calibrated.json --samples 10000 --spread 20%
    """
    from malta.campaigns.plan import Plan
    from malta.campaigns.run import campaign as run_campaign
    from malta.model.data import plant_of
    from malta.model.published import published_figures
    from malta.simulation.catalogue import main_job

    controller = read_controller(gains, machine)
    parameters = change_machine(controller.parameters, change)
    plant = plant_of(parameters)
    if scenario == "help":
        print_scenarios(plant, campaigns=True)
        raise typer.Exit
    scenario = scenario or main_job(plant)
    published = published_figures(plant.name)
    options = scenario_options(
        distance,
        rise,
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
    )
    spec = design_of(gains, controller, design)
    folder = out or Path("build") / "campaigns" / f"{controller.name}_{scenario}_{plan.identity[:8]}"
    with progress_bar(scenario, quiet=as_json) as bar:
        progress = limit_time(bar, f"{scenario}, {samples} runs", agreed=yes)
        result = run_campaign(plan, folder, workers=workers, cluster=cluster, progress=progress)
    _report(gains, result, Bounds(published, spec), worst, as_json=as_json)


class Bounds(NamedTuple):
    """What bounds the runs of a campaign."""

    published: Mapping[str, Any] | None
    spec: Spec | None


def _report(gains: Path, campaign: Campaign, bounds: Bounds, worst: int, *, as_json: bool) -> None:
    """Draw and print a campaign and note what went wrong; exit with code 130 after Ctrl-C."""
    from malta.model.data import plant_of

    for file in campaign.damaged:
        print_note(f"{file}: a damaged block, flown again")
    files = _draw(campaign, bounds.published)
    if as_json:
        names = [str(file) for file in files]
        document = {"gains": str(gains), "folder": str(campaign.folder), "files": names}
        print_json(document | campaign_document(campaign, bounds.published, worst, bounds.spec))
    else:
        _print_tables(gains, campaign, bounds, worst, files)
    plan = campaign.plan
    if "virtual machine" in campaign.engines and not plant_of(plan.controller.parameters).tabulated:
        print_note("no C compiler: simulated on CasADi's virtual machine, some hundred times slower")
    if campaign.interrupted:
        print_note(
            f"interrupted after {len(campaign.index)} of {plan.samples} runs, which {campaign.folder} keeps; "
            "the same command goes on"
        )
        raise typer.Exit(130)


def _draw(campaign: Campaign, published: Mapping[str, Any] | None) -> list[Path]:
    """Draw the figures of a campaign into its folder; none without runs."""
    if campaign.folder is None or not len(campaign.index):
        return []
    from malta import report

    return report.campaign(campaign, campaign.folder, published)


def _print_tables(
    gains: Path,
    campaign: Campaign,
    bounds: Bounds,
    worst: int,
    files: Sequence[Path],
) -> None:
    """Print what was flown, the yield, the distributions and the worst runs; only the first without runs."""
    from malta import report
    from malta.campaigns.plan import planned_run

    plan, console, wanted = campaign.plan, make_console(), planned_run(campaign.plan)
    case = "" if wanted.label == plan.scenario else f" ({wanted.label})"
    console.print(
        f"{gains}: {plan.scenario}{case}, fidelity {wanted.scenario.fidelity}, "
        f"{len(campaign.index)} of {plan.samples} machines"
    )
    console.print(f"{report.box_text(campaign)}; {plan.sampler}, seed {plan.seed}")
    if not len(campaign.index):
        return
    console.print(report.campaign_tables(campaign, bounds.published, worst, bounds.spec))
    if worst:
        console.print(
            f"one of them again: malta simulate {gains} --replay {campaign.folder}:RUN", soft_wrap=True
        )
    print_written(console, files)
