"""Currents that are held between samples, forces of disturbance, PID laws: what all machines share."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

import malta
from malta import gains
from malta.linear.closed_loops import closed_loop
from malta.linear.open_loops import responses
from malta.linear.sampling import sample
from malta.linear.uncertain import UncertainSystem
from malta.loops.own_model import unstable_gain
from malta.loops.parametric_loops import machine_system
from malta.loops.sampled_laws import sampled_law
from malta.loops.sampled_loops import machine_loop, sampled_loop
from malta.loops.uncertain_models import uncertain
from malta.loops.windings import left_out
from malta.margins.travel import travel_margin
from malta.margins.verify import linear_report
from malta.model.linearize import LinearModel
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.references import Motion
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller
from malta.synthesis.design_models import between_samples, sampled_model
from malta.synthesis.linear_law import linear_law
from malta.synthesis.lqg import lqg
from malta.synthesis.pid import pid
from malta.synthesis.separation import controller_poles
from malta.synthesis.spec import Pid
from malta.synthesis.weighting import Weights

ROOT = Path(__file__).parents[2]


@cache
def _plant(machine: str, **changes: float) -> Plant:
    par = malta.read(ROOT / "data" / f"{machine}.toml")
    return plant_of(replace(par, **changes))


@cache
def _model(machine: str, **changes: float) -> LinearModel:
    plant = _plant(machine, **changes)
    return malta.linearize(plant, plant.at())


def _weights(machine: str, *, drift: bool = True) -> Weights:
    if machine == "halbach":
        own = {"q": [1.0, 0.0], "q_base": [10e-6, 1.0], "r": [1.0], "r_base": [5e-3]}
        noise = {"process_variance": [1e-5], "sensor_variance": [1.3e-14]}
        return _made(own | noise, 1, [1e-6] if drift else [])
    own = {"q": [1.0] * 6 + [0.0] * 6, "q_base": [1e-6] * 3 + [1e-5] * 3 + [1.0] * 6}
    own |= {"r": [1.0] * 6, "r_base": [10.0] * 3 + [1.0] * 3}
    noise = {"process_variance": [1.0] * 3 + [0.01] * 3, "sensor_variance": [4e-16] * 3 + [1e-14] * 3}
    return _made(own | noise, 6, [1e-2] * 3 + [1e-4] * 3 if drift else [])


def _made(given: dict[str, list[float]], outputs: int, drift: list[float]) -> Weights:
    arrays: Any = {name: np.array(values) for name, values in given.items()}
    q_i = np.zeros(outputs) if drift else np.ones(outputs)
    return Weights(
        **arrays, q_i=q_i, q_i_base=np.full(outputs, 1e-5), drift_variance=np.array(drift, dtype=float)
    )


@cache
def _controller(machine: str, delay: int, *, drift: bool = True, **changes: float) -> Controller:
    model = _model(machine, **changes)
    Ts = 55e-3 if machine == "halbach" else 200e-6
    return lqg(model, _weights(machine, drift=drift), Ts, "sampled-data", delay)


def _still(plant: Plant) -> Any:
    def at(t: Any) -> Motion:
        zero = np.zeros((len(t), len(plant.outputs)))
        return Motion(zero, zero, zero)

    return at


# The held spring


def test_held_angle_is_a_spring_of_k_F_z() -> None:
    """E = k F_z / m; the eigenvalue of the sampled motor at 5 N is 0.509, with friction alone 0.871."""
    par: Any = _plant("halbach").parameters
    model = _model("halbach")
    assert model.E.ravel() == pytest.approx([0, par.k * par.F_z / par.m], rel=1e-12)
    Ad, Bd, _ = sampled_model(model, par.T_laser)
    assert np.sort(np.linalg.eigvals(Ad)) == pytest.approx([0.509, 1.0], abs=1e-3)
    free, _ = sample(model.A, model.B, par.T_laser)
    assert np.sort(np.linalg.eigvals(free)) == pytest.approx([0.871, 1.0], abs=5e-4)
    assert Bd.shape == (2, 1)


@pytest.mark.parametrize("delay", [0, 1])
def test_simulation_and_linear_loop_agree(delay: int) -> None:
    """The linear loop with hold, held currents, lag and delay, iterated: the simulated motor, let go 1 nm off."""
    late = {"latency": float(delay)}
    plant, c, model = (
        _plant("halbach", **late),
        _controller("halbach", delay, **late),
        _model("halbach", **late),
    )
    exact = sampled_loop(model, c, delay=delay, current_loops="lag")
    run = simulate(
        plant, c, Scenario("let go", 1.0, _still, start={"x": 1e-9}, fidelity="force", substeps=64)
    )
    n = len(exact.Ad)
    state = np.zeros(len(exact.closed))
    state[0] = state[n] = 1e-9  # where it is, and where the observer takes it to be
    state[2:n] = [0.0, 1e-9] * (1 + delay)  # no force, and currents that were commutated for it
    state[n + 2 : n + 2 + delay] = between_samples(model).H.item() * 1e-9  # which it knows
    seen = []
    for _ in range(len(run.t)):
        seen.append(state[0])
        state = exact.closed @ state
    assert np.array(seen) == pytest.approx(run.x[:, 0], abs=1e-15)
    assert np.abs(np.linalg.eigvals(exact.closed)).max() < 1


def test_commutation_that_follows_leaves_the_tilt_stiffness_alone() -> None:
    """In x, y, z nothing is left of the field's stiffness; in tilt, which the sensors' commutation ignores, all."""
    A = _model("planar").A[6:, :6]
    assert np.abs(A[:, :3]).max() < 1e-9 * np.abs(A).max()
    assert np.diag(A)[3:5] == pytest.approx([-1477.5, -1477.5], rel=1e-3)
    assert A[5, 5] > 0


def test_a_wrong_motor_constant_scales_forces_and_spring() -> None:
    plant, wrong = _plant("halbach"), _plant("halbach", A=1.2 * 1.6067)
    model = malta.linearize(wrong, wrong.at(), plant)
    own = _model("halbach")
    for found, expected in ((model.B, 1.2 * own.B), (model.E, 1.2 * own.E), (model.A, own.A)):
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-9)


def test_a_ramp_takes_a_force_and_passes_the_readings_at_another_speed() -> None:
    """Steady 2 mm/s: the error at the readings is below 1 nm, with rate and speed of the feedforward, 10 um without."""
    plant, c = _plant("halbach"), _controller("halbach", 0)

    def ramp(_: Plant) -> Any:
        def at(t: Any) -> Motion:
            p = (2e-3 * np.asarray(t) - 0.02)[:, None]
            return Motion(p, np.full_like(p, 2e-3), np.zeros_like(p))

        return at

    quiet = Scenario("ramp", 15.0, ramp, fidelity="force", substeps=64)
    run = simulate(plant, c, quiet)
    assert np.abs((run.p - run.reference)[-20:]).max() < 3e-9
    plain = replace(c.feedforward, rate=0 * c.feedforward.rate, speed=0 * c.feedforward.speed)
    without = simulate(plant, replace(c, feedforward=plain), quiet)
    assert np.abs((without.p - without.reference)[-20:]).max() > 1e-6


# Forces of disturbance


@pytest.mark.slow_for("planar-1")
@pytest.mark.parametrize(("machine", "delay"), [("halbach", 0), ("halbach", 1), ("planar", 1), ("planar", 2)])
def test_regulator_and_filter_are_stable_by_the_separation_principle(machine: str, delay: int) -> None:
    """The poles of the law on its own model are those of regulator and filter, whatever stands between."""
    c = _controller(machine, delay)
    assert c.observed == 1
    assert c.delay == delay
    assert not c.integrating
    regulator, observer = controller_poles(c)
    assert unstable_gain(c) is None
    # x+ = Ad x + Bd v, y = Cd x on the model without the disturbances, which are the filter's alone
    k = len(c.Ad) - len(c.forces)
    law = linear_law(c)
    plant = np.block(
        [[c.Ad[:k, :k] + c.Bd[:k] @ law.D_y @ c.Cd[:, :k], c.Bd[:k] @ law.C], [law.B_y @ c.Cd[:, :k], law.A]]
    )
    expected = np.concatenate([regulator, observer])
    found = np.linalg.eigvals(plant)
    for pole in expected:
        assert np.abs(found - pole).min() < 1e-5


@pytest.mark.slow_for("planar-50.0")
@pytest.mark.parametrize(("machine", "push"), [("halbach", 0.3), ("planar", 50.0)])
def test_a_constant_force_is_taken_off_without_integrals(machine: str, push: float) -> None:
    plant = _plant(machine)
    delay = plant.actuator.delay(55e-3 if machine == "halbach" else 200e-6)
    c = _controller(machine, delay)

    def wrench(t: Any) -> Any:
        w = np.zeros((len(t), len(plant.disturbances)))
        w[:, 0] = push
        return w

    samples = 200 if machine == "halbach" else 900
    scenario = Scenario(
        "push", samples * c.sample_time, _still, disturbance=wrench, fidelity="force", substeps=2
    )
    run = simulate(plant, c, scenario, engine="virtual machine")
    assert run.verdict.completed
    assert run.v[-1, 0] == pytest.approx(-push, rel=1e-3)
    assert run.xi_hat[-1, -len(c.forces)] == pytest.approx(push, rel=1e-3)
    assert abs(run.p[-1, 0]) < 1e-9
    assert np.abs(run.p[:, 0]).max() > 1e-7


@pytest.mark.parametrize(("machine", "delay"), [("halbach", 0), ("halbach", 1), ("planar", 1)])
def test_sums_stand_last_and_the_law_is_the_same(machine: str, delay: int) -> None:
    """Frequency responses of the law in the coordinates of the proof, with its poles at z = 1 by themselves."""
    c = _controller(machine, delay)
    law, c1 = linear_law(c), sampled_law(c, 0, math.inf)
    assert c1.integrals == len(c.forces)
    w = np.geomspace(1e-3, 3.0, 20) / c.sample_time
    z = np.exp(1j * w * c.sample_time)[:, None, None]
    plain = law.C @ np.linalg.solve(z * np.eye(len(law.A)) - law.A, law.B_y) + law.D_y
    system = UncertainSystem(("p",), np.zeros(1), _nothing(len(c.forces)), ((-1.0, 1.0),))
    F = responses(system, c1, np.zeros(1), w).F
    assert np.abs(F - plain).max() < 1e-7 * np.abs(plain).max()


def _nothing(m: int) -> Any:
    import casadi as ca

    p = ca.SX.sym("p")
    return ca.Function("matrices", [p], [ca.DM.zeros(1, 1), ca.DM.zeros(1, m), ca.DM.zeros(m, 1)])


def test_integrals_and_forces_of_disturbance_are_one_or_the_other() -> None:
    both = replace(_weights("halbach"), q_i=np.ones(1))
    with pytest.raises(malta.InputError, match="one of them takes off loads"):
        lqg(_model("halbach"), both, 55e-3, "sampled-data")


def test_backward_euler_knows_nothing_of_held_currents() -> None:
    with pytest.raises(malta.InputError, match="held currents with backward-euler"):
        lqg(_model("halbach"), _weights("halbach", drift=False), 55e-3, "backward-euler")


# PID


TERMS = Pid(np.array([300.0]), np.array([400.0]), np.array([20.0]), 0.0)


@pytest.mark.parametrize("smooth", [0.0, 0.03])
def test_pid_is_the_textbook_law(smooth: float) -> None:
    """v = Kp (p* - y) + Ki e + Kd (p*' - d), d a filtered difference: plain Python on the run's own readings."""
    plant, model = _plant("halbach"), _model("halbach")
    terms = replace(TERMS, filter=smooth)
    c = pid(model, terms, 55e-3)
    assert c.cost is None
    assert not c.Bd.any()
    start = {"x": 20e-6}
    run = simulate(
        plant, c, Scenario("let go", 3.0, _still, start=start, fidelity="force", noise=1.0, seed=3)
    )
    a = math.exp(-c.sample_time / smooth) if smooth else 0.0
    e, d, last, wanted = 0.0, 0.0, 20e-6, []
    for y in run.y[:, 0]:
        e -= c.sample_time * y
        d = a * d + (1 - a) / c.sample_time * (y - last)
        last = y
        wanted.append(-300.0 * y + 400.0 * e - 20.0 * d)
    assert run.v[:, 0] == pytest.approx(np.array(wanted), abs=1e-12)


def test_a_pid_is_judged_on_its_machine() -> None:
    model = _model("halbach")
    assert unstable_gain(pid(model, TERMS, 55e-3)) is None
    wild = pid(model, replace(TERMS, Kd=np.array([500.0])), 55e-3)
    name, radius = unstable_gain(wild) or ("", 0.0)
    assert (name, radius > 1) == ("K", True)


@pytest.mark.slow
def test_a_pid_has_a_margin_on_its_machine() -> None:
    model = _model("halbach")
    found = linear_report(model, pid(model, TERMS, 55e-3), {"m": 0.2})
    assert found.stable
    assert found.poles.regulator.size == 0
    assert found.robust is not None
    assert found.robust.lower is not None
    assert found.robust.lower > 0.5


@pytest.mark.parametrize(
    ("terms", "Ts", "found"),
    [
        (TERMS, 0.0, "Ts"),
        (TERMS, math.nan, "Ts"),
        (Pid(np.ones(2), np.ones(2), np.ones(2), 0.0), 55e-3, "2 gains"),
    ],
)
def test_what_is_no_pid_is_one_sentence(terms: Pid, Ts: float, found: str) -> None:
    with pytest.raises(malta.InputError, match=found):
        pid(_model("halbach"), terms, Ts)


@pytest.mark.parametrize("bad", [{"Kp": np.array([np.nan])}, {"Kd": np.ones(3)}, {"filter": -1.0}])
def test_gains_that_are_none_are_refused(bad: Any) -> None:
    with pytest.raises(malta.InputError, match="Pid"):
        replace(TERMS, **bad)


# Gain files


@pytest.mark.parametrize("suffix", gains.SUFFIXES)
@pytest.mark.parametrize("kind", ["halbach", "planar", "pid"])
def test_gain_files_come_back_as_they_were(kind: str, suffix: str, tmp_path: Path) -> None:
    if kind == "pid":
        model, c = _model("halbach"), pid(_model("halbach"), TERMS, 55e-3)
    else:
        model, c = _model(kind), _controller(kind, 0 if kind == "halbach" else 1)
    path = tmp_path / f"mine{suffix}"
    gains.write(c, linear_report(model, c), path)
    again = gains.read(path)
    for name in ("A", "B", "C", "Ad", "Bd", "Cd", "K", "Ki", "L"):
        assert np.array_equal(getattr(again, name), getattr(c, name)), name
    assert again.states == c.states
    for table in ("cost", "noise", "feedforward", "limits"):
        mine, theirs = getattr(c, table), getattr(again, table)
        assert (mine is None) == (theirs is None)
        for name in mine.__dataclass_fields__ if mine is not None else ():
            assert np.array_equal(getattr(mine, name), getattr(theirs, name)), f"{table}.{name}"
    assert again.current_loop == c.current_loop
    assert again.parameters == c.parameters


# Margins


def test_margins_count_what_holding_costs() -> None:
    """The loop of the proof has the poles of the exact sampled loop; the witness is unstable, 99 % of it is not."""
    plant, c = _plant("halbach"), _controller("halbach", 0)
    system, law = machine_system(plant, c, ["m", "A"], {"x": 0.0})
    assert system.matrices.size2_out(1) == 1  # the reading acts as the force H y
    (ours,) = closed_loop(system, law, system.nominal)
    poles = 1 + c.sample_time * np.linalg.eigvals(ours)
    expected = np.linalg.eigvals(sampled_loop(_model("halbach"), c, current_loops="lag").closed)
    for pole in expected[np.abs(expected) > 0.01]:  # those of the fast lag are beyond rounding
        assert np.abs(poles - pole).min() < 1e-6
    margin = travel_margin(plant, c, {"m": 0.2, "A": 0.2})
    assert margin.lower is not None
    assert 1 < margin.lower < margin.upper < 3
    assert margin.witness is not None
    for share, stable in ((0.99, True), (1.01, False)):
        par: Any = plant.parameters
        values = {k: getattr(par, k) + share * margin.moved[k] for k in ("m", "A")}
        other = plant_of(replace(par, **values))
        model = malta.linearize(other, other.at(), plant)
        radius = np.abs(np.linalg.eigvals(machine_loop(model, c).closed)).max()
        assert (radius < 1) == stable


@pytest.mark.slow
def test_coil_positions_make_waves_and_get_an_answer_in_time() -> None:
    plant, c = _plant("planar"), _controller("planar", 1)
    system, law = machine_system(plant, c, ["coil_pitch"], {"y": 0.0})
    found = malta.robust_margin(system, law, {"coil_pitch": 0.01}, budget=malta.proof.Budget(1.0))
    assert found.upper > 1
    assert found.work < 2
    assert found.lower is not None or found.reason


@pytest.mark.slow
def test_mass_inertia_and_field_of_the_planar_motor_are_proven() -> None:
    box = {"m": 0.2, "I_x": 0.2, "I_z": 0.2, "B_r": 0.2, "r_z": 0.1}
    plant, c = _plant("planar"), _controller("planar", 1)
    system, law = machine_system(plant, c, list(box), {"y": 0.0})
    found = malta.robust_margin(system, law, box)
    assert found.lower is not None
    assert found.lower > 1
    assert found.upper / found.lower < 1.03


def test_parameters_that_shape_a_model_have_no_margin() -> None:
    with pytest.raises(malta.InputError, match="a parameter that shapes the model"):
        uncertain(_plant("planar"), ["tau_n"])


# Simulation


@pytest.mark.slow
def test_a_table_flies_on_the_virtual_machine() -> None:
    """The controller's bilinear table is looked up at every sample; the C engine has no tables and says so."""
    plant, c = _plant("planar"), _controller("planar", 1)
    par: Any = c.parameters
    looked_up = replace(c, parameters=replace(par, cells=35.0))
    scenario = Scenario("still", 0.01, _still, start={"x": 6e-3, "y": 4e-3}, fidelity="force", substeps=1)
    still = replace(scenario, reference=_at(6e-3, 4e-3))
    run = simulate(plant, looked_up, still)
    assert run.engine == "virtual machine"
    assert run.verdict.completed
    exact = simulate(plant, c, still, engine="virtual machine")
    off = np.abs(run.p - run.reference).max()
    assert 1e-12 < off < 1e-5
    assert np.abs(exact.p - exact.reference).max() < 1e-3 * off
    with pytest.raises(malta.InputError, match="looks up a table"):
        simulate(plant, looked_up, still, engine="compiled")


def _at(x: float, y: float) -> Any:
    def reference(plant: Plant) -> Any:
        def at(t: Any) -> Motion:
            p = np.zeros((len(t), len(plant.outputs)))
            p[:, 0], p[:, 1] = x, y
            return Motion(p, 0 * p, 0 * p)

        return at

    return reference


def test_noise_of_the_laser_is_uniform_with_its_own_rms() -> None:
    plant, c = _plant("halbach"), _controller("halbach", 0)
    par: Any = plant.parameters
    run = simulate(plant, c, Scenario("hold", 400.0, _still, fidelity="force", noise=1.0, substeps=1))
    noise = (run.y - run.p)[:, 0]
    assert np.abs(noise).max() <= par.n_laser
    assert np.abs(noise).max() > 0.999 * par.n_laser
    assert noise.std() == pytest.approx(par.n_laser / math.sqrt(3), rel=0.02)
    fourth = (noise**4).mean() / noise.var() ** 2
    assert fourth == pytest.approx(9 / 5, rel=0.03)  # of a uniform variable; 3 of a normal one


def test_open_loop_is_the_angle_of_the_reference() -> None:
    """Without feedback the motor hangs on its spring at the reference: it goes there, and stays."""
    plant, c = _plant("halbach"), _controller("halbach", 0)

    def jump(_: Plant) -> Any:
        def at(t: Any) -> Motion:
            p = np.where(np.asarray(t) > 0.5, 1e-4, 0.0)[:, None]
            return Motion(p, 0 * p, 0 * p)

        return at

    run = simulate(plant, c, Scenario("open", 8.0, jump, fidelity="force", open_loop=True, substeps=64))
    assert not run.v.any()
    assert run.p[-1, 0] == pytest.approx(1e-4, rel=1e-3)
    assert run.p.max() > 1.2e-4  # hardly damped


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_fidelities_that_a_machine_has_not_are_one_sentence(fidelity: Any) -> None:
    plant, c = _plant("planar"), _controller("planar", 1)
    with pytest.raises(malta.InputError, match="one of force for a planar"):
        simulate(plant, c, Scenario("hold", 0.01, _still, fidelity=fidelity))


def test_machines_without_windings_say_so() -> None:
    with pytest.raises(malta.InputError, match="windings are modelled"):
        _ = _plant("planar").drive
    assert "the electronics' own current controllers" in left_out(
        _plant("halbach"), _controller("halbach", 0)
    )
    assert left_out(_plant("planar"), _controller("planar", 1)) == ""


def test_disturbances_by_hand() -> None:
    """Filter and regulator of a mass on a spring, once more with scipy: the augmented Riccati equation."""
    c, model = _controller("halbach", 0), _model("halbach")
    w = _weights("halbach")
    still = between_samples(model)
    Ad, Bd = sample(still.A, model.B, 55e-3)
    Ad = Ad + Bd @ still.H @ model.C
    A = np.block([[Ad, Bd], [np.zeros((1, 2)), np.eye(1)]])
    C = np.hstack([model.C, [[0.0]]])
    n = 400  # the noise of the force within a sample, summed finely
    fine, into = sample(still.A, model.B, 55e-3 / n)
    W, step = np.zeros((2, 2)), np.eye(2)
    for _ in range(n):
        W += step @ into @ into.T @ step.T * w.process_variance[0] * n
        step = fine @ step
    P = linalg.solve_discrete_are(
        A.T, C.T, linalg.block_diag(W, w.drift_variance[0]), np.diag(w.sensor_variance)
    )
    L = P @ C.T / (C @ P @ C.T + w.sensor_variance[0])
    assert c.L.ravel() == pytest.approx(L.ravel(), rel=1e-3)


# What was wrong once


def _slow() -> Controller:
    """So slow that what tilt stiffness does to the planar motor decides."""
    w = _weights("planar")
    base = np.where(np.arange(12) < 6, 10e-3, 1.0)
    slow = replace(w, q_base=base, sensor_variance=1e4 * w.sensor_variance)
    return lqg(_model("planar"), slow, 200e-6, "sampled-data", 1)


@pytest.mark.slow
def test_currents_carry_the_weight_that_there_is() -> None:
    """A lighter mover is held by smaller currents, which tilt it less: proofs and the exact loop agree on that."""
    plant, c = _plant("planar"), _slow()
    system, law = machine_system(plant, c, ["m", "B_r"], {"y": 0.0})
    par: Any = plant.parameters
    for m, B_r in ((20.0, 1.17), (10.0, 1.17), (15.0, 1.0)):
        light = plant_of(replace(par, m=m, B_r=B_r))
        model = malta.linearize(light, light.at())
        radius = np.abs(np.linalg.eigvals(machine_loop(model, c).closed)).max()
        (ours,) = closed_loop(system, law, np.array([m, B_r]))
        assert np.abs(1 + c.sample_time * np.linalg.eigvals(ours)).max() == pytest.approx(radius, abs=1e-9)


@pytest.mark.slow
def test_twins_that_are_both_named_move_apart() -> None:
    plant, c = _plant("planar"), _controller("planar", 1)
    system, law = machine_system(plant, c, ["I_x", "I_y"], {"y": 0.0})
    both = malta.robust_margin(system, law, {"I_x": 0.01, "I_y": 0.2})
    system, law = machine_system(plant, c, ["I_z", "I_y"], {"y": 0.0})
    alone = malta.robust_margin(system, law, {"I_y": 0.2})
    assert both.upper <= 1.001 * alone.upper


def test_parameters_that_shape_functions_do_not_change_in_flight() -> None:
    plant, c = _plant("halbach"), _controller("halbach", 0)
    scenario = Scenario("faster", 1.0, _still, fidelity="phase", changes=((0.5, {"f_pwm": 2e4}),))
    with pytest.raises(malta.InputError, match=r"changes.f_pwm: found a parameter that shapes"):
        simulate(plant, c, scenario)


@pytest.mark.parametrize(
    ("fidelity", "found"),
    [("phase", "kalman with electronics of their own pace"), ("force", "whose currents are held")],
)
def test_other_estimators_know_nothing_of_held_currents(fidelity: Any, found: str) -> None:
    plant, c = _plant("halbach"), _controller("halbach", 0, drift=False)
    with pytest.raises(malta.InputError, match=found):
        simulate(plant, c, Scenario("hold", 1.0, _still, fidelity=fidelity, estimator="kalman"))


@pytest.mark.slow
def test_a_margin_says_where_stability_is_lost_where_the_first_guess_was_wrong() -> None:
    """A hold of 0.1 s: the search neglects images, and looks again by the poles of the loop."""
    plant = _plant("halbach", b=0.5, T_laser=0.1)
    model = malta.linearize(plant, plant.at())
    c = lqg(model, _weights("halbach"), 0.1, "sampled-data", 0)
    box = {"m": 0.3, "A": 0.112, "b": 0.219}
    system, law = machine_system(plant, c, list(box), {"x": 0.0})
    found = malta.robust_margin(system, law, box, budget=malta.proof.Budget(10.0))
    assert found.lower is not None
    assert not found.exhausted
    assert found.lower < found.upper < 3.4
    worse = system.nominal + 1.001 * (np.array(list((found.witness or {}).values())) - system.nominal)
    assert np.abs(1 + 0.1 * np.linalg.eigvals(closed_loop(system, law, worse)[0])).max() > 1


def test_a_pid_takes_the_mean_rate_between_readings() -> None:
    c = pid(_model("halbach"), TERMS, 55e-3)
    assert not c.feedforward.rate.any()
    assert c.feedforward.speed[0, 0] > 0


def test_currents_far_below_their_limit_have_not_met_it() -> None:
    """x / x as a product with a reciprocal is not always 1."""
    plant, c = _plant("halbach", I_adc=49.0), _controller("halbach", 0, I_adc=49.0)
    run = simulate(plant, c, Scenario("hold", 5.0, _still, fidelity="phase", noise=1.0))
    assert np.abs(run.current).max() < 10
    assert run.limits == ()


@pytest.mark.slow_for("planar-start1")
@pytest.mark.parametrize(("machine", "start"), [("halbach", {"x": 1e-4}), ("planar", {"x": 1e-5})])
def test_an_observer_that_knows_the_start_sees_no_disturbance(machine: str, start: Any) -> None:
    """Off the reference, with a sample of delay: what acted before is what the currents made there."""
    late = {"latency": 1.0} if machine == "halbach" else {}
    plant, c = _plant(machine, **late), _controller(machine, 1, **late)
    scenario = Scenario("let go", 10 * c.sample_time, _still, start=start, fidelity="force", substeps=64)
    run = simulate(plant, c, scenario, engine="virtual machine" if machine == "planar" else "auto")
    seen = np.abs(run.xi_hat[:, -len(c.forces)]).max()
    assert seen < (
        3e-3 if machine == "halbach" else 1e-3
    )  # the lag of the current loops is in no design model


def test_a_gain_file_with_two_kinds_of_integrals_is_refused(tmp_path: Path) -> None:
    c, model = _controller("halbach", 0), _model("halbach")
    path = tmp_path / "both.json"
    margins = linear_report(model, c)
    gains.write(replace(c, Ki=np.array([[1.0]])), margins, path)
    with pytest.raises(malta.InputError, match=r"gains.Ki: found sums of errors beside"):
        gains.read(path)


def test_a_machine_that_cannot_be_controlled_is_refused_by_its_file(tmp_path: Path) -> None:
    import json

    from malta.gains.encodings import content_sha256

    c, model = _controller("planar", 1), _model("planar")
    path = tmp_path / "pitch.json"
    gains.write(c, linear_report(model, c), path)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["plant"]["parameters"]["coil_pitch"]["value"] = 0.1
    content["sha256"] = content_sha256(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(
        malta.InputError, match=r"pitch.json: plant.parameters: found planar: with a coil pitch"
    ):
        gains.read(path)


def test_slow_samples_take_as_many_steps_as_their_current_loops_ask_for() -> None:
    plant, c = _plant("halbach"), _controller("halbach", 0)
    scenario = Scenario("let go", 2.0, _still, start={"x": 1e-4}, fidelity="force")
    found = simulate(plant, c, scenario).p
    fine = simulate(plant, c, replace(scenario, substeps=256)).p
    assert np.abs(found - fine).max() < 2e-9
