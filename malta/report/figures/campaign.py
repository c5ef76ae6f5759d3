"""The figures of a campaign: distributions, how runs end over the parameters, the worst runs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.model.signal_groups import lateral_outputs
from malta.report.figures.drawing import (
    BOUND_STYLE,
    CROSS,
    DOT,
    LEGEND,
    MORE_STYLES,
    NOTE,
    STYLES,
    Published,
    add_shared_legend,
    clearance,
    finish_axes,
    legend_entries,
    micro,
    new_figure,
    number,
    number_logarithm,
    published_in_unit,
    rows_and_columns,
    save_figure,
)
from malta.simulation.engine.digest import MAX_FIGURE, verdicts
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.campaigns.plan import Plan
    from malta.campaigns.result import Campaign
    from malta.campaigns.studies import Index, Sensitivity
    from malta.campaigns.summary import Distribution, Runs, Summary

SHOWN_PARAMETERS = 9  # parameters with a panel each, at most
MIN_DEVIATION = 1e-3  # of a deviation on a logarithmic axis, in its fine unit


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
    """A page with a panel for each value that was varied, at most SHOWN_PARAMETERS, side by side with one y axis."""
    from malta.campaigns.plan import half_width, varied_names

    names = [
        name for name in varied_names(summary.plan) if half_width(summary.plan, name) and summary.runs > 1
    ]
    shown = names[:SHOWN_PARAMETERS]
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
    contact = np.clip(np.nan_to_num(runs.batch.contact, nan=0.0), 0.0, MAX_FIGURE)
    if contact.shape[1]:
        beyond = contact.max(axis=0) - np.median(contact, axis=0)
        k = int(beyond.argmax())
        name = plant.contacts.names[k].removeprefix("touchdown at ")
        return 100 * contact[:, k], f"clearance used up, {name} [%]"
    group = lateral_outputs(plant)[0]
    worst = runs.batch.deviation[:, group.columns].max(axis=1) * in_unit(1.0, group.fine)
    return np.asarray(worst), f"largest {group.name} deviation [{micro(group.fine)}]"


def worst_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Draw the worst runs of a campaign: the places of their machines in the box, and their largest errors.

    found : the campaign, or its summary
    published : figures of the machine's paper, from `malta.model.read_published`; None: none; a summary has its own

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
    from malta.campaigns.summary import RunLimits, as_summary, worst_runs

    summary = as_summary(found, RunLimits(published))
    plan, names = summary.plan, varied_names(summary.plan)
    runs = worst_runs(summary, len(STYLES) + len(MORE_STYLES))
    figure = campaign_page(
        summary, "the worst runs and their machines", wspace=0.42, top=0.84, bottom=0.13, right=0.95
    )
    box, far = figure.subplots(1, 2, width_ratios=(1.7, 1))
    labels = [_run_label(plan, index, end) for index, end in zip(runs.index, runs.batch.verdict, strict=True)]
    at = np.arange(len(names))
    middle = np.array([middle_of(plan, name) for name in names])
    half = np.array([half_width(plan, name) for name in names])
    for row, style in zip(range(len(runs.index)), (*STYLES, *MORE_STYLES), strict=False):
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
    values = np.clip(np.minimum(known, MAX_FIGURE) * fine, MIN_DEVIATION, None).max(axis=1)
    label, unit = f"largest {across.name} deviation [{micro(across.fine)}]", micro(across.fine)
    bounds = {"clearance": clearance(plant) * fine} if across.unit == "m" else {}
    key = bounds_of(plan).get(across.unit)
    if published is not None and key is not None:
        bounds["published bound"] = published_in_unit(published, key, across.fine)
    if plant.contacts.names and completed.all():  # what the runs are ranked by
        values, label = 100 * closeness(summary, runs), "clearance used up beyond median [%]"
        unit, bounds = "%", {}
    most = float(values.max(initial=0.0))
    bounds = {text: v for text, v in bounds.items() if math.isfinite(v) and v < 30 * most}
    _set_reach(axes, values, list(bounds.values()))
    for row, value in enumerate(values):
        axes.plot(value, row, **(DOT if completed[row] else CROSS))
        place = axes.transAxes.inverted().transform(axes.transData.transform((value, row)))[0]
        beside: dict[str, Any] = {"xytext": (8 if place < 0.5 else -8, 0), "textcoords": "offset points"}
        text = f"{number(float(value), 3)} {unit}" if value < MAX_FIGURE * fine else "diverged"
        axes.annotate(
            text, (value, row), ha="left" if place < 0.5 else "right", va="center", **beside, **NOTE
        )
    for text, value in bounds.items():
        axes.axvline(value, **BOUND_STYLE)
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

    name = verdicts(plan.plant)[int(verdict)]
    text = f"run {index}"
    return text if name == "completed" else f"{text}\n{name.replace(' at ', chr(10) + 'at ')}"


END_STYLES: Mapping[str, dict[str, Any]] = {  # ways in which runs end, the best first; contacts follow
    "within the published bounds": {"facecolor": "#2f7ea8"},
    "completed": {"facecolor": "#e8dcc0"},
    "completed, commands limited": {"facecolor": "#e8dcc0", "hatch": "////"},
    "diverged": {"facecolor": "#c1440e"},
    "not lifted": {"facecolor": "#d8d8d8", "hatch": ".."},
}
TOUCHES: Sequence[dict[str, Any]] = (
    {"facecolor": "#202020"},
    {"facecolor": "#ffffff", "edgecolor": "#202020", "hatch": "xx"},
    {"facecolor": "#202020", "hatch": ".."},
)
BINS = 40  # of a distribution


def distributions_figure(found: Campaign | Summary, published: Published | None = None) -> Figure:
    """Draw the distributions of a campaign's figures of merit over the completed runs, with the published bounds.

    A figure that is the same in every run, or that the reference makes by a jump, is told in a sentence.

    found : the campaign, or its summary
    published : figures of the machine's paper, from `malta.model.read_published`; None: none; a summary has its own

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
    from malta.campaigns.summary import RunLimits, as_summary

    summary = as_summary(found, RunLimits(published))
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
        axes.axvline(bound, **BOUND_STYLE)
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
    published : figures of the machine's paper, from `malta.model.read_published`; None: none; a summary has its own

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
    from malta.campaigns.summary import RunLimits, as_summary

    summary = as_summary(found, RunLimits(published))
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
    bounded = by_way["within the published bounds"].any()
    for label, style in (dict(END_STYLES) | dict(zip(plan.plant.contacts.names, cycle(TOUCHES)))).items():
        if not by_way[label].any():
            continue
        share = 100 * by_way[label] / np.maximum(total, 1)
        axes.bar(
            edges[:-1],
            share,
            np.diff(edges),
            base,
            align="edge",
            label="completed, outside the bounds" if label == "completed" and bounded else label,
            **{"edgecolor": "#ffffff", "linewidth": 0.6, **style},
        )
        base += share
    finish_axes(axes, f"{name} [{'%' if unit == 'percent' else micro(unit)}]", "")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(0, 100)


# The figure of a sensitivity: Sobol indices as bars, a panel for each figure of merit.


MAX_UPRIGHT_NAMES = 6  # names of factors below an axis, at most; more are turned
BARS: dict[str, dict[str, Any]] = {
    "first-order index: alone": {"facecolor": "#d0d0d0", "edgecolor": "#000000", "hatch": "////"},
    "total index: also with others": {"facecolor": "#8c8c8c", "edgecolor": "#000000"},
}


def sensitivity_figure(found: Sensitivity, path: str | Path | None = None) -> Figure:
    """Draw the Sobol indices of a campaign's yield and merits, and save the figure where a path is given.

    found : from `malta.campaigns.sensitivity`
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> options = {"duration": 0.02, "noise": 0.0}
    >>> box = {"m": 0.2, "C": 0.2}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=64, options=options
    ... )
    >>> found = malta.campaigns.sensitivity(
    ...     plan, malta.campaigns.limit_of(plan, "touchdown"), workers=1
    ... )
    >>> figure = malta.report.sensitivity_figure(found)
    >>> figure.axes[0].get_ylabel()
    'share of the variance [-]'
    """
    from malta.report.tables.campaign import run_text

    panels = {"yield": found.of_yield, **found.of_merits}
    shown = {label: indices for label, indices in panels.items() if indices}
    rows, columns = rows_and_columns(len(shown))
    upright = len(found.factors) <= MAX_UPRIGHT_NAMES
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
    return save_figure(figure, path)


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
        {}
        if len(factors) <= MAX_UPRIGHT_NAMES
        else {"rotation": 50, "ha": "right", "rotation_mode": "anchor"}
    )
    axes.set_xticks(at, factors, fontsize=8, **turned)
    axes.set_xlim(-0.6, len(factors) - 0.4)
    ends = [i.first + i.first_half for i in indices] + [i.total + i.total_half for i in indices]
    starts = [i.first - i.first_half for i in indices]
    low, high = axes.get_ylim() if axes.get_shared_y_axes().get_siblings(axes)[1:] else (0.0, 1.05)
    axes.set_ylim(min(low, *starts) - 0.02, max(high, *(1.03 * end for end in ends)))


class CampaignFigures(NamedTuple):
    """The figures of a campaign; a notebook shows all three as the value of a cell.

    distributions : of the figures of merit
    endings : how runs end over the parameters
    worst : the worst runs

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", {"m": 0.1}, samples=8, options=short
    ... )
    >>> figures = malta.report.campaign(malta.campaign(plan, workers=1))
    >>> figures._fields
    ('distributions', 'endings', 'worst')
    """

    distributions: Figure
    endings: Figure
    worst: Figure

    def _ipython_display_(self) -> None:
        """Show every figure, as IPython asks for it."""
        from IPython.display import display

        for figure in self:
            display(figure)


CAMPAIGN_FILES = ("distributions.png", "yield.png", "worst.png")  # of CampaignFigures, in a campaign's folder
"""The files of `CampaignFigures` in a campaign's folder, in their order.

>>> import malta
>>> malta.report.CAMPAIGN_FILES
('distributions.png', 'yield.png', 'worst.png')
"""


def campaign(
    found: Campaign | Summary, folder: str | Path | None = None, published: Published | None = None
) -> CampaignFigures:
    """Draw the results of a campaign, and save them as CAMPAIGN_FILES where a folder is given.

    found : the campaign, or its summary
    folder : of the files; None: nothing is written
    published : figures of the machine's paper, from `malta.model.read_published`; None: none; a summary has its own

    Returns CampaignFigures.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", {"m": 0.1}, samples=8, options=short
    ... )
    >>> figures = malta.report.campaign(malta.campaign(plan, workers=1), "build")
    >>> figures.worst is figures[-1], malta.report.CAMPAIGN_FILES[-1]
    (True, 'worst.png')
    """
    from malta.campaigns.summary import RunLimits, as_summary

    summary = as_summary(found, RunLimits(published))
    figures = CampaignFigures(distributions_figure(summary), yield_figure(summary), worst_figure(summary))
    for figure, name in zip(figures, CAMPAIGN_FILES, strict=True):
        save_figure(figure, None if folder is None else Path(folder) / name)
    return figures
