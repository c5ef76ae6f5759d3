"""Records -> figures of a report. Functions import matplotlib when they draw, not when a module is loaded.

Every figure names its design and fidelity, and shows published figures of the same experiment. A machine's own figures
are in the module `figures` beside its plant, which has

    FIGURES        name of an experiment -> (experiment, published or None) -> figure
    stroke_figure  (run, published or None) -> figure, of a machine whose main job is a stroke

An experiment without a figure of its own is drawn by `run_figure`: its first run.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import InputError
from malta.model.parts import attribute_of
from malta.model.signal_groups import KINDS, SignalGroup, outputs_of
from malta.report.figures.campaign import (
    distributions_figure as distributions_figure,
    worst_figure as worst_figure,
    yield_figure as yield_figure,
)
from malta.report.figures.drawing import (
    MORE_STYLES as MORE_STYLES,
    POINTS as POINTS,
    STYLES as STYLES,
    Published,
    draw_bound,
    draw_grid,
    draw_group,
    draw_line,
    encode_figure as encode_figure,
    ending_text,
    finish_axes,
    micro,
    new_figure,
    new_page,
    number as number,
    save as save,
    save_figure,
)
from malta.report.figures.log import log_figure as log_figure, strips_figure as strips_figure
from malta.simulation.experiments import Case, Experiment
from malta.simulation.experiments.catalogue import experiments_of
from malta.simulation.trajectory import Trajectory
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray
    from malta.identification.identified import Identified
    from malta.identification.measure import Curve, Measurement


TOP_BELOW_LEGENDS = 0.835  # of panels whose legends have two rows


def experiment_figure(
    e: Experiment, published: Published | None = None, path: str | Path | None = None
) -> Figure:
    """Draw an experiment: the machine's own figure of it, or that of its first run; save it where a path is given.

    e : the experiment
    published : figures of the machine's paper, from `malta.model.read_published`; None: none
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for an experiment that the machine does not have, and for another suffix.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> push = malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact)
    >>> figure = malta.report.experiment_figure(push)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['commanded force [N]', 'y, off reference [µm]', 'clearance used up [%]', '']
    """
    plant = e.run.plant
    drawn: dict[str, Callable[[Experiment, Published | None], Figure]] = {
        **dict.fromkeys(experiments_of(plant), run_figure),
        **attribute_of(plant, "figures", "FIGURES", {}),
        "run": run_figure,
    }
    if e.name not in drawn:
        raise InputError("figure", "experiment", repr(e.name), "one of " + ", ".join(drawn))
    return save_figure(drawn[e.name](e, published), path)


def stroke_figure(
    run: Trajectory, published: Published | None = None, path: str | Path | None = None
) -> Figure:
    """Draw a run: the machine's own figure of a stroke; of a machine without one, errors, forces and clearances.

    run : from `malta.simulate`
    published : figures of the machine's paper, from `malta.model.read_published`; None: none
    path : .png, .svg or .pdf file; None: nothing is written

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(10e-3))
    >>> figure = malta.report.stroke_figure(
    ...     run, malta.model.read_published("data/tubular.toml")
    ... )
    >>> len(figure.axes) > 2
    True
    """
    draw = attribute_of(run.plant, "figures", "stroke_figure")
    if draw is None:
        alone = Experiment("run", run.scenario.name, (Case(run.scenario.name, run, ()),), ())
        return save_figure(run_figure(alone), path)
    return save_figure(draw(run, published), path)


def run_figure(e: Experiment, _: Published | None = None) -> Figure:
    """One run: errors of all outputs, forces, and the clearance that is used up."""
    run = e.run
    stroke, *others = outputs_of(run.plant)
    panels: list[Callable[[Axes, str], None]] = [
        *(partial(_draw_errors, run=run, group=group, unit=group.fine) for group in others),
        *(
            partial(_draw_forces, run=run, unit=unit)
            for unit in dict.fromkeys(s.unit for s in run.plant.inputs)
        ),
        partial(_draw_errors, run=run, group=stroke, unit=_stroke_unit(run)),
        partial(_draw_clearances if run.plant.contacts.names else _draw_currents, run=run),
    ]
    furthest = [(group.name, _largest_error(run, group), group.fine) for group in others]
    furthest.append((stroke.name, _largest_error(run, stroke), _stroke_unit(run)))
    told = (f"{name} {number(in_unit(size, unit), 3)} {micro(unit)}" for name, size, unit in furthest)
    what = e.question if len(e.cases) == 1 else f"{e.question} {e.cases[0].label}, one of {len(e.cases)}"
    text = "furthest off its reference: " + ", ".join(told)
    rows = min(2, len(panels))
    columns = math.ceil(len(panels) / rows)
    rows_of_legends = max(-(-len(group) // 4) for group in (run.plant.inputs, run.plant.outputs))
    places = {
        "left": 0.1,
        "hspace": 0.24 + 0.06 * (min(rows_of_legends, 2) - 1),
        "wspace": 0.25 if columns < 3 else 0.42,
    }
    figure = new_page([run], f"{micro(what)}{ending_text(run)}", text, **places)
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    last = len(panels) - columns
    for k, (axes, draw) in enumerate(zip(grid, panels, strict=False)):
        draw(axes, "time [ms]" if k >= last else "")
        axes.tick_params(labelbottom=k >= last)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    legends = [axes.get_legend() for axes in grid[:columns]]
    if any(one is not None and len(one.get_texts()) > 4 for one in legends):  # two rows of them
        figure.subplots_adjust(top=TOP_BELOW_LEGENDS)
    return figure


def _largest_error(run: Trajectory, group: SignalGroup) -> float:
    """Largest error of a group of outputs, SI."""
    return float(np.abs((run.p - run.reference)[:, group.columns]).max())


def _stroke_unit(run: Trajectory) -> str:
    """A unit in which the error along the stroke has few digits."""
    stroke = outputs_of(run.plant)[0]
    small = _largest_error(run, stroke) < 1e-4
    return stroke.fine if small else {"m": "mm", "rad": "mrad"}.get(stroke.unit, stroke.unit)


def _draw_errors(axes: Axes, x: str, run: Trajectory, group: SignalGroup, unit: str) -> None:
    """Errors of the outputs of a group."""
    error = in_unit(1.0, unit) * (run.p - run.reference)
    several = len(group.columns) > 1
    columns = draw_group(axes, run.t * 1e3, {run.plant.outputs[k].name: error[:, k] for k in group.columns})
    axes.ticklabel_format(axis="y", scilimits=(-2, 5))  # numbers of many zeros have no room
    name = group.name if several else run.plant.outputs[group.columns[0]].name
    finish_axes(axes, x, f"{name}, off reference [{micro(unit)}]", legend=columns if several else 0)


def _draw_forces(axes: Axes, x: str, run: Trajectory, unit: str) -> None:
    """Every input of this unit, the leading one first."""
    inputs = run.plant.inputs
    shown = [k for k in range(len(inputs)) if inputs[k].unit == unit]
    shown.sort(key=lambda k: k != run.plant.leading_input)
    columns = draw_group(axes, run.t * 1e3, {inputs[k].name: run.v[:, k] for k in shown})
    finish_axes(axes, x, f"commanded {KINDS.get(unit, 'input')} [{unit}]", legend=columns)


def _draw_clearances(axes: Axes, x: str, run: Trajectory) -> None:
    """Shares of the clearances that are used up, on a logarithmic axis."""
    names = [name.removeprefix("touchdown at sensor ") for name in run.plant.contacts.names]
    ways = dict(zip(names, np.maximum(run.contact.T * 100, 1e-3), strict=True))
    columns = draw_group(axes, run.t * 1e3, ways)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.01)
    draw_bound(axes, 100, "touched")
    finish_axes(axes, x, "clearance used up [%]", legend=columns, side="right")


def _draw_currents(axes: Axes, x: str, run: Trajectory) -> None:
    """The largest and the smallest of all currents, for a machine without contacts."""
    for side, style in zip(("largest", "least"), STYLES, strict=False):
        values = run.current.max(axis=1) if side == "largest" else run.current.min(axis=1)
        draw_line(axes, run.t * 1e3, values, label=f"{side} of {run.current.shape[1]}", **style)
    finish_axes(axes, x, "currents, from least to largest [A]", legend=2)


# Figures of a loop that was measured.


def measured_figure(found: Measurement) -> Figure:
    """Draw a loop that was measured: S, T, open loop and compliance of each sensor with bands over the tube."""
    p = len(found.sensors)
    verdict = found.refusal or f"as predicted by {found.machines} machines of the box"
    figure = new_figure(
        f"{found.source}: the loop as measured", verdict, size=(11.0, 1.4 + 1.75 * p), wspace=0.42, left=0.07
    )
    curves = {"|S| [1]": found.S, "|T| [1]": found.T, "|L| [1]": found.L, "|S P| [m/N]": found.compliance}
    panels = figure.subplots(p, 4, sharex=True, squeeze=False)
    for i, (name, row) in enumerate(zip(found.sensors, panels, strict=True)):
        for axes, (label, curve) in zip(row, curves.items(), strict=True):
            at: tuple[int, ...] = (i,)
            if curve is found.compliance:
                j = int(curve.size[:, i].max(axis=0).argmax())
                at, label = (i, j), f"{name} by {found.forces[j]} [SI]"
            _draw_curve(axes, found.w / (2 * np.pi), curve.at(*at))
            axes.set_ylabel(label if len(at) > 1 else f"{name}: {label}", fontsize=8)
            axes.tick_params(which="both", labelsize=7)
    for axes in panels[-1]:
        axes.set_xlabel("frequency [Hz]", fontsize=8)
    panels[0, 0].legend(fontsize=7, frameon=False)
    return figure


def identified_figure(found: Identified) -> Figure:
    """Draw an identification: responses measured and explained, what is left of each line, and S with its band."""
    e, outputs = found.explanation, found.plant.outputs
    if e is None:
        raise InputError("identify", "--figure", "a log that nothing was explained of", "an identified one")
    f, order = e.w / (2 * np.pi), np.argsort(e.w)
    size = (11.0, 1.4 + 1.75 * len(outputs))
    figure = new_figure(
        f"{found.log.source}: {found.plant.name}",
        textwrap.fill(found.refusal or found.verdict, 120),
        size=size,
        wspace=0.3,
        top=1 - 1.05 / size[1],
    )
    panels = figure.subplots(len(outputs), 3, sharex=True, squeeze=False)
    for k, (signal, row) in enumerate(zip(outputs, panels, strict=True)):
        measured, left, noise = e.measured[:, k], np.abs(e.left[:, k]), e.noise[:, k]
        row[0].plot(f, np.abs(measured), ".", color="#c1440e", markersize=4, label="measured")
        row[0].plot(
            f,
            np.abs(measured - e.left[:, k]),
            "o",
            mfc="none",
            color="#4a4a4a",
            markersize=5,
            label="explained",
        )
        row[1].fill_between(
            f[order], 1e-2 * noise[order], 1.73 * noise[order], color="#d9d9d9", label="noise, 95 %"
        )
        row[1].plot(f, left, ".", color="#c1440e", markersize=4, label="left")
        for axes, label in zip(row[:2], (f"{signal.name} / rms [1]", "left / rms [1]"), strict=True):
            axes.set(xscale="log", yscale="log")
            axes.set_ylabel(label, fontsize=8)
            draw_grid(axes)
        row[1].set_ylim(bottom=0.3 * float(noise.min()))
        if found.loop is not None:
            _draw_curve(row[2], found.loop.measured.w / (2 * np.pi), found.loop.measured.S.at(k))
            row[2].set_ylabel(f"|S| of {signal.name} [1]", fontsize=8)
        for axes in row:
            axes.tick_params(which="both", labelsize=7)
    for axes, last in zip(panels[0], panels[-1], strict=True):
        axes.legend(
            fontsize=7, frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2
        )
        last.set_xlabel("frequency [Hz]", fontsize=8)
    return figure


def _draw_curve(axes: Axes, f: FloatArray, curve: Curve) -> None:
    """A response with its 95 % band as bars, the prediction as a line and its tube as an area."""
    size, half = curve.size, 1.96 * curve.deviation
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.fill_between(f, curve.low, curve.high, color="#d9d9d9", linewidth=0, label="tube")
    axes.plot(f, np.abs(curve.predicted), color="#4a4a4a", linewidth=0.9, label="predicted")
    bars = np.array([np.minimum(half, 0.999 * size), half])
    axes.errorbar(f, size, bars, fmt=".", color="#c1440e", markersize=3, elinewidth=0.8, label="measured")
    axes.set_ylim(bottom=0.5 * min(float(size.min()), float(curve.low.min())))
    draw_grid(axes)
