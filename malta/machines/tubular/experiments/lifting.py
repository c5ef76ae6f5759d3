"""MALTA against its weight: lift-off from the touchdown bearing, and payloads."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.machines.tubular.experiments.strokes import delayed_stroke
from malta.model.places import outputs_at
from malta.model.plant import Plant
from malta.roots import sign_change
from malta.simulation import references
from malta.simulation.experiments import Experiment, Merit, PlannedRun, Progress, fly, scenario_of
from malta.simulation.references import Motion, Reference
from malta.simulation.scenario import ESTIMATORS
from malta.simulation.simulate import fits_kalman_filter
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller


def lift_off(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """From rest on the touchdown bearing, without current; the observer takes the mover to be at the centre.

    One run for each start-up estimator that fits the controller, or the one that options name: the Kalman filters need
    the noise that an LQG with integrals was designed for, and have no run with a PID.
    """
    wanted = lift_cases(plant, controller, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    current = break_away_current(plant, wanted[0].scenario.start)
    needed = Merit("current per module that lifts it, statics", current, "A")
    return Experiment("lift-off", "Does it rise from its bearing?", cases, (needed,), interrupted=cut)


def lift_cases(plant: Plant, controller: Controller, **options: Any) -> list[PlannedRun]:
    """The runs of `lift-off`: one for each start-up estimator that fits the controller, or the one of the options."""
    resting = rest_on_bearing(plant)
    able = ESTIMATORS if fits_kalman_filter(controller) else ESTIMATORS[:1]
    kinds = [options["estimator"]] if "estimator" in options else list(able)
    own = {"start": resting, "cold": True, "bearing": True}
    reference = partial(rise_reference, start=resting)
    return [
        PlannedRun(
            kind, scenario_of("lift-off", 0.15, reference, own | options | {"estimator": kind}), _lift_merits
        )
        for kind in kinds
    ]


def rise_reference(plant: Plant, start: Mapping[str, float], duration: float = 30e-3) -> Reference:
    """From the state `start` to the centre, a quintic of `duration` (s)."""
    first = outputs_at(plant, plant.at(**start).x)

    def at(t: FloatArray) -> Motion:
        s, ds, dds = references.quintic(np.asarray(t) - duration / 2, duration / references.QUINTIC_DURATION)
        return Motion(np.outer(1 - s, first), np.outer(-ds, first), np.outer(-dds, first))

    return at


def rest_on_bearing(plant: Plant) -> dict[str, float]:
    """The state in which the mover lies on its touchdown bearings, without current."""
    names = [s.name for s in plant.states]
    downward = int(np.argmax(np.abs(np.array(ca.evalf(plant.load(ca.SX(ca.DM(plant.at().x)))))[:3, 0])))
    free = plant.states[downward].name
    x = ca.SX.sym("x", len(names))
    force = ca.Function(
        "force", [x], [plant.f(x, ca.SX.zeros(len(plant.inputs)), plant.load(x) + plant.contacts.bearing(x))]
    )

    def net(depth: float) -> float:
        return float(force(plant.at(**{free: -depth}).x)[len(names) // 2 + downward])

    def beyond(depth: float) -> float:
        return float(ca.evalf(plant.contacts.contact(ca.SX(ca.DM(plant.at(**{free: -depth}).x))))[0]) - 1

    edge = sign_change(beyond, 0.0, 1.0, 1e-12)
    return {free: -sign_change(net, edge, 1.5 * edge, 1e-15)}


def break_away_current(plant: Plant, resting: Mapping[str, float]) -> float:
    """Current of each bearing axis, A, whose forces balance weight and attraction in the state of rest."""
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    rate = ca.Function(
        "rate", [x, u], [plant.f(x, u, plant.load(x)), ca.jacobian(plant.f(x, u, plant.load(x)), u)]
    )
    pull, G = (np.array(value) for value in rate(plant.at(**resting).x, 0))
    forces = np.linalg.lstsq(G, -pull, rcond=None)[0].ravel()
    return float(np.abs(forces / np.array(plant.actuator.force_constant)).max())


def _lift_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Times of lift-off and settling, overshoot, deviation from the path, and current."""
    free = (run.contact[:, :2] < 1).all(axis=1)
    lifted = float(run.t[int(np.argmax(free))]) if free.any() else math.nan
    late = np.flatnonzero(np.abs(run.p[:, :4]).max(axis=1) > 20e-6)
    settled = float(run.t[late[-1]]) if len(late) and late[-1] + 1 < len(run.t) else math.nan
    return (
        Merit("off the bearing after", lifted, "ms"),
        Merit("within 20 um after", settled, "ms", key="settled"),
        Merit("beyond the centre", max(float(run.p[:, [1, 3]].max()), 0.0), "um"),
        Merit("off its path", float(np.abs(run.p - run.reference)[:, :4].max()), "um"),
        Merit("largest bearing current", bearing_current(run), "A"),
    )


def bearing_current(run: Trajectory) -> float:
    """Largest acting current of a bearing axis, A."""
    others = [k for k in range(len(run.plant.inputs)) if k != run.plant.thrust_input]
    return float(np.abs(run.force[:, others] / np.array(run.plant.actuator.force_constant)[others]).max())


def payload(
    plant: Plant,
    controller: Controller,
    *,
    masses: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2),
    known: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A mass (kg) picked at the centre of gravity after 50 ms of a hold, carried, and moved through the stroke.

    The controller does not learn of it, unless the mass is known: then its weight and its inertia are fed forward from
    the pick on, and gains stay. The integrals have 0.45 s before the stroke begins.
    """
    reference = partial(delayed_stroke, wait=WAIT)
    wanted = []
    for extra in masses:
        own: dict[str, Any] = {
            "changes": ((PICKING_TIME, {"m": plant.stroke.mass + extra}),),
            "bearing": True,
        }
        own |= {"anticipated": partial(payload_wrench, plant=plant, extra=extra)} if known else {}
        scenario = scenario_of("payload", WAIT + 0.15, reference, own | options)
        wanted.append(PlannedRun(f"{extra * 1e3:.0f} g", scenario, _payload_merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    carried = max((m for m, c in zip(masses, cases, strict=False) if c.run.verdict.completed), default=0.0)
    merit = Merit(
        "largest of these carried and moved", carried, "kg", "position_controller.payload", better="high"
    )
    return Experiment("payload", "What can it pick and move?", cases, (merit,), interrupted=cut)


PICKING_TIME, WAIT = 0.05, 0.5  # s: the mass is picked, the stroke begins


def payload_wrench(t: FloatArray, plant: Plant, extra: float) -> FloatArray:
    """The load that a mass (kg) adds on the published stroke, from the pick on: F_y = -m g, F_z = -m z*''."""
    names = [s.name for s in plant.disturbances]
    par: Any = plant.parameters
    wrench, picked = np.zeros((len(t), len(names))), np.asarray(t) >= PICKING_TIME
    wrench[:, names.index("F_y")] = -extra * par.g * picked
    along = delayed_stroke(plant, WAIT)(np.asarray(t)).ddp[:, plant.stroke_output]
    wrench[:, names.index("F_z")] = -extra * along * picked
    return wrench


def _payload_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Sag after the pick, and overshoot and errors of the stroke."""
    error, axis = np.abs(run.p - run.reference), run.plant.stroke_output
    carrying, moving = (run.t >= PICKING_TIME) & (run.t < WAIT), run.t >= WAIT
    radial = [k for k in range(error.shape[1]) if k != axis]
    start, end = run.reference[[0, -1], axis]
    beyond = (run.p[moving, axis] - end) / (end - start)
    return (
        Merit("largest sag after the pick", float(error[carrying][:, radial].max(initial=0.0)), "um"),
        Merit("stroke: overshoot", max(float(beyond.max(initial=0.0)), 0.0), "percent"),
        Merit("stroke: axial error", float(error[moving][:, axis].max(initial=0.0)), "mm"),
        Merit("stroke: radial deviation", float(error[moving][:, radial].max(initial=0.0)), "um"),
    )
