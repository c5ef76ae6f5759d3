"""When a run has diverged, of an output that no contact of its machine bounds.

    |p - p*| >= MOST_SCALES x its scale,     or     |z| >= travel of the stroke

The scale is the largest that the experiment asks for, in multiples of each sensor's noise: the range of the reference,
the distance and the rates of the start, what loads and forces move within T, the noise itself. T is the duration, or
1 / p of a machine with an unstable pole p: a loop that holds it is faster.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.inputs import Inputs, initial_values
from malta.simulation.layout import columns_of_row
from malta.simulation.scenario import Simulation

MOST_SCALES = 1e3


@lru_cache(maxsize=64)
def free_outputs(plant: Plant) -> tuple[int, ...]:
    """The outputs that no contact bounds: none of the states that they show enters one."""
    x, u = _symbols(plant)
    contact = ca.vertcat(plant.contacts.contact(x))
    bounded: set[int] = set(ca.jacobian(contact, x).sparsity().get_triplet()[1]) if contact.numel() else set()
    rows, columns = ca.jacobian(ca.vertcat(plant.h(x, u)), x).sparsity().get_triplet()
    held = {row for row, column in zip(rows, columns, strict=True) if column in bounded}
    return tuple(k for k in range(len(plant.outputs)) if k not in held)


def strokes(plant: Plant) -> bool:
    """Whether the travel alone bounds the stroke."""
    return plant.has_stroke and plant.stroke_output in free_outputs(plant)


def rooms_of(run: Simulation, inputs: Inputs) -> FloatArray:
    """1 / the largest deviation of each free output, then 1 / travel where it bounds the stroke; SI."""
    plant, free = run.plant, list(free_outputs(run.plant))
    if not free:
        return np.zeros(0)
    scale, unit = _scales(run, inputs), plant.sensors.deviations
    unit = np.array(ca.DM(unit)).ravel() if (unit > 0).all() else np.ones(len(unit))
    most = MOST_SCALES * unit * max(1.0, (scale / unit).max())
    rooms = np.where(np.isfinite(most), 1 / most, 0.0)[free]
    travel = plant.stroke.travel
    return np.append(rooms, 1 / travel if travel > 0 else 0.0) if strokes(plant) else rooms


def used_rooms(plant: Plant, p: Any, p_ref: Any, rooms: Any) -> Any:
    """The shares of their rooms that outputs take, 1 and more: diverged. Columns of CasADi, or rows of numpy."""
    free = list(free_outputs(plant))
    if not free and not isinstance(p, np.ndarray):
        return ca.SX(0, 1)
    if isinstance(p, np.ndarray):
        used = [np.abs(p[:, free] - p_ref[:, free]), np.abs(p[:, [plant.leading_output] * strokes(plant)])]
        return np.hstack(used) * rooms
    used = [ca.fabs(p[free] - p_ref[free]), ca.fabs(p[[plant.leading_output] * strokes(plant)])]
    return ca.vertcat(*used) * rooms


def rooms_in(run: Simulation, rows: FloatArray, given: FloatArray, rooms: FloatArray) -> FloatArray:
    """`used_rooms` of the rows of a simulation and their inputs."""
    p = rows[:, columns_of_row(run.plant, run.controller, run.setup)["p"]]
    return np.asarray(used_rooms(run.plant, p, given[:, : p.shape[1]], rooms))


def _scales(run: Simulation, inputs: Inputs) -> FloatArray:
    """The largest deviation of each output that the experiment asks for; infinite where it has none that is finite."""
    plant, c, scenario, _ = run
    believed = plant_of(c.parameters)
    same = believed.states == plant.states and believed.disturbances == plant.disturbances
    machine, x = believed if same else plant, initial_values(run, inputs.given[0])[0]
    y, J, A, f, G_u, G_w = (np.asarray(value, dtype=float) for value in _motion(machine)(x))
    if not all(np.isfinite(M).all() for M in (y, J, A, f, G_u, G_w)):
        return np.full(len(y), np.inf)
    p_ref, t = inputs.motion.p, inputs.t
    T = min(float(t[-1] - t[0]), 1 / max(np.linalg.eigvals(A).real.max(), 1e-300))
    w = np.zeros(G_w.shape[1]) if scenario.disturbance is None else _largest(scenario.disturbance(t))
    u = np.zeros(G_u.shape[1]) if scenario.excitation is None else _largest(scenario.excitation(t))
    if scenario.faults:
        u = u + np.nan_to_num(np.array(c.limits.force, dtype=float), posinf=0.0)
    pushed = np.hstack([f, G_u * u, G_w * w])
    moved = (np.abs(J @ pushed) * T + np.abs(J @ A @ pushed) * T**2 / 2).sum(axis=1)
    errors = np.array([(scenario.sensor_errors or {}).get(s.name, 0.0) for s in plant.sensors.errors])
    off = np.array(ca.DM(plant.sensors.sense(ca.DM(x), ca.DM(errors)))).ravel() - y.ravel()
    start = np.abs(y.ravel() - p_ref[0]) + np.abs(off) + np.ptp(p_ref, axis=0)
    return np.asarray(start + moved + scenario.noise * plant.sensors.deviations)


def _largest(forces: Any) -> FloatArray:
    return np.asarray(np.abs(np.asarray(forces, dtype=float)).max(axis=0))


@lru_cache(maxsize=16)
def _motion(plant: Plant) -> Any:
    """x -> outputs, their slopes, and x' with its slopes in x, inputs and disturbances, at currents that are held."""
    x, u = _symbols(plant)
    kind = type(x)
    w, i = kind.sym("w", len(plant.disturbances)), kind.sym("i", len(plant.actuator.coils))
    y = ca.densify(plant.h(x, kind.zeros(len(plant.inputs))))
    rate = plant.f(x, plant.actuator.forces(x, i) + u, w + plant.load(x))
    found = [rate, *(ca.jacobian(rate, one) for one in (x, u, w))]
    held = plant.actuator.currents(y, kind.zeros(len(plant.inputs)))
    values = [kind.zeros(len(plant.inputs)), kind.zeros(len(plant.disturbances)), ca.densify(held)]
    f, A, G_u, G_w = ca.substitute(found, [u, w, i], values)
    outputs = [y, ca.jacobian(y, x), A, f, G_u, G_w]
    return ca.Function("motion", [x], [ca.densify(one) for one in outputs])


def _symbols(plant: Plant) -> tuple[Any, Any]:
    """Symbols of the states and the inputs."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    return kind.sym("x", len(plant.states)), kind.sym("u", len(plant.inputs))
