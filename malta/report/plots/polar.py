"""Nyquist and Nichols plots of the loop gain with the margins drawn in, and the margin map.

The margin map shows the proven box in the plane of two parameters, and the boundary of stability.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.bound import at_least
from malta.errors import InputError
from malta.margins.margin_map import MarginMap, Others, margin_map_of
from malta.report.figures.drawing import BOUND_LINE, BOUND_STYLE, LEGEND, NOTE, draw_grid, new_figure
from malta.report.plots.frequency import ONE_LOOP, Channel, fails_peak, phase_of, title_of
from malta.report.plots.panels import (
    CLEAR_BOX,
    FORBIDDEN,
    LIMIT_LINE,
    PLACES,
    chosen_channels,
    decibels,
    limit_text,
    loops_of,
    loops_with_channel,
    margins_text,
    mark,
    new_sheet,
    plain,
    region_styles,
    styles_of,
    thin,
    write_above,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.arrays import ComplexArray, FloatArray
    from malta.campaigns.result import Campaign
    from malta.campaigns.summary import Summary
    from malta.loops.channel_margins import ChannelMargins
    from malta.loops.linear_loops import Place
    from malta.synthesis.curve_limits import CurveLimit

Window = tuple[float, float, float]  # left and right end, and half of the height

MAX_LEFT_REACH = 4.0  # how far left of the origin a Nyquist plot reaches at most
M_CIRCLES = (12.0, 6.0, 3.0, 1.0, 0.0, -3.0, -6.0, -12.0)  # dB of |T|
LEADER = {"arrowstyle": "-", "linewidth": 0.6, "color": FORBIDDEN, "shrinkA": 0, "shrinkB": 0}
HEIGHTS = (-45.0, 60.0)  # dB, of a Nichols plot


def nyquist(
    source: Any,
    controller: Any = None,
    *,
    channel: Channel = None,
    at: Place = "sensors",
    axes: Any = None,
    limits: Sequence[CurveLimit] = (),
) -> Figure:
    """Draw the Nyquist plot of the loop gain of each channel, the others closed.

    Thin: negative frequencies. Dotted about -1: the circle of radius `1 / max|S|`, which the curve touches. Grey: the
    circle of the symmetric disk margin, which the curve does not enter. Dots: where margins of gain and phase are read.
    N: counterclockwise turns about -1; P: unstable poles with this channel open. The loop is stable where they agree.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : the channel or channels, by name; None: all
    at : where the loop is cut, "sensors" or "forces"
    axes : one for each channel; None: a new figure
    limits : regions that requirements exclude, from `malta.synthesis.curve_limits`

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import control, malta
    >>> figure = malta.report.nyquist(control.tf([3], [1, -1]))  # stable: N = P = 1
    >>> figure.axes[0].texts[-1].get_text()
    'GM −9.5 … ∞, PM 70.5°, N 1, P 1'
    """
    loops = loops_of(source, controller)
    chosen, styles = chosen_channels(loops, channel, at), styles_of(loops)
    title = f"{title_of(loops)}: Nyquist plot {PLACES[at]}", f"{ONE_LOOP}; N turns about −1, P unstable poles"
    sheet = new_sheet(title, loops, len(chosen), axes, height=3.3)
    for (name, _), (panel,) in zip(chosen, sheet.panels, strict=True):
        found = list(loops_with_channel(loops, name, at))
        window = _window([margins for *_, margins in found])
        _draw_circles(panel)
        lines = []
        gains: list[ComplexArray] = []
        for loop, curves, k, margins in found:
            style = styles[loop]
            gain = _inside(curves.responses.alone(at)[:, k], window)
            curve: Any = panel.plot(gain.real, gain.imag, **style)[0]
            curve.frequencies = curves.w, gain  # for a page, which tells them under the pointer
            panel.plot(gain.real, -gain.imag, **{**style, "linewidth": 0.6}, gid=BOUND_LINE)
            _draw_direction(panel, gain, style)
            _draw_margins(panel, margins, style, window)
            lines.append((margins_text(margins, turns=True), style["color"]))
            gains.append(gain)
        for limit in limits if at == "sensors" else ():
            if limit.curve == "S":
                _draw_exclusion(panel, limit, window, gains, fails=fails_peak(loops, name, limit))
        panel.set_xlim(window[0], window[1])
        panel.set_ylim(-window[2], window[2])
        panel.set_aspect("equal", adjustable="box")
        draw_grid(panel)
        panel.tick_params(labelsize=8)
        panel.set_xlabel("real part of L [-]", fontsize=8.5)
        panel.set_ylabel("imaginary part of L [-]", fontsize=8.5)
        write_above(panel, name, lines)
    return sheet.figure


def _draw_exclusion(
    axes: Axes, limit: CurveLimit, window: Window, curves: Sequence[ComplexArray], *, fails: bool
) -> None:
    """The disk about -1 that a bound of `|S|` keeps a loop out of, and its name where no curve passes."""
    radius, turn = 1 / limit.limit, np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    for style in region_styles(fails=fails):
        axes.fill(-1 + radius * turn.real, radius * turn.imag, **style)
    axes.plot(-1 + radius * turn.real, radius * turn.imag, **LIMIT_LINE)
    text = f"{limit.words} {'FAILS' if fails else 'asked'}"
    place = _free_place(window, radius, (0.021 * len(text), 0.05), curves)
    towards = place + 1
    axes.annotate(
        text, (-1 + radius * towards.real / abs(towards), radius * towards.imag / abs(towards)),
        xytext=(place.real, place.imag), va="center", ha="center", zorder=6, arrowprops=LEADER,
        **limit_text(fails=fails),
    )  # fmt: skip


def _free_place(
    window: Window, radius: float, share: tuple[float, float], curves: Sequence[ComplexArray]
) -> complex:
    """The middle of a text of this share of a window that lies on no curve: at the disk about -1, else in a corner."""
    left, right, high = window
    half = complex(share[0] * (right - left) / 2, share[1] * high)
    low = -radius - 1.4 * half.imag
    ends = [left + 1.1 * half.real, right - 1.1 * half.real]
    corners = [complex(x, y) for x in ends[::-1] for y in (1.6 * half.imag - high, high - 1.6 * half.imag)]
    places = [complex(-1, low), complex(-1, -low), *corners]
    steps = np.linspace(0, 1, 20)[:, None]
    upper = np.concatenate([np.ravel(c[:-1] + steps * np.diff(c)) for c in curves])
    points = np.concatenate([upper, upper.conj()])

    def covered(place: complex) -> int:
        away = points - place
        return int(((np.abs(away.real) < half.real) & (np.abs(away.imag) < half.imag)).sum())

    free = [place for place in places if left < place.real - half.real and not covered(place)]
    return free[0] if free else min(places, key=covered)


def _window(found: list[ChannelMargins]) -> Window:
    """Left and right end and half the height: the unit circle, and gain margins within MAX_LEFT_REACH."""
    left = -1.9
    for margins in found:
        half = margins.disk.size / 2
        if half < 1:
            left = min(left, max(-1.05 * (1 + half) / (1 - half), -MAX_LEFT_REACH))
        places = [1 / k for k in margins.gain if 0 < k < math.inf]
        left = min([left, *(-1.2 * place for place in places if place < MAX_LEFT_REACH / 1.2)])
    right = 1.3
    return left, right, max(1.3, (right - left) / 2)


def _inside(gain: ComplexArray, window: Window) -> ComplexArray:
    """The curve without what lies far outside of the window; NaN interrupts the line."""
    reach = 4 * max(abs(window[0]), window[2])
    return np.asarray(np.where(np.abs(gain) < reach, gain, complex(np.nan, np.nan)))


def _draw_circles(axes: Axes) -> None:
    """The unit circle, the axes and the critical point."""
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    axes.plot(turn.real, turn.imag, gid=BOUND_LINE, **BOUND_STYLE)
    axes.axhline(0, color="#c8c8c8", linewidth=0.6)
    axes.axvline(0, color="#c8c8c8", linewidth=0.6)
    axes.plot(-1, 0, marker="+", markersize=10, markeredgewidth=1.8, color="#000000", zorder=5)


def _draw_direction(axes: Axes, gain: ComplexArray, style: Mapping[str, Any]) -> None:
    """An arrow of rising frequency where the curve is nearest to the unit circle, if it comes near."""
    far = np.abs(np.log(np.maximum(np.abs(np.nan_to_num(gain, nan=1e9)), 1e-300)))
    k = min(max(int(far.argmin()), 1), len(gain) - 2)
    here, after = complex(gain[k]), complex(gain[k + 1])
    if not far[k] < 1 or not np.isfinite([here, after]).all() or here == after:
        return
    ahead = here + 0.02 * (after - here) / abs(after - here)
    axes.annotate(
        "", (ahead.real, ahead.imag), xytext=(here.real, here.imag),
        arrowprops={"arrowstyle": "-|>", "color": style["color"], "lw": 1.0, "mutation_scale": 11},
    )  # fmt: skip


def _draw_margins(axes: Axes, found: ChannelMargins, style: Mapping[str, Any], window: Window) -> None:
    """The circles of max|S| and of the disk margin, and the crossings at which margins are read."""
    if not found.stable:
        return
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    near = -1 + turn / found.peak_sensitivity
    axes.plot(near.real, near.imag, gid=BOUND_LINE, **{**thin(style), "linestyle": (0, (1, 1.5))})
    half = found.disk.size / 2
    if half < 1:  # -1 / f for the factors f = (1 + d) / (1 - d) with |d| <= half
        ends = -(1 + half) / (1 - half), -(1 - half) / (1 + half)
        disk = sum(ends) / 2 + turn * (ends[1] - ends[0]) / 2
        axes.fill(disk.real, disk.imag, color="#000000", alpha=0.07, linewidth=0)
    for factor in found.gain:
        if 0 < factor < math.inf and -1 / factor > window[0]:
            mark(axes, -1 / factor, 0, style)
    for crossing in found.gain_crossings:
        if crossing.frequency == found.phase_frequency:
            mark(axes, crossing.value.real, crossing.value.imag, style, markerfacecolor="#ffffff")
            axes.plot([0, crossing.value.real], [0, crossing.value.imag], **thin(style) | {"linewidth": 0.6})


def nichols(
    source: Any, controller: Any = None, *, channel: Channel = None, at: Place = "sensors", axes: Any = None
) -> Figure:
    """Draw the Nichols chart of the loop gain of each channel, the others closed, on curves of equal `|T|`.

    Crosses: the critical points, 0 dB at -180 degrees and a turn away. Segments from there: the margins of gain,
    upright, and of phase, level.

    source : a plant; LoopSystems; a system of python-control, the loop gain L of negative feedback or the plant P of
        L = P C; or a table name -> loop, where a pair is a tuple
    controller : of the plant, or the system C; None: the source has it
    channel : the channel or channels, by name; None: all
    at : where the loop is cut, "sensors" or "forces"
    axes : one for each channel; None: a new figure

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for what is no loop, for an unknown channel and another number of axes.

    >>> import control, malta
    >>> figure = malta.report.nichols(control.tf([1], [1, 3, 2, 0]))
    >>> figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    ('phase of L [°]', 'magnitude of L [dB]')
    """
    loops = loops_of(source, controller)
    chosen, styles = chosen_channels(loops, channel, at), styles_of(loops)
    title = f"{title_of(loops)}: Nichols chart {PLACES[at]}", f"{ONE_LOOP}; light: |T|"
    sheet = new_sheet(title, loops, len(chosen), axes, height=3.3)
    for (name, _), (panel,) in zip(chosen, sheet.panels, strict=True):
        lines, phases = [], []
        for loop, curves, k, margins in loops_with_channel(loops, name, at):
            gain, style = curves.responses.alone(at)[:, k], styles[loop]
            phase, size = phase_of(curves.w, gain), decibels(gain)
            shown = (size > HEIGHTS[0]) & (size < HEIGHTS[1])
            panel.plot(np.where(shown, phase, np.nan), np.where(shown, size, np.nan), **style)
            _draw_nichols_margins(panel, curves.w, phase, margins, style)
            phases.append(phase[shown])
            lines.append((margins_text(margins), style["color"]))
        _finish_nichols(panel, np.concatenate(phases))
        write_above(panel, name, lines)
    return sheet.figure


def _draw_nichols_margins(
    axes: Axes, w: FloatArray, phase: FloatArray, found: ChannelMargins, style: Mapping[str, Any]
) -> None:
    def critical(frequency: float) -> tuple[float, float]:
        """The phase at a frequency, and that of the critical point next to it."""
        here = float(np.interp(math.log(max(frequency, w[0])), np.log(w), phase))
        return here, 360 * round((here + 180) / 360) - 180.0

    for factor, frequency in zip(found.gain, found.gain_frequency, strict=True):
        if 0 < factor < math.inf:
            _, at = critical(frequency)
            level = float(np.clip(-20 * math.log10(factor), *HEIGHTS))
            axes.plot([at, at], [0, level], **thin(style))
            mark(axes, at, level, style)
    if math.isfinite(found.phase):
        here, at = critical(found.phase_frequency)
        axes.plot([at, here], [0, 0], **thin(style))
        mark(axes, here, 0, style, markerfacecolor="#ffffff")


def _finish_nichols(axes: Axes, phases: FloatArray) -> None:
    """Curves of equal |T|, critical points, and axes in quarter turns about them."""
    from matplotlib.ticker import MultipleLocator

    known = phases[np.isfinite(phases)]
    low = 90 * math.floor(min(float(known.min(initial=-180.0)), -225) / 90)
    high = 90 * math.ceil(max(float(known.max(initial=-180.0)), -135) / 90)
    low, high = max(low, -720), min(high, 360)
    axes.set_xlim(low, high)
    axes.set_ylim(*HEIGHTS)
    angle = np.linspace(1e-3, 2 * np.pi - 1e-3, 400)
    for k in range(math.floor(low / 360), math.ceil(high / 360) + 1):
        for level in M_CIRCLES:
            T = 10 ** (level / 20) * np.exp(1j * angle)
            L = T / (1 - T)
            x = np.degrees(np.mod(np.angle(L), 2 * np.pi)) - 360 + 360 * k
            x = np.where(np.abs(np.diff(x, append=x[-1])) > 180, np.nan, x)
            if np.nanmax(x) > low and np.nanmin(x) < high:
                axes.plot(x, decibels(L), color="#d6d6d6", linewidth=0.7, zorder=1)
        if low <= 360 * k - 180 <= high:
            axes.plot(
                360 * k - 180, 0, marker="+", markersize=10, markeredgewidth=1.8, color="#000000", zorder=5
            )
    _name_circles(axes, low, high)
    axes.xaxis.set_major_locator(MultipleLocator(90 if high - low <= 540 else 180))
    axes.tick_params(labelsize=8)
    for edge in ("top", "right"):
        axes.spines[edge].set_visible(False)
    axes.set_xlabel("phase of L [°]", fontsize=8.5)
    axes.set_ylabel("magnitude of L [dB]", fontsize=8.5)


def _name_circles(axes: Axes, low: float, high: float) -> None:
    """What |T| is: beside the closed curves about the first critical point, and at the left end of the open ones."""
    at = next(p for p in (-180.0, -540.0, 180.0) if low <= p <= high)
    where: dict[str, Any] = {
        "textcoords": "offset points",
        "zorder": 1.5,
        "color": "#8a8a8a",
        "fontsize": 7,
        "bbox": CLEAR_BOX,
    }
    for level in (6.0, 1.0):
        size = 10 ** (level / 20)
        reach, height = math.degrees(math.asin(1 / size)), 10 * math.log10(size**2 / (size**2 - 1))
        if at - reach > low:
            axes.annotate(
                f"{level:g} dB", (at - reach, height), xytext=(-2, 0), ha="right", va="center", **where
            )
    for level in (-3.0, -6.0, -12.0):
        size, turn = 10 ** (level / 20), math.cos(math.radians(low))
        # |L| on |T| = M at phase low: x^2 (1 - M^2) - 2 M^2 cos(low) x - M^2 = 0
        x = (size**2 * turn + size * math.sqrt(1 - size**2 * (1 - turn**2))) / (1 - size**2)
        axes.annotate(f"{level:g} dB", (low, 20 * math.log10(x)), xytext=(2, 1), va="bottom", **where)


UNSTABLE_STYLE: dict[str, Any] = {"colors": ["#b0b0b0"], "zorder": 0}
PROVEN_STYLE: dict[str, Any] = {"facecolor": "#cfe3f5", "edgecolor": "#1f77b4", "linewidth": 1.6, "zorder": 2}
BOX: dict[str, Any] = {"facecolor": "none", "edgecolor": "#000000", "linestyle": (0, (5, 2)), "zorder": 3}
NOMINAL_STYLE: dict[str, Any] = {
    "marker": "+",
    "markersize": 10,
    "color": "#000000",
    "linestyle": "none",
    "zorder": 5,
}
WITNESS: dict[str, Any] = {
    "marker": "X", "markersize": 9, "color": "#c1440e", "markeredgecolor": "#ffffff", "linestyle": "none", "zorder": 6,
}  # fmt: skip
RUNS: tuple[tuple[str, dict[str, Any]], ...] = (
    (
        "run completed",
        {"marker": "o", "markersize": 2.6, "color": "#5a5a5a", "linestyle": "none", "zorder": 4},
    ),
    ("run failed", {"marker": "v", "markersize": 5, "color": "#c1440e", "linestyle": "none", "zorder": 4.5}),
)


def margin_map(
    source: Any,
    controller: Any = None,
    *,
    x: str = "",
    y: str = "",
    uncertainty: Mapping[str, float] | None = None,
    others: Others = "box",
    campaigns: Sequence[Campaign | Summary] = (),
    axes: Any = None,
) -> Figure:
    """Draw the plane of two parameters: the proven box, the boundary of stability by eigenvalues, the lost machine.

    Every machine in the blue box is proven stable, anywhere in the travel. Grey: unstable, by eigenvalues on a grid,
    which prove nothing. The box of 100 % is dashed. The cross is a machine at the limit of stability. At each point
    the other uncertain parameters are anywhere in the box, times the multiple at which the point lies.

    source : a plant, or a MarginMap
    controller : of the plant
    x, y : parameters of the axes; "": the first two of `uncertainty`
    uncertainty : relative half range of each parameter, as {"m": 0.2, "K_A": 0.2}
    others : what the parameters are that are not drawn: "box", anywhere in the box as `malta.verify` proves, or
        "nominal"
    campaigns : whose runs are dots, where they vary x or y; of a summary those that it keeps
    axes : one; None: a new figure

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for parameters that are not uncertain, fewer than two of them, and several axes.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.margin_map(
    ...     spec.plant, controller, uncertainty={"m": 0.2, "C": 0.2}
    ... )
    >>> figure.axes[0].get_xlabel()
    'mass of the sphere m [kg]'
    """
    found = source
    if not isinstance(source, MarginMap):
        box = dict(uncertainty or {})
        if len(box) < 2:
            raise InputError("margin map", "uncertainty", f"{len(box)} parameters", "two at least")
        first = [name for name in box if name not in (x, y)]
        x = x or first.pop(0)
        y = y or next((name for name in first if name != x), "")
        found = margin_map_of(source, controller, (x, y), box, others=others)
    if axes is None:
        figure = new_figure(
            *_titles(found), size=(7.2, 6.1), left=0.115, right=0.975, bottom=0.095, top=0.795
        )
        panel = figure.subplots()
    else:
        given = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(given) != 1:
            raise InputError("plot", "axes", str(len(given)), "one")
        panel, figure = given[0], given[0].figure
    handles = {handle.get_label(): handle for handle in _draw_map(panel, found)}
    for one in campaigns:
        handles |= {handle.get_label(): handle for handle in _draw_runs(panel, found, one)}
    where: dict[str, Any] = {"ncols": 3, "loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
    panel.legend(handles=list(handles.values()), **where, **LEGEND)
    _finish(panel, found)
    return figure


def _titles(found: MarginMap) -> tuple[str, str]:
    """The title, and the margin in words."""
    title = plain(f"{found.name}: margin map over {found.words[0]} and {found.words[1]}")
    beside = plain(found.beside_text and f", {found.beside_text}")
    if found.margin is None:
        return title, f"nothing proven: the proof was left out{beside}"
    if not found.proven:
        return title, f"nothing proven: {found.margin.reason}"[:110] + beside
    by = "" if found.witness is not None else " by others"
    lost = "" if found.margin.exhausted else f", lost at {found.margin.lost.percent()}{by}"
    text = f"proven {found.margin.proven.percent()} of the box{lost} {found.where}{beside}"
    return title, plain(" ".join(text.split()))


def _draw_map(axes: Axes, found: MarginMap) -> list[Any]:
    """The unstable region, its boundary, the boxes, the nominal machine and the witness; handles of a legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, Rectangle

    X, Y, growth = found.x_values, found.y_values, found.growth
    if growth.max() > 0:
        axes.contourf(X, Y, growth, levels=[0.0, math.inf], **UNSTABLE_STYLE)
        if growth.min() < 0:
            axes.contour(X, Y, growth, levels=[0.0], colors=["#000000"], linewidths=1.4, zorder=3)
    handles: list[Any] = []
    for share, look, label in (
        (found.proven, PROVEN_STYLE, f"proven, {at_least(found.proven).percent()}"),
        (1.0, BOX, "box, 100 %"),
    ):
        if share and math.isfinite(share):
            corner = [m - share * h for m, h in zip(found.nominal, found.half, strict=True)]
            axes.add_patch(Rectangle((corner[0], corner[1]), *(2 * share * h for h in found.half), **look))
            handles.append(Patch(label=label, **look))
    handles.append(Line2D([], [], color="#000000", linewidth=1.4, label="boundary by eigenvalues"))
    handles.append(Patch(facecolor="#b0b0b0", label="unstable"))
    handles += axes.plot(*found.nominal, label="nominal", **NOMINAL_STYLE)
    if found.witness is not None:
        moved = " (others moved too)" if found.beside and found.others == "box" else ""
        handles += axes.plot(*found.witness, label=f"lost{moved}", **WITNESS)
    return handles


def _draw_runs(axes: Axes, found: MarginMap, campaign: Campaign | Summary) -> Iterator[Any]:
    """The machines of a campaign, by whether their runs were completed; handles of a legend."""
    for (label, look), points in zip(RUNS, _runs_of(found, campaign), strict=True):
        if len(points):
            yield from axes.plot(points[:, 0], points[:, 1], label=label, **look)


def _runs_of(found: MarginMap, campaign: Campaign | Summary) -> Iterator[FloatArray]:
    """Values of x and y of the completed runs, then of the others; a parameter that was not varied is nominal."""
    from malta.campaigns.plan import varied_names
    from malta.campaigns.summary import Summary

    runs = campaign.kept if isinstance(campaign, Summary) else campaign
    known = list(varied_names(campaign.plan))
    columns = [
        runs.values[:, known.index(name)] if name in known else np.full(len(runs.values), nominal)
        for name, nominal in zip((found.x, found.y), found.nominal, strict=True)
    ]
    points, completed = np.column_stack(columns), runs.batch.completed == 1
    varied = any(name in known for name in (found.x, found.y))
    for chosen in (completed, ~completed):
        yield points[chosen] if varied else points[:0]


def _multiple_text(size: float, v: float, _: int) -> str:
    """The number at a tick in multiples of a power of ten."""
    return f"{v / size:g}"


MAX_PLAIN_POWER = 3  # of ten, either way, without which numbers at an axis are written


def _finish(axes: Axes, found: MarginMap) -> None:
    """Axes as wide as the grid, with units, and a power of ten with these where numbers would be long."""
    axes.set_xlim(found.x_values[0], found.x_values[-1])
    axes.set_ylim(found.y_values[0], found.y_values[-1])
    for axis, name, unit, values in (
        (axes.xaxis, found.words[0], found.units[0], found.x_values),
        (axes.yaxis, found.words[1], found.units[1], found.y_values),
    ):
        power = 3 * math.floor(math.log10(max(abs(float(values[0])), abs(float(values[-1])), 1e-300)) / 3)
        own = [] if unit == "1" else [unit]
        if abs(power) > MAX_PLAIN_POWER:
            axis.set_major_formatter(partial(_multiple_text, 10.0**power))
            own.insert(0, f"1e{power}")
        axis.set_label_text(plain(f"{name} [{' '.join(own) or '-'}]"))
    draw_grid(axes)
    if not found.growth.max() > 0:
        axes.annotate(
            "stable all over the map",
            (0.985, 0.015),
            xycoords="axes fraction",
            ha="right",
            va="bottom",
            **NOTE,
        )
