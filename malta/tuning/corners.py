"""The sampled machine at the corners of its box of parameters, and where each corner of the growing box is lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.synthesis.controller import LinearLaw

    Indices = NDArray[np.int_]

STEP = 0.15  # of the multiples of the box at which the machine is sampled; linear between them
NEAR = 1.3  # times the smallest margin, beyond which no corner is looked at


@dataclass(frozen=True, eq=False)
class SampledMachine:
    """Sampled machines with hold, delay and current loops; leading axes are corners of the box."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray

    def close(self, F: LinearLaw) -> FloatArray:
        """Close the loops with a law, without its references."""
        n, k = self.Ad.shape[-1], len(F.A)
        M = np.zeros((*self.Ad.shape[:-2], n + k, n + k))
        M[..., :n, :n], M[..., :n, n:] = self.Ad + self.Bd @ F.D_y @ self.Cd, self.Bd @ F.C
        M[..., n:, :n], M[..., n:, n:] = F.B_y @ self.Cd, F.A
        return M


def corner_margins(table: SampledMachine, F: LinearLaw) -> FloatArray:
    """Multiples of the box at which each corner becomes unstable, by bisection; at most NEAR times the smallest."""
    every = np.arange(table.Ad.shape[1])
    top = STEP * (len(table.Ad) - 1)
    smallest = _first_lost(table, F, every, (0.0, top), 13)
    far = min(max(NEAR * smallest, STEP), top)
    found = np.full(len(every), far)
    low, high = np.full(len(every), smallest), found.copy()
    near = every[_lost(table, F, every, far)]
    for _ in range(9 if len(near) else 0):  # all that are near at once, each between its own bounds
        t = (low[near] + high[near]) / 2
        lost = _lost(table, F, near, t)
        high[near[lost]], low[near[~lost]] = t[lost], t[~lost]
    found[near] = low[near]
    return found


def _first_lost(
    table: SampledMachine, F: LinearLaw, which: Indices, between: tuple[float, float], halvings: int
) -> float:
    """Where the first of some corners is lost, a multiple of the box."""
    low, high = between
    for _ in range(halvings):
        t = (low + high) / 2
        lost = _lost(table, F, which, t)
        if lost.any():
            high, which = t, which[lost]  # the others are lost later
        else:
            low = t
    return low


def _lost(table: SampledMachine, F: LinearLaw, which: Indices, t: float | FloatArray) -> NDArray[np.bool_]:
    """Which of some corners are unstable at t times the box, one t for all or one each."""
    t = np.broadcast_to(np.asarray(t), which.shape)
    k = np.minimum((t / STEP).astype(int), len(table.Ad) - 2)
    share = (t / STEP - k)[:, None, None]
    between = SampledMachine(
        *((1 - share) * M[k, which] + share * M[k + 1, which] for M in (table.Ad, table.Bd, table.Cd))
    )
    lost: NDArray[np.bool_] = np.abs(np.linalg.eigvals(between.close(F))).max(axis=1) >= 1
    return lost
