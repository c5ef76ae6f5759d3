"""Designs by blocks: any points of a Latin hypercube or a Sobol sequence, without the others."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.stats import chi2, qmc

from malta.campaigns.plan import MAX_RUNS, latin_hypercube, permute, sobol
from malta.simulation.readings import keys


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**70),
    samples=st.integers(1, 3000),
    dimensions=st.integers(1, 5),
    cuts=st.lists(st.integers(0, 3000), max_size=3),
)
def test_every_stratum_has_one_point_and_blocks_change_none(
    seed: int, samples: int, dimensions: int, cuts: list[int]
) -> None:
    whole = latin_hypercube(seed, samples, dimensions, 0, samples)
    for column in whole.T:
        assert np.array_equal(np.sort(np.floor(column * samples)), np.arange(samples))
    places = [0, *sorted(min(cut, samples) for cut in cuts), samples]
    parts = [latin_hypercube(seed, samples, dimensions, a, b - a) for a, b in pairwise(places)]
    assert np.array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("size", [3, 4, pytest.param(7, marks=pytest.mark.slow)])
def test_all_permutations_come_equally_often(size: int) -> None:
    """Chi-squared of so many keys for each: 7 numbers fail with 12 rounds, and with both sides odd."""
    every, times = math.factorial(size), 6
    each = np.repeat(keys(3, np.arange(times * every))[:, None], size, axis=1)
    numbers = np.broadcast_to(np.arange(size, dtype=np.uint64), each.shape)
    found = Counter(map(tuple, permute(numbers, size, each).tolist()))
    squares = sum((n - times) ** 2 for n in found.values()) + (every - len(found)) * times**2
    assert chi2.sf(squares / times, every - 1) > 1e-4


@pytest.mark.slow
def test_dimensions_and_neighbours_are_independent() -> None:
    """Correlations of 200 designs are as wide as those of random permutations: 1 / sqrt(n - 1)."""
    n, across, along = 400, [], []
    for seed in range(200):
        points = latin_hypercube(seed, n, 3, 0, n)
        across += np.asarray(np.corrcoef(points.T))[np.triu_indices(3, 1)].tolist()
        along.append(np.asarray(np.corrcoef(points[1:, 0], points[:-1, 0]))[0, 1])
    for found in (across, along):
        assert np.std(found) * np.sqrt(n - 1) == pytest.approx(1, abs=0.2)
        assert abs(np.mean(found)) * np.sqrt(n * len(found)) < 4


def test_the_largest_plan_keeps_every_point_in_its_stratum() -> None:
    points = latin_hypercube(1, MAX_RUNS, 2, MAX_RUNS - 5000, 5000)
    strata = np.floor(points * MAX_RUNS)
    assert points.min() > 0
    assert points.max() < 1
    for column in strata.T:
        assert len(set(column.tolist())) == 5000
    numbers = np.array([0, 1, MAX_RUNS - 1], dtype=np.uint64)
    assert np.array_equal(
        np.floor(latin_hypercube(1, MAX_RUNS, 1, MAX_RUNS - 1, 1)[:, 0] * MAX_RUNS),
        permute(numbers, MAX_RUNS, keys(1, np.array([-1]))[0])[-1:],
    )


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**40),
    samples=st.integers(1, 900),
    dimensions=st.integers(1, 7),
    cut=st.integers(0, 900),
)
def test_sobol_points_are_those_of_scipy(seed: int, samples: int, dimensions: int, cut: int) -> None:
    """To the bit, from any point on."""
    wanted = qmc.Sobol(dimensions, rng=seed).random_base2(max(samples - 1, 1).bit_length())[:samples]
    first = min(cut, samples - 1)
    assert np.array_equal(sobol(seed, samples, dimensions, first, samples - first), wanted[first:])
