"""Kalman filters for a start with an unknown state: filterpy's, on the CasADi model of the machine.

    kalman     time-varying, on the linear model of the gain file; its gain is large at first
    extended   on the nonlinear machine of the gain file, with gravity, cogging and touchdown bearings, so that it
               accounts for the force of a bearing on a mover that rests there

Both start from the first measurement: positions as measured, and zero rates with the variance that a difference of two
measurements would have. Covariances of forces and sensors are those of the gain file's filter.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.linalg import LinAlgWarning

from malta.errors import InputError
from malta.model.data import plant_of
from malta.model.plant import Plant
from malta.proof.uncertain import is_commutated
from malta.simulation.engine.engines import Engine
from malta.simulation.layout import layout_of, numbers_of
from malta.simulation.period import period_of, runge_kutta
from malta.simulation.scenario import Simulation
from malta.synthesis.controller import Controller, Noise
from malta.synthesis.filters import noise_input
from malta.synthesis.riccati import sample

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

Observer = Callable[
    [Engine, Plant, "FloatArray", "FloatArray", "FloatArray"], tuple["FloatArray", "FloatArray"]
]


def observer(simulation: Simulation, substeps: int) -> Observer:
    """A function that simulates sample by sample with the estimate of a Kalman filter of filterpy.

    It takes (engine, machine, state, inputs, noise) and returns (state, rows), as an engine does.

    Raises InputError for a controller that is no LQG with integrals, and for a machine whose currents are held.
    """
    plant, c, scenario, setup = simulation
    kind, errors = scenario.estimator, scenario.sensor_errors
    filter_ = _kalman_filter(c, _noise_of(plant, c, kind))
    force = _acting_force(c)
    predict = _nonlinear_prediction(c) if kind == "extended" else _linear_prediction(c)
    jacobian, output = _measurement(c)

    @cache
    def sensors(now: Plant) -> ca.Function:
        return period_of(now, c, setup, numbers_of(now, c, substeps, errors), constant=True).sense

    sizes = layout_of(plant, c, setup).row
    edges = dict(zip(sizes, np.cumsum([0, *sizes.values()]), strict=False))
    commands = slice(edges["v"], edges["v"] + sizes["v"])
    axis = plant_of(c.parameters).leading_output
    n = len(c.A)
    under_way = np.zeros(len(c.Ad) - n)  # v - v0 behind the lag, and of the last samples, the oldest first
    loads: list[FloatArray] = []  # v0 of the last samples
    started = False

    @np.errstate(all="ignore")  # a filter that diverges ends the run with a verdict
    def run(
        engine: Engine, machine: Plant, state: FloatArray, given: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        nonlocal started, under_way
        rows = []
        sense, none = sensors(machine), np.zeros((0, 0))
        for k in range(len(given)):
            y = np.array(sense(state, given[k], noise[k], [])[0]).ravel()[: len(c.measurements)]
            if not started:
                _start_filter(filter_, c, y)
                started = True
            _update(filter_, y, jacobian, output)
            now = given[k : k + 1].copy()
            now[0, -len(c.states) :] = np.concatenate([filter_.x, under_way])
            state, row = engine.run(0, state, now, noise[k : k + 1], none)
            rows.append(row)
            if not np.isfinite(row).all():
                break
            v0 = c.feedforward.at(y[axis])
            sent = row[0, commands] - v0
            acting = force(under_way, sent)
            under_way = c.Ad[n:, n:] @ under_way + c.Bd[n:] @ sent
            loads.append(v0)
            filter_.x, filter_.F = predict(filter_.x, acting, loads.pop(0) if len(loads) > c.delay else v0)
            filter_.P = filter_.F @ filter_.P @ filter_.F.T + filter_.Q
        return state, np.concatenate(rows)

    return run


def _update(filter_: Any, y: FloatArray, jacobian: Any, output: Any) -> None:
    """The estimate with the readings y; NaN where estimate or covariance are no numbers, without a word of scipy's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LinAlgWarning)  # of a covariance that is nearly singular
        try:
            filter_.update(y, jacobian, output)
        except (np.linalg.LinAlgError, ValueError):
            filter_.x = np.full(len(filter_.x), np.nan)


def fits_kalman_filter(c: Controller) -> bool:
    """Whether a controller has covariances for a filter of the mechanical states: an LQG with integrals."""
    return c.noise is not None and not c.observed


def _noise_of(plant: Plant, c: Controller, kind: str) -> Noise:
    """The covariances of a controller; InputError for one that these filters do not fit."""
    if c.noise is None or not fits_kalman_filter(c):
        without = "a PID" if c.tracks == "states" else "a law of errors"
        found = without if c.noise is None else "forces of disturbance in its own"
        raise InputError("simulate", f"estimator {kind}", found, "an LQG with integrals")
    believed = plant_of(c.parameters)
    believed.require_second_order(f"estimator {kind}")
    if is_commutated(believed):
        found = f"a {plant.name}, whose currents are held between samples"
        raise InputError("simulate", f"estimator {kind}", found, "steady-state, which knows of that")
    return c.noise


def _kalman_filter(c: Controller, noise: Noise) -> Any:
    """filterpy's filter with the covariances of the gain file, process noise held over a sample.

    Correlations of readings with accelerations are left out: they shape the filter in steady state.
    """
    from filterpy.kalman import ExtendedKalmanFilter  # brings scipy.stats: half a second to import

    n, p = len(c.A), len(c.measurements)
    kalman = ExtendedKalmanFilter(dim_x=n, dim_z=p, dim_u=len(c.forces))
    coordinates = c.cost.coordinates if c.cost else "signals"
    G = _constant_force_map(c)
    if coordinates != "signals":
        G = sample(c.A, noise_input(c.B, coordinates), c.sample_time)[1]
    kalman.Q = G * noise.process @ G.T
    kalman.R = np.diag(noise.sensor)
    kalman.x = np.zeros(n)
    return kalman


def _start_filter(kalman: Any, c: Controller, y: FloatArray) -> None:
    """Start from one measurement: positions P^-1 y with their covariance S, zero rates with 2 diag(S) / Ts^2."""
    believed = plant_of(c.parameters)
    symbol = ca.SX.sym("y", len(y))
    q = believed.position_of(symbol)
    values = ca.Function("q", [symbol], [q, ca.jacobian(q, symbol)])(y)
    position, J = np.array(values[0]).ravel(), np.array(values[1])
    half = len(position)
    kalman.x = np.concatenate([position, np.zeros(len(c.A) - half)])
    spread = J @ kalman.R @ J.T
    kalman.P = np.zeros((len(c.A), len(c.A)))
    kalman.P[:half, :half] = spread
    kalman.P[half:, half:] = 2 * np.diag(np.diag(spread)) / c.sample_time**2


def _linear_prediction(c: Controller) -> Callable[..., tuple[FloatArray, FloatArray]]:
    """(x, v, v0) -> A x + B v, and A."""
    n, B = len(c.A), _constant_force_map(c)
    A = c.Ad[:n, :n]
    return lambda x, v, _: (A @ x + B @ v, A)


def _constant_force_map(c: Controller) -> FloatArray:
    """What forces that are constant over a sample add to the mechanical states: n x m."""
    n, m = len(c.A), len(c.forces)
    if c.lagging:
        return sample(c.A, c.B, c.sample_time)[1]
    return c.Ad[:n, n : n + m] if c.delay else c.Bd[:n]


def _acting_force(c: Controller) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """(forces under way, force sent) -> forces over the next sample; of lagging forces a constant equivalent."""
    n, m = len(c.A), len(c.forces)
    if not c.lagging:
        return lambda under_way, sent: under_way[:m] if c.delay else sent
    back = np.linalg.pinv(_constant_force_map(c))
    A, B = back @ c.Ad[:n, n:], back @ c.Bd[:n]
    return lambda under_way, sent: A @ under_way + B @ sent


def _nonlinear_prediction(c: Controller) -> Callable[..., tuple[FloatArray, FloatArray]]:
    """(x, v, v0) -> one sample of the controller's machine under v + v0, with loads and bearings; and its Jacobian."""
    believed = plant_of(c.parameters)
    x, u = ca.SX.sym("x", len(believed.states)), ca.SX.sym("u", len(c.forces))
    h = c.sample_time / 4

    def rate(z: Any, _: int) -> Any:
        return believed.f(z, u, believed.load(z) + believed.bearing(z))

    z = x
    for _ in range(4):
        z = runge_kutta(rate, z, h)
    chosen = list(believed.controlled)
    step = ca.Function("step", [x, u], [z[chosen], ca.jacobian(z, x)[chosen, chosen]])

    def predict(estimate: FloatArray, v: FloatArray, v0: FloatArray) -> tuple[FloatArray, FloatArray]:
        full = np.zeros(len(believed.states))
        full[chosen] = estimate
        after, F = step(full, v + v0)
        return np.array(after).ravel(), np.array(F)

    return predict


def _measurement(c: Controller) -> tuple[Callable[..., FloatArray], Callable[..., FloatArray]]:
    """The functions x -> dh/dx and x -> h(x) of the controller's machine."""
    believed = plant_of(c.parameters)
    x = ca.SX.sym("x", len(c.A))
    full = ca.SX.zeros(len(believed.states))
    full[list(believed.controlled)] = x
    y = believed.h(full, 0)
    function = ca.Function("h", [x], [y, ca.jacobian(y, x)])
    return (
        lambda estimate: np.array(function(estimate)[1]),
        lambda estimate: np.array(function(estimate)[0]).ravel(),
    )
