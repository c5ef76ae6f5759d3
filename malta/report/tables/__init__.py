"""Tables of everything that malta computes, for a terminal: they fit the width they are given.

Texts fold at spaces, numbers keep their units. A table that is too wide first folds its headings, then its cells, and
is then drawn as several tables below each other that share the first column. Where even two columns are too wide, each
row becomes a list. Nothing is ever left out.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

from rich import box
from rich.table import Column, Table
from rich.text import Text

from malta.display import micro
from malta.report.figures.drawing import Published, number, published_in_unit
from malta.units import in_unit

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.style import Style

    from malta.merits import Merit

EDGES = 2  # columns of a terminal, left and right of a table
GAPS = (3, 2)  # columns of a terminal between those of a table: if possible, and if need be
MAX_CELL_LETTERS = 30  # letters; cells that are longer are folded before a table is split
INDENT = "  "
_NUMBER = r"(?<![\w.])[-+±]*\d[\d.,e+-]*j?"
_UNIT = r"(?:%|[munkMµ]?(?:m|s|g|N|A|V|W|J|H|F|T|rad|Hz|Ohm|ohm)|deg|dB|samples|us)(?:[/^*][\w^]+)*(?![\w])"
_WHOLE_CELL = re.compile(
    rf"{_NUMBER}(?: {_UNIT})+"  # 1 N m
    rf"|{_NUMBER} (?:\(x\d+\)|±[\d.]+)"  # a pole that is there twice; an interval
    r"|(?:[<>]=?|=|about|x) (?=[-+]?\d)"
    r"|\[[^\[\]]{1,24}\]"  # [N m]
)
_JOINING_SPACE = "\N{NO-BREAK SPACE}"  # which textwrap does not break at


def glue(text: str) -> str:
    """Join numbers with their units, and what stands in brackets, by spaces that no fold breaks.

    >>> glue("at 1 N m or more").replace("\\N{NO-BREAK SPACE}", "_")
    'at 1_N_m or more'
    """
    once = _WHOLE_CELL.sub(lambda found: found[0].replace(" ", _JOINING_SPACE), text)
    return _WHOLE_CELL.sub(
        lambda found: found[0].replace(" ", _JOINING_SPACE), once
    )  # "<= 5 um" has two joints


def fold(text: str, width: int) -> list[str]:
    """Fold a text into lines of at most `width` letters, at spaces that do not part a number from its unit.

    Microns are written as µm. Only a word or a number with its unit that is longer than a line is broken.

    >>> fold("moves by 353.3 um in all", 12)
    ['moves by', '353.3 µm in', 'all']
    """
    lines = [
        line
        for part in text.split("\n")
        for line in textwrap.wrap(glue(part), max(width, 1), break_on_hyphens=False) or [""]
    ]
    return [micro(line.replace(_JOINING_SPACE, " ")) for line in lines]


def longest_word(text: str) -> int:
    """The letters of the longest part of a text that folds do not break."""
    return max((len(word) for word in re.split("[ \n]", glue(text))), default=0)


def longest_line(text: str) -> int:
    """The letters of the longest line of a text."""
    return max(map(len, text.split("\n")))


@dataclass(frozen=True)
class Widths:
    """How wide a column can be: headings and cells in one line; cells in one line; everything folded."""

    whole: int
    body: int
    least: int


def widths_of(heading: str, cells: Sequence[str]) -> Widths:
    """The widths of a column.

    >>> widths_of("share in the margin", ["12 %", "3 %"])
    Widths(whole=19, body=6, least=6)
    """
    word = longest_word(heading)
    body = max([word, *map(longest_line, cells)])
    return Widths(max(body, longest_line(heading)), body, max([word, *map(longest_word, cells)]))


def allot(columns: Sequence[Widths], room: int, *, cells: bool) -> list[int] | None:
    """Share `room` among columns, the widest folds first. None where they do not fit.

    Headings and sentences fold before short cells, where `cells` lets these fold, and the first column, which names
    the rows, folds last.
    """
    found = [one.whole for one in columns]
    bodies = [columns[0].body, *(_short(one) for one in columns[1:])]
    least = [one.least for one in columns]
    for floors in (bodies, [bodies[0], *least[1:]], least)[: 3 if cells else 1]:
        while sum(found) > room:
            loose = [i for i, floor in enumerate(floors) if found[i] > floor]
            if not loose:
                break
            found[max(loose, key=lambda i: found[i])] -= 1
    return found if sum(found) <= room else None


def _short(column: Widths) -> int:
    """The width to which a column folds before others fold: that of its cells, or of lines of sentences."""
    return column.body if column.body <= MAX_CELL_LETTERS else max(column.least, MAX_CELL_LETTERS)


def split(columns: Sequence[Widths], width: int) -> list[list[int]] | None:
    """The columns of the tables that a wide table is drawn as: each has the first one, and as many others as fit.

    None where the first column and some other do not fit beside each other.
    """
    gap = GAPS[-1]
    wanted = [_short(one) for one in columns]
    room, blocks = width - EDGES, [[0]]
    for i in range(1, len(columns)):
        if columns[0].least + gap + columns[i].least > room:
            return None
        taken = sum(wanted[k] + gap for k in blocks[-1])
        if len(blocks[-1]) > 1 and taken + wanted[i] > room:
            blocks.append([0])
        blocks[-1].append(i)
    return blocks


class FoldingTable(Table):
    """A table of rich that folds and splits to the width it is given, and cuts nothing."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw the table; several below each other, or lists, where the width asks for it."""
        width = options.max_width
        if self.title:
            yield Text("\n".join(fold(str(self.title), width)))
        cells = [[str(cell) for cell in column.cells] for column in self.columns]
        headings = [str(column.header) for column in self.columns]
        measured = [widths_of(*one) for one in zip(headings, cells, strict=True)]
        for gap, folded in ((GAPS[0], False), (GAPS[1], False), (GAPS[1], True)):
            found = allot(measured, width - EDGES - gap * (len(measured) - 1), cells=folded)
            if found is not None:
                yield self._block_table(list(range(len(measured))), found, cells, gap)
                return
        blocks = split(measured, width)
        if blocks is None:
            yield Text("\n".join(_as_lists(headings, cells, width)))
            return
        for block in blocks:
            room = width - EDGES - GAPS[-1] * (len(block) - 1)
            found = allot([measured[i] for i in block], room, cells=True)
            assert found is not None  # `split` has made blocks that fit
            yield self._block_table(block, found, cells, GAPS[-1])

    def _block_table(
        self, block: Sequence[int], widths: Sequence[int], cells: list[list[str]], gap: int
    ) -> Table:
        """The table of some columns in these widths; rows without a cell in them are left out."""
        drawn = Table(box=self.box, pad_edge=False, padding=(0, 1, 0, gap - 2), show_header=self.show_header)
        for i, width in zip(block, widths, strict=True):
            column: Column = self.columns[i]
            heading = Text("\n".join(fold(str(column.header), width)))
            drawn.add_column(heading, justify=column.justify, no_wrap=True)
        for row, style in enumerate(self.rows):
            texts = [cells[i][row] for i in block]
            if len(block) == len(self.columns) or any(texts[1:]):
                folded = ("\n".join(fold(text, width)) for text, width in zip(texts, widths, strict=True))
                marks = (_style_of(self.columns[i], row) for i in block)
                drawn.add_row(*map(Text, folded, marks), end_section=style.end_section)
        return drawn


def _style_of(column: Column, row: int) -> str | Style:
    """The style of a cell, as bold; none of a plain string."""
    cell = next(islice(column.cells, row, None))
    return cell.style if isinstance(cell, Text) else ""


def _as_lists(headings: Sequence[str], cells: Sequence[Sequence[str]], width: int) -> list[str]:
    """Each row as lines: its first cell, then heading and cell of every other column, indented."""
    lines = [""]
    for row in zip(*cells, strict=True):
        lines += fold(row[0], width)
        for heading, cell in zip(headings[1:], row[1:], strict=True):
            if cell:
                entry = f"{heading}: {cell}" if heading else cell
                lines += [INDENT + line for line in fold(entry, width - len(INDENT))]
    return [*lines, ""]


def new_sheet(title: str, columns: Sequence[tuple[str, str]]) -> FoldingTable:
    """An empty table with columns (heading, "left" or "right"); texts are text, not rich's markup."""
    table = FoldingTable(title=Text(title), box=box.SIMPLE_HEAD)
    for heading, side in columns:
        table.add_column(Text(heading), justify="left" if side == "left" else "right")
    return table


@dataclass(frozen=True)
class Paragraph:
    """A text of one paragraph that folds at spaces, as the cells of tables do: no number parts from its unit.

    text : the text
    style : as rich has it, "bold"; "": plain

    >>> import malta, rich
    >>> rich.print(malta.report.Paragraph("F_x moves x2 by 52.9 um", style="bold"))
    F_x moves x2 by 52.9 µm
    """

    text: str
    style: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw the lines of the text."""
        yield Text("\n".join(fold(self.text, options.max_width)), style=self.style)


# Rows, cells and headings that several tables share.

ROUNDING_LIMIT = 1e-9  # in its unit, up to which a value is shown as 0
POWER_LIMIT = 1e-3  # below which it is shown as 4.7e-07


def merit_text(merit: Merit) -> str:
    """Our value of a figure of merit, in its unit; counts without decimals."""
    count = merit.unit == "1" and merit.value.is_integer()
    return f"{merit.value:.0f}" if count else digits_of(in_unit(merit.value, merit.unit))


def digits_of(value: float, digits: int = 4) -> str:
    """A number with so many digits; a small one with its power of ten, and what is rounding as 0."""
    return f"{value:.{digits}g}" if ROUNDING_LIMIT < abs(value) < POWER_LIMIT else number(value, digits)


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


COLOURS = {"holds": "green", "undecided": "bold yellow", "fails": "bold red"}  # of a verdict, beside its word


def add_row(table: Table, *cells: str | Text) -> None:
    """Append a row; brackets in cells are text, not rich's markup."""
    table.add_row(*(cell if isinstance(cell, Text) else Text(cell) for cell in cells))


def end_cell(end: str, *, completed: bool) -> Text:
    """How a run ended, in the colour of a verdict."""
    return Text(end, style=COLOURS["holds" if completed else "fails"])
