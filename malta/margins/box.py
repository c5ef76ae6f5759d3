"""Boxes of parameters: what grows with the margin t, and what stays."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import InputError

if TYPE_CHECKING:
    from malta.plant import FloatArray


@dataclass(frozen=True, eq=False)
class Box:
    """Nominal values and how far each grows downwards and upwards with t; `over` stays."""

    names: tuple[str, ...]
    nominal: FloatArray
    down: FloatArray
    up: FloatArray
    over: FloatArray  # names x 2: added to nominal, whatever t
    most: float  # t at which a parameter leaves what it can be
    frame: Mapping[int, tuple[float, float]] = field(
        default_factory=dict
    )  # by index: an interval around `over`

    def sides(self, t: float) -> FloatArray:
        """Low and high of every parameter: names x 2."""
        return np.column_stack([self.nominal - t * self.down, self.nominal + t * self.up]) + self.over

    def framed(self, t: float) -> FloatArray:
        """`sides`, those of the frame as wide as that: what several boxes have in common."""
        sides = self.sides(t)
        for i, interval in self.frame.items():
            sides[i] = interval
        return sides

    def standing(self) -> FloatArray:
        """Nominal values, at both ends and the middle of everything that stays; the nominal ones first."""
        sides = (np.unique([0.0, low, (low + high) / 2, high]) for low, high in self.over)
        places = np.array(list(itertools.islice(itertools.product(*sides), 4096)))
        order = np.argsort(np.abs(places).sum(axis=1), kind="stable")
        return np.asarray(self.nominal + places[order])

    def stretched(self, p: FloatArray, share: float) -> FloatArray:
        """Parameters that deviate `share` times as far, those that stay as they are."""
        return np.where(self.down + self.up > 0, self.nominal + share * (p - self.nominal), p)


def box_of(
    names: tuple[str, ...],
    at: FloatArray,
    limits: Sequence[tuple[float, float]],
    ranges: Mapping[str, float | tuple[float, float]],
    over: Mapping[str, tuple[float, float]],
    *,
    empty: bool = False,
) -> Box:
    """The box of ranges (that grow) and of intervals that stay, about the nominal values `at`.

    empty : whether there may be no ranges at all

    Raises InputError for names that are not known and ranges that are none.
    """
    k = len(names)
    down, up, fixed = np.zeros(k), np.zeros(k), np.zeros((k, 2))
    most = math.inf
    for name, value in (*ranges.items(), *over.items()):
        if name not in names:
            raise InputError("robust_margin", name, "an unknown parameter", "one of " + " ".join(names))
        i = names.index(name)
        nominal = float(at[i])
        pair = (
            value
            if isinstance(value, tuple)
            else (nominal - abs(nominal) * value, nominal + abs(nominal) * value)
        )
        sound = len(pair) == 2 and all(math.isfinite(v) for v in pair) and pair[0] <= nominal <= pair[1]
        if not sound or pair[0] == pair[1] or (not isinstance(value, tuple) and not value > 0):
            raise InputError(
                "robust_margin",
                name,
                repr(value),
                f"a share above 0, or (low, high) about the nominal {nominal:g}",
            )
        if name in ranges and name in over:
            raise InputError("robust_margin", name, "in ranges and in over", "in one of them")
        low, high = limits[i] if limits else (-math.inf, math.inf)
        if not low < nominal < high or (name in over and not low < pair[0] < pair[1] < high):
            raise InputError(
                "robust_margin", name, f"{pair}", f"values within its limits ({low:g}, {high:g})"
            )
        if name in over:
            fixed[i] = pair[0] - nominal, pair[1] - nominal
            continue
        down[i], up[i] = nominal - pair[0], pair[1] - nominal
        for room, rate in ((nominal - low, down[i]), (high - nominal, up[i])):
            most = min(most, room / rate) if rate > 0 else most
    if not ranges and not empty:
        raise InputError("robust_margin", "ranges", "no parameters", "at least one uncertain parameter")
    return Box(names, at, down, up, fixed, most)
