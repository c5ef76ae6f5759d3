"""The parameters of the planar motor."""

from __future__ import annotations

from dataclasses import dataclass

from malta.errors import InputError
from malta.model.parameters import check_parameters, si

COIL_ORDER = 16  # of the wrench: the mean over a coil makes higher ones negligible; see test_planar.py


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI. data/planar.toml has the source of each."""

    tau_n: float = si("m", above=0, shapes=True)  # pole pitch along x and y
    w_c: float = si("m", above=0, shapes=True)  # width of a coil's leg
    h_c: float = si("m", above=0, shapes=True)  # height of a coil
    l_c: float = si("m", above=0, shapes=True)  # length of a leg, and distance of opposite legs' axes
    r_c: float = si("m", at_least=0, shapes=True)  # inner corner radius of a coil
    N_c: float = si("1", above=0)  # turns
    h_m: float = si("m", above=0, shapes=True)  # thickness of the magnets
    B_r: float = si("remanence [T]", above=0)  # their remanence, relative permeability 1
    upright: float = si("1", above=0, shapes=True)  # upright blocks' width over sqrt(2) tau_n
    h: float = si("m", above=0)  # air gap: the working height
    B_z: float = si(
        "flux density [T]", above=0
    )  # flux density that (17)-(24) count with, at the working height
    C: float = si("1", above=0)  # harmonic compensation factor of (23), (24)
    coil_pitch: float = si("m", above=0)  # of the 4 x 4 coils
    r_z: float = si("height of the force [m]")  # centre of gravity to the coils' centre of force
    w_m: float = si("m", above=0)  # width of the mover's square plate
    m: float = si("mass [kg]", above=0)  # mover with coils
    I_x: float = si("moment of inertia [kg m^2]", above=0)
    I_y: float = si("moment of inertia [kg m^2]", above=0, twin="I_x")
    I_z: float = si("moment of inertia [kg m^2]", above=0)
    g: float = si("m/s^2", at_least=0)
    F_max: float = si("N", above=0)  # limit of each commanded force
    T_max: float = si("N m", above=0)  # limit of each commanded torque
    I_max: float = si("A", above=0)  # limit of each coil current
    T_s: float = si("s", above=0, shapes=True)  # control period
    T_d: float = si("s", at_least=0, shapes=True)  # dead time of computation and hold
    xy_max: float = si("m", above=0)  # travel in the plane, either way
    z_max: float = si("m", above=0)  # greatest height
    s_p: float = si("m", at_least=0)  # position sensor noise, rms of a sample
    s_a: float = si("rad", at_least=0)  # angle sensor noise, rms of a sample
    order: float = si("1", at_least=1, shapes=True)  # harmonics of the controller's coil model; 1: (17)-(24)
    cells: float = si("1", at_least=0, shapes=True)  # of its table over tau_n, along x and y; 0: no table
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "planar.Parameters")
        if self.upright >= 1:
            raise InputError("planar.Parameters", "upright", f"{self.upright}", "a share below 1")
        straight = self.l_c - self.w_c - 2 * self.r_c
        if not straight > 0:
            raise InputError(
                "planar.Parameters", "r_c", f"{self.r_c} m", f"a corner that fits legs {self.l_c} m apart"
            )
        if not self.coil_pitch >= self.l_c + self.w_c:
            found, coil = f"{self.coil_pitch} m", self.l_c + self.w_c
            raise InputError(
                "planar.Parameters", "coil_pitch", found, f"at least {coil:.6g} m, the width of a coil"
            )
        if not self.z_max > self.h:
            raise InputError("planar.Parameters", "z_max", f"{self.z_max} m", f"more than h, {self.h} m")
        if not (self.order <= COIL_ORDER and self.order == int(self.order)):
            expected = f"a whole number from 1 to {COIL_ORDER}"
            raise InputError("planar.Parameters", "order", f"{self.order:g}", expected)
        if self.cells != int(self.cells):
            raise InputError("planar.Parameters", "cells", f"{self.cells:g}", "a whole number")
