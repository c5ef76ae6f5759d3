"""The figures of the experiments that replicate the paper's on the planar motor."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.report import STYLES
from malta.report.figures.drawing import (
    BOUND_STYLE,
    Published,
    add_shared_legend,
    draw_bound,
    draw_dots,
    draw_line,
    finish_axes,
    label_upright,
    mark_end,
    new_page,
    number,
    published_in_unit,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.simulation import Experiment


def errors_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Figs 7, 8 and 13: maps of the models' errors, errors over the table's step, and errors along x."""
    from matplotlib.ticker import FixedLocator, NullLocator

    c, models = e.curves, [case.label for case in e.cases]
    mm = c["x"] * 1e3
    row = len(mm) // 8  # a quarter of a pole pitch
    largest = (f"{case.label} {case.merits[2].phrase()}" for case in e.cases)
    figure = new_page(
        runs_of(e),
        "one inner coil, coil models against its exact wrench",
        "largest error of F_z: " + ", ".join(largest),
        wspace=0.48,
        hspace=0.36,
        left=0.075,
        right=0.985,
    )
    (*maps, steps), (forces, missed, torque) = figure.subplots(2, 3)
    errors = {name: np.abs(c[name][..., 2]) * 1e3 for name in models}
    darkest = max(float(values.max()) for values in errors.values())
    for axes, (name, values) in zip(maps, errors.items(), strict=False):
        _draw_map(axes, mm, values, darkest, f"{name}: error of F_z")
    for axes in maps[len(models) :]:
        axes.set_visible(False)
    for k, (force, style) in enumerate(zip(("F_x", "F_z"), STYLES, strict=False)):
        steps.loglog(c["step"] * 1e3, c["by step"][:, k], marker="o", markersize=3, label=force, **style)
        if published is not None:
            bound = published_in_unit(published, f"model.error_interpolation.{force}", "N")
            draw_bound(steps, bound, f"published {force}", where=f"{('below', 'above')[k]} left")
    names = [s.name for s in e.run.plant.inputs]
    for k, style in zip((0, 1, 2), STYLES, strict=False):
        draw_line(forces, mm, c["exact"][:, row, k], label=names[k], **style)
    for axes, k in ((missed, 0), (torque, 3)):
        for name in models:
            _draw_error(axes, mm, c[name][:, row, k] * 1e3, name)
    finish_axes(steps, "step of the table [mm]", "largest error [N]", legend=2)
    steps.xaxis.set_major_locator(FixedLocator([0.3, 0.5, 1, 2, 3]))
    steps.xaxis.set_major_formatter("{x:g}")
    steps.xaxis.set_minor_locator(NullLocator())
    where = f"x [mm], y = {number(c['x'][row] * 1e3, 3)} mm"
    finish_axes(forces, where, "exact force [N]", legend=3)
    finish_axes(missed, where, "error of F_x [mN]", legend=2)
    finish_axes(torque, where, "error of T_x [mN m]", legend=2, side="right")
    return figure


def _draw_error(axes: Axes, mm: FloatArray, values: FloatArray, name: str) -> None:
    """An error along x: a line, or a band from least to largest where it turns too often for a line to be followed."""
    turns = int(np.count_nonzero(np.diff(np.sign(np.diff(values)))))
    if turns < MANY_TURNS:
        draw_line(axes, mm, values, label=name, **STYLES[0])
        return
    window = 2 * math.ceil(2 * len(values) / turns) + 1
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, window // 2, mode="edge"), window)
    band: dict[str, Any] = {"color": "#9ecae1", "linewidth": 0, "label": f"{name}, extremes"}
    axes.fill_between(mm, around.min(axis=1), around.max(axis=1), **band)


MANY_TURNS = 40  # of a line over a panel


def _draw_map(axes: Axes, mm: FloatArray, values: FloatArray, darkest: float, text: str) -> None:
    """A map over x and y in grey levels from 0 to `darkest`, with its scale."""
    shown: dict[str, Any] = {"cmap": "Greys", "shading": "gouraud", "rasterized": True}
    drawn = axes.pcolormesh(mm, mm, values.T, vmin=0, vmax=darkest, **shown)
    bar = axes.figure.colorbar(drawn, ax=axes, fraction=0.05, pad=0.03)
    bar.ax.set_title("[mN]", fontsize=8)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8)
    axes.set_title(text, fontsize=9, loc="left")
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_box_aspect(1)


def delay_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The largest of the three angles over time, by speed of the controller."""
    speeds = list(dict.fromkeys(case.label.split(", ")[1] for case in e.cases))
    left = (
        f"{case.merits[1].phrase()} {case.label.split(',')[0]} the delay"
        for case in e.cases
        if case.label.endswith(speeds[-1])
    )
    figure = new_page(
        runs_of(e),
        "filters with and without the delay in their model",
        f"angles left at rest, {speeds[-1]} as fast as designed: " + ", ".join(left),
        top=0.82,
        wspace=0.12,
    )
    panels = figure.subplots(1, len(speeds), sharex=True, sharey=True, squeeze=False)[0]
    for axes, speed in zip(panels, speeds, strict=True):
        for case in (case for case in e.cases if case.label.endswith(f", {speed}")):
            knows = case.label.split(",")[0]
            off = np.abs(case.run.p - case.run.reference)[:, 3:].max(axis=1) * 1e6
            off = np.maximum(off, MIN_ANGLE)
            style = STYLES[0] if knows == "with" else STYLES[1]
            draw_line(axes, case.run.t * 1e3, off, label=f"{knows} the delay", **style)
            mark_end(axes, case.run, case.run.t * 1e3, off)
        axes.set_title(f"{speed} as fast as designed", fontsize=9)
        finish_axes(axes, "time [ms]", "largest angle, off reference [µrad]" if axes is panels[0] else "")
    panels[0].set_yscale("log")
    panels[0].set_ylim(bottom=MIN_ANGLE)
    add_shared_legend(figure)
    return figure


MIN_ANGLE = 1e-4  # urad, smallest value on the logarithmic axis


def timing_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Computing times of one commutation, beside the control period."""
    timed = [merit for merit in e.merits if merit.unit == "us" and math.isfinite(merit.value)]
    times = {merit.label: merit.value * 1e6 for merit in timed}
    if published is not None:
        times["the paper's whole loop"] = published_in_unit(published, "real_time.mean", "us")
    figure = new_page(
        runs_of(e),
        "K(p) and its pseudo-inverse",
        "on this computer; the paper's on an NI PXI-1042Q",
        left=0.28,
    )
    axes = figure.subplots()
    draw_dots(axes, list(times), list(times.values()), [f"{number(value, 3)} µs" for value in times.values()])
    period = e.run.controller.sample_time * 1e6
    axes.axvline(period, **BOUND_STYLE)
    label_upright(axes, 1.05 * period, 0.4, f"control period, {period:g} µs", ha="left")
    axes.set_xlim(0.5 * min(times.values()), 4 * period)
    finish_axes(axes, "time of one call [µs]", "")
    return figure


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "errors": errors_figure,
    "delay": delay_figure,
    "timing": timing_figure,
}
