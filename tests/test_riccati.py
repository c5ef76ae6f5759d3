"""Riccati equations: closed forms, textbook cases, micrometre-level variances, two solvers, bad input."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg
from scipy.integrate import quad_vec

import malta
from malta.riccati import RESIDUAL, care, dare, delay_inputs, eigenvalues, sample, sample_cost, sample_noise

if TYPE_CHECKING:
    from conftest import Design

    from malta.linearize import LinearModel


@given(
    sign=st.sampled_from([-1, 0, 1]),
    w=st.floats(1, 1e4),
    m=st.floats(1e-3, 1e3),
    r=st.floats(1e-6, 1e6),
    weight=st.floats(-8, 8),
    damping=st.floats(0, 10),
)
def test_one_mode_has_a_closed_form(
    sign: int, w: float, m: float, r: float, weight: float, damping: float
) -> None:
    """m x'' = k x + u: K1 = k + sqrt(k^2 + q1/r), K2 = sqrt(q2/r + 2 m K1), k = +-m w^2 or 0."""
    k = sign * m * w**2
    q1 = r * (m * w**2) ** 2 * 10 ** (weight if sign > 0 else abs(weight))
    q2 = damping * q1 / w**2
    A, B = np.array([[0, 1], [k / m, 0]]), np.array([[0], [1 / m]])
    solution = care(A, B, np.diag([q1, q2]), np.array([[r]]))
    K1 = k + math.hypot(k, math.sqrt(q1 / r))
    assert solution.K[0] == pytest.approx([K1, math.sqrt(q2 / r + 2 * m * K1)], rel=1e-6)


@pytest.mark.parametrize("variance", [7e-10, 1e-13, 1e-15, 1e-18, 1e-24])
def test_kalman_filter_at_any_sensor_variance_in_SI(model: LinearModel, variance: float) -> None:
    """Unscaled solvers fail from 1e-13 m2 on: slycot silently, scipy with an error."""
    W = model.B * np.array([2.55e-3] * 4 + [4.95e-3]) @ model.B.T
    V = variance * np.eye(5)
    continuous = care(model.A.T, model.C.T, W, V)
    assert continuous.residual <= RESIDUAL
    poles = eigenvalues(model.A - continuous.K.T @ model.C)
    assert poles.real.max() < 0
    # z'' = w with force noise s_f: all poles of the axial pair at sqrt(s_f / (m s_z)), 45 degrees
    expected = math.sqrt(math.sqrt(4.95e-3 / variance) * model.force_map[2, 4])
    axial = eigenvalues(
        model.A[np.ix_([2, 7], [2, 7])] - continuous.K.T[np.ix_([2, 7], [4])] @ np.array([[1, 0]])
    )
    assert axial == pytest.approx(expected * np.exp(1j * np.pi * np.array([0.75, -0.75])), rel=1e-9)
    Ts = 50e-6
    Ad, _ = sample(model.A, model.B, Ts)
    sampled = dare(Ad.T, model.C.T, sample_noise(model.A, W * Ts, Ts), V)
    assert sampled.residual <= RESIDUAL
    assert np.abs(eigenvalues(Ad - sampled.K.T @ model.C)).max() < 1


def test_the_solution_is_symmetric_positive_and_satisfies_the_equation(design: Design) -> None:
    A, B, w = design.model.A, design.model.B, design.spec.weights
    X, K, residual = care(A, B, w.Q, w.R)
    assert residual <= RESIDUAL
    assert np.array_equal(X, X.T)
    assert linalg.eigvalsh(X).min() > 0
    assert pytest.approx(np.linalg.solve(w.R, B.T @ X), rel=1e-9, abs=1e-9) == K


def test_scipy_and_slycot_agree_where_both_are_right(model: LinearModel, designs: dict[str, Design]) -> None:
    pytest.importorskip("slycot", reason="slycot is not installed")
    w = designs["table2"].spec.weights
    ours = care(model.A, model.B, w.Q, w.R)
    X, _, K = control.care(model.A, model.B, w.Q, w.R, method="slycot")
    assert pytest.approx(K, abs=1e-6 * np.abs(K).max()) == ours.K
    assert pytest.approx(X, abs=1e-6 * np.abs(X).max()) == ours.X
    Ad, Bd = sample(model.A, model.B, 50e-6)
    w = designs["calibrated"].spec.weights
    sampled = dare(Ad, Bd, w.Q * 50e-6, w.R * 50e-6)
    _, _, K = control.dare(Ad, Bd, w.Q * 50e-6, w.R * 50e-6, method="slycot")
    assert pytest.approx(K, abs=1e-6 * np.abs(K).max()) == sampled.K


def test_slycot_in_the_environment_changes_nothing(model: LinearModel) -> None:
    """control prefers slycot when it is installed; at 1e-13 m2 its filter is off by far more than rounding."""
    pytest.importorskip("slycot", reason="slycot is not installed")
    W = model.B * np.array([2.55e-3] * 4 + [4.95e-3]) @ model.B.T
    W, V = (W + W.T) / 2, 1e-13 * np.eye(5)
    ours = care(model.A.T, model.C.T, W, V).K.T
    L, _, _ = control.lqe(model.A, np.eye(10), model.C, W, V, method="slycot")
    assert eigenvalues(model.A - ours @ model.C).real.max() < -500
    assert np.abs(L - ours).max() / np.abs(ours).max() > 1e-3


@pytest.mark.parametrize(("q", "sigma"), [(60.0, 60.0), (1000.0, 1000.0)])
def test_doyle_1978_lqg_has_no_guaranteed_margin(q: float, sigma: float) -> None:
    """Doyle's example: K = f [1 1], L = d [1 1]', f = 2 + sqrt(4 + q), d = 2 + sqrt(4 + sigma), for A = [1 1; 0 1].

    With an actuator gain m the loop is stable only for 1 - 1/(d f) < m < 1 + 1/(d f) (1 - (d + f - 4) / ...): both
    bounds close in on 1 as q and sigma grow. The lower order coefficients of the characteristic polynomial are
    d + f - 4 + 2 (m - 1) d f and 1 + (1 - m) d f.
    """
    A, B, C = np.array([[1.0, 1], [0, 1]]), np.array([[0.0], [1]]), np.array([[1.0, 0]])
    K = care(A, B, q * np.ones((2, 2)), np.eye(1)).K
    L = care(A.T, C.T, sigma * np.ones((2, 2)), np.eye(1)).K.T
    f, d = 2 + math.sqrt(4 + q), 2 + math.sqrt(4 + sigma)
    assert pytest.approx(np.array([[f, f]]), rel=1e-9) == K
    assert pytest.approx(np.array([[d], [d]]), rel=1e-9) == L

    def stable(m: float) -> bool:
        loop = np.block([[A, -m * B @ K], [L @ C, A - B @ K - L @ C]])
        return bool(eigenvalues(loop).real.max() < 0)

    upper = 1 + 1 / (d * f)
    lower = 1 - (d + f - 4) / (2 * d * f)
    assert stable(1.0)
    assert stable(1 + 0.99 * (upper - 1))
    assert not stable(1 + 1.01 * (upper - 1))
    assert not stable(lower - 1e-6)
    assert upper - 1 < 0.011


@pytest.mark.parametrize("Ts", [50e-6, 1e-3])
def test_van_loan_equals_quadrature(model: LinearModel, designs: dict[str, Design], Ts: float) -> None:
    w = designs["calibrated"].spec.weights
    A, B = model.A, model.B

    def integrand(s: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        Ad, Bd = sample(A, B, s) if s else (np.eye(10), np.zeros((10, 5)))
        both = np.hstack([Ad, Bd])
        held = np.hstack([np.zeros((5, 10)), np.eye(5)])
        return np.asarray(both.T @ w.Q @ both + held.T @ w.R @ held)

    Q, N, R = sample_cost(A, B, w.Q, w.R, Ts)
    expected, _ = quad_vec(integrand, 0, Ts, epsrel=1e-12)
    found = np.block([[Q, N], [N.T, R]])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-9
    W = B @ B.T

    def spread(s: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        return np.asarray(linalg.expm(A * s) @ W @ linalg.expm(A * s).T)

    noise, _ = quad_vec(spread, 0, Ts, epsrel=1e-12)
    scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
    assert np.abs((sample_noise(A, W, Ts) - noise) / scale).max() < 1e-9


def test_sampled_gains_become_the_continuous_ones(model: LinearModel, designs: dict[str, Design]) -> None:
    """lqrd and kalmd converge to lqr and lqe, linearly in Ts."""
    w = designs["calibrated"].spec.weights
    continuous = care(model.A, model.B, w.Q, w.R).K
    errors = []
    for Ts in (40e-6, 20e-6, 10e-6):
        Q, N, R = sample_cost(model.A, model.B, w.Q, w.R, Ts)
        K = dare(*sample(model.A, model.B, Ts), Q, R, N).K
        errors.append(np.abs(K - continuous).max() / np.abs(continuous).max())
    assert errors[0] < 0.03
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.05)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.05)


def test_delayed_inputs_act_late() -> None:
    Ad, Bd = np.array([[0.5]]), np.array([[2.0, 3.0]])
    A, B = delay_inputs(Ad, Bd, 3)
    state = np.zeros(7)
    seen = []
    for k in range(6):
        u = np.array([1.0, 10.0]) if k == 0 else np.zeros(2)
        state = A @ state + B @ u
        seen.append(state[0])
    assert seen == [0, 0, 0, 32, 16, 8]


def test_systems_that_do_not_touch_are_solved_apart(design: Design) -> None:
    """Gains between the planes x-beta, y-alpha and the axis z are zero, not small."""
    K = malta.lqr(design.model, design.spec.weights)
    groups = [({0, 4, 5, 9}, {0, 2}), ({1, 3, 6, 8}, {1, 3}), ({2, 7}, {4})]
    for states, inputs in groups:
        outside = [i for i in range(10) if i not in states]
        assert not K[np.ix_(sorted(inputs), outside)].any()
        assert K[np.ix_(sorted(inputs), sorted(states))].all()


def test_bad_input_is_named() -> None:
    A, B, Q, R = np.eye(2), np.eye(2), np.eye(2), np.eye(2)
    nan = np.array([[1, np.nan], [0, 1]])
    cases = [
        ((A[:1], B, Q, R), "A"),
        ((nan, B, Q, R), "A"),
        ((A, B, Q[:, :1], R), "Q"),
        ((A, B, np.array([[1.0, 0.5], [0, 1]]), R), "Q"),
        ((A, B, -Q, R), "Q"),
        ((A, B, Q, R - R), "R"),
    ]
    for solve in (care, dare):
        for arguments, field in cases:
            with pytest.raises(malta.InputError, match=f": {field}: found"):
                solve(*arguments)


@pytest.mark.parametrize("solve", [care, dare])
def test_no_stabilizing_solution_is_a_failed_check(solve: type) -> None:
    """An unstable state that no input reaches."""
    A, B = np.diag([2.0, 0.5]), np.array([[0.0], [1.0]])
    with pytest.raises(malta.CheckError):
        solve(A, B, np.eye(2), np.eye(1))


@pytest.mark.parametrize("Ts", [10.0, 1e300])
def test_sampling_that_overflows_is_a_failed_check(model: LinearModel, Ts: float) -> None:
    A, B = model.A, model.B
    for sampled in (
        lambda: sample(A, B, Ts),
        lambda: sample_cost(A, B, np.eye(10), np.eye(5), Ts),
        lambda: sample_noise(A, np.eye(10), Ts),
    ):
        with pytest.raises(malta.CheckError, match="no sample time of this length for so fast a machine"):
            sampled()


@pytest.mark.parametrize("matrix", [np.array([[math.inf]]), np.array([[math.nan]])])
def test_eigenvalues_beyond_all_floats_are_a_failed_check(
    matrix: np.ndarray[tuple[int, int], np.dtype[np.float64]],
) -> None:
    with pytest.raises(malta.CheckError, match="overflow"):
        eigenvalues(matrix)
