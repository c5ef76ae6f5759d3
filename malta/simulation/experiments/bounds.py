"""The payload of a machine, bounded by statics and by flight.

    statics   at rest the commanded forces stay within their limits, anywhere in the travel
    flight    the machine's experiment `payload` ends without touchdown: the mass is picked up and moved

The mass margin of the linear loop (margins/verify.py) knows no limits of forces and no clearances, and is far larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import CheckError
from malta.margins.loop_report import Payload
from malta.model.equilibrium import balance
from malta.model.parameters import units_of
from malta.simulation.experiments import setting
from malta.simulation.experiments.catalogue import experiment

if TYPE_CHECKING:
    from malta.model.linearize import LinearModel
    from malta.model.plant import FloatArray, Plant
    from malta.synthesis.controller import Controller


EXPERIMENT = "payload"
PLACES = (-1.0, 0.0, 1.0)  # of the travel
HEAVIEST = 1e6  # kg; what holds that is not limited by its forces
UNREACHED = 2.0  # share of a limit, beyond it, where no command makes the forces
STEP = 0.02  # of a mass: how finely the flight is bisected


def payload(plant: Plant, controller: Controller) -> Payload | None:
    """Bound the payload of a machine; None for a machine without a mass m.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> found = payload(malta.plant_of(controller.parameters), controller)
    >>> f"forces hold {found.held:.1f} kg, the mover carries {found.carried:.1f} kg"
    'forces hold 3.6 kg, the mover carries 0.7 kg'
    """
    if "m" not in units_of(plant.parameters):
        return None
    held = held_payload(plant)
    return Payload(held, *flown_payload(plant, controller, held))


def held_payload(plant: Plant) -> float:
    """Find the mass, kg, at which a force reaches its limit at rest in the middle or at an end of the travel."""
    par: Any = plant.parameters
    limits = np.array(plant.actuator.force_limit)
    places = [{plant.stroke: share * plant.travel} for share in PLACES] if plant.has_stroke else [{}]

    def share_used(extra: float) -> float:
        heavier = plant.variant(replace(par, m=par.m + extra))
        try:
            held = [balance(heavier, plant.state(at)).v for at in places]
        except CheckError:  # no command makes these forces
            return UNREACHED
        return float(np.abs(np.array(held) / limits).max())

    if share_used(0.0) >= 1:
        return 0.0
    from scipy.optimize import brentq  # here: it takes long to load

    high = par.m
    while share_used(high) < 1:
        high *= 2
        if high > HEAVIEST:
            return math.inf
    return float(brentq(lambda extra: share_used(extra) - 1, 0.0, high, xtol=1e-9))


def flown_payload(plant: Plant, controller: Controller, most: float) -> tuple[float, float]:
    """Find the largest mass, kg, up to `most` that the experiment `payload` carries, and the smallest that it drops."""
    if EXPERIMENT not in setting(plant, "EXPERIMENTS", {}):
        return math.nan, math.inf

    def carries(mass: float) -> bool:
        return experiment(EXPERIMENT, plant, controller, masses=(mass,)).cases[0].run.verdict.completed

    return largest_mass(carries, most if math.isfinite(most) else HEAVIEST)


def largest_mass(carries: Callable[[float], bool], most: float) -> tuple[float, float]:
    """Find the largest mass, kg, up to `most` that is carried, by bisection, and the smallest that is not."""
    if carries(most):
        return most, math.inf
    low, high = 0.0, most
    while high - low > STEP * high and high > 1e-6 * most:
        middle = (low + high) / 2
        low, high = (middle, high) if carries(middle) else (low, middle)
    return low, high


# Starting positions from which bounded forces can bring an unstable linear model back to rest.
#
# In a mode with the real pole lambda > 0 and the left eigenvector w, the coordinate s = w x obeys s' = lambda s + w B
# u + w d. It can be brought back if, and only if, s lies in the set of -integral of e^(-lambda t) (w B u + w d) dt
# over all forces |u_i| <= limit_i. No controller returns from beyond: stable modes and rates of force only take away
# from it.


SLOW = 1.0  # rad/s: slower modes count as stable


def recoverable(
    model: LinearModel, plane: tuple[str, str], load: FloatArray, directions: int = 360
) -> FloatArray:
    """The boundary of the recoverable starts at rest in the plane of two positions, directions x 2, SI.

    plane : names of two positions; the others are zero, and so are all rates
    load : rates of change of the states by a constant load, n

    For each direction c the furthest point of the convex set, reached by u_i = -limit_i sign(c e^(-lambda t) w B_i),
    which changes its sign once at most.

    Raises CheckError unless two real unstable modes, and only two, move the plane's positions.

        recoverable(model, ("x", "beta"), np.zeros(10))[:, 0].max()
    """
    names = [s.name for s in model.plant.design_states]
    columns = [names.index(name) for name in plane]
    poles, W = _unstable_modes(model.A, columns)
    if len(poles) != 2 or abs(poles[0] - poles[1]) < 1e-9 * poles[0]:
        raise CheckError(
            f"{model.plant.name}: {' and '.join(plane)} have {len(poles)} separate unstable modes"
        )
    limits = np.array(model.plant.actuator.force_limit)
    W /= (np.abs(W @ model.B) @ limits / poles)[:, None]  # the set reaches from -1 to 1 in both coordinates
    b = W @ model.B  # 2 x m
    angle = np.linspace(0, 2 * math.pi, directions, endpoint=False)
    furthest = np.array([_furthest(np.array([math.cos(a), math.sin(a)]), poles, b, limits) for a in angle])
    boundary: FloatArray = np.linalg.solve(W[:, columns], (furthest - (W @ load) / poles).T).T
    return boundary


def _unstable_modes(A: FloatArray, columns: list[int]) -> tuple[FloatArray, FloatArray]:
    """Poles and left eigenvectors (rows) of the unstable modes that positions of these columns move."""
    values, vectors = np.linalg.eig(A.T)
    chosen = (values.real > SLOW) & (np.abs(vectors[columns]).max(axis=0) > 1e-9)
    return values[chosen].real, vectors[:, chosen].real.T


def _furthest(c: FloatArray, poles: FloatArray, b: FloatArray, limits: FloatArray) -> FloatArray:
    """The point of the set that is furthest along c: 2."""
    point = np.zeros(2)
    for b_i, limit in zip(b.T, limits, strict=True):
        first, second = c * b_i
        sign = np.sign(first + second) or 1.0
        ratio = -first / second if second else 0.0
        switch = math.log(ratio) / (poles[0] - poles[1]) if ratio > 0 else math.inf
        left = np.exp(-poles * switch) if switch > 0 else np.zeros(2)  # what comes after the switch
        point += limit * sign * b_i / poles * (1 - 2 * left)
    return point


def reach(boundary: FloatArray, direction: tuple[float, float]) -> float:
    """How far a boundary is from the centre along a direction, in multiples of it; NaN where the ray misses it."""
    along, across = np.array(direction), np.array([-direction[1], direction[0]])
    after = np.roll(boundary, -1, axis=0)
    side, next_side = boundary @ across, after @ across
    with np.errstate(divide="ignore", invalid="ignore"):
        share = side / (side - next_side)
        found = ((boundary + share[:, None] * (after - boundary)) @ along) / (along @ along)
    crossed = (side * next_side <= 0) & (found > 0) & np.isfinite(found)
    return float(found[crossed].max()) if crossed.any() else math.nan
