"""Columns that are not what they are called are refused by name, and what no sensor reads is seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import malta
from malta.identification import Log, log_of, read_log, write_log
from malta.identification.log import require_currents
from malta.identification.signal_checks import (
    driven_currents,
    findings_of_machine,
    machine_findings,
    require_signals,
    signal_fits,
)
from malta.identification.spectra import readings

CONTROLLER = malta.gains.read("design/gains/robust.json")
PLANT = malta.plant_of(CONTROLLER.parameters)
ASKED = ["K_A", "K_B"]
DRIVEN = ("i_0q1", "i_dd1", "i_qd1", "i_0q2", "i_dd2", "i_qd2")


def flown(**values: float) -> Log:
    """An excited flight of a machine that differs so from the gain file's."""
    plan = malta.excite(malta.loop(PLANT, CONTROLLER), period=0.25, periods=3, band=(8.0, 400.0), lines=8)
    par: Any = CONTROLLER.parameters
    true = PLANT.variant(replace(par, **values))
    return log_of(malta.simulate(true, CONTROLLER, malta.Scenario.excited(plan.signal, plan.duration)))


@pytest.fixture(scope="module")
def log() -> Log:
    return flown()


def changed(log: Log, group: str, change: Any) -> Log:
    table = np.array(log.columns[group])
    change(table, log.names(group))
    return replace(log, columns={**log.columns, group: table})


def swapped(one: str, other: str) -> Any:
    def swap(table: Any, names: list[str]) -> None:
        places = [names.index(one), names.index(other)]
        table[:, places] = table[:, places[::-1]]

    return swap


def scaled(factor: float, *names: str) -> Any:
    def scale(table: Any, known: list[str]) -> None:
        table[:, [known.index(name) for name in names or known]] *= factor

    return scale


@pytest.mark.slow
def test_signals_of_another_machine_are_their_own() -> None:
    log = flown(K_A=9500.0, K_B=6.2, K_D=4.4)
    for one in signal_fits(CONTROLLER, PLANT, log).values():
        assert np.diag(one.fit).min() > 0.97
        assert np.abs(one.size - 1).max() < 0.4
    require_signals(CONTROLLER, PLANT, log)


@pytest.mark.parametrize(
    ("group", "change", "found"),
    [
        ("y", swapped("x1", "y1"), "x1: found what y1 does under this excitation .*are x1 and y1 swapped"),
        ("y", swapped("x1", "x2"), "are x1 and x2 swapped"),
        ("i", swapped("i_dd1", "i_qd1"), "are i_dd1 and i_qd1 swapped"),
        ("v", swapped("fx_B1", "f_D"), "are fx_B1 and f_D swapped"),
        ("i", scaled(1e3), "i_0q1: found values 1000 times those of this excitation"),
        ("i", scaled(1e-3, "i_qd2"), "i_qd2: found values 1/1000 of those"),
        ("y", scaled(1e6, "z"), "z: found values a million times those"),
        ("y", scaled(-1.0, "y2"), "y2: found the other sign"),
        ("i", scaled(0.5**0.5), "are they rms values"),
    ],
)
def test_columns_that_are_no_such_signals_are_refused_by_name(
    log: Log, group: str, change: Any, found: str
) -> None:
    require_signals(CONTROLLER, PLANT, log)
    with pytest.raises(malta.InputError, match=found):
        require_signals(CONTROLLER, PLANT, changed(log, group, change))


def test_identify_asks_for_its_columns_first(log: Log) -> None:
    with pytest.raises(malta.InputError, match="values 1000 times those"):
        malta.identify(CONTROLLER, changed(log, "i", scaled(1e3)), parameters=ASKED)


def test_a_missing_current_is_refused_and_an_idle_one_is_not(log: Log, tmp_path: Path) -> None:
    assert driven_currents(PLANT) == DRIVEN
    quiet = changed(log, "i", scaled(0.0, "i_0q1", "i_qq2"))
    for suffix in (".csv", ".npz", ".mat"):
        found = read_log(write_log(quiet, tmp_path / f"log{suffix}"))
        assert "i_0q1" not in found.names("i")
        assert {"i_0q1", "i_qq2"} <= set(found.idle)
        require_currents(found, [s.name for s in PLANT.drive.axes], DRIVEN)
    lost = replace(found, idle=())
    with pytest.raises(
        malta.InputError, match=r"i_0q1: found no such column of i, expected i_0q1 \[A\]: the law"
    ):
        malta.identify(CONTROLLER, lost, parameters=ASKED)


def test_readings_that_no_sensor_gives_are_seen(log: Log) -> None:
    def spoil(table: Any, names: list[str]) -> None:
        table[7000, names.index("y1")] = 127.0

    assert changed(log, "y", spoil).survey.impossible["y1"].startswith("127 m, others within")
    found = machine_findings(changed(log, "y", spoil), PLANT)
    assert [words.split(",")[0] for words in found] == ["y1 reads 127 m"]
    assert "times the clearance" in found[0]
    assert machine_findings(log, PLANT) == log.survey.findings == ()

    def freeze(table: Any, names: list[str]) -> None:
        table[3000:9000, names.index("i_qd1")] = table[3000, names.index("i_qd1")]

    frozen = changed(log, "i", freeze)
    assert frozen.survey.stuck == {"i_qd1": 6000}
    with pytest.raises(malta.CheckError, match="sensor i_qd1 is stuck in 6000 of"):
        malta.identify(CONTROLLER, frozen, parameters=ASKED)

    def double(table: Any, _: list[str]) -> None:
        table[1::2] = table[: 2 * (len(table) // 2) : 2]

    doubled = changed(log, "i", double)
    assert set(DRIVEN) <= set(doubled.survey.repeated)
    assert set(doubled.survey.repeated.values()) == {2}
    with pytest.raises(malta.CheckError, match="has each reading 2 times"):
        malta.identify(CONTROLLER, doubled, parameters=ASKED)
    milli = findings_of_machine(CONTROLLER, changed(log, "i", scaled(1e3)))
    assert any("in another unit?" in words for words in milli)
    assert milli[-1].startswith("i_0q1: found values 1000 times those")
    assert findings_of_machine(CONTROLLER, log) == []


def test_missing_cells_are_counted_by_signal(log: Log) -> None:
    random = np.random.default_rng(1)

    def lose(share: float) -> Log:
        def lost(table: Any, _: list[str]) -> None:
            table[random.random(table.shape) < share] = np.nan

        return changed(log, "y", lost)

    assert np.isnan(readings(lose(0.15), robust=False)).mean() == pytest.approx(0.15, abs=0.01)
    with pytest.raises(
        malta.CheckError, match=r"2[45]\.?\d* % of the readings of \w+ are missing, at most 20 %"
    ):
        readings(lose(0.25), robust=False)
