"""The claims of the paper on the Halbach linear motor."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.halbach import plant as halbach
from malta.machines.halbach.experiments import (
    COUNT,
    FAULTS,
    LAWS,
    PAUSE,
    STEP,
    places,
    responses,
)
from malta.machines.halbach.plant import MEAN_OF, Parameters
from malta.margins.verify import Margins
from malta.model.data import published_value
from malta.model.linearize import LinearModel
from malta.report.ledger import (
    Row,
    designed,
    machine_share,
    merit,
    peak_sensitivity,
)
from malta.simulation.experiments import Experiment, Progress
from malta.synthesis.controller import Controller
from malta.synthesis.lqg import sampled_model
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

SOURCE = "L. C. Díaz-Pérez et al., Actuators 7(4), 2018"
FLOWN = ("step", "stairs", "ramp", "force", "budget", "identify")


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of one design."""

    spec: Spec
    published: Mapping[str, Any]
    model: LinearModel
    controller: Controller
    margins: Margins
    flown: Mapping[str, Experiment]

    @property
    def par(self) -> Parameters:
        """The machine."""
        parameters = self.spec.parameters
        assert isinstance(parameters, Parameters)
        return parameters

    def value(self, key: str) -> float:
        """What the paper prints, SI."""
        return published_value(self.published, key)


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> Evidence:
    """Design, prove and fly."""
    found = designed(spec, FLOWN, progress)
    return Evidence(spec, published, found.model, found.controller, found.margins, found.flown)


def rows() -> list[Row]:
    return [*_motor(), *_electronics(), *_open_loop(), *_closed_loop(), *_lift()]


def _motor() -> list[Row]:
    return [
        Row("pitch, 2π/k", "mm", "{:.3f}", lambda e: 2 * math.pi / e.par.k, "motor.pitch", "equal"),
        Row("Fig. 2: largest force", "N", "{:.3f}", lambda e: _figure_2(e)[0], "figure_2.force", "equal"),
        Row(
            "Fig. 2: between F_x and F_z",
            "deg",
            "{:.1f}",
            lambda e: _figure_2(e)[1],
            math.pi / 2,
            "equal",
        ),
        Row(
            "stiffness at 1 N: secant over 2 mm",
            "N/m",
            "{:.1f}",
            partial(merit, "identify", "secant stiffness"),
            "servo.K",
            note="the tangent k F_z is 211.0",
        ),
        Row(
            "step of 2 mm: linear servo off by, rms",
            "mm",
            "{:.3f}",
            partial(merit, "identify", "linear servo off by, rms"),
            note="over 6 s; 0.02 mm in the first 2 s",
        ),
        Row(
            "pole of the motor between readings",
            "1",
            "{:.4f}",
            _sampled_pole,
            note="the Park angle is held; a mass with friction alone has 0.871",
        ),
        Row(
            "current for 1 µm at 5 N, peak",
            "mA",
            "{:.2f}",
            _current,
            "sensitivity.current",
            why="0.1 mA for 1 µm makes the 6 mA of a PWM step 60 µm, four times the paper's own 15 µm",
        ),
    ]


def _electronics() -> list[Row]:
    mean = "a mean of 32 samples leaves 22 mA / √32 of white noise: theirs is none"
    return [
        Row(
            "PWM: step of a phase voltage",
            "mV",
            "{:.2f}",
            _step_of("plain"),
            "pwm.step",
            note="printed rounded",
        ),
        Row(
            "high-resolution PWM: 150 ps of a period at 12 V",
            "mV",
            "{:.4f}",
            lambda e: e.par.V_dc * e.value("pwm.micro_edge") * e.par.f_pwm,
            "pwm.fine_step",
        ),
        Row("duty cycle at −2.1 A", "percent", "{:.1f}", lambda e: _duty(e, -1), "pwm.duty_low", "equal"),
        Row("duty cycle at +2.1 A", "percent", "{:.1f}", lambda e: _duty(e, 1), "pwm.duty_high", "equal"),
        Row(
            "least duty cycle at 5 N", "percent", "{:.1f}", lambda e: _duty_at_force(e).min(), "pwm.duty_low"
        ),
        Row(
            "greatest duty cycle at 5 N",
            "percent",
            "{:.1f}",
            lambda e: _duty_at_force(e).max(),
            "pwm.duty_high",
        ),
        Row(
            "current sensor: step",
            "A",
            "{:.2f}",
            lambda e: halbach.adc_step(e.par),
            "current_sampling.step",
            "equal",
        ),
        Row(
            "current sensor: noise after the rolling mean",
            "mA",
            "{:.1f}",
            lambda e: e.par.s_adc / math.sqrt(MEAN_OF),
            "current_sampling.noise_of_mean",
            why=mean,
        ),
        Row(
            "current loops: crossover",
            "rad/s",
            "{:.0f}",
            lambda e: e.spec.plant.actuator.crossover,
            note="the paper prints no gains; 60° with the mean of 32",
        ),
    ]


def _open_loop() -> list[Row]:
    ten = "ten times too large: it goes as the step of the voltage, 15 µm × 26.2 µV / 5.86 mV"
    return [
        Row(
            "smallest motion, plain PWM",
            "um",
            "{:.1f}",
            partial(merit, "stairs", "longest dead zone, plain PWM"),
            "open_loop.smallest_motion",
        ),
        Row(
            "smallest motion, high-resolution PWM",
            "um",
            "{:.3f}",
            partial(merit, "stairs", "longest dead zone, high-resolution PWM"),
            "open_loop.smallest_motion_fine",
            why=ten,
        ),
        Row(
            "Fig. 7a: second stair of 10 µm",
            "um",
            "{:.2f}",
            lambda e: abs(float(np.diff(places(e.flown["stairs"].cases[0].run)[0])[1])),
            0.1e-6,
            "at most",
            "“cannot react”, read as 0.1 µm",
        ),
        Row("Fig. 7a: first stair", "um", "{:.2f}", _first_stair, note="then 13.39, 26.74, 40.17 µm"),
    ]


def _closed_loop() -> list[Row]:
    main = "the paper names it as one of the two main sources"
    jump = "no set-point weight: a jump of the reference enters the proportional part"
    return [
        Row("Fig. 7b: swing, plain PWM", "um", "{:.1f}", partial(_swing, 2), note="“marginally oscillates”"),
        Row(
            "Fig. 7c: swing, high-resolution PWM", "um", "{:.2f}", partial(_swing, 3), note="“imperceptible”"
        ),
        Row("Fig. 8: way at constant speed", "mm", "{:.1f}", _way, "closed_loop.travel", "equal"),
        Row(
            "Fig. 8: mean lag, worst of 1, 2, 5 mm/s",
            "um",
            "{:.2f}",
            lambda e: max(case.merits[0].value for case in e.flown["ramp"].cases),
        ),
        Row(
            "Fig. 8: vertical force off by",
            "percent",
            "{:.2f}",
            lambda e: max(case.merits[3].value for case in e.flown["ramp"].cases),
        ),
        Row("Fig. 9: step", "um", "{:.1f}", _stepped, "closed_loop.step"),
        Row(
            "Fig. 9: mean overshoot of a jump",
            "percent",
            "{:.1f}",
            partial(_stepping, 0, 0),
            note=f"of the PID: {jump}",
        ),
        Row("the same of a quintic in 0.3 s", "percent", "{:.1f}", partial(_stepping, 1, 0)),
        Row(
            "Fig. 9: a jump is within 5 % after",
            "s",
            "{:.2f}",
            partial(_stepping, 0, 1),
            "position_control.response",
            "at most",
        ),
        Row("the same of a quintic in 0.3 s", "s", "{:.2f}", partial(_stepping, 1, 1)),
        Row("at rest, all sources: rms", "um", "{:.2f}", partial(_stepping, 0, 2)),
        Row("at rest, all sources: mean error", "um", "{:.3f}", partial(_stepping, 0, 3)),
        Row("noise of the laser alone: rms", "um", "{:.2f}", partial(_source, 0), note=main),
        Row("noise of the current sensors alone: rms", "um", "{:.2f}", partial(_source, 1), note=main),
        Row(
            "the same at the best place",
            "um",
            "{:.2f}",
            partial(merit, "budget", "current noise, at the best place"),
        ),
        Row(
            "the same at the worst place",
            "um",
            "{:.2f}",
            partial(merit, "budget", "current noise, at the worst place"),
        ),
        Row("steps of the current sensors alone: rms", "um", "{:.2f}", partial(_source, 2)),
        Row(
            "steps of the PWM alone: rms",
            "um",
            "{:.2f}",
            partial(_source, 3),
            note="current loops take them out",
        ),
        Row(
            "share of the box of m, A, b, R",
            "percent",
            "{:.0f}",
            machine_share,
            note="proven; 10 % of m and A, 20 % of b and R; k makes waves along the travel and is flown in campaigns",
        ),
        Row("peak sensitivity", "1", "{:.2f}", peak_sensitivity),
    ]


def _lift() -> list[Row]:
    why = "no steady change follows from the motor law, and no fault below has both signs and 0 under vector control"
    found = [
        Row(
            "Fig. 10: open loop, steady change",
            "percent",
            "{:.2f}",
            partial(_change, "open loop"),
            "figure_10.open_loop",
            why=why,
        ),
        Row(
            "Fig. 10: open loop, dip",
            "percent",
            "{:.1f}",
            lambda e: _moved(e, "open loop", 1),
            note="back within 5 s",
        ),
        Row(
            "Fig. 10: position control, steady change",
            "percent",
            "{:.2f}",
            partial(_change, "position control"),
            "figure_10.position_controller",
            why=why,
        ),
        Row(
            "Fig. 10: vector control, steady change",
            "percent",
            "{:.2f}",
            lambda e: abs(_change("vector control", e)),
            1e-3,
            "at most",
            "“coincident with its target”, read as 0.1 %",
        ),
    ]
    for fault in [fault for fault in FAULTS if fault != "sound"]:
        if not FAULTS[fault].keys() & {f.name for f in fields(Parameters)}:  # of the motor itself it is none
            largest = partial(_largest_change, fault)
            found.append(Row(f"{fault}: largest of the three", "percent", "{:.2f}", largest, note="tried"))
            continue
        for law in LAWS:
            change = partial(_change, f"{law}, {fault}")
            found.append(Row(f"{fault}: {law}", "percent", "{:.1f}", change, note="tried"))
    return found


def _figure_2(e: Evidence) -> tuple[float, float]:
    """Amplitude of the forces along a pitch, N, and the angle between them."""
    i = np.array([e.value(f"figure_2.I_{phase}") for phase in "abc"])
    places = np.arange(360) / 360 * 2 * math.pi / e.par.k
    F = np.array([np.array(halbach.forces(e.par, x, i)).ravel() for x in places])
    waves = np.fft.rfft(F, axis=0)[1] / 180
    return float(np.abs(waves).max()), abs(float(np.angle(waves[1] / waves[0])))


def _sampled_pole(e: Evidence) -> float:
    """The pole, other than 1, of the motor between readings, on the spring of the held angle."""
    Ad = sampled_model(e.model, e.par.T_laser)[0]
    return float(min(np.linalg.eigvals(Ad).real))


def _current(e: Evidence) -> float:
    step, F_z = e.value("sensitivity.displacement"), e.value("sensitivity.F_z")
    i = [np.array(halbach.phase_currents(e.par, x, 0, F_z)) for x in (0.0, step)]
    return float(np.abs(i[1] - i[0]).max())


def _step_of(pwm: halbach.Pwm) -> Callable[[Evidence], float]:
    return lambda e: float(halbach.pwm_step(e.par, pwm))


def _duty(e: Evidence, sign: int) -> float:
    return float(halbach.duty_cycles(e.par, e.par.R * sign * e.value("pwm.current")))


def _duty_at_force(e: Evidence) -> FloatArray:
    places = np.linspace(0, 2 * math.pi / e.par.k, 361)
    V = [e.par.R * halbach.phase_currents(e.par, x, 0, e.par.F_z) for x in places]
    return np.array([np.array(halbach.duty_cycles(e.par, v)).ravel() for v in V])


def _first_stair(e: Evidence) -> float:
    """Where the open loop stands then, plain PWM."""
    return float(places(e.flown["stairs"].cases[0].run)[0][1])


def _swing(case: int, e: Evidence) -> float:
    return e.flown["stairs"].cases[case].merits[3].value


def _way(e: Evidence) -> float:
    run = e.flown["ramp"].run
    return float(run.p[-1, 0] - run.p[0, 0])


def _stepped(e: Evidence) -> float:
    """How far it has gone a second after a jump, on average."""
    return STEP * float(responses(e.flown["step"].run, STEP, COUNT)[:, PAUSE // 2 :].mean())


def _stepping(case: int, number: int, e: Evidence) -> float:
    return e.flown["step"].cases[case].merits[number].value


def _source(number: int, e: Evidence) -> float:
    return e.flown["budget"].cases[number].merits[0].value


def _moved(e: Evidence, label: str, number: int) -> float:
    return next(case.merits[number].value for case in e.flown["force"].cases if case.label == label)


def _largest_change(fault: str, e: Evidence) -> float:
    return max(abs(_change(f"{law}, {fault}", e)) for law in LAWS)


def _change(label: str, e: Evidence) -> float:
    return _moved(e, label, 0)
