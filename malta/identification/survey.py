"""What a log shows at a first look: statistics of its signals, and readings that no sensor of a moving machine gives.

All is counted block by block, so that a record of any length takes the memory of a block.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from malta.arrays import FloatArray
from malta.display import quantity
from malta.errors import InputError
from malta.identification.readers.raw import GROUPS, MAX_READING
from malta.identification.readers.stored import EvenTimes
from malta.model.plant import Signal


class SurveyedLog(Protocol):
    """What is asked of a log here."""

    @property
    def source(self) -> str: ...
    @property
    def columns(self) -> Mapping[str, FloatArray]: ...
    @property
    def signals(self) -> Mapping[str, tuple[Signal, ...]]: ...
    @property
    def t(self) -> FloatArray: ...
    @property
    def samples(self) -> int: ...
    @property
    def sample_time(self) -> float: ...
    @property
    def jitter(self) -> float: ...
    @property
    def sensor_survey(self) -> Survey: ...


SOUND_LOG = "nothing is missing, stuck, clipped or at a limit"
BLOCK_ROWS = 50_000  # rows that are looked at together
STUCK_SHARE = 0.02  # of a log, for which a sensor may read the same
MIN_STUCK_SAMPLES = 200  # samples of a reading that is called stuck
PILE = 0.002  # of a log at an end of a sensor's range
PILE_RATIO = 4.0  # times as many readings at the end as beside it
MIN_DIFFERENT_READINGS = 5  # different readings, without which a sensor has no range
REPEATS = (10, 8, 5, 4, 3, 2)  # how often a logger may write each reading, the largest first
MIN_CHANGES = 50  # of a reading, that tell whether it stands several times
REPEATED_SHARE = 0.99  # of the changes, which are so many samples apart
MAX_SPIKE = 100.0  # times as far from the median as 99.9 % of the readings: what is beyond is none
SAMPLED = 20_000  # readings that tell the quantiles
READ = ("y", "i")  # groups of sensors


@dataclass(frozen=True)
class Survey:
    """What a log shows at a first look.

    statistics : by heading "name [unit]": least, mean, largest value and standard deviation, SI; missing ones apart
    jitter : s, standard deviation of the intervals between samples
    gaps : intervals longer than 1.5 samples
    missing : by signal: readings that are not there
    samples : of the log
    stuck : by measured output or current: the longest run of one reading, samples, where it is suspicious
    clipped : by measured output: samples at the end of its range, where they pile up
    limits : by flag: share of the samples in which it was set
    repeated : by measured output or current: how often each reading stands, where that is more than once
    impossible : by measured output or current: a reading far beyond all others, and 99.9 % of these, in words
    """

    statistics: Mapping[str, tuple[float, float, float, float]]
    jitter: float
    gaps: int
    missing: Mapping[str, int]
    samples: int
    stuck: Mapping[str, int]
    clipped: Mapping[str, int]
    limits: Mapping[str, float]
    repeated: Mapping[str, int] = field(default_factory=dict)
    impossible: Mapping[str, str] = field(default_factory=dict)

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong, in words."""
        found = [f"{self.gaps} gaps"] if self.gaps else []
        for name, count in self.missing.items():
            found.append(f"{count} readings of {name} missing, {100 * count / self.samples:.3g} %")
        found += [f"{name} stuck for {count} samples" for name, count in self.stuck.items()]
        found += [f"{name} clipped in {count} samples" for name, count in self.clipped.items()]
        found += [
            f"each reading of {name} stands {count} times: it is sampled less often than it is logged"
            for name, count in self.repeated.items()
        ]
        found += [f"{name} reads {words}" for name, words in self.impossible.items()]
        return (
            *found,
            *(f"{name} in {100 * share:.3g} % of the time" for name, share in self.limits.items()),
        )


def blocks_of(table: Any) -> Iterator[FloatArray]:
    """The rows of a table, some at a time."""
    for first in range(0, len(table), BLOCK_ROWS):
        yield np.asarray(table[first : first + BLOCK_ROWS], dtype=float)


def survey(log: SurveyedLog, groups: Collection[str] = tuple(GROUPS)) -> Survey:
    """The statistics of some groups of a log and what is wrong with its samples.

    Raises InputError for a number that is no reading, of a record that stays in its file.
    """
    statistics: dict[str, tuple[float, float, float, float]] = {}
    missing: dict[str, int] = {}
    stuck, clipped, repeated, impossible = (
        dict[str, int](),
        dict[str, int](),
        dict[str, int](),
        dict[str, str](),
    )
    limits: dict[str, float] = {}
    for group, table in log.columns.items():
        if group not in groups:
            continue
        signals = log.signals[group]
        names = [GROUPS[group] + signal.name for signal in signals]
        found = _SignalCounts(len(signals), group)
        for block in blocks_of(table):
            found.add(block)
        for k, (name, signal) in enumerate(zip(names, signals, strict=True)):
            if max(abs(found.least[k]), abs(found.largest[k])) >= MAX_READING and found.there[k]:
                found_one = f"{found.least[k]:g} .. {found.largest[k]:g}"
                raise InputError(log.source, name, found_one, "readings, or nothing where they are missing")
            if found.there[k] < log.samples:
                missing[name] = log.samples - int(found.there[k])
            statistics[f"{name} [{signal.unit}]"] = found.numbers(k)
            if group == "flags" and found.mean[k]:
                limits[signal.name] = float(found.mean[k])
        if group not in READ:
            continue
        for k, signal in enumerate(signals):
            longest, piled, times = found.longest(k), found.pile(k), found.repeats(k)
            used = group == "y" or found.largest[k] > found.least[k] or found.least[k] != 0
            if used and longest >= max(MIN_STUCK_SAMPLES, STUCK_SHARE * log.samples):
                stuck[signal.name] = longest
            elif piled:
                clipped[signal.name] = piled
            if times > 1:
                repeated[signal.name] = times
            words = found.spike(k, signal.unit)
            if words:
                impossible[signal.name] = words
    even = isinstance(log.t, EvenTimes)
    gaps = 0 if even else int((np.diff(log.t) > 1.5 * log.sample_time).sum())
    return Survey(
        statistics, log.jitter, gaps, missing, log.samples, stuck, clipped, limits, repeated, impossible
    )


class _SignalCounts:
    """What is counted of the columns of a group, block by block."""

    def __init__(self, count: int, group: str) -> None:
        self.rows, self.group = 0, group
        self.there, self.mean, self.squares = np.zeros(count), np.zeros(count), np.zeros(count)
        self.least, self.largest = np.full(count, np.inf), np.full(count, -np.inf)
        self.last: FloatArray = np.full(count, np.nan)
        self.run, self.longest_run = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
        self.residues = np.zeros((count, 120), dtype=int)  # of samples with a new reading, by 120
        self.ends: list[tuple[dict[float, int], dict[float, int]]] = [({}, {}) for _ in range(count)]
        self.drawn: list[FloatArray] = []

    def add(self, block: FloatArray) -> None:
        """Count a block, rows x columns."""
        good = np.isfinite(block)
        whole = bool(good.all())
        count = good.sum(axis=0)
        filled = block if whole else np.where(good, block, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(count > 0, filled.sum(axis=0) / count, 0.0)
            off = filled - mean if whole else np.where(good, block - mean, 0.0)
            total = self.there + count
            moved = mean - self.mean
            self.squares += (off * off).sum(axis=0) + np.where(
                total > 0, moved**2 * self.there * count / total, 0.0
            )
            self.mean = np.where(total > 0, self.mean + moved * count / total, 0.0)
        self.there = total
        self.least = np.minimum(
            self.least, np.where(good, block, np.inf).min(axis=0) if not whole else block.min(axis=0)
        )
        self.largest = np.maximum(
            self.largest, np.where(good, block, -np.inf).max(axis=0) if not whole else block.max(axis=0)
        )
        if self.group in READ:
            self._count_changes(block)
            self.drawn.append(np.array(block[:: max(1, len(block) * (len(self.drawn) + 1) // SAMPLED)]))
        for k in range(block.shape[1] if self.group == "y" else 0):
            self._count_ends(k, block[:, k] if whole else block[good[:, k], k])
        self.rows += len(block)

    def _count_changes(self, block: FloatArray) -> None:
        """Runs of one reading, and where new ones begin."""
        new = np.empty(block.shape, dtype=bool)
        new[0], new[1:] = block[0] != self.last, block[1:] != block[:-1]
        for k in range(block.shape[1]):
            at = np.flatnonzero(new[:, k])
            if not len(at):
                self.run[k] += len(block)
            else:
                inner = int(np.diff(at).max(initial=0))
                self.longest_run[k] = max(self.longest_run[k], self.run[k] + at[0], inner)
                self.run[k] = len(block) - at[-1]
                self.residues[k] += np.bincount((self.rows + at) % 120, minlength=120)
            self.longest_run[k] = max(self.longest_run[k], self.run[k])
        self.last = block[-1]

    def _count_ends(self, k: int, values: FloatArray) -> None:
        """How often the two least and the two largest readings of a column stand."""
        for known, side in zip(self.ends[k], (values, -values), strict=True):
            for _ in range(2):
                if not len(side):
                    break
                end = float(side.min())
                known[end] = known.get(end, 0) + int((side == end).sum())
                side = side[side > end]
            for value in sorted(known)[2:]:
                del known[value]

    def numbers(self, k: int) -> tuple[float, float, float, float]:
        """Least, mean, largest value and deviation of a column; NaN where nothing is there."""
        if not self.there[k]:
            return (np.nan,) * 4
        spread = float(np.sqrt(self.squares[k] / self.there[k]))
        return float(self.least[k]), float(self.mean[k]), float(self.largest[k]), spread

    def longest(self, k: int) -> int:
        """Samples of the longest run of one reading."""
        return int(self.longest_run[k])

    def pile(self, k: int) -> int:
        """Samples at an end of the range where many more pile up than beside it; 0: none do."""
        if self.group != "y" or len(np.unique(self._sample_of(k))) < MIN_DIFFERENT_READINGS:
            return 0
        found = 0
        for known in self.ends[k]:
            end, beside = (known[value] for value in sorted(known)[:2])
            found += end if end > max(PILE * self.rows, PILE_RATIO * beside) else 0
        return found

    def repeats(self, k: int) -> int:
        """How often each reading stands; 1 where the readings change at any sample."""
        by = self.residues[k]
        if by.sum() < MIN_CHANGES:
            return 1
        for times in REPEATS:
            most = by.reshape(-1, times).sum(axis=0).max()
            if most > REPEATED_SHARE * by.sum() and by.sum() > 0.3 * self.rows / times:
                return times
        return 1

    def _sample_of(self, k: int) -> FloatArray:
        """Some of a column's readings, which are there."""
        values = np.concatenate([block[:, k] for block in self.drawn]) if self.drawn else np.zeros(0)
        return np.asarray(values[np.isfinite(values)])

    def spike(self, k: int, unit: str) -> str:
        """A reading that is far beyond all others, in words; "" where there is none."""
        values = self._sample_of(k)
        if len(values) < MIN_STUCK_SAMPLES:
            return ""
        middle = float(np.median(values))
        usual = float(np.quantile(np.abs(values - middle), 0.999))
        end = max(self.least[k], self.largest[k], key=lambda value: abs(value - middle))
        if not usual or abs(end - middle) <= MAX_SPIKE * usual:
            return ""
        return (
            f"{quantity(float(end), unit)}, others within {quantity(usual, unit)} of {quantity(middle, unit)}"
        )


def faults_of(log: SurveyedLog) -> dict[str, str]:
    """By sensor, in words: that it is stuck or clipped, or has each reading several times."""
    found, samples = log.sensor_survey, log.samples
    faults = {name: f"has each reading {count} times" for name, count in found.repeated.items()}
    faults |= {name: f"is clipped in {count} of {samples} samples" for name, count in found.clipped.items()}
    return faults | {name: f"is stuck in {count} of {samples} samples" for name, count in found.stuck.items()}
