"""The steady-state Kalman filter of a linear model, continuous and sampled.

    x' = A x + B v + G w,  y = C x + n          W, V: variances of w and n, of one sample

G = B: noise on the forces of the inputs. In the coordinates of the positions G = [0; I]: noise on their accelerations,
and the noise of a reading, as positions q = C_q^-1 y, may correlate with the acceleration that led to it:

    E[w q'] = diag(rho sigma_w sigma_q),    sigma_q^2 = diag(C_q^-1 V C_q^-T)

With rho > 0 the filter takes part of a deviation for the noise of the reading, and corrects positions less than rates:
its poles are less damped, and delay the loop less.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.linear.sampling import add_lags, delay_inputs, sample, sample_noise
from malta.linear.system import System
from malta.processes import on_one_thread
from malta.synthesis.controller import noise_input
from malta.synthesis.riccati import Solver, care, dare
from malta.synthesis.spec import Weights

# The design model between samples: currents that are held, forces behind the lag of the current loops.


class Linear(Protocol):
    """xi' = A xi + B v, p = C xi: a LinearModel, or a system; a model with held currents has E (y_k - p) beside it."""

    @property
    def A(self) -> FloatArray: ...
    @property
    def B(self) -> FloatArray: ...
    @property
    def C(self) -> FloatArray: ...
    @property
    def E(self) -> FloatArray | None: ...


def with_lags(model: Linear, rate: float) -> System:
    """The model with lags rate / (s + rate) before its inputs, rate in rad/s; these forces are states after x."""
    A, B = add_lags(model.A, model.B, rate)
    C = np.hstack([model.C, np.zeros((len(model.C), B.shape[1]))])
    return System(A, B, C, np.zeros((len(C), B.shape[1])))


class Held(NamedTuple):
    """A machine between samples, its currents held: x' = A x + B (v + H y_k), y_k the last reading."""

    A: FloatArray
    H: FloatArray  # m x p, N/m


def between_samples(model: Linear) -> Held:
    """What a linear model is between samples; E is in the reach of the inputs."""
    if model.E is None or isinstance(model, System) or not model.E.any():
        return Held(model.A, np.zeros((model.B.shape[1], len(model.C))))
    return Held(model.A - model.E @ model.C, np.linalg.lstsq(model.B, model.E, rcond=None)[0])


def gain_at_rest(K: FloatArray, n: int, known: int) -> FloatArray:
    """K of the n / 2 positions where forces are what is commanded: v = -K q - K_f v, m x n / 2.

    known : blocks of forces under way among the states, after n mechanical states
    """
    m = len(K)
    under_way = K[:, n : n + m * known].reshape(m, known, m).sum(axis=1)
    return np.asarray(np.linalg.solve(np.eye(m) + under_way, K[:, : n // 2]))


def sampled_model(model: Linear, Ts: float, delay: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ad, Bd, Cd under held currents, with the forces of the last `delay` samples as states."""
    still = between_samples(model)
    Ad, Bd = delay_inputs(*sample(still.A, model.B, Ts), delay)
    n, pull = len(model.A), still.H @ model.C
    if delay:
        Ad[-len(pull) :, :n] = pull
    else:
        Ad = Ad + Bd @ pull
    return Ad, Bd, np.hstack([model.C, np.zeros((len(model.C), len(Ad) - n))])


class Gains(NamedTuple):
    """The sampled design model with its gains, as the controller runs them."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    K: FloatArray
    Ki: FloatArray
    L: FloatArray


@on_one_thread
def kalman(model: Linear, weights: Weights, *, solver: Solver = "python-control") -> FloatArray:
    """Design the continuous steady-state Kalman filter: xi_hat' = A xi_hat + B v + L (y - C xi_hat).

    L = P C' V^-1 with 0 = A P + P A' + W - P C' V^-1 C P. Only the ratio of process to sensor noise matters, so
    variances of a sample serve as intensities. The same as control.lqe(A, B, C, W, V)[0], which loses digits in SI.

    model : the linear model
    weights : whose variances are used
    solver : of the scaled equation: "python-control", or "scipy" without it, to the bit the same

    Returns L, n x p.

    Raises InputError for weights of another size, CheckError when the Riccati equation has no sound solution.

    >>> import malta
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    >>> model = malta.linearize(cart, cart.at())
    >>> weights = malta.synthesis.weights(q=[1, 1], r=[1], w=[1e-2], v=[1e-6])
    >>> malta.synthesis.kalman(model, weights).round(6).tolist()
    [[14.142136], [100.0]]
    """
    A, W, along = intensities(model, weights)
    V = np.diag(weights.sensor_variance)
    return care(A.T, model.C.T, W, V, "Kalman filter", solver=solver).K.T + along


def intensities(model: Linear, weights: Weights) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A and W of a continuous filter without the part of w that comes with n, and S V^-1, which takes that off."""
    G, A = noise_input(model.B, weights.coordinates), model.A
    W, along = G * weights.process_variance @ G.T, np.zeros_like(model.C.T)
    if weights.correlation.any():
        along = G @ _cross_covariance(model, weights) / weights.sensor_variance
        A, W = A - along @ model.C, W - along * weights.sensor_variance @ along.T
    return A, W, along


def sampled_filter(
    model: Linear, weights: Weights, Ts: float, delay: int, *, integrated: bool, solver: Solver = "scipy"
) -> FloatArray:
    """Filter-form Kalman gain. The stored forces are known, so their rows are zero; disturbances stand last.

    L = (P C' + S) (C P C' + C S + S' C' + V)^-1 with the covariance P of the prediction.

    integrated : process noise is white within a sample; otherwise held over it
    """
    n, m, p = len(model.A), model.B.shape[1], len(model.C)
    noisy = sampled_noise(model, weights, Ts, delay, integrated=integrated)
    L = filter_gain(noisy, covariance(noisy, solver))
    return np.vstack([L[:n], np.zeros((delay * m, p)), L[n:]])


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


def sampled_noise(model: Linear, weights: Weights, Ts: float, delay: int, *, integrated: bool) -> Noisy:
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
    if not delay:
        Ad = Ad + Bd @ still.H @ C
    if weights.drift_variance.size:
        drift = np.diag(weights.drift_variance)
        if weights.coordinates == "positions":  # forces that make these accelerations
            back = np.linalg.inv(model.B[n // 2 :])
            drift = back @ drift @ back.T
        Ad = system_matrix(Ad, Bd, None, np.eye(m))
        W = np.asarray(linalg.block_diag(W, drift))
        C, S = np.hstack([C, np.zeros((p, m))]), np.vstack([S, np.zeros((m, p))])
    return Noisy(Ad, C, W, V, S)


def positions_from(model: Linear) -> FloatArray:
    """C_q^-1 of p = C_q q: n / 2 x p.

    Raises InputError where the outputs are not as many as the positions, or do not give them.
    """
    half = len(model.A) // 2
    C_q = model.C[:, :half]
    if C_q.shape[0] != half or np.linalg.cond(C_q) > 1e12:
        found = f"{len(C_q)} measured signals for {half} positions"
        raise InputError("weights", "coordinates", found, "signals, or measurements that give all positions")
    return np.asarray(np.linalg.inv(C_q))


def _cross_covariance(model: Linear, weights: Weights) -> FloatArray:
    """E[w n'] of accelerations and readings, n / 2 x p."""
    to_positions = positions_from(model)
    sigma_q = np.sqrt(np.square(to_positions) @ weights.sensor_variance)
    back = np.linalg.inv(to_positions)
    return np.asarray((weights.correlation * np.sqrt(weights.process_variance) * sigma_q)[:, None] * back.T)
