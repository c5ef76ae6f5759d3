"""The mover against energy, a second formulation, its symmetry, finite differences and its statics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

import malta
from malta.machines.tubular import plant as tubular
from malta.model.parameters import differences
from malta.model.rigid_body import cardan_rates, rotation

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.plant import Plant

Rate = Callable[[Any, Any, Any], "FloatArray"]

NO_INPUT, NO_WRENCH = np.zeros(5), np.zeros(6)
# Sizes of a random state far outside the air gap, so that no term hides: m and rad, then m/s and rad/s.
SIZE = np.array([5e-3, 5e-3, 15e-3, 0.3, 0.3, 3.0, 0.5, 0.5, 1.0, 10.0, 10.0, 50.0])
FIELDS = [f for f in fields(tubular.Parameters) if "unit" in f.metadata]
SIGNED = {"phi_c", *differences(tubular.Parameters)}  # a phase, and what scatters about 0
OPTIONAL = {f.name for f in FIELDS if f.default == 0}  # 0 leaves an effect out


def _numeric(outputs: Callable[..., Any], *sizes: int) -> Callable[..., FloatArray]:
    """A CasADi expression of vectors of these sizes as a function of numpy arrays."""
    arguments = [ca.SX.sym(f"a{i}", size) for i, size in enumerate(sizes)]
    function = ca.Function("numeric", arguments, [outputs(*arguments)])
    return lambda *values: np.array(function(*values)).squeeze()


def _rate(plant: Plant) -> Rate:
    """(x, u, w) -> x' under the machine's own loads."""
    return _numeric(lambda x, u, w: plant.f(x, u, w + plant.load(x)), 12, 5, 6)


def _energy(par: tubular.Parameters) -> Callable[..., FloatArray]:
    return _numeric(lambda x: tubular.energy(par, x), 12)


def _kinetic(par: tubular.Parameters) -> Callable[..., FloatArray]:
    return _energy(replace(par, K_A=0, g=0, F_c=0))


def _drift(plant: Plant, par: tubular.Parameters, start: FloatArray, time: float, rtol: float) -> float:
    """Largest change of energy on the way, relative to the largest kinetic energy met."""
    rate, energy, kinetic = _rate(plant), _energy(par), _kinetic(par)
    path = solve_ivp(
        lambda _, x: rate(x, NO_INPUT, NO_WRENCH),
        (0, time),
        start,
        "DOP853",
        rtol=rtol,
        atol=rtol * abs(start),
    )
    assert path.success
    E = np.array([energy(x) for x in path.y.T])
    return float(abs(E - E[0]).max() / max(kinetic(x) for x in path.y.T))


# x y z, alpha beta gamma, and their rates. No component is zero: the integrator's tolerance is relative to each.
TUMBLING = np.array([1e-3, -2e-3, 3e-3, 0.1, -0.15, 0.5, 0.3, 0.2, 0.4, 5.0, -4.0, 20.0])
HAIR = np.array([1e-13, -1e-13, 1e-3, 1e-12, -1e-12, 0.5, 1e-11, 2e-11, 0.1, 1e-10, -1e-10, 10.0])
FREE_FLIGHTS: dict[str, tuple[dict[str, Any], FloatArray, float]] = {
    # Attraction at full strength for 21.9 time constants, e^21.9 = 3e9: only a hair off the axis, almost weightless.
    "full attraction": ({"g": 1e-9}, HAIR, 0.1),
    "full attraction and weight": ({}, TUMBLING, 0.012),
    "weak attraction": ({"K_A": 86.267}, TUMBLING, 0.1),
    "unequal inertias": ({"K_A": 86.267, "I_yy": 2.5e-3, "phi_c": 0.7}, TUMBLING, 0.1),
}


@pytest.mark.parametrize("case", FREE_FLIGHTS)
def test_energy_is_conserved_in_free_flight(par: tubular.Parameters, case: str) -> None:
    """Gravity, attraction and cogging have a potential, and the equations of motion follow from it."""
    changes, start, time = FREE_FLIGHTS[case]
    changed = replace(par, **changes)
    assert _drift(tubular.plant(changed), changed, start, time, rtol=1e-12) < 1e-8


def test_full_attraction_carries_the_mover_from_a_hair_to_a_fraction_of_the_gap(
    par: tubular.Parameters,
) -> None:
    """The first of the free flights above covers nine decades and stays where a mover could be."""
    changes, start, time = FREE_FLIGHTS["full attraction"]
    rate = _rate(tubular.plant(replace(par, **changes)))
    end = solve_ivp(
        lambda _, x: rate(x, NO_INPUT, NO_WRENCH),
        (0, time),
        start,
        "DOP853",
        rtol=1e-9,
        atol=1e-9 * abs(start),
    ).y[:, -1]
    assert 1e-4 < np.hypot(end[0], end[1]) < 0.6e-3


def test_energy_drift_is_the_integrators(par: tubular.Parameters) -> None:
    """The drift falls with the tolerance over five decades: nothing of it belongs to the model."""
    weak = replace(par, K_A=86.267)
    plant = tubular.plant(weak)
    drifts = [_drift(plant, weak, TUMBLING, 0.1, rtol) for rtol in (1e-6, 1e-8, 1e-10, 1e-12)]
    for coarse, fine in pairwise(drifts):
        assert fine < coarse / 20
    assert drifts[-1] < 1e-5 * drifts[0]


def test_papers_equations_do_not_conserve_energy(par: tubular.Parameters) -> None:
    """Eqs (9), (10) have no axial attraction: in an axial motion of a tilted mover energy comes from nowhere."""
    weightless = replace(par, K_A=86.267, g=0, F_c=0)
    start = np.array([1e-3, -1e-3, 1e-3, 0.02, -0.02, 1e-3, 1e-3, 1e-3, 1.0, 1e-3, 1e-3, 1e-3])
    paper = _drift(tubular.plant(weightless, small_angle=True), weightless, start, 0.03, rtol=1e-12)
    exact = _drift(tubular.plant(weightless), weightless, start, 0.03, rtol=1e-12)
    assert paper > 1e-4
    assert exact < 1e-10


def test_power_that_the_papers_equations_invent(par: tubular.Parameters) -> None:
    """To leading order it is z' sum F_A . n: the axial part of the attraction that (9), (10) leave out."""
    gain = _numeric(
        lambda x: ca.jtimes(
            tubular.energy(par, x),
            x,
            tubular.plant(par, small_angle=True).f(x, NO_INPUT, tubular.load(par, x)),
        ),
        12,
    )
    x = 1e-4 * np.array([1, -2, 0, 2, 3, 1, 1, 2, 0, 3, 2, 1])
    x[2], x[8] = 5e-3, 1.0
    n = np.array([x[4], -x[3]])
    pull = sum(par.K_A * (x[:2] + l_i * n) for l_i in (-(par.l_B + x[2]), par.l_B - x[2]))
    assert gain(x) == pytest.approx(x[8] * pull @ n, rel=1e-4)


@pytest.mark.parametrize("I_yy", [1.3805e-3, 2.5e-3])
def test_power_balance(par: tubular.Parameters, I_yy: float) -> None:
    """dE/dt is what the inputs and the wrench feed in, F . v + T . omega: at every state, without integration."""
    par = replace(par, I_yy=I_yy)
    rate = _rate(tubular.plant(par))
    slope = _numeric(lambda x: ca.gradient(tubular.energy(par, x), x), 12)
    motion = _motion()
    rng = np.random.default_rng(1)
    for _ in range(30):
        x, u, w = rng.uniform(-SIZE, SIZE), rng.uniform(-20, 20, 5), rng.uniform(-1, 1, 6)
        v = x[6:9]
        R, dR, _ = motion(x[3:6], x[9:12], np.zeros(3))
        omega = _vector(-R.T @ dR)  # of the mover, in frame I
        fed = w[:3] @ v + w[3:] @ omega
        for l_i, force in (
            (-(par.l_B + x[2]), np.array([*u[0:2], u[4] / 2])),
            (par.l_B - x[2], np.array([*u[2:4], u[4] / 2])),
        ):
            fed += force @ (v + np.cross(omega, l_i * R[2]))
        parts = slope(x) * rate(x, u, w)
        assert parts.sum() == pytest.approx(fed, abs=1e-12 * abs(parts).sum())


def _skew(a: FloatArray) -> FloatArray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def _vector(skew: FloatArray) -> FloatArray:
    """The inverse of _skew."""
    return np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2


def _motion() -> Callable[..., tuple[FloatArray, FloatArray, FloatArray]]:
    """(q_r, q_r', q_r'') -> R_RI, R_RI', R_RI'' by the chain rule, from nothing but `rotation`."""
    q, dq, ddq = (ca.SX.sym(name, 3) for name in ("q", "dq", "ddq"))
    R = ca.vec(rotation(q))
    dR = ca.jtimes(R, q, dq)
    ddR = ca.jtimes(dR, q, dq) + ca.jtimes(R, q, ddq)
    function = ca.Function("motion", [q, dq, ddq], [ca.reshape(a, 3, 3) for a in (R, dR, ddR)])
    return lambda *arguments: tuple(np.array(a) for a in function(*arguments))


def _free_body(par: tubular.Parameters, s: FloatArray, u: FloatArray, w: FloatArray) -> FloatArray:
    """Rates of s = (place, velocity, attitude body -> inertial, body rates): Newton and Euler, no Cardan angle."""
    place, velocity, attitude, spin = s[:3], s[3:6], s[6:15].reshape(3, 3), s[15:]
    axis = attitude[:, 2]
    force, torque = w[:3].copy(), w[3:].copy()
    force[1] -= par.m * par.g
    force[2] += par.F_c * math.sin(2 * math.pi * place[2] / par.L_p + par.phi_c)
    for module, lever in enumerate((-(par.l_B + place[2]), par.l_B - place[2])):
        arm = lever * axis
        pull = par.K_A * (place + arm) * [1, 1, 0]
        applied = pull + np.array([u[2 * module], u[2 * module + 1], u[4] / 2])
        force += applied - [0, 0, pull @ axis]
        torque += _skew(arm) @ applied
    inertia = np.array([par.I_xx, par.I_yy, par.I_zz])
    spin_rate = (attitude.T @ torque - _skew(spin) @ (inertia * spin)) / inertia
    return np.concatenate([velocity, force / par.m, (attitude @ _skew(spin)).ravel(), spin_rate])


def _smooth(rng: np.random.Generator, size: FloatArray) -> Callable[[float], FloatArray]:
    """A sum of three sines in every entry, of random amplitude, frequency (rad/s) and phase."""
    shape = (3, len(size))
    amplitude, frequency, phase = (
        rng.uniform(-1, 1, shape),
        rng.uniform(20, 600, shape),
        rng.uniform(0, 6.3, shape),
    )
    return lambda t: size * (amplitude * np.sin(frequency * t + phase)).sum(axis=0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("I_yy", [1.3805e-3, 2.5e-3])
def test_a_second_formulation_moves_alike(par: tubular.Parameters, seed: int, I_yy: float) -> None:
    """Cardan angles and CasADi against a rotation matrix and plain numpy: the same motion to 1e-9, driven at random."""
    par = replace(par, I_yy=I_yy, phi_c=0.4)
    rng = np.random.default_rng(seed)
    rate, motion = _rate(tubular.plant(par)), _motion()
    u, w = _smooth(rng, np.full(5, 20.0)), _smooth(rng, np.array([10, 10, 10, 0.3, 0.3, 0.02]))
    x0 = rng.uniform(-SIZE, SIZE)
    R0, dR0, _ = motion(x0[3:6], x0[9:12], np.zeros(3))
    s0 = np.concatenate([x0[:3], x0[6:9], R0.T.ravel(), _vector(-dR0 @ R0.T)])
    times = np.linspace(0, 0.012, 31)
    accuracy: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14, "t_eval": times}
    theirs = solve_ivp(lambda t, s: _free_body(par, s, u(t), w(t)), (0, times[-1]), s0, **accuracy).y.T
    ours = solve_ivp(lambda t, x: rate(x, u(t), w(t)), (0, times[-1]), x0, **accuracy).y.T

    assert 0.2 < abs(ours[:, 3:5]).max() < 1.2  # rad: far beyond small angles, short of the singularity
    for t, x, s in zip(times, ours, theirs, strict=True):
        R, dR, ddR = motion(x[3:6], x[9:12], rate(x, u(t), w(t))[9:])
        np.testing.assert_allclose(x[:3], s[:3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(R.T, s[6:15].reshape(3, 3), rtol=0, atol=1e-9)
        # Accelerations at one and the same state, ours.
        here = np.concatenate([x[:3], x[6:9], R.T.ravel(), _vector(-dR @ R.T)])
        there = _free_body(par, here, u(t), w(t))
        turning, turning_rate = _skew(here[15:]), _skew(there[15:])
        bend = (R.T @ (turning @ turning + turning_rate)).T
        push = rate(x, u(t), w(t))[6:9]
        np.testing.assert_allclose(push, there[3:6], rtol=0, atol=1e-9 * abs(push).max())
        np.testing.assert_allclose(ddR, bend, rtol=0, atol=1e-9 * abs(bend).max())


def _about_z(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _angles(R: FloatArray) -> FloatArray:
    """Cardan angles of R_RI."""
    return np.array([math.atan2(-R[2, 1], R[2, 2]), math.asin(R[2, 0]), math.atan2(-R[1, 0], R[0, 0])])


@pytest.mark.parametrize("I_yy", [1.3805e-3, 2.5e-3])
def test_turning_the_machine_about_its_axis_turns_the_answer(par: tubular.Parameters, I_yy: float) -> None:
    """Two equal axes of the stator: mover, forces and weight turned by any angle accelerate turned by that angle."""
    par = replace(par, g=0, I_yy=I_yy)
    plant = tubular.plant(par)
    rate, motion = _rate(plant), _motion()
    sensed = _numeric(lambda x: plant.h(x, NO_INPUT), 12)
    weight = np.array([0, -0.36 * 9.81, 0, 0, 0, 0])
    rng = np.random.default_rng(3)
    for psi in rng.uniform(-math.pi, math.pi, 20):
        x, u, w = rng.uniform(-SIZE, SIZE), rng.uniform(-20, 20, 5), rng.uniform(-1, 1, 6) + weight
        turn = _about_z(psi)
        twice = np.kron(np.eye(2), turn[:2, :2])
        R, dR, _ = motion(x[3:6], x[9:12], np.zeros(3))
        rotate = np.zeros(12)
        rotate[:3], rotate[6:9], rotate[3:6] = turn @ x[:3], turn @ x[6:9], _angles(R @ turn.T)
        # The mover turns along, so its angular velocity has the same components in frame R.
        rotate[9:] = np.array(cardan_rates(ca.DM(rotate[3:6]), ca.DM(_vector(-dR @ R.T)))).ravel()
        here = rate(x, u, w)
        there = rate(rotate, np.append(twice @ u[:4], u[4]), np.kron(np.eye(2), turn) @ w)
        bend, bend_turned = motion(x[3:6], x[9:], here[9:])[2], motion(rotate[3:6], rotate[9:], there[9:])[2]
        np.testing.assert_allclose(there[6:9], turn @ here[6:9], rtol=0, atol=1e-11 * abs(here[6:9]).max())
        np.testing.assert_allclose(bend_turned, bend @ turn.T, rtol=0, atol=1e-11 * abs(bend).max())
        p, p_turned = sensed(x), sensed(rotate)
        np.testing.assert_allclose(p_turned, np.append(twice @ p[:4], p[4]), rtol=0, atol=1e-14)


def test_the_angle_about_a_symmetric_movers_axis_is_felt_by_nothing(par: tubular.Parameters) -> None:
    """With I_xx = I_yy no acceleration and no sensor knows gamma; with unequal inertias accelerations do."""
    rng = np.random.default_rng(4)
    x, u, w = rng.uniform(-SIZE, SIZE), rng.uniform(-20, 20, 5), rng.uniform(-1, 1, 6)
    rolled = x + 1.1 * (np.arange(12) == 5)
    plant = tubular.plant(par)
    assert (_rate(plant)(rolled, u, w) == _rate(plant)(x, u, w)).all()
    sensed = _numeric(lambda x: plant.h(x, NO_INPUT), 12)
    np.testing.assert_allclose(sensed(rolled), sensed(x), rtol=0, atol=1e-15)
    lopsided = _rate(tubular.plant(replace(par, I_yy=2.5e-3)))
    assert abs(lopsided(rolled, u, w) - lopsided(x, u, w)).max() > 100  # rad/s2


def _central(function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float = 1e-6) -> FloatArray:
    steps = step * np.eye(len(at))
    return np.array([(function(at + d) - function(at - d)) / (2 * step) for d in steps]).T


@pytest.mark.parametrize("small_angle", [False, True])
@pytest.mark.parametrize("I_yy", [1.3805e-3, 2.5e-3])
def test_jacobians_equal_central_differences(par: tubular.Parameters, I_yy: float, small_angle: bool) -> None:
    """CasADi's derivatives of f (by x, u and w) and of h, at random states."""
    plant = tubular.plant(replace(par, I_yy=I_yy), small_angle=small_angle)
    rate = _rate(plant)
    sensed = _numeric(lambda x: plant.h(x, NO_INPUT), 12)

    def stacked(s: Any) -> Any:
        return plant.f(s[:12], s[12:17], s[17:] + plant.load(s[:12]))

    f_slope = _numeric(lambda s: ca.jacobian(stacked(s), s), 23)
    h_slope = _numeric(lambda x: ca.jacobian(plant.h(x, NO_INPUT), x), 12)
    rng = np.random.default_rng(5)
    for _ in range(3):
        s = np.concatenate([rng.uniform(-SIZE, SIZE), rng.uniform(-20, 20, 5), rng.uniform(-1, 1, 6)])
        J = f_slope(s)
        difference = abs(J - _central(lambda s: rate(s[:12], s[12:17], s[17:]), s))
        assert (difference <= 1e-6 * abs(J).max(axis=1, keepdims=True)).all()
        np.testing.assert_allclose(h_slope(s[:12]), _central(sensed, s[:12]), rtol=0, atol=1e-9)


def test_small_angles_agree_to_first_order(par: tubular.Parameters) -> None:
    """Halving a motion shows the order in which the paper's equations err.

    The second axially, for the attraction that they leave out; the third in alpha and beta; the fourth in the rest.
    With forces on, the second in alpha and beta: cos a = 1 multiplies a force.
    """
    exact, paper = _rate(tubular.plant(par)), _rate(tubular.plant(par, small_angle=True))
    motion = np.array([1e-3, -2e-3, 5e-3, 0.1, 0.15, 0.1, 0.1, -0.2, 0.1, 4.0, 3.0, 5.0])

    def orders(amplitude: float, u: FloatArray, rows: slice) -> FloatArray:
        coarse, fine = (
            abs(exact(a * motion, u, NO_WRENCH) - paper(a * motion, u, NO_WRENCH))
            for a in (amplitude, amplitude / 2)
        )
        assert (coarse[:6] == 0).all()
        return np.log2(coarse[rows] / fine[rows])

    free = orders(0.05, NO_INPUT, slice(6, 12))
    np.testing.assert_allclose(free, [4, 4, 2, 3, 3, 4], rtol=0, atol=0.02)
    driven = orders(0.001, np.array([5.0, -3.0, 2.0, 4.0, 6.0]), slice(9, 11))
    np.testing.assert_allclose(driven, 2, rtol=0, atol=0.1)


def test_sensors_agree_with_small_angles_to_second_order(par: tubular.Parameters) -> None:
    """Where the axis pierces the sensor planes: tan a / cos b against a, an error of the third order."""
    exact = _numeric(lambda x: tubular.plant(par).h(x, NO_INPUT), 12)
    small = _numeric(lambda x: tubular.plant(par, small_angle=True).h(x, NO_INPUT), 12)
    pose = np.array([4e-4, -3e-4, 0.01, 0.1, 0.15, 0.3, 0, 0, 0, 0, 0, 0])

    def error(tilt: float) -> FloatArray:
        x = pose * np.where((np.arange(12) >= 3) & (np.arange(12) < 6), tilt, 1)
        return abs(exact(x) - small(x))

    np.testing.assert_allclose(error(0.2)[:4] / error(0.1)[:4], 8, rtol=0.01)
    assert 1e-9 < error(0.1)[:4].max() < 1e-6  # m, at 0.018 rad
    assert error(0.2)[4] == 0


def test_a_tilted_axis_pierces_the_sensor_planes_where_geometry_says(par: tubular.Parameters) -> None:
    """A tilt beta alone moves x by tan(beta) per metre of z, a tilt alpha alone moves y by -tan(alpha)."""
    z, angle = 4e-3, 0.2
    beta = np.array(tubular.measure_outputs(par, ca.DM([0, 0, z, 0, angle, 0]))).ravel()
    alpha = np.array(tubular.measure_outputs(par, ca.DM([0, 0, z, angle, 0, 0]))).ravel()
    planes = np.array([-par.l_S, par.l_S]) - z
    np.testing.assert_allclose(beta[[0, 2]], math.tan(angle) * planes, rtol=1e-14)
    np.testing.assert_allclose(alpha[[1, 3]], -math.tan(angle) * planes, rtol=1e-14)
    assert (beta[[1, 3]] == 0).all()
    assert (alpha[[0, 2]] == 0).all()


@pytest.mark.parametrize("z", [-15e-3, -7.3e-3, 0.0, 5e-3, 15e-3])
def test_trim_is_the_lever_rule(par: tubular.Parameters, z: float) -> None:
    """The bearing further from the centre of gravity carries less of the weight; the drive holds the cogging.

    NOTE: Figure 13's text has the two the other way round at z = +5 mm.
    """
    par = replace(par, phi_c=0.3)
    cogging = par.F_c * math.sin(2 * math.pi * z / par.L_p + par.phi_c)
    weight = par.m * par.g
    levers = 0, par.l_B - z, 0, par.l_B + z
    expected = [weight * lever / (2 * par.l_B) for lever in levers]
    u = malta.trim(tubular.plant(par), z=z).u
    np.testing.assert_allclose(u, [*expected, -cogging], rtol=0, atol=1e-12)


def test_trim_off_the_axis_holds_the_attraction(par: tubular.Parameters, plant: Plant) -> None:
    """A mover 0.1 mm beside the axis is pulled outwards with 2 K_A x, half of it in each module."""
    u = malta.trim(plant, x=1e-4).u
    weight = par.m * par.g / 2
    np.testing.assert_allclose(u, [-par.K_A * 1e-4, weight, -par.K_A * 1e-4, weight, 0], rtol=0, atol=1e-12)


def test_position_of_inverts_the_sensors(par: tubular.Parameters) -> None:
    """q = P(z)^-1 p for random poses, small angles; with exact sensors it errs by the cube of the angle."""
    rng = np.random.default_rng(6)
    plant = tubular.plant(par, small_angle=True)
    back = _numeric(lambda x: plant.position_of(plant.h(x, NO_INPUT)), 12)
    exact = _numeric(lambda x: tubular.position_of(par, tubular.measure_outputs(par, x)), 12)
    for _ in range(100):
        x = rng.uniform(-SIZE, SIZE)
        np.testing.assert_allclose(back(x), x[:5], rtol=0, atol=1e-12)
        x[3:5] *= 0.02  # 6 mrad: touchdown
        np.testing.assert_allclose(exact(x), x[:5], rtol=0, atol=3e-7)


@pytest.mark.parametrize("z", [-15e-3, -7.3e-3, 0.0, 5e-3, 15e-3, 1.0])
def test_sensor_matrix_is_invertible_everywhere(par: tubular.Parameters, z: float) -> None:
    """det P(z) = (2 l_S)^2. NOTE: the paper calls it singular, which holds with the gamma column only."""
    plant = tubular.plant(par, small_angle=True)
    P = _numeric(lambda x: ca.jacobian(plant.h(x, NO_INPUT), x)[:, :6], 12)(plant.at(z=z).x)
    assert np.linalg.det(P[:, :5]) == pytest.approx((2 * par.l_S) ** 2, rel=1e-12)
    assert (P[:, 5] == 0).all()


def test_contact_is_one_at_touchdown(par: tubular.Parameters, plant: Plant) -> None:
    """A share of exactly 1 at r_max in both planes, in the one plane that a tilted mover reaches, and at the stop."""
    assert np.array(plant.contacts.contact(plant.at(x=par.r_max).x)).ravel().tolist() == [1, 1, 0]
    assert np.array(plant.contacts.contact(plant.at(y=-par.r_max).x)).ravel().tolist() == [1, 1, 0]
    assert np.array(plant.contacts.contact(plant.at(z=-par.z_max).x)).ravel().tolist() == [0, 0, 1]
    beta = math.atan(par.r_max / (2 * par.l_S))  # about the point where the axis crosses plane 2
    tilted = plant.at(x=-par.l_S * math.tan(beta), beta=beta).x
    np.testing.assert_allclose(
        np.array(plant.contacts.contact(tilted)).ravel(), [1, 0, 0], rtol=0, atol=1e-13
    )
    small_angle = tubular.plant(par, small_angle=True)
    share = small_angle.contacts.contact(
        small_angle.at(beta=par.r_max / par.l_S).x
    )  # where l_S beta is the clearance
    np.testing.assert_allclose(np.array(share).ravel(), [1, 1, 0], rtol=0, atol=1e-13)
    diagonal = plant.at(x=0.6 * par.r_max, y=0.8 * par.r_max).x
    np.testing.assert_allclose(
        np.array(plant.contacts.contact(diagonal)).ravel(), [1, 1, 0], rtol=0, atol=1e-15
    )


def test_limits_of_force(plant: Plant) -> None:
    """5 A times 5.2 N/A in each bearing axis; the drive has both modules, eq. (17)."""
    np.testing.assert_allclose(plant.actuator.force_limit, [26, 26, 26, 26, 52], rtol=1e-15)


def _changed(par: tubular.Parameters, name: str, value: Any) -> tubular.Parameters:
    changes: dict[str, Any] = {name: value}
    return replace(par, **changes)


@pytest.mark.slow
@settings(deadline=None)
@given(
    f=st.sampled_from(FIELDS),
    value=st.one_of(
        st.sampled_from(
            [math.nan, math.inf, -math.inf, True, False, None, "", "0.36", "0.36 kg", [0.36], 1j]
        ),
        st.text(max_size=5),
    ),
)
def test_a_parameter_is_a_finite_number(par: tubular.Parameters, f: Any, value: Any) -> None:
    """NaN, infinity, a bool, a string, a list: refused with the field's name."""
    with pytest.raises(malta.InputError) as caught:
        _changed(par, f.name, value)
    assert caught.value.field == f.name


@settings(deadline=None)
@given(
    f=st.sampled_from([f for f in FIELDS if f.name not in SIGNED]),
    value=st.floats(max_value=0, exclude_max=True, allow_infinity=False),
)
def test_no_parameter_but_the_cogging_phase_is_negative(
    par: tubular.Parameters, f: Any, value: float
) -> None:
    """A negative mass, inertia, length or noise, however small, is refused with the field's name."""
    said = re.escape(f"{f.name}: found {value} {f.metadata['unit']}")
    with pytest.raises(malta.InputError, match=said):
        _changed(par, f.name, value)


@pytest.mark.parametrize("f", FIELDS, ids=lambda f: f.name)
def test_what_may_be_zero(par: tubular.Parameters, f: Any) -> None:
    """A machine without attraction, weight, cogging, delay or noise exists; one without mass or bearings does not."""
    noise = {"s_r", "n_x1", "n_y1", "n_x2", "n_y2", "s_z", "dp"}
    if f.name in {"K_A", "g", "F_c", "phi_c", "T_d", "d_t", "t_dead"} | noise | OPTIONAL:
        assert getattr(_changed(par, f.name, 0), f.name) == 0
    else:
        with pytest.raises(malta.InputError) as caught:
            _changed(par, f.name, 0)
        assert caught.value.field == f.name


def test_the_cogging_phase_may_be_negative(par: tubular.Parameters) -> None:
    """A phase has no sign to refuse."""
    assert replace(par, phi_c=-1).phi_c == -1
