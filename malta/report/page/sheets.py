"""Tables of a page, from the same tables that the terminal shows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from malta.report.figures.parts import micro

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Signal


WIDE = 8  # columns of a matrix beside each other


@dataclass(frozen=True)
class Sheet:
    """A table of a page: cells as text, and for each column whether it is aligned to the right."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: tuple[bool, ...]
    # by row and column, of a cell that stands out: "good", "near", "bad" or "best"
    marks: tuple[tuple[str, ...], ...] = ()

    def mark(self, row: int, column: int) -> str:
        """The mark of a cell; "" for none."""
        return self.marks[row][column] if self.marks else ""


def sheets_of(parts: Any) -> list[Sheet]:
    """The tables in what a terminal would print, in its order; texts between them become tables without rows."""
    if isinstance(parts, Table):
        return [_sheet(parts)]
    if isinstance(parts, Group):
        return [sheet for part in parts.renderables for sheet in sheets_of(part)]
    if isinstance(parts, str | Text):
        return [Sheet(polish(str(parts)), (), (), ())] if str(parts).strip() else []
    return [sheet for part in parts for sheet in sheets_of(part)] if isinstance(parts, Iterable) else []


def _sheet(table: Table) -> Sheet:
    columns = [[polish(_text(cell)) for cell in column.cells] for column in table.columns]
    return Sheet(
        polish(_text(table.title or "")),
        tuple(polish(_text(column.header)) for column in table.columns),
        tuple(zip(*columns, strict=True)),
        tuple(column.justify == "right" for column in table.columns),
    )


def _text(cell: Any) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def polish(text: str) -> str:
    """A text of a terminal with the signs that a page has: ±, ≤, µm, minus.

    >>> polish("-3745+-3096j <= 1 um")
    '−3745±3096j ≤ 1 µm'
    """
    text = text.replace("+-", "±").replace("<=", "≤").replace(">=", "≥")
    return micro(re.sub(r"(?<![\w.])-(?=\d)", "−", text))


def plain_sheet(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Sheet:
    """A table whose first column is of words, the others of numbers."""
    return Sheet(
        polish(title),
        tuple(map(polish, heads)),
        tuple(tuple(map(polish, row)) for row in rows),
        (False, *(True for _ in heads[1:])),
    )


def matrix_sheets(
    title: str, M: FloatArray, rows: Sequence[Signal], columns: Sequence[Signal]
) -> Iterator[Sheet]:
    """A matrix with the names and units of its rows and columns, in parts that a sheet of paper has room for."""
    for first in range(0, len(columns), WIDE):
        part = columns[first : first + WIDE]
        heads = ["", *(_name(s) for s in part)]
        values = M[:, first : first + WIDE].tolist()
        cells = ([_name(s), *(_entry(value) for value in row)] for s, row in zip(rows, values, strict=True))
        more = "" if len(part) == len(columns) else f", columns {first + 1} to {first + len(part)}"
        yield plain_sheet(f"{title}{more}", heads, cells)


def _name(signal: Signal) -> str:
    return signal.name if signal.unit == "1" else f"{signal.name} [{signal.unit}]"


def _entry(value: float) -> str:
    return f"{value:.6g}" if value else "0"
