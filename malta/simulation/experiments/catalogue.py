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
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from functools import partial
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.display import quantity
from malta.errors import CheckError, InputError
from malta.model.parts import INSTALL_PAPERS, has_papers, parts_of
from malta.model.places import holdable_outputs, place_states
from malta.model.plant import Plant, given_plant
from malta.model.plants import plant_of
from malta.model.printed import published_figures
from malta.simulation import references
from malta.simulation.engine.engines import EngineChoice
from malta.simulation.experiments import (
    Case,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    choose_signals,
    experiment_of,
    fly,
    merits_of_first,
    rms,
    scenario_of,
    setting,
    step_wrench,
    with_exact_sensors,
    with_fidelity,
)
from malta.simulation.experiments.worst_load import LOAD_SHARE, WORST_LOAD, worst_load_cases
from malta.simulation.references import Motion, Reference
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import EngineOf
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller, given_law
from malta.units import FINE_UNITS

# Experiments of any machine: hold still, step an output, push.
#
# hold         motion and commands at rest, with sensors as built
# step         a step of one output after the other
# disturbance  a constant force or torque on each input of disturbance in turn
# worst-load   the load of bounded size whose waveform moves one signal furthest; any machine on which loads act has it
#
# A machine that defines no experiments has all of these. Their options are in SI.


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
    """A step of one output, or of each in turn, by `size` (SI; 0: a tenth of the clearance), with exact sensors.

    Raises InputError for an output that no machine at rest is at, as an acceleration.
    """
    duration, planned, held = _duration(controller, time), list[PlannedRun](), holdable_outputs(plant)
    for k in choose_signals(plant.outputs, output, "output") if output != "all" else held:
        if k not in held:
            names = " ".join(plant.outputs[j].name for j in held)
            found = f"{output}, which no constant holds at rest"
            raise InputError("simulate", "output", found, f"all, or one of {names}")
        signal, distance = plant.outputs[k], size or default_step(plant, k)
        reference = partial(jump, output=k, size=distance, at=LEAD_SHARE * duration)
        scenario = scenario_of("step", duration, reference, with_exact_sensors(with_fidelity(plant, options)))
        planned.append(PlannedRun(signal.name, scenario, partial(_step_merits, output=k, size=distance)))
    return planned


def disturbance_cases(
    plant: Plant,
    controller: Controller,
    *,
    on: str = "all",
    size: float = 0.0,
    time: float = 0.0,
    **options: Any,
) -> list[PlannedRun]:
    """A constant load of `size` (SI; 0: 1, or what half of the way to a contact takes) on one disturbance, or on each.

    Raises InputError for a machine without inputs of disturbance.
    """
    if not plant.disturbances:
        raise InputError(plant.name, "disturbances", "none", "a machine on which forces act from outside")
    duration, planned = _duration(controller, time), []
    for k in choose_signals(plant.disturbances, on, "on"):
        load, signal = size or default_load(controller, k), plant.disturbances[k]
        push = partial(
            step_wrench, column=k, size=load, at=LEAD_SHARE * duration, width=len(plant.disturbances)
        )
        given = with_exact_sensors(with_fidelity(plant, options)) | {"disturbance": push}
        scenario = scenario_of("disturbance", duration, references.hold, given)
        label = signal.name if size or load == 1 else f"{signal.name} of {quantity(load, signal.unit)}"
        planned.append(PlannedRun(label, scenario, _load_merits))
    return planned


def jump(plant: Plant, output: int, size: float, at: float) -> Reference:
    """One output steps by `size` at `at` (s), the others stay at zero."""

    def motion(t: FloatArray) -> Motion:
        p = np.zeros((len(t), len(plant.outputs)))
        p[np.asarray(t) >= at, output] = size
        return Motion(p, np.zeros_like(p), np.zeros_like(p))

    return motion


def default_step(plant: Plant, output: int) -> float:
    """A tenth of the clearance of an output, SI, or of what its sensor reads; without either, ten times its noise."""
    touch, end = _rooms(plant, output)
    return float(min(_probe(plant, output) if np.isinf(touch) else CLEARANCE * touch, CLEARANCE * end))


def default_load(controller: Controller, disturbance: int) -> float:
    """1 SI, or less where that moves an output more than half of the way to a contact or to its sensor's end.

    By the linear loop of the gain file's machine, so that all machines of a campaign are pushed alike.
    """
    from malta.loops.loop import loop_along  # here: most experiments need no linear loop

    plant = plant_of(controller.parameters)
    try:
        moved = loop_along(plant, controller).sampled.answer(disturbance).largest[:, 0]
    except CheckError:  # an unstable loop
        return 1.0
    used = max(x / min(_rooms(plant, k)) for k, x in enumerate(moved.tolist()))
    return 1.0 if used <= LOAD_SHARE else float(f"{LOAD_SHARE / used:.1g}")


def _probe(plant: Plant, output: int) -> float:
    return max(10 * plant.sensors.noise[output], SIZE)


def _rooms(plant: Plant, output: int) -> tuple[float, float]:
    """How far an output moves from rest to a contact, and to the end of what its sensor reads, SI; infinite: never."""
    y, end = np.zeros(len(plant.outputs)), plant.sensors.range[output] or np.inf
    y[output] = _probe(plant, output)
    if not plant.contacts.names:
        return np.inf, end
    x = place_states(plant, ca.DM(plant.position_of(ca.DM(y))))
    used = float(np.max(np.array(ca.DM(plant.contacts.contact(x)))))
    return (y[output] / used if used > 0 else np.inf), end


def _duration(controller: Controller, time: float) -> float:
    return time or SAMPLES * controller.sample_time


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
    """Figures of the output that moves furthest, of each unit."""
    error, merits = np.abs(run.p - run.reference), list[Merit]()
    for unit in dict.fromkeys(signal.unit for signal in run.plant.outputs):
        alike = [k for k, signal in enumerate(run.plant.outputs) if signal.unit == unit]
        k = alike[int(error[:, alike].max(axis=0).argmax())]
        name, fine = run.plant.outputs[k].name, FINE_UNITS.get(unit, unit)
        merits.append(Merit(f"{name} moves by", float(error[:, k].max()), fine))
        merits.append(Merit(f"{name}, left at the end", float(error[-1, k]), fine))
    return tuple(merits)


QUESTIONS = {
    "hold": "How still does it stand?",
    "step": "Does it go where it is sent?",
    "disturbance": "How far does a load move it, and does it come back?",
    WORST_LOAD: "How far does the worst of all loads of this size move it?",
}
CASES: Mapping[str, Callable[..., list[PlannedRun]]] = {
    "hold": hold_cases,
    "step": step_cases,
    "disturbance": disturbance_cases,
    WORST_LOAD: worst_load_cases,
}
EXPERIMENTS: Mapping[str, Callable[..., Experiment]] = {
    name: experiment_of(name, question, CASES[name], merits_of_first) for name, question in QUESTIONS.items()
}


# Fields of a scenario that the experiment itself decides. All others are options, and so is the engine.
EXPERIMENT_FIELDS = {
    *("name", "reference", "start", "cold", "disturbance", "anticipated", "excitation"),
    *("faults", "correction", "changes"),
}
COMMON_UNITS = {"distance": "m", "rise": "s", "settle": "s", "time": "s"}  # of options of many experiments
SIZED = {"step", "disturbance", WORST_LOAD}  # experiments here with a `size`, in the unit of signals
OPTIONS = {f.name for f in fields(Scenario)} - EXPERIMENT_FIELDS | {"engine"}


def experiments_of(plant: Plant) -> Mapping[str, Callable[..., Experiment]]:
    """The experiments of a machine by name, its main job first."""
    return _own(plant, "EXPERIMENTS", EXPERIMENTS)


def series_of(plant: Plant) -> Mapping[str, Callable[..., list[PlannedRun]]]:
    """The functions that list the runs of an experiment for campaigns, by the experiment's name."""
    return _own(plant, "CASES", {} if _has_own(plant) else CASES)


def _has_own(plant: Plant) -> bool:
    return setting(plant, "EXPERIMENTS", None) is not None


def _own(plant: Plant, name: str, default: Mapping[str, Any]) -> Mapping[str, Any]:
    """The entries that a machine has of a setting, and the worst load's, which every machine under loads has."""
    found: dict[str, Any] = dict(setting(plant, name, default))
    found.setdefault(WORST_LOAD, (EXPERIMENTS if name == "EXPERIMENTS" else CASES)[WORST_LOAD])
    if not plant.disturbances:
        del found[WORST_LOAD]
    return found


def main_job(plant: Plant) -> str:
    """The name of the experiment that every design has to complete."""
    return next(iter(experiments_of(plant)))


def settling_option(name: str, plant: Plant, controller: Controller) -> dict[str, float]:
    """The option with which yields of an experiment are counted: the machine's SETTLE before its main job.

    A machine without experiments of its own rests for SAMPLES before each: v0 is not what another mass needs.
    """
    if not _has_own(plant):
        return {"settle": SAMPLES * controller.sample_time}
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
    controller = given_law("experiment", controller)
    plant = given_plant("experiment", plant)
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
        more = (
            "" if has_papers() or published_figures(plant.name) is None else f"; or one of {INSTALL_PAPERS}"
        )
        raise InputError("simulate", "scenario", repr(name), "one of " + ", ".join(known) + more)
    parameters = inspect.signature(known[name]).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY and p.name != "progress"}


def option_units(name: str, plant: Plant, options: Mapping[str, str] | None = None) -> dict[str, str]:
    """SI units of an experiment's options by name; of a `size`, that of all signals that `options` choose, or none."""
    units: dict[str, str] = COMMON_UNITS | setting(plant, "OPTION_UNITS", {})
    if name not in SIZED or experiments_of(plant).get(name) is not EXPERIMENTS[name]:
        return units
    given = options or {}
    if name == "step":
        signals, which = [plant.outputs[k] for k in holdable_outputs(plant)], given.get("output", "all")
    else:
        signals = list(plant.disturbances)
        which = given.get("on") or (signals[0].name if name == WORST_LOAD else "all")
    chosen = {s.unit for s in signals if which in ("all", s.name)}
    return {"size": chosen.pop() if len(chosen) == 1 else ""} | units


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


def check_of(name: str, plant: Plant) -> Callable[[str, str, Any], None] | None:
    """The function `check` for the options of an experiment, of its paper where that has the experiment."""
    _, printed = parts_of("experiments", plant.name)
    if name == WORST_LOAD:
        return None
    of_paper = name in getattr(printed, "EXPERIMENTS", ())
    found: Callable[[str, str, Any], None] | None
    found = getattr(printed, "check", None) if of_paper else setting(plant, "check", None)
    return found


def _check(name: str, plant: Plant, options: Mapping[str, Any]) -> None:
    """InputError for an unknown experiment, an unknown option, or a value of the wrong kind."""
    mine, check = options_of(name, plant), check_of(name, plant)
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
        if not _is_number(value):
            return "a number"
        return "" if math.isfinite(value) else "a finite number"
    if isinstance(default, tuple):
        several = isinstance(value, tuple | list) and len(value) > 0
        return "" if several and all(map(_is_number, value)) else "numbers"
    return ""  # words are looked up where they are used


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
