"""The records of a machine: immutable, named in every refusal, and held only where something can hold it."""

from __future__ import annotations

import math
import re
from dataclasses import FrozenInstanceError, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import malta
from malta.machines.tubular import plant as tubular
from malta.model.checks import check_signals
from malta.model.equilibrium import load_balance
from malta.model.plant import OperatingPoint

if TYPE_CHECKING:
    from malta.model.plant import Plant


def test_records_are_frozen(par: tubular.Parameters, plant: Plant) -> None:
    """No field of a parameter record, a plant, its actuator or an operating point can be set."""
    records: list[tuple[Any, str]] = [
        (par, "m"),
        (plant, "mass"),
        (plant.actuator, "R"),
        (plant.at(z=0.0), "x"),
    ]
    for record, name in records:
        with pytest.raises(FrozenInstanceError):
            setattr(record, name, 1.0)


def test_an_operating_point_is_a_private_read_only_copy(plant: Plant) -> None:
    """Neither the point's arrays nor those it was made from change it afterwards."""
    x, u = np.zeros(12), np.zeros(5)
    point = OperatingPoint(x, u, loaded=False)
    x[2], u[4] = 1.0, 1.0
    assert point.x[2] == 0
    assert point.u[4] == 0
    for array in (point.x, point.u, malta.trim(plant, z=0.0).u):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_signals_are_twelve_five_five_and_six(plant: Plant) -> None:
    """Positions, then rates in the same order; units follow; the design has everything but gamma."""
    names = [s.name for s in plant.states]
    assert names[:6] == ["x", "y", "z", "alpha", "beta", "gamma"]
    assert names[6:] == [f"{name}_dot" for name in names[:6]]
    assert [s.unit for s in plant.states] == ["m"] * 3 + ["rad"] * 3 + ["m/s"] * 3 + ["rad/s"] * 3
    assert [s.name for s in plant.design_states] == [n for n in names if not n.startswith("gamma")]
    assert plant.controlled == (0, 1, 2, 3, 4, 6, 7, 8, 9, 10)
    assert (len(plant.inputs), len(plant.outputs), len(plant.disturbances)) == (5, 5, 6)
    assert len(plant.sensors.noise) == len(plant.sensors.resolution) == len(plant.outputs)
    assert plant.stroke.thrust in {s.name for s in plant.inputs}
    assert plant.stroke.name in {s.name for s in plant.outputs}


def test_at_sets_the_named_states_and_no_other(plant: Plant) -> None:
    """`at` leaves out the loads and has no preload."""
    point = plant.at(z=5e-3, beta_dot=2.0)
    assert point.x.tolist() == [0, 0, 5e-3, 0, 0, 0, 0, 0, 0, 0, 2.0, 0]
    assert point.u.tolist() == [0, 0, 0, 0, 0]
    assert not point.loaded
    assert malta.trim(plant, z=5e-3).loaded


@settings(deadline=None)
@given(
    name=st.sampled_from([s.name for s in tubular.POSITIONS + tubular.RATES]),
    value=st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_a_state_is_finite(plant: Plant, name: str, value: float) -> None:
    """NaN or infinity is refused with the state's name, by `at` and by `trim`."""
    for make in (plant.at, lambda **states: malta.trim(plant, **states)):
        with pytest.raises(malta.InputError, match="finite") as caught:
            make(**{name: value})
        assert (caught.value.where, caught.value.field) == ("tubular", name)


@settings(deadline=None)
@given(
    name=st.text().filter(
        lambda n: n not in {s.name for s in tubular.POSITIONS + tubular.RATES} | {"self", "plant"}
    )
)
def test_an_unknown_state_is_refused_and_the_known_ones_are_listed(plant: Plant, name: str) -> None:
    """A misspelt state is never a zero."""
    for make in (plant.at, lambda **states: malta.trim(plant, **states)):
        with pytest.raises(malta.InputError, match="x y z alpha beta gamma x_dot") as caught:
            make(**{name: 1e-3})
        assert caught.value.field == name


@pytest.mark.parametrize(
    "states",
    [{"z_dot": 0.1}, {"x_dot": -1e-6}, {"alpha_dot": 1.0}, {"gamma_dot": 5.0}, {"x": 1e-4, "beta_dot": 1e-3}],
)
def test_a_moving_mover_is_not_held(plant: Plant, states: dict[str, float]) -> None:
    """No force makes a rate vanish: trim says so instead of returning its best attempt."""
    with pytest.raises(malta.CheckError, match="no input holds"):
        malta.trim(plant, **states)


@pytest.mark.parametrize(
    "states",
    [
        {},
        {"z": 15e-3},
        {"x": 1e-4},
        {"y": -6e-4, "z": -15e-3},
        {"alpha": 6e-3, "beta": -6e-3, "z": 5e-3},
        {"gamma": 1.0},
    ],
)
def test_every_pose_in_the_gap_is_held(plant: Plant, states: dict[str, float]) -> None:
    """Five inputs hold five degrees of freedom; about its own axis nothing turns the mover."""
    point = malta.trim(plant, **states)
    left = np.array(plant.f(point.x, point.u, plant.load(point.x))).ravel()
    assert abs(left).max() < 1e-9  # m/s2, rad/s2


def test_load_balance_is_the_trim_along_the_stroke(plant: Plant) -> None:
    """A row for each state: the machine itself pulls nowhere along its axis."""
    stroke = np.linspace(-15e-3, 15e-3, 7)
    rows = load_balance(plant, np.array([plant.at(z=z).x for z in stroke]))
    assert rows.shape == (7, 5)
    for z, row in zip(stroke, rows, strict=True):
        np.testing.assert_array_equal(row, malta.trim(plant, z=z).u)
    with pytest.raises(malta.InputError, match="finite"):
        plant.at(z=math.nan)


def test_load_balance_leaves_the_machines_own_pull_to_the_controller(plant: Plant) -> None:
    """1 mm off the axis the trim holds against 2 K_A x, the balance of the loads does not."""
    x = plant.at(x=1e-3).x
    (balance,), pull = load_balance(plant, x[None, :]), malta.trim(plant, x=1e-3).u
    K_A: float = plant.parameters.K_A  # type: ignore[attr-defined]
    assert balance[0] + balance[2] == pytest.approx(0.0, abs=1e-9)
    assert pull[0] + pull[2] == pytest.approx(-2 * K_A * 1e-3, rel=1e-9)


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("sensors.range", 5, "found 5, expected a tuple, a number for each of the outputs"),
        ("sensors.noise", 1e-3, "found 0.001, expected a tuple, a number for each of the outputs"),
        ("sensors.lag", 1e-4, "found 0.0001, expected a tuple, a number for each of the outputs"),
        ("sensors.dead_time", (1e-4,), "found (0.0001,), expected one number, s"),
        (
            "inputs",
            malta.model.Signal("u", "V"),
            "found Signal(name='u', unit='V'), expected Signals in a tuple",
        ),
        ("outputs", ("y",), "found ('y',), expected Signals in a tuple"),
    ],
)
def test_one_where_there_are_several_is_refused_by_name(field: str, value: Any, expected: str) -> None:
    plant = malta.linear_machine([[0, 1], [4, 0]], [[0], [1]], [[1, 0]])
    group, _, name = field.rpartition(".")
    changed = replace(getattr(plant, group), **{name: value}) if group else value
    with pytest.raises(malta.InputError, match=re.escape(f"{field}: {expected}")):
        check_signals(replace(plant, **{group or name: changed}))
