"""Tables of long records, which stay in their file: rows are read as they are asked for, table[first:end]."""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from malta.arrays import FloatArray
from malta.errors import InputError

MOST_IN_MEMORY = 32_000_000  # bytes of a log whose tables are read as a whole


class OpenFile:
    """A file that is open for reading until nothing needs it."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        weakref.finalize(self, os.close, descriptor)


class ArrayManners(NDArrayOperatorsMixin):
    """Attributes, methods and arithmetic of an array, for what becomes one as a whole where they are asked for."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        arrays = [np.asarray(one) if isinstance(one, ArrayManners) else one for one in inputs]
        return getattr(ufunc, method)(*arrays, **options)


@dataclass(frozen=True, eq=False)
class StoredTable(ArrayManners):
    """A table of numbers in a file, rows x columns: table[a:b] reads these rows, np.asarray(table) all of them.

    What is read are doubles, SI.

    path : of the file, for errors
    file : open as long as the table is used
    offset : bytes before the first number
    kind : of the numbers
    by_column : whether the numbers of a column stand side by side; else those of a row
    stored : rows and columns of the file's table
    columns : of these, which the table has
    factors : of each column
    skipped : rows of the file before the first one of the table
    """

    path: Path
    file: OpenFile
    offset: int
    kind: np.dtype[Any]
    by_column: bool
    stored: tuple[int, int]
    columns: tuple[int, ...]
    factors: tuple[float, ...]
    skipped: int = 0

    ndim = 2

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self), len(self.columns)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the numbers in the file."""
        return self.kind

    @property
    def size(self) -> int:
        """Numbers of the table."""
        return len(self) * len(self.columns)

    @property
    def T(self) -> FloatArray:
        """The whole table, turned."""
        return self.rows(0, len(self)).T

    def choose(self, columns: Sequence[int], factors: Sequence[float] | None = None) -> StoredTable:
        """Some of the columns, each times a factor."""
        own = [self.factors[k] for k in columns]
        times = own if factors is None else [a * b for a, b in zip(own, factors, strict=True)]
        return replace(self, columns=tuple(self.columns[k] for k in columns), factors=tuple(times))

    def last(self, count: int) -> StoredTable:
        """The last rows, which stay in the file too."""
        return replace(self, skipped=self.skipped + len(self) - count)

    def rows(self, first: int, end: int) -> FloatArray:
        """Rows first to end."""
        count, (height, width) = max(0, end - first), self.stored
        first += self.skipped
        if self.by_column:
            table: FloatArray = np.empty((count, len(self.columns)))
            for k, column in enumerate(self.columns):
                table[:, k] = self._numbers(column * height + first, count)
        else:
            table = self._numbers(first * width, count * width).reshape(count, width)
            if self.columns != tuple(range(width)):
                table = table[:, self.columns]
        return table if all(factor == 1 for factor in self.factors) else table * np.array(self.factors)

    def _numbers(self, first: int, count: int) -> FloatArray:
        size = self.kind.itemsize
        content = os.pread(self.file.descriptor, count * size, self.offset + first * size)
        if len(content) < count * size:
            raise InputError(self.path, "", "a file that has become shorter", "the file as it was opened")
        return np.frombuffer(content, self.kind).astype(float, copy=False)

    def __len__(self) -> int:
        return self.stored[0] - self.skipped

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice) and key.step in (None, 1):
            return self.rows(*key.indices(len(self))[:2])
        return self.rows(0, len(self))[key]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:
        return self.rows(0, len(self)).astype(dtype or float, copy=bool(copy))


@dataclass(frozen=True, eq=False)
class EvenTimes(ArrayManners):
    """Times on a raster, first + k step, s, which take no memory."""

    first: float
    step: float
    count: int

    ndim = 1

    @property
    def shape(self) -> tuple[int]:
        """Their number."""
        return (self.count,)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            return self.first + self.step * np.arange(*key.indices(self.count))
        return self.first + self.step * np.arange(self.count)[key]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:
        return (self.first + self.step * np.arange(self.count)).astype(dtype or float, copy=bool(copy))


def stored_table(
    path: Path, place: tuple[int, np.dtype[Any], bool], shape: tuple[int, int], file: OpenFile | None = None
) -> StoredTable:
    """A table of a file with all of its columns.

    place : its offset, the kind of its numbers, and whether those of a column stand side by side
    """
    own = OpenFile(os.open(path, os.O_RDONLY)) if file is None else file
    columns = tuple(range(shape[1]))
    return StoredTable(path, own, *place, shape, columns, (1.0,) * len(columns))


def store_rows(blocks: Iterable[FloatArray], width: int, path: Path) -> StoredTable:
    """A table of blocks of rows, in a file without a name that goes with the table."""
    count = 0
    with _scratch(path) as file:
        for block in blocks:
            _write(file, block, path)
            count += len(block)
        kept = OpenFile(os.dup(file.fileno()))
    return stored_table(path, (0, np.dtype(float), False), (count, width), kept)


def store_columns(load: Callable[[int], FloatArray], numbers: Sequence[int], path: Path) -> StoredTable:
    """A table of columns that are loaded one by one, in a file without a name that goes with the table.

    Raises InputError for columns of different length.
    """
    counts: list[int] = []
    with _scratch(path) as file:
        for number in numbers:
            column = load(number)
            counts.append(len(column))
            if counts[0] != counts[-1]:
                found = f"columns of different rasters: {counts[0]} and {counts[-1]} samples"
                raise InputError(path, "", found, "one raster for all that are used")
            _write(file, column, path)
        kept = OpenFile(os.dup(file.fileno()))
    return stored_table(path, (0, np.dtype(float), True), (counts[0], len(counts)), kept)


def _scratch(path: Path) -> Any:
    try:
        return tempfile.TemporaryFile(prefix="malta-")
    except OSError as error:
        raise InputError(
            path, "", f"no place for its numbers ({error})", "a folder for temporary files"
        ) from error


def _write(file: Any, values: FloatArray, path: Path) -> None:
    try:
        np.ascontiguousarray(values, dtype=float).tofile(file)
    except OSError as error:
        raise InputError(
            path, "", f"no room for its numbers ({error})", "room for temporary files, TMPDIR"
        ) from error
