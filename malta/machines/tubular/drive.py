"""The drive of MALTA: two modules of 3 x 3 coils on 18 half-bridges; star points along the machine.

Axis currents are those of windings.AXES, of module 1 and then of module 2. The forces are fx_B1 fy_B1 fx_B2 fy_B2 f_D.
NOTE: K_D = 5.2 N/A is 2.99 K_ind, where the power balance of an amplitude-invariant transformation asks for 4.5 K_ind.
Both are the paper's measured constants and kept as such: electrical and mechanical power do not balance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import casadi as ca

from malta.machines.tubular.parameters import Parameters
from malta.model.drive import CurrentSensors, Drive
from malta.model.equations import note
from malta.model.plant import Signal

# Windings: the two-directional dq transformation, and position sensing by Hall sensors.
#
# A module has 3 x 3 coils, r around and c along the machine; x_rc is any phase quantity. Eq. (16), X_dq = K_R X_abc
# K_L:
#
#     K_R(phi)   = [1/3 1/3 1/3; 2/3 cos(phi - 2 pi r / 3)]               zero sequence, bearing axis
#     K_L(theta) = 2/3 [cos(theta - 2 pi c / 3), -sin(theta - 2 pi c / 3)],   theta = pi z / L_p
#
# The paper does not print the two; these map pure currents to single entries of 1 (amplitude-invariant). Both have
# rank 2 and inverses in the Moore-Penrose sense only: five of the nine modes carry no current.
#
# NOTE: (18) commands a magnitude and an angle phi = atan2(f_y, f_x) (the paper prints a quotient in it). That angle
# is undefined at zero force and jumps by pi through it. Here phi is constant, 0 and pi/2: two fixed bearing axes, d
# along x and q along y, whose currents are f_x / K_B and f_y / K_B. The axes of a module are AXES, rotary letter
# first.


AXES = ("0d", "0q", "dd", "dq", "qd", "qq")
WEIGHT = (4.5, 4.5, 2.25, 2.25, 2.25, 2.25)  # power of a module = sum of weight u i
TURN = 2 * math.pi / 3


def K_R(phi: Any) -> Any:
    """2 x 3: zero sequence and the bearing axis at the angle phi (rad), of the three coils around the machine."""
    return ca.vertcat(
        ca.horzcat(*[1 / 3] * 3), ca.horzcat(*(2 / 3 * ca.cos(phi - TURN * r) for r in range(3)))
    )


def K_L(theta: Any) -> Any:
    """3 x 2: d and q along the machine at the electrical angle theta (rad), of the three coils along it."""
    angles = [theta - TURN * c for c in range(3)]
    cosines, sines = (ca.vertcat(*(wave(a) for a in angles)) for wave in (ca.cos, ca.sin))
    note(
        "wave",
        "cosines, sines of theta - 2 pi c / 3 for c = 0, 1, 2, theta = pi z / L_p",
        cosines=cosines,
        sines=sines,
    )
    return 2 / 3 * ca.horzcat(cosines, -sines)


def K_L_inverse(theta: Any) -> Any:
    """2 x 3, Moore-Penrose: K_L' with its orthogonal columns scaled by 1 / |column|^2 = 3/2."""
    return 1.5 * K_L(theta).T


def _around() -> Any:
    """3 x 3: zero sequence and the two fixed bearing axes, at 0 (d) and pi/2 (q)."""
    return ca.vertcat(K_R(0), K_R(math.pi / 2)[1, :])


def to_axes(theta: Any) -> Any:
    """6 x 9: a module's phase quantities (x_11 x_12 x_13 x_21 ...) to AXES, phi fixed at 0 (d) and pi/2 (q)."""
    T = ca.kron(_around(), K_L(theta).T)
    meaning = "T_d = 2/3 R x cosines, T_q = 2/3 R x sines, of a module; axes d are T_d i, axes q -T_q i"
    note("axes_of_phases", meaning, T_d=T[0::2, :], T_q=-T[1::2, :])
    return T


def to_phases(theta: Any) -> Any:
    """9 x 6: AXES to phase quantities, the Moore-Penrose inverse of `to_axes`."""
    T = ca.kron(_around().T @ ca.diag(ca.DM([3, 1.5, 1.5])), K_L_inverse(theta).T)
    meaning = "U_d = R' diag(3, 3/2, 3/2) x cosines, U_q the same of sines"
    note(
        "phases_of_axes",
        f"{meaning}, of a module; u_phase = U_d u_d - U_q u_q",
        U_d=T[:, 0::2],
        U_q=-T[:, 1::2],
    )
    return T


def hall_position(z: Any, x: Any, y: Any, pole: Any, errors: Any) -> Any:
    """Axial position as atan2 of the two planes' averaged Hall signals gives it, m.

    Each plane has four sensors, on +x, +y, -x, -y; the field grows as e^(pi r / L_p) towards a sensor that the mover
    nears by r, so one sensor reads z and r alike. Their average keeps (cosh(pi x / L_p) + cosh(pi y / L_p)) / 2, in
    which the first order cancels. Half a pole apart, one plane gives the cosine and the other the sine.
    x, y    : radial positions at the two planes, m, two each
    errors  : amplitude of the sine relative to the cosine less 1; its phase error, rad; share of the radial
              sensitivity that averaging leaves (0 as built, 1 for a single sensor on +x)
    """
    k = math.pi / pole
    cosine, sine = hall_signals(z, x, y, pole, errors)
    angle = ca.atan2(sine, cosine)
    turns = (k * z - angle) / (2 * math.pi)
    return (angle + 2 * math.pi * ca.floor(turns + 0.5)) / k  # counts periods: never wrong by one


def hall_signals(z: Any, x: Any, y: Any, pole: Any, errors: Any, functions: Any = ca) -> tuple[Any, Any]:
    """Averaged Hall signals of both planes, cosine and sine, over the field's amplitude; arguments of hall_position.

    functions : CasADi, or numpy for arrays
    """
    k = math.pi / pole
    amplitude, phase, single = errors
    cosine, sine = (
        (1 - single) * (functions.cosh(k * x[i]) + functions.cosh(k * y[i])) / 2
        + single * functions.exp(k * x[i])
        for i in (0, 1)
    )
    return cosine * functions.cos(k * z), (1 + amplitude) * sine * functions.sin(k * z + phase)


# The two stator modules, which may differ, and whose magnetic centre may lie off the sensors' centre.
#
# Modules 1 and 2 act at z = -l_B and z = +l_B, with (upper signs: module 1)
#
#     K_A,i = K_A (1 -+ dK_A),     K_B,i = K_B (1 -+ dK_B).
#
# A module attracts the mover's axis, which passes it at P, away from the magnetic centre e = (e_x, e_y):
#
#     rho = P - e,     F = K_A,i (1 + kappa |rho|^2 / r_max^2) rho,
#
# with the potential -K_A,i (|rho|^2 / 2 + kappa |rho|^4 / (4 r_max^2)). A pole pulls as 1 / gap^2, so two opposite
# ones pull as 1 / (g - r)^2 - 1 / (g + r)^2 = (4 r / g^3) (1 + 2 r^2 / g^2 + ...): with a magnetic
# gap g, kappa is 2 (r_max / g)^2.
#
# The pull at the sensors' centre, F at P = 0, is a load, as the weight is: v0(z) cancels it where a controller knows
# of it. The rest grows from zero with P and belongs to the machine that a controller is designed for.


SIDES = (-1, 1)  # of modules 1 and 2 along z


def levers(par: Parameters, z: Any) -> tuple[Any, Any]:
    """l_i: from the mover's middle at z to the modules, m."""
    return -(par.l_B + z), par.l_B - z


def bearing_constants(par: Parameters) -> tuple[Any, Any]:
    """K_B,i of the modules, N/A."""
    return par.K_B * (1 - par.dK_B), par.K_B * (1 + par.dK_B)


def magnetic_centre(par: Parameters) -> Any:
    """The magnetic centre e as the sensors see it, m."""
    return ca.vertcat(par.e_x, par.e_y)


def attraction(par: Parameters, side: int, P: Any) -> Any:
    """F of a module on the mover's axis at P, N: x and y."""
    rho = P - magnetic_centre(par)
    return par.K_A * (1 + side * par.dK_A) * (1 + _growth(par) * ca.sumsqr(rho)) * rho


def difference_of_attraction(par: Parameters, side: int, P: Any) -> Any:
    """F(P) - F(0) - K_A P of a module: all that an ideal module does not have, N. Zero with the defaults."""
    e = magnetic_centre(par)
    rho, share = P - e, side * par.dK_A
    grown = _growth(par) * (ca.sumsqr(rho) * rho + ca.sumsqr(e) * e)
    return par.K_A * (share * P + (1 + share) * grown)


def potential(par: Parameters, side: int, P: Any) -> Any:
    """Potential energy of the attraction of a module, J."""
    square = ca.sumsqr(P - magnetic_centre(par))
    return -par.K_A * (1 + side * par.dK_A) / 2 * (square + _growth(par) / 2 * square**2)


def _growth(par: Parameters) -> Any:
    """kappa / r_max^2, 1/m^2."""
    return par.kappa / (par.r_max * par.r_max)


# Signs of the offsets of the 18 current sensors, i_11 i_12 ... of module 1, then of module 2: 1 where k is a square
# modulo 19. This pattern shows in every axis that makes a force; equal offsets would cancel at the star points.
SIGNS = tuple(1 if any((n * n - k) % 19 == 0 for n in range(19)) else -1 for k in range(1, 19))


def drive(par: Parameters) -> Drive:
    """The drive of the machine, as simulations at fidelity "dq" and "phase" use it."""
    return Drive(
        axes=tuple(Signal(f"i_{axis}{module}", "A") for module in (1, 2) for axis in AXES),
        phases=tuple(
            Signal(f"i_{r}{c}_{module}", "A") for module in (1, 2) for r in (1, 2, 3) for c in (1, 2, 3)
        ),
        command=_axis_currents,
        force=partial(_forces, par),
        emf=partial(_emf, par),
        coupling=partial(_coupling, par),
        to_phases=partial(_of_both_modules, par, to_phases),
        to_axes=partial(_of_both_modules, par, to_axes),
        turned=_turn_bearing_axes,
        peak=_peak,
        groups=(tuple(range(6)), tuple(range(6, 12))),
        stars=tuple(tuple(range(k, k + 3)) for k in range(0, 18, 3)),
        weight=2 * WEIGHT,
        link_voltage=par.V_dc,
        link_capacitance=par.C_dc,
        supply_resistance=par.R_dc,
        pwm_step=par.f_pwm / par.f_clk,
        dead_share=par.t_dead * par.f_pwm,
        sensors=_current_sensors(par),
    )


def _current_sensors(par: Parameters) -> CurrentSensors | None:
    """The sensors of the phase currents; None where they are ideal."""
    if all(isinstance(value, float) and value == 0 for value in (par.s_i, par.d_i, par.q_i)):
        return None
    return CurrentSensors(par.s_i, tuple(sign * par.d_i for sign in SIGNS), par.q_i)


def _of_both_modules(par: Parameters, transform: Callable[[Any], Any], x: Any) -> Any:
    """A module's transformation at the electrical angle pi z / L_p, for both modules."""
    theta = math.pi * x[2] / par.L_p
    return ca.diagcat(transform(theta), transform(theta))


def _axis_currents(i: Any) -> Any:
    """The 12 axis currents of the five currents that belong to the forces."""
    return ca.vertcat(0, i[4], i[0], 0, i[1], 0, 0, i[4], i[2], 0, i[3], 0)


def _forces(par: Parameters, i: Any) -> Any:
    """The five forces of 12 axis currents."""
    K_B1, K_B2 = bearing_constants(par)
    return ca.vertcat(K_B1 * i[2], K_B1 * i[4], K_B2 * i[8], K_B2 * i[10], par.K_D * (i[1] + i[7]))


def _emf(par: Parameters, x: Any) -> Any:
    """Induced voltages of the axes: that of the thrust, K_ind z'."""
    return ca.vertcat(0, par.K_ind * x[8], ca.SX(5, 1), par.K_ind * x[8], ca.SX(4, 1))


def _coupling(par: Parameters, x: Any, i: Any) -> Any:
    """Rates of the axis currents by the axes' motion: d' gets theta' q and q' gets -theta' d."""
    crossed = [part for d in range(0, 12, 2) for part in (i[d + 1], -i[d])]
    return math.pi / par.L_p * x[8] * ca.vertcat(*crossed)


def _turn_bearing_axes(v: Any) -> Any:
    """Bearing axes at phi = atan2(f_y, f_x) of each module: (18), with its atan2 of two arguments."""
    blocks = []
    for f_x, f_y in ((v[0], v[1]), (v[2], v[3])):
        phi = ca.atan2(f_y, f_x)
        c, s = ca.cos(phi) * ca.SX.eye(2), ca.sin(phi) * ca.SX.eye(2)
        blocks += [ca.SX.eye(2), ca.vertcat(ca.horzcat(c, s), ca.horzcat(-s, c))]
    return ca.diagcat(*blocks)


def _peak(u: Any) -> Any:
    """An upper bound of each module's phase quantities at any position: the sum of both sequences' amplitudes."""
    sizes = []
    for k in (0, 6):
        sizes.append(ca.sqrt(ca.sumsqr(u[k : k + 2])) + ca.sqrt(ca.sumsqr(u[k + 2 : k + 6])))
    return ca.vertcat(*sizes)
