"""The fingerprint of a record: sha256 of its numbers, names and tuples."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import numpy as np


def fingerprint(record: Any) -> str:
    """sha256 of every number, name and tuple in a record: equal for a gain file's .json, .npz and .mat.

    Each part is hashed with its kind and its size, so that two records of different structure never give the same
    bytes: ((1, 2), (3,)) and ((1,), (2, 3)) differ.
    """
    marks = hashlib.sha256()
    for part in _parts(record):
        marks.update(part)
    return marks.hexdigest()


def _parts(value: Any) -> Iterator[bytes]:
    """The bytes of a value: its kind, its size, then its content."""
    if isinstance(value, np.ndarray | np.generic | float | int):
        yield f"number {np.shape(value)}:".encode()
        # Files do not store the sign of a zero: + 0.0 drops it.
        yield (np.asarray(value, dtype="<f8") + 0.0).tobytes()
    elif is_dataclass(value):
        # A field that came later is left out at its default: older gain files do not mention it.
        kept = [
            f.name
            for f in fields(value)
            if not (f.metadata.get("later") and _is_usual(f, getattr(value, f.name)))
        ]
        yield f"record {len(kept)}:".encode()
        for name in kept:
            yield from _parts(name)
            yield from _parts(getattr(value, name))
    elif isinstance(value, Mapping):
        yield f"table {len(value)}:".encode()
        for name in sorted(value):
            yield from _parts(name)
            yield from _parts(value[name])
    elif isinstance(value, tuple | list):
        yield f"list {len(value)}:".encode()
        for entry in value:
            yield from _parts(entry)
    else:
        text = repr(value).encode()
        yield f"text {len(text)}:".encode() + text


def _is_usual(f: Field[Any], value: Any) -> bool:
    """Whether a field has its default."""
    usual: Any = f.default if f.default_factory is MISSING else f.default_factory()
    return np.array_equal(value, usual) if isinstance(value, np.ndarray) else bool(value == usual)
