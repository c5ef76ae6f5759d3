"""Figures of a log: a panel for each signal with its spectrum and the excited lines, and a small one by units."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.display import prefixed_unit
from malta.identification.log_view import TAIL_ROWS
from malta.report.figures.drawing import draw_grid, draw_group, finish_axes, micro, new_figure
from malta.units import FINE_UNITS, in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.identification.log import Log
    from malta.identification.log_view import SignalView

COLORS = {"y": "#1f4e79", "i": "#8c2d04", "v": "#4a4a4a", "excitation": "#5b7f3a", "reference": "#6a51a3"}
STRIP_INTERVALS = 300  # of a signal in the small figure
LEGEND_COLUMNS = 8  # of that figure: all names in one row
SLICE = 256  # samples of a slice of a spectrogram, at least
DECIBELS = 80  # of a spectrogram, at most
SLICES = 64  # of a record, without those between them
SIDE_BY_SIDE = 2  # signals in a row
ROW = 1.25  # inch


def log_figure(log: Log, *, spectrogram: bool = False) -> Figure:
    """Draw a log: of each signal that changes its envelope over time, and its spectrum with the excited lines.

    log : what to draw
    spectrogram : in place of spectra amplitudes over time and frequency, of the last 400 000 samples

    Returns a matplotlib Figure. Orange dots are the lines of the excitation.
    """
    from malta.identification.log_view import view_log

    views = view_log(log)
    rows = max(1, -(-len(views) // SIDE_BY_SIDE))
    found = "; ".join(log.survey.findings)
    short = found if len(found) < 150 else f"{found[:147]}..."
    height = 1.5 + ROW * rows
    room = {"wspace": 0.52, "right": 0.955} if spectrogram else {"wspace": 0.34, "right": 0.985}
    figure = new_figure(log.source, short, size=(13.0, height), hspace=0.32, left=0.06, **room)
    panels = figure.subplots(rows, 2 * SIDE_BY_SIDE, squeeze=False, width_ratios=[1.5, 1.0] * SIDE_BY_SIDE)
    for k in range(rows * SIDE_BY_SIDE):
        row, column = k % rows, 2 * (k // rows)
        over_time, spectrum = panels[row, column : column + 2]
        if k >= len(views):
            figure.delaxes(over_time)
            figure.delaxes(spectrum)
            continue
        last = row == rows - 1 or k == len(views) - 1
        _draw_signal(over_time, spectrum, views[k])
        if spectrogram:
            _draw_spectrogram(spectrum, log, views[k])
        below = "time [s]" if spectrogram else "frequency [Hz]"
        for axes, label in ((over_time, "time [s]"), (spectrum, below)):
            axes.tick_params(which="both", labelsize=7, labelbottom=last)
            axes.set_xlabel(label if last else "", fontsize=8)
    return figure


def strips_figure(log: Log) -> Figure:
    """Draw a log small: a panel for each unit, in which a line goes through the least and largest values.

    log : what to draw

    Returns a matplotlib Figure.
    """
    from malta.identification.log_view import view_log, view_panels

    panels = view_panels(view_log(log, STRIP_INTERVALS))
    height = 1.0 + 1.15 * max(1, len(panels))
    figure = new_figure(size=(9.0, height), hspace=0.5, top=1 - 0.35 / height)
    drawn = figure.subplots(max(1, len(panels)), 1, sharex=True, squeeze=False)[:, 0]
    for axes, panel in zip(drawn, panels, strict=False):
        unit, power = prefixed_unit(max(view.size for view in panel.views), panel.unit)
        lines = {view.label: view.ends[1] / 1000.0**power for view in panel.views}
        draw_group(axes, panel.views[0].ends[0], lines)
        finish_axes(axes, "time [s]" if axes is drawn[-1] else "", f"[{micro(unit)}]", legend=LEGEND_COLUMNS)
    return figure


def _draw_signal(over_time: Axes, spectrum: Axes, view: SignalView) -> None:
    """The envelope of a signal, and its spectrum."""
    unit = FINE_UNITS.get(view.unit, view.unit)
    scale, color = in_unit(1.0, unit), COLORS[view.group]
    shown = f"{view.label} [{micro(unit)}]"
    low, high = scale * view.low, scale * view.high
    over_time.fill_between(view.t, low, high, color=color, linewidth=0.6, step="post")
    over_time.set_ylabel(shown, fontsize=8)
    over_time.margins(x=0)
    draw_grid(over_time)
    good = view.amplitude > 0
    if good.any():
        spectrum.loglog(view.f[good], scale * view.amplitude[good], color=color, linewidth=0.7)
        seen = view.at_lines > 0
        spectrum.plot(view.lines[seen], scale * view.at_lines[seen], "o", color="#e07b00", markersize=2.2)
        top = scale * float(np.max(view.amplitude))
        spectrum.set_ylim(max(1e-6 * top, scale * float(np.median(view.amplitude[good])) / 5), 3 * top)
        spectrum.margins(x=0)
    draw_grid(spectrum)


def _draw_spectrogram(axes: Axes, log: Log, view: SignalView) -> None:
    """The amplitudes of a signal over time and frequency, darker where they are larger, in place of its spectrum."""
    from scipy.signal import spectrogram

    x = np.asarray(log.columns[view.group][-TAIL_ROWS:])[:, log.names(view.group).index(view.name)]
    length = min(len(x), max(SLICE, len(x) // SLICES))
    axes.clear()
    if length < 8 or not np.isfinite(x).any():
        return
    x, rate = np.nan_to_num(x - np.nanmean(x)), 1 / log.sample_time
    f, t, A = spectrogram(
        x, rate, "hann", length, length // 2, detrend=False, scaling="spectrum", mode="magnitude"
    )
    unit = FINE_UNITS.get(view.unit, view.unit)
    level = 20 * np.log10(np.maximum(2 * in_unit(1.0, unit) * A[1:], 1e-12))  # a half of it is at -f
    begin = float(log.t[log.samples - len(x)])
    least = max(float(np.median(level)), float(level.max()) - DECIBELS)
    mesh = axes.pcolormesh(begin + t, f[1:], level, cmap="Greys", vmin=least, rasterized=True)
    axes.set_yscale("log")
    axes.set_xlim(begin, float(log.t[-1]))
    axes.set_ylabel("f [Hz]", fontsize=8)
    bar = axes.figure.colorbar(mesh, ax=axes, pad=0.02)
    bar.set_label(f"dB of 1 {micro(unit)}", fontsize=7)
    bar.ax.tick_params(labelsize=7)
