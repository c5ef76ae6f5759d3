"""The Halbach motor from design file to ledger: what its paper shows, on the simulated machine, and by a second route.

The second route is bench/peer_halbach.py: the same motor, electronics and laws in plain Python floats.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import peer_halbach as peer
import pytest
from conftest import ROOT, Run
from scipy.linalg import expm, solve_discrete_lyapunov

import malta
from malta.linear.sampling import sample_noise
from malta.machines.halbach import electronics, electronics as motor, plant as halbach
from malta.machines.halbach.electronics import IDEAL_ELECTRONICS, Options
from malta.machines.halbach.experiments import lift_force, responses, steps_reference
from malta.machines.halbach.plant import Parameters
from malta.model.plant import Plant
from malta.model.printed import published_value
from malta.report.ledger import ledger
from malta.simulation.engine.compiled import compiler
from malta.simulation.experiments.catalogue import cases_of, experiment
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller
from malta.synthesis.design_models import sampled_model
from malta.synthesis.linear_law import linear_law
from malta_papers.halbach import claims
from malta_papers.halbach.claims import HalbachEvidence, open_loop_dip, rise_of_dip
from malta_papers.halbach.experiments import (
    FAULTS,
    LAWS,
    fit_servo,
    move_reference,
    positions_at_rest,
    servo_step,
)

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.simulation.experiments import Experiment

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

DESIGNS = ("halbach", "halbach_pid")
SCENARIOS = ("step", "stairs", "ramp", "force", "budget", "identify")


@pytest.fixture(scope="module")
def printed() -> dict[str, Any]:
    return malta.model.read_published(ROOT / "data" / "halbach.toml")


@pytest.fixture(scope="module")
def evidence(printed: dict[str, Any]) -> Mapping[str, HalbachEvidence]:
    """Both designs, from their files through all experiments."""
    specs = (malta.read_design(ROOT / "design" / f"{name}.toml") for name in DESIGNS)
    return {spec.name: claims.evidence(spec, printed) for spec in specs}


@cache
def controller_of(name: str) -> Controller:
    """As its gain file has it."""
    return malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")


@pytest.fixture(params=DESIGNS)
def controller(request: pytest.FixtureRequest) -> Controller:
    return controller_of(request.param)


def plant_for(c: Controller) -> Plant:
    return malta.plant_of(c.parameters)


def found(e: Experiment, case: int | str, label: str) -> float:
    """A figure of merit of a case."""
    one = e.cases[case] if isinstance(case, int) else next(c for c in e.cases if c.label == case)
    return next(merit.value for merit in one.merits if merit.label == label)


# Designs


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNS)
def test_gain_files_are_of_their_design_files(evidence: Mapping[str, HalbachEvidence], name: str) -> None:
    made, read = evidence[name].controller, controller_of(name)
    assert read.spec_sha256 == made.spec_sha256
    for matrix in ("Ad", "Bd", "Cd", "K", "Ki", "L"):
        own = getattr(made, matrix)
        np.testing.assert_allclose(getattr(read, matrix), own, rtol=1e-12, atol=1e-14 * np.abs(own).max())
    assert evidence[name].margins.stable
    robust = evidence[name].margins.robust
    assert robust is not None
    assert robust.lower is not None
    assert robust.lower > 1.9


def test_noise_of_the_design_is_that_of_the_sensors() -> None:
    par = malta.read("data/halbach.toml")
    weights = malta.read_design("design/halbach.toml").weights
    assert weights.process_variance[0] == pytest.approx(electronics.force_noise(par) / par.T_laser, rel=1e-3)
    assert math.sqrt(weights.sensor_variance[0]) == pytest.approx(
        halbach.plant(par).sensors.noise[0], rel=1e-3
    )


def _closed(e: HalbachEvidence) -> tuple[FloatArray, FloatArray]:
    """The sampled loop, the motor's states first, and how an error of a reading enters it: angle and law."""
    law, H = linear_law(e.controller), e.par.k * e.par.F_z
    Ad, Bd, C = sampled_model(e.model, e.par.T_laser)
    M = np.block([[Ad + Bd @ law.D_y @ C, Bd @ law.C], [law.B_y @ C, law.A]])
    return M, np.vstack([Bd * H + Bd @ law.D_y, law.B_y])


# The same by another route


@pytest.mark.slow
def test_20_readings_against_plain_python(controller: Controller) -> None:
    """All quantizers and all noise: 16 000 PWM periods, equal to rounding."""
    plant = plant_for(controller)
    reference = partial(steps_reference, distance=100e-6, rise=0.0, count=1, Ts=controller.sample_time)
    scenario = Scenario("step", 1.1, reference, fidelity="phase", noise=1.0, quantize=True, seed=3)
    run = simulate(plant, controller, scenario)
    rows = peer.run(controller, *peer.given(plant, controller, scenario))
    for mine, theirs in (
        (run.x, [(row.x, row.speed) for row in rows]),
        (run.y[:, 0], [row.y for row in rows]),
        (run.v[:, 0], [row.F for row in rows]),
        (run.i_phase, [row.currents for row in rows]),
    ):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)
    assert run.y.std() > 10e-6


def test_small_steps_against_matrices(
    controller: Controller, evidence: Mapping[str, HalbachEvidence]
) -> None:
    """On the held model; it knows nothing of the current loops, whose 2 ms are the difference."""
    e, step = evidence[controller.name], 1e-6
    law = linear_law(controller)
    Ad, Bd, C = sampled_model(e.model, e.par.T_laser)
    reference = partial(move_reference, distance=step, rise=0.0, begin=2 * e.par.T_laser)
    run = simulate(
        plant_for(controller),
        controller,
        Scenario("step", 1.65, reference, fidelity="phase", electronics=IDEAL_ELECTRONICS),
    )
    xi, s = np.zeros(2), np.zeros(len(law.A))
    for k, x in enumerate(run.p[:, 0]):
        assert x == pytest.approx(xi[0], abs=0.15 * step)
        r = np.zeros(law.B_r.shape[1])
        r[:2] = step if k >= 2 else 0.0  # p*, and the first of xi*
        y = C @ xi
        v = law.C @ s + law.D_y @ y + law.D_r @ r
        s, xi = law.A @ s + law.B_y @ y + law.B_r @ r, Ad @ xi + Bd @ v
    assert xi[0] == pytest.approx(step, rel=0.02)


@pytest.mark.parametrize("name", DESIGNS)
def test_noise_by_source_against_covariances(evidence: Mapping[str, HalbachEvidence], name: str) -> None:
    """Of the sampled loop; where the motor stands sets how noise of the phases adds up."""
    e = evidence[name]
    M, reading = _closed(e)
    A = np.array([[0, 1], [-e.par.k * e.par.F_z / e.par.m, -e.par.b / e.par.m]])
    B = np.array([[0], [1 / e.par.m]])

    def rms(W: FloatArray) -> float:
        return math.sqrt(solve_discrete_lyapunov(M, W)[0, 0])

    budget = e.experiments["budget"]
    laser = rms(reading @ reading.T * e.par.n_laser**2 / 3)
    assert found(budget, "laser", "position, rms") == pytest.approx(laser, rel=0.15)
    expected = []
    for x in budget.curves["place"]:
        W = np.zeros_like(M)
        W[:2, :2] = sample_noise(A, B @ B.T, e.par.T_laser) * electronics.force_noise(e.par, float(x))
        expected.append(rms(W))
    np.testing.assert_allclose(budget.curves["rms"], expected, rtol=0.15)


# What the paper shows


@pytest.mark.parametrize("name", DESIGNS)
def test_step_of_100_um_with_all_errors(evidence: Mapping[str, HalbachEvidence], name: str) -> None:
    """Fig. 9. The PID has no set-point weight, and overshoots a jump by 78 %: its reference is a quintic."""
    step, case = evidence[name].experiments["step"], {"halbach": "jumps", "halbach_pid": "quintics"}[name]
    assert step.run.scenario.fidelity == "phase"
    assert found(step, case, "mean overshoot") < 0.10
    # NOTE: the PID's gains are for loads: behind a quintic of 0.3 s it is 33 ms over the half second.
    assert found(step, case, "mean within 5 % after") < {"halbach": 0.5, "halbach_pid": 0.55}[name]
    assert found(step, case, "at rest, rms") < 3e-6
    assert found(step, case, "at rest, mean error") < 0.1e-6
    assert all(case.run.limits == () for case in step.cases)
    jumped = found(evidence["halbach_pid"].experiments["step"], "jumps", "mean overshoot")
    assert 0.7 < jumped < 0.85


@pytest.mark.slow
def test_the_calm_design_answers_what_the_paper_asked() -> None:
    """Sec. 5.1: response within a minute, no oscillation; at that a stiff loop. What it pays is a slow integral."""
    c = controller_of("halbach_calm")
    plant = plant_for(c)
    step = experiment("step", plant, c)
    assert found(step, "jumps", "mean overshoot") == pytest.approx(0.029, abs=0.005)
    assert found(step, "jumps", "mean within 5 % after") < 0.25
    assert found(step, "jumps", "at rest, rms") < 2.4e-6
    mean = responses(step.run, 100e-6, 20).mean(axis=0)
    assert mean[int((mean > 0.95).argmax()) :].min() > 0.985  # it does not swing back, but for noise
    assert 0.1e-6 < found(step, "jumps", "at rest, mean error") < 0.4e-6
    reference = partial(steps_reference, distance=100e-6, rise=0.0, count=1, Ts=c.sample_time)
    run = simulate(plant, c, Scenario("step", 60.0, reference, fidelity="force"))
    share = run.p[5:, 0] / 100e-6
    assert share.max() < 1.04
    assert share[int((share > 0.95).argmax()) :].min() > 0.99
    assert abs(share[-1] - 1) < 1e-4
    model = malta.linearize(plant, plant.at())
    assert malta.verify(model, c, {}).peak_sensitivity["x"] == pytest.approx(2.11, abs=0.01)
    weak = replace(c, K=np.array([[150.0, 30.0]]), Ki=np.array([[30.0]]))
    assert malta.verify(model, weak, {}).peak_sensitivity["x"] == pytest.approx(7.06, abs=0.02)


def test_what_differs_from_the_paper_is_said(evidence: Mapping[str, HalbachEvidence]) -> None:
    """The laser as a main contributor, and a smoother force under vector control: neither, by any of our designs."""
    for e in evidence.values():
        assert claims.share_of_error("laser", e) == pytest.approx(0.03, abs=0.01)
        assert claims.share_of_error("current noise", e) == pytest.approx(1, abs=0.1)
        assert claims.vector_over_position(e) == pytest.approx(0.99, abs=0.02)


@pytest.mark.parametrize("name", DESIGNS)
def test_stairs(evidence: Mapping[str, HalbachEvidence], printed: dict[str, Any], name: str) -> None:
    """Fig. 7: the second step is dead; closed, it switches between what voltages there are; fine ones are not seen."""
    stairs = evidence[name].experiments["stairs"]
    stands, _ = positions_at_rest(stairs.cases[0].run)
    assert 1e6 * stands == pytest.approx([0, 13.39, 13.39, 26.74, 40.17], abs=0.05)
    fine, _ = positions_at_rest(stairs.cases[1].run)
    assert np.abs(fine - published_value(printed, "open_loop.stair") * np.arange(5)).max() < 35e-9
    for case, off, swing in ((2, 5e-6, 60e-6), (3, 0.03e-6, 0.2e-6)):
        assert found(stairs, case, "off its stair by") < off
        assert 0.05 * swing < found(stairs, case, "swing, peak to peak") < swing
    zones = {merit.published: merit.value for merit in stairs.merits}
    assert zones["open_loop.smallest_motion"] == pytest.approx(15.3e-6, rel=0.03)
    assert zones["open_loop.smallest_motion_fine"] == pytest.approx(69e-9, rel=0.03)


@pytest.mark.parametrize("name", DESIGNS)
def test_ramps_through_the_travel(evidence: Mapping[str, HalbachEvidence], name: str) -> None:
    """Fig. 8: 50 mm at 1, 2 and 5 mm/s."""
    ramp = evidence[name].experiments["ramp"]
    assert [case.label for case in ramp.cases] == ["1 mm/s", "2 mm/s", "5 mm/s"]
    for case in ramp.cases:
        assert case.run.limits == ()
        assert case.run.p[-1, 0] - case.run.p[0, 0] == pytest.approx(50e-3, abs=20e-6)
        assert case.merits[0].value < 1e-6  # mean lag
        assert lift_force(case.run) == pytest.approx(5.0, rel=0.01)


def test_ramps_without_feedforward_start_later(controller: Controller) -> None:
    without = replace(controller, feedforward=replace(controller.feedforward, speed=np.zeros((1, 1))))
    options: dict[str, Any] = {"speeds": (5e-3,), "distance": 5e-3, "noise": 0.0, "adc_noise": False}
    worst = [
        found(experiment("ramp", plant_for(c), c, **options), 0, "largest error")
        for c in (controller, without)
    ]
    assert worst[0] < 0.95 * worst[1]


@pytest.mark.parametrize("name", DESIGNS)
def test_error_budget(evidence: Mapping[str, HalbachEvidence], name: str) -> None:
    """Sec. 5.1: current sampling decides; how much depends on where in a pitch the motor stands."""
    budget = evidence[name].experiments["budget"]
    rms = {case.label: 1e6 * case.merits[0].value for case in budget.cases}
    best, worst = (1e6 * merit.value for merit in budget.merits)
    assert rms["laser"] == pytest.approx(0.07, abs=0.01)
    assert 1.6 < best < rms["current noise"] < worst < {"halbach": 3.1, "halbach_pid": 3.7}[name]
    assert rms["current steps"] < 0.05
    assert rms["PWM"] < 0.01
    assert rms["angle of 24 bits"] < 0.001
    assert rms["all"] == pytest.approx(rms["current noise"], rel=0.1)
    assert rms["all, fine PWM"] == pytest.approx(rms["all"], rel=0.1)


@pytest.mark.parametrize("name", DESIGNS)
def test_vertical_force_of_a_move(evidence: Mapping[str, HalbachEvidence], name: str) -> None:
    """Fig. 10, sound: only the jump of the open loop disturbs the vertical force, and not for good."""
    force = evidence[name].experiments["force"]
    assert found(force, "open loop", "lowest") == pytest.approx(-0.503, abs=1e-3)
    assert abs(found(force, "open loop", "steady change")) < 1e-3
    for law in ("position control", "vector control"):
        assert found(force, law, "lowest") > -0.01
        assert abs(found(force, law, "steady change")) < 1e-3
        assert found(force, law, "moved") == pytest.approx(5e-3, abs=3e-6)


@pytest.mark.slow
def test_vertical_force_with_the_induced_voltage() -> None:
    """Preset emf: the same damping, split."""
    c = controller_of("halbach")
    force = experiment("force", halbach.plant(malta.read("data/halbach.toml", preset="emf")), c)
    assert found(force, "open loop", "lowest") == pytest.approx(-0.503, abs=1e-3)
    for law in LAWS:
        assert abs(found(force, law, "steady change")) < 1e-3


@pytest.mark.parametrize("name", DESIGNS)
def test_no_fault_explains_figure_10(
    evidence: Mapping[str, HalbachEvidence], printed: dict[str, Any], name: str
) -> None:
    """The paper's steady -18 % (open loop) and +7 % (position controller) with 0 under vector control.

    Unequal magnets show under vector control, too. An angle error, or a force from outside, changes nothing between two
    places at rest. Unequal windings are left: vector control takes them out, but the two others go one way.
    """
    force = evidence[name].experiments["force"]

    def steady(fault: str) -> list[float]:
        return [found(force, f"{law}, {fault}", "steady change") for law in LAWS]

    windings, magnets, angle, push = (fault for fault in FAULTS if fault != "sound")
    assert steady(magnets)[2] == pytest.approx(-0.104, abs=2e-3)
    assert np.abs(steady(angle) + steady(push)).max() < 5e-3
    open_loop, position, vector = steady(windings)
    assert abs(vector) < 1e-3
    assert open_loop == pytest.approx(position, abs=0.03)
    assert open_loop > 0.1
    both = [published_value(printed, f"figure_10.{key}") for key in ("open_loop", "position_controller")]
    assert both[0] < 0 < both[1]


@pytest.mark.parametrize("preset", ["identified", "emf"])
def test_linear_servo_against_the_motor_on_a_step_of_2_mm(preset: str) -> None:
    par: Parameters = malta.read("data/halbach.toml", preset=preset)
    e = experiment("identify", halbach.plant(par), controller_of("halbach"))
    rms, first, secant, tangent, *fitted = (merit.value for merit in e.merits)
    # Fitted as the paper did: a line of known stiffness for what is a sine costs 1.8 and 1.3 %, not in the intervals.
    assert fitted[:5] == pytest.approx([3.684, 0.018, 9.29, 0.076, 5.6e-6], rel=0.02)
    assert fitted[5::2] == pytest.approx([1.6067, 211.0001, 29.778e-3], rel=1e-3)  # of the load cell
    assert abs(fitted[0] - 3.75) > 3 * fitted[1]
    assert 0.005e-3 < rms < first < 0.03e-3
    assert secant == pytest.approx(204.8, abs=0.5)
    assert tangent == pytest.approx(211.0, abs=0.05)
    A, _ = motor.servo(par, 1.0, 2e-3)
    assert np.linalg.eigvals(A).real == pytest.approx([-9.41 / 3.75 / 2] * 2, rel=1e-5)


@pytest.mark.parametrize("b", [0.5, 9.41, 2 * math.sqrt(205 * 3.75), 80.0])
def test_a_servo_is_found_in_its_step(b: float) -> None:
    """With little friction, the critical one and more: the matrix exponential's step gives m and b back."""
    A, B = np.array([[0, 1], [-205 / 3.75, -b / 3.75]]), np.array([[0], [205 / 3.75]])
    t = np.arange(110) * 0.055
    x = np.array([(np.linalg.solve(A, expm(A * at) - np.eye(2)) @ B)[0, 0] for at in t]) * 2e-3
    np.testing.assert_allclose(servo_step(t, 3.75, b, 205.0, 2e-3), x, rtol=0, atol=1e-12)
    fit = fit_servo(t, x, 2e-3, 205.0)
    assert (fit.m, fit.b) == pytest.approx((3.75, b), rel=1e-5)


@pytest.mark.slow
def test_intervals_of_a_fit_hold_what_they_promise() -> None:
    """Of 200 records with white noise of the laser's size times 100, 95 % of the intervals hold m, and b."""
    t, rng = np.arange(110) * 0.055, np.random.default_rng(0)
    x, held = servo_step(t, 3.75, 9.41, 205.0, 2e-3), np.zeros(2)
    for _ in range(200):
        fit = fit_servo(t, x + rng.uniform(-20e-6, 20e-6, len(t)), 2e-3, 205.0)
        held += abs(fit.m - 3.75) < fit.m_half, abs(fit.b - 9.41) < fit.b_half
    assert (held > 0.9 * 200).all()


def test_records_that_are_no_steps_are_refused() -> None:
    t = np.arange(110) * 0.055
    with pytest.raises(malta.InputError, match="7 readings at 7 times, expected 8 or more"):
        fit_servo(t[:7], t[:7], 2e-3, 205.0)
    for x, K in ((t * np.nan, 205.0), (t, -1.0)):
        with pytest.raises(malta.InputError, match="finite numbers, K above 0"):
            fit_servo(t, x, 2e-3, K)
    with pytest.raises(malta.CheckError, match="no servo of 205 N/m fits the record"):
        fit_servo(t[:10], servo_step(t[:10], 3.75, 9.41, 205.0, 2e-3), 2e-3, 205.0)


@pytest.mark.slow
def test_the_open_loop_dips_as_its_reference_is_quick() -> None:
    """At once by 1 - cos(k 5 mm), not at all for the slowest; the rise of -18 % is between."""
    plant = halbach.plant(malta.read("data/halbach.toml"))
    assert open_loop_dip(plant, 1e-3) == pytest.approx(math.cos(211.0001 * 5e-3) - 1, abs=5e-3)
    assert abs(open_loop_dip(plant, 2.0)) < 1e-4
    rise = rise_of_dip(plant, -0.18)
    assert rise == pytest.approx(0.1257, abs=1e-3)
    assert open_loop_dip(plant, rise) == pytest.approx(-0.18, abs=1e-4)


def test_lqg_of_a_mass_with_friction_falls_into_a_limit_cycle() -> None:
    """With a late reading the spring that it does not know of makes it unstable; the limit of the force holds it."""
    late: Parameters = malta.read("data/halbach.toml", preset="late")
    spec = malta.read_design("design/halbach.toml")
    reference = partial(move_reference, distance=100e-6, rise=0.0, begin=1.1)
    scenario = Scenario("step", 20.0, reference, fidelity="phase", electronics=IDEAL_ELECTRONICS)
    swing, limits = [], []
    for F_z in (0.0, late.F_z):  # commutation without vertical force holds no spring
        believed = halbach.plant(replace(late, F_z=F_z))
        model = malta.linearize(believed, believed.at())
        c = malta.lqg(model, spec.weights, spec.sample_time, spec.discretization, 1)
        run = simulate(halbach.plant(late), replace(c, parameters=late), scenario)
        swing.append(float(np.ptp(run.p[run.t > 15])))
        limits.append(run.limits)
    assert limits == [("force limit",), ()]
    assert 1e-3 < swing[0] < 5e-3
    assert swing[1] < 1e-9


@pytest.mark.parametrize("speed", [1e-3, 5e-3])
def test_ramps_with_a_late_laser(speed: float) -> None:
    late: Parameters = malta.read("data/halbach.toml", preset="late")
    spec, plant = malta.read_design("design/halbach.toml"), halbach.plant(late)
    model = malta.linearize(plant, plant.at())
    c = malta.lqg(model, spec.weights, spec.sample_time, spec.discretization, 1)
    ramp = experiment("ramp", plant, c, speeds=(speed,), distance=20e-3)
    assert found(ramp, 0, "mean lag") < 1e-6
    assert found(ramp, 0, "vertical force off by") < 0.02


def test_compiled_simulation_is_much_faster_than_the_virtual_machine() -> None:
    """With every quantizer on: some 20 times. The best of five each, in turn, as others may be using this processor."""
    if compiler() is None:
        pytest.skip("no C compiler here")
    c = controller_of("halbach")
    reference = partial(steps_reference, distance=100e-6, rise=0.0, count=8, Ts=c.sample_time)
    durations: dict[Literal["compiled", "virtual machine"], float] = {
        "compiled": 20.0,
        "virtual machine": 1.0,
    }
    taken = dict.fromkeys(durations, math.inf)
    for _ in range(5):
        for engine, duration in durations.items():
            scenario = Scenario("steps", duration, reference, fidelity="phase", noise=1.0, quantize=True)
            began = time.process_time()
            simulate(plant_for(c), c, scenario, engine=engine)
            taken[engine] = min(taken[engine], (time.process_time() - began) / duration)
    assert taken["virtual machine"] > 4 * taken["compiled"]


# The ledger


@pytest.mark.slow
def test_every_row_of_the_ledger_has_its_verdict(
    evidence: Mapping[str, HalbachEvidence], printed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = claims.evidence(malta.read_design(ROOT / "design" / "halbach_calm.toml"), printed)
    known = {**evidence, judged.spec.name: judged}
    monkeypatch.setattr(claims, "evidence", lambda spec, *_: known[spec.name])
    rows = {claim.subject: claim for claim in ledger([e.spec for e in known.values()], printed).claims}
    missed = {name for name, claim in rows.items() if "not reproduced" in claim.verdict}
    assert missed == {
        "current for 1 µm at 5 N, peak [mA]",
        "current sensor: noise after the rolling mean [mA]",
        "current sensor: range of 32 samples [A]",
        "smallest motion, high-resolution PWM [µm]",
        "Fig. 10: open loop, steady change [%]",
        "Fig. 10: position control, steady change [%]",
        "Fig. 10 as a transient: open loop, lowest [%]",
        "noise of the laser alone, of all [%]",
        "the same, over that under position control",
    }
    for name in missed:
        assert re.match(
            "not reproduced(: (smaller|larger), x [0-9.]+)?; .", rows[name].verdict
        )  # with a reason
    built = {name for name, claim in rows.items() if claim.verdict.startswith("by construction; ")}
    assert built == {
        "pitch, 2π/k [mm]",
        "Fig. 2: between F_x and F_z [°]",
        "PWM: step of a phase voltage [mV]",
        "duty cycle at −2.1 A [%]",
        "duty cycle at +2.1 A [%]",
        "current sensor: step [A]",
        "Fig. 8: way at constant speed [mm]",
    }
    near = {name for name, claim in rows.items() if claim.verdict.startswith("by construction, within ")}
    assert near == {
        "high-resolution PWM: 150 ps of a period at 12 V [mV]",
        "step of 2 mm: mass [kg]",
        "step of 2 mm: friction [N s/m]",
        "load cell: A [N/A]",
        "load cell: k [rad/m]",
        "load cell: l [mm]",
    }
    assert rows["Fig. 10 as a transient: position control, highest [%]"].verdict.startswith("within 10 %")
    assert rows["pole of the motor between readings"].ours[0].startswith("0.509")
    assert all("–" not in claim.ours for claim in rows.values())


# Options, limits, refusals


@pytest.mark.slow
def test_electronics_are_options(controller: Controller) -> None:
    plant = plant_for(controller)
    few: dict[str, Any] = {"count": 2}
    usual = experiment("step", plant, controller, **few)
    assert usual.run.scenario.electronics is None
    for options, parts in (
        ({"pwm": "fine"}, Options("fine")),
        ({"adc_noise": False, "adc_steps": False}, Options(adc_noise=False, adc_steps=False)),
        ({"mean_of": 8, "current_loops": False}, Options(mean_of=8, current_loops=False)),
    ):
        asked: dict[str, Any] = options | few
        assert experiment("step", plant, controller, **asked).run.scenario.electronics == parts
    quiet = experiment("step", plant, controller, adc_noise=False, noise=0.0, **few)
    assert found(quiet, 0, "at rest, rms") < 0.5e-6 < 1e-6 < found(usual, 0, "at rest, rms")
    fast = experiment("step", plant, controller, fidelity="force", **few)
    assert (fast.run.scenario.fidelity, fast.run.i_phase.size) == ("force", 0)


def test_what_many_machines_fly_is_at_fidelity_force(controller: Controller) -> None:
    for name in ("step", "ramp"):
        wanted = cases_of(name, plant_for(controller), controller)
        assert {one.scenario.fidelity for one in wanted} == {"force"}


def _pressed(F_z: float, **changes: float) -> tuple[Plant, Controller]:
    """The LQG's machine with another vertical force, which the controller commutates for."""
    c = controller_of("halbach")
    par = replace(c.parameters, F_z=F_z, **changes)
    return malta.plant_of(par), replace(c, parameters=par)


@pytest.mark.slow
def test_limits_are_named_and_nothing_is_nan() -> None:
    hold = Scenario("hold", 1.1, malta.references.hold, fidelity="phase", noise=1.0, quantize=True)
    jump = replace(
        hold, reference=partial(move_reference, distance=20e-3, rise=0.0, begin=0.0), start={"x": 0.0}
    )
    for (plant, c), scenario, limit in (
        (_pressed(20.0), hold, "duty limit"),
        (_pressed(5.0), jump, "force limit"),
        (_pressed(60.0, V_dc=60.0), hold, "current range"),
    ):
        run = simulate(plant, c, scenario)
        assert limit in run.limits
        for series in (run.p, run.i_phase, run.duty, run.v):
            assert np.isfinite(series).all()
        assert np.abs(run.duty - 0.5).max() <= 0.5
    plant, c = _pressed(20.0)
    said = malta.report.limits_text(experiment("step", plant, c, count=1))
    assert said == ["met the duty limit: jumps, quintics"]
    pushed = replace(hold, duration=11.0, disturbance=lambda t: np.full((len(t), 1), 20.0))
    run = simulate(*_pressed(5.0), pushed)
    assert run.verdict.name == "left the travel"
    assert np.isfinite(run.p).all()


@pytest.mark.slow_for("force-options0")
@pytest.mark.parametrize(
    ("name", "options"), [("force", {"distance": 60e-3}), ("step", {"distance": 60e-3, "count": 1})]
)
def test_what_leaves_the_travel_is_shown(name: str, options: dict[str, Any], printed: dict[str, Any]) -> None:
    c = controller_of("halbach")
    e = experiment(name, plant_for(c), c, **options)
    assert e.failed
    assert "left the travel" in e.outcome
    malta.report.experiment_figure(e, printed)
    malta.report.experiment_table(e, printed)


BAD: tuple[tuple[str, dict[str, Any], str], ...] = (
    ("step", {"pwm": "coarse"}, "pwm: found 'coarse', expected one of exact, plain, fine"),
    ("step", {"mean_of": 0}, "mean_of: found 0, expected 1 to 4096 samples"),
    ("step", {"adc_noise": 1}, "step: adc_noise: found 1, expected true or false"),
    ("step", {"distance": 0.0}, "step: distance: found 0.0, expected finite, other than 0"),
    ("step", {"count": 0}, "step: count: found 0, expected 1 to 1000 steps"),
    ("step", {"rise": -1.0}, "rise: found -1.0 s"),
    ("step", {"speeds": (1e-3,)}, "step: speeds: found an option of another scenario, expected"),
    ("step", {"tilt": 1.0}, "step: tilt: found an unknown option, expected"),
    ("step", {"fidelity": "dq"}, "fidelity: found dq, expected one of force, phase for a halbach"),
    (
        "step",
        {"fidelity": "force", "pwm": "fine"},
        "electronics: found options of electronics at fidelity force",
    ),
    ("ramp", {"speeds": (1e-3, 0.0)}, "ramp: speeds: found (0.001, 0.0), expected above 0"),
    ("ramp", {"distance": 0.2}, "ramp: distance: found 0.2 m, expected at most 0.1 m"),
    ("identify", {"F_z": 1e9}, "identify: F_z: found 1e+09 N, expected above 0 and at most 10000 N"),
    ("budget", {"place": math.nan}, "budget: place: found nan, expected a finite number"),
    ("stroke", {}, "scenario: found 'stroke', expected one of step, ramp, stairs, force, budget, identify"),
)


@pytest.mark.parametrize(("name", "options", "sentence"), BAD, ids=lambda v: str(v)[:30])
def test_bad_options_are_refused_in_one_sentence(name: str, options: dict[str, Any], sentence: str) -> None:
    c = controller_of("halbach")
    with pytest.raises(malta.InputError) as caught:
        experiment(name, plant_for(c), c, **options)
    assert sentence in str(caught.value)
    assert str(caught.value).isprintable()


# The command line


GAINS = "design/gains/halbach.json"


@pytest.mark.slow
def test_design_makes_the_shipped_gain_files(run: Run, tmp_path: Path) -> None:
    designs = [f"design/{name}.toml" for name in DESIGNS]
    said = run("design", *designs, "--out", tmp_path, "--figures", tmp_path)
    assert (said.code, said.err) == (0, "")
    assert max(map(len, said.out.splitlines())) <= 100 + len(str(tmp_path))
    for name in DESIGNS:
        assert malta.gains.read(tmp_path / f"{name}.json").spec_sha256 == controller_of(name).spec_sha256
        assert (tmp_path / f"{name}_step.png").stat().st_size > 20_000


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_simulate_each_scenario(run: Run, tmp_path: Path, scenario: str) -> None:
    said = run("simulate", GAINS, "--scenario", scenario, "--out", tmp_path)
    assert (said.code, said.err) == (0, "")
    assert "fidelity phase" in said.out
    assert (tmp_path / f"halbach_{scenario}.png").stat().st_size > 20_000


def test_simulate_with_options_of_the_electronics(run: Run) -> None:
    said = run(
        "simulate",
        GAINS,
        "--option",
        "pwm=fine",
        "--option",
        "adc_noise=false",
        "--option",
        "count=2",
        "--json",
    )
    assert said.code == 0
    assert json.loads(said.out)["cases"][0]["merits"]["at_rest_rms_m"] < 0.5e-6
    said = run("simulate", GAINS, "--option", "pwm=coarse")
    assert (said.code, said.out) == (2, "")
    assert "pwm: found 'coarse', expected one of exact, plain, fine" in said.err


@pytest.mark.slow
def test_verify(run: Run) -> None:
    said = run("verify", GAINS, "--uncertain", "b=50%")
    assert (said.code, said.err) == (0, "")
    assert "Peak sensitivity" in said.out


@pytest.mark.slow
def test_claims(run: Run) -> None:
    said = run("claims", "design/halbach.toml", "--markdown")
    assert said.code == 0
    assert said.out.startswith("### halbach, L. C. Díaz-Pérez et al., Actuators 7(4), 2018")


@pytest.mark.slow
def test_campaign_of_a_few_machines(run: Run, tmp_path: Path) -> None:
    said = run(
        "campaign",
        GAINS,
        "--samples",
        "50",
        "--spread",
        "10%",
        "--spread",
        "k=1%",
        "--out",
        tmp_path,
        "--json",
    )
    assert said.code == 0, said.err
    content = json.loads(said.out)
    assert content["runs"] == 50
    assert content["ends"] == {"completed": 50}
    refused = run(
        "campaign", GAINS, "--samples", "5", "--option", "fidelity=phase", "--out", tmp_path / "other"
    )
    assert refused.code == 2
    assert "expected force in a campaign of a halbach" in refused.err
