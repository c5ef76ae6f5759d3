"""`malta campaign`: many machines that differ, in the same scenario."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import typer

from malta.cli.options import (
    MACHINE,
    NUMBER,
    RUN,
    SCENARIOS,
    AsJson,
    Changes,
    GainFileOrNone,
    MachineFile,
    OwnOptions,
    WholeTime,
    Yes,
    change_machine,
    find_design,
    offer,
    print_scenarios,
    read_assignments,
    read_controller,
    read_options,
    read_sensor_errors,
    read_shares,
    scenarios,
)
from malta.cli.output import (
    NO_COMPILER,
    duration_text,
    interruption,
    limit_time,
    make_console,
    print_document,
    print_line,
    print_note,
    print_text,
    print_written,
    progress_bar,
)
from malta.errors import InputError
from malta.work import count_work
from malta.writing import json_text, replace_files

if TYPE_CHECKING:
    from malta.campaigns.limits import Limit
    from malta.campaigns.plan import Law, Plan, Sampler
    from malta.campaigns.run import Status
    from malta.campaigns.summary import RunLimits, Summary
    from malta.cli.documents.loops import DocumentPart
    from malta.simulation.experiments import Progress


# The status of a campaign's folder, and what `malta campaign` prints of it.


def print_tables(gains: Path, found: Summary, worst: int) -> None:
    """Print what was flown, the yield, the distributions and the worst runs; only the first without runs."""
    from malta.report.tables.campaign import box_text, campaign_tables, run_text

    plan, console = found.plan, make_console()
    print_text(console, f"{gains}: {run_text(plan)}, {found.runs} of {plan.samples} machines")
    print_text(console, f"{box_text(plan)}; {plan.sampler}, seed {plan.seed}")
    if not found.runs:
        return
    console.print(campaign_tables(found, worst=worst))
    if worst:
        console.print(
            f"one of them again: malta simulate {gains} --replay {found.folder}:RUN", soft_wrap=True
        )


class StatusOptions(NamedTuple):
    """Options of a campaign that say how its status is looked at."""

    design: Path | None
    machine: Path | None
    worst: int
    as_json: bool


def show_status(ctx: typer.Context, folder: Path, gains: Path | None, options: StatusOptions) -> None:
    """Print the status of the campaign in a folder. Raises InputError for options that the campaign decides."""
    from malta.campaigns.run import status as status_of
    from malta.campaigns.store import noted_gains
    from malta.campaigns.summary import RunLimits
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures

    sources = {param: ctx.get_parameter_source(str(param.name)) for param in ctx.command.params}
    given = [param for param, source in sources.items() if source and source.name == "COMMANDLINE"]
    others = [
        param.opts[0] for param in given if param.name not in ("status", "gains", *StatusOptions._fields)
    ]
    if others:
        raise InputError(
            "--status", "", f"{', '.join(others)} too", "none of them: the folder has its campaign"
        )
    gains = noted_gains(folder) if gains is None else gains
    controller = read_controller(gains, options.machine)
    published = published_figures(plant_of(controller.parameters).name)
    bounds = RunLimits(published, find_design(gains, controller, options.design))
    with progress_bar("status") as progress:
        found = status_of(folder, controller, bounds, progress)
    if options.as_json:
        from malta.cli.documents.campaigns import StatusOutput, runs_fields, status_fields

        fields = runs_fields(found.summary, options.worst) | status_fields(found)
        print_document(StatusOutput(gains=str(gains), folder=str(folder), **fields))
        return
    for file in found.summary.damaged:
        print_note(f"{file}: a damaged block, which the campaign will fly again")
    console = make_console()
    for line in _status_lines(found):
        print_line(console, line)
    print_tables(gains, found.summary, options.worst)


def _status_lines(found: Status) -> list[str]:
    """Blocks in the folder, and whether others seem to come."""
    summary = found.summary
    lines = [
        f"{summary.folder}: {found.blocks} of {found.of} blocks of {found.size} runs, "
        f"{found.stored / 1e6:.1f} MB, {len(summary.damaged)} damaged"
    ]
    last = "" if found.age is None else f": the last block came {duration_text(found.age)} ago"
    if found.running:
        left = "" if found.left is None else f", about {duration_text(found.left)} left"
        lines.append(f"running{last}{left}")
    elif found.blocks < found.of:
        lines.append(f"not running{last}; the same command goes on")
    return lines


# Studies of `malta campaign` on its box, in place of plain runs: rare events, sensitivity and tolerances.


class Study(NamedTuple):
    """A study of STUDIES."""

    name: str
    limit: str  # "touchdown", "deviation-y1=20um", "help"
    wanted: float = 1.0  # yield to keep


class Setting(NamedTuple):
    """What the studies have in common."""

    gains: Path
    plan: Plan
    bounds: RunLimits
    folder: Path
    workers: int | None
    as_json: bool
    yes: bool  # to work of any length


def choose_study(name: str | None, limit: str | None, keep: str | None, cluster: str | None) -> Study | None:
    """The study that the options ask for; None for a plain campaign.

    Raises InputError for an unknown study, for a cluster, and for an invalid limit or yield, and one without its study.
    """
    if name is None:
        for option, given in (("--limit", limit), ("--keep", keep)):
            if given is not None:
                raise InputError(option, "", repr(given), "it with --study")
        return None
    if name not in STUDIES:
        raise InputError("--study", "", repr(name), "one of " + ", ".join(STUDIES))
    if cluster is not None:
        raise InputError("--study", name, "--cluster too", "it without: it runs on this machine")
    if (keep is None) == (name == "tolerances"):
        raise InputError(
            "--study", name, f"{'no ' if keep is None else ''}--keep", "it with tolerances alone, as 99%"
        )
    wanted = 1.0 if keep is None else read_assignments("--keep", [f"yield={keep}"], {"yield": "1"})["yield"]
    if not 0 < wanted <= 1:
        raise InputError("--keep", "", repr(keep), "a yield above 0 % and up to 100 %, as 99%")
    return Study(name, limit or "touchdown", wanted)


class StudyOutcome(NamedTuple):
    """What a study leaves behind."""

    document: DocumentPart
    files: list[Path]
    parts: list[Any]  # tables and lines for the console
    note: str  # "": none


def run_study(study: Study, setting: Setting) -> None:
    """Run a study, write it into the campaign's folder and print it; exit with code 130 after Ctrl-C."""
    from malta.campaigns.plan import planned_run
    from malta.campaigns.run import RunExecution, campaign_folder
    from malta.report.tables.campaign import box_text, run_text
    from malta.simulation.engine.batch import is_compiled

    if study.limit == "help":
        _print_limits(setting.plan)
        raise typer.Exit
    limit = read_limit(study.limit, setting.plan, setting.bounds)
    what, session = f"{setting.plan.scenario}, {study.name}", RunExecution(setting.workers)
    folder = campaign_folder(setting.plan, setting.folder, session, setting.gains)
    with folder, progress_bar(what, insists=False) as bar:
        progress = limit_time(bar, what, agreed=setting.yes)
        try:
            outcome = STUDIES[study.name](limit, study.wanted, setting, progress)
        except KeyboardInterrupt:
            raise interruption(f"nothing is known of {what}; {setting.folder} stands as it was") from None
    if setting.as_json:
        print_document(outcome.document)
    else:
        console = make_console()
        print_text(console, f"{setting.gains}: {run_text(setting.plan)}")
        print_text(console, f"{box_text(setting.plan)}; seed {setting.plan.seed}")
        for part in outcome.parts:
            console.print(part, soft_wrap=isinstance(part, str))
        print_written(console, outcome.files)
    if outcome.note:
        print_note(outcome.note)
    plan = setting.plan
    if not (
        plan.plant.actuator.tabulated or is_compiled(plan.plant, plan.controller, planned_run(plan).scenario)
    ):
        print_note(NO_COMPILER)


def _rare(limit: Limit, _: float, setting: Setting, progress: Progress | None) -> StudyOutcome:
    """The probability of exceeding a limit."""
    from malta.campaigns.rare import event_name, rare_event, write_event
    from malta.cli.documents.campaigns import RareOutput, rare_fields
    from malta.report.tables.campaign import rare_event_sentence, rare_event_tables

    try:
        event = rare_event(setting.plan, limit, setting.folder, workers=setting.workers, progress=progress)
    except KeyboardInterrupt:
        raise interruption(f"the same command goes on with the repetitions in {setting.folder}") from None
    files = [write_event(event, setting.folder)]
    parts: list[Any] = [rare_event_tables(event)]
    if event.design_point is not None:
        place = f"{setting.folder}:{event_name(limit)}"
        parts.append(f"the design point again: malta simulate {setting.gains} --replay {place}")
    document = RareOutput(**_head(setting, files), **rare_fields(event))
    return StudyOutcome(document, files, parts, rare_event_sentence(event))


def _sobol(limit: Limit, _: float, setting: Setting, progress: Progress | None) -> StudyOutcome:
    """Which parameter costs yield."""
    from malta.campaigns.studies import sensitivity, sensitivity_document
    from malta.cli.documents.campaigns import SobolOutput, sobol_fields
    from malta.report.figures.campaign import sensitivity_figure
    from malta.report.tables.campaign import sensitivity_sentence, sensitivity_tables

    found = sensitivity(setting.plan, limit, workers=setting.workers, progress=progress)
    files = [_write(setting, f"sobol_{limit.slug}.json", sensitivity_document(found))]
    if found.of_yield or any(found.of_merits.values()):
        files.append(setting.folder / f"sobol_{limit.slug}.png")
        sensitivity_figure(found, files[-1])
    output = SobolOutput(**_head(setting, files), **sobol_fields(found))
    return StudyOutcome(output, files, [sensitivity_tables(found)], sensitivity_sentence(found))


def _tolerance(limit: Limit, wanted: float, setting: Setting, progress: Progress | None) -> StudyOutcome:
    """The largest spreads that keep a yield."""
    from malta.campaigns.studies import tolerance_document, tolerances
    from malta.cli.documents.campaigns import ToleranceOutput, tolerance_fields
    from malta.report.tables.campaign import spreads_table, tolerance_sentence

    found = tolerances(setting.plan, limit, wanted, workers=setting.workers, progress=progress)
    files = [_write(setting, f"tolerance_{limit.slug}.json", tolerance_document(found))]
    output = ToleranceOutput(**_head(setting, files), **tolerance_fields(found))
    return StudyOutcome(output, files, [spreads_table(found)], tolerance_sentence(found))


def _head(setting: Setting, files: list[Path]) -> dict[str, Any]:
    """What the documents of all studies begin with."""
    names = [str(file) for file in files]
    gains, folder = str(setting.gains), str(setting.folder)
    return {"gains": gains, "folder": folder, "files": names, "manifest": setting.plan.manifest}


STUDIES = {"rare": _rare, "sensitivity": _sobol, "tolerances": _tolerance}


def _write(setting: Setting, name: str, document: dict[str, Any]) -> Path:
    path = setting.folder / name
    replace_files({path: (json_text(document) + "\n").encode()})
    return path


def read_limit(text: str, plan: Plan, bounds: RunLimits) -> Limit:
    """Read a limit: "touchdown", "published", "specification", or a merit with its bound, as "deviation-y1=20um".

    A bound without a unit is in SI. Raises InputError for any other text.
    """
    from malta.campaigns.limits import limit_of, merits_of, slug
    from malta.units import to_si, unit_factor

    name, sign, value = (part.strip() for part in text.partition("="))
    bound = None
    try:
        if sign:
            number = re.fullmatch(NUMBER, value)
            if number is None:
                raise InputError("--limit", name, repr(value), "a number with its unit, as 20um")
            known = merits_of(plan)
            _, shown = known.get(slug(name), ("", ""))
            bound = float(number[1])
            if number[2] and slug(name) in known:
                unit = number[2].replace("%", "percent")
                bound = to_si(bound, unit, shown, "--limit", name) * unit_factor(shown, name)
        return limit_of(plan, name, bound, bounds)
    except InputError as error:
        raise InputError(
            "--limit", error.field.removeprefix("limit").strip(), error.found, error.expected
        ) from None


def _print_limits(plan: Plan) -> None:
    """Print the names of the limits, with the units of those that take a bound."""
    from malta.campaigns.limits import EVENTS, merits_of

    console = make_console()
    for name in EVENTS:
        console.print(name)
    for name, (label, unit) in merits_of(plan).items():
        console.print(f"{name}=VALUE  {label} [{'%' if unit == 'percent' else unit}]")


STUDY = "A study in place of plain runs"  # a panel of the help


def campaign(
    ctx: typer.Context,
    gains: GainFileOrNone = None,
    samples: Annotated[
        int, typer.Option(metavar="N", help="How many machines.", rich_help_panel=MACHINE)
    ] = 10_000,
    spread: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SHARE|NAME=SHARE",
            help="Of parameters: 20%, m=10%. [the gain file's]",
            rich_help_panel=MACHINE,
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Errors of sensors: gain_x1=2%, offset_y2=5um.",
            rich_help_panel=MACHINE,
        ),
    ] = None,
    sampler: Annotated[
        str,
        typer.Option(
            metavar="WORD",
            autocompletion=offer("latin-hypercube", "sobol"),
            help="[latin-hypercube] or sobol.",
            show_default=False,
            rich_help_panel=MACHINE,
        ),
    ] = "latin-hypercube",
    seed: Annotated[
        int, typer.Option(metavar="N", help="Seed of machines and noise.", rich_help_panel=MACHINE)
    ] = 0,
    change: Changes = None,
    machine: MachineFile = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="SCENARIO",
            help=f"What each machine does: {SCENARIOS}",
            autocompletion=scenarios,
            rich_help_panel=RUN,
        ),
    ] = None,
    case: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="One case of a scenario that has several. [the first]", rich_help_panel=RUN
        ),
    ] = None,
    option: OwnOptions = None,
    law: Annotated[
        str,
        typer.Option(
            "--controller",
            metavar="WORD",
            autocompletion=offer("own", "c", "c-float"),
            help="own; or c, c-float: the exported C flies.",
            show_default=False,
            rich_help_panel=RUN,
        ),
    ] = "own",
    study: Annotated[
        str | None,
        typer.Option(
            metavar="WORD",
            autocompletion=offer("rare", "sensitivity", "tolerances"),
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
        str | None, typer.Option(metavar="SHARE", help="Of tolerances: 99%.", rich_help_panel=STUDY)
    ] = None,
    workers: Annotated[int | None, typer.Option(metavar="N", help="Threads. [one for each core]")] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Workers of a Dask scheduler: tcp://host:8786.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder of blocks and figures. [build/campaigns/]")
    ] = None,
    design: Annotated[
        Path | None, typer.Option(metavar="DESIGN", help="Design file whose [specification] counts too.")
    ] = None,
    worst: Annotated[int, typer.Option(metavar="N", min=0, max=1000, help="Runs to list.")] = 5,
    status: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Show how far the campaign in a folder is.")
    ] = None,
    yes: Yes = False,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Simulate many machines that differ, each with noise of its own: the yield, and what goes wrong where.

    The folder keeps every block of runs: the same command goes on where it was ended. Whatever the yield is, the exit
    code is 0.

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
    from malta.campaigns.run import RunExecution, campaign_folder, summarize
    from malta.campaigns.summary import RunLimits
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures
    from malta.simulation.experiments.catalogue import main_job, settling_option

    controller = read_controller(gains, machine)
    parameters = change_machine(controller.parameters, change)
    plant = plant_of(parameters)
    if scenario == "help":
        print_scenarios(plant, campaigns=True)
        raise typer.Exit
    scenario = scenario or main_job(plant)
    published = published_figures(plant.name)
    asked = choose_study(study, limit, keep, cluster)
    options = {"noise": 1.0} | read_options(option, scenario, plant)
    if study != "rare":
        options = settling_option(scenario, plant, controller) | options
    plan = Plan(
        controller,
        scenario,
        read_shares(gains, spread, parameters),
        read_sensor_errors(sensor, plant),
        samples,
        seed,
        cast("Sampler", sampler),
        parameters,
        case,
        options,
        cast("Law", law),
    )
    bounds = RunLimits(published, find_design(gains, controller, design))
    folder = out or Path("build") / "campaigns" / f"{controller.name}_{scenario}_{plan.identity[:8]}"
    if asked is not None:
        if time is not None:
            raise InputError("--time", "", f"--study {asked.name}", "one of them: a study ends by itself")
        run_study(asked, Setting(gains, plan, bounds, folder, workers, as_json, yes))
        return
    session = RunExecution(workers, cluster)
    with (
        count_work(math.inf, time) as meter,
        campaign_folder(plan, folder, session, gains),
        progress_bar(scenario, insists=False) as bar,
    ):
        progress = limit_time(bar, f"{scenario}, {samples} runs", agreed=yes)
        result = summarize(plan, folder, bounds, workers=workers, cluster=cluster, progress=progress)
    _report(gains, result, worst, as_json=as_json, pressed=not meter.stopped)


def _report(gains: Path, found: Summary, worst: int, *, as_json: bool, pressed: bool) -> None:
    """Draw and print a campaign and note what went wrong; exit with code 130 after Ctrl-C."""
    from malta.model.plants import plant_of

    for file in found.damaged:
        print_note(f"{file}: a damaged block, flown again")
    files = draw_figures(found)
    if as_json:
        from malta.cli.documents.campaigns import CampaignOutput, runs_fields

        names, fields = [str(file) for file in files], runs_fields(found, worst)
        print_document(CampaignOutput(gains=str(gains), folder=str(found.folder), files=names, **fields))
    else:
        print_tables(gains, found, worst)
        print_written(make_console(), files)
    plan = found.plan
    if "virtual machine" in found.engines and not plant_of(plan.controller.parameters).actuator.tabulated:
        print_note(NO_COMPILER)
    if found.interrupted:
        print_note(
            f"{'interrupted' if pressed else 'ended'} after {found.runs} of {plan.samples} runs, which {found.folder} "
            "keeps; the same command goes on"
        )
        raise typer.Exit(130 if pressed else 0)


def draw_figures(found: Summary) -> list[Path]:
    """Draw the figures of a campaign into its folder; none without runs."""
    if found.folder is None or not found.runs:
        return []
    from malta import report

    report.campaign(found, found.folder)
    return [found.folder / name for name in report.CAMPAIGN_FILES]
