"""The parameters of the Halbach linear motor."""

from __future__ import annotations

import math
from dataclasses import dataclass

from malta.errors import InputError
from malta.model.parameters import check_parameters, si

# m, air gap at which A and K_e stand: Sec. 2.3. NOTE: the paper does not say at which gap A was measured; it has one.
GAP = 0.4e-3


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI. data/halbach.toml has the source of each."""

    A: float = si("motor constant [N/A]", above=0)  # motor constant, of Id and Iq
    k: float = si("rad/m", above=0)  # wave number
    m: float = si("mass [kg]", above=0)  # moving stator
    b: float = si("friction [N s/m]", at_least=0)  # viscous friction
    K_e: float = si("V s/m", at_least=0)  # induced voltage of a phase
    R: float = si("resistance [ohm]", above=0)  # phase winding
    L: float = si("inductance [H]", above=0)
    V_dc: float = si("V", above=0)
    f_pwm: float = si("Hz", above=0, shapes=True)
    counts: float = si("1", above=0)  # steps of a duty cycle
    dV_fine: float = si("V", above=0)  # step of the high-resolution PWM
    I_adc: float = si("A", above=0)  # full scale, either way
    codes: float = si("1", above=0)  # the largest
    s_adc: float = si("A", at_least=0)  # noise of a current sample, rms
    T_laser: float = si("s", above=0, shapes=True)  # time between readings
    dx: float = si("m", above=0)  # resolution of the laser
    n_laser: float = si("m", at_least=0)  # its noise is uniform within +- this
    latency: float = si("1", at_least=0, shapes=True)  # readings that the controller is late: 0 or 1
    F_z: float = si("N", at_least=0)  # vertical force, commanded open loop
    F_max: float = si("N", above=0)  # limit of the horizontal force
    travel: float = si("m", above=0)  # from end to end; either end may be where moves begin, x = 0
    pm_cc: float = si("rad", above=0)  # phase margin of the current loops
    r_a: float = si("1", above=0)  # resistance of each phase in R, which is what the current loops know
    r_b: float = si("1", above=0)
    r_c: float = si("1", above=0)
    a_a: float = si("1", above=0)  # motor constant of each phase in A, which is what commutation knows
    a_b: float = si("1", above=0)
    a_c: float = si("1", above=0)
    z_0: float = si("m", above=0, default=GAP)  # air gap
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "halbach.Parameters")
        if self.latency not in (0, 1):
            found = f"{self.latency:g}"
            raise InputError("halbach.Parameters", "latency", found, "0 or 1 readings of the laser")
        if not self.pm_cc < math.pi / 2:
            found = f"{math.degrees(self.pm_cc):.0f} deg"
            raise InputError("halbach.Parameters", "pm_cc", found, "less than 90 deg, as the loop integrates")
