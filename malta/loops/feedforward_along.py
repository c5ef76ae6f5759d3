"""v0(z) of a law along the stroke, in a proof that has the position as a parameter.

A law looks v0(z) up in a table, linear between its places: its slope dv0/dz jumps there. Along the stroke a proof takes

    dv0/dz = s(z) + e,   |e| <= largest difference over all cells of the table

s is the slope of the forces that hold the law's own machine, and e one more parameter of each force. What the reading
makes of v0, (s(z) + e) y_z, is a further output of the machine, which the law adds to its forces as it adds v0.

Sines and their like of the position, as of a cogging force, are parameters as well. A proof over all their values holds
for those that a position has; a machine that is found unstable need not be one, see `malta.margins.travel`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import CheckError
from malta.linear.branches import INTERVALS, SYMBOLS, Interval
from malta.linear.expressions import MatrixProgram, NotAnalytic, is_rational_step, program
from malta.linear.uncertain import Derived, UncertainSystem
from malta.loops.parametric_plants import rest_model
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller, Feedforward

ROUNDING = 1e-9  # of the largest v0, and of its steepest slope: what a table has of rounding


@dataclass(frozen=True, eq=False)
class SlopesAlong:
    """The slopes of v0 along the stroke: of the forces that have some."""

    forces: tuple[int, ...]
    rough: tuple[int, ...]  # of these, where the table differs from s by more than rounding
    names: tuple[str, ...]  # of the parameters e of these
    s: ca.Function  # z -> slopes, N/m
    error: FloatArray  # of each, N/m: the largest |e|
    table: Feedforward

    def at(self, z: float) -> FloatArray:
        """The parameters e at a position: the slope of the table there, less s(z)."""
        return np.asarray(self.table.slope(z)[list(self.forces)] - np.array(self.s(z)).ravel())[
            list(self.rough)
        ]


@lru_cache(maxsize=16)  # plants and controllers compare by identity
def slopes_along(plant: Plant, controller: Controller) -> SlopesAlong | None:
    """The slopes of a law's v0 over the travel of a machine; None where v0 is the same everywhere."""
    grid, v0 = controller.feedforward.z_grid, controller.feedforward.v0
    if not plant.has_stroke or len(grid) < 2:
        return None
    forces = tuple(np.flatnonzero(np.ptp(v0, axis=0) > ROUNDING * np.abs(v0).max()).tolist())
    if not forces:
        return None
    table = grid, v0[:, list(forces)]
    s = _believed_slopes(plant_of(controller.parameters), forces)
    error = _differences(s, *table, plant.stroke.travel)
    if not np.isfinite(error).all():
        z = ca.SX.sym("z")
        s = ca.Function("s", [z], [ca.SX.zeros(len(forces))])
        error = _differences(s, *table, plant.stroke.travel)
    steepest = np.abs(np.diff(table[1], axis=0) / np.diff(grid)[:, None]).max()
    rough = tuple(np.flatnonzero(error > ROUNDING * steepest).tolist())
    names = tuple(f"dv0_{plant.inputs[forces[k]].name}" for k in rough)
    return SlopesAlong(forces, rough, names, s, readonly(error[list(rough)]), controller.feedforward)


def _believed_slopes(believed: Plant, forces: tuple[int, ...]) -> ca.Function:
    """The slopes of the forces that hold the law's own machine; zero where these are no function of z."""
    z = ca.SX.sym("z")
    try:
        _, u, _ = rest_model(believed, ()).function(ca.SX.zeros(0), z)
    except CheckError:
        u = ca.SX.zeros(len(believed.inputs))
    return ca.Function("s", [z], [ca.densify(ca.jacobian(u[list(forces)], z))])


def _differences(s: ca.Function, grid: FloatArray, v0: FloatArray, travel: float) -> FloatArray:
    """The largest difference between the slopes of a table and s(z) within the travel, rounded up; else infinite."""
    places = [-travel, *(z for z in grid.tolist() if -travel < z < travel), travel]
    found, steps = np.zeros(v0.shape[1]), np.diff(v0, axis=0) / np.diff(grid)[:, None]
    own = program(s)
    for low, high in pairwise(places):
        k = int(np.searchsorted(grid, (low + high) / 2)) - 1
        slope = steps[k] if 0 <= k < len(steps) else np.zeros(len(found))
        try:
            (entries,) = own.run([Interval(low, high)], INTERVALS)
        except NotAnalytic:
            return np.full(len(found), np.inf)
        ends = np.zeros((len(found), 2))
        for i, _, x in entries:
            ends[i] = x.low, x.high
        found = np.maximum(found, np.abs(ends - slope[:, None]).max(axis=1))
    return found * (1 + 1e-12) + math.ulp(0.0)


@lru_cache(maxsize=16)  # of equal systems all is computed once; records compare by identity
def along_stroke(system: UncertainSystem, plant: Plant, slopes: SlopesAlong | None) -> UncertainSystem:
    """The machine with (s(z) + e) y_z as outputs behind its readings; z is one of the system's parameters.

    What a load makes of the position, as the sine of a cogging force, becomes a parameter of its own as well: the
    matrices are short functions then, and a bound over all of its values holds at each z.
    """
    count = 0 if slopes is None else len(slopes.names)
    p, stroke = ca.SX.sym("p", len(system.names) + count), plant.stroke.name
    own, z = p[: len(system.names)], p[system.names.index(stroke)]
    A, B, C, *rest = (ca.SX(M) for M in system.matrices.call([own]))
    if slopes is not None:
        readings = len(plant.outputs)
        along: Any = slopes.s(z)
        for k, index in enumerate(slopes.rough):
            along[index] += p[len(system.names) + k]
        more: Any = along @ C[plant.stroke_output, :]
        C = ca.vertcat(C[:readings, :], more, C[readings:, :])
    above = [] if system.positive is None else [system.positive(own)]
    found = _without_waves(
        ca.Function("whole", [p], ca.cse([A, B, C, *rest, *above])), system.names.index(stroke)
    )
    names = tuple(f"{stroke}_{k + 1}" for k in range(found.waves.size1_out(0)))
    if not (names or count):
        return system
    ends = _hull(found.waves, plant.stroke.travel)
    e = {} if slopes is None else dict(zip(slopes.names, slopes.error.tolist(), strict=True))
    intervals = {name: (-x, x) for name, x in e.items()} | dict(zip(names, ends, strict=True))

    def values(at: float) -> FloatArray:
        return np.concatenate([[] if slopes is None else slopes.at(at), np.array(found.waves(at)).ravel()])

    position = float(system.nominal[system.names.index(stroke)])
    return replace(
        system,
        names=(*system.names, *intervals),
        nominal=readonly(np.concatenate([system.nominal, values(position)])),
        matrices=ca.Function("matrices", [found.p], found.parts[: 3 + len(rest)]),
        limits=(*system.limits, *[(-math.inf, math.inf)] * len(intervals)),
        positive=ca.Function("positive", [found.p], found.parts[3 + len(rest) :]) if above else None,
        derived=Derived(stroke, values, intervals),
    )


class _StrokeFunctions(NamedTuple):
    """Matrices in symbols p and in those of what were foreign operations of z alone, and these by z."""

    p: Any
    parts: list[Any]
    waves: ca.Function


def _without_waves(matrices: ca.Function, index: int) -> _StrokeFunctions:
    """The function with the foreign operations of one parameter alone as further inputs.

    index : of the parameter z among the inputs
    """
    model = program(matrices)
    p, z = ca.SX.sym("p", model.inputs), ca.SX.sym("z")
    column = ca.vertsplit(p)
    column[index] = z
    values, place = model.cells(column, SYMBOLS), dict[str, int]()
    steps, waves = list(model.steps), list[Any]()
    for k, (name, _, _, power) in enumerate(model.steps):
        if model.reach[k] == {index} and not is_rational_step(name, power):
            text = str(values[k])
            if text not in place:
                place[text] = len(waves)
                waves.append(values[k])
            steps[k] = ("input", model.inputs + place[text], (), 0.0)
    q = ca.SX.sym("p", model.inputs + len(waves))
    made = MatrixProgram(tuple(steps), model.entries, model.shapes, model.inputs + len(waves))
    parts = [ca.SX(*shape) for shape in made.shapes]
    for part, entries in zip(parts, made.run(ca.vertsplit(q), SYMBOLS), strict=True):
        for i, j, x in entries:
            part[i, j] = x
    return _StrokeFunctions(q, parts, ca.Function("waves", [z], [ca.vertcat(*waves)]))


PIECES = 64  # of the travel, over which a function of the position is enclosed


def _hull(function: ca.Function, travel: float) -> list[tuple[float, float]]:
    """Intervals that hold the values of a function of the position within the travel, either way."""
    own, edges = program(function), np.linspace(-travel, travel, PIECES + 1).tolist()
    ends = np.repeat([[math.inf, -math.inf]], own.shapes[0][0], axis=0)
    for low, high in pairwise([-travel, *edges[1:-1], travel]):
        (entries,) = own.run([Interval(low, high)], INTERVALS)
        for i, _, x in entries:
            ends[i] = min(ends[i, 0], x.low), max(ends[i, 1], x.high)
    return [(low, high) for low, high in ends.tolist()]
