"""Experiments that replicate the paper's on the planar motor, and that ask what its steps leave open.

errors   errors of the coil models against the exact wrench, Figs 7, 8 and 13
delay    filters with the sample of computation in their model, and without
timing   K(p) and its pseudo-inverse within the control period, Table 2
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from malta import InputError, Scenario, linearize, lqg, references
from malta.arrays import FloatArray
from malta.machines.planar import commutation, experiments as machine, field, plant as planar
from malta.machines.planar.motions import (
    CELLS,
    DISTANCE,
    DURATION,
    FORCES,
    GAP,
    LIFT,
    PLACE,
    SOFT_END,
    braking_rates,
    jumps_of,
    jumps_reference,
    largest_of,
    parameters_of,
    soften,
    step_cases,
    with_coil_model,
)
from malta.model import Plant
from malta.simulation import Experiment, Trajectory
from malta.simulation.engine import compiled as engine
from malta.simulation.experiments import Merit, PlannedRun, Progress, fly, fly_all, scenario_of
from malta.simulation.layout import numbers_of
from malta.simulation.period import period_of
from malta.simulation.scenario import setup_of
from malta.synthesis import Controller
from malta.synthesis.feedforward import commutate_ahead
from malta.synthesis.weighting import weights_of

CURRENT = 3.0  # A in one coil: Sec. 4.1


NODES = (5, 7, 10, 14, 20, 28, 35, 50, 70)  # cells over tau_n of the tables whose errors are compared


def errors(
    plant: Plant,
    controller: Controller,
    *,
    current: float = CURRENT,
    cells: int = CELLS,
    place: tuple[float, ...] = PLACE,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """One coil at `current` (A) over a period at the working height: each model against the exact wrench.

    The coil is an inner one of the mover, its torques are about the centre of gravity; the paper does not name one.
    A hover at `place` (m) shows the force and torque that feedback adds to correct a model.
    """
    par = parameters_of(plant)
    if len(place) != 2:
        raise InputError("simulate", "errors: place", f"{len(place)} numbers", "x and y")
    commutation.check_position(par, np.array([*place, par.h]))
    truth = field.exact_model(par)
    models: dict[str, field.CoilModel] = {
        "analytical": field.Analytical(par),
        "table": field.table(par, truth, cells),
    }
    x, y = np.meshgrid(*[np.linspace(0, 2 * par.tau_n, 141)] * 2, indexing="ij")
    exact = coil_wrench(par, truth, current, x, y)
    curves: dict[str, FloatArray] = {"x": x[:, 0], "exact": exact}
    reference = partial(references.hold, x=place[0], y=place[1])
    scenario = scenario_of("errors", 0.02, reference, FORCES | options)
    flights = []
    for name, model in models.items():
        error = coil_wrench(par, model, current, x, y) - exact
        curves[name] = error
        merits = partial(_error_merits, largest=np.abs(error).max(axis=(0, 1)))
        flights.append((plant, with_coil_model(controller, name, cells), PlannedRun(name, scenario, merits)))
    cases, cut = fly_all(flights, progress, options)
    curves |= {"step": par.tau_n / np.array(NODES), "by step": _by_step(par, truth, current)}
    amplitude = np.abs(exact).max(axis=(0, 1))
    found_merits = (
        *(
            Merit(f"{s.name}, amplitude", float(a), s.unit, f"model.amplitude.{s.name}")
            for s, a in zip(plant.inputs, amplitude, strict=True)
        ),
        Merit("fitted C of the analytical model", field.compensation(par, truth), "1", better=""),
        Merit(
            "error of the table, each halving of its step", _error_ratio(curves), "1", key="table_error_ratio"
        ),
    )
    return Experiment("errors", "What do the coil models miss?", cases, found_merits, curves, interrupted=cut)


def coil_wrench(
    par: planar.Parameters, model: field.CoilModel, current: float, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Wrench of an inner coil, ... x 6, centred at x, y at the working height, about the centre of gravity."""
    own = current * model(x, y, np.full_like(x, par.h))
    arm = np.array([par.coil_pitch / 2, par.coil_pitch / 2, par.r_z])
    own[..., 3:] += np.cross(arm, own[..., :3])
    return np.asarray(own)


def _by_step(par: planar.Parameters, truth: field.CoilModel, current: float) -> FloatArray:
    """Largest errors of F_x and F_z, N, of a table for each of NODES, at the middles and edges of its cells."""
    found = []
    for n in NODES:
        fine = np.linspace(0, par.tau_n, 2 * n + 1)
        x, y = np.meshgrid(fine, fine, indexing="ij")
        exact = coil_wrench(par, truth, current, x, y)
        error = np.abs(coil_wrench(par, field.table(par, truth, n), current, x, y) - exact)
        found.append(error[..., [0, 2]].max(axis=(0, 1)))
    return np.array(found)


def _error_ratio(curves: Mapping[str, FloatArray]) -> float:
    """Ratio of the errors of F_x with 10 and with 20 cells."""
    error = curves["by step"][:, 0]
    return float(error[NODES.index(10)] / error[NODES.index(20)])


def _error_merits(run: Trajectory, largest: FloatArray) -> tuple[Merit, ...]:
    """Largest errors of one coil's wrench, and the force and torque that feedback adds in a hover."""
    missed = np.abs(run.v[-1] - np.array(ca.evalf(run.plant.preload(ca.DM(run.x[-1])))).ravel())
    return (
        *(
            Merit(f"{s.name}, largest error", float(e), s.unit)
            for s, e in zip(run.plant.inputs, largest, strict=True)
        ),
        Merit("hover: force to correct", float(missed[:3].max()), "N"),
        Merit("hover: torque to correct", float(missed[3:].max()), "N m"),
    )


def timing(
    plant: Plant,
    controller: Controller,
    *,
    cells: int = CELLS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """How long K(p) and its pseudo-inverse take on this computer, by numpy and compiled, beside a hover of 10 ms.

    A whole step of the controller has the filter and the control law besides.
    """
    par = parameters_of(plant)
    scenario = scenario_of("timing", 0.01, references.hold, FORCES | options)
    cases, cut = fly(plant, controller, [PlannedRun("hover", scenario, _no_merits)], progress, options)
    models: dict[str, field.CoilModel] = {
        "table": field.table(par, field.simulation_model(par), cells),
        "exact": field.simulation_model(par),
        "analytical": field.Analytical(par),
    }
    p, W = np.array([*PLACE, par.h]), np.array([10.0, 200, 400, 1, 2, 3])
    plain = numpy_seconds(par, models["table"], p, W)
    compiled = {
        name: compiled_seconds(commutation.decoupling(par, model), p, W) for name, model in models.items()
    }
    by_table = with_coil_model(controller, "table", cells)
    step = step_function(plant, by_table, scenario)
    whole = compiled_seconds(step, *(np.zeros(step.size1_in(i)) for i in range(step.n_in())))
    Ts = controller.sample_time
    merits = (
        Merit("table, numpy", plain, "us", "table_2.interpolation", "at most"),
        *(
            Merit(f"{name}, compiled", seconds, "us", f"table_2.{PRINTED_MODELS[name]}", "at most")
            for name, seconds in compiled.items()
        ),
        Merit("whole step by the table, compiled", whole, "us"),
        Merit(
            "of the control period, table compiled",
            compiled["table"] / Ts,
            "percent",
            key="table_of_control_period",
        ),
    )
    return Experiment("timing", "Is it quick enough?", cases, merits, interrupted=cut)


def step_function(plant: Plant, controller: Controller, scenario: Scenario) -> ca.Function:
    """One step of the controller, from readings to coil currents, as the simulation runs it."""
    setup, numbers = setup_of(plant, controller, scenario), numbers_of(plant, controller, 1)
    return period_of(plant, controller, setup, numbers, constant=True).decide


# The paper's names of the coil models; its exact one is FEM, point by point.
PRINTED_MODELS = {"table": "interpolation", "analytical": "analytical", "exact": "interpolation"}


def _no_merits(_: Trajectory) -> tuple[Merit, ...]:
    """No figures of merit."""
    return ()


def numpy_seconds(
    par: planar.Parameters, model: field.CoilModel, p: FloatArray, W: FloatArray, calls: int = 20
) -> float:
    """Shortest mean time, s, of `currents(wrench_matrix(...))` by numpy with all checks, over rounds of `calls`."""
    best = math.inf
    for _ in range(20):
        start = time.perf_counter()
        for _ in range(calls):
            commutation.currents(commutation.wrench_matrix(par, model, p), W)
        best = min(best, (time.perf_counter() - start) / calls)
    return best


def compiled_seconds(f: ca.Function, *arguments: FloatArray, calls: int = 2000) -> float:
    """Shortest mean time, s, of a function's C code, over rounds of `calls`; NaN without a compiler."""
    timed = compile_function(f)
    if timed is None:
        return math.nan
    return min(timed(calls, *arguments)[0] for _ in range(20))


def compile_function(f: ca.Function) -> Callable[..., tuple[float, FloatArray]] | None:
    """A function compiled as C: (calls, *arguments) -> seconds for one call, result; None without a compiler."""
    generator = ca.CodeGenerator("code", {"with_header": False})
    generator.add(f)
    sizes = {"ARG": f.sz_arg(), "RES": f.sz_res(), "IW": f.sz_iw(), "W": f.sz_w()}
    defines = "".join(f"#define SZ_{name} {size + 1}\n" for name, size in sizes.items())
    library = engine.library(generator.dump() + defines + _TIMED_CODE.replace("FUNCTION", f.name()), 1)
    if library is None:
        return None
    timed = library.timed
    timed.restype = ctypes.c_double

    def call(calls: int, *arguments: FloatArray) -> tuple[float, FloatArray]:
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]
        result = np.empty(f.nnz_out(0))
        pointers = (ctypes.c_void_p * len(given))(*(a.ctypes.data for a in given))
        seconds = timed(pointers, len(given), ctypes.c_void_p(result.ctypes.data), calls)
        return seconds, result

    return call


_TIMED_CODE = """
#include <time.h>
double timed(const double **given, int n, double *result, int calls) {
  static const double *arg[SZ_ARG]; static double *res[SZ_RES]; static casadi_int iw[SZ_IW]; static double w[SZ_W];
  struct timespec a, b;
  clock_gettime(CLOCK_MONOTONIC, &a);
  for (int k = 0; k < calls; k++) {
    for (int j = 0; j < n; j++) arg[j] = given[j];
    res[0] = result;
    FUNCTION(arg, res, iw, w, 0);
  }
  clock_gettime(CLOCK_MONOTONIC, &b);
  return ((b.tv_sec - a.tv_sec) + 1e-9 * (b.tv_nsec - a.tv_nsec)) / calls;
}
"""


# What the paper's steps leave open: where currents act, what the filter knows, what soft gains leave.


PREDICTION = "place predicted"


def steps_ahead(plant: Plant, controller: Controller, **options: Any) -> Experiment:
    """The published steps from PLACE with currents for where they will act, by the exact coils.

    The same controller, but for its commutation (`commutate_ahead`); design files ask for it by `commutation`.
    """
    moves: dict[str, Any] = {"place": PLACE, "gap": GAP, "lift": LIFT, "distance": DISTANCE}
    wanted = step_cases(plant, controller, **moves, **options)[0]
    believed = planar.plant(parameters_of(controller))
    ahead = commutate_ahead(controller, linearize(believed, believed.point(controller.operating_point[0])))
    flights = [(plant, with_coil_model(ahead, "exact"), wanted._replace(label=f"exact, {PREDICTION}"))]
    cases, cut = fly_all(flights, None, options)
    return Experiment("step", "What is left when currents are where they act?", cases, (), interrupted=cut)


def delay(
    plant: Plant,
    controller: Controller,
    *,
    speeds: tuple[float, ...] = (1.0, 2.0, 3.0),
    place: tuple[float, ...] = PLACE,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The steps with filters that know of the sample of computation and with such that do not.

    speeds : of the regulator and the filter, in multiples of the controller's own

    Raises InputError for a PID, which predicts nothing.
    """
    if controller.cost is None or controller.noise is None:
        raise InputError("simulate", "scenario", "'delay' with a PID, which predicts nothing", "an LQG")
    moves: dict[str, Any] = {"place": place, "gap": GAP, "lift": LIFT, "distance": DISTANCE}
    wanted = step_cases(plant, controller, **moves, **options)[0]._replace(merits=_rest_merits)
    flights = [
        (
            plant,
            scale_speed(controller, speed, controller.delay if knows else 0),
            wanted._replace(label=f"{'with' if knows else 'without'}, {speed:g} x"),
        )
        for speed in speeds
        for knows in (True, False)
    ]
    cases, cut = fly_all(flights, progress, options)
    return Experiment("delay", "Does the filter have to know of the delay?", cases, (), interrupted=cut)


def scale_speed(controller: Controller, speed: float, delay: float) -> Controller:
    """The LQG of the same cost and noise, `speed` times as fast, with `delay` samples in its design model.

    Natural frequencies of a double integrator go with the fourth root of q / r, those of its filter with the fourth
    root of the ratio of variances; the filter then follows disturbances `speed` times as fast.
    """
    plant, own = planar.plant(parameters_of(controller)), weights_of(controller)
    weights = replace(
        own,
        q=own.q * speed**4,
        process_variance=own.process_variance * speed**4,
        drift_variance=own.drift_variance * speed**6,
    )
    model = linearize(plant, plant.point(controller.operating_point[0]))
    return lqg(
        model, weights, controller.sample_time, "sampled-data", delay, name=controller.name, solver="scipy"
    )


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Largest deviation of the angles, and the errors in the last tenth of the run."""
    error = np.abs(run.p - run.reference)
    late = error[run.t >= 0.9 * run.scenario.duration]
    return (
        Merit("angles, largest deviation", float(error[:, 3:].max()), "urad"),
        Merit("angles, left at rest", largest_of(late[:, 3:]), "urad"),
        Merit("position, left at rest", largest_of(late[:, :3]), "um"),
    )


def soft_jumps(plant: Plant, controller: Controller, *, rate: float = 0.0, **options: Any) -> Experiment:
    """The jumps of `jump` with soft gains alone, by the analytical model and by the table; what `jump` says holds."""
    reference = partial(jumps_reference, place=PLACE, gap=GAP, lift=LIFT, distance=DISTANCE)
    scenario = scenario_of("jump", DURATION, reference, FORCES | options)
    soft = soften(controller, plant, (rate, rate) if rate else braking_rates(plant, DISTANCE, LIFT))
    laws = {f"{model}, {SOFT_END}": with_coil_model(soft, model) for model in ("analytical", "table")}
    cases, cut = fly_all(jumps_of(plant, laws, scenario), None, options)
    return Experiment("jump", "What do the coil models leave of jumps?", cases, (), interrupted=cut)


EXPERIMENTS: dict[str, Callable[..., Experiment]] = {"errors": errors, "delay": delay, "timing": timing}
FINDINGS = ("delay",)
OPTION_UNITS = {"current": "A"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number outside the range of an option."""
    numbers = value if isinstance(value, tuple | list) else (value,)
    if option in ("speeds", "current") and not all(math.isfinite(v) and v > 0 for v in numbers):
        raise InputError("simulate", f"{name}: {option}", repr(value), "finite, above 0")
    machine.check(name, option, value)
