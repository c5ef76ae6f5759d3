"""Numbers of a design file by the names of signals -> arrays in SI units, in the order of the signals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.model.plant import Signal
from malta.tables import Quantity
from malta.units import to_si

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def ordered(
    entries: Mapping[str, Any], signals: Sequence[Signal], where: Path, field: str, what: str
) -> list[Any]:
    """The entries in the order of the signals, one for each."""
    names = [s.name for s in signals]
    if set(entries) != set(names):
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
    values = ordered(entries, signals, where, field, what)
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
            for q, s in zip(ordered(entries, signals, where, field, what), signals, strict=True)
        ]
    )


def variances(
    entries: Mapping[str, Quantity], signals: Sequence[Signal], where: Path, field: str, what: str
) -> FloatArray:
    """Variances: given as such (unit squared), or as standard deviations (the signal's unit)."""
    variances = []
    for q, s in zip(ordered(entries, signals, where, field, what), signals, strict=True):
        name = f"{field}.{s.name}"
        try:
            deviation = positive(to_si(q.value, q.unit, s.unit, where, name), where, name, s.unit)
            variances.append(positive(deviation * deviation, where, name, f"({s.unit})^2"))
        except InputError as error:
            if not error.field.endswith(".unit"):
                raise
            squared = f"({s.unit})^2"
            try:
                variance = to_si(q.value, q.unit, squared, where, name)
            except InputError:
                expected = f"a unit of {s.unit} (standard deviation) or {s.unit}^2 (variance)"
                raise InputError(where, f"{name}.unit", repr(q.unit), expected) from None
            variances.append(positive(variance, where, name, squared))
    return np.array(variances)


def positive(value: float, where: Path, field: str, unit: str) -> float:
    if not 0 < value < math.inf:
        raise InputError(where, field, f"{value:g} {unit}", f"a finite number above 0 {unit}")
    return value
