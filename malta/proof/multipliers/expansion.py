"""Matrices over a box of parameters to first order: M(p) = M_0 + sum_i delta_i M_i + rest, with |delta_i| <= 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

EPS = 2.0**-52


@dataclass(frozen=True, eq=False)
class Expansion:
    """The value in the middle of the box, slopes per half side, and an entrywise bound of the error with rounding."""

    middle: FloatArray  # n x m
    slopes: FloatArray  # P x n x m
    rest: FloatArray  # n x m

    @property
    def size(self) -> FloatArray:
        return np.asarray(np.abs(self.middle) + np.abs(self.slopes).sum(axis=0))

    def __add__(self, other: Expansion) -> Expansion:
        rest = self.rest + other.rest + 2 * EPS * (self.size + other.size)
        return Expansion(self.middle + other.middle, self.slopes + other.slopes, rest)

    def times(self, a: float) -> Expansion:
        rest = abs(a) * (self.rest + 2 * EPS * self.size)
        return Expansion(a * self.middle, a * self.slopes, rest * (1 + 4 * EPS))

    def columns(self, gains: FloatArray) -> Expansion:
        """The product with a constant matrix from the right."""
        rest = (self.rest + 4 * (len(gains) + 1) * EPS * self.size) @ np.abs(gains)
        return Expansion(self.middle @ gains, self.slopes @ gains, rest * (1 + 1e-12))

    def part(self, rows: slice, columns: slice) -> Expansion:
        return Expansion(self.middle[rows, columns], self.slopes[:, rows, columns], self.rest[rows, columns])


def constant(matrix: FloatArray, count: int) -> Expansion:
    """A matrix that depends on none of `count` parameters."""
    return Expansion(matrix, np.zeros((count, *matrix.shape)), np.zeros(matrix.shape))


def stack(rows: Sequence[Sequence[Expansion]]) -> Expansion:
    """A matrix from rows of blocks."""
    return Expansion(
        np.vstack([np.hstack([part.middle for part in row]) for row in rows]),
        np.concatenate([np.concatenate([part.slopes for part in row], axis=2) for row in rows], axis=1),
        np.vstack([np.hstack([part.rest for part in row]) for row in rows]),
    )


@dataclass(frozen=True, eq=False)
class Table:
    """A matrix of polynomials in p: monomials, each with its place."""

    shape: tuple[int, int]
    places: Any  # row and column
    powers: Any
    gains: FloatArray

    def over(self, c: FloatArray, r: FloatArray) -> Expansion:
        """The expansion on |p - c| <= r."""
        e, count = self.powers, len(c)
        each = np.where(e > 0, c, 1.0) ** e
        middle = self.gains * each.prod(axis=1)
        size = np.abs(self.gains) * (np.where(e > 0, np.abs(c) + r, 1.0) ** e).prod(axis=1)
        slopes, linear = np.zeros((count, *self.shape)), np.abs(middle)
        for i in range(count):
            if r[i] > 0 and (e[:, i] > 0).any():
                rest = np.delete(each, i, axis=1).prod(axis=1)
                own = self.gains * rest * e[:, i] * c[i] ** np.maximum(e[:, i] - 1, 0) * r[i]
                slopes[i] = self._sum_terms(own)
                linear = linear + np.abs(own)
        # (|c| + r)^e less its value and slopes: terms of second order, none of them negative
        beyond = np.where(e.sum(axis=1) > 1, np.maximum(size - linear, 0), 0)
        rounding = 8 * (count + int(e.max(initial=1)) + 4) * EPS * size
        return Expansion(self._sum_terms(middle), slopes, self._sum_terms(beyond + rounding))

    def _sum_terms(self, values: FloatArray) -> FloatArray:
        found = np.zeros(self.shape)
        np.add.at(found, (self.places[:, 0], self.places[:, 1]), values)
        return found


def table(shape: tuple[int, int], entries: dict[tuple[int, int], Any], count: int) -> Table:
    """The table of polynomials over the rationals in the first `count` of their variables."""
    places, powers, gains = [], [], []
    for at, polynomial in entries.items():
        for monomial, gain in polynomial.to_dict().items():
            places.append(at)
            powers.append([int(k) for k in monomial[:count]])
            gains.append(int(gain.p) / int(gain.q))
    k = len(gains)
    return Table(
        shape,
        np.array(places, dtype=int).reshape(k, 2),
        np.array(powers, dtype=int).reshape(k, count),
        np.array(gains, dtype=float),
    )
