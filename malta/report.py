"""Records -> figures and pages. The only module that imports matplotlib."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.optimize import linear_sum_assignment

from malta.data import to_si
from malta.errors import InputError
from malta.files import replace_files
from malta.linearize import LinearModel
from malta.simulate import StrokeFigures, Trajectory, stroke_figures
from malta.spec import Spec
from malta.synthesize import continuous_poles
from malta.verify import BANDWIDTHS, Margins, zone

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.plant import ComplexArray, FloatArray

Published = Mapping[str, Any]  # a file of data/published/


# --- pages ---


def poles_table(model: LinearModel, published: Published | None) -> Table:
    """Open-loop poles by mode, beside Table I where it applies."""
    names, values = _modes(model)
    table = _table("Open-loop poles [rad/s]", "mode", *names)
    table.add_row("ours, +-", *(f"{value:.2f}" for value in values))
    at_centre = not np.any(model.operating_point.x)
    if published is not None and at_centre:
        digits = _entry(published, "table_I.digits", int)
        printed = [_entry(published, f"table_I.poles.{name}") for name in names]
        table.add_row("Table I, +-", *(f"{value:.{digits}f}" for value in printed))
    return table


def loop_poles_table(margins: Margins, continuous: Mapping[str, ComplexArray] | None = None) -> Table:
    """Poles of the continuous design, if given, and of the sampled loop as s-plane values."""
    table = _table("Poles [rad/s]; of sampled systems ln(lambda) / Ts", "of", "poles")
    for what, poles in (continuous or {}).items():
        table.add_row(what, _pole_text(poles))
    for what, key in (
        ("sampled regulator, with integrals", "regulator"),
        ("sampled Kalman filter", "filter"),
        ("closed loop of the machine", "closed_loop"),
    ):
        table.add_row(what, _pole_text(getattr(margins.poles, key)))
    return table


def bandwidth_table(margins: Margins, published: Published | None) -> Table:
    """Bandwidths by definition; the paper gives one figure and no definition."""
    table = _table("Bandwidth by definition", "definition", "rad/s", "Hz")
    for key, meaning in BANDWIDTHS.items():
        value = margins.bandwidth[key]
        table.add_row(meaning, f"{value:.1f}", f"{value / (2 * math.pi):.2f}")
    if published is not None:
        value = _si(published, "position_controller.bandwidth", "rad/s")
        table.add_row("published, without a definition", f"about {value:.0f}", f"{value / (2 * math.pi):.0f}")
    return table


def sensitivity_table(margins: Margins) -> Table:
    """Peak sensitivity at each sensor with its ISO 14839-3 zone, stage by stage."""
    sensors = [k for k in margins.peak_sensitivity if k != "sigma_max"]
    table = _table(
        "Peak sensitivity (ISO 14839-3 zone: A < 3, B < 4, C < 5)", "loop", *sensors, "sigma_max", "at rad/s"
    )
    for stage in margins.stages:
        peaks = [f"{stage.peak_sensitivity[s]:.2f} {zone(stage.peak_sensitivity[s])}" for s in sensors]
        table.add_row(
            stage.name, *peaks, f"{stage.peak_sensitivity['sigma_max']:.2f}", f"{stage.peak_frequency:.3g}"
        )
    return table


def stroke_table(figures: StrokeFigures, published: Published | None) -> Table:
    """The stroke beside the published figures."""
    rows = [
        ("rise, 10-90 % [ms]", figures.rise * 1e3, "figure_12.rise_time", "ms", 2, "{:.1f}"),
        ("overshoot [%]", figures.overshoot * 1e2, "figure_12.overshoot", "percent", 2, "<= {:.1f}"),
        ("axial error [mm]", figures.axial_error * 1e3, "figure_12.axial_error", "mm", 3, "<= {:.1f}"),
    ]
    radial = ("figure_13.radial_deviation", "um", 2, "<= {:.0f}")
    rows += [(f"deviation {name} [um]", value * 1e6, *radial) for name, value in figures.radial.items()]
    table = _table("Stroke", "figure", "ours", "published")
    for label, value, key, unit, digits, form in rows:
        printed = "" if published is None else form.format(_si(published, key, unit))
        table.add_row(label, f"{value:.{digits}f}", printed)
    table.add_row("largest thrust [N]", f"{figures.force:.1f}", "")
    table.add_row("largest current [A]", f"{figures.current:.2f}", "")
    return table


def design_page(
    spec: Spec, model: LinearModel, margins: Margins, figures: StrokeFigures, published: Published | None
) -> Group:
    """One readable page about a design."""
    return Group(
        Text(f"{spec.name}: {spec.summary}", style="bold"),
        f"{model.plant.name}, preset {spec.parameters.preset}, {spec.discretization}, "
        f"{1e-3 / spec.sample_time:g} kHz, delay {spec.delay} in the design model",
        "",
        poles_table(model, published),
        loop_poles_table(margins, continuous_poles(model, spec.weights)),
        bandwidth_table(margins, published),
        sensitivity_table(margins),
        stroke_table(figures, published),
    )


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 or column == "poles" else "right")
    return table


def _modes(model: LinearModel) -> tuple[list[str], FloatArray]:
    """Each pair of poles +-value by the position that moves most in it."""
    names = [s.name for s in model.plant.design_states[: len(model.stiffness)]]
    squares, shapes = np.linalg.eig(model.stiffness)
    participation = np.abs(shapes * np.linalg.inv(shapes).T)  # of position i in mode j, free of units
    _, mode = linear_sum_assignment(-participation)
    return names, np.sqrt(np.maximum(squares.real, 0))[mode]


def _pole_text(poles: ComplexArray) -> str:
    """Poles in one line: conjugate pairs once, repeated ones counted."""
    counted: dict[str, int] = {}
    for pole in poles:
        if pole.imag < -1e-6 * abs(pole):
            continue
        real = f"{pole.real:.4g}"
        text = f"{real}+-{pole.imag:.4g}j" if pole.imag > 1e-6 * abs(pole) else real
        counted[text] = counted.get(text, 0) + 1
    return "  ".join(text if count == 1 else f"{text} (x{count})" for text, count in counted.items())


def _si(published: Published, key: str, unit: str) -> float:
    """A published quantity in the unit asked for."""
    value, given = _entry(published, f"{key}.value"), _entry(published, f"{key}.unit", str)
    return to_si(value, given, unit, "data/published", key)


def _entry(published: Published, key: str, kind: Any = (int, float)) -> Any:
    entry: Any = published
    for part in key.split("."):
        if not isinstance(entry, Mapping) or part not in entry:
            raise InputError("data/published", key, "nothing", "what the paper prints")
        entry = entry[part]
    if isinstance(entry, bool) or not isinstance(entry, kind):
        raise InputError("data/published", key, repr(entry), "a text" if kind is str else "a number")
    return entry


# --- figures ---

STYLES: Sequence[dict[str, Any]] = (  # told apart without colour: by darkness and by dash
    {"color": "#000000", "linestyle": "-", "linewidth": 1.6},
    {"color": "#c1440e", "linestyle": "-", "linewidth": 1.4},
    {"color": "#1f77b4", "linestyle": (0, (5, 2)), "linewidth": 1.4},
    {"color": "#8a8a8a", "linestyle": (0, (1.5, 1.5)), "linewidth": 1.6},
)
BOUND = {"color": "#9a9a9a", "linestyle": (0, (8, 3)), "linewidth": 0.9}


def stroke_figure(run: Trajectory, published: Published | None = None) -> Figure:
    """Axial position, tracking error, radial deviation and currents of a stroke, published bounds drawn in."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), dpi=120)
    figure.subplots_adjust(left=0.085, right=0.985, bottom=0.085, top=0.93, wspace=0.24, hspace=0.16)
    (position, radial), (error, current) = figure.subplots(2, 2, sharex=True)
    names = [s.name for s in run.plant.outputs]
    axis = run.plant.stroke_output
    ms = run.t * 1e3
    position.plot(ms, run.reference[:, axis] * 1e3, label="reference", **STYLES[2])
    position.plot(ms, run.p[:, axis] * 1e3, label="position", **STYLES[0])
    position.set_ylabel("axial position z [mm]")
    error.plot(ms, (run.reference[:, axis] - run.p[:, axis]) * 1e3, **STYLES[0])
    error.set_ylabel("axial error z* - z [mm]")
    for i, style in zip((k for k in range(len(names)) if k != axis), (1, 0, 3, 2), strict=False):
        radial.plot(ms, (run.p[:, i] - run.reference[:, i]) * 1e6, label=names[i], **STYLES[style])
    radial.set_ylabel("radial deviation [µm]")
    for name, style, i in _widest_currents(run):
        current.plot(ms, run.current[:, i], label=name, **STYLES[style])
    current.set_ylabel("current per module [A]")
    if published is not None:
        for axes, key, unit in (
            (error, "figure_12.axial_error", "mm"),
            (radial, "figure_13.radial_deviation", "um"),
        ):
            bound = _si(published, key, unit)
            for sign in (-1, 1):
                axes.axhline(sign * bound, **BOUND)
            axes.annotate(
                "published bound",
                (0.985, bound),
                xycoords=("axes fraction", "data"),
                ha="right",
                va="bottom",
                fontsize=8,
                color="#6a6a6a",
            )
            reach = max(
                abs(value) for line in axes.lines for value in np.asarray(line.get_ydata(), dtype=float)
            )
            axes.set_ylim(-max(1.25 * bound, 1.1 * reach), max(1.25 * bound, 1.1 * reach))
    for axes in (position, radial, current):
        below_bound = {"loc": "upper left", "bbox_to_anchor": (0, 0.89), "ncols": 2} if axes is radial else {}
        axes.legend(frameon=False, fontsize=8, **below_bound)
    for axes in (error, current):
        axes.set_xlabel("time [ms]")
    for axes in (position, radial, error, current):
        axes.grid(color="#e4e4e4", linewidth=0.6)
        axes.margins(x=0)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    f = stroke_figures(run)
    figure.suptitle(
        f"{run.controller.name}: stroke of {(run.reference[-1, axis] - run.reference[0, axis]) * 1e3:.0f} mm, "
        f"rise {f.rise * 1e3:.1f} ms, overshoot {f.overshoot * 100:.1f} %, axial error {f.axial_error * 1e3:.2f} mm, "
        f"radial {max(f.radial.values()) * 1e6:.1f} µm"
        + ("" if run.verdict.completed else f" ({run.verdict.name})"),
        fontsize=10,
    )
    return figure


def _widest_currents(run: Trajectory) -> list[tuple[str, int, int]]:
    """The thrust current and the two bearing currents that carry the weight: label, style, index."""
    inputs = [s.name for s in run.plant.inputs]
    thrust = run.plant.thrust_input
    widest = np.argsort(-np.abs(run.v).max(axis=0), kind="stable")
    others = sorted(int(i) for i in widest[widest != thrust][:2])
    return [(inputs[i], style, i) for style, i in enumerate([thrust, *others])]


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


def stroke(run: Trajectory, path: str | Path | None = None, published: Published | None = None) -> Path:
    """Draw a stroke and save it, as build/NAME_SCENARIO.png if no path is given."""
    default = Path("build") / f"{run.controller.name}_{run.scenario.name}.png"
    return save(stroke_figure(run, published), default if path is None else path)
