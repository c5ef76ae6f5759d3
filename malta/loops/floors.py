"""How far a floor that shakes as much as its class allows moves a machine that stands on it."""

from __future__ import annotations

import numpy as np

from malta.arguments import describe, positive
from malta.errors import CheckError, InputError
from malta.loops.loop import Loop
from malta.loops.sampled_loops import disturbance_map

BANDS = 10 ** (np.arange(9, 20) / 10)  # Hz, midbands of thirds of an octave, nominally 8 to 80 Hz
HALF_BAND = 10**0.05
POINTS = 33  # of a band, at which the response is looked at, beside those about resonances


def floor_motion(loop: Loop, velocity: float) -> dict[str, dict[str, float]]:
    """Bound the rms motion on a floor whose velocity has at most this rms in each band of a third of an octave.

        rms(y)^2 <= sum over bands of (velocity * max over the band of |m w G(jw)|)^2,       8 to 80 Hz

    A floor that accelerates by a acts as a force -m a at the centre of gravity, seen from the floor, where the sensors
    stand. G is the response of the sampled loop to that force. At worst all motion of a band is at the frequency of its
    largest response, which is looked for at 33 frequencies of the band and about resonances.

    loop : from `malta.loop`
    velocity : m/s, rms in each band, as that of `malta.model.vibration_preset`

    Returns the rms of each output, SI, by the force along which the floor shakes: of each force from outside that
    accelerates one state alone, with m from that. What is slower than 7 Hz or faster than 89 Hz is not in it.

    Raises InputError for a machine without such a force and for a loop that samples less than ten times as fast,
    CheckError for an unstable loop. Source: C. G. Gordon, Proc. SPIE 3786, 22-33, 1999.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> floor = malta.model.vibration_preset("vc_c")
    >>> rms = malta.loops.floor_motion(loop, floor.velocity)["F_x"]["x1"]
    >>> f"{floor.title}: x1 within {1e9 * rms:.1f} nm rms"
    'VC-C: x1 within 34.9 nm rms'
    """
    if not isinstance(loop, Loop):
        raise InputError("floor_motion", "loop", describe(loop), "a Loop, from malta.loop")
    speed, plant, T = positive("floor_motion", "velocity", velocity), loop.plant, loop.sample_time
    if not loop.stable:
        raise CheckError(f"{loop.controller.name}: an unstable loop moves without limit")
    slowest = 1 / (10 * float(BANDS[-1]) * HALF_BAND)
    if slowest < T:
        raise InputError(
            loop.controller.name, "sample_time", f"{T:g} s", f"at most {slowest:.2g} s, for a floor"
        )
    B_w, near, found = disturbance_map(loop.model), loop.sampled.resonances, dict[str, dict[str, float]]()
    for k, signal in enumerate(plant.disturbances):
        moved = np.abs(B_w[:, k])
        if signal.unit != "N" or (moved > 1e-9 * moved.max(initial=0.0)).sum() != 1:
            continue
        load, squares = np.eye(len(plant.disturbances))[k] / moved.max(), np.zeros(len(plant.outputs))
        for low, high in (2 * np.pi * np.outer(BANDS, (1 / HALF_BAND, HALF_BAND))).tolist():
            w = np.concatenate([np.geomspace(low, high, POINTS), near[(near > low) & (near < high)]])
            held = np.sinc(w * T / (2 * np.pi))  # of a force that is constant throughout each sample
            answer = (w / held)[:, None] * np.abs(loop.sampled.compliance(w, load))
            squares += (speed * answer.max(axis=0)) ** 2
        found[signal.name] = {s.name: float(x) for s, x in zip(plant.outputs, np.sqrt(squares), strict=True)}
    if not found:
        raise InputError(
            plant.name, "disturbances", "none of them", "a force that accelerates one state alone"
        )
    return found
