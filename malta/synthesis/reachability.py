"""Why a linear model has no stabilizing controller, in words: modes that nothing moves or sees, zeros, slow samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.linear.matrices import system_matrix
from malta.model.linearize import LinearModel
from malta.synthesis.design_models import between_samples
from malta.synthesis.regulators import integrals_of
from malta.synthesis.weighting import Weights

SINGULAR_SIZE = (
    1e-10  # of [pole I - A, B] on scales that balance A, in units of A: a smaller one is out of reach
)
SHARE = 0.1  # of its largest entry: a state with more of it carries a mode
LONG_SAMPLE_GROWTH = 1.0  # a sample in which an unstable mode grows by e or more


class LostMode(NamedTuple):
    """A mode that is not stable and that inputs do not move.

    pole : rad/s
    states : of A that carry it, by index
    """

    pole: complex
    states: tuple[int, ...]


def lost_modes(A: FloatArray, B: FloatArray) -> list[LostMode]:
    """The modes of x' = A x + B u that are not stable and that u does not move: rank [pole I - A, B] < n (Hautus).

    A' and C' in place of A and B give the modes that y = C x does not see.
    """
    balanced, (scale, _) = linalg.matrix_balance(A, permute=False, separate=True)
    size = float(np.abs(balanced).max()) or 1.0
    pushed = B / scale[:, None]
    columns = np.linalg.norm(pushed, axis=0)
    pushed = pushed * np.divide(size, columns, out=np.zeros_like(columns), where=columns > 0)
    found: list[LostMode] = []
    for pole in linalg.eigvals(balanced):
        if pole.imag < 0 or pole.real < -1e-9 * size:
            continue
        u, s, _ = linalg.svd(np.hstack([pole * np.eye(len(A)) - balanced, pushed]))
        if s[-1] < SINGULAR_SIZE * size and all(abs(pole - one.pole) > 1e-6 * size for one in found):
            found.append(LostMode(complex(pole), _carriers(u[:, -1])))
    return found


def _carriers(vector: ComplexArray) -> tuple[int, ...]:
    size = np.abs(vector)
    return tuple(int(i) for i in np.flatnonzero(size > SHARE * size.max()))


def obstacle(model: LinearModel, weights: Weights, Ts: float) -> str:
    """Why no controller of this model stabilizes it, in one sentence; "" where none of these reasons holds.

    Ts : sample time, s
    """
    A = between_samples(model).A
    states = [s.name for s in model.plant.design_states]
    reason = out_of_reach(A, model.B, model.C, states)
    if reason:
        return reason
    outputs = [s.name for s in model.plant.outputs]
    summed = integrals_of(model, weights).outputs
    if summed and _rank_at_rest(A, model.B, model.C[summed]) < len(A) + len(summed):
        forces, names = " ".join(s.name for s in model.plant.inputs), " ".join(outputs[k] for k in summed)
        return (
            f"{forces} cannot hold {names} at rest, each at a reference of its own (a zero at s = 0): "
            "weights.integral needs to be 0 of outputs that cannot be held beside the others"
        )
    if weights.drift_variance.size and _rank_at_rest(A, model.B, model.C) < len(A) + model.B.shape[1]:
        return (
            f"{' '.join(outputs)} do not tell the disturbances of the forces from each other at rest: "
            "leave out noise.drift, and take integrals"
        )
    fastest = float(linalg.eigvals(A).real.max())
    if fastest * Ts > LONG_SAMPLE_GROWTH:
        return (
            f"the sample time of {Ts:.4g} s is too long for the unstable pole at {fastest:.4g} rad/s, which grows "
            f"{math.exp(min(fastest * Ts, 700)):.3g}-fold in it: at most about {0.3 / fastest:.1g} s"
        )
    return ""


def out_of_reach(A: FloatArray, B: FloatArray, C: FloatArray, states: Sequence[str]) -> str:
    """A mode that is not stable and that no input moves, or no output sees, in one sentence; "" without one."""
    for mode in lost_modes(A, B):
        return f"no force moves the mode {_mode_text(mode, states)}: a force that acts on it is missing"
    for mode in lost_modes(A.T, C.T):
        return f"no sensor sees the mode {_mode_text(mode, states)}: a measurement of it is missing"
    return ""


def _mode_text(mode: LostMode, states: Sequence[str]) -> str:
    """Of a mode: its pole or frequency, and its states."""
    size = abs(mode.pole)
    kind = (
        f"at {size:.4g} rad/s"
        if mode.pole.imag or size < 1e-6
        else f"with the pole {mode.pole.real:.4g} rad/s"
    )
    return f"{kind} of {' '.join(states[i] for i in mode.states)}, which is not stable"


def _rank_at_rest(A: FloatArray, B: FloatArray, C: FloatArray) -> int:
    """The rank of [A B; C 0], rows and columns scaled to 1."""
    system = system_matrix(A, B, C)
    for axis in (1, 0, 1):
        size = np.linalg.norm(system, axis=axis, keepdims=True)
        system = system / np.where(size > 0, size, 1.0)
    return int(np.linalg.matrix_rank(system, tol=1e-10))
