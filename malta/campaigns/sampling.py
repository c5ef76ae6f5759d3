"""Points of a design in the unit box, any consecutive ones of them without the others.

A campaign of a hundred million runs draws its machines block by block, on several computers: no point may need a table
of all. A Latin hypercube needs, for each dimension, a random permutation of its samples. Here that permutation is a
Feistel network on the pairs (l, r) of the numbers l + a r, 0 <= l < a, 0 <= r < b, with a b >= n, whose rounds

    l <- (l + F(r)) mod a    and    r <- (r + F(l)) mod b

can each be undone, so that the network permutes the numbers below a b. A number that comes out as n or more goes
through it again, until it is below n: what is left permutes the numbers below n. F is SplitMix64 of a key.

Sources: M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21(2), 1979 (Latin hypercubes); J. Black, P. Rogaway,
Ciphers with arbitrary finite domains, CT-RSA 2002 (networks on a b >= n, and the way back below n); I. M. Sobol, 1967,
and S. Joe, F. Y. Kuo, SIAM J. Sci. Comput. 30, 2008 (direction numbers, those of scipy.stats.qmc.Sobol).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from malta.simulation.noise import GAMMA, keys, mix

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

ROUNDS = 24  # so many that all 5040 permutations of 7 numbers come equally often; pairs are mixed after a few
JITTER = 22  # bits of a place in its stratum: 30 bits of strata, these and the half fill the 53 of a number
DIGITS = 30  # bits of a coordinate of a Sobol point


def latin_hypercube(seed: int, samples: int, dimensions: int, first: int, count: int) -> FloatArray:
    """Points first ... first + count - 1 of a Latin hypercube of `samples` points, count x dimensions.

    In each dimension every stratum [k/n, (k+1)/n) has one of the n = `samples` points, at a random place in it.

    >>> sorted((latin_hypercube(0, 4, 1, 0, 4)[:, 0] * 4).astype(int).tolist())
    [0, 1, 2, 3]
    """
    runs = np.arange(first, first + count, dtype=np.uint64)
    # Indices below 0: runs have the others, for their noise.
    streams = keys(seed, -1 - np.arange(2 * dimensions)).reshape(dimensions, 2)
    columns = []
    for permuting, placing in streams:
        stratum = permute(runs, samples, permuting).astype(float)
        place = mix(placing + runs * np.uint64(GAMMA)) >> np.uint64(64 - JITTER)
        columns.append((stratum + (place.astype(float) + 0.5) / 2**JITTER) / samples)
    return np.stack(columns, axis=1)


def permute(numbers: NDArray[np.uint64], size: int, key: np.uint64) -> NDArray[np.uint64]:
    """Where a permutation of 0 ... size - 1 takes some of these numbers. The key chooses the permutation."""
    a = math.isqrt(size - 1) + 1
    a += a % 2  # rounds of an odd a and an odd b would be even permutations, and make no others
    b = -(-size // a)
    found = _through_network(numbers, np.uint64(a), np.uint64(b), key)
    while (outside := found >= size).any():
        found[outside] = _through_network(found[outside], np.uint64(a), np.uint64(b), key)
    return found


def _through_network(
    numbers: NDArray[np.uint64], a: np.uint64, b: np.uint64, key: np.uint64
) -> NDArray[np.uint64]:
    right, left = np.divmod(numbers, a)
    for own in mix(key + np.arange(1, ROUNDS + 1, dtype=np.uint64) * np.uint64(GAMMA)).reshape(-1, 2):
        left = (left + mix(own[0] + right * np.uint64(GAMMA)) % a) % a
        right = (right + mix(own[1] + left * np.uint64(GAMMA)) % b) % b
    return np.asarray(left + a * right)


def sobol(seed: int, samples: int, dimensions: int, first: int, count: int) -> FloatArray:
    """Points first ... first + count - 1 of scipy's scrambled Sobol sequence, count x dimensions; to the bit.

    Point n is that of 0, xor the direction numbers of the ones in n xor n // 2, the Gray code of n.
    """
    start, directions = _directions(seed, max(samples - 1, 1).bit_length(), dimensions)
    runs = np.arange(first, first + count, dtype=np.uint64)
    gray = runs ^ (runs >> np.uint64(1))
    points = np.tile(start, (count, 1))
    for bit, direction in enumerate(directions):
        points ^= (
            np.where((gray >> np.uint64(bit)) & np.uint64(1), np.uint64(1), np.uint64(0))[:, None] * direction
        )
    return np.asarray(points / 2.0**DIGITS)


@lru_cache(maxsize=8)
def _directions(seed: int, bits: int, dimensions: int) -> tuple[NDArray[np.uint64], list[NDArray[np.uint64]]]:
    """Point 0 and the direction numbers of the first 2**bits points, as whole numbers below 2**DIGITS.

    The Gray code of 2**(k + 1) - 1 is 2**k: that point differs from point 0 by direction k alone.
    """
    from scipy.stats import qmc  # half a second to import

    sequence = qmc.Sobol(dimensions, rng=seed, bits=DIGITS)
    start, at, directions = _whole(sequence.random(1)), 1, []
    for bit in range(bits):
        sequence.fast_forward(2 ** (bit + 1) - 1 - at)
        at = 2 ** (bit + 1)
        directions.append(_whole(sequence.random(1)) ^ start)
    return start, directions


def _whole(points: FloatArray) -> NDArray[np.uint64]:
    return np.asarray(points[0] * 2.0**DIGITS).astype(np.uint64)
