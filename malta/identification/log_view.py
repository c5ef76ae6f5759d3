"""What a picture of a log shows of each signal: its envelope over time, and its spectrum with the excited lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.identification.survey import blocks_of

if TYPE_CHECKING:
    from malta.identification.log import Log
    from malta.identification.spectra import IntArray

INTERVALS = 1000  # of a record, each with its least and its largest value
TAIL_ROWS = 400_000  # at the end of a record, of which the spectrum is taken
POINTS = 400  # of a spectrum, each the largest of its bins
MIN_LINE_SHARE = 1e-3  # of the largest line of an excitation: what is above is a line
MAX_SIZE_RATIO = 30  # of signals that share an axis
WORDS = {"excitation": "exc. ", "reference": "ref. "}
VIEWED = ("y", "i", "v", "excitation", "reference")  # groups, in the order of the panels


@dataclass(frozen=True, eq=False)
class SignalView:
    """A signal as it is drawn; SI.

    group : as "y"
    name : of the signal
    unit : SI
    t : s, where intervals begin
    low, high : the least and the largest value of each interval; NaN where all are missing
    f : Hz
    amplitude : of the spectrum, the largest of the bins about each f
    lines : Hz, that are excited
    at_lines : amplitude there
    whole : whether each interval is one sample
    """

    group: str
    name: str
    unit: str
    t: FloatArray
    low: FloatArray
    high: FloatArray
    f: FloatArray
    amplitude: FloatArray
    lines: FloatArray
    at_lines: FloatArray
    whole: bool

    @property
    def label(self) -> str:
        """Its name, of an excitation and of a reference with a word before it."""
        return f"{WORDS.get(self.group, '')}{self.name}"

    @property
    def size(self) -> float:
        """The largest distance from zero, SI; 0 where all values are missing."""
        return float(np.nanmax(np.abs([self.low, self.high]), initial=0.0))

    @property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """Times and values of a line that goes through the least and the largest value of each interval.

        Intervals of one sample have one value.
        """
        if self.whole:
            return self.t, self.low
        half = np.diff(self.t, append=2 * self.t[-1] - self.t[-2]) / 2
        return np.column_stack([self.t, self.t + half]).ravel(), np.column_stack(
            [self.low, self.high]
        ).ravel()


class SignalPanel(NamedTuple):
    """Signals of one unit and of sizes that one axis shows."""

    unit: str  # SI
    views: tuple[SignalView, ...]


def view_panels(views: Sequence[SignalView]) -> list[SignalPanel]:
    """Signals by their unit; where some are MAX_SIZE_RATIO times as large as others they have a panel of their own.

    A signal that is zero is beside the largest of its unit.
    """
    panels: list[SignalPanel] = []
    for unit in dict.fromkeys(view.unit for view in views):
        left = [view for view in views if view.unit == unit]
        while left:
            largest = max(view.size for view in left)
            shown = [view for view in left if view.size * MAX_SIZE_RATIO >= largest or view.size == 0]
            panels.append(SignalPanel(unit, tuple(shown)))
            left = [view for view in left if view not in shown]
    return panels


def view_log(log: Log, intervals: int = INTERVALS) -> list[SignalView]:
    """The signals of a log that change, and all readings, each with envelope and spectrum.

    intervals : of the envelope, at most

    Of a log under a periodic excitation the spectrum is that of the last whole periods.
    """
    rows = min(log.samples, TAIL_ROWS)
    each = round(log.period / log.sample_time) if log.period else 0
    rows -= rows % each if 1 < each <= rows else 0
    bins = np.arange(1, rows // 2 + 1)
    f = bins / (rows * log.sample_time)
    lines = _excited_bins(log, rows)
    edges = np.unique(np.geomspace(1, max(len(bins), 1), POINTS).astype(int)) - 1 if len(bins) else bins
    views = []
    for group in [name for name in VIEWED if log.names(name)]:
        starts, low, high = _envelope(log, group, intervals)
        X = _amplitudes(np.asarray(log.columns[group][log.samples - rows :]))
        for k, signal in enumerate(log.signals[group]):
            moves = np.nanmax(high[:, k], initial=-np.inf) > np.nanmin(low[:, k], initial=np.inf)
            if not moves and group != "y":
                continue
            drawn = np.maximum.reduceat(X[1:, k], edges) if len(edges) else X[:0, k]
            views.append(
                SignalView(
                    group,
                    signal.name,
                    signal.unit,
                    starts,
                    low[:, k],
                    high[:, k],
                    f[edges],
                    drawn,
                    lines / (rows * log.sample_time),
                    X[lines, k],
                    len(starts) == log.samples,
                )
            )
    return views


def _envelope(log: Log, group: str, intervals: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where intervals begin, s, and the least and the largest values of a group in them, intervals x signals."""
    count, width = log.samples, log.columns[group].shape[1]
    size = max(1, -(-count // intervals))
    number = -(-count // size)
    low, high = np.full((number, width), np.inf), np.full((number, width), -np.inf)
    first = 0
    for block in blocks_of(log.columns[group]):
        own = (first + np.arange(len(block))) // size
        begins = np.concatenate([[0], np.flatnonzero(np.diff(own)) + 1])
        places = own[begins]
        np.minimum.at(low, places, np.fmin.reduceat(block, begins, axis=0))
        np.maximum.at(high, places, np.fmax.reduceat(block, begins, axis=0))
        first += len(block)
    starts = np.array([float(log.t[k]) for k in range(0, count, size)])
    low, high = (np.where(np.isfinite(ends), ends, np.nan) for ends in (low, high))
    return starts, low, high


def _amplitudes(rows: FloatArray) -> FloatArray:
    """Amplitudes of the spectrum of rows without their means; missing values are on the mean."""
    there = np.isfinite(rows)
    count = np.maximum(there.sum(axis=0), 1)
    mean = np.where(there, rows, 0.0).sum(axis=0) / count
    return np.asarray(2 * np.abs(np.fft.rfft(np.where(there, rows - mean, 0.0), axis=0)) / max(len(rows), 1))


def _excited_bins(log: Log, rows: int) -> IntArray:
    """The bins that the excitation has; none without one that is periodic."""
    if not (log.period and log.names("excitation")):
        return np.zeros(0, dtype=int)
    size = _amplitudes(np.asarray(log.columns["excitation"][log.samples - rows :])).max(axis=1)
    return np.flatnonzero(size > MIN_LINE_SHARE * max(float(size.max(initial=0.0)), 1e-300))
