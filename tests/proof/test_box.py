"""Boxes of parameters hold what is claimed of them: their ends are rounded outwards, t of cells downwards."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

import malta
from malta.proof.box import Box, box_of
from malta.proof.exclusion import growth_over


def one(nominal: float, value: float | tuple[float, float], *, fixed: bool = False) -> Box:
    limits = [(-math.inf, math.inf)]
    if not fixed:
        return box_of(("p",), np.array([nominal]), limits, {"p": value}, {})
    assert isinstance(value, tuple)
    return box_of(("p",), np.array([nominal]), limits, {}, {"p": value}, empty=True)


def exact_ends(nominal: float, value: float | tuple[float, float], t: float) -> tuple[Fraction, Fraction]:
    middle, times = Fraction(nominal), Fraction(t)
    if isinstance(value, tuple):
        low, high = (Fraction(x) for x in value)
    else:
        low, high = middle - abs(middle) * Fraction(value), middle + abs(middle) * Fraction(value)
    return middle - times * (middle - low), middle + times * (high - middle)


@pytest.mark.parametrize("seed", range(3))
def test_sides_hold_the_box_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for nominal, share, t in rng.uniform([-9, 0, 0], [9, 1, 4], (400, 3)).tolist():
        for value in (share, (nominal - share * 0.7, nominal + share)):
            low, high = exact_ends(nominal, value, t)
            first, last = one(nominal, value).sides(t)[0].tolist()
            assert Fraction(first) <= low
            assert high <= Fraction(last)
            assert Fraction(last) - high < Fraction(2 * (t + 1) * math.ulp(abs(nominal) + share))


def test_sides_meet_limits_and_zero_and_do_not_cross_them() -> None:
    box = one(0.3, (0.1, 0.4))  # 0.3 - 1.5 * (0.3 - 0.1) is 2e-17 above zero, or below
    t = 0.3 / 0.2
    for _ in range(20):
        t = math.nextafter(t, 0)
        low, _ = exact_ends(0.3, (0.1, 0.4), t)
        assert box.sides(t)[0, 0] <= low
        if low >= Fraction(math.ulp(0.1)):
            assert box.sides(t)[0, 0] >= 0
    assert one(2.0, (0.0, 3.0)).sides(1.0).tolist() == [[0.0, 3.0]]
    assert one(-1.0, (-2.0, 0.0)).sides(1.0).tolist() == [[-2.0, 0.0]]


def test_intervals_that_do_not_grow_are_what_was_asked_for() -> None:
    for ends in ((1e-20, 1.0), (0.1, 0.7), (-0.3, 1 / 3)):
        box = one(0.3, ends, fixed=True)
        assert box.sides(3.7).tolist() == [list(ends)]
        assert sorted(box.nominal_places()[:, 0].tolist()) == sorted({0.3, *ends, sum(ends) / 2})


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("digits", [3, 40, 10**12])
def test_no_cell_is_said_to_begin_later_than_it_does(inverted: bool, digits: int) -> None:
    """Boxes of a few digits about 5.4e6 lose about a digit; rounded to nearest, they gained one."""
    rng, nominal = np.random.default_rng(digits), 5.4e6
    width = digits * math.ulp(nominal)
    box = one(nominal, (nominal - width, nominal + width))
    growth = growth_over(box.sides(2.0), (inverted,), box)
    ends = Fraction(growth.low[0]), Fraction(growth.high[0])
    for a, b in np.sort(rng.uniform(0, 1, (500, 2)), axis=1).tolist():
        low, high = (ends[0] + (ends[1] - ends[0]) * Fraction(u) for u in (a, b))
        if inverted:
            low, high = 1 / high, 1 / low
        away = max(low - Fraction(nominal), Fraction(nominal) - high, Fraction(0))
        t = growth.smallest(np.array([[[a, b]]])).item()
        assert Fraction(t) <= away / Fraction(width)
        assert float(away / Fraction(width)) - t < 20 / digits
        assert growth.inside(t)[0, 0] <= 1


@pytest.mark.parametrize("inverted", [False, True])
def test_the_part_of_a_box_within_another_is_not_too_small(inverted: bool) -> None:
    rng, nominal = np.random.default_rng(1), 5.4e6
    for digits in (38, 10**6, 10**14):
        width = digits * math.ulp(nominal)
        box = one(nominal, (nominal - width, nominal + width))
        growth = growth_over(box.sides(3.0), (inverted,), box)
        ends = Fraction(growth.low[0]), Fraction(growth.high[0])
        for t in rng.uniform(0, 3, 100).tolist():
            low, high = (ends[0] + (ends[1] - ends[0]) * Fraction(u) for u in growth.inside(t)[0].tolist())
            if inverted:
                low, high = 1 / high, 1 / low
            if high < Fraction(box.sides(3.0)[0, 1]):
                assert high >= Fraction(nominal) + Fraction(t) * Fraction(width)
            if low > Fraction(box.sides(3.0)[0, 0]):
                assert low <= Fraction(nominal) - Fraction(t) * Fraction(width)


@pytest.mark.slow
def test_a_box_of_a_few_digits() -> None:
    """s + p - c, stable where p > c, which is 38 digits below the nominal value."""
    nominal, digit = 5.4e6, math.ulp(5.4e6)
    lost = nominal - 38 * digit
    for digits in (10, 19, 30):
        box = (nominal - digits * digit, nominal + digits * digit)
        found = malta.proof.margin_of_polynomial(lambda p: [1, p - lost], {"p": box}, {"p": nominal})
        assert found.lower is not None
        assert 0.8 * 38 / digits <= found.lower <= 38 / digits
