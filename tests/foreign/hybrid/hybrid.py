"""A hybrid magnet, permanent and coil, whose remanence falls with its temperature: heater in W, coil in V.

    m v' = C (M / (s - q))^2 - m g + w    L i' = u - R I    c T' = P + R (I^2 - i_0^2) - k_T (T - T_a)    q' = v

M = I_m (1 - a T) + I is the magnetomotive force, I = i_0 + i the current of the coil. Temperature, voltage and power
count from those at rest. Readings: temperature in K behind a slow sensor, flux in T, gap as a current loop in A.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; hybrid.toml says where each comes from."""

    m: float = si("kg", above=0)
    C: float = si("N m^2/A^2", above=0)
    I_m: float = si("A", above=0)  # of the permanent magnet, at T_0
    a_T: float = si("1/K", at_least=0)
    s: float = si("m", above=0)
    L: float = si("H", above=0)
    R: float = si("ohm", above=0)
    c_T: float = si("J/K", above=0)
    k_T: float = si("W/K", above=0)
    k_B: float = si("T m/A", above=0)
    k_y: float = si("A/m", above=0)
    U_max: float = si("V", above=0)
    T_d: float = si("s", at_least=0, shapes=True)
    T_s: float = si("s", at_least=0, shapes=True)
    T_T: float = si("s", at_least=0)
    g: float = si("m/s^2", above=0)
    q_max: float = si("m", above=0)
    s_T: float = si("K", at_least=0)
    s_B: float = si("T", at_least=0)
    s_y: float = si("A", at_least=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "hybrid.Parameters")


def plant(par: Any) -> Plant:
    """The magnet, its coil, its heater and its sensors."""
    i_0 = par.s * ca.sqrt(par.m * par.g / par.C) - par.I_m  # of the coil, beside the magnet

    def mmf(x: Any) -> Any:
        return par.I_m * (1 - par.a_T * x[0]) + i_0 + x[1]

    def rates(x: Any, u: Any, w: Any) -> Any:
        gap = par.s - x[3]
        pull = par.C * (mmf(x) / gap) ** 2
        warming = u[1] + par.R * ((i_0 + x[1]) ** 2 - i_0**2) - par.k_T * (x[0] - w[1])
        return ca.vertcat(
            warming / par.c_T, (u[0] - par.R * (i_0 + x[1])) / par.L, (pull + w[0]) / par.m, x[2]
        )

    def read(x: Any, _: Any) -> Any:
        return ca.vertcat(x[0], par.k_B * (mmf(x) / (par.s - x[3]) - (par.I_m + i_0) / par.s), par.k_y * x[3])

    def rest(y: Any) -> Any:
        q = y[2] / par.k_y
        i = (par.I_m + i_0) * (par.s - q) / par.s - i_0 - par.I_m * (1 - par.a_T * y[0])
        return ca.vertcat(y[0], i, 0, q)

    return Plant(
        name="hybrid",
        parameters=par,
        variant=plant,
        states=(Signal("T", "K"), Signal("i", "A"), Signal("v", "m/s"), Signal("q", "m")),
        inputs=(Signal("u", "V"), Signal("P", "W")),
        outputs=(Signal("y_T", "K"), Signal("y_B", "T"), Signal("y_q", "A")),
        disturbances=(Signal("w", "N"), Signal("T_a", "K")),
        f=rates,
        h=read,
        load=lambda _: ca.vertcat(-par.m * par.g, 0),
        position_of=rest,
        preload=lambda x: ca.vertcat(
            par.R * (i_0 + x[1]), par.k_T * x[0] - par.R * ((i_0 + x[1]) ** 2 - i_0**2)
        ),
        actuator=Actuator(
            (Signal("u", "V"), Signal("P", "W")), (1.0, 1.0), current_limit=par.U_max, dead_time=par.T_d
        ),
        contacts=Contacts(("stop",), lambda x: ca.fabs(x[3]) / par.q_max),
        sensors=Sensors(
            noise=(par.s_T, par.s_B, par.s_y),
            lag=(par.T_T, 0.0, 0.0),
            dead_time=par.T_s,
            range=(100, 1, 20e-3),
        ),
    )
