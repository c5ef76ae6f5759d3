"""A few axes as double integrators under their share of a compensator: determinants and adjugates over a box.

A group's sampled loop has q+ = q + T q' + T^2 / 2 (a + k q), q'+ = q' + T (a + k q), a+ = b v. The b_i and the k_i are
monomials of p, each the factor of a matrix of rank one in M0 = z - A0: its determinant and its adjugate are affine in
each, so sums over subsets of them. The terms are computed once; a box of p changes their weights alone. Polynomials in
g = z - 1 are mapped to v as in characteristic.py.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb, arb_mat, fmpq, fmpq_mat

from malta.arrays import FloatArray
from malta.linear.expressions import exact
from malta.linear.uncertain import Compensator
from malta.proof.groups import rational
from malta.proof.polynomial.characteristic import bilinear_table, map_bilinear
from malta.proof.polynomial.enclosure import precision
from malta.proof.polynomial.family import EPS, binary
from malta.proof.weak_coupling.held_currents import HeldMachine, Lead

BITS = 320
MAX_OWN_STIFFNESSES = 2  # axes of a group whose own stiffness is kept


@dataclass(frozen=True, eq=False)
class AxisGroup:
    """A group of axes with its states of the compensator; polynomials of g = z - 1 are mapped to v.

    factors : the b_i, then the k_i other than zero
    subsets : of the factors; a term has those of its subset at their coefficients and the others at zero
    """

    axes: tuple[int, ...]
    own: tuple[int, ...]
    names: tuple[str, ...]
    factors: tuple[Lead, ...]
    determinants: tuple[list[Any], ...]  # exact
    adjugates: FloatArray  # subsets x K x states x states, over 2^heights
    slack: FloatArray  # bounds of their errors
    heights: tuple[int, ...]

    @property
    def inverted(self) -> tuple[bool, ...]:
        return (False,) * len(self.names)

    @cached_property
    def powers(self) -> list[tuple[int, ...]]:
        """The monomial of p that multiplies the term of each subset, with denominators cleared."""
        found = []
        for chosen in itertools.product((0, 1), repeat=len(self.factors)):
            total = [0] * len(self.names)
            for factor, inside in zip(self.factors, chosen, strict=True):
                for k, e in enumerate(factor.monomial):
                    total[k] += max(e, 0) if inside else max(-e, 0)
            found.append(tuple(total))
        return found

    @cached_property
    def degrees(self) -> tuple[int, ...]:
        return tuple(max(row[k] for row in self.powers) for k in range(len(self.names)))

    def degrees_over(self, sides: FloatArray) -> tuple[int, ...]:
        """The degrees over a box: zero along a side without width."""
        return tuple(d if low < high else 0 for d, (low, high) in zip(self.degrees, sides, strict=True))

    def values_at(self, p: FloatArray) -> tuple[float, ...]:
        """The values of the factors at p, rounded."""
        return tuple(float(x.coefficient * np.prod(p ** np.array(x.monomial))) for x in self.factors)

    def at(self, v: Sequence[Any]) -> list[Any]:
        """Coefficients of the determinant at exact p."""
        total = [arb(0)] * len(self.determinants[0])
        for power, a in zip(self.powers, self.determinants, strict=True):
            weight = fmpq(1)
            for x, e in zip(v, power, strict=True):
                weight *= x**e
            total = [t + weight * c for t, c in zip(total, a, strict=True)]
        return total

    def over(self, sides: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The determinant and the adjugate over a box, with denominators cleared, and bounds of their errors.

        K x nodes and K; K x states x states x nodes and K x states x states, over 2^heights.
        """
        degrees = self.degrees_over(sides)
        weights = _bernstein(self.powers, degrees, sides)  # subsets x nodes
        sizes = _bernstein(self.powers, degrees, np.abs(sides))
        determinant, slack = _doubles(self.determinants, self.heights)
        values = determinant.T @ weights
        radius = (slack.T @ sizes + 64 * EPS * (np.abs(determinant).T @ sizes)).max(axis=1)
        N = np.tensordot(self.adjugates, weights, axes=(0, 0))
        slack = 64 * EPS * np.abs(self.adjugates) + 2 * self.slack
        return values, radius, N, np.tensordot(slack, sizes, axes=(0, 0)).max(axis=3)


def members_of(g: AxisGroup, n: int) -> list[int]:
    """The indices of a group's states among all: positions, rates, accelerations, states of the compensator."""
    return [*(k * n + i for k in range(3) for i in g.axes), *(3 * n + k for k in g.own)]


def stiff_axes(machine: HeldMachine, axes: Sequence[int]) -> tuple[int, ...]:
    """The axes of a group whose k_i is other than zero and is kept: subsets of large groups would be many."""
    return tuple(i for i in axes if machine.stiff[i].coefficient) if len(axes) <= MAX_OWN_STIFFNESSES else ()


def state_matrix(
    law: Compensator, axes: Sequence[int], own: Sequence[int], b: Sequence[Any], k: Sequence[Any] = ()
) -> FloatArray:
    """The state matrix A0 of a group at values of b and of k, which is zero if not given."""
    r, T = len(axes), float(law.sample_time or 0)
    A = np.zeros((3 * r + len(own),) * 2)
    eye = np.eye(r)
    A[:r, :r], A[:r, r : 2 * r], A[:r, 2 * r : 3 * r] = eye, T * eye, T**2 / 2 * eye
    A[r : 2 * r, r : 2 * r], A[r : 2 * r, 2 * r : 3 * r] = eye, T * eye
    if len(k):
        A[:r, :r] += T**2 / 2 * np.diag(k)
        A[r : 2 * r, :r] += T * np.diag(k)
    A[2 * r : 3 * r, :r] = np.array(b)[:, None] * law.D[np.ix_(axes, axes)]
    A[2 * r : 3 * r, 3 * r :] = np.array(b)[:, None] * law.C[np.ix_(axes, own)]
    A[3 * r :, :r] = law.B[np.ix_(own, axes)]
    A[3 * r :, 3 * r :] = law.A[np.ix_(own, own)]
    return A


def axes_of(machine: HeldMachine, law: Compensator, axes: tuple[int, ...], own: tuple[int, ...]) -> AxisGroup:
    """Determinants and adjugates of a group, for every subset of its b and k."""
    vertices, stiff = [], stiff_axes(machine, axes)
    factors = tuple(machine.lead[i] for i in axes) + tuple(machine.stiff[i] for i in stiff)
    chosen = list(itertools.product((0, 1), repeat=len(factors)))
    with precision(BITS):
        for on in chosen:
            c = [factor.coefficient if x else 0.0 for factor, x in zip(factors, on, strict=True)]
            k = dict(zip(stiff, c[len(axes) :], strict=True))
            vertices.append(_adjugate(_exact(law, axes, own, c, k)))
        count = len(vertices[0][0])
        determinants: list[list[Any]] = []
        adjugates: list[list[Any]] = []
        for on in chosen:
            f, N = [arb(0)] * count, [0 * m for m in vertices[0][1]]
            for other, (a, R) in zip(chosen, vertices, strict=True):
                if any(y > x for x, y in zip(on, other, strict=True)):
                    continue
                sign = (-1) ** (sum(on) - sum(other))
                f = [x + sign * y for x, y in zip(f, a, strict=True)]
                N = [x + sign * y for x, y in zip(N, R, strict=True)]
            determinants.append(f)
            adjugates.append(N)
        return AxisGroup(axes, own, machine.names, factors, *_map_terms(determinants, adjugates))


def _exact(
    law: Compensator, axes: Sequence[int], own: Sequence[int], c: Sequence[float], stiff: Mapping[int, float]
) -> Any:
    """A0 - 1 of a group in exact numbers, rounded to balls."""
    r, T = len(axes), exact(float(law.sample_time or 0))
    n = 3 * r + len(own)
    table = [[fmpq(0)] * n for _ in range(n)]
    D, C = rational(law.D[np.ix_(axes, axes)]), rational(law.C[np.ix_(axes, own)])
    B, A = rational(law.B[np.ix_(own, axes)]), rational(law.A[np.ix_(own, own)])
    for i in range(r):
        table[i][r + i], table[i][2 * r + i], table[r + i][2 * r + i] = T, T * T / 2, T
        k = exact(stiff.get(axes[i], 0.0))
        table[i][i], table[r + i][i] = T * T / 2 * k, T * k
        b = exact(c[i])
        table[2 * r + i][:r] = [b * x for x in D[i]]
        table[2 * r + i][3 * r :] = [b * x for x in C[i]]
        table[2 * r + i][2 * r + i] = fmpq(-1)
    for j in range(len(own)):
        table[3 * r + j][:r] = B[j]
        table[3 * r + j][3 * r :] = [x - (j == i) for i, x in enumerate(A[j])]
    return arb_mat(fmpq_mat(table))


def _adjugate(H: Any) -> tuple[list[Any], list[Any]]:
    """det(g - H) and adj(g - H) by powers of g from the lowest on: Faddeev and LeVerrier."""
    n = H.nrows()
    eye = arb_mat([[int(i == j) for j in range(n)] for i in range(n)])
    R, c = [eye], [arb(1)]
    for k in range(1, n + 1):
        moved = H * R[-1]
        c.append(-sum((moved[i, i] for i in range(n)), arb(0)) / k)
        if k < n:
            R.append(moved + c[-1] * eye)
    return c[::-1], R[::-1]


def _map_terms(
    determinants: list[list[Any]], adjugates: list[list[Any]]
) -> tuple[tuple[list[Any], ...], FloatArray, FloatArray, tuple[int, ...]]:
    """The terms mapped from g to v: determinants, adjugates, bounds of their errors, heights."""
    turned = [map_bilinear(f) for f in determinants]
    heights = []
    for k in range(len(turned[0])):
        sizes = [binary(f[k]) for f in turned]
        heights.append(max((math.frexp(m)[1] + e for m, _, e in sizes if m), default=0))
    n = adjugates[0][0].nrows()
    found, slack = np.zeros((2, len(turned), len(heights), n, n))
    for s, N in enumerate(adjugates):
        flat = arb_mat([m.entries() for m in N] + [[arb(0)] * (n * n)])
        rows = bilinear_table(len(heights) - 1) * flat
        for k, height in enumerate(heights):
            values, radii = _doubles([[rows[k, i] for i in range(n * n)]], [height] * (n * n))
            found[s, k], slack[s, k] = values.reshape(n, n), radii.reshape(n, n)
    return tuple(turned), found, slack, tuple(heights)


def _doubles(a: Sequence[list[Any]], heights: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Balls over 2^heights as doubles, and bounds of their errors."""
    values, radii = np.zeros((2, len(a), len(heights)))
    for s, row in enumerate(a):
        for k, (c, height) in enumerate(zip(row, heights, strict=True)):
            m, r, e = binary(c)
            shift = max(min(e - height, 900), -1000)
            values[s, k], radii[s, k] = math.ldexp(m, shift), math.ldexp(r, shift) + 1e-300
    return values, radii


def _bernstein(powers: Sequence[Sequence[int]], degrees: Sequence[int], sides: FloatArray) -> FloatArray:
    """Bernstein coefficients of monomials over a box: monomials x nodes. A side of degree 0 has no width."""
    rows = []
    for power in powers:
        row = np.ones(1)
        for r, d, (low, high) in zip(power, degrees, sides.tolist(), strict=True):
            own = [low**r] if not d else [
                sum(
                    math.comb(i, s) * math.comb(d - i, r - s) * high**s * low ** (r - s)
                    for s in range(max(0, r - d + i), min(i, r) + 1)
                ) / math.comb(d, r)
                for i in range(d + 1)
            ]  # fmt: skip
            row = np.outer(row, own).ravel()
        rows.append(row)
    return np.array(rows)
