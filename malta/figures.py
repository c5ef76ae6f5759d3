"""Records -> figures, as a report has them. The only module that imports matplotlib, and only where it draws.

Every figure names the design and the fidelity behind it, and holds what the paper prints of the same experiment.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.data import in_unit, plant_of, published_value
from malta.errors import InputError
from malta.files import replace_files
from malta.references import hold
from malta.simulate import Trajectory, stroke_figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaign import Campaign
    from malta.experiments import Case, Experiment, Merit
    from malta.findings import Finding
    from malta.plant import FloatArray, Plant
    from malta.tune import Tuned

Published = Mapping[str, Any]  # a file of data/published/

STYLES: Sequence[dict[str, Any]] = (  # told apart without colour: by darkness and by dash
    {"color": "#000000", "linestyle": "-", "linewidth": 1.6},
    {"color": "#c1440e", "linestyle": "-", "linewidth": 1.4},
    {"color": "#1f77b4", "linestyle": (0, (5, 2)), "linewidth": 1.4},
    {"color": "#8a8a8a", "linestyle": (0, (1.5, 1.5)), "linewidth": 1.6},
)
MORE: Sequence[dict[str, Any]] = (  # after those
    {"color": "#000000", "linestyle": (0, (7, 2, 1.5, 2)), "linewidth": 1.4},
    {"color": "#c1440e", "linestyle": (0, (1.5, 1.5)), "linewidth": 1.6},
    {"color": "#1f77b4", "linestyle": (0, (9, 2, 1.5, 2, 1.5, 2)), "linewidth": 1.4},
    {"color": "#8a8a8a", "linestyle": "-", "linewidth": 1.2},
)
BOUND: dict[str, Any] = {"color": "#9a9a9a", "linestyle": (0, (8, 3)), "linewidth": 0.9}
NOTE: dict[str, Any] = {"fontsize": 8, "color": "#5a5a5a"}
DOT: dict[str, Any] = {"marker": "o", "markersize": 6, "linestyle": "none", "color": "#000000"}
CROSS: dict[str, Any] = DOT | {"marker": "X", "markersize": 9, "markeredgecolor": "#ffffff", "clip_on": False}
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8, "handlelength": 2.4, "columnspacing": 1.5}
POINTS = 3000  # of a line: more than a page resolves


def experiment_figure(e: Experiment, published: Published | None = None) -> Figure:
    """The figure of an experiment, beside what the paper prints of it."""
    if e.name not in FIGURES:
        raise InputError("figure", "experiment", repr(e.name), "one of " + ", ".join(FIGURES))
    return FIGURES[e.name](e, published)


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure as .png or .svg, whole or not at all; the same figure gives the same bytes."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    path = Path(path)
    if path.suffix not in (".png", ".svg"):
        raise InputError(path, "", f"suffix {path.suffix!r}", "one of .png, .svg")
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "malta", "svg.fonttype": "none"}):
        if path.suffix == ".svg":
            figure.savefig(buffer, format="svg", metadata={"Date": None})
        else:
            # Figure.savefig lays everything out in a draw of its own first, which only tight boxes need.
            canvas: Any = FigureCanvasAgg(figure)
            canvas.print_png(buffer, metadata={"Software": None}, pil_kwargs={"compress_level": 1})
    replace_files({path: buffer.getvalue()})
    return path


# --- one figure for each experiment ---


def stroke_figure(run: Trajectory, published: Published | None = None) -> Figure:
    """Axial position, tracking error, radial deviation, currents and thrust of a stroke. Figs 12 and 13."""
    plant, f, axis, ms = run.plant, stroke_figures(run), run.plant.stroke_output, run.t * 1e3
    first, last = run.scenario.reference(plant)(np.array([0, run.scenario.duration])).p[:, axis]
    errors = (
        f"axial error {f.axial_error * 1e3:.2f} mm, radial deviation {max(f.radial.values()) * 1e6:.1f} µm"
    )
    tracked = f"rise {number(f.rise * 1e3, 3)} ms, overshoot {f.overshoot * 100:.1f} %, "
    figure = _figure(
        [run],
        f"stroke of {(last - first) * 1e3:.3g} mm{_ending(run)}",
        (tracked if run.verdict.completed else "") + errors,
        right=0.925,
        hspace=0.24,
    )
    (position, radial), (error, current) = figure.subplots(2, 2, sharex=True)
    names = [s.name for s in plant.outputs]
    _line(position, ms, run.reference[:, axis] * 1e3, label="reference z*", **STYLES[2])
    _line(position, ms, run.p[:, axis] * 1e3, label="position z", **STYLES[0])
    _line(error, ms, (run.reference[:, axis] - run.p[:, axis]) * 1e3, **STYLES[0])
    for i, style in zip((k for k in range(len(names)) if k != axis), (1, 0, 3, 2), strict=False):
        _line(radial, ms, (run.p[:, i] - run.reference[:, i]) * 1e6, label=names[i], **STYLES[style])
    for name, style, i in _widest_currents(run):
        _line(current, ms, run.current[:, i], label=name, **STYLES[style])
    _published_bound(error, published, "figure_12.axial_error", "mm", both=True)
    _published_bound(radial, published, "figure_13.radial_deviation", "um", both=True)
    reached = np.array([first, last, run.p[:, axis].min(), run.p[:, axis].max()]) * 1e3
    margin = 0.05 * (reached.max() - reached.min())  # about the whole stroke, whatever became of it
    position.set_ylim(reached.min() - margin, reached.max() + margin)
    _finish(position, "", "axial position z [mm]", legend=2)
    _finish(radial, "", "radial deviation [µm]", legend=4)
    _finish(error, "time [ms]", "axial error z* - z [mm]")
    _finish(current, "time [ms]", "current per module [A]", legend=3)
    constant = plant_of(run.controller.parameters).actuator.force_constant[plant.thrust_input]
    thrust = current.secondary_yaxis("right", functions=(lambda i: i * constant, lambda f: f / constant))
    thrust.set_ylabel("thrust [N]")
    return figure


def _widest_currents(run: Trajectory) -> list[tuple[str, int, int]]:
    """The thrust current and the two bearing currents that carry the weight: label, style, index."""
    inputs = [s.name for s in run.plant.inputs]
    thrust = run.plant.thrust_input
    widest = np.argsort(-np.abs(run.v).max(axis=0), kind="stable")
    others = sorted(int(i) for i in widest[widest != thrust][:2])
    return [(inputs[i], style, i) for style, i in enumerate([thrust, *others])]


def hold_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Histograms of measured and true positions at rest, in bins of the sensors' resolution. Fig. 14, Table III."""
    from malta.experiments import RESTING  # here: a page of tables does not wait for it

    run, axis = e.run, e.run.plant.stroke_output
    names = [s.name for s in run.plant.outputs]
    y, p = run.y[-RESTING:] * 1e6, run.p[-RESTING:] * 1e6
    bins = [1e6 * (r or s / 3) or 1.0 for r, s in zip(run.plant.resolution, run.plant.noise, strict=True)]
    rms, widest = np.sqrt((p**2).mean(axis=0)), np.abs(y).max(axis=0)
    radial = [k for k in range(len(names)) if k != axis]
    figure = _figure(
        [run],
        f"{len(y)} samples at rest{_ending(run)}",
        "mean and standard deviation of what is measured above the bars; "
        f"true motion {number(rms[radial].max(), 2)} µm rms radially, {number(rms[axis], 2)} µm axially",
        wspace=0.33,
    )
    grid = figure.add_gridspec(2, 3)
    panels = [figure.add_subplot(grid[k % 2, k // 2] if k != axis else grid[:, 2]) for k in range(len(names))]
    labels = (
        f"measured, in bins of {bins[0]:.2g} µm ({names[axis]}: {bins[axis]:.2g} µm)",
        "true, in bins of a tenth",
    )
    spreads = [[("ours", float(y[:, k].mean()), float(y[:, k].std()))] for k in range(len(names))]
    if published is not None:
        for name, found in zip(names, spreads, strict=True):
            mean, std = (read_out(published, f"table_III.{what}.{name}", "um") for what in ("mean", "std"))
            found.append(("Table III", mean, std))
    for k, axes in enumerate(panels):
        reach = 1.4 * max(float(widest[k] if k == axis else widest[radial].max()), bins[k])
        told = [2.4 * (abs(mean) + std) for _, mean, std in spreads[k][1:]]
        _histogram(axes, (y[:, k], p[:, k]), labels, bins[k], max([min(reach, 60 * bins[k]), *told]))
        _finish(axes, f"{names[k]} [µm]", "share of samples [%]")
    highest = max(panels[k].dataLim.y1 for k in radial)
    for k, axes in enumerate(panels):
        _callipers(axes, spreads[k], float(axes.dataLim.y1) if k == axis else highest)
    _shared_legend(figure)
    return figure


def _histogram(
    axes: Axes, series: Sequence[FloatArray], labels: Sequence[str], bins: float, reach: float
) -> None:
    styles: tuple[dict[str, Any], ...] = (
        {"fill": True, "facecolor": "#d4d4d4", "edgecolor": "#8a8a8a", "linewidth": 0.8},
        {"edgecolor": "#000000", "linewidth": 1.2},
    )
    for values, label, width, style in zip(series, labels, (bins, bins / 10), styles, strict=True):
        count = math.ceil(reach / width)
        edges = (np.arange(-count, count + 2) - 0.5) * width
        axes.stairs(100 * np.histogram(values, edges)[0] / len(values), edges, label=label, **style)
    axes.set_xlim(-reach, reach)


def _callipers(axes: Axes, spreads: Sequence[tuple[str, float, float]], top: float) -> None:
    """Mean and standard deviation above the data."""
    for n, (label, mean, std) in enumerate(spreads):
        height = top * (1.26 - 0.13 * n)
        style = {"color": STYLES[n]["color"], "marker": "|", "markersize": 7}
        axes.plot([mean - std, mean, mean + std], 3 * [height], **style)
        where: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "va": "center"}
        axes.annotate(label, (0.03, height), **where, **NOTE)
        axes.annotate(f"{number(std, 3)} µm", (0.99, height), ha="right", **where, **NOTE)
    axes.set_ylim(0, 1.36 * top)


def tilt_figure(e: Experiment, published: Published | None = None) -> Figure:
    """The circle in sensor plane 1, what it leaves in sensor plane 2, and both over time. Fig. 16, eq. (21)."""
    figure = _figure(_runs(e), "circle in sensor plane 1, sensor plane 2 held", _told(e.cases, 0))
    (circle, tracking), (blow_up, deviation) = figure.subplots(2, 2, width_ratios=(1, 1.6))
    for case, style in zip(e.cases, STYLES, strict=False):
        run, error = case.run, (case.run.p - case.run.reference) * 1e6
        late = slice(len(error) // 2, None)
        circle.plot(run.p[late, 0] * 1e6, run.p[late, 1] * 1e6, label=case.label, **style)
        blow_up.plot(error[late, 2], error[late, 3], **style)
        for axes, k in ((tracking, 0), (deviation, 2)):
            distance = np.hypot(error[:, k], error[:, k + 1])
            _line(axes, run.t, distance, **style)
            _mark(axes, run, run.t, distance)
    asked = e.run.reference * 1e6
    circle.plot(
        asked[:, 0], asked[:, 1], label="reference", **STYLES[2] | {"color": "#000000", "linewidth": 0.9}
    )
    bound = 0.0
    if published is not None:
        bound, angle = read_out(published, "figure_16.deviation", "um"), np.linspace(0, 2 * math.pi, 181)
        blow_up.plot(bound * np.cos(angle), bound * np.sin(angle), **BOUND)
        blow_up.annotate("published bound", (0, -1.08 * bound), ha="center", va="top", **NOTE)
    for axes in (tracking, deviation):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.1)
    _published_bound(deviation, published, "figure_16.deviation", "um", where="below right")
    _square(circle)
    _square(blow_up, least=1.4 * bound)
    late_part = "second half" if any(map(_touched, _runs(e))) else "last period"
    _finish(circle, f"x1, {late_part} [µm]", "y1 [µm]")
    _finish(blow_up, f"x2, {late_part} [µm]", "y2 [µm]")
    _finish(tracking, "time [s]", "plane 1, off reference [µm]")
    _finish(deviation, "time [s]", "plane 2, off centre [µm]")
    _shared_legend(figure)
    return figure


def lift_off_figure(e: Experiment, _: Published | None = None) -> Figure:
    """From the touchdown bearing to the centre, and the bearing currents, for each start-up estimator."""
    plant, runs = e.run.plant, _runs(e)
    figure = _figure(runs, "lift-off from the touchdown bearing", _told(e.cases, 1), hspace=0.2)
    panels = figure.subplots(2, 2, sharex=True, sharey="row")
    for k, (height, current) in zip((1, 3), panels.T, strict=True):
        for case, style in zip(e.cases, STYLES, strict=False):
            ms, y = case.run.t * 1e3, case.run.p[:, k] * 1e6
            _line(height, ms, y, label=case.label, **style)
            _mark(height, case.run, ms, y)
            _line(current, ms, case.run.force[:, k] / plant.actuator.force_constant[k], **style)
        _bound(height, -clearance(plant) * 1e6, "touchdown bearing")
        _bound(current, e.merits[0].value, "lifts it by statics")
        _finish(height, "", f"{plant.outputs[k].name} [µm]")
        _finish(current, "time [ms]", f"current of {plant.inputs[k].name} [A]")
    moving = max(float(run.t[np.flatnonzero(np.abs(run.p[:, 1]) > 20e-6)].max(initial=0.0)) for run in runs)
    panels[0, 0].set_xlim(0, 1e3 * min(1.6 * moving, max(float(run.t[-1]) for run in runs)) or None)
    _shared_legend(figure)
    return figure


def payload_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Sag after the pick and the stroke that follows, for each mass; touchdowns are marked."""
    plant, runs = e.run.plant, _runs(e)
    figure = _figure(runs, "masses picked during a hold, then moved", _told(e.cases, 0))
    (sag, axial), (largest, radial) = figure.subplots(2, 2)
    t, picked = e.run.t, e.run.scenario.changes[0][0]
    begin = _half_way(e.run) - 0.05
    lowest = min((1, 3), key=lambda k: float(e.run.p[(t >= picked) & (t < begin), k].min(initial=0.0)))
    sag.set_xlim(-20, (begin - picked) * 1e3)
    for axes in (axial, radial):
        axes.set_xlim(0, (e.run.scenario.duration - begin) * 1e3)
    masses = [(run.scenario.changes[0][1]["m"] - plant.mass) * 1e3 for run in runs]
    for case, mass, style in zip(e.cases, masses, cycle((*STYLES, *MORE))):
        run, y = case.run, case.run.p[:, lowest] * 1e6
        last = int(np.searchsorted(run.t, begin))
        shown = slice(0, min(last, _end(run) + 1))
        _line(sag, (run.t[shown] - picked) * 1e3, y[shown], label=case.label, **style)
        _mark(sag, run, (run.t - picked) * 1e3, y)
        largest.plot(mass, case.merits[0].value * 1e6, **(CROSS if _touched(run) else DOT))
        if not _touched(run):
            ms, error = (run.t[last:] - begin) * 1e3, (run.reference - run.p)[last:]
            _line(axial, ms, error[:, plant.stroke_output] * 1e3, **style)
            _line(radial, ms, np.abs(error[:, :4]).max(axis=1) * 1e6, **style)
    if all(map(_touched, runs)):
        axial.annotate("none is carried", (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
    _bound(sag, -clearance(plant) * 1e6, "touchdown bearing")
    _bound(largest, clearance(plant) * 1e6, "touchdown bearing", where="above left")
    if published is not None:
        payload = read_out(published, "position_controller.payload", "kg") * 1e3
        largest.axvline(payload, **BOUND)
        _upright(largest, payload, 0.26, "published payload", ha="right")
    _published_bound(axial, published, "figure_12.axial_error", "mm", EMPTY, both=True, where="above left")
    _published_bound(radial, published, "figure_13.radial_deviation", "um", EMPTY, where="above left")
    _finish(sag, "time after the pick [ms]", f"sag {plant.outputs[lowest].name} [µm]")
    _finish(largest, "picked mass [g]", "largest sag [µm]")
    largest.set(xlim=(0, 1.1 * max(masses)), ylim=(0, None))
    radial.set_ylim(0, None)
    _finish(axial, "time of the stroke [ms]", "axial error z* - z [mm]")
    _finish(radial, "time of the stroke [ms]", "largest radial deviation [µm]")
    _shared_legend(figure)
    return figure


EMPTY = "published, empty"  # the paper's bounds are of a stroke without payload


def _half_way(run: Trajectory) -> float:
    """When the reference of the stroke axis is fastest, s; of the whole scenario."""
    t = np.arange(0, run.scenario.duration, run.controller.sample_time)
    return float(t[np.abs(run.scenario.reference(run.plant)(t).dp[:, run.plant.stroke_output]).argmax()])


def thermal_figure(e: Experiment, published: Published | None = None) -> Figure:
    """The drift of the support, and the mover's place in space with and without the outer loop. Fig. 15."""
    _, now, true = (said(merit) for merit in e.merits)
    found = f"{_told(e.cases, 0)}; lag {now}, at true speed {true}"
    figure = _figure(_runs(e), "support drifts by thermal expansion", found, hspace=0.18)
    space, blow_up = figure.subplots(2, 1, sharex=True)
    t, drift = e.run.t, e.curves["drift"]
    _line(space, t, drift * 1e6, label="drift of the support", color="#cfcfcf", linewidth=6)
    for case, style in zip(e.cases, STYLES, strict=False):
        size = min(len(t), len(case.run.t))
        place = (case.run.p[:size, 2] + drift[:size]) * 1e6
        _line(space, t[:size], place, label=f"mover in space, {case.label}", **style)
        _mark(space, case.run, t[:size], place)
        if case is e.cases[0]:
            _line(blow_up, t, place, **style | {"linewidth": 0.8})
    read = ("figure_14.resolution", "um", "published resolution of the sensors")
    _published_bound(blow_up, published, *read, both=True, where="under right")
    _finish(space, "", "x2 in space [µm]")
    _finish(blow_up, "simulated time [s]", f"{e.cases[0].label}, enlarged [µm]")
    _shared_legend(figure)
    return figure


def disturbance_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Compliance over frequency with simulated points, and the responses to steps and to vibration."""
    plant, c = e.run.plant, e.curves
    worst, at, stiffness = (said(merit) for merit in e.merits)
    found = f"largest compliance {worst} at {at}, smallest dynamic stiffness {stiffness}"
    figure = _figure(_runs(e), "forces and torques on the mover", found, hspace=0.44)
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
            _line(vibration, ms[late], run.p[late, 1] * 1e6, label=case.label, **STYLES[0])
            continue
        if "F_z" in case.label:
            axes, deflection, style = axial, run.p[:, plant.stroke_output] * 1e3, STYLES[0]
        else:
            axes, deflection, style = radial, run.p[:, 0] * 1e6, next(sideways)
        _line(axes, ms, deflection, label=case.label.removeprefix("step of "), **style)
        _mark(axes, run, ms, deflection)
    _finish(compliance, "frequency [Hz]", "x1 over F_x [µm/N]", legend=2)
    _finish(radial, "time [ms]", f"{plant.outputs[0].name} [µm]", legend=3)
    _finish(axial, "time [ms]", f"{plant.stroke} [mm]", legend=2)
    _finish(vibration, "time [ms]", f"{plant.outputs[1].name} [µm]", legend=1)
    return figure


def faults_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The largest radial deviation after each fault against the clearance, and the four worst over time."""
    edge = clearance(e.run.plant) * 1e6
    survived = f"{e.merits[0].value:.0f} of {len(e.cases)} survived"
    during = "stroke" if e.run.scenario.reference is not hold else "hold"
    figure = _figure(_runs(e), f"faults during a {during}", survived, left=0.245, wspace=0.24)
    bars, traces = figure.subplots(1, 2, width_ratios=(1, 1.25))
    for place, case in enumerate(e.cases):
        down, deviation = _touched(case.run), case.merits[0].value * 1e6
        bars.barh(place, deviation, height=0.62, color="#2b2b2b" if down else "#c9c9c9")
        text = _when(case.merits[1]) if down else f"{number(deviation, 2)} µm"
        inside = deviation > edge / 10
        style = NOTE | {"color": "#ffffff" if down else NOTE["color"], "ha": "right" if inside else "left"}
        bars.annotate(text, (deviation * (0.88 if inside else 1.1), place), va="center", **style)
    bars.set_yticks(range(len(e.cases)), [_micro(case.label) for case in e.cases], fontsize=9)
    bars.invert_yaxis()
    bars.set_xscale("log")
    bars.set_xlim(0.1, 2 * edge)
    bars.axvline(edge, **BOUND)
    _upright(bars, 1.1 * edge, 0.02, "touchdown bearing", ha="left")
    struck = e.run.scenario.faults[0].at
    traces.set_xlim(-20, (e.run.scenario.duration - struck) * 1e3)
    worst = sorted(e.cases, key=lambda case: -case.merits[0].value)[: len(STYLES)]
    for case, style in zip(worst, STYLES, strict=False):
        run, last = case.run, _end(case.run) + 1
        ms = (run.t[:last] - struck) * 1e3
        deviation = np.maximum(np.abs(run.p[:last, :4]).max(axis=1) * 1e6, 1e-3)
        _line(traces, ms, deviation, label=_micro(case.label), **style)
        _mark(traces, run, ms, deviation, named=False)
    traces.set_yscale("log")
    traces.set_ylim(bottom=0.1)
    _bound(traces, edge, "touchdown bearing")
    _finish(bars, "largest radial deviation [µm]", "")
    _finish(traces, "time after the fault [ms]", "radial deviation of the worst [µm]", legend=2, side="right")
    return figure


def _when(after: Merit) -> str:
    return f"touchdown after {said(after)}" if after.value >= 0 else "touchdown before it"


def drive_limits_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Position, speed, current and voltage of the fastest stroke and of the sigmoid, against the limits."""
    plant, actuator = e.run.plant, e.run.plant.actuator
    what = "fastest stroke, and sigmoid of the same peak current"
    what += "".join(f", {case.label}{_ending(case.run)}" for case in e.cases if _ending(case.run))
    figure = _figure(_runs(e), what, _told(e.cases, 1), hspace=0.2)
    (position, current), (speed, voltage) = figure.subplots(2, 2, sharex=True)
    half = 0.75e3 * e.cases[-1].merits[1].value
    position.set_xlim(-half, half)
    thrust, rate = _thrust_axis(plant), len(plant.states) // 2 + plant.stroke_state
    for case, style in zip(e.cases, STYLES, strict=False):
        run, ms = case.run, (case.run.t - case.run.scenario.duration / 2) * 1e3
        _line(position, ms, run.p[:, plant.stroke_output] * 1e3, label=case.label, **style)
        _mark(position, run, ms, run.p[:, plant.stroke_output] * 1e3)
        _line(speed, ms, run.x[:, rate], **style)
        _line(current, ms, run.axis_currents[:, thrust], **style)
        if run.u.size:
            _line(voltage, ms, run.u[:, thrust], **style)
    if not e.run.u.size:
        note = f"none at fidelity {e.run.scenario.fidelity}"
        voltage.annotate(note, (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
    for axes, merit, limit in (
        (current, e.merits[0], actuator.current_limit),
        (voltage, e.merits[1], actuator.voltage_limit),
    ):
        _bound(axes, merit.value, "for the reference", both=True, where="below left")
        _bound(axes, limit, "limit of the drive", both=True, where="above left")
    _finish(position, "", "position z [mm]")
    _finish(current, "", "current per module [A]")
    _finish(speed, "time from half-way [ms]", "speed [m/s]")
    _finish(voltage, "time from half-way [ms]", "voltage per module [V]")
    _shared_legend(figure)
    return figure


def _thrust_axis(plant: Plant) -> int:
    """The first axis that carries the thrust current."""
    unit = np.zeros(len(plant.inputs))
    unit[plant.thrust_input] = 1.0
    return int(np.flatnonzero(np.array(ca.DM(plant.drive.command(ca.DM(unit)))))[0])


def _published_stroke(e: Experiment, published: Published | None) -> Figure:
    """Bounds only where the paper shows this very stroke."""
    return stroke_figure(e.run, published if any(merit.published for merit in e.merits) else None)


def run_figure(e: Experiment, _: Published | None = None) -> Figure:
    """One run: how far it is off its reference, its forces, and the way to what it could touch."""
    run, ms, axis = e.run, e.run.t * 1e3, e.run.plant.stroke_output
    names, error = [s.name for s in run.plant.outputs], run.p - run.reference
    radial = [k for k in range(len(names)) if k != axis]
    furthest = f"furthest off its reference: {number(np.abs(error[:, radial]).max() * 1e6, 3)} µm radially, "
    size, unit = (1e6, "µm") if np.abs(error[:, axis]).max() < 0.1e-3 else (1e3, "mm")
    furthest += f"{number(np.abs(error[:, axis]).max() * size, 3)} {unit} axially"
    figure = _figure([run], f"{_micro(e.question)}{_ending(run)}", furthest, hspace=0.24)
    (planes, forces), (stroke, ways) = figure.subplots(2, 2, sharex=True)
    for k, style in zip(radial, (1, 0, 3, 2), strict=False):
        _line(planes, ms, error[:, k] * 1e6, label=names[k], **STYLES[style])
    _line(stroke, ms, error[:, axis] * size, **STYLES[0])
    for name, style, k in _widest_currents(run):
        _line(forces, ms, run.v[:, k], label=name, **STYLES[style])
    for k, name in enumerate(run.plant.contacts):
        way = np.maximum(run.contact[:, k] * 100, 1e-3)
        _line(ways, ms, way, label=name.removeprefix("touchdown at sensor "), **STYLES[k % len(STYLES)])
    ways.set_yscale("log")
    ways.set_ylim(bottom=0.01)
    _bound(ways, 100, "touched")
    _finish(planes, "", "radial, off reference [µm]", legend=4)
    _finish(forces, "", "commanded force [N]", legend=3)
    _finish(stroke, "time [ms]", f"{names[axis]}, off reference [{unit}]")
    _finish(ways, "time [ms]", "clearance used up [%]", legend=3, side="right")
    return figure


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "stroke": _published_stroke,
    "hold": hold_figure,
    "tilt": tilt_figure,
    "lift-off": lift_off_figure,
    "payload": payload_figure,
    "thermal": thermal_figure,
    "disturbance": disturbance_figure,
    "faults": faults_figure,
    "drive-limits": drive_limits_figure,
    "run": run_figure,
}


# --- figures of a campaign ---

FINE: Mapping[str, dict[str, Any]] = {  # how runs end, the best first, light to dark; what is touched follows
    "within the published bounds": {"facecolor": "#f0f0f0"},
    "completed": {"facecolor": "#d0d0d0"},
    "completed, commands limited": {"facecolor": "#d0d0d0", "hatch": "////"},
    "diverged": {"facecolor": "#c1440e"},
    "not lifted": {"facecolor": "#909090", "hatch": ".."},
}
TOUCHES: Sequence[dict[str, Any]] = (
    {"facecolor": "#202020"},
    {"facecolor": "#6a6a6a"},
    {"facecolor": "#202020", "hatch": "xx"},
)
BINS = 40  # of a distribution


def distributions_figure(found: Campaign, published: Published | None = None) -> Figure:
    """How the figures of merit of the completed runs are distributed, with the published bounds."""
    from malta.findings import figures_of

    panels: dict[str, list[Finding]] = {}  # what is of a kind goes into one
    for listed in figures_of(found, published):
        panels.setdefault(listed.kind, []).append(listed)
    figure = _campaign_figure(found, "figures of merit of the completed runs", hspace=0.44, wspace=0.28)
    for axes, (kind, group) in zip(figure.subplots(2, 3).ravel(), panels.items(), strict=False):
        _distribution(axes, kind, group)
    return figure


def _distribution(axes: Axes, kind: str, listed: Sequence[Finding]) -> None:
    """Histograms of figures of one kind, on a logarithmic axis where they reach over decades."""
    unit = listed[0].unit
    series = [in_unit(1.0, unit) * f.values[np.isfinite(f.values)] for f in listed]
    bound = in_unit(listed[0].published, unit)
    every = np.concatenate(series)
    told = "%" if unit == "percent" else _micro(unit)
    _finish(axes, f"{kind} [{told}]", "share of runs [%]")
    if not every.size:
        axes.annotate("no run completed", (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
        return
    low, high = float(every.min()), float(every.max())
    if math.isfinite(bound):
        low, high = min(low, bound), max(high, bound)
    logarithmic = low > 0 and high > 30 * low
    room = 0.04 * (high - low) or 0.05 * abs(high) or 1.0
    edges = (
        np.geomspace(low / 1.1, high * 1.1, BINS + 1)
        if logarithmic
        else np.linspace(max(low - room, 0.0) if low >= 0 else low - room, high + room, BINS + 1)
    )
    for f, values, style in zip(listed, series, (1, 0, 3, 2), strict=False):
        share = 100 * np.histogram(values, edges)[0] / max(len(values), 1)
        line = {"color": STYLES[0]["color"], "linewidth": 1.2} if len(listed) == 1 else STYLES[style]
        if len(listed) == 1:
            axes.stairs(share, edges, fill=True, facecolor="#d4d4d4")
        axes.stairs(share, edges, label=f.label.removeprefix(f"{kind} ") if len(listed) > 1 else None, **line)
    if logarithmic:
        axes.set_xscale("log")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(0, None)
    if math.isfinite(bound):
        axes.axvline(bound, **BOUND)
        text = "published" if listed[0].relation == "about" else "published bound"
        axes.annotate(
            text, (bound, 1.01), xycoords=("data", "axes fraction"), ha="center", va="bottom", **NOTE
        )
    if len(listed) > 1:
        where: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1.06), "borderaxespad": 0.2}
        axes.legend(ncols=len(listed), **where, **LEGEND)


def yield_figure(found: Campaign, published: Published | None = None) -> Figure:
    """How runs end over each parameter that was varied, the others wherever they were drawn."""
    from malta.findings import kept
    from malta.many import verdicts

    names = [name for k, name in enumerate(found.names) if len(set(found.values[:, k])) > 1]
    shown = names[:9]
    limited = found.batch.saturated.max(axis=1, initial=0.0) > 0
    within = kept(found, published)
    known = verdicts(found.plan.plant)
    band = np.array(known, dtype=object)[found.batch.verdict.astype(int)]
    band[found.completed & limited] = "completed, commands limited"
    if within is not None:
        band[within] = "within the published bounds"
    columns = min(3, max(1, len(shown))) if len(shown) != 4 else 2
    rows = max(1, -(-len(shown) // columns))
    more = f", {len(shown)} of {len(names)} shown" if len(shown) < len(names) else ""
    figure = _campaign_figure(found, f"how runs end over the parameters{more}", hspace=0.5, top=0.8)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for axes, name in zip(panels, shown, strict=False):
        _bands(axes, found, name, band)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    for axes in panels[: len(shown) : columns]:
        axes.set_ylabel("share of runs [%]")
    handles, labels = _entries(list(panels))
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.91)}
    if handles:
        figure.legend(handles, labels, ncols=min(4, len(labels)), **where, **LEGEND)
    return figure


def _bands(axes: Axes, found: Campaign, name: str, band: Any) -> None:
    """Shares of the ways in which runs end, stacked, in bins of one parameter."""
    from malta.findings import unit_of

    unit = unit_of(found.plan, name)
    values = found.values[:, found.names.index(name)] * in_unit(1.0, unit)
    edges = np.linspace(values.min(), values.max(), 11 if len(values) >= 200 else 6)
    total = np.histogram(values, edges)[0]
    base = np.zeros(len(total))
    styles = dict(FINE) | dict(zip(found.plan.plant.contacts, cycle(TOUCHES)))
    for label, style in styles.items():
        if not (band == label).any():
            continue
        share = 100 * np.histogram(values[band == label], edges)[0] / np.maximum(total, 1)
        axes.bar(
            edges[:-1],
            share,
            np.diff(edges),
            base,
            align="edge",
            label=label,
            edgecolor="#ffffff",
            linewidth=0.6,
            **style,
        )
        base += share
    _finish(axes, f"{name} [{'%' if unit == 'percent' else _micro(unit)}]", "")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(0, 100)


def worst_figure(found: Campaign, published: Published | None = None) -> Figure:
    """The worst runs: where in the box their machines lie, and how far off the reference they went."""
    from malta.findings import half_text, is_published, worst_of

    plan, plant = found.plan, found.plan.plant
    rows = worst_of(found, len(STYLES) + len(MORE))
    figure = _campaign_figure(found, "the worst runs and their machines", wspace=0.34, top=0.84, bottom=0.13)
    box, far = figure.subplots(1, 2, width_ratios=(1.7, 1))
    at = np.arange(len(found.names))
    middle = np.array([getattr(plan.parameters, n) if n in plan.spread else 0.0 for n in found.names])
    half = np.array(
        [
            getattr(plan.parameters, n) * plan.spread[n] if n in plan.spread else plan.sensor_spread[n]
            for n in found.names
        ]
    )
    radial = [k for k in range(len(plant.outputs)) if k != plant.stroke_output]
    for place, (row, style) in enumerate(zip(rows, (*STYLES, *MORE), strict=False)):
        where = 100 * (found.values[row] - middle) / np.where(half == 0, 1, half)
        box.plot(at, where, marker="o", markersize=4, **style)
        off = float(found.batch.deviation[row, radial].max()) * 1e6
        far.plot([1e-3, off], [place, place], **style)
        far.plot(
            off,
            place,
            marker="o" if found.completed[row] else "X",
            markersize=7,
            color=style["color"],
            clip_on=False,
        )
    spreads = [half_text(found.plan, name) for name in found.names]
    box.set_xticks(at, [f"{n}\n{s}" for n, s in zip(found.names, spreads, strict=True)], fontsize=9)
    box.set_yticks([-100, -50, 0, 50, 100])
    far.set_yticks(range(len(rows)), [_ended(found, row) for row in rows], fontsize=8)
    far.invert_yaxis()
    edge, offs = clearance(plant) * 1e6, found.batch.deviation[rows][:, radial] * 1e6
    far.set_xscale("log")
    least = float(offs.max(axis=1).min()) if len(rows) else 1.0
    bounds = [edge]
    if published is not None and is_published(plan):
        bounds.append(read_out(published, "figure_13.radial_deviation", "um"))
    far.set_xlim(min([least, *bounds]) / 2, 1.6 * max([float(offs.max()) if len(rows) else 1.0, *bounds]))
    for value, text in zip(bounds, ("clearance", "published bound"), strict=False):
        far.axvline(value, **BOUND)
        far.annotate(
            text, (value, 1.01), xycoords=("data", "axes fraction"), ha="center", va="bottom", **NOTE
        )
    _finish(box, "", "place in the box [% of half its width]")
    _finish(far, "largest radial deviation [µm]", "")
    box.set_xlim(-0.3, len(at) - 0.7)
    box.set_ylim(-108, 108)
    return figure


def _campaign_figure(found: Campaign, what: str, **places: float) -> Figure:
    """A figure that says of which campaign it is, and its yield."""
    from matplotlib.figure import Figure

    from malta.plan import wanted_of

    plan, share = found.plan, found.rate
    figure = Figure(figsize=(9.0, 6.0), dpi=120)
    usual = {"left": 0.085, "right": 0.98, "bottom": 0.085, "top": 0.86, "wspace": 0.25, "hspace": 0.3}
    figure.subplots_adjust(**usual | places)
    wanted = wanted_of(plan)
    flown = plan.scenario if wanted.label == plan.scenario else f"{plan.scenario} ({wanted.label})"
    title = f"{plan.controller.name}, {flown}, fidelity {wanted.scenario.fidelity}: {what}"
    figure.suptitle(title, fontsize=11, y=0.985)
    text = f"{share.passed} of {share.runs} runs completed: {100 * share.share:.4g} % "
    text += f"(95 %: {100 * share.low:.4g} to {100 * share.high:.4g} %)"
    figure.text(0.5, 0.945, text, fontsize=9, color="#4a4a4a", ha="center", va="top")
    return figure


def _ended(found: Campaign, row: int) -> str:
    """A run by its number, and what ended it."""
    from malta.many import verdicts

    name = verdicts(found.plan.plant)[int(found.batch.verdict[row])]
    text = f"run {found.index[row]}"
    return text if name == "completed" else f"{text}\n{name.replace(' at ', chr(10) + 'at ')}"


def front_figure(tuned: Tuned) -> Figure:
    """Noise of the forces and motion against the proven margin: what the search found, and what it took."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    asked, chosen, front = tuned.spec.specification, tuned.trial, tuned.front
    figure = Figure(figsize=(9.0, 4.6), dpi=120)
    figure.subplots_adjust(left=0.1, right=0.98, bottom=0.115, top=0.8, wspace=0.25)
    taken = next((one for one in front if one.values == chosen.values), chosen)
    others = [one for one in front if one is not taken] or [taken]
    found = f"{tuned.trials} trials; taken: margin {100 * taken.figures['margin']:.0f} %, which keeps a reserve in all"
    figure.suptitle(f"{tuned.spec.name}: margin against noise", fontsize=11, y=0.985)
    figure.text(0.5, 0.925, found, fontsize=9, color="#4a4a4a", ha="center", va="top")
    margins = [100 * one.figures["margin"] for one in others]
    panels: Any = figure.subplots(1, 2)
    sides = (
        (("force_noise", "bearing force", 1.0, 0), ("thrust_noise", "thrust", 1.0, 2)),
        (("radial_motion", "radial", 1e6, 0), ("axial_motion", "axial", 1e6, 2)),
    )
    for axes, lines, y in zip(
        panels, sides, ("noise of the force [N rms]", "true motion [µm rms]"), strict=True
    ):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
        for name, label, scale, style in lines:
            if not all(name in one.figures for one in front):
                continue
            sizes = [scale * one.figures[name] for one in others]
            axes.plot(margins, sizes, marker="o", markersize=4, label=label, **STYLES[style])
            where = 100 * taken.figures["margin"], scale * taken.figures[name]
            ring = {"markersize": 9, "markerfacecolor": "none", "markeredgecolor": STYLES[style]["color"]}
            axes.plot(*where, **DOT | ring)
        if asked.margin is not None:
            axes.axvline(100 * asked.margin, **BOUND)
        _finish(axes, "robust margin over the travel, proven [% of the box]", y, legend=2)
        axes.margins(x=0.04)
    return figure


# --- what figures are made of ---


def _runs(e: Experiment) -> list[Trajectory]:
    return [case.run for case in e.cases]


def _figure(runs: Sequence[Trajectory], what: str, found: str, **places: float) -> Figure:
    """A figure that says which design and fidelity drew it, and what was found."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), dpi=120)
    usual = {"left": 0.085, "right": 0.98, "bottom": 0.085, "top": 0.86, "wspace": 0.25, "hspace": 0.3}
    figure.subplots_adjust(**usual | places)
    fidelities = " and ".join(dict.fromkeys(run.scenario.fidelity for run in runs))
    figure.suptitle(f"{runs[0].controller.name}, fidelity {fidelities}: {what}", fontsize=11, y=0.985)
    figure.text(0.5, 0.945, found, fontsize=9, color="#4a4a4a", ha="center", va="top")
    return figure


def _ending(run: Trajectory) -> str:
    """How a run ended, if not completed."""
    end = run.verdict
    return "" if end.completed else f" ({end.name} at {end.time * 1e3:.0f} ms)"


def _line(axes: Axes, t: FloatArray, values: FloatArray, **style: Any) -> None:
    """A line; of more samples than the page resolves, the least and the greatest of each stretch."""
    size = math.ceil(2 * len(t) / POINTS)
    if size > 2:
        first = np.arange(0, len(t) - size + 1, size)
        stretches = values[: len(first) * size].reshape(-1, size)
        peaks = np.column_stack([stretches.argmin(axis=1), stretches.argmax(axis=1)]) + first[:, None]
        kept = np.unique([0, *peaks.ravel(), len(t) - 1])
        t, values = t[kept], values[kept]
    axes.plot(t, values, **style)


def _mark(axes: Axes, run: Trajectory, t: FloatArray, values: FloatArray, *, named: bool = True) -> None:
    """A cross where the run touched something; `named` in the legend."""
    if _touched(run):
        k = min(_end(run), len(t) - 1)
        low, high = axes.get_xlim()
        if not (axes.get_autoscalex_on() or low <= t[k] <= high):
            return
        label = TOUCHED if run.verdict.name.startswith(TOUCHED) else run.verdict.name
        axes.plot(t[k], values[k], **CROSS | ({"label": label} if named else {}))


TOUCHED = "touchdown"


def _touched(run: Trajectory) -> bool:
    """Whether something ended the run, other than time and Ctrl-C."""
    return run.verdict.name not in ("completed", "interrupted")


def _end(run: Trajectory) -> int:
    """The sample of the verdict."""
    return min(int(np.searchsorted(run.t, run.verdict.time)), len(run.t) - 1)


def _published_bound(
    axes: Axes,
    published: Published | None,
    key: str,
    unit: str,
    text: str = "published bound",
    **drawn: Any,
) -> None:
    if published is not None:
        _bound(axes, read_out(published, key, unit), text, **drawn)


def _bound(axes: Axes, value: float, text: str, *, both: bool = False, where: str = "above right") -> None:
    """A line at a value, or at both signs; the axes reach beyond it.

    where : of its name: above, below, or under the lower line of both; left or right
    """
    lines = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]
    reach = max((float(np.abs(y[np.isfinite(y)]).max(initial=0.0)) for y in lines), default=0.0)
    for sign in (-1, 1) if both else (1,):
        axes.axhline(sign * value, **BOUND)
    height, side = where.split()
    axes.annotate(
        text,
        ({"left": 0.015, "right": 0.985}[side], -value if height == "under" else value),
        xycoords=("axes fraction", "data"),
        xytext=(0, 1.5 if height == "above" else -1.5),
        textcoords="offset points",
        ha=side,
        va="bottom" if height == "above" else "top",
        **NOTE,
    )
    room = max(1.25 * abs(value), 1.1 * reach)
    if both:
        axes.set_ylim(-room, room)
    elif axes.get_yscale() == "log":
        axes.set_ylim(top=max(2.5 * abs(value), 1.5 * reach))
    elif value > 0:
        axes.set_ylim(top=room)


def _upright(axes: Axes, x: float, height: float, text: str, *, ha: str) -> None:
    """A name along an upright line, from a share of the axes' height."""
    where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "rotation": 90, "va": "bottom", "ha": ha}
    axes.annotate(text, (x, height), **where, **NOTE)


def _square(axes: Axes, *, least: float = 0.0) -> None:
    """Equal axes about the centre that hold all that is drawn, and at least so much."""
    from matplotlib.ticker import MaxNLocator

    box = axes.dataLim
    reach = max(least, 1.1 * max(abs(edge) for edge in (box.x0, box.x1, box.y0, box.y1)))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_box_aspect(1)
    axes.tick_params(labelsize=8)
    for side in (axes.xaxis, axes.yaxis):
        side.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def plain(axes: Axes) -> None:
    """A light grid behind the data, no frame on the far sides."""
    axes.grid(color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)
    for edge in ("top", "right"):
        axes.spines[edge].set_visible(False)


def _finish(axes: Axes, x: str, y: str, *, legend: int = 0, side: str = "left") -> None:
    """Labels, grid, and a legend of so many columns above the axes, where it covers no data."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    plain(axes)
    axes.margins(x=0)
    if legend:
        where: dict[str, Any] = {"loc": f"lower {side}", "bbox_to_anchor": ({"left": 0, "right": 1}[side], 1)}
        handles, labels = _entries([axes])
        axes.legend(handles, labels, ncols=legend, borderaxespad=0.2, **where, **LEGEND)


def _shared_legend(figure: Figure) -> None:
    """One legend for all panels, below the title."""
    handles, labels = _entries(figure.axes)
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.925)}
    figure.legend(handles, labels, ncols=len(labels), **where, **LEGEND)


def _entries(panels: Sequence[Axes]) -> tuple[list[Any], list[str]]:
    """Handles and labels, each label once, crosses last."""
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    labels = sorted(found, key=lambda label: getattr(found[label], "get_marker", str)() == CROSS["marker"])
    return [found[label] for label in labels], labels


def clearance(plant: Plant) -> float:
    """Radial way to the touchdown bearing, m."""
    way = 1e-6
    share = ca.evalf(plant.contact(ca.SX(ca.DM(plant.at(**{plant.states[0].name: way}).x))))
    return way / float(share[0])


# --- numbers ---


def read_out(published: Published, key: str, unit: str) -> float:
    """A published quantity in the unit to show it in."""
    return in_unit(published_value(published, key), unit)


def number(value: float, digits: int = 4) -> str:
    """A number in so many digits, without exponent; "-" for NaN."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else f"{value}"
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else 0
    text = f"{value:.{min(max(decimals, 0), digits + 1)}f}"
    return text if float(text) else "0"


def said(merit: Merit, digits: int = 3) -> str:
    """A figure of merit in its unit, as a sentence has it."""
    unit = {"percent": " %", "1": ""}.get(merit.unit, f" {_micro(merit.unit)}")
    return number(in_unit(merit.value, merit.unit), digits) + unit


def _told(cases: Sequence[Case], which: int) -> str:
    """One merit of every case, in a line."""
    found = ", ".join(f"{case.label} {said(case.merits[which])}" for case in cases)
    return _micro(f"{cases[0].merits[which].label.replace(': ', ', ')}: {found}")


def _micro(text: str) -> str:
    """um as µm."""
    return re.sub(r"\bu(?=[msANV]\b)", "µ", text)
