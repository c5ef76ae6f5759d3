"""The control law of the flexible rotor: that of design/flexible_rotor.toml, whose numbers `malta tune` found.

design()            the design file: on each axis a PD, a notch and a lag, alike in x and y, and its goals
controller(plant)   the law as it runs, sampled by Tustin's rule
continuous(plant)   the law before it is sampled: A, B, C and D of the errors
rest_weight()       W in m/N, above the modes that are left out: the weight of the goal `rest`, which counts in um/N
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import control
import numpy as np

import malta
from malta.synthesis.structure import Structure, places_in

FILE = Path(__file__).resolve().parent / "design" / "flexible_rotor.toml"
MICRO = 1e-6


def design() -> Any:
    """The design file, read and checked."""
    return malta.read_design(FILE)


def controller(plant: malta.model.Plant) -> malta.Controller:
    """The law as it runs."""
    return malta.synthesize(design(), malta.linearize(plant, plant.at()))


def continuous(plant: malta.model.Plant) -> Any:
    """The law before it is sampled."""
    structure = Structure(places_in(design().structure, malta.linearize(plant, plant.at())))
    return structure.system(np.zeros(len(structure.parameters)))


def rest_weight() -> control.TransferFunction:
    """W(s), m/N."""
    (rest,) = (goal for goal in design().structure.goals if goal.name == "rest")
    return MICRO * control.tf(*map(list, rest.arguments["weight"]))
