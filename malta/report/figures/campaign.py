"""The figures of a campaign: distributions, how runs end over the parameters, the worst runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.model.signals import lateral_outputs
from malta.report.figures.parts import (
    BOUND,
    LEGEND,
    MORE,
    NOTE,
    STYLES,
    Published,
    clearance,
    finish_axes,
    legend_entries,
    micro,
    new_figure,
    published_in_unit,
)
from malta.simulation.digest import LARGEST_FIGURE
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.plan import Plan
    from malta.campaigns.result import Campaign
    from malta.campaigns.summary import Merit, Summary


FINE: Mapping[
    str, dict[str, Any]
] = {  # ways in which runs end, the best first, light to dark; contacts follow
    "within the published bounds": {"facecolor": "#f0f0f0"},
    "completed": {"facecolor": "#d0d0d0"},
    "completed, commands limited": {"facecolor": "#d0d0d0", "hatch": "////"},
    "diverged": {"facecolor": "#c1440e"},
    "not lifted": {"facecolor": "#909090", "hatch": ".."},
}
TOUCHES: Sequence[dict[str, Any]] = (
    {"facecolor": "#202020"},
    {"facecolor": "#6a6a6a"},
    {"facecolor": "#202020", "hatch": "xx"},
)
BINS = 40  # of a distribution
LEFT = 1e-3  # where the lines of the worst runs begin, in the fine unit of their deviation


def distributions_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Distributions of the figures of merit over the completed runs, with the published bounds."""
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published))
    panels: dict[tuple[str, str], list[Merit]] = {}  # one panel for each kind and unit
    for listed in summary.merits:
        panels.setdefault((listed.kind, listed.unit), []).append(listed)
    figure = _campaign_figure(summary, "figures of merit of the completed runs", hspace=0.44, wspace=0.28)
    every = figure.subplots(2, 3).ravel()
    for axes, ((kind, _), group) in zip(every, panels.items(), strict=False):
        _draw_distribution(axes, kind, group)
    for axes in every[len(panels) :]:
        axes.set_visible(False)
    return figure


def _draw_distribution(axes: Axes, kind: str, listed: Sequence[Merit]) -> None:
    """Histograms of figures of one kind, on a logarithmic axis where they reach over decades."""
    from matplotlib.ticker import LogLocator

    from malta.campaigns.sketch import histogram

    unit = listed[0].unit
    bound, scale = in_unit(listed[0].published, unit), in_unit(1.0, unit)
    told = "%" if unit == "percent" else micro(unit)
    finish_axes(axes, f"{kind} [{told}]", "share of runs [%]")
    if not any(m.sketch.count for m in listed):
        axes.annotate("no run completed", (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
        return
    low = scale * min(m.sketch.smallest for m in listed)
    high = scale * max(m.sketch.largest for m in listed)
    if math.isfinite(bound):
        low, high = min(low, bound), max(high, bound)
    logarithmic = low > 0 and high > 30 * low
    room = 0.04 * (high - low) or 0.05 * abs(high) or 1.0
    edges = (
        np.geomspace(low / 1.1, high * 1.1, BINS + 1)
        if logarithmic
        else np.linspace(max(low - room, 0.0) if low >= 0 else low - room, high + room, BINS + 1)
    )
    for m, style in zip(listed, cycle((1, 0, 3, 2)), strict=False):
        share = 100 * histogram(m.sketch, edges / scale) / max(m.sketch.count, 1)
        line = {"color": STYLES[0]["color"], "linewidth": 1.2} if len(listed) == 1 else STYLES[style]
        if len(listed) == 1:
            axes.stairs(share, edges, fill=True, facecolor="#d4d4d4")
        axes.stairs(share, edges, label=m.label.removeprefix(f"{kind} ") if len(listed) > 1 else None, **line)
    if logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high > 100 * low else (1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(0, None)
    if math.isfinite(bound):
        axes.axvline(bound, **BOUND)
        text = "published" if listed[0].relation == "about" else "published bound"
        axes.annotate(
            text, (bound, 1.01), xycoords=("data", "axes fraction"), ha="center", va="bottom", **NOTE
        )
    if len(listed) > 1:
        where: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1.06), "borderaxespad": 0.2}
        close = {"handlelength": 1.4, "columnspacing": 0.8} if len(listed) > 3 else {}
        axes.legend(ncols=len(listed), **where, **LEGEND | close)


def yield_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Shares of the ways in which runs end, over each parameter that was varied."""
    from malta.campaigns.plan import half_width, varied_names
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published))
    every = varied_names(summary.plan)
    names = [name for name in every if half_width(summary.plan, name) and summary.runs > 1]
    shown = names[:9]
    columns = min(3, max(1, len(shown))) if len(shown) != 4 else 2
    rows = max(1, -(-len(shown) // columns))
    more = f", {len(shown)} of {len(names)} shown" if len(shown) < len(names) else ""
    figure = _campaign_figure(summary, f"how runs end over the parameters{more}", hspace=0.5, top=0.8)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for axes, name in zip(panels, shown, strict=False):
        _draw_bands(axes, summary.plan, name, summary.bands[every.index(name)])
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    for axes in panels[: len(shown) : columns]:
        axes.set_ylabel("share of runs [%]")
    handles, labels = legend_entries(list(panels))
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.91)}
    if handles:
        figure.legend(handles, labels, ncols=min(4, len(labels)), **where, **LEGEND)
    return figure


def _draw_bands(axes: Axes, plan: Plan, name: str, counts: Any) -> None:
    """Shares of the ways in which runs end, stacked, in bins of one parameter. counts : ways x bins."""
    from malta.campaigns.statistics import unit_of
    from malta.campaigns.summary import bin_edges, ways_to_end

    unit = unit_of(plan, name)
    edges = bin_edges(plan, name) * in_unit(1.0, unit)
    total = counts.sum(axis=0)
    base = np.zeros(len(total))
    by_way = dict(zip(ways_to_end(plan), counts, strict=True))
    for label, style in (dict(FINE) | dict(zip(plan.plant.contacts, cycle(TOUCHES)))).items():
        if not by_way[label].any():
            continue
        share = 100 * by_way[label] / np.maximum(total, 1)
        axes.bar(
            edges[:-1],
            share,
            np.diff(edges),
            base,
            align="edge",
            label=label,
            edgecolor="#ffffff",
            linewidth=0.6,
            **style,
        )
        base += share
    finish_axes(axes, f"{name} [{'%' if unit == 'percent' else micro(unit)}]", "")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(0, 100)


def worst_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """The worst runs: the places of their machines in the box, and their largest errors."""
    from malta.campaigns.plan import half_width, middle_of, varied_names
    from malta.campaigns.statistics import bounds_of, spread_text
    from malta.campaigns.summary import Bounds, as_summary, worst_runs

    summary = as_summary(found, Bounds(published))
    plan, plant, published = summary.plan, summary.plan.plant, summary.bounds.published
    names, runs = varied_names(plan), worst_runs(summary, len(STYLES) + len(MORE))
    completed = runs.batch.completed == 1
    figure = _campaign_figure(
        summary, "the worst runs and their machines", wspace=0.34, top=0.84, bottom=0.13
    )
    box, far = figure.subplots(1, 2, width_ratios=(1.7, 1))
    at = np.arange(len(names))
    middle = np.array([middle_of(plan, name) for name in names])
    half = np.array([half_width(plan, name) for name in names])
    across = lateral_outputs(plant)[0]
    fine = in_unit(1.0, across.fine)
    known = np.nan_to_num(runs.batch.deviation[:, across.columns], nan=np.inf)  # of runs that diverged
    offs = np.clip(np.minimum(known, LARGEST_FIGURE) * fine, LEFT, None)
    for row, (_, style) in enumerate(zip(runs.index, (*STYLES, *MORE), strict=False)):
        where = 100 * (runs.values[row] - middle) / np.where(half == 0, 1, half)
        box.plot(at, where, marker="o", markersize=4, **style)
        off = float(offs[row].max())
        far.plot([LEFT, off], [row, row], **style)
        far.plot(
            off,
            row,
            marker="o" if completed[row] else "X",
            markersize=7,
            color=style["color"],
            clip_on=False,
        )
    box.set_xticks(at, [f"{name}\n{spread_text(plan, name)}" for name in names], fontsize=9)
    box.set_yticks([-100, -50, 0, 50, 100])
    labels = [_run_label(plan, index, end) for index, end in zip(runs.index, runs.batch.verdict, strict=True)]
    far.set_yticks(range(len(labels)), labels, fontsize=8)
    far.invert_yaxis()
    far.set_xscale("log")
    least = float(offs.max(axis=1).min()) if len(labels) else 1.0
    bounds = {"clearance": clearance(plant) * fine} if across.unit == "m" else {}
    key = bounds_of(plan).get(across.unit)
    if published is not None and key is not None:
        bounds["published bound"] = published_in_unit(published, key, across.fine)
    bounds = {text: value for text, value in bounds.items() if math.isfinite(value)}
    most = float(offs.max()) if len(labels) else 1.0
    far.set_xlim(min([least, *bounds.values()]) / 2, 1.6 * max([most, *bounds.values()]))
    for text, value in bounds.items():
        far.axvline(value, **BOUND)
        far.annotate(
            text, (value, 1.01), xycoords=("data", "axes fraction"), ha="center", va="bottom", **NOTE
        )
    finish_axes(box, "", "place in the box [% of half its width]")
    finish_axes(far, f"largest {across.name} deviation [{micro(across.fine)}]", "")
    box.set_xlim(-0.3, len(at) - 0.7)
    box.set_ylim(-108, 108)
    return figure


def _campaign_figure(found: Summary, what: str, **places: Any) -> Figure:
    """An empty figure whose title names the campaign, with its yield."""
    from malta.campaigns.plan import planned_run

    plan, share = found.plan, found.rate
    wanted = planned_run(plan)
    flown = plan.scenario if wanted.label == plan.scenario else f"{plan.scenario} ({wanted.label})"
    title = f"{plan.controller.name}, {flown}, fidelity {wanted.scenario.fidelity}: {what}"
    text = f"{share.passed} of {share.runs} runs completed: {100 * share.share:.4g} % "
    text += f"(95 %: {100 * share.low:.4g} to {100 * share.high:.4g} %)"
    return new_figure(title, text, **places)


def _run_label(plan: Plan, index: int, verdict: float) -> str:
    """The number of a run, and how it ended."""
    from malta.simulation.digest import verdicts

    name = verdicts(plan.plant)[int(verdict)]
    text = f"run {index}"
    return text if name == "completed" else f"{text}\n{name.replace(' at ', chr(10) + 'at ')}"
