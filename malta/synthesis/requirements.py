"""Requirements: what a design can be asked to reach in [specification], and how each one is judged.

A requirement is one record: its key in the file, its unit, the side that it bounds from, how it is measured on a
finished design, and how a search estimates it in milliseconds. GENERIC_REQUIREMENTS holds what every machine can be
asked for. A machine's own stand as REQUIREMENTS in the module `requirements` of its folder, and replace generic ones
of their name:

    def _carried(design, asked, signal):
        e = design.fly("payload", masses=(asked,))
        return [Figure(asked if e.cases[0].run.verdict.completed else 0.0, "hold and stroke")]

    REQUIREMENTS = (Requirement("payload", _carried, "kg", at_least=True),)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from malta.arrays import ComplexArray, FloatArray
from malta.model.parts import attribute_of
from malta.model.plant import Parameters, Plant, Signal
from malta.model.vibration import CLEARANCE_PRESETS, vibration_preset
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.synthesis.filters import Linear
    from malta.synthesis.recovery import RecoveryBound
    from malta.synthesis.spec import Law, Spec
    from malta.synthesis.step_response import StepResponse

Trade = Literal["force", "motion"]
Form = Literal["number", "switch", "outputs", "inputs", "disturbances", "loads"]
Verdict = Literal["holds", "fails", "undecided"]
# Keys of [specification] that bound loads of any waveform, with the preset of vibration that says what they may use.
CLEARANCES_OF = {"never_touches": "", **{f"within_{name}": name for name in CLEARANCE_PRESETS}}
Indices = Callable[[Plant], Sequence[int]]  # of some of a plant's outputs, or inputs
SEEDS = (4, 8, 16, 32)  # numbers of seeds after which a simulated figure is compared with its bound


class Figure(NamedTuple):
    """What a design has, in SI units, and the words that say where the number comes from."""

    value: float
    source: str
    interval: tuple[float, float] | None = None  # CONFIDENCE of the value, where it is a mean over seeds


class NoiseRms(NamedTuple):
    """Rms by output and by input: what the sensors' noise and steps leave in both."""

    motion: FloatArray  # p, of the true outputs, m or rad
    force: FloatArray  # m, of the commands, N or N m


class Design(Protocol):
    """A synthesized design, as a requirement measures it. What takes long is computed once, when first asked for."""

    @property
    def spec(self) -> Spec:
        """The design as its file holds it."""

    @property
    def plant(self) -> Plant:
        """The machine that the controller is designed for."""

    @property
    def controller(self) -> Controller:
        """What a machine would run."""

    @property
    def margins(self) -> Any:
        """margins.verify.Margins, with the proven robust margin where one is asked for."""

    @property
    def bandwidth(self) -> Figure:
        """The smallest by the definitions of margins.verify, rad/s, and which one it is."""

    @property
    def noise(self) -> NoiseRms:
        """By the covariance of the machine's linear loop, each reading's step q as noise of variance q^2 / 12."""

    @property
    def load_figures(self) -> Mapping[str, float]:
        """Of a PID under the loads of [cost]: "load_error x", "noise_motion x"."""

    def __hash__(self) -> int:
        """By identity, so that a machine's requirements may share what they compute."""

    def deviation(self, bound: RecoveryBound) -> Figure:
        """Under a constant load from outside, of the machine's linear loop: what the bound is of."""

    def largest_load(self, disturbance: str, limit: float) -> Figure:
        """The largest load of any waveform that uses no more than a share of a clearance: of the linear loop."""

    def fly(self, name: str, **options: Any) -> Any:
        """Run an experiment of the machine by name: simulation.experiments.Experiment."""

    def simulate(self, parameters: Parameters, scenario: Any) -> Any:
        """Run a scenario on a machine with other parameters: simulation.trajectory.Trajectory."""


@dataclass(frozen=True, eq=False)
class TrialFigures:
    """What a trial of the search has computed of its loop: of outputs and inputs that nothing joins to the others."""

    plant: Plant
    outputs: tuple[int, ...]  # p of the plant's
    inputs: tuple[int, ...]  # m of the plant's
    model: Linear  # continuous, n states
    noise: NoiseRms  # p motions and m forces
    margin: float | None  # None: not asked for
    peak_sensitivity: float
    bandwidth: float  # rad/s
    # Of a unit load on each of the plant's disturbances, at positions of the stroke, m, the operating point first.
    answers: tuple[tuple[float, StepResponse], ...]
    recovery: Mapping[str, RecoveryBound]  # what is asked of them
    # of w (rad/s), p and x: the true outputs, p complex amplitudes, while the reference is p exp(jwt) and the states
    # that go with it are x exp(jwt)
    follow: Callable[[float, FloatArray, ComplexArray], ComplexArray]
    # of any waveform of a disturbance: the size that uses no more than a share of the clearance of any contact which
    # these states move; None: none is moved
    largest_load: Callable[[str, float], float | None]


Measure = Callable[[Design, float, str], Sequence[Figure]]  # of a bound that is asked for, of a signal or ""
Estimate = Callable[[TrialFigures, str], float | None]  # None: the trial has no such figure


@dataclass(frozen=True, eq=False)
class Requirement:
    """A key of [specification].

    name : as it stands in the file
    measure : (design, bound, signal) -> figures, each of which is judged; signal is "" unless `form` is of signals.
        One quantity has one figure: of a linear loop by its covariance, of noisy flights by `mean_over_seeds`
    unit : SI; of a requirement by signal each signal's own
    at_least : bounds from below; otherwise from above
    laws : the kinds of controllers that can be asked for it
    form : what the file holds: a number with its unit, true, a table of signals, or of loads (recovery.py)
    above : numbers without a unit must be larger
    estimate : (loop, signal) -> figure of a trial; None: the search does not look at it
    needs_stability : an unstable loop has no such figure, and fails
    flown : measured on flights of the simulated machine, not on its linear loop
    trade : what the Pareto front shows it as, against the margin: noise of the force, or motion
    heading : its words in the Pareto front, without "motion"; none: not shown, or by the signal's name
    meaning : what is bounded, in words, for schemas and pages
    indices : of the inputs (force) or outputs (motion) whose noise at rest it bounds; None: it bounds no such noise
    error_of : outputs whose errors in the main job it is about, beside whose curves its bound is drawn
    """

    name: str
    measure: Measure
    unit: str = "1"
    at_least: bool = False
    laws: tuple[Law, ...] = ("LQG",)
    form: Form = "number"
    above: float = 0.0
    estimate: Estimate | None = None
    needs_stability: bool = True
    flown: bool = False
    trade: Trade | None = None
    heading: str = ""
    meaning: str = ""
    indices: Indices | None = None
    error_of: tuple[str, ...] = ()

    def suits(self, law: Law) -> bool:
        """Whether a kind of law can be asked for it: one of a given structure for what all others can be."""
        return law in self.laws or (law == "structure" and {"LQG", "PID"} <= {*self.laws})

    def signals(self, plant: Plant) -> tuple[Signal, ...]:
        """Return the signals that can be bounded one by one; none for one bound of the whole machine."""
        tables = {name: tuple(getattr(plant, name)) for name in ("outputs", "inputs", "disturbances")}
        return tables.get(self.form, ())

    def unit_of(self, spec: Spec, signal: str) -> str:
        """Return the SI unit of a bound: that of its signal, of its load's outputs, or the requirement's own."""
        if self.form == "loads":
            return spec.recovery[signal].unit
        return next((s.unit for s in self.signals(spec.plant) if s.name == signal), self.unit)


def requirements_for(plant: Plant) -> dict[str, Requirement]:
    """List what a machine's designs can be asked for, by name: generic requirements, then the machine's own."""
    mine: Sequence[Requirement] = attribute_of(plant, "requirements", "REQUIREMENTS", ())
    names = {r.name for r in mine}
    return {r.name: r for r in (*(g for g in GENERIC_REQUIREMENTS if g.name not in names), *mine)}


def ratio_of(asked: float, found: float, *, at_least: bool) -> float:
    """Return how near a figure is to its bound: at most 1 where the bound holds, infinite for no number."""
    if not math.isfinite(found):
        return math.inf
    if at_least:
        return asked / found if found > 0 else math.inf
    return found / asked


def judge_figure(figure: Figure, asked: float | None, *, at_least: bool) -> Verdict:
    """Compare a figure with its bound: "undecided" where its interval holds values on both sides of the bound.

    asked : the bound; None: as little as the others leave, which holds

    >>> judge_figure(Figure(1.0, "mean", (0.9, 1.1)), 1.05, at_least=False)
    'undecided'
    """
    bound = math.inf if asked is None else asked
    ends = figure.interval or (figure.value, figure.value)
    within = [ratio_of(bound, end, at_least=at_least) <= 1 for end in ends]
    return "holds" if all(within) else "undecided" if any(within) else "fails"


def noise_at_rest(
    name: str, kind: Trade, chosen: Callable[[Plant, str], Sequence[int]], **fields: Any
) -> Requirement:
    """A bound of motion or force, of the worst of those that are chosen by plant and signal: by the covariance."""

    def measure(design: Design, _asked: float, signal: str) -> list[Figure]:
        noise = getattr(design.noise, kind)[list(chosen(design.plant, signal))]
        return [Figure(float(noise.max()), "covariance")]

    def estimate(trial: TrialFigures, signal: str) -> float | None:
        own = chosen(trial.plant, signal)
        places = trial.outputs if kind == "motion" else trial.inputs
        noise = zip(places, getattr(trial.noise, kind), strict=True)
        return max((float(value) for k, value in noise if k in own), default=None)

    return Requirement(name, measure, laws=("LQG", "PID"), estimate=estimate, trade=kind, **fields)


# --- the requirements of every machine ---


def proven_margin(margin: Any) -> Figure:
    """The figure of margins.robust.Margin by which a requirement is judged: what is proven, 0 where nothing is."""
    return Figure((margin and margin.lower) or 0.0, "proven over the travel")


def _peak_sensitivity(design: Design, _asked: float, _signal: str) -> list[Figure]:
    peaks = design.margins.peak_sensitivity
    worst = max(peaks[s.name] for s in design.controller.measurements)
    return [Figure(worst, "worst sensor, machine")]


def _recovery_estimate(trial: TrialFigures, signal: str) -> float | None:
    """The deviation of the loop's own outputs; at the ends of the travel where it is asked for anywhere."""
    bound = trial.recovery[signal]
    names = [trial.plant.outputs[k].name for k in trial.outputs]
    chosen = [k for k, name in enumerate(names) if name in bound.outputs]
    places = trial.answers if bound.anywhere else trial.answers[:1]
    answers = [one.of(bound.load_at(position)) for position, one in places]
    if not chosen or not any(one.y.any() for one in answers):
        return None
    reached = [one.largest if bound.after is None else one.left(bound.after) for one in answers]
    return max(float(deviation[chosen].max()) for deviation in reached)


def _index(signals: Sequence[Signal], name: str) -> list[int]:
    return [k for k, s in enumerate(signals) if s.name == name]


def _bounded_clearance(key: str, preset: str) -> Requirement:
    """A bound of loads of any waveform that use no more of a clearance than a preset allows; "": touch nothing."""

    def share() -> float:
        return vibration_preset(preset).clearance if preset else 1.0

    words = f"keeps clearances within {preset}" if preset else "no contact is touched by"
    return Requirement(
        key,
        lambda design, _asked, signal: [design.largest_load(signal, share())],
        at_least=True,
        laws=("LQG", "PID"),
        form="disturbances",
        estimate=lambda trial, signal: trial.largest_load(signal, share()),
        meaning=f"load of any waveform that {words}, of the linear loop, at least",
    )


GENERIC_REQUIREMENTS = (
    Requirement(
        "noise_motion",
        lambda design, _asked, signal: [
            Figure(design.load_figures.get(f"noise_motion {signal}", math.inf), "covariance")
        ],
        laws=("PID",),
        form="outputs",
        meaning="motion of outputs, rms, from the noise of [cost]",
    ),
    Requirement(
        "margin",
        lambda design, _asked, _signal: [proven_margin(design.margins.robust)],
        at_least=True,
        laws=("LQG", "PID"),
        estimate=lambda trial, _: trial.margin,
        needs_stability=False,
        meaning="proven margin in multiples of the box of uncertainty, anywhere in the travel, at least",
    ),
    Requirement(
        "peak_sensitivity",
        _peak_sensitivity,
        laws=("LQG", "PID"),
        above=1.0,
        estimate=lambda trial, _: trial.peak_sensitivity,
        needs_stability=False,
        heading="peak S",
        meaning="largest |S| of every sensor, on the machine",
    ),
    Requirement(
        "bandwidth",
        lambda design, _asked, _signal: [design.bandwidth],
        "rad/s",
        at_least=True,
        laws=("LQG", "PID"),
        estimate=lambda trial, _: trial.bandwidth,
        needs_stability=False,
        heading="bandwidth",
        meaning="bandwidth by every definition of `malta verify`, at least",
    ),
    Requirement(
        "recovery",
        lambda design, _asked, signal: [design.deviation(design.spec.recovery[signal])],
        laws=("LQG", "PID"),
        form="loads",
        estimate=_recovery_estimate,
        meaning="what a constant load from outside does, by the name of a load",
    ),
    *(_bounded_clearance(key, preset) for key, preset in CLEARANCES_OF.items()),
    noise_at_rest(
        "motion",
        "motion",
        lambda plant, signal: _index(plant.outputs, signal),
        form="outputs",
        meaning="motion of outputs at rest, rms, from the sensors' noise and steps",
    ),
    noise_at_rest(
        "force_noise",
        "force",
        lambda plant, signal: _index(plant.inputs, signal),
        form="inputs",
        meaning="noise of commanded inputs at rest, rms",
    ),
)


class Payload(NamedTuple):
    """How much a machine carries beside its mover, kg."""

    held: float  # by the forces at rest; inf: its weight loads no input
    carried: float  # the largest that was flown; NaN: the machine has no experiment of it
    dropped: float  # the smallest that was dropped; inf: none


def base_of(figure: str) -> str:
    """Return the requirement that a figure belongs to: "noise_motion" of "noise_motion x"."""
    return figure.partition(" ")[0]
