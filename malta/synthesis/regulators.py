"""The continuous regulator of a linear model, with integrals of the errors where they have weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.processes import on_one_thread
from malta.synthesis.filters import Linear, positions_from
from malta.synthesis.riccati import Solver, care
from malta.synthesis.weighting import Weights


@on_one_thread
def lqr(model: Linear, weights: Weights, *, solver: Solver = "python-control") -> FloatArray:
    """Design a continuous LQR: v = -K xi minimizes the integral of xi' Q xi + v' R v.

    K = R^-1 B' P with 0 = A' P + P A + Q - P B R^-1 B' P. The same as control.lqr(A, B, Q, R)[0].

    model : the linear model
    weights : Q and R
    solver : of the scaled equation: "python-control", or "scipy" without it, to the bit the same

    Returns K, m x n.

    Raises InputError for weights of another size, CheckError when the Riccati equation has no sound solution.

    >>> import malta
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    >>> weights = malta.synthesis.weights(q=[16, 0], r=[1], w=[1], v=[1])
    >>> K = malta.synthesis.lqr(malta.linearize(cart, cart.at()), weights)
    >>> K.round(6).tolist()  # w_n = 2 rad/s: K1 = w_n^2, K2 = sqrt(2) w_n
    [[4.0, 2.828427]]
    """
    check_sizes(model, weights)
    return care(model.A, model.B, weights.Q, weights.R, "LQR", solver=solver).K


@on_one_thread
def lqi(
    model: Linear, weights: Weights, *, solver: Solver = "python-control"
) -> tuple[FloatArray, FloatArray]:
    """Design a continuous LQR with the integrals of the measured errors.

        minimize integral of xi' Q xi + e' Q_i e + v' R v,    v = K (xi* - xi) + Ki e,   e' = p* - p

    The Riccati gain on e acts as -K_e e, so Ki = -K_e. An output without a weight has no integral: its column is 0.
    With a weight for each it is the same as control.lqr(A, B, diag(Q, Q_i), R, integral_action=C)[0] = [K, Ki].

    model : the linear model
    weights : Q, R and Q_i
    solver : of the scaled equation: "python-control", or "scipy" without it, to the bit the same

    Returns K (m x n) and Ki (m x p).

    Raises InputError for weights of another size, CheckError when the Riccati equation has no sound solution.

    >>> import malta
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    >>> weights = malta.synthesis.weights([1, 0], [1], [1], [1], q_i=[4])
    >>> K, Ki = malta.synthesis.lqi(malta.linearize(cart, cart.at()), weights)
    >>> K.round(3).tolist(), Ki.round(3).tolist()
    ([[3.375, 2.598]], [[2.0]])
    """
    check_sizes(model, weights)
    summed, Q_i = integrals_of(model, weights)
    n, k, Ki = len(model.A), len(summed), np.zeros((model.B.shape[1], len(model.C)))
    if not summed:
        return lqr(model, weights, solver=solver), Ki
    A = system_matrix(model.A, None, -model.C[summed])
    B = np.vstack([model.B, np.zeros((k, model.B.shape[1]))])
    gain = care(A, B, linalg.block_diag(weights.Q, Q_i), weights.R, "LQI", solver=solver).K
    Ki[:, summed] = -gain[:, n:]
    return gain[:, :n], Ki


class Integrals(NamedTuple):
    """The outputs whose errors p* - p are integrated, and the weight of these integrals.

    Those are the outputs with a weight; in the coordinates of the positions, C_q^-1 (p* - p), all outputs or none.
    """

    outputs: list[int]  # k indices
    weight: FloatArray  # k x k


def integrals_of(model: Linear, weights: Weights) -> Integrals:
    """The integrals that the weights ask for."""
    q_i = np.diag(weights.Q_i)
    if weights.coordinates == "signals" or not q_i.any():
        outputs = np.flatnonzero(q_i).tolist()
        return Integrals(outputs, np.diag(q_i[outputs]))
    to_positions = positions_from(model)
    return Integrals(list(range(len(model.C))), np.asarray(to_positions.T @ weights.Q_i @ to_positions))


def check_sizes(model: Linear, weights: Weights) -> None:
    """Raise InputError for weights and noise of other numbers than a model's states, inputs and outputs."""
    n, m, p = len(model.A), model.B.shape[1], len(model.C)
    half, in_positions = n // 2, weights.coordinates == "positions"
    if in_positions:
        positions_from(model)
        if weights.q_i.any() and not weights.q_i.all():
            found = f"{weights.q_i.tolist()} in coordinates of positions"
            raise InputError("Weights", "q_i", found, "weights above 0 of all integrals, or of none")
    integrals = ("q_i", "positions", half) if in_positions else ("q_i", "measured signals", p)
    for field, what, size in (("q", "states", n), ("r", "inputs", m), integrals):
        if len(getattr(weights, field)) != size:
            raise InputError(
                "Weights",
                field,
                f"{len(getattr(weights, field))} entries",
                f"{size}, one for each of the {what}",
            )
    drifts = m if weights.drift_variance.size else 0
    sources = half if in_positions else m
    for field, size in (("process_variance", sources), ("sensor_variance", p), ("drift_variance", drifts)):
        if len(getattr(weights, field)) != size:
            raise InputError("Weights", field, f"{len(getattr(weights, field))} entries", f"{size}")
