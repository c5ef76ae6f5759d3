"""The ledger: every number that the source paper publishes, ours for each design, and a verdict. Computed, not typed.

What the paper prints is read from data/published/, ours comes from the same functions that a user calls: model, gains,
margins, and the experiments on the simulated drive. A verdict follows from the numbers:

    reproduced          equal to the printed digits, within the printed bound, or within 5 % of an "about"
    within x %          of the published figure, x up to 20
    not reproduced      else, with the reason

It is said by design where the designs differ, and with the reading where the paper leaves a definition open.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from malta.chain import compensators
from malta.controller import Controller
from malta.data import in_unit, published_value
from malta.electric import link_voltage, open_loop_gain
from malta.errors import InputError
from malta.experiments import Experiment, experiment, late_stroke
from malta.linearize import LinearModel, linearize
from malta.riccati import add_integrals
from malta.robust import Margin, robust_margin
from malta.simulate import Scenario, StrokeFigures, simulate, stroke_figures
from malta.spec import Spec
from malta.synthesize import lqr, synthesize
from malta.uncertain import uncertain
from malta.verify import Margins, verify

if TYPE_CHECKING:
    from malta.plant import FloatArray

CLOSE, NEAR = 0.05, 0.2  # of the published figure: reproduced; within x %
ROUNDING = 1e-9
FLOWN = ("stroke", "hold", "tilt", "payload", "thermal")


class Claim(NamedTuple):
    """A line of the ledger."""

    subject: str
    published: str
    ours: tuple[str, ...]  # for each design
    verdict: str


@dataclass(frozen=True)
class Ledger:
    """All claims, for some designs."""

    designs: tuple[str, ...]
    claims: tuple[Claim, ...]

    def markdown(self) -> str:
        """The table as the README shows it."""
        header = ["claim", "published", *(f"`{name}`" for name in self.designs), "verdict"]
        rows = [[c.subject, c.published, *c.ours, c.verdict] for c in self.claims]
        lines = ["| " + " | ".join(row) + " |" for row in (header, *rows)]
        return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]]) + "\n"


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of one design."""

    spec: Spec
    model: LinearModel
    controller: Controller
    margins: Margins
    K: FloatArray  # of the LQR without integrals
    flown: Mapping[str, Experiment]
    uncompensated: StrokeFigures  # of the stroke with cogging left out of v0(z)
    braked: float  # m/s, published speed that fills the DC link
    growth: float  # m, of the published arm


class Row(NamedTuple):
    """A figure that the paper publishes, and how to find ours."""

    subject: str
    unit: str  # that both are shown in
    form: str
    value: Callable[[Evidence], float]  # SI
    published: str | float | None = (
        None  # key of data/published/, or a figure that its text implies; None: ours alone
    )
    relation: str = "about"  # "equal" to the printed digits, "at most", "at least", "about"
    note: str = ""  # where the paper leaves a definition open, or what explains the figures
    why: str = ""  # the reason for whatever is not reproduced


def ledger(specs: Sequence[Spec], published: Mapping[str, Any], progress: Any = None) -> Ledger:
    """Compute every claim for these designs.

    progress : told the share that is done

    Raises InputError for designs of another machine, or when the published figures lack one.
    """
    if not specs:
        raise InputError("claims", "designs", "none", "at least one design")
    for spec in specs:
        if spec.plant.name != "tubular":
            raise InputError(spec.path, "machine", spec.plant.name, "tubular: whose paper the claims are of")
    found = []
    for n, spec in enumerate(specs):
        found.append(_evidence(spec, published, _part(progress, n, len(specs))))
    claims = [_claim(row, found, published) for row in _rows()]
    return Ledger(tuple(e.spec.name for e in found), tuple(claims))


def _part(progress: Any, n: int, total: int) -> Any:
    return None if progress is None else lambda share: progress((n + share) / total)


def _evidence(spec: Spec, published: Mapping[str, Any], progress: Any) -> Evidence:
    plant = spec.plant
    model = linearize(plant, plant.at(**spec.operating_point))
    controller = synthesize(spec, model)
    flown = {}
    for n, name in enumerate(FLOWN):
        flown[name] = experiment(name, plant, controller, progress=_part(progress, n, len(FLOWN)))
    v0 = controller.feedforward.v0.copy()
    v0[:, plant.thrust_input] = 0
    without = replace(controller, feedforward=replace(controller.feedforward, v0=v0))
    slow = simulate(plant, without, Scenario("stroke", 0.4, partial(late_stroke, wait=0.0)))
    return Evidence(
        spec,
        model,
        controller,
        verify(model, controller, spec.uncertainty),
        lqr(model, spec.weights),
        flown,
        stroke_figures(slow),
        published_value(published, "dc_link.speed"),
        published_value(published, "thermal.length") * published_value(published, "thermal.strain"),
    )


def _rows() -> list[Row]:
    plain = "printed weights as plain SI are next to nothing beside (2 K_A)^2"
    undefined = "the paper gives no definition"
    rows = [
        Row(
            "poles of x, y",
            "rad/s",
            "±{:.2f}",
            partial(_pole, "x"),
            "table_I.poles.x",
            "equal",
            "K_A solved from it; Table IV as printed gives 215.12",
        ),
        Row(
            "poles of alpha, beta",
            "rad/s",
            "±{:.2f}",
            partial(_pole, "alpha"),
            "table_I.poles.alpha",
            "equal",
            "l_B solved from it",
        ),
        Row("poles of z", "rad/s", "±{:.2f}", partial(_pole, "z"), "table_I.poles.z", "equal"),
        Row(
            "change of the poles over ±15 mm",
            "percent",
            "{:.1f}",
            _pole_change,
            0.1,
            "at most",
            "“do not vary significantly”, read as 10 %",
        ),
        Row(
            "LQR: stiffness over attraction, K1/k",
            "1",
            "{:.2f}",
            _stiffness_ratio,
            4.0,
            "about",
            "implied by 300 %",
            plain,
        ),
        Row(
            "LQR: share of the 20 % box",
            "percent",
            "{:.0f}",
            _full_state_share,
            "position_controller.margin",
            "about",
            "proven for all of m, K_A, K_D, K_B at once; full state feedback",
            plain,
        ),
        Row(
            "the same, sampled, with observer, delay and current loops",
            "percent",
            "{:.0f}",
            _machine_share,
            note="proven anywhere in the travel; the paper's is of full state feedback",
        ),
        Row(
            "bandwidth: last −3 dB of σ_max(T)",
            "rad/s",
            "{:.0f}",
            partial(_bandwidth, "sigma_max_T"),
            "position_controller.bandwidth",
            "about",
            "",
            undefined,
        ),
        Row(
            "bandwidth: last 0 dB of σ_max(L)",
            "rad/s",
            "{:.0f}",
            partial(_bandwidth, "crossover_max"),
            "position_controller.bandwidth",
            "about",
            "",
            undefined,
        ),
        Row(
            "bandwidth: regulator's fastest w_n",
            "rad/s",
            "{:.0f}",
            partial(_bandwidth, "w_n_max"),
            "position_controller.bandwidth",
            "about",
            "",
            undefined,
        ),
        Row(
            "slowest radial pole with integrals",
            "rad/s",
            "{:.4f}",
            _slowest_radial,
            note="its inverse is the time that integral action takes",
        ),
        Row(
            "axial stiffness of the feedback",
            "N/m",
            "{:.3g}",
            _axial_stiffness,
            note="an assumed cogging of 0.5 N has 209 N/m",
        ),
        Row(
            "peak sensitivity, worst sensor",
            "1",
            "{:.1f}",
            lambda e: _peak(e)[0],
            note="ISO 14839-3 zone A ends at 3",
        ),
        Row(
            "current loops: crossover",
            "rad/s",
            "{:.0f}",
            lambda e: _current_loop(e)[0],
            "current_controller.crossover",
        ),
        Row(
            "current loops: phase margin",
            "deg",
            "{:.1f}",
            lambda e: _current_loop(e)[1],
            "current_controller.phase_margin",
            "about",
            "for the dead time that the design file names",
        ),
        Row("DC link: rise when 5 m/s are braked", "V", "{:.2f}", _link_rise, "dc_link.rise", "equal"),
        Row(
            "stroke: rise 10–90 %",
            "ms",
            "{:.2f}",
            lambda e: _stroke(e).rise,
            "figure_12.rise_time",
            "about",
            "an input: the reference has it",
        ),
        Row(
            "stroke: overshoot",
            "percent",
            "{:.2f}",
            lambda e: _stroke(e).overshoot,
            "figure_12.overshoot",
            "at most",
        ),
        Row(
            "stroke: axial error",
            "mm",
            "{:.3f}",
            lambda e: _stroke(e).axial_error,
            "figure_12.axial_error",
            "at most",
        ),
        Row(
            "stroke: radial deviation",
            "um",
            "{:.2f}",
            lambda e: max(_stroke(e).radial.values()),
            "figure_13.radial_deviation",
            "at most",
        ),
        Row(
            "stroke: deviation of x1, x2",
            "um",
            "{:.2f}",
            _stroke_across,
            0.0,
            "equal",
            "so in its simulation; measured: up to 20 µm",
        ),
        Row(
            "stroke: f/i of a module",
            "N/A",
            "{:.2f}",
            partial(_merit, "stroke", "drive constant per module, f / i"),
            "figure_12.drive_constant",
        ),
        Row(
            "stroke, cogging not compensated: rise",
            "ms",
            "{:.1f}",
            lambda e: e.uncompensated.rise,
            "figure_12.rise_time",
            "about",
            "",
            "the axial loop yields to 0.5 N of cogging",
        ),
        Row(
            "stroke, cogging not compensated: error",
            "mm",
            "{:.2f}",
            lambda e: e.uncompensated.axial_error,
            "figure_12.axial_error",
            "at most",
            "",
            "the axial loop yields to 0.5 N of cogging",
        ),
        Row(
            "weight carried at z = 5 mm",
            "N",
            "{:.2f}",
            _weight,
            "figure_13.weight",
            "equal",
            "",
            "m g of Table IV; and statics load module 2 more, not 1",
        ),
    ]
    rows += [
        Row(
            f"at rest: {name} measured, std",
            "um",
            "{:.2f}",
            partial(_merit, "hold", f"measured {name}, std"),
            f"table_III.std.{name}",
            "about",
            "noise of that size is put in",
            "noise of 0.5 µm is assumed and steps of 1 µm add 0.29 µm",
        )
        for name in ("x1", "y1", "x2", "y2", "z")
    ]
    rows += [
        Row(
            "at rest: radial motion, true rms",
            "um",
            "{:.2f}",
            _true_radial,
            note="less than what is measured",
        ),
        Row(
            "tilt: SP2 deviates, law as printed",
            "um",
            "{:.1f}",
            partial(_case, "tilt", 0),
            "figure_16.deviation",
            "at most",
            "",
            "the attraction at the reference is not fed forward",
        ),
        Row(
            "tilt: SP2, attraction fed forward",
            "um",
            "{:.2f}",
            partial(_case, "tilt", 1),
            "figure_16.deviation",
            "at most",
        ),
        Row(
            "thermal: growth of 0.5 m in 10 °C", "um", "{:.0f}", lambda e: e.growth, "thermal.drift", "equal"
        ),
        Row(
            "thermal: left after compensation",
            "um",
            "{:.2f}",
            partial(_case, "thermal", 0),
            note="run 30 times as fast",
        ),
        Row(
            "payload carried through a stroke",
            "kg",
            "{:.2f}",
            partial(_merit, "payload", "largest of these carried and moved"),
            "position_controller.payload",
            "at least",
            "without touchdown; no more is tried",
            "touches down with more",
        ),
    ]
    return rows


def _claim(row: Row, found: Sequence[Evidence], published: Mapping[str, Any]) -> Claim:
    values = [in_unit(row.value(e), row.unit) for e in found]
    ours = tuple("–" if math.isnan(value) else row.form.format(value) for value in values)
    unit = {"1": "", "percent": " [%]", "um": " [µm]", "deg": " [°]"}.get(row.unit, f" [{row.unit}]")
    subject = row.subject + unit
    if row.published is None:
        return Claim(subject, "–", ours, "ours" + (f": {row.note}" if row.note else ""))
    target = in_unit(
        published_value(published, row.published) if isinstance(row.published, str) else row.published,
        row.unit,
    )
    printed = row.form.format(target) if row.relation == "equal" else f"{target:.4g}"
    mark = {"at most": "≤ ", "at least": "≥ "}.get(row.relation, "")
    return Claim(subject, mark + printed, ours, _verdict(row, target, values, [e.spec.name for e in found]))


def _verdict(row: Row, target: float, values: Sequence[float], names: Sequence[str]) -> str:
    """What the figures of all designs say together."""
    words = [_word(row, target, value) for value in values]
    note = f"; {row.note}" if row.note else ""
    if len(set(words)) == 1:
        text = words[0] + note
    else:
        text = "; ".join(f"{name}: {word}" for name, word in zip(names, words, strict=True)) + note
    return text + (f"; {row.why}" if row.why and "not reproduced" in text else "")


def _word(row: Row, target: float, value: float) -> str:
    if math.isnan(value):
        return "not reproduced"
    if row.relation in ("at most", "at least"):
        within = value <= target if row.relation == "at most" else value >= target
        return "reproduced" if within else "not reproduced"
    if row.relation == "equal":
        if row.form.format(value) == row.form.format(target):
            return "reproduced"
        return "not reproduced"
    off = abs(value / target - 1)
    if off <= CLOSE + ROUNDING:
        return "reproduced"
    return f"within {math.ceil((off - ROUNDING) * 100)} %" if off <= NEAR + ROUNDING else "not reproduced"


def _pole(name: str, e: Evidence) -> float:
    names = [s.name for s in e.model.plant.design_states]
    return math.sqrt(max(float(e.model.stiffness.diagonal()[names.index(name)]), 0.0))


def _pole_change(e: Evidence) -> float:
    plant = e.model.plant
    middle, end = (linearize(plant, plant.at(z=z)).sys.poles().real.max() for z in (0.0, plant.travel))
    return float(end / middle - 1)


def _stiffness_ratio(e: Evidence) -> float:
    half = len(e.model.stiffness)
    return float((e.model.force_map @ e.K[:, :half])[0, 0] / e.model.stiffness[0, 0])


def _full_state_share(e: Evidence) -> float:
    law, states = compensators(e.model.plant, e.controller)["LQR"]
    system = uncertain(e.model.plant, list(e.spec.uncertainty), at=e.spec.operating_point, states=states)
    return _proven(robust_margin(system, law, e.spec.uncertainty))


def _machine_share(e: Evidence) -> float:
    return math.nan if e.margins.robust is None else _proven(e.margins.robust)


def _proven(margin: Margin) -> float:
    return math.nan if margin.lower is None else margin.lower


def _bandwidth(definition: str, e: Evidence) -> float:
    return e.margins.bandwidth[definition]


def _slowest_radial(e: Evidence) -> float:
    """Of the regulator with integrals: the slowest pole in which x1 takes part."""
    A, B = add_integrals(e.controller.Ad, e.controller.Bd, e.controller.Cd, e.controller.sample_time)
    values, shapes = np.linalg.eig(A - B @ np.hstack([e.controller.K, -e.controller.Ki]))
    part = np.abs(shapes[len(e.controller.Ad)]) > 1e-9 * np.abs(shapes).max(axis=0)
    return float((np.log(values[part]) / e.controller.sample_time).real.max())


def _axial_stiffness(e: Evidence) -> float:
    plant = e.model.plant
    return float(e.controller.K[plant.thrust_input, plant.stroke_state])


def _peak(e: Evidence) -> tuple[float, str]:
    peaks = {name: v for name, v in e.margins.peak_sensitivity.items() if name != "sigma_max"}
    worst = max(peaks, key=lambda name: peaks[name])
    return peaks[worst], worst


def _current_loop(e: Evidence) -> tuple[float, float]:
    """Crossover (rad/s) and phase margin (rad) of the loop that the gain file's Kp and Ki make."""
    loop, actuator = e.controller.current_loop, e.model.plant.actuator
    delay = actuator.dead_time if e.spec.current_loop_delay else 0.0

    def gain(w: float) -> complex:
        return complex(open_loop_gain(actuator, loop.Kp, loop.Ki, delay, np.array([w]))[0])

    crossover = float(brentq(lambda w: abs(gain(w)) - 1, 1.0, 1e5))
    return crossover, math.pi + float(np.angle(gain(crossover)))


def _link_rise(e: Evidence) -> float:
    par: Any = e.spec.parameters
    return float(link_voltage(par.V_dc, par.C_dc, par.m * e.braked**2 / 2) - par.V_dc)


def _stroke(e: Evidence) -> StrokeFigures:
    return stroke_figures(e.flown["stroke"].run)


def _stroke_across(e: Evidence) -> float:
    return max(_stroke(e).radial[name] for name in ("x1", "x2"))


def _weight(e: Evidence) -> float:
    v = e.flown["stroke"].run.v[-1]
    return float(v[1] + v[3])


def _merit(name: str, label: str, e: Evidence) -> float:
    return next(merit.value for merit in e.flown[name].merits if merit.label == label)


def _case(name: str, number: int, e: Evidence) -> float:
    return e.flown[name].cases[number].merits[0].value


def _true_radial(e: Evidence) -> float:
    return max(_merit("hold", f"true {name}, rms", e) for name in ("x1", "y1", "x2", "y2"))
