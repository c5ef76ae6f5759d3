"""What must hold for every design: separation, S + T = I, one gain by two routes, the law and its linear form."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import control
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

import malta
from malta.linear.matrices import eigenvalues
from malta.linear.sampling import sample, sample_noise
from malta.loops.sampled_loops import sampled_loop
from malta.synthesis.law import law
from malta.synthesis.linear_law import linear_law
from malta.synthesis.separation import controller_poles

if TYPE_CHECKING:
    from conftest import Design

    from malta.synthesis.spec import Discretization

WAYS: list[tuple[Discretization, int]] = [
    ("backward-euler", 0),
    ("zoh", 0),
    ("zoh", 1),
    ("sampled-data", 0),
    ("sampled-data", 1),
    ("sampled-data", 2),
]


def _matched(found: Any, expected: Any) -> float:
    """Largest distance of two sets of eigenvalues, each paired with its nearest."""
    return float(max(np.abs(np.asarray(expected) - value).min() for value in found))


@pytest.mark.parametrize(("way", "delay"), WAYS[1:])
def test_separation_principle(designs: dict[str, Design], way: Discretization, delay: int) -> None:
    """Closed-loop eigenvalues are the regulator's and the filter's, each where it was placed."""
    design = designs["calibrated"]
    controller = malta.lqg(design.model, design.spec.weights, 50e-6, way, delay)
    regulator, observer = controller_poles(controller)
    closed = eigenvalues(sampled_loop(design.model, controller, delay=delay).closed)
    expected = np.concatenate([regulator, observer])
    # The filter's copy of the stored forces and the machine's own make multiple eigenvalues at zero: compare the rest.
    moving, wanted = closed[np.abs(closed) > 0.3], expected[np.abs(expected) > 0.3]
    assert len(moving) == len(wanted) == 10 + 5 + 10
    assert _matched(moving, wanted) < 1e-7
    assert _matched(wanted, moving) < 1e-7


def test_backward_euler_separates_on_its_own_model(designs: dict[str, Design]) -> None:
    """The implicit observer is one of the model (I - Ts A)^-1, and the filter form hides nothing."""
    design = designs["table2"]
    c = design.controller
    A, C, Ts = design.model.A, design.model.C, c.sample_time
    L = malta.synthesis.kalman(design.model, design.spec.weights)
    implicit = np.linalg.inv(
        np.eye(10) - Ts * (A - L @ C)
    )  # xi_hat = implicit (xi_hat_old + Ts B v + Ts L y)
    assert (np.eye(10) - c.L @ C) @ c.Ad == pytest.approx(implicit, abs=1e-12)
    assert pytest.approx(implicit @ (Ts * L), rel=1e-9, abs=1e-15) == c.L
    _, observer = controller_poles(c)
    assert _matched(1 / observer, 1 - Ts * eigenvalues(A - L @ C)) < 1e-10


def test_sensitivity_and_complementary_sensitivity_add_up_to_one(design: Design) -> None:
    stage = sampled_loop(design.model, design.controller, delay=1, current_loops="lag")
    w = np.geomspace(1, 6e4, 50)
    S, L = stage.sensitivity(w), stage.loop_gain(w)
    T = L @ np.linalg.inv(np.eye(5) + L)
    assert np.abs(S + T - np.eye(5)).max() < 1e-12


def test_sensitivity_is_what_noise_becomes_in_the_measurement(design: Design) -> None:
    """S computed from transfer functions equals the frequency response of the closed state space."""
    stage = sampled_loop(design.model, design.controller, delay=1, current_loops="lag")
    c = stage.control
    A = stage.closed
    B = np.vstack([stage.Bd @ c.D_y, c.B_y])
    C = np.hstack([stage.Cd, np.zeros((5, len(c.A)))])
    for w in (3.0, 100.0, 379.0, 5000.0):
        z = np.exp(1j * w * stage.sample_time)
        direct = C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + np.eye(5)
        assert stage.sensitivity(np.array([w]))[0] == pytest.approx(direct, abs=1e-9)


@pytest.mark.parametrize("way", ["zoh", "sampled-data"])
def test_filterpy_iterated_gives_the_same_gain(designs: dict[str, Design], way: Discretization) -> None:
    design = designs["calibrated"]
    w, model, Ts = design.spec.weights, design.model, 50e-6
    controller = malta.lqg(model, w, Ts, way)
    Ad, Bd = sample(model.A, model.B, Ts)
    iterated = KalmanFilter(dim_x=10, dim_z=5, dim_u=5)
    iterated.F, iterated.B, iterated.H = Ad, Bd, model.C
    iterated.R = np.diag(w.sensor_variance)
    iterated.Q = (
        Bd * w.process_variance @ Bd.T
        if way == "zoh"
        else sample_noise(model.A, model.B * (w.process_variance * Ts) @ model.B.T, Ts)
    )
    iterated.P = np.diag([1e-8] * 5 + [1e-4] * 5)
    for _ in range(30_000):
        before = iterated.K.copy()
        iterated.predict(u=np.zeros((5, 1)))
        iterated.update(np.zeros((5, 1)))
        if np.abs(iterated.K - before).max() <= 1e-14 * np.abs(iterated.K).max():
            break
    assert pytest.approx(iterated.K, abs=1e-9 * np.abs(iterated.K).max()) == controller.L


def test_filter_gain_is_the_predictor_gain_without_the_step(designs: dict[str, Design]) -> None:
    """Ad L is what control.dlqe returns (at Table II's variances: unscaled, it loses digits below them)."""
    design = designs["table2"]
    w, model, Ts = design.spec.weights, design.model, 50e-6
    c = malta.lqg(model, w, Ts, "zoh")
    W = c.Bd * w.process_variance @ c.Bd.T
    predictor, _, _ = control.dlqe(
        c.Ad, np.eye(10), model.C, (W + W.T) / 2, np.diag(w.sensor_variance), method="scipy"
    )
    assert c.Ad @ c.L == pytest.approx(predictor, abs=1e-7 * np.abs(predictor).max())


def test_the_linear_law_is_the_law(designs: dict[str, Design]) -> None:
    for delay in (0, 2):
        design = designs["calibrated"]
        c = malta.lqg(design.model, design.spec.weights, 50e-6, "sampled-data", delay)
        n = len(c.states)
        linear, step = linear_law(c), law(c)
        rng = np.random.default_rng(1)
        s, y, r = rng.normal(size=n + 5) * 1e-6, rng.normal(size=5) * 1e-6, rng.normal(size=5 + n + 10) * 1e-6
        p_ref, xi_ref, v_ff, v0 = np.split(r, [5, 5 + n, 10 + n])
        xi_pred, e, frozen, v, _ = (
            np.array(out).ravel() for out in step(s[:n], s[n:], np.zeros(5), y, p_ref, xi_ref, v_ff, v0)
        )
        assert not frozen.any()
        assert v == pytest.approx(linear.C @ s + linear.D_y @ y + linear.D_r @ r, rel=1e-9)
        expected = linear.A @ s + linear.B_y @ y + linear.B_r @ r
        assert np.concatenate([xi_pred, e]) == pytest.approx(expected, rel=1e-9, abs=1e-18)


def test_the_law_step_by_step(designs: dict[str, Design]) -> None:
    """The six lines of the control law, written out in numpy, with one axis in saturation."""
    c = designs["calibrated"].controller
    rng = np.random.default_rng(2)
    xi_pred, e, y, p_ref, xi_ref, v_ff, v0 = (
        rng.normal(size=size) * scale
        for size, scale in ((10, 1e-4), (5, 1e-6), (5, 1e-4), (5, 1e-4), (10, 1e-4), (5, 1.0), (5, 1.0))
    )
    frozen = np.array([0, 1.0, 0, 0, 0])
    v_ff[4] = 500.0
    out = [np.array(value).ravel() for value in law(c)(xi_pred, e, frozen, y, p_ref, xi_ref, v_ff, v0)]
    e_next = e + c.sample_time * (p_ref - y) * (1 - frozen)
    assert e_next[1] == e[1]
    xi_hat = xi_pred + c.L @ (y - c.Cd @ xi_pred)
    wanted = c.K @ (xi_ref - xi_hat) + c.Ki @ e_next + v_ff + v0
    v = np.clip(wanted, -c.limits.force, c.limits.force)
    assert v[4] == c.limits.force[4] == pytest.approx(52)
    expected = [c.Ad @ xi_hat + c.Bd @ (v - v0), e_next, (v != wanted).astype(float), v, xi_hat]
    for found, value in zip(out, expected, strict=True):
        assert found == pytest.approx(value, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(("way", "delay"), WAYS)
def test_integrals_remove_the_error_of_a_wrong_machine(
    designs: dict[str, Design], way: Discretization, delay: int
) -> None:
    """Constant forces on a machine with other parameters leave no error at the sensors: S(1) = 0."""
    design = designs["calibrated"]
    controller = malta.lqg(design.model, design.spec.weights, 50e-6, way, delay)
    other = malta.plant_of(replace(design.spec.parameters, m=0.4, K_A=9000.0, l_B=0.046))
    model = malta.linearize(other, other.at(z=3e-3))
    wrong = sampled_loop(model, controller, delay=max(delay, 1), current_loops="lag")
    assert np.abs(eigenvalues(wrong.closed)).max() < 1
    assert np.abs(wrong.sensitivity(np.array([1e-6]))).max() < 1e-5


def test_delay_in_the_design_keeps_the_poles(designs: dict[str, Design]) -> None:
    """A modelled delay costs the regulator nothing but itself: the same poles, and zeros for the stored forces."""
    design = designs["calibrated"]
    plain, _ = controller_poles(malta.lqg(design.model, design.spec.weights, 50e-6, "sampled-data", 0))
    late, _ = controller_poles(malta.lqg(design.model, design.spec.weights, 50e-6, "sampled-data", 2))
    assert (np.abs(late) < 1e-3).sum() == 10
    assert _matched(plain, late[np.abs(late) > 0.5]) < 2e-5
