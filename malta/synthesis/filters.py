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

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.processes import on_one_thread
from malta.synthesis.controller import noise_input
from malta.synthesis.riccati import Solver, care
from malta.synthesis.weighting import Weights


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


def gain_at_rest(K: FloatArray, n: int, known: int) -> FloatArray:
    """K of the n / 2 positions where forces are what is commanded: v = -K q - K_f v, m x n / 2.

    known : blocks of forces under way among the states, after n mechanical states
    """
    m = len(K)
    under_way = K[:, n : n + m * known].reshape(m, known, m).sum(axis=1)
    return np.asarray(np.linalg.solve(np.eye(m) + under_way, K[:, : n // 2]))


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
