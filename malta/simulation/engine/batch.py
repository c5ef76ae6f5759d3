"""Many machines at once: the same scenario and controller on plants that all differ, each with its own noise.

With a C compiler, LANES machines share a SIMD register and the groups share the cores; each run leaves a digest only.
Run i of a seed does not depend on the other runs of its batch; `replay_run` gives its machine and scenario.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.parameters import is_default, shape_parameters, twins_of, units_of
from malta.model.plant import Plant, given_plant
from malta.model.plants import plant_of
from malta.simulation.divergence import rooms_of
from malta.simulation.engine.compiled import LANES, feedforward_table
from malta.simulation.engine.digest import (
    Batch,
    batch_of,
    cruise_functions,
    digest_function,
    digest_sizes,
    first_digest,
    recorder_function,
    restart,
    verdicts,
)
from malta.simulation.engine.engines import BLOCK, EngineChoice, engine_key, evaluate, library_of, shape_of
from malta.simulation.engine.lanes import (
    Lanes,
    Shared,
    TimeSpan,
    arrange_in_lanes,
    foresee_samples,
    numbers_in_lanes,
    run_many,
)
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.inputs import Inputs, initial_values, inputs_of
from malta.simulation.layout import electronics_of, flatten, layout_of, noise_scales, numbers_of, with_symbols
from malta.simulation.period import initial_state, period_of
from malta.simulation.readings import NOISE_SAMPLES_AT_ONCE, advance_keys, keys, starts_of_parts
from malta.simulation.scenario import Scenario, Simulation, setup_of, simulation_of
from malta.simulation.simulate import EngineOf, simulate
from malta.simulation.steps import steps_of
from malta.simulation.trajectory import Trajectory, trajectory_of
from malta.synthesis.controller import Controller, given_law

# Groups of machines on several threads: each takes the next call of the engine until none is left.


WORK = 2_000_000  # substeps of the groups in one call of the engine, at most: a fraction of a second
PROGRESS_INTERVAL = 0.1  # s from one report of progress to the next


class LaneWork(NamedTuple):
    """The runs of a batch, ready for the compiled engine; the lanes' keys are those of the parts."""

    lanes: Lanes
    shared: Shared
    parts: Sequence[TimeSpan]


def run_groups(lib: Any, work: LaneWork, workers: int, progress: Callable[[float], None] | None) -> None:
    """Simulate all groups of machines on several threads; the digests change in place."""
    lanes, shared, parts = work
    groups, done = len(lanes.states), list[int]()
    most = max(1, WORK // (len(shared.given) * shared.substeps))
    if len(parts) <= 2:  # a run, and perhaps the rest before it
        calls = _calls(groups, workers, 1, min(16, most))
    else:  # calls of short parts: the more groups in each, the less it counts
        step = min(64, -(-groups // workers), most)
        calls = _calls(groups, workers, step, step)

    def run() -> None:
        while True:
            try:
                chosen = calls.popleft()
            except IndexError:
                return
            run_many(lib, chosen, lanes, shared, parts)
            done.append(chosen.stop - chosen.start)

    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(run) for _ in range(min(workers, len(calls)))}
        try:
            while running:  # to wake up for every call takes time from the workers
                ended, running = wait(running, PROGRESS_INTERVAL, FIRST_EXCEPTION)
                for thread in ended:
                    thread.result()
                if progress is not None and done and calls:
                    progress(sum(done) / groups)
        except BaseException:
            calls.clear()
            raise
    if progress is not None:
        progress(1.0)


def _calls(groups: int, workers: int, least: int, most: int) -> deque[slice]:
    """Groups of each call of the engine: at most `most`, and towards the end fewer, so that threads end together."""
    calls, first = deque[slice](), 0
    while first < groups:
        size = max(least, min(most, (groups - first) // (2 * workers)))
        calls.append(slice(first, min(first + size, groups)))
        first += size
    return calls


def simulate_many(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    *,
    sensor_errors: Mapping[str, FloatArray] | None = None,
    starts: Mapping[str, FloatArray] | None = None,
    first: int = 0,
    noise: NDArray[np.int64] | None = None,
    workers: int | None = None,
    engine: EngineOf | None = None,
    progress: Callable[[float], None] | None = None,
) -> Batch:
    """Run a scenario on many machines, or from many starts, and keep the figures of each run.

    plant : the machine in the middle
    controller : of all runs
    scenario : of all runs
    changes : parameters of the machine by name, SI, a value for each run
    sensor_errors : errors of the sensors by name, SI, a value for each run, in place of the scenario's
    starts : states by name, SI, a value for each run, in place of the scenario's
    first : index of the first run; noise depends on scenario.seed and on the index
    noise : runs x parts: each of these equal parts of a run has the noise of the run of this index; None: its own
    workers : threads; None: one for each core
    engine : makes the engine of each run, one after the other, as `malta.firmware.engine_of_c`; None: all at once
    progress : called now and then with the share of the runs that is done, 0 to 1

    Returns a Batch: figures of each run, not its time series.

    Raises InputError for an unknown parameter, for columns of different length, and for a scenario with faults,
    changes, an outer loop or another estimator than "steady-state": `malta.simulate` runs those.

    >>> import malta
    >>> import numpy as np
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> masses = {"m": np.linspace(0.3, 0.4, 3)}
    >>> stroke = malta.Scenario.stroke(10e-3)
    >>> simulate_many = malta.simulation.simulate_many
    >>> batch = simulate_many(plant, controller, stroke, masses, workers=1)
    >>> [f"{1e3 * rise:.1f} ms" for rise in batch.rise]
    ['14.5 ms', '15.6 ms', '16.5 ms']
    """
    controller = given_law("simulate_many", controller)
    plant = given_plant("simulate_many", plant)
    for name in ("faults", "changes", "correction"):
        if getattr(scenario, name):
            raise InputError(scenario.where, name, "some", "none in a campaign")
    simulation = simulation_of(plant, controller, _with_sensor_errors(scenario, sensor_errors))
    _check(simulation, workers)
    variation = _variation(plant, changes, sensor_errors, starts, first, noise)
    for name in set(changes) & set(shape_parameters(plant.parameters)):
        raise InputError("campaign", name, "another one for each run", "one for all: it shapes the functions")
    if engine is not None:
        return _simulate_one_by_one(simulation, variation, progress, engine)
    alone, plant = simulation, with_varied(plant, changes)
    simulation = simulation_of(plant, controller, simulation.scenario)
    shape = shape_of(plant, controller, simulation.setup)
    compiled = library_of(shape, LANES, digest_function(shape), cruise_functions(shape))
    if compiled is None:
        return _simulate_one_by_one(alone, variation, progress)
    count = steps_of(alone.plant, controller, scenario)  # whatever the others of a batch are
    inputs, shared, lanes, parts = _prepare(simulation, variation, count)
    rooms = rooms_of(alone, inputs)
    digest, sizes = first_digest(plant, inputs.motion.p, rooms), digest_sizes(plant)
    groups, runs = len(lanes.states), variation.runs
    lanes = lanes._replace(digests=arrange_in_lanes(digest[None], groups))
    shared = shared._replace(foreseen=foresee_samples(compiled, lanes, shared))
    settled = scenario.settling_samples(controller.sample_time)
    if settled:
        sensors = lanes.sigma.shape[1]
        parts = _split(parts, settled, sensors, partial(restart, first=digest, sizes=sizes))
    run_groups(compiled, LaneWork(lanes, shared, parts), workers or os.cpu_count() or 1, progress)
    ends = lanes.digests.swapaxes(1, 2).reshape(groups * LANES, -1)[:runs]
    return batch_of(ends, len(inputs.t), controller.sample_time, sizes, settled)


class Variation(NamedTuple):
    """The values in which the runs of a batch differ, one for each run."""

    changes: Mapping[str, FloatArray]  # parameters of the machine by name, SI
    sensor_errors: Mapping[str, FloatArray]
    starts: Mapping[str, FloatArray]  # states by name, SI
    noise: NDArray[np.int64]  # runs x parts, index of the run whose noise a part has
    runs: int


def _prepare(
    simulation: Simulation, variation: Variation, count: int
) -> tuple[Inputs, Shared, Lanes, Sequence[TimeSpan]]:
    """Inputs that all machines share, each machine's own numbers in lanes, still without digests, and the noise.

    count : Runge-Kutta steps in a sample
    """
    plant, controller, scenario, setup = simulation
    runs = variation.runs
    values = numbers_of(plant, controller, count, scenario.sensor_errors)
    same, own = flatten(values), _own_numbers(plant, values, variation)
    inputs = inputs_of(simulation)
    start = _starts(simulation, inputs.given[0], variation.starts)
    states, noise = _starts_and_noise(
        _start_function(shape_of(plant, controller, setup)), (same, own), start, runs
    )
    groups = -(-runs // LANES)
    indices = variation.noise[np.minimum(np.arange(groups * LANES), runs - 1)]
    streams = np.moveaxis(keys(scenario.seed, indices).reshape(groups, LANES, -1), 2, 0)
    starts = starts_of_parts(len(inputs.t), len(streams))
    parts = [
        TimeSpan(slice(start, end), np.ascontiguousarray(advance_keys(stream, start, noise.shape[1])))
        for start, end, stream in zip(starts, [*starts[1:], len(inputs.t)], streams, strict=True)
        if end > start
    ]
    lanes = Lanes(
        theta=numbers_in_lanes(same, own, groups),
        states=arrange_in_lanes(states, groups),
        sigma=arrange_in_lanes(scenario.noise * noise, groups),
        keys=parts[0].keys,
        digests=np.empty((groups, 0, LANES)),
    )
    ff = controller.feedforward
    shared = Shared(inputs.given, feedforward_table(ff.z_grid, ff.v0), count, plant.sensors.uniform)
    return inputs, shared, lanes, parts


def _split(
    parts: Sequence[TimeSpan], sample: int, sensors: int, then: Callable[[FloatArray], None]
) -> list[TimeSpan]:
    """The parts, of which one ends in front of `sample`, an even number, and is followed by `then`."""
    split: list[TimeSpan] = []
    for part in parts:
        first, last = part.samples.start, part.samples.stop
        if first < sample < last:
            keys = np.ascontiguousarray(advance_keys(part.keys, sample - first, sensors))
            split += [
                part._replace(samples=slice(first, sample), then=then),
                TimeSpan(slice(sample, last), keys),
            ]
        else:
            split.append(part._replace(then=then) if last == sample else part)
    return split


def record_run(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    index: int,
    *,
    first: int = 0,
    sensor_errors: Mapping[str, FloatArray] | None = None,
    noise: NDArray[np.int64] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Trajectory | None:
    """The trajectory of one run of `simulate_many`, the same to the bit; None without a C compiler.

    `simulate` runs one machine alone, and its last digits differ from those of a lane. Quantized sensors amplify such a
    difference, and so does a machine that barely falls. Therefore this function simulates the run's whole group of
    LANES machines again and records every sample of the run.

    changes, sensor_errors : columns of the runs from `first` on, a multiple of LANES as for the blocks of
        `simulate_many`; at least those of the run's group
    noise : of the same runs, as in `simulate_many`
    """
    begin = index // LANES * LANES
    group, errors = (
        {name: column[begin - first : begin - first + LANES] for name, column in columns.items()}
        for columns in (changes, sensor_errors or {})
    )
    own_plant, own_scenario = replay_run(plant, scenario, changes, index, first, sensor_errors)
    if noise is not None:
        noise = noise[begin - first : begin - first + LANES]
        own_scenario = replace(own_scenario, run=tuple(noise[index - begin].tolist()))
    count, plant = steps_of(plant, controller, scenario), with_varied(plant, changes)
    simulation = simulation_of(plant, controller, _with_sensor_errors(scenario, sensor_errors))
    shape = shape_of(plant, controller, simulation.setup)
    compiled = library_of(shape, LANES, recorder_function(shape))
    if compiled is None:
        return None
    variation = _variation(plant, group, errors, None, begin, noise)
    inputs, shared, lanes, parts = _prepare(simulation, variation, count)
    width = sum(layout_of(plant, controller, simulation.setup).row.values())
    rows = np.empty((len(inputs.t), width))
    last = np.zeros((1, NOISE_SAMPLES_AT_ONCE * width, LANES))
    sensors = len(noise_scales(plant, simulation.setup))
    for samples, streams, _ in parts:
        for k in range(samples.start, samples.stop, NOISE_SAMPLES_AT_ONCE):
            given = inputs.given[k : min(k + NOISE_SAMPLES_AT_ONCE, samples.stop)]
            now = lanes._replace(keys=advance_keys(streams, k - samples.start, sensors), digests=last)
            run_many(compiled, slice(0, 1), now, shared._replace(given=given))
            rows[k : k + len(given)] = last[0, :, index - begin].reshape(NOISE_SAMPLES_AT_ONCE, width)[
                -len(given) :
            ]
            if progress is not None and k % 1000 == 0:
                progress(k / len(rows))
    own = Simulation(own_plant, controller, own_scenario, simulation.setup)
    return trajectory_of(own, inputs, rows, "compiled")


def replay_run(
    plant: Plant,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    index: int,
    first: int = 0,
    sensor_errors: Mapping[str, FloatArray] | None = None,
) -> tuple[Plant, Scenario]:
    """Return machine and scenario of one run of `malta.simulation.simulate_many`, to simulate it again in full.

    plant : as in `malta.simulation.simulate_many`
    scenario : as in `malta.simulation.simulate_many`
    changes : as in `malta.simulation.simulate_many`
    index : of the run
    first : index of the run with which changes and sensor_errors begin
    sensor_errors : as in `malta.simulation.simulate_many`

    Returns the plant with the run's parameters, and the scenario with its noise and its errors of the sensors.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> hold = malta.Scenario("hold", 5e-3, malta.references.hold, noise=1.0)
    >>> masses = {"m": [0.3, 0.4]}
    >>> batch = malta.simulation.simulate_many(plant, controller, hold, masses, workers=1)
    >>> machine, scenario = malta.simulation.replay_run(plant, hold, masses, index=1)
    >>> run = malta.simulate(machine, controller, scenario)
    >>> bool(abs(run.v).max() > 0.999 * batch.force[1].max())
    True
    """
    own, errors = (
        {name: float(values[index - first]) for name, values in columns.items()}
        for columns in (changes, sensor_errors or {})
    )
    par: Any = replace(plant.parameters, **own)
    if errors:
        scenario = replace(scenario, sensor_errors=dict(scenario.sensor_errors or {}) | errors)
    return plant.variant(par), replace(scenario, run=index)


def with_varied(plant: Plant, changes: Mapping[str, FloatArray]) -> Plant:
    """The machine with a value that is no default for every parameter that varies, so that its functions contain it."""
    par: Any = plant.parameters
    furthest = {name: float(max(changes[name], key=abs)) for name in changes if is_default(par, name)}
    return plant.variant(replace(par, **furthest)) if furthest else plant


def is_compiled(plant: Plant, controller: Controller, scenario: Scenario) -> bool:
    """Whether `simulate_many` runs compiled; without a C compiler it simulates one run after the other."""
    shape = shape_of(plant, controller, setup_of(plant, controller, scenario))
    return library_of(shape, LANES, digest_function(shape), cruise_functions(shape)) is not None


def functions_text(plant: Plant, controller: Controller, scenario: Scenario) -> str:
    """What decides the functions that `simulate_many` runs: of those without a form in C, themselves."""
    shape = shape_of(plant, controller, setup_of(plant, controller, scenario))
    if not plant_of(controller.parameters).actuator.tabulated:
        return engine_key(shape, digest_function(shape), cruise_functions(shape))
    period = period_of(plant, controller, shape.setup, numbers_of(plant, controller, 1), constant=True)
    return "\n".join(f.serialize() for f in (period.sense, period.decide, period.substep))


def _with_sensor_errors(scenario: Scenario, sensor_errors: Mapping[str, FloatArray] | None) -> Scenario:
    """The scenario with errors of the sensors, 0 for those that differ from run to run."""
    if not sensor_errors:
        return scenario
    return replace(
        scenario, sensor_errors=dict(scenario.sensor_errors or {}) | dict.fromkeys(sensor_errors, 0.0)
    )


def _check(simulation: Simulation, workers: int | None) -> None:
    """InputError for a setup that a batch cannot simulate, or for no workers."""
    plant, _, scenario, setup = simulation
    where = scenario.where
    if setup.outside:
        raise InputError(where, "estimator", scenario.estimator, "steady-state in a campaign")
    if electronics_of(plant, setup) is not None:
        raise InputError(where, "fidelity", "phase", f"force in a campaign of a {plant.name}")
    if workers is not None and workers < 1:
        raise InputError("campaign", "workers", str(workers), "at least 1")


def _variation(
    plant: Plant,
    changes: Mapping[str, FloatArray],
    sensor_errors: Mapping[str, FloatArray] | None,
    starts: Mapping[str, FloatArray] | None,
    first: int,
    noise: NDArray[np.int64] | None,
) -> Variation:
    """The variation of a batch. Raises InputError for unknown parameters and for columns of different length."""
    sensor_errors, starts = sensor_errors or {}, starts or {}
    known = units_of(plant.parameters)
    sizes = {}
    for name, values in [*changes.items(), *sensor_errors.items(), *starts.items()]:
        column = np.asarray(values)
        if column.ndim != 1 or not column.size or column.dtype.kind not in "fiu":
            raise InputError(
                "campaign", name, f"{column.dtype} of shape {column.shape}", "a number for each run"
            )
        sizes[name] = len(column)
    for name in changes:
        if name not in known:
            raise InputError("campaign", name, "an unknown parameter", "one of " + " ".join(known))
    if len(set(sizes.values())) != 1:
        raise InputError("campaign", "changes", f"{sizes or 'nothing'}", "as many values of each parameter")
    runs = next(iter(sizes.values()))
    own = first + np.arange(runs)[:, None] if noise is None else np.asarray(noise)
    if own.ndim != 2 or len(own) != runs or not own.size or own.dtype.kind not in "iu":
        raise InputError("campaign", "noise", f"{own.dtype} of shape {own.shape}", "indices, runs x parts")
    return Variation(changes, sensor_errors, starts, own, runs)


def _own_numbers(plant: Plant, values: Mapping[str, ca.DM], variation: Variation) -> dict[int, FloatArray]:
    """The entries of theta that are each run's own, by index. Raises InputError for values that a data file may not
    have either."""
    changes, sensor_errors, _, _, runs = variation
    place, k = {}, 0
    for name, value in values.items():
        place[name] = k
        k += value.nnz()
    own: dict[int, FloatArray] = {}
    for name, column in changes.items():
        column = np.asarray(column, dtype=float)
        for extreme in (column.min(), column.max()):  # NaN comes out of both
            replace(plant.parameters, **{name: float(extreme)})
        if f"machine.{name}" in place:  # else every run has the default
            own[place[f"machine.{name}"]] = column
    names = [signal.name for signal in plant.sensors.errors]
    for name, column in sensor_errors.items():
        column = np.asarray(column, dtype=float)
        if not np.isfinite(column).all():
            raise InputError("campaign", name, "NaN or infinity", "finite errors of a sensor")
        own[place["errors"] + names.index(name)] = column
    for name, twin in twins_of(plant.parameters).items():
        one, other = (
            own.get(place[key], np.full(runs, float(values[key])))
            for key in (f"machine.{name}", f"machine.{twin}")
        )
        if not np.array_equal(one, other):
            raise InputError("campaign", name, f"values unlike {twin}", f"the same, as in {plant.name}")
    return own


@lru_cache(maxsize=16)
def _start_function(shape: Any) -> ca.Function:
    """(theta, (x, xi_pred, currents)) -> the state of machine and controller at the start, and the sensors' noise."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    symbolic, _, theta = with_symbols(plant, numbers_of(plant, c, 1))
    sizes = {"x": len(plant.states), "xi_pred": len(c.states), "current": len(plant.actuator.coils)}
    arguments = [ca.SX.sym(name, size) for name, size in sizes.items()]
    first = initial_state(symbolic, c, setup, *arguments)
    noise = ca.densify(ca.vertcat(*noise_scales(symbolic, setup)))
    return ca.Function("start", [theta, ca.vertcat(*arguments)], [first, noise])


def _starts(simulation: Simulation, given: FloatArray, starts: Mapping[str, FloatArray]) -> FloatArray:
    """x, xi_pred and currents at the start: a row for each run, or one row where all runs start alike."""
    names = list(starts)
    rows: list[FloatArray] = []
    for values in zip(*starts.values(), strict=True) if names else [()]:
        own = dict(simulation.scenario.start) | dict(zip(names, map(float, values), strict=True))
        one = simulation._replace(scenario=replace(simulation.scenario, start=own))
        rows.append(np.concatenate(initial_values(one, given)))
    return np.array(rows)


def _starts_and_noise(
    function: ca.Function, theta: tuple[FloatArray, Mapping[int, FloatArray]], others: FloatArray, runs: int
) -> list[FloatArray]:
    """f(theta, other), a row for each run or one for all, for each result of f. At most BLOCK runs go in one call.

    theta : the numbers of all runs, and those that are each run's own
    others : a row for each run, or one row. Where f reads nothing of a run's own, it is evaluated once.
    """
    same, own = theta
    read = {k for i in range(function.n_out()) for k in function.jac_sparsity(i, 0).get_col()}
    if len(others) == 1 and not read & set(own):
        found = evaluate(function, same, others[0])
        return [value.reshape(1, -1) for value in found]
    rows = np.tile(same, (runs, 1))
    for k, column in own.items():
        rows[:, k] = column
    count = -(-len(rows) // BLOCK)
    pairs = zip(
        *(np.array_split(a, count) for a in (rows, np.broadcast_to(others, (len(rows), others.shape[1])))),
        strict=True,
    )
    mapped = cache(function.map)
    blocks = [evaluate(mapped(len(part)), part, other) for part, other in pairs]
    return [np.vstack(column) for column in zip(*blocks, strict=True)]


def _simulate_one_by_one(
    simulation: Simulation,
    variation: Variation,
    progress: Callable[[float], None] | None,
    engine: EngineChoice | EngineOf = "virtual machine",
) -> Batch:
    """A batch without a C compiler, or with engines of one's own: every run by `simulate`."""
    plant, controller, scenario, _ = simulation
    changes, sensor_errors, starts, noise, runs = variation
    figures: dict[str, list[Any]] = {name: [] for name in Batch.__dataclass_fields__}
    for k in range(runs):
        machine_k, scenario_k = replay_run(plant, scenario, changes, k, sensor_errors=sensor_errors)
        own = dict(scenario_k.start) | {name: float(column[k]) for name, column in starts.items()}
        scenario_k = replace(scenario_k, start=own, run=tuple(noise[k].tolist()))
        run = simulate(machine_k, controller, scenario_k, engine=engine)
        stroke = stroke_figures(run)
        error = run.p - run.reference
        row = {
            "duration": run.verdict.time,
            "completed": run.verdict.completed,
            "deviation": np.abs(error).max(axis=0),
            "rms": np.sqrt((error**2).mean(axis=0)),
            "force": np.abs(run.v).max(axis=0),
            "contact": run.contact.max(axis=0),
            "rise": stroke.rise,
            "overshoot": stroke.overshoot,
            "saturated": run.saturated.mean(axis=0),
            "verdict": verdicts(plant).index(run.verdict.name),
            "last": error[-1],
        }
        for name, value in row.items():
            figures[name].append(value)
        if progress is not None:
            progress((k + 1) / runs)
    return Batch(**{name: np.array(column) for name, column in figures.items()})
