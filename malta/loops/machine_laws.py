"""The control law of a gain file as the machine runs it, as the compensator of a proof: hold, delay, current loops."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.errors import CheckError
from malta.model.data import plant_of
from malta.proof.machine.windings import CurrentControl, with_current_control, with_estimated_emf
from malta.proof.uncertain import Compensator
from malta.synthesis.controller import Controller, LinearLaw, linear_law, with_readings, with_slope

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


class ReadingUse(NamedTuple):
    """What a reading y does besides entering the control law."""

    held: FloatArray | None = None  # the gain H of held currents: v + H y acts
    handed: bool = False  # whether y is a further input of the system
    slope: FloatArray | None = None  # dv0/dy, m x p: v0 follows the reading; None: it stands still


def sampled_law(
    controller: Controller,
    delay: int,
    lag: float,
    control: CurrentControl | None = None,
    *,
    late: int = 0,
    use: ReadingUse | None = None,
) -> Compensator:
    """The control law of a gain file as the machine runs it: hold, `delay` samples, current loops.

    lag : rad/s, crossover of the current loops, as first-order lags; without effect where there is a `control`
    control : PI controllers of the currents, which also read phi (windings.py)
    late : samples by which these and the law read y late, where there is a `control`
    """
    law, T = linear_law(controller), controller.sample_time
    held, handed, slope = use or ReadingUse()
    if slope is not None:
        law = with_slope(law, slope)
    if control is not None:
        law = with_estimated_emf(law, control.emf)
    n, m = len(controller.states), len(controller.forces)
    half = plant_of(controller.parameters).coordinates
    p = len(controller.measurements) if controller.integrating else 0
    # Sums of errors and stored forces in the coordinates of the modes, where these decouple.
    to_modes = np.eye(len(law.A))
    if controller.tracks == "states" and len(controller.measurements) == m == half:
        if p:
            to_modes[n:, n:] = np.linalg.inv(controller.C[:, :half])
        for k in range(2 * half, n, m):
            to_modes[k : k + m, k : k + m] = controller.B[half:]
    back = np.linalg.inv(to_modes)
    law = law._replace(A=to_modes @ law.A @ back, B_y=to_modes @ law.B_y, C=law.C @ back)
    if controller.observed:
        summed = _integrals_last(law, m)
        law, p = (law, 0) if summed is None else (summed, m)
    if held is not None:
        law = law._replace(D_y=law.D_y + held)
    if handed:
        law = with_readings(law)
    c = Compensator(
        law.A, law.B_y, law.C, law.D_y,
        integrals=p, sample_time=T, delay=delay, lag=lag if math.isfinite(lag) else None,
    )  # fmt: skip
    return c if control is None else with_current_control(c, control, late)


def _integrals_last(law: LinearLaw, count: int) -> LinearLaw | None:
    """Transform a law that cancels observed disturbances d: its last states d + X xi become plain sums of the readings.

    With A = [[M, N], [G, 1]], X solves X (M - 1) = -G. Then X N = 0, because the law leaves no constant disturbance.
    None for a law that leaves one, as with rounded coefficients: its states are no sums, and stay as they are.
    """
    A, k = law.A, len(law.A) - count
    try:
        X = -np.linalg.solve((A[:k, :k] - np.eye(k)).T, A[k:, :k].T).T
    except np.linalg.LinAlgError as error:
        raise CheckError("the law sums errors beside the disturbances that it observes") from error
    left, size = np.abs(X @ A[:k, k:]).max(), (np.abs(X) @ np.abs(A[:k, k:])).max()
    if not left <= 1e-8 * size:
        return None

    def summed(M: FloatArray) -> FloatArray:
        return np.vstack([M[:k], M[k:] + X @ M[:k]])

    T = np.eye(len(A))
    T[k:, :k] = -X
    A = summed(A) @ T
    A[k:] = np.eye(len(A))[k:]
    return law._replace(A=A, B_y=summed(law.B_y), B_r=summed(law.B_r), C=law.C @ T)
