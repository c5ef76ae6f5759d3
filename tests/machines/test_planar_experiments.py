"""The planar motor as a user meets it: designs, experiments, figures, claims, command line, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from conftest import Run
from scipy.integrate import solve_ivp

import malta
from malta.machines.planar import commutation, field, motions, motions as jumps, plant as planar
from malta.margins.loop_report import LoopReport
from malta.model.printed import published_value, read_published
from malta.report.figures import experiment_figure
from malta.report.ledger import ledger
from malta.simulation.experiments import Experiment
from malta.simulation.experiments.catalogue import cases_of, experiments_of
from malta.synthesis.law import law
from malta.synthesis.linear_law import linear_law
from malta.synthesis.synthesize import braking_errors
from malta_papers.planar import claims, experiments

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

pytestmark = pytest.mark.usefixtures("proven_once")

NAMES = ("step", "jump", "errors", "delay", "timing")

GAINS = "design/gains/planar.json"
SLOW: dict[str, Any] = {"engine": "virtual machine"}  # half a second a run, and nothing to compile


class Design(NamedTuple):
    """A design file, read, and its controller."""

    spec: Spec
    plant: Plant
    controller: Controller
    margins: LoopReport


def made(name: str) -> Design:
    spec = malta.read_design(f"design/{name}.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    controller = malta.synthesize(spec, model)
    return Design(spec, spec.plant, controller, malta.verify(model, controller))


@pytest.fixture(scope="module")
def lqg() -> Design:
    return made("planar")


@pytest.fixture(scope="module")
def pid() -> Design:
    return made("planar_pid")


@pytest.fixture(scope="module")
def paper() -> dict[str, Any]:
    return read_published("data/planar.toml")


@pytest.fixture(scope="module")
def flown(lqg: Design) -> dict[str, Experiment]:
    """Every experiment, once."""
    return {name: malta.experiment(name, lqg.plant, lqg.controller, **SLOW) for name in NAMES}


def merits(e: Experiment, label: str = "") -> dict[str, float]:
    """Those of the experiment, or of the case whose label begins so."""
    found = e.merits if not label else next(case.merits for case in e.cases if case.label.startswith(label))
    return {merit.label: merit.value for merit in found}


# --- Designs ---


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar", "planar_pid"])
def test_gain_files_are_of_the_design_files(name: str, request: pytest.FixtureRequest) -> None:
    design: Design = request.getfixturevalue("lqg" if name == "planar" else "pid")
    kept = malta.gains.read(f"design/gains/{name}.json")
    assert kept.spec_sha256 == design.spec.sha256
    for gain in ("K", "Ki", "L"):
        np.testing.assert_allclose(
            getattr(kept, gain), getattr(design.controller, gain), rtol=1e-6, atol=1e-9
        )


def test_the_lqg_observes_disturbances_and_predicts_a_sample(lqg: Design) -> None:
    """1350 rad/s in every axis, zone A: 2.64; 24 states: the mover's, forces under way and of disturbance."""
    c = lqg.controller
    assert (len(c.states), c.delay, c.observed, c.integrating) == (24, 1, 1, False)
    assert lqg.margins.stable
    assert lqg.margins.peak_sensitivity["sigma_max"] == pytest.approx(2.64, abs=0.01)
    assert lqg.margins.bandwidth["w_n_max"] == pytest.approx(1350, abs=1)


def test_the_pid_is_one_of_a_double_integrator(pid: Design) -> None:
    """Every axis the same, times its inertia, though searched by itself; crossover at 1146 rad/s, peak 1.8."""
    assert pid.spec.pid is not None
    for name, size in {"Kp": 5.75e5, "Ki": 3.53e8, "Kd": 1210.0}.items():
        np.testing.assert_allclose(getattr(pid.spec.pid, name) / pid.plant.inertia, size, rtol=5e-3)
    assert max(pid.margins.peak_sensitivity[s.name] for s in pid.plant.outputs) == pytest.approx(
        1.8, abs=1e-4
    )
    assert pid.margins.bandwidth["crossover_max"] == pytest.approx(1146, abs=1)


# --- The steps ---


@pytest.mark.parametrize("model", motions.MODELS)
@pytest.mark.parametrize("place", ["(6, 4)", "(0, 0)"])
def test_the_steps_meet_the_table(flown: dict[str, Experiment], model: str, place: str) -> None:
    """y within 10 um in 60 ms, overshoot below 1 um, z within 1.5 um 20 ms after its step, forces within 1000 N."""
    found = merits(flown["step"], f"{model}, from {place}")
    assert found["y within 10 um after its step"] < 60e-3
    assert found["y, overshoot"] < 1e-6
    assert found["z, from 20 ms after its step"] < 1.5e-6
    assert found["largest force"] < 1000
    assert found["largest coil current"] < 30
    assert flown["step"].run.limits == ()


def test_a_symmetric_start_stays_symmetric(flown: dict[str, Experiment]) -> None:
    """From (0, 0) no model moves x, theta and psi by 1e-9 um or urad: the paper, where they move, started elsewhere."""
    for model in motions.MODELS:
        found = merits(flown["step"], f"{model}, from (0, 0)")
        assert max(found[f"{name}, deviation"] for name in ("x", "theta", "psi")) < 1e-15


def test_what_a_coil_model_moves(flown: dict[str, Experiment]) -> None:
    """Off the path with the exact one: table phi 0.010, theta 0.025 urad; (17)-(24) phi 3.8 urad by their torque."""
    found = merits(flown["step"])
    assert found["table moves phi by"] == pytest.approx(0.010e-6, abs=0.001e-6)
    assert found["table moves theta by"] == pytest.approx(0.0253e-6, abs=0.001e-6)
    assert found["analytical moves phi by"] == pytest.approx(3.79e-6, abs=0.05e-6)


@pytest.mark.slow
def test_currents_that_act_late_tilt_the_mover(lqg: Design, flown: dict[str, Experiment]) -> None:
    """phi by 0.8 urad with the exact model, a sample late and held; 0.3 urad when the computation takes no time."""
    assert merits(flown["step"], "exact, from (6, 4)")["phi, deviation"] == pytest.approx(
        0.81e-6, abs=0.01e-6
    )
    first = cases_of("step", lqg.plant, lqg.controller, delay=0)[0]
    run = malta.simulate(lqg.plant, lqg.controller, first.scenario, **SLOW)
    assert np.abs(run.p[:, 3]).max() == pytest.approx(0.296e-6, abs=0.01e-6)


@pytest.mark.slow
def test_the_pid_is_slower_to_arrive(pid: Design) -> None:
    """Its feedforward acts a sample late and nothing predicts: 4.9 um beyond, 3.4 um in z, 0.9 urad."""
    first = cases_of("step", pid.plant, pid.controller)[0]
    found = {
        m.label: m.value
        for m in first.merits(malta.simulate(pid.plant, pid.controller, first.scenario, **SLOW))
    }
    assert found["y within 10 um after its step"] < 60e-3
    assert found["y, overshoot"] == pytest.approx(4.89e-6, abs=0.1e-6)
    assert found["z, from 20 ms after its step"] == pytest.approx(3.42e-6, abs=0.1e-6)
    assert found["phi, deviation"] == pytest.approx(0.876e-6, abs=0.02e-6)


def test_sensor_noise(lqg: Design) -> None:
    """20 nm and 0.1 urad of noise make 15 nm and 1.7 N rms of it: the steps are met as before."""
    first = cases_of("step", lqg.plant, lqg.controller, noise=1.0)[0]
    run = malta.simulate(lqg.plant, lqg.controller, first.scenario, **SLOW)
    found = {m.label: m.value for m in first.merits(run)}
    assert found["y within 10 um after its step"] < 60e-3
    assert found["y, overshoot"] < 1e-6
    assert found["z, from 20 ms after its step"] < 1.5e-6
    still = (run.p - run.reference)[run.t > 0.09]
    assert still[:, 0].std() == pytest.approx(15e-9, rel=0.5)


@pytest.mark.slow
def test_the_run_by_another_integrator(lqg: Design, flown: dict[str, Experiment]) -> None:
    """scipy, numpy's decoupling and the mover in heights above the magnets: the same 20 samples to 1e-12 m.

    The currents of a sample are those for the reading before, limited together, and they are held.
    """
    run, par = flown["step"].run, motions.parameters_of(lqg.plant)
    model = field.simulation_model(par)
    f = planar.dynamics(par, model)
    shift = np.array([0, 0, par.h, *np.zeros(9)])

    def rate(_: float, x: FloatArray, i: FloatArray) -> FloatArray:
        return np.array(f(x, i, np.zeros(6))).ravel()

    first = int(0.045 / par.T_s)  # the middle of the move in y
    x = run.x[first] + shift
    for k in range(first, first + 20):
        read = (run.x[k - 1] + shift)[:3]
        i = commutation.limit_currents(
            par, commutation.currents(commutation.wrench_matrix(par, model, read), run.v[k - 1])
        )
        np.testing.assert_allclose(run.current[k - 1], i, rtol=0, atol=1e-9)
        x = solve_ivp(rate, (0, par.T_s), x, args=(i,), rtol=1e-10, atol=1e-14).y[:, -1]
        np.testing.assert_allclose(run.p[k + 1], (x - shift)[:6], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_one_runge_kutta_step_a_sample_is_enough(lqg: Design) -> None:
    first = cases_of("step", lqg.plant, lqg.controller)[0]
    coarse, fine = (
        malta.simulate(lqg.plant, lqg.controller, replace(first.scenario, duration=0.05, substeps=n), **SLOW)
        for n in (1, 4)
    )
    assert first.scenario.substeps == 1
    assert np.abs(coarse.p - fine.p).max() < 1e-10


def test_the_believed_model_is_a_parameter(lqg: Design) -> None:
    """`with_coil_model` changes what the controller commutates by, and no gain; the machine stays the same."""
    table = motions.with_coil_model(lqg.controller, "table", 20)
    assert (motions.parameters_of(table).order, motions.parameters_of(table).cells) == (16, 20)
    assert table.K is lqg.controller.K
    assert motions.with_coil_model(table, "exact").parameters == lqg.controller.parameters


# --- The steps as jumps ---


@pytest.mark.slow
def test_a_law_that_brakes_arrives_and_one_that_does_not_swings(
    flown: dict[str, Experiment], pid: Design
) -> None:
    """A jump of 10 mm at 1000 N, 28.3 ms at least: 30 and 34 ms. Without braking 6.4 and 5.8 mm off at 0.1 s."""
    by_pid = malta.experiment("jump", pid.plant, pid.controller, **SLOW)
    for e, arrives, beyond, swings, soft in (
        (flown["jump"], 30.0e-3, 17e-6, 6.37e-3, 9e-6),
        (by_pid, 33.6e-3, 21e-6, 5.78e-3, 31e-6),
    ):
        found = merits(e, "table, as designed")
        assert found["y within 10 um after its step"] == pytest.approx(arrives, abs=0.5e-3)
        assert found["y, overshoot"] == pytest.approx(beyond, rel=0.1)
        assert found["y, left at the end"] < 0.01e-6
        assert merits(e, "table, without")["y, left at the end"] == pytest.approx(swings, rel=0.02)
        for model in motions.MODELS:
            found = merits(e, f"{model}, soft")
            assert found["y, left at the end"] == pytest.approx(soft, rel=0.05)
            assert found["z, left at the end"] < 0.1e-6
            assert found["largest force"] == 1000


@pytest.mark.slow
def test_braking_changes_nothing_near_the_reference(lqg: Design, pid: Design) -> None:
    """The linear law is the same, entry by entry, and a quintic flies the same bits."""
    for design in (lqg, pid):
        c, without = design.controller, replace(design.controller, braking=np.zeros(0))
        for found, expected in zip(linear_law(c), linear_law(without), strict=True):
            np.testing.assert_array_equal(found, expected)
        first = cases_of("step", design.plant, c)[0]
        runs = [malta.simulate(design.plant, one, first.scenario, **SLOW) for one in (c, without)]
        np.testing.assert_array_equal(runs[0].x, runs[1].x)


def test_the_speed_of_a_far_error_is_the_one_from_which_it_stops(pid: Design) -> None:
    """The force is zero at v^2 = 2 a (error - a / rate^2 / 2), its slope is continuous, and far errors sum nothing."""
    c, a = pid.controller, 40.0
    rate = c.K[1, 1] / c.K[1, 7]
    b = c.braking[1]
    assert b == pytest.approx(a / rate**2)
    step, n = law(c), len(c.states)

    def answer(error: float, speed: float) -> tuple[float, float]:
        xi, y = np.zeros(n), np.zeros(6)
        y[1] = -error
        xi[1] = y[1] - speed * c.sample_time  # the last reading: this filter takes rates as differences
        found = step(xi_pred=xi, y=y)
        total = float(found["e_next"][1])
        return float(found["v"][1]) - c.Ki[1, 1] * total, total

    for error in (0.5 * b, 1.5 * b, 10 * b, 1e-3):
        speed = rate * error if error < b else np.sqrt(2 * a * (error - b / 2))
        force, total = answer(error, speed)
        assert abs(force) < 1e-6 * c.K[1, 1] * error
        assert total == pytest.approx(c.sample_time * error if error < b else 0.0)


def test_the_rate_of_approach_is_the_one_that_brakes_within_the_limit(pid: Design) -> None:
    """The double integrator that is accelerated to the line v = rate (d - y) needs the limit there, and no more."""
    par = motions.parameters_of(pid.plant)
    rate, upwards = jumps.braking_rates(pid.plant, 10e-3, -1e-3)
    assert (rate, upwards) == pytest.approx((86.603, 245.56), rel=1e-4)
    y, v, dt = 0.0, 0.0, 1e-7
    while v < rate * (10e-3 - y):
        y, v = y + v * dt, v + par.F_max / par.m * dt
    assert par.m * rate * v == pytest.approx(par.F_max, rel=1e-3)
    soft = jumps.soften(pid.controller, pid.plant, (rate, upwards))
    assert soft.K[1, 1] / soft.K[1, 7] == pytest.approx(rate)
    assert not soft.Ki[1:3].any()
    np.testing.assert_array_equal(soft.K[3:], pid.controller.K[3:])


@pytest.mark.slow
def test_torques_of_jumps_depend_on_the_gains(pid: Design) -> None:
    """Kp = 1.2 N/um: T_x -2.69 to 2.32 N m with (17)-(24), -0.31 to 0.42 with the table; y is 0.35 mm off."""
    e = malta.experiment("jump", pid.plant, pid.controller, rate=49.6, **SLOW)
    for model, ends in (("analytical", (-2.685, 2.321)), ("table", (-0.308, 0.417))):
        run = next(case.run for case in e.cases if case.label == f"{model}, soft")
        assert (run.v[:, 3].min(), run.v[:, 3].max()) == pytest.approx(ends, abs=5e-3)
        assert merits(e, f"{model}, soft")["y, left at the end"] == pytest.approx(0.352e-3, rel=0.01)


# --- Errors of the coil models ---


def test_errors_of_the_models(flown: dict[str, Experiment], paper: dict[str, Any]) -> None:
    """At 3 A: the fundamental 0.043 and 0.075 N, the table of tau_n / 35 0.0125 and 0.024 N; all within the paper's."""
    e = flown["errors"]
    fundamental, table = merits(e, "analytical"), merits(e, "table")
    assert [fundamental[f"{n}, largest error"] for n in ("F_x", "F_z")] == pytest.approx(
        [0.043, 0.075], abs=2e-3
    )
    assert table["F_x, largest error"] == pytest.approx(0.012, abs=2e-3)
    assert table["F_z, largest error"] == pytest.approx(0.024, abs=2e-3)
    for model, found in (("analytical", fundamental), ("interpolation", table)):
        for name, _ in claims.WRENCH:
            assert found[f"{name}, largest error"] < published_value(paper, f"model.error_{model}.{name}")


def test_amplitudes_and_step_of_the_table(flown: dict[str, Experiment]) -> None:
    """12.40 and 24.70 N; tau_n / 10 errs by 0.155 N, and four times less with every halving."""
    e = flown["errors"]
    found, n = merits(e), experiments.NODES
    assert found["F_x, amplitude"] == pytest.approx(12.39, abs=0.1)
    assert found["F_z, amplitude"] == pytest.approx(24.7, abs=0.1)
    assert found["fitted C of the analytical model"] == pytest.approx(1.138, abs=1e-3)
    assert e.curves["by step"][n.index(10), 0] == pytest.approx(0.155, abs=0.01)
    assert found["error of the table, each halving of its step"] == pytest.approx(4.0, abs=0.05)


def test_a_hover_corrects_what_the_model_misses(flown: dict[str, Experiment]) -> None:
    """0.18 and 0.10 N that the observed disturbance takes off."""
    for model, force in (("analytical", 0.20), ("table", 0.12)):
        assert merits(flown["errors"], model)["hover: force to correct"] == pytest.approx(force, abs=0.01)


@pytest.mark.slow
def test_coils_further_apart_have_the_torques_that_the_paper_prints(paper: dict[str, Any]) -> None:
    """22/3 tau_n: 1.615, 1.615 and 1.604 N m at 3 A, 4, 5 and 13 % below; the arm of F_z is half the pitch, 65 mm."""
    par: Any = malta.read("data/planar.toml", preset="pitch_22_3")
    x, y = np.meshgrid(*[np.linspace(0, 2 * par.tau_n, 141)] * 2, indexing="ij")
    found = np.abs(experiments.coil_wrench(par, field.exact_model(par), 3.0, x, y)).max(axis=(0, 1))
    assert found[3:] == pytest.approx([1.6152, 1.6152, 1.6041], abs=1e-3)
    printed = [published_value(paper, f"model.amplitude.{name}") for name in ("F_z", "T_x")]
    assert printed[1] / printed[0] == pytest.approx(par.coil_pitch / 2, rel=0.01)


def test_a_coil_off_the_centre_has_arms(lqg: Design) -> None:
    """T about the centre of gravity is the coil's own and arm x F, as in K(p)."""
    par = motions.parameters_of(lqg.plant)
    model = field.exact_model(par)
    x, y = np.array([3e-3]), np.array([5e-3])
    centre = np.array([x[0] - par.coil_pitch / 2, y[0] - par.coil_pitch / 2, par.h])
    column = commutation.wrench_matrix(par, model, centre)[
        :, 10
    ]  # the third of the third row: half a pitch along both
    np.testing.assert_allclose(
        experiments.coil_wrench(par, model, 2.0, x, y)[0], 2 * column, rtol=0, atol=1e-11
    )


# --- Delay and time ---


def test_the_filter_has_to_know_of_the_delay(flown: dict[str, Experiment]) -> None:
    """As designed both are quiet at rest; at twice and three times the speed the one that does not know circles."""
    e = flown["delay"]
    left = {case.label: case.merits[1].value for case in e.cases}
    assert left["with, 1 x"] < 2e-9
    assert left["without, 1 x"] < 2e-9
    assert left["with, 3 x"] < 1e-11
    assert left["without, 2 x"] > 30e-6
    assert left["without, 3 x"] > 30e-6


@pytest.mark.slow
def test_times_are_those_of_the_numbers(lqg: Design, flown: dict[str, Experiment]) -> None:
    """The timed C code gives numpy's currents. Times themselves are for bench/run.py."""
    par = motions.parameters_of(lqg.plant)
    p, W = np.array([6e-3, 4e-3, par.h]), np.array([10.0, 200, 400, 1, 2, 3])
    for model in (
        field.table(par, field.simulation_model(par), 35),
        field.simulation_model(par),
        field.Analytical(par),
    ):
        compiled = experiments.compile_function(commutation.decoupling(par, model))
        if compiled is None:
            pytest.skip("no C compiler")
        seconds, i = compiled(10, p, W)
        assert seconds > 0
        expected = commutation.currents(commutation.wrench_matrix(par, model, p), W)
        np.testing.assert_allclose(i, expected, rtol=0, atol=1e-11)
    assert {m.label for m in flown["timing"].merits} >= {"table, numpy", "table, compiled"}


def test_without_a_compiler_there_is_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("malta.simulation.engine.compiled.compiler", lambda: None)
    x = ca.SX.sym("x")
    assert np.isnan(experiments.compiled_seconds(ca.Function("square", [x], [x * x]), np.ones(1)))


# --- Figures and claims ---


@pytest.mark.parametrize("name", NAMES)
def test_figures(flown: dict[str, Experiment], paper: dict[str, Any], name: str) -> None:
    """Every panel has labels with units, and every experiment its own figure, with and without the paper."""
    for published in (paper, None):
        figure = experiment_figure(flown[name], published)
        labelled = [a for a in figure.axes if a.get_xlabel() or a.get_ylabel()]
        assert labelled
        assert any("[" in a.get_xlabel() + a.get_ylabel() for a in labelled)
        assert "planar" in figure.get_suptitle()


@pytest.mark.slow
def test_the_ledger(
    lqg: Design, flown: dict[str, Experiment], paper: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chosen numbers are by construction, bounds say how far, speed proves nothing, what is off has a reason."""
    monkeypatch.setattr("malta_papers.ledger.experiment", lambda name, *_, **__: flown[name])
    monkeypatch.setattr("malta_papers.ledger.verify", lambda *_: lqg.margins)
    found = {claim.subject: claim for claim in ledger([lqg.spec], paper).claims}
    words = {
        "one coil at 3 A: F_x [N]": "by construction, within 1 %; B_r and the corner radius",
        "one coil at 3 A: F_z [N]": "within 4 %; a field without curl",
        "F_z over F_x": "within 4 %; a field without curl",
        "T_z that (20)–(22) make of the printed F_x, F_z, T_x, T_y [N m]": "within 12 %; the printed torques contr",
        "the same with coils 22/3 τ_n apart: T_x [N m]": "within 4 %",
        "the same with coils 22/3 τ_n apart: T_y [N m]": "within 5 %",
        "the same with coils 22/3 τ_n apart: T_z [N m]": "within 13 %",
        "largest force [N]": "by construction; an input",
        "control period [us]": "by construction; an input",
        "table of τ_n/35, error of F_z [N]": "smaller, x 9.6",
        "analytical model with C = 1, error of F_x [N]": "not reproduced; the paper prints no C",
        "analytical model with C = 1, error of T_z [N m]": "within 7 %",
        "analytical model with the fitted C, error of F_x [N]": "not compared; C is fitted to the truth",
        "jumps, analytical, soft, at once: phi, highest [µrad]": "of another design",  # the paper's is a PID
        "jumps, analytical, soft: phi, highest [µrad]": "not compared; with the machine's sample of delay",
        "jumps, soft: largest force [N]": "by construction",
        "K(p) and pseudo-inverse, table [us]": "not compared; compiled, on this computer",
        "K(p) and pseudo-inverse, analytical [us]": "not compared; on another computer",
        "K(p) and pseudo-inverse, exact field [s]": "not compared; ours sums 22 harmonics",
    }
    for subject, start in words.items():
        assert found[subject].verdict.startswith(start), subject
    torque = found["one coil at 3 A: T_x [N m]"].verdict
    assert torque.startswith("not reproduced")
    assert "pitch" in torque
    for name, implied in (("F_x", "1.062"), ("F_z", "1.029")):
        assert found[f"C of (23), (24) that errs by the printed {name}"].ours == (implied,)
    assert found["the same with 4 τ_n"].ours == ("inf",)
    assert found["width of the coils, 22/3 τ_n apart [mm]"].ours == ("454",)
    assert found["step of the table that errs by the printed F_x [mm]"].ours == ("1.93",)
    assert found["step of the table that errs by the printed F_z [mm]"].ours == ("1.57",)


def test_without_a_fitted_C_forces_are_12_percent_low(
    pid: Design, flown: dict[str, Experiment], paper: dict[str, Any]
) -> None:
    """By (17)-(24) evaluated anew with C = 1, and with the C at which the amplitude of F_x is 0.83 N off."""
    par = motions.parameters_of(pid.plant)
    evidence: Any = SimpleNamespace(spec=pid.spec, parameters=par, experiments=flown, published=paper)
    x, y = np.meshgrid(*[np.linspace(0, 2 * par.tau_n, 141)] * 2, indexing="ij")
    exact = experiments.coil_wrench(par, field.exact_model(par), 3.0, x, y)

    def errors(C: float) -> Any:
        found = experiments.coil_wrench(par, field.Analytical(replace(par, C=C)), 3.0, x, y)
        return np.abs(found - exact).max(axis=(0, 1))

    found = [claims.unfitted_error(name, evidence) for name, _ in claims.WRENCH]
    assert found == pytest.approx(errors(1.0), rel=1e-9)
    assert found[0] / np.abs(exact[..., 0]).max() == pytest.approx(0.122, abs=1e-3)
    # The amplitude is of the whole field, the error of a fundamental is largest beside its top.
    assert errors(claims.implied_compensation("F_x", evidence))[0] == pytest.approx(0.83, rel=0.05)


@pytest.mark.slow
def test_jumps_without_delay_are_nearer_to_the_paper(pid: Design, paper: dict[str, Any]) -> None:
    """T_x -0.115 to 0.141 by the table, and 6 of 16 extremes; with the sample of computation -0.350 to 0.614, and 3."""
    for delay, ends, within in ((0, (-0.115, 0.141), 6), (1, (-0.350, 0.614), 3)):
        jumped = experiments.soft_jumps(pid.plant, pid.controller, delay=delay, **SLOW)
        evidence: Any = SimpleNamespace(experiments={"jump": jumped}, published=paper)
        found = [claims.extreme("table, soft", "T_x", "v", of, evidence) for of in (np.min, np.max)]
        assert found == pytest.approx(ends, abs=1e-3)
        assert claims.extremes_within("table, soft", "interpolation", evidence) == within


def test_every_printed_number_is_claimed(paper: dict[str, Any]) -> None:
    """Each figure of data/published/ that is no input of ours."""
    keys = {row.published for row in claims.rows() if isinstance(row.published, str)}

    def printed(node: dict[str, Any], path: str = "") -> list[str]:
        below = [
            (f"{path}.{key}".lstrip("."), value) for key, value in node.items() if isinstance(value, dict)
        ]
        return [p if "value" in v else "" for p, v in below] + [k for p, v in below for k in printed(v, p)]

    inputs = {
        "model.current",
        "model.range",
        "steps.duration",
        "steps.z_step",
        "steps.z_time",
        "steps.y_step",
        "steps.y_time",
    }
    assert {key for key in printed(paper) if key} - keys == inputs


@pytest.mark.slow
def test_gain_files_keep_where_axes_brake(pid: Design, tmp_path: Path) -> None:
    files = [tmp_path / f"kept{suffix}" for suffix in (".json", ".npz", ".mat")]
    malta.gains.write(pid.controller, pid.margins, *files)
    for file in files:
        np.testing.assert_array_equal(malta.gains.read(file).braking, pid.controller.braking)


def test_an_axis_that_cannot_brake_is_refused(lqg: Design) -> None:
    spec, model = lqg.spec, malta.linearize(lqg.plant, lqg.plant.at())
    with pytest.raises(malta.InputError, match=r"braking\.psi: found an axis without both"):
        braking_errors(replace(lqg.controller, K=0 * lqg.controller.K), [0, 0, 0, 0, 0, 9.0], spec.path)
    turned = replace(spec, braking=(40.0, 0, 0, 0, 0, 0))
    assert malta.synthesize(turned, model).braking[0] == lqg.controller.braking[0]
    with pytest.raises(malta.InputError, match="expected one of an output that is the state of its index"):
        replace(lqg.controller, C=lqg.controller.C[::-1])


# --- The command line ---


@pytest.mark.slow
def test_design(run: Run, tmp_path: Path) -> None:
    """From the design file to gain files and a figure: they are the shipped ones, bit for bit but for dates."""
    code, out, _ = run("design", "design/planar.toml", "--out", tmp_path, "--figures", tmp_path)
    assert code == 0
    assert "What does the coil model move?" in out
    assert re.search(r"over\sthe\swhole\stravel", out)
    assert re.search(r"proven\s369\.\d+ %", out)  # of the box of m, I_x, I_z, B_r and r_z
    assert max(len(line) for line in out.splitlines() if not line.startswith("wrote")) <= 100
    assert {path.name for path in tmp_path.iterdir()} == {
        "planar.json",
        "planar.npz",
        "planar.mat",
        "planar_step.png",
    }
    np.testing.assert_allclose(
        malta.gains.read(tmp_path / "planar.json").K, malta.gains.read(GAINS).K, rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["step", "errors", "timing"])
def test_simulate(run: Run, tmp_path: Path, scenario: str) -> None:
    arguments = ("--scenario", scenario, "--engine", "virtual-machine", "--out", tmp_path)
    code, out, err = run("simulate", GAINS, *arguments)
    assert (code, err) == (0, "")
    assert (tmp_path / f"planar_{scenario}.png").exists()
    assert max(len(line) for line in out.splitlines() if not line.startswith("wrote")) <= 100


@pytest.mark.slow
def test_simulate_json(run: Run) -> None:
    code, out, _ = run("simulate", GAINS, "--engine", "virtual-machine", "--option", "cells=10", "--json")
    found = json.loads(out)
    assert code == 0
    assert len(found["cases"]) == 6
    assert found["merits"]["table_moves_theta_by_rad"] > 0.1e-6


@pytest.mark.slow
def test_a_campaign(lqg: Design, tmp_path: Path) -> None:
    """Machines whose coils, magnets and masses differ: all arrive; the unknown pitch tilts by some urad."""
    spread = {"m": 0.05, "B_r": 0.05, "I_x": 0.1, "coil_pitch": 0.002}
    found = malta.campaign(malta.campaigns.Plan(lqg.controller, "step", spread, samples=8), tmp_path)
    assert found.batch.completed.all()
    assert 1e-6 < found.batch.deviation[:, 3].max() < 20e-6


@pytest.mark.slow_for("arguments7-1-touchdown on the magnets at 0 s")
@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (("--set", "coil_pitch=70.8mm"), 2, "= 4 tau_n, K(p) is singular"),
        (("--set", "coil_pitch=60mm"), 2, "the width of a coil"),
        (("--option", "place=200mm,0mm"), 2, "x: found 0.2 m, expected a position from -0.1 to 0.1 m"),
        (("--option", "place=6mm"), 2, "found 1 numbers, expected x and y"),
        (("--option", "distance=300mm"), 2, "y: found 0.304 m"),
        (("--option", "lift=9mm"), 2, "z: found 0.00905 m"),
        (("--option", "gap=-1um"), 2, "z: found -1e-06 m"),
        (("--option", "gap=0mm"), 1, "touchdown on the magnets at 0 s"),
        (("--option", "cells=0"), 2, "finite, above 0"),
        (("--option", "cells=3.5"), 2, "a whole number"),
        (("--option", "fidelity=dq"), 2, "one of force for a planar"),
        (("--scenario", "errors", "--option", "place=0,0,0"), 2, "3 numbers"),
        (("--scenario", "jump", "--option", "place=6mm"), 2, "found 1 numbers, expected x and y"),
        (("--scenario", "jump", "--option", "rate=-1"), 2, "0 to 1000 1/s"),
        (("--scenario", "jump", "--set", "m=110kg"), 2, "more than the weight, 1078 N"),
        (("--scenario", "errors", "--option", "current=0"), 2, "finite, above 0"),
        (("--scenario", "delay", "--option", "speeds=1,-2"), 2, "finite, above 0"),
        (("--scenario", "stroke"), 2, "one of step, jump, errors, delay, timing"),
    ],
)
def test_what_is_refused(run: Run, arguments: tuple[str, ...], code: int, sentence: str) -> None:
    found, _, err = run("simulate", GAINS, *arguments, "--engine", "virtual-machine")
    assert found == code
    assert sentence in err
    assert err.count("\n") == 1


def test_a_pid_predicts_nothing(pid: Design) -> None:
    with pytest.raises(malta.InputError, match="a PID, which predicts nothing"):
        malta.experiment("delay", pid.plant, pid.controller, **SLOW)


def test_the_main_job_comes_first(lqg: Design) -> None:
    assert list(experiments_of(lqg.plant)) == ["step", "jump", "errors", "delay", "timing", "worst-load"]
