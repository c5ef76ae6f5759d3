"""Where a machine is in a state: its outputs, its position along the stroke, and all else that is not zero."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from malta.arrays import FloatArray

if TYPE_CHECKING:
    from malta.model.plant import Plant

MIN_SLOPE = 1e-6  # of a reading at rest over what is asked for, below which it does not follow


def place_states(plant: Plant, design: Any) -> Any:
    """All states as an expression: these first ones of the design model, the others zero. design : a CasADi column"""
    x = type(design).zeros(len(plant.states))
    x[list(plant.controlled[: design.numel()])] = design
    return x


def position_in(plant: Plant, x: ArrayLike) -> float:
    """The position along the stroke in a state; 0 for a machine without a stroke."""
    return float(np.asarray(x)[plant.stroke_state]) if plant.has_stroke else 0.0


def position_at(plant: Plant, x: ArrayLike) -> dict[str, float]:
    """The position along the stroke by name, an argument of `plant.at`, and the other states that are not zero."""
    return ({plant.stroke.name: position_in(plant, x)} if plant.has_stroke else {}) | off_stroke(plant, x)


def outputs_at(plant: Plant, x: ArrayLike) -> FloatArray:
    """The outputs at rest at the states x, without sensors' errors."""
    return np.array(ca.DM(plant.h(ca.DM(np.asarray(x, dtype=float)), 0)), dtype=float).ravel()


def holdable_outputs(plant: Plant) -> tuple[int, ...]:
    """The outputs that a machine at rest can be at, by h and `position_of`: no accelerations, and no rates.

    Of outputs that say the same, as a position and the current that holds it, those that `position_of` reads; all where
    none is left.
    """
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    p = kind.sym("p", len(plant.outputs))
    read = ca.vertcat(plant.h(place_states(plant, ca.densify(plant.position_of(p))), 0))
    slope = np.array(
        ca.Function("slope", [p], [ca.densify(ca.jacobian(read, p))])(np.zeros(len(plant.outputs)))
    )
    found = np.flatnonzero(np.abs(np.diag(slope)) > MIN_SLOPE)
    return tuple(found.tolist() or range(len(plant.outputs)))


def off_stroke(plant: Plant, x: ArrayLike) -> dict[str, float]:
    """The states by name that are not zero, without the stroke."""
    pairs = zip(plant.states, np.asarray(x).tolist(), strict=True)
    return {s.name: value for s, value in pairs if value and s.name != plant.stroke.name}
