"""The Halbach motor: Park transform, forces, motion and voltages of the three phases.

Equation numbers are those of the paper named in plant.py. Functions take and give CasADi expressions or numbers unless
they say otherwise; `par` are the parameters of the plant.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.model.equations import note
from malta.simulation.substep import runge_kutta

if TYPE_CHECKING:
    from malta.machines.halbach.plant import Parameters
    from malta.model.plant import FloatArray


PHASES = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)  # electrical angles of a, b, c
# m, air gap at which A and K_e stand: Sec. 2.3. NOTE: the paper does not say at which gap A was measured; it has one.
GAP = 0.4e-3
COS, SIN = ca.DM([math.cos(p) for p in PHASES]), ca.DM([math.sin(p) for p in PHASES])


def park(x: Any, k: Any) -> Any:
    """2 x 3: (6), phase quantities to d (horizontal) and q (vertical) at the position x."""
    cosine, sine = ca.cos(k * x), ca.sin(k * x)
    note("wave", "cosine, sine of k y", cosine=cosine, sine=sine)
    return park_of_angle(cosine, sine)


def unpark(x: Any, k: Any) -> Any:
    """3 x 2: (9), the inverse of `park` among phase quantities that sum to zero."""
    return 2 / 3 * park(x, k).T


def park_of_angle(c: Any, s: Any) -> Any:
    """2 x 3: `park` from the cosine and the sine of the angle k x."""
    return ca.vertcat((c * COS + s * SIN).T, (s * COS - c * SIN).T)


def gap_factor(par: Parameters) -> Any:
    """e^(-k (z_0 - GAP)): the array's field at the coils over its value at the gap at which A and K_e stand. Eq. (2).

    At GAP it is 1 exactly. 0.1 mm more leaves 97.9 %, 0.5 mm more 90 %.
    """
    return ca.exp(-par.k * (par.z_0 - GAP))


def motor_constant(par: Parameters) -> Any:
    """A(z_0) = A e^(-k (z_0 - GAP)), N/A, the motor constant at the machine's air gap. Eq. (2).

    Example: `motor_constant(replace(par, z_0=0.5e-3))` is 1.5732 N/A for A = 1.6067 N/A at 0.4 mm.
    """
    return par.A * gap_factor(par)


def forces(par: Parameters, x: Any, i: Any) -> Any:
    """(F_x, F_z) of three phase currents at the position x: the motor law (1)."""
    return motor_constant(par) * _weighted_park(par, x) @ i


def vertical_force(par: Parameters, x: FloatArray, i: FloatArray) -> FloatArray:
    """F_z, N, at k positions of k x 3 phase currents."""
    place, currents = ca.SX.sym("x"), ca.SX.sym("i", 3)
    law = ca.Function("lift", [place, currents], [forces(par, place, currents)[1]])
    return np.array(law.map(len(x))(np.atleast_2d(x), np.transpose(i))).ravel()


def _weighted_park(par: Parameters, x: Any) -> Any:
    """2 x 3: `park` with each phase weighted by its share of the motor constant."""
    return park(x, par.k) @ ca.diag(ca.vertcat(par.a_a, par.a_b, par.a_c))


def phase_currents(par: Parameters, x: Any, F_x: Any, F_z: Any) -> Any:
    """The three currents of least loss for these forces (N) at the position x, with all phases alike. A."""
    return unpark(x, par.k) @ ca.vertcat(F_x, F_z) / motor_constant(par)


def duty_cycles(par: Parameters, V: Any) -> Any:
    """Duty cycles of the half-bridges for these phase voltages (V), not limited: 1/2 is no voltage."""
    return 0.5 + V / par.V_dc


def motion(par: Parameters, x: Any, F_x: Any, w: Any) -> Any:
    """Rates of (x, x') under the motor's horizontal force and an outer one: m x'' = F_x - b x' + w."""
    return ca.vertcat(x[1], (F_x - par.b * x[1] + w) / par.m)


def rates(par: Parameters, state: Any, V: Any, w: Any = 0) -> Any:
    """Rates of (x, x', i_a, i_b, i_c) under these voltages of the half-bridges; the star point floats."""
    x, i = state[0:2], state[2:5]
    drop = V - resistive_drop(par, i) - gap_factor(par) * par.K_e * x[1] * _weighted_park(par, x[0])[0, :].T
    return ca.vertcat(motion(par, x, forces(par, x[0], i)[0], w), (drop - ca.sum1(drop) / 3) / par.L)


def resistive_drop(par: Parameters, i: Any) -> Any:
    """Voltage drop of each phase's resistance, V."""
    return par.R * ca.vertcat(par.r_a, par.r_b, par.r_c) * i


def advance(par: Parameters, state: Any, V: Any, w: Any = 0) -> Any:
    """The state (x, x', i_a, i_b, i_c) one PWM period later, at mean voltages V of the half-bridges.

    One Runge-Kutta step; with L / R = 15 periods its error is 1e-8. As in the paper, the ripple within a period is left
    out.
    """
    return runge_kutta(lambda z, _: rates(par, z, V, w), ca.vertcat(state), 1 / par.f_pwm)


def stiffness(par: Parameters, F_z: float, displacement: float = 0.0) -> float:
    """Stiffness of the motor with constant currents, N/m: the tangent k F_z, or the secant over a displacement (m).

    NOTE: the paper's 205 N/m at 1 N is the secant over its identification step of 2 mm; the tangent is 211.
    """
    angle = par.k * displacement
    return F_z * (math.sin(angle) / displacement if displacement else par.k)


def emf_damping(par: Parameters) -> float:
    """Damping by induced currents while the voltages are constant, N s/m: 3/2 A K_e / R, both at the gap."""
    return float(1.5 * par.A * par.K_e / par.R * gap_factor(par) ** 2)


def servo(par: Parameters, F_z: float, displacement: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """(5), the motor on constant voltages about its equilibrium: (x, x')' = A (x, x') + B x_eq. A 2 x 2, B 2 x 1."""
    K = stiffness(par, F_z, displacement)
    A = np.array([[0, 1], [-K / par.m, -(par.b + emf_damping(par)) / par.m]])
    return A, np.array([[0], [K / par.m]])
