"""Every figure: nothing empty, nothing on top of something else, every input drawn, readable in grey."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT
from figure_checks import defects, texts_of

import malta
from malta import report
from malta.cli.options import read_shares
from malta.errors import InputError
from malta.model.signal_groups import outputs_of
from malta.report import encode_figure, figures, new_figure
from malta.report.page import document
from malta.simulation.experiments import Case, Experiment
from malta.simulation.experiments.catalogue import experiments_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes

    from malta.campaigns.result import Campaign

SHORT: dict[str, dict[str, Any]] = {"capture": {"points": 9}, "supervised-faults": {"only": "stuck"}}

X = np.linspace(0, 1, 50)


def _plain(axes: Axes) -> None:
    axes.plot(X, X, color="#000000")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("height [m]")


def _bare(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.set_ylim(2, 8)
    axes.yaxis.set_minor_formatter("")


def _alike(axes: Axes) -> None:
    axes.plot(X, X**2, label="a", color="#c1440e")
    axes.plot(X, X**3, label="b", color="#1f77b4", linestyle="-")
    axes.lines[0].set_label("c")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 0.6), ncols=3)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda axes: axes, []),
        (lambda axes: axes.lines[0].remove(), ["panel 0 is empty"]),
        (lambda axes: axes.set_ylabel("height"), ["the y axis of panel 0 has no unit: 'height'"]),
        (_bare, ["the y axis of panel 0 has no number at its ticks"]),
        (_alike, ["'a' and 'b' look alike without colour"]),
        (lambda axes: axes.plot(X, X, color="#000000"), ["panel 0 draws one line twice: '_child0' and '_child1'"]),
        (lambda axes: axes.plot(X, X**2, "--"), ["panel 0 has 2 looks of lines without a name"]),
        (lambda axes: axes.text(0.5, 0.45, "here"), ["'here' in panel 0 is crossed by a line"]),
        (lambda axes: axes.text(0.5, 1.9, "up"), ["'up' of panel 0 leaves the page"]),
        (lambda axes: axes.set_title("a title\n", fontsize=15), ["'found' of found lies on 'a title\\n' of panel 0"]),
    ],
)  # fmt: skip
def test_the_checks_find_what_is_wrong(spoil: Callable[[Axes], object], said: list[str]) -> None:
    figure = new_figure("title", "found", size=(4.5, 3.0), left=0.2, bottom=0.2)
    _plain(figure.subplots())
    spoil(figure.axes[0])
    assert defects(figure) == said


# --- experiments ---


@cache
def machine(name: str) -> tuple[malta.model.Plant, malta.synthesis.Controller, Any]:
    """The plant and the controller of a shipped gain file, and what its paper prints."""
    c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    plant = malta.plant_of(c.parameters)
    kind = next((kind for kind in ("halbach", "planar") if name.startswith(kind)), "tubular")
    return plant, c, malta.model.read_published(ROOT / "data" / f"{kind}.toml")


def drawn_experiments() -> list[Any]:
    """Every experiment of a design of the other machines; those of `tubular` are in test_report."""
    return [(name, one) for name in ("halbach", "planar") for one in experiments_of(machine(name)[0])]


@pytest.mark.slow
@pytest.mark.parametrize(("design", "name"), drawn_experiments())
def test_nothing_is_wrong_with_the_figure_of_an_experiment(design: str, name: str) -> None:
    plant, c, published = machine(design)
    e = malta.experiment(name, plant, c, **SHORT.get(name, {}))
    assert defects(report.experiment_figure(e, published)) == []


@cache
def run_of(name: str) -> Experiment:
    """The first run of a machine's first experiment, as an experiment without a figure of its own."""
    plant, c, _ = machine(name)
    run = malta.experiment(next(iter(experiments_of(plant))), plant, c).run
    return Experiment("run", "A run", (Case("a", run, ()),), ())


@pytest.mark.slow_for("calibrated", "halbach")
@pytest.mark.parametrize("name", ["calibrated", "halbach", pytest.param("planar", marks=pytest.mark.slow)])
def test_a_run_is_drawn_with_every_input_and_output(name: str) -> None:
    figure = report.experiment_figure(run_of(name))
    assert defects(figure) == []
    written = " ".join(texts_of(figure))
    plant = run_of(name).run.plant
    assert [s.name for s in (*plant.inputs, *plant.outputs) if s.name not in written] == []
    assert len(outputs_of(plant)) <= len([axes for axes in figure.axes if axes.get_visible()])


def test_many_inputs_are_drawn_as_a_band() -> None:
    """Of twenty inputs no line is dropped: the band reaches from the least to the largest of all."""
    run = run_of("calibrated").run
    count = 20
    pushed = np.sin(np.outer(run.t, np.arange(1, count + 1))) * np.linspace(1, 3, count)
    inputs = tuple(run.plant.inputs[0]._replace(name=f"coil {k}") for k in range(count - 1))
    plant = replace(run.plant, inputs=(*inputs, run.plant.inputs[-1]))
    e = Experiment("run", "A run", (Case("a", replace(run, plant=plant, v=pushed), ()),), ())
    force = next(axes for axes in report.experiment_figure(e).axes if "force" in axes.get_ylabel())
    (band,) = force.collections
    assert str(band.get_label()) == f"all {count}, least to largest"
    heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
    assert (heights.min(), heights.max()) == (pushed.min(), pushed.max())
    assert len(force.lines) == 3


# --- campaigns, margins, loads ---


def campaign_of(name: str, scenario: str, samples: int, share: float = 1.0, **options: Any) -> Campaign:
    """A campaign over the box of a shipped gain file."""
    plant, c, _ = machine(name)
    box = read_shares(ROOT / "design" / "gains" / f"{name}.json", [], plant.parameters)
    spread = {key: share * value for key, value in box.items()}
    return malta.campaign(malta.campaigns.Plan(c, scenario, spread, samples=samples, **options))


def test_a_campaign_without_failures_shows_how_near_they_are() -> None:
    """A jump of the reference is no merit, what is the same in every run no distribution, 100 % no picture."""
    drawn = report.campaign(campaign_of("halbach", "step", 16), published=machine("halbach")[2])
    written = texts_of(drawn.distributions)
    assert any("deviation of x: the jump of the reference itself, 100 µm" in text for text in written)
    assert any("limited commands: 0 % in every run" in text for text in written)
    assert len(drawn.distributions.axes) == 2
    title, *_ = (text for text in texts_of(drawn.endings) if text.startswith("all 16 runs completed"))
    assert "nearest: run" in title
    assert all(patch.get_label() != "completed" for axes in drawn.endings.axes for patch in axes.patches)
    far = drawn.worst.axes[1]
    dots = [float(np.asarray(line.get_xdata())[0]) for line in far.lines if line.get_marker() == "o"]
    low, high = far.get_xlim()
    assert np.ptp(dots) > 0.2 * (high - low)  # eight marks that can be told apart


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "scenario", "samples", "share"),
    [
        ("calibrated", "stroke", 200, 1.0),
        ("table2", "stroke", 200, 1.0),
        ("calibrated", "hold", 60, 3.0),
        ("planar", "step", 40, 1.0),
        ("halbach_pid", "step", 40, 1.0),
        ("calibrated", "hold", 1, 1.0),
    ],
)
def test_nothing_is_wrong_with_the_figures_of_a_campaign(
    name: str, scenario: str, samples: int, share: float
) -> None:
    for figure in report.campaign(campaign_of(name, scenario, samples, share), published=machine(name)[2]):
        assert defects(figure) == []


@pytest.mark.slow
@pytest.mark.usefixtures("proven_once")
@pytest.mark.parametrize("name", ["table2", "halbach"])
def test_nothing_is_wrong_with_the_figures_of_margins_and_loads(name: str) -> None:
    plant, c, _ = machine(name)
    box = read_shares(ROOT / "design" / "gains" / f"{name}.json", [], plant.parameters)
    found = malta.verify(plant, c, box, stages=True, worst_case=False)
    assert defects(report.chain_figure(found)) == []
    assert defects(report.recovery_figure(plant, c)) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["ball/design/ball", "ball/design/ball_pid", "rotor/design/rotor", "rotor/design/rotor_pid"]
)
def test_nothing_is_wrong_with_the_figures_of_machines_of_ones_own(name: str) -> None:
    """Without figures of their own: with and without a stroke, one input or several, one output or four."""
    spec = malta.read_design(ROOT / "examples" / f"{name}.toml")
    c = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at(**spec.operating_point)))
    for experiment in experiments_of(spec.plant):
        assert defects(report.experiment_figure(malta.experiment(experiment, spec.plant, c))) == []
    assert defects(report.recovery_figure(spec.plant, c)) == []


@pytest.mark.slow_for("pdf")
@pytest.mark.parametrize("end", ["png", "svg", "pdf"])
def test_a_dollar_in_a_name_begins_no_formula(end: str) -> None:
    r"""Names of signals come from files: `a$x_{$` is no TeX, and `\frac` is not read."""
    figure = new_figure("a$x_{$ and $\\frac$", "found $_{$")
    axes = figure.add_subplot()
    axes.loglog([1.0, 1e3], [1.0, 10.0], label="y$^{$")
    axes.set_ylabel("y$^{$ [m]")
    axes.legend()
    content = encode_figure(figure, Path(f"figure.{end}"))
    assert len(content) > 1000
    if end == "svg":
        assert "a$x_{$ and $\\frac$" in content.decode()
        assert ">$\\mathdefault" not in content.decode()  # ticks are drawn as powers


def _rows(*names: str) -> Any:
    """Colours of six hexadecimal digits as rows of red, green, blue from 0 to 1."""
    return np.array([[int(name.lstrip("#")[k : k + 2], 16) for k in (0, 2, 4)] for name in names]) / 255


def _contrast(rows: Any, paper: str) -> Any:
    """Contrast of colours with a page, 1 to 21, as WCAG 2 has it."""
    low, high = np.sort(
        [document.luminance(rows), np.full(len(rows), document.luminance(_rows(paper))[0])], axis=0
    )
    return (high + 0.05) / (low + 0.05)


def test_lines_are_told_apart_without_colour() -> None:
    """By dash, or by steps of lightness, on a light page and on a dark one; a light grid or fill is no line."""
    styles = (*figures.STYLES, *figures.MORE_STYLES)
    assert len({(style["color"], style["linestyle"]) for style in styles}) == len(styles)
    light = _rows(*dict.fromkeys(style["color"] for style in styles))
    for rows, paper, least in ((light, "ffffff", 13.0), (document.dark_colours(light), "1a1a1a", 11.0)):
        assert np.abs(np.diff(np.sort(document.lightness(rows)))).min() > least
        assert _contrast(rows, paper).min() > 3  # of graphical objects
    assert document.lightness(_rows("777777"))[0] == pytest.approx(
        50.03, abs=0.01
    )  # CIE 1976, published sRGB table


def test_lines_of_the_live_page_are_told_apart_without_colour() -> None:
    """Lines of one dash, the first and the fifth and so on, by lightness."""
    css = (ROOT / "malta" / "app" / "static" / "app.css").read_text(encoding="utf-8")
    for theme in re.findall(r"--card: (#\w+);.*?(--c0:.*?) color-scheme", css, re.DOTALL):
        card = theme[0] if len(theme[0]) == 7 else "#" + "".join(2 * letter for letter in theme[0][1:])
        rows = _rows(*re.findall(r"--c\d: #(\w{6});", theme[1]))
        assert len(rows) == 8
        assert _contrast(rows, card).min() > 3
        bright = document.lightness(rows)
        assert np.abs(bright[:4] - bright[4:]).min() > 15


def test_a_dark_figure_is_one_in_each_form(tmp_path: Path) -> None:
    """Paper and ink change places in a picture and in vectors; on paper nothing is dark."""
    figure = report.new_figure("dark", size=(3.0, 2.0))
    figure.subplots().plot([0, 1], [0, 1], **figures.STYLES[1])
    light, dark = (_pixels(report.encode_figure(figure, Path("a.png"), dark=dark)) for dark in (False, True))
    for picture, page in ((light, 255), (dark, 0x1A)):
        assert (picture == page).all(axis=2).mean() > 0.8
    assert len(np.unique(dark.reshape(-1, 3), axis=0)) > 20  # smooth edges stay
    svg = report.encode_figure(figure, Path("a.svg"), dark=True).decode()
    assert "prefers-color-scheme" not in svg
    assert f"stroke:{document.dark_colour('7d2906')}" in svg
    with pytest.raises(InputError, match="dark figure on paper"):
        report.save(figure, tmp_path / "a.pdf", dark=True)


def _pixels(png: bytes) -> Any:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
