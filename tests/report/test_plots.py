"""Plots of loops: what they draw, where margins are marked, and that nothing of them overlaps; `malta plot`."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import control
import jsonschema
import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence
from figure_checks import defects, texts_of
from matplotlib.figure import Figure
from matplotlib.text import Text

import malta
from malta import report
from malta.cli.documents.published import output_schema
from malta.loops.curves import LoopCurves, loop_curves
from malta.loops.locus import root_locus
from malta.margins.margin_map import margin_map_of
from malta.model.signal_groups import axis_units
from malta.report.plots.plane import Window, branch_paths
from malta.synthesis.curve_limits import curve_limits
from malta.synthesis.recovery import RecoveryBound
from malta.tuning.judging import judge

if TYPE_CHECKING:
    from matplotlib.axes import Axes

s = control.tf("s")
GAINS = ROOT / "design" / "gains"
PLOTS = (
    report.bode,
    report.nyquist,
    report.nichols,
    report.sigma,
    report.sensitivity_curves,
    report.gang_of_four,
    report.step,
    report.pzmap,
)


@cache
def shipped(name: str) -> LoopCurves:
    controller = malta.gains.read(GAINS / f"{name}.json")
    return loop_curves(malta.plant_of(controller.parameters), controller)


@pytest.fixture(scope="module")
def robust() -> LoopCurves:
    return shipped("robust")


@pytest.fixture(scope="module")
def unstable() -> dict[str, Any]:
    """An unstable open loop, closed with enough gain and with too little."""
    return {"enough": loop_curves(3 / (s - 1)), "too little": loop_curves(0.5 / (s - 1))}


def lines(axes: Axes) -> list[np.ndarray[Any, Any]]:
    """The data of all lines, k x 2 each."""
    return [np.asarray(line.get_xydata(), dtype=float) for line in axes.lines]


def near(axes: Axes, x: float, y: float, rel: float = 1e-3) -> bool:
    """Whether a marker or the end of a segment stands at a place."""
    short = [xy for xy in lines(axes) if len(xy) < 3]
    return any(np.allclose(point, (x, y), rtol=rel, atol=rel) for xy in short for point in xy)


@pytest.mark.slow_for("bode", "sigma", "sensitivity_curves", "gang_of_four")
@pytest.mark.parametrize("draw", PLOTS, ids=lambda draw: draw.__name__)
def test_plots_of_stable_and_unstable_loops_have_no_defects(draw: Any, unstable: dict[str, Any]) -> None:
    figure = draw(unstable)
    assert isinstance(figure, Figure)
    assert defects(figure) == []
    assert all(np.isfinite(xy).all(axis=1).any() for axes in figure.axes for xy in lines(axes))


@pytest.mark.slow
@pytest.mark.parametrize("draw", [*PLOTS, report.load_response], ids=lambda draw: draw.__name__)
@pytest.mark.parametrize(
    "names", [("robust", "tubular_pid"), ("halbach",), ("planar", "planar_pid")], ids=lambda names: names[0]
)
def test_plots_of_every_machine_have_no_defects(draw: Any, names: tuple[str, ...]) -> None:
    assert defects(draw({name: shipped(name) for name in names})) == []


@pytest.mark.slow
def test_loads_are_drawn_without_defects(robust: LoopCurves) -> None:
    figure = report.load_response(robust)
    assert defects(figure) == []
    assert len(figure.axes) == 2 * 5  # T_z turns the mover about its axis, which no output reads


@pytest.mark.slow
def test_names_are_drawn_as_they_are() -> None:
    """No formula of $, no markup; names of any length leave room."""
    names = ["$a_1$ <b>", "ε" * 70, "c", "d", "e"]
    figure = report.bode({name: control.tf([k], [1, 1, 0]) for k, name in enumerate(names, 2)})
    assert defects(figure) == []
    assert any("$a_1$ <b>" in text for text in texts_of(figure))


def test_margins_are_marked_on_the_bode_plot() -> None:
    L = 1 / (s * (s + 1) * (s + 2))
    upper, lower = report.bode(L).axes
    gain, phase, at_gain, at_phase = control.margin(L)
    assert near(upper, at_gain, -20 * math.log10(gain))
    assert near(upper, at_phase, 0)
    assert near(lower, at_phase, phase - 180)
    curve = lines(upper)[0]
    assert np.interp(1.0, *curve.T) == pytest.approx(20 * math.log10(abs(L(1j))), abs=0.01)
    phases = lines(lower)[0]
    assert np.interp(1.0, *phases.T) == pytest.approx(math.degrees(np.angle(L(1j))), abs=0.1)


def test_both_sides_of_the_gain_margin_are_marked(unstable: dict[str, Any]) -> None:
    (axes,) = report.nyquist(unstable["enough"]).axes
    assert near(axes, -3, 0)
    text = " ".join(texts_of(axes.figure))  # type: ignore[arg-type]
    assert "N 1, P 1" in text
    assert "GM −9.5 … ∞" in text
    assert "UNSTABLE; N 0, P 1" in " ".join(texts_of(report.nyquist(unstable["too little"])))


def test_the_circle_of_the_peak_touches_the_nyquist_curve() -> None:
    L = 1 / (s * (s + 1) * (s + 2))
    found = loop_curves(L)
    radius = 1 / found.margins[0].peak_sensitivity
    drawn = [xy[:, 0] + 1j * xy[:, 1] for xy in lines(report.nyquist(found).axes[0])]
    circle = next(line for line in drawn if np.allclose(np.abs(line + 1), radius))
    value = found.responses.L[:, 0, 0]
    assert np.abs(circle - value[:, None]).min() < 0.02
    assert np.abs(value + 1).min() >= radius - 1e-6


@pytest.mark.slow
def test_a_channel_and_axes_may_be_chosen(robust: LoopCurves) -> None:
    figure = Figure()
    axes = figure.subplots(2, 2)
    assert report.bode(robust, channel=["x1", "z"], axes=axes) is figure
    assert all(panel.lines for panel in axes.ravel())
    assert len(report.nyquist(robust, channel="z").axes) == 1
    assert len(report.bode(robust, at="forces").axes) == 10
    with pytest.raises(malta.InputError, match="axes: found 1, expected 2"):
        report.bode(robust, channel="z", axes=axes[0, 0])
    with pytest.raises(malta.InputError, match="'q', expected one of x1 y1 x2 y2 z"):
        report.step(robust, channel="q")
    with pytest.raises(malta.InputError, match="'here', expected sensors or forces"):
        report.bode(robust, at="here")  # type: ignore[arg-type]
    with pytest.raises(malta.InputError, match="loops: found none"):
        report.bode({})
    with pytest.raises(malta.InputError, match="no loads from outside"):
        report.load_response(control.tf([1], [1, 1]))


@pytest.mark.parametrize("name", ["halbach_pid", pytest.param("planar", marks=pytest.mark.slow)])
def test_a_root_locus_mirrors_and_its_branches_have_no_gaps(name: str) -> None:
    """Sampled loops: each branch has a mirror image among the branches, and no step in it is longer than a tenth."""
    controller = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    found = root_locus(malta.plant_of(controller.parameters), controller)
    assert found.sample_time is not None
    strip = np.pi / found.sample_time
    for row in found.poles:
        known = row[np.isfinite(row) & (row.real > -1.2 * strip)]
        mirrored = known.conj() + np.where(np.abs(known.imag) > 0.999 * strip, 2j * known.imag, 0)
        assert np.abs(known[:, None] - mirrored).min(axis=0).max(initial=0.0) < 1e-6 * strip
    for path in branch_paths(found):
        step = np.abs(np.diff(path))
        size = np.maximum(np.abs(path[1:]), 0.02 * strip)
        assert np.nanmax(step / size, initial=0.0) < 0.2


def test_a_margin_map_has_powers_of_ten_with_the_unit() -> None:
    """C is 20 millionths: beside the ticks the power would stand on the legend."""
    spec = malta.read_design("examples/ball/design/ball.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    figure = report.margin_map(margin_map_of(spec.plant, controller, ("m", "C"), {"m": 0.2, "C": 0.2}))
    (panel,) = figure.axes
    assert (panel.get_xlabel(), panel.get_ylabel()) == (
        "mass of the sphere m [kg]",
        "magnet constant C [1e-6 N m^2/A^2]",
    )
    figure.canvas.draw()
    assert panel.yaxis.get_offset_text().get_text() == ""
    assert "20" in [text.get_text() for text in panel.get_yticklabels()]


@pytest.mark.slow
def test_a_margin_map_proves_no_unstable_machine_and_meets_its_witness() -> None:
    """Two routes: no eigenvalue in the proven box is unstable, and the witness lies on the boundary that they show."""
    controller = malta.gains.read(GAINS / "halbach.json")
    plant, box = malta.plant_of(controller.parameters), {"m": 0.1, "A": 0.1}
    found = margin_map_of(plant, controller, ("m", "A"), box)
    X, Y = np.meshgrid(found.x_values, found.y_values)
    off = [np.abs(V - m) / h for V, m, h in zip((X, Y), found.nominal, found.half, strict=True)]
    inside = np.maximum(*off) <= found.proven * (1 - 1e-9)
    assert inside.sum() > 50
    assert found.growth[inside].max() < 0
    assert found.growth.max() > 0
    assert found.witness is not None
    near = np.hypot((X - found.witness[0]) / found.half[0], (Y - found.witness[1]) / found.half[1]) < 0.2
    assert found.growth[near].min() < 0 < found.growth[near].max()
    figure = report.margin_map(found)
    assert defects(figure) == []
    assert found.margin is not None
    low, high = found.margin.proven.percent(), found.margin.lost.percent()
    assert f"proven {low} of the box, lost at {high}" in " ".join(texts_of(figure))
    for names, what in ((("m", "q"), "--y"), (("m", "m"), "--y")):
        with pytest.raises(malta.InputError, match=what):
            margin_map_of(plant, controller, names, box)


def test_a_root_locus_leaves_the_axis_at_a_right_angle_and_ends_at_zeros() -> None:
    """(s + 3) / (s (s + 1)): a circle about the zero, of radius sqrt 6; one pole ends at -3, the other at infinity."""
    found = root_locus((s + 3) / (s * (s + 1)), span=(1e-3, 1e4))
    points = np.concatenate(branch_paths(found))
    circle = points[np.abs(points.imag) > 1e-9]
    assert np.abs(np.abs(circle + 3) - np.sqrt(6)).max() < 0.02
    assert np.abs(circle.imag).min() < 0.05
    assert np.abs(found.poles[-1] + 3).min() < 1e-3
    assert found.poles[-1].real.min() < -9e3


def test_a_root_locus_shows_its_ends_and_the_boundary() -> None:
    found = root_locus(1 / (s * (s + 1) * (s + 2)), span=(0.5, 10))
    figure = report.root_locus(found)
    assert defects(figure) == []
    assert "stability changes at gain = 6.000" in " ".join(texts_of(figure))
    drawn = np.vstack([xy for axes in figure.axes for xy in lines(axes)])
    for pole in (*found.poles[0], *found.poles[-1], *found.nominal_poles):
        assert np.hypot(*(drawn - [pole.real, pole.imag]).T)[np.isfinite(drawn).all(axis=1)].min() < 1e-9


@pytest.mark.slow
def test_plots_show_themselves_in_notebooks(unstable: dict[str, Any]) -> None:
    picture = report.sigma(unstable)._repr_png_()  # type: ignore[attr-defined]
    assert picture.startswith(b"\x89PNG")


# --- malta plot ---


@pytest.mark.slow
def test_the_command_writes_pictures_and_numbers(tmp_path: Path, run: Run) -> None:
    gains = str(GAINS / "halbach.json")
    said = run(
        "plot", gains, "bode", "pzmap", "rootlocus", "step", "--json", "--out", str(tmp_path),
        "--with", str(GAINS / "halbach_late.json"),
    )  # fmt: skip
    document = json.loads(said.out)
    assert said.code == 0
    jsonschema.validate(document, output_schema("plot-output"))
    names = [Path(file).name for file in document["files"]]
    assert names == ["halbach_bode.png", "halbach_pzmap.png", "halbach_rootlocus.png", "halbach_late_rootlocus.png",
                     "halbach_step.png"]  # fmt: skip
    assert all(Path(file).read_bytes().startswith(b"\x89PNG") for file in document["files"])
    first, second = document["loops"]
    margins = shipped("halbach").margins[0]
    assert first["margins"][0]["phase_rad"] == pytest.approx(margins.phase)
    assert len(first["bode"]["x"]["magnitude"]) == len(first["frequency_rad_per_s"])
    assert second["step"]["x"]["final"] == pytest.approx(1, abs=1e-6)
    assert document["root_loci"][0]["stability_changes"] == pytest.approx([margins.gain[1]], rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".svg", ".pdf"])
def test_a_picture_may_be_a_drawing(tmp_path: Path, run: Run, suffix: str) -> None:
    contents = []
    for name in "ab":
        path = tmp_path / f"{name}{suffix}"
        assert run("plot", str(GAINS / "halbach.json"), "nyquist", "--out", str(path)).code == 0
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["blode"], "'blode', expected one of bode nyquist"),
        (["bode", "--at", "here"], "--at: found 'here', expected sensors or forces"),
        (["bode", "--channel", "q"], "--channel: found 'q', expected one of x"),
        (["bode", "--out", "a.gif"], "--out: found a.gif, expected a folder, or a file .png"),
        (["bode", "step", "--out", "a.png"], "--out: found one file for 2 pictures, expected a folder"),
        (["bode", "--range", "1..2"], "--range: found no rootlocus"),
        (["rootlocus", "--range", "1-2"], "--range: found '1-2', expected LOW..HIGH"),
        (["rootlocus", "--range", "2..1..3"], "expected LOW..HIGH"),
        (["rootlocus", "--parameter", "q"], "--parameter: found 'q', expected one of gain A k m"),
        (
            ["rootlocus", "--parameter", "m", "--range", "0..2"],
            "m: found 0, expected a finite number above 0",
        ),
        (["rootlocus", "--parameter", "m", "--range", "1kg..2V"], "expected a unit of kg"),
        (["bode", "--with", str(GAINS / "halbach.json")], "the same gain file twice"),
    ],
    ids=lambda value: " ".join(value)[-40:] if isinstance(value, list) else "",
)
def test_bad_input_is_one_sentence(arguments: list[str], message: str, run: Run) -> None:
    said = run("plot", str(GAINS / "halbach.json"), *arguments)
    assert said.code == 2
    assert message in one_sentence(said.err)
    assert not said.out


@pytest.mark.slow
def test_an_unstable_loop_is_drawn_and_named(tmp_path: Path, run: Run) -> None:
    said = run(
        "plot", str(GAINS / "robust.json"), "step", "--channel", "z", "--set", "m=5.2", "--out", str(tmp_path / "a.png")
    )  # fmt: skip
    assert said.code == 0
    assert "robust: the loop is unstable" in said.err


@pytest.mark.parametrize("unstable", [0.0, 20.0])
def test_a_pole_map_holds_poles_of_little_damping(unstable: float) -> None:
    poles = np.array([-17.4 + 139.3j, -17.4 - 139.3j, -5.0, unstable])
    window = Window.about(poles, float(np.abs(poles).max()))
    assert len(window.inside(poles)) == len(poles)
    assert window.right - window.left == pytest.approx(2 * window.height)  # equal scales in a square


def test_a_constant_gain_is_a_straight_line() -> None:
    """|S| of -2 / (s + 1) is 1 at every frequency: the axis shows decibels, not the digits of rounding."""
    figure = malta.report.sigma(control.tf([-2], [1, 1]))
    low, high = figure.axes[1].get_ylim()
    assert low < -2 < 2 < high


@pytest.mark.parametrize(
    ("output", "force", "found"),
    [
        ("m", "N", ("um/N", "N/um", True)),
        ("1", "1", ("1", "1", False)),
        ("1", "V", ("1/V", "V", False)),
        ("m", "V", ("m/V", "V/m", False)),
    ],
)
def test_axes_of_any_unit_have_a_compliance(output: str, force: str, found: tuple[str, str, bool]) -> None:
    assert axis_units(output, force) == found


@pytest.mark.parametrize("bound", [1.5, 1.65])
def test_a_region_is_hatched_where_the_judge_fails(bound: float) -> None:
    """Bounds of the ball's design on either side of what it has: |S|, its disk about -1, T and a load's deviation."""
    spec = malta.read_design(ROOT / "examples" / "ball" / "design" / "ball.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    curves = loop_curves(spec.plant, controller)
    load = RecoveryBound("w largest", (1.0,), (0.0,), None, False, ("y",), "m", 220e-6 * bound)
    asked = {"peak_sensitivity": bound, "bandwidth": 240.0 * bound / 1.5, "recovery w largest": load.limit}
    named = replace(spec, specification=asked, recovery={"w largest": load})
    verdicts = {one.name: one.verdict for one in judge(named, controller)}
    limits = curve_limits(named)
    assert [one.curve for one in limits] == ["S", "T", "load"]
    for draw, entry in ((report.sensitivity_curves, "peak_sensitivity"), (report.nyquist, "peak_sensitivity"),
                        (report.load_response, "recovery w largest")):  # fmt: skip
        figure = draw(curves, limits=limits)
        drawn: list[Any] = [one for panel in figure.axes for one in (*panel.collections, *panel.patches)]
        regions = [one for one in drawn if one.get_hatch()]
        assert bool(regions) == (verdicts[entry] == "fails"), (draw, entry)
        word = "FAILS" if regions else "asked"
        words = next(one.words for one in limits if one.entry == entry)
        assert f"{words} {word}" in texts_of(figure)
    assert {verdicts["peak_sensitivity"], verdicts["recovery w largest"]} == {
        "holds" if bound > 1.6 else "fails"
    }


@pytest.mark.parametrize("channel", ["x1", "z"])
def test_no_curve_passes_the_name_of_a_nyquist_plots_region(channel: str) -> None:
    spec = malta.read_design(ROOT / "design" / "robust.toml")
    curves = loop_curves(spec.plant, malta.gains.read(GAINS / "robust.json"))
    figure = report.nyquist(curves, channel=channel, limits=curve_limits(spec))
    figure.draw_without_rendering()
    (panel,) = figure.axes
    (name,) = [text for text in panel.texts if text.get_text() == "peak sensitivity asked"]
    box = Text.get_window_extent(name)  # without its line to the disk
    for line in panel.lines:
        places = panel.transData.transform(np.column_stack(line.get_data()))
        between = np.linspace(places[:-1], places[1:], 50).reshape(-1, 2)
        assert not ((between > box.min) & (between < box.max)).all(axis=1).any()


@pytest.mark.parametrize(
    ("name", "known"),
    [
        (
            "robust",
            [
                "every 50 µs, 20 kHz",
                "delay 75 µs",
                "PI to 477 Hz",
                "|v| ≤ 52 N",
                "Kalman filter",
                "15 states",
            ],
        ),
        (
            "halbach_pid",
            ["every 55 ms, 18.2 Hz", "delay 27.5 ms", "filters of rates", "|v| ≤ 2 N", "noise 0.12 µm"],
        ),
        ("planar", ["every 200 µs, 5 kHz", "delay 1 sample"]),
    ],
)
def test_a_block_diagram_has_the_blocks_of_its_loop(name: str, known: list[str]) -> None:
    """Rates, delays, limits and noise are those of the gain file and its machine; every text is inside of its block."""
    controller = malta.gains.read(GAINS / f"{name}.json")
    figure = report.block_diagram(controller, malta.plant_of(controller.parameters))
    figure.draw_without_rendering()
    (axes,) = figure.axes
    texts = [text.get_text() for text in axes.texts]
    assert [text for text in known if text not in texts] == []
    frames = [patch.get_window_extent() for patch in axes.patches]
    assert len(frames) == 6
    for text in axes.texts:
        box = text.get_window_extent()
        middle = (box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2
        for frame in frames:
            if frame.contains(*middle):
                assert frame.x0 < box.x0
                assert box.x1 < frame.x1
                assert frame.y0 < box.y0
