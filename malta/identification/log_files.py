"""Logs as files: those that malta writes, as .csv, .npz, .mat and .parquet, and those of instruments and others."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError, relocate_errors
from malta.files import read_file, require_suffix
from malta.identification.dump import decode_dump
from malta.identification.log import GROUPS, Log
from malta.identification.readers.arrays import arrays_log
from malta.identification.readers.choice import ColumnChoice, decode_columns, excitation_table, group_by_unit
from malta.identification.readers.instruments import bag_log, mcap_log, mdf_log, parquet_log, tdms_log
from malta.identification.readers.matlab import LEAST_ROOM, MOST_RATIO, hdf5_tree, mat_tree
from malta.identification.readers.raster import period_of, raster_of
from malta.identification.readers.raw import (
    MAX_READING,
    Decoded,
    RawColumn,
    RawLog,
    heading_parts,
    module,
    raw_log,
)
from malta.identification.readers.stored import MOST_IN_MEMORY, StoredTable, stored_table
from malta.identification.readers.text import text_log
from malta.model.plant import Signal
from malta.tables import locate_arrays, read_npz
from malta.units import is_unit_of, si_unit_of, to_si
from malta.writing import replace_files

VERSION = 1
MAX_LOG_BYTES = 2_000_000_000  # bytes of a log that is read as a whole
SMALL_ARRAY = 20_000  # numbers of an array that is read as a whole from a long file too
PERIOD_ROWS = 1_000_000  # at the end of a log, in which the period of its excitation is looked for
MAX_STORED_BYTES = 100_000_000_000  # of one that is read by blocks
SUFFIXES = (".csv", ".npz", ".mat", ".parquet")  # that are written too
BY_BLOCKS = (".csv", ".txt", ".dat", ".tsv", ".lvm", ".gz", ".mf4", ".mdf", ".parquet")  # read so, like .npz
OTHER_SUFFIXES = (".txt", ".dat", ".tsv", ".lvm", ".gz", ".h5", ".hdf5", ".mf4", ".mdf", ".tdms", ".mcap")


def without_idle(log: Log) -> Log:
    """The log without columns of currents and voltages that are zero throughout."""
    columns, signals, idle = dict(log.columns), dict(log.signals), list(log.idle)
    for group in ("i", "u"):
        table, known = columns.get(group, np.zeros((0, 0))), signals.get(group, ())
        used = [k for k in range(table.shape[1]) if table[:, k].any()]
        idle += [signal.name for k, signal in enumerate(known) if k not in used]
        columns[group], signals[group] = table[:, used], tuple(known[k] for k in used)
    return replace(log, columns=columns, signals=signals, idle=tuple(idle))


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
    names |= {"idle": " ".join(log.idle)} if log.idle else {}
    return names | {"sample_time": f"{log.sample_time!r} s", "period": f"{log.period!r} s"}


def _one_table(log: Log) -> tuple[list[str], FloatArray]:
    """Headings with prefixes, and all columns beside t."""
    present = [group for group in GROUPS if log.names(group)]
    headings = [
        "t [s]",
        *(_prefix_of(g, heading, log.source) + heading for g in present for heading in _headings(log, g)),
    ]
    return headings, np.column_stack([log.t, *(log.columns[group] for group in present)])


def _to_parquet(log: Log) -> bytes:
    """A column of doubles for each heading, and the head as metadata of the schema."""
    arrow, parquet = (module(name, "log.parquet", "pyarrow") for name in ("pyarrow", "pyarrow.parquet"))
    headings, table = _one_table(log)
    head = {"malta log": str(VERSION)} | _head(log)
    buffer = io.BytesIO()
    parquet.write_table(arrow.table(list(table.T.copy()), names=headings, metadata=head), buffer)
    return buffer.getvalue()


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
    arrays |= {"idle": np.array(log.idle)} if log.idle else {}
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


def read_log(
    path: str | Path,
    groups: Collection[str] = tuple(GROUPS),
    *,
    columns: str = "",
    time: str = "",
    sample_time: float = 0.0,
    excitation: str | Path | None = None,
) -> Log:
    """Read a log: of malta, of an instrument, or of another program.

    A text (.csv, .txt, .lvm, .gz) may have any separator, a decimal comma, a header of an oscilloscope or a row of
    units. .npz, .mat of any version, .h5, .parquet, .mf4, .tdms, .mcap and bags of ROS 2 are read too, some by packages
    that the refusal names. A .dump is the memory of the ring buffer of exported C, `malta export --log`.

    path : the file. Units are converted to SI; a cell that is empty or nan is a missing reading.
    groups : of its columns that are read, as ("y", "i"): of large files some take less time than all
    columns : which columns are which signals, where their names and units do not say so: NAME=COLUMN:UNIT, ..., as
        'x1=CH1:10um/V,i_dd1="Coil current":A'; "x*:um" is the unit of all columns of such names
    time : the column of times, as "TIME:ms"; "": found by its name
    sample_time : s, of a file without times
    excitation : a file with one period of the excitation, which begins with the log, or with all of it

    Returns a Log. Signals of headings without a prefix are found by their unit when the log is used. Positions and
    angles are measured outputs, forces and torques commands, currents and voltages those of the axes. Others have a
    prefix, as "y.a [m/s^2]" of a measured acceleration, "v.u [V]" of a commanded voltage, "ref." or "flag.".
    The sample time is (last - first time) / (number of intervals), where it is not named.

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
    path, choice = Path(path), ColumnChoice.of(columns, time, sample_time, excitation)
    read = _decode(path, groups, choice)
    head, t, tables, headings, notes = read
    named = choice.sample_time or _seconds(head, "sample_time", path)
    if not len(t) and named and tables:
        t = named * np.arange(len(next(iter(tables.values()))))
    raster = raster_of(t, named, path, exact="malta" in head)
    period = _seconds(head, "period", path)
    if choice.excitation is not None:
        given = _decode(choice.excitation, ("excitation",), ColumnChoice())
        table, own = excitation_table(tables, raster.t, given, raster.sample_time, choice.excitation)
        tables = {**tables, "excitation": table}
        headings = {**headings, "excitation": given.headings["excitation"]}
        period = own or period
    remarks = [*notes, *raster.notes]
    if not period and "excitation" in tables and "period" not in head:
        end = np.asarray(tables["excitation"][-PERIOD_ROWS:], dtype=float)
        period = raster.sample_time * period_of(end)
        remarks += [f"the excitation repeats itself after {period:.6g} s"] if period else []
    found = {group: _in_si(tables[group], list(headings[group]), path) for group in tables if group in groups}
    if "y" not in found:
        unused = f" ({'; '.join(notes)})" if notes else ""
        expected = "columns of positions, as x1 [m], or a choice as --columns x1=CH1:10um/V"
        raise InputError(path, "y", f"no measured outputs{unused}", expected)
    return Log(
        source=str(path),
        machine=str(head.get("machine", "")),
        controller=str(head.get("controller", "")),
        sample_time=raster.sample_time,
        period=period,
        t=raster.t,
        columns={group: table for group, (table, _) in found.items()},
        signals={group: signals for group, (_, signals) in found.items()},
        sha256=_digest(path),
        jitter=raster.jitter,
        idle=tuple(str(head.get("idle", "")).split()),
        notes=tuple(remarks),
    )


def _decode(path: Path, groups: Collection[str], choice: ColumnChoice) -> Decoded:
    """The tables of a file by group. Raises InputError for another suffix, and for what is no such file."""
    suffix = _suffix_of(path)
    if suffix == "":
        found: Decoded | RawLog = bag_log(path)
    elif suffix in READERS:
        read_file(path, "log", _first_byte, MAX_STORED_BYTES if suffix in BY_BLOCKS else MAX_LOG_BYTES)
        found = READERS[suffix](path)
    elif suffix == ".npz" and (arrays := _stored_arrays(path)) is not None:
        found = arrays_log(arrays, path)
    else:
        found = _in_memory(suffix, read_file(path, "log", Path.read_bytes, MAX_LOG_BYTES), path)
    if isinstance(found, Decoded) and choice.chosen:
        found = _columns_of(found, path)
    return decode_columns(found, choice, groups, path) if isinstance(found, RawLog) else found


def _suffix_of(path: Path) -> str:
    """The suffix that tells how a file is read, that of a .csv.gz too; "" of the folder of a bag of ROS 2."""
    if path.is_dir() and (path / "metadata.yaml").exists():
        return ""
    return require_suffix(path, *SUFFIXES, *OTHER_SUFFIXES, ".dump").suffix.lower()


def _first_byte(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1)


def _stored_arrays(path: Path) -> dict[str, Any] | None:
    """The arrays of a large .npz that is not packed: large ones stay in the file; None of a small or packed file."""
    if not path.is_file() or path.stat().st_size <= MOST_IN_MEMORY:
        return None
    read_file(path, "log", _first_byte, MAX_STORED_BYTES)
    try:
        places = locate_arrays(path)
    except ValueError as error:
        found = f"a file that numpy cannot read safely ({error})"
        raise InputError(path, "", found, "an .npz archive of arrays") from error
    if places is None:
        return None
    arrays: dict[str, Any] = {}
    for name, one in places.items():
        numbers, shape = one.kind.kind in "fiub", one.shape
        if numbers and math.prod(shape) > SMALL_ARRAY and len(shape) in (1, 2):
            table = stored_table(path, (one.offset, one.kind, one.columns_first), (shape[0], (*shape, 1)[1]))
            arrays[name] = table
        else:
            with path.open("rb") as file:
                file.seek(one.offset)
                content = file.read(math.prod(shape) * one.kind.itemsize)
            order: Any = "F" if one.columns_first else "C"
            arrays[name] = np.ndarray(shape, one.kind, buffer=content, order=order)
    return arrays


def _in_memory(suffix: str, content: bytes, path: Path) -> Decoded | RawLog:
    """What a file holds that is read as a whole."""
    if suffix == ".dump":
        return Decoded(*decode_dump(content, path))
    if suffix == ".mat":
        return arrays_log(mat_tree(content, path), path)
    try:
        return arrays_log(read_npz(content, max(LEAST_ROOM, MOST_RATIO * len(content))), path)
    except InputError:
        raise
    except ValueError as error:
        found = f"a file that numpy cannot read safely ({error})"
        raise InputError(path, "", found, "an .npz archive of arrays") from error


def _columns_of(found: Decoded, path: Path) -> RawLog:
    """The tables of malta's own files as columns, of which others may be chosen."""
    columns, values = [RawColumn("t", "s")], [found.t]
    for group, table in found.tables.items():
        for heading, vector in zip(found.headings[group], np.asarray(table).T, strict=True):
            columns.append(
                RawColumn(*heading_parts(_prefix_of(group, heading, str(path)) + heading), times=0)
            )
            values.append(vector)
    return raw_log(found.head, columns, values, path)


def _digest(path: Path) -> str:
    """The sha256 of a file; of a folder that of its files' names and contents."""
    found = sha256()
    for one in sorted(path.iterdir()) if path.is_dir() else [path]:
        found.update(one.name.encode() if path.is_dir() else b"")
        with one.open("rb") as file:
            while part := file.read(1 << 20):
                found.update(part)
    return found.hexdigest()


def _hdf5_log(path: Path) -> RawLog:
    found = arrays_log(hdf5_tree(path), path)
    return found if isinstance(found, RawLog) else _columns_of(found, path)


READERS: Mapping[str, Callable[[Path], RawLog]] = {
    **dict.fromkeys((".csv", ".txt", ".dat", ".lvm", ".tsv", ".gz"), text_log),
    **dict.fromkeys((".mf4", ".mdf"), mdf_log),
    ".tdms": tdms_log,
    ".parquet": parquet_log,
    ".mcap": mcap_log,
    **dict.fromkeys((".h5", ".hdf5"), _hdf5_log),
}


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


def _prefix_of(group: str, heading: str, path: str) -> str:
    """What stands before a heading in a file that is one table: nothing where its unit tells the group."""
    told = group_by_unit(_parts(heading, Path(path))[1]) == group
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
    signals, factors = [], []
    for heading in headings:
        name, unit = _parts(heading, path)
        si_unit = next((one for one in SI_UNITS if is_unit_of(unit, one)), None)
        if si_unit is None:
            with relocate_errors(path, heading):
                si_unit = si_unit_of(unit)
        factors.append(to_si(1.0, unit, si_unit, path, name))
        signals.append(Signal(name, si_unit))
    if isinstance(table, StoredTable):  # its readings are looked at when they are read
        return cast("FloatArray", table.choose(range(table.shape[1]), factors)), tuple(signals)
    table = np.asarray(table, dtype=float)
    if any(factor != 1 for factor in factors):
        table = table * factors
    ends = np.fmin.reduce(table, axis=None, initial=0), np.fmax.reduce(table, axis=None, initial=0)
    if max(map(abs, ends)) >= MAX_READING:
        row, column = np.argwhere(np.abs(table) >= MAX_READING)[0]
        found = f"{table[row, column]:g} in sample {row + 1}"
        raise InputError(path, headings[column], found, "a reading, or nothing where it is missing")
    table.flags.writeable = False  # so that a log takes it as it is
    return table, tuple(signals)
