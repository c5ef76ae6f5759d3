"""The command line: it reads arguments, calls the same functions as a notebook, and prints their records."""

from __future__ import annotations

import gc
import io
import json
import math
import os
import re
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from malta.campaigns.campaign import Campaign
    from malta.campaigns.plan import Sampler
    from malta.margins.robust import Margin
    from malta.margins.stages import Robustness
    from malta.margins.verify import CurrentLoops, Margins
    from malta.model.plant import Parameters, Plant
    from malta.simulation.experiments import Experiment
    from malta.simulation.simulate import EngineChoice
    from malta.synthesis.controller import Controller
    from malta.tuning.search import Requirement

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
SCENARIOS = "one of the machine's own, which `--scenario help` lists. [its first]"
# Options of a run, in `simulate` and in `campaign`.
Distance = Annotated[float | None, typer.Option(help="Length of a stroke [mm]. [the scenario's]")]
Rise = Annotated[float | None, typer.Option(help="Rise of its reference, 10-90 % [ms]. [the scenario's]")]
ProfileName = Annotated[str | None, typer.Option(help="Its reference: logistic or quintic. [the scenario's]")]
Own = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Any other option that `--scenario help` lists: radius=0.1mm, masses=50g,100g, during=hold, ...",
    ),
]
FidelityName = Annotated[
    str | None,
    typer.Option(
        help="What makes the forces: force (first-order lags), dq (PI loops), phase. [the scenario's]"
    ),
]
Noise = Annotated[
    float | None, typer.Option(help="Sensor noise in multiples of the machine's. [the scenario's]")
]
Quantize = Annotated[
    bool | None, typer.Option(help="Sensors with the machine's resolution. [the scenario's]")
]
Bearing = Annotated[
    bool | None,
    typer.Option(help="Touchdown bearings push back, or a touchdown ends the run. [the scenario's]"),
]
Scheduled = Annotated[bool | None, typer.Option(help="C(z) of the measured z in the filter.")]
Feedforward = Annotated[
    str | None,
    typer.Option(help="axial, as printed, or attraction: also what holds it off centre. [axial]"),
]
BearingAxes = Annotated[
    str | None,
    typer.Option(
        help="dq, phase: current controllers in fixed axes, or turning with the force as printed. [fixed]"
    ),
]
RealPwm = Annotated[
    bool | None, typer.Option(help="phase: duty cycles in steps, dead time of the half-bridges.")
]
Delay = Annotated[int | None, typer.Option(help="Samples between measurement and command. [the machine's]")]
Substeps = Annotated[
    int | None,
    typer.Option(help="Runge-Kutta steps a sample; the error is estimated. [4, more for slow samples]"),
]
Seed = Annotated[int | None, typer.Option(help="Seed of the noise. [0]")]
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

    Gain files are replaced only by a design that is stable on the machine and completes its main job, as the stroke.

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
def verify(
    gains: GainFile,
    change: Changes = None,
    uncertain: Annotated[
        list[str] | None,
        typer.Option(
            "--uncertain",
            metavar="SHARE|NAME=SHARE",
            help="How far parameters vary at margin 1, either way: 20% (those of the gain file), m=10%, ... "
            "[the gain file's]",
        ),
    ] = None,
    current_loops: Annotated[
        str, typer.Option(help="Of the machine's loop: lag (first order), or pi (sampled PI loops).")
    ] = "lag",
    time: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Longest search of a margin over the travel. [120]"),
    ] = None,
    no_proof: Annotated[
        bool, typer.Option("--no-proof", help="A first look: no proof of the margins over the travel.")
    ] = False,
    worst_case: Annotated[
        bool | None,
        typer.Option(
            "--worst-case/--no-worst-case",
            help="The largest |S| of each sensor over the uncertainty. [where one proof covers the travel]",
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the proof of the margin, for `malta check`.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the figure (.png).")] = None,
    as_json: AsJson = False,
) -> None:
    """Verify a gain file on the machine, stage by stage.

    Poles, bandwidths by definition, peak sensitivities with their ISO 14839-3 zones; real parametric margins with
    their proof, from full state feedback to the sampled loop, and over the travel; disk and delay margins, gang of
    four, tolerance of each parameter.

    The machine is the one in the file, with the changes given by --set, as far as they shape the linear loop (on MALTA
    m, K_A, K_B, l_B, F_c, T_d; windings and DC link do not).

    \b
    Example:  malta verify design/gains/calibrated.json --set m=0.56
    """
    from malta import gains as gain_files
    from malta.margins.stages import robustness
    from malta.margins.verify import covers_travel, require_stable, worst_sensitivities
    from malta.margins.verify import verify as verified
    from malta.model.data import plant_of, units_of
    from malta.model.linearize import linearize

    controller = gain_files.read(gains)
    plant = plant_of(_changed(controller.parameters, change))
    model = linearize(plant, plant.point(controller.operating_point[0]))
    published = _published(plant.name)
    box = _box(gains, uncertain, units_of(plant.parameters), published, option="--uncertain")
    for name, share in box.items():
        if not 0 < share < math.inf:
            raise InputError("--uncertain", name, f"{100 * share:g} %", "a share above 0 %")
    if time is not None and not 0 < time < math.inf:
        raise InputError("--time", "", f"{time:g}", "seconds above 0")
    if certificate is not None and no_proof:
        raise InputError("--certificate", "", "--no-proof", "one of them")
    loops = cast("CurrentLoops", current_loops)
    try:
        margins = verified(model, controller)
        with _bounds("margins", quiet=as_json) as (progress, bounds):
            found = robustness(
                plant, controller, box,
                current_loops=loops, progress=progress, bounds=bounds, time=time, proof=not no_proof,
            )  # fmt: skip
        if worst_case is None:
            worst_case = not no_proof and covers_travel(plant, controller, tuple(box), loops)
        worst = worst_sensitivities(plant, controller, box, loops, time=time) if worst_case else {}
    except CheckError as error:
        raise CheckError(f"{gains}: {error}") from error
    files: list[Path] = []
    refused: InputError | CheckError | None = None
    if certificate is not None:
        try:
            files.append(_certified(certificate, gains, plant, controller, box, loops, found.travel))
        except (InputError, CheckError) as error:
            refused = error  # the tables come first
    if out is not None:
        from malta import report

        picture, position = out / f"{controller.name}_margins.png", f"position {plant.stroke}"
        files.append(report.robustness(found, controller.name, box, picture, position, worst))
    if as_json:
        described = {"gains": str(gains), "design": controller.name, "files": [str(file) for file in files]}
        largest = {
            name: {
                "found": gain.lower,
                "frequency": gain.frequency,
                "proven": gain.upper,
                "reason": gain.reason,
            }
            for name, gain in worst.items()
        }
        robust = _robustness(found, box) | ({"worst_sensitivity": largest} if worst else {})
        _print_json(described | _margins(margins) | {"robust": robust})
    else:
        from malta import report

        console = _console()
        console.print(
            f"{gains}: {controller.name}, {plant.name}, preset {controller.parameters.preset}",
            *(change or ()),
        )
        for table in (
            report.poles_table(model, None if change else published),
            report.loop_poles_table(margins),
            report.bandwidth_table(margins, published),
            report.sensitivity_table(margins),
            "Uncertainty: " + "  ".join(f"{name} +-{100 * share:g} %" for name, share in box.items()) + "\n",
            report.chain_table(found),
            report.disk_table(found, controller.sample_time),
            report.gang_table(found, plant),
            report.tolerance_table(found, box),
            report.places_table(found, controller.sample_time),
            *([report.worst_case_table(worst)] if worst else []),
        ):
            console.print(table)
        for file in files:
            console.print(f"wrote {file}", soft_wrap=True)
    require_stable(margins, str(gains))
    if refused is not None:
        raise refused


@app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A certificate that verify wrote.")],
    gains: Annotated[
        Path | None,
        typer.Option(metavar="GAINS", help="The gain file that it has to be of, to the last digit."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check the proof of a margin, in arithmetic with rigorous bounds and without the code that found it.

    \b
    Example:  malta check build/table2_margin.json --gains design/gains/table2.json
    """
    from malta.margins.check import check as checked

    found = checked(file, gains)
    failures = list(found.failures)
    if gains is not None and not failures and not _is_of(file, gains):
        failures.append(f"the loops are not those of {gains}")
    if as_json:
        described = {"file": str(file), "holds": not failures, "lower": found.claim}
        _print_json(described | {"groups": list(found.groups), "failures": failures})
    else:
        console = _console()
        for line in found.groups:
            console.print(line, soft_wrap=True)
        verdict = "does not hold" if failures else "holds"
        console.print(
            f"{file}: stable in {100 * found.claim:.3f} % of the uncertainty: {verdict}", soft_wrap=True
        )
        for line in failures:
            print(f"malta: {file}: {line}", file=sys.stderr)
    raise typer.Exit(1 if failures else 0)


@app.command()
def simulate(
    gains: GainFile,
    scenario: Annotated[str | None, typer.Option(help=f"What to simulate: {SCENARIOS}")] = None,
    change: Changes = None,
    distance: Distance = None,
    rise: Rise = None,
    profile: ProfileName = None,
    during: Annotated[
        str | None, typer.Option(help="Faults strike during a stroke or a hold. [the scenario's]")
    ] = None,
    option: Own = None,
    fidelity: FidelityName = None,
    noise: Noise = None,
    quantize: Quantize = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="An error of the sensors: gain_x1=0.02, offset_y2=5um, hall_amplitude=0.01, hall_phase=2deg, ...",
        ),
    ] = None,
    bearing: Bearing = None,
    estimator: Annotated[
        str | None, typer.Option(help="steady-state, kalman (time-varying) or extended. [steady-state]")
    ] = None,
    scheduled: Scheduled = None,
    feedforward: Feedforward = None,
    bearing_axes: BearingAxes = None,
    real_pwm: RealPwm = None,
    delay: Delay = None,
    substeps: Substeps = None,
    seed: Seed = None,
    engine: Annotated[str, typer.Option(help="auto, compiled or virtual-machine.")] = "auto",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the figure (.png) and the time series (.npz).")
    ] = None,
    replay: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER:RUN", help="One run of a campaign again: its machine, sensors and noise."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate the nonlinear machine and its drive with a gain file.

    The machine is the one in the file, with the changes given by --set; the controller does not learn of them.

    \b
    Example:  malta simulate design/gains/calibrated.json --scenario stroke --set m=0.56 --noise 1 --out build
    """
    from malta import gains as gain_files
    from malta.model.data import plant_of
    from malta.simulation.experiments import experiment, main_job

    controller = gain_files.read(gains)
    plant = plant_of(_changed(controller.parameters, change))
    if scenario == "help":
        _list_scenarios(plant)
        raise typer.Exit
    chosen, choice = scenario or main_job(plant), engine.replace("-", " ")
    given = _given(
        distance,
        rise,
        profile=profile,
        during=during,
        fidelity=fidelity,
        noise=noise,
        quantize=quantize,
        sensor_errors=_assigned("--sensor", sensor, {s.name: s.unit for s in plant.sensor_errors}) or None,
        bearing=bearing,
        estimator=estimator,
        scheduled=scheduled,
        feedforward=feedforward,
        bearing_axes=bearing_axes,
        real_pwm=real_pwm,
        delay=delay,
        substeps=substeps,
        seed=seed,
    )
    given = _with_own(given, option, chosen, plant)
    stem = f"{controller.name}_{chosen}"
    with _bar(scenario or "simulating", quiet=as_json) as progress:
        if replay is None:
            found = experiment(chosen, plant, controller, progress=progress, engine=choice, **given)
        else:
            other = [*given, *(["scenario"] if scenario else []), *(["set"] if change else [])]
            found, chosen, stem = _replayed(replay, controller, other, choice, progress)
    published = _published(plant.name)
    files = [] if out is None else _kept(found, out, stem, published)
    if as_json:
        _print_json(
            {"gains": str(gains), "scenario": chosen, "files": [str(f) for f in files]} | _found(found)
        )
    else:
        from malta import report

        console = _console()
        run = found.run
        console.print(
            f"{gains}: {chosen}, fidelity {run.scenario.fidelity}", *(change or ()), f"-> {found.outcome}"
        )
        console.print(report.experiment_table(found, published))
        for line in report.limits_text(found):
            console.print(line)
        if substeps is not None:
            from malta.simulation.simulate import integration_error

            units = "/".join(dict.fromkeys(signal.unit for signal in run.plant.outputs))
            console.print(f"integration error, estimated: {integration_error(run):.1g} {units}")
        for file in files:
            console.print(f"wrote {file}", soft_wrap=True)
    able = [case.run for case in found.cases if not plant_of(case.run.controller.parameters).tabulated]
    if engine == "auto" and any(run.engine == "virtual machine" for run in able):
        print(
            "malta: no C compiler: simulated on CasADi's virtual machine, some ten times slower",
            file=sys.stderr,
        )
    if found.interrupted:
        print(f"malta: interrupted: {found.outcome}; what was computed is shown", file=sys.stderr)
        raise typer.Exit(130)
    if found.failed:
        raise CheckError(f"{gains}: {chosen}: {found.outcome}")


@app.command()
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
    option: Own = None,
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
    as_json: AsJson = False,
) -> None:
    """Simulate many machines that differ, each with noise of its own: the yield, and what goes wrong where.

    Every block of runs is kept in the folder. The same command goes on where it was ended, and reads what is done;
    `malta simulate GAINS --replay FOLDER:RUN` shows one of the runs. Whatever the yield is, the exit code is 0.

    \b
    Example:  malta campaign design/gains/calibrated.json --samples 10000 --spread 20%
    """
    from malta import gains as gain_files
    from malta.campaigns.campaign import campaign as fly
    from malta.campaigns.plan import Plan
    from malta.model.data import plant_of, units_of
    from malta.simulation.experiments import main_job

    controller = gain_files.read(gains)
    machine = _changed(controller.parameters, change)
    plant = plant_of(machine)
    if scenario == "help":
        _list_scenarios(plant, many=True)
        raise typer.Exit
    scenario = scenario or main_job(plant)
    published = _published(plant.name)
    given = _given(
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
    given = _with_own(given, option, scenario, plant)
    plan = Plan(
        controller,
        scenario,
        _box(gains, spread, units_of(machine), published),
        _assigned("--sensor", sensor, {s.name: s.unit for s in plant.sensor_errors}),
        samples,
        seed,
        cast("Sampler", sampler),
        machine,
        case,
        given,
    )
    folder = out or Path("build") / "campaigns" / f"{controller.name}_{scenario}_{plan.identity[:8]}"
    with _bar(scenario, quiet=as_json) as progress:
        found = fly(plan, folder, workers=workers, cluster=cluster, progress=progress)
    for file in found.damaged:
        print(f"malta: {file}: a damaged block, flown again", file=sys.stderr)
    files: list[Path] = []
    if len(found.index):
        from malta import report

        files = report.campaign(found, folder, published)
    if as_json:
        described = {"gains": str(gains), "folder": str(folder), "files": [str(f) for f in files]}
        _print_json(described | _campaign(found, published, worst))
    else:
        _show_campaign(gains, found, published, worst, files)
    if "virtual machine" in found.engines and not plant_of(controller.parameters).tabulated:
        print(
            "malta: no C compiler: simulated on CasADi's virtual machine, some hundred times slower",
            file=sys.stderr,
        )
    if found.interrupted:
        print(
            f"malta: interrupted after {len(found.index)} of {samples} runs, which {folder} keeps; "
            "the same command goes on",
            file=sys.stderr,
        )
        raise typer.Exit(130)


@app.command()
def tune(
    file: Annotated[
        Path, typer.Argument(metavar="SPEC", help="A design file with [specification] and [search].")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder of the design file that is found, the trials, the front.")
    ] = Path("build/tuned"),
    check: Annotated[
        bool, typer.Option("--check", help="Only judge the design as it stands in the file.")
    ] = False,
    generations: Annotated[
        int, typer.Option(min=0, help="Of the global search; 0 starts from the file's numbers.")
    ] = 20,
    front: Annotated[
        int, typer.Option(min=0, help="Trials for each number and point of the Pareto front; 0: no front.")
    ] = 40,
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
    from malta import report
    from malta.files import replace_files
    from malta.synthesis.spec import read_design
    from malta.tuning.search import Effort, design_text
    from malta.tuning.tune import judged
    from malta.tuning.tune import tune as tuned

    spec = read_design(file)
    if check:
        requirements = judged(spec)
        if as_json:
            _print_json({"design": spec.name, "requirements": [_requirement(r) for r in requirements]})
        else:
            _console().print(report.requirements_table(requirements))
        _require(requirements, file)
        return
    target, journal = out / f"{spec.name}.toml", out / f"{spec.name}_trials.jsonl"
    if target.resolve() == spec.path.resolve() and not overwrite:
        raise InputError(target, "", "the design file that was given", "another --out, or --overwrite")
    if target.exists() and not overwrite:
        raise InputError(target, "", "a design file", "another --out, or --overwrite")
    effort = Effort(generations=generations, front=front)
    with _bar(f"tuning {spec.name}", quiet=as_json) as progress:
        try:
            found = tuned(spec, journal, effort=effort, restart=restart, progress=progress)
        except KeyboardInterrupt:
            print(f"malta: interrupted; the same command goes on from {journal}", file=sys.stderr)
            raise typer.Exit(130) from None
    files = {target: design_text(spec, found.trial, target).encode()}
    if found.front:
        files[out / f"{spec.name}_front.md"] = report.front_markdown(found).encode()
    replace_files(files)
    written = list(files)
    if found.front:
        written.append(report.front(found, out / f"{spec.name}_front.png"))
    if as_json:
        _print_json(
            {
                "design": spec.name,
                "files": [str(path) for path in written],
                "trials": found.trials,
                "values": dict(zip((v.name for v in spec.search), found.trial.values, strict=True)),
                "delay": found.trial.delay,
                "requirements": [_requirement(r) for r in found.requirements],
                "front": [dict(one.figures) for one in found.front],
            }
        )
    else:
        console = _console()
        if found.front:
            console.print(report.front_table(found))
        console.print(report.requirements_table(found.requirements))
        for path in written:
            console.print(f"wrote {path}", soft_wrap=True)
    _require(found.requirements, target)


@app.command()
def claims(
    designs: Annotated[
        list[Path] | None,
        typer.Argument(help="Design files; all of design/ if none is named."),
    ] = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the table as the README holds it.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print the ledger: every number that a machine's paper publishes, ours for each design, and a verdict.

    One table for each machine, all of it computed now: models, gains, margins, experiments on the simulated machine.

    \b
    Example:  malta claims design/table2.toml
    """
    from dataclasses import asdict

    from malta.model.data import published
    from malta.report.ledger import ledger
    from malta.simulation.experiments import part
    from malta.synthesis.spec import read_design

    chosen = designs or sorted(Path("design").glob("*.toml"), reverse=True)
    if not chosen:
        raise InputError(
            "claims", "", "no design files (*.toml) here", "a folder design/ with some, or their names"
        )
    specs = [read_design(file) for file in chosen]
    if not designs:
        specs.sort(key=lambda spec: bool(spec.search))  # the paper's own designs first
    machines = [
        [spec for spec in specs if spec.plant.name == name]
        for name in dict.fromkeys(spec.plant.name for spec in specs)
    ]
    with _bar("claims", quiet=as_json) as progress:
        found = [
            ledger(those, published(those[0].machine_file), part(progress, n, len(machines)))
            for n, those in enumerate(machines)
        ]
    if as_json:
        _print_json([asdict(one) | {"claims": [claim._asdict() for claim in one.claims]} for one in found])
    elif markdown:
        print("\n".join(f"### {one.title}\n\n{one.markdown()}" for one in found), end="")
    else:
        from malta import report

        for one in found:
            _console().print(report.claims_table(one))


def main() -> None:
    """Entry point: errors become one sentence and an exit code."""
    # The matrices here are small: threads of the linear algebra would only get into each other's way.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
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
    from malta.margins.verify import require_stable
    from malta.margins.verify import verify as verified
    from malta.model.data import published_beside
    from malta.model.linearize import linearize
    from malta.simulation.experiments import experiment, main_job
    from malta.synthesis.lqg import synthesize
    from malta.synthesis.spec import read_design

    spec = read_design(file)
    plant = spec.plant
    job = main_job(plant)
    picture = figures / f"{spec.name}_{job}.png"
    for target in (out / f"{spec.name}.json", picture):
        if made.setdefault(target, file) != file:
            raise InputError(file, "name", repr(spec.name), f"another name than that of {made[target]}")
    model = linearize(plant, plant.at(**spec.operating_point))
    controller = synthesize(spec, model)
    margins = verified(model, controller, spec.uncertainty)
    require_stable(margins, str(file))
    # The harness consumes the gain file before it replaces a good one.
    with tempfile.TemporaryDirectory() as scratch:
        trial = Path(scratch) / f"{spec.name}.json"
        gain_files.write(controller, margins, trial)
        found = experiment(job, plant, gain_files.read(trial))
    for case in found.cases:
        end = case.run.verdict
        if not end.completed:
            raise CheckError(f"{file}: the {job} ends at {end.time:.4g} s: {end.name}; gain files unchanged")
    published = published_beside(spec.machine_file)
    page = report.design_page(spec, model, margins, found, published)
    report.experiment(found, picture, published)
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
        | _found(found)
    )


def _require(requirements: Sequence[Requirement], file: Path) -> None:
    """Raise CheckError when something asked for is not reached: what, by how much, and what binds most."""
    failed = sorted((r for r in requirements if not r.holds), key=lambda r: -r.ratio)
    if failed:
        text = "; ".join(map(str, failed))
        raise CheckError(f"{file}: not reached: {text} ({failed[0].name.replace('_', ' ')} binds most)")


def _requirement(r: Requirement) -> dict[str, Any]:
    ratio = r.ratio if r.ratio < float("inf") else None
    return {**r._asdict(), "ratio": ratio, "holds": r.holds}


def _changed(parameters: Parameters, changes: list[str] | None) -> Parameters:
    """The parameters with `NAME=VALUE` applied; a unit may follow the value."""
    from dataclasses import replace

    from malta.model.data import plant_of, units_of

    values = _assigned("--set", changes, units_of(parameters))
    try:
        preset = f"{parameters.preset}, changed" if values else parameters.preset
        changed = replace(parameters, **values, preset=preset)
        plant_of(changed)
    except InputError as error:
        raise InputError("--set", error.field, error.found, error.expected) from error
    except CheckError as error:
        raise InputError("--set", "", str(error), "a machine that can be controlled") from error
    return changed


def _assigned(option: str, given: list[str] | None, units: Mapping[str, str]) -> dict[str, float]:
    """Values in SI of `NAME=VALUE`, each with the unit that may follow it."""
    values: dict[str, float] = {}
    for text in given or ():
        name, _, value = (part.strip() for part in text.partition("="))
        number = re.fullmatch(NUMBER, value)
        if number is None or not name.isidentifier():
            examples = {"--set": "m=0.56 or l_B=45mm", "--spread": "20% or m=10%"}
            example = examples.get(option, "gain_x1=0.02 or offset_y2=5um")
            raise InputError(option, "", repr(text), f"NAME=VALUE, as {example}")
        if name not in units:
            kind = "sensor error" if option == "--sensor" else "parameter"
            raise InputError(option, name, f"an unknown {kind}", "one of " + " ".join(units))
        values[name] = _in_si(number, units[name], option, name)
    return values


NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)"


def _in_si(number: re.Match[str], si_unit: str, option: str, name: str) -> float:
    """The value of a number with the unit that may follow it."""
    from malta.model.data import to_si

    value, unit = float(number[1]), number[2]
    if si_unit != "1":
        return to_si(value, unit or si_unit, si_unit, option, name)
    if unit not in ("", "%", "percent"):
        raise InputError(option, f"{name}.unit", repr(unit), "no unit, or %")
    return value * (0.01 if unit else 1.0)


def _with_own(given: dict[str, Any], texts: list[str] | None, scenario: str, plant: Plant) -> dict[str, Any]:
    """The options of a scenario with those of `--option NAME=VALUE`, in SI, read as the default is."""
    from malta.simulation.experiments import option_of, setting

    units = setting(plant, "OPTION_UNITS", {})
    found = dict(given)
    for text in texts or ():
        name, _, value = (part.strip() for part in text.partition("="))
        if not (name and value):
            raise InputError("--option", "", repr(text), "NAME=VALUE")
        default = option_of(scenario, plant, name)
        if name in found:
            raise InputError("--option", name, f"{value!r} for the second time", "it once")
        if isinstance(default, str) or default is None:
            found[name] = value
        elif isinstance(default, bool):
            if value not in ("true", "false"):
                raise InputError("--option", name, repr(value), "true or false")
            found[name] = value == "true"
        else:
            several = isinstance(default, tuple)
            numbers = [
                re.fullmatch(NUMBER, part.strip()) for part in (value.split(",") if several else [value])
            ]
            read = [_in_si(n, units.get(name, "1"), "--option", name) for n in numbers if n is not None]
            if len(read) < len(numbers):
                raise InputError("--option", name, repr(value), "numbers" if several else "a number")
            whole = isinstance(default, int) and read[0].is_integer()
            found[name] = tuple(read) if several else int(read[0]) if whole else read[0]
    return found


def _list_scenarios(plant: Plant, *, many: bool = False) -> None:
    """What the machine can be asked for: all, or what many can fly."""
    from malta import report
    from malta.simulation.experiments import series_of

    _console().print(report.scenarios_table(plant, series_of(plant) if many else None))


def _given(distance: float | None, rise: float | None, **others: Any) -> dict[str, Any]:
    """The options of a scenario that were given, in SI: lengths come in mm, times in ms."""
    scaled = {"distance": distance, "rise": rise}
    options = {name: None if value is None else value * 1e-3 for name, value in scaled.items()} | others
    return {name: value for name, value in options.items() if value is not None}


def _box(
    gains: Path,
    spread: list[str] | None,
    units: Mapping[str, str],
    published: Mapping[str, Any] | None,
    option: str = "--spread",
) -> dict[str, float]:
    """The shares of an option: one for all uncertain parameters, others by name, or the gain file's own."""
    from malta.campaigns.plan import box_of

    named = [text for text in spread or () if "=" in text]
    general = [text for text in spread or () if "=" not in text]
    if len(general) > 1:
        raise InputError(option, "", " and ".join(general), "one share for all, others as NAME=SHARE")
    box: dict[str, float] = {}
    if general or not named:
        box = box_of(gains, published)
    if general:
        share = _assigned(option, [f"all={general[0]}"], {"all": "1"})["all"]
        box = dict.fromkeys(box, share)
    return box | _assigned(option, named, dict.fromkeys(units, "1"))


def _replayed(
    text: str, controller: Controller, other: list[str], engine: str, progress: Callable[[float], None] | None
) -> tuple[Experiment, str, str]:
    """A run of a campaign as `FOLDER:RUN` names it, its scenario, and how its files are called."""
    from malta.campaigns.campaign import read_plan
    from malta.campaigns.campaign import replay as again

    folder, _, run = text.rpartition(":")
    if not folder or not run.isdecimal():
        raise InputError("--replay", "", repr(text), "FOLDER:RUN, as build/campaigns/mine:17")
    if other:
        options = ", ".join("--" + name.replace("_", "-") for name in other)
        raise InputError("--replay", "", f"{options} too", "none of them: the campaign says how it runs")
    plan = read_plan(folder, controller)
    found = again(plan, int(run), engine=cast("EngineChoice", engine), progress=progress)
    return found, plan.scenario, f"{controller.name}_{plan.scenario}_run_{int(run)}"


def _show_campaign(gains: Path, found: Campaign, published: Any, worst: int, files: list[Path]) -> None:
    from malta import report
    from malta.campaigns.plan import wanted_of

    plan, console, wanted = found.plan, _console(), wanted_of(found.plan)
    case = "" if wanted.label == plan.scenario else f" ({wanted.label})"
    console.print(
        f"{gains}: {plan.scenario}{case}, fidelity {wanted.scenario.fidelity}, "
        f"{len(found.index)} of {plan.samples} machines"
    )
    console.print(f"{report.box_text(found)}; {plan.sampler}, seed {plan.seed}")
    if not len(found.index):
        return
    console.print(report.campaign_tables(found, published, worst))
    if worst:
        console.print(
            f"one of them again: malta simulate {gains} --replay {found.folder}:RUN", soft_wrap=True
        )
    for file in files:
        console.print(f"wrote {file}", soft_wrap=True)


def _campaign(found: Campaign, published: Any, worst: int) -> dict[str, Any]:
    """What a campaign found as plain tables; SI."""
    import numpy as np

    from malta.campaigns.statistics import figures_of, kept, worst_of
    from malta.simulation.batch import verdicts

    within = kept(found, published)
    names = verdicts(found.plan.plant)
    merits = {}
    for f in figures_of(found, published):
        values = f.values[np.isfinite(f.values)]
        marks = np.percentile(values, (5, 50, 95, 99, 100)) if values.size else [float("nan")] * 5
        merits[f.label] = dict(
            zip(("p5", "p50", "p95", "p99", "largest"), map(float, marks), strict=True)
        ) | {"published": f.published}
    return {
        "manifest": found.plan.manifest,
        "runs": len(found.index),
        "interrupted": found.interrupted,
        "engines": list(found.engines),
        "yield": found.rate._asdict(),
        "within_published": None if within is None else int(within.sum()),
        "ends": found.ends,
        "merits": merits,
        "worst": [
            {
                "run": int(found.index[row]),
                "end": names[int(found.batch.verdict[row])],
                "time": float(found.batch.duration[row]),
                "values": dict(zip(found.names, found.values[row].tolist(), strict=True)),
                "deviation": found.batch.deviation[row].tolist(),
                "contact": found.batch.contact[row].tolist(),
                "replay": f"{found.folder}:{found.index[row]}",
            }
            for row in worst_of(found, worst)
        ],
    }


def _published(machine: str) -> dict[str, Any] | None:
    """What the machine's paper prints, when the command runs where data/ is."""
    from malta.model.data import published

    file = Path("data") / f"{machine}.toml"
    printed = file.parent / "published" / file.name
    if printed.exists():
        return published(file)
    print(f"malta: no {printed} here: published figures are left out", file=sys.stderr)
    return None


def _kept(found: Experiment, out: Path, stem: str, published: Any) -> list[Path]:
    """Write the figure, and the time series of every run."""
    from malta import report
    from malta.simulation.simulate import save as save_series

    names = [stem] if len(found.cases) == 1 else [f"{stem}_{_slug(case.label)}" for case in found.cases]
    series = [
        save_series(case.run, out / f"{name}.npz") for name, case in zip(names, found.cases, strict=True)
    ]
    return [*series, report.experiment(found, out / f"{stem}.png", published)]


def _slug(label: str) -> str:
    return "_".join("".join(c if c.isalnum() else " " for c in label).split())


def _found(found: Experiment) -> dict[str, Any]:
    """An experiment as plain tables; SI, with the unit that a report would show."""
    content: dict[str, Any] = {
        "engine": found.run.engine,
        "fidelity": found.run.scenario.fidelity,
        "verdict": found.run.verdict._asdict(),
        "merits": {merit.label: merit.value for merit in found.merits},
        "cases": [
            {
                "label": case.label,
                "verdict": case.run.verdict._asdict(),
                "limits": list(case.run.limits),
                "merits": {merit.label: merit.value for merit in case.merits},
            }
            for case in found.cases
        ],
    }
    if found.name == "stroke":
        from dataclasses import asdict

        from malta.simulation.simulate import stroke_figures

        content["stroke"] = asdict(stroke_figures(found.run))
    return content


def _margins(margins: Margins) -> dict[str, Any]:
    return {
        "stable": margins.stable,
        "poles": margins.poles.pairs(),
        "bandwidth": dict(margins.bandwidth),
        "peak_sensitivity": {stage.name: dict(stage.peak_sensitivity) for stage in margins.stages},
    }


def _robustness(found: Robustness, box: Mapping[str, float]) -> dict[str, Any]:
    def margin(m: Margin) -> dict[str, Any]:
        return {
            "lower": m.lower,
            "upper": None if m.exhausted else m.upper,
            "frequency": m.frequency,
            "witness": None if m.witness is None else dict(m.witness),
            "sensitivity": dict(m.sensitivity),
            "cells": sum(proof.cells for proof in m.certificate),
            "reason": m.reason,
        }

    return {
        "uncertainty": dict(box),
        "chain": [
            {"stage": link.name, "peak_sensitivity": link.peak, "at": link.broken_at} | margin(link.margin)
            for link in found.chain
        ],
        "travel": margin(found.travel),
        "disks": [
            {
                "channels": d.channels,
                "size": d.size,
                "gain": d.gain,
                "phase": d.phase,
                "frequency": d.frequency,
            }
            for d in found.disks
        ],
        "delay": dict(found.delay),
        "gang_of_four": {
            name: dict(zip(("S", "T", "SP", "FS"), v, strict=True)) for name, v in found.gang.items()
        },
        "tolerance": {k: {"down": margin(a), "up": margin(b)} for k, (a, b) in found.tolerance.items()},
        "payload": None if found.payload is None else margin(found.payload),
        "places": [
            {"position": p.position, "peak_sensitivity": p.peak, "disk": p.disk, "delay": p.delay}
            | margin(p.margin)
            for p in found.places
        ],
    }


def _print_json(content: Any) -> None:
    def finite(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: finite(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [finite(entry) for entry in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

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


@contextmanager
def _bar(what: str, *, quiet: bool) -> Iterator[Callable[[float], None] | None]:
    """A progress bar with the time left on a terminal's standard error, gone when the work is done."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@contextmanager
def _bounds(
    what: str, *, quiet: bool
) -> Iterator[tuple[Callable[[float], None] | None, Callable[[float, float], None]]]:
    """A bar and the bounds of a margin so far; without a terminal a line every 2 s, once the proof takes longer.

    Ctrl-C prints what stands and ends with 130.
    """
    stands: list[float] = []
    terminal = sys.stderr.isatty()
    due: float | None = None  # when the next line is, from the proof's first word on

    def words() -> str:
        lower, upper = stands
        high = "not found" if math.isinf(upper) else f"{100 * upper:.2f} %"
        return f"proven {100 * max(lower, 0):.2f} %, lost at {high}"

    with _bar(what, quiet=quiet) as progress:

        def bounds(lower: float, upper: float) -> None:
            nonlocal due
            stands[:] = lower, upper
            due = clock.monotonic() + PATIENCE if due is None else due
            if quiet or terminal or clock.monotonic() < due:
                return
            due = clock.monotonic() + 2.0
            print(f"malta: {what}: {words()}", file=sys.stderr, flush=True)

        try:
            yield progress, bounds
        except KeyboardInterrupt:
            print("malta: interrupted; " + (words() if stands else "nothing proven"), file=sys.stderr)
            raise typer.Exit(130) from None


PATIENCE = 5.0  # s, before the first line about a proof


def _certified(
    path: Path,
    gains: Path,
    plant: Plant,
    controller: Controller,
    box: Mapping[str, float],
    current_loops: CurrentLoops,
    margin: Margin,
) -> Path:
    """Write the certificate of a margin over the travel."""
    from malta.margins import certificate
    from malta.margins.verify import travel_loops

    places, over = travel_loops(plant, controller, tuple(box), current_loops)
    return certificate.write(path, places, box, over, margin, gains)


def _is_of(path: Path, gains: Path) -> bool:
    """Whether a certificate's loops are those of a gain file, with either kind of current loops."""
    from malta import gains as gain_files
    from malta.margins import certificate, checked_file
    from malta.margins.verify import travel_loops
    from malta.model.data import plant_of

    controller = gain_files.read(gains)
    plant = plant_of(controller.parameters)
    names = tuple(p["name"] for p in checked_file.content_of(path)["parameters"] if p["name"] != plant.stroke)
    kinds: tuple[CurrentLoops, ...] = ("lag", "pi") if controller.current_loop is not None else ("lag",)
    return any(certificate.matches(path, travel_loops(plant, controller, names, kind)[0]) for kind in kinds)


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
