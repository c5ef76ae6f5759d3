"""The margins of one channel at a time, the others closed, at exact crossings; of unstable open loops as well.

l = T_ii / S_ii        what channel i sees around itself, negative feedback
1 + k l(jw) = 0        at the factors k = -1 / l where l is real and negative: 0, the Nyquist frequency and
                       infinity among them. The nearest below and above 1 bound the stable ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from malta.linear.peaks import Crossing, Peak, peak_gain, phase_crossings
from malta.loops.classical import Disk, Nominal, crossings_at, disk_system, phase_and_delay

MAX_GAIN_FACTOR = 1e6  # factors of gain beyond which a margin counts as infinite


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


def gain_range(crossings: Sequence[Crossing]) -> tuple[tuple[float, float], tuple[float, float]]:
    """The factors about 1 that no crossing lies between, and the frequencies of both bounds."""
    factors = [(-1 / c.value.real, c.frequency) for c in crossings if c.value.real < 0]
    below = max((f for f in factors if 1 / MAX_GAIN_FACTOR < f[0] < 1), default=(0.0, math.nan))
    above = min((f for f in factors if 1 <= f[0] < MAX_GAIN_FACTOR), default=(math.inf, math.nan))
    return (below[0], above[0]), (below[1], above[1])


def channel_margins(loop: Nominal, channel: int, name: str, unstable: tuple[int, int]) -> ChannelMargins:
    """The margins of one channel of `loop.closed`, the others closed.

    unstable : poles of the loop that grow, with this channel open and closed
    """
    S, stable, nan = loop.sensitivity(channel).balanced, unstable[1] == 0, math.nan
    gains = crossings_at(loop, channel)
    phases = tuple(Crossing(loop.frequency(w), value) for w, value in phase_crossings(S))
    values: dict[str, Any] = dict.fromkeys(("phase", "phase_frequency", "delay", "delay_frequency"), nan)
    gain, at, half, peak = (nan, nan), (nan, nan), Peak(nan, nan), Peak(nan, nan)
    if stable:
        gain, at = gain_range(phases)
        values = dict(zip(values, phase_and_delay(gains), strict=True))
        half, peak = peak_gain(disk_system(S)), peak_gain(S)
    return ChannelMargins(
        channel=name,
        stable=stable,
        gain=gain,
        gain_frequency=at,
        **values,
        disk=Disk(name, 1 / half.value, loop.frequency(half.frequency)),
        peak_sensitivity=peak.value,
        peak_frequency=loop.frequency(peak.frequency),
        unstable_poles=unstable[0],
        encirclements=unstable[0] - unstable[1],
        gain_crossings=gains,
        phase_crossings=phases,
    )
