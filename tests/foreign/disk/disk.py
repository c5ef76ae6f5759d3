"""The head of a hard disk by two stages: a voice coil and a piezo actuator, one position error signal in volts.

    m p_v'' = k_m i + w    L i' = u_v - R i - k_m p_v'
    p_p'' + 2 z w_p p_p' + w_p^2 p_p = w_p^2 k_p u_p    y = k_y (p_v + p_p)

Two commands for one reading. The positions come first, then the current, then the velocities: no states (q, q').
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; disk.toml says where each comes from."""

    m: float = si("kg", above=0)
    k_m: float = si("N/A", above=0)
    L: float = si("H", above=0)
    R: float = si("ohm", above=0)
    w_p: float = si("rad/s", above=0)
    z_p: float = si("1", at_least=0)
    k_p: float = si("m/V", above=0)
    k_y: float = si("V/m", above=0)
    U_max: float = si("V", above=0)
    T_d: float = si("s", at_least=0, shapes=True)
    s_y: float = si("V", at_least=0)
    p_max: float = si("m", above=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "disk.Parameters")


def plant(par: Any) -> Plant:
    """The head with both actuators."""

    def rates(x: Any, u: Any, w: Any) -> Any:
        return ca.vertcat(
            x[3],
            x[4],
            (u[0] - par.R * x[2] - par.k_m * x[3]) / par.L,
            (par.k_m * x[2] + w) / par.m,
            par.w_p**2 * (par.k_p * u[1] - x[1]) - 2 * par.z_p * par.w_p * x[4],
        )

    return Plant(
        name="disk",
        parameters=par,
        variant=plant,
        states=(
            *(
                Signal("p_v", "m"),
                Signal("p_p", "m"),
                Signal("i", "A"),
                Signal("v_v", "m/s"),
                Signal("v_p", "m/s"),
            ),
        ),
        inputs=(Signal("u_v", "V"), Signal("u_p", "V")),
        outputs=(Signal("y", "V"),),
        disturbances=(Signal("w", "N"),),
        f=rates,
        h=lambda x, _: par.k_y * (x[0] + x[1]),
        position_of=lambda y: ca.vertcat(y / par.k_y, 0, 0, 0, 0),
        preload=lambda x: ca.vertcat(par.R * x[2], x[1] / par.k_p),
        actuator=Actuator(
            (Signal("u_v", "V"), Signal("u_p", "V")), (1.0, 1.0), current_limit=par.U_max, dead_time=par.T_d
        ),
        contacts=Contacts(("crash stop",), lambda x: ca.fabs(x[0]) / par.p_max),
        sensors=Sensors(noise=(par.s_y,), range=(5,)),
    )
