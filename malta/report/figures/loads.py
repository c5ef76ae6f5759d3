"""The figure of loads of any waveform: how much of a clearance they use, over their size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from malta.errors import InputError
from malta.margins.load_sizes import LoadCourse, LoadLimit
from malta.report.figures.drawing import BOUND_STYLE, STYLES, draw_bound, finish_axes, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def load_limits_figure(found: Sequence[LoadLimit], name: str, path: str | Path | None = None) -> Figure:
    """Draw the share of a clearance that any waveform of a load uses at most, over its size: proven, and linear.

    found : from `malta.margins.load_limits`, with `courses`: a panel for each load that has one
    name : of the design
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError where no load has a course, and for another suffix.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/structured.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> found = malta.margins.load_limits(loop, ["F_x"], courses=True)
    >>> figure = malta.report.load_limits_figure(found, controller.name)
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['any F_x of at most [N]']
    """
    drawn = [(one, one.course) for one in found if one.course is not None]
    if not drawn:
        raise InputError(name, "courses", "none", "load_limits of a machine with contacts, with courses=True")
    told = (f"any {one.safe.disturbance} of {one.proven.text()} {one.safe.unit}" for one, _ in drawn)
    text = f"proven: {', '.join(told)}"
    figure = new_figure(
        f"{name}: clearance used under loads of any waveform", text, size=(9.0, 4.4), top=0.78, wspace=0.25
    )
    panels = figure.subplots(1, len(drawn), squeeze=False)[0]
    for axes, (one, course) in zip(panels, drawn, strict=True):
        _draw(axes, one, course)
    return save_figure(figure, path)


def _draw(axes: Axes, found: LoadLimit, course: LoadCourse) -> None:
    """The two courses of a load, where the proof ends, and where a clearance is used up."""
    axes.plot(course.sizes, 100 * course.used, label="nonlinear machine, proven", **STYLES[0])
    axes.plot(course.linear[0], 100 * course.linear[1], label="linear loop", **STYLES[2])
    axes.axvline(course.sizes[-1], **BOUND_STYLE)
    if math.isfinite(found.touches):
        draw_bound(axes, 100 * found.safe.clearance, "touched" if found.safe.clearance == 1 else "allowed")
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)
    label = f"any {found.safe.disturbance} of at most [{found.safe.unit}]"
    finish_axes(axes, label, "clearance used [%]", legend=2)
