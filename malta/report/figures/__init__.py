"""Records -> figures of a report. Functions import matplotlib when they draw, not when a module is loaded.

Every figure names its design and fidelity, and shows published figures of the same experiment. A machine's own figures
are in the module `figures` beside its plant, which has

    FIGURES        name of an experiment -> (experiment, published or None) -> figure
    stroke_figure  (run, published or None) -> figure, of a machine whose main job is a stroke

An experiment without a figure of its own is drawn by `run_figure`: its first run.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import InputError
from malta.files import PICTURES, replace_files, require_suffix
from malta.model.machines import (
    KINDS,
    Group,
    attribute_of,
    outputs_of,
)
from malta.report.figures.campaign import distributions_figure as distributions_figure
from malta.report.figures.campaign import yield_figure as yield_figure
from malta.report.figures.drawing import MORE as MORE
from malta.report.figures.drawing import POINTS as POINTS
from malta.report.figures.drawing import STYLES as STYLES
from malta.report.figures.drawing import (
    Published,
    draw_bound,
    draw_group,
    draw_line,
    ending_text,
    finish_axes,
    micro,
    new_page,
)
from malta.report.figures.drawing import number as number
from malta.report.figures.margins import front_figure as front_figure
from malta.report.figures.runs import worst_figure as worst_figure
from malta.simulation.experiments import Case, Experiment
from malta.simulation.experiments.catalogue import experiments_of
from malta.simulation.trajectory import Trajectory
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def experiment_figure(e: Experiment, published: Published | None = None) -> Figure:
    """Draw an experiment: the machine's own figure of it, or that of its first run.

    e : the experiment
    published : figures of the machine's paper, from `malta.model.published`; None: none

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for an experiment that the machine does not have.

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
    return drawn[e.name](e, published)


def stroke_figure(run: Trajectory, published: Published | None = None) -> Figure:
    """Draw a run: the machine's own figure of a stroke; of a machine without one, errors, forces and clearances.

    run : from `malta.simulate`
    published : figures of the machine's paper, from `malta.model.published`; None: none

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(10e-3))
    >>> figure = malta.report.stroke_figure(
    ...     run, malta.model.published("data/tubular.toml")
    ... )
    >>> len(figure.axes) > 2
    True
    """
    draw = attribute_of(run.plant, "figures", "stroke_figure")
    if draw is None:
        return run_figure(Experiment("run", run.scenario.name, (Case(run.scenario.name, run, ()),), ()))
    figure: Figure = draw(run, published)
    return figure


def save(figure: Figure, path: str | Path, *, dark: bool = False) -> Path:
    """Write a figure as .png, .svg or .pdf, whole or not at all; the same figure gives the same bytes.

    A .svg file is light on screens that prefer light pages, and dark on those that prefer dark ones.

    figure : a matplotlib Figure
    path : of the file; its suffix gives the form
    dark : light lines on a dark page, of a .png or .svg file

    Returns the path.

    Raises InputError for another suffix, a dark .pdf file, or a folder that cannot be written to.

    >>> import malta
    >>> malta.report.save(malta.report.new_figure("empty"), "build/empty.svg").name
    'empty.svg'
    """
    path = Path(path)
    replace_files({path: encode_figure(figure, path, dark=dark)})
    return path


def encode_figure(figure: Figure, path: Path, *, dark: bool = False) -> bytes:
    r"""Make the content of a .png, .svg or .pdf file of a figure; the same figure gives the same bytes.

    A .svg file is light on screens that prefer light pages, and dark on those that prefer dark ones.

    figure : a matplotlib Figure
    path : of the file; its suffix gives the form
    dark : light lines on a dark page, of a .png or .svg file

    Returns the bytes.

    Raises InputError for another suffix, and for a dark .pdf file.

    >>> import malta
    >>> from pathlib import Path
    >>> figure = malta.report.new_figure("empty")
    >>> malta.report.encode_figure(figure, Path("empty.png"))[:4]
    b'\x89PNG'
    """
    import matplotlib

    from malta.report.figures.inline import png_of

    suffix = require_suffix(path, *PICTURES).suffix.lower()
    if suffix == ".pdf" and dark:
        raise InputError(path, "", "a dark figure on paper", "a .png or .svg file, or a light figure")
    if suffix == ".png":
        return png_of(figure, dark=dark)
    buffer = io.BytesIO()
    date = {"Date": None} if suffix == ".svg" else {"CreationDate": None}
    with matplotlib.rc_context({"svg.hashsalt": "malta", "svg.fonttype": "none", "pdf.fonttype": 42}):
        figure.savefig(buffer, format=suffix[1:], metadata=date)
    return with_dark_mode(buffer.getvalue(), always=dark) if suffix == ".svg" else buffer.getvalue()


def with_dark_mode(svg: bytes, *, always: bool = False) -> bytes:
    """An SVG file that has light lines on a dark page, where the reader's screen prefers dark or `always`."""
    from malta.report.page.document import dark_colour

    text = svg.decode()
    rules = ["svg{fill:#ededed}"]  # of texts, which have no colour of their own
    for side, name in sorted(set(re.findall(r"(fill|stroke): #([0-9a-f]{6})", text))):
        rules.append(f'[style*="{side}: #{name}"]{{{side}:{dark_colour(name)} !important}}')
    inside = "".join(rules)
    style = f"<style>{inside if always else f'@media (prefers-color-scheme: dark){{{inside}}}'}</style>"
    return re.sub(r"(<svg\b[^>]*>)", lambda found: found[0] + style, text, count=1).encode()


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
        partial(_draw_clearances if run.plant.contacts else _draw_currents, run=run),
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
    return figure


def _largest_error(run: Trajectory, group: Group) -> float:
    """Largest error of a group of outputs, SI."""
    return float(np.abs((run.p - run.reference)[:, group.columns]).max())


def _stroke_unit(run: Trajectory) -> str:
    """A unit in which the error along the stroke has few digits."""
    stroke = outputs_of(run.plant)[0]
    small = _largest_error(run, stroke) < 1e-4
    return stroke.fine if small else {"m": "mm", "rad": "mrad"}.get(stroke.unit, stroke.unit)


def _draw_errors(axes: Axes, x: str, run: Trajectory, group: Group, unit: str) -> None:
    """Errors of the outputs of a group."""
    error = in_unit(1.0, unit) * (run.p - run.reference)
    several = len(group.columns) > 1
    columns = draw_group(axes, run.t * 1e3, {run.plant.outputs[k].name: error[:, k] for k in group.columns})
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
    names = [name.removeprefix("touchdown at sensor ") for name in run.plant.contacts]
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
