"""The experiments on the Halbach linear motor.

step     100 um there and back, with every source of error, Fig. 9
ramp     50 mm at constant speed, Fig. 8

Electronics run period by period at fidelity "phase", which is the default; campaigns run at fidelity "force".

Motions of the Halbach motor under position control: steps and ramps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.machines.halbach import electronics
from malta.machines.halbach.electronics import MEAN_SAMPLES, Options, Pwm
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.experiments import Experiment, Merit, PlannedRun, experiment_of, rms, scenario_of
from malta.simulation.references import Motion, Reference
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller


def lift_deviation(run: Trajectory) -> float:
    """Largest relative difference of the vertical force from the commanded one; NaN if that is 0."""
    F_z = commanded_lift(run)
    return float(np.abs(lift_force(run) / F_z - 1).max()) if F_z else math.nan


def commanded_lift(run: Trajectory) -> float:
    """The vertical force in the controller's parameters, N."""
    believed: Any = run.controller.parameters
    return float(believed.F_z)


def lift_force(run: Trajectory) -> FloatArray:
    """The vertical force at all samples, N; at fidelity "force" that of the commanded currents."""
    par: Any = run.plant.parameters
    return electronics.vertical_force(par, run.x[:, 0], run.i_phase if run.i_phase.size else run.current)


# Options of the electronics in an experiment.


def electronics_options(
    options: Mapping[str, Any], pwm: Pwm, adc_noise: bool, adc_steps: bool, mean_of: int, current_loops: bool
) -> dict[str, Any]:
    """Options with a record of the electronics; None for those of the paper, as fidelity "force" takes none."""
    found = Options(pwm, adc_steps, adc_noise, mean_of, current_loops)
    parts = None if found == electronics.REAL_ELECTRONICS else found
    return {"fidelity": "phase", "electronics": parts} | dict(options)


def in_campaigns(cases: Callable[..., list[PlannedRun]]) -> Callable[..., list[PlannedRun]]:
    """The same runs with fidelity "force", unless the options name another."""
    return lambda plant, controller, **options: cases(plant, controller, **{"fidelity": "force"} | options)


STEP, COUNT = 100e-6, 20  # m, Fig. 9
LEAD_READINGS, PAUSE, REST = 5, 40, 400  # readings before the steps, between them, after the last


def step_cases(
    _: Plant,
    controller: Controller,
    *,
    distance: float = STEP,
    rise: float = 0.3,
    count: int = COUNT,
    pwm: Pwm = "plain",
    adc_noise: bool = True,
    adc_steps: bool = True,
    mean_of: int = MEAN_SAMPLES,
    current_loops: bool = True,
    **options: Any,
) -> list[PlannedRun]:
    """Steps there and back, `count` of them, then 22 s of rest: as jumps, and as quintics with a rise of `rise` (s)."""
    own = electronics_options(options, pwm, adc_noise, adc_steps, mean_of, current_loops)
    Ts = controller.sample_time
    wanted = []
    for label, taken in (("jumps", 0.0), ("quintics", rise)):
        reference = partial(steps_reference, distance=distance, rise=taken, count=count, Ts=Ts)
        scenario = scenario_of("step", (LEAD_READINGS + PAUSE * count + REST) * Ts, reference, own)
        wanted.append(PlannedRun(label, scenario, partial(_step_merits, distance=distance, count=count)))
    return wanted


def steps_reference(_: Plant, distance: float, rise: float, count: int, Ts: float) -> Reference:
    """`count` steps of `distance` (m) away from 0 and back, with a rise of `rise` (s); 0: jumps at readings."""
    begin = (LEAD_READINGS + PAUSE * np.arange(count)) * Ts

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
    """Responses to the steps of `steps_reference`, count x readings: 0 before a step, 1 after, NaN after the run."""
    wanted = LEAD_READINGS + PAUSE * count
    x = np.full(wanted, np.nan)
    x[: min(wanted, len(run.p))] = run.p[:wanted, 0]
    shares = x[LEAD_READINGS:].reshape(count, PAUSE) / distance
    shares[1::2] = 1 - shares[1::2]
    return shares


def _step_merits(run: Trajectory, distance: float, count: int) -> tuple[Merit, ...]:
    """Overshoot and settling time of the mean response, the error at rest, and the vertical force."""
    mean, Ts = responses(run, distance, count).mean(axis=0), run.controller.sample_time
    outside = np.flatnonzero(~(np.abs(mean - 1) <= 0.05))
    settled = math.nan
    if 0 < len(outside) < PAUSE and outside[-1] + 1 < PAUSE:
        k = int(outside[-1])
        edge = 1 + math.copysign(0.05, mean[k] - 1)
        settled = (k + float((mean[k] - edge) / (mean[k] - mean[k + 1]))) * Ts
    tail = (run.p - run.reference)[LEAD_READINGS + PAUSE * count - PAUSE // 2 :, 0]
    if len(tail) == 0:
        tail = np.array([math.nan])
    return (
        Merit("mean overshoot", max(float(mean.max()) - 1, 0.0), "percent"),
        Merit("mean within 5 % after", settled, "ms", key="mean_settled"),
        Merit("at rest, rms", float(tail.std()), "um"),
        Merit("at rest, mean error", abs(float(tail.mean())), "um"),
        Merit("vertical force off by", lift_deviation(run), "percent"),
    )


REST_READINGS, SETTLING = 20, 2.0  # before and after the ramp; s, until the start at full speed has decayed


def ramp_cases(
    _: Plant,
    controller: Controller,
    *,
    distance: float = 50e-3,
    speeds: tuple[float, ...] = (1e-3, 2e-3, 5e-3),
    pwm: Pwm = "plain",
    adc_noise: bool = True,
    adc_steps: bool = True,
    mean_of: int = MEAN_SAMPLES,
    current_loops: bool = True,
    **options: Any,
) -> list[PlannedRun]:
    """Through the travel, half of `distance` to either side of the middle, at each of the speeds (m/s)."""
    own = electronics_options(options, pwm, adc_noise, adc_steps, mean_of, current_loops)
    still, wanted = REST_READINGS * controller.sample_time, []
    for speed in speeds:
        moving = abs(distance) / speed
        reference = partial(ramp_reference, distance=distance, speed=speed, start=still)
        scenario = scenario_of("ramp", moving + 2 * still, reference, own)
        merits = partial(_ramp_merits, start=still, moving=moving)
        wanted.append(PlannedRun(f"{1e3 * speed:g} mm/s", scenario, merits))
    return wanted


def ramp_reference(plant: Plant, distance: float, speed: float, start: float) -> Reference:
    """From -distance / 2 (m) to distance / 2 at a constant speed (m/s), beginning at `start` (s).

    Raises InputError for a distance that is longer than twice the travel.
    """
    if not abs(distance) / 2 <= plant.stroke.travel:
        found, most = (f"{distance:g} m", f"at most {2 * plant.stroke.travel:g} m, the travel to both sides")
        raise InputError("halbach", "ramp: distance", found, most)

    def at(t: FloatArray) -> Motion:
        passed = np.clip((np.asarray(t) - start) * speed / abs(distance), 0, 1)[:, None]
        moving = (passed > 0) & (passed < 1)
        return Motion(
            distance * (passed - 0.5), math.copysign(speed, distance) * moving, np.zeros(passed.shape)
        )

    return at


def _ramp_merits(run: Trajectory, start: float, moving: float) -> tuple[Merit, ...]:
    """Lag and error while the speed is constant, the largest error, and the vertical force."""
    error = (run.reference - run.p)[:, 0]
    steady = (run.t > start + SETTLING) & (run.t < start + moving)
    lag = abs(float(error[steady].mean())) if steady.any() else math.nan
    return (
        Merit("mean lag", lag, "um"),
        Merit("error on the way, rms", rms(error[steady]) if steady.any() else math.nan, "um"),
        Merit("largest error", float(np.abs(error).max()), "um"),
        Merit("vertical force off by", lift_deviation(run), "percent"),
    )


EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "step": experiment_of("step", "Does it go where it is sent, and stay?", step_cases),
    "ramp": experiment_of("ramp", "Does it follow through the whole travel?", ramp_cases),
}
CASES: dict[str, Callable[..., list[PlannedRun]]] = {
    "step": in_campaigns(step_cases),
    "ramp": in_campaigns(ramp_cases),
}
ALONE = ("step", "ramp")
WORDS = {"stroke": "position", "thrust": "force"}
OPTION_UNITS = {"distance": "m", "rise": "s", "speeds": "m/s"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number outside the range of an option, and for options of no electronics."""
    if option in ("pwm", "mean_of"):
        Options(**{option: value})
    elif option == "count" and not (isinstance(value, int) and 1 <= value <= 1000):
        raise InputError("simulate", f"{name}: {option}", repr(value), "1 to 1000 steps")
    elif option == "rise":
        references.check_rise(value)
    elif option in ("distance", "speeds"):
        values = value if option == "speeds" else (value,)
        if not all(math.isfinite(v) and (v > 0 or (v and option == "distance")) for v in values):
            expected = "above 0" if option == "speeds" else "finite, other than 0"
            raise InputError("simulate", f"{name}: {option}", repr(value), expected)
