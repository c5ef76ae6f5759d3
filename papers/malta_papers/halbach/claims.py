"""What the paper on the Halbach linear motor publishes, a row for each figure, and ours; no design loads it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta import Spec, read
from malta.files import shipped_path
from malta.machines.halbach import electronics
from malta.machines.halbach.electronics import MEAN_SAMPLES
from malta.machines.halbach.experiments import COUNT, PAUSE, STEP, responses
from malta.machines.halbach.plant import Parameters
from malta.margins import LoopReport
from malta.model import LinearModel
from malta.model.printed import published_value
from malta.simulation import Experiment
from malta.simulation.experiments import Progress
from malta.synthesis import Controller
from malta.synthesis.design_models import sampled_model
from malta_papers.halbach.experiments import (
    FAULTS,
    LAWS,
    MOVE,
    PAPER_NAMES,
    move_reference,
    positions_at_rest,
    sound_moves,
)
from malta_papers.ledger import Row, case_merit, machine_share, merit, peak_sensitivity, run_design

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model import Plant

DEAD_FORCE = 14.45  # N, between the largest with fine steps everywhere, 14.42 N, and the supply's 14.46 N
EXPERIMENT_NAMES = ("step", "stairs", "ramp", "force", "budget", "identify")


@dataclass(frozen=True, eq=False)
class HalbachEvidence:
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


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> HalbachEvidence:
    """Design a controller, prove its margins and run all experiments; the moves of `force` quicker as well."""
    found = run_design(spec, EXPERIMENT_NAMES, progress)
    rise = rise_of_dip(spec.plant, published_value(published, "figure_10.open_loop"))
    experiments = found.experiments | {"quick": sound_moves(spec.plant, found.controller, rise)}
    return HalbachEvidence(spec, published, found.model, found.controller, found.margins, experiments)


def figure_2(e: HalbachEvidence) -> tuple[float, float]:
    """Amplitude of the forces along a pitch at the currents of Fig. 2, N, and their phase difference, rad."""
    i = np.array([e.value(f"figure_2.I_{phase}") for phase in "abc"])
    places = np.arange(360) / 360 * 2 * math.pi / e.par.k
    F = np.array([np.array(electronics.forces(e.par, x, i)).ravel() for x in places])
    waves = np.fft.rfft(F, axis=0)[1] / 180
    return float(np.abs(waves).max()), abs(float(np.angle(waves[1] / waves[0])))


def sampled_pole(e: HalbachEvidence) -> float:
    """The smaller pole of the motor over the time between readings, with the Park angle constant."""
    Ad = sampled_model(e.model, e.par.T_laser)[0]
    return float(min(np.linalg.eigvals(Ad).real))


def current_for_step(e: HalbachEvidence) -> float:
    """Largest change of a phase current for the paper's example of a displacement, A."""
    step, F_z = e.value("sensitivity.displacement"), e.value("sensitivity.F_z")
    i = [np.array(electronics.phase_currents(e.par, x, 0, F_z)) for x in (0.0, step)]
    return float(np.abs(i[1] - i[0]).max())


def pwm_step_of(pwm: electronics.Pwm) -> Callable[[HalbachEvidence], float]:
    """A function of the evidence: the step of a phase voltage, V."""
    return lambda e: float(electronics.pwm_step(e.par, pwm))


def duty(e: HalbachEvidence, sign: int) -> float:
    """Duty cycle at the paper's example of a current, or at its negative."""
    return float(electronics.duty_cycles(e.par, e.par.R * sign * e.value("pwm.current")))


def duty_of(end: Callable[[FloatArray], Any]) -> Callable[[HalbachEvidence], float]:
    """A function of the evidence: the least or greatest duty cycle of the half-bridges along a pitch at rest."""

    def duty_at_force(e: HalbachEvidence) -> float:
        places = np.linspace(0, 2 * math.pi / e.par.k, 361)
        V = [e.par.R * electronics.phase_currents(e.par, x, 0, e.par.F_z) for x in places]
        return float(end(np.array([np.array(electronics.duty_cycles(e.par, v)).ravel() for v in V])))

    return duty_at_force


def bits_of_mean(e: HalbachEvidence) -> float:
    """Bits that the rolling mean adds to a current sample: log2 of the errors' ratio, over the printed range."""
    rng, most = np.random.default_rng(0), e.value("pwm.current")
    i = rng.uniform(-most, most, (4000, 1))
    noisy = i + e.par.s_adc * rng.standard_normal((len(i), electronics.MEAN_SAMPLES))
    codes = np.array(electronics.sample_current(e.par, noisy, steps=True)[0])
    error = codes * electronics.adc_step(e.par) - e.par.I_adc - i
    return math.log2(float(error.std() / error.mean(axis=1).std()))


def samples_of_range(e: HalbachEvidence) -> float:
    """The number of samples whose range is the printed one, on average."""
    wanted, low, high = e.value("current_sampling.range"), 2, 100_000
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if electronics.expected_range(e.par, middle) < wanted else (low, middle)
    return float(high)


def rest_in_dead_ends(dead_ends: int, e: HalbachEvidence) -> float:
    """Largest error of the resting place at DEAD_FORCE with high-resolution PWM, m."""
    places = np.linspace(0, math.pi / 3 / e.par.k, 1001)  # a sixth of a pitch: the phases take turns
    found = electronics.resting_positions(e.par, places, DEAD_FORCE, "fine", dead_ends)
    return float(np.abs(found - places).max())


def first_stair(e: HalbachEvidence) -> float:
    """Position on the first stair in the open loop with plain PWM, m."""
    return float(positions_at_rest(e.experiments["stairs"].cases[0].run)[0][1])


def ramp_distance(e: HalbachEvidence) -> float:
    """Distance of the first ramp, m."""
    run = e.experiments["ramp"].run
    return float(run.p[-1, 0] - run.p[0, 0])


def mean_step(e: HalbachEvidence) -> float:
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
    damping = par.b + electronics.emf_damping(par)

    def rate(state: FloatArray, k: int) -> FloatArray:
        push = par.F_z * math.sin(par.k * (wanted[k] - state[0]))
        return np.array([state[1], (push - damping * state[1]) / par.m])

    state, least = np.zeros(2), 1.0
    for k in range(0, len(t) - 2, 2):
        least = min(least, math.cos(par.k * (wanted[k] - state[0])))
        middle = state + dt / 2 * rate(state, k)
        state = state + dt * rate(middle, k + 1)
    return least - 1


def share_of_error(source: str, e: HalbachEvidence) -> float:
    """The error at rest by one source of noise over that by all, rms."""
    return case_merit("budget", source, "position, rms", e) / case_merit("budget", "all", "position, rms", e)


def vector_over_position(e: HalbachEvidence) -> float:
    """Largest change of the vertical force in the quicker move: under vector control over position control."""
    vector, position = (
        case_merit("quick", law, "highest", e) for law in ("vector control", "position control")
    )
    return vector / position


def largest_lift_change(fault: str, e: HalbachEvidence) -> float:
    """Largest change of the vertical force with a fault, over the three laws, as a share."""
    return max(abs(case_merit("force", f"{law}, {fault}", 0, e)) for law in LAWS)


SOURCE = "L. C. Díaz-Pérez et al., Actuators 7(4), 2018"
REPRODUCING = ("halbach_calm",)


MOTOR: tuple[Row, ...] = (
    Row(
        "pitch, 2π/k",
        "{:.3f} mm",
        lambda e: 2 * math.pi / e.par.k,
        "motor.pitch",
        note="k, an input",
        by_construction=True,
    ),
    Row(
        "more air gap that costs a tenth of A, (2)",
        "{:.2f} mm",
        lambda e: math.log(1 / 0.9) / e.par.k,
        note="A e^(-k z₀), z₀ = 0.4 mm as printed; the proven box of 10 % of A covers it",
    ),
    Row("Fig. 2: largest force", "{:.3f} N", lambda e: figure_2(e)[0], "figure_2.force"),
    Row(
        "Fig. 2: between F_x and F_z",
        "{:.1f} deg",
        lambda e: figure_2(e)[1],
        math.pi / 2,
        note="the motor law has a sine and a cosine",
        by_construction=True,
    ),
    Row(
        "stiffness at 1 N: secant over 2 mm",
        "{:.1f} N/m",
        partial(merit, "identify", "secant stiffness"),
        "servo.K",
        note="the tangent k F_z is 211.0",
    ),
    Row(
        "step of 2 mm: linear servo off by, rms",
        "{:.3f} mm",
        partial(merit, "identify", "linear servo off by, rms"),
        note="over 6 s; 0.02 mm in the first 2 s",
    ),
    Row(
        "pole of the motor between readings",
        "{:.4f}",
        sampled_pole,
        note="the Park angle is held; a mass with friction alone has 0.871",
    ),
    Row(
        "current for 1 µm at 5 N, peak",
        "{:.2f} mA",
        current_for_step,
        "sensitivity.current",
        why="0.1 mA for 1 µm makes the 6 mA of a PWM step 60 µm, four times the paper's own 15 µm",
    ),
)


MEAN = "a mean of 32 samples leaves 22 mA / √32 of white noise: theirs is none"
ELECTRONICS: tuple[Row, ...] = (
    Row(
        "PWM: step of a phase voltage",
        "{:.2f} mV",
        pwm_step_of("plain"),
        "pwm.step",
        note="V_dc over the counts of the PWM; printed rounded",
        by_construction=True,
    ),
    Row(
        "high-resolution PWM: 150 ps of a period at 12 V",
        "{:.4f} mV",
        lambda e: e.par.V_dc * e.value("pwm.micro_edge") * e.par.f_pwm,
        "pwm.fine_step",
        note="a product of inputs, 12 V × 150 ps × 14.648 kHz",
        by_construction=True,
    ),
    *(
        Row(
            f"duty cycle at {sign}2.1 A",
            "{:.1f} percent",
            partial(duty, sign=factor),
            key,
            note="1/2 + R i / V_dc, of inputs",
            by_construction=True,
        )
        for sign, factor, key in (("−", -1, "pwm.duty_low"), ("+", 1, "pwm.duty_high"))
    ),
    *(
        Row(f"{which} duty cycle at 5 N", "{:.1f} percent", duty_of(end), key, why="2.07 A, printed as 2.1 A")
        for which, end, key in (("least", np.min, "pwm.duty_low"), ("greatest", np.max, "pwm.duty_high"))
    ),
    Row(
        "current sensor: step",
        "{:.2f} A",
        lambda e: electronics.adc_step(e.par),
        "current_sampling.step",
        note="the range over the codes, both inputs",
        by_construction=True,
    ),
    Row(
        "current sensor: noise after the rolling mean",
        "{:.1f} mA",
        lambda e: e.par.s_adc / math.sqrt(MEAN_SAMPLES),
        "current_sampling.noise_of_mean",
        why=MEAN,
    ),
    Row(
        f"current sensor: range of {MEAN_SAMPLES} samples",
        "{:.2f} A",
        lambda e: electronics.expected_range(e.par, MEAN_SAMPLES),
        "current_sampling.range",
        why="the paper does not say how many samples: as many as its mean takes are our reading",
    ),
    Row(
        "samples that range over the printed 0.12 A",
        "{:.0f}",
        samples_of_range,
        note="normal noise of the printed 22 mA: the two figures agree for so many samples",
    ),
    Row(
        "bits that the rolling mean adds",
        "{:.1f}",
        bits_of_mean,
        "current_sampling.bits_of_mean",
        note="log2 √32 of white noise; the printed 22 mA and 3.2 mA are 2.8 bits",
    ),
    Row(
        "vertical force up to which PWM steps are fine",
        "{:.2f} N",
        lambda e: electronics.largest_fine_force(e.par),
        "pwm.force",
        "at least",
        note="coarse within 3 counts of 0 and of 100 %: the module's manual; the paper says “near”",
    ),
    *(
        Row(
            f"at {DEAD_FORCE} N, {text}: rest off by",
            "{:.0f} nm",
            partial(rest_in_dead_ends, ends),
            note=note,
        )
        for ends, text, note in (
            (electronics.DEAD_ENDS, "in the dead ends", "open loop; 2.5 µm with plain PWM"),
            (0, "if there were none", "open loop"),
        )
    ),
    Row(
        "current loops: crossover",
        "{:.0f} rad/s",
        lambda e: e.spec.plant.actuator.crossover,
        note="the paper prints no gains; 60° with the MEAN of 32",
    ),
)


TENFOLD = "ten times too large: it goes as the step of the voltage, 15 µm × 26.2 µV / 5.86 mV"
OPEN_LOOP: tuple[Row, ...] = (
    Row(
        "smallest motion, plain PWM",
        "{:.1f} um",
        partial(merit, "stairs", "longest dead zone, plain PWM"),
        "open_loop.smallest_motion",
    ),
    Row(
        "smallest motion, high-resolution PWM",
        "{:.3f} um",
        partial(merit, "stairs", "longest dead zone, high-resolution PWM"),
        "open_loop.smallest_motion_fine",
        why=TENFOLD,
    ),
    Row(
        "Fig. 7a: second stair of 10 µm",
        "{:.2f} um",
        lambda e: abs(float(np.diff(positions_at_rest(e.experiments["stairs"].cases[0].run)[0])[1])),
        0.1e-6,
        "at most",
        note="“cannot react”, read as 0.1 µm",
    ),
    Row("Fig. 7a: first stair", "{:.2f} um", first_stair, note="then 13.39, 26.74, 40.17 µm"),
)


SHARE = "one of “the two main contributors”, read as a tenth of the rms at least; each run has its own noise"
LASER = (
    "the laser reads 0.12 µm rms wrong, which no loop here enlarges; the current sensors' noise is a force"
)
JUMP = "no set-point weight: a jump of the reference enters the proportional part"
CLOSED_LOOP: tuple[Row, ...] = (
    *(
        Row(f"Fig. 7{text} PWM", shown, partial(case_merit, "stairs", case, 3), note=note)
        for text, shown, case, note in (
            ("b: swing, plain", "{:.1f} um", 2, "“marginally oscillates”"),
            ("c: swing, high-resolution", "{:.2f} um", 3, "“imperceptible”"),
        )
    ),
    Row(
        "Fig. 8: way at constant speed",
        "{:.1f} mm",
        ramp_distance,
        "closed_loop.travel",
        note="an input: the reference has it",
        by_construction=True,
    ),
    Row(
        "Fig. 8: mean lag, worst of 1, 2, 5 mm/s",
        "{:.2f} um",
        lambda e: max(case.merits[0].value for case in e.experiments["ramp"].cases),
    ),
    Row(
        "Fig. 8: vertical force off by",
        "{:.2f} percent",
        lambda e: max(case.merits[3].value for case in e.experiments["ramp"].cases),
    ),
    Row(
        "Fig. 9: step",
        "{:.1f} um",
        mean_step,
        "closed_loop.step",
        note="an input: the reference has it",
        why="what is left of the overshoot from a second on, which the integral takes off",
        by_construction=True,
    ),
    Row(
        "Fig. 9: mean overshoot of a jump",
        "{:.1f} percent",
        partial(case_merit, "step", 0, 0),
        0.05,
        "at most",
        note="asked: “to prevent oscillation”, read as the 5 % within which it has arrived",
        why=JUMP,
    ),
    Row("the same of a quintic in 0.3 s", "{:.1f} percent", partial(case_merit, "step", 1, 0)),
    Row(
        "Fig. 9: a jump is within 5 % after",
        "{:.2f} s",
        partial(case_merit, "step", 0, 1),
        "position_control.response",
        "at most",
        note="asked: “a maximum response time of 1 min”",
    ),
    Row("the same of a quintic in 0.3 s", "{:.2f} s", partial(case_merit, "step", 1, 1)),
    Row("at rest, all sources: rms", "{:.2f} um", partial(case_merit, "step", 0, 2)),
    Row("at rest, all sources: mean error", "{:.3f} um", partial(case_merit, "step", 0, 3)),
    *(
        Row(f"{text} alone: rms", "{:.2f} um", partial(case_merit, "budget", case, 0), note=note)
        for text, case, note in (
            ("noise of the laser", 0, ""),
            ("noise of the current sensors", 1, ""),
            ("steps of the current sensors", 2, ""),
            ("steps of the PWM", 3, "current loops take them out"),
        )
    ),
    *(
        Row(f"noise of {name} alone, of all", "{:.0f} percent", share, 0.1, "at least", note=SHARE, why=LASER)
        for name, share in (
            ("the laser", partial(share_of_error, "laser")),
            ("the current sensors", partial(share_of_error, "current noise")),
        )
    ),
    *(
        Row(f"noise of the current sensors alone, at the {end} place: rms", "{:.2f} um", value)
        for end in ("best", "worst")
        for value in (partial(merit, "budget", f"current noise, at the {end} place"),)
    ),
    Row(
        "angles of 24 bits alone: rms",
        "{:.2f} nm",
        partial(case_merit, "budget", f"angle of {electronics.IQ_BITS} bits", 0),
        "fixed_point.error",
        "at most",
        note="the library's default, the paper prints no format; a step is 1.77 nm",
    ),
    Row(
        "share of the box of m, A, b, R",
        "proven percent",
        machine_share,
        note="proven; 10 % of m and A, 20 % of b and R; k makes waves along the travel and is flown in campaigns",
    ),
    Row("peak sensitivity", "{:.2f}", peak_sensitivity),
)


CAUSE = "no steady change follows from the motor law, and no fault below has both signs and 0 under vector control"
TRANSIENT = "largest change on the way, of the sign that the paper prints"
LIFT: tuple[Row, ...] = (
    *(
        Row(
            f"Fig. 10: {law}, steady change",
            "{:.2f} percent",
            partial(case_merit, "force", law, 0),
            f"figure_10.{PAPER_NAMES[law]}",
            why=CAUSE,
        )
        for law in ("open loop", "position control")
    ),
    Row(
        "Fig. 10 as a transient: open loop, lowest",
        "{:.1f} percent",
        partial(case_merit, "force", "open loop", "lowest"),
        "figure_10.open_loop",
        note=f"{TRANSIENT}; back within 5 s",
        why="a jump of 5 mm is 1 − cos(k 5 mm) = 51 %, all at once: a slower command or a slow load cell sees less",
        of_machine=True,
    ),
    Row(
        "the same with a quintic: rise that dips by as much",
        "{:.3f} s",
        lambda e: rise_of_dip(e.spec.plant, e.value("figure_10.open_loop")),
        note="solved; from 10 to 90 % of the 5 mm, without electronics",
        of_machine=True,
    ),
    Row(
        "Fig. 10 as a transient: position control, highest",
        "{:.1f} percent",
        partial(case_merit, "quick", "position control", "highest"),
        "figure_10.position_controller",
        note=f"{TRANSIENT}; with the same quintic, at the assumed limit of 2 N; 0.3 s makes 1.4 %",
    ),
    Row(
        "the same under vector control",
        "{:.1f} percent",
        partial(case_merit, "quick", "vector control", "highest"),
    ),
    Row(
        "the same, over that under position control",
        "{:.2f}",
        vector_over_position,
        0.9,
        "at most",
        note="“smoother”, read as by a tenth",
        why="currents are commutated for a reading that is up to 55 ms old, with current loops and without",
    ),
    Row(
        "Fig. 10: vector control, steady change",
        "{:.2f} percent",
        lambda e: abs(case_merit("force", "vector control", 0, e)),
        1e-3,
        "at most",
        note="“coincident with its target”, read as 0.1 %",
    ),
)


def _lift() -> list[Row]:
    """Rows of the changes of the vertical force that possible faults cause."""
    found: list[Row] = []
    for fault in [fault for fault in FAULTS if fault != "sound"]:
        if not FAULTS[fault].keys() & {f.name for f in fields(Parameters)}:  # of the motor itself it is none
            largest = partial(largest_lift_change, fault)
            found.append(Row(f"{fault}: largest of the three", "{:.2f} percent", largest, note="tried"))
            continue
        for law in LAWS:
            value = partial(case_merit, "force", f"{law}, {fault}", 0)
            found.append(Row(f"{fault}: {law}", "{:.1f} percent", value, note="tried"))
    return found


LASER_K = "the laser's readings of a simulated record with K known, as Sec. 2.3 does"
CELL = "a simulated record of a load cell along 50 mm with noise of 5 mN, as Sec. 2.1 does"
LINE = "(5) is a line where the motor has a sine, which costs 2 %"
NOISE = "white noise of the cell, within the interval below"
RESIDUALS = "residuals that are correlated over a period, of a K that is taken as exact"


def _fitted_rows() -> list[Row]:
    """Rows of the constants as the paper identified them; their printed figures stand in the machine's data."""
    printed: Any = read(shipped_path("data", "halbach.toml"))
    found: list[Row] = []
    for text, label, shown, value, source, why, interval in (
        ("step of 2 mm: mass", "mass, fitted", "{:.2f} kg", printed.m, LASER_K, LINE, RESIDUALS),
        ("step of 2 mm: friction", "friction, fitted", "{:.2f} N s/m", printed.b, LASER_K, LINE, RESIDUALS),
        ("load cell: A", "load cell: A", "{:.4f} N/A", printed.A, CELL, NOISE, "white noise of the cell"),
        ("load cell: k", "load cell: k", "{:.4f} rad/m", printed.k, CELL, NOISE, "white noise of the cell"),
        ("load cell: l", "load cell: l", "{:.3f} mm", "motor.pitch", CELL, NOISE, "white noise of the cell"),
    ):
        half = f"{label.removesuffix(', fitted')}, half of its interval"
        note = f"fitted to {source}; the record's motor has the printed figure"
        found += [
            Row(
                text,
                shown,
                partial(merit, "identify", label),
                value,
                note=note,
                why=why,
                by_construction=True,
            ),
            Row(
                f"{text}, half of its interval",
                shown,
                partial(merit, "identify", half),
                note=f"95 %; {interval}",
            ),
        ]
    return found


def rows() -> list[Row]:
    """All claims of the paper, in the order of the ledger."""
    motor = [row._replace(of_machine=True) for row in (*MOTOR, *_fitted_rows(), *ELECTRONICS, *OPEN_LOOP)]
    return [*motor, *CLOSED_LOOP, *LIFT, *_lift()]
