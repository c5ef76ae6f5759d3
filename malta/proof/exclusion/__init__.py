"""Branch and bound: a characteristic polynomial has no zero at any frequency on the box.

A cell is an interval of frequency and a part of the box. On it f lies in the convex hull of the Bernstein coefficients
of its expansion, widened by radii; where all of that lies in an open half plane Re(conj(c) f) > 0, zero is excluded,
c is the cell's witness. Other cells are split. Cells are taken in the order of the smallest margin t of any point in
them, so that `lower`, the smallest t of a cell that is still open, only grows: it is true whenever a search stops.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.proof.box import Box, smallest_t
from malta.proof.polynomial.enclosure import Polynomial, TooWide, Unproven
from malta.proof.polynomial.family import EPS, Family, restrict, restriction_rounding
from malta.work import is_past

# A family along s = jw: Taylor expansions on intervals of frequency, from zero to infinity.
#
# Branch 0 counts x = w / 2^scale, branch 1 its inverse, where f = a(jw) / (w / 2^scale)^n; so [0, x1] of the one and
# [0, 1 / x1] of the other cover every frequency. On an interval of middle x0 and half width h
#
#     f(x0 + h t) = b_0 + b_1 t + b_2 t^2 + b_3 t^3 + rest,   -1 <= t <= 1
#     |rest| <= sum_k |a_k| C(k, 4) h^4 (x0 + h)^(k - 4)


ORDER = 4


class FrequencyExpansion(NamedTuple):
    """f on intervals of frequency (rows): b_m at the nodes of the family, and a bound of the error."""

    terms: tuple[ComplexArray, ...]  # b_0, b_1, b_2, b_3: cells x nodes
    radius: FloatArray  # cells
    lasting: FloatArray  # cells: the part of the radius that narrower intervals do not reduce


def cover(f: Family) -> FloatArray:
    """Intervals that cover every frequency: rows of branch, from, to."""
    size = f.size()
    with np.errstate(divide="ignore"):
        top = np.where(size > 0, np.log2(np.where(size > 0, size, 1)), -np.inf) + np.array(f.exponents)
    k = np.arange(len(top))
    if f.degree == 0:
        return np.array([[0, 0, 1.0], [1, 0, 1.0]])
    ends = []
    for reverse in (False, True):
        t = top[::-1] if reverse else top
        ends.append(float(((t[0] - t[1:]) / k[1:]).min()) if np.isfinite(t[0]) else 0.0)
    low, high = int(np.floor(min(ends[0], 0))) - 1, int(np.ceil(max(-ends[1], 0))) + 1
    edges = 2.0 ** np.arange(low, high + 1)
    cells = [[0, 0, edges[0]], *([0, a, b] for a, b in pairwise(edges))]
    return np.array([*cells, [1, 0, 1 / edges[-1]]])


def expand(f: Family, cells: FloatArray, like: Family | None = None) -> FrequencyExpansion:
    """The expansions on intervals (rows of branch, from, to), each on a scale of its own, or on those of `like`."""
    n = f.degree
    high = cells[:, 0] == 1
    x0, h = (cells[:, 2] + cells[:, 1]) / 2, (cells[:, 2] - cells[:, 1]) / 2
    end = np.maximum(cells[:, 2], np.nextafter(x0 + h, np.inf))
    k = np.arange(n + 1)
    power = np.where(high[:, None], n - k, k)  # of x in term k
    size = f.size()
    m_end, e_end = np.frexp(end)
    tops = power * e_end[:, None] + np.array(f.exponents)
    shift = _shifts(like or f, power, m_end, e_end)
    scaled = np.maximum(tops - shift[:, None], -1000)  # terms that overflow exclude nothing
    # terms C(k, m) x0^(k - m) h^m = end^k C(k, m) (x0 / end)^(k - m) (h / end)^m
    whole = np.ldexp(m_end[:, None] ** power, scaled)
    share, step = (x0 / end)[:, None], (h / end)[:, None]
    terms = []
    turn = 1j ** (k % 4)
    for m in range(ORDER):
        weight = whole * _binomial(power, m) * share ** np.maximum(power - m, 0) * step**m
        weight = np.where(power >= m, weight, 0)
        terms.append(_product(weight, turn, f.values))
    rest = whole * _binomial(power, ORDER) * step**ORDER
    # a term takes powers of end, share and step, 3 products and a binomial: 2 n + 8 digits; the sum of n + 1 terms as
    # many, its restriction to parts of the box more; terms of one k add up to |a_k| end^k over all m at most
    rounding = whole * ((4 * n + 32) * EPS + restriction_rounding(f.shape))
    lasting = rounding @ size + whole @ f.radius * (1 + 1e-9)
    radius = rest @ size * (1 + 1e-9) + lasting
    return FrequencyExpansion(tuple(terms), radius + 1e-290, lasting)


def _shifts(f: Family, power: FloatArray, m_end: FloatArray, e_end: FloatArray) -> FloatArray:
    """log2 of the largest term on each interval."""
    size, tops = f.size(), power * e_end[:, None] + np.array(f.exponents)
    with np.errstate(divide="ignore"):
        heights = tops + np.log2(np.maximum(size, 1e-300)) + power * np.log2(m_end)[:, None]
    return np.asarray(np.round(np.where(size > 0, heights, -np.inf).max(axis=1)).astype(int))


def _binomial(n: FloatArray, m: int) -> FloatArray:
    found = np.ones(n.shape)
    for i in range(m):
        found = found * np.maximum(n - i, 0) / (i + 1)
    return found


def _product(weight: FloatArray, turn: ComplexArray, values: FloatArray) -> ComplexArray:
    """sum_k weight_k j^k a_k: even k are real, odd ones imaginary."""
    real, imag = weight * turn.real, weight * turn.imag
    return (real[:, ::2] @ values[::2]) + 1j * (imag[:, 1::2] @ values[1::2])


GUARD = 1e-9  # rad that a half plane must have to spare
BATCH = 1024
CALL, CELL, NODE = 1.2e-3, 5e-6, 5e-7  # work of a batch, of each cell, and of each coefficient on it
MIN_INTERVAL_WIDTH = 1e-4  # of an interval of frequency, whose expansion leaves out less than rounding
ROUNDING_VARIATION = 0.1  # variation of f on a cell, in radii, below which smaller cells exclude no more
FEW_CELLS, MANY_CELLS = 24, 96  # cells up to which they are cut thrice, and twice, at once
MAX_EXTRA_SPLITS = 14  # splits beyond the first of a cell that holds a candidate for the witness


@dataclass(frozen=True, eq=False)
class Growth:
    """The map between u in [0, 1]^P and the boxes that grow with t: nominal - t down <= p <= nominal + t up.

    p = v or 1 / v (inverted), v = low + (high - low) u. Axes with neither down nor up do not grow.

    Rounding moves p by EPS (|p| + high - low) and t down by EPS (|p| + |nominal|) or less. A box may be as narrow as a
    few digits of its parameters, so that sides and t are bounded with these budgets.
    """

    low: FloatArray
    high: FloatArray
    inverted: tuple[bool, ...]
    nominal: FloatArray
    down: FloatArray
    up: FloatArray

    @property
    def grows(self) -> FloatArray:
        return np.asarray(self.down + self.up > 0)

    def parameters(self, u: FloatArray) -> FloatArray:
        """p at u: ... x P."""
        v = self.low + (self.high - self.low) * u
        return np.asarray(np.where(self.inverted, 1 / np.where(self.inverted, v, 1), v))

    def slopes(self, u: FloatArray) -> FloatArray:
        """dp / du at u: P."""
        v = self.low + (self.high - self.low) * u
        return np.asarray(
            (self.high - self.low) * np.where(self.inverted, -1 / np.where(self.inverted, v, 1) ** 2, 1)
        )

    def shares(self, p: FloatArray) -> FloatArray:
        """u at p, within the box."""
        v = np.where(self.inverted, 1 / np.where(self.inverted, p, 1), p)
        width = np.where(self.high > self.low, self.high - self.low, 1)
        return np.asarray(np.clip(np.where(self.high > self.low, (v - self.low) / width, 0.5), 0, 1))

    @cached_property
    def _rounding(self) -> FloatArray:
        """A bound of the error of p at u, and of 1 / p where inverted."""
        largest = np.maximum(np.abs(self.low), np.abs(self.high))
        return np.asarray(EPS * (largest + (self.high - self.low)))

    def inside(self, t: float) -> FloatArray:
        """The sides of box(t) in u, not too small for any rounding, clipped to [0, 1]: P x 2."""
        with np.errstate(all="ignore"):
            ends = np.array([self.nominal - t * self.down, self.nominal + t * self.up])
            wide = ends + 2 * EPS * (np.abs(self.nominal) + np.abs(ends)) * np.array([[-1], [1]])
            divides = self.inverted & (wide[0] * wide[1] <= 0)
            width = np.where(self.high > self.low, self.high - self.low, 1)
            slack = 1e-9 + 2 * self._rounding / width
            sides = np.sort([self.shares(p) for p in wide], axis=0).T + slack[:, None] * np.array([-1, 1])
        known = self.grows & ~divides & np.isfinite(sides).all(axis=1) & np.isfinite(t)
        return np.asarray(np.clip(np.where(known[:, None], sides, [0.0, 1.0]), 0, 1))

    def margin(self, p: FloatArray) -> FloatArray:
        """The smallest t with p in box(t): ... -> ..."""
        return smallest_t(p, self.nominal, self.down, self.up)

    def smallest(self, boxes: FloatArray) -> FloatArray:
        """The smallest t of any point of each box (cells x P x 2), not too large for any rounding."""
        a, b = self.parameters(boxes[..., 0]), self.parameters(boxes[..., 1])
        low, high = np.minimum(a, b), np.maximum(a, b)
        largest = np.maximum(np.abs(low), np.abs(high))
        share = largest * self._rounding  # of 1 / v: |1 / (v - r) - 1 / v| <= 2 r / v^2 for r <= |v| / 2
        moved = np.where(self.inverted, np.where(share < 0.5, 2 * share * largest, np.inf), self._rounding)
        moved = moved + EPS * largest
        low, high = low - moved, high + moved
        return self.margin(np.clip(self.nominal, low, high)) * (1 - 2 * EPS)


def growth_over(sides: FloatArray, inverted: tuple[bool, ...], box: Box) -> Growth:
    """The growth of a box in the coordinates of a part of it with these sides of p (P x 2)."""
    low, high = sides[:, 0], sides[:, 1]
    v_low = np.where(inverted, 1 / np.where(inverted, high, 1), low)
    v_high = np.where(inverted, 1 / np.where(inverted, low, 1), high)
    return Growth(v_low, v_high, inverted, box.nominal, box.down, box.up)


@dataclass(frozen=True, eq=False)
class OpenCell:
    """A cell from which zero is not excluded: an interval of frequency and a part of the box."""

    branch: int
    interval: tuple[float, float]
    box: FloatArray  # P x 2
    smallest: float


class CellBounds(NamedTuple):
    """f on cells with more than its family: expansions, discs around them, and terms of further axes."""

    terms: list[ComplexArray]
    radius: FloatArray
    lasting: FloatArray  # what of the radius narrower intervals of frequency leave
    discs: ComplexArray  # cells x nodes
    moves: list[FloatArray]
    sure: ComplexArray | None = None  # directions of cells that are excluded for other reasons, else zero


@dataclass(frozen=True, eq=False)
class CellSearch:
    """Open and finished cells of one family. `lower`: zero is excluded on every box(t) with t below it."""

    family: Family
    growth: Growth
    cells: FloatArray
    boxes: FloatArray
    smallest: FloatArray
    depth: FloatArray
    target: float
    count: int = 0
    around: Callable[[FloatArray, FloatArray], CellBounds] | None = None  # f by more than its family
    hasty: bool = False  # whether few cells are cut several times at once
    # the smallest t of a cell that no splitting frees of zero, as the radius is larger than f
    blocked: float = np.inf
    done: tuple[tuple[FloatArray, FloatArray, ComplexArray], ...] = ()

    @property
    def lower(self) -> float:
        return float(min(self.smallest.min(initial=np.inf), self.target))

    @property
    def finished(self) -> bool:
        return not (self.smallest < self.target).any()

    def excluded_cells(self, axes: int) -> tuple[FloatArray, FloatArray, ComplexArray]:
        """Cells from which zero is excluded: intervals, boxes, directions."""
        if not self.done:
            return np.zeros((0, 3)), np.zeros((0, axes, 2)), np.zeros(0, dtype=complex)
        cells, boxes, c = zip(*self.done, strict=True)
        return np.vstack(cells), np.vstack(boxes), np.concatenate(c)

    def first(self) -> OpenCell | None:
        """The open cell of smallest t."""
        if not len(self.cells):
            return None
        return self._cell(int(self.smallest.argmin()))

    def _cell(self, k: int) -> OpenCell:
        b, lo, hi = self.cells[k]
        return OpenCell(int(b), (float(lo), float(hi)), self.boxes[k], float(self.smallest[k]))

    def hardest(self) -> OpenCell | None:
        """The open cell of smallest t that was split most often, if further splits seem useless."""
        stuck = (self.depth >= MAX_EXTRA_SPLITS) & (self.smallest < self.target)
        if not stuck.any():
            return None
        return self._cell(int(np.lexsort((-self.depth, np.where(stuck, self.smallest, np.inf)))[0]))


def start(family: Family, growth: Growth, target: float, until: float = np.inf) -> CellSearch:
    """A search up to `target`, which may later rise to `until`."""
    cells = cover(family)
    boxes = np.tile(growth.inside(max(target, until)), (len(cells), 1, 1))
    zero = np.zeros(len(cells))
    return CellSearch(family, growth, cells, boxes, growth.smallest(boxes), zero, target)


def advance(s: CellSearch) -> CellSearch:
    """The search after a batch of open cells of the smallest t: zero is excluded from them, or they are split."""
    batch = s.smallest < s.target
    if not batch.any():
        return s
    most = max(16, min(BATCH, 4_000_000 // max(1, s.family.values.shape[1] * 8)))
    if batch.sum() > most:
        order = np.argpartition(s.smallest, most)
        batch = np.zeros(len(s.cells), dtype=bool)
        batch[order[:most]] = True
    cells, boxes, depth = s.cells[batch], s.boxes[batch], s.depth[batch]
    is_past(price=CALL + CELL * len(cells) + NODE * len(cells) * s.family.values.shape[1])
    found = _expand(s, cells, boxes)
    terms, radius = found.terms, found.radius
    c = half_plane([*terms, found.discs], radius)
    if found.sure is not None:
        c = np.where(c == 0, found.sure, c)
    good = c != 0
    s = replace(
        s,
        cells=s.cells[~batch],
        boxes=s.boxes[~batch],
        smallest=s.smallest[~batch],
        depth=s.depth[~batch],
        count=s.count + len(cells),
        done=(*s.done, (cells[good], boxes[good], c[good])) if good.any() else s.done,
    )
    bad = ~good
    if bad.any():
        narrow = (
            cells[:, 2] - cells[:, 1] < MIN_INTERVAL_WIDTH * cells[:, 2]
        )  # the radius is not the expansion's
        spread = _spread(terms)
        hopeless = bad & (
            narrow & (spread < ROUNDING_VARIATION * radius)
            | (spread < ROUNDING_VARIATION * found.discs.real.max(axis=1))
        )
        blocked = min(s.blocked, float(s.growth.smallest(boxes[hopeless]).min(initial=np.inf)))
        moves = [m[bad] for m in found.moves]
        kept = CellBounds([t[bad] for t in terms], radius[bad], found.lasting[bad], found.discs[bad], moves)
        s = _split(replace(s, blocked=blocked), cells[bad], boxes[bad], depth[bad], kept)
    return s


def _spread(terms: list[ComplexArray]) -> FloatArray:
    """The approximate variation of f on each cell."""
    b0 = terms[0]
    return np.asarray(np.abs(b0 - b0[:, :1]).max(axis=1) + sum(np.abs(t).max(axis=1) for t in terms[1:]))


def on_boxes(
    f: Family, cells: FloatArray, boxes: FloatArray, like: Family | None = None
) -> FrequencyExpansion:
    """The expansion of each cell with its coefficients over the cell's own box."""
    # An interval and its branch as one number: ends are not negative.
    ends = (cells[:, 1] + 1j * cells[:, 2]) * (1 - 2 * cells[:, 0])
    _, first, index = np.unique(ends, return_index=True, return_inverse=True)
    with np.errstate(over="ignore", invalid="ignore"):
        e: FrequencyExpansion = expand(f, cells[first], like)
        count = len(e.terms)
        together = np.stack(e.terms, axis=1)[index].reshape(len(index), -1)  # one more axis, which is not cut
        whole = np.concatenate([np.broadcast_to([0.0, 1.0], (len(index), 1, 2)), boxes], axis=1)
        cut = restrict(together, (count, *f.shape), whole).reshape(len(index), count, -1)
    return FrequencyExpansion(tuple(np.moveaxis(cut, 1, 0)), e.radius[index], e.lasting[index])


def _expand(s: CellSearch, cells: FloatArray, boxes: FloatArray) -> CellBounds:
    if s.around is not None:
        return s.around(cells, boxes)
    e = on_boxes(s.family, cells, boxes)
    return CellBounds(list(e.terms), e.radius, e.lasting, np.zeros((len(cells), 1), dtype=complex), [])


def half_plane(terms: list[ComplexArray], radius: FloatArray) -> ComplexArray:
    """c of unit size with Re(conj(c) f) > 0 on the cell; zero when none was found.

    Rounding: a disc that takes nearly half the plane lets all centres be nearly parallel, so that |b_1| < |b_0| and a
    centre's size is below 2 |b_0|; then 1e-14 |b_0| is more than the rounding of size and radius, the half angle is not
    too small for it although arcsin is steep at one, and other angles are off by a few units of 1e-16, far below GUARD.
    """
    b0, b1 = terms[:2]
    beside = (
        radius[:, None] + sum(np.abs(b) for b in terms[2:]) + 1e-14 * np.abs(b0).max(axis=1, keepdims=True)
    )
    points = np.concatenate([b0 - b1, b0 + b1], axis=1)
    radii = np.concatenate([beside, beside], axis=1)
    size = np.abs(points)
    fine = np.isfinite(radii).all(axis=1) & (size > radii).all(axis=1)
    c = np.zeros(len(points), dtype=complex)
    if not fine.any():
        return c
    points, radii, size = points[fine], radii[fine], size[fine]
    middle = (points / size).mean(axis=1, keepdims=True)
    middle = np.where(np.abs(middle) > 1e-3, middle / np.maximum(np.abs(middle), 1e-3), 1)
    angle = np.angle(points * np.conj(middle))
    half = np.arcsin(radii / size)
    high, low = (angle + half).max(axis=1), (angle - half).min(axis=1)
    c[fine] = np.where(high - low < np.pi - GUARD, np.exp(0.5j * (high + low)) * middle[:, 0], 0)
    c[fine] = np.where(np.abs(c[fine]) > 0, c[fine] / np.maximum(np.abs(c[fine]), 0.5), 0)
    return c


def _split(
    s: CellSearch, cells: FloatArray, boxes: FloatArray, depth: FloatArray, found: CellBounds
) -> CellSearch:
    """Split each cell in two across the axis that moves f most: frequency, a parameter or a further axis."""
    shape, terms, radius = s.family.shape, found.terms, found.radius
    count = terms[0].shape[1]
    width = np.abs(terms[1]).sum(axis=1) + sum(2 * np.abs(t).sum(axis=1) for t in terms[2:])
    width = width + 2 * np.maximum(radius - found.lasting, 0) * count
    moves = [np.where(np.isfinite(width), width, np.inf)]
    values = terms[0].reshape(-1, *shape)
    for axis, size in enumerate(shape):
        if size == 1:
            moves.append(np.zeros(len(cells)))
            continue
        ends = np.take(values, size - 1, axis=axis + 1) - np.take(values, 0, axis=axis + 1)
        inner = np.abs(np.diff(values, axis=axis + 1)).reshape(len(cells), -1).sum(axis=1) * (
            1.0 if size > 2 else 0
        )
        moves.append(
            0.5 * np.maximum(np.abs(ends).reshape(len(cells), -1).sum(axis=1) * size, inner * size / 2)
        )
    moves += [np.where(np.isfinite(m), m, 0.0) for m in found.moves]
    sizes = np.array(moves)
    for _ in range(_rounds(len(cells)) if s.hasty else 1):
        choice, k = np.argmax(sizes, axis=0), np.arange(len(cells))
        middles = np.concatenate([cells[:, 1:].mean(axis=1)[None], _middles(boxes, s.growth)])[choice, k]
        sizes[choice, k] /= 2
        wide, far = choice == 0, (k[choice > 0], choice[choice > 0] - 1)
        halves = []
        for side in (0, 1):
            c, b = cells.copy(), boxes.copy()
            c[wide, 2 - side] = middles[wide]
            b[far[0], far[1], 1 - side] = middles[~wide]
            halves.append((c, b))
        cells, boxes = (np.vstack(pair) for pair in zip(*halves, strict=True))
        sizes, depth = np.hstack([sizes, sizes]), np.tile(depth + 1, 2)
    return replace(
        s,
        cells=np.vstack([s.cells, cells]),
        boxes=np.vstack([s.boxes, boxes]),
        smallest=np.concatenate([s.smallest, s.growth.smallest(boxes)]),
        depth=np.concatenate([s.depth, depth]),
    )


def _rounds(count: int) -> int:
    """The number of cuts at once: a few cells take as much time as one."""
    return 1 if count > MANY_CELLS else 2 if count > FEW_CELLS else 3


def _middles(boxes: FloatArray, growth: Growth) -> FloatArray:
    """The places of splits (axes x cells): first the nominal value, as parts beside it need no proof at small t."""
    low, high = boxes[..., 0], boxes[..., 1]
    c = growth.shares(growth.nominal)
    inside = (low < c) & (c < high) & (high - low == (high - low).max(axis=0)) & growth.grows
    return np.asarray(np.where(inside, c, (low + high) / 2).T)


# Parts of a box with the characteristic polynomials on them; equal ones are proven once.


PATCHES = 64  # parts of a box at most


@dataclass(frozen=True, eq=False)
class BoxPart:
    """One characteristic polynomial on one part of the box."""

    of: Polynomial
    sides: FloatArray
    family: Family
    growth: Growth
    # the family with its coupling to other groups, on cells and boxes:
    around: Callable[[FloatArray, FloatArray], CellBounds] | None = None


def cut(
    sides: FloatArray, nominal: FloatArray, made: Callable[[FloatArray], list[Any]], most: int = PATCHES
) -> list[Any]:
    """Apply `made` to a box, or to parts of it where the box is too wide; `most` parts at most.

    Raises Unproven when the parts are too many, and what `made` raises.
    """
    todo, found = [sides], list[Any]()
    while todo:
        own = todo.pop()
        try:
            found += made(own)
        except TooWide as error:
            if len(todo) + len(found) >= most:
                raise Unproven(str(error)) from error
            todo += _halves(own, error.axis, float(nominal[error.axis]))
    return found


def _halves(sides: FloatArray, axis: int, nominal: float) -> list[FloatArray]:
    """The halves of a box across one axis, cut at the nominal value if that is well inside."""
    low, high = sides[axis]
    at = (
        nominal
        if low < nominal < high and min(nominal - low, high - nominal) > 0.2 * (high - low)
        else (low + high) / 2
    )
    found = []
    for a, b in ((low, at), (at, high)):
        half = sides.copy()
        half[axis] = a, b
        found.append(half)
    return found


def merge_twins(parts: list[BoxPart]) -> list[BoxPart]:
    """Merge groups whose coefficients agree to rounding, as those of the two planes of a round body."""
    kept: list[BoxPart] = []
    for part in parts:
        for k, other in enumerate(kept):
            both = _merge(other, part)
            if both is not None:
                kept[k] = both
                break
        else:
            kept.append(part)
    return kept


def _merge(one: BoxPart, two: BoxPart) -> BoxPart | None:
    """A part whose radius covers both families; None when they differ by more than rounding."""
    f, g = one.family, two.family
    if one.around is not None or two.around is not None:
        return None
    if (f.shape, f.exponents, f.scale) != (
        g.shape,
        g.exponents,
        g.scale,
    ) or one.of.inverted != two.of.inverted:
        return None
    if not np.array_equal(one.sides, two.sides):
        return None
    apart = np.abs(f.values - g.values).max(axis=1)
    if not (apart <= 1e-9 * f.size()).all():
        return None
    radius = np.maximum(f.radius, g.radius + apart * (1 + 1e-9))
    return BoxPart(one.of, one.sides, Family(f.shape, f.values, radius, f.exponents, f.scale), one.growth)
