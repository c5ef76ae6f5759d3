"""The figure of a search: the Pareto front of noise and motion against the proven margin."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from malta.report.figures.parts import BOUND, DOT, NOTE, STYLES, finish_axes, front_lines, new_figure
from malta.synthesis.requirements import Trade

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.tuning.tune import Tuned

LABELS = ("noise of the force [N rms]", "true motion [µm rms]")  # by trade
MARKS = ((0, "o"), (2, "s"), (1, "D"))  # style of a line and marker


def front_figure(tuned: Tuned) -> Figure:
    """Draw the Pareto front of a search: force noise and motion over the proven margin, the chosen trial ringed.

    A dot has the least force noise, or the least motion, that goes with its margin. The chosen trial has to keep the
    bounds of both and of the experiments at once, so it may lie off either front.

    tuned : from `malta.tune`

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    >>> import malta
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import Tuned
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = Tuned(spec, front[1], (), front, trials=120)  # as malta.tune finds it
    >>> figure = malta.report.front_figure(tuned)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['noise of the force [N rms]', 'true motion [µm rms]']
    """
    asked, chosen, front = tuned.spec.specification, tuned.trial, tuned.front
    taken = next((one for one in front if one.values == chosen.values), chosen)
    others = [one for one in front if one is not taken] or [taken]
    kept = (
        "keeps all that is asked for" if tuned.reached else f"misses {tuned.binding.name.replace('_', ' ')}"
    )
    share = f"{100 * taken.figures['margin']:.0f} %"
    found = f"{tuned.trials} trials; open marks: taken, margin {share}, which {kept}; "
    found += "filled: least force noise, or least motion, at a margin"
    figure = new_figure(f"{tuned.spec.name}: margin against noise", found, size=(9.0, 4.6), left=0.1)
    panels: Any = figure.subplots(1, 2)
    for axes, trade, y in zip(panels, get_args(Trade), LABELS, strict=True):
        lines = front_lines(tuned.spec.plant, taken.figures, trade)
        axes.set_yscale("log")
        for (name, label, scale, _), (style, marker) in zip(lines, cycle(MARKS), strict=False):
            if all(name in one.figures for one in front):
                points = [(100 * one.figures["margin"], scale * one.figures[name]) for one in others]
                where = 100 * taken.figures["margin"], scale * taken.figures[name]
                _draw_points(axes, points, where, STYLES[style] | {"marker": marker, "label": label})
        if "margin" in asked:
            axes.axvline(100 * asked["margin"], **BOUND)
            above: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
            axes.annotate("asked for", (100 * asked["margin"], 1.01), **above, **NOTE)
        axes.margins(x=0.04)
        finish_axes(axes, "proven margin [% of the box]", y, legend=2)
        axes.margins(x=0.04)
    return figure


def _draw_points(
    axes: Axes, points: Sequence[tuple[float, float]], taken: tuple[float, float], style: dict[str, Any]
) -> None:
    """Draw trials, those that none beats as a line where they are more than two, and a ring at the one taken."""
    best = _pareto_front(points)
    if len(best) <= 2:
        best, style = sorted(points), style | {"linestyle": "none"}
    axes.plot(*np.array(best).T, markersize=4, **style)
    ring = {"markersize": 10, "markerfacecolor": "none", "markeredgecolor": style["color"]}
    axes.plot(*taken, **DOT | ring | {"marker": style["marker"]})


def _pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points (margin, size) that no other beats in both, by margin."""
    found: list[tuple[float, float]] = []
    for margin, size in sorted(points, key=lambda point: (-point[0], point[1])):
        if not found or size < found[-1][1]:
            found.append((margin, size))
    return found[::-1]
