"""A steel sphere under one electromagnet whose command is a voltage: its current is a state.

    m q'' = C i^2 / (s - q)^2 + w - m g        L(q) i' = u - R i - L'(q) q' i        L(q) = L_s + 2 C / (s - q)

q points up from the middle of the clearance, s is the gap there. L' q' i is the voltage that motion induces; with it
the magnet converts what energy it is given: force = i^2 L' / 2. The state i counts from the current I = s sqrt(m g / C)
that holds the sphere in the middle. The position is measured, and the current, from I as well, where `sensed` is 1:
two measurements for one command. The range of the current's sensor is what all of the voltage makes at rest.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """SI; magnet.toml says where each comes from."""

    m: float = si("kg", above=0)  # sphere
    C: float = si("N m^2/A^2", above=0)  # constant of the magnet
    s: float = si("m", above=0)  # gap in the middle
    L_s: float = si("H", above=0)  # inductance by stray flux
    R: float = si("ohm", above=0)
    g: float = si("m/s^2", above=0)
    U_max: float = si("V", above=0)  # limit of the voltage, either way
    T_d: float = si("s", at_least=0, shapes=True)  # from measurement to voltage
    q_max: float = si("m", above=0)  # clearance, either way
    s_y: float = si("m", at_least=0)  # noise of the position sensor, rms of a sample
    s_i: float = si("A", at_least=0)  # noise of the current sensor
    sensed: float = si("1", at_least=0, below=2, shapes=True)  # 1: the current is measured; 0: it is not
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "magnet.Parameters")


def plant(par: Any) -> Plant:
    """The sphere with its magnet and its sensors."""
    slope = ca.sqrt(par.m * par.g / par.C)  # A/m: the current that holds the sphere, by the gap
    held = par.s * slope

    def rates(x: Any, u: Any, w: Any) -> Any:
        gap, i = par.s - x[0], held + x[2]
        L, dL = par.L_s + 2 * par.C / gap, 2 * par.C / gap**2
        return ca.vertcat(x[1], (dL * i**2 / 2 + w) / par.m, (u - par.R * i - dL * x[1] * i) / L)

    outputs = (Signal("y", "m"), Signal("i_y", "A"))[: 2 if par.sensed else 1]
    return Plant(
        name="magnet",
        parameters=par,
        variant=plant,
        states=(Signal("q", "m"), Signal("q_dot", "m/s"), Signal("i", "A")),
        inputs=(Signal("u", "V"),),
        outputs=outputs,
        disturbances=(Signal("w", "N"),),
        f=rates,
        h=lambda x, _: ca.vertcat(x[0], x[2])[: len(outputs)],
        load=lambda _: -par.m * par.g,
        position_of=lambda y: ca.vertcat(y[0], 0, -slope * y[0]),  # all states at rest at y
        preload=lambda x: par.R * (held + x[2]),
        actuator=Actuator((Signal("u", "V"),), (1.0,), current_limit=par.U_max, dead_time=par.T_d),
        contacts=Contacts(("stop",), lambda x: ca.fabs(x[0]) / par.q_max),
        sensors=Sensors(
            noise=(par.s_y, par.s_i)[: len(outputs)], range=(0, par.U_max / par.R + held)[: len(outputs)]
        ),
    )
