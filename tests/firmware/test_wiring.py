"""The first switch-on: mistakes in the wiring are found at low force while the machine rests, and named.

The supervised C of `robust`, exported with `wiring`, with the C of its machine: see rig.c.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from exported import require, target
from rig import Outcome, Rig, Wires, strike

from malta.errors import InputError
from malta.firmware.sources import sources
from malta.firmware.supervisor_text import supervisor_sources
from malta.firmware.wiring import MAX_SHARE, wiring_table
from malta.firmware.wiring_words import wiring_sentences

END = 0.75  # s, of a flight: the wiring takes 0.4 s of it
QUARTER = 7.5e-3  # m, half a pole along the stroke, where cogging lets the mover rest
POLE = 15e-3  # m, L_p
SHARE = 0.05  # of the limits, that may act
GATES_OFF = 0.15  # m/s, less than the fastest contact of gates that go off: see test_supervisor_search.py
OUTPUTS, PHASES, MODULE = ("x1", "y1", "x2", "y2", "z"), 18, 9


@cache
def rig() -> Rig:
    require("gcc")
    return Rig(replace(target("robust", "double"), wiring=True))


class Found(NamedTuple):
    """What came of a flight with a wiring."""

    outcome: Outcome
    supervisor: dict[str, Any]
    said: str


def fly(w: Wires | None, place: float = 0.0, until: float = END) -> Found:
    one = rig()
    one.wire(w)
    try:
        outcome, moment = one.fly(one.begin(place=place), until, strike("NOTHING", -1.0))
    finally:
        one.wire(None)
    supervisor = one.supervisor(moment)
    return Found(outcome, supervisor, "; ".join(wiring_sentences(one.t, supervisor)))


def swap(row: tuple[Any, ...], a: int, b: int, size: int = 1) -> tuple[Any, ...]:
    new = list(row)
    new[a : a + size], new[b : b + size] = row[b : b + size], row[a : a + size]
    return tuple(new)


def put(row: tuple[Any, ...], k: int, value: float) -> tuple[Any, ...]:
    return (*row[:k], value, *row[k + 1 :])


def phase(k: int) -> str:
    return rig().t.current_readings[k].name


class Mistake(NamedTuple):
    """A mistake, as a change of a wiring, and words of which one has to be said."""

    name: str
    change: Any
    words: tuple[str, ...]


def invert_reading(k: int) -> Mistake:
    return Mistake(
        f"{OUTPUTS[k]} inverted",
        lambda w: w._replace(gain=put(w.gain, k, -w.gain[k])),
        (f"{OUTPUTS[k]} is inverted",),
    )


def swap_readings(a: int, b: int) -> Mistake:
    words = f"{OUTPUTS[a]} and {OUTPUTS[b]} are swapped"
    return Mistake(words, lambda w: w._replace(y=swap(w.y, a, b)), (words,))


def lose_reading(k: int) -> Mistake:
    return Mistake(
        f"{OUTPUTS[k]} dead", lambda w: w._replace(gain=put(w.gain, k, 0.0)), (f"{OUTPUTS[k]} shows nothing",)
    )


def scale_reading(k: int, gain: float) -> Mistake:
    words = f"{OUTPUTS[k]} reads {gain:.1g}"
    return Mistake(
        f"{OUTPUTS[k]} times {gain}",
        lambda w: w._replace(gain=put(w.gain, k, gain)),
        (words, f"{OUTPUTS[k]} reads"),
    )


def swap_cables(a: int, b: int, size: int = 1) -> Mistake:
    """Coils on each other's half-bridges, with the current sensors that sit there."""
    name = "modules 1 and 2 are swapped" if size == MODULE else f"{phase(a)} and {phase(b)} are swapped"
    return Mistake(name, lambda w: w._replace(out=swap(w.out, a, b, size), i=swap(w.i, a, b, size)), (name,))


def swap_sensors(a: int, b: int) -> Mistake:
    name = f"{phase(a)} and {phase(b)} are swapped"
    return Mistake(f"sensors {name}", lambda w: w._replace(i=swap(w.i, a, b)), (f"current sensors: {name}",))


INVERTED = Mistake(
    "all duties inverted", lambda w: w._replace(out_gain=(-1.0,) * PHASES), ("all duties are inverted",)
)
OFF_A_POLE = Mistake(
    "commutation off by L_p", lambda w: w._replace(more=put(w.more, 4, POLE)), ("commutation is off by 0.0",)
)
PLANES = Mistake(
    "planes swapped",
    lambda w: w._replace(y=(2, 3, 0, 1, 4)),
    ("x1 and x2 are swapped; y1 and y2 are swapped",),
)
DEAD = Mistake(
    "radial sensors dead",
    lambda w: w._replace(gain=(0.0, 0.0, 0.0, 0.0, 1.0)),
    ("x1 shows nothing; y1 shows nothing; x2",),
)
TWICE = Mistake("y2 on both inputs", lambda w: w._replace(y=(0, 3, 2, 3, 4)), ("y1 shows y2",))


def assert_found(f: Found, *mistakes: Mistake) -> None:
    """A fault in WIRING before any flight, named, with no contact and no current of a flight."""
    assert (f.outcome.state, f.supervisor["wired"]) == ("FAULT", -1), f.said
    for one in mistakes:
        assert any(words in f.said for words in one.words), (one.name, f.said)
    assert f.outcome.radial < GATES_OFF
    assert f.outcome.axial == 0.0
    assert 0.1 < f.outcome.current <= SHARE * rig().t.controller.limits.current.max()


@pytest.mark.slow
@pytest.mark.parametrize("place", [0.0, QUARTER])
def test_a_machine_that_is_wired_as_it_should_be_flies(place: float) -> None:
    found = fly(None, place)
    assert (found.outcome.state, found.supervisor["wired"], found.said) == ("OPERATE", 1, "")


@pytest.mark.slow
def test_mistakes_of_the_first_power_up() -> None:
    """Each threw the machine at up to 1.8 m/s, or was seen by nothing."""
    listed = (
        invert_reading(4),
        OFF_A_POLE,
        PLANES,
        swap_readings(1, 3),
        swap_cables(0, 9, MODULE),
        INVERTED,
        DEAD,
        TWICE,
    )
    for one in listed:
        assert_found(fly(one.change(rig().wires)), one)
    coils = swap_cables(0, 4)
    assert_found(fly(coils.change(rig().wires)), coils)


def draw(rng: np.random.Generator) -> tuple[Mistake, ...]:
    """One mistake, or one of the readings and one of the coils together."""
    a, b = (int(k) for k in rng.choice(4, 2, replace=False))
    c, d = (int(k) for k in rng.choice(PHASES, 2, replace=False))
    of_readings = (
        invert_reading(int(rng.integers(5))),
        swap_readings(min(a, b), max(a, b)),
        lose_reading(a),
        scale_reading(a, 0.5),
        TWICE,
    )
    of_coils = (swap_cables(min(c, d), max(c, d)), swap_sensors(min(c, d), max(c, d)), INVERTED, OFF_A_POLE)
    one, other = of_readings[rng.integers(len(of_readings))], of_coils[rng.integers(len(of_coils))]
    return ((one,), (other,), (one, other))[rng.integers(3)]


def wire(mistakes: tuple[Mistake, ...]) -> Wires:
    w = rig().wires
    for one in mistakes:
        w = one.change(w)
    return w


@pytest.mark.slow
def test_twenty_drawn_mistakes_are_found_at_one_of_two_places_of_rest() -> None:
    """What has no answer where the mover rests has one half a pole away; no mistake flies at both."""
    rng = np.random.default_rng(45)
    for _ in range(20):
        mistakes = draw(rng)
        named = []
        for place in (0.0, QUARTER):
            found = fly(wire(mistakes), place, 0.6)
            assert found.outcome.radial < GATES_OFF
            assert found.outcome.axial == 0.0
            if found.outcome.state == "FAULT":
                assert found.outcome.current <= SHARE * rig().t.controller.limits.current.max()
            named.append(all(any(words in found.said for words in one.words) for one in mistakes))
        assert any(named), [one.name for one in mistakes]


@pytest.mark.slow
def test_every_pair_of_coils_has_another_answer_at_one_of_two_places() -> None:
    """By the table alone: swapped answers differ from those expected by more than their noise."""
    w = wiring_table(rig().t)
    places = [int(np.argmin(np.abs(w.places - place))) for place in (0.0, QUARTER)]
    for a in range(PHASES):
        for b in range(a):
            apart = [
                np.abs(w.answers[k][:, a] - w.answers[k][:, b]).max() / np.abs(w.answers[k]).max()
                for k in places
            ]
            assert max(apart) > 0.05, (a, b)


@pytest.mark.slow
def test_machines_whose_rest_nothing_carries_are_refused_with_a_sentence() -> None:
    with pytest.raises(InputError, match="wiring of planar: found a mover that nothing carries at rest"):
        wiring_table(replace(target("planar", "double"), wiring=True))
    with pytest.raises(InputError, match="wiring of halbach: found electronics that take set points"):
        wiring_table(replace(target("halbach", "double"), wiring=True))


def test_answers_of_a_motor_without_gravity_are_those_of_its_free_mass() -> None:
    """`halbach` down to currents: m x'' = F, so that answers of its three coils add up to none."""
    t = replace(target("halbach", "double"), fidelity="force", wiring=True)
    w = wiring_table(t)
    assert np.abs(w.answers.sum(axis=2)).max() < 1e-9 * np.abs(w.answers).max()
    assert np.abs(w.rest).max() == 0.0


@pytest.mark.slow
def test_forces_stay_below_their_share() -> None:
    """Steady currents of each pattern at each place, by the drive's own transformation."""
    t = rig().t
    w, plant = wiring_table(t), t.believed
    for place in w.places:
        x = plant.at(z=float(place)).x
        volts = plant.drive.link_voltage * w.patterns.T
        axes = np.array(plant.drive.to_axes(x)) @ volts / plant.actuator.R
        forces = np.array([np.array(plant.drive.force(axes[:, j])).ravel() for j in range(axes.shape[1])])
        assert (np.abs(forces) <= (MAX_SHARE + 1e-9) * np.asarray(t.controller.limits.force)).all()


@pytest.mark.slow
def test_an_export_without_wiring_keeps_its_law() -> None:
    """Not one line of the law differs, and the supervisor has nothing of it."""
    plain = replace(rig().t, wiring=False)
    assert sources(plain, "0" * 64) == sources(rig().t, "0" * 64)
    assert "wir" not in supervisor_sources(plain, "ctl")["ctl_supervisor.c"].lower()
