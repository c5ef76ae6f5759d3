"""Forces and readings that experiments of several machines use: steps and sines, amplitudes, compliance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from malta.loops.loop import loop_along
from malta.model.linearize import linearize
from malta.model.plant import Plant
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def compliance(
    plant: Plant, controller: Controller, w: FloatArray, output: int = 0, wrench: str = "F_x"
) -> FloatArray:
    """|S(j w) G_w(j w)|, m/N: from a force on the centre of gravity to an output, on the linear loop of the machine.

    S is the sampled loop's sensitivity at the sensors, G_w the open machine's response to the force between samples.
    """
    point = plant.point(controller.operating_point[0])
    model = linearize(plant, point)
    loop = loop_along(plant, controller)
    x, w_ext = ca.SX.sym("x", len(plant.states)), ca.SX.sym("w", len(plant.disturbances))
    rate = plant.f(x, ca.SX(point.u), w_ext)
    column = [s.name for s in plant.disturbances].index(wrench)
    B = np.array(ca.Function("B", [x, w_ext], [ca.jacobian(rate, w_ext)])(point.x, 0))[
        list(plant.controlled), column
    ]
    S = loop.sensitivity(w)
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(1j * wk * eye - model.A, B) for wk in w])
    return np.asarray(np.abs(np.einsum("kij,kj->ki", S, G)[:, output]))


def step_wrench(t: FloatArray, column: int, size: float, at: float, width: int) -> FloatArray:
    """A wrench, k x width, whose entry `column` steps to `size` (N or N m) at `at` (s)."""
    wrench = np.zeros((len(t), width))
    wrench[t >= at, column] = size
    return wrench


def sine_wrench(t: FloatArray, column: int, size: float, frequency: float, width: int) -> FloatArray:
    """A wrench, k x width, whose entry `column` is a sine of amplitude `size` (N or N m) at `frequency` (Hz)."""
    wrench = np.zeros((len(t), width))
    wrench[:, column] = size * np.sin(2 * math.pi * frequency * t)
    return wrench


def amplitude(run: Trajectory, output: int, frequency: float) -> float:
    """Amplitude of an output at a frequency (Hz): a fit to the last whole periods in the second half of a run."""
    Ts = run.controller.sample_time
    period = 1 / frequency
    periods = max(1, int(len(run.t) / 2 * Ts / period))
    last = round(periods * period / Ts)
    t, p = run.t[-last:], run.p[-last:, output]
    basis = np.column_stack(
        [
            np.sin(2 * math.pi * frequency * t),
            np.cos(2 * math.pi * frequency * t),
            np.ones(len(t)),
            t - t.mean(),
        ]
    )
    fit = np.linalg.lstsq(basis, p, rcond=None)[0]
    return float(math.hypot(fit[0], fit[1]))
