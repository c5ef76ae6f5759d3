"""What the paper on the planar motor publishes, a row for each figure, and ours; no design loads it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta import Spec, synthesize
from malta.machines.planar import commutation, field as planar_field, plant as planar
from malta.machines.planar.motions import DESIGN_END, LINEAR_END, SOFT_END
from malta.margins import LoopReport
from malta.model.printed import published_value
from malta.simulation import Experiment, Trajectory
from malta.simulation.experiments import Progress
from malta.synthesis import Controller
from malta_papers.ledger import ZONE_NOTE, Row, case_merit, machine_share, merit, peak_sensitivity, run_design
from malta_papers.planar.experiments import CURRENT, PREDICTION, coil_wrench, soft_jumps, steps_ahead

if TYPE_CHECKING:
    from malta.arrays import FloatArray

EXPERIMENT_NAMES = ("step", "jump", "errors", "timing", "delay")
TIMES = 5  # the sample rate: how far motion under jumps depends on currents that are held
RATE = 49.6  # 1/s, approach of Kp = 1.2 N/um with the Kd of planar_pid: how far torques depend on gains
AT_ONCE_LABEL = "at once"
FASTER_CASE, SLOWER_CASE = f"{AT_ONCE_LABEL}, {TIMES} times the rate", f"{AT_ONCE_LABEL}, at {RATE:.0f}/s"


@dataclass(frozen=True, eq=False)
class PlanarEvidence:
    """A design, its margins and its experiments, beside the published figures."""

    spec: Spec
    published: Mapping[str, Any]
    parameters: planar.Parameters
    controller: Controller
    margins: LoopReport
    # experiments : with "ahead", and soft jumps without delay, AT_ONCE_LABEL, also SLOWER_CASE and FASTER_CASE;
    # without "delay" for other laws than an LQG, which predict nothing
    experiments: Mapping[str, Experiment]


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> PlanarEvidence:
    """Design a controller, prove its margins and run the experiments."""
    few: dict[str, Any] = {"engine": "virtual machine"}  # runs of a law: compiling it takes longer
    found = run_design(spec, EXPERIMENT_NAMES[: None if spec.kind == "LQG" else -1], progress, **few)
    par: Any = spec.parameters
    at_once, faster = (
        synthesize(replace(spec, delay=0, sample_time=spec.sample_time / times), found.model, solver="scipy")
        for times in (1, TIMES)
    )
    experiments = found.experiments | {
        "ahead": steps_ahead(spec.plant, found.controller, **few),
        AT_ONCE_LABEL: soft_jumps(spec.plant, at_once, delay=0, **few),
        SLOWER_CASE: soft_jumps(spec.plant, at_once, rate=RATE, delay=0, **few),
        FASTER_CASE: soft_jumps(spec.plant, faster, delay=0, **few),
    }
    return PlanarEvidence(spec, published, par, found.controller, found.margins, experiments)


def pole_field(e: PlanarEvidence) -> float:
    """Flux density over a pole at the working height, T."""
    par = e.parameters
    return float(planar_field.flux_density(planar_field.modes(par), np.array([par.tau_n, 0, par.h]))[2])


def force_ratio(e: PlanarEvidence) -> float:
    """Amplitude of F_z over that of F_x, of one coil."""
    return merit("errors", "F_z, amplitude", e) / merit("errors", "F_x, amplitude", e)


def printed_torque(e: PlanarEvidence) -> float:
    """T_z of (22), N m, from the printed F_x and from the arms of the coil that the printed F_z, T_x and T_y imply."""
    F_x, F_z, T_x, T_y = (
        published_value(e.published, f"model.amplitude.{k}") for k in ("F_x", "F_z", "T_x", "T_y")
    )
    return F_x * (T_x + T_y) / F_z


def formula_error(e: PlanarEvidence) -> float:
    """Largest relative difference of (17)-(21) from quadrature over the rectangles in the fundamental's field."""
    par = replace(e.parameters, C=1.0)
    field = planar_field.fundamental(par, par.B_z * math.exp(math.pi / par.tau_n * par.h))
    coil = planar_field.winding(par, rectangles=True, nodes=40)
    p = np.array([6e-3, 4e-3, par.h])
    expected = planar_field.quadrature(par, field, coil, p)
    found = planar_field.Analytical(par)(*(np.array([v]) for v in p))[0]
    return float(
        max(np.abs((found - expected)[k]).max() / np.abs(expected[k]).max() for k in (slice(3), slice(3, 6)))
    )


def implied_step(name: str, e: PlanarEvidence) -> float:
    """Step of a table, m, for which the error is the printed one; interpolated as the square of the step."""
    printed = published_value(e.published, f"model.error_interpolation.{name}")
    curves = e.experiments["errors"].curves
    error = curves["by step"][:, ("F_x", "F_z").index(name)]
    return float(np.exp(np.interp(math.log(printed), np.log(error[::-1]), np.log(curves["step"][::-1]))))


def misprint_error(e: PlanarEvidence) -> float:
    """Largest error of F_x, N, of a table of 10 cells with two weights exchanged as (27) prints them."""
    par, truth = e.parameters, planar_field.exact_model(e.parameters)
    table = planar_field.table(par, truth, 10)
    printed = replace(table, cells=table.cells[:, [0, 2, 1, 3]])
    x, y = np.meshgrid(*[np.linspace(0, par.tau_n, 81)] * 2, indexing="ij")
    z = np.full_like(x, par.h)
    return CURRENT * float(np.abs(printed(x, y, z) - truth(x, y, z))[..., 0].max())


def condition(ratio: float, e: PlanarEvidence) -> float:
    """Worst condition of K(p) for a coil pitch of `ratio` tau_n."""
    par = replace(e.parameters, coil_pitch=ratio * e.parameters.tau_n)
    return float(commutation.condition_numbers(par, planar_field.simulation_model(par)).max())


def coil_torque(ratio: float, name: str, e: PlanarEvidence) -> float:
    """Amplitude of a torque, N m, of an inner coil at the paper's 3 A for a coil pitch of `ratio` tau_n."""
    par = replace(e.parameters, coil_pitch=ratio * e.parameters.tau_n)
    x, y = np.meshgrid(*[np.linspace(0, 2 * par.tau_n, 141)] * 2, indexing="ij")
    wrench = coil_wrench(par, planar_field.exact_model(par), CURRENT, x, y)
    return float(np.abs(wrench[..., [s.name for s in e.spec.plant.inputs].index(name)]).max())


def coils_width(ratio: float, e: PlanarEvidence) -> float:
    """Width of the 4 x 4 coils, m, for a coil pitch of `ratio` tau_n."""
    par = e.parameters
    return 3 * ratio * par.tau_n + par.l_c + par.w_c


def residual(e: PlanarEvidence) -> float:
    """Largest relative error of the wrench K i of the computed currents, over a period."""
    par = e.parameters
    model, W, worst = planar_field.simulation_model(par), np.array([100.0, 200, 400, 10, 20, 30]), 0.0
    for x in np.arange(6) * par.tau_n / 3:
        for y in np.arange(6) * par.tau_n / 3:
            K = commutation.wrench_matrix(par, model, np.array([x, y, par.h]))
            worst = max(worst, float(np.abs(K @ commutation.currents(K, W) - W).max() / np.abs(W).max()))
    return worst


def flight(model: str, e: PlanarEvidence) -> Trajectory:
    """The steps with a coil model, from the place without symmetry: by quintics, or as the label's end says.

    PREDICTION: with currents for the predicted place; SOFT_END: by jumps, with soft gains; then an experiment's name.
    """
    label, soft, name = model.partition(SOFT_END)
    names = (name.removeprefix(", ") or "jump",) if soft else ("step", "ahead")
    cases = (case for name in names for case in e.experiments[name].cases)
    return next(case.run for case in cases if case.label.startswith(label + soft))


def symmetric_deviation(e: PlanarEvidence) -> float:
    """Largest deviation of x, theta, psi from (0, 0) with the analytical model: m or rad."""
    run = e.experiments["step"].cases[-1].run  # the analytical model, from (0, 0)
    return float(np.abs(run.p - run.reference)[:, [0, 4, 5]].max())


def extreme(model: str, name: str, series: str, of: Callable[[FloatArray], Any], e: PlanarEvidence) -> float:
    """Smallest or largest deviation of an output, or value of a force, in the steps with a coil model. SI"""
    run = flight(model, e)
    if series == "v":
        return float(of(run.v[:, [s.name for s in run.plant.inputs].index(name)]))
    k = [s.name for s in run.plant.outputs].index(name)
    return float(of((run.p - run.reference)[:, k]))


def largest_deviation(model: str, name: str, e: PlanarEvidence) -> float:
    """Largest deviation of an output from the reference in the steps with a coil model, SI."""
    return max(-extreme(model, name, "p", np.min, e), extreme(model, name, "p", np.max, e))


def jump_ratio(e: PlanarEvidence) -> float:
    """Largest motion in phi under jumps without delay by the analytical model over that by the table."""
    analytical, table = (
        largest_deviation(f"{model}, {SOFT_END}, {AT_ONCE_LABEL}", "phi", e)
        for model in ("analytical", "table")
    )
    return analytical / table


def extremes_within(model: str, key: str, e: PlanarEvidence) -> float:
    """How many of the extremes of `_ranges` are within those that the paper prints."""
    rows = _ranges(model, key)
    printed = [published_value(e.published, str(row.published)) for row in rows]
    return sum(
        row.value(e) <= p if row.relation == "at most" else row.value(e) >= p
        for row, p in zip(rows, printed, strict=True)
    )


def unfitted_error(name: str, e: PlanarEvidence) -> float:
    """Largest error of (17)-(24) with C = 1; the wrench of the analytical model is C times that."""
    curves, C = e.experiments["errors"].curves, e.parameters.C
    error = (curves["exact"] + curves["analytical"]) / C - curves["exact"]
    return float(np.abs(error).max(axis=(0, 1))[[s.name for s in e.spec.plant.inputs].index(name)])


def implied_compensation(name: str, e: PlanarEvidence) -> float:
    """C below the fitted one for which the amplitude of a force is off by the printed error."""
    printed = published_value(e.published, f"model.error_analytical.{name}")
    amplitude = merit("errors", f"{name}, amplitude", e)
    return e.parameters.C * (amplitude - printed) / amplitude


def angles_at_rest(label: str, e: PlanarEvidence) -> float:
    """Angles left at rest in a case of the experiment `delay`, rad; NaN without the experiment."""
    if "delay" not in e.experiments:
        return math.nan
    return case_merit("delay", label, "angles, left at rest", e)


SOURCE = "F. Xing et al., 2017"
REPRODUCING = ("planar_pid",)
WRENCH = (("F_x", "N"), ("F_y", "N"), ("F_z", "N"), ("T_x", "N m"), ("T_y", "N m"), ("T_z", "N m"))


ARM = (
    "the paper names neither the coil nor the pitch; its F_z and T_x imply an arm of 65 mm, ours is 47 mm: see the "
    "rows with 22/3 τ_n"
)
WIDE_PITCH = 22 / 3  # in tau_n: twice that arm; 4 + 10/3, where K(p) is conditioned as with 16/3
FIT = "B_r and the corner radius, not printed, were chosen for it and 0.81 T"
RATIO = "a field without curl gives F_z / F_x = 2 for the fundamental, this coil's 1.99 with all harmonics"
NOTES = {"F_x": FIT, "F_y": FIT}
FITTED_ROWS = (
    "C is fitted to the truth, so that harmonics alone are missing; the paper's are amplitudes 7 to 9 % off"
)
NO_C = "the paper prints no C: between 1 and the fitted one lies what its own errors imply"
ERRORS = {
    "N": "",
    "N m": "of an inner coil; the rectangles of (23), (24) overlap: 3.8 times a rounded coil's own torque",
}
COIL: tuple[Row, ...] = (
    Row("field over a pole at 1 mm", "{:.2f} T", pole_field, "field.B_z", note=FIT, by_construction=True),
    *(
        Row(
            f"one coil at 3 A: {name}",
            f"{{:.2f}} {unit}",
            partial(merit, "errors", f"{name}, amplitude"),
            f"model.amplitude.{name}",
            note=NOTES.get(name, ""),
            why={"F_x": "", "F_y": "", "F_z": RATIO}.get(name, ARM),
            by_construction=NOTES.get(name) == FIT,
        )
        for name, unit in WRENCH
    ),
    *(
        Row(
            f"the same with coils 22/3 τ_n apart: {name}",
            "{:.2f} N m",
            partial(coil_torque, WIDE_PITCH, name),
            f"model.amplitude.{name}",
            note="preset pitch_22_3",
            why="at most 1.63 by the printed F_x, F_z, T_x and T_y" if name == "T_z" else "F_z is 4 % less",
        )
        for name in ("T_x", "T_y", "T_z")
    ),
    Row(
        "width of the coils, 22/3 τ_n apart",
        "{:.0f} mm",
        partial(coils_width, WIDE_PITCH),
        note="what it costs: a plate of 400 mm has the printed mass and inertias, and 16/3 τ_n take 348 mm of it",
    ),
    Row("F_z over F_x", "{:.2f}", force_ratio, "implied.force_ratio", why=RATIO),
    Row(
        "T_z that (20)–(22) make of the printed F_x, F_z, T_x, T_y",
        "{:.2f} N m",
        printed_torque,
        "model.amplitude.T_z",
        why="the printed torques contradict each other",
    ),
    Row(
        "(17)–(21) against quadrature of their own field",
        "{:.0e}",
        formula_error,
        note="largest relative difference, with -x_k F_z for the -y_k F_z that (21) prints",
    ),
    *(
        Row(
            f"analytical model with C = 1, error of {name}",
            f"{{:.3f}} {unit}",
            partial(unfitted_error, name),
            f"model.error_analytical.{name}",
            note=ERRORS[unit],
            why=NO_C,
        )
        for name, unit in WRENCH
    ),
    *(
        Row(
            f"C of (23), (24) that errs by the printed {name}",
            "{:.3f}",
            partial(implied_compensation, name),
            note="as much above the fitted one errs as much",
        )
        for name in ("F_x", "F_z")
    ),
    Row(
        "C of (23), (24) fitted to the truth",
        "{:.3f}",
        partial(merit, "errors", "fitted C of the analytical model"),
        note="least squares of the forces",
    ),
    *(
        Row(
            f"analytical model with the fitted C, error of {name}",
            f"{{:.3f}} {unit}",
            partial(case_merit, "errors", "analytical", f"{name}, largest error"),
            f"model.error_analytical.{name}",
            "beside",
            note=FITTED_ROWS,
        )
        for name, unit in WRENCH
    ),
)


TABLE: tuple[Row, ...] = (
    *(
        Row(
            f"table of τ_n/35, error of {name}",
            f"{{:.3f}} {unit}",
            partial(case_merit, "errors", "table", f"{name}, largest error"),
            f"model.error_interpolation.{name}",
            "at most",
        )
        for name, unit in WRENCH
    ),
    Row(
        "error of the table, each halving of its step",
        "{:.2f}",
        partial(merit, "errors", "error of the table, each halving of its step"),
        4.0,
        note="bilinear interpolation has it",
        by_construction=True,
    ),
    *(
        Row(
            f"step of the table that errs by the printed {name}",
            "{:.2f} mm",
            partial(implied_step, name),
            note="the paper prints none; its F_x and F_z imply different ones",
        )
        for name in ("F_x", "F_z")
    ),
    Row(
        "error of F_x with (27) as printed, τ_n/10",
        "{:.1f} N",
        misprint_error,
        note="two weights are in each other's place; 0.15 N with them mended",
    ),
)


PITCH = "the paper prints no coil pitch"
HOUR = (
    "ours sums 22 harmonics of an endless array's field at one place; the paper's hour is a finite-element "
    "model's, whose mesh and number of places it does not print"
)
MOVER: tuple[Row, ...] = (
    Row("condition of K(p), at most", "{:.2f}", partial(condition, 16 / 3), note=f"16/3 τ_n; {PITCH}"),
    Row("the same with 14/3 τ_n", "{:.2f}", partial(condition, 14 / 3), note=PITCH),
    Row("the same with 22/3 τ_n", "{:.2f}", partial(condition, WIDE_PITCH), note="wider than the plate"),
    Row("the same with 4 τ_n", "{:.0f}", partial(condition, 4.0), note="all coils in phase: singular"),
    Row("K K⁺ W − W over W, at most", "{:.0e}", residual, note="over a period at the working height"),
    *(
        Row(
            f"K(p) and pseudo-inverse, {text}",
            shown,
            partial(merit, "timing", f"{text.partition(' ')[0]}, compiled"),
            f"table_2.{key}",
            "beside",
            note=note,
        )
        for text, shown, key, note in (
            (
                "table",
                "{:.1f} us",
                "interpolation",
                "compiled, on this computer; the paper's on an NI PXI-1042Q",
            ),
            ("analytical", "{:.1f} us", "analytical", "on another computer, as above"),
            ("exact field", "{:.0e} s", "fem", HOUR),
        )
    ),
    Row(
        "K(p) and pseudo-inverse with filter and law, table",
        "{:.1f} us",
        partial(merit, "timing", "whole step by the table, compiled"),
        note="a whole step of the controller without input and output, on this computer",
    ),
    Row(
        "longest loop of the whole program",
        "{:.0f} us",
        lambda _: math.nan,
        "real_time.longest",
        "beside",
        note="a program with input and output on an NI PXI-1042Q. Ours runs without, and the longest of its steps on "
        "this computer is a matter of the scheduler, up to milliseconds",
    ),
    Row(
        "control period",
        "{:.0f} us",
        lambda e: e.controller.sample_time,
        "real_time.mean",
        note="an input: taken from it",
        by_construction=True,
    ),
)


AHEAD_EXACT = f"exact, {PREDICTION}"
MISSING_NOTE = "start, gains and pitch are missing, and with them the motion; ours holds currents for 200 µs"
DELAY_NOTE = "with the machine's sample of delay, which the paper's diagram does not name"
RECTANGLES = f"{MISSING_NOTE}; and the overlapping rectangles of (23), (24) make too much torque"
STEPS: tuple[Row, ...] = (
    Row(
        "y within 10 µm after its step of 10 mm",
        "{:.1f} ms",
        partial(case_merit, "step", 0, "y within 10 um after its step"),
        note="a quintic of 40 ms, as all rows up to those of jumps",
    ),
    Row("y, overshoot", "{:.2f} um", partial(case_merit, "step", 0, "y, overshoot"), note="asked for: 1 µm"),
    Row(
        "z, from 20 ms after its step of 1 mm",
        "{:.2f} um",
        partial(case_merit, "step", 0, "z, from 20 ms after its step"),
        note="asked for: 1.5 µm; from 50 µm over the magnets, as the paper's start on them is a touchdown",
    ),
    Row(
        "largest force",
        "{:.0f} N",
        partial(case_merit, "step", 0, "largest force"),
        "steps.force_limit",
        "at most",
        note="an input: commands are limited there",
        by_construction=True,
    ),
    Row(
        "x, theta, psi from (0, 0)",
        "{:.0e} urad",
        symmetric_deviation,
        note="zero by mirror symmetry, µm or µrad: the paper, where they move, started elsewhere",
    ),
)


def _step_rows() -> list[Row]:
    """Rows of the motion under quintics: what each coil model moves, and currents for where they act or were read."""
    moved = [
        Row(
            f"{model} moves {name} by",
            "{:.3f} urad",
            partial(merit, "step", f"{model} moves {name} by"),
            note="off the path of the exact model",
        )
        for model in ("table", "analytical")
        for name in ("phi", "theta")
    ]
    return moved + [
        Row(f"{text}: {name}, largest", "{:.3f} urad", partial(largest_deviation, model, name), note=note)
        for name in ("phi", "theta", "psi")
        for text, model, note in (
            ("exact, place as read", "exact", "currents are those of a place 300 µs old, on average"),
            (AHEAD_EXACT, AHEAD_EXACT, "same loop, same margins: the prediction is the reference's"),
        )
    ]


BRAKING_NOTE = "its braking; the least for 10 mm is 28.3 ms, at ±1000 N all the way"
SWING_NOTE = (
    "±1000 N are too little for gains this fast: a linear law brakes too late and swings about its end"
)
APPROACH_NOTE = "y and z approach their ends at the fastest rate that brakes within ±1000 N, √(3 F / 2 m d)"
GAINS_NOTE = "Kp = 1.2 N/µm of the PID: gains, which the paper does not print, decide about its torques"


def _jump_rows() -> list[Row]:
    """Rows of the steps as the paper commands them: jumps that saturate."""
    last = partial(case_merit, "jump")
    found = [
        Row(f"jumps, {law}: {text}", shown, partial(last, f"table, {law}", label), note=note)
        for law, text, shown, label, note in (
            (DESIGN_END, "y within 10 µm after", "{:.1f} ms", "y within 10 um after its step", BRAKING_NOTE),
            (DESIGN_END, "y, overshoot", "{:.1f} um", "y, overshoot", ""),
            (LINEAR_END, "y off at 0.1 s", "{:.2f} mm", "y, left at the end", SWING_NOTE),
            (SOFT_END, "y off at 0.1 s", "{:.1f} um", "y, left at the end", APPROACH_NOTE),
            (SOFT_END, "y, overshoot", "{:.1f} um", "y, overshoot", ""),
            (SOFT_END, "z off at 0.1 s", "{:.1f} um", "z, left at the end", ""),
        )
    ]
    found.append(
        Row(
            f"jumps, {SOFT_END}: largest force",
            "{:.0f} N",
            partial(last, f"table, {SOFT_END}", "largest force"),
            "steps.force_limit",
            note="an input: commands are limited there, and reach it as the paper's do",
            by_construction=True,
        )
    )
    keys = {"analytical": "analytical", "table": "interpolation"}
    for model, why in (("analytical", RECTANGLES), ("table", MISSING_NOTE)):
        found += [
            row._replace(why=why) for row in _ranges(f"{model}, {SOFT_END}, {AT_ONCE_LABEL}", keys[model])
        ]
    found += [
        Row(
            f"jumps, {model}: of 16 extremes within the paper's",
            "{:.0f}",
            partial(extremes_within, model, "interpolation"),
            note=note,
        )
        for model, note in (
            (f"table, {SOFT_END}, {AT_ONCE_LABEL}", "currents are held for 200 µs"),
            (f"table, {SOFT_END}, {FASTER_CASE}", "currents are held for 40 µs, gains as before"),
            (f"table, {SOFT_END}", DELAY_NOTE),
        )
    ]
    for model, key in keys.items():
        found += [
            row._replace(relation="beside", note=DELAY_NOTE) for row in _ranges(f"{model}, {SOFT_END}", key)
        ]
    found += [
        Row(
            f"jumps, {model}, {SLOWER_CASE}: T_x, {side}",
            "{:.3f} N m",
            partial(extreme, f"{model}, {SOFT_END}, {SLOWER_CASE}", "T_x", "v", of),
            note=GAINS_NOTE,
        )
        for model in keys
        for side, of in (("lowest", np.min), ("highest", np.max))
    ]
    found.append(
        Row(
            f"jumps, {AT_ONCE_LABEL}: phi moved, analytical over table",
            "{:.1f}",
            jump_ratio,
            "implied.phi_ratio",
            "at least",
            note="its conclusion: the table is better; what it leaves is what held currents do",
        )
    )
    return found


DEVIATIONS = (("x", "um"), ("phi", "urad"), ("theta", "urad"), ("psi", "urad"))


def _ranges(model: str, key: str) -> list[Row]:
    """Rows of the lowest and the highest of each deviation and force whose range the paper prints: ours within it."""
    return [
        Row(
            f"jumps, {model}: {name}, {side}",
            f"{{:.3f}} {unit}",
            partial(extreme, model, name, series, of),
            f"steps.{key}.{side}.{name}",
            relation,
        )
        for series, signals in (("p", DEVIATIONS), ("v", (("F_x", "N"), *WRENCH[3:])))
        for name, unit in signals
        for side, relation, of in (("lowest", "at least", np.min), ("highest", "at most", np.max))
    ]


LOOP: tuple[Row, ...] = (
    Row("peak sensitivity, worst sensor", "{:.1f}", peak_sensitivity, note=ZONE_NOTE),
    Row(
        "share of the design's box that is proven",
        "proven percent",
        machine_share,
        note="anywhere in the travel",
    ),
    *(
        Row(
            f"three times as fast, filter {name} the delay: angles",
            "{:.2f} urad",
            partial(angles_at_rest, f"{name}, 3 x"),
            note="left at rest; it is the sample of computation",
        )
        for name in ("with", "without")
    ),
)


def rows() -> list[Row]:
    """All claims of the paper, in the order of the ledger."""
    model = [row._replace(of_machine=True) for row in (*COIL, *TABLE, *MOVER)]
    return [*model, *STEPS, *_step_rows(), *_jump_rows(), *LOOP]
