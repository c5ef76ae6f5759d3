"""Readings of the position sensors: their errors, their lag and their dead time, noise and resolution.

    x --> [ errors ] --> [ lag ] --> [ dead time ] --+--> [ resolution ] --> y
                                                noise-+

Lag and dead time have states beside those of the machine:

    lagged  behind the lag of each output
    late    blocks of all outputs: the reading of the next sample, those of whole samples under way, and the one that is
            caught within a sample, at the rest of the dead time before its end
    clock   time since the last sample, s
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from malta.model.plant import Plant
from malta.simulation.layout import Loop, Setup

TINY = 1e-6  # share of a step that rounding may take from the clock


def signals(loop: Loop, x: Any) -> Any:
    """The outputs at a state with the errors of the sensors."""
    plant = loop.plant
    return plant.sense(x, loop.numbers["errors"]) if loop.setup.sensed else plant.h(x, 0)


def measurement(loop: Loop, machine: Mapping[str, Any], noise: Any) -> Any:
    """y: what the sensors read now, with noise and, where the setup says so, resolution."""
    plant, s = loop.plant, loop.setup
    now = signals(loop, machine["x"])
    if s.late is not None:
        now = machine["late"][: now.numel()]
    elif s.lagging:
        now = machine["lagged"]
    y = now + noise
    if not s.quantize:
        return y
    steps = plant.resolution
    return ca.vertcat(
        *(
            y[i] if _is_zero(step) else ca.if_else(step > 0, step * ca.floor(y[i] / step + 0.5), y[i])
            for i, step in enumerate(steps)
        )
    )


def step_readings(loop: Loop, machine: Mapping[str, Any], x: Any) -> dict[str, Any]:
    """The states of the sensors after a step that took the machine to x."""
    s, h = loop.setup, loop.numbers["substep"]
    if not s.lagging and s.late is None:
        return {}
    before, after = signals(loop, machine["x"]), signals(loop, x)
    states: dict[str, Any] = {}
    if s.lagging:
        sensors = loop.plant.sensors
        lags = (0.0,) * after.numel() if sensors is None else sensors.lag
        after = _lag_outputs(machine["lagged"], before, after, lags, h)
        before, states = machine["lagged"], {"lagged": after}
    if s.late is not None:
        states |= _late(loop, machine, before, after)
    return states


def initial_readings(plant: Plant, s: Setup, x: Any) -> dict[str, Any]:
    """The states of the sensors of a machine that has been at rest at x."""
    p = plant.h(x, 0)
    return {"lagged": p, "late": p if s.late is None else ca.repmat(p, s.late + 2, 1)}


def _lag_outputs(s: Any, before: Any, after: Any, lags: tuple[Any, ...], h: Any) -> Any:
    """Readings behind lags after a step h, exactly for signals that grow evenly in it: s' = (p - s) / lag."""
    found = []
    for k, lag in enumerate(lags):
        if _is_zero(lag):
            found.append(after[k])
            continue
        rate = 1 / ca.fmax(lag, 1e-12)  # a lag of 0 among others in a campaign
        left = ca.exp(-h * rate)
        behind = (after[k] - before[k]) / (h * rate)
        found.append(after[k] - behind * (1 - left) + left * (s[k] - before[k]))
    return ca.vertcat(*found)


def _late(loop: Loop, machine: Mapping[str, Any], before: Any, after: Any) -> dict[str, Any]:
    """The blocks of late readings and the clock after a step in which the readings went from `before` to `after`."""
    plant, _, s, g = loop
    assert plant.sensors is not None
    assert s.late is not None
    Ts, h, p = g["control_time"], g["substep"], after.numel()
    rest = plant.sensors.dead_time - s.late * Ts
    clock = machine["clock"] + h
    share = (Ts - rest - machine["clock"]) / h  # of this step, until the reading is caught
    caught = ca.logic_and(share > TINY, share < 1 + TINY)
    blocks = machine["late"]
    last = ca.if_else(caught, before + share * (after - before), blocks[-p:])
    ends = clock > Ts - h / 2
    moved = ca.vertcat(blocks[p:-p], last)
    return {
        "late": ca.vertcat(ca.if_else(ends, moved, blocks[:-p]), last),
        "clock": ca.if_else(ends, 0, clock),
    }


def _is_zero(step: Any) -> bool:
    return isinstance(step, float | int) and step == 0
