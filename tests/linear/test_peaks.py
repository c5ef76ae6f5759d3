"""Peaks and crossings of random loops with light damping, against grids that are dense about every pole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from light_loops import Drawn, drawn_loop

from malta.linear.falls import Fall, fall_frequencies
from malta.linear.peaks import gain_crossings, in_plane, of_plane, part_of, peak_gain, phase_crossings
from malta.linear.system import System

if TYPE_CHECKING:
    pass


def check_loop(loop: Drawn) -> None:
    """No peak is below the grid's by 1e-6 or above its neighbours' by more than they show; no crossing is missed."""
    w = loop.grid()
    S = np.linalg.inv(np.eye(len(loop.C)) + loop.gain(w))
    plane = in_plane(loop.S, loop.T).balanced
    largest = np.linalg.norm(S, 2, axis=(1, 2)).max()
    assert (1 - 1e-6) * largest <= peak_gain(plane).value <= (1 + 2e-4) * largest
    for k in range(len(loop.C)):
        own = part_of(plane, [k], [k])
        found, seen = peak_gain(own), np.abs(S[:, k, k]).max()
        assert (1 - 1e-6) * seen <= found.value <= (1 + 2e-4) * seen
        own_gain = 1 / S[:, k, k] - 1
        inner = [c.frequency for c in phase_crossings(own) if 0 < c.frequency < math.inf]
        real = (own_gain.real[:-1] < 0) & (own_gain.real[1:] < 0)
        real &= np.abs(own_gain.imag[:-1]) > 1e-12 * np.abs(own_gain[:-1])
        for measure, those, where in (
            (np.log(np.abs(own_gain)), [c.frequency for c in gain_crossings(own)], True),
            (own_gain.imag, inner, real),
        ):
            at = np.flatnonzero((np.sign(measure[1:]) * np.sign(measure[:-1]) < 0) & where)
            known = of_plane(np.array(those), loop.T)
            for i in at:
                near = np.abs(known - w[i]).min(initial=math.inf)
                assert near <= 2 * (w[i + 1] - w[i]) + 1e-9 * w[i]


@pytest.mark.parametrize("seed", [0, 2, 6])
def test_no_peak_and_no_crossing_is_missed(seed: int) -> None:
    check_loop(drawn_loop(seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 400))
def test_no_peak_and_no_crossing_of_three_hundred_is_missed(seed: int) -> None:
    check_loop(drawn_loop(seed))


@given(st.floats(1e-6, 0.3), st.floats(0.05, 0.9), st.floats(-2, 3))
@settings(max_examples=30)
def test_the_margins_of_a_mode_in_closed_form(zeta: float, size: float, decades: float) -> None:
    """L = -2 size zeta w s / (s^2 + 2 zeta w s + w^2): S peaks at 1 / (1 - size), at w, where L is -size."""
    w = 10**decades
    A, B = np.array([[0.0, w], [-w, -2 * zeta * w]]), np.array([[0.0], [1.0]])
    C = np.array([[0.0, -2 * size * zeta * w]])
    S = System(A - B @ C, B, -C, np.eye(1)).balanced
    value, at = peak_gain(S)
    assert value == pytest.approx(1 / (1 - size), rel=1e-6)
    assert at == pytest.approx(w, rel=1e-3 * zeta + 1e-7)
    (crossing,) = phase_crossings(S)
    assert crossing.value == pytest.approx(-size, rel=1e-6)
    assert not gain_crossings(S)


def test_gain_crossings_of_a_mode() -> None:
    """L = k / (s^2 + 2 zeta s + 1): |L| = 1 where (1 - w^2)^2 + 4 zeta^2 w^2 = k^2."""
    k, zeta = 0.02, 1e-4
    A, B, C = np.array([[0.0, 1.0], [-1.0, -2 * zeta]]), np.array([[0.0], [1.0]]), np.array([[k, 0.0]])
    found = gain_crossings(System(A - B @ C, B, -C, np.eye(1)))
    middle, root = 1 - 2 * zeta**2, math.sqrt(k**2 - 4 * zeta**2 + 4 * zeta**4)
    assert [c.frequency for c in found] == pytest.approx(
        [math.sqrt(middle - root), math.sqrt(middle + root)], rel=1e-12
    )
    assert [abs(c.value) for c in found] == pytest.approx([1, 1], abs=1e-9)


def test_the_plane_has_the_response_of_the_samples() -> None:
    T, rng = 1e-3, np.random.default_rng(3)
    A, B, C, D = (
        rng.normal(size=(4, 4)),
        rng.normal(size=(4, 2)),
        rng.normal(size=(3, 4)),
        rng.normal(size=(3, 2)),
    )
    sampled = control.ss(np.eye(4) + T * A, T * B, C, D, T)
    w = np.array([0.01, 1.0, 300.0, 3000.0])
    v = 2 / T * np.tan(w * T / 2)
    found = in_plane(System(A, B, C, D), T).response(1j * v)
    np.testing.assert_allclose(found, sampled(np.exp(1j * w * T)).transpose(2, 0, 1), rtol=1e-11)
    np.testing.assert_allclose(of_plane(v, T), w, rtol=1e-12)


@pytest.mark.parametrize(("k", "first", "last"), [(2.0, math.sqrt(3), math.sqrt(3)), (0.5, 0.0, 0.0)])
def test_where_a_lag_falls_below_one(k: float, first: float, last: float) -> None:
    """k / (s + 1) is 1 at sqrt(k^2 - 1), and never for k < 1."""
    lag = System(-np.eye(1), np.eye(1), k * np.eye(1), np.zeros((1, 1)))
    found = fall_frequencies(lag, 1.0, (Fall(0, last=False), Fall(0, last=True)))
    assert found == pytest.approx([first, last], rel=1e-12)


def test_a_gain_that_never_falls_has_no_frequency_of_falling() -> None:
    through = System(-np.eye(1), np.eye(1), np.eye(1), 3 * np.eye(1))
    assert fall_frequencies(through, 1.0, (Fall(0, last=True),)) == [math.inf]
