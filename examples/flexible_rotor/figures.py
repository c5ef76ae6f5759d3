"""Figures of the flexible rotor, as docs/howto/flexible_rotor.md shows them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

import malta
from malta.margins.loop_report import ZONES
from malta.report.figures.inline import InlineFigure

from . import analysis, flexible_rotor

if TYPE_CHECKING:
    from malta.model import Plant
    from malta.synthesis import Controller

STYLES = malta.report.STYLES
RPM = 30 / math.pi


def _new() -> tuple[Figure, Any]:
    figure = InlineFigure(figsize=(7.6, 3.6), layout="constrained")
    return figure, figure.subplots(1, 2)


def _finish(axes: Any, x: str, y: str, title: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.set_title(title, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=7)


def whirl(plant: Plant, controller: Controller) -> Figure:
    """Shapes of the four bending modes at rest, and the Campbell diagram."""
    figure, axes = _new()
    draw_whirl(axes, plant, controller)
    return figure


def draw_whirl(axes: Any, plant: Plant, controller: Controller) -> None:
    """Draw the shapes and the Campbell diagram on two axes."""
    left, right = axes
    m = flexible_rotor.modes(flexible_rotor.BENDING)
    z = flexible_rotor.NODE * np.arange(len(m.shapes) // 2)
    for k in range(flexible_rotor.BENDING):
        shape = m.shapes[::2, k + 2]
        left.plot(z, shape / np.abs(shape).max(), label=f"{m.w[k + 2] / (2 * math.pi):.0f} Hz", **STYLES[k])
    for name, nodes, mark in (("magnets", flexible_rotor.MAGNETS, "s"), ("sensors", flexible_rotor.SENSORS, "^"),
                              ("discs", flexible_rotor.DISCS, "o")):  # fmt: skip
        left.plot(z[list(nodes)], np.full(2, -1.25), mark, color="0.3", label=name, linestyle="none")
    _finish(left, "along the shaft [m]", "displacement, scaled", "Bending modes of the free rotor")
    par: Any = plant.parameters
    speeds = np.linspace(1.0, par.Omega_max, 25)
    for law, label, colour in ((None, "free rotor", "0.6"), (controller, "levitated", STYLES[0]["color"])):
        for k, speed in enumerate(speeds):
            found = analysis.whirl(plant, law, float(speed)).imag / (2 * math.pi)
            found = found[(found > 1) & (found < 500)]
            right.plot(np.full(len(found), speed * RPM), found, ".", markersize=2.5, color=colour,
                       label=label if not k else "")  # fmt: skip
    right.plot(speeds * RPM, speeds / (2 * math.pi), label="1x, the unbalance", **STYLES[3])
    right.set_ylim(0, 600)
    _finish(right, "speed [rpm]", "frequency [Hz]", "Campbell diagram")


def unbalance(plant: Plant, controller: Controller) -> Figure:
    """The unbalance response with the zones of ISO 14839-2, and |S| with those of ISO 14839-3."""
    figure, axes = _new()
    draw_unbalance(axes, plant, controller)
    return figure


def draw_unbalance(axes: Any, plant: Plant, controller: Controller) -> None:
    """Draw the response and |S| on two axes."""
    left, right = axes
    par: Any = plant.parameters
    found = analysis.unbalance_response(plant, controller, np.linspace(5.0, par.Omega_max, 70))
    for k, end in enumerate("AB"):
        left.semilogy(found.speeds * RPM, 1e6 * found.sensors[:, k], label=f"sensor {end}", **STYLES[k])
        left.semilogy(found.speeds * RPM, 1e6 * found.magnets[:, k], label=f"magnet {end}", **STYLES[k + 2])
    for name, share in analysis.ISO_14839_2.items():
        left.axhline(1e6 * share * par.c_r, color="0.5", linewidth=0.8, linestyle=":")
        left.text(
            1600 * "ABC".index(name), 1e6 * share * par.c_r * 0.72, f"zone {name}", fontsize=7, color="0.3"
        )
    left.set_ylim(0.1, 500)
    _finish(left, "speed [rpm]", "amplitude [µm]", "G2.5 unbalance; displacement zones of ISO 14839-2")
    w = np.geomspace(10, 3e4, 500)
    for k, speed in enumerate((1.0, par.Omega_max)):
        S = malta.loop(analysis.at_speed(plant, speed), controller).sensitivity(w)
        peak = np.abs(np.einsum("kii->ki", S)).max(axis=1)
        right.semilogx(w, peak, label=f"{speed * RPM:.0f} rpm, largest {peak.max():.2f}", **STYLES[k])
    for (below, _), name in zip(ZONES, "ABC", strict=False):
        right.axhline(below, color="0.5", linewidth=0.8, linestyle=":")
        right.text(11, below - 0.3, f"zone {name}", fontsize=7, color="0.3")
    right.set_ylim(0, 5.5)
    _finish(right, "frequency [rad/s]", "|S| of the worst sensor", "Sensitivity zones of ISO 14839-3")


def flown_unbalance(e: Any, _: Any = None) -> Figure:
    """Of the experiment `unbalance`: modes, Campbell diagram and response of the rotor, and what was flown."""
    figure = InlineFigure(figsize=(9.6, 7.2), layout="constrained")
    (top, bottom), run = figure.subplots(2, 2), e.run
    draw_whirl(top, run.plant, run.controller)
    draw_unbalance(bottom, run.plant, run.controller)
    for k, end in enumerate("AB"):
        flown = 1e6 * e.curves["flown"][:, k]
        bottom[0].plot(
            e.curves["speed"] * RPM, flown, "o", color=STYLES[k]["color"], label=f"sensor {end}, flown"
        )
    bottom[0].legend(frameon=False, fontsize=7)
    return figure


def rest(par: flexible_rotor.Parameters, weight: Any) -> Figure:
    """What four bending modes leave out, at three speeds, beside the weight that bounds it at all of them."""
    figure = InlineFigure(figsize=(5.0, 3.2), layout="constrained")
    axes = figure.subplots()
    k = flexible_rotor.BENDING + 2
    m, w = (
        flexible_rotor.modes(30),
        np.unique(np.concatenate([np.geomspace(300, 1e5, 500), np.linspace(5500, 6300, 300)])),
    )
    for i, speed in enumerate((-par.Omega_max, 0.0, par.Omega_max)):
        Z = [
            np.diag(m.w[k:] ** 2 - x**2 + 2j * x * par.zeta * m.w[k:]) + x * speed * m.gyroscopic[k:, k:]
            for x in w
        ]
        R = m.sensors[:, k:] @ np.linalg.solve(np.array(Z), m.magnets[:, k:].T[None])
        axes.loglog(w, np.linalg.norm(R, 2, axis=(1, 2)), label=f"{speed * RPM:.0f} rpm", **STYLES[i])
    axes.loglog(w, np.abs(weight(1j * w)), label="|W|", **STYLES[3])
    _finish(
        axes, "frequency [rad/s]", "magnet to sensor [m/N]", "The rest of the modes; backward whirl: negative"
    )
    return figure


FIGURES = {"unbalance": flown_unbalance}
