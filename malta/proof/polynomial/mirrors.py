"""Groups of states whose own dynamics are equal but for signs, as those of the two planes of a round body.

    A' = S A S,  E' = S E S        S = diag(+-1)

(s E - A)^-1 of minors.py is then S (s E' - A')^-1 S. The signs are read from the exact entries: numbers that differ in
their last digit make no mirror image.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import sparse

from malta.proof.expressions import Program
from malta.proof.groups import A, E
from malta.proof.polynomial.rational import Ratio, Symbolic


class Places(NamedTuple):
    """A group's states by their numbers in the loop, and its rows with inputs by their own."""

    states: tuple[int, ...]
    rows: tuple[int, ...]

    def entries(self, s: Symbolic, which: int) -> dict[tuple[int, int], Ratio]:
        """The entries of A or E in the group, by row and column in the group."""
        at = {state: k for k, state in enumerate(self.states)}
        return {(at[i], at[j]): r for (i, j), r in s.entries[which].items() if i in at and j in at}


class Image(NamedTuple):
    """A group as the mirror image of the group `of`, and the signs of its states."""

    of: Places
    signs: tuple[int, ...]


def first_alike(program: Program, s: Symbolic | None, places: Places) -> Image:
    """A group as an image of the first group of a program's system that it mirrors: of itself when there is none."""
    firsts = _firsts(program)
    if places not in firsts:
        others = [one for one, image in firsts.items() if image.of == one] if s is not None else []
        found = (image for one in others if s is not None and (image := image_of(s, one, places)) is not None)
        firsts[places] = next(found, Image(places, (1,) * len(places.states)))
    return firsts[places]


@lru_cache(maxsize=64)
def _firsts(program: Program) -> dict[Places, Image]:
    del program
    return {}


def image_of(s: Symbolic, one: Places, two: Places) -> Image | None:
    """The second group as an image of the first; None where they differ, as exact expressions, in more than signs."""
    if one.rows != two.rows or len(one.states) != len(two.states):
        return None
    related = list[tuple[int, int, int]]()
    for which in (k for k in (A, E) if k < len(s.entries)):
        own, other = one.entries(s, which), two.entries(s, which)
        if own.keys() != other.keys():
            return None
        related += [(i, j, _sign(r, other[i, j])) for (i, j), r in own.items()]
    signs = _signs(related, len(one.states))
    return None if signs is None else Image(one, signs)


def _sign(one: Ratio, two: Ratio) -> int:
    """1 for equal functions, -1 for opposite ones, else 0."""
    if one.den != two.den:
        return 0
    return 1 if one.num == two.num else -1 if one.num == -two.num else 0


def _signs(related: list[tuple[int, int, int]], count: int) -> tuple[int, ...] | None:
    """Signs s_i = +-1 with s_i s_j = sign for each (i, j, sign); None where there are none.

    Each place has two nodes, s_i = 1 and s_i = -1, and a relation joins those that imply each other.
    """
    if not all(sign for *_, sign in related):
        return None
    nodes = [(i, j + (sign < 0) * count) for i, j, sign in related]
    nodes += [(i + count, j + (sign > 0) * count) for i, j, sign in related]
    graph = sparse.coo_array((np.ones(len(nodes)), np.array(nodes).reshape(-1, 2).T), (2 * count,) * 2)
    _, label = sparse.csgraph.connected_components(graph, directed=False)
    plus, minus = label[:count], label[count:]
    return None if (plus == minus).any() else tuple(np.where(plus < minus, 1, -1).tolist())
