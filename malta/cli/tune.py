"""`malta tune`: the numbers of a design for the specification in its file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.completion import complete_designs
from malta.cli.options import AsJson
from malta.cli.output import interruption, make_console, print_document, print_written, progress_bar, working
from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from malta.margins.loop_report import Outcome
    from malta.synthesis.spec import Spec
    from malta.tuning.search import Effort
    from malta.tuning.tune import Tuned


def tune(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="SPEC",
            help="A design file with [specification] and [search].",
            autocompletion=complete_designs,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Folder of the design file that is found, the trials, the front.")
    ] = Path("build/tuned"),
    check: Annotated[
        bool, typer.Option("--check", help="Only judge the design as it stands in the file.")
    ] = False,
    generations: Annotated[
        int, typer.Option(min=0, help="Of the global search; 0 starts from the file's numbers.")
    ] = 8,
    front: Annotated[
        int, typer.Option(min=0, help="Trials for each number and point of the Pareto front; 0: no front.")
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

    Of an LQG these are weights, bases and noise. Of a PID they are gains, and what its [cost] names is made small.

    The design file that is found is the one that was given, with other numbers. Every trial is kept in the folder: the
    same command goes on where it was ended. Exit code 1 when something asked for is not reached; the nearest design is
    written all the same.

    \b
    Example:  malta tune design/robust.toml --out build/tuned
    """
    from malta.files import file_exists
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
    effort = Effort(generations=generations, front=front)
    tuned = _search(spec, journal, effort, restart=restart)
    files = _write(spec, tuned, target)
    if as_json:
        from malta.cli.documents.others import tune_output

        print_document(tune_output(spec, tuned, files))
    else:
        _print_tables(tuned, files)
    _require_all(tuned.requirements, target)


def _judge(spec: Spec, file: Path, *, as_json: bool) -> None:
    """Print what the design as it stands reaches; raise CheckError when that is not all it is asked for."""
    from malta import report
    from malta.tuning.outcomes import judge

    with working(f"judging {spec.name}"):
        requirements = judge(spec)
    if as_json:
        from malta.cli.documents.loops import RequirementPart
        from malta.cli.documents.others import TuneOutput

        parts = [RequirementPart.of(one) for one in requirements]
        print_document(TuneOutput(design=spec.name, requirements=parts))
    else:
        make_console().print(report.requirements_table(requirements))
    _require_all(requirements, file)


def _search(spec: Spec, journal: Path, effort: Effort, *, restart: bool) -> Tuned:
    """Search the numbers behind a progress bar; Ctrl-C names the journal of the trials and ends with code 130."""
    from malta.tuning.tune import tune as search

    with progress_bar(f"tuning {spec.name}") as progress:
        try:
            return search(spec, journal, effort=effort, restart=restart, progress=progress)
        except KeyboardInterrupt:
            raise interruption(f"the same command goes on from {journal}") from None


def _write(spec: Spec, tuned: Tuned, target: Path) -> list[Path]:
    """Write the design file that was found; beside it the Pareto front where there is one."""
    from malta import report
    from malta.files import replace_files
    from malta.tuning.design_text import design_text

    files = {target: design_text(spec, tuned.trial, target).encode()}
    if not tuned.front:
        replace_files(files)
        return list(files)
    files[target.with_name(f"{target.stem}_front.md")] = report.front_markdown(tuned).encode()
    replace_files(files)
    picture = target.with_name(f"{target.stem}_front.png")
    report.front(tuned, picture)
    return [*files, picture]


def _print_tables(tuned: Tuned, files: Sequence[Path]) -> None:
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
