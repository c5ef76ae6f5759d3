"""Reproducible white noise: the same numbers here and in the lanes of the compiled engine.

SplitMix64 (Steele, Lea, Flood 2014) of a key and a counter gives 64 bits: 32 for the radius and 32 for the angle of two
normal numbers (Box–Muller). The noise of a run depends on its seed and index only, not on workers or order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

_Keys = TypeVar("_Keys", np.uint64, "NDArray[np.uint64]")
GAMMA = 0x9E3779B97F4A7C15


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
    unit = 1 / 2**32
    radius = np.sqrt(-2 * np.log(((bits >> np.uint64(32)).astype(float) + 0.5) * unit))
    quadrant = ((bits >> np.uint64(30)) & np.uint64(3)).astype(float)
    middle = 536870911.5  # of the range of the 30 bits within a quadrant
    within = ((bits & np.uint64(0x3FFFFFFF)).astype(float) - middle) / 2**30
    angle = (quadrant + within) * (np.pi / 2)
    drawn = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return drawn.reshape(-1, channels)[:samples]


def starts_of_parts(samples: int, parts: int) -> list[int]:
    """The first sample of each of `parts` nearly equal parts of a run: even numbers, as samples are drawn in pairs."""
    pairs = (samples + 1) // 2
    return [2 * (k * pairs // parts) for k in range(parts)]


def advanced(stream: _Keys, sample: int, channels: int) -> _Keys:
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
        [normals(advanced(key, start, channels), end - start, channels) for key, start, end in parts]
    )


def mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The output function of SplitMix64."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
