"""Studies of `malta campaign` on its box, in place of plain runs: rare events, sensitivity and tolerances."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from malta.cli.assignments import NUMBER, read_assignments
from malta.cli.output import (
    NO_COMPILER,
    interruption,
    make_console,
    print_document,
    print_note,
    print_text,
    print_written,
    progress_bar,
)
from malta.cli.patience import limit_time
from malta.errors import InputError
from malta.files import json_text, replace_files

if TYPE_CHECKING:
    from malta.campaigns.limits import Limit
    from malta.campaigns.plan import Plan
    from malta.campaigns.summary import Bounds
    from malta.cli.documents.parts import Part
    from malta.simulation.experiments import Progress


class Study(NamedTuple):
    """A study of STUDIES."""

    name: str
    limit: str  # "touchdown", "deviation-y1=20um", "help"
    wanted: float = 1.0  # yield to keep


class Setting(NamedTuple):
    """What the studies have in common."""

    gains: Path
    plan: Plan
    bounds: Bounds
    folder: Path
    workers: int | None
    as_json: bool
    yes: bool  # to work of any length


def study_of(name: str | None, limit: str | None, keep: str | None, cluster: str | None) -> Study | None:
    """The study that the options ask for; None for a plain campaign.

    Raises InputError for an unknown study, for a cluster, and for a limit or a yield that is none or has no study.
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


class Outcome(NamedTuple):
    """What a study leaves behind."""

    document: Part
    files: list[Path]
    parts: list[Any]  # tables and lines for the console
    notes: list[str]
    interrupted: bool = False


def run_study(study: Study, setting: Setting) -> None:
    """Run a study, write it into the campaign's folder and print it; exit with code 130 after Ctrl-C."""
    from malta import report
    from malta.campaigns.plan import planned_run
    from malta.campaigns.run import Session, campaign_folder
    from malta.simulation.batch import is_compiled

    if study.limit == "help":
        _print_limits(setting.plan)
        raise typer.Exit
    limit = read_limit(study.limit, setting.plan, setting.bounds)
    what, session = f"{setting.plan.scenario}, {study.name}", Session(setting.workers)
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
        print_text(console, f"{setting.gains}: {report.run_text(setting.plan)}")
        print_text(console, f"{report.box_text(setting.plan)}; seed {setting.plan.seed}")
        for part in outcome.parts:
            console.print(part, soft_wrap=isinstance(part, str))
        print_written(console, outcome.files)
    for note in outcome.notes:
        print_note(note)
    plan = setting.plan
    if not (plan.plant.tabulated or is_compiled(plan.plant, plan.controller, planned_run(plan).scenario)):
        print_note(NO_COMPILER)
    if outcome.interrupted:
        raise typer.Exit(130)


def _rare(limit: Limit, _: float, setting: Setting, progress: Progress | None) -> Outcome:
    """The probability of exceeding a limit."""
    from malta import report
    from malta.campaigns.rare import event_name, rare_event, write_event
    from malta.cli.documents.campaigns import RareOutput, rare_fields

    event = rare_event(setting.plan, limit, workers=setting.workers, progress=progress)
    files = [write_event(event, setting.folder)]
    parts: list[Any] = [report.rare_event_tables(event)]
    if event.design_point is not None:
        place = f"{setting.folder}:{event_name(limit)}"
        parts.append(f"the design point again: malta simulate {setting.gains} --replay {place}")
    notes = [text for text in (report.rare_event_sentence(event),) if text]
    if event.uncertain:
        notes.append(
            f"the failures descend from {event.found.ancestors} of the first runs: the coefficient of variation is "
            "itself uncertain, more --samples make it certain"
        )
    document = RareOutput(**_head(setting, files), **rare_fields(event))
    return Outcome(document, files, parts, notes, event.found.interrupted)


def _sobol(limit: Limit, _: float, setting: Setting, progress: Progress | None) -> Outcome:
    """Which parameter costs yield."""
    from malta import report
    from malta.campaigns.sensitivity import sensitivity, sensitivity_document
    from malta.cli.documents.campaigns import SobolOutput, sobol_fields

    found = sensitivity(setting.plan, limit, workers=setting.workers, progress=progress)
    files = [_write(setting, f"sobol_{limit.slug}.json", sensitivity_document(found))]
    if found.of_yield or any(found.of_merits.values()):
        files.append(setting.folder / f"sobol_{limit.slug}.png")
        report.sensitivity(found, files[-1])
    notes = [text for text in (report.sensitivity_sentence(found),) if text]
    output = SobolOutput(**_head(setting, files), **sobol_fields(found))
    return Outcome(output, files, [report.sensitivity_tables(found)], notes)


def _tolerance(limit: Limit, wanted: float, setting: Setting, progress: Progress | None) -> Outcome:
    """The largest spreads that keep a yield."""
    from malta import report
    from malta.campaigns.tolerance import tolerance_document, tolerances
    from malta.cli.documents.campaigns import ToleranceOutput, tolerance_fields

    found = tolerances(setting.plan, limit, wanted, workers=setting.workers, progress=progress)
    files = [_write(setting, f"tolerance_{limit.slug}.json", tolerance_document(found))]
    notes = [text for text in (report.tolerance_sentence(found),) if text]
    output = ToleranceOutput(**_head(setting, files), **tolerance_fields(found))
    return Outcome(output, files, [report.spreads_table(found)], notes)


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


def read_limit(text: str, plan: Plan, bounds: Bounds) -> Limit:
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
            _, shown = merits_of(plan).get(slug(name), ("", "percent"))
            bound = float(number[1])
            if number[2]:
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
