"""Peaks and bandwidths of a nominal loop: where S peaks, T falls and L crosses one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from malta.linear.falls import Fall, fall_frequencies
from malta.linear.peaks import Peak, joined_channels, largest_gain, part_of
from malta.loops.classical import Nominal

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.plant import Plant


def peak_of_channels(loop: Nominal, channels: Sequence[int]) -> Peak:
    """The largest sigma_max of the sensitivities of some channels of `loop.closed`, cut at once."""
    sets = joined_channels(loop.closed, channels)
    value, at = largest_gain(part_of(loop.closed, own, own) for own in sets)
    return Peak(value, loop.frequency(at))


def in_sizes(loop: Nominal, sizes: FloatArray | None, outputs: Sequence[int] | None = None) -> Nominal:
    """The same loop with readings in multiples of these sizes, SI; singular values of unlike units are of no use.

    sizes : of each sensor; None: as they are
    outputs : sensors that the loop has, of a part of the machine; None: all
    """
    if sizes is None:
        return loop
    sizes = sizes if outputs is None else sizes[list(outputs)]
    P, F, column = loop.P, loop.F, sizes[:, None]
    plant = replace(P, C=P.C / column, D=P.D / column)
    return replace(loop, P=plant, F=replace(F, B=F.B * sizes, D=F.D * sizes))


def reading_sizes(plant: Plant, believed: FloatArray | None) -> FloatArray | None:
    """Sizes in which readings of unlike units are compared: the machine's noise, its sensors' ranges, or what a design
    believes. None where all have one unit, and where nothing is known.

    believed : variance of the noise of each sensor that the design is made for; None: it has none
    """
    if len({signal.unit for signal in plant.outputs}) == 1:
        return None
    variance = np.zeros(0) if believed is None else believed
    known = (plant.sensors.deviations, np.asarray(plant.sensors.range), np.sqrt(np.asarray(variance)))
    found = (one for one in known if one.size == len(plant.outputs) and (one > 0).all())
    return next(found, None)


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
