"""Nonlinear machine + gain file + scenario -> trajectory.

At every sample the control law of synthesis/controller.py runs on the measurements; between samples the machine moves
by Runge–Kutta steps. Both are functions of period.py, and an engine of engines.py runs them. The gain file's record is
all that the simulation knows of the controller; the machine may have other parameters than that record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from malta.errors import InputError
from malta.model.data import plant_of, shaping, units_of
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.engines import EngineChoice, engine_of, evaluate, substeps_until
from malta.simulation.inputs import electronics_noise, initial_values, inputs_of, sample_inputs, sensor_noise
from malta.simulation.layout import Setup
from malta.simulation.period import initial_state_function
from malta.simulation.scenario import Scenario, setup_of, steps_of, substeps_of
from malta.simulation.trajectory import Trajectory, label_rows
from malta.simulation.verdict import Verdict, columns_of, judge
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

PORTION = 20_000  # samples between looks at how the run goes


def simulate(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    engine: EngineChoice = "auto",
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """Run a scenario. Touchdown and divergence end it early and are named in the verdict, not raised.

    engine : "auto" compiles where there is a C compiler
    progress : told the share that is done, now and then; Ctrl-C ends the run there and keeps what was computed

    Raises InputError when plant and controller do not belong together or the scenario does not fit the plant.
    """
    believed = plant_of(controller.parameters)
    if (plant.inputs, plant.outputs) != (believed.inputs, believed.outputs):
        raise InputError("simulate", "controller", f"gains of a {believed.name}", f"gains of a {plant.name}")
    if engine not in get_args(EngineChoice):
        raise InputError("simulate", "engine", repr(engine), "one of " + ", ".join(get_args(EngineChoice)))
    setup = setup_of(plant, controller, scenario)
    t, motion, given = inputs_of(plant, controller, scenario, setup)
    samples = len(t)
    stages = _stages(plant, scenario, controller.sample_time)
    noise = sensor_noise(stages, scenario, t)
    steps = substeps_of(plant, controller, setup, scenario)
    fast = electronics_noise(plant, setup, scenario, substeps_until(samples, steps))
    x, xi_pred, current = initial_values(plant, controller, scenario, given[0])
    start = initial_state_function(plant, controller, setup)
    state = evaluate(start, x, xi_pred, current)[0].ravel()
    observer = _observer(plant, controller, scenario, setup) if setup.outside else None
    every = _samples_between_stops(scenario, controller.sample_time)
    stops = _stops(every, samples, [first for first, _ in stages])
    parts: list[FloatArray] = []
    verdict, kind, done = None, "", 0
    try:
        for stop in stops:
            now = next(p for first, p in reversed(stages) if first <= done)
            run = engine_of(now, controller, setup, steps, _sensor_errors(scenario), engine)
            part = given[done:stop]
            jitter = fast[substeps_until(done, steps) : substeps_until(stop, steps)]
            if observer is None:
                state, rows = run.run(done, state, part, noise[done:stop], jitter)
            else:
                state, rows = observer(run, now, state, part, noise[done:stop])
            rows, verdict = judge(plant, controller, setup, rows, t[done:stop])
            parts.append(rows)
            kind, done = run.kind, done + len(rows)
            if verdict is not None:
                break
            if progress is not None:
                progress(done / samples)
            if scenario.correction is not None and done < samples and done % every == 0:
                offset = np.asarray(
                    scenario.correction.update(
                        float(t[done]), columns_of(plant, controller, setup, rows[-1], "p")
                    ),
                    dtype=float,
                )
                if offset.shape != motion.p.shape[1:]:
                    expected = f"{motion.p.shape[1]} numbers"
                    raise InputError(
                        f"scenario {scenario.name}", "correction", f"shape {offset.shape}", expected
                    )
                # Up to the next correction; the samples before are there for the feedforward under way.
                before = min(done, controller.delay)
                ahead = slice(done - before, done + every)
                p_ref = motion.p[ahead] + offset
                p_ref[:before] = given[done - before : done, : len(offset)]  # as they were
                shifted = references.Motion(*(part[ahead] for part in motion))._replace(p=p_ref)
                new = sample_inputs(plant, controller, scenario, setup, shifted, t[ahead])
                given[done : done + every] = new[before:]
    except KeyboardInterrupt:
        if not parts:
            raise
        verdict = Verdict("interrupted", float(t[done - 1]))
    table = np.concatenate(parts) if len(parts) > 1 else parts[0]
    return label_rows(plant, controller, scenario, setup, (t, given), table, verdict, kind)


def integration_error(run: Trajectory) -> float:
    """Largest error of an output that the Runge–Kutta steps made, m: against the same run with twice as many.

    Halving the steps of a fourth-order method leaves 1/16 of the error, so the difference is 15/16 of it.
    """
    s = run.scenario
    count = steps_of(run.plant, run.controller, s)
    finer = simulate(run.plant, run.controller, replace(s, substeps=2 * count))
    k = min(len(run.p), len(finer.p))
    return float(np.abs(run.p[:k] - finer.p[:k]).max()) * 16 / 15


def _sensor_errors(scenario: Scenario) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((scenario.sensor_errors or {}).items()))


def _observer(plant: Plant, c: Controller, scenario: Scenario, setup: Setup) -> Any:
    from malta.simulation.start_up import observer  # filterpy takes a while to import

    count = steps_of(plant, c, scenario)
    return observer(plant, c, setup, scenario.estimator, count, scenario.sensor_errors)


def _stages(plant: Plant, scenario: Scenario, Ts: float) -> list[tuple[int, Plant]]:
    """From which sample on which machine is simulated."""
    stages = [(0, plant)]
    for at, values in sorted(scenario.changes, key=lambda change: change[0]):
        known = units_of(plant.parameters)
        for name in values:
            if name not in known:
                raise InputError(
                    f"scenario {scenario.name}", f"changes.{name}", "an unknown parameter", " ".join(known)
                )
            if name in shaping(plant.parameters):
                found = "a parameter that shapes the machine's functions"
                raise InputError(
                    f"scenario {scenario.name}", f"changes.{name}", found, "one that enters them"
                )
        before = stages[-1][1]
        par: Any = replace(before.parameters, **values)
        stages.append((max(0, round(at / Ts)), before.variant(par)))
    return stages


def _samples_between_stops(scenario: Scenario, Ts: float) -> int:
    """Samples between corrections of the reference, or between looks at the run."""
    return PORTION if scenario.correction is None else max(1, round(scenario.correction.every / Ts))


def _stops(every: int, samples: int, changes: list[int]) -> list[int]:
    """Samples at which the run pauses: to look, to correct the reference, to change the machine."""
    marks = set(range(every, samples, every)) | set(range(PORTION, samples, PORTION)) | {samples}
    return sorted(marks | {k for k in changes if 0 < k < samples})
