"""The experiments on the Halbach linear motor.

step     100 um there and back, with every source of error, Fig. 9
stairs   steps of 10 um: open loop and position control, plain and high-resolution PWM, Fig. 7
ramp     50 mm at constant speed, Fig. 8
force    the vertical force of a move of 5 mm under three control laws, Fig. 10, sound and with faults
budget   the error of a motor at rest by source, Sec. 5.1
identify the step of 2 mm in the open loop from which the paper identified mass and friction, Sec. 2.3

Electronics run period by period at fidelity "phase", which is the default; campaigns run at fidelity "force".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from malta.errors import InputError
from malta.machines.halbach.electronics import Options
from malta.machines.halbach.experiments.motions import budget, ramp, ramp_cases, step, step_cases
from malta.machines.halbach.experiments.open_loop import F_MOST, force, identify, stairs
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    PlannedRun,
)

EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "step": step,
    "stairs": stairs,
    "ramp": ramp,
    "force": force,
    "budget": budget,
    "identify": identify,
}
CASES: dict[str, Callable[..., list[PlannedRun]]] = {"step": step_cases, "ramp": ramp_cases}
ALONE = ("step", "ramp")
WORDS = {"stroke": "position", "thrust": "force"}
OPTION_UNITS = {"distance": "m", "rise": "s", "speeds": "m/s", "place": "m", "F_z": "N"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number outside the range of an option, and for options of no electronics."""
    if option in ("pwm", "mean_of"):
        Options(**{option: value})
    elif option == "count" and not (isinstance(value, int) and 1 <= value <= 1000):
        raise InputError("simulate", f"{name}: {option}", repr(value), "1 to 1000 steps")
    elif option == "rise":
        references.check_rise(value)
    elif option == "F_z" and not 0 < value <= F_MOST:
        raise InputError("simulate", f"{name}: F_z", f"{value:g} N", f"above 0 and at most {F_MOST:g} N")
    elif option in ("distance", "speeds", "place"):
        values = value if option == "speeds" else (value,)
        if not all(
            math.isfinite(v) and (v > 0 or option == "place" or (v and option == "distance")) for v in values
        ):
            expected = (
                "above 0"
                if option == "speeds"
                else "finite" + ("" if option == "place" else ", other than 0")
            )
            raise InputError("simulate", f"{name}: {option}", repr(value), expected)
