"""The loop of a PID as one part: what its loads leave in it, and the figures that it is judged by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import covariance
from malta.linear.peaks import smooth_peak
from malta.linear.sampling import sample, sample_noise
from malta.loops.bandwidths import in_sizes, last_crossover, reading_sizes, tracked_band
from malta.loops.loop import loop_of_model
from malta.loops.sampled_loops import SampledLoop, push_through
from malta.loops.windings import emf_slope, windings_of
from malta.model.equilibrium import trim
from malta.model.linearize import LinearModel, linearize
from malta.model.places import position_at, position_in
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.synthesis.spec import Loads, Spec


@dataclass(frozen=True, eq=False)
class PidPart:
    """Some outputs with the forces of the same index, the sampled states behind them, and what acts from outside."""

    outputs: tuple[int, ...]  # k of them
    Ad: FloatArray  # n x n
    # n x k forces, then the k readings that currents are commutated for, where they are held, or k voltages that the
    # law forecasts
    Bd: FloatArray
    Cd: FloatArray
    slope: FloatArray  # of v0(z), k x k
    push: FloatArray  # n x k, what constant forces leave in the states after a sample
    shaken: FloatArray  # n x n, covariance that the noise of forces leaves there
    forecast: FloatArray  # k x 2 k, of voltages by positions and rates of the outputs; empty: none
    true: FloatArray | None  # k x n, outputs of the states where sensors read them late; None: Cd


def whole_machine(model: LinearModel, controller: Controller, loads: Loads) -> PidPart:
    """Describe all of a machine as one part, with what the loads leave in its states."""
    machine, plant, Ts = loop_of_model(model, controller).sampled, model.plant, controller.sample_time
    x = model.operating_point.x
    loaded = linearize(plant, trim(plant, **position_at(plant, x)))
    assert machine.continuous is not None
    A, n = machine.continuous, len(machine.continuous)
    B = np.vstack([loaded.B, np.zeros((n - len(loaded.B), loaded.B.shape[1]))])
    push, shaken = push_through(A, B, Ts, len(machine.Ad), machine.caught), np.zeros_like(machine.Ad)
    W = B * (np.square(loads.force_noise) * Ts) @ B.T
    shaken[:n, :n] = sample_noise(A, W, Ts)
    if machine.caught is not None:  # readings within the sample
        first, (C, time) = machine.caught
        own, then = slice(first, first + len(C)), C @ sample_noise(A, W, time)
        shaken[own, own] = then @ C.T
        shaken[own, :n] = then @ sample(A, B, Ts - time)[0].T
        shaken[:n, own] = shaken[own, :n].T
    slope = np.zeros((B.shape[1], len(machine.Cd)))
    if plant.has_stroke:
        slope[:, plant.stroke_output] = controller.feedforward.slope(position_in(plant, x))
    return PidPart(
        tuple(range(len(machine.Cd))), machine.Ad, machine.Bd, machine.Cd, slope, push, shaken,
        _forecast(model, controller, machine), machine.true,
    )  # fmt: skip


def _forecast(model: LinearModel, controller: Controller, machine: SampledLoop) -> FloatArray:
    """Voltages that the law forecasts, of positions and rates of the outputs, m x 2 m; empty where there are none."""
    m, half = len(controller.forces), model.plant.coordinates
    if model.E.any() or machine.Bd.shape[1] == m:
        return np.zeros((0, 0))
    believed, x = plant_of(controller.parameters), model.operating_point
    axes = windings_of(model.plant, believed, x, np.eye(m)).axes
    back = np.linalg.inv(model.C[:, :half])
    slope = axes @ emf_slope(believed, x.x)[:, list(believed.controlled)]
    return np.hstack([slope[:, :half] @ back, slope[:, half:] @ back])


def loop_figures(spec: Spec, part: PidPart, loop: SampledLoop) -> dict[str, float]:
    """Compute the figures of a part's loop, by name and output; none where the loop is unstable."""
    closed, c, n, Ts = loop.closed, loop.control, len(part.Ad), loop.sample_time
    if not np.isfinite(closed).all():
        return {}
    poles = np.linalg.eigvals(closed)
    if not np.abs(poles).max() < 1:
        return {}
    own, names = list(part.outputs), [spec.plant.outputs[o].name for o in part.outputs]
    loads = loads_of(spec)
    found = {}
    pushed = np.vstack([part.push * np.array(loads.load)[own], np.zeros((len(c.A), len(own)))])
    for name, row, x in zip(
        names, loop.outputs, np.linalg.solve(np.eye(len(closed)) - closed, pushed).T, strict=True
    ):
        X = covariance(closed, np.outer(x, x))  # it starts at -x from where it ends
        found[f"load_error {name}"] = math.sqrt(Ts * float(row @ X[:n, :n] @ row))
    noise = np.vstack([loop.Bd @ c.D_y, c.B_y])
    W = noise * np.square(np.array(loads.sensor_noise)[own]) @ noise.T
    W[:n, :n] += part.shaken
    motion = np.sqrt(np.diag(loop.outputs @ covariance(closed, W)[:n, :n] @ loop.outputs.T))
    found |= {f"noise_motion {name}": value for name, value in zip(names, motion.tolist(), strict=True)}
    cut = loop.cut
    found |= {f"peak_sensitivity {name}": smooth_peak(cut.sensitivity(i)) for i, name in enumerate(names)}
    if "bandwidth" in spec.specification:
        scaled = in_sizes(cut, reading_sizes(spec.plant, None), own)
        found["bandwidth"] = min(tracked_band(scaled)[0], last_crossover(scaled))
    return found


def loads_of(spec: Spec) -> Loads:
    """Return the loads that a PID is judged by. Raises InputError for a design file without [cost]."""
    if spec.loads is None:
        raise InputError(spec.path, "cost", "nothing", "a table of the loads whose errors a PID makes small")
    return spec.loads
