"""Experiments that replicate the paper's on the Halbach linear motor.

stairs   steps of 10 um: open loop and position control, plain and high-resolution PWM, Fig. 7
force    the vertical force of a move of 5 mm under three control laws, Fig. 10, sound and with faults
budget   the error of a motor at rest by source, Sec. 5.1
identify the step of 2 mm in the open loop from which the paper identified mass and friction, Sec. 2.3; A, k and l from
         a load cell's record, Sec. 2.1
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from malta import CheckError, InputError, references
from malta.arrays import FloatArray
from malta.machines.halbach import electronics, experiments as machine
from malta.machines.halbach.electronics import IDEAL_ELECTRONICS, IQ_BITS, Options, Pwm
from malta.machines.halbach.experiments import lift_force
from malta.machines.halbach.load_cell import MIN_READINGS, SIGMAS, MotorFit, fit_motor_law, simulated_record
from malta.model import Plant
from malta.simulation import Experiment, Trajectory
from malta.simulation.experiments import (
    AS_BUILT,
    NO_NOISE,
    Merit,
    PlannedRun,
    Progress,
    fly,
    fly_all,
    rms,
    scenario_of,
)
from malta.simulation.references import Motion, Reference
from malta.synthesis import Controller

MOVE = 5e-3  # m
LEAD, TAIL = 100, 120  # readings before a move, and from its beginning to the end
SAMPLES_PER_READING = 50  # control periods of the open loop in a period of the laser
FAULTS: Mapping[str, Mapping[str, float]] = {  # that may explain the paper: angle in rad, outer force in N
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
PAPER_NAMES = dict(
    zip(LAWS, ("open_loop", "position_controller", "vector_control"), strict=True)
)  # figure_10


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
    flights = [
        _flight(plant, controller, fault, law, distance, rise, own) for fault in FAULTS for law in LAWS
    ]
    cases, cut = fly_all(flights, progress, options)
    return Experiment("force", "Does a move disturb the vertical force?", cases, (), interrupted=cut)


def sound_moves(plant: Plant, controller: Controller, rise: float) -> Experiment:
    """The moves of `force` of the sound machine alone, with another rise (s) of the quintics."""
    own = {"electronics": Options("fine")}
    cases, cut = fly_all(
        [_flight(plant, controller, "sound", law, MOVE, rise, own) for law in LAWS], None, {}
    )
    return Experiment("force", "Does a quick move disturb the vertical force?", cases, (), interrupted=cut)


def _flight(
    plant: Plant,
    controller: Controller,
    fault: str,
    law: str,
    distance: float,
    rise: float,
    options: Mapping[str, Any],
) -> tuple[Plant, Controller, PlannedRun]:
    """One run of `force`: the machine with a fault, its controller, and the scenario.

    The open loop has no feedback from the laser, so its controller runs SAMPLES_PER_READING times as often.
    """
    par: Any = plant.parameters
    (position, vector), faulty = LAWS[law], dict(FAULTS[fault])
    angle, push = faulty.pop("angle", 0.0), faulty.pop("push", 0.0)
    machine = plant.variant(replace(par, **faulty)) if faulty else plant
    begin, end = LEAD * controller.sample_time, (LEAD + TAIL) * controller.sample_time
    own: dict[str, Any] = {"fidelity": "phase"} | dict(options)
    own["electronics"] = replace(own["electronics"] or electronics.REAL_ELECTRONICS, current_loops=vector)
    if not position:
        controller = replace(controller, sample_time=controller.sample_time / SAMPLES_PER_READING)
        own |= {"open_loop": True, "delay": 0}
    if angle and position:  # the open loop takes the angle from the reference
        own["sensor_errors"] = {"offset_x": angle / par.k}
    if push:
        own["disturbance"] = partial(constant_force, size=push)
    reference = partial(move_reference, distance=distance, rise=rise if position else 0.0, begin=begin)
    printed = f"figure_10.{PAPER_NAMES[law]}" if fault == "sound" and distance == MOVE else ""
    merits = partial(_move_merits, begin=begin, printed=printed)
    label = law if fault == "sound" else f"{law}, {fault}"
    return machine, controller, PlannedRun(label, scenario_of("force", end, reference, own), merits)


def move_reference(_: Plant, distance: float, rise: float, begin: float) -> Reference:
    """From 0 to `distance` (m), beginning at `begin` (s): a quintic with a rise of `rise` (s), or a jump for 0."""

    def at(t: FloatArray) -> Motion:
        later = np.asarray(t) - begin
        if not rise:
            p = np.where(later > -1e-9, distance, 0.0)[:, None]
            return Motion(p, 0 * p, 0 * p)
        middle = references.QUINTIC_DURATION * rise / 2
        return Motion(*(distance * s[:, None] for s in references.quintic(later - middle, rise)))

    return at


def constant_force(t: FloatArray, size: float) -> FloatArray:
    """A constant force, N."""
    return np.full((len(t), 1), size)


def _move_merits(run: Trajectory, begin: float, printed: str) -> tuple[Merit, ...]:
    """Relative changes of the vertical force from its mean in the second before the move, and the distance moved."""
    F, later = lift_force(run), run.t > begin
    earlier, late = (run.t > begin - 1) & ~later, run.t > run.scenario.duration - 1
    if not late.any():  # the run ended earlier
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
        Merit("lowest", lowest, "percent", better="high"),
        Merit("highest", highest, "percent"),
        Merit("moved", moved, "mm", better=""),
    )


PWMS: Mapping[Pwm, str] = {"plain": "plain PWM", "fine": "high-resolution PWM"}
STAIR, LEVELS, STAY = 10e-6, 5, 100  # m, height of a stair; number of levels; readings on each


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
    reference = partial(stairs_reference, distance=distance, Ts=Ts)
    merits = partial(_stairs_merits, distance=distance)
    wanted = []
    for law in ("open loop", "position control"):
        for pwm, name in PWMS.items():
            parts = replace(IDEAL_ELECTRONICS, pwm=pwm, current_loops=False)
            own = {"fidelity": "phase", "electronics": parts, "open_loop": law == "open loop"}
            scenario = scenario_of("stairs", LEVELS * STAY * Ts, reference, NO_NOISE | own | options)
            wanted.append(PlannedRun(f"{law}, {name}", scenario, merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    believed: Any = controller.parameters
    printed = {"plain": "smallest_motion", "fine": "smallest_motion_fine"}
    found = []
    for pwm, name in PWMS.items():
        longest = float(electronics.dead_zones(believed, believed.F_z, pwm)[1].max())
        found.append(Merit(f"longest dead zone, {name}", longest, "um", f"open_loop.{printed[pwm]}"))
    return Experiment("stairs", "How small a motion can it make?", cases, tuple(found), interrupted=cut)


def stairs_reference(_: Plant, distance: float, Ts: float) -> Reference:
    """Stairs of `distance` (m), STAY readings long."""

    def at(t: FloatArray) -> Motion:
        p = distance * np.minimum(np.floor(np.asarray(t) / (STAY * Ts) + 1e-6), LEVELS - 1)[:, None]
        return Motion(p, 0 * p, 0 * p)

    return at


def positions_at_rest(run: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Mean and peak to peak of the position in the last second on each stair, m."""
    x = np.full(LEVELS * STAY, np.nan)
    x[: len(run.p)] = run.p[:, 0]
    late = x.reshape(LEVELS, STAY)[:, -STAY // 5 :]
    return late.mean(axis=1), np.ptp(late, axis=1)


def _stairs_merits(run: Trajectory, distance: float) -> tuple[Merit, ...]:
    """Heights of the stairs, the largest error of a stair, and the largest motion on one."""
    stands, swings = positions_at_rest(run)
    return (
        Merit("smallest stair", float(np.diff(stands).min()), "um", better="high"),
        Merit("largest stair", float(np.diff(stands).max()), "um", better=""),
        Merit("off its stair by", float(np.abs(stands - distance * np.arange(LEVELS)).max()), "um"),
        Merit("swing, peak to peak", float(swings.max()), "um"),
    )


IDENTIFICATION_STEP, IDENTIFICATION_TIME = 2e-3, 6.0  # m, s: step and duration of the identification
MAX_FORCE = 1e4  # N, largest F_z to ask for: far beyond any supply, far from the largest float


def identify(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = IDENTIFICATION_STEP,
    F_z: float = 1.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A step of the open loop at a vertical force of `F_z` (N), beside the linear servo (5) that was fitted to one.

    Mass and friction are fitted to what the laser reads of it, as the paper fitted them: see `fit_servo`. A, k and l
    come from a simulated record of a load cell along the travel, Sec. 2.1: see `fit_motor_law`.
    """
    par: Any = plant.parameters
    believed: Any = controller.parameters
    fast = controller.sample_time / SAMPLES_PER_READING
    commanding = replace(controller, sample_time=fast, parameters=replace(believed, F_z=F_z))
    own = {
        "fidelity": "phase",
        "electronics": replace(IDEAL_ELECTRONICS, current_loops=False),
        "open_loop": True,
        "delay": 0,
    }
    scenario = scenario_of(
        "identify",
        IDENTIFICATION_TIME,
        partial(move_reference, distance=distance, rise=0.0, begin=0.0),
        NO_NOISE | own | options,
    )
    wanted = PlannedRun("motor", replace(scenario, start={"x": 0.0}), lambda _: ())
    (case,), cut = fly(plant, commanding, [wanted], progress, options)
    A, B = electronics.servo(par, F_z, distance)
    held = expm(fast * np.block([[A, B], [np.zeros((1, 3))]]))
    E, G = held[:2, :2], held[:2, 2:]
    states = [np.zeros(2)]
    for _ in case.run.t[1:]:
        states.append(E @ states[-1] + G[:, 0] * distance)
    linear = np.array(states)[:, 0]
    off, K = linear - case.run.p[:, 0], electronics.stiffness(par, F_z, distance)
    fit = _fit_to_readings(case.run, distance, K)
    fitted = (
        servo_step(case.run.t, fit.m, fit.b, K, distance) if fit.m > 0 else np.full(len(linear), math.nan)
    )
    law = _fit_to_cell(plant)
    merits = (
        Merit("linear servo off by, rms", rms(off), "mm"),
        Merit(
            "the same in the first 2 s", rms(off[case.run.t < 2]), "mm", key="linear_servo_off_by_rms_early"
        ),
        Merit("secant stiffness", K, "N/m", "servo.K", better="high"),
        Merit("tangent stiffness", electronics.stiffness(par, F_z), "N/m", better="high"),
        Merit("mass, fitted", fit.m, "kg", better=""),
        Merit("mass, half of its interval", fit.m_half, "kg"),
        Merit("friction, fitted", fit.b, "N s/m", better=""),
        Merit("friction, half of its interval", fit.b_half, "N s/m"),
        Merit("fitted servo off by, rms", fit.rms, "um"),
        *(
            Merit(f"load cell: {name}{what}", value, unit, better="low" if what else "")
            for name, unit, found in (
                ("A", "N/A", (law.A, law.A_half)),
                ("k", "rad/m", (law.k, law.k_half)),
                ("l", "mm", (law.pitch, law.pitch_half)),
            )
            for what, value in zip(("", ", half of its interval"), found, strict=True)
        ),
    )
    return Experiment(
        "identify",
        "Is the motor a linear servo?",
        (case._replace(merits=merits),),
        merits,
        {"linear": linear, "fitted": fitted},
        cut,
    )


def _fit_to_readings(run: Trajectory, distance: float, K: float) -> ServoFit:
    """The servo fitted to what the laser reads of a run; NaN where none fits, as of a run that ended early."""
    try:
        return fit_servo(run.t[::SAMPLES_PER_READING], run.y[::SAMPLES_PER_READING, 0], distance, K)
    except (CheckError, InputError):
        return ServoFit(*[math.nan] * 5)


def _fit_to_cell(plant: Plant) -> MotorFit:
    """The motor law fitted to a simulated record of a load cell; NaN where the cell's noise hides it."""
    try:
        return fit_motor_law(*simulated_record(plant))
    except CheckError:
        return MotorFit(*[math.nan] * 8)


class ServoFit(NamedTuple):
    """Mass and friction of the linear servo (5), fitted to a record of a step."""

    m: float  # kg
    m_half: float  # kg, half of its interval of 95 %
    b: float  # N s/m
    b_half: float  # N s/m
    rms: float  # m, what the fit leaves of the record


def fit_servo(t: FloatArray, x: FloatArray, distance: float, K: float) -> ServoFit:
    """Fit m and b of the linear servo (5), m x'' + b x' + K x = K x_eq, to its step from rest. Least squares.

    t : n times after the step, s
    x : n positions that were read, m, before the step 0
    distance : of the step of x_eq, m
    K : stiffness, N/m, which is known, as in Sec. 2.3. A step tells m / K and b / K alone.

    Returns a ServoFit. What a linear servo leaves of a motor's record is no white noise but a wave of its own period:
    the intervals are the wider of those of white residuals and of residuals that are correlated over a period (Newey
    and West, Econometrica 55, 1987). They know of no error of K.

    Raises InputError for fewer than 8 readings or numbers that are not finite, CheckError where nothing fits.

    >>> import numpy as np
    >>> t = np.arange(100) * 0.055
    >>> fit = fit_servo(t, servo_step(t, 3.75, 9.41, 205.0, 2e-3), 2e-3, 205.0)
    >>> round(fit.m, 6), round(fit.b, 6)
    (3.75, 9.41)
    """
    from scipy.optimize import least_squares

    if len(t) < MIN_READINGS or len(t) != len(x):
        raise InputError(
            "fit_servo", "x", f"{len(x)} readings at {len(t)} times", f"{MIN_READINGS} or more, of one each"
        )
    if not (np.isfinite([*t, *x, distance, K]).all() and distance and K > 0):
        raise InputError("fit_servo", "t, x, distance, K", "NaN or infinity", "finite numbers, K above 0")

    def off(logs: FloatArray) -> FloatArray:
        m, b = np.exp(logs)
        return (servo_step(t, m, b, K, distance) - x) / distance

    crossing = int(np.argmax(x / distance > 0.5))  # a mass that is late by a sixth of its period
    w = np.pi / 3 / max(t[crossing], t[1])
    found = least_squares(off, np.log([K / w**2, K / w]), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    m, b = np.exp(found.x)
    period = 2 * np.pi * np.sqrt(m / K)
    if not (found.success and period < t[-1] - t[0]):
        raise CheckError(f"fit_servo: no servo of {K:g} N/m fits the record of {t[-1] - t[0]:g} s")
    lags = int(np.ceil(period / (t[1] - t[0])))
    shares = SIGMAS * np.sqrt(_variances(np.asarray(found.jac), found.fun, lags))
    rest = abs(distance) * rms(found.fun)
    return ServoFit(float(m), float(m * shares[0]), float(b), float(b * shares[1]), rest)


def _variances(J: FloatArray, off: FloatArray, lags: int) -> FloatArray:
    """Variances of fitted numbers from the residuals: the larger of those of white ones and of ones that correlate."""
    scores = J * off[:, None]
    inner = scores.T @ scores
    for lag in range(1, min(lags, len(off) - 1)):
        cross = scores[lag:].T @ scores[:-lag]
        inner += (1 - lag / lags) * (cross + cross.T)
    outer = np.linalg.inv(J.T @ J)
    white = outer * (off @ off) / (len(off) - J.shape[1])
    return np.asarray(np.maximum(np.diag(outer @ inner @ outer), np.diag(white)))


def servo_step(t: FloatArray, m: float, b: float, K: float, distance: float) -> FloatArray:
    """Positions, m, of the linear servo (5) at times t (s) after a step of x_eq by `distance` (m) from rest."""
    decay = b / (2 * m)
    w = np.sqrt(complex(K / m - decay**2))  # imaginary where friction leaves no oscillation
    w = w if abs(w) > 1e-6 * decay else 1e-6 * decay  # poles that meet: the limit, to 1e-12
    first, second = -decay + 1j * w, -decay - 1j * w
    left = (first * np.exp(second * t) - second * np.exp(first * t)) / (first - second)
    return np.asarray(distance * (1 - left.real))


# The error of the Halbach motor at rest, by source: Sec. 5.1.


class Source(NamedTuple):
    """A source of error: the electronics and the sensors that have it alone."""

    parts: Options
    sensors: dict[str, Any]
    aside: float = 0.0  # m, beside the place of the budget


SOURCES: Mapping[str, Source] = {
    "laser": Source(IDEAL_ELECTRONICS, AS_BUILT),
    "current noise": Source(replace(IDEAL_ELECTRONICS, adc_noise=True), NO_NOISE),
    "current steps": Source(replace(IDEAL_ELECTRONICS, adc_steps=True), NO_NOISE),
    "PWM": Source(replace(IDEAL_ELECTRONICS, pwm="plain"), NO_NOISE),
    f"angle of {IQ_BITS} bits": Source(
        replace(IDEAL_ELECTRONICS, angle_bits=IQ_BITS), NO_NOISE, 0.3e-3
    ),  # exact at x = 0
    "all": Source(electronics.REAL_ELECTRONICS, AS_BUILT),
    "all, fine PWM": Source(replace(electronics.REAL_ELECTRONICS, pwm="fine"), AS_BUILT),
}


RUN_READINGS, FIRST_READING = 500, 40  # readings of a run, and the first of them that counts


PLACES_ALONG = 7  # places along half a pitch, for current noise alone


def budget(
    plant: Plant,
    controller: Controller,
    *,
    place: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Rest at `place` (m) with each source of error alone, and with all; current noise along half a pitch.

    The fixed-point angle is not among all: the paper prints no format.
    """
    believed: Any = controller.parameters
    spots = np.linspace(0, math.pi / believed.k, PLACES_ALONG)
    asked = [(name, *source[:2], place + source.aside) for name, source in SOURCES.items()]
    asked += [(f"current noise at {1e3 * x:.1f} mm", *SOURCES["current noise"][:2], float(x)) for x in spots]
    wanted = []
    for label, parts, sensors, x in asked:
        own = {"fidelity": "phase", "electronics": parts} | sensors
        reference = partial(references.hold, x=x)
        scenario = scenario_of("budget", RUN_READINGS * controller.sample_time, reference, own | options)
        wanted.append(PlannedRun(label, scenario, _rest_merits))
    flown, cut = fly(plant, controller, wanted, progress, options)
    shown, along = flown[: len(SOURCES)], flown[len(SOURCES) :]
    found = np.array([case.merits[0].value for case in along])
    ends = (("best", found.min(initial=math.inf)), ("worst", found.max(initial=0.0))) if len(found) else ()
    merits = tuple(Merit(f"current noise, at the {end} place", float(value), "um") for end, value in ends)
    curves = {"place": spots[: len(found)], "rms": found}
    return Experiment("budget", "What keeps it from standing still?", shown, merits, curves, interrupted=cut)


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Rms, mean and peak to peak of the position error after the first readings."""
    error = (run.p - run.reference)[FIRST_READING:, 0]
    if len(error) == 0:
        error = np.array([math.nan])
    return (
        Merit("position, rms", float(error.std()), "um"),
        Merit("mean error", abs(float(error.mean())), "um"),
        Merit("peak to peak", float(np.ptp(error)), "um"),
    )


EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "stairs": stairs,
    "force": force,
    "budget": budget,
    "identify": identify,
}
OPTION_UNITS = {"place": "m", "F_z": "N"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number outside the range of an option."""
    if option == "F_z" and not 0 < value <= MAX_FORCE:
        raise InputError("simulate", f"{name}: F_z", f"{value:g} N", f"above 0 and at most {MAX_FORCE:g} N")
    if option == "place" and not math.isfinite(value):
        raise InputError("simulate", f"{name}: place", repr(value), "finite")
    machine.check(name, option, value)
