"""The loop of a machine and a controller, sampled; and the machine's loop with uncertain parameters.

P is the machine from forces to measurements under a zero-order hold, exactly; F is the control law from measurements
to forces (v = F y), as in the block diagram of synthesis/controller.py. At the sensors

    S = (I - P F)^-1,   T = I - S,   L = -P F.

Coil currents are commutated for the last reading and held for a sample. Where the machine moves on meanwhile, the
reading is a further input of P, and F passes it on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, get_args

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.margins.plants import of_plant
from malta.margins.uncertain import (
    Compensator,
    ReadingUse,
    UncertainSystem,
    held_gain,
    is_commutated,
    sampled_law,
)
from malta.model.data import plant_of
from malta.model.equilibrium import trim
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import position_in
from malta.model.sensors import whole_samples, with_lags
from malta.synthesis.controller import Controller, LinearLaw, linear_law, with_readings, with_slope
from malta.synthesis.riccati import add_lags, delay_inputs, sample
from malta.synthesis.sampled import held

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from malta.model.plant import ComplexArray, FloatArray, Plant

CurrentLoops = Literal["lag", "pi"]
ROUNDING = 1e-9  # of the largest entry


@dataclass(frozen=True, eq=False)
class Loop:
    """Sampled machine x+ = Ad x + Bd v, y = Cd x, closed by the linear control law v = F y."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    control: LinearLaw
    sample_time: float  # s
    true: FloatArray | None = None  # outputs of the states, where sensors read them late; None: Cd

    @property
    def outputs(self) -> FloatArray:
        """The matrix of the true outputs, which Cd reads."""
        return self.Cd if self.true is None else self.true

    @property
    def closed(self) -> FloatArray:
        """State matrix of the closed loop, states of the machine first."""
        c = self.control
        return np.block(
            [
                [self.Ad + self.Bd @ c.D_y @ self.Cd, self.Bd @ c.C],
                [c.B_y @ self.Cd, c.A],
            ]
        )

    def loop_gain(self, w: FloatArray) -> ComplexArray:
        """The loop gain at the sensors, L = -P F, at the frequencies w (rad/s): k x p x p."""
        z = np.exp(1j * np.asarray(w) * self.sample_time)[:, None, None]
        P = self.Cd @ np.linalg.solve(z * np.eye(len(self.Ad)) - self.Ad, self.Bd)
        c = self.control
        F = c.C @ np.linalg.solve(z * np.eye(len(c.A)) - c.A, c.B_y) + c.D_y
        return np.asarray(-P @ F)

    def sensitivity(self, w: FloatArray) -> ComplexArray:
        """The sensitivity S = (I + L)^-1 at the sensors, k x p x p; it also takes noise to the outputs."""
        return np.asarray(np.linalg.inv(np.eye(len(self.Cd)) + self.loop_gain(w)))


def loop(
    model: LinearModel,
    controller: Controller,
    *,
    delay: int = 0,
    current_loops: bool = False,
    feedforward: bool = False,
    sensors: bool = False,
) -> Loop:
    """The sampled loop of a machine and a controller.

    delay : samples between measurement and force
    current_loops : whether forces follow their commands with a first-order lag at the loops' crossover
    feedforward : whether the slope of v0(z) acts, for models at their trim, where the slope of the loads acts
    sensors : whether the machine's sensors read late; their readings are states after the machine's

    The controller commutates with its own parameters, and the currents produce forces with the machine's parameters.
    """
    model, law = commanded_model(model, controller), linear_law(controller)
    A, B, C = model.A, model.B, model.C
    if model.E.any():
        A, B = A - model.E @ C, np.hstack([B, model.E])
    lag, true = model.plant.actuator.crossover, None
    if sensors and model.plant.sensors is not None:
        true = C
        A, B, C = (np.array(ca.DM(M)) for M in with_lags(model.plant.sensors, A, B, C))
    if current_loops and math.isfinite(lag):
        A, B = add_lags(A, B, lag)
    Ad, Bd = delay_inputs(*sample(A, B, controller.sample_time), delay)
    Cd, true = _pad(C, len(Ad)), None if true is None else _pad(true, len(Ad))
    if feedforward:
        law = with_slope(law, feedforward_slope(model, controller))
    if model.E.any():
        law = with_readings(law)
    return Loop(Ad, Bd, Cd, law, controller.sample_time, true)


def _pad(C: FloatArray, n: int) -> FloatArray:
    """C of the first states as a matrix of all n."""
    return np.hstack([C, np.zeros((len(C), n - C.shape[1]))])


def machine_loop(model: LinearModel, controller: Controller) -> Loop:
    """The loop as the machine runs it: hold, delay, current loops, late sensors, loads against v0(z) at the trim.

    Raises CheckError when no input holds the machine at the model's operating point, and InputError for a dead time of
    its sensors that is not whole samples.
    """
    plant = model.plant
    loaded = loaded_model(plant, position_in(plant, model.operating_point.x))
    delay = plant.actuator.delay(controller.sample_time) + whole_samples(plant, controller.sample_time)
    return loop(loaded, controller, delay=delay, current_loops=True, feedforward=True, sensors=True)


@lru_cache(maxsize=8)  # every stage needs it; records compare by identity, so no entry is stale
def commanded_model(model: LinearModel, controller: Controller) -> LinearModel:
    """The model with the forces as inputs that the controller commands with its own parameters."""
    believed = plant_of(controller.parameters)
    if believed is model.plant:
        return model
    return linearize(model.plant, model.operating_point, believed)


def machine_law(
    plant: Plant,
    controller: Controller,
    current_loops: CurrentLoops = "lag",
    *,
    use: ReadingUse | None = None,
) -> Compensator:
    """The control law with the machine's hold, delay and current loops.

    current_loops : "lag", first-order lags at the crossover, or "pi", the PI controllers on the windings
    use : of the reading besides the law

    Raises InputError for other current loops, for PI loops that run faster than the control law, and for a dead time
    of the sensors that is not whole samples.
    """
    if current_loops not in get_args(CurrentLoops):
        raise InputError("verify", "current_loops", repr(current_loops), "lag or pi")
    a = plant.actuator
    delay = a.delay(controller.sample_time) + whole_samples(plant, controller.sample_time)
    if current_loops == "lag" or controller.current_loop is None:
        return sampled_law(controller, delay, a.crossover, use=use)
    if plant.windings is None:
        raise InputError("verify", "current_loops", "pi", f"lag: those of a {plant.name} run much faster")
    return sampled_law(controller, delay, a.R / a.L, controller.current_loop, a.R, use=use)


def machine_system(
    plant: Plant,
    controller: Controller,
    names: Sequence[str],
    at: Mapping[str, float],
    current_loops: CurrentLoops = "lag",
) -> tuple[UncertainSystem, Compensator]:
    """The machine at the states `at` in parameters by name, and its control law: the arguments of robust_margin."""
    believed = plant_of(controller.parameters)
    system, H = _commanded_system(plant, believed, tuple(names), tuple(at.items()))
    handed = H is not None and system.matrices.size2_out(1) > len(H)
    return system, machine_law(plant, controller, current_loops, use=ReadingUse(H, handed))


@lru_cache(maxsize=16)  # every controller of a machine has it; plants compare by identity
def _commanded_system(
    plant: Plant, believed: Plant, names: tuple[str, ...], at: tuple[tuple[str, float], ...]
) -> tuple[UncertainSystem, FloatArray | None]:
    """The machine at the states `at` in parameters by name, and the gain of currents that are held; None: none are."""
    states = dict(at)
    H = (
        held_gain(believed, position_in(believed, believed.at(**states).x))
        if is_commutated(believed)
        else None
    )
    return of_plant(plant, names, at=states, believed=believed, held=H, late=True), H


@lru_cache(maxsize=16)  # every loop of a machine needs it; plants compare by identity
def loaded_model(plant: Plant, position: float) -> LinearModel:
    """The machine at rest under its loads at a position of the stroke, m; 0 for a machine without a stroke.

    Raises CheckError when no input holds the machine there.
    """
    return linearize(plant, trim(plant, **({plant.stroke: position} if plant.has_stroke else {})))


def loaded_system(
    plant: Plant, controller: Controller, at: Mapping[str, float], current_loops: CurrentLoops = "lag"
) -> tuple[UncertainSystem, Compensator]:
    """The machine under its loads against v0(z), and its law: `machine_loop` in the form of `machine_system`.

    at : the states of the position, SI. The system has no uncertain parameters.

    Raises CheckError when no input holds the machine there.
    """
    model = commanded_model(loaded_model(plant, at.get(plant.stroke, 0.0)), controller)
    A, B, C, use = model.A, model.B, model.C, ReadingUse(slope=feedforward_slope(model, controller))
    if model.E.any():
        A, H = held(model)
        left = model.E - B @ H
        handed = bool(np.abs(left).max() > ROUNDING * np.abs(model.E).max())
        B, use = np.hstack([B, left]) if handed else B, use._replace(held=H, handed=handed)
    if plant.sensors is not None:
        A, B, C = (np.array(ca.DM(M)) for M in with_lags(plant.sensors, A, B, C))
    none = ca.SX.sym("p", 0)
    matrices = ca.Function("matrices", [none], [ca.SX(ca.DM(M)) for M in (A, B, C)])
    return UncertainSystem((), np.zeros(0), matrices), machine_law(plant, controller, current_loops, use=use)


def feedforward_slope(model: LinearModel, controller: Controller) -> FloatArray:
    """dv0/dy at a model's position, m x p: v0(z) follows the reading of the stroke."""
    plant = model.plant
    slope = np.zeros((len(controller.forces), len(model.C)))
    if plant.has_stroke:
        position = float(model.operating_point.x[plant.stroke_state])
        slope[:, plant.stroke_output] = controller.feedforward.slope(position)
    return slope
