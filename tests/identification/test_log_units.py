"""Logs of signals of any unit: what is written is read, in every encoding, whatever the unit of an output is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.identification import log_of, read_log, write_log
from malta.identification.log import Log

UNITS = ("m/s", "m/s^2", "V", "A", "N", "T", "1", "rad/s")


def log_in(unit: str) -> Log:
    """Of a machine whose second output, and command, have a unit of their own."""
    outputs, inputs = ["x [m]", f"r [{unit}]"], [f"c [{unit}]"]
    plant = malta.linear_machine(
        [[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 1]], outputs=outputs, inputs=inputs, noise=1e-3
    )
    weights = malta.synthesis.weights(q=[1, 1], r=[1], w=[1], v=[1e-6, 1e-6])
    law = malta.lqg(malta.linearize(plant, plant.at()), weights, Ts=1e-3)
    hold = malta.Scenario("hold", 20e-3, malta.references.hold, fidelity="force", noise=1.0)
    return log_of(malta.simulate(plant, law, hold))


def equal(one: Log, two: Log) -> bool:
    """Whether two logs have the same signals in the same groups."""
    groups = [name for name in one.signals if one.names(name)]
    assert {name: one.signals[name] for name in groups} == {name: two.signals[name] for name in groups}
    return all(np.allclose(one.columns[name], two.columns[name], rtol=1e-8, atol=1e-12) for name in groups)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mat"])
@pytest.mark.parametrize("unit", UNITS)
def test_what_is_written_is_read(unit: str, suffix: str, tmp_path: Path) -> None:
    log = log_in(unit)
    assert equal(log, read_log(write_log(log, tmp_path / f"log{suffix}")))


def test_a_measured_current_and_a_commanded_voltage_keep_their_groups(tmp_path: Path) -> None:
    spec = malta.read_design(ROOT / "examples" / "magnet" / "design" / "with_current.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    hold = malta.Scenario("hold", 20e-3, malta.references.hold, fidelity="force", noise=1.0)
    log = log_of(malta.simulate(spec.plant, law, hold))
    file = write_log(log, tmp_path / "log.csv")
    assert "t [s],y [m],y.i_y [A],v.u [V],i.u [V]," in file.read_text(encoding="utf-8")
    assert equal(log, read_log(file))


def test_units_of_others_are_converted(tmp_path: Path) -> None:
    file = tmp_path / "other.csv"
    file.write_text("t [ms],x [um],y.a [mm/s^2]\n0,1,1000\n1,2,2000\n", encoding="utf-8")
    found = read_log(file)
    assert [tuple(s) for s in found.signals["y"]] == [("x", "m"), ("a", "m/s^2")]
    assert found.columns["y"].tolist() == [[1e-6, 1.0], [2e-6, 2.0]]
    file.write_text("t [ms],x [um],y.a [quarks]\n0,1,1\n1,2,2\n", encoding="utf-8")
    with pytest.raises(malta.InputError, match=r"a \[quarks\].*found unit 'quarks', expected"):
        read_log(file)
