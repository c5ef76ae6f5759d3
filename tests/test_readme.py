"""The README's example runs, and its table of claims shows what the code computes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from conftest import ROOT

import malta

if TYPE_CHECKING:
    from conftest import Design

README = (ROOT / "README.md").read_text(encoding="utf-8")


def _row(start: str) -> list[str]:
    line = next(line for line in README.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.search(r"```python\n(.*?)```", README, re.S)
    assert block is not None
    assert len(block[1].splitlines()) == 5
    exec(block[1], {})
    assert capsys.readouterr().out.startswith("stable with hold, delay and current loops")


def test_the_claims_are_computed(designs: dict[str, Design]) -> None:
    for column, name in ((2, "table2"), (3, "calibrated")):
        design = designs[name]
        run = malta.simulate(design.plant, design.controller, malta.Scenario.stroke())
        figures = malta.stroke_figures(run)
        assert _row("stroke: rise")[column] == f"{figures.rise * 1e3:.2f}"
        assert _row("stroke: overshoot")[column] == f"{figures.overshoot * 100:.2f}"
        assert _row("stroke: axial error")[column] == f"{figures.axial_error * 1e3:.3f}"
        assert _row("stroke: radial")[column] == f"{max(figures.radial.values()) * 1e6:.2f}"
        weight = run.v[-1, 1] + run.v[-1, 3]
        assert _row("weight carried")[column].startswith(f"{weight:.2f}, more on module 2")
        assert run.v[-1, 3] > run.v[-1, 1]
        peak = design.margins.peak_sensitivity["sigma_max"]
        zones = {"table2": "D", "calibrated": "A"}
        assert _row("peak sensitivity")[column] == f"{peak:.1f} ({zones[name]})"
        definition = {"table2": "sigma_max_T", "calibrated": "crossover_max"}[name]
        assert _row("bandwidth")[column] == f"{design.margins.bandwidth[definition]:.0f}"


def test_the_poles_over_the_travel(designs: dict[str, Design]) -> None:
    plant = designs["table2"].plant
    radial = [malta.linearize(plant, plant.at(z=z)).sys.poles().real.max() for z in (0.0, 15e-3)]
    assert _row("poles over")[2] == f"{(radial[1] / radial[0] - 1) * 100:.1f} %"
