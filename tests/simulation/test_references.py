"""References: their derivatives are derivatives, they start and end where asked, and refuse the impossible."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, strategies as st

import malta
from malta.simulation.references import PROFILES, QUINTIC_DURATION, circle, hold, stroke

if TYPE_CHECKING:
    from malta.model.plant import Plant


@pytest.mark.parametrize("profile", list(PROFILES))
def test_derivatives_are_derivatives(plant: Plant, profile: str) -> None:
    reference = stroke(plant, -5e-3, 5e-3, 16.2e-3, 0.05, profile)  # type: ignore[arg-type]
    t = np.linspace(0.03, 0.07, 40_001)
    motion = reference(t)
    h = t[1] - t[0]
    speed = (motion.p[2:, 4] - motion.p[:-2, 4]) / (2 * h)
    acceleration = (motion.dp[2:, 4] - motion.dp[:-2, 4]) / (2 * h)
    assert np.abs(speed - motion.dp[1:-1, 4]).max() < 1e-6 * np.abs(motion.dp).max()
    assert np.abs(acceleration - motion.ddp[1:-1, 4]).max() < 1e-4 * np.abs(motion.ddp).max()
    assert not motion.p[:, :4].any()


@pytest.mark.parametrize("profile", list(PROFILES))
@given(rise=st.floats(1e-3, 1.0), distance=st.floats(1e-4, 0.03))
def test_rise_is_from_10_to_90_percent(profile: str, rise: float, distance: float) -> None:
    shape = PROFILES[profile]
    s, _, _ = shape(np.array([-rise / 2, 0.0, rise / 2]), rise)
    assert s * distance == pytest.approx(np.array([0.1, 0.5, 0.9]) * distance, rel=1e-9)


def test_the_quintic_rests_outside_its_duration() -> None:
    rise = 16.2e-3
    half = QUINTIC_DURATION * rise / 2
    s, ds, dds = PROFILES["quintic"](np.array([-1.0, -half, half, 1.0]), rise)
    assert s == pytest.approx([0, 0, 1, 1], abs=1e-12)
    assert np.abs(ds).max() < 1e-9
    assert np.abs(dds).max() < 1e-6


def test_the_logistic_does_not_overflow() -> None:
    s, ds, dds = PROFILES["logistic"](np.array([-1e6, 1e6]), 1e-6)
    assert s.tolist() == [0, 1]
    assert not ds.any()
    assert not dds.any()


def test_hold_keeps_what_is_named(plant: Plant) -> None:
    motion = hold(plant, y1=1e-5)(np.arange(3.0))
    assert motion.p.tolist() == [[0, 1e-5, 0, 0, 0]] * 3
    assert not motion.dp.any()
    with pytest.raises(malta.InputError, match="hold: q: found an unknown output"):
        hold(plant, q=1.0)


@given(radius=st.floats(1e-6, 5e-4), frequency=st.floats(0.1, 50))
def test_the_circle_is_equation_21(plant: Plant, radius: float, frequency: float) -> None:
    """p* = (S cos 2 pi f t, S sin 2 pi f t, 0, 0, 0), once around in 1 / f; it turns, so p*'' = -(2 pi f)^2 p*."""
    w = 2 * math.pi * frequency
    t = np.linspace(0, 1 / frequency, 401)
    p, dp, ddp = circle(plant, radius, frequency)(t)
    quarters = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 0]]) * radius
    assert np.abs(np.hypot(p[:, 0], p[:, 1]) - radius).max() < 1e-12 * radius
    assert np.abs(p[::100, :2] - quarters).max() < 1e-12 * radius
    assert np.abs(ddp + w**2 * p).max() < 1e-12 * w**2 * radius
    assert np.abs(dp[:, :2] - w * np.column_stack([-p[:, 1], p[:, 0]])).max() < 1e-12 * w * radius
    assert not any(part[:, 2:].any() for part in (p, dp, ddp))
    h = t[1] - t[0]
    chord = np.sin(w * h) / (w * h)  # a central difference of a circle falls short by this, exactly
    assert np.abs((p[2:] - p[:-2]) / (2 * h) - chord * dp[1:-1]).max() < 1e-9 * w * radius


def test_the_impossible_is_refused(plant: Plant) -> None:
    with pytest.raises(malta.InputError, match=r"end: found 0\.02 m, expected a position within the travel"):
        stroke(plant, 0.0, 0.02, 0.01, 0.05)
    with pytest.raises(malta.InputError, match="rise: found 0"):
        stroke(plant, 0.0, 0.01, 0.0, 0.05)
    with pytest.raises(malta.InputError, match="profile: found 'cubic'"):
        stroke(plant, 0.0, 0.01, 0.01, 0.05, "cubic")  # type: ignore[arg-type]
