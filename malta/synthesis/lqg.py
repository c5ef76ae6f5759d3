"""Linear model + weights -> controller: LQR, LQR with integrals, steady-state Kalman filter, sampling.

    minimize  integral of  xi' Q xi + e' Q_i e + v' R v      subject to  xi' = A xi + B v,  e' = -C xi
    v = K (xi* - xi) + Ki e

Three ways to a sampled controller:
  backward-euler   continuous gains; the observer's equation by backward Euler (the paper's way)
  zoh              gains of the exactly sampled model; weights and noise taken once a sample
  sampled-data     gains of the exactly sampled model; weights and noise integrated over the sample (Van Loan),
                   what MATLAB calls lqrd and kalmd
The integrals are the controller's own sums, e+ = e + Ts (p* - y), so their weight is a sum in both sampled ways.
Noise is given for one sample; held over it (forces) or spread over it (intensity = variance x Ts).

Both sampled ways may have the lag of the current loops in the model: forces are then states, which the regulator feeds
back and the filter knows from the commands.

Both sampled ways know what is held between samples: the currents, commutated for the last reading (E of the linear
model), so that the sampled machine hangs on their spring. In place of integrals the filter may observe a constant force
of disturbance on each input, which the regulator takes off again.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from numbers import Real
from typing import Any, get_args

import numpy as np
from scipy import linalg

from malta.arguments import describe, is_number
from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.linear.matrices import add_integrals, eigenvalues, system_matrix
from malta.linear.sampling import sample, sample_cost, split_delay, stored_blocks, whole_or_not
from malta.model.linear.machine import linear_model_of
from malta.model.linearize import LinearModel
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller, Cost, Noise, disturbances, lagging_forces, stored_forces
from malta.synthesis.design_models import between_samples, sampled_model, with_lags
from malta.synthesis.feedforward import machine_part
from malta.synthesis.filters import Gains, Linear, kalman
from malta.synthesis.reachability import obstacle
from malta.synthesis.regulators import Integrals, check_sizes, integrals_of, lqi, lqr
from malta.synthesis.riccati import Solver, dare
from malta.synthesis.sampled_filters import sampled_filter
from malta.synthesis.spec import Discretization
from malta.synthesis.weighting import Weights


def continuous_poles(model: LinearModel, weights: Weights) -> dict[str, ComplexArray]:
    """Poles of the continuous LQR, LQI and Kalman filter, rad/s: what the weights ask for, before sampling."""
    poles = {}
    with suppress(CheckError):  # weights on the integrals alone stabilize the LQI only
        poles["LQR"] = eigenvalues(model.A - model.B @ lqr(model, weights, solver="scipy"))
    if summed := integrals_of(model, weights).outputs:
        K, Ki = lqi(model, weights, solver="scipy")
        integrating = system_matrix(model.A - model.B @ K, model.B @ Ki[:, summed], -model.C[summed])
        poles["LQR with integrals"] = eigenvalues(integrating)
    poles["Kalman filter"] = eigenvalues(model.A - kalman(model, weights, solver="scipy") @ model.C)
    return {name: np.sort_complex(values) for name, values in poles.items()}


def gains(
    model: Linear,
    weights: Weights,
    Ts: float,
    discretization: Discretization,
    delay: float = 0,
    lag: float | None = None,
    solver: Solver = "scipy",
) -> Gains:
    """LQR with integrals and Kalman filter of a model, sampled. Raises CheckError as riccati.dare.

    lag : rad/s, of the forces behind their commands, which are then states of the design model; None: no lag

    Without delay, lag, integrals and disturbances K is control.dlqr(Ad, Bd, Qd, Rd, Nd)[0] with the sampled weights of
    `sample_cost`, and Ad L is the gain of control.dlqe(Ad, 1, Cd, Wd, V)[0], a predictor's. control.dlqr with
    integral_action sums errors without Ts, and one sample late.
    """
    if discretization == "backward-euler":
        return Gains(*_backward_euler(model, weights, Ts, solver))
    integrated, n, m = discretization == "sampled-data", len(model.A), model.B.shape[1]
    driven, cost, known = model, weights, delay  # samples of forces that are known, as what was commanded is
    if lag is not None:
        driven, known = with_lags(model, lag), delay + 1
        free = np.zeros(m)
        cost = replace(weights, q=np.append(weights.q, free), q_base=np.append(weights.q_base, free + 1))
    Ad, Bd, Cd = sampled_model(driven, Ts, delay)
    integrals = integrals_of(model, weights)
    K, Ki = _sampled_regulator(driven, cost, integrals, Ts, delay, integrated=integrated, solver=solver)
    L = sampled_filter(model, weights, Ts, known, integrated=integrated, solver=solver)
    if weights.drift_variance.size:  # x+ = Ad x + Bd (v + d), d+ = d; v takes d off, as forces under way have
        p, pushed = len(Cd), np.zeros((len(Ad), m))
        pushed[:n] = sample(between_samples(model).A, model.B, Ts)[1]
        Ad = system_matrix(Ad, pushed, None, np.eye(m))
        Bd, Cd = np.vstack([Bd, np.zeros((m, m))]), np.hstack([Cd, np.zeros((p, m))])
        K = np.hstack([K, np.eye(m) + K[:, n:].reshape(m, stored_blocks(known), m).sum(axis=1)])
    return Gains(Ad, Bd, Cd, K, Ki, L)


@on_one_thread
@np.errstate(all="ignore")  # what overflows is found at the end
def lqg(
    model: LinearModel | Any,
    weights: Weights,
    Ts: float,
    discretization: Discretization = "sampled-data",
    delay: float = 0,
    *,
    name: str = "lqg",
    current_loop_delay: bool = True,
    current_lag: bool = False,
    position_feedforward: bool = False,
    solver: Solver = "python-control",
) -> Controller:
    """Design an LQG controller: LQR with integrals, steady-state Kalman filter, feedforward, current loop, all sampled.

    model : the machine's linear model; or its Plant, at rest at zero, or a continuous control.StateSpace
    weights : of the cost, and the noise of one sample
    Ts : sample time, s
    discretization : "sampled-data" (cost and noise integrated over the sample, Van Loan), "zoh" (taken once a sample)
        or "backward-euler" (continuous gains)
    delay : samples between measurement and force in the design model, also a fraction (not with backward-euler)
    name : of the design
    current_loop_delay : design the current loop with the machine's dead time
    current_lag : forces are states of the design model, first-order lags at the current loops' crossover behind v
    position_feedforward : feed forward the forces that hold the machine at its reference, so that a tilt meets no error
    solver : of the scaled Riccati equations: "python-control" (control.care, control.dare), or "scipy" without it, to
        the bit the same and without two seconds of import

    Returns a Controller.

    Raises InputError for arguments that do not fit, CheckError when an equation has no sound solution.

    >>> import malta
    >>> A, B, C = [[0, 1], [400, 0]], [[0], [2]], [[1, 0]]
    >>> cart = malta.linear_machine(A, B, C, name="cart", states=["z [m]", "v [m/s]"])
    >>> model = malta.linearize(cart, cart.at())
    >>> given = {"q": [1e6, 0], "r": [1], "w": [1e-2], "v": [1e-12], "q_i": [1e7]}
    >>> weights = malta.synthesis.weights(**given)
    >>> controller = malta.lqg(model, weights, Ts=1e-3)
    >>> malta.verify(model, controller).stable, [f"{k:.3g}" for k in controller.K[0]]
    (True, ['1.29e+03', '35.8'])
    """
    if not (is_number(Ts) and Ts > 0):
        raise InputError("lqg", "Ts", f"{describe(Ts)} s", "a sample time above 0 s")
    model = linear_model_of(model, "lqg")
    if model.operating_point.loaded:
        raise InputError(
            "lqg", "model", "a model at its trim", "one at plant.at(...): v0(z) cancels the loads"
        )
    if isinstance(delay, bool) or not isinstance(delay, Real) or not math.isfinite(delay):
        raise InputError("lqg", "delay", repr(delay), "a number of samples")
    delay = whole_or_not(float(delay))
    if discretization not in get_args(Discretization):
        raise InputError(
            "lqg", "discretization", repr(discretization), "one of " + ", ".join(get_args(Discretization))
        )
    sampled_only = {"delay": delay, "held currents": model.E.any(), "drift": weights.drift_variance.size}
    asked = [what for what, given in sampled_only.items() if given]
    if delay < 0 or (asked and discretization == "backward-euler"):
        what = str(delay) if delay else asked[0]
        raise InputError(
            "lqg", "delay", f"{what} with {discretization}", "0, or more with zoh or sampled-data"
        )
    if weights.drift_variance.size and weights.q_i.any():
        raise InputError(
            "lqg", "drift", "integrals with a weight", "weights.integral all 0: one of them takes off loads"
        )
    check_sizes(model, weights)
    lag = model.plant.actuator.crossover if current_lag else None
    _require_lag(model, lag, discretization)
    try:
        found = gains(model, weights, Ts, discretization, delay, lag, solver)
    except CheckError as error:
        reason = obstacle(model, weights, Ts)
        said = f"{str(error).partition(': ')[0]}: no sound solution: {reason}" if reason else str(error)
        raise CheckError(said) from error
    if not all(np.isfinite(M).all() for M in found):
        raise CheckError("lqg: the gains overflow")
    plant = model.plant
    observed = disturbances(plant.inputs) if weights.drift_variance.size else ()
    lagging = lagging_forces(plant.inputs) if current_lag else ()
    return Controller(
        **machine_part(
            model, Ts, delay, current_loop_delay=current_loop_delay, position_feedforward=position_feedforward
        ),
        **found._asdict(),
        name=name,
        states=plant.design_states + lagging + stored_forces(plant.inputs, stored_blocks(delay)) + observed,
        fraction=split_delay(delay)[1],
        cost=Cost(
            weights.q / weights.q_base**2,
            weights.r / weights.r_base**2,
            weights.q_i / weights.q_i_base**2,
            weights.coordinates,
        ),
        noise=Noise(
            weights.process_variance, weights.sensor_variance, weights.drift_variance, weights.correlation
        ),
    )


def _require_lag(model: LinearModel, lag: float | None, discretization: Discretization) -> None:
    """InputError for a lag in the design of a machine without one, of held currents, or by backward Euler."""
    if lag is None:
        return
    found, expected = "", "a machine with current loops"
    if not math.isfinite(lag):
        found = f"a {model.plant.name}, whose currents follow their commands at once"
    elif model.E.any():
        found, expected = (
            f"a {model.plant.name}, whose currents are held between samples",
            "one whose forces do not depend on where it is",
        )
    elif discretization == "backward-euler":
        found, expected = discretization, "zoh or sampled-data"
    if found:
        raise InputError("lqg", "current_lag", found, expected)


def _backward_euler(
    model: Linear, weights: Weights, Ts: float, solver: Solver
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Continuous gains; xi_hat' = A xi_hat + B v + L (y - C xi_hat) by backward Euler, in filter form.

    (I - Ts A) xi_pred = xi_hat + Ts B v, and the correction is (I - Ts (A - L C))^-1 Ts L (y - C xi_pred).
    """
    K, Ki = lqi(model, weights, solver=solver)
    Lc = kalman(model, weights, solver=solver)
    eye = np.eye(len(model.A))
    Ad = np.linalg.inv(eye - Ts * model.A)
    L = np.linalg.solve(eye - Ts * (model.A - Lc @ model.C), Ts * Lc)
    return Ad, Ts * Ad @ model.B, model.C, K, Ki, L


def _sampled_regulator(
    model: Linear,
    weights: Weights,
    integrals: Integrals,
    Ts: float,
    delay: float,
    *,
    integrated: bool,
    solver: Solver,
) -> tuple[FloatArray, FloatArray]:
    """K, Ki of the sampled model. With delay, a force acts on the states d samples after it is commanded.

    Its own weight R Ts may be charged when it is commanded, which shifts a sum and changes no optimum. What is left
    beside the oldest stored force, Van Loan's integral with R = 0, is positive semidefinite. What acts is v + H y.
    """
    n, m, p, blocks = len(model.A), model.B.shape[1], len(model.C), stored_blocks(delay)
    still, commanded, (whole, part) = between_samples(model), weights.R * Ts, split_delay(delay)
    if integrated and part:
        Q, N, R = _split_cost(still.A, model.B, weights.Q, Ts, part)
        R = R + commanded
    elif integrated:
        Q, N, R = sample_cost(still.A, model.B, weights.Q, weights.R, Ts)
    else:
        Q, N, R = weights.Q * Ts, np.zeros((n, m)), commanded
        if part:
            Q, N = linalg.block_diag(Q, np.zeros((m, m))), np.zeros((n + m, m))
    Ad, Bd, Cd = sampled_model(model, Ts, delay)
    if whole:
        rest = m * (whole - 1)
        Q = linalg.block_diag(system_matrix(Q, N, N.T, R - commanded), np.zeros((rest, rest)))
        N, R = np.zeros((n + m * blocks, m)), commanded
    else:
        pull, acting = np.hstack([still.H @ model.C, np.zeros((m, m * blocks))]), R - commanded
        Q = Q + N @ pull + pull.T @ N.T + pull.T @ acting @ pull
        N = N + pull.T @ acting
    Ki, (summed, Q_i) = np.zeros((m, p)), integrals
    if not summed:
        return dare(Ad, Bd, Q, R, N, "sampled LQR", solver=solver).K, Ki
    A, B = add_integrals(Ad, Bd, Cd[summed], Ts)
    N = np.vstack([N, np.zeros((len(summed), m))])
    gain = dare(A, B, linalg.block_diag(Q, Q_i * Ts), R, N, "sampled LQI", solver=solver).K
    Ki[:, summed] = -gain[:, n + m * blocks :]
    return gain[:, : n + m * blocks], Ki


def _split_cost(
    A: FloatArray, B: FloatArray, Q: FloatArray, Ts: float, part: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The integral of x'Qx over a sample in which a stored input acts for its first part, and a newer one after it.

    Q, N and R of x~'Q x~ + 2 x~'N u + u'R u, x~ = (x, stored input).
    """
    free = np.zeros((B.shape[1],) * 2)
    first, last = (sample_cost(A, B, Q, free, t) for t in (part * Ts, (1 - part) * Ts))
    reached = np.hstack(sample(A, B, part * Ts))  # x when the newer one begins, of (x, stored)
    before = system_matrix(first[0], first[1], first[1].T, first[2])
    return before + reached.T @ last[0] @ reached, reached.T @ last[1], last[2]
