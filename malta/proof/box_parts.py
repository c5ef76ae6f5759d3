"""Parts of a box with the characteristic polynomials on them; equal ones are proven once."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.proof.exclusion.exclusion import CellBounds, Growth
from malta.proof.polynomial.enclosure import Polynomial, TooWide, Unproven
from malta.proof.polynomial.family import Family

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


PATCHES = 64  # parts of a box at most


@dataclass(frozen=True, eq=False)
class Part:
    """One characteristic polynomial on one part of the box."""

    of: Polynomial
    sides: FloatArray
    family: Family
    growth: Growth
    # the family with its coupling to other groups, on cells and boxes:
    around: Callable[[FloatArray, FloatArray], CellBounds] | None = None


def cut(
    sides: FloatArray,
    nominal: FloatArray,
    until: float,
    made: Callable[[FloatArray], list[Any]],
    most: int = PATCHES,
) -> list[Any]:
    """Apply `made` to a box, or to parts of it where the box is too wide; `most` parts at most.

    Raises Unproven when the parts are too many or time is up.
    """
    todo, found = [sides], list[Any]()
    while todo:
        own = todo.pop()
        if clock.monotonic() > until:
            raise Unproven("time was up before the coefficients were found")
        try:
            found += made(own)
        except TooWide as error:
            if len(todo) + len(found) >= most:
                raise Unproven(str(error)) from error
            todo += _halves(own, error.axis, float(nominal[error.axis]))
    return found


def _halves(sides: FloatArray, axis: int, nominal: float) -> list[FloatArray]:
    """The halves of a box across one axis, cut at the nominal value if that is well inside."""
    low, high = sides[axis]
    at = (
        nominal
        if low < nominal < high and min(nominal - low, high - nominal) > 0.2 * (high - low)
        else (low + high) / 2
    )
    found = []
    for a, b in ((low, at), (at, high)):
        half = sides.copy()
        half[axis] = a, b
        found.append(half)
    return found


def merge_twins(parts: list[Part]) -> list[Part]:
    """Merge groups whose coefficients agree to rounding, as those of the two planes of a round body."""
    kept: list[Part] = []
    for part in parts:
        for k, other in enumerate(kept):
            both = _merge(other, part)
            if both is not None:
                kept[k] = both
                break
        else:
            kept.append(part)
    return kept


def _merge(one: Part, two: Part) -> Part | None:
    """A part whose radius covers both families; None when they differ by more than rounding."""
    f, g = one.family, two.family
    if one.around is not None or two.around is not None:
        return None
    if (f.shape, f.exponents, f.scale) != (
        g.shape,
        g.exponents,
        g.scale,
    ) or one.of.inverted != two.of.inverted:
        return None
    if not np.array_equal(one.sides, two.sides):
        return None
    apart = np.abs(f.values - g.values).max(axis=1)
    if not (apart <= 1e-9 * f.size()).all():
        return None
    radius = np.maximum(f.radius, g.radius + apart * (1 + 1e-9))
    return Part(one.of, one.sides, Family(f.shape, f.values, radius, f.exponents, f.scale), one.growth)
