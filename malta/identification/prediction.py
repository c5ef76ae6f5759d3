"""Parameters from prediction errors in time: a Kalman filter of the whole machine that runs over a log.

    e_k = y_k - h(x_k),    x_k+ = x_k + K w_k e_k,    x_k+1 = F(x_k+, i_k, i_k+1, theta) + process noise

F is the machine without linearization, integrated over a sample in steps that are short beside its poles, with the
currents as measured at both ends; constant accelerations that no parameter explains are estimated beside theta, and the
first state. K is the steady gain of the filter at the place of the log. Missing readings have the weight 0; others 1,
or with Student's likelihood (nu + 1) / (nu + (e / s)^2), so that an outlier moves neither filter nor parameters.

The slopes of e are those of the linear machine behind the same filter. An error of theirs, of the size of the machine's
curvature, slows the search and does not move where it ends: sum of (de/dtheta)' w e / s^2 = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.ndimage import median_filter
from scipy.optimize import minimize

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError
from malta.identification.response import ResponseModel, axes_of, current_rate
from malta.model.parameters import symbolic_names, twins_of
from malta.model.plant import Plant, symbolic
from malta.simulation.engine.sample_loops import Loop, loop_of
from malta.simulation.period import runge_kutta
from malta.synthesis.riccati import dare

BLOCK = 1000  # samples that are summed up together
PASSES = 8  # of the filter over the log, at most
SETTLED_STEP = 0.05  # standard deviations: steps of all parameters that are smaller end the search
LARGE_STEP = 1.0  # standard deviations: after a larger step slopes are computed anew
FREEDOM = 1e12  # degrees of freedom with which Student's distribution is the normal one
STUDENT = 4.0  # degrees of freedom against outliers
SPAN = 7  # readings: a reading's neighbours
SPIKE = 20.0  # times the usual distance from the median of the neighbours
OUTLIER = 6.0  # standard deviations
FORGETTING_RATE = (
    20.0  # over the record's length, rad/s: the filter forgets the process noise at least so fast
)
STEP = 0.2  # over the fastest pole: about a step of the integration
MOST_STEPS = 32  # of a sample
MAX_LAG_SHARE = 1e-3  # of a sample, over the time constant of a current: what lags by less goes evenly
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


class NoiseModel(NamedTuple):
    """Variances of a sample: of the sensors by output, and of accelerations by position."""

    sensors: FloatArray
    process: FloatArray


def noise_between_lines(
    model: ResponseModel, theta: FloatArray, w: FloatArray, e: ComplexArray, N: int
) -> NoiseModel:
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
    H = _from_accelerations(model, theta, w)
    n = H.shape[2]
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
    return NoiseModel(N * size * found[:p], N * found[p:] / strength)


def _from_accelerations(model: ResponseModel, theta: FloatArray, w: FloatArray) -> ComplexArray:
    """The response from accelerations to outputs, bins x p x positions."""
    A, _, C, _ = model.matrices(theta)
    n = len(A) // 2
    push = np.vstack([np.zeros((n, n)), np.eye(n)])
    return np.asarray(C @ np.linalg.solve(1j * w[:, None, None] * np.eye(2 * n) - A, push))


def noise_covariances(
    model: ResponseModel, theta: FloatArray, noise: NoiseModel, w: FloatArray
) -> ComplexArray:
    """The covariance R + H(w) Q H(w)^H of a noise at each bin, bins x p x p, but for a factor.

    w : bins, rad/s
    """
    H = _from_accelerations(model, theta, w)
    return np.asarray(np.diag(noise.sensors) + (H * noise.process) @ H.conj().transpose(0, 2, 1))


class _LinearFilter(NamedTuple):
    """The filter about the place of the log: F ~ A x, y ~ C x, gain K, and s, the size of innovations."""

    A: FloatArray
    C: FloatArray
    K: FloatArray
    s: FloatArray


def _filter(model: ResponseModel, theta: FloatArray, noise: NoiseModel, length: float) -> _LinearFilter:
    """The steady filter. Process noise below what lets it forget within the record is raised to that."""
    A, _, C, _ = model.matrices(theta)
    n, Ts = len(A) // 2, model.sample_time
    Ad = expm(A * Ts)
    at_positions = (np.linalg.pinv(C[:, :n]) ** 2) @ noise.sensors
    least = (FORGETTING_RATE / length) ** 4 * at_positions
    G = np.vstack([Ts**2 / 2 * np.eye(n), Ts * np.eye(n)])
    Q, R = (G * np.maximum(noise.process, least)) @ G.T, np.diag(noise.sensors)
    P = dare(Ad.T, C.T, Q, R, what="filter of a log").X
    size = C @ P @ C.T + R
    return _LinearFilter(Ad, C, np.linalg.solve(size, C @ P).T, np.sqrt(np.diag(size)))


class _Shape(NamedTuple):
    """What the functions of a filter depend on, but for numbers."""

    plant: Plant
    currents: tuple[str, ...]
    sample_time: float
    apart: tuple[str, ...]  # parameters that differ from their twins
    steps: int  # of the integration in a sample


class _Equations(NamedTuple):
    """The machine in symbols: all states and parameters, and the currents at both ends of a sample."""

    numbers: Any  # parameters, errors of the sensors, shares of the currents
    named: dict[str, Any]  # symbols of parameters and errors
    x: Any
    ends: Any  # currents at the begin of the sample, and at its end
    slope: Callable[[Any, Any], Any]  # (states, share of the current at the end) -> x'
    shares: Any  # of the current at the end of a sample at begin, middle and end of each step, and their mean
    read: Any


def _equations(shape: _Shape) -> _Equations:
    plant, par = shape.plant, shape.plant.parameters
    n, m = len(plant.controlled), len(shape.currents)
    value = {name: ca.SX.sym(name) for name in symbolic_names(par)}
    error = {s.name: ca.SX.sym(s.name) for s in plant.sensors.errors}
    twins = {name: value[twin] for name, twin in twins_of(par).items() if name not in shape.apart}
    machine = plant.variant(symbolic(par, value | twins))
    x, i, after, shares = (ca.SX.sym("signal", size) for size in (n, m, m, 3 * shape.steps + 1))
    axes, keep = [a.name for a in axes_of(plant)], list(plant.controlled)

    def whole(own: Any) -> Any:
        state = ca.SX.zeros(len(plant.states))
        state[keep] = own
        return state

    def slope(z: Any, share: Any) -> Any:
        flowing, state = ca.SX.zeros(len(axes)), whole(z)
        flowing[[axes.index(name) for name in shape.currents]] = i + share * (after - i)
        wound = plant.actuator.windings is not None
        force = machine.drive.force(flowing) if wound else machine.actuator.forces(state, flowing)
        return machine.f(state, force, machine.load(state))[keep]

    read = machine.sensors.sense(whole(x), ca.vertcat(*error.values()))
    numbers = ca.vertcat(*value.values(), *error.values(), shares)
    return _Equations(numbers, value | error, x, ca.vertcat(i, after), slope, shares, read)


@lru_cache(maxsize=8)
def _filter_loop(shape: _Shape) -> Loop:
    """(x; i_k, i_k+1, y, whether it is there; numbers, d, K, s, nu) -> x, (e, w, better x) of each sample."""
    q = _equations(shape)
    n, p, half = q.x.numel(), q.read.numel(), q.x.numel() // 2
    y, there, s, d = (ca.SX.sym("signal", size) for size in (p, p, p, half))
    K, nu = ca.SX.sym("K", n, p), ca.SX.sym("nu")
    e = y - q.read
    w = there * (nu + 1) / (nu + (e / s) ** 2)
    better = q.x + K @ (w * e)
    constant = ca.vertcat(ca.SX.zeros(half), d)

    def rate(first: int, z: Any, halves: int) -> Any:
        return q.slope(z, q.shares[first + halves]) + constant

    moved, step = better, shape.sample_time / shape.steps
    for k in range(0, 3 * shape.steps, 3):
        moved = runge_kutta(partial(rate, k), moved, step, half)
    numbers = ca.vertcat(q.numbers, d, ca.vec(K), s, nu)
    return loop_of(q.x, ca.vertcat(q.ends, y, there), numbers, moved, ca.vertcat(e, w, better))


@lru_cache(maxsize=8)
def _slope_loop(shape: _Shape, names: tuple[str, ...], count: int) -> Loop:
    """Slopes of e in parameters by the modes of the linear filter: E = -Re(C V z) - read'.

    (z of each parameter; i_k, i_k+1, better x; numbers, modes) -> z, slopes of each output's e

    count : of the modes
    """
    q = _equations(shape)
    p, half = q.read.numel(), q.x.numel() // 2
    theta = ca.vertcat(*(q.named[name] for name in names))
    pushed = ca.jacobian(q.slope(q.x, q.shares[-1])[half:], theta)
    read = ca.jacobian(q.read, theta)
    z = ca.SX.sym("z", 2 * count, len(names))  # real parts, imaginary parts
    values, seen = ca.SX.sym("values", 2 * count), ca.SX.sym("seen", p, 2 * count)
    accelerated, corrected = ca.SX.sym("acc", 2 * count, half), ca.SX.sym("cor", 2 * count, p)
    real, imaginary = ca.diag(values[:count]), ca.diag(values[count:])
    turned = ca.vertcat(
        real @ z[:count, :] - imaginary @ z[count:, :], imaginary @ z[:count, :] + real @ z[count:, :]
    )
    after = turned + accelerated @ pushed - corrected @ read
    modes = (values, ca.vec(accelerated), ca.vec(corrected), ca.vec(seen))
    numbers = ca.vertcat(q.numbers, *modes)
    return loop_of(ca.vec(z), ca.vertcat(q.ends, q.x), numbers, ca.vec(after), ca.vec((-seen @ z - read).T))


class _Search(NamedTuple):
    """What the runs of a search share."""

    model: ResponseModel
    linear: _LinearFilter
    i: FloatArray
    after: FloatArray  # i one sample later
    y: FloatArray  # 0 where missing
    there: FloatArray
    nu: float

    @property
    def shape(self) -> _Shape:
        """What its functions depend on. A step of the integration takes about STEP over the machine's fastest pole."""
        model = self.model
        apart = tuple(name for name in twins_of(model.plant.parameters) if name in model.names)
        A = model.matrices(model.start)[0]
        fastest = float(np.abs(np.linalg.eigvals(A)).max()) * model.sample_time
        steps = min(max(1, round(fastest / STEP)), MOST_STEPS)
        return _Shape(model.plant, model.currents, model.sample_time, apart, steps)


class _FilterRun(NamedTuple):
    """A run of the filter: innovations and weights, k x p, and states after each correction, k x n."""

    e: FloatArray
    w: FloatArray
    x: FloatArray


def current_shares(rate: float, Ts: float, steps: int) -> FloatArray:
    """Shares of the current at the end of a sample at begin, middle and end of each step of it, and their mean.

    The rest is that at its begin. The shares f of a step have the first two moments of the current, sum of f and of
    (1 - t) f over it, as Runge and Kutta's method weighs them: so speed and place at its end are right for a current
    that settles within the step too.

    rate : of the current, 1/s; 0: it goes evenly; infinite: it is held
    """
    if np.isinf(rate):
        return np.zeros(3 * steps + 1)
    t = np.arange(steps + 1) / steps
    a = rate * Ts
    if a < MAX_LAG_SHARE:
        f = np.column_stack([t[:-1], (t[:-1] + t[1:]) / 2, t[1:]])
        return np.append(f.ravel(), 0.5)
    h, left = a / steps, 1 - np.exp(-a)
    own = np.exp(-a * t[:-1])
    # Means over a step of e^(-h s) and of (1 - s) e^(-h s).
    first = (1 - np.exp(-h)) / h
    second = (1 - first) / h
    sums, moments = (1 - own * first) / left, (0.5 - own * second) / left
    end = (1 - np.exp(-a * t[1:])) / left
    middle = (6 * sums - end - 6 * moments) / 2
    f = np.column_stack([6 * moments - 2 * middle, middle, end])
    return np.append(f.ravel(), sums.mean())


def _numbers(s: _Search, theta: FloatArray) -> FloatArray:
    """The numbers of a machine, as `_Equations` has them."""
    model, plant, par = s.model, s.model.plant, s.model.plant.parameters
    own = dict(zip(model.names, theta.tolist(), strict=True))
    twins = twins_of(par)
    value = [own.get(n, own.get(twins.get(n, ""), float(getattr(par, n)))) for n in symbolic_names(par)]
    error = [own.get(signal.name, 0.0) for signal in plant.sensors.errors]
    shares = current_shares(current_rate(plant), model.sample_time, s.shape.steps)
    return np.array([*value, *error, *shares])


def _fly(s: _Search, theta: FloatArray, d: FloatArray, x: FloatArray) -> _FilterRun:
    """Run the filter over the log from the state x."""
    p = s.y.shape[1]
    numbers = np.concatenate([_numbers(s, theta), d, s.linear.K.T.ravel(), s.linear.s, [s.nu]])
    rows = _filter_loop(s.shape)(x, (s.i, s.after, s.y, s.there), numbers)
    if not np.isfinite(rows).all():
        raise FloatingPointError
    return _FilterRun(rows[:, :p], rows[:, p : 2 * p], rows[:, 2 * p :])


class _Modes(NamedTuple):
    """The linear filter's states as modes: x = V z, z_k+1 = values z_k."""

    values: ComplexArray
    seen: ComplexArray  # by outputs
    inverse: ComplexArray
    accelerated: ComplexArray  # by accelerations
    corrected: ComplexArray  # by readings


def next_rows(table: FloatArray) -> FloatArray:
    """The next row of each row; the last one follows itself."""
    return np.concatenate([table[1:], table[-1:]])


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
    return _Modes(values[upper] + 0j, C @ V + 0j, inverse + 0j, inverse @ G + 0j, inverse @ A @ K + 0j)


def _slopes(s: _Search, modes: _Modes, theta: FloatArray, x: FloatArray) -> FloatArray:
    """The slopes of e in the parameters along the states x, k x p x parameters."""
    stacked = (
        np.concatenate([part.real, part.imag]) for part in (modes.values, modes.accelerated, modes.corrected)
    )
    seen = np.hstack([modes.seen.real, -modes.seen.imag])
    numbers = np.concatenate([_numbers(s, theta), *(part.T.ravel() for part in (*stacked, seen))])
    count, c = len(modes.values), len(theta)
    loop = _slope_loop(s.shape, s.model.names, count)
    return loop(np.zeros(2 * count * c), (s.i, s.after, x), numbers).reshape(len(x), -1, c)


def _normal(s: _Search, modes: _Modes, flight: _FilterRun, E: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sums of E' w E / s^2 and of E' w e / s^2 over the log, with the slopes of e in parameters, constant accelerations
    and the first state.

    Those in the last two are Re(values^k L) + settled. A block has the powers of the first one; its L is turned.

    E : k x p x parameters, slopes in parameters
    """
    _, p, c = E.shape
    half, n = modes.accelerated.shape[1], modes.inverse.shape[1]
    constant = modes.accelerated / (1 - modes.values)[:, None]
    settled = np.hstack([-(modes.seen @ constant).real, np.zeros((p, n))])[:, :, None]
    left = np.hstack([constant, -modes.inverse]).T * modes.seen[:, None, :]  # p x (half + n) x modes
    powers = modes.values ** np.arange(BLOCK)[:, None]
    basis = np.hstack([powers.real, powers.imag, np.ones((BLOCK, 1))])
    size = basis.shape[1]
    products = (basis[:, :, None] * basis[:, None, :]).reshape(BLOCK, -1)
    N, g = np.zeros((c + half + n,) * 2), np.zeros(c + half + n)
    for first in range(0, len(E), BLOCK):
        part = slice(first, first + BLOCK)
        w = flight.w[part] / s.linear.s**2
        own, weighed = E[part], w * flight.e[part]
        heavy, count = own * w[:, :, None], len(own)
        turned = left * modes.values**first
        L = np.concatenate([turned.real, -turned.imag, settled], axis=2)
        mixed = (heavy.reshape(count, -1).T @ basis[:count]).reshape(p, c, size)
        told = (w.T @ products[:count]).reshape(p, size, size)
        N[:c, :c] += heavy.reshape(-1, c).T @ own.reshape(-1, c)
        N[:c, c:] += (mixed @ L.transpose(0, 2, 1)).sum(axis=0)
        N[c:, c:] += (L @ told @ L.transpose(0, 2, 1)).sum(axis=0)
        g[:c] += weighed.ravel() @ own.reshape(-1, c)
        g[c:] += (L @ (weighed.T @ basis[:count])[:, :, None]).sum(axis=0)[:, 0]
    N[c:, :c] = N[:c, c:].T
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
    noise: NoiseModel,
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
    s = _Search(
        model, linear, i, next_rows(i), np.where(there > 0, y, 0.0), there, STUDENT if robust else FREEDOM
    )
    n, c = len(linear.A), len(theta)
    half, x = n // 2, np.array(model.place[list(model.plant.controlled)])
    d = np.zeros(half)
    theta, covariance, modes, moved = np.array(theta), np.zeros((c, c)), _modes(s), np.inf
    for _ in range(PASSES):
        try:
            flight = _fly(s, theta, d, x)
        except FloatingPointError:
            raise CheckError(
                f"{source}: the filter does not follow the log: another machine than the model"
            ) from None
        if moved > LARGE_STEP:
            E = _slopes(s, modes, theta, flight.x)
        N, g = _normal(s, modes, flight, E)
        unit = np.sqrt(np.diag(N))
        step = -np.linalg.lstsq(N / np.outer(unit, unit), g / unit, rcond=1e-13)[0] / unit
        inverse = np.linalg.pinv(N / np.outer(unit, unit), rcond=1e-13) / np.outer(unit, unit)
        covariance = inverse[:c, :c]
        theta, d, x = theta + step[:c], d + step[c : c + half], x + step[c + half :]
        moved = float((np.abs(step[:c]) / np.sqrt(np.diag(covariance))).max())
        if moved < SETTLED_STEP:
            break
    return _result(s, theta, covariance, flight, noise)


def _result(
    s: _Search, theta: FloatArray, covariance: FloatArray, flight: _FilterRun, noise: NoiseModel
) -> Predicted:
    """The record of a search that ended."""
    size = flight.e / s.linear.s
    off = (np.abs(size) > OUTLIER) & (s.there > 0)
    kept = np.where((s.there > 0) & ~off, size, np.nan)
    rms = np.sqrt(np.nanmean(kept**2, axis=0))
    predicted = s.y - flight.e
    gone = (s.there == 0) | off
    spread = max(1.0, float(np.nanmean(kept**2)))
    if s.nu < FREEDOM:  # of weights that depend on e: mean score^2 over the squared mean of the score's slope
        w = flight.w
        slope = (w * (1 - 2 * w * size**2 / (s.nu + 1))).sum() / w.sum()
        spread = float((w**2 * size**2).sum() / w.sum() / slope**2)
    return Predicted(
        theta, spread * covariance, rms, int(off.sum()), int((s.there == 0).sum()),
        np.sqrt(noise.process), np.where(gone, predicted, s.y),
    )  # fmt: skip
