"""Labelled time series of a simulation, the figures of a stroke, and the file that keeps them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.display import Curves, Description, display, quantity
from malta.frames import data_frame
from malta.merits import Merit
from malta.model.plant import Plant
from malta.model.signals import Signal
from malta.simulation.divergence import free_outputs, rooms_in, rooms_of
from malta.simulation.engine.engines import evaluate
from malta.simulation.inputs import Inputs
from malta.simulation.layout import columns_of_row, electronics_of
from malta.simulation.scenario import Scenario, Simulation, setup_of
from malta.simulation.steps import stated_error
from malta.synthesis.controller import Controller
from malta.units import FINE_UNITS

# How a simulation ended: completed, diverged, or at the first contact.


class Verdict(NamedTuple):
    """How a simulation ended, and when (s).

    The name is "completed", "diverged", "interrupted", "not lifted", or the contact that was touched. A run has
    diverged when a value is no number any more, or an output that no contact bounds leaves the travel, or is a
    thousand times the scale of the experiment off its reference; the signal names that output.
    """

    name: str
    time: float
    signal: str = ""

    def __str__(self) -> str:
        return f"{self.words} at {self.time:.4g} s"

    @property
    def completed(self) -> bool:
        return self.name == "completed"

    @property
    def words(self) -> str:
        """The name, and the signal that diverged."""
        return f"{self.name} ({self.signal})" if self.signal else self.name


def judge(
    run: Simulation, rows: FloatArray, t: FloatArray, ended: bool = False, used: FloatArray | None = None
) -> tuple[FloatArray, Verdict | None]:
    """The rows up to the first contact, the first NaN or a divergence, and the verdict; None where none occurs.

    A machine with touchdown bearings goes on after it touches one of them; only other contacts end its run.

    ended : rows end with the first in which a contact ends the run, as the compiled engine's do
    used : from `rooms_in`; None: contacts bound all outputs
    """
    away = np.zeros(len(rows), dtype=bool) if used is None else np.atleast_1d((used >= 1).any(axis=1))
    columns, last = columns_of_row(run.plant, run.controller, run.setup)["contact"], rows[-1].tolist()
    if all(map(math.isfinite, last)):  # a state that is no number stays none
        largest = max(last[columns], default=0.0) if ended else rows[:, columns].max(initial=0.0)
        if largest < 1 and not away.any():
            return rows, None
    plant, contact = run.plant, rows[:, columns]
    lost = np.atleast_1d(~np.isfinite(rows).all(axis=1))
    touching = contact >= 1
    if run.setup.bearing:
        touching = touching & ~np.array(plant.contacts.cushioned)
    stopped = np.flatnonzero(lost | away | touching.any(axis=1))
    if not len(stopped):
        return rows, None
    k = int(stopped[0])
    if not (lost[k] or (away[k] and not touching[k].any())):
        name = plant.contacts.names[int(np.where(touching[k], contact[k], 0).argmax())]
        return rows[: k + 1], Verdict(name, float(t[k]))
    signal = ""
    if used is not None and away[k]:
        outputs = [*free_outputs(plant), plant.leading_output]
        signal = plant.outputs[outputs[int(np.nan_to_num(used[k], nan=np.inf).argmax())]].name
    return rows[: k + 1], Verdict("diverged", float(t[k]), signal)


def bearing_verdict(plant: Plant, contact: FloatArray, t: FloatArray) -> Verdict | None:
    """The verdict of a run with touchdown bearings.

    None where the mover never touched them, or where it rested on them at the start and is free at the end.
    """
    touching = contact >= 1
    if not touching.any():
        return None
    if touching[0].any():  # a lift-off
        if not touching[-1].any():
            return None
        return Verdict("not lifted", float(t[len(contact) - 1]))
    k = int(touching.any(axis=1).argmax())
    return Verdict(plant.contacts.names[int(contact[k].argmax())], float(t[k]))


def columns_of(run: Simulation, rows: FloatArray, name: str) -> FloatArray:
    """The columns of one signal of `layout_of(...).row`; rows has any number of leading axes."""
    return rows[..., columns_of_row(run.plant, run.controller, run.setup)[name]]


@display
@dataclass(frozen=True, eq=False)
class Trajectory:
    """Labelled time series of a run, one row a sample, up to the verdict. SI.

    i, u and link are empty in fidelity `force`, i_phase and duty in all fidelities but `phase`. The phases of a machine
    with electronics of its own are its coils.

    plant : the machine
    controller : its controller
    scenario : the scenario
    verdict : its name, as "completed", and its time (s)
    engine : which simulated it: "compiled" or "virtual machine"
    integration_error : bound of what Runge-Kutta steps err in p, as in `malta.simulation.choose_steps`; NaN: not known,
        with `substeps`, electronics of their own pace, or contacts
    t : k, s; from 0 on, but for a run that ended while it settled
    reference : k x p
    p : k x p, true outputs
    y : k x p, measured
    x : k x states, true
    xi_hat : k x n, estimated
    v : k x m, commanded forces, N
    force : k x m, acting forces, N
    saturated : k x m, 1 where the command was limited
    contact : k x contacts, share of each clearance that the mover takes; 1: touch
    current : k x coils, commanded, A
    met : k x limits, 1 where a limit was reached: the coil currents', then those of the electronics
    i : k x axes, A
    u : k x axes, V
    link : k x 1, V
    i_phase : k x phases, A
    duty : k x phases, 0 to 1

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(10e-3))
    >>> run.verdict.name, run.p.shape, run.limits
    ('completed', (2000, 5), ())
    >>> f"{run.copper_loss.max():.0f} W"
    '134 W'
    """

    plant: Plant
    controller: Controller
    scenario: Scenario
    verdict: Verdict
    engine: str
    integration_error: float
    t: FloatArray
    reference: FloatArray
    p: FloatArray
    y: FloatArray
    x: FloatArray
    xi_hat: FloatArray
    v: FloatArray
    force: FloatArray
    saturated: FloatArray
    contact: FloatArray
    current: FloatArray
    met: FloatArray
    i: FloatArray
    u: FloatArray
    link: FloatArray
    i_phase: FloatArray
    duty: FloatArray

    def __post_init__(self) -> None:
        for name in ("t", "reference", *SERIES):
            array = getattr(self, name)
            if array is not (sealed := readonly(array)):
                object.__setattr__(self, name, sealed)

    @property
    def columns(self) -> dict[str, tuple[Signal, ...]]:
        """The signals of each series that was simulated: its columns."""
        plant, coils = self.plant, self.plant.actuator.coils
        drive = plant.actuator.windings
        axes, phases = ((), coils) if drive is None else (drive.axes, drive.phases)
        volts = tuple(Signal(s.name.replace("i_", "u_"), "V") for s in axes)
        shares = tuple(Signal(s.name.replace("i_", "d_"), "1") for s in phases)
        every = dict.fromkeys(("reference", "p", "y"), plant.outputs)
        every |= {"x": plant.states, "xi_hat": self.controller.states}
        every |= dict.fromkeys(("v", "force", "saturated"), plant.inputs)
        every |= {"current": coils, "i": axes, "u": volts, "link": (Signal("V_link", "V"),)}
        every |= {"i_phase": phases, "duty": shares}
        return {name: signals for name, signals in every.items() if getattr(self, name).shape[1]}

    def to_pandas(self) -> Any:
        """The series as a pandas.DataFrame by time, a column a signal: "p z [m]". SI.

        Raises InputError where pandas is not installed.
        """
        series = {
            f"{name} {signal.name} [{signal.unit}]": column
            for name, signals in self.columns.items()
            for signal, column in zip(signals, getattr(self, name).T, strict=True)
        }
        return data_frame(series, ("t [s]", self.t))

    @property
    def limits(self) -> tuple[str, ...]:
        """Names of the limits that were reached on the way."""
        fast = electronics_of(self.plant, setup_of(self.plant, self.controller, self.scenario))
        names = ("current limit", *(fast.flags if fast is not None else ()))
        met = [name for name, column in zip(names, self.met.T, strict=True) if column.any()]
        return (*(["force limit"] if self.saturated.any() else []), *met)

    @property
    def copper_loss(self) -> FloatArray:
        """Heat in the windings, W, shape (k,): R i^2 summed over phases, or over axes with their weights."""
        if self.i_phase.size:
            return np.asarray(self.plant.actuator.R * (self.i_phase**2).sum(axis=1))
        if self.plant.actuator.windings is None:
            return np.asarray(self.plant.actuator.R * (self.current**2).sum(axis=1))
        return np.asarray(self.plant.actuator.R * self.axis_currents**2 @ np.array(self.plant.drive.weight))

    @property
    def electrical_power(self) -> FloatArray:
        """Power into the windings, W, shape (k,); empty in fidelity `force`."""
        if not self.i.size or self.plant.actuator.windings is None:
            return np.empty(0)
        delay = min(setup_of(self.plant, self.controller, self.scenario).delay, len(self.u) - 1)
        acting = np.vstack([np.repeat(self.u[:1], delay, axis=0), self.u[: len(self.u) - delay]])
        return np.asarray((acting * self.i) @ np.array(self.plant.drive.weight))

    @property
    def axis_currents(self) -> FloatArray:
        """Currents of the transformation's axes, A, k x axes; in fidelity `force` those that make the acting forces."""
        if self.i.size or self.plant.actuator.windings is None:
            return self.i
        drive, constants = self.plant.drive, np.array(self.plant.actuator.force_constant)
        symbol = ca.SX.sym("i", len(constants))
        axes = ca.Function("axes", [symbol], [ca.densify(drive.command(symbol))])
        return evaluate(axes.map(len(self.force)), self.force / constants)[0]

    @property
    def figures(self) -> tuple[Merit, ...]:
        """Figures of merit of any run: deviations of each output, largest and rms, forces, the nearest contact."""
        off, found = self.p - self.reference, []
        for k, s in enumerate(self.plant.outputs):
            largest = float(np.abs(off[:, k]).max(initial=0.0))
            rms = math.sqrt((off[:, k] ** 2).mean()) if len(off) else 0.0
            unit = FINE_UNITS.get(s.unit, s.unit)
            found += [
                Merit(f"largest deviation {s.name}", largest, unit, signal=s.name),
                Merit(f"deviation {s.name}, rms", rms, unit, signal=s.name),
            ]
        for s, column in zip(self.plant.inputs, self.v.T, strict=False):
            largest = float(np.abs(column).max(initial=0.0))
            found.append(Merit(f"largest command {s.name}", largest, s.unit, signal=s.name))
        if self.plant.contacts.names:
            closest = float(self.contact.max(initial=0.0))
            found.append(Merit("nearest contact", closest, "percent", relation="at most", bound=1.0))
        return tuple(found)

    @property
    def description(self) -> Description:
        """How it ended, the largest deviations, forces and shares of clearances."""
        plant, Ts, figures = self.plant, self.controller.sample_time, self.figures
        rows = [("ended", f"{self.verdict.words} at {quantity(self.verdict.time, 's')}, {self.engine}")]
        for signal, largest, rms in zip(plant.outputs, figures[::2], figures[1::2], strict=False):
            sizes = (quantity(one.value, signal.unit) for one in (largest, rms))
            rows.append((f"p - p* of {signal.name}", "{} at most, {} rms".format(*sizes)))
        if plant.contacts.names:
            rows.append((figures[-1].label, f"{figures[-1].phrase()} of a clearance"))
        rows.append(("limits reached", ", ".join(self.limits) or "none"))
        units = "/".join(dict.fromkeys(signal.unit for signal in plant.outputs))
        if not math.isnan(self.integration_error):
            rows.append(("integration error", f"below {self.integration_error:.2g} {units}"))
        off, size = self.p - self.reference, [one.value for one in figures[::2]]
        shown = {s.name: off[:, k] / (size[k] or 1.0) for k, s in enumerate(plant.outputs)}
        curves = Curves(self.t, "time [s]", shown, "(p - p*) / its largest [1]")
        title = f"Trajectory of {self.controller.name!r} in {self.scenario.name!r}: {len(self.t)} samples"
        return Description(f"{title} of {quantity(Ts, 's')}", tuple(rows), curves)


SERIES = (
    *("p", "y", "x", "xi_hat", "v", "force", "saturated", "contact", "current", "met"),
    *("i", "u", "link", "i_phase", "duty"),
)


def trajectory_of(run: Simulation, inputs: Inputs, rows: FloatArray, kind: str) -> Trajectory:
    """The trajectory of a run from rows that are there already, one for each sample of the inputs."""
    rooms = rooms_of(run, inputs)
    used = rooms_in(run, rows, inputs.given, rooms) if rooms.size else None
    rows, verdict = judge(run, rows, inputs.t, used=used)
    return label_rows(run, inputs, rows, verdict, kind)


def label_rows(
    run: Simulation, inputs: Inputs, rows: FloatArray, verdict: Verdict | None, kind: str
) -> Trajectory:
    """The trajectory of rows up to a verdict; None: no contact and no divergence ended the run."""
    plant, controller, scenario, setup = run
    (t, _, given), done = inputs, len(rows)
    for array in (rows, given, t):
        array.flags.writeable = False  # the trajectory's series are views of them
    columns = columns_of_row(plant, controller, setup)
    if setup.bearing and (verdict is None or verdict.name in plant.contacts.names):
        verdict = bearing_verdict(plant, rows[:, columns["contact"]], t) or verdict
    verdict = verdict or Verdict("completed", scenario.duration)
    steady = verdict.completed and not (setup.bearing and (rows[:, columns["contact"]] >= 1).any())
    before = scenario.settling_samples(controller.sample_time)
    kept = slice(before if done > before else 0, done)
    rows = rows[kept.start :]
    none = slice(0, 0)  # of a signal that this fidelity does not have
    return Trajectory(
        plant,
        controller,
        scenario,
        verdict,
        kind,
        stated_error(run) if steady else math.nan,
        t=t[kept],
        reference=given[kept, : len(plant.outputs)],
        **{name: rows[:, columns.get(name, none)] for name in SERIES},
    )
