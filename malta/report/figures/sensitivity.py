"""The figure of a sensitivity: Sobol indices as bars, a panel for each figure of merit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from malta.report.figures.parts import add_shared_legend, finish_axes, new_figure, rows_and_columns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.sensitivity import Index, Sensitivity

UPRIGHT = 6  # names of factors below an axis, at most; more are turned
BARS: dict[str, dict[str, Any]] = {
    "first-order index: alone": {"facecolor": "#d0d0d0", "edgecolor": "#000000", "hatch": "////"},
    "total index: also with others": {"facecolor": "#8c8c8c", "edgecolor": "#000000"},
}


def sensitivity_figure(found: Sensitivity) -> Figure:
    """First-order and total Sobol indices with their 95 % intervals: of the yield, then of figures of merit."""
    from malta.report.tables.campaign import run_text

    panels = {"yield": found.of_yield, **found.of_merits}
    shown = {label: indices for label, indices in panels.items() if indices}
    rows, columns = rows_and_columns(len(shown))
    upright = len(found.factors) <= UPRIGHT
    below = 0.55 if upright else 0.95  # inch, of the names of the factors
    height = 1.05 + rows * (1.9 + below)
    places: dict[str, Any] = {"size": (9.0, height), "left": 0.08, "top": 1 - 1.05 / height, "wspace": 0.22}
    places |= {"bottom": below / height, "hspace": 0.42 if upright else 0.7}
    title = f"{found.plan.controller.name}, {run_text(found.plan)}: what costs yield"
    share = found.within
    text = f"{found.limit.kept}: {100 * share.share:.4g} % "
    text += f"(95 %: {100 * share.low:.4g} to {100 * share.high:.4g} %), {found.runs} runs"
    figure = new_figure(title, text, **places)
    first = None
    for k, (label, indices) in enumerate(shown.items()):
        axes = figure.add_subplot(rows, columns, k + 1, sharey=first)
        first = first or axes
        _draw_indices(axes, label, found.factors, indices)
        axes.set_ylabel("share of the variance [-]" if k % columns == 0 else "")
    add_shared_legend(figure)
    return figure


def _draw_indices(axes: Axes, label: str, factors: Sequence[str], indices: Sequence[Index]) -> None:
    at, width = np.arange(len(factors)), 0.38
    columns = [(i.first, i.first_half) for i in indices], [(i.total, i.total_half) for i in indices]
    for side, (name, style), rows in zip((-0.5, 0.5), BARS.items(), columns, strict=True):
        values = np.array(rows)
        axes.bar(
            at + side * width,
            values[:, 0],
            width,
            yerr=values[:, 1],
            capsize=2,
            ecolor="#000000",
            label=name,
            **style,
        )
    finish_axes(axes, "", "")
    axes.set_title(label.replace("clearance:", "clearance used up,"), fontsize=9)
    turned: dict[str, Any] = (
        {} if len(factors) <= UPRIGHT else {"rotation": 50, "ha": "right", "rotation_mode": "anchor"}
    )
    axes.set_xticks(at, factors, fontsize=8, **turned)
    axes.set_xlim(-0.6, len(factors) - 0.4)
    ends = [i.first + i.first_half for i in indices] + [i.total + i.total_half for i in indices]
    starts = [i.first - i.first_half for i in indices]
    low, high = axes.get_ylim() if axes.get_shared_y_axes().get_siblings(axes)[1:] else (0.0, 1.05)
    axes.set_ylim(min(low, *starts) - 0.02, max(high, *(1.03 * end for end in ends)))
