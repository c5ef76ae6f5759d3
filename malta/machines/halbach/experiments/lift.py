"""The vertical force of the Halbach motor, and its change by a move: Fig. 10."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.halbach import electronics
from malta.machines.halbach import electronics as motor
from malta.machines.halbach.electronics import Options, Pwm
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly_all,
    scenario_of,
)
from malta.simulation.references import Motion, Reference
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def lift_deviation(run: Trajectory) -> float:
    """Largest relative difference of the vertical force from the commanded one; NaN if that is 0."""
    F_z = commanded_lift(run)
    return float(np.abs(lift_force(run) / F_z - 1).max()) if F_z else math.nan


def commanded_lift(run: Trajectory) -> float:
    """The vertical force in the controller's parameters, N."""
    believed: Any = run.controller.parameters
    return float(believed.F_z)


def lift_force(run: Trajectory) -> FloatArray:
    """The vertical force at all samples, N; at fidelity "force" that of the commanded currents."""
    par: Any = run.plant.parameters
    return motor.vertical_force(par, run.x[:, 0], run.i_phase if run.i_phase.size else run.current)


MOVE = 5e-3  # m
CALM, AFTER = 100, 120  # readings before a move, and from its beginning to the end
FASTER = 50  # control periods of the open loop in a period of the laser
FAULTS: Mapping[
    str, Mapping[str, float]
] = {  # possible explanations of the paper's figures: parameters, angle (rad), outer force (N)
    "sound": {},
    "windings x 0.9, 0.9, 1.25": {"r_a": 0.9, "r_b": 0.9, "r_c": 1.25},
    "magnets of a phase x 0.8": {"a_a": 0.8},
    "angle off by 0.2 rad": {"angle": 0.2},
    "pushed by 1 N": {"push": 1.0},
}
LAWS: Mapping[str, tuple[bool, bool]] = {  # feedback of the position, of the currents
    "open loop": (False, False),
    "position control": (True, False),
    "vector control": (True, True),
}
PRINTED = dict(zip(LAWS, ("open_loop", "position_controller", "vector_control"), strict=True))  # figure_10


def force(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = MOVE,
    rise: float = 0.3,
    pwm: Pwm = "fine",
    adc_noise: bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The vertical force of a move: open loop, position control without current loops, vector control; with faults.

    In the open loop the reference jumps; with feedback it is a quintic with a rise of `rise` (s).
    """
    own = {"electronics": Options(pwm, adc_noise=adc_noise)} | options
    flights = [
        _flight(plant, controller, fault, law, distance, rise, own) for fault in FAULTS for law in LAWS
    ]
    cases, cut = fly_all(flights, progress, options)
    return Experiment("force", "Does a move disturb the vertical force?", cases, (), interrupted=cut)


def sound_moves(plant: Plant, controller: Controller, rise: float) -> Experiment:
    """The moves of `force` of the sound machine alone, with another rise (s) of the quintics."""
    own = {"electronics": Options("fine")}
    cases, cut = fly_all(
        [_flight(plant, controller, "sound", law, MOVE, rise, own) for law in LAWS], None, {}
    )
    return Experiment("force", "Does a quick move disturb the vertical force?", cases, (), interrupted=cut)


def _flight(
    plant: Plant,
    controller: Controller,
    fault: str,
    law: str,
    distance: float,
    rise: float,
    options: Mapping[str, Any],
) -> tuple[Plant, Controller, PlannedRun]:
    """One run of `force`: the machine with a fault, its controller, and the scenario.

    The open loop has no feedback from the laser, so its controller runs FASTER times as often.
    """
    par: Any = plant.parameters
    (position, vector), faulty = LAWS[law], dict(FAULTS[fault])
    angle, push = faulty.pop("angle", 0.0), faulty.pop("push", 0.0)
    machine = plant.variant(replace(par, **faulty)) if faulty else plant
    begin, end = CALM * controller.sample_time, (CALM + AFTER) * controller.sample_time
    own: dict[str, Any] = {"fidelity": "phase"} | dict(options)
    own["electronics"] = replace(own["electronics"] or electronics.REAL, current_loops=vector)
    if not position:
        controller = replace(controller, sample_time=controller.sample_time / FASTER)
        own |= {"open_loop": True, "delay": 0}
    if angle and position:  # the open loop takes the angle from the reference
        own["sensor_errors"] = {"offset_x": angle / par.k}
    if push:
        own["disturbance"] = partial(constant_force, size=push)
    reference = partial(move_reference, distance=distance, rise=rise if position else 0.0, begin=begin)
    printed = f"figure_10.{PRINTED[law]}" if fault == "sound" and distance == MOVE else ""
    merits = partial(_move_merits, begin=begin, printed=printed)
    label = law if fault == "sound" else f"{law}, {fault}"
    return machine, controller, PlannedRun(label, scenario_of("force", end, reference, own), merits)


def move_reference(_: Plant, distance: float, rise: float, begin: float) -> Reference:
    """From 0 to `distance` (m), beginning at `begin` (s): a quintic with a rise of `rise` (s), or a jump for 0."""

    def at(t: FloatArray) -> Motion:
        later = np.asarray(t) - begin
        if not rise:
            p = np.where(later > -1e-9, distance, 0.0)[:, None]
            return Motion(p, 0 * p, 0 * p)
        middle = references.QUINTIC_DURATION * rise / 2
        return Motion(*(distance * s[:, None] for s in references.quintic(later - middle, rise)))

    return at


def constant_force(t: FloatArray, size: float) -> FloatArray:
    """A constant force, N."""
    return np.full((len(t), 1), size)


def _move_merits(run: Trajectory, begin: float, printed: str) -> tuple[Merit, ...]:
    """Relative changes of the vertical force from its mean in the second before the move, and the distance moved."""
    F, later = lift_force(run), run.t > begin
    earlier, late = (run.t > begin - 1) & ~later, run.t > run.scenario.duration - 1
    if not late.any():  # the run ended earlier
        steady = lowest = highest = moved = math.nan
    else:
        shares = F / F[earlier].mean() - 1
        steady, lowest, highest = (
            float(shares[late].mean()),
            float(shares[later].min()),
            float(shares[later].max()),
        )
        moved = float(run.p[late, 0].mean() - run.p[earlier, 0].mean())
    return (
        Merit("steady change", steady, "percent", printed),
        Merit("lowest", lowest, "percent", better="high"),
        Merit("highest", highest, "percent"),
        Merit("moved", moved, "mm", better=""),
    )
