"""`malta report`: everything about a gain file as one page in HTML."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.assignments import read_uncertainty
from malta.cli.inputs import change_machine, design_of, read_controller
from malta.cli.options import AsJson, Changes, DesignFile, GainFile, MachineFile, Uncertain
from malta.cli.output import (
    interruption,
    make_console,
    print_document,
    print_note,
    print_written,
    progress_bar,
)
from malta.errors import InputError
from malta.files import replace_files

if TYPE_CHECKING:
    from malta.campaigns.summary import Summary
    from malta.report.page.analysis import Subject
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

CAMPAIGNS = Path("build", "campaigns")  # where `malta campaign` keeps its folders


def report(
    gains: GainFile,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The page. [build/NAME_report.html]")
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write the figures as a PDF for a paper too, beside the page.")
    ] = False,
    campaign: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER", help="A campaign of these gains. [those in build/campaigns/ that are of them]"
        ),
    ] = None,
    design: DesignFile = None,
    uncertain: Uncertain = None,
    change: Changes = None,
    no_proof: Annotated[
        bool, typer.Option("--no-proof", help="A first look: no proof of the margins of the parameters.")
    ] = False,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Write a page about a gain file: what it is, margins and where they go, loads, main job, noise, gains.

    One HTML file that needs no network, for light and dark screens and for paper. The same gain file gives the same
    bytes. An unstable loop gets a page that says so, and exit code 1.

    \b
    Example:  malta report design/gains/robust.json --out build/robust.html --pdf
    """
    from malta.margins.loop_report import require_stable
    from malta.report.page.document import SUFFIXES, require_suffix
    from malta.report.page.pdf import pdf_of
    from malta.report.page.report import report_work

    controller = read_controller(gains, machine)
    page_file = require_suffix(out or Path("build") / f"{controller.name}_report.html", *SUFFIXES)
    subject = read_subject(gains, controller, change, uncertain, design)
    with unwritten_progress("report") as progress:
        flown = _campaigns_of(campaign, controller, subject.spec)
        analysis, page = report_work(subject, proof=not no_proof, campaigns=flown, progress=progress)
        contents = {page_file: page.content}
        if pdf:
            contents[page_file.with_suffix(".pdf")] = pdf_of(page)
    replace_files(contents)
    if as_json:
        from malta.cli.documents.pages import report_output

        print_document(report_output(gains, analysis, contents))
    else:
        print_written(make_console(), contents)
    for note in analysis.notes:
        print_note(note)
    require_stable(analysis.report, str(gains))


@contextmanager
def unwritten_progress(what: str) -> Iterator[Callable[[float], None]]:
    """Say how far work is that writes nothing before its end; Ctrl-C ends it with exit code 130."""
    with progress_bar(what) as progress:
        try:
            yield progress
        except KeyboardInterrupt:
            raise interruption("nothing is written") from None


def read_subject(
    gains: Path,
    controller: Controller,
    change: list[str] | None,
    uncertain: list[str] | None,
    design: Path | None,
) -> Subject:
    """Read what a page is about: the machine with its changes, the uncertainty, the design file.

    Raises InputError for a change, a share or a design file that does not fit.
    """
    from malta.model.published import published_figures
    from malta.report.page.report import subject_of

    parameters = change_machine(controller.parameters, change)
    spec = design_of(gains, controller, design)
    subject = subject_of(gains, parameters=parameters, spec=spec, changes=change or ())
    if not uncertain:
        return subject
    box = read_uncertainty(gains, uncertain, parameters, published_figures(subject.plant.name))
    return subject._replace(box=box)


def _campaigns_of(folders: Sequence[Path] | None, controller: Controller, spec: Spec | None) -> list[Summary]:
    """Summarize the campaigns in some folders; without any, those in build/campaigns that are of this controller.

    Raises InputError for a named folder without a campaign, or with one of another controller.
    """
    from malta.campaigns.status import status
    from malta.campaigns.summary import Bounds
    from malta.model.data import plant_of
    from malta.model.published import published_figures

    bounds = Bounds(published_figures(plant_of(controller.parameters).name), spec)
    found = []
    for folder in folders or sorted(path.parent for path in CAMPAIGNS.glob("*/campaign.json")):
        try:
            found.append(status(folder, controller, bounds).summary)
        except InputError:
            if folders:
                raise
    return [summary for summary in found if summary.runs or folders]
