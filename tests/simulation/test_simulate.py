"""The harness: linear at small amplitude, an independent integrator, limits, verdicts, noise."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from scipy import linalg
from scipy.integrate import solve_ivp

import malta
from malta import references
from malta.loops.sampled_loops import sampled_loop
from malta.merit_lists import by_identifier
from malta.merits import Merit
from malta.simulation.experiments import Case, Experiment
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.inputs import feedforward
from malta.simulation.period import state_reference
from malta.simulation.scenario import Scenario
from malta.simulation.trajectory import Verdict, bearing_verdict
from malta.simulation.trajectory_file import save
from malta.synthesis.linear_law import linear_law

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.plant import Plant

SP1 = {"x1": 1e-6, "y1": -0.7e-6, "x2": 0.4e-6, "y2": 0.9e-6}


def _held(name: str, samples: int, start: dict[str, float] | None = None, **outputs: float) -> Scenario:
    duration = samples * 50e-6
    return Scenario(
        name, duration, lambda plant: references.hold(plant, **outputs), start or {}, fidelity="force"
    )


def _stroke(distance: float = 10e-3, **options: Any) -> Scenario:
    """The stroke on first-order current loops: what linear theory and independent integrators are compared with."""
    return Scenario.stroke(distance, **{"fidelity": "force"} | options)


def _linear_response(design: Design, moved: dict[str, float], samples: int, delay: int) -> FloatArray:
    """Outputs after a step of the reference: the plant at its gravity trim under a hold, exactly; v0(z) with its
    slope; the law by its derivatives."""
    c, plant = design.controller, design.plant
    model = malta.linearize(plant, malta.trim(plant, z=0.0))
    stage = sampled_loop(model, c, delay=delay, current_loops="lag")
    grid, table = c.feedforward.z_grid, c.feedforward.v0
    middle = len(grid) // 2
    slope = np.zeros((5, 5))
    slope[:, 4] = (table[middle + 1] - table[middle]) / (grid[middle + 1] - grid[middle])  # dv0/dy
    law = linear_law(c)
    B_v0, D_v0 = law.B_r[:, -5:] @ slope, law.D_r[:, -5:] @ slope
    p_ref = np.array([moved.get(s.name, 0.0) for s in plant.outputs])
    xi_ref = np.zeros(10)
    xi_ref[:5] = np.array(plant.position_of(ca.DM(p_ref))).ravel()
    r = np.concatenate([p_ref, xi_ref, np.zeros(10)])
    x, s = np.zeros(len(stage.Ad)), np.zeros(15)
    response = np.empty((samples, 5))
    for k in range(samples):
        y = response[k] = stage.Cd @ x
        v = law.C @ s + (law.D_y + D_v0) @ y + law.D_r @ r
        s = law.A @ s + (law.B_y + B_v0) @ y + law.B_r @ r
        x = stage.Ad @ x + stage.Bd @ v
    return response


@pytest.mark.slow_for("table2-radial-0")
@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(
    ("moved", "axes"), [(SP1, [0, 1, 2, 3]), ({"z": 1e-6}, [4])], ids=["radial", "axial"]
)
def test_small_motions_are_the_linear_loops(
    design: Design, moved: dict[str, float], axes: list[int], delay: int
) -> None:
    """A step of 1 um: what moves equals the linear sampled loop's response to 1e-6 of its size.

    The other axes are moved in second order only (tilted attraction pulls axially: 7 pm here), so a thousandth of the
    step leaves them a millionth, and all five outputs agree to 1e-6.
    """
    samples, centre = 1000, dict.fromkeys(("x", "y", "z", "alpha", "beta"), 0.0)
    for scale, compared in ((1.0, axes), (1e-3, [0, 1, 2, 3, 4])):
        step = {name: scale * value for name, value in moved.items()}
        scenario = replace(_held("step", samples, centre, **step), delay=delay)
        run = malta.simulate(design.plant, design.controller, scenario)
        linear = _linear_response(design, step, samples, delay)
        size = np.abs(linear).max()
        assert size > 0.03e-6 * scale
        assert np.abs(run.p - linear)[:, compared].max() < 1e-6 * size


def _independent_stroke(plant: Plant, design: Design, samples: int, delay: int) -> FloatArray:
    """The same loop in numpy, every sample integrated by scipy's DOP853 to 1e-12."""
    c, w_c = design.controller, design.plant.actuator.crossover
    x_, u_ = ca.SX.sym("x", 12), ca.SX.sym("u", 5)
    rate = ca.Function("rate", [x_, u_], [plant.f(x_, u_, plant.load(x_))])
    output = ca.Function("output", [x_], [plant.h(x_, u_)])
    t = np.arange(samples) * c.sample_time
    motion = references.stroke(plant, -5e-3, 5e-3, 16.2e-3, 0.05)(t)
    v_ff = feedforward(c, motion)
    xi_ref = np.array(
        [np.array(state_reference(plant)(p, dp)).ravel() for p, dp in zip(*motion[:2], strict=True)]
    )
    start = plant.at(z=motion.p[0, 4], z_dot=motion.dp[0, 4]).x

    def v0_at(z: float) -> FloatArray:
        return np.array([np.interp(z, c.feedforward.z_grid, column) for column in c.feedforward.v0.T])

    x, force = start.copy(), v0_at(start[2])
    xi_pred, e = start[list(plant.controlled)].copy(), np.zeros(5)
    queue = [force.copy()] * delay
    trace = np.empty((samples, 12))
    for k in range(samples):
        trace[k] = x
        y = np.array(output(x)).ravel()
        e = e + c.sample_time * (motion.p[k] - y)
        xi_hat = xi_pred + c.L @ (y - c.Cd @ xi_pred)
        v0 = v0_at(y[4])
        v = c.K @ (xi_ref[k] - xi_hat) + c.Ki @ e + v_ff[k] + v0
        assert (np.abs(v) < c.limits.force).all()
        xi_pred = c.Ad @ xi_hat + c.Bd @ (v - v0)
        queue.append(v)
        acting, initial = queue.pop(0), force

        def lagged(time: float, acting: FloatArray = acting, initial: FloatArray = initial) -> FloatArray:
            return acting + (initial - acting) * math.exp(-w_c * time)

        def field(time: float, state: FloatArray, lagged: Any = lagged) -> FloatArray:
            return np.array(rate(state, lagged(time))).ravel()

        solved = solve_ivp(field, (0, c.sample_time), x, method="DOP853", rtol=1e-12, atol=1e-16)
        x, force = solved.y[:, -1], lagged(c.sample_time)
    return trace


@pytest.mark.slow_for("1")
@pytest.mark.parametrize("delay", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_stroke_equals_an_independent_integration(designs: dict[str, Design], delay: int) -> None:
    design = designs["calibrated"]
    run = malta.simulate(design.plant, design.controller, replace(_stroke(10e-3), delay=delay))
    samples = 1500  # past the stroke
    trace = _independent_stroke(design.plant, design, samples, delay)
    assert np.abs(run.x[:samples, :3] - trace[:, :3]).max() < 1e-9
    assert np.abs(run.x[:samples, 3:5] - trace[:, 3:5]).max() < 1e-9
    assert trace[-1, 2] > 4.9e-3


def test_the_integrator_has_fourth_order(designs: dict[str, Design]) -> None:
    """One Runge–Kutta step a sample errs by less than 0.1 nm; each halving divides the error by about 16."""
    design = designs["calibrated"]
    runs = {
        n: malta.simulate(design.plant, design.controller, replace(_stroke(10e-3), substeps=n)).x[:, :5]
        for n in (1, 2, 16)
    }
    first, second = (np.abs(runs[n] - runs[16]).max() for n in (1, 2))
    assert first < 1e-10
    assert first / second > 8


@pytest.mark.slow_for("1", "3")
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_design_with_delay_tracks_on_a_machine_with_that_delay(
    designs: dict[str, Design], delay: int
) -> None:
    design = designs["calibrated"]
    c = malta.lqg(design.model, design.spec.weights, 50e-6, "sampled-data", delay)
    run = malta.simulate(design.plant, c, _stroke(10e-3))
    figures = stroke_figures(run)
    assert run.verdict.completed
    assert run.xi_hat.shape == (2000, 10 + 5 * delay)
    assert figures.axial_error < 0.3e-3
    if delay:  # the stored forces that the observer holds are the ones that were sent
        stored = run.xi_hat[delay:, 10:15]
        sent = (
            run.v[:-delay]
            - np.array([np.interp(run.y[:-delay, 4], c.feedforward.z_grid, v) for v in c.feedforward.v0.T]).T
        )
        assert stored == pytest.approx(sent, abs=1e-9)


def test_figures_of_a_run_say_what_they_are_and_what_is_better(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    run = malta.simulate(design.plant, design.controller, _stroke(10e-3))
    found, stroke = by_identifier(run.figures), by_identifier(stroke_figures(run).figures)
    off = np.abs(run.p - run.reference).max(axis=0)
    assert [found[f"largest_deviation_{s.name}_m"].value for s in run.plant.outputs] == off.tolist()
    assert stroke["axial_error_m"].value == found["largest_deviation_z_m"].value
    assert (stroke["rise_s"].relation, stroke["overshoot_share"].relation) == ("about", "at most")
    nearest = found["nearest_contact_share"]
    assert (nearest.value, nearest.bound, nearest.better) == (run.contact.max(), 1.0, "low")
    own = Merit("efficiency", 0.5, "percent", better="high")
    figures = Experiment("stroke", "Does it follow?", (Case("stroke", run, (own,)),), (own,)).figures
    assert [one.identifier for one in figures] == ["stroke_completed_share", "stroke_efficiency_share"]
    assert [(one.value, one.better) for one in figures] == [(1.0, "high"), (0.5, "high")]


def test_noise_is_the_machines_and_repeats_with_its_seed(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    scenario = replace(_held("hold", 4000), noise=1.0)
    run = malta.simulate(design.plant, design.controller, scenario)
    noise = run.y - run.p
    assert noise.std(axis=0) == pytest.approx(design.plant.sensors.noise, rel=0.05)
    again = malta.simulate(design.plant, design.controller, scenario)
    assert np.array_equal(run.y, again.y)
    other = malta.simulate(design.plant, design.controller, replace(scenario, seed=1))
    assert not np.array_equal(run.y, other.y)


def test_the_noise_of_a_hold_is_what_the_linear_loop_predicts(designs: dict[str, Design]) -> None:
    """True motion under sensor noise against the covariance of the closed loop (a Lyapunov equation)."""
    design = designs["calibrated"]
    stage = sampled_loop(design.model, design.controller, delay=1, current_loops="lag")
    A = stage.closed
    B = np.vstack([stage.Bd @ stage.control.D_y, stage.control.B_y])
    C = np.hstack([stage.Cd, np.zeros((5, len(stage.control.A)))])
    W = B @ np.diag(np.square(design.plant.sensors.noise)) @ B.T
    predicted = np.sqrt(np.diag(C @ linalg.solve_discrete_lyapunov(A, W, method="bilinear") @ C.T))
    run = malta.simulate(design.plant, design.controller, replace(_held("hold", 40_000), noise=1.0, delay=1))
    found = np.sqrt((run.p[4000:] ** 2).mean(axis=0))
    assert found == pytest.approx(predicted, rel=0.25)  # slow loops: few independent samples in two seconds
    assert predicted[:4].max() < 0.3e-6


def test_radial_sensors_resolve_one_micrometre(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    run = malta.simulate(design.plant, design.controller, _stroke(10e-3, noise=1.0, quantize=True))
    steps = run.y[:, :4] / 1e-6
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert run.verdict.completed


def test_forces_are_limited_and_the_integrals_wait(designs: dict[str, Design]) -> None:
    """A drive weak enough to saturate still arrives, and its integral does not wind up meanwhile."""
    design = designs["calibrated"]
    c = design.controller
    weak = replace(c, limits=replace(c.limits, force=np.array([26.0, 26, 26, 26, 18])))
    run = malta.simulate(design.plant, weak, _stroke(10e-3, duration=0.4))
    assert run.saturated[:, 4].any()
    assert np.abs(run.v[:, 4]).max() == 18
    assert run.verdict.completed
    assert abs(run.p[-1, 4] - 5e-3) < 20e-6
    assert not run.saturated[:, :4].any()


def test_currents_are_what_the_controller_believes_and_forces_what_the_machine_makes_of_them(
    designs: dict[str, Design],
) -> None:
    design = designs["calibrated"]
    stronger = malta.plant_of(replace(design.spec.parameters, K_D=5.2 * 1.1))
    run = malta.simulate(stronger, design.controller, _stroke(10e-3, delay=0))
    assert run.current[:, 4] == pytest.approx(run.v[:, 4] / 10.4)
    lagged = 1 - math.exp(-3000 * 50e-6)
    expected = run.force[:-1, 4] + lagged * (1.1 * run.v[:-1, 4] - run.force[:-1, 4])
    assert run.force[1:, 4] == pytest.approx(expected, abs=1e-9)


def test_a_force_step_is_held_off(designs: dict[str, Design]) -> None:
    """1 N sideways at the centre of gravity: the integrals bring the mover back; the stiffness is the linear one's."""
    design = designs["calibrated"]

    def push(t: FloatArray) -> FloatArray:
        wrench = np.zeros((len(t), 6))
        wrench[t >= 0.01, 0] = 1.0
        return wrench

    scenario = replace(_held("push", 12_000), disturbance=push)
    run = malta.simulate(design.plant, design.controller, scenario)
    deflection = run.x[:, 0]
    assert not deflection[:200].any()
    assert deflection.max() > 10e-6
    assert abs(deflection[-1]) < 0.05 * deflection.max()
    assert run.v[-1, [0, 2]].sum() == pytest.approx(-1.0, abs=0.05)


def test_touchdown_ends_the_run_with_its_name_and_time(designs: dict[str, Design]) -> None:
    design = designs["table2"]
    heavy = malta.plant_of(replace(design.spec.parameters, m=0.56))
    run = malta.simulate(heavy, design.controller, _stroke(10e-3))
    assert run.verdict.name == "touchdown at sensor plane 1"
    assert run.verdict.time == run.t[-1] < 0.1
    reach = np.hypot(run.p[:, 0], run.p[:, 1])
    assert reach[-1] >= 0.6e-3
    assert (reach[:-1] < 0.6e-3).all()
    assert len(run.x) == len(run.t) == len(run.v)
    assert math.isnan(stroke_figures(run).rise)


def test_the_end_stop_has_a_name(designs: dict[str, Design]) -> None:
    design = designs["table2"]

    def shove(t: FloatArray) -> FloatArray:
        return np.tile([0, 0, 200.0, 0, 0, 0], (len(t), 1))

    run = malta.simulate(design.plant, design.controller, replace(_held("shove", 4000), disturbance=shove))
    assert run.verdict.name == "axial end stop"


def test_divergence_has_a_name(designs: dict[str, Design]) -> None:
    """The mover's clearance widened until numbers end first."""
    design = designs["table2"]
    endless = malta.plant_of(replace(design.spec.parameters, r_max=1e300, z_max=1e300, K_A=1e6))
    run = malta.simulate(endless, design.controller, _held("fall", 20_000, {"y": 1e-4}))
    assert run.verdict.name == "diverged"
    assert 0 < run.verdict.time < 1
    assert np.isfinite(run.x[:-1]).all()


def test_a_run_that_is_no_multiple_of_a_block(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    whole = malta.simulate(design.plant, design.controller, _stroke(10e-3))
    for samples in (1, 7, 251, 1999):
        part = malta.simulate(
            design.plant, design.controller, replace(_stroke(10e-3), duration=samples * 50e-6)
        )
        assert len(part.t) == samples
        assert np.array_equal(part.x, whole.x[:samples])


def test_scenarios_that_do_not_fit_are_refused(designs: dict[str, Design]) -> None:
    design = designs["table2"]
    with pytest.raises(malta.InputError, match="duration"):
        _stroke(duration=-1.0)
    with pytest.raises(malta.InputError, match="noise"):
        _stroke(noise=math.nan)
    with pytest.raises(malta.InputError, match="delay"):
        _stroke(delay=-1)
    with pytest.raises(malta.InputError, match=r"start: found -0\.02 m"):
        malta.simulate(design.plant, design.controller, _stroke(40e-3))
    wrong = replace(_held("push", 10), disturbance=lambda t: np.zeros((len(t), 3)))
    with pytest.raises(malta.InputError, match=r"disturbance: found shape \(10, 3\)"):
        malta.simulate(design.plant, design.controller, wrong)
    with pytest.raises(malta.InputError, match="an unknown state"):
        malta.simulate(design.plant, design.controller, _held("start", 10, {"q": 1.0}))


def test_the_saved_series_read_back(designs: dict[str, Design], tmp_path: Path) -> None:
    design = designs["calibrated"]
    run = malta.simulate(design.plant, design.controller, _stroke(10e-3, duration=0.01))
    path = save(run, tmp_path / "deep" / "run.npz")
    with np.load(path) as archive:
        assert np.array_equal(archive["p"], run.p)
        assert archive["p_columns"].tolist() == ["x1 [m]", "y1 [m]", "x2 [m]", "y2 [m]", "z [m]"]
        assert archive["verdict"].tolist() == ["completed"]


def test_the_machine_limits_its_own_currents(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    weak = malta.plant_of(replace(design.spec.parameters, I_max=2.0))
    run = malta.simulate(weak, design.controller, _stroke(10e-3))
    assert np.abs(run.v[:, 4]).max() > 2 * 10.4
    assert np.abs(run.force[:, 4]).max() <= 2 * 10.4


def test_a_slow_stroke_is_given_its_time(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    run = malta.simulate(design.plant, design.controller, _stroke(10e-3, rise=0.05))
    assert run.t[-1] == pytest.approx(0.3, abs=1e-4)
    assert run.reference[[0, -1], 4] == pytest.approx([-5e-3, 5e-3], abs=1e-7)
    assert stroke_figures(run).rise == pytest.approx(0.05, rel=0.02)


def test_a_run_beyond_all_memory_is_refused(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    with pytest.raises(malta.InputError, match="duration: found 20000000 samples, expected at most 4000000"):
        malta.simulate(design.plant, design.controller, replace(_stroke(10e-3), duration=1000.0))


def test_bearings_carry_the_mover_and_the_end_of_the_travel_does_not(design: Design) -> None:
    """With bearings only the end of the travel ends a run; a mover that rests on them to the end has not lifted."""
    plant, start = design.plant, {"z": 14.9e-3, "z_dot": 3.0}
    engines: tuple[Any, ...] = ("auto", "virtual machine")
    for bearing, engine in product((False, True), engines):
        scenario = Scenario("slide", 4e-3, references.hold, start, fidelity="force", bearing=bearing)
        run = malta.simulate(plant, design.controller, scenario, engine=engine)
        assert run.verdict.name == plant.contacts.names[2]
        assert run.t[-1] == run.verdict.time < 1e-3
    t, free, resting = np.arange(4.0), [0.2, 0.0, 0.0], [1.2, 0.0, 0.0]
    found = bearing_verdict(plant, np.array([resting, resting, free, resting]), t)
    assert found == Verdict("not lifted", 3.0)
    assert bearing_verdict(plant, np.array([resting, resting, free, free]), t) is None
    assert bearing_verdict(plant, np.array([free, resting, free, free]), t) == Verdict(
        plant.contacts.names[0], 1.0
    )
