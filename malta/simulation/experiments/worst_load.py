"""The worst load of a size: flown, it moves the machine as far as the linear loop says that any load can."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.display import quantity
from malta.errors import InputError
from malta.model.plant import Plant, Signal
from malta.simulation import references
from malta.simulation.experiments import (
    Merit,
    PlannedRun,
    choose_signals,
    scenario_of,
    with_exact_sensors,
    with_fidelity,
)
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.units import FINE_UNITS

if TYPE_CHECKING:
    from malta.loops.loop import Loop

WORST_LOAD = "worst-load"  # the experiment
LOAD_SHARE = 0.5  # of the way to a contact or a sensor's end, at most, by a load of default size
AFTER_PEAK = 20  # samples, that the run goes on


def worst_load_cases(
    plant: Plant, controller: Controller, *, on: str = "", output: str = "", size: float = 0.0, **options: Any
) -> list[PlannedRun]:
    """The load of at most `size` whose waveform moves one signal furthest by the linear loop, with exact sensors.

    on : a disturbance, or "all" of them, one after the other; "": the first
    output : an output, a command or a contact; "": the contact of which most is used, or the output that moves furthest
    size : SI; 0: 1, or what uses half of a clearance

    Raises InputError for signals that the machine does not have, and for a load that moves none of them.
    """
    from malta.loops.loop import loop_along  # here: most experiments need no linear loop

    if not plant.disturbances:
        raise InputError(plant.name, "disturbances", "none", "a machine on which forces act from outside")
    chosen = choose_signals(plant.disturbances, on or plant.disturbances[0].name, "on")
    loop = loop_along(plant, controller)
    return [_worst_run(loop, plant.disturbances[k], output, size, options) for k in chosen]


def _worst_run(loop: Loop, load: Signal, output: str, size: float, options: Mapping[str, Any]) -> PlannedRun:
    """The run under the worst waveform of one load."""
    from malta.loops.waveforms import nominal_waveform, used_clearances

    plant, contacts, used = loop.plant, loop.plant.contacts.names, dict[str, float]()
    if contacts and (not output or (output in contacts and not size)):
        used = dict(zip(contacts, used_clearances(loop, load.name, np.ones(1))[0].tolist(), strict=True))
    seen = output or (max(used, key=lambda name: used[name]) if used else _most_moved(loop, load.name))
    share = used.get(seen, 0.0)
    size = size or (1.0 if share <= LOAD_SHARE else float(f"{LOAD_SHARE / share:.1g}"))
    found = nominal_waveform(loop, load.name, seen, size)
    given = with_exact_sensors(with_fidelity(plant, options)) | {"disturbance": found.load}
    duration = found.peak_time + AFTER_PEAK * found.sample_time
    label = f"worst {load.name} of {quantity(size, load.unit)} for {seen}"
    merits = partial(_reach_merits, signal=seen, bound=found.value + found.error)
    return PlannedRun(label, scenario_of(WORST_LOAD, duration, references.hold, given), merits)


def _most_moved(loop: Loop, load: str) -> str:
    """The output of a machine without contacts that a load moves most of its noise."""
    from malta.loops.waveforms import bound_any_waveform, load_shares

    moved = bound_any_waveform(loop, load_shares(loop.plant, load)[1])
    noise = np.asarray(loop.plant.sensors.noise, dtype=float)
    return loop.plant.outputs[int((moved / np.where(noise > 0, noise, 1.0)).argmax())].name


def _reach_merits(run: Trajectory, signal: str, bound: float) -> tuple[Merit, ...]:
    """How far a signal goes, and the share of the linear loop's bound that it reaches."""
    plant, contacts = run.plant, run.plant.contacts.names
    outputs, inputs = ([s.name for s in signals] for signals in (plant.outputs, plant.inputs))
    if signal in contacts:
        reached, unit = float(run.contact[:, contacts.index(signal)].max()), "percent"
        words = f"{signal}: clearance used"
    elif signal in outputs:
        k = outputs.index(signal)
        reached, unit = float(np.abs((run.p - run.reference)[:, k]).max()), plant.outputs[k].unit
        words = f"{signal} moves by"
    else:
        k = inputs.index(signal)
        reached, unit = float(np.abs(run.v[:, k] - run.v[0, k]).max()), plant.inputs[k].unit
        words = f"{signal} changes by"
    shown = FINE_UNITS.get(unit, unit)
    return (
        Merit(words, reached, shown, key="reached"),
        Merit("linear loop, any waveform: at most", bound, shown, key="bound"),
        Merit("reached of that", reached / bound, "percent", key="share_of_bound", better=""),
    )
