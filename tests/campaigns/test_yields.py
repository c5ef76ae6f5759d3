"""Yields of machines that differ: within the paper's bounds, and within what the design itself is asked for."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import Run

import malta
from malta import gains
from malta.campaigns.plan import Plan
from malta.campaigns.result import runs_within_specification, specified_bounds, yields_of
from malta.campaigns.run import campaign, main_campaign
from malta.machines.tubular.experiments.strokes import SETTLE

if TYPE_CHECKING:
    from pathlib import Path

    from malta.campaigns.result import Campaign
    from malta.synthesis.spec import Spec

BOX = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2)
LOADS = "design/gains/robust.json"


@pytest.fixture(scope="module")
def spec() -> Spec:
    return malta.read_design("design/robust.toml")


@pytest.fixture(scope="module")
def flown() -> Campaign:
    return campaign(Plan(gains.read(LOADS), "stroke", BOX, samples=256, options={"settle": SETTLE}))


def test_bounds_of_a_design_are_those_of_its_file(flown: Campaign, spec: Spec) -> None:
    bounds = specified_bounds(flown.plan, spec)
    assert bounds == {
        key: spec.specification[n] for key, n in (("stroke", "tracking_error"), ("m", "radial_deviation"))
    }
    assert 0 < bounds["m"] < bounds["stroke"] < 1e-3
    longer = Plan(gains.read(LOADS), "stroke", BOX, samples=1, options={"distance": 5e-3})
    assert specified_bounds(longer, spec) == {}  # of the published stroke alone
    assert specified_bounds(flown.plan, malta.read_design("design/table2.toml")) == {}


def test_runs_within_the_specification_by_hand(flown: Campaign, spec: Spec) -> None:
    deviation = flown.batch.deviation
    by_hand = (
        flown.completed
        & (deviation[:, 4] <= spec.specification["tracking_error"])
        & (deviation[:, :4].max(axis=1) <= spec.specification["radial_deviation"])
    )
    within = runs_within_specification(flown, spec)
    assert within is not None
    np.testing.assert_array_equal(within, by_hand)
    assert 0 < by_hand.sum() < len(by_hand)
    assert runs_within_specification(flown, None) is None


def test_yields(flown: Campaign, spec: Spec, published: dict[str, Any]) -> None:
    found = yields_of(flown, published, spec)
    assert found.published is not None
    assert found.specified is not None
    assert found.completed.runs == found.published.runs == found.specified.runs == 256
    assert found.completed.passed >= found.published.passed >= found.specified.passed
    assert found.published.low < found.published.share < found.published.high
    assert yields_of(flown)[1:] == (None, None)


@pytest.mark.slow
def test_yields_of_the_main_job_are_drawn_from_the_designs_uncertainty(
    spec: Spec, published: dict[str, Any], flown: Campaign
) -> None:
    shares: list[float] = []
    found = yields_of(
        main_campaign(flown.plan.controller, spec, 256, progress=shares.append), published, spec
    )
    assert found == yields_of(flown, published, spec)
    assert shares[-1] == pytest.approx(1)


@pytest.mark.slow
def test_fewer_machines_of_table2_than_of_calibrated_fly_as_published(published: dict[str, Any]) -> None:
    """Ten times 1 % are 10 %; the intervals are far apart."""
    controllers = [gains.read(f"design/gains/{name}.json") for name in ("table2", "calibrated")]
    specs = [malta.read_design(f"design/{name}.toml") for name in ("table2", "calibrated")]
    first, second = (
        yields_of(main_campaign(controller, spec, 512), published, spec)
        for controller, spec in zip(controllers, specs, strict=True)
    )
    assert first.published is not None
    assert second.published is not None
    assert first.published.high < 0.05 < 0.1 < second.published.low
    assert first.completed.share < 0.8 < second.completed.share == 1


@pytest.mark.slow
def test_a_campaign_shows_all_yields(run: Run, tmp_path: Path) -> None:
    common = ("campaign", LOADS, "--samples", "64", "--spread", "20%", "--out", tmp_path)
    code, out, err = run(*common)
    assert (code, err) == (0, "")
    assert "completed within the published bounds" in out
    assert "completed within the [specification]" in out  # of design/robust.toml, which stands beside
    code, out, err = run(*common, "--json")
    document = json.loads(out)
    assert document["yield"]["passed"] >= document["within_published"] >= document["within_specification"]
    code, _, err = run(*common, "--design", "design/planar.toml")
    assert code == 2
    assert "found planar, expected that of the gain file" in err
    code, _, err = run(*common, "--design", tmp_path / "none.toml")
    assert code == 2
    assert "no such file" in err
