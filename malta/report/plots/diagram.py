"""The block diagram of a loop: its own blocks with their rates, delays and limits, as the records have them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.display import micro, number, quantity
from malta.model.plant import Plant, Signal, given_plant
from malta.report.figures.drawing import NOTE, new_figure
from malta.report.plots.panels import plain
from malta.synthesis.controller import Controller, given_law
from malta.units import FINE_UNITS, in_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

BLOCK = 1.5, 1.02  # inch
SHEET = 3.4  # inch, of the figure
SHOWN_NAMES = 3  # signals that a block names


class DiagramBlock(NamedTuple):
    """A block: what it is, and what is known of it in a few words a line."""

    title: str
    lines: tuple[str, ...] = ()


def block_diagram(controller: Controller, plant: Plant) -> Figure:
    """Draw the block diagram of a loop with the blocks that the controller and its machine have.

    controller : the law
    plant : the machine that it runs on

    Returns a matplotlib Figure, which a notebook shows as the value of a cell.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> figure = malta.report.block_diagram(controller, spec.plant)
    >>> [text.get_text() for text in figure.axes[0].texts if "every" in text.get_text()]
    ['every 200 µs, 5 kHz']
    """
    controller = given_law("block_diagram", controller)
    plant = given_plant("block_diagram", plant)
    forward, back = _forward(controller, plant), _backward(controller, plant)
    width, height = BLOCK
    gap = 0.42
    total = 1.1 + len(forward) * (width + gap) + 0.7
    figure = new_figure(
        f"{plain(controller.name)}: block diagram of the loop",
        size=(total, SHEET),
        left=0,
        right=1,
        bottom=0,
        top=1,
    )
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0, total)
    axes.set_ylim(0, SHEET)
    axes.axis("off")
    upper, lower = 2.1, 0.62
    x = 1.1
    draw_arrow(axes, (0.1, upper), (x, upper), "p*")
    for k, block in enumerate(forward):
        _draw(axes, block, x, upper)
        after = x + width + gap
        if k + 1 < len(forward):
            draw_arrow(axes, (x + width, upper), (after, upper), "v" if k == 0 else "")
        x = after
    if plant.disturbances:
        machine = x - gap - width / 2
        draw_arrow(axes, (machine, upper + height / 2 + 0.42), (machine, upper + height / 2), "")
        write_note(
            axes, machine + 0.05, upper + height / 2 + 0.3, f"loads {_names(plant.disturbances)}", ha="left"
        )
    end = x - gap + 0.3
    draw_arrow(axes, (x - gap, upper), (total - 0.05, upper), "p")
    x = end
    start, target = (end, lower), 1.1 + width / 2
    axes.plot([end, end], [upper, lower], color="#000000", linewidth=1.0)
    for k, block in enumerate(back):
        left = 1.1 + (len(forward) - 1 - k) * (width + gap)
        draw_arrow(axes, start, (left + width, lower), "y" if k == 1 else "")
        _draw(axes, block, left, lower)
        start = (left, lower)
    axes.plot([start[0], target], [lower, lower], color="#000000", linewidth=1.0)
    draw_arrow(axes, (target, lower), (target, upper - height / 2), "")
    return figure


def _forward(c: Controller, plant: Plant) -> list[DiagramBlock]:
    """From the reference to the outputs: law, limits, computing, current loops, machine."""
    law = ["K, Ki" if c.integrating else "K"] if c.tracks == "states" else ["linear, of the errors"]
    if c.integrating:
        law.append("sums all errors" if len(c.summed) == len(c.measurements) else "sums some errors")
    if any(np.any(part) for part in (c.feedforward.inertia, c.feedforward.speed, c.feedforward.position)):
        law.append("feedforward")
    law.append(f"every {_time(c.sample_time)}, {quantity(1 / c.sample_time, 'Hz')}")
    blocks = [DiagramBlock("law", tuple(law))]
    finite = [(s, float(f)) for s, f in zip(c.forces, c.limits.force, strict=True) if np.isfinite(f)]
    if finite:
        by_unit = {s.unit: max(f for other, f in finite if other.unit == s.unit) for s, _ in finite}
        texts = tuple(f"|v| ≤ {size:.4g} {unit}" for unit, size in by_unit.items())
        blocks.append(DiagramBlock("limits", texts))
    actuator = plant.actuator
    if actuator.dead_time > 0 or actuator.coils:
        lines = [f"{len(actuator.coils)} coils"] if len(actuator.coils) > 1 else []
        lines += [f"delay {_time(actuator.dead_time)}"] if actuator.dead_time > 0 else []
        if math.isfinite(actuator.crossover) and c.current_loop is not None:
            lines.append(f"PI to {quantity(actuator.crossover / (2 * math.pi), 'Hz')}")
        blocks.append(
            DiagramBlock("current loops" if c.current_loop is not None else "actuator", tuple(lines))
        )
    states = f"{len(plant.states)} states"
    return [
        *blocks,
        DiagramBlock(
            plain(plant.name), (states, f"{len(plant.inputs)} forces" if len(plant.inputs) > 1 else "")
        ),
    ]


def _backward(c: Controller, plant: Plant) -> list[DiagramBlock]:
    """From the outputs back: sensors, and what estimates states of their readings."""
    noise: dict[str, float] = {}
    for s, size in zip(
        plant.outputs, np.ravel(np.asarray(plant.sensors.deviations, dtype=float)), strict=True
    ):
        noise[s.unit] = max(noise.get(s.unit, 0.0), float(size))
    fine = {unit: FINE_UNITS.get(unit, unit) for unit in noise}
    sizes = [f"{number(in_unit(v, fine[u]), 2)} {fine[u]}" for u, v in noise.items() if v > 0]
    lines = [_names(plant.outputs), *(f"noise {size}" for size in sizes)]
    if plant.sensors.dead_time > 0:
        lines.append(f"late by {_time(plant.sensors.dead_time)}")
    blocks = [DiagramBlock("sensors", tuple(lines))]
    if c.noise is not None:
        known = [f"{len(c.states)} states"]
        late = c.delay + c.fraction
        known += [f"delay {late:.3g} {'samples' if late > 1 else 'sample'}"] if late else []
        blocks.append(DiagramBlock("Kalman filter", (*known, *(["constant forces"] if c.observed else []))))
    elif c.tracks == "states":
        blocks.append(DiagramBlock("filters of rates", (f"{len(c.states)} states",)))
    return blocks


def _names(signals: Sequence[Signal]) -> str:
    """The names of some signals; of many the first and the last."""
    names = [s.name for s in signals]
    return " ".join(names) if len(names) <= SHOWN_NAMES else f"{names[0]} … {names[-1]}"


def _time(seconds: float) -> str:
    return quantity(seconds, "s")


def _draw(axes: Any, block: DiagramBlock, left: float, middle: float) -> None:
    """A frame with its title above its lines."""
    from matplotlib.patches import Rectangle

    width, height = BLOCK
    frame = Rectangle((left, middle - height / 2), width, height, facecolor="#f2f5f8", edgecolor="#000000")
    axes.add_patch(frame)
    write_note(
        axes,
        left + width / 2,
        middle + height / 2 - 0.16,
        block.title,
        weight="bold",
        fontsize=9,
        color="#000000",
    )
    for k, line in enumerate(line for line in block.lines if line):
        write_note(axes, left + width / 2, middle + height / 2 - 0.36 - 0.165 * k, micro(line), fontsize=7.5)


def write_note(axes: Any, x: float, y: float, text: str, **style: Any) -> None:
    axes.text(x, y, plain(text), **{**NOTE, "ha": "center", "va": "center", **style})


def draw_arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], name: str) -> None:
    """An arrow with its signal above it."""
    axes.annotate(
        "",
        end,
        xytext=start,
        arrowprops={"arrowstyle": "-|>", "color": "#000000", "shrinkA": 0, "shrinkB": 0},
    )
    if name:
        write_note(axes, (start[0] + end[0]) / 2, start[1] + 0.12, name, style="italic", color="#000000")
