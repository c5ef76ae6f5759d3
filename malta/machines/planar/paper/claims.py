"""Claims of the paper on the planar motor: a row for each published figure."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from malta.machines.planar.motions import AHEAD, DESIGNED, LINEAR, SOFT
from malta.machines.planar.paper.evidence import (
    angles_at_rest,
    coil_torque,
    coils_width,
    condition,
    extreme,
    force_ratio,
    formula_error,
    implied_step,
    jump_ratio,
    largest_deviation,
    misprint_error,
    phi_ratio,
    pole_field,
    printed_torque,
    residual,
    slower_torque,
    symmetric_deviation,
)
from malta.machines.planar.paper.evidence import evidence as evidence
from malta.report.ledger import ZONE_NOTE, Row, case_merit, machine_share, merit, peak_sensitivity

SOURCE = "F. Xing et al., 2017"
REPRODUCING = ("planar_pid",)


WRENCH = (("F_x", "N"), ("F_y", "N"), ("F_z", "N"), ("T_x", "N m"), ("T_y", "N m"), ("T_z", "N m"))


ARM = (
    "the paper names neither the coil nor the pitch; its F_z and T_x imply an arm of 65 mm, ours is 47 mm: see the "
    "rows with 22/3 τ_n"
)
WIDE = (
    22 / 3
)  # coil pitch in tau_n whose half is that arm; 4 + 10/3, where K(p) is as well conditioned as with 16/3
BOTH = "B_r and the corner radius, not printed, were chosen for it and 0.81 T"
NOTES = {"F_x": BOTH, "F_y": BOTH, "T_x": "", "T_y": "", "T_z": ""}
ERRORS = {
    "N": "the paper's are amplitudes 7 to 9 % off, not missing harmonics",
    "N m": "of an inner coil; the rectangles of (23), (24) overlap: 3.8 times a rounded coil's own torque",
}
COIL: tuple[Row, ...] = (
    Row(
        "field over a pole at 1 mm",
        "T",
        "{:.2f}",
        pole_field,
        "field.B_z",
        "equal",
        BOTH,
        by_construction=True,
    ),
    *(
        Row(
            f"one coil at 3 A: {name}",
            unit,
            "{:.2f}",
            partial(merit, "errors", f"{name}, amplitude"),
            f"model.amplitude.{name}",
            "about",
            NOTES.get(name, "4 % less; see the ratio"),
            ARM,
            by_construction=NOTES.get(name) == BOTH,
        )
        for name, unit in WRENCH
    ),
    *(
        Row(
            f"the same with coils 22/3 τ_n apart: {name}",
            "N m",
            "{:.2f}",
            partial(coil_torque, WIDE, name),
            f"model.amplitude.{name}",
            "about",
            "preset pitch_22_3; at most 1.63 by the printed F_x, F_z, T_x and T_y"
            if name == "T_z"
            else "preset pitch_22_3",
        )
        for name in ("T_x", "T_y", "T_z")
    ),
    Row(
        "width of the coils, 22/3 τ_n apart",
        "mm",
        "{:.0f}",
        partial(coils_width, WIDE),
        note="what it costs: a plate of 400 mm has the printed mass and inertias, and 16/3 τ_n take 348 mm of it",
    ),
    Row(
        "F_z over F_x",
        "1",
        "{:.2f}",
        force_ratio,
        "implied.force_ratio",
        "equal",
        "",
        "a field without curl gives 2 for the fundamental, this coil's 1.99 with all harmonics",
    ),
    Row(
        "T_z that (20)–(22) make of the printed F_x, F_z, T_x, T_y",
        "N m",
        "{:.2f}",
        printed_torque,
        "model.amplitude.T_z",
        "equal",
        "",
        "the printed torques contradict each other",
    ),
    Row(
        "(17)–(21) against quadrature of their own field",
        "1",
        "{:.0e}",
        formula_error,
        note="largest relative difference, with -x_k F_z for the -y_k F_z that (21) prints",
    ),
    *(
        Row(
            f"analytical model, error of {name}",
            unit,
            "{:.3f}",
            partial(case_merit, "errors", "analytical", f"{name}, largest error"),
            f"model.error_analytical.{name}",
            "at most",
            ERRORS[unit],
        )
        for name, unit in WRENCH
    ),
)


TABLE: tuple[Row, ...] = (
    *(
        Row(
            f"table of τ_n/35, error of {name}",
            unit,
            "{:.3f}",
            partial(case_merit, "errors", "table", f"{name}, largest error"),
            f"model.error_interpolation.{name}",
            "at most",
        )
        for name, unit in WRENCH
    ),
    Row(
        "error of the table, each halving of its step",
        "1",
        "{:.2f}",
        partial(merit, "errors", "error of the table, each halving of its step"),
        4.0,
        note="bilinear interpolation has it",
        by_construction=True,
    ),
    *(
        Row(
            f"step of the table that errs by the printed {name}",
            "mm",
            "{:.2f}",
            partial(implied_step, name),
            note="the paper prints none; its F_x and F_z imply different ones",
        )
        for name in ("F_x", "F_z")
    ),
    Row(
        "error of F_x with (27) as printed, τ_n/10",
        "N",
        "{:.1f}",
        misprint_error,
        note="two weights are in each other's place; 0.15 N with them mended",
    ),
)


PITCH = "the paper prints no coil pitch"
MOVER: tuple[Row, ...] = (
    Row(
        "condition of K(p), at most",
        "1",
        "{:.2f}",
        partial(condition, 16 / 3),
        note=f"16/3 τ_n; {PITCH}",
    ),
    Row("the same with 14/3 τ_n", "1", "{:.2f}", partial(condition, 14 / 3), note=PITCH),
    Row("the same with 22/3 τ_n", "1", "{:.2f}", partial(condition, WIDE), note="wider than the plate"),
    Row(
        "the same with 4 τ_n",
        "1",
        "{:.0f}",
        partial(condition, 4.0),
        note="all coils in phase: singular",
    ),
    Row("K K⁺ W − W over W, at most", "1", "{:.0e}", residual, note="over a period at the working height"),
    Row(
        "K(p) and pseudo-inverse, table",
        "us",
        "{:.1f}",
        partial(merit, "timing", "table, compiled"),
        "table_2.interpolation",
        "beside",
        "compiled, on this computer; the paper's on an NI PXI-1042Q",
    ),
    Row(
        "K(p) and pseudo-inverse, analytical",
        "us",
        "{:.1f}",
        partial(merit, "timing", "analytical, compiled"),
        "table_2.analytical",
        "beside",
        "on another computer, as above",
    ),
    Row(
        "K(p) and pseudo-inverse, exact field",
        "s",
        "{:.0e}",
        partial(merit, "timing", "exact, compiled"),
        "table_2.fem",
        "beside",
        "ours sums 22 harmonics of an endless array's field at one place; the paper's hour is a finite-element "
        "model's, whose mesh and number of places it does not print",
    ),
    Row(
        "K(p) and pseudo-inverse with filter and law, table",
        "us",
        "{:.1f}",
        partial(merit, "timing", "whole step by the table, compiled"),
        note="a whole step of the controller without input and output, on this computer",
    ),
    Row(
        "longest loop of the whole program",
        "us",
        "{:.0f}",
        lambda _: math.nan,
        "real_time.longest",
        "beside",
        "a program with input and output on an NI PXI-1042Q. Ours runs without, and the longest of its steps on this "
        "computer is a matter of the scheduler, up to milliseconds",
    ),
    Row(
        "control period",
        "us",
        "{:.0f}",
        lambda e: e.controller.sample_time,
        "real_time.mean",
        "equal",
        "an input: taken from it",
        by_construction=True,
    ),
)


QUINTIC = "quintics of 20 and 40 ms; the paper commands jumps, see the rows of jumps"
MISSING = "start, gains and pitch are missing, and with them the motion; ours holds currents for 200 µs, a sample late"
RECTANGLES = f"{MISSING}; and the overlapping rectangles of (23), (24) make too much torque"
STEPS: tuple[Row, ...] = (
    Row(
        "y within 10 µm after its step of 10 mm",
        "ms",
        "{:.1f}",
        partial(case_merit, "step", 0, "y within 10 um after its step"),
        note="a quintic of 40 ms, as all rows up to those of jumps",
    ),
    Row(
        "y, overshoot", "um", "{:.2f}", partial(case_merit, "step", 0, "y, overshoot"), note="asked for: 1 µm"
    ),
    Row(
        "z, from 20 ms after its step of 1 mm",
        "um",
        "{:.2f}",
        partial(case_merit, "step", 0, "z, from 20 ms after its step"),
        note="asked for: 1.5 µm; from 50 µm over the magnets, as the paper's start on them is a touchdown",
    ),
    Row(
        "largest force",
        "N",
        "{:.0f}",
        partial(case_merit, "step", 0, "largest force"),
        "steps.force_limit",
        "at most",
        "an input: commands are limited there",
        by_construction=True,
    ),
    Row(
        "x, theta, psi from (0, 0)",
        "urad",
        "{:.0e}",
        symmetric_deviation,
        note="zero by mirror symmetry, µm or µrad: the paper, where they move, started elsewhere",
    ),
)


def _step_rows() -> list[Row]:
    """Rows of the motion under quintics: deviations and forces beside the paper's, and what each coil model moves."""
    found: list[Row] = []
    for model, key in (("analytical", "analytical"), ("table", "interpolation")):
        found += [row._replace(relation="beside", note=QUINTIC) for row in _ranges(model, key, "", "")]
    for model in ("table", "analytical"):
        for name in ("phi", "theta"):
            found.append(
                Row(
                    f"{model} moves {name} by",
                    "urad",
                    "{:.3f}",
                    partial(merit, "step", f"{model} moves {name} by"),
                    note="off the path of the exact model",
                )
            )
    found.append(
        Row(
            "phi moved: analytical over table",
            "1",
            "{:.0f}",
            phi_ratio,
            "implied.phi_ratio",
            "beside",
            QUINTIC,
        )
    )
    return found


def _ahead_rows() -> list[Row]:
    """Rows of the quintics with currents for the place where they will act, beside those for the place as read."""
    exact, table = (f"{model}, {AHEAD}" for model in ("exact", "table"))
    found = [
        Row(
            f"{text}: {name}, largest",
            "urad",
            "{:.3f}",
            partial(largest_deviation, model, name),
            note=note,
        )
        for name in ("phi", "theta", "psi")
        for text, model, note in (
            ("exact, place as read", "exact", "currents are those of a place 300 µs old, on average"),
            (exact, exact, "same loop, same margins: the prediction is the reference's"),
        )
    ]
    for name, unit in DEVIATIONS:
        rows = _range(table, "interpolation", name, unit, "p", "", "")
        found += [row._replace(relation="beside", note=QUINTIC) for row in rows]
    return found


BRAKES = "its braking; the least for 10 mm is 28.3 ms, at ±1000 N all the way"
SWINGS = "±1000 N are too little for gains this fast: a linear law brakes too late and swings about its end"
SLOW = "y and z approach their ends at the fastest rate that brakes within ±1000 N, √(3 F / 2 m d)"
SLOWEST = "Kp = 1.2 N/µm of the PID: gains, which the paper does not print, decide about its torques"


def _jump_rows() -> list[Row]:
    """Rows of the steps as the paper commands them: jumps that saturate."""
    last = partial(case_merit, "jump")
    found = [
        Row(
            f"jumps, {DESIGNED}: y within 10 µm after",
            "ms",
            "{:.1f}",
            partial(last, f"table, {DESIGNED}", "y within 10 um after its step"),
            note=BRAKES,
        ),
        Row(
            f"jumps, {DESIGNED}: y, overshoot",
            "um",
            "{:.1f}",
            partial(last, f"table, {DESIGNED}", "y, overshoot"),
        ),
        Row(
            f"jumps, {LINEAR}: y off at 0.1 s",
            "mm",
            "{:.2f}",
            partial(last, f"table, {LINEAR}", "y, left at the end"),
            note=SWINGS,
        ),
        *(
            Row(f"jumps, {SOFT}: {text}", "um", "{:.1f}", partial(last, f"table, {SOFT}", label), note=note)
            for text, label, note in (
                ("y off at 0.1 s", "y, left at the end", SLOW),
                ("y, overshoot", "y, overshoot", ""),
                ("z off at 0.1 s", "z, left at the end", ""),
            )
        ),
        Row(
            f"jumps, {SOFT}: largest force",
            "N",
            "{:.0f}",
            partial(last, f"table, {SOFT}", "largest force"),
            "steps.force_limit",
            "equal",
            "an input: commands are limited there, and reach it as the paper's do",
            by_construction=True,
        ),
    ]
    for model, key, why in (("analytical", "analytical", RECTANGLES), ("table", "interpolation", MISSING)):
        found += _ranges(f"{model}, {SOFT}", key, "jumps, ", why)
    found += [
        Row(
            f"jumps, {model}, at 50/s: T_x, {side}",
            "N m",
            "{:.3f}",
            partial(slower_torque, model, of),
            note=SLOWEST,
        )
        for model in ("analytical", "table")
        for side, of in (("lowest", np.min), ("highest", np.max))
    ]
    found.append(
        Row(
            "jumps: phi moved, analytical over table",
            "1",
            "{:.1f}",
            jump_ratio,
            "implied.phi_ratio",
            "at least",
            "its conclusion: the table is better; what it leaves is what "
            "late currents do, as by the exact model",
        )
    )
    return found


DEVIATIONS = (("x", "um"), ("phi", "urad"), ("theta", "urad"), ("psi", "urad"))


def _ranges(model: str, key: str, start: str, why: str) -> list[Row]:
    """Rows of all deviations and forces of a flight whose range the paper prints; subjects begin with `start`."""
    found = [row for name, unit in DEVIATIONS for row in _range(model, key, name, unit, "p", start, why)]
    loads = (("F_x", "N"), *WRENCH[3:])
    return found + [row for name, unit in loads for row in _range(model, key, name, unit, "v", start, why)]


def _range(model: str, key: str, name: str, unit: str, series: str, start: str, why: str) -> list[Row]:
    """Rows of the lowest and the highest value of a deviation or a force: ours within the paper's."""
    sides = (("lowest", "at least", np.min), ("highest", "at most", np.max))
    return [
        Row(
            f"{start}{model}: {name}, {side}",
            unit,
            "{:.3f}",
            partial(extreme, model, name, series, of),
            f"steps.{key}.{side}.{name}",
            relation,
            "",
            why,
        )
        for side, relation, of in sides
    ]


LOOP: tuple[Row, ...] = (
    Row(
        "peak sensitivity, worst sensor",
        "1",
        "{:.1f}",
        peak_sensitivity,
        note=ZONE_NOTE,
    ),
    Row(
        "share of the design's box that is proven",
        "percent",
        "{:.0f}",
        machine_share,
        note="anywhere in the travel",
    ),
    *(
        Row(
            f"three times as fast, filter {name} the delay: angles",
            "urad",
            "{:.2f}",
            partial(angles_at_rest, f"{name}, 3 x"),
            note="left at rest; it is the sample of computation",
        )
        for name in ("with", "without")
    ),
)


def rows() -> list[Row]:
    """All claims of the paper, in the order of the ledger."""
    model = [row._replace(of_machine=True) for row in (*COIL, *TABLE, *MOVER)]
    return [*model, *STEPS, *_step_rows(), *_ahead_rows(), *_jump_rows(), *LOOP]
