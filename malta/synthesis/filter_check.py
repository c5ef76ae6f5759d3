"""An observer's gain, found once more: filterpy's Kalman filter runs until its covariance stands.

    predict: P = F P F' + Q      update: K = (P H' + M) (H P H' + H M + M' H' + R)^-1,  P = P - K (H P + M')

A continuous filter, as a design by backward Euler has, has the covariance P of a sampled one, for any rate b in rad/s:

    F = V (I + A / b),  H = sqrt(2) C V,  Q = 2 V W V' / b,  R = b R_c + C V W V' C' / b,  V = (I - A / b)^-1

with E[w n'] = sqrt(2) V W V' C' / b. Near the rates of its poles few samples are enough.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError
from malta.linear.matrices import eigenvalues
from malta.model.linearize import LinearModel, linearize
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.filters import intensities
from malta.synthesis.law import point_at
from malta.synthesis.riccati import EPS, care, lyapunov
from malta.synthesis.sampled_filters import Noisy, covariance, filter_gain, innovations, sampled_noise
from malta.synthesis.spec import Spec

SETTLED_SHARE = 1e-10  # of a covariance: what may be left of where it began
SAMPLES = 20_000  # at most, some seconds; what is left then is allowed
ALLOWED_ERROR = 1e-7  # of the gain, in units in which covariances are of one size


class FilterCheck(NamedTuple):
    """How far an observer's gain is from filterpy's.

    samples : that filterpy's filter ran
    apart : the largest difference of an entry of L relative to the largest, states in their standard deviations after a
        prediction, readings in those of their noise
    allowed : of `apart`, after so many samples
    """

    samples: int
    apart: float
    allowed: float


def check_filter(spec: Spec, model: LinearModel, controller: Controller) -> FilterCheck:
    """Run filterpy's KalmanFilter on a design's model until it stands, and compare its gain with the observer's.

    spec : of an LQG, from `malta.read_design`
    model : the machine's linear model that it is designed on
    controller : from `malta.synthesize`; with a schedule the law of each place is compared

    Returns a FilterCheck: `samples`, `apart`, `allowed`; the worst of a schedule.

    Raises CheckError where the two are further apart than allowed.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> found = malta.synthesis.check_filter(spec, model, malta.synthesize(spec, model))
    >>> found.samples, found.apart < 1e-9
    (114, True)
    """
    made = controller.schedule
    if made is None:
        return _check_one(spec, model, controller.L)
    plant, x = spec.plant, model.operating_point.x
    models = [linearize(plant, point_at(plant, x, made.variable, place)) for place in made.places]
    checks = [_check_one(spec, *pair) for pair in zip(models, made.L, strict=True)]
    return max(checks, key=lambda one: one.apart / one.allowed)


@on_one_thread
def _check_one(spec: Spec, model: LinearModel, L: FloatArray) -> FilterCheck:
    n, weights, Ts = len(model.A), spec.weights, spec.sample_time
    continuous = spec.discretization == "backward-euler"
    if continuous:
        A, W, along = intensities(model, weights)
        V = np.diag(weights.sensor_variance)
        P, K, _ = care(A.T, model.C.T, W, V, "Kalman filter")
        noisy = _sampled_alike(A, model.C, W, V, eigenvalues(A - K.T @ model.C))
    else:
        known, integrated = spec.delay + spec.current_lag, spec.discretization == "sampled-data"
        noisy = sampled_noise(model, weights, Ts, known, integrated=integrated)
        P = covariance(noisy)
    t, s = np.sqrt(np.where(np.diag(P) > 0, np.diag(P), 1.0)), np.sqrt(weights.sensor_variance)
    noisy = _in_units(noisy, t, np.sqrt(np.diag(noisy.R)))
    samples, allowed = _patience(noisy, P / np.outer(t, t))
    P, K = _run(noisy, samples)
    if continuous:
        Lc = (P * np.outer(t, t)) @ model.C.T / weights.sensor_variance + along
        K = np.linalg.solve(np.eye(n) - Ts * (model.A - Lc @ model.C), Ts * Lc) * s / t[:, None]
    stored = len(L) - len(K)  # forces that are known have rows of zeros
    observer = np.vstack([L[:n], L[n + stored :]]) * s / t[:, None]
    apart = float(np.abs(K - observer).max() / np.abs(observer).max())
    if not apart <= allowed:
        said = f"after {samples} samples filterpy's gain is {apart:.1e} from the observer's"
        raise CheckError(f"{spec.path}: Kalman filter: {said}, allowed {allowed:.1e}")
    return FilterCheck(samples, apart, allowed)


def _in_units(noisy: Noisy, t: FloatArray, s: FloatArray) -> Noisy:
    """The same with states that count in t and readings that count in s."""
    F, H, Q, R, M = noisy
    return Noisy(
        F * t / t[:, None], H * t / s[:, None], Q / np.outer(t, t), R / np.outer(s, s), M / np.outer(t, s)
    )


def _patience(noisy: Noisy, P: FloatArray) -> tuple[int, float]:
    """How many samples a filter runs that begins with ones, and how far its gain may then be off.

    With F_c = F (I - K H) what it began with shrinks as F_c^k (I - P) F_c'^k, and the rounding of each F P F' adds up
    as the sum of these.

    P : in the steady state
    """
    size, one, K = partial(np.linalg.norm, ord=2), np.eye(len(P)), filter_gain(noisy, P)
    closed = noisy.F @ (one - K @ noisy.H)
    slowest = float(np.abs(eigenvalues(closed)).max())
    samples = min(math.ceil(math.log(SETTLED_SHARE) / (2 * math.log(max(slowest, 0.5)))), SAMPLES)
    left = size(np.linalg.matrix_power(closed, samples)) ** 2 * size(one - P)
    rounding = EPS * size(lyapunov(closed.T, one, discrete=True)) * size(noisy.F) ** 2 * size(P)
    moved = size(np.linalg.solve(innovations(noisy, P), noisy.H)) / np.abs(K).max()
    return samples, float(ALLOWED_ERROR + 10 * moved * (left + rounding))


def _run(noisy: Noisy, samples: int) -> tuple[FloatArray, FloatArray]:
    """P after a prediction and K of filterpy's filter after some samples, from a covariance of ones."""
    from filterpy.kalman import KalmanFilter

    run = KalmanFilter(dim_x=len(noisy.F), dim_z=len(noisy.H))
    run.F, run.H, run.Q, run.R, run.M = noisy
    update = run.update_correlated if noisy.M.any() else run.update
    reading = np.zeros((len(noisy.H), 1))
    for _ in range(samples):
        run.predict()
        update(reading)
    return run.P_prior, run.K


def _sampled_alike(A: FloatArray, C: FloatArray, W: FloatArray, V: FloatArray, poles: ComplexArray) -> Noisy:
    """A sampled machine whose filter has the covariance of a continuous one's, of x' = A x + w, y = C x + n.

    The noise of its reading is correlated with what acts after it; taken off, with the reading, the rest is not.

    poles : of the continuous filter, rad/s: the rate is amid them, and no pole of the machine
    """
    size, own, one = np.abs(poles), eigenvalues(A), np.eye(len(A))
    rates = np.sqrt(size.max() * size.min()) * np.array([1.0, 1.1, 1.2, 1.3])
    rate = max(rates, key=lambda rate: np.abs(own / rate - 1).min())
    back = np.linalg.inv(one - A / rate)
    pushed = back @ W @ back.T / rate
    H, R = np.sqrt(2) * C @ back, rate * V + C @ pushed @ C.T
    along = np.linalg.solve(R, np.sqrt(2) * C @ pushed).T
    Q = 2 * pushed - along @ R @ along.T
    return Noisy(back @ (one + A / rate) - along @ H, H, (Q + Q.T) / 2, R, np.zeros_like(H.T))
