"""The figure of a log: a panel for each group of columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.report.figures.parts import finish_axes, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.identification.log import Log
    from malta.model.plant import FloatArray

PANELS = {
    "y": "measured",
    "reference": "reference",
    "v": "command",
    "excitation": "excitation",
    "i": "current",
}
POINTS = 2000  # of a line: intervals, each drawn from its least to its largest value


def log_figure(log: Log) -> Figure:
    """Draw a log: measured outputs, reference, commands, excitation and currents over time."""
    groups = [group for group in PANELS if log.names(group) and np.nan_to_num(log.columns[group]).any()]
    figure = new_figure(log.source, "; ".join(log.survey.findings), size=(9.0, 1.2 + 1.9 * len(groups)))
    for axes, group in zip(
        figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0], groups, strict=True
    ):
        micro = {"m": 1e6, "rad": 1e6}.get(log.signals[group][0].unit, 1.0)
        for signal, values in zip(log.signals[group], log.columns[group].T, strict=True):
            axes.plot(*_thinned(log.t, micro * values), lw=0.8, label=signal.name)
        unit = log.signals[group][0].unit
        finish_axes(
            axes, "time [s]", f"{PANELS[group]} [{'u' if micro != 1 else ''}{unit}]", legend=len(axes.lines)
        )
    return figure


def _thinned(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest value of each of POINTS intervals."""
    each = len(t) // POINTS
    if each < 4:
        return t, values
    whole = POINTS * each
    parts = values[:whole].reshape(POINTS, each)
    ends = np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).ravel()
    return np.repeat(t[:whole:each], 2), ends
