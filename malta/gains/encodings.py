"""The three forms of a gain file: .json, .npz and .mat, all holding the same tables.

A document is nested tables of lists, numbers, texts and nulls. Decoding does not check the content: schema.py does.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from malta.errors import InputError
from malta.files import read_file
from malta.synthesis.schedule import SCHEDULED_MATRICES
from malta.tables import read_npz, require_shallow

# A strict reader of MAT-files, level 5: the elements that gain files are made of, and no others.
#
#     file      128 bytes of header, then elements: matrices, plain or compressed (zlib)
#     element   type and size, 4 bytes each, or both in 4 bytes if the content fits into 4; content, padded to 8 bytes
#     matrix    flags and class, dimensions, name; then the content of its class:
#               struct   length of a name, names, a matrix for each;  cell   a matrix for each entry
#               char     one element of text;                         number one element of integers or floats
#
# Every size is compared with the bytes that are left before anything is read, so no file makes this reader crash, run
# on, or take more memory than a small multiple of the file, or of MAX_DECOMPRESSED_BYTES where it is compressed.
# Source: MathWorks, MAT-File Format (R2019b), chapter 1.


HEADER = 128  # bytes
LITTLE_ENDIAN = b"\x00\x01IM"  # version 1.0 and the mark of the byte order, at the end of the header
MAX_DECOMPRESSED_BYTES = 16_000_000  # bytes of all compressed elements after decompression
MAX_STRUCT_DEPTH = 16  # structs in structs

INT8, INT32, UINT32, MATRIX, COMPRESSED_ELEMENT = 1, 5, 6, 14, 15
NUMBERS = {
    1: "<i1",
    2: "<u1",
    3: "<i2",
    4: "<u2",
    5: "<i4",
    6: "<u4",
    7: "<f4",
    9: "<f8",
    12: "<i8",
    13: "<u8",
}
TEXTS = {2: "ascii", 4: "utf-16-le", 16: "utf-8", 17: "utf-16-le"}  # text as bytes or as MATLAB stores it
CELL, STRUCT, CHAR = 1, 2, 4
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}


def read_mat(data: bytes) -> dict[str, Any]:
    """The variables of a MAT-file by name: structs as tables, cells as lists, text, and arrays of two dimensions.

    Raises ValueError for damage and for anything that gain files do not have: big-endian files, other classes, arrays
    that are complex, logical or of more than two dimensions, several structs in one array.
    """
    if data[HEADER - len(LITTLE_ENDIAN) : HEADER] != LITTLE_ENDIAN:
        raise ValueError("its header is none of a little-endian MAT-file of level 5")
    found: dict[str, Any] = {}
    room = MAX_DECOMPRESSED_BYTES
    for kind, content in mat_elements(memoryview(data)[HEADER:]):
        if kind == COMPRESSED_ELEMENT:
            kind, content = _decompress(content, room)
            room -= len(content)  # never 0, which zlib takes for no limit: the tag is not counted
        if kind != MATRIX:
            raise ValueError(f"an element of type {kind} in place of a matrix")
        name, value = _matrix(content, 0)
        if not name or name in found:
            raise ValueError(f"{name} stands twice" if name else "a matrix without a name")
        found[name] = value
    return found


def mat_elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(type, content) of each element of some bytes, which end with the last one and its padding."""
    at = 0
    while at < len(data):
        if len(data) - at < 8:
            raise ValueError(f"{len(data) - at} bytes in place of an element")
        kind, size = struct.unpack_from("<II", data, at)
        begin, padded = at + 8, size + -size % 8
        if kind >> 16:  # type, size and content in 8 bytes
            kind, size = kind & 0xFFFF, kind >> 16
            begin, padded = at + 4, 4
        elif kind == COMPRESSED_ELEMENT:  # without padding
            padded = size
        if size > padded or padded > len(data) - begin:
            raise ValueError(f"an element of {size} bytes where {len(data) - begin} are left")
        yield kind, data[begin : begin + size]
        at = begin + padded


def _decompress(content: memoryview, room: int) -> tuple[int, memoryview]:
    """The one element that a compressed element consists of; at most `room` bytes."""
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(content, room)
    except zlib.error as error:
        raise ValueError(f"a compressed element that is damaged: {error}") from error
    if not unpacker.eof or unpacker.unused_data:
        raise ValueError(
            f"a compressed element that is damaged, or of more than {MAX_DECOMPRESSED_BYTES} bytes"
        )
    parts = mat_elements(memoryview(plain))
    found = next(parts, None)
    if found is None or next(parts, None) is not None:
        raise ValueError("a compressed element that is not one matrix")
    return found


def _matrix(content: memoryview, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix; no bytes at all are an empty one."""
    if not content:
        return "", np.zeros((0, 0))
    if depth > MAX_STRUCT_DEPTH:
        raise ValueError(f"more than {MAX_STRUCT_DEPTH} structs in structs")
    parts = mat_elements(content)
    flags = np.frombuffer(_content(parts, UINT32, "flags", 8), "<u4")
    kind = int(flags[0]) & 0xFF
    if int(flags[0]) & 0xFF00:
        raise ValueError("an array that is complex, logical or global")
    rows, columns = map(int, np.frombuffer(_content(parts, INT32, "dimensions", 8), "<i4"))
    if rows < 0 or columns < 0:
        raise ValueError(f"{rows} x {columns} entries")
    name = _name(_content(parts, INT8, "name"))
    value: Any
    if kind == STRUCT:
        value = _struct(parts, rows * columns, depth)
    elif kind == CELL:
        value = _texts(parts, rows * columns, depth)
    elif kind == CHAR:
        value = _text(parts, rows, columns)
    elif kind in CLASSES:
        value = _numbers(parts, rows, columns, np.dtype(CLASSES[kind]))
    else:
        raise ValueError(f"an array of class {kind}")
    if next(parts, None) is not None:
        raise ValueError(f"more than one array in the matrix {name!r}")
    return name, value


def _content(
    parts: Iterator[tuple[int, memoryview]], kind: int, what: str, size: int | None = None
) -> memoryview:
    """The content of the next element, which has to be of a type, and of a size where one is given."""
    found, content = next(parts, (0, memoryview(b"")))
    if found != kind or (size is not None and len(content) != size):
        raise ValueError(f"{len(content)} bytes of type {found} in place of {what}")
    return content


def _name(content: memoryview) -> str:
    """A name, which may be empty; signals of a machine from plain matrices may have names with spaces."""
    name = bytes(content).decode("ascii")
    if not name.isprintable():
        raise ValueError(f"the name {name[:40]!r}")
    return name


def _struct(parts: Iterator[tuple[int, memoryview]], count: int, depth: int) -> dict[str, Any]:
    if count != 1:
        raise ValueError(f"{count} structs in one array")
    length = int(np.frombuffer(_content(parts, INT32, "the length of a name", 4), "<i4")[0])
    names = bytes(_content(parts, INT8, "the names of a struct"))
    if length < 1 or len(names) % length:
        raise ValueError(f"{len(names)} bytes of names of {length} bytes each")
    table: dict[str, Any] = {}
    for at in range(0, len(names), length):
        text, end, _ = names[at : at + length].partition(b"\0")
        name = _name(memoryview(text))
        if not name or not end or name in table:
            raise ValueError(
                f"{name} stands twice" if name in table else "a name without letters or without end"
            )
        table[name] = _matrix(_content(parts, MATRIX, name), depth + 1)[1]
    return table


def _texts(parts: Iterator[tuple[int, memoryview]], count: int, depth: int) -> list[str]:
    """The texts of a cell array; more entries than bytes end with an error at the last byte."""
    texts = []
    for _ in range(count):
        value = _matrix(_content(parts, MATRIX, "an entry of a cell array"), depth + 1)[1]
        if not isinstance(value, str):
            raise ValueError("a cell array with entries other than text")
        texts.append(value)
    return texts


def _text(parts: Iterator[tuple[int, memoryview]], rows: int, columns: int) -> str:
    """Text in one row. Characters beyond 16 bits count twice where they are stored as two."""
    kind, content = next(parts, (0, memoryview(b"")))
    if kind not in TEXTS or (rows * columns and rows != 1):
        raise ValueError(f"text of {rows} rows in an element of type {kind}")
    text = bytes(content).decode(TEXTS[kind])
    stored = len(content) // 2 if TEXTS[kind] == "utf-16-le" else len(text)
    if stored != rows * columns:
        raise ValueError(f"{stored} characters in place of {rows * columns}")
    if "\0" in text:
        raise ValueError("text with a null character")
    return text


def _numbers(parts: Iterator[tuple[int, memoryview]], rows: int, columns: int, wanted: np.dtype[Any]) -> Any:
    """An array, rows x columns; numbers may be stored in a type that is smaller than the array's class."""
    kind, content = next(parts, (0, memoryview(b"")))
    if kind not in NUMBERS or not np.can_cast(NUMBERS[kind], wanted):
        raise ValueError(f"numbers of type {kind} in an array of {wanted}")
    stored = np.dtype(NUMBERS[kind])
    if len(content) != rows * columns * stored.itemsize:
        raise ValueError(
            f"{len(content)} bytes of numbers in place of {rows} x {columns} of {stored.itemsize} each"
        )
    array = np.frombuffer(content, stored).astype(wanted)
    return array.reshape((rows, columns), order="F") if array.size else np.zeros((0, 0))


MAT_HEADER = 116  # bytes of descriptive text that open a MAT-file
MATRICES = (
    *(f"schedule.{name}" for name in SCHEDULED_MATRICES),
    "model.",
    "gains.",
    "feedforward.v0",
    "feedforward.speed",
    "feedforward.rate",
    "feedforward.position",
    "commutation.pull",
    "law.references",
    "verification.poles.",
    "plant.linear.matrices.",
    "plant.linear.terms.",
)
VECTORS = (
    "law.pause",
    "law.braking",
    "operating_point.",
    "feedforward.inertia",
    "feedforward.z_grid",
    "schedule.places",
    "limits.",
    "cost.",
    "noise.",
    "plant.linear.limit",
    "plant.linear.noise",
)

_Form = tuple[Callable[[Mapping[str, Any]], bytes], Callable[[bytes], Any]]


def encode(content: Mapping[str, Any], path: Path) -> bytes:
    """The bytes of a document in the encoding that the suffix names; equal documents give equal bytes."""
    write, _ = _form(path)
    return write(content)


def decode(path: Path) -> dict[str, Any]:
    """The document in a file. Raises InputError for a missing, unreadable, damaged or foreign file."""
    _, read = _form(path)
    data = read_file(path, "gain file", Path.read_bytes)
    try:
        content = read(data)
    except Exception as error:  # a damaged archive makes its reader raise nearly anything
        found = f"a damaged or foreign file ({str(error)[:120]})"
        raise InputError(path, "", found, f"a complete {path.suffix} gain file") from error
    if not isinstance(content, dict):
        raise InputError(path, "", f"a {type(content).__name__}", "the tables of a gain file")
    require_shallow(content, path)
    return content


def content_sha256(content: Mapping[str, Any]) -> str:
    """sha256 of a document without its own "sha256": compact JSON, keys sorted."""
    rest = {key: value for key, value in content.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _to_json(content: Mapping[str, Any]) -> bytes:
    text = json.dumps(content, indent=1, allow_nan=False)
    return _INNERMOST_LIST.sub(_on_one_line, text).encode() + b"\n"


_INNERMOST_LIST = re.compile(r"([\[{])\s*([^][{}]*?)\s*([\]}])")


def _on_one_line(innermost: re.Match[str]) -> str:
    """A matrix row or a small table on one line."""
    line = f"{innermost[1]}{' '.join(innermost[2].split())}{innermost[3]}"
    return line if innermost[1] == "[" or len(line) <= 80 else innermost[0]


def _from_json(data: bytes) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table = dict(pairs)
        if len(table) < len(pairs):
            keys = [key for key, _ in pairs]
            raise ValueError(f"{next(k for k in keys if keys.count(k) > 1)} stands twice")
        return table

    return json.loads(data.decode("utf-8"), object_pairs_hook=unique)


def _to_npz(content: Mapping[str, Any]) -> bytes:
    archived = io.BytesIO()
    with zipfile.ZipFile(archived, "w") as archive:  # stored: compressors differ in their bytes
        for name, value in flat_entries(columns_of(content)).items():
            entry = io.BytesIO()
            array = np.zeros(0) if value is None else np.array(value)
            np.lib.format.write_array(entry, array, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), entry.getvalue())  # dated 1980: no time stamp
    return archived.getvalue()


def _from_npz(data: bytes) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, array in read_npz(data).items():
        *tables, key = name.split(".")
        table = tree
        for part in tables:
            table = table.setdefault(part, {})
        table[key] = array.tolist() if array.size else None
    return tree


def to_mat(content: Mapping[str, Any]) -> bytes:
    from scipy.io import savemat

    buffer: Any = io.BytesIO()  # any: scipy's stubs know only file names
    savemat(buffer, matlab_cells(columns_of(content)), long_field_names=True, oned_as="row")
    body = bytes(buffer.getvalue())[MAT_HEADER:]
    return mat_header(body) + body


def mat_header(body: bytes) -> bytes:
    """The 116 bytes that open a MAT-file: instead of date and platform, the sha256 of the bytes that follow."""
    return f"MATLAB 5.0 MAT-file, malta gain file, sha256 {hashlib.sha256(body).hexdigest()}".encode().ljust(
        MAT_HEADER
    )


def _from_mat(data: bytes) -> dict[str, Any]:
    if data[:MAT_HEADER] != mat_header(data[MAT_HEADER:]):
        raise ValueError("its header does not hold the sha256 of its content")
    return {name: _without_shape(value, name) for name, value in read_mat(data).items()}


def columns_of(content: Any) -> Any:
    """Signals as two lists, name and unit."""
    if isinstance(content, list) and content and isinstance(content[0], Mapping):
        return {column: [row[column] for row in content] for column in ("name", "unit")}
    if isinstance(content, Mapping):
        return {key: columns_of(entry) for key, entry in content.items()}
    return content


def flat_entries(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, names joined by dots."""
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        flat |= (
            flat_entries(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else {f"{prefix}{key}": value}
        )
    return flat


def matlab_cells(value: Any) -> Any:
    """Lists of text as MATLAB cell arrays, lists of numbers as arrays."""
    if isinstance(value, Mapping):
        return {key: matlab_cells(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return np.array(value, dtype=object if isinstance(value[0], str) else float)
    return np.zeros((0, 0)) if value is None else value


def _without_shape(value: Any, name: str) -> Any:
    """A value of a MAT-file, where every number is a matrix: its name tells if it is a matrix, vector or number."""
    if isinstance(value, dict):
        return {key: _without_shape(entry, f"{name}.{key}") for key, entry in value.items()}
    if isinstance(value, list | str):
        return value
    if not value.size:
        return None
    if name.startswith(MATRICES):
        return value.tolist()
    if name.startswith(VECTORS):
        return value.ravel().tolist()
    return value.item()


_FORMS: dict[str, _Form] = {
    ".json": (_to_json, _from_json),
    ".npz": (_to_npz, _from_npz),
    ".mat": (to_mat, _from_mat),
}
SUFFIXES = tuple(_FORMS)
"""The suffixes of gain files, one for each encoding.

>>> import malta
>>> malta.gains.SUFFIXES
('.json', '.npz', '.mat')
"""


def _form(path: Path) -> _Form:
    """Writer and reader for a suffix."""
    if path.suffix not in _FORMS:
        raise InputError(path, "", f"suffix {path.suffix!r}", "one of " + ", ".join(SUFFIXES))
    return _FORMS[path.suffix]
