"""The experiments of a machine by name, with their options.

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
    SETTLE        s at rest before the main job, where yields are counted
    STROKE_UNIT   unit in which deviations along the stroke are displayed, if not um
    bounds        (scenario, options) -> bounds that the paper prints for this scenario, as keys of data/published/:
                  "rise" and "overshoot" of the stroke, largest deviations "stroke" along it, "m" and "rad" of others
    bounds_in_specification
                  (scenario, options) -> names in [specification] that bound the same deviations in this scenario
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields
from numbers import Real
from typing import Any

from malta.errors import InputError
from malta.model.plant import Plant
from malta.simulation import generic
from malta.simulation.engines import EngineChoice
from malta.simulation.experiments import Case, Experiment, PlannedRun, Progress, fly, setting
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import EngineOf
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

# Fields of a scenario that the experiment itself decides. All others are options, and so is the engine.
MADE = {
    *("name", "reference", "start", "cold", "disturbance", "anticipated", "excitation"),
    *("faults", "correction", "changes"),
}
OPTIONS = {f.name for f in fields(Scenario)} - MADE | {"engine"}


def experiments_of(plant: Plant) -> Mapping[str, Callable[..., Experiment]]:
    """The experiments of a machine by name, its main job first."""
    found: Mapping[str, Callable[..., Experiment]] = setting(plant, "EXPERIMENTS", generic.EXPERIMENTS)
    return found


def series_of(plant: Plant) -> Mapping[str, Callable[..., list[PlannedRun]]]:
    """The functions that list the runs of an experiment for campaigns, by the experiment's name."""
    own: Mapping[str, Callable[..., list[PlannedRun]]] | None = setting(plant, "CASES", None)
    if own is None:
        return {} if experiments_of(plant) is not generic.EXPERIMENTS else generic.CASES
    return own


def main_job(plant: Plant) -> str:
    """The name of the experiment that every design has to complete."""
    return next(iter(experiments_of(plant)))


def settling(name: str, plant: Plant) -> dict[str, float]:
    """The option with which yields of an experiment are counted: the machine's SETTLE before its main job."""
    seconds = float(setting(plant, "SETTLE", 0.0)) if name == main_job(plant) else 0.0
    return {"settle": seconds} if seconds else {}


def experiment(
    name: str, plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Run an experiment by name.

    name : one of the machine's experiments, as "stroke", "hold" or "disturbance"
    plant : the machine
    controller : its controller
    progress : called with the share of the work that is done, 0 to 1
    options : of the experiment, SI, as distance=20e-3, and fields of `malta.Scenario`, as seed=1

    Returns an Experiment: runs, and their figures of merit.

    Raises InputError for an unknown experiment, and for options that it does not have.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> print(malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact))
    disturbance: completed at 0.4 s
      w; y moves by 34.3 um; y, left at the end 0.0531 um
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
    engine: EngineChoice | EngineOf = "auto",
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
