"""v0(z) of MALTA as its paper has it: recorded by a slow stroke there and back, or from a log of one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from malta import CheckError, InputError
from malta.arrays import FloatArray
from malta.machines.tubular.experiments.strokes import delayed_stroke
from malta.model import Plant
from malta.simulation import Experiment, Trajectory
from malta.simulation.experiments import (
    Case,
    Merit,
    PlannedRun,
    Progress,
    fly_all,
    progress_of_part,
    rms,
    scenario_of,
)
from malta.simulation.references import QUINTIC_DURATION, Motion, Reference, quintic
from malta.synthesis import Controller
from malta.synthesis.feedforward import V0_STEP, V0_STEPS

if TYPE_CHECKING:
    from malta.identification import Log

# v0(z) of MALTA recorded by a slow stroke there and back, beside the computed one, also with displaced cogging.
#
# In steady state the commanded forces hold the mover, whatever the loads are: v + d(z) = m z'' ~ 0. What depends on
# the way, as friction and the lag of the integrals, has opposite signs there and back, and the mean of both is
#
#     v0(z) = (v_there(z) + v_back(z)) / 2
#
# Each way is fitted by least squares with a function that is linear between the positions of a grid, as the law reads
# it. Means of some neighbouring samples are fitted: the noise of a single reading of z is in the command of the same
# sample.


SLOW_STROKE, OWN_TABLE, RECORDED_TABLE = "slow stroke", "own v0", "recorded v0"  # the cases of a machine
COVERED_SHARE = 0.98  # share of the travel, either way, that a log has to cover and the recorded table covers
SWEPT_SHARE = 0.99  # share of the travel that the slow stroke covers
POINTS = 4000  # means of neighbouring samples, at least, where a log has so many samples
TURN = 0.05  # share of the travel: a shorter way back is noise
MIN_MEANS = 2  # means in each interval of the grid, each way
INERTIA = 0.1  # N, largest inertial force of a stroke that counts as slow
PLACES = 20  # parts of the travel with a mean speed each


class ForceLog(NamedTuple):
    """Samples of a machine under control, SI."""

    source: str  # the file or the run, as errors name it
    t: FloatArray  # s, k
    z: FloatArray  # m, k, measured positions along the stroke
    v: FloatArray  # N or N m, k x m, commanded forces


def force_log(run: Trajectory) -> ForceLog:
    """The log of a simulated run of a machine with a stroke."""
    return ForceLog(run.scenario.name, run.t, run.y[:, run.plant.stroke_output], run.v)


def forces_of(log: Log, plant: Plant) -> ForceLog:
    """Positions and commanded forces of a log. Raises InputError for a missing column, and for a missing reading."""
    names = [s.name for s in plant.inputs]
    z, v = log.table("y", [plant.stroke.name]), log.table("v", names)
    for name, column in zip([plant.stroke.name, *names], np.hstack([z, v]).T, strict=True):
        missing = np.flatnonzero(~np.isfinite(column))
        if len(missing):
            found = f"no finite number in row {missing[0] + 1}"
            raise InputError(log.source, name, found, "a number in every row")
    return ForceLog(log.source, log.t, z[:, 0].copy(), np.ascontiguousarray(v))  # in memory as a run has them


class Recorded(NamedTuple):
    """v0(z) from a log."""

    z_grid: FloatArray  # m, g
    v0: FloatArray  # N, g x m
    apart: FloatArray  # N, g x m, half of the difference between the two ways


def slow_stroke(plant: Plant, way: float) -> Reference:
    """From one end of the travel to the other and back, a quintic of `way` seconds each.

    The stroke begins and ends at -SWEPT_SHARE of the travel; the other outputs stay at zero.
    """
    reach, axis = SWEPT_SHARE * plant.stroke.travel, plant.stroke_output

    def at(t: FloatArray) -> Motion:
        motion = [np.zeros((len(t), len(plant.outputs))) for _ in range(3)]
        there, back = (quintic(t - centre, way / QUINTIC_DURATION) for centre in (way / 2, 1.5 * way))
        for column, one, other, offset in zip(motion, there, back, (-reach, 0.0, 0.0), strict=True):
            column[:, axis] = offset + 2 * reach * (one - other)
        return Motion(*motion)

    return at


def record(log: ForceLog, plant: Plant) -> Recorded:
    """The forces v0(z) that held a machine along its travel, from a log of a slow stroke there and back.

    Raises InputError, naming the log, where it does not cover the travel in both directions, or where the stroke is
    so fast that inertia takes a part of the forces.

        recorded = record(forces_of(malta.identification.read_log("stand.csv"), plant), plant)
    """
    reach = COVERED_SHARE * plant.stroke.travel
    low, high = float(log.z.min()), float(log.z.max())
    if low > -reach or high < reach:
        found = f"positions from {low * 1e3:.4g} to {high * 1e3:.4g} mm"
        raise InputError(
            log.source, plant.stroke.name, found, f"the travel, -{reach * 1e3:.4g} to {reach * 1e3:.4g} mm"
        )
    half = max(V0_STEPS, math.ceil(reach / V0_STEP))
    z_grid = np.linspace(-reach, reach, 2 * half + 1)
    means = _average(log)
    _require_slow(means, plant)
    rising = _is_rising(means.z, TURN * plant.stroke.travel)
    there, back = (
        _fit(means._replace(z=means.z[chosen], v=means.v[chosen]), z_grid, plant.stroke.name, way)
        for chosen, way in ((rising, "there"), (~rising, "back"))
    )
    return Recorded(z_grid, (there + back) / 2, (there - back) / 2)


def with_recorded(c: Controller, recorded: Recorded) -> Controller:
    """The controller with the recorded v0(z) in its feedforward, named NAME_recorded."""
    name = c.name if c.name.endswith("_recorded") else f"{c.name}_recorded"
    table = replace(c.feedforward, z_grid=recorded.z_grid, v0=recorded.v0)
    return replace(c, name=name, feedforward=table)


def require_integral_action(c: Controller) -> None:
    """Raise InputError for a controller that leaves a load at an offset, whose forces are not those of the load."""
    if c.tracks == "states" and not c.integrating and not c.observed:
        expected = "gains with integrals or observed disturbances"
        raise InputError("record-v0", "gains", f"{c.name}, without integral action", expected)


def _average(log: ForceLog) -> ForceLog:
    """Means of neighbouring samples; the last samples are left out where they do not fill a mean."""
    size = max(1, len(log.z) // POINTS)
    count = len(log.z) // size * size
    t, z, v = (s[:count].reshape(-1, size, *s.shape[1:]).mean(axis=1) for s in (log.t, log.z, log.v))
    return log._replace(t=t, z=z, v=v)


def _is_rising(z: FloatArray, turn: float) -> NDArray[np.bool_]:
    """True on a way towards positive z; a way back that is shorter than `turn` counts as noise."""
    from scipy.signal import find_peaks  # a third of a second to import

    turns = np.concatenate([find_peaks(sign * z, prominence=turn)[0] for sign in (1, -1)])
    edges = [0, *sorted(turns.tolist()), len(z)]
    rising = np.zeros(len(z), dtype=bool)
    for first, last in pairwise(edges):
        rising[first:last] = z[last - 1] > z[first]
    return rising


def _require_slow(log: ForceLog, plant: Plant) -> None:
    """Raise InputError where the mover's kinetic energy changes by more than INERTIA times the way.

    The speed is the mean one in each of PLACES parts of the travel, so that noise does not show.
    """
    edges = np.linspace(-COVERED_SHARE * plant.stroke.travel, COVERED_SHARE * plant.stroke.travel, PLACES + 1)
    middle, speed = (log.z[1:] + log.z[:-1]) / 2, np.abs(np.diff(log.z) / np.diff(log.t))
    place = np.digitize(middle, edges)
    mean = np.array([speed[place == k].mean() for k in range(1, PLACES + 1) if (place == k).any()])
    force = plant.stroke.mass / 2 * np.abs(np.diff(mean**2)).max(initial=0.0) / (edges[1] - edges[0])
    if force > INERTIA:
        found = f"a stroke that accelerates the mover by {force:.3g} N"
        raise InputError(log.source, plant.stroke.name, found, f"a slow one: at most {INERTIA:g} N")


def _fit(log: ForceLog, z_grid: FloatArray, stroke: str, way: str) -> FloatArray:
    """Values at the grid of the function, linear between them, that fits v(z) best: g x m.

    Raises InputError where an interval of the grid has too few samples.
    """
    inside = (log.z >= z_grid[0]) & (log.z <= z_grid[-1])
    z, v = log.z[inside], log.v[inside]
    k = np.clip(np.searchsorted(z_grid, z, side="right") - 1, 0, len(z_grid) - 2)
    counts = np.bincount(k, minlength=len(z_grid) - 1)
    if counts.min() < MIN_MEANS:
        found = f"no way {way} past {z_grid[int(counts.argmin())] * 1e3:.4g} mm"
        raise InputError(log.source, stroke, found, "a slow stroke there and back over the whole travel")
    b = (z - z_grid[k]) / (z_grid[k + 1] - z_grid[k])
    a, g = 1 - b, len(z_grid)
    normal = np.zeros((2, g))  # tridiagonal matrix of the normal equations: its diagonal, then below it
    normal[0] = np.bincount(k, a * a, g) + np.bincount(k + 1, b * b, g)
    normal[1] = np.bincount(k, a * b, g)
    right = [np.bincount(k, a * f, g) + np.bincount(k + 1, b * f, g) for f in v.T]
    return np.asarray(solveh_banded(normal, np.column_stack(right), lower=True))


class _StrokeCases(NamedTuple):
    """What one machine shows: its runs, and v0(z) where it could be recorded."""

    cases: tuple[Case, ...]
    recorded: Recorded | None
    interrupted: bool


def record_v0(
    plant: Plant,
    controller: Controller,
    *,
    log: str = "",
    way: float = 3.0,
    phase_error: float = 0.5,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """v0(z) recorded by a slow stroke there and back (`way` s each), or from the file `log`.

    The published stroke with the controller's own v0(z) and with the recorded one; the same on machines whose cogging
    is displaced by +-`phase_error` rad, which the controller does not know. With --out, gain files with the recorded
    v0(z).

    Raises InputError for a controller without integral action and for a log that cannot be used, CheckError where the
    simulated slow stroke does not cover the travel.
    """
    require_integral_action(controller)
    measured = None
    if log:
        from malta.identification import read_log  # which no run reads

        measured = forces_of(read_log(log), plant)
    machines = {"": plant} | dict(_displace(plant, phase_error))
    found: dict[str, _StrokeCases] = {}
    for n, (label, machine) in enumerate(machines.items()):
        share = progress_of_part(progress, n, len(machines))
        given = measured if not label else None
        found[label] = _record_on(machine, controller, label, given, way, share, options)
        if found[label].interrupted:
            break
    cases = tuple(case for one in found.values() for case in one.cases)
    recorded = found[""].recorded
    return Experiment(
        "record-v0",
        "Does the recorded v0 fit the machine?",
        cases,
        () if recorded is None else _differences(recorded, controller, plant),
        _curves({label: one.recorded for label, one in found.items()}),
        interrupted=any(one.interrupted for one in found.values()),
        controller=None if recorded is None else with_recorded(controller, recorded),
    )


def _displace(plant: Plant, error: float) -> Iterator[tuple[str, Plant]]:
    """The machine with its cogging displaced either way, by the labels of the cases."""
    par: Any = plant.parameters
    for sign, side in ((1, "more"), (-1, "less")) if error else ():
        displaced = replace(par, phi_c=par.phi_c + sign * error)
        yield f"phi_c {error:g} rad {side}: ", plant.variant(displaced)


def _record_on(
    plant: Plant,
    controller: Controller,
    label: str,
    log: ForceLog | None,
    way: float,
    progress: Progress | None,
    options: dict[str, Any],
) -> _StrokeCases:
    """The slow stroke on one machine unless there is a log, and the published stroke without and with its record."""
    cases: tuple[Case, ...] = ()
    if log is None:
        reference = partial(slow_stroke, way=way)
        sweep = PlannedRun(
            label + SLOW_STROKE, scenario_of("record-v0", 2 * way, reference, options), _merits
        )
        cases, cut = fly_all([(plant, controller, sweep)], progress_of_part(progress, 0, 2), options)
        if cut:
            return _StrokeCases(cases, None, True)
    recorded = record(log, plant) if log is not None else _recorded_from(cases[0].run, required=not label)
    scenario = scenario_of("stroke", 0.2, partial(delayed_stroke, wait=0.0), options)
    flights = [(plant, controller, PlannedRun(label + OWN_TABLE, scenario, _merits))]
    if recorded is not None:
        known = with_recorded(controller, recorded)
        flights.append((plant, known, PlannedRun(label + RECORDED_TABLE, scenario, _merits)))
    strokes, cut = fly_all(flights, progress_of_part(progress, 1, 2), options)
    return _StrokeCases((*cases, *strokes), recorded, cut)


def _recorded_from(run: Trajectory, *, required: bool) -> Recorded | None:
    """The record of a simulated slow stroke; None where the run ended early.

    Raises CheckError, where the record is required, for a slow stroke that does not cover the travel.
    """
    if not run.verdict.completed:
        return None
    try:
        return record(force_log(run), run.plant)
    except InputError as error:
        if required:
            raise CheckError(f"the slow stroke gives no v0: {error}") from error
        return None


def _merits(run: Trajectory) -> tuple[Merit, ...]:
    """How far a run is off its reference."""
    error, axis = run.p - run.reference, run.plant.stroke_output
    across = [k for k in range(error.shape[1]) if k != axis]
    return (
        Merit("axial error", float(np.abs(error[:, axis]).max()), "um"),
        Merit("axial error, rms", rms(error[:, axis]), "um"),
        Merit("radial deviation", float(np.abs(error[:, across]).max()), "um"),
    )


def _differences(recorded: Recorded, controller: Controller, plant: Plant) -> tuple[Merit, ...]:
    """The largest differences between the recorded v0(z) and the controller's own, and of the two ways."""
    off = np.abs(recorded.v0 - _own(controller, recorded.z_grid))
    merits = [
        Merit(
            f"largest |recorded - own v0|, {signal.name}",
            float(off[:, k].max()),
            "N",
            key=f"recorded_minus_own_v0_{signal.name}",
        )
        for k, signal in enumerate(plant.inputs)
    ]
    at = float(recorded.z_grid[int(off[:, plant.thrust_input].argmax())])
    merits.append(
        Merit(
            f"that of {plant.stroke.thrust} at {plant.stroke.name}",
            at,
            "mm",
            key=f"recorded_minus_own_v0_{plant.stroke.thrust}_at",
        )
    )
    apart = float(np.abs(recorded.apart).max())
    return (
        *merits,
        Merit("largest |there - back| / 2 of any force", apart, "N", key="half_there_minus_back"),
    )


def _own(controller: Controller, z: FloatArray) -> FloatArray:
    """v0 of the controller at positions z, k x m."""
    return np.array([controller.feedforward.at(float(at)) for at in z])


def _curves(recorded: dict[str, Recorded | None]) -> dict[str, FloatArray]:
    """The recorded tables for the figure: positions z, and v0 by the label of the machine."""
    tables = {label: one for label, one in recorded.items() if one is not None}
    if not tables:
        return {}
    z = {"z": next(iter(tables.values())).z_grid}
    return z | {f"v0 {label}": one.v0 for label, one in tables.items()}
