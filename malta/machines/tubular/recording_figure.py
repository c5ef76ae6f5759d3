"""The figure of the experiment record-v0: recorded beside computed v0(z), and the strokes with both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.tubular.experiments.recording import OWN, RECORDED
from malta.report.figures.parts import (
    MORE,
    NOTE,
    STYLES,
    Published,
    add_shared_legend,
    draw_line,
    finish_axes,
    mark_end,
    merit_phrase,
    new_page,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.model.plant import FloatArray
    from malta.simulation.experiments import Experiment


def recording_figure(e: Experiment, _: Published | None = None) -> Figure:
    """v0(z) of the thrust and the differences of all forces; axial errors of strokes with own and recorded v0."""
    found = "no v0 recorded"
    if e.merits:
        thrust = next(merit for merit in e.merits if merit.label.endswith(e.run.plant.thrust))
        found = f"{thrust.label}: {merit_phrase(thrust)}; {e.merits[-1].label}: {merit_phrase(e.merits[-1])}"
    figure = new_page(runs_of(e), "v0(z) recorded by a slow stroke", found, hspace=0.34, top=0.83, left=0.1)
    (table, difference), (own, recorded) = figure.subplots(2, 2)
    _draw_tables(table, difference, e)
    top = 0.0
    for axes, what in ((own, OWN), (recorded, RECORDED)):
        drawn = [case for case in e.cases if case.label.endswith(what)]
        for case in drawn:
            run, ms = case.run, case.run.t * 1e3
            error = (run.reference - run.p)[:, run.plant.stroke_output] * 1e3
            draw_line(axes, ms, error, label=_machine(case.label), **_style(case.label, e))
            mark_end(axes, run, ms, error)
            top = max(top, float(np.abs(error).max()))
        if not drawn:
            axes.annotate("no such stroke", (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
        finish_axes(axes, "time [ms]", f"axial error, {what} [mm]")
    for axes in (own, recorded):
        axes.set_ylim(-1.05 * top or None, 1.05 * top or None)
    add_shared_legend(figure)
    return figure


def _draw_tables(table: Axes, difference: Axes, e: Experiment) -> None:
    """v0 of the thrust on each machine beside the gain file's own; recorded less own v0, of bearings the extremes."""
    plant, c = e.run.plant, e.run.controller
    ff, axis = c.feedforward, plant.thrust_input
    draw_line(table, ff.z_grid * 1e3, ff.v0[:, axis], label="own v0", **STYLES[3])
    z = e.curves.get("z", np.zeros(0))
    for name in (name for name in e.curves if name.startswith("v0 ")):
        label = name.removeprefix("v0 ")
        draw_line(table, z * 1e3, e.curves[name][:, axis], label=_machine(label), **_style(label, e))
    if "v0 " in e.curves:
        off = (e.curves["v0 "] - np.array([ff.at(float(at)) for at in z])) * 1e3
        bearings = np.delete(off, axis, axis=1)
        draw_line(difference, z * 1e3, off[:, axis], label=plant.thrust, **STYLES[0] | {"linewidth": 0.9})
        count = f"{bearings.shape[1]} bearing forces, least to largest"
        difference.fill_between(z * 1e3, *_extremes(bearings), color="#e0a08c", linewidth=0, label=count)
    finish_axes(table, f"{plant.stroke} [mm]", f"v0 of {plant.thrust} [N]")
    finish_axes(difference, f"{plant.stroke} [mm]", "recorded less own v0 [mN]", legend=2)


def _extremes(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest of each row."""
    return values.min(axis=1), values.max(axis=1)


def _machine(label: str) -> str:
    """The machine of a case: its displaced cogging, or as it is."""
    return label.rpartition(": ")[0] or "as it is"


def _style(label: str, e: Experiment) -> dict[str, Any]:
    """The line of a machine, the same in all panels."""
    machines = list(dict.fromkeys(_machine(case.label) for case in e.cases))
    return dict(STYLES[machines.index(_machine(label))]) if _machine(label) in machines else dict(MORE[0])
