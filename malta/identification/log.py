"""Logs of a bench: what sensors, commands and excitation were, sample by sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError
from malta.model.plant import Plant, Signal
from malta.simulation.current_control import reading_errors
from malta.simulation.inputs import initial_values
from malta.simulation.layout import LoopPlan
from malta.simulation.multisine import Multisine
from malta.simulation.simulate import prepare
from malta.simulation.trajectory import Trajectory

GROUPS = {"y": "", "v": "", "i": "", "u": "", "reference": "ref.", "excitation": "exc.", "flags": "flag."}
"""The groups of columns, and what stands before the signal's name in a heading."""


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

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", readonly(self.t))
        object.__setattr__(self, "columns", {name: readonly(table) for name, table in self.columns.items()})

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
        return np.asarray(self.columns[group][:, [known.index(name) for name in names]])

    @cached_property
    def survey(self) -> Survey:
        """Statistics of its signals and what is wrong with its samples."""
        return survey(self)

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
        return Description(f"Log {self.source!r}", tuple(rows))


@dataclass(frozen=True)
class Survey:
    """What a log shows at a first look.

    statistics : by heading "name [unit]": least, mean, largest value and standard deviation, SI; missing ones apart
    jitter : s, standard deviation of the intervals between samples
    gaps : intervals longer than 1.5 samples
    missing : by signal: readings that are not there
    stuck : by measured output: the longest run of one and the same reading, samples, where it is suspicious
    clipped : by measured output: samples at the end of its range, where they pile up
    limits : by flag: share of the samples in which it was set
    """

    statistics: Mapping[str, tuple[float, float, float, float]]
    jitter: float
    gaps: int
    missing: Mapping[str, int]
    stuck: Mapping[str, int]
    clipped: Mapping[str, int]
    limits: Mapping[str, float]

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong, in words."""
        found = [f"{self.gaps} gaps"] if self.gaps else []
        found += [f"{count} readings of {name} missing" for name, count in self.missing.items()]
        found += [f"{name} stuck for {count} samples" for name, count in self.stuck.items()]
        found += [f"{name} clipped in {count} samples" for name, count in self.clipped.items()]
        return (
            *found,
            *(f"{name} in {100 * share:.3g} % of the time" for name, share in self.limits.items()),
        )


STUCK_SHARE = 0.02  # of a log, for which a sensor may read the same
MIN_STUCK_SAMPLES = 200  # samples of a reading that is called stuck
PILE = 0.002  # of a log at an end of a sensor's range
PILE_RATIO = 4.0  # times as many readings at the end as beside it
MIN_DIFFERENT_READINGS = 5  # different readings, without which a sensor has no range


def survey(log: Log) -> Survey:
    """The statistics of a log and what is wrong with its samples."""
    statistics: dict[str, tuple[float, float, float, float]] = {}
    missing: dict[str, int] = {}
    for group, table in log.columns.items():
        for signal, values in zip(log.signals[group], table.T, strict=True):
            there = values[np.isfinite(values)]
            if len(there) < len(values):
                missing[GROUPS[group] + signal.name] = len(values) - len(there)
            numbers = (there.min(), there.mean(), there.max(), there.std()) if len(there) else (np.nan,) * 4
            heading = f"{GROUPS[group]}{signal.name} [{signal.unit}]"
            statistics[heading] = tuple(map(float, numbers))  # type: ignore[assignment]
    steps = np.diff(log.t)
    near = steps[steps < 1.5 * log.sample_time]
    stuck, clipped = {}, {}
    for signal, values in zip(log.signals.get("y", ()), log.columns["y"].T, strict=True):
        longest, piled = _longest_run(values), _count_piled(values)
        if longest >= max(MIN_STUCK_SAMPLES, STUCK_SHARE * len(values)):
            stuck[signal.name] = longest
        elif piled:
            clipped[signal.name] = piled
    flags = zip(log.names("flags"), log.columns.get("flags", np.zeros((1, 0))).mean(axis=0), strict=True)
    return Survey(
        statistics,
        jitter=float(near.std()) if len(near) else 0.0,
        gaps=len(steps) - len(near),
        missing=missing,
        stuck=stuck,
        clipped=clipped,
        limits={name: float(share) for name, share in flags if share},
    )


def _longest_run(values: FloatArray) -> int:
    """The number of samples of the longest run of one value."""
    changes = np.flatnonzero(np.diff(values) != 0)
    return int(np.diff(np.concatenate([[-1], changes, [len(values) - 1]])).max(initial=0))


def _count_piled(values: FloatArray) -> int:
    """The number of samples at an end of the range where many more pile up than beside it; 0: none do."""
    levels, count = np.unique(values[np.isfinite(values)], return_counts=True)
    if len(levels) < MIN_DIFFERENT_READINGS:
        return 0
    ends = ((count[0], count[1]), (count[-1], count[-2]))
    return int(sum(end for end, next_ in ends if end > max(PILE * len(values), PILE_RATIO * next_)))


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
    delay = actuator.delay(Ts) if run.scenario.delay is None else run.scenario.delay
    ready = prepare(run.plant, run.controller, run.scenario)
    first = (
        run.current[:1] if run.scenario.settle else initial_values(ready.simulation, ready.inputs.given[0])[2]
    )
    held = np.vstack([np.tile(first, (delay, 1)), run.current])[: len(run.current)]
    if not np.isfinite(actuator.crossover):
        return np.asarray(held)
    from scipy.signal import lfilter  # half a second to import

    decay = float(np.exp(-actuator.crossover * Ts))
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
        table = np.full((log.samples, len(names)), otherwise)
        table[:, [names.index(name) for name in there]] = log.table(group, there)
        columns[group], signals[group] = table, tuple(wanted)
    return log if signals == log.signals else replace(log, columns=columns, signals=signals)


def require_currents(log: Log, axes: Sequence[str]) -> None:
    """Raise InputError for a log with a current that its machine has not.

    axes : names of the machine's currents
    """
    for name in log.names("i"):
        if name not in axes:
            raise InputError(
                log.source, name, "a current that the machine has not", "one of " + " ".join(axes)
            )


def require_same_law(log: Log, machine: str, sample_time: float) -> None:
    """Raise CheckError for a log of another machine than the gain file's, and of another sample time."""
    if log.machine and log.machine != machine:
        raise CheckError(f"{log.source}: a log of machine {log.machine}, but the gain file is for {machine}")
    if abs(log.sample_time / sample_time - 1) > 1e-3:
        found = f"samples of {log.sample_time:.6g} s, but the law's are {sample_time:.6g} s"
        raise CheckError(f"{log.source}: {found}")
