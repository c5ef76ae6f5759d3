"""v0(z) of MALTA recorded by a slow stroke, beside the computed one, on machines whose cogging is displaced."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import CheckError, InputError
from malta.machines.tubular.experiments.strokes import delayed_stroke
from malta.model.plant import Plant
from malta.simulation.experiments import (
    Case,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly_all,
    progress_of_part,
    rms,
    scenario_of,
)
from malta.simulation.force_log import ForceLog, log_of, read_log
from malta.simulation.recording import (
    Recorded,
    record,
    require_integral_action,
    slow_stroke,
    with_recorded,
)
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


SLOW, OWN, RECORDED = "slow stroke", "own v0", "recorded v0"  # the cases of a machine


class _Found(NamedTuple):
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
    """v0(z) recorded by a slow stroke there and back (`way` s each), or from the file `log` (.csv, .npz).

    The published stroke with the controller's own v0(z) and with the recorded one; the same on machines whose cogging
    is displaced by +-`phase_error` rad, which the controller does not know. With --out, gain files with the recorded
    v0(z).

    Raises InputError for a controller without integral action and for a log that cannot be used, CheckError where the
    simulated slow stroke does not cover the travel.
    """
    require_integral_action(controller)
    measured = read_log(log, plant) if log else None
    machines = {"": plant} | dict(_displace(plant, phase_error))
    found: dict[str, _Found] = {}
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
) -> _Found:
    """The slow stroke on one machine unless there is a log, and the published stroke without and with its record."""
    cases: tuple[Case, ...] = ()
    if log is None:
        reference = partial(slow_stroke, way=way)
        sweep = PlannedRun(label + SLOW, scenario_of("record-v0", 2 * way, reference, options), _merits)
        cases, cut = fly_all([(plant, controller, sweep)], progress_of_part(progress, 0, 2), options)
        if cut:
            return _Found(cases, None, True)
    recorded = record(log, plant) if log is not None else _recorded_from(cases[0].run, required=not label)
    scenario = scenario_of("stroke", 0.2, partial(delayed_stroke, wait=0.0), options)
    flights = [(plant, controller, PlannedRun(label + OWN, scenario, _merits))]
    if recorded is not None:
        known = with_recorded(controller, recorded)
        flights.append((plant, known, PlannedRun(label + RECORDED, scenario, _merits)))
    strokes, cut = fly_all(flights, progress_of_part(progress, 1, 2), options)
    return _Found((*cases, *strokes), recorded, cut)


def _recorded_from(run: Trajectory, *, required: bool) -> Recorded | None:
    """The record of a simulated slow stroke; None where the run ended early.

    Raises CheckError, where the record is required, for a slow stroke that does not cover the travel.
    """
    if not run.verdict.completed:
        return None
    try:
        return record(log_of(run), run.plant)
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
            f"that of {plant.thrust} at {plant.stroke}",
            at,
            "mm",
            key=f"recorded_minus_own_v0_{plant.thrust}_at",
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
