"""Claims of the paper on the Halbach linear motor: a row for each published figure."""

from __future__ import annotations

import math
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np

from malta.files import shipped_path
from malta.machines.halbach import electronics
from malta.machines.halbach.electronics import MEAN_OF
from malta.machines.halbach.open_loop import FAULTS, LAWS, positions_at_rest
from malta.machines.halbach.paper.evidence import (
    DEAD_FORCE,
    bits_of_mean,
    current_for_step,
    duty,
    duty_at_force,
    figure_2,
    first_stair,
    largest_lift_change,
    mean_step,
    pwm_step_of,
    ramp_distance,
    rest_in_dead_ends,
    rise_of_dip,
    sampled_pole,
    samples_of_range,
)
from malta.machines.halbach.paper.evidence import evidence as evidence
from malta.machines.halbach.plant import Parameters
from malta.model.data import read
from malta.report.ledger import Row, case_merit, machine_share, merit, peak_sensitivity

SOURCE = "L. C. Díaz-Pérez et al., Actuators 7(4), 2018"
REPRODUCING = ("halbach_pid",)


MOTOR: tuple[Row, ...] = (
    Row(
        "pitch, 2π/k",
        "mm",
        "{:.3f}",
        lambda e: 2 * math.pi / e.par.k,
        "motor.pitch",
        "equal",
        "k, an input",
        by_construction=True,
    ),
    Row(
        "more air gap that costs a tenth of A, (2)",
        "mm",
        "{:.2f}",
        lambda e: math.log(1 / 0.9) / e.par.k,
        note="A e^(-k z₀), z₀ = 0.4 mm as printed; the proven box of 10 % of A covers it",
    ),
    Row("Fig. 2: largest force", "N", "{:.3f}", lambda e: figure_2(e)[0], "figure_2.force", "equal"),
    Row(
        "Fig. 2: between F_x and F_z",
        "deg",
        "{:.1f}",
        lambda e: figure_2(e)[1],
        math.pi / 2,
        "equal",
        "the motor law has a sine and a cosine",
        by_construction=True,
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
        sampled_pole,
        note="the Park angle is held; a mass with friction alone has 0.871",
    ),
    Row(
        "current for 1 µm at 5 N, peak",
        "mA",
        "{:.2f}",
        current_for_step,
        "sensitivity.current",
        why="0.1 mA for 1 µm makes the 6 mA of a PWM step 60 µm, four times the paper's own 15 µm",
    ),
)


MEAN = "a mean of 32 samples leaves 22 mA / √32 of white noise: theirs is none"
ELECTRONICS: tuple[Row, ...] = (
    Row(
        "PWM: step of a phase voltage",
        "mV",
        "{:.2f}",
        pwm_step_of("plain"),
        "pwm.step",
        note="V_dc over the counts of the PWM; printed rounded",
        by_construction=True,
    ),
    Row(
        "high-resolution PWM: 150 ps of a period at 12 V",
        "mV",
        "{:.4f}",
        lambda e: e.par.V_dc * e.value("pwm.micro_edge") * e.par.f_pwm,
        "pwm.fine_step",
        note="a product of inputs",
        by_construction=True,
    ),
    *(
        Row(
            f"duty cycle at {sign}2.1 A",
            "percent",
            "{:.1f}",
            partial(duty, sign=factor),
            key,
            "equal",
            "1/2 + R i / V_dc, of inputs",
            by_construction=True,
        )
        for sign, factor, key in (("−", -1, "pwm.duty_low"), ("+", 1, "pwm.duty_high"))
    ),
    Row("least duty cycle at 5 N", "percent", "{:.1f}", lambda e: duty_at_force(e).min(), "pwm.duty_low"),
    Row(
        "greatest duty cycle at 5 N",
        "percent",
        "{:.1f}",
        lambda e: duty_at_force(e).max(),
        "pwm.duty_high",
    ),
    Row(
        "current sensor: step",
        "A",
        "{:.2f}",
        lambda e: electronics.adc_step(e.par),
        "current_sampling.step",
        "equal",
        "the range over the codes, both inputs",
        by_construction=True,
    ),
    Row(
        "current sensor: noise after the rolling mean",
        "mA",
        "{:.1f}",
        lambda e: e.par.s_adc / math.sqrt(MEAN_OF),
        "current_sampling.noise_of_mean",
        why=MEAN,
    ),
    Row(
        f"current sensor: range of {MEAN_OF} samples",
        "A",
        "{:.2f}",
        lambda e: electronics.expected_range(e.par, MEAN_OF),
        "current_sampling.range",
        why="the paper does not say how many samples: as many as its mean takes are our reading",
    ),
    Row(
        "samples that range over the printed 0.12 A",
        "1",
        "{:.0f}",
        samples_of_range,
        note="normal noise of the printed 22 mA: the two figures agree for so many samples",
    ),
    Row(
        "bits that the rolling mean adds",
        "1",
        "{:.1f}",
        bits_of_mean,
        "current_sampling.bits_of_mean",
        why="log2 √32 of white noise; the printed 22 mA and 3.2 mA are 2.8 bits: whole bits, rounded down",
    ),
    Row(
        "vertical force up to which PWM steps are fine",
        "N",
        "{:.2f}",
        lambda e: electronics.largest_fine_force(e.par),
        "pwm.force",
        "at least",
        "coarse within 3 counts of 0 and of 100 %: the module's manual; the paper says “near”",
    ),
    *(
        Row(
            f"at {DEAD_FORCE} N, {text}: rest off by",
            "nm",
            "{:.0f}",
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
        "rad/s",
        "{:.0f}",
        lambda e: e.spec.plant.actuator.crossover,
        note="the paper prints no gains; 60° with the MEAN of 32",
    ),
)


TEN = "ten times too large: it goes as the step of the voltage, 15 µm × 26.2 µV / 5.86 mV"
OPEN_LOOP: tuple[Row, ...] = (
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
        why=TEN,
    ),
    Row(
        "Fig. 7a: second stair of 10 µm",
        "um",
        "{:.2f}",
        lambda e: abs(float(np.diff(positions_at_rest(e.experiments["stairs"].cases[0].run)[0])[1])),
        0.1e-6,
        "at most",
        "“cannot react”, read as 0.1 µm",
    ),
    Row("Fig. 7a: first stair", "um", "{:.2f}", first_stair, note="then 13.39, 26.74, 40.17 µm"),
)


MAIN = "the paper names it as one of the two main sources"
JUMP = "no set-point weight: a jump of the reference enters the proportional part"
CLOSED_LOOP: tuple[Row, ...] = (
    Row(
        "Fig. 7b: swing, plain PWM",
        "um",
        "{:.1f}",
        partial(case_merit, "stairs", 2, 3),
        note="“marginally oscillates”",
    ),
    Row(
        "Fig. 7c: swing, high-resolution PWM",
        "um",
        "{:.2f}",
        partial(case_merit, "stairs", 3, 3),
        note="“imperceptible”",
    ),
    Row(
        "Fig. 8: way at constant speed",
        "mm",
        "{:.1f}",
        ramp_distance,
        "closed_loop.travel",
        "equal",
        "an input: the reference has it",
        by_construction=True,
    ),
    Row(
        "Fig. 8: mean lag, worst of 1, 2, 5 mm/s",
        "um",
        "{:.2f}",
        lambda e: max(case.merits[0].value for case in e.experiments["ramp"].cases),
    ),
    Row(
        "Fig. 8: vertical force off by",
        "percent",
        "{:.2f}",
        lambda e: max(case.merits[3].value for case in e.experiments["ramp"].cases),
    ),
    Row(
        "Fig. 9: step",
        "um",
        "{:.1f}",
        mean_step,
        "closed_loop.step",
        note="an input: the reference has it",
        by_construction=True,
    ),
    Row(
        "Fig. 9: mean overshoot of a jump",
        "percent",
        "{:.1f}",
        partial(case_merit, "step", 0, 0),
        note=f"of the PID: {JUMP}",
    ),
    Row("the same of a quintic in 0.3 s", "percent", "{:.1f}", partial(case_merit, "step", 1, 0)),
    Row(
        "Fig. 9: a jump is within 5 % after",
        "s",
        "{:.2f}",
        partial(case_merit, "step", 0, 1),
        "position_control.response",
        "at most",
    ),
    Row("the same of a quintic in 0.3 s", "s", "{:.2f}", partial(case_merit, "step", 1, 1)),
    Row("at rest, all sources: rms", "um", "{:.2f}", partial(case_merit, "step", 0, 2)),
    Row("at rest, all sources: mean error", "um", "{:.3f}", partial(case_merit, "step", 0, 3)),
    Row("noise of the laser alone: rms", "um", "{:.2f}", partial(case_merit, "budget", 0, 0), note=MAIN),
    Row(
        "noise of the current sensors alone: rms",
        "um",
        "{:.2f}",
        partial(case_merit, "budget", 1, 0),
        note=MAIN,
    ),
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
    Row("steps of the current sensors alone: rms", "um", "{:.2f}", partial(case_merit, "budget", 2, 0)),
    Row(
        "steps of the PWM alone: rms",
        "um",
        "{:.2f}",
        partial(case_merit, "budget", 3, 0),
        note="current loops take them out",
    ),
    Row(
        "angles of 24 bits alone: rms",
        "nm",
        "{:.2f}",
        partial(case_merit, "budget", f"angle of {electronics.IQ_BITS} bits", 0),
        "fixed_point.error",
        "at most",
        "the library's default, the paper prints no format; a step is 1.77 nm",
    ),
    Row(
        "share of the box of m, A, b, R",
        "percent",
        "{:.0f}",
        machine_share,
        note="proven; 10 % of m and A, 20 % of b and R; k makes waves along the travel and is flown in campaigns",
    ),
    Row("peak sensitivity", "1", "{:.2f}", peak_sensitivity),
)


WHY = "no steady change follows from the motor law, and no fault below has both signs and 0 under vector control"
TRANSIENT = "largest change on the way, of the sign that the paper prints"
LIFT: tuple[Row, ...] = (
    Row(
        "Fig. 10: open loop, steady change",
        "percent",
        "{:.2f}",
        partial(case_merit, "force", "open loop", 0),
        "figure_10.open_loop",
        why=WHY,
    ),
    Row(
        "Fig. 10: position control, steady change",
        "percent",
        "{:.2f}",
        partial(case_merit, "force", "position control", 0),
        "figure_10.position_controller",
        why=WHY,
    ),
    Row(
        "Fig. 10 as a transient: open loop, lowest",
        "percent",
        "{:.1f}",
        partial(case_merit, "force", "open loop", "lowest"),
        "figure_10.open_loop",
        note=f"{TRANSIENT}; back within 5 s",
        why="a jump of 5 mm is 1 − cos(k 5 mm) = 51 %, all at once: a slower command or a slow load cell sees less",
        of_machine=True,
    ),
    Row(
        "the same with a quintic: rise that dips by as much",
        "s",
        "{:.3f}",
        lambda e: rise_of_dip(e.spec.plant, e.value("figure_10.open_loop")),
        note="solved; from 10 to 90 % of the 5 mm, without electronics",
        of_machine=True,
    ),
    Row(
        "Fig. 10 as a transient: position control, highest",
        "percent",
        "{:.1f}",
        partial(case_merit, "quick", "position control", "highest"),
        "figure_10.position_controller",
        note=f"{TRANSIENT}; with the same quintic, at the assumed limit of 2 N; 0.3 s makes 1.4 %",
    ),
    Row(
        "the same under vector control",
        "percent",
        "{:.1f}",
        partial(case_merit, "quick", "vector control", "highest"),
        note="currents are commutated for a reading that is up to 55 ms old, with current loops and without; the paper "
        "finds its transient smoother",
    ),
    Row(
        "Fig. 10: vector control, steady change",
        "percent",
        "{:.2f}",
        lambda e: abs(case_merit("force", "vector control", 0, e)),
        1e-3,
        "at most",
        "“coincident with its target”, read as 0.1 %",
    ),
)


def _lift() -> list[Row]:
    """Rows of the changes of the vertical force that possible faults cause."""
    found: list[Row] = []
    for fault in [fault for fault in FAULTS if fault != "sound"]:
        if not FAULTS[fault].keys() & {f.name for f in fields(Parameters)}:  # of the motor itself it is none
            largest = partial(largest_lift_change, fault)
            found.append(Row(f"{fault}: largest of the three", "percent", "{:.2f}", largest, note="tried"))
            continue
        for law in LAWS:
            value = partial(case_merit, "force", f"{law}, {fault}", 0)
            found.append(Row(f"{fault}: {law}", "percent", "{:.1f}", value, note="tried"))
    return found


FITTED = (
    "fitted to the laser's readings of a simulated record with K known, as Sec. 2.3 does; the record's motor has the "
    "printed figure"
)


def _fitted() -> list[Row]:
    """Rows of mass and friction as the paper identified them; their printed figures stand in the machine's data."""
    printed: Any = read(shipped_path("data", "halbach.toml"))
    found: list[Row] = []
    for name, unit, value, note in (
        ("mass", "kg", printed.m, f"{FITTED}: (5) is a line where the motor has a sine, which costs 2 %"),
        ("friction", "N s/m", printed.b, FITTED),
    ):
        fit, half = (
            partial(merit, "identify", f"{name}, {what}") for what in ("fitted", "half of its interval")
        )
        found += [
            Row(f"step of 2 mm: {name}", unit, "{:.2f}", fit, value, note=note, by_construction=True),
            Row(f"step of 2 mm: {name}, half of its interval", unit, "{:.2f}", half, note=INTERVAL),
        ]
    return found


INTERVAL = "95 %; residuals that are correlated over a period, of a K that is taken as exact"


def rows() -> list[Row]:
    """All claims of the paper, in the order of the ledger."""
    motor = [row._replace(of_machine=True) for row in (*MOTOR, *_fitted(), *ELECTRONICS, *OPEN_LOOP)]
    return [*motor, *CLOSED_LOOP, *LIFT, *_lift()]
