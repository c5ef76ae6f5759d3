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
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np
from scipy import linalg, optimize

from malta.data import check_parameters, si
from malta.engine import evaluate
from malta.errors import CheckError, InputError
from malta.plant import Actuator, Electronics, Plant, Signal, readonly
from malta.riccati import dare, eigenvalues, sample, sample_noise

if TYPE_CHECKING:
    from malta.plant import ComplexArray, FloatArray

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
        limited=lambda i: i * (par.I_adc / ca.fmax(par.I_adc, ca.mmax(ca.fabs(i)))),  # their sum stays zero
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


# The motor with controllers and a simulation of its own, which needs nothing of the pipeline: the same by another route

# What the position controllers are designed on


class Sampled(NamedTuple):
    """The motor between readings: xi+ = A xi + B F_x + H n, y = C xi + n; xi = (x, x') and, with latency, the last x.

    An error n of a reading is one of the Park angle, too: the spring hangs from where the laser says.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    H: FloatArray
    W: FloatArray  # covariance that a white force of 1 N2/Hz leaves in xi after one sample
    T: float  # s
    latency: int

    def ramp(self) -> tuple[FloatArray, float]:
        """The state, less the position, and the force (N) that go with a steady 1 m/s.

        Within a sample the held spring pulls back, so the velocity at the readings is above the mean.
        """
        n = len(self.A)
        shift = self.T * np.array([1.0, 0.0, 1.0][:n])
        M = np.hstack([(self.A - np.eye(n))[:, 1:2], self.B])
        offset = np.array([0.0, 0.0, -self.T][:n])
        solution = np.linalg.lstsq(M, shift - (self.A - np.eye(n)) @ offset, rcond=None)[0]
        return offset + np.array([0.0, solution[0], 0.0][:n]), float(solution[1])


def held(par: Parameters, F_z: float, latency: int = 0, *, spring: bool = True) -> Sampled:
    """The motor with the Park angle held at the last reading, which is `latency` samples old; force held as well.

    Current loops keep the phase currents, so damping is b alone. spring=False is what one would write down without
    the held angle, a mass with friction: its sampled pole is 0.871 where the motor at 5 N has 0.51.
    """
    K = stiffness(par, F_z) if spring else 0.0
    A = np.array([[0, 1], [-K / par.m, -par.b / par.m]])
    B = np.array([[0], [1 / par.m]])
    E, G = sample(A, B, par.T_laser)
    W = sample_noise(A, B @ B.T, par.T_laser)
    pull = np.array([[1 - E[0, 0]], [-E[1, 0]]])  # of the point that the spring hangs from
    if _latency(latency) == 0:  # it starts from rest at each reading
        E[:, :1] += pull
        return Sampled(E, G, np.array([[1.0, 0.0]]), pull, W, par.T_laser, 0)
    A = np.block([[E, pull], [np.array([[1.0, 0.0, 0.0]])]])
    B, H, C = np.vstack([G, [[0.0]]]), np.vstack([pull, [[0.0]]]), np.array([[0.0, 0.0, 1.0]])
    return Sampled(A, B, C, H, linalg.block_diag(W, np.zeros((1, 1))), par.T_laser, 1)


def _latency(latency: int) -> int:
    if latency not in (0, 1):
        raise InputError("halbach", "latency", repr(latency), "0 or 1 samples of the laser")
    return latency


@dataclass(frozen=True)
class Hardware(Options):
    """The electronics, and what the laser is."""

    laser_steps: bool = True
    laser_noise: bool = True
    latency: int = 0  # readings that the controller is late

    def __post_init__(self) -> None:
        super().__post_init__()
        _latency(self.latency)


HARDWARE = Hardware()


@dataclass(frozen=True)
class Faults:
    """What may be wrong with a motor that its controller takes for a sound one."""

    winding: tuple[float, float, float] = (1.0, 1.0, 1.0)  # resistance of each phase, times R
    magnet: tuple[float, float, float] = (1.0, 1.0, 1.0)  # motor constant of each phase, times A
    angle: float = 0.0  # error of the controller's Park angle, rad
    force: float = 0.0  # external horizontal force, N

    def __post_init__(self) -> None:
        for name, low in (("winding", 0), ("magnet", 0), ("angle", -math.inf), ("force", -math.inf)):
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            if not (np.isfinite(values).all() and (values > low).all()):
                expected = "finite numbers above 0" if low == 0 else "a finite number"
                raise InputError("halbach.Faults", name, repr(getattr(self, name)), expected)


SOUND = Faults()


# Position controllers, one step every reading


@dataclass(frozen=True)
class Pid:
    """PID controller of the position in increments, so that its limit winds nothing up."""

    Kp: float  # N/m
    Ki: float  # N/(m s)
    Kd: float  # N s/m
    weight: float  # of jumps of the reference in the proportional part
    feedforward: float  # N s/m, of the reference's velocity
    F_max: float  # N
    T: float  # s
    latency: int
    pole: float  # the one that is placed three times


@dataclass(frozen=True, eq=False)
class Lqg:
    """State feedback, Kalman filter and observed force of disturbance, in filter form; the force stands last."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    K: FloatArray
    L: FloatArray
    ramp: FloatArray  # state that goes with 1 m/s
    feedforward: float  # N s/m
    F_max: float  # N

    def __post_init__(self) -> None:
        for name in ("A", "B", "C", "K", "L", "ramp"):
            object.__setattr__(self, name, readonly(getattr(self, name)))


def pid(par: Parameters, model: Sampled, *, overshoot: float = 0.02) -> Pid:
    """Three poles of the sampled loop at one real place, as fast as leaves no other pole slower.

    The reference's jumps enter the proportional part with the largest weight that lets a step overshoot by no more
    than this share; feedforward is what a steady ramp needs. The paper prints no gains.
    Raises CheckError where no such place makes the loop stable.
    """
    num = np.poly(model.A - model.B @ model.C) - np.poly(model.A)
    G = num, np.poly(model.A)

    def excess(p: float) -> float:
        q = _pid_terms(G, p)
        polynomial = np.polymul(G[1], [1, -1, 0])
        polynomial = np.polyadd(polynomial, np.polymul(num, q))
        rest, _ = np.polydiv(polynomial, np.poly([p, p, p]))
        return float(np.abs(np.roots(rest)).max()) - p

    grid = np.arange(0.02, 0.99, 0.01)
    first = next((k for k, p in enumerate(grid) if excess(p) < 0), None)
    if first is None:
        raise CheckError("PID: no triple pole inside the unit circle dominates the sampled loop")
    p = optimize.brentq(excess, grid[first - 1], grid[first]) if first else grid[0]
    q0, q1, q2 = _pid_terms(G, p)
    gains = float(-q1 - 2 * q2), float(q0 + q1 + q2) / model.T, float(q2) * model.T
    weight = _weight(model, gains, overshoot)
    return Pid(*gains, weight, model.ramp()[1], par.F_max, model.T, model.latency, float(p))


def _weight(model: Sampled, gains: tuple[float, float, float], overshoot: float) -> float:
    """The largest weight, up to 1, of the reference's jumps; the response is linear in it."""
    M, n = _pid_loop(model, gains), len(model.A)
    inputs = np.zeros((n + 2, 2))  # a reference of 1 through the integral part, and through the proportional
    inputs[:n] = model.B @ np.array([[gains[1] * model.T, gains[0]]])
    inputs[n, 0] = model.T
    z, responses = np.zeros((n + 2, 2)), []
    for _ in range(400):
        z = M @ z + inputs
        responses.append(model.C[0] @ z[:n])
    base, more = np.array(responses).T
    room = (1 + overshoot - base)[more > 0] / more[more > 0]
    return float(min(1.0, max(0.0, room.min(initial=1.0))))


def _pid_terms(G: tuple[FloatArray, FloatArray], p: float) -> FloatArray:
    """q0 q1 q2 that make z (z - 1) den + (q0 z^2 + q1 z + q2) num vanish at p with two derivatives."""
    num, den = G
    terms = [np.polymul(den, [1, -1, 0]), *(np.polymul(num, basis) for basis in np.eye(3))]
    values = np.array([[np.polyval(np.polyder(term, d), p) for term in terms] for d in range(3)])
    return np.asarray(np.linalg.solve(values[:, 1:], -values[:, 0]))


def _pid_loop(model: Sampled, gains: tuple[float, float, float]) -> FloatArray:
    """The closed loop, with the sum of errors and the last reading as further states."""
    Kp, Ki, Kd = gains
    n, T = len(model.A), model.T
    M = np.zeros((n + 2, n + 2))
    M[:n, :n] = model.A - (Kp + Ki * T + Kd / T) * model.B @ model.C
    M[:n, n:] = model.B @ np.array([[Ki, Kd / T]])
    M[n, :n], M[n, n], M[n + 1, :n] = -T * model.C[0], 1, model.C[0]
    return M


def lqg(
    par: Parameters,
    model: Sampled,
    *,
    position: float = 10e-6,
    force: float = 5e-3,
    drift: float = 1e-3,
) -> Lqg:
    """LQG with a constant force of disturbance among its states, on a sampled model with its delay.

    position, force : an error of the one costs as much as the other, m and N
    drift           : of the disturbance from one sample to the next, N rms; beside it the filter knows the force noise
                      that the current sensors cause and the variance of the laser
    Raises CheckError as riccati.dare.
    """
    n = len(model.A)
    Q = np.diag([1 / position**2, 0.0, 0.0][:n])
    K = dare(model.A, model.B, Q, np.array([[1 / force**2]]), what="halbach LQG").K
    A = np.block([[model.A, model.B], [np.zeros((1, n)), np.ones((1, 1))]])
    B, C = np.vstack([model.B, [[0]]]), np.hstack([model.C, [[0]]])
    W = linalg.block_diag(model.W * force_noise(par), np.array([[drift**2]]))
    V = np.array([[(2 * par.n_laser) ** 2 / 12 + par.dx**2 / 12]])
    X = dare(A.T, C.T, W, V, what="halbach Kalman filter").X
    L = X @ C.T @ np.linalg.inv(C @ X @ C.T + V)
    ramp, feedforward = model.ramp()
    return Lqg(A, B, C, np.hstack([K, [[1.0]]]), L, np.append(ramp, 0.0), feedforward, par.F_max)


def closed_loop(model: Sampled, controller: Pid | Lqg) -> ComplexArray:
    """Poles of the sampled loop."""
    return eigenvalues(_closed(model, controller)[0])


def deviation(par: Parameters, model: Sampled, controller: Pid | Lqg, x: float) -> tuple[float, float]:
    """Rms of the position at the readings, m: from noise of the current sensors, and from noise of the laser."""
    M, reading = _closed(model, controller)
    W = np.zeros_like(M)
    W[: len(model.A), : len(model.A)] = model.W * force_noise(par, x)
    covariances = (W, reading @ reading.T * par.n_laser**2 / 3)
    found = [linalg.solve_discrete_lyapunov(M, covariance)[0, 0] for covariance in covariances]
    return math.sqrt(found[0]), math.sqrt(found[1])


def _closed(model: Sampled, c: Pid | Lqg) -> tuple[FloatArray, FloatArray]:
    """The closed loop, the motor's states first, and how an error of a reading enters it."""
    if isinstance(c, Pid):
        M, T = _pid_loop(model, (c.Kp, c.Ki, c.Kd)), c.T
        return M, np.vstack([model.H - (c.Kp + c.Ki * T + c.Kd / T) * model.B, [[-T], [1.0]]])
    filtered, fed = np.eye(len(c.A)) - c.L @ c.C, c.A - c.B @ c.K  # xi_hat = filtered xi_pred + L y
    M = np.block(
        [
            [model.A - model.B @ c.K @ c.L @ model.C, -model.B @ c.K @ filtered],
            [fed @ c.L @ model.C, fed @ filtered],
        ]
    )
    return M, np.vstack([model.H - model.B @ c.K @ c.L, fed @ c.L])


def _law(controller: Pid | Lqg | None, z: Any, y: Any, r: Any, v: Any) -> tuple[Any, Any]:
    """Force and next state of a position controller with state z, at the reading y and the reference r, v."""
    if controller is None:
        return ca.SX(0), z
    c = controller
    if isinstance(c, Pid):
        F, r_last, v_last, y_last, step_last = ca.vertsplit(z)
        step = y - y_last
        jump = r - r_last - c.T * v
        F += c.Kp * (c.weight * jump + c.T * v - step) + c.Ki * c.T * (r - c.latency * c.T * v - y)
        F += c.Kd * (v - v_last - (step - step_last) / c.T) + c.feedforward * (v - v_last)
        F = ca.fmin(ca.fmax(F, -c.F_max), c.F_max)
        return F, ca.vertcat(F, r, v, y, step)
    xi = z + ca.DM(c.L) * (y - ca.DM(c.C) @ z)
    wanted = ca.vertcat(r, *[0] * (len(c.A) - 1)) + ca.DM(c.ramp) * v
    if len(c.A) == 4:  # the last position is a state
        wanted[2] += r
    F = ca.fmin(ca.fmax(ca.DM(c.K) @ (wanted - xi) + c.feedforward * v, -c.F_max), c.F_max)
    return F, ca.DM(c.A) @ xi + ca.DM(c.B) * F


def _law_start(controller: Pid | Lqg | None, x0: float) -> FloatArray:
    """State of a position controller that has been at rest at x0."""
    if controller is None:
        return np.zeros(0)
    if isinstance(controller, Pid):
        return np.array([0.0, x0, 0.0, x0, 0.0])
    return np.array([x0, 0.0, *([x0] if len(controller.A) == 4 else []), 0.0])


# The two rates

F_MOST = 1e4  # N, of a vertical force to ask for: far beyond any supply, far from the largest float

Mode = Literal["open", "position", "vector"]


class Loop(NamedTuple):
    """Controller, electronics and motor as two functions, and the names and sizes of what they carry along."""

    reading: ca.Function  # every T_laser: (state, [r, v, F_z, noise of the laser]) -> state, [y, F]
    period: ca.Function  # every PWM period: (state, noise of two current samples) -> state, ROW
    sizes: dict[str, int]


ROW = ("x", "v", "F_x", "F_z", "i_a", "i_b", "i_c", "d_a", "d_b", "d_c", "duty limit", "current range")


@lru_cache(maxsize=32)
def loop(
    par: Parameters,
    mode: Mode,
    controller: Pid | Lqg | None,
    electronics: Hardware,
    faults: Faults = SOUND,
) -> Loop:
    """What happens at a reading and in a PWM period.

    mode : open      voltages of the reference's currents, no feedback
           position  voltages of the currents that the position controller wants
           vector    the same currents through current loops on Id and Iq
    Duty cycles that a period computes act in the next one. The Park angle is the last reading's.
    """
    shares: dict[str, Any] = dict(
        zip(("r_a", "r_b", "r_c", "a_a", "a_b", "a_c"), (*faults.winding, *faults.magnet), strict=True)
    )
    par = replace(par, **shares)
    n = electronics.mean_of if mode == "vector" else 1
    sizes = {"motor": 5, "u": 2, "duty": 3, "ring_a": n, "ring_b": n, "sums": 2, "cos_sin": 2, "wanted": 2}
    sizes |= {"last": 1, "law": len(_law_start(controller, 0.0))}
    s = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    state = ca.vertcat(*s.values())

    given = ca.SX.sym("given", 4)
    r, v, F_z, noise = ca.vertsplit(given)
    y = s["motor"][0] + (noise if electronics.laser_noise else 0)
    y = _round(y / par.dx) * par.dx if electronics.laser_steps else y
    late = s["last"] if electronics.latency else y
    angle = par.k * (r if mode == "open" else late) + faults.angle
    F, law = _law(controller, s["law"], late, r, v)
    after = s | {
        "cos_sin": ca.vertcat(ca.cos(angle), ca.sin(angle)),
        "wanted": ca.vertcat(F, F_z) / par.A,
        "last": y,
        "law": law,
    }
    row = ca.vertcat(y, F)
    reading = ca.Function(
        "reading", [state, given], ca.cse([ca.densify(ca.vertcat(*after.values())), ca.densify(row)])
    )

    noise = ca.SX.sym("noise", 2)
    after, row = _period(par, mode, electronics, faults.force, s, noise)
    period = ca.Function(
        "period", [state, noise], ca.cse([ca.densify(ca.vertcat(*after.values())), ca.densify(row)])
    )
    return Loop(reading, period, sizes)


def _period(
    par: Parameters, mode: Mode, electronics: Hardware, w: float, s: dict[str, Any], noise: Any
) -> tuple[dict[str, Any], Any]:
    motor, after = s["motor"], dict(s)
    P = _park(s["cos_sin"][0], s["cos_sin"][1])
    far = ca.SX(0)
    if mode == "vector":
        sums = []
        for k, ring in enumerate(("ring_a", "ring_b")):
            i = motor[2 + k] + (par.s_adc * noise[k] if electronics.adc_noise else 0)
            code, out = sampled_current(par, i, steps=electronics.adc_steps)
            far = ca.logic_or(far, out)
            sums.append(s["sums"][k] + code - s[ring][0])
            after[ring] = ca.vertcat(*ca.vertsplit(s[ring])[1:], code)
        after["sums"] = ca.vertcat(*sums)
        a, b = ca.vertsplit(after["sums"] / electronics.mean_of * adc_step(par) - par.I_adc)
        e = s["wanted"] - P @ ca.vertcat(a, b, -a - b)
        gains = current_loop(par, electronics.mean_of)
        V_dq = s["u"] + gains.Kp * e
        duty, limited = modulated(par, 2 / 3 * P.T @ V_dq, electronics.pwm)
        after["u"] = s["u"] + ca.if_else(limited, 0, gains.Ki / par.f_pwm) * e
    else:
        duty, limited = modulated(par, 2 / 3 * P.T @ (par.R * s["wanted"]), electronics.pwm)
    after["duty"] = duty
    after["motor"] = moved(par, motor, par.V_dc * (s["duty"] - 0.5), w)
    F = forces(par, motor[0], motor[2:5])
    return after, ca.vertcat(motor[:2], F, motor[2:5], s["duty"], limited, far)


@dataclass(frozen=True, eq=False)
class Reference:
    """Where the motor shall be at each reading, and how fast it shall pass there."""

    position: FloatArray  # m
    velocity: FloatArray  # m/s

    def __post_init__(self) -> None:
        for name in ("position", "velocity"):
            values = readonly(getattr(self, name))
            object.__setattr__(self, name, values)
            if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
                found = f"NaN, infinity or nothing in the shape {values.shape}"
                raise InputError("halbach.Reference", name, found, "a row of finite numbers")
        if len(self.position) != len(self.velocity):
            found = f"{len(self.velocity)} values"
            raise InputError("halbach.Reference", "velocity", found, f"{len(self.position)}, as of position")


def steps(par: Parameters, *to: tuple[float, float]) -> Reference:
    """Jumps: (position, seconds) one after the other."""
    parts = [np.full(round(time / par.T_laser), position) for position, time in to]
    position = np.concatenate(parts) if parts else np.zeros(0)
    return Reference(position, np.zeros(len(position)))


def ramp(par: Parameters, length: float, speed: float, rest: float = 1.0) -> Reference:
    """At rest at 0, a ramp of this length at this speed, at rest again."""
    if not (speed > 0 and length > 0):
        raise InputError("halbach", "ramp", f"{length:g} m at {speed:g} m/s", "a length and a speed above 0")
    still, moving = round(rest / par.T_laser), round(length / speed / par.T_laser)
    position = np.concatenate([np.zeros(still), length / moving * np.arange(moving), np.full(still, length)])
    velocity = np.zeros(len(position))
    velocity[still : still + moving] = length / moving / par.T_laser
    return Reference(position, velocity)


@dataclass(frozen=True, eq=False)
class Run:
    """What a simulation left behind: rows of the PWM periods (the quantities of ROW), and of the readings."""

    time: FloatArray  # s, of the rows
    rows: dict[str, FloatArray]
    reading_time: FloatArray
    reading: FloatArray  # m, as the laser gave it
    position: FloatArray  # m, true, at the readings
    force: FloatArray  # N, F_x that the position controller asked for
    reference: Reference
    verdicts: tuple[
        str, ...
    ]  # limits that were met: "force limit", "left the travel", "duty limit", "current range"

    @property
    def error(self) -> FloatArray:
        """Reference less true position at the readings, m."""
        return np.asarray(self.reference.position[: len(self.position)] - self.position)


def simulate(
    par: Parameters,
    reference: Reference,
    *,
    F_z: float,
    mode: Mode = "vector",
    controller: Pid | Lqg | None = None,
    electronics: Hardware = HARDWARE,
    faults: Faults = SOUND,
    x0: float = 0.0,
    seed: int = 0,
    every: int = 1,
) -> Run:
    """The motor from rest at x0, with the currents of F_z there, along a reference; every so many periods are kept.

    Readings fall on the first PWM period that begins after them: 805 or 806 periods apart. Raises InputError for
    numbers that are none; limits that are met on the way are verdicts in the result. A motor that leaves its travel by
    more than a pitch ends the run.
    """
    if mode not in get_args(Mode):
        raise InputError("halbach", "mode", repr(mode), _one_of(Mode))
    if (controller is None) != (mode == "open"):
        found = "a controller" if controller is not None else "none"
        raise InputError("halbach", "controller", f"{found} in mode {mode!r}", "one unless the loop is open")
    for name, value, most, unit in (
        ("F_z", F_z, F_MOST, "N"),
        ("x0", x0, par.travel, "m"),
        ("reference", float(np.abs(reference.position).max()), par.travel, "m"),
    ):
        if not abs(value) <= most:
            raise InputError("halbach", name, f"{value:g} {unit}", f"at most {most:g} {unit} either way")
    if not (isinstance(every, int) and every > 0):
        raise InputError("halbach", "every", repr(every), "a whole number of periods")
    parts = loop(par, mode, controller, electronics, faults)
    rng = np.random.default_rng(seed)
    count = len(reference.position)
    at = np.ceil(np.arange(count + 1) * (par.T_laser * par.f_pwm) - 1e-6).astype(int)
    state = start(par, mode, controller, electronics, F_z, x0)
    rows, readings, left = [], [], False
    for k in range(count):
        jitter = par.n_laser * rng.uniform(-1, 1)
        given = np.array([reference.position[k], reference.velocity[k], F_z, jitter])
        true = state[0]
        (state,), (row,) = evaluate(parts.reading, state, given)
        readings.append([true, *row])
        length = int(at[k + 1] - at[k])
        chain = _chain(parts.period, length)
        noise = rng.standard_normal((chain.size2_in(1), chain.size1_in(1)))
        states, block = evaluate(chain, state, noise)
        state = states[-1]
        rows.append(block.reshape(length, -1))
        if left := abs(state[0]) > par.travel + 2 * math.pi / par.k:
            break
    table = np.concatenate(rows)
    at_readings = np.array(readings)
    verdicts = [name for name in ROW[-2:] if table[:, ROW.index(name)].any()]
    if left:
        verdicts.insert(0, "left the travel")
    if controller is not None and (np.abs(at_readings[:, 2]) >= controller.F_max).any():
        verdicts.insert(0, "force limit")
    kept = table[::every]
    return Run(
        time=np.arange(len(table))[::every] / par.f_pwm,
        rows=dict(zip(ROW[:-2], kept.T, strict=False)),
        reading_time=at[: len(at_readings)] / par.f_pwm,
        reading=at_readings[:, 1],
        position=at_readings[:, 0],
        force=at_readings[:, 2],
        reference=reference,
        verdicts=tuple(verdicts),
    )


@lru_cache(maxsize=64)
def _chain(period: ca.Function, length: int) -> ca.Function:
    """Periods one after the other, a row of ROW for each: some written out, so that shifting means costs nothing."""
    together = next(n for n in range(13, 0, -1) if length % n == 0)
    state, noise = ca.SX.sym("state", period.size1_in(0)), ca.SX.sym("noise", 2 * together)
    after, rows = state, []
    for k in range(together):
        after, row = period(after, noise[2 * k : 2 * k + 2])
        rows.append(row)
    block = ca.Function("block", [state, noise], [after, ca.vertcat(*rows)])
    return block.mapaccum("chain", length // together)


def start(
    par: Parameters, mode: Mode, controller: Pid | Lqg | None, electronics: Hardware, F_z: float, x0: float
) -> FloatArray:
    """The state at rest at x0, currents flowing, the rolling means full of them."""
    i = np.array(phase_currents(par, x0, 0, F_z)).ravel()
    duty, _ = modulated(par, par.R * ca.DM(i), electronics.pwm)
    n = electronics.mean_of if mode == "vector" else 1
    codes = np.array([float(sampled_current(par, c, steps=electronics.adc_steps)[0]) for c in i[:2]])
    u = [0.0, par.R * F_z / par.A] if mode == "vector" else [0.0, 0.0]
    angle = par.k * x0
    values = [[x0, 0.0], i, u, np.array(duty).ravel(), np.repeat(codes, n), codes * n]
    values += [[math.cos(angle), math.sin(angle)], [0.0, F_z / par.A], [x0], _law_start(controller, x0)]
    return np.concatenate([np.asarray(value, dtype=float) for value in values])
