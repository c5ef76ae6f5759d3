"""A steel sphere between two electromagnets: one axis, open-loop unstable.

    m q'' = f + w - m g        f = C ((I_0 + i)^2 / (s - q)^2 - (I_0 - i)^2 / (s + q)^2)

q points up from the middle, s is the gap there; the controller adds i to the bias current I_0 of the upper magnet and
takes it from the lower one: f = k_i i + k_s q about the middle, and the force command f takes i = f / k_i.
"""

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si
from malta.model.rigid_body import Body, Resultant


@dataclass(frozen=True)
class Parameters:
    """SI; ball.toml says where each comes from."""

    m: float = si("mass of the sphere [kg]", above=0)
    C: float = si("magnet constant [N m^2/A^2]", above=0)  # constant of each magnet
    s: float = si("m", above=0)  # gap in the middle
    I_0: float = si("A", above=0)  # bias current
    g: float = si("m/s^2", at_least=0)
    I_max: float = si("A", above=0)  # limit of i, either way
    T_d: float = si("s", at_least=0, shapes=True)  # from measurement to force
    q_max: float = si("m", above=0)  # clearance, either way
    s_y: float = si("m", at_least=0)  # noise of the sensor, rms of a sample
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "ball.Parameters")


def plant(par: Parameters) -> Plant:
    """The sphere with its magnets and its sensor."""
    k_i = 4 * par.C * par.I_0 / par.s**2  # N/A
    return Plant(
        name="ball",
        parameters=par,
        variant=plant,
        states=(Signal("q", "m"), Signal("q_dot", "m/s")),
        inputs=(Signal("f", "N"),),
        outputs=(Signal("y", "m"),),
        disturbances=(Signal("w", "N"),),
        f=lambda x, u, w: ca.vertcat(x[1], (u + w) / par.m),
        h=lambda x, _: x[0],
        load=lambda _: -par.m * par.g,
        actuator=Actuator(
            (Signal("i", "A"),), (k_i,), par.I_max, dead_time=par.T_d, forces=lambda x, i: pull(par, x[0], i)
        ),
        contacts=Contacts(("stop",), lambda x: ca.fabs(x[0]) / par.q_max),
        sensors=Sensors(noise=(par.s_y,)),
        bodies=lambda: bodies(par),
    )


def pull(par: Parameters, q: Any, i: Any) -> Any:
    """The pull of both magnets, N, upwards."""
    return par.C * (((par.I_0 + i) / (par.s - q)) ** 2 - ((par.I_0 - i) / (par.s + q)) ** 2)


def bodies(par: Parameters) -> tuple[Body, ...]:
    """The sphere between its magnets, as `malta motion` draws them; nothing is computed of their sizes."""
    d = (6 * par.m / (math.pi * 7850)) ** (1 / 3)  # m, of steel, 7850 kg/m^3
    height = 0.75 * d + par.s
    return (
        Body("upper magnet", "box", (d, d, d / 2), (0.0, 0.0, height)),
        Body("lower magnet", "box", (d, d, d / 2), (0.0, 0.0, -height)),
        Body(
            "sphere", "sphere", (d, d, d), moves=("", "", "q"),
            resultants=(Resultant("magnets", ("", "", "f")),),
        ),
    )  # fmt: skip
