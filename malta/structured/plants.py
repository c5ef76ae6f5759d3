"""What a law is tuned for: systems, an uncertain system, or a machine; its models at parameters, and what proves a law.

A machine's models for goals are its loops under load, as `malta verify` measures them; those for stability are the
loops without loads that the proof of the margin is of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.loops.loop import loop
from malta.loops.sampled_loops import LAST, SampledLoop, sampled_loop
from malta.margins.travel import travel_margin, worst_sensitivities
from malta.model.linearize import linearize
from malta.model.parameters import units_of
from malta.model.plant import Plant
from malta.proof.blocks.gain import Gain, worst_case_gain
from malta.proof.margin import Margin, Ranges
from malta.proof.robust import robust_margin
from malta.proof.uncertain import Compensator, UncertainSystem
from malta.proof.windings import chosen_loops
from malta.structured.goals import Goal
from malta.structured.loops import Model, model_of, models_of_systems
from malta.synthesis.elements import CALLER
from malta.synthesis.riccati import add_lags, delay_inputs, sample
from malta.synthesis.state_space import System, controller_of
from malta.synthesis.structure import sample_law

if TYPE_CHECKING:
    from malta.synthesis.controller import Controller

Values = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Systems:
    """Systems of python-control, without parameters: nothing of them is proven."""

    models: tuple[Model, ...]

    @property
    def nominal(self) -> list[Model]:
        return list(self.models)


@dataclass(frozen=True, eq=False)
class Uncertain:
    """An uncertain system, continuous, or sampled with a delay."""

    system: UncertainSystem
    sample_time: float | None
    delay: int
    lag: float | None

    @property
    def nominal(self) -> list[Model]:
        return [self.at({}, goals=True)]

    def at(self, values: Values, *, goals: bool) -> Model:
        s, T = self.system, self.sample_time
        p = np.array([values.get(n, v) for n, v in zip(s.names, s.nominal, strict=True)])
        A, B, C, D = (M[0] for M in s.explicit(p))
        if self.lag is not None:
            A, B = add_lags(A, B, self.lag)
        if T is not None and s.sample_time is None:
            A, B = sample(A, B, T)
        if T is not None:
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
class Machine:
    """A machine with its hold, delay, current loops and late sensors, at places along its travel."""

    plant: Plant
    sample_time: float
    places: tuple[Values, ...]
    zero: Controller = field(
        repr=False
    )  # a law of errors that does nothing, with the machine's current loops

    @property
    def nominal(self) -> list[Model]:
        return [self.at(place, goals=True) for place in self.places]

    def at(self, values: Values, *, goals: bool) -> Model:
        known = units_of(self.plant.parameters)
        parameters = {name: v for name, v in values.items() if name in known}
        states = {name: v for name, v in values.items() if name not in known}
        if goals:
            at: dict[str, Any] = dict(states)
            found = loop(self.plant, self.zero, parameters=parameters, **at).sampled_forces
        else:
            found = self._unloaded(parameters, states)
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

    def _unloaded(self, parameters: Values, states: Values) -> SampledLoop:
        own: Any = self.plant.parameters
        changed = replace(own, **parameters)
        machine = self.plant.variant(changed) if parameters else self.plant
        return sampled_loop(
            linearize(machine, machine.at(**states)), self.zero,
            delay=machine.actuator.delay(self.sample_time),
            current_loops=chosen_loops(machine, self.zero, LAST), sensors=True, forces_alone=True,
        )  # fmt: skip

    def controller(self, law: System, name: str) -> Controller:
        """The law of errors as a controller, sampled by Tustin's rule."""
        import control  # imports matplotlib and takes a second: only where it is used

        sampled = control.ss(*sample_law(law, self.sample_time), self.sample_time, name=name)
        return controller_of(sampled, self.plant, name=name)

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
    plant: Any, sample_time: float | None, delay: int, lag: float | None, places: Sequence[Values] | None
) -> Systems | Uncertain | Machine:
    """What a law is tuned for. Raises InputError for anything else, and for options that it does not have."""
    if isinstance(plant, UncertainSystem):
        T = plant.sample_time if sample_time is None else sample_time
        if plant.sample_time is not None and plant.sample_time != T:
            raise InputError(CALLER, "sample_time", f"{T} s", f"{plant.sample_time} s, that of the system")
        if T is None and delay:
            raise InputError(CALLER, "delay", f"{delay} samples", "none without a sample time")
        return Uncertain(plant, T, delay, lag)
    if delay or lag is not None:
        raise InputError(
            CALLER, "delay, lag", "some", "those of an uncertain system alone: other plants have their own"
        )
    if isinstance(plant, Plant):
        if sample_time is None:
            raise InputError(CALLER, "sample_time", "none", "the sample time of the machine's law, s")
        import control  # imports matplotlib and takes a second: only where it is used

        m, p = len(plant.inputs), len(plant.outputs)
        nothing = control.ss([[0.0]], np.zeros((1, p)), np.zeros((m, 1)), np.zeros((m, p)), sample_time)
        own = (
            [{plant.stroke: share * plant.travel} for share in (0.0, 1.0, -1.0)] if plant.has_stroke else [{}]
        )
        zero = controller_of(nothing, plant, name="nothing")
        return Machine(plant, sample_time, tuple(own if places is None else places), zero)
    if sample_time is not None:
        raise InputError(
            CALLER, "sample_time", f"{sample_time} s", "none: systems of python-control have their own"
        )
    return Systems(tuple(models_of_systems(plant)))
