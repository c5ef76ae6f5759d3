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
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from numbers import Real
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.linear.matrices import add_integrals, eigenvalues, system_matrix
from malta.linear.sampling import sample, sample_cost, split_delay, stored_blocks, whole_or_not
from malta.model.linearize import LinearModel
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller, Cost, Noise, disturbances, lagging_forces, stored_forces
from malta.synthesis.feedforward import machine_part
from malta.synthesis.filters import (
    Gains,
    Linear,
    between_samples,
    kalman as kalman,
    positions_from,
    sampled_filter,
    sampled_model,
    with_lags,
)
from malta.synthesis.riccati import Solver, care, dare
from malta.synthesis.spec import Discretization, Weights

# Why a linear model has no stabilizing controller, in words: modes that nothing moves or sees, zeros, slow samples.


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
    model: LinearModel,
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

    model : the machine's linear model
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
    if not (math.isfinite(Ts) and Ts > 0):
        raise InputError("lqg", "Ts", f"{Ts} s", "a sample time above 0 s")
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


def weights(
    q: ArrayLike, r: ArrayLike, w: ArrayLike, v: ArrayLike, *, q_i: ArrayLike | None = None
) -> Weights:
    """Make weights of a cost and variances of noise in SI units, without bases.

    A vector or a diagonal matrix each.

    q : n, of the states
    r : m, of the inputs
    w : m, variance of the forces held over a sample, N2
    v : p, variance of a sample of the sensors
    q_i : p, of the integrals of the errors; None: none

    Returns a Weights.

    Raises InputError for a matrix that is not diagonal, and for values below 0.

    >>> import malta
    >>> malta.synthesis.weights([1e8, 1e4], [1], [1e-2], [1e-12]).Q.tolist()
    [[100000000.0, 0.0], [0.0, 10000.0]]
    """
    of_states, of_inputs, forces, sensors = (
        _diagonal(name, value) for name, value in (("q", q), ("r", r), ("w", w), ("v", v))
    )
    integrals = np.zeros(len(sensors)) if q_i is None else _diagonal("q_i", q_i)
    return _without_bases(of_states, of_inputs, integrals, forces, sensors, np.zeros(0))


def _diagonal(name: str, value: ArrayLike) -> FloatArray:
    found: FloatArray = np.atleast_1d(np.asarray(value, dtype=float))
    if found.ndim == 1:
        return found
    if found.ndim != 2 or found.shape[0] != found.shape[1] or np.any(found - np.diag(np.diag(found))):
        raise InputError(
            "weights", name, f"shape {found.shape}, not diagonal", "a vector or a diagonal matrix"
        )
    return np.diag(found)


def weights_of(controller: Controller) -> Weights:
    """What an LQG was designed for, on bases of one SI unit. InputError for a PID, which was not."""
    cost, noise = controller.cost, controller.noise
    if cost is None or noise is None:
        raise InputError(controller.name, "cost", "none, as a PID has", "an LQG")
    found = _without_bases(cost.state, cost.input, cost.integral, noise.process, noise.sensor, noise.drift)
    return replace(found, coordinates=cost.coordinates, correlation=noise.correlation)


def _without_bases(
    q: FloatArray, r: FloatArray, q_i: FloatArray, w: FloatArray, v: FloatArray, drift: FloatArray
) -> Weights:
    one = np.ones_like
    return Weights(q, one(q), r, one(r), q_i, one(q_i), w, v, drift)


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
