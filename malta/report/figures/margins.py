"""Figures of robustness: margins stage by stage, and the machine's loop along its travel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from malta.bound import at_least
from malta.errors import InputError
from malta.loops.loop import loop_along
from malta.loops.sampled_loops import SampledLoop
from malta.loops.time_domain import Deviation, Recovery, furthest, load_vector, recovery
from malta.margins.loop_report import ZONES, LoopReport
from malta.model.parameters import box_words
from malta.report.figures.drawing import (
    BOUND_STYLE,
    DOT,
    LEGEND,
    MORE_STYLES,
    NOTE,
    PAPER,
    STYLES,
    draw_grid,
    draw_group,
    finish_axes,
    front_lines,
    micro,
    new_figure,
    save_figure,
)
from malta.synthesis.requirements import Trade
from malta.units import FINE_UNITS, unit_factor

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.proof.blocks.gain import Gain
    from malta.proof.margin import Margin
    from malta.synthesis.controller import Controller
    from malta.synthesis.step_response import StepResponse
    from malta.tuning.tune import TuningResult

LOOKS: tuple[dict[str, Any], dict[str, Any]] = ({"color": "#c9c9c9"}, {"color": "#5a5a5a"})  # stages, machine
WITNESS: dict[str, Any] = {"color": "#c1440e", "linewidth": 1.6}
NO_WITNESS: dict[str, Any] = {"marker": ">", "markersize": 7, "linestyle": "none", "color": "#000000"}
MAX_NAMED_PEAK = 12.0  # peak |S| up to which the names of the zones have room


def chain_figure(found: LoopReport, path: str | Path | None = None) -> Figure:
    """Draw margins and peak sensitivities of all stages as bars, and below them both along the travel.

    A machine without a travel has the first parameter that its proofs cover in its place, or nothing below.

    found : from `malta.verify`, with `stages`
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for a report without stages, and for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> figure = malta.report.chain_figure(found)
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['proven margin [% of the box]', 'peak |S| [-], zones of ISO 14839-3']
    """
    if not found.chain:
        raise InputError(found.controller.name, "stages", "none", "a report of malta.verify with stages=True")
    box = box_words(found.uncertainty, found.plant.parameters)
    figure = new_figure(
        f"{found.controller.name}: where the margin goes",
        f"100 %: {box}, all at once",
        left=0.21,
        right=0.97,
        top=0.83,
        wspace=0.17,
        hspace=0.45,
    )
    extent = found.extent
    grid = figure.add_gridspec(
        2 if extent.course else 1, 2, height_ratios=(1.6, 1) if extent.course else None
    )
    left, right = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    _draw_stages(left, right, found)
    if extent.course:
        along = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
        _draw_along_course(*along, found, _bound(found.worst))
        for axes in along:
            along_travel = f"position {extent.stroke} [mm]"
            axes.set_xlabel(along_travel if extent.stroke else f"{extent.course} [{extent.unit}]")
    return save_figure(figure, path)


def _draw_stages(left: Axes, right: Axes, found: LoopReport) -> None:
    """Bars of all stages: the proven margin with its witness, and the peak sensitivity with the zones of its limits."""
    from matplotlib.patches import Patch

    rows = [(link.name, link.margin, link.peak) for link in found.chain]
    extent = found.extent
    if extent.course:
        everything = "all of the travel" if extent.stroke else f"every {extent.course}"
        rows.append((everything, found.travel, float(np.max([place.peak for place in found.places]))))
    most = max([_percent(m.lower) for _, m, _ in rows if m.lower is not None] + [100.0])
    beside: dict[str, Any] = {"xytext": (6, 0), "textcoords": "offset points", "va": "center"}
    for k, (_, margin, peak) in enumerate(rows):
        look, end = LOOKS[k >= len(found.chain) - 1], _draw_margin(left, k, margin)
        text = "none" if margin.lower is None else margin.proven.percent()
        text = f"{text} or more" if margin.exhausted and margin.lower is not None else text
        left.annotate(text, (end, k), **beside, **NOTE)
        stable = not math.isnan(peak)
        if stable:
            right.barh(k, peak, height=0.6, **look)
        right.annotate(
            f"{peak:.2f}" if stable else "unstable", (peak if stable else 0.0, k), **beside, **NOTE | PAPER
        )
        left.patches[k].set(**look)
    ends = [_percent(m.upper) for _, m, _ in rows if not m.exhausted]
    left.set_xlim(0, 1.35 * max([most, *(end for end in ends if end < 2 * most)]))
    left.set_yticks(range(len(rows)), [row[0] for row in rows])
    if ends:
        left.plot([], [], **WITNESS, label="unstable there")
    if any(m.exhausted and m.lower is not None for _, m, _ in rows):
        left.plot([], [], **NO_WITNESS, label="no instability found")
    if left.get_legend_handles_labels()[0]:
        _legend(left)
    named = ("of a stage", "of the machine, under its loads")
    _legend(right, 1.07, [Patch(label=label, **look) for look, label in zip(LOOKS, named, strict=True)])
    left.set_xlabel("proven margin [% of the box]")
    right.set_yticks(range(len(rows)), [""] * len(rows))
    right.tick_params(axis="y", length=0)
    right.set_xlim(0, max(5.6, 1.15 * max(link.peak for link in found.chain if not math.isnan(link.peak))))
    for (limit, zone), (_, worse) in pairwise(ZONES):
        right.axvline(limit, **BOUND_STYLE)
        if right.get_xlim()[1] < MAX_NAMED_PEAK:
            where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
            right.annotate(f"{zone} | {worse}", (limit, 1.005), **where, **NOTE)
    right.set_xlabel("peak |S| [-], zones of ISO 14839-3")
    for axes in (left, right):
        draw_grid(axes)
        axes.set_ylim(len(rows) - 0.4, -0.8)


def _draw_margin(axes: Axes, row: int, margin: Margin) -> float:
    """A bar of the proven margin, and at the end of it what ends it: a witness, or the search. Returns the end."""
    proven = _percent(margin.lower)
    axes.barh(row, proven, height=0.6)
    if margin.exhausted:
        if margin.lower is not None:
            axes.plot(proven, row, **NO_WITNESS)
        return proven
    witness = _percent(margin.upper)
    axes.plot([witness] * 2, [row - 0.38, row + 0.38], **WITNESS)
    return witness if witness < 1.3 * proven else proven


def _draw_along_course(left: Axes, right: Axes, found: LoopReport, bound: float) -> None:
    """Margin and peak sensitivity over the position; each value is the worse of +z and -z, so both sides are alike."""
    places, even = found.places, bool(found.extent.stroke)
    z = np.array([p.position for p in places]) * (1e3 if even else 1.0)
    both = np.concatenate([-z[:0:-1], z]) if even else z

    def mirrored(values: list[float]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        array = np.array(values)
        return np.concatenate([array[:0:-1], array]) if even else array

    left.plot(both, mirrored([_percent(p.margin.lower) for p in places]), **DOT | {"markersize": 4})
    if level := _percent(found.travel.lower):
        left.axhline(level, **STYLES[1])
        left.annotate(
            "proven for all of it at once", (0.02, level), xycoords=("axes fraction", "data"),
            xytext=(0, -3), textcoords="offset points", va="top", **NOTE,
        )  # fmt: skip
    left.set_ylim(0, 1.25 * max([_percent(p.margin.lower) for p in places] + [1.0]))
    left.set_ylabel("margin [%]")
    right.plot(both, mirrored([p.peak for p in places]), **DOT | {"markersize": 4})
    right.set_xlim(left.get_xlim())
    for place, peak in zip(both, mirrored([p.peak for p in places]), strict=True):
        if math.isnan(peak):
            right.annotate(
                "unstable", (float(place), 0.5), xycoords=("data", "axes fraction"), rotation=90, ha="center",
                va="center", **NOTE,
            )  # fmt: skip
    peaks = [p.peak for p in places if not math.isnan(p.peak)] + ([bound] if math.isfinite(bound) else [])
    limit, zone = ZONES[0]
    right.set_ylim(0, max(limit + 0.5, 1.2 * max([*peaks, 1.0])))
    if math.isfinite(bound):
        right.axhline(bound, **STYLES[1])
        right.annotate(
            "upper bound over the box, proven", (0.02, bound), xycoords=("axes fraction", "data"),
            xytext=(0, -3), textcoords="offset points", va="top", **NOTE | PAPER,
        )  # fmt: skip
    right.axhline(limit, **BOUND_STYLE)
    where: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
    right.annotate(f"end of zone {zone}", (0.985, limit), **where, **NOTE)
    right.set_ylabel("peak |S| [-]")
    for axes in (left, right):
        draw_grid(axes)


def _bound(worst: Mapping[str, Gain]) -> float:
    """The proven upper bound of |S| of all sensors; NaN where a sensor has none."""
    found = [gain.upper for gain in worst.values()]
    return max([bound for bound in found if bound is not None]) if found and None not in found else math.nan


def _percent(t: float | None) -> float:
    """A share in percent; 0 for None, and for one without end, which no axis holds."""
    return 100 * t if t is not None and math.isfinite(t) else 0.0


def _legend(axes: Axes, bottom: float = 1.0, handles: Sequence[Artist] | None = None) -> None:
    """A legend of two columns above the axes, of what is drawn or of these handles."""
    where: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, bottom), "borderaxespad": 0.2}
    axes.legend(handles=handles, ncols=2, **where, **LEGEND)


# The figure of how a machine takes loads from outside: deviation over time, and compliance over frequency.


SHOWN_TIME_FACTOR = 1.5  # times the longest time to 1 %
POINTS = 400  # of frequency
# A line that covers another has gaps.
RECOVERY_LOOKS = (STYLES[0], MORE_STYLES[1], STYLES[2], MORE_STYLES[0], *STYLES[1::2], *MORE_STYLES[2:])


def recovery_figure(
    plant: Plant,
    controller: Controller,
    found: Sequence[Recovery] | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw the answer to a unit step of every load from outside, and the compliance over frequency.

    A row for each pair of units, as um under N, with the output that each load moves furthest.

    plant : the machine
    controller : its controller
    found : from `malta.loops.recovery`, where it is known already; None: it is computed
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for a machine without disturbances and for another suffix, CheckError for an unstable loop.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.recovery_figure(spec.plant, controller)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['deviation under 1 N [µm]', 'compliance [µm/N]']
    """
    picked = furthest(recovery(plant, controller) if found is None else found)
    units = {s.name: s.unit for s in plant.disturbances}
    rows: dict[tuple[str, str], list[tuple[Recovery, Deviation]]] = {}
    for load, output in picked:
        rows.setdefault((output.unit, units[load.name]), []).append((load, output))
    height = 0.9 + 2.4 * len(rows)
    figure = new_figure(
        f"{controller.name}: how a load from outside is carried",
        size=(9.0, height),
        left=0.1,
        bottom=0.6 / height,
        top=0.97 - 0.62 / height,
        hspace=0.5,
    )
    panels = figure.subplots(len(rows), 2, squeeze=False)
    loop = loop_along(plant, controller).sampled
    answer = loop.answer()
    for (left, right), ((unit, of), lines) in zip(panels, rows.items(), strict=True):
        _draw_steps(left, plant, answer, lines, FINE_UNITS.get(unit, unit), of)
        _draw_compliance(right, plant, loop, lines, FINE_UNITS.get(unit, unit), of)
    return save_figure(figure, path)


def _draw_steps(
    axes: Axes,
    plant: Plant,
    answer: StepResponse,
    lines: Sequence[tuple[Recovery, Deviation]],
    unit: str,
    of: str,
) -> None:
    """Deviation over time of the output furthest off, after 1 N or 1 N m at t = 0."""
    names = [s.name for s in plant.outputs]
    settled = max(output.settled for _, output in lines)
    end = (
        min(SHOWN_TIME_FACTOR * settled, float(answer.t[-1])) if np.isfinite(settled) else float(answer.t[-1])
    )
    shown = answer.t <= end
    series = {}
    for load, output in lines:
        y = answer.of(load_vector(plant, load.name, load.load)).y[shown, names.index(output.output), 0]
        series[f"{load.name}: {output.output}"] = y * np.sign(y[np.abs(y).argmax()]) / unit_factor(unit, unit)
    columns = draw_group(axes, 1e3 * answer.t[shown], series, RECOVERY_LOOKS)
    finish_axes(axes, "time [ms]", f"deviation under 1 {of} [{micro(unit)}]", legend=columns)


def _draw_compliance(
    axes: Axes,
    plant: Plant,
    loop: SampledLoop,
    lines: Sequence[tuple[Recovery, Deviation]],
    unit: str,
    of: str,
) -> None:
    """Amplitude of the same outputs over frequency, under a load of amplitude 1 N or 1 N m."""
    names = [s.name for s in plant.outputs]
    top = 0.3 * np.pi / loop.sample_time
    turning = loop.resonances
    w: FloatArray = np.union1d(np.geomspace(1.0, top, POINTS), turning[(turning > 1) & (turning < top)])
    series = {}
    for load, output in lines:
        amplitude = np.abs(loop.compliance(w, load_vector(plant, load.name, load.load)))
        series[f"{load.name}: {output.output}"] = amplitude[:, names.index(output.output)] / unit_factor(
            unit, unit
        )
    axes.set(xscale="log", yscale="log")
    draw_group(axes, w / (2 * np.pi), series, RECOVERY_LOOKS)
    finish_axes(
        axes,
        "frequency [Hz]",
        f"compliance [{micro(unit)}/({of})]" if " " in of else f"compliance [{micro(unit)}/{of}]",
    )


# The figure of a search: the Pareto front of noise and motion against the proven margin.


LABELS = ("noise of the force [N rms]", "true motion [µm rms]")  # by trade
MARKS = ((0, "o"), (2, "s"), (1, "D"))  # style of a line and marker


def front_figure(tuned: TuningResult, path: str | Path | None = None) -> Figure:
    """Draw the Pareto front of a search: force noise and motion over the proven margin, the chosen trial ringed.

    A dot has the least force noise, or the least motion, that goes with its margin. The chosen trial has to keep the
    bounds of both and of the experiments at once, so it may lie off either front.

    tuned : from `malta.tune`
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    >>> import malta
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import TuningResult
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = TuningResult(spec, front[1], (), front, trials=120)  # of malta.tune
    >>> figure = malta.report.front_figure(tuned)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['noise of the force [N rms]', 'true motion [µm rms]']
    """
    asked, chosen, front = tuned.spec.specification, tuned.trial, tuned.front
    taken = next((one for one in front if one.values == chosen.values), chosen)
    others = [one for one in front if one is not taken] or [taken]
    kept = (
        ("keeps all that is asked for" if tuned.reached else f"misses {tuned.binding.name.replace('_', ' ')}")
        if tuned.requirements
        else "was not judged"
    )
    share = at_least(taken.figures["margin"]).percent()
    found = f"{tuned.trials} trials; open marks: taken, margin {share}, which {kept}; "
    found += "filled: least force noise, or least motion, at a margin"
    figure = new_figure(f"{tuned.spec.name}: margin against noise", found, size=(9.0, 4.6), left=0.1)
    panels: Any = figure.subplots(1, 2)
    for axes, trade, y in zip(panels, get_args(Trade), LABELS, strict=True):
        lines = front_lines(tuned.spec.plant, taken.figures, trade)
        axes.set_yscale("log")
        for (name, label, scale, _), (style, marker) in zip(lines, cycle(MARKS), strict=False):
            if all(name in one.figures for one in front):
                points = [(100 * one.figures["margin"], scale * one.figures[name]) for one in others]
                where = 100 * taken.figures["margin"], scale * taken.figures[name]
                _draw_points(axes, points, where, STYLES[style] | {"marker": marker, "label": label})
        if "margin" in asked:
            axes.axvline(100 * asked["margin"], **BOUND_STYLE)
            above: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
            axes.annotate("asked for", (100 * asked["margin"], 1.01), **above, **NOTE)
        axes.margins(x=0.04)
        finish_axes(axes, "proven margin [% of the box]", y, legend=2)
        axes.margins(x=0.04)
    return save_figure(figure, path)


def _draw_points(
    axes: Axes, points: Sequence[tuple[float, float]], taken: tuple[float, float], style: dict[str, Any]
) -> None:
    """Draw trials, those that none beats as a line where they are more than two, and a ring at the one taken."""
    best = _pareto_front(points)
    if len(best) <= 2:
        best, style = sorted(points), style | {"linestyle": "none"}
    axes.plot(*np.array(best).T, markersize=4, **style)
    ring = {"markersize": 10, "markerfacecolor": "none", "markeredgecolor": style["color"]}
    axes.plot(*taken, **DOT | ring | {"marker": style["marker"]})


def _pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points (margin, size) that no other beats in both, by margin."""
    found: list[tuple[float, float]] = []
    for margin, size in sorted(points, key=lambda point: (-point[0], point[1])):
        if not found or size < found[-1][1]:
            found.append((margin, size))
    return found[::-1]
