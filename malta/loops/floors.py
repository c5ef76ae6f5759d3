"""How far a floor that shakes as much as its class allows moves a machine that stands on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from malta.arguments import describe, positive
from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.loops.loop import Loop
from malta.loops.sampled_loops import disturbance_map

BANDS = 10 ** (np.arange(9, 20) / 10)  # Hz, midbands of thirds of an octave, nominally 8 to 80 Hz
HALF_BAND = 10**0.05
POINTS = 33  # of a band, at which the response is looked at, beside those about resonances


class FloorMotion(NamedTuple):
    """How far a floor that shakes along a load moves the outputs.

    along : the load that stands for the floor's acceleration
    mass : kg, that is accelerated with the floor
    outputs : of each output by name, the largest rms with its unit
    furthest : the output that is moved furthest, of those in m where there are any
    band : Hz, of the band that adds most to it

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> [f"{one.along}: {one.furthest}" for one in malta.loops.floor_motion(loop, 1e-5)]
    ['F_x: x1', 'F_y: y2', 'F_z: z']
    """

    along: str
    mass: float
    outputs: Mapping[str, tuple[float, str]]
    furthest: str
    band: float


def floor_motion(loop: Loop, velocity: float) -> tuple[FloorMotion, ...]:
    """Bound the rms motion on a floor whose velocity has at most this rms in each band of a third of an octave.

        rms(y)^2 <= sum over bands of (velocity * max over the band of |m w G(jw)|)^2,       8 to 80 Hz

    A floor that accelerates by a acts as a force -m a at the centre of gravity, seen from the floor, where the sensors
    stand. G is the response of the sampled loop to that force. At worst all motion of a band is at the frequency of its
    largest response, which is looked for at 33 frequencies of the band and about resonances.

    loop : from `malta.loop`
    velocity : m/s, rms in each band, as that of `malta.model.vibration_preset`

    Returns a FloorMotion for each force from outside that accelerates one state of the machine alone. What moves slower
    than 7 Hz or faster than 89 Hz is not in it.

    Raises InputError for a machine without such a force and for a loop that samples less than ten times as fast,
    CheckError for an unstable loop. Source: C. G. Gordon, Proc. SPIE 3786, 22-33, 1999.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> floor = malta.model.vibration_preset("vc_c")
    >>> rms, _ = malta.loops.floor_motion(loop, floor.velocity)[0].outputs["x1"]
    >>> f"{floor.title}: x1 within {1e9 * rms:.1f} nm rms"
    'VC-C: x1 within 34.9 nm rms'
    """
    if not isinstance(loop, Loop):
        raise InputError("floor_motion", "loop", describe(loop), "a Loop, from malta.loop")
    speed, plant = positive("floor_motion", "velocity", velocity), loop.plant
    if not loop.stable:
        raise CheckError(f"{loop.controller.name}: an unstable loop moves without limit")
    slowest = 1 / (10 * float(BANDS[-1]) * HALF_BAND)
    if loop.sample_time > slowest:
        name = loop.controller.name
        raise InputError(
            name, "sample_time", f"{loop.sample_time:g} s", f"at most {slowest:.2g} s, for a floor"
        )
    B_w, found = disturbance_map(loop.model), list[FloorMotion]()
    for k, signal in enumerate(plant.disturbances):
        (moved,) = np.nonzero(np.abs(B_w[:, k]) > 1e-9 * np.abs(B_w[:, k]).max(initial=0.0))
        if signal.unit == "N" and len(moved) == 1:
            mass, load = 1 / abs(float(B_w[moved[0], k])), np.eye(len(plant.disturbances))[k]
            bands = speed * mass * _largest_in_bands(loop, load)
            rms = np.sqrt((bands**2).sum(axis=0)).tolist()
            outputs = {s.name: (x, s.unit) for s, x in zip(plant.outputs, rms, strict=True)}
            furthest = max(outputs, key=lambda name: (outputs[name][1] == "m", outputs[name][0]))
            band = float(BANDS[bands[:, [*outputs].index(furthest)].argmax()])
            found.append(FloorMotion(signal.name, mass, outputs, furthest, band))
    if not found:
        raise InputError(
            plant.name, "disturbances", "none of them", "a force that accelerates one state alone"
        )
    return tuple(found)


def _largest_in_bands(loop: Loop, load: FloatArray) -> FloatArray:
    """The largest |w G(jw)| from a load to each output in each band: bands x p."""
    near, largest = loop.sampled.resonances, []
    for middle in BANDS.tolist():
        low, high = 2 * np.pi * middle / HALF_BAND, 2 * np.pi * middle * HALF_BAND
        w = np.concatenate([np.geomspace(low, high, POINTS), near[(near > low) & (near < high)]])
        held = np.sinc(
            w * loop.sample_time / (2 * np.pi)
        )  # of a force that is constant throughout each sample
        largest.append(((w / held)[:, None] * np.abs(loop.sampled.compliance(w, load))).max(axis=0))
    return np.array(largest)
