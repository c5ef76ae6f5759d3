"""An LQG as an element of a law: what is tuned are the sizes that its weights and its noise stand for.

    minimize  integral of  sum (x_i / state_i)^2 + sum (s_k / integral_k)^2 + sum (u_j / input_j)^2
    x' = A x + B (u + w),  y = C x + n,  s' = -C x        std w_j = process_j,  std n_k = sensor_k

The law is the continuous LQG, x_hat' = A x_hat + B u + L (y - C x_hat), u = -K x_hat + Ki s, of the errors e = p* - y;
its states are -x_hat and s. K and L follow the sizes through two Riccati equations. Differentiated, each is a Lyapunov
equation of the loop that its solution closes:

    0 = A'X + XA - X B R^-1 B'X + Q,  K = R^-1 B'X        F = A - B K
    0 = F'dX + dX F + dQ + K' dR K,   dK = R^-1 (B'dX - dR K)

Bases of the weights on which an LQR has the stiffness that is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arguments import require_real
from malta.arrays import FloatArray
from malta.errors import CheckError, InputError, relocate_errors
from malta.linear.conversion import from_control
from malta.linear.matrices import system_matrix
from malta.linear.system import System
from malta.model.linearize import LinearModel
from malta.synthesis.elements import CALLER, Bounds, Element, Matrices, keep_sign
from malta.synthesis.reachability import out_of_reach
from malta.synthesis.regulators import check_sizes
from malta.synthesis.riccati import RiccatiSolution, care
from malta.synthesis.weighting import Weights

Change = tuple[Any, Any]  # of Q and R


def lqg(name: str, model: Any, weights: Weights, *, bounds: Bounds | None = None) -> Element:
    """The LQG of a plant with weights that are tuned: from all errors to all inputs, of the order of its model.

    minimize  integral of sum (x_i / state_i)^2 + sum (s_k / integral_k)^2 + sum (u_j / input_j)^2,  s' = p* - y

    Its parameters are these sizes and the standard deviations of noise, as "state.x", "integral.x", "input.F",
    "process.F" and "sensor.x"; a state or an integral of weight 0 has none. An integral is a state of the law.

    name : of the element
    model : that the law is designed for: a LinearModel, a continuous control.StateSpace without D, or A, B and C
    weights : from `malta.synthesis.weights` or of a design, at which a search starts: state_i is q_base / sqrt(q)
    bounds : (low, high) of some of the parameters

    Raises InputError for weights of other sizes, for modes that are not stable and that no input moves or no output
    sees, and for weights without an LQG.

    >>> import malta
    >>> from malta import structured
    >>> body = [[0, 1], [100, 0]], [[0], [1]], [[1, 0]]
    >>> weights = malta.synthesis.weights(q=[1e6, 0], r=[1], w=[1e-2], v=[1e-12])
    >>> law = structured.lqg("lqg", body, weights)
    >>> law.order, {key: f"{value:g}" for key, value in law.values.items()}
    (2, {'lqg.state.x0': '0.001', 'lqg.input.u0': '1', 'lqg.process.u0': '0.1', 'lqg.sensor.y0': '1e-06'})
    """
    plant = _model_of(name, model)
    _require_fit(name, plant, weights)
    weighted, summed = np.flatnonzero(weights.q).tolist(), np.flatnonzero(weights.q_i).tolist()
    starts = _sizes(plant, weights)
    n, (m, p), k = len(plant.A), (len(plant.inputs), len(plant.outputs)), len(summed)

    def solve(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        own = len(weighted) + k + m
        K, by_cost = _regulator(plant, [*weighted, *range(n, n + k)], summed, values[:own])
        L, by_noise = _filter(plant, values[own:])
        return np.concatenate([K.ravel(), L.ravel()]), linalg.block_diag(by_cost, by_noise)

    def matrices(v: Sequence[Any]) -> Matrices:
        rows = ca.reshape(ca.vertcat(*v[: m * (n + k)]), n + k, m).T
        L = ca.reshape(ca.vertcat(*v[m * (n + k) :]), p, n).T
        K, G = rows[:, :n], rows[:, n:]
        A, B, C = (ca.DM(M) for M in (plant.A, plant.B, plant.C))
        whole = system_matrix(A - B @ K - L @ C, B @ G)
        return whole, ca.vertcat(L, ca.DM(np.eye(p)[summed])), ca.horzcat(K, -G), ca.DM(m, p)

    parameters = (replace(one, name=f"{name}.{one.name}") for one in keep_sign(name, bounds, **starts))
    found = Element(name, tuple(parameters), matrices, solve)
    try:
        found.system  # noqa: B018  # solves both equations
    except CheckError as error:
        raise InputError(CALLER, name, str(error), "weights whose LQG exists") from error
    return found


def _sizes(plant: System, weights: Weights) -> dict[str, float]:
    """The parameters at which a search starts, without those of states and integrals whose weight is 0."""
    tables = (
        ("state", plant.states, weights.q, weights.q_base),
        ("integral", plant.outputs, weights.q_i, weights.q_i_base),
        ("input", plant.inputs, weights.r, weights.r_base),
        ("process", plant.inputs, 1 / weights.process_variance, 1.0),
        ("sensor", plant.outputs, 1 / weights.sensor_variance, 1.0),
    )
    return {
        f"{table}.{name}": float(base / np.sqrt(weight))
        for table, names, of, bases in tables
        for name, weight, base in zip(names, of, np.broadcast_to(bases, of.shape), strict=True)
        if weight > 0
    }


def _model_of(name: str, model: Any) -> System:
    """A model as a system with names. Raises InputError."""
    if isinstance(model, LinearModel):
        return model.system
    if hasattr(model, "A"):
        found = from_control(model, CALLER, name)
        if found.dt is not None or found.D.any():
            kind = f"a model with dt = {model.dt}, or with D"
            raise InputError(CALLER, name, kind, "a continuous one without D")
        return found
    A, B, C = (np.atleast_2d(np.asarray(require_real(CALLER, name, M), dtype=float)) for M in model)
    n, shapes = len(A), [M.shape for M in (A, B, C)]
    if shapes != [(n, n), (n, B.shape[1]), (len(C), n)] or not all(np.isfinite(M).all() for M in (A, B, C)):
        raise InputError(CALLER, name, f"A, B and C of shapes {shapes}", "matrices that fit, of numbers")
    sides = zip("xuy", (n, B.shape[1], len(C)), strict=True)
    numbered = [tuple(f"{letter}{i}" for i in range(size)) for letter, size in sides]
    return System(A, B, C, np.zeros((len(C), B.shape[1])), None, None, *numbered)


def _require_fit(name: str, plant: System, weights: Weights) -> None:
    """Raise InputError for weights that are not of this plant, and for a plant that no LQG stabilizes."""
    if weights.coordinates != "signals" or weights.drift_variance.size:
        found = weights.coordinates if weights.coordinates != "signals" else "a drift"
        raise InputError(CALLER, f"{name}.weights", found, "weights of signals, without a drift")
    A, B, C = plant.A, plant.B, plant.C
    with relocate_errors(CALLER, f"{name}.{{}}"):
        check_sizes(plant, weights)
    reason = out_of_reach(A, B, C, plant.states)
    if reason:
        raise InputError(CALLER, name, reason, "a plant that its inputs stabilize and its outputs show")


def _regulator(
    plant: System, weighted: Sequence[int], summed: Sequence[int], sizes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The gain of states and integrals, and its derivative by their sizes and by those of the inputs."""
    n, k, m = len(plant.A), len(summed), len(plant.inputs)
    A = system_matrix(plant.A, None, -plant.C[list(summed)])
    B = np.vstack([plant.B, np.zeros((k, m))])
    count = len(weighted)
    Q, R = np.zeros(n + k), sizes[count:] ** -2.0
    Q[list(weighted)] = sizes[:count] ** -2.0
    changes: list[Change] = [
        (_entry(n + k, i, -2 * s**-3.0), np.zeros((m, m))) for i, s in zip(weighted, sizes, strict=False)
    ]
    changes += [(np.zeros_like(A), _entry(m, j, -2 * s**-3.0)) for j, s in enumerate(sizes[count:])]
    solution = care(A, B, np.diag(Q), np.diag(R), "LQI" if k else "LQR")
    return solution.K, np.stack([dK.ravel() for dK in _slopes(A, B, np.diag(R), solution, changes)], axis=1)


def _filter(plant: System, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The gain of the filter, and its derivative by the standard deviations of process and sensors."""
    A, B, C = plant.A, plant.B, plant.C
    m, p = B.shape[1], len(C)
    V = np.diag(sizes[m:] ** 2)
    changes: list[Change] = [
        (2 * s * np.outer(b, b), np.zeros((p, p))) for b, s in zip(B.T, sizes, strict=False)
    ]
    changes += [(np.zeros_like(A), _entry(p, j, 2 * s)) for j, s in enumerate(sizes[m:])]
    solution = care(A.T, C.T, B * sizes[:m] ** 2 @ B.T, V, "Kalman filter")
    slopes = _slopes(A.T, C.T, V, solution, changes)
    return solution.K.T, np.stack([dK.T.ravel() for dK in slopes], axis=1)


def _entry(size: int, i: int, value: float) -> FloatArray:
    M = np.zeros((size, size))
    M[i, i] = value
    return M


def _slopes(
    A: FloatArray, B: FloatArray, R: FloatArray, solution: RiccatiSolution, changes: Sequence[Change]
) -> list[FloatArray]:
    """How the gain changes with Q and R: one Schur form of the closed loop serves all Lyapunov equations.

    States count in units in which X has a diagonal of ones, as in `care`.
    """
    K = solution.K
    diagonal = np.diag(solution.X)
    t = np.exp2(-np.round(np.log2(np.where(diagonal > 0, diagonal, 1.0)) / 2))
    T, U = linalg.schur((A - B @ K) * t / t[:, None])
    found = []
    for dQ, dR in changes:
        right = U.T @ ((dQ + K.T @ dR @ K) * np.outer(t, t)) @ U
        Y, scale, _ = linalg.lapack.dtrsyl(T, T, -right, trana="T")
        dX = U @ (Y / scale) @ U.T / np.outer(t, t)
        found.append(np.linalg.solve(R, B.T @ dX - dR @ K))
    return found
