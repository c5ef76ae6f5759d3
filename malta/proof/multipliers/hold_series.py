"""Matrix functions of a hold over a box of parameters, by power series: value, slopes, and a bound of what is left.

With Y = T A, x+ - x = Phi_1(Y) T (A x + B u), so that multiplied by Y / (e^Y - 1) = 1 - Y / 2 + c(Y) the sampled loop
holds A and B as they stand, and only c(Y) = Y^2 / 12 - Y^4 / 720 + ... is curved. Close to it is a continued fraction,

    c = z^2 / (3 + z^2 / (5 + z^2 / (7 + ...))),    z = Y / 2,

of which pencils hold the first levels by rows of their own. Where Y is too large for that series, e^Y itself is
expanded. Beyond first order a function of Y_0 + E with coefficients b_k is bounded by the same function
of moduli: f(|Y_0| + |E|) - f(|Y_0|) - f'(|Y_0|) |E|, with |b_k|.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg

from malta.proof.multipliers.expansion import EPS, Expansion, stack

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

BERNOULLI = 36  # terms of c
LEVELS = 3  # of the fraction: up to these, its coefficients have the sign of those of c and are not larger
LARGEST = 4.8  # norm of Y up to which c is taken: its series ends at 2 pi
POWERS = 30  # of a matrix, towards its largest eigenvector
EXPONENTIAL = 80  # terms of e^Y
STEEPEST = 16.0  # norm of Y up to which e^Y is


@lru_cache(maxsize=LEVELS + 1)
def _gains(level: int) -> tuple[float, ...]:
    """Coefficients of c(Y), B_2k / (2 k)!, less those of its fraction, by powers of Y^2 from the first."""
    from flint import fmpq

    held = [fmpq(0)] * (BERNOULLI + 1)
    for k in range(level, 0, -1):  # Y^2 / 4 over 2 k + 1 + held
        inverse = [fmpq(1, 2 * k + 1)]
        for i in range(1, BERNOULLI):
            moved = sum((held[j] * inverse[i - j] for j in range(1, i + 1)), fmpq(0))
            inverse.append(-moved / (2 * k + 1))
        held = [fmpq(0), *(x / 4 for x in inverse)]
    found = []
    for k in range(1, BERNOULLI + 1):
        b = fmpq.bernoulli(2 * k) / math.factorial(2 * k) - held[k]
        found.append(int(b.p) / int(b.q))
    return tuple(found)


def quotient(A: Expansion, dens: Expansion) -> Expansion | None:
    """A over the diagonal of dens; None where that may vanish."""
    d0 = np.diag(dens.middle)[:, None]
    moved = np.diagonal(dens.slopes, axis1=1, axis2=2)[:, :, None]
    beside = np.diag(dens.rest)[:, None]
    share = (np.abs(moved).sum(axis=0) + beside) / np.abs(d0)
    if not (share < 0.98).all():
        return None
    middle = A.middle / d0
    slopes = (A.slopes - middle * moved) / d0
    rest = (A.rest + np.abs(middle) * beside) / np.abs(d0)
    size = np.abs(middle) + (np.abs(A.slopes / d0) + np.abs(middle * moved / d0)).sum(axis=0)
    rest = rest + 8 * EPS * size
    linear = np.abs(slopes).sum(axis=0)
    return Expansion(middle, slopes, (rest + (linear + rest) * share / (1 - share)) * (1 + 1e-12))


def square_hold_series(A: Expansion, dens: Expansion, T: float, *, level: int = 0) -> Expansion | None:
    """dens (1 + c(Y)) 2 + ... = 2 dens + 2 dens c(T A / dens); None where the series does not do.

    level : for c(Y) less its fraction up to this level, and no slopes of it but a bound
    """
    own = quotient(A, dens)
    if own is None:
        return None
    c = _function(own.times(T), _gains(level), LARGEST, even=True)
    if c is None:
        return None
    if level:
        moves = np.abs(c.slopes).sum(axis=0) * (1 + 1e-12)
        c = Expansion(c.middle, np.zeros_like(c.slopes), c.rest + moves)
    d0, moved = np.diag(dens.middle)[:, None], np.diagonal(dens.slopes, axis1=1, axis2=2)[:, :, None]
    beside, wide = np.diag(dens.rest)[:, None], np.abs(moved).sum(axis=0)
    linear = np.abs(c.slopes).sum(axis=0)
    whole = np.abs(c.middle) + linear + c.rest
    rest = (
        np.abs(d0) * c.rest
        + wide * (linear + c.rest)
        + beside * whole
        + 8 * EPS * (np.abs(d0) + wide) * whole
    )
    curved = Expansion(d0 * c.middle, d0 * c.slopes + moved * c.middle, rest)
    return (dens + curved).times(2.0)


def hold_series(A: Expansion, B: Expansion, dens: Expansion, T: float) -> tuple[Expansion, Expansion] | None:
    """e^(A T) - 1 and what u does over a sample, of A / dens and B / dens; None where they are too steep."""
    n, m, count = len(A.middle), B.middle.shape[1], len(A.slopes)
    one, two = quotient(A, dens), quotient(B, dens)
    if one is None or two is None:
        return None
    none = Expansion(np.zeros((m, n + m)), np.zeros((count, m, n + m)), np.zeros((m, n + m)))
    Y = stack([[one, two], [none]]).times(T)
    found = _function(Y, [1 / math.factorial(k) for k in range(1, EXPONENTIAL + 1)], STEEPEST, even=False)
    if found is None:
        return None
    return found.part(slice(0, n), slice(0, n)), found.part(slice(0, n), slice(n, n + m))


def _function(Y: Expansion, b: Sequence[float], largest: float, *, even: bool) -> Expansion | None:
    """sum_k b_k Z^k, k from 1, with Z = Y, or Y^2 where even."""
    extra = np.abs(Y.slopes).sum(axis=0) + Y.rest
    size = np.abs(Y.middle)
    if not np.isfinite(extra + size).all():
        return None
    _, (units, _) = linalg.matrix_balance(size + extra, permute=False, separate=True)
    turn = units / units[:, None]
    size, extra, rest = size * turn, extra * turn, Y.rest * turn
    norm, weights = _norm(size + extra)
    if not norm < largest:
        return None
    middle, slopes = Y.middle * turn, Y.slopes * turn
    value, moved = _sum(middle, slopes, b, even)
    bound, linear = _sum(size, (extra - rest)[None], np.abs(b).tolist(), even)
    whole, _ = _sum(size + extra, np.zeros((0, *size.shape)), np.abs(b).tolist(), even)
    power = norm ** (2 if even else 1)
    ratio = power / (39.0 if even else len(b) + 1)
    last = _gains(0)[-1] if even else b[-1]  # no smaller than with a level
    tail = abs(last) * power ** len(b) * ratio / (1 - ratio)
    rounding = 4 * len(b) * len(size) * EPS * whole
    tails = 2 * tail * weights[:, None] / weights
    left = np.maximum(whole - bound - linear[0], 0) + 4 * rounding + tails
    return Expansion(value / turn, moved / turn, left / turn)


def _norm(M: FloatArray) -> tuple[float, FloatArray]:
    """A norm of M and weights d for which M^k is at most norm^k d_i / d_j: M d <= norm d. M has no negative entries."""
    d: FloatArray = np.ones(len(M))
    shift = float(M.max(initial=0.0)) * np.eye(len(M))
    for _ in range(POWERS):
        d = np.maximum((M + shift) @ d, 1e-3)
        d = d / d.max(initial=1e-3)
    return float((M @ d / d).max(initial=0.0)) * (1 + 1e-12), d


def _sum(Y: FloatArray, slopes: FloatArray, b: Sequence[float], even: bool) -> tuple[FloatArray, FloatArray]:
    """The series at Y, and its derivatives along `slopes`."""
    Z, dZ = (Y @ Y, Y @ slopes + slopes @ Y) if even else (Y, slopes)
    power, moved = Z, dZ
    value, along = b[0] * Z, b[0] * dZ
    for gain in b[1:]:
        moved = moved @ Z + power @ dZ
        power = power @ Z
        value = value + gain * power
        along = along + gain * moved
    return value, along
