"""Filters that do without one sensor: their gains, and the machine's equations that they take.

Two unstable modes seen by one sensor leave little room: C and A at the operating point are not enough where a stroke
moves the levers, so these filters expect readings by h, and predict by f.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from malta.errors import CheckError
from malta.firmware.signals import Target
from malta.synthesis.controller import Controller
from malta.synthesis.filters import noise_input
from malta.synthesis.riccati import dare, eigenvalues, sample

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

# Of the process noise's variance, for a filter that does without a sensor. For none at all the Kalman filter is the one
# of least gain that is stable: two unstable modes seen by one sensor take large gains, which noise and errors grow by.
# One that keeps its estimates of disturbances has to follow new ones by its other states, and so has to be faster.
TRUST, TRUST_KEPT = 2e-6, 5e-5
PLACES = 9  # along the stroke, for which there are such gains


class Gains(NamedTuple):
    """Gains L of filters that do without one sensor each, at places along the stroke."""

    places: FloatArray  # g, of the stroke; one of 0 for a machine without a stroke
    L: dict[int, FloatArray]  # by the sensor's index: g x n x p, its column zero


@lru_cache(maxsize=16)
def gains_without(t: Target) -> Gains:
    """Gains of Kalman filters that do without one sensor, for the prediction of prediction_correction at each place.

    The process noise is TRUST, or TRUST_KEPT, of the gain file's. Where the other sensors cannot see the disturbances
    that a design estimates, the filter of all other states is used and keeps the estimates of the disturbances. A
    sensor is left out of the answer where no filter of the others is stable, and all are without a record of the noise.
    """
    c, plant = t.controller, t.believed
    places = np.zeros(1)
    if plant.has_stroke and plant.travel:
        places = np.linspace(-plant.travel, plant.travel, PLACES)
    plain = c.tracks == "states" and c.schedule is None
    if c.noise is None or c.cost is None or not plain or len(c.measurements) < 2:
        return Gains(places, {})
    W, V = _process_noise(c), c.noise.sensor
    xi = ca.SX.sym("xi", len(c.states))
    derivatives = ca.Function(
        "derivatives",
        [xi],
        [ca.jacobian(prediction_correction(t)(xi), xi), ca.jacobian(expected_readings(t)(xi), xi)],
    )
    models = []
    for place in places:
        at = np.zeros(len(c.states))
        if plant.has_stroke:
            at[plant.controlled.index(plant.stroke_state)] = place
        more, C = (np.array(value) for value in derivatives(at))
        models.append((c.Ad + more, C))
    found = {}
    sizes = [(len(W), TRUST)]  # of what is filtered
    if c.observed:
        sizes.append((len(W) - len(c.forces), TRUST_KEPT))
    for k in range(len(c.measurements)):
        for n, trust in sizes:
            seen = [(A[:n, :n], C[:, :n]) for A, C in models]
            gains = [
                _gain_without(k, A, C, trust * W[:n, :n], V) for A, C in seen if _sees_instability(k, A, C)
            ]
            stable = [np.vstack([L, np.zeros((len(W) - n, len(V)))]) for L in gains if L is not None]
            if len(stable) == len(models):
                found[k] = np.array(stable)
                break
    return Gains(places, found)


def _process_noise(c: Controller) -> FloatArray:
    """The process noise's covariance over a sample, of all states of the filter."""
    assert c.noise is not None
    assert c.cost is not None
    n, size = len(c.A), len(c.Ad)
    G = sample(c.A, noise_input(c.B, c.cost.coordinates), c.sample_time)[1]
    W = np.zeros((size, size))
    W[:n, :n] = G * c.noise.process @ G.T
    if c.observed:
        drift = np.diag(c.noise.drift)
        if c.cost.coordinates == "positions":
            back = np.linalg.inv(c.B[n // 2 :])
            drift = back @ drift @ back.T
        W[-len(c.forces) :, -len(c.forces) :] = drift
    return W


def _sees_instability(k: int, A: FloatArray, C: FloatArray) -> bool:
    """Whether the sensors without k see every mode of A that does not decay (Hautus)."""
    others = np.delete(C, k, axis=0)
    rows = np.abs(A).max(axis=1, keepdims=True)
    scale = np.where(rows > 0, rows, 1.0)  # a delayed force remembers nothing
    seen = others / (np.abs(others).max() or 1.0)
    for pole in eigenvalues(A):
        if abs(pole) >= 1 - 1e-9:
            pencil = np.vstack([(A - pole * np.eye(len(A))) / scale, seen])
            if np.linalg.matrix_rank(pencil, tol=1e-9) < len(A):
                return False
    return True


def _gain_without(k: int, A: FloatArray, C: FloatArray, W: FloatArray, V: FloatArray) -> FloatArray | None:
    """The filter's gain without sensor k; None where there is no stable one."""
    others = [j for j in range(len(C)) if j != k]
    rest = C[others]
    try:
        P = dare(A.T, rest.T, W, np.diag(V[others]), what="filter without a sensor").X
    except (CheckError, np.linalg.LinAlgError):
        return None
    L = np.zeros((len(A), len(C)))
    L[:, others] = np.linalg.solve(rest @ P @ rest.T + np.diag(V[others]), rest @ P).T
    stable = np.abs(eigenvalues((np.eye(len(A)) - L @ C) @ A)).max() < 1
    return L if stable else None


def expected_readings(t: Target) -> ca.Function:
    """xi_pred -> readings that the filter expects: h of the machine, where C at the operating point is not enough.

    With two sensors less one, the filter sees a tilt by the levers of the sensor that is left, which a stroke moves.
    """
    c, plant = t.controller, t.believed
    xi = ca.SX.sym("xi_pred", len(c.states))
    x = ca.SX.zeros(len(plant.states))
    for k, index in enumerate(plant.controlled[: len(c.A)]):
        x[index] = xi[k]
    y = ca.densify(plant.h(x, ca.SX.zeros(len(plant.inputs))))
    return ca.Function("expected", [xi], [y], ["xi_pred"], ["y"])


def prediction_correction(t: Target) -> ca.Function:
    """xi_hat -> what a sample of the machine's equations adds to the linear model of the filter, by Euler's method.

    Ts (f(x, u0 + u, 0) - f(0, u0, 0) - A x - B u) for the mechanical states, with the forces u that act by the filter's
    own states; 0 for a model without such states. u0 is what acts at rest, as a voltage that holds a sphere, and what
    is left of f there cancels the loads.
    """
    c, plant = t.controller, t.believed
    xi = ca.SX.sym("xi_hat", len(c.states))
    n, m = len(c.A), len(c.forces)
    x = ca.SX.zeros(len(plant.states))
    for k, index in enumerate(plant.controlled):
        x[index] = xi[k]
    u = xi[n : n + m] if c.lagging + c.delay else ca.SX.zeros(m)
    held, outside = ca.DM(plant.at().u), ca.SX.zeros(len(plant.disturbances))
    rate = plant.f(x, held + u, outside) - plant.f(
        ca.DM.zeros(len(plant.states)), held, ca.DM.zeros(outside.shape)
    )
    rate = rate[list(plant.controlled)]
    linear = ca.sparsify(ca.DM(c.A)) @ xi[:n] + ca.sparsify(ca.DM(c.B)) @ u
    more = ca.vertcat(c.sample_time * (rate - linear), ca.SX.zeros(len(c.states) - n))
    return ca.Function("correction", [xi], [ca.densify(more)], ["xi_hat"], ["more"])
