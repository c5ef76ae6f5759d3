"""The machine's state as the compiled engine carries it from one Runge–Kutta step to the next within a sample.

    machine -- enter --> working -- substep --> working -- ... --> working -- leave --> machine

It is another set of coordinates of the same motion, in which a step takes fewer operations:

- A rate that belongs to a conserved quantity G = x_k + s(q) x_j is not integrated: x_k = G - s(q) x_j. G is proven to
  be constant, whatever its value (expressions.conserved); a torque from outside leaves the rate among the others.
- Forces enter the motion as a few linear combinations of the coils' currents. Currents follow their commands as
  first-order lags, so the combinations do, and no step needs the currents themselves.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from malta.model.plant import Plant
from malta.simulation.expressions import Conserved, conserved, linear_parts
from malta.simulation.layout import (
    Loop,
    Setup,
    electronics_of,
    layout_of,
    numbers_of,
    signals_of,
    with_symbols,
)
from malta.simulation.period import Period
from malta.simulation.readings import step_readings
from malta.simulation.substep import SENSORS, half_step_decay, motion, runge_kutta
from malta.synthesis.controller import Controller


class Coordinates(NamedTuple):
    """Indices of the states (q, q'), and what replaces some of them."""

    half: int  # number of positions
    constants: list[Conserved]

    @property
    def free(self) -> list[int]:
        """Positions whose rates are integrated."""
        return [i for i in range(self.half) if self.half + i not in {g.k for g in self.constants}]

    @property
    def driven(self) -> list[int]:
        """Positions whose rates follow from a conserved quantity."""
        return [g.k - self.half for g in self.constants]

    def full(self, x: Any, moving: Any, G: Any) -> Any:
        """(q, q') of the moving coordinates: free positions, their rates, driven positions. x: symbols of (q, q')."""
        count, q = len(self.free), ca.SX.zeros(self.half)
        w = ca.SX.zeros(self.half)
        for i, k in enumerate(self.free):
            q[k], w[k] = moving[i], moving[count + i]
        for i, k in enumerate(self.driven):
            q[k] = moving[2 * count + i]
        for i, (k, j, s) in enumerate(self.constants):
            w[k - self.half] = G[i] - ca.substitute(s, x[: self.half], q) * w[j - self.half]
        return ca.vertcat(q, w)


def with_working_state(p: Period, plant: Plant, c: Controller, s: Setup) -> Period:
    """The same control period with a working state; unchanged for other fidelities than `force`.

    p : with the numbers as the argument theta
    """
    if s.fidelity != "force" or electronics_of(plant, s) is not None or not plant.second_order:
        return p
    plant, g, theta = with_symbols(plant, numbers_of(plant, c, 1))
    loop, signals = Loop(plant, c, s, g), signals_of(layout_of(plant, c, s), ca.SX)
    machine, given = signals.machine, ca.vertcat(*signals.given.values())
    x, i, h = machine["x"], machine["i_coil"], g["substep"]
    rate = ca.cse(ca.densify(motion(loop, signals, x, plant.forces(x, i))))
    parts, names, slope = linear_parts(rate, i, theta)
    if parts.numel() > i.numel():
        parts, names, slope = i, i, rate
    at = Coordinates(x.numel() // 2, conserved(x, rate))
    held, jitter = ca.SX.sym("held", i.numel()), ca.SX.sym("jitter", 0)
    decay = half_step_decay(plant.actuator.crossover, h)

    # What a step begins with, and the symbols of it.
    G0 = ca.vertcat(*(x[k] + s * x[j] for k, j, s in at.constants))
    drawn = (1 - decay) * ca.substitute(parts, i, held)
    order = [*at.free, *(at.half + k for k in at.free), *at.driven]
    others = [machine[name] for name in machine if name in SENSORS]
    acting_first = drawn if decay.is_zero() else parts
    first = [x[order], acting_first, ca.SX(1), G0, drawn, *others]
    moving, acting, left, G, towards, *read = (ca.SX.sym("part", part.numel()) for part in first)
    working = ca.vertcat(moving, acting, left, G, towards, *read)

    middle = towards + decay * acting
    forces = [acting, middle, towards + decay * middle]
    law = ca.Function("slope", [x, names, given, theta], [slope])

    def change(z: Any, halves: int) -> Any:
        state = at.full(x, z, G)
        slopes = law(state, forces[halves], given, theta)
        return slopes[order]

    moved = runge_kutta(change, moving, h, len(at.free))
    full = at.full(x, moved, G)
    sensors = dict(zip([name for name in machine if name in SENSORS], read, strict=True))
    before = {**machine, **sensors, "x": at.full(x, moving, G)}
    after = step_readings(loop, before, full)
    stepped = [moved, forces[2], left * decay**2, G, towards, *(after[name] for name in sensors)]
    left_behind = [at.full(x, moving, G), held + left * (i - held), *read]
    symbols = ca.vertcat(*machine.values())
    return p._replace(
        enter=ca.Function("enter", [symbols, held, theta], _dense(first)),
        substep=ca.Function("substep", [working, held, given, jitter, theta], _dense(stepped)),
        leave=ca.Function("leave", [working, symbols, held, theta], _dense(left_behind)),
    )


def _dense(parts: list[Any]) -> list[Any]:
    return [ca.cse(ca.densify(ca.vertcat(*parts)))]
