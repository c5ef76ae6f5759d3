"""The status of a campaign's folder, and what `malta campaign` prints of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from malta.cli.inputs import design_of, read_controller
from malta.cli.output import make_console, print_document, print_line, print_note, print_text, progress_bar
from malta.cli.patience import duration_text
from malta.errors import InputError

if TYPE_CHECKING:
    from malta.campaigns.status import Status
    from malta.campaigns.summary import Summary


def print_tables(gains: Path, found: Summary, worst: int) -> None:
    """Print what was flown, the yield, the distributions and the worst runs; only the first without runs."""
    from malta import report

    plan, console = found.plan, make_console()
    print_text(console, f"{gains}: {report.run_text(plan)}, {found.runs} of {plan.samples} machines")
    print_text(console, f"{report.box_text(plan)}; {plan.sampler}, seed {plan.seed}")
    if not found.runs:
        return
    console.print(report.campaign_tables(found, worst=worst))
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
    from malta.campaigns.status import status as status_of
    from malta.campaigns.store import noted_gains
    from malta.campaigns.summary import Bounds
    from malta.model.data import plant_of
    from malta.model.published import published_figures

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
    bounds = Bounds(published, design_of(gains, controller, options.design))
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
