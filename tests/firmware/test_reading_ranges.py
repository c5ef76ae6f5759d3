"""Ranges of readings: of contacts, or declared with the sensors; without one an export asks for it."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence
from exported import require

import malta
from malta.firmware.flight import differences, engine_of_c
from malta.firmware.signals import UNLIMITED_RANGE, reading_ranges
from malta.model import Contacts, Plant, Signal
from malta.model.checks import check_signals

pytestmark = pytest.mark.usefixtures("proven_once")

MAGNET = ROOT / "examples" / "magnet"
HELD = 5e-3 * np.sqrt(0.1 * 9.81 / 2e-5)  # A, of the magnet's current that holds the sphere


def magnet(ranges: tuple[Any, ...]) -> Plant:
    """The magnet whose current is measured, with sensors of these ranges."""
    plant = malta.read_design(MAGNET / "design" / "with_current.toml").plant
    return replace(plant, sensors=replace(plant.sensors, range=ranges))


def test_a_range_is_declared_with_the_sensors() -> None:
    """That of the position by default is twice the clearance of 2 mm, in the steps of a twentieth of a decade."""
    plant = magnet((0.0, 7.0))
    assert reading_ranges(plant).tolist() == pytest.approx([2 * 10 ** (-7 + 87 / 20), 7.0], rel=1e-12)
    assert reading_ranges(magnet((1e-3, 7.0)))[0] == 1e-3
    shipped = malta.read_design(MAGNET / "design" / "with_current.toml").plant
    assert reading_ranges(shipped)[1] == pytest.approx(12 / 2 + HELD)


@pytest.mark.parametrize("unit", ["A", "V", "m/s^2", "m"])
def test_without_one_the_export_asks_for_it(unit: str) -> None:
    plant = magnet((0.0, 0.0))
    plant = replace(plant, outputs=(plant.outputs[0], Signal("i_y", unit)))
    said = rf"none for i_y, which meets no contact, expected its largest reading either way, {re.escape(unit)}, as"
    with pytest.raises(malta.InputError, match=said):
        reading_ranges(plant)


def test_contacts_are_looked_for_beyond_one_of_the_unit() -> None:
    """A position in volts, 25 kV a metre, whose clearance of 2 mm is 50 V; and a contact on one side."""
    plant = magnet((0.0, 7.0))
    volts = replace(plant, position_of=lambda y: ca.vertcat(y[0] / 25e3, 0, 0))
    assert 100 <= reading_ranges(volts)[0] < 100 * 10**0.05
    below = replace(plant, contacts=Contacts(("floor",), lambda x: -x[0] / 2e-3))
    with pytest.raises(malta.InputError, match="none for y, which meets no contact"):
        reading_ranges(below)


def test_positions_of_a_machine_without_contacts_are_unlimited() -> None:
    turning = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], outputs=["phi [rad]"])
    assert reading_ranges(turning).tolist() == [UNLIMITED_RANGE]
    volts = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], outputs=["phi [V]"])
    with pytest.raises(malta.InputError, match="none for phi"):
        reading_ranges(volts)
    known = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], outputs=["phi [V]"], range=10)
    assert reading_ranges(known).tolist() == [10.0]


@pytest.mark.parametrize(
    ("ranges", "found"),
    [
        ((1.0,), "1 entries"),
        ((0.0, -1.0), "-1.0"),
        ((0.0, None), "None"),
        ((0.0, (3.0, -3.0)), r"\(3.0, -3.0\)"),
        ((0.0, np.nan), "nan"),
        ((1e-9, 7.0), "1 nm, which its noise of "),
    ],
)
def test_a_range_that_is_no_size_is_refused(ranges: tuple[Any, ...], found: str) -> None:
    with pytest.raises(malta.InputError, match=rf"sensors\.range.*found {found}"):
        check_signals(magnet(ranges))


def test_the_range_of_matrices_is_in_their_gain_file(tmp_path: Path) -> None:
    plant = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], outputs=["z [V]"], range=5)
    model = malta.linearize(plant, plant.at())
    law = malta.lqg(model, malta.synthesis.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8]), Ts=1e-3)
    malta.gains.write(law, malta.verify(model, law), tmp_path / "law.json")
    assert malta.gains.read(tmp_path / "law.json").parameters == plant.parameters


@pytest.mark.parametrize("size", [0.65, 0.7])
def test_exported_c_holds_what_the_simulation_holds(size: float) -> None:
    """Currents above 1 A are readings, too: under these loads the sphere is held, by both."""
    require("gcc")
    spec = malta.read_design(MAGNET / "design" / "with_current.toml")
    plant, law = spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    load = malta.Scenario(
        "hold",
        0.25,
        malta.references.hold,
        disturbance=lambda t: size * (t > 0.02)[:, None],
        fidelity="force",
    )
    own, flown = malta.simulate(plant, law, load), malta.simulate(plant, law, load, engine=engine_of_c())
    assert np.abs(own.y[:, 1]).max() > 1
    assert len(own.t) == len(flown.t)
    assert max(d.share for d in differences(own, flown)) < 1e-12


def test_the_command_asks_in_one_sentence(run: Run, tmp_path: Path) -> None:
    """Exit code 2, and no folder."""
    shutil.copytree(MAGNET, tmp_path / "magnet")
    module = tmp_path / "magnet" / "magnet.py"
    declared = "range=(0, par.U_max / par.R + held)[: len(outputs)]"
    text = module.read_text(encoding="utf-8")
    assert declared in text
    module.write_text(text.replace(declared, "range=()"), encoding="utf-8")
    spec = malta.read_design(tmp_path / "magnet" / "design" / "with_current.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    law = malta.synthesize(spec, model)
    malta.gains.write(law, malta.verify(model, law), tmp_path / "law.json")
    done = run("export", tmp_path / "law.json", "--machine", module, "--out", tmp_path / "c")
    assert done.code == 2
    assert "sensors.range: found none for i_y" in one_sentence(done.err)
    assert not (tmp_path / "c").exists()
