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

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.ndimage import median_filter
from scipy.optimize import minimize

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError
from malta.identification.readers.stored import StoredTable, store_rows
from malta.identification.response import Flow, ResponseModel, axes_of, flow_of
from malta.model.parameters import symbolic_names, twins_of
from malta.model.plant import Plant, symbolic
from malta.simulation.engine.sample_loops import SampleLoop, loop_of
from malta.simulation.period import runge_kutta
from malta.synthesis.riccati import dare

BLOCK = 1000  # samples that are summed up together
RUN_SAMPLES = 50_000  # samples that the filter runs through before its sums are taken
PREFIX = 200_000  # samples of a long record that are run through again
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
LOST_LOG = "the filter does not follow the log: another machine than the model"
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
    expected : by output: the size that innovations should have, SI
    loads : constant accelerations that no parameter explains, m/s2 or rad/s2
    begin : the first state, SI
    """

    values: FloatArray
    covariance: FloatArray
    rms: FloatArray
    outliers: int
    missing: int
    process: FloatArray
    readings: FloatArray
    expected: FloatArray
    loads: FloatArray
    begin: FloatArray


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
def _filter_loop(shape: _Shape) -> SampleLoop:
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
def _slope_loop(shape: _Shape, names: tuple[str, ...], count: int) -> SampleLoop:
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
    i: FloatArray  # k x currents; of a long record both stay in their file
    y: FloatArray  # k x p, NaN where missing
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
    """A run of the filter over some samples: y with 0 where one is missing, and whether it is there, innovations and
    weights, k x p, states after each correction, k x n, and the currents at both ends of each sample."""

    first: int  # the number of its first sample
    y: FloatArray
    there: FloatArray
    e: FloatArray
    w: FloatArray
    x: FloatArray
    ends: tuple[FloatArray, FloatArray]


def current_shares(flow: Flow, steps: int) -> FloatArray:
    """Shares of the current at the end of a sample at begin, middle and end of each step of it, and their mean.

    The rest is that at its begin. The shares f of a step have the first two moments of the current, sum of f and of
    (1 - t) f over it, as Runge and Kutta's method weighs them: so speed and place at its end are right for a current
    that settles within the step too.

    flow : of the current
    """
    t = np.arange(steps + 1) / steps
    if np.isinf(flow.rate):
        kept = (
            np.clip(flow.until / flow.sample_time - t[:-1], 0.0, 1 / steps) * steps
            if flow.until
            else np.ones(steps)
        )
        new = 1 - kept  # the end of each step has the value of the next sample
        middle = 3 * (new - new**2 / 2) - 0.5 * (new > 0)
        f = np.column_stack([3 * new**2 - 2 * middle, middle, new > 0])
        return np.append(f.ravel(), new.mean())
    a = flow.rate * flow.sample_time
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
    shares = current_shares(flow_of(plant, model.sample_time), s.shape.steps)
    return np.array([*value, *error, *shares])


def _fly(s: _Search, theta: FloatArray, d: FloatArray, x: FloatArray, count: int) -> Iterator[_FilterRun]:
    """Run the filter over the first `count` samples of the log from the state x, some of them at a time."""
    p, state = s.y.shape[1], np.array(x, dtype=float)
    numbers = np.concatenate([_numbers(s, theta), d, s.linear.K.T.ravel(), s.linear.s, [s.nu]])
    for first in range(0, count, RUN_SAMPLES):
        end = min(first + RUN_SAMPLES, count)
        i, y = np.asarray(s.i[first : end + 1]), np.asarray(s.y[first:end])
        after = i[1:] if len(i) > end - first else next_rows(i)
        i, there = i[: end - first], np.isfinite(y).astype(float)
        y = np.where(there > 0, y, 0.0)
        rows = _filter_loop(s.shape)(state, (i, after, y, there), numbers, state)
        if not np.isfinite(rows).all():
            raise FloatingPointError
        yield _FilterRun(first, y, there, rows[:, :p], rows[:, p : 2 * p], rows[:, 2 * p :], (i, after))


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


def _slopes(s: _Search, modes: _Modes, theta: FloatArray) -> Callable[[_FilterRun], FloatArray]:
    """The slopes of e in the parameters along the states of each run, from run to run: k x p x parameters."""
    stacked = (
        np.concatenate([part.real, part.imag]) for part in (modes.values, modes.accelerated, modes.corrected)
    )
    seen = np.hstack([modes.seen.real, -modes.seen.imag])
    numbers = np.concatenate([_numbers(s, theta), *(part.T.ravel() for part in (*stacked, seen))])
    count, c = len(modes.values), len(theta)
    loop, z = _slope_loop(s.shape, s.model.names, count), np.zeros(2 * count * c)

    def along(run: _FilterRun) -> FloatArray:
        return loop(z, (*run.ends, run.x), numbers, z).reshape(len(run.x), -1, c)

    return along


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
        turned = left * modes.values ** (flight.first + first)
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
    linear = _filter(model, theta, noise, len(y) * model.sample_time)
    s = _Search(model, linear, i, y, STUDENT if robust else FREEDOM)
    begin = _SearchPoint(
        np.array(theta), np.zeros(len(linear.A) // 2), np.array(model.place[list(model.plant.controlled)])
    )
    try:
        at, normal, tally = _minimize(s, begin)
        readings = _readings(s, at) if robust or tally.missing else y
    except FloatingPointError:
        raise CheckError(f"{source}: {LOST_LOG}") from None
    c = len(theta)
    covariance = tally.spread(s.nu) * _inverse(normal)[:c, :c]
    return Predicted(
        at.theta, covariance, np.sqrt(tally.squares / tally.kept), tally.outliers, tally.missing,
        np.sqrt(noise.process), readings, linear.s, at.d, at.x,
    )  # fmt: skip


def information_of(
    model: ResponseModel, noise: NoiseModel, i: FloatArray, y: FloatArray, source: str
) -> FloatArray:
    """What a log tells of parameters where the search starts, beside constant loads and the first state, 1 / SI^2.

    Raises CheckError for a filter that does not follow the log.
    """
    linear, count = _filter(model, model.start, noise, len(y) * model.sample_time), min(len(y), PREFIX)
    s, c = _Search(model, linear, i, y, FREEDOM), len(model.start)
    at = _SearchPoint(
        model.start, np.zeros(len(linear.A) // 2), np.array(model.place[list(model.plant.controlled)])
    )
    try:
        (normal, _), *_ = _pass(s, _modes(s), at, count, count, None)
    except FloatingPointError:
        raise CheckError(f"{source}: {LOST_LOG}") from None
    return len(y) / count * _beside_others(normal, c)


def _beside_others(normal: FloatArray, c: int) -> FloatArray:
    """The information of the first c unknowns of normal equations, with the others unknown too."""
    more = np.linalg.pinv(normal[c:, c:], rcond=1e-13, hermitian=True)
    return np.asarray(normal[:c, :c] - normal[:c, c:] @ more @ normal[c:, :c])


def innovations_of(
    model: ResponseModel, found: Predicted, noise: NoiseModel, i: FloatArray, y: FloatArray
) -> FloatArray:
    """The prediction errors of a log over their expected size, k x p; NaN where a reading is missing or an outlier."""
    linear = _filter(model, found.values, noise, len(y) * model.sample_time)
    s, parts = _Search(model, linear, i, y, FREEDOM), []
    for run in _fly(s, found.values, found.loads, found.begin, len(y)):
        size = run.e / linear.s
        parts.append(np.where((run.there > 0) & (np.abs(size) <= OUTLIER), size, np.nan))
    return np.concatenate(parts)


def _inverse(normal: FloatArray) -> FloatArray:
    """The inverse of normal equations, in units in which all are 1."""
    unit = np.outer(*[np.sqrt(np.diag(normal))] * 2)
    return np.asarray(np.linalg.pinv(normal / unit, rcond=1e-13) / unit)


class _SearchPoint(NamedTuple):
    """Where the search is: parameters, constant accelerations and the first state."""

    theta: FloatArray
    d: FloatArray
    x: FloatArray

    def step_by(self, step: FloatArray) -> _SearchPoint:
        """The point a step further."""
        c, half = len(self.theta), len(self.d)
        return _SearchPoint(self.theta + step[:c], self.d + step[c : c + half], self.x + step[c + half :])


def _minimize(s: _Search, begin: _SearchPoint) -> tuple[_SearchPoint, FloatArray, _Tally]:
    """The point where the prediction errors are least, their normal equations there, and what was counted.

    The first pass runs over the whole record, later ones over its first PREFIX samples. They tell how the gradient of
    the whole differs from its linear prediction, g(u) = g(0) + N u + (samples / PREFIX) (what is beyond it there). A
    record that is not longer is run through as a whole each time.
    """
    count, c = len(s.y), len(begin.theta)
    prefix, modes = min(count, PREFIX), _modes(s)
    whole, own, slopes, tally = _pass(s, modes, begin, count, prefix, None)
    (N, g), (N_own, g_own), u = whole, own, np.zeros(len(whole[1]))
    moved, ratio, at = np.inf, count / prefix, begin
    for k in range(PASSES):
        if k:
            renewed = None if moved > LARGE_STEP else slopes
            (N_own, g_own), _, slopes, counted = _pass(s, modes, at, prefix, prefix, renewed)
            tally = counted if prefix == count else tally
        left = g + N @ u + ratio * (g_own - own[1] - own[0] @ u)
        normal = N + ratio * (N_own - own[0])
        unit = np.sqrt(np.diag(normal))
        step = -np.linalg.lstsq(normal / np.outer(unit, unit), left / unit, rcond=1e-13)[0] / unit
        u, at = u + step, at.step_by(step)
        moved = float((np.abs(step[:c]) / np.sqrt(np.diag(_inverse(normal))[:c])).max())
        if moved < SETTLED_STEP:
            break
    return at, normal, tally


_Sums = tuple[FloatArray, FloatArray]


def _pass(
    s: _Search, modes: _Modes, at: _SearchPoint, count: int, prefix: int, slopes: list[FloatArray] | None
) -> tuple[_Sums, _Sums, list[FloatArray], _Tally]:
    """Run through the first `count` samples: sums of `_normal` over them and over the prefix, the slopes there, counts.

    slopes : those of an earlier pass, of each run; None: they are computed anew
    """
    whole: _Sums | None = None
    own: _Sums | None = None
    kept: list[FloatArray] = []
    tally = _Tally(s.y.shape[1])
    along = _slopes(s, modes, at.theta)
    for k, run in enumerate(_fly(s, at.theta, at.d, at.x, count)):
        E = along(run) if slopes is None else slopes[k]
        N, g = _normal(s, modes, run, E)
        whole = (N, g) if whole is None else (whole[0] + N, whole[1] + g)
        tally.add(run, run.e / s.linear.s, s.nu)
        if run.first < prefix:
            own = whole
            kept.append(E)
    assert whole is not None
    assert own is not None
    return whole, own, kept, tally


class _Tally:
    """What is counted of the innovations of a pass, in their expected sizes."""

    def __init__(self, outputs: int) -> None:
        self.squares, self.kept = np.zeros(outputs), np.zeros(outputs)
        self.outliers, self.missing = 0, 0
        self.weights = np.zeros(3)  # sums of w, of w (1 - 2 w size^2 / (nu + 1)) and of (w size)^2

    def add(self, run: _FilterRun, size: FloatArray, nu: float) -> None:
        """Count a run; size: its innovations over what is expected."""
        there = run.there > 0
        off = there & (np.abs(size) > OUTLIER)
        good = there & ~off
        self.squares += np.where(good, size**2, 0.0).sum(axis=0)
        self.kept += good.sum(axis=0)
        self.outliers += int(off.sum())
        self.missing += int((~there).sum())
        if nu < FREEDOM:
            w = run.w
            slope = w * (1 - 2 * w * size**2 / (nu + 1))
            self.weights += w.sum(), slope.sum(), (w**2 * size**2).sum()

    def spread(self, nu: float) -> float:
        """The variance of the innovations over what is expected; of weights that depend on e: mean score^2 over the
        squared mean of the score's slope."""
        if nu < FREEDOM:
            total, slope, score = self.weights
            return float(score / total / (slope / total) ** 2)
        return max(1.0, float(self.squares.sum() / self.kept.sum()))


def _readings(s: _Search, at: _SearchPoint) -> FloatArray:
    """The readings of the log, with predictions in place of missing ones and of outliers."""

    def blocks() -> Iterator[FloatArray]:
        for run in _fly(s, at.theta, at.d, at.x, len(s.y)):
            off = (run.there == 0) | (np.abs(run.e / s.linear.s) > OUTLIER)
            yield np.where(off, run.y - run.e, run.y)

    if isinstance(s.y, StoredTable):
        return cast("FloatArray", store_rows(blocks(), s.y.shape[1], s.y.path))
    return np.concatenate(list(blocks()))
