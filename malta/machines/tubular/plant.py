"""MALTA: a magnetically levitated tubular actuator with two stator modules.

Source: S. Miric et al., IEEE Trans. Ind. Electron. 68(1), 2021; equation and table numbers are its own.
State: x y z, the Cardan angles alpha beta gamma, and their rates. The mover's axis is z, gravity is along -y.
Two modules act at z = -l_B and z = +l_B, two radial sensor planes sit at z = -l_S and z = +l_S. Modules that differ and
a mover out of balance are those of drive.py and plant.py.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import casadi as ca

from malta.machines.tubular.drive import (
    SIDES,
    attraction,
    bearing_constants,
    difference_of_attraction,
    drive,
    hall_position,
    levers,
    potential,
)
from malta.machines.tubular.parameters import Parameters as Parameters
from malta.model.actuator import Actuator
from malta.model.contacts import Contacts
from malta.model.plant import Plant, Signal, trace
from malta.model.rigid_body import (
    EXACT_TRIG,
    SMALL_ANGLE_TRIG,
    Body,
    Resultant,
    Trig,
    acceleration,
    principal_angles,
    rate_map,
    rotate,
    rotation,
)
from malta.model.sensors import Sensors
from malta.model.stroke import Stroke

# The mover's centre of gravity off its axis, by c = (c_x, c_y, 0) in frame R.
#
# The position x y z is that of the point A of the mover's axis, the axis of its magnets and the one that the sensors
# see. The centre of gravity O is off it by r = R_IR c, so with F at the axis, moments T_A about A, and w at O
#
#     m (A'' + r'') = F + w,     I omega' + omega x I omega = T_A - r x F + w_T.
#
# Two effects remain of an unbalance on a mover that is not driven round: thrust along the axis tilts the mover by
# the torque c x f_D, and the weight hangs below the axis: the mover rolls as a pendulum of the frequency
# sqrt(m g |c| / I_zz). A principal axis that is tilted against the axis of the magnets acts only through products of
# angular rates, so it is left out.


def centre_of_gravity(par: Parameters, q_r: Any, trig: Trig = EXACT_TRIG) -> Any:
    """r = R_IR c: from the mover's axis to its centre of gravity, in frame I, m."""
    return rotation(q_r, trig).T @ ca.vertcat(par.c_x, par.c_y, 0)


def second_derivative(r: Any, q: Any, dq: Any, ddq: Any) -> Any:
    """r'' of an expression r of q; q and dq are CasADi SX symbols."""
    return ca.jtimes(ca.jtimes(r, q, dq), q, dq) + ca.jtimes(r, q, ddq)


POSITIONS = tuple(Signal(n, "m") for n in "xyz") + tuple(Signal(n, "rad") for n in ("alpha", "beta", "gamma"))
RATES = tuple(Signal(f"{s.name}_dot", f"{s.unit}/s") for s in POSITIONS)
INPUTS = tuple(Signal(n, "N") for n in ("fx_B1", "fy_B1", "fx_B2", "fy_B2", "f_D"))
COILS = tuple(Signal(s.name.replace("f", "i", 1), "A") for s in INPUTS)  # axes of inputs' transformation
OUTPUTS = tuple(Signal(n, "m") for n in ("x1", "y1", "x2", "y2", "z"))
SENSOR_ERRORS = (
    *(Signal(f"gain_{s.name}", "1") for s in OUTPUTS[:4]),
    *(Signal(f"offset_{s.name}", "m") for s in OUTPUTS[:4]),
    Signal("hall_amplitude", "1"),
    Signal("hall_phase", "rad"),
    Signal("hall_single", "1"),
)
WRENCH = tuple(Signal(f"F_{a}", "N") for a in "xyz") + tuple(Signal(f"T_{a}", "N m") for a in "xyz")


def plant(par: Parameters, *, small_angle: bool = False) -> Plant:
    """The nonlinear mover, six degrees of freedom, exact trigonometry.

    small_angle: the paper's own equations (sin a = a, cos a = 1; attraction without an axial part).
    """
    x, u, w = ca.SX.sym("x", 12), ca.SX.sym("u", 5), ca.SX.sym("w", 6)
    trig = SMALL_ANGLE_TRIG if small_angle else EXACT_TRIG
    K_B1, K_B2 = bearing_constants(par)
    constants = (K_B1, K_B1, K_B2, K_B2, 2 * par.K_D)  # f_D = f_D1 + f_D2, eq. (17)
    return Plant(
        name="tubular",
        parameters=par,
        states=POSITIONS + RATES,
        inputs=INPUTS,
        outputs=OUTPUTS,
        disturbances=WRENCH,
        uncontrolled=("gamma", "gamma_dot"),
        f=trace("f", [x, u, w], lambda x, u, w: ca.vertcat(x[6:], _acceleration(par, x, u, w, trig))),
        h=lambda x, _: measure_outputs(par, x, trig),
        load=lambda x: load(par, x, trig),
        position_of=lambda p: position_of(par, p),
        preload=lambda _: ca.DM.zeros(5),
        actuator=_actuator(par, constants),
        contacts=Contacts(
            names=("touchdown at sensor plane 1", "touchdown at sensor plane 2", "axial end stop"),
            contact=lambda x: contact(par, x, trig),
            cushioned=(True, True, False),
            bearing=trace("bearing", [x], lambda x: touchdown_bearing(par, x, trig)),
        ),
        sensors=Sensors(
            sense=lambda x, errors: sense_outputs(par, x, errors, trig),
            errors=SENSOR_ERRORS,
            lag=(*[par.tau_s] * 4, 0.0),
            dead_time=par.T_s,
            noise=(*(par.s_r * n for n in (par.n_x1, par.n_y1, par.n_x2, par.n_y2)), par.s_z),
            resolution=(par.dp, par.dp, par.dp, par.dp, 0.0),
        ),
        stroke=Stroke("z", thrust="f_D", travel=par.z_max, mass=par.m),
        inertia=(0.0, 0.0, 0.0, 0.0, par.m),
        bodies=partial(_bodies, par),
        variant=partial(plant, small_angle=small_angle),
    )


def _bodies(par: Parameters) -> tuple[Body, ...]:
    """The modules, whose bore is drawn wide for magnified motion; the mover as a cylinder of its mass and inertia."""
    radius = math.sqrt(2 * par.I_zz / par.m)
    length = math.sqrt(max(12 * par.I_xx / par.m - 3 * radius**2, radius**2))
    bore = 2.6 * radius
    modules = (
        Body(
            f"module {k}", "cylinder", (bore, bore, 1.8 * par.l_B), (0.0, 0.0, sign * par.l_B),
            resultants=(Resultant(f"module {k}", (f"fx_B{k}", f"fy_B{k}", "")),),
        )
        for k, sign in ((1, -1), (2, 1))
    )  # fmt: skip
    moves, drives = tuple(s.name for s in POSITIONS), (Resultant("drives", ("", "", "f_D")),)
    size = (2 * radius, 2 * radius, length)
    return (*modules, Body("mover", "cylinder", size, moves=moves, resultants=drives))


def _actuator(par: Parameters, constants: tuple[float, ...]) -> Actuator:
    """The current loops, their limits and the windings; `constants` are N/A of each input."""
    return Actuator(
        coils=COILS,
        force_limit=tuple(par.I_max * constant for constant in constants),
        force_constant=constants,
        current_limit=par.I_max,
        voltage_limit=par.V_max,
        R=par.R,
        L=par.L,
        crossover=par.w_cc,
        phase_margin=par.pm_cc,
        sample_time=par.T_cc,
        loop_delay=par.T_d,
        dead_time=par.T_d,
        windings=drive(par),
    )


def _acceleration(par: Parameters, x: Any, u: Any, w: Any, trig: Trig) -> Any:
    """(x y z)'' of the mover's axis and (alpha beta gamma)'' under forces u of the modules and a wrench w."""
    inertia, q_r, dq_r = (par.I_xx, par.I_yy, par.I_zz), x[3:6], x[9:12]
    q_B = principal_angles(q_r, inertia)
    n, r = rotation(q_r, trig)[2, :2].T, centre_of_gravity(par, q_r, trig)
    F_I, M_I = _wrench(par, x, u, n, conservative=trig is EXACT_TRIG)
    # The points of force lie on the mover's axis: T_B = sum of l_i e_z x F_i, in frame B, from the moment sum l_i F_i.
    T_B = ca.cross(ca.SX([0, 0, 1]), rotate(q_B, M_I, trig)) + rotate(q_B, w[3:] - ca.cross(r, F_I), trig)
    a_O, ddq_r = acceleration(par.m, inertia, q_r, dq_r, F_I + w[:3], T_B, trig)
    return ca.vertcat(a_O - second_derivative(r, q_r, dq_r, ddq_r), ddq_r)


def _wrench(par: Parameters, x: Any, u: Any, n: Any, *, conservative: bool) -> tuple[Any, Any]:
    """Sums of F_i and of l_i F_i over the modules, in frame I: eqs (5)-(14). n: x and y of the mover's axis.

    F_i = (fx_i, fy_i, f_D / 2) + K_A P_i,xy acts at P_i = O + l_i n with l_1 = -(l_B + z), l_2 = l_B - z. As
    l_1 + l_2 = -2 z and l_1^2 + l_2^2 = 2 (l_B^2 + z^2), the attraction sums up to F_A = 2 K_A (O - z n) and its moment
    to 2 K_A l_B^2 n - z F_A. Modules that differ add their differences, and their pull at P = 0 is a load.
    NOTE: eq. (12) prints (l_B + z) in the second lever arm; eq. (5) gives (l_B - z), and only with that is the
    linearized stiffness symmetric.
    """
    z, f_1, f_2, f_D = x[2], u[0:2], u[2:4], u[4]
    F_A = 2 * par.K_A * (x[0:2] - z * n)
    F_xy = f_1 + f_2 + F_A
    M_xy = par.l_B * (f_2 - f_1) + 2 * par.K_A * (par.l_B * par.l_B) * n - z * F_xy
    for side, l_i in zip(SIDES, levers(par, z), strict=True):
        more = difference_of_attraction(par, side, x[0:2] + l_i * n)
        F_A, F_xy, M_xy = F_A + more, F_xy + more, M_xy + l_i * more
    # The potential -K_A |P_i,xy|^2 / 2 has an axial slope too, because l_i falls as z grows. The paper's (9), (10)
    # leave it out. It is of second order and absent from every linearization, but without it energy is not conserved.
    F_z = f_D - ca.dot(F_A, n) if conservative else f_D
    return ca.vertcat(F_xy, F_z), ca.vertcat(M_xy, -z * f_D)


def load(par: Parameters, x: Any, trig: Trig = EXACT_TRIG) -> Any:
    """Gravity (missing from eq. (6)), cogging and the pull of magnets off the centre, as a wrench at the centre of
    gravity.

    The magnets act on the mover's axis; their pull has an axial part there, as in _wrench.
    """
    cogging = par.F_c * ca.sin(2 * math.pi / par.L_p * x[2] + par.phi_c)
    n = rotation(x[3:6], trig)[2, :].T
    force, torque = ca.vertcat(0, 0, cogging), ca.DM.zeros(3)
    for side, l_i in zip(SIDES, levers(par, x[2]), strict=True):
        F = attraction(par, side, ca.DM.zeros(2))
        force += ca.vertcat(F, -ca.dot(F, n[:2]) if trig is EXACT_TRIG else 0)
        torque += ca.cross(l_i * n, ca.vertcat(F, 0))
    torque -= ca.cross(centre_of_gravity(par, x[3:6], trig), force)
    return ca.vertcat(force + ca.vertcat(0, -par.m * par.g, 0), torque)


def measure_outputs(par: Parameters, x: Any, trig: Trig = EXACT_TRIG) -> Any:
    """p = (x1, y1, x2, y2, z): where the mover's axis intersects the planes z = -l_S and z = +l_S.

    With small angles this is p = P_0(z) q, eq. (15).
    """
    n = rotation(x[3:6], trig)[2, :].T
    slope = n[0:2] / n[2]
    return ca.vertcat(x[0:2] - (par.l_S + x[2]) * slope, x[0:2] + (par.l_S - x[2]) * slope, x[2])


def contact(par: Parameters, x: Any, trig: Trig = EXACT_TRIG) -> Any:
    """Shares of the clearances that are used up, 1 at contact; touchdown bearings are in the sensor planes."""
    p = measure_outputs(par, x, trig)
    radii = [ca.sqrt(p[i] ** 2 + p[i + 1] ** 2) / par.r_max for i in (0, 2)]
    return ca.vertcat(*radii, ca.fabs(p[4]) / par.z_max)


def touchdown_bearing(par: Parameters, x: Any, trig: Trig = EXACT_TRIG) -> Any:
    """Wrench of the touchdown bearings in the sensor planes: k_t delta + d_t delta', never pulling, without friction.

    delta is how far the mover's axis is beyond the clearance r_max at the plane. The axial end stops push alike where
    the stroke is beyond z_max; a simulation ends there, a co-simulation goes on. `x` is a CasADi SX symbol.
    """
    rates = ca.vertcat(x[6:12], ca.SX.zeros(6))
    p = measure_outputs(par, x, trig)
    dp = ca.jtimes(p, x, rates)
    force, torque = ca.SX.zeros(3), ca.SX.zeros(3)

    def push_of(delta: Any, outwards: Any) -> Any:
        return ca.if_else(delta > 0, ca.fmax(par.k_t * delta + par.d_t * outwards, 0), 0)

    middle = x[0:3] + centre_of_gravity(par, x[3:6], trig)
    for i, plane in ((0, -par.l_S), (2, par.l_S)):
        r, dr = p[i : i + 2], dp[i : i + 2]
        size = ca.sqrt(ca.sumsqr(r) + 1e-24)
        push = push_of(size - par.r_max, ca.dot(r, dr) / size)
        F = ca.vertcat(-push * r / size, 0)
        force += F
        torque += ca.cross(ca.vertcat(r, plane) - middle, F)
    force[2] -= ca.sign(p[4]) * push_of(ca.fabs(p[4]) - par.z_max, ca.sign(p[4]) * dp[4])
    return ca.vertcat(force, torque)


def sense_outputs(par: Parameters, x: Any, errors: Any, trig: Trig = EXACT_TRIG) -> Any:
    """Sensor signals before noise: eddy-current sensors with gain and offset errors, Hall sensors for z."""
    p = measure_outputs(par, x, trig)
    radial = [(1 + errors[i]) * p[i] + errors[4 + i] for i in range(4)]
    z = hall_position(p[4], (p[0], p[2]), (p[1], p[3]), par.L_p, (errors[8], errors[9], errors[10]))
    return ca.vertcat(*radial, z)


def position_of(par: Parameters, p: Any) -> Any:
    """q = (x, y, z, alpha, beta) = P(z)^-1 p. det P = (2 l_S)^2 for every z, so it always exists.

    NOTE: the paper calls P_0 not invertible: that holds for the 5 x 6 matrix with gamma only.
    """
    alpha, beta = (p[1] - p[3]) / (2 * par.l_S), (p[2] - p[0]) / (2 * par.l_S)
    return ca.vertcat((p[0] + p[2]) / 2 + p[4] * beta, (p[1] + p[3]) / 2 - p[4] * alpha, p[4], alpha, beta)


def energy(par: Parameters, x: Any) -> Any:
    """Kinetic plus potential energy, J: constant without inputs and disturbances."""
    n = rotation(x[3:6])[2, :].T
    omega = rate_map(x[3:6]) @ x[9:12]
    r = centre_of_gravity(par, x[3:6])
    velocity = x[6:9] + ca.jtimes(r, x[3:6], x[9:12])
    kinetic = par.m / 2 * ca.sumsqr(velocity) + ca.dot(ca.vertcat(par.I_xx, par.I_yy, par.I_zz), omega**2) / 2
    wave = 2 * math.pi / par.L_p
    stored = par.m * par.g * (x[1] + r[1]) + par.F_c / wave * ca.cos(wave * x[2] + par.phi_c)
    for side, l_i in zip(SIDES, levers(par, x[2]), strict=True):
        stored += potential(par, side, x[0:2] + l_i * n[0:2])
    return kinetic + stored
