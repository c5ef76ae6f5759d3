"""The command line: it reads arguments, calls the same functions as a notebook, and prints their records."""

from __future__ import annotations

import gc
import io
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from malta.plant import Parameters
    from malta.simulate import StrokeFigures, Trajectory
    from malta.verify import Margins

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
    help="""Controllers for self-bearing and magnetically levitated actuators: from a machine's data to verified
    gain files, and a nonlinear simulation that consumes them.

    Exit codes: 0 fine; 1 a check failed (unstable, touched down), old gain files stand; 2 bad input.""",
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"malta {version('malta')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_version, help="Show the version.")
    ] = False,
) -> None:
    pass


AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of tables.")]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Change a parameter of the machine: m=0.56 (SI) or l_B=45mm."
    ),
]
GainFile = Annotated[Path, typer.Argument(metavar="GAINS", help="A gain file: .json, .npz or .mat.")]


@app.command()
def design(
    files: Annotated[
        list[Path] | None, typer.Argument(help="Design files; all of design/ if none is named.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the gain files. [gains/ beside the design file]")
    ] = None,
    figures: Annotated[Path, typer.Option(help="Folder of the figures.")] = Path("build"),
    as_json: AsJson = False,
) -> None:
    """Design controllers: synthesize, verify, simulate, write gain files.

    Gain files are replaced only by a design that is stable on the machine and completes the stroke.

    \b
    Example:  malta design design/table2.toml
    """
    chosen = files or sorted(Path("design").glob("*.toml"))
    if not chosen:
        raise InputError(
            "design", "", "no design files (*.toml) here", "a folder design/ with some, or their names"
        )
    results: list[dict[str, Any]] = []
    made: dict[Path, Path] = {}  # which design file wrote which gain file in this run
    worst = 0
    for file in _progress(chosen, "designing", quiet=as_json):
        try:
            results.append(_design(file, out or file.parent / "gains", figures, made, quiet=as_json))
        except (InputError, CheckError) as error:
            worst = max(worst, _complain(error, file))
    if as_json:
        _print_json(results)
    raise typer.Exit(worst)


@app.command()
def verify(gains: GainFile, change: Changes = None, as_json: AsJson = False) -> None:
    """Verify a gain file on the machine, stage by stage.

    Poles, bandwidths by definition, peak sensitivities with their ISO 14839-3 zones.

    The machine is the one in the file, with the changes given by --set (m, K_A, K_B, l_B, F_c, T_d, ... as far as
    they shape the linear loop; windings and DC link do not).

    \b
    Example:  malta verify design/gains/calibrated.json --set m=0.56
    """
    from malta import gains as gain_files
    from malta.data import plant_of
    from malta.linearize import linearize
    from malta.verify import require_stable
    from malta.verify import verify as verified

    controller = gain_files.read(gains)
    plant = plant_of(_changed(controller.parameters, change))
    names = [s.name for s in plant.design_states]
    point = plant.at(**dict(zip(names, controller.operating_point[0].tolist(), strict=True)))
    model = linearize(plant, point)
    try:
        margins = verified(model, controller)
    except CheckError as error:
        raise CheckError(f"{gains}: {error}") from error
    if as_json:
        _print_json({"gains": str(gains), "design": controller.name} | _margins(margins))
    else:
        from malta import report

        console, published = _console(), _published(plant.name)
        console.print(
            f"{gains}: {controller.name}, {plant.name}, preset {controller.parameters.preset}",
            *(change or ()),
        )
        for table in (
            report.poles_table(model, None if change else published),
            report.loop_poles_table(margins),
            report.bandwidth_table(margins, published),
            report.sensitivity_table(margins),
        ):
            console.print(table)
    require_stable(margins, str(gains))


@app.command()
def simulate(
    gains: GainFile,
    scenario: Annotated[str, typer.Option(help="What to simulate: stroke.")] = "stroke",
    change: Changes = None,
    distance: Annotated[float, typer.Option(help="Stroke [mm].")] = 10.0,
    rise: Annotated[
        float | None, typer.Option(help="Rise of the reference, 10-90 % [ms]. [the published 16.2]")
    ] = None,
    profile: Annotated[str, typer.Option(help="Reference: logistic or quintic.")] = "logistic",
    noise: Annotated[float, typer.Option(help="Sensor noise in multiples of the machine's; 0: none.")] = 0.0,
    quantize: Annotated[bool, typer.Option(help="Sensors with the machine's resolution.")] = False,
    delay: Annotated[int | None, typer.Option(help="Samples of delay. [the machine's]")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the figure (.png) and the time series (.npz).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate the nonlinear machine with a gain file.

    The machine is the one in the file, with the changes given by --set; the controller does not learn of them.

    \b
    Example:  malta simulate design/gains/calibrated.json --scenario stroke --set m=0.56 --noise 1 --out build
    """
    from malta import gains as gain_files
    from malta.data import plant_of
    from malta.simulate import RISE, Scenario, stroke_figures
    from malta.simulate import save as save_series
    from malta.simulate import simulate as simulated

    if scenario != "stroke":
        raise InputError("simulate", "--scenario", repr(scenario), "stroke")
    controller = gain_files.read(gains)
    plant = plant_of(_changed(controller.parameters, change))
    asked = Scenario.stroke(
        distance * 1e-3,
        rise=RISE if rise is None else rise * 1e-3,
        profile=profile,  # type: ignore[arg-type]  # checked by references.stroke, with a sentence
        noise=noise,
        quantize=quantize,
        delay=delay,
        seed=seed,
    )
    run = simulated(plant, controller, asked)
    figures = stroke_figures(run)
    published = _published(plant.name) if distance == 10.0 and rise is None else None  # of that stroke
    files: list[Path] = []
    if out is not None:
        from malta import report

        stem = out / f"{controller.name}_{scenario}"
        files = [
            save_series(run, stem.with_suffix(".npz")),
            report.stroke(run, stem.with_suffix(".png"), published),
        ]
    if as_json:
        _print_json(
            {"gains": str(gains), "scenario": scenario, "files": [str(f) for f in files]}
            | _stroke(run, figures)
        )
    else:
        from malta import report

        console = _console()
        console.print(
            f"{gains}: {scenario}", *(change or ()), f"-> {run.verdict.name} at {run.verdict.time:.4g} s"
        )
        console.print(report.stroke_table(figures, published))
        for file in files:
            console.print(f"wrote {file}", soft_wrap=True)
    if not run.verdict.completed:
        raise CheckError(f"{gains}: {scenario}: {run.verdict.name} at {run.verdict.time:.4g} s")


def main() -> None:
    """Entry point: errors become one sentence and an exit code."""
    # Numeric libraries make many lasting objects; going through them again and again costs a sixth of the time.
    gc.set_threshold(200_000, 50, 50)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters shows ? and goes on
    try:
        app()
    except (InputError, CheckError) as error:
        sys.exit(_complain(error))
    except ArithmeticError as error:
        sys.exit(_complain(CheckError(f"numbers beyond what can be computed ({error})")))
    finally:
        gc.freeze()  # the process ends: no last walk through what the system takes back at once


def _design(file: Path, out: Path, figures: Path, made: dict[Path, Path], *, quiet: bool) -> dict[str, Any]:
    """The main job for one design file."""
    import tempfile

    from malta import gains as gain_files
    from malta import report
    from malta.data import published as published_of
    from malta.linearize import linearize
    from malta.simulate import Scenario, stroke_figures
    from malta.simulate import simulate as simulated
    from malta.spec import read_design
    from malta.synthesize import synthesize
    from malta.verify import require_stable
    from malta.verify import verify as verified

    spec = read_design(file)
    picture = figures / f"{spec.name}_stroke.png"
    for target in (out / f"{spec.name}.json", picture):
        if made.setdefault(target, file) != file:
            raise InputError(file, "name", repr(spec.name), f"another name than that of {made[target]}")
    plant = spec.plant
    model = linearize(plant, plant.at(**spec.operating_point))
    controller = synthesize(spec, model)
    margins = verified(model, controller, spec.uncertainty)
    require_stable(margins, str(file))
    # The harness consumes the gain file before it replaces a good one.
    with tempfile.TemporaryDirectory() as scratch:
        trial = Path(scratch) / f"{spec.name}.json"
        gain_files.write(controller, margins, trial)
        run = simulated(plant, gain_files.read(trial), Scenario.stroke())
    if not run.verdict.completed:
        raise CheckError(
            f"{file}: the stroke ends at {run.verdict.time:.4g} s: {run.verdict.name}; gain files unchanged"
        )
    published = published_of(spec.machine_file)
    stroke = stroke_figures(run)
    page = report.design_page(spec, model, margins, stroke, published)
    report.stroke(run, picture, published)
    paths = [out / f"{spec.name}{suffix}" for suffix in gain_files.SUFFIXES]
    gain_files.write(controller, margins, *paths)  # last: whatever fails before leaves the old files
    if not quiet:
        console = _console()
        console.print(page)
        for path in (*paths, picture):
            console.print(f"wrote {path}", soft_wrap=True)
        console.print()
    return (
        {"design": spec.name, "files": [str(p) for p in (*paths, picture)]}
        | _margins(margins)
        | _stroke(run, stroke)
    )


def _changed(parameters: Parameters, changes: list[str] | None) -> Parameters:
    """The parameters with `NAME=VALUE` applied; a unit may follow the value."""
    import re
    from dataclasses import replace

    from malta.data import to_si, units_of

    units = units_of(parameters)
    values: dict[str, float] = {}
    for change in changes or ():
        match = re.fullmatch(r"\s*(\w+)\s*=\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", change)
        if match is None:
            raise InputError("--set", "", repr(change), "NAME=VALUE, as m=0.56 or l_B=45mm")
        name, number, unit = match.groups()
        if name not in units:
            raise InputError("--set", name, "an unknown parameter", "one of " + " ".join(units))
        values[name] = to_si(float(number), unit or units[name], units[name], "--set", name)
    try:
        preset = f"{parameters.preset}, changed" if values else parameters.preset
        return replace(parameters, **values, preset=preset)
    except InputError as error:
        raise InputError("--set", error.field, error.found, error.expected) from error


def _published(machine: str) -> dict[str, Any] | None:
    """What the machine's paper prints, when the command runs where data/ is."""
    from malta.data import published

    file = Path("data") / f"{machine}.toml"
    printed = file.parent / "published" / file.name
    if printed.exists():
        return published(file)
    print(f"malta: no {printed} here: published figures are left out", file=sys.stderr)
    return None


def _margins(margins: Margins) -> dict[str, Any]:
    return {
        "stable": margins.stable,
        "poles": margins.poles.pairs(),
        "bandwidth": dict(margins.bandwidth),
        "peak_sensitivity": {stage.name: dict(stage.peak_sensitivity) for stage in margins.stages},
    }


def _stroke(run: Trajectory, figures: StrokeFigures) -> dict[str, Any]:
    from dataclasses import asdict

    return {"verdict": run.verdict._asdict(), "stroke": asdict(figures)}


def _print_json(content: Any) -> None:
    def finite(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: finite(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [finite(entry) for entry in value]
        return None if isinstance(value, float) and value != value else value

    print(json.dumps(finite(content), indent=1, allow_nan=False))


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal or console.width > 100:
        console.width = 100
    return console


def _progress(files: list[Path], what: str, *, quiet: bool) -> Any:
    """A progress bar on a terminal's standard error when there is more than one file."""
    if quiet or len(files) < 2 or not sys.stderr.isatty():
        return files
    from rich.console import Console
    from rich.progress import track

    return track(files, what, console=Console(stderr=True), transient=True)


def _complain(error: InputError | CheckError, file: Path | None = None) -> int:
    """Print one line, naming the file of a failed check; the exit code."""
    failed, text = isinstance(error, CheckError), str(error)
    print(
        f"malta: {file}: {text}" if failed and file and str(file) not in text else f"malta: {text}",
        file=sys.stderr,
    )
    return 1 if failed else 2


if __name__ == "__main__":
    main()
