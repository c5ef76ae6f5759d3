"""Bounds of the rate at which a parameter may vary."""

from __future__ import annotations

import control
import numpy as np
import pytest
from scipy import linalg

import malta
from malta.proof.rates import RateBound

LOW, HIGH, T = 1.0, 3.0, 0.01


def spring(damping: float = 1.0) -> malta.proof.UncertainSystem:
    return malta.uncertain(lambda k: ([[0, 1], [-k, -damping]], [[0], [1]], [[1, 0]]), {"k": 2.0})


def law(gain: float = -1.0) -> control.StateSpace:
    return control.ss([], [], [], [[gain]], T)


def growth(rate: float, damping: float, frequency: float) -> float:
    """The spectral radius of a period of k = 2 + a sin(frequency t) under u = -y, a as the rate allows."""
    a, Phi = min(1.0, rate / frequency), np.eye(2)
    for t in np.arange(0.0, 2 * np.pi / frequency, T):
        k = 2 + a * np.sin(frequency * (t + T / 2))
        A = np.array([[0, 1, 0], [-k, -damping, 1], [0, 0, 0]])
        whole = linalg.expm(A * T)
        Phi = (whole[:2, :2] + np.outer(whole[:2, 2], [-1.0, 0.0])) @ Phi
    return float(np.abs(np.linalg.eigvals(Phi)).max())


def test_courses_below_the_bound_fall_and_parametric_resonance_is_above_it() -> None:
    found = malta.proof.prove_rate(spring(0.2), law(), "k", (LOW, HIGH))
    assert found.rate is not None
    assert found.decay is not None
    assert 0.05 < found.rate < 2 * np.sqrt(3)  # of k = 2 + sin(2 sqrt(3) t), Mathieu's first tongue
    assert growth(2 * np.sqrt(3), 0.2, 2 * np.sqrt(3)) > 1
    assert max(growth(found.rate, 0.2, w) for w in (1.0, 2.0, 3.464)) < 1
    slowest = 0.1 - 2 * T  # damping / 2, less what the hold takes
    assert 0.3 * slowest < found.decay < 0.1


def test_more_damping_allows_more() -> None:
    rates = [malta.proof.prove_rate(spring(d), law(), "k", (LOW, HIGH)).rate or 0.0 for d in (0.2, 1.0)]
    assert rates[1] > 5 * rates[0]


def test_a_delay_and_a_law_with_states_are_part_of_the_loop() -> None:
    lead = control.c2d(control.tf([-1.0, -2.0], [0.05, 1]), T, "tustin")
    c = control.ss(lead)
    late = malta.proof.Compensator(c.A, c.B, c.C, c.D, sample_time=T, delay=3)
    at_once = malta.proof.Compensator(c.A, c.B, c.C, c.D, sample_time=T)
    found = [malta.proof.prove_rate(spring(0.2), F, "k", (LOW, HIGH)) for F in (at_once, late)]
    assert all(f.rate is not None for f in found)
    assert (found[0].decay or 0) > (found[1].decay or 0)


def test_an_unstable_frozen_value_is_no_proof() -> None:
    found = malta.proof.prove_rate(spring(), law(1.5), "k", (LOW, HIGH))  # k - 1.5 < 0 at k = 1
    assert found.rate is None
    assert str(found) == "k in 1 .. 3: nothing proven (the loop is unstable at a frozen value)"
    assert isinstance(found, RateBound)


def test_what_is_not_covered_is_refused() -> None:
    for system, compensator, name, words in (
        (spring(), law(), "m", "name: found 'm', expected one of k"),
        (spring(), [[-1.0]], "k", "compensator: found another loop"),
        (malta.uncertain(lambda k: ([[-k * k]], [[1]], [[1]]), {"k": 2.0}), law(), "k", "not affine in k"),
        (malta.uncertain(lambda k: ([[-k]], [[k]], [[1]]), {"k": 2.0}), law(), "k", "depend on k"),
    ):
        with pytest.raises(malta.InputError, match=words):
            malta.proof.prove_rate(system, compensator, name, (LOW, HIGH))
