"""The drive of MALTA: two modules of 3 x 3 coils on 18 half-bridges; star points along the machine.

Axis currents are those of windings.AXES, of module 1 and then of module 2. The forces are fx_B1 fy_B1 fx_B2 fy_B2 f_D.
NOTE: K_D = 5.2 N/A is 2.99 K_ind, where the power balance of an amplitude-invariant transformation asks for 4.5 K_ind.
Both are the paper's measured constants and kept as such: electrical and mechanical power do not balance.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca

from malta.machines.tubular.modules import bearing_constants
from malta.machines.tubular.windings import AXES, WEIGHT, to_axes, to_phases
from malta.model.drive import CurrentSensors, Drive
from malta.model.plant import Signal

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.machines.tubular.plant import Parameters


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
