"""A magnetically levitated planar motor: sixteen coils on a mover above a 2-D Halbach array of magnets.

Source: F. Xing, B. Kou, L. Zhang, X. Yin, Y. Zhou, "Design of a Control System for a Maglev Planar Motor Based on
Two-Dimension Linear Interpolation", 2017; equation and table numbers are its own.
State: x y z, the angles phi theta psi of eq. (7), and their rates. x, y lie in the plane of the magnets, gravity is
along -z. The inputs are a wrench, from which commutation.py finds sixteen coil currents by a model of field.py.

Heights: the plant's state z counts from the working height par.h, so that z = 0 is the air gap of Table 1. Coil models
and the functions of a position p take the height of the coils' lower faces above the magnets, of a level mover.
"""

from __future__ import annotations

import math
from dataclasses import fields
from functools import partial
from numbers import Real
from typing import Any

import casadi as ca

from malta.machines.planar.commutation import (
    check_pitch,
    current_law,
    factors_of,
    forces_function,
    limit_currents,
    wrench_matrix,
)
from malta.machines.planar.field import CoilModel, centre_of_force, shape_of, simulation_model
from malta.machines.planar.parameters import Parameters as Parameters
from malta.model.actuator import Actuator
from malta.model.contacts import Contacts
from malta.model.plant import Plant, Signal, trace
from malta.model.rigid_body import Body, Resultant, acceleration, principal_angles, rotate, rotation
from malta.model.sensors import Sensors
from malta.model.stroke import Stroke

POSITIONS = tuple(Signal(n, "m") for n in "xyz") + tuple(Signal(n, "rad") for n in ("phi", "theta", "psi"))
RATES = tuple(Signal(f"{s.name}_dot", f"{s.unit}/s") for s in POSITIONS)
WRENCH = tuple(Signal(f"F_{a}", "N") for a in "xyz") + tuple(Signal(f"T_{a}", "N m") for a in "xyz")
CURRENTS = tuple(Signal(f"i_{k}", "A") for k in range(1, 17))
SENSOR_ERRORS = tuple(Signal(f"offset_{s.name}", s.unit) for s in POSITIONS)
CONTACTS = ("touchdown on the magnets", "above the greatest height", "left the magnet array")


def plant(par: Parameters) -> Plant:
    """The mover under the wrench of its coils. Commutation takes the mover to be level.

    Raises CheckError when the coils cannot give every wrench: see `check_pitch`. Parameters that are symbols are not
    checked, as they stand for those of a record that was.
    """
    numbers = all(isinstance(getattr(par, f.name), Real | str) for f in fields(par))
    if numbers:
        check_pitch(par, simulation_model(par))
    x, u, w = ca.SX.sym("x", 12), ca.SX.sym("u", 6), ca.SX.sym("w", 6)
    return Plant(
        name="planar",
        parameters=par,
        states=POSITIONS + RATES,
        inputs=WRENCH,
        outputs=POSITIONS,
        disturbances=WRENCH,
        f=trace("f", [x, u, w], partial(motion, par)),
        h=lambda x, _: x[:6],
        load=lambda _: load(par),
        preload=lambda _: -load(par),
        actuator=Actuator(
            coils=CURRENTS,
            force_limit=(par.F_max, par.F_max, par.F_max, par.T_max, par.T_max, par.T_max),
            force_constant=(),
            current_limit=par.I_max,
            phase_margin=0.0,
            sample_time=par.T_s,
            dead_time=par.T_d,
            currents=current_law(par, numbers=numbers),
            forces=lambda x, i: forces_function(shape_of(par))(x, i, factors_of(par)),
            limited=lambda i: limit_currents(par, i),
            tabulated=par.cells > 0,
        ),
        contacts=Contacts(CONTACTS, lambda x: contact(par, x)),
        sensors=Sensors(
            sense=lambda x, errors: x[:6] + errors,
            errors=SENSOR_ERRORS,
            noise=(par.s_p, par.s_p, par.s_p, par.s_a, par.s_a, par.s_a),
            range=(0.0, 0.0, 0.0, 0.0, 0.0, 1.0),  # rad, of psi, which meets no contact
        ),
        inertia=(par.m, par.m, par.m, par.I_x, par.I_y, par.I_z),
        stroke=Stroke("y", thrust="F_y", travel=par.xy_max, mass=par.m),
        variant=plant,
        bodies=partial(_bodies, par),
    )


def _bodies(par: Parameters) -> tuple[Body, ...]:
    """As the mover the plate of even density with its mass and moments of inertia; the magnets lie under its travel."""
    side = math.sqrt(6 * par.I_z / par.m)
    height = math.sqrt(max(12 * par.I_x / par.m - side**2, (0.05 * side) ** 2))
    wide, thick = side + 2 * par.xy_max, 0.05 * side
    moves = tuple(s.name for s in POSITIONS)
    wrench = (Resultant("coils", ("F_x", "F_y", "F_z")), Resultant("coils", ("T_x", "T_y", "T_z")))
    return (
        Body("magnets", "box", (wide, wide, thick), (0.0, 0.0, -(thick + height) / 2)),
        Body("mover", "box", (side, side, height), moves=moves, resultants=wrench),
    )


def load(par: Parameters) -> Any:
    """Gravity, as a wrench at the centre of gravity."""
    return ca.vertcat(0, 0, -par.m * par.g, 0, 0, 0)


def contact(par: Parameters, x: Any) -> Any:
    """Shares of the clearance that are used up, 1 at contact: to the magnets, to z_max, to xy_max.

    The lowest corner of a plate, w_m wide in the plane of the coils' lower faces, touches the magnets first.
    """
    up = rotation(x[3:6])[:, 2]  # the vertical in the mover's frame
    below = par.r_z - centre_of_force(par)  # centre of gravity to that plane
    sunk = below * (1 - up[2]) + par.w_m / 2 * (ca.fabs(up[0]) + ca.fabs(up[1])) - x[2]
    beyond = ca.fmax(ca.fabs(x[0]), ca.fabs(x[1])) / par.xy_max
    return ca.vertcat(sunk / par.h, x[2] / (par.z_max - par.h), beyond)


def motion(par: Parameters, x: Any, W: Any, w: Any) -> Any:
    """x' of the mover under the coils' wrench W and the outer wrench w with gravity: (36)-(38), exact angles.

    `x` is a CasADi SX symbol of 12; both wrenches are about the centre of gravity, in the frame of the magnets.
    NOTE: (39) prints roll twice, and (36) leaves out the products of rates; with them the angles are those of eq. (7).
    """
    inertia = (par.I_x, par.I_y, par.I_z)
    T_B = rotate(principal_angles(x[3:6], inertia), W[3:] + w[3:])
    q_t_ddot, q_r_ddot = acceleration(par.m, inertia, x[3:6], x[9:12], W[:3] + w[:3], T_B)
    return ca.vertcat(x[6:12], q_t_ddot, q_r_ddot)


def dynamics(par: Parameters, model: CoilModel) -> ca.Function:
    """(x, i, w) -> x': the mover under coil currents i, gravity and another wrench w.

    The height in x counts from the magnets, unlike that in the states of the plant.
    """
    x, i, w = ca.SX.sym("x", 12), ca.SX.sym("i", 16), ca.SX.sym("w", 6)
    rate = motion(par, x, wrench_matrix(par, model, x[:3], x[3:6]) @ i, w + load(par))
    return ca.Function("dynamics", [x, i, w], [ca.cse(rate)], ["x", "i", "w"], ["dx"])
