"""What a Python user has today for a real parametric margin, on the same loops: each answers with a number.

    gridding       roots at all combinations of some values of each parameter, boxes by bisection
    Monte-Carlo    roots of random loops from ever smaller boxes
    AB13MD         SLICOT's upper bound of mu for 1 x 1 blocks, on a grid of frequencies

The first two only sample: what they report is at best an upper bound. AB13MD's is a lower bound at the frequencies of
its grid, and says nothing between them.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.linear.closed_loops import instability
from malta.linear.open_loops import responses
from malta.linear.uncertain import Compensator, UncertainSystem

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray

Lost = Callable[["FloatArray"], np.ndarray]  # which rows are unstable; deviations in multiples of the box
SHARE = 0.2
MACHINE_MOST = 4.9  # boxes of SHARE: a mass stays above zero


class Problem(NamedTuple):
    """m, K_A, K_D, K_B at 20 % each, without the position as an interval."""

    system: UncertainSystem
    law: Compensator

    def lost(self, rows: FloatArray) -> np.ndarray:
        """Of the machine's exactly sampled loop at z = 0."""
        return instability(self.system, self.law, self.system.nominal * (1 + SHARE * rows)) >= 0


def gridding(lost: Lost, parameters: int, most: float, points: int = 9, bisections: int = 5) -> float:
    """Smallest box with an unstable loop on its grid."""
    grid = np.array(list(itertools.product(np.linspace(-1, 1, points), repeat=parameters)))
    low, high = 0.0, most
    for _ in range(bisections):
        t = (low + high) / 2
        bad = any(lost(t * part).any() for part in np.array_split(grid, 1 + len(grid) // 256))
        low, high = (low, t) if bad else (t, high)
    return high


def monte_carlo(lost: Lost, parameters: int, most: float, batches: Iterable[int]) -> float:
    """The smallest box from which an unstable loop was drawn, in as many batches of these sizes."""
    rng, best = np.random.default_rng(0), most
    for size in batches:
        rows = rng.uniform(-1, 1, (size, parameters))
        found = lost(best * rows)
        if found.any():
            best *= float(np.abs(rows[found]).max(axis=1).min())
    return best


def for_seconds(seconds: float, size: int) -> Iterator[int]:
    """Batches of this size until the time is over."""
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        yield size


def ab13md(matrices: Iterable[ComplexArray], kinds: list[int]) -> float:
    """1 / the largest mu of these M. NaN where SLICOT fails at all of them. kinds: 1 real, 2 complex, of each block."""
    import slycot

    worst, blocks = 0.0, np.ones(len(kinds), int)
    for M in matrices:
        try:
            worst = max(worst, float(slycot.ab13md(M, blocks, np.array(kinds))[0]))
        except slycot.exceptions.SlycotError:
            continue
    return 1 / worst if worst else float("nan")


def machine_modes(problem: Problem, frequencies: int = 300) -> Iterator[list[ComplexArray]]:
    """M of each mode: z = M d, d = diag(reals of size 1) z. N q = -d_m + d_A + d_B with N = m s^2 - k - h."""
    w = np.geomspace(1e-2, 6e4, frequencies)
    P, _, _, F = responses(problem.system, problem.law, problem.system.nominal, w)
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
        yield [*np.einsum("ik,j->kij", np.array(terms) / (free - h), np.array(sides))]


def machine_ab13md(problem: Problem) -> float:
    """The smallest of the modes', which it is asked of one at a time."""
    found = [ab13md(matrices, [1] * len(matrices[0])) for matrices in machine_modes(problem)]
    return float(np.nanmin(found))
