"""Groups of states whose systems are equal but for signs of states, as those of the two planes of a round body.

    A' = S A S,  B' = S B,  C' = C S,  E' = S E S        S = diag(+-1)

X = C (s E - A)^-1 is then X S, and each product det X[S, R] det B[R, T] of minors.py is the same in both groups. The
signs are read from the exact entries: numbers that differ in their last digit make no mirror image.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import sparse

from malta.margins.algebra import Ratio, Symbolic
from malta.margins.expressions import Program
from malta.margins.groups import A, B, C, E


class Places(NamedTuple):
    """A group's states, inputs and outputs by their numbers in the loop, and its rows with inputs by their own."""

    states: tuple[int, ...]
    rows: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]

    def entries(self, s: Symbolic, which: int) -> dict[tuple[int, int], Ratio]:
        """The entries of A, B, C or E in the group, by row and column in the group."""
        rows = self.outputs if which == C else self.states
        columns = self.inputs if which == B else self.states
        i_of, j_of = ({place: k for k, place in enumerate(own)} for own in (rows, columns))
        return {
            (i_of[i], j_of[j]): r for (i, j), r in s.entries[which].items() if i in i_of and j in j_of
        }  # fmt: skip


def first_alike(program: Program, s: Symbolic | None, places: Places) -> Places:
    """The first group of a program's system of which this one is a mirror image: itself when there is none."""
    firsts = _firsts(program)
    if places not in firsts:
        mirrored = (
            one for one in firsts if s is not None and firsts[one] == one and is_mirror(s, one, places)
        )
        firsts[places] = next(mirrored, places)
    return firsts[places]


@lru_cache(maxsize=64)
def _firsts(program: Program) -> dict[Places, Places]:
    del program
    return {}


def is_mirror(s: Symbolic, one: Places, two: Places) -> bool:
    """Whether the systems of two groups are equal but for signs of their states, as exact expressions."""
    if one.rows != two.rows or [len(part) for part in one] != [len(part) for part in two]:
        return False
    n, related = len(one.states), list[tuple[int, int, int]]()
    for which in (k for k in (A, B, C, E) if k < len(s.entries)):
        own, other = one.entries(s, which), two.entries(s, which)
        if own.keys() != other.keys():
            return False
        for (i, j), r in own.items():
            sign = _sign(r, other[i, j])
            related.append((n if which == C else i, n if which == B else j, sign))
    return _are_signs(related, n + 1)


def _sign(one: Ratio, two: Ratio) -> int:
    """1 for equal functions, -1 for opposite ones, else 0."""
    if one.den != two.den:
        return 0
    return 1 if one.num == two.num else -1 if one.num == -two.num else 0


def _are_signs(related: list[tuple[int, int, int]], count: int) -> bool:
    """Whether signs s_i = +-1 exist with s_i s_j = sign for each (i, j, sign).

    Each place has two nodes, s_i = 1 and s_i = -1, and a relation joins those that imply each other.
    """
    if not all(sign for *_, sign in related):
        return False
    nodes = [(i, j + (sign < 0) * count) for i, j, sign in related]
    nodes += [(i + count, j + (sign > 0) * count) for i, j, sign in related]
    graph = sparse.coo_array((np.ones(len(nodes)), np.array(nodes).reshape(-1, 2).T), (2 * count,) * 2)
    _, label = sparse.csgraph.connected_components(graph, directed=False)
    return not (label[:count] == label[count:]).any()
