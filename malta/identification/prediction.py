"""Parameters from prediction errors in time: a Kalman filter of the whole machine that runs over a log.

    e_k = y_k - h(x_k),    x_k+ = x_k + K w_k e_k,    x_k+1 = F(x_k+, i_k, i_k+1, theta) + process noise

F is the machine without linearization, integrated over a sample with the currents as measured at both ends; constant
accelerations that no parameter explains are estimated beside theta, and the first state. K is the steady gain of the
filter at the place of the log. Missing readings have the weight 0; others 1, or with Student's likelihood
(nu + 1) / (nu + (e / s)^2), so that an outlier moves neither the filter nor the parameters.

The slopes of e are those of the linear machine behind the same filter. An error of theirs, of the size of the machine's
curvature, slows the search and does not move where it ends: sum of (de/dtheta)' w e / s^2 = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.ndimage import median_filter
from scipy.optimize import minimize
from scipy.signal import lfilter

from malta.errors import CheckError
from malta.identification.response import ResponseModel, acting, axes_of, current_rate
from malta.model.parameters import symbolic_names, twins_of
from malta.model.plant import Plant, symbolic
from malta.simulation.engine.compiled import library
from malta.simulation.engine.engines import evaluate
from malta.simulation.period import runge_kutta
from malta.synthesis.riccati import dare

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

BLOCK = 1000  # samples in one call
FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared")
PASSES = 8  # of the filter over the log, at most
SETTLED = 0.05  # standard deviations: steps of all parameters that are smaller end the search
NORMAL = 1e12  # degrees of freedom with which Student's distribution is the normal one
STUDENT = 4.0  # degrees of freedom against outliers
SPAN = 7  # readings: a reading's neighbours
SPIKE = 20.0  # times the usual distance from the median of the neighbours
OUTLIER = 6.0  # standard deviations
SLOWEST = 20.0  # over the record's length, rad/s: with which the filter forgets the process noise at least
BINS = 400  # between the lines, from which the process noise is found


@dataclass(frozen=True, eq=False)
class Predicted:
    """What the filter found in a log.

    values : of the parameters, SI
    covariance : of the values, SI
    rms : by output: of the innovations over their expected size
    outliers : readings that are more than 6 standard deviations off
    missing : readings that are missing
    process : by position: rms of a sample of the process noise, m/s2 or rad/s2
    readings : k x p, those of the log, with predictions in place of missing ones and of outliers
    """

    values: FloatArray
    covariance: FloatArray
    rms: FloatArray
    outliers: int
    missing: int
    process: FloatArray
    readings: FloatArray


class Noise(NamedTuple):
    """Variances of a sample: of the sensors by output, and of accelerations by position."""

    sensors: FloatArray
    process: FloatArray


def noise_between_lines(
    model: ResponseModel, theta: FloatArray, w: FloatArray, e: ComplexArray, N: int
) -> Noise:
    """The noise of sensors and process from e = Y - G I at bins between the lines.

    The covariance at a bin is R + H(w) Q H(w)^H, with the response H from accelerations to outputs; R and Q are
    diagonal and minimize the sum of ln det + e^H covariance^-1 e (P. Whittle, Ark. Mat. 2, 1953).

    w : bins, rad/s
    e : bins x p
    N : samples of the record
    """
    if len(w) > BINS:
        chosen = np.unique(np.linspace(0, len(w) - 1, BINS).round().astype(int))
        w, e = w[chosen], e[chosen]
    A, _, C, _ = model.matrices(theta)
    n = len(A) // 2
    push = np.vstack([np.zeros((n, n)), np.eye(n)])
    H = C @ np.linalg.solve(1j * w[:, None, None] * np.eye(2 * n) - A, push)
    size = (np.abs(e) ** 2).mean(axis=0)
    unit, H = e / np.sqrt(size), H / np.sqrt(size)[:, None]
    strength = (np.abs(H) ** 2).sum(axis=1).mean(axis=0)  # of each position
    H = H / np.sqrt(strength)
    p = len(size)
    kinds = np.concatenate([np.tile(np.eye(p), (len(w), 1, 1)), H], axis=2)  # bins x p x (p + n)

    def cost(logarithms: FloatArray) -> tuple[float, FloatArray]:
        scale = np.exp(logarithms)
        P = (kinds * scale) @ kinds.conj().transpose(0, 2, 1)
        inverse = np.linalg.inv(P)
        seen = kinds.conj().transpose(0, 2, 1) @ inverse  # bins x (p + n) x p
        slope = np.einsum("bjp,bpj->j", seen, kinds).real - (
            np.abs(np.einsum("bjp,bp->bj", seen, unit)) ** 2
        ).sum(0)
        value = np.linalg.slogdet(P)[1].sum() + np.einsum("bp,bpq,bq->", unit.conj(), inverse, unit).real
        return float(value), slope * scale

    bounds = [(-6.0, 2.0)] * p + [(-16.0, 4.0)] * n
    start = np.concatenate([np.zeros(p), np.full(n, -6.0)])
    found = np.exp(minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x)
    return Noise(N * size * found[:p], N * found[p:] / strength)


class _Linear(NamedTuple):
    """The filter about the place of the log: F ~ A x, y ~ C x, gain K, and s, the size of innovations."""

    A: FloatArray
    C: FloatArray
    K: FloatArray
    s: FloatArray


def _filter(model: ResponseModel, theta: FloatArray, noise: Noise, length: float) -> _Linear:
    """The steady filter. Process noise below what lets it forget within the record is raised to that."""
    A, _, C, _ = model.matrices(theta)
    n, Ts = len(A) // 2, model.sample_time
    Ad = expm(A * Ts)
    at_positions = (np.linalg.pinv(C[:, :n]) ** 2) @ noise.sensors
    least = (SLOWEST / length) ** 4 * at_positions
    G = np.vstack([Ts**2 / 2 * np.eye(n), Ts * np.eye(n)])
    Q, R = (G * np.maximum(noise.process, least)) @ G.T, np.diag(noise.sensors)
    P = dare(Ad.T, C.T, Q, R, what="filter of a log").X
    size = C @ P @ C.T + R
    return _Linear(Ad, C, np.linalg.solve(size, C @ P).T, np.sqrt(np.diag(size)))


class _Shape(NamedTuple):
    """What the functions of a filter depend on, but for numbers."""

    plant: Plant
    names: tuple[
        str, ...
    ]  # of the parameters whose slopes are written: all that act, so that one text serves
    currents: tuple[str, ...]
    sample_time: float


@lru_cache(maxsize=8)
def _chain(shape: _Shape) -> ca.Function:
    """BLOCK samples of the filter, compiled where a C compiler works.

    (x; i_k, i_k+1, y, whether it is there; numbers, errors of sensors, d, K, s, nu, rate), a column a sample ->
    x, (e, w, slopes of accelerations and of readings in the parameters)
    """
    plant, par = shape.plant, shape.plant.parameters
    n, p, m, Ts = len(plant.controlled), len(plant.outputs), len(shape.currents), shape.sample_time
    value = {name: ca.SX.sym(name) for name in symbolic_names(par)}
    error = {s.name: ca.SX.sym(s.name) for s in plant.sensor_errors}
    twins = {name: value[twin] for name, twin in twins_of(par).items()}
    machine = plant.variant(symbolic(par, value | twins))
    theta = ca.vertcat(*((value | error)[name] for name in shape.names))
    x, i, after, y, there = (ca.SX.sym("signal", size) for size in (n, m, m, p, p))
    d, K, s = ca.SX.sym("d", n // 2), ca.SX.sym("K", n, p), ca.SX.sym("s", p)
    nu, rate = ca.SX.sym("nu"), ca.SX.sym("rate")
    axes, keep = [a.name for a in axes_of(plant)], list(plant.controlled)

    def whole(own: Any) -> Any:
        state = ca.SX.zeros(len(plant.states))
        state[keep] = own
        return state

    def slope(z: Any, share: Any) -> Any:
        flowing, state = ca.SX.zeros(len(axes)), whole(z)
        flowing[[axes.index(name) for name in shape.currents]] = i + share * (after - i)
        force = machine.forces(state, flowing) if plant.windings is None else machine.drive.force(flowing)
        return machine.f(state, force, machine.load(state))[keep] + ca.vertcat(ca.SX.zeros(n // 2), d)

    # At half of a sample: 1/2 of a current that goes evenly, more of one that lags, 0 of one that is held.
    middle = ca.if_else(rate < 0, 0, 1 / (1 + ca.exp(-rate * Ts / 2)))
    shares = (0, middle, ca.if_else(rate < 0, 0, 1))
    read = machine.sense(whole(x), ca.vertcat(*error.values()))
    e = y - read
    w = there * (nu + 1) / (nu + (e / s) ** 2)
    better = x + K @ (w * e)
    moved = runge_kutta(lambda z, halves: slope(z, shares[halves]), better, Ts, n // 2)
    pushed = ca.jacobian(slope(x, middle)[n // 2 :], theta)
    constants = ca.vertcat(*value.values(), *error.values(), d, ca.vec(K), s, nu, rate)
    row = ca.vertcat(e, w, ca.vec(pushed), ca.vec(ca.jacobian(read, theta)))
    one = ca.Function(
        "one", [x, ca.vertcat(i, after, y, there), constants], ca.cse([ca.densify(moved), ca.densify(row)])
    )
    chain = one.mapaccum("chain", BLOCK)
    made = ca.CodeGenerator("chain")
    made.add(chain)
    compiled = library(made.dump(), 1, flags=FLAGS)
    return chain if compiled is None else ca.external(chain.name(), compiled._name)


class _Flight(NamedTuple):
    """A run of the filter: innovations and weights, k x p, and slopes of accelerations and of readings."""

    e: FloatArray
    w: FloatArray
    pushed: FloatArray  # k x parameters x positions
    read: FloatArray  # k x parameters x p


class _Search(NamedTuple):
    """What the runs of a search share."""

    model: ResponseModel
    linear: _Linear
    i: FloatArray
    y: FloatArray  # 0 where missing
    there: FloatArray
    nu: float


def _fly(s: _Search, theta: FloatArray, d: FloatArray, x: FloatArray) -> _Flight:
    """Run the filter over the log from the state x."""
    model, plant = s.model, s.model.plant
    par, names = plant.parameters, model.names
    own = dict(zip(names, theta.tolist(), strict=True))
    twins = twins_of(par)
    value = [own.get(n, own.get(twins.get(n, ""), float(getattr(par, n)))) for n in symbolic_names(par)]
    error = [own.get(signal.name, 0.0) for signal in plant.sensor_errors]
    rate = current_rate(plant)
    numbers = np.concatenate(
        [value, error, d, s.linear.K.T.ravel(), s.linear.s, [s.nu, rate if np.isfinite(rate) else -1.0]]
    )
    errors = tuple(signal.name for signal in plant.sensor_errors)
    known = tuple(dict.fromkeys((*acting(plant), *errors, *names)))
    chain = _chain(_Shape(plant, known, model.currents, model.sample_time))
    places, p, half = [known.index(name) for name in names], len(plant.outputs), len(d)
    chosen = np.arange(2 * p), *(2 * p + half * k + np.arange(half) for k in places)
    of_readings = (2 * p + half * len(known) + p * k + np.arange(p) for k in places)
    columns = np.concatenate([*chosen, *of_readings])
    constants, rows = np.tile(numbers, (BLOCK, 1)), []
    inputs = np.hstack([s.i, np.vstack([s.i[1:], s.i[-1:]]), s.y, s.there])
    for first in range(0, len(inputs), BLOCK):
        block = inputs[first : first + BLOCK]
        count = len(block)
        if count < BLOCK:
            block = np.vstack([block, np.repeat(block[-1:], BLOCK - count, axis=0)])
        states, row = evaluate(chain, x, block, constants)
        x = states[-1]
        rows.append(row[:count, columns])
    row = np.vstack(rows)
    if not np.isfinite(row).all():
        raise FloatingPointError
    c = len(names)
    parts = np.split(row, np.cumsum([p, p, c * half]), axis=1)
    return _Flight(parts[0], parts[1], parts[2].reshape(-1, c, half), parts[3].reshape(-1, c, p))


class _Modes(NamedTuple):
    """The linear filter's states as modes: x = V z, z_k+1 = values z_k."""

    values: ComplexArray
    V: ComplexArray
    inverse: ComplexArray
    accelerated: ComplexArray  # by accelerations
    corrected: ComplexArray  # by readings


def _modes(s: _Search) -> _Modes:
    """The modes of the linear filter, of a pair the one above the real axis, whose real part counts twice."""
    A, C, K, _ = s.linear
    n, Ts = len(A), s.model.sample_time
    values, V = np.linalg.eig(A @ (np.eye(n) - K @ C))
    inverse = np.linalg.inv(V)
    upper = values.imag >= 0
    G = np.vstack([Ts**2 / 2 * np.eye(n // 2), Ts * np.eye(n // 2)])
    inverse = inverse[upper]
    V = (V * np.where(values.imag > 0, 2.0, 1.0))[:, upper]
    return _Modes(values[upper] + 0j, V + 0j, inverse + 0j, inverse @ G + 0j, inverse @ A @ K + 0j)


def _normal(s: _Search, flight: _Flight) -> tuple[FloatArray, FloatArray]:
    """Sums of E' w E / s^2 and of E' w e / s^2 over the log, with the slopes E of e in parameters, constant
    accelerations and the first state."""
    modes, p, k = _modes(s), s.y.shape[1], len(s.y)
    c, half, n = len(s.model.names), modes.accelerated.shape[1], modes.inverse.shape[1]
    seen = s.linear.C @ modes.V
    constant = modes.accelerated / (1 - modes.values)[:, None]
    left = np.hstack([constant, -modes.inverse])  # what powers of the modes add to `settled`
    decaying = (seen.T[:, None, :] * left[:, :, None]).reshape(len(left), -1)
    settled = -(seen @ constant).real.T
    memory = np.zeros((c, len(modes.values)), dtype=complex)
    N, g = np.zeros((c + half + n,) * 2), np.zeros(c + half + n)
    weight = flight.w / s.linear.s**2
    for first in range(0, k, 20 * BLOCK):
        part = slice(first, min(first + 20 * BLOCK, k))
        count = part.stop - first
        E = np.empty((c + half + n, count, p))
        for j in range(c):
            u = modes.accelerated @ flight.pushed[part, j].T - modes.corrected @ flight.read[part, j].T
            for row, value in enumerate(modes.values):
                u[row], memory[j, row : row + 1] = lfilter(
                    [0, 1], [1, -value], u[row], zi=memory[j, row : row + 1]
                )
            E[j] = -(seen @ u).real.T - flight.read[part, j]
        powers = modes.values ** np.arange(first, part.stop)[:, None]
        E[c:] = (powers @ decaying).real.reshape(count, half + n, p).transpose(1, 0, 2)
        E[c : c + half] += settled[:, None, :]
        flat = E.reshape(len(E), -1)
        heavy = flat * weight[part].ravel()
        N += heavy @ flat.T
        g += heavy @ flight.e[part].ravel()
    return N, g


def without_spikes(y: FloatArray) -> FloatArray:
    """Readings without those that stick out of their neighbours' median: NaN in place of them.

    y : k x p
    """
    off = np.abs(y - median_filter(y, size=(SPAN, 1), mode="nearest"))
    return np.where(off > SPIKE * np.maximum(np.nanmedian(off, axis=0), np.nanmean(off, axis=0)), np.nan, y)


def predict(
    model: ResponseModel,
    theta: FloatArray,
    noise: Noise,
    i: FloatArray,
    y: FloatArray,
    *,
    source: str = "log",
    robust: bool = False,
) -> Predicted:
    """Parameters from the prediction errors of a log, from theta on.

    model : the machine where the log was made
    theta : parameters to start with, SI
    noise : of sensors and process
    i : k x currents, as measured
    y : k x p, NaN where a reading is missing
    source : of the log, for errors
    robust : Student's likelihood with 4 degrees of freedom in place of the normal one

    Raises CheckError for a filter that does not follow the log.
    """
    there = np.isfinite(y).astype(float)
    linear = _filter(model, theta, noise, len(y) * model.sample_time)
    s = _Search(model, linear, i, np.where(there > 0, y, 0.0), there, STUDENT if robust else NORMAL)
    n, c = len(linear.A), len(theta)
    half, x = n // 2, np.array(model.place[list(model.plant.controlled)])
    d = np.zeros(half)
    theta, covariance = np.array(theta), np.zeros((c, c))
    for _ in range(PASSES):
        try:
            flight = _fly(s, theta, d, x)
        except FloatingPointError:
            raise CheckError(
                f"{source}: the filter does not follow the log: another machine than the model"
            ) from None
        N, g = _normal(s, flight)
        unit = np.sqrt(np.diag(N))
        step = -np.linalg.lstsq(N / np.outer(unit, unit), g / unit, rcond=1e-13)[0] / unit
        inverse = np.linalg.pinv(N / np.outer(unit, unit), rcond=1e-13) / np.outer(unit, unit)
        covariance = inverse[:c, :c]
        theta, d, x = theta + step[:c], d + step[c : c + half], x + step[c + half :]
        if (np.abs(step[:c]) < SETTLED * np.sqrt(np.diag(covariance))).all():
            break
    return _result(s, theta, covariance, flight, noise)


def _result(
    s: _Search, theta: FloatArray, covariance: FloatArray, flight: _Flight, noise: Noise
) -> Predicted:
    """The record of a search that ended."""
    size = flight.e / s.linear.s
    off = (np.abs(size) > OUTLIER) & (s.there > 0)
    kept = np.where((s.there > 0) & ~off, size, np.nan)
    rms = np.sqrt(np.nanmean(kept**2, axis=0))
    predicted = s.y - flight.e
    gone = (s.there == 0) | off
    spread = max(1.0, float(np.nanmean(kept**2)))
    if (
        s.nu < NORMAL
    ):  # of weights that depend on e: the mean of score^2 over that of the score's slope, squared
        w = flight.w
        slope = (w * (1 - 2 * w * size**2 / (s.nu + 1))).sum() / w.sum()
        spread = float((w**2 * size**2).sum() / w.sum() / slope**2)
    return Predicted(
        theta, spread * covariance, rms, int(off.sum()), int((s.there == 0).sum()),
        np.sqrt(noise.process), np.where(gone, predicted, s.y),
    )  # fmt: skip
