"""The claims of the paper on the planar motor."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.planar import field as planar_field
from malta.machines.planar import plant as planar
from malta.machines.planar.experiments import CURRENT
from malta.margins.verify import Margins
from malta.model.data import published_value
from malta.report.ledger import (
    Row,
    designed,
    machine_share,
    merit,
    peak_sensitivity,
)
from malta.simulation.experiments import Case, Experiment, Progress
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

SOURCE = "F. Xing et al., 2017"
FLOWN = ("step", "errors", "timing", "delay")


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of one design."""

    spec: Spec
    published: Mapping[str, Any]
    parameters: planar.Parameters
    controller: Controller
    margins: Margins
    flown: Mapping[str, Experiment]  # without "delay" for a PID, which predicts nothing


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> Evidence:
    """Design, prove and fly."""
    found = designed(spec, FLOWN[: 3 if spec.pid is not None else 4], progress)
    par: Any = spec.parameters
    return Evidence(spec, published, par, found.controller, found.margins, found.flown)


def rows() -> list[Row]:
    return [*_coil_rows(), *_table_rows(), *_mover_rows(), *_step_rows(), *_loop_rows()]


WRENCH = (("F_x", "N"), ("F_y", "N"), ("F_z", "N"), ("T_x", "N m"), ("T_y", "N m"), ("T_z", "N m"))


def _coil_rows() -> list[Row]:
    arm = (
        "the paper names neither the coil nor the pitch; its F_z and T_x imply an arm of 65 mm, ours is 47 mm"
    )
    both = "B_r and the corner radius, not printed, were chosen for it and 0.81 T"
    notes = {"F_x": both, "F_y": both, "T_x": "", "T_y": "", "T_z": ""}
    errors = {
        "N": "the paper's are amplitudes 7 to 9 % off, not missing harmonics",
        "N m": "of an inner coil; the rectangles of (23), (24) overlap: 3.8 times a rounded coil's own torque",
    }
    return [
        Row("field over a pole at 1 mm", "T", "{:.2f}", _pole_field, "field.B_z", "equal", both),
        *(
            Row(
                f"one coil at 3 A: {name}",
                unit,
                "{:.2f}",
                partial(merit, "errors", f"{name}, amplitude"),
                f"model.amplitude.{name}",
                "about",
                notes.get(name, "4 % less; see the ratio"),
                arm,
            )
            for name, unit in WRENCH
        ),
        Row(
            "F_z over F_x",
            "1",
            "{:.2f}",
            _force_ratio,
            "implied.force_ratio",
            "equal",
            "",
            "a field without curl gives 2 for the fundamental, this coil's 1.99 with all harmonics",
        ),
        Row(
            "T_z that (20)–(22) make of the printed F_x, F_z, T_x, T_y",
            "N m",
            "{:.2f}",
            _printed_torque,
            "model.amplitude.T_z",
            "equal",
            "",
            "the printed torques contradict each other",
        ),
        Row(
            "(17)–(21) against quadrature of their own field",
            "1",
            "{:.0e}",
            _formulas,
            note="largest relative difference, with -x_k F_z for the -y_k F_z that (21) prints",
        ),
        *(
            Row(
                f"analytical model, error of {name}",
                unit,
                "{:.3f}",
                partial(_error, "analytical", name),
                f"model.error_analytical.{name}",
                "at most",
                errors[unit],
            )
            for name, unit in WRENCH
        ),
    ]


def _table_rows() -> list[Row]:
    return [
        *(
            Row(
                f"table of τ_n/35, error of {name}",
                unit,
                "{:.3f}",
                partial(_error, "table", name),
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
            note="bilinear",
        ),
        *(
            Row(
                f"step of the table that errs by the printed {name}",
                "mm",
                "{:.2f}",
                partial(_implied_step, name),
                note="the paper prints none; its F_x and F_z imply different ones",
            )
            for name in ("F_x", "F_z")
        ),
        Row(
            "error of F_x with (27) as printed, τ_n/10",
            "N",
            "{:.1f}",
            _misprinted,
            note="two weights are in each other's place; 0.15 N with them mended",
        ),
    ]


def _mover_rows() -> list[Row]:
    pitch = "the paper prints no coil pitch"
    return [
        Row(
            "condition of K(p), at most",
            "1",
            "{:.2f}",
            partial(_condition, 16 / 3),
            note=f"16/3 τ_n; {pitch}",
        ),
        Row("the same with 14/3 τ_n", "1", "{:.2f}", partial(_condition, 14 / 3), note=pitch),
        Row(
            "the same with 4 τ_n",
            "1",
            "{:.0f}",
            partial(_condition, 4.0),
            note="all coils in phase: singular",
        ),
        Row(
            "K K⁺ W − W over W, at most", "1", "{:.0e}", _residual, note="over a period at the working height"
        ),
        Row(
            "K(p) and pseudo-inverse, table",
            "us",
            "{:.1f}",
            partial(merit, "timing", "table, compiled"),
            "table_2.interpolation",
            "at most",
            "compiled, on this computer; the paper's on an NI PXI-1042Q",
        ),
        Row(
            "K(p) and pseudo-inverse, analytical",
            "us",
            "{:.1f}",
            partial(merit, "timing", "analytical, compiled"),
            "table_2.analytical",
            "at most",
        ),
        Row(
            "K(p) and pseudo-inverse, exact field",
            "s",
            "{:.0e}",
            partial(merit, "timing", "exact, compiled"),
            "table_2.fem",
            "at most",
            "22 harmonics; the paper has FEM for it",
        ),
        Row(
            "control period",
            "us",
            "{:.0f}",
            lambda e: e.controller.sample_time,
            "real_time.mean",
            "equal",
            "taken",
        ),
    ]


def _step_rows() -> list[Row]:
    missing = "start, gains and pitch are missing; ours holds currents for 200 µs, a sample late, its Simulink does not"
    found = [
        Row(
            "y within 10 µm after its step of 10 mm",
            "ms",
            "{:.1f}",
            partial(_step, "y within 10 um after its step"),
            note="a quintic of 40 ms",
        ),
        Row("y, overshoot", "um", "{:.2f}", partial(_step, "y, overshoot"), note="asked for: 1 µm"),
        Row(
            "z, from 20 ms after its step of 1 mm",
            "um",
            "{:.2f}",
            partial(_step, "z, from 20 ms after its step"),
            note="asked for: 1.5 µm; from 50 µm over the magnets, as the paper's start on them is a touchdown",
        ),
        Row("largest force", "N", "{:.0f}", partial(_step, "largest force"), "steps.force_limit", "at most"),
        Row(
            "x, theta, psi from (0, 0)",
            "urad",
            "{:.0e}",
            _symmetric,
            note="zero by mirror symmetry, µm or µrad: the paper, where they move, started elsewhere",
        ),
    ]
    rectangles = f"{missing}; and the overlapping rectangles of (23), (24) make too much torque"
    for model, key, why in (("analytical", "analytical", rectangles), ("table", "interpolation", missing)):
        for name, unit in (("x", "um"), ("phi", "urad"), ("theta", "urad"), ("psi", "urad")):
            found += _range(model, key, name, unit, "p", why)
        found += [
            row
            for name, unit in (("F_x", "N"), ("T_x", "N m"), ("T_y", "N m"), ("T_z", "N m"))
            for row in _range(model, key, name, unit, "v", why)
        ]
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
            _better,
            "implied.phi_ratio",
            "at least",
            "its conclusion: the table is better",
        )
    )
    return found


def _range(model: str, key: str, name: str, unit: str, series: str, why: str) -> list[Row]:
    """The lowest and the highest of a deviation or of a force: ours within the paper's."""
    sides = (("lowest", "at least", np.min), ("highest", "at most", np.max))
    return [
        Row(
            f"{model}: {name}, {side}",
            unit,
            "{:.3f}",
            partial(_extreme, model, name, series, of),
            f"steps.{key}.{side}.{name}",
            relation,
            "",
            why,
        )
        for side, relation, of in sides
    ]


def _loop_rows() -> list[Row]:
    return [
        Row(
            "peak sensitivity, worst sensor",
            "1",
            "{:.1f}",
            peak_sensitivity,
            note="ISO 14839-3 zone A ends at 3",
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
                partial(_circling, f"{name}, 3 x"),
                note="left at rest; it is the sample of computation",
            )
            for name in ("with", "without")
        ),
    ]


def _pole_field(e: Evidence) -> float:
    par = e.parameters
    return float(planar_field.flux_density(planar_field.modes(par), np.array([par.tau_n, 0, par.h]))[2])


def _force_ratio(e: Evidence) -> float:
    return merit("errors", "F_z, amplitude", e) / merit("errors", "F_x, amplitude", e)


def _printed_torque(e: Evidence) -> float:
    """F_z and T_x, T_y fix the coil's arms, (22) makes T_z of them and F_x."""
    F_x, F_z, T_x, T_y = (
        published_value(e.published, f"model.amplitude.{k}") for k in ("F_x", "F_z", "T_x", "T_y")
    )
    return F_x * (T_x + T_y) / F_z


def _formulas(e: Evidence) -> float:
    par = replace(e.parameters, C=1.0)
    field = planar_field.fundamental(par, par.B_z * math.exp(math.pi / par.tau_n * par.h))
    coil = planar_field.winding(par, rectangles=True, nodes=40)
    p = np.array([6e-3, 4e-3, par.h])
    expected = planar_field.quadrature(par, field, coil, p)
    found = planar.Analytical(par)(*(np.array([v]) for v in p))[0]
    return float(
        max(np.abs((found - expected)[k]).max() / np.abs(expected[k]).max() for k in (slice(3), slice(3, 6)))
    )


def _error(model: str, name: str, e: Evidence) -> float:
    case = next(case for case in e.flown["errors"].cases if case.label == model)
    return _of(case, f"{name}, largest error")


def _of(case: Case, label: str) -> float:
    return next(m.value for m in case.merits if m.label == label)


def _implied_step(name: str, e: Evidence) -> float:
    """The error goes with the square of the step."""
    printed = published_value(e.published, f"model.error_interpolation.{name}")
    curves = e.flown["errors"].curves
    error = curves["by step"][:, ("F_x", "F_z").index(name)]
    return float(np.exp(np.interp(math.log(printed), np.log(error[::-1]), np.log(curves["step"][::-1]))))


def _misprinted(e: Evidence) -> float:
    par, truth = e.parameters, planar.truth(e.parameters)
    table = planar.table(par, truth, 10)
    printed = replace(table, cells=table.cells[:, [0, 2, 1, 3]])
    x, y = np.meshgrid(*[np.linspace(0, par.tau_n, 81)] * 2, indexing="ij")
    z = np.full_like(x, par.h)
    return CURRENT * float(np.abs(printed(x, y, z) - truth(x, y, z))[..., 0].max())


def _condition(ratio: float, e: Evidence) -> float:
    par = replace(e.parameters, coil_pitch=ratio * e.parameters.tau_n)
    return float(planar.conditioning(par, planar.simulated(par)).max())


def _residual(e: Evidence) -> float:
    par = e.parameters
    model, W, worst = planar.simulated(par), np.array([100.0, 200, 400, 10, 20, 30]), 0.0
    for x in np.arange(6) * par.tau_n / 3:
        for y in np.arange(6) * par.tau_n / 3:
            K = planar.wrench_matrix(par, model, np.array([x, y, par.h]))
            worst = max(worst, float(np.abs(K @ planar.currents(K, W) - W).max() / np.abs(W).max()))
    return worst


def _flight(model: str, e: Evidence) -> Trajectory:
    """From the place without symmetry."""
    return next(case.run for case in e.flown["step"].cases if case.label.startswith(model))


def _step(label: str, e: Evidence) -> float:
    return _of(e.flown["step"].cases[0], label)


def _symmetric(e: Evidence) -> float:
    run = e.flown["step"].cases[-1].run  # the analytical model, from (0, 0)
    return float(np.abs(run.p - run.reference)[:, [0, 4, 5]].max())


def _extreme(model: str, name: str, series: str, of: Callable[[FloatArray], Any], e: Evidence) -> float:
    run = _flight(model, e)
    if series == "v":
        return float(of(run.v[:, [s.name for s in run.plant.inputs].index(name)]))
    k = [s.name for s in run.plant.outputs].index(name)
    return float(of((run.p - run.reference)[:, k]))


def _better(e: Evidence) -> float:
    return merit("step", "analytical moves phi by", e) / merit("step", "table moves phi by", e)


def _circling(label: str, e: Evidence) -> float:
    if "delay" not in e.flown:
        return math.nan
    return _of(next(c for c in e.flown["delay"].cases if c.label == label), "angles, left at rest")
