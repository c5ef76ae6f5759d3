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

from malta.arrays import FloatArray, readonly
from malta.errors import CheckError, InputError, require_known
from malta.linear.matrices import system_matrix
from malta.model.plant import Plant, Signal
from malta.tables import Quantity, Record, entry
from malta.units import is_unit_of, to_si, units_like

# The answer of a sampled loop to a constant load: s+ = M s + g w, y = C s, w a unit step on one load at a time.
#
# The grid of times is every sample at first, and then coarser by a factor of two from octave to octave: the largest
# deviation of a fast mode and the tail of a slow one cost the same few products of matrices.


BLOCK = 64  # times that one product of matrices gives
BLOCKS = 32  # in an octave
SETTLED_SHARE = 1e-9  # share of the largest deviation: what is left at the end of the grid
MAX_OCTAVES = 44  # octaves at most, where a pole is next to 1


@dataclass(frozen=True, eq=False)
class StepResponse:
    """Outputs after a unit step of each load at t = 0.

    t : s, k times;  y : k x p outputs x w loads;  final : p x w, what y ends at
    """

    t: FloatArray
    y: FloatArray
    final: FloatArray

    def __post_init__(self) -> None:
        for name in ("t", "y", "final"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    def of(self, sizes: FloatArray) -> StepResponse:
        """Return the answer to loads of these sizes at the same time: w numbers, and one load is left."""
        return StepResponse(self.t, (self.y @ sizes)[..., None], (self.final @ sizes)[..., None])

    @property
    def largest(self) -> FloatArray:
        """The largest |y|, p x w."""
        return np.asarray(np.abs(self.y).max(axis=0))

    def left(self, after: float) -> FloatArray:
        """The largest |y| from a time on, s; p x w. A swing through zero at that very time does not hide it."""
        later = self.t >= after * (1 - 1e-12)
        rest = np.abs(self.y[later]).max(axis=0) if later.any() else np.zeros_like(self.final)
        return np.asarray(np.maximum(rest, np.abs(self.final)))

    def within(self, share: float) -> FloatArray:
        """The time, s, from which |y| stays within a share of its largest; p x w, infinite where it never does."""
        bound = share * self.largest
        outside = np.abs(self.y) > bound
        last = len(self.t) - 1 - outside[::-1].argmax(axis=0)
        after = self.t[np.minimum(last + 1, len(self.t) - 1)]
        times = np.where(outside.any(axis=0), after, 0.0)
        return np.where(np.abs(self.final) > bound, math.inf, times)


def step_response(M: FloatArray, g: FloatArray, C: FloatArray, Ts: float) -> StepResponse:
    """Compute the answer of a stable sampled loop to unit steps, until nothing of it changes.

    M : n x n;  g : n x w, what a load that acts throughout a sample leaves in the states;  C : p x n;  Ts : s
    Raises CheckError for a loop that is not stable.

    >>> import numpy as np
    >>> step_response(
    ...     np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), 1e-3
    ... ).final.tolist()
    [[2.0]]
    """
    n, w = g.shape
    radius = float(np.abs(np.linalg.eigvals(M)).max(initial=0.0))
    if not radius < 1:
        raise CheckError(f"an unstable loop, |lambda| = {radius:.6f}, has no answer to a constant load")
    step = system_matrix(M, g, None, np.eye(w))
    out = np.hstack([C, np.zeros((len(C), w))])
    samples = math.log(SETTLED_SHARE) / math.log(max(radius, 1e-3))
    octaves = min(1 + max(math.ceil(math.log2(samples / (BLOCK * BLOCKS))), 0), MAX_OCTAVES)
    state, stride, k = np.vstack([np.zeros((n, w)), np.eye(w)]), 1, 0
    times: list[FloatArray] = []
    found: list[FloatArray] = []
    for octave in range(octaves):
        if octave > 1:
            step, stride = step @ step, 2 * stride
        reading, far = _ahead(out, step)
        for _ in range(BLOCKS):
            found.append((reading @ state).reshape(BLOCK, len(C), w))
            times.append((k + stride * np.arange(BLOCK)) * Ts)
            state, k = far @ state, k + stride * BLOCK
    final = C @ np.linalg.solve(np.eye(n) - M, g)
    return StepResponse(np.concatenate(times), np.concatenate(found), final)


def _ahead(out: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """[C; C M; ...; C M^(BLOCK - 1)] by doubling, and M^BLOCK."""
    rows, power = out, step
    while len(rows) < BLOCK * len(out):
        rows, power = np.vstack([rows, rows @ power]), power @ power
    return rows, power


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
