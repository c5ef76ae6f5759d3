"""Plots in the plane of poles: pole-zero map and root locus. Poles of sampled loops are ln(z) / T, in rad/s."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from malta.errors import InputError
from malta.loops.curves import LoopCurves, loop_curves
from malta.loops.locus import DELAY, GAIN, RootLocus, root_locus as locus_of
from malta.report.figures.drawing import new_figure, number
from malta.report.plots.frequency import title_of
from malta.report.plots.panels import PlotSheet, add_hertz, add_legend, head_of, loops_of, plain, styles_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import ComplexArray
    from malta.loops.linear_loops import Place

DAMPING = (0.2, 0.5, 0.8)  # rays of the grid
MARKERS = ("x", "s", "D", "^", "v", "p", "h", "*")  # of the closed loops
NEAR_RANGE_FACTOR = 2.5  # times the highest crossing of unit gain: the panel of the slow poles
STRIP = 1.6  # times the Nyquist frequency: sampled poles beyond are next to pure delay
GREY = "#dcdcdc"
MAX_LINEAR_RANGE = 30.0  # from the slowest pole to the reach of a panel: beyond, its axes are logarithmic
ZERO_POLE_SHARE = 1e-6  # of the reach: slower poles are at zero
BEND = np.linspace(0.0, 1.0, 13)[:-1] ** 2  # shares of an interval about the point where two poles meet
JUMP = 0.8  # of the strip: motions of an imaginary part that are jumps of ln(z)
REAL_POLE_TOLERANCE = 1e-9  # of a pole: imaginary parts that are none


def pzmap(source: Any, controller: Any = None, *, axes: Any = None, reach: float | None = None) -> Figure:
    """Draw poles of the closed loop and of the plant, and zeros of L, with rays of damping and circles of frequency.

    Left: all of them; right: those slower than `reach`, on logarithmic axes where they lie decades apart. Sampled
    loops: ln(z) / T, without the poles of pure delay; the unit circle is the imaginary axis, and levels at pi / T are
    the Nyquist frequency.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    axes : one for all poles and one for the slow ones, or one alone for the slow ones; None: a new figure
    reach : rad/s, of the right panel; None: a multiple of the highest crossing of unit gain

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop and for another number of axes.

    >>> import control, malta
    >>> figure = malta.report.pzmap(control.tf([1], [1, 3, 2, 0]))
    >>> figure.axes[0].get_xlabel()
    'real part [rad/s]'
    """
    loops = loops_of(source, controller)
    styles = styles_of(loops)
    drawn = [_finite(curves.poles[of]) for curves in loops.values() for of in ("closed_loop", "plant")]
    everything = np.concatenate(drawn)
    times = [curves.loop.sample_time for curves in loops.values()]
    reaches = _reaches(everything, times, _reach(loops) if reach is None else reach)
    outside = int((np.abs(everything) > 1.001 * reaches[0]).sum())
    told = ["marks of the legend: closed loop"] * (len(loops) > 1)
    told += [f"{outside} faster {'pole' if outside == 1 else 'poles'} outside"] * (outside > 0)
    sheet, reaches = _plane_sheet(
        (f"{title_of(loops)}: poles and zeros", "; ".join(told)), loops, axes, reaches
    )
    for (panel,), size in zip(sheet.panels, reaches, strict=True):
        window = Window.about(everything, size)
        slowest = np.abs(everything[np.abs(everything) > ZERO_POLE_SHARE * size]).min(initial=size)
        wide = panel is sheet.panels[-1][0] and slowest < size / MAX_LINEAR_RANGE
        _draw_plane(panel, window, times, linear=_round(slowest / 2) if wide else None)
        for k, (name, curves) in enumerate(loops.items()):
            look = {"color": styles[name]["color"], "marker": MARKERS[k % len(MARKERS)]}
            _draw_poles(panel, curves, look, window, list(loops.values())[:k])
    own = [("x", "closed loop")] if len(loops) == 1 else []
    _explain(sheet, [*own, ("+", "plant"), ("o", "zero of L")])
    return sheet.figure


def _finite(values: ComplexArray) -> ComplexArray:
    return values[np.isfinite(values)]


def _whole(poles: ComplexArray, times: Sequence[float | None]) -> float:
    """The size of the largest pole, of sampled loops at most STRIP times the Nyquist frequency, rad/s."""
    known = float(np.abs(poles).max(initial=0.0)) or 1.0
    return min([known, *(STRIP * np.pi / T for T in times if T is not None)])


def _reach(loops: Mapping[str, LoopCurves]) -> float:
    """NEAR times the highest crossing of unit gain of the loops; infinite where none crosses."""
    crossings = [c.frequency for curves in loops.values() for m in curves.margins for c in m.gain_crossings]
    return NEAR_RANGE_FACTOR * max(crossings) if crossings else math.inf


def _reaches(poles: ComplexArray, times: Sequence[float | None], slow: float) -> list[float]:
    """The sizes of the panels of all poles and of the slow ones, rad/s; one where they are nearly the same."""
    whole = _whole(poles, times)
    return [whole, slow] if slow < 0.8 * whole else [whole]


class Window(NamedTuple):
    """The part of the plane that a panel shows, rad/s."""

    left: float
    right: float
    height: float  # either way

    @classmethod
    def about(cls, poles: ComplexArray, reach: float) -> Window:
        """The left half plane to a reach, the right one as far as unstable poles, and the highest pole."""
        near = poles[np.abs(poles) <= 1.001 * reach]
        right = max(0.3 * reach, 1.15 * float(near.real.max(initial=0.0)))
        height = max((1.08 * reach + right) / 2, 1.08 * float(np.abs(near.imag).max(initial=0.0)))
        return cls(right - 2 * height, right, height)

    def inside(self, values: ComplexArray) -> ComplexArray:
        """The poles that lie in the window."""
        fine = _finite(values)
        kept = (fine.real > self.left) & (fine.real < self.right) & (np.abs(fine.imag) < self.height)
        return fine[kept]


def _plane_sheet(
    title: tuple[str, str], loops: Mapping[str, LoopCurves], axes: Any, reaches: list[float]
) -> tuple[PlotSheet, list[float]]:
    """A panel for each reach, or the axes of the caller for the last of them."""
    if axes is not None:
        given = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(given) not in (1, 2):
            raise InputError("plot", "axes", str(len(given)), "two, or one for the slow poles")
        figure: Figure = given[0].figure
        return PlotSheet(figure, [(panel,) for panel in given]), [*reaches, reaches[-1]][-len(given) :]
    width, height = 5.6 * len(reaches), 5.0 + head_of(loops)
    figure = new_figure(
        *title, size=(width, height), left=0.8 / width, right=1 - 0.55 / width,
        bottom=0.52 / height, top=1 - (head_of(loops) + 0.25) / height, wspace=0.2,
    )  # fmt: skip
    add_legend(figure, loops, height, MARKERS)
    return PlotSheet(figure, [(panel,) for panel in np.ravel(figure.subplots(1, len(reaches)))]), reaches


def _draw_plane(
    axes: Axes, window: Window, times: Sequence[float | None], linear: float | None = None
) -> None:
    """Axes of equal scale with a grid of damping and frequency, the unstable half grey, and the Nyquist frequency.

    linear : rad/s, beyond which the axes are logarithmic either way; None: nowhere
    """
    left, right, height = window
    reach = -left
    axes.set_xlim(left, right)
    axes.set_ylim(-height, height)
    axes.set_box_aspect(1)
    axes.axvspan(0, right, color="#f3f3f3", zorder=0)
    axes.axvline(0, color="#000000", linewidth=0.9, zorder=1)
    axes.axhline(0, color=GREY, linewidth=0.8, zorder=0.5)
    small: dict[str, Any] = {"fontsize": 7, "color": "#8a8a8a"}
    for damping in DAMPING:
        slope = math.sqrt(1 - damping**2) / damping
        end = min(reach, height / slope)
        along = end * np.append(0, np.geomspace(1e-4, 1, 60))
        for sign in (1, -1):
            axes.plot(-along, sign * slope * along, color=GREY, linewidth=0.8, zorder=0.5)
        if linear is None:
            axes.annotate(f"ζ {damping:g}", (-0.8 * end, 0.8 * slope * end), ha="center", va="center",
                      bbox={"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.3}, **small)  # fmt: skip
    turn = np.linspace(np.pi / 2, 3 * np.pi / 2, 121)
    step = _round(reach / 3)
    circles = np.arange(step, math.hypot(reach, height), step)
    if linear is not None:
        circles = 10.0 ** np.arange(math.ceil(math.log10(linear)), math.log10(math.hypot(reach, height)))
    for radius in circles.tolist():
        x, y = radius * np.cos(turn), radius * np.sin(turn)
        inside = (x > -reach) & (np.abs(y) < height)
        axes.plot(
            np.where(inside, x, np.nan), np.where(inside, y, np.nan), color=GREY, linewidth=0.8, zorder=0.5
        )
    for T in dict.fromkeys(times):
        for level in () if T is None else (np.pi / T, -np.pi / T):
            if abs(level) < height:
                axes.axhline(level, color="#9a9a9a", linestyle=(0, (8, 3)), linewidth=0.9)
    axes.tick_params(labelsize=8)
    for edge in ("top", "right"):
        axes.spines[edge].set_visible(False)
    if linear is None:
        axes.locator_params(nbins=5)
    else:
        _set_logarithmic(axes, linear)
    axes.set_xlabel("real part [rad/s]", fontsize=8.5)
    axes.set_ylabel("imaginary part [rad/s]", fontsize=8.5)
    add_hertz(axes, "right")


def _set_logarithmic(axes: Axes, linear: float) -> None:
    """Make both axes logarithmic either way beyond +-linear, with numbers at decades."""
    from matplotlib.ticker import NullLocator, SymmetricalLogLocator

    for side, limits, set_limits in (
        (axes.xaxis, axes.get_xlim(), axes.set_xlim),
        (axes.yaxis, axes.get_ylim(), axes.set_ylim),
    ):
        getattr(axes, f"set_{side.axis_name}scale")("symlog", linthresh=linear)
        side.set_major_locator(SymmetricalLogLocator(base=10, linthresh=linear))
        side.set_minor_locator(NullLocator())
        set_limits(*limits)


def _round(value: float) -> float:
    """The next number below of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(m for m in (1, 2, 5) if m * power <= value)


def _draw_poles(
    axes: Axes,
    curves: LoopCurves,
    look: Mapping[str, Any],
    window: Window,
    drawn_before: Sequence[LoopCurves],
) -> None:
    """Poles and zeros of one loop that lie within the axes; a plant that stands there already is not drawn again."""
    hollow = {"linestyle": "none", "markerfacecolor": "none", "markeredgewidth": 0.9, "color": look["color"]}
    closed, plant, zeros = curves.poles["closed_loop"], curves.poles["plant"], curves.zeros
    again = any(np.array_equal(plant, before.poles["plant"]) for before in drawn_before)
    for values, own in (
        (closed, {"marker": look["marker"], "markersize": 6.5, "markeredgewidth": 1.4, "zorder": 4}),
        (plant[:0] if again else plant, {"marker": "+", "markersize": 8}),
        (zeros, {"marker": "o", "markersize": 5.5}),
    ):
        shown = window.inside(values)
        if len(shown):
            axes.plot(shown.real, shown.imag, **{**hollow, **own})


def _explain(sheet: PlotSheet, marks: Sequence[tuple[str, str]]) -> None:
    """A legend of the markers above the last panel."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=m,
            color="#000000",
            markerfacecolor="none" if m == "o" else "#000000",
        )
        for m, _ in marks
    ]
    sheet.panels[-1][0].legend(
        handles, [text for _, text in marks], ncols=len(marks), loc="lower right", bbox_to_anchor=(1, 1),
        frameon=False, fontsize=8, handletextpad=0.1, columnspacing=1.2, borderaxespad=0.2,
    )  # fmt: skip


def root_locus(
    source: Any,
    controller: Any = None,
    *,
    parameter: str = GAIN,
    span: tuple[float, float] | None = None,
    channel: str | None = None,
    at: Place = "sensors",
    axes: Any = None,
) -> Figure:
    """Draw closed-loop poles over a parameter of the machine or over the loop gain, every branch a line.

    Small circles: the lowest value; triangles: the highest; crosses: the nominal machine. Text: the values at which the
    loop becomes stable or unstable.

    source : one loop: a plant; LoopSystems; a system of python-control, L or P; or a RootLocus
    controller : of the plant, the system C, or the curves of the RootLocus's loop; None: the source has it
    parameter : of the machine, by name; or "gain", a factor of the loop gain
    span : lowest and highest value of the parameter, SI; None: half and one and a half of its nominal value, of the
        gain 0.1 and 10
    channel : whose gain is changed; None: all
    at : where the gain is changed, "sensors" or "forces"
    axes : one for all poles and one for the slow ones, or one alone for the slow ones; None: a new figure

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for an unknown parameter, an invalid range, and a value that the machine cannot have.

    >>> import control, malta
    >>> servo = control.tf([1], [1, 3, 2, 0], name="servo")
    >>> figure = malta.report.root_locus(servo, span=(1, 10))
    >>> figure.get_suptitle()
    'servo: root locus over the loop gain, 1 … 10'
    """
    found = source
    if not isinstance(source, RootLocus):
        found = locus_of(source, controller, parameter=parameter, span=span, channel=channel, at=at)
    unit = "" if found.unit == "1" else f" {found.unit}"
    gain = f"the gain of {found.channel}" if found.channel else "the loop gain"
    what = gain if found.parameter == GAIN else found.parameter
    ends = f"{found.values[0]:.4g} … {found.values[-1]:.4g}{unit}"
    title = plain(f"{found.name}: root locus over {what}, {ends}"), plain(_changes_text(found, unit))
    loop = controller if isinstance(source, RootLocus) else loop_curves(source, controller)
    slow = math.inf if loop is None else _reach({"": loop})
    drawn, times = _finite(found.poles.ravel()), [found.sample_time]
    sheet, reaches = _plane_sheet(title, {}, axes, _reaches(drawn, times, slow))
    for (panel,), size in zip(sheet.panels, reaches, strict=True):
        window = Window.about(drawn, size)
        _draw_plane(panel, window, times)
        _draw_branches(panel, found, window)
    _explain(sheet, [("o", "lowest value"), ("x", "nominal"), (">", "highest value")])
    return sheet.figure


def _changes_text(found: RootLocus, unit: str) -> str:
    """What becomes of stability over the range."""
    if found.changes:
        values = ", ".join(f"{number(value)}{unit}" for value in found.changes)
        return f"stability changes at {found.parameter} = {values}"
    stable = bool((found.poles[0][np.isfinite(found.poles[0])].real < 0).all())
    return f"{'stable' if stable else 'UNSTABLE'} over the whole range"


def _draw_branches(axes: Axes, found: RootLocus, window: Window) -> None:
    """Every branch, through the points where pairs meet and part; poles at the edge of the strip are at both edges."""
    strip = math.inf if found.sample_time is None else math.pi / found.sample_time
    for line in branch_paths(found):
        edge = np.where(
            np.abs(line.imag) > (1 - REAL_POLE_TOLERANCE) * strip, line.conj(), complex(np.nan, np.nan)
        )
        for path in (line, edge):
            if np.isfinite(path).any():
                axes.plot(path.real, path.imag, color="#000000", linewidth=1.1, zorder=3)
    colour = "#c1440e"
    drawn: tuple[tuple[ComplexArray, dict[str, Any]], ...] = (
        (
            found.poles[0],
            {"marker": "o", "markersize": 4.5, "markerfacecolor": "#ffffff", "color": "#000000"},
        ),
        (found.poles[-1], {"marker": ">", "markersize": 4.5, "color": "#000000"}),
        (found.nominal_poles, {"marker": "x", "markersize": 6.5, "markeredgewidth": 1.6, "color": colour}),
    )
    for values, look in drawn:
        shown = window.inside(values)
        axes.plot(shown.real, shown.imag, linestyle="none", zorder=4, **look)


def branch_paths(found: RootLocus) -> list[ComplexArray]:
    """The branches as lines, with the points between samples where two poles meet or part, NaN where ln(z) jumps.

    The mean of two such poles and the square of half their difference are smooth in the parameter, and their straight
    lines between two samples are the branches there: the poles leave the real axis at a right angle. Sampled poles
    next to pure delay, `|z| < 0.02`, are left out: they turn about z = 0 from one sample to the next.
    """
    T = found.sample_time
    strip = math.inf if T is None else math.pi / T
    lines = [[complex(pole)] for pole in found.poles[0]]
    columns = list(range(len(lines)))  # of the samples, in which each line is
    for before, after in pairwise(found.poles):
        meeting = _meeting_points(before, after, strip)
        parting = {
            real: (pair, path[::-1]) for pair, (real, path) in _meeting_points(after, before, strip).items()
        }
        between = meeting | parting
        for k, line in enumerate(lines):
            columns[k], path = between.get(columns[k], (columns[k], ()))
            line += [*path, complex(after[columns[k]])]
    paths = [np.array(line) for line in lines]
    if T is not None:
        paths = [np.where(path.real < math.log(DELAY) / T, complex(np.nan, np.nan), path) for path in paths]
    return [_cut(path, strip) for path in paths if np.isfinite(path).any()]


def _meeting_points(
    pairs: ComplexArray, real: ComplexArray, strip: float
) -> dict[int, tuple[int, ComplexArray]]:
    """The real poles that conjugate pairs become, and points on the way, by branch; real: or on the strip's edge."""
    edge, flat = (_is_flat(poles, strip) for poles in (real, pairs))
    on_edge = np.abs(real.imag) > strip / 2
    turned = edge & ~flat
    twins: dict[int, int] = {}
    for i in np.flatnonzero(turned & (pairs.imag > 0)).tolist():
        left = [j for j in np.flatnonzero(turned & (pairs.imag < 0)).tolist() if j not in twins.values()]
        if left:
            twins[i] = min(left, key=lambda k: abs(pairs[k] - pairs[i].conj()))
    ends = _ends_of_alike(pairs, real, twins)
    found: dict[int, tuple[int, ComplexArray]] = {}
    for i, j in twins.items():
        lift = 1j * strip if on_edge[i] else 0.0  # the edge becomes the real axis
        start, (one, other) = pairs[i] - lift, (real[k].real for k in ends[i])
        before, after = -(start.imag**2), (one - other) ** 2 / 4  # squares of half the difference
        meets = before / (before - after) if after > 0 else 1.0  # share of the interval
        shares = np.concatenate([meets * (1 - BEND[::-1]), meets + (1 - meets) * BEND[1:]])
        middle = start.real + shares * ((one + other) / 2 - start.real)
        half = np.sqrt(np.abs(before + shares * (after - before)))
        paired = shares <= meets
        upper = np.where(paired, 1j * np.sign(start.imag), np.sign(one - other)) * half
        found[i] = ends[i][0], middle + upper + lift
        found[j] = ends[i][1], middle + np.where(paired, upper.conj() - lift, lift - upper)
    return found


def _ends_of_alike(
    pairs: ComplexArray, real: ComplexArray, twins: Mapping[int, int]
) -> dict[int, tuple[int, int]]:
    """The two real poles that each pair becomes, by branch.

    Of pairs that are alike, as of axes that nearly agree, the one that is lowest above the axis parts first and
    furthest: it gets the outermost of their real poles.
    """
    ends: dict[int, tuple[int, int]] = {}
    left = sorted(twins, key=lambda i: pairs[i].imag)
    while left:
        i, j = left[0], twins[left[0]]
        reach = abs(pairs[i].imag) + abs(real[i].real - real[j].real)
        alike = [k for k in left if abs(pairs[k] - pairs[i]) < reach]
        poles = sorted((one for k in alike for one in (k, twins[k])), key=lambda one: real[one].real)
        ends |= {k: (poles[-1 - n], poles[n]) for n, k in enumerate(alike)}
        left = [k for k in left if k not in alike]
    return ends


def _is_flat(poles: ComplexArray, strip: float) -> NDArray[np.bool_]:
    """Whether poles are real, or those of sampled loops real and negative in z, up to rounding."""
    height = np.abs(poles.imag)
    return (height <= REAL_POLE_TOLERANCE * np.abs(poles)) | (height >= (1 - REAL_POLE_TOLERANCE) * strip)


def _cut(line: ComplexArray, strip: float) -> ComplexArray:
    """A line that is interrupted where ln(z) jumps: across the strip, or from its middle to its edge through z = 0."""
    jumps = np.flatnonzero(np.abs(np.diff(line.imag)) > JUMP * strip)
    return np.insert(line, jumps + 1, complex(np.nan, np.nan))
