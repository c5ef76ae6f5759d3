"""Groups of lines, dots, noise and histograms in a panel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.report.figures.parts import DOT, MORE, NOTE, STYLES, draw_line, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from malta.model.plant import FloatArray

STRETCHES = 400  # of `draw_largest`


def draw_group(
    axes: Axes, t: FloatArray, series: Mapping[str, FloatArray], styles: Sequence[dict[str, Any]] = ()
) -> int:
    """Draw every signal of a group; returns the number of columns that its legend has room for.

    Signals with the same values, but for rounding, share a line. More lines than there are styles share a band from the
    least to the largest of them, and the three that reach furthest are lines as well.

    series : name -> values over t
    styles : of the lines; the usual ones where none are given
    """
    lines: dict[str, FloatArray] = {}
    for name, values in series.items():
        room = 1e-9 * float(np.abs(values).max(initial=0.0))
        twin = next(
            (known for known, drawn in lines.items() if np.abs(drawn - values).max(initial=0.0) <= room), None
        )
        if twin is None:
            lines[name] = values
        else:
            lines = {f"{twin}, {name}" if known == twin else known: drawn for known, drawn in lines.items()}
    styles = styles or (*STYLES, *MORE)
    if len(lines) > len(styles):
        every = np.array(list(series.values()))
        label = f"all {len(every)}, least to largest"
        axes.fill_between(t, every.min(axis=0), every.max(axis=0), color="#d4d4d4", linewidth=0, label=label)
        furthest = sorted(lines, key=lambda name: -float(np.abs(lines[name]).max()))[:3]
        lines = {name: lines[name] for name in lines if name in furthest}
    for (name, values), style in zip(lines.items(), styles, strict=False):
        draw_line(axes, t, values, label=name, **style)
    return len(lines) if len(lines) < 5 else 4


def draw_largest(axes: Axes, t: FloatArray, values: FloatArray, **style: Any) -> None:
    """Draw the largest value of each stretch: of a noisy size on a logarithmic axis the small values say nothing."""
    size = math.ceil(len(t) / STRETCHES)
    first = np.arange(0, len(t), size)
    axes.plot(t[first], np.maximum.reduceat(values, first), **style)


def draw_dots(
    axes: Axes,
    names: Sequence[str],
    values: Sequence[float],
    texts: Sequence[str],
    marks: Sequence[dict[str, Any]] = (),
) -> None:
    """Draw a row for each name, from top to bottom: a dot at its value on a logarithmic axis, and a text beside it.

    Dots, as bars on a logarithmic axis would begin at an arbitrary place. A value of 0 or less has its text alone.

    marks : of the rows; dots where none are given
    """
    shown = [value for value in values if value > 0]
    axes.set_xscale("log")
    axes.set_xlim(min(shown, default=1.0) / 3, 3 * max(shown, default=1.0))
    low, high = axes.get_xlim()
    rows = zip(values, texts, marks or [DOT] * len(values), strict=True)
    for row, (value, text, mark) in enumerate(rows):
        if value > 0:
            axes.plot(value, row, **mark)
        beyond = value > math.sqrt(low * high)
        where: dict[str, Any] = {"xytext": (-8 if beyond else 8, 0), "textcoords": "offset points"}
        where |= {"ha": "right" if beyond else "left", "va": "center"}
        axes.annotate(text, (value if value > 0 else low, row), **where, **NOTE)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.set_ylim(len(names) - 0.4, -0.6)


def draw_noisy(axes: Axes, t: FloatArray, values: FloatArray, size: int, **style: Any) -> None:
    """Draw samples in grey, and as a line their means over stretches of `size` samples."""
    count = len(t) // size * size
    draw_line(axes, t, values, color="#c4c4c4", linewidth=0.7, label="samples")
    means = (s[:count].reshape(-1, size).mean(axis=1) for s in (t, values))
    axes.plot(*means, label=f"means of {size}", **STYLES[0] | style)


def draw_histograms(
    axes: Axes, series: Sequence[FloatArray], labels: Sequence[str], bins: float, reach: float
) -> None:
    """Draw shares of samples in bins of this width: of the first series as filled bars, of the others as outlines."""
    styles: tuple[dict[str, Any], ...] = (
        {"fill": True, "facecolor": "#d4d4d4", "edgecolor": "#8a8a8a", "linewidth": 0.8},
        {"edgecolor": "#000000", "linewidth": 1.2},
    )
    count = math.ceil(reach / bins)
    edges = (np.arange(-count, count + 2) - 0.5) * bins
    for values, label, style in zip(series, labels, styles, strict=True):
        axes.stairs(100 * np.histogram(values, edges)[0] / len(values), edges, label=label, **style)
    axes.set_xlim(-reach, reach)


def draw_spreads(axes: Axes, spreads: Sequence[tuple[str, float, float]], top: float) -> None:
    """Draw means and standard deviations above histograms: label, mean and deviation of each."""
    for n, (label, mean, std) in enumerate(spreads):
        height = top * (1 + 0.13 * (len(spreads) - n))
        style = {"color": STYLES[n]["color"], "marker": "|", "markersize": 7}
        axes.plot([mean - std, mean, mean + std], 3 * [height], **style)
        where: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "va": "center"}
        axes.annotate(label, (0.03, height), **where, **NOTE)
        axes.annotate(f"{number(std, 3)} µm", (0.99, height), ha="right", **where, **NOTE)
    axes.set_ylim(0, top * (1.1 + 0.13 * len(spreads)))
    axes.set_yticks([tick for tick in axes.get_yticks() if tick <= top])
