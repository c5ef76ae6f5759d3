"""Lightly damped modes of uncertain frequency: proven by Hurwitz's determinant over the box of parameters alone."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

import malta
from malta.proof.box import box_of
from malta.proof.exclusion.hurwitz import Signs, determinant, raise_bound, signs_over
from malta.proof.robust import law_of, problem_of

DAMPING = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)


def one_mode(zeta: float) -> malta.proof.UncertainSystem:
    """w = 100 rad/s, force in, velocity out."""

    def f(w: Any) -> Any:
        return [[0, 1], [-w * w, -2 * zeta * w]], [[0], [1]], [[0, 1]]

    return malta.uncertain(f, {"w": 100.0})


def two_modes(zeta: float, a: float = 100.0, b: float = 1000.0) -> malta.proof.UncertainSystem:
    """Two modes under one force, and the velocity beside it."""

    def f(a: Any, b: Any) -> Any:
        A = [[0, 1, 0, 0], [-a * a, -2 * zeta * a, 0, 0], [0, 0, 0, 1], [0, 0, -b * b, -2 * zeta * b]]
        return A, [[0], [1], [0], [1]], [[0, 1, 0, 1]]

    return malta.uncertain(f, {"a": a, "b": b})


def feedback(gain: float, T: float | None) -> malta.proof.Compensator:
    none = np.zeros((0, 0))
    return malta.proof.Compensator(none, np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-gain]]), 0, T)


@pytest.mark.slow_for("0.001-0.001", "0.0001-0.001", "1e-05-0.001", "1e-06-0.001", "1e-07-0.001")
@pytest.mark.parametrize("T", [None, 1e-3])
@pytest.mark.parametrize("zeta", DAMPING)
def test_one_mode_is_stable_until_its_frequency_is_zero(zeta: float, T: float | None) -> None:
    found = malta.robust_margin(one_mode(zeta), feedback(20 * zeta, T), {"w": 0.1})
    assert found.lower is not None
    assert 9.9 < found.lower <= 10.000001
    assert found.upper == pytest.approx(10, rel=1e-6)
    assert found.witness is not None
    assert abs(found.witness["w"]) < 1e-4


@pytest.mark.parametrize("zeta", [1e-3, 1e-5, 1e-7])
def test_two_modes_are_stable_until_a_frequency_is_zero(zeta: float) -> None:
    found = malta.robust_margin(two_modes(zeta), feedback(20 * zeta, None), {"a": 0.1, "b": 0.005})
    assert found.lower is not None
    assert 9.9 < found.lower <= found.upper == pytest.approx(10, rel=1e-6)


@pytest.mark.parametrize("zeta", [1e-3, 1e-7])
def test_damping_that_a_stiffness_takes_away(zeta: float) -> None:
    """A force from the position, late by a first-order filter, drives the mode."""
    w, late = 100.0, 0.02

    def f(k: Any) -> Any:
        A = [[0, 1, 0], [-w * w, -2 * zeta * w, -k], [1 / late, 0, -1 / late]]
        return A, [[0], [0], [0]], [[1, 0, 0]]

    system = malta.uncertain(f, {"k": 0.0})
    limit = min(_first_loss(system, sign) for sign in (-1, 1))
    found = malta.robust_margin(system, [[0.0]], {"k": (-limit / 4, limit / 4)})
    assert found.lower == pytest.approx(4, rel=0.01)
    assert found.upper == pytest.approx(4, rel=0.01)


def _first_loss(system: malta.proof.UncertainSystem, sign: int) -> float:
    """The least |k| of that sign at which the poles are unstable, bisected."""
    low, high = 0.0, 1e-9
    while high < 1e9 and np.linalg.eigvals(system.at(np.array([[sign * high]]))[0][0]).real.max() < 0:
        low, high = high, 1.5 * high
    for _ in range(60):
        middle = (low + high) / 2
        stable = np.linalg.eigvals(system.at(np.array([[sign * middle]]))[0][0]).real.max() < 0
        low, high = (middle, high) if stable else (low, middle)
    return high


def test_the_determinant_is_the_product_of_all_sums_of_two_roots() -> None:
    rng = np.random.default_rng(1)
    for n in range(2, 7):
        roots = rng.integers(-9, 9, n)
        a = [1]
        for r in roots.tolist():  # a (s - r), lowest power first
            a = [-r * x + y for x, y in zip([*a, 0], [0, *a], strict=True)]
        sums = math.prod(int(x + y) for x, y in itertools.combinations(roots.tolist(), 2))
        assert float(determinant([arb(x) for x in a])) == (-1) ** (n * (n - 1) // 2) * sums


def signs_of(system: Any, law: Any, ranges: Any, reach: float) -> Signs:
    law = law_of(system, law)
    box = box_of(system.names, system.nominal, system.limits, ranges, {})
    found = signs_over(problem_of(system, law), box, min(reach, box.limit))
    raise_bound(found, 1e-3, 3000)
    return found


@pytest.mark.slow_for("0-0.3", "1-0.3", "2-0.3")
@pytest.mark.parametrize("T", [None, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_no_sample_of_a_proven_box_is_unstable(seed: int, T: float | None) -> None:
    """Random loops in two parameters, in x' or sampled: poles on a grid within the proven bound, and at the witness."""
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(1, 3))
    X, Y = rng.normal(size=(2, 3, 3))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(3)

    def f(p: Any, q: Any) -> Any:
        return [[A[i, j] + p * X[i, j] + q * q * Y[i, j] for j in range(3)] for i in range(3)], B, C

    system, law = malta.uncertain(f, {"p": 0.0, "q": 0.1}), feedback(0.05, T)
    problem = problem_of(system, law_of(system, law))
    found = signs_of(system, law, {"p": (-0.1, 0.2), "q": (0.0, 0.3)}, 40.0 if T is None else 0.5)
    grid = np.linspace(-1, 1, 41) * found.lower * 0.999999
    rows = [
        (0.2 * x if x > 0 else 0.1 * x, 0.1 + (0.2 * y if y > 0 else 0.1 * y)) for x in grid for y in grid
    ]
    assert (problem.instability(np.array(rows)) < 0).all()
    assert found.lower >= min(found.upper * (1 - 2e-3), 0.4999)
    if found.witness is not None:
        assert problem.instability(found.witness[None])[0] > -1e-6


def _in_units(unit: float, scale: float) -> Any:
    def f(w: Any) -> Any:
        return [[0, unit * scale], [-w * w * unit / scale, -2e-6 * w * unit]], [[0], [unit]], [[0, 1]]

    return f


def test_units_change_nothing() -> None:
    """Time in other units, and states scaled by 1e9: the same bound."""
    bounds = []
    for unit, scale in ((1.0, 1.0), (1e6, 1e9), (1e-6, 1e-9)):
        f = _in_units(unit, scale)
        found = signs_of(malta.uncertain(f, {"w": 7.0}), [[-1e-5]], {"w": 0.1}, 50.0)
        bounds.append(found.lower)
    assert bounds == pytest.approx([bounds[0]] * 3, rel=1e-9)
    assert bounds[0] == pytest.approx(10, rel=2e-3)


def test_a_touch_of_the_boundary_is_a_witness() -> None:
    found = signs_of(one_mode(1e-6), [[-1e-5]], {"w": 0.1}, 30.0)
    assert found.upper == pytest.approx(10, rel=1e-12)
    assert fmpq(0) <= fmpq(*found.lower.as_integer_ratio()) <= 10
