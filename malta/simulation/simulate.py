"""Nonlinear machine + gain file + scenario -> trajectory.

At every sample the control law of synthesis/controller.py runs on the measurements; between samples the machine moves
by Runge–Kutta steps. Both are functions of period.py, and an engine of engines.py runs them. The gain file's record is
all that the simulation knows of the controller; the machine may have other parameters than that record."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, get_args

import numpy as np

from malta.errors import InputError
from malta.model.data import plant_of
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.engines import Engine, EngineChoice, engine_of, substeps_until
from malta.simulation.inputs import (
    Inputs,
    sample_inputs,
    samples_of_memory,
)
from malta.simulation.prepared import Prepared, prepare
from malta.simulation.scenario import (
    MOST_SUBSTEPS,
    Scenario,
    Simulation,
    steps_of,
)
from malta.simulation.trajectory import Trajectory, label_rows
from malta.simulation.verdict import Verdict, columns_of, judge
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.simulation.start_up import Observer

EngineOf = Callable[[Prepared, Plant, float], Engine]  # (what a run begins with, machine, substeps) -> engine
PORTION = 20_000  # samples of the longest portion: between two portions progress is reported
WORK = 200_000  # substeps of the longest portion


def simulate(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    engine: EngineChoice | EngineOf = "auto",
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """Simulate a scenario: the sampled controller on the nonlinear machine, Runge-Kutta steps between samples.

    Touchdown and divergence end the run early; the verdict names them, and nothing is raised. After Ctrl-C the
    trajectory has the samples that were computed, and the verdict "interrupted".

    plant : the machine
    controller : its controller, which may have been designed for other parameters
    scenario : reference, start, disturbances, noise, faults and fidelity
    engine : "auto" compiles where there is a C compiler; a function makes the engine of a run, as `malta.engine_of_c`
    progress : called now and then with the share of the samples that is done, 0 to 1

    Returns a Trajectory: time series in SI, a row for each sample.

    Raises InputError when plant and controller do not belong together or the scenario does not fit the plant.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(10e-3))
    >>> run.verdict.completed, f"z = {1e3 * run.p[-1, -1]:.3f} mm"
    (True, 'z = 4.993 mm')
    """
    believed = plant_of(controller.parameters)
    if (plant.inputs, plant.outputs) != (believed.inputs, believed.outputs):
        raise InputError("simulate", "controller", f"gains of a {believed.name}", f"gains of a {plant.name}")
    if not callable(engine) and engine not in get_args(EngineChoice):
        raise InputError("simulate", "engine", repr(engine), "one of " + ", ".join(get_args(EngineChoice)))
    ready = prepare(plant, controller, scenario)
    simulation, inputs = ready.simulation, ready.inputs
    parts: list[FloatArray] = []
    verdict: Verdict | None = None
    kind, done = "", 0
    try:
        for rows, end, engine_kind in _portions(ready, engine):
            parts.append(rows)
            verdict, kind, done = end, engine_kind, done + len(rows)
            if verdict is not None:
                break
            if progress is not None:
                progress(done / len(inputs.t))
    except KeyboardInterrupt:
        if not parts:
            raise
        verdict = Verdict("interrupted", float(inputs.t[done - 1]))
    table = np.concatenate(parts) if len(parts) > 1 else parts[0]
    return label_rows(simulation, inputs, table, verdict, kind)


def _portions(
    ready: Prepared, choice: EngineChoice | EngineOf
) -> Iterator[tuple[FloatArray, Verdict | None, str]]:
    """Simulate portion by portion: rows, the verdict if one ends the run there, and the engine's kind.

    Between portions the machine's parameters may change, and an outer loop may correct the reference.
    """
    simulation, (t, _, given), state, stages, steps, noise, fast = ready
    _, controller, scenario, setup = simulation
    samples = len(t)
    observer = _observer(simulation) if setup.outside else None
    every = _samples_between_stops(scenario, controller.sample_time)
    longest = max(1, min(PORTION, int(WORK / steps)))
    done = 0
    for stop in _stops(every, longest, samples, [first for first, _ in stages]):
        now = next(p for first, p in reversed(stages) if first <= done)
        if callable(choice):
            engine = choice(ready, now, steps)
        else:
            engine = engine_of(now, controller, setup, steps, sensor_errors_of(scenario), choice)
        part = slice(done, stop)
        if observer is None:
            jitter = fast[substeps_until(done, steps) : substeps_until(stop, steps)]
            state, rows = engine.run(done, state, given[part], noise[part], jitter)
        else:
            state, rows = observer(engine, now, state, given[part], noise[part])
        ended = observer is None and engine.kind == "compiled"
        rows, verdict = judge(simulation, rows, t[part], ended)
        done += len(rows)
        yield rows, verdict, engine.kind
        if scenario.correction is not None and done < samples and done % every == 0:
            p = columns_of(simulation, rows[-1], "p")
            offset = np.asarray(scenario.correction.update(float(t[done]), p), dtype=float)
            _correct(simulation, ready.inputs, slice(done, done + every), offset)


def _correct(simulation: Simulation, inputs: Inputs, ahead: slice, offset: FloatArray) -> None:
    """Add an outer loop's offset to the reference of the samples `ahead`, in place. Raises InputError for its shape."""
    t, motion, given = inputs
    if offset.shape != motion.p.shape[1:]:
        where, expected = f"scenario {simulation.scenario.name}", f"{motion.p.shape[1]} numbers"
        raise InputError(where, "correction", f"shape {offset.shape}", expected)
    # The feedforward that is under way needs the samples before, with the reference that they had.
    before = min(ahead.start, samples_of_memory(simulation.controller))
    span = slice(ahead.start - before, ahead.stop)
    p_ref = motion.p[span] + offset
    p_ref[:before] = given[span.start : ahead.start, : len(offset)]
    shifted = references.Motion(*(part[span] for part in motion))._replace(p=p_ref)
    given[ahead] = sample_inputs(simulation, shifted, t[span])[before:]


def integration_error(run: Trajectory) -> float:
    """Largest error of an output (m) that the Runge–Kutta steps make, from a second run with twice as many steps.

    Half the step of a fourth-order method leaves 1/16 of the error, so the runs differ by 15/16 of it. Where twice as
    many are too many, the second run has half as many steps and differs by 15 times the error.
    """
    s = run.scenario
    count = steps_of(run.plant, run.controller, s)
    finer = 2 * count <= MOST_SUBSTEPS
    other = simulate(run.plant, run.controller, replace(s, substeps=2 * count if finer else count // 2))
    k = min(len(run.p), len(other.p))
    return float(np.abs(run.p[:k] - other.p[:k]).max()) * (16 / 15 if finer else 1 / 15)


def sensor_errors_of(scenario: Scenario) -> tuple[tuple[str, float], ...]:
    """Errors of the sensors by name, as a key of `engine_of`'s memory."""
    return tuple(sorted((scenario.sensor_errors or {}).items()))


def _observer(simulation: Simulation) -> Observer:
    """The Kalman filter of a scenario that asks for one."""
    from malta.simulation.start_up import observer  # filterpy takes a while to import

    return observer(simulation, steps_of(simulation.plant, simulation.controller, simulation.scenario))


def _samples_between_stops(scenario: Scenario, Ts: float) -> int:
    """Samples from one correction of the reference to the next, or PORTION without corrections."""
    return PORTION if scenario.correction is None else max(1, round(scenario.correction.every / Ts))


def _stops(every: int, longest: int, samples: int, changes: list[int]) -> list[int]:
    """Samples at which a portion ends: for progress, a correction of the reference, or a change of the machine."""
    marks = set(range(every, samples, every)) | set(range(longest, samples, longest)) | {samples}
    return sorted(marks | {k for k in changes if 0 < k < samples})
