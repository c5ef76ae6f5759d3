"""Nonlinear machine + gain file + scenario -> trajectory.

At every sample the control law of controller.py runs on what the sensors say; between samples the machine moves by
Runge–Kutta steps. Both are the functions of machine.py, run by engine.py. The controller is known only by its gain
file's record; the machine may have other parameters.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np
from scipy.special import erf

from malta.errors import InputError
from malta.files import replace_files
from malta.model.data import (
    plant_of,
    shaping,
    twins_of,
    units_of,
)
from malta.model.plant import Plant, Signal, position_in, readonly
from malta.simulation import period as machine
from malta.simulation import references
from malta.simulation.engines import (
    Engine,
    compiled_engine,
    evaluate,
    feedforward_table,
    library,
    source,
    substeps_until,
    virtual_engine,
)
from malta.simulation.noise import keys, normals
from malta.simulation.period import (
    FIDELITIES,
    Fidelity,
    Parts,
    Setup,
)
from malta.simulation.references import Profile, Reference
from malta.synthesis.controller import Controller, gains_of

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

LONGEST = 4_000_000  # samples: 200 s at 20 kHz, 2 GB of trajectory
BLOCK = 250  # samples in one call of the virtual machine's chain
PORTION = 20_000  # samples between looks at how the run goes

Estimator = Literal["steady-state", "kalman", "extended"]
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
FeedforwardChoice = Literal["axial", "attraction"]
FEEDFORWARDS: tuple[FeedforwardChoice, ...] = get_args(FeedforwardChoice)
BearingAxes = Literal["fixed", "turning"]
EngineChoice = Literal["auto", "compiled", "virtual machine"]
FaultKind = Literal[
    "lost sample", "stuck sensor", "biased sensor", "noisy sensor", "open phase", "link sag", "missed step"
]


class Correction(NamedTuple):
    """An outer loop, slower than the controller, that moves its reference: (t, true outputs) -> added to p*."""

    every: float  # s
    update: Callable[[float, FloatArray], FloatArray]


class Fault(NamedTuple):
    """Something that breaks at `at` (s) and is whole again at `until` (s)."""

    kind: FaultKind
    at: float  # s
    until: float = math.inf  # s
    what: str = ""  # the sensor (an output's name) or the phase that it concerns
    size: float = (
        0.0  # bias, in the output's unit; factor of the noise; share of the link voltage that is missing
    )


@dataclass(frozen=True, eq=False)
class Scenario:
    """What is asked of the machine, and what it has to stand."""

    name: str
    duration: float  # s
    reference: Callable[[Plant], Reference]
    start: Mapping[str, float] = field(default_factory=dict)  # states (SI) unlike the reference's first
    cold: bool = False  # starts without current, and with an observer that takes the machine to be at zero
    disturbance: Callable[[FloatArray], FloatArray] | None = None  # t (k,) -> wrench, k x 6, N and N m
    noise: float = 0.0  # sensor noise in multiples of the plant's
    quantize: bool = False  # sensors resolve what the plant's do
    sensor_errors: Mapping[str, float] | None = None  # of the sensors' own signals; None: y = p exactly
    seed: int = 0
    run: int = 0  # of a campaign: its noise depends on seed and run alone
    delay: int | None = None  # samples between measurement and force; None: the machine's own
    substeps: int | None = (
        None  # Runge–Kutta steps a sample; None: as many as the current loops ask for, at least 4
    )
    fidelity: Fidelity = "dq"  # what makes the forces, see machine.py
    real_pwm: bool = False  # duty cycles in steps, dead time (fidelity phase)
    bearing_axes: BearingAxes = "fixed"  # of the current controllers; "turning": (18) as printed
    bearing: bool = False  # touchdown bearings push back; without, a touchdown ends the run
    estimator: Estimator = "steady-state"
    feedforward: FeedforwardChoice = (
        "axial"  # "attraction" adds what holds the mover off centre, see `feedforward`
    )
    scheduled: bool = False  # C(z) of the measured z in the steady-state filter
    faults: tuple[Fault, ...] = ()
    correction: Correction | None = None
    open_loop: bool = False  # no feedback: what is fed forward, commutated for the reference
    electronics: Any = None  # options of the machine's own electronics (fidelity phase), where it has some
    changes: tuple[
        tuple[float, Mapping[str, float]], ...
    ] = ()  # s: parameters of the machine (SI) from then on

    def __post_init__(self) -> None:
        where = f"scenario {self.name}"
        for name, low, whole in (
            ("duration", 1e-12, False),
            ("noise", 0, False),
            ("substeps", 1, True),
            ("delay", 0, True),
            ("seed", 0, True),
            ("run", 0, True),
        ):
            value = getattr(self, name)
            if whole and value is not None and not isinstance(value, int):
                raise InputError(where, name, repr(value), "a whole number")
            if value is not None and not isinstance(value, float | int | np.number):
                raise InputError(where, name, repr(value), "a number")
            if value is not None and not (math.isfinite(value) and value >= low):
                raise InputError(where, name, str(value), "a number above 0" if low else "0 or more")
        for name, known in (
            ("fidelity", FIDELITIES),
            ("estimator", ESTIMATORS),
            ("feedforward", FEEDFORWARDS),
            ("bearing_axes", get_args(BearingAxes)),
        ):
            if getattr(self, name) not in known:
                raise InputError(where, name, repr(getattr(self, name)), "one of " + ", ".join(known))
        for fault in self.faults:
            if fault.kind not in get_args(FaultKind):
                raise InputError(
                    where, "faults", repr(fault.kind), "one of " + ", ".join(get_args(FaultKind))
                )
            if math.isnan(fault.at) or math.isnan(fault.until):
                raise InputError(where, fault.kind, f"{fault.at} s to {fault.until} s", "times")
        for at, _ in self.changes:
            if not math.isfinite(at):
                raise InputError(where, "changes", f"{at} s", "a time")
        if self.correction is not None and not (0 < self.correction.every < math.inf):
            raise InputError(where, "correction", f"{self.correction.every} s", "a time above 0 s")
        if self.real_pwm and self.fidelity != "phase":
            raise InputError(where, "real_pwm", f"fidelity {self.fidelity}", "fidelity phase")

    @classmethod
    def stroke(
        cls,
        distance: float = 10e-3,
        *,
        rise: float | None = None,
        profile: Profile = "logistic",
        duration: float | None = None,
        **options: Any,
    ) -> Scenario:
        """Move by `distance` (m), symmetrically about the middle, in `rise` (s, 10-90 %).

        rise : None: the machine's own, RISE of its experiments
        duration : s; None gives six times the rise, at least 0.1 s, so that the move is whole
        options : fields of the scenario, as noise=1.0
        """
        if rise is not None:
            references.check_rise(rise)
        if duration is None:
            duration = max(0.1, 6 * (rise or 0.0))
        if not (math.isfinite(distance) and distance != 0):
            raise InputError("stroke", "distance", f"{distance} m", "a finite distance other than 0 m")
        reference = partial(
            references.stroke,
            start=-distance / 2,
            end=distance / 2,
            rise=rise,
            centre=duration / 2,
            profile=profile,
        )
        return cls("stroke", duration, reference, **options)


class Verdict(NamedTuple):
    """How a simulation ended: "completed", "diverged", or what was touched; and when (s)."""

    name: str
    time: float

    @property
    def completed(self) -> bool:
        return self.name == "completed"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Labelled time series, one row a sample, up to the verdict. SI.

    Axis currents, their voltages and the link voltage are empty in fidelity `force`; phases in all but `phase`; of
    machines with electronics of their own the phases are the coils.
    """

    plant: Plant
    controller: Controller
    scenario: Scenario
    verdict: Verdict
    engine: str  # what ran it: "compiled" or "virtual machine"
    t: FloatArray  # k
    reference: FloatArray  # k x p
    p: FloatArray  # k x p, true outputs
    y: FloatArray  # k x p, measured
    x: FloatArray  # k x states, true
    xi_hat: FloatArray  # k x n, estimated
    v: FloatArray  # k x m, commanded forces, N
    force: FloatArray  # k x m, acting forces, N
    saturated: FloatArray  # k x m, 1 where the command was limited
    contact: FloatArray  # k x contacts, share of each clearance that is used up
    current: FloatArray  # k x coils, commanded, A
    met: FloatArray  # k x limits, 1 where one was met: of the coil currents, then those of the electronics until then
    i: FloatArray  # k x axes, A
    u: FloatArray  # k x axes, V
    link: FloatArray  # k x 1, V
    i_phase: FloatArray  # k x phases, A
    duty: FloatArray  # k x phases, 0 to 1

    def __post_init__(self) -> None:
        for name in ("t", "reference", *SERIES):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def limits(self) -> tuple[str, ...]:
        """The limits that were met on the way, by name."""
        fast = machine.electronics_of(self.plant, setup_of(self.plant, self.controller, self.scenario))
        names = ("current limit", *(fast.flags if fast is not None else ()))
        met = [name for name, column in zip(names, self.met.T, strict=True) if column.any()]
        return (*(["force limit"] if self.saturated.any() else []), *met)

    @property
    def copper_loss(self) -> FloatArray:
        """Heat in the windings, W, k: sum of R i^2 over phases or, with its weights, over axes."""
        if self.i_phase.size:
            return np.asarray(self.plant.actuator.R * (self.i_phase**2).sum(axis=1))
        if self.plant.windings is None:
            return np.asarray(self.plant.actuator.R * (self.current**2).sum(axis=1))
        return np.asarray(self.plant.actuator.R * self.axis_currents**2 @ np.array(self.plant.drive.weight))

    @property
    def electrical_power(self) -> FloatArray:
        """Power into the windings, W, k; empty in fidelity `force`."""
        if not self.i.size or self.plant.windings is None:
            return np.empty(0)
        delay = min(setup_of(self.plant, self.controller, self.scenario).delay, len(self.u) - 1)
        acting = np.vstack([np.repeat(self.u[:1], delay, axis=0), self.u[: len(self.u) - delay]])
        return np.asarray((acting * self.i) @ np.array(self.plant.drive.weight))

    @property
    def axis_currents(self) -> FloatArray:
        """Currents of the transformation's axes, A, k x axes; in fidelity `force` what the forces take."""
        if self.i.size or self.plant.windings is None:
            return self.i
        drive, constants = self.plant.drive, np.array(self.plant.actuator.force_constant)
        symbol = ca.SX.sym("i", len(constants))
        axes = ca.Function("axes", [symbol], [ca.densify(drive.command(symbol))])
        return evaluate(axes.map(len(self.force)), self.force / constants)[0]


SERIES = (
    *("p", "y", "x", "xi_hat", "v", "force", "saturated", "contact", "current", "met"),
    *("i", "u", "link", "i_phase", "duty"),
)


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
    t, motion, given = sampled(plant, controller, scenario, setup)
    samples = len(t)
    stages = _stages(plant, scenario, controller.sample_time)
    noise = _noise(stages, scenario, t)
    steps = substeps_of(plant, controller, setup, scenario)
    fast = _fast_noise(plant, setup, scenario, substeps_until(samples, steps))
    x, xi_pred, current = beginning(plant, controller, scenario, given[0])
    start = machine.initial_state(plant, controller, setup)
    state = evaluate(start, x, xi_pred, current)[0].ravel()
    observer = _observer(plant, controller, scenario, setup) if setup.outside else None
    every = _every(scenario, controller.sample_time)
    stops = _stops(every, samples, [first for first, _ in stages])
    parts: list[FloatArray] = []
    verdict, kind, done = None, "", 0
    try:
        for stop in stops:
            now = next(p for first, p in reversed(stages) if first <= done)
            run = engine_of(now, controller, setup, steps, _errors(scenario), engine)
            part = given[done:stop]
            jitter = fast[substeps_until(done, steps) : substeps_until(stop, steps)]
            if observer is None:
                state, rows = run.run(done, state, part, noise[done:stop], jitter)
            else:
                state, rows = observer(run, now, state, part, noise[done:stop])
            rows, verdict = _judged(plant, controller, setup, rows, t[done:stop])
            parts.append(rows)
            kind, done = run.kind, done + len(rows)
            if verdict is not None:
                break
            if progress is not None:
                progress(done / samples)
            if scenario.correction is not None and done < samples and done % every == 0:
                offset = np.asarray(
                    scenario.correction.update(
                        float(t[done]), _columns(plant, controller, setup, rows[-1], "p")
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
                new = _given(plant, controller, scenario, setup, shifted, t[ahead])
                given[done : done + every] = new[before:]
    except KeyboardInterrupt:
        if not parts:
            raise
        verdict = Verdict("interrupted", float(t[done - 1]))
    table = np.concatenate(parts) if len(parts) > 1 else parts[0]
    return _labelled(plant, controller, scenario, setup, (t, given), table, verdict, kind)


def recorded(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    setup: Setup,
    asked: tuple[FloatArray, FloatArray],
    rows: FloatArray,
    kind: str,
) -> Trajectory:
    """The trajectory of a run whose rows, one for each sample, are there already; `asked` as `sampled` gives them."""
    rows, verdict = _judged(plant, controller, setup, rows, asked[0])
    return _labelled(plant, controller, scenario, setup, asked, rows, verdict, kind)


def _labelled(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    setup: Setup,
    asked: tuple[FloatArray, FloatArray],
    table: FloatArray,
    verdict: Verdict | None,
    kind: str,
) -> Trajectory:
    """Rows up to the verdict as labelled series."""
    (t, given), done = asked, len(table)
    for array in (table, given, t):
        array.flags.writeable = False  # the trajectory's series are views of them
    sizes = machine.layout(plant, controller, setup).row
    columns = dict(zip(sizes, np.split(table, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))
    if setup.bearing and (verdict is None or verdict.name in plant.contacts):  # what it touched first
        verdict = _touched(plant, columns["contact"], t) or verdict
    return Trajectory(
        plant,
        controller,
        scenario,
        verdict or Verdict("completed", scenario.duration),
        kind,
        t=t[:done],
        reference=given[:done, : len(plant.outputs)],
        **{name: columns.get(name, np.empty((done, 0))) for name in SERIES},
    )


def sampled(
    plant: Plant, c: Controller, scenario: Scenario, setup: Setup
) -> tuple[FloatArray, references.Motion, FloatArray]:
    """Times of the samples, the motion that is asked for, and what every sample is given."""
    samples = max(1, round(scenario.duration / c.sample_time))
    if samples > LONGEST:
        raise InputError(f"scenario {scenario.name}", "duration", f"{samples} samples", f"at most {LONGEST}")
    t = np.arange(samples) * c.sample_time
    motion = scenario.reference(plant)(t)
    return t, motion, _given(plant, c, scenario, setup, motion, t)


def setup_of(plant: Plant, c: Controller, s: Scenario) -> Setup:
    """What of a scenario shapes the simulated functions."""
    kinds = {fault.kind for fault in s.faults}
    if "open phase" in kinds and s.fidelity != "phase":
        found = f"an open phase at fidelity {s.fidelity}"
        raise InputError(f"scenario {s.name}", "faults", found, "fidelity phase")
    able = machine.fidelities(plant)
    if s.fidelity not in able:
        expected = "one of " + ", ".join(able) + f" for a {plant.name}"
        raise InputError(f"scenario {s.name}", "fidelity", s.fidelity, expected)
    own = plant.electronics is not None and s.fidelity == "phase"
    if s.electronics is not None and not own:
        found = f"options of electronics at fidelity {s.fidelity}"
        raise InputError(f"scenario {s.name}", "electronics", found, "a machine that has some, at phase")
    if own and s.estimator != "steady-state":
        found = f"{s.estimator} with electronics of their own pace"
        raise InputError(f"scenario {s.name}", "estimator", found, "steady-state, or fidelity force")
    if own and (s.real_pwm or s.bearing_axes == "turning" or "open phase" in kinds or "link sag" in kinds):
        raise InputError(f"scenario {s.name}", "fidelity", "options of a drive", "those of the electronics")
    if s.scheduled and c.tracks == "errors":
        raise InputError(f"scenario {s.name}", "scheduled", "a law of errors", "one with a filter of states")
    known = [signal.name for signal in plant.sensor_errors]
    for name, value in (s.sensor_errors or {}).items():
        if name not in known:
            where = f"scenario {s.name}"
            raise InputError(where, f"sensor_errors.{name}", "an unknown error", "one of " + " ".join(known))
        if not math.isfinite(value):
            raise InputError(f"scenario {s.name}", f"sensor_errors.{name}", repr(value), "a finite number")
    return Setup(
        fidelity=s.fidelity,
        delay=plant.actuator.delay(c.sample_time) if s.delay is None else s.delay,
        quantize=s.quantize,
        disturbed=s.disturbance is not None,
        bearing=s.bearing,
        sensed=s.sensor_errors is not None,
        faulty=bool(kinds - {"biased sensor", "noisy sensor"}),
        scheduled=s.scheduled,
        real_pwm=s.real_pwm,
        turning=s.bearing_axes == "turning" and s.fidelity != "force",
        outside=s.estimator != "steady-state",
        open_loop=s.open_loop,
        electronics=s.electronics,
    )


def substeps_of(plant: Plant, c: Controller, setup: Setup, s: Scenario) -> float:
    """Steps of the simulation in a sample: the scenario's, or the periods of the machine's electronics."""
    fast = machine.electronics_of(plant, setup)
    return steps_of(plant, c, s) if fast is None else c.sample_time / fast.period


def steps_of(plant: Plant, c: Controller, s: Scenario) -> int:
    """Runge–Kutta steps in a sample: the scenario's, or one for each time constant of the current loops, at least 4."""
    if s.substeps is not None:
        return s.substeps
    lag = c.sample_time * plant.actuator.crossover
    return max(4, math.ceil(lag)) if math.isfinite(lag) else 4


def _errors(scenario: Scenario) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((scenario.sensor_errors or {}).items()))


@dataclass(frozen=True)
class _Shape:
    """A plant and controller, equal to another one where the same compiled text serves both."""

    key: tuple[Any, ...]
    plant: Plant = field(compare=False)
    controller: Controller = field(compare=False)
    setup: Setup


def shape_of(plant: Plant, c: Controller, setup: Setup) -> _Shape:
    """What the compiled functions of a plant and a controller depend on, beside numbers that they are given."""
    variant, par = plant.variant, plant.parameters
    kin = (variant.func, *sorted(variant.keywords.items())) if isinstance(variant, partial) else (variant,)
    twins = tuple(twins_of(par).items())
    patterns = tuple(
        (m.shape, *m.sparsity().get_triplet()[0], *m.sparsity().get_triplet()[1])
        for m in gains_of(c).values()
    )
    fixed = tuple(shaping(par).items())
    return _Shape((type(par), kin, twins, fixed, patterns, c.tracks, c.parameters), plant, c, setup)


@lru_cache(maxsize=32)
def compiled_shape(
    shape: _Shape, lanes: int = 1, digest: ca.Function | None = None
) -> tuple[Any, Parts] | None:
    """The library for a shape; None where it cannot be compiled."""
    c = shape.controller
    if plant_of(c.parameters).tabulated:
        return None
    p = machine.parts(shape.plant, c, shape.setup, machine.numbers(shape.plant, c, 1), constant=False)
    lib = library(source(p, digest), lanes)
    return None if lib is None else (lib, p)


@lru_cache(maxsize=32)  # building takes as long as a run; records compare by identity, so no hit is stale
def engine_of(
    plant: Plant,
    c: Controller,
    setup: Setup,
    substeps: float,
    errors: tuple[tuple[str, float], ...] = (),
    choice: EngineChoice = "auto",
) -> Engine:
    """What runs the control periods of this machine: compiled where possible, else CasADi's virtual machine."""
    values = machine.numbers(plant, c, substeps, dict(errors))
    if choice != "virtual machine":
        found = compiled_shape(shape_of(plant, c, setup))
        if found is not None:
            lib, p = found
            ff = c.feedforward
            table = feedforward_table(ff.z_grid, ff.v0)
            return compiled_engine(lib.run, p, machine.flat(values), substeps, table)
        if choice == "compiled":
            if plant_of(c.parameters).tabulated:
                raise InputError(
                    "simulate", "engine", "a controller that looks up a table", "virtual machine"
                )
            raise InputError("simulate", "engine", "no C compiler that works", "cc, gcc or clang, or $CC")
    p = machine.parts(plant, c, setup, values, constant=True)
    block = 1 if setup.outside or machine.electronics_of(plant, setup) is not None else BLOCK
    return virtual_engine(cache(lambda count: machine.chained(p, c, count, block)), substeps)


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


def _every(scenario: Scenario, Ts: float) -> int:
    """Samples between corrections of the reference, or between looks at the run."""
    return PORTION if scenario.correction is None else max(1, round(scenario.correction.every / Ts))


def _stops(every: int, samples: int, changes: list[int]) -> list[int]:
    """Samples at which the run pauses: to look, to correct the reference, to change the machine."""
    marks = set(range(every, samples, every)) | set(range(PORTION, samples, PORTION)) | {samples}
    return sorted(marks | {k for k in changes if 0 < k < samples})


def _judged(
    plant: Plant, c: Controller, setup: Setup, rows: FloatArray, t: FloatArray
) -> tuple[FloatArray, Verdict | None]:
    """The rows up to the first at which the machine touches something or its state is no number."""
    contact = _columns(plant, c, setup, rows, "contact")
    if np.isfinite(rows[-1]).all() and contact.max(initial=0.0) < 1:
        return rows, None  # a state that is no number stays none
    lost = np.atleast_1d(~np.isfinite(rows).all(axis=1))
    touching = contact >= 1
    if setup.bearing:  # the touchdown bearings hold it: only what has no bearing ends the run
        touching = touching & ~np.array(plant.cushioned)
    stopped = np.flatnonzero(lost | touching.any(axis=1))
    if not len(stopped):
        return rows, None
    k = int(stopped[0])
    name = "diverged" if lost[k] else plant.contacts[int(np.where(touching[k], contact[k], 0).argmax())]
    return rows[: k + 1], Verdict(name, float(t[k]))


def _touched(plant: Plant, contact: FloatArray, t: FloatArray) -> Verdict | None:
    """With touchdown bearings: None where the mover stayed off them, or lifted off and is free at the end."""
    touching = contact >= 1
    if not touching.any():
        return None
    if touching[0].any():  # a lift-off
        if not touching[-1].any():
            return None
        return Verdict("not lifted", float(t[len(contact) - 1]))
    k = int(touching.any(axis=1).argmax())
    return Verdict(plant.contacts[int(contact[k].argmax())], float(t[k]))


def _columns(plant: Plant, c: Controller, setup: Setup, rows: FloatArray, name: str) -> FloatArray:
    sizes = machine.layout(plant, c, setup).row
    first = sum(size for key, size in list(sizes.items())[: list(sizes).index(name)])
    return rows[..., first : first + sizes[name]]


def _given(
    plant: Plant,
    c: Controller,
    scenario: Scenario,
    setup: Setup,
    motion: references.Motion,
    t: FloatArray,
) -> FloatArray:
    """What every sample is given, in the order of machine.layout."""
    v_ff = feedforward(c, motion, scenario.feedforward)
    stored = v_ff
    if c.delay:  # and what currents commutated for the reference make, in the row of the newest stored force
        n, m = len(c.A), len(c.forces)
        newest = n + m * (c.delay - 1)
        states = evaluate(machine.state_reference(plant_of(c.parameters)).map(len(t)), motion.p, motion.dp)[0]
        stored = v_ff + states @ c.Ad[newest : newest + m, :n].T
    past = [np.vstack([np.repeat(stored[:1], age, axis=0), stored[:-age]]) for age in range(c.delay, 0, -1)]
    if c.observed:
        past.append(np.zeros_like(v_ff))
    parts = {"p_ref": motion.p, "dp_ref": motion.dp, "v_ff": v_ff}
    if past:
        parts["v_past"] = np.hstack(past)
    sizes = machine.layout(plant, c, setup).given
    if scenario.disturbance is not None:
        parts["w"] = _wrench(plant, scenario, t)
    if setup.faulty:
        parts |= _fault_flags(plant, scenario, sizes, t)
    parts |= {name: np.zeros((len(t), size)) for name, size in sizes.items() if name not in parts}
    return np.hstack([parts[name] for name in sizes])


def feedforward(c: Controller, motion: references.Motion, choice: FeedforwardChoice = "axial") -> FloatArray:
    """v_ff, N, k x m: inertia p*'' + speed p*'; "attraction" adds the forces that hold the mover at q*.

    With state feedback alone a mover that is pulled with stiffness k and held with K1 goes to K1 / (K1 - k) of what is
    asked, until the integrals have taken it back: twice as far at K1 = 2 k. From the file's own model q'' = k q + G v,
    these forces are -G^-1 k q*.
    """
    believed = plant_of(c.parameters)
    v_ff = c.feedforward.inertia * motion.ddp + motion.dp @ c.feedforward.speed.T
    if choice == "attraction":
        believed.require_second_order("feedforward attraction")
        half = len(c.A) // 2
        hold = -np.linalg.lstsq(c.B[half:], c.A[half:, :half], rcond=None)[0]
        states = evaluate(machine.state_reference(believed).map(len(motion.p)), motion.p, motion.dp)[0]
        v_ff += states[:, :half] @ hold.T
    return v_ff


def _wrench(plant: Plant, scenario: Scenario, t: FloatArray) -> FloatArray:
    assert scenario.disturbance is not None
    wrench = np.asarray(scenario.disturbance(t), dtype=float)
    shape = (len(t), len(plant.disturbances))
    if wrench.shape != shape or not np.isfinite(wrench).all():
        found = f"shape {wrench.shape}"
        raise InputError(f"scenario {scenario.name}", "disturbance", found, f"finite, shape {shape}")
    return wrench


def _during(fault: Fault, t: FloatArray) -> FloatArray:
    return np.asarray((t >= fault.at) & (t < fault.until))


def _index(scenario: Scenario, kind: str, name: str, known: tuple[Any, ...]) -> int:
    names = [signal.name for signal in known]
    if name not in names:
        raise InputError(f"scenario {scenario.name}", kind, repr(name), "one of " + " ".join(names))
    return names.index(name)


def _fault_flags(
    plant: Plant, scenario: Scenario, sizes: Mapping[str, int], t: FloatArray
) -> dict[str, FloatArray]:
    flags: dict[str, FloatArray] = {
        name: np.zeros((len(t), sizes[name])) for name in ("stuck", "missed", "sag", "open")
    }
    for fault in scenario.faults:
        during = _during(fault, t)
        if fault.kind == "lost sample":
            flags["stuck"][during] = 1
        elif fault.kind == "stuck sensor":
            flags["stuck"][during, _index(scenario, fault.kind, fault.what, plant.outputs)] = 1
        elif fault.kind == "missed step":
            flags["missed"][during] = 1
        elif fault.kind == "link sag":
            if not 0 <= fault.size < 1:
                raise InputError(
                    f"scenario {scenario.name}", fault.kind, f"{fault.size:g}", "a share from 0 to 1"
                )
            flags["sag"][during] = fault.size
        elif fault.kind == "open phase":
            flags["open"][during, _index(scenario, fault.kind, fault.what, plant.drive.phases)] = 1
    return flags


def _noise(stages: list[tuple[int, Plant]], scenario: Scenario, t: FloatArray) -> FloatArray:
    """Sensor noise, with what faults add to it."""
    plant = stages[0][1]
    drawn: FloatArray = np.zeros((len(t), len(plant.outputs)))
    if scenario.noise:
        drawn = normals(keys(scenario.seed, np.array([scenario.run]))[0], *drawn.shape)
        if plant.uniform:
            drawn = math.sqrt(3) * erf(drawn / math.sqrt(2))
        for k, (first, now) in enumerate(stages):
            last = stages[k + 1][0] if k + 1 < len(stages) else len(t)
            drawn[first:last] *= scenario.noise * np.array(now.noise)
    for fault in scenario.faults:
        if fault.kind in ("biased sensor", "noisy sensor"):
            column = _index(scenario, fault.kind, fault.what, plant.outputs)
            during = _during(fault, t)
            if fault.kind == "noisy sensor":
                drawn[during, column] *= fault.size
            else:
                drawn[during, column] += fault.size
    return drawn


def _fast_noise(plant: Plant, setup: Setup, scenario: Scenario, periods: int) -> FloatArray:
    """Standard normal numbers for the electronics, a row for each of their periods."""
    fast = machine.electronics_of(plant, setup)
    if fast is None or not fast.noises:
        return np.zeros((periods, 0))
    return normals(keys(scenario.seed, np.array([-1 - scenario.run]))[0], periods, fast.noises)


def beginning(plant: Plant, c: Controller, scenario: Scenario, first: FloatArray) -> tuple[FloatArray, ...]:
    """x, xi_pred and the currents of the coils (A) at the start.

    On the reference and moving with it, or as the scenario says; the observer knows it, and v0 acts, unless it is cold.
    """
    p, n = len(plant.outputs), len(c.states)
    believed = plant_of(c.parameters)
    design = [s.name for s in plant.design_states]
    moving = evaluate(machine.state_reference(believed), first[:p], first[p : 2 * p])[0].ravel()
    x = plant.state(dict(zip(design, moving.tolist(), strict=True)) | dict(scenario.start))
    xi_pred, current = np.zeros(n), np.zeros(len(plant.actuator.coils))
    if not scenario.cold:
        if c.tracks == "states":
            xi_pred[: len(design)] = x[list(plant.controlled)]
        held = c.feedforward.at(position_in(plant, x))
        if c.delay:  # what acted before, with currents that were commutated for here
            n, m = len(design), len(held)
            pull = c.Ad[n + m * (c.delay - 1) : n + m * c.delay, :n] @ (xi_pred[:n] - moving)
            stored = first[2 * p + m :][: m * c.delay]
            xi_pred[n : n + m * c.delay] = stored + np.tile(pull, c.delay)
        current[:] = evaluate(_commutated(plant, believed), x, held)[0].ravel()
    return x, xi_pred, current


@lru_cache(maxsize=16)
def _commutated(plant: Plant, believed: Plant) -> ca.Function:
    """(x, v) -> currents of the coils that the controller holds a machine at x with, as a function of numbers."""
    kind = ca.MX if believed.tabulated else ca.SX
    x, v = kind.sym("x", len(plant.states)), kind.sym("v", len(plant.inputs))
    return ca.Function("currents", [x, v], [ca.densify(believed.currents(plant.h(x, 0), v))])


def integration_error(run: Trajectory) -> float:
    """Largest error of an output that the Runge–Kutta steps made, m: against the same run with twice as many.

    Halving the steps of a fourth-order method leaves 1/16 of the error, so the difference is 15/16 of it.
    """
    s = run.scenario
    count = steps_of(run.plant, run.controller, s)
    finer = simulate(run.plant, run.controller, replace(s, substeps=2 * count))
    k = min(len(run.p), len(finer.p))
    return float(np.abs(run.p[:k] - finer.p[:k]).max()) * 16 / 15


@dataclass(frozen=True)
class StrokeFigures:
    """What the published figures say of a stroke. SI."""

    rise: float  # s, 10 to 90 % of the true position; NaN when it was not reached
    overshoot: float  # beyond the end, as a share of the stroke; NaN when the run ended early
    axial_error: float  # m, largest |z* - z|
    radial: Mapping[str, float]  # m, largest deviation of each radial output
    force: float  # N, largest commanded thrust
    current: float  # A, largest commanded current of any axis


def stroke_figures(run: Trajectory) -> StrokeFigures:
    """Rise, overshoot, tracking error and deviation of a stroke; without one, of a move of the first output."""
    names = [s.name for s in run.plant.outputs]
    axis = run.plant.leading_output
    z, z_ref = run.p[:, axis], run.reference[:, axis]
    start, end = z_ref[0], z_ref[-1]
    error = np.abs(run.p - run.reference)
    whole = run.verdict.completed and end != start  # what ended early never saw where the stroke goes
    share = (z - start) / (end - start) if whole else np.full(len(z), np.nan)
    return StrokeFigures(
        rise=_reached(run.t, share, 0.9) - _reached(run.t, share, 0.1) if whole else math.nan,
        overshoot=max(float(share.max()) - 1, 0.0) if whole else math.nan,
        axial_error=float(error[:, axis].max()),
        radial={name: float(error[:, i].max()) for i, name in enumerate(names) if i != axis},
        force=float(np.abs(run.v[:, run.plant.leading_input]).max()),
        current=float(np.abs(run.current).max()),
    )


def _reached(t: FloatArray, share: FloatArray, level: float) -> float:
    k = int(np.argmax(np.asarray(share) >= level))
    if k == 0:
        return math.nan
    return float(np.interp(level, share[k - 1 : k + 1], t[k - 1 : k + 1]))


def save(run: Trajectory, path: str | Path) -> Path:
    """Write the time series as .npz: t, and a named array for every kind of signal with the names of its columns."""
    path, drive = Path(path), run.plant.windings
    axes, phases = ((), run.plant.actuator.coils) if drive is None else (drive.axes, drive.phases)
    columns = {
        "reference": run.plant.outputs,
        "p": run.plant.outputs,
        "y": run.plant.outputs,
        "x": run.plant.states,
        "xi_hat": run.controller.states,
        "v": run.plant.inputs,
        "force": run.plant.inputs,
        "saturated": run.plant.inputs,
        "current": run.plant.actuator.coils,
        "i": axes,
        "u": tuple(Signal(s.name.replace("i_", "u_"), "V") for s in axes),
        "link": (Signal("V_link", "V"),),
        "i_phase": phases,
        "duty": tuple(Signal(s.name.replace("i_", "d_"), "1") for s in phases),
    }
    arrays: dict[str, Any] = {"t": run.t, "verdict": np.array([run.verdict.name])}
    for name, signals in columns.items():
        if not getattr(run, name).shape[1]:
            continue  # not simulated at this fidelity
        arrays[name] = getattr(run, name)
        arrays[f"{name}_columns"] = np.array([f"{s.name} [{s.unit}]" for s in signals])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    replace_files({path: buffer.getvalue()})
    return path
