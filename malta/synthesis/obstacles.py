"""Why a linear model has no stabilizing controller, in words: modes that nothing moves or sees, zeros, slow samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import linalg

from malta.synthesis.sampled import held

if TYPE_CHECKING:
    from malta.model.linearize import LinearModel
    from malta.model.plant import ComplexArray, FloatArray
    from malta.synthesis.spec import Weights

SINGULAR = 1e-10  # of [pole I - A, B] on scales that balance A, in units of A: a mode below is out of reach
SHARE = 0.1  # of its largest entry: a state with more of it carries a mode
LONG = 1.0  # a sample in which an unstable mode grows by e or more


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
        if s[-1] < SINGULAR * size and all(abs(pole - one.pole) > 1e-6 * size for one in found):
            found.append(LostMode(complex(pole), _carriers(u[:, -1])))
    return found


def _carriers(vector: ComplexArray) -> tuple[int, ...]:
    size = np.abs(vector)
    return tuple(int(i) for i in np.flatnonzero(size > SHARE * size.max()))


def obstacle(model: LinearModel, weights: Weights, Ts: float) -> str:
    """Why no controller of this model stabilizes it, in one sentence; "" where none of these reasons holds.

    Ts : sample time, s
    """
    A = held(model).A
    states = [s.name for s in model.plant.design_states]
    for mode in lost_modes(A, model.B):
        return f"no force moves the mode {_mode_text(mode, states)}: a force that acts on it is missing"
    for mode in lost_modes(A.T, model.C.T):
        return f"no sensor sees the mode {_mode_text(mode, states)}: a measurement of it is missing"
    if weights.q_i.any() and _is_blocked_at_rest(A, model.B, model.C):
        return "forces cannot move all outputs at rest (a zero at s = 0): the integrals need weights of 0"
    fastest = float(linalg.eigvals(A).real.max())
    if fastest * Ts > LONG:
        return (
            f"the sample time of {Ts:.4g} s is too long for the unstable pole at {fastest:.4g} rad/s, which grows "
            f"{math.exp(min(fastest * Ts, 700)):.3g}-fold in it: at most about {0.3 / fastest:.1g} s"
        )
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


def _is_blocked_at_rest(A: FloatArray, B: FloatArray, C: FloatArray) -> bool:
    """Whether [A B; C 0] has less than full row rank, rows and columns scaled to 1."""
    system = np.block([[A, B], [C, np.zeros((len(C), B.shape[1]))]])
    for axis in (1, 0, 1):
        size = np.linalg.norm(system, axis=axis, keepdims=True)
        system = system / np.where(size > 0, size, 1.0)
    return bool(np.linalg.matrix_rank(system, tol=1e-10) < len(system))
