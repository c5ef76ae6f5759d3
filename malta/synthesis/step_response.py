"""The answer of a sampled loop to a constant load: s+ = M s + g w, y = C s, w a unit step on one load at a time.

The grid of times is every sample at first, and then coarser by a factor of two from octave to octave: the largest
deviation of a fast mode and the tail of a slow one cost the same few products of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import CheckError
from malta.linear.matrices import system_matrix

BLOCK = 64  # times that one product of matrices gives
BLOCKS = 32  # in an octave
SETTLED_SHARE = 1e-9  # share of the largest deviation: what is left at the end of the grid
MAX_OCTAVES = 44  # octaves at most, where a pole is next to 1


@dataclass(frozen=True, eq=False)
class StepResponse:
    """Outputs after a unit step of each load at t = 0.

    t : s, k times;  y : k x p outputs x w loads;  final : p x w, what y ends at
    """

    t: FloatArray
    y: FloatArray
    final: FloatArray

    def __post_init__(self) -> None:
        for name in ("t", "y", "final"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    def of(self, sizes: FloatArray) -> StepResponse:
        """Return the answer to loads of these sizes at the same time: w numbers, and one load is left."""
        return StepResponse(self.t, (self.y @ sizes)[..., None], (self.final @ sizes)[..., None])

    @property
    def largest(self) -> FloatArray:
        """The largest |y|, p x w."""
        return np.asarray(np.abs(self.y).max(axis=0))

    def left(self, after: float) -> FloatArray:
        """The largest |y| from a time on, s; p x w. A swing through zero at that very time does not hide it."""
        later = self.t >= after * (1 - 1e-12)
        rest = np.abs(self.y[later]).max(axis=0) if later.any() else np.zeros_like(self.final)
        return np.asarray(np.maximum(rest, np.abs(self.final)))

    def within(self, share: float) -> FloatArray:
        """The time, s, from which |y| stays within a share of its largest; p x w, infinite where it never does."""
        bound = share * self.largest
        outside = np.abs(self.y) > bound
        last = len(self.t) - 1 - outside[::-1].argmax(axis=0)
        after = self.t[np.minimum(last + 1, len(self.t) - 1)]
        times = np.where(outside.any(axis=0), after, 0.0)
        return np.where(np.abs(self.final) > bound, math.inf, times)


def step_response(M: FloatArray, g: FloatArray, C: FloatArray, Ts: float) -> StepResponse:
    """Compute the answer of a stable sampled loop to unit steps, until nothing of it changes.

    M : n x n;  g : n x w, what a load that acts throughout a sample leaves in the states;  C : p x n;  Ts : s
    Raises CheckError for a loop that is not stable.

    >>> import numpy as np
    >>> step_response(
    ...     np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), 1e-3
    ... ).final.tolist()
    [[2.0]]
    """
    n, w = g.shape
    radius = float(np.abs(np.linalg.eigvals(M)).max(initial=0.0))
    if not radius < 1:
        raise CheckError(f"an unstable loop, |lambda| = {radius:.6f}, has no answer to a constant load")
    step = system_matrix(M, g, None, np.eye(w))
    out = np.hstack([C, np.zeros((len(C), w))])
    samples = math.log(SETTLED_SHARE) / math.log(max(radius, 1e-3))
    octaves = min(1 + max(math.ceil(math.log2(samples / (BLOCK * BLOCKS))), 0), MAX_OCTAVES)
    state, stride, k = np.vstack([np.zeros((n, w)), np.eye(w)]), 1, 0
    times: list[FloatArray] = []
    found: list[FloatArray] = []
    for octave in range(octaves):
        if octave > 1:
            step, stride = step @ step, 2 * stride
        reading, far = _ahead(out, step)
        for _ in range(BLOCKS):
            found.append((reading @ state).reshape(BLOCK, len(C), w))
            times.append((k + stride * np.arange(BLOCK)) * Ts)
            state, k = far @ state, k + stride * BLOCK
    final = C @ np.linalg.solve(np.eye(n) - M, g)
    return StepResponse(np.concatenate(times), np.concatenate(found), final)


def _ahead(out: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """[C; C M; ...; C M^(BLOCK - 1)] by doubling, and M^BLOCK."""
    rows, power = out, step
    while len(rows) < BLOCK * len(out):
        rows, power = np.vstack([rows, rows @ power]), power @ power
    return rows, power
