"""What laws and simulations take of readings: none of u in them, 0 at rest, positions that they give back."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.plant import Plant, has_feedthrough
from malta.model.traced import trace

MIN_SHARE = 1e-6  # of the largest change of a row: smaller ones are rounding
RATE = 100.0  # 1/s, from the step of a position to that of its rate


class Observation(NamedTuple):
    """What was found of a part of a machine, what to have there, and whether nothing is proven because of it."""

    part: str
    found: str
    change: str
    unproven: bool = False

    def __str__(self) -> str:
        return f"{self.part}: {self.found}: {self.change}"


@lru_cache(maxsize=64)
def require_readings(plant: Plant) -> None:
    """Raise InputError for readings that laws and simulations do not have: see `sensor_rows`."""
    for row in sensor_rows(plant):
        raise InputError(plant.name, row.part, row.found, row.change)


def sensor_rows(plant: Plant) -> list[Observation]:
    """Readings that follow u at once, that are not 0 at 0, and positions that readings do not give back."""
    if has_feedthrough(plant):
        change = "h(x) of states alone; a current that a sensor sees is a state"
        return [Observation("h", "y follows u at once", change, True)]
    q, moved = list(plant.controlled)[: plant.coordinates or None], np.zeros(len(plant.states))
    moved[q] = 1e-3 * rooms_of(plant)[q] * np.cos(np.arange(1, len(q) + 1))
    zero, y = read_outputs(plant, 0 * moved, moved)
    if not np.isfinite([zero, y]).all():
        return []
    off = np.abs(zero) > MIN_SHARE * np.maximum(np.abs(y - zero).max(), np.abs(zero))
    for signal, value in ((s, v) for s, v, is_off in zip(plant.outputs, zero, off, strict=True) if is_off):
        found = f"h(0) is {value:.4g} {signal.unit} of {signal.name}"
        return [Observation("h", found, "h(x) without it: laws take y = 0 at x = 0", True)]
    (again,) = read_outputs(plant, _place(plant, y))  # of a state at rest
    (twice,) = read_outputs(plant, _place(plant, again))
    k = int(np.abs(twice - again).argmax())
    if abs(twice - again)[k] > MIN_SHARE * np.abs(again).max():
        signal = plant.outputs[k]
        found = f"h(position_of(y)) is {twice[k]:.4g} where {signal.name} is {again[k]:.4g} {signal.unit}"
        return [Observation("position_of", found, "the inverse of h at rest", True)]
    return []


def read_outputs(plant: Plant, *x: FloatArray) -> FloatArray:
    """The readings at rest at some states, a row for each."""
    return np.asarray(trace(_readings, plant).each(np.array(x))[0].T)


def _readings(plant: Plant, _: None) -> tuple[list[Any], list[Any]]:
    x, u = symbols_of(plant)[:2]
    return [x], [ca.densify(ca.vertcat(plant.h(x, type(x).zeros(u.numel()))))]


def _place(plant: Plant, y: FloatArray) -> FloatArray:
    """The states at rest for readings."""
    position = np.array(ca.DM(plant.position_of(ca.DM(y))), dtype=float).ravel()
    x = np.zeros(len(plant.states))
    x[list(plant.controlled[: len(position)])] = position
    return x


@lru_cache(maxsize=64)
def rooms_of(plant: Plant) -> FloatArray:
    """How far each state may go, SI, to a factor of 2: to the first contact, else 1e-3; rates by RATE."""
    n, far = len(plant.states), 2.0 ** np.arange(-30, 21)
    rooms = np.full(n, 1e-3)
    if plant.contacts.names:
        places = np.vstack([s * np.eye(n)[k] for k in range(n) for s in far])
        touched = trace(_contact, plant).each(places)[0].max(axis=0).reshape(n, -1) >= 1
        inside = ~touched[:, 0] & touched.any(axis=1)
        rooms[inside] = far[touched.argmax(axis=1)[inside] - 1]
    if plant.second_order:
        rooms[n // 2 :] = RATE * rooms[: n // 2]
    return rooms


def _contact(plant: Plant, _: None) -> tuple[list[Any], list[Any]]:
    x = symbols_of(plant)[0]
    return [x], [ca.densify(ca.vertcat(plant.contacts.contact(x)))]


def symbols_of(plant: Plant) -> list[Any]:
    """Symbols of states, inputs, disturbances and coil currents."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    sizes = (len(plant.states), len(plant.inputs), len(plant.disturbances), len(plant.actuator.coils))
    return [kind.sym(name, size) for name, size in zip("xuwi", sizes, strict=True)]
