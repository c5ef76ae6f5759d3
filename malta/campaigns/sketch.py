"""Sketches: the distribution of a figure over any number of runs, in memory that does not grow with them.

Up to EXACT values a sketch keeps all. Beyond them it counts: a bucket has the numbers that agree in sign, exponent and
the first BITS bits of the mantissa, so a bucket is at most 2**-BITS of its numbers wide, and its middle is within
ACCURACY = 2**-(BITS + 1) of each of them. Counts of two sketches add, and the number of values alone decides whether
they are counted: what is merged in whatever order is the same to the bit.

    values of a block -> sketch_of -> merge -> quantiles, histogram

Source: C. Masson, J. E. Rim, H. K. Lee, DDSketch, Proc. VLDB 12(12), 2019: quantiles of a relative accuracy from counts
that add. Its buckets are powers of a base; these are read from the bits of a number, so that no logarithm is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

EXACT = 100_000  # values that a sketch keeps as they are
BITS = 13  # of the mantissa that name a bucket; a power of two of values takes 2**BITS counts, 64 KB
ACCURACY = 2.0 ** -(BITS + 1)  # relative, of a quantile of counted values


@dataclass(frozen=True, eq=False)
class Sketch:
    """The distribution of some finite values."""

    count: int = 0
    smallest: float = math.inf
    largest: float = -math.inf
    values: tuple[FloatArray, ...] = ()  # all of them, in any order, while they are at most EXACT
    counts: Mapping[int, NDArray[np.int64]] = field(
        default_factory=dict
    )  # sign and exponent -> count of each bucket

    @property
    def exact(self) -> bool:
        """Whether quantiles are those of the values; else they are within ACCURACY of them."""
        return self.count <= EXACT


def sketch_of(values: FloatArray) -> Sketch:
    """The sketch of some finite values."""
    if not len(values):
        return Sketch()
    values = (
        np.asarray(values, dtype=float) + 0.0
    )  # -0.0 is 0.0: of the two, sorting and merging may find either
    return _count_if_many(Sketch(len(values), float(values.min()), float(values.max()), (values,)))


def merge(one: Sketch, other: Sketch) -> Sketch:
    """The sketch of the values of two sketches.

    >>> quantiles(merge(sketch_of(np.array([1.0, 2.0])), sketch_of(np.array([9.0]))), [0.5]).tolist()
    [2.0]
    """
    return _count_if_many(
        Sketch(
            one.count + other.count,
            min(one.smallest, other.smallest),
            max(one.largest, other.largest),
            one.values + other.values,
            _add_counts(one.counts, other.counts),
        )
    )


def _count_if_many(sketch: Sketch) -> Sketch:
    """The same sketch, its values counted where they are too many."""
    if sketch.exact or not sketch.values:
        return sketch
    counts = _add_counts(sketch.counts, _count(sketch.values))
    return Sketch(sketch.count, sketch.smallest, sketch.largest, (), counts)


def _add_counts(
    one: Mapping[int, NDArray[np.int64]], other: Mapping[int, NDArray[np.int64]]
) -> Mapping[int, NDArray[np.int64]]:
    return {**one, **{k: one[k] + new if k in one else new for k, new in other.items()}}


def _count(parts: Iterable[FloatArray]) -> dict[int, NDArray[np.int64]]:
    """The counts of values: magnitudes by the bits of their numbers, those of negative numbers in reverse."""
    values = np.concatenate([*parts])
    magnitudes = (np.abs(values).view(np.int64)) >> (52 - BITS)
    buckets = np.where(values < 0, ~magnitudes, magnitudes)
    exponents, places = buckets >> BITS, buckets & (2**BITS - 1)
    return {
        int(k): np.bincount(places[exponents == k], minlength=2**BITS).astype(np.int64)
        for k in np.unique(exponents)
    }


def quantiles(sketch: Sketch, shares: Sequence[float]) -> FloatArray:
    """The values below which these shares of the values lie, between neighbours linear, as numpy.quantile has them."""
    if not sketch.count:
        return np.full(len(shares), np.nan)
    if sketch.exact:
        return np.asarray(np.quantile(np.concatenate(sketch.values), shares))
    low, high, counts = _buckets(sketch)
    middles, below = (low + high) / 2, np.cumsum(counts)
    rank = np.asarray(shares) * (sketch.count - 1)
    first = np.floor(rank)
    at, after = (middles[np.searchsorted(below, k, side="right")] for k in (first, np.ceil(rank)))
    found = at + (rank - first) * (after - at)
    ends = np.where(rank <= 0, sketch.smallest, np.where(rank >= sketch.count - 1, sketch.largest, found))
    return np.asarray(ends)


def histogram(sketch: Sketch, edges: FloatArray) -> FloatArray:
    """How many values lie between each pair of edges; values of one bucket are spread over it evenly."""
    if not sketch.count:
        return np.zeros(len(edges) - 1)
    if sketch.exact:
        return np.histogram(np.concatenate(sketch.values), edges)[0].astype(float)
    low, high, counts = _buckets(sketch)
    below = np.concatenate([[0], np.cumsum(counts)]).astype(float)
    at = np.stack([low, high], axis=1).ravel()
    return np.diff(np.interp(edges, at, np.stack([below[:-1], below[1:]], axis=1).ravel()))


def _buckets(sketch: Sketch) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Lower and upper end of each bucket that has values, within those of all values, and its count; ascending."""
    exponents = sorted(sketch.counts)
    counts = np.concatenate([sketch.counts[k] for k in exponents])
    buckets = (np.array(exponents, dtype=np.int64)[:, None] << BITS) + np.arange(2**BITS)
    used = counts > 0
    counts, buckets = counts[used], buckets.ravel()[used]
    magnitudes = np.where(buckets < 0, ~buckets, buckets)
    inner, outer = ((k << (52 - BITS)).view(np.float64) for k in (magnitudes, magnitudes + 1))
    low, high = np.where(buckets < 0, -outer, inner), np.where(buckets < 0, -inner, outer)
    bounds = sketch.smallest, sketch.largest
    return np.clip(low, *bounds), np.clip(high, *bounds), counts
