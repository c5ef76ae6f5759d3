"""What is computed once rather than in every lane at every sample, and its place in the arrays c, d and g of C text.

c   once a run, in every lane: depends on theta only
d   once a run for all lanes: depends only on the numbers that they share, those of the controller
g   once a sample for all lanes: depends on these and on the inputs of the sample, as K xi* + v_ff does
"""

from __future__ import annotations

import re
from typing import NamedTuple

from malta.simulation.instructions import Node

PLAIN = (
    "OP_ADD",
    "OP_SUB",
    "OP_MUL",
    "OP_SQ",
    "OP_NEG",
    "OP_TWICE",
)  # the same text for one number and for lanes


class Counts(NamedTuple):
    """Entries of the arrays of what is computed once."""

    c: int = 0
    d: int = 0
    g: int = 0


NONE = Counts()


def counts_of(place: dict[int, str]) -> Counts:
    """How many entries of each array are taken."""
    return Counts(*(sum(entry.startswith(array) for entry in place.values()) for array in "cdg"))


def find_common(nodes: list[Node], used: list[int]) -> set[int]:
    """The nodes that are computed once a sample for all lanes: plain operations on inputs of the sample and numbers
    that the lanes share."""
    found: set[int] = set()
    for k in used:
        node = nodes[k]
        known = all(nodes[a].fixed or not nodes[a].op or a in found for a in node.arguments)
        if node.op in PLAIN and node.common and not node.fixed and known:
            found.add(k)
    return found


def places(
    nodes: list[Node], used: list[int], early: set[int], results: set[int], first: Counts
) -> dict[int, str]:
    """The entries of nodes that are computed once and read later.

    early : the nodes that `find_common` found
    results : of the function
    first : entries before those of this function
    """
    later = [k for k in used if nodes[k].op and not nodes[k].fixed and k not in early]
    read = {a for k in later for a in nodes[k].arguments} | results
    kept = [k for k in used if nodes[k].fixed and nodes[k].op]
    kept = [k for k in kept if k in read or any(k in nodes[reader].arguments for reader in early)]
    members = {
        "c": [k for k in kept if not nodes[k].common],
        "d": [k for k in kept if nodes[k].common],
        "g": [k for k in used if k in early and k in read],
    }
    return {
        k: f"{array}[{start + index}]"
        for (array, chosen), start in zip(members.items(), first, strict=True)
        for index, k in enumerate(chosen)
    }


def foresee(nodes: list[Node], used: list[int], early: set[int], place: dict[int, str]) -> list[str]:
    """Lines that compute the entries of g from the inputs of a sample, in numbers rather than lanes."""

    def text(k: int) -> str:
        if k in early:
            return f"t{k}"
        if nodes[k].op:
            return place[k]
        return re.sub(r"^K\((?:a\d+(\[\d+\])|(.*))\)$", _of_one_lane, nodes[k].form)

    members = [k for k in used if k in early]
    values = [nodes[k].form.format(*map(text, nodes[k].arguments)) for k in members]
    lines = [f"  const double t{k} = {value};" for k, value in zip(members, values, strict=True)]
    return lines + [f"  {place[k]} = t{k};" for k in members if k in place]


def _of_one_lane(found: re.Match[str]) -> str:
    """An input of the sample, or a constant, without its repetition in every lane."""
    return f"given{found[1]}" if found[1] else f"({found[2]})"
