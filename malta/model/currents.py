"""What the currents of a command make: the inputs that act, and whether these are the command.

v -> i = currents(h(x), v) -> u = forces(x, i)
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.model.inverse import InverseCheck, Mismatch
from malta.model.plant import Plant

PLACES = 21  # along a state, from one end to the other
SHARES = (-0.5, -0.1, 0.0, 0.1, 0.5)  # of the limits, commanded beside the preload
MAX_CLEARANCE, MIN_CLEARANCE = 1e6, 1e-9  # m or rad: a clearance lies between


@lru_cache(maxsize=32)  # plants compare by identity
def chain(plant: Plant, believed: Plant | None) -> tuple[ca.Function, ca.Function]:
    """(x, v) -> inputs that the currents of v make; (x, v) -> these currents, A."""
    x, v, i = currents_of(plant, believed)
    made = ca.Function("inputs", [x, v], [ca.densify(plant.actuator.forces(x, i))])
    return made, ca.Function("currents", [x, v], [ca.densify(i)])


def currents_of(plant: Plant, believed: Plant | None) -> tuple[Any, Any, Any]:
    """Symbols for the states x and the command v, and the currents of v there."""
    x, v = command_symbols(plant, believed)
    return x, v, currents_at(plant, believed, x, v)


def command_symbols(plant: Plant, believed: Plant | None) -> list[Any]:
    kind = ca.MX if (believed or plant).actuator.tabulated else ca.SX
    return [kind.sym("x", len(plant.states)), kind.sym("v", len(plant.inputs))]


def currents_at(plant: Plant, believed: Plant | None, x: Any, v: Any) -> Any:
    return (believed or plant).actuator.currents(plant.h(x, type(x).zeros(len(plant.inputs))), v)


# Whether a machine's `currents` is the inverse of its `forces`: where, and by how much not.


def check_inverse(plant: Plant) -> InverseCheck:
    """Compare forces(x, currents(h(x), v)) with v along each position of a plant: see `Plant.check`."""
    made, currents = chain(plant, None)
    positions = plant.controlled[: plant.coordinates] if plant.second_order else plant.controlled
    found = []
    for index in positions:
        low, high = (_clearance(plant, index, sign) for sign in (-1.0, 1.0))
        if low < high:
            found.append(_mismatch(plant, (made, currents), index, (low, high)))
    if not found:  # no contact bounds any state
        found.append(_mismatch(plant, (made, currents), positions[0], (0.0, 0.0)))
    x = np.zeros(len(plant.states))
    lost = [
        f"{s.name} = {v[k]:.4g} {s.unit}"
        for k, s in enumerate(plant.inputs)
        for v in _commands(plant, k)
        if not np.isfinite(np.array(currents(x, v))).all()
    ]
    undefined = f"no currents for {', '.join(lost[:3])}{' and others' if lost[3:] else ''}" if lost else ""
    return InverseCheck(plant.name, tuple(found), undefined)


def _clearance(plant: Plant, index: int, sign: float) -> float:
    """How far a state may go either way, SI: to the first contact or the end of the travel; 0 without any."""
    if plant.has_stroke and index == plant.stroke_state:
        return sign * plant.stroke.travel
    if not plant.contacts.names:
        return 0.0
    x = ca.SX.sym("x", len(plant.states))
    share = ca.Function("contact", [x], [ca.densify(plant.contacts.contact(x))])

    def is_free(distance: float) -> bool:
        there = np.zeros(len(plant.states))
        there[index] = sign * distance
        return bool(np.max(np.array(share(there))) < 1)

    if is_free(MAX_CLEARANCE) or not is_free(MIN_CLEARANCE):
        return 0.0
    low, high = MIN_CLEARANCE, MAX_CLEARANCE
    while high > low * (1 + 1e-6):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_free(middle) else (low, middle)
    return sign * low


def _commands(plant: Plant, index: int) -> list[FloatArray]:
    """Commands beside the preload at the states' zero in one input, within its limit."""
    limits = _limits(plant)
    preload = plant.at().u
    along = np.eye(len(limits))[index] * limits
    found = [preload + share * along for share in SHARES]
    return [v for v in found if (np.abs(v) <= np.maximum(limits, np.abs(preload)) * (1 + 1e-12)).all()]


def _limits(plant: Plant) -> FloatArray:
    limits = np.array(plant.actuator.force_limit or np.ones(len(plant.inputs)), dtype=float)
    return np.where(np.isfinite(limits) & (limits > 0), limits, 1.0)


def _mismatch(plant: Plant, functions: Any, index: int, ends: tuple[float, float]) -> Mismatch:
    """The worst command along one state, of those whose currents are defined and within their limits."""
    made, currents = functions
    limits, worst = _limits(plant), Mismatch(plant.states[index], *ends, 0.0, plant.inputs[0], 0.0, 0.0, 0.0)
    for place in np.linspace(*ends, PLACES if ends[0] < ends[1] else 1):
        x = np.zeros(len(plant.states))
        x[index] = place
        for k in range(len(plant.inputs)):
            for v in _commands(plant, k):
                i, u = np.array(currents(x, v)).ravel(), np.array(made(x, v)).ravel()
                if not (np.isfinite(i).all() and np.isfinite(u).all()):
                    continue
                if not np.allclose(
                    np.array(ca.evalf(ca.vertcat(plant.actuator.limited(ca.DM(i))))).ravel(), i, rtol=1e-9
                ):
                    continue
                j = int((np.abs(u - v) / limits).argmax())
                share = float(abs(u[j] - v[j]) / limits[j])
                if share > worst.share:
                    worst = worst._replace(
                        place=float(place),
                        input=plant.inputs[j],
                        command=float(v[j]),
                        made=float(u[j]),
                        share=share,
                    )
    return worst


@lru_cache(maxsize=64)  # tracing the currents is slow
def is_commutated(plant: Plant) -> bool:
    """Whether a machine's currents depend on the measured position, so that holding them changes the loop."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    y, v = kind.sym("y", len(plant.outputs)), kind.sym("v", len(plant.inputs))
    i = plant.actuator.currents(y, v)
    return bool(ca.which_depends(i, y, 1, True) != [False] * len(plant.actuator.coils))
