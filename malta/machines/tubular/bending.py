"""The mover's first bending mode, which the model leaves out: a free tube of the printed mass and inertias.

A tube of outer radius r_o (printed) has m (r_o^2 + r_i^2) / 2 = I_zz and m (r_o^2 + r_i^2) / 4 + m L^2 / 12 = I_xx,
which gives its bore and length. A free Euler-Bernoulli beam bends first with

    w_1 = k^2 sqrt(E I / (m L^3)),   k = 4.7300,   I = pi / 4 (r_o^4 - r_i^4),

and moves the sensors by phi_S phi_B / m / (s^2 + 2 zeta w_1 s + w_1^2) of a radial force. Stiffness and damping of
magnets glued on a tube are not known: both are arguments.

Source: R. D. Blevins, Formulas for Natural Frequency and Mode Shape, 1979, table 8-1: the free beam.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from malta.linear.uncertain import UncertainSystem
from malta.machines.tubular.parameters import Parameters
from malta.model.printed import published_figures, published_value
from malta.proof.blocks import Dynamic

FREE_BEAM_ROOT = 4.730040744862704  # k of the first mode of a free beam
SIZE = 2.0  # the square of sqrt 2: two forces, and two sensors, of one plane


class Tube(NamedTuple):
    """The tube of a mover.

    bore : inner radius, m
    length : m
    density : kg/m^3
    area_moment : of its section, m^4
    """

    bore: float
    length: float
    density: float
    area_moment: float


@lru_cache(maxsize=1)
def radius() -> float:
    """The outer radius of the shaft that the paper prints, m."""
    return published_value(published_figures("tubular") or {}, "figure_1.shaft") / 2


def tube(par: Parameters) -> Tube:
    """The tube that has the printed mass and inertias."""
    squares = 2 * par.I_zz / par.m
    bore = math.sqrt(squares - radius() ** 2)
    length = math.sqrt(12 * (par.I_xx / par.m - squares / 4))
    volume = math.pi * (radius() ** 2 - bore**2) * length
    return Tube(bore, length, par.m / volume, math.pi / 4 * (radius() ** 4 - bore**4))


def first_bending(par: Parameters, E: float) -> float:
    """w_1 of the mover, rad/s, with a modulus E of its material, N/m^2."""
    found = tube(par)
    return FREE_BEAM_ROOT**2 * math.sqrt(E * found.area_moment / (par.m * found.length**3))


def shape(par: Parameters, z: float) -> float:
    """The mode's displacement at z from the middle, m; its square is 1 on the average over the tube."""
    k, u = FREE_BEAM_ROOT / 2, FREE_BEAM_ROOT * z / tube(par).length
    return float(np.cos(u) / np.cos(k) + np.cosh(u) / np.cosh(k))


def bending_block(
    par: Parameters, loop: UncertainSystem, plane: tuple[int, int], w_1: float, zeta: float
) -> Dynamic:
    """The mode as unmodelled dynamics of any phase, from both radial inputs of a plane to both of its sensors.

    loop : the machine of `travel_loops`, whose windings are states: x_f' = -a x_f + b u of each force x_f
    """
    import control  # imports matplotlib and takes a second: only where it is used

    A, B, _ = loop.at(loop.nominal)
    (state,) = np.flatnonzero(B[0][:, plane[0]])
    gain = SIZE * abs(shape(par, par.l_S) * shape(par, par.l_B)) / par.m
    winding = control.tf([float(B[0][state, plane[0]])], [1, -float(A[0][state, state])])
    return Dynamic(
        control.tf([gain], [1, 2 * zeta * w_1, w_1**2]) * winding, "additive", channel=(plane, plane)
    )
