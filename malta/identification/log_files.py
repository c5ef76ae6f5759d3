"""Logs as files that other programs read: .csv with units, .npz, .mat and .parquet."""

from __future__ import annotations

import ctypes
import io
import math
import re
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError, relocate_errors
from malta.files import read_file, read_packaged, require_suffix
from malta.gains.encodings import read_mat
from malta.identification.dump import decode_dump
from malta.identification.log import GROUPS, Log
from malta.model.plant import Signal
from malta.simulation.engine.compiled import address_of, library
from malta.simulation.engine.sample_loops import SAMPLE_LOOP_FLAGS
from malta.tables import read_npz
from malta.units import is_unit_of, si_unit_of, to_si
from malta.writing import replace_files

VERSION = 1
MAX_LOG_BYTES = 2_000_000_000  # bytes of a log
MAX_READING = 1e30  # SI: no reading is beyond it, and squares and sums of those within are numbers
SUFFIXES = (".csv", ".npz", ".mat", ".parquet")
TEXTS = ("machine", "controller")  # of a file's head; sample_time and period are numbers, s


def without_idle(log: Log) -> Log:
    """The log without columns of currents and voltages that are zero throughout."""
    columns, signals = dict(log.columns), dict(log.signals)
    for group in ("i", "u"):
        table = columns.get(group, np.zeros((0, 0)))
        used = [k for k in range(table.shape[1]) if table[:, k].any()]
        columns[group], signals[group] = table[:, used], tuple(signals.get(group, ())[k] for k in used)
    return replace(log, columns=columns, signals=signals)


def write_log(log: Log, path: str | Path) -> Path:
    """Write a log as .csv, .npz, .mat or .parquet; docs/formats/log.md describes the files.

    log : what to write
    path : the suffix chooses the encoding; .parquet needs pyarrow

    Returns the path. Raises InputError for another suffix, without pyarrow, and for a file that cannot be written.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> malta.identification.write_log(
    ...     malta.identification.log_of(run), "build/stand.npz"
    ... ).name
    'stand.npz'
    """
    path = Path(path)
    require_suffix(path, *SUFFIXES)
    log = without_idle(log)
    encoders: dict[str, Callable[[Log], bytes]] = {".csv": _to_csv, ".npz": _to_npz, ".mat": _to_mat}
    encode = encoders.get(path.suffix.lower(), _to_parquet)
    replace_files({path: encode(log)})
    return path


def _headings(log: Log, group: str) -> list[str]:
    return [f"{s.name} [{s.unit}]" for s in log.signals.get(group, ())]


def _head(log: Log) -> dict[str, str]:
    """What a text says of a log beside its columns."""
    names = {"machine": log.machine, "controller": log.controller}
    return names | {"sample_time": f"{log.sample_time!r} s", "period": f"{log.period!r} s"}


def _one_table(log: Log) -> tuple[list[str], FloatArray]:
    """Headings with prefixes, and all columns beside t."""
    present = [group for group in GROUPS if log.names(group)]
    headings = [
        "t [s]",
        *(_prefix_of(g, heading, log.source) + heading for g in present for heading in _headings(log, g)),
    ]
    return headings, np.column_stack([log.t, *(log.columns[group] for group in present)])


def _arrow(path: Path | str) -> tuple[Any, Any]:
    """pyarrow and its module of Parquet files. Raises InputError where it is not installed."""
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        expected = "pyarrow, as by pip install pyarrow; or .csv, .npz, .mat"
        raise InputError(path, "", "a .parquet file without pyarrow", expected) from None


def _to_parquet(log: Log) -> bytes:
    """A column of doubles for each heading, and the head as metadata of the schema."""
    arrow, parquet = _arrow("log")
    headings, table = _one_table(log)
    head = {"malta log": str(VERSION)} | _head(log)
    buffer = io.BytesIO()
    parquet.write_table(arrow.table(list(table.T.copy()), names=headings, metadata=head), buffer)
    return buffer.getvalue()


def _from_parquet(content: bytes, path: Path) -> Decoded:
    arrow, parquet = _arrow(path)
    try:
        read = parquet.read_table(io.BytesIO(content), use_threads=False)
        columns = [
            np.asarray(column.cast(arrow.float64()).to_numpy(), dtype=float) for column in read.columns
        ]
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise InputError(
            path, "", f"a damaged file ({str(error)[:80]})", "a Parquet file of numbers"
        ) from error
    stored = read.schema.metadata or {}
    words = {
        name.decode(errors="replace"): value.decode(errors="replace").split()
        for name, value in stored.items()
    }
    head = {name: text[0] for name, text in words.items() if text}
    if not columns:
        raise InputError(path, "", "no columns", "t [s], x1 [m], ...")
    return _tables_of(head, [name.strip() for name in read.column_names], columns, path)


def _to_csv(log: Log) -> bytes:
    """A head of comments, a line of headings, and a line a sample."""
    present = [group for group in GROUPS if log.names(group)]
    head = [f"# malta log {VERSION}", *(f"# {name} {value}" for name, value in _head(log).items())]
    headings, table = _one_table(log)
    head.append(",".join(headings))
    buffer = io.StringIO()
    buffer.write("\n".join(head) + "\n")
    sent = ("reference", "excitation")  # with all digits: they are differentiated
    formats = ["%.12g", *("%.17g" if g in sent else "%.9g" for g in present for _ in log.names(g))]
    np.savetxt(buffer, table, fmt=formats, delimiter=",")
    return buffer.getvalue().encode()


def _arrays(log: Log) -> dict[str, Any]:
    """What the binary files hold."""
    arrays: dict[str, Any] = {"malta_log": np.array([VERSION]), "t": log.t}
    arrays |= {"sample_time": np.array([log.sample_time]), "period": np.array([log.period])}
    for group in GROUPS:
        if log.names(group):
            arrays |= {group: log.columns[group], f"{group}_columns": np.array(_headings(log, group))}
    return arrays


def _to_npz(log: Log) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, machine=np.array([log.machine]), controller=np.array([log.controller]), **_arrays(log))
    return buffer.getvalue()


def _to_mat(log: Log) -> bytes:
    from scipy.io import savemat

    buffer: Any = io.BytesIO()  # any: scipy's stubs know only file names
    arrays = {k: a.astype(object) if a.dtype.kind == "U" else a for k, a in _arrays(log).items()}
    arrays |= {"machine": log.machine, "controller": log.controller, "t": log.t[:, None]}
    savemat(buffer, arrays)
    return bytes(buffer.getvalue())


def read_log(path: str | Path, groups: Collection[str] = tuple(GROUPS)) -> Log:
    """Read a log: a .csv, .npz, .mat or .parquet of malta, or a .csv of another program with headings "name [unit]".

    A .dump is the memory of the ring buffer of exported C, `malta export --log`.

    path : the file. Units are converted to SI; a cell that is empty or nan is a missing reading.
    groups : of its columns that are read, as ("y", "i"): of large files some take less time than all

    Returns a Log. Signals of headings without a prefix are found by their unit when the log is used. Positions and
    angles are measured outputs, forces and torques commands, currents and voltages those of the axes. Others have a
    prefix, as "y.a [m/s^2]" of a measured acceleration, "v.u [V]" of a commanded voltage, "ref." or "flag.".

    Raises InputError: no such file, another suffix, damage, headings that are no "name [unit]", times that do not rise.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> file = malta.identification.write_log(
    ...     malta.identification.log_of(run), "build/stand.csv"
    ... )
    >>> malta.identification.read_log(file).samples
    2000
    """
    path = Path(path)
    suffix = require_suffix(path, *SUFFIXES, ".dump").suffix.lower()
    content = read_file(path, "log", Path.read_bytes, MAX_LOG_BYTES)
    decoders: dict[str, Callable[[bytes, Path], Decoded]]
    decoders = {
        ".csv": partial(_from_csv, groups=groups),
        ".npz": _from_npz,
        ".mat": _from_mat,
        ".dump": decode_dump,
    }
    head, t, tables, headings = decoders.get(suffix, _from_parquet)(content, path)
    if len(t) < 2 or not ((np.diff(t) > 0).all() and np.abs(t).max() < MAX_READING):
        raise InputError(path, "t", "times that do not rise", "the times of the samples, in order")
    columns, signals = {}, {}
    for group in [name for name in tables if name in groups]:
        columns[group], signals[group] = _in_si(tables[group], headings[group], path)
    if "y" not in columns:
        raise InputError(path, "y", "no measured outputs", "columns of positions, as x1 [m]")
    Ts = _seconds(head, "sample_time", path) or float(np.median(np.diff(t)))
    names = (str(head.get("machine", "")), str(head.get("controller", "")))
    period = _seconds(head, "period", path)
    return Log(str(path), *names, Ts, period, t, columns, signals, sha256(content).hexdigest())


def _seconds(head: Mapping[str, Any], name: str, path: Path) -> float:
    """A time of a file's head; 0 where it has none."""
    found = head.get(name, 0.0)
    try:
        seconds = float(found)
    except (TypeError, ValueError):
        seconds = math.nan
    if not 0 <= seconds < MAX_READING:
        raise InputError(path, name, repr(found), "a number of seconds")
    return seconds


Decoded = tuple[dict[str, Any], "FloatArray", dict[str, "FloatArray"], dict[str, list[str]]]
"""What a file holds: its head, t, and by group a table and its headings."""


def _from_csv(content: bytes, path: Path, groups: Collection[str]) -> Decoded:
    """The head, times, tables and headings of a .csv."""
    try:
        head, names, begin = _csv_head(content)
    except UnicodeDecodeError as error:
        raise InputError(path, "", "bytes that are no text", "UTF-8") from error
    if not names:
        raise InputError(path, "", "no line of headings", 'a line as "t [s],x1 [um],..."')
    _require_times(names, path)
    used = [k for k, name in enumerate(names) if k == 0 or _group_of(name, path) in groups]
    columns = _fast_columns(content, begin, len(names), used)
    try:
        if columns is None:
            columns = _columns(content, begin, len(names), used)
    except UnicodeDecodeError as error:
        raise InputError(path, "", "bytes that are no text", "UTF-8") from error
    except ValueError as error:
        raise InputError(path, "", f"a line that cannot be read ({str(error)[:80]})", "numbers") from error
    if not columns or not len(columns[0]):
        raise InputError(path, "", "headings alone", "a line of numbers for each sample")
    if len(columns) != len(used):
        raise InputError(path, "", f"{len(columns)} cells in a line", f"{len(names)}, as headings")
    return _tables_of(head, [names[k] for k in used], columns, path)


def _csv_head(content: bytes) -> tuple[dict[str, Any], list[str], int]:
    """The comments of a .csv as a head, its headings, and the byte where its rows begin."""
    lines, head = io.BytesIO(content), dict[str, Any]()
    while line := lines.readline():
        text = line.decode("utf-8-sig").strip()
        if text.startswith("#"):
            words = text[1:].split()
            head |= {words[0]: words[1]} if len(words) > 1 else {}
        elif text:
            return head, [name.strip() for name in text.split(",")], lines.tell()
    return head, [], len(content)


def _fast_columns(content: bytes, begin: int, count: int, used: list[int]) -> list[FloatArray] | None:
    """Columns of a .csv from a byte on by compiled C, to the bit those of numpy; NaN for an empty cell.

    None without a compiler, and for what that does not take: numpy reads it, or says what is wrong.
    """
    read = library(read_packaged("identification/cells.c").decode(), 1, flags=SAMPLE_LOOP_FLAGS)
    if read is None:
        return None
    wanted = np.isin(np.arange(count), used).astype(np.uint8)
    table = np.empty((content.count(b"\n", begin) + 1, len(used)))
    read.cells.restype = ctypes.c_long
    text = address_of(np.frombuffer(content, np.uint8)[begin:])
    size, cells, most = (ctypes.c_long(n) for n in (len(content) - begin, count, len(table)))
    rows = read.cells(text, size, cells, address_of(wanted), most, address_of(table))
    return None if rows < 1 else list(table[:rows].T)


def _columns(content: bytes, begin: int, count: int, used: list[int]) -> list[FloatArray]:
    """Columns of a .csv from a byte on, NaN for an empty cell. Raises ValueError for what is no number."""

    def rows() -> io.TextIOWrapper:
        data = io.BytesIO(content)
        data.seek(begin)
        return io.TextIOWrapper(data, "utf-8")

    # Where all are read, their number in each line is checked.
    only: Any = used if len(used) < count else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without rows, which is refused later
        try:
            table = np.loadtxt(rows(), delimiter=",", comments=None, ndmin=2, usecols=only)
        except ValueError:
            if not re.search(rb",\s*(,|$)", content, re.M):
                raise
            # Cells are empty where readings are missing: a slower reader takes them.
            table = np.genfromtxt(rows(), delimiter=",", ndmin=2, usecols=only)
    if only and content.count(b",", begin) != (count - 1) * len(table):
        raise ValueError("lines of different length")
    return list(table.T)


def _tables_of(head: dict[str, Any], names: list[str], columns: list[FloatArray], path: Path) -> Decoded:
    """The tables of a file that is one table, whose first column is t."""
    _require_times(names, path)
    places: dict[str, list[int]] = {}
    for k, name in enumerate(names[1:], start=1):
        group = _group_of(name, path)
        places.setdefault(group, []).append(k)
    scale = to_si(1.0, _parts(names[0], path)[1], "s", path, "t")
    tables = {group: np.column_stack([columns[k] for k in found]) for group, found in places.items()}
    headings = {
        group: [names[k].removeprefix(GROUPS[group] or f"{group}.") for k in found]
        for group, found in places.items()
    }
    return head, columns[0] * scale, tables, headings


def _require_times(names: list[str], path: Path) -> None:
    if not names[0].startswith("t ") and names[0] != "t":
        raise InputError(path, names[0], "the first column", "t [s]")


def _group_of(heading: str, path: Path) -> str:
    """The group of a column of a .csv by its prefix, or by its unit."""
    for group, prefix in GROUPS.items():
        if heading.startswith(prefix or f"{group}."):
            return group
    unit = _parts(heading, path)[1]
    found = _group_by_unit(unit)
    if not found:
        expected = "one of m, rad, N, N m, A, V, or a prefix as y., ref. or flag."
        raise InputError(path, heading, f"unit {unit!r}", expected)
    return found


def _group_by_unit(unit: str) -> str:
    """The group of a column without a prefix; "" for another unit than those that tell one."""
    for si_unit, group in (("m", "y"), ("rad", "y"), ("N", "v"), ("N m", "v"), ("A", "i"), ("V", "u")):
        if is_unit_of(unit, si_unit):
            return group
    return ""


def _prefix_of(group: str, heading: str, path: str) -> str:
    """What stands before a heading in a file that is one table: nothing where its unit tells the group."""
    told = _group_by_unit(_parts(heading, Path(path))[1]) == group
    return GROUPS[group] or ("" if told else f"{group}.")


def _parts(heading: str, path: Path) -> tuple[str, str]:
    """Name and unit of a heading."""
    name, bracket, rest = heading.partition("[")
    if not bracket or not rest.endswith("]") or not name.strip():
        raise InputError(path, heading, "a heading without unit", 'one as "x1 [um]"')
    return name.strip(), rest[:-1].strip()


SI_UNITS = ("m", "rad", "N", "N m", "A", "V", "1")


def _in_si(table: FloatArray, headings: list[str], path: Path) -> tuple[FloatArray, tuple[Signal, ...]]:
    """A table in SI, and its signals."""
    table, signals, factors = np.asarray(table, dtype=float), [], []
    for heading in headings:
        name, unit = _parts(heading, path)
        si_unit = next((one for one in SI_UNITS if is_unit_of(unit, one)), None)
        if si_unit is None:
            with relocate_errors(path, heading):
                si_unit = si_unit_of(unit)
        factors.append(to_si(1.0, unit, si_unit, path, name))
        signals.append(Signal(name, si_unit))
    if any(factor != 1 for factor in factors):
        table = table * factors
    ends = np.fmin.reduce(table, axis=None, initial=0), np.fmax.reduce(table, axis=None, initial=0)
    if max(map(abs, ends)) >= MAX_READING:
        row, column = np.argwhere(np.abs(table) >= MAX_READING)[0]
        found = f"{table[row, column]:g} in sample {row + 1}"
        raise InputError(path, headings[column], found, "a reading, or nothing where it is missing")
    table.flags.writeable = False  # so that a log takes it as it is
    return table, tuple(signals)


def _from_npz(content: bytes, path: Path) -> Decoded:
    try:
        arrays = read_npz(content)
    except ValueError as error:
        found = f"a file that numpy cannot read safely ({error})"
        raise InputError(path, "", found, "an .npz archive, not compressed") from error
    return _from_arrays(arrays, path)


def _from_mat(content: bytes, path: Path) -> Decoded:
    try:
        given = read_mat(content)
    except ValueError as error:
        raise InputError(path, "", f"a damaged file ({error})", "a MAT-file of version 5") from error
    arrays = {
        name: np.array(value) if isinstance(value, str | list) else value for name, value in given.items()
    }
    if "t" in arrays:
        arrays["t"] = np.ravel(arrays["t"])
    return _from_arrays(arrays, path)


def _from_arrays(arrays: Mapping[str, Any], path: Path) -> Decoded:
    """Head, times, tables and headings of the arrays of a file; also those of a run of `malta simulate --out`."""
    head = {
        name: arrays[name].ravel()[0] for name in (*TEXTS, "sample_time", "period")
        if name in arrays and arrays[name].size
    }  # fmt: skip
    t = arrays.get("t", np.zeros(0))
    if t.dtype.kind not in "fiu" or t.ndim != 1:
        raise InputError(path, "t", f"an array of {t.dtype}, {t.shape}", "the times of the samples, in order")
    tables, headings = {}, {}
    for group in GROUPS:
        if group not in arrays:
            continue
        table, names = arrays[group], arrays.get(f"{group}_columns")
        if names is None or names.dtype.kind != "U" or names.ndim != 1:
            raise InputError(path, f"{group}_columns", "no headings", f"those of {group}")
        if table.dtype.kind not in "fiub" or table.shape != (len(t), len(names)):
            found = f"an array of {table.dtype}, {table.shape}"
            raise InputError(path, group, found, f"numbers, ({len(t)}, {len(names)})")
        tables[group], headings[group] = table, [str(name) for name in names]
    return head, np.asarray(t, dtype=float), tables, headings
