"""[specification.recovery]: how far a constant load from outside may move a machine, and what may be left of it.

[specification.recovery.F_x]                  # the name of a disturbance: 1 N or 1 N m of it
largest = { value = 9, unit = "um" }          # of every output that has such a unit
left = [{ value = 0.5, unit = "um", after = { value = 0.1, unit = "s" } }]

[specification.recovery.F_x.anywhere]         # the same anywhere in the travel
largest = { value = 10, unit = "um" }

[specification.recovery.bearing]              # any other name: a load at a point is forces and torques together
load = { F_x = { value = 1, unit = "N" }, T_y = { value = -45, unit = "mN m" } }
load_slope = { T_y = { value = -1, unit = "N m / m" } }   # with the stroke: the point stays, the machine moves
outputs = ["x1", "x2"]                        # these alone
largest = { value = 11, unit = "um" }
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, StrictStr

from malta.arrays import FloatArray
from malta.errors import InputError, require_known
from malta.model.plant import Plant, Signal
from malta.tables import Quantity, Record, entry
from malta.units import is_unit_of, to_si, units_like

# Numbers of a design file by the names of signals -> arrays in SI units, in the order of the signals.


def order_entries(
    entries: Mapping[str, Any], signals: Sequence[Signal], where: Path, field: str, what: str
) -> list[Any]:
    """The entries in the order of the signals, one for each."""
    names = [s.name for s in signals]
    require_known(entries, names, where, f"{field}.{{}}", f"none of the {len(names)} {what}")
    if len(entries) < len(names):
        raise InputError(
            where,
            field,
            f"{len(entries)} entries ({' '.join(entries)})",
            f"one for each of the {len(names)} {what} ({' '.join(names)})",
        )
    return [entries[name] for name in names]


def numbers(
    entries: Mapping[str, float],
    signals: Sequence[Signal],
    where: Path,
    field: str,
    what: str,
    *,
    above: bool = False,
) -> FloatArray:
    values = order_entries(entries, signals, where, field, what)
    for signal, value in zip(signals, values, strict=True):
        if value < 0 or (above and value == 0):
            wanted = "a number above 0" if above else "a number of at least 0"
            raise InputError(where, f"{field}.{signal.name}", f"{value:g}", wanted)
    return np.array(values, dtype=float)


def bases(
    entries: Mapping[str, Quantity] | None, signals: Sequence[Signal], where: Path, field: str, what: str
) -> FloatArray:
    """Bases by name; one SI unit each where the file says "SI"."""
    if entries is None:
        return np.ones(len(signals))
    return np.array(
        [
            positive(
                to_si(q.value, q.unit, s.unit, where, f"{field}.{s.name}"), where, f"{field}.{s.name}", s.unit
            )
            for q, s in zip(order_entries(entries, signals, where, field, what), signals, strict=True)
        ]
    )


def variances(
    entries: Mapping[str, Quantity], signals: Sequence[Signal], where: Path, field: str, what: str
) -> FloatArray:
    """Variances: given as such (unit squared), or as standard deviations (the signal's unit)."""
    variances = []
    for q, s in zip(order_entries(entries, signals, where, field, what), signals, strict=True):
        name = f"{field}.{s.name}"
        squared = f"({s.unit})^2"
        if is_unit_of(q.unit, s.unit):
            deviation = positive(to_si(q.value, q.unit, s.unit, where, name), where, name, s.unit)
            variance = deviation * deviation
        elif is_unit_of(q.unit, squared):
            variance = to_si(q.value, q.unit, squared, where, name)
        else:
            expected = f"a unit of {s.unit} (standard deviation) or {s.unit}^2 (variance)"
            raise InputError(where, f"{name}.unit", repr(q.unit), expected, units_like(q.unit, s.unit))
        variances.append(positive(variance, where, name, squared))
    return np.array(variances)


def quantities(
    entries: Mapping[str, Quantity], units: Mapping[str, str], where: Path, field: str, what: str
) -> dict[str, float]:
    """Quantities in SI, by names that have these units. Raises InputError for others; what: the names are of."""
    require_known(entries, units, where, f"{field}.{{}}", f"an unknown {what}")
    return {
        name: to_si(q.value, q.unit, units[name], where, f"{field}.{name}") for name, q in entries.items()
    }


def positive(value: float, where: Path, field: str, unit: str) -> float:
    if not 0 < value < math.inf:
        raise InputError(where, field, f"{value:g} {unit}", f"a finite number above 0 {unit}")
    return value


class LeftTable(Quantity):
    """An entry of `left`: a bound, and from when on it holds."""

    after: Quantity = entry("time after which the bound holds")


class BoundsTable(Record):
    """[specification.recovery.NAME.anywhere]: bounds of the deviation."""

    largest: Quantity | None = entry("largest deviation", default=None)
    left: list[LeftTable] = entry("deviations that are left after some time", default=[])


class RecoveryTable(BoundsTable):
    """[specification.recovery.NAME]: a load, and what it may do."""

    load: Annotated[dict[StrictStr, Quantity], Field(min_length=1)] | None = entry(
        "forces and torques by disturbance; without it, 1 of the disturbance that the table is named after",
        default=None,
    )
    load_slope: dict[StrictStr, Quantity] = entry("change of the load along the stroke", default={})
    outputs: Annotated[list[StrictStr], Field(min_length=1)] | None = entry(
        "outputs that are bounded; without it, all of the unit", default=None
    )
    anywhere: BoundsTable | None = entry("bounds anywhere in the travel", default=None)


@dataclass(frozen=True)
class RecoveryBound:
    """A bound of what a constant load from outside does to some outputs."""

    name: str  # as "F_x left 0.1 s anywhere"
    load: tuple[float, ...]  # N or N m, of each of the plant's disturbances
    slope: tuple[float, ...]  # N / m or N m / m, what they change by with the stroke
    after: float | None  # s, the largest deviation from then on; None: the largest at all
    anywhere: bool  # in the travel; else at the operating point
    outputs: tuple[str, ...]  # each of these
    unit: str  # of the bound and the outputs, SI
    limit: float

    def load_at(self, position: float) -> FloatArray:
        """The load at a position of the stroke, m: a number for each disturbance."""
        return np.array(self.load) + position * np.array(self.slope)


def recovery_bounds(
    given: Mapping[str, RecoveryTable], plant: Plant, path: Path, field: str
) -> list[RecoveryBound]:
    """Read the tables of [specification.recovery], in SI units.

    Raises InputError for an unknown disturbance or output, a bound in a unit of no output, nothing to bound, and
    bounds in the travel of a machine without a stroke.
    """
    return [
        bound
        for name, table in given.items()
        for bound in _bounds_of(name, table, plant, path, f"{field}.{name}")
    ]


def _bounds_of(
    name: str, table: RecoveryTable, plant: Plant, path: Path, field: str
) -> Iterator[RecoveryBound]:
    """The bounds of one load."""
    if not re.fullmatch(r"\S+", name):
        raise InputError(path, field, repr(name), "a name without spaces")
    load, slope = _load(name, table, plant, path, field)
    signals = _outputs(table, plant, path, field)
    if table.anywhere is not None and not plant.has_stroke:
        raise InputError(path, f"{field}.anywhere", f"a {plant.name}", "a machine with a stroke")
    tables: list[tuple[BoundsTable, str, bool]] = [(table, field, False)]
    tables += [] if table.anywhere is None else [(table.anywhere, f"{field}.anywhere", True)]
    for bounds, where, anywhere in tables:
        if bounds.largest is None and not bounds.left:
            raise InputError(path, where, "nothing to bound", "largest, left or both")
        for quantity, after, at in _entries(bounds, path, where):
            unit = _unit(quantity, signals, path, at)
            limit = positive(to_si(quantity.value, quantity.unit, unit, path, at), path, at, unit)
            words = [name, "largest" if after is None else f"left {after:g} s", *["anywhere"] * anywhere]
            bounded = tuple(s.name for s in signals if s.unit == unit)
            yield RecoveryBound(" ".join(words), load, slope, after, anywhere, bounded, unit, limit)


def _entries(bounds: BoundsTable, path: Path, field: str) -> Iterator[tuple[Quantity, float | None, str]]:
    """Each bound with the time, s, from when on it holds, and its place in the file."""
    if bounds.largest is not None:
        yield bounds.largest, None, f"{field}.largest"
    for k, left in enumerate(bounds.left):
        at = f"{field}.left[{k}]"
        after = to_si(left.after.value, left.after.unit, "s", path, f"{at}.after")
        yield left, positive(after, path, f"{at}.after", "s"), at


def _load(
    name: str, table: RecoveryTable, plant: Plant, path: Path, field: str
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The load by disturbance, that of the table or 1 of the disturbance whose name it has; and its slope."""
    units = {s.name: s.unit for s in plant.disturbances}
    if table.load_slope and not plant.has_stroke:
        raise InputError(path, f"{field}.load_slope", f"a {plant.name}", "a machine with a stroke")
    per_stroke = {disturbance: f"({unit}) / m" for disturbance, unit in units.items()}
    slope = _by_disturbance(table.load_slope, per_stroke, path, f"{field}.load_slope")
    if table.load is not None:
        load = _by_disturbance(table.load, units, path, f"{field}.load")
        if not any(load):
            raise InputError(path, f"{field}.load", "nothing but zeros", "a load")
        return load, slope
    if name not in units:
        known = " ".join(units) or "none"
        expected = f"a load, or the name of a disturbance: {known}"
        raise InputError(path, f"{field}.load", f"nothing, and {name!r}", expected, units)
    return tuple(float(disturbance == name) for disturbance in units), slope


def _by_disturbance(
    given: Mapping[str, Quantity], units: Mapping[str, str], path: Path, field: str
) -> tuple[float, ...]:
    """A number for each disturbance, in these units; zero for those that are not given."""
    sizes = quantities(given, units, path, field, "disturbance")
    return tuple(sizes.get(disturbance, 0.0) for disturbance in units)


def _outputs(table: RecoveryTable, plant: Plant, path: Path, field: str) -> Sequence[Signal]:
    """The outputs that are bounded."""
    known = {s.name: s for s in plant.outputs}
    require_known(table.outputs or (), known, path, f"{field}.outputs")
    return [known[name] for name in table.outputs or known]


def _unit(quantity: Quantity, signals: Sequence[Signal], path: Path, field: str) -> str:
    """The SI unit of the outputs that a bound is of: the one that its own unit converts to."""
    units = list(dict.fromkeys(s.unit for s in signals))
    unit = next((one for one in units if is_unit_of(quantity.unit, one)), units[-1])
    to_si(1.0, quantity.unit, unit, path, field)
    return unit
