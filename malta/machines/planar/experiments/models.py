"""Errors of the planar motor's coil models."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.machines.planar import coils, commutation
from malta.machines.planar import plant as planar
from malta.machines.planar.experiments.motions import CELLS, FORCES, PLACE, parameters_of, with_coil_model
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
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


CURRENT = 3.0  # A in one coil: Sec. 4.1
NODES = (5, 7, 10, 14, 20, 28, 35, 50, 70)  # cells over tau_n of the tables whose errors are compared


def errors(
    plant: Plant,
    controller: Controller,
    *,
    current: float = CURRENT,
    cells: int = CELLS,
    place: tuple[float, ...] = PLACE,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """One coil at `current` (A) over a period at the working height: each model against the exact wrench.

    The coil is an inner one of the mover, its torques are about the centre of gravity; the paper does not name one.
    A hover at `place` (m) shows the force and torque that feedback adds to correct a model.
    """
    par = parameters_of(plant)
    if len(place) != 2:
        raise InputError("simulate", "errors: place", f"{len(place)} numbers", "x and y")
    commutation.check_position(par, np.array([*place, par.h]))
    truth = coils.exact_model(par)
    models: dict[str, coils.CoilModel] = {
        "analytical": coils.Analytical(par),
        "table": coils.table(par, truth, cells),
    }
    x, y = np.meshgrid(*[np.linspace(0, 2 * par.tau_n, 141)] * 2, indexing="ij")
    exact = coil_wrench(par, truth, current, x, y)
    curves: dict[str, FloatArray] = {"x": x[:, 0], "exact": exact}
    reference = partial(references.hold, x=place[0], y=place[1])
    scenario = scenario_of("errors", 0.02, reference, FORCES | options)
    flights = []
    for name, model in models.items():
        error = coil_wrench(par, model, current, x, y) - exact
        curves[name] = error
        merits = partial(_error_merits, largest=np.abs(error).max(axis=(0, 1)))
        flights.append((plant, with_coil_model(controller, name, cells), PlannedRun(name, scenario, merits)))
    cases, cut = fly_all(flights, progress, options)
    curves |= {"step": par.tau_n / np.array(NODES), "by step": _by_step(par, truth, current)}
    amplitude = np.abs(exact).max(axis=(0, 1))
    found_merits = (
        *(
            Merit(f"{s.name}, amplitude", float(a), s.unit, f"model.amplitude.{s.name}")
            for s, a in zip(plant.inputs, amplitude, strict=True)
        ),
        Merit("fitted C of the analytical model", coils.compensation(par, truth), "1", better=""),
        Merit(
            "error of the table, each halving of its step", _error_ratio(curves), "1", key="table_error_ratio"
        ),
    )
    return Experiment("errors", "What do the coil models miss?", cases, found_merits, curves, interrupted=cut)


def coil_wrench(
    par: planar.Parameters, model: coils.CoilModel, current: float, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Wrench of an inner coil, ... x 6, centred at x, y at the working height, about the centre of gravity."""
    own = current * model(x, y, np.full_like(x, par.h))
    arm = np.array([par.coil_pitch / 2, par.coil_pitch / 2, par.r_z])
    own[..., 3:] += np.cross(arm, own[..., :3])
    return np.asarray(own)


def _by_step(par: planar.Parameters, truth: coils.CoilModel, current: float) -> FloatArray:
    """Largest errors of F_x and F_z, N, of a table for each of NODES, at the middles and edges of its cells."""
    found = []
    for n in NODES:
        fine = np.linspace(0, par.tau_n, 2 * n + 1)
        x, y = np.meshgrid(fine, fine, indexing="ij")
        exact = coil_wrench(par, truth, current, x, y)
        error = np.abs(coil_wrench(par, coils.table(par, truth, n), current, x, y) - exact)
        found.append(error[..., [0, 2]].max(axis=(0, 1)))
    return np.array(found)


def _error_ratio(curves: Mapping[str, FloatArray]) -> float:
    """Ratio of the errors of F_x with 10 and with 20 cells."""
    error = curves["by step"][:, 0]
    return float(error[NODES.index(10)] / error[NODES.index(20)])


def _error_merits(run: Trajectory, largest: FloatArray) -> tuple[Merit, ...]:
    """Largest errors of one coil's wrench, and the force and torque that feedback adds in a hover."""
    missed = np.abs(run.v[-1] - np.array(ca.evalf(run.plant.preload(ca.DM(run.x[-1])))).ravel())
    return (
        *(
            Merit(f"{s.name}, largest error", float(e), s.unit)
            for s, e in zip(run.plant.inputs, largest, strict=True)
        ),
        Merit("hover: force to correct", float(missed[:3].max()), "N"),
        Merit("hover: torque to correct", float(missed[3:].max()), "N m"),
    )
