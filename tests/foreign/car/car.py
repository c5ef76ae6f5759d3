"""A quarter of a car with an active suspension: deflection and two accelerometers for one servo valve in volts.

    m_s v_s' = -k_s d - c_s (v_s - v_u) + F + w    m_u v_u' = k_s d + c_s (v_s - v_u) - F - k_t t    T F' = k_F u - F
    d' = v_s - v_u    t' = v_u - v_r

d is the deflection of the suspension, t that of the tyre, v_r the velocity of the road. The accelerometers depend on
the force F of the actuator, which is a state.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; car.toml says where each comes from."""

    m_s: float = si("kg", above=0)
    m_u: float = si("kg", above=0)
    k_s: float = si("N/m", above=0)
    c_s: float = si("N s/m", above=0)
    k_t: float = si("N/m", above=0)
    k_F: float = si("N/V", above=0)
    T: float = si("s", above=0)
    U_max: float = si("V", above=0)
    T_d: float = si("s", at_least=0, shapes=True)
    T_s: float = si("s", at_least=0, shapes=True)
    d_max: float = si("m", above=0)
    s_d: float = si("m", at_least=0)
    s_a: float = si("m/s^2", at_least=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "car.Parameters")


def plant(par: Any) -> Plant:
    """The quarter of a car with its actuator and sensors."""

    def forces(x: Any) -> Any:
        strut = -par.k_s * x[0] - par.c_s * (x[1] - x[3]) + x[4]
        return ca.vertcat(strut, -strut - par.k_t * x[2])

    def rates(x: Any, u: Any, w: Any) -> Any:
        F = forces(x)
        return ca.vertcat(
            x[1] - x[3], (F[0] + w[0]) / par.m_s, x[3] - w[1], F[1] / par.m_u, (par.k_F * u - x[4]) / par.T
        )

    def read(x: Any, _: Any) -> Any:
        F = forces(x)
        return ca.vertcat(x[0], F[0] / par.m_s, F[1] / par.m_u)

    return Plant(
        name="car",
        parameters=par,
        variant=plant,
        states=(
            *(
                Signal("d", "m"),
                Signal("v_s", "m/s"),
                Signal("t", "m"),
                Signal("v_u", "m/s"),
                Signal("F", "N"),
            ),
        ),
        inputs=(Signal("u", "V"),),
        outputs=(Signal("y_d", "m"), Signal("a_s", "m/s^2"), Signal("a_u", "m/s^2")),
        disturbances=(Signal("w", "N"), Signal("v_r", "m/s")),
        f=rates,
        h=read,
        position_of=lambda y: ca.vertcat(y[0], 0, 0, 0, par.k_s * y[0]),
        preload=lambda x: x[4] / par.k_F,
        actuator=Actuator((Signal("u", "V"),), (1.0,), current_limit=par.U_max, dead_time=par.T_d),
        contacts=Contacts(("bump stop",), lambda x: ca.fabs(x[0]) / par.d_max),
        sensors=Sensors(noise=(par.s_d, par.s_a, par.s_a), dead_time=par.T_s, range=(0.2, 50, 200)),
    )
