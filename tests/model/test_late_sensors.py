"""Sensors that read late: their lag and dead time in simulations, linear loops, proofs and recovery."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from conftest import Run, one_sentence
from hypothesis import given, settings, strategies as st
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import malta
from malta.linear.closed_loops import instability
from malta.loops.parametric_loops import machine_system
from malta.loops.sampled_loops import machine_loop
from malta.loops.time_domain import recovery
from malta.margins.travel import travel_margin
from malta.model.linearize import linearize
from malta.model.plants import plant_of
from malta.model.sensors import Sensors, split_dead_time, with_lags
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.pid import axes_of
from malta.tuning.pid import close_loop, parts_of
from malta.tuning.pid_loop import loads_of, loop_figures, whole_machine
from malta.tuning.search import Effort, model_and_controller

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.simulation.trajectory import Trajectory

pytestmark = pytest.mark.usefixtures("proven_once")

GAINS = "design/gains/calibrated.json"
Ts = 50e-6


@pytest.fixture(scope="module")
def controller() -> malta.synthesis.Controller:
    return malta.gains.read(GAINS)


def late(controller: Any, **changes: float) -> Plant:
    return plant_of(replace(controller.parameters, **changes))


def stroke(controller: Any, engine: Any = "auto", fidelity: Any = "force", **changes: float) -> Trajectory:
    scenario = Scenario.stroke(10e-3, rise=16.2e-3, fidelity=fidelity, sensor_errors={"gain_x1": 0.01})
    return simulate(late(controller, e_x=2e-5, **changes), controller, scenario, engine=engine)


def radius(plant: Plant, controller: Any, current_loops: Any = "pi") -> float:
    loop = machine_loop(linearize(plant, plant.at(z=0.0)), controller, current_loops)
    return float(abs(np.linalg.eigvals(loop.closed)).max())


# --- simulation ---


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ["force", "dq", "phase"])
def test_both_engines_agree(controller: Any, fidelity: Any) -> None:
    own = {"tau_s": 3e-5, "T_s": 65e-6}
    one, two = (stroke(controller, engine, fidelity, **own) for engine in ("compiled", "virtual machine"))
    np.testing.assert_allclose(one.p, two.p, rtol=0, atol=1e-13)
    assert one.verdict.completed


@pytest.mark.slow
@pytest.mark.parametrize("dead_time", [3e-6, 40e-6, 50e-6, 80e-6, 150e-6])
def test_a_reading_is_as_old_as_the_dead_time(controller: Any, dead_time: float) -> None:
    """Between samples the motion is smooth: a spline through the true outputs is right to a nanometre."""
    run = stroke(controller, T_s=dead_time)
    before = CubicSpline(run.t, run.p * [1.01, 1, 1, 1, 1])(run.t - dead_time)
    np.testing.assert_allclose(run.y[20:, :4], before[20:, :4], rtol=0, atol=1e-9)
    if dead_time == 50e-6:
        np.testing.assert_allclose(run.y[1:, 1], run.p[:-1, 1], rtol=0, atol=1e-15)


@pytest.mark.slow
def test_a_reading_lags_by_the_time_constant(controller: Any) -> None:
    """s' = (p - s) / tau, solved on a fine grid through the true outputs; z has Hall sensors, without this lag."""
    tau, parts = 120e-6, 20
    run = stroke(controller, tau_s=tau)
    fine = np.linspace(0, run.t[-1], parts * (len(run.t) - 1) + 1)
    p = CubicSpline(run.t, run.p)(fine)
    left = np.exp(-Ts / parts / tau)
    s = p.copy()
    for k in range(1, len(p)):
        slope = (p[k] - p[k - 1]) / (Ts / parts)
        s[k] = p[k] - slope * tau * (1 - left) + left * (s[k - 1] - p[k - 1])
    np.testing.assert_allclose(run.y[:, 1:4], s[::parts, 1:4], rtol=0, atol=2e-9)
    assert abs(run.y[:, 1] - run.p[:, 1]).max() > 5e-9
    plain = simulate(
        late(controller, tau_s=tau), controller, Scenario.stroke(10e-3, rise=16.2e-3, fidelity="force")
    )
    assert (plain.y[:, 4] == plain.p[:, 4]).all()


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ["force", "dq"])
def test_no_lag_is_the_limit(controller: Any, fidelity: Any) -> None:
    prompt = stroke(controller, fidelity=fidelity)
    for changes in ({"tau_s": 1e-9}, {"T_s": 1e-9}):
        almost = stroke(controller, fidelity=fidelity, **changes)
        np.testing.assert_allclose(almost.p, prompt.p, rtol=0, atol=5e-9)
        assert (almost.p != prompt.p).any()


@pytest.mark.slow
def test_lanes_of_different_lags_are_the_runs_alone(controller: Any) -> None:
    lags = np.array([0.0, 1e-5, 2e-5, 5e-5, 1e-4])
    scenario = Scenario("hold", 0.02, malta.references.hold, noise=1.0, fidelity="force", substeps=4)
    batch = malta.simulation.simulate_many(late(controller, T_s=2e-5), controller, scenario, {"tau_s": lags})
    for k, lag in enumerate(lags.tolist()):
        own = simulate(late(controller, T_s=2e-5, tau_s=lag), controller, replace(scenario, run=k))
        np.testing.assert_allclose(abs(own.p).max(axis=0), batch.deviation[k], rtol=1e-7)


@pytest.mark.slow
def test_a_lag_may_come_on_the_way(controller: Any) -> None:
    changes = ((0.01, {"tau_s": 2e-4}),)
    hold = Scenario("hold", 0.03, malta.references.hold, start={"x": 5e-6}, changes=changes)
    run = simulate(late(controller), controller, hold)
    k = round(0.01 / Ts)
    np.testing.assert_allclose(run.y[:k], run.p[:k], rtol=0, atol=1e-15)
    assert abs(run.y[k + 1 :, 0] - run.p[k + 1 :, 0]).max() > 1e-8
    with pytest.raises(malta.InputError, match="shapes the machine's functions"):
        simulate(late(controller), controller, replace(hold, changes=((0.01, {"T_s": 1e-5}),)))


# --- linear loops and proofs ---


def test_dead_time_splits_into_samples_and_a_rest() -> None:
    assert split_dead_time(1.5e-4, Ts) == (3, 0.0)
    whole, rest = split_dead_time(1.2e-4, Ts)
    assert whole == 2
    assert rest == pytest.approx(2e-5)


@settings(deadline=None, max_examples=30)
@given(n=st.integers(1, 4), p=st.integers(1, 3), seed=st.integers(0, 2**32 - 1))
def test_lags_multiply_the_transfer_function(n: int, p: int, seed: int) -> None:
    """C (s - A)^-1 B of the longer system is 1 / (lag s + 1) of the shorter one's row, at any s."""
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, 2)), rng.normal(size=(p, n))
    lag = tuple(float(rng.choice([0.0, rng.uniform(0.1, 2)])) for _ in range(p))
    longer = [np.array(ca.DM(M)) for M in with_lags(Sensors(lag, 0.0), A, B, C)]
    s = complex(*rng.normal(size=2)) * 3
    short = C @ np.linalg.solve(s * np.eye(n) - A, B)
    found = longer[2] @ np.linalg.solve(s * np.eye(len(longer[0])) - longer[0], longer[1])
    np.testing.assert_allclose(found, short / (np.array(lag)[:, None] * s + 1), rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_stability_is_lost_at_the_lag_that_the_linear_loop_says(controller: Any) -> None:
    """The spectral radius crosses 1 at some lag; the simulated machine rings below it and touches down beyond it."""
    critical = brentq(lambda tau: radius(late(controller, tau_s=tau), controller) - 1, 1e-5, 5e-3, rtol=1e-4)
    assert 3e-4 < critical < 5e-3
    ends = []
    for share in (0.93, 1.07):
        scenario = Scenario("hold", 0.5, malta.references.hold, start={"x": 2e-6, "alpha": 1e-5})
        run = simulate(late(controller, tau_s=share * critical, F_c=0.0), controller, scenario)
        ends.append(float(abs(run.p[-2000:, :4]).max()))
    assert ends[0] < 1e-6
    assert ends[1] > 5e-6


@pytest.mark.slow
def test_dead_time_of_a_sample_is_a_sample_of_delay(controller: Any) -> None:
    """With lagging currents; current controllers read currents at once, and feel a delay of the voltages alone."""
    one, two = late(controller, T_s=Ts), late(controller, T_d=2.5 * Ts)
    assert radius(one, controller, "lag") == pytest.approx(radius(two, controller, "lag"), rel=1e-12)
    for plant, delay in ((one, 1), (two, 2)):
        assert machine_system(plant, controller, ["m"], {"z": 0.0}, "lag")[1].delay == 2
        assert machine_system(plant, controller, ["m"], {"z": 0.0})[1].delay == delay


@pytest.mark.slow
def test_the_proven_loop_is_the_loop_that_is_verified(controller: Any) -> None:
    """The uncertain system at its nominal values has the poles of the sampled loop under its loads, lag and all."""
    plant = late(controller, tau_s=2e-4, T_s=Ts)
    system, law = machine_system(plant, controller, ["m", "tau_s"], {"z": 0.0})
    rate = float(instability(system, law, system.nominal[None])[0])
    assert rate == pytest.approx(np.log(radius(plant, controller)) / Ts, rel=1e-6)
    assert system.matrices.size1_out(0) == 10 + 4 + 5


@pytest.mark.slow
def test_a_lag_costs_margin_and_the_proof_has_it(controller: Any) -> None:
    box = {"K_A": 0.2, "K_B": 0.2}
    prompt, slow = (travel_margin(late(controller, tau_s=tau), controller, box) for tau in (0.0, 3e-4))
    assert prompt.lower is not None
    assert slow.lower is not None
    assert slow.upper < prompt.lower
    assert slow.lower > 0.97 * slow.upper


def test_an_uncertain_lag_of_nothing_is_refused(controller: Any) -> None:
    """It has no state in the model: leaving it out would prove too much."""
    with pytest.raises(malta.InputError, match="an uncertain lag of 0 s"):
        travel_margin(late(controller), controller, {"tau_s": (0.0, 1e-4)})


@pytest.mark.slow
def test_the_lag_itself_may_be_uncertain(controller: Any) -> None:
    found = travel_margin(late(controller, tau_s=3e-4), controller, {"tau_s": (1e-4, 3.1e-4)})
    assert found.lower is not None
    assert found.lower > 0.7  # 1.49985 on a quiet machine; the proof ends by the clock
    assert found.lower <= found.upper


@pytest.mark.slow
def test_recovery_is_of_the_true_outputs(controller: Any) -> None:
    """The linear answer to 0.1 N against the simulated one, behind a lag that shows."""
    plant = late(controller, tau_s=3e-4, T_s=Ts, g=0.0, F_c=0.0)
    flat = replace(controller, feedforward=replace(controller.feedforward, v0=0 * controller.feedforward.v0))
    (answer,) = recovery(plant, flat, {"push": {"F_x": 0.1}})
    hold = Scenario(
        "hold", 0.05, malta.references.hold, disturbance=lambda t: np.tile([0.1, 0, 0, 0, 0, 0], (len(t), 1))
    )
    run = simulate(plant, flat, hold)
    largest = abs(run.p[:, [0, 2]]).max(axis=0)
    np.testing.assert_allclose(
        [d.largest for d in answer.outputs if d.output in ("x1", "x2")], largest, rtol=2e-3
    )
    (prompt,) = recovery(late(controller, g=0.0, F_c=0.0), flat, {"push": {"F_x": 0.1}})
    assert answer.outputs[0].compliance > prompt.outputs[0].compliance * (1 + 5e-4)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_search_of_pid_gains_sees_the_loop_of_late_sensors(share: float) -> None:
    """Lags, and dead times of whole samples and of parts: figures of a trial are those of the machine's own loop."""
    spec = malta.read_design("design/tubular_pid.toml")
    slow = replace(spec, parameters=replace(spec.parameters, tau_s=1e-5, T_s=share * spec.sample_time))
    model, controller = model_and_controller(slow)
    loop, axes = malta.loop(slow.plant, controller).sampled, axes_of(model, slow.axes)
    whole, Ts = whole_machine(model, controller, loads_of(slow)), slow.sample_time
    prompt = malta.loop(spec.plant, controller).sampled
    known, quick = loop_figures(slow, whole, loop), dict[str, float]()
    assert slow.pid is not None
    for part in parts_of(whole):
        quick |= loop_figures(slow, part, close_loop(part, slow.pid, Ts, axes))
    assert quick == {name: pytest.approx(value, rel=1e-6) for name, value in known.items() if name in quick}
    assert len(quick) > 10
    before = loop_figures(spec, whole_machine(*model_and_controller(spec), loads_of(spec)), prompt)
    assert known["peak_sensitivity x1"] > 1.01 * before["peak_sensitivity x1"]


@pytest.mark.slow
def test_tune_takes_a_pid_whose_sensors_read_late() -> None:
    spec = malta.read_design("design/tubular_pid.toml")
    between = replace(spec, parameters=replace(spec.parameters, T_s=0.4 * spec.sample_time))
    with pytest.raises(malta.InputError, match=r"whole samples of 50 us in a proof with PI current loops"):
        malta.tune(between)  # before it searches
    slow = replace(spec, parameters=replace(spec.parameters, tau_s=1e-5, T_s=spec.sample_time))
    tuned = malta.tune(slow, effort=Effort(generations=0, polish=3, front=0))
    judged = {one.name: one.found for one in tuned.requirements}
    assert judged["peak_sensitivity"] == pytest.approx(
        max(v for k, v in tuned.trial.figures.items() if k.startswith("peak_sensitivity")), rel=1e-3
    )


# --- command line ---


@pytest.mark.slow
def test_verify_takes_lag_and_dead_time_but_proves_whole_samples_with_pi_loops(run: Run) -> None:
    said = run("verify", GAINS, "--set", "tau_s=0.2ms", "--no-proof", "--json")
    assert said.code == 0, said.err
    prompt = json.loads(Path(GAINS).read_text(encoding="utf-8"))["verification"]["peak_sensitivity"]["x1"]
    assert json.loads(said.out)["peak_sensitivity"]["machine"]["x1"] > 1.01 * prompt
    said = run("verify", GAINS, "--set", "T_s=10us", "--no-proof")
    assert said.code == 2
    assert "sensors.dead_time: found 10 us" in one_sentence(said.err)
    assert run("simulate", GAINS, "--set", "T_s=10us", "--json").code == 0
