"""What results say of themselves: ten lines of a terminal at most, a table in a notebook."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, strategies as st

import malta
from malta.display import COLUMNS, LINES, Curves, Description, quantity, svg

pytestmark = pytest.mark.usefixtures("proven_once")

BALL = "examples/ball/design/ball.toml"
SHORT: dict[str, Any] = {"duration": 0.02}  # s


@pytest.fixture(scope="module")
def spec() -> malta.Spec:
    return malta.read_design(BALL)


@pytest.fixture(scope="module")
def law(spec: malta.Spec) -> malta.synthesis.Controller:
    return malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def _plan(c: malta.synthesis.Controller, samples: int = 8) -> malta.campaigns.Plan:
    return malta.campaigns.Plan(c, "disturbance", {"m": 0.1}, samples=samples, options=SHORT)


# each with a word of its text that stands for a figure
RESULTS: dict[str, tuple[Callable[[malta.Spec, malta.synthesis.Controller], Any], str]] = {
    "spec": (lambda s, _: s, "LQG, sampled-data, every 200 us, delay 1"),
    "plant": (lambda s, _: s.plant, "states         q q_dot"),
    "loop": (lambda s, c: malta.loop(s.plant, c), "stable"),
    "systems": (lambda s, c: malta.loops.loop_systems(s.plant, c), "1 inputs, 1 outputs"),
    "curves": (lambda s, c: malta.loops.loop_curves(s.plant, c), "largest |S|  1.57"),
    "margins": (lambda s, c: malta.verify(malta.linearize(s.plant, s.plant.at()), c), "delay margin, smallest [µs]"),
    "margin": (lambda s, c: malta.robust_margin(malta.loop(s.plant, c), {"m": 0.2}), "proven 3"),
    "sampled": (lambda s, c: malta.loop(s.plant, c).sampled, "sample_time  0.0002"),
    "classical": (lambda s, c: malta.loop(s.plant, c).classical, "delay  y"),
    "poles": (lambda s, c: malta.verify(malta.linearize(s.plant, s.plant.at()), c).poles, "regulator"),
    "weights": (lambda s, _: s.weights, "r_base            "),
    "scenario": (lambda *_: malta.Scenario.stroke(10e-3, noise=1.0), "noise      1"),
    "point": (lambda s, _: s.plant.at(), "x       0, 0"),
    "noise": (lambda _, c: c.noise, "sensor   "),
    "plan": (lambda _, c: _plan(c), "spread         m"),
    "recovery": (lambda s, c: malta.loops.recovery(s.plant, c, {"push": {"w": 0.01}})[0], "y  moves"),
    "stages": (lambda s, c: malta.verify(s.plant, c, {"m": 0.2}, stages=True), "proven 3"),
    "run": (lambda s, c: malta.experiment("disturbance", s.plant, c, size=0.1, **SHORT).run, "completed at 20 ms"),
    "experiment": (lambda s, c: malta.experiment("disturbance", s.plant, c, size=0.1, **SHORT), "y moves by"),
    "campaign": (lambda _, c: malta.campaign(_plan(c), workers=1), "8 of 8: 100 %"),
    "summary": (lambda _, c: malta.campaigns.summarize(_plan(c), workers=1), "8 of 8: 100 %"),
    "batch": (lambda _, c: malta.campaign(_plan(c), workers=1).batch, "8 of 8 runs"),
    "rare": (
        lambda _, c: malta.campaigns.rare_event(
            _plan(c, 2000), malta.campaigns.limit_of(_plan(c), "deviation-y", 1e-9), workers=1
        ),
        "probability  1, ",
    ),
    "tolerances": (
        lambda _, c: malta.campaigns.tolerances(
            _plan(c), malta.campaigns.limit_of(_plan(c), "touchdown"), 0.9, workers=1
        ),
        "m      9.5 times, 8 of 8",
    ),
}  # fmt: skip


@pytest.mark.slow_for("curves", "margins", "stages")
@pytest.mark.parametrize("name", RESULTS)
def test_a_result_prints_itself_in_ten_lines(
    name: str, spec: malta.Spec, law: malta.synthesis.Controller
) -> None:
    made, word = RESULTS[name]
    result = made(spec, law)
    text = repr(result)
    assert word in text
    assert len(text.splitlines()) <= LINES
    assert all(len(line) <= COLUMNS for line in text.splitlines())
    assert "array(" not in text
    table = ElementTree.fromstring(re.findall("<table>.*</table>", result._repr_html_(), re.DOTALL)[0])
    own = getattr(result, "description", None)
    labels = [row[0].text or "" for row in table]
    assert labels == [label for label, _ in own.rows] if own else len(labels) >= len(text.splitlines()) - 1


@pytest.mark.slow
def test_the_flagship_stays_within_ten_lines() -> None:
    """Five sensors, eleven figures: what does not fit is counted, and stands in the notebook's table."""
    c = malta.gains.read("design/gains/robust.json")
    plant = malta.plant_of(c.parameters)
    curves = malta.loops.loop_curves(plant, c)
    assert "largest |S|  2.44 at 2.17e+03 rad/s" in repr(curves)
    assert curves.description.html.count("<svg") == 1
    for result in (plant, malta.loop(plant, c), malta.loops.loop_systems(plant, c), curves):
        assert len(repr(result).splitlines()) <= LINES
        assert max(len(line) for line in repr(result).splitlines()) <= COLUMNS


def test_rows_that_do_not_fit_are_counted() -> None:
    text = str(Description("t" * 100, tuple((f"row {k}", "x" * 100) for k in range(20))))
    assert len(text.splitlines()) == LINES
    assert text.splitlines()[-1] == "  and 12 more"
    assert {len(line) for line in text.splitlines()[:-1]} == {COLUMNS}


@pytest.mark.slow
def test_a_picture_has_its_axes_and_its_curves() -> None:
    w = np.geomspace(1, 100, 50)
    text = svg(Curves(w, "frequency [rad/s]", {"|S|": w, "<T>": 1 / w}, "gain [1]", logarithmic=True))
    root = ElementTree.fromstring(text)
    assert root.tag.endswith("svg")
    assert text.count("clip-path=") > 2


def test_words_of_results_are_escaped() -> None:
    assert "<script>" not in Description("<script>", (("<script>", "<script>"),)).html


@given(
    st.one_of(st.floats(-1e300, 1e300), st.just(math.inf), st.just(math.nan)),
    st.sampled_from(["m", "rad", "kg", "1", "N m"]),
)
def test_a_quantity_is_its_value(value: float, unit: str) -> None:
    number, _, shown = quantity(value, unit).partition(" ")
    scale = {"": 1.0, **{p: 1000.0**k for k, p in malta.display.PREFIXES.items() if p}}[
        shown.removesuffix(unit)
    ]
    if unit == "1":
        assert shown == ""
        scale = 1.0
    assert float(number) * scale == pytest.approx(value, rel=6e-3, nan_ok=True)
    if math.isfinite(value) and 1e-12 <= abs(value) < 1e11 and unit in ("m", "N m"):
        assert 0.999 <= abs(float(number)) < 1001
