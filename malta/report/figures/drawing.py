"""Parts of figures: styles, pages, lines, bounds, legends, numbers."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.display import micro as micro, number as number
from malta.errors import InputError
from malta.files import PICTURES, require_suffix
from malta.merits import ROOTS
from malta.model.plant import Plant
from malta.model.printed import published_value
from malta.simulation.trajectory import Trajectory
from malta.synthesis.requirements import Trade, requirements_for
from malta.units import in_unit
from malta.writing import replace_files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from malta.simulation.experiments import Case, Experiment

Published = Mapping[str, Any]  # a file of data/published/

STYLES: Sequence[dict[str, Any]] = (  # distinct without colour: by steps of lightness and by dashes
    {"color": "#000000", "linestyle": "-", "linewidth": 1.6},
    {"color": "#7d2906", "linestyle": "-", "linewidth": 1.4},
    {"color": "#176aa8", "linestyle": (0, (5, 2)), "linewidth": 1.4},
    {"color": "#8e8e8e", "linestyle": (0, (1.5, 1.5)), "linewidth": 1.6},
)
"""Styles of lines that are distinct without colour, by lightness and dashes: keywords of Axes.plot.

>>> import malta
>>> [style["color"] for style in malta.report.STYLES]
['#000000', '#7d2906', '#176aa8', '#8e8e8e']
"""
MORE_STYLES: Sequence[dict[str, Any]] = (  # used after STYLES
    {"color": "#000000", "linestyle": (0, (7, 2, 1.5, 2)), "linewidth": 1.4},
    {"color": "#7d2906", "linestyle": (0, (1.5, 1.5)), "linewidth": 1.6},
    {"color": "#176aa8", "linestyle": (0, (9, 2, 1.5, 2, 1.5, 2)), "linewidth": 1.4},
    {"color": "#8e8e8e", "linestyle": "-", "linewidth": 1.2},
)
BOUND_STYLE: dict[str, Any] = {"color": "#9a9a9a", "linestyle": (0, (8, 3)), "linewidth": 0.9}
BOUND_LINE = "bound"  # marks what is no data
MAX_BOUND_FACTOR = 2.5  # times the data: bounds further away are arrows
# A reference that lies under a curve.
REFERENCE: dict[str, Any] = {"color": "#a9c6e0", "linestyle": "-", "linewidth": 5.0, "zorder": 1.5}
NOTE: dict[str, Any] = {"fontsize": 8, "color": "#5a5a5a"}
# The ground of a text.
PAPER: dict[str, Any] = {"bbox": {"facecolor": "#ffffff", "edgecolor": "none", "alpha": 0.75, "pad": 0.4}}
DOT: dict[str, Any] = {"marker": "o", "markersize": 6, "linestyle": "none", "color": "#000000"}
CROSS: dict[str, Any] = DOT | {"marker": "X", "markersize": 9, "markeredgecolor": "#ffffff", "clip_on": False}
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8, "handlelength": 2.4, "columnspacing": 1.5}
UNPRINTABLE_CHARACTER = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
POINTS = 3000  # of a line; a page does not resolve more


def runs_of(e: Experiment) -> list[Trajectory]:
    """The runs of an experiment's cases."""
    return [case.run for case in e.cases]


def new_figure(
    title: str = "", found: str = "", *, size: tuple[float, float] = (9.0, 6.0), **places: Any
) -> Figure:
    """Make an empty figure that shows itself in a notebook: as the value of a cell, or by `display(figure)`.

    title : what the figure shows
    found : a line of results below the title
    size : width and height, inch
    places : left, right, bottom, top, wspace, hspace of the panels, as Figure.subplots_adjust takes them

    Returns a matplotlib Figure.

    >>> import malta
    >>> figure = malta.report.new_figure("robust: Bode plot", size=(9.0, 4.6))
    >>> upper, lower = figure.subplots(2, 1, sharex=True)
    >>> figure.get_size_inches().tolist()
    [9.0, 4.6]
    """

    from malta.report.figures.inline import InlineFigure

    figure, height = InlineFigure(figsize=size, dpi=120), size[1]
    usual = {"left": 0.085, "right": 0.98, "bottom": 0.51 / height, "top": 1 - 0.84 / height}
    figure.subplots_adjust(**usual | {"wspace": 0.25, "hspace": 0.3} | places)
    if title:
        figure.suptitle(title, fontsize=11, y=1 - 0.09 / height)
    if found:
        figure.text(0.5, 1 - 0.33 / height, found, fontsize=9, color="#4a4a4a", ha="center", va="top")
    return figure


def show_plain_texts(figure: Figure) -> None:
    """Take the texts of a figure as they stand: a dollar in a name begins no formula, as it does in ticks."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if text.get_text() and "\\mathdefault" not in text.get_text():
            text.set_parse_math(False)
            text.set_text(printable(text.get_text().replace(r"\$", "$")))


def printable(text: str) -> str:
    """A text without the characters that no page may have, as control characters: each becomes a mark."""
    return UNPRINTABLE_CHARACTER.sub("\ufffd", text)


def save(figure: Figure, path: str | Path, *, dark: bool = False) -> Path:
    """Write a figure as .png, .svg or .pdf, whole or not at all; the same figure gives the same bytes.

    A .svg file is light on screens that prefer light pages, and dark on those that prefer dark ones.

    figure : a matplotlib Figure
    path : of the file; its suffix gives the form
    dark : light lines on a dark page, of a .png or .svg file

    Returns the path.

    Raises InputError for another suffix, a dark .pdf file, or a folder that cannot be written to.

    >>> import malta
    >>> malta.report.save(malta.report.new_figure("empty"), "build/empty.svg").name
    'empty.svg'
    """
    path = Path(path)
    replace_files({path: encode_figure(figure, path, dark=dark)})
    return path


def encode_figure(figure: Figure, path: Path, *, dark: bool = False) -> bytes:
    r"""Make the content of a .png, .svg or .pdf file of a figure; the same figure gives the same bytes.

    A .svg file is light on screens that prefer light pages, and dark on those that prefer dark ones.

    figure : a matplotlib Figure
    path : of the file; its suffix gives the form
    dark : light lines on a dark page, of a .png or .svg file

    Returns the bytes.

    Raises InputError for another suffix, and for a dark .pdf file.

    >>> import malta
    >>> from pathlib import Path
    >>> figure = malta.report.new_figure("empty")
    >>> malta.report.encode_figure(figure, Path("empty.png"))[:4]
    b'\x89PNG'
    """
    import matplotlib

    from malta.report.figures.inline import png_of

    suffix = require_suffix(path, *PICTURES).suffix.lower()
    if suffix == ".pdf" and dark:
        raise InputError(path, "", "a dark figure on paper", "a .png or .svg file, or a light figure")
    if suffix == ".png":
        return png_of(figure, dark=dark)
    buffer = io.BytesIO()
    date = {"Date": None} if suffix == ".svg" else {"CreationDate": None}
    with matplotlib.rc_context({"svg.hashsalt": "malta", "svg.fonttype": "none", "pdf.fonttype": 42}):
        figure.savefig(buffer, format=suffix[1:], metadata=date)
    return with_dark_mode(buffer.getvalue(), always=dark) if suffix == ".svg" else buffer.getvalue()


def with_dark_mode(svg: bytes, *, always: bool = False) -> bytes:
    """An SVG file that has light lines on a dark page, where the reader's screen prefers dark or `always`."""
    from malta.report.page.document import dark_colour

    text = svg.decode()
    rules = ["svg{fill:#ededed}"]  # of texts, which have no colour of their own
    for side, name in sorted(set(re.findall(r"(fill|stroke): #([0-9a-f]{6})", text))):
        rules.append(f'[style*="{side}: #{name}"]{{{side}:{dark_colour(name)} !important}}')
    inside = "".join(rules)
    style = f"<style>{inside if always else f'@media (prefers-color-scheme: dark){{{inside}}}'}</style>"
    return re.sub(r"(<svg\b[^>]*>)", lambda found: found[0] + style, text, count=1).encode()


def save_figure(figure: Figure, path: str | Path | None) -> Figure:
    """The figure itself, saved where a path is given."""
    if path is not None:
        save(figure, path)
    return figure


def rows_and_columns(count: int) -> tuple[int, int]:
    """Rows and columns of so many panels, at most three beside each other and few places left empty."""
    columns = {0: 1, 1: 1, 2: 2, 4: 2}.get(count, 3)
    return max(1, -(-count // columns)), columns


def new_page(runs: Sequence[Trajectory], what: str, found: str, **places: Any) -> Figure:
    """A new figure whose title names the design, the fidelity and the subject; `found` is its line of results."""
    fidelities = " and ".join(dict.fromkeys(run.scenario.fidelity for run in runs))
    return new_figure(f"{runs[0].controller.name}, fidelity {fidelities}: {what}", found, **places)


def ending_text(run: Trajectory) -> str:
    """How a run ended, in brackets; empty if it was completed."""
    end = run.verdict
    return "" if end.completed else f" ({end.words} at {end.time * 1e3:.0f} ms)"


def draw_line(axes: Axes, t: FloatArray, values: FloatArray, **style: Any) -> None:
    """Draw a line. Of more samples than a page resolves, it has the smallest and the largest of each stretch."""
    size = math.ceil(2 * len(t) / POINTS)
    if size > 2:
        first = np.arange(0, len(t) - size + 1, size)
        stretches = values[: len(first) * size].reshape(-1, size)
        peaks = np.column_stack([stretches.argmin(axis=1), stretches.argmax(axis=1)]) + first[:, None]
        kept = np.unique([0, *peaks.ravel(), len(t) - 1])
        t, values = t[kept], values[kept]
    axes.plot(t, values, **style)


def mark_end(axes: Axes, run: Trajectory, t: FloatArray, values: FloatArray, *, named: bool = True) -> None:
    """Draw a cross where a run ended early; `named`: with an entry in the legend."""
    if ended_early(run):
        k = min(end_of(run), len(t) - 1)
        low, high = axes.get_xlim()
        if not (axes.get_autoscalex_on() or low <= t[k] <= high):
            return
        label = TOUCHDOWN_LABEL if run.verdict.name.startswith(TOUCHDOWN_LABEL) else run.verdict.words
        axes.plot(t[k], values[k], **CROSS | ({"label": label} if named else {}))


TOUCHDOWN_LABEL = "touchdown"


def ended_early(run: Trajectory) -> bool:
    """Whether a run ended by a touchdown or another event, and not by time or Ctrl-C."""
    return run.verdict.name not in ("completed", "interrupted")


def end_of(run: Trajectory) -> int:
    """The sample at which a run ended."""
    return min(int(np.searchsorted(run.t, run.verdict.time)), len(run.t) - 1)


def draw_published(
    axes: Axes, published: Published | None, key: str, unit: str, text: str = "published bound", **drawn: Any
) -> None:
    """`draw_bound` at a published value; nothing without published figures."""
    if published is not None:
        draw_bound(axes, published_in_unit(published, key, unit), text, **drawn)


def draw_bound(
    axes: Axes, value: float, text: str, *, both: bool = False, where: str = "above right"
) -> None:
    """Draw a line at a value, or at both signs of it, and extend the axes to it; the data decide what they show.

    A bound beyond MAX_BOUND_FACTOR times the data would flatten them: it is an arrow with its number at the edge.

    where : place of its text: above, below, or under the lower line of both; left or right
    """
    drawn = [line for line in axes.lines if line.get_gid() != BOUND_LINE]
    reach = max((_reach(line) for line in drawn), default=0.0)
    height, side = where.split()
    if axes.get_yscale() != "log" and 0 < MAX_BOUND_FACTOR * reach < abs(value):
        _point_to_bound(axes, value, text, side, both=both)
        return
    for sign in (-1, 1) if both else (1,):
        axes.axhline(sign * value, gid=BOUND_LINE, **BOUND_STYLE)
    axes.annotate(
        text,
        ({"left": 0.015, "right": 0.985}[side], -value if height == "under" else value),
        xycoords=("axes fraction", "data"),
        xytext=(0, 1.5 if height == "above" else -1.5),
        textcoords="offset points",
        ha=side,
        va="bottom" if height == "above" else "top",
        **NOTE | PAPER,
    )
    room = max(1.25 * abs(value), 1.1 * max(map(_reach, axes.lines)))
    if both:
        axes.set_ylim(-room, room)
    elif axes.get_yscale() == "log":
        axes.set_ylim(top=max(2.5 * abs(value), 1.5 * reach))
    elif value > 0:
        axes.set_ylim(top=room)
    elif height == "below":
        axes.set_ylim(bottom=-room)


def _reach(line: Line2D) -> float:
    """The largest size of the values of a line."""
    y = np.asarray(line.get_ydata(), dtype=float)
    return float(np.abs(y[np.isfinite(y)]).max(initial=0.0))


def _point_to_bound(axes: Axes, value: float, text: str, side: str, *, both: bool) -> None:
    """Name a bound beyond the axes, with an arrow towards it, at the upper edge or, of a negative one, at the lower."""
    up = both or value > 0
    told = f"{text} {'±' if both else ''}{value:.3g} {'↕' if both else '↑' if up else '↓'}"
    above = sum(note.get_gid() == BOUND_LINE for note in axes.texts)  # other bounds at the edge
    axes.annotate(
        told.replace("-", "−"), ({"left": 0.015, "right": 0.985}[side], 1.0 if up else 0.0), xycoords="axes fraction",
        xytext=(0, (-3 - 11 * above) if up else (3 + 11 * above)), textcoords="offset points",
        ha=side, va="top" if up else "bottom", gid=BOUND_LINE, **NOTE | PAPER,
    )  # fmt: skip
    low, high = axes.get_ylim()
    room = 0.14 * (high - low)  # for the text
    axes.set_ylim(low - (0 if up else room), high + (room if up else 0))


def label_upright(axes: Axes, x: float, height: float, text: str, *, ha: str) -> None:
    """Write a text along an upright line at x, beginning at a share `height` of the axes."""
    where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "rotation": 90, "va": "bottom", "ha": ha}
    axes.annotate(text, (x, height), **where, **NOTE)


def square_axes(axes: Axes, *, least: float = 0.0) -> None:
    """Make axes equal and square about the centre, with all data inside, and at least `least` wide to either side."""
    from matplotlib.ticker import MaxNLocator

    box = axes.dataLim
    reach = max(least, 1.1 * max(abs(edge) for edge in (box.x0, box.x1, box.y0, box.y1)))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_box_aspect(1)
    axes.tick_params(labelsize=8)
    for side in (axes.xaxis, axes.yaxis):
        side.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def draw_grid(axes: Axes) -> None:
    """Draw a light grid behind the data, and no frame at the top and on the right."""
    axes.grid(color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)
    for edge in ("top", "right"):
        axes.spines[edge].set_visible(False)


def finish_axes(axes: Axes, x: str, y: str, *, legend: int = 0, side: str = "left") -> None:
    """Set labels and grid, and a legend with `legend` columns above the axes, where it covers no data."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    draw_grid(axes)
    axes.margins(x=0)
    for scale in (axes.xaxis, axes.yaxis):
        if scale.get_scale() == "log":
            number_logarithm(scale)
    if legend:
        where: dict[str, Any] = {"loc": f"lower {side}", "bbox_to_anchor": ({"left": 0, "right": 1}[side], 1)}
        handles, labels = legend_entries([axes])
        close = {"handlelength": 1.8, "columnspacing": 0.9} if len(labels) > 4 else {}
        axes.legend(handles, labels, ncols=legend, borderaxespad=0.2, **where, **LEGEND | close)


def number_logarithm(side: Axis) -> None:
    """Set numbers at the ticks of a logarithmic axis: enough for a part of a decade, not too many for several."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    low, high = sorted(side.get_view_interval())
    decades = math.log10(high / low)
    side.set_minor_formatter("")
    if decades > 2.2:
        return  # powers of ten
    if decades < 0.7:
        side.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    else:
        side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 1.7 else (1.0, 3.0)))
    side.set_major_formatter("{x:g}")


def add_shared_legend(figure: Figure) -> None:
    """Add one legend below the title for all panels that have none of their own."""
    handles, labels = legend_entries([axes for axes in figure.axes if axes.get_legend() is None])
    where: dict[str, Any] = {
        "loc": "upper center",
        "bbox_to_anchor": (0.5, 1 - 0.45 / figure.get_figheight()),
    }
    figure.legend(handles, labels, ncols=len(labels), **where, **LEGEND)


def legend_entries(panels: Sequence[Axes]) -> tuple[list[Any], list[str]]:
    """Handles and labels of panels, each label once, crosses last."""
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    labels = sorted(found, key=lambda label: getattr(found[label], "get_marker", str)() == CROSS["marker"])
    return [found[label] for label in labels], labels


def clearance(plant: Plant) -> float:
    """The shortest displacement across the stroke that ends in a contact, m; infinite without contacts."""
    way, half = 1e-6, len(plant.states) // 2
    across = [
        s.name
        for k, s in enumerate(plant.states[:half])
        if s.unit == "m" and not (plant.has_stroke and k == plant.stroke_state)
    ]

    def share(**moved: float) -> FloatArray:
        return np.array(ca.evalf(plant.contacts.contact(ca.SX(ca.DM(plant.at(**moved).x))))).ravel()

    nearer = [share(**{name: side * way}) - share() for name in across for side in (1, -1)]
    most = max((float(used.max(initial=0.0)) for used in nearer), default=0.0)
    return way / most if most else math.inf


def published_in_unit(published: Published, key: str, unit: str) -> float:
    """A published quantity in the unit that it is shown in."""
    return in_unit(published_value(published, key), unit)


def merits_phrase(cases: Sequence[Case], which: int) -> str:
    """One figure of merit of all cases, in a line."""
    found = ", ".join(f"{case.label} {case.merits[which].phrase()}" for case in cases)
    return micro(f"{cases[0].merits[which].label.replace(': ', ', ')}: {found}")


UNITS = {
    "m": (1e6, "um"),
    "rad": (1e6, "urad"),
    "V": (1e3, "mV"),
    **ROOTS,
    "rad/s": (1.0, "rad/s"),
    "N": (1.0, "N"),
    "N m": (1.0, "N m"),
    "kg": (1.0, "kg"),
}


def front_lines(plant: Plant, names: Iterable[str], trade: Trade) -> list[tuple[str, str, float, str]]:
    """Figures of a Pareto front of one trade, "force" noise or "motion": name, label, factor, unit of each."""
    known, found = requirements_for(plant), []
    for name in names:
        base, _, signal = name.partition(" ")
        if base in known and known[base].trade == trade:
            r = known[base]
            unit = next((s.unit for s in r.signals(plant) if s.name == signal), r.unit)
            found.append((name, signal or r.heading, *UNITS.get(unit, (1.0, unit))))
    return found


# Groups of lines, dots, noise and histograms in a panel.


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
    styles = styles or (*STYLES, *MORE_STYLES)
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
