"""Every single fault at random moments of lift, operation, stroke and landing, with the supervisor and without it.

What a sensor, a current reading, the link's reading or a bridge does wrong is done to what the exported C reads and
commands; missed steps, an open phase and a sagging link are faults of the simulated machine.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.machines.tubular.experiments.lifting import rest_on_bearing
from malta.machines.tubular.experiments.strokes import DISTANCE, RISE, delayed_stroke
from malta.model.equilibrium import trim
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
from malta.simulation.scenario import Fault, Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory, Verdict
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.firmware.supervised_flight import Flown, Interference, Requests

# As in commissioning.py, the exporter is imported where its C flies.

# Faults of sensors, samples, a phase and the DC link.


FAULT_TIME = 0.05  # s, when faults strike


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
    at, Ts = FAULT_TIME, controller.sample_time
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


# When and how fast the mover meets its touchdown bearings.


MAX_LANDING_SPEED = 0.05  # m/s: faster is a touchdown; a fall by 33 um, pulled by the magnets


def contacts_of(run: Trajectory, since: float = 0.0) -> tuple[NDArray[np.intp], FloatArray]:
    """Samples at which a touchdown bearing is met after `since`, s, and how fast, m/s.

    Every contact counts, also after a bounce, but that at the start; its speed is that of the sensor planes over the
    three samples before.
    """
    touching = np.atleast_1d((run.contact[:, np.array(run.plant.contacts.cushioned)] >= 1).any(axis=1))
    met = np.flatnonzero(touching[1:] & ~touching[:-1]) + 1
    met = met[run.t[met] >= since]
    others = [i for i in range(run.p.shape[1]) if i != run.plant.stroke_output]
    before = np.maximum(met - 3, 0)
    moved = np.abs(run.p[met][:, others] - run.p[before][:, others]).max(axis=1)
    return met, moved / (run.t[met] - run.t[before])


def contact_of(run: Trajectory, since: float = 0.0) -> tuple[float, float]:
    """When a touchdown bearing is met first after `since`, s, and how fast at worst, m/s; NaN where it is not."""
    met, speeds = contacts_of(run, since)
    if not len(met):
        return math.nan, math.nan
    return float(run.t[met[0]]), float(speeds.max())


Phase = Literal["lift", "operate", "stroke", "landing"]
# (begin and end of the moments at which faults strike, s; request to land, s; duration, s): a landing takes 0.21 s
PHASES: dict[Phase, tuple[float, float, float, float]] = {
    "lift": (0.020, 0.070, math.inf, 0.33),
    "operate": (0.005, 0.015, math.inf, 0.26),
    "stroke": (0.010, 0.070, math.inf, 0.32),
    "landing": (0.005, 0.205, 0.005, 0.26),
}
STROKE_CENTRE = 0.04  # s
MAX_MOMENTS = 1000  # moments of a class


class FaultKind(NamedTuple):
    """A class of faults: what it does to readings, requests and commands, or which faults of the simulation it is."""

    label: str
    change: Callable[[Blow, Any, Any], None] | None = None  # (blow, inputs, request): before a step
    command: Callable[[Blow, Any], None] | None = None  # (blow, outputs): after a step
    simulated: Callable[[Blow, Plant, float], tuple[Fault, ...]] | None = None


@dataclass
class Blow:
    """A fault at a moment."""

    kind: FaultKind
    phase: Phase
    at: float  # s
    sensor: int
    scale: float  # of errors of the sensor: the stroke's are ten times as large
    current: int
    sign: float
    rng: np.random.Generator
    held: float = math.nan


def change_reading(
    name: str, at: Literal["sensor", "current", ""], new: Callable[[Blow, Any], Any]
) -> Callable[[Blow, Any, Any], None]:
    """What a fault does to a reading: from (fault, old value) the new one; `at` is its place, "" for all."""

    def change(b: Blow, inputs: Any, _: Any) -> None:
        from malta.firmware.flight import view

        values, k = view(inputs, name), getattr(b, at) if at else slice(None)
        values[k] = new(b, values[k])

    return change


def freeze(b: Blow, value: float) -> float:
    """The value at the moment of the fault."""
    b.held = value if math.isnan(b.held) else b.held
    return b.held


def _cut_torque(_: Blow, __: Any, request: Any) -> None:
    if request is not None:
        request.sto = 1


def _stick_gates(b: Blow, outputs: Any) -> None:
    from malta.firmware.flight import view

    view(outputs, "command")[b.current] = 1.0 if b.sign > 0 else 0.0


def _open(b: Blow, plant: Plant, _: float) -> tuple[Fault, ...]:
    return (Fault("open phase", b.at, math.inf, plant.drive.phases[b.current].name),)


def _open_all(b: Blow, plant: Plant, _: float) -> tuple[Fault, ...]:
    return tuple(Fault("open phase", b.at, math.inf, phase.name) for phase in plant.drive.phases)


def _miss(b: Blow, _: Plant, Ts: float, steps: int) -> tuple[Fault, ...]:
    return (Fault("missed step", b.at - Ts / 4, b.at + (steps - 0.25) * Ts),)


def _shift(size: float) -> Callable[[Blow, Any, Any], None]:
    return change_reading("y", "sensor", lambda b, y: y + b.sign * b.scale * size)


KINDS: tuple[FaultKind, ...] = (
    FaultKind("sensor lost", change_reading("y", "sensor", lambda _, __: math.nan)),
    FaultKind("sensor stuck", change_reading("y", "sensor", freeze)),
    FaultKind("sensor biased by 20 um", _shift(20e-6)),
    FaultKind("sensor jumps by 200 um", _shift(200e-6)),
    FaultKind(
        "sensor noisier by 10 um",
        change_reading("y", "sensor", lambda b, y: y + b.scale * 10e-6 * b.rng.normal()),
    ),
    FaultKind("one current lost", change_reading("i_valid", "current", lambda _, __: 0.0)),
    FaultKind("all currents lost", change_reading("i", "", lambda _, __: math.nan)),
    FaultKind("one current frozen", change_reading("i", "current", freeze)),
    FaultKind("one current reads 70 %", change_reading("i", "current", lambda _, i: 0.7 * i)),
    FaultKind("link at 50 %", simulated=lambda b, _, __: (Fault("link sag", b.at, math.inf, size=0.5),)),
    FaultKind("link reads 130 %", change_reading("link", "", lambda _, link: 1.3 * link)),
    FaultKind("one phase open", simulated=_open),
    FaultKind("a half-bridge stuck", command=_stick_gates),
    FaultKind("safe torque off", _cut_torque, simulated=_open_all),
    FaultKind("1 step missed", simulated=partial(_miss, steps=1)),
    FaultKind("20 steps missed", simulated=partial(_miss, steps=20)),
)


class FaultOutcome(NamedTuple):
    """What came of a fault at a moment: a row of the experiment's curves."""

    phase: int  # index in PHASES
    at: float  # s
    speed_alone: float  # m/s, of the fastest contact with a touchdown bearing; 0: none
    speed: float  # m/s, the same with the supervisor
    current_alone: float  # A, largest of an axis from the fault on
    current: float
    phase_current: float  # A, largest of a phase, with the supervisor
    safe: float  # s, from the fault until it is off, landed or in a fault; NaN: it goes on
    monitor: int  # index in MONITORS of the last that acted, or -1


def fly_moments(
    plant: Plant,
    controller: Controller,
    moments: int,
    only: str,
    progress: Progress | None,
    options: Mapping[str, Any],
) -> Experiment:
    """Each class of faults at `moments` moments, spread over the phases of a flight; seeded by the option seed.

    only : "all", or a word in the labels of classes

    Raises InputError for another one, for less than one moment or more than MAX_MOMENTS, and for a fidelity without
    phases, whose currents could not be lost.
    """
    kinds = _choose_kinds(only, moments, options)
    healthy: dict[Phase, Flown] = {}
    rows: dict[str, list[FaultOutcome]] = {}
    worst: dict[str, Trajectory] = {}
    cut = False
    try:
        for n, (kind, blow) in enumerate(draw_blows(plant, kinds, moments, int(options.get("seed", 0)))):
            share = progress_of_part(progress, n, len(kinds) * moments)
            if blow.phase not in healthy:
                healthy[blow.phase] = _healthy(plant, controller, blow.phase, options)
            row, run = _strike(plant, controller, blow, healthy[blow.phase], options, share)
            found = rows.setdefault(kind.label, [])
            if all(row.speed >= other.speed for other in found):
                worst[kind.label] = run
            found.append(row)
    except KeyboardInterrupt:
        if not worst:
            raise
        cut = True
    cases = tuple(Case(label, run, _merits(rows[label])) for label, run in worst.items())
    curves = {label: np.array(found, dtype=float) for label, found in rows.items()}
    question = "How fast does it touch down, which currents flow, when is it off? (s): supervised"
    return Experiment("supervised-faults", question, cases, totals_of(curves), curves, interrupted=cut)


def _choose_kinds(only: str, moments: int, options: Mapping[str, Any]) -> list[FaultKind]:
    """The classes that are asked for."""
    if not isinstance(moments, int) or not 1 <= moments <= MAX_MOMENTS:
        raise InputError(
            "simulate", "supervised-faults: moments", repr(moments), f"a whole number, 1 to {MAX_MOMENTS}"
        )
    if options.get("fidelity", "phase") != "phase":
        asked = repr(options["fidelity"])
        raise InputError(
            "simulate", "supervised-faults: fidelity", asked, "phase, where it strikes at moments"
        )
    found = [kind for kind in KINDS if only in ("all", *kind.label.split())]
    if not found:
        words = " ".join(sorted({word for kind in KINDS for word in kind.label.split()}))
        raise InputError("simulate", "supervised-faults: only", repr(only), f"all, or one of {words}")
    return found


def draw_blows(
    plant: Plant, kinds: Sequence[FaultKind], moments: int, seed: int
) -> Iterator[tuple[FaultKind, Blow]]:
    """The faults of a campaign; those of a class do not depend on which others are flown, nor on how many."""
    for kind in kinds:
        rng = np.random.default_rng([seed, KINDS.index(kind)])
        for m in range(moments):
            yield kind, _draw_fault(kind, m, plant, rng)


def _draw_fault(kind: FaultKind, m: int, plant: Plant, rng: np.random.Generator) -> Blow:
    """A fault at a random moment of the phase whose turn it is."""
    phase = list(PHASES)[m % len(PHASES)]
    begin, end, _, _ = PHASES[phase]
    at, sensor = float(rng.uniform(begin, end)), int(rng.integers(len(plant.outputs)))
    current, sign = int(rng.integers(len(plant.drive.phases))), float(rng.choice([-1.0, 1.0]))
    scale = 10.0 if sensor == plant.stroke_output else 1.0
    noise = np.random.default_rng(int(rng.integers(2**32)))
    return Blow(kind, phase, at, sensor, scale, current, sign, noise)


def _interference(b: Blow) -> Interference:
    """What the fault does at each sample from its moment on."""
    from malta.firmware.supervised_flight import Interference

    def before(t: float, inputs: Any, request: Any) -> None:
        if request is not None:
            request.sto = 0
        if t >= b.at and b.kind.change is not None:
            b.kind.change(b, inputs, request)

    def after(t: float, outputs: Any) -> None:
        if t >= b.at and b.kind.command is not None:
            b.kind.command(b, outputs)

    return Interference(before, after)


def _scenario(plant: Plant, phase: Phase, faults: tuple[Fault, ...], options: Mapping[str, Any]) -> Scenario:
    """The flight of a phase, with the machine as built and its duty cycles."""
    duration = PHASES[phase][3]
    own: dict[str, Any] = {"bearing": True, "fidelity": "phase", "faults": faults} | dict(options)
    reference: Any = references.hold
    if phase == "lift":
        own |= {"start": rest_on_bearing(plant) | {plant.stroke.name: 0.0}, "cold": True}
    if phase == "stroke":
        reference = partial(
            references.stroke, start=-DISTANCE / 2, end=DISTANCE / 2, rise=RISE, centre=STROKE_CENTRE
        )
    return scenario_of("supervised-faults", duration, reference, own)


def _requests(plant: Plant, phase: Phase) -> Requests:
    """What is asked for in a phase."""
    from malta.firmware.supervised_flight import Requests

    if phase == "lift":
        return Requests()
    rest = outputs_at(plant, plant.at(**rest_on_bearing(plant)).x)
    return Requests(land=PHASES[phase][2], take_over=tuple(rest.tolist()))


def _healthy(plant: Plant, c: Controller, phase: Phase, options: Mapping[str, Any]) -> Flown:
    """The flight of a phase without a fault."""
    from malta.firmware.supervised_flight import supervised_engine

    flights: list[Flown] = []
    engine = supervised_engine(flights, _requests(plant, phase))
    _fly(plant, c, _scenario(plant, phase, (), options), engine, None)
    return flights[0]


def _fly(
    plant: Plant, c: Controller, scenario: Scenario, engine: Any, progress: Progress | None
) -> Trajectory:
    """A flight to its end. Raises KeyboardInterrupt where Ctrl-C ended it before."""
    run = simulate(plant, c, scenario, engine=engine, progress=progress)
    if run.verdict.name == "interrupted":
        raise KeyboardInterrupt
    return run


def _strike(
    plant: Plant,
    c: Controller,
    b: Blow,
    healthy: Flown,
    options: Mapping[str, Any],
    progress: Progress | None,
) -> tuple[FaultOutcome, Trajectory]:
    """A fault with the supervisor and without it: what came of both, and the supervised run."""
    from malta.firmware.supervised_flight import supervised_engine, unsupervised_engine
    from malta.firmware.supervisor_text import NUMBERS

    simulated = () if b.kind.simulated is None else b.kind.simulated(b, plant, c.sample_time)
    scenario = _scenario(plant, b.phase, simulated, options)
    flights: list[Flown] = []
    runs = []
    for n, supervised in enumerate((False, True)):
        faults = _interference(replace(b, rng=copy.deepcopy(b.rng)))  # the same noise twice
        engine = (
            supervised_engine(flights, _requests(plant, b.phase), faults=faults)
            if supervised
            else unsupervised_engine(healthy, faults)
        )
        runs.append(_fly(plant, c, scenario, engine, progress_of_part(progress, n, 2)))
    ended = [NUMBERS["OFF"], NUMBERS["FAULT"]]
    t, states = np.array(flights[0].t), np.array(flights[0].state)
    off = t[np.isin(states, ended) & (t >= b.at)]
    speed_alone, speed = (float(np.nan_to_num(contact_of(run, b.at)[1])) for run in runs)
    current_alone, current = (float(np.abs(run.i[run.t >= b.at]).max(initial=0.0)) for run in runs)
    end = replace(runs[1], verdict=Verdict("completed", float(runs[1].t[-1])))  # a contact is a figure
    outcome = FaultOutcome(
        phase=list(PHASES).index(b.phase),
        at=b.at,
        speed_alone=speed_alone,
        speed=speed,
        current_alone=current_alone,
        current=current,
        phase_current=float(np.abs(end.i_phase[end.t >= b.at]).max(initial=0.0)),
        safe=float(off[0]) - b.at if len(off) else math.nan,
        monitor=_last_monitor(flights[0], b.at),
    )
    return outcome, end


def _last_monitor(flown: Flown, since: float) -> int:
    """The last monitor that acted after a time, or -1: none, or one that had acted before."""
    before = [monitor for t, monitor in zip(flown.t, flown.monitor, strict=True) if t < since]
    last = flown.monitor[-1]
    return -1 if before and last == before[-1] else last


def _merits(rows: Sequence[FaultOutcome]) -> tuple[Merit, ...]:
    """The worst of a class."""
    off = [row.safe for row in rows if not math.isnan(row.safe)]
    return (
        Merit("contact", max(row.speed_alone for row in rows), "mm/s", key="contact_speed_alone"),
        Merit("contact (s)", max(row.speed for row in rows), "mm/s", key="contact_speed_supervised"),
        Merit("current", max(row.current_alone for row in rows), "A", key="current_alone"),
        Merit("current (s)", max(row.current for row in rows), "A", key="current_supervised"),
        Merit("off (s)", max(off, default=math.nan), "ms", key="off_after"),
    )


def totals_of(curves: Mapping[str, FloatArray]) -> tuple[Merit, ...]:
    """Of all classes together."""
    rows = [FaultOutcome(*row) for found in curves.values() for row in found]
    alone, supervised = (
        float(sum(speed > MAX_LANDING_SPEED for speed in speeds))
        for speeds in ([row.speed_alone for row in rows], [row.speed for row in rows])
    )
    return (
        Merit("moments", float(len(rows)), "1"),
        Merit("touchdowns alone", alone, "1"),
        Merit("touchdowns with supervisor", supervised, "1"),
        Merit("fastest contact alone", max(row.speed_alone for row in rows), "mm/s"),
        Merit("fastest contact with supervisor", max(row.speed for row in rows), "mm/s"),
        Merit("largest current of an axis alone", max(row.current_alone for row in rows), "A"),
        Merit("largest current of an axis with supervisor", max(row.current for row in rows), "A"),
        Merit("largest current of a phase with supervisor", max(row.phase_current for row in rows), "A"),
    )
