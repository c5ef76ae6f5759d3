"""Logs of a bench: what sensors, commands and excitation were, sample by sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError
from malta.identification.readers.raster import unit_hint
from malta.identification.readers.raw import GROUPS as GROUPS
from malta.identification.readers.stored import EvenTimes, StoredTable
from malta.identification.survey import READ, Survey, survey
from malta.linear.sampling import split_delay, stored_blocks
from malta.model.plant import Plant, Signal
from malta.simulation.current_control import reading_errors
from malta.simulation.inputs import initial_values
from malta.simulation.layout import LoopPlan
from malta.simulation.multisine import Multisine
from malta.simulation.scenario import delay_of
from malta.simulation.simulate import prepare
from malta.simulation.trajectory import Trajectory


@display
@dataclass(frozen=True, eq=False)
class Log:
    """A log of a machine under control: k samples, SI, as sensors read them; NaN where a reading is missing.

    source : the file or the run, as errors name it
    machine : its name; "" where the file does not say
    controller : the name of the law; likewise
    sample_time : s
    period : of the excitation, s; 0: none, or not periodic
    t : k, s
    columns : by group: y (measured outputs), v (commanded forces), i (measured currents), u (commanded voltages),
        reference, excitation (forces beside the law's) and flags (1 while a limit is reached); k x signals each
    signals : by group: the names and units of its columns
    sha256 : of the file; "" of a run
    jitter : s, standard deviation of the intervals between samples, but for how coarsely their times are written
    idle : signals of i and u that were zero throughout, of which the file says that it leaves them out
    notes : what reading made of the file: columns that are not used, times that are rounded

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> log = malta.identification.log_of(run)
    >>> log.samples, log.names("y"), log.columns["i"].shape[1]
    (2000, ['x1', 'y1', 'x2', 'y2', 'z'], 12)
    """

    source: str
    machine: str
    controller: str
    sample_time: float
    period: float
    t: FloatArray
    columns: Mapping[str, FloatArray]
    signals: Mapping[str, tuple[Signal, ...]]
    sha256: str = field(default="")
    jitter: float = 0.0
    idle: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", _keep_table(self.t))
        object.__setattr__(
            self, "columns", {name: _keep_table(table) for name, table in self.columns.items()}
        )

    @property
    def samples(self) -> int:
        """Their number."""
        return len(self.t)

    def names(self, group: str) -> list[str]:
        """The names of a group's signals; none of a group that the log has not.

        group : as "y"
        """
        return [signal.name for signal in self.signals.get(group, ())]

    def table(self, group: str, names: list[str]) -> FloatArray:
        """The columns of a group by name, k x names. Raises InputError for a signal that the log lacks.

        group : as "y"
        names : of its signals
        """
        known = self.names(group)
        for name in names:
            if name not in known:
                expected = f"one of {' '.join(known)}" if known else f"one, as {GROUPS[group]}{name} [unit]"
                raise InputError(self.source, GROUPS[group] + name, f"no such column of {group}", expected)
        return choose_columns(self.columns[group], [known.index(name) for name in names])

    @cached_property
    def survey(self) -> Survey:
        """Statistics of its signals and what is wrong with its samples."""
        return survey(self)

    @cached_property
    def sensor_survey(self) -> Survey:
        """The same of its readings and currents alone."""
        known = self.__dict__.get("survey")
        return survey(self, READ) if known is None else known

    @property
    def description(self) -> Description:
        """Its length, its signals and what is wrong with it."""
        found = self.survey
        rows = [
            ("of", f"{self.machine or 'an unnamed machine'} under {self.controller or 'an unnamed law'}"),
            ("samples", f"{self.samples} of {quantity(self.sample_time, 's')}"),
            ("excitation", f"with a period of {self.period:g} s" if self.period else "none that is periodic"),
        ]
        rows += [(group, " ".join(self.names(group))) for group in GROUPS if self.names(group)]
        rows.append(("findings", "; ".join(found.findings) or "none"))
        rows += [("note", note) for note in self.notes]
        return Description(f"Log {self.source!r}", tuple(rows))


def _keep_table(table: FloatArray) -> FloatArray:
    """A table that nobody changes: in memory, or in its file."""
    return table if isinstance(table, StoredTable | EvenTimes) else readonly(table)


def choose_columns(table: FloatArray, columns: Sequence[int]) -> FloatArray:
    """Some columns of a table, in its file where that is long."""
    if isinstance(table, StoredTable):
        return cast("FloatArray", table.choose(columns))
    return np.asarray(table[:, list(columns)])


def last_rows(table: FloatArray, count: int) -> FloatArray:
    """The last rows of a table; of a long one they stay in its file."""
    if isinstance(table, StoredTable):
        return cast("FloatArray", table.last(count))
    return table[len(table) - count :]


def log_of(run: Trajectory) -> Log:
    """The log that a bench would write of a simulated run: what is measured and sent, and nothing of the truth.

    run : a run. Currents are those of the axes that the drive's sensors read, with their noise, offset and steps; of a
        machine without a model of its windings, those of the coils.

    Returns a Log.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> malta.identification.log_of(run).names("flags")[-1]
    'current_limit'
    """
    plant, scenario = run.plant, run.scenario
    axes = plant.actuator.coils if not run.i.size else plant.drive.axes
    excitation = np.zeros_like(run.v) if scenario.excitation is None else scenario.excitation(run.t)
    flags = (np.hstack([run.saturated, run.met]) > 0).astype(float)
    limits = [Signal(f"{s.name}_limit", "1") for s in plant.inputs]
    met = [Signal("current_limit" if k == 0 else f"limit_{k}", "1") for k in range(run.met.shape[1])]
    columns = {"y": run.y, "v": run.v, "i": _read_currents(run), "u": run.u}
    columns |= {"reference": run.reference, "excitation": excitation, "flags": flags}
    voltages = tuple(Signal(s.name.replace("i_", "u_", 1), "V") for s in axes)
    signals = {
        "y": plant.outputs,
        "v": plant.inputs,
        "i": axes,
        "u": voltages if run.u.size else (),
        "reference": plant.outputs,
        "excitation": plant.inputs,
        "flags": (*limits, *met),
    }
    period = scenario.excitation.period if isinstance(scenario.excitation, Multisine) else 0.0
    Ts, names = run.controller.sample_time, (plant.name, run.controller.name)
    return Log(f"run {scenario.name}", *names, Ts, period, run.t, columns, signals)


def _read_currents(run: Trajectory) -> FloatArray:
    """The currents as they are measured at the samples, A."""
    plant, c = run.plant, run.controller
    if not run.i.size:
        return _lagging_currents(run)
    ready = prepare(plant, c, run.scenario)
    setup = ready.simulation.setup
    if not setup.current_sensors:
        return run.i
    x, i = ca.SX.sym("x", run.x.shape[1]), ca.SX.sym("i", run.i.shape[1])
    phases = ca.SX.sym("i_phase", run.i_phase.shape[1])
    noise = ca.SX.sym("noise", len(plant.drive.phases))
    loop = LoopPlan(plant, c, setup, {})
    errors = reading_errors(loop, {"x": x, "i": i, "i_phase": phases}, noise)
    read = ca.Function("read", [x, i, phases, noise], [i + plant.drive.to_axes(x) @ errors])
    k = len(run.t)
    drawn = ready.noise[:k, len(plant.outputs) :]
    return np.array(read.map(k)(run.x.T, run.i.T, run.i_phase.T, drawn.T)).T


def _lagging_currents(run: Trajectory) -> FloatArray:
    """Currents of the coils behind their commands: delayed, and lagging by the crossover of the current loops.

    Until the first command arrives, those flow with which the run began.
    """
    actuator, Ts = run.plant.actuator, run.controller.sample_time
    delay = delay_of(run.plant, run.controller, run.scenario)
    ready = prepare(run.plant, run.controller, run.scenario)
    first = (
        run.current[:1] if run.scenario.settle else initial_values(ready.simulation, ready.inputs.given[0])[2]
    )
    held, newer = (
        np.vstack([np.tile(first, (k, 1)), run.current])[: len(run.current)]
        for k in (stored_blocks(delay), split_delay(delay)[0])
    )
    if not np.isfinite(actuator.crossover):
        return np.asarray(held)
    from scipy.signal import lfilter  # half a second to import

    decay = float(np.exp(-actuator.crossover * Ts))
    if part := split_delay(delay)[1]:  # the newer ones have the rest of the sample
        share = -np.expm1(-actuator.crossover * (1 - part) * Ts) / (1 - decay)
        held = held + share * (newer - held)
    before = np.reshape(first, (1, -1))
    return np.asarray(lfilter([0, 1 - decay], [1, -decay], held, axis=0, zi=before)[0])


def reference_spline(log: Log, names: list[str], sample_time: float) -> Any:
    """The reference of outputs by a spline of fifth degree in t, s, which has its derivatives.

    Raises InputError for an output without one, and CheckError for a log of fewer samples than it takes.
    """
    from scipy.interpolate import make_interp_spline

    p = log.table("reference", names)
    if len(p) < 6 or not np.isfinite(p).all():
        raise CheckError(f"{log.source}: {len(p)} samples of a reference, or some that are missing")
    return make_interp_spline(sample_time * np.arange(len(p)), p, k=5)


def sample_excitation(Ts: float, plant: Plant, forces: FloatArray) -> Callable[[Any], FloatArray]:
    """Forces at samples as an excitation, a function of time; none before the first and after the last.

    forces : k x inputs; or k, of the thrust alone
    """
    table = forces
    if forces.ndim == 1:
        table = np.zeros((len(forces), len(plant.inputs)))
        table[:, plant.thrust_input] = forces

    def sent(t: Any) -> FloatArray:
        k = np.round(np.asarray(t) / Ts).astype(int)
        inside = (k >= 0) & (k < len(table))
        return np.where(inside[..., None], table[np.clip(k, 0, len(table) - 1)], 0.0)

    return sent


def in_order(log: Log, plant: Plant) -> Log:
    """The log with readings and forces in the machine's order, whatever that of the file's columns.

    A command without a column is missing, an excitation without one is zero. Without all of the readings these are left
    as they are, for whoever needs them to refuse.
    """
    columns, signals = dict(log.columns), dict(log.signals)
    forces = ("v", plant.inputs, np.nan), ("excitation", plant.inputs, 0.0)
    for group, wanted, otherwise in (("y", plant.outputs, np.nan), *forces):
        have, names = log.names(group), [s.name for s in wanted]
        there = [name for name in names if name in have]
        if have == names or not there or (group == "y" and there != names):
            continue
        if there == names:
            columns[group], signals[group] = log.table(group, names), tuple(wanted)
            continue
        table = np.full((log.samples, len(names)), otherwise)
        table[:, [names.index(name) for name in there]] = log.table(group, there)
        columns[group], signals[group] = table, tuple(wanted)
    return log if signals == log.signals else replace(log, columns=columns, signals=signals)


def require_currents(log: Log, axes: Sequence[str], driven: Sequence[str] = ()) -> None:
    """Raise InputError for a log with a current that its machine has not, or without one that the law drives.

    axes : names of the machine's currents
    driven : of these the currents that have to be there, unless the file says that they are zero
    """
    for name in log.names("i"):
        if name not in axes:
            raise InputError(
                log.source, name, "a current that the machine has not", "one of " + " ".join(axes)
            )
    for name in driven:
        if name not in (*log.names("i"), *log.idle):
            expected = (
                f"{name} [A]: the law drives this current, and one that is left out would count as zero"
            )
            raise InputError(log.source, name, "no such column of i", expected)


def require_same_law(log: Log, machine: str, sample_time: float) -> None:
    """Raise CheckError for a log of another machine than the gain file's, and of another sample time."""
    if log.machine and log.machine != machine:
        raise CheckError(f"{log.source}: a log of machine {log.machine}, but the gain file is for {machine}")
    if abs(log.sample_time / sample_time - 1) > 1e-3:
        hint = unit_hint(log.sample_time, sample_time)
        found = f"samples of {log.sample_time:.6g} s, but the law's are {sample_time:.6g} s{hint}"
        raise CheckError(f"{log.source}: {found}")
