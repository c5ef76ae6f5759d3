"""Rows, cells and headings that several tables share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from malta.report.figures.parts import Published, number, published_in_unit
from malta.report.tables.layout import FoldingTable, new_sheet
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.simulation.experiments import Merit


def merit_heading(merit: Merit) -> str:
    """The name of a figure of merit with its unit in brackets."""
    unit = {"percent": "%", "1": ""}.get(merit.unit, merit.unit)
    return f"{merit.label} [{unit}]" if unit else merit.label


def merit_text(merit: Merit) -> str:
    """Our value of a figure of merit, in its unit; counts without decimals."""
    count = merit.unit == "1" and merit.value.is_integer()
    return f"{merit.value:.0f}" if count else number(in_unit(merit.value, merit.unit))


def published_text(merit: Merit, published: Published) -> str:
    """The published value of a figure of merit, in its unit; empty where the paper prints none."""
    if not merit.published:
        return ""
    value = f"{published_in_unit(published, merit.published, merit.unit):.6g}"
    return f"<= {value}" if merit.relation == "at most" else value


def new_table(title: str, *columns: str) -> FoldingTable:
    """An empty table: the first column and columns of poles are left-aligned, the others right-aligned."""
    sides = ("left" if i == 0 or heading == "poles" else "right" for i, heading in enumerate(columns))
    return new_sheet(title, list(zip(columns, sides, strict=True)))


def add_row(table: Table, *cells: str) -> None:
    """Append a row; brackets in cells are text, not rich's markup."""
    table.add_row(*map(Text, cells))
