"""Parts of a margin: numbers as balls, restrictions of polynomials, what is kept of a plant for other laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flint import arb, ctx

import malta
from malta.linear.uncertain import Compensator
from malta.proof import groups, robust
from malta.proof.polynomial import family, minors


@pytest.mark.parametrize("decades", [0, 90, -90, 400])
def test_a_ball_is_within_its_doubles(decades: int) -> None:
    rng = np.random.default_rng(1)
    before, ctx.prec = ctx.prec, 160
    try:
        for middle, radius in zip(rng.normal(size=50), 10.0 ** rng.uniform(-50, 0, 50), strict=True):
            x = (arb(float(middle)) / 3 + arb(0, float(radius))) * arb(10) ** decades
            value, width, exponent = family.binary(x)
            assert (arb(value, width) * arb(2) ** exponent).contains(x)
    finally:
        ctx.prec = before


@pytest.mark.parametrize("degree", range(1, 9))
def test_a_restriction_is_the_polynomial_on_the_smaller_box(degree: int) -> None:
    rng = np.random.default_rng(degree)
    low = rng.uniform(0, 0.5, 20)
    high = low + rng.uniform(0, 0.5, 20)
    values = rng.normal(size=(20, degree + 1))
    cut = np.einsum("cij,cj->ci", family.restriction(degree, low, high), values)
    for u in (0.0, 0.3, 1.0):
        there = np.einsum("cj,cj->c", family.basis(degree, low + (high - low) * u), values)
        assert np.allclose(
            family.basis(degree, np.full(20, u)) * cut @ np.ones(degree + 1), there, atol=1e-13
        )


def test_restrictions_along_all_axes_are_those_along_each() -> None:
    rng = np.random.default_rng(0)
    shape = (3, 1, 2, 5)
    values = rng.normal(size=(7, 30)) + 1j * rng.normal(size=(7, 30))
    boxes = np.sort(rng.uniform(0, 1, (7, 4, 2)), axis=2)
    whole = family.restrict(values, shape, boxes)
    each = values
    for axis in (3, 0, 2):
        one = np.tile([0.0, 1.0], (7, 4, 1))
        one[:, axis] = boxes[:, axis]
        each = family.restrict(each, shape, one)
    assert np.abs(whole - each).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("sample_time", [None, 1e-2])
def test_another_law_of_the_same_plant_has_the_margin_that_it_has_alone(sample_time: float | None) -> None:
    """What is kept of a plant at places and on discs is no part of the compensator, its lag or its delay."""
    system = malta.uncertain(
        lambda m, d: ([[0, 1], [4 / m, d / m]], [[0], [1 / m]], [[1, 0]]), {"m": 1.0, "d": 0.1}
    )
    a, b = (np.exp(-50 * sample_time), -np.expm1(-50 * sample_time) / 50) if sample_time else (-50.0, 1.0)
    A, B, C, D = (np.array([[x]]) for x in (a, b, 2000.0, -50.0))
    law = Compensator(A, B, C, D, sample_time=sample_time)
    laws = [law, replace(law, C=1.02 * law.C), replace(law, lag=900.0), replace(law, lag=700.0)]
    if sample_time:
        laws.append(replace(law, delay=1))

    def margins(*, anew: bool) -> list[tuple[float | None, float]]:
        found = []
        for own in laws:
            if anew:
                for kept in (robust.problem_of, minors._kept_minors, groups._program, groups._symbolic):
                    kept.cache_clear()
            margin = malta.robust_margin(system, own, {"m": 0.2, "d": 1.0})
            found.append((margin.lower, margin.upper))
        return found

    kept, alone = margins(anew=False), margins(anew=True)
    assert kept == alone
    assert len(set(kept)) == len(laws)
