"""The planar motor as a machine of the pipeline: commutation, forces, limits and contacts of its Plant."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import malta
from malta.machines.planar import commutation, field as coils, plant as planar
from malta.model.equilibrium import trim
from malta.model.parameters import shape_parameters, units_of
from malta.model.plant import Plant, symbolic
from malta.model.plants import plant_of

if TYPE_CHECKING:
    from malta.arrays import FloatArray

FILE = Path("data/planar.toml")
AT = np.array([6e-3, 4e-3, 0.3e-3, *np.zeros(9)])  # level, where nothing is symmetric
TILTED = np.array([6e-3, 4e-3, 0.3e-3, 1e-3, -2e-3, 3e-3, 0.1, 0.2, -0.1, 0.3, 0.1, -0.2])
WRENCH = np.array([50.0, -200, 400, 3, -2, 1])


@pytest.fixture(scope="module")
def par() -> planar.Parameters:
    parameters: planar.Parameters = malta.read(FILE)
    return parameters


@pytest.fixture(scope="module")
def machine(par: planar.Parameters) -> Plant:
    return plant_of(par)


def column(value: Any) -> FloatArray:
    return np.array(ca.evalf(value), dtype=float).ravel()


# --- The record ---


def test_the_record_fits_together(machine: Plant) -> None:
    """Six forces for six positions, sixteen coils; the hover at the origin is a legal operating point."""
    assert (
        len(machine.inputs) == len(machine.outputs) == len(machine.disturbances) == len(machine.inertia) == 6
    )
    assert [s.name for s in machine.states[:6]] == [s.name for s in machine.outputs]
    assert len(machine.actuator.coils) == 16
    assert machine.design_states == machine.states
    assert machine.stroke_output == machine.thrust_input == 1
    assert not machine.actuator.tabulated
    hover = machine.at()
    assert column(machine.contacts.contact(hover.x)).max() == 0
    assert column(machine.f(hover.x, hover.u, machine.load(hover.x))) == pytest.approx(
        np.zeros(12), abs=1e-12
    )
    np.testing.assert_allclose(trim(machine).u, hover.u, rtol=0, atol=1e-9)


def test_the_state_counts_height_from_the_working_height(par: planar.Parameters, machine: Plant) -> None:
    """z = 0 is an air gap of 1 mm: the forces there are those of K(p) at p = (0, 0, h)."""
    i = np.linspace(-3, 3, 16)
    for z in (-par.h, 0.0, 1e-3):
        x = np.array([6e-3, 4e-3, z, *np.zeros(9)])
        K = commutation.wrench_matrix(par, coils.simulation_model(par), x[:3] + np.array([0, 0, par.h]))
        np.testing.assert_allclose(column(machine.actuator.forces(x, i)), K @ i, rtol=0, atol=1e-11)


def test_the_computation_takes_one_period(par: planar.Parameters, machine: Plant) -> None:
    assert machine.actuator.dead_time == pytest.approx(1.5 * par.T_s, rel=1e-12)
    assert machine.actuator.delay(par.T_s) == 1


# --- Commutation ---


@settings(deadline=None, max_examples=50)
@given(
    p=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-1e-3, 4e-3)),
    W=st.lists(st.floats(-1000, 1000), min_size=6, max_size=6),
)
def test_a_level_mover_gets_what_it_asks_for(
    machine: Plant, p: tuple[float, float, float], W: list[float]
) -> None:
    """forces(x, currents(x, W)) = W within 1e-9 of 1000 N, with the exact coil model."""
    x = np.array([*p, *np.zeros(9)])
    made = column(machine.actuator.forces(x, machine.actuator.currents(x[:6], W)))
    np.testing.assert_allclose(made, W, rtol=0, atol=1e-9)


def test_commutation_ignores_angles(machine: Plant) -> None:
    """As (33): the mover of K(p) is level. Tilted by 1 to 3 mrad it misses 2.6 N and 3.1 N m, of 400 N."""
    i = column(machine.actuator.currents(TILTED[:6], WRENCH))
    np.testing.assert_array_equal(i, column(machine.actuator.currents([*TILTED[:3], 0, 0, 0], WRENCH)))
    missed = np.abs(column(machine.actuator.forces(TILTED, i)) - WRENCH)
    assert missed[:3].max() == pytest.approx(2.64, abs=0.01)
    assert missed[3:].max() == pytest.approx(3.08, abs=0.01)


def stiffness(machine: Plant, believed: Plant, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(H, S) at the hover: d forces(x, currents(y, v)) / dy at y = x, and d forces(x, i) / dx; N/m ... N m/rad."""
    kind = ca.MX if believed.actuator.tabulated else ca.SX
    x_, y = kind.sym("x", 12), kind.sym("y", 6)
    v = machine.preload(x)
    made = machine.actuator.forces(x_, believed.actuator.currents(y, v))
    slopes = ca.Function("slopes", [x_, y], [ca.jacobian(made, y), ca.jacobian(made, x_)[:, :6]])
    H, S = (np.array(value) for value in slopes(x, x[:6]))
    return H, S


def test_commutation_that_follows_leaves_no_stiffness(machine: Plant) -> None:
    """H = -d forces / d(x, y, z) at held currents, to 2e-11 of 35 N/mm; a held current is a spring, up to -35 N/mm."""
    H, S = stiffness(machine, machine, AT)
    size = np.abs(S).max()
    assert np.abs(H[:, :3] + S[:, :3]).max() < 2e-11 * size
    assert np.linalg.eigvalsh(-S[:3, :3])[-1] > 3e4
    assert abs(np.trace(S[:3, :3])) < 1e-9 * size  # Earnshaw
    np.testing.assert_array_equal(H[:, 3:], 0)


def test_stiffness_against_tilt_is_left(machine: Plant) -> None:
    """What commutation for a level mover does not cancel: -333, -265 and +340 N m/rad at (6, 4) mm and 1 mm."""
    _, S = stiffness(machine, machine, np.array([6e-3, 4e-3, *np.zeros(10)]))
    assert np.diag(S[3:, 3:]) == pytest.approx([-333.1, -265.5, 339.9], abs=0.1)


# --- Coil models ---


@pytest.mark.slow_for("5-0")
@pytest.mark.parametrize(("order", "cells"), [(1, 0), (2, 0), (5, 0), (16, 0), (16, 35), (1, 10)])
def test_the_named_coil_model_commutates(par: planar.Parameters, order: int, cells: int) -> None:
    """currents() is K(p)^+ W of the coil model that numpy has too; the table's in MX alone."""
    own = replace(par, order=order, cells=cells)
    machine = plant_of(own)
    assert machine.actuator.tabulated == (cells > 0)
    model: coils.CoilModel = coils.Analytical(par) if order == 1 else coils.simulation_model(par, order)
    if cells:
        model = coils.table(par, model, cells)
    y, W = ca.MX.sym("y", 6), ca.MX.sym("W", 6)
    given = ca.Function("given", [y, W], [machine.actuator.currents(y, W)])
    for p in np.random.default_rng(1).uniform([-0.1, -0.1, -1e-3], [0.1, 0.1, 4e-3], (10, 3)):
        expected = commutation.currents(
            commutation.wrench_matrix(par, model, p + np.array([0, 0, par.h])), WRENCH
        )
        np.testing.assert_allclose(column(given([*p, 0, 0, 0], WRENCH)), expected, rtol=0, atol=1e-9)


def test_the_truth_is_not_what_the_controller_believes(par: planar.Parameters, machine: Plant) -> None:
    """`order` and `cells` change currents() and nothing else; the wrong ones miss a hover by 0.18 and 0.10 N."""
    missed = {}
    for name, own in (("analytical", replace(par, order=1)), ("table", replace(par, cells=35))):
        believed = plant_of(own)
        i = np.linspace(-3, 3, 16)
        forces, same = (column(one.actuator.forces(TILTED, i)) for one in (believed, machine))
        np.testing.assert_array_equal(forces, same)
        y, v = ca.MX.sym("y", 6), ca.MX.sym("v", 6)
        carried = ca.Function("i", [y, v], [believed.actuator.currents(y, v)])(AT[:6], machine.at().u)
        error = column(machine.actuator.forces(AT, carried)) - machine.at().u
        missed[name] = float(np.abs(error[:3]).max())
    assert missed == pytest.approx({"analytical": 0.181, "table": 0.102}, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "value", "field"),
    [
        ("order", 1.5, "order"),
        ("order", 17, "order"),
        ("order", 0, "order"),
        ("cells", 2.5, "cells"),
        ("cells", -1, "cells"),
        ("h", 6e-3, "z_max"),
        ("w_m", 0.0, "w_m"),
        ("s_a", math.nan, "s_a"),
    ],
)
def test_no_machine_has_such_a_model(par: planar.Parameters, name: str, value: float, field: str) -> None:
    with pytest.raises(malta.InputError, match=r"planar\.Parameters") as caught:
        replace(par, **{name: value})  # type: ignore[arg-type]
    assert caught.value.field == field


def test_simulated_forces_are_the_truth(par: planar.Parameters) -> None:
    """22 harmonics instead of 144: within 0.2 mN/A of 8.2 N/A at the working height, 0.9 of 9.9 on the magnets."""
    few, whole = coils.simulation_model(par), coils.exact_model(par)
    assert (len(few.m), len(whole.m)) == (22, 144)
    x, y = np.meshgrid(*[np.linspace(0, par.tau_n, 61)] * 2, indexing="ij")
    for z, force, torque in ((0.0, 0.9e-3, 0.07e-3), (par.h, 0.19e-3, 0.02e-3)):
        at = (x, y, np.full_like(x, z))
        error = np.abs(few(*at) - whole(*at)).max(axis=(0, 1))
        assert 0.9 * force < error[:3].max() < force
        assert error[3:].max() < torque


# --- Parameters as symbols ---


@pytest.mark.parametrize("order", [1, 16])
def test_symbols_give_the_numbers(par: planar.Parameters, order: int) -> None:
    """One model in symbols of everything that does not shape it, evaluated at two machines, is their own models."""
    par = replace(par, order=order)
    names = [name for name in units_of(par) if name not in shape_parameters(par)]
    assert {"B_r", "N_c", "coil_pitch", "r_z", "h", "m", "I_x", "g", "I_max"} <= {*names}
    symbols = {name: ca.SX.sym(name) for name in names}
    record = symbolic(par, symbols | {"I_y": symbols["I_x"]})
    general = planar.plant(record)
    x, i, v, w = (ca.SX.sym(name, size) for name, size in (("x", 12), ("i", 16), ("v", 6), ("w", 6)))
    theta = ca.vertcat(*symbols.values())

    def everything(machine: Plant) -> list[Any]:
        return [
            machine.f(x, v, w + machine.load(x)),
            machine.actuator.forces(x, i),
            machine.actuator.currents(x[:6], v),
            machine.actuator.limited(i),
            machine.contacts.contact(x),
            machine.preload(x),
        ]

    evaluated = ca.Function("general", [x, i, v, w, theta], everything(general))
    other = replace(par, B_r=1.2, N_c=210, coil_pitch=95e-3, r_z=8e-3, h=1.2e-3, m=21, g=9.81, I_max=2, C=1.1)
    given = (TILTED, np.linspace(-3, 3, 16), WRENCH, np.linspace(-1, 1, 6))
    for numbers in (par, other):
        own = ca.Function("own", [x, i, v, w], everything(planar.plant(numbers)))(*given)
        found = evaluated(*given, [getattr(numbers, name) for name in names])
        for mine, general_s in zip(own, found, strict=True):
            np.testing.assert_allclose(np.array(general_s), np.array(mine), rtol=1e-11, atol=1e-11)


def test_shaping_parameters_stay_numbers(par: planar.Parameters) -> None:
    """What harmonics, delays and tables are made of; none of them is a factor of the model."""
    shapes = {"tau_n", "w_c", "h_c", "l_c", "r_c", "h_m", "upright", "T_s", "T_d", "order", "cells"}
    assert {*shape_parameters(par)} == shapes
    assert {f.name for f in fields(par)} >= shapes


def test_a_table_does_not_go_with_symbols(par: planar.Parameters) -> None:
    """The truth of such a machine is there, its look-up is refused in a sentence."""
    machine = planar.plant(symbolic(replace(par, cells=35), {"m": ca.SX.sym("m")}))
    assert column(machine.actuator.forces(AT, np.ones(16))).shape == (6,)
    with pytest.raises(malta.CheckError, match="cells has to be 0"):
        machine.actuator.currents(AT[:6], WRENCH)


# --- Limits ---


def test_currents_are_limited_together(par: planar.Parameters, machine: Plant) -> None:
    """Twice the limit becomes the limit, in the same direction, as numpy has it; less is left as it is."""
    i = np.linspace(-1, 1, 16) * 2 * par.I_max
    np.testing.assert_allclose(column(machine.actuator.limited(ca.DM(i))), i / 2, rtol=1e-15)
    np.testing.assert_allclose(commutation.limit_currents(par, i), i / 2, rtol=1e-15)
    np.testing.assert_array_equal(column(machine.actuator.limited(ca.DM(i / 4))), i / 4)


def test_a_pitch_that_cannot_be_inverted_has_no_plant(par: planar.Parameters) -> None:
    with pytest.raises(malta.CheckError, match=r"coil pitch of 0\.0708 m = 4 tau_n, K\(p\) is singular"):
        planar.plant(replace(par, coil_pitch=4 * par.tau_n))


@pytest.mark.parametrize(
    ("x", "shares"),
    [
        ({"z": -1e-3}, (1.0, -0.25, 0.0)),
        ({"z": 4e-3}, (-4.0, 1.0, 0.0)),
        ({"phi": 5e-3}, (1.0, 0.0, 0.0)),
        ({"theta": -2.5e-3, "z": -0.5e-3}, (1.0, -0.125, 0.0)),
        ({"y": -0.1}, (0.0, 0.0, 1.0)),
        ({"x": 0.05, "y": 0.02, "psi": 0.3}, (0.0, 0.0, 0.5)),
    ],
)
def test_contacts(machine: Plant, x: dict[str, float], shares: tuple[float, float, float]) -> None:
    """1 mm of air under a plate of 400 mm: 5 mrad, or 2.5 mrad at half the gap; 4 mm upwards; 100 mm in the plane."""
    found = column(machine.contacts.contact(machine.at(**x).x))
    assert found == pytest.approx(
        shares, abs=2e-4
    )  # the plate's lower face is 6.4 mm off the centre of gravity
    assert len(machine.contacts.names) == len(machine.contacts.cushioned) == 3
    np.testing.assert_array_equal(column(machine.contacts.bearing(machine.at(**x).x)), np.zeros(6))


# --- Size ---


def test_the_models_are_small_enough_to_compile(machine: Plant) -> None:
    """A Runge-Kutta step holds forces() four times: 6000 operations each; currents() takes 3300."""
    x, i, v = ca.SX.sym("x", 12), ca.SX.sym("i", 16), ca.SX.sym("v", 6)
    assert ca.Function("forces", [x, i], [machine.actuator.forces(x, i)]).n_instructions() < 6000
    assert ca.Function("currents", [x, v], [machine.actuator.currents(x[:6], v)]).n_instructions() < 3500
