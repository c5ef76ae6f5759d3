"""Figures of robustness: margins stage by stage, and the machine's loop along its travel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.margins.figures import ZONES
from malta.report.figures.parts import (
    BOUND,
    DOT,
    LEGEND,
    NOTE,
    PAPER,
    STYLES,
    draw_grid,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.margins.loop_report import LoopReport
    from malta.proof.blocks.gain import Gain
    from malta.proof.margin import Margin


LOOKS: tuple[dict[str, Any], dict[str, Any]] = ({"color": "#c9c9c9"}, {"color": "#5a5a5a"})  # stages, machine
WITNESS: dict[str, Any] = {"color": "#c1440e", "linewidth": 1.6}
NO_WITNESS: dict[str, Any] = {"marker": ">", "markersize": 7, "linestyle": "none", "color": "#000000"}
CROWDED = 12.0  # peak |S| up to which the names of the zones have room


def chain_figure(found: LoopReport) -> Figure:
    """Draw margins and peak sensitivities of all stages as bars, and below them both along the travel.

    A machine without a travel has the first parameter that its proofs cover in its place, or nothing below.

    found : from `malta.verify`, with `stages`

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    Raises InputError for a report without stages.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> figure = malta.report.chain_figure(found)
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['proven margin without loads [% of the box]', 'peak |S| [-], zones of ISO 14839-3']
    """
    if not found.chain:
        raise InputError(found.controller.name, "stages", "none", "a report of malta.verify with stages=True")
    box = ", ".join(f"{key} ±{100 * share:g} %" for key, share in found.uncertainty.items())
    figure = new_figure(
        f"{found.controller.name}: where the margin goes",
        f"100 %: {box}, all at once",
        left=0.21,
        right=0.97,
        top=0.83,
        wspace=0.17,
        hspace=0.45,
    )
    extent = found.extent
    grid = figure.add_gridspec(
        2 if extent.course else 1, 2, height_ratios=(1.6, 1) if extent.course else None
    )
    left, right = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    _draw_stages(left, right, found)
    if extent.course:
        along = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
        _draw_along_course(*along, found, _bound(found.worst))
        for axes in along:
            along_travel = f"position {extent.stroke} [mm]"
            axes.set_xlabel(along_travel if extent.stroke else f"{extent.course} [{extent.unit}]")
    return figure


def _draw_stages(left: Axes, right: Axes, found: LoopReport) -> None:
    """Bars of all stages: the proven margin with its witness, and the peak sensitivity with the zones of its limits."""
    from matplotlib.patches import Patch

    rows = [(link.name, link.margin, link.peak) for link in found.chain]
    extent = found.extent
    if extent.course:
        everything = "all of the travel" if extent.stroke else f"every {extent.course}"
        rows.append((everything, found.travel, float(np.max([place.peak for place in found.places]))))
    most = max([_percent(m.lower) for _, m, _ in rows if m.lower is not None] + [100.0])
    beside: dict[str, Any] = {"xytext": (6, 0), "textcoords": "offset points", "va": "center"}
    for k, (_, margin, peak) in enumerate(rows):
        look, end = LOOKS[k >= len(found.chain) - 1], _draw_margin(left, k, margin)
        text = "none" if margin.lower is None else f"{_percent(margin.lower):.1f} %"
        text = f"{text} or more" if margin.exhausted and margin.lower is not None else text
        left.annotate(text, (end, k), **beside, **NOTE)
        stable = not math.isnan(peak)
        if stable:
            right.barh(k, peak, height=0.6, **look)
        right.annotate(
            f"{peak:.2f}" if stable else "unstable", (peak if stable else 0.0, k), **beside, **NOTE | PAPER
        )
        left.patches[k].set(**look)
    ends = [_percent(m.upper) for _, m, _ in rows if not m.exhausted]
    left.set_xlim(0, 1.35 * max([most, *(end for end in ends if end < 2 * most)]))
    left.set_yticks(range(len(rows)), [row[0] for row in rows])
    if ends:
        left.plot([], [], **WITNESS, label="unstable there")
    if any(m.exhausted and m.lower is not None for _, m, _ in rows):
        left.plot([], [], **NO_WITNESS, label="no instability found")
    if left.get_legend_handles_labels()[0]:
        _legend(left)
    named = ("of a stage", "of the machine, under its loads")
    _legend(right, 1.07, [Patch(label=label, **look) for look, label in zip(LOOKS, named, strict=True)])
    left.set_xlabel("proven margin without loads [% of the box]")
    right.set_yticks(range(len(rows)), [""] * len(rows))
    right.tick_params(axis="y", length=0)
    right.set_xlim(0, max(5.6, 1.15 * max(link.peak for link in found.chain if not math.isnan(link.peak))))
    for (limit, zone), (_, worse) in pairwise(ZONES):
        right.axvline(limit, **BOUND)
        if right.get_xlim()[1] < CROWDED:
            where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
            right.annotate(f"{zone} | {worse}", (limit, 1.005), **where, **NOTE)
    right.set_xlabel("peak |S| [-], zones of ISO 14839-3")
    for axes in (left, right):
        draw_grid(axes)
        axes.set_ylim(len(rows) - 0.4, -0.8)


def _draw_margin(axes: Axes, row: int, margin: Margin) -> float:
    """A bar of the proven margin, and at the end of it what ends it: a witness, or the search. Returns the end."""
    proven = _percent(margin.lower)
    axes.barh(row, proven, height=0.6)
    if margin.exhausted:
        if margin.lower is not None:
            axes.plot(proven, row, **NO_WITNESS)
        return proven
    witness = _percent(margin.upper)
    axes.plot([witness] * 2, [row - 0.38, row + 0.38], **WITNESS)
    return witness if witness < 1.3 * proven else proven


def _draw_along_course(left: Axes, right: Axes, found: LoopReport, bound: float) -> None:
    """Margin and peak sensitivity over the position; each value is the worse of +z and -z, so both sides are alike."""
    places, even = found.places, bool(found.extent.stroke)
    z = np.array([p.position for p in places]) * (1e3 if even else 1.0)
    both = np.concatenate([-z[:0:-1], z]) if even else z

    def mirrored(values: list[float]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        array = np.array(values)
        return np.concatenate([array[:0:-1], array]) if even else array

    left.plot(both, mirrored([_percent(p.margin.lower) for p in places]), **DOT | {"markersize": 4})
    if found.travel.lower is not None:
        left.axhline(100 * found.travel.lower, **STYLES[1])
        left.annotate(
            "proven for all of it at once", (0.02, 100 * found.travel.lower), xycoords=("axes fraction", "data"),
            xytext=(0, -3), textcoords="offset points", va="top", **NOTE,
        )  # fmt: skip
    left.set_ylim(0, 1.25 * max([_percent(p.margin.lower) for p in places] + [1.0]))
    left.set_ylabel("margin [%]")
    right.plot(both, mirrored([p.peak for p in places]), **DOT | {"markersize": 4})
    right.set_xlim(left.get_xlim())
    for place, peak in zip(both, mirrored([p.peak for p in places]), strict=True):
        if math.isnan(peak):
            right.annotate(
                "unstable", (float(place), 0.5), xycoords=("data", "axes fraction"), rotation=90, ha="center",
                va="center", **NOTE,
            )  # fmt: skip
    peaks = [p.peak for p in places if not math.isnan(p.peak)] + ([bound] if math.isfinite(bound) else [])
    limit, zone = ZONES[0]
    right.set_ylim(0, max(limit + 0.5, 1.2 * max([*peaks, 1.0])))
    if math.isfinite(bound):
        right.axhline(bound, **STYLES[1])
        right.annotate(
            "no more for any parameters of the box", (0.02, bound), xycoords=("axes fraction", "data"),
            xytext=(0, 3), textcoords="offset points", va="bottom", **NOTE,
        )  # fmt: skip
    right.axhline(limit, **BOUND)
    where: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
    right.annotate(f"end of zone {zone}", (0.985, limit), **where, **NOTE)
    right.set_ylabel("peak |S| [-]")
    for axes in (left, right):
        draw_grid(axes)


def _bound(worst: Mapping[str, Gain]) -> float:
    """The proven upper bound of |S| of all sensors; NaN where a sensor has none."""
    found = [gain.upper for gain in worst.values()]
    return max([bound for bound in found if bound is not None]) if found and None not in found else math.nan


def _percent(t: float | None) -> float:
    """A share in percent; 0 for None."""
    return 0.0 if t is None else 100 * t


def _legend(axes: Axes, bottom: float = 1.0, handles: Sequence[Artist] | None = None) -> None:
    """A legend of two columns above the axes, of what is drawn or of these handles."""
    where: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, bottom), "borderaxespad": 0.2}
    axes.legend(handles=handles, ncols=2, **where, **LEGEND)
