"""The characteristic polynomials of a loop with complex blocks, over a box of parameters.

The entries of blocks are further parameters (`blocks.probe`), and a polynomial is affine in each of them: its values
with some of them at zero and some at -unit give a_S of polydisc.py, for every set S of the blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import acb, arb

from malta.proof.blocks.blocks import Block
from malta.proof.box import Box
from malta.proof.box_parts import PATCHES, cut
from malta.proof.exclusion.exclusion import Growth, growth_over
from malta.proof.families import family_over
from malta.proof.polynomial.family import Family, align, combine

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.problem import OfLoop, Polynomial

Matrix = tuple[tuple[tuple[Family, ...], ...], ...]  # rows x columns of a_{S + ij}


@dataclass(frozen=True, eq=False)
class Part:
    """One group's polynomial over a part of the box, with the terms of the blocks that act on the group.

    scalars: indices of blocks; sets: a_S, S a number whose binary digits say which of the scalars
    full: index of a full block; entries: rows x columns of a_{S + ij}
    """

    growth: Growth
    scale: int
    scalars: tuple[int, ...]
    sets: tuple[Family, ...]
    full: int | None = None
    entries: Matrix = ()


def parts_of(
    problem: OfLoop,
    blocks: Sequence[tuple[Block, list[int]]],
    box: Box,
    reach: float,
    most: Sequence[float],
    until: float,
) -> list[Part]:
    """The groups' polynomials over parts of box(reach).

    blocks : each with the numbers of its entries among the problem's parameters; other entries are zero
    most : the largest size of each block, if it is known; couplings of the size of rounding are then taken as zero and
        bounded

    Raises Unproven when a polynomial cannot be enclosed.
    """
    sides = box.sides(reach)
    known = all(
        math.isfinite(r) and (b.kind != "feedback" or r < 1) for (b, _), r in zip(blocks, most, strict=True)
    )
    p: list[Any] = [arb(low).union(arb(high)) for low, high in sides.tolist()]
    p += [arb(0)] * (len(problem.names) - len(p))
    grown = 1.0
    for (b, pins), r in zip(blocks, most, strict=True):
        if b.kind == "feedback" and known:  # the gain is 1 / (1 - delta), and f times 1 - delta
            r, grown = r / (1 - r), grown * (1 + r)
        disc = arb(0, max(b.unit, r) * (1 + 1e-9)) if known else arb(0, b.unit)
        for i in pins:
            p[i] = acb(disc, disc)
    groups = (problem if known else replace(problem, neglect=False)).parts(p)
    found: list[Part] = []
    owners = _owners([f for f, _ in groups], blocks)
    for (f, moves), acting in zip(groups, owners, strict=True):
        scaled = tuple(arb(grown) * c for c in moves)
        own = [(k, *blocks[k]) for k in acting]
        made = partial(_part, f, moves=scaled, acting=own, box=box, until=until)
        found += cut(sides, box.nominal, until, made, PATCHES - len(found))
    return found


def _owners(groups: Sequence[Polynomial], blocks: Sequence[tuple[Block, list[int]]]) -> list[list[int]]:
    """The blocks on which each group's polynomial may depend; a feedback around no group belongs to the first."""
    found: list[list[int]] = [[] for _ in groups]
    for k, (b, pins) in enumerate(blocks):
        touched = [n for n, f in enumerate(groups) if any(f.degrees[i] != 0 for i in pins)]
        if not touched and b.kind == "feedback":
            touched = [0]
        for n in touched:
            found[n].append(k)
    return found


def _part(
    f: Polynomial,
    sides: FloatArray,
    moves: tuple[Any, ...],
    acting: list[tuple[int, Block, list[int]]],
    box: Box,
    until: float,
) -> list[Part]:
    """The families of one group, from its values with entries at zero and at -unit."""
    known: dict[frozenset[int], Family] = {}
    count = len(f.names) - len(sides)

    def family(at: frozenset[int]) -> Family:
        """The family with the entries `at` (parameters) at -unit and all others at zero."""
        if at not in known:
            fixed = np.zeros((count, 2))
            for _, b, pins in acting:
                for i in pins:
                    fixed[i - len(sides)] = -b.unit if i in at else 0.0
            made = family_over(f, np.vstack([sides, fixed]), () if at else moves, until)
            known[at] = replace(made, shape=made.shape[: len(sides)])  # entries are pinned
        return known[at]

    scalars = [(k, b, pins[0]) for k, b, pins in acting if not b.full]
    full = next(((k, b, pins) for k, b, pins in acting if b.full), None)
    plain = [
        [(b, pin, False) for n, (_, b, pin) in enumerate(scalars) if S >> n & 1]
        for S in range(2 ** len(scalars))
    ]
    sums = [_probe(picked, family) for picked in plain]
    entries: list[list[list[dict[Any, float]]]] = []
    if full is not None:
        _, b, pins = full
        width = len(b.columns)
        entries = [
            [
                [_probe([*picked, (b, pins[i * width + j], i != j)], family) for picked in plain]
                for j in range(width)
            ]
            for i in range(len(b.rows))
        ]
    made = _common(sums, entries, known)
    growth = _widen(growth_over(np.asarray(sides), f.inverted[: len(sides)], box), len(scalars))
    flat = iter(made)
    sets = tuple(next(flat) for _ in sums)
    matrix = tuple(tuple(tuple(next(flat) for _ in plain) for _ in row) for row in entries)
    part = Part(
        growth,
        sets[0].scale,
        tuple(k for k, _, _ in scalars),
        sets,
        None if full is None else full[0],
        matrix,
    )
    return [part]


def _probe(
    picked: list[tuple[Block, int, bool]], family: Callable[[frozenset[int]], Family]
) -> dict[frozenset[int], float]:
    """a_S as a sum of the polynomial's values: weights by which entries are at -unit.

    M_ii f of a feedback is f without the channel, where its gain 1 + delta is zero; all others are
    (f(-unit) - f(0)) / unit. Both follow from f(-unit), as f is affine; at -1 itself f may have coefficients of zero.
    """
    total: dict[frozenset[int], float] = {frozenset(): 1.0}
    for b, pin, beside in picked:
        own = 1.0 if b.kind == "feedback" and not beside else 0.0
        turned: dict[frozenset[int], float] = {}
        for at, weight in total.items():
            turned[at | {pin}] = turned.get(at | {pin}, 0.0) + weight / b.unit
            turned[at] = turned.get(at, 0.0) + weight * (own - 1 / b.unit)
        total = turned
    for at in total:
        family(at)
    return total


def _common(
    sums: list[dict[frozenset[int], float]],
    entries: list[list[list[dict[frozenset[int], float]]]],
    known: dict[frozenset[int], Family],
) -> list[Family]:
    """The weighted sums of families, with equal degrees and scales."""
    base = known[frozenset()]
    for g in known.values():
        base = align(base, g)[0]
    raised = {at: align(base, g)[1] for at, g in known.items()}

    def summed(weights: dict[frozenset[int], float]) -> Family:
        (first, a), *rest = weights.items()
        total = raised[first] if a == 1.0 else combine(raised[first], raised[first], a, 0.0)
        for at, weight in rest:
            total = combine(total, raised[at], 1.0, weight)
        return total

    return [summed(s) for s in [*sums, *(s for row in entries for cell in row for s in cell)]]


def _widen(growth: Growth, phases: int) -> Growth:
    """The growth with the phases of blocks as further axes, which do not grow; phases are in turns."""
    none, one = np.zeros(phases), np.ones(phases)
    return Growth(
        np.append(growth.low, none), np.append(growth.high, one), (*growth.inverted, *[False] * phases),
        np.append(growth.nominal, none), np.append(growth.down, none), np.append(growth.up, none),
    )  # fmt: skip
