"""MALTA under its supervisor, the exported C: commissioning, and faults with and without it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.machines.tubular.experiments.faults import (
    FAULT_TIME,
    MAX_LANDING_SPEED,
    contact_of,
    contacts_of,
    fly_moments,
    planned_faults,
)
from malta.machines.tubular.experiments.lifting import rest_on_bearing
from malta.machines.tubular.experiments.strokes import DISTANCE, RISE
from malta.model.places import outputs_at
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    Case,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    progress_of_part,
    scenario_of,
)
from malta.simulation.trajectory import Trajectory, Verdict
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.firmware.supervised_flight import Flown
    from malta.firmware.supervisor import State

# The exporter is imported where these experiments fly: all others do without it.

STROKE, LAND, END = 0.4, 0.5, 0.75  # s: middle of the stroke, request to land, end
FAULT_RUN_TIME = 0.4  # s, of a run with a fault: room for a landing
SUFFIX = " (s)"  # in the label of a run with the supervisor


def commissioning(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = DISTANCE,
    rise: float = RISE,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """From rest on the touchdown bearing: offsets, sensors, lift-off, settling, a stroke in operation, landing, off.

    The exported C of controller and supervisor fly it, and a C compiler has to be there.
    """
    from malta.firmware.supervised_flight import Requests, supervised_engine

    _require_own_engine("commissioning", options)
    own = {"start": rest_on_bearing(plant) | {plant.stroke.name: 0.0}, "cold": True, "bearing": True}
    reference = partial(references.stroke, start=-distance / 2, end=distance / 2, rise=rise, centre=STROKE)
    scenario = scenario_of("commissioning", END, reference, own | options)
    flights: list[Flown] = []
    engine = supervised_engine(flights, Requests(land=LAND))
    planned = [PlannedRun("commissioning", scenario, lambda _: ())]
    (case,), cut = fly(plant, controller, planned, progress, options | {"engine": engine})
    run = _judge(case.run, flights[0], from_rest=True)
    case = Case("commissioning", run, _commissioning_merits(run, flights[0]))
    states = flights[0].states(run.t).astype(float)
    curves = {"state": states, "followed": flights[0].references(run.t)}
    question = "Does it start, work and land by itself?"
    return Experiment("commissioning", question, (case,), case.merits, curves, interrupted=cut)


def supervised_faults(
    plant: Plant,
    controller: Controller,
    *,
    during: str = "stroke",
    only: str = "all",
    moments: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The faults of `faults`, each with the supervisor and without it; `only`: those with this word in their names.

    A supervised run has no touchdown where it stays off its bearings, or meets them at the end of a landing, slowly.

    moments : in place of those faults, all classes of faults.py, each at so many random moments of lift,
        operation, stroke and landing
    """
    from malta.firmware.supervised_flight import Requests, supervised_engine

    _require_own_engine("supervised-faults", options)
    if moments:
        if during != "stroke":
            found = f"{during!r} and {moments} moments"
            raise InputError(
                "simulate", "supervised-faults: during", found, "all phases of a flight: without it"
            )
        return fly_moments(plant, controller, moments, only, progress, options)
    wanted = planned_faults("supervised-faults", plant, controller, during, options, FAULT_RUN_TIME)
    chosen = [one for one in wanted if only in ("all", *one.label.split())]
    if not chosen:
        words = " ".join(sorted({word for one in wanted for word in one.label.split()}))
        raise InputError("simulate", "supervised-faults: only", repr(only), f"all, or one of {words}")
    rest = tuple(outputs_at(plant, plant.at(**rest_on_bearing(plant)).x).tolist())
    flights: list[Flown] = []
    engines: dict[str, Any] = {"": "auto", SUFFIX: supervised_engine(flights, Requests(take_over=rest))}
    cases: list[Case] = []
    curves: dict[str, FloatArray] = {}
    cut = False
    for n, one in enumerate(chosen):
        for k, (who, engine) in enumerate(engines.items()):
            share = progress_of_part(progress, 2 * n + k, 2 * len(chosen))
            (case,), cut = fly(plant, controller, [one], share, options | {"engine": engine})
            run, label = case.run, one.label + who
            if who == SUFFIX:
                run = _judge(run, flights[-1], from_rest=False)
                curves[one.label] = flights[-1].states(run.t).astype(float)
            cases.append(Case(label, run, _fault_merits(run)))
            if cut:
                break
        if cut:
            break
    return Experiment(
        "supervised-faults",
        "Which touchdowns does the supervisor (s) prevent?",
        tuple(cases),
        _counts(cases),
        curves,
        interrupted=cut,
    )


def _require_own_engine(name: str, options: Mapping[str, Any]) -> None:
    """InputError without a C compiler, and for another engine than the exported C."""
    from malta.firmware.supervised_flight import require_compiler

    require_compiler(name)
    engine = options.get("engine", "auto")
    if callable(engine) or engine == "virtual machine":
        found = "the exported C" if callable(engine) else repr(engine)
        raise InputError("simulate", f"{name}: engine", found, "auto: the C flies, with its supervisor")


def _judge(run: Trajectory, flown: Flown, *, from_rest: bool) -> Trajectory:
    """The run with the verdict of a supervised flight: slow contact in a lift-off or at a landing's end is none."""
    from malta.firmware.supervisor import IN_FLIGHT
    from malta.firmware.supervisor_text import NUMBERS

    if run.verdict.name in ("interrupted", "diverged", run.plant.contacts.names[-1]):
        return run
    states = flown.states(run.t)
    if from_rest and not (states == NUMBERS["OPERATE"]).any():
        return replace(run, verdict=Verdict("not lifted", float(run.t[-1])))
    flying = np.isin(states, [NUMBERS[state] for state in IN_FLIGHT if state != "LIFT"])
    met, speeds = contacts_of(run)
    low = np.isin(states[met], [NUMBERS[state] for state in ("LIFT", "LANDING", "OFF")])
    hard = met[~low | (speeds > MAX_LANDING_SPEED)]
    if not len(hard) or not flying.any():
        return replace(run, verdict=Verdict("completed", run.scenario.duration))
    k = hard[0]
    shares = run.contact[k, : len(run.plant.contacts.names)]
    return replace(run, verdict=Verdict(run.plant.contacts.names[int(shares.argmax())], float(run.t[k])))


def _commissioning_merits(run: Trajectory, flown: Flown) -> tuple[Merit, ...]:
    """Times of the states, errors in flight, the largest jump of a command, and the speed at the end of the landing."""
    from malta.firmware.supervisor import IN_FLIGHT
    from malta.firmware.supervisor_text import NUMBERS

    states, followed = flown.states(run.t), flown.references(run.t)
    others = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
    error = np.abs(run.p - followed)
    ready = np.isin(states, [NUMBERS["SETTLE"], NUMBERS["OPERATE"]])
    lifting = states == NUMBERS["LIFT"]

    def begin(state: State) -> float:
        at = np.flatnonzero(states == NUMBERS[state])
        return float(run.t[at[0]]) if len(at) else math.nan

    flying = np.isin(states, [NUMBERS[state] for state in IN_FLIGHT])
    changed = np.flatnonzero(flying[1:] & flying[:-1] & (states[1:] != states[:-1])) + 1
    v = run.v
    jumps = np.abs(v[changed] - v[changed - 1]).max(initial=0.0)
    off = np.flatnonzero((states == NUMBERS["OFF"]) & (run.t > begin("OPERATE")))
    return (
        Merit("lift-off after", begin("LIFT"), "ms"),
        Merit("in operation after", begin("OPERATE"), "ms"),
        Merit("off its reference, lift-off", float(error[lifting][:, others].max(initial=0.0)), "um"),
        Merit(
            "off its reference, at zero and in operation",
            float(error[ready][:, others].max(initial=0.0)),
            "um",
        ),
        Merit("largest jump of a force between states in flight", float(jumps), "N"),
        Merit("meets its bearing in the landing at", contact_of(run)[1], "mm/s"),
        Merit("off after", float(run.t[off[0]]) if len(off) else math.nan, "ms"),
    )


def _fault_merits(run: Trajectory) -> tuple[Merit, ...]:
    """The largest deviation after a fault, and when and how fast a bearing is met."""
    others = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
    at, speed = contact_of(run)
    return (
        Merit(
            "largest deviation", float(np.abs(run.p[run.t >= FAULT_TIME][:, others]).max(initial=0.0)), "um"
        ),
        Merit("contact after", at - FAULT_TIME, "ms"),
        Merit("its speed", speed, "mm/s", key="contact_speed", better=""),
    )


def _counts(cases: list[Case]) -> tuple[Merit, ...]:
    """Touchdowns without and with the supervisor, and landings."""
    supervised = [case for case in cases if case.label.endswith(SUFFIX)]
    alone = [case for case in cases if not case.label.endswith(SUFFIX)]
    down, still = (float(sum(not c.run.verdict.completed for c in part)) for part in (alone, supervised))
    landed = sum(case.run.verdict.completed and case.merits[2].value >= 0 for case in supervised)
    return (
        Merit(f"touchdowns alone, of {len(alone)}", down, "1", key="touchdowns_alone"),
        Merit(
            f"touchdowns with supervisor, of {len(supervised)}", still, "1", key="touchdowns_with_supervisor"
        ),
        Merit("slow landings with supervisor", float(landed), "1", better="high"),
    )
