"""Results as tables of pandas: the numbers of the records, and a sentence where pandas is not installed."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta

BALL = ROOT / "examples" / "ball" / "design" / "ball.toml"


def frame(columns: dict[str, list[Any]], index: Any) -> Any:
    """What a DataFrame is made from."""
    return SimpleNamespace(columns=columns, index=index)


@pytest.fixture(autouse=True)
def _pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for pandas, which malta does without."""
    index = lambda values, name: SimpleNamespace(values=values, name=name)  # noqa: E731
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=frame, Index=index))


@pytest.fixture(scope="module")
def law() -> malta.synthesis.Controller:
    spec = malta.read_design(BALL)
    return malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def test_a_run_is_a_row_for_each_sample(law: malta.synthesis.Controller) -> None:
    plant = malta.plant_of(law.parameters)
    run = malta.simulate(plant, law, malta.Scenario("hold", 0.01, malta.references.hold, fidelity="force"))
    found = run.to_pandas()
    assert found.index.name == "t [s]"
    assert np.array_equal(found.index.values, run.t)
    assert np.array_equal(found.columns["p y [m]"], run.p[:, 0])
    assert len(found.columns) == sum(len(signals) for signals in run.columns.values())
    assert {len(column) for column in found.columns.values()} == {len(run.t)}


def test_a_campaign_is_a_row_for_each_machine(law: malta.synthesis.Controller) -> None:
    plan = malta.campaigns.Plan(law, "hold", {"m": 0.1}, samples=3, options={"duration": 0.01})
    campaign = malta.campaign(plan, workers=1)
    found = campaign.to_pandas()
    assert list(found.index.values) == [0, 1, 2]
    assert np.array_equal(found.columns["m"], campaign.values[:, 0])
    assert found.columns["verdict"] == ["completed"] * 3
    (rms,) = (name for name in found.columns if name.startswith("rms"))
    assert np.array_equal(found.columns[rms], campaign.batch.rms[:, 0])


def test_a_report_and_curves_are_tables_of_their_figures(law: malta.synthesis.Controller) -> None:
    report = malta.verify(malta.plant_of(law.parameters), law, proof=False)
    found = report.to_pandas()
    assert found.columns["value"] == [one.value for one in report.figures]
    curves = malta.loops.loop_curves(report.loop)
    table = curves.to_pandas()
    one = np.ones(len(curves.w))
    assert np.allclose(np.add(table.columns["S y y"], table.columns["T y y"]), one)
    assert np.array_equal(table.index.values, curves.w)


def test_without_pandas_it_is_a_sentence(
    law: malta.synthesis.Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(
        malta.InputError, match="to_pandas: pandas: found not installed, expected pip install"
    ):
        malta.verify(malta.plant_of(law.parameters), law, proof=False).to_pandas()
