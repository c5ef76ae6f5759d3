"""The figures of the experiments on MALTA, similar to those of its paper."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from malta.machines.tubular.experiment_figures import commissioning_figure, supervised_faults_figure
from malta.machines.tubular.experiments.disturbances import REST_SAMPLES
from malta.model.plants import plant_of
from malta.report.figures.drawing import (
    BOUND_STYLE,
    CROSS,
    DOT,
    MORE_STYLES,
    NOTE,
    PAPER,
    REFERENCE,
    STYLES,
    Published,
    add_shared_legend,
    clearance,
    draw_bound,
    draw_dots,
    draw_group,
    draw_histograms,
    draw_largest,
    draw_line,
    draw_published,
    draw_spreads,
    end_of,
    ended_early,
    ending_text,
    finish_axes,
    label_upright,
    mark_end,
    merits_phrase,
    micro,
    new_page,
    number,
    published_in_unit,
    runs_of,
    square_axes,
)
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.references import hold
from malta.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.simulation.experiments import Experiment, Merit


def stroke_figure(run: Trajectory, published: Published | None = None) -> Figure:
    """Axial position, tracking error and speed, radial deviation, currents and thrust of a stroke. Figs 12 and 13."""
    plant, f, axis, ms = run.plant, stroke_figures(run), run.plant.stroke_output, run.t * 1e3
    motion = run.scenario.reference(plant)
    first, last = motion(np.array([0, run.scenario.duration])).p[:, axis]
    errors = (
        f"axial error {f.axial_error * 1e3:.2f} mm, "
        f"radial deviation {number(max(f.radial.values()) * 1e6, 2)} µm"
    )
    tracked = f"rise {number(f.rise * 1e3, 3)} ms, overshoot {number(f.overshoot * 100, 2)} %, "
    figure = new_page(
        [run],
        f"stroke of {(last - first) * 1e3:.3g} mm{ending_text(run)}",
        (tracked if run.verdict.completed else "") + errors,
        left=0.1,
        right=0.925,
        hspace=0.24,
        size=(9.0, 6.7),
        top=0.885,
    )
    (position, radial), (error, bearing), (speed, current) = figure.subplots(3, 2, sharex=True)
    names = [s.name for s in plant.outputs]
    draw_line(position, ms, run.reference[:, axis] * 1e3, label="reference z*", **REFERENCE)
    draw_line(position, ms, run.p[:, axis] * 1e3, label="position z", **STYLES[0])
    draw_line(error, ms, (run.reference[:, axis] - run.p[:, axis]) * 1e3, **STYLES[0])
    off = (run.p - run.reference) * 1e6
    draw_group(radial, ms, {name: off[:, i] for i, name in enumerate(names) if i != axis})
    draw_line(speed, ms, motion(run.t).dp[:, axis], **REFERENCE)
    draw_line(speed, ms, run.x[:, len(plant.states) // 2 + plant.stroke_state], **STYLES[0])
    forces = {s.name: run.current[:, i] for i, s in enumerate(plant.inputs)}
    drive = plant.inputs[plant.thrust_input].name
    draw_line(current, ms, forces.pop(drive), **STYLES[0])
    draw_group(bearing, ms, forces)
    draw_published(error, published, "figure_12.axial_error", "mm", both=True)
    draw_published(radial, published, "figure_13.radial_deviation", "um", both=True)
    reached = np.array([first, last, run.p[:, axis].min(), run.p[:, axis].max()]) * 1e3
    margin = 0.05 * (reached.max() - reached.min())  # around the whole stroke, even if the run ended early
    position.set_ylim(reached.min() - margin, reached.max() + margin)
    finish_axes(position, "", "axial position z [mm]", legend=2)
    finish_axes(radial, "", "radial deviation [µm]", legend=4)
    finish_axes(error, "", "axial error z* - z [mm]")
    finish_axes(bearing, "", "bearing current [A]", legend=4)
    finish_axes(speed, "time [ms]", "axial speed [m/s]")
    finish_axes(current, "time [ms]", "drive current [A]", side="right")
    constant = plant_of(run.controller.parameters).actuator.force_constant[plant.thrust_input]
    thrust = current.secondary_yaxis("right", functions=(lambda i: i * constant, lambda f: f / constant))
    thrust.set_ylabel(f"thrust {drive} [N]")
    return figure


def hold_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Histograms of measured and true positions at rest, in bins of the sensors' resolution. Fig. 14, Table III."""
    run, axis = e.run, e.run.plant.stroke_output
    names = [s.name for s in run.plant.outputs]
    y, p = run.y[-REST_SAMPLES:] * 1e6, run.p[-REST_SAMPLES:] * 1e6
    sensors = run.plant.sensors
    bins = [1e6 * (r or s / 3) or 1.0 for r, s in zip(sensors.resolution, sensors.noise, strict=True)]
    rms, widest = np.sqrt((p**2).mean(axis=0)), np.abs(y).max(axis=0)
    radial = [k for k in range(len(names)) if k != axis]
    figure = new_page(
        [run],
        f"{len(y)} samples at rest{ending_text(run)}",
        "means and standard deviations above the bars; "
        f"true motion {number(rms[radial].max(), 2)} µm rms radially, {number(rms[axis], 2)} µm axially",
        wspace=0.33,
    )
    grid = figure.add_gridspec(2, 3)
    panels = [figure.add_subplot(grid[k % 2, k // 2] if k != axis else grid[:, 2]) for k in range(len(names))]
    labels = (
        f"measured, in bins of {bins[0]:.2g} µm ({names[axis]}: {bins[axis]:.2g} µm)",
        "true, in the same bins",
    )
    spreads = [[("measured", float(y[:, k].mean()), float(y[:, k].std()))] for k in range(len(names))]
    if published is not None:
        for name, found in zip(names, spreads, strict=True):
            mean, std = (
                published_in_unit(published, f"table_III.{what}.{name}", "um") for what in ("mean", "std")
            )
            found.append(("Table III", mean, std))
    for k, found in enumerate(spreads):
        found.append(("true", float(p[:, k].mean()), float(p[:, k].std())))
    for k, axes in enumerate(panels):
        reach = 1.4 * max(float(widest[k] if k == axis else widest[radial].max()), bins[k])
        told = [2.4 * (abs(mean) + std) for _, mean, std in spreads[k][1:]]
        draw_histograms(axes, (y[:, k], p[:, k]), labels, bins[k], max([min(reach, 60 * bins[k]), *told]))
        finish_axes(axes, f"{names[k]} [µm]", "share of samples [%]")
    highest = max(panels[k].dataLim.y1 for k in radial)
    for k, axes in enumerate(panels):
        draw_spreads(axes, spreads[k], float(axes.dataLim.y1) if k == axis else highest)
    add_shared_legend(figure)
    return figure


def tilt_figure(e: Experiment, published: Published | None = None) -> Figure:
    """The circle in sensor plane 1, the deviation in sensor plane 2, and both over time. Fig. 16, eq. (21)."""
    figure = new_page(runs_of(e), "circle in sensor plane 1, sensor plane 2 held", merits_phrase(e.cases, 0))
    (circle, tracking), (blow_up, deviation) = figure.subplots(2, 2, width_ratios=(1, 1.6))
    for case, style in zip(e.cases, STYLES, strict=False):
        run, error = case.run, (case.run.p - case.run.reference) * 1e6
        late = slice(len(error) // 2, None)
        circle.plot(run.p[late, 0] * 1e6, run.p[late, 1] * 1e6, label=case.label, **style)
        blow_up.plot(error[late, 2], error[late, 3], **style)
        for axes, k in ((tracking, 0), (deviation, 2)):
            distance = np.hypot(error[:, k], error[:, k + 1])
            draw_largest(axes, run.t, distance, **style)
            mark_end(axes, run, run.t, distance)
    asked = e.run.reference * 1e6
    circle.plot(
        asked[:, 0], asked[:, 1], label="reference", **STYLES[2] | {"color": "#000000", "linewidth": 0.9}
    )
    bound = 0.0
    if published is not None:
        bound, angle = (
            published_in_unit(published, "figure_16.deviation", "um"),
            np.linspace(0, 2 * math.pi, 181),
        )
        blow_up.plot(bound * np.cos(angle), bound * np.sin(angle), **BOUND_STYLE)
        blow_up.annotate("published bound", (0, -1.08 * bound), ha="center", va="top", **NOTE | PAPER)
    for axes in (tracking, deviation):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.1)
    draw_published(deviation, published, "figure_16.deviation", "um")
    square_axes(circle)
    square_axes(blow_up, least=1.4 * bound)
    late_part = "second half" if any(map(ended_early, runs_of(e))) else "last period"
    finish_axes(circle, f"x1, {late_part} [µm]", "y1 [µm]")
    finish_axes(blow_up, f"x2, {late_part} [µm]", "y2 [µm]")
    finish_axes(tracking, "time [s]", "plane 1, off reference [µm]")
    finish_axes(deviation, "time [s]", "plane 2, off centre [µm]")
    add_shared_legend(figure)
    return figure


def lift_off_figure(e: Experiment, _: Published | None = None) -> Figure:
    """From the touchdown bearing to the centre, and the bearing currents, for each start-up estimator.

    Both ends rise nearly alike: the left panels have the end in sensor plane 1, the right ones what differs.
    """
    plant, runs = e.run.plant, runs_of(e)
    figure = new_page(runs, "lift-off from the touchdown bearing", merits_phrase(e.cases, 1), hspace=0.2)
    (height, tilt), (current, uneven) = figure.subplots(2, 2, sharex=True)
    for case, style in zip(e.cases, STYLES, strict=False):
        ms, y = case.run.t * 1e3, case.run.p * 1e6
        i = case.run.force / np.array(plant.actuator.force_constant)
        for axes, differs, values in ((height, tilt, y), (current, uneven, i)):
            draw_line(axes, ms, values[:, 1], label=case.label, **style)
            draw_line(differs, ms, values[:, 3] - values[:, 1], **style)
        mark_end(height, case.run, ms, y[:, 1])
    draw_bound(height, -clearance(plant) * 1e6, "touchdown bearing")
    draw_bound(current, e.merits[0].value, "lifts it by statics")
    one, two = (plant.outputs[k].name for k in (1, 3))
    finish_axes(height, "", f"{one} [µm]")
    finish_axes(tilt, "", f"{two} less {one} [µm]")
    one, two = (plant.inputs[k].name for k in (1, 3))
    finish_axes(current, "time [ms]", f"current of {one} [A]")
    finish_axes(uneven, "time [ms]", f"current of {two} less that of {one} [A]")
    moving = max(float(run.t[np.flatnonzero(np.abs(run.p[:, 1]) > 20e-6)].max(initial=0.0)) for run in runs)
    height.set_xlim(0, 1e3 * min(1.6 * moving, max(float(run.t[-1]) for run in runs)) or None)
    add_shared_legend(figure)
    return figure


def payload_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Sag after the pick and the stroke that follows, for each mass; touchdowns are marked."""
    plant, runs = e.run.plant, runs_of(e)
    figure = new_page(runs, "masses picked during a hold, then moved", merits_phrase(e.cases, 0))
    (sag, axial), (largest, radial) = figure.subplots(2, 2)
    t, picked = e.run.t, e.run.scenario.changes[0][0]
    begin = _half_way(e.run) - 0.05
    lowest = min((1, 3), key=lambda k: float(e.run.p[(t >= picked) & (t < begin), k].min(initial=0.0)))
    sag.set_xlim(-20, (begin - picked) * 1e3)
    for axes in (axial, radial):
        axes.set_xlim(0, (e.run.scenario.duration - begin) * 1e3)
    masses = [(run.scenario.changes[0][1]["m"] - plant.stroke.mass) * 1e3 for run in runs]
    for case, mass, style in zip(e.cases, masses, cycle((*STYLES, *MORE_STYLES))):
        run, y = case.run, case.run.p[:, lowest] * 1e6
        last = int(np.searchsorted(run.t, begin))
        shown = slice(0, min(last, end_of(run) + 1))
        draw_line(sag, (run.t[shown] - picked) * 1e3, y[shown], label=case.label, **style)
        mark_end(sag, run, (run.t - picked) * 1e3, y)
        largest.plot(mass, case.merits[0].value * 1e6, **(CROSS if ended_early(run) else DOT))
        if not ended_early(run):
            ms, error = (run.t[last:] - begin) * 1e3, (run.reference - run.p)[last:]
            draw_line(axial, ms, error[:, plant.stroke_output] * 1e3, **style)
            draw_line(radial, ms, np.abs(error[:, :4]).max(axis=1) * 1e6, **style)
    if all(map(ended_early, runs)):
        axial.annotate("none is carried", (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
    draw_bound(sag, -clearance(plant) * 1e6, "touchdown bearing")
    draw_bound(largest, clearance(plant) * 1e6, "touchdown bearing", where="above left")
    if published is not None:
        payload = published_in_unit(published, "position_controller.payload", "kg") * 1e3
        largest.axvline(payload, **BOUND_STYLE)
        label_upright(largest, payload, 0.26, "published payload", ha="right")
    draw_published(axial, published, "figure_12.axial_error", "mm", NO_PAYLOAD, both=True, where="above left")
    draw_published(radial, published, "figure_13.radial_deviation", "um", NO_PAYLOAD, where="above left")
    finish_axes(sag, "time after the pick [ms]", f"sag {plant.outputs[lowest].name} [µm]")
    finish_axes(largest, "picked mass [g]", "largest sag [µm]")
    largest.set(xlim=(0, 1.1 * max(masses)), ylim=(0, None))
    radial.set_ylim(0, None)
    finish_axes(axial, "time of the stroke [ms]", "axial error z* - z [mm]")
    finish_axes(radial, "time of the stroke [ms]", "largest radial deviation [µm]")
    add_shared_legend(figure)
    return figure


NO_PAYLOAD = "published, empty"  # the paper's bounds hold for a stroke without payload


def _half_way(run: Trajectory) -> float:
    """Time at which the reference of the stroke is fastest, s, in the whole scenario."""
    t = np.arange(0, run.scenario.duration, run.controller.sample_time)
    return float(t[np.abs(run.scenario.reference(run.plant)(t).dp[:, run.plant.stroke_output]).argmax()])


def disturbance_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Compliance over frequency with simulated points, and the responses to steps and to vibration."""
    plant, c = e.run.plant, e.curves
    worst, at, stiffness = (merit.phrase() for merit in e.merits)
    found = f"largest compliance {worst} at {at}, smallest dynamic stiffness {stiffness}"
    figure = new_page(runs_of(e), "forces and torques on the mover", found, hspace=0.44)
    (compliance, radial), (axial, vibration) = figure.subplots(2, 2)
    compliance.loglog(
        c["frequency"], c["compliance"] * 1e6, label="linear loop, currents as lags", **STYLES[0]
    )
    points = DOT | {"color": STYLES[1]["color"], "label": f"simulated, {e.run.scenario.fidelity}"}
    compliance.loglog(c["tones"], c["simulated"] * 1e6, **points)
    sideways = iter(STYLES)
    for case in e.cases:
        run, ms = case.run, case.run.t * 1e3
        if not case.label.startswith("step"):
            late = run.t > run.t[-1] - 0.1
            draw_line(vibration, ms[late], run.p[late, 1] * 1e6, label=case.label, **STYLES[0])
            continue
        if "F_z" in case.label:
            axes, deflection, style = axial, run.p[:, plant.stroke_output] * 1e3, STYLES[0]
        else:
            axes, deflection, style = radial, run.p[:, 0] * 1e6, next(sideways)
        draw_line(axes, ms, deflection, label=case.label.removeprefix("step of "), **style)
        mark_end(axes, run, ms, deflection)
    finish_axes(compliance, "frequency [Hz]", "x1 over F_x [µm/N]", legend=2)
    finish_axes(radial, "time [ms]", f"{plant.outputs[0].name} [µm]", legend=3)
    finish_axes(axial, "time [ms]", f"{plant.stroke.name} [mm]", legend=2)
    finish_axes(vibration, "time [ms]", f"{plant.outputs[1].name} [µm]", legend=1)
    return figure


def faults_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The largest radial deviation after each fault against the clearance, and the four worst over time."""
    edge = clearance(e.run.plant) * 1e6
    survived = f"{e.merits[0].value:.0f} of {len(e.cases)} survived"
    during = "stroke" if e.run.scenario.reference is not hold else "hold"
    figure = new_page(runs_of(e), f"faults during a {during}", survived, left=0.245, wspace=0.24, top=0.835)
    dots, traces = figure.subplots(1, 2, width_ratios=(1, 1.25))
    down, deviations = (
        [ended_early(run) for run in runs_of(e)],
        [case.merits[0].value * 1e6 for case in e.cases],
    )
    texts = [
        _touchdown_text(case.merits[1]) if touched else f"{number(deviation, 2)} µm"
        for case, touched, deviation in zip(e.cases, down, deviations, strict=True)
    ]
    marks = [CROSS if touched else DOT for touched in down]
    draw_dots(dots, [micro(case.label) for case in e.cases], deviations, texts, marks)
    dots.set_xlim(min(0.1, 0.5 * min(deviations)), 2 * edge)
    dots.axvline(edge, **BOUND_STYLE)
    label_upright(dots, 1.1 * edge, 0.62, "touchdown bearing", ha="left")
    struck = e.run.scenario.faults[0].at
    traces.set_xlim(-20, (e.run.scenario.duration - struck) * 1e3)
    worst = sorted(e.cases, key=lambda case: -case.merits[0].value)[: len(STYLES)]
    for case, style in zip(worst, STYLES, strict=False):
        run, last = case.run, end_of(case.run) + 1
        ms = (run.t[:last] - struck) * 1e3
        deviation = np.maximum(np.abs(run.p[:last, :4]).max(axis=1) * 1e6, 1e-3)
        draw_largest(traces, ms, deviation, label=micro(case.label), **style)
        mark_end(traces, run, ms, deviation, named=False)
    traces.set_yscale("log")
    traces.set_ylim(bottom=0.1)
    draw_bound(traces, edge, "touchdown bearing")
    finish_axes(dots, "largest radial deviation [µm]", "")
    finish_axes(
        traces, "time after the fault [ms]", "radial deviation of the worst [µm]", legend=2, side="right"
    )
    return figure


def _touchdown_text(after: Merit) -> str:
    """When a fault led to a touchdown."""
    return f"touchdown after {after.phrase()}" if after.value >= 0 else "touchdown before it"


def _published_stroke(e: Experiment, published: Published | None) -> Figure:
    """`stroke_figure`, with published bounds only for the published stroke."""
    return stroke_figure(e.run, published if any(merit.published for merit in e.merits) else None)


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "stroke": _published_stroke,
    "hold": hold_figure,
    "tilt": tilt_figure,
    "lift-off": lift_off_figure,
    "payload": payload_figure,
    "disturbance": disturbance_figure,
    "faults": faults_figure,
    "commissioning": commissioning_figure,
    "supervised-faults": supervised_faults_figure,
}
