"""The runs that the page can show: the machine's main job, and a step of each output."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.errors import InputError
from malta.simulation.catalogue import cases_of, main_job, series_of
from malta.simulation.generic import step_cases

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.simulation.experiments import PlannedRun
    from malta.synthesis.controller import Controller

STEP = "step "


def run_names(plant: Plant, controller: Controller) -> list[str]:
    """The runs by name, the one that the page begins with first: the main job, unless nothing moves in it."""
    job, steps = main_job(plant), [STEP + s.name for s in plant.outputs]
    if job not in series_of(plant):
        return steps
    scenario = cases_of(job, plant, controller)[0].scenario
    moves = scenario.reference(plant)(np.linspace(0.0, scenario.duration, 50)).p
    return [job, *steps] if np.ptp(moves, axis=0).any() else [*steps, job]


def planned_run(plant: Plant, controller: Controller, name: str) -> tuple[str, PlannedRun]:
    """A run by its name, and the name; "": the first. Raises InputError for an unknown one."""
    known = run_names(plant, controller)
    name = name or known[0]
    if name not in known:
        raise InputError("run", "name", repr(name), "one of " + ", ".join(known))
    if name.startswith(STEP):
        return name, step_cases(plant, controller, output=name.removeprefix(STEP), size=0.0, time=0.0)[0]
    return name, cases_of(name, plant, controller)[0]
