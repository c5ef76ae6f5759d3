"""`malta design`: design file -> controller -> margins -> main job -> gain files and figure."""

from __future__ import annotations

import ast
import keyword
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from malta.cli.options import (
    AsJson,
    DesignChanges,
    complete_designs,
    design_files,
    gains_folder,
    read_changed_design,
)
from malta.cli.output import (
    interruption,
    make_console,
    print_document,
    print_error,
    print_written,
    progress_bar,
    progress_on,
)
from malta.errors import CheckError, InputError
from malta.files import file_exists, shipped_path
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.cli.documents.campaigns import DesignPart
    from malta.margins.loop_report import LoopReport, Outcome
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller
    from malta.synthesis.filter_check import FilterCheck
    from malta.synthesis.spec import Pid, Spec
    from malta.tuning.search import Effort
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
    as_json: AsJson = False,
) -> None:
    """Design controllers: synthesize, verify, simulate, write gain files.

    A law of [structure] is tuned first, unless the file's numbers hold its goals: `malta tune` writes what it finds.

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
            with progress_on(
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
        from malta.cli.documents.campaigns import DesignOutput

        print_document(DesignOutput(designs=designed))
    raise typer.Exit(code)


class Made(NamedTuple):
    """A design whose gain files stand."""

    name: str
    page: Any
    margins: LoopReport
    result: Experiment
    observer: FilterCheck | None  # of an LQG
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
    replace_files(contents)  # last, all at once: whatever fails leaves the old gain files and their figure
    return Made(spec.name, page, margins, result, observer, paths, picture, unchanged)


def _with_other_sign(spec: Spec, pid: Pid) -> Spec:
    """The design with the other sign of its PID gains."""
    return replace(spec, law=replace(pid, Kp=-pid.Kp, Ki=-pid.Ki, Kd=-pid.Kd))


def _document(made: Made, changes: Sequence[str]) -> DesignPart:
    """The design in the JSON document."""
    from malta.cli.documents.campaigns import ObserverPart, design_part

    files = (*made.paths, made.picture)
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
    if result.cut:
        raise KeyboardInterrupt
    for case in result.cases:
        end = case.run.verdict
        if not end.completed:
            raise CheckError(f"{file}: the {job} ends at {end.time:.4g} s: {end.words}; gain files unchanged")
    return result


# `malta new`: a folder with a machine of one's own that runs at once.


EXAMPLE = "ball"  # the folder of examples/ that a new machine begins as
NEXT_STEPS = """
Try it, from the folder {name}/:
    malta design
    malta verify design/gains/{name}.json --machine {name}.py
    malta simulate design/gains/{name}.json --machine {name}.py --scenario step --out build
    python notebook.py

Then make it yours:
    {name}.py           parameters with units, and x' = f(x, u, w), y = h(x, u)
    {name}.toml         values, each with its unit and where it comes from
    design/{name}.toml  weights, noise, and how far parameters vary
    test_{name}.py      numbers that you know by another way
"""


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the machine: letters, digits and _.")],
) -> None:
    """Write a folder NAME with a machine that runs at once, a levitated sphere, and say what to change.

    \b
    Example:  malta new rotor
    """
    from malta.model.machines import machine_names

    folder = Path(name)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError("malta new", "NAME", repr(name), "small letters, digits and _, as rotor")
    if name in machine_names():
        raise InputError(
            "malta new", "NAME", repr(name), "another name than that of a machine that malta has"
        )
    if folder.exists():
        raise InputError(folder, "", "a file or folder of that name", "a name that is free here")
    source = shipped_path("examples", EXAMPLE)
    files = [
        path for path in sorted(source.rglob("*")) if path.suffix in (".py", ".toml") and _is_source(path)
    ]
    if name in _taken_names(files):
        found = f"{name!r}, which Python, the module or the notebook has for something else"
        raise InputError("malta new", "NAME", found, "another name")
    renamed = {
        folder / path.relative_to(source).with_name(path.name.replace(EXAMPLE, name)): path for path in files
    }
    replace_files(
        {
            target: re.sub(
                rf"(?<![A-Za-z]){EXAMPLE}(?![A-Za-z])", name, path.read_text(encoding="utf-8")
            ).encode()
            for target, path in renamed.items()
        }
    )
    console = make_console()
    print_written(console, renamed)
    console.print(NEXT_STEPS.format(name=name), soft_wrap=True)  # commands stay whole, to be copied


def _taken_names(files: Sequence[Path]) -> set[str]:
    """Names under which a copy of these files would not work: words of Python, modules, and what the files name."""
    texts = [path.read_text(encoding="utf-8") for path in files if path.suffix == ".py"]
    trees = [node for text in texts for node in ast.walk(ast.parse(text))]
    own = {node.id for node in trees if isinstance(node, ast.Name)}
    own |= {node.arg for node in trees if isinstance(node, ast.arg | ast.keyword) and node.arg}
    own |= {path.stem for path in files}
    installed = set(packages_distributions()) | set(sys.stdlib_module_names)
    return (own | installed | set(keyword.kwlist)) - {EXAMPLE}


def _is_source(path: Path) -> bool:
    return not {"build", "gains", "__pycache__"} & set(
        path.parts[len(shipped_path("examples", EXAMPLE).parts) :]
    )


# `malta tune`: the numbers of a design for the specification in its file.


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
    as_json: AsJson = False,
) -> None:
    """Find the numbers of a design for what its file asks for: margin, bandwidth, noise, experiments.

    Of an LQG these are weights, bases and noise. Of a PID they are gains, and what its [cost] names is made small. Of a
    law of [structure] they are the numbers of its elements, tuned on [goals] and [specification] until the margin is
    proven, in a minute and without trials.

    The design file that is found is the one that was given, with other numbers. Every trial is kept in the folder: the
    same command goes on where it was ended. Exit code 1 when something asked for is not reached; the nearest design is
    written all the same.

    \b
    Example:  malta tune design/robust.toml --out build/tuned
    """
    from malta.synthesis.design_file import read_design
    from malta.tuning.search import Effort

    spec = read_design(file)
    if not (spec.specification or spec.recovery):
        expected = "this table: what the design has to reach, as margin = 3"
        raise InputError(file, "specification", "nothing", expected)
    if check:
        _judge(spec, file, as_json=as_json)
        return
    target, journal = out / f"{spec.name}.toml", out / f"{spec.name}_trials.jsonl"
    if target.resolve() == spec.path.resolve() and not overwrite:
        raise InputError(target, "", "the design file that was given", "another --out, or --overwrite")
    if file_exists(target) and not overwrite:
        raise InputError(target, "", "a design file", "another --out, or --overwrite")
    if spec.structure is not None:
        _tune_structure(spec, target, as_json=as_json)
        return
    effort = Effort(generations=generations, front=front)
    tuned = _search(spec, journal, effort, restart=restart)
    files = _write(spec, tuned, target)
    if as_json:
        from malta.cli.documents.others import tune_output

        print_document(tune_output(spec, tuned, files))
    else:
        _print_tables(tuned, files)
    _require_all(tuned.requirements, target)


def _tune_structure(spec: Spec, target: Path, *, as_json: bool) -> None:
    """Tune the elements of a law, write the design file that is found, and judge it."""
    from malta import report
    from malta.structured.design import structured_text, tune_design
    from malta.tuning.judging import judge

    with progress_on(f"tuning {spec.name}") as work:
        found = tune_design(spec, note=work.note)
        replace_files({target: structured_text(found.spec, target).encode()})
        work.note("requirements")
        requirements = judge(found.spec)
    if as_json:
        from malta.cli.documents.loops import RequirementPart
        from malta.cli.documents.others import TuneOutput

        parts = [RequirementPart.of(one) for one in requirements]
        print_document(TuneOutput(design=spec.name, files=[str(target)], requirements=parts))
    else:
        console = make_console()
        console.print(found.tuned.certificate, soft_wrap=True)
        console.print(report.requirements_table(requirements))
        print_written(console, [target])
    _require_all(requirements, target)


def _judge(spec: Spec, file: Path, *, as_json: bool) -> None:
    """Print what the design as it stands reaches; raise CheckError when that is not all it is asked for."""
    from malta import report
    from malta.tuning.judging import judge

    with progress_on(f"judging {spec.name}"):
        requirements = judge(spec)
    if as_json:
        from malta.cli.documents.loops import RequirementPart
        from malta.cli.documents.others import TuneOutput

        parts = [RequirementPart.of(one) for one in requirements]
        print_document(TuneOutput(design=spec.name, requirements=parts))
    else:
        make_console().print(report.requirements_table(requirements))
    _require_all(requirements, file)


def _search(spec: Spec, journal: Path, effort: Effort, *, restart: bool) -> TuningResult:
    """Search the numbers behind a progress bar; Ctrl-C names the journal of the trials and ends with code 130."""
    from malta.tuning.tune import tune as search

    with progress_bar(f"tuning {spec.name}") as progress:
        try:
            return search(spec, journal, effort=effort, restart=restart, progress=progress)
        except KeyboardInterrupt:
            raise interruption(f"the same command goes on from {journal}") from None


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
    console.print(report.requirements_table(tuned.requirements))
    print_written(console, files)


def _require_all(requirements: Sequence[Outcome], file: Path) -> None:
    """Raise CheckError when a requirement is not reached: which, by how much, and which binds most."""
    failed = sorted((r for r in requirements if not r.holds), key=lambda r: -r.ratio)
    if failed:
        text = "; ".join(map(str, failed))
        raise CheckError(f"{file}: not reached: {text} ({failed[0].name.replace('_', ' ')} binds most)")
