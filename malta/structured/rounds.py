"""A law of a given structure whose goals hold, proven over the parameters: tune, prove, add what refutes it, repeat.

1. The law is searched for all models so far, at first those at nominal parameters.
2. The margin of the loop is proven, and the peaks of |S| over the box. Where one is worse than what is asked for, its
   witness is a plant that refutes the law: it becomes a model, as far out as the margin asks.
3. This ends when the proofs hold what is asked for, or when they cannot, which the certificate says then.

What a law is tuned for: systems, an uncertain system, or a machine; its models at parameters, and what proves a law.

A machine's models for goals and for stability are its loops under load, as `malta verify` measures and proves them.
"""

from __future__ import annotations

import itertools
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError
from malta.linear.sampling import add_lags, delay_inputs, sample, split_delay
from malta.linear.system import System
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.loop import loop
from malta.loops.sampled_loops import SampledLoop, sampled_loop
from malta.loops.windings import LAST_STAGE, chosen_loops
from malta.margins.travel import travel_margin
from malta.margins.worst_case import worst_sensitivities
from malta.model.linearize import linearize
from malta.model.parameters import units_of
from malta.model.plant import Plant
from malta.processes import on_one_thread
from malta.proof.blocks.gain import Gain, worst_case_gain
from malta.proof.margin import Margin, Ranges
from malta.proof.robust import robust_margin
from malta.structured.goals import Goal
from malta.structured.loops import TunedPlant, model_of, models_of_systems
from malta.structured.search import ROOM, Look, Task, contradiction, random_starts, rate_of, search
from malta.synthesis.controller import Controller
from malta.synthesis.elements import CALLER
from malta.synthesis.state_space import controller_of
from malta.synthesis.structure import Structure, places_of, sample_law
from malta.work import is_stopped

Values = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Systems:
    """Systems of python-control, without parameters: nothing of them is proven."""

    models: tuple[TunedPlant, ...]

    @property
    def nominal(self) -> list[TunedPlant]:
        return list(self.models)


@dataclass(frozen=True, eq=False)
class UncertainModel:
    """An uncertain system, continuous, or sampled with a delay."""

    system: UncertainSystem
    sample_time: float | None
    delay: float
    lag: float | None

    @property
    def nominal(self) -> list[TunedPlant]:
        return [self.at({}, goals=True)]

    def at(self, values: Values, *, goals: bool) -> TunedPlant:
        s, T = self.system, self.sample_time
        p = np.array([values.get(n, v) for n, v in zip(s.names, s.nominal, strict=True)])
        A, B, C, D = (M[0] for M in s.explicit(p))
        if self.lag is not None:
            A, B = add_lags(A, B, self.lag)
        if T is not None and s.sample_time is None:
            A, B = sample(A, B, T, self.delay)
        elif T is not None:
            A, B = delay_inputs(A, B, self.delay)
        C = np.hstack([C, np.zeros((len(C), len(A) - C.shape[1]))])
        inputs, outputs = [f"u{k}" for k in range(B.shape[1])], [f"y{k}" for k in range(len(C))]
        return model_of(_name(values), System(A, B, C, D), inputs, outputs, sample_time=T, goals=goals)

    def compensator(self, law: System) -> Compensator:
        """The law as the proof takes it: u = F y."""
        T = self.sample_time
        F = law if T is None else sample_law(law, T)
        return Compensator(F.A, -F.B, F.C, -F.D, sample_time=T, delay=self.delay, lag=self.lag)

    def margin(self, law: System, ranges: Ranges, time: float | None) -> Margin:
        return robust_margin(self.system, self.compensator(law), ranges, time=time)

    def gains(self, law: System, goal: Goal, ranges: Ranges, time: float | None) -> dict[str, Gain]:
        assert goal.peak is not None
        c, at = self.compensator(law), goal.peak[1]
        names = self.nominal[0].outputs if at == "sensors" else self.nominal[0].inputs
        return {
            name: worst_case_gain(self.system, c, ranges, at=at, channel=k, time=time)
            for k, name in enumerate(names)
        }


@dataclass(frozen=True, eq=False)
class PlacedMachine:
    """A machine with its hold, delay, current loops and late sensors, at places along its travel."""

    plant: Plant
    sample_time: float
    places: tuple[Values, ...]
    zero: Controller = field(repr=False)  # a law that does nothing, with the machine's current loops

    @property
    def nominal(self) -> list[TunedPlant]:
        return [self.at(place, goals=True) for place in self.places]

    def at(self, values: Values, *, goals: bool) -> TunedPlant:
        known = units_of(self.plant.parameters)
        parameters = {name: v for name, v in values.items() if name in known}
        states = {name: v for name, v in values.items() if name not in known}
        if goals:
            at: dict[str, Any] = dict(states)
            found = loop(self.plant, self.zero, parameters=parameters, **at).sampled_forces
        else:
            found = self._without_loads(parameters, states)
        m, extra = len(self.plant.inputs), found.control.D_y
        into = found.Bd[:, :m]
        pushed = np.zeros((len(found.Ad), 0)) if found.pushed is None else found.pushed
        system = System(
            found.Ad + found.Bd @ extra @ found.Cd,
            np.hstack([into, pushed]), found.Cd, np.zeros((len(found.Cd), m + pushed.shape[1])),
        )  # fmt: skip
        names = [
            [s.name for s in signals]
            for signals in (self.plant.inputs, self.plant.outputs, self.plant.disturbances)
        ]
        return model_of(
            _name(values), system, names[0], names[1],
            disturbances=names[2] if pushed.shape[1] else (), sample_time=self.sample_time, goals=goals,
        )  # fmt: skip

    def _without_loads(self, parameters: Values, states: Values) -> SampledLoop:
        own: Any = self.plant.parameters
        changed = replace(own, **parameters)
        machine = self.plant.variant(changed) if parameters else self.plant
        return sampled_loop(
            linearize(machine, machine.at(**states)), self.zero,
            delay=machine.actuator.delay(self.sample_time),
            current_loops=chosen_loops(machine, self.zero, LAST_STAGE), sensors=True, forces_alone=True,
        )  # fmt: skip

    def controller(self, law: System, name: str) -> Controller:
        """The law of errors as a controller, sampled by Tustin's rule."""
        return controller_of(sample_law(law, self.sample_time), self.plant, name=name)

    def margin(self, law: System, ranges: Ranges, time: float | None) -> Margin:
        return travel_margin(self.plant, self.controller(law, "structured"), ranges, time=time)

    def gains(self, law: System, goal: Goal, ranges: Ranges, time: float | None) -> dict[str, Gain]:
        assert goal.peak is not None
        law_of = self.controller(law, "structured")
        return worst_sensitivities(self.plant, law_of, ranges, at=goal.peak[1], time=time)


def _name(values: Values) -> str:
    """Parameters in words."""
    return ", ".join(f"{name} = {value:.4g}" for name, value in values.items()) or "nominal"


def target_of(
    plant: Any, sample_time: float | None, delay: float, lag: float | None, places: Sequence[Values] | None
) -> Systems | UncertainModel | PlacedMachine:
    """What a law is tuned for. Raises InputError for anything else, and for options that it does not have."""
    if isinstance(plant, UncertainSystem):
        T = plant.sample_time if sample_time is None else sample_time
        if plant.sample_time is not None and plant.sample_time != T:
            raise InputError(CALLER, "sample_time", f"{T} s", f"{plant.sample_time} s, that of the system")
        if split_delay(delay)[1] and plant.sample_time is not None:
            raise InputError(CALLER, "delay", f"{delay:g} samples", "whole samples of a sampled system")
        if T is None and delay:
            raise InputError(CALLER, "delay", f"{delay} samples", "none without a sample time")
        return UncertainModel(plant, T, delay, lag)
    if delay or lag is not None:
        raise InputError(
            CALLER, "delay, lag", "some", "those of an uncertain system alone: other plants have their own"
        )
    if isinstance(plant, Plant):
        if sample_time is None:
            raise InputError(CALLER, "sample_time", "none", "the sample time of the machine's law, s")
        m, p = len(plant.inputs), len(plant.outputs)
        nothing = System(
            np.zeros((1, 1)), np.zeros((1, p)), np.zeros((m, 1)), np.zeros((m, p)), None, sample_time
        )
        stroke = plant.stroke
        own = (
            [{stroke.name: share * stroke.travel} for share in (0.0, 1.0, -1.0)] if plant.has_stroke else [{}]
        )
        zero = controller_of(nothing, plant, name="nothing")
        return PlacedMachine(plant, sample_time, tuple(own if places is None else places), zero)
    if sample_time is not None:
        raise InputError(
            CALLER, "sample_time", f"{sample_time} s", "none: systems of python-control have their own"
        )
    return Systems(tuple(models_of_systems(plant)))


ROUNDS = 12
PROOF_TIME = 60.0  # s, of each proof


@display
@dataclass(frozen=True, eq=False)
class Tuned:
    """A law of a given structure, with what it reaches and what is proven of it.

    values : of its parameters, by "element.parameter"
    order : states of the whole law
    law : the continuous law of the errors p* - y: A, B, C and D
    sample_time : s, at which it is sampled by Tustin's rule; None: continuous
    reached : by goal the largest figure of all models; at most 1 where the goal holds
    models : that it was tuned on, in words
    margin : proven over the ranges; None without ranges
    peaks : proven peaks of |S| by goal and channel
    asked : what was asked of the margin, in multiples of the ranges
    closed : whether the proofs hold all that was asked to be proven
    rounds : of tuning and proving
    seconds : s
    controller : of a machine, for gain files, verification, simulation and export
    against : where the proof does not close: the goals that hold each other once what refutes the law is a model

    >>> import control
    >>> from malta import structured
    >>> law = structured.gain("k", 3.0)
    >>> found = structured.tune(control.tf([1], [1, 1]), law, [], starts=1)
    >>> found.order, found.closed
    (0, False)
    >>> print(found.certificate)
    Nothing is proven: the plant has no ranges of parameters; figures are those of its models.
    """

    values: Mapping[str, float]
    order: int
    law: System
    sample_time: float | None
    reached: Mapping[str, float]
    models: tuple[str, ...]
    margin: Margin | None
    peaks: Mapping[tuple[str, str], Gain]
    asked: float | None
    closed: bool
    rounds: int
    seconds: float
    controller: Controller | None
    against: str = ""

    @property
    def sampled(self) -> System:
        """The law as it runs: s+ = A s + B e, v = C s + D e; of a continuous loop `law`."""
        return self.law if self.sample_time is None else sample_law(self.law, self.sample_time)

    @property
    def certificate(self) -> str:
        """What is proven and what is not, in one sentence each."""
        if self.margin is None:
            return (
                "Nothing is proven: the plant has no ranges of parameters; figures are those of its models."
            )
        low, but = self.margin.lower, f" ({self.margin.reason})" if self.margin.reason else ""
        found = [
            f"Proven: the loop is stable for all parameters within {self.margin.proven.percent()} of their ranges{but}."
            if low
            else f"Not proven: stability over the ranges ({self.margin.reason or 'the nominal loop is lost'})."
        ]
        if self.asked is not None and (low or 0.0) < self.asked:
            why = f" {self.against}." if self.against else ""
            found.append(f"Asked for were {100 * self.asked:.10g} %: the proof does not close.{why}")
        for (goal, channel), gain in self.peaks.items():
            if gain.upper is None:
                found.append(
                    f"Not proven: {goal} of {channel} over the ranges ({gain.reason}); "
                    f"{gain.reached.text()} is reached."
                )
            else:
                found.append(
                    f"Proven: |S| of {channel} is below {gain.proven.text()} over the ranges ({goal})."
                )
        return "\n".join(found)

    @property
    def description(self) -> Description:
        """Its parameters, goals and proofs."""
        rows = [("order", f"{self.order} states"), ("models", f"{len(self.models)}, in {self.rounds} rounds")]
        rows += [(name, f"{value:.5g}") for name, value in self.values.items()]
        rows += [(name, f"{value:.4f} of its bound") for name, value in self.reached.items()]
        rows.append(("searched in", quantity(self.seconds, "s")))
        rows += [("certificate", line) for line in self.certificate.split("\n")]
        return Description(
            "Structured law: " + ("the proof closes" if self.closed else "not proven"), tuple(rows)
        )


@on_one_thread
def tune(
    plant: Any,
    law: Any,
    goals: Sequence[Goal],
    *,
    ranges: Ranges | None = None,
    margin: float | None = None,
    over_box: bool = False,
    sample_time: float | None = None,
    delay: float = 0,
    lag: float | None = None,
    places: Sequence[Values] | None = None,
    starts: int = 3,
    seed: int = 0,
    name: str = "structured",
    keep: bool = False,
    note: Callable[[str], None] | None = None,
) -> Tuned:
    """Find the parameters of a law's elements that meet goals, and prove what they promise over ranges of parameters.

    plant : a control system, or several that one law shall hold; an uncertain system, from `malta.uncertain`; a Plant
    law : elements by the outputs whose errors they take, for the input of the same index; one element from all errors
        to all inputs; or places (left, element, right), as for the coordinates of a centre of gravity
    goals : of malta.structured; hard ones hold, the largest soft one is made small
    ranges : of parameters, as in `malta.robust_margin`, over which stability is proven, and worst ones are searched
    margin : multiples of the ranges within which the loop is proven stable; None: 1
    over_box : whether goals hold for the worst plants within the ranges, not at nominal parameters alone; peaks of |S|
        are proven over them
    sample_time : s, of the law, for an uncertain system that is continuous and for a machine
    delay, lag : of an uncertain system, as in malta.proof.Compensator
    places : of a machine: states at which goals hold; None: the middle and the ends of its travel
    starts : of the search, the first from the elements' own values
    seed : of the further ones
    name : of the controller
    keep : whether first values that hold all hard goals, with the proofs, stand as they are
    note : called with what is being done

    Returns a Tuned. Its `closed` and its `certificate` say whether the proofs hold what was asked for.

    Raises InputError for elements that do not fit, and for a structure that was not found to stabilize the models.
    Raises CheckError where no law was found that meets all hard goals, with two that conflict.

    Source: Apkarian and Noll, Nonsmooth H-infinity synthesis, IEEE TAC 51 (2006), for the kind of the search; the
    proofs are those of malta.proof.

    >>> import malta
    >>> from malta import structured
    >>> def body(m):
    ...     return [[0, 1], [0, 0]], [[0], [1 / m]], [[1, 0]]
    >>> mass = malta.uncertain(body, {"m": 1.0})
    >>> law = structured.pid("axis", Kp=50.0, Kd=10.0, filter=0.01)
    >>> goals = [structured.sensitivity(1.5)]
    >>> found = structured.tune(mass, law, goals, ranges={"m": 0.2}, margin=2.0)
    >>> found.closed, found.margin.lower >= 2
    (True, True)
    """
    begun = clock.monotonic()
    if ranges is None and (margin is not None or over_box):
        raise InputError(
            CALLER, "ranges", "none beside a margin or over_box", "ranges of parameters to prove it over"
        )
    target = target_of(plant, sample_time, delay, lag, places)
    models = target.nominal
    first = models[0]
    structure = Structure(places_of(law, first.inputs, first.outputs))
    task = Task(structure, tuple(goals), tuple(models), rate_of(first))
    begin, wanted = random_starts(structure, starts, seed), 1.0 if margin is None else margin
    if isinstance(target, Systems):
        if ranges is not None:
            raise InputError(
                CALLER, "ranges", "ranges", "none for systems of python-control: malta.uncertain has some"
            )
        look, proof, rounds = _search(task, begin), LawProof(None, {}, closed=False), 1
    else:
        asked = _Asked(target, tuple(goals), ranges, wanted, over_box)
        held = _try_start(asked, task) if keep else None
        task, look, proof, rounds = _rounds(asked, task, begin, note) if held is None else held
    found = structure.at(look.x)
    values = {key: value for e in found.elements for key, value in e.values.items()}
    system = structure.system(look.x)
    controller = target.controller(system, name) if isinstance(target, PlacedMachine) else None
    return Tuned(
        values, structure.order, system, first.sample_time, _figures(look, goals), tuple(m.name for m in task.models),
        proof.margin, proof.peaks, None if ranges is None else wanted, proof.closed,
        rounds, clock.monotonic() - begun, controller, proof.against,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class LawProof:
    """The proofs of a law, and the models that refute it."""

    margin: Margin | None
    peaks: Mapping[tuple[str, str], Gain]
    closed: bool
    refuting: tuple[TunedPlant, ...] = ()
    against: str = ""


@dataclass(frozen=True, eq=False)
class _Asked:
    """What shall be proven."""

    target: UncertainModel | PlacedMachine
    goals: tuple[Goal, ...]
    ranges: Ranges | None
    margin: float
    over_box: bool

    def prove(self, law: System) -> LawProof:
        """Prove a law."""
        if self.ranges is None:
            return LawProof(None, {}, closed=False)
        found = self.target.margin(law, self.ranges, PROOF_TIME)
        holds = found.lower is not None and found.lower >= self.margin
        refuting = []
        if not holds and found.witness is not None and found.upper < self.margin * (1 + ROOM):
            refuting.append(self.target.at(self._far(found), goals=False))
        peaks: dict[tuple[str, str], Gain] = {}
        stable = found.lower is not None and found.lower >= 1
        for goal in self.goals if self.over_box and stable else ():
            if goal.peak is None:
                continue
            for channel, gain in self.target.gains(law, goal, self.ranges, PROOF_TIME).items():
                peaks[goal.name, channel] = gain
                if gain.upper is None or gain.upper > goal.peak[0]:
                    holds = holds and not goal.hard
                    if gain.lower > goal.peak[0] * (1 - ROOM):
                        refuting.append(self.target.at(gain.witness, goals=True))
        return LawProof(
            found, peaks, closed=holds and (stable or not self.over_box), refuting=tuple(refuting)
        )

    def _far(self, margin: Margin) -> dict[str, float]:
        """The witness of a margin, as far out as is asked for."""
        assert margin.witness is not None
        further = self.margin * (1 + ROOM) / margin.upper
        nominal = {name: margin.witness[name] - moved for name, moved in margin.moved.items()}
        return {name: nominal.get(name, 0.0) + further * margin.moved[name] if name in (self.ranges or {}) else value
                for name, value in margin.witness.items()}  # fmt: skip


def _search(task: Task, starts: Sequence[Any]) -> Look:
    """The best law by then. Raises CheckError where it breaks hard goals after a whole search."""
    look = search(task, starts)
    both = contradiction(look) if look.hard > 1 + ROOM and not is_stopped() else None
    if both is not None:
        one, other = both
        against = f"{one} against {other}" if one != other else one
        raise CheckError(f"{CALLER}: no law of this structure was found that meets the hard goals: {against}")
    return look


def _try_start(asked: _Asked, task: Task) -> tuple[Task, Look, LawProof, int] | None:
    """The first values, where they hold all hard goals and the proof closes, or there was no time for it."""
    look = task.look(np.zeros(len(task.structure.parameters)))
    if look is None or look.hard > 1 + ROOM:
        return None
    proof = asked.prove(task.structure.system(look.x))
    return (task, look, proof, 0) if proof.closed or asked.ranges is None or is_stopped() else None


def _rounds(
    asked: _Asked, task: Task, starts: Sequence[Any], note: Callable[[str], None] | None
) -> tuple[Task, Look, LawProof, int]:
    """Tune and prove until the proof closes, or cannot: then the last law that meets the goals stands."""
    say = note or (lambda _: None)
    say("tuning")
    look = _search(task, starts)
    for count in itertools.count(1):
        say(f"round {count}: proof")
        proof = asked.prove(task.structure.system(look.x))
        known = {(model.name, model.goals) for model in task.models}
        new = tuple(m for m in proof.refuting if (m.name, m.goals) not in known)
        if proof.closed or not new or count == ROUNDS or is_stopped():
            break
        more = replace(task, models=(*task.models, *new))
        say(f"round {count + 1}: tuning on {len(more.models)} models")
        try:
            look = _search(more, [look.x])
        except (CheckError, InputError):
            try:
                look = _search(more, [look.x, *starts])
            except (CheckError, InputError) as error:
                words = str(error).rpartition("structured: ")[2]
                proof = replace(proof, against=words[0].upper() + words[1:])
                break
        task = more
    return task, look, proof, count


def _figures(look: Look, goals: Sequence[Goal]) -> dict[str, float]:
    """The largest figure of each goal, without the room of hard ones."""
    found = {}
    for goal in goals:
        own = [f.value for f in look.figures if f.key[1] == goal.name]
        found[goal.name] = max(own, default=0.0) / (1 + ROOM if goal.hard else 1.0)
    return found
