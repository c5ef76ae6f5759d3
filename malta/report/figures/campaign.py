"""The figures of a campaign: distributions, how runs end over the parameters, the worst runs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.report.figures.drawing import (
    BOUND,
    LEGEND,
    NOTE,
    STYLES,
    Published,
    add_shared_legend,
    finish_axes,
    legend_entries,
    micro,
    new_figure,
    number,
    number_logarithm,
    rows_and_columns,
)
from malta.report.figures.runs import campaign_page, is_first, nearest_figure, panels_over_parameters
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.plan import Plan
    from malta.campaigns.result import Campaign
    from malta.campaigns.studies import Index, Sensitivity
    from malta.campaigns.summary import Distribution, Summary


FINE: Mapping[
    str, dict[str, Any]
] = {  # ways in which runs end, the best first, light to dark; contacts follow
    "within the published bounds": {"facecolor": "#ececec"},
    "completed": {"facecolor": "#b4b4b4"},
    "completed, commands limited": {"facecolor": "#b4b4b4", "hatch": "////"},
    "diverged": {"facecolor": "#c1440e"},
    "not lifted": {"facecolor": "#d8d8d8", "hatch": ".."},
}
TOUCHES: Sequence[dict[str, Any]] = (
    {"facecolor": "#202020"},
    {"facecolor": "#6a6a6a"},
    {"facecolor": "#202020", "hatch": "xx"},
)
BINS = 40  # of a distribution
LEFT = 1e-3  # where the lines of the worst runs begin, in the fine unit of their deviation


def distributions_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Draw the distributions of a campaign's figures of merit over the completed runs, with the published bounds.

    A figure that is the same in every run, or that the reference makes by a jump, is told in a sentence.

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
    >>> figure = malta.report.distributions_figure(malta.campaign(plan, workers=1))
    >>> [axes.get_xlabel() for axes in figure.axes][:2]
    ['deviation y [µm]', 'largest f [N]']
    """
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published))
    told = {m.label: text for m in summary.merits if (text := _without_spread(summary, m))}
    panels: dict[tuple[str, str], list[Distribution]] = {}  # one panel for each kind and unit
    for listed in summary.merits:
        if listed.label not in told and listed.sketch.count:
            panels.setdefault((listed.kind, listed.merit.unit), []).append(listed)
    rows, columns = rows_and_columns(len(panels))
    height = 1.2 + 2.4 * rows
    places = {"size": (9.0, height), "top": 1 - 1.05 / height, "hspace": 0.7, "wspace": 0.28}
    figure = campaign_page(summary, "figures of merit of the completed runs", **places)
    notes = (
        "; ".join(told.values())
        if panels
        else "no run was completed"
        if not told
        else "; ".join(told.values())
    )
    figure.text(0.5, 1 - 0.53 / height, textwrap.fill(notes, 140), ha="center", va="top", **NOTE)
    for k, ((kind, _), group) in enumerate(panels.items()):
        _draw_distribution(figure.add_subplot(rows, columns, k + 1), kind, group)
    return figure


def _without_spread(found: Summary, one: Distribution) -> str:
    """What is to say of a figure of merit that needs no distribution; nothing of one that has one."""
    if not one.sketch.count:
        return ""
    unit = "%" if one.merit.unit == "percent" else micro(one.merit.unit)
    least, most = (in_unit(value, one.merit.unit) for value in (one.sketch.smallest, one.sketch.largest))
    label = one.label.replace("clearance:", "clearance used up,")
    if found.runs > 1 and most - least <= 1e-9 * abs(most):
        return f"{label}: {number(most, 3)} {unit} in every run"
    output = one.label.removeprefix("deviation ").removeprefix("of ")
    jump = in_unit(_jumps(found.plan).get(output, 0.0), one.merit.unit)
    if one.kind.startswith("deviation") and jump and 0.9 * jump < least and most < 1.5 * jump:
        return f"{label}: the jump of the reference itself, {number(jump, 3)} {unit}"
    return ""


def _jumps(plan: Plan) -> dict[str, float]:
    """The largest change of the reference from one sample to the next, by output, SI."""
    from malta.campaigns.plan import planned_run

    scenario, plant = planned_run(plan).scenario, plan.plant
    t = np.arange(0.0, scenario.duration, plan.controller.sample_time)
    steps = np.abs(np.diff(scenario.reference(plant)(t).p, axis=0)).max(axis=0, initial=0.0)
    return {signal.name: float(step) for signal, step in zip(plant.outputs, steps, strict=True)}


def _draw_distribution(axes: Axes, kind: str, listed: Sequence[Distribution]) -> None:
    """Histograms of figures of one kind, on a logarithmic axis where they reach over decades."""
    from matplotlib.ticker import MaxNLocator

    from malta.campaigns.summary import histogram

    merit = listed[0].merit
    unit, scale = merit.unit, in_unit(1.0, merit.unit)
    bound = math.nan if merit.bound is None else in_unit(merit.bound, unit)
    told = "%" if unit == "percent" else micro(unit)
    name = kind if len(listed) > 1 else listed[0].label
    name = name.replace("clearance:", "clearance used up,").removesuffix(",")
    finish_axes(axes, f"{name} [{told}]", "share of runs [%]")
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
    axes.set_xlim(edges[0], edges[-1])
    if logarithmic:
        axes.set_xscale("log")
        number_logarithm(axes.xaxis)
    else:
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_ylim(0, None)
    if math.isfinite(bound):
        axes.axvline(bound, **BOUND)
        text = "published" if merit.relation == "about" else "published bound"
        axes.annotate(
            text, (bound, 1.01), xycoords=("data", "axes fraction"), ha="center", va="bottom", **NOTE
        )
    if len(listed) > 1:
        bottom = 1.13 if math.isfinite(bound) else 1.04  # above the name of the bound
        where: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (-0.1, bottom), "borderaxespad": 0.2}
        close = {"handlelength": 1.2, "columnspacing": 0.7, "handletextpad": 0.5, "fontsize": 7.5}
        longest = max(len(m.label.removeprefix(f"{kind} ")) for m in listed)
        axes.legend(ncols=max(1, min(len(listed), 36 // (longest + 4))), **where, **LEGEND | close)


def yield_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Draw the shares of the ways in which the runs of a campaign end, over each parameter that was varied.

    Where all are completed alike there is nothing to tell apart, and `nearest_figure` stands in its place.

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
    >>> figure = malta.report.yield_figure(malta.campaign(plan, workers=1))
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['m [kg]']
    """
    from malta.campaigns.plan import varied_names
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published))
    if np.count_nonzero(summary.bands.sum(axis=(0, 2))) == 1 and summary.rate.passed == summary.runs:
        return nearest_figure(summary)
    every = varied_names(summary.plan)
    figure, panels = panels_over_parameters(summary, "how runs end over the parameters")
    for name, axes in panels:
        _draw_bands(axes, summary.plan, name, summary.bands[every.index(name)])
        if is_first(axes):
            axes.set_ylabel("share of runs [%]")
    handles, labels = legend_entries([axes for _, axes in panels])
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.91)}
    if handles:
        figure.legend(handles, labels, ncols=min(4, len(labels)), **where, **LEGEND)
    return figure


def _draw_bands(axes: Axes, plan: Plan, name: str, counts: Any) -> None:
    """Shares of the ways in which runs end, stacked, in bins of one parameter. counts : ways x bins."""
    from malta.campaigns.result import unit_of
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


# The figure of a sensitivity: Sobol indices as bars, a panel for each figure of merit.


UPRIGHT = 6  # names of factors below an axis, at most; more are turned
BARS: dict[str, dict[str, Any]] = {
    "first-order index: alone": {"facecolor": "#d0d0d0", "edgecolor": "#000000", "hatch": "////"},
    "total index: also with others": {"facecolor": "#8c8c8c", "edgecolor": "#000000"},
}


def sensitivity_figure(found: Sensitivity) -> Figure:
    """First-order and total Sobol indices with their 95 % intervals: of the yield, then of figures of merit."""
    from malta.report.tables.campaign import run_text

    panels = {"yield": found.of_yield, **found.of_merits}
    shown = {label: indices for label, indices in panels.items() if indices}
    rows, columns = rows_and_columns(len(shown))
    upright = len(found.factors) <= UPRIGHT
    below = 0.55 if upright else 0.95  # inch, of the names of the factors
    height = 1.05 + rows * (1.9 + below)
    places: dict[str, Any] = {"size": (9.0, height), "left": 0.08, "top": 1 - 1.05 / height, "wspace": 0.22}
    places |= {"bottom": below / height, "hspace": 0.42 if upright else 0.7}
    title = f"{found.plan.controller.name}, {run_text(found.plan)}: what costs yield"
    share = found.within
    text = f"{found.limit.kept}: {100 * share.share:.4g} % "
    text += f"(95 %: {100 * share.low:.4g} to {100 * share.high:.4g} %), {found.runs} runs"
    figure = new_figure(title, text, **places)
    first = None
    for k, (label, indices) in enumerate(shown.items()):
        axes = figure.add_subplot(rows, columns, k + 1, sharey=first)
        first = first or axes
        _draw_indices(axes, label, found.factors, indices)
        axes.set_ylabel("share of the variance [-]" if k % columns == 0 else "")
    add_shared_legend(figure)
    return figure


def _draw_indices(axes: Axes, label: str, factors: Sequence[str], indices: Sequence[Index]) -> None:
    at, width = np.arange(len(factors)), 0.38
    columns = [(i.first, i.first_half) for i in indices], [(i.total, i.total_half) for i in indices]
    for side, (name, style), rows in zip((-0.5, 0.5), BARS.items(), columns, strict=True):
        values = np.array(rows)
        axes.bar(
            at + side * width,
            values[:, 0],
            width,
            yerr=values[:, 1],
            capsize=2,
            ecolor="#000000",
            label=name,
            **style,
        )
    finish_axes(axes, "", "")
    axes.set_title(label.replace("clearance:", "clearance used up,"), fontsize=9)
    turned: dict[str, Any] = (
        {} if len(factors) <= UPRIGHT else {"rotation": 50, "ha": "right", "rotation_mode": "anchor"}
    )
    axes.set_xticks(at, factors, fontsize=8, **turned)
    axes.set_xlim(-0.6, len(factors) - 0.4)
    ends = [i.first + i.first_half for i in indices] + [i.total + i.total_half for i in indices]
    starts = [i.first - i.first_half for i in indices]
    low, high = axes.get_ylim() if axes.get_shared_y_axes().get_siblings(axes)[1:] else (0.0, 1.05)
    axes.set_ylim(min(low, *starts) - 0.02, max(high, *(1.03 * end for end in ends)))
