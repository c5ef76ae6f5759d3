"""A proof without frequencies: a polynomial with roots on the boundary of stability has a zero in one of three places.

    a(s; p) = sum of a_k(p) s^k:    a_0 = 0 (a root at zero),  a_n = 0 (at infinity),  H(p) = 0 (a pair +-jw)

H is Hurwitz's determinant of order n - 1: a_n^(n-1) times the product of all sums of two roots (Orlando). A loop
that is stable at the nominal values stays stable on a box on which none of the three is zero. They are polynomials of
p, or close to one: their Bernstein coefficients over parts of the box decide, in exact numbers or balls. The damping of
a mode, however light, is a factor of H and no width that cells of frequency must resolve.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat, fmpq, fmpq_mat

from malta.arrays import FloatArray
from malta.linear.expressions import NotAnalytic, exact
from malta.proof.box import Box
from malta.proof.exclusion import cut
from malta.proof.polynomial.characteristic import pair
from malta.proof.polynomial.enclosure import (
    Disc,
    Polynomial,
    TooWide,
    Unproven,
    discs_of,
    ends_of,
    precision,
    remainder,
    wanted_degree,
)
from malta.proof.polynomial.family import nodes, scale_of
from malta.proof.problem import Problem, hurwitz
from malta.work import check_clock, spend

BITS = 640  # of balls: Bernstein coefficients of degree d lose about 2 d of them
MAX_POLYNOMIAL_DEGREE = 14  # degree in s
DETERMINANT, HALVING = 3e-7, 4e-6  # work of a determinant, by its order cubed; of a cell, by its coefficients
MOST_PLACES = 4000  # at which a_k, or H, is evaluated
MAX_INTERPOLATION_DEGREE = 40  # degree of an interpolation along one parameter
TAIL = 2.0**-70  # what an interpolation may leave out, relative to each coefficient


class Tensor(NamedTuple):
    """A polynomial on [0, 1]^P by its Bernstein coefficients, or another basis: one axis for each parameter."""

    shape: tuple[int, ...]
    values: list[Any]

    def along(self, axis: int, M: Any) -> Tensor:
        """The tensor with M, an exact matrix, applied along one axis."""
        n, m = self.shape[axis], M.nrows()
        after = math.prod(self.shape[axis + 1 :])
        before = len(self.values) // (n * after)
        rows = [
            self.values[(b * n + i) * after + a]
            for i in range(n)
            for b in range(before)
            for a in range(after)
        ]
        exactly = isinstance(M, fmpq_mat) and all(isinstance(x, fmpq) for x in rows)
        kind = fmpq_mat if exactly else arb_mat
        made = (kind(M) * kind(n, before * after, rows)).entries()
        shape = (*self.shape[:axis], m, *self.shape[axis + 1 :])
        return Tensor(
            shape,
            [
                made[(i * before + b) * after + a]
                for b in range(before)
                for i in range(m)
                for a in range(after)
            ],
        )

    def corner(self, at: Sequence[int]) -> Any:
        """The value at a corner of the cell; at: 0 or 1 on each axis."""
        k = 0
        for n, side in zip(self.shape, at, strict=True):
            k = k * n + (n - 1) * side
        return self.values[k]


@dataclass(frozen=True, eq=False)
class BoxAxes:
    """A box in exact numbers: v = low + (high - low) u; p = v, or 1 / v where inverted."""

    low: list[Any]
    high: list[Any]
    inverted: tuple[bool, ...]
    nominal: list[Any]
    down: list[Any]
    up: list[Any]

    def place(self, u: Sequence[Any]) -> list[Any]:
        """v at u."""
        return [a + (b - a) * x for a, b, x in zip(self.low, self.high, u, strict=True)]

    def middle(self, i: int) -> Any:
        """The nominal value of v_i."""
        return 1 / self.nominal[i] if self.inverted[i] else self.nominal[i]

    def smallest(self, cell: Sequence[tuple[Any, Any]]) -> Any:
        """The smallest t of any point of a cell in u; None where no box(t) reaches it."""
        t = fmpq(0)
        for i, (a, b) in enumerate(cell):
            if not self.down[i] and not self.up[i]:
                continue
            width = self.high[i] - self.low[i]
            low, high = self.low[i] + width * a, self.low[i] + width * b
            if self.inverted[i]:
                low, high = 1 / high, 1 / low
            for away, rate in ((self.nominal[i] - high, self.down[i]), (low - self.nominal[i], self.up[i])):
                if away > 0:
                    if not rate:
                        return None
                    t = max(t, away / rate)
        return t


@dataclass(frozen=True, eq=False)
class Function:
    """a_0, a_n or H over a part of the box, positive at the nominal values; of: the polynomial in s."""

    of: Polynomial
    axes: BoxAxes
    tensor: Tensor  # Bernstein coefficients
    slack: Any  # bound of what these leave out

    def is_positive(self, tensor: Tensor) -> bool:
        return all(x > self.slack for x in tensor.values)


def determinant(a: Sequence[Any]) -> Any:
    """Hurwitz's determinant of order n - 1 of a_0 + a_1 s + ... + a_n s^n, as a ball.

    >>> from flint import arb
    >>> print(
    ...     determinant([arb(6), arb(11), arb(6), arb(1)])
    ... )  # (s + 1)(s + 2)(s + 3): 3 x 4 x 5
    60.0000000000000
    """
    n = len(a) - 1
    at = [[n - 2 * j + i for j in range(1, n)] for i in range(1, n)]
    entries = [arb(a[k]) if 0 <= k <= n else arb(0) for row in at for k in row]
    return arb_mat(n - 1, n - 1, entries).det() if n > 1 else arb(1)


def functions_over(f: Polynomial, box: Box, moves: Sequence[Any], sides: FloatArray) -> list[Function]:
    """a_0, a_n and H of a polynomial over a part of the box (P x 2, of p).

    Raises Unproven where they are too large, or one of them is zero at the nominal values.
    """
    low, high = ends_of(f, sides)
    nominal = [exact(x) for x in box.nominal.tolist()]
    rates = [[exact(x) for x in rate.tolist()] for rate in (box.down, box.up)]
    axes = BoxAxes(low, high, f.inverted, nominal, *rates)
    here = _values(f, [axes.middle(i) for i in range(len(nominal))])
    if len(here) - 1 > MAX_POLYNOMIAL_DEGREE:
        raise Unproven(f"a polynomial of degree {len(here) - 1} in s")
    powers, tails = _enclose(f, axes)
    for k, bound in enumerate(f.coupling_bounds(moves, [(arb(a), arb(b)) for a, b in sides.tolist()]) or ()):
        tails[k] += arb(bound[0]) * arb(2) ** bound[1]
    while len(powers) > 1 and all(x == 0 for x in powers[-1].values) and tails[len(powers) - 1] == 0:
        powers.pop()  # a power of s that the polynomial does not have
        here.pop()
    units = _balance([_to_bernstein(tensor) for tensor in powers])
    powers = [Tensor(t.shape, [x * unit for x in t.values]) for t, unit in zip(powers, units, strict=True)]
    tails = [x * unit for x, unit in zip(tails, units, strict=False)]
    ends = [_to_bernstein(tensor) for tensor in powers]
    found = [(here[0], ends[0], tails[0]), (here[-1], ends[-1], tails[-1])]
    if len(powers) > 2:
        slack = _determinant_slack([_largest(tensor) for tensor in ends], tails)
        found.append((determinant(here), _to_bernstein(_expand(powers)), slack))
    made = []
    for value, tensor, slack in found:
        sign = 1 if value > 0 else -1 if value < 0 else 0
        if not sign:
            raise Unproven("the nominal loop is not proven stable")
        values = [arb(x) * sign for x in tensor.values]
        made.append(Function(f, axes, Tensor(tensor.shape, values), slack))
    return made


def _values(f: Polynomial, v: list[Any]) -> list[Any]:
    try:
        return list(f.at(v))
    except (NotAnalytic, ZeroDivisionError) as error:
        raise Unproven(f"the matrices have no value on the box: {error}") from error


def _enclose(f: Polynomial, axes: BoxAxes) -> tuple[list[Tensor], list[Any]]:
    """The coefficients a_k as polynomials of u, by powers, and bounds of what these leave out."""
    known = f.degrees
    free = [i for i, d in enumerate(known) if d is None and axes.low[i] < axes.high[i]]
    degrees = [0 if axes.low[i] == axes.high[i] else d or 0 for i, d in enumerate(known)]
    tails: list[Any] = []
    if free:
        middle = _values(f, axes.place([fmpq(1, 2)] * len(known)))
        tails = [arb(0)] * len(middle)
        size = [pair(arb(c)) for c in middle]
        for order, i in enumerate(free):
            degrees[i], left = _interpolation_nodes(f.names[i], i, discs_of(f, i, axes.low, axes.high, size))
            tails = [one + two * 4**order for one, two in zip(tails, left, strict=True)]
    if math.prod(d + 1 for d in degrees) > MOST_PLACES:
        raise Unproven("too many coefficients")
    grids = [
        [exact(x) if i in free else fmpq(k, max(d, 1)) for k, x in enumerate(nodes(d, chebyshev=i in free))]
        for i, d in enumerate(degrees)
    ]
    places = []
    spend(f.price * math.prod(map(len, grids)))
    for u in itertools.product(*grids):
        check_clock()
        places.append(_values(f, axes.place(u)))
    shape = tuple(d + 1 for d in degrees)
    found = [Tensor(shape, [a[k] for a in places]) for k in range(len(places[0]))]
    for i, grid in enumerate(grids):
        M = _powers_at(grid, len(grid) - 1)
        M = arb_mat(M).inv() if i in free else M.inv()
        found = [tensor.along(i, M) for tensor in found]
    return found, tails or [arb(0)] * len(found)


def _interpolation_nodes(name: str, axis: int, discs: list[Disc]) -> tuple[int, list[Any]]:
    """The lowest degree of an interpolation at Chebyshev nodes that leaves out little enough, and what it leaves out.

    Raises TooWide when the degree is too high.
    """
    disc = min(discs, key=lambda disc: wanted_degree(disc, TAIL))
    degree = max(1, math.ceil(wanted_degree(disc, TAIL)))
    if degree > MAX_INTERPOLATION_DEGREE:
        raise TooWide(axis, f"{name}: its range is too wide for one expansion")
    return degree, [arb(m) * arb(2) ** e for m, e in remainder(disc, degree)]


def _powers_at(grid: list[Any], degree: int) -> Any:
    return fmpq_mat([[u**k for k in range(degree + 1)] for u in grid])


def _to_bernstein(tensor: Tensor) -> Tensor:
    """Powers of u -> Bernstein coefficients."""
    for axis, n in enumerate(tensor.shape):
        M = [
            [fmpq(math.comb(i, k), math.comb(n - 1, k)) if k <= i else fmpq(0) for k in range(n)]
            for i in range(n)
        ]
        tensor = tensor.along(axis, fmpq_mat(M))
    return tensor


def _balance(bernstein: list[Tensor]) -> list[Any]:
    """Factors of the coefficients, which count s in a power of two that makes them alike; signs stay."""
    sizes = [pair(_largest(tensor)) for tensor in bernstein]
    top = np.array([math.log2(m) + e if m else -math.inf for m, e in sizes])
    scale = scale_of(top)
    common = round(float(np.max(top + scale * np.arange(len(top)), initial=-math.inf)))
    return [fmpq(2) ** (scale * k - common) for k in range(len(top))]


def _largest(bernstein: Tensor) -> Any:
    """A bound of |polynomial|, by its Bernstein coefficients."""
    top = arb(0)
    for x in bernstein.values:
        top = top.max(abs(arb(x)))
    return top


def _expand(powers: list[Tensor]) -> Tensor:
    """H by powers of u: evaluated on a grid."""
    orders = [_degrees(tensor) for tensor in powers]
    axes = range(len(powers[0].shape))
    degrees = [_determinant_degree([order[i] for order in orders]) for i in axes]
    if math.prod(d + 1 for d in degrees) > MOST_PLACES:
        raise Unproven("too many coefficients of Hurwitz's determinant")
    grids = [[fmpq(k, max(d, 1)) for k in range(d + 1)] for d in degrees]
    values = []
    for tensor in powers:
        for i, grid in enumerate(grids):
            tensor = tensor.along(i, _powers_at(grid, tensor.shape[i] - 1))
        values.append(tensor.values)
    found = []
    spend(DETERMINANT * len(powers) ** 3 * len(values[0]))
    for a in zip(*values, strict=True):
        check_clock()
        found.append(determinant(a))
    made = Tensor(tuple(d + 1 for d in degrees), found)
    for i, grid in enumerate(grids):
        made = made.along(i, arb_mat(_powers_at(grid, len(grid) - 1)).inv())
    return made


def _degrees(tensor: Tensor) -> list[int]:
    """The degree along each axis of a polynomial by powers of u; -1 for zero."""
    # a ball about zero is neither zero nor known to be another number
    table = ~np.array([bool(x == 0) for x in tensor.values]).reshape(tensor.shape)
    return [int(max(np.nonzero(table)[i], default=-1)) for i in range(table.ndim)]


def _determinant_degree(degrees: list[int]) -> int:
    """An upper bound of the degree of H, by the heaviest of its products."""
    n = len(degrees) - 1
    weight = np.full((n - 1, n - 1), -1e6)
    for i, j in itertools.product(range(1, n), repeat=2):
        k = n - 2 * j + i
        if 0 <= k <= n and degrees[k] >= 0:
            weight[i - 1, j - 1] = degrees[k]
    from scipy.optimize import linear_sum_assignment  # here: it takes long to import, and few loops need it

    rows, columns = linear_sum_assignment(weight, maximize=True)
    return max(0, round(float(weight[rows, columns].sum())))


def _determinant_slack(sizes: list[Any], tails: list[Any]) -> Any:
    """A bound of the change of H when each a_k moves by its tail: Hadamard's inequality, row by row."""
    n = len(sizes) - 1
    if all(x == 0 for x in tails):
        return arb(0)
    large, small = arb(1), arb(1)
    for i in range(1, n):
        picked = [n - 2 * j + i for j in range(1, n) if 0 <= n - 2 * j + i <= n]
        row = sum((sizes[k] ** 2 for k in picked), arb(0)).sqrt()
        move = sum((tails[k] ** 2 for k in picked), arb(0)).sqrt()
        small, large = small * row, large * (row + move)
    return abs(large - small)


# The largest box on which a_0, a_n and Hurwitz's determinant are positive: branch and bound over parameters alone.


SIGN_SNAP = fmpq(1, 256)  # of a range: in cells that narrow, a parameter about zero is tried at zero
MAX_HALVINGS = 60  # halvings of a side
SIGN_PARTS = 16  # of a box
MOST_CORNERS = 64  # of a cell, that are tried as witnesses
HALF = fmpq(1, 2)


class PositivityCell(NamedTuple):
    """A part of the box on which a function is not proven positive; t: the smallest of any of its points."""

    t: Any
    number: int
    function: Function
    tensor: Tensor
    sides: list[tuple[Any, Any]]  # in u


@dataclass(eq=False)
class Signs:
    """The functions of all groups, and the cells that are left. `lower`: all are positive on every smaller box(t).

    It changes in place: work that is up may end any step of it, and what was found before then stands.
    """

    reach: Any  # the box that the functions cover
    upper: float = math.inf
    cells: list[PositivityCell] = field(default_factory=list)
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
            heapq.heappush(self.cells, PositivityCell(t, self.count, function, tensor, sides))

    def advance(self) -> None:
        """Take the open cell of the smallest t: try its corners as witnesses, and halve it."""
        spend(HALVING * len(self.cells[0].tensor.values))
        cell = heapq.heappop(self.cells)
        if float(cell.t) >= self.upper:
            return
        self._try_corners(cell)
        axis = _axis(cell)
        low, high = cell.sides[axis]
        if (high - low) * 2**MAX_HALVINGS <= 1:
            self.blocked = True
            heapq.heappush(self.cells, cell)
            return
        middle = (low + high) * HALF
        for M, side in zip(_halves(cell.tensor.shape[axis]), ((low, middle), (middle, high)), strict=True):
            sides = [*cell.sides[:axis], side, *cell.sides[axis + 1 :]]
            self.add(cell.function, cell.tensor.along(axis, M), sides)

    def _try_corners(self, cell: PositivityCell) -> None:
        function, axes = cell.function, cell.function.axes
        free = [i for i, (a, b) in enumerate(zip(axes.low, axes.high, strict=True)) if a < b]
        ends = [(0, 1) if i in free else (0,) for i in range(len(cell.sides))]
        for at in itertools.islice(itertools.product(*ends), MOST_CORNERS):
            if not cell.tensor.corner(at) > function.slack:
                self._try(function, [side[k] for side, k in zip(cell.sides, at, strict=True)])
        self._try_zeros(cell)

    def _try_zeros(self, cell: PositivityCell) -> None:
        """A root may touch the boundary where a parameter is zero, and a halved cell has no corner there."""
        axes, u, any_zero = cell.function.axes, [], False
        for i, ((a, b), low, high) in enumerate(zip(cell.sides, axes.low, axes.high, strict=True)):
            if not low < high:
                u.append(a)
                continue
            zero, middle = (-low / (high - low), (axes.middle(i) - low) / (high - low))
            near = b - a <= SIGN_SNAP and a <= zero <= b
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


def _axis(cell: PositivityCell) -> int:
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


def signs_over(problem: Problem, box: Box, reach: float) -> Signs:
    """The search over box(reach).

    Raises Unproven where the determinant has too many coefficients or a matrix has no value; WorkUp as spend does.
    """
    sides = box.sides(reach)
    found = Signs(_covered_box(box, sides))
    try:
        with precision(BITS):
            for f, moves in problem.parts([arb(a).union(arb(b)) for a, b in sides.tolist()]):
                made = partial(functions_over, f, box, moves)
                for function in cut(sides, box.nominal, made, SIGN_PARTS):
                    whole = [(fmpq(0), fmpq(1))] * len(box.names)
                    found.add(function, function.tensor, whole)
    except NotAnalytic as error:
        raise Unproven(f"the matrices have no value on the box: {error}") from error
    return found


def _covered_box(box: Box, sides: FloatArray) -> Any:
    """The largest t with box(t) within these sides, exactly."""
    t = fmpq(2) ** 40
    for i, (low, high) in enumerate(sides.tolist()):
        middle = exact(float(box.nominal[i]))
        for away, rate in ((middle - exact(low), box.down[i]), (exact(high) - middle, box.up[i])):
            if rate > 0:
                t = min(t, away / exact(float(rate)))
    return t


def raise_bound(s: Signs, tolerance: float, most: int) -> None:
    """Halve cells until the bound is as near to the witness as `tolerance` says, or the work or the cells are over."""
    with precision(BITS):
        while s.cells and not s.blocked and s.count < most:
            if s.lower >= s.upper * (1 - tolerance):
                return
            s.advance()
