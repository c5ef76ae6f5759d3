"""Five PIDs hold MALTA: what the law of single axes is, lift-off, the search with estimates, claims beside an LQG."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence, refusal

import malta
from malta.loops.sampled_loops import machine_loop
from malta.loops.time_domain import recovery
from malta.margins.outcome import Outcome
from malta.simulation.experiments.catalogue import experiment
from malta.simulation.flown_strokes import stroke_figures
from malta.synthesis.law import law
from malta.synthesis.pid import axes_of, pid
from malta.synthesis.spec import Pid
from malta.tuning.judging import judge
from malta.tuning.outcomes import SynthesizedDesign
from malta.tuning.pid import CORNER_TOLERANCE, close_loop, estimates_of, name_of, outputs_of, parts_of
from malta.tuning.pid_loop import loads_of, loop_figures, whole_machine
from malta.tuning.search import model_and_controller
from malta_papers import ledger as claims
from malta_papers.ledger import Row
from malta_papers.tubular import claims as tubular
from malta_papers.tubular.quantities import (
    axial_deviation,
    axis_coupling,
    evidence as evidence_of,
    load_deviation,
    noise_forces,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from malta.model.linearize import LinearModel
    from malta.synthesis.spec import Spec
    from malta_papers.tubular.quantities import TubularEvidence

pytestmark = pytest.mark.usefixtures("proven_once")

FILE = ROOT / "design" / "tubular_pid.toml"
GAINS = ROOT / "design" / "gains" / "tubular_pid.json"

# What `malta tune` finds for the specification of tubular_pid with axes at the centre of gravity: x, y, z, alpha, beta.
CENTRED = Pid(
    Kp=np.array([4.0789e5, 4.0789e5, 2.7934e4, 3.7135e5, 3.7135e5]),
    Ki=np.array([3.6982e7, 3.6982e7, 1.0067e6, 8.8073e7, 8.8073e7]),
    Kd=np.array([889.71, 889.71, 151.13, 930.39, 930.39]),
    filter=np.array([0.19446e-3, 0.19446e-3, 1.3e-3, 0.18529e-3, 0.18529e-3]),
    axes="centre-of-gravity",
)


@pytest.fixture(scope="module")
def spec() -> Spec:
    return malta.read_design(FILE)


@pytest.fixture(scope="module")
def design(spec: Spec) -> SynthesizedDesign:
    return SynthesizedDesign(spec, *model_and_controller(spec))


@pytest.fixture(scope="module")
def found(spec: Spec, published: dict[str, Any]) -> Iterator[TubularEvidence]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("malta_papers.tubular.quantities.MACHINES", 16)
        patch.setattr("malta_papers.tubular.quantities.LEARNERS", 2)
        yield evidence_of(spec, published)


def terms_of(spec: Spec) -> Pid:
    assert spec.pid is not None
    return spec.pid


def centred(spec: Spec) -> SynthesizedDesign:
    other = replace(spec, law=CENTRED)
    return SynthesizedDesign(other, *model_and_controller(other))


# --- the law ---


def test_the_gain_file_says_that_each_axis_is_alone(spec: Spec) -> None:
    """K P^-1 and Ki are diagonal, to the last bit: a sensor moves the actuator beside it and no other."""
    c, terms = malta.gains.read(GAINS), terms_of(spec)
    assert terms.axes == "decentralized"
    P = c.C[:, :5]
    for half, gains in ((c.K[:, :5], terms.Kp), (c.K[:, 5:], terms.Kd)):
        np.testing.assert_allclose(half, gains[:, None] * P, rtol=1e-12, atol=0)
    np.testing.assert_allclose(c.Ki, np.diag(terms.Ki), rtol=1e-12, atol=0)
    assert c.spec_sha256 == spec.sha256
    other = centred(spec).controller
    assert np.abs(other.Ki - np.diag(np.diag(other.Ki))).max() > 0.01 * other.Ki.max()


@pytest.mark.parametrize("axes", ["decentralized", "centre-of-gravity"])
def test_the_law_is_five_scalar_pids(model: LinearModel, axes: Any) -> None:
    """Another filter on every axis; fifty samples of chance beside the textbook's recursion."""
    Ts, rng = 5e-5, np.random.default_rng(1)
    per_force = axes == "decentralized"
    size = np.ones(5) if per_force else 1 / 0.36
    terms = Pid(
        size * np.array([6e4, 5e4, 1e4, 7e4, 3e4]),
        size * np.array([6e6, 5e6, 1e6, 7e6, 3e6]),
        size * np.array([90.0, 80.0, 60.0, 50.0, 40.0]),
        np.array([1e-4, 0.0, 2e-3, 3e-4, 1e-3]),
        axes,
    )
    c = pid(model, terms, Ts)
    step, kinds = law(c), axes_of(model, axes)
    xi, e, frozen = np.zeros(10), np.zeros(5), np.zeros(5)
    d, total, last = np.zeros(5), np.zeros(5), np.zeros(5)
    a = np.array([math.exp(-Ts / f) if f else 0.0 for f in terms.filters])
    for _ in range(50):
        y, p_ref = 1e-7 * rng.standard_normal((2, 5))
        q_ref = np.concatenate([np.linalg.solve(model.C[:, :5], p_ref), np.zeros(5)])
        out = step(xi, e, frozen, y, p_ref, q_ref, np.zeros(5), np.zeros(5))
        xi, e, frozen, v = (np.array(value).ravel() for value in out[:4])
        s, s_ref = kinds.of_outputs @ y, kinds.of_outputs @ p_ref
        d = a * d + (1 - a) * (s - last) / Ts
        last, total = s, total + Ts * (s_ref - s)
        wanted = kinds.inputs @ (terms.Kp * (s_ref - s) + terms.Ki * total - terms.Kd * d)
        assert not frozen.any()
        np.testing.assert_allclose(v, wanted, rtol=1e-9, atol=1e-9)


def test_centred_axes_move_one_coordinate_each(model: LinearModel) -> None:
    terms = Pid(np.full(5, 2e5), np.full(5, 1e7), np.full(5, 800.0), 1e-4, "centre-of-gravity")
    c = pid(model, terms, 5e-5)
    np.testing.assert_allclose(model.force_map @ c.K[:, :5], 2e5 * np.eye(5), rtol=0, atol=1e-9)
    np.testing.assert_allclose(model.force_map @ c.Ki @ model.C[:, :5], 1e7 * np.eye(5), rtol=0, atol=1e-6)


def test_a_sensor_plane_is_near_the_other_bearings_centre_of_percussion(model: LinearModel, par: Any) -> None:
    """Why positions are not scaled to the bearing planes: a force there would move the other by a third of its own."""
    own = 1 / par.m + par.l_S * par.l_B / par.I_xx
    other = 1 / par.m - par.l_S * par.l_B / par.I_xx
    moved = model.C[:, :5] @ model.force_map
    assert moved[0, 0] == pytest.approx(own, rel=1e-12)
    assert moved[0, 2] == pytest.approx(other, rel=1e-9)
    assert abs(other / own) == pytest.approx(1 / 23.5, rel=0.01)
    at_bearing = (1 / par.m - par.l_B**2 / par.I_xx) / (1 / par.m + par.l_B**2 / par.I_xx)
    assert at_bearing == pytest.approx(0.32, abs=0.005)


def test_what_a_filtered_rate_lags_is_taken_off_the_feedforward(design: SynthesizedDesign) -> None:
    """Kd times the filter's lag is a fifth of the mover's mass, which more than doubles the error of the stroke."""
    c, terms = design.controller, terms_of(design.spec)
    a = np.exp(-c.sample_time / terms.filters)
    lagging = terms.Kd * c.sample_time * a / (1 - a)
    assert lagging[4] == pytest.approx(0.19 * 0.36, rel=0.02)
    inertia = np.array(design.plant.inertia)
    np.testing.assert_allclose(c.feedforward.inertia, inertia - lagging, rtol=1e-12)
    errors = []
    for one in (c, replace(c, feedforward=replace(c.feedforward, inertia=inertia))):
        run = malta.simulate(design.plant, one, malta.Scenario.stroke())
        errors.append(stroke_figures(run).axial_error)
    assert errors[0] == pytest.approx(0.211e-3, rel=0.02)
    assert errors[1] > 2 * errors[0]


# --- lift-off ---


def test_a_pid_lifts_the_mover_without_a_kalman_filter(design: SynthesizedDesign) -> None:
    flown = experiment("lift-off", design.plant, design.controller)
    (case,) = flown.cases
    assert case.label == "steady-state"
    assert not flown.failed
    assert case.run.p[0, 1] < -0.6e-3
    assert np.abs(case.run.p[-1, :4]).max() < 2e-6
    assert np.abs(case.run.p[case.run.t > 0.05][:, :4]).max() < 5e-6
    with pytest.raises(malta.InputError) as caught:
        experiment("lift-off", design.plant, design.controller, estimator="kalman")
    assert (caught.value.field, caught.value.found) == ("estimator kalman", "a PID")


def test_the_command_lifts_off_with_a_pids_gain_file(run: Run) -> None:
    code, text, err = run("simulate", GAINS, "--scenario", "lift-off")
    assert (code, "steady-state" in text) == (0, True)
    assert "kalman" not in text + err
    code, _, err = run("simulate", GAINS, "--scenario", "lift-off", "--option", "estimator=extended")
    assert code == 2
    assert "estimator extended: found a PID" in one_sentence(err)


# --- the search ---


def test_parts_of_either_kind_have_the_figures_of_the_whole_machine(spec: Spec) -> None:
    for one in (spec, replace(spec, law=CENTRED)):
        model, controller = model_and_controller(one)
        whole, axes = whole_machine(model, controller, loads_of(one)), axes_of(model, one.axes)
        parts = parts_of(whole)
        # Weight joins the stroke to the tilt: the mover slides to the bearing that then carries more.
        assert [part.outputs for part in parts] == [(0, 2), (1, 3, 4)]
        quick: dict[str, float] = {}
        for part in parts:
            quick |= loop_figures(one, part, close_loop(part, terms_of(one), one.sample_time, axes))
        known = loop_figures(one, whole, machine_loop(model, controller))
        assert quick.keys() == known.keys()
        for key, value in known.items():
            assert quick[key] == pytest.approx(value, rel=1e-6), key


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["decentralized", pytest.param("centre-of-gravity", marks=pytest.mark.slow)])
def test_estimates_are_what_is_measured(spec: Spec, axes: str) -> None:
    """Margin, noise, recovery: the groups of the search beside the proof, the covariance and the machine's own loop."""
    one = spec if axes == "decentralized" else replace(spec, law=CENTRED)
    design = SynthesizedDesign(one, *model_and_controller(one))
    estimates = estimates_of(one, [{0, 1, 2, 3}, {4}])
    assert [group.outputs for group in estimates.groups] == [
        (0, 2),
        (1, 3),
        (4,),
    ]  # x and y: sensors of other noise
    found = estimates.figures(terms_of(one), range(5))
    assert [{tuple(outputs_of(name)) for name in group} for group in found[:2]] == [
        {("x1", "x2")},
        {("y1", "y2")},
    ]
    figures: dict[str, float] = {}
    for group in found:
        for name, value in group.items():
            figures[name_of(name)] = max(value, figures.get(name_of(name), value))
    margin = min(value for group in found for name, value in group.items() if name_of(name) == "margin")
    del figures["margin"]
    proven = design.margins.robust
    assert proven is not None
    # The search looks at the corners of the machine without its loads, of which the slope of the cogging takes 1.5 %.
    assert margin / (1 - CORNER_TOLERANCE) == pytest.approx(proven.lower, rel=2e-2)
    noise = design.noise
    assert figures["force_noise"] == pytest.approx(noise.force[:4].max(), rel=1e-6)
    assert figures["thrust_noise"] == pytest.approx(noise.force[4], rel=1e-6)
    assert figures["radial_motion"] == pytest.approx(noise.motion[:4].max(), rel=1e-4)
    assert not {"peak_sensitivity", "bandwidth"} & figures.keys()
    for name in ("F_x largest", "bearing_x left 0.1 s", "F_z largest"):
        measured = design.deviation(one.recovery[name]).value
        assert figures[f"recovery {name}"] == pytest.approx(measured, rel=1e-4, abs=1e-12), name


def test_what_needs_no_estimate_is_not_estimated(spec: Spec) -> None:
    plain = replace(spec, specification={"peak_sensitivity": 2.0}, recovery={})
    assert estimates_of(plain, [{0, 1, 2, 3}, {4}]).groups == ()


@pytest.mark.slow
def test_the_shipped_gains_are_those_that_the_search_ends_with(spec: Spec) -> None:
    """All that is asked for holds; what binds binds."""
    rows: dict[str, Outcome] = {}
    for row in judge(spec):
        rows[row.name] = max(row, rows.get(row.name, row), key=lambda r: r.ratio)
        assert row.asked is None or row.holds, row
    assert rows["margin"].found == pytest.approx(2.9600, abs=1e-3)
    assert 0.9 < rows["peak_sensitivity"].ratio < 1
    assert rows["force_noise"].ratio > 0.96
    assert rows["lift_off"].how == "steady-state estimator, 4 seeds"


# --- the design file ---

FILTERS = "[pid.filters]"


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        (FILTERS, '[pid.filter]\nvalue = 1\nunit = "ms"\n' + FILTERS, "pid.filter"),
        (FILTERS, "[pid.times]", "pid.times"),
        ('axes = "decentralized"', 'axes = "centre-of-gravity"', "pid.Kp.fx_B1"),
        ('axes = "decentralized"', 'axes = "polar"', "pid.axes"),
        ('"pid.filters.f_D"', '"pid.filters.z"', "search.numbers.axial_filter.vary"),
        ('"pid.filters.f_D"', '"pid.filter"', "search.numbers.axial_filter.vary"),
        ("thrust_noise = {", "noise_of_thrust = {", "specification.noise_of_thrust"),
    ],
)
def test_a_wrong_file_gets_one_sentence(tmp_path: Path, old: str, new: str, field: str) -> None:
    text = FILE.read_text(encoding="utf-8").replace("../data", (ROOT / "data").as_posix())
    assert text.count(old) == 1
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    assert refusal(lambda: malta.read_design(path), path).field == field


def test_a_pid_without_any_filter_is_refused(tmp_path: Path) -> None:
    text = FILE.read_text(encoding="utf-8").replace("../data", (ROOT / "data").as_posix())
    first, last = text.index(FILTERS), text.index("[cost]")
    path = tmp_path / "wrong.toml"
    path.write_text(text[:first] + text[last:], encoding="utf-8")
    error = refusal(lambda: malta.read_design(path), path)
    assert (error.field, error.found) == ("pid.filter", "nothing")


def test_terms_are_one_of_each_axis() -> None:
    one = np.ones(5)
    assert Pid(one, one, one, 1e-4).filters.tolist() == [1e-4] * 5
    for wrong in (-1e-4, math.nan, np.zeros(4), np.array([0, 0, 0, 0, -1.0])):
        with pytest.raises(malta.InputError) as caught:
            Pid(one, one, one, wrong)
        assert caught.value.field == "filter"


def test_a_number_of_the_search_is_written_to_its_own_axis(spec: Spec) -> None:
    (k,) = [k for k, v in enumerate(spec.search) if v.name == "axial_filter"]
    values = [spec.value_of(v) for v in spec.search]
    assert values[k] == pytest.approx(1.3)
    values[k] = 0.9
    filters = terms_of(spec.vary(values)).filters
    assert filters[4] == pytest.approx(0.9e-3)
    np.testing.assert_allclose(filters[:4], terms_of(spec).filters[:4], rtol=1e-12)
    assert spec.vary(values).axes == "decentralized"


# --- claims ---


@pytest.mark.slow
def test_a_pid_has_no_verdict_on_figures_of_an_lqg(found: TubularEvidence, published: dict[str, Any]) -> None:
    lines = {row.subject: claims.claim_of(row, [found], published, ["tubular_pid"]) for row in tubular.rows()}
    only = {subject for subject, line in lines.items() if line.verdict == "of an LQG only"}
    assert only == {"LQR: stiffness over attraction, K1/k", "LQR: share of the 20 % box"}
    dashes = {subject for subject, line in lines.items() if line.ours == ("–",)}
    assert dashes == only | {"slowest radial pole with integrals"}
    assert not any("nan" in line.ours[0] for line in lines.values())
    row = Row("a gain", "{:.1f}", lambda e: e.K[0, 0], 4.0, of_lqg=True)
    lqg = replace(found, spec=malta.read_design(ROOT / "design" / "table2.toml"), K=np.array([[4.0]]))
    line = claims.claim_of(row, [lqg, found], published, ["table2"])
    assert (line.ours, line.verdict, line.word) == (("4.0", "–"), "reproduced", "reproduced")


def test_what_the_paper_calls_unsuitable_holds_what_it_claims(found: TubularEvidence) -> None:
    """296 % of the box under its loads, with the sampled loop and single axes."""
    assert claims.machine_share(found) == pytest.approx(2.9600, abs=1e-3)
    assert claims.peak_sensitivity(found) == pytest.approx(2.0, abs=1e-3)
    plant = found.model.plant
    end = malta.verify(malta.linearize(plant, plant.at(z=plant.stroke.travel)), found.controller)
    assert max(end.peak_sensitivity[s.name] for s in plant.outputs) == pytest.approx(2.242, abs=0.002)
    assert axis_coupling(found) == pytest.approx(0.139, abs=0.001)
    assert noise_forces(found) == pytest.approx((0.5000, 0.8000), rel=1e-3)
    assert load_deviation("centre of gravity", None, found) == pytest.approx(6.418e-6, rel=1e-3)
    assert load_deviation("bearing", None, found) == pytest.approx(12.503e-6, rel=1e-3)
    assert load_deviation("bearing", 0.1, found) < 1e-9
    along = {axis: {f"F_{axis}": 1.0} for axis in "xy"}
    apart = [max(d.largest for d in one.outputs) for one in recovery(plant, found.controller, along)]
    assert load_deviation("centre of gravity", None, found) == pytest.approx(max(apart), rel=1e-12)
    assert axial_deviation(found).largest == pytest.approx(93.58e-6, rel=1e-3)
