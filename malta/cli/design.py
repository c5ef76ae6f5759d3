"""`malta design`: design file -> controller -> margins -> main job -> gain files and figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from malta.cli.completion import complete_designs
from malta.cli.inputs import design_files, gains_folder, read_changed_design
from malta.cli.options import AsJson, DesignChanges
from malta.cli.output import make_console, print_document, print_error, print_written, working
from malta.errors import CheckError, InputError
from malta.files import replace_files

if TYPE_CHECKING:
    from malta.cli.documents.simulations import DesignPart
    from malta.margins.loop_report import LoopReport
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Pid, Spec


def design(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Design files; all of design/ if none is named.", autocompletion=complete_designs
        ),
    ] = None,
    change: DesignChanges = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the gain files. [gains/ beside the design file]")
    ] = None,
    figures: Annotated[Path, typer.Option(help="Folder of the figures.")] = Path("build"),
    as_json: AsJson = False,
) -> None:
    """Design controllers: synthesize, verify, simulate, write gain files.

    Gain files are replaced only by a design that is stable on the machine and completes its main job, as the stroke.

    With --set the gain files have the name of the design and its changes, so that those of the unchanged design stand.

    \b
    Example:  malta design design/table2.toml
              malta design design/table2.toml --set m=0.4 --set weights.state.z=2
    """
    designed: list[DesignPart] = []
    sources: dict[Path, Path] = {}  # output file -> the design file of this run that it comes from
    code = 0
    chosen = design_files("design", files)
    for n, file in enumerate(chosen):
        try:
            with working(
                f"designing {file}" + (f" ({n + 1} of {len(chosen)})" if len(chosen) > 1 else "")
            ) as work:
                made = _run_design(file, change, out or gains_folder(file), figures, sources, work.note)
        except (InputError, CheckError) as error:
            code = max(code, print_error(error, file))
            continue
        if as_json:
            designed.append(_document(made, change or ()))
        else:
            _print_design(made)
    if as_json:
        from malta.cli.documents.simulations import DesignOutput

        print_document(DesignOutput(designs=designed))
    raise typer.Exit(code)


class Made(NamedTuple):
    """A design whose gain files stand."""

    name: str
    page: Any
    margins: LoopReport
    result: Experiment
    paths: Sequence[Path]  # gain files
    picture: Path
    unchanged: bool  # the gain files held these numbers already


def _run_design(
    file: Path,
    changes: list[str] | None,
    out: Path,
    figures: Path,
    sources: dict[Path, Path],
    note: Callable[[str], None],
) -> Made:
    """Design, verify and simulate the controller of one design file and write its gain files.

    Raises InputError for a design of a name that `sources` has, CheckError where a check fails; nothing is written
    over a gain file then.
    """
    from malta import gains, report
    from malta.margins.loop_report import require_stable
    from malta.margins.verify import linear_report
    from malta.model.linearize import linearize
    from malta.model.published import published_beside
    from malta.simulation.catalogue import main_job
    from malta.synthesis.lqg import synthesize

    spec = read_changed_design(file, changes)
    plant, job = spec.plant, main_job(spec.plant)
    paths = [out / f"{spec.name}{suffix}" for suffix in gains.SUFFIXES]
    picture = figures / f"{spec.name}_{job}.png"
    for target in (out / f"{spec.name}.json", picture):
        if sources.setdefault(target, file) != file:
            raise InputError(file, "name", repr(spec.name), f"another name than that of {sources[target]}")
    model = linearize(plant, plant.at(**spec.operating_point))
    controller = synthesize(spec, model)
    note("margins")
    margins = linear_report(model, controller, spec.uncertainty)
    try:
        require_stable(margins, str(file))
    except CheckError as error:
        if spec.pid and linear_report(model, synthesize(_with_other_sign(spec, spec.pid), model)).stable:
            raise CheckError(f"{error}; with the other sign of Kp, Ki and Kd it is stable") from error
        raise
    note(job)
    result = _simulate_gain_file(file, spec, controller, margins, job)
    note("figure")
    published = published_beside(spec.machine_file)
    page = report.design_page(spec, model, margins, result, published)
    contents = {picture: report.encode_figure(report.experiment_figure(result, published), picture)}
    unchanged = gains.agrees(controller, margins, *paths)
    if not unchanged:
        contents |= gains.file_contents(controller, margins, *paths)
    replace_files(
        contents
    )  # last, and all at once: whatever fails leaves the old gain files and their figure
    return Made(spec.name, page, margins, result, paths, picture, unchanged)


def _with_other_sign(spec: Spec, pid: Pid) -> Spec:
    """The design with the other sign of its PID gains."""
    return replace(spec, law=replace(pid, Kp=-pid.Kp, Ki=-pid.Ki, Kd=-pid.Kd))


def _document(made: Made, changes: Sequence[str]) -> DesignPart:
    """The design in the JSON document."""
    from malta.cli.documents.simulations import design_part

    return design_part(made.name, (*made.paths, made.picture), changes, made.margins, made.result)


def _print_design(made: Made) -> None:
    """Print the page of a design, and the files."""
    console = make_console()
    console.print(made.page)
    if made.unchanged:
        console.print(f"{made.paths[0]}: holds these numbers already; left as it is", soft_wrap=True)
    print_written(console, (made.picture,) if made.unchanged else (*made.paths, made.picture))
    console.print()


def _simulate_gain_file(
    file: Path, spec: Spec, controller: Controller, margins: LoopReport, job: str
) -> Experiment:
    """Simulate the main job with a gain file that is written for it alone, before a good one is replaced.

    Raises CheckError, naming the design file, when a run ends early; KeyboardInterrupt when Ctrl-C cut it short.
    """
    import tempfile

    from malta import gains
    from malta.simulation.catalogue import experiment

    with tempfile.TemporaryDirectory() as scratch:
        trial = Path(scratch) / f"{spec.name}.json"
        gains.write(controller, margins, trial)
        try:
            written = gains.read(trial)
        except InputError as error:  # of numbers in the design: the user knows of no other file
            raise InputError(file, error.field, error.found, error.expected) from error
        result = experiment(job, spec.plant, written)
    if result.cut:
        raise KeyboardInterrupt
    for case in result.cases:
        end = case.run.verdict
        if not end.completed:
            raise CheckError(f"{file}: the {job} ends at {end.time:.4g} s: {end.name}; gain files unchanged")
    return result
