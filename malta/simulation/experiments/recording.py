"""v0(z) recorded from a slow stroke there and back, under a controller with integral action.

In steady state the commanded forces hold the mover, whatever the loads are: v + d(z) = m z'' ~ 0. What depends on the
way, as friction and the lag of the integrals, has opposite signs there and back, and the mean of both is

    v0(z) = (v_there(z) + v_back(z)) / 2

Each way is fitted by least squares with a function that is linear between the positions of a grid, as the law reads it.
Means of some neighbouring samples are fitted: the noise of a single reading of z is in the command of the same sample.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from malta.archives import read_npz
from malta.errors import InputError
from malta.files import read_file
from malta.simulation.references import QUINTIC_DURATION, Motion, Reference, quintic
from malta.synthesis.feedforward import V0_STEP, V0_STEPS
from malta.units import to_si

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray, Plant, Signal
    from malta.simulation.trajectory import Trajectory
    from malta.synthesis.controller import Controller


COVERED = 0.98  # share of the travel, either way, that a log has to cover and the recorded table covers
SWEPT = 0.99  # share of the travel that the slow stroke covers
POINTS = 4000  # means of neighbouring samples, at least, where a log has so many samples
TURN = 0.05  # share of the travel: a shorter way back is noise
LEAST = 2  # means in each interval of the grid, each way
INERTIA = 0.1  # N, largest inertial force of a stroke that counts as slow
PLACES = 20  # parts of the travel with a mean speed each


class Recorded(NamedTuple):
    """v0(z) from a log."""

    z_grid: FloatArray  # m, g
    v0: FloatArray  # N, g x m
    apart: FloatArray  # N, g x m, half of the difference between the two ways


def slow_stroke(plant: Plant, way: float) -> Reference:
    """From one end of the travel to the other and back, a quintic of `way` seconds each.

    The stroke begins and ends at -SWEPT of the travel; the other outputs stay at zero.
    """
    reach, axis = SWEPT * plant.travel, plant.stroke_output

    def at(t: FloatArray) -> Motion:
        motion = [np.zeros((len(t), len(plant.outputs))) for _ in range(3)]
        there, back = (quintic(t - centre, way / QUINTIC_DURATION) for centre in (way / 2, 1.5 * way))
        for column, one, other, offset in zip(motion, there, back, (-reach, 0.0, 0.0), strict=True):
            column[:, axis] = offset + 2 * reach * (one - other)
        return Motion(*motion)

    return at


def record(log: ForceLog, plant: Plant) -> Recorded:
    """The forces v0(z) that held a machine along its travel, from a log of a slow stroke there and back.

    Raises InputError, naming the log, where it does not cover the travel in both directions, or where the stroke is
    so fast that inertia takes a part of the forces.

        recorded = record(read_log("stand.csv", plant), plant)
    """
    reach = COVERED * plant.travel
    low, high = float(log.z.min()), float(log.z.max())
    if low > -reach or high < reach:
        found = f"positions from {low * 1e3:.4g} to {high * 1e3:.4g} mm"
        raise InputError(
            log.source, plant.stroke, found, f"the travel, -{reach * 1e3:.4g} to {reach * 1e3:.4g} mm"
        )
    half = max(V0_STEPS, math.ceil(reach / V0_STEP))
    z_grid = np.linspace(-reach, reach, 2 * half + 1)
    means = _average(log)
    _require_slow(means, plant)
    rising = _rising(means.z, TURN * plant.travel)
    there, back = (
        _fit(means._replace(z=means.z[chosen], v=means.v[chosen]), z_grid, plant.stroke, way)
        for chosen, way in ((rising, "there"), (~rising, "back"))
    )
    return Recorded(z_grid, (there + back) / 2, (there - back) / 2)


def with_recorded(c: Controller, recorded: Recorded) -> Controller:
    """The controller with the recorded v0(z) in its feedforward, named NAME_recorded."""
    name = c.name if c.name.endswith("_recorded") else f"{c.name}_recorded"
    table = replace(c.feedforward, z_grid=recorded.z_grid, v0=recorded.v0)
    return replace(c, name=name, feedforward=table)


def require_integral_action(c: Controller) -> None:
    """Raise InputError for a controller that leaves a load at an offset, whose forces are not those of the load."""
    if c.tracks == "states" and not c.integrating and not c.observed:
        expected = "gains with integrals or observed disturbances"
        raise InputError("record-v0", "gains", f"{c.name}, without integral action", expected)


def _average(log: ForceLog) -> ForceLog:
    """Means of neighbouring samples; the last samples are left out where they do not fill a mean."""
    size = max(1, len(log.z) // POINTS)
    count = len(log.z) // size * size
    t, z, v = (s[:count].reshape(-1, size, *s.shape[1:]).mean(axis=1) for s in (log.t, log.z, log.v))
    return log._replace(t=t, z=z, v=v)


def _rising(z: FloatArray, turn: float) -> NDArray[np.bool_]:
    """True on a way towards positive z; a way back that is shorter than `turn` counts as noise."""
    from scipy.signal import find_peaks  # a third of a second to import

    turns = np.concatenate([find_peaks(sign * z, prominence=turn)[0] for sign in (1, -1)])
    edges = [0, *sorted(turns.tolist()), len(z)]
    rising = np.zeros(len(z), dtype=bool)
    for first, last in pairwise(edges):
        rising[first:last] = z[last - 1] > z[first]
    return rising


def _require_slow(log: ForceLog, plant: Plant) -> None:
    """Raise InputError where the mover's kinetic energy changes by more than INERTIA times the way.

    The speed is the mean one in each of PLACES parts of the travel, so that noise does not show.
    """
    edges = np.linspace(-COVERED * plant.travel, COVERED * plant.travel, PLACES + 1)
    middle, speed = (log.z[1:] + log.z[:-1]) / 2, np.abs(np.diff(log.z) / np.diff(log.t))
    place = np.digitize(middle, edges)
    mean = np.array([speed[place == k].mean() for k in range(1, PLACES + 1) if (place == k).any()])
    force = plant.mass / 2 * np.abs(np.diff(mean**2)).max(initial=0.0) / (edges[1] - edges[0])
    if force > INERTIA:
        found = f"a stroke that accelerates the mover by {force:.3g} N"
        raise InputError(log.source, plant.stroke, found, f"a slow one: at most {INERTIA:g} N")


def _fit(log: ForceLog, z_grid: FloatArray, stroke: str, way: str) -> FloatArray:
    """Values at the grid of the function, linear between them, that fits v(z) best: g x m.

    Raises InputError where an interval of the grid has too few samples.
    """
    inside = (log.z >= z_grid[0]) & (log.z <= z_grid[-1])
    z, v = log.z[inside], log.v[inside]
    k = np.clip(np.searchsorted(z_grid, z, side="right") - 1, 0, len(z_grid) - 2)
    counts = np.bincount(k, minlength=len(z_grid) - 1)
    if counts.min() < LEAST:
        found = f"no way {way} past {z_grid[int(counts.argmin())] * 1e3:.4g} mm"
        raise InputError(log.source, stroke, found, "a slow stroke there and back over the whole travel")
    b = (z - z_grid[k]) / (z_grid[k + 1] - z_grid[k])
    a, g = 1 - b, len(z_grid)
    normal = np.zeros(
        (2, g)
    )  # the symmetric tridiagonal matrix of the normal equations: diagonal, then below it
    normal[0] = np.bincount(k, a * a, g) + np.bincount(k + 1, b * b, g)
    normal[1] = np.bincount(k, a * b, g)
    right = [np.bincount(k, a * f, g) + np.bincount(k + 1, b * f, g) for f in v.T]
    return np.asarray(solveh_banded(normal, np.column_stack(right), lower=True))


# Logs of a machine under control: times, measured positions and commanded forces, from a run or a file.


LARGEST = 1_000_000_000  # bytes of a log: ten minutes of ten columns at 20 kHz
SUFFIXES = (".csv", ".npz")


class ForceLog(NamedTuple):
    """Samples of a machine under control, SI."""

    source: str  # the file or the run, as errors name it
    t: FloatArray  # s, k
    z: FloatArray  # m, k, measured positions along the stroke
    v: FloatArray  # N or N m, k x m, commanded forces


def force_log(run: Trajectory) -> ForceLog:
    """The log of a simulated run of a machine with a stroke."""
    return ForceLog(run.scenario.name, run.t, run.y[:, run.plant.stroke_output], run.v)


def read_log(path: str | Path, plant: Plant) -> ForceLog:
    """Read a log: a .csv with a line of headings, or the .npz that `malta simulate --out` writes of a run.

    Columns: t, the stroke of the machine, and its inputs, each "name [unit]", as "z [mm]" or "fx_B1 [N]". The .npz has
    them as t, as a column of y (measured outputs) and as columns of v (commanded forces). Other columns are ignored.

    Raises InputError: no such file, another suffix, a missing column, a unit that does not fit, a cell that is not a
    finite number, times that do not rise.

        log = read_log("stand.csv", plant)
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(path, "", f"suffix {path.suffix!r}", "one of " + ", ".join(SUFFIXES))
    if path.suffix == ".csv":
        text = read_file(path, "log of a run", lambda p: p.read_text(encoding="utf-8-sig"), LARGEST)
        columns = _csv_columns(text, path)
    else:
        columns = _npz_columns(read_file(path, "log of a run", Path.read_bytes, LARGEST), path)
    stroke = plant.outputs[plant.stroke_output]
    t = _series(columns, "t", "s", path)
    if len(t) < 2 or not (np.diff(t) > 0).all():
        raise InputError(path, "t", "times that do not rise", "the times of the samples, in order")
    v = [_series(columns, s.name, s.unit, path) for s in plant.inputs]
    return ForceLog(str(path), t, _series(columns, stroke.name, stroke.unit, path), np.column_stack(v))


def columns_of_log(plant: Plant) -> tuple[str, ...]:
    """The headings that a log has to have."""
    wanted: tuple[Signal, ...] = (plant.outputs[plant.stroke_output], *plant.inputs)
    return ("t [s]", *(f"{s.name} [{s.unit}]" for s in wanted))


def _csv_columns(text: str, path: Path) -> dict[str, FloatArray]:
    """The columns of a .csv by their headings; a cell that is no number becomes NaN."""
    rows = [row for row in csv.reader(text.splitlines()) if row]
    headings = [heading.strip() for heading in rows[0]] if rows else []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(headings):
            expected = f"{len(headings)}, as in the first"
            raise InputError(path, f"line {number}", f"{len(row)} cells", expected)
    return {name: np.array([_number(row[k]) for row in rows[1:]]) for k, name in enumerate(headings)}


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _npz_columns(content: bytes, path: Path) -> dict[str, FloatArray]:
    """The times, measured outputs and commanded forces of a saved run by their headings."""
    try:
        arrays = read_npz(content)
    except ValueError as error:
        found = f"a file that numpy cannot read safely ({error})"
        raise InputError(path, "", found, "an .npz archive of a run, not compressed") from error
    t = arrays.get("t", np.zeros(0))
    columns = {"t [s]": _of_numbers(t, (len(t) if t.ndim else 0,), "t", path)}
    for name in ("y", "v"):
        headings = arrays.get(f"{name}_columns")
        if name in arrays and headings is not None:
            if headings.dtype.kind != "U" or headings.ndim != 1:
                found = f"an array of {headings.dtype}, {headings.shape}"
                raise InputError(path, f"{name}_columns", found, "a list of headings")
            table = _of_numbers(arrays[name], (len(t), len(headings)), name, path)
            columns |= dict(zip(headings.tolist(), table.T, strict=True))
    return columns


def _of_numbers(array: Any, shape: tuple[int, ...], name: str, path: Path) -> FloatArray:
    if array.dtype.kind not in "fiu" or array.shape != shape:
        raise InputError(path, name, f"an array of {array.dtype}, {array.shape}", f"numbers, {shape}")
    return np.asarray(array, dtype=float)


def _series(columns: Mapping[str, FloatArray], name: str, unit: str, path: Path) -> FloatArray:
    """A column by the name of its signal, in SI."""
    pattern = re.compile(re.escape(name) + r"\s*\[(.*)\]")
    found = [(match[1], values) for key, values in columns.items() if (match := pattern.fullmatch(key))]
    if len(found) != 1:
        raise InputError(
            path, name, f"{len(found) or 'no'} such columns", f"one, with the heading {name} [{unit}]"
        )
    given, values = found[0]
    values = np.asarray(values, dtype=float) * to_si(1.0, given, unit, path, name)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise InputError(path, name, f"no finite number in row {bad[0] + 1}", "a number in every row")
    return values
