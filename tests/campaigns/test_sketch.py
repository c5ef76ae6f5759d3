"""Sketches of distributions: within their accuracy of numpy, and the same to the bit in any order."""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from malta.campaigns import summary as module
from malta.campaigns.summary import ACCURACY, MAX_EXACT_VALUES, Sketch, histogram, merge, quantiles, sketch_of

SHARES = (0.0, 0.01, 0.05, 0.5, 0.95, 0.99, 0.999, 1.0)
LIMIT = 50  # values that are kept in these tests
finite = st.floats(
    allow_nan=False, allow_infinity=False, allow_subnormal=False, min_value=-1e300, max_value=1e300
)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_EXACT_VALUES", LIMIT)


def _content(sketch: Sketch) -> Any:
    values = np.sort(np.concatenate([*sketch.values, np.empty(0)])).tobytes()
    return (
        sketch.count,
        sketch.smallest,
        sketch.largest,
        values,
        {k: v.tobytes() for k, v in sketch.counts.items()},
    )


@settings(deadline=None)
@given(
    sign=st.sampled_from([1.0, -1.0]),
    magnitudes=st.lists(st.floats(1e-300, 1e300), min_size=1, max_size=200),
    zeros=st.integers(0, 20),
)
def test_quantiles_are_within_the_accuracy_of_those_of_numpy(
    sign: float, magnitudes: list[float], zeros: int
) -> None:
    """Of values of one sign, where an error relative to a value is one relative to what lies between two of them."""
    values = sign * np.array(magnitudes + [0.0] * zeros)
    found, wanted = quantiles(sketch_of(values), SHARES), np.quantile(values, SHARES)
    if len(values) <= LIMIT:
        assert np.array_equal(found, wanted)
    assert (np.abs(found - wanted) <= ACCURACY * np.abs(wanted) * (1 + 1e-9)).all()
    assert (np.diff(found) >= 0).all()
    assert (found[0], found[-1]) == (values.min(), values.max())


@pytest.mark.slow
@settings(deadline=None)
@given(parts=st.lists(st.lists(finite, max_size=40), min_size=1, max_size=8), seed=st.integers(0, 99))
def test_order_and_grouping_of_merges_change_no_bit(parts: list[list[float]], seed: int) -> None:
    """One after another, in another order, in pairs of pairs, and all values at once."""
    sketches = [sketch_of(np.array(part)) for part in parts]
    wanted = sketch_of(np.concatenate([np.array(part) for part in parts]))
    shuffled = [sketches[k] for k in np.random.default_rng(seed).permutation(len(sketches))]
    half = len(sketches) // 2
    found = [
        reduce(merge, sketches),
        reduce(merge, shuffled, Sketch()),
        merge(reduce(merge, sketches[:half], Sketch()), reduce(merge, sketches[half:], Sketch())),
    ]
    for one in found:
        assert _content(one) == _content(wanted)
        assert np.array_equal(quantiles(one, SHARES), quantiles(wanted, SHARES), equal_nan=True)
    assert wanted.exact == (wanted.count <= LIMIT)


@pytest.mark.parametrize("scale", [1.0, 1e-7, -3e4])
def test_a_histogram_counts_what_lies_between_its_edges(scale: float) -> None:
    """Bins as wide as some buckets: counts are off by what the buckets at the edges have, and sums are kept."""
    values = scale * (1 + 0.01 * np.random.default_rng(0).standard_normal(20_000))
    edges = np.linspace(values.min(), values.max(), 41)
    found, wanted = histogram(sketch_of(values), edges), np.histogram(values, edges)[0]
    assert found.sum() == pytest.approx(20_000)
    assert np.abs(found - wanted).max() < 20
    assert np.array_equal(histogram(sketch_of(values[:9]), edges), np.histogram(values[:9], edges)[0])
    assert histogram(Sketch(), edges).sum() == 0


def test_memory_is_that_of_the_range_not_of_the_values() -> None:
    rng = np.random.default_rng(0)
    found = Sketch()
    for _ in range(30):
        found = merge(found, sketch_of(rng.uniform(1e-6, 1e-3, 4000)))
    assert (found.count, found.values) == (120_000, ())
    assert len(found.counts) <= 11  # powers of two
    assert sum(part.nbytes for part in found.counts.values()) <= 11 * 8 * 2**module.BITS
    assert MAX_EXACT_VALUES == 100_000
    assert np.isnan(quantiles(Sketch(), [0.5])).all()


def test_the_rank_of_a_quantile_is_exact_where_values_grow_fast() -> None:
    """Values that double every 40: a rank that is off by 2e-4 of itself is off by 30 times the accuracy."""
    values = np.exp2(np.arange(200_000) / 100.0 % 900)
    values.sort()
    found = quantiles(sketch_of(values), [0.3, 0.5, 0.9])
    assert found == pytest.approx(np.quantile(values, [0.3, 0.5, 0.9]), rel=2 * ACCURACY)


def test_zeros_beside_other_values_are_zero() -> None:
    """The bucket of zero reaches to 3e-312, whose middle is no value."""
    values = np.concatenate([np.zeros(150_000), np.ones(1_000), -np.ones(10)])
    found = quantiles(sketch_of(values), [0.0, 0.01, 0.5, 0.9, 1.0])
    assert found.tolist() == [-1.0, 0.0, 0.0, 0.0, 1.0]
