"""The figure of a sensitivity: Sobol indices as bars, a panel for each figure of merit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from malta.report.figures.parts import add_shared_legend, finish_axes, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.campaigns.sensitivity import Index, Sensitivity

PANELS = (2, 3)
UPRIGHT = 6  # names of factors below an axis, at most; more are turned
BARS: dict[str, dict[str, Any]] = {
    "first-order index: alone": {"facecolor": "#d0d0d0", "edgecolor": "#000000", "hatch": "////"},
    "total index: also with others": {"facecolor": "#404040", "edgecolor": "#000000"},
}


def sensitivity_figure(found: Sensitivity) -> Figure:
    """First-order and total Sobol indices with their 95 % intervals: of the yield, then of figures of merit."""
    from malta.report.tables.campaign import run_text

    panels = {"yield": found.of_yield, **found.of_merits}
    shown = {label: indices for label, indices in panels.items() if indices}
    places: dict[str, Any] = {"left": 0.07, "right": 0.98, "top": 0.83, "wspace": 0.22}
    places |= (
        {"bottom": 0.09, "hspace": 0.42} if len(found.factors) <= UPRIGHT else {"bottom": 0.15, "hspace": 0.7}
    )
    title = f"{found.plan.controller.name}, {run_text(found.plan)}: what costs yield"
    share = found.within
    text = f"{found.limit.kept}: {100 * share.share:.4g} % "
    text += f"(95 %: {100 * share.low:.4g} to {100 * share.high:.4g} %), {found.runs} runs"
    figure = new_figure(title, text, **places)
    every = figure.subplots(*PANELS).ravel()
    for axes, (label, indices) in zip(every, shown.items(), strict=False):
        _draw_indices(axes, label, found.factors, indices)
    for axes in every[:: PANELS[1]]:
        axes.set_ylabel("share of the variance")
    for axes in every[len(shown) :]:
        axes.set_visible(False)
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
            label=name,
            **style,
        )
    finish_axes(axes, "", "")
    axes.set_title(label, fontsize=9)
    turned: dict[str, Any] = (
        {} if len(factors) <= UPRIGHT else {"rotation": 50, "ha": "right", "rotation_mode": "anchor"}
    )
    axes.set_xticks(at, factors, fontsize=8, **turned)
    axes.set_xlim(-0.6, len(factors) - 0.4)
    axes.set_ylim(0, 1.05)
