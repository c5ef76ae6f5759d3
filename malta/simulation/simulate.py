"""Nonlinear machine + gain file + scenario -> trajectory.

At every sample the control law of synthesis/controller.py runs on the measurements; between samples the machine moves
by Runge–Kutta steps. Both are functions of period.py, and an engine of engines.py runs them. The gain file's record is
all that the simulation knows of the controller; the machine may have other parameters than that record.

Kalman filters for a start with an unknown state: filterpy's, on the CasADi model of the machine.

    kalman     time-varying, on the linear model of the gain file; its gain is large at first
    extended   on the nonlinear machine of the gain file, with gravity, cogging and touchdown bearings, so that it
               accounts for the force of a bearing on a mover that rests there

Both start from the first measurement: positions as measured, and zero rates with the variance that a difference of two
measurements would have. Covariances of forces and sensors are those of the gain file's filter.
"""

from __future__ import annotations

import math
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple, get_args

import casadi as ca
import numpy as np
from scipy.linalg import LinAlgWarning

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.sampling import sample
from malta.model.currents import is_commutated
from malta.model.parameters import shape_parameters, units_of
from malta.model.places import place_states
from malta.model.plant import Plant, given_plant
from malta.model.plants import plant_of
from malta.model.readings import require_readings
from malta.simulation import references
from malta.simulation.divergence import rooms_in, rooms_of
from malta.simulation.engine.engines import Engine, EngineChoice, engine_of, evaluate, substeps_until
from malta.simulation.inputs import (
    Inputs,
    electronics_noise,
    initial_values,
    inputs_of,
    sample_inputs,
    samples_of_memory,
    sensor_noise,
)
from malta.simulation.layout import layout_of, numbers_of
from malta.simulation.period import initial_state_function, period_of, runge_kutta
from malta.simulation.scenario import MOST_SUBSTEPS, Scenario, Simulation, machines_of, simulation_of
from malta.simulation.steps import steps_of, substeps_of
from malta.simulation.trajectory import Trajectory, Verdict, columns_of, judge, label_rows
from malta.synthesis.controller import Controller, Noise, given_law, noise_input

Observer = Callable[[Engine, Plant, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def observer(simulation: Simulation, substeps: int) -> Observer:
    """A function that simulates sample by sample with the estimate of a Kalman filter of filterpy.

    It takes (engine, machine, state, inputs, noise) and returns (state, rows), as an engine does.

    Raises InputError for a controller that is no LQG with integrals, and for a machine whose currents are held.
    """
    plant, c, scenario, setup = simulation
    kind, errors = scenario.estimator, scenario.sensor_errors
    filter_ = _kalman_filter(c, _noise_of(plant, c, kind))
    force = _acting_force(c)
    predict = _nonlinear_prediction(c) if kind == "extended" else _linear_prediction(c)
    jacobian, output = _measurement(c)

    @cache
    def sensors(now: Plant) -> ca.Function:
        return period_of(now, c, setup, numbers_of(now, c, substeps, errors), constant=True).sense

    sizes = layout_of(plant, c, setup).row
    edges = dict(zip(sizes, np.cumsum([0, *sizes.values()]), strict=False))
    commands = slice(edges["v"], edges["v"] + sizes["v"])
    axis = plant_of(c.parameters).leading_output
    n = len(c.A)
    under_way = np.zeros(len(c.Ad) - n)  # v - v0 behind the lag, and of the last samples, the oldest first
    loads: list[FloatArray] = []  # v0 of the last samples
    started = False

    def run(
        engine: Engine, machine: Plant, state: FloatArray, given: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        nonlocal started, under_way
        rows = []
        sense, none = sensors(machine), np.zeros((0, 0))
        for k in range(len(given)):
            y = evaluate(sense, state, given[k], noise[k], none)[0].ravel()[: len(c.measurements)]
            if not started:
                _start_filter(filter_, c, y)
                started = True
            _update(filter_, y, jacobian, output)
            now = given[k : k + 1].copy()
            now[0, -len(c.states) :] = np.concatenate([filter_.x, under_way])
            state, row = engine.run(0, state, now, noise[k : k + 1], none)
            rows.append(row)
            if not np.isfinite(row).all():
                break
            v0 = c.feedforward.at(y[axis])
            sent = row[0, commands] - v0
            acting = force(under_way, sent)
            under_way = c.Ad[n:, n:] @ under_way + c.Bd[n:] @ sent
            loads.append(v0)
            filter_.x, filter_.F = predict(filter_.x, acting, loads.pop(0) if len(loads) > c.stored else v0)
            filter_.P = filter_.F @ filter_.P @ filter_.F.T + filter_.Q
        return state, np.concatenate(rows)

    return _without_warnings(run)


def _without_warnings(run: Observer) -> Observer:
    """The same without a word of numpy or scipy: a filter that diverges ends its run with a verdict."""

    def quietly(*of: Any) -> tuple[FloatArray, FloatArray]:
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore", category=LinAlgWarning):
            return run(*of)

    return quietly


def _update(filter_: Any, y: FloatArray, jacobian: Any, output: Any) -> None:
    """The estimate with the readings y; NaN where estimate or covariance are no numbers."""
    try:
        filter_.update(y, jacobian, output)
    except (np.linalg.LinAlgError, ValueError):
        filter_.x = np.full(len(filter_.x), np.nan)


def fits_kalman_filter(c: Controller) -> bool:
    """Whether a controller has covariances for a filter of the mechanical states: an LQG with integrals."""
    return c.noise is not None and not c.observed


def _noise_of(plant: Plant, c: Controller, kind: str) -> Noise:
    """The covariances of a controller; InputError for one that these filters do not fit."""
    if c.noise is None or not fits_kalman_filter(c):
        without = "a PID" if c.tracks == "states" else "a law of errors"
        found = without if c.noise is None else "forces of disturbance in its own"
        raise InputError("simulate", f"estimator {kind}", found, "an LQG with integrals")
    believed = plant_of(c.parameters)
    believed.require_second_order(f"estimator {kind}")
    if is_commutated(believed):
        found = f"a {plant.name}, whose currents are held between samples"
        raise InputError("simulate", f"estimator {kind}", found, "steady-state, which knows of that")
    return c.noise


def _kalman_filter(c: Controller, noise: Noise) -> Any:
    """filterpy's filter with the covariances of the gain file, process noise held over a sample.

    Correlations of readings with accelerations are left out: they shape the filter in steady state.
    """
    from filterpy.kalman import ExtendedKalmanFilter  # brings scipy.stats: half a second to import

    n, p = len(c.A), len(c.measurements)
    kalman = ExtendedKalmanFilter(dim_x=n, dim_z=p, dim_u=len(c.forces))
    coordinates = c.cost.coordinates if c.cost else "signals"
    G = _constant_force_map(c)
    if coordinates != "signals":
        G = sample(c.A, noise_input(c.B, coordinates), c.sample_time)[1]
    kalman.Q = G * noise.process @ G.T
    kalman.R = np.diag(noise.sensor)
    kalman.x = np.zeros(n)
    return kalman


def _start_filter(kalman: Any, c: Controller, y: FloatArray) -> None:
    """Start from one measurement: positions P^-1 y with their covariance S, zero rates with 2 diag(S) / Ts^2."""
    believed = plant_of(c.parameters)
    symbol = ca.SX.sym("y", len(y))
    q = believed.position_of(symbol)
    values = ca.Function("q", [symbol], [q, ca.jacobian(q, symbol)])(y)
    position, J = np.array(values[0]).ravel(), np.array(values[1])
    half = len(position)
    kalman.x = np.concatenate([position, np.zeros(len(c.A) - half)])
    spread = J @ kalman.R @ J.T
    kalman.P = np.zeros((len(c.A), len(c.A)))
    kalman.P[:half, :half] = spread
    kalman.P[half:, half:] = 2 * np.diag(np.diag(spread)) / c.sample_time**2


def _linear_prediction(c: Controller) -> Callable[..., tuple[FloatArray, FloatArray]]:
    """(x, v, v0) -> A x + B v, and A."""
    n, B = len(c.A), _constant_force_map(c)
    A = c.Ad[:n, :n]
    return lambda x, v, _: (A @ x + B @ v, A)


def _constant_force_map(c: Controller) -> FloatArray:
    """What forces that are constant over a sample add to the mechanical states: n x m."""
    n, m = len(c.A), len(c.forces)
    if c.lagging or c.fraction:
        return sample(c.A, c.B, c.sample_time)[1]
    return c.Ad[:n, n : n + m] if c.stored else c.Bd[:n]


def _acting_force(c: Controller) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """(forces under way, force sent) -> forces over the next sample; where these change, a constant equivalent."""
    n, m = len(c.A), len(c.forces)
    if not (c.lagging or c.fraction):
        return lambda under_way, sent: under_way[:m] if c.stored else sent
    back = np.linalg.pinv(_constant_force_map(c))
    A, B = back @ c.Ad[:n, n:], back @ c.Bd[:n]
    return lambda under_way, sent: A @ under_way + B @ sent


# A bearing's contact at 2000 rad/s turns by 0.1 rad in such a step, of which a step errs by 1e-7: far below the noise.
PREDICTION_STEP = 50e-6  # s, of Runge and Kutta
MAX_PREDICTION_STEPS = 4


def _nonlinear_prediction(c: Controller) -> Callable[..., tuple[FloatArray, FloatArray]]:
    """(x, v, v0) -> one sample of the controller's machine under v + v0, with loads and bearings; and its Jacobian."""
    believed = plant_of(c.parameters)
    x, u = ca.SX.sym("x", len(believed.states)), ca.SX.sym("u", len(c.forces))
    steps = min(MAX_PREDICTION_STEPS, math.ceil(c.sample_time / PREDICTION_STEP - 1e-6))
    h = c.sample_time / steps

    def rate(z: Any, _: int) -> Any:
        return believed.f(z, u, believed.load(z) + believed.contacts.bearing(z))

    z = x
    for _ in range(steps):
        z = runge_kutta(rate, z, h)
    chosen = list(believed.controlled)
    transposed = ca.jacobian(z, x)[chosen, chosen].T  # a row of what `evaluate` returns is a column
    step = ca.Function("step", [x, u], [z[chosen], ca.densify(transposed)])

    def predict(estimate: FloatArray, v: FloatArray, v0: FloatArray) -> tuple[FloatArray, FloatArray]:
        full = np.zeros(len(believed.states))
        full[chosen] = estimate
        after, F = evaluate(step, full, v + v0)
        return after.ravel(), F

    return predict


def _measurement(c: Controller) -> tuple[Callable[..., FloatArray], Callable[..., FloatArray]]:
    """The functions x -> dh/dx and x -> h(x) of the controller's machine."""
    believed = plant_of(c.parameters)
    x = ca.SX.sym("x", len(c.A))
    y = believed.h(place_states(believed, x), 0)
    transposed = ca.densify(ca.jacobian(y, x).T)  # a row of what `evaluate` returns is a column
    slope, output = ca.Function("slope", [x], [transposed]), ca.Function("h", [x], [ca.densify(y)])
    return (
        lambda estimate: evaluate(slope, estimate)[0],
        lambda estimate: evaluate(output, estimate)[0].ravel(),
    )


# What a simulation begins with, remembered for runs that can only begin with the same again.


MAX_KEPT_SIMULATIONS = 8  # simulations
MAX_KEPT_BYTES = 4_000_000  # bytes of a simulation that is remembered


class Prepared(NamedTuple):
    """What a simulation begins with."""

    simulation: Simulation  # its records must live as long as their addresses are a key
    inputs: Inputs
    state: FloatArray  # of machine and controller at the start
    stages: list[tuple[int, Plant]]  # see stages_of
    substeps: float  # in a sample
    noise: FloatArray  # of the sensors, k x sensors
    fast_noise: FloatArray  # of the electronics, substeps x numbers
    rooms: FloatArray  # see rooms_of

    @property
    def size(self) -> int:
        """Bytes of its arrays."""
        arrays = (self.inputs.t, *self.inputs.motion, self.inputs.given, self.noise, self.fast_noise)
        return sum(array.nbytes for array in arrays)


_memory: OrderedDict[tuple[int, ...], Prepared] = OrderedDict()


def prepare(plant: Plant, controller: Controller, scenario: Scenario) -> Prepared:
    """The inputs of every sample, their noise and the first state; those of the last runs of the same records are
    remembered.

    Raises InputError as `simulation_of`, `inputs_of`, `stages_of`, `sensor_noise` and `substeps_of` do.
    """
    key = (id(plant), id(controller), id(scenario))
    found = _memory.get(key)
    if found is None:
        run = simulation_of(plant, controller, scenario)
        inputs = inputs_of(run)
        start = initial_state_function(run.plant, run.controller, run.setup)
        state = evaluate(start, *initial_values(run, inputs.given[0]))[0].ravel()
        stages = stages_of(plant, scenario, controller.sample_time)
        noise = sensor_noise(run, stages, inputs.t)
        steps = substeps_of(plant, controller, run.setup, scenario)
        fast = electronics_noise(run, substeps_until(len(inputs.t), steps))
        found = Prepared(run, inputs, state, stages, steps, noise, fast, rooms_of(run, inputs))
        if is_repeatable(scenario) and found.size <= MAX_KEPT_BYTES:
            _memory[key] = found
            if len(_memory) > MAX_KEPT_SIMULATIONS:
                _memory.popitem(last=False)
    return found


def is_repeatable(s: Scenario) -> bool:
    """Whether inputs follow from the scenario's own numbers: a reference of malta with numbers for arguments, and
    nothing that a caller may write into or that looks at the run."""
    reference = s.reference
    arguments: tuple[object, ...] = ()
    if isinstance(reference, partial):
        arguments = (*reference.args, *reference.keywords.values())
        reference = reference.func
    own = str(getattr(reference, "__module__", "")).partition(".")[0] == __name__.partition(".")[0]
    plain = all(isinstance(value, int | float | str | None) for value in arguments)
    functions = s.disturbance or s.anticipated or s.excitation or s.correction or s.electronics
    written = s.faults or s.start or s.changes or s.sensor_errors
    return own and plain and not functions and not written


def stages_of(plant: Plant, scenario: Scenario, Ts: float) -> list[tuple[int, Plant]]:
    """(first sample, machine): the machine before and after every change of its parameters.

    Raises InputError for unknown parameters, and for those that shape the machine's functions.
    """
    known, shaping = units_of(plant.parameters), shape_parameters(plant.parameters)
    for name in (name for _, values in scenario.changes for name in values):
        if name not in known:
            expected = "one of " + " ".join(known)
            raise InputError(scenario.where, f"changes.{name}", "an unknown parameter", expected)
        if name in shaping:
            found = "a parameter that shapes the machine's functions"
            raise InputError(scenario.where, f"changes.{name}", found, "one that enters them")
    before = scenario.settling_samples(Ts)
    firsts = [max(0, round(at / Ts) + before) for at in sorted(at for at, _ in scenario.changes)]
    return list(zip([0, *firsts], machines_of(plant, scenario), strict=True))


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
    engine : "auto" compiles where there is a C compiler; a function makes the engine of a run, as
        `malta.firmware.engine_of_c`
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
    controller = given_law("simulate", controller)
    plant = given_plant("simulate", plant)
    believed = plant_of(controller.parameters)
    if (plant.inputs, plant.outputs) != (believed.inputs, believed.outputs):
        raise InputError("simulate", "controller", f"gains of a {believed.name}", f"gains of a {plant.name}")
    if not callable(engine) and engine not in get_args(EngineChoice):
        raise InputError("simulate", "engine", repr(engine), "one of " + ", ".join(get_args(EngineChoice)))
    require_readings(plant)
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
    simulation, (t, _, given), state, stages, steps, noise, fast, rooms = ready
    plant, controller, scenario, setup = simulation
    samples, correction = len(t), scenario.correction
    watching = observer(simulation, steps_of(plant, controller, scenario)) if setup.outside else None
    every = PORTION if correction is None else max(1, round(correction.every / controller.sample_time))
    longest = max(1, min(PORTION, int(WORK / steps)))
    done = 0
    for stop in _stops(every, longest, samples, [first for first, _ in stages]):
        now = next(p for first, p in reversed(stages) if first <= done)
        if callable(choice):
            engine = choice(ready, now, steps)
        else:
            engine = engine_of(now, controller, setup, steps, sensor_errors_of(scenario), choice)
        part = slice(done, stop)
        if watching is None:
            jitter = fast[substeps_until(done, steps) : substeps_until(stop, steps)]
            state, rows = engine.run(done, state, given[part], noise[part], jitter)
        else:
            state, rows = watching(engine, now, state, given[part], noise[part])
        ended = watching is None and engine.kind == "compiled"
        used = rooms_in(simulation, rows, given[part][: len(rows)], rooms) if rooms.size else None
        rows, verdict = judge(simulation, rows, t[part], ended, used)
        done += len(rows)
        yield rows, verdict, engine.kind
        if correction is not None and done < samples and done % every == 0:
            p = columns_of(simulation, rows[-1], "p")
            offset = np.asarray(correction.update(float(t[done]), p), dtype=float)
            _correct(simulation, ready.inputs, slice(done, done + every), offset)


def _correct(simulation: Simulation, inputs: Inputs, ahead: slice, offset: FloatArray) -> None:
    """Add an outer loop's offset to the reference of the samples `ahead`, in place. Raises InputError for its shape."""
    t, motion, given = inputs
    if offset.shape != motion.p.shape[1:]:
        where, expected = simulation.scenario.where, f"{motion.p.shape[1]} numbers"
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
    steps = 2 * count if finer else count // 2
    other = simulate(run.plant, run.controller, replace(s, substeps=steps, accuracy=None))
    k = min(len(run.p), len(other.p))
    return float(np.abs(run.p[:k] - other.p[:k]).max()) * (16 / 15 if finer else 1 / 15)


def sensor_errors_of(scenario: Scenario) -> tuple[tuple[str, float], ...]:
    """Errors of the sensors by name, as a key of `engine_of`'s memory."""
    return tuple(sorted((scenario.sensor_errors or {}).items()))


def _stops(every: int, longest: int, samples: int, changes: list[int]) -> list[int]:
    """Samples at which a portion ends: for progress, a correction of the reference, or a change of the machine."""
    marks = set(range(every, samples, every)) | set(range(longest, samples, longest)) | {samples}
    return sorted(marks | {k for k in changes if 0 < k < samples})
