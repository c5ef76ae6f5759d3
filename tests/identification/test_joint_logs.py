"""Several logs of one machine, identified together: noise counts less, offsets are free, mixtures are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run

import malta
from malta.identification import Log, write_log
from malta.identification.data_file import read_identified

pytestmark = pytest.mark.slow

ROBUST = "design/gains/robust.json"
CONTROLLER = malta.gains.read(ROBUST)
ASKED = ["K_A", "K_B", "I_xx"]
TRUE = {"K_A": 9000.0, "K_B": 5.0}


def flown(seed: int, **values: float) -> Log:
    """A log of its own noise under an excitation of other phases."""
    plant = malta.plant_of(CONTROLLER.parameters)
    plan = malta.excite(malta.loop(plant, CONTROLLER), period=0.5, periods=4, band=(4.0, 400.0))
    par: Any = CONTROLLER.parameters
    machine = malta.plant_of(replace(par, **(TRUE | values)))
    run = malta.simulate(machine, CONTROLLER, malta.Scenario.excited(plan.signal, plan.duration, seed=seed))
    return replace(malta.identification.log_of(run), source=f"log{seed}")


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    return [flown(seed) for seed in (1, 2)]


def identify(*logs: Log) -> malta.identification.Identified:
    return malta.identify(CONTROLLER, logs, parameters=ASKED, in_time=False)


def test_two_logs_of_their_own_noise_halve_its_variance(logs: list[Log]) -> None:
    alone, both = [identify(one) for one in logs], identify(*logs)
    assert both.refusal == ""
    assert both.log.source == "log1, log2"
    mean = np.sqrt(np.mean([one.half_widths**2 for one in alone], axis=0))
    # chi2 of each scales its intervals by up to 15 %.
    assert both.half_widths * np.sqrt(2) == pytest.approx(mean, rel=0.2)
    assert (both.total <= 1.05 * np.min([one.total for one in alone], axis=0)).all()
    low, high = np.sort([one.values for one in alone], axis=0)
    assert ((low - both.half_widths < both.values) & (both.values < high + both.half_widths)).all()
    off = np.abs(both.values[:2] - list(TRUE.values()))
    assert (off < 2 * both.half_widths[:2]).all()
    assert both.in_time is None
    assert both.dof == 2 * alone[0].dof + len(ASKED)


def test_offsets_of_each_log_are_free(logs: list[Log]) -> None:
    moved = replace(logs[1], columns={**logs[1].columns, "y": logs[1].columns["y"] + 5e-6})
    assert identify(logs[0], moved).values == pytest.approx(identify(*logs).values, rel=1e-3)


def test_logs_that_do_not_fit_together_are_refused(logs: list[Log]) -> None:
    other = flown(3, K_A=8600.0)
    with pytest.raises(
        malta.CheckError, match=r"log1 and log3 do not fit together: K_A is [89]\d\d\d\S* by one"
    ):
        identify(logs[0], other)
    faster = replace(logs[1], sample_time=25e-6, t=logs[1].t / 2, period=0.25)
    with pytest.raises(malta.CheckError, match="log2: "):
        identify(logs[0], faster)
    with pytest.raises(malta.InputError, match="one log"):
        malta.identify(CONTROLLER, logs, robust=True)
    with pytest.raises(malta.InputError, match="at least one log"):
        malta.identify(CONTROLLER, [])


def test_the_command_takes_several_logs(logs: list[Log], tmp_path: Path, run: Run) -> None:
    paths = [write_log(one, tmp_path / f"{one.source}.npz") for one in logs]
    data = tmp_path / "found.toml"
    said = run("identify", ROBUST, *paths, "-p", "K_A", "-p", "K_B", "-p", "I_xx", "-o", data)
    assert said.code == 0, said.err
    assert "log1.npz," in said.out
    assert "log2.npz" in data.read_text()
    assert read_identified(data).unmodelled is not None
    for option in (("--robust",), ("--record", "all"), ("--drive",)):
        said = run("identify", ROBUST, *paths, *option)
        assert said.code == 2
        assert said.err.count("\n") <= 2
        assert "found 2 logs, expected one log" in said.err
