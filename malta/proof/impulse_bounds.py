"""l1 norms of a sampled loop, enclosed: what any signal of bounded size may move, to the last rounding.

    o_k = c M^k,   |h|_1 = sum over k of |o_k e|        M, c and e known to a radius

Rows are computed in floating point, and the residual of each of them, o_k+1 - o_k M, is a disturbance of the true
rows. A Gramian Y, of which Y - M Y M' / s^2 - 1 is proven to be positive definite, bounds what disturbances do, and the
rows that were not computed: by Cauchy and Schwarz the sum of |o M^k v| is at most sqrt(o Y o' v'v / (1 - s^2)).
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat
from scipy import linalg

from malta.arrays import FloatArray
from malta.linear.matrices import covariance, eigenvalues
from malta.proof.polynomial.closed_loop import hold
from malta.proof.polynomial.enclosure import Unproven

EPS = float(np.finfo(float).eps)
UP = 1 + 1e-9  # covers the rounding of sums of millions of numbers above zero
MOST_SAMPLES = 2**18


class Enclosed(NamedTuple):
    """A matrix in floating point, and how far the true one may be, entry by entry."""

    mid: FloatArray
    rad: FloatArray

    def scale(self, rows: FloatArray | float, columns: FloatArray | float) -> Enclosed:
        """The matrix with rows and columns times powers of two, which is exact."""
        left, right = np.reshape(rows, (-1, 1)), np.reshape(columns, (1, -1))
        return Enclosed(left * self.mid * right, left * self.rad * right)

    def part(self, rows: Any, columns: Any) -> Enclosed:
        """Some rows and columns."""
        return Enclosed(self.mid[np.ix_(rows, columns)], self.rad[np.ix_(rows, columns)])


def enclose(matrix: Any) -> Enclosed:
    """A matrix of real balls."""
    shape, entries = (matrix.nrows(), matrix.ncols()), matrix.entries()
    mid = [float(x.mid()) for x in entries]
    rad = [float(abs(x - arb(m)).upper()) * UP for x, m in zip(entries, mid, strict=True)]
    if not np.isfinite([*mid, *rad]).all():
        raise Unproven("numbers that overflow")
    return Enclosed(np.reshape(mid, shape), np.reshape(rad, shape))


def sizes_of(matrix: Any) -> FloatArray:
    """The largest sizes of the entries of a matrix of balls."""
    found = [float(abs(x).upper()) * UP for x in matrix.entries()]
    return np.reshape(found, (matrix.nrows(), matrix.ncols()))


def reach_of(joins: Any) -> Any:
    """Which rows a column reaches by any way, itself included, of a square matrix of what it reaches at once."""
    found = joins | np.eye(len(joins), dtype=bool)
    while (found != found @ found).any():
        found = found @ found
    return found


def push_in_parts(a: Any, unit: Any, T: float, parts: int) -> tuple[list[Enclosed], FloatArray]:
    """What x' = a x + unit w leaves in x at the end of a sample, of a unit w that is constant in each of its parts.

    Returns it for each part, and by how much any other w within 1 may leave more than its mean in a part.
    """
    left = [hold(arb_mat, a, unit, arb(T) * (parts - k) / parts)[1] for k in range(parts)]
    left.append(0 * left[-1])
    size, d = sizes_of(a), T / parts
    spread = size @ linalg.expm(size * T) @ sizes_of(unit) * (UP * d * d / 4)
    return [enclose(one - two) for one, two in itertools.pairwise(left)], spread


def l1_norms(
    M: Enclosed, rows: Enclosed, E: Enclosed, spread: FloatArray, share: float, *, largest: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Bounds, below and above, of the sums over k >= 0 of |c M^k e| for each row c and each column e.

    largest : of the largest |c M^k e| in place of the sum

    spread : n x columns, by how much columns may differ from e besides, from sample to sample; in the upper bound alone
    share : of a norm, that may be left to the rows that are not computed

    Raises Unproven where the loop is not proven stable.
    """
    radius = float(np.abs(eigenvalues(M.mid)).max(initial=0.0))
    if not radius < 1:
        raise Unproven("the loop is unstable")
    s = max(math.sqrt(radius), 0.5)
    difference = M.mid - np.eye(
        len(M.mid)
    )  # whose balance makes Y a hundred times better conditioned than that of M
    _, (units, _) = linalg.matrix_balance(difference, permute=False, separate=True)  # powers of two
    M, rows, E = M.scale(1 / units, units), rows.scale(1.0, units), E.scale(1 / units, 1.0)
    spread = spread / units[:, None]
    Y, gain = _proven_gramian(M, s), UP / math.sqrt(1 - s * s)
    size = gain * UP * np.sqrt(np.diag(Y))
    length = UP * (np.linalg.norm(E.mid, axis=0) + np.linalg.norm(E.rad + spread, axis=0))
    r, n, power, last = len(rows.mid), len(M.mid), M.mid, rows.mid
    found, sums, norms = last[:, None], np.abs(last), np.abs(last @ E.mid)
    newest = found
    while True:  # rows x samples x n
        newest = found @ power
        power = power @ power
        sums, sizes = sums + np.abs(newest).sum(axis=1), np.abs(newest @ E.mid)
        norms = np.maximum(norms, sizes.max(axis=1)) if largest else norms + sizes.sum(axis=1)
        found = np.concatenate([found, newest], axis=1)
        last = found[:, -1]
        tail = np.einsum("ij,jk,ik->i", last, Y, last).clip(0) + 8 * n * EPS * (np.abs(last) @ size) ** 2
        tail = gain * np.sqrt(tail)
        if (tail[:, None] * length <= share * norms).all() or found.shape[1] >= MOST_SAMPLES:
            break
    if not largest:
        norms -= np.abs(last @ E.mid)  # it begins the tail
    residual = np.abs(found[:, 1:] - found[:, :-1] @ M.mid).sum(axis=1)
    residual += 2 * sums @ ((n + 2) * EPS * (np.abs(M.mid) + np.eye(n)) + M.rad) + rows.rad
    errors = np.outer(residual @ size, length) + sums @ ((n + 2) * EPS * np.abs(E.mid))
    assert errors.shape == (r, E.mid.shape[1])
    upper = norms + errors + sums @ (E.rad + spread) + np.outer(tail, length)
    return np.maximum(norms / UP - errors, 0.0), UP * upper


def _proven_gramian(M: Enclosed, s: float) -> FloatArray:
    """Y with Y - M Y M' / s^2 - 1 positive definite for all of M: the loop is stable, and faster than s.

    Raises Unproven where rounding, or the radius of M, may have made it so.
    """
    n, Y = len(M.mid), covariance(M.mid / s, 2 * np.eye(len(M.mid)))
    Y = (Y + Y.T) / 2
    Z = Y - M.mid @ Y @ M.mid.T / s**2 - np.eye(n)
    m, y, rad = (float(np.linalg.norm(X)) for X in (M.mid, Y, M.rad))
    unsure = 8 * n * EPS * y * (1 + m * m / s**2) + (2 * m * rad + rad * rad) * y / s**2
    unsure += 8 * n * EPS * float(np.linalg.norm(Z))
    if not (np.isfinite(Z).all() and float(np.linalg.eigvalsh((Z + Z.T) / 2).min()) > unsure):
        raise Unproven("rounding hides whether the loop is stable")
    return Y
