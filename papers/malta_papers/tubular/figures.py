"""The figures of the experiments on MALTA that its paper shows or leaves open."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.report import STYLES
from malta.report.figures.drawing import (
    MORE_STYLES,
    NOTE,
    Published,
    add_shared_legend,
    draw_bound,
    draw_largest,
    draw_line,
    draw_published,
    ending_text,
    finish_axes,
    mark_end,
    merits_phrase,
    new_page,
    runs_of,
)
from malta_papers.tubular.capture import PLANES
from malta_papers.tubular.experiments import FED_SHARES
from malta_papers.tubular.recording import OWN_TABLE, RECORDED_TABLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.model import Plant
    from malta.simulation import Experiment


def thermal_figure(e: Experiment, published: Published | None = None) -> Figure:
    """The drift of the support, and the mover's position in space with and without the outer loop. Fig. 15."""
    _, now, true = (merit.phrase() for merit in e.merits)
    found = f"{merits_phrase(e.cases, 0)}; lag {now}, at true speed {true}"
    figure = new_page(runs_of(e), "support drifts by thermal expansion", found, hspace=0.18)
    space, blow_up = figure.subplots(2, 1, sharex=True)
    t, drift = e.run.t, e.curves["drift"]
    draw_line(space, t, drift * 1e6, label="drift of the support", color="#cfcfcf", linewidth=6)
    for case, style in zip(e.cases, STYLES, strict=False):
        size = min(len(t), len(case.run.t))
        place = (case.run.p[:size, 2] + drift[:size]) * 1e6
        draw_line(space, t[:size], place, label=f"mover in space, {case.label}", **style)
        mark_end(space, case.run, t[:size], place)
        if case is e.cases[0]:
            draw_line(blow_up, t, place, **style | {"linewidth": 0.8})
    read = ("figure_14.resolution", "um", "published resolution of the sensors")
    draw_published(blow_up, published, *read, both=True, where="under right")
    finish_axes(space, "", "x2 in space [µm]")
    finish_axes(blow_up, "simulated time [s]", f"{e.cases[0].label}, enlarged [µm]")
    add_shared_legend(figure)
    return figure


def drive_limits_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Position, speed, current and voltage of the fastest stroke and of the sigmoid, against the limits."""
    plant, actuator = e.run.plant, e.run.plant.actuator
    what = "fastest stroke, and sigmoid of the same peak current"
    what += "".join(f", {case.label}{ending_text(case.run)}" for case in e.cases if ending_text(case.run))
    figure = new_page(runs_of(e), what, merits_phrase(e.cases, 1), hspace=0.2)
    (position, current), (speed, voltage) = figure.subplots(2, 2, sharex=True)
    half = 0.75e3 * e.cases[-1].merits[1].value
    position.set_xlim(-half, half)
    thrust, rate = _thrust_axis(plant), len(plant.states) // 2 + plant.stroke_state
    for case, style in zip(e.cases, STYLES, strict=False):
        run, ms = case.run, (case.run.t - case.run.scenario.duration / 2) * 1e3
        draw_line(position, ms, run.p[:, plant.stroke_output] * 1e3, label=case.label, **style)
        mark_end(position, run, ms, run.p[:, plant.stroke_output] * 1e3)
        draw_line(speed, ms, run.x[:, rate], **style)
        draw_line(current, ms, run.axis_currents[:, thrust], **style)
        if run.u.size:
            draw_line(voltage, ms, run.u[:, thrust], **style)
    if not e.run.u.size:
        note = f"none at fidelity {e.run.scenario.fidelity}"
        voltage.annotate(note, (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
    for axes, merit, limit in (
        (current, e.merits[0], actuator.current_limit),
        (voltage, e.merits[1], actuator.voltage_limit),
    ):
        draw_bound(axes, merit.value, "for the reference", both=True, where="below left")
        draw_bound(axes, limit, "limit of the drive", both=True, where="above left")
    finish_axes(position, "", "position z [mm]")
    finish_axes(current, "", "current per module [A]")
    finish_axes(speed, "time from half-way [ms]", "speed [m/s]")
    finish_axes(voltage, "time from half-way [ms]", "voltage per module [V]")
    add_shared_legend(figure)
    return figure


def _thrust_axis(plant: Plant) -> int:
    """The first axis with a thrust current."""
    unit = np.zeros(len(plant.inputs))
    unit[plant.thrust_input] = 1.0
    return int(np.flatnonzero(np.array(ca.DM(plant.drive.command(ca.DM(unit)))))[0])


SCALES = {"x": "mm", "y": "mm", "z": "mm", "alpha": "mrad", "beta": "mrad"}  # 1e3 of each SI value


RETURNS = "#cfcfcf"


SHOWN_TIME = 60.0  # ms, of the releases


OUTER_STYLE: dict[str, Any] = {"color": "#000000", "linestyle": (0, (5, 2)), "linewidth": 1.3}


INNER_STYLE: dict[str, Any] = {"color": "#1f77b4", "linestyle": "-", "linewidth": 1.3}


def capture_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Maps of the starts at rest from which the mover returns, with what the force limit allows at best and the
    clearance as built; the largest displacement over time of some releases."""
    ratio = next(merit for merit in e.merits if merit.label == "x: their ratio")
    inside = e.merits[-1]
    found = f"along x it returns from {ratio.phrase()} of what the force limit allows; "
    found += f"{inside.label}: {inside.phrase()}"
    figure = new_page(runs_of(e), "released at rest, without touchdown bearings", found, hspace=0.42)
    *maps, traces = figure.subplots(2, 2).ravel()
    for axes, plane in zip(maps, PLANES, strict=True):
        _draw_map(axes, e, plane)
    highest = float(np.abs(e.curves["clearance x beta"][:, 0]).max()) * 1e3
    for case, style in zip(e.cases, (*STYLES, *MORE_STYLES), strict=False):
        run, ms = case.run, case.run.t * 1e3
        off = np.abs(run.p[:, :4]).max(axis=1) * 1e3
        draw_line(traces, ms, off, label=case.label.removesuffix(", inside"), **style)
        if run.verdict.completed:
            highest = max(highest, float(off.max()))
    finish_axes(traces, "time [ms]", "off centre, largest [mm]", legend=4)
    traces.set_xlim(0, SHOWN_TIME)
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
        axes.plot(*np.vstack([bound, bound[:1]]).T, label="force limit, at best", **OUTER_STYLE)
    else:  # the travel along, and across what is allowed at the centre
        reach = float(np.abs(e.curves[f"bound {' '.join(PLANES[0])}"][:, 0]).max()) * 1e3
        for side in (-reach, reach):
            axes.axhline(side, label="force limit, at best", **OUTER_STYLE)
    edge = e.curves[f"clearance {name}"] * 1e3
    axes.plot(*np.vstack([edge, edge[:1]]).T, label="clearance", **INNER_STYLE)
    finish_axes(axes, f"{plane[0]} [{SCALES[plane[0]]}]", f"{plane[1]} [{SCALES[plane[1]]}]", legend=3)


SMOOTHING_SAMPLES = 50  # samples of a mean of the noisy force


def carrier_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The carrier's acceleration, the force of a bearing, and the radial deviation at rest and during a stroke."""
    rest = [case for case in e.cases if case.label.startswith("rest")]
    told = ", ".join(f"{case.label.partition(', ')[2]} {case.merits[0].phrase()}" for case in rest)
    figure = new_page(runs_of(e), "the carrier accelerates sideways", f"radial deviation at rest: {told}")
    (moved, force), (still, stroke) = figure.subplots(2, 2, sharex=True)
    moved.plot(e.curves["t"] * 1e3, e.curves["acceleration"], color="#000000", linewidth=1.4)
    for case in e.cases:
        run, ms = case.run, case.run.t * 1e3
        place, __, label = case.label.partition(", ")
        style = STYLES[list(FED_SHARES).index(label)]
        radial = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
        off = np.maximum(np.abs((run.p - run.reference)[:, radial]).max(axis=1) * 1e6, 0.1)
        axes = still if place == "rest" else stroke
        draw_largest(axes, ms, off, label=label, **style)
        mark_end(axes, run, ms, off)
        if place == "rest":
            count = len(ms) // SMOOTHING_SAMPLES * SMOOTHING_SAMPLES
            means = (s[:count].reshape(-1, SMOOTHING_SAMPLES).mean(axis=1) for s in (ms, run.v[:, 0]))
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


# The figure of record-v0: recorded beside computed v0(z), and the strokes with both.


def recording_figure(e: Experiment, _: Published | None = None) -> Figure:
    """v0(z) of the thrust and the differences of all forces; axial errors of strokes with own and recorded v0."""
    found = "no v0 recorded"
    if e.merits:
        thrust = next(merit for merit in e.merits if merit.label.endswith(e.run.plant.stroke.thrust))
        found = f"{thrust.label}: {thrust.phrase()}; {e.merits[-1].label}: {e.merits[-1].phrase()}"
    figure = new_page(runs_of(e), "v0(z) recorded by a slow stroke", found, hspace=0.34, top=0.83, left=0.1)
    (table, difference), (own, recorded) = figure.subplots(2, 2)
    _draw_tables(table, difference, e)
    top = 0.0
    for axes, what in ((own, OWN_TABLE), (recorded, RECORDED_TABLE)):
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
        draw_line(
            difference, z * 1e3, off[:, axis], label=plant.stroke.thrust, **STYLES[0] | {"linewidth": 0.9}
        )
        count = f"{bearings.shape[1]} bearing forces, least to largest"
        difference.fill_between(z * 1e3, *_extremes(bearings), color="#e0a08c", linewidth=0, label=count)
    finish_axes(table, f"{plant.stroke.name} [mm]", f"v0 of {plant.stroke.thrust} [N]")
    finish_axes(difference, f"{plant.stroke.name} [mm]", "recorded less own v0 [mN]", legend=2)


def _extremes(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest of each row."""
    return values.min(axis=1), values.max(axis=1)


def _machine(label: str) -> str:
    """The machine of a case: its displaced cogging, or as it is."""
    return label.rpartition(": ")[0] or "as it is"


def _style(label: str, e: Experiment) -> dict[str, Any]:
    """The line of a machine, the same in all panels."""
    machines = list(dict.fromkeys(_machine(case.label) for case in e.cases))
    return (
        dict(STYLES[machines.index(_machine(label))]) if _machine(label) in machines else dict(MORE_STYLES[0])
    )


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "thermal": thermal_figure,
    "drive-limits": drive_limits_figure,
    "record-v0": recording_figure,
    "carrier": carrier_figure,
    "capture": capture_figure,
}
