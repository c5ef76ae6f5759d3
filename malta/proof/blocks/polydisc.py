"""Proofs that a characteristic polynomial has no zero for complex blocks up to a size, on boxes of parameters.

With M as in `malta.proof.blocks`, f is affine in each of the scalar blocks delta_1 .. delta_K:

    f(delta) = sum over sets S of the blocks: (-1)^|S| delta^S a_S,    a_S = f times the minor of M of S.

It is not zero for all |delta_k| <= r_k if, for every k in turn, with the first k - 1 of them anywhere on the circles
|delta_i| = r_i and the later ones zero,

    |sum_S (-1)^|S| delta^S a_S|  >  r_k |sum_S (-1)^|S| delta^S a_{S + k}|:

by induction the left side has no zero in the polydisc, so that the quotient is largest on its circles. Phases are cut
like parameters. A full block comes last: its critical values have rank one, so that r |a_{S + k}| is r times the
largest singular value of the matrix that its entries give.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from flint import acb, arb

from malta.proof.blocks import Block, Expanded
from malta.proof.box import Box
from malta.proof.exclusion import PATCHES, CellBounds, Growth, advance, cut, growth_over, on_boxes, start
from malta.proof.polynomial.enclosure import ROUGH_TAILS, Polynomial, family_over
from malta.proof.polynomial.family import Family, align, combine
from malta.work import is_past

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.proof.problem import OfLoop


# The characteristic polynomials of a loop with complex blocks, over a box of parameters.
#
# The entries of blocks are further parameters (`blocks.probe`), and a polynomial is affine in each of them: its values
# with some of them at zero and some at -unit give a_S of polydisc.py, for every set S of the blocks.


Matrix = tuple[tuple[tuple[Family, ...], ...], ...]  # rows x columns of a_{S + ij}


@dataclass(frozen=True, eq=False)
class PolydiscPart:
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
    problem: OfLoop, blocks: Sequence[tuple[Block, list[int]]], box: Box, reach: float, most: Sequence[float]
) -> list[PolydiscPart]:
    """The groups' polynomials over parts of box(reach).

    blocks : each with the numbers of its entries among the problem's parameters; other entries are zero
    most : the largest size of each block, if it is known; couplings of the size of rounding are then taken as zero and
        bounded

    Raises Unproven when a polynomial cannot be enclosed; WorkUp within a work_limit.
    """
    sides = box.sides(reach)
    known = all(
        math.isfinite(r) and (b.kind != "feedback" or r < 1) for (b, _), r in zip(blocks, most, strict=True)
    )
    p: list[Any] = [arb(low).union(arb(high)) for low, high in sides.tolist()]
    p += [arb(0)] * (len(problem.loop.system.names) - len(p))
    grown = 1.0
    for (b, pins), r in zip(blocks, most, strict=True):
        if b.kind == "feedback" and known:  # the gain is 1 / (1 - delta), and f times 1 - delta
            r, grown = r / (1 - r), grown * (1 + r)
        disc = arb(0, max(b.unit, r) * (1 + 1e-9)) if known else arb(0, b.unit)
        for i in pins:
            p[i] = acb(disc, disc)
    groups = problem.parts(p, neglect=known)
    found: list[PolydiscPart] = []
    owners = _owners([f for f, _ in groups], blocks)
    for (f, moves), acting in zip(groups, owners, strict=True):
        scaled = tuple(arb(grown) * c for c in moves)
        own = [(k, *blocks[k]) for k in acting]
        made = partial(_part, f, moves=scaled, acting=own, box=box)
        found += cut(sides, box.nominal, made, PATCHES - len(found))
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
) -> list[PolydiscPart]:
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
            made = family_over(f, np.vstack([sides, fixed]), () if at else moves, ROUGH_TAILS)
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
    part = PolydiscPart(
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


MOST_CELLS = 200_000
CIRCLES = 3e-7  # work of each coefficient of each family on a cell
Size = Callable[["FloatArray", int], Expanded]  # of a block, on cells of a scale


def is_zero_free(
    parts: Sequence[PolydiscPart], target: float, sizes: Sequence[Size], until: float
) -> tuple[bool, int]:
    """Whether no polynomial has a zero on box(target) with blocks of these radii, and the number of cells."""
    count = 0
    for part in parts:
        levels = range(max(1, len(part.scalars) + (part.full is not None)))
        for level in levels:
            done, cells = _level(part, level, target, sizes, until)
            count += cells
            if not done:
                return False, count
    return True, count


def _level(
    part: PolydiscPart, level: int, target: float, sizes: Sequence[Size], until: float
) -> tuple[bool, int]:
    """One step of the induction: blocks before `level` on circles, block `level` in its disc, the later ones zero."""
    growth = part.growth
    axes = len(growth.low) - len(part.scalars)
    keep = axes + level
    growth = Growth(
        growth.low[:keep], growth.high[:keep], growth.inverted[:keep],
        growth.nominal[:keep], growth.down[:keep], growth.up[:keep],
    )  # fmt: skip
    search = start(part.sets[0], growth, target if growth.grows.any() else 1.0)
    if part.scalars or part.full is not None:
        search = replace(search, around=_Circles(part, level, axes, sizes).on)
    while not search.finished:
        if search.count > MOST_CELLS or is_past(until):
            return False, search.count
        search = advance(search)
    return True, search.count


@dataclass(frozen=True, eq=False)
class _Circles:
    """f on cells with the blocks before `level` on circles and block `level` in a disc; phases follow `axes`."""

    part: PolydiscPart
    level: int
    axes: int
    sizes: Sequence[Size]

    def on(self, cells: FloatArray, boxes: FloatArray) -> CellBounds:
        part, level = self.part, self.level
        is_past(price=CIRCLES * len(cells) * len(part.sets) * part.sets[0].values.shape[1])
        phases = boxes[:, self.axes :]
        on_circles = [self.sizes[k](cells, part.scale) for k in part.scalars[:level]]
        circle = _circle(on_circles, phases, None)
        f = _sum_over(part.sets[: 2**level], circle, cells, boxes, part.sets[0])
        if level < len(part.scalars):
            k = part.scalars[level]
            matrix: Matrix = ((part.sets[2**level : 2 ** (level + 1)],),)
        else:
            assert part.full is not None
            k, matrix = part.full, part.entries
        within = _circle(on_circles, phases, self.sizes[k](cells, part.scale))
        g = [[_sum_over(families, within, cells, boxes, part.sets[0]) for families in row] for row in matrix]
        discs = f.disc + sum(np.abs(x) for x in f.slopes) + _largest(g)
        moves = [
            2 * (np.abs(x) + sum(np.abs(entry.slopes[n]) for row in g for entry in row)).sum(axis=1)
            for n, x in enumerate(f.slopes)
        ]
        sure = _half_plane(f, g[0][0]) if len(g) == len(g[0]) == 1 else None
        none = np.zeros(len(cells))
        return CellBounds(f.terms, f.radius, none, discs.astype(complex), moves, sure)


def _half_plane(f: _BlockSum, g: _BlockSum) -> ComplexArray:
    """The direction c of f in the middle if Re(conj(c) f) > |g| on the whole cell, else zero.

    All of g lies within an angle e of d, so that |g| <= Re(conj(d) g) / cos(e): the condition is linear in f and g.
    """
    c, d = (x / np.maximum(np.abs(x), 1e-300) for x in (f.terms[0].mean(axis=1), g.terms[0].mean(axis=1)))
    beside = sum(np.abs(x) for x in (*g.terms[1:], *g.slopes)) + g.disc + g.radius[:, None]
    size = np.abs(g.terms[0])
    close = (size > beside).all(axis=1) & np.isfinite(beside).all(axis=1)
    turned = np.abs(np.angle(g.terms[0] * np.conj(d)[:, None]))
    angle = (turned + np.arcsin(np.where(size > beside, beside / np.maximum(size, 1e-300), 1))).max(axis=1)
    close &= angle < 1.2
    rate = (1 + 1e-12) / np.cos(np.where(close, angle, 0))

    def along(x: ComplexArray, y: ComplexArray) -> FloatArray:
        return np.asarray((np.conj(c)[:, None] * x).real - rate[:, None] * (np.conj(d)[:, None] * y).real)

    left = along(f.terms[0], g.terms[0]) - np.abs(along(f.terms[1], g.terms[1]))
    for x, y in zip(f.slopes, g.slopes, strict=True):
        left = left - np.abs(along(x, y))
    for x, y in zip(f.terms[2:], g.terms[2:], strict=True):
        left = left - np.abs(along(x, y))
    rounding = 1e-13 * (np.abs(f.terms[0]) + rate[:, None] * size).max(axis=1)
    left = left - f.disc - rate[:, None] * g.disc - (f.radius + rate * g.radius + rounding)[:, None]
    with np.errstate(invalid="ignore"):
        return np.where(close & (left > 0).all(axis=1), c, 0)


class _Circle(NamedTuple):
    """Products of (-delta) over sets of blocks on circles, on cells; rows are sets, in binary order."""

    value: ComplexArray  # sets x cells: in the middle of the cell
    slope: ComplexArray  # sets x cells: along the cell's frequencies
    rest: FloatArray  # sets x cells: bounds of the error
    spread: FloatArray  # sets x blocks x cells: half the interval of each phase that the set holds, rad


def _circle(sizes: list[Expanded], phases: FloatArray, last: Expanded | None) -> _Circle:
    """The products on cells.

    sizes : of the blocks on circles; phases : cells x blocks x 2, in turns; last : a factor of all sets

    W may replace |W|, because a circle contains every phase.
    """
    cells = len(phases)
    middle = np.exp(1j * math.pi * phases.sum(axis=2))
    arc = math.pi * (phases[:, :, 1] - phases[:, :, 0]) * (1 + 1e-12)
    none = np.zeros(cells)
    found = []
    for S in range(2 ** len(sizes)):
        inside = [n for n in range(len(sizes)) if S >> n & 1]
        value, slope, rest = last or Expanded(none + 1 + 0j, none + 0j, none)
        for n in inside:
            one = sizes[n].times(1.0)
            rest = (
                rest * (np.abs(one.value) + np.abs(one.slope) + one.rest)
                + one.rest * (np.abs(value) + np.abs(slope))
                + np.abs(slope * one.slope)
            )
            turn = -middle[:, n]
            value, slope = turn * value * one.value, turn * (slope * one.value + value * one.slope)
        found.append((value, slope, rest, [arc[:, n] * (n in inside) for n in range(len(sizes))]))
    values, slopes, rests, spreads = zip(*found, strict=True)
    shape = (2 ** len(sizes), len(sizes), cells)
    return _Circle(
        np.array(values), np.array(slopes), np.array(rests) * (1 + 1e-12), np.array(spreads).reshape(shape)
    )


class _BlockSum(NamedTuple):
    """A sum over sets of blocks, on cells: expansions in frequency and in phases, and bounds of their errors."""

    terms: list[ComplexArray]  # in frequency: cells x nodes
    slopes: list[ComplexArray]  # in each phase
    disc: FloatArray  # cells x nodes
    radius: FloatArray  # cells


def _sum_over(
    families: Sequence[Family], circle: _Circle, cells: FloatArray, boxes: FloatArray, like: Family
) -> _BlockSum:
    """The sum, by e^(j x) = 1 + j x + rest, |rest| <= x^2 / 2, x the sum of a set's phases minus their middles."""
    terms: list[Any] = [0.0] * 4
    slopes: list[Any] = [0.0] * circle.spread.shape[1]
    disc: Any = 0.0
    radius: Any = 0.0
    for family, value, slope, left, spread in zip(families, *circle, strict=True):
        found, rest, _ = on_boxes(family, cells, boxes, None if family is like else like)
        high = sum(np.abs(x) for x in found[1:]) + rest[:, None]
        x, steep = spread.sum(axis=0), np.abs(slope)
        size = np.abs(value) + steep + left  # of the factor
        moved = [np.zeros_like(found[0]), *found]
        for m, (y, before) in enumerate(zip(found, moved, strict=False)):
            terms[m] = terms[m] + value[:, None] * y + slope[:, None] * before
        slopes = [m + (1j * value * s)[:, None] * found[0] for m, s in zip(slopes, spread, strict=True)]
        # errors of the products of expansions in frequency, weights and phases
        beyond = size * np.minimum(x**2 / 2, x + 2) + left * (1 + x) + steep * x
        disc = disc + beyond[:, None] * (np.abs(found[0]) + high) + (np.abs(value) * x)[:, None] * high
        disc = disc + steep[:, None] * np.abs(found[-1])
        radius = radius + size * (rest + 1e-14 * (np.abs(found[0]) + high).max(axis=1))  # rounded products
    return _BlockSum(terms, slopes, np.asarray(disc), np.asarray(radius))


def _largest(matrix: list[list[_BlockSum]]) -> FloatArray:
    """An upper bound of the largest singular value of the matrix at each node: cells x nodes."""
    if len(matrix) == len(matrix[0]) == 1:
        (one,) = matrix[0]
        return np.asarray(sum(np.abs(t) for t in (*one.terms, *one.slopes)) + one.disc + one.radius[:, None])
    total: Any = 0.0
    for m in range(4):
        stacked = np.array([[g.terms[m] for g in row] for row in matrix]).transpose(2, 3, 0, 1)
        finite = np.isfinite(stacked).all(axis=(2, 3))
        size = np.linalg.norm(np.where(finite[..., None, None], stacked, 0), ord=2, axis=(2, 3))
        total = total + np.where(finite, size, np.inf) * (1 + 1e-12)
    rest = sum(
        (g.disc + sum(np.abs(x) for x in g.slopes) + g.radius[:, None]) ** 2 for row in matrix for g in row
    )
    return np.asarray(total + np.sqrt(rest), dtype=float)
