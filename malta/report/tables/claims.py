"""The ledger of published numbers, a line a claim."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.text import Text

from malta.report.tables.layout import INDENT, fold

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

    from malta.report.ledger import Claim, Ledger

GAP = 2  # columns of a terminal between those of a line
LEAST = 30  # letters of a claim that a line shows at least: a terminal with room for fewer has fewer designs a line
CUT = "…"


@dataclass(frozen=True)
class ClaimLines:
    """A line for each claim: claim, published figure, that of each design, and the verdict in one word.

    Claims that are too long for their line are cut in the middle. Where not all designs fit beside each other, the
    lines are printed once for as many designs as fit, and then for the others.

    ledger : from `malta.ledger`
    why : below each line the whole claim, where it was cut, and the whole verdict with its reason
    """

    ledger: Ledger
    why: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw the lines in the width that is given."""
        width = options.max_width
        yield Text("\n".join(fold(f"Published numbers and ours: {self.ledger.title}", width)))
        for designs in self._blocks(width):
            yield Text("\n".join(["", *self._lines(designs, width)]))

    def _columns(self, designs: Sequence[int]) -> list[list[str]]:
        """The texts of all columns but the claim's, each with its heading."""
        ledger = self.ledger
        ours = [[ledger.designs[k], *(claim.ours[k] for claim in ledger.claims)] for k in designs]
        published = ["published", *(claim.published for claim in ledger.claims)]
        return [published, *ours, ["verdict", *(claim.word for claim in ledger.claims)]]

    def _room(self, designs: Sequence[int], width: int) -> int:
        """The letters that are left for the claim."""
        return width - sum(max(map(len, column)) + GAP for column in self._columns(designs))

    def _blocks(self, width: int) -> list[list[int]]:
        """The designs that stand beside each other."""
        blocks: list[list[int]] = [[]]
        for k in range(len(self.ledger.designs)):
            if blocks[-1] and self._room([*blocks[-1], k], width) < LEAST:
                blocks.append([])
            blocks[-1].append(k)
        return blocks

    def _lines(self, designs: Sequence[int], width: int) -> Iterator[str]:
        """Heading, rule and claims for some of the designs."""
        columns = self._columns(designs)
        longest = max(len("claim"), *(len(claim.subject) for claim in self.ledger.claims))
        room = max(min(self._room(designs, width), longest), 2 * len(CUT) + 1)
        widths = [max(map(len, column)) for column in columns]
        for row, claim in enumerate((None, *self.ledger.claims)):
            numbers = (
                " " * GAP + column[row].rjust(n) for column, n in zip(columns[:-1], widths, strict=False)
            )
            subject = "claim" if claim is None else claim.subject
            line = _cut(subject, room).ljust(room) + "".join(numbers) + " " * GAP + columns[-1][row]
            yield line
            if claim is None:
                yield "─" * (room + sum(n + GAP for n in widths))
            elif self.why:
                yield from _reasons(claim, room, width)


def _reasons(claim: Claim, room: int, width: int) -> Iterator[str]:
    """The whole claim, where its line has it cut, and the whole verdict, as lines that are indented."""
    whole = f"{claim.subject}: " if len(claim.subject) > room else ""
    if whole or claim.verdict != claim.word:
        yield from (INDENT + line for line in fold(whole + claim.verdict, width - len(INDENT)))


def _cut(text: str, room: int) -> str:
    """A text in `room` letters, without its middle where it is longer: the end tells rows and units apart.

    >>> _cut("K(p) and pseudo-inverse, table [us]", 24)
    'K(p) and pse…table [us]'
    """
    if len(text) <= room:
        return text
    end = (room - len(CUT)) // 2
    return text[: room - len(CUT) - end].rstrip() + CUT + text[len(text) - end :].lstrip()


def claims_table(ledger: Ledger, *, why: bool = False) -> ClaimLines:
    """Tabulate published numbers, a line each: the paper's value, that of each design, and the verdict in one word.

    ledger : from `malta.ledger`
    why : below each line the whole verdict, with its reason

    Returns what `rich.print` prints: a line for each claim, in the width of the terminal.

    >>> import malta, rich
    >>> from malta.report.ledger import Claim, Ledger
    >>> verdict = "by construction; K_A"
    >>> claim = Claim("pole of x [rad/s]", "±218.92", ("±218.92",), verdict, "input")
    >>> ledger = Ledger("tubular", "the paper", ("table2",), (claim,))
    >>> rich.print(malta.report.claims_table(ledger, why=True))
    Published numbers and ours: tubular, the paper
    <BLANKLINE>
    claim              published   table2  verdict
    ──────────────────────────────────────────────
    pole of x [rad/s]    ±218.92  ±218.92  input
      by construction; K_A
    """
    return ClaimLines(ledger, why)
