"""The payload of a machine, bounded by statics and by flight.

statics   at rest the commanded forces stay within their limits, anywhere in the travel
flight    the machine's experiment `payload` ends without touchdown: the mass is picked up and moved

The mass margin of the linear loop (margins/verify.py) knows no limits of forces and no clearances, and is far larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from malta.errors import CheckError
from malta.model.equilibrium import balance
from malta.model.parameters import units_of
from malta.model.plant import Plant
from malta.roots import sign_change
from malta.simulation.experiments import setting, whole_experiment
from malta.simulation.experiments.catalogue import experiment
from malta.synthesis.controller import Controller
from malta.synthesis.requirements import Payload

PAYLOAD = "payload"  # name of the experiment
PLACES_OF_REST = (-1.0, 0.0, 1.0)  # of the travel
MAX_PAYLOAD = 1e6  # kg; what holds that is not limited by its forces
UNREACHED_SHARE = 2.0  # share of a limit, beyond it, where no command makes the forces
FINENESS = 0.02  # of a mass: how finely the flight is bisected


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
    stroke = plant.stroke
    places = [{stroke.name: share * stroke.travel} for share in PLACES_OF_REST] if plant.has_stroke else [{}]

    def share_used(extra: float) -> float:
        heavier = plant.variant(replace(par, m=par.m + extra))
        try:
            held = [balance(heavier, plant.state(at)).v for at in places]
        except CheckError:  # no command makes these forces
            return UNREACHED_SHARE
        return float(np.abs(np.array(held) / limits).max())

    if share_used(0.0) >= 1:
        return 0.0
    high = par.m
    while share_used(high) < 1:
        high *= 2
        if high > MAX_PAYLOAD:
            return math.inf
    return sign_change(lambda extra: share_used(extra) - 1, 0.0, high, 1e-9)


def flown_payload(plant: Plant, controller: Controller, most: float) -> tuple[float, float]:
    """Find the largest mass, kg, up to `most` that the experiment `payload` carries, and the smallest that it drops."""
    if PAYLOAD not in setting(plant, "EXPERIMENTS", {}):
        return math.nan, math.inf

    def carries(mass: float) -> bool:
        found = whole_experiment(experiment(PAYLOAD, plant, controller, masses=(mass,)))
        return found.cases[0].run.verdict.completed

    return largest_mass(carries, most if math.isfinite(most) else MAX_PAYLOAD)


def largest_mass(carries: Callable[[float], bool], most: float) -> tuple[float, float]:
    """Find the largest mass, kg, up to `most` that is carried, by bisection, and the smallest that is not."""
    if carries(most):
        return most, math.inf
    low, high = 0.0, most
    while high - low > FINENESS * high and high > 1e-6 * most:
        middle = (low + high) / 2
        low, high = (middle, high) if carries(middle) else (low, middle)
    return low, high
