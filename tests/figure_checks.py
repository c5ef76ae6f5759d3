"""What can be checked of any figure without eyes: `defects(figure)` lists in sentences what a reader would stumble on.

empty panels            visible axes without data and without a text that says why
overlaps, cut texts     titles, labels, numbers at ticks, notes, legends: two on one place, or beyond the page
texts on lines          notes that a line of the same axes crosses; a text on a box of its own may
axes without units      a numeric axis needs a label with its unit in brackets, "[-]" where it has none
bare axes               fewer than two numbers at the ticks, as on a logarithmic axis of less than a decade
lines drawn twice       two lines of one axes with the same data
looks that are alike    two entries of one legend that differ by colour alone, or not at all
lines without a name    two or more looks of lines in one axes, some neither in a legend, nor beside a
                            note, nor with their name at a tick
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FixedLocator, FuncFormatter, NullLocator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

TOUCHING = 1.0  # pixels by which boxes may lie on each other: boxes of texts have room of their own
DARKNESS = 0.12  # smallest difference of two greys, of 0 (black) to 1 (white)


@dataclass(frozen=True)
class Piece:
    """A text or a legend: what a sentence calls it, its box, pixels, and the group whose own parts may touch."""

    name: str
    box: Bbox
    group: object


def defects(figure: Figure) -> list[str]:
    """What is wrong with a figure, a sentence each; it is drawn for it."""
    FigureCanvasAgg(figure).draw()  # type: ignore[no-untyped-call]
    panels = list(_panels(figure))
    found = [*_misplaced(figure, panels), *_unlike(figure)]
    for name, axes in panels:
        found += _of_panel(name, axes)
        found += _unnamed_looks(name, axes, figure)
    return found


def texts_of(figure: Figure) -> list[str]:
    """Every visible text of a figure: titles, labels, notes, legends, numbers at ticks."""
    return [t.get_text() for t in figure.findobj(Text) if isinstance(t, Text) and t.get_text()]


def _panels(figure: Figure) -> Iterator[tuple[str, Axes]]:
    """Visible axes with their names, axes on a second side included."""
    for n, axes in enumerate(figure.axes):
        if axes.get_visible():
            yield f"panel {n}", axes
            for child in axes.child_axes:
                yield f"second side of panel {n}", child  # type: ignore[misc]


# --- texts ---


def _misplaced(figure: Figure, panels: list[tuple[str, Axes]]) -> Iterator[str]:
    """Texts and legends beyond the page, on each other, or on lines."""
    pieces = list(_pieces(figure, panels))
    page = figure.bbox
    for piece in pieces:
        box = piece.box
        if min(box.x0 - page.x0, box.y0 - page.y0, page.x1 - box.x1, page.y1 - box.y1) < -TOUCHING:
            yield f"{piece.name} leaves the page"
    for one, other in combinations(pieces, 2):
        if one.group is not None and one.group is other.group:
            continue
        wide = min(one.box.x1, other.box.x1) - max(one.box.x0, other.box.x0)
        high = min(one.box.y1, other.box.y1) - max(one.box.y0, other.box.y0)
        if min(wide, high) > TOUCHING:
            yield f"{one.name} lies on {other.name}"
    for name, axes in panels:
        for text in axes.texts:
            if text.get_visible() and text.get_text() and text.get_bbox_patch() is None:
                yield from _crossed(f"{text.get_text()!r} in {name}", axes, text.get_window_extent())


def _pieces(figure: Figure, panels: list[tuple[str, Axes]]) -> Iterator[Piece]:
    """Everything that is written; numbers at turned ticks may touch each other, boxes being upright."""
    for text in figure.texts:
        yield from _piece(text, text.get_text())
    for legend in figure.legends:
        yield Piece("the legend of the figure", legend.get_window_extent(), None)
    for name, axes in panels:
        for text in (axes.title, axes._left_title, axes._right_title, *axes.texts):  # type: ignore[attr-defined]
            yield from _piece(text, name)
        legend_of = axes.get_legend()
        if legend_of is not None and legend_of.get_visible():
            yield Piece(f"the legend of {name}", legend_of.get_window_extent(), None)
        for side in _sides(axes):
            yield from _piece(side.label, name)
            for number in _numbers(side):
                turned = side if number.get_rotation() % 90 else None
                yield from _piece(number, name, turned)


def _piece(text: Text, where: str, group: object = None) -> Iterator[Piece]:
    if text.get_visible() and text.get_text().strip():
        yield Piece(f"{text.get_text()!r} of {where}", text.get_window_extent(), group)


def _sides(axes: Axes) -> list[Axis]:
    """The axes of a panel that are shown."""
    return [side for side in (axes.xaxis, axes.yaxis) if side.get_visible() and axes.axison]


def _numbers(side: Axis) -> list[Text]:
    """The texts at the ticks that are drawn."""
    low, high = sorted(side.get_view_interval())
    room = 1e-9 * (high - low)
    ticks = [*side.get_major_ticks(), *side.get_minor_ticks()]
    seen = [tick for tick in ticks if low - room <= tick.get_loc() <= high + room]
    labels = [label for tick in seen for label in (tick.label1, tick.label2)]
    return [label for label in labels if label.get_visible() and label.get_text().strip()]


def _crossed(what: str, axes: Axes, box: Bbox) -> Iterator[str]:
    """Lines and bars' edges that run through a box."""
    inner = box.padded(-1.5)
    for line in axes.lines:
        path = line.get_transform().transform_path(line.get_path())
        if not line.get_visible() or line.get_linestyle() == "None" or len(np.asarray(path.vertices)) < 2:
            continue
        if path.intersects_bbox(inner, filled=False):
            yield f"{what} is crossed by a line"
            return


# --- panels ---


def _of_panel(name: str, axes: Axes) -> Iterator[str]:
    """What is wrong within one panel."""
    second = name.startswith("second")
    drawn = [a for a in axes.get_children() if isinstance(a, Line2D | Collection) or a in axes.patches]
    if not second and not any(_has_data(a) for a in [*drawn, *axes.images]) and not axes.texts:
        yield f"{name} is empty"
    for side in _sides(axes):
        label, numbers = side.get_label_text(), _numbers(side)
        what = f"the {side.axis_name} axis of {name}"  # type: ignore[attr-defined]
        if _is_of_names(side) or (not numbers and not _wants_numbers(side)):
            continue
        title = "" if second else axes.get_title()
        if "[" not in label + title and not _shared_label(axes, side):
            yield f"{what} has no unit: {label!r}"
        if len(numbers) < 2:
            yield f"{what} has {len(numbers) or 'no'} number at its ticks"
    data = [(line, np.asarray(line.get_xydata(), dtype=float)) for line in axes.lines if line.get_visible()]
    for (one, a), (other, b) in combinations(data, 2):
        alike = one.get_transform() == other.get_transform()
        if len(a) > 2 and alike and a.shape == b.shape and np.array_equal(a, b, equal_nan=True):
            yield f"{name} draws one line twice: {one.get_label()!r} and {other.get_label()!r}"


def _has_data(artist: Any) -> bool:
    """Whether an artist shows something; lines of no finite point and bars without width do not."""
    if isinstance(artist, Line2D):
        xy = np.asarray(artist.get_xydata(), dtype=float)
        return artist.get_visible() and bool(np.isfinite(xy).all(axis=1).any())
    if isinstance(artist, Patch):
        return artist.get_visible() and np.asarray(artist.get_path().vertices).size > 0
    return bool(artist.get_visible())


def _is_of_names(side: Axis) -> bool:
    """Whether the ticks of an axis have names and no numbers."""
    form = side.get_major_formatter()
    if not isinstance(form, FixedFormatter | FuncFormatter):
        return False
    return any(not _is_number(text.get_text()) for text in _numbers(side))


def _wants_numbers(side: Axis) -> bool:
    """Whether an axis is to show numbers: the inner ones of a shared axis are not, nor are axes without ticks."""
    shown = side.get_tick_params("major")
    places = ("labelbottom", "labeltop") if side.axis_name == "x" else ("labelleft", "labelright")  # type: ignore[attr-defined]
    return any(shown.get(place, False) for place in places) and not isinstance(
        side.get_major_locator(), FixedLocator | NullLocator
    )


def _is_number(text: str) -> bool:
    try:
        float(text.replace("\N{MINUS SIGN}", "-"))
    except ValueError:
        return text.startswith("$")  # powers of ten
    return True


def _shared_label(axes: Axes, side: Axis) -> bool:
    """Whether an axes of the same row or column, with the same axis, has the label."""
    shared = axes.get_shared_x_axes() if side is axes.xaxis else axes.get_shared_y_axes()
    name = side.axis_name  # type: ignore[attr-defined]
    return any("[" in getattr(one, f"get_{name}label")() for one in shared.get_siblings(axes))


# --- looks ---


def _unlike(figure: Figure) -> Iterator[str]:
    """Entries of legends that a reader without colours cannot tell from each other."""
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    for legend in legends:
        if legend is None:
            continue
        names = [text.get_text() for text in legend.get_texts()]
        looks = [_look(handle) for handle in legend.legend_handles if handle is not None]
        for (name, one), (other_name, other) in combinations(zip(names, looks, strict=True), 2):
            if one[1:] == other[1:] and abs(one[0] - other[0]) < DARKNESS:
                yield f"{name!r} and {other_name!r} look alike without colour"


def _look(artist: Any) -> tuple[float, str, str, float]:
    """Darkness; dashes or hatch; marker; width, coarsely."""
    if isinstance(artist, Line2D):
        dashes = str(artist._unscaled_dash_pattern) if artist.get_linestyle() != "None" else "none"  # type: ignore[attr-defined]
        mark = f"{artist.get_marker()} {to_grey(artist.get_markerfacecolor()):.1f}"
        return to_grey(artist.get_color()), dashes, mark, round(artist.get_linewidth() / 3)
    if isinstance(artist, Patch):
        face = artist.get_facecolor()
        return to_grey(face), f"{artist.get_hatch()} {artist.get_fill()}", "patch", 0.0
    return 0.0, type(artist).__name__, str(id(artist)), 0.0


def to_grey(colour: Any) -> float:
    """The lightness of a colour on white paper, 0 (black) to 1 (white)."""
    red, green, blue, alpha = to_rgba(colour)
    return alpha * (0.299 * red + 0.587 * green + 0.114 * blue) + 1 - alpha


def _unnamed_looks(name: str, axes: Axes, figure: Figure) -> Iterator[str]:
    """Looks of lines that neither a legend nor a note names, where one axes has several; straight lines are bounds."""
    legends = [legend for legend in (axes.get_legend(), *figure.legends) if legend is not None]
    for other in figure.axes:
        legends += [legend for legend in (other.get_legend(),) if legend is not None]
    named = {
        _colour_and_dash(h) for legend in legends for h in legend.legend_handles if isinstance(h, Line2D)
    }
    drawn = {
        _colour_and_dash(line)
        for line in axes.lines
        if line.get_visible()
        and line.get_linestyle() != "None"
        and _has_data(line)
        and not _is_straight(line)
    }
    written = set(texts_of(figure))
    named |= {
        _colour_and_dash(h)
        for h in figure.findobj(Line2D)
        if isinstance(h, Line2D) and h.get_label() in written
    }
    missing = drawn - named
    if len(drawn) > 1 and len(missing) > len([text for text in axes.texts if text.get_visible()]):
        yield f"{name} has {len(missing)} looks of lines without a name"


def _colour_and_dash(line: Line2D) -> tuple[str, str]:
    return str(to_rgba(line.get_color())), str(line._unscaled_dash_pattern)  # type: ignore[attr-defined]


def _is_straight(line: Line2D) -> bool:
    xy = np.asarray(line.get_xydata(), dtype=float)
    return 0 < len(xy) <= 3 and bool(np.ptp(xy, axis=0).min() == 0 or not math.isfinite(np.ptp(xy)))
