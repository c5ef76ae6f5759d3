"""Imperfections of a machine and its bench that a data file takes for none, each with the size that is usual.

Of a machine whose states are (q, q'), about its linearization

    q'' = (A_q + dK) q + (A_v + dD) q' + (B + dB) (1 + g_i) i,     y = (1 + g_y) (1 + c) h(q),  behind lag and skew

have every entry of dK, dD, dB and c, so that no linear machine of as many coordinates is left out. Of other machines
gains, cross talk of readings and skews remain. Parameters of the machine and errors of its sensors that are zero, and
those that are taken as known, are imperfections too: their names come first.

Readings and currents of a log belong to the same instant; where a current is held over a sample, it is the one that
flows from there on. A skew is by how much a reading is older than its row's currents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.model.parameters import symbolic_names, twins_of, units_of

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.plant import Plant

# Prior sizes, one standard deviation. Of what is known: shares of the value by its unit.
KNOWN_SHARES = {"kg": 5e-3, "m": 2e-3, "m/s^2": 1e-3, "rad": 0.0, "N": 0.2}
KNOWN_SHARE = 0.01  # of other units
ZERO_SIZES = {"1": 5e-3, "m": 1e-4, "rad": 5e-3, "s": 2e-5}  # of a parameter that is zero, SI
TWIN_SHARE = 5e-3  # by which a parameter differs from its twin
GAIN = 4e-3  # of a sensor, of position or current
SHAPE = 3e-3  # of another error of a sensor that is a pure number
COMMON_GAIN = 3e-3  # of all sensors of a kind
CROSS_TALK = 3e-3  # of a reading by another one, as of a frame turned by 3 mrad
FORCE = 3e-3  # of the largest force on a coordinate, by any current
STIFFNESS = 5e-3  # of that between two coordinates
DAMPING = 0.02  # of that of a coordinate at its natural frequency, or in the middle of the band where that is higher
BETWEEN_SHARE = 0.25  # of it, between two coordinates
SKEW = 0.5  # samples
FRAME = 3e-3  # rad, by which the sensors' axes are turned


class Imperfection(NamedTuple):
    """A departure from the machine of the data file.

    name : as gain_x1
    unit : SI
    size : standard deviation before the log, SI
    kind : where it acts: "parameter" (of the machine, or an error of its sensors), "stiffness", "damping", "force",
        "reading", "readings", "current", "currents", "frame" or "skew"
    row, column : indices of what it acts on
    least : the smallest value that it may have, SI
    """

    name: str
    unit: str
    size: float
    kind: str = "parameter"
    row: int = 0
    column: int = 0
    least: float = -np.inf


def usual_size(plant: Plant, name: str) -> float:
    """The standard deviation of a parameter of a machine, or of an error of its sensors, before a log, SI."""
    units = units_of(plant.parameters) | {s.name: s.unit for s in plant.sensors.errors}
    value = float(getattr(plant.parameters, name, 0.0))
    if name in twins_of(plant.parameters):
        return TWIN_SHARE * abs(value)
    if value:
        return KNOWN_SHARES.get(units[name], KNOWN_SHARE) * abs(value)
    if name.startswith("gain_"):
        return GAIN
    shape = units[name] == "1" and name not in units_of(plant.parameters)  # of a sensor's signals
    return SHAPE if shape else ZERO_SIZES.get(units[name], 0.0)


def own_imperfections(plant: Plant, asked: Sequence[str], sizes: Mapping[str, float]) -> list[Imperfection]:
    """Those that have a name in the machine's record, or are errors of its sensors.

    asked : parameters that are estimated without a prior
    sizes : of those whose size is known, SI
    """
    units = units_of(plant.parameters) | {s.name: s.unit for s in plant.sensors.errors}
    names = [*symbolic_names(plant.parameters), *(s.name for s in plant.sensors.errors)]
    found = []
    for name in names:
        size = sizes.get(name, usual_size(plant, name))
        if name in asked or not size > 0:
            continue
        field = plant.parameters.__dataclass_fields__.get(name)
        limits = {} if field is None else field.metadata
        given = [limit for limit in (limits.get("above"), limits.get("at_least")) if limit is not None]
        found.append(Imperfection(name, units[name], size, least=max(given, default=-np.inf)))
    return found


def bench_units(plant: Plant) -> dict[str, str]:
    """The SI units of the imperfections of a bench that one may know: gains and skews, but not those of the machine."""
    wound = plant.actuator.windings is not None
    signals = [*plant.outputs, *(plant.drive.axes if wound else plant.actuator.coils)]
    own = {s.name for s in plant.sensors.errors}
    gains = [f"gain_{name}" for name in ("readings", "currents", *(s.name for s in signals))]
    late = ["skew", *([f"skew_{plant.stroke.name}"] if plant.has_stroke else [])]
    return {name: "1" for name in gains if name not in own} | dict.fromkeys(late, "s")


def turn(plant: Plant, a: int, b: int) -> FloatArray:
    """dq of a turn of the axes in the plane of coordinates a and b, by its angle: of places, and of angles likewise."""
    half = len(plant.controlled) // 2
    kinds = [[k for k in range(half) if plant.design_states[k].unit == unit] for unit in ("m", "rad")]
    found = np.zeros((half, half))
    for kind in kinds:
        if len(kind) > max(kinds[0].index(a), kinds[0].index(b)):
            one, other = kind[kinds[0].index(a)], kind[kinds[0].index(b)]
            found[one, other], found[other, one] = 1.0, -1.0
    return found


def disturb(
    plant: Plant,
    imperfections: Sequence[Imperfection],
    values: FloatArray,
    A: FloatArray,
    B: FloatArray,
    C: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, B and C with imperfections of the bench."""
    A, B, C, half = A.copy(), B.copy(), C.copy(), len(plant.controlled) // 2
    straight = C[:, :half].copy()
    reads, flows = np.eye(len(C)), np.eye(B.shape[1])
    for one, value in zip(imperfections, values, strict=True):
        if one.kind == "stiffness":
            A[half + one.row, one.column] += value
        elif one.kind == "damping":
            A[half + one.row, half + one.column] += value
        elif one.kind == "force":
            B[half + one.row, one.column] += value
        elif one.kind == "reading":
            reads[one.row, one.column] += value
        elif one.kind == "current":
            flows[one.row, one.column] += value
        elif one.kind == "frame":
            C[:, :half] += value * straight @ turn(plant, one.row, one.column)
        elif one.kind == "readings":
            reads += value * np.eye(len(C))
        elif one.kind == "currents":
            flows += value * np.eye(B.shape[1])
    return A, B @ flows, reads @ C


def skews(imperfections: Sequence[Imperfection], values: FloatArray, outputs: int) -> FloatArray:
    """By how much each reading is older than its row's currents, s."""
    found = np.zeros(outputs)
    for one, value in zip(imperfections, values, strict=True):
        if one.kind == "skew":
            found[slice(None) if one.row < 0 else one.row] += value
    return found
