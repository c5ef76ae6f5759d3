"""The tables of a comparison for a terminal: what differs, and figures of merit with the better one marked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.text import Text

from malta.report.figures.parts import micro
from malta.report.page.comparison import NOTHING
from malta.report.tables.parts import new_table

if TYPE_CHECKING:
    from rich.table import Table

    from malta.report.page.comparison import Comparison, Line

JOINT = "\N{NO-BREAK SPACE}"
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
    room, sign = width - LABELS - EDGE, _sign_width(lines)
    for k, name in enumerate(names if lines else ()):
        needed = max(min(len(name), NAME), *(len(line.texts[k]) + sign for line in lines)) + EDGE
        if block and needed > room:
            yield block
            block, room = [], width - LABELS - EDGE
        block.append(k)
        room -= needed
    if block:
        yield block


def _sign_width(lines: Sequence[Line]) -> int:
    """The letters behind a value that mark it as better."""
    return len(BEST) + 1 if any(any(line.best) for line in lines) else 0


def _table(title: str, names: Sequence[str], lines: Sequence[Line], columns: Sequence[int]) -> Table:
    """A table of some of the designs, with a line for each group, of the lines that one of them has a value in."""
    table = new_table(title, "", *(names[k] for k in columns))
    group, blank = "", JOINT * _sign_width(lines)
    for line in lines:
        if all(line.texts[k] == NOTHING for k in columns):
            continue
        if line.group != group:
            if group:
                table.add_section()
            group = line.group
            table.add_row(Text(group, style="italic"))
        cells = [
            Text(f"{line.texts[k]}{JOINT}{BEST}", style="bold")
            if line.best[k]
            else Text(line.texts[k] + blank)
            for k in columns
        ]
        table.add_row(Text(micro(line.heading)), *cells)
    return table
