"""The experiments on the planar motor.

step     the paper's steps in z and y, Figs 9 to 12, as quintics, with each coil model in the controller
jump     the same as the paper commands them, jumps that saturate, with gains that settle

The coil models are the controller's; the simulated machine always has the exact wrench of the field.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from malta.errors import InputError
from malta.machines.planar.motions import jump, step, step_cases
from malta.simulation.experiments import Experiment, PlannedRun

EXPERIMENTS: dict[str, Callable[..., Experiment]] = {"step": step, "jump": jump}
CASES: dict[str, Callable[..., list[PlannedRun]]] = {"step": step_cases}  # with the controller's coil model
WORDS = {
    "stroke": "y",
    "m": "x and z",
    "rad": "angles",
    "thrust": "F_y",
    "N": "F_x and F_z",
    "N m": "torques",
}
OPTION_UNITS = {"place": "m", "gap": "m", "lift": "m", "distance": "m", "rate": "1/s"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number outside the range of an option. `steps_reference` checks positions."""
    if option == "rate" and not 0 <= value <= 1000:
        raise InputError("simulate", f"{name}: rate", repr(value), "0 to 1000 1/s")
    if option == "cells" and not (math.isfinite(value) and value > 0):
        raise InputError("simulate", f"{name}: {option}", repr(value), "finite, above 0")
    if option == "cells" and value != int(value):
        raise InputError("simulate", f"{name}: cells", repr(value), "a whole number")
