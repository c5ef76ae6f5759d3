"""A plant in groups: defaults of each group, and the sentence for fields that stand at the machine itself."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import casadi as ca
import pytest
from conftest import Run, one_sentence

import malta
from malta.model import Actuator, Contacts, Plant, Sensors, Signal, Stroke
from malta.model.checks import check_numbers
from malta.model.flat_fields import GROUPS, PLACES

BALL = "examples/ball/design/ball.toml"


@pytest.fixture(scope="module")
def ball() -> Plant:
    return malta.read_design(BALL).plant


@pytest.mark.parametrize("name", PLACES)
def test_a_flat_field_is_refused_with_its_group(ball: Plant, name: str) -> None:
    group, _, field = PLACES[name].format(name).partition(".")
    assert field in {f.name for f in fields(GROUPS[group])}
    expected = (
        rf"ball: {name}: found at the machine itself, expected {group}={GROUPS[group].__name__}\({field}="
    )
    changes: dict[str, Any] = {name: 1.0}
    with pytest.raises(malta.InputError, match=expected):
        replace(ball, **changes)
    given = {f.name: getattr(ball, f.name) for f in fields(ball)} | changes
    with pytest.raises(malta.InputError, match=expected):
        Plant(**given)


@pytest.mark.parametrize("name", sorted(PLACES.keys() - GROUPS.keys()))
def test_a_flat_field_that_is_read_says_where_it_is(ball: Plant, name: str) -> None:
    with pytest.raises(malta.InputError, match=rf"{name}: found a name that has moved, expected plant\."):
        getattr(ball, name)


def test_other_names_are_missing_as_those_of_any_object(ball: Plant) -> None:
    assert not hasattr(ball, "volume")
    with pytest.raises(AttributeError, match="'Plant' object has no attribute 'volume'"):
        ball.volume  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_is_its_record(ball: Plant, group: str) -> None:
    changes: dict[str, Any] = {group: None}
    with pytest.raises(malta.InputError, match=f"{group}=.*{GROUPS[group].__name__}"):
        replace(ball, **changes)


def test_all_flat_fields_of_a_file_are_one_sentence(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, _ = run("new", "sphere")
    assert code == 0
    file = tmp_path / "sphere" / "sphere.py"
    text = file.read_text(encoding="utf-8")
    flat = text.replace("contacts=Contacts((", "contact=abs, contacts=((").replace(
        "Sensors(noise=(par.s_y,))", "None"
    )
    file.write_text(flat, encoding="utf-8")
    code, out, err = run("design", str(tmp_path / "sphere" / "design" / "sphere.toml"))
    assert (code, out) == (2, "")
    one_sentence(err)
    assert "contact, contacts, sensors: found at the machine itself" in err


def test_a_group_that_is_left_out_has_the_defaults_of_the_machine(ball: Plant) -> None:
    bare = Plant(
        "bare", ball.parameters, ball.states, ball.inputs, ball.outputs, ball.f, ball.h,
        Actuator((Signal("i", "A"),), (2.0,), current_limit=3.0), lambda _: bare,
    )  # fmt: skip
    x = ca.DM([1e-3, 0.0])
    assert (bare.sensors.noise, bare.sensors.resolution, bare.sensors.lag) == ((0.0,), (0.0,), (0.0,))
    assert float(bare.sensors.sense(x, ca.DM(0, 1))) == 1e-3
    assert (bare.contacts.names, bare.contacts.contact(x).numel(), bare.has_stroke) == ((), 0, False)
    assert [float(f(x, 1.0)) for f in (bare.actuator.currents, bare.actuator.forces)] == [0.5, 2.0]
    assert float(bare.actuator.limited(ca.DM(9.0))) == 3.0


def test_functions_that_follow_from_numbers_follow_changed_ones() -> None:
    coil = Actuator((Signal("i", "A"),), (2.0,), current_limit=3.0)
    other = replace(coil, force_constant=(4.0,), current_limit=1.0)
    assert float(other.forces(0, 1.0)) == 4.0
    assert float(other.limited(ca.DM(9.0))) == 1.0
    own = replace(coil, forces=lambda _, i: 5 * i)
    assert replace(own, force_constant=(4.0,)).forces(0, 1.0) == 5.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"sensors": Sensors(noise=(1e-6, 1e-6))}, "sensors.noise: found 2 entries, expected 1"),
        ({"sensors": Sensors(resolution=(0.0, 1.0))}, "sensors.resolution: found 2 entries"),
        ({"sensors": Sensors(lag=(1e-3, 1e-3))}, "sensors.lag: found 2 entries"),
        ({"contacts": Contacts(("a", "b"), lambda x: x[0])}, "contacts.contact: found 1 entries, expected 2"),
        ({"stroke": Stroke("z", thrust="f")}, "stroke.name: found 'z'"),
    ],
)
def test_a_group_that_does_not_fit_is_named(ball: Plant, changes: dict[str, Any], says: str) -> None:

    with pytest.raises(malta.InputError, match=says):
        check_numbers(replace(ball, **changes))


def test_the_old_name_of_the_sensors_answers_for_one_version() -> None:
    with pytest.warns(DeprecationWarning, match=r"malta.model.LateSensors goes: write malta.model.Sensors"):
        late = malta.model.LateSensors((1e-3,), dead_time=1e-4)
    assert (late.lag, late.dead_time, late.late) == ((1e-3,), 1e-4, True)
