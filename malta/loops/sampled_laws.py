"""The control law of a gain file as the machine runs it, as the compensator of a proof: hold, delay, current loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.linear.uncertain import Compensator
from malta.loops.sampled_loops import pad
from malta.loops.windings import (
    LAST_STAGE,
    CurrentControl,
    CurrentLoops,
    chosen_loops,
    current_control,
    force_modes,
    windings_of,
    with_current_control,
    with_estimated_emf,
)
from malta.model.plant import OperatingPoint, Plant, total_delay, whole_samples
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller
from malta.synthesis.linear_law import LinearLaw, linear_law, with_forces_read, with_readings, with_slope


class ReadingUse(NamedTuple):
    """What a reading y does besides entering the control law."""

    held: FloatArray | None = None  # the gain H of held currents: v + H y acts
    handed: bool = False  # whether y is a further input of the system
    slope: FloatArray | None = None  # dv0/dy, m x p: v0 follows the reading; None: it stands still
    moved: tuple[int, ...] = ()  # forces whose v0 is read behind the outputs, see feedforward_along.py


def sampled_law(
    controller: Controller,
    delay: float,
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
    held, handed, slope, moved = use or ReadingUse()
    if slope is not None:
        law = with_slope(law, slope)
    if moved:
        law = with_forces_read(law, moved, len(controller.forces))
    if control is not None:
        law = with_estimated_emf(law, control.emf)
    n, m = len(controller.states), len(controller.forces)
    half = plant_of(controller.parameters).coordinates
    p = len(controller.summed)
    # Sums of errors and stored forces in the coordinates of the modes, where these decouple.
    to_modes = np.eye(len(law.A))
    if controller.tracks == "states" and len(controller.measurements) == m == half:
        if p == m:
            to_modes[n:, n:] = np.linalg.inv(controller.C[:, :half])
        for k in range(2 * half, n, m):
            to_modes[k : k + m, k : k + m] = controller.B[half:]
    back = np.linalg.inv(to_modes)
    law = law._replace(A=to_modes @ law.A @ back, B_y=to_modes @ law.B_y, C=law.C @ back)
    if controller.observed:
        summed = _integrals_last(law, m)
        law, p = (law, 0) if summed is None else (summed, m)
    law = with_held_currents(law, held, len(controller.measurements) if handed else 0)
    c = Compensator(
        law.A, law.B_y, law.C, law.D_y,
        integrals=p, sample_time=T, delay=delay, lag=lag if math.isfinite(lag) else None,
    )  # fmt: skip
    return c if control is None else with_current_control(c, control, late)


def with_held_currents(law: LinearLaw, held: FloatArray | None, handed: int) -> LinearLaw:
    """The law with what readings do beside it: v + held y acts, and the first `handed` readings are passed on."""
    if held is not None:
        law = law._replace(D_y=law.D_y + pad(held, law.D_y.shape[1]))
    return with_readings(law, handed) if handed else law


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


def machine_law(
    plant: Plant,
    controller: Controller,
    current_loops: CurrentLoops = LAST_STAGE,
    *,
    use: ReadingUse | None = None,
    point: OperatingPoint | None = None,
) -> Compensator:
    """The control law with the machine's hold, delay and current loops.

    current_loops : "pi", the controllers of the gain file on the windings, where a machine has some; "lag", first-order
        lags at the crossover
    use : of the reading besides the law
    point : where the windings are at rest; None: at the centre

    Raises InputError for other current loops, and beside PI current loops for a dead time of the sensors that is not
    whole samples.
    """
    a = plant.actuator
    if chosen_loops(plant, controller, current_loops) == "lag":
        return sampled_law(controller, total_delay(plant, controller.sample_time), a.crossover, use=use)
    delay = a.delay(controller.sample_time)
    late = whole_samples(plant, controller.sample_time)
    believed = plant_of(controller.parameters)
    point = plant.at() if point is None else point
    windings = windings_of(plant, believed, point, force_modes(believed))
    control = current_control(controller, windings, point)
    return sampled_law(controller, delay, a.crossover, control, late=late, use=use)
