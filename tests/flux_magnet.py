"""A magnet driven by voltage whose flux, current and temperature are read; none of the readings meets a contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    m: float = si("kg", above=0, default=0.1)
    C: float = si("N m^2/A^2", above=0, default=2e-5)
    k_B: float = si("T m/A", above=0, default=4e-4)
    s: float = si("m", above=0, default=5e-3)
    L_s: float = si("H", above=0, default=20e-3)
    R: float = si("ohm", above=0, default=2.0)
    c_T: float = si("J/K", above=0, default=20.0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "flux_magnet.Parameters")


def plant(par: Parameters) -> Plant:
    """The magnet about its gap s, where its current I_0 holds the weight."""
    I_0 = par.s * (par.m * 9.81 / par.C) ** 0.5

    def rates(x: Any, u: Any, w: Any) -> Any:
        gap, i = par.s - x[0], I_0 + x[2]
        inductance, slope = par.L_s + 2 * par.C / gap, 2 * par.C / gap**2
        return ca.vertcat(
            x[1],
            (slope * i**2 / 2 + w) / par.m,
            (u - par.R * i - slope * x[1] * i) / inductance,
            (par.R * (i**2 - I_0**2) - 0.1 * x[3]) / par.c_T,
        )

    def readings(x: Any, _: Any) -> Any:
        flux = par.k_B * (I_0 + x[2]) / (par.s - x[0]) - par.k_B * I_0 / par.s
        return ca.vertcat(flux, x[2], x[3])

    return Plant(
        name="flux magnet",
        parameters=par,
        variant=plant,
        states=(Signal("q", "m"), Signal("v", "m/s"), Signal("i", "A"), Signal("th", "K")),
        inputs=(Signal("u", "V"),),
        outputs=(Signal("B", "T"), Signal("i_y", "A"), Signal("th_y", "K")),
        disturbances=(Signal("w", "N"),),
        f=rates,
        h=readings,
        load=lambda _: -par.m * 9.81,
        position_of=lambda y: ca.vertcat(0, 0, 0, y[2]),
        preload=lambda x: par.R * (I_0 + x[2]),
        actuator=Actuator((Signal("u", "V"),), (1.0,), current_limit=24.0, dead_time=400e-6),
        contacts=Contacts(("stop",), lambda x: ca.fabs(x[0]) / 1.5e-3),
        sensors=Sensors(noise=(2e-4, 1e-3, 1e-2), range=(1.7, 10, 50)),
    )
