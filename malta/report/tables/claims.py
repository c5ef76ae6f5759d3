"""The ledger of published numbers as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from malta.report.tables.parts import add_row, new_table

if TYPE_CHECKING:
    from malta.report.ledger import Ledger


def claims_table(ledger: Ledger) -> Table:
    """Tabulate published numbers: the paper's value, that of each design, and the verdict.

    ledger : from `malta.ledger`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> from malta.report.ledger import Claim, Ledger
    >>> claim = Claim("pole of x [rad/s]", "±218.92", ("±218.92",), "reproduced")
    >>> ledger = Ledger("tubular", "the paper", ("table2",), (claim,))
    >>> rich.print(malta.report.claims_table(ledger))
    Published numbers and ours: tubular, the paper
    <BLANKLINE>
     claim               published    table2   verdict
     ────────────────────────────────────────────────────
     pole of x [rad/s]     ±218.92   ±218.92   reproduced
    <BLANKLINE>
    """
    table = new_table(
        f"Published numbers and ours: {ledger.title}", "claim", "published", *ledger.designs, "verdict"
    )
    table.columns[-1].justify = "left"
    for claim in ledger.claims:
        add_row(table, claim.subject, claim.published, *claim.ours, claim.verdict)
    return table
