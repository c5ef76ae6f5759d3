"""Sensor noise: standard normal, white, and every stream its own, whatever else is drawn."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

from malta.simulation.readings import GAMMA, keys, normals

if TYPE_CHECKING:
    from malta.arrays import FloatArray

SEED = st.integers(0, 2**64)
RUNS = 64
SAMPLES = 20_000  # of 5 channels: 100 000 numbers a stream


def _key(seed: int = 0, run: int = 0) -> np.uint64:
    return np.uint64(keys(seed, np.array([run]))[0])


@pytest.fixture(scope="module")
def drawn() -> FloatArray:
    """Five channels of a stream, a million numbers."""
    return normals(_key(seed=7), 200_000, 5)


def test_the_numbers_are_split_mix_and_box_muller() -> None:
    """By hand, with Python's integers and the constants of Steele, Lea and Flood: 32 bits make the radius of each pair,
    the other 32 its angle, evenly all around. The pairs are made in single precision, of which 24 bits are left."""

    def mixed(x: int) -> int:
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
        x = (x ^ (x >> 27)) * 0x94D049BB133111EB % 2**64
        return x ^ (x >> 31)

    assert GAMMA == 0x9E3779B97F4A7C15
    # Published first outputs of SplitMix64 from the state 0: its counter is one gamma on.
    assert [hex(mixed(k * GAMMA % 2**64)) for k in (1, 2)] == ["0xe220a8397b1dcdaf", "0x6e789e6aa1b965f4"]
    a, b = normals(np.uint64(GAMMA), 4000, 1).reshape(2, -1, 2)[0].T
    bits = [mixed((1 + count) * GAMMA % 2**64) for count in range(len(a))]
    radius = [math.sqrt(-2 * math.log(((x >> 32) + 0.5) / 2**32)) for x in bits]
    assert np.hypot(a, b) == pytest.approx(radius, rel=3e-7, abs=2e-6)
    turned = np.arctan2(b, a) / (math.pi / 2) - np.array([(x & 0xFFFFFFFF) / 2**30 for x in bits])
    assert np.std((turned - turned[0] + 0.5) % 1) < 3e-7  # the same for all: where the angle starts is free
    assert np.std((turned - turned[0] + 2) % 4) < 3e-7


def test_moments_are_those_of_the_normal_distribution(drawn: FloatArray) -> None:
    """Mean, variance, skewness and kurtosis of each channel within five of their standard errors."""
    n = len(drawn)
    assert np.abs(drawn.mean(axis=0)).max() < 5 / math.sqrt(n)
    assert np.abs(drawn.var(axis=0) - 1).max() < 5 * math.sqrt(2 / n)
    assert np.abs(stats.skew(drawn)).max() < 5 * math.sqrt(6 / n)
    assert np.abs(stats.kurtosis(drawn)).max() < 5 * math.sqrt(24 / n)


@pytest.mark.slow
def test_the_distribution_is_normal_into_its_tails(drawn: FloatArray) -> None:
    """Kolmogorov and Smirnov's distance of a million numbers, and what lies beyond 2, 3, 4 and 4.5 sigma."""
    values = drawn.ravel()
    assert stats.kstest(values, "norm").statistic < 1.95 / math.sqrt(
        len(values)
    )  # one in a thousand is larger
    for limit in (2.0, 3.0, 4.0, 4.5):
        for side in (values, -values):
            expected = len(values) * stats.norm.sf(limit)
            assert abs((side > limit).sum() - expected) < 5 * math.sqrt(expected) + 1
    assert 4.5 < np.abs(values).max() < math.sqrt(-2 * math.log(2**-33)) == pytest.approx(6.76, abs=0.01)


def test_it_is_white_and_its_channels_are_independent(drawn: FloatArray) -> None:
    """Correlations over lags of 0 to 20 samples, of every pair of channels: none beyond five standard errors. The
    pairs of Box and Muller share a radius, so the squares are looked at too."""
    n = len(drawn) - 20
    for values in (drawn, (drawn**2 - 1) / math.sqrt(2)):
        for lag in range(21):
            correlation = values[:n].T @ values[lag : lag + n] / n
            if lag == 0:
                correlation -= np.diag(np.diag(correlation))
            assert np.abs(correlation).max() < 5 / math.sqrt(n), lag


def test_the_spectrum_is_flat(drawn: FloatArray) -> None:
    """Power in 100 bands of 1000 frequencies each: 1 within five standard errors, none favoured."""
    power = np.abs(np.fft.rfft(drawn[:, 0])[1:100_001]) ** 2 / len(drawn)
    bands = power.reshape(100, 1000).mean(axis=1)
    assert np.abs(bands - 1).max() < 5 / math.sqrt(1000)


def test_runs_and_seeds_are_independent_streams() -> None:
    """64 runs of a seed, and a run of 64 seeds: correlations as of independent numbers, all keys different."""
    limit = 5.5 / math.sqrt(SAMPLES)
    same_seed = keys(3, np.arange(RUNS))
    same_run = np.array([_key(seed) for seed in range(RUNS)])
    for chosen in (same_seed, same_run):
        streams = np.array([normals(key, SAMPLES // 5, 5).ravel() for key in chosen])
        correlation = np.corrcoef(streams) - np.eye(RUNS)
        assert np.abs(correlation).max() < limit
    assert len({*same_seed.tolist(), *same_run.tolist()}) == 2 * RUNS - 1  # run 3 of seed 3 is in both
    assert len(set(keys(0, np.arange(100_000)).tolist())) == 100_000


def test_no_two_streams_meet() -> None:
    """Streams are one sequence from different starts; those of 1000 runs lie more than a second of samples apart."""
    starts = keys(0, np.arange(1000))
    inverse = pow(GAMMA, -1, 2**64)
    places = np.sort(np.array([int(key) * inverse % 2**64 for key in starts], dtype=np.uint64))
    assert int(np.diff(places).min()) > 20_000 * 5


@given(seed=SEED, run=st.integers(0, 2**31), samples=st.integers(1, 60), more=st.integers(0, 60))
def test_what_is_drawn_first_does_not_depend_on_what_follows(
    seed: int, run: int, samples: int, more: int
) -> None:
    key = _key(seed, run)
    few = normals(key, samples, 5)
    assert few.shape == (samples, 5)
    assert np.isfinite(few).all()
    assert np.array_equal(few, normals(key, samples + more, 5)[:samples])


@given(seed=SEED, runs=st.lists(st.integers(0, 2**31), min_size=1, max_size=8))
def test_the_key_of_a_run_does_not_depend_on_its_company(seed: int, runs: list[int]) -> None:
    together = keys(seed, np.array(runs))
    assert together.tolist() == [int(_key(seed, run)) for run in runs]


def test_channels_share_one_sequence() -> None:
    """It is dealt out row by row: how many channels take it changes who gets which number, not the numbers."""
    key = _key(seed=5)
    for samples, channels in ((60, 1), (30, 2), (20, 3), (12, 5), (4, 15)):
        assert np.array_equal(normals(key, samples, channels).ravel(), normals(key, 60, 1).ravel())
