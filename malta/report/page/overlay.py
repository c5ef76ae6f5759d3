"""Curves of several designs over each other, for the page of a comparison."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.margins.loops import machine_loop
from malta.margins.verify import ZONES
from malta.model.signals import FINE
from malta.report.figures.parts import BOUND, MORE, NOTE, STYLES, draw_line, finish_axes, micro
from malta.report.page.sections import Item, Picture
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.report.page.analysis import Analysis
    from malta.report.page.comparison import Comparison

POINTS = 500  # of frequency


def overlaid(found: Comparison) -> Iterator[Item]:
    """The figures of a comparison: S and T, the main job, loads."""
    stable = [(name, a) for name, a in zip(found.names, found.designs, strict=True) if a.margins.stable]
    if stable:
        yield Picture(
            lambda: _sensitivity_figure(stable),
            "Largest singular values of S and T of the machine's loop at the sensors, with the zones of ISO 14839-3.",
        )
    flown = [(name, a) for name, a in zip(found.names, found.designs, strict=True) if a.job is not None]
    if found.one_machine and len(flown) > 1:
        yield Picture(
            lambda: _job_figure(flown),
            "The main job on the nonlinear machine: the leading output, its distance from the reference, and the "
            "command that leads.",
        )


def _styles(count: int) -> list[dict[str, Any]]:
    """A style for each design; more designs than styles begin again."""
    return [style for style, _ in zip(cycle((*STYLES, *MORE)), range(count), strict=False)]


def _sensitivity_figure(designs: list[tuple[str, Analysis]]) -> Figure:
    """Largest singular values of S and T over frequency."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), dpi=120)
    figure.subplots_adjust(left=0.075, right=0.985, bottom=0.13, top=0.82, wspace=0.2)
    left, right = figure.subplots(1, 2)
    for (name, a), style in zip(designs, _styles(len(designs)), strict=True):
        loop = machine_loop(a.model, a.subject.controller)
        w = np.geomspace(1e-1, np.pi / loop.sample_time, POINTS)
        S = loop.sensitivity(w)
        for axes, G in ((left, S), (right, np.eye(len(loop.Cd)) - S)):
            size = np.linalg.svd(G, compute_uv=False)[:, 0]
            axes.loglog(w / (2 * np.pi), np.maximum(size, 1e-4), label=name, **style)
    for axes, what in ((left, "S"), (right, "T")):
        finish_axes(axes, "frequency [Hz]", f"largest singular value of {what}")
        axes.set_ylim(bottom=max(axes.get_ylim()[0], 1e-2))
    _draw_zones(left)
    _add_legend(figure, left)
    return figure


def _draw_zones(axes: Axes) -> None:
    """The limits of the zones of ISO 14839-3."""
    for (limit, zone), (_, worse) in pairwise(ZONES):
        axes.axhline(limit, **BOUND)
        axes.annotate(
            f"{zone} | {worse}", (0.01, limit), xycoords=("axes fraction", "data"), va="bottom", **NOTE
        )


def _job_figure(designs: list[tuple[str, Analysis]]) -> Figure:
    """The leading output of the main job, its error, and the leading command, of the first run of each design."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.4), dpi=120)
    figure.subplots_adjust(left=0.095, right=0.985, bottom=0.085, top=0.88, hspace=0.28)
    panels = figure.subplots(3, 1, sharex=True)
    plant = designs[0][1].plant
    k, m = plant.leading_output, plant.leading_input
    signal, force = plant.outputs[k], plant.inputs[m]
    shown = {"m": "mm", "rad": "mrad"}.get(signal.unit, signal.unit)
    fine = FINE.get(signal.unit, signal.unit)
    for (name, a), style in zip(designs, _styles(len(designs)), strict=True):
        assert a.job is not None
        run = a.job.run
        t = 1e3 * run.t
        draw_line(panels[0], t, in_unit(1.0, shown) * run.p[:, k], label=name, **style)
        draw_line(panels[1], t, in_unit(1.0, fine) * (run.p - run.reference)[:, k], **style)
        draw_line(panels[2], t, run.v[:, m], **style)
    labels = (
        f"{signal.name} [{micro(shown)}]",
        f"{signal.name}, off reference [{micro(fine)}]",
        f"command {force.name} [{force.unit}]",
    )
    for axes, label in zip(panels, labels, strict=True):
        finish_axes(axes, "time [ms]" if axes is panels[-1] else "", label)
    _add_legend(figure, panels[0])
    return figure


def _add_legend(figure: Figure, axes: Axes) -> None:
    """One legend above all panels, in rows of three."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 0.995), frameon=False, fontsize=9
    )
