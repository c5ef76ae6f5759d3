"""A machine in motion: its bodies as they move in a run, as a page with a scrubber or as an animated picture.

A coordinate that moves little beside the size of the machine is magnified, so that one sees what sensors see. Bodies
are those of `Plant.bodies`; nothing is computed of them.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.display import micro, quantity
from malta.errors import InputError
from malta.files import read_file, read_packaged
from malta.model.rigid_body import Body
from malta.report.page.bodies import (
    VIEW,
    Mesh,
    camera,
    draw_order,
    mesh_of,
    place_points,
    poses_of,
    upright_axis,
)
from malta.tables import read_npz

if TYPE_CHECKING:
    from PIL import Image, ImageDraw, ImageFont

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.report.page.document import Page
    from malta.simulation.trajectory import Trajectory

FRAMES = 240  # of a run
MAX_PAGE_BYTES = 4_500_000  # bytes of a page: runs of longer ones show fewer frames
MAGNIFIED_SHARE = 0.01  # of the largest body: what moves less is magnified
HEAD = 16.0  # of an arrow, pixels of the animated picture at twice its size
ARROW = 0.2  # of the largest body: the arrow of the scale
SHOWN_MOTION_SHARE = 0.12  # of the smallest side of a moving body: the largest magnified motion
INKS: Mapping[str, tuple[int, int, int]] = {
    "paper": (255, 255, 255), "text": (40, 44, 48), "torque": (40, 44, 48),
    "trace": (125, 41, 6), "force": (176, 58, 8),
}  # fmt: skip


class Arrow(NamedTuple):
    """A force or a torque of the actuators in a run, drawn from the middle of a body."""

    name: str
    unit: str
    body: int
    values: FloatArray  # frames x 3, along the stator's axes, SI


@dataclass(frozen=True, eq=False)
class Animation:
    """The bodies of a machine, and how they move in a run.

    title : of the run
    ended : how it ended, in words
    t : s, of each frame
    bodies : of the machine
    poses : of each body, frames x 6: place (m) and Cardan angles (rad)
    up : the axis that points up, 0 to 2
    small : the coordinates that are magnified, of each body
    factor : by which, as a first choice
    signals : series of numbers beside the picture, by their names with units, frames each
    arrows : forces and torques of the actuators, as they acted
    """

    title: str
    ended: str
    t: FloatArray
    bodies: tuple[Body, ...]
    poses: FloatArray
    up: int
    small: FloatArray
    factor: float
    signals: Mapping[str, FloatArray]
    arrows: tuple[Arrow, ...] = ()


def read_motion(file: str | Path, plant: Plant, *, frames: int = FRAMES) -> Animation:
    """Read how a machine moves from the file of a run, as `malta simulate --out` writes them.

    file : a .npz file
    plant : the machine
    frames : at most so many

    Raises InputError for a machine without bodies, and a file that holds no run of it.
    """
    arrays = _series(Path(file), plant)
    ended = str(np.ravel(arrays.get("verdict", [""]))[0])
    signals = {
        str(name): arrays[key][:, k] for key in ("p", "v") for k, name in enumerate(arrays[f"{key}_columns"])
    }
    series = arrays["t"], arrays["x"], arrays["force"]
    return _motion(Path(file).stem, ended, plant, series, signals, frames)


def motion_of(run: Trajectory, title: str, *, frames: int = FRAMES) -> Animation:
    """How a machine moves in a run.

    title : of the run, as "y1 stuck"
    frames : at most so many

    Raises InputError for a machine without bodies.
    """
    signals = {
        f"{signal.name} [{signal.unit}]": values[:, k]
        for of, values in ((run.plant.outputs, run.p), (run.plant.inputs, run.v))
        for k, signal in enumerate(of)
    }
    ended = f"{run.verdict.words} at {quantity(run.verdict.time, 's')}"
    return _motion(title, ended, run.plant, (run.t, run.x, run.force), signals, frames)


def _motion(
    title: str,
    ended: str,
    plant: Plant,
    series: tuple[FloatArray, FloatArray, FloatArray],
    signals: Mapping[str, FloatArray],
    frames: int,
) -> Animation:
    """Frames of a run, evenly over its time. Raises InputError for a machine without bodies.

    series : times, states and acting inputs
    """
    t, x, force = series
    if plant.bodies is None:
        raise InputError(plant.name, "bodies", "none", "bodies of the machine: Plant(bodies=...)")
    kept = np.unique(np.linspace(0, len(t) - 1, frames).astype(int))
    states = dict(zip((s.name for s in plant.states), x[kept].T, strict=True))
    bodies = tuple(plant.bodies())
    poses = np.stack([poses_of(body, states, len(kept)) for body in bodies])
    small, factor = _magnify(bodies, poses)
    shown = {name: np.asarray(values[kept]) for name, values in signals.items()}
    arrows = _arrows(bodies, plant, force[kept])
    return Animation(title, ended, t[kept], bodies, poses, upright_axis(plant), small, factor, shown, arrows)


def _arrows(bodies: Sequence[Body], plant: Plant, force: FloatArray) -> tuple[Arrow, ...]:
    """The resultants of each body in every frame."""
    columns = dict(zip((s.name for s in plant.inputs), force.T, strict=True))
    units, none = {s.name: s.unit for s in plant.inputs}, np.zeros(len(force))
    return tuple(
        Arrow(one.name, next(units[name] for name in one.inputs if name), k,
              np.column_stack([columns.get(name, none) for name in one.inputs]))
        for k, body in enumerate(bodies) for one in body.resultants
    )  # fmt: skip


def arrow_size(found: Animation, unit: str) -> float:
    """The force or torque, SI, whose arrow is as long as the scale of the picture: 1, 2 or 5 times a power of ten.

    It is the largest of these below the largest of the run; 0 where nothing acts.
    """
    sizes = [np.linalg.norm(one.values, axis=1).max() for one in found.arrows if one.unit == unit]
    largest = float(max(sizes, default=0.0))
    if largest <= 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(largest))
    return max(step * power for step in (1, 2, 5) if step * power <= largest)


def _series(file: Path, plant: Plant) -> Mapping[str, Any]:
    """Times, states, outputs and commands of a run. Raises InputError for another file, and another machine's."""
    kind = "run, a .npz file of malta simulate"
    content = read_file(file, kind, Path.read_bytes)
    try:
        arrays = read_npz(content)
    except ValueError as error:
        raise InputError(file, "", str(error), f"a {kind}") from error
    t = arrays.get("t", np.zeros((0, 0)))
    if t.ndim != 1 or not len(t):
        raise InputError(file, "t", "no times", f"a {kind}")
    for key, signals in (
        ("x", plant.states),
        ("p", plant.outputs),
        ("v", plant.inputs),
        ("force", plant.inputs),
    ):
        names = [f"{s.name} [{s.unit}]" for s in signals]
        columns = [str(name) for name in np.ravel(arrays.get(f"{key}_columns", []))]
        if columns != names:
            raise InputError(
                file, f"{key}_columns", " ".join(columns[:4]) or "none", f"those of {plant.name}"
            )
        values = arrays.get(key)
        if values is None or values.shape != (len(t), len(names)) or not np.isfinite(values).all():
            raise InputError(file, key, "no numbers of every time", f"{len(t)} x {len(names)} finite numbers")
    return arrays


def _magnify(bodies: Sequence[Body], poses: FloatArray) -> tuple[FloatArray, float]:
    """Which coordinates of each body are magnified, and a factor of 1, 2 or 5 times a power of ten that shows them."""
    largest = max(max(body.size) for body in bodies)
    arm = np.array([[1, 1, 1, *[max(body.size) / 2] * 3] for body in bodies])
    reach = arm * np.abs(poses - poses.mean(axis=1, keepdims=True)).max(axis=1)
    moving = np.array([[bool(body.moves)] * 6 for body in bodies])
    small = moving & (reach < MAGNIFIED_SHARE * largest)
    most = float((reach * small).max(initial=0.0))
    if most <= 0:
        return small, 1.0
    shown = SHOWN_MOTION_SHARE * min(min(body.size) for body in bodies if body.moves) / most
    power = 10.0 ** math.floor(math.log10(max(shown, 1.0)))
    return small, max(step * power for step in (1, 2, 5) if step * power <= max(shown, 1.0))


def magnify(found: Animation, k: int, body: int, factor: float) -> FloatArray:
    """The pose of a body in a frame, small motion about its mean times a factor."""
    pose, rest = found.poses[body, k], found.poses[body].mean(axis=0)
    return np.asarray(np.where(found.small[body], rest + factor * (pose - rest), pose))


def motion_gif(
    found: Animation, *, size: tuple[int, int] = (520, 320), frames: int = 60, dark: bool = False
) -> bytes:
    """Draw the motion as an animated picture, which repeats.

    size : pixels
    frames : so many, evenly over the run
    dark : for a dark page
    """
    from PIL import Image

    meshes = [mesh_of(body) for body in found.bodies]
    view = camera(found.up, *VIEW)
    ends = np.vstack([place_points(mesh, magnify(found, k, n, found.factor)) @ view.T
                      for n, mesh in enumerate(meshes) for k in (0, len(found.t) // 2, len(found.t) - 1)])  # fmt: skip
    shown = np.unique(np.linspace(0, len(found.t) - 1, frames).astype(int))
    pictures = [_draw_frame(found, int(k), meshes, view, ends, size) for k in shown]
    palette = pictures[len(pictures) // 2].quantize(48, Image.Quantize.MAXCOVERAGE)
    drawn = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    if dark:
        from malta.report.page.document import dark_colours

        rows = np.array(palette.getpalette()).reshape(-1, 3) / 255
        for picture in drawn:
            picture.putpalette(np.round(255 * dark_colours(rows)).astype(int).ravel().tolist())
    buffer = io.BytesIO()
    drawn[0].save(buffer, "GIF", save_all=True, append_images=drawn[1:], duration=66, loop=0, optimize=True)
    return buffer.getvalue()


def motion_page(found: Animation | Sequence[Animation], about: str = "") -> Page:
    """Write the motion as one page in HTML that needs no network: turned by dragging, with a scrubber.

    found : a run, or several of one machine, which the page chooses among by buttons
    about : a line below the title

    The page stays below 5 MB: many runs show fewer frames each.
    """
    from markupsafe import Markup

    from malta.report.page.document import Page, json_in_page, page_style, render_template, script_of

    runs = [found] if isinstance(found, Animation) else [*found]
    every = 1
    while len(data := json_in_page(_page_data(runs, every))) > MAX_PAGE_BYTES and every < FRAMES:
        every *= 2
    title = runs[0].title if len(runs) == 1 else f"{len(runs)} runs"
    policy, script = script_of(read_packaged("report/page/motion.js").decode())
    page = render_template(
        "motion.html.jinja", title=title, about=about, style=Markup(page_style()), script=Markup(script),
        policy=policy, data=Markup(data),
    )  # fmt: skip
    return Page(f"{title}: in motion", page)


def _page_data(runs: Sequence[Animation], every: int) -> dict[str, Any]:
    """What the page's script reads: the bodies once, and each run, of which every n-th frame is kept."""
    first = runs[0]
    upright = camera(first.up, 0.0, 0.0)
    return {
        "view": VIEW, "up": np.eye(3)[first.up].tolist(), "across": upright[2].tolist(), "along": upright[0].tolist(),
        "reach": max(float(2 * np.linalg.norm(b.place) + np.linalg.norm(b.size)) for b in first.bodies),
        "arrow": ARROW * max(max(body.size) for body in first.bodies),
        "bodies": [
            {"points": _digits(mesh.points), "faces": mesh.faces, "moves": bool(body.moves)}
            for body, mesh in ((body, mesh_of(body)) for body in first.bodies)
        ],
        "runs": [_run_data(run, every) for run in runs],
    }  # fmt: skip


def _run_data(run: Animation, every: int) -> dict[str, Any]:
    """A run for the page: what stands still has one pose."""
    shown = np.append(np.arange(0, len(run.t) - 1, every), len(run.t) - 1)
    return {
        "name": micro(run.title), "ended": run.ended, "t": _digits(run.t[shown]), "factor": run.factor,
        "bodies": [
            {"poses": _digits(poses[shown] if body.moves else poses[:1]), "mean": _digits(poses.mean(axis=0)),
             "small": small.tolist()}
            for body, poses, small in zip(run.bodies, run.poses, run.small, strict=True)
        ],
        "signals": [
            {"name": name.partition(" ")[0], "k": k, **_in_fine_unit(name, values[shown])}
            for k, (name, values) in enumerate(run.signals.items())
        ],
        "arrows": [
            {"name": one.name, "unit": one.unit, "body": one.body, "scale": arrow_size(run, one.unit),
             "values": _digits(one.values[shown])}
            for one in run.arrows
        ],
    }  # fmt: skip


def _in_fine_unit(name: str, values: FloatArray) -> dict[str, Any]:
    """A series in a unit in which its numbers are short: micrometres, or millimetres beyond a tenth of one."""
    unit, largest = name.partition("[")[2].rstrip("]"), float(np.abs(values).max(initial=0.0))
    factor, prefix = (1.0, "") if unit not in ("m", "rad") else (1e6, "µ") if largest < 1e-4 else (1e3, "m")
    return {"unit": prefix + unit, "values": _digits(factor * values)}


def _digits(values: FloatArray) -> Any:
    """Numbers with six digits, as lists."""
    flat = [float(f"{value:.6g}") for value in np.ravel(values)]
    return np.reshape(flat, np.shape(values)).tolist()


def _draw_frame(
    found: Animation,
    k: int,
    meshes: Sequence[Mesh],
    view: FloatArray,
    ends: FloatArray,
    size: tuple[int, int],
) -> Image.Image:
    """A frame at twice the size, made smaller: still bodies as edges, moving ones as faces, the time and a trace."""
    from matplotlib import get_data_path
    from PIL import Image, ImageDraw, ImageFont

    big = (2 * size[0], 2 * size[1])
    picture = Image.new("RGB", big, INKS["paper"])
    pen = ImageDraw.Draw(picture)
    low, high = ends.min(axis=0), ends.max(axis=0)
    scale = 0.9 * min(big[0] / (high[0] - low[0]), 0.74 * big[1] / (high[1] - low[1]))
    middle = np.array([big[0] / 2, 0.47 * big[1]])
    poses = [magnify(found, k, n, found.factor) for n in range(len(meshes))]
    for face in draw_order(found.bodies, meshes, poses, view):
        flat = middle + scale * (face.outline - (low + high)[:2] / 2) * [1, -1]
        outline = [(float(x), float(y)) for x, y in flat]
        if face.moves:
            pen.polygon(outline, fill=face.ink)
        else:
            pen.line([*outline, outline[0]], fill=face.ink, width=2)
    _draw_arrows(
        pen, found, k, lambda point: middle + scale * (view @ point - (low + high) / 2)[:2] * [1, -1]
    )
    font = ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), 26)
    outputs = [name for name in found.signals if name.endswith("[m]")] or [*found.signals][:1]
    chosen = max(outputs, key=lambda name: float(np.ptp(found.signals[name])))
    y = found.signals[chosen]
    left, right, top, bottom = 40, big[0] - 40, 0.86 * big[1], 0.96 * big[1]
    along = left + (right - left) * (found.t - found.t[0]) / max(found.t[-1] - found.t[0], 1e-12)
    across = bottom - (bottom - top) * (y - y.min()) / max(float(np.ptp(y)), 1e-300)
    trace = [(float(a), float(b)) for a, b in zip(along, across, strict=True)]
    pen.line(trace, fill=(200, 200, 200), width=3)
    pen.line(trace[: k + 1], fill=INKS["trace"], width=4)
    pen.ellipse([trace[k][0] - 8, trace[k][1] - 8, trace[k][0] + 8, trace[k][1] + 8], fill=INKS["trace"])
    pen.text((left, 16), f"{1e3 * found.t[k]:6.1f} ms", fill=INKS["text"], font=font)
    pen.text((right, 16), f"small motion × {found.factor:g}", fill=INKS["text"], font=font, anchor="ra")
    _draw_scale(pen, found, np.array([right, top - 22]), scale, font)
    pen.text(
        (left, int(top) - 36),
        f"{chosen.partition(' ')[0]}: {1e3 * y[k]:.2f} mm",
        fill=INKS["trace"],
        font=font,
    )
    return picture.resize(size, Image.Resampling.LANCZOS)


def _draw_arrows(
    pen: ImageDraw.ImageDraw, found: Animation, k: int, place: Callable[[FloatArray], FloatArray]
) -> None:
    """Forces with one head, torques with two, from the middle of their bodies; place : metres -> pixels."""
    whole = ARROW * max(max(body.size) for body in found.bodies)
    for one in found.arrows:
        size, start = arrow_size(found, one.unit), magnify(found, k, one.body, found.factor)[:3]
        if size:
            ends = place(start), place(start + one.values[k] * whole / size)
            _draw_arrow(
                pen, *ends, INKS["force" if one.unit == "N" else "torque"], heads=1 + (one.unit != "N")
            )


def _draw_scale(
    pen: ImageDraw.ImageDraw, found: Animation, end: FloatArray, scale: float, font: ImageFont.FreeTypeFont
) -> None:
    """The arrow of the scale of forces up to an end, with its size before it. scale : pixels a metre"""
    size, length = arrow_size(found, "N"), scale * ARROW * max(max(body.size) for body in found.bodies)
    if size:
        start = end - [length, 0]
        _draw_arrow(pen, start, end, INKS["force"], heads=1)
        pen.text(
            (float(start[0]) - 14, float(end[1])), f"{size:g} N", fill=INKS["force"], font=font, anchor="rm"
        )


def _draw_arrow(
    pen: ImageDraw.ImageDraw, start: FloatArray, tip: FloatArray, ink: tuple[int, int, int], *, heads: int
) -> None:
    """A line with filled heads; what is shorter than a head is not drawn."""
    length = float(np.linalg.norm(tip - start))
    if length < HEAD:
        return
    along = (tip - start) / length
    aside = np.array([-along[1], along[0]])
    pen.line([*start.tolist(), *(tip - HEAD / 2 * along).tolist()], fill=ink, width=5)
    for n in range(heads):
        at = tip - n * HEAD * along
        pen.polygon(
            [
                (float(x), float(y))
                for x, y in (at, *(at - HEAD * along + s * 0.4 * HEAD * aside for s in (1, -1)))
            ],
            fill=ink,
        )
