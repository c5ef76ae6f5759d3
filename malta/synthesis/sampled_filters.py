"""The steady-state Kalman filter of a sampled model, and the noise that it knows of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.linear.matrices import system_matrix
from malta.linear.sampling import sample, sample_noise, split_delay, stored_blocks
from malta.synthesis.controller import noise_input
from malta.synthesis.design_models import between_samples
from malta.synthesis.filters import Linear, _cross_covariance
from malta.synthesis.riccati import Solver, dare
from malta.synthesis.weighting import Weights


def sampled_filter(
    model: Linear, weights: Weights, Ts: float, delay: float, *, integrated: bool, solver: Solver = "scipy"
) -> FloatArray:
    """Filter-form Kalman gain. The stored forces are known, so their rows are zero; disturbances stand last.

    L = (P C' + S) (C P C' + C S + S' C' + V)^-1 with the covariance P of the prediction.

    integrated : process noise is white within a sample; otherwise held over it
    """
    n, m, p = len(model.A), model.B.shape[1], len(model.C)
    noisy = sampled_noise(model, weights, Ts, delay, integrated=integrated)
    L = filter_gain(noisy, covariance(noisy, solver))
    return np.vstack([L[:n], np.zeros((stored_blocks(delay) * m, p)), L[n:]])


class Noisy(NamedTuple):
    """A sampled model and its noise: x+ = F x + w, y = H x + n. Q, R are the variances of w and n, M = E[w n'] of what
    acted over the last sample with the reading."""

    F: FloatArray
    H: FloatArray
    Q: FloatArray
    R: FloatArray
    M: FloatArray


def covariance(noisy: Noisy, solver: Solver = "scipy") -> FloatArray:
    """P of the states after a prediction, in the steady state."""
    F, H, Q, _, M = noisy
    return dare(F.T, H.T, Q, _with_reading(noisy), F @ M, "sampled Kalman filter", solver=solver).X


def filter_gain(noisy: Noisy, P: FloatArray) -> FloatArray:
    """(P H' + M) (H P H' + H M + M' H' + R)^-1."""
    return np.asarray(np.linalg.solve(innovations(noisy, P), noisy.H @ P + noisy.M.T).T)


def innovations(noisy: Noisy, P: FloatArray) -> FloatArray:
    """The variance of the innovations, H P H' + H M + M' H' + R."""
    return np.asarray(noisy.H @ P @ noisy.H.T + _with_reading(noisy))


def _with_reading(noisy: Noisy) -> FloatArray:
    """R + H M + M' H'."""
    return noisy.R + noisy.H @ noisy.M + noisy.M.T @ noisy.H.T


def sampled_noise(model: Linear, weights: Weights, Ts: float, delay: float, *, integrated: bool) -> Noisy:
    """What a sampled filter knows of the machine; disturbances stand last, stored forces are known and left out.

    The noise of a reading is in the currents that are commutated for it, too; beside what it does through the law that
    is next to nothing, and left out.

    integrated : process noise is white within a sample; otherwise held over it
    """
    n, m, p = len(model.A), model.B.shape[1], len(model.C)
    V, C, still = np.diag(weights.sensor_variance), model.C, between_samples(model)
    G = noise_input(model.B, weights.coordinates)
    Ad, Bd = sample(still.A, model.B, Ts)
    Gd = Bd if weights.coordinates == "signals" else sample(still.A, G, Ts)[1]
    if integrated:
        W = sample_noise(still.A, G * (weights.process_variance * Ts) @ G.T, Ts)
    else:
        W = Gd * weights.process_variance @ Gd.T
    S = np.zeros((n, p))
    if weights.correlation.any():
        S = Gd @ _cross_covariance(model, weights)
    whole, part = split_delay(delay)
    if not whole:  # of the last reading, which acts for what its delay leaves of the sample
        Ad = Ad + (sample(still.A, model.B, (1 - part) * Ts)[1] if part else Bd) @ still.H @ C
    if weights.drift_variance.size:
        drift = np.diag(weights.drift_variance)
        if weights.coordinates == "positions":  # forces that make these accelerations
            back = np.linalg.inv(model.B[n // 2 :])
            drift = back @ drift @ back.T
        Ad = system_matrix(Ad, Bd, None, np.eye(m))
        W = np.asarray(linalg.block_diag(W, drift))
        C, S = np.hstack([C, np.zeros((p, m))]), np.vstack([S, np.zeros((m, p))])
    return Noisy(Ad, C, W, V, S)
