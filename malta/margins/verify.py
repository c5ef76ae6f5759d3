"""Linear verification of a controller on a machine: poles, sensitivities, bandwidths, stage by stage.

The loops and their signals are those of loops.py; at the sensors S = (I - P F)^-1, T = I - S, L = -P F.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError
from malta.loops.loop import loop_of_model
from malta.loops.sampled_loops import (
    LAST,
    SampledLoop,
    commanded_model,
    continuous_poles,
    sampled_loop,
    sorted_poles,
)
from malta.margins.extent import extent_of
from malta.margins.figures import BANDWIDTHS
from malta.margins.loop_report import LoopReport, Poles, Stage
from malta.margins.travel import travel_margin
from malta.model.data import plant_of
from malta.model.linearize import LinearModel, linearize
from malta.proof.responses import crossing, find_peaks
from malta.synthesis.controller import Controller
from malta.synthesis.riccati import add_integrals, eigenvalues
from malta.synthesis.sampled import gain_at_rest
from malta.threads import on_one_thread

if TYPE_CHECKING:
    from collections.abc import Mapping

    from malta.model.plant import ComplexArray, FloatArray
    from malta.proof.machine.windings import CurrentLoops


def controller_poles(c: Controller) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues in z of regulator and filter on the controller's own model (separation principle).

    The regulator has no poles for observed disturbance forces, which only the filter estimates.
    """
    k = len(c.Ad) - c.observed * len(c.forces)
    A, B, K = c.Ad[:k, :k], c.Bd[:k], c.K[:, :k]
    if c.integrating:
        A, B = add_integrals(A, B, c.Cd[:, :k], c.sample_time)
        K = np.hstack([K, -c.Ki])
    return eigenvalues(A - B @ K), eigenvalues((np.eye(len(c.Ad)) - c.L @ c.Cd) @ c.Ad)


@on_one_thread
def unstable_gain(c: Controller) -> tuple[str, float] | None:
    """The name of a gain that leaves the controller's own model unstable, and the worst |lambda|; None: all are stable.

    An LQG is judged by its regulator and its filter. A PID or a law of errors has no model and is judged on the machine
    that it names.
    """
    if c.cost is None:
        plant = plant_of(c.parameters)
        model = linearize(plant, plant.point(c.operating_point[0]))
        found = {"K": eigenvalues(loop_of_model(model, c).matrix)}
    else:
        found = dict(zip("KL", controller_poles(c), strict=True))
    for name, poles in found.items():
        radius = float(np.abs(poles).max())
        if not radius < 1:
            return name, radius
    return None


@on_one_thread
def linear_report(
    model: LinearModel,
    controller: Controller,
    uncertainty: Mapping[str, float] | None = None,
    current_loops: CurrentLoops = LAST,
    *,
    time: float | None = None,
) -> LoopReport:
    """Report what is linear: poles, peak sensitivities, bandwidths, and the robust margin over an uncertainty.

    Stages: the sampled loop as designed; with the current loops; the machine. The robust margin covers the travel and
    the intervals of `plant.over`. The peak sensitivities of an unstable loop are NaN; instability raises nothing.

    Raises CheckError when numbers overflow or no input holds the machine.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            found = _nominal_report(model, controller, current_loops)
            if not uncertainty:
                return found
            robust = travel_margin(model.plant, controller, uncertainty, current_loops, time=time)
    except np.linalg.LinAlgError as error:
        raise CheckError(f"{controller.name}: the loop cannot be computed ({error})") from error
    extent = extent_of(model.plant, uncertainty)
    return replace(found, uncertainty=dict(uncertainty), robust=robust, extent=extent)


def _nominal_report(model: LinearModel, controller: Controller, current_loops: CurrentLoops) -> LoopReport:
    whole = loop_of_model(model, controller)
    machine = whole.sampled
    loops = {
        "sampled": sampled_loop(model, controller, delay=controller.delay),
        "+ current loops": sampled_loop(model, controller, delay=controller.delay, current_loops="lag"),
        "machine": machine,
    }
    names = [s.name for s in controller.measurements]
    stages = tuple(stage_of(name, stage, names) for name, stage in loops.items())
    empty = np.zeros(0, dtype=complex)
    regulator, observer = (empty, empty) if controller.cost is None else controller_poles(controller)
    poles = Poles(
        open_loop=sorted_poles(eigenvalues(model.A)),
        regulator=continuous_poles(regulator, controller.sample_time),
        filter=continuous_poles(observer, controller.sample_time),
        closed_loop=whole.poles,
    )
    bandwidths = bandwidths_of(model, controller, machine, stable=stages[-1].stable)
    extent = extent_of(model.plant)
    return LoopReport(
        model, controller, poles, stages, bandwidths, extent=extent, current_loops=current_loops
    )


def _grid(Ts: float) -> FloatArray:
    return np.geomspace(1e-2, np.pi / Ts, 240)


def stage_of(name: str, stage: SampledLoop, sensors: list[str]) -> Stage:
    """The peak sensitivities and the spectral radius of a loop; the peaks of an unstable one are NaN."""
    radius = float(np.abs(eigenvalues(stage.closed)).max())
    if radius >= 1:
        return Stage(name, dict.fromkeys([*sensors, "sigma_max"], np.nan), np.nan, radius)

    def sizes(w: FloatArray) -> FloatArray:
        S = stage.sensitivity(w)
        return np.column_stack([np.abs(np.einsum("kii->ki", S)), _singular_values(S)[:, 0]])

    peaks, at = find_peaks(sizes, _grid(stage.sample_time))
    return Stage(name, dict(zip([*sensors, "sigma_max"], peaks.tolist(), strict=True)), float(at[-1]), radius)


def bandwidths_of(
    model: LinearModel, controller: Controller, machine: SampledLoop, *, stable: bool
) -> dict[str, float]:
    """The bandwidths of the machine's loop by the definitions of BANDWIDTHS, rad/s; NaN where it is unstable."""
    natural = _natural_frequencies(commanded_model(model, controller), controller)
    if not stable:
        return {key: np.nan for key in BANDWIDTHS if not key.startswith("w_n")} | natural
    w = _grid(machine.sample_time)
    L = machine.loop_gain(w)
    S = machine.sensitivity(w)
    T = _singular_values(np.eye(len(machine.Cd)) - S)
    half = np.sqrt(0.5)
    return {
        "sigma_max_T": crossing(w, T[:, 0], half, last=True),
        "sigma_min_T": crossing(w, T[:, -1], half, last=False),
        "crossover_max": crossing(w, _singular_values(L)[:, 0], 1.0, last=True),
        **natural,
    }


def _natural_frequencies(model: LinearModel, controller: Controller) -> dict[str, float]:
    """Natural frequencies of q'' = (k - G K1) q, rad/s; none unless the controller feeds back states (q, q')."""
    n = model.plant.coordinates
    if not n or controller.tracks == "errors":
        return {}
    K = controller.K[:, :n]
    if controller.lagging:
        K = gain_at_rest(controller.K, len(controller.A), controller.lagging + controller.delay)
    closed = model.force_map @ K - model.stiffness
    w_n = np.sqrt(np.maximum(eigenvalues(closed).real, 0))
    return {"w_n_max": float(w_n.max()), "w_n_min": float(w_n.min())}


def _singular_values(G: ComplexArray) -> FloatArray:
    return np.asarray(np.linalg.svd(G, compute_uv=False))
