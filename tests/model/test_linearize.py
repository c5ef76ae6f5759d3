"""The linear model against Table I, the closed forms of M, S and V, and the statics of the trim."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.machines.tubular import plant as tubular
from malta.model.plant import OperatingPoint

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant

STROKE = [-15e-3, -7.3e-3, 0.0, 5e-3, 15e-3]  # m
Q = ("x", "y", "z", "alpha", "beta")


def _at(plant: Plant, z: float) -> LinearModel:
    return malta.linearize(plant, plant.at(z=z))


def _mode(model: LinearModel, name: str) -> FloatArray:
    """The two poles of one coordinate and its rate, where no other couples in (z = 0)."""
    pair = [Q.index(name), Q.index(name) + len(Q)]
    return np.sort(np.linalg.eigvals(model.A[np.ix_(pair, pair)]).real)


def _poles(model: LinearModel) -> FloatArray:
    return np.sort(np.linalg.eigvals(model.A).real)


def _table(model: LinearModel) -> list[float]:
    """The positive poles to two digits, the largest first; every pole has its negative."""
    poles = _poles(model)
    np.testing.assert_allclose(poles, -poles[::-1], rtol=0, atol=1e-6)
    return [round(pole, 2) for pole in poles[:4:-1] if pole > 1]


def test_table_1_to_every_printed_digit(
    par: tubular.Parameters, model: LinearModel, published: dict[str, Any]
) -> None:
    """The poles of the linear mover at z = 0: one unstable and one stable of the same size in each radial mode."""
    printed, digits = published["table_I"]["poles"], published["table_I"]["digits"]
    assert set(printed) == set(Q)
    for name in Q:
        assert [round(pole, digits) for pole in _mode(model, name)] == [-printed[name], printed[name]]
    modes = sorted([s * printed[name] for name in Q for s in (-1, 1)])
    np.testing.assert_allclose(_poles(model), modes, rtol=0, atol=0.5 * 10**-digits)
    assert par.preset == "table1"


def test_table_4_does_not_give_table_1(published: dict[str, Any]) -> None:
    """Table IV's attraction and mass put the poles of x and y at 215.12, 1.7 % below those that Table I prints."""
    par = malta.read("data/tubular.toml", preset=published["table_IV"]["preset"])
    assert isinstance(par, tubular.Parameters)
    assert (par.K_A, par.m, par.I_xx) == (8330, 0.360, 1.3805e-3)
    model = _at(tubular.plant(par), 0.0)
    assert _table(model) == [215.12, 215.12, 157.53, 157.53]
    printed = published["table_I"]["poles"]
    assert printed["x"] / _poles(model)[-1] == pytest.approx(1.0177, abs=1e-4)


@pytest.mark.parametrize(
    ("z", "radial", "tilt"),
    [(0.0, 218.92, 157.53), (5e-3, 220.37, 156.49), (10e-3, 224.47, 153.63), (15e-3, 230.64, 149.52)],
)
def test_poles_over_the_travel(plant: Plant, z: float, radial: float, tilt: float) -> None:
    """They move apart by 5 % at the ends, evenly in z."""
    assert _table(_at(plant, z)) == [radial, radial, tilt, tilt]
    assert _table(_at(plant, -z)) == [radial, radial, tilt, tilt]


@pytest.mark.parametrize("z", STROKE)
def test_product_of_the_poles_is_the_same_everywhere(par: tubular.Parameters, plant: Plant, z: float) -> None:
    """It is 2 K_A l_B / sqrt(m I_xx) at any z, because det S has no z in it; with the printed poles 34486.47."""
    product = math.prod(_poles(_at(plant, z))[[-1, -3]])
    assert product == pytest.approx(2 * par.K_A * par.l_B / math.sqrt(par.m * par.I_xx), rel=1e-11)
    assert product == pytest.approx(218.92 * 157.53, rel=1e-5)


def _closed_forms(par: tubular.Parameters, z: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """M, S, V and P at z without preload: small rotations about the axis, worked out by hand."""
    a, b, c = par.l_B + z, par.l_B - z, par.l_B**2 + z**2
    M = np.diag([par.m, par.m, par.m, par.I_xx, par.I_yy])
    S = np.array([[1, 0, 0, 0, -z], [0, 1, 0, z, 0], [0, 0, 0, 0, 0], [0, z, 0, c, 0], [-z, 0, 0, 0, c]])
    V = np.array([[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [0, 0, 0, 0, 1], [0, a, 0, -b, 0], [-a, 0, b, 0, 0]])
    low, high = par.l_S + z, par.l_S - z
    P = np.array(
        [[1, 0, 0, 0, -low], [0, 1, 0, low, 0], [1, 0, 0, 0, high], [0, 1, 0, -high, 0], [0, 0, 1, 0, 0]]
    )
    return M, 2 * par.K_A * S, V, P


@pytest.mark.parametrize("I_yy", [1.3805e-3, 2.5e-3])
@pytest.mark.parametrize("small_angle", [False, True])
@pytest.mark.parametrize("z", STROKE)
def test_closed_forms(par: tubular.Parameters, z: float, small_angle: bool, I_yy: float) -> None:
    """A = [0, 1; M^-1 S, 0], B = [0; M^-1 V], C = [P(z), 0], exact and small angles, symmetric S.

    NOTE: with the second lever arm as eq. (12) prints it, (l_B + z), S would not be symmetric.
    """
    par = replace(par, I_yy=I_yy)
    model = _at(tubular.plant(par, small_angle=small_angle), z)
    M, S, V, P = _closed_forms(par, z)
    ours = M @ model.stiffness
    np.testing.assert_allclose(ours, S, rtol=0, atol=1e-12 * S.max())
    np.testing.assert_allclose(ours, ours.T, rtol=0, atol=1e-12 * S.max())
    np.testing.assert_allclose(M @ model.force_map, V, rtol=0, atol=1e-12 * V.max())
    np.testing.assert_allclose(model.C, np.hstack([P, np.zeros((5, 5))]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(model.A[:5], np.hstack([np.zeros((5, 5)), np.eye(5)]))
    np.testing.assert_array_equal(model.A[5:, 5:], np.zeros((5, 5)))  # no damping, no spin
    np.testing.assert_array_equal(model.B[:5], np.zeros((5, 5)))


def test_a_spinning_mover_is_gyroscopic(par: tubular.Parameters, plant: Plant) -> None:
    """A spin Omega couples the tilts: alpha'' = -(I_zz / I_xx) Omega beta', beta'' = (I_zz / I_xx) Omega alpha'."""
    spin = 40.0
    A = malta.linearize(plant, plant.at(gamma_dot=spin)).A
    coupling = par.I_zz / par.I_xx * spin
    np.testing.assert_allclose(A[8:, 8:], [[0, -coupling], [coupling, 0]], rtol=0, atol=1e-13)
    assert coupling == pytest.approx(1.3823, abs=1e-4)


def test_unequal_inertias_split_the_tilting_poles(par: tubular.Parameters) -> None:
    """Each tilt has its own inertia: 157.53 stays with alpha, beta goes with the square root of I_xx / I_yy."""
    model = _at(tubular.plant(replace(par, I_yy=4 * par.I_xx)), 0.0)
    alpha, beta = _mode(model, "alpha")[1], _mode(model, "beta")[1]
    assert alpha == pytest.approx(157.53, abs=5e-3)
    assert beta == pytest.approx(alpha / 2, rel=1e-12)


def test_gamma_is_left_out_and_names_stay(model: LinearModel) -> None:
    """Ten states of twelve, five inputs, five sensors, with their names in python-control's system."""
    assert (model.A.shape, model.B.shape, model.C.shape) == ((10, 10), (10, 5), (5, 10))
    rates = [f"{name}_dot" for name in Q]
    assert model.sys.state_labels == [*Q, *rates]
    assert model.sys.input_labels == ["fx_B1", "fy_B1", "fx_B2", "fy_B2", "f_D"]
    assert model.sys.output_labels == ["x1", "y1", "x2", "y2", "z"]
    assert model.sys.name == "tubular"
    for name in "ABC":
        np.testing.assert_array_equal(getattr(model.sys, name), getattr(model, name))
    np.testing.assert_array_equal(model.sys.D, np.zeros((5, 5)))
    assert model.sys.dt == 0  # continuous time


def test_what_is_left_out_is_out_of_reach(plant: Plant) -> None:
    """No input turns the mover about its own axis and no design state feels gamma: dropping it loses nothing."""
    x, u = ca.SX.sym("x", 12), ca.SX.sym("u", 5)
    f = plant.f(x, u, ca.SX.zeros(6))
    slopes = ca.Function("slopes", [x, u], [ca.jacobian(f, x), ca.jacobian(f, u)])
    A, B = (np.array(a) for a in slopes(plant.at(z=5e-3).x, np.zeros(5)))
    gamma, kept = [5, 11], list(plant.controlled)
    assert (B[gamma] == 0).all()
    assert (A[np.ix_(kept, gamma)] == 0).all()
    assert (A[np.ix_(gamma, kept)] == 0).all()


@pytest.mark.parametrize("z", STROKE)
@pytest.mark.parametrize("I_yy", [1.3805e-3, 2.5e-3])
def test_trim_adds_the_slopes_of_the_loads(par: tubular.Parameters, z: float, I_yy: float) -> None:
    """With u held at the trim and the loads acting, three slopes join the stiffness without preload.

    alpha'' = (m g / I_xx) z: the bearing forces keep still while the weight moves away from between them.
    z'' = (2 pi / L_p) (F_c / m) cos(2 pi z / L_p + phi_c) z: the wave of the cogging.
    alpha'' = (z f_D / I_xx) alpha, and beta alike: halves of the drive force act at both modules, the cogging
    that they balance at the centre of gravity, which is z away from the middle of the two.
    """
    par = replace(par, phi_c=0.3, I_yy=I_yy)
    plant = tubular.plant(par)
    point = malta.trim(plant, z=z)
    wave = 2 * math.pi / par.L_p
    f_D = -par.F_c * math.sin(wave * z + par.phi_c)
    added = np.zeros((5, 5))
    added[2, 2] = wave * par.F_c / par.m * math.cos(wave * z + par.phi_c)
    added[3, 2] = par.m * par.g / par.I_xx
    added[3, 3], added[4, 4] = z * f_D / par.I_xx, z * f_D / par.I_yy
    loaded, free = malta.linearize(plant, point), _at(plant, z)
    size = abs(free.stiffness).max()
    np.testing.assert_allclose(loaded.stiffness - free.stiffness, added, rtol=0, atol=1e-14 * size)
    np.testing.assert_array_equal(loaded.B, free.B)
    np.testing.assert_array_equal(loaded.C, free.C)
    np.testing.assert_array_equal(loaded.A[5:, 5:], np.zeros((5, 5)))


def test_gravity_ties_the_tilt_to_the_stroke(plant: Plant) -> None:
    """2558 rad/s2 of alpha'' per metre of z: why, in Fig. 13, y1 and y2 move in a stroke and x1 and x2 do not."""
    stiffness = malta.linearize(plant, malta.trim(plant, z=0.0)).stiffness
    assert stiffness[Q.index("alpha"), Q.index("z")] == pytest.approx(2558, abs=0.5)
    assert (stiffness[[Q.index("x"), Q.index("beta")], Q.index("z")] == 0).all()
    cogging = stiffness[Q.index("z"), Q.index("z")]  # pushes away from 0
    assert cogging == pytest.approx(581.78, abs=0.01)


def test_without_preload_no_load_is_seen(par: tubular.Parameters) -> None:
    """v0(z) cancels weight and cogging at every position, so at plant.at neither is in the model."""
    light = _at(tubular.plant(replace(par, g=0, F_c=0)), 5e-3)
    heavy = _at(tubular.plant(replace(par, g=9.81, F_c=2)), 5e-3)
    np.testing.assert_array_equal(light.A, heavy.A)
    assert heavy.stiffness[2].tolist() == [0, 0, 0, 0, 0]


@pytest.mark.parametrize("z", STROKE)
def test_nothing_accelerates_at_trim(plant: Plant, z: float) -> None:
    """The residual of the trim is rounding: 1e-12 m/s2 and rad/s2 beside 9.81 and 2558 z."""
    point = malta.trim(plant, z=z)
    left = np.array(plant.f(point.x, point.u, plant.load(point.x))).ravel()
    assert abs(left).max() < 1e-11
    fallen = np.array(plant.f(point.x, np.zeros(5), plant.load(point.x))).ravel()
    assert fallen[7] == pytest.approx(-9.81)


@pytest.mark.parametrize(("n", "m"), [(10, 5), (12, 4), (0, 5), (13, 6)])
def test_a_point_of_the_wrong_size_is_refused(plant: Plant, n: int, m: int) -> None:
    """The message gives both sizes."""
    point = OperatingPoint(np.zeros(n), np.zeros(m), loaded=False)
    with pytest.raises(malta.InputError, match="operating point") as caught:
        malta.linearize(plant, point)
    assert caught.value.found == f"x ({n},), u ({m},)"
    assert caught.value.expected == "x (12,), u (5,)"


def test_a_point_without_a_linear_model_is_refused(plant: Plant) -> None:
    """An infinite force has no slope: an answer with NaN would be worse than none."""
    point = OperatingPoint(plant.at(z=0.0).x, np.full(5, math.inf), loaded=False)
    with pytest.raises(malta.CheckError, match="not finite"):
        malta.linearize(plant, point)


def test_the_model_cannot_be_written_to(model: LinearModel) -> None:
    """A, B, C and the blocks cut from them are read-only."""
    for array in (model.A, model.B, model.C, model.stiffness, model.force_map):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
