"""A plate that three forces hold and four coils make: height, roll and pitch, open-loop unstable, a coil to spare.

    m z'' = F_z + k_z z        J_x alpha'' = T_x + k_t alpha        J_y beta'' = T_y + k_t beta

Four voice coils under the corners (+-a, +-b) push by k_f i each; magnets carry the weight and pull with the negative
stiffness k_z at the corners, k_t = k_z (a^2 or b^2). Three sensors read the height at the points of SENSORS. The coil
`failed` (1 to 4; 0: none) carries no current, and the others take over: malta.model.allocation.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from malta.model import (
    Actuator,
    Allocation,
    Contacts,
    Plant,
    Sensors,
    Signal,
    allocation,
    check_parameters,
    si,
)

CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))  # of the coils, in a and b
SENSORS = ((1, 0), (-1, 0), (0, 1))  # of the sensors, in a and b


@dataclass(frozen=True)
class Parameters:
    """SI; plate.toml says where each comes from."""

    m: float = si("mass of the plate [kg]", above=0)
    J_x: float = si("moment of inertia [kg m^2]", above=0)  # about x
    J_y: float = si("moment of inertia [kg m^2]", above=0)  # about y
    a: float = si("m", above=0)  # half distance of the coils along x
    b: float = si("m", above=0)  # half distance of the coils along y
    k_f: float = si("force constant [N/A]", above=0)  # force constant of each coil
    k_z: float = si("magnet stiffness [N/m]", at_least=0)  # negative stiffness of the magnets
    I_max: float = si("A", above=0)  # limit of each current
    T_d: float = si("s", at_least=0, shapes=True)  # from measurement to force
    gap: float = si("m", above=0)  # clearance of each corner, either way
    s_y: float = si("m", at_least=0)  # noise of each sensor, rms of a sample
    failed: float = si("1", at_least=0, below=5, shapes=True)  # coil that carries no current, 1 to 4; 0: none
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "plate.Parameters")


def coils(par: Any) -> Allocation:
    """The currents of least loss for lift, roll and pitch, where k_f, a and b are 1."""
    rows = [[1.0] * 4, [y for _, y in CORNERS], [-x for x, _ in CORNERS]]
    return allocation(rows, failed=[int(par.failed) - 1] if par.failed else [])


def plant(par: Any) -> Plant:
    """The plate with its coils and sensors."""
    made, lever = coils(par), ca.vertcat(1, par.b, par.a)
    T = par.k_f * ca.diag(lever) @ ca.DM(made.matrix) @ ca.diag([k not in made.failed for k in range(4)])
    heights = ca.vertcat(*(ca.horzcat(1, par.b * y, -par.a * x) for x, y in SENSORS))
    tilts = par.k_z * ca.vertcat(1, par.b**2, par.a**2)
    reach = [made.largest(row, 1.0) for row in np.eye(3)]  # A of the worst coil

    def corners(x: Any) -> Any:
        return ca.vertcat(*(x[0] + par.b * y * x[1] - par.a * s * x[2] for s, y in CORNERS))

    return Plant(
        name="plate",
        parameters=par,
        variant=plant,
        states=tuple(
            Signal(f"{name}{dot}", unit + rate)
            for dot, rate in (("", ""), ("_dot", "/s"))
            for name, unit in (("z", "m"), ("alpha", "rad"), ("beta", "rad"))
        ),
        inputs=(Signal("F_z", "N"), Signal("T_x", "N m"), Signal("T_y", "N m")),
        outputs=tuple(Signal(f"h{k}", "m") for k in (1, 2, 3)),
        disturbances=(Signal("w_z", "N"), Signal("w_x", "N m"), Signal("w_y", "N m")),
        f=lambda x, u, w: ca.vertcat(x[3:6], (u + w + tilts * x[:3]) / ca.vertcat(par.m, par.J_x, par.J_y)),
        h=lambda x, _: heights @ x[:3],
        position_of=lambda y: ca.solve(heights, y),
        actuator=Actuator(
            tuple(Signal(f"i{k}", "A") for k in (1, 2, 3, 4)),
            (),
            current_limit=par.I_max,
            force_limit=tuple(
                par.I_max * par.k_f * r * d for r, d in zip(reach, (1, par.b, par.a), strict=True)
            ),
            dead_time=par.T_d,
            currents=lambda _, v: made.currents(v / lever) / par.k_f,
            forces=lambda _, i: T @ i,
        ),
        contacts=Contacts(("corner",), lambda x: ca.mmax(ca.fabs(corners(x))) / par.gap),
        sensors=Sensors(noise=(par.s_y,) * 3),
    )
