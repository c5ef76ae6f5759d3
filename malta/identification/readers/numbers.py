"""Rows of numbers of a text by blocks: by compiled C, which gives the doubles of Python, or by Python."""

from __future__ import annotations

import codecs
import csv
import ctypes
import gzip
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.files import read_packaged
from malta.identification.readers.raw import refuse_damage
from malta.simulation.engine.compiled import address_of, library
from malta.simulation.engine.sample_loops import SAMPLE_LOOP_FLAGS

BLOCK = 8_000_000  # bytes of text that are read at once
MISSING = ("", "nan", "na", "-", "--", "n/a", "#n/a", "null", "none")
"""Words in small letters that stand where a reading is missing; cells.c has the same ones."""
CLOCK = re.compile(
    r"(?:(\S+)[ T_])?(\d{1,2}):(\d\d):(\d\d)(?:[.,:](\d+))?\s*([AaPp][Mm])?(?:Z|[+-]\d\d:?\d\d)?"
)


class Dialect(NamedTuple):
    """How a text is a table.

    encoding : as Python names it
    separator : between cells; " ": any spaces
    decimal : the sign before the fraction
    begin : lines above the rows of numbers
    kinds : of each column of the rows: "n" numbers, "t" instants, "x" words
    """

    encoding: str
    separator: str
    decimal: str
    begin: int
    kinds: str


def open_text(path: Path) -> Any:
    """The bytes of a text, of a .gz too."""
    return gzip.open(path, "rb") if path.suffix.lower() == ".gz" else path.open("rb")


def blocks_of(path: Path, dialect: Dialect) -> Iterator[bytes]:
    """The rows below a text's header as blocks of whole lines."""
    wide = dialect.encoding.startswith("utf-16")
    decoder = codecs.getincrementaldecoder(dialect.encoding)() if wide else None
    rest, above = b"", dialect.begin
    with open_text(path) as file:
        while part := file.read(BLOCK):
            part = rest + (decoder.decode(part).encode() if decoder else part)
            while above and b"\n" in part:
                part, above = part[part.index(b"\n") + 1 :], above - 1
            end = part.rfind(b"\n") + 1 if not above else 0
            rest = part[end:]
            if end:
                yield part[:end]
    if rest.strip() and not above and _is_whole(rest, dialect):
        yield rest


def _is_whole(line: bytes, dialect: Dialect) -> bool:
    """Whether a last line, without an end, has all cells: a logger that is switched off leaves a part of one."""
    if dialect.separator == " ":
        return len(line.split()) >= len(dialect.kinds)
    return line.count(dialect.separator.encode()) >= len(dialect.kinds) - 1


def row_blocks(
    path: Path, dialect: Dialect, wanted: Sequence[int], words: dict[int, list[str]] | None = None
) -> Iterator[FloatArray]:
    """Rows of some columns of a text, NaN where a reading is missing; cells of instants go to `words`.

    Raises InputError for a row of another form.
    """
    order = sorted(set(wanted))
    places = [order.index(k) for k in wanted]
    row = 0
    try:
        for block in blocks_of(path, dialect):
            if dialect.separator == " ":
                block = re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)", b"", block)
                block = re.sub(rb"[ \t]+", b" ", block)
            table = None if words else fast_rows(block, dialect, order)
            table = plain_rows(block, dialect, order, row, words or {}) if table is None else table
            row += len(table)
            yield table if places == list(range(len(order))) else table[:, places]
    except (ValueError, UnicodeDecodeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "", f"a line that cannot be read ({str(error)[:80]})", "numbers") from error
    except (OSError, EOFError) as error:
        raise refuse_damage(path, "text, or one packed by gzip", error) from error


def read_numbers(path: Path, dialect: Dialect, wanted: Sequence[int]) -> list[FloatArray]:
    """Columns of a text, NaN where a reading is missing. Raises InputError for a row of another form."""
    words: dict[int, list[str]] = {k: [] for k in wanted if dialect.kinds[k] == "t"}
    parts = list(row_blocks(path, dialect, wanted, words))
    if not parts:
        raise InputError(path, "", "headings alone", "a line of numbers for each sample")
    found = [np.concatenate([part[:, at] for part in parts]) for at in range(len(wanted))]
    return [clock_seconds(words[k], path) if k in words else c for k, c in zip(wanted, found, strict=True)]


@cache
def _library() -> Any:
    read = library(read_packaged("identification/readers/cells.c").decode(), 1, flags=SAMPLE_LOOP_FLAGS)
    if read is not None:
        read.cells.restype = ctypes.c_long
    return read


def fast_rows(block: bytes, dialect: Dialect, wanted: Sequence[int]) -> FloatArray | None:
    """Rows by compiled C, to the bit those of Python. None without a compiler, and for what that does not take."""
    read = _library()
    if read is None:
        return None
    count = len(dialect.kinds)
    kept = np.isin(np.arange(count), wanted).astype(np.uint8)
    table = np.empty((block.count(b"\n") + 1, len(wanted)))
    signs = (ctypes.c_char(sign.encode()) for sign in (dialect.separator, dialect.decimal))
    text = address_of(np.frombuffer(block, np.uint8))
    size, cells, most = (ctypes.c_long(n) for n in (len(block), count, len(table)))
    rows = read.cells(text, size, cells, address_of(kept), most, address_of(table), *signs)
    return None if rows < 0 else table[:rows]


def plain_rows(
    block: bytes, dialect: Dialect, wanted: Sequence[int], row: int, words: dict[int, list[str]]
) -> FloatArray:
    """Rows by Python; cells of instants go to `words`. Raises ValueError for what is no number.

    row : the number of the first one, for errors
    """
    encoding = "utf-8" if dialect.encoding.startswith("utf") else dialect.encoding
    lines = block.decode(encoding).splitlines()
    rows = []
    for k, cells in enumerate(csv.reader(lines, delimiter=dialect.separator)):
        if not any(cell.strip() for cell in cells) and len(cells) < 2:
            continue
        if len(cells) != len(dialect.kinds):
            raise ValueError(f"row {row + k + 1}: {len(cells)} cells in a line of {len(dialect.kinds)}")
        for at, found in words.items():
            found.append(cells[at])
        decimal, line = dialect.decimal, row + k + 1
        rows.append([np.nan if at in words else _number(cells[at], decimal, line) for at in wanted])
    return np.array(rows, dtype=float).reshape(len(rows), len(wanted))


def _number(cell: str, decimal: str, row: int) -> float:
    """A cell as a number, NaN for a missing one."""
    text = cell.strip().strip('"').strip()
    if text.lower() in MISSING:
        return np.nan
    text = text.replace(",", ".") if decimal == "," else text
    if not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text):
        raise ValueError(f"{cell[:30]!r} in row {row}")
    return float(text)


def is_clock(cell: str) -> bool:
    """Whether a cell is an instant: a time of the day, with a date or without."""
    return CLOCK.fullmatch(cell.strip().strip('"')) is not None


def clock_seconds(cells: Sequence[str], path: Path) -> FloatArray:
    """Instants as s after the first one's midnight; a clock that falls has passed a noon or a midnight."""
    found = [CLOCK.fullmatch(cell.strip().strip('"')) for cell in cells]
    if None in found:
        k = found.index(None)
        raise InputError(
            path, "t", f"{cells[k][:30]!r} in row {k + 1}", "an instant, as 2026-11-27 10:00:00.000050"
        )
    parts = [m.groups() for m in found if m is not None]
    whole = np.array([3600 * int(h) + 60 * int(m) + int(s) for _, h, m, s, _, _ in parts], dtype=float)
    fraction = np.array([int(f or 0) / 10.0 ** len(f or "") for *_, f, _ in parts])
    half = 43_200.0 if parts and parts[0][-1] else 86_400.0
    turns = np.concatenate([[0.0], np.cumsum(np.diff(whole) < -half / 2)]) * half
    return np.asarray(whole + turns + fraction)
