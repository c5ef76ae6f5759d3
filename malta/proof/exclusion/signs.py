"""The largest box on which a_0, a_n and Hurwitz's determinant are positive: branch and bound over parameters alone."""

from __future__ import annotations

import heapq
import itertools
import math
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from flint import arb, fmpq, fmpq_mat

from malta.proof.box_parts import cut
from malta.proof.exclusion.hurwitz import BITS, Function, Tensor, functions_over
from malta.proof.expressions import NotAnalytic, exact
from malta.proof.polynomial.enclosure import Unproven, precision
from malta.proof.problem import hurwitz

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.box import Box
    from malta.proof.problem import Problem

SNAP = fmpq(1, 256)  # of a range: in cells that narrow, a parameter about zero is tried at zero
DEEPEST = 60  # halvings of a side
FEW_PARTS = 16  # of a box
MOST_CORNERS = 64  # of a cell, that are tried as witnesses
HALF = fmpq(1, 2)


class Cell(NamedTuple):
    """A part of the box on which a function is not proven positive; t: the smallest of any of its points."""

    t: Any
    number: int
    function: Function
    tensor: Tensor
    sides: list[tuple[Any, Any]]  # in u


@dataclass(eq=False)
class Signs:
    """The functions of all groups, and the cells that are left. `lower`: all are positive on every smaller box(t)."""

    reach: Any  # the box that the functions cover
    upper: float = math.inf
    cells: list[Cell] = field(default_factory=list)
    witness: FloatArray | None = None
    count: int = 0
    blocked: bool = False

    @property
    def lower(self) -> float:
        t = min(self.reach, self.cells[0].t) if self.cells else self.reach
        return max(0.0, math.nextafter(float(t), 0.0))

    def add(self, function: Function, tensor: Tensor, sides: list[tuple[Any, Any]]) -> None:
        if function.is_positive(tensor):
            return
        t = function.axes.smallest(sides)
        if t is not None and t < self.reach and float(t) < self.upper:
            self.count += 1
            heapq.heappush(self.cells, Cell(t, self.count, function, tensor, sides))

    def advance(self) -> None:
        """Take the open cell of the smallest t: try its corners as witnesses, and halve it."""
        cell = heapq.heappop(self.cells)
        if float(cell.t) >= self.upper:
            return
        self._try_corners(cell)
        axis = _axis(cell)
        low, high = cell.sides[axis]
        if (high - low) * 2**DEEPEST <= 1:
            self.blocked = True
            heapq.heappush(self.cells, cell)
            return
        middle = (low + high) * HALF
        for M, side in zip(_halves(cell.tensor.shape[axis]), ((low, middle), (middle, high)), strict=True):
            sides = [*cell.sides[:axis], side, *cell.sides[axis + 1 :]]
            self.add(cell.function, cell.tensor.along(axis, M), sides)

    def _try_corners(self, cell: Cell) -> None:
        function, axes = cell.function, cell.function.axes
        free = [i for i, (a, b) in enumerate(zip(axes.low, axes.high, strict=True)) if a < b]
        ends = [(0, 1) if i in free else (0,) for i in range(len(cell.sides))]
        for at in itertools.islice(itertools.product(*ends), MOST_CORNERS):
            if not cell.tensor.corner(at) > function.slack:
                self._try(function, [side[k] for side, k in zip(cell.sides, at, strict=True)])
        self._try_zeros(cell)

    def _try_zeros(self, cell: Cell) -> None:
        """A root may touch the boundary where a parameter is zero, and a halved cell has no corner there."""
        axes, u, any_zero = cell.function.axes, [], False
        for i, ((a, b), low, high) in enumerate(zip(cell.sides, axes.low, axes.high, strict=True)):
            if not low < high:
                u.append(a)
                continue
            zero, middle = (-low / (high - low), (axes.middle(i) - low) / (high - low))
            near = b - a <= SNAP and a <= zero <= b
            any_zero |= near
            u.append(zero if near else min(max(middle, a), b))
        if any_zero:
            self._try(cell.function, u)

    def _try(self, function: Function, u: Sequence[Any]) -> None:
        """Keep a place as the witness when it is nearer than the nearest so far and not stable, by Routh's scheme."""
        t = function.axes.smallest([(x, x) for x in u])
        if t is None or not float(t) < self.upper:
            return
        v = function.axes.place(u)
        try:
            stable = hurwitz(function.of.at(v))
        except (NotAnalytic, ZeroDivisionError):
            return
        if not stable:
            self.upper = float(t)
            p = [1 / x if inverted else x for x, inverted in zip(v, function.axes.inverted, strict=True)]
            self.witness = np.array([float(arb(x)) for x in p])


def _axis(cell: Cell) -> int:
    """The axis along which the function changes most; else the widest one."""
    shape = cell.tensor.shape
    sizes = [abs(x) for x in cell.tensor.values]
    top = max(sizes, key=lambda x: float(x.mid()))
    scale = 1 / top.mid() if top.mid() > 0 else arb(1)
    values = np.array([float((x * scale).mid()) for x in cell.tensor.values]).reshape(shape)
    moves = [
        float(np.abs(np.diff(values, axis=i)).sum(axis=i).max()) if n > 1 else 0.0
        for i, n in enumerate(shape)
    ]
    if max(moves) > 0:
        return int(np.argmax(moves))
    return int(np.argmax([float(b - a) for a, b in cell.sides]))


def _halves(n: int) -> tuple[Any, Any]:
    """The matrices from Bernstein coefficients to those over both halves of the interval."""
    left = [[fmpq(math.comb(i, k), 2**i) if k <= i else fmpq(0) for k in range(n)] for i in range(n)]
    right = [row[::-1] for row in left[::-1]]
    return fmpq_mat(left), fmpq_mat(right)


def signs_over(problem: Problem, box: Box, reach: float, until: float) -> Signs:
    """The search over box(reach).

    Raises Unproven where the determinant has too many coefficients or a matrix has no value, or when time is up.
    """
    sides = box.sides(reach)
    found = Signs(_covered(box, sides))
    try:
        with precision(BITS):
            for f, moves in problem.parts([arb(a).union(arb(b)) for a, b in sides.tolist()]):
                made = partial(functions_over, f, box, moves, until)
                for function in cut(sides, box.nominal, until, made, FEW_PARTS):
                    whole = [(fmpq(0), fmpq(1))] * len(box.names)
                    found.add(function, function.tensor, whole)
    except NotAnalytic as error:
        raise Unproven(f"the matrices have no value on the box: {error}") from error
    return found


def _covered(box: Box, sides: FloatArray) -> Any:
    """The largest t with box(t) within these sides, exactly."""
    t = fmpq(2) ** 40
    for i, (low, high) in enumerate(sides.tolist()):
        middle = exact(float(box.nominal[i]))
        for away, rate in ((middle - exact(low), box.down[i]), (exact(high) - middle, box.up[i])):
            if rate > 0:
                t = min(t, away / exact(float(rate)))
    return t


def raise_bound(s: Signs, tolerance: float, until: float, most: int) -> None:
    """Halve cells until the bound is as near to the witness as `tolerance` says, or the time or the cells are over."""
    with precision(BITS):
        while s.cells and not s.blocked and s.count < most and clock.monotonic() < until:
            if s.lower >= s.upper * (1 - tolerance):
                return
            s.advance()
