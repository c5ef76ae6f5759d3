"""Columns of files of arrays: of MATLAB and Octave, of Simulink and dSPACE, of HDF5, of numpy.

A file is first a tree of names: tables, lists, texts and arrays. In it are looked for, in this order: malta's own
groups; recordings of dSPACE (X, Y with Data); structures with time of Simulink (time, signals); vectors of one length
beside one of times; one table with a row or a column for each signal, of which the first are the times.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from malta.errors import InputError
from malta.identification.readers.choice import TIMES
from malta.identification.readers.raw import GROUPS, Decoded, RawColumn, RawLog, heading_parts, raw_log
from malta.identification.readers.stored import StoredTable

TEXTS = ("machine", "controller", "idle")  # of a file's head; sample_time and period are numbers, s
MAX_PARTS = 10_000  # of a tree, that are looked at


def arrays_log(tree: Mapping[str, Any], path: Path) -> Decoded | RawLog:
    """What the arrays of a file are: groups of malta, or columns. Raises InputError where neither is found."""
    groups = [group for group in GROUPS if group in tree]
    named = [group for group in groups if f"{group}_columns" in tree]
    if named or ("t" in tree and "y" in groups):
        return _groups(tree, path)
    head = _head(tree)
    for search in (_dspace, _simulink, _vectors, _single_table):
        found = search(tree)
        if found is not None:
            columns, values = found
            return raw_log(head, columns, values, path)
    names = " ".join(list(tree)[:12]) or "nothing"
    expected = (
        "t, y and y_columns, vectors beside one of times, a structure with time, or a recording of dSPACE"
    )
    raise InputError(path, "", f"no signals among {names}", expected)


def _head(tree: Mapping[str, Any]) -> dict[str, Any]:
    """What the arrays say of the log."""
    found: dict[str, Any] = {"malta": True} if "malta_log" in tree else {}
    for name in (*TEXTS, "sample_time", "period"):
        if name in tree and not isinstance(tree[name], Mapping):
            value: Any = np.ravel(np.asarray(tree[name]))
            found |= {name: " ".join(map(str, value)) if name == "idle" else value[0]} if len(value) else {}
    return found


def _groups(arrays: Mapping[str, Any], path: Path) -> Decoded:
    """Head, times, tables and headings of malta's own arrays; also those of a run of `malta simulate --out`."""
    t = arrays.get("t", np.zeros(0))
    stored = isinstance(t, StoredTable)
    t = t if stored else np.asarray(t)
    if not stored and t.ndim == 2 and 1 in t.shape and path.suffix.lower() != ".npz":
        t = t.ravel()
    if t.dtype.kind not in "fiu" or (t.shape[1:] != (1,) if stored else t.ndim != 1):
        raise InputError(path, "t", f"an array of {t.dtype}, {t.shape}", "the times of the samples, in order")
    tables, headings = {}, {}
    for group in GROUPS:
        if group not in arrays:
            continue
        table, texts = arrays[group], arrays.get(f"{group}_columns")
        table = table if isinstance(table, StoredTable) else np.asarray(table)
        names = np.array([texts]) if isinstance(texts, str) else np.asarray(texts)
        if not table.size and not names.size:
            continue  # as u = [] of a log without voltages
        if table.ndim == 2 and table.shape[0] == 1 != len(t):
            table = table.T  # a row of one signal
        if names.dtype.kind != "U" or names.ndim != 1:
            raise InputError(path, f"{group}_columns", "no headings", f"those of {group}")
        if table.dtype.kind not in "fiub" or table.shape != (len(t), len(names)):
            found = f"an array of {table.dtype}, {table.shape}"
            raise InputError(path, group, found, f"numbers, ({len(t)}, {len(names)})")
        tables[group], headings[group] = table, [str(name).strip() for name in names]
    return Decoded(_head(arrays), t if stored else np.asarray(t, dtype=float), tables, headings)


def _parts(tree: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """All tables of a tree, with their names."""
    if depth > 8:
        return
    if isinstance(tree, Mapping):
        yield name, tree
        for key, value in tree.items():
            yield from _parts(value, f"{name}.{key}" if name else str(key), depth + 1)
    elif isinstance(tree, list):
        for value in tree[:MAX_PARTS]:
            yield from _parts(value, name, depth + 1)


Found = tuple[list[RawColumn], list[Any]]


def _dspace(tree: Mapping[str, Any]) -> Found | None:
    """The columns of a recording of dSPACE: X and Y, tables with Name, Unit and Data."""
    for _, part in _parts(tree):
        if not {"X", "Y"} <= set(part):
            continue
        axes, signals = _tables_of(part["X"]), _tables_of(part["Y"])
        if not all("Data" in one for one in (*axes, *signals)) or not signals:
            continue
        columns = [RawColumn(_text(one.get("Name")) or "time", _text(one.get("Unit"))) for one in axes]
        values = [one["Data"] for one in axes]
        for one in signals:
            index = int(np.ravel(np.asarray(one.get("XIndex", 1), dtype=float))[0]) - 1 if axes else -1
            name = _text(one.get("Name")).strip('"').split("/")[-1].strip('"')
            columns.append(RawColumn(name, _text(one.get("Unit")), min(max(index, 0), len(axes) - 1)))
            values.append(one["Data"])
        return columns, values
    return None


def _simulink(tree: Mapping[str, Any]) -> Found | None:
    """The columns of a structure with time of Simulink: time, and signals with values and labels."""
    for name, part in _parts(tree):
        if not {"time", "signals"} <= set(part):
            continue
        signals = [one for one in _tables_of(part["signals"]) if "values" in one]
        if not signals or not np.size(part["time"]):
            continue
        columns, values = [RawColumn("time", "s")], [part["time"]]
        count = np.size(part["time"])
        for k, one in enumerate(signals):
            label = _text(one.get("label")) or f"{name.split('.')[-1]}_{k + 1}"
            for key, vector in _vectors_of(label, np.asarray(one["values"]), count):
                columns.append(RawColumn(*heading_parts(key), times=0))
                values.append(vector)
        return columns, values
    return None


def _vectors_of(name: str, table: Any, count: int) -> Iterator[tuple[str, Any]]:
    """The vectors of a table with `count` rows or columns, each with a name of its own."""
    table = np.squeeze(np.asarray(table))
    if table.dtype.kind not in "fiubM" or table.ndim > 2:
        return
    if table.ndim == 1 and len(table) == count:
        yield name, table
    elif table.ndim == 2 and count in table.shape:
        by_row = table if table.shape[1] == count else table.T
        for k, vector in enumerate(by_row):
            yield f"{name}_{k + 1}", vector


def _vectors(tree: Mapping[str, Any]) -> Found | None:
    """Vectors beside one of times, in the tree itself or in a table of it."""
    for _, part in _parts(tree):
        sizes = {key: np.size(value) for key, value in part.items() if isinstance(value, np.ndarray)}
        times = next((k for k in sizes if heading_parts(str(k))[0].split(".")[-1].lower() in TIMES), "")
        if not times or sizes[times] < 2 or np.asarray(part[times]).dtype.kind not in "fiuM":
            continue
        columns, values = [RawColumn(*heading_parts(times))], [part[times]]
        units = part.get("units") if isinstance(part.get("units"), Mapping) else {}
        for key, value in part.items():
            if key == times or not isinstance(value, np.ndarray):
                continue
            for name, vector in _vectors_of(key, value, sizes[times]):
                plain, unit = heading_parts(name)
                columns.append(RawColumn(plain, unit or _text((units or {}).get(name)), times=0))
                values.append(vector)
        if len(columns) > 1:
            columns[0] = RawColumn(columns[0].name, columns[0].unit or _text((units or {}).get(times)))
            return columns, values
    return None


def _single_table(tree: Mapping[str, Any]) -> Found | None:
    """One table whose first row or column rises as times do, as To File of Simulink writes."""
    for name, table in tree.items():
        if (
            not isinstance(table, np.ndarray)
            or table.ndim != 2
            or min(table.shape) < 2
            or table.dtype.kind not in "fiu"
        ):
            continue
        rows = table if table.shape[0] <= table.shape[1] else table.T
        if not (np.diff(np.asarray(rows[0], dtype=float)) > 0).all():
            continue
        columns = [
            RawColumn(f"{name}_1", "s"),
            *(RawColumn(f"{name}_{k}", "", 0) for k in range(2, len(rows) + 1)),
        ]
        return columns, list(rows)
    return None


def _tables_of(part: Any) -> Sequence[Mapping[str, Any]]:
    """Tables of a part: itself, or those that it lists."""
    parts = part if isinstance(part, list) else [part]
    return [one for one in parts if isinstance(one, Mapping)]


def _text(value: Any) -> str:
    """A text of a tree; "" of what is none."""
    if isinstance(value, str):
        return value.strip()
    listed = np.ravel(np.asarray(value if value is not None else ""))
    return str(listed[0]).strip() if listed.dtype.kind == "U" and listed.size else ""


def octave_tree(text: str) -> dict[str, Any]:
    """The variables of a text file of Octave: scalars, matrices, texts and cells of texts. Raises ValueError."""
    tree: dict[str, Any] = {}
    parts = re.split(r"(?m)^# name: ", text)
    for part in parts[1:]:
        name, _, rest = part.partition("\n")
        if not name.startswith("<cell-element>"):
            tree[name.strip()] = _octave_value(rest)
        elif tree:
            owner = list(tree)[-1]
            if isinstance(tree[owner], list):
                tree[owner].append(_octave_value(rest))
    texts = [name for name, v in tree.items() if isinstance(v, list) and all(isinstance(x, str) for x in v)]
    return tree | {name: np.array(tree[name]) for name in texts}


def _octave_value(text: str) -> Any:
    """A variable of a text file of Octave, of the lines below its name."""
    lines = text.split("\n")
    kind = lines[0].removeprefix("# type: ").strip()
    marks = dict(line[2:].split(": ", 1) for line in lines[1:4] if line.startswith("# ") and ": " in line)
    body = [line for line in lines[1:] if line.strip() and not line.startswith("#")]
    if kind in ("string", "sq_string"):
        return body[0] if len(body) == 1 else np.array(body)
    if kind == "cell":
        return []
    if kind.endswith("scalar") or kind == "bool":
        return np.array([float(body[0])])
    if kind.endswith("matrix") and "rows" in marks:
        shape = int(marks["rows"]), int(marks["columns"])
        return np.array(" ".join(body).split(), dtype=float).reshape(shape)
    raise ValueError(f"a variable of type {kind[:40]!r}, which is no matrix of two dimensions or text")
