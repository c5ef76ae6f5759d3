"""Figures of commissioning by the supervisor, and of faults with and without it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.firmware.supervisor import MONITORS, STATES
from malta.machines.tubular.experiments.commissioning import SUFFIX
from malta.machines.tubular.experiments.faults import FaultOutcome
from malta.report.figures.drawing import (
    CROSS,
    NOTE,
    REFERENCE,
    STYLES,
    Published,
    add_shared_legend,
    clearance,
    draw_bound,
    draw_largest,
    draw_line,
    ended_early,
    finish_axes,
    micro,
    new_page,
    number,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.simulation.experiments import Experiment


def commissioning_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Heights, stroke, deviation from the reference and forces, with the states of the supervisor."""
    run, ms = e.run, e.run.t * 1e3
    plant, state = run.plant, e.curves["state"]
    flying = (state >= list(STATES).index("LIFT")) & (state <= list(STATES).index("LANDING"))
    followed = np.where(flying[:, None], e.curves["followed"], np.nan)
    shown = (e.merits[1], e.merits[3], e.merits[5])
    found = ", ".join(f"{merit.label} {merit.phrase()}" for merit in shown)
    places = {"size": (9.0, 9.6), "hspace": 0.28, "top": 0.885}
    figure = new_page([run], "commissioning by the supervisor", found, **places)
    (height, error), (stroke, thrust), *others = figure.subplots(4, 2, sharex=True)
    axis = plant.stroke_output
    draw_line(height, ms, followed[:, 1] * 1e6, label="reference that is followed", **REFERENCE)
    for k, style in zip((1, 3), STYLES, strict=False):
        draw_line(height, ms, run.p[:, k] * 1e6, label=plant.outputs[k].name, **style)
    draw_line(stroke, ms, followed[:, axis] * 1e3, **REFERENCE)
    draw_line(stroke, ms, run.p[:, axis] * 1e3, **STYLES[0])
    off = np.abs(run.p - followed)[:, [k for k in range(followed.shape[1]) if k != axis]].max(axis=1)
    draw_line(error, ms, np.maximum(off * 1e6, 1e-2), **STYLES[0] | {"linewidth": 0.8})
    error.set_yscale("log")
    draw_bound(height, -clearance(plant) * 1e6, "touchdown bearing", where="below left")
    finish_axes(height, "", "height [µm]")
    finish_axes(error, "", "off its reference, radially [µm]")
    finish_axes(stroke, "", f"{plant.stroke.name} [mm]")
    radial = [k for k in range(len(plant.inputs)) if k != plant.thrust_input]
    forces = dict(zip((plant.thrust_input, *radial), (thrust, *np.ravel(others)), strict=True))
    for k, axes in forces.items():  # each in a panel of its own: noise hides the others
        draw_line(axes, ms, run.v[:, k], **STYLES[0] | {"linewidth": 0.8})
        bottom = axes in others[-1]
        finish_axes(axes, "time [ms]" if bottom else "", f"{plant.inputs[k].name} [{plant.inputs[k].unit}]")
    span = [run.v[:, radial].min(), run.v[:, radial].max()]
    room = 0.08 * (span[1] - span[0])
    for k in radial:
        forces[k].set_ylim(span[0] - room, span[1] + room)
    for axes in figure.axes:
        _mark_states(axes, ms, state, named=axes is height)
    add_shared_legend(figure)
    return figure


def _mark_states(axes: Axes, ms: FloatArray, state: FloatArray, *, named: bool) -> None:
    """Shade every other state, and write the names above the axes, upright where they are short."""
    edges = [0, *(np.flatnonzero(np.diff(state)) + 1).tolist(), len(state)]
    apart, free = 0.033 * ms[-1], -np.inf  # of upright names
    for n, (begin, end) in enumerate(pairwise(edges)):
        left, right = ms[begin], ms[end - 1]
        if n % 2:
            axes.axvspan(left, right, color="#e6e6e6", zorder=0)
        if named:
            upright = right - left < 0.13 * ms[-1]
            place = max((left + right) / 2, free)
            free = place + apart if upright else free
            where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
            name = list(STATES)[int(state[begin])].lower()
            axes.annotate(name, (place, 1.01), rotation=90 * upright, **where, **NOTE | {"fontsize": 7})


def supervised_faults_figure(e: Experiment, _: Published | None = None) -> Figure:
    """The speed at which a bearing is met after each fault, with and without the supervisor; deviations over time."""
    if any(merit.label == "moments" for merit in e.merits):
        return _moments_figure(e)
    found = "; ".join(f"{merit.label}: {merit.value:.0f}" for merit in e.merits)
    places = {"left": 0.245, "wspace": 0.24, "top": 0.75}
    figure = new_page(runs_of(e), "faults with and without the supervisor", found, **places)
    bars, deviations = figure.subplots(1, 2, width_ratios=(1, 1.25))
    _draw_speeds(bars, e)
    _draw_deviations(deviations, e)
    finish_axes(bars, "speed at the first contact [mm/s]", "", legend=2)
    finish_axes(
        deviations, "time after the fault [ms]", "largest radial deviation [µm]", legend=1, side="right"
    )
    return figure


def _draw_speeds(axes: Axes, e: Experiment) -> None:
    """Two bars for each fault: alone, and with the supervisor."""
    labels = list(dict.fromkeys(case.label.removesuffix(SUFFIX) for case in e.cases))
    speeds = [case.merits[2].value * 1e3 for case in e.cases]
    for case, speed in zip(e.cases, speeds, strict=True):
        supervised = case.label.endswith(SUFFIX)
        place = labels.index(case.label.removesuffix(SUFFIX)) + (0.2 if supervised else -0.2)
        text = "no contact"
        if speed >= 0:
            axes.barh(place, speed, height=0.36, **LOOKS[supervised])
            text = f"{number(speed, 2)} mm/s, " + ("touchdown" if ended_early(case.run) else "landed")
        where: dict[str, Any] = {"xytext": (3, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(
            text, (max(speed, 0.0) if speed >= 0 else 0.0, place), **where, **NOTE | {"fontsize": 7}
        )
    for supervised, look in LOOKS.items():
        axes.barh(0, 0, label="with supervisor" if supervised else "alone", **look)
    axes.set_yticks(range(len(labels)), [micro(label) for label in labels], fontsize=9)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlim(0, 1.9 * max([speed for speed in speeds if speed >= 0], default=1.0))


def _moments_figure(e: Experiment) -> Figure:
    """Contact speeds, currents and times until it is off of each class of faults, a mark for each moment."""
    merits = {merit.label: merit for merit in e.merits}
    alone, supervised = (merits[f"fastest contact {who}"].phrase() for who in ("alone", "with supervisor"))
    found = (
        f"{merits['moments'].value:.0f} moments; fastest contact alone {alone}, with supervisor {supervised}"
    )
    places = {"left": 0.24, "right": 0.98, "wspace": 0.12, "top": 0.87}
    title = "faults at random moments of lift, operation, stroke and landing"
    figure = new_page(runs_of(e), title, found, **places)
    panels = figure.subplots(1, 3, sharey=True)
    classes = {label: [FaultOutcome(*row) for row in rows] for label, rows in e.curves.items()}
    for n, rows in enumerate(classes.values()):
        shown: tuple[tuple[list[float], list[float]], ...] = (
            ([row.speed_alone * 1e3 for row in rows], [row.speed * 1e3 for row in rows]),
            ([row.current_alone for row in rows], [row.current for row in rows]),
            ([], [max(row.safe * 1e3, MIN_TIME) for row in rows]),
        )
        for axes, values in zip(panels, shown, strict=True):
            for supervised_run, marks in zip((False, True), values, strict=True):
                place = n + (0.18 if supervised_run else -0.18)
                label = ("with supervisor" if supervised_run else "alone") if n == 0 else None
                axes.plot(marks, [place] * len(marks), label=label, **MARKS[supervised_run])
    limit = e.run.plant.actuator.current_limit
    dashes: dict[str, Any] = {"color": "#2b2b2b", "linewidth": 0.8, "linestyle": "--"}
    panels[1].axvline(limit, label=f"limit of an axis, {limit:g} A", **dashes)
    panels[2].set_xscale("log")
    panels[0].set_yticks(range(len(classes)), [_name_class(*one) for one in classes.items()], fontsize=7)
    panels[0].set_ylim(len(classes) - 0.4, -0.6)
    for axes, label in zip(panels, ("fastest contact [mm/s]", "current of an axis [A]"), strict=False):
        finish_axes(axes, label, "")
        axes.set_xlim(-0.03 * axes.get_xlim()[1], 1.05 * axes.get_xlim()[1])
    panels[2].set_xlim(MIN_TIME / 1.5, MAX_TIME)
    finish_axes(panels[2], "off or landed after [ms]", "")
    panels[2].set_xlim(MIN_TIME / 1.5, MAX_TIME)
    add_shared_legend(figure)
    return figure


def _name_class(label: str, rows: Sequence[FaultOutcome]) -> str:
    """A class of faults, and below it the monitors that acted last, the most frequent first."""
    acted = [MONITORS[int(row.monitor)].lower().replace("_", " ") for row in rows if row.monitor >= 0]
    names = sorted(set(acted), key=lambda name: (-acted.count(name), name))
    return f"{micro(label)}\n({', '.join(names[:3]) or 'no monitor'})"


MIN_TIME, MAX_TIME = 1e-2, 1e3  # ms, of the axis of times
MARKS: dict[bool, dict[str, Any]] = {
    False: {"color": "#2b2b2b", "marker": "x", "markersize": 4, "linestyle": "none"},
    True: {
        "color": "#2b2b2b",
        "marker": "o",
        "markersize": 4,
        "linestyle": "none",
        "markerfacecolor": "#ffffff",
    },
}
LOOKS: dict[bool, dict[str, Any]] = {
    False: {"color": "#2b2b2b"},
    True: {"color": "#ffffff", "edgecolor": "#2b2b2b", "hatch": "////"},
}


def _draw_deviations(axes: Axes, e: Experiment) -> None:
    """The largest radial deviation over time of two faults that end in a touchdown without the supervisor."""
    struck = e.run.scenario.faults[0].at
    alone = [case for case in e.cases if not case.label.endswith(SUFFIX)]
    down = [case.label for case in alone if ended_early(case.run)][:2]
    styles = iter(STYLES)
    for case in (case for case in e.cases if case.label.removesuffix(SUFFIX) in down):
        run = case.run
        radial = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
        ms, off = (run.t - struck) * 1e3, np.abs(run.p[:, radial]).max(axis=1) * 1e6
        label = micro(case.label.removesuffix(SUFFIX)) + (
            ", supervised" if case.label.endswith(SUFFIX) else ""
        )
        draw_largest(axes, ms, np.maximum(off, 0.1), label=label, **next(styles))
        if case.merits[1].value >= 0:
            k = min(int(np.searchsorted(ms, case.merits[1].value * 1e3)), len(ms) - 1)
            down_there = {"label": "touchdown"} if ended_early(run) else {"marker": "v", "label": "landed"}
            axes.plot(ms[k], off[k], **CROSS | down_there)
    if not down:
        axes.annotate("no touchdown", (0.5, 0.5), xycoords="axes fraction", ha="center", **NOTE)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.1)
    draw_bound(axes, clearance(e.run.plant) * 1e6, "touchdown bearing")
