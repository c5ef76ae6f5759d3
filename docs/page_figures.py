"""Figures of the tutorial and the theory pages, computed by malta: python docs/page_figures.py [FOLDER].

The same malta draws the same bytes: ids of the SVGs are hashed with a fixed salt, and no date is written.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from scipy.special import comb

import malta
from malta.proof import certificate
from malta.proof.robust import law_of
from malta.proof.weak_coupling import taylor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from malta.arrays import ComplexArray, FloatArray

FOLDER = Path(__file__).parent / "theory" / "figures"
STYLES = malta.report.STYLES
GREY: dict[str, Any] = {"color": "#8a8a8a", "fontsize": 8}
# The Handbook's problem 7.3.3 (Floudas et al., 1999): q = middle + t width.
MIDDLE, WIDTH = np.array([2.25, 1.5, 1.5]), np.array([0.25, 0.5, 1.5])


def new_figure(panels: int = 1, width: float = 7.2, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    """An empty figure and its panels, side by side."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, panels)))


def finish(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Label a panel."""
    axes.set(xlabel=x, ylabel=y)
    axes.set_title(title, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=8)


def handbook(q1: Any, q2: Any, q3: Any) -> list[Any]:
    """Coefficients of the polynomial, highest power first."""
    return [16, 16 * q1 - 24, 78 - 9.625 * q1 - 16 * q2, 19 * q1 + 8 * q2 + q3 - 44, 12 - 4 * q1 - q2 + q3]


def handbook_values(w: FloatArray, u: FloatArray, t: float) -> ComplexArray:
    """a(jw; q) at frequencies w and places u, 3 x n, of the box t."""
    rows = [
        np.broadcast_to(row, u.shape[1:]) for row in handbook(*(MIDDLE[:, None] + t * WIDTH[:, None] * u))
    ]
    return np.asarray(sum(row * (1j * w[:, None]) ** (4 - k) for k, row in enumerate(rows)))


def handbook_margin() -> malta.proof.Margin:
    """The margin of the polynomial, proven."""
    box = {f"q{k + 1}": (MIDDLE[k] - WIDTH[k], MIDDLE[k] + WIDTH[k]) for k in range(3)}
    return malta.proof.margin_of_polynomial(handbook, box, dict(zip(box, MIDDLE.tolist(), strict=True)))


def value_sets() -> Figure:
    """Images of growing boxes at the frequency where stability is lost: zero lies outside up to the margin."""
    found = handbook_margin()
    assert found.frequency is not None
    figure, (axes,) = new_figure(width=5.4)
    corners = np.array(list(product((-1, 1), repeat=3))).T
    inside = np.random.default_rng(0).uniform(-1, 1, (3, 120))
    for t, style in zip((0.4, 0.6, found.upper), STYLES, strict=False):
        points = handbook_values(np.array([found.frequency]), corners, t)[0]
        edge = points[hull(points)]
        axes.plot(edge.real, edge.imag, label=f"t = {t:.3g}", **style)
        some = handbook_values(np.array([found.frequency]), inside, t)[0]
        axes.plot(some.real, some.imag, ".", markersize=1.5, color=style["color"])
    axes.plot(0, 0, "k+", markersize=10, markeredgewidth=1.6)
    axes.annotate("0", (0, 0), (6, 4), textcoords="offset points")
    finish(
        axes, "Re a(jw; p)", "Im a(jw; p)", f"one frequency, {found.frequency:.3g} rad/s, and growing boxes"
    )
    return figure


def hull(points: ComplexArray) -> list[int]:
    """Indices around the convex hull of points in the plane, closed."""
    from scipy.spatial import ConvexHull

    vertices = ConvexHull(np.column_stack([points.real, points.imag])).vertices
    return [int(k) for k in (*vertices, vertices[0])]


def bernstein(low: float, high: float, t: float) -> ComplexArray:
    """Bernstein coefficients of a(jw; q) over w in [low, high] and the corners of the box t: 5 x 8."""
    corners = np.array(list(product((-1, 1), repeat=3))).T
    x = np.linspace(0, 1, 5)
    values = handbook_values(low + (high - low) * x, corners, t)
    basis = np.array([[comb(4, k) * s**k * (1 - s) ** (4 - k) for k in range(5)] for s in x])
    return np.asarray(np.linalg.solve(basis, values))


def cell() -> Figure:
    """One cell: an interval of frequency times the box; its coefficients lie in an open half plane."""
    low, high, t = 0.95, 1.15, 0.6
    coefficients = bernstein(low, high, t).ravel()
    u = np.random.default_rng(1).uniform(-1, 1, (3, 30))
    values = handbook_values(np.linspace(low, high, 20), u, t).ravel()
    edge = coefficients[hull(coefficients)]
    directions = np.exp(1j * np.linspace(0, 2 * np.pi, 7200, endpoint=False))
    spare = (np.conj(directions)[:, None] * edge[None]).real.min(axis=1)
    c = directions[spare.argmax()]
    figure, (axes,) = new_figure(width=5.4)
    axes.plot(values.real, values.imag, ".", markersize=1.2, color="#8a8a8a", label="values in the cell")
    axes.plot(
        coefficients.real,
        coefficients.imag,
        "o",
        markersize=4,
        color="#c1440e",
        label="Bernstein coefficients",
    )
    axes.plot(edge.real, edge.imag, **(STYLES[0] | {"label": "their hull", "linewidth": 1.0}))
    reach = 1.1 * np.abs(edge).max()
    line = c * 1j * np.array([-reach, reach])
    axes.plot(line.real, line.imag, **(STYLES[2] | {"label": "Re(conj(c) a) = 0"}))
    axes.annotate("", (0.3 * reach * c.real, 0.3 * reach * c.imag), (0, 0), arrowprops={"arrowstyle": "->"})
    axes.annotate("c", (0.3 * reach * c.real, 0.3 * reach * c.imag), (5, 0), textcoords="offset points")
    axes.plot(0, 0, "k+", markersize=10, markeredgewidth=1.6)
    view = np.concatenate([edge, [0]])
    room = 0.15 * np.ptp(view.real)
    axes.set_xlim(view.real.min() - room, view.real.max() + room)
    axes.set_ylim(view.imag.min() - room, view.imag.max() + room)
    finish(axes, "Re a(jw; p)", "Im a(jw; p)", f"one cell: w = {low} .. {high} rad/s, {t} boxes")
    return figure


def gain_loop() -> tuple[malta.proof.UncertainSystem, Any]:
    """A levitated mass with an uncertain force constant b, closed by a lead at 1 kHz."""
    mass = malta.uncertain(lambda b: ([[0, 1], [100.0, 0]], [[0], [b]], [[1, 0]]), {"b": 1.0})
    lead = control.c2d(-control.tf([8.0, 400.0], [0.004, 1]), 1e-3, "tustin")
    return mass, lead


def cells() -> Figure:
    """All cells of a proof: they tile every frequency and the whole interval of the parameter."""
    mass, lead = gain_loop()
    ranges = {"b": (0.2, 2.0)}
    margin = malta.robust_margin(mass, lead, ranges)
    proof = certificate.certificate_of([(mass, law_of(mass, lead))], ranges, None, margin)
    figure, (axes,) = new_figure()
    (loop,) = proof["loops"]
    (group,) = loop["groups"]
    count = 0
    for part in group["parts"]:
        (ends,) = [[float.fromhex(x) for x in side] for side in part["box"]]
        for branch, low, high, ((first, last),), *_ in part["cells"]:
            x = (low, high) if branch == 0 else (2 - high, 2 - low)
            place = [ends[0] + share * (ends[1] - ends[0]) for share in (first, last)]
            below, above = sorted(1 / v for v in place) if group["inverted"][0] else place
            axes.add_patch(
                Rectangle(
                    (x[0], below), x[1] - x[0], above - below, facecolor="#dfe8f1" if branch == 0 else "#f3e3da",
                    edgecolor="#404040", linewidth=0.5,
                )
            )  # fmt: skip
            count += 1
    assert margin.lower is not None
    assert margin.witness is not None
    axes.axhline(margin.witness["b"], **(STYLES[1] | {"label": f"lost: b = {margin.witness['b']:.4g}"}))
    axes.axhline(1.0, **(STYLES[3] | {"label": "nominal"}))
    top = 1 + 1.06 * margin.upper
    axes.set(xlim=(0, 2), ylim=(1 - 0.85 * margin.upper, top))
    axes.set_xticks([0, 0.5, 1, 1.5, 2], ["0", "", "w1", "", "Nyquist"])
    finish(
        axes, "frequency: w / w1, then 2 - w1 / w", "b [1]", f"{count} cells prove {100 * margin.lower:.2f} %"
    )
    axes.legend(frameon=True, fontsize=8, loc="lower right", framealpha=1)
    return figure


def taylor_model() -> Figure:
    """Taylor models of a function on one interval and on three, and the function that they enclose."""
    half = 1.4
    figure, (axes,) = new_figure(width=5.4)
    u = np.linspace(-1, 1, 100)
    for pieces, color in ((1, "#e7edf3"), (3, "#9fb3c8")):
        z = taylor.variable(-half, half, pieces)
        f = taylor.divide(taylor.cosine(z), taylor.add(taylor.constant(2.0, pieces), taylor.sine(z)))
        polynomial = np.sum([np.outer(f.c[k], u**k) for k in range(len(f.c))], axis=0)
        label = f"{pieces} interval{'s' * (pieces > 1)}: +-{f.radius.max():.1g}"
        for k in range(pieces):
            y = z.c[0, k] + z.c[1, k] * u
            axes.fill_between(
                y,
                polynomial[k] - f.radius[k],
                polynomial[k] + f.radius[k],
                color=color,
                label=label if k == 0 else None,
            )
    y = half * u
    axes.plot(y, np.cos(y) / (2 + np.sin(y)), **(STYLES[0] | {"label": "cos z / (2 + sin z)"}))
    finish(axes, "z [rad]", "f", "polynomials of degree 6 with their remainders")
    return figure


def continuation() -> Figure:
    """Roots of the sampled loop on the way from the nominal machine to the witness."""
    spec = malta.read_design("design/calibrated.toml")
    model = malta.linearize(spec.plant, spec.plant.at(z=0.0))
    law = malta.synthesize(spec, model)
    found = malta.verify(model, law, spec.uncertainty).robust
    assert found is not None
    assert found.witness is not None
    par = spec.parameters
    z = found.witness.get("z", 0.0)
    way = np.linspace(0, 1.15, 47)
    steps = {name: found.witness[name] - getattr(par, name) for name in spec.uncertainty}
    roots = [
        roots_at(par, law, {name: getattr(par, name) + s * d for name, d in steps.items()}, z) for s in way
    ]
    figure, (left, right) = new_figure(2)
    for s, row in zip(way, roots, strict=True):
        left.plot(row.real, row.imag, ".", markersize=2.5, color=mpl.colormaps["viridis"](0.9 * s / way[-1]))
    left.axvline(0, color="0.5", linewidth=0.8)
    left.set(xlim=(-600, 60), ylim=(-450, 450))
    finish(left, "Re ln(z) / Ts [rad/s]", "Im ln(z) / Ts [rad/s]", "roots, dark to light on the way")
    share = 100 * found.upper * way
    right.plot(share, [row.real.max() for row in roots], **STYLES[0])
    right.axhline(0, color="0.5", linewidth=0.8)
    right.axvline(100 * found.upper, **(STYLES[1] | {"label": f"lost at {100 * found.upper:.2f} %"}))
    finish(
        right, "of the way to the witness, in % of the box", "largest real part [rad/s]", "where it is lost"
    )
    return figure


def roots_at(par: Any, law: malta.synthesis.Controller, values: dict[str, float], z: float) -> ComplexArray:
    """Poles of the sampled loop on another machine, as ln(z) / Ts."""
    from dataclasses import replace

    plant = malta.plant_of(replace(par, **values))
    poles = malta.verify(malta.linearize(plant, plant.at(z=z)), law).poles.closed_loop
    return np.asarray(poles)


def discs() -> Figure:
    """Unmodelled dynamics: a disc about every point of the Nyquist curve, which grows until it meets -1."""
    plant = control.tf([18], [1, 1.8, 10])
    pid = 2.3 + control.tf([3], [1, 0]) + control.tf([0.38, 0], [0.001, 1])
    w = np.geomspace(1, 40, 600)
    L = (plant * pid)(1j * w)
    margin = malta.dynamic_margin(
        malta.uncertain(lambda k: ([[0, 1], [-k, -1.8]], [[0], [18]], [[1, 0]]), {"k": 10.0}),
        -pid, {}, malta.proof.Dynamic(0.5),
    )  # fmt: skip
    figure, panels = new_figure(2, height=3.8)
    for axes, t in zip(panels, (1.0, margin.upper), strict=True):
        for k in range(0, len(w), 12):
            disc = Circle(
                (L[k].real, L[k].imag), 0.5 * t * abs(L[k]), facecolor="#dfe8f1", edgecolor="#b8c4d0", lw=0.4
            )
            axes.add_patch(disc)
        axes.plot(L.real, L.imag, **STYLES[0])
        axes.plot(-1, 0, "k+", markersize=10, markeredgewidth=1.6)
        axes.set(xlim=(-4, 2), ylim=(-3.6, 2.4), aspect="equal")
        finish(axes, "Re L", "Im L", f"discs of 50 %, times {t:.3f}")
    return figure


def stages() -> Figure:
    """Where the margin goes: from full state feedback to the machine, of two designs."""
    figure, (axes,) = new_figure(height=3.2)
    for n, name in enumerate(("calibrated", "robust")):
        law = malta.gains.read(f"design/gains/{name}.json")
        box = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2)
        chain = malta.verify(law, uncertainty=box, stages=True, worst_case=False).chain
        proven = [
            0.0 if link.margin is None or link.margin.lower is None else 100 * link.margin.lower
            for link in chain
        ]
        places = np.arange(len(chain)) + 0.38 * (n - 0.5)
        axes.bar(places, proven, 0.36, color=("#c9d3de", "#404a55")[n], label=name)
        for x, value in zip(places, proven, strict=True):
            axes.annotate(
                f"{value:.0f}", (x, value), (0, 2), textcoords="offset points", ha="center", fontsize=7
            )
    axes.set_xticks(
        range(len(chain)), [link.name.replace("all of the travel", "travel") for link in chain], fontsize=8
    )
    axes.margins(y=0.2)  # room for the legend
    finish(axes, "", "proven [% of the box]")
    return figure


def frames() -> Figure:
    """The mover from the side: bearing planes, sensor planes, and a tilt."""
    par = malta.read("data/tubular.toml")
    figure, (axes,) = new_figure(height=2.7)
    tilt, shift = 0.06, 5.0  # much more than an air gap allows
    l_B, l_S = 1e3 * par.l_B, 1e3 * par.l_S
    line = np.array([-1.2 * l_S, 1.2 * l_S])
    axes.plot(line, shift + tilt * line, color="#000000", linewidth=5, alpha=0.25, solid_capstyle="butt")
    axes.plot(line, 0 * line, **(STYLES[3] | {"label": "axis of the stator, z"}))
    axes.plot(line, shift + tilt * line, **(STYLES[0] | {"label": "axis of the mover"}))
    for n, (z, what) in enumerate(((-l_S, "x1"), (-l_B, "fx_B1"), (l_B, "fx_B2"), (l_S, "x2"))):
        sensor = what[0] == "x"
        axes.plot([z, z], [0, shift + tilt * z], **(STYLES[1 + sensor] | {"linestyle": "-"}))
        up = shift + tilt * z
        axes.annotate(what, (z, max(up, 0)), (0, 7), textcoords="offset points", ha="center")
        axes.annotate(("sensor", "bearing", "bearing", "sensor")[n], (z, 0), (0, -14), textcoords="offset points",
                      ha="center", **GREY)  # fmt: skip
    axes.plot(0, shift, "ko", markersize=4)
    axes.annotate("centre of gravity (x, z)", (0, shift), (6, -14), textcoords="offset points", fontsize=8)
    axes.annotate(
        "tilt beta", (0.7 * l_S, shift + tilt * 0.7 * l_S), (-8, 16), textcoords="offset points", fontsize=8
    )
    axes.set(ylim=(-6, 17), yticks=[])
    finish(axes, "z [mm]", "x, not to scale")
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def current_noise() -> Figure:
    """Rest and commands of two designs under noise of the current sensors; bars are 95 % intervals over seeds."""
    from malta_papers.tubular.quantities import rests_of_seeds

    noise = np.array([0.0, 5.0, 10.0, 13.8, 20.0, 50.0])  # mA
    figure, (motion, force) = new_figure(2, height=3.0)
    for name, style in zip(("calibrated", "robust"), STYLES, strict=False):
        law = malta.gains.read(f"design/gains/{name}.json")
        plant = malta.plant_of(law.parameters)
        rests = [
            rests_of_seeds(plant.variant(replace(plant.parameters, s_i=1e-3 * s_i)), law, range(16))
            for s_i in noise.tolist()
        ]
        worst = [max(rest[f"true {p}, rms"] for p in ("x1", "y1", "x2", "y2")) for rest in rests]
        commands = [rest["bearing force, rms about its mean"] for rest in rests]
        for axes, found, scale in ((motion, worst, 1e6), (force, commands, 1.0)):
            sizes = [[scale * one, scale * one.half] for one in found]
            axes.errorbar(noise, *np.transpose(sizes), capsize=2, label=name, **style)
    motion.set_ylim(0, None)
    force.set(yscale="log", ylim=(2e-3, 5))
    finish(
        motion, "noise of a current sensor, rms [mA]", "worst radial motion at rest, rms [µm]", "the mover"
    )
    finish(force, "noise of a current sensor, rms [mA]", "commanded bearing force, rms [N]", "its price")
    return figure


def cogging_of_two_modules() -> Figure:
    """The cogging of MALTA's two modules over their distance, of period L_p, and where the presets have them."""
    figure, (axes,) = new_figure(height=3.2)
    plain, printed = (malta.read("data/tubular.toml", name) for name in ("table1", "table4"))
    D = np.linspace(75, 105, 600)  # mm
    axes.plot(D, np.abs(np.cos(np.pi * D * 1e-3 / plain.L_p)), label="two like modules", **STYLES[0])
    for par, style in zip((plain, printed), STYLES[1:], strict=False):
        at = 2e3 * par.l_B
        axes.axvline(at, label=f"2 l_B of {par.preset}, {at:.1f} mm", **style)
    for n in (11, 13):
        axes.annotate(
            f"{n / 2:g} L_p", (n / 2 * 15, 0.03), ha="left", xytext=(6, 0), textcoords="offset points", **GREY
        )
    axes.set_ylim(0, 1.35)
    finish(axes, "distance of the modules' middles [mm]", "cogging over twice one module's")
    return figure


def block_diagram() -> Figure:
    """The loop of a shipped design, block by block."""
    controller = malta.gains.read("design/gains/robust.json")
    return malta.report.block_diagram(controller, malta.plant_of(controller.parameters))


def bode() -> Figure:
    """The Bode plot of the machine that the tutorial begins with."""
    from malta.files import shipped_path

    spec = malta.read_design(shipped_path("examples", "ball", "design", "ball.toml"))
    model = malta.linearize(spec.plant, spec.plant.at())
    return malta.report.bode(spec.plant, malta.synthesize(spec, model))


def positioning() -> Figure:
    """|S| of the positioning system of docs/howto/structured.md at the corners of its box, with two laws."""
    from malta import structured

    inertia, load = 1e-6, 1.15e-7  # kg m^2
    laws = {"tuned at nominal parameters": (8.0426e-5, 1.7952, 860.61, 358.41, 0.042484, 0.61949),
            "tuned until the proof closes": (6.907e-5, 1.6407, 260.03, 377.74, 0.0078568, 0.71245)}  # fmt: skip
    w = np.unique(
        np.concatenate([np.geomspace(10, 1000, 150), np.linspace(285, 305, 80), np.linspace(380, 405, 100)])
    )
    s = 1j * w
    figure, panels = new_figure(2)
    for axes, (title, (k0, zero, pole, *notch)) in zip(panels, laws.items(), strict=True):
        law = (
            structured.gain("k", k0) * structured.lead("lead", zero, pole) * structured.notch("notch", *notch)
        )
        K = law.system.response(s)[:, 0, 0]
        for share in product((0.5, 1.5), (0.5, 1.5), (0.5, 1.5), (0.75, 1.0, 1.25)):
            b1, b2, b12, k = np.array([1e-6, 1e-6, 5e-7, 0.013]) * share
            shaft = b12 * s + k
            P = shaft / ((inertia * s**2 + b1 * s + shaft) * (load * s**2 + b2 * s + shaft) - shaft**2)
            axes.loglog(w, np.abs(1 / (1 + P * K)), color="#3b6ea5", linewidth=0.7)
        axes.axhline(1.3, color="#b5432a", linewidth=1, linestyle="--", label="1.3")
        axes.set_ylim(0.1, 12)
        finish(axes, "w [rad/s]", "|S|", title)
    return figure


def coils() -> Figure:
    """Currents of least loss of a plate's four coils, with all of them and with the first one open."""
    corners = [[1, 1, 1, 1], [1, 1, -1, -1], [-1, 1, 1, -1]]  # lift, roll, pitch
    figure, panels = new_figure(2, height=2.6)
    for axes, forces, title in zip(
        panels, ([4, 0, 0], [4, 1, 0]), ("lift of 4", "lift of 4, roll of 1"), strict=True
    ):
        for k, (failed, label) in enumerate((((), "all coils"), ((0,), "coil 1 open"))):
            currents = malta.model.allocation(corners, failed=list(failed)).currents(forces)
            axes.bar(
                np.arange(1, 5) + 0.38 * (k - 0.5),
                currents,
                0.36,
                color=("#c9d3de", "#404a55")[k],
                label=label,
            )
        axes.set_xticks(range(1, 5))
        finish(axes, "coil", "current", title)
    return figure


def order() -> Figure:
    """Proven margins of laws of MALTA by their states, as notebooks/10_structured.py computes and asserts them."""
    figure, (axes,) = new_figure(1, 5.2, 3.4)
    laws = {
        "robust, truncated": ("o", ((20, 3.502), (18, 3.289), (16, 0.0))),
        "tuned for the margin": ("s", ((5, 3.742), (10, 3.718), (15, 3.819))),
        "structured, tuned for stiffness": ("D", ((15, 3.077),)),
    }
    for (label, (mark, points)), style in zip(laws.items(), STYLES, strict=False):
        axes.plot(*zip(*points, strict=True), mark, label=label, fillstyle="none", color=style["color"])
    axes.axhline(3.4, color="#8a8a8a", linewidth=1, linestyle="--")
    axes.set_ylim(-0.2, 4.2)
    axes.set_xlim(0, 21)
    axes.legend(frameon=False, loc="lower left")
    finish(axes, "states of the law", "proven margin [boxes of ±20 %]", "")
    return figure


def flexible_rotor(name: str) -> Figure:
    """A figure of examples/flexible_rotor."""
    from importlib import import_module

    from malta.model.data import read
    from malta.model.plants import plant_of

    folder = Path(__file__).parents[1] / "examples" / "flexible_rotor"
    machine = malta.machine(folder / "flexible_rotor.py")
    law, figures = (import_module(f"{machine.__name__}.{part}") for part in ("law", "figures"))
    par = read(folder / "flexible_rotor.toml")
    if name == "rest":
        return figures.rest(par, law.rest_weight())  # type: ignore[no-any-return]
    plant = plant_of(par)
    return getattr(figures, name)(plant, law.controller(plant))  # type: ignore[no-any-return]


def scheduled() -> Figure:
    """Of examples/magnet: one law and a scheduled one over a gap from 2 to 8 mm, standing and moving."""
    spec = malta.read_design("examples/magnet/design/scheduled.toml")
    plant = spec.plant
    law = malta.synthesize(spec, malta.linearize(plant, plant.at()))
    figure, (standing, moving) = new_figure(2, height=3.0)
    places, w = np.linspace(-3e-3, 3e-3, 61), np.geomspace(1, np.pi / spec.sample_time, 1000)

    def course(t: FloatArray) -> malta.references.Motion:
        s, ds, dds = (x[:, None] for x in malta.references.quintic(t - 2.1, 2.0))  # 2.85 mm/s at most
        return malta.references.Motion(6e-3 * s - 3e-3, 6e-3 * ds, 6e-3 * dds)

    scenario = malta.Scenario("along", 5.0, lambda _: course, fidelity="force", settle=0.2)
    laws = {"law of 5 mm": replace(law, schedule=None), "scheduled": law}
    for (label, one), style in zip(laws.items(), STYLES, strict=False):
        currents = [float(ca.DM(plant.position_of([place]))[2]) for place in places]
        loops = [malta.loop(plant, one, q=y, i=i) for y, i in zip(places, currents, strict=True)]
        peaks = [np.abs(o.sensitivity(w)).max() if o.stable else np.nan for o in loops]
        standing.semilogy(5 - 1e3 * places, peaks, label=label, **style)
        run = malta.simulate(plant, one, scenario)
        moving.plot(run.t, 1e6 * (run.p[:, 0] - run.reference[:, 0]), label=label, **style)
    standing.axhline(4, color="0.6", linewidth=0.8)
    standing.text(8.0, 4.2, "zone C of ISO 14839-3 above", ha="right", **GREY)
    moving.set_ylim(-100, 100)
    finish(standing, "gap [mm]", "peak |S|", "at rest")
    finish(moving, "time [s]", "off the reference [µm]", "from a gap of 8 mm to 2 mm")
    return figure


def bending() -> Figure:
    """How much larger the mover's first bending mode may be, as a block, over its frequency; gain file robust."""
    from malta.machines.tubular.bending import bending_block, first_bending

    controller = malta.gains.read("design/gains/robust.json")
    own: Any = controller.parameters
    system, law = malta.loop(malta.plant_of(own), controller).uncertain(("m",))
    frequencies = np.array([8e3, 12e3, 16e3, 20e3, 24e3, 28e3])
    figure, (axes,) = new_figure(width=5.0, height=3.0)
    for zeta, style in ((0.005, STYLES[0]), (0.02, STYLES[1])):
        blocks = [bending_block(own, system, (0, 2), w, zeta) for w in frequencies]
        proven = [malta.dynamic_margin(system, law, {}, block).lower for block in blocks]
        axes.loglog(frequencies / (2e3 * np.pi), proven, marker="o", label=f"damping {zeta:.1%}", **style)
    axes.axhline(1, color="#b5432a", linewidth=1, linestyle="--", label="the mode itself")
    for E, text in ((30e9, "30 GPa"), (160e9, "160 GPa")):
        axes.axvline(first_bending(own, E) / (2e3 * np.pi), color="0.6", linewidth=0.8)
        axes.text(first_bending(own, E) / (2e3 * np.pi), 0.03, text, rotation=90, **GREY)
    finish(axes, "first bending frequency [kHz]", "proven multiple of the mode")
    return figure


def any_load() -> Figure:
    """The worst load of 20 N on `robust`: the load, what it does in the simulator, the bound and the clearance."""
    controller = malta.gains.read(Path(__file__).parents[1] / "design" / "gains" / "robust.json")
    plant = malta.plant_of(controller.parameters)
    loop = malta.loop(plant, controller)
    found = malta.worst_waveform(loop, "F_x", "x1", 20.0)
    end = found.peak_time + 0.05
    scenario = malta.Scenario("load", end, malta.references.hold, disturbance=found.load)
    run = malta.simulate(plant, controller, scenario)
    t = np.linspace(0.0, end, 2000)
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    load, motion = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    load.step(1e3 * t, found.load(t)[:, 0], where="post", label="the load that does it", **STYLES[0])
    finish(load, "", "F_x [N]")
    motion.plot(1e3 * run.t, 1e6 * run.p[:, 0], label="simulated, nonlinear machine", **STYLES[0])
    motion.plot(
        1e3 * found.response[0],
        1e6 * found.response[1],
        label="linear loop",
        **STYLES[1] | {"linestyle": "--"},
    )
    bound, clearance = 1e6 * (found.value + found.error), 1e6 * vars(plant.parameters)["r_max"]
    for size, words in ((bound, "bound of any load of 20 N"), (clearance, "clearance")):
        for sign in (-1, 1):
            motion.axhline(sign * size, color="0.3", linestyle=":" if size == bound else "-", linewidth=1)
        motion.annotate(f"{words}, {size:.0f} µm", (0, size), (4, 4), textcoords="offset points", **GREY)
    motion.set_ylim(-1.25 * clearance, 1.25 * clearance)
    finish(motion, "time [ms]", "x1 [µm]")
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "value_sets": value_sets,
    "cell": cell,
    "cells": cells,
    "taylor": taylor_model,
    "continuation": continuation,
    "discs": discs,
    "stages": stages,
    "frames": frames,
    "current_noise": current_noise,
    "cogging": cogging_of_two_modules,
    "bode": bode,
    "block_diagram": block_diagram,
    "statechart": partial(malta.report.statechart, wiring=True),
    "positioning": positioning,
    "coils": coils,
    "order": order,
    "flexible_whirl": partial(flexible_rotor, "whirl"),
    "flexible_unbalance": partial(flexible_rotor, "unbalance"),
    "bending": bending,
    "scheduled": scheduled,
    "any_load": any_load,
    "flexible_rest": partial(flexible_rotor, "rest"),
}


def draw(folder: Path) -> list[Path]:
    """Draw all figures into a folder."""
    mpl.rcParams.update(
        {"svg.hashsalt": "malta", "svg.fonttype": "none", "font.size": 9, "path.simplify": True}
    )
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, make in FIGURES.items():
        files.append(folder / f"{name}.svg")
        make().savefig(files[-1], metadata={"Date": None}, facecolor="white")
    return files


if __name__ == "__main__":
    print(*draw(Path(sys.argv[1]) if sys.argv[1:] else FOLDER), sep="\n")
