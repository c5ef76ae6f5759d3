"""Windings: the two-directional dq transformation, and position sensing by Hall sensors.

A module has 3 x 3 coils, r around and c along the machine; x_rc is any phase quantity. Eq. (16), X_dq = K_R X_abc K_L:

    K_R(phi)   = [1/3 1/3 1/3; 2/3 cos(phi - 2 pi r / 3)]               zero sequence, bearing axis
    K_L(theta) = 2/3 [cos(theta - 2 pi c / 3), -sin(theta - 2 pi c / 3)],   theta = pi z / L_p

The paper does not print the two; these map pure currents to single entries of 1 (amplitude-invariant). Both have rank
2 and inverses in the Moore-Penrose sense only: five of the nine modes carry no current.

NOTE: (18) commands a magnitude and an angle phi = atan2(f_y, f_x) (the paper prints a quotient in it). That angle is
undefined at zero force and jumps by pi through it. Here phi is constant, 0 and pi/2: two fixed bearing axes,
d along x and q along y, whose currents are f_x / K_B and f_y / K_B. The axes of a module are AXES, rotary letter first.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca

from malta.model.equations import note

AXES = ("0d", "0q", "dd", "dq", "qd", "qq")
WEIGHT = (4.5, 4.5, 2.25, 2.25, 2.25, 2.25)  # power of a module = sum of weight u i
TURN = 2 * math.pi / 3


def K_R(phi: Any) -> Any:
    """2 x 3: zero sequence and the bearing axis at the angle phi (rad), of the three coils around the machine."""
    return ca.vertcat(
        ca.horzcat(*[1 / 3] * 3), ca.horzcat(*(2 / 3 * ca.cos(phi - TURN * r) for r in range(3)))
    )


def K_L(theta: Any) -> Any:
    """3 x 2: d and q along the machine at the electrical angle theta (rad), of the three coils along it."""
    angles = [theta - TURN * c for c in range(3)]
    cosines, sines = (ca.vertcat(*(wave(a) for a in angles)) for wave in (ca.cos, ca.sin))
    note(
        "wave",
        "cosines, sines of theta - 2 pi c / 3 for c = 0, 1, 2, theta = pi z / L_p",
        cosines=cosines,
        sines=sines,
    )
    return 2 / 3 * ca.horzcat(cosines, -sines)


def K_R_inverse(phi: Any) -> Any:
    """3 x 2, Moore-Penrose: K_R' with its orthogonal rows scaled by 1 / |row|^2 = 3 and 3/2."""
    return K_R(phi).T @ ca.diag(ca.DM([3, 1.5]))


def K_L_inverse(theta: Any) -> Any:
    """2 x 3, Moore-Penrose: K_L' with its orthogonal columns scaled by 1 / |column|^2 = 3/2."""
    return 1.5 * K_L(theta).T


def _around() -> Any:
    """3 x 3: zero sequence and the two fixed bearing axes, at 0 (d) and pi/2 (q)."""
    return ca.vertcat(K_R(0), K_R(math.pi / 2)[1, :])


def to_axes(theta: Any) -> Any:
    """6 x 9: a module's phase quantities (x_11 x_12 x_13 x_21 ...) to AXES, phi fixed at 0 (d) and pi/2 (q)."""
    T = ca.kron(_around(), K_L(theta).T)
    meaning = "T_d = 2/3 R x cosines, T_q = 2/3 R x sines, of a module; axes d are T_d i, axes q -T_q i"
    note("axes_of_phases", meaning, T_d=T[0::2, :], T_q=-T[1::2, :])
    return T


def to_phases(theta: Any) -> Any:
    """9 x 6: AXES to phase quantities, the Moore-Penrose inverse of `to_axes`."""
    T = ca.kron(_around().T @ ca.diag(ca.DM([3, 1.5, 1.5])), K_L_inverse(theta).T)
    meaning = "U_d = R' diag(3, 3/2, 3/2) x cosines, U_q the same of sines"
    note(
        "phases_of_axes",
        f"{meaning}, of a module; u_phase = U_d u_d - U_q u_q",
        U_d=T[:, 0::2],
        U_q=-T[:, 1::2],
    )
    return T


def magnitude_and_angle(f_x: float, f_y: float, K_B: float, phi_before: float = 0.0) -> tuple[float, float]:
    """i_bd (A) and phi (rad) of the printed form (18). At zero force, where the angle is undefined, it is `phi_before`.

    A force that passes through zero turns phi by pi within one sample, faster than any current can follow.
    """
    force = math.hypot(f_x, f_y)
    return force / K_B, math.atan2(f_y, f_x) if force else phi_before


def hall_position(z: Any, x: Any, y: Any, pole: Any, errors: Any) -> Any:
    """Axial position as atan2 of the two planes' averaged Hall signals gives it, m.

    Each plane has four sensors, on +x, +y, -x, -y; the field grows as e^(pi r / L_p) towards a sensor that the mover
    nears by r, so one sensor reads z and r alike. Their average keeps (cosh(pi x / L_p) + cosh(pi y / L_p)) / 2, in
    which the first order cancels. Half a pole apart, one plane gives the cosine and the other the sine.
    x, y    : radial positions at the two planes, m, two each
    errors  : amplitude of the sine relative to the cosine less 1; its phase error, rad; share of the radial
              sensitivity that averaging leaves (0 as built, 1 for a single sensor on +x)
    """
    k = math.pi / pole
    amplitude, phase, single = errors
    cosine, sine = (
        (1 - single) * (ca.cosh(k * x[i]) + ca.cosh(k * y[i])) / 2 + single * ca.exp(k * x[i]) for i in (0, 1)
    )
    angle = ca.atan2((1 + amplitude) * sine * ca.sin(k * z + phase), cosine * ca.cos(k * z))
    turns = (k * z - angle) / (2 * math.pi)
    return (angle + 2 * math.pi * ca.floor(turns + 0.5)) / k  # counts periods: never wrong by one
