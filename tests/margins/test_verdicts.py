"""One verdict: a requirement has one figure, and every tool prints that figure and that verdict."""

from __future__ import annotations

import html
import io
import json
import math
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT
from rich.console import Console

import malta
from malta.app.files import Edit, open_design
from malta.app.picture import _figures, solve
from malta.app.worker import outcome_document
from malta.display import number
from malta.gains.file import read
from malta.margins.loop_report import BANDWIDTH, BANDWIDTHS
from malta.margins.outcome import Outcome
from malta.model.plants import plant_of
from malta.proof.margin import NOT_PROVEN
from malta.report.page.analysis import key_figures
from malta.report.tables.design import requirements_table
from malta.report.verdict import verdict_html, verdict_lines, verdict_text
from malta.synthesis.machine_requirements import mean_over_seeds, reached_with_every_seed
from malta.synthesis.requirements import SEEDS, Figure, Verdict, judge_figure
from malta.tuning.judging import judge
from malta.tuning.outcomes import SynthesizedDesign, entries_without_flights, outcomes_of
from malta.tuning.search import model_and_controller

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Run

ROBUST = "design/gains/robust.json"
OPEN = Outcome("error", 1.0, 0.99, "1", "flights", interval=(0.95, 1.03))


def noisy_verdict(mean: float, rng: np.random.Generator, *, at_least: bool = False) -> Verdict:
    """The verdict of a figure with a scatter of 1 against a bound of 100."""
    figure = mean_over_seeds(lambda _: mean + rng.standard_normal(), 100.0, "draws", at_least=at_least)
    return judge_figure(figure, 100.0, at_least=at_least)


@pytest.mark.slow
@pytest.mark.parametrize("at_least", [False, True])
def test_an_interval_decides_wrongly_in_five_of_a_hundred_at_most(at_least: bool) -> None:
    """At the bound itself either decision is an error; two scatters off it hardly one decision is."""
    rng, runs = np.random.default_rng(7), 1500
    at_bound = [noisy_verdict(100.0, rng, at_least=at_least) for _ in range(runs)]
    wrong = 1 - at_bound.count("undecided") / runs
    assert 0.02 < wrong < 0.05 + 2 * math.sqrt(0.05 * 0.95 / runs)
    above = [noisy_verdict(102.0, rng, at_least=at_least) for _ in range(runs)]
    right: Verdict = "holds" if at_least else "fails"
    assert above.count(right) > 0.99 * runs


def test_seeds_are_drawn_until_the_interval_decides_and_no_longer() -> None:
    drawn: list[int] = []

    def draw(seed: int) -> float:
        drawn.append(seed)
        return 1.1 if seed % 2 else 0.9

    clear = mean_over_seeds(draw, 2.0, "runs")
    assert drawn == list(range(SEEDS[0]))
    assert clear.value == pytest.approx(1.0)
    drawn.clear()
    close = mean_over_seeds(draw, 1.001, "runs")
    assert drawn == list(range(SEEDS[-1]))
    assert judge_figure(close, 1.001, at_least=False) == "undecided"
    exact = mean_over_seeds(lambda _: 1.0, 1.0, "runs")
    assert judge_figure(exact, 1.0, at_least=False) == "holds"
    lost = mean_over_seeds(lambda seed: math.inf if seed == 2 else 1.0, 2.0, "runs")
    assert judge_figure(lost, 2.0, at_least=False) == "fails"


def test_a_flight_that_fails_with_one_seed_reaches_nothing() -> None:
    asked: list[int] = []

    def ends_well(seed: int) -> bool:
        asked.append(seed)
        return True

    found = reached_with_every_seed(ends_well, 0.2, "stroke")
    assert (found.value, found.source, asked) == (0.2, "stroke, 4 seeds", list(range(SEEDS[0])))
    found = reached_with_every_seed(lambda seed: seed != 1, 0.2, "stroke")
    assert (found.value, found.source) == (0.0, "stroke, 3 of 4 seeds")


@pytest.mark.slow
def test_verify_judges_what_no_flight_measures(run: Run) -> None:
    """The figures are those of `malta tune --check`; the margin of the proof that is printed is not proven again."""
    spec = malta.read_design(ROOT / "design" / "robust.toml")
    flown = {"tracking_error", "radial_deviation", "tilt_deviation", "payload", "lift_off"}
    names = entries_without_flights(spec)
    assert set(names) == set(spec.specification) - flown
    names.remove("margin")
    rows = {one.name: one for one in judge(spec, names=names)}
    said = run("verify", ROBUST, "--no-proof", "--json")
    found = {one["name"]: one["found"] for one in json.loads(said.out)["requirements"]}
    assert found.keys() == set(names)
    assert found == pytest.approx({name: one.found for name, one in rows.items()}, rel=1e-9)


@pytest.mark.slow
def test_a_changed_machine_is_judged_and_fails_in_verify(run: Run) -> None:
    said = run("verify", ROBUST, "--no-proof", "--set", "m=0.6", "--set", "K_B=2.5")
    text = " ".join(said.out.split())
    assert said.code == 0
    assert "FAILS" in text
    assert re.search(r"\d+ of 25 hold; nearest their limits .* Not judged here: margin, tracking error", text)
    assert "25 of 25" not in text


def test_a_named_design_of_another_machine_is_refused(run: Run) -> None:
    said = run("verify", ROBUST, "--no-proof", "--design", "design/planar.toml")
    assert said.code == 2
    assert "machine" in said.err


def test_undecided_is_no_pass_anywhere() -> None:
    assert (OPEN.verdict, OPEN.holds) == ("undecided", False)
    assert "undecided between 0.95 and 1.03" in str(OPEN)
    assert OPEN.found_text == "0.99 ± 0.04"
    assert "undecided" in str(list(requirements_table([OPEN]).columns[4].cells))
    assert outcome_document([OPEN])["holds"] is None
    held = Outcome("error", 1.0, 0.5, "1", "flights")
    worse = Outcome("error", 1.0, 1.5, "1", "flights")
    assert outcome_document([held, OPEN])["holds"] is None
    assert outcome_document([OPEN, worse])["holds"] is False
    assert judge_figure(Figure(math.nan, "nothing"), 1.0, at_least=False) == "fails"


def test_the_verdict_names_failures_first_and_says_the_same_everywhere() -> None:
    """One record makes the lines of terminal and pages; a proven margin is never rounded up to what is not proven."""
    controller = malta.gains.read(ROOT / ROBUST)
    model = malta.linearize(plant_of(controller.parameters), plant_of(controller.parameters).at())
    spoiled = replace(controller, K=0.0 * controller.K)
    margin = Outcome("margin", 3.0, 2.0, "1", "proof", at_least=True)
    held = Outcome("bandwidth", 100.0, 401.7, "rad/s", "loop", at_least=True)
    proven = replace(NOT_PROVEN, lower=0.99996, upper=1.00004, reason="")
    found = replace(
        malta.verify(model, controller),
        requirements=(held, OPEN, margin),
        robust=proven,
        uncertainty={"m": 0.2},
    )
    lines = verdict_lines(found)
    assert [line.label for line in lines] == ["loop", "margin", "peak |S|", "requirements", "yield"]
    assert (lines[1].value, lines[1].state) == ("99.99 % proven", "bad")
    assert "lost at 100.01 %" in lines[1].note
    assert lines[3].value == "1 of 3 FAILS, 1 undecided"
    assert lines[3].note.startswith("margin 200.00 %, asked >= 300 %; error")
    assert held.found_text == "63.93 Hz (401.7 rad/s)"
    console = Console(width=200, file=io.StringIO(), color_system=None)
    console.print(verdict_text(found))
    terminal, page = console.file.getvalue(), html.unescape(verdict_html(lines))  # type: ignore[attr-defined]
    for line in lines:
        assert f"{line.value}, {line.note}" in terminal
        assert line.value in page
        assert line.note in page
    unstable = verdict_lines(malta.verify(model, spoiled))
    assert [line.state for line in unstable[:3]] == ["bad", "", "bad"]


def test_undecided_ends_tune_with_exit_code_1(monkeypatch: pytest.MonkeyPatch) -> None:
    from typer.testing import CliRunner

    from malta.cli.main import app

    monkeypatch.setattr("malta.tuning.judging.judge", lambda *_: (OPEN,))
    ended = CliRunner().invoke(app, ["tune", "--check", str(ROOT / "design" / "halbach_pid.toml"), "--json"])
    (row,) = json.loads(ended.stdout)["requirements"]
    assert (row["holds"], row["verdict"], row["interval"]) == (False, "undecided", [0.95, 1.03])
    assert ended.exit_code != 0


def compare_verdicts(design: Path, gains: Path) -> None:
    """The rows of tune, of a gain file (report, compare) and of the app: the same figures and verdicts."""
    spec = malta.read_design(design)
    model, controller = model_and_controller(spec)
    stored = read(gains)
    tuned = judge(spec)
    reported = judge(spec, stored)
    app = SynthesizedDesign(spec, model, controller)
    shown = {name: outcomes_of(app, name) for name in spec.specification}
    quiet = [one for one in tuned if one.asked is not None]
    assert [(r.name, r.verdict) for r in tuned] == [(r.name, r.verdict) for r in reported]
    assert [r.name for r in quiet] == list(spec.specification)  # one figure for each requirement
    for mine, other in zip(tuned, reported, strict=True):
        if mine.interval is None or other.interval is None:
            assert mine.found == pytest.approx(other.found, rel=1e-6), mine.name
        else:  # quantizers make another flight of the last digits of a gain: the same figure within its interval
            assert max(mine.interval[0], other.interval[0]) <= min(mine.interval[1], other.interval[1]), (
                mine.name
            )
    for row in quiet:
        (one,) = shown[row.name]
        assert (one.found, one.verdict) == (row.found, row.verdict)


SMALL = ("halbach_pid", "planar_pid")
LARGE = ("robust_observer", "tubular_pid")


@pytest.mark.parametrize(
    "name", [*SMALL[:1], *map(partial(pytest.param, marks=pytest.mark.slow), (*SMALL[1:], *LARGE))]
)
def test_all_tools_give_one_figure_and_one_verdict(name: str) -> None:
    compare_verdicts(ROOT / "design" / f"{name}.toml", ROOT / "design" / "gains" / f"{name}.json")


def test_the_first_line_says_what_stands_in_the_loop_and_what_is_left_out() -> None:
    """Of a machine without windings no line names current loops; what `left_out` names is named."""
    said = {}
    for name in ("robust", "halbach", "planar_pid"):
        controller = malta.gains.read(ROOT / f"design/gains/{name}.json")
        plant = plant_of(controller.parameters)
        found = malta.verify(malta.linearize(plant, plant.at()), controller)
        said[name] = next(iter(verdict_lines(found))).note
        assert said[name] == found.loop.contents
        assert found.loop.left_out in said[name]
        assert str(found).startswith(f"stable {said[name]}\n")
        assert ("contents", said[name]) in found.description.rows
    assert said["robust"] == "with hold, delay and current loops"
    assert said["halbach"].startswith(
        "with hold and lag of the current loops; left out: the electronics' own"
    )
    assert said["planar_pid"].startswith("with hold and delay; left out: the limited speed")
    cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    weights = malta.synthesis.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8])
    law = malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=1e-3)
    late = replace(cart, sensors=malta.model.Sensors((2e-3,), dead_time=1e-3))
    assert malta.loop(cart, law).contents == "with hold"
    assert malta.loop(late, law).contents == "with hold, lag of the sensors and dead time of the sensors"


@pytest.mark.parametrize("name", ["robust", "structured"])
def test_a_tile_has_one_bandwidth_with_its_name(name: str) -> None:
    """The same definition whether the design file bounds a bandwidth or not; the page of the theory has all of them."""
    controller = malta.gains.read(ROOT / f"design/gains/{name}.json")
    plant = plant_of(controller.parameters)
    report = malta.verify(malta.linearize(plant, plant.at()), controller)
    asked = Outcome("bandwidth", 400.0, 401.7, "rad/s", BANDWIDTHS["w_n_min"], at_least=True)
    analysis: Any = SimpleNamespace(
        report=replace(report, requirements=(asked,)), job=None, plant=plant, loads=()
    )
    tile = next(one for one in key_figures(analysis) if one.label == "Bandwidth")
    value = report.bandwidth[BANDWIDTH]
    assert tile.value == f"{number(value / (2 * math.pi), 3)} Hz"
    assert tile.note.endswith(BANDWIDTHS[BANDWIDTH])
    shown = {
        one["label"]: one
        for one in _figures(solve(open_design(ROOT / f"design/{name}.toml").apply(Edit())), None)
    }
    assert shown["bandwidth, T"]["value"] == pytest.approx(value)
    assert shown["bandwidth, T"]["note"] == BANDWIDTHS[BANDWIDTH]
    assert [label for label in shown if "bandwidth" in label] == ["bandwidth, T"]


def test_all_definitions_of_bandwidth_stand_in_one_table() -> None:
    page = (ROOT / "docs/theory/loop.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \| .+ \| `(\w+)` \|$", page, re.M)
    assert [(key, name) for name, key in rows] == list(BANDWIDTHS.items())
