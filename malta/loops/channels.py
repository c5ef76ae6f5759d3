"""The margins of one channel at a time, the others closed, at exact crossings; of unstable open loops as well.

l = T_ii / S_ii        what channel i sees around itself, negative feedback
1 + k l(jw) = 0        at the factors k = -1 / l where l is real and negative: 0, the Nyquist frequency and
                       infinity among them. The nearest below and above 1 bound the stable ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.loops.classical import Disk

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

FARTHEST = 1e6  # factors of gain beyond which a margin counts as infinite
STEPS = 6  # of the false position at each crossing
PEAKS = 2  # parabolas through the three values about each peak


class Crossing(NamedTuple):
    """A place at which |l| = 1 or l is real and negative."""

    frequency: float  # rad/s
    value: complex  # l there


@dataclass(frozen=True)
class ChannelMargins:
    """The classical margins of one channel, the others closed. NaN for an unstable loop.

    The loop is stable for every factor of gain in `gain` and for none next to it: an open loop that is unstable has a
    lower bound as well. Encirclements of -1 are counted counterclockwise, over negative and positive frequencies.
    """

    channel: str
    stable: bool  # the closed loop
    gain: tuple[float, float]  # factors; 0 and inf where nothing bounds them
    gain_frequency: tuple[float, float]  # rad/s; NaN where nothing bounds them
    phase: float  # rad, the smallest turn of either sign; inf without a gain crossing
    phase_frequency: float  # rad/s
    delay: float  # s; inf without a gain crossing
    delay_frequency: float  # rad/s
    disk: Disk  # symmetric
    peak_sensitivity: float  # max |S_ii|; its inverse is the modulus margin
    peak_frequency: float  # rad/s
    unstable_poles: int  # with this channel open; poles on the axis count as stable
    encirclements: int  # unstable_poles minus those of the closed loop
    gain_crossings: tuple[Crossing, ...]  # |l| = 1
    phase_crossings: tuple[Crossing, ...]  # l < 0

    @property
    def modulus(self) -> float:
        """The modulus margin, the shortest distance of l(jw) from -1: 1 / max |S_ii|."""
        return 1 / self.peak_sensitivity


class Seen(NamedTuple):
    """What channels see: l and S_ii at frequencies, k x channels each."""

    w: FloatArray  # rad/s, ascending; the last is the Nyquist frequency of a sampled loop
    loop: ComplexArray
    S: ComplexArray


See = Callable[["FloatArray"], Seen]


def find_crossings(see: See, seen: Seen) -> tuple[list[list[Crossing]], list[list[Crossing]]]:
    """Gain and phase crossings of each channel between the frequencies of `seen`, by false position."""
    turn = seen.loop.imag
    with np.errstate(divide="ignore"):
        size = np.log(np.abs(seen.loop))
    behind = (seen.loop.real[1:] < 0) | (seen.loop.real[:-1] < 0)
    found: list[tuple[list[list[Crossing]], Any, bool]] = []
    channels = seen.loop.shape[1]
    for values, also, phase in ((size, True, False), (turn, behind, True)):
        ends = np.sign(values[:-1]) * np.sign(values[1:]) < 0
        found.append(([[] for _ in range(channels)], np.argwhere(ends & also), phase))
    rows = [(k, i, phase) for _, where, phase in found for k, i in where.tolist()]
    if rows:
        k, i, phase = np.array(rows).T
        w, values = _false_position(see, seen, k, i, phase == 1)
        for at, value, channel, of_phase in zip(w.tolist(), values.tolist(), i, phase, strict=True):
            if not math.isnan(at) and (not of_phase or value.real < 0):
                found[of_phase][0][channel].append(Crossing(at, value))
    return found[0][0], found[1][0]


def _false_position(
    see: See, seen: Seen, k: FloatArray, i: FloatArray, phase: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Roots of log|l_i|, or of Im l_i where `phase`, in the intervals k of the grid (Illinois); and l there.

    NaN where the sign changes at a pole on the axis: there the measure grows instead of vanishing.
    """

    def measure(values: ComplexArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.where(phase, values.imag, np.log(np.abs(values)))

    rows = np.arange(len(k))
    a, b = np.log(seen.w[k]), np.log(seen.w[k + 1])
    f, g = measure(seen.loop[k, i]), measure(seen.loop[k + 1, i])
    largest = np.maximum(np.abs(f), np.abs(g))
    kept = np.zeros(len(k))  # the end that stayed: -1 a, 1 b
    for _ in range(STEPS):
        x = np.where(f == g, (a + b) / 2, b - g * (b - a) / np.where(f == g, 1, g - f))
        values = see(np.exp(x)).loop[rows, i]
        h = measure(values)
        left = h * f > 0
        g = np.where(left & (kept == 1), g / 2, np.where(left, g, h))
        f = np.where(~left & (kept == -1), f / 2, np.where(left, h, f))
        a, b, kept = np.where(left, x, a), np.where(left, b, x), np.where(left, 1.0, -1.0)
    return np.where(np.abs(h) > largest, np.nan, np.exp(x)), values


def find_tops(see: See, seen: Seen, measure: Callable[[Seen], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """The largest measure of each channel and its frequency, between the frequencies of `seen` as well."""
    values = measure(seen)
    k = values.argmax(axis=0)
    rows = np.arange(values.shape[1])
    best, at = values[k, rows], seen.w[k]
    inner = np.clip(k, 1, max(len(seen.w) - 2, 1))
    if len(seen.w) < 3:
        return best, at
    x = np.log(np.stack([seen.w[inner + d] for d in (-1, 0, 1)]))
    y = np.stack([values[inner + d, rows] for d in (-1, 0, 1)])
    for _ in range(PEAKS):
        edge = 1e-3 * (x[2] - x[0])
        tip = np.clip(_vertex(x, y), x[0] + edge, x[2] - edge)
        found = measure(see(np.exp(tip)))[rows, rows]
        better = found > best
        best, at = np.where(better, found, best), np.where(better, np.exp(tip), at)
        x, y = _about_top(x, y, tip, found)
    return best, at


def _vertex(x: FloatArray, y: FloatArray) -> FloatArray:
    """The top of the parabolas through three points each (3 x n); the middle point where there is none."""
    left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
    bend = (right - left) / (x[2] - x[0])
    safe = np.where(bend < 0, bend, -1)
    return np.asarray(np.where(bend < 0, (x[0] + x[1]) / 2 - left / (2 * safe), x[1]))


def _about_top(
    x: FloatArray, y: FloatArray, tip: FloatArray, found: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The highest of four points with its neighbours, columns of 3 x n; points that coincide are moved apart."""
    tip = np.where(np.abs(tip - x[1]) < 1e-9, x[1] + 1e-3 * (x[2] - x[1]), tip)
    order = np.argsort(np.vstack([x, tip]), axis=0)
    x, y = (
        np.take_along_axis(np.vstack([x, tip]), order, 0),
        np.take_along_axis(np.vstack([y, found]), order, 0),
    )
    middle = np.clip(y.argmax(axis=0), 1, 2)
    pick = np.stack([middle - 1, middle, middle + 1])
    return np.take_along_axis(x, pick, 0), np.take_along_axis(y, pick, 0)


def gain_range(crossings: list[Crossing]) -> tuple[tuple[float, float], tuple[float, float]]:
    """The factors about 1 that no crossing lies between, and the frequencies of both bounds."""
    factors = [(-1 / c.value.real, c.frequency) for c in crossings if c.value.real < 0]
    below = max((f for f in factors if 1 / FARTHEST < f[0] < 1), default=(0.0, math.nan))
    above = min((f for f in factors if 1 <= f[0] < FARTHEST), default=(math.inf, math.nan))
    return (below[0], above[0]), (below[1], above[1])


def phase_and_delay(crossings: list[Crossing]) -> tuple[float, float, float, float]:
    """The smallest turn (rad) and the shortest delay (s) that reach -1, each with its frequency."""
    turns, delays = [], []
    for w, value in crossings:
        lag = float(np.mod(np.angle(value) + np.pi, 2 * np.pi))
        turns.append((min(lag, 2 * np.pi - lag), w))
        delays.append((lag / w, w))
    none = (math.inf, math.nan)
    return *min(turns, default=none), *min(delays, default=none)


def margins_of_channel(
    name: str,
    crossings: tuple[list[Crossing], list[Crossing]],
    tops: tuple[tuple[float, float], tuple[float, float]],
    unstable: tuple[int, int],
) -> ChannelMargins:
    """The margins of a channel from its crossings, largest |S - 1/2| and |S|, and unstable poles, open and closed."""
    (half, half_at), (peak, peak_at) = tops
    stable = unstable[1] == 0
    nan = math.nan
    values: dict[str, Any] = dict.fromkeys(("phase", "phase_frequency", "delay", "delay_frequency"), nan)
    gain, at = (nan, nan), (nan, nan)
    if stable:
        gain, at = gain_range(crossings[1])
        values = dict(zip(values, phase_and_delay(crossings[0]), strict=True))
    return ChannelMargins(
        channel=name,
        stable=stable,
        gain=gain,
        gain_frequency=at,
        **values,
        disk=Disk(name, 1 / half if stable else nan, half_at if stable else nan),
        peak_sensitivity=peak if stable else nan,
        peak_frequency=peak_at if stable else nan,
        unstable_poles=unstable[0],
        encirclements=unstable[0] - unstable[1],
        gain_crossings=tuple(crossings[0]),
        phase_crossings=tuple(crossings[1]),
    )
