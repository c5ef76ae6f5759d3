"""A characteristic polynomial over a box of parameters: a(s; p) = sum_k a_k(p) s^k.

Each a_k is a Bernstein polynomial in p over the box, with a radius for the errors of that polynomial (rounding,
truncation, couplings taken as zero). The coefficients of different k spread over hundreds of decades, so each k has a
power of two of its own, and s counts in a power of two: nothing here has a unit, and no scale changes an answer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.work import spend

if TYPE_CHECKING:
    from malta.arrays import FloatArray

EPS = 2.0**-52
MIN_NODES_IN_PLACE = 8  # nodes of the following axes from which on values are multiplied in place
MAX_PRODUCT_DEGREE = 6  # degree up to which a restriction is one product of matrices
COLUMNS = 4096  # of a product of exact matrices at once
ROUNDING_WORK = 4e-6  # work of rounding an entry
ENTRY, BIT = 5e-8, 1.3e-9  # work of a product of entries, and of each bit of exact ones


@dataclass(frozen=True, eq=False)
class Family:
    """a_k(p) = 2^exponents[k] (sum_b values[k, b] B_b(u) +- radius[k]), with u = (p - low) / (high - low) in [0, 1].

    values : (n + 1) x nodes; shape: (d_1 + 1, ..., d_P + 1), of which nodes is the product
    scale : s counts in 2^scale, so a(s) = sum_k a_k (s / 2^scale)^k
    """

    shape: tuple[int, ...]
    values: FloatArray
    radius: FloatArray
    exponents: tuple[int, ...]
    scale: int

    @property
    def degree(self) -> int:
        return len(self.values) - 1

    @cached_property
    def _largest(self) -> FloatArray:
        return np.asarray(np.abs(self.values).max(axis=1) + self.radius)

    def size(self) -> FloatArray:
        """The largest |a_k| over the box, in units of 2^exponents[k]."""
        return self._largest

    @cached_property
    def powers(self) -> FloatArray:
        """The exponents as an array."""
        return np.array(self.exponents)

    @cached_property
    def levels(self) -> FloatArray:
        """log2 of the largest value of each a_k over the box; -inf where it is zero."""
        size = np.abs(self.values).max(axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log2(size) + self.powers)


def nodes(degree: int, *, chebyshev: bool = False) -> list[float]:
    """The points at which a polynomial of this degree on [0, 1] is sampled."""
    if degree == 0:
        return [0.5]
    if chebyshev:
        return [0.5 - 0.5 * math.cos(math.pi * (i + 0.5) / (degree + 1)) for i in range(degree + 1)]
    return [i / degree for i in range(degree + 1)]


@lru_cache(maxsize=64)
def to_bernstein(degree: int, chebyshev: bool) -> Any:
    """The exact matrix from values at the nodes to Bernstein coefficients."""
    from flint import fmpq, fmpq_mat

    u = [fmpq(*x.as_integer_ratio()) for x in nodes(degree, chebyshev=chebyshev)]
    if degree and not chebyshev:
        u = [fmpq(i, degree) for i in range(degree + 1)]
    one = fmpq(1)
    rows = [[math.comb(degree, k) * x**k * (one - x) ** (degree - k) for k in range(degree + 1)] for x in u]
    return fmpq_mat(rows).inv()


def binary(x: Any) -> tuple[float, float, int]:
    """An exact rational or a real ball as (mantissa, radius, exponent): x = (mantissa +- radius) 2^exponent."""
    if hasattr(x, "rad"):
        if not x.is_finite():
            return 0.0, math.inf, 0
        value = float(x)  # the middle, to the last digit
        if 1e-280 < abs(value) < 1e280:
            return value, float(x.rad()) * (1 + EPS) + abs(value) * EPS, 0
        m, e = (int(v) for v in x.mid().man_exp())
        shift = m.bit_length() - 60 if m else 0
        value = float(m >> shift if shift > 0 else m)
        exponent = e + max(shift, 0)
        rm, re = (int(v) for v in x.rad().man_exp())
        radius = math.ldexp(rm, min(re - exponent, 900)) if rm else 0.0
        cut = 1.0 if shift > 0 else 0.0  # digits that were shifted out
        return value, radius + abs(value) * EPS + cut, exponent
    p, q = int(x.p), int(x.q)
    if p == 0:
        return 0.0, 0.0, 0
    exponent = p.bit_length() - q.bit_length()
    value = p / (q << exponent) if exponent >= 0 else (p << -exponent) / q
    return value, abs(value) * EPS, exponent


def family(
    shape: Sequence[int], chebyshev: Sequence[bool], points: list[list[Any]], tails: Any = None
) -> Family:
    """The family through exact values (rationals or balls): points[node][k] = a_k at the tensor grid's nodes.

    tails : bounds of the terms of a_k beyond these degrees, (mantissa, exponent) for each k; None for polynomials
    """
    count = len(points[0])
    table = np.empty((len(points), count), dtype=object)
    for b, row in enumerate(points):
        table[b] = row
    for axis, (n, cheb) in enumerate(zip(shape, chebyshev, strict=True)):
        if n > 2 or (cheb and n > 1):
            table = _transform(table, tuple(shape), axis, to_bernstein(n - 1, cheb))
    return _round_to_doubles(shape, table, tails)


def align(f: Family, g: Family) -> tuple[Family, Family]:
    """Both families with the same degrees and with f's scale of s."""
    shape = tuple(max(n, m) for n, m in zip(f.shape, g.shape, strict=True))
    count = max(len(f.values), len(g.values))
    moved = tuple(e + (f.scale - g.scale) * k for k, e in enumerate(g.exponents))
    return _raise_degrees(f, shape, count), _raise_degrees(
        replace(g, exponents=moved, scale=f.scale), shape, count
    )


def _raise_degrees(f: Family, shape: tuple[int, ...], count: int) -> Family:
    """Raise the degrees in the parameters to `shape`, and append zero coefficients up to `count`."""
    values, slack = f.values.reshape(len(f.values), *f.shape), 0.0
    for axis, (n, m) in enumerate(zip(f.shape, shape, strict=True)):
        if m > n:
            d, D = n - 1, m - 1
            E = np.array([[math.comb(d, j) * math.comb(D - d, i - j) / math.comb(D, i) if 0 <= i - j <= D - d else 0.0
                           for j in range(n)] for i in range(m)])  # fmt: skip
            values = np.moveaxis(np.moveaxis(values, axis + 1, -1) @ E.T, -1, axis + 1)
            slack += 4 * m * EPS
    values = values.reshape(len(values), -1)
    more = count - len(values)
    radius = f.radius + slack * np.abs(f.values).max(axis=1)
    return Family(
        shape,
        np.vstack([values, np.zeros((more, values.shape[1]))]),
        np.append(radius, np.zeros(more)),
        (*f.exponents, *[f.exponents[-1]] * more),
        f.scale,
    )


def combine(f: Family, g: Family, a: float, b: float) -> Family:
    """a f + b g of aligned families."""
    top = np.maximum(np.array(f.exponents), np.array(g.exponents))
    x = np.ldexp(1.0, np.clip(np.array(f.exponents) - top, -1070, 0))
    y = np.ldexp(1.0, np.clip(np.array(g.exponents) - top, -1070, 0))
    values = a * x[:, None] * f.values + b * y[:, None] * g.values
    size = abs(a) * x * f.size() + abs(b) * y * g.size()
    radius = abs(a) * x * f.radius + abs(b) * y * g.radius + 4 * EPS * size + 1e-300
    return Family(f.shape, values, radius, tuple(int(e) for e in top), f.scale)


def _round_to_doubles(shape: Sequence[int], table: Any, tails: Any) -> Family:
    """Bernstein coefficients (nodes x k, exact or balls) as a family."""
    each, count = table.shape
    spend(ROUNDING_WORK * each * count)
    mantissas, radii, powers = (np.zeros((count, each)) for _ in range(3))
    for (b, k), x in np.ndenumerate(table):
        mantissas[k, b], radii[k, b], powers[k, b] = binary(x)
    sizes = np.where(
        mantissas == 0, -np.inf, powers + np.log2(np.abs(np.where(mantissas == 0, 1, mantissas)))
    )
    top = sizes.max(axis=1)
    scale = scale_of(top)
    exponents = [int(np.ceil(t)) if np.isfinite(t) else 0 for t in top]
    shift = np.clip(powers - np.array(exponents)[:, None], -1020, 1020).astype(int)
    values, radius = np.ldexp(mantissas, shift), np.ldexp(radii, shift).max(axis=1)
    if tails is not None:
        radius = radius + [
            math.ldexp(m, max(min(e - x, 1000), -1020)) for (m, e), x in zip(tails, exponents, strict=True)
        ]
        radius = radius * (1 + 1e-12)  # tails are sums and products of a few bounds, rounded to nearest
    moved = tuple(e + scale * k for k, e in enumerate(exponents))
    return _reduce(Family(tuple(shape), values, np.asarray(radius), moved, scale))


def _transform(table: Any, shape: tuple[int, ...], axis: int, M: Any) -> Any:
    """Multiply a tensor of exact values along one parameter by an exact matrix."""
    from flint import arb_mat, fmpq, fmpq_mat

    kind = fmpq_mat if all(isinstance(x, fmpq) for x in table.ravel().tolist()) else arb_mat
    n, count = shape[axis], table.shape[1]
    array = np.moveaxis(table.reshape(*shape, count), axis, 0)
    rest = array.shape[1:]
    flat = array.reshape(n, -1)
    own, made = kind(M), np.empty(flat.shape, dtype=object)
    first = table.ravel()[0]
    bits = int(first.p).bit_length() + int(first.q).bit_length() if kind is fmpq_mat else 0
    price = n * (ENTRY + BIT * bits)
    for k in range(0, flat.shape[1], COLUMNS):
        spend(price * flat[:, k : k + COLUMNS].size)
        some = flat[:, k : k + COLUMNS]
        product = own * kind(n, some.shape[1], some.ravel().tolist())
        made[:, k : k + COLUMNS] = np.array(product.entries(), dtype=object).reshape(some.shape)
    return np.moveaxis(made.reshape(n, *rest), 0, axis).reshape(-1, count)


def scale_of(top: FloatArray) -> int:
    """The scale of s: log2 of the geometric mean of the roots' sizes; top: log2 of the coefficients."""
    known = np.flatnonzero(np.isfinite(top))
    if len(known) < 2:
        return 0
    first, last = known[0], known[-1]
    return round(float(top[first] - top[last]) / int(last - first))


def _reduce(f: Family) -> Family:
    """Lower the degrees whose terms are below rounding; these terms become part of the radius."""
    shape, values, radius = list(f.shape), f.values, f.radius.copy()
    size = np.abs(values).max(axis=1)
    for axis, count in enumerate(f.shape):
        d = count - 1
        while d > 0:
            array = np.moveaxis(values.reshape(len(values), *shape), axis + 1, -1)
            signs = np.array([(-1) ** (d - i) * math.comb(d, i) for i in range(d + 1)], dtype=float)
            lead = np.abs(array @ signs).reshape(len(values), -1).max(axis=1)  # of u^d
            # u^d less its best approximation of a lower degree is below 2^(1 - 2 d) on [0, 1]
            if not (lead * 2.0 ** (1 - 2 * d) <= 64 * EPS * 4**d * size).all():
                break
            array, error = _lower_degree(array, d)
            values = np.moveaxis(array, -1, axis + 1).reshape(len(values), -1)
            shape[axis] = d
            radius += error
            d -= 1
    return Family(tuple(shape), values, radius, f.exponents, f.scale)


def _lower_degree(array: FloatArray, d: int) -> tuple[FloatArray, FloatArray]:
    """Bernstein coefficients of degree d - 1 for those of degree d, and a bound of the difference."""
    raise_ = np.zeros((d + 1, d))
    for i in range(d):
        raise_[i, i] = (d - i) / d
        raise_[i + 1, i] = (i + 1) / d
    lower = np.linalg.pinv(raise_)
    new = array @ lower.T
    left = np.abs(array - new @ raise_.T).reshape(len(array), -1).max(axis=1)
    size = np.abs(array).reshape(len(array), -1).max(axis=1) + np.abs(new).reshape(len(array), -1).max(axis=1)
    return new, left + 8 * d * EPS * size  # two products a node, whose rounding hides the rest of `left`


@lru_cache(maxsize=64)
def _powers(degree: int) -> tuple[Any, FloatArray]:
    """i and C(degree, i), i = 0 .. degree."""
    i = np.arange(degree + 1)
    return i, np.array([math.comb(degree, int(k)) for k in i], dtype=float)


def basis(degree: int, u: FloatArray) -> FloatArray:
    """Bernstein polynomials at u: ... x (degree + 1)."""
    i, binomial = _powers(degree)
    u = np.asarray(u)[..., None]
    return np.asarray(binomial * u**i * (1 - u) ** (degree - i))


def restriction(degree: int, low: FloatArray, high: FloatArray) -> FloatArray:
    """Matrices from Bernstein coefficients over [0, 1] to those over [low, high]: cells x (d + 1) x (d + 1), all >= 0.

    Row i holds the blossom at (d - i) times low and i times high.
    """
    if degree <= MAX_PRODUCT_DEGREE:
        j, rest, k, left, weights = _blossoms(degree)
        powers = [np.power(x[:, None], np.arange(degree + 1)) for x in (low, 1 - low, high, 1 - high)]
        terms = powers[0][:, j] * powers[1][:, rest] * powers[2][:, k] * powers[3][:, left]
        return np.asarray((terms @ weights).reshape(-1, degree + 1, degree + 1))
    M = np.zeros((len(low), degree + 1, degree + 1))
    for i in range(degree + 1):
        a, b = basis(degree - i, low), basis(i, high)
        for j in range(degree - i + 1):
            M[:, i, j : j + i + 1] += a[:, j, None] * b
    return M


@lru_cache(maxsize=MAX_PRODUCT_DEGREE + 1)
def _blossoms(degree: int) -> tuple[Any, ...]:
    """Powers of low, 1 - low, high, 1 - high in each term, and the terms' weights in each entry: terms x entries."""
    terms = [(i, j, k) for i in range(degree + 1) for j in range(degree - i + 1) for k in range(i + 1)]
    i, j, k = np.array(terms).T
    weights = np.zeros((len(terms), (degree + 1) ** 2))
    for n, (row, a, b) in enumerate(terms):
        weights[n, row * (degree + 1) + a + b] = math.comb(degree - row, a) * math.comb(row, b)
    return j, degree - i - j, k, i - k, weights


def restriction_rounding(shape: Sequence[int]) -> float:
    """A bound of the rounding of `restrict`, relative to the largest value.

    Along a parameter of degree d an entry of the matrix takes 4 powers (a digit each, and d halves of one from 1 - x),
    3 products and a sum of d + 1 terms, all above zero; the product with the values, convex combinations, takes d + 1
    more. Degree 1 takes no powers: half a digit of 1 - x, two products and a sum.
    """
    return EPS * sum(2 if n == 2 else 3 * n + 6 for n in shape if n > 1)


def restrict(values: Any, shape: tuple[int, ...], boxes: FloatArray) -> Any:
    """Bernstein coefficients (cells x nodes) over [0, 1]^P, restricted to the box of each cell (cells x P x 2)."""
    cells, before = len(values), 1
    for axis, count in enumerate(shape):
        low, high = boxes[:, axis, 0], boxes[:, axis, 1]
        if count > 1 and not ((low == 0).all() and (high == 1).all()):
            M = restriction(count - 1, low, high)
            array = values.reshape(cells, before, count, -1)
            if array.shape[3] >= MIN_NODES_IN_PLACE:  # wide enough to multiply in place
                flat = np.ascontiguousarray(array).view(float)
                values = (M[:, None] @ flat).view(values.dtype)
            else:
                flat = array.swapaxes(2, 3).reshape(cells, -1, count) @ M.swapaxes(1, 2)
                values = flat.reshape(cells, before, -1, count).swapaxes(2, 3)
            values = values.reshape(cells, -1)
        before *= count
    return values
