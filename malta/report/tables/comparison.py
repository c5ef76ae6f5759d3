"""The tables of a comparison for a terminal: what differs, and figures of merit with the better one marked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.text import Text

from malta.report.figures.parts import micro
from malta.report.tables.parts import new_table

if TYPE_CHECKING:
    from rich.table import Table

    from malta.report.page.comparison import Comparison, Line

BEST = "*"  # behind the better value, beside bold letters
LABELS = 34  # letters of the first column; longer labels are broken into lines
NAME = 18  # letters of a design's name in a heading; longer names are broken
EDGE = 2  # letters at both ends of a line


def comparison_tables(found: Comparison, width: int = 80) -> Group:
    """What differs in the designs, and their figures of merit, in blocks of designs that fit in `width` columns."""
    parts: list[Any] = []
    for title, lines in (
        ("What differs in the designs", found.difference_lines),
        (f"Figures of merit ({BEST} and bold: better)", found.figure_lines),
    ):
        for columns in _blocks(found.names, lines, width):
            parts.append(_table(title, found.names, lines, columns))
    if not found.differences:
        parts.insert(0, Text("The designs do not differ.\n"))
    parts += [Text(remark) for remark in found.remarks]
    return Group(*parts)


def _blocks(names: Sequence[str], lines: Sequence[Line], width: int) -> Iterator[list[int]]:
    """Columns of designs that fit beside each other; none without lines."""
    block: list[int] = []
    room = width - LABELS - EDGE
    for k, name in enumerate(names if lines else ()):
        needed = max(min(len(name), NAME), *(len(line.texts[k]) + len(BEST) + 1 for line in lines)) + 2
        if block and needed > room:
            yield block
            block, room = [], width - LABELS - EDGE
        block.append(k)
        room -= needed
    if block:
        yield block


def _table(title: str, names: Sequence[str], lines: Sequence[Line], columns: Sequence[int]) -> Table:
    """A table of some of the designs, with a line for each group."""
    table = new_table(title, "", *(names[k] for k in columns))
    table.columns[0].max_width = LABELS
    group = ""
    for line in lines:
        if line.group != group:
            if group:
                table.add_section()
            group = line.group
            table.add_row(Text(group, style="italic"))
        cells = [
            Text(f"{line.texts[k]} {BEST}", style="bold") if line.best[k] else Text(f"{line.texts[k]}  ")
            for k in columns
        ]
        table.add_row(Text(micro(line.heading)), *cells)
    return table
