"""The experiments on the Halbach linear motor.

step     100 um there and back, with every source of error, Fig. 9
stairs   steps of 10 um: open loop and position control, plain and high-resolution PWM, Fig. 7
ramp     50 mm at constant speed, Fig. 8
force    the vertical force of a move of 5 mm under three control laws, Fig. 10, and what faults make of it
budget   the error of a motor at rest by source, Sec. 5.1
identify the step of 2 mm in the open loop that mass and friction were found from, Sec. 2.3

Electronics run period by period at fidelity "phase", which is the default; many machines fly at fidelity "force".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.machines.halbach import plant as halbach
from malta.machines.halbach.plant import (
    IDEAL,
    MEAN_OF,
    Options,
    Pwm,
)
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import (
    QUIET,
    REAL,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    fly_all,
    rms,
    scenario_of,
)
from malta.simulation.references import Motion, Reference
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.riccati import sample

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

STEP, COUNT = 100e-6, 20  # m, Fig. 9
BEFORE, PAUSE, REST = 5, 40, 400  # readings before the steps, between them, after the last


def step(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = STEP,
    rise: float = 0.3,
    count: int = COUNT,
    pwm: Pwm = "plain",
    adc_noise: bool = True,
    adc_steps: bool = True,
    mean_of: int = MEAN_OF,
    current_loops: bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Steps there and back, `count` of them, then 22 s of rest: as jumps, and as quintics with a rise of `rise` (s)."""
    parts = _electronics(pwm, adc_noise, adc_steps, mean_of, current_loops)
    wanted = _step_wanted(
        controller, distance, rise, count, {"fidelity": "phase", "electronics": parts} | options
    )
    cases, cut = fly(plant, controller, wanted, progress, options)
    return Experiment("step", "Does it go where it is sent, and stay?", cases, (), interrupted=cut)


def _step_cases(
    _: Plant, controller: Controller, *, distance: float, rise: float, count: int, **options: Any
) -> list[PlannedRun]:
    return _step_wanted(controller, distance, rise, count, _many(options))


def _step_wanted(
    controller: Controller, distance: float, rise: float, count: int, options: Mapping[str, Any]
) -> list[PlannedRun]:
    Ts = controller.sample_time
    wanted = []
    for label, taken in (("jumps", 0.0), ("quintics", rise)):
        reference = partial(there_and_back, distance=distance, rise=taken, count=count, Ts=Ts)
        scenario = scenario_of("step", (BEFORE + PAUSE * count + REST) * Ts, reference, options)
        wanted.append(PlannedRun(label, scenario, partial(_step_merits, distance=distance, count=count)))
    return wanted


def there_and_back(_: Plant, distance: float, rise: float, count: int, Ts: float) -> Reference:
    """So many steps of `distance` (m) from 0 and back, with a rise of `rise` (s); 0: they jump at readings."""
    begin = (BEFORE + PAUSE * np.arange(count)) * Ts

    def at(t: FloatArray) -> Motion:
        later = np.asarray(t)[:, None] - begin
        signs = distance * (-1.0) ** np.arange(count)
        if not rise:
            jumped = (later > -Ts / 2) @ signs
            return Motion(*(column[:, None] for column in (jumped, 0 * jumped, 0 * jumped)))
        middle = references.QUINTIC_DURATION * rise / 2
        return Motion(*(s @ signs[:, None] for s in references.quintic(later - middle, rise)))

    return at


def responses(run: Trajectory, distance: float, count: int) -> FloatArray:
    """count x readings: each step of `there_and_back` as a share of its distance, all upwards; NaN where it ended."""
    wanted = BEFORE + PAUSE * count
    x = np.full(wanted, np.nan)
    x[: min(wanted, len(run.p))] = run.p[:wanted, 0]
    shares = x[BEFORE:].reshape(count, PAUSE) / distance
    shares[1::2] = 1 - shares[1::2]
    return shares


def _step_merits(run: Trajectory, distance: float, count: int) -> tuple[Merit, ...]:
    mean, Ts = responses(run, distance, count).mean(axis=0), run.controller.sample_time
    outside = np.flatnonzero(~(np.abs(mean - 1) <= 0.05))
    settled = math.nan
    if 0 < len(outside) < PAUSE and outside[-1] + 1 < PAUSE:
        k = int(outside[-1])
        edge = 1 + math.copysign(0.05, mean[k] - 1)
        settled = (k + float((mean[k] - edge) / (mean[k] - mean[k + 1]))) * Ts
    tail = (run.p - run.reference)[BEFORE + PAUSE * count - PAUSE // 2 :, 0]
    if len(tail) == 0:
        tail = np.array([math.nan])
    return (
        Merit("mean overshoot", max(float(mean.max()) - 1, 0.0), "percent"),
        Merit("mean within 5 % after", settled, "ms"),
        Merit("at rest, rms", float(tail.std()), "um"),
        Merit("at rest, mean error", abs(float(tail.mean())), "um"),
        Merit("vertical force off by", _off(run), "percent"),
    )


def _off(run: Trajectory) -> float:
    """Largest deviation of the vertical force from what is commanded, as a share."""
    F_z = wanted_lift(run)
    return float(np.abs(lift_of(run) / F_z - 1).max()) if F_z else math.nan


def wanted_lift(run: Trajectory) -> float:
    """The vertical force that the controller commutates for, N."""
    believed: Any = run.controller.parameters
    return float(believed.F_z)


def lift_of(run: Trajectory) -> FloatArray:
    """The vertical force, N; at fidelity force that of the commanded currents."""
    par: Any = run.plant.parameters
    return halbach.lift(par, run.x[:, 0], run.i_phase if run.i_phase.size else run.current)


def _electronics(
    pwm: Pwm, adc_noise: bool, adc_steps: bool, mean_of: int, current_loops: bool
) -> Options | None:
    """The paper's own need not be named, which leaves fidelity force open."""
    found = Options(pwm, adc_steps, adc_noise, mean_of, current_loops)
    return None if found == halbach.REAL else found


def _many(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a scenario that many machines fly: without electronics, unless something of theirs is asked for."""
    given = dict(options)
    own = [given.pop(name) for name in ("pwm", "adc_noise", "adc_steps", "mean_of", "current_loops")]
    return {"fidelity": "force", "electronics": _electronics(*own)} | given


# Fig. 7

PWMS: Mapping[Pwm, str] = {"plain": "plain PWM", "fine": "high-resolution PWM"}
STAIR, LEVELS, STAY = 10e-6, 5, 100  # m; stairs, and readings on each


def stairs(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = STAIR,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Steps of 10 um, 5.5 s each: open loop and position control, with plain and with high-resolution PWM."""
    Ts = controller.sample_time
    reference = partial(climb, distance=distance, Ts=Ts)
    merits = partial(_stairs_merits, distance=distance)
    wanted = []
    for law in ("open loop", "position control"):
        for pwm, name in PWMS.items():
            parts = replace(IDEAL, pwm=pwm, current_loops=False)
            own = {"fidelity": "phase", "electronics": parts, "open_loop": law == "open loop"}
            scenario = scenario_of("stairs", LEVELS * STAY * Ts, reference, QUIET | own | options)
            wanted.append(PlannedRun(f"{law}, {name}", scenario, merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    believed: Any = controller.parameters
    printed = {"plain": "smallest_motion", "fine": "smallest_motion_fine"}
    found = []
    for pwm, name in PWMS.items():
        longest = float(halbach.dead_zones(believed, believed.F_z, pwm)[1].max())
        found.append(Merit(f"longest dead zone, {name}", longest, "um", f"open_loop.{printed[pwm]}"))
    return Experiment("stairs", "How small a motion can it make?", cases, tuple(found), interrupted=cut)


def climb(_: Plant, distance: float, Ts: float) -> Reference:
    """A step of `distance` (m) every STAY readings."""

    def at(t: FloatArray) -> Motion:
        p = distance * np.minimum(np.floor(np.asarray(t) / (STAY * Ts) + 1e-6), LEVELS - 1)[:, None]
        return Motion(p, 0 * p, 0 * p)

    return at


def places(run: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Where it stands on each stair, m, and how far it swings about there: mean and peak to peak of the last second."""
    x = np.full(LEVELS * STAY, np.nan)
    x[: len(run.p)] = run.p[:, 0]
    late = x.reshape(LEVELS, STAY)[:, -STAY // 5 :]
    return late.mean(axis=1), np.ptp(late, axis=1)


def _stairs_merits(run: Trajectory, distance: float) -> tuple[Merit, ...]:
    stands, swings = places(run)
    return (
        Merit("smallest stair", float(np.diff(stands).min()), "um"),
        Merit("largest stair", float(np.diff(stands).max()), "um"),
        Merit("off its stair by", float(np.abs(stands - distance * np.arange(LEVELS)).max()), "um"),
        Merit("swing, peak to peak", float(swings.max()), "um"),
    )


# Fig. 8

STILL, SETTLING = 20, 2.0  # readings before and after the ramp; s, which a start at full speed takes


def ramp(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = 50e-3,
    speeds: tuple[float, ...] = (1e-3, 2e-3, 5e-3),
    pwm: Pwm = "plain",
    adc_noise: bool = True,
    adc_steps: bool = True,
    mean_of: int = MEAN_OF,
    current_loops: bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Through the travel, half of `distance` to either side of the middle, at each of the speeds (m/s)."""
    parts = _electronics(pwm, adc_noise, adc_steps, mean_of, current_loops)
    wanted = _ramp_wanted(controller, distance, speeds, {"fidelity": "phase", "electronics": parts} | options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    return Experiment("ramp", "Does it follow through the whole travel?", cases, (), interrupted=cut)


def _ramp_cases(
    _: Plant, controller: Controller, *, distance: float, speeds: tuple[float, ...], **options: Any
) -> list[PlannedRun]:
    return _ramp_wanted(controller, distance, speeds, _many(options))


def _ramp_wanted(
    controller: Controller, distance: float, speeds: tuple[float, ...], options: Mapping[str, Any]
) -> list[PlannedRun]:
    still, wanted = STILL * controller.sample_time, []
    for speed in speeds:
        moving = abs(distance) / speed
        reference = partial(pass_through, distance=distance, speed=speed, start=still)
        scenario = scenario_of("ramp", moving + 2 * still, reference, options)
        merits = partial(_ramp_merits, start=still, moving=moving)
        wanted.append(PlannedRun(f"{1e3 * speed:g} mm/s", scenario, merits))
    return wanted


def pass_through(plant: Plant, distance: float, speed: float, start: float) -> Reference:
    """From -distance / 2 (m) to the other side at a constant speed (m/s) from `start` (s) on."""
    if not abs(distance) / 2 <= plant.travel:
        found, most = f"{distance:g} m", f"at most {2 * plant.travel:g} m, the travel to both sides"
        raise InputError("halbach", "ramp: distance", found, most)

    def at(t: FloatArray) -> Motion:
        passed = np.clip((np.asarray(t) - start) * speed / abs(distance), 0, 1)[:, None]
        moving = (passed > 0) & (passed < 1)
        return Motion(
            distance * (passed - 0.5), math.copysign(speed, distance) * moving, np.zeros(passed.shape)
        )

    return at


def _ramp_merits(run: Trajectory, start: float, moving: float) -> tuple[Merit, ...]:
    error = (run.reference - run.p)[:, 0]
    steady = (run.t > start + SETTLING) & (run.t < start + moving)
    lag = abs(float(error[steady].mean())) if steady.any() else math.nan
    return (
        Merit("mean lag", lag, "um"),
        Merit("error on the way, rms", rms(error[steady]) if steady.any() else math.nan, "um"),
        Merit("largest error", float(np.abs(error).max()), "um"),
        Merit("vertical force off by", _off(run), "percent"),
    )


# Fig. 10

MOVE = 5e-3  # m
CALM, AFTER = 100, 120  # readings before a move, and from its begin to the end
FASTER = 50  # rows in a sample of a loop that is open, and does not wait for the laser
FAULTS: Mapping[
    str, Mapping[str, float]
] = {  # what might explain the paper's figures: parameters, errors, a force (N)
    "sound": {},
    "windings x 0.9, 0.9, 1.25": {"r_a": 0.9, "r_b": 0.9, "r_c": 1.25},
    "magnets of a phase x 0.8": {"a_a": 0.8},
    "angle off by 0.2 rad": {"angle": 0.2},
    "pushed by 1 N": {"push": 1.0},
}
LAWS: Mapping[str, tuple[bool, bool]] = {  # feedback of the position, of the currents
    "open loop": (False, False),
    "position control": (True, False),
    "vector control": (True, True),
}
PRINTED = dict(zip(LAWS, ("open_loop", "position_controller", "vector_control"), strict=True))  # figure_10


def force(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = MOVE,
    rise: float = 0.3,
    pwm: Pwm = "fine",
    adc_noise: bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The vertical force of a move: open loop, position control without current loops, vector control; with faults.

    In the open loop the reference jumps; with feedback it is a quintic with a rise of `rise` (s).
    """
    own = {"electronics": Options(pwm, adc_noise=adc_noise)} | options
    flights = [_move(plant, controller, fault, law, distance, rise, own) for fault in FAULTS for law in LAWS]
    cases, cut = fly_all(flights, progress, options)
    return Experiment("force", "Does a move disturb the vertical force?", cases, (), interrupted=cut)


def _move(
    plant: Plant,
    controller: Controller,
    fault: str,
    law: str,
    distance: float,
    rise: float,
    options: Mapping[str, Any],
) -> tuple[Plant, Controller, PlannedRun]:
    """The machine, what commands it and what is asked: nothing waits for the laser where nothing is fed back."""
    par: Any = plant.parameters
    (position, vector), faulty = LAWS[law], dict(FAULTS[fault])
    angle, push = faulty.pop("angle", 0.0), faulty.pop("push", 0.0)
    machine = plant.variant(replace(par, **faulty)) if faulty else plant
    begin, end = CALM * controller.sample_time, (CALM + AFTER) * controller.sample_time
    own: dict[str, Any] = {"fidelity": "phase"} | dict(options)
    own["electronics"] = replace(own["electronics"] or halbach.REAL, current_loops=vector)
    if not position:
        controller = replace(controller, sample_time=controller.sample_time / FASTER)
        own |= {"open_loop": True, "delay": 0}
    if angle and position:  # the open loop knows no angle but the reference's
        own["sensor_errors"] = {"offset_x": angle / par.k}
    if push:
        own["disturbance"] = partial(pushed, size=push)
    reference = partial(move, distance=distance, rise=rise if position else 0.0, begin=begin)
    printed = f"figure_10.{PRINTED[law]}" if fault == "sound" and distance == MOVE else ""
    merits = partial(_move_merits, begin=begin, printed=printed)
    label = law if fault == "sound" else f"{law}, {fault}"
    return machine, controller, PlannedRun(label, scenario_of("force", end, reference, own), merits)


def move(_: Plant, distance: float, rise: float, begin: float) -> Reference:
    """From 0 to `distance` (m), beginning at `begin` (s): a quintic with a rise of `rise` (s); 0: it jumps."""

    def at(t: FloatArray) -> Motion:
        later = np.asarray(t) - begin
        if not rise:
            p = np.where(later > -1e-9, distance, 0.0)[:, None]
            return Motion(p, 0 * p, 0 * p)
        middle = references.QUINTIC_DURATION * rise / 2
        return Motion(*(distance * s[:, None] for s in references.quintic(later - middle, rise)))

    return at


def pushed(t: FloatArray, size: float) -> FloatArray:
    """A constant force, N."""
    return np.full((len(t), 1), size)


def _move_merits(run: Trajectory, begin: float, printed: str) -> tuple[Merit, ...]:
    """Changes of the vertical force, as shares of what it was in the second before the move."""
    F, later = lift_of(run), run.t > begin
    earlier, late = (run.t > begin - 1) & ~later, run.t > run.scenario.duration - 1
    if not late.any():  # it ended before
        steady = lowest = highest = moved = math.nan
    else:
        shares = F / F[earlier].mean() - 1
        steady, lowest, highest = (
            float(shares[late].mean()),
            float(shares[later].min()),
            float(shares[later].max()),
        )
        moved = float(run.p[late, 0].mean() - run.p[earlier, 0].mean())
    return (
        Merit("steady change", steady, "percent", printed),
        Merit("lowest", lowest, "percent"),
        Merit("highest", highest, "percent"),
        Merit("moved", moved, "mm"),
    )


# Sec. 5.1

SOURCES: Mapping[str, tuple[Options, dict[str, Any]]] = {
    "laser": (IDEAL, REAL),
    "current noise": (replace(IDEAL, adc_noise=True), QUIET),
    "current steps": (replace(IDEAL, adc_steps=True), QUIET),
    "PWM": (replace(IDEAL, pwm="plain"), QUIET),
    "all": (halbach.REAL, REAL),
    "all, fine PWM": (replace(halbach.REAL, pwm="fine"), REAL),
}
LASTING, FIRST = 500, 40  # readings; from which they count
ALONG = 7  # places of half a pitch at which current noise alone is looked at


def budget(
    plant: Plant,
    controller: Controller,
    *,
    place: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Rest at `place` (m) with each source of error alone, and with all; current noise along half a pitch."""
    believed: Any = controller.parameters
    spots = np.linspace(0, math.pi / believed.k, ALONG)
    asked = [(name, *source, place) for name, source in SOURCES.items()]
    asked += [(f"current noise at {1e3 * x:.1f} mm", *SOURCES["current noise"], float(x)) for x in spots]
    wanted = []
    for label, parts, sensors, x in asked:
        own = {"fidelity": "phase", "electronics": parts} | sensors
        reference = partial(references.hold, x=x)
        scenario = scenario_of("budget", LASTING * controller.sample_time, reference, own | options)
        wanted.append(PlannedRun(label, scenario, _rest_merits))
    flown, cut = fly(plant, controller, wanted, progress, options)
    shown, along = flown[: len(SOURCES)], flown[len(SOURCES) :]
    found = np.array([case.merits[0].value for case in along])
    ends = (("best", found.min(initial=math.inf)), ("worst", found.max(initial=0.0))) if len(found) else ()
    merits = tuple(Merit(f"current noise, at the {end} place", float(value), "um") for end, value in ends)
    curves = {"place": spots[: len(found)], "rms": found}
    return Experiment("budget", "What keeps it from standing still?", shown, merits, curves, interrupted=cut)


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    error = (run.p - run.reference)[FIRST:, 0]
    if len(error) == 0:
        error = np.array([math.nan])
    return (
        Merit("position, rms", float(error.std()), "um"),
        Merit("mean error", abs(float(error.mean())), "um"),
        Merit("peak to peak", float(np.ptp(error)), "um"),
    )


# Sec. 2.3

IDENTIFIED, LASTS = 2e-3, 6.0  # m, s
F_MOST = 1e4  # N, to ask for: far beyond any supply, far from the largest float


def identify(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = IDENTIFIED,
    F_z: float = 1.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A step of the open loop at a vertical force of `F_z` (N), beside the linear servo (5) that was fitted to one."""
    par: Any = plant.parameters
    believed: Any = controller.parameters
    fast = controller.sample_time / FASTER
    commanding = replace(controller, sample_time=fast, parameters=replace(believed, F_z=F_z))
    own = {
        "fidelity": "phase",
        "electronics": replace(IDEAL, current_loops=False),
        "open_loop": True,
        "delay": 0,
    }
    scenario = scenario_of(
        "identify", LASTS, partial(move, distance=distance, rise=0.0, begin=0.0), QUIET | own | options
    )
    wanted = PlannedRun("motor", replace(scenario, start={"x": 0.0}), lambda _: ())
    (case,), cut = fly(plant, commanding, [wanted], progress, options)
    E, G = sample(*halbach.servo(par, F_z, distance), fast)
    states = [np.zeros(2)]
    for _ in case.run.t[1:]:
        states.append(E @ states[-1] + G[:, 0] * distance)
    linear = np.array(states)[:, 0]
    off = linear - case.run.p[:, 0]
    merits = (
        Merit("linear servo off by, rms", rms(off), "mm"),
        Merit("the same in the first 2 s", rms(off[case.run.t < 2]), "mm"),
        Merit("secant stiffness", halbach.stiffness(par, F_z, distance), "N/m", "servo.K"),
        Merit("tangent stiffness", halbach.stiffness(par, F_z), "N/m"),
    )
    return Experiment(
        "identify",
        "Is the motor a linear servo?",
        (case._replace(merits=merits),),
        merits,
        {"linear": linear},
        cut,
    )


EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "step": step,
    "stairs": stairs,
    "ramp": ramp,
    "force": force,
    "budget": budget,
    "identify": identify,
}
CASES: dict[str, Callable[..., list[PlannedRun]]] = {"step": _step_cases, "ramp": _ramp_cases}
ALONE = ("step", "ramp")
WORDS = {"stroke": "position", "thrust": "force"}
OPTION_UNITS = {"distance": "m", "rise": "s", "speeds": "m/s", "place": "m", "F_z": "N"}


def check(name: str, option: str, value: Any) -> None:
    """InputError for a number without a sense, and for electronics that are none."""
    if option in ("pwm", "mean_of"):
        Options(**{option: value})
    elif option == "count" and not (isinstance(value, int) and 1 <= value <= 1000):
        raise InputError("simulate", f"{name}: {option}", repr(value), "1 to 1000 steps")
    elif option == "rise":
        references.check_rise(value)
    elif option == "F_z" and not 0 < value <= F_MOST:
        raise InputError("simulate", f"{name}: F_z", f"{value:g} N", f"above 0 and at most {F_MOST:g} N")
    elif option in ("distance", "speeds", "place"):
        values = value if option == "speeds" else (value,)
        if not all(
            math.isfinite(v) and (v > 0 or option == "place" or (v and option == "distance")) for v in values
        ):
            expected = (
                "above 0"
                if option == "speeds"
                else "finite" + ("" if option == "place" else ", other than 0")
            )
            raise InputError("simulate", f"{name}: {option}", repr(value), expected)
