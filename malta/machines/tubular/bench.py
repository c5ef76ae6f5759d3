"""MALTA's checklist of the first day: sensors and coils on the bearing, lift-off, loop, stroke, cogging, drop.

On the simulated bench the mover rolls on its bearing without friction, so forces that turn it are above its weight.
What the bearings give way is taken into account with the stiffness that the gain file's machine has, and as uncertain
by its whole size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.identification.calibration import (
    Interval95,
    at_rest,
    magnetic_centre,
    quadrature,
    ring,
    slope,
    unstable_pole,
    wave,
)
from malta.identification.commission import (
    Bench,
    Check,
    StepFinding,
    fly,
    judge_noise,
    loop_step,
    noise_step,
    record_noise,
    stroke_step,
)
from malta.identification.log import Log
from malta.machines.tubular.drive import hall_signals
from malta.machines.tubular.experiments.lifting import lift_cases, rest_on_bearing
from malta.model.plant import Signal
from malta.model.plants import plant_of
from malta.simulation import references
from malta.simulation.scenario import Scenario
from malta.synthesis.controller import Controller

PLANES = (("x1", "y1"), ("x2", "y2"))
PUSH = 6.0  # N, of each module along the ring: more than the weight
TURNS = 2.0  # 1/s, around the ring
SETTLING_TIME = 0.1  # s, after which the mover rolls steadily
PULSE = 2.0  # N, of the thrust
RATE = 40.0  # 1/s, of these pulses: the mover goes 0.1 mm
ZERO_CURRENT = 0.05  # A: largest current without a command
GAIN = 0.05  # largest error of a sensor's gain, and cross talk
OFFSET = 20e-6  # m, largest of a sensor, and of the magnetic centre
HALL = 0.05  # largest error of amplitude, and of phase, rad
MAX_LIFT_DEVIATION = 10e-6  # m, largest deviation after the lift-off
MISMATCH = 0.2  # of K_A / m and its like
SLOW_STROKE_TIME = 3.0  # s, of the slow stroke


def steps(box: Mapping[str, float]) -> tuple[Check, ...]:
    """The checklist, in its order. box: share by which each parameter may differ."""
    on_ring = "no current but that of the test, mover on its bearing"
    return (
        Check("rest", "Do currents read zero, sensors still?", "drive off, mover on its bearing", "a current above 1 A",
             _record_rest, _judge_rest),
        noise_step(_record_dc),
        Check("ring", "How do the radial sensors read the ring?", on_ring, "a bearing that warms up",
             _record_ring, _judge_ring),
        Check("hall", "Are the axial sensors' signals in quadrature?", "mover moved by hand over 28 mm", "an end stop",
             _record_hall, _judge_hall),
        Check("polarity", "Does the thrust push the way it is commanded?", on_ring, "an end stop",
             _record_thrust, _judge_thrust),
        Check("lift", "Does it rise and stay?", "polarity and sensors passed", "touchdown after 60 ms, current limit",
             _record_lift, _judge_lift),
        Check("centre", "Where is the magnetic centre?", "in flight", "touchdown", _record_centre, _judge_centre),
        loop_step(box),
        stroke_step(),
        Check("cogging", "What holds it along the travel?", "in flight, 16 mm of travel", "touchdown",
             _record_slow, _judge_slow),
        Check("drop", "How fast does it fall?", "in flight, then currents off", "none: it lands on its bearing",
             _record_drop, _judge_drop),
    )  # fmt: skip


def _unheld(bench: Bench) -> Bench:
    """The bench with a law that feeds no v0(z) forward: without feedback no current flows but that of a test."""
    table = bench.controller.feedforward
    none = replace(table, v0=np.zeros_like(table.v0))
    return bench._replace(controller=replace(bench.controller, feedforward=none))


def _on_bearing(
    bench: Bench, name: str, duration: float, push: Callable[[FloatArray], FloatArray] | None = None
) -> Log:
    """The mover on its bearing without feedback, where cogging holds it, under the forces of a test."""
    par: Any = bench.truth.parameters
    start = rest_on_bearing(bench.truth) | {"z": (math.pi - par.phi_c) / (2 * math.pi) * par.L_p}
    reference = partial(references.hold, z=start["z"])
    scenario = Scenario(
        name, duration, reference, start, cold=True, bearing=True, open_loop=True, excitation=push
    )
    return fly(_unheld(bench), scenario)


def part_of_log(log: Log, first: int, last: int | None = None) -> Log:
    """Some samples of a log."""
    columns = {group: table[first:last] for group, table in log.columns.items()}
    return replace(log, t=log.t[first:last], columns=columns)


def _record_rest(bench: Bench) -> Log:
    return _on_bearing(bench, "rest", 0.5)


def _record_dc(bench: Bench) -> Log:
    """1 A dc in each module's bearing axis, which presses the mover on its bearing, so that nothing moves.

    A log without currents where their sensors are ideal.
    """
    par: Any = bench.controller.parameters
    if bench.truth.drive.sensors is None:
        return record_noise(bench)
    push = np.array([0.0, -par.K_B, 0.0, -par.K_B, 0.0])
    return part_of_log(
        _on_bearing(bench, "noise", 1.0 + SETTLING_TIME, lambda t: np.tile(push, (len(t), 1))),
        round(SETTLING_TIME / bench.controller.sample_time),
    )


def _judge_rest(controller: Controller, log: Log) -> list[StepFinding]:
    """Means of the measured currents, and noise of the sensors.

    With the drive off, the means are the offsets of the current sensors. On the simulated bench it is on, and its
    controllers hold the readings at zero.
    """
    currents = at_rest(log, "i") if log.names("i") else {}
    offsets = [
        StepFinding(f"mean of {name}", mean, -ZERO_CURRENT, ZERO_CURRENT)
        for name, (mean, _) in currents.items()
    ]
    return [*offsets, *judge_noise(controller, log)]


def _record_ring(bench: Bench) -> Log:
    def push(t: FloatArray) -> FloatArray:
        angle = 2 * math.pi * TURNS * np.maximum(t - SETTLING_TIME / 2, 0) - math.pi / 2
        c, s = PUSH * np.cos(angle), PUSH * np.sin(angle)
        return np.column_stack([c, s, c, s, 0 * t])

    return _on_bearing(bench, "ring", 2 * SETTLING_TIME + 1 / TURNS, push)


def _judge_ring(controller: Controller, log: Log) -> list[StepFinding]:
    """Gains, cross talk and offsets of the radial sensors, and the polarity of the bearing coils."""
    par: Any = controller.parameters
    log = part_of_log(log, round(SETTLING_TIME / log.sample_time))
    sag = (par.m * par.g / 2 + par.K_A * par.r_max + PUSH) / par.k_t  # of a bearing, downwards
    findings = []
    for x, y in PLANES:
        found = ring(log, (x, y), par.r_max + (par.K_A * par.r_max + PUSH) / par.k_t)
        unsure = sag / par.r_max
        ends = (
            (f"gain of {x}", found.gain_x),
            (f"gain of {y}", found.gain_y),
            (f"cross talk {x} {y}", found.cross),
        )
        findings += [StepFinding(name, e._replace(half=e.half + unsure), -GAIN, GAIN) for name, e in ends]
        offsets = ((x, found.offset_x), (y, found.offset_y))
        findings += [
            StepFinding(f"offset of {name}", e._replace(half=e.half + sag), -OFFSET, OFFSET)
            for name, e in offsets
        ]
    for force, sensor in zip(("fx_B1", "fy_B1", "fx_B2", "fy_B2"), ("x1", "y1", "x2", "y2"), strict=True):
        findings.append(StepFinding(f"{sensor} by {force}", slope(log, ("v", force), sensor), 0.0))
    return findings


def _record_hall(bench: Bench) -> Log:
    """Cosine and sine of both planes' Hall sensors while a hand moves the mover along its bearing."""
    par: Any = bench.truth.parameters
    Ts, count = bench.controller.sample_time, 20_000
    t = Ts * np.arange(count)
    z = 14e-3 * np.cos(math.pi * t / t[-1])
    at = rest_on_bearing(bench.truth)
    errors = [bench.errors.get(name, 0.0) for name in ("hall_amplitude", "hall_phase", "hall_single")]
    noise = np.random.default_rng(bench.seed).normal(0, math.pi * par.s_z / par.L_p, (count, 2))
    x, y = (at.get("x", 0.0),) * 2, (at.get("y", 0.0),) * 2
    cosine, sine = (np.array(one).ravel() for one in hall_signals(z, x, y, par.L_p, errors, np))
    raw = np.column_stack([cosine, sine]) + noise * abs(cosine[0])
    signals = {"y": (Signal("hall_cosine", "1"), Signal("hall_sine", "1"))}
    return Log("run hall", bench.truth.name, bench.controller.name, Ts, 0.0, t, {"y": raw}, signals)


def _judge_hall(_: Controller, log: Log) -> list[StepFinding]:
    """Amplitude and phase of the sine beside the cosine, and offsets of both."""
    found = quadrature(*log.table("y", ["hall_cosine", "hall_sine"]).T)
    return [
        StepFinding(f"hall {name.replace('_', ' ')}", e, -HALL, HALL) for name, e in found._asdict().items()
    ]


def _record_thrust(bench: Bench) -> Log:
    def push(t: FloatArray) -> FloatArray:
        f = np.zeros((len(t), 5))
        f[:, 4] = PULSE * np.sign(np.cos(2 * math.pi * RATE * t))
        return f

    return _on_bearing(bench, "polarity", 0.5, push)


def _judge_thrust(controller: Controller, log: Log) -> list[StepFinding]:
    """1 / m as the thrust sees it: its sign is the polarity."""
    par: Any = controller.parameters
    found = slope(log, ("v", "f_D"), "z", free=True)
    return [StepFinding("z'' by f_D", found, 0.5 / par.m, 2 / par.m)]


def _record_lift(bench: Bench) -> Log:
    one = lift_cases(bench.truth, bench.controller, estimator="steady-state")[0].scenario
    return fly(bench, one, ends=("completed",))


def _judge_lift(controller: Controller, log: Log) -> list[StepFinding]:
    """The largest deviation of the radial readings in the last third."""
    plant = plant_of(controller.parameters)
    y = log.table("y", [s.name for s in plant.outputs])[-log.samples // 3 :, :4]
    return [
        StepFinding(
            "off its place after the lift-off",
            Interval95(float(np.abs(y).max()), plant.sensors.resolution[0], "m"),
            0,
            MAX_LIFT_DEVIATION,
        )
    ]


def _record_centre(bench: Bench) -> Log:
    reference = partial(references.circle, radius=100e-6, frequency=0.5)
    return fly(bench, Scenario("centre", 2.0, reference, settle=0.5))


def _judge_centre(controller: Controller, log: Log) -> list[StepFinding]:
    """The magnetic centre at each sensor, and the attraction over that of the gain file."""
    found = magnetic_centre(log, plant_of(controller.parameters))
    places = [StepFinding(f"magnetic centre, {name}", e, -OFFSET, OFFSET) for name, e in found.centre.items()]
    return [
        *places,
        StepFinding("K_A / K_B over the gain file's", found.stiffness, 1 - MISMATCH, 1 + MISMATCH),
    ]


def _record_slow(bench: Bench) -> Log:
    return fly(
        bench, Scenario.stroke(16e-3, rise=0.8, duration=SLOW_STROKE_TIME, profile="quintic", settle=0.3)
    )


def _judge_slow(controller: Controller, log: Log) -> list[StepFinding]:
    """Amplitude and phase of the cogging."""
    par: Any = controller.parameters
    size, phase = wave(log, plant_of(par), par.L_p)
    return [
        StepFinding("cogging", size, 0.0, 0.05 * 2 * par.K_D * par.I_max),
        StepFinding("phase of the cogging", phase),
    ]


def _record_drop(bench: Bench) -> Log:
    """From the centre without current; the log ends before the touchdown."""
    scenario = Scenario("drop", 0.05, references.hold, cold=True, open_loop=True)
    log = fly(_unheld(bench), scenario, ends=tuple(bench.truth.contacts.names))
    par: Any = bench.truth.parameters
    fallen = np.flatnonzero(np.abs(log.columns["y"][:, :4]).max(axis=1) > 0.9 * par.r_max)
    if not len(fallen):
        raise CheckError("drop: the mover does not fall")
    return part_of_log(log, 4, int(fallen[0]))


def _judge_drop(controller: Controller, log: Log) -> list[StepFinding]:
    """The unstable pole over that of the gain file's machine, sqrt(2 K_A / m)."""
    par: Any = controller.parameters
    expected = math.sqrt(2 * par.K_A / par.m)
    found = unstable_pole(log, "y1")
    share = Interval95(found.value / expected, found.half / expected)
    return [StepFinding("unstable pole over the gain file's", share, 1 - MISMATCH, 1 + MISMATCH)]
