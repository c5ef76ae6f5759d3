"""Parts of plots of loops: which loops and channels, panels for each channel, and what is written above them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from malta.display import quantity
from malta.errors import InputError
from malta.loops.curves import LoopCurves, loop_curves
from malta.report.figures.drawing import (
    BOUND_LINE,
    BOUND_STYLE,
    MORE_STYLES,
    NOTE,
    STYLES,
    draw_grid,
    new_figure,
    number,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Transform

    from malta.arrays import ComplexArray, FloatArray
    from malta.loops.channel_margins import ChannelMargins
    from malta.loops.linear_loops import Place

LINE = 0.155  # inch, of text above a panel
FOOT = 0.64  # inch, below a panel of frequency
SECOND_AXIS_OFFSET = 16.0  # points, from the numbers below an axis to the same in Hz
DECADES = 3.0  # shown below the first crossing of unit gain
FORBIDDEN = "#b3261e"  # colour of what a requirement excludes
LIMIT_LINE: dict[str, Any] = {"color": FORBIDDEN, "linewidth": 1.2, "gid": BOUND_LINE, "zorder": 2}
MOST_LINES = 3  # loops whose margins are written above a panel
PLACES: Mapping[str, str] = {"sensors": "at the sensors", "forces": "at the forces"}
CLEAR_BOX: dict[str, Any] = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.2}
SMALL_TEXT: dict[str, Any] = {"fontsize": 7.5, "va": "bottom", "bbox": CLEAR_BOX}


class PlotSheet(NamedTuple):
    """A figure and its panels, a tuple of them for each channel from top to bottom."""

    figure: Figure
    panels: Sequence[tuple[Axes, ...]]


def loops_of(source: Any, controller: Any = None) -> dict[str, LoopCurves]:
    """The curves of one loop or of a mapping name -> loop, by name. Raises InputError for no loop at all."""
    if not isinstance(source, Mapping):
        curves = loop_curves(source, controller)
        return {curves.name: curves}
    if not source:
        raise InputError("plot", "loops", "none", "a loop, or a table of loops by name")
    found = {str(name): loop_curves(loop, name=str(name)) for name, loop in source.items()}
    low = min(float(curves.w[0]) for curves in found.values())
    high = max(float(curves.w[-1]) for curves in found.values())
    return {name: curves.over(low, high) for name, curves in found.items()}


def styles_of(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """A style for each loop, distinct without colour."""
    styles = (*STYLES, *MORE_STYLES)
    return {name: styles[k % len(styles)] for k, name in enumerate(names)}


def chosen_channels(
    loops: Mapping[str, LoopCurves], channel: str | Sequence[str] | None, at: Place
) -> list[tuple[str, str]]:
    """Names and units of the channels to draw: those named, or all of all loops, in their order.

    Raises InputError for a channel that no loop has, and for an unknown place.
    """
    if at not in PLACES:
        raise InputError("plot", "at", repr(at), " or ".join(PLACES))
    known = dict(chain.from_iterable(curves.channels(at) for curves in loops.values()))
    if channel is None:
        return list(known.items())
    names = [channel] if isinstance(channel, str) else list(channel)
    for name in names:
        if name not in known:
            raise InputError("plot", "channel", repr(name), "one of " + " ".join(known))
    return [(name, known[name]) for name in dict.fromkeys(names)]


def loops_with_channel(
    loops: Mapping[str, LoopCurves], channel: str, at: Place
) -> Iterable[tuple[str, LoopCurves, int, ChannelMargins]]:
    """The loops that have a channel: name, curves, the channel's index and its margins."""
    for name, curves in loops.items():
        if channel in [s.name for s in curves.channels(at)]:
            k = curves.channel_index(channel, at)
            yield name, curves, k, curves.margins_at(at)[k]


def new_sheet(
    title: tuple[str, str],
    loops: Mapping[str, LoopCurves],
    count: int,
    axes: Any,
    *,
    stacked: int = 1,
    height: float = 2.6,
    ticks: bool = False,
) -> PlotSheet:
    """A sheet of `count` channels, or the axes of the caller as one.

    title : and the line below it
    stacked : panels of one channel, above each other
    height : inch, of a panel
    ticks : whether stacked panels have an axis each; else they share that of frequency

    Raises InputError for another number of axes.
    """
    if axes is not None:
        given = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(given) != count * stacked:
            raise InputError(
                "plot", "axes", str(len(given)), f"{count * stacked}, as many as there are panels"
            )
        rows = np.array(given, dtype=object).reshape(stacked, count)
        figure: Figure = given[0].figure
        return PlotSheet(figure, [tuple(column) for column in rows.T])
    columns = min(count, 3) if count != 4 else 2
    blocks = math.ceil(count / columns)
    lines = 1 + min(len(loops), MOST_LINES)
    head, foot, above = head_of(loops), FOOT, LINE * lines + 0.08
    gap = foot + 0.1 if ticks else 0.12
    each = above + height * stacked + gap * (stacked - 1) + foot
    width, whole = {1: 7.5, 2: 9.5}.get(columns, 12.0), head + each * blocks
    figure = new_figure(*title, size=(width, whole))
    add_legend(figure, loops, whole)
    left, right = 0.72 / width, 1 - 0.4 / width
    panels = []
    for k in range(count):
        row, column = divmod(k, columns)
        top = 1 - (head + row * each + above) / whole
        bottom = 1 - (head + (row + 1) * each - foot) / whole
        grid = figure.add_gridspec(
            stacked, columns, left=left, right=right, bottom=bottom, top=top, hspace=gap / height, wspace=0.27
        )
        first = figure.add_subplot(grid[0, column])
        others = [
            figure.add_subplot(grid[i, column], sharex=None if ticks else first) for i in range(1, stacked)
        ]
        for upper in [] if ticks else [first, *others][:-1]:
            upper.tick_params(labelbottom=False)
        panels.append((first, *others))
    return PlotSheet(figure, panels)


def head_of(loops: Mapping[str, LoopCurves]) -> float:
    """The height of the title, the line below it and the legend, inch."""
    return 0.52 if len(loops) < 2 else 0.75 + 0.18 * ((len(loops) - 1) // 4)


def add_legend(
    figure: Figure, loops: Mapping[str, LoopCurves], height: float, markers: Sequence[str] = ()
) -> None:
    """A legend of the loops below the title, where there are several: of their lines, or of their markers."""
    if len(loops) < 2:
        return
    from matplotlib.lines import Line2D

    styles = list(styles_of(loops).values())
    handles = [Line2D([], [], **style) for style in styles]
    if markers:
        hollow: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "markersize": 6.5}
        handles = [
            Line2D([], [], color=style["color"], marker=markers[k % len(markers)], **hollow)
            for k, style in enumerate(styles)
        ]
    names = [name if len(name) <= 40 else f"{name[:37]}..." for name in loops]
    figure.legend(
        handles,
        [plain(name) for name in names],
        ncols=min(len(loops), 4),
        loc="upper center",
        bbox_to_anchor=(0.5, 1 - 0.45 / height),
        frameon=False,
        fontsize=8.5,
        handlelength=3.0,
    )


def plain(text: str) -> str:
    """A text in which no character starts a formula."""
    return text.replace("$", r"\$")


def write_above(axes: Axes, title: str, lines: Sequence[tuple[str, str]]) -> None:
    """Write the channel's name above its panel, and below it lines of (text, colour)."""
    shown = lines[:MOST_LINES]
    for k, (text, colour) in enumerate([(title, "#000000"), *shown]):
        up = 72 * LINE * (len(shown) - k) + 3
        axes.annotate(
            plain(text), (0, 1), xycoords="axes fraction", xytext=(0, up), textcoords="offset points",
            color=colour, fontweight="bold" if k == 0 else "normal", annotation_clip=False, **SMALL_TEXT,
        )  # fmt: skip


def margins_text(found: ChannelMargins, *, turns: bool = False) -> str:
    """The margins of a channel in one line, with its delay margin or, by `turns`, with encirclements and open poles."""
    counted = f"N {found.encirclements}, P {found.unstable_poles}"
    if not found.stable:
        return f"UNSTABLE; {counted}"
    low, high = (20 * math.log10(k) if 0 < k < math.inf else math.nan for k in found.gain)
    if math.isnan(low):
        gain = "GM ∞" if math.isnan(high) else f"GM {high:.1f} dB"
    else:
        gain = f"GM {low:.1f} … " + ("∞" if math.isnan(high) else f"+{high:.1f} dB")
    phase = f"PM {math.degrees(found.phase):.1f}°" if math.isfinite(found.phase) else "PM ∞"
    last = counted if turns else f"delay {seconds_text(found.delay)}"
    return f"{gain}, {phase}, {last}".replace("-", "−")


def seconds_text(value: float) -> str:
    """A time in a unit with few digits."""
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if abs(value) >= size:
            return f"{number(value / size, 3)} {unit}"
    return f"{number(value * 1e6, 3)} µs"


def rate_text(w: float) -> str:
    """A frequency in rad/s and in Hz with few digits."""
    return f"{number(w, 4)} rad/s ({quantity(w / (2 * math.pi), 'Hz')})"


def finish_frequency(axes: Axes, loops: Iterable[LoopCurves], y: str, *, labelled: bool = True) -> None:
    """A logarithmic axis of frequency that ends where the curves do, with a grid; `labelled`: with its label."""
    from matplotlib.ticker import NullFormatter

    shown = list(loops)
    axes.set_xscale("log")
    axes.set_xlim(min(_lowest(curves) for curves in shown), max(float(curves.w[-1]) for curves in shown))
    draw_grid(axes)
    axes.tick_params(labelsize=8)
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(plain(y), fontsize=8.5)
    if labelled:
        axes.set_xlabel("frequency [rad/s]", fontsize=8.5)
        add_hertz(axes, "bottom")


def add_hertz(axes: Axes, side: Literal["bottom", "right"]) -> None:
    """Hz of an axis in rad/s: a second row of numbers below that of x, or numbers at the other side of y."""
    from matplotlib.ticker import NullFormatter, NullLocator

    ways: Any = (lambda w: w / (2 * math.pi), lambda f: f * 2 * math.pi)
    if side == "bottom":
        hertz = axes.secondary_xaxis("bottom", functions=ways)
        hertz.spines["bottom"].set(position=("outward", SECOND_AXIS_OFFSET), visible=False)
        hertz.tick_params(which="both", length=0, labelsize=8, labelcolor=NOTE["color"])
        hertz.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.labelpad += SECOND_AXIS_OFFSET - 2
        hertz.set_xlabel("[Hz]", fontsize=8, color=NOTE["color"], ha="right", va="top")
        hertz.xaxis.set_label_coords(0, 0, axes.transAxes + _points(axes, -16, -SECOND_AXIS_OFFSET - 4))
    else:
        hertz = axes.secondary_yaxis("right", functions=ways)
        if axes.get_yscale() == "symlog":
            symlog: Any = axes.yaxis.get_transform()
            hertz.set_yscale("symlog", linthresh=symlog.linthresh / (2 * math.pi))
            hertz.yaxis.set_minor_locator(NullLocator())
        else:
            hertz.locator_params(axis="y", nbins=5)
        hertz.spines["right"].set_visible(False)
        hertz.tick_params(labelsize=8, labelcolor=NOTE["color"], color=NOTE["color"])
        hertz.set_ylabel("[Hz]", fontsize=8, color=NOTE["color"], rotation=0, ha="left", va="top")
        hertz.yaxis.set_label_coords(1, 0, axes.transAxes + _points(axes, 14, -6))


def _points(axes: Axes, x: float, y: float) -> Transform:
    """A shift by so many points."""
    from matplotlib.transforms import ScaledTranslation

    return ScaledTranslation(x / 72, y / 72, axes.figure.dpi_scale_trans)


def _lowest(curves: LoopCurves) -> float:
    """The lowest frequency to show: DECADES below the first crossing of unit gain, or where the curves begin."""
    first = [c.frequency for margins in curves.margins for c in margins.gain_crossings]
    return max(float(curves.w[0]), min(first) / 10**DECADES) if first else float(curves.w[0])


def decibels(values: FloatArray | ComplexArray) -> FloatArray:
    """Magnitudes in dB."""
    with np.errstate(divide="ignore"):
        return np.asarray(20 * np.log10(np.abs(values)))


def mark(axes: Axes, x: Any, y: Any, style: Mapping[str, Any], **drawn: Any) -> None:
    """A dot in the colour of a loop."""
    look: dict[str, Any] = {"marker": "o", "markersize": 4.5, "linestyle": "none", "zorder": 4}
    axes.plot(x, y, **look | {"color": style["color"]} | drawn)


def thin(style: Mapping[str, Any]) -> dict[str, Any]:
    """A thin solid line in the colour of a loop."""
    return {"color": style["color"], "linestyle": "-", "linewidth": 0.9, "zorder": 3}


def draw_level(axes: Axes, value: float) -> None:
    """A light line at a value of y."""
    axes.axhline(value, **BOUND_STYLE)


def draw_limit(
    axes: Axes,
    along: tuple[float, float],
    across: tuple[float, float],
    text: str,
    *,
    fails: bool,
    line: int | None = None,
) -> None:
    """A region of a panel with its final limits that curves may not enter: shaded, and hatched where one does.

    along, across : the region, low and high, of x and y; what lies outside of the panel is cut off
    text : the requirement
    line : of several regions, in which line below the panel's top their texts end at its right; None: at the
        region's edge
    """
    edges = [sorted(axes.get_xlim()), sorted(axes.get_ylim())]
    (left, right), (low, high) = (
        (max(side[0], edge[0]), min(side[1], edge[1]))
        for side, edge in zip((along, across), edges, strict=True)
    )
    if not (left < right and low < high):
        return
    upward = across[0] > edges[1][0]  # the region lies above its limit
    level = low if upward else high
    for style in region_styles(fails=fails):
        axes.fill_between([left, right], low, high, **style)
    axes.plot([left, right], [level, level], **LIMIT_LINE)
    if right < edges[0][1]:
        axes.plot([right, right], [low, high], **LIMIT_LINE)
    look = limit_text(fails=fails) | ({"bbox": CLEAR_BOX} if fails or line is not None else {})
    look |= {"textcoords": "offset points", "zorder": 6}
    words = plain(f"{text} {'FAILS' if fails else 'asked'}")
    if line is None:
        move = (3, 2 if upward else -2)
        axes.annotate(words, (left, level), xytext=move, va="bottom" if upward else "top", ha="left", **look)
    else:  # at its end a response has decayed
        axes.annotate(
            words, (1, 1), xytext=(-3, -3 - 11 * line), xycoords="axes fraction", va="top", ha="right", **look
        )


def region_styles(*, fails: bool) -> list[dict[str, Any]]:
    """The looks in which a region that a requirement excludes is drawn: shaded, then hatched, which has no ground."""
    shade: dict[str, Any] = {"color": FORBIDDEN, "linewidth": 0, "zorder": 0.5, "alpha": 0.1 + 0.1 * fails}
    lines: dict[str, Any] = {"facecolor": "none", "edgecolor": FORBIDDEN, "hatch": "////"}
    return [shade, {**lines, "linewidth": 0, "zorder": 0.6}] if fails else [shade]


def limit_text(*, fails: bool) -> dict[str, Any]:
    """The look of the name of a region that a requirement excludes."""
    return {**note_style(), "color": FORBIDDEN, "fontweight": "bold" if fails else "normal"}


def note_style() -> dict[str, Any]:
    """The style of small notes."""
    return {**NOTE, "fontsize": 7.5}
