"""Figures and pages: labelled, bounded, written whole, within 100 columns."""

from __future__ import annotations

import io
import math
import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import DESIGNS, assert_folds, printed
from figure_checks import defects
from flight import EXPERIMENTS
from rich.console import Console

import malta
from malta import report
from malta.display import micro
from malta.report import figures
from malta.report.ledger import Ledger, LedgerClaim
from malta.simulation.experiments import Case, Experiment, Merit
from malta.simulation.scenario import Scenario
from malta.simulation.trajectory import Verdict

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Design
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Flown = Callable[[str, str], Experiment]
    Pictured = Callable[[str, str], tuple[Figure, bytes]]

pytestmark = pytest.mark.usefixtures("proven_once")


SHORT: dict[str, dict[str, Any]] = {
    "lift-off": {"duration": 0.06},
    "thermal": {"faster": 100.0},
    "capture": {"points": 9},
    "supervised-faults": {"only": "stuck"},
}


@pytest.fixture(scope="session")
def flown(designs: dict[str, Design]) -> Flown:
    """Experiments of a design by name, each made once."""

    @cache
    def made(design: str, name: str) -> Experiment:
        return malta.experiment(
            name, designs[design].plant, designs[design].controller, **SHORT.get(name, {})
        )

    return made


@pytest.fixture(scope="session")
def pictured(flown: Flown, published: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Pictured:
    """Their figures, each drawn once, with the bytes of the picture."""
    folder = tmp_path_factory.mktemp("figures")

    @cache
    def made(design: str, name: str) -> tuple[Figure, bytes]:
        figure = report.experiment_figure(flown(design, name), published)
        return figure, drawn(figure, folder)

    return made


def drawn(figure: Figure, folder: Path) -> bytes:
    return figures.save(figure, folder / "figure.png").read_bytes()


def levels(axes: Axes) -> set[float]:
    """Where lines run from side to side."""
    ys = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]
    return {round(float(y[0]), 6) for y in ys if len(y) == 2 and y[0] == y[1]}


def bounds(axes: Axes) -> set[float]:
    """The sizes of bounds: of lines from side to side, and those that arrows beyond the data name."""
    arrows = [re.search(r"([\d.]+) [↑↓↕]", text.get_text()) for text in axes.texts]
    return {abs(level) for level in levels(axes)} | {float(found[1]) for found in arrows if found}


def words(figure: Figure) -> list[str]:
    return [text.get_text() for axes in figure.axes for text in axes.texts]


@pytest.mark.slow
def test_the_page_of_a_design_fits_and_names_its_figures(
    design: Design, flown: Flown, published: dict[str, Any]
) -> None:
    stroke = flown(design.spec.name, "stroke")
    page = report.design_page(design.spec, design.model, design.margins, stroke, published)
    text = printed(page)
    assert_folds(page, 80, 60, 40)
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
    row = next(line for line in printed(report.poles_table(model, None)).splitlines() if "ours" in line)
    assert row.split()[2:] == ["230.64", "230.64", "0.00", "149.52", "149.52"]


def test_the_stroke_figure_has_labelled_axes_and_the_published_bounds(
    design: Design, published: dict[str, Any]
) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke())
    figure = report.stroke_figure(run, published)
    assert len(figure.axes) == 6
    for axes in figure.axes:
        assert axes.get_ylabel().endswith("]")
    speed = figure.axes[4].lines[-1].get_ydata()
    assert np.max(speed) == pytest.approx(0.678, rel=0.1)  # of the reference, Fig. 12(c)
    assert [axes.get_xlabel() for axes in figure.axes[4:]] == ["time [ms]", "time [ms]"]
    for axes, bound in zip(figure.axes[1:3], (20.0, 0.6), strict=True):
        data = max(float(np.abs(line.get_ydata()).max()) for line in axes.lines if line.get_gid() != "bound")
        near = bound <= 2.5 * data  # a bound further away would flatten the data: an arrow with its number
        assert levels(axes) == ({-bound, bound} if near else set())
        assert [text.get_text() for text in axes.texts] == [
            "published bound" if near else f"published bound ±{bound:g} ↕"
        ]
        assert axes.get_ylim()[1] < 4 * data
    assert figure.get_suptitle() == f"{design.spec.name}, fidelity dq: stroke of 10 mm"
    assert figure.texts[-1].get_text().startswith("rise 1")
    force = replace(Scenario.stroke(), fidelity="force")
    coarse = report.stroke_figure(malta.simulate(design.plant, design.controller, force))
    assert coarse.get_suptitle() == f"{design.spec.name}, fidelity force: stroke of 10 mm"
    assert not any(levels(axes) for axes in coarse.axes)


@pytest.mark.slow
def test_the_stroke_figure_reads_currents_as_thrust(design: Design, tmp_path: Path) -> None:
    """Two modules of 5.2 N/A each, as Fig. 12(d)."""
    run = malta.simulate(design.plant, design.controller, Scenario.stroke())
    figure = report.stroke_figure(run)
    drawn(figure, tmp_path)
    current = figure.axes[5]
    (thrust,) = current.child_axes
    assert thrust.get_ylabel() == "thrust f_D [N]"
    assert np.allclose(thrust.get_ylim(), 10.4 * np.array(current.get_ylim()))


def test_a_figure_of_a_failed_run_says_so(designs: dict[str, Design]) -> None:
    design = designs["table2"]
    heavy = malta.plant_of(replace(design.spec.parameters, m=0.56))
    run = malta.simulate(heavy, design.controller, Scenario.stroke())
    figure = report.stroke_figure(run)
    assert "touchdown at sensor plane 1 at" in figure.get_suptitle()
    assert "stroke of 10 mm" in figure.get_suptitle()  # the one asked for
    assert "rise" not in figure.texts[-1].get_text()
    low, high = figure.axes[0].get_ylim()
    assert low < -5 < 5 < high


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_same_figure_gives_the_same_bytes(design: Design, tmp_path: Path, suffix: str) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke())
    for name in "ab":
        report.stroke_figure(run, path=tmp_path / f"{name}{suffix}")
    first, second = ((tmp_path / f"{name}{suffix}").read_bytes() for name in "ab")
    assert first == second
    assert len(first) > 10_000


def test_unknown_kinds_of_figures_are_refused(design: Design, tmp_path: Path) -> None:
    run = malta.simulate(design.plant, design.controller, Scenario.stroke(duration=0.005))
    with pytest.raises(malta.InputError, match=r"suffix '\.gif', expected one of \.png, \.svg"):
        report.stroke_figure(run, path=tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_stroke_is_drawn_whole_and_saved_only_where_a_path_is_given(
    designs: dict[str, Design], published: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a payload the error leaves the published bounds; the axes grow with it."""
    design = designs["calibrated"]
    heavy = malta.plant_of(replace(design.spec.parameters, m=0.56))
    run = malta.simulate(heavy, design.controller, Scenario.stroke())
    figure = report.stroke_figure(run, published)
    assert figure.axes[2].get_ylim()[1] > 1.8
    assert figure.axes[1].get_ylim()[1] > 100
    monkeypatch.chdir(tmp_path)
    shown = malta.report.stroke_figure(run)
    assert not list(tmp_path.iterdir())  # a path is named by who wants a file
    shown = malta.report.stroke_figure(run, path=tmp_path / "build" / "stroke.png")
    assert shown._repr_png_() == (tmp_path / "build" / "stroke.png").read_bytes()  # type: ignore[attr-defined]


def test_a_figure_of_the_version_before_says_its_new_name(
    designs: dict[str, Design], tmp_path: Path, published: dict[str, Any]
) -> None:
    """Its second argument was the path."""
    design = designs["calibrated"]
    run = malta.simulate(design.spec.plant, design.controller, Scenario.stroke(duration=0.05))
    new = malta.report.stroke_figure(run, published, tmp_path / "new.png")
    with pytest.warns(
        DeprecationWarning, match=r"malta.report.stroke goes: write malta.report.stroke_figure"
    ):
        old = malta.report.stroke(run, tmp_path / "old.png", published)
    assert len(old.axes) == len(new.axes)
    assert (tmp_path / "old.png").read_bytes() == (tmp_path / "new.png").read_bytes()


# --- experiments ---


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_a_figure_that_says_what_drew_it(
    name: str, flown: Flown, pictured: Pictured, published: dict[str, Any], tmp_path: Path
) -> None:
    figure, content = pictured("calibrated", name)
    assert content == drawn(report.experiment_figure(flown("calibrated", name), published), tmp_path)
    assert defects(figure) == []
    fidelity = "dq and phase" if name == "faults" else "dq"  # an open phase is none of dq
    assert figure.get_suptitle().startswith(f"calibrated, fidelity {fidelity}: ")
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert label == "" or label.endswith("]")
        assert axes.has_data()
    shown = [axes for axes in figure.axes if axes.get_xlabel()]
    assert len(shown) >= len(figure.axes) / 4  # the lowest of panels that share their time
    assert sum(not axes.get_ylabel() for axes in figure.axes) == name.endswith(
        "faults"
    )  # its bars have names


LONG = ("commissioning", "supervised-faults", "record-v0", "lift-off", "capture")  # of many flights each


QUICK = [name for name in EXPERIMENTS if name not in LONG]
FLOWN = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in EXPERIMENTS if name in LONG)]


@pytest.mark.slow_for("stroke", "hold", "tilt", "payload", "disturbance", "faults", "drive-limits", "carrier")
@pytest.mark.parametrize("name", QUICK)
def test_nothing_in_a_figure_overlaps_or_is_cut_off(name: str, pictured: Pictured) -> None:
    """Panels, axis labels, titles and legends: none lies on another, none leaves the page. See test_figures, too."""
    figure, _ = pictured("table2", name)
    texts = [*figure.texts, *figure.legends]
    boxes: list[tuple[str, int | None, Any]] = [(str(text), None, text.get_window_extent()) for text in texts]
    for n, axes in enumerate(figure.axes):
        boxes.append((f"panel {n}", n, axes.get_window_extent()))
        for side in (axes.xaxis, axes.yaxis, *(child.yaxis for child in axes.child_axes)):
            box = side.get_tightbbox()
            boxes += [(f"{side} of panel {n}", n, box)] if box is not None else []
        legend = axes.get_legend()
        if legend is not None:
            boxes.append((f"legend of panel {n}", None, legend.get_window_extent()))
    page = figure.bbox
    for what, _, box in boxes:
        assert box.x0 >= page.x0 - 1, what
        assert box.y0 >= page.y0 - 1, what
        assert box.x1 <= page.x1 + 1, what
        assert box.y1 <= page.y1 + 1, what
    for (what, panel, one), (that, other_panel, other) in combinations(boxes, 2):
        wide = min(one.x1, other.x1) - max(one.x0, other.x0)
        high = min(one.y1, other.y1) - max(one.y0, other.y0)
        if panel is None or panel != other_panel:  # a panel meets its own axes
            assert min(wide, high) < 2, f"{what} lies on {that}"


@pytest.mark.slow
def test_figures_hold_what_the_paper_prints(flown: Flown, published: dict[str, Any]) -> None:
    def of(name: str) -> Figure:
        return report.experiment_figure(flown("calibrated", name), published)

    assert [bounds(axes) for axes in of("stroke").axes] == [set(), {20.0}, {0.6}, set(), set(), set()]
    tilt = of("tilt")
    assert [levels(axes) for axes in tilt.axes] == [set(), set(), set(), {4.0}]
    ring = tilt.axes[2].lines[-1]
    assert np.allclose(np.hypot(ring.get_xdata(), ring.get_ydata()), 4.0)
    assert words(tilt) == ["published bound", "published bound"]
    sag, axial, largest, radial = of("payload").axes
    assert (bounds(axial), bounds(radial)) == ({0.6}, {20.0})
    assert (bounds(sag), bounds(largest)) == ({600.0}, {600.0})  # the clearance of the machine
    assert 200.0 in {float(np.asarray(line.get_xdata())[0]) for line in largest.lines}
    assert bounds(of("thermal").axes[1]) == {1.0}
    for name in EXPERIMENTS:  # and without it there is nothing to say
        assert not any(
            "published" in text for text in words(report.experiment_figure(flown("calibrated", name)))
        )


def test_the_histograms_stand_below_the_published_spread(flown: Flown, published: dict[str, Any]) -> None:
    e = flown("calibrated", "hold")
    figure = report.experiment_figure(e, published)
    for axes, merit, signal in zip(figure.axes, e.merits, e.run.plant.outputs, strict=False):
        lines: list[Any] = list(axes.lines)
        ours, theirs, actual = (line.get_xdata() for line in lines)
        mean, std = (published["table_III"][what][signal.name]["value"] for what in ("mean", "std"))
        assert np.allclose(theirs, [mean - std, mean, mean + std])
        assert np.isclose((ours[2] - ours[0]) / 2, merit.value * 1e6)
        assert (actual[2] - actual[0]) / 2 < 0.3 * merit.value * 1e6  # what moves, and not what is measured
        bars: list[Any] = list(axes.patches)
        measured, true = (patch.get_data() for patch in bars)
        for shares, edges, _ in (measured, true):
            assert np.isclose(shares.sum(), 100)
            assert np.allclose(np.diff(edges), edges[1] - edges[0])
        width = 1.0 if signal.name != "z" else 5.0  # the resolution; of the Hall sensors a third of the noise
        assert np.isclose(measured.edges[1] - measured.edges[0], width)
        assert np.array_equal(measured.edges, true.edges)  # shares in other bins cannot be compared
        heights = [line.get_ydata()[0] for line in lines]
        assert min(heights) > max(measured.values.max(), true.values.max())
        assert axes.get_ylim()[1] > max(heights)


def test_figures_hold_the_limits_of_the_machine(flown: Flown) -> None:
    lift = report.experiment_figure(flown("calibrated", "lift-off"))
    need = flown("calibrated", "lift-off").merits[0].value
    assert [levels(axes) for axes in lift.axes] == [{-600.0}, set(), {round(need, 6)}, set()]
    _, current, _, voltage = report.experiment_figure(flown("calibrated", "drive-limits")).axes
    assert levels(current) == {-5.0, -4.0, 4.0, 5.0}
    assert levels(voltage) == {-22.5, -15.75, 15.75, 22.5}
    bars, traces = report.experiment_figure(flown("calibrated", "faults")).axes
    assert levels(traces) == {600.0}
    assert [label.get_text() for label in bars.get_yticklabels()][7] == "y1 stuck"
    assert bars.texts[7].get_text().startswith("touchdown after")
    assert sum(line.get_marker() in ("o", "X") for line in bars.lines) == 13


def test_touchdowns_are_marked(flown: Flown, published: dict[str, Any]) -> None:
    """table2 carries 100 g; an axial push takes it to the end stop, a torque to the touchdown bearing."""
    payload = report.experiment_figure(flown("table2", "payload"), published)
    crosses = [[line for line in axes.lines if line.get_marker() == "X"] for axes in payload.axes]
    assert [len(found) for found in crosses] == [2, 0, 2, 0]
    assert [text.get_text() for text in payload.legends[0].get_texts()][-1] == "touchdown"
    pushed = report.experiment_figure(flown("table2", "disturbance"))
    legends = [axes.get_legend() for axes in pushed.axes]
    marked = [text.get_text() for legend in legends if legend for text in legend.get_texts()]
    assert {"touchdown", "axial end stop"} <= set(marked)


@pytest.mark.slow_for("stroke", "hold", "tilt", "payload", "disturbance", "faults", "carrier")
@pytest.mark.parametrize("name", [one for one in FLOWN if one != "drive-limits"])
def test_runs_that_end_early_are_drawn(
    name: str, designs: dict[str, Design], published: dict[str, Any], tmp_path: Path
) -> None:
    """A mover of 0.56 kg falls onto its bearing within 25 ms; where estimators are compared, one is enough."""
    design = designs["table2"]
    heavy = malta.plant_of(replace(design.spec.parameters, m=0.56))
    options: dict[str, Any] = {"estimator": "steady-state"} if name == "lift-off" else {}
    options |= SHORT["supervised-faults"] if name == "supervised-faults" else {}
    e = malta.experiment(name, heavy, design.controller, **options)
    assert not all(case.run.verdict.completed for case in e.cases)
    assert len(drawn(report.experiment_figure(e, published), tmp_path)) > 10_000
    printed(report.experiment_table(e, published))


@pytest.mark.slow
def test_an_interrupted_run_has_touched_nothing(flown: Flown, tmp_path: Path) -> None:
    e = flown("calibrated", "payload")
    broken = replace(e.run, verdict=Verdict("interrupted", float(e.run.t[-1])))
    figure = report.experiment_figure(replace(e, cases=(e.cases[0]._replace(run=broken),)))
    drawn(figure, tmp_path)
    assert not any(line.get_marker() == "X" for axes in figure.axes for line in axes.lines)


@pytest.mark.slow
def test_one_case_is_an_experiment_too(flown: Flown, published: dict[str, Any], tmp_path: Path) -> None:
    """As after Ctrl-C, or where an option leaves one choice."""
    for name in EXPERIMENTS:
        e = flown("calibrated", name)
        first = replace(e, cases=e.cases[:1])
        drawn(report.experiment_figure(first, published), tmp_path)
        assert first.cases[0].merits[0].label.split()[0] in printed(report.experiment_table(first, published))


def test_long_lines_keep_their_peaks(flown: Flown) -> None:
    e = flown("calibrated", "thermal")
    space = report.experiment_figure(e).axes[0]
    line = next(line for line in space.lines if "not compensated" in str(line.get_label()))
    whole = (e.cases[1].run.p[:, 2] + e.curves["drift"]) * 1e6
    y = np.asarray(line.get_ydata(), dtype=float)
    assert len(y) <= figures.POINTS + 2 < len(whole)
    assert (y.min(), y.max(), y[-1]) == (whole.min(), whole.max(), whole[-1])


@pytest.mark.slow
def test_experiments_are_saved_where_a_path_is_given(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report.experiment_figure(flown("table2", "payload"))
    assert not list(tmp_path.iterdir())
    for name in "ab":
        report.experiment_figure(flown("table2", "hold"), path=tmp_path / f"{name}.svg")
    svg = (tmp_path / "a.svg").read_text()
    assert svg == (tmp_path / "b.svg").read_text()
    assert ">2000 samples" in svg or "2000 samples at rest" in svg
    unknown = replace(flown("table2", "hold"), name="lunch")
    with pytest.raises(malta.InputError, match="'lunch', expected one of stroke, hold, tilt"):
        report.experiment_figure(unknown)


@pytest.mark.slow
def test_importing_the_report_does_not_wait_for_matplotlib() -> None:
    code = "import sys, malta.report; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("design", "name"),
    [
        *((design, name) for name in QUICK for design in DESIGNS),
        *(pytest.param("calibrated", name, marks=pytest.mark.slow) for name in EXPERIMENTS if name in LONG),
    ],
)
def test_the_table_of_an_experiment_fits_and_names_its_merits(
    name: str, design: str, flown: Flown, published: dict[str, Any]
) -> None:
    e = flown(design, name)
    text = printed(report.experiment_table(e, published))
    assert e.question in text
    assert "nan" not in text
    flat = " ".join(text.split())
    for merit in e.merits:
        unit = {"percent": "%", "1": ""}.get(merit.unit, merit.unit)
        assert micro(f"{merit.label} [{unit}]" if unit else merit.label) in flat
    ended = [
        case for case in e.cases if not case.run.verdict.completed
    ]  # how is said where one did not go to its end
    if len(e.cases) > 1:
        for case in e.cases:
            assert micro(case.label) in flat
        for case in e.cases if ended else ():
            assert f"{case.run.verdict.time * 1e3:.1f}" in flat
    assert ("published" in text) == any(m.published for m in (*e.merits, *e.cases[0].merits))
    assert "published" not in printed(report.experiment_table(e))
    assert_folds(report.experiment_table(e, published), 80, 60, 40)


def test_tables_show_what_the_paper_prints(flown: Flown, published: dict[str, Any]) -> None:
    def rows(name: str) -> dict[str, list[str]]:
        lines = printed(report.experiment_table(flown("calibrated", name), published)).splitlines()
        return {line.split("]")[0].strip(): line.split("]")[-1].split() for line in lines}

    stroke = rows("stroke")
    assert stroke["rise, 10-90 % [ms"] == ["15.76", "16.2"]
    assert stroke["overshoot [%"] == ["0", "<=", "1.5"]
    assert stroke["deviation y1 [µm"][1:] == ["<=", "20"]
    assert stroke["deviation x1 [µm"] == ["0", "<=", "20"]  # 1e-36 m
    assert stroke["drive constant per module, f / i [N/A"] == ["5.200", "5"]
    assert rows("hold")["measured x1, std [µm"][1] == "0.3883"
    assert rows("payload")["largest of these carried and moved [kg"] == ["0.2000", "0.2"]
    tilt = printed(report.experiment_table(flown("calibrated", "tilt"), published)).splitlines()
    assert next(line for line in tilt if "published" in line).split() == ["published", "<=", "4", "<=", "4"]


def test_tables_of_cases(flown: Flown, published: dict[str, Any]) -> None:
    """A row for each, a column for each where there is much to say, a list where they are asked different things."""
    faults = printed(report.experiment_table(flown("table2", "faults"), published))
    whole = next(line for line in faults.splitlines() if "one sample lost" in line)
    assert whole.split()[3:5] == ["completed", "300.0"]
    assert whole.split()[-2] == "-"  # no touchdown
    assert next(line for line in faults.splitlines() if "survived, of 13" in line).split()[-1] == "10"
    limits = printed(report.experiment_table(flown("table2", "drive-limits"), published)).splitlines()
    assert next(line for line in limits if "fastest " in line).split() == ["figure", "fastest", "sigmoid"]
    pushes = printed(report.experiment_table(flown("table2", "disturbance"), published))
    assert "axial end stop at 130" in " ".join(pushes.split())


def test_units_and_missing_figures(flown: Flown, published: dict[str, Any]) -> None:
    merits = (
        Merit("never reached", math.nan, "ms", "figure_12.rise_time"),
        Merit("compliance", 52.2e-6, "um/N"),
        Merit("stiffness", 19.1e3, "N/um"),
        Merit("mass", 0.15, "kg"),
        Merit("share", 0.0123, "percent", "figure_12.overshoot", "at most"),
        Merit("ratio", 1.2315, "1"),
        Merit("count", 11.0, "1"),
        Merit("beyond", math.inf, "ms"),
    )
    run = flown("table2", "hold").run
    e = Experiment("hold", "What?", (Case("hold", run, merits),), merits)
    text = printed(report.experiment_table(e, published))
    found = [line.split() for line in text.splitlines()[4:] if line.strip()]
    assert found == [
        ["never", "reached", "[ms]", "-", "16.2"],
        ["compliance", "[µm/N]", "52.20"],
        ["stiffness", "[N/µm]", "0.01910"],
        ["mass", "[kg]", "0.1500"],
        ["share", "[%]", "1.230", "<=", "1.5"],
        ["ratio", "1.232"],
        ["count", "11"],
        ["beyond", "[ms]", "inf"],
    ]
    wrong = Experiment("hold", "What?", e.cases, (Merit("a", 1.0, "m", "figure_99.nothing"),))
    with pytest.raises(malta.InputError, match=r"figure_99\.nothing: found nothing, expected what the paper"):
        report.experiment_table(wrong, published)


def test_units_survive_a_console_with_markup(flown: Flown, published: dict[str, Any], design: Design) -> None:
    """To rich, [ms] is a style; notebooks print with its defaults."""
    buffer = io.StringIO()
    console = Console(file=buffer, width=100)
    console.print(report.experiment_table(flown("table2", "stroke"), published))
    console.print(report.experiment_table(flown("table2", "payload"), published))
    console.print(report.poles_table(design.model, published))
    text = buffer.getvalue()
    for wanted in ("[ms]", "[%]", "[N/A]", "[kg]", "[rad/s]"):
        assert wanted in text


def test_cases_that_broke_off_leave_gaps(flown: Flown) -> None:
    """The shorter of two cases says nothing of the stroke that it did not see."""
    e = flown("calibrated", "payload")
    short = e.cases[0]._replace(
        run=replace(e.run, verdict=Verdict("interrupted", 0.1)), merits=e.cases[0].merits[:1]
    )
    lines = printed(report.experiment_table(replace(e, cases=(short, *e.cases[1:])))).splitlines()
    row = next(line for line in lines if "interrupted" in line).split()
    assert row[:4] == ["50", "g", "interrupted", "100.0"]
    assert row[-2:] == ["-", "-"]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (16.1326, 4, "16.13"),
        (399.04, 4, "399.0"),
        (15001.2, 4, "15001"),
        (0.08292, 4, "0.08292"),
        (0.0022113, 4, "0.00221"),
        (-0.0045, 4, "-0.00450"),
        (2.5e-29, 4, "0"),
        (0.0, 3, "0"),
        (math.nan, 4, "-"),
        (-math.inf, 4, "-inf"),
    ],
)
def test_numbers_are_written_without_exponents(value: float, digits: int, text: str) -> None:
    assert figures.number(value, digits) == text


LEDGER = Ledger(
    "tubular",
    "A. Author, 2021",
    ("table2", "calibrated", "a_design_of_a_long_name"),
    (
        LedgerClaim(
            "poles of x, y [rad/s]",
            "±218.92",
            ("±218.92", "±218.93", "1"),
            "not reproduced; " + "said at length, " * 9,
            "differs",
        ),
        LedgerClaim(
            "a claim with a subject that is longer than its line [N m/rad]",
            "–",
            ("1", "2", "3"),
            "ours",
            "ours",
        ),
    ),
)


@pytest.mark.parametrize("width", [80, 100, 200])
def test_a_claim_has_its_whole_name_on_the_terminal_and_its_figures_in_one_line(width: int) -> None:
    def lines(*, why: bool) -> list[str]:
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(report.claims_table(LEDGER, why=why))
        return console.export_text().splitlines()

    found = lines(why=False)
    assert found[0] == "Published numbers and ours: tubular, A. Author, 2021"
    assert max(map(len, found)) <= width
    blocks = 1 if width > 80 else 2  # of designs beside each other
    long = LEDGER.claims[1].subject
    more = 0 if width == 200 else 1  # lines of its name
    assert len(found) == 1 + blocks * (3 + len(LEDGER.claims) + more)
    assert next(line for line in found if line.startswith("poles")).split()[5] == "±218.92"
    assert [line.split()[-1] for line in found if line.endswith((" differs", " ours"))] == [
        "differs",
        "ours",
    ] * blocks
    assert all(line.split()[-2] in "123" and "rad] " in line for line in found if line.endswith(" ours"))
    assert all(word in " ".join(found).split() for word in long.split())
    assert "said" not in "".join(found)
    whole = " ".join(" ".join(lines(why=True)).split())
    assert whole.count(LEDGER.claims[0].verdict.strip()) == blocks
    assert "…" not in whole
