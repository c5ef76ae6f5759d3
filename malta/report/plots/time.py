"""Plots over time: steps of the references, and loads from outside with the compliance over frequency."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.loops.steps import StepFigures, loop_steps, step_figures
from malta.report.figures.drawing import draw_grid, micro, number
from malta.report.plots.frequency import Channel, title_of
from malta.report.plots.panels import (
    chosen_channels,
    draw_level,
    draw_limit,
    finish_frequency,
    loops_of,
    loops_with_channel,
    mark,
    new_sheet,
    plain,
    rate_text,
    seconds_text,
    styles_of,
    thin,
    write_above,
)
from malta.units import FINE_UNITS, unit_factor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.loops.curves import LoopCurves
    from malta.synthesis.curve_limits import CurveLimit
    from malta.synthesis.step_response import StepResponse

SHOWN_TIME_FACTOR = 1.6  # times the longest settling time
MAX_TIME_FACTOR = 60.0  # times the shortest rise or time to the peak
MAX_DOTTED_SAMPLES = 60  # samples in a window: each gets a dot
MAX_LINEAR_RATIO = 20.0  # of the largest to the smallest peak of several lines: a logarithmic axis
POINTS = 1500  # of a line
TIMES = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6))


def step(source: Any, controller: Any = None, *, channel: Channel = None, axes: Any = None) -> Figure:
    """Draw the answer of each output to a unit step of its own reference, by the linear loop: no limits or feedforward.

    Marked: 10 to 90 % (rise), the largest value (overshoot), and the time after which it stays within 2 % (settling).

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : the channel or channels, by name; None: all
    axes : one for each channel; None: a new figure

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import control, malta
    >>> figure = malta.report.step(control.tf([1], [1, 1, 0]))  # zeta = 0.5
    >>> figure.axes[0].texts[-1].get_text()
    'rise 1.64 s, overshoot 16.3 %, settled 8.08 s'
    """
    loops = loops_of(source, controller)
    chosen, styles = chosen_channels(loops, channel, "sensors"), styles_of(loops)
    answers = {name: loop_steps(curves.loop).references for name, curves in loops.items()}
    title = (
        f"{title_of(loops)}: step of each reference",
        "linear loop, without limits and feedforward of rates",
    )
    sheet = new_sheet(title, loops, len(chosen), axes, height=2.3)
    for (name, unit), (panel,) in zip(chosen, sheet.panels, strict=True):
        rows = [(loop, answers[loop], k, k) for loop, _, k, _ in loops_with_channel(loops, name, "sensors")]
        figures = [step_figures(answer, k, column) for _, answer, k, column in rows]
        window = _window(rows, figures)
        lines = []
        for (loop, answer, k, column), found in zip(rows, figures, strict=True):
            _draw_answer(panel, answer, k, column, window, _with_dots(styles[loop], loops[loop], window))
            _mark_step(panel, answer, k, found, styles[loop])
            lines.append((_step_text(found), styles[loop]["color"]))
        draw_level(panel, 1)
        _hold_range(panel, rows, window)
        _finish_time(panel, window, f"{name} over its reference [{_over(unit, unit)}]")
        write_above(panel, name, lines)
    return sheet.figure


def _over(upper: str, lower: str) -> str:
    if upper == lower:
        return "-" if upper == "1" else f"{upper}/{lower}"
    return micro(upper if lower == "1" else f"{upper}/({lower})" if " " in lower else f"{upper}/{lower}")


def _step_text(found: StepFigures) -> str:
    if math.isnan(found.final):
        return "UNSTABLE"
    if math.isnan(found.rise):
        return f"returns to 0, settled {seconds_text(found.settling)}"
    over = f"overshoot {number(100 * found.overshoot, 3)} %"
    ends = "" if abs(found.final - 1) < 1e-3 else f", ends at {found.final:.3g}"
    return f"rise {seconds_text(found.rise)}, {over}, settled {seconds_text(found.settling)}{ends}"


def _window(rows: Sequence[tuple[str, StepResponse, int, int]], figures: Sequence[StepFigures]) -> float:
    """The time to show, s: until the slowest loop has settled, as long as the fastest can still be seen.

    Of unstable loops alone: all that is known.
    """
    settled = [f.settling for f in figures if math.isfinite(f.settling) and f.settling > 0]
    if settled:
        seen = min(max(f.peak_time, 0.0 if math.isnan(f.rise) else f.rise) for f in figures if f.settling > 0)
        return min(
            SHOWN_TIME_FACTOR * max(settled), max(MAX_TIME_FACTOR * seen, SHOWN_TIME_FACTOR * min(settled))
        )
    return max(float(answer.t[min(len(answer.t) - 1, POINTS)]) for _, answer, *_ in rows)


def _draw_answer(
    axes: Axes,
    answer: StepResponse,
    k: int,
    column: int,
    window: float,
    style: Mapping[str, Any],
    scale: float = 1.0,
) -> None:
    """One line, of points that are evenly spread over the window."""
    last = min(int(np.searchsorted(answer.t, window)) + 1, len(answer.t))
    picked = np.unique(np.searchsorted(answer.t[:last], np.linspace(0, answer.t[last - 1], POINTS)))
    t, y = answer.t[picked], answer.y[picked, k, column]
    if t[-1] < window and math.isfinite(answer.final[k, column]):  # nothing changes any more
        t, y = np.append(t, window), np.append(y, answer.final[k, column])
    axes.plot(t, scale * y, **style)


def _with_dots(style: Mapping[str, Any], curves: LoopCurves, window: float) -> Mapping[str, Any]:
    """The style of a line, with a dot at each sample where a window has few."""
    T = curves.loop.sample_time
    return (
        style if T is None or window / T > MAX_DOTTED_SAMPLES else {**style, "marker": ".", "markersize": 4}
    )


def _mark_step(
    axes: Axes, answer: StepResponse, k: int, found: StepFigures, style: Mapping[str, Any]
) -> None:
    """The rise as a bar below the line, the peak as a dot, the settling time as an upright line at the final value."""
    if math.isnan(found.rise):
        return
    share = answer.y[:, k, k] / found.final
    for level in (0.1, 0.9):
        at = int(np.argmax(share >= level))
        mark(axes, answer.t[at], answer.y[at, k, k], style, marker="|", markersize=8)
    if found.overshoot > 1e-3:
        mark(axes, found.peak_time, found.peak, style)
    if math.isfinite(found.settling):
        axes.plot(
            2 * [found.settling], np.array([0.95, 1.05]) * found.final, **thin(style) | {"linewidth": 1.4}
        )


def _hold_range(
    axes: Axes, rows: Sequence[tuple[str, StepResponse, int, int]], window: float, scale: float = 1.0
) -> None:
    """Keep the stable answers visible beside unstable ones, which leave the axes."""
    values = [
        scale * answer.y[answer.t <= window, k, column]
        for _, answer, k, column in rows
        if math.isfinite(answer.final[k, column])
    ]
    if 0 < len(values) < len(rows):
        known = np.concatenate(values)
        reach = float(known.max() - min(known.min(), 0.0)) or 1.0
        axes.set_ylim(float(min(known.min(), 0.0)) - 0.6 * reach, float(known.max()) + 0.6 * reach)


def _spread_apart(axes: Axes, peaks: Sequence[float]) -> None:
    """A symmetric logarithmic axis where the largest values of the lines are far apart: the small ones are seen."""
    from matplotlib.ticker import NullLocator, SymmetricalLogLocator

    sizes = [abs(peak) for peak in peaks if peak]
    if len(sizes) < 2 or max(sizes) < MAX_LINEAR_RATIO * min(sizes):
        return
    linear = 10.0 ** math.floor(math.log10(min(sizes) / 3))
    axes.set_yscale("symlog", linthresh=linear)
    axes.yaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=linear))
    axes.yaxis.set_minor_locator(NullLocator())


def _finish_time(axes: Axes, window: float, y: str) -> None:
    """A linear axis of time in a unit that fits."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    unit, size = next(((u, s) for u, s in TIMES if window >= 2 * s), TIMES[-1])
    axes.set_xlim(0, window)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    scaled = [tick * size for tick in MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(0, window / size)]
    axes.set_xticks([tick for tick in scaled if tick <= window])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / size:g}"))
    draw_grid(axes)
    axes.tick_params(labelsize=8)
    axes.set_xlabel(f"time [{unit}]", fontsize=8.5)
    axes.set_ylabel(plain(y), fontsize=8.5)


def load_response(
    source: Any,
    controller: Any = None,
    *,
    channel: Channel = None,
    axes: Any = None,
    limits: Sequence[CurveLimit] = (),
) -> Figure:
    """Draw deviations after a constant load of 1 N or 1 N m from outside, and the compliance over frequency below.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : outputs, by name; None: of each load the output that it moves furthest
    axes : time and frequency of every load and output, as `figure.subplots(2, n)` gives them; None: a new figure
    limits : regions that requirements exclude, from `malta.synthesis.curve_limits`

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for loops on which no loads act from outside, for an unknown channel and another number of axes.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.load_response(spec.plant, controller)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['y [µm/N]', '|y/w| [µm/N]']
    """
    loops = loops_of(source, controller)
    answers = {name: loop_steps(curves.loop).loads for name, curves in loops.items()}
    pairs = _pairs(loops, answers, channel)
    styles = styles_of(loops)
    title = (
        f"{title_of(loops)}: loads from outside",
        "above: constant, one unit; below: compliance over frequency",
    )
    sheet = new_sheet(title, loops, len(pairs), axes, stacked=2, height=1.85, ticks=True)
    for (load, output), (upper, lower) in zip(pairs, sheet.panels, strict=True):
        rows, units, shown = [], ("1", "1"), []
        for name, curves in loops.items():
            found = _places(curves, load, output)
            if found is None:
                continue
            k, column, units = found
            rows.append((name, answers[name], k, column))
            shown.append(curves)
        figures = [step_figures(answer, k, column) for _, answer, k, column in rows]
        window = _window(rows, figures)
        fine = FINE_UNITS.get(units[0], units[0])
        scale = 1 / unit_factor(fine, fine) if fine != units[0] else 1.0
        lines = []
        for (name, answer, k, column), found_figures, curves in zip(rows, figures, shown, strict=True):
            style = styles[name]
            _draw_answer(upper, answer, k, column, window, _with_dots(style, curves, window), scale)
            size = np.abs(curves.responses.compliance[:, k, column]) * scale
            lower.plot(curves.w, size, **style)
            lines.append(
                (_load_text(curves, size, found_figures, scale, _over(fine, units[1])), style["color"])
            )
            if curves.stable:
                mark(upper, found_figures.peak_time, found_figures.peak * scale, style)
                mark(lower, curves.w[int(size.argmax())], size.max(), style)
        _hold_range(upper, rows, window, scale)
        _spread_apart(upper, [scale * f.peak for f, c in zip(figures, shown, strict=True) if c.stable])
        own = [one for one in limits if one.curve == "load" and one.load == load and output in one.signals]
        _draw_load_limits(upper, own, rows, scale)
        _finish_time(upper, window, f"{output} [{_over(fine, units[1])}]")
        lower.set_yscale("log")
        low, high = lower.get_ylim()
        lower.set_ylim(max(low, high / 1e6), high * 1.5)
        finish_frequency(lower, shown, f"|{output}/{load}| [{_over(fine, units[1])}]")
        write_above(upper, f"{load} → {output}", lines)
    return sheet.figure


def _draw_load_limits(
    axes: Axes, limits: Sequence[CurveLimit], rows: Sequence[tuple[str, StepResponse, int, int]], scale: float
) -> None:
    """What is asked of deviations, from a time on: regions above and below, so that the next of them is seen."""
    shown = sorted(limits, key=lambda one: -one.limit)
    for line, limit in enumerate(shown):
        sizes = [(a.left(limit.low) if limit.low else a.largest)[k, column] for _, a, k, column in rows]
        fails = not all(size <= limit.limit for size in sizes)
        side = 1 if sum(axes.get_ylim()) >= 0 else -1
        low, high = axes.get_ylim()
        reach = max(abs(low), abs(high), 1.15 * scale * limit.limit)
        axes.set_ylim(min(low, -reach) if side < 0 else low, max(high, reach) if side > 0 else high)
        above = min((one.limit for one in shown[:line] if one.low <= limit.low), default=math.inf)
        region = sorted((side * scale * limit.limit, side * scale * above))  # up to the next wider limit
        draw_limit(axes, (limit.low, math.inf), (region[0], region[1]), limit.words, fails=fails, line=line)


def _load_text(curves: LoopCurves, size: Any, found: StepFigures, scale: float, unit: str) -> str:
    if not curves.stable:
        return "UNSTABLE"
    at = rate_text(float(curves.w[int(size.argmax())]))
    ends = f", stays {number(scale * found.final, 3)}" if abs(found.final) > 1e-6 * abs(found.peak) else ""
    return f"peak {number(scale * found.peak, 3)} {unit}{ends}; max {number(float(size.max()), 3)} at {at}"


def _places(curves: LoopCurves, load: str, output: str) -> tuple[int, int, tuple[str, str]] | None:
    """The indices of an output and a load, and their units; None where a loop has not both."""
    outputs, loads = curves.loop.outputs, curves.loop.loads
    k = next((i for i, s in enumerate(outputs) if s.name == output), None)
    column = next((i for i, s in enumerate(loads) if s.name == load), None)
    if k is None or column is None:
        return None
    return k, column, (outputs[k].unit, loads[column].unit)


def _pairs(
    loops: Mapping[str, LoopCurves], answers: Mapping[str, StepResponse], channel: Channel
) -> list[tuple[str, str]]:
    """Loads with the outputs to show: those named, or of each load the output that it moves furthest for its unit."""
    loads = dict.fromkeys(s.name for curves in loops.values() for s in curves.loop.loads)
    if not loads:
        raise InputError(
            "plot", "load", "no loads from outside", "a machine with disturbances, or plant and controller"
        )
    if channel is not None:
        outputs = [name for name, _ in chosen_channels(loops, channel, "sensors")]
        found = [
            (load, output) for load in loads for output in outputs if _moves(loops, answers, load, output)
        ]
        if not found:
            raise InputError("plot", "channel", " ".join(outputs), "an output that a load from outside moves")
        return found
    return [(load, output) for load in loads if (output := _furthest(loops, answers, load)) is not None]


def _moves(
    loops: Mapping[str, LoopCurves], answers: Mapping[str, StepResponse], load: str, output: str
) -> bool:
    """Whether a load moves an output of any loop."""
    found = [(name, _places(curves, load, output)) for name, curves in loops.items()]
    return any(np.abs(answers[name].y[:, at[0], at[1]]).max() > 0 for name, at in found if at is not None)


def _furthest(loops: Mapping[str, LoopCurves], answers: Mapping[str, StepResponse], load: str) -> str | None:
    """The output that a load moves furthest in the first loop that has the load, for its unit; None: it moves none."""
    for name, curves in loops.items():
        known = [s.name for s in curves.loop.loads]
        if load not in known:
            continue
        largest = np.abs(np.nan_to_num(answers[name].y)).max(axis=0)
        units = [s.unit for s in curves.loop.outputs]
        whole = {unit: max(largest[k].max() for k, u in enumerate(units) if u == unit) for unit in units}
        moved = [largest[k, known.index(load)] / max(whole[u], 1e-300) for k, u in enumerate(units)]
        return curves.loop.outputs[int(np.argmax(moved))].name if max(moved) > 1e-9 else None
    return None
