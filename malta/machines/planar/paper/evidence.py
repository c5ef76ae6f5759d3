"""Figures of a design that the claims on the planar motor are about: from its experiments, margins and model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.planar import commutation
from malta.machines.planar import field as planar_field
from malta.machines.planar import plant as planar
from malta.machines.planar.experiments import CURRENT, coil_wrench
from malta.machines.planar.motions import SOFT, jump, steps_ahead
from malta.margins.loop_report import LoopReport
from malta.model.data import published_value
from malta.report.ledger import case_merit, merit, run_design
from malta.simulation.experiments import Experiment, Progress
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


EXPERIMENT_NAMES = ("step", "jump", "errors", "timing", "delay")
SLOWER = (
    49.6  # 1/s, rate of approach of Kp = 1.2 N/um with the Kd of planar_pid: how far torques depend on gains
)


@dataclass(frozen=True, eq=False)
class Evidence:
    """A design, its margins and its experiments, beside the published figures."""

    spec: Spec
    published: Mapping[str, Any]
    parameters: planar.Parameters
    controller: Controller
    margins: LoopReport
    # experiments : with "ahead" and "slower"; without "delay" for other laws than an LQG, which predict nothing
    experiments: Mapping[str, Experiment]


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> Evidence:
    """Design a controller, prove its margins and run the experiments."""
    found = run_design(spec, EXPERIMENT_NAMES[: None if spec.kind == "LQG" else -1], progress)
    par: Any = spec.parameters
    # A few runs, and nothing to compile.
    ahead = steps_ahead(spec.plant, found.controller, engine="virtual machine")
    slower = jump(spec.plant, found.controller, rate=SLOWER, engine="virtual machine")
    experiments = found.experiments | {"ahead": ahead, "slower": slower}
    return Evidence(spec, published, par, found.controller, found.margins, experiments)


def pole_field(e: Evidence) -> float:
    """Flux density over a pole at the working height, T."""
    par = e.parameters
    return float(planar_field.flux_density(planar_field.modes(par), np.array([par.tau_n, 0, par.h]))[2])


def force_ratio(e: Evidence) -> float:
    """Amplitude of F_z over that of F_x, of one coil."""
    return merit("errors", "F_z, amplitude", e) / merit("errors", "F_x, amplitude", e)


def printed_torque(e: Evidence) -> float:
    """T_z of (22), N m, from the printed F_x and from the arms of the coil that the printed F_z, T_x and T_y imply."""
    F_x, F_z, T_x, T_y = (
        published_value(e.published, f"model.amplitude.{k}") for k in ("F_x", "F_z", "T_x", "T_y")
    )
    return F_x * (T_x + T_y) / F_z


def formula_error(e: Evidence) -> float:
    """Largest relative difference of (17)-(21) from quadrature over the rectangles in the fundamental's field."""
    par = replace(e.parameters, C=1.0)
    field = planar_field.fundamental(par, par.B_z * math.exp(math.pi / par.tau_n * par.h))
    coil = planar_field.winding(par, rectangles=True, nodes=40)
    p = np.array([6e-3, 4e-3, par.h])
    expected = planar_field.quadrature(par, field, coil, p)
    found = planar_field.Analytical(par)(*(np.array([v]) for v in p))[0]
    return float(
        max(np.abs((found - expected)[k]).max() / np.abs(expected[k]).max() for k in (slice(3), slice(3, 6)))
    )


def implied_step(name: str, e: Evidence) -> float:
    """Step of a table, m, for which the error is the printed one; interpolated as the square of the step."""
    printed = published_value(e.published, f"model.error_interpolation.{name}")
    curves = e.experiments["errors"].curves
    error = curves["by step"][:, ("F_x", "F_z").index(name)]
    return float(np.exp(np.interp(math.log(printed), np.log(error[::-1]), np.log(curves["step"][::-1]))))


def misprint_error(e: Evidence) -> float:
    """Largest error of F_x, N, of a table of 10 cells with two weights exchanged as (27) prints them."""
    par, truth = e.parameters, planar_field.exact_model(e.parameters)
    table = planar_field.table(par, truth, 10)
    printed = replace(table, cells=table.cells[:, [0, 2, 1, 3]])
    x, y = np.meshgrid(*[np.linspace(0, par.tau_n, 81)] * 2, indexing="ij")
    z = np.full_like(x, par.h)
    return CURRENT * float(np.abs(printed(x, y, z) - truth(x, y, z))[..., 0].max())


def condition(ratio: float, e: Evidence) -> float:
    """Worst condition of K(p) for a coil pitch of `ratio` tau_n."""
    par = replace(e.parameters, coil_pitch=ratio * e.parameters.tau_n)
    return float(commutation.conditioning(par, planar_field.simulation_model(par)).max())


def coil_torque(ratio: float, name: str, e: Evidence) -> float:
    """Amplitude of a torque, N m, of an inner coil at the paper's 3 A for a coil pitch of `ratio` tau_n."""
    par = replace(e.parameters, coil_pitch=ratio * e.parameters.tau_n)
    x, y = np.meshgrid(*[np.linspace(0, 2 * par.tau_n, 141)] * 2, indexing="ij")
    wrench = coil_wrench(par, planar_field.exact_model(par), CURRENT, x, y)
    return float(np.abs(wrench[..., [s.name for s in e.spec.plant.inputs].index(name)]).max())


def coils_width(ratio: float, e: Evidence) -> float:
    """Width of the 4 x 4 coils, m, for a coil pitch of `ratio` tau_n."""
    par = e.parameters
    return 3 * ratio * par.tau_n + par.l_c + par.w_c


def residual(e: Evidence) -> float:
    """Largest relative error of the wrench K i of the computed currents, over a period."""
    par = e.parameters
    model, W, worst = planar_field.simulation_model(par), np.array([100.0, 200, 400, 10, 20, 30]), 0.0
    for x in np.arange(6) * par.tau_n / 3:
        for y in np.arange(6) * par.tau_n / 3:
            K = commutation.wrench_matrix(par, model, np.array([x, y, par.h]))
            worst = max(worst, float(np.abs(K @ commutation.currents(K, W) - W).max() / np.abs(W).max()))
    return worst


def flight(model: str, e: Evidence) -> Trajectory:
    """The steps with a coil model, from the place without symmetry: by quintics, or as the label's end says.

    AHEAD: with currents for the predicted place; SOFT: by jumps, with soft gains.
    """
    names = ("jump",) if model.endswith(SOFT) else ("step", "ahead")
    cases = (case for name in names for case in e.experiments[name].cases)
    return next(case.run for case in cases if case.label.startswith(model))


def symmetric_deviation(e: Evidence) -> float:
    """Largest deviation of x, theta, psi from (0, 0) with the analytical model: m or rad."""
    run = e.experiments["step"].cases[-1].run  # the analytical model, from (0, 0)
    return float(np.abs(run.p - run.reference)[:, [0, 4, 5]].max())


def extreme(model: str, name: str, series: str, of: Callable[[FloatArray], Any], e: Evidence) -> float:
    """Smallest or largest deviation of an output, or value of a force, in the steps with a coil model. SI"""
    run = flight(model, e)
    if series == "v":
        return float(of(run.v[:, [s.name for s in run.plant.inputs].index(name)]))
    k = [s.name for s in run.plant.outputs].index(name)
    return float(of((run.p - run.reference)[:, k]))


def largest_deviation(model: str, name: str, e: Evidence) -> float:
    """Largest deviation of an output from the reference in the steps with a coil model, SI."""
    return max(-extreme(model, name, "p", np.min, e), extreme(model, name, "p", np.max, e))


def phi_ratio(e: Evidence) -> float:
    """Motion in phi by the analytical model over that by the table."""
    return merit("step", "analytical moves phi by", e) / merit("step", "table moves phi by", e)


def jump_ratio(e: Evidence) -> float:
    """Largest motion in phi under jumps by the analytical model over that by the table, with soft gains."""
    return largest_deviation(f"analytical, {SOFT}", "phi", e) / largest_deviation(f"table, {SOFT}", "phi", e)


def slower_torque(model: str, of: Callable[[FloatArray], Any], e: Evidence) -> float:
    """Smallest or largest T_x under jumps with a rate of approach of SLOWER, N m."""
    run = next(case.run for case in e.experiments["slower"].cases if case.label == f"{model}, {SOFT}")
    return float(of(run.v[:, [s.name for s in run.plant.inputs].index("T_x")]))


def angles_at_rest(label: str, e: Evidence) -> float:
    """Angles left at rest in a case of the experiment `delay`, rad; NaN without the experiment."""
    if "delay" not in e.experiments:
        return math.nan
    return case_merit("delay", label, "angles, left at rest", e)
