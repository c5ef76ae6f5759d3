"""A family along s = jw: Taylor expansions on intervals of frequency, from zero to infinity.

Branch 0 counts x = w / 2^scale, branch 1 its inverse, where f = a(jw) / (w / 2^scale)^n; so [0, x1] of the one and
[0, 1 / x1] of the other cover every frequency. On an interval of middle x0 and half width h

    f(x0 + h t) = b_0 + b_1 t + b_2 t^2 + b_3 t^3 + rest,   -1 <= t <= 1
    |rest| <= sum_k |a_k| C(k, 4) h^4 (x0 + h)^(k - 4)
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.proof.polynomial.family import EPS, Family, restriction_rounding

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

ORDER = 4


class Expansion(NamedTuple):
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


def expand(f: Family, cells: FloatArray, like: Family | None = None) -> Expansion:
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
    return Expansion(tuple(terms), radius + 1e-290, lasting)


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
