"""Many machines at once: the same scenario and controller on plants that all differ, each with its own noise.

Compiled, eight machines share a SIMD register and the cores share the rest; only a digest of each run is kept. Run i of
a seed draws the same noise wherever and with whatever company it runs; `replayed` gives it back as a scenario.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.model.data import shaping, twins_of, units_of
from malta.model.plant import Plant, readonly
from malta.simulation.compiled import LANES, feedforward_table, in_lanes, run_many
from malta.simulation.engines import BLOCK, compiled_shape, evaluate, shape_of
from malta.simulation.inputs import beginning, sampled
from malta.simulation.layout import electronics_of, flatten, layout_of, numbers_of, with_symbols
from malta.simulation.noise import GAMMA, keys
from malta.simulation.period import initial_state
from malta.simulation.scenario import Scenario, setup_of, steps_of
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory, recorded, stroke_figures
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

LEVELS = (0.1, 0.9)  # of a stroke: its rise is between them


@dataclass(frozen=True, eq=False)
class Batch:
    """What became of each run. SI; a row for each run."""

    duration: FloatArray  # s, until the end or until something was touched
    completed: FloatArray  # 1 or 0
    deviation: FloatArray  # runs x outputs, largest |p - p*|
    rms: FloatArray  # runs x outputs, root mean square of p - p*
    force: FloatArray  # runs x inputs, N, largest |v|
    contact: FloatArray  # runs x contacts, largest share of each clearance that was used up
    rise: FloatArray  # s, 10-90 % of the stroke; NaN when it was not reached
    overshoot: FloatArray  # beyond the end, as a share of the stroke; NaN when the run ended early
    saturated: FloatArray  # runs x inputs, share of the samples whose command was limited
    verdict: FloatArray  # how it ended: index into `verdicts` of the plant

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            object.__setattr__(self, name, readonly(getattr(self, name)))


def verdicts(plant: Plant) -> tuple[str, ...]:
    """How a run may end, the first of them as it should: the names of simulate.Verdict."""
    return ("completed", "diverged", "not lifted", *plant.contacts)


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
    scenario = _sensed(scenario, sensor_errors)
    setup = setup_of(plant, controller, scenario)
    if setup.outside:
        raise InputError(where, "estimator", scenario.estimator, "steady-state in a campaign")
    if electronics_of(plant, setup) is not None:
        raise InputError(where, "fidelity", "phase", f"force in a campaign of a {plant.name}")
    if workers is not None and workers < 1:
        raise InputError("campaign", "workers", str(workers), "at least 1")
    runs = _count(plant, changes, sensor_errors or {})
    for name in set(changes) & set(shaping(plant.parameters)):
        raise InputError("campaign", name, "another one for each run", "one for all: it shapes the functions")
    shape = shape_of(plant, controller, setup)
    digest = _digest(shape)
    compiled = compiled_shape(shape, LANES, digest)
    if compiled is None:
        return _one_by_one(plant, controller, scenario, changes, sensor_errors, first, runs, progress)
    lib, _ = compiled
    ready = _prepared(plant, controller, scenario, changes, sensor_errors or {}, first, runs)
    axis = plant.leading_output
    start, end = ready.p_ref[0, axis], ready.p_ref[-1, axis]
    scale = 1 / (end - start) if end != start else 0
    known = {"alive": 1.0, "start": start, "scale": scale, "reached": -1.0, "touched": -1.0, "culprit": -1.0}
    sizes = _digest_sizes(plant)
    kept = np.repeat([known.get(name, 0.0) for name in sizes], [*sizes.values()])
    lanes = ready.lanes | {"digests": in_lanes(np.tile(kept, (runs, 1)), ready.groups)}
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
    return _batch(ends, len(ready.t), controller.sample_time, sizes)


class _Ready(NamedTuple):
    """What flies many machines: those of LANES in a group, a group in the first axis."""

    t: FloatArray
    p_ref: FloatArray
    given: FloatArray
    table: FloatArray  # of v0(z)
    groups: int
    lanes: dict[str, FloatArray]
    keys: NDArray[np.uint64]


def _prepared(
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
    t, motion, given = sampled(plant, controller, scenario, setup)
    start = np.concatenate(beginning(plant, controller, scenario, given[0]))
    states, noise = _mapped(_starts(shape_of(plant, controller, setup)), theta, start)
    ff = controller.feedforward
    groups = -(-runs // LANES)
    rows = {"theta": theta, "states": states, "sigma": scenario.noise * noise}
    lanes = {name: in_lanes(array, groups) for name, array in rows.items()}
    streams = keys(scenario.seed, first + np.minimum(np.arange(groups * LANES), runs - 1))
    table = feedforward_table(ff.z_grid, ff.v0)
    return _Ready(t, motion.p, given, table, groups, lanes, streams.reshape(groups, LANES))


def recorded_run(
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
    or barely do not, make more of them. Here the run's whole group is flown again, with everything recorded.

    changes, sensor_errors : those of all runs, of which `simulate_many` had blocks that begin with a multiple of LANES
    """
    begin = index // LANES * LANES
    group = {
        kind: {name: column[begin : begin + LANES] for name, column in columns.items()}
        for kind, columns in (("changes", changes), ("errors", sensor_errors or {}))
    }
    own_plant, own_scenario = replayed(plant, scenario, changes, index, sensor_errors=sensor_errors)
    scenario = _sensed(scenario, sensor_errors)
    setup = setup_of(plant, controller, scenario)
    shape = shape_of(plant, controller, setup)
    compiled = compiled_shape(shape, LANES, _recorder(shape))
    if compiled is None:
        return None
    runs = _count(plant, group["changes"], group["errors"])
    ready = _prepared(plant, controller, scenario, group["changes"], group["errors"], begin, runs)
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
    return recorded(own_plant, controller, own_scenario, setup, asked, rows, "compiled")


@lru_cache(maxsize=16)
def _recorder(shape: Any) -> ca.Function:
    """A digest that keeps the last two rows as they are."""
    sizes = layout_of(shape.plant, shape.controller, shape.setup)
    width, given = sum(sizes.row.values()), sum(sizes.given.values())
    kept, row = ca.SX.sym("kept", 2 * width), ca.SX.sym("row", width)
    theta = ca.SX.sym("theta", len(flatten(numbers_of(shape.plant, shape.controller, 1))))
    arguments = [kept, row, ca.SX.sym("given", given), theta]
    return ca.Function("digest", arguments, [ca.vertcat(kept[width:], row)])


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
    return compiled_shape(shape, LANES, _digest(shape)) is not None


def _sensed(scenario: Scenario, sensor_errors: Mapping[str, FloatArray] | None) -> Scenario:
    """With sensors that may err where runs have errors of their own; none of them is known to be finite yet."""
    if not sensor_errors:
        return scenario
    return replace(
        scenario, sensor_errors=dict(scenario.sensor_errors or {}) | dict.fromkeys(sensor_errors, 0.0)
    )


def _count(plant: Plant, changes: Mapping[str, FloatArray], sensor_errors: Mapping[str, FloatArray]) -> int:
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
def _starts(shape: Any) -> ca.Function:
    """(theta, x, xi_pred, currents) -> the state in which a machine starts, and the noise of its sensors."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    symbolic, _, theta = with_symbols(plant, numbers_of(plant, c, 1))
    sizes = {"x": len(plant.states), "xi_pred": len(c.states), "current": len(plant.actuator.coils)}
    beginning = [ca.SX.sym(name, size) for name, size in sizes.items()]
    first = initial_state(symbolic, c, setup, *beginning)
    noise = ca.densify(ca.vertcat(*symbolic.noise))
    return ca.Function("start", [theta, ca.vertcat(*beginning)], [first, noise])


def _mapped(function: ca.Function, rows: FloatArray, same: FloatArray) -> list[FloatArray]:
    """A function of a row and of what is the same for all, on all rows: each of its results."""
    parts = np.array_split(rows, -(-len(rows) // BLOCK))
    found = [evaluate(function.map(len(part)), part, np.tile(same, (len(part), 1))) for part in parts]
    return [np.vstack(column) for column in zip(*found, strict=True)]


def _digest_sizes(plant: Plant) -> dict[str, int]:
    p, m = len(plant.outputs), len(plant.inputs)
    return {
        "alive": 1,
        "start": 1,  # of the stroke, and 1 / its length or 0: constant
        "scale": 1,
        "samples": 1,
        "reached": len(LEVELS),  # sample at which each level was reached, -1 before
        "below": len(LEVELS),  # share of the stroke one sample before
        "above": len(LEVELS),  # and then
        "share": 1,
        "largest_share": 1,
        "deviation": p,
        "squares": p,
        "force": m,
        "limited": m,
        "contact": len(plant.contacts),
        "resting": 1,  # on the touchdown bearings at the start
        "touching": 1,  # them at the end
        "touched": 1,  # sample at which it first did, -1 before
        "culprit": 1,  # index of what was touched first, -1 before
    }


@lru_cache(maxsize=16)
def _digest(shape: Any) -> ca.Function:
    """(kept, row, given, theta) -> kept: what a run leaves behind, sample by sample, until something is touched."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    sizes = layout_of(plant, c, setup)
    kept = {name: ca.SX.sym(name, size) for name, size in _digest_sizes(plant).items()}
    row = {name: ca.SX.sym(name, size) for name, size in sizes.row.items()}
    given = {name: ca.SX.sym(name, size) for name, size in sizes.given.items()}
    theta = ca.SX.sym("theta", len(flatten(numbers_of(plant, c, 1))))
    largest = ca.fmax(kept["contact"], row["contact"])
    most, used = (_most(contact) for contact in (largest, row["contact"]))
    alive = kept["alive"]  # what follows adds nothing once it is 0
    error = ca.if_else(alive, row["p"] - given["p_ref"], 0)
    share = (row["p"][plant.leading_output] - kept["start"]) * kept["scale"]
    now = ca.logic_and(ca.logic_and(alive, kept["reached"] < 0), share >= ca.DM(LEVELS))
    after = {
        "alive": ca.logic_and(alive, most < 1),
        "start": kept["start"],
        "scale": kept["scale"],
        "samples": kept["samples"] + alive,
        "reached": ca.if_else(now, kept["samples"], kept["reached"]),
        "below": ca.if_else(now, kept["share"], kept["below"]),
        "above": ca.if_else(now, share, kept["above"]),
        "share": share,
        "largest_share": ca.if_else(alive, ca.fmax(kept["largest_share"], share), kept["largest_share"]),
        "deviation": ca.fmax(kept["deviation"], ca.fabs(error)),
        "squares": kept["squares"] + error**2,
        "force": ca.fmax(kept["force"], ca.if_else(alive, ca.fabs(row["v"]), 0)),
        "limited": kept["limited"] + ca.if_else(alive, row["saturated"], 0),
        "contact": ca.if_else(alive, largest, kept["contact"]),
        "culprit": ca.if_else(
            ca.logic_and(ca.logic_and(alive, kept["culprit"] < 0), used >= 1),
            _largest(row["contact"]) if plant.contacts else -1,
            kept["culprit"],
        ),
    }
    if setup.bearing:
        touching = used >= 1
        ends = [row["contact"][i] for i, held in enumerate(plant.cushioned) if not held]
        after["alive"] = ca.logic_and(alive, _most(ca.vertcat(*ends)) < 1)
        first = kept["samples"] == 0
        after["resting"] = ca.if_else(first, touching, kept["resting"])
        after["touching"] = ca.if_else(alive, touching, kept["touching"])
        now = ca.logic_and(touching, kept["touched"] < 0)
        after["touched"] = ca.if_else(now, kept["samples"], kept["touched"])
    result = ca.vertcat(*(after.get(name, kept[name]) for name in kept))
    arguments = [ca.vertcat(*part.values()) for part in (kept, row, given)]
    return ca.Function("digest", [*arguments, theta], [ca.densify(result)])


def _most(contact: Any) -> Any:
    """The largest share of a clearance that is used up; 0 for a machine that has nothing to touch."""
    return ca.mmax(contact) if contact.numel() else ca.SX(0)


def _largest(values: Any) -> Any:
    """Index of the largest entry, the first of equals."""
    found, index = values[0], ca.SX(0)
    for k in range(1, values.numel()):
        index = ca.if_else(values[k] > found, k, index)
        found = ca.fmax(found, values[k])
    return index


def _batch(kept: FloatArray, samples: int, Ts: float, sizes: Mapping[str, int]) -> Batch:
    columns = dict(zip(sizes, np.split(kept, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))
    count = columns["samples"][:, 0]
    resting, touching, touched = (columns[name][:, 0] for name in ("resting", "touching", "touched"))
    held = np.where(resting == 1, touching == 0, touched < 0)
    completed = (columns["alive"][:, 0] == 1) & np.isfinite(kept).all(axis=1) & (count == samples) & held
    end = np.where((count == samples) & (resting == 0) & (touched >= 0), touched, np.maximum(count - 1, 0))
    reached, below, above = (columns[name] for name in ("reached", "below", "above"))
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = np.where(
            reached > 0, reached - 1 + (np.array(LEVELS) - below) / (above - below), np.nan
        ).T
    # What follows the end is not guarded in "share" alone.
    told = np.hstack([columns[name] for name in ("deviation", "squares", "contact")])
    verdict = np.select(
        [completed, ~np.isfinite(told).all(axis=1), resting == 1, columns["culprit"][:, 0] >= 0],
        [0, 1, 2, 3 + columns["culprit"][:, 0]],
        1,
    )
    return Batch(
        duration=np.where(completed, samples, end) * Ts,
        completed=completed,
        deviation=columns["deviation"],
        rms=np.sqrt(columns["squares"] / np.maximum(count, 1)[:, None]),
        force=columns["force"],
        contact=columns["contact"],
        rise=np.where(completed, (last - first) * Ts, np.nan),
        overshoot=np.where(
            completed & (columns["scale"][:, 0] != 0),
            np.maximum(columns["largest_share"][:, 0] - 1, 0),
            np.nan,
        ),
        saturated=columns["limited"] / np.maximum(count, 1)[:, None],
        verdict=verdict,
    )


def _one_by_one(
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
