"""A rotor on two magnetic bearings in one plane, with a bending mode, amplifiers in volts and sensors in volts.

    m y'' = F_A + F_B + w    J theta'' = l (F_A - F_B)    eta'' + 2 z w_b eta' + w_b^2 eta = phi (F_A + F_B) / m_b
    F = C ((I_0 + i)^2 / (s - q)^2 - (I_0 - i)^2 / (s + q)^2)    T_a i' = k_a u - i    q = y +- l theta + phi eta

The amplifiers follow voltages u with a lag. Sensors stand outside of the bearings; their voltage is k (q + c q^3) of
the place q, behind a filter of the first order. The horizontal plane: no weight.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; spindle.toml says where each comes from."""

    m: float = si("kg", above=0)
    J: float = si("kg m^2", above=0)
    m_b: float = si("kg", above=0)  # modal mass
    w_b: float = si("rad/s", above=0)
    z_b: float = si("1", at_least=0)
    l: float = si("m", above=0)  # noqa: E741 - of the bearings
    l_s: float = si("m", above=0)  # of the sensors
    phi: float = si("1")  # mode at the bearings
    phi_s: float = si("1")
    C: float = si("N m^2/A^2", above=0)
    I_0: float = si("A", above=0)
    s: float = si("m", above=0)
    k_a: float = si("A/V", above=0)
    T_a: float = si("s", above=0)
    k: float = si("V/m", above=0)
    c_3: float = si("1/m^2", above=0)
    U_max: float = si("V", above=0)
    T_d: float = si("s", at_least=0, shapes=True)
    T_f: float = si("s", at_least=0)
    q_max: float = si("m", above=0)
    s_V: float = si("V", at_least=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "spindle.Parameters")


def plant(par: Any) -> Plant:
    """The rotor with bearings, amplifiers and sensors."""

    def places(x: Any, arm: Any, phi: Any) -> Any:
        return ca.vertcat(x[0] + arm * x[1] + phi * x[2], x[0] - arm * x[1] + phi * x[2])

    def pull(x: Any) -> Any:
        q, i = places(x, par.l, par.phi), x[6:8]
        return par.C * (((par.I_0 + i) / (par.s - q)) ** 2 - ((par.I_0 - i) / (par.s + q)) ** 2)

    def rates(x: Any, u: Any, w: Any) -> Any:
        F = pull(x)
        bend = par.phi * (F[0] + F[1]) / par.m_b - 2 * par.z_b * par.w_b * x[5] - par.w_b**2 * x[2]
        return ca.vertcat(
            x[3:6],
            (F[0] + F[1] + w[0]) / par.m,
            (par.l * (F[0] - F[1]) + w[1]) / par.J,
            bend,
            (par.k_a * u - x[6:8]) / par.T_a,
        )

    def read(x: Any, _: Any) -> Any:
        q = places(x, par.l_s, par.phi_s)
        return par.k * (q + par.c_3 * q**3)

    def rest(y: Any) -> Any:
        p = 1 / par.c_3
        q = 2 * ca.sqrt(p / 3) * ca.sinh(ca.asinh(1.5 * y / par.k * ca.sqrt(3 / p)) / 3)  # y = k (q + c q^3)
        middle, tilt = (q[0] + q[1]) / 2, (q[0] - q[1]) / (2 * par.l_s)
        at = ca.vertcat(middle + par.l * tilt, middle - par.l * tilt)
        return ca.vertcat(middle, tilt, 0, 0, 0, 0, -par.I_0 * at / par.s)

    return Plant(
        name="spindle",
        parameters=par,
        variant=plant,
        states=(
            *(Signal("y", "m"), Signal("theta", "rad"), Signal("eta", "m")),
            *(Signal("y_dot", "m/s"), Signal("theta_dot", "rad/s"), Signal("eta_dot", "m/s")),
            *(Signal("i_A", "A"), Signal("i_B", "A")),
        ),
        inputs=(Signal("u_A", "V"), Signal("u_B", "V")),
        outputs=(Signal("s_A", "V"), Signal("s_B", "V")),
        disturbances=(Signal("F", "N"), Signal("M", "N m")),
        f=rates,
        h=read,
        position_of=rest,
        preload=lambda x: x[6:8] / par.k_a,
        actuator=Actuator(
            (Signal("u_A", "V"), Signal("u_B", "V")), (1.0, 1.0), current_limit=par.U_max, dead_time=par.T_d
        ),
        contacts=Contacts(
            ("bearing A", "bearing B"), lambda x: ca.fabs(places(x, par.l, par.phi)) / par.q_max
        ),
        sensors=Sensors(noise=(par.s_V, par.s_V), lag=(par.T_f, par.T_f), range=(10, 10)),
    )
