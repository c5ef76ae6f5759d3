"""The summary of a campaign: all that its tables and figures show, in memory that does not grow with the runs.

    block -> summary_of -> join -> Summary

Numbers of runs add, distributions are sketches, sums of values are exact fractions, and KEPT_RUNS worst runs stay.
Therefore blocks may be joined in any order: the summary is the same to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from malta.arrays import FloatArray
from malta.campaigns.plan import Plan, half_width, middle_of
from malta.campaigns.result import (
    CLEARANCE,
    RISE,
    Campaign,
    Finding,
    Rate,
    Yields,
    every_figure,
    rate,
    runs_within_bounds,
    runs_within_specification,
)
from malta.display import Description, display
from malta.merits import Merit, figure
from malta.simulation.engine.digest import MAX_FIGURE, Batch, verdicts
from malta.synthesis.spec import Spec
from malta.units import in_unit

# Sketches: the distribution of a figure over any number of runs, in memory that does not grow with them.
#
# Up to MAX_EXACT_VALUES values a sketch keeps all. Beyond them it counts: a bucket has the numbers that agree in
# sign, exponent and the first BITS bits of the mantissa, so a bucket is at most 2**-BITS of its numbers wide, and its
# middle is within ACCURACY = 2**-(BITS + 1) of each of them. Counts of two sketches add, and the number of values
# alone decides whether they are counted: what is merged in whatever order is the same to the bit.
#
#     values of a block -> sketch_of -> merge -> quantiles, histogram
#
# Source: C. Masson, J. E. Rim, H. K. Lee, DDSketch, Proc. VLDB 12(12), 2019: quantiles of a relative accuracy from
# counts that add. Its buckets are powers of a base; these are read from the bits of a number, so that no logarithm is
# rounded.


MAX_EXACT_VALUES = 100_000  # values that a sketch keeps as they are
BITS = 13  # of the mantissa that name a bucket; a power of two of values takes 2**BITS counts, 64 KB
ACCURACY = 2.0 ** -(BITS + 1)  # relative, of a quantile of counted values


@dataclass(frozen=True, eq=False)
class Sketch:
    """The distribution of some finite values."""

    count: int = 0
    smallest: float = math.inf
    largest: float = -math.inf
    values: tuple[FloatArray, ...] = ()  # all of them, in any order, while they are at most MAX_EXACT_VALUES
    counts: Mapping[int, NDArray[np.int64]] = field(default_factory=dict)  # (sign, exponent) -> counts

    @property
    def exact(self) -> bool:
        """Whether quantiles are those of the values; else they are within ACCURACY of them."""
        return self.count <= MAX_EXACT_VALUES


def sketch_of(values: FloatArray) -> Sketch:
    """The sketch of some finite values."""
    if not len(values):
        return Sketch()
    values = np.asarray(values, dtype=float) + 0.0  # -0.0 is 0.0: sorting and merging may find either
    return _count_if_many(Sketch(len(values), float(values.min()), float(values.max()), (values,)))


def merge(one: Sketch, other: Sketch) -> Sketch:
    """The sketch of the values of two sketches.

    >>> quantiles(
    ...     merge(sketch_of(np.array([1.0, 2.0])), sketch_of(np.array([9.0]))), [0.5]
    ... ).tolist()
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
    outer = np.where(magnitudes == 0, 0.0, outer)  # zeros, with numbers below 3e-312
    low, high = np.where(buckets < 0, -outer, inner), np.where(buckets < 0, -inner, outer)
    bounds = sketch.smallest, sketch.largest
    return np.clip(low, *bounds), np.clip(high, *bounds), counts


KEPT_RUNS = 1000  # of the worst runs, by each measure of badness
WITHIN_BOUNDS_TEXT, LIMITED_TEXT = "within the published bounds", "completed, commands limited"


class RunLimits(NamedTuple):
    """What bounds the runs of a campaign, beside the scenario itself."""

    published: Mapping[str, Any] | None = None  # figures of the machine's paper
    spec: Spec | None = None  # whose [specification] counts


NO_BOUNDS = RunLimits()


@dataclass(frozen=True, eq=False)
class Runs:
    """Some runs of a campaign, a row for each."""

    index: NDArray[np.int64]
    values: FloatArray  # runs x names, SI
    batch: Batch

    def take(self, rows: Any) -> Runs:
        """The runs in these rows."""
        batch = Batch(**{name: getattr(self.batch, name)[rows] for name in Batch.__dataclass_fields__})
        return Runs(self.index[rows], self.values[rows], batch)


@dataclass(frozen=True, eq=False)
class Distribution:
    """The distribution of a figure of merit over the completed runs, SI."""

    merit: Merit  # without a value; its bound is the published one
    kind: str  # figures of one kind share a diagram
    sketch: Sketch
    within: int  # runs that were completed within the published bound
    total: Fraction  # of the values
    squares: Fraction  # of the values

    @property
    def label(self) -> str:
        """The words of the figure."""
        return self.merit.label

    @property
    def mean(self) -> float:
        return float(self.total / self.sketch.count) if self.sketch.count else math.nan

    @property
    def standard_deviation(self) -> float:
        """Standard deviation, of the values themselves: divided by their number."""
        n = self.sketch.count
        return math.sqrt(max(float(self.squares / n - (self.total / n) ** 2), 0.0)) if n else math.nan

    def percentiles(self, marks: Iterable[float]) -> FloatArray:
        """Percentiles, exact or to `sketch.ACCURACY`: see `Summary.exact`."""
        return quantiles(self.sketch, [mark / 100 for mark in marks])

    def figures(self, marks: Iterable[float]) -> list[Merit]:
        """The same as figures of merit."""
        return [self.merit._replace(value=float(value)) for value in self.percentiles(marks)]


@display
@dataclass(frozen=True, eq=False)
class Summary:
    """What a campaign found, without its runs: counts, yields, percentiles and the worst runs. SI.

    plan : the plan of the campaign
    bounds : published figures and the design whose bounds are counted
    runs : number of runs
    verdicts : number of runs with each verdict
    within : runs that were completed within every published bound; None where the paper has none
    specified : runs that were completed within [specification]; None where it has no bounds for them
    engines : which simulated them: "compiled" or "virtual machine"
    listed : distributions of the figures of merit; those of a stroke also where there is none
    bands : numbers of runs, names x ways to end x bins over the box
    kept : the runs among which the worst are, ascending
    interrupted : whether Ctrl-C ended the campaign; the summary is of the blocks before
    damaged : files of blocks that could not be read; their runs were simulated again
    folder : where the blocks are stored; None: nowhere

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> short = {"duration": 0.01}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "hold", {"m": 0.1}, samples=5, options=short
    ... )
    >>> found = malta.campaigns.summarize(plan, workers=1)
    >>> found.runs, found.ends, [merit.label for merit in found.merits][:2]
    (5, {'completed': 5}, ['deviation of z', 'deviation x1'])
    """

    plan: Plan
    bounds: RunLimits
    runs: int
    verdicts: NDArray[np.int64]
    within: int | None
    specified: int | None
    engines: tuple[str, ...]
    listed: tuple[Distribution, ...]
    bands: NDArray[np.int64]
    kept: Runs
    interrupted: bool = False
    damaged: tuple[Path, ...] = ()
    folder: Path | None = None

    @property
    def merits(self) -> tuple[Distribution, ...]:
        """The distributions of the figures of merit of the scenario."""
        rose = any(m.kind == RISE[0] and m.sketch.count for m in self.listed)
        return tuple(m for m in self.listed if rose or m.kind not in RISE)

    @property
    def exact(self) -> bool:
        """Whether all percentiles are those of the values; else they are within `sketch.ACCURACY` of them."""
        return all(merit.sketch.exact for merit in self.listed)

    @property
    def ends(self) -> dict[str, int]:
        """Number of runs by the name of their verdict."""
        names = verdicts(self.plan.plant)
        return {name: int(n) for name, n in zip(names, self.verdicts, strict=True) if n}

    @property
    def rate(self) -> Rate:
        """Share of the runs that were completed."""
        return rate(int(self.verdicts[0]), self.runs)

    @property
    def yields(self) -> Yields:
        """Shares of the runs that were completed, within the published bounds, within [specification]."""
        published, specified = (
            None if count is None else rate(count, self.runs) for count in (self.within, self.specified)
        )
        return Yields(self.rate, published, specified)

    @property
    def figures(self) -> tuple[Merit, ...]:
        """Figures of merit: the shares of its yields, then of each distribution the median and the 95 % percentile."""
        words = ("completed", "completed within the published bounds", "completed within the [specification]")
        rates = zip(words, self.yields, strict=True)
        found = [figure("yield", name, name, one.share) for name, one in rates if one is not None]
        for one in self.merits:
            middle, high = one.figures((50, 95))
            found += [
                middle._replace(label=f"{one.label}, median"),
                high._replace(label=f"{one.label}, 95 % of the runs"),
            ]
        return tuple(found)

    @property
    def description(self) -> Description:
        """Its plan, its ends, its yields and its figures of merit."""
        ends = ", ".join(f"{name} {count}" for name, count in self.ends.items())
        rows = [("ends", ends or "none"), ("completed", str(self.rate))]
        for one in self.merits:
            low, middle, high = (in_unit(x.value, x.unit) for x in one.figures((5, 50, 95)))
            shown = f"{middle:.3g} {one.merit.unit}, 90 % of the runs in {low:.3g} .. {high:.3g}"
            rows.append((one.label, shown))
        title = f"Summary of {self.plan.controller.name!r} in {self.plan.scenario!r}"
        return Description(f"{title}: {self.runs} of {self.plan.samples} machines", tuple(rows))


def summary_of(found: Campaign, bounds: RunLimits = NO_BOUNDS) -> Summary:
    """The summary of a campaign whose runs are in memory, or of one block of it.

    found = malta.campaign(plan)
    print(summary_of(found).rate)
    """
    within = runs_within_bounds(found, bounds.published)
    specified = runs_within_specification(found, bounds.spec)
    return Summary(
        found.plan,
        bounds,
        len(found.index),
        np.bincount(found.batch.verdict.astype(int), minlength=len(verdicts(found.plan.plant))),
        None if within is None else int(within.sum()),
        None if specified is None else int(specified.sum()),
        found.engines,
        tuple(_distribution(one) for one in every_figure(found, bounds.published)),
        _bands(found, within),
        _keep(Runs(found.index, found.values, found.batch)),
        found.interrupted,
        found.damaged,
        found.folder,
    )


def as_summary(found: Campaign | Summary, bounds: RunLimits) -> Summary:
    """A summary, which has its own bounds, or that of a campaign in memory."""
    return found if isinstance(found, Summary) else summary_of(found, bounds)


def join(one: Summary, other: Summary) -> Summary:
    """The summary of the runs of two summaries of one plan."""

    def add(first: int | None, second: int | None) -> int | None:
        return None if first is None or second is None else first + second

    return replace(
        one,
        runs=one.runs + other.runs,
        verdicts=one.verdicts + other.verdicts,
        within=add(one.within, other.within),
        specified=add(one.specified, other.specified),
        engines=tuple(sorted({*one.engines, *other.engines})),
        listed=tuple(map(_join_merits, one.listed, other.listed)),
        bands=one.bands + other.bands,
        kept=_keep(_join_runs(one.kept, other.kept)),
    )


def _distribution(found: Finding) -> Distribution:
    values = found.values[np.isfinite(found.values)]
    sums = Fraction(float(values.sum())), Fraction(float((values**2).sum()))
    return Distribution(found.merit, found.kind, sketch_of(values), int(found.within.sum()), *sums)


def _join_merits(one: Distribution, other: Distribution) -> Distribution:
    return replace(
        one,
        sketch=merge(one.sketch, other.sketch),
        within=one.within + other.within,
        total=one.total + other.total,
        squares=one.squares + other.squares,
    )


# --- ways to end, over the box ---


def ways_to_end(plan: Plan) -> tuple[str, ...]:
    """Names of the ways in which a run may end, the best first: verdicts, with success in three grades."""
    names = verdicts(plan.plant)
    return (WITHIN_BOUNDS_TEXT, LIMITED_TEXT, *names)


def bin_edges(plan: Plan, name: str) -> FloatArray:
    """Edges of the bins of a varied value: ten over its box, five where few runs would fill each."""
    middle, half = middle_of(plan, name), abs(half_width(plan, name))
    return np.linspace(middle - half, middle + half, 11 if plan.samples >= 200 else 6)


def _bands(found: Campaign, within: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    """Number of runs by varied value, way to end, and bin."""
    way = 2 + found.batch.verdict.astype(int)
    way[found.completed & (found.batch.saturated.max(axis=1, initial=0.0) > 0)] = 1
    if within is not None:
        way[within] = 0
    ways, counts = len(ways_to_end(found.plan)), []
    for name, values in zip(found.names, found.values.T, strict=True):
        edges = bin_edges(found.plan, name)
        bins = len(edges) - 1
        place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, bins - 1)
        counts.append(np.bincount(way * bins + place, minlength=ways * bins).reshape(ways, bins))
    return np.array(counts)


# --- the worst runs ---


def worst_runs(summary: Summary, count: int) -> Runs:
    """The worst runs, the worst first, at most KEPT_RUNS: those that ended early, then those closest to a contact.

    Closeness is relative to the median of the completed runs, because the scenario itself may come near an end stop.
    """
    runs = summary.kept
    completed = runs.batch.completed == 1
    closest = -closeness(summary, runs)
    order = np.lexsort((runs.index, np.where(completed, closest, runs.batch.duration), completed))
    return runs.take(order[: min(count, KEPT_RUNS)])


def closeness(summary: Summary, runs: Runs) -> FloatArray:
    """How much more of its clearance each run uses up than the median of the completed runs, at its worst contact."""
    medians = [m.percentiles([50])[0] for m in summary.listed if m.kind == CLEARANCE]
    contact = np.nan_to_num(runs.batch.contact, posinf=MAX_FIGURE, neginf=-MAX_FIGURE)
    # a run that diverged may have any
    away = np.clip(contact, -MAX_FIGURE, MAX_FIGURE) - np.array(medians)
    return np.asarray(away.max(axis=1) if away.shape[1] else np.zeros(len(runs.index)))


def worst_of(found: Campaign, count: int) -> list[int]:
    """Rows of the worst runs of a campaign in memory, as `worst_runs` orders them."""
    rows: list[int] = np.searchsorted(found.index, worst_runs(summary_of(found), count).index).tolist()
    return rows


def _keep(runs: Runs) -> Runs:
    """The runs of which the worst may be: the first KEPT_RUNS that ended early, and the closest to each contact.

    A run among the KEPT_RUNS worst is among the KEPT_RUNS closest to that contact to which it is closest relative to
    the median: every run before it there is worse.
    """
    if len(runs.index) <= KEPT_RUNS:
        return runs
    completed = runs.batch.completed == 1
    measures = [np.where(completed, np.inf, runs.batch.duration)]
    measures += [np.where(completed, -column, np.inf) for column in runs.batch.contact.T]
    if not runs.batch.contact.shape[1]:
        measures.append(np.where(completed, 0.0, np.inf))
    rows = [np.lexsort((runs.index, measure))[:KEPT_RUNS] for measure in measures]
    return runs.take(np.unique(np.concatenate(rows)))


def _join_runs(one: Runs, other: Runs) -> Runs:
    """The runs of two selections, ascending."""
    columns = {
        name: np.concatenate([getattr(part.batch, name) for part in (one, other)])
        for name in Batch.__dataclass_fields__
    }
    joined = Runs(
        np.concatenate([one.index, other.index]), np.concatenate([one.values, other.values]), Batch(**columns)
    )
    return joined.take(np.argsort(joined.index))
