"""A flywheel at its speed, driven by a motor with a PI current loop in hardware; tachometer and shunt in volts.

    J Omega' = k_t I - b Omega + w    L I' = K_p (k_r r - I) + K_I z - R I - k_t Omega    z' = k_r r - I

The command is the voltage r of the set point. States count from Omega_0 and from what holds it; z is the integral of
the current loop. No state is a position, and nothing touches. The readings count from those at Omega_0.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; flywheel.toml says where each comes from."""

    J: float = si("kg m^2", above=0)
    b: float = si("N m s/rad", above=0)
    k_t: float = si("N m/A", above=0)
    k_e: float = si("V s/rad", above=0)
    L: float = si("H", above=0)
    R: float = si("ohm", above=0)
    K_p: float = si("V/A", above=0)
    K_I: float = si("V/(A s)", above=0)
    k_r: float = si("A/V", above=0)
    Omega_0: float = si("rad/s", above=0)
    k_w: float = si("V s/rad", above=0)  # tachometer
    k_s: float = si("V/A", above=0)  # shunt
    r_max: float = si("V", above=0)
    T_d: float = si("s", at_least=0, shapes=True)
    s_w: float = si("V", at_least=0)
    s_i: float = si("V", at_least=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "flywheel.Parameters")


def plant(par: Any) -> Plant:
    """The flywheel, its motor and its current loop."""
    I_0 = par.b * par.Omega_0 / par.k_t
    z_0 = (par.R * I_0 + par.k_e * par.Omega_0) / par.K_I

    def rates(x: Any, u: Any, w: Any) -> Any:
        speed, I, z = par.Omega_0 + x[0], I_0 + x[1], z_0 + x[2]  # noqa: E741
        error = par.k_r * u - I
        return ca.vertcat(
            (par.k_t * I - par.b * speed + w) / par.J,
            (par.K_p * error + par.K_I * z - par.R * I - par.k_e * speed) / par.L,
            error,
        )

    def rest(y: Any) -> Any:
        speed = y[0] / par.k_w
        I = par.b * speed / par.k_t  # noqa: E741
        return ca.vertcat(speed, I, (par.R * I + par.k_e * speed) / par.K_I)

    return Plant(
        name="flywheel",
        parameters=par,
        variant=plant,
        states=(Signal("omega", "rad/s"), Signal("i", "A"), Signal("z", "A s")),
        inputs=(Signal("r", "V"),),
        outputs=(Signal("y_w", "V"), Signal("y_i", "V")),
        disturbances=(Signal("w", "N m"),),
        f=rates,
        h=lambda x, _: ca.vertcat(par.k_w * x[0], par.k_s * x[1]),
        position_of=rest,
        preload=lambda x: (I_0 + x[1]) / par.k_r,
        actuator=Actuator((Signal("r", "V"),), (1.0,), current_limit=par.r_max, dead_time=par.T_d),
        sensors=Sensors(noise=(par.s_w, par.s_i), range=(12, 5)),
    )
