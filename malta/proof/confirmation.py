"""Witnesses confirmed by the poles of the loop, and the share of each parameter in them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError
from malta.proof.exclusion.witness import Zero, gradients
from malta.proof.loss import corner_of
from malta.proof.weak_coupling.weak_coupling import HeldLoop

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.box import Box
    from malta.proof.box_parts import Part
    from malta.proof.loss import Loss
    from malta.proof.problem import Problem

BISECTIONS = 16  # of the way to a witness
COARSE = 1e-5  # how far beyond a zero, relative, the poles may become unstable without a bisection


def confirm(problem: Problem, box: Box, zero: Zero, part: Part) -> Loss | None:
    """The t, frequency and p just beyond a zero at which the poles are unstable; None where they stay stable."""
    p = part.growth.parameters(zero.u)
    w = problem.physical(zero.frequency(part.family))
    stable = 1.0
    for share in 1 + 10.0 ** np.arange(-9, -0.9, 0.5):
        there = box.stretch(p, share)
        if _is_unstable(problem, there):
            if isinstance(problem, HeldLoop):  # the zero is that of uncoupled axes
                p = corner_of(problem, box, there)
                there = box.stretch(p, _first_unstable(problem, box, p, 0.95, 1.0))
                return float(box.margin(there)), w, there
            if share > 1 + COARSE:  # a double zero, which is found to the root of rounding
                share = _first_unstable(problem, box, p, stable, float(share))
                there = box.stretch(p, share)
            return float(zero.t * share), w, there
        stable = float(share)
    return None


def _first_unstable(problem: Problem, box: Box, p: FloatArray, low: float, high: float) -> float:
    """The share of the way to p, between low and high, from which on the loop is unstable: bisected."""
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if _is_unstable(problem, box.stretch(p, middle)) else (middle, high)
    return high


def _is_unstable(problem: Problem, p: FloatArray) -> bool:
    """Whether the poles at p are unstable; False where the loop has no poles there."""
    try:
        return bool(problem.instability(p[None])[0] > 0)
    except (CheckError, np.linalg.LinAlgError):
        return False


def contributions(zero: Zero, part: Part, names: tuple[str, ...]) -> dict[str, float]:
    """The share of each parameter in reaching the boundary: d ln(margin) = -sum of share x d ln(range).

    Along f(jw, p) = 0 the margin moves by Im(conj(f_w) f_p dp); at the witness all parameters pull the same way.
    """
    g = part.growth
    p = g.parameters(zero.u)
    moved = np.where(g.grows, p - g.nominal, 0)
    by_u, by_x = gradients(part.family, zero)
    slope = g.slopes(zero.u)
    pulls = by_u / np.where(slope == 0, 1, slope) * moved
    size = pulls.real if zero.x == 0 else (np.conj(by_x) * pulls).imag
    total = size.sum()
    used = [i for i in range(len(p)) if abs(moved[i]) > 1e-9 * abs(p[i]) and size[i] != 0]
    return {names[i]: float(size[i] / total) for i in used} if total else {}
