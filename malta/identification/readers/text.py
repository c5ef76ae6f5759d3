"""Tables of text as instruments and spreadsheets write them: separators, decimal commas, encodings, headers.

The rows of numbers are found first: the last lines of a file's beginning tell separator and kinds of columns, and the
first line that is such a row ends the header: words with their values, names, a row of units.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.identification.readers.numbers import (
    MISSING,
    Dialect,
    is_clock,
    open_text,
    read_numbers,
    row_blocks,
)
from malta.identification.readers.raw import (
    RawColumn,
    RawLog,
    heading_parts,
    is_unit,
    plain_unit,
    refuse_damage,
)
from malta.identification.readers.stored import MOST_IN_MEMORY
from malta.units import is_unit_of, to_si

SAMPLE = 262_144  # bytes of the beginning, in which the header and some rows stand
PACKING = 3  # times as many bytes as those of a text that gzip packed
KIND_ROWS = 20  # rows that tell the kinds of columns
HEAD_WORDS = ("machine", "controller", "sample_time", "period", "idle", "malta")
INTERVAL_WORDS = ("sample interval", "sampling interval", "sample period", "delta_x", "dt")
UNIT_WORDS = ("unit", "units", "vertical units", "y_unit_label", "einheit", "einheiten")
NAME_WORDS = ("label", "labels", "name", "names")
NUMBER = r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?"

Rows = Sequence[list[str]]


def text_log(path: Path) -> RawLog:
    """A table of text as columns. Raises InputError where no rows of numbers are found."""
    try:
        with open_text(path) as file:
            sample = file.read(SAMPLE)
    except (OSError, EOFError) as error:
        raise refuse_damage(path, "text, or one packed by gzip", error) from error
    encoding = _find_encoding(sample)
    try:
        text = sample.decode(encoding, "strict" if len(sample) < SAMPLE else "ignore")
    except UnicodeDecodeError as error:
        raise InputError(path, "", "bytes that are no text", "UTF-8, UTF-16 or Latin-1") from error
    lines = [line.rstrip("\r") for line in text.split("\n")]
    # The last line is nothing, or a part of one where a logger was switched off.
    dialect, header = _sniff(lines[:-1] if len(lines) > 2 else lines, encoding, path)
    head, columns, start = _header(header, dialect, path)
    # A signal has a unit: words in its column are refused when it is read.
    numbers = "".join("n" if c.unit and k == "x" else k for c, k in zip(columns, dialect.kinds, strict=True))
    dialect = dialect._replace(kinds=numbers)

    def load(numbers: Sequence[int]) -> list[FloatArray]:
        found = read_numbers(path, dialect, numbers)
        return [
            start[0] + start[1] * c if start and k == 0 else c for k, c in zip(numbers, found, strict=True)
        ]

    size = path.stat().st_size * (PACKING if path.suffix.lower() == ".gz" else 1)
    return RawLog(
        head,
        columns,
        load,
        blocks=lambda numbers: row_blocks(path, dialect, numbers),
        long=size > MOST_IN_MEMORY and not start and "t" not in dialect.kinds,
    )


def _find_encoding(sample: bytes) -> str:
    """The encoding of a text, by its mark or by its bytes."""
    if sample[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if len(sample) > 4 and sample[1:40:2].count(0) > 0.8 * len(sample[1:40:2]):
        return "utf-16-le"
    try:
        sample[:-4].decode("utf-8")
        return "utf-8-sig"
    except UnicodeDecodeError as error:
        return "latin-1" if error.start < len(sample) - 8 and b"\0" not in sample else "utf-8-sig"


def _kind(cell: str) -> str:
    """What a cell holds: "n" a number, "t" an instant, "" nothing, "x" words."""
    text = cell.strip().strip('"').strip()
    if text.lower() in MISSING:
        return ""
    return "n" if re.fullmatch(NUMBER, text) else "t" if is_clock(text) else "x"


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return next(csv.reader([line], delimiter=separator), [])


def _separator(rows: Sequence[str]) -> str:
    """The separator of rows of numbers: the first of these signs that all of them have."""
    for sign in "\t;,":
        if rows and all(sign in row for row in rows):
            return sign
    return " " if rows and all(len(row.split()) > 1 for row in rows) else ","


def _sniff(lines: Sequence[str], encoding: str, path: Path) -> tuple[Dialect, list[str]]:
    """How a text is a table, and the lines above its rows. Raises InputError where it is none."""
    there = [k for k, line in enumerate(lines) if line.strip()]
    headings = [k for k in there if not lines[k].startswith("#")]
    if not headings:
        raise InputError(path, "", "no line of headings", 'a line as "t [s],x1 [um],..."')
    last = [lines[k] for k in there[-KIND_ROWS:] if k > headings[0]] or [lines[headings[0]]]
    separator = _separator(last[len(last) // 2 :])
    rows = [_cells(line, separator) for line in last[len(last) // 2 :]]
    count = len(rows[-1])
    commas = any(re.fullmatch(r"[-+]?\d+,\d+([eE].*)?", cell.strip()) for cell in rows[-1])
    decimal = "," if separator != "," and commas else "."
    kinds = "".join(_column_kind([row[k] for row in rows if len(row) == count]) for k in range(count))

    def is_row(line: str) -> bool:
        cells = _cells(line, separator)
        own = [_kind(cell) for cell in cells]
        fits = len(cells) == count and any(own)
        return fits and all(a in ("", b) or b == "x" for a, b in zip(own, kinds, strict=True))

    begin = next((k for k in there if k > headings[0] - 1 and is_row(lines[k])), -1)
    if begin < 0 or not {"n", "t"} & set(kinds):
        begin = headings[0] + 1  # no row of numbers: what stands there is refused when it is read
        kinds = "n" * len(_cells(lines[headings[0]], separator))
    return Dialect(encoding, separator, decimal, begin, kinds), list(lines[:begin])


def _column_kind(cells: Sequence[str]) -> str:
    """What a column holds, by some of its cells; "x" where all are words."""
    kinds = {_kind(cell) for cell in cells} - {""}
    return kinds.pop() if len(kinds) == 1 else "n"


def _header(
    lines: Sequence[str], dialect: Dialect, path: Path
) -> tuple[dict[str, Any], list[RawColumn], tuple[float, float] | None]:
    """Head and columns by the lines above the rows; and begin and interval of a column that counts samples."""
    head: dict[str, Any] = {}
    for line in lines:
        words = line[1:].split()
        if line.startswith("#") and len(words) > 1 and words[0] in HEAD_WORDS:
            head[words[0]] = " ".join(words[1:]) if words[0] == "idle" else words[1]
    rows = [_cells(line, dialect.separator) for line in lines if line.strip() and not line.startswith("#")]
    rows = [
        [cell.strip().strip('"').strip() for cell in row] for row in rows if any(cell.strip() for cell in row)
    ]
    if not rows:  # numpy.savetxt writes the headings behind a #
        rows = [_cells(line[1:].strip(), dialect.separator) for line in lines if line.startswith("#")]
        rows = [row for row in rows if len(row) == len(dialect.kinds)]
    if not rows:
        raise InputError(path, "", "no line of headings", 'a line as "t [s],x1 [um],..."')
    if paired := _paired_columns(rows, dialect):
        return head, paired, None
    count = len(dialect.kinds)
    names, units = _names_and_units(rows, count)
    columns = [RawColumn(*heading_parts(name)) for name in names]
    columns = [RawColumn(c.name, c.unit or plain_unit(unit)) for c, unit in zip(columns, units, strict=True)]
    for k, kind in enumerate(dialect.kinds):
        if kind == "x" and not columns[k].unit:
            columns[k] = RawColumn("")
    step = _stated_interval(rows, path)
    if step and all(c.name.lower() not in ("time", "t", "x_value") for c in columns):
        head.setdefault("sample_time", step)
    return head, columns, _sample_counter(rows, columns, dialect)


def _names_and_units(rows: Rows, count: int) -> tuple[list[str], list[str]]:
    """Names and units of the columns: of the last row of names, of a row of units, and of rows that say so."""
    wide = [row for row in rows if len(row) >= count or len(row) == count - 1]
    if not wide:
        wide = [rows[-1] + [""] * (count - len(rows[-1]))]
    units = [""] * count
    if len(wide) > 1 and _is_unit_row(wide[-1]):
        units = ([*wide[-1], *units])[:count]
        wide = wide[:-1]
    names = ([*wide[-1], *[""] * count])[:count]
    for row in wide[:-1]:
        word = row[0].lower().rstrip(":")
        if word in UNIT_WORDS and any(map(is_unit, row[1:])):
            units = [units[0], *([*row[1:], *[""] * count])[: count - 1]]
        elif word in NAME_WORDS and any(row[1:]):
            given = [*row[1:], *[""] * count]
            names = [names[0], *(new or old for new, old in zip(given, names[1:], strict=False))]
        elif word == "horizontal units" and len(row) > 1:
            units[0] = row[1]
    return names, units


def _is_unit_row(row: Sequence[str]) -> bool:
    """Whether a row of the header has units alone, or a word for what counts in place of the first."""
    there = [cell.strip("[]() ") for cell in row if cell and not re.fullmatch(NUMBER, cell)]
    own = [cell for cell in there if cell.lower() != "sequence"]
    return bool(own) and all(is_unit(cell) or plain_unit(cell) == "" for cell in own)


def _paired_columns(rows: Rows, dialect: Dialect) -> list[RawColumn]:
    """The columns of a TwinCAT Scope: each has times of its own before it, and words above both; [] of others."""
    count = len(dialect.kinds)
    own = [
        row for row in rows if len(row) >= count > 1 and row[0] == "Name" and set(row[::2]) <= {"Name", ""}
    ]
    if not own or count % 2:
        return []
    named = own[-1]
    values = {row[0]: row for row in rows if len(row) >= count and row[0] == row[2 % len(row)]}
    clock = next((word for word in values if word.startswith("SampleTime")), "SampleTime[ms]")
    unit_row = values.get("Unit", [""] * count)
    columns = []
    for k in range(0, count, 2):
        columns.append(RawColumn(f"time of {named[k + 1]}", heading_parts(clock)[1]))
        columns.append(RawColumn(named[k + 1], plain_unit(unit_row[k + 1]), times=k))
    return columns


def _stated_interval(rows: Rows, path: Path) -> float:
    """The sample time that a header names, s; 0: none."""
    for row in rows:
        name, unit = heading_parts(row[0])
        if len(row) > 1 and name.lower().rstrip(":") in INTERVAL_WORDS and re.fullmatch(NUMBER, row[1]):
            seconds = float(row[1].replace(",", "."))
            return to_si(seconds, unit, "s", path, name) if is_unit_of(unit, "s") else seconds
    return 0.0


def _sample_counter(rows: Rows, columns: list[RawColumn], dialect: Dialect) -> tuple[float, float] | None:
    """Begin and interval of a first column that counts samples, as a Rigol's; it becomes one of times, s."""
    for names, values in pairwise(rows):
        if "Increment" in names and len(values) >= names.index("Increment"):
            step = values[names.index("Increment")]
            begin = values[names.index("Start")] if "Start" in names else "0"
            if re.fullmatch(NUMBER, step) and re.fullmatch(NUMBER, begin) and dialect.kinds[0] == "n":
                columns[:] = [RawColumn("") if c.name in ("Start", "Increment") else c for c in columns]
                columns[0] = RawColumn("t", "s")
                return float(begin), float(step)
    return None
