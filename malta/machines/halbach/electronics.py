"""Electronics of the Halbach motor: half-bridges, current sensors and current loops, period by period."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np
from scipy.special import ndtr

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.machines.halbach.parameters import GAP, Parameters
from malta.model.drive import Electronics
from malta.model.equations import note
from malta.model.plant import Signal
from malta.simulation.period import runge_kutta

# The Halbach motor: Park transform, forces, motion and voltages of the three phases.
#
# Equation numbers are those of the paper named in plant.py. Functions take and give CasADi expressions or numbers
# unless they say otherwise; `par` are the parameters of the plant.


PHASES = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)  # electrical angles of a, b, c
COS, SIN = ca.DM([math.cos(p) for p in PHASES]), ca.DM([math.sin(p) for p in PHASES])


def park(x: Any, k: Any) -> Any:
    """2 x 3: (6), phase quantities to d (horizontal) and q (vertical) at the position x."""
    cosine, sine = ca.cos(k * x), ca.sin(k * x)
    note("wave", "cosine, sine of k y", cosine=cosine, sine=sine)
    return park_of_angle(cosine, sine)


def unpark(x: Any, k: Any) -> Any:
    """3 x 2: (9), the inverse of `park` among phase quantities that sum to zero."""
    return 2 / 3 * park(x, k).T


def park_of_angle(c: Any, s: Any) -> Any:
    """2 x 3: `park` from the cosine and the sine of the angle k x."""
    return ca.vertcat((c * COS + s * SIN).T, (s * COS - c * SIN).T)


def gap_factor(par: Parameters) -> Any:
    """e^(-k (z_0 - GAP)): the array's field at the coils over its value at the gap at which A and K_e stand. Eq. (2).

    At GAP it is 1 exactly. 0.1 mm more leaves 97.9 %, 0.5 mm more 90 %.
    """
    return ca.exp(-par.k * (par.z_0 - GAP))


def motor_constant(par: Parameters) -> Any:
    """A(z_0) = A e^(-k (z_0 - GAP)), N/A, the motor constant at the machine's air gap. Eq. (2).

    Example: `motor_constant(replace(par, z_0=0.5e-3))` is 1.5732 N/A for A = 1.6067 N/A at 0.4 mm.
    """
    return par.A * gap_factor(par)


def forces(par: Parameters, x: Any, i: Any) -> Any:
    """(F_x, F_z) of three phase currents at the position x: the motor law (1)."""
    return motor_constant(par) * _weighted_park(par, x) @ i


def vertical_force(par: Parameters, x: FloatArray, i: FloatArray) -> FloatArray:
    """F_z, N, at k positions of k x 3 phase currents."""
    place, currents = ca.SX.sym("x"), ca.SX.sym("i", 3)
    law = ca.Function("lift", [place, currents], [forces(par, place, currents)[1]])
    return np.array(law.map(len(x))(np.atleast_2d(x), np.transpose(i))).ravel()


def _weighted_park(par: Parameters, x: Any) -> Any:
    """2 x 3: `park` with each phase weighted by its share of the motor constant."""
    return park(x, par.k) @ ca.diag(ca.vertcat(par.a_a, par.a_b, par.a_c))


def phase_currents(par: Parameters, x: Any, F_x: Any, F_z: Any) -> Any:
    """The three currents of least loss for these forces (N) at the position x, with all phases alike. A."""
    return unpark(x, par.k) @ ca.vertcat(F_x, F_z) / motor_constant(par)


def duty_cycles(par: Parameters, V: Any) -> Any:
    """Duty cycles of the half-bridges for these phase voltages (V), not limited: 1/2 is no voltage."""
    return 0.5 + V / par.V_dc


def motion(par: Parameters, x: Any, F_x: Any, w: Any) -> Any:
    """Rates of (x, x') under the motor's horizontal force and an outer one: m x'' = F_x - b x' + w."""
    return ca.vertcat(x[1], (F_x - par.b * x[1] + w) / par.m)


def rates(par: Parameters, state: Any, V: Any, w: Any = 0) -> Any:
    """Rates of (x, x', i_a, i_b, i_c) under these voltages of the half-bridges; the star point floats."""
    x, i = state[0:2], state[2:5]
    drop = V - resistive_drop(par, i) - gap_factor(par) * par.K_e * x[1] * _weighted_park(par, x[0])[0, :].T
    return ca.vertcat(motion(par, x, forces(par, x[0], i)[0], w), (drop - ca.sum1(drop) / 3) / par.L)


def resistive_drop(par: Parameters, i: Any) -> Any:
    """Voltage drop of each phase's resistance, V."""
    return par.R * ca.vertcat(par.r_a, par.r_b, par.r_c) * i


def advance(par: Parameters, state: Any, V: Any, w: Any = 0) -> Any:
    """The state (x, x', i_a, i_b, i_c) one PWM period later, at mean voltages V of the half-bridges.

    One Runge-Kutta step; with L / R = 15 periods its error is 1e-8. As in the paper, the ripple within a period is left
    out.
    """
    return runge_kutta(lambda z, _: rates(par, z, V, w), ca.vertcat(state), 1 / par.f_pwm)


def stiffness(par: Parameters, F_z: float, displacement: float = 0.0) -> float:
    """Stiffness of the motor with constant currents, N/m: the tangent k F_z, or the secant over a displacement (m).

    NOTE: the paper's 205 N/m at 1 N is the secant over its identification step of 2 mm; the tangent is 211.
    """
    angle = par.k * displacement
    return F_z * (math.sin(angle) / displacement if displacement else par.k)


def emf_damping(par: Parameters) -> float:
    """Damping by induced currents while the voltages are constant, N s/m: 3/2 A K_e / R, both at the gap."""
    return float(1.5 * par.A * par.K_e / par.R * gap_factor(par) ** 2)


def servo(par: Parameters, F_z: float, displacement: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """(5), the motor on constant voltages about its equilibrium: (x, x')' = A (x, x') + B x_eq. A 2 x 2, B 2 x 1."""
    K = stiffness(par, F_z, displacement)
    A = np.array([[0, 1], [-K / par.m, -(par.b + emf_damping(par)) / par.m]])
    return A, np.array([[0], [K / par.m]])


Pwm = Literal["exact", "plain", "fine"]
MEAN_SAMPLES = 32  # samples in the rolling mean of a current, Sec. 4.2
# Counts at either end of a period within which the edges of the high-resolution PWM have the counter's steps. Sec. 4.1
# says "near 0 % and 100 %"; the manual of the PWM module, Texas Instruments SPRUGE8, has three clocks.
DEAD_ENDS = 3
IQ_BITS = 24  # bits behind the point of the DSP's fixed-point numbers: IQmath's default; not printed


@dataclass(frozen=True)
class Options:
    """What the electronics consist of; each source of error can be switched off."""

    pwm: Pwm = "plain"  # duty cycles: exact, in steps of the counter, or in those of the high-resolution PWM
    adc_steps: bool = True
    adc_noise: bool = True
    mean_of: int = MEAN_SAMPLES  # samples in the rolling mean of a current
    current_loops: bool = True  # vector control; without loops, voltages are R times the wanted currents
    dead_ends: int = 0  # counts at either end of a duty cycle without fine steps; the paper's: DEAD_ENDS
    angle_bits: int | None = None  # of a turn of the Park angle, and of its cosine and sine; None: exact

    def __post_init__(self) -> None:
        if self.pwm not in get_args(Pwm):
            raise InputError("halbach.Options", "pwm", repr(self.pwm), _one_of(Pwm))
        if isinstance(self.mean_of, bool) or self.mean_of not in range(1, 4097):
            raise InputError("halbach.Options", "mean_of", repr(self.mean_of), "1 to 4096 samples")
        if isinstance(self.dead_ends, bool) or self.dead_ends not in range(1025):
            raise InputError("halbach.Options", "dead_ends", repr(self.dead_ends), "0 to 1024 counts")
        if self.angle_bits is not None and self.angle_bits not in range(4, 49):
            raise InputError("halbach.Options", "angle_bits", repr(self.angle_bits), "None, or 4 to 48 bits")
        for name in ("adc_steps", "adc_noise", "current_loops"):
            if not isinstance(getattr(self, name), bool):
                raise InputError("halbach.Options", name, repr(getattr(self, name)), "True or False")


def _one_of(choices: Any) -> str:
    return "one of " + ", ".join(get_args(choices))


REAL_ELECTRONICS = Options()
IDEAL_ELECTRONICS = Options("exact", adc_steps=False, adc_noise=False)


def pwm_step(par: Parameters, pwm: Pwm) -> Any:
    """Smallest change of a phase voltage, V; 0 where duty cycles are exact."""
    return {"exact": 0.0, "plain": par.V_dc / par.counts, "fine": par.dV_fine}[pwm]


def adc_step(par: Parameters) -> Any:
    """Current of one code of the current sensors, A."""
    return 2 * par.I_adc / par.codes


def modulate(par: Parameters, V: Any, pwm: Pwm, dead_ends: int = 0) -> tuple[Any, Any]:
    """Duty cycles of the half-bridges for wanted phase voltages (V), and whether one was limited to 0 or 1.

    dead_ends : counts at either end of a duty cycle where the steps of `fine` are those of `plain`
    """
    wanted = duty_cycles(par, V)
    d = ca.fmin(ca.fmax(wanted, 0), 1)
    limited = ca.mmax(ca.fabs(d - wanted)) > 0
    if pwm == "exact":
        return d, limited
    step = pwm_step(par, pwm) / par.V_dc
    stepped = _round_half_up(d / step) * step
    if pwm == "fine" and dead_ends:
        coarse = _round_half_up(d * par.counts) / par.counts
        stepped = ca.if_else(ca.fmin(d, 1 - d) * par.counts < dead_ends, coarse, stepped)
    return ca.fmin(stepped, 1), limited


def largest_fine_force(par: Parameters, dead_ends: int = DEAD_ENDS) -> float:
    """The largest vertical force (N) at which the high-resolution PWM has its fine steps at every place.

    The amplitude of the phase voltages, 2/3 R F_z / A, stays V_dc dead_ends / counts below V_dc / 2.
    """
    return float(0.75 * par.V_dc * motor_constant(par) / par.R * (1 - 2 * dead_ends / par.counts))


def sample_current(par: Parameters, i: Any, *, steps: bool) -> tuple[Any, Any]:
    """The code of a current (A), and whether the current was out of range. Code 0 is -I_adc.

    steps : codes are whole numbers
    """
    code = (i + par.I_adc) / adc_step(par)
    inside = ca.fmin(ca.fmax(_round_half_up(code) if steps else code, 0), par.codes)
    return inside, ca.fabs(i) > par.I_adc


def expected_range(par: Parameters, count: int) -> float:
    """Mean difference between the largest and the smallest of `count` samples of a constant current, A.

    integral of 1 - P^count - (1 - P)^count over the current, P the normal distribution of noise and steps together.

    Example: `expected_range(par, 32)` is 0.092 A for a noise of 22 mA and steps of 10 mA.
    """
    sigma = math.hypot(par.s_adc, adc_step(par) / math.sqrt(12))
    x = np.linspace(-9, 9, 4001)
    P = ndtr(x)
    return float(sigma * np.trapezoid(1 - P**count - (1 - P) ** count, x))


def _round_half_up(x: Any) -> Any:
    return ca.floor(x + 0.5)


def resting_positions(
    par: Parameters, references: Any, F_z: float, pwm: Pwm, dead_ends: int = 0
) -> FloatArray:
    """Positions at which the open-loop motor comes to rest for these references, m."""
    return resting_points(par, references, F_z, pwm, dead_ends)[:, 0]


def resting_points(par: Parameters, references: Any, F_z: float, pwm: Pwm, dead_ends: int = 0) -> FloatArray:
    """Positions (m) at which the open-loop motor comes to rest, and its vertical forces (N) there: references x 2.

    The half-bridges round the voltages of a reference; the motor rests at the angle of the rounded voltages, and their
    length makes the force.

    dead_ends : as in `modulate`

    Raises InputError for a vertical force F_z (N) that is not above 0, or larger than the supply can drive.
    """
    points = []
    for r in np.atleast_1d(np.asarray(references, dtype=float)):
        d, limited = modulate(par, par.R * phase_currents(par, r, 0, F_z), pwm, dead_ends)
        if not (F_z > 0 and math.isfinite(r)) or bool(limited):
            most = 0.75 * par.V_dc * float(motor_constant(par)) / par.R
            raise InputError("halbach", "settled", f"{F_z:g} N at {r:g} m", f"forces of 0 to {most:.1f} N")
        V_d, V_q = np.array(park(r, par.k) @ (par.V_dc * (d - 0.5))).ravel()
        force = float(motor_constant(par)) / par.R * math.hypot(V_d, V_q)
        points.append((r + math.atan2(V_d, V_q) / par.k, force))
    return np.array(points)


def dead_zones(par: Parameters, F_z: float, pwm: Pwm) -> tuple[FloatArray, FloatArray]:
    """Dead zones of the open-loop motor over a pitch: their beginnings and their lengths, m.

    All references within a dead zone have the same duty cycles. The longest zone is the smallest step of the reference
    that moves the motor wherever it begins.

    Raises InputError for exact duty cycles, and without a vertical force.
    """
    step = pwm_step(par, pwm)
    if not (step and F_z):
        raise InputError("halbach", "dead_zones", f"pwm {pwm!r} at {F_z:g} N", "steps, and a vertical force")
    amplitude = 2 / 3 * par.R * abs(F_z) / float(motor_constant(par)) / step  # of a phase voltage, in steps
    edges = np.arange(math.ceil(-amplitude - 0.5), math.floor(amplitude - 0.5) + 1) + 0.5
    rise = np.arcsin(edges[np.abs(edges) <= amplitude] / amplitude)
    angles = [np.concatenate([rise, math.pi - rise]) + phase for phase in PHASES]
    switched = np.sort(np.mod(np.concatenate(angles), 2 * math.pi))
    return switched / par.k, np.diff(np.concatenate([switched, switched[:1] + 2 * math.pi])) / par.k


class DqCurrentLoop(NamedTuple):
    """PI controller of Id and of Iq, u = Kp e + Ki integral of e."""

    Kp: float  # V/A
    Ki: float  # V/(A s)
    crossover: float  # rad/s


def current_delay(par: Parameters, mean_of: int) -> float:
    """Delay from a current to its voltage, s: 1.5 periods of computation and hold, and the rolling mean's."""
    return (1.5 + (mean_of - 1) / 2) / par.f_pwm


def current_loop(par: Parameters, mean_of: int) -> DqCurrentLoop:
    """Gains of the current loops for a rolling mean of `mean_of` samples.

    The zero of the controller cancels the winding's pole, which leaves w e^(-s delay) / s; the crossover w follows from
    the phase margin pm_cc. The paper prints no gains. With its mean of 32 samples the delay is 1.16 ms and w is 451
    rad/s, 27 times faster than the motor on its spring.
    """
    w = (math.pi / 2 - par.pm_cc) / current_delay(par, mean_of)
    return DqCurrentLoop(w * par.L, w * par.R, w)


def force_noise(par: Parameters, x: float | None = None) -> float:
    """Intensity of the horizontal force noise that current sensors cause within the bandwidth of the loops, N^2/Hz.

    Two samples of equal noise make Id, as the third current is computed: its variance is 1.5 to 4.5 times theirs as the
    Park angle goes, 3 times on average (x=None).
    """
    share = 3.0
    if x is not None:
        d = np.array(park(x, par.k))[0]
        share = float((d[0] - d[2]) ** 2 + (d[1] - d[2]) ** 2)
    return float(share * (motor_constant(par) * par.s_adc) ** 2 / par.f_pwm)


FLAGS = ("duty limit", "current range")


def electronics(par: Parameters, options: Options | None = None) -> Electronics:
    """Current loops on Id and Iq, their sensors and the half-bridges, as they run in every PWM period.

        i*, y --> [ hold ] --> Id*, Iq*, cos, sin --> [ move: loops, modulator, windings, motor ] --> x, i
                               until the next reading     ^ two phase currents, rolling means ----------|

    The duty cycles computed in a period act in the next one. The loops know R, L and k, but not that the phases differ.

    options : what the electronics consist of; None: REAL_ELECTRONICS, as in the paper
    """
    parts = _Electronics(par, REAL_ELECTRONICS if options is None else options)
    o = parts.options
    return Electronics(
        period=1 / par.f_pwm,
        state=_state_sizes(o),
        noises=2 if o.current_loops and o.adc_noise else 0,
        flags=FLAGS,
        set_points=SET_POINTS,
        held=partial(_references, parts),
        start=partial(_start, parts),
        move=partial(_move, parts),
        met=lambda state: state["met"],
        duty=lambda state: state["duty"],
    )


# Wanted currents along and across the field, and the angle of the last reading for Park's transformation.
SET_POINTS = (Signal("Id_ref", "A"), Signal("Iq_ref", "A"), Signal("cos_kx", "1"), Signal("sin_kx", "1"))


class _Electronics(NamedTuple):
    """The electronics' parameters, and the options of what they consist of."""

    par: Parameters
    options: Options


def _state_sizes(o: Options) -> dict[str, int]:
    """Sizes of the electronics' state: duty cycles, limits met, integrals, and the rolling means of two currents."""
    sizes = {"duty": 3, "met": len(FLAGS)}
    if o.current_loops:
        sizes |= {"u": 2, "sums": 2, "ring_a": o.mean_of, "ring_b": o.mean_of}
    return sizes


def _references(parts: _Electronics, i: Any, y: Any) -> Any:
    """(Id*, Iq*, cos k y, sin k y) of wanted phase currents i at a reading y: constant until the next reading.

    Id* and Iq* are the wanted forces over A, and have no angle in them: what is fixed-point is the angle of the loops.
    """
    par, bits = parts.par, parts.options.angle_bits
    c, s = ca.cos(par.k * y[0]), ca.sin(par.k * y[0])
    wanted = park_of_angle(c, s) @ i
    return (
        ca.vertcat(wanted, c, s) if bits is None else ca.vertcat(wanted, fixed_point_angle(par, y[0], bits))
    )


def fixed_point_angle(par: Parameters, x: Any, bits: int = IQ_BITS) -> Any:
    """(cos, sin) of the Park angle k x, the angle in turns and both results rounded to `bits` behind the point.

    A step of the angle is worth 2 pi / k / 2^bits of position: 1.77 nm with 24 bits.
    """
    one = 2.0**bits
    turns = _round_half_up(par.k * x / (2 * math.pi) * one) / one
    return _round_half_up(ca.vertcat(ca.cos(2 * math.pi * turns), ca.sin(2 * math.pi * turns)) * one) / one


def _start(parts: _Electronics, x: Any, i: Any) -> dict[str, Any]:
    """The electronics' state in a steady state at the position x[0] with phase currents i."""
    par, o = parts
    P, n = park(x[0], par.k), o.mean_of
    drop = resistive_drop(par, i) if o.current_loops else par.R * i  # integrals found each resistance
    u = P @ drop
    codes = sample_current(par, i[0:2], steps=o.adc_steps)[0]
    state = {
        "duty": modulate(par, 2 / 3 * P.T @ u, o.pwm, o.dead_ends)[0],
        "met": ca.DM.zeros(len(FLAGS)),
        "u": u,
        "sums": n * codes,
        "ring_a": ca.repmat(codes[0], n, 1),
        "ring_b": ca.repmat(codes[1], n, 1),
    }
    return {name: state[name] for name in _state_sizes(o)}


def _move(
    parts: _Electronics, x: Any, i: Any, state: Mapping[str, Any], held: Any, w: Any, noise: Any
) -> tuple[Any, Any, dict[str, Any]]:
    """One PWM period: (x, i, state) at its end. held: `_references`; w: outer force; noise: of two current samples."""
    par, o = parts
    P, wanted = park_of_angle(held[2], held[3]), held[0:2]
    if o.current_loops:
        V, out_of_range, loops = _control_currents(parts, i, state, P, wanted, noise)
    else:
        V, out_of_range, loops = 2 / 3 * P.T @ (par.R * wanted), 0, lambda _: {}
    duty, limited = modulate(par, V, o.pwm, o.dead_ends)
    met = ca.fmax(state["met"], ca.vertcat(limited, out_of_range))
    z = advance(par, ca.vertcat(x, i), par.V_dc * (state["duty"] - 0.5), w[0])
    return z[0:2], z[2:5], dict(state) | loops(limited) | {"duty": duty, "met": met}


def _control_currents(
    parts: _Electronics, i: Any, state: Mapping[str, Any], P: Any, wanted: Any, noise: Any
) -> tuple[Any, Any, Callable[[Any], dict[str, Any]]]:
    """PI control of Id and Iq: phase voltages, whether a sample was out of range, and the state for a limit flag.

    The integrals stand still while the modulator is at its limit.
    """
    par, o = parts
    gains = current_loop(par, o.mean_of)
    codes, out = sample_current(par, i[0:2] + (par.s_adc * noise if o.adc_noise else 0), steps=o.adc_steps)
    oldest = ca.vertcat(state["ring_a"][0], state["ring_b"][0])
    sums = state["sums"] + codes - oldest
    mean = sums / o.mean_of * adc_step(par) - par.I_adc
    e = wanted - P @ ca.vertcat(mean, -ca.sum1(mean))  # (8): the third current is computed

    def after(limited: Any) -> dict[str, Any]:
        return {
            "sums": sums,
            "ring_a": ca.vertcat(*ca.vertsplit(state["ring_a"])[1:], codes[0]),
            "ring_b": ca.vertcat(*ca.vertsplit(state["ring_b"])[1:], codes[1]),
            "u": state["u"] + ca.if_else(limited, 0, gains.Ki / par.f_pwm) * e,
        }

    return 2 / 3 * P.T @ (state["u"] + gains.Kp * e), ca.mmax(out), after
