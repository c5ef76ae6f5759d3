"""Half-bridges on a DC link: what voltages and duty cycles they make of those that are asked for."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.model.plant import Actuator, Drive

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def open_loop_gain(actuator: Actuator, Kp: float, Ki: float, delay: float, w: FloatArray) -> Any:
    """(Kp + Ki / s) e^(-s delay) / (L s + R) at s = j w: the loop of one current axis, eq. (20)."""
    s = 1j * np.asarray(w, dtype=float)
    return (Kp + Ki / s) * np.exp(-s * delay) / (actuator.L * s + actuator.R)


def modulation(drive: Drive, u: Any, V: Any) -> tuple[Any, Any]:
    """Axis voltages as shares of the link voltage V, within what its half-bridges can make, and who was limited.

    Where the largest phase voltage of a group of axes would pass V/2, the group is scaled down: its direction stays.
    """
    peak = drive.peak(u)
    m, limited = ca.SX(u / V), ca.SX.zeros(len(drive.axes))
    for k, group in enumerate(drive.groups):
        fits = 2 * peak[k] <= V
        scale = ca.if_else(fits, 1, V / (2 * ca.fmax(peak[k], 1e-12)))
        for axis in group:
            m[axis], limited[axis] = m[axis] * scale, ca.logic_not(fits)
    return m, limited


def duty_cycles(drive: Drive, u_phase: Any, V: Any, i_phase: Any, *, real_pwm: bool) -> tuple[Any, Any]:
    """Duty cycles of the half-bridges, 0 to 1, and who was limited: d = 1/2 + u / V.

    real_pwm: duty cycles in the steps of the modulator's counter, and the voltage that dead time costs,
    dead_share V against the current's direction.
    """
    wanted = 0.5 + u_phase / V
    d = ca.fmax(ca.fmin(wanted, 1), 0)
    limited = d != wanted
    if real_pwm:
        d = drive.pwm_step * ca.floor(d / drive.pwm_step + 0.5) - drive.dead_share * ca.sign(i_phase)
        d = ca.fmax(ca.fmin(d, 1), 0)  # one that does not switch has no dead time
    return d, limited


def phase_voltages(drive: Drive, drop: Any, closed: Any) -> Any:
    """What drives the current of each winding, V: `drop` = u - R i - emf, less the star point that it hangs on.

    The star point floats so that the currents of its phases keep adding to zero. closed: 1 per phase, 0 where it is
    open; an open phase drives nothing.
    """
    net = ca.SX(drop)
    for star in drive.stars:
        phases = list(star)
        count = ca.fmax(ca.sum1(closed[phases]), 1)
        net[phases] = closed[phases] * (drop[phases] - ca.dot(closed[phases], drop[phases]) / count)
    return net


def link_slope(drive: Drive, V: Any, power: Any) -> Any:
    """V' of the DC link, V/s: the supply's current through its resistance, never backwards, less power / V."""
    supply = ca.fmax(drive.link_voltage - V, 0) / drive.supply_resistance
    return (supply - power / V) / drive.link_capacitance


def link_voltage(V: float, C: float, energy: float) -> float:
    """Voltage of a link of C (F) at V (V) after it took up `energy` (J) without loss."""
    return math.sqrt(V**2 + 2 * energy / C)
