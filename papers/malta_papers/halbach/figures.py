"""The figures of the experiments that replicate the paper's on the Halbach linear motor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from malta.machines.halbach.experiments import commanded_lift, lift_force
from malta.machines.halbach.figures import MARKERS
from malta.model import in_unit
from malta.report import STYLES
from malta.report.figures.drawing import (
    REFERENCE,
    Published,
    add_shared_legend,
    draw_bound,
    draw_dots,
    draw_line,
    ending_text,
    finish_axes,
    merits_phrase,
    micro,
    new_page,
    number,
    published_in_unit,
    runs_of,
)
from malta_papers.halbach.experiments import FAULTS, LAWS, LEAD, PAPER_NAMES, TAIL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.simulation import Experiment

ASKED_STYLE: dict[str, Any] = {"color": "#c1440e", "linestyle": (0, (5, 2)), "linewidth": 1.2}


def stairs_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Every law with either PWM: reference and position. Fig. 7."""
    text = merits_phrase(e.cases[:2], 2)
    if len(e.merits) > 1:
        zones = "; ".join(f"{m.label} {m.phrase()}" for m in e.merits)
        text = zones if published is None else f"{zones} (published: {_published_text(e, published)})"
    figure = new_page(runs_of(e), "stairs", micro(text), top=0.83, hspace=0.28)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for k, (axes, case) in enumerate(zip(panels, e.cases, strict=False)):
        run = case.run
        axes.plot(run.t, 1e6 * run.reference[:, 0], label="reference", drawstyle="steps-post", **REFERENCE)
        draw_line(axes, run.t, 1e6 * run.p[:, 0], label="position", **STYLES[0])
        axes.set_title(case.label, fontsize=9, loc="left")
        finish_axes(axes, "time [s]" if k > 1 else "", "position [µm]")
    add_shared_legend(figure)
    return figure


def _published_text(e: Experiment, published: Published) -> str:
    """The published values of an experiment's figures of merit."""
    values = (
        f"{number(published_in_unit(published, m.published, m.unit), 3)} {micro(m.unit)}" for m in e.merits
    )
    return " and ".join(values)


def force_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Vertical force and position over time for each law, and the steady changes with faults. Fig. 10."""
    sound = [case for case in e.cases if case.label in LAWS]
    figure = new_page(runs_of(e), "vertical force of a move", merits_phrase(sound, 0), top=0.84, wspace=0.34)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1))
    lift = figure.add_subplot(grid[0, 0])
    position = figure.add_subplot(grid[1, 0], sharex=lift)
    for case, style in zip(sound, STYLES, strict=False):
        run = case.run
        start = run.scenario.duration * LEAD / (LEAD + TAIL)
        shown = (run.t > start - 0.5) & (run.t < start + 5)
        draw_line(lift, run.t[shown] - start, lift_force(run)[shown], label=case.label, **style)
        draw_line(position, run.t[shown] - start, 1e3 * run.p[shown, 0], **style)
    draw_bound(lift, commanded_lift(e.run), "wanted", where="below right")
    finish_axes(lift, "", "vertical force [N]", legend=len(sound))
    lift.tick_params(labelbottom=False)
    finish_axes(position, "time after the begin [s]", "position [mm]")
    _draw_faults(figure.add_subplot(grid[:, 1]), e, published)
    return figure


def _draw_faults(axes: Axes, e: Experiment, published: Published | None) -> None:
    """Steady changes of the vertical force: a group for each fault, a mark for each law."""
    found = {case.label: case.merits[0].value for case in e.cases if case.merits}
    for k, (law, style) in enumerate(zip(LAWS, STYLES, strict=False)):
        heights, changes = [], []
        for row, fault in enumerate(FAULTS):
            label = law if fault == "sound" else f"{law}, {fault}"
            if label in found:
                heights.append(-row - 0.2 * (k - 1))
                changes.append(100 * found[label])
        mark = {"marker": MARKERS[k], "markersize": 6, "linestyle": "none", "color": style["color"]}
        axes.plot(changes, heights, label=law, **mark)
        if published is not None:
            value = published_in_unit(published, f"figure_10.{PAPER_NAMES[law]}", "percent")
            axes.axvline(value, color=style["color"], linewidth=0.9, linestyle=style["linestyle"])
    if published is not None:
        axes.plot([], [], color="#5a5a5a", linewidth=0.9, label="lines: published")
    axes.set_yticks(
        [-row for row in range(len(FAULTS))], [_on_two_lines(fault) for fault in FAULTS], fontsize=8
    )
    axes.set_ylim(-len(FAULTS) + 0.35, 0.5)
    finish_axes(axes, "steady change of the vertical force [%]", "", legend=2)
    axes.margins(x=0.06)


def _on_two_lines(text: str) -> str:
    """A text, broken after its first word."""
    words = text.split(" ", 1)
    return "\n".join(words)


def budget_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The error at rest by source, and current noise along half a pitch. Sec. 5.1."""
    values = [in_unit(case.merits[0].value, "um") for case in e.cases]
    found = f"position, rms, of all sources together: {e.cases[-1].merits[0].phrase()}"
    figure = new_page(runs_of(e), "error of the position at rest, by source", found, left=0.15, wspace=0.26)
    sources, along = figure.subplots(1, 2, width_ratios=(1.2, 1))
    floor = 1e-3  # um: the resolution of the laser is 1 nm
    values = [value if value >= floor else 0.0 for value in values]
    draw_dots(sources, [case.label for case in e.cases], values, [f"{number(v, 2)} µm" for v in values])
    finish_axes(sources, "position, rms [µm]", "")
    along.plot(1e3 * e.curves["place"], 1e6 * e.curves["rms"], marker="o", markersize=5, **STYLES[0])
    along.set_ylim(0, None)
    finish_axes(along, "place [mm], half a pitch", "current noise alone: position, rms [µm]")
    along.margins(x=0.03)
    return figure


def identify_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The motor's step beside the linear servo's, printed and fitted, and their differences. Sec. 2.3."""
    run, linear = e.run, e.curves["linear"]
    text = ", ".join(f"{m.label.replace(', ', ' ')} {m.phrase()}" for m in e.merits[:4])
    figure = new_page([run], f"a step of the open loop{ending_text(run)}", micro(text), hspace=0.2)
    position, difference = figure.subplots(2, 1, sharex=True)
    draw_line(position, run.t, 1e3 * run.p[:, 0], label="motor", **STYLES[0])
    draw_line(position, run.t, 1e3 * linear, label="linear servo, eq. (5)", **ASKED_STYLE)
    draw_line(difference, run.t, 1e3 * (linear - run.p[:, 0]), **ASKED_STYLE)
    fitted = 1e3 * (e.curves["fitted"] - run.p[:, 0])
    draw_line(difference, run.t, fitted, label="m and b fitted to the laser's readings", **STYLES[1])
    finish_axes(position, "", "position [mm]")
    finish_axes(difference, "time [s]", "linear servo less motor [mm]")
    add_shared_legend(figure)
    return figure


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "stairs": stairs_figure,
    "force": force_figure,
    "budget": budget_figure,
    "identify": identify_figure,
}
