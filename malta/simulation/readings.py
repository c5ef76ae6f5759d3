"""Readings of the sensors in a simulation: errors, lag, dead time, noise and resolution, added to true outputs.

    x --> [ errors ] --> [ lag ] --> [ dead time ] --+--> [ resolution ] --> y
                                                noise-+

Lag and dead time have states beside those of the machine:

    lagged  behind the lag of each output
    late    blocks of all outputs: the reading of the next sample, those of whole samples under way, and the one that is
            caught within a sample, at the rest of the dead time before its end
    clock   time since the last sample, s; also where commands begin to act within a sample
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from malta.arrays import FloatArray
from malta.model.plant import Plant
from malta.simulation.layout import LoopPlan, Setup

CLOCK_ROUNDING = 1e-6  # share of a step that rounding may take from the clock


def signals(loop: LoopPlan, x: Any) -> Any:
    """The outputs at a state with the errors of the sensors."""
    plant = loop.plant
    return plant.sensors.sense(x, loop.numbers["errors"]) if loop.setup.sensed else plant.h(x, 0)


def measurement(loop: LoopPlan, machine: Mapping[str, Any], noise: Any) -> Any:
    """y: what the sensors read now, with noise and, where the setup says so, resolution."""
    plant, s = loop.plant, loop.setup
    now = signals(loop, machine["x"])
    if s.late is not None:
        now = machine["late"][: now.numel()]
    elif s.lagging:
        now = machine["lagged"]
    y = now + noise
    if not s.quantize:
        return y
    steps = plant.sensors.resolution
    return ca.vertcat(
        *(
            y[i] if _is_zero(step) else ca.if_else(step > 0, step * ca.floor(y[i] / step + 0.5), y[i])
            for i, step in enumerate(steps)
        )
    )


def step_readings(loop: LoopPlan, machine: Mapping[str, Any], x: Any) -> dict[str, Any]:
    """The states of the sensors after a step that took the machine to x."""
    s, h = loop.setup, loop.numbers["substep"]
    states: dict[str, Any] = {}
    if "clock" in machine:
        states["clock"] = ca.if_else(_ends_sample(loop, machine), 0, machine["clock"] + h)
    if not s.lagging and s.late is None:
        return states
    before, after = signals(loop, machine["x"]), signals(loop, x)
    if s.lagging:
        after = _lag_outputs(machine["lagged"], before, after, loop.plant.sensors.lag, h)
        before = machine["lagged"]
        states["lagged"] = after
    if s.late is not None:
        states |= _late(loop, machine, before, after)
    return states


def initial_readings(plant: Plant, s: Setup, x: Any) -> dict[str, Any]:
    """The states of the sensors of a machine that has been at rest at x."""
    p = plant.h(x, 0)
    return {"lagged": p, "late": p if s.late is None else ca.repmat(p, s.late + 2, 1)}


def _lag_outputs(s: Any, before: Any, after: Any, lags: tuple[Any, ...], h: Any) -> Any:
    """Readings behind lags after a step h, exactly for signals that grow evenly in it: s' = (p - s) / lag."""
    found = []
    for k, lag in enumerate(lags):
        if _is_zero(lag):
            found.append(after[k])
            continue
        rate = 1 / ca.fmax(lag, 1e-12)  # a lag of 0 among others in a campaign
        left = ca.exp(-h * rate)
        behind = (after[k] - before[k]) / (h * rate)
        found.append(after[k] - behind * (1 - left) + left * (s[k] - before[k]))
    return ca.vertcat(*found)


def _ends_sample(loop: LoopPlan, machine: Mapping[str, Any]) -> Any:
    """Whether a step is the last one of its sample."""
    h = loop.numbers["substep"]
    last = loop.numbers.get("last_substep", h)
    return machine["clock"] + h > loop.numbers["control_time"] - last / 2


def _late(loop: LoopPlan, machine: Mapping[str, Any], before: Any, after: Any) -> dict[str, Any]:
    """The blocks of late readings after a step in which the readings went from `before` to `after`."""
    plant, _, s, g = loop
    assert s.late is not None
    Ts, h, p = g["control_time"], g["substep"], after.numel()
    rest = plant.sensors.dead_time - s.late * Ts
    share = (Ts - rest - machine["clock"]) / h  # of this step, until the reading is caught
    caught = ca.logic_and(share > CLOCK_ROUNDING, share < 1 + CLOCK_ROUNDING)
    blocks = machine["late"]
    last = ca.if_else(caught, before + share * (after - before), blocks[-p:])
    ends = _ends_sample(loop, machine)
    moved = ca.vertcat(blocks[p:-p], last)
    return {"late": ca.vertcat(ca.if_else(ends, moved, blocks[:-p]), last)}


def _is_zero(step: Any) -> bool:
    return isinstance(step, float | int) and step == 0


# Reproducible white noise: the same numbers to the bit here and in the lanes of the compiled engine.
#
# SplitMix64 (Steele, Lea, Flood 2014) of a key and a counter gives 64 bits: 32 for the radius and 32 for the angle of
# two normal numbers (Box–Muller), which are computed in single precision. The noise of a run depends on its seed and
# index only, not on workers or order.


_Keys = TypeVar("_Keys", np.uint64, "NDArray[np.uint64]")
GAMMA = 0x9E3779B97F4A7C15
NOISE_SAMPLES_AT_ONCE = 4  # samples whose noise the engine draws at once
_SIGN = np.uint32(0x80000000)
# log(1 + f) / f, cos(pi a) and sin(pi a) / a of a^2: minimax, errors about 1e-7
LOGARITHM = (
    0.99999992,
    -0.50000344,
    0.33335607,
    -0.24971558,
    0.19884252,
    -0.17212471,
    0.16338027,
    -0.10378417,
)
COSINE = (0.99999995, -4.93479283, 4.05841135, -1.33187657, 0.21968961)
SINE = (3.14159264, -5.1677101, 2.5500775, -0.59829129, 0.07765766)


def keys(seed: int, indices: NDArray[np.int64]) -> NDArray[np.uint64]:
    """The key of each run of a campaign, from the campaign's seed and the run's index."""
    stream = mix(np.array([(seed * GAMMA + 1) % 2**64], dtype=np.uint64))
    return mix(stream + (indices.astype(np.uint64) + np.uint64(1)) * np.uint64(0xD1342543DE82EF95))


def normals(key: np.uint64, samples: int, channels: int) -> FloatArray:
    """Standard normal numbers, samples x channels. A row does not depend on the number of samples.

    >>> normals(keys(0, np.array([0]))[0], 2, 3).shape
    (2, 3)
    """
    pairs = (samples + 1) // 2 * channels
    bits = mix(key + np.arange(pairs, dtype=np.uint64) * np.uint64(GAMMA))
    radius = np.sqrt(np.float32(-2) * _log_of_share((bits >> np.uint64(32)).astype(np.uint32)))
    low = bits.astype(np.uint32)  # the angle: the right half of the circle in half turns, and either sign
    half_turns = ((low << np.uint32(1)) ^ _SIGN).view(np.int32).astype(np.float32) * np.float32(2**-32)
    radius = (radius.view(np.uint32) ^ (low & _SIGN)).view(np.float32)
    square = half_turns * half_turns
    drawn = np.stack(
        [radius * _polynomial(square, COSINE), radius * (half_turns * _polynomial(square, SINE))], axis=1
    )
    return drawn.astype(float).reshape(-1, channels)[:samples]


def _log_of_share(whole: NDArray[np.uint32]) -> NDArray[np.float32]:
    """log(u / 2^32) of odd numbers u: u = m 2^k with m from sqrt(1/2) to sqrt(2), and log m by a polynomial."""
    u = (whole | np.uint32(1)).astype(np.float32).view(np.int32)
    k = (u - np.int32(0x3F3504F3)) >> np.int32(23)
    f = (u - (k << np.int32(23))).view(np.float32) - np.float32(1)
    return f * _polynomial(f, LOGARITHM) + np.float32(0.69314718) * (k - np.int32(32)).astype(np.float32)


def _polynomial(x: NDArray[np.float32], coefficients: tuple[float, ...]) -> NDArray[np.float32]:
    """A polynomial by Horner's scheme, the highest power last; every operation is rounded to single precision."""
    value: NDArray[np.float32] = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = np.float32(coefficient) + x * value
    return value


def starts_of_parts(samples: int, parts: int) -> list[int]:
    """The first sample of each of `parts` nearly equal parts of a run: even numbers, as samples are drawn in pairs."""
    pairs = (samples + 1) // 2
    return [2 * (k * pairs // parts) for k in range(parts)]


def advance_keys(stream: _Keys, sample: int, channels: int) -> _Keys:
    """The key, or keys, whose first row of `normals` is row `sample`, an even number, of the given ones."""
    with np.errstate(over="ignore"):  # modulo 2^64 is meant
        return stream + np.uint64(sample // 2 * channels * GAMMA % 2**64)


def normals_of_parts(streams: NDArray[np.uint64], samples: int, channels: int) -> FloatArray:
    """Standard normal numbers, samples x channels: the rows of part k of the run are those of `normals(streams[k])`.

    >>> streams = keys(0, np.array([7, 7]))
    >>> np.array_equal(normals_of_parts(streams, 100, 3), normals(streams[0], 100, 3))
    True
    """
    starts = starts_of_parts(samples, len(streams))
    parts = zip(streams, starts, [*starts[1:], samples], strict=True)
    return np.concatenate(
        [normals(advance_keys(key, start, channels), end - start, channels) for key, start, end in parts]
    )


def mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The output function of SplitMix64."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
