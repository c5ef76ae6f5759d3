"""More coils than forces: currents of least loss, within limits, without a failed coil; the plate that has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy.optimize import minimize

import malta
from malta.model import allocation

CORNERS = np.array([[1.0, 1, 1, 1], [1, 1, -1, -1], [-1, 1, 1, -1]])
PLATE = Path("examples/plate/design")


def random_coils(seed: int) -> Any:
    """Three forces of very different sizes, five coils, unequal resistances."""
    rng = np.random.default_rng(seed)
    T = rng.normal(size=(3, 5)) * np.array([[1e3], [1.0], [1e-3]])
    return allocation(T, rng.uniform(0.5, 3, 5)), rng


@given(st.integers(0, 10_000))
def test_currents_make_the_forces_with_the_least_loss(seed: int) -> None:
    coils, rng = random_coils(seed)
    v = coils.matrix @ rng.normal(size=5)
    i = coils.currents(v)
    np.testing.assert_allclose(
        coils.matrix @ i, v, rtol=1e-8, atol=1e-9 * np.abs(coils.matrix).max(axis=1).max()
    )
    null = np.linalg.svd(coils.matrix / np.abs(coils.matrix).max(axis=1)[:, None])[2][3:]
    assert np.abs(null @ (coils.resistance * i)).max() < 1e-9 * np.abs(coils.resistance * i).max()  # optimal
    symbols = ca.SX.sym("v", 3)
    f = ca.Function("i", [symbols], [coils.currents(symbols)])
    np.testing.assert_allclose(np.array(f(v)).ravel(), i, rtol=1e-12, atol=1e-12 * np.abs(i).max())


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.floats(0.4, 0.999))
@example(282, 0.75)  # which an active-set program of CasADi left 0.04 A off
def test_limits_are_kept_and_reached(seed: int, share: float) -> None:
    """By scaling: just below the largest force there are currents, just beyond there are none."""
    coils, rng = random_coils(seed)
    d, limit = coils.matrix @ rng.normal(size=5), rng.uniform(0.5, 2, 5)
    most = coils.largest(d, limit)
    i = coils.limited(share * most * d, limit)
    assert (np.abs(i) <= limit).all()
    rows = np.abs(coils.matrix).max(axis=1)
    np.testing.assert_allclose(coils.matrix @ i / rows, share * most * d / rows, atol=1e-6 * np.abs(i).max())
    with pytest.raises(malta.CheckError, match=r"the coils make 9\d.* % of this force"):
        coils.limited(1.02 * most * d, limit)
    assert coils.largest(d, 2 * limit) == pytest.approx(2 * most, rel=1e-7)


def test_the_quadratic_program_is_the_one_of_another_solver() -> None:
    coils, limit = allocation(CORNERS, [1, 2, 3, 4]), 1.6
    v = np.array([4.0, 2, 1])
    solve: Any = minimize
    other = solve(
        lambda i: i @ (coils.resistance * i), coils.currents(v), bounds=[(-limit, limit)] * 4, method="SLSQP",
        constraints={"type": "eq", "fun": lambda i: CORNERS @ i - v}, options={"ftol": 1e-14},
    )  # fmt: skip
    np.testing.assert_allclose(coils.limited(v, limit), other.x, atol=1e-6)
    np.testing.assert_allclose(coils.limited(v, 10), coils.currents(v), atol=1e-8)


def test_a_failed_coil_halves_the_lift() -> None:
    """The coil across makes a torque that no other balances, so that two coils of four lift."""
    for k in range(4):
        coils = allocation(CORNERS, failed=[k])
        assert coils.currents([4, 0, 0])[[k, (k + 2) % 4]] == pytest.approx([0, 0], abs=1e-14)
        assert coils.largest([1, 0, 0], 3) == pytest.approx(6)
        assert coils.limited([3, 1, 0], 2)[k] == 0
    assert allocation(CORNERS).largest([1, 0, 0], 3) == pytest.approx(12)
    assert allocation(CORNERS).largest([1, 0, 0], np.inf) == np.inf
    assert allocation(CORNERS).largest([0, 0, 1], 0) == 0


@pytest.mark.parametrize(
    ("made", "kind", "sentence"),
    [
        (lambda: allocation([1, 2]), malta.InputError, "matrix: found shape"),
        (lambda: allocation([[1, np.nan]]), malta.InputError, "matrix: found shape"),
        (lambda: allocation(CORNERS, -1), malta.InputError, "resistance: found -1"),
        (
            lambda: allocation(CORNERS, [1, 2]),
            malta.InputError,
            r"resistance: found \[1, 2\], expected .* 4 of them",
        ),
        (
            lambda: allocation(CORNERS, failed=[4]),
            malta.InputError,
            "failed: found 4, expected coils from 0 to 3",
        ),
        (lambda: allocation(CORNERS, failed=[0, 1]), malta.CheckError, "coils that are left .* shares 1 1 0"),
        (lambda: allocation(CORNERS, failed=[0, 1, 2, 3]), malta.CheckError, "do not make force 1 at all"),
        (lambda: allocation([[1, 1], [1, 1]]), malta.CheckError, "shares 1 -1|shares -1 1"),
        (lambda: allocation(CORNERS).limited([1, 2], 1), malta.InputError, "v: found"),
        (lambda: allocation(CORNERS).limited([1, 2, 3], -1), malta.InputError, "limit: found -1"),
        (lambda: allocation(CORNERS).largest([0, 0, 0], 1), malta.InputError, "direction: found zeros"),
    ],
)
def test_coils_that_cannot_be_get_one_sentence(made: Any, kind: Any, sentence: str) -> None:
    with pytest.raises(kind, match=sentence):
        made()


@pytest.mark.slow
def test_the_plate_flies_on_three_coils() -> None:
    """A law that knows of the open coil has the loop of four coils; one that does not has less of a margin."""
    four, three = (malta.read_design(PLATE / f"{name}.toml") for name in ("plate", "three_coils"))
    laws = [malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())) for spec in (four, three)]
    models = [malta.linearize(spec.plant, spec.plant.at()) for spec in (four, three)]
    np.testing.assert_allclose(models[0].B, models[1].B, atol=1e-9 * np.abs(models[0].B).max())
    assert four.plant.actuator.force_limit[0] == pytest.approx(2 * three.plant.actuator.force_limit[0])
    margins = [
        malta.robust_margin(malta.loop(spec.plant, law), {"k_f": 0.1, "k_z": 0.2})
        for spec, law in ((four, laws[0]), (three, laws[0]), (three, laws[1]))
    ]
    assert margins[0].lower == pytest.approx(margins[2].lower, rel=1e-3)
    assert margins[1].lower is not None
    assert 1 < margins[1].lower < 0.9 * (margins[0].lower or 0)
    assert margins[0].searched.endswith("where k_z reaches its limit 0")
    run = malta.experiment("step", three.plant, laws[1], size=50e-6).cases[0].run
    assert run.verdict.completed
    assert np.abs(run.p[-1] - run.reference[-1]).max() < 1e-6


@pytest.mark.slow
def test_a_coil_that_is_never_used_does_not_break_the_linear_model() -> None:
    """A structural zero among the currents."""
    three = malta.read_design(PLATE / "three_coils.toml").plant
    v = ca.SX.sym("v", 3)
    assert ca.sparsify(ca.SX(three.actuator.currents(ca.SX.zeros(3), v))).nnz() < 4
    assert three.check().exact
