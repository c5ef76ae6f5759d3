"""Plots over frequency: Bode, singular values, sensitivities with their zones, gang of four."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.loops.curves import LoopCurves
from malta.margins.loop_report import ZONES, zone
from malta.report.figures.drawing import new_figure
from malta.report.plots.panels import (
    FOOT,
    PLACES,
    PlotSheet,
    add_legend,
    chosen_channels,
    decibels,
    draw_level,
    draw_limit,
    finish_frequency,
    head_of,
    loops_of,
    loops_with_channel,
    margins_text,
    mark,
    new_sheet,
    note_style,
    plain,
    rate_text,
    styles_of,
    thin,
    write_above,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.loops.channel_margins import ChannelMargins
    from malta.loops.linear_loops import Place
    from malta.synthesis.curve_limits import CurveLimit

ONE_LOOP = "one loop at a time, the others closed"
RANGE = (-100.0, 120.0)  # dB, of a loop gain that is drawn
MIN_RANGE_DB = 6.0  # dB that an axis shows
MAX_PHASE_STEP = 170.0  # degrees, between neighbours: a pole on the axis
HIGHEST_TURN = 20.0  # degrees: phases begin from 200 below what the slope says to 160 above
ZERO_GAIN_SHARE = 0.1  # of the value beside it: a loop gain that counts as zero at the end of the grid
Channel = str | Sequence[str] | None


def bode(
    source: Any, controller: Any = None, *, channel: Channel = None, at: Place = "sensors", axes: Any = None
) -> Figure:
    """Draw the Bode plot of the loop gain of each channel, the others closed, with its margins drawn in.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : the channel or channels, by name; None: all
    at : where the loop is cut, "sensors" or "forces"
    axes : magnitude and phase of every channel, as `figure.subplots(2, channels)` gives them; None: a new figure

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.bode(spec.plant, controller)
    >>> figure.axes[0].texts[-1].get_text()
    'GM −7.8 … +12.8 dB, PM 45.3°, delay 2.72 ms'
    """
    loops = loops_of(source, controller)
    chosen, styles = chosen_channels(loops, channel, at), styles_of(loops)
    title = f"{title_of(loops)}: Bode plot {PLACES[at]}", ONE_LOOP
    sheet = new_sheet(title, loops, len(chosen), axes, stacked=2, height=1.75)
    for (name, _), (upper, lower) in zip(chosen, sheet.panels, strict=True):
        lines, shown = [], []
        for loop, curves, k, margins in loops_with_channel(loops, name, at):
            gain, style = curves.responses.alone(at)[:, k], styles[loop]
            phase = phase_of(curves.w, gain)
            upper.plot(curves.w, decibels(gain), **style)
            lower.plot(curves.w, phase, **style)
            _draw_margins(upper, lower, curves, phase, margins, style)
            lines.append((margins_text(margins), style["color"]))
            shown.append(curves)
        _finish_bode(upper, lower, shown)
        write_above(upper, name, lines)
    return sheet.figure


def title_of(loops: Mapping[str, LoopCurves]) -> str:
    """The names of the loops in a title."""
    names = list(loops)
    text = names[0] if len(names) == 1 else f"{len(names)} loops"
    return plain(text if len(text) <= 40 else f"{text[:37]}...")


def phase_of(w: FloatArray, gain: Any) -> FloatArray:
    """The unwrapped phase in degrees, which begins where the slope of the gain lets it: an integrator at -90 degrees.

    Where that is half a turn off, as of an unstable pole, it begins below. A pole on the axis lowers it by 180.
    """
    steps = np.mod(np.degrees(np.diff(np.angle(gain))) + 180, 360) - 180
    phase = math.degrees(np.angle(gain[0])) + np.append(
        0, np.cumsum(np.where(steps > MAX_PHASE_STEP, steps - 360, steps))
    )
    slope = math.log(abs(gain[1]) / abs(gain[0])) / math.log(w[1] / w[0]) if abs(gain[0] * gain[1]) else 0.0
    expected = 90 * round(slope)
    if abs(gain[-1]) < ZERO_GAIN_SHARE * abs(
        gain[-2]
    ):  # a zero at the Nyquist frequency, where any phase is as good
        phase[-1] = phase[-2]
    return np.asarray(phase - 360 * math.floor((phase[0] - expected + HIGHEST_TURN) / 360 + 0.5))


def _draw_margins(
    upper: Axes,
    lower: Axes,
    curves: LoopCurves,
    phase: FloatArray,
    margins: ChannelMargins,
    style: Mapping[str, Any],
) -> None:
    """Segments from 0 dB and from -180 degrees (or its like a turn away) to the curves."""
    w = curves.w
    for factor, frequency in zip(margins.gain, margins.gain_frequency, strict=True):
        if 0 < factor < math.inf:
            at = max(frequency, float(w[0]))
            level = -20 * math.log10(factor)
            upper.plot([at, at], [0, level], **thin(style))
            mark(upper, at, level, style)
            mark(lower, at, float(np.interp(math.log(at), np.log(w), phase)), style, markerfacecolor="none")
    if math.isfinite(margins.phase):
        at = margins.phase_frequency
        here = float(np.interp(math.log(at), np.log(w), phase))
        lower.plot([at, at], [360 * round((here + 180) / 360) - 180, here], **thin(style))
        mark(lower, at, here, style)
        mark(upper, at, 0, style, markerfacecolor="none")


def _limit_decibels(axes: Axes) -> None:
    """Limits within RANGE, and so wide that a constant value shows no rounding."""
    low, high = axes.get_ylim()
    more = max(MIN_RANGE_DB - (high - low), 0.0) / 2
    axes.set_ylim(max(low - more, RANGE[0]), min(high + more, RANGE[1]))


def _finish_bode(upper: Axes, lower: Axes, shown: Sequence[LoopCurves]) -> None:
    from matplotlib.ticker import MultipleLocator

    draw_level(upper, 0)
    _limit_decibels(upper)
    lower.set_ylim(
        *(np.array([math.floor(lower.get_ylim()[0] / 45), math.ceil(lower.get_ylim()[1] / 45)]) * 45)
    )
    low, high = lower.get_ylim()
    for level in np.arange(math.ceil((low + 180) / 360), math.floor((high + 180) / 360) + 1) * 360 - 180:
        draw_level(lower, float(level))
    lower.yaxis.set_major_locator(
        MultipleLocator(45 if high - low <= 270 else 90 if high - low <= 720 else 180)
    )
    finish_frequency(upper, shown, "magnitude [dB]", labelled=False)
    finish_frequency(lower, shown, "phase [°]")


def sigma(
    source: Any,
    controller: Any = None,
    *,
    at: Place = "sensors",
    axes: Any = None,
    limits: Sequence[CurveLimit] = (),
) -> Figure:
    """Draw the singular values of L, S and T with all channels: the largest, the smallest, and the band between.

    Signals count in SI units, metres beside radians.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    at : where the loop is cut, "sensors" or "forces"
    axes : three axes, for L, S and T; None: a new figure
    limits : regions that requirements exclude, from `malta.synthesis.curve_limits`

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import control, malta
    >>> old, new = (control.tf([gain], [1, 3, 2, 0]) for gain in (1, 2))
    >>> figure = malta.report.sigma({"old": old, "new": new})
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['singular values of L [dB]', 'singular values of S [dB]', 'singular values of T [dB]']
    """
    loops = loops_of(source, controller)
    chosen_channels(loops, None, at)
    styles = styles_of(loops)
    title = f"{title_of(loops)}: singular values {PLACES[at]}", "all channels together, in SI units"
    sheet = new_sheet(title, loops, 3, axes, height=3.1)
    for k, ((panel,), letter) in enumerate(zip(sheet.panels, "LST", strict=True)):
        lines = []
        for name, curves in loops.items():
            values = decibels(curves.singular_values(curves.responses.cut(at)[k]))
            style = styles[name]
            panel.plot(curves.w, values[:, 0], **style)
            if values.shape[1] > 1:
                panel.plot(curves.w, values[:, -1], **{**style, "linewidth": 0.8})
                panel.fill_between(
                    curves.w, values[:, -1], values[:, 0], color=style["color"], alpha=0.08, linewidth=0
                )
            lines.append((_largest_text(curves, values[:, 0], letter), style["color"]))
        draw_level(panel, 0)
        _limit_decibels(panel)
        finish_frequency(panel, loops.values(), f"singular values of {letter} [dB]")
        for limit in limits if letter == "T" and at == "sensors" else ():
            if limit.curve == "T":
                fails = any(not _holds_bandwidth(curves, limit) for curves in loops.values())
                draw_limit(panel, (0, limit.high), (-math.inf, -3.01), limit.words, fails=fails)
        write_above(panel, letter, lines)
    return sheet.figure


def _holds_bandwidth(curves: LoopCurves, limit: CurveLimit) -> bool:
    """Whether the smallest singular value of T stays above a limit up to its end, of a stable loop."""
    values = curves.singular_values(curves.responses.cut("sensors")[2])[:, -1]
    return curves.stable and bool((values[curves.w <= limit.high] >= limit.limit).all())


def _largest_text(curves: LoopCurves, values: FloatArray, letter: str) -> str:
    """The largest singular value of S or T; of L the last frequency with a value above 0 dB."""
    if letter == "L":
        above = np.flatnonzero(values > 0)
        return f"last 0 dB at {rate_text(curves.w[above[-1]])}" if len(above) else "below 0 dB"
    if not curves.stable:
        return "unstable"
    k = int(np.nanargmax(values))
    text = f"max {10 ** (values[k] / 20):.2f} ({values[k] + 0.0:.1f} dB) at {rate_text(curves.w[k])}"
    return text.replace("-0.0", "0.0").replace("-", "−")


def sensitivity_curves(
    source: Any,
    controller: Any = None,
    *,
    channel: Channel = None,
    at: Place = "sensors",
    axes: Any = None,
    limits: Sequence[CurveLimit] = (),
) -> Figure:
    """Draw `|S_ii|` and `|T_ii|` of each channel, with the zones of ISO 14839-3 and the peaks marked.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : the channel or channels, by name; None: all
    at : where the loop is cut, "sensors" or "forces"
    axes : `|S|` and `|T|` of every channel, as `figure.subplots(2, channels)` gives them; None: a new figure
    limits : regions that requirements exclude, from `malta.synthesis.curve_limits`

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.sensitivity_curves(spec.plant, controller)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['|S| [-]', '|T| [-]']
    """
    loops = loops_of(source, controller)
    chosen, styles = chosen_channels(loops, channel, at), styles_of(loops)
    title = (
        f"{title_of(loops)}: sensitivities {PLACES[at]}",
        "|S| above, with zones A to D of ISO 14839-3; |T| below",
    )
    sheet = new_sheet(title, loops, len(chosen), axes, stacked=2, height=1.75)
    for (name, _), (upper, lower) in zip(chosen, sheet.panels, strict=True):
        lines, shown = [], []
        for loop, curves, k, margins in loops_with_channel(loops, name, at):
            style, (_, S, T) = styles[loop], curves.responses.cut(at)
            upper.plot(curves.w, np.abs(S[:, k, k]), **style)
            lower.plot(curves.w, np.abs(T[:, k, k]), **style)
            text = "UNSTABLE"
            if margins.stable:
                top = int(np.argmax(np.abs(T[:, k, k])))
                at_peak = margins.peak_frequency  # 0 or infinite where |S| has no top between
                mark(
                    upper, float(np.clip(at_peak, curves.w[0], curves.w[-1])), margins.peak_sensitivity, style
                )
                mark(lower, curves.w[top], abs(T[top, k, k]), style)
                peak = margins.peak_sensitivity
                text = f"max|S| {peak:.2f} (zone {zone(peak)}) at "
                text += rate_text(at_peak) if at_peak < np.inf else "infinite frequency"
                text += f", max|T| {abs(T[top, k, k]):.2f}"
            lines.append((text, style["color"]))
            shown.append(curves)
        _draw_zones(upper)
        for panel, letter in ((upper, "S"), (lower, "T")):
            panel.set_yscale("log")
            low, high = panel.get_ylim()
            panel.set_ylim(min(max(low, 1e-3), 0.1), max(min(high, 1e3), 8.0 if letter == "S" else 2.0))
            finish_frequency(panel, shown, f"|{letter}| [-]", labelled=panel is lower)
            draw_level(panel, 1)
        for limit in limits if at == "sensors" else ():
            if limit.curve == "S":
                fails = fails_peak(loops, name, limit)
                draw_limit(upper, (0, math.inf), (limit.limit, math.inf), limit.words, fails=fails)
        write_above(upper, name, lines)
    return sheet.figure


def fails_peak(loops: Mapping[str, LoopCurves], channel: str, limit: CurveLimit) -> bool:
    """Whether the peak sensitivity of a sensor is above a limit in some loop, as the judge of the requirement finds."""
    found = [margins for *_, margins in loops_with_channel(loops, channel, "sensors")]
    return any(not one.stable or one.peak_sensitivity > limit.limit for one in found)


def _draw_zones(axes: Axes) -> None:
    """The limits of the zones; the best and the worst zone are named beside the axes."""
    for limit, _ in ZONES[:-1]:
        axes.axhline(limit, color="#c1440e", linewidth=0.6, linestyle=(0, (1, 2)))
    for (limit, _), name, side in ((ZONES[0], "A", "top"), (ZONES[-2], "D", "bottom")):
        axes.annotate(
            name, (1, limit), xycoords=("axes fraction", "data"), xytext=(3, 0), textcoords="offset points",
            va=side, annotation_clip=False, **note_style(),
        )  # fmt: skip


def gang_of_four(source: Any, controller: Any = None, *, channel: Channel = None, axes: Any = None) -> Figure:
    """Draw S, T, S P and F S of each channel at the sensors: what noise, references and forces do to it.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : outputs, by name; None: all. Output i stands with force i, of the same axis, or with the last force
    axes : four for each channel, row by row; None: a new figure

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.gang_of_four(spec.plant, controller, channel="y")
    >>> len(figure.axes)
    4
    """
    loops = loops_of(source, controller)
    chosen, styles = chosen_channels(loops, channel, "sensors"), styles_of(loops)
    sheet = _gang_sheet(loops, len(chosen), axes)
    for row, (name, unit) in enumerate(chosen):
        panels = [panel for (panel,) in sheet.panels[4 * row : 4 * row + 4]]
        shown, force = [], ""
        for loop, curves, k, _ in loops_with_channel(loops, name, "sensors"):
            r = curves.responses
            j = min(k, len(curves.loop.inputs) - 1)
            force = curves.loop.inputs[j].unit
            places = ((r.S, k, k), (r.T, k, k), (r.SP, k, j), (r.FS, j, k))
            for panel, (G, row_of, column) in zip(panels, places, strict=True):
                panel.plot(curves.w, np.abs(G[:, row_of, column]), **styles[loop])
            shown.append(curves)
        panels[0].set_title(plain(name), fontsize=8.5, loc="left", pad=3, fontweight="bold")
        units = ("-", "-", _ratio(unit, force), _ratio(force, unit))
        for k, (panel, letters, of) in enumerate(zip(panels, ("S", "T", "S P", "F S"), units, strict=True)):
            panel.set_yscale("log")
            low, high = panel.get_ylim()
            panel.set_ylim(min(max(low, high / 1e7), high / 100), high * 1.3)
            if k < 2:
                draw_level(panel, 1)
            finish_frequency(panel, shown, f"|{letters}| [{of}]", labelled=row == len(chosen) - 1)
            panel.tick_params(labelbottom=row == len(chosen) - 1)
    return sheet.figure


def _ratio(upper: str, lower: str) -> str:
    """A unit over another."""
    if upper == lower:
        return "-"
    return f"{upper}/({lower})" if " " in lower else f"{upper}/{lower}"


def _gang_sheet(loops: Mapping[str, LoopCurves], count: int, axes: Any) -> PlotSheet:
    """Four panels in a row for each channel."""
    if axes is not None:
        return new_sheet(("", ""), loops, 4 * count, axes)
    head = head_of(loops) + 0.2
    height = head + FOOT - 0.15 + 2.05 * count
    told = "each channel with the force of its axis; S P: force to output, F S: reading to force"
    figure = new_figure(
        f"{title_of(loops)}: gang of four at the sensors", told,
        size=(13.0, height), left=0.055, right=0.99, bottom=FOOT / height, top=1 - head / height,
        wspace=0.3, hspace=0.2,
    )  # fmt: skip
    add_legend(figure, loops, height)
    grid = figure.subplots(count, 4, squeeze=False)
    return PlotSheet(figure, [(panel,) for panel in grid.ravel()])
