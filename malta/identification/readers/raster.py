"""The raster of a log's times: one real period, however coarsely the times are written.

Times are rounded: to the digits of a text, to single precision, to what a double keeps of seconds since 1970. The
median of their differences is one of the two differences beside the period. The period is

    T_s = (t_last - t_first) / (number of intervals between them)

where an interval that is longer than 1.5 others counts as the gap of as many samples as fit into it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.identification.readers.stored import EvenTimes, StoredTable

GAP = 1.5  # sample times: a longer interval is a gap
MAX_TIME = 1e30  # s, beyond which nothing is a time
UNIX = 1e8  # s: times beyond it count from 1970 or another epoch, and are shown from the first sample
STAMP_UNITS = (
    (1e17, 1e-9),
    (1e14, 1e-6),
    (1e11, 1e-3),
)  # sizes of stamps since 1970 in ns, us and ms, and their unit
MAX_PERIOD_ERROR = 1e-3  # by which a period that is named may differ from that of the times
SAMPLED_TIMES = 100_000  # times of a long record that are looked at together
DIGITS = 12  # significant digits of a period, at most


class Raster(NamedTuple):
    """The samples of a log in time.

    t : s, those of the file, on the raster where their rounding alone takes them off it
    sample_time : s
    jitter : s, standard deviation of the intervals; 0 of times that are on the raster but for their rounding
    notes : what was made of the times
    """

    t: FloatArray
    sample_time: float
    jitter: float
    notes: tuple[str, ...] = ()


def raster_of(t: FloatArray, named: float, path: str | Path, *, exact: bool = False) -> Raster:
    """The raster of times.

    t : s
    named : the sample time that the file or the user names, s; 0: none
    exact : the name stands for whatever the times are, as in files of malta

    Raises InputError for times that do not rise, and for a named sample time that is not theirs.
    """
    if isinstance(t, EvenTimes):
        return Raster(t, t.step, 0.0)
    if isinstance(t, StoredTable):
        return _stored_raster(t, named, path, exact=exact)
    if len(t) < 2 or not (np.isfinite(t).all() and np.abs(t).max() < MAX_TIME):
        raise InputError(path, "t", "times that do not rise", "the times of the samples, in order")
    steps = np.diff(t)
    _require_rising(t, steps, path)
    coarse = resolution_of(t)
    mean = float(t[-1] - t[0]) / len(steps)
    usual = float(np.median(steps)) or mean
    gaps = steps > GAP * max(usual, mean if coarse > usual else 0.0) + coarse
    apart = np.ones(len(steps))
    if gaps.any():
        period = float(steps[~gaps].mean())
        apart[gaps] = np.maximum(np.round(steps[gaps] / period), 1)
    k = np.concatenate([[0.0], np.cumsum(apart)])
    mean = float(t[-1] - t[0]) / k[-1]
    off = float(np.abs(t - (t[0] + k * mean)).max())
    period = _round_period(mean, max(off, coarse) / float(t[-1] - t[0]))
    notes = [f"times count from {t[0]:.9g} s"] if abs(t[0]) > UNIX else []
    even = off <= coarse + 1e-9 * mean
    if even and coarse > 0.01 * period:
        notes.append(f"times are rounded to {coarse:.2g} s")
    shown = (0.0 if abs(t[0]) > UNIX else float(t[0])) + k * period if even else t - (t[0] if notes else 0.0)
    jitter = 0.0 if even or gaps.all() else float(steps[~gaps].std())
    if not exact:
        _require_named(named, period, path)
    return Raster(shown, named or period, jitter, tuple(notes))


def _stored_raster(t: StoredTable, named: float, path: str | Path, *, exact: bool) -> Raster:
    """The raster of times that stay in their file: even ones take no memory, others are read as a whole."""
    begin, end = (np.ravel(part) for part in (t[:SAMPLED_TIMES], t[len(t) - SAMPLED_TIMES :]))
    near = raster_of(begin, 0.0, path)
    mean = float(end[-1] - begin[0]) / (len(t) - 1)
    coarse = max(resolution_of(begin), resolution_of(end)) + 1e-9 * abs(mean)
    off = 0.0
    for first in range(0, len(t), SAMPLED_TIMES):
        block = np.ravel(t[first : first + SAMPLED_TIMES])
        line = begin[0] + mean * np.arange(first, first + len(block))
        off = max(off, float(np.abs(block - line).max()) if np.isfinite(block).all() else np.inf)
    if not off <= coarse < 0.5 * mean:
        return raster_of(np.ravel(np.asarray(t)), named, path, exact=exact)
    period = _round_period(mean, coarse / float(end[-1] - begin[0]))
    if not exact:
        _require_named(named, period, path)
    return Raster(even_times(float(near.t[0]), named or period, len(t)), named or period, 0.0, near.notes)


def _require_named(named: float, period: float, path: str | Path) -> None:
    """Raise InputError for a named sample time, if any, that is not that of the times."""
    if named and abs(named / period - 1) > MAX_PERIOD_ERROR:
        found = f"{named:.6g} s, while the times rise by {period:.6g} s{unit_hint(named, period)}"
        raise InputError(path, "sample time", found, "one sample time")


def even_times(first: float, step: float, count: int) -> FloatArray:
    """Times on a raster, which take no memory where they are many."""
    return cast("FloatArray", EvenTimes(first, step, count))


def _require_rising(t: FloatArray, steps: FloatArray, path: str | Path) -> None:
    """Raise InputError for times that fall, and for equal ones that no rounding explains."""
    falls = np.flatnonzero(steps < 0)
    if len(falls):
        k = int(falls[0])
        found = f"times that do not rise: {t[k + 1]:.9g} s in row {k + 2} after {t[k]:.9g} s"
        raise InputError(path, "t", found, "the times of the samples, in order")
    still = int((steps == 0).sum())
    if still and (still == len(steps) or resolution_of(t) < 0.5 * float(t[-1] - t[0]) / len(steps)):
        k = int(np.flatnonzero(steps == 0)[0])
        found = f"times that do not rise: {t[k]:.9g} s in rows {k + 1} and {k + 2}"
        raise InputError(path, "t", found, "the times of the samples, in order, each row once")


def resolution_of(t: FloatArray) -> float:
    """To what times are rounded, s: to single or double precision, or to the last digit of a decimal; the largest."""
    size = float(np.abs(t).max())
    single = np.spacing(np.float32(size)) if np.array_equal(t.astype(np.float32), t) else np.spacing(size)
    for digits in range(10):
        if 10.0**-digits > (single or 1.0):
            scaled = t * 10.0**digits
            near = float(np.abs(scaled - np.round(scaled)).max())
            if near <= 4 * np.spacing(max(size * 10.0**digits, 1.0)):
                # Even times are multiples of their period too: only what is off the raster is rounded.
                return 10.0**-digits if _is_uneven(t) else float(single)
    return float(single)


def _is_uneven(t: FloatArray) -> bool:
    """Whether intervals that are no gaps differ by more than the precision of a double."""
    steps = np.diff(t)
    near = steps[steps <= GAP * np.median(steps)]
    uneven = np.ptp(near) > 8 * np.spacing(float(np.abs(t).max())) if len(near) else True
    return bool(uneven or (steps <= 0).any())


def _round_period(period: float, share: float) -> float:
    """A period with the digits that its times tell: known to a share of itself."""
    digits = min(DIGITS, max(2, math.floor(-math.log10(share)))) if share > 0 else DIGITS
    return float(f"{period:.{digits}g}")


def unit_hint(found: float, expected: float) -> str:
    """What a ratio of two sample times near a power of 1000 says; "" for another one."""
    power = round(math.log10(found / expected) / 3) if found > 0 and expected > 0 else 0
    if power == 0 or abs(found / expected / 1000.0**power - 1) > 0.01:
        return ""
    return f" ({1000.0 ** abs(power):.0f} times as {'long' if power > 0 else 'short'}: another unit of time?)"


def seconds_of(t: FloatArray, unit: str, factor: float) -> tuple[FloatArray, str]:
    """Times in s, and a note where they are in no unit that was named: stamps since 1970 tell theirs by their size.

    factor : of the unit, s; 1 without one
    """
    if isinstance(t, StoredTable):
        if unit or abs(float(t[:1][0, 0])) <= min(size for size, _ in STAMP_UNITS):
            return cast("FloatArray", t.choose([0], [factor])), ""
        t = np.ravel(np.asarray(t))
    if unit or not len(t):
        return t * factor if factor != 1 else t, ""
    for least, one in STAMP_UNITS:
        if abs(t[0]) > least:
            return (t - t[0]) * one, f"times are stamps in {one:g} s since 1970"
    return t, ""


SAME_SHARE = (
    1e-5  # of the largest value: columns that differ by less are the same, as written with few digits
)
PATTERN = 64  # samples that are looked for


def period_of(table: FloatArray) -> int:
    """The samples after which columns repeat themselves, by the end of a record; 0: they do not, or never change.

    table : samples x columns

    >>> import numpy as np
    >>> period_of(np.sin(2 * np.pi * np.arange(500)[:, None] / 100))
    100
    """
    count = len(table)
    if count < 4 or not np.isfinite(table).all():
        return 0
    back = table[::-1]
    size = np.abs(table).max(axis=0)
    x = back[:, int(size.argmax())]
    near = SAME_SHARE * float(size.max())
    if not near or float(np.ptp(x)) <= near:
        return 0
    lags = np.arange(2, count // 2 + 1)
    for k in range(min(PATTERN, count // 2)):
        lags = lags[np.abs(x[k + lags] - x[k]) <= near]
    for lag in lags.tolist():
        repeats = max(1, min(3, count // lag) - 1) * lag
        if (np.abs(back[lag : lag + repeats] - back[:repeats]) <= SAME_SHARE * np.maximum(size, near)).all():
            return int(lag)
    return 0
