"""Recorded vectors: readings of flights, and what the controller makes of them, for a test on any processor.

stroke       a short stroke with noise
saturation   readings far off, so that forces are limited and sums of errors wait, and back
invalid      NaN, infinity, readings out of reach, readings that their sensors call invalid
lift-off     a controller that knows nothing meets a machine that is far away
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.firmware.calibration import FNV_FACTOR, FNV_START
from malta.firmware.program import TYPES
from malta.firmware.signals import (
    Target,
    input_fields,
    output_fields,
    reading_ranges,
    reference_fields,
    state_fields,
)
from malta.firmware.step import first_state, started_state, step_of, zero_reference
from malta.firmware.supervisor import reference_limits
from malta.simulation import references
from malta.simulation.inputs import motion_of
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.simulation.trajectory import Trajectory

SAMPLES = 60  # of each vector
STROKE = 0.02  # of the travel, at most


class Vector(NamedTuple):
    """Readings of some samples, and what a controller must make of them."""

    name: str
    warm: bool  # whether the state is one of a machine that follows the first reference; else that of `init`
    readings: FloatArray  # samples x (p, dp, ddp, then what is read), in the order of signals.py
    expected: FloatArray  # samples x (v, then commands or currents)
    checksums: list[int]  # of all outputs and the whole state after each sample


def record_vectors(t: Target) -> list[Vector]:
    """The vectors of a target; the readings are those of simulations, the answers are computed by step.py."""
    rest, moving = _flight(t, stroke=False), _flight(t, stroke=True)
    reach = np.minimum(reading_ranges(t.believed), 1.0)
    far = {name: value.copy() for name, value in rest.items()}
    far["y"][10:35] += 0.2 * reach * (-1.0) ** np.arange(len(reach))
    lifted = {name: value.copy() for name, value in rest.items()}
    lifted["y"] += 0.4 * reach * np.exp(-np.arange(SAMPLES) / 12.0)[:, None]
    return [
        _answered(t, "stroke", moving, warm=True),
        _answered(t, "saturation", far, warm=True),
        _answered(t, "invalid", _damage(t, rest), warm=True),
        _answered(t, "lift_off", lifted, warm=False),
    ]


def _flight(t: Target, *, stroke: bool) -> dict[str, FloatArray]:
    """References and readings of a flight with noise: of a short stroke, or at rest."""
    c, plant = t.controller, t.believed
    lasts = SAMPLES * c.sample_time
    options: Any = {"noise": 1.0, "fidelity": "force" if not t.driven else t.fidelity}
    if stroke and plant.has_stroke and plant.travel:
        scenario = Scenario.stroke(_distance(t, lasts / 6), rise=lasts / 6, duration=lasts, **options)
    else:
        scenario = Scenario("hold", lasts, references.hold, **options)
    run = simulate(plant, c, scenario)
    motion = motion_of(scenario, plant, c, run.t)
    found = {"p": motion.p, "dp": motion.dp, "ddp": motion.ddp} | _readings(t, run)
    if len(run.t) < SAMPLES:  # it touched down: go on with the last reading
        found = {k: np.vstack([v, np.repeat(v[-1:], SAMPLES - len(v), axis=0)]) for k, v in found.items()}
    return found


def _distance(t: Target, rise: float) -> float:
    """The way of a stroke, m, with half of the largest acceleration of references: a = D k^2 / (6 sqrt(3))."""
    k = 2 * math.log(9) / rise
    most = float(reference_limits(t).acceleration[t.believed.stroke_output])
    return float(min(STROKE * t.believed.travel, 0.5 * most * 6 * math.sqrt(3) / k**2))


def _readings(t: Target, run: Trajectory) -> dict[str, FloatArray]:
    """What the controller read in a flight."""
    found = {"y": run.y.copy(), "y_valid": np.ones_like(run.y)}
    if t.driven:
        i = run.i_phase if t.fidelity == "phase" else run.i
        found |= {"i": i.copy(), "i_valid": np.ones_like(i), "link": run.link.copy()}
    return found


def _damage(t: Target, flight: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The same flight with readings that cannot be true."""
    found = {name: value.copy() for name, value in flight.items()}
    outputs = found["y"].shape[1]
    for k, value in enumerate((math.nan, math.inf, -math.inf, 1e30, -1e30)):
        found["y"][4 + 5 * k, k % outputs] = value
    found["y"][32:36] = math.nan
    found["y_valid"][40:44, 0] = 0
    if t.driven:
        found["i"][6, 0], found["i"][11, -1], found["i_valid"][16:20, 1] = math.nan, math.inf, 0
        found["link"][21], found["link"][26], found["link"][31] = math.nan, 0.0, math.inf
    return found


def _answered(t: Target, name: str, flight: dict[str, FloatArray], *, warm: bool) -> Vector:
    """A vector with the controller's answers."""
    real, step = TYPES[t.precision], step_of(t)
    order = [*(f.name for f in reference_fields(t)), *(f.name for f in input_fields(t))]
    rows = {key: np.asarray(flight[key], dtype=real) for key in order}
    first = {key: rows[key][0] for key in zero_reference(t)}
    state = started_state(t, first) if warm else first_state(t)
    expected, checksums = [], []
    for k in range(SAMPLES):
        sample = {key: value[k] for key, value in rows.items()}
        state, out = step(state, sample, sample)
        last = out["command"] if "command" in out else out["current"]
        expected.append(np.concatenate([out["v"], last]))
        outputs = [out[f.name] for f in output_fields(t) if f.size]
        remembered = [state[f.name] for f in state_fields(t) if f.size]
        checksums.append(checksum(np.concatenate([*outputs, *remembered])))
    return Vector(name, warm, np.hstack([rows[key] for key in order]), np.array(expected), checksums)


def checksum(values: Any, begin: int = FNV_START) -> int:
    """FNV-1a over the words of 32 bits of numbers, the upper word of a double first; -0 counts as 0."""
    values = np.ascontiguousarray(values + values.dtype.type(0))
    words = values.view(np.uint32 if values.dtype == np.float32 else np.uint64)
    found = begin
    for word in words.tolist():
        for part in (word,) if values.dtype == np.float32 else (word >> 32, word & 0xFFFFFFFF):
            found = ((found ^ part) * FNV_FACTOR) & 0xFFFFFFFF
    return found
