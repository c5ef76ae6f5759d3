"""Figures and pages: labelled, bounded, written whole, within 100 columns."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rich.console import Console

import malta
from malta import report
from malta.simulate import Scenario, stroke_figures

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Design


def test_the_page_of_a_design_fits_and_names_its_figures(design: Design, published: dict[str, Any]) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke())
    page = report.design_page(design.spec, design.model, design.margins, stroke_figures(run), published)
    buffer = io.StringIO()
    Console(file=buffer, width=100, markup=False, highlight=False).print(page)
    text = buffer.getvalue()
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 100
    for wanted in (
        "218.92",
        "157.53",
        "Table I",
        "LQR",
        "Kalman filter",
        "closed loop",
        "about 400",
        "<= 20",
    ):
        assert wanted in text
    if design.spec.name == "table2":
        assert "-255.3 (x2)  -225.2 (x2)  -212.8 (x2)  -97.2 (x2)" in text


def test_modes_keep_their_names_off_the_centre(design: Design) -> None:
    """At z_ss = 15 mm y and alpha mix; each pole still stands under the mode that it grows from."""
    model = malta.linearize(design.plant, design.plant.at(z=15e-3))
    buffer = io.StringIO()
    Console(file=buffer, width=100).print(report.poles_table(model, None))
    row = next(line for line in buffer.getvalue().splitlines() if "ours" in line)
    assert row.split()[2:] == ["230.64", "230.64", "0.00", "149.52", "149.52"]


def test_the_stroke_figure_has_labelled_axes_and_the_published_bounds(
    design: Design, published: dict[str, Any]
) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke())
    figure = report.stroke_figure(run, published)
    assert len(figure.axes) == 4
    for axes in figure.axes:
        assert axes.get_ylabel().endswith("]")
    assert [axes.get_xlabel() for axes in figure.axes[2:]] == ["time [ms]", "time [ms]"]
    lines = [np.asarray(line.get_ydata(), dtype=float) for axes in figure.axes for line in axes.lines]
    bounds = {round(float(y[0]), 6) for y in lines if len(y) == 2}
    assert bounds == {-20.0, 20.0, -0.6, 0.6}
    title = figure.get_suptitle()
    assert title.startswith(f"{design.spec.name}: stroke of 10 mm, rise 1")


def test_a_figure_of_a_failed_run_says_so(designs: dict[str, Design]) -> None:
    design = designs["table2"]
    heavy = malta.plant_of(replace(design.spec.parameters, m=0.56))
    run = malta.simulate(heavy, design.controller, Scenario.stroke())
    assert "touchdown at sensor plane 1" in report.stroke_figure(run).get_suptitle()


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_same_figure_gives_the_same_bytes(design: Design, tmp_path: Path, suffix: str) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke())
    first, second = (report.stroke(run, tmp_path / f"{name}{suffix}").read_bytes() for name in "ab")
    assert first == second
    assert len(first) > 10_000


def test_unknown_kinds_of_figures_are_refused(design: Design, tmp_path: Path) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke(duration=0.005))
    with pytest.raises(malta.InputError, match=r"suffix '\.gif', expected one of \.png, \.svg"):
        report.stroke(run, tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


def test_a_stroke_is_drawn_whole_and_saved_by_default_in_build(
    designs: dict[str, Design], published: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a payload the error leaves the published bounds; the axes grow with it."""
    design = designs["calibrated"]
    heavy = malta.plant_of(replace(design.spec.parameters, m=0.56))
    run = malta.simulate(heavy, design.controller, Scenario.stroke())
    figure = report.stroke_figure(run, published)
    assert figure.axes[2].get_ylim()[1] > 1.8
    assert figure.axes[1].get_ylim()[1] > 145
    monkeypatch.chdir(tmp_path)
    assert str(malta.report.stroke(run)) == "build/calibrated_stroke.png"
    assert [p.name for p in (tmp_path / "build").iterdir()] == ["calibrated_stroke.png"]
