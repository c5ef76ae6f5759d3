"""Curves of several designs over each other, for the page of a comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING

from malta.model.signals import FINE
from malta.report import plots
from malta.report.figures.parts import MORE, STYLES, draw_line, finish_axes, micro, new_figure
from malta.report.page.channels import distinct_channels
from malta.report.page.sections import Item, Picture
from malta.units import in_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.report.page.analysis import Analysis
    from malta.report.page.comparison import Comparison


def overlaid(found: Comparison) -> Iterator[Item]:
    """The figures of a comparison: sensitivities, Nyquist plots, singular values, loads, the main job."""
    named = dict(zip(found.names, found.designs, strict=True))
    loops = {name: a.curves for name, a in named.items()}
    stable = {name: loops[name] for name, a in named.items() if a.report.stable}
    panels = distinct_channels(loops)
    if stable and found.one_machine:
        shown = distinct_channels(stable)
        yield Picture(
            partial(plots.sensitivity_curves, stable, channel=shown.channels),
            f"Sensitivity S and complementary sensitivity T, with the zones of ISO 14839-3.{shown.note}",
        )
    if found.one_machine:
        yield Picture(
            partial(plots.nyquist, loops, channel=panels.channels),
            f"Nyquist plots of the loop at each sensor, the others closed.{panels.note}",
        )
    if stable:
        yield Picture(partial(plots.sigma, stable), "Singular values of L, S and T with all sensors at once.")
    if stable and found.one_machine and found.designs[0].plant.disturbances:
        yield Picture(
            partial(plots.load_response, stable),
            "Deviation after a unit step of each load from outside, and compliance over frequency.",
        )
    flown = [(name, a) for name, a in named.items() if a.job is not None]
    if found.one_machine and len(flown) > 1:
        yield Picture(
            lambda: _job_figure(flown),
            "The main job on the nonlinear machine: the leading output, its distance from the reference, and the "
            "leading command.",
        )


def _job_figure(designs: Sequence[tuple[str, Analysis]]) -> Figure:
    """The leading output of the main job, its error, and the leading command, of the first run of each design."""
    figure = new_figure("", size=(9.0, 6.4))
    figure.subplots_adjust(left=0.095, right=0.985, bottom=0.085, top=0.9, hspace=0.28)
    panels = figure.subplots(3, 1, sharex=True)
    plant = designs[0][1].plant
    k, m = plant.leading_output, plant.leading_input
    signal, force = plant.outputs[k], plant.inputs[m]
    shown = {"m": "mm", "rad": "mrad"}.get(signal.unit, signal.unit)
    fine = FINE.get(signal.unit, signal.unit)
    for (name, a), style in zip(designs, cycle((*STYLES, *MORE)), strict=False):
        assert a.job is not None
        run = a.job.run
        t = 1e3 * run.t
        draw_line(panels[0], t, in_unit(1.0, shown) * run.p[:, k], label=name, **style)
        draw_line(panels[1], t, in_unit(1.0, fine) * (run.p - run.reference)[:, k], **style)
        draw_line(panels[2], t, run.v[:, m], **style)
    labels = (
        f"{signal.name}{_in_brackets(shown)}",
        f"{signal.name}, off reference{_in_brackets(fine)}",
        f"command {force.name}{_in_brackets(force.unit)}",
    )
    for axes, label in zip(panels, labels, strict=True):
        finish_axes(axes, "time [ms]" if axes is panels[-1] else "", label)
    _add_legend(figure, panels[0])
    return figure


def _in_brackets(unit: str) -> str:
    return "" if unit == "1" else f" [{micro(unit)}]"


def _add_legend(figure: Figure, axes: Axes) -> None:
    """One legend above all panels, in rows of four."""
    handles, labels = axes.get_legend_handles_labels()
    shown = [label if len(label) <= 40 else f"{label[:37]}..." for label in labels]
    figure.legend(
        handles, shown, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 0.995), frameon=False, fontsize=9
    )
