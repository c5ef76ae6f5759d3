"""Whatever one fault or request: no contact much faster than one of gates off, no current for long above its limit.

A seeded search over kinds, sizes, moments, states and axes; then the worst cases again, nearby. The supervised C flies
with the C of its nonlinear machine: see rig.c.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from exported import require, target
from rig import KINDS, Moment, Outcome, Rig, Strike, strike

from malta.firmware.supervisor import reference_limits

MARGIN = 0.03  # m/s, by which a contact may be faster than the fastest one of gates off
LONGEST = 2e-3  # s, that a current may be above its limit
LIFT, FLIGHT, END = 0.02, 0.1, 0.28  # s, begin of the lift, of a stroke back and forth, and the end
LANDING = 0.16  # s, of the request to land
RADIAL, AXIAL = (0, 1, 2, 3), 4


class Case(NamedTuple):
    """A fault or request in a flight."""

    strike: Strike
    found: Outcome
    over: float  # m/s, by which the fastest contact exceeds that of gates off at most


@cache
def rig() -> Rig:
    require("gcc")
    return Rig(replace(target("robust", "double"), excited=True))


@cache
def flights() -> tuple[tuple[float, Moment], ...]:
    """A flight of lift, operation, strokes and landing, to go on from at every 5 ms."""
    moment, found = rig().begin(stroke=FLIGHT, rise=0.02, end=8e-3, land=LANDING), []
    for t in np.arange(0.0, END, 5e-3):
        _, moment = rig().fly(moment, float(t))
        found.append((float(t), moment))
    return tuple(found)


def fly(s: Strike) -> Outcome:
    """The flight with a fault or request, until it rests."""
    moment = max((row for row in flights() if row[0] <= s.at), key=lambda row: row[0])[1]
    return rig().fly(moment, s.at + 0.3, s)[0]


@cache
def gates_off() -> tuple[float, dict[int, float]]:
    """The fastest radial contact of gates that go off at any moment, and the axial one by the moment in ms."""
    outcomes = {k: fly(strike("STO", 1e-3 * k)) for k in range(21, 280, 3)}
    return max(o.radial for o in outcomes.values()), {k: o.axial for k, o in outcomes.items()}


def case(s: Strike) -> Case:
    radial, axial = gates_off()
    found = fly(s)
    end = s.at + max(found.off, 0.0) + 10e-3
    near = max((v for k, v in axial.items() if s.at - 10e-3 < 1e-3 * k < end), default=0.0)
    return Case(s, found, max(found.radial - radial, found.axial - near))


def draw(rng: np.random.Generator) -> Strike:
    """A fault or request: its kind, place, size, moment and how long it lasts."""
    kind = str(rng.choice(list(SIZES)))
    places, low, high, rates = SIZES[kind]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))) * rng.choice([-1, 1]))
    place = int(rng.choice(places))
    if place == AXIAL and kind in ("JUMP", "DRIFT", "NOISY"):
        size *= 20
    at = float(rng.uniform(LIFT, END - 0.06))
    lasts = float(np.inf if rng.random() < 0.5 else np.exp(rng.uniform(np.log(2e-4), np.log(0.1))))
    return strike(kind, at, place, size, float(rng.uniform(*rates)), at + lasts)


SENSORS, CURRENTS = (*RADIAL, AXIAL), tuple(range(18))
# places, least and largest size, least and largest rate
SIZES: dict[str, tuple[tuple[int, ...], float, float, tuple[float, float]]] = {
    "LOST": (SENSORS, 1, 2, (0, 0)),
    "STUCK": (SENSORS, 1, 2, (0, 0)),
    "JUMP": (SENSORS, 5e-6, 8e-4, (0, 0)),
    "DRIFT": (RADIAL, 1e-3, 1.0, (0, 0)),
    "NOISY": (SENSORS, 1e-6, 5e-5, (0, 0)),
    "CURRENT_BIAS": (CURRENTS, 0.1, 10, (0, 0)),
    "CURRENT_STUCK": (CURRENTS, 0.1, 10.1, (0, 0)),
    "CURRENT_FROZEN": (CURRENTS, 1, 2, (0, 0)),
    "CURRENT_GAIN": (CURRENTS, 0.1, 2, (0, 0)),
    "CURRENT_LOST": (CURRENTS, 1, 2, (0, 0)),
    "LINK": ((0,), 0.3, 1.5, (0, 0)),
    "MISSED": ((0,), 1, 60, (0, 0)),
    "EXCITED": (SENSORS, 1, 50, (0, 0)),
    "BIT": (SENSORS, 1e-6, 2e-4, (0, 0)),
    "BURST": (SENSORS, 0.05, 1, (0, 0)),
    "PAIR_DRIFT": (RADIAL, 1e-3, 1.0, (-1, 1)),
    "CURRENT_DRIFT": (CURRENTS, 0.5, 20, (0, 0)),
    "SAG": ((0,), 0.02, 1, (1, 50)),
    "ASK_TOGGLE": (SENSORS, 1e-5, 1.35e-2, (20, 2000)),
    "ASK_SINE": (SENSORS, 1e-4, 2e-2, (1, 200)),
    "ASK_ACCELERATION": (SENSORS, 1, 1000, (-13e-3, 13e-3)),
    "ASK_RAMP": (SENSORS, 1e-4, 2e-2, (0.01, 3)),
    "ASK_STEP": (SENSORS, 1e-5, 2e-2, (0, 0)),
    "ASK_RATE": (SENSORS, 0.01, 3, (-150, 150)),
    "ASK_NAN": (SENSORS, 1, 2, (0, 0)),
}


def search(count: int, seed: int) -> list[Case]:
    """So many cases, the worst first; a tenth of them near the worst of the others, ever nearer."""
    rng = np.random.default_rng(seed)
    cases = [case(draw(rng)) for _ in range(count - count // 10)]
    for k in range(count // 10):
        worst = sorted(cases, key=lambda one: -one.over)[k % 10].strike
        reach = 0.5 ** (1 + k // 20)
        at = float(np.clip(worst.at + reach * 5e-3 * rng.uniform(-1, 1), LIFT, END))
        until = at + (worst.until - worst.at)
        near = Strike(
            worst.kind, worst.place, worst.size * (1 + reach * rng.uniform(-1, 1)), worst.rate, at, until
        )
        cases.append(case(near))
    return sorted(cases, key=lambda one: -one.over)


# What one sensor says without being wrong at once shows late, or as a motion: contacts are up to so much faster there.
# What one fault or request can still do, m/s: see "supervised" in docs/howto/firmware.md. Of 1300 drifts the worst had
# 0.158, of 2000 cases of all kinds 0.028. Two at a time leave one sensor for two unstable modes, and it lies.
LATE = {
    "DRIFT": 0.2,
    "PAIR_DRIFT": 0.2,
    "ASK_RAMP": 0.08,
    "ASK_SINE": 0.08,
    "CURRENT_STUCK": 0.05,
    "CURRENT_GAIN": 0.05,
    "CURRENT_BIAS": 0.05,
}


def assert_invariant(cases: list[Case]) -> None:
    for one in cases:
        kind = KINDS[one.strike.kind]
        assert one.over < LATE.get(kind, MARGIN), (
            kind,
            one.strike.place,
            one.strike.size,
            one.strike.at,
            one.found,
        )
        assert one.found.beyond < LONGEST, (kind, one.strike.place, one.strike.size, one.strike.at, one.found)
        assert not one.found.spoiled, kind


@pytest.mark.slow
def test_no_fault_and_no_request_is_much_worse_than_gates_off() -> None:
    assert 0.15 < gates_off()[0] < 0.3
    assert_invariant(search(40, 3))


@pytest.mark.slow
def test_nor_is_the_worst_of_two_thousand() -> None:
    assert_invariant(search(2000, 4))


# Each a fault or a request that threw the machine once: what, how fast contacts may be at most (m/s), and who saw it.
THROWN = (
    ("a slip of the stroke", strike("JUMP", 0.125, AXIAL, 7.5e-3), 0.05, 0.01, "RATE"),
    ("a jump of a radial sensor", strike("JUMP", 0.125, 0, 8e-4), 0.1, 0.01, "RATE"),
    ("an inverted stroke", strike("GAIN", 0.125, AXIAL, -1.0), 0.22, 0.03, "INNOVATION"),
    ("an inverted radial sensor", strike("GAIN", 0.125, 1, -1.0), 0.27, 0.03, "FOLLOWING"),
    ("a current stuck at 10.1 A", strike("CURRENT_STUCK", 0.125, 2, 10.1), 0.27, 0.03, "CURRENT_SUM"),
    ("a force left on", strike("EXCITED", 0.125, 1, 20.0), 0.01, 0.01, ""),
    ("a sine beyond the travel", strike("ASK_SINE", 0.125, AXIAL, 20e-3, 10.0), 0.01, 0.01, "REFERENCE"),
    ("all acceleration outward", strike("ASK_ACCELERATION", 0.125, AXIAL, 140.0), 0.01, 0.01, "REFERENCE"),
    ("a ramp of places alone", strike("ASK_RAMP", 0.125, AXIAL, 13.4e-3, 1.0), 0.01, 0.01, ""),
)


@pytest.mark.parametrize(
    ("s", "radial", "axial", "monitor"), [row[1:] for row in THROWN], ids=[r[0] for r in THROWN]
)
def test_what_threw_the_machine_once(s: Strike, radial: float, axial: float, monitor: str) -> None:
    """In operation, at rest at the middle: from 0.4 to 1.8 m/s before."""
    _, moment = rig().fly(rig().begin(), 0.12)
    found, _ = rig().fly(moment, 0.4, s)
    assert found.radial < radial
    assert found.axial < axial
    assert found.monitor == monitor


@pytest.mark.slow
def test_a_reading_that_is_no_number_spoils_no_monitor() -> None:
    """Each position sensor before operation, for a sample: currents that are wrong afterwards are found as before."""
    for k in range(5):
        found, moment = rig().fly(rig().begin(), 0.12, strike("LOST", 0.005, k, until=0.00504))
        assert not found.spoiled
        found, _ = rig().fly(moment, 0.2, strike("CURRENT_STUCK", 0.125, 2, 10.1))
        assert (found.monitor, found.spoiled) == ("CURRENT_SUM", 0)


def test_requests_of_places_alone_become_strokes_within_the_limits() -> None:
    """A ramp of 1 m/s ends without a rate of its own: the reference brakes, does not pass its end, and rests there."""
    _, moment = rig().fly(rig().begin(), 0.12)
    rows = rig().trace(moment, 0.2, strike("ASK_RAMP", 0.125, AXIAL, 13.4e-3, 1.0))
    p, dp = rows[:, 12 + AXIAL], rows[:, 17 + AXIAL]
    limits = reference_limits(rig().t)
    Ts = rig().t.controller.sample_time
    assert p.max() == p[-1] == 13.4e-3
    assert dp[-1] == 0
    assert np.abs(np.diff(dp)).max() < 0.751 * limits.acceleration[AXIAL] * Ts
    assert np.abs(np.diff(p) - Ts * (dp[1:] + dp[:-1]) / 2).max() < limits.acceleration[AXIAL] * Ts**2 / 2


def test_a_request_that_is_feasible_is_followed_as_it_is() -> None:
    """Once the fade from the place of rest is over: no digit of the stroke is moved."""
    rows = rig().trace(rig().begin(stroke=FLIGHT, rise=0.02, end=8e-3), 0.15)
    at = rows[:, 0] > 0.135
    u = (rows[at, 0] - FLIGHT) / 0.02
    turn = np.floor(u)
    u = u - turn
    back = turn % 2 == 1
    p = np.where(back, 8e-3, 0) + np.where(back, -8e-3, 8e-3) * (u**3 * (10 - u * (15 - 6 * u)))
    assert np.abs(rows[at, 12 + AXIAL] - p).max() < 1e-15


def test_a_half_bridge_that_sticks_is_carried_and_lands() -> None:
    """Its currents are off their commands: following errors are real, and the law goes on until it has landed."""
    _, moment = rig().fly(rig().begin(), 0.12)
    for k in (0, 3, 9):
        found, _ = rig().fly(moment, 0.43, strike("HALF_BRIDGE", 0.125, k, 0.0))
        assert found.state == "OFF"
        assert found.radial < 0.005


def test_an_excitation_acts_in_operation_alone() -> None:
    """10 N on a bearing: seen in operation, and in a landing none of it."""
    _, moment = rig().fly(rig().begin(land=0.13), 0.12)
    force = strike("EXCITED", 0.1321, 1, 10.0)
    assert np.array_equal(rig().trace(moment, 0.2), rig().trace(moment, 0.2, force))
    _, moment = rig().fly(rig().begin(), 0.12)
    rows = rig().trace(moment, 0.2, force)
    assert np.abs(rows[:, 2 + 1]).max() > 2 * np.abs(rig().trace(moment, 0.2)[:, 2 + 1]).max()


@pytest.mark.parametrize(
    ("kind", "size"), [("LOST", 0.0), ("STUCK", 0.0), ("BURST", 0.5), ("BIT", 1e-4), ("JUMP", 2e-4)]
)
def test_a_landing_from_a_stroke_does_without_a_sensor(kind: str, size: float) -> None:
    """Gates off are 0.23 m/s. The mover lands at 8 to 45 mm/s; with a filter that lags behind the stroke at 370.

    A bit that sticks is no fault while it is set: its sensor is believed in between.
    """
    # With the bit the filter without its sensor is once 3.06 leaps off the others: gates go off, 0.131 m/s. A bound of
    # 4 leaps in place of 3 lands there at 0.036, but of 45 drifts the worst is then 0.084 over gates off, not 0.029.
    for place in (1, 3):
        for at in (0.105, 0.12, 0.15):
            found = fly(strike(kind, at, place, size))
            assert found.radial < (0.2 if kind == "BIT" else 0.06), (place, at, found)


@pytest.mark.parametrize("place", [-12e-3, -8e-3, 7e-3, 11e-3])
def test_a_landing_from_anywhere_of_the_travel_does_without_a_sensor(place: float) -> None:
    """Of 76 such landings the fastest meets its bearing with 89 mm/s.

    With gains of a filter for more process noise, taken from the nearest place, it was up to 384.
    """
    _, moment = rig().fly(rig().begin(place=place, operate=9.0), 0.1)
    for k in RADIAL:
        found, _ = rig().fly(moment, 0.5, strike("LOST", 0.1, k))
        assert found.radial < 0.15, (k, found)


@pytest.mark.parametrize("speed", [0.1, 0.2, 0.43, 0.84])
def test_a_reading_that_leaps_throws_no_machine(speed: float) -> None:
    """A sensor that drifts fast is left out at its first samples; followed for two to six it was 0.38 m/s."""
    for place, at in ((0, 0.088), (3, 0.167), (1, 0.117), (2, 0.137)):
        found = fly(strike("DRIFT", at, place, speed))
        assert found.radial < gates_off()[0] + MARGIN, (place, at, found)
        assert found.noticed < 2e-3


@pytest.mark.parametrize("place", RADIAL)
def test_a_sensor_that_is_noisier_than_it_says_is_believed(place: int) -> None:
    """Twenty deviations of it, in a lift, in operation and in a stroke: it flies on as the law alone does.

    When a leap was a wrong reading at once, the gates went off: up to 0.23 m/s at the bearing.
    """
    for at in (0.04, 0.08, 0.12):
        begun = rig().begin(stroke=FLIGHT, rise=0.02, end=8e-3)
        _, moment = rig().fly(begun, at)
        found, _ = rig().fly(moment, at + 0.1, strike("NOISY", at, place, 10e-6))
        assert (found.radial, found.axial) == (0, 0)
        assert found.state in ("SETTLE", "OPERATE")


def test_two_that_drift_apart_are_not_followed_by_the_whole_filter() -> None:
    """While one that leapt may be noisy nothing is corrected by the others: 0.446 m/s where it was."""
    found = fly(strike("PAIR_DRIFT", 0.17685, 1, 0.18, -0.606))
    assert found.radial < gates_off()[0] + 0.1


def test_a_stroke_goes_on_after_fifty_missed_steps() -> None:
    """The filter goes on by its own rates meanwhile; else it expects the stroke 1.7 mm behind, and the gates go off."""
    for at in (0.105, 0.11, 0.13):
        _, moment = rig().fly(rig().begin(stroke=FLIGHT, rise=0.02, end=8e-3), at)
        found, moment = rig().fly(moment, at + 0.1, strike("MISSED", at, 0, 50))
        assert (found.radial, found.axial, found.monitor) == (0, 0, "MISSED")
        assert found.state == "OPERATE"


def test_missed_steps_do_not_shorten_the_averages_before_a_flight() -> None:
    found, _ = rig().fly(rig().begin(), 0.0115, strike("MISSED", 0.0015, 0, 190))
    assert found.state == "OFFSETS"
