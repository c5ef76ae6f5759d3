"""Linear systems sampled exactly: a zero-order hold, inputs that act late, lags, costs and noise of a sample."""

from __future__ import annotations

import math

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.linear.matrices import system_matrix

WHOLE_TOLERANCE = 1e-9  # samples, or share of a delay, that rounding takes from whole samples
MAX_EXPONENTIAL_ENTRY = 1e8  # entry of a matrix whose exponential is taken


def split_delay(delay: float) -> tuple[int, float]:
    """Whole samples of a delay, and the fraction of one that is left; what is within 1e-9 of whole samples is whole."""
    nearest = round(delay)
    if abs(delay - nearest) <= WHOLE_TOLERANCE * max(1.0, abs(delay)):
        return nearest, 0.0
    return math.floor(delay), delay - math.floor(delay)


def whole_or_not(delay: float) -> float:
    """The same delay, an int where it is whole samples."""
    whole, part = split_delay(delay)
    return whole + part if part else whole


def stored_blocks(delay: float) -> int:
    """How many samples of inputs a delay stores: a fraction stores one more than its whole samples."""
    whole, part = split_delay(delay)
    return whole + (part > 0)


def sample(A: FloatArray, B: FloatArray, Ts: float, delay: float = 0) -> tuple[FloatArray, FloatArray]:
    """Zero-order hold: Ad = e^(A Ts), Bd = integral of e^(A s) B over one sample; of a stack of systems each.

    delay : samples by which inputs act late, also a fraction of one; stored inputs follow x, the oldest first
    """
    n, (_, part) = B.shape[-2], split_delay(delay)
    E = _exponential(system_matrix(A, B) * Ts)
    newest = sample(A, B, (1 - part) * Ts)[1] if part else None
    return delay_inputs(E[..., :n, :n], E[..., :n, n:], delay, newest)


def sample_within(
    A: FloatArray, B: FloatArray, Ts: float, delay: float, time: float
) -> tuple[FloatArray, FloatArray]:
    """x at a time after a sample, s, at most Ts: of the states of `sample` and of its inputs."""
    n, m = B.shape
    found = np.zeros((n, n + m * (stored_blocks(delay) + 1)))
    of_states, of_inputs = sample(A, B, time, min(1.0, split_delay(delay)[1] * Ts / time))
    found[:, : of_states.shape[1] + m] = np.hstack([of_states[:n], of_inputs[:n]])
    return found[:, :-m], found[:, -m:]


def delay_inputs(
    Ad: FloatArray, Bd: FloatArray, delay: float, newest: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """The sampled system whose inputs act `delay` samples late; stored inputs follow x, the oldest first.

    newest : with a fraction f, the integral N of e^(A s) B over 1 - f of a sample: x+ = Ad x + (Bd - N) u_d+1 + N u_d
    """
    (n, m), (whole, part) = Bd.shape[-2:], split_delay(delay)
    stored = m * stored_blocks(delay)
    if not stored:
        return Ad, Bd
    A = np.zeros((*Ad.shape[:-2], n + stored, n + stored))
    A[..., :n, :n], A[..., :n, n : n + m] = Ad, Bd
    A[..., n:, n:] = np.eye(stored, k=m)  # each stored input moves up one place
    B = np.zeros((*(Bd.shape[:-2] if part else ()), n + stored, m))
    B[..., -m:, :] = np.eye(m)
    if part:
        assert newest is not None
        A[..., :n, n : n + m] -= newest
        if whole:
            A[..., :n, n + m : n + 2 * m] = newest
        else:
            B[..., :n, :] = newest
    return A, B


def add_lags(A: FloatArray, B: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    """The continuous system whose inputs follow as first-order lags, rate / (s + rate); they are states after x."""
    n, m = B.shape[-2:]
    return system_matrix(A, B, None, -rate * np.eye(m)), np.vstack([np.zeros((n, m)), rate * np.eye(m)])


def sample_cost(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, Ts: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The integral of x'Qx + u'Ru over a sample, u held: Qd, Nd, Rd of x'Qd x + 2 x'Nd u + u'Rd u.

    Van Loan, IEEE Trans. Autom. Control 23(3), 1978; the weights of MATLAB's lqrd.
    """
    n = len(A)
    Wd = sample_noise(system_matrix(A, B).T, linalg.block_diag(Q, R), Ts)
    return Wd[:n, :n], Wd[:n, n:], Wd[n:, n:]


def sample_noise(A: FloatArray, W: FloatArray, Ts: float) -> FloatArray:
    """Covariance that white noise of intensity W leaves in x after one sample (Van Loan).

    The integral of e^(A s) W e^(A' s) over a sample, from one exponential; W counts in its largest entry.
    """
    n, size = len(A), np.abs(W).max() or 1.0
    E = _exponential(system_matrix(-A, W / size, None, A.T) * Ts)
    W = E[n:, n:].T @ E[:n, n:] * size
    return np.asarray((W + W.T) / 2)


def _exponential(M: FloatArray) -> FloatArray:
    """e^M, of a stack of matrices each."""
    with np.errstate(all="ignore"):
        turn = np.ones(M.shape)
        if (
            not np.abs(M).max(initial=0.0) < MAX_EXPONENTIAL_ENTRY and np.isfinite(M).all()
        ):  # units of states?
            if M.ndim > 2:
                return np.array([_exponential(one) for one in M])
            _, (units, _) = linalg.matrix_balance(M, permute=False, separate=True)
            turn = units / units[:, None]
        # e^710 is past the largest float
        E = (
            linalg.expm(M * turn) / turn
            if np.abs(M * turn).max(initial=0.0) < MAX_EXPONENTIAL_ENTRY
            else np.array([np.inf])
        )
    if not np.isfinite(E).all():
        raise CheckError(
            "the sampled model's numbers overflow: no sample time of this length for so fast a machine"
        )
    return np.asarray(E)
