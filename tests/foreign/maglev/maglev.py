"""A magnet of a maglev vehicle below its track: voltage in; gap (V), flux and acceleration out.

    B = K_b I / G    F = K_f B^2    M z'' = F - M g + w    G' = v_t - z'
    (L + N A K_b / G) I' = u - R I + N A K_b I G' / G^2

The benchmark of Michail, Zolotas and Goodall for the choice of sensors. States: current, velocity of the vehicle and
gap, which are no pairs (q, q'). v_t is the velocity of the track. Voltage and flux count from those at the nominal gap.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; maglev.toml says where each comes from."""

    M: float = si("kg", above=0)
    K_f: float = si("N/T^2", above=0)
    K_b: float = si("T m/A", above=0)
    G_0: float = si("m", above=0)  # nominal gap
    N: float = si("1", above=0)  # turns
    A: float = si("m^2", above=0)  # pole face
    L: float = si("H", above=0)  # stray
    R: float = si("ohm", above=0)
    g: float = si("m/s^2", above=0)
    k_G: float = si("V/m", above=0)
    U_max: float = si("V", above=0)
    T_d: float = si("s", at_least=0, shapes=True)
    T_s: float = si("s", at_least=0, shapes=True)
    c: float = si("m", above=0)  # clearance
    s_V: float = si("V", at_least=0)
    s_B: float = si("T", at_least=0)
    s_a: float = si("m/s^2", at_least=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "maglev.Parameters")


def plant(par: Any) -> Plant:
    """The magnet, its vehicle and its sensors."""
    held = ca.sqrt(par.M * par.g / par.K_f)  # T
    I_0 = held * par.G_0 / par.K_b
    area = par.N * par.A * par.K_b

    def flux(x: Any) -> Any:
        return par.K_b * (I_0 + x[0]) / (par.G_0 + x[2])

    def rates(x: Any, u: Any, w: Any) -> Any:
        I, G, dG = I_0 + x[0], par.G_0 + x[2], w[1] - x[1]  # noqa: E741
        return ca.vertcat(
            (u - par.R * I + area * I * dG / G**2) / (par.L + area / G),
            (par.K_f * flux(x) ** 2 + w[0]) / par.M,
            dG,
        )

    def read(x: Any, _: Any) -> Any:
        B = flux(x)
        return ca.vertcat(par.k_G * x[2], B - held, par.K_f * B**2 / par.M - par.g)

    def rest(y: Any) -> Any:
        G = y[0] / par.k_G
        return ca.vertcat(held * G / par.K_b, 0, G)

    return Plant(
        name="maglev",
        parameters=par,
        variant=plant,
        states=(Signal("i", "A"), Signal("v", "m/s"), Signal("G", "m")),
        inputs=(Signal("u", "V"),),
        outputs=(Signal("y_G", "V"), Signal("y_B", "T"), Signal("a", "m/s^2")),
        disturbances=(Signal("w", "N"), Signal("v_t", "m/s")),
        f=rates,
        h=read,
        load=lambda _: ca.vertcat(-par.M * par.g, 0),
        position_of=rest,
        preload=lambda x: par.R * (I_0 + x[0]),
        actuator=Actuator((Signal("u", "V"),), (1.0,), current_limit=par.U_max, dead_time=par.T_d),
        contacts=Contacts(("skid",), lambda x: ca.fabs(x[2]) / par.c),
        sensors=Sensors(noise=(par.s_V, par.s_B, par.s_a), dead_time=par.T_s, range=(10, 2, 30)),
    )
