"""Motion of the machine between two samples: one step of the classical Runge–Kutta method under held commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

from malta.model.plant import Plant
from malta.simulation import inverter
from malta.simulation.layout import Loop, Setup, Signals, electronics_of
from malta.simulation.readings import step_readings

OPENING = 20e-6  # s, time constant with which the current of an open phase decays
SENSORS = ("lagged", "late", "clock")  # states of the machine that belong to its sensors


def advance(loop: Loop, signals: Signals, held: Any, jitter: Any) -> Any:
    """The machine's state after one Runge–Kutta step under held commands, or after one period of its electronics."""
    own = {name: value for name, value in signals.machine.items() if name not in SENSORS}
    moved = _move(loop, signals._replace(machine=own), held, jitter)
    after = step_readings(loop, signals.machine, moved[: len(loop.plant.states)])
    return ca.vertcat(moved, *(after[name] for name in signals.machine if name in SENSORS))


def motion(loop: Loop, signals: Signals, x: Any, inputs: Any) -> Any:
    """x' under the inputs, the machine's loads and what acts from outside."""
    plant, s = loop.plant, loop.setup
    w = plant.load(x) + _outside(loop, signals)
    return plant.f(x, inputs, w + plant.bearing(x) if s.bearing else w)


def _outside(loop: Loop, signals: Signals) -> Any:
    """The disturbance; structural zeros, which cost nothing, where there is none."""
    return signals.given["w"] if loop.setup.disturbed else ca.SX(len(loop.plant.disturbances), 1)


def _move(loop: Loop, signals: Signals, held: Any, jitter: Any) -> Any:
    """The same without the sensors' states."""
    plant, s, h = loop.plant, loop.setup, loop.numbers["substep"]
    machine, given = signals.machine, signals.given
    x, fast = machine["x"], electronics_of(plant, s)
    if fast is not None:
        own = {name: machine[name] for name in fast.state}
        x, i, own = fast.move(
            x, machine["i_coil"], own, held, plant.load(x) + _outside(loop, signals), jitter
        )
        return ca.vertcat(x, i, *(own[name] for name in fast.state))
    if s.fidelity == "force":
        currents = _lagging_currents(plant.actuator.crossover, machine["i_coil"], held, h)
        half = len(plant.states) // 2 if plant.second_order else 0
        moved = runge_kutta(lambda x, n: motion(loop, signals, x, plant.forces(x, currents[n])), x, h, half)
        return ca.vertcat(moved, currents[2])
    n, count = len(plant.states), machine["i" if s.fidelity == "dq" else "i_phase"].numel()
    slope = _axis_slope if s.fidelity == "dq" else _phase_slope

    def rate(z: Any, _: int) -> Any:
        x, i, V = z[:n], z[n : n + count], z[n + count]
        forces, electrics = slope(plant, s, given, x, i, V, held)
        return ca.vertcat(motion(loop, signals, x, forces), electrics)

    return runge_kutta(rate, ca.vertcat(*machine.values()), h, n // 2 if plant.second_order else 0)


def half_step_decay(crossover: Any, h: Any) -> Any:
    """What is left of a current's deviation from its command after half a step h; 0 where currents follow at once."""
    at_once = isinstance(crossover, float) and math.isinf(crossover)
    return ca.SX(0) if at_once else ca.exp(-crossover * h / 2)


def _lagging_currents(crossover: Any, i: Any, held: Any, h: Any) -> list[Any]:
    """Currents at the beginning, the middle and the end of a step: i = held + (i_0 - held) e^(-w_c t), exactly."""
    if isinstance(crossover, float) and math.isinf(crossover):
        return [held] * 3
    lag, decay = i - held, half_step_decay(crossover, h)
    return [held + lag, held + decay * lag, held + decay**2 * lag]


def runge_kutta(rate: Callable[[Any, int], Any], z: Any, h: Any, positions: int = 0) -> Any:
    """z after one step h of the classical Runge–Kutta method of fourth order.

    rate : (z, half steps since the beginning: 0, 1 or 2) -> z'
    positions : number of leading entries of z whose rates are the next entries of z. Their update is written in
        accelerations (Nyström), which gives the same result in fewer operations.
    """
    q, w = z[:positions, 0], z[positions:, 0]  # columns, also of a single entry
    dq = w[:positions, 0]

    def slope(q: Any, w: Any, halves: int) -> Any:
        return rate(ca.vertcat(q, w), halves)[positions:, 0]

    k1 = slope(q, w, 0)
    middle = q + h / 2 * dq
    k2 = slope(middle, w + h / 2 * k1, 1)
    k3 = slope(middle + h * h / 4 * k1[:positions, 0], w + h / 2 * k2, 1)
    end = q + h * dq
    k4 = slope(end + h * h / 2 * k2[:positions, 0], w + h * k3, 2)
    late = k2 + k3
    early = k1 + late
    return ca.vertcat(end + h * h / 6 * early[:positions, 0], w + h / 6 * (early + late + k4))


def _axis_slope(
    plant: Plant, s: Setup, given: Mapping[str, Any], x: Any, i: Any, V: Any, m: Any
) -> tuple[Any, Any]:
    """Forces, and d/dt of axis currents and link voltage: L i' = m V - R i - emf, with the coupling of the axes."""
    drive, actuator = plant.drive, plant.actuator
    u = m * V * (1 - given["sag"] if s.faulty else 1)
    di = (u - actuator.R * i - drive.emf(x)) / actuator.L + drive.coupling(x, i)
    power = ca.dot(ca.DM(list(drive.weight)), u * i)
    return drive.force(i), ca.vertcat(di, inverter.link_slope(drive, V, power))


def _phase_slope(
    plant: Plant, s: Setup, given: Mapping[str, Any], x: Any, i: Any, V: Any, d: Any
) -> tuple[Any, Any]:
    """Forces, and d/dt of phase currents and link voltage. The voltage of a phase is u = (d - 1/2) V."""
    drive, actuator = plant.drive, plant.actuator
    u = (d - 0.5) * V * (1 - given["sag"] if s.faulty else 1)
    closed = 1 - given["open"] if s.faulty else ca.SX.ones(len(drive.phases))
    flowing = closed * i
    net = inverter.phase_voltages(drive, u - actuator.R * flowing - drive.to_phases(x) @ drive.emf(x), closed)
    # The arc is short: an open phase loses its current within a sample, and the other phases lose their part of it.
    lost = (1 - closed) * i
    for star in drive.stars if s.faulty else ():
        phases = list(star)
        lost[phases] += closed[phases] * ca.sum1(flowing[phases]) / ca.fmax(ca.sum1(closed[phases]), 1)
    di = net / actuator.L - lost / OPENING
    power = ca.dot(u, flowing)
    return drive.force(drive.to_axes(x) @ flowing), ca.vertcat(di, inverter.link_slope(drive, V, power))
