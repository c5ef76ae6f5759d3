"""Other machines under the rig: whatever one fault or request, no contact much faster than one of gates off.

The planar motor flies over its magnets, the Halbach motor along its track; neither has touchdown bearings. They begin
in flight, held by their currents. See test_supervisor_search.py for MALTA.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from exported import require, target
from rig import KINDS, Moment, Outcome, Rig, Strike, strike

from malta.firmware.supervisor import bounds_of, reference_limits

SENSED = ("LOST", "STUCK", "JUMP", "DRIFT", "NOISY", "BIT", "BURST", "GAIN")
ASKED = ("ASK_SINE", "ASK_RAMP", "ASK_STEP", "ASK_RATE", "ASK_TOGGLE", "ASK_NAN", "ASK_ACCELERATION")
SAMPLES = {"halbach": 100, "planar": 1500}  # of a flight after a strike
CASES = {"halbach": 300, "planar": 150}  # a flight of the planar motor takes five times as long


class Bench(NamedTuple):
    """A machine in a stroke, at moments to go on from."""

    rig: Rig
    moments: tuple[tuple[float, Moment], ...]


@cache
def bench(name: str) -> Bench:
    """A flight with a stroke back and forth over half of what references may, in four times the shortest time."""
    require("gcc")
    rig = Rig(target(name, "double"))
    plant, limits, Ts = rig.t.believed, reference_limits(rig.t), rig.t.controller.sample_time
    k = plant.stroke_output
    end = 0.4 * min(limits.position[k], 0.05)
    rise = max(4 * np.sqrt(5.8 * end / limits.acceleration[k]), 40 * Ts)
    moment = rig.begin_in_flight(plant.at().x, np.zeros(len(plant.outputs)))
    moment.plan.stroke, moment.plan.rise, moment.plan.end = 10 * Ts, rise, end
    found = []
    for t in np.linspace(10 * Ts, 10 * Ts + 2 * rise, 12):
        moment = rig.fly(moment, float(t))[1]
        found.append((float(t), moment))
    return Bench(rig, tuple(found))


def fly(name: str, s: Strike) -> Outcome:
    own = bench(name)
    moment = max((row for row in own.moments if row[0] <= s.at), key=lambda row: row[0])[1]
    return own.rig.fly(moment, s.at + SAMPLES[name] * own.rig.t.controller.sample_time, s)[0]


def fastest(found: Outcome) -> float:
    return float(max(found.radial, found.axial))


def draw(name: str, rng: np.random.Generator) -> Strike:
    """A fault or request, sizes between the noise of its sensor and the way to its end."""
    rig, moments = bench(name)
    b, limits, Ts = bounds_of(rig.t), reference_limits(rig.t), rig.t.controller.sample_time
    kind = str(rng.choice([*SENSED, *ASKED, "MISSED"]))
    place = int(rng.integers(rig.outputs))
    way = float(min(b.touch[place], b.range[place]))
    size = float(np.exp(rng.uniform(np.log(1e-3 * way), np.log(way))) * rng.choice([-1, 1]))
    rate = float(rng.uniform(-1, 1) * limits.speed[place])
    if kind == "DRIFT":
        size /= 100 * Ts
    if kind in ("ASK_SINE", "ASK_TOGGLE"):
        rate = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.2)))) / Ts
    if kind == "BURST":
        size = float(rng.uniform(0.05, 1))
    if kind == "GAIN":
        size = float(rng.uniform(-1, 2))
    if kind == "ASK_ACCELERATION":
        size, rate = float(rng.uniform(-2, 2) * limits.acceleration[place]), size / 2
    if kind == "ASK_RATE":
        size, rate = rate, float(rng.uniform(-2, 2) * limits.acceleration[place])
    if kind == "MISSED":
        place, size = 0, float(rng.integers(1, 30))
    at = float(rng.uniform(moments[0][0], moments[-1][0]))
    lasts = np.inf if rng.random() < 0.5 else float(np.exp(rng.uniform(0, np.log(500)))) * Ts
    return strike(kind, at, place, size, rate, at + lasts)


def gates_off(name: str) -> float:
    """The fastest contact of gates that go off at any moment."""
    moments = bench(name).moments
    return max(fastest(fly(name, strike("STO", t))) for t in np.linspace(moments[0][0], moments[-1][0], 20))


# What one fault can still do beyond gates off, m/s: by machine and kind.
LATE = {
    ("halbach", "GAIN"): 0.1,
    ("halbach", "JUMP"): 0.06,
    ("planar", "DRIFT"): 0.3,
    ("planar", "GAIN"): 0.25,
    ("planar", "STUCK"): 0.15,
}
MARGIN = 0.03  # m/s


@pytest.mark.slow
@pytest.mark.parametrize("name", ["halbach", "planar"])
def test_no_fault_and_no_request_is_much_worse_than_gates_off(name: str) -> None:
    rng, off = np.random.default_rng(5), gates_off(name)
    for _ in range(CASES[name]):
        s = draw(name, rng)
        found, kind = fly(name, s), KINDS[s.kind]
        assert fastest(found) - off < LATE.get((name, kind), MARGIN), (kind, s.place, s.size, s.at, found)
        assert not found.spoiled, kind
