"""The experiments of a machine by name, with their options.

A machine without experiments of its own has those at the end of this file. Other machines define, in the module of the
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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.places import place_states
from malta.model.plant import Plant, Signal
from malta.simulation import references
from malta.simulation.engine.engines import EngineChoice
from malta.simulation.experiments import (
    Case,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    experiment_of,
    fly,
    merits_of_first,
    rms,
    scenario_of,
    setting,
    step_wrench,
)
from malta.simulation.layout import fidelities
from malta.simulation.references import Motion, Reference
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import EngineOf
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.units import FINE_UNITS

# Experiments of any machine: hold still, step an output, push.
#
# hold         motion and commands at rest, with sensors as built
# step         a step of one output after the other
# disturbance  a constant force or torque on each input of disturbance in turn
#
# A machine that defines no experiments has these. Their options are in SI.


SAMPLES = 2000  # of a run without a `time`
LEAD_SHARE = 0.1  # share of the run before a step or a load
CLEARANCE = 0.1  # of a step of default size, as a share of the clearance
SIZE = 1e-5  # SI, of a step of a machine without contacts and without noise


def hold_cases(
    plant: Plant, controller: Controller, *, time: float = 0.0, **options: Any
) -> list[PlannedRun]:
    """Hold still for `time` (s; 0: 2000 samples), with the noise of the sensors as built."""
    scenario = scenario_of(
        "hold", _duration(controller, time), references.hold, with_fidelity(plant, options)
    )
    return [PlannedRun("hold", scenario, _rest_merits)]


def step_cases(
    plant: Plant,
    controller: Controller,
    *,
    output: str = "all",
    size: float = 0.0,
    time: float = 0.0,
    **options: Any,
) -> list[PlannedRun]:
    """A step of one output, or of each in turn, by `size` (SI; 0: a tenth of the clearance), with exact sensors."""
    duration, planned = _duration(controller, time), []
    for k in _choose(plant.outputs, output, "output"):
        signal, distance = plant.outputs[k], size or default_step(plant, k)
        reference = partial(jump, output=k, size=distance, at=LEAD_SHARE * duration)
        scenario = scenario_of(
            "step", duration, reference, _with_exact_sensors(with_fidelity(plant, options))
        )
        planned.append(PlannedRun(signal.name, scenario, partial(_step_merits, output=k, size=distance)))
    return planned


def disturbance_cases(
    plant: Plant,
    controller: Controller,
    *,
    on: str = "all",
    size: float = 1.0,
    time: float = 0.0,
    **options: Any,
) -> list[PlannedRun]:
    """A constant force or torque of `size` (N or N m) on one input of disturbance, or on each in turn.

    Raises InputError for a machine without inputs of disturbance.
    """
    if not plant.disturbances:
        raise InputError(plant.name, "disturbances", "none", "a machine on which forces act from outside")
    duration, planned = _duration(controller, time), []
    for k in _choose(plant.disturbances, on, "on"):
        push = partial(
            step_wrench, column=k, size=size, at=LEAD_SHARE * duration, width=len(plant.disturbances)
        )
        given = _with_exact_sensors(with_fidelity(plant, options)) | {"disturbance": push}
        scenario = scenario_of("disturbance", duration, references.hold, given)
        planned.append(PlannedRun(plant.disturbances[k].name, scenario, _load_merits))
    return planned


def jump(plant: Plant, output: int, size: float, at: float) -> Reference:
    """One output steps by `size` at `at` (s), the others stay at zero."""

    def motion(t: FloatArray) -> Motion:
        p = np.zeros((len(t), len(plant.outputs)))
        p[np.asarray(t) >= at, output] = size
        return Motion(p, np.zeros_like(p), np.zeros_like(p))

    return motion


def default_step(plant: Plant, output: int) -> float:
    """A tenth of the clearance of an output, SI; without contacts, ten times the sensor's noise."""
    y = np.zeros(len(plant.outputs))
    probe = max(10 * plant.sensors.noise[output], SIZE)
    y[output] = probe
    if plant.contacts.names:
        x = place_states(plant, ca.DM(plant.position_of(ca.DM(y))))
        used = float(np.max(np.array(ca.DM(plant.contacts.contact(x)))))
        if used > 0:
            return probe * CLEARANCE / used
    return probe


def _choose(signals: Sequence[Signal], name: str, option: str) -> list[int]:
    """The index of a signal, or all indices for "all". Raises InputError for an unknown name."""
    names = [s.name for s in signals]
    if name == "all":
        return list(range(len(names)))
    if name not in names:
        raise InputError("simulate", option, repr(name), "all, or one of " + " ".join(names))
    return [names.index(name)]


def _duration(controller: Controller, time: float) -> float:
    return time or SAMPLES * controller.sample_time


def with_fidelity(plant: Plant, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options with the default fidelity: "dq" for machines with windings, else "force"."""
    return {"fidelity": "dq" if "dq" in fidelities(plant) else "force"} | dict(options)


def _with_exact_sensors(options: Mapping[str, Any]) -> dict[str, Any]:
    return {"noise": 0.0, "quantize": False} | dict(options)


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    error, merits = run.p - run.reference, []
    for k, s in enumerate(run.plant.outputs):
        merits.append(Merit(f"{s.name}, rms", rms(error[:, k]), FINE_UNITS.get(s.unit, s.unit)))
    for k, s in enumerate(run.plant.inputs):
        merits.append(Merit(f"{s.name}, rms", float(run.v[:, k].std()), s.unit))
    return tuple(merits)


def _step_merits(run: Trajectory, output: int, size: float) -> tuple[Merit, ...]:
    first = int(LEAD_SHARE * len(run.t))
    share = (run.p[first:, output] - run.reference[0, output]) / size
    t = run.t[first:] - run.t[first]
    outside = np.flatnonzero(np.abs(share - 1) > 0.02)
    settled = float(t[outside[-1]]) if len(outside) and outside[-1] + 1 < len(t) else float("nan")
    others = np.delete(run.p - run.reference, output, axis=1)
    unit = run.plant.outputs[output].unit
    merits = [
        Merit("overshoot", max(0.0, float(share.max()) - 1), "percent"),
        Merit("within 2 % after", settled, "ms", key="settled"),
        Merit("left at the end", abs(float(share[-1]) - 1) * abs(size), FINE_UNITS.get(unit, unit)),
    ]
    units = {s.unit for k, s in enumerate(run.plant.outputs) if k != output}
    if others.size and len(units) == 1:
        (other,) = units
        merits.append(Merit("others move by", float(np.abs(others).max()), FINE_UNITS.get(other, other)))
    return tuple(merits)


def _load_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Figures of the output that moves furthest."""
    error = np.abs(run.p - run.reference)
    k = int(error.max(axis=0).argmax())
    signal = run.plant.outputs[k]
    fine = FINE_UNITS.get(signal.unit, signal.unit)
    return (
        Merit(f"{signal.name} moves by", float(error[:, k].max()), fine),
        Merit(f"{signal.name}, left at the end", float(error[-1, k]), fine),
    )


QUESTIONS = {
    "hold": "How still does it stand?",
    "step": "Does it go where it is sent?",
    "disturbance": "How far does a load move it, and does it come back?",
}
CASES: Mapping[str, Callable[..., list[PlannedRun]]] = {
    "hold": hold_cases,
    "step": step_cases,
    "disturbance": disturbance_cases,
}
EXPERIMENTS: Mapping[str, Callable[..., Experiment]] = {
    name: experiment_of(name, question, CASES[name], merits_of_first) for name, question in QUESTIONS.items()
}


# Fields of a scenario that the experiment itself decides. All others are options, and so is the engine.
EXPERIMENT_FIELDS = {
    *("name", "reference", "start", "cold", "disturbance", "anticipated", "excitation"),
    *("faults", "correction", "changes"),
}
OPTIONS = {f.name for f in fields(Scenario)} - EXPERIMENT_FIELDS | {"engine"}


def experiments_of(plant: Plant) -> Mapping[str, Callable[..., Experiment]]:
    """The experiments of a machine by name, its main job first."""
    found: Mapping[str, Callable[..., Experiment]] = setting(plant, "EXPERIMENTS", EXPERIMENTS)
    return found


def series_of(plant: Plant) -> Mapping[str, Callable[..., list[PlannedRun]]]:
    """The functions that list the runs of an experiment for campaigns, by the experiment's name."""
    own: Mapping[str, Callable[..., list[PlannedRun]]] | None = setting(plant, "CASES", None)
    if own is None:
        return {} if experiments_of(plant) is not EXPERIMENTS else CASES
    return own


def main_job(plant: Plant) -> str:
    """The name of the experiment that every design has to complete."""
    return next(iter(experiments_of(plant)))


def settling_option(name: str, plant: Plant) -> dict[str, float]:
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


def option_of(name: str, plant: Plant, option: str, general: Iterable[str] = sorted(OPTIONS)) -> Any:
    """The default of one of these options. Raises InputError for an option that the experiment does not have.

    general : options of every experiment, for the sentence
    """
    mine = options_of(name, plant)
    if option not in mine:
        others = {o for other in experiments_of(plant) for o in options_of(other, plant)}
        own = " ".join(sorted(mine))
        if option in others:
            raise InputError(
                "simulate", f"{name}: {option}", "an option of another scenario", own or "none of its own"
            )
        known = " ".join([own, *general]).strip()
        raise InputError("simulate", f"{name}: {option}", "an unknown option", f"one of {known}")
    return mine[option]


def _check(name: str, plant: Plant, options: Mapping[str, Any]) -> None:
    """InputError for an unknown experiment, an unknown option, or a value of the wrong kind."""
    mine, check = options_of(name, plant), setting(plant, "check", None)
    for option, value in options.items():
        if option in OPTIONS and option not in mine:
            continue
        expected = _expected_kind(value, option_of(name, plant, option))
        if expected:
            raise InputError("simulate", f"{name}: {option}", repr(value), expected)
        if check is not None:
            check(name, option, value)


def _expected_kind(value: Any, default: Any) -> str:
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
