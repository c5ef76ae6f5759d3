"""Half-bridges on a DC link: voltages and duty cycles within their limits, star points, the link voltage."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.model.drive import Drive
from malta.model.plant import Actuator

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def open_loop_gain(actuator: Actuator, Kp: float, Ki: float, delay: float, w: FloatArray) -> Any:
    """(Kp + Ki / s) e^(-s delay) / (L s + R) at s = j w: the loop of one current axis, eq. (20)."""
    s = 1j * np.asarray(w, dtype=float)
    return (Kp + Ki / s) * np.exp(-s * delay) / (actuator.L * s + actuator.R)


def largest_voltage(V: Any, *limits: Any) -> Any:
    """The largest voltage of a phase, V/2 of the link or the smallest of the limits (V); infinite ones are none."""
    most = V / 2
    for limit in limits:
        if not (isinstance(limit, float) and math.isinf(limit)):
            most = ca.fmin(most, limit)
    return most


def modulation(drive: Drive, u: Any, V: Any, most: Any = None) -> tuple[Any, Any]:
    """Axis voltages u as shares of the link voltage V within the limits of the half-bridges, and 1 for limited axes.

    Where the largest phase voltage of a group of axes exceeds `most`, the whole group is scaled: its direction stays.

    most : V, see `largest_voltage`; None: V/2
    """
    most = largest_voltage(V) if most is None else most
    peak = drive.peak(u)
    m, limited = ca.SX(u / V), ca.SX.zeros(len(drive.axes))
    for k, group in enumerate(drive.groups):
        fits = peak[k] <= most
        scale = ca.if_else(fits, 1, most / ca.fmax(peak[k], 1e-12))
        for axis in group:
            m[axis], limited[axis] = m[axis] * scale, ca.logic_not(fits)
    return m, limited


def duty_cycles(
    drive: Drive, u_phase: Any, V: Any, i_phase: Any, *, real_pwm: bool, most: Any = None
) -> tuple[Any, Any]:
    """Duty cycles of the half-bridges, d = 1/2 + u / V with |u| at most `most`, and 1 for limited phases.

    most : V, see `largest_voltage`; None: V/2
    real_pwm : with the resolution of the modulator's counter, and with the loss of voltage by dead time, dead_share V
        against the direction of the current
    """
    wanted, share = 0.5 + u_phase / V, (largest_voltage(V) if most is None else most) / V
    d = ca.fmax(ca.fmin(wanted, 0.5 + share), 0.5 - share)
    limited = d != wanted
    if real_pwm:
        d = drive.pwm_step * ca.floor(d / drive.pwm_step + 0.5) - drive.dead_share * ca.sign(i_phase)
        d = ca.fmax(ca.fmin(d, 1), 0)  # a half-bridge that does not switch has no dead time
    return d, limited


def phase_voltages(drive: Drive, drop: Any, closed: Any) -> Any:
    """The voltage L i' of each winding: `drop` = u - R i - emf minus the potential of its star point.

    A star point floats so that the currents of its phases add up to zero.

    closed : 1 for every phase, 0 for an open one, whose voltage is zero
    """
    net = ca.SX(drop)
    for star in drive.stars:
        phases = list(star)
        count = ca.fmax(ca.sum1(closed[phases]), 1)
        net[phases] = closed[phases] * (drop[phases] - ca.dot(closed[phases], drop[phases]) / count)
    return net


def link_slope(drive: Drive, V: Any, power: Any) -> Any:
    """V' of the DC link, V/s: C V' = i_supply - power / V. The supply's current never reverses."""
    supply = ca.fmax(drive.link_voltage - V, 0) / drive.supply_resistance
    return (supply - power / V) / drive.link_capacitance


def link_voltage(V: float, C: float, energy: float) -> float:
    """Voltage of a link with capacitance C (F) at V (V) after it has absorbed `energy` (J) without loss."""
    return math.sqrt(V**2 + 2 * energy / C)
