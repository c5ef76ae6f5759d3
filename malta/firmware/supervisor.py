"""The supervisor: what it watches, with which limits, and how it reacts; all of it from the gain file and its machine.

    off --start--> offsets --> sensors --> lift --> settle --operate--> operate <--> hold
     ^                                       |         |                   |           |
     +-------------------------------- landing <-------+------- land ------+-----------+
    fault: from everywhere, until it is acknowledged

supervisor_text.py writes these tables as C; templates/supervisor.c is the machine of states itself.

Filters that do without one sensor: their gains, and the machine's equations that they take.

Two unstable modes seen by one sensor leave little room: C and A at the operating point are not enough where a stroke
moves the levers, so these filters expect readings by h, and predict by f.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.firmware.signals import Target, place_of_readings, reading_ranges, used_clearances
from malta.linear.matrices import eigenvalues
from malta.linear.sampling import sample
from malta.model.places import place_states
from malta.model.plant import Plant
from malta.synthesis.controller import Controller, noise_input
from malta.synthesis.riccati import dare

# Of the process noise's variance, for a filter that does without a sensor. For none at all the Kalman filter is the one
# of least gain that is stable: two unstable modes seen by one sensor take large gains, which noise and errors grow by.
# One that keeps its estimates of disturbances has to follow new ones by its other states, and so has to be faster.
TRUST, TRUST_KEPT = 3e-8, 5e-5
PLACES = 9  # along the stroke, for which there are such gains


class ReducedFilterGains(NamedTuple):
    """Gains L of filters that do without one sensor each, at places along the stroke."""

    places: FloatArray  # g, of the stroke; one of 0 for a machine without a stroke
    L: dict[int, FloatArray]  # by the sensor's index: g x n x p, its column zero


@lru_cache(maxsize=16)
def gains_without(t: Target) -> ReducedFilterGains:
    """Gains of Kalman filters that do without one sensor, for the prediction of prediction_correction at each place.

    The process noise is TRUST, or TRUST_KEPT, of the gain file's. Where the other sensors cannot see the disturbances
    that a design estimates, the filter of all other states is used and keeps the estimates of the disturbances. A
    sensor is left out of the answer where no filter of the others is stable, and all are without a record of the noise.
    """
    c, plant = t.controller, t.believed
    places = np.zeros(1)
    if plant.has_stroke and plant.stroke.travel:
        places = np.linspace(-plant.stroke.travel, plant.stroke.travel, PLACES)
    plain = c.tracks == "states" and c.schedule is None
    if c.noise is None or c.cost is None or not plain or len(c.measurements) < 2:
        return ReducedFilterGains(places, {})
    W, V = _process_noise(c), c.noise.sensor
    xi = ca.SX.sym("xi", len(c.states))
    derivatives = ca.Function(
        "derivatives",
        [xi],
        [ca.jacobian(prediction_correction(t)(xi), xi), ca.jacobian(expected_readings(t)(xi), xi)],
    )
    models = []
    for place in places:
        at = np.zeros(len(c.states))
        if plant.has_stroke:
            at[plant.controlled.index(plant.stroke_state)] = place
        more, C = (np.array(value) for value in derivatives(at))
        models.append((c.Ad + more, C))
    found = {}
    sizes = [(len(W), TRUST)]  # of what is filtered
    if c.observed:
        sizes.append((len(W) - len(c.forces), TRUST_KEPT))
    for k in range(len(c.measurements)):
        for n, trust in sizes:
            seen = [(A[:n, :n], C[:, :n]) for A, C in models]
            gains = [
                _gain_without(k, A, C, _reduce_noise(k, A, C, trust, W[:n, :n]), V)
                for A, C in seen
                if _sees_instability(k, A, C)
            ]
            stable = [np.vstack([L, np.zeros((len(W) - n, len(V)))]) for L in gains if L is not None]
            if len(stable) == len(models):
                found[k] = np.array(stable)
                break
    return ReducedFilterGains(places, found)


def _process_noise(c: Controller) -> FloatArray:
    """The process noise's covariance over a sample, of all states of the filter."""
    assert c.noise is not None
    assert c.cost is not None
    n, size = len(c.A), len(c.Ad)
    G = sample(c.A, noise_input(c.B, c.cost.coordinates), c.sample_time)[1]
    W = np.zeros((size, size))
    W[:n, :n] = G * c.noise.process @ G.T
    if c.observed:
        drift = np.diag(c.noise.drift)
        if c.cost.coordinates == "positions":
            back = np.linalg.inv(c.B[n // 2 :])
            drift = back @ drift @ back.T
        W[-len(c.forces) :, -len(c.forces) :] = drift
    return W


def _reduce_noise(k: int, A: FloatArray, C: FloatArray, trust: float, W: FloatArray) -> FloatArray:
    """The process noise, with this share of it for the states that act on sensor k; the others keep theirs.

    A filter that trusts its prediction of a stroke lags behind it, and so looks up its loads at another place.
    """
    acts = np.abs(C[k]) > 0
    couples = np.abs(A) > ROUNDING * np.abs(A).max(axis=1, keepdims=True)
    for _ in range(len(A)):
        acts = acts | couples[acts].any(axis=0)
    share = np.where(acts, math.sqrt(trust), 1.0)
    return share[:, None] * W * share


def _sees_instability(k: int, A: FloatArray, C: FloatArray) -> bool:
    """Whether the sensors without k see every mode of A that does not decay (Hautus)."""
    others = np.delete(C, k, axis=0)
    rows = np.abs(A).max(axis=1, keepdims=True)
    scale = np.where(rows > 0, rows, 1.0)  # a delayed force remembers nothing
    seen = others / (np.abs(others).max() or 1.0)
    for pole in eigenvalues(A):
        if abs(pole) >= 1 - 1e-9:
            pencil = np.vstack([(A - pole * np.eye(len(A))) / scale, seen])
            if np.linalg.matrix_rank(pencil, tol=1e-9) < len(A):
                return False
    return True


def _gain_without(k: int, A: FloatArray, C: FloatArray, W: FloatArray, V: FloatArray) -> FloatArray | None:
    """The filter's gain without sensor k; None where there is no stable one."""
    others = [j for j in range(len(C)) if j != k]
    rest = C[others]
    try:
        P = dare(A.T, rest.T, W, np.diag(V[others]), what="filter without a sensor").X
    except (CheckError, np.linalg.LinAlgError):
        return None
    L = np.zeros((len(A), len(C)))
    L[:, others] = np.linalg.solve(rest @ P @ rest.T + np.diag(V[others]), rest @ P).T
    stable = np.abs(eigenvalues((np.eye(len(A)) - L @ C) @ A)).max() < 1
    return L if stable else None


def expected_readings(t: Target) -> ca.Function:
    """xi_pred -> readings that the filter expects: h of the machine, where C at the operating point is not enough.

    With two sensors less one, the filter sees a tilt by the levers of the sensor that is left, which a stroke moves.
    """
    c, plant = t.controller, t.believed
    xi = ca.SX.sym("xi_pred", len(c.states))
    x = place_states(plant, xi[: len(plant.controlled)])
    y = ca.densify(plant.h(x, ca.SX.zeros(len(plant.inputs))))
    return ca.Function("expected", [xi], [y], ["xi_pred"], ["y"])


def prediction_correction(t: Target) -> ca.Function:
    """xi_hat -> what a sample of the machine's equations adds to the linear model of the filter, by Euler's method.

    Ts (f(x, u0 + u, 0) - f(0, u0, 0) - A x - B u) for the mechanical states, with the forces u that act by the filter's
    own states; 0 for a model without such states. u0 is what acts at rest, as a voltage that holds a sphere, and what
    is left of f there cancels the loads.
    """
    c, plant = t.controller, t.believed
    xi = ca.SX.sym("xi_hat", len(c.states))
    n, m = len(c.A), len(c.forces)
    x = place_states(plant, xi[: len(plant.controlled)])
    u = xi[n : n + m] if c.lagging + c.stored else ca.SX.zeros(m)
    held, outside = ca.DM(plant.at().u), ca.SX.zeros(len(plant.disturbances))
    rate = plant.f(x, held + u, outside) - plant.f(
        ca.DM.zeros(len(plant.states)), held, ca.DM.zeros(outside.shape)
    )
    rate = rate[list(plant.controlled)]
    linear = ca.sparsify(ca.DM(c.A)) @ xi[:n] + ca.sparsify(ca.DM(c.B)) @ u
    more = ca.vertcat(c.sample_time * (rate - linear), ca.SX.zeros(len(c.states) - n))
    return ca.Function("correction", [xi], [ca.densify(more)], ["xi_hat"], ["more"])


State = Literal[
    "OFF", "OFFSETS", "SENSORS", "LIFT", "SETTLE", "OPERATE", "HOLD", "LANDING", "FAULT", "WIRING"
]
Reaction = Literal["NONE", "IGNORE", "HOLD", "LAND", "FAULT"]

STATES: dict[State, str] = {
    "OFF": "bridges at zero voltage",
    "OFFSETS": "bridges at zero voltage; readings of the currents are averaged",
    "SENSORS": "bridges at zero voltage; readings of positions are checked and averaged",
    "LIFT": "from the place where the machine rests to zero; a stroke stays where it is",
    "SETTLE": "at zero, until the errors are small",
    "OPERATE": "the reference of the request",
    "HOLD": "the reference stops; operation goes on when no monitor of it is over its threshold",
    "LANDING": "to the place where the machine rested, with its stroke",
    "FAULT": "bridges at zero voltage, until acknowledged",
}
REACTIONS: tuple[Reaction, ...] = ("NONE", "IGNORE", "HOLD", "LAND", "FAULT")
IN_FLIGHT: tuple[State, ...] = ("LIFT", "SETTLE", "OPERATE", "HOLD", "LANDING")
IN_OPERATION: tuple[State, ...] = ("SETTLE", "OPERATE", "HOLD")
IN_USE: tuple[State, ...] = ("OFFSETS", "SENSORS", *IN_FLIGHT)
TRANSITIONS: tuple[tuple[State, str, State], ...] = (
    ("OFF", "START", "OFFSETS"),
    ("OFFSETS", "DONE", "SENSORS"),
    ("OFFSETS", "LAND", "OFF"),
    ("SENSORS", "DONE", "LIFT"),
    ("SENSORS", "LAND", "OFF"),
    ("LIFT", "DONE", "SETTLE"),
    ("SETTLE", "DONE", "OPERATE"),
    ("OPERATE", "HOLD", "HOLD"),
    ("HOLD", "DONE", "OPERATE"),
    *((state, "LAND", "LANDING") for state in IN_FLIGHT if state != "LANDING"),
    ("LANDING", "DONE", "OFF"),
    *((state, "FAULT", "FAULT") for state in IN_USE),
    ("FAULT", "ACKNOWLEDGE", "OFF"),
)
WIRING_STATES: dict[State, str] = {"WIRING": "small voltages; what sensors and currents answer is looked at"}
WIRING_TRANSITIONS: tuple[tuple[State, str, State], ...] = (
    ("SENSORS", "WIRE", "WIRING"),
    ("WIRING", "DONE", "LIFT"),
    ("WIRING", "LAND", "OFF"),
    ("WIRING", "FAULT", "FAULT"),
)


def transitions_of(*, wiring: bool) -> tuple[tuple[State, str, State], ...]:
    """The transitions of a supervisor: from a state, by an event, to another state."""
    return (*TRANSITIONS, *WIRING_TRANSITIONS) if wiring else TRANSITIONS


def states_of(t: Target) -> dict[State, str]:
    """The states of a target's supervisor, each with its meaning, in the order of their numbers."""
    return STATES | (WIRING_STATES if t.wiring else {})


def monitor_names(t: Target) -> tuple[str, ...]:
    """The names of monitors, in the order of their numbers."""
    return (*MONITORS, "WIRING") if t.wiring else MONITORS


MONITORS = (
    *(
        "TOUCH",
        "FOLLOWING",
        "RANGE",
        "RATE",
        "INNOVATION",
        "STROKE",
        "STUCK",
        "STALE",
        "NAN",
        "UNBELIEVED",
        "BLIND",
    ),
    *("ASTRAY", "HELPLESS", "MISSED", "CURRENT", "OFFSET", "LINK", "SATURATION", "REFERENCE"),
    *(
        "UNSETTLED",
        "UNREADY",
        "CURRENT_LOST",
        "CURRENT_INFERRED",
        "CURRENT_SUM",
        "CURRENT_FROZEN",
        "CURRENT_ERROR",
        "CURRENT_EXCESS",
        "OVERVOLTAGE",
        "OVERRUN",
    ),
    *("STOP", "STO"),
)

ROUNDING = 1e-9  # share of what a sum of products consists of, below which it is zero
MOST_RATE = 1e6  # of a reference, per s and s^2: beyond, single precision has no room
SAMPLES_ACROSS = 5  # in which a reference goes half of its way, at most: one that jumps stops nowhere
TOUCH = 0.7  # share of a clearance: two outputs at it are not beyond the clearance of a round bearing
JUMP = 8.0  # standard deviations of readings that a jump, an innovation or a returning reading may have
# A reading that repeats so often while the reference of a lift or a landing goes so many of its standard deviations is
# stuck: within the time that noise allows, a law that follows such a reading throws the machine against its bearing.
REPEATS, UNMOVED_DEVIATIONS = 12, 16.0
FALSE_ALARM = 1e-15  # probability at a sample that working sensors repeat a value as long as a stuck one
# By so many deviations, and what disturbances can do in so many samples, a reading may leave what the filter expects.
LEAP, LEAP_SAMPLES = 8.0, 4
HELD_SAMPLES = 3  # in which a sensor that leapt may turn out to be noisy, and nothing is corrected
DISTURBANCE_SHARE = 0.05  # of the largest acceleration: a machine may leave the filter's prediction by it
# Share of the largest acceleration with which references stop. Twice as much takes the voltage that the bearings need
# when the link sags by 90 %, and ends in a touchdown.
STOPPING_SHARE = 0.1
EXCITATION_SHARE = 0.5  # of the limits of forces, that an excitation may have in operation
HELPLESS_SAMPLES = 10  # with a force at its limit and a sensor ignored, until it is a fault
BRIDGED_SAMPLES = 10  # most samples for which a sensor is ignored before the reference stops
# Good readings in a row until an ignored sensor is believed again, and the share of the way to a touchdown by which
# they may be off what the filter expects: one that follows more of it throws the machine.
AGREEMENT, BELIEVED_SHARE = 3, 0.1
# How often a sensor was wrong is remembered for so many believed readings, up to so many times: one that errs again and
# again, as by a bit that sticks, would be followed in between.
LAPSE_SAMPLES, MOST_LAPSES = 400, 4
# A stroke has room to be thrown: its sensor lies when it is so many deviations off what the filter expects.
LOST_WAY = 16.0
# Shares of a cushioned clearance, or of the travel, that a reading may be off its reference; times FREER in a lift and
# a landing, where bearings push.
ASTRAY_SHARE, ASTRAY_STROKE, FREER = 0.4, 0.1, 2.5
SETTLED_DEVIATIONS = 12.0  # standard deviations of readings that errors may have
SAG_SHARE = 0.3  # share of the link's voltage that is missing
OFFSET = 0.02  # largest offset of a current sensor as a share of the current limit
OVERVOLTAGE = 0.2  # share of the link's voltage that is too much
LOST_CURRENT = 5  # samples without a reading of a current: a loop that acts on an old one drives it away
TORN_SHARE = (
    0.3  # the same, for gates off at once: a loop that follows a wrong reading drives its current away
)
IMBALANCE_SHARE = 0.04  # of the current limit: the sum of a star's currents, with its sensors' offsets
# Shares of the current limit, on average over MEAN samples: by the first a current may miss its command, else it lands
# after MISSES samples; by the second it may exceed it, else it is off at once. What stays below its command pushes no
# harder than was meant, and a landing with it is slower than a fall.
ASTRAY_CURRENT, LOST_CONTROL = 0.1, 0.6
MEAN = 32.0
MISSES = 100
FROZEN_SAMPLES = (
    8  # in which one reading of an uneven star repeats: it is the wrong one, and the others tell it
)
FREEZE = 20  # samples in which no current of a star changes although the commands do
LATENESS = (0.2, 0.5)  # share of missed steps, averaged over MEMORY samples: hold, land
RESERVED_SHARE = 0.1  # share of a way to a touchdown or of a travel that references leave free
OVERCURRENT_FACTOR = 1.2  # a current is too large, as a multiple of what the limits of the axes can add up to


class Times(NamedTuple):
    """Durations in samples."""

    offsets: int  # averaged readings of the currents
    check: int  # samples in a row with readings of all positions that can be true
    lift: int
    settle: int  # samples in a row with small errors
    fade: int  # from one reference to that of the request
    landing: int
    calm: int  # samples in a row without a cause to hold


TIMES = Times(offsets=200, check=200, lift=1000, settle=200, fade=1000, landing=4000, calm=200)


class Monitor(NamedTuple):
    """A row of the table of monitors: it acts when its level is over a threshold for so many samples in a row."""

    key: str
    level: str  # in words
    threshold: float
    samples: int
    reaction: Reaction
    states: tuple[State, ...]  # in which it counts


@dataclass(frozen=True, eq=False)
class MonitorLimits:
    """Limits of the p outputs, of currents and of times, from the gain file and its machine; inf: none."""

    touch: FloatArray  # p, of readings: near a touchdown or the end of the travel
    range: FloatArray  # p, of readings: see signals.reading_ranges
    jump: FloatArray  # p, of readings from sample to sample
    leap: FloatArray  # p, of what a reading is off the filter's prediction, from sample to sample
    sigma: FloatArray  # p, standard deviation of a reading, with its resolution
    unmoved: FloatArray  # p, of references while a reading repeats
    settled: FloatArray  # p, of errors
    drift: FloatArray  # p, of what the filter expects without readings, per sample^2
    nearest: FloatArray  # p, by which an ignored sensor may differ from them at most, to be believed again
    astray: FloatArray  # p, of readings off their references
    stopping: FloatArray  # p, per s^2, of a reference that stops
    stuck: tuple[int, ...]  # p, samples with one value from which on a sensor is stuck
    stale: int  # the same, of all sensors at once
    unbelieved: int  # samples that a sensor may be ignored
    bridged: int  # samples for which a sensor is ignored before the reference stops: before it lands
    current: float  # A, of a reading
    deviation: float  # A, of a current from its command, on average
    uneven: float  # A, of the currents of a star
    offset: float  # A, of a current sensor


@lru_cache(maxsize=16)
def bounds_of(t: Target) -> MonitorLimits:
    """The limits of a target's supervisor.

    Speeds: from rest through twice the way to a touchdown with the largest acceleration, v = sqrt(4 a d). A reading
    jumps by v Ts and JUMP standard deviations of a difference at most.

        bounds_of(Target(malta.gains.read("design/gains/robust.json"))).jump
    """
    c, plant = t.controller, t.believed
    sigma = plant.sensors.deviations
    touch, acceleration = touch_bounds(plant), accelerations(c)
    speed = np.sqrt(4 * acceleration * touch)
    known = np.where(sigma > 0, sigma, np.inf)
    quiet = np.where(np.isfinite(touch), 0.01 * touch, np.minimum(reading_ranges(plant), 1.0) / 100)
    strokes = np.arange(len(touch)) == (plant.stroke_output if plant.has_stroke else -1)
    unbelieved = _samples_without_reading(c)
    stopping = np.where(np.isfinite(acceleration), STOPPING_SHARE * acceleration, np.inf)
    stuck = tuple(_repetitions([p]) for p in repetition_probabilities(plant))
    drift = np.where(
        np.isfinite(acceleration), DISTURBANCE_SHARE / 2 * acceleration * c.sample_time**2, np.inf
    )
    return MonitorLimits(
        touch=touch,
        range=reading_ranges(plant),
        jump=speed * c.sample_time + math.sqrt(2) * JUMP * sigma,
        leap=np.where(strokes, np.inf, LEAP * known + LEAP_SAMPLES**2 * drift),
        sigma=known,
        settled=np.where(sigma > 0, SETTLED_DEVIATIONS * sigma, quiet),
        drift=drift,
        nearest=BELIEVED_SHARE * touch,
        astray=np.where(strokes, ASTRAY_STROKE, ASTRAY_SHARE) * touch,
        stopping=stopping,
        unmoved=np.where(np.array(stuck) < ENDLESS_SAMPLES, UNMOVED_DEVIATIONS * known, np.inf),
        stuck=stuck,
        stale=_repetitions(repetition_probabilities(plant)),
        unbelieved=unbelieved,
        bridged=min(BRIDGED_SAMPLES, unbelieved - 1),
        current=OVERCURRENT_FACTOR * largest_reading(t),
        offset=OFFSET * float(np.max(c.limits.current)) if t.driven else math.inf,
        deviation=ASTRAY_CURRENT * float(np.max(c.limits.current)) if t.driven else math.inf,
        uneven=IMBALANCE_SHARE * float(np.max(c.limits.current)) if t.driven else math.inf,
    )


def monitors_of(t: Target) -> tuple[Monitor, ...]:
    """The table of monitors: those that make sense for a target's machine, in the order in which they are counted."""
    b = bounds_of(t)
    checked: tuple[State, ...] = ("SENSORS", *IN_FLIGHT)
    moving: tuple[State, ...] = ("OPERATE", "HOLD")
    lifting: tuple[State, ...] = ("LIFT", "LANDING")
    ground: tuple[State, ...] = ("OFFSETS", "SENSORS")
    off = LOST_CONTROL / ASTRAY_CURRENT * b.deviation
    apart = TORN_SHARE / IMBALANCE_SHARE * b.uneven
    # Without a filter that does without the sensor, a fall is softer than a landing by prediction alone.
    without: Reaction = "LAND" if gains_without(t).L else "FAULT"
    listed = [
        Monitor("TOUCH", "reading over the bound of a touchdown", 1.0, 5, "LAND", IN_OPERATION),
        Monitor("TOUCH", "reading over the bound of a touchdown", 1.0, 5, "LAND", ("LIFT",)),
        Monitor("TOUCH", "reading over the bound of a touchdown", 1.3, 5, "FAULT", ("LANDING",)),
        Monitor("FOLLOWING", "error of a reading, by what it may be", 1.0, 3, "FAULT", IN_OPERATION),
        Monitor("FOLLOWING", "error of a reading, by what it may be", FREER, 3, "FAULT", lifting),
        Monitor("RANGE", "reading over what can be read", 1.0, 1, "IGNORE", checked),
        Monitor("RATE", "jump of a reading over what the machine can do", 1.0, 1, "IGNORE", IN_FLIGHT),
        Monitor("INNOVATION", "|y - h(xi_pred)| over sigma", JUMP, 20, "HOLD", moving),
        Monitor("INNOVATION", "|y - h(xi_pred)| over sigma", JUMP, 400, "LAND", moving),
        Monitor("STROKE", "|y - h(xi_pred)| of the stroke over sigma", LOST_WAY, 10, "FAULT", IN_FLIGHT),
        Monitor("STUCK", "repetitions over what noise or motion allow", 1.0, 1, "IGNORE", checked),
        Monitor("STALE", "repetitions of all sensors at once", b.stale - 0.5, 1, "IGNORE", checked),
        Monitor("NAN", "no number, or called invalid", 0.5, 1, "IGNORE", checked),
        Monitor("UNBELIEVED", "a sensor is ignored", 0.5, b.bridged, "HOLD", moving),
        Monitor("UNBELIEVED", "a sensor is ignored", 0.5, b.unbelieved, without, IN_FLIGHT),
        Monitor("BLIND", "all sensors are ignored", 0.5, b.unbelieved, "FAULT", IN_FLIGHT),
        Monitor(
            "ASTRAY", "expected reading where none can be, or no reference is", 1.0, 5, "FAULT", IN_FLIGHT
        ),
        Monitor(
            "HELPLESS", "a force at its limit, a sensor ignored", 0.5, HELPLESS_SAMPLES, "FAULT", IN_FLIGHT
        ),
        Monitor("MISSED", "missed steps before this one", 2.5, 1, "HOLD", moving),
        Monitor("MISSED", "missed steps before this one", b.unbelieved + 0.5, 1, "LAND", IN_FLIGHT),
        Monitor("OVERRUN", "share of samples after a missed step", LATENESS[0], 1, "HOLD", moving),
        Monitor("OVERRUN", "share of samples after a missed step", LATENESS[1], 1, "LAND", IN_FLIGHT),
        Monitor("STOP", "the request to stop", 0.5, 1, "FAULT", IN_USE),
        Monitor("STO", "safe torque off is active", 0.5, 1, "FAULT", IN_USE),
        Monitor("CURRENT", "largest reading of a current, A", b.current, 3, "FAULT", IN_USE),
        Monitor("OFFSET", "largest offset of a current sensor, A", b.offset, 1, "FAULT", ("OFFSETS",)),
        Monitor("CURRENT_LOST", "a current without a reading", 0.5, LOST_CURRENT, "FAULT", IN_USE),
        Monitor("CURRENT_INFERRED", "currents known by their stars", 0.5, LOST_CURRENT, "FAULT", ground),
        Monitor("CURRENT_INFERRED", "currents known by their stars", 0.5, LOST_CURRENT, "LAND", IN_FLIGHT),
        Monitor(
            "CURRENT_SUM", "currents of a star together, A", b.uneven, LOST_CURRENT, "FAULT", ("SENSORS",)
        ),
        Monitor("CURRENT_SUM", "currents of a star together, A", b.uneven, LOST_CURRENT, "LAND", IN_FLIGHT),
        Monitor("CURRENT_SUM", "currents of a star together, A", apart, 3, "FAULT", IN_FLIGHT),
        Monitor(
            "CURRENT_FROZEN", "samples without change, commands move", FREEZE - 0.5, 1, "FAULT", IN_FLIGHT
        ),
        Monitor(
            "CURRENT_ERROR", "mean of a current off its command, A", b.deviation, MISSES, "LAND", IN_FLIGHT
        ),
        Monitor("CURRENT_EXCESS", "mean of a current beyond its command, A", off, 1, "FAULT", checked),
        Monitor("OVERVOLTAGE", "surplus share of the link voltage", OVERVOLTAGE, 3, "FAULT", IN_USE),
        Monitor("LINK", "missing share of the link voltage", SAG_SHARE, 3, "FAULT", ("OFFSETS", "SENSORS")),
        Monitor("LINK", "missing share of the link voltage", SAG_SHARE, 3, "LAND", ("LIFT",)),
        Monitor("LINK", "missing share of the link voltage", SAG_SHARE, 3, "HOLD", moving),
        Monitor("LINK", "missing share of the link voltage", SAG_SHARE, 2000, "LAND", IN_OPERATION),
        Monitor("SATURATION", "a force is at its limit", 0.5, 200, "HOLD", moving),
        Monitor("SATURATION", "a force is at its limit", 0.5, 1000, "LAND", IN_OPERATION),
        Monitor("REFERENCE", "a request that is no number or out of reach", 0.5, 1, "HOLD", moving),
        Monitor("UNSETTLED", "samples without settling", 20.0 * TIMES.settle, 1, "LAND", ("SETTLE",)),
        Monitor("UNREADY", "samples without good readings", 8.0 * TIMES.check, 1, "FAULT", ("SENSORS",)),
    ]
    absent = absent_monitors(t)
    rows = tuple(row for row in listed if row.key not in absent)
    if not t.wiring:
        return rows
    own = Monitor("WIRING", "the wiring is not as expected", 0.5, 1, "FAULT", ("WIRING",))
    watched = tuple(
        row._replace(states=(*row.states, "WIRING")) if row.states in (IN_USE, ground) else row
        for row in rows
    )
    return (*watched, own)


def absent_monitors(t: Target) -> dict[str, str]:
    """The monitors that make no sense for a target's machine, each with the reason."""
    b = bounds_of(t)
    plant = t.believed
    stroke = plant.has_stroke and t.controller.tracks == "states"
    unlimited = not np.isfinite(t.controller.limits.force).any()
    faulty_at_once = len(t.controller.measurements) == 1 or not gains_without(t).L
    listed = (
        (not np.isfinite(b.touch).any(), "nothing is met", ("TOUCH", "FOLLOWING")),
        (
            not (stroke and np.isfinite(b.sigma[plant.stroke_output] + b.touch[plant.stroke_output])),
            "no filter knows a stroke",
            ("STROKE",),
        ),
        (not np.isfinite(b.jump).any(), "no speed is too large", ("RATE",)),
        (not np.isfinite(b.sigma).any(), "no noise of the sensors is known", ("INNOVATION",)),
        (min(b.stuck) >= ENDLESS_SAMPLES, "readings of a sensor that works repeat", ("STUCK",)),
        (b.stale >= ENDLESS_SAMPLES, "readings of sensors that work repeat", ("STALE",)),
        (
            not t.driven,
            "the drive has the current loops",
            ("CURRENT", "OFFSET", "CURRENT_LOST", "CURRENT_ERROR", "CURRENT_EXCESS", "OVERVOLTAGE", "LINK"),
        ),
        (
            not stars_of(t),
            "no phases of a star are read",
            ("CURRENT_INFERRED", "CURRENT_SUM", "CURRENT_FROZEN"),
        ),
        (unlimited, "forces have no limits", ("HELPLESS", "SATURATION")),
        (
            faulty_at_once and b.unbelieved < HELPLESS_SAMPLES and not unlimited,
            "a sensor that is ignored so long is a fault already",
            ("HELPLESS",),
        ),
    )
    return {key: reason for absent, reason, keys in listed if absent for key in keys}


def repetition_probabilities(plant: Plant) -> list[float]:
    """The largest probability of each output that a reading of a machine at rest is that of the sample before.

    Normal noise s in steps q stays within the step about its mean with erf(q / (2 sqrt(2) s)); without steps, numbers
    do not repeat. Of a sensor without noise: 1, it may repeat for ever.
    """
    found = []
    for noise, step in zip(plant.sensors.noise, plant.sensors.resolution, strict=True):
        inside = math.erf(step / (2 * math.sqrt(2) * noise)) if noise else 1.0
        found.append(min(max(inside, 1e-12), 1.0))
    return found


ENDLESS_SAMPLES = 1_000_000_000  # samples: never


def _repetitions(probabilities: list[float]) -> int:
    """Repetitions that are less likely than FALSE_ALARM for sensors that repeat with these probabilities."""
    together = sum(math.log(p) for p in probabilities)
    return ENDLESS_SAMPLES if together > -1e-6 else max(2, math.ceil(math.log(FALSE_ALARM) / together))


def touch_bounds(plant: Plant) -> FloatArray:
    """The reading of each output, the others zero, at which TOUCH of a cushioned clearance is used up, or another one.

    Infinite where nothing is met.
    """
    bounds = np.where(np.array(plant.contacts.cushioned, dtype=bool), TOUCH, 1.0)
    shares = used_clearances(plant)

    def share_used(k: int, reading: float) -> float:
        return float((shares(k, reading) / bounds).max(initial=0.0))

    found = []
    for k, most in enumerate(reading_ranges(plant)):
        low, high = 0.0, float(most)
        if max(share_used(k, high), share_used(k, -high)) < 1 or share_used(k, 0.0) >= 1:
            found.append(math.inf)
            continue
        for _ in range(40):
            middle = (low + high) / 2
            if max(share_used(k, middle), share_used(k, -middle)) < 1:
                low = middle
            else:
                high = middle
        found.append(low)
    return np.array(found)


def accelerations(c: Controller) -> FloatArray:
    """The largest accelerations of the outputs, p'' = C A B v within the limits of the forces; inf without limits.

    Of a machine whose states are not positions and rates, p' = C B v is not zero: inf.
    """
    if np.abs(c.C @ c.B).max(initial=0.0) > 0:
        return np.full(len(c.measurements), math.inf)
    gain = np.abs(c.C @ c.A @ c.B)
    limits = np.asarray(c.limits.force, dtype=float)
    return np.array([np.sum(row[row > 0] * limits[row > 0]) or math.inf for row in gain])


def reachable_rates(c: Controller, way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Speeds and accelerations that the forces reach over a way d of each output; inf without limits.

    The first derivative that the forces set at once is y^(r), at most J = |C A^(r-1) B| v within their limits. By it
    the output goes d within about T = (d / J)^(1/r), with accelerations of d / T^2, J itself for r = 2, and speeds of
    at most J for r = 1.
    """
    limits = np.asarray(c.limits.force, dtype=float)
    speeds, accelerations = np.full(len(way), math.inf), np.full(len(way), math.inf)
    power, size = np.eye(len(c.A)), np.eye(len(c.A))
    for r in range(1, len(c.A) + 1):
        gain, scale = np.abs(c.C @ power @ c.B), np.abs(c.C) @ size @ np.abs(c.B)
        for k in np.flatnonzero(np.isinf(accelerations) & (gain > ROUNDING * scale).any(axis=1)):
            acts = gain[k] > ROUNDING * scale[k]
            J = float(np.sum(gain[k, acts] * limits[acts]))
            accelerations[k] = way[k] * (J / way[k]) ** (2 / r)
            speeds[k] = J if r == 1 else math.inf
        power, size = power @ c.A, size @ np.abs(c.A)
    return speeds, accelerations


def stars_of(t: Target) -> tuple[tuple[int, ...], ...]:
    """The current readings that add up to zero, by index: those of one star point each; none of axes."""
    return tuple(t.believed.drive.stars) if t.driven and t.fidelity == "phase" else ()


def current_deviations(t: Target) -> ca.Function:
    """(i, expected readings, commanded currents of the coils) -> currents of the axes off their commands and beyond, A.

    Readings of phases are turned to axes where the filter expects the machine.
    """
    plant, drive = t.believed, t.believed.drive
    i, current = ca.SX.sym("i", len(t.current_readings)), ca.SX.sym("current", len(plant.actuator.coils))
    y = ca.SX.sym("expected", len(plant.outputs))
    axes = drive.to_axes(place_of_readings(plant, y)) @ i if t.fidelity == "phase" else i
    command = drive.command(current)
    off, beyond = ca.densify(command - axes), ca.densify(ca.fabs(axes) - ca.fabs(command))
    names = ["i", "expected", "current"], ["off", "beyond"]
    return ca.Function("deviation", [i, y, current], [off, beyond], *names)


class ReferenceLimits(NamedTuple):
    """What references may be at most, either way, of the p outputs."""

    position: FloatArray  # in the unit of the output
    speed: FloatArray  # per s
    acceleration: FloatArray  # per s^2


@lru_cache(maxsize=16)
def reference_limits(t: Target) -> ReferenceLimits:
    """The limits of references: of the design file, or by default those of the machine.

    Positions: RESERVED_SHARE less than the way to a touchdown or the travel; else the range of its readings.
    Accelerations: all that the forces can do, and at most what a sampled reference shows, which takes SAMPLES_ACROSS
    samples for half of its way. Speeds: from rest through twice the way with that, v = sqrt(4 a d). Of a
    machine whose states are not positions and rates: see reachable_rates.

    Raises InputError for a position beyond the way to a touchdown, the travel, or what can be read.
    """
    touch, most = touch_bounds(t.believed), accelerations(t.controller)
    position = np.where(np.isfinite(touch), (1 - RESERVED_SHARE) * touch, reading_ranges(t.believed))
    fastest, steepest = reachable_rates(t.controller, position)
    sampled = position / (SAMPLES_ACROSS * t.controller.sample_time) ** 2
    acceleration = np.minimum(np.where(np.isfinite(most), most, steepest), np.minimum(sampled, MOST_RATE))
    speed = np.minimum(np.minimum(np.sqrt(4 * acceleration * position), fastest), MOST_RATE)
    limits = ReferenceLimits(*(_written_limits(values) for values in (position, speed, acceleration)))
    if not t.controller.references.size:
        return limits
    reach = np.minimum(touch, reading_ranges(t.believed))
    for s, asked, end in zip(t.controller.measurements, t.controller.references[0], reach, strict=True):
        if asked > end:
            raise InputError(
                t.controller.name,
                f"references.position.{s.name}",
                f"{asked:.6g} {s.unit}",
                f"at most {end:.6g}",
            )
    asked_for = zip(t.controller.references, limits, strict=True)
    return ReferenceLimits(*(np.where(given > 0, given, own) for given, own in asked_for))


def _written_limits(values: FloatArray) -> FloatArray:
    """Limits of as many digits as texts have, not above the values: what a reader types is within them."""
    nearest = np.array([float(f"{v:.8g}") for v in values])
    below = np.array([float(f"{v * (1 - 5e-8):.8g}") for v in values])
    return np.where(nearest <= values * (1 + ROUNDING), nearest, below)


def _samples_without_reading(c: Controller) -> int:
    """Samples in which an error of the filter's prediction doubles by the machine's fastest instability; 5 to 200."""
    fastest = float(eigenvalues(np.asarray(c.A)).real.max(initial=0.0))
    doubling = math.log(2) / (fastest * c.sample_time) if fastest > 0 else math.inf
    return int(min(max(doubling, 5), 200))


def largest_reading(t: Target) -> float:
    """A: a bound of what a current sensor reads with all axes at their limits, at any place of the travel; else inf."""
    if not t.driven:
        return math.inf
    plant, drive = t.believed, t.believed.drive
    axes = np.abs(np.array(ca.DM(drive.command(ca.DM(t.controller.limits.current))))).ravel()
    if t.fidelity == "dq":
        return float(axes.max())
    places = np.linspace(-plant.stroke.travel, plant.stroke.travel, 101) if plant.has_stroke else np.zeros(1)
    largest = 0.0
    for place in places:
        x = plant.at(**({plant.stroke.name: place} if plant.has_stroke else {})).x
        largest = max(largest, float((np.abs(np.array(ca.DM(drive.to_phases(ca.DM(x))))) @ axes).max()))
    return largest
