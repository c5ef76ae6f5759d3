"""The experiments on the flexible rotor, beside those of any machine.

unbalance  flown speed by speed on the nonlinear magnets, beside the response of the linear loop that analysis.py has
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.simulation import references
from malta.simulation.experiments import (
    NO_NOISE,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    amplitude,
    catalogue as generic,
    fly_all,
    scenario_of,
)

from . import analysis, flexible_rotor

if TYPE_CHECKING:
    from malta.model import Plant
    from malta.simulation.trajectory import Trajectory
    from malta.synthesis import Controller

SPEEDS = (100.0, 250.0, 418.0)  # rad/s
SETTLING, TURNS = 0.3, 8  # s, and revolutions after it of which amplitudes are read


def unbalance(
    plant: Plant,
    controller: Controller,
    *,
    speeds: tuple[float, ...] = SPEEDS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The rotor at each of these speeds (rad/s) with the unbalance of its discs, and exact sensors."""
    linear = analysis.unbalance_response(plant, controller, np.array(speeds)).sensors
    flights = []
    for speed, expected in zip(speeds, linear, strict=True):
        machine = analysis.at_speed(plant, speed)
        given = {"fidelity": "force", "disturbance": partial(rotating, machine)} | NO_NOISE | options
        duration = SETTLING + 2 * math.pi * TURNS / speed
        scenario = scenario_of("unbalance", duration, references.hold, given)
        merits = partial(_merits, speed=speed, expected=expected)
        flights.append((machine, controller, PlannedRun(f"{speed:g} rad/s", scenario, merits)))
    cases, cut = fly_all(flights, progress, options)
    flown = np.array([[one.value for one in case.merits[:2]] for case in cases])
    curves = {"speed": np.array(speeds)[: len(flown)], "flown": flown}
    question = "How far does its unbalance move the rotor?"
    return Experiment("unbalance", question, cases, cases[0].merits, curves, interrupted=cut)


def rotating(machine: Plant, t: Any) -> Any:
    """The forces of the unbalance on the discs at the times t, k x 4."""
    par: Any = machine.parameters
    turning = flexible_rotor.unbalance(par, par.Omega).T * np.exp(1j * par.Omega * np.asarray(t))[:, None]
    return np.hstack([turning.real, turning.imag])


def _merits(run: Trajectory, speed: float, expected: Any) -> tuple[Merit, ...]:
    ends = [s.name for s in run.plant.outputs[:2]]
    rate = speed / (2 * math.pi)
    return (
        *(Merit(f"{name}, amplitude", amplitude(run, k, rate), "um") for k, name in enumerate(ends)),
        *(Merit(f"{name}, linear", float(expected[k]), "um") for k, name in enumerate(ends)),
        Merit("largest current", float(np.abs(run.current).max()), "A"),
    )


EXPERIMENTS = {**generic.EXPERIMENTS, "unbalance": unbalance}
CASES = generic.CASES
OPTION_UNITS = {"speeds": "rad/s"}
