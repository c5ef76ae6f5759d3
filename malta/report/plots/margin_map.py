"""The margin map as a figure: the proven box in the plane of two parameters, and the boundary of stability."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.display import ceil_to, floor_to
from malta.errors import InputError
from malta.margins.margin_map import MarginMap, margin_map_of
from malta.report.figures.drawing import LEGEND, NOTE, draw_grid, new_figure
from malta.report.plots.panels import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.result import Campaign
    from malta.campaigns.summary import Summary
    from malta.model.plant import FloatArray

UNSTABLE: dict[str, Any] = {"colors": ["#b0b0b0"], "zorder": 0}
PROVEN: dict[str, Any] = {"facecolor": "#cfe3f5", "edgecolor": "#1f77b4", "linewidth": 1.6, "zorder": 2}
BOX: dict[str, Any] = {"facecolor": "none", "edgecolor": "#000000", "linestyle": (0, (5, 2)), "zorder": 3}
NOMINAL: dict[str, Any] = {
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
    campaigns: Sequence[Campaign | Summary] = (),
    axes: Any = None,
) -> Figure:
    """Draw the plane of two parameters: the proven box, the boundary of stability by eigenvalues, the witness.

    Every machine in the blue box is proven stable, anywhere in the travel. Grey: unstable, by eigenvalues on a grid,
    which prove nothing. The box of 100 % is dashed. The cross is the witness, a machine at the limit of stability.

    source : a plant, or a MarginMap
    controller : of the plant
    x, y : parameters of the axes; "": the first two of `uncertainty`
    uncertainty : relative half range of each parameter, as {"m": 0.2, "K_A": 0.2}
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
    'm [kg]'
    """
    found = source
    if not isinstance(source, MarginMap):
        box = dict(uncertainty or {})
        if len(box) < 2:
            raise InputError("margin map", "uncertainty", f"{len(box)} parameters", "two at least")
        first = [name for name in box if name not in (x, y)]
        x = x or first.pop(0)
        y = y or next((name for name in first if name != x), "")
        found = margin_map_of(source, controller, (x, y), box)
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
    title = plain(f"{found.name}: margin map over {found.x} and {found.y}")
    if found.margin is None:
        return title, "nothing proven: the proof was left out"
    if not found.proven:
        return title, f"nothing proven: {found.margin.reason}"[:110]
    others = [name for name in found.parameters if name not in (found.x, found.y)]
    beside = f", with {' '.join(others)} anywhere in the box" if others else ""
    lost = "" if found.margin.exhausted else f", lost at {ceil_to(100 * found.margin.upper, 1):g} %"
    text = f"proven {floor_to(100 * found.proven, 1):g} % of the box{lost} {found.where}{beside}"
    return title, plain(" ".join(text.split()))


def _draw_map(axes: Axes, found: MarginMap) -> list[Any]:
    """The unstable region, its boundary, the boxes, the nominal machine and the witness; handles of a legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, Rectangle

    X, Y, growth = found.x_values, found.y_values, found.growth
    if growth.max() > 0:
        axes.contourf(X, Y, growth, levels=[0.0, math.inf], **UNSTABLE)
        if growth.min() < 0:
            axes.contour(X, Y, growth, levels=[0.0], colors=["#000000"], linewidths=1.4, zorder=3)
    handles: list[Any] = []
    for share, look, label in (
        (found.proven, PROVEN, f"proven, {floor_to(100 * found.proven, 1):g} %"),
        (1.0, BOX, "box, 100 %"),
    ):
        if share:
            corner = [m - share * h for m, h in zip(found.nominal, found.half, strict=True)]
            axes.add_patch(Rectangle((corner[0], corner[1]), *(2 * share * h for h in found.half), **look))
            handles.append(Patch(label=label, **look))
    handles.append(Line2D([], [], color="#000000", linewidth=1.4, label="boundary by eigenvalues"))
    handles.append(Patch(facecolor="#b0b0b0", label="unstable"))
    handles += axes.plot(*found.nominal, label="nominal", **NOMINAL)
    if found.witness is not None:
        others = [name for name in found.parameters if name not in (found.x, found.y)]
        label = f"witness ({' '.join(others)} moved too)" if others else "witness"
        hollow = {"markerfacecolor": "none", "markeredgecolor": "#c1440e"} if others else {}
        handles += axes.plot(*found.witness, label=label, **WITNESS | hollow)
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


def _finish(axes: Axes, found: MarginMap) -> None:
    """Axes as wide as the grid, with units."""
    axes.set_xlim(found.x_values[0], found.x_values[-1])
    axes.set_ylim(found.y_values[0], found.y_values[-1])
    for set_label, name, unit in (
        (axes.set_xlabel, found.x, found.units[0]),
        (axes.set_ylabel, found.y, found.units[1]),
    ):
        set_label(plain(f"{name} [{'-' if unit == '1' else unit}]"))
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
