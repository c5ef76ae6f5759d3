"""The three forms of a gain file: .json, .npz and .mat, all holding the same tables.

A document is nested tables of lists, numbers, texts and nulls. Decoding does not check the content: schema.py does.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from malta.archives import read_npz
from malta.errors import InputError
from malta.files import read_file
from malta.gains.mat import read_mat
from malta.tables import require_shallow

MAT_HEADER = 116  # bytes of descriptive text that open a MAT-file
MATRICES = (
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
    return _INNERMOST.sub(_on_one_line, text).encode() + b"\n"


_INNERMOST = re.compile(r"([\[{])\s*([^][{}]*?)\s*([\]}])")


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
        for name, value in _flat(_columns(content)).items():
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


def _to_mat(content: Mapping[str, Any]) -> bytes:
    from scipy.io import savemat

    buffer: Any = io.BytesIO()  # any: scipy's stubs know only file names
    savemat(buffer, _cells(_columns(content)), long_field_names=True, oned_as="row")
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


def _columns(content: Any) -> Any:
    """Signals as two lists, name and unit."""
    if isinstance(content, list) and content and isinstance(content[0], Mapping):
        return {column: [row[column] for row in content] for column in ("name", "unit")}
    if isinstance(content, Mapping):
        return {key: _columns(entry) for key, entry in content.items()}
    return content


def _flat(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, names joined by dots."""
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _cells(value: Any) -> Any:
    """Lists of text as MATLAB cell arrays, lists of numbers as arrays."""
    if isinstance(value, Mapping):
        return {key: _cells(entry) for key, entry in value.items()}
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
    ".mat": (_to_mat, _from_mat),
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
