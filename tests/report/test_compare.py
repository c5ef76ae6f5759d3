"""Gain files beside each other: what differs, which is better, and what cannot be compared."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browsing import browser as browser, open_page, printed_overlaps
from conftest import ROOT, Run
from page_checks import read_page
from rich.console import Console
from test_report_page import HOSTILE, STRANGE, cart_controller

from malta.cli.documents.loops import compare_output
from malta.margins.verify import linear_report
from malta.merit_lists import find_best
from malta.merits import MEANINGS, Merit, figure, four_digits
from malta.model.linearize import linearize
from malta.report.page.analysis import Subject
from malta.report.page.comparison import Comparison, MeritRow, compare, comparison_tables, names_of
from malta.report.page.report import comparison_page
from malta.report.tables.margins import position_text
from malta.synthesis.design_file import read_design
from malta.synthesis.synthesize import synthesize

if TYPE_CHECKING:
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

GAINS = ROOT / "design" / "gains"


def subject_of(controller: Controller, source: str = "", **box: float) -> Subject:
    return Subject(controller, controller.parameters, box or {"k": 0.2}, None, source)


@pytest.fixture(scope="module")
def carts() -> Comparison:
    soft, stiff = cart_controller("soft"), cart_controller("stiff", 2e-5)
    return compare([subject_of(soft), subject_of(stiff)])


def test_what_never_settles_is_said_so() -> None:
    """An accelerometer under a constant load: no time is long enough; a delay margin without end is any."""
    assert figure("load_settles", "k", "1 N w: within 1 % after", float("inf"), "s").text == "never"
    assert figure("delay_margin", "k", "delay margin", float("inf")).text == "any"


def test_what_any_waveform_does_at_most_is_rounded_up_in_its_unit_and_stands_before_the_step() -> None:
    assert figure("load_any", "", "any waveform of 1 N F_x: at most", 1.97846e-5, "um").text == "19.79"
    assert figure("load_moves", "", "1 N F_x: largest deviation", 1.97846e-5, "um").text == "19.78"
    spec = read_design("examples/ball/design/ball.toml")
    model = linearize(spec.plant, spec.plant.at())
    found = {one.key: one for one in linear_report(model, synthesize(spec, model), {}).figures}
    worst, step = found["load w any waveform"], found["load w largest"]
    assert (worst.meaning.group, step.meaning.group) == (
        "a load of any waveform",
        "a constant load from outside",
    )
    assert worst.value > step.value > 0
    assert [*found].index(worst.key) < [*found].index(step.key)


def row_of(found: Comparison, key: str) -> MeritRow:
    (row,) = [one for one in found.rows if one.key == key]
    return row


def text_of(found: Comparison, width: int) -> str:
    console = Console(file=io.StringIO(), width=width, highlight=False, markup=False)
    console.print(comparison_tables(found, width))
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue()


def test_figures_are_those_of_verify_and_the_better_is_marked(carts: Comparison) -> None:
    for name, a in zip(carts.names, carts.designs, strict=True):
        margins = linear_report(a.report.model, a.subject.controller)
        k = carts.names.index(name)
        for key, of in (("bandwidth_sigma_max_T_rad_per_s", margins.bandwidth["sigma_max_T"]),
                        ("peak_sensitivity", margins.peak_sensitivity[STRANGE])):  # fmt: skip
            score = row_of(carts, key).scores[k]
            assert score is not None
            assert score.value == of
    soft, stiff = (score.value for score in row_of(carts, "bandwidth_sigma_max_T_rad_per_s").scores if score)
    assert stiff > 1.5 * soft
    assert row_of(carts, "bandwidth_sigma_max_T_rad_per_s").best == (False, True)
    noise = next(row for row in carts.rows if row.scores[0] and row.scores[0].kind == "command")
    assert noise.best == (True, False)
    assert row_of(carts, "stable").best == (False, False)  # a tie


@pytest.mark.slow
def test_margins_stand_as_bars_where_they_count_in_one_box(carts: Comparison) -> None:
    """As high as the proven margin, in the terminal and on the page; no bars of different uncertainties."""
    proven = [stair.proven for stair in carts.margins]
    assert proven == [a.report.robust.lower for a in carts.designs if a.report.robust is not None]
    line = next(line for line in text_of(carts, 80).splitlines() if line.startswith(" margin"))
    assert re.findall("[▁-█]", line)[int(np.argmax(proven))] == "█"
    html = comparison_page(carts).html
    heights = [float(height) for height in re.findall(r'<i style="height:([\d.]+)rem"', html)]
    assert np.divide(heights, max(heights)) == pytest.approx(np.divide(proven, max(proven)), abs=0.01)
    wide = replace(carts.designs[1], subject=carts.designs[1].subject._replace(box={"k": 0.1}))
    assert Comparison(carts.names, (carts.designs[0], wide)).margins == ()


def test_only_what_differs_is_listed(carts: Comparison) -> None:
    keys = {row.key for row in carts.differences}
    assert {"cost_state_z_1_per_m2", "gains_norm_of_K"} <= keys
    assert not any(key.startswith(("machine", "parameters", "law_sample_time", "noise")) for key in keys)
    same = cart_controller("soft")
    assert compare([subject_of(same), subject_of(same)], proof=False).differences == ()


def test_the_table_fits_its_width_and_marks_without_colour(carts: Comparison) -> None:
    for width in (80, 60):
        text = text_of(carts, width)
        assert max(map(len, text.splitlines())) <= width
        rows = [part.partition("regulator's")[0] for part in text.split("last 0 dB")[1:]]
        assert sum(row.count("*") for row in rows) == 1
    assert "What differs in the designs" in text
    document = compare_output(carts, [])
    assert [one.name for one in document.designs] == ["soft", "stiff"]
    bandwidth = next(one for one in document.figures if one.key == "bandwidth_crossover_max_rad_per_s")
    assert bandwidth.best == ["stiff"]
    assert bandwidth.better == "high"


def test_four_designs_fit_a_terminal() -> None:
    names = ("table2", "calibrated", "robust_observer", "tubular_pid")
    four = compare(
        [subject_of(cart_controller(name, (k + 1) * 1e-5)) for k, name in enumerate(names)], proof=False
    )
    assert max(map(len, text_of(four, 80).splitlines())) <= 80


def test_different_uncertainties_mark_no_margin(carts: Comparison) -> None:
    wide = replace(carts.designs[1], subject=carts.designs[1].subject._replace(box={"k": 0.1}))
    found = Comparison(carts.names, (carts.designs[0], wide))
    assert row_of(found, "margin_proven_share").best == (False, False)
    assert any("different uncertainties" in remark for remark in found.remarks)


def test_names_stay_distinguishable() -> None:
    controller = cart_controller("one")
    found = names_of(
        [subject_of(controller, source) for source in ("a/one.json", "b/one.json", "b/one.json", "")]
    )
    assert len(set(found)) == 4
    assert found[0] == "a/one.json"
    assert found[1:3] == ("b/one.json (1)", "b/one.json (2)")


def score(value: float, kind: str = "peak_s") -> Merit:
    return figure(kind, "key", "label", value, "1")


def test_the_best_is_better_in_digits_that_are_shown() -> None:
    low, nan = [score(1.5), score(2.0), score(1.5)], score(float("nan"))
    assert find_best(low) == (True, False, True)
    assert find_best([score(1.5), score(1.5000001)]) == (False, False)
    assert find_best([nan, score(1.5)]) == (False, False)
    assert find_best([nan, score(1.5), score(2.5), None]) == (False, True, False, False)
    assert find_best([score(1.0, "disk"), score(2.0, "disk")]) == (False, True)
    assert find_best([score(1.0, "natural"), score(2.0, "natural")]) == (False, False)
    assert find_best([score(float("inf"), "delay_margin"), score(2.0, "delay_margin")]) == (True, False)
    assert {one.better for one in MEANINGS.values()} == {"high", "low", ""}
    assert (four_digits(0.0), four_digits(1.99996), four_digits(-4.7e-7)) == ("0", "2.000", "-4.7e-07")


def test_two_to_eight_designs_are_compared(run: Run) -> None:
    one = GAINS / "robust.json"
    for files in ([one], [one] * 9):
        said = run("compare", *files)
        assert said.code == 2
        assert f"gain files: found {len(files)}, expected 2 to 8" in said.err


@pytest.mark.slow
def test_the_page_of_a_comparison(carts: Comparison, tmp_path: Path, browser: Any) -> None:
    page = comparison_page(carts)
    reader = read_page(page.html)
    text = "".join(reader.text)
    assert HOSTILE.replace("\x0b", "\ufffd") in text
    assert "★ " in text
    assert comparison_page(carts).content == page.content
    out = page.save(tmp_path / "page.html")
    for width in (1280, 390):
        open_page(browser, out, width=width)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert printed_overlaps(browser, "h1, h2, figure svg, figcaption, table, .caption, p, dt, dd") == []
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.mark.slow
def test_shipped_designs_beside_each_other(run: Run, tmp_path: Path) -> None:
    files = [GAINS / f"{name}.json" for name in ("halbach", "halbach_pid")]
    found = json.loads(run("compare", *files, "--json", "--out", tmp_path / "page.html").out)
    html = (tmp_path / "page.html").read_text(encoding="utf-8")
    read_page(html)
    assert "<b>✗ worse than halbach_pid</b>" in html
    assert ">time [s]<" in html  # 66 s of steps
    figures = {one["key"]: one for one in found["figures"]}
    for k, file in enumerate(files):
        stored = json.loads(file.read_text(encoding="utf-8"))["verification"]
        assert figures["margin_proven_share"]["values"][k] == pytest.approx(
            stored["robust"]["lower"], rel=2e-3
        )
        peak = stored["peak_sensitivity"]["sigma_max"]
        assert figures["peak_sensitivity_sigma_max"]["values"][k] == pytest.approx(peak, rel=1e-4)
    assert figures["margin_proven_share"]["best"] == ["halbach"]
    assert {"law_kind", "gains_norm_of_K"} <= set(found["differences"])
    assert found["specification"].endswith("halbach_pid.toml")
    first, second = found["standings"]
    assert (first["design"], first["verdict"]) == ("halbach", "worse than halbach_pid")
    assert "misses peak sensitivity 1.851, asked <= 1.8" in first["where"]
    assert second["verdict"].startswith("the reference, holds all 2 requirements")


def design_of(name: str, bound: float) -> tuple[Spec, Controller]:
    """The ball's design, asked for a peak sensitivity, with the gains of its file."""
    spec = read_design(ROOT / f"examples/ball/design/{name}.toml")
    asked = replace(spec, specification={"peak_sensitivity": bound, "bandwidth": 240.0})
    return asked, synthesize(spec, linearize(spec.plant, spec.plant.at()))


def test_one_specification_judges_all_designs_and_says_which_is_better_and_where() -> None:
    """The ball's LQG and PID by bounds of one file: what one of them alone holds makes it the better one."""
    spec, lqg = design_of("ball", 1.52)
    _, pid = design_of("ball_pid", 1.52)
    subjects = [Subject(one, one.parameters, {}, own) for one, own in ((lqg, spec), (pid, None))]
    found = compare(subjects, proof=False)
    assert [a.report.requirements[0].asked for a in found.designs] == [1.52, 1.52]
    peaks = [a.report.requirements[0].found for a in found.designs]
    assert peaks[1] < 1.52 < peaks[0]
    assert peaks == [a.report.peak_sensitivity["y"] for a in found.designs]
    first, second = found.standings
    assert first.value.startswith("the reference, holds 1 of 2 requirements")
    assert f"misses peak sensitivity {peaks[0]:.4g}, asked <= 1.52" in first.note
    assert second.value == "better than ball"
    assert text_of(found, 80).startswith("ball: the reference")
    other = compare(subjects[::-1], proof=False, spec=spec)
    assert [one.value.partition(",")[0] for one in other.standings] == ["better than ball", "the reference"]
    assert (other.reference, other.judged_text) == (1, "")


def test_a_specification_of_another_machine_judges_nothing(run: Run) -> None:
    files = [GAINS / f"{name}.json" for name in ("halbach", "halbach_pid")]
    said = run("compare", *files, "--no-proof", "--specification", ROOT / "design" / "robust.toml")
    assert (said.code, said.out) == (2, "")
    assert "--specification: machine: found tubular, expected that of all gain files" in said.err


@pytest.mark.slow
def test_different_machines_are_compared_in_what_they_share(run: Run) -> None:
    said = run("compare", GAINS / "planar_pid.json", GAINS / "halbach.json", "--no-proof", "--json")
    found = json.loads(said.out)
    keys = {one["key"] for one in found["figures"]}
    assert {"stable", "disk_margin_forces", "peak_sensitivity"} <= keys
    assert not any(key.startswith(("motion", "load", "stroke", "requirement")) for key in keys)
    assert any("machines differ (planar, halbach)" in remark for remark in found["remarks"])
    assert not any(one["best"] for one in found["figures"])


@pytest.mark.slow
def test_an_unstable_design_is_compared_and_ends_with_exit_code_1(run: Run) -> None:
    said = run("compare", GAINS / "robust.json", GAINS / "table2.json", "--set", "K_B=15", "--no-proof")
    assert said.code == 1
    assert "UNSTABLE" in said.out
    assert "unstable" in said.err


def test_places_along_a_travel_are_in_millimetres_and_others_as_they_are() -> None:
    travel: Any = SimpleNamespace(stroke=0.01, course="z")
    speed: Any = SimpleNamespace(stroke=0.0, course="Omega")
    assert [position_text(one, 1.5e-3) for one in (travel, speed)] == ["1.5", "0.0015"]
