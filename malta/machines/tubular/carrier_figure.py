"""The figure of the experiment carrier: the carrier's move, radial deviations and bearing forces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.machines.tubular.experiments.carrier import KNOWN
from malta.report.figures.marks import draw_largest
from malta.report.figures.parts import (
    STYLES,
    Published,
    add_shared_legend,
    finish_axes,
    mark_end,
    merit_phrase,
    new_page,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.simulation.experiments import Experiment


SMOOTHED = 50  # samples of a mean of the noisy force


def carrier_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The carrier's acceleration, the force of a bearing, and the radial deviation at rest and during a stroke."""
    rest = [case for case in e.cases if case.label.startswith("rest")]
    told = ", ".join(f"{case.label.partition(', ')[2]} {merit_phrase(case.merits[0])}" for case in rest)
    figure = new_page(runs_of(e), "the carrier accelerates sideways", f"radial deviation at rest: {told}")
    (moved, force), (still, stroke) = figure.subplots(2, 2, sharex=True)
    moved.plot(e.curves["t"] * 1e3, e.curves["acceleration"], color="#000000", linewidth=1.4)
    for case in e.cases:
        run, ms = case.run, case.run.t * 1e3
        place, __, label = case.label.partition(", ")
        style = STYLES[list(KNOWN).index(label)]
        radial = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
        off = np.maximum(np.abs((run.p - run.reference)[:, radial]).max(axis=1) * 1e6, 0.1)
        axes = still if place == "rest" else stroke
        draw_largest(axes, ms, off, label=label, **style)
        mark_end(axes, run, ms, off)
        if place == "rest":
            count = len(ms) // SMOOTHED * SMOOTHED
            means = (s[:count].reshape(-1, SMOOTHED).mean(axis=1) for s in (ms, run.v[:, 0]))
            force.plot(*means, **style)
    for axes in (still, stroke):
        axes.set_yscale("log")
        axes.set_ylim(0.1, 2e3)
    finish_axes(moved, "", "acceleration [m/s²]")
    finish_axes(force, "", f"{e.run.plant.inputs[0].name}, at rest, smoothed [N]")
    finish_axes(still, "time [ms]", "radial deviation, at rest [µm]")
    finish_axes(stroke, "time [ms]", "radial deviation, stroke [µm]")
    add_shared_legend(figure)
    return figure
