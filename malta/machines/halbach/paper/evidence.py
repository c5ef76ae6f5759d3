"""Figures of a design that the claims on the Halbach motor are about: from its experiments, margins and model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.halbach import electronics
from malta.machines.halbach import electronics as motor
from malta.machines.halbach.experiments import COUNT, PAUSE, STEP, responses
from malta.machines.halbach.open_loop import LAWS, MOVE, move_reference, positions_at_rest, sound_moves
from malta.machines.halbach.plant import Parameters
from malta.margins.loop_report import LoopReport
from malta.model.data import published_value
from malta.model.linearize import LinearModel
from malta.report.ledger import case_merit, run_design
from malta.simulation.experiments import Experiment, Progress
from malta.synthesis.controller import Controller
from malta.synthesis.filters import sampled_model
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Plant


DEAD_FORCE = 14.45  # N, between the largest with fine steps everywhere, 14.42 N, and the supply's 14.46 N
EXPERIMENT_NAMES = ("step", "stairs", "ramp", "force", "budget", "identify")


@dataclass(frozen=True, eq=False)
class Evidence:
    """A design, its margins and its experiments, beside the published figures."""

    spec: Spec
    published: Mapping[str, Any]
    model: LinearModel
    controller: Controller
    margins: LoopReport
    experiments: Mapping[str, Experiment]  # with "quick": moves of "force" with the rise of rise_of_dip

    @property
    def par(self) -> Parameters:
        """The machine's parameters."""
        parameters = self.spec.parameters
        assert isinstance(parameters, Parameters)
        return parameters

    def value(self, key: str) -> float:
        """A published quantity, SI."""
        return published_value(self.published, key)


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> Evidence:
    """Design a controller, prove its margins and run all experiments; the moves of `force` quicker as well."""
    found = run_design(spec, EXPERIMENT_NAMES, progress)
    rise = rise_of_dip(spec.plant, published_value(published, "figure_10.open_loop"))
    experiments = found.experiments | {"quick": sound_moves(spec.plant, found.controller, rise)}
    return Evidence(spec, published, found.model, found.controller, found.margins, experiments)


def figure_2(e: Evidence) -> tuple[float, float]:
    """Amplitude of the forces along a pitch at the currents of Fig. 2, N, and their phase difference, rad."""
    i = np.array([e.value(f"figure_2.I_{phase}") for phase in "abc"])
    places = np.arange(360) / 360 * 2 * math.pi / e.par.k
    F = np.array([np.array(motor.forces(e.par, x, i)).ravel() for x in places])
    waves = np.fft.rfft(F, axis=0)[1] / 180
    return float(np.abs(waves).max()), abs(float(np.angle(waves[1] / waves[0])))


def sampled_pole(e: Evidence) -> float:
    """The smaller pole of the motor over the time between readings, with the Park angle constant."""
    Ad = sampled_model(e.model, e.par.T_laser)[0]
    return float(min(np.linalg.eigvals(Ad).real))


def current_for_step(e: Evidence) -> float:
    """Largest change of a phase current for the paper's example of a displacement, A."""
    step, F_z = e.value("sensitivity.displacement"), e.value("sensitivity.F_z")
    i = [np.array(motor.phase_currents(e.par, x, 0, F_z)) for x in (0.0, step)]
    return float(np.abs(i[1] - i[0]).max())


def pwm_step_of(pwm: electronics.Pwm) -> Callable[[Evidence], float]:
    """A function of the evidence: the step of a phase voltage, V."""
    return lambda e: float(electronics.pwm_step(e.par, pwm))


def duty(e: Evidence, sign: int) -> float:
    """Duty cycle at the paper's example of a current, or at its negative."""
    return float(motor.duty_cycles(e.par, e.par.R * sign * e.value("pwm.current")))


def duty_at_force(e: Evidence) -> FloatArray:
    """Duty cycles of the three half-bridges along a pitch at rest, 361 x 3."""
    places = np.linspace(0, 2 * math.pi / e.par.k, 361)
    V = [e.par.R * motor.phase_currents(e.par, x, 0, e.par.F_z) for x in places]
    return np.array([np.array(motor.duty_cycles(e.par, v)).ravel() for v in V])


def bits_of_mean(e: Evidence) -> float:
    """Bits that the rolling mean adds to a current sample: log2 of the errors' ratio, over the printed range."""
    rng, most = np.random.default_rng(0), e.value("pwm.current")
    i = rng.uniform(-most, most, (4000, 1))
    noisy = i + e.par.s_adc * rng.standard_normal((len(i), electronics.MEAN_OF))
    codes = np.array(electronics.sample_current(e.par, noisy, steps=True)[0])
    error = codes * electronics.adc_step(e.par) - e.par.I_adc - i
    return math.log2(float(error.std() / error.mean(axis=1).std()))


def samples_of_range(e: Evidence) -> float:
    """The number of samples whose range is the printed one, on average."""
    wanted, low, high = e.value("current_sampling.range"), 2, 100_000
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if electronics.expected_range(e.par, middle) < wanted else (low, middle)
    return float(high)


def rest_in_dead_ends(dead_ends: int, e: Evidence) -> float:
    """Largest error of the resting place at DEAD_FORCE with high-resolution PWM, m."""
    places = np.linspace(0, math.pi / 3 / e.par.k, 1001)  # a sixth of a pitch: the phases take turns
    found = electronics.resting_positions(e.par, places, DEAD_FORCE, "fine", dead_ends)
    return float(np.abs(found - places).max())


def first_stair(e: Evidence) -> float:
    """Position on the first stair in the open loop with plain PWM, m."""
    return float(positions_at_rest(e.experiments["stairs"].cases[0].run)[0][1])


def ramp_distance(e: Evidence) -> float:
    """Distance of the first ramp, m."""
    run = e.experiments["ramp"].run
    return float(run.p[-1, 0] - run.p[0, 0])


def mean_step(e: Evidence) -> float:
    """Mean motion from a second after a jump of the reference, m."""
    return STEP * float(responses(e.experiments["step"].run, STEP, COUNT)[:, PAUSE // 2 :].mean())


def rise_of_dip(plant: Plant, dip: float) -> float:
    """Rise of a quintic of the open loop's reference, s, for which the vertical force changes by `dip`, a share."""
    low, high = 1e-3, 2.0  # the slower, the less
    for _ in range(20):
        middle = (low + high) / 2
        low, high = (middle, high) if open_loop_dip(plant, middle) < dip else (low, middle)
    return high


def open_loop_dip(plant: Plant, rise: float) -> float:
    """Largest dip, as a share, of the vertical force of a move of MOVE without feedback: a quintic with this rise, s.

    Currents follow at once: F_x = F_z sin(k (x_eq - x)), and F_z cos(k (x_eq - x)) is what is left of F_z.
    """
    par: Any = plant.parameters
    dt = 1e-3
    t = np.arange(0, 4 * rise + 1, dt / 2)
    wanted = move_reference(plant, MOVE, rise, 0.0)(t).p[:, 0]
    damping = par.b + motor.emf_damping(par)

    def rate(state: FloatArray, k: int) -> FloatArray:
        push = par.F_z * math.sin(par.k * (wanted[k] - state[0]))
        return np.array([state[1], (push - damping * state[1]) / par.m])

    state, least = np.zeros(2), 1.0
    for k in range(0, len(t) - 2, 2):
        least = min(least, math.cos(par.k * (wanted[k] - state[0])))
        middle = state + dt / 2 * rate(state, k)
        state = state + dt * rate(middle, k + 1)
    return least - 1


def largest_lift_change(fault: str, e: Evidence) -> float:
    """Largest change of the vertical force with a fault, over the three laws, as a share."""
    return max(abs(case_merit("force", f"{law}, {fault}", 0, e)) for law in LAWS)
