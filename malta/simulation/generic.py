"""Experiments of any machine: hold still, step an output, push.

hold         motion and commands at rest, with sensors as built
step         a step of one output after the other
disturbance  a constant force or torque on each input of disturbance in turn

A machine that defines no experiments has these. Their options are in SI.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.model.plant import Plant, Signal
from malta.model.signals import FINE
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    rms,
    scenario_of,
)
from malta.simulation.layout import fidelities
from malta.simulation.references import Motion, Reference
from malta.simulation.responses import step_wrench
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

SAMPLES = 2000  # of a run without a `time`
BEFORE = 0.1  # share of the run before a step or a load
CLEARANCE = 0.1  # of a step of default size, as a share of the clearance
SIZE = 1e-5  # SI, of a step of a machine without contacts and without noise


def hold(
    plant: Plant,
    controller: Controller,
    *,
    time: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Hold still for `time` (s; 0: 2000 samples), with the noise of the sensors as built."""
    planned = hold_cases(plant, controller, time=time, **options)
    cases, cut = fly(plant, controller, planned, progress, options)
    return Experiment("hold", "How still does it stand?", cases, cases[0].merits, interrupted=cut)


def hold_cases(plant: Plant, controller: Controller, *, time: float, **options: Any) -> list[PlannedRun]:
    """The run of `hold`."""
    scenario = scenario_of(
        "hold", _duration(controller, time), references.hold, _with_fidelity(plant, options)
    )
    return [PlannedRun("hold", scenario, _rest_merits)]


def step(
    plant: Plant,
    controller: Controller,
    *,
    output: str = "all",
    size: float = 0.0,
    time: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A step of one output, or of each in turn, by `size` (SI; 0: a tenth of the clearance), with exact sensors."""
    planned = step_cases(plant, controller, output=output, size=size, time=time, **options)
    cases, cut = fly(plant, controller, planned, progress, options)
    return Experiment("step", "Does it go where it is sent?", cases, cases[0].merits, interrupted=cut)


def step_cases(
    plant: Plant, controller: Controller, *, output: str, size: float, time: float, **options: Any
) -> list[PlannedRun]:
    """The runs of `step`."""
    duration, planned = _duration(controller, time), []
    for k in _choose(plant.outputs, output, "output"):
        signal, distance = plant.outputs[k], size or default_step(plant, k)
        reference = partial(jump, output=k, size=distance, at=BEFORE * duration)
        scenario = scenario_of(
            "step", duration, reference, _with_exact_sensors(_with_fidelity(plant, options))
        )
        planned.append(PlannedRun(signal.name, scenario, partial(_step_merits, output=k, size=distance)))
    return planned


def disturbance(
    plant: Plant,
    controller: Controller,
    *,
    on: str = "all",
    size: float = 1.0,
    time: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A constant force or torque of `size` (N or N m) on one input of disturbance, or on each in turn."""
    planned = disturbance_cases(plant, controller, on=on, size=size, time=time, **options)
    cases, cut = fly(plant, controller, planned, progress, options)
    question = "How far does a load move it, and does it come back?"
    return Experiment("disturbance", question, cases, cases[0].merits, interrupted=cut)


def disturbance_cases(
    plant: Plant, controller: Controller, *, on: str, size: float, time: float, **options: Any
) -> list[PlannedRun]:
    """The runs of `disturbance`. Raises InputError for a machine without inputs of disturbance."""
    if not plant.disturbances:
        raise InputError(plant.name, "disturbances", "none", "a machine on which forces act from outside")
    duration, planned = _duration(controller, time), []
    for k in _choose(plant.disturbances, on, "on"):
        push = partial(step_wrench, column=k, size=size, at=BEFORE * duration, width=len(plant.disturbances))
        given = _with_exact_sensors(_with_fidelity(plant, options)) | {"disturbance": push}
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
    probe = max(10 * plant.noise[output], SIZE)
    y[output] = probe
    if plant.contacts:
        x = plant.at().x.copy()
        positions = np.array(ca.DM(plant.position_of(ca.DM(y)))).ravel()
        x[list(plant.controlled)[: len(positions)]] = positions
        used = float(np.max(np.array(ca.DM(plant.contact(ca.DM(x))))))
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


def _with_fidelity(plant: Plant, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options with the default fidelity: "dq" for machines with windings, else "force"."""
    return {"fidelity": "dq" if "dq" in fidelities(plant) else "force"} | dict(options)


def _with_exact_sensors(options: Mapping[str, Any]) -> dict[str, Any]:
    return {"noise": 0.0, "quantize": False} | dict(options)


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    error, merits = run.p - run.reference, []
    for k, s in enumerate(run.plant.outputs):
        merits.append(Merit(f"{s.name}, rms", rms(error[:, k]), FINE.get(s.unit, s.unit)))
    for k, s in enumerate(run.plant.inputs):
        merits.append(Merit(f"{s.name}, rms", float(run.v[:, k].std()), s.unit))
    return tuple(merits)


def _step_merits(run: Trajectory, output: int, size: float) -> tuple[Merit, ...]:
    first = int(BEFORE * len(run.t))
    share = (run.p[first:, output] - run.reference[0, output]) / size
    t = run.t[first:] - run.t[first]
    outside = np.flatnonzero(np.abs(share - 1) > 0.02)
    settled = float(t[outside[-1]]) if len(outside) and outside[-1] + 1 < len(t) else float("nan")
    others = np.delete(run.p - run.reference, output, axis=1)
    unit = run.plant.outputs[output].unit
    merits = [
        Merit("overshoot", max(0.0, float(share.max()) - 1), "percent"),
        Merit("within 2 % after", settled, "ms", key="settled"),
        Merit("left at the end", abs(float(share[-1]) - 1) * abs(size), FINE.get(unit, unit)),
    ]
    units = {s.unit for k, s in enumerate(run.plant.outputs) if k != output}
    if others.size and len(units) == 1:
        (other,) = units
        merits.append(Merit("others move by", float(np.abs(others).max()), FINE.get(other, other)))
    return tuple(merits)


def _load_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Figures of the output that moves furthest."""
    error = np.abs(run.p - run.reference)
    k = int(error.max(axis=0).argmax())
    signal = run.plant.outputs[k]
    fine = FINE.get(signal.unit, signal.unit)
    return (
        Merit(f"{signal.name} moves by", float(error[:, k].max()), fine),
        Merit(f"{signal.name}, left at the end", float(error[-1, k]), fine),
    )


EXPERIMENTS: Mapping[str, Callable[..., Experiment]] = {
    "hold": hold,
    "step": step,
    "disturbance": disturbance,
}
CASES: Mapping[str, Callable[..., list[PlannedRun]]] = {
    "hold": hold_cases,
    "step": step_cases,
    "disturbance": disturbance_cases,
}
