"""Scenarios: the reference, the duration, and everything that disturbs the machine on the way."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from malta.arrays import FloatArray
from malta.display import display
from malta.errors import InputError
from malta.linear.sampling import split_delay, stored_blocks
from malta.model.parameters import replace_fields, units_of
from malta.model.plant import Plant
from malta.model.sensors import require_short, split_dead_time
from malta.simulation import references
from malta.simulation.layout import FIDELITIES, Fidelity, Setup, fidelities
from malta.simulation.references import Profile, Reference
from malta.synthesis.controller import Controller

Estimator = Literal["steady-state", "kalman", "extended"]
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
FeedforwardChoice = Literal["own", "axial", "attraction"]
FEEDFORWARDS: tuple[FeedforwardChoice, ...] = get_args(FeedforwardChoice)
MOST_SUBSTEPS = 10_000  # in a sample: long before, rounding is larger than the error of the steps
BearingAxes = Literal["fixed", "turning"]
FaultKind = Literal[
    "lost sample", "stuck sensor", "biased sensor", "noisy sensor", "open phase", "link sag", "missed step"
]


class Correction(NamedTuple):
    """An outer loop, slower than the controller, that moves its reference.

    update : (t, true outputs) -> offset of the reference p* until the next update
    """

    every: float  # s
    update: Callable[[float, FloatArray], FloatArray]


class Fault(NamedTuple):
    """A fault of the machine or its electronics during a run.

    kind : "lost sample", "stuck sensor", "biased sensor", "noisy sensor", "open phase", "link sag" or "missed step"
    at : s, its begin
    until : s, its end
    what : name of the output whose sensor fails, or of the phase
    size : bias (the output's unit), factor of the noise, or missing share of the link voltage

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> stuck = malta.simulation.Fault("stuck sensor", at=1e-3, until=2e-3, what="x1")
    >>> hold = malta.Scenario("hold", 5e-3, malta.references.hold, faults=(stuck,))
    >>> plant = malta.plant_of(controller.parameters)
    >>> malta.simulate(plant, controller, hold).verdict.name
    'completed'
    """

    kind: FaultKind
    at: float
    until: float = math.inf
    what: str = ""
    size: float = 0.0


@display
@dataclass(frozen=True, eq=False)
class Scenario:
    """A reference for a machine, with start, disturbances, noise, faults and the fidelity of the simulation.

    name : of the scenario, for figures and errors
    duration : s
    reference : plant -> reference, as `malta.references.hold`
    settle : s at rest on the reference's first outputs before it begins. t = 0 is its beginning: duration, figures and
        time series are from there on. Only a run that ends earlier has times below 0, and its samples up to there.
    start : states (SI) that do not start on the reference
    cold : starts without current, with the observer at zero
    disturbance : t (s, shape (k,)) -> wrench, k x disturbances, N and N m; None: none
    anticipated : likewise: what the controller knows of the disturbance in advance
    excitation : t (s, shape (k,)) -> forces beside the law's, k x inputs, N; the filter knows them as sent. None: none
    noise : standard deviation of the sensors in multiples of the plant's
    quantize : sensors with the plant's resolution
    sensor_errors : errors by name, SI; those that are left out are 0; None: y = p exactly
    seed : of the noise
    run : index in a campaign: the noise depends on seed and run only. Several: equal parts of the time have theirs.
    delay : samples between measurement and force, also a fraction; None: the machine's own
    substeps : Runge-Kutta steps in a sample, at least 2 where commands begin in it; None: as many as `accuracy` needs
    accuracy : wanted integration error, SI, of `malta.simulation.choose_steps`; None: 1e-9 m or rad, or what is reached
    fidelity : how forces arise: "force" (at once), "dq" (current loops in axes) or "phase" (duty cycles of the phases)
    real_pwm : duty cycles with a resolution, dead time (fidelity phase)
    bearing_axes : of the current controllers: "fixed", or "turning" with the mover
    bearing : touchdown bearings push back; without them a touchdown ends the run
    estimator : "steady-state", "kalman" or "extended"
    feedforward : "own" (the controller's), "axial" or "attraction"
    scheduled : the steady-state filter uses C at the measured z
    faults : of the machine and its electronics
    correction : an outer loop that moves the reference; None: none
    open_loop : no feedback: feedforward alone, commutated for the reference
    electronics : options of the machine's own electronics (fidelity phase)
    changes : times (s), and parameters of the machine (SI) from then on

    Raises InputError for values out of range or unknown words.

    >>> import malta
    >>> off = {"x": 50e-6}  # m
    >>> hold = malta.Scenario("hold", 0.02, malta.references.hold, off, fidelity="force")
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> run = malta.simulate(malta.plant_of(controller.parameters), controller, hold)
    >>> f"x1 from {1e6 * run.p[0, 0]:.0f} um to {1e6 * run.p[-1, 0]:.1f} um"
    'x1 from 50 um to -7.1 um'
    """

    name: str
    duration: float
    reference: Callable[[Plant], Reference]
    start: Mapping[str, float] = field(default_factory=dict)
    cold: bool = False
    disturbance: Callable[[FloatArray], FloatArray] | None = None
    anticipated: Callable[[FloatArray], FloatArray] | None = None
    excitation: Callable[[FloatArray], FloatArray] | None = None
    noise: float = 0.0
    quantize: bool = False
    sensor_errors: Mapping[str, float] | None = None
    seed: int = 0
    run: int | tuple[int, ...] = 0
    delay: float | None = None
    substeps: int | None = None
    accuracy: float | None = None
    fidelity: Fidelity = "dq"
    real_pwm: bool = False
    bearing_axes: BearingAxes = "fixed"
    bearing: bool = False
    estimator: Estimator = "steady-state"
    feedforward: FeedforwardChoice = "own"
    scheduled: bool = False
    faults: tuple[Fault, ...] = ()
    correction: Correction | None = None
    open_loop: bool = False
    electronics: Any = None
    changes: tuple[tuple[float, Mapping[str, float]], ...] = ()
    settle: float = 0.0

    def replace(self, **fields: Any) -> Scenario:
        """Return the scenario with other fields.

        fields : of this record, by name

        Raises InputError for an unknown field, and as Scenario does.

        >>> import malta
        >>> malta.Scenario.stroke(10e-3).replace(noise=1.0, seed=3).seed
        3
        """
        return replace_fields(self, self.where, fields)

    @property
    def where(self) -> str:
        """The scenario, as errors name it."""
        return f"scenario {self.name}"

    def __post_init__(self) -> None:
        where = self.where
        for name, low, whole in (
            ("duration", 1e-12, False),
            ("settle", 0, False),
            ("noise", 0, False),
            ("substeps", 1, True),
            ("accuracy", 1e-300, False),
            ("delay", 0, False),
            ("seed", 0, True),
            ("run", 0, True),
        ):
            value = getattr(self, name)
            value = min(value, default=-1) if isinstance(value, tuple) else value
            if whole and value is not None and not isinstance(value, int):
                raise InputError(where, name, repr(value), "a whole number")
            if value is not None and not isinstance(value, float | int | np.number):
                raise InputError(where, name, repr(value), "a number")
            if value is not None and not (math.isfinite(value) and value >= low):
                raise InputError(where, name, str(value), "a number above 0" if low else "0 or more")
        if self.substeps is not None and self.substeps > MOST_SUBSTEPS:
            raise InputError(where, "substeps", str(self.substeps), f"at most {MOST_SUBSTEPS}")
        if self.substeps is not None and self.accuracy is not None:
            raise InputError(where, "accuracy", "one beside substeps", "one of the two")
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

    def settling_samples(self, sample_time: float) -> int:
        """Samples before t = 0: an even number, as noise is drawn for two samples at once.

        sample_time : of the controller, s
        """
        return 2 * round(self.settle / (2 * sample_time))

    def samples(self, sample_time: float) -> int:
        """All samples that are simulated, those before t = 0 among them.

        sample_time : of the controller, s
        """
        return self.settling_samples(sample_time) + max(1, round(self.duration / sample_time))

    @classmethod
    def stroke(
        cls,
        distance: float = 10e-3,
        *,
        rise: float | None = None,
        profile: Profile = "logistic",
        duration: float | None = None,
        settle: float = 0.0,
        **options: Any,
    ) -> Scenario:
        """A stroke, symmetric about the middle.

        distance : m, either sign
        rise : s, 10-90 %; None: the machine's own, RISE of its experiments
        profile : "logistic" or "quintic"
        duration : s; None: six times the rise, at least 0.1 s, so that the move fits
        settle : s at rest before, in which errors of v0 and integrals settle, as on a bench
        options : fields of the scenario, as noise=1.0

        Raises InputError for a distance of 0 m, or a rise that no stroke may have.

        >>> import malta
        >>> stroke = malta.Scenario.stroke(20e-3, rise=30e-3, noise=1.0, settle=0.3)
        >>> stroke.duration, stroke.samples(5e-5), stroke.settling_samples(5e-5)
        (0.18, 9600, 6000)
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
        return cls("stroke", duration, reference, settle=settle, **options)

    @classmethod
    def excited(
        cls, excitation: Callable[[FloatArray], FloatArray], duration: float, **options: Any
    ) -> Scenario:
        """The machine held at its place while forces excite it, with sensors as built: a run for identification.

        excitation : t (s, shape (k,)) -> forces beside the law's, k x inputs, N, as a `malta.simulation.Multisine`
        duration : s
        options : fields of the scenario, as reference=..., seed=1; noise is 1.0 and quantize True unless they differ

        Raises InputError as Scenario does.

        >>> import malta
        >>> controller = malta.gains.read("design/gains/robust.json")
        >>> plant = malta.plant_of(controller.parameters)
        >>> plan = malta.excite(malta.loop(plant, controller), force=0.5, period=0.5)
        >>> scenario = malta.Scenario.excited(plan.signal, 0.1)
        >>> malta.simulate(plant, controller, scenario).verdict.name
        'completed'
        """
        given: dict[str, Any] = {"reference": references.hold, "noise": 1.0, "quantize": True}
        return cls("excited", duration, excitation=excitation, **given | options)


class Simulation(NamedTuple):
    """A scenario on a machine under its controller, and the setup that follows from the three."""

    plant: Plant
    controller: Controller
    scenario: Scenario
    setup: Setup


def simulation_of(plant: Plant, controller: Controller, scenario: Scenario) -> Simulation:
    """The record of a simulation. Raises InputError as `setup_of` does."""
    return Simulation(plant, controller, scenario, setup_of(plant, controller, scenario))


def setup_of(plant: Plant, c: Controller, s: Scenario) -> Setup:
    """The setup of a scenario: the part of it that decides which functions are simulated.

    Raises InputError for a fidelity, faults or options that the machine does not have.
    """
    kinds = {fault.kind for fault in s.faults}
    if "open phase" in kinds and s.fidelity != "phase":
        found = f"an open phase at fidelity {s.fidelity}"
        raise InputError(s.where, "faults", found, "fidelity phase")
    able = fidelities(plant)
    if s.fidelity not in able:
        expected = "one of " + ", ".join(able) + f" for a {plant.name}"
        raise InputError(s.where, "fidelity", s.fidelity, expected)
    own = plant.actuator.electronics is not None and s.fidelity == "phase"
    if s.electronics is not None and not own:
        found = f"options of electronics at fidelity {s.fidelity}"
        raise InputError(s.where, "electronics", found, "a machine that has some, at phase")
    if own and s.estimator != "steady-state":
        found = f"{s.estimator} with electronics of their own pace"
        raise InputError(s.where, "estimator", found, "steady-state, or fidelity force")
    if own and (s.real_pwm or s.bearing_axes == "turning" or "open phase" in kinds or "link sag" in kinds):
        raise InputError(s.where, "fidelity", "options of a drive", "those of the electronics")
    if s.anticipated is not None and s.estimator != "steady-state":
        raise InputError(s.where, "anticipated", f"estimator {s.estimator}", "steady-state")
    if s.scheduled and c.tracks == "errors":
        raise InputError(s.where, "scheduled", "a law of errors", "one with a filter of states")
    if c.schedule is not None and (s.scheduled or s.estimator != "steady-state"):
        field, found = ("scheduled", "C of the reading") if s.scheduled else ("estimator", s.estimator)
        expected = "the filter of the gain file, beside a law that is scheduled"
        raise InputError(s.where, field, found, expected)
    known = [signal.name for signal in plant.sensors.errors]
    for name, value in (s.sensor_errors or {}).items():
        if name not in known:
            where = s.where
            raise InputError(where, f"sensor_errors.{name}", "an unknown error", "one of " + " ".join(known))
        if not math.isfinite(value):
            raise InputError(s.where, f"sensor_errors.{name}", repr(value), "a finite number")
    driven, machines = s.fidelity != "force" and not own, machines_of(plant, s)
    dead_time = plant.sensors.dead_time
    if dead_time and own:
        found = "sensors with a dead time beside electronics of their own pace"
        raise InputError(s.where, "fidelity", found, "force, or sensors without dead time")
    late = split_dead_time(dead_time, c.sample_time)[0] if dead_time else None
    delay = delay_of(plant, c, s)
    if own and split_delay(delay)[1]:
        found = f"{delay:g} samples of delay beside electronics of their own pace"
        raise InputError(s.where, "fidelity", found, "force, or whole samples of dead time")
    return Setup(
        fidelity=s.fidelity,
        delay=stored_blocks(delay),
        fraction=split_delay(delay)[1],
        quantize=s.quantize,
        disturbed=s.disturbance is not None,
        bearing=s.bearing,
        sensed=s.sensor_errors is not None,
        faulty=bool(kinds - {"biased sensor", "noisy sensor"}),
        scheduled=s.scheduled,
        real_pwm=s.real_pwm,
        turning=s.bearing_axes == "turning" and s.fidelity != "force",
        outside=s.estimator != "steady-state",
        anticipated=s.anticipated is not None,
        open_loop=s.open_loop,
        lagging=any(machine.sensors.lagging for machine in machines),
        late=late,
        current_sensors=driven and any(machine.drive.sensors is not None for machine in machines),
        electronics=s.electronics,
    )


def delay_of(plant: Plant, c: Controller, s: Scenario) -> float:
    """Samples between measurement and force. Raises InputError for more than MOST_DELAY."""
    delay = plant.actuator.delay(c.sample_time) if s.delay is None else s.delay
    return require_short(s.where, "delay", delay)


def machines_of(plant: Plant, s: Scenario) -> list[Plant]:
    """The machine before and after every change of its parameters in a scenario."""
    machines = [plant]
    for _, values in sorted(s.changes, key=lambda change: change[0]):
        known = {name: value for name, value in values.items() if name in units_of(plant.parameters)}
        par: Any = replace(machines[-1].parameters, **known)
        machines.append(plant.variant(par))
    return machines
