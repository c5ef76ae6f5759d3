"""The loop of a machine, from which everything linear follows, first of all whether it is stable: by its poles.

A loop is a machine x a law x an operating point x parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NoReturn

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.display import Description, display, quantity
from malta.errors import InputError, require_known
from malta.linear.matrices import eigenvalues
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.classical import Classical, Nominal, classical_margins
from malta.loops.parametric_loops import machine_system
from malta.loops.sampled_loops import (
    SampledLoop,
    continuous_poles,
    disturbance_map,
    loaded_loop,
    loaded_model,
    machine_loop,
    push_through,
)
from malta.loops.windings import LAST_STAGE, CurrentLoops, chosen_loops, left_out
from malta.model.linearize import LinearModel
from malta.model.parameters import units_of
from malta.model.places import position_at
from malta.model.plant import Plant, given_plant
from malta.model.traced import with_parameters
from malta.synthesis.controller import Controller, given_law, require_law_of
from malta.synthesis.law import law_at


@display
@dataclass(frozen=True, eq=False)
class Loop:
    """A machine and its controller at an operating point: the derivative of the control period that simulations run.

        xi+ = Ad xi + Bd (v, r) + G w,   y = Cd xi,   (v, r) = F y        one sample, negative feedback inside F

    xi holds the machine's states, the windings' currents, the link's voltage under load, stored forces and readings;
    r are readings on which held currents depend, w disturbances. Hold, delay, current loops, sensors and loads are
    exact. What is not in it is named by `left_out`.

    plant : the machine, with its parameters
    controller : its controller; of a schedule the law that it has there
    at : states that are not zero, SI, by name
    current_loops : "pi", the controllers of the gain file on the windings, where a machine has some; or "lag"

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller, z=5e-3)
    >>> loop.stable, loop.matrix.shape
    (True, (41, 41))
    >>> found = malta.robust_margin(loop, {"m": 0.2, "K_A": 0.2, "K_B": 0.2, "K_D": 0.2})
    >>> f"{found.lower:.2f} times the box"
    '1.65 times the box'
    """

    plant: Plant
    controller: Controller
    at: Mapping[str, float] = field(default_factory=dict)
    current_loops: CurrentLoops = LAST_STAGE

    @cached_property
    def model(self) -> LinearModel:
        """The machine's linear model at rest under its loads. Raises CheckError where no command holds it."""
        along = {name: value for name, value in self.at.items() if name != self.plant.stroke.name}
        return loaded_model(self.plant, self.at.get(self.plant.stroke.name, 0.0), tuple(along.items()))

    @cached_property
    def sampled(self) -> SampledLoop:
        """The sampled matrices; voltages that the law forecasts are inputs beside the forces."""
        found = machine_loop(self.model, self.controller, self.current_loops)
        assert found.continuous is not None
        pushed = push_through(
            found.continuous, disturbance_map(self.model), self.sample_time, len(found.Ad), found.caught
        )
        return replace(found, pushed=pushed)

    @cached_property
    def sampled_forces(self) -> SampledLoop:
        """The same loop, with the forecast voltages as part of the law's forces."""
        if chosen_loops(self.plant, self.controller, self.current_loops) != "pi":
            return self.sampled  # which forecasts none
        found = machine_loop(self.model, self.controller, self.current_loops, forces_alone=True)
        return replace(found, pushed=self.sampled.pushed)

    @property
    def sample_time(self) -> float:
        """Of the law, s."""
        return self.controller.sample_time

    @property
    def matrix(self) -> FloatArray:
        """The state matrix of the closed loop over one sample, the machine's states first."""
        return self.sampled.closed

    @cached_property
    def poles(self) -> ComplexArray:
        """Of the closed loop, ln(z) / Ts in rad/s, without those of pure delay."""
        return continuous_poles(self._eigenvalues, self.sample_time)

    @cached_property
    def _eigenvalues(self) -> ComplexArray:
        return eigenvalues(self.matrix)

    @cached_property
    def stable(self) -> bool:
        """Whether all poles decay."""
        return bool(np.abs(self._eigenvalues).max() < 1)

    @property
    def left_out(self) -> str:
        """What the machine has and this loop has not, in words; "": nothing."""
        return left_out(self.plant, self.controller, self.current_loops)

    @property
    def contents(self) -> str:
        """What stands between the law and the machine, and what is left out, in words."""
        actuator, sensors = self.plant.actuator, self.plant.sensors
        pi = chosen_loops(self.plant, self.controller, self.current_loops) == "pi"
        stands = {
            "delay": actuator.delay(self.sample_time) > 0,
            "current loops": pi,
            "lag of the current loops": not pi and math.isfinite(actuator.crossover),
            "lag of the sensors": bool(sensors.lagging),
            "dead time of the sensors": sensors.dead_time > 0,
        }
        *first, last = ["hold", *(words for words, there in stands.items() if there)]
        text = f"with {', '.join(first)} and {last}" if first else f"with {last}"
        return f"{text}; left out: {self.left_out}" if self.left_out else text

    def loop_gain(self, w: FloatArray) -> ComplexArray:
        """L = -P F at the sensors: k x p x p.

        w : k frequencies, rad/s
        """
        P, F = self.nominal.response(np.asarray(w, dtype=float))
        return np.asarray(-P @ F)

    def sensitivity(self, w: FloatArray) -> ComplexArray:
        """S = (I + L)^-1 at the sensors: k x p x p.

        w : k frequencies, rad/s
        """
        L = self.loop_gain(w)
        return np.asarray(np.linalg.inv(np.eye(L.shape[-1]) + L))

    @cached_property
    def nominal(self) -> Nominal:
        """The responses P and F of the loop, in differences, which classical margins take."""
        return loaded_loop(self.plant, self.controller, self.at, self.current_loops)

    @cached_property
    def classical(self) -> Classical:
        """Disk margins, delay margins and the gang of four."""
        sensors = [s.name for s in self.plant.outputs]
        return classical_margins(self.nominal, sensors, [s.unit for s in self.plant.inputs])

    def uncertain(self, names: Sequence[str]) -> tuple[UncertainSystem, Compensator]:
        """The loop at rest under its loads in parameters by name: the arguments of malta.robust_margin and its like.

        names : of the machine's parameters
        """
        return machine_system(self.plant, self.controller, list(names), self.at, self.current_loops)

    @property
    def margin(self) -> NoReturn:
        """Moved: `malta.robust_margin(loop, ranges)`. Raises InputError, which says so."""
        raise InputError("Loop", "margin", "a name that has moved", "malta.robust_margin(loop, ranges)")

    @property
    def description(self) -> Description:
        """Where it stands, its size and its poles."""
        place = ", ".join(f"{name} = {value:g}" for name, value in self.at.items() if value) or "the centre"
        rate = np.abs(self.poles)
        rows = (
            ("machine", f"{self.plant.name!r}, preset {self.plant.parameters.preset!r}, at {place}"),
            ("law", f"{self.controller.name!r}, every {quantity(self.sample_time, 's')}"),
            ("closed loop", f"{len(self.matrix)} states, {'stable' if self.stable else 'UNSTABLE'}"),
            ("poles", f"{rate.min():.4g} .. {rate.max():.4g} rad/s"),
            ("contents", self.contents),
        )
        return Description(f"Loop of {self.controller.name!r} at {place}", rows)


def loop(
    plant: Plant | LinearModel,
    controller: Controller,
    /,
    *,
    parameters: Mapping[str, float] | None = None,
    current_loops: CurrentLoops = LAST_STAGE,
    **at: float,
) -> Loop:
    """Make the loop of a machine and a controller at an operating point.

    plant : the machine; or a LinearModel of it, which brings its operating point
    controller : its controller; or a control.StateSpace of the errors, as `malta.synthesis.controller_of` takes it
    parameters : of the machine that differ, by name, SI; the controller keeps what it believes
    current_loops : "pi", the controllers of the gain file on the windings, where a machine has some; or "lag",
        first-order lags at their crossover
    at : states that are not zero, SI; none: the model's operating point, or the controller's

    Returns a Loop.

    Raises InputError for unknown states or parameters, and for values that the machine cannot have.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> heavy = malta.loop(plant, controller, parameters={"m": 0.6})
    >>> f"slowest pole {heavy.poles.real.max():.2f} rad/s"
    'slowest pole -9.89 rad/s'
    """
    model = plant
    plant = given_plant("loop", model)
    if hasattr(controller, "dt"):  # a system of python-control
        from malta.synthesis.state_space import controller_of

        controller = controller_of(controller, plant)
    controller = given_law("loop", controller)
    design = controller.operating_point[0]
    if isinstance(model, LinearModel):
        design = model.operating_point.x[list(plant.controlled)]
    chosen_loops(plant, controller, current_loops)
    require_known(parameters or (), units_of(plant.parameters), "loop", found="an unknown parameter")
    machine = with_parameters(plant, replace(plant.parameters, **parameters)) if parameters else plant
    require_law_of("loop", controller, plant)
    x = plant.state(at) if at else plant.point(design).x
    return _cached_loop(machine, controller, tuple(position_at(plant, x).items()), current_loops)


def loop_of_model(model: LinearModel, controller: Controller) -> Loop:
    """The loop of a linear model's machine at the model's operating point."""
    at = position_at(model.plant, model.operating_point.x)
    return _cached_loop(model.plant, controller, tuple(at.items()))


def loop_along(plant: Plant, controller: Controller, position: float | None = None) -> Loop:
    """The loop at a position of the stroke, m; None: at the controller's operating point."""
    require_law_of("loop", controller, plant)
    at = position_at(plant, plant.point(controller.operating_point[0]).x)
    if position is not None and plant.has_stroke:
        at[plant.stroke.name] = position
    return _cached_loop(plant, controller, tuple(at.items()))


def loop_from(
    source: Plant | LinearModel | Loop, controller: Controller | None, position: float | None = None
) -> Loop:
    """The loop that a function was given: as it is, or of a plant and its controller. Raises InputError."""
    if isinstance(source, Loop) and controller is None and position is None:
        return source
    if isinstance(source, Loop) or controller is None:
        found = "none" if controller is None else "one beside a Loop"
        raise InputError("loop", "controller", found, "a Loop, or a plant and its controller")
    if isinstance(source, LinearModel) and position is None:
        return loop_of_model(source, controller)
    return loop_along(given_plant("loop", source), controller, position)


@lru_cache(maxsize=32)  # what is asked of a loop is computed once; plants and controllers compare by identity
def _cached_loop(
    plant: Plant,
    controller: Controller,
    at: tuple[tuple[str, float], ...],
    current_loops: CurrentLoops = LAST_STAGE,
) -> Loop:
    return Loop(plant, law_at(controller, plant, plant.state(dict(at))), dict(at), current_loops)
