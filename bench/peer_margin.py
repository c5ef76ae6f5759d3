"""What a Python user has today for a real parametric margin, on the machine's own loop: each answers with a number.

    gridding       eigenvalues at all combinations of nine values of each parameter, boxes by bisection
    Monte-Carlo    eigenvalues of random machines from ever smaller boxes, for as long as it is given
    AB13MD         SLICOT's upper bound of mu for real 1 x 1 blocks, on a grid of frequencies, one mode at a time

The first two only sample: what they report is at best an upper bound. AB13MD's is a lower bound at the frequencies of
its grid, and says nothing between them. All use the exactly sampled loop at z = 0.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.uncertain import Compensator, UncertainSystem, instability, responses

if TYPE_CHECKING:
    from malta.plant import ComplexArray, FloatArray

SHARE = 0.2
GRID = 9


class Problem(NamedTuple):
    """m, K_A, K_D, K_B at 20 % each, without the position as an interval."""

    system: UncertainSystem
    law: Compensator


def _unstable(problem: Problem, rows: FloatArray) -> bool:
    return bool((instability(problem.system, problem.law, rows) >= 0).any())


def gridding(problem: Problem, bisections: int = 8) -> float:
    """Smallest box with an unstable machine on the grid."""
    signs = np.array(list(itertools.product(np.linspace(-1, 1, GRID), repeat=len(problem.system.names))))
    low, high = 0.0, 4.9
    for _ in range(bisections):
        t = (low + high) / 2
        bad = any(
            _unstable(problem, problem.system.nominal * (1 + t * SHARE * part))
            for part in np.array_split(signs, 26)
        )
        low, high = (low, t) if bad else (t, high)
    return high


def monte_carlo(problem: Problem, seconds: float) -> float:
    """The smallest box from which an unstable machine was drawn, within the time."""
    rng, best, start = np.random.default_rng(0), 4.9, time.perf_counter()
    while time.perf_counter() - start < seconds:
        rows = rng.uniform(-1, 1, (16, len(problem.system.names)))
        found = (
            instability(problem.system, problem.law, problem.system.nominal * (1 + best * SHARE * rows)) >= 0
        )
        if found.any():
            best *= float(np.abs(rows[found]).max(axis=1).min())
    return best


def ab13md(problem: Problem, frequencies: int = 300) -> float:
    """1 / the largest mu over modes and frequencies. NaN where SLICOT fails at every frequency."""
    import slycot

    w = np.geomspace(1e-2, 6e4, frequencies)
    worst, failed = 0.0, 0
    for M in _modes(problem, w):
        blocks = M.shape[1]
        for own in M:
            try:
                mu = slycot.ab13md(own, np.ones(blocks, int), np.ones(blocks, int))[0]
                worst = max(worst, float(mu))
            except Exception:
                failed += 1
    return 1 / worst if worst else float("nan")


def _modes(problem: Problem, w: FloatArray) -> Iterator[ComplexArray]:
    """M of each mode: z = M d, d = diag(reals of size 1) z. N q = -d_m + d_A + d_B with N = m s^2 - k - h."""
    P, F = responses(problem.system, problem.law, problem.system.nominal, w)
    A, _, C = (matrix[0] for matrix in problem.system.at(problem.system.nominal))
    half = len(A) // 2
    to_modes = np.linalg.inv(C[:, :half])
    loop = np.einsum("ij,kjl,lm->kim", to_modes, P @ F, C[:, :half])
    s2 = -(w**2)
    for i in (0, 2, 3):  # x, z, alpha: y and beta are their images
        free = s2 - A[half + i, i]
        h = loop[:, i, i] * free
        terms = [SHARE * h] if i == 2 else [SHARE * A[half + i, i] + 0j * w, SHARE * h]
        sides = [1.0] * len(terms)
        if i != 3:  # the inertia is certain
            terms, sides = [SHARE * s2 + 0j, *terms], [-1.0, *sides]
        yield np.einsum("ik,j->kij", np.array(terms) / (free - h), np.array(sides))
