"""Experiments on a machine by name: simulated runs and their figures of merit.

An experiment is a function (plant, controller, *, progress=None, **options) -> Experiment. Its options are fields of
Scenario that replace the experiment's own (fidelity, noise, seed, estimator, ...), and the keywords of its signature:
numbers in SI, words, true or false, or tuples of numbers, as their defaults are.

A machine without experiments of its own has those of simulation/generic.py. Other machines define, in the module of the
plant or in a module `experiments` beside it,

    EXPERIMENTS   name -> experiment; the first is the machine's main job, which every design has to complete

and, where they differ from the defaults,

    CASES         name -> (plant, controller, **options) -> list[PlannedRun]: experiments for campaigns
    FINDINGS      names of experiments in which a touchdown is an expected result and no failure
    ALONE         names of experiments whose figure shows a single run
    OPTION_UNITS  option -> SI unit
    check         (experiment, option, value): raises InputError for a value that the experiment does not accept
    WORDS         the machine's words for its "stroke" and "thrust", and by unit ("m", "rad", "N", "N m") for its other
                  outputs and inputs; without a word the names of the signals are used
    RISE          s, 10-90 %, of a stroke without a rise of its own
    STROKE_UNIT   unit in which deviations along the stroke are displayed, if not um
    bounds        (scenario, options) -> bounds that the paper prints for this scenario, as keys of data/published/:
                  "rise" and "overshoot" of the stroke, largest deviations "stroke" along it, "m" and "rad" of others
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.model.data import in_unit
from malta.model.machines import attribute_of
from malta.model.plant import Plant
from malta.simulation.engines import EngineChoice
from malta.simulation.references import Reference
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

Progress = Callable[[float], None]
# Fields of a scenario that the experiment itself decides. All others are options, and so is the engine.
MADE = {"name", "reference", "start", "cold", "disturbance", "faults", "correction", "changes"}
OPTIONS = {f.name for f in fields(Scenario)} - MADE | {"engine"}
# Sensors as built, without systematic errors; and exact sensors.
REAL: dict[str, Any] = {"noise": 1.0, "quantize": True, "sensor_errors": {}}
QUIET: dict[str, Any] = {"noise": 0.0, "quantize": False, "sensor_errors": None}


class Merit(NamedTuple):
    """A figure of merit: value in SI, unit for display, and the key of the paper's value."""

    label: str
    value: float
    unit: str
    published: str = ""  # key of data/published/
    relation: str = "about"  # of ours to the published: "about" or "at most"

    def __str__(self) -> str:
        unit = "%" if self.unit == "percent" else self.unit
        return f"{self.label} {in_unit(self.value, self.unit):.3g} {unit}"


class Case(NamedTuple):
    """A run of an experiment with its figures of merit."""

    label: str
    run: Trajectory
    merits: tuple[Merit, ...]


class PlannedRun(NamedTuple):
    """A run that an experiment is going to simulate, and the function that evaluates its trajectory."""

    label: str
    scenario: Scenario
    merits: Callable[[Trajectory], tuple[Merit, ...]]


@dataclass(frozen=True, eq=False)
class Experiment:
    """The result of an experiment."""

    name: str
    question: str
    cases: tuple[Case, ...]
    merits: tuple[Merit, ...]
    curves: Mapping[str, FloatArray] = field(default_factory=dict)  # drawn beside the runs
    interrupted: bool = False  # Ctrl-C ended the experiment: it has the cases up to then

    def __str__(self) -> str:
        cases = ("; ".join([case.label, *map(str, case.merits)]) for case in self.cases)
        return "\n  ".join([f"{self.name}: {self.outcome}", *cases])

    @property
    def run(self) -> Trajectory:
        """The first run."""
        return self.cases[0].run

    @property
    def failed(self) -> bool:
        """Whether a run ended early, except in experiments in which a touchdown is an expected result."""
        ends = {case.run.verdict.name for case in self.cases}
        findings = setting(self.run.plant, "FINDINGS", ())
        return self.name not in findings and not ends <= {"completed", "interrupted"}

    @property
    def outcome(self) -> str:
        """How the runs ended, in words."""
        ends = [case for case in self.cases if not case.run.verdict.completed]
        if not ends and self.interrupted:
            return f"interrupted after {len(self.cases)} runs"
        if not ends:
            return f"completed at {self.run.verdict.time:.4g} s"
        verdicts = [f"{case.run.verdict.name} at {case.run.verdict.time:.4g} s" for case in ends]
        if len(self.cases) == 1:
            return verdicts[0]
        return f"{len(ends)} of {len(self.cases)} runs not completed ({ends[0].label}: {verdicts[0]})"


def scenario_of(
    name: str, duration: float, reference: Callable[[Plant], Reference], options: Mapping[str, Any]
) -> Scenario:
    """The scenario of an experiment, with sensors as built unless the options differ."""
    fields = REAL | {key: value for key, value in options.items() if key != "engine"}
    return replace(Scenario(name, duration, reference), **fields)


def fly(
    plant: Plant,
    controller: Controller,
    planned: Sequence[PlannedRun],
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[tuple[Case, ...], bool]:
    """Simulate runs one after the other: the cases, and whether Ctrl-C ended the series before its last run."""
    return fly_all([(plant, controller, one) for one in planned], progress, options)


def fly_all(
    flights: Sequence[tuple[Plant, Controller, PlannedRun]],
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[tuple[Case, ...], bool]:
    """`fly` for runs with different machines and controllers."""
    cases: list[Case] = []
    for n, (plant, controller, (label, scenario, merits)) in enumerate(flights):
        share = progress_of_part(progress, n, len(flights))
        try:
            run = simulate(plant, controller, scenario, engine=options.get("engine", "auto"), progress=share)
        except KeyboardInterrupt:
            if not cases:
                raise
            return tuple(cases), True
        cases.append(Case(label, run, merits(run)))
        if run.verdict.name == "interrupted":
            return tuple(cases), True
    return tuple(cases), False


def progress_of_part(progress: Progress | None, n: int, total: int) -> Progress | None:
    """The progress function of part n of `total` equal parts."""
    return None if progress is None else lambda share: progress((n + share) / total)


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def experiments_of(plant: Plant) -> Mapping[str, Callable[..., Experiment]]:
    """The experiments of a machine by name, its main job first."""
    from malta.simulation.generic import EXPERIMENTS

    found: Mapping[str, Callable[..., Experiment]] = setting(plant, "EXPERIMENTS", EXPERIMENTS)
    return found


def series_of(plant: Plant) -> Mapping[str, Callable[..., list[PlannedRun]]]:
    """The functions that list the runs of an experiment for campaigns, by the experiment's name."""
    from malta.simulation import generic

    own: Mapping[str, Callable[..., list[PlannedRun]]] | None = setting(plant, "CASES", None)
    if own is None:
        return {} if experiments_of(plant) is not generic.EXPERIMENTS else generic.CASES
    return own


def setting(plant: Plant, name: str, default: Any) -> Any:
    """The value of a name that the machine's module may define, see the list at the top of this file."""
    return attribute_of(plant, "experiments", name, default)


def main_job(plant: Plant) -> str:
    """The name of the experiment that every design has to complete."""
    return next(iter(experiments_of(plant)))


def experiment(
    name: str, plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Run an experiment by name.

    Raises InputError for an unknown experiment, and for options that it does not have.

        print(malta.experiment("hold", plant, controller, seed=1))
    """
    _check(name, plant, options)
    return experiments_of(plant)[name](plant, controller, progress=progress, **options)


def cases_of(name: str, plant: Plant, controller: Controller, **options: Any) -> list[PlannedRun]:
    """The runs of one of the machine's CASES, before they are simulated. Raises InputError as `experiment` does."""
    _check(name, plant, options)
    cases = series_of(plant)
    if name not in cases:
        found = f"{name!r}, which changes the machine or the reference in flight"
        raise InputError("simulate", "scenario", found, "one of " + ", ".join(cases))
    return cases[name](plant, controller, **options_of(name, plant) | options)


def single_run(
    name: str,
    plant: Plant,
    controller: Controller,
    planned: PlannedRun,
    engine: EngineChoice = "auto",
    progress: Progress | None = None,
    run: Trajectory | None = None,
) -> Experiment:
    """An experiment of one run alone, simulated here unless `run` has it already.

    Where the experiment's own figure compares several runs, the result is named "run" and has a plain figure.
    """
    if run is None:
        cases, cut = fly(plant, controller, [planned], progress, {"engine": engine})
    else:
        cases, cut = (Case(planned.label, run, planned.merits(run)),), False
    shown = name if name in setting(plant, "ALONE", ()) else "run"
    what = name if planned.label == name else f"{name}: {planned.label}"
    return Experiment(shown, what, cases, cases[0].merits, interrupted=cut)


def options_of(name: str, plant: Plant) -> dict[str, Any]:
    """The options of an experiment's own signature with their defaults. Raises InputError for an unknown experiment."""
    known = experiments_of(plant)
    if name not in known:
        raise InputError("simulate", "scenario", repr(name), "one of " + ", ".join(known))
    parameters = inspect.signature(known[name]).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY and p.name != "progress"}


def option_of(name: str, plant: Plant, option: str) -> Any:
    """The default of one of these options. Raises InputError for an option that the experiment does not have."""
    mine = options_of(name, plant)
    if option not in mine:
        others = {o for other in experiments_of(plant) for o in options_of(other, plant)}
        found = "an option of another scenario" if option in others else "an unknown option"
        expected = " ".join(sorted(mine)) or "none of its own"
        raise InputError("simulate", f"{name}: {option}", found, expected)
    return mine[option]


def _check(name: str, plant: Plant, options: Mapping[str, Any]) -> None:
    """InputError for an unknown experiment, an unknown option, or a value of the wrong kind."""
    mine, check = options_of(name, plant), setting(plant, "check", None)
    for option, value in options.items():
        if option in OPTIONS and option not in mine:
            continue
        expected = _expected(value, option_of(name, plant, option))
        if expected:
            raise InputError("simulate", f"{name}: {option}", repr(value), expected)
        if check is not None:
            check(name, option, value)


def _expected(value: Any, default: Any) -> str:
    """The kind of value that an option with this default takes; "" where the value is of that kind."""
    if isinstance(default, bool):
        return "" if isinstance(value, bool) else "true or false"
    if isinstance(default, Real):
        return "" if _is_number(value) else "a number"
    if isinstance(default, tuple):
        several = isinstance(value, tuple | list) and len(value) > 0
        return "" if several and all(map(_is_number, value)) else "numbers"
    return ""  # words are looked up where they are used


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
