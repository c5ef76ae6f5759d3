"""MALTA on a carrier that accelerates sideways, with and without radial feedforward of the known acceleration.

Sec. IV-A: the first four components of v_FF can counter "any known radial disturbances, e.g. when the MALTA is moved
with parallel kinematics in pick-and-place robots". Reading: the stator moves along x by a known quintic, from rest to
rest; seen from the stator, the inertial force -m a acts at the mover's centre of gravity. The acceleration is known at
the sample at which it acts, not before.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.tubular.experiments.strokes import delayed_stroke
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    rms,
    scenario_of,
)
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

BEGIN, AFTER = 0.02, 0.08  # s, before and after the carrier's move
KNOWN = {"not fed forward": 0.0, "fed forward": 1.0, "90 % fed forward": 0.9}  # share of the acceleration


def carrier(
    plant: Plant,
    controller: Controller,
    *,
    carried: float = 0.1,
    within: float = 0.2,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The carrier moves sideways by `carried` (m) in `within` (s): at rest and during the published stroke, with the
    inertial force fed forward and without."""
    wanted = carrier_cases(plant, controller, carried=carried, within=within, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    t = np.arange(0, wanted[0].scenario.duration, controller.sample_time)
    acceleration = carrier_acceleration(t, carried, within)
    found = (
        Merit("largest acceleration of the carrier", float(np.abs(acceleration).max()), "m/s^2"),
        Merit("largest inertial force", float(plant.mass * np.abs(acceleration).max()), "N"),
    )
    curves = {"t": t, "acceleration": acceleration}
    return Experiment("carrier", "Does it ride along?", cases, found, curves, interrupted=cut)


def carrier_cases(
    plant: Plant, _: Controller, *, carried: float, within: float, **options: Any
) -> list[PlannedRun]:
    """The runs of `carrier`: at rest, and during the published stroke."""
    duration = BEGIN + within + AFTER
    wanted = []
    for place, reference in (("rest", references.hold), ("stroke", partial(delayed_stroke, wait=BEGIN))):
        for label, share in KNOWN.items():
            acts = partial(inertial_wrench, plant=plant, carried=carried, within=within)
            own: dict[str, Any] = {"disturbance": acts}
            own |= {"anticipated": partial(acts, share=share)} if share else {}
            scenario = scenario_of("carrier", duration, reference, own | options)
            wanted.append(PlannedRun(f"{place}, {label}", scenario, _merits))
    return wanted


def carrier_acceleration(t: FloatArray, carried: float, within: float) -> FloatArray:
    """Acceleration of the carrier at the times t, m/s^2: a quintic from rest to rest that begins at BEGIN."""
    _, __, shape = references.quintic(
        np.asarray(t) - BEGIN - within / 2, within / references.QUINTIC_DURATION
    )
    return carried * shape


def inertial_wrench(
    t: FloatArray, plant: Plant, carried: float, within: float, share: float = 1.0
) -> FloatArray:
    """The wrench on the mover as seen from the carrier, or a share of it, at the times t."""
    wrench = np.zeros((len(t), len(plant.disturbances)))
    column = [s.name for s in plant.disturbances].index("F_x")
    wrench[:, column] = -share * plant.mass * carrier_acceleration(t, carried, within)
    return wrench


def _merits(run: Trajectory) -> tuple[Merit, ...]:
    """Radial deviation and the bearing currents."""
    error, axis = run.p - run.reference, run.plant.stroke_output
    radial = error[:, [k for k in range(error.shape[1]) if k != axis]]
    bearings = [k for k in range(len(run.plant.inputs)) if k != run.plant.thrust_input]
    constant = np.array(run.plant.actuator.force_constant)[bearings]
    return (
        Merit("radial deviation", float(np.abs(radial).max()), "um"),
        Merit("rms of x1", rms(error[:, 0]), "um"),
        Merit("largest bearing current", float(np.abs(run.v[:, bearings] / constant).max()), "A"),
    )
