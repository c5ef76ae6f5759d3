"""What a supervisor has found of its wiring, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from malta.firmware.signals import Target
from malta.firmware.wiring import wiring_table


def wiring_sentences(t: Target, found: Mapping[str, Any]) -> tuple[str, ...]:
    """The mistakes by name; none where the wiring is as it should be.

    found : members of the supervisor by name: shows, gain, coil, turned, reads, at, scale, doubt ...

    >>> import malta
    >>> from malta.firmware.signals import Target
    >>> t = Target(malta.gains.read("design/gains/halbach.json"), fidelity="force", wiring=True)
    >>> found = {"read": 32.0, "shows": [-1], "gain": [1.0], "coil": [0, 1, 2], "turned": [1, 1, 1], "at": 32.0}
    >>> wiring_sentences(t, found | {"scale": [1.0, 1.0], "doubt": -1, "cables": 0})
    ('x is inverted',)
    """
    outputs = [s.name for s in t.controller.measurements]
    shows, gain = [int(k) for k in found["shows"]], list(found["gain"])
    said = [*_commands(t, found), *_commutation(t, found), *_readings(outputs, shows, gain)]
    if t.driven:
        names = [s.name for s in t.current_readings]
        said += [
            f"current sensors: {text}" for text in _readings(names, [int(k) for k in found["reads"]], [])
        ]
        low, high = min(found["scale"]), max(found["scale"])
        if low < LEAST_CURRENT or high > MOST_CURRENT:
            said.append(
                f"currents are {low:.2g} to {high:.2g} times those of the gain file's R, L and link voltage"
            )
    if int(found["doubt"]) >= 0 and said:
        said[0] += _doubt(t, found, outputs)
    return tuple(said)


LEAST_CURRENT, MOST_CURRENT = 0.65, 1.5


def _commands(t: Target, found: Mapping[str, Any]) -> list[str]:
    """Swapped and inverted half-bridges or coils; larger blocks first."""
    coil, turned = [int(k) for k in found["coil"]], [int(k) for k in found["turned"]]
    what = "coils" if found["cables"] or not t.driven else "half-bridges"
    said = []
    for swap in wiring_table(t).swaps:
        a, b, size = swap
        if coil[a : a + size] == list(range(b, b + size)) and coil[b : b + size] == list(range(a, a + size)):
            said.append(f"{_block(t, swap, what)} are swapped")
            coil[a : a + size], coil[b : b + size] = range(a, a + size), range(b, b + size)
    names = _names(t)
    said += [f"{names[k]} drives {names[to]}" for k, to in enumerate(coil) if to != k]
    if all(sign < 0 for sign in turned):
        return [*said, "all duties are inverted" if t.driven else "all coils are inverted"]
    return [*said, *(f"{names[k]} is inverted" for k, sign in enumerate(turned) if sign < 0)]


def _names(t: Target) -> list[str]:
    return [s.name for s in (t.current_readings if t.driven else t.believed.actuator.coils)]


def _block(t: Target, swap: Sequence[int], what: str) -> str:
    """Two blocks of commands: a module of all its phases, or each by its names."""
    a, b, size = swap
    names, modules = _names(t), {s[2]: s for s in wiring_table(t).swaps}
    if size == max(modules) and 2 * size == len(names):
        return "modules 1 and 2"
    first, second = (" ".join(names[k : k + size]) for k in (a, b))
    return f"{what} {first} and {second}"


def _commutation(t: Target, found: Mapping[str, Any]) -> list[str]:
    """How far the currents are commutated off the place that is read."""
    places, plant = wiring_table(t).places, t.believed
    if len(places) == 1:
        return []
    k, apart, last = plant.stroke_output, float(places[1] - places[0]), len(places) - 1
    here, own = float(found["at"]), float(found["read"])
    if abs(here - own) < NEAR_PLACES or (
        int(found["shows"][k]) == -(k + 1) and abs(here + own - last) < NEAR_PLACES
    ):
        return []
    return [
        f"the commutation is off by {apart * abs(here - own):.3g} {plant.outputs[k].unit} of {plant.stroke.name}"
    ]


NEAR_PLACES = 1.6  # places


def _readings(names: list[str], shows: list[int], gain: list[float]) -> list[str]:
    """Readings that show others, inverted, nothing, or too much."""
    said = []
    for k, to in enumerate(shows):
        j = abs(to) - 1
        if j > k and abs(shows[j]) - 1 == k:
            said.append(f"{names[k]} and {names[j]} are swapped")
        elif to and j != k and not (j < k and abs(shows[j]) - 1 == k):
            twice = abs(shows[j]) - 1 == j
            said.append(f"{names[k]} shows {names[j]}" + (", as does that reading itself" if twice else ""))
    for k, to in enumerate(shows):
        if to < 0:
            said.append(f"{names[k]} is inverted")
        elif to == 0:
            said.append(f"{names[k]} shows nothing")
        elif gain and not LEAST_CURRENT < gain[k] < MOST_CURRENT:
            said.append(f"{names[k]} reads {gain[k]:.2g} times what it should")
    return said


def _doubt(t: Target, found: Mapping[str, Any], outputs: list[str]) -> str:
    """Another mistake that has the same answers."""
    number, swaps = int(found["doubt"]), wiring_table(t).swaps
    names = _names(t)
    if number == 0:
        words = "; ".join(_readings(outputs, [int(k) for k in found["shows_else"]], []))
    elif number == 1:
        words = "all of them are inverted"
    elif number < 2 + len(swaps):
        words = f"{_block(t, swaps[number - 2], 'coils')} are"
    elif number < 2 + len(swaps) + len(names):
        words = f"{names[number - 2 - len(swaps)]} is inverted"
    else:
        words = "the commutation is off"
    return f" (or {words}: where the mover rests now, nothing tells them apart)"
