"""The figures of the experiments on the planar motor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from malta.report.figures.drawing import (
    STYLES,
    Published,
    draw_group,
    draw_line,
    draw_published,
    finish_axes,
    mark_end,
    new_page,
    number,
    runs_of,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.simulation.experiments import Experiment


def step_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Figs 9 to 12: motion, forces, and deviations of the other outputs, from the place without symmetry."""
    cases = [case for case in e.cases if case.label.endswith(e.cases[0].label.split(", ", 1)[1])]
    run, inputs = e.run, [s.name for s in e.run.plant.inputs]
    merits = {merit.label: merit.phrase() for merit in e.merits}
    names = {"table moves phi by": "table", "analytical moves phi by": "analytical"}
    told = [f"{short} {merits[label]}" for label, short in names.items() if label in merits]
    figure = new_page(
        runs_of(e),
        f"steps in z and y {cases[0].label.split(', ', 1)[1]}, by coil model of the controller",
        "phi moved by the coil model: " + ", ".join(told) if told else e.outcome,
        wspace=0.42,
        left=0.065,
        hspace=0.2,
    )
    (motion, across, forces), *below = figure.subplots(2, 3, sharex=True)
    for k, style in ((1, STYLES[0]), (2, STYLES[3])):
        moved = (run.p[:, k] - run.reference[0, k]) * 1e3
        draw_line(motion, run.t * 1e3, moved, label=run.plant.outputs[k].name, **style)
    pushes = {name: run.v[:, k] for k, name in enumerate(inputs) if run.plant.inputs[k].unit == "N"}
    draw_group(forces, run.t * 1e3, pushes)
    for axes, k, scale in (
        (across, 0, 1e9),
        (below[0][0], 3, 1e6),
        (below[0][1], 4, 1e6),
        (below[0][2], 5, 1e6),
    ):
        for case, style in zip(cases, STYLES, strict=False):
            ms, error = case.run.t * 1e3, (case.run.p - case.run.reference)[:, k] * scale
            label = {"label": case.label.split(",")[0]} if axes is across else {}
            draw_line(axes, ms, error, **label, **style)
            mark_end(axes, case.run, ms, error)
        unit = "nm" if k == 0 else "µrad"
        finish_axes(axes, "time [ms]" if k else "", f"{run.plant.outputs[k].name}, off reference [{unit}]")
    draw_published(forces, published, "steps.force_limit", "N", "published limit", both=True)
    finish_axes(motion, "", "moved [mm]", legend=2)
    finish_axes(forces, "", "commanded force [N]", legend=3)
    finish_axes(across, "", "x, off reference [nm]", legend=3)
    return figure


def jump_figure(e: Experiment, published: Published | None = None) -> Figure:
    """The same as jumps of the reference: y and its force by law, torque and tilt by coil model with soft gains."""
    laws = {case.label.split(", ", 1)[1]: case for case in e.cases if case.label.startswith("table")}
    soft = [case for case in e.cases if case.label in ("table, soft", "analytical, soft")]
    figure = new_page(
        runs_of(e),
        "jumps of the reference in z and y, by the law and by the coil model",
        "y off after 0.1 s: "
        + ", ".join(f"{t} {number(1e6 * c.merits[1].value)} µm" for t, c in laws.items()),
        wspace=0.3,
        left=0.075,
        hspace=0.2,
    )
    (motion, forces), (torque, tilt) = figure.subplots(2, 2, sharex=True)
    for (text, case), style in zip(laws.items(), STYLES, strict=False):
        run = case.run
        draw_line(motion, run.t * 1e3, (run.p[:, 1] - run.reference[0, 1]) * 1e3, label=text, **style)
        mark_end(motion, run, run.t * 1e3, (run.p[:, 1] - run.reference[0, 1]) * 1e3)
        draw_line(forces, run.t * 1e3, run.v[:, 1], label=text, **style)
    draw_published(forces, published, "steps.force_limit", "N", "published limit", both=True)
    for case, style in zip(soft, STYLES, strict=False):
        run = case.run
        draw_line(torque, run.t * 1e3, run.v[:, 3], label=case.label, **style)
        draw_line(tilt, run.t * 1e3, (run.p - run.reference)[:, 3] * 1e6, label=case.label, **style)
    finish_axes(motion, "", "y, moved [mm]", legend=3)
    finish_axes(forces, "", "F_y, commanded [N]")
    finish_axes(torque, "time [ms]", "T_x, commanded [N m]", legend=2)
    finish_axes(tilt, "time [ms]", "phi, off reference [µrad]")
    return figure


FIGURES: dict[str, Callable[[Experiment, Published | None], Figure]] = {
    "step": step_figure,
    "jump": jump_figure,
}
