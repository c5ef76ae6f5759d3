"""Where a singular value falls below a level, for the first time or the last."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.linear.peaks import (
    MIN_SINGULAR_VALUE,
    false_position,
    joined_channels,
    level_frequencies,
    part_of,
    response_at,
)
from malta.linear.system import System


class Fall(NamedTuple):
    """What is asked of a singular value: where it falls below a level for the first or the last time."""

    rank: int  # of the singular value, 0 the largest
    last: bool


def fall_frequencies(system: System, level: float, asked: Sequence[Fall]) -> list[float]:
    """The frequencies at which singular values of a square G, in balanced units, fall below a level.

    0 where one never reaches the level, infinite where it never falls below.
    """

    parts = [part_of(system, own, own) for own in joined_channels(system, range(len(system.C)))]

    def sizes(w: FloatArray) -> FloatArray:
        each = [np.linalg.svd(response_at(part, w), compute_uv=False) for part in parts]
        found = -np.sort(-np.concatenate(each, axis=1), axis=1)
        return np.asarray(np.log(np.maximum(found, MIN_SINGULAR_VALUE) / level))

    c = np.sort(np.concatenate([level_frequencies(part, level) for part in parts]))
    c = c[c > 0]
    w = np.concatenate([c[:1] / 2, np.sqrt(c[1:] * c[:-1]), 2 * c[-1:]]) if len(c) else np.ones(1)
    above = sizes(w)
    return [_fall(sizes, w, above, one) for one in asked]


def _fall(sizes: Callable[[FloatArray], FloatArray], w: FloatArray, above: FloatArray, one: Fall) -> float:
    mine = above[:, one.rank]
    falls = np.flatnonzero((mine[:-1] >= 0) & (mine[1:] < 0))
    if not len(falls):
        return math.inf if mine[-1] >= 0 else 0.0
    k = falls[[-1 if one.last else 0]]
    low, high = (w[k], mine[k]), (w[k + 1], mine[k + 1])
    return float(false_position(lambda x: sizes(x)[:, one.rank], low, high)[0])
