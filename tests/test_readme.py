"""The README's example runs, and its table of claims shows what the code computes."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.riccati import eigenvalues
from malta.verify import machine_loop, zone

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Design

    from malta.linearize import LinearModel

README = (ROOT / "README.md").read_text(encoding="utf-8")


def _row(start: str) -> list[str]:
    line = next(line for line in README.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.search(r"```python\n(.*?)```", README, re.S)
    assert block is not None
    assert len(block[1].split("\n")) - block[1].count("\n\n") - 1 == 5
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
        sensors = {k: v for k, v in design.margins.peak_sensitivity.items() if k != "sigma_max"}
        worst = max(sensors, key=lambda k: sensors[k])
        assert _row("peak sensitivity")[column] == f"{sensors[worst]:.1f} in {worst} ({zone(sensors[worst])})"
        for definition, start in (
            ("sigma_max_T", "bandwidth, last −3 dB"),
            ("crossover_max", "bandwidth, last 0 dB"),
            ("w_n_max", "bandwidth, regulator"),
        ):
            assert _row(start)[column] == f"{design.margins.bandwidth[definition]:.0f}"
        heavy = malta.plant_of(replace(design.spec.parameters, m=design.plant.mass + 0.2))
        loaded = malta.simulate(heavy, design.controller, malta.Scenario.stroke())
        if loaded.verdict.completed:
            f = malta.stroke_figures(loaded)
            text = f"{f.overshoot * 100:.0f} % overshoot, {f.axial_error * 1e3:.1f} mm, {f.radial['y1'] * 1e6:.0f} µm"
        else:
            text = "touches down"
        assert _row("stroke with 0.2 kg")[column] == text


def _reach(stable: Callable[[float], bool]) -> float:
    """The largest share of the box, by bisection."""
    low, high = 0.0, 4.9
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def test_the_margins_along_the_worst_corner(design: Design) -> None:
    """K_A up, K_B down: 5/3 and 3 of the box for the LQR, what the observer leaves of them on the machine."""
    par, K = design.spec.parameters, malta.lqr(design.model, design.spec.weights)

    def model(share: float) -> LinearModel:
        corner = replace(par, K_A=par.K_A * (1 + 0.2 * share), K_B=par.K_B * (1 - 0.2 * share))  # type: ignore[attr-defined]
        plant = malta.plant_of(corner)
        return malta.linearize(plant, plant.at())

    def full_state(share: float) -> bool:
        m, weaker = model(share), np.array([1 - 0.2 * share] * 4 + [1])
        return bool(eigenvalues(m.A - m.B * weaker @ K).real.max() < 0)

    def machine(share: float) -> bool:
        return bool(np.abs(eigenvalues(machine_loop(model(share), design.controller).closed)).max() < 1)

    column = {"table2": 2, "calibrated": 3}[design.spec.name]
    lqr = _reach(full_state)
    assert lqr == pytest.approx({"table2": 5 / 3, "calibrated": 3.0}[design.spec.name], rel=1e-5)
    assert _row("share of the 20 % box")[column] == f"{lqr * 100:.0f}"
    assert _row("the same with the observer")[column] == f"{_reach(machine) * 100:.0f}"


def test_the_poles_over_the_travel(designs: dict[str, Design]) -> None:
    plant = designs["table2"].plant
    radial = [malta.linearize(plant, plant.at(z=z)).sys.poles().real.max() for z in (0.0, 15e-3)]
    assert _row("poles over")[2] == f"{(radial[1] / radial[0] - 1) * 100:.1f} %"
