"""The nonlinear machine beside a margin: with parameters inside it, and beyond it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.model.equilibrium import balance, with_command
from malta.model.places import position_in
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation import references
from malta.simulation.experiments import Case, scenario_of, with_fidelity
from malta.simulation.experiments.catalogue import SAMPLES
from malta.simulation.references import Reference
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

WITNESS_SHARES = (0.95, 1.05)  # of the way to a witness: inside the margin and beyond it
LEAVING_FACTOR = 5.0  # times its push: a machine beyond the margin is shown until it has left so far
MAX_SAMPLES = 64_000  # samples of such a run
HELD_SHARE = 0.98  # of a witness at an end of the travel, where a stop is touched
PUSH: Mapping[str, float] = {"m": 2e-5, "rad": 2e-5}  # where these begin


def witness_flights(plant: Plant, controller: Controller, witness: Mapping[str, float]) -> list[Case]:
    """Fly the nonlinear machine with parameters inside a margin and beyond it, pushed a little at the beginning.

    witness : values (SI) with which the linear loop is at its limit of stability; an output among them is where it is

    Returns two runs, one inside and one beyond the margin, under the machine's loads. They begin beside rest: v0 of the
    law is what holds the machine there, as its integrals find it.

    Example: `witness_flights(plant, controller, margin.witness)[1].run.verdict`
    """
    samples, beyond = SAMPLES, _fly_beside(plant, controller, witness, WITNESS_SHARES[1], SAMPLES)
    while beyond.verdict.completed and not _leaves(beyond) and samples < MAX_SAMPLES:
        samples *= 2
        beyond = _fly_beside(plant, controller, witness, WITNESS_SHARES[1], samples)
    inside = _fly_beside(plant, controller, witness, WITNESS_SHARES[0], samples)
    sides = zip(("inside", "beyond"), WITNESS_SHARES, (inside, beyond), strict=True)
    return [Case(f"{side} the margin, at {100 * share:.0f} % of it", run, ()) for side, share, run in sides]


def _fly_beside(
    plant: Plant, controller: Controller, witness: Mapping[str, float], share: float, samples: int
) -> Trajectory:
    """A run of the machine at a share of the way from its own parameters to a witness."""
    held = {
        signal.name: HELD_SHARE * witness[signal.name] for signal in plant.outputs if signal.name in witness
    }
    own: Any = plant.parameters
    ends = {name: value for name, value in witness.items() if hasattr(own, name)}
    there = plant_of(
        replace(own, **{name: (1 - share) * getattr(own, name) + share * end for name, end in ends.items()})
    )
    start = {s.name: held.get(s.name, 0.0) + PUSH[s.unit] for s in plant.design_states if s.unit in PUSH}
    options: dict[str, Any] = {"start": start} | with_fidelity(plant, {})
    at = there.at(**{name: value for name, value in held.items() if name in {s.name for s in there.states}})
    controller = settle_feedforward(controller, there, at.x)
    duration = samples * controller.sample_time
    return simulate(
        there, controller, scenario_of("witness", duration, partial(_hold_at, outputs=held), options)
    )


def settle_feedforward(controller: Controller, plant: Plant, x: FloatArray) -> Controller:
    """The law with v0 moved by what its integrals add until a machine rests at the states x. Raises CheckError."""
    wanted = with_command(plant, balance(plant, x), plant_of(controller.parameters)).v
    known = controller.feedforward
    held = known.at_rest(position_in(plant, x), x[list(plant.controlled)])
    return replace(controller, feedforward=replace(known, v0=known.v0 + (np.asarray(wanted) - held)))


def _hold_at(plant: Plant, outputs: Mapping[str, float]) -> Reference:
    return references.hold(plant, **outputs)


def _leaves(run: Trajectory) -> bool:
    """Whether the deviation at the end is many times that of the beginning."""
    off, tenth = np.abs(run.p - run.reference).max(axis=1), max(len(run.p) // 10, 1)
    return bool(off[-tenth:].max() > LEAVING_FACTOR * off[0])
