"""The two stator modules, which may differ, and whose magnetic centre may lie off the sensors' centre.

Modules 1 and 2 act at z = -l_B and z = +l_B, with (upper signs: module 1)

    K_A,i = K_A (1 -+ dK_A),     K_B,i = K_B (1 -+ dK_B).

A module attracts the mover's axis, which passes it at P, away from the magnetic centre e = (e_x, e_y):

    rho = P - e,     F = K_A,i (1 + kappa |rho|^2 / r_max^2) rho,

with the potential -K_A,i (|rho|^2 / 2 + kappa |rho|^4 / (4 r_max^2)). A pole pulls as 1 / gap^2, so two opposite ones
pull as 1 / (g - r)^2 - 1 / (g + r)^2 = (4 r / g^3) (1 + 2 r^2 / g^2 + ...): a magnetic gap g asks for kappa =
2 (r_max / g)^2.

The pull at the sensors' centre, F at P = 0, is a load, as the weight is: v0(z) cancels it where a controller knows of
it. The rest grows from zero with P and belongs to the machine that a controller is designed for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

if TYPE_CHECKING:
    from malta.machines.tubular.plant import Parameters

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
