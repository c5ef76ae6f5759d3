"""The constants of the motor law from a record of a load cell, Sec. 2.1: forces along the travel at known currents."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.machines.halbach import electronics
from malta.model.plant import Plant

MIN_READINGS, SIGMAS = 8, 1.96  # readings; standard deviations of an interval of 95 %
TURNS = 500  # pitches in a record, at most
TURN = np.exp(2j * np.pi / 3)  # from a phase to the next
# The simulated record: places 0.25 mm apart, the currents of Fig. 2, and our assumption of the cell's noise.
SPAN, PLACES, CURRENTS = 50e-3, 201, (0.0, -0.3593, 0.3593)  # m, and A
CELL_NOISE = 5e-3  # N rms; the paper does not print its cell's


class MotorFit(NamedTuple):
    """The motor law (1), fitted to a record; halves are those of intervals of 95 %."""

    A: float  # N/A
    A_half: float
    k: float  # rad/m
    k_half: float
    pitch: float  # m, l = 2 pi / k
    pitch_half: float
    origin: float  # m, where the motor's x_0 = 0 is in the record, within half a pitch of its middle
    rms: float  # N, what the fit leaves of the record


def fit_motor_law(x: FloatArray, i: FloatArray, F: FloatArray) -> MotorFit:
    """Fit A, k and the place of x_0 = 0 of the motor law (1) to forces at known currents. Least squares.

    F_x + j F_z = A e^(j k (x - origin)) (I_a + I_b e^(-2 pi j / 3) + I_c e^(2 pi j / 3)). For any k the best A and
    origin have a closed form; k is sought up to half a turn a place, and up to TURNS in the record.

    x : n positions, m
    i : n x 3 phase currents, A, or three that are the same everywhere
    F : n x 2 forces F_x and F_z of the cell, N

    Returns a MotorFit, whose intervals are those of white noise of the forces.

    Raises InputError for fewer than 8 readings, numbers that are not finite, and places or currents that are all the
    same or zero; CheckError where the law leaves half of the record or more.

    >>> import numpy as np
    >>> x = np.arange(200) * 0.25e-3
    >>> F = 1.6067 * 0.6223 * np.stack([np.cos(211 * x + 1), np.sin(211 * x + 1)], axis=1)
    >>> fit = fit_motor_law(x, np.array([0.0, -0.3593, 0.3593]), F)
    >>> round(fit.A, 4), round(fit.k, 3), round(1e3 * fit.pitch, 3)  # N/A, rad/m, mm
    (1.6067, 211.0, 29.778)
    """
    from scipy.optimize import minimize_scalar

    x, F = np.ravel(np.asarray(x, dtype=float)), np.asarray(F, dtype=float)
    if len(x) < MIN_READINGS or F.shape != (len(x), 2) or np.shape(i) not in ((3,), (len(x), 3)):
        found = f"{len(x)} places, currents {np.shape(i)}, forces {F.shape}"
        raise InputError(
            "fit_motor_law", "x, i, F", found, f"n >= {MIN_READINGS} places, (3,) or (n, 3), (n, 2)"
        )
    force, current = F @ [1, 1j], np.asarray(i) @ [1, 1 / TURN, TURN] * np.ones(len(x))
    middle, span = x.mean(), np.ptp(x)
    if not (np.isfinite([*x, *force, *current]).all() and span > 0 and np.abs(current).any()):
        raise InputError(
            "fit_motor_law", "x, i, F", "one place, no current, NaN or infinity", "finite numbers"
        )
    weighted, energy = force * current.conj(), float(np.vdot(current, current).real)

    def response(k: float) -> complex:
        return complex(np.exp(-1j * k * (x - middle)) @ weighted) / energy

    # A quarter of a turn over the record apart.
    grid = np.arange(1, min(2 * len(x), 4 * TURNS)) * np.pi / 2 / span
    some = slice(None, None, -(-len(x) // (8 * TURNS)))  # of a long record, enough to begin with
    start = max(grid, key=lambda k: abs(np.exp(-1j * k * x[some]) @ weighted[some]))
    ends = start - grid[0], start + grid[0]
    k = float(
        minimize_scalar(lambda k: -abs(response(k)), bounds=ends, method="bounded", options={"xatol": 1e-9}).x
    )
    A, phase = abs(response(k)), float(np.angle(response(k)))
    model = A * np.exp(1j * (k * (x - middle) + phase)) * current
    left, power = float(np.sum(np.abs(force - model) ** 2)), np.abs(model) ** 2
    if not left < np.sum(np.abs(force) ** 2) / 2:
        raise CheckError(f"fit_motor_law: no motor law explains half of the record of {len(x)} places")
    sigma = np.sqrt(left / (2 * len(x) - 3))
    around = x - np.average(x, weights=power)
    A_half, k_half = SIGMAS * sigma / np.sqrt(energy), SIGMAS * sigma / np.sqrt(power @ around**2)
    pitch = 2 * np.pi / k
    rms = float(np.sqrt(left / 2 / len(x)))
    pitch_half, origin = pitch / k * k_half, middle - phase / k
    return MotorFit(A, float(A_half), k, float(k_half), pitch, float(pitch_half), float(origin), rms)


def simulated_record(plant: Plant, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places read by the laser, currents, and forces read by a cell with CELL_NOISE: what `fit_motor_law` takes."""
    par: Any = plant.parameters
    rng, i = np.random.default_rng(seed), np.array(CURRENTS)
    places = np.linspace(-SPAN / 2, SPAN / 2, PLACES)
    F = np.array([np.array(electronics.forces(par, x, i)).ravel() for x in places])
    read = places + rng.uniform(-par.n_laser, par.n_laser, PLACES)
    return read, i, F + CELL_NOISE * rng.standard_normal(F.shape)
