"""Boxes of parameters: ranges that grow with the margin t, and intervals that do not."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.margins.arguments import (
    LARGEST,
    by_name,
    describe,
    is_number,
    is_pair,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


FAR = 1e2  # search limit, in multiples of the modelled box
EDGE = 1e-4  # relative distance of the search from the limits of parameters


def smallest_t(p: FloatArray, nominal: FloatArray, down: FloatArray, up: FloatArray) -> FloatArray:
    """The smallest t with nominal - t down <= p <= nominal + t up on the axes that grow: ... x P -> ..."""
    moved = p - nominal
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(moved > 0, moved / up, np.where(moved < 0, -moved / down, 0))
    return np.asarray(np.where(down + up > 0, t, 0).max(axis=-1, initial=0.0))


@dataclass(frozen=True, eq=False)
class Box:
    """Nominal values, how far each parameter moves down and up per unit of t, and intervals that do not grow."""

    names: tuple[str, ...]
    nominal: FloatArray
    down: FloatArray
    up: FloatArray
    over: FloatArray  # P x 2, intervals that do not grow, relative to nominal
    most: float  # t at which a parameter reaches its limit
    frame: Mapping[int, tuple[float, float]] = field(
        default_factory=dict
    )  # by index: an interval around `over`, shared by several boxes
    ends: str = ""  # what happens at `most`

    @property
    def limit(self) -> float:
        """The largest t that a search tries: close to the limit of a parameter, FAR at most."""
        return min(self.most * (1 - EDGE), FAR)

    @property
    def searched(self) -> str:
        """How far a search goes, in words."""
        if self.most * (1 - EDGE) > FAR:
            return f"up to t = {FAR:g}"
        return f"up to t = {self.most:.4g}, where {self.ends}"

    def margin(self, p: FloatArray) -> FloatArray:
        """The smallest t with p in box(t): ... -> ..."""
        return smallest_t(p, self.nominal, self.down, self.up)

    def sides(self, t: float) -> FloatArray:
        """The ends (low, high) of every parameter in box(t): P x 2."""
        return np.column_stack([self.nominal - t * self.down, self.nominal + t * self.up]) + self.over

    def frame_sides(self, t: float) -> FloatArray:
        """The sides of box(t) with those of the frame in place of the own ones: equal for several boxes."""
        sides = self.sides(t)
        for i, interval in self.frame.items():
            sides[i] = interval
        return sides

    def nominal_places(self) -> FloatArray:
        """The nominal values at the ends and the middle of the intervals that do not grow; rows, nominal first."""
        sides = (np.unique([0.0, low, (low + high) / 2, high]) for low, high in self.over)
        places = np.array(list(itertools.islice(itertools.product(*sides), 4096)))
        order = np.argsort(np.abs(places).sum(axis=1), kind="stable")
        return np.asarray(self.nominal + places[order])

    def stretch(self, p: FloatArray, share: float) -> FloatArray:
        """The parameters p with `share` times their deviation on the axes that grow."""
        return np.where(self.down + self.up > 0, self.nominal + share * (p - self.nominal), p)


def box_of(
    names: tuple[str, ...],
    at: FloatArray,
    limits: Sequence[tuple[float, float]],
    ranges: Mapping[str, float | tuple[float, float] | list[float]],
    over: Mapping[str, tuple[float, float]],
    *,
    empty: bool = False,
    caller: str = "robust_margin",
) -> Box:
    """The box of ranges that grow with t and of intervals `over` that do not, about the nominal values `at`.

    empty : whether `ranges` may be empty
    caller : the function that an error names

    Raises InputError for unknown names and invalid ranges.
    """
    by_name(caller, "ranges", ranges, '{"k": 0.2} or {"k": (1, 2)}')
    by_name(caller, "over", over, '{"k": (1, 2)}')
    k = len(names)
    down, up, fixed = np.zeros(k), np.zeros(k), np.zeros((k, 2))
    most, ends = math.inf, ""
    for name, value in (*ranges.items(), *over.items()):
        if name not in names:
            raise InputError(caller, name, "an unknown parameter", "one of " + " ".join(names))
        if name in ranges and name in over:
            raise InputError(caller, name, "in ranges and in over", "in one of them")
        i = names.index(name)
        nominal = float(at[i])
        pair = _sides(caller, name, value, nominal)
        low, high = limits[i] if limits else (-math.inf, math.inf)
        if not low < nominal < high or (name in over and not low < pair[0] < pair[1] < high):
            raise InputError(caller, name, f"{pair}", f"values within its limits ({low:g}, {high:g})")
        if name in over:
            fixed[i] = pair[0] - nominal, pair[1] - nominal
            continue
        down[i], up[i] = nominal - pair[0], pair[1] - nominal
        for limit, rate in ((low, down[i]), (high, up[i])):
            if rate > 0 and abs(limit - nominal) / rate < most:
                most, ends = abs(limit - nominal) / rate, f"{name} reaches its limit {limit:g}"
    if not ranges and not empty:
        raise InputError(caller, "ranges", "no parameters", "at least one uncertain parameter")
    return Box(names, at, down, up, fixed, most, ends=ends)


def _sides(caller: str, name: str, value: Any, nominal: float) -> tuple[float, float]:
    """(low, high) of a range about the nominal value: a share of that, or an interval. Raises InputError."""
    low = high = math.nan
    if is_pair(value) and all(is_number(v) for v in value):
        low, high = (float(v) for v in value)
    elif is_number(value) and value > 0:
        low, high = nominal - abs(nominal) * float(value), nominal + abs(nominal) * float(value)
    if not (low <= nominal <= high and low < high):
        wanted = f"a share above 0, or (low, high) about the nominal {nominal:g}"
        raise InputError(caller, name, describe(value), wanted)
    if max(-low, high) > LARGEST:
        raise InputError(caller, name, describe(value), f"values between -{LARGEST:g} and {LARGEST:g}")
    return low, high
