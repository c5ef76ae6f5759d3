"""The bodies of a machine as flat faces in the order in which a picture draws them, and the machine at rest as SVG."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.model.rigid_body import Body, rotation

if TYPE_CHECKING:
    from malta.model.plant import Plant

SIDES = 28  # of a cylinder
VIEW = (math.radians(-38), math.radians(24))  # turn about the upright axis, and height of the eye
MOVER_INK, FRONT_INK, BACK_INK = (86, 143, 196), (150, 150, 150), (205, 205, 205)
STILL_WIDTH, STILL_HEIGHT = 200.0, 130.0  # units of the picture at rest, at most


class Mesh(NamedTuple):
    """A body as flat faces: points in its own frame, m, and the points of each face in order."""

    points: FloatArray  # n x 3
    faces: tuple[tuple[int, ...], ...]


def mesh_of(body: Body) -> Mesh:
    """The faces of a box, of a cylinder about z or of a sphere, which has rings of faces between two small caps.

    >>> from malta.model.rigid_body import Body
    >>> len(mesh_of(Body("plate", "box", (1.0, 1.0, 0.1))).faces)
    6
    """
    half = np.array(body.size) / 2
    if body.form == "box":
        signs = np.array([[x, y, z] for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        around = tuple((k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4))
        return Mesh(signs * half, ((3, 2, 1, 0), (4, 5, 6, 7), *around))
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = np.column_stack([half[0] * np.cos(turn), half[1] * np.sin(turn)])
    tilts = np.radians(np.linspace(-80, 80, 9))
    rings = (
        zip(np.cos(tilts), np.sin(tilts), strict=True) if body.form == "sphere" else ((1.0, -1.0), (1.0, 1.0))
    )
    levels = [np.column_stack([wide * ring, np.full(SIDES, high * half[2])]) for wide, high in rings]
    between = [
        (low + k, low + (k + 1) % SIDES, low + SIDES + (k + 1) % SIDES, low + SIDES + k)
        for low in range(0, SIDES * (len(levels) - 1), SIDES)
        for k in range(SIDES)
    ]
    count = SIDES * len(levels)
    caps = tuple(range(SIDES - 1, -1, -1)), tuple(range(count - SIDES, count))
    return Mesh(np.vstack(levels), (*caps, *between))


def poses_of(body: Body, states: Mapping[str, FloatArray], count: int) -> FloatArray:
    """Place and Cardan angles of a body in every frame."""
    columns = [states.get(name, np.zeros(count)) for name in (*body.moves, *[""] * (6 - len(body.moves)))]
    return np.asarray(np.column_stack(columns) + np.append(body.place, np.zeros(3)))


def upright_axis(plant: Plant) -> int:
    """The axis against which the weight of the mover acts; z where none is told."""
    names = [s.name for s in plant.disturbances]
    if not {"F_x", "F_y", "F_z"} <= {*names}:
        return 2
    load = np.abs(np.array(ca.DM(plant.load(ca.DM.zeros(len(plant.states))))).ravel())
    size = [load[names.index(f"F_{axis}")] for axis in "xyz"]
    return int(np.argmax(size)) if max(size) > 0 else 2


def place_points(mesh: Mesh, pose: FloatArray) -> FloatArray:
    """The points of a body in the frame of the stator, n x 3."""
    return np.asarray(mesh.points @ np.array(ca.DM(rotation(pose[3:]))) + pose[:3])


def camera(up: int, turn: float, height: float) -> FloatArray:
    """Rows: to the right, up and towards the eye, for the upright axis `up`."""
    upright, across, along = (np.eye(3)[(up + k) % 3] for k in range(3))
    eye = math.cos(height) * (math.cos(turn) * across + math.sin(turn) * along) + math.sin(height) * upright
    right = np.cross(upright, eye)
    right /= np.linalg.norm(right)
    return np.vstack([right, np.cross(eye, right), eye])


class Face(NamedTuple):
    """A face as it is drawn: what moves is filled, what stands still has edges alone.

    moves : whether its body moves
    outline : n x 2, to the right and up, m
    ink : red, green, blue, 0 to 255
    """

    moves: bool
    outline: FloatArray
    ink: tuple[int, ...]


def draw_order(
    bodies: Sequence[Body], meshes: Sequence[Mesh], poses: Sequence[FloatArray], view: FloatArray
) -> list[Face]:
    """The faces that are seen, from the back to the front: backs of still bodies, moving bodies, fronts of still ones.

    view : from `camera`
    """
    found = []
    for body, mesh, pose in zip(bodies, meshes, poses, strict=True):
        points, moves = place_points(mesh, pose) @ view.T, bool(body.moves)
        for face in mesh.faces:
            a, b, c = points[list(face[:3])]
            normal = np.cross(b - a, c - a)
            normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
            seen = bool(normal[2] > 0)
            if moves and not seen:
                continue
            light = 0.62 + 0.38 * max(0.0, float(normal @ [0.25, 0.6, 0.75]))
            lit = tuple(round(light * part) for part in MOVER_INK)
            layer, ink = (1, lit) if moves else (2, FRONT_INK) if seen else (0, BACK_INK)
            shown = Face(moves, points[list(face), :2], ink)
            found.append(((layer, float(points[list(face), 2].mean())), shown))
    return [face for _, face in sorted(found, key=lambda one: one[0])]


def machine_svg(plant: Plant) -> str:
    """Draw the bodies of a machine at rest as an <svg> element, as `malta motion` shows them; "" where it has none.

    Its colours are for light and dark pages.
    """
    if plant.bodies is None:
        return ""
    bodies = tuple(plant.bodies())
    poses = [poses_of(body, {}, 1)[0] for body in bodies]
    faces = draw_order(bodies, [mesh_of(b) for b in bodies], poses, camera(upright_axis(plant), *VIEW))
    ends = np.vstack([face.outline for face in faces])
    low, high = ends.min(axis=0), ends.max(axis=0)
    scale = min(STILL_WIDTH / (high[0] - low[0]), STILL_HEIGHT / (high[1] - low[1]))
    wide, tall = scale * (high - low) + 4
    drawn = []
    for face in faces:
        points = np.column_stack([face.outline[:, 0] - low[0], high[1] - face.outline[:, 1]]) * scale + 2
        ink = "#" + "".join(f"{part:02x}" for part in face.ink)
        look = f'fill="{ink}" stroke="{ink}"' if face.moves else f'fill="none" stroke="{ink}"'
        drawn.append(f'<path d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in points)}Z" {look}/>')
    moved = ", ".join(body.name for body in bodies if body.moves)
    still = ", ".join(body.name for body in bodies if not body.moves)
    told = html.escape(f"the machine {plant.name}: {moved}" + (f" in {still}" if still else ""))
    shape = f'viewBox="0 0 {wide:.0f} {tall:.0f}" stroke-width="0.7" stroke-linejoin="round"'
    return f'<svg class="machine" role="img" aria-label="{told}" {shape}>{"".join(drawn)}</svg>'
