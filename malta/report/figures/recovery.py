"""The figure of how a machine takes loads from outside: deviation over time, and compliance over frequency."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.loops.loop import loop_along
from malta.loops.recovery import furthest, load_vector
from malta.loops.sampled_loops import SampledLoop
from malta.report.figures.marks import draw_group
from malta.report.figures.parts import MORE, STYLES, finish_axes, micro, new_figure
from malta.units import unit_factor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from malta.loops.recovery import Deviation, Recovery
    from malta.model.plant import FloatArray, Plant
    from malta.synthesis.controller import Controller
    from malta.synthesis.step_response import StepResponse

FINE = {"m": "um", "rad": "urad"}  # units that outputs are drawn in
SHOWN = 1.5  # times the longest time to 1 %
POINTS = 400  # of frequency
LOOKS = (
    STYLES[0],
    MORE[1],
    STYLES[2],
    MORE[0],
    *STYLES[1::2],
    *MORE[2:],
)  # a line that covers another has gaps


def recovery_figure(plant: Plant, controller: Controller, found: Sequence[Recovery]) -> Figure:
    """Deviation after a unit step of every disturbance, and compliance over frequency, of the output furthest off.

    found : the answers of this machine to its disturbances, as malta.recovery(plant, controller) gives them

    A row for each pair of units, as um under N. Raises CheckError for an unstable loop.
    """
    picked = furthest(found)
    units = {s.name: s.unit for s in plant.disturbances}
    rows: dict[tuple[str, str], list[tuple[Recovery, Deviation]]] = {}
    for load, output in picked:
        rows.setdefault((output.unit, units[load.name]), []).append((load, output))
    height = 0.9 + 2.4 * len(rows)
    figure = new_figure(
        f"{controller.name}: how a load from outside is carried",
        size=(9.0, height),
        left=0.1,
        bottom=0.6 / height,
        top=0.97 - 0.62 / height,
        hspace=0.5,
    )
    panels = figure.subplots(len(rows), 2, squeeze=False)
    loop = loop_along(plant, controller).sampled
    answer = loop.answer()
    for (left, right), ((unit, of), lines) in zip(panels, rows.items(), strict=True):
        _draw_steps(left, plant, answer, lines, FINE.get(unit, unit), of)
        _draw_compliance(right, plant, loop, lines, FINE.get(unit, unit), of)
    return figure


def _draw_steps(
    axes: Axes,
    plant: Plant,
    answer: StepResponse,
    lines: Sequence[tuple[Recovery, Deviation]],
    unit: str,
    of: str,
) -> None:
    """Deviation over time of the output furthest off, after 1 N or 1 N m at t = 0."""
    names = [s.name for s in plant.outputs]
    settled = max(output.settled for _, output in lines)
    end = min(SHOWN * settled, float(answer.t[-1])) if np.isfinite(settled) else float(answer.t[-1])
    shown = answer.t <= end
    series = {}
    for load, output in lines:
        y = answer.of(load_vector(plant, load.name, load.load)).y[shown, names.index(output.output), 0]
        series[f"{load.name}: {output.output}"] = y * np.sign(y[np.abs(y).argmax()]) / unit_factor(unit, unit)
    columns = draw_group(axes, 1e3 * answer.t[shown], series, LOOKS)
    finish_axes(axes, "time [ms]", f"deviation under 1 {of} [{micro(unit)}]", legend=columns)


def _draw_compliance(
    axes: Axes,
    plant: Plant,
    loop: SampledLoop,
    lines: Sequence[tuple[Recovery, Deviation]],
    unit: str,
    of: str,
) -> None:
    """Amplitude of the same outputs over frequency, under a load of amplitude 1 N or 1 N m."""
    names = [s.name for s in plant.outputs]
    w: FloatArray = np.geomspace(1.0, 0.3 * np.pi / loop.sample_time, POINTS)
    series = {}
    for load, output in lines:
        amplitude = np.abs(loop.compliance(w, load_vector(plant, load.name, load.load)))
        series[f"{load.name}: {output.output}"] = amplitude[:, names.index(output.output)] / unit_factor(
            unit, unit
        )
    axes.set(xscale="log", yscale="log")
    draw_group(axes, w / (2 * np.pi), series, LOOKS)
    finish_axes(
        axes,
        "frequency [Hz]",
        f"compliance [{micro(unit)}/({of})]" if " " in of else f"compliance [{micro(unit)}/{of}]",
    )
