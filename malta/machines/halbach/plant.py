"""A Halbach linear motor: three phase currents make one horizontal and one vertical force.

Source: L. C. Díaz-Pérez et al., Actuators 7(4), 2018; equation and figure numbers are its own.

    reference --> [ position law ] --> F_x --> [ commutation ] --> currents --> [ current loops ] --> [ motor ] --> x
                        ^  every 55 ms              ^  F_z, y, held                  ^  every 68 us      |
                        +--- laser -----------------+                                +--- two of three --+

SCALING. The transform is the paper's (6), P(x), with its inverse (9): they carry the factor 3/2 in one direction, so Id
and Iq are 1.5 x the amplitude of the phase currents, and F = A (Id, Iq) without a factor. Voltages are transformed
alike, so u = R i + L i' holds in these axes as it stands; power is 2/3 (Vd Id + Vq Iq).

HELD ANGLE. Between two readings of the laser the Park angle stands still, and so do the phase currents. A motor that
has moved on by d from that reading makes F_x cos(k d) - F_z sin(k d): it hangs on a spring of k F_z. Every model here
that a position controller is designed on has that spring in it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.model.data import check_parameters, si
from malta.model.plant import (
    Actuator,
    Electronics,
    Plant,
    Signal,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

PHASES = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)  # electrical angles of a, b, c
COS, SIN = ca.DM([math.cos(p) for p in PHASES]), ca.DM([math.sin(p) for p in PHASES])


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI; where each comes from is said in data/halbach.toml."""

    A: float = si("N/A", above=0)  # motor constant, of Id and Iq
    k: float = si("rad/m", above=0)  # wave number
    m: float = si("kg", above=0)  # moving stator
    b: float = si("N s/m", at_least=0)  # viscous friction
    K_e: float = si("V s/m", at_least=0)  # induced voltage of a phase
    R: float = si("ohm", above=0)  # phase winding
    L: float = si("H", above=0)
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
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "halbach.Parameters")
        if self.latency not in (0, 1):
            found = f"{self.latency:g}"
            raise InputError("halbach.Parameters", "latency", found, "0 or 1 readings of the laser")
        if not self.pm_cc < math.pi / 2:
            found = f"{math.degrees(self.pm_cc):.0f} deg"
            raise InputError("halbach.Parameters", "pm_cc", found, "less than 90 deg, as the loop integrates")


# The motor


def park(x: Any, k: Any) -> Any:
    """2 x 3: (6), phase quantities to d (horizontal) and q (vertical) at the position x."""
    return _park(ca.cos(k * x), ca.sin(k * x))


def unpark(x: Any, k: Any) -> Any:
    """3 x 2: (9), the inverse of `park` among phase quantities that sum to zero."""
    return 2 / 3 * park(x, k).T


def _park(c: Any, s: Any) -> Any:
    """`park` of the angle with this cosine and sine."""
    return ca.vertcat((c * COS + s * SIN).T, (s * COS - c * SIN).T)


def forces(par: Parameters, x: Any, i: Any) -> Any:
    """(F_x, F_z) of three phase currents at the position x: the motor law (1)."""
    return par.A * _linked(par, x) @ i


def lift(par: Parameters, x: FloatArray, i: FloatArray) -> FloatArray:
    """F_z, N, at k positions of k x 3 phase currents."""
    place, currents = ca.SX.sym("x"), ca.SX.sym("i", 3)
    law = ca.Function("lift", [place, currents], [forces(par, place, currents)[1]])
    return np.array(law.map(len(x))(np.atleast_2d(x), np.transpose(i))).ravel()


def _linked(par: Parameters, x: Any) -> Any:
    """2 x 3: `park`, each phase with its share of the motor constant."""
    return park(x, par.k) @ ca.diag(ca.vertcat(par.a_a, par.a_b, par.a_c))


def phase_currents(par: Parameters, x: Any, F_x: Any, F_z: Any) -> Any:
    """The three currents of smallest loss that make these forces at the position x of a sound motor."""
    return unpark(x, par.k) @ ca.vertcat(F_x, F_z) / par.A


def duty_cycles(par: Parameters, V: Any) -> Any:
    """0 to 1 of each half-bridge for these phase voltages: all at 1/2 is no voltage."""
    return 0.5 + V / par.V_dc


def motion(par: Parameters, x: Any, F_x: Any, w: Any) -> Any:
    """Rates of (x, x') under a horizontal force and one from outside: m x'' = F_x - b x' + w."""
    return ca.vertcat(x[1], (F_x - par.b * x[1] + w) / par.m)


def rates(par: Parameters, state: Any, V: Any, w: Any = 0) -> Any:
    """Rates of (x, x', i_a, i_b, i_c) under these voltages of the half-bridges; the star point floats."""
    x, i = state[0:2], state[2:5]
    drop = V - _resistive(par, i) - par.K_e * x[1] * _linked(par, x[0])[0, :].T
    return ca.vertcat(motion(par, x, forces(par, x[0], i)[0], w), (drop - ca.sum1(drop) / 3) / par.L)


def _resistive(par: Parameters, i: Any) -> Any:
    """Voltages of the windings' resistance."""
    return par.R * ca.vertcat(par.r_a, par.r_b, par.r_c) * i


def moved(par: Parameters, state: Any, V: Any, w: Any = 0) -> Any:
    """The motor one PWM period later, its half-bridges at these mean voltages: one Runge–Kutta step.

    Ripple within the period is left out, as in the paper. With L / R = 15 periods the step errs by 1e-8.
    """
    h = 1 / par.f_pwm
    k1 = rates(par, state, V, w)
    k2 = rates(par, state + h / 2 * k1, V, w)
    k3 = rates(par, state + h / 2 * k2, V, w)
    k4 = rates(par, state + h * k3, V, w)
    return state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def stiffness(par: Parameters, F_z: float, displacement: float = 0.0) -> float:
    """Of the spring of held currents, N/m: the tangent k F_z, or the secant over a displacement.

    NOTE: the paper's 205 N/m at 1 N is the secant over its identification step of 2 mm; the tangent is 211.
    """
    angle = par.k * displacement
    return F_z * (math.sin(angle) / displacement if displacement else par.k)


def emf_damping(par: Parameters) -> float:
    """What induced voltage adds to the friction while voltages are held, N s/m."""
    return 1.5 * par.A * par.K_e / par.R


def servo(par: Parameters, F_z: float, displacement: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """(5), the motor on held voltages about its equilibrium: (x, x')' = A (x, x') + B x_eq."""
    K = stiffness(par, F_z, displacement)
    A = np.array([[0, 1], [-K / par.m, -(par.b + emf_damping(par)) / par.m]])
    return A, np.array([[0], [K / par.m]])


# Electronics

Pwm = Literal["exact", "plain", "fine"]
MEAN_OF = 32  # samples in the rolling mean of a current, Sec. 4.2


@dataclass(frozen=True)
class Options:
    """What the electronics are; each source of error can be switched off."""

    pwm: Pwm = "plain"  # duty cycles: exact, or in steps of the counter, or of the high-resolution PWM
    adc_steps: bool = True
    adc_noise: bool = True
    mean_of: int = MEAN_OF  # samples in the rolling mean of a current
    current_loops: bool = True  # vector control; without them voltages are R times the wanted currents

    def __post_init__(self) -> None:
        if self.pwm not in get_args(Pwm):
            raise InputError("halbach.Options", "pwm", repr(self.pwm), _one_of(Pwm))
        if isinstance(self.mean_of, bool) or self.mean_of not in range(1, 4097):
            raise InputError("halbach.Options", "mean_of", repr(self.mean_of), "1 to 4096 samples")
        for name in ("adc_steps", "adc_noise", "current_loops"):
            if not isinstance(getattr(self, name), bool):
                raise InputError("halbach.Options", name, repr(getattr(self, name)), "True or False")


def _one_of(choices: Any) -> str:
    return "one of " + ", ".join(get_args(choices))


REAL = Options()
IDEAL = Options("exact", adc_steps=False, adc_noise=False)


def pwm_step(par: Parameters, pwm: Pwm) -> Any:
    """Smallest change of a phase voltage, V; 0 where duty cycles are exact."""
    return {"exact": 0.0, "plain": par.V_dc / par.counts, "fine": par.dV_fine}[pwm]


def adc_step(par: Parameters) -> Any:
    """A code of the current sensors, A."""
    return 2 * par.I_adc / par.codes


def modulated(par: Parameters, V: Any, pwm: Pwm) -> tuple[Any, Any]:
    """Duty cycles that the half-bridges make of wanted phase voltages, and whether any was beyond 0 to 1."""
    wanted = duty_cycles(par, V)
    d = ca.fmin(ca.fmax(wanted, 0), 1)
    limited = ca.mmax(ca.fabs(d - wanted)) > 0
    if pwm == "exact":
        return d, limited
    step = pwm_step(par, pwm) / par.V_dc
    return ca.fmin(_round(d / step) * step, 1), limited


def sampled_current(par: Parameters, i: Any, *, steps: bool) -> tuple[Any, Any]:
    """The code of a current, not rounded without steps, and whether it was out of range; 0 is -I_adc."""
    code = (i + par.I_adc) / adc_step(par)
    inside = ca.fmin(ca.fmax(_round(code) if steps else code, 0), par.codes)
    return inside, ca.fabs(i) > par.I_adc


def _round(x: Any) -> Any:
    return ca.floor(x + 0.5)


def settled(par: Parameters, references: Any, F_z: float, pwm: Pwm) -> FloatArray:
    """Where the open-loop motor comes to rest for these references, m: at the angle of what its voltages can be.

    Raises InputError where nothing holds it: without a vertical force upwards, or beyond what the supply can drive.
    """
    places = []
    for r in np.atleast_1d(np.asarray(references, dtype=float)):
        d, limited = modulated(par, par.R * phase_currents(par, r, 0, F_z), pwm)
        if not (F_z > 0 and math.isfinite(r)) or bool(limited):
            most = 0.75 * par.V_dc * par.A / par.R
            raise InputError("halbach", "settled", f"{F_z:g} N at {r:g} m", f"forces of 0 to {most:.1f} N")
        V_d, V_q = np.array(park(r, par.k) @ (par.V_dc * (d - 0.5))).ravel()
        places.append(r + math.atan2(V_d, V_q) / par.k)
    return np.array(places)


def dead_zones(par: Parameters, F_z: float, pwm: Pwm) -> tuple[FloatArray, FloatArray]:
    """Where references begin, over a pitch, that leave all duty cycles of the open-loop motor alike; and how long, m.

    The longest is the smallest motion that is sure to be one.
    """
    step = pwm_step(par, pwm)
    if not (step and F_z):
        raise InputError("halbach", "dead_zones", f"pwm {pwm!r} at {F_z:g} N", "steps, and a vertical force")
    amplitude = 2 / 3 * par.R * abs(F_z) / par.A / step  # of a phase voltage, in steps
    edges = np.arange(math.ceil(-amplitude - 0.5), math.floor(amplitude - 0.5) + 1) + 0.5
    rise = np.arcsin(edges[np.abs(edges) <= amplitude] / amplitude)
    angles = [np.concatenate([rise, math.pi - rise]) + phase for phase in PHASES]
    switched = np.sort(np.mod(np.concatenate(angles), 2 * math.pi))
    return switched / par.k, np.diff(np.concatenate([switched, switched[:1] + 2 * math.pi])) / par.k


# Current loops


class CurrentLoop(NamedTuple):
    """PI controller of Id and of Iq, u = Kp e + Ki integral of e."""

    Kp: float  # V/A
    Ki: float  # V/(A s)
    crossover: float  # rad/s


def current_delay(par: Parameters, mean_of: int) -> float:
    """Between a current and the voltage it causes, s: computation and hold, 1.5 periods, and the rolling mean."""
    return (1.5 + (mean_of - 1) / 2) / par.f_pwm


def current_loop(par: Parameters, mean_of: int) -> CurrentLoop:
    """The zero cancels the winding's pole, which leaves w e^(-s delay) / s; w is where its phase margin is pm_cc.

    The paper prints no gains. With its mean of 32 samples the delay is 1.16 ms and w is 451 rad/s, 27 times faster
    than the motor on its spring.
    """
    w = (math.pi / 2 - par.pm_cc) / current_delay(par, mean_of)
    return CurrentLoop(w * par.L, w * par.R, w)


def force_noise(par: Parameters, x: float | None = None) -> float:
    """Intensity of the horizontal force that noise of the current sensors makes inside the current loops, N2/Hz.

    Two samples of equal noise make Id, as the third current is computed: its variance is 1.5 to 4.5 times theirs as the
    Park angle goes, 3 times on average (x=None).
    """
    share = 3.0
    if x is not None:
        d = np.array(park(x, par.k))[0]
        share = float((d[0] - d[2]) ** 2 + (d[1] - d[2]) ** 2)
    return share * (par.A * par.s_adc) ** 2 / par.f_pwm


# The machine in the pipeline

POSITION = Signal("x", "m")
FORCE = Signal("F_x", "N")
COILS = tuple(Signal(f"i_{phase}", "A") for phase in "abc")


def plant(par: Parameters) -> Plant:
    """The motor along its travel: F_x is the input, F_z a parameter that commutation makes along with it."""
    return Plant(
        name="halbach",
        parameters=par,
        states=(POSITION, Signal("x_dot", "m/s")),
        inputs=(FORCE,),
        outputs=(POSITION,),
        disturbances=(FORCE,),
        uncontrolled=(),
        f=lambda x, u, w: motion(par, x, u[0], w[0]),
        h=lambda x, _: x[0],
        load=lambda _: ca.DM.zeros(1),
        position_of=lambda p: p,
        preload=lambda _: ca.DM.zeros(1),
        currents=lambda y, v: phase_currents(par, y[0], v[0], par.F_z),
        forces=lambda x, i: forces(par, x[0], i)[0],
        limited=lambda i: i / ca.fmax(1, ca.mmax(ca.fabs(i)) / par.I_adc),  # their sum stays zero
        tabulated=False,
        actuator=Actuator(
            coils=COILS,
            force_limit=(par.F_max,),
            force_constant=(par.A,),
            current_limit=par.I_adc,
            voltage_limit=par.V_dc / 2,
            R=par.R,
            L=par.L,
            crossover=current_loop(par, MEAN_OF).crossover,
            phase_margin=par.pm_cc,
            sample_time=1 / par.f_pwm,
            loop_delay=current_delay(par, MEAN_OF),
            dead_time=(par.latency + 0.5) * par.T_laser,
        ),
        windings=None,
        electronics=partial(electronics, par),
        contacts=("left the travel",),
        contact=lambda x: ca.fabs(x[0]) / par.travel,
        cushioned=(False,),
        bearing=lambda _: ca.DM.zeros(1),
        sense=lambda x, errors: x[0] + errors[0],
        sensor_errors=(Signal("offset_x", "m"),),  # of the Park angle: k times this
        noise=(par.n_laser / math.sqrt(3),),
        uniform=True,
        resolution=(par.dx,),
        inertia=(par.m,),
        mass=par.m,
        thrust="F_x",
        stroke="x",
        travel=par.travel,
        variant=plant,
    )


FLAGS = ("duty limit", "current range")


def electronics(par: Parameters, options: Options | None = None) -> Electronics:
    """Current loops on Id and Iq, their sensors and the half-bridges, as they run in every PWM period.

        i*, y --> [ held ] --> Id*, Iq*, cos, sin --> [ move: loops, modulator, windings, motor ] --> x, i
                               until the next reading     ^ two phase currents, rolling means ----------|

    Duty cycles that a period computes act in the next one. The loops know R, L and k, not the share that a phase has.
    Options of None are those of the paper, REAL.
    """
    o = REAL if options is None else options
    gains, n = current_loop(par, o.mean_of), o.mean_of
    sizes = {"duty": 3, "met": len(FLAGS)}
    if o.current_loops:
        sizes |= {"u": 2, "sums": 2, "ring_a": n, "ring_b": n}

    def held(i: Any, y: Any) -> Any:
        c, s = ca.cos(par.k * y[0]), ca.sin(par.k * y[0])
        return ca.vertcat(_park(c, s) @ i, c, s)

    def start(x: Any, i: Any) -> dict[str, Any]:
        P = park(x[0], par.k)
        drop = _resistive(par, i) if o.current_loops else par.R * i  # loops have found what each phase needs
        u = P @ drop
        codes = sampled_current(par, i[0:2], steps=o.adc_steps)[0]
        state = {
            "duty": modulated(par, 2 / 3 * P.T @ u, o.pwm)[0],
            "met": ca.DM.zeros(len(FLAGS)),
            "u": u,
            "sums": n * codes,
            "ring_a": ca.repmat(codes[0], n, 1),
            "ring_b": ca.repmat(codes[1], n, 1),
        }
        return {name: state[name] for name in sizes}

    def move(
        x: Any, i: Any, state: Mapping[str, Any], told: Any, w: Any, noise: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        P, after, far = _park(told[2], told[3]), dict(state), 0
        if o.current_loops:
            read = i[0:2] + (par.s_adc * noise if o.adc_noise else 0)
            codes, out = sampled_current(par, read, steps=o.adc_steps)
            far = ca.mmax(out)
            oldest = ca.vertcat(state["ring_a"][0], state["ring_b"][0])
            after |= {
                "sums": state["sums"] + codes - oldest,
                "ring_a": ca.vertcat(*ca.vertsplit(state["ring_a"])[1:], codes[0]),
                "ring_b": ca.vertcat(*ca.vertsplit(state["ring_b"])[1:], codes[1]),
            }
            mean = after["sums"] / n * adc_step(par) - par.I_adc
            e = told[0:2] - P @ ca.vertcat(mean, -ca.sum1(mean))  # (8): the third current is computed
            duty, limited = modulated(par, 2 / 3 * P.T @ (state["u"] + gains.Kp * e), o.pwm)
            after["u"] = state["u"] + ca.if_else(limited, 0, gains.Ki / par.f_pwm) * e
        else:
            duty, limited = modulated(par, 2 / 3 * P.T @ (par.R * told[0:2]), o.pwm)
        after |= {"duty": duty, "met": ca.fmax(state["met"], ca.vertcat(limited, far))}
        z = moved(par, ca.vertcat(x, i), par.V_dc * (state["duty"] - 0.5), w[0])
        return z[0:2], z[2:5], after

    return Electronics(
        period=1 / par.f_pwm,
        state=sizes,
        noises=2 if o.current_loops and o.adc_noise else 0,
        flags=FLAGS,
        held_size=4,
        held=held,
        start=start,
        move=move,
        met=lambda state: state["met"],
        duty=lambda state: state["duty"],
    )
