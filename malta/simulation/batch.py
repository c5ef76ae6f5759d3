"""Many machines at once: the same scenario and controller on plants that all differ, each with its own noise.

Compiled, eight machines share a SIMD register and the cores share the rest; only a digest of each run is kept. Run i of
a seed draws the same noise wherever and with whatever company it runs; `replayed` gives it back as a scenario.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.model.data import shaping, twins_of, units_of
from malta.model.plant import Plant
from malta.simulation.compiled import LANES, arrange_in_lanes, feedforward_table, run_many
from malta.simulation.digest import (
    Batch,
    batch_of,
    digest_function,
    digest_sizes,
    recorder_function,
    verdicts,
)
from malta.simulation.engines import BLOCK, evaluate, library_of, shape_of
from malta.simulation.inputs import initial_values, inputs_of
from malta.simulation.layout import electronics_of, flatten, layout_of, numbers_of, with_symbols
from malta.simulation.noise import GAMMA, keys
from malta.simulation.period import initial_state
from malta.simulation.scenario import Scenario, setup_of, steps_of
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory, stroke_figures, trajectory_of
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray


def simulate_many(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    *,
    sensor_errors: Mapping[str, FloatArray] | None = None,
    first: int = 0,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Batch:
    """Run a scenario on many machines.

    changes : parameters of the machine by name, SI, a value for each run
    sensor_errors : errors of the sensors by name, likewise, in place of the scenario's
    first : index of the first run; noise depends on scenario.seed and on the index
    workers : threads; None: one for each core

    Raises InputError for an unknown parameter, values of different number, or a scenario with faults, changes, another
    estimator or an outer loop, which are for `simulate`.
    """
    where = f"scenario {scenario.name}"
    for name in ("faults", "changes", "correction"):
        if getattr(scenario, name):
            raise InputError(where, name, "some", "none in a campaign")
    scenario = _with_sensor_errors(scenario, sensor_errors)
    setup = setup_of(plant, controller, scenario)
    if setup.outside:
        raise InputError(where, "estimator", scenario.estimator, "steady-state in a campaign")
    if electronics_of(plant, setup) is not None:
        raise InputError(where, "fidelity", "phase", f"force in a campaign of a {plant.name}")
    if workers is not None and workers < 1:
        raise InputError("campaign", "workers", str(workers), "at least 1")
    runs = _count_runs(plant, changes, sensor_errors or {})
    for name in set(changes) & set(shaping(plant.parameters)):
        raise InputError("campaign", name, "another one for each run", "one for all: it shapes the functions")
    shape = shape_of(plant, controller, setup)
    digest = digest_function(shape)
    compiled = library_of(shape, LANES, digest)
    if compiled is None:
        return _simulate_one_by_one(
            plant, controller, scenario, changes, sensor_errors, first, runs, progress
        )
    lib, _ = compiled
    ready = _prepare(plant, controller, scenario, changes, sensor_errors or {}, first, runs)
    axis = plant.leading_output
    start, end = ready.p_ref[0, axis], ready.p_ref[-1, axis]
    scale = 1 / (end - start) if end != start else 0
    known = {"alive": 1.0, "start": start, "scale": scale, "reached": -1.0, "touched": -1.0, "culprit": -1.0}
    sizes = digest_sizes(plant)
    kept = np.repeat([known.get(name, 0.0) for name in sizes], [*sizes.values()])
    lanes = ready.lanes | {"digests": arrange_in_lanes(np.tile(kept, (runs, 1)), ready.groups)}
    groups = ready.groups
    workers = workers or os.cpu_count() or 1
    step = max(1, min(16, groups // (4 * workers)))  # groups in one call, for the progress bar

    def fly(k: int) -> None:
        run_many(
            lib,
            slice(k, min(k + step, groups)),
            substeps=steps_of(plant, controller, scenario),
            table=ready.table,
            given=ready.given,
            uniform=plant.uniform,
            keys=ready.keys,
            **lanes,
        )

    with ThreadPoolExecutor(workers) as pool:
        try:
            for done, _ in enumerate(pool.map(fly, range(0, groups, step))):
                if progress is not None:
                    progress(min(1.0, (done + 1) * step / groups))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    ends = lanes["digests"].swapaxes(1, 2).reshape(groups * LANES, -1)[:runs]
    return batch_of(ends, len(ready.t), controller.sample_time, sizes)


class _Ready(NamedTuple):
    """What flies many machines: those of LANES in a group, a group in the first axis."""

    t: FloatArray
    p_ref: FloatArray
    given: FloatArray
    table: FloatArray  # of v0(z)
    groups: int
    lanes: dict[str, FloatArray]
    keys: NDArray[np.uint64]


def _prepare(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    sensor_errors: Mapping[str, FloatArray],
    first: int,
    runs: int,
) -> _Ready:
    setup = setup_of(plant, controller, scenario)
    count = steps_of(plant, controller, scenario)
    values = numbers_of(plant, controller, count, scenario.sensor_errors)
    theta = _thetas(plant, values, changes, sensor_errors, runs)
    t, motion, given = inputs_of(plant, controller, scenario, setup)
    start = np.concatenate(initial_values(plant, controller, scenario, given[0]))
    states, noise = _map_rows(_start_function(shape_of(plant, controller, setup)), theta, start)
    ff = controller.feedforward
    groups = -(-runs // LANES)
    rows = {"theta": theta, "states": states, "sigma": scenario.noise * noise}
    lanes = {name: arrange_in_lanes(array, groups) for name, array in rows.items()}
    streams = keys(scenario.seed, first + np.minimum(np.arange(groups * LANES), runs - 1))
    table = feedforward_table(ff.z_grid, ff.v0)
    return _Ready(t, motion.p, given, table, groups, lanes, streams.reshape(groups, LANES))


def record_run(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    index: int,
    *,
    sensor_errors: Mapping[str, FloatArray] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Trajectory | None:
    """One run of `simulate_many` with its time series, the same to the bit; None without a C compiler.

    `simulate` computes one machine by itself, whose last digits differ; sensors in steps, and machines that barely fall
    or barely do not, make more of them. Here the run's whole group is flown again, with every sample recorded.

    changes, sensor_errors : those of all runs, of which `simulate_many` had blocks that begin with a multiple of LANES
    """
    begin = index // LANES * LANES
    group = {
        kind: {name: column[begin : begin + LANES] for name, column in columns.items()}
        for kind, columns in (("changes", changes), ("errors", sensor_errors or {}))
    }
    own_plant, own_scenario = replayed(plant, scenario, changes, index, sensor_errors=sensor_errors)
    scenario = _with_sensor_errors(scenario, sensor_errors)
    setup = setup_of(plant, controller, scenario)
    shape = shape_of(plant, controller, setup)
    compiled = library_of(shape, LANES, recorder_function(shape))
    if compiled is None:
        return None
    runs = _count_runs(plant, group["changes"], group["errors"])
    ready = _prepare(plant, controller, scenario, group["changes"], group["errors"], begin, runs)
    width = sum(layout_of(plant, controller, setup).row.values())
    rows = np.empty((len(ready.t), width))
    stream = ready.keys.copy()
    kept = np.zeros((1, 2 * width, LANES))
    for k in range(0, len(rows), 2):  # the noise of two samples is drawn at once
        part = ready.given[k : k + 2]
        run_many(
            compiled[0],
            slice(0, 1),
            substeps=steps_of(plant, controller, scenario),
            table=ready.table,
            given=part,
            uniform=plant.uniform,
            keys=stream,
            digests=kept,
            **ready.lanes,
        )
        rows[k : k + len(part)] = kept[0, :, index - begin].reshape(2, width)[2 - len(part) :]
        stream += np.uint64(len(plant.outputs) * GAMMA % 2**64)
        if progress is not None and k % 1000 == 0:
            progress(k / len(rows))
    asked = (ready.t, ready.given)
    return trajectory_of(own_plant, controller, own_scenario, setup, asked, rows, "compiled")


def replayed(
    plant: Plant,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    index: int,
    first: int = 0,
    sensor_errors: Mapping[str, FloatArray] | None = None,
) -> tuple[Plant, Scenario]:
    """Machine and scenario of one run of `simulate_many`, for `simulate`."""
    own, errors = (
        {name: float(values[index - first]) for name, values in columns.items()}
        for columns in (changes, sensor_errors or {})
    )
    par: Any = replace(plant.parameters, **own)
    if errors:
        scenario = replace(scenario, sensor_errors=dict(scenario.sensor_errors or {}) | errors)
    return plant.variant(par), replace(scenario, run=index)


def is_compiled(plant: Plant, controller: Controller, scenario: Scenario) -> bool:
    """Whether `simulate_many` runs these compiled; without a C compiler they run one by one."""
    shape = shape_of(plant, controller, setup_of(plant, controller, scenario))
    return library_of(shape, LANES, digest_function(shape)) is not None


def _with_sensor_errors(scenario: Scenario, sensor_errors: Mapping[str, FloatArray] | None) -> Scenario:
    """With sensors that may err where runs have errors of their own; none of them is known to be finite yet."""
    if not sensor_errors:
        return scenario
    return replace(
        scenario, sensor_errors=dict(scenario.sensor_errors or {}) | dict.fromkeys(sensor_errors, 0.0)
    )


def _count_runs(
    plant: Plant, changes: Mapping[str, FloatArray], sensor_errors: Mapping[str, FloatArray]
) -> int:
    known = units_of(plant.parameters)
    sizes = {}
    for name, values in [*changes.items(), *sensor_errors.items()]:
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
    return next(iter(sizes.values()))


def _thetas(
    plant: Plant,
    values: Mapping[str, ca.DM],
    changes: Mapping[str, FloatArray],
    sensor_errors: Mapping[str, FloatArray],
    runs: int,
) -> FloatArray:
    """theta of every run, a row each. Every record is checked as one that is read from a file."""
    place, k = {}, 0
    for name, value in values.items():
        place[name] = k
        k += value.nnz()
    theta = np.tile(flatten(values), (runs, 1))
    for name, column in changes.items():
        column = np.asarray(column, dtype=float)
        for extreme in (column.min(), column.max()):  # NaN comes out of both
            replace(plant.parameters, **{name: float(extreme)})
        theta[:, place[f"machine.{name}"]] = column
    names = [signal.name for signal in plant.sensor_errors]
    for name, column in sensor_errors.items():
        column = np.asarray(column, dtype=float)
        if not np.isfinite(column).all():
            raise InputError("campaign", name, "NaN or infinity", "finite errors of a sensor")
        theta[:, place["errors"] + names.index(name)] = column
    for name, twin in twins_of(plant.parameters).items():
        pair = theta[:, place[f"machine.{name}"]], theta[:, place[f"machine.{twin}"]]
        if not np.array_equal(*pair):
            raise InputError("campaign", name, f"values unlike {twin}", f"the same, as in {plant.name}")
    return theta


@lru_cache(maxsize=16)
def _start_function(shape: Any) -> ca.Function:
    """(theta, x, xi_pred, currents) -> the state in which a machine starts, and the noise of its sensors."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    symbolic, _, theta = with_symbols(plant, numbers_of(plant, c, 1))
    sizes = {"x": len(plant.states), "xi_pred": len(c.states), "current": len(plant.actuator.coils)}
    arguments = [ca.SX.sym(name, size) for name, size in sizes.items()]
    first = initial_state(symbolic, c, setup, *arguments)
    noise = ca.densify(ca.vertcat(*symbolic.noise))
    return ca.Function("start", [theta, ca.vertcat(*arguments)], [first, noise])


def _map_rows(function: ca.Function, rows: FloatArray, same: FloatArray) -> list[FloatArray]:
    """A function of a row and of what is the same for all, on all rows: each of its results."""
    parts = np.array_split(rows, -(-len(rows) // BLOCK))
    found = [evaluate(function.map(len(part)), part, np.tile(same, (len(part), 1))) for part in parts]
    return [np.vstack(column) for column in zip(*found, strict=True)]


def _simulate_one_by_one(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    sensor_errors: Mapping[str, FloatArray] | None,
    first: int,
    runs: int,
    progress: Callable[[float], None] | None,
) -> Batch:
    """The same without a C compiler."""
    figures: dict[str, list[Any]] = {name: [] for name in Batch.__dataclass_fields__}
    for k in range(runs):
        machine_k, scenario_k = replayed(plant, scenario, changes, first + k, first, sensor_errors)
        run = simulate(machine_k, controller, scenario_k, engine="virtual machine")
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
        }
        for name, value in row.items():
            figures[name].append(value)
        if progress is not None:
            progress((k + 1) / runs)
    return Batch(**{name: np.array(column) for name, column in figures.items()})
