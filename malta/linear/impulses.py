"""Impulse responses of sampled systems and their l1 norms: how far any signal of bounded size moves an output.

    x+ = M x + sum_j e_j w_j,   y = C x + sum_j d_j w_j        w_j the signal in part j of a sample

A signal |w| <= 1 moves y by at most the sum of |C M^k e_j| over all k and j, and its signs are the signal that does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.linear.matrices import balanced_units, covariance, eigenvalues

BLOCK = 128  # samples that one product of matrices gives
MOST_SAMPLES = 2**21  # of a response; what is left then is in its tail
TAIL_SHARE = 1e-6  # of the norm: where a response ends
MOST_AT_ONCE = 2**50  # samples
FIRST_SAMPLES = 1024  # that are looked at one by one, where a bound is all that is asked for
EXCESS = 1e-4  # of a bound, that looking at several samples at once may add
ROUNDING = 1e-13  # of what a response of many samples may lose in each, to rounding


class Impulses(NamedTuple):
    """The response of each output to a unit of the signal in each part of a sample, newest part first: p x parts."""

    values: FloatArray
    tail: FloatArray  # p, at most what older parts add

    @property
    def norms(self) -> FloatArray:
        """The l1 norm of each output, without its tail."""
        return np.asarray(np.abs(self.values).sum(axis=1))


def impulses(M: FloatArray, C: FloatArray, pushed: FloatArray, direct: FloatArray) -> Impulses:
    """The responses of a stable sampled system until what is left no longer counts.

    M : n x n;  C : p x n
    pushed : n x parts, what a unit in each part of a sample leaves in the states, the first part first
    direct : p x parts, what it leaves in outputs of the same sample

    With s^2 the spectral radius, Y = M Y M' / s^2 + E E' and o = C M^N, the sum of |C M^k e_j| over k >= N
    is at most sqrt(parts o Y o' / (1 - s^2)), by Cauchy and Schwarz.

    Raises CheckError for an unstable system.
    """
    M, C, E, Y, gap = _prepare(M, C, pushed)
    rows, power = _powers(C, M, BLOCK)
    (p, parts), found = direct.shape, [direct[:, ::-1]]
    norms, columns, newest, samples = np.abs(direct).sum(axis=1), E, E, BLOCK
    while True:
        block = (rows @ newest).reshape(BLOCK, p, -1, parts).transpose(1, 2, 0, 3).reshape(p, -1)
        norms = norms + np.abs(block).sum(axis=1)
        found.append(block)
        left = C @ power
        tail = _sizes(left, Y) * math.sqrt(parts / gap) + ROUNDING * samples * norms
        if (tail <= TAIL_SHARE * norms).all() or samples >= MOST_SAMPLES or not norms.any():
            return Impulses(np.hstack(found), tail)
        newest = power @ columns
        columns, power, samples = np.hstack([columns, newest]), power @ power, 2 * samples


def l1_bounds(M: FloatArray, C: FloatArray, pushed: FloatArray, direct: FloatArray) -> FloatArray:
    """The l1 norm of each output at most, tail and changes of sign within parts included; p. Arguments as `impulses`.

    Slow responses need few numbers: with o = C M^k and Y_m the sum of M^j E E' M'^j over j < m, the sum of |C M^j e_i|
    over m samples from k on is at most sqrt(parts m o Y_m o'), by Cauchy and Schwarz, and hardly less where the
    response hardly changes in them. m doubles with the samples before k. Where that would add more than EXCESS, as to
    a response that rings fast and long, every sample is looked at.

    Raises CheckError for an unstable system.
    """
    (A, left, E, Y, gap), (p, parts) = _prepare(M, C, pushed), direct.shape
    found, reached = [direct[:, ::-1]], np.abs(direct).sum(axis=1)
    samples, m, step, S, Y_m, most = 0, 1, A, E, E @ E.T, reached
    while ((tail := _sizes(left, Y) * math.sqrt(parts / gap)) > TAIL_SHARE * most).any() and m < MOST_AT_ONCE:
        if (most - reached > EXCESS * most).any():
            every = impulses(M, C, pushed, direct)
            return np.asarray(every.norms + every.tail + [sign_changes(h) for h in every.values])
        if samples >= FIRST_SAMPLES:
            S, Y_m, step, m = S + step @ S, Y_m + step @ Y_m @ step.T, step @ step, 2 * m
        count = max(samples, BLOCK) // m
        rows, power = _powers(left, step, count)
        sums = (rows @ S).reshape(count, p, parts).swapaxes(0, 1).reshape(p, -1)
        reached = reached + np.abs(sums).sum(axis=1)
        if m == 1:
            found.append(sums)
            most = reached
        else:
            most = most + math.sqrt(parts * m) * _sizes(rows, Y_m).reshape(count, p).sum(axis=0)
        left, samples = left @ power, samples + m * count
    most = most * (1 + ROUNDING * min(samples, 1 / gap))
    return np.asarray(most + tail + [sign_changes(h) for h in np.hstack(found)])


def sign_changes(h: FloatArray) -> float:
    """What a response may have beside its parts' means where it changes its sign within one: estimated."""
    turns = np.flatnonzero(h[1:] * h[:-1] < 0)
    return float(np.abs(h[turns]).sum() + np.abs(h[turns + 1]).sum()) / 4


class _Balanced(NamedTuple):
    """A stable sampled system in units of like size, and what bounds its tail."""

    M: FloatArray
    C: FloatArray
    E: FloatArray  # n x parts, newest part first
    Y: FloatArray  # M Y M' / s^2 + E E'
    gap: float  # 1 - s^2


def _prepare(M: FloatArray, C: FloatArray, pushed: FloatArray) -> _Balanced:
    """Balance a system. Raises CheckError for an unstable one."""
    radius = float(np.abs(eigenvalues(M)).max(initial=0.0))
    if not radius < 1:
        raise CheckError(f"an unstable loop, |lambda| = {radius:.6f}, moves without limit")
    t = balanced_units(M, pushed, C)
    M, C, E = M * t / t[:, None], C * t, pushed[:, ::-1] / t[:, None]
    radius = max(radius, 0.25)
    return _Balanced(M, C, E, covariance(M / math.sqrt(radius), E @ E.T), 1 - radius)


def _powers(C: FloatArray, M: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """C, C M, C M^2, ... one below the other, count of them, a power of two; and M^count."""
    rows, power = C, M
    while len(rows) < count * len(C):
        rows, power = np.vstack([rows, rows @ power]), power @ power
    return rows, power


def _sizes(rows: FloatArray, Y: FloatArray) -> FloatArray:
    """sqrt(o Y o') of each row o."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", rows @ Y, rows).clip(0)))
