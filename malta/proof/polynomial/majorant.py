"""Upper bounds of the coefficients of det(g + A) from bounds of |A| alone.

With column scales d and any rho > 0, |a_k| rho^k is at most the product of the row sums of (rho I + |A|) d / d_i. The
scales are found for each rho by balancing, and each k takes the rho that suits it best: a determinant whose entries
and roots spread over decades is bounded to a few bits for each row, where one scaling for all k loses dozens.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import arb

from malta.proof.expressions import NotAnalytic

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

ROUNDS = 20
SAFE = 1 + 1e-9


def coefficient_bounds(m: FloatArray, roots: FloatArray) -> list[Any]:
    """Bounds of a_0, a_1, ... of det(g diag(roots) + M), roots 0 or 1 in each row, from m >= |M|: exact powers of two.

    Raises NotAnalytic where numbers overflow.
    """
    return all_bounds(m[None], roots)[0]


def all_bounds(m: FloatArray, roots: FloatArray) -> list[list[Any]]:
    """`coefficient_bounds` of several matrices: rows x n x n."""
    if not np.isfinite(m).all():
        raise NotAnalytic("numbers that overflow")
    count, n = int(roots.sum()), m.shape[1]
    low = np.log2(np.where(m > 0, m, np.inf).min(axis=(1, 2), initial=1.0)) - 2
    high = np.log2(m.max(axis=(1, 2), initial=1.0)) + 3 + math.log2(max(n, 1))
    rho = np.exp2(np.linspace(np.maximum(low, -400), np.minimum(high, 400), 28, axis=1))
    full = m[:, None] + rho[:, :, None, None] * np.diag(roots)
    heights = _heights(full.reshape(-1, n, n)).reshape(rho.shape)
    logs = (heights[:, :, None] - np.arange(count + 1) * np.log2(rho)[:, :, None]).min(axis=1)
    return [[power_of_two(x) for x in row] for row in logs.tolist()]


def power_of_two(x: float) -> Any:
    """2^x, from above."""
    if x == -math.inf:
        return arb(0)
    if not math.isfinite(x):
        raise NotAnalytic("numbers that overflow")
    whole = math.floor(x)
    return arb(2.0 ** (x - whole) * SAFE) * arb(2) ** whole


def _heights(full: FloatArray) -> FloatArray:
    """log2 of the product of row sums of F d / d_i, d by Sinkhorn's iteration: rows x n x n -> rows."""
    d = np.ones(full.shape[:2])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(ROUNDS):
            rows = np.einsum("kij,kj->ki", full, d)
            columns = np.einsum("kij,ki->kj", full, 1 / np.where(rows > 0, rows, 1))
            d = 1 / np.where(columns > 0, columns, 1)
        d = np.exp2(np.round(np.log2(np.clip(d, 1e-200, 1e200))))
        rows = np.einsum("kij,kj->ki", full, d)
        heights = np.log2(rows * SAFE).sum(axis=1) - np.log2(d).sum(axis=1)
    return np.where(np.isnan(heights), np.inf, heights)
