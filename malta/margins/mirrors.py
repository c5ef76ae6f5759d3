"""Groups of states whose systems are equal but for signs, as those of the two planes of a round body.

    A' = S A S,  B' = S B U,  C' = Y C S,  E' = S E S        S, U, Y = diag(+-1)

X = C (s E - A)^-1 is then Y X S, and each product det X[S, R] det B[R, T] of minors.py is that of the first group times
the signs in Y of its outputs and those in U of its inputs. The signs are read from the exact entries: numbers that
differ in their last digit make no mirror image.
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


class Image(NamedTuple):
    """A group as the mirror image of the group `of`, and the signs of its inputs and outputs beside that one's."""

    of: Places
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


def first_alike(program: Program, s: Symbolic | None, places: Places) -> Image:
    """A group as an image of the first group of a program's system that it mirrors: of itself when there is none."""
    firsts = _firsts(program)
    if places not in firsts:
        others = [one for one, image in firsts.items() if image.of == one] if s is not None else []
        found = (image for one in others if s is not None and (image := image_of(s, one, places)) is not None)
        alone = Image(places, (1,) * len(places.inputs), (1,) * len(places.outputs))
        firsts[places] = next(found, alone)
    return firsts[places]


@lru_cache(maxsize=64)
def _firsts(program: Program) -> dict[Places, Image]:
    del program
    return {}


def image_of(s: Symbolic, one: Places, two: Places) -> Image | None:
    """The second group as an image of the first; None where they differ, as exact expressions, in more than signs."""
    if one.rows != two.rows or [len(part) for part in one] != [len(part) for part in two]:
        return None
    n, m, related = len(one.states), len(one.inputs), list[tuple[int, int, int]]()
    for which in (k for k in (A, B, C, E) if k < len(s.entries)):
        own, other = one.entries(s, which), two.entries(s, which)
        if own.keys() != other.keys():
            return None
        for (i, j), r in own.items():
            sign = _sign(r, other[i, j])
            related.append((n + m + i if which == C else i, n + j if which == B else j, sign))
    signs = _signs(related, n + m + len(one.outputs))
    return None if signs is None else Image(one, signs[n : n + m], signs[n + m :])


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
