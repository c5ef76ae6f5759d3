"""Computing times of the planar motor's commutation."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.machines.planar import coils, commutation
from malta.machines.planar import plant as planar
from malta.machines.planar.experiments.motions import CELLS, FORCES, PLACE, parameters_of, with_coil_model
from malta.model.plant import Plant
from malta.simulation import compiled as engine
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    scenario_of,
)
from malta.simulation.layout import numbers_of
from malta.simulation.period import period_of
from malta.simulation.scenario import Scenario, setup_of
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


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
    models: dict[str, coils.CoilModel] = {
        "table": coils.table(par, coils.simulation_model(par), cells),
        "exact": coils.simulation_model(par),
        "analytical": coils.Analytical(par),
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
            Merit(f"{name}, compiled", seconds, "us", f"table_2.{PRINTED[name]}", "at most")
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
PRINTED = {"table": "interpolation", "analytical": "analytical", "exact": "interpolation"}


def _no_merits(_: Trajectory) -> tuple[Merit, ...]:
    """No figures of merit."""
    return ()


def numpy_seconds(
    par: planar.Parameters, model: coils.CoilModel, p: FloatArray, W: FloatArray, calls: int = 20
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
