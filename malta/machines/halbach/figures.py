"""The figures of the experiments on the Halbach linear motor."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.halbach.experiments import LEAD_READINGS, PAUSE, lift_force, responses
from malta.report.figures.drawing import (
    MORE_STYLES,
    REFERENCE,
    STYLES,
    Published,
    add_shared_legend,
    draw_line,
    draw_noisy,
    ending_text,
    finish_axes,
    merits_phrase,
    micro,
    new_page,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.simulation.experiments import Case, Experiment
    from malta.simulation.trajectory import Trajectory

RUN_STYLE: dict[str, Any] = {"color": "#b5b5b5", "linewidth": 0.7}


def step_figure(e: Experiment, _: Published | None = None) -> Figure:
    """All steps on top of each other with their mean, the position at rest, and the vertical force. Fig. 9."""
    run = e.run
    merits = "; ".join(f"{m.label} {m.phrase()}" for m in e.cases[0].merits[:4])
    figure = new_page([run], f"steps{ending_text(run)}", f"{e.cases[0].label}: {micro(merits)}", hspace=0.4)
    grid = figure.add_gridspec(2, 2)
    if len(e.cases) > 1:
        panels = [figure.add_subplot(grid[0, k]) for k in range(2)]
    else:
        panels = [figure.add_subplot(grid[0, :])]
    for axes, case in zip(panels, e.cases, strict=False):
        _draw_steps(axes, case)
    rest, lift = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
    last = slice(_first_sample_at_rest(run), None)
    draw_line(rest, run.t[last], 1e6 * (run.p - run.reference)[last, 0], **STYLES[0] | {"linewidth": 0.9})
    draw_noisy(lift, run.t, lift_force(run), PAUSE)
    finish_axes(rest, "time [s]", "off reference, at rest [µm]")
    finish_axes(lift, "time [s]", "vertical force [N]", legend=2)
    add_shared_legend(figure)
    return figure


def _first_sample_at_rest(run: Trajectory) -> int:
    """The first reading after the last step has settled."""
    moving = np.flatnonzero(np.diff(run.reference[:, 0]))
    return min(int(moving[-1]) + PAUSE // 2 if len(moving) else 0, len(run.t) - 1)


def _draw_steps(axes: Axes, case: Case) -> None:
    """All responses of a case and their mean, over the time after a step."""
    run = case.run
    moved = run.scenario.reference(run.plant)(run.t).p[:, 0]
    distance = float(moved[np.abs(moved).argmax()])
    count = (round(run.scenario.duration / run.controller.sample_time) - LEAD_READINGS) // PAUSE
    count = min(count, int(np.count_nonzero(np.diff(np.sign(np.abs(moved) - abs(distance) / 2)))))
    shares = responses(run, distance, max(count, 1))
    ms = 1e3 * run.controller.sample_time * np.arange(PAUSE)
    shown = ms < 1200
    for k, share in enumerate(shares):
        named = {"label": "each step"} if k == 0 else {}
        axes.plot(ms[shown], 1e6 * distance * share[shown], **RUN_STYLE | named)
    axes.plot(ms[shown], 1e6 * distance * shares.mean(axis=0)[shown], label="mean", **STYLES[0])
    asked = run.reference[LEAD_READINGS : LEAD_READINGS + PAUSE, 0]
    axes.plot(ms[shown][: len(asked)], 1e6 * asked[shown[: len(asked)]], label="reference", **REFERENCE)
    finish_axes(axes, "time after the step begins [ms]", f"position, {case.label} [µm]")


def ramp_figure(e: Experiment, _: Published | None = None) -> Figure:
    """Position and error over time; error and vertical force along the travel, by stretches, for each speed. Fig. 8."""
    figure = new_page(runs_of(e), f"ramps{ending_text(e.run)}", merits_phrase(e.cases, 0), hspace=0.42)
    (position, begin), (along, lift) = figure.subplots(2, 2)
    for n, (case, style) in enumerate(zip(e.cases, cycle((*STYLES, *MORE_STYLES)), strict=False)):
        run, aside = case.run, (n - (len(e.cases) - 1) / 2) / (len(e.cases) + 1)
        error, place = 1e6 * (run.p - run.reference)[:, 0], 1e3 * run.reference[:, 0]
        moving = np.diff(run.reference[:, 0], append=run.reference[-1, 0]) != 0
        first = run.t - (run.t[moving][0] if moving.any() else 0.0)
        draw_line(position, run.t, 1e3 * run.p[:, 0], label=case.label, **style)
        started = (first > -0.5) & (first < 3)
        begin.plot(first[started], error[started], **style)
        steady = moving & (first > 2)
        mark = {"marker": MARKERS[n % len(MARKERS)], "color": style["color"], "label": case.label}
        _draw_stretches(along, place[steady], error[steady], aside, mark)
        _draw_stretches(lift, place[moving], lift_force(run)[moving], aside, mark)
    finish_axes(position, "time [s]", "position [mm]")
    finish_axes(begin, "time after the begin [s]", "off reference [µm]")
    stretches, columns = f"position, mean and deviation in each {STRETCH:g} mm [mm]", len(e.cases)
    finish_axes(along, stretches, "off reference, after 2 s [µm]", legend=columns)
    finish_axes(lift, stretches, "vertical force [N]", legend=columns)
    for axes in (along, lift):
        axes.margins(x=0.03)
    add_shared_legend(figure)
    return figure


STRETCH = 5.0  # mm of the travel, over which noisy signals are averaged
MARKERS = "osD^"


def _draw_stretches(
    axes: Axes, place: FloatArray, values: FloatArray, aside: float, mark: dict[str, Any]
) -> None:
    """Mean and standard deviation of a signal in each stretch of the travel, drawn a share of it beside its middle."""
    stretch = np.floor(place / STRETCH)
    parts = {(k + 0.5 + 0.8 * aside) * STRETCH: values[stretch == k] for k in np.unique(stretch)}
    means, deviations = ([float(f(part)) for part in parts.values()] for f in (np.mean, np.std))
    axes.errorbar(list(parts), means, deviations, markersize=4.5, linestyle="none", elinewidth=0.9, **mark)


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "step": step_figure,
    "ramp": ramp_figure,
}
