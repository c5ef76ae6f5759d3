"""The ledger in a Markdown file: its tables are computed anew where they stand, and nothing else changes.

    ### tubular, S. Miric et al., ...          the machine and its paper: the title of a ledger (or with ##)

    | claim | published | `table2` | ... | verdict |       the designs are those that the header names

A count in a summary in front of the table, as "<summary>52 figures", follows the table.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from malta.errors import InputError
from malta.report.ledger import Ledger

HEADER = re.compile(r"^\| claim \| published \|(?P<designs>.*)\| verdict \|\n", re.MULTILINE)
TITLE = re.compile(r"^###? (?P<machine>\w+), .*\n", re.MULTILINE)
COUNT = re.compile(r"(?<=<summary>)\d+(?= figures)")


class Place(NamedTuple):
    """A table of claims in a text: from `begin`, the end of its title, and `start` to `end`."""

    machine: str
    designs: tuple[str, ...]
    begin: int
    start: int
    end: int


def find_tables(text: str, name: str) -> list[Place]:
    """Find the tables of claims in a text. Raises InputError, naming the file, where there is none."""
    places, titles = [], list(TITLE.finditer(text))
    for header in HEADER.finditer(text):
        above = [title for title in titles if title.end() <= header.start()]
        if not above:
            raise InputError(name, "claims", "a table without a title", '"### MACHINE, SOURCE" above it')
        rest = re.compile(r"(?:\|.*\n)+").match(text, header.start())
        assert rest is not None  # the header is such a line
        designs = tuple(re.findall(r"`(\w+)`", header["designs"]))
        places.append(Place(above[-1]["machine"], designs, above[-1].end(), header.start(), rest.end()))
    if not places:
        raise InputError(name, "claims", "no table", 'a line "| claim | published | `DESIGN` | verdict |"')
    return places


def replace_tables(text: str, ledgers: Sequence[Ledger], name: str) -> str:
    """Put the ledgers, in the order of `find_tables`, in the places of a text's tables."""
    for place, ledger in reversed(list(zip(find_tables(text, name), ledgers, strict=True))):
        between = COUNT.sub(f"{len(ledger.claims)}", text[place.begin : place.start])
        text = text[: place.begin] + between + ledger.markdown() + text[place.end :]
    return text
