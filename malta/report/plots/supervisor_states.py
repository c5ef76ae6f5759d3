"""The statechart of a supervisor, from the table of transitions that its C has."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

from malta.firmware.supervisor import State, transitions_of
from malta.report.figures.drawing import new_figure
from malta.report.plots.diagram import draw_arrow, write_note

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BOX = 1.15, 0.46  # inch
PLACES: dict[State, tuple[float, float]] = {  # inch, of the middles
    "OFF": (0.8, 2.2),
    "OFFSETS": (2.5, 2.2),
    "SENSORS": (4.2, 2.2),
    "WIRING": (4.2, 1.2),
    "LIFT": (5.9, 2.2),
    "SETTLE": (7.6, 2.2),
    "OPERATE": (9.3, 2.2),
    "HOLD": (9.3, 1.2),
    "LANDING": (5.9, 0.4),
    "FAULT": (2.5, 0.4),
}
SIZE = 10.1, 3.2  # inch


def statechart(*, wiring: bool = False) -> Figure:
    """Draw the states of a supervisor and what leads from one to the next.

    What leads from many states to one is drawn once, with their names.

    wiring : with the state in which the wiring is tried, as `malta export --wiring` writes it

    Returns a matplotlib Figure.

    >>> import malta
    >>> texts = [text.get_text() for text in malta.report.statechart().axes[0].texts]
    >>> [name for name in ("OFF", "OPERATE", "WIRING") if name in texts]
    ['OFF', 'OPERATE']
    """
    figure = new_figure("states of the supervisor", size=SIZE, left=0, right=1, bottom=0, top=1)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0, SIZE[0])
    axes.set_ylim(0, SIZE[1])
    axes.axis("off")
    table = transitions_of(wiring=wiring)
    for begin, on, end in table:
        if end not in ("LANDING", "FAULT"):  # to which many lead, drawn once
            _join(axes, begin, end, on.lower())
    gathered: tuple[State, ...] = ("LANDING", "FAULT")
    for end in gathered:
        from_all = [begin for begin, _, other in table if other == end]
        (x, y), (width, _) = PLACES[end], BOX
        draw_arrow(axes, (x + width / 2 + 0.45, y), (x + width / 2, y), "")
        words = f"{next(on for _, on, other in table if other == end).lower()}, from"
        names = textwrap.wrap(" ".join(from_all), 24)
        for k, text in enumerate((words, *names)):
            write_note(axes, x + width / 2 + 0.5, y + 0.22 - 0.16 * k, text, ha="left", fontsize=7.5)
    for state in dict.fromkeys(state for begin, _, end in table for state in (begin, end)):
        _draw_state(axes, state)
    return figure


def _join(axes: Any, begin: State, end: State, on: str) -> None:
    """An arrow between two states with what leads along it."""
    (x, y), (to_x, to_y), (width, height) = PLACES[begin], PLACES[end], BOX
    if y == to_y and x < to_x <= x + 1.8:  # neighbours
        start, tip, at = (x + width / 2, y), (to_x - width / 2, y), (0.0, 0.12)
    elif x == to_x:
        side = -0.25 if to_y < y else 0.25  # there and back beside each other
        down = -height / 2 if to_y < y else height / 2
        start, tip, at = (x + side, y + down), (x + side, to_y - down), (0.4 if side > 0 else -0.4, 0.0)
    elif end == "OFF":  # back to the begin, above or below the others
        _bend(axes, begin, on)
        return
    else:
        start, tip, at = (x + width / 2, y), (to_x, to_y - height / 2), (0.2, 0.0)
    draw_arrow(axes, start, tip, "")
    middle = (start[0] + tip[0]) / 2 + at[0], (start[1] + tip[1]) / 2 + at[1]
    write_note(axes, *middle, on, style="italic", fontsize=7.5)


def _bend(axes: Any, begin: State, on: str) -> None:
    """An arrow back to OFF: over the states of its row, else through the room below it."""
    (x, y), (off_x, off_y), (width, height) = PLACES[begin], PLACES["OFF"], BOX
    if y == off_y:
        top, shift = y + height / 2 + 0.2 * (1 + (x > 3)), 0.15 * (x > 3) - 0.1
        way = [(x + shift, y + height / 2), (x + shift, top), (off_x + shift, top)]
        tip = off_x + shift, off_y + height / 2
    else:
        level = {"WIRING": 1.2, "LANDING": 0.85, "FAULT": 0.4}[begin]
        shift = {"WIRING": 0.3, "LANDING": 0.0, "FAULT": -0.3}[begin]
        beginning = [(x, y + height / 2)] if begin == "LANDING" else []
        way = [*beginning, (x if beginning else x - width / 2, level), (off_x + shift, level)]
        tip = off_x + shift, off_y - height / 2
    axes.plot([p[0] for p in way], [p[1] for p in way], color="#000000", linewidth=1.0)
    draw_arrow(axes, way[-1], tip, "")
    write_note(axes, (way[-1][0] + way[-2][0]) / 2, way[-1][1] + 0.1, on, style="italic", fontsize=7.5)


def _draw_state(axes: Any, state: State) -> None:
    from matplotlib.patches import FancyBboxPatch

    (x, y), (width, height) = PLACES[state], BOX
    corner = (x - width / 2, y - height / 2)
    style = "round,pad=0,rounding_size=0.12"
    axes.add_patch(
        FancyBboxPatch(corner, width, height, boxstyle=style, facecolor="#f2f5f8", edgecolor="#000000")
    )
    write_note(axes, x, y, state, weight="bold", fontsize=9, color="#000000")
