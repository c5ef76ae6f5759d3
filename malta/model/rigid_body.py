"""Newton–Euler equations of a free rigid body with Cardan angles, in CasADi.

Frames: I is fixed to the stator, R to the mover. q_r = (alpha, beta, gamma) turn I into R about x, y', z'':

    R_RI = R_z(gamma) R_y(beta) R_x(alpha)          a_R = R_RI a_I
    omega_R = (0, 0, gamma') + R_z (0, beta', 0) + R_z R_y (alpha', 0, 0)                      eq. (4)
    m q_t'' = F_I          I omega_R' + omega_R x I omega_R = T_R                              eq. (3)

`rotation`, `rate_map` and `cardan_rates` hold for any frame; their first argument is its angles.

NOTE: eq. (4) writes the Cardan rates as components of an angular velocity in frame I; they are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import casadi as ca


class Resultant(NamedTuple):
    """The force or the torque of a group of inputs, as pictures show it: an arrow from the middle of a body.

    name : of the group, as "module 1"
    inputs : their names along x, y and z of the stator, "" for none

    >>> import malta
    >>> planar = malta.plant_of(malta.read("data/planar.toml"))
    >>> [one.inputs for one in planar.bodies()[1].resultants]
    [('F_x', 'F_y', 'F_z'), ('T_x', 'T_y', 'T_z')]
    """

    name: str
    inputs: tuple[str, str, str]


class Body(NamedTuple):
    """A body of a machine as pictures show it; nothing is computed of it.

    name : as "mover"
    form : "box", "cylinder", whose axis is z, or "sphere"
    size : along x, y and z, m
    place : of its middle, m, beside what it moves by
    moves : states that move it along x, y, z and turn it by Cardan angles about them, "" for none; (): it stands still
    resultants : of the inputs, where they act: on this body, or on the mover in the middle of this one

    >>> import malta
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> [(body.name, body.moves[:3]) for body in plant.bodies()]
    [('module 1', ()), ('module 2', ()), ('mover', ('x', 'y', 'z'))]
    """

    name: str
    form: Literal["box", "cylinder", "sphere"]
    size: tuple[float, float, float]
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    moves: tuple[str, ...] = ()
    resultants: tuple[Resultant, ...] = ()


class Trig(NamedTuple):
    """Sine and cosine, exact or by the paper's small-angle approximation."""

    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]


EXACT_TRIG = Trig(ca.sin, ca.cos)
SMALL_ANGLE_TRIG = Trig(lambda angle: angle, lambda _: 1)


def rotation(q_r: Any, trig: Trig = EXACT_TRIG) -> Any:
    """R_RI, 3 x 3, from components in I to components in R."""
    (sa, sb, sg), (ca_, cb, cg) = ([fn(q_r[i]) for i in range(3)] for fn in trig)
    R_x = _matrix([[1, 0, 0], [0, ca_, sa], [0, -sa, ca_]])
    R_y = _matrix([[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]])
    R_z = _matrix([[cg, sg, 0], [-sg, cg, 0], [0, 0, 1]])
    return R_z @ R_y @ R_x


def rate_map(q_r: Any, trig: Trig = EXACT_TRIG) -> Any:
    """E, 3 x 3, of eq. (4): omega_R = E(q_r) q_r'."""
    sb, cb, sg, cg = trig.sin(q_r[1]), trig.cos(q_r[1]), trig.sin(q_r[2]), trig.cos(q_r[2])
    return _matrix([[cg * cb, sg, 0], [-sg * cb, cg, 0], [sb, 0, 1]])


def principal_angles(q_r: Any, inertia: Sequence[float]) -> Any:
    """The Cardan angles of the frame B of the equations: R, or R before the rotation by gamma.

    With Ixx = Iyy every axis across the body is a principal axis, so the equations need no gamma.
    """
    return ca.vertcat(q_r[:2], 0) if is_round(inertia) else q_r


def is_round(inertia: Sequence[Any]) -> bool:
    """Whether Ixx = Iyy, as numbers or as one symbol."""
    return bool(ca.is_equal(ca.SX(inertia[0]), ca.SX(inertia[1])))


def cardan_rates(q_r: Any, omega: Any, trig: Trig = EXACT_TRIG) -> Any:
    """q_r' = E(q_r)^-1 omega_R. Singular at beta = +-90 degrees, far beyond any air gap."""
    sb, cb, sg, cg = trig.sin(q_r[1]), trig.cos(q_r[1]), trig.sin(q_r[2]), trig.cos(q_r[2])
    if trig is SMALL_ANGLE_TRIG:  # E's own inverse: with these sines and cosines it is not the exact one
        return ca.solve(rate_map(q_r, trig), omega)
    dalpha = (cg * omega[0] - sg * omega[1]) / cb
    return ca.vertcat(dalpha, sg * omega[0] + cg * omega[1], omega[2] - sb * dalpha)


def acceleration(
    m: float, inertia: Sequence[float], q_r: Any, dq_r: Any, F_I: Any, T_B: Any, trig: Trig = EXACT_TRIG
) -> tuple[Any, Any]:
    """q_t'' and q_r'' under the force F_I (N) and the torque T_B about the centre of gravity (N m).

    B is the frame with the angles `principal_angles(q_r, inertia)`; `q_r` and `dq_r` are CasADi SX symbols; inertia is
    (Ixx, Iyy, Izz) in kg m2. With Omega the angular velocity of B and omega that of the body, both in B:
    I omega' + Omega x I omega = T_B and omega' = E q_r'' + (d omega / d q_r) q_r'.
    """
    if is_round(inertia) and trig is EXACT_TRIG:
        return F_I / m, _top_acceleration(inertia, q_r, dq_r, T_B)
    q_B = principal_angles(q_r, inertia)
    omega = rate_map(q_B, trig) @ dq_r
    spin = ca.vertcat(0, 0, dq_r[2] if is_round(inertia) else 0)
    I_m = ca.vertcat(*inertia)
    domega = (T_B - ca.cross(omega - spin, I_m * omega)) / I_m
    return F_I / m, cardan_rates(q_B, domega - ca.jtimes(omega, q_r, dq_r), trig)


def _top_acceleration(inertia: Sequence[Any], q_r: Any, dq_r: Any, T_B: Any) -> Any:
    """q_r'' of a body with Ixx = Iyy: the same equations solved by hand, because simulations evaluate them most often.

    With turn = sin(beta) alpha', omega = (cos(beta) alpha', beta', turn + gamma') and lean = Izz / Ixx omega_3 - turn:
    alpha'' = (T_1 / Ixx - beta' (lean - turn)) / cos(beta),     beta'' = T_2 / Ixx + omega_1 lean.
    """
    dalpha, dbeta, dgamma = dq_r[0], dq_r[1], dq_r[2]
    sb, cb = ca.sin(q_r[1]), ca.cos(q_r[1])
    turn, omega_1 = sb * dalpha, cb * dalpha
    lean = inertia[2] / inertia[0] * (turn + dgamma) - turn
    ddalpha = (T_B[0] / inertia[0] - dbeta * (lean - turn)) / cb
    ddbeta = T_B[1] / inertia[0] + omega_1 * lean
    return ca.vertcat(ddalpha, ddbeta, T_B[2] / inertia[2] - omega_1 * dbeta - sb * ddalpha)


def rotate(q_r: Any, a_I: Any, trig: Trig = EXACT_TRIG) -> Any:
    """R_RI a_I by one rotation after the other, in fewer operations than by the matrix."""
    (sa, sb, sg), (ca_, cb, cg) = ([fn(q_r[i]) for i in range(3)] for fn in trig)
    x, y, z = a_I[0], ca_ * a_I[1] + sa * a_I[2], ca_ * a_I[2] - sa * a_I[1]
    x, z = cb * x - sb * z, sb * x + cb * z
    return ca.vertcat(cg * x + sg * y, cg * y - sg * x, z)


def _matrix(rows: list[list[Any]]) -> Any:
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))
