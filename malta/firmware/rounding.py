"""What single precision does to a controller: its coefficients, its margin, and the noise of its rounding."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.firmware.program import TYPES
from malta.firmware.signals import Target
from malta.firmware.step import started_state, step_of, zero_reference
from malta.model.plant import position_in
from malta.simulation import references
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.margin import Margin
    from malta.synthesis.controller import Controller

ROUNDED = ("Ad", "Bd", "Cd", "K", "Ki", "L")
SAMPLES = 200  # over which the noise of rounding is measured


class RoundingNoise(NamedTuple):
    """Of each commanded force, rms: what rounding adds, and what the sensors' noise makes."""

    rounding: FloatArray
    sensors: FloatArray


def rounded(c: Controller) -> Controller:
    """The controller with the coefficients that single precision holds."""
    values: dict[str, Any] = {name: getattr(c, name).astype(np.float32).astype(float) for name in ROUNDED}
    return replace(c, **values)


def rounded_margin(c: Controller, uncertainty: dict[str, float]) -> Margin | None:
    """The margin of the sampled loop with rounded coefficients, proven over the travel; None without uncertainty."""
    from malta.margins.travel import travel_margin
    from malta.model.data import plant_of

    if not uncertainty:
        return None
    return travel_margin(plant_of(c.parameters), rounded(c), uncertainty)


def rounding_noise(t: Target) -> RoundingNoise:
    """The noise of rounding beside that of the sensors, from the same readings of a machine at rest.

    Both precisions take the readings of one flight; what their forces differ by is the rounding.
    """
    c, plant = t.controller, t.believed
    lasts = SAMPLES * c.sample_time
    fidelity: Any = t.fidelity if t.driven else "force"
    run = simulate(plant, c, Scenario("hold", lasts, references.hold, noise=1.0, fidelity=fidelity))
    forces = {}
    for precision in ("double", "float"):
        own = replace(t, precision=precision)
        step, reference = step_of(own), zero_reference(own)
        real = TYPES[own.precision]
        state = started_state(own, reference)
        rows = []
        for k in range(len(run.t)):
            readings: dict[str, Any] = {"y": run.y[k].astype(real), "y_valid": np.ones(len(plant.outputs))}
            if t.driven:
                i = run.i_phase if t.fidelity == "phase" else run.i
                readings |= {"i": i[k], "i_valid": np.ones(i.shape[1]), "link": run.link[k]}
            state, out = step(state, reference, readings)
            rows.append(out["v"].astype(float))
        forces[precision] = np.array(rows)
    apart = forces["float"] - forces["double"]
    steady = forces["double"] - c.feedforward.at(position_in(plant, run.x[0]))
    return RoundingNoise(np.sqrt((apart**2).mean(axis=0)), np.sqrt((steady**2).mean(axis=0)))


def smallest_error(c: Controller, e: float) -> float:
    """The error (m) below which a plain sum of single precision at `e` (m s) stands still: half its step over Ts."""
    return float(np.spacing(np.float32(e))) / 2 / c.sample_time
