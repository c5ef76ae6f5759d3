"""The ledger of published numbers as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from malta.report.tables.parts import add_row, new_table

if TYPE_CHECKING:
    from malta.report.ledger import Ledger


def claims_table(ledger: Ledger) -> Table:
    """A row for each published number: the paper's value, that of each design, and the verdict."""
    table = new_table(
        f"Published numbers and ours: {ledger.title}", "claim", "published", *ledger.designs, "verdict"
    )
    table.columns[-1].justify = "left"
    for claim in ledger.claims:
        add_row(table, claim.subject, claim.published, *claim.ours, claim.verdict)
    return table
