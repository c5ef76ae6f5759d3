"""`malta design`: design file -> controller -> margins -> main job -> gain files and figure."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from malta.cli.options import (
    AsJson,
    DesignChanges,
    WholeTime,
    complete_designs,
    design_files,
    gains_folder,
    read_changed_design,
)
from malta.cli.output import (
    end_early,
    interruption,
    make_console,
    print_document,
    print_error,
    print_note,
    print_written,
    require_whole,
    work_until,
)
from malta.errors import CheckError, InputError
from malta.files import file_exists
from malta.work import is_stopped, share_time
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.cli.documents.campaigns import DesignPart
    from malta.margins.loop_report import LoopReport
    from malta.margins.outcome import Outcome
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller
    from malta.synthesis.filter_check import FilterCheck
    from malta.synthesis.spec import Pid, Spec
    from malta.tuning.tune import TuningResult


def design(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[DESIGN]...",
            help="Design files; all of design/ if none is named.",
            autocompletion=complete_designs,
        ),
    ] = None,
    change: DesignChanges = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder of the gain files. [gains/ beside the design file]"),
    ] = None,
    figures: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the figures.")] = Path("build"),
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Design controllers: synthesize, verify, simulate, write gain files.

    A law of [structure] is tuned first, unless the file's numbers hold its goals: `malta tune` writes what it finds.

    Gain files are replaced only by a design that is stable on the machine and completes its main job, as the stroke.

    At the end of --time, or at Ctrl-C, the design that is being made is shown as far as it is known, and others are
    named. Its gain files stand as they were.

    With --set the gain files have the name of the design and its changes, so that those of the unchanged design stand.

    \b
    Example:  malta design design/table2.toml
              malta design design/table2.toml --set m=0.4 --set weights.state.z=2
    """
    designed: list[DesignPart] = []
    sources: dict[Path, Path] = {}  # output file -> the design file of this run that it comes from
    code, left, pressed = 0, list[str](), list[float]()  # files whose designs are not whole; when Ctrl-C was
    chosen, end = design_files("design", files), math.inf if time is None else monotonic() + time
    for n, file in enumerate(chosen):
        what = f"designing {file}" + (f" ({n + 1} of {len(chosen)})" if len(chosen) > 1 else "")
        if pressed or (n and monotonic() > end):
            left.append(str(file))
            continue
        try:
            with work_until(what, None if time is None else end - monotonic()) as work:
                pressed = work.pressed
                made = _run_design(file, change, out or gains_folder(file), figures, sources, work.step)
        except (InputError, CheckError) as error:
            code = max(code, print_error(error, file))
            continue
        left += [] if made.paths else [str(file)]
        if as_json:
            designed.append(_document(made, change or ()))
        else:
            _print_design(made)
    if as_json:
        from malta.cli.documents.campaigns import DesignOutput

        print_document(DesignOutput(designs=designed))
    if left:
        whole = f"{len(chosen) - len(left)} of {len(chosen)} designs are whole"
        end_early(pressed, f"{whole}; gain files stand as they were of {' '.join(left)}")
    raise typer.Exit(code)


class Made(NamedTuple):
    """A design whose gain files stand."""

    name: str
    page: Any
    margins: LoopReport
    result: Experiment
    observer: FilterCheck | None  # of an LQG
    paths: Sequence[Path]  # gain files; none where the main job was cut short
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
    """Design, verify and simulate the controller of one design file; write its gain files where nothing was cut short.

    Raises InputError for a design of a name that `sources` has, CheckError where a check fails; nothing is written
    over a gain file then.
    """
    from malta import gains, report
    from malta.gains.writing import require_stable
    from malta.margins.verify import linear_report
    from malta.model.linearize import linearize
    from malta.model.printed import published_beside
    from malta.simulation.experiments.catalogue import main_job
    from malta.synthesis.synthesize import synthesize

    spec = read_changed_design(file, changes)
    if spec.structure is not None:
        from malta.structured.design import tune_design

        spec = tune_design(spec, keep=True, note=note).spec
    plant, job = spec.plant, main_job(spec.plant)
    paths = [out / f"{spec.name}{suffix}" for suffix in gains.SUFFIXES]
    picture = figures / f"{spec.name}_{job}.png"
    for target in (out / f"{spec.name}.json", picture):
        if sources.setdefault(target, file) != file:
            raise InputError(file, "name", repr(spec.name), f"another name than that of {sources[target]}")
    model = linearize(plant, plant.at(**spec.operating_point))
    controller = synthesize(spec, model)
    observer = None
    if spec.kind == "LQG":
        from malta.synthesis.filter_check import check_filter

        observer = check_filter(spec, model, controller)
    note("margins")
    with share_time(MARGIN_SHARE):
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
    if result.cut or is_stopped():
        return Made(spec.name, page, margins, result, observer, (), picture, unchanged=True)
    contents = {picture: report.encode_figure(report.experiment_figure(result, published), picture)}
    unchanged = gains.agrees(controller, margins, *paths)
    if not unchanged:
        contents |= gains.file_contents(controller, margins, *paths)
    replace_files(contents)  # last, all at once: whatever fails leaves the old gain files and their figure
    return Made(spec.name, page, margins, result, observer, paths, picture, unchanged)


def _with_other_sign(spec: Spec, pid: Pid) -> Spec:
    """The design with the other sign of its PID gains."""
    return replace(spec, law=replace(pid, Kp=-pid.Kp, Ki=-pid.Ki, Kd=-pid.Kd))


def _document(made: Made, changes: Sequence[str]) -> DesignPart:
    """The design in the JSON document."""
    from malta.cli.documents.campaigns import ObserverPart, design_part

    files = (*made.paths, made.picture) if made.paths else ()
    observer = None if made.observer is None else ObserverPart.of(made.observer)
    return design_part(made.name, files, made.margins, made.result, changes=list(changes), observer=observer)


def _print_design(made: Made) -> None:
    """Print the page of a design, and the files."""
    console = make_console()
    console.print(made.page)
    if made.observer is not None:
        samples, apart, _ = made.observer
        console.print(
            f"Gains by python-control; filterpy's filter agrees to {apart:.0e} ({samples} samples)."
        )
    if not made.paths:
        return
    if made.unchanged:
        console.print(f"{made.paths[0]}: holds these numbers already; left as it is", soft_wrap=True)
    print_written(console, (made.picture,) if made.unchanged else (*made.paths, made.picture))
    console.print()


def _simulate_gain_file(
    file: Path, spec: Spec, controller: Controller, margins: LoopReport, job: str
) -> Experiment:
    """Simulate the main job with a gain file that is written for it alone, before a good one is replaced.

    Raises CheckError, naming the design file, when a run ends early by itself.
    """

    from malta import gains
    from malta.gains.stable import read_stable
    from malta.simulation.experiments.catalogue import experiment

    with tempfile.TemporaryDirectory() as scratch:
        trial = Path(scratch) / f"{spec.name}.json"
        gains.write(controller, margins, trial)
        try:
            written = read_stable(trial)
        except InputError as error:  # of numbers in the design: the user knows of no other file
            raise InputError(file, error.field, error.found, error.expected) from error
        result = experiment(job, spec.plant, written)
    for case in result.cases:
        end = case.run.verdict
        if not (end.completed or end.name == "interrupted"):
            raise CheckError(f"{file}: the {job} ends at {end.time:.4g} s: {end.words}; gain files unchanged")
    return result


# `malta tune`: the numbers of a design for the specification in its file.


MARGIN_SHARE = 0.5  # of the time of `malta design`; the rest is for the main job
SEARCH_SHARE = 0.7  # of the time of `malta tune`; the rest is for the proof and the flights


def tune(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="DESIGN",
            help="A design file with [specification] and [search].",
            autocompletion=complete_designs,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FOLDER", help="Folder of the design file that is found, the trials, the front."
        ),
    ] = Path("build/tuned"),
    check: Annotated[
        bool, typer.Option("--check", help="Only judge the design as it stands in the file.")
    ] = False,
    generations: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, help="Generations of the global search; 0 starts from the file's numbers."
        ),
    ] = 8,
    front: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, help="Trials for each number and point of the Pareto front; 0: no front."
        ),
    ] = 12,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a design file of that name.")
    ] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="Forget the trials of an earlier search.")
    ] = False,
    time: WholeTime = None,
    as_json: AsJson = False,
) -> None:
    """Find the numbers of a design for what its file asks for: margin, bandwidth, noise, experiments.

    Of an LQG these are weights, bases and noise. Of a PID they are gains, and what its [cost] names is made small. Of a
    law of [structure] they are the numbers of its elements, tuned on [goals] and [specification] until the margin is
    proven, in a minute and without trials.

    The design file that is found is the one that was given, with other numbers. Every trial is kept in the folder: the
    same command goes on where it was ended, by Ctrl-C or --time, which write the best design by then. Exit code 1 when
    something asked for is not reached; the nearest design is written all the same.

    \b
    Example:  malta tune design/robust.toml --out build/tuned
    """
    from malta.synthesis.design_file import read_design
    from malta.tuning.search import Effort
    from malta.tuning.tune import tune as search

    spec = read_design(file)
    if not (spec.specification or spec.recovery):
        expected = "this table: what the design has to reach, as margin = 3"
        raise InputError(file, "specification", "nothing", expected)
    if check:
        _judge(spec, file, time, as_json=as_json)
        return
    target, journal = out / f"{spec.name}.toml", out / f"{spec.name}_trials.jsonl"
    if target.resolve() == spec.path.resolve() and not overwrite:
        raise InputError(target, "", "the design file that was given", "another --out, or --overwrite")
    if file_exists(target) and not overwrite:
        raise InputError(target, "", "a design file", "another --out, or --overwrite")
    if spec.structure is not None:
        _tune_structure(spec, target, time, as_json=as_json)
        return
    effort = Effort(generations=generations, front=front)
    goes_on = f"the same command goes on from {journal}"
    with work_until(f"tuning {spec.name}", time, goes_on) as work:
        share = None if time is None else SEARCH_SHARE * time
        tuned = search(spec, journal, effort=effort, restart=restart, time=share, progress=work.report)
    files = _write(spec, tuned, target)
    if as_json:
        from malta.cli.documents.others import tune_output

        print_document(tune_output(spec, tuned, files))
    else:
        _print_tables(tuned, files)
    if work.pressed:
        raise interruption(f"{target} is the best design by then; with --overwrite {goes_on}")
    _require_all(spec, tuned.requirements, target)


def _tune_structure(spec: Spec, target: Path, time: float | None, *, as_json: bool) -> None:
    """Tune the elements of a law, write the design file that is found, and judge it."""
    from malta import report
    from malta.structured.design import structured_text, tune_design
    from malta.tuning.judging import judge

    with work_until(f"tuning {spec.name}", time) as work:
        with share_time(SEARCH_SHARE):
            found = tune_design(spec, note=work.step)
        replace_files({target: structured_text(found.spec, target).encode()})
        work.step("requirements")
        requirements = () if is_stopped() else judge(found.spec)
    if as_json:
        from malta.cli.documents.loops import RequirementPart
        from malta.cli.documents.others import TuneOutput

        parts = [RequirementPart.of(one) for one in requirements]
        print_document(TuneOutput(design=spec.name, files=[str(target)], requirements=parts))
    else:
        console = make_console()
        console.print(found.tuned.certificate, soft_wrap=True)
        if requirements:
            console.print(report.requirements_table(requirements))
        print_written(console, [target])
    if work.pressed:
        raise interruption(f"{target} is the best design by then")
    _require_all(spec, requirements, target)


def _judge(spec: Spec, file: Path, time: float | None, *, as_json: bool) -> None:
    """Print what the design as it stands reaches; raise CheckError when that is not all it is asked for."""
    from malta import report
    from malta.tuning.judging import judge

    with work_until(f"judging {spec.name}", time) as work:
        requirements = judge(spec)
    if as_json:
        from malta.cli.documents.loops import RequirementPart
        from malta.cli.documents.others import TuneOutput

        parts = [RequirementPart.of(one) for one in requirements]
        print_document(TuneOutput(design=spec.name, requirements=parts))
    else:
        make_console().print(report.requirements_table(requirements))
    require_whole(work)
    _require_all(spec, requirements, file)


def _write(spec: Spec, tuned: TuningResult, target: Path) -> list[Path]:
    """Write the design file that was found; beside it the Pareto front where there is one."""
    from malta import report
    from malta.tuning.design_text import design_text

    files = {target: design_text(spec, tuned.trial, target).encode()}
    if not tuned.front:
        replace_files(files)
        return list(files)
    files[target.with_name(f"{target.stem}_front.md")] = report.front_markdown(tuned).encode()
    replace_files(files)
    picture = target.with_name(f"{target.stem}_front.png")
    report.front_figure(tuned, picture)
    return [*files, picture]


def _print_tables(tuned: TuningResult, files: Sequence[Path]) -> None:
    """Print the Pareto front where there is one, the requirements, and the files."""
    from malta import report

    console = make_console()
    if tuned.front:
        console.print(report.front_table(tuned))
    if tuned.requirements:
        console.print(report.requirements_table(tuned.requirements))
    print_written(console, files)


def _require_all(spec: Spec, requirements: Sequence[Outcome], file: Path) -> None:
    """Print what there was no time to judge; raise CheckError for what is not reached, and which of it binds most."""
    from malta.tuning.outcomes import open_entries

    left = open_entries(spec.specification, requirements)
    if left:
        print_note(f"{file}: no time was left to judge {' '.join(left)}; malta tune {file} --check does")
    failed = sorted((r for r in requirements if not r.holds), key=lambda r: -r.ratio)
    if failed:
        text = "; ".join(map(str, failed))
        raise CheckError(f"{file}: not reached: {text} ({failed[0].name.replace('_', ' ')} binds most)")
