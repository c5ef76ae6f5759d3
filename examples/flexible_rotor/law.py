"""The control law of the flexible rotor: on each axis a PD, a notch and a lag, alike in x and y; and how it was found.

structure(plant)    named elements of malta.structured, with the values that `tune` found, rounded
controller(plant)   the law as it runs, sampled by Tustin's rule
tune(plant)         the search, from these values: |S| <= 2.7 at rest and at full speed, the rest's block within 0.9,
                    and the smallest motion of the sensors under forces on the discs
"""

from __future__ import annotations

from typing import Any

import control
import numpy as np

import malta
from malta import structured

SAMPLE_TIME = 1e-4  # s
VALUES = {
    "A": {
        "pid": {"Kp": 0.898e6, "Kd": 9.86e3, "filter": 844e-6},
        "notch": {"frequency": 1028.0, "depth": 0.327, "damping": 1.817},
        "lead": {"zero": 13020.0, "pole": 4121.0},
    },
    "B": {
        "pid": {"Kp": 0.898e6, "Kd": 6.19e3, "filter": 566e-6},
        "notch": {"frequency": 1266.0, "depth": 0.586, "damping": 1.008},
        "lead": {"zero": 12070.0, "pole": 4064.0},
    },
}  # SI, by the end of the rotor
REST = control.tf(1.8e-7 * np.array([1.0, 1600.0, 800.0**2]), [1.0, 8000.0, 4000.0**2])  # m/N, above the rest


def structure(plant: malta.Plant) -> dict[str, Any]:
    """The law of each sensor."""
    found = {}
    for end, v in VALUES.items():
        lag = structured.lead(f"{end}_lag", **v["lead"], bounds={"pole": (2e3, 3e4)})
        pd = structured.pid(end, **v["pid"], bounds={"filter": (1.5e-4, 1)})
        within = {"frequency": (1e3, 8e3), "depth": (0.05, 3), "damping": (0.1, 3)}
        found[end] = lag * pd * structured.notch(f"{end}_notch", **v["notch"], bounds=within)
    return {s.name: found[s.name[2]] for s in plant.outputs}


def controller(plant: malta.Plant) -> malta.Controller:
    """The law as it runs."""
    whole = control.append(*(control.ss(*e.system.balanced) for e in structure(plant).values()))
    sampled = control.c2d(whole, SAMPLE_TIME, "tustin")
    return malta.synthesis.controller_of(sampled, plant, name="flexible_rotor")


def tune(plant: malta.Plant) -> structured.Tuned:
    """The search that found VALUES; two minutes."""
    par: Any = plant.parameters
    outputs = [f"output {s.name}" for s in plant.outputs]
    goals = [
        structured.sensitivity(2.7),
        structured.gain_limit("reference", "force", 0.9, weight=REST, name="rest"),
        structured.soft(structured.gain_limit("disturbance", outputs, 1e-6, name="compliance")),
    ]
    places = [{"Omega": 0.0}, {"Omega": par.Omega_max}]
    return structured.tune(plant, structure(plant), goals, sample_time=SAMPLE_TIME, places=places, starts=1)
