"""A rigid rotor on two radial active magnetic bearings: four degrees of freedom, coupled by the gyroscopic effect.

A machine of a user's own: malta knows it by this file alone, which rotor.toml names. In this folder,

    malta design                       both designs: margins proven for every speed, gain files, a run
    malta verify design/gains/rotor.json --machine rotor.py
    python notebook.py                 sensitivity, Campbell diagram, unbalance and load, as figures in build/

Data: "Performances Comparison for a Rotating Shaft Suspended by 4-Axis Radial Active Magnetic Bearings via
mu-Synthesis, Loop-Shaping Design, and Sub(H)inf with Uncertainties", Modelling and Simulation in Engineering 2011,
414286, Table 1. Magnets: Schweitzer and Maslen, Magnetic Bearings, 2009, ch. 4.

The axis of the rotor is z, bearing A at +l_A and bearing B at -l_B from the centre of gravity; x and y are the axes of
the bearings. alpha and beta turn the rotor about x and y, so the axis is at (x + z beta, y - z alpha).

    m x'' = F_x      I_t alpha'' + I_p Omega beta'  = T_x
    m y'' = F_y      I_t beta''  - I_p Omega alpha' = T_y

Each axis of a bearing has two magnets, one with the bias plus the control current i, the other with the bias less i:

    F = k_i / (4 i_b) ((i_b + i)^2 a - (i_b - i)^2 b),      a = 1 / (1 - q / g_0)^2,  b = 1 / (1 + q / g_0)^2
      = k_i i (a + b) / 2 + k_s g_0 (1 + i^2 / i_b^2) (a - b) / 4

with the bias i_b = k_s g_0 / k_i: k_i i + k_s q about the middle. The controller takes i = f / k_i for a force f.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta import InputError
from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si

MU_0 = 4e-7 * math.pi  # V s/(A m)


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI; where each comes from is said in rotor.toml."""

    m: float = si("mass of the rotor [kg]", above=0)
    I_p: float = si("kg m^2", above=0)  # about its axis
    I_t: float = si("kg m^2", above=0)  # across, about the centre of gravity
    l_A: float = si("m", above=0)  # centre of gravity to bearing A
    l_B: float = si("m", above=0)
    s_A: float = si("m", above=0)  # centre of gravity to sensor A
    s_B: float = si("m", above=0)
    k_s: float = si("magnet stiffness [N/m]", above=0)  # negative stiffness of a bearing axis
    k_i: float = si("force constant [N/A]", above=0)  # its force per control current
    g_0: float = si("m", above=0)  # air gap
    A_g: float = si("m^2", above=0)  # face of a pole
    theta_p: float = si("rad", above=0)  # between the two poles of a magnet
    N: float = si("1", above=0)  # turns of a magnet, both poles
    i_0: float = si("A", above=0)  # bias current
    I_max: float = si("A", above=0)  # limit of the control current, below the bias
    slope: float = si("rad")  # of the axis x against the horizontal
    g: float = si("m/s^2", at_least=0)
    c_r: float = si("m", above=0)  # clearance in the retainer bearings
    k_r: float = si("N/m", above=0)  # stiffness of one of them
    d_r: float = si("N s/m", at_least=0)  # its damping
    mu_r: float = si("1", at_least=0)  # its friction on the turning rotor
    e_u: float = si("m", at_least=0)  # unbalance: eccentricity of the rotor's mass
    l_u: float = si("m")  # plane of the unbalance, from the centre of gravity
    s_n: float = si("m", at_least=0)  # sensor noise, rms of a sample
    T_d: float = si("s", at_least=0, shapes=True)  # dead time from measurement to force
    Omega: float = si("rad/s", at_least=0)  # speed
    Omega_max: float = si("rad/s", above=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "rotor.Parameters")
        if not self.Omega <= self.Omega_max:
            found, most = f"{self.Omega:g} rad/s", f"at most Omega_max, {self.Omega_max:g} rad/s"
            raise InputError("rotor.Parameters", "Omega", found, most)


POSITIONS = (Signal("x", "m"), Signal("y", "m"), Signal("alpha", "rad"), Signal("beta", "rad"))
RATES = tuple(Signal(f"{s.name}_dot", f"{s.unit}/s") for s in POSITIONS)
BEARINGS = ("Ax", "Ay", "Bx", "By")
FORCES = tuple(Signal(f"f_{axis}", "N") for axis in BEARINGS)
SENSORS = tuple(Signal(f"s_{axis}", "m") for axis in BEARINGS)
CURRENTS = tuple(Signal(f"i_{axis}", "A") for axis in BEARINGS)
WRENCH = (Signal("F_x", "N"), Signal("F_y", "N"), Signal("T_x", "N m"), Signal("T_y", "N m"))


def plant(par: Parameters) -> Plant:
    """The rotor on its bearings. Every proof covers all speeds up to Omega_max."""
    lever, reading = planes(par.l_A, par.l_B), planes(par.s_A, par.s_B)
    return Plant(
        name="rotor",
        parameters=par,
        states=POSITIONS + RATES,
        inputs=FORCES,
        outputs=SENSORS,
        disturbances=WRENCH,
        f=lambda x, u, w: motion(par, x, lever.T @ u + w),
        h=lambda x, _: reading @ x[:4],
        position_of=lambda y: ca.solve(reading, y),
        load=lambda _: gravity(par),
        actuator=Actuator(
            coils=CURRENTS,
            force_constant=(par.k_i,) * 4,
            current_limit=par.I_max,
            dead_time=par.T_d,
            forces=lambda x, i: magnets(par, lever @ x[:4], i),
        ),
        contacts=Contacts(
            names=("retainer bearing A", "retainer bearing B"),
            contact=lambda x: used(par, x),
            cushioned=(True, True),
            bearing=lambda x: retainers(par, x),
        ),
        sensors=Sensors(noise=(par.s_n,) * 4),
        over={"Omega": (0.0, par.Omega_max)},
        variant=plant,
    )


def planes(a: Any, b: Any) -> Any:
    """(x, y, alpha, beta) -> x and y of the axis at +a, then at -b. Transposed: forces there -> wrench."""
    return ca.vertcat(
        ca.horzcat(1, 0, 0, a), ca.horzcat(0, 1, -a, 0), ca.horzcat(1, 0, 0, -b), ca.horzcat(0, 1, b, 0)
    )


def magnets(par: Parameters, q: Any, i: Any) -> Any:
    """Forces of the bearings, N, at the displacements q there (m) and control currents i (A)."""
    bias, a, b = par.k_s * par.g_0 / par.k_i, 1 / (1 - q / par.g_0) ** 2, 1 / (1 + q / par.g_0) ** 2
    return par.k_i * i * (a + b) / 2 + par.k_s * par.g_0 / 4 * (1 + (i / bias) ** 2) * (a - b)


def motion(par: Parameters, x: Any, wrench: Any) -> Any:
    """x' under F_x, F_y, T_x, T_y: Newton, and Euler for small angles."""
    spin = par.I_p * par.Omega
    return ca.vertcat(
        x[4:8], wrench[:2] / par.m, (wrench[2] - spin * x[7]) / par.I_t, (wrench[3] + spin * x[6]) / par.I_t
    )


def gravity(par: Parameters) -> Any:
    """Weight, as a wrench."""
    return ca.vertcat(-par.m * par.g * ca.sin(par.slope), -par.m * par.g * ca.cos(par.slope), 0, 0)


def used(par: Parameters, x: Any) -> Any:
    """Share of the clearance that is used up in each retainer bearing; they stand at the magnets."""
    r = planes(par.l_A, par.l_B) @ x[:4]
    return ca.vertcat(*(ca.sqrt(ca.sumsqr(r[k : k + 2])) for k in (0, 2))) / par.c_r


def retainers(par: Parameters, x: Any) -> Any:
    """Wrench of the retainer bearings: k_r delta + d_r delta', pushing only, and friction against the rotation."""
    lever = planes(par.l_A, par.l_B)
    r, dr = lever @ x[:4], lever @ x[4:8]
    forces = []
    for k in (0, 2):
        size = ca.sqrt(ca.sumsqr(r[k : k + 2]) + 1e-24)
        n = r[k : k + 2] / size
        delta, outwards = size - par.c_r, ca.dot(n, dr[k : k + 2])
        push = ca.if_else(delta > 0, ca.fmax(par.k_r * delta + par.d_r * outwards, 0), 0)
        turning = ca.tanh(par.Omega)  # a rotor that stands has no friction along a direction
        forces.append(-push * (n + par.mu_r * turning * ca.vertcat(-n[1], n[0])))
    return lever.T @ ca.vertcat(*forces)


def gains_of_coils(par: Parameters) -> tuple[float, float]:
    """k_s (N/m) and k_i (N/A) of two opposite magnets about their bias, by the data of their coils.

    F = 1/4 mu_0 N^2 A_g cos(theta_p / 2) ((i_0 + i)^2 / (g_0 - q)^2 - (i_0 - i)^2 / (g_0 + q)^2)
    """
    factor = MU_0 * par.N**2 * par.A_g * math.cos(par.theta_p / 2)
    return factor * par.i_0**2 / par.g_0**3, factor * par.i_0 / par.g_0**2
