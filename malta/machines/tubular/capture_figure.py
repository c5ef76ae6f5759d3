"""The figure of the experiment capture: maps of starts that return, and releases from just inside and beyond."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.tubular.experiments.capture import PLANES
from malta.report.figures.parts import (
    MORE,
    STYLES,
    Published,
    draw_line,
    finish_axes,
    merit_phrase,
    new_page,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.simulation.experiments import Experiment

SCALES = {"x": "mm", "y": "mm", "z": "mm", "alpha": "mrad", "beta": "mrad"}  # 1e3 of each SI value
RETURNS = "#cfcfcf"
SHOWN = 60.0  # ms, of the releases
BESIDE: dict[str, Any] = {"color": "#000000", "linestyle": (0, (5, 2)), "linewidth": 1.3}
INSIDE: dict[str, Any] = {"color": "#1f77b4", "linestyle": "-", "linewidth": 1.3}


def capture_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Maps of the starts at rest from which the mover returns, with what the force limit allows at best and the
    clearance as built; the largest displacement over time of some releases."""
    ratio = next(merit for merit in e.merits if merit.label == "x: their ratio")
    inside = e.merits[-1]
    found = f"along x it returns from {merit_phrase(ratio)} of what the force limit allows; "
    found += f"{inside.label}: {merit_phrase(inside)}"
    figure = new_page(runs_of(e), "released at rest, without touchdown bearings", found, hspace=0.42)
    *maps, traces = figure.subplots(2, 2).ravel()
    for axes, plane in zip(maps, PLANES, strict=True):
        _draw_map(axes, e, plane)
    highest = float(np.abs(e.curves["clearance x beta"][:, 0]).max()) * 1e3
    for case, style in zip(e.cases, (*STYLES, *MORE), strict=False):
        run, ms = case.run, case.run.t * 1e3
        off = np.abs(run.p[:, :4]).max(axis=1) * 1e3
        draw_line(traces, ms, off, label=case.label.removesuffix(", inside"), **style)
        if run.verdict.completed:
            highest = max(highest, float(off.max()))
    finish_axes(traces, "time [ms]", "off centre, largest [mm]", legend=4)
    traces.set_xlim(0, SHOWN)
    traces.set_ylim(0, 1.3 * highest)
    return figure


def _draw_map(axes: Axes, e: Experiment, plane: tuple[str, str]) -> None:
    """The starts of one plane that return, the bound of the force limit, and the clearance as built."""
    from matplotlib.colors import ListedColormap

    name = " ".join(plane)
    across, up = (e.curves[f"axis {name} {state}"] * 1e3 for state in plane)
    returns = e.curves[f"map {name}"]
    axes.pcolormesh(across, up, returns, cmap=ListedColormap(["#ffffff", RETURNS]), vmin=0, vmax=1)
    axes.plot([], [], label="returns", marker="s", markersize=8, linestyle="none", color=RETURNS)
    if f"bound {name}" in e.curves:
        bound = e.curves[f"bound {name}"] * 1e3
        axes.plot(*np.vstack([bound, bound[:1]]).T, label="force limit, at best", **BESIDE)
    else:  # the travel along, and across what is allowed at the centre
        reach = float(np.abs(e.curves[f"bound {' '.join(PLANES[0])}"][:, 0]).max()) * 1e3
        for side in (-reach, reach):
            axes.axhline(side, label="force limit, at best", **BESIDE)
    edge = e.curves[f"clearance {name}"] * 1e3
    axes.plot(*np.vstack([edge, edge[:1]]).T, label="clearance", **INSIDE)
    finish_axes(axes, f"{plane[0]} [{SCALES[plane[0]]}]", f"{plane[1]} [{SCALES[plane[1]]}]", legend=3)
