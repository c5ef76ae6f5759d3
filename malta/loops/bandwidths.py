"""Peaks and bandwidths of a nominal loop: where S peaks, T falls and L crosses one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from malta.linear.falls import Fall, fall_frequencies
from malta.linear.peaks import Peak, joined_channels, largest_gain, part_of
from malta.loops.classical import Nominal


def peak_of_channels(loop: Nominal, channels: Sequence[int]) -> Peak:
    """The largest sigma_max of the sensitivities of some channels of `loop.closed`, cut at once."""
    sets = joined_channels(loop.closed, channels)
    value, at = largest_gain(part_of(loop.closed, own, own) for own in sets)
    return Peak(value, loop.frequency(at))


def tracked_band(loop: Nominal, rank: int | None = None) -> tuple[float, float]:
    """Where the smallest singular value of T first falls below 1 / sqrt(2), and the largest for the last time, rad/s.

    rank : of T, where it is less than the number of sensors
    """
    S, p = part_of(loop.closed, loop.sensors, loop.sensors), len(loop.sensors)
    T = replace(S, D=S.D - np.eye(p))
    smallest, largest = Fall((rank or p) - 1, last=False), Fall(0, last=True)
    first, last = fall_frequencies(T, math.sqrt(0.5), (smallest, largest))
    return loop.frequency(first), loop.frequency(last)


def last_crossover(loop: Nominal) -> float:
    """Where the largest singular value of the loop gain falls below 1 for the last time, rad/s."""
    return loop.frequency(fall_frequencies(loop.open, 1.0, (Fall(0, last=True),))[0])


def peak_sensitivity(loop: Nominal, at: Literal["forces", "sensors"]) -> float:
    """The largest |S_ii| over all frequencies and channels at nominal parameters; NaN for an unstable loop."""
    if not loop.stable:
        return float("nan")
    channels = loop.inputs if at == "forces" else loop.sensors
    return largest_gain(loop.sensitivity(i) for i in channels).value
