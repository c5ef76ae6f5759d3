"""Logs of a machine under control: times, measured positions and commanded forces, from a run or a file."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.archives import read_npz
from malta.errors import InputError
from malta.files import read_file
from malta.units import to_si

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Plant, Signal
    from malta.simulation.trajectory import Trajectory

LARGEST = 1_000_000_000  # bytes of a log: ten minutes of ten columns at 20 kHz
SUFFIXES = (".csv", ".npz")


class ForceLog(NamedTuple):
    """Samples of a machine under control, SI."""

    source: str  # the file or the run, as errors name it
    t: FloatArray  # s, k
    z: FloatArray  # m, k, measured positions along the stroke
    v: FloatArray  # N or N m, k x m, commanded forces


def log_of(run: Trajectory) -> ForceLog:
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
