"""A lag whose only reading is the angle of which its state is the tangent: at most pi/2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si


@dataclass(frozen=True)
class Parameters:
    T: float = si("s", above=0, default=0.02)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "angle_lag.Parameters")


def plant(par: Parameters) -> Plant:
    """T dx/dt = u + w - x, y = atan(x)."""

    def rates(x: Any, u: Any, w: Any) -> Any:
        return (u + w - x) / par.T

    return Plant(
        name="angle lag",
        parameters=par,
        variant=plant,
        states=(Signal("x", "V"),),
        inputs=(Signal("u", "V"),),
        outputs=(Signal("a", "rad"),),
        disturbances=(Signal("w", "V"),),
        f=rates,
        h=lambda x, _: ca.atan(x),
        position_of=lambda y: ca.tan(y),
        actuator=Actuator((Signal("u", "V"),), (1.0,), current_limit=10.0),
        contacts=Contacts(("stop",), lambda x: ca.fabs(x[0]) / 0.3),
        sensors=Sensors(noise=(1e-4,), range=(1.7,)),
    )
