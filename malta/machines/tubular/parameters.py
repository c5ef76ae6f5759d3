"""The parameters of the tubular actuator."""

from __future__ import annotations

from dataclasses import dataclass

from malta.model.parameters import check_parameters, si


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI. data/tubular.toml has the source of each."""

    m: float = si("mass [kg]", above=0)  # mover with magnets
    I_xx: float = si("moment of inertia [kg m^2]", above=0)  # moments of inertia in frame R
    I_yy: float = si("moment of inertia [kg m^2]", above=0, twin="I_xx")
    I_zz: float = si("moment of inertia [kg m^2]", above=0)
    K_A: float = si("magnet stiffness [N/m]", at_least=0)  # attraction per module (a negative stiffness)
    K_B: float = si("force constant [N/A]", above=0)  # bearing force per module
    K_D: float = si("thrust constant [N/A]", above=0)  # drive force per module
    l_B: float = si("bearing distance [m]", above=0)  # origin to bearing plane
    l_S: float = si("m", above=0)  # origin to sensor plane
    L_p: float = si("m", above=0)  # pole size
    g: float = si("m/s^2", at_least=0)
    F_c: float = si("cogging [N]", at_least=0)  # cogging amplitude
    phi_c: float = si("rad")  # cogging phase
    R: float = si("resistance [ohm]", above=0)  # phase winding
    L: float = si("inductance [H]", above=0)
    Psi: float = si("Wb", above=0)  # flux linkage
    K_ind: float = si("V s/m", above=0)  # induced voltage
    V_dc: float = si("V", above=0)  # DC link
    C_dc: float = si("F", above=0)
    V_max: float = si("V", above=0)  # phase-voltage limit
    I_max: float = si("A", above=0)  # current limit per dq axis
    f_pwm: float = si("Hz", above=0)
    T_cc: float = si("s", above=0)  # period of the current controllers
    w_cc: float = si("rad/s", above=0)  # crossover of the current loops
    pm_cc: float = si("rad", above=0)  # phase margin of the current loops
    T_d: float = si("s", at_least=0, shapes=True)  # dead time of computation and hold
    z_max: float = si("m", above=0)  # axial travel, either way
    r_max: float = si("m", above=0)  # radial travel, either way: touchdown
    s_r: float = si("m", at_least=0)  # radial sensors' noise, rms of a sample and of the four
    s_z: float = si("m", at_least=0)  # axial sensor noise, rms of a sample
    dp: float = si("m", at_least=0)  # radial sensor resolution
    k_t: float = si("N/m", above=0)  # touchdown bearing, each
    d_t: float = si("N s/m", at_least=0)
    R_dc: float = si("ohm", above=0)  # supply and cable in front of the DC link
    f_clk: float = si("Hz", above=0)  # clock of the pulse-width modulators
    t_dead: float = si("s", at_least=0)  # dead time of the half-bridges
    dK_A: float = si("1", above=-1, below=1, default=0)  # K_A (1 - dK_A) of module 1, K_A (1 + dK_A) of 2
    dK_B: float = si("1", above=-1, below=1, default=0)  # the same of K_B
    kappa: float = si("1", at_least=0, default=0)  # growth of K_A up to touchdown, over K_A
    e_x: float = si("m", default=0)  # magnetic centre, as the sensors see it
    e_y: float = si("m", default=0)
    c_x: float = si("m", default=0)  # centre of gravity off the mover's axis, in frame R
    c_y: float = si("m", default=0)
    s_i: float = si("A", at_least=0, default=0)  # noise of a current sensor, rms of a sample
    d_i: float = si("A", default=0)  # offset of each current sensor, with signs of drive.py
    q_i: float = si("A", at_least=0, default=0)  # steps of a current sensor
    tau_s: float = si("s", at_least=0, default=0)  # lag of the radial sensors and their demodulation
    T_s: float = si("s", at_least=0, shapes=True, default=0)  # dead time of all position sensors
    n_x1: float = si("1", at_least=0, default=1)  # noise of a radial sensor, over s_r
    n_y1: float = si("1", at_least=0, default=1)
    n_x2: float = si("1", at_least=0, default=1)
    n_y2: float = si("1", at_least=0, default=1)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "tubular.Parameters")
