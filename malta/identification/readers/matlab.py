"""MAT-files of every version as trees: level 5, text of Octave, and v7.3, which is HDF5; HDF5 files of others too."""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from malta.gains.encodings import COMPRESSED_ELEMENT, HEADER, mat_elements
from malta.identification.readers.arrays import octave_tree
from malta.identification.readers.raw import module, refuse_damage

HDF5 = b"\x89HDF\r\n\x1a\n"
LEAST_ROOM, MOST_RATIO = (
    64_000_000,
    50,
)  # bytes that a MAT-file may have when unpacked, and how many times its own
MAX_DEPTH = 8  # groups in groups


def mat_tree(content: bytes, path: Path) -> dict[str, Any]:
    """The variables of a MAT-file. Raises InputError for damage, and for v7.3 without h5py."""
    try:
        if HDF5 in content[:2048]:
            return hdf5_tree(path, "a MAT-file of version 7.3")
        if content[:64].lstrip().startswith(b"#") and b"# name: " in content:
            return octave_tree(content.decode("utf-8"))
        _require_room(content)
        from scipy.io import loadmat  # a third of a second to import

        buffer: Any = io.BytesIO(content)  # any: scipy's stubs know only file names
        found = loadmat(buffer, struct_as_record=True, squeeze_me=False, chars_as_strings=True)
    except Exception as error:  # scipy raises many kinds for damage
        raise refuse_damage(path, "MAT-file: of version 5 or 7.3, or Octave's text", error) from error
    return {name: _plain(value) for name, value in found.items() if not name.startswith("__")}


def _require_room(content: bytes) -> None:
    """Raise ValueError for a file that is a bomb: compressed parts that are far larger than the file."""
    room = max(LEAST_ROOM, MOST_RATIO * len(content))
    for kind, part in mat_elements(memoryview(content)[HEADER:]):
        if kind == COMPRESSED_ELEMENT and 1032 * len(part) > room:  # deflate packs to 1 of 1032 bytes at best
            unpacker, rest = zlib.decompressobj(), bytes(part)
            while rest and not unpacker.eof:
                room -= len(unpacker.decompress(rest, 1_000_000))
                rest = unpacker.unconsumed_tail
                if room < 0:
                    raise ValueError("compressed parts that are far larger than the file")


def _plain(value: Any) -> Any:
    """An array of scipy as a tree: structs as tables, cells as lists, text."""
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.names:
        tables = [{name: _plain(one[name]) for name in value.dtype.names} for one in value.ravel()]
        return tables[0] if len(tables) == 1 else tables
    if value.dtype.kind == "O":
        return _texts_of([_plain(one) for one in value.ravel(order="F")])
    if value.dtype.kind == "U":
        return str(value.ravel()[0]) if value.size == 1 else value.ravel()
    return value


def _texts_of(values: list[Any]) -> Any:
    """A cell array: texts as an array of text, others as a list."""
    return np.array(values) if values and all(isinstance(one, str) for one in values) else values


def hdf5_tree(path: Path, kind: str = "an HDF5 file") -> dict[str, Any]:
    """The groups and arrays of an HDF5 file. Raises InputError without h5py, and for damage."""
    h5py = module("h5py", path, "h5py")
    try:
        with h5py.File(path, "r") as file:
            tree = _group(file, file, 0)
    except Exception as error:  # h5py raises many kinds
        raise refuse_damage(path, kind, error) from error
    return tree if isinstance(tree, dict) else {"log": tree}


def _group(group: Any, file: Any, depth: int) -> Any:
    """A group as a table with its arrays, and their units; structs of MATLAB in one array as a list."""
    table: dict[str, Any] = {}
    units: dict[str, str] = {}
    for name, item in group.items():
        if name.startswith("#") or depth > MAX_DEPTH:
            continue
        if hasattr(item, "items"):
            table[name] = _group(item, file, depth + 1)
            continue
        table[name] = _dataset(item, file, depth)
        unit = next((item.attrs[key] for key in ("unit", "units", "Unit", "Units") if key in item.attrs), "")
        if unit is not None and np.size(unit) == 1:
            one = np.ravel(np.asarray(unit))[0]
            units[name] = one.decode(errors="replace") if isinstance(one, bytes) else str(one)
    if any(units.values()):
        table.setdefault("units", units)
    lists = [value for value in table.values() if isinstance(value, list | np.ndarray)]
    if table and "MATLAB_class" in group.attrs and len(lists) == len(table):
        sizes = {len(value) for value in lists if isinstance(value, list)}
        if len(sizes) == 1 and all(isinstance(value, list) for value in lists):
            return [dict(zip(table, one, strict=True)) for one in zip(*table.values(), strict=True)]
    return table


def _dataset(item: Any, file: Any, depth: int) -> Any:
    """An array of an HDF5 file: text, a list of what it refers to, or numbers in the order of their program."""
    kind = item.attrs.get("MATLAB_class", b"")
    values = item[()]
    if isinstance(values, bytes):
        return values.decode(errors="replace")
    if item.dtype.kind == "O" and np.size(values) and isinstance(np.ravel(values)[0], bytes):
        return np.array([one.decode(errors="replace") for one in np.ravel(values)])
    if item.dtype.kind == "O":
        referred = [file[one] for one in np.ravel(values) if one]
        read = [(_group if hasattr(one, "items") else _dataset)(one, file, depth + 1) for one in referred]
        return _texts_of(read)
    if item.dtype.names:
        return {name: np.asarray(values[name]) for name in item.dtype.names}
    if item.dtype.kind == "S":
        return np.array([one.decode(errors="replace") for one in np.ravel(values)])
    if kind == b"char":
        rows = np.atleast_2d(values).T
        texts = ["".join(map(chr, row)).rstrip("\0") for row in np.asarray(rows, dtype=int).tolist()]
        return texts[0] if len(texts) == 1 else np.array(texts)
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros((0, 0))
    return np.asarray(values).T if kind else np.asarray(values)
