"""Figures of a campaign's single runs: how near they come to a limit over the parameters, and the worst of them."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.model.machines import lateral_outputs
from malta.report.figures.drawing import (
    BOUND,
    CROSS,
    DOT,
    LEGEND,
    MORE,
    NOTE,
    STYLES,
    Published,
    clearance,
    draw_grid,
    finish_axes,
    legend_entries,
    micro,
    new_figure,
    number,
    published_in_unit,
    rows_and_columns,
)
from malta.simulation.engine.digest import LARGEST_FIGURE
from malta.units import in_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.plan import Plan
    from malta.campaigns.result import Campaign
    from malta.campaigns.summary import Runs, Summary
    from malta.identification.log import Log
    from malta.identification.measure import Curve, Measurement
    from malta.model.plant import FloatArray


SHOWN = 9  # parameters with a panel each, at most
LEAST = 1e-3  # of a deviation on a logarithmic axis, in its fine unit


def campaign_page(found: Summary, what: str, **places: Any) -> Figure:
    """An empty figure whose title names the campaign, with its yield."""
    from malta.campaigns.plan import planned_run

    plan, yields = found.plan, found.yields
    wanted = planned_run(plan)
    flown = plan.scenario if wanted.label == plan.scenario else f"{plan.scenario} ({wanted.label})"
    title = f"{plan.controller.name}, {flown}, fidelity {wanted.scenario.fidelity}: {what}"
    bounded = yields.specified or yields.published
    share = bounded or yields.completed
    done = "all" if share.passed == share.runs else f"{share.passed} of"
    ends = "completed" if bounded is None else "within bounds"
    text = f"{done} {share.runs} runs {ends}: {100 * share.share:.4g} % "
    text += f"(95 %: {100 * share.low:.4g} to {100 * share.high:.4g} %)"
    if bounded is not None:
        text += f"; completed {100 * found.rate.share:.4g} %"
    if found.runs < plan.samples:
        text += f"; not final: {plan.samples} runs are planned"
    return new_figure(title, text, **{"right": 0.965} | places)


def panels_over_parameters(
    summary: Summary, what: str, **places: Any
) -> tuple[Figure, list[tuple[str, Axes]]]:
    """A page with a panel for each value that was varied, at most SHOWN, side by side with one y axis."""
    from malta.campaigns.plan import half_width, varied_names

    names = [
        name for name in varied_names(summary.plan) if half_width(summary.plan, name) and summary.runs > 1
    ]
    shown = names[:SHOWN]
    rows, columns = rows_and_columns(len(shown))
    more = f", {len(shown)} of {len(names)} shown" if len(shown) < len(names) else ""
    figure = campaign_page(summary, what + more, **{"hspace": 0.5, "top": 0.8} | places)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    if not shown:
        figure.text(
            0.5, 0.5, "one run" if summary.runs == 1 else "no parameter was varied", ha="center", **NOTE
        )
    return figure, list(zip(shown, panels, strict=False))


def nearest_figure(summary: Summary) -> Figure:
    """How near the runs of a campaign came to a limit, over each parameter: for a campaign whose runs all end alike.

    The limit is the contact to which the nearest run is closest beyond the usual; without contacts the deviation stands
    in its place. Of more runs than a summary keeps, these are the nearest.
    """
    from malta.campaigns.plan import varied_names
    from malta.campaigns.result import unit_of
    from malta.campaigns.summary import bin_edges

    runs = summary.kept
    values, label = _nearness(summary, runs)
    what, _, unit = label.removesuffix("]").rpartition(" [")
    nearest = f"run {runs.index[int(values.argmax())]}, {what} {number(float(values.max()), 3)} {unit}"
    every = varied_names(summary.plan)
    page, panels = panels_over_parameters(summary, "how near runs come to a limit", top=0.79, left=0.12)
    page.texts[-1].set_text(f"{page.texts[-1].get_text()}; nearest: {nearest}")
    for name, axes in panels:
        unit = unit_of(summary.plan, name)
        scale = in_unit(1.0, unit)
        at, edges = runs.values[:, every.index(name)] * scale, bin_edges(summary.plan, name) * scale
        axes.plot(at, values, label="each run", **DOT | {"markersize": 2.5, "color": "#9a9a9a"})
        place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
        highest = [
            values[place == k].max() if (place == k).any() else math.nan for k in range(len(edges) - 1)
        ]
        axes.stairs(
            highest, edges, baseline=None, label="nearest in each stretch", color="#000000", linewidth=1.4
        )
        shown = "%" if unit == "percent" else micro(unit)
        finish_axes(axes, f"{name} [{shown}]", textwrap.fill(label, 30) if is_first(axes) else "")
        axes.set_xlim(edges[0], edges[-1])
    for _, axes in panels[:1]:
        most = float(values.max())
        apart = most - float(values.min())
        axes.set_ylim(most - 1.3 * apart if apart < 0.3 * most else 0, most + 0.15 * min(most, 2 * apart))
    kept = "" if len(runs.index) == summary.runs else f", the {len(runs.index)} nearest"
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.91)}
    handles, labels = legend_entries([axes for _, axes in panels])
    if handles:
        page.legend(
            handles, [text + kept * (text == "each run") for text in labels], ncols=2, **where, **LEGEND
        )
    return page


def is_first(axes: Axes) -> bool:
    """Whether axes are in the first column, which has the label."""
    place = axes.get_subplotspec()
    return place is None or place.is_first_col()


def _nearness(summary: Summary, runs: Runs) -> tuple[FloatArray, str]:
    """How near each run came to a limit, and what that is, for an axis."""
    plant = summary.plan.plant
    contact = np.clip(np.nan_to_num(runs.batch.contact, nan=0.0), 0.0, LARGEST_FIGURE)
    if contact.shape[1]:
        beyond = contact.max(axis=0) - np.median(contact, axis=0)
        k = int(beyond.argmax())
        name = plant.contacts[k].removeprefix("touchdown at ")
        return 100 * contact[:, k], f"clearance used up, {name} [%]"
    group = lateral_outputs(plant)[0]
    worst = runs.batch.deviation[:, group.columns].max(axis=1) * in_unit(1.0, group.fine)
    return np.asarray(worst), f"largest {group.name} deviation [{micro(group.fine)}]"


def worst_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Draw the worst runs of a campaign: the places of their machines in the box, and their largest errors.

    found : the campaign, or its summary
    published : figures of the machine's paper, from `malta.model.published`; None: none; a summary has its own

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", {"m": 0.1}, samples=8, options=short
    ... )
    >>> figure = malta.report.worst_figure(malta.campaign(plan, workers=1))
    >>> len(figure.axes)
    2
    """
    from malta.campaigns.plan import half_width, middle_of, varied_names
    from malta.campaigns.result import spread_text
    from malta.campaigns.summary import Bounds, as_summary, worst_runs

    summary = as_summary(found, Bounds(published))
    plan, names = summary.plan, varied_names(summary.plan)
    runs = worst_runs(summary, len(STYLES) + len(MORE))
    figure = campaign_page(
        summary, "the worst runs and their machines", wspace=0.42, top=0.84, bottom=0.13, right=0.95
    )
    box, far = figure.subplots(1, 2, width_ratios=(1.7, 1))
    labels = [_run_label(plan, index, end) for index, end in zip(runs.index, runs.batch.verdict, strict=True)]
    at = np.arange(len(names))
    middle = np.array([middle_of(plan, name) for name in names])
    half = np.array([half_width(plan, name) for name in names])
    for row, style in zip(range(len(runs.index)), (*STYLES, *MORE), strict=False):
        where = 100 * (runs.values[row] - middle) / np.where(half == 0, 1, half)
        box.plot(at, where, marker="o", markersize=4, **style)
        # the look of its line, left of the name of the run
        named: dict[str, Any] = style | {"label": labels[row], "clip_on": False}
        far.plot([-0.12, -0.02], [row, row], transform=far.get_yaxis_transform(), **named)
    box.set_xticks(at, [f"{name}\n{spread_text(plan, name)}" for name in names], fontsize=9)
    box.set_yticks([-100, -50, 0, 50, 100])
    finish_axes(box, "", "place in the box [% of half its width]")
    box.set_xlim(-0.3, len(at) - 0.7)
    box.set_ylim(-108, 108)
    _draw_errors(far, summary, runs)
    far.set_yticks(range(len(labels)), labels, fontsize=8)
    far.tick_params(axis="y", length=0, pad=28)
    far.set_ylim(len(labels) - 0.5, -0.5)
    return figure


def _draw_errors(axes: Axes, summary: Summary, runs: Runs) -> None:
    """What ranks the runs: how near they came to a contact; of runs that ended early their largest deviation."""
    from malta.campaigns.result import bounds_of
    from malta.campaigns.summary import closeness

    plan, plant, published = summary.plan, summary.plan.plant, summary.bounds.published
    across, completed = lateral_outputs(plant)[0], runs.batch.completed == 1
    fine = in_unit(1.0, across.fine)
    known = np.nan_to_num(runs.batch.deviation[:, across.columns], nan=np.inf)  # of runs that diverged
    values = np.clip(np.minimum(known, LARGEST_FIGURE) * fine, LEAST, None).max(axis=1)
    label, unit = f"largest {across.name} deviation [{micro(across.fine)}]", micro(across.fine)
    bounds = {"clearance": clearance(plant) * fine} if across.unit == "m" else {}
    key = bounds_of(plan).get(across.unit)
    if published is not None and key is not None:
        bounds["published bound"] = published_in_unit(published, key, across.fine)
    if plant.contacts and completed.all():  # what the runs are ranked by
        values, label = 100 * closeness(summary, runs), "clearance used up beyond median [%]"
        unit, bounds = "%", {}
    most = float(values.max(initial=0.0))
    bounds = {text: v for text, v in bounds.items() if math.isfinite(v) and v < 30 * most}
    _set_reach(axes, values, list(bounds.values()))
    for row, value in enumerate(values):
        axes.plot(value, row, **(DOT if completed[row] else CROSS))
        place = axes.transAxes.inverted().transform(axes.transData.transform((value, row)))[0]
        beside: dict[str, Any] = {"xytext": (8 if place < 0.5 else -8, 0), "textcoords": "offset points"}
        text = f"{number(float(value), 3)} {unit}" if value < LARGEST_FIGURE * fine else "diverged"
        axes.annotate(
            text, (value, row), ha="left" if place < 0.5 else "right", va="center", **beside, **NOTE
        )
    for text, value in bounds.items():
        axes.axvline(value, **BOUND)
        above: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
        axes.annotate(text, (value, 1.01), **above, **NOTE)
    finish_axes(axes, label, "")


def _set_reach(axes: Axes, values: FloatArray, bounds: Sequence[float]) -> None:
    """Set the x axis: logarithmic where values and bounds reach far, without zero where the values are nearly alike."""
    from matplotlib.ticker import MaxNLocator

    if not len(values):
        return
    least, most = float(values.min()), max([float(values.max()), *bounds, 1e-12])
    apart = most - least
    if least > 0 and most > 10 * min([least, *bounds]):
        axes.set_xscale("log")
        axes.set_xlim(min([least, *bounds]) / 3, 2 * most)
    elif 0 < apart < 0.3 * most:
        axes.set_xlim(least - 0.6 * apart, most + 0.6 * apart)
        axes.xaxis.set_major_locator(MaxNLocator(3, prune="upper"))
    else:
        axes.set_xlim(0, 1.5 * most)


def _run_label(plan: Plan, index: int, verdict: float) -> str:
    """The number of a run, and how it ended."""
    from malta.simulation.engine.digest import verdicts

    name = verdicts(plan.plant)[int(verdict)]
    text = f"run {index}"
    return text if name == "completed" else f"{text}\n{name.replace(' at ', chr(10) + 'at ')}"


# Figures of a log, and of a loop that was measured.


PANELS = {
    "y": "measured",
    "reference": "reference",
    "v": "command",
    "excitation": "excitation",
    "i": "current",
}
POINTS = 2000  # of a line: intervals, each drawn from its least to its largest value


def log_figure(log: Log) -> Figure:
    """Draw a log: measured outputs, reference, commands, excitation and currents over time."""
    groups = [g for g in PANELS if log.names(g) and (g == "y" or np.nan_to_num(log.columns[g]).any())]
    figure = new_figure(log.source, "; ".join(log.survey.findings), size=(9.0, 1.2 + 1.9 * len(groups)))
    for axes, group in zip(
        figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0], groups, strict=True
    ):
        micro = {"m": 1e6, "rad": 1e6}.get(log.signals[group][0].unit, 1.0)
        for signal, values in zip(log.signals[group], log.columns[group].T, strict=True):
            axes.plot(*_thinned(log.t, micro * values), lw=0.8, label=signal.name)
        unit = log.signals[group][0].unit
        finish_axes(
            axes, "time [s]", f"{PANELS[group]} [{'u' if micro != 1 else ''}{unit}]", legend=len(axes.lines)
        )
    return figure


def _thinned(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest value of each of POINTS intervals."""
    each = len(t) // POINTS
    if each < 4:
        return t, values
    whole = POINTS * each
    parts = values[:whole].reshape(POINTS, each)
    ends = np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).ravel()
    return np.repeat(t[:whole:each], 2), ends


def measured_figure(found: Measurement) -> Figure:
    """Draw a loop that was measured: S, T, open loop and compliance of each sensor with bands over the tube."""
    p = len(found.sensors)
    verdict = found.refusal or f"as predicted by {found.machines} machines of the box"
    figure = new_figure(
        f"{found.source}: the loop as measured", verdict, size=(11.0, 1.4 + 1.75 * p), wspace=0.42, left=0.07
    )
    curves = {"|S| [1]": found.S, "|T| [1]": found.T, "|L| [1]": found.L, "|S P| [m/N]": found.compliance}
    panels = figure.subplots(p, 4, sharex=True, squeeze=False)
    for i, (name, row) in enumerate(zip(found.sensors, panels, strict=True)):
        for axes, (label, curve) in zip(row, curves.items(), strict=True):
            at: tuple[int, ...] = (i,)
            if curve is found.compliance:
                j = int(curve.size[:, i].max(axis=0).argmax())
                at, label = (i, j), f"{name} by {found.forces[j]} [SI]"
            _draw_curve(axes, found.w / (2 * np.pi), curve.at(*at))
            axes.set_ylabel(label if len(at) > 1 else f"{name}: {label}", fontsize=8)
            axes.tick_params(which="both", labelsize=7)
    for axes in panels[-1]:
        axes.set_xlabel("frequency [Hz]", fontsize=8)
    panels[0, 0].legend(fontsize=7, frameon=False)
    return figure


def _draw_curve(axes: Axes, f: FloatArray, curve: Curve) -> None:
    """A response with its 95 % band as bars, the prediction as a line and its tube as an area."""
    size, half = curve.size, 1.96 * curve.deviation
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.fill_between(f, curve.low, curve.high, color="#d9d9d9", linewidth=0, label="tube")
    axes.plot(f, np.abs(curve.predicted), color="#4a4a4a", linewidth=0.9, label="predicted")
    bars = np.array([np.minimum(half, 0.999 * size), half])
    axes.errorbar(f, size, bars, fmt=".", color="#c1440e", markersize=3, elinewidth=0.8, label="measured")
    axes.set_ylim(bottom=0.5 * min(float(size.min()), float(curve.low.min())))
    draw_grid(axes)
