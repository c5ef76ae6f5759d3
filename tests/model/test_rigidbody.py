"""Rotations, rates and Euler's equations against what they conserve and against each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

from malta.model.rigid_body import (
    EXACT_TRIG,
    SMALL_ANGLE_TRIG,
    Trig,
    acceleration,
    cardan_rates,
    principal_angles,
    rate_map,
    rotation,
)

if TYPE_CHECKING:
    from malta.arrays import FloatArray

ANGLES = st.lists(st.floats(-10, 10), min_size=3, max_size=3)
TILTS = st.tuples(st.floats(-10, 10), st.floats(-1.4, 1.4), st.floats(-10, 10))  # beta short of +-90 degrees
RATES = st.lists(st.floats(-100, 100), min_size=3, max_size=3)

INERTIA = (1.3805e-3, 1.3805e-3, 4.7707e-5)  # kg m2, the mover of the tubular actuator
LOPSIDED = (1.3805e-3, 2.5e-3, 4.7707e-5)


def _array(value: Any) -> FloatArray:
    return np.array(ca.DM(value)).squeeze()


def _skew(a: FloatArray) -> FloatArray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def _angular(inertia: tuple[float, float, float]) -> Callable[..., FloatArray]:
    """(q_r, q_r', T in frame R) -> q_r''."""
    q, dq, T_R = (ca.SX.sym(name, 3) for name in ("q", "dq", "T_R"))
    T_B = rotation(principal_angles(q, inertia)) @ rotation(q).T @ T_R
    _, ddq = acceleration(1.0, inertia, q, dq, ca.SX.zeros(3), T_B)
    function = ca.Function("angular", [q, dq, T_R], [ddq])
    return lambda *values: _array(function(*values))


def _coast(inertia: tuple[float, float, float], start: FloatArray, times: FloatArray) -> list[Any]:
    """(R_RI, omega_R) along a torque-free motion from start = (q_r, q_r')."""
    angular = _angular(inertia)
    path = solve_ivp(
        lambda _, s: np.concatenate([s[3:], angular(s[:3], s[3:], np.zeros(3))]),
        (0, times[-1]),
        start,
        "DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-12,
    )
    return [(_array(rotation(s[:3])), _array(rate_map(ca.DM(s[:3])) @ s[3:])) for s in path.y.T]


@given(q_r=ANGLES)
def test_rotation_keeps_lengths_and_handedness(q_r: list[float]) -> None:
    """R R^T = 1 and det R = 1 at any angles."""
    R = _array(rotation(q_r))
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=4e-15)
    assert np.linalg.det(R) == pytest.approx(1, abs=4e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotation_is_right_handed_about_each_axis(axis: int) -> None:
    """A mover turned by a positive angle about an axis carries the next axis towards the one after it."""
    q_r = np.zeros(3)
    q_r[axis] = 0.3
    carried = _array(rotation(q_r)).T[:, (axis + 1) % 3]  # in frame I
    expected = np.zeros(3)
    expected[(axis + 1) % 3], expected[(axis + 2) % 3] = math.cos(0.3), math.sin(0.3)
    np.testing.assert_allclose(carried, expected, rtol=0, atol=1e-15)


def test_cardan_angles_turn_in_their_order() -> None:
    """x, then the turned y', then the turned z'': the mover's axis is (sin b, -sin a cos b, cos a cos b) in frame I."""
    a, b, g = 0.3, -0.5, 0.7
    R = _array(rotation([a, b, g]))
    axis = [math.sin(b), -math.sin(a) * math.cos(b), math.cos(a) * math.cos(b)]
    np.testing.assert_allclose(R[2], axis, rtol=0, atol=1e-15)
    np.testing.assert_allclose(R @ axis, [0, 0, 1], rtol=0, atol=1e-15)
    x_first = _array(rotation([0, 0, g])) @ _array(rotation([0, b, 0])) @ _array(rotation([a, 0, 0]))
    np.testing.assert_allclose(R, x_first, rtol=0, atol=1e-15)


@settings(deadline=None)
@given(q_r=ANGLES, dq_r=RATES)
def test_rate_map_is_the_rate_of_the_rotation(q_r: list[float], dq_r: list[float]) -> None:
    """R' = -[omega_R] R for a rotation from I to R; R' by CasADi's chain rule.

    NOTE: eq. (4) takes the Cardan rates for components of omega in frame I.
    """
    q, dq = ca.SX.sym("q", 3), ca.SX.sym("dq", 3)
    rate = ca.Function("rate", [q, dq], [ca.reshape(ca.jtimes(ca.vec(rotation(q)), q, dq), 3, 3)])
    omega = _array(rate_map(ca.DM(q_r)) @ ca.DM(dq_r))
    size = max(1.0, *map(abs, dq_r))
    np.testing.assert_allclose(
        _array(rate(q_r, dq_r)), -_skew(omega) @ _array(rotation(q_r)), rtol=0, atol=2e-14 * size
    )


@pytest.mark.parametrize("trig", [EXACT_TRIG, SMALL_ANGLE_TRIG], ids=["exact", "small angle"])
@settings(deadline=None)
@given(q_r=TILTS, dq_r=RATES)
def test_cardan_rates_invert_the_rate_map(
    trig: Trig, q_r: tuple[float, float, float], dq_r: list[float]
) -> None:
    """There and back, with exact trigonometry and with the paper's."""
    q, dq = ca.SX.sym("q", 3), ca.SX.sym("dq", 3)
    back = ca.Function("back", [q, dq], [cardan_rates(q, rate_map(q, trig) @ dq, trig)])
    size = max(1.0, *map(abs, dq_r))
    np.testing.assert_allclose(_array(back(q_r, dq_r)), dq_r, rtol=0, atol=1e-12 * size)


def test_rate_map_is_singular_at_a_right_angle() -> None:
    """At beta = 90 degrees alpha and gamma turn about one axis: the determinant is cos(beta)."""
    for beta in (0.0, 0.5, 1.4, math.pi / 2):
        determinant = np.linalg.det(_array(rate_map(ca.DM([0.3, beta, 0.7]))))
        assert determinant == pytest.approx(math.cos(beta), abs=4e-15)


@pytest.mark.parametrize("inertia", [INERTIA, LOPSIDED])
def test_angular_momentum_and_energy_of_a_free_body_are_kept(inertia: tuple[float, float, float]) -> None:
    """No torque: R^T I omega stands still in frame I, and omega . I omega / 2 is constant."""
    start = np.array([0.2, -0.3, 0.4, 6.0, -9.0, 120.0])
    path = _coast(inertia, start, np.linspace(0, 0.1, 21))
    L = np.array([R.T @ (np.array(inertia) * omega) for R, omega in path])
    E = np.array([omega @ (np.array(inertia) * omega) / 2 for _, omega in path])
    np.testing.assert_allclose(L, np.broadcast_to(L[0], L.shape), rtol=0, atol=1e-10 * abs(L[0]).max())
    np.testing.assert_allclose(E, E[0], rtol=1e-10)
    assert max(np.linalg.norm(R[2] - path[0][0][2]) for R, _ in path) > 0.5  # rad: the axis did move


def test_a_symmetric_top_precesses_as_euler_says() -> None:
    """A free symmetric body's axis goes round its angular momentum once in 2 pi I_xx / L; its spin is constant."""
    start = np.array([0.2, -0.3, 0.4, 6.0, -9.0, 300.0])
    R, omega = _array(rotation(start[:3])), _array(rate_map(ca.DM(start[:3])) @ start[3:])
    L = R.T @ (np.array(INERTIA) * omega)
    period = 2 * math.pi * INERTIA[0] / np.linalg.norm(L)
    begin, half, full = _coast(INERTIA, start, np.array([0, period / 2, period]))
    np.testing.assert_allclose(full[0][2], begin[0][2], rtol=0, atol=1e-10)
    mirrored = 2 * (begin[0][2] @ L) * L / (L @ L) - begin[0][2]
    np.testing.assert_allclose(half[0][2], mirrored, rtol=0, atol=1e-10)
    assert np.linalg.norm(half[0][2] - begin[0][2]) > 0.5
    assert full[1][2] == pytest.approx(omega[2], rel=1e-11)


@pytest.mark.parametrize("inertia", [(2e-3, 1e-3, 3e-3), (3e-3, 1e-3, 2e-3), (1e-3, 2e-3, 3e-3)])
def test_spin_is_unstable_about_the_middle_axis_only(inertia: tuple[float, float, float]) -> None:
    """A hair of omega_y beside a spin about x grows as cosh(k t), k^2 = spin^2 (Ix - Iy) (Iz - Ix) / (Iy Iz)."""
    spin, hair, times = 8.0, 1e-4, np.linspace(0, 0.6, 7)
    path = _coast(inertia, np.array([0.1, 0, 0, spin, hair, 0]), times)
    I_x, I_y, I_z = inertia
    k = spin * np.emath.sqrt((I_x - I_y) * (I_z - I_x) / (I_y * I_z))
    expected = hair * np.cosh(k * times).real
    np.testing.assert_allclose(
        [omega[1] for _, omega in path], expected, rtol=0, atol=1e-6 * abs(expected).max()
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_nearly_equal_inertias_accelerate_as_equal_ones(axis: int) -> None:
    """Ixx = Iyy is written in a frame without gamma, anything else in the body's: the two meet."""
    near = list(INERTIA)
    near[axis] *= 1 + 1e-9
    equal, unequal = _angular(INERTIA), _angular((near[0], near[1], near[2]))
    rng = np.random.default_rng(0)
    for _ in range(50):
        q, dq, T = rng.uniform(-1.2, 1.2, 3), rng.uniform(-20, 20, 3), rng.uniform(-0.3, 0.3, 3)
        expected = equal(q, dq, T)
        np.testing.assert_allclose(unequal(q, dq, T), expected, rtol=0, atol=2e-8 * abs(expected).max())


def test_principal_drops_gamma_of_a_symmetric_body_only() -> None:
    """Every axis across a symmetric body is a principal one."""
    q = ca.DM([0.1, 0.2, 0.3])
    assert _array(principal_angles(q, INERTIA)).tolist() == [0.1, 0.2, 0.0]
    assert _array(principal_angles(q, LOPSIDED)).tolist() == [0.1, 0.2, 0.3]


@pytest.mark.parametrize("inertia", [INERTIA, LOPSIDED])
def test_acceleration_is_newtons_and_eulers(inertia: tuple[float, float, float]) -> None:
    """m q_t'' = F, and I omega' + omega x I omega = T with omega' from the rate map by finite differences."""
    q, dq, F, T_R = (ca.SX.sym(name, 3) for name in ("q", "dq", "F", "T_R"))
    T_B = rotation(principal_angles(q, inertia)) @ rotation(q).T @ T_R
    both = ca.Function("both", [q, dq, F, T_R], list(acceleration(0.36, inertia, q, dq, F, T_B)))
    rng = np.random.default_rng(1)
    for _ in range(20):
        angles, rates = rng.uniform(-1.2, 1.2, 3), rng.uniform(-20, 20, 3)
        force, torque = rng.uniform(-30, 30, 3), rng.uniform(-0.3, 0.3, 3)
        push, turn = (_array(a) for a in both(angles, rates, force, torque))
        np.testing.assert_allclose(push, force / 0.36, rtol=1e-14)

        def omega(
            t: float, angles: FloatArray = angles, rates: FloatArray = rates, turn: FloatArray = turn
        ) -> FloatArray:
            here = angles + t * rates + t**2 / 2 * turn
            return _array(rate_map(ca.DM(here)) @ (rates + t * turn))

        domega = (omega(1e-6) - omega(-1e-6)) / 2e-6
        I_m = np.array(inertia)
        left = I_m * domega + np.cross(omega(0), I_m * omega(0))
        np.testing.assert_allclose(left, torque, rtol=0, atol=1e-7)
