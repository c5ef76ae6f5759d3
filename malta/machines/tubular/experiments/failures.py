"""Faults of sensors, samples, a phase and the DC link."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.machines.tubular.experiments.strokes import RISE, delayed_stroke
from malta.model.equilibrium import trim
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    scenario_of,
)
from malta.simulation.scenario import Fault
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

AT = 0.05  # s, when faults strike


def faults(
    plant: Plant,
    controller: Controller,
    *,
    during: str = "stroke",
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Each fault strikes where the published stroke accelerates most, or during a hold. Touchdown bearings catch the
    mover; 0.25 s are left."""
    wanted = planned_faults("faults", plant, controller, during, options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    survived = float(sum(case.run.verdict.completed for case in cases))
    merit = Merit(f"survived, of {len(cases)}", survived, "1", key="survived", better="high")
    return Experiment("faults", "What does it survive?", cases, (merit,), interrupted=cut)


def planned_faults(
    name: str,
    plant: Plant,
    controller: Controller,
    during: str,
    options: Mapping[str, Any],
    duration: float = 0.3,
) -> list[PlannedRun]:
    """The runs of an experiment `name` on faults that strike at AT. Raises InputError for another word than stroke or
    hold."""
    if during not in ("stroke", "hold"):
        raise InputError("simulate", f"{name}: during", repr(during), "stroke or hold")
    at, Ts = AT, controller.sample_time
    eps = Ts / 4  # faults begin and end between samples
    # A logistic of slope k = 2 ln 9 / rise has its largest acceleration ln(2 + sqrt 3) / k before its middle.
    early = math.log(2 + math.sqrt(3)) * RISE / (2 * math.log(9))
    reference = partial(delayed_stroke, wait=at + early - 0.05) if during == "stroke" else references.hold
    sensor = plant.outputs[1].name
    phase = plant.drive.phases[_most_loaded(plant)].name
    listed: dict[str, tuple[Fault, ...]] = {
        "one sample lost": (Fault("lost sample", at - eps, at + Ts - eps),),
        "10 samples lost": (Fault("lost sample", at - eps, at + 10 * Ts - eps),),
        "50 samples lost": (Fault("lost sample", at - eps, at + 50 * Ts - eps),),
        "one control step missed": (Fault("missed step", at - eps, at + Ts - eps),),
        "10 control steps missed": (Fault("missed step", at - eps, at + 10 * Ts - eps),),
        "50 control steps missed": (Fault("missed step", at - eps, at + 50 * Ts - eps),),
        f"{sensor} stuck for 5 ms": (Fault("stuck sensor", at, at + 5e-3, sensor),),
        f"{sensor} stuck": (Fault("stuck sensor", at, math.inf, sensor),),
        f"{sensor} biased by 50 um": (Fault("biased sensor", at, math.inf, sensor, 50e-6),),
        "noise of all sensors x 10": tuple(
            Fault("noisy sensor", at, math.inf, s.name, 10.0) for s in plant.outputs
        ),
        f"phase {phase.removeprefix('i_')} open": (Fault("open phase", at, math.inf, phase),),
        "DC link sags by 50 % for 50 ms": (Fault("link sag", at, at + 50e-3, size=0.5),),
        "DC link sags by 90 % for 50 ms": (Fault("link sag", at, at + 50e-3, size=0.9),),
    }
    wanted = []
    for label, struck in listed.items():
        own: dict[str, Any] = {"faults": struck, "bearing": True} | dict(options)
        if any(fault.kind == "open phase" for fault in struck):
            own["fidelity"] = "phase"
        scenario = scenario_of(name, duration, reference, own)
        wanted.append(PlannedRun(label, scenario, partial(_fault_merits, at=at)))
    return wanted


def _most_loaded(plant: Plant) -> int:
    """The phase with the largest current at the middle of the travel, where the bearings carry the weight."""
    held = ca.DM(trim(plant).u / np.array(plant.actuator.force_constant))
    i = np.array(ca.DM(plant.drive.to_phases(ca.DM(plant.at().x)) @ plant.drive.command(held))).ravel()
    return int(np.abs(i).argmax())


def _fault_merits(run: Trajectory, at: float) -> tuple[Merit, ...]:
    """Deviation after a fault, the time to a touchdown, and the deviation at the end."""
    others = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
    radial = np.abs(run.p[run.t >= min(at, run.t[-1])][:, others])
    after = run.verdict.time - at
    touched = after if after >= 0 and not run.verdict.completed else math.nan
    return (
        Merit("largest deviation", float(radial.max()), "um"),
        Merit("touchdown after", touched, "ms"),
        Merit("deviation at the end", float(radial[-1].max()), "um"),
    )
