"""Claims of the paper on MALTA: a row for each published figure."""

from __future__ import annotations

from functools import partial

from malta.machines.tubular.experiments.strokes import SETTLE
from malta.machines.tubular.paper.evidence import (
    FEW,
    FEWER,
    IMPLIED_RATIO,
    MACHINES,
    PUSH,
    axial_deviation,
    axis_coupling,
    carried_payload,
    carried_weight,
    current_loop_margin,
    full_state_share,
    is_solved_for_ratio,
    link_rise,
    load_deviation,
    measured_at_rest,
    noise_forces,
    pole,
    pole_change,
    precise_payload,
    published_stroke,
    slowest_radial,
    stiffness_ratio,
    stroke_across,
    true_radial,
    yield_share,
)
from malta.machines.tubular.paper.evidence import evidence as evidence
from malta.machines.tubular.paper.further_claims import BRAKE, CAPTURE, MEANS, RULE_OF_THUMB, TAUGHT
from malta.machines.tubular.paper.further_claims import ROWS as FIGURE_13
from malta.report.ledger import ZONE_NOTE, Row, bandwidth, machine_share, merit, peak_sensitivity

SOURCE = "S. Miric et al., IEEE Trans. Ind. Electron. 68(1), 2021"
REPRODUCING = ("table2", "calibrated")


PLAIN = "printed weights as plain SI are next to nothing beside (2 K_A)^2"
UNDEFINED = "the paper gives no definition"
NOISY = "covariance of the linear loop, from the sensors' noise and steps"
COGGING = "the axial loop yields to 0.5 N of cogging"
SLOW = (
    "weight and attraction that v0 does not know are the integrals' to carry, which take longer than the rest"
)

POLES_AND_LQR: tuple[Row, ...] = (
    Row(
        "poles of x, y",
        "rad/s",
        "±{:.2f}",
        partial(pole, "x"),
        "table_I.poles.x",
        "equal",
        "K_A solved from it; Table IV as printed gives 215.12",
        by_construction=True,
    ),
    Row(
        "poles of alpha, beta",
        "rad/s",
        "±{:.2f}",
        partial(pole, "alpha"),
        "table_I.poles.alpha",
        "equal",
        "l_B solved from it",
        by_construction=True,
    ),
    Row(
        "poles of z",
        "rad/s",
        "±{:.2f}",
        partial(pole, "z"),
        "table_I.poles.z",
        "equal",
        "a mass that nothing holds",
        by_construction=True,
    ),
    Row(
        "change of the poles over ±15 mm",
        "percent",
        "{:.1f}",
        pole_change,
        0.1,
        "at most",
        "“do not vary significantly”, read as 10 %",
    ),
    Row(
        "LQR: stiffness over attraction, K1/k",
        "1",
        "{:.2f}",
        stiffness_ratio,
        IMPLIED_RATIO,
        "about",
        "implied by 300 %, and what the bases of `calibrated` were solved for",
        PLAIN,
        of_lqg=True,
        by_construction=is_solved_for_ratio,
    ),
    Row(
        "LQR: share of the 20 % box",
        "percent",
        "{:.0f}",
        full_state_share,
        "position_controller.margin",
        "about",
        "proven for all of m, K_A, K_D, K_B at once; full state feedback; K1/k = 4 is 300 %",
        PLAIN,
        of_lqg=True,
        by_construction=is_solved_for_ratio,
    ),
    Row(
        "the same, sampled, with observer, delay and current loops",
        "percent",
        "{:.0f}",
        machine_share,
        note="proven anywhere in the travel, without loads; the paper's is of full state feedback",
    ),
)
LOOPS: tuple[Row, ...] = (
    Row(
        "bandwidth: last −3 dB of σ_max(T)",
        "rad/s",
        "{:.0f}",
        partial(bandwidth, "sigma_max_T"),
        "position_controller.bandwidth",
        "about",
        "",
        UNDEFINED,
    ),
    Row(
        "bandwidth: last 0 dB of σ_max(L)",
        "rad/s",
        "{:.0f}",
        partial(bandwidth, "crossover_max"),
        "position_controller.bandwidth",
        "about",
        "",
        UNDEFINED,
    ),
    Row(
        "bandwidth: regulator's fastest w_n",
        "rad/s",
        "{:.0f}",
        partial(bandwidth, "w_n_max"),
        "position_controller.bandwidth",
        "about",
        "",
        UNDEFINED,
    ),
    Row(
        "slowest radial pole with integrals",
        "rad/s",
        "{:.4f}",
        slowest_radial,
        note="its inverse is the time that integral action takes",
        of_lqg=True,
    ),
    Row(
        "1 N along z from outside moves it by",
        "mm",
        "{:.2f}",
        lambda e: axial_deviation(e).largest,
        note="at most, then the integral takes it back; linear sampled loop at z = 0, where the assumed cogging has "
        "209 N/m; the travel is ±15 mm",
    ),
    Row(
        "the same at the worst frequency, per newton",
        "mm/N",
        "{:.2f}",
        lambda e: axial_deviation(e).compliance,
        note="a sine from outside",
    ),
    Row("peak sensitivity, worst sensor", "1", "{:.1f}", peak_sensitivity, note=ZONE_NOTE),
    Row(
        "current loops: crossover",
        "rad/s",
        "{:.0f}",
        lambda e: current_loop_margin(e)[0],
        "current_controller.crossover",
        note="Kp and Ki solved from both",
        by_construction=True,
    ),
    Row(
        "current loops: phase margin",
        "deg",
        "{:.1f}",
        lambda e: current_loop_margin(e)[1],
        "current_controller.phase_margin",
        "about",
        "Kp and Ki solved from both, for the dead time that the design file names",
        by_construction=True,
    ),
    Row(
        "DC link: rise when 5 m/s are braked",
        "V",
        "{:.2f}",
        link_rise,
        "dc_link.rise",
        "equal",
        "the same formula with the printed m, C_dc and V_dc",
        by_construction=True,
    ),
)
STROKE: tuple[Row, ...] = (
    Row(
        "stroke: rise 10–90 %",
        "ms",
        "{:.2f}",
        lambda e: published_stroke(e).rise,
        "figure_12.rise_time",
        "about",
        "an input: the reference has it",
        by_construction=True,
    ),
    Row(
        "stroke: overshoot",
        "percent",
        "{:.2f}",
        lambda e: published_stroke(e).overshoot,
        "figure_12.overshoot",
        "at most",
    ),
    Row(
        "stroke: axial error",
        "mm",
        "{:.3f}",
        lambda e: published_stroke(e).axial_error,
        "figure_12.axial_error",
        "at most",
    ),
    Row(
        "stroke: radial deviation",
        "um",
        "{:.2f}",
        lambda e: max(published_stroke(e).radial.values()),
        "figure_13.radial_deviation",
        "at most",
    ),
    Row(
        "stroke: deviation of x1, x2",
        "um",
        "{:.2f}",
        stroke_across,
        0.0,
        "equal",
        "no force of the model pushes along x, nor in its simulation; measured: up to 20 µm",
        by_construction=True,
    ),
    Row(
        "stroke: f/i of a module",
        "N/A",
        "{:.2f}",
        partial(merit, "stroke", "drive constant per module, f / i"),
        "figure_12.drive_constant",
        note="K_D, an input",
        by_construction=True,
    ),
    Row(
        "stroke, cogging not compensated: rise",
        "ms",
        "{:.1f}",
        lambda e: e.uncompensated.rise,
        "figure_12.rise_time",
        "about",
        "the reference has it, and a loop that follows",
        COGGING,
        by_construction=True,
    ),
    Row(
        "stroke, cogging not compensated: error",
        "mm",
        "{:.2f}",
        lambda e: e.uncompensated.axial_error,
        "figure_12.axial_error",
        "at most",
        "",
        COGGING,
    ),
    Row(
        "weight carried at z = 5 mm",
        "N",
        "{:.2f}",
        carried_weight,
        "figure_13.weight",
        "equal",
        "",
        "m g of Table IV; and statics load module 2 more, not 1",
    ),
)
LEFT = "rms over 16 seeds; the sensors' noise is what this leaves beside steps and motion"
REST: tuple[Row, ...] = (
    *(
        Row(
            f"at rest: {name} measured, std",
            "um",
            "{:.2f}",
            partial(measured_at_rest, name),
            published=f"table_III.std.{name}",
            note=LEFT,
            why=LEFT,
            by_construction=True,
        )
        for name in ("x1", "y1", "x2", "y2", "z")
    ),
    Row(
        "at rest: radial motion, true rms",
        "um",
        "{:.3f}",
        true_radial,
        note="less than what is measured; rms over 16 seeds",
    ),
)
OTHER_EXPERIMENTS: tuple[Row, ...] = (
    Row(
        "tilt: SP2 deviates, law as printed",
        "um",
        "{:.1f}",
        lambda e: e.flights["tilt", 0],
        published="figure_16.deviation",
        relation="at most",
        why="the attraction at the reference is not fed forward",
    ),
    Row(
        "tilt: SP2, attraction fed forward",
        "um",
        "{:.2f}",
        lambda e: e.flights["tilt", 1],
        published="figure_16.deviation",
        relation="at most",
    ),
    Row(
        "thermal: growth of 0.5 m in 10 °C",
        "um",
        "{:.0f}",
        lambda e: e.growth,
        "thermal.drift",
        "equal",
        "length times strain, both printed",
        by_construction=True,
    ),
    Row(
        "thermal: left after compensation",
        "um",
        "{:.2f}",
        lambda e: e.flights["thermal", 0],
        note="mean of 5 seeds; run 30 times as fast",
    ),
    Row(
        "payload moved within the bounds of Figs 12 and 13",
        "kg",
        "{:.2f}",
        partial(precise_payload, False),
        note="overshoot, axial error and radial deviation; the controller does not learn of the mass",
    ),
    Row(
        "the same, its weight and inertia fed forward",
        "kg",
        "{:.2f}",
        partial(precise_payload, True),
        note="a known mass; gains as before",
    ),
    Row(
        "payload picked and moved without touchdown",
        "kg",
        "{:.2f}",
        carried_payload,
        "position_controller.payload",
        "at least",
        "the paper's “around 0.2 kg” follows from its margin, 3 times 20 % of 0.36 kg: stability, no bound of errors",
        "below the proven margin of the loop",
    ),
)
HERE = "at the operating point"
# Of an LQG and a PID, which the paper calls unsuitable, as the axes are several.
COMPARISON: tuple[Row, ...] = (
    Row(
        "a bearing's force at the other's sensor, beside the other's own",
        "percent",
        "{:.0f}",
        axis_coupling,
        note="the worst of the travel; what PIDs of single axes, “unsuitable” for this machine, do not know",
    ),
    Row("noise of bearing forces at rest, rms", "N", "{:.2f}", lambda e: noise_forces(e)[0], note=NOISY),
    Row("noise of the thrust at rest, rms", "N", "{:.2f}", lambda e: noise_forces(e)[1], note=NOISY),
    Row(
        "1 N at the centre of gravity moves a sensor by",
        "um",
        "{:.1f}",
        partial(load_deviation, "centre of gravity", None),
        note=HERE,
    ),
    Row(
        "1 N at a bearing moves a sensor by",
        "um",
        "{:.1f}",
        partial(load_deviation, "bearing", None),
        note=HERE,
    ),
    Row("of which is left after 0.1 s", "um", "{:.2f}", partial(load_deviation, "bearing", 0.1), note=HERE),
)
DRAWN = (
    f"m, K_A, K_D and K_B drawn at random, with noise, {SETTLE:g} s at rest first: {MACHINES} machines, "
    f"{FEW} without a C compiler"
)
ALSO = "the same machines"
AT_ONCE = f"v0 is that of the nominal machine, the integrals are empty: {round(FEWER * MACHINES)} machines"
YIELDS: tuple[Row, ...] = (
    Row(
        "machines ±20 %: stroke within the published bounds",
        "percent",
        "{:.1f}",
        partial(yield_share, "published", "strokes"),
        note=f"overshoot, axial error and radial deviation of Figs 12 and 13; {DRAWN}",
    ),
    Row(
        f"machines ±20 %: the same, {PUSH} times the inertia fed forward",
        "percent",
        "{:.1f}",
        partial(yield_share, "published", "pushed"),
        note=f"`inertia_feedforward = {PUSH}`: the loop and its margin stay; {round(FEWER * MACHINES)} machines",
    ),
    Row(
        "machines ±20 %: stroke within [specification]",
        "percent",
        "{:.1f}",
        partial(yield_share, "specified", "strokes"),
        note="the tracking error and radial deviation that the design file asks of 5 % of K_D, for designs that ask",
    ),
    Row(
        "machines ±20 %: stroke without touchdown",
        "percent",
        "{:.1f}",
        partial(yield_share, "completed", "strokes"),
        note=ALSO,
    ),
    Row(
        "machines ±20 %: radial deviation in the stroke, median",
        "um",
        "{:.2f}",
        lambda e: e.strokes.median,
        note=ALSO,
    ),
    Row(
        "machines ±20 %: radial deviation in the stroke, largest",
        "um",
        "{:.2f}",
        lambda e: e.strokes.largest,
        "figure_13.radial_deviation",
        "at most",
        ALSO,
        SLOW,
    ),
    Row(
        "machines ±20 %, no rest before: stroke within the published bounds",
        "percent",
        "{:.1f}",
        partial(yield_share, "published", "unsettled"),
        note=AT_ONCE,
    ),
    Row(
        "machines ±20 %, no rest before: radial deviation, median",
        "um",
        "{:.2f}",
        lambda e: e.unsettled.median,
        note=AT_ONCE,
    ),
    Row(
        "machines ±20 %, no rest before: radial deviation, largest",
        "um",
        "{:.2f}",
        lambda e: e.unsettled.largest,
        "figure_13.radial_deviation",
        "at most",
        AT_ONCE,
        SLOW,
    ),
)
ROWS = (
    *YIELDS,
    *TAUGHT,
    *POLES_AND_LQR,
    *LOOPS,
    *RULE_OF_THUMB,
    *BRAKE,
    *STROKE,
    *REST,
    *MEANS,
    *OTHER_EXPERIMENTS,
    *CAPTURE,
    *COMPARISON,
    *FIGURE_13,
)


def rows() -> list[Row]:
    """All claims of the paper, in the order of the ledger."""
    return list(ROWS)
