"""The experiments on the planar motor.

step     the paper's steps in z and y, Figs 9 to 12, with each coil model in the controller
errors   what the coil models miss of the exact wrench, Figs 7, 8 and 13
delay    the filter that knows of the sample of computation, and the one that does not
timing   K(p) and its pseudo-inverse within the control period, Table 2

The coil models are the controller's: the machine always has the field's own wrench.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.machines.planar import plant as planar
from malta.machines.planar.field import COIL_ORDER
from malta.model.linearize import linearize
from malta.model.plant import Plant
from malta.simulation import compiled as engine
from malta.simulation import references
from malta.simulation.experiments import (
    QUIET,
    Case,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    fly_all,
    scenario_of,
)
from malta.simulation.references import Motion, Reference
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.lqg import lqg, weights_of

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

MODELS = ("exact", "table", "analytical")  # of the coils, in the controller
PLACE = (6e-3, 4e-3)  # m, x and y where no mirror makes anything zero; the paper's own is missing
CELLS = 35  # of the table over tau_n, along x and along y; the paper's number is missing
# Sec. 4.2: the steps and when they begin. Ours: quintics of this duration, as steps would wind up at 1000 N.
LIFT, LIFT_AT, LIFTING = 1e-3, 0.01, 0.02  # m, s, s
DISTANCE, MOVE_AT, MOVING = 10e-3, 0.03, 0.04
DURATION = 0.1  # s
GAP = 50e-6  # m, over the magnets at the start. NOTE: the paper starts on them, where this machine has touched down
WITHIN = 10e-6  # m: y has arrived


def believing(controller: Controller, model: str, cells: int = CELLS) -> Controller:
    """The same gains with another coil model to find the currents by: one of MODELS."""
    known: dict[str, dict[str, float]] = {
        "exact": {"order": COIL_ORDER, "cells": 0},
        "table": {"order": COIL_ORDER, "cells": cells},
        "analytical": {"order": 1, "cells": 0},
    }
    par: Any = controller.parameters
    return replace(controller, parameters=replace(par, **known[model]))


def _parameters(of: Controller | Plant) -> planar.Parameters:
    par = of.parameters
    assert isinstance(par, planar.Parameters)
    return par


def step(
    plant: Plant,
    controller: Controller,
    *,
    place: tuple[float, ...] = PLACE,
    gap: float = GAP,
    lift: float = LIFT,
    distance: float = DISTANCE,
    cells: int = CELLS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The published steps: up by `lift` (m) from `gap` (m), then `distance` (m) along y, from `place` (m) and (0, 0).

    Once with each coil model in the controller; `cells` of the table over tau_n.
    """
    wanted = _step_cases(plant, controller, place=place, gap=gap, lift=lift, distance=distance, **options)
    flights = [
        (plant, believing(controller, model, cells), one._replace(label=f"{model}, {one.label}"))
        for model in MODELS
        for one in wanted
    ]
    cases, cut = fly_all(flights, progress, options)
    merits = cases[0].merits if cut else _moved_by(cases)
    return Experiment("step", "What does the coil model move?", cases, merits, interrupted=cut)


def _step_cases(
    plant: Plant,
    _: Controller,
    *,
    place: tuple[float, ...],
    gap: float,
    lift: float,
    distance: float,
    cells: int = CELLS,  # noqa: ARG001 - the controller's own coil model flies
    **options: Any,
) -> list[PlannedRun]:
    if len(place) != 2:
        raise InputError("simulate", "step: place", f"{len(place)} numbers", "x and y")
    wanted = []
    for x, y in ((place[0], place[1]), (0.0, 0.0)):
        reference = partial(steps, place=(x, y), gap=gap, lift=lift, distance=distance)
        reference(plant)  # raises where it leaves the travel
        scenario = scenario_of("step", DURATION, reference, FORCES | options)
        wanted.append(PlannedRun(f"from ({x * 1e3:g}, {y * 1e3:g}) mm", scenario, step_merits))
    return wanted


FORCES: dict[str, Any] = QUIET | {"fidelity": "force", "substeps": 1}  # whose error is 1e-13 m


def steps(plant: Plant, place: tuple[float, float], gap: float, lift: float, distance: float) -> Reference:
    """Two quintics: z from `gap` (m) over the magnets up by `lift`, then y by `distance`; the rest stays.

    Raises InputError for a position outside the travel.
    """
    par = _parameters(plant)
    first = np.array([*place, gap])
    last = first + np.array([0, distance, lift])
    for p in (first, last):
        planar.checked(par, p)
    moves = ((2, lift, LIFT_AT, LIFTING), (1, distance, MOVE_AT, MOVING))

    def at(t: FloatArray) -> Motion:
        motion = [np.zeros((len(t), 6)) for _ in range(3)]
        motion[0][:, :3] = first - [0, 0, par.h]
        for axis, size, begin, duration in moves:
            rise = duration / references.QUINTIC_DURATION
            for column, s in zip(
                motion, references.quintic(np.asarray(t) - begin - duration / 2, rise), strict=True
            ):
                column[:, axis] += size * s
        return Motion(*motion)

    return at


def step_merits(run: Trajectory) -> tuple[Merit, ...]:
    """When y arrives, overshoot, z, what moves that should not, forces and currents."""
    Ts, error = run.controller.sample_time, np.abs(run.p - run.reference)
    target = run.scenario.reference(run.plant)(np.array([run.scenario.duration])).p[0]
    late = run.t >= LIFT_AT + 0.02 - Ts / 2
    beyond = (run.p[:, 1] - target[1]) * np.sign(target[1] - run.reference[0, 1])
    return (
        Merit("y within 10 um after its step", _arrival(run, target[1]), "ms"),
        Merit("y, overshoot", max(float(beyond.max()), 0.0), "um"),
        Merit("z, from 20 ms after its step", _largest(np.abs(run.p[late, 2] - target[2])), "um"),
        *(
            Merit(f"{signal.name}, deviation", float(error[:, k].max()), "um" if k < 3 else "urad")
            for k, signal in enumerate(run.plant.outputs)
            if signal.name not in "yz"
        ),
        Merit("largest force", float(np.abs(run.v[:, :3]).max()), "N", "steps.force_limit", "at most"),
        Merit("largest coil current", float(np.abs(run.current).max()), "A"),
    )


def _arrival(run: Trajectory, target: float) -> float:
    """From the step in y until it stays within WITHIN of the target, s; NaN if it does not."""
    off = np.flatnonzero(np.abs(run.p[:, 1] - target) > WITHIN)
    if not len(off) or off[-1] + 1 == len(run.t):
        return math.nan
    return float(run.t[off[-1] + 1]) - MOVE_AT


def _largest(values: FloatArray) -> float:
    return float(values.max()) if values.size else math.nan


def _moved_by(cases: Sequence[Case]) -> tuple[Merit, ...]:
    """How far each coil model moves the mover off the path that the exact one takes, from the first place.

    What is left with the exact one comes of currents that are held, and a sample old; the paper's runs have neither.
    """
    exact = cases[0].run
    merits = []
    for case in cases[2::2]:
        size = min(len(exact.p), len(case.run.p))
        off = np.abs(case.run.p[:size] - exact.p[:size]).max(axis=0)
        model = case.label.split(",")[0]
        for k, signal in enumerate(exact.plant.outputs):
            if k != 1:
                merits.append(
                    Merit(f"{model} moves {signal.name} by", float(off[k]), "um" if k < 3 else "urad")
                )
    return tuple(merits)


CURRENT = 3.0  # A in one coil: Sec. 4.1
NODES = (5, 7, 10, 14, 20, 28, 35, 50, 70)  # tables of so many cells over tau_n


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

    The coil is an inner one of the mover, its torques are about the centre of gravity: the paper does not say which.
    And what a hover at `place` (m) has to correct, as its force is not what the model says.
    """
    par = _parameters(plant)
    if len(place) != 2:
        raise InputError("simulate", "errors: place", f"{len(place)} numbers", "x and y")
    planar.checked(par, np.array([*place, par.h]))
    truth = planar.truth(par)
    models: dict[str, planar.CoilModel] = {
        "analytical": planar.Analytical(par),
        "table": planar.table(par, truth, cells),
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
        flights.append((plant, believing(controller, name, cells), PlannedRun(name, scenario, merits)))
    cases, cut = fly_all(flights, progress, options)
    curves |= {"step": par.tau_n / np.array(NODES), "by step": _by_step(par, truth, current)}
    amplitude = np.abs(exact).max(axis=(0, 1))
    found_merits = (
        *(
            Merit(f"{s.name}, amplitude", float(a), s.unit, f"model.amplitude.{s.name}")
            for s, a in zip(plant.inputs, amplitude, strict=True)
        ),
        Merit("fitted C of the analytical model", planar.compensation(par, truth), "1"),
        Merit("error of the table, each halving of its step", _order(curves), "1"),
    )
    return Experiment("errors", "What do the coil models miss?", cases, found_merits, curves, interrupted=cut)


def coil_wrench(
    par: planar.Parameters, model: planar.CoilModel, current: float, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Of an inner coil with its centre at x, y, at the working height, about the mover's centre of gravity: ... x 6."""
    own = current * model(x, y, np.full_like(x, par.h))
    arm = np.array([par.coil_pitch / 2, par.coil_pitch / 2, par.r_z])
    own[..., 3:] += np.cross(arm, own[..., :3])
    return np.asarray(own)


def _by_step(par: planar.Parameters, truth: planar.CoilModel, current: float) -> FloatArray:
    """Largest errors of a table, for each of NODES, N: F_x and F_z, in the middle and on the edges of cells."""
    found = []
    for n in NODES:
        fine = np.linspace(0, par.tau_n, 2 * n + 1)
        x, y = np.meshgrid(fine, fine, indexing="ij")
        exact = coil_wrench(par, truth, current, x, y)
        error = np.abs(coil_wrench(par, planar.table(par, truth, n), current, x, y) - exact)
        found.append(error[..., [0, 2]].max(axis=(0, 1)))
    return np.array(found)


def _order(curves: Mapping[str, FloatArray]) -> float:
    """By what the error of F_x falls from 10 to 20 cells."""
    error = curves["by step"][:, 0]
    return float(error[NODES.index(10)] / error[NODES.index(20)])


def _error_merits(run: Trajectory, largest: FloatArray) -> tuple[Merit, ...]:
    missed = np.abs(run.v[-1] - np.array(ca.evalf(run.plant.preload(ca.DM(run.x[-1])))).ravel())
    return (
        *(
            Merit(f"{s.name}, largest error", float(e), s.unit)
            for s, e in zip(run.plant.inputs, largest, strict=True)
        ),
        Merit("hover: force to correct", float(missed[:3].max()), "N"),
        Merit("hover: torque to correct", float(missed[3:].max()), "N m"),
    )


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
    wanted = _step_cases(plant, controller, **moves, **options)[0]._replace(merits=_late_merits)
    flights = [
        (
            plant,
            faster(controller, speed, controller.delay if knows else 0),
            wanted._replace(label=f"{'with' if knows else 'without'}, {speed:g} x"),
        )
        for speed in speeds
        for knows in (True, False)
    ]
    cases, cut = fly_all(flights, progress, options)
    return Experiment("delay", "Does the filter have to know of the delay?", cases, (), interrupted=cut)


def faster(controller: Controller, speed: float, delay: int) -> Controller:
    """The LQG of the same cost and noise, so many times as fast, with so many samples of delay in its model.

    Natural frequencies of a double integrator go with the fourth root of q / r, those of its filter with the fourth
    root of the ratio of variances; a disturbance is then followed as many times as fast.
    """
    plant, own = planar.plant(_parameters(controller)), weights_of(controller)
    weights = replace(
        own,
        q=own.q * speed**4,
        process_variance=own.process_variance * speed**4,
        drift_variance=own.drift_variance * speed**6,
    )
    model = linearize(plant, plant.point(controller.operating_point[0]))
    return lqg(model, weights, controller.sample_time, "sampled-data", delay, name=controller.name)


def _late_merits(run: Trajectory) -> tuple[Merit, ...]:
    """The last tenth of the run, at rest: what circles there."""
    error = np.abs(run.p - run.reference)
    late = error[run.t >= 0.9 * run.scenario.duration]
    return (
        Merit("angles, largest deviation", float(error[:, 3:].max()), "urad"),
        Merit("angles, left at rest", _largest(late[:, 3:]), "urad"),
        Merit("position, left at rest", _largest(late[:, :3]), "um"),
    )


def timing(
    plant: Plant,
    controller: Controller,
    *,
    cells: int = CELLS,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """How long K(p) and its pseudo-inverse take on this computer, by numpy and compiled, beside a hover of 10 ms."""
    par = _parameters(plant)
    scenario = scenario_of("timing", 0.01, references.hold, FORCES | options)
    cases, cut = fly(plant, controller, [PlannedRun("hover", scenario, _no_merits)], progress, options)
    models: dict[str, planar.CoilModel] = {
        "table": planar.table(par, planar.simulated(par), cells),
        "exact": planar.simulated(par),
        "analytical": planar.Analytical(par),
    }
    p, W = np.array([*PLACE, par.h]), np.array([10.0, 200, 400, 1, 2, 3])
    plain = numpy_seconds(par, models["table"], p, W)
    compiled = {name: compiled_seconds(planar.decoupling(par, model), p, W) for name, model in models.items()}
    Ts = controller.sample_time
    merits = (
        Merit("table, numpy", plain, "us", "table_2.interpolation", "at most"),
        *(
            Merit(f"{name}, compiled", seconds, "us", f"table_2.{PRINTED[name]}", "at most")
            for name, seconds in compiled.items()
        ),
        Merit("of the control period, table compiled", compiled["table"] / Ts, "percent"),
    )
    return Experiment("timing", "Is it quick enough?", cases, merits, interrupted=cut)


# The paper's name of each coil model; it has the exact one from its FEM only, point by point.
PRINTED = {"table": "interpolation", "analytical": "analytical", "exact": "interpolation"}


def _no_merits(_: Trajectory) -> tuple[Merit, ...]:
    return ()


def numpy_seconds(
    par: planar.Parameters, model: planar.CoilModel, p: FloatArray, W: FloatArray, calls: int = 20
) -> float:
    """Of `planar.currents(planar.wrench_matrix(...))`, checks included: the best of some rounds, s."""
    best = math.inf
    for _ in range(20):
        start = time.perf_counter()
        for _ in range(calls):
            planar.currents(planar.wrench_matrix(par, model, p), W)
        best = min(best, (time.perf_counter() - start) / calls)
    return best


def compiled_seconds(f: ca.Function, *arguments: FloatArray, calls: int = 2000) -> float:
    """Of one call of CasADi's C code for a function, compiled here: the best of some rounds, s; NaN: no compiler."""
    found = compiled(f)
    if found is None:
        return math.nan
    return min(found(calls, *arguments)[0] for _ in range(20))


def compiled(f: ca.Function) -> Callable[..., tuple[float, FloatArray]] | None:
    """(calls, *arguments) -> seconds a call and the result, by the compiled C code; None without a compiler."""
    generator = ca.CodeGenerator("code", {"with_header": False})
    generator.add(f)
    sizes = {"ARG": f.sz_arg(), "RES": f.sz_res(), "IW": f.sz_iw(), "W": f.sz_w()}
    defines = "".join(f"#define SZ_{name} {size + 1}\n" for name, size in sizes.items())
    library = engine.library(generator.dump() + defines + _TIMED.replace("FUNCTION", f.name()), 1)
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


_TIMED = """
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

EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "step": step,
    "errors": errors,
    "delay": delay,
    "timing": timing,
}
CASES: dict[str, Callable[..., list[PlannedRun]]] = {
    "step": _step_cases
}  # with the controller's own coil model
FINDINGS = ("delay",)
WORDS = {
    "stroke": "y",
    "m": "x and z",
    "rad": "angles",
    "thrust": "F_y",
    "N": "F_x and F_z",
    "N m": "torques",
}
OPTION_UNITS = {"place": "m", "gap": "m", "lift": "m", "distance": "m", "current": "A"}


def check(name: str, option: str, value: Any) -> None:
    """InputError for a number without a sense. Positions are looked at where the reference is made."""
    numbers = value if isinstance(value, tuple | list) else (value,)
    if option in ("cells", "speeds", "current") and not all(math.isfinite(v) and v > 0 for v in numbers):
        raise InputError("simulate", f"{name}: {option}", repr(value), "finite, above 0")
    if option == "cells" and value != int(value):
        raise InputError("simulate", f"{name}: cells", repr(value), "a whole number")
