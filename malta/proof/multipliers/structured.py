"""Margins of many parameters: a loop's pencil is not singular, shown by multipliers, cell by cell.

A cell is an interval of frequency and a part of box(t). Where multipliers show that no parameters of it reach the
boundary of stability there it is done; else it is split, across frequency where they do in its middle, across the
parameter that matters most where they do not. Multipliers take real parameters as they are, all at once: their effort
grows as a power of the number of parameters, not exponentially, and a box is seldom split at all. Along frequency the
multipliers of one interval are continued to the next, by their slopes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg

from malta.linear.rational import TooLarge
from malta.linear.sampling import split_delay
from malta.proof.groups import UncertainLoop, groups
from malta.proof.multipliers import BlockSizes, Branch, Multiplier, excludes_zero, multiplier, response
from malta.proof.multipliers.pencil import TERMS, Pencil, Rows
from malta.work import is_past, spend, work_done

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.proof.box import Box
    from malta.proof.problem import Problem

SPLIT_BETA = 0.98  # beta up to which splitting frequency is expected to do
MIN_INTERVAL = 1e-9  # of an interval of frequency, relative; of a part of a box, in sides of box(1)
FIRST_INTERVAL_END = 1e-5  # end of the one from zero, relative to the octave that it was cut from
MAX_KEPT_PENCILS = 64  # pencils
MAX_PENCIL_ROWS = 40  # rows of a group's pencil, beyond which families of its smaller groups are cheaper
FIRST_BETA_TOLERANCE = 0.1  # how close the first beta is to the smallest, relative
MIN_BOX_SHARE = 1e-6  # of the target: boxes below that are not tried
FIRST_STEP, LAST_STEP = 1.2, 1.003  # from one box to the next
DIRECT_BOX_FACTOR = 1.3  # times what stands: boxes up to that are tried at once
INTERVAL_GROWTH = 1.3  # the next interval of frequency than the last one
HASTY_WIDTH_SHARE = 0.4  # of the last interval's width: a failure from there on means that it was too wide
PATIENCE = 0.4  # share of the work that is left for one box
LEVEL = 3.5e-6  # work of a cell beside Newton steps, times the square of its rows


@dataclass(frozen=True, eq=False)
class MultiplierCell:
    """An interval of frequency of a branch, and a part of the box, with a multiplier to begin with."""

    rows: int
    sides: FloatArray
    branch: int
    low: float
    high: float
    top: float  # end of the interval that rows and columns are scaled for
    near: Multiplier | None = None


class Shown(NamedTuple):
    """A cell of a proof and the multiplier that excludes it; None where it lies in the layer before, or is empty."""

    cell: MultiplierCell
    multiplier: Multiplier | None


class Layer(NamedTuple):
    """The cells that tile all frequencies x box(t)."""

    t: float
    cells: tuple[Shown, ...]


@dataclass(frozen=True, eq=False)
class MultiplierProof:
    """A proof by multipliers, which `multipliers.checked.refusal` checks again: boxes, the smallest first."""

    rows: tuple[Rows, ...]
    box: Box
    layers: tuple[Layer, ...]


class CellsResult(NamedTuple):
    """The result for cells: beta of one that was not excluded, if any, and the cells left when the work was up."""

    beta: float
    cell: MultiplierCell | None
    left: list[MultiplierCell]


class FrequencyStep(NamedTuple):
    """The width of the next interval of frequency on a part of the box, relative to its end."""

    sides: FloatArray | None = None
    share: float = math.inf
    good: float = math.inf  # width of the last excluded interval

    def hasty(self, cell: MultiplierCell) -> bool:
        """Whether the interval is about as wide as an excluded neighbour, so that a narrower one will be excluded."""
        wide = cell.high - cell.low > HASTY_WIDTH_SHARE * self.good * cell.high
        return cell.sides is self.sides and cell.low > 0 and wide

    def cut(self, cell: MultiplierCell) -> tuple[MultiplierCell, list[MultiplierCell]]:
        """The first part of the cell of that width, and the rest, if any."""
        width = self.share * cell.high
        if cell.sides is not self.sides or cell.low == 0 or not cell.low + 1.2 * width < cell.high:
            return cell, []
        return replace(cell, high=cell.low + width), [replace(cell, low=cell.low + width)]

    def after(self, cell: MultiplierCell, done: bool) -> FrequencyStep:
        if not cell.low:
            return self
        share = (cell.high - cell.low) / cell.high
        good = share if done else self.good if cell.sides is self.sides else math.inf
        return FrequencyStep(cell.sides, (INTERVAL_GROWTH if done else 0.5) * share, good)


@dataclass(eq=False)
class Structured:
    """The groups of loops, and the largest t for which box(t) is proven as stable as the nominal values.

    It changes in place: work that is up may end any step of it, and what was proven before then stands.
    """

    rows: list[Rows]
    box: Box
    most: int = 1_000_000  # cells
    lower: float = 0.0
    count: int = 0
    layers: list[Layer] = field(default_factory=list, repr=False)
    _shown: dict[float, list[Shown]] = field(default_factory=dict, repr=False)  # by t of begun boxes
    _order: list[MultiplierCell] = field(default_factory=list, repr=False)  # those that resist first
    # t of the largest box that was begun, and its cells that are left
    _open: tuple[float, list[MultiplierCell]] | None = None
    _branches: dict[Any, tuple[Pencil | None, dict[Any, Branch]]] = field(default_factory=dict, repr=False)

    def _is_late(self, until: float) -> bool:
        return is_past(until) or self.count >= self.most

    def raise_bound(
        self, target: float, until: float = math.inf, report: Callable[[float], object] = lambda _: None
    ) -> float:
        """Prove box(target), or smaller boxes when that takes too long; a further call continues the work.

        until : of the work, at which it ends; report : called with each t that is proven

        Raises WorkUp within a work_limit.
        """
        if not self.lower:
            self._order = self._prove_whole(target, until, report)
        t, begun = self._next(target), self._open
        while self.lower < t and (t == target or t > LAST_STEP * self.lower) and not self._is_late(until):
            if begun is not None and self.lower < begun[0] <= target:
                t, cells = begun
            else:
                cells = self._begin(self._order or self.cover(t), t)
            begun, now = None, work_done()
            found = self._prove(cells, now + PATIENCE * (until - now), self._shown[t], split=True)
            if found.cell is None:
                self._raise_to(t, report)
                t = self._next(target)
            elif not self.lower:
                break
            else:
                if found.left and (self._open is None or t >= self._open[0]):
                    self._open = t, found.left
                t = math.sqrt(t * self.lower)
        return self.lower

    def _next(self, target: float) -> float:
        """The next box to be tried: the target if it is near, else one a little larger than the proven one."""
        if not self.lower:
            return target / 64
        return target if target <= DIRECT_BOX_FACTOR * self.lower else FIRST_STEP * self.lower

    def _raise_to(self, t: float, report: Callable[[float], object]) -> None:
        if t > self.lower:
            self.lower = t
            self.layers.append(Layer(t, tuple(self._shown.pop(t))))
        report(self.lower)

    def proof(self) -> MultiplierProof:
        """What shows that box(lower) is stable when the nominal loop is."""
        return MultiplierProof(tuple(self.rows), self.box, tuple(self.layers))

    def _begin(self, cells: list[MultiplierCell], t: float) -> list[MultiplierCell]:
        """The cells on box(t), of which none is shown yet."""
        kept = self._open[0] if self._open is not None else t
        self._shown = {u: shown for u, shown in self._shown.items() if u == kept} | {t: []}
        sides = self.box.sides(t)
        return [replace(cell, sides=sides) for cell in cells]

    def _prove_whole(
        self, target: float, until: float, report: Callable[[float], object]
    ) -> list[MultiplierCell]:
        """Prove the largest box possible without a cut, and return the cells of all frequencies, the hardest first."""
        t, (beta, cells) = target, self._survey(target, until)
        while not cells and not self._is_late(until) and t > MIN_BOX_SHARE * target:
            t /= 2
            beta, cells = self._survey(t, until)
        t *= min(1.0, 0.95 / max(beta, 1e-9)) if math.isfinite(beta) else 0.1
        now = work_done()
        last = now + 0.7 * (until - now)
        while cells and not self._is_late(last) and t > MIN_BOX_SHARE * target:
            found = self._prove(self._begin(cells, t), last, self._shown[t], split=False)
            if found.cell is None:
                self._raise_to(t, report)
                break
            cells = _first(cells, found.cell)
            t *= min(0.9, max(0.9 / found.beta, 0.6))
        return cells

    def _survey(self, t: float, until: float) -> tuple[float, list[MultiplierCell]]:
        """The largest beta on box(t) at a grid of frequencies, and the cells by falling beta; none: t is too large."""
        found, near = [], None
        for cell in self.cover(t):
            for part in [cell] if cell.low == 0 else across_frequency(cell):
                spend(LEVEL * self.rows[cell.rows].size ** 2)
                own = self._branch(part)
                if own is None:
                    return math.inf, []
                at = math.sqrt(part.low * part.high) if part.low else part.high / 2
                r, beta = response(own, at, at), math.inf
                if r is not None and own.channels[0].blocks.real and not self._is_late(until):
                    try:
                        # slopes alone: higher terms are slow, and matter in large boxes only
                        blocks = BlockSizes(own.channels[0].blocks.real)
                        N = r.terms[0][: blocks.size, : blocks.size]
                        near, beta = multiplier(N, blocks, near, 0.0, FIRST_BETA_TOLERANCE)
                    except (np.linalg.LinAlgError, ValueError):
                        near = None
                found.append((beta, replace(part, near=near)))
        found.sort(key=lambda pair: -pair[0])
        return max((beta for beta, _ in found if math.isfinite(beta)), default=math.inf), [
            c for _, c in found
        ]

    def _prove(
        self, cells: list[MultiplierCell], last: float, shown: list[Shown], *, split: bool
    ) -> CellsResult:
        """Exclude all cells in order of frequency, by intervals as wide as the last excluded ones, into `shown`."""
        todo, step = list(reversed(cells)), FrequencyStep()
        inner = self.box.sides(self.lower) if self.lower else None
        while todo:
            cell = todo.pop()
            if self._is_late(last):
                return CellsResult(math.inf, cell, [cell, *reversed(todo)])
            if inner is not None and split and _within(cell.sides, inner):
                shown.append(Shown(replace(cell, near=None), None))
                continue
            cell, rest = step.cut(cell)
            todo += rest
            beta, m, done = self._level(cell, hasty=step.hasty(cell))
            if done:
                shown.append(Shown(replace(cell, near=None), m))
                step = step.after(cell, True)
                if todo and (todo[-1].near is None or _is_next(cell, todo[-1])):
                    todo[-1] = replace(todo[-1], near=m)
            elif beta < SPLIT_BETA:
                if (
                    cell.high - cell.low < MIN_INTERVAL * cell.high
                    or cell.high < FIRST_INTERVAL_END * cell.top
                ):
                    return CellsResult(1.0, cell, [])
                step = step.after(cell, False)
                todo += [replace(half, near=m) for half in reversed(across_frequency(cell))]
            elif split and self._width(cell.sides).max() > MIN_INTERVAL:
                todo += self._across_box(cell, m)
            else:
                return CellsResult(beta, cell, [])
        return CellsResult(0.0, None, [])

    def _branch(self, cell: MultiplierCell) -> Branch | None:
        key = (cell.rows, cell.sides.tobytes())
        if key not in self._branches:
            while len(self._branches) >= MAX_KEPT_PENCILS:
                self._branches.pop(next(iter(self._branches)))
            self._branches[key] = self.rows[cell.rows].over(cell.sides), {}
        pencil, known = self._branches[key]
        if pencil is None:
            return None
        if (cell.branch, cell.top) not in known:
            known[cell.branch, cell.top] = Branch(pencil, cell.branch, cell.top)
        found = known[cell.branch, cell.top]
        return found if found.finite else None

    def cover(self, t: float) -> list[MultiplierCell]:
        """The cells of all frequencies and all groups on box(t)."""
        found, sides = [], self.box.sides(t)
        for k, rows in enumerate(self.rows):
            for branch, low, high in intervals(rows, self.box.nominal):
                found.append(MultiplierCell(k, sides, branch, low, high, high))
        return found

    def _level(self, cell: MultiplierCell, *, hasty: bool = False) -> tuple[float, Multiplier | None, bool]:
        """The beta in the middle of a cell, its multiplier, and whether the cell is excluded."""
        self.count += 1
        spend(LEVEL * self.rows[cell.rows].size ** 2)
        own = self._branch(cell)
        if own is None:
            return math.inf, None, False
        found = response(own, cell.low, cell.high)
        if found is None:
            return 0.0, cell.near, False
        blocks = own.channels[0].blocks
        if not blocks.size:
            return 0.0, None, True
        x, half = (cell.low + cell.high) / 2, (cell.high - cell.low) / 2
        near = cell.near.at(x) if cell.near is not None and cell.near.blocks == blocks else None
        if near is not None and excludes_zero(found, near, half):
            return 0.0, near, True
        along = found.terms[1] / half if half > 0 else None
        try:
            m, beta = multiplier(found.terms[0], blocks, near, 1.0, along=along, hasty=hasty)
            if hasty and beta >= 1 and near is not None:
                return 0.0, near, False
            done = beta < 1 and excludes_zero(found, m := m._replace(x=x), half)
            if SPLIT_BETA <= beta < 1 and not done:
                narrow = response(own, x, x)
                if narrow is not None and excludes_zero(narrow, m):
                    return 0.0, m, False
                m, beta = multiplier(found.terms[0], blocks, m, SPLIT_BETA)
        except (np.linalg.LinAlgError, ValueError):
            return math.inf, None, False
        return beta, m, done

    def _width(self, sides: FloatArray) -> FloatArray:
        """The widths of a part of a box, in those of box(1)."""
        return np.asarray((sides[:, 1] - sides[:, 0]) / np.maximum(self.box.up + self.box.down, 1e-300))

    def _across_box(self, cell: MultiplierCell, m: Multiplier | None) -> list[MultiplierCell]:
        sides = cell.sides
        axis = int(self._width(sides).argmax())
        own = self._branch(cell)
        if own is not None and m is not None:
            found = response(own, cell.low, cell.high)
            if found is not None:
                axis = worst(found.terms[0], m, own.channels[0].owners, len(sides), axis)
        made = []
        for side in (0, 1):
            half = sides.copy()
            half[axis, 1 - side] = sides[axis].mean()
            made.append(replace(cell, sides=half, near=m))
        return made


def _first(cells: list[MultiplierCell], hard: MultiplierCell) -> list[MultiplierCell]:
    """The cells with the one that a part of resisted in front, each once."""

    def holds(c: MultiplierCell) -> bool:
        return (c.rows, c.branch) == (hard.rows, hard.branch) and c.low <= hard.low and hard.high <= c.high

    return sorted(cells, key=lambda c: not holds(c))


def _within(sides: FloatArray, outer: FloatArray) -> bool:
    return bool((sides[:, 0] >= outer[:, 0]).all() and (sides[:, 1] <= outer[:, 1]).all())


def _is_next(cell: MultiplierCell, other: MultiplierCell) -> bool:
    """Whether the other cell is the next one along frequency."""
    return cell.sides is other.sides and cell.branch == other.branch and cell.high == other.low


def across_frequency(cell: MultiplierCell) -> list[MultiplierCell]:
    low, high = cell.low, cell.high
    middle = math.sqrt(low * high) if low > 0 and high > 4 * low else low + 0.5 * (high - low)
    if low == 0:
        middle = high / 8
    return [replace(cell, high=middle), replace(cell, low=middle)]


def worst(N: Any, m: Multiplier, owners: Any, count: int, other: int) -> int:
    """The parameter with the largest effect in the direction that is excluded least."""
    D, G = m.D, m.G
    H = N.conj().T
    S = H @ D @ N + 1j * (G @ N - H @ G)
    try:
        _, vectors = linalg.eigh((S + S.conj().T) / 2, (D + D.conj().T) / 2)
    except (np.linalg.LinAlgError, ValueError):  # numbers that overflow
        return other
    w = vectors[:, -1]
    each = (w.conj() * (D @ w)).real
    shares = np.zeros(count)
    np.add.at(shares, owners[owners >= 0], each[owners >= 0])
    return int(shares.argmax()) if shares.max(initial=0) > 0 else other


def intervals(rows: Rows, nominal: FloatArray) -> list[tuple[int, float, float]]:
    """Intervals of frequency from zero to infinity, octaves around the poles."""
    pencil = rows.over(np.column_stack([nominal, nominal]))
    known = np.ones(1)
    if pencil is not None:
        with np.errstate(all="ignore"):
            poles = np.abs(linalg.eigvals(-pencil.constant.middle, pencil.linear.middle, check_finite=False))
        poles = poles[np.isfinite(poles) & (poles > 0)]
        if len(poles):
            typical = np.exp(np.median(np.log(poles)))
            known = poles[(poles < 1e12 * typical) & (poles > 1e-12 * typical)]
    low, high = math.floor(math.log2(known.min())) - 3, math.ceil(math.log2(known.max())) + 3
    edges = [2.0**k for k in range(low, high + 1)]
    inner = [(0, a, b) for a, b in pairwise(edges)]
    return [(0, 0.0, edges[0]), *inner, (1, 0.0, 1 / edges[-1])]


def rows_of(problem: Problem) -> list[Rows] | None:
    """The rows of all groups of the loops; None when they are too large or no rational functions of p."""
    found = [_rows_of(loop) for loop in problem.loops]
    return None if None in found else [rows for several in found for rows in several or ()]


def _rows_of(loop: UncertainLoop | None) -> list[Rows] | None:
    """The rows of one loop's groups."""
    if (
        loop is None
        or loop.symbolic is None
        or not loop.program.rational
        or (loop.descriptor and loop.sampled)
        or split_delay(loop.law.delay)[1]  # the pencil has one hold a sample
    ):
        return None
    try:
        found = [Rows(loop, group) for group in groups(loop)]
    except TooLarge:
        return None
    small = sum(rows.cost for rows in found) <= TERMS and max(rows.size for rows in found) <= MAX_PENCIL_ROWS
    return found if small else None
