"""python-control and malta: systems go both ways, and say the same."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import control
import matplotlib as mpl
import numpy as np
import pytest
from conditions import of_gain
from conftest import refusal
from scipy import linalg

import malta
from malta.gains import encodings
from malta.loops.sampled_loops import machine_loop
from malta.model.fingerprint import fingerprint
from malta.simulation.experiments.catalogue import jump
from malta.synthesis import filters, lqg, regulators, riccati, sampled_filters

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.loops.linear_loops import LoopSystems
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

LQGS = ("calibrated", "halbach", "halbach_late", "planar", "robust", "table2")
SUFFIXES = (".json", ".npz", ".mat")


# --- gains: python-control solves the same equations ---


class Question(NamedTuple):
    """A Riccati equation that a design asked, and malta's answer."""

    A: FloatArray
    B: FloatArray
    Q: FloatArray
    R: FloatArray
    N: FloatArray
    what: str
    found: riccati.RiccatiSolution


class Design(NamedTuple):
    """A shipped LQG with all that it and its continuous stages ask."""

    model: LinearModel
    weights: malta.synthesis.Weights
    continuous: list[Question]
    sampled: list[Question]


@pytest.fixture(scope="module", params=LQGS)
def shipped(request: pytest.FixtureRequest) -> Design:
    """Each shipped LQG; its sampled equations are those of sampled weights and noise, whatever it runs with."""
    spec = malta.read_design(f"design/{request.param}.toml")
    model = malta.linearize(spec.plant, spec.plant.at(**spec.operating_point))
    asked: dict[str, list[Question]] = {"care": [], "dare": []}

    def noted(name: str, *given: Any, solver: riccati.Solver) -> riccati.RiccatiSolution:
        found: riccati.RiccatiSolution = getattr(riccati, name)(*given, solver=solver)
        A, B, Q, R, *rest = given
        N = rest[0] if name == "dare" else np.zeros_like(B)
        asked[name].append(Question(A, B, Q, R, N, str(rest[-1]), found))
        return found

    with pytest.MonkeyPatch.context() as patch:
        for name in asked:
            for module in (lqg, regulators, filters, sampled_filters):
                patch.setattr(module, name, partial(noted, name), raising=False)
        weights = replace(spec.weights, correlation=np.zeros(0))  # which python-control does not know
        regulators.lqr(model, weights)
        filters.kalman(model, weights)
        lqg.gains(model, weights, spec.sample_time, "sampled-data", spec.delay)
    return Design(model, weights, asked["care"], asked["dare"])


def apart(found: FloatArray, expected: FloatArray) -> float:
    """The largest difference of an entry, relative to the largest entry of its row."""
    size = np.abs(expected).max(axis=1, keepdims=True)
    return float((np.abs(found - expected) / np.where(size == 0, 1, size)).max())


def test_control_lqr_gives_the_continuous_gains(shipped: Design) -> None:
    m, w = shipped.model, shipped.weights
    K = control.lqr(m.A, m.B, w.Q, w.R, method="scipy")[0]
    assert apart(K, malta.synthesis.lqr(m, w)) < 1e-9
    if w.q_i.any():
        Q = linalg.block_diag(w.Q, regulators.integrals_of(m, w).weight)
        K = control.lqr(m.A, m.B, Q, w.R, integral_action=m.C, method="scipy")[0]
        p, n = m.C.shape
        A = np.block([[m.A, np.zeros((n, p))], [m.C, np.zeros((p, p))]])
        B = np.vstack([m.B, np.zeros((p, m.B.shape[1]))])
        allowed = of_gain(A, B, Q, w.R, riccati.care(A, B, Q, w.R).X)
        assert (np.abs(K - np.hstack(malta.synthesis.lqi(m, w))) <= allowed).all()


def test_control_dlqr_gives_the_sampled_gains(shipped: Design) -> None:
    regulator = shipped.sampled[0]
    A, B, Q, R, N, what, found = regulator
    assert what in ("sampled LQR", "sampled LQI")
    assert apart(control.dlqr(A, B, Q, R, N, method="scipy")[0], found.K) < 1e-7


def test_control_dlqe_loses_digits_of_the_filters_in_si_units(shipped: Design) -> None:
    """Up to a ten-thousandth of them, where forces count in newtons and sensor noise in 1e-13 m2.

    Or all of them: at times, as rounding has it, the solver finds the problem too ill-conditioned.
    """
    A, B, Q, R, *_, found = shipped.sampled[1]
    try:
        L = control.dlqe(A.T, np.eye(len(A)), B.T, Q, R, method="scipy")[0]
    except ValueError as error:
        if "ill-conditioned" not in str(error):
            raise
        return
    assert apart(L, found.K.T) < 1e-3


def test_control_lqe_and_dlqe_give_the_filters_in_their_own_units(shipped: Design) -> None:
    """States in standard deviations of what the filter leaves unknown, sensors in those of their noise."""
    for solve, (A, B, Q, R, *_, what, found) in (
        (control.lqe, shipped.continuous[1]),
        (control.dlqe, shipped.sampled[1]),
    ):
        assert "Kalman filter" in what
        t, s = np.sqrt(np.diag(found.X)), np.sqrt(np.diag(R))
        F, C, W = A.T * t / t[:, None], B.T * t / s[:, None], Q / np.outer(t, t)
        L = solve(F, np.eye(len(t)), C, (W + W.T) / 2, np.eye(len(s)), method="scipy")[0]
        assert apart(L * t[:, None] / s, found.K.T) < 1e-9


# --- systems of malta for python-control ---


@pytest.fixture(scope="module")
def table2() -> Controller:
    """MALTA's published gains."""
    return malta.gains.read("design/gains/table2.json")


@pytest.fixture(scope="module")
def loop(plant: Plant, table2: Controller) -> LoopSystems:
    """The systems of its loop."""
    return malta.loops.loop_systems(plant, table2)


def at(system: Any, w: float) -> Any:
    """The response at a frequency, rad/s, of balanced states: in SI units python-control keeps five digits or so."""
    A, (scale, _) = linalg.matrix_balance(system.A, permute=False, separate=True)
    pencil = np.exp(1j * w * system.dt) * np.eye(len(A)) - A
    return system.C * scale @ np.linalg.solve(pencil, system.B / scale[:, None]) + system.D


def test_nlsys_moves_as_the_machine_does(plant: Plant) -> None:
    system = plant.nlsys()
    assert system.state_labels == [s.name for s in plant.states]
    assert system.input_labels == [s.name for s in (*plant.inputs, *plant.disturbances)]
    assert system.output_labels == [s.name for s in plant.outputs]
    trimmed = malta.trim(plant, z=2e-3)
    none = np.zeros(len(plant.disturbances))
    assert np.abs(system.dynamics(0, trimmed.x, np.r_[trimmed.u, none])).max() < 1e-9
    linear = system.linearize(trimmed.x, np.r_[trimmed.u, none], eps=1e-7)
    model, kept = malta.linearize(plant, trimmed), list(plant.controlled)
    assert np.abs(linear.A[np.ix_(kept, kept)] - model.A).max() < 1e-6 * np.abs(model.A).max()
    assert np.abs(linear.C[:, kept] - model.C).max() < 1e-9


def test_nlsys_simulates_in_python_control() -> None:
    """A pendulum that hangs: a load beside the input, one period of small swings."""
    plant = malta.linear_machine([[0, 1], [-4, 0]], [[0], [1]], [[1, 0]])
    t = np.linspace(0, np.pi, 50)
    response = control.input_output_response(
        plant.nlsys(), t, np.zeros((2, 50)), [1.0, 0.0], solve_ivp_kwargs={"rtol": 1e-9}
    )
    assert np.abs(response.outputs - np.cos(2 * t)).max() < 1e-5


def test_the_law_as_a_system(plant: Plant, table2: Controller) -> None:
    """One sample of the simulated law, from a measurement and a set point."""
    sys = table2.sys
    measured, forces = [s.name for s in plant.outputs], [s.name for s in plant.inputs]
    assert sys.input_labels == [*measured, *(f"{name}_ref" for name in measured)]
    assert (sys.output_labels, sys.dt) == (forces, table2.sample_time)
    assert sys.name == "table2"
    y, target = np.linspace(1e-6, 5e-6, 5), np.linspace(-2e-6, 2e-6, 5)
    q = np.linalg.solve(plant_positions(plant), target)
    xi_hat = table2.L @ y
    e = table2.sample_time * (target - y)
    v = table2.K @ (np.r_[q, np.zeros(5)] - xi_hat) + table2.Ki @ e
    assert sys.D @ np.r_[y, target] == pytest.approx(v, rel=1e-9)


def plant_positions(plant: Plant) -> FloatArray:
    """P of p = P q at the centre."""
    return malta.linearize(plant, plant.at()).C[:, :5]


@pytest.mark.slow_for("planar", "planar_pid")
@pytest.mark.parametrize("name", [p.stem for p in sorted(Path("design/gains").glob("*.json"))])
def test_loops_are_those_of_verify(name: str) -> None:
    controller = malta.gains.read(f"design/gains/{name}.json")
    plant = malta.plant_of(controller.parameters)
    systems = malta.loops.loop_systems(plant, controller)
    model = malta.linearize(plant, plant.point(controller.operating_point[0]))
    verified = machine_loop(model, controller)
    one = np.eye(len(plant.outputs))
    for w in (1.0, 30.0, 0.3 * np.pi / controller.sample_time):
        S = verified.sensitivity(np.array([w]))[0]
        assert np.abs(at(systems.S, w) - S).max() < 1e-8 * np.abs(S).max()
        assert np.abs(at(systems.S, w) + at(systems.T, w) - one).max() < 1e-8
        P, F = at(systems.P, w), at(systems.F, w)
        S_forces = np.linalg.inv(np.eye(len(F)) - F @ P)
        assert np.abs(at(systems.S_forces, w) - S_forces).max() < 1e-9 * np.abs(S_forces).max()
        assert np.abs(at(systems.L_forces, w) + F @ P).max() < 1e-9 * np.abs(F @ P).max()
        if not model.E.any():  # else a part of the law stands in the machine
            assert np.abs(at(systems.L, w) + P @ F).max() < 1e-9 * np.abs(P @ F).max()
    assert np.abs(systems.S.poles()).max() < 1


def test_peak_sensitivity_is_the_norm_of_s(model: LinearModel, table2: Controller, loop: LoopSystems) -> None:
    pytest.importorskip("slycot", reason="the norm of systems of several channels needs slycot")
    expected = malta.verify(model, table2).peak_sensitivity["sigma_max"]
    assert control.linfnorm(loop.S)[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_plots_of_python_control_take_them(loop: LoopSystems, table2: Controller) -> None:
    with mpl.rc_context({"backend": "Agg"}), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what the plots' own library says
        import matplotlib.pyplot as plt

        siso = loop.S["z", "z"], loop.L["z", "z"]
        drawn = [
            control.bode_plot(siso[0]).figure,
            control.step_response(loop.tracking["z", "z_ref"], np.arange(200) * table2.sample_time)
            .plot()
            .figure,
            control.nyquist_plot(siso[1]).figure,
            control.bode_plot(table2.sys["f_D", "z"]).figure,
        ]
        assert all(figure.axes for figure in drawn)
        plt.close("all")


# --- systems of python-control as controllers ---


def weights(rate: float) -> tuple[Any, Any]:
    """Of the error, an integral up to a thousandth of `rate`, and of the force."""
    return control.ss(control.tf([0.5, rate], [1, 1e-3 * rate])), control.ss([], [], [], [[0.1]])


@pytest.fixture(scope="module")
def ball() -> Plant:
    """A levitated ball, 0.1 kg on a negative stiffness of 2 kN/m."""
    return malta.linear_machine(
        [[0, 1], [0, 0]], [[0], [10]], [[1, 0]],
        name="levitated_ball", states=["x [m]", "x_dot [m/s]"], inputs=["f [N]"], outputs=["x [m]"],
        nominal={"k": 2e4}, terms={"k": [[[0, 0], [1, 0]]]}, noise=1e-7, limit=40.0, dead_time=1e-4,
    )  # fmt: skip


@pytest.fixture(scope="module")
def h_infinity(ball: Plant) -> Controller:
    """Mixed sensitivity of errors and forces, sampled at 10 kHz."""
    pytest.importorskip("slycot", reason="control.hinfsyn needs slycot")
    unit = 2e3  # N: forces count in what the stiffness pulls at 1 m
    model = malta.linearize(ball, ball.at())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of augw's own library
        augmented = control.augw(control.ss(model.A, model.B * unit, model.C, 0), *weights(200.0))
    K, _, gamma, _ = control.hinfsyn(augmented, 1, 1)
    assert gamma == pytest.approx(1.6, abs=0.1)
    sampled = control.c2d(control.ss(K.A, K.B, unit * K.C, unit * K.D), 1e-4, "tustin")
    return malta.synthesis.controller_of(sampled, ball, name="h-infinity")


def test_an_h_infinity_controller_is_verified(ball: Plant, h_infinity: Controller) -> None:
    found = malta.verify(malta.linearize(ball, ball.at()), h_infinity, {"k": 0.2})
    assert found.stable
    assert found.peak_sensitivity["x"] < 2.5
    assert found.robust is not None
    assert found.robust.lower == pytest.approx(found.robust.upper, rel=1e-3)
    assert found.robust.lower is not None
    assert found.robust.lower > 1
    (k,) = found.robust.witness.values() if found.robust.witness else (np.nan,)
    lost = malta.linear_machine(
        [[0, 1], [k, 0]], [[0], [10]], [[1, 0]], dead_time=1e-4, inputs=["f [N]"], outputs=["x [m]"]
    )
    radius = malta.verify(malta.linearize(lost, lost.at()), h_infinity).stages[-1].spectral_radius
    assert radius == pytest.approx(1, abs=1e-7)
    stages = malta.verify(ball, h_infinity, {"k": 0.2}, stages=True, proof=False).chain
    assert [link.name for link in stages] == ["sampled"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_h_infinity_controller_in_a_gain_file(
    ball: Plant, h_infinity: Controller, suffix: str, tmp_path: Path
) -> None:
    path = tmp_path / f"h{suffix}"
    margins = malta.verify(malta.linearize(ball, ball.at()), h_infinity)
    malta.gains.write(h_infinity, margins, path)
    found, content = malta.gains.read(path), encodings.decode(path)
    assert (content["version"], content["law"]) == (2, {"tracks": "errors"})
    assert content["cost"] is None
    assert fingerprint(found) == fingerprint(h_infinity)
    assert malta.gains.document(found, margins)["sha256"] == content["sha256"]


def test_an_h_infinity_controller_in_the_simulated_loop(ball: Plant, h_infinity: Controller) -> None:
    """A small step, within the limits, is the response of the linear loop; a push is taken off."""
    scenario = malta.Scenario("step", 0.05, partial(jump, output=0, size=1e-4, at=0.95e-4), fidelity="force")
    run = malta.simulate(ball, h_infinity, scenario)
    assert not run.saturated.any()
    response = control.step_response(malta.loops.loop_systems(ball, h_infinity).tracking, run.t[:-1])
    assert np.abs(run.p[1:, 0] - 1e-4 * response.outputs.ravel()).max() < 1e-10 * 1e-4
    pushed = malta.experiment("disturbance", ball, h_infinity).cases[0].run
    assert pushed.verdict.completed
    assert abs(pushed.p[-1, 0]) < 0.02 * np.abs(pushed.p).max()


def test_an_h_infinity_controller_in_a_campaign(h_infinity: Controller) -> None:
    plan = malta.campaigns.Plan(h_infinity, "hold", {"k": 0.2}, samples=16, options={"time": 0.05})
    found = malta.campaign(plan)
    assert found.rate.passed == 16
    assert 1e-8 < found.batch.rms.min() < found.batch.rms.max() < 1e-6


@pytest.mark.slow
def test_a_law_of_errors_is_the_law_of_states_at_rest(
    plant: Plant, model: LinearModel, table2: Controller
) -> None:
    """MALTA's LQG from its measurements to its forces, turned round: the same loop, the same noise, the same run."""
    measured = [s.name for s in plant.outputs]
    again = malta.synthesis.controller_of(-table2.sys[:, measured], plant, name="turned round")
    assert again.tracks == "errors"
    first, second = (malta.verify(model, controller) for controller in (table2, again))
    assert second.stages[1].peak_sensitivity == pytest.approx(first.stages[1].peak_sensitivity, rel=1e-9)
    # A law of errors knows no speeds: its current controllers do without a forecast of induced voltages, in z alone.
    assert second.peak_sensitivity["x1"] == pytest.approx(first.peak_sensitivity["x1"], rel=1e-5)
    assert second.peak_sensitivity["z"] == pytest.approx(first.peak_sensitivity["z"], rel=0.02)
    assert "w_n_max" not in second.bandwidth
    ranges = {"m": 0.1}
    one, other = (
        malta.margins.travel.travel_margin(plant, c, ranges, "lag", time=20.0) for c in (table2, again)
    )
    assert one.upper == pytest.approx(other.upper, rel=2e-3)
    assert other.lower is not None
    scenario = malta.Scenario("hold", 0.01, malta.references.hold, noise=1.0, fidelity="force")
    runs = [malta.simulate(plant, controller, scenario) for controller in (table2, again)]
    size = np.abs(runs[0].p).max()
    assert size > 1e-7
    assert np.abs(runs[0].p - runs[1].p).max() < 1e-9 * size
    assert np.abs(runs[0].v - runs[1].v).max() < 1e-9 * np.abs(runs[0].v).max()


def test_a_law_of_errors_on_the_windings(plant: Plant, table2: Controller) -> None:
    """Where the mover is the current controllers take from the measurements."""
    measured = [s.name for s in plant.outputs]
    again = malta.synthesis.controller_of(-table2.sys[:, measured], plant)
    runs = [malta.simulate(plant, c, malta.Scenario.stroke(2e-3, duration=0.06)) for c in (table2, again)]
    assert all(run.verdict.completed for run in runs)
    assert np.abs(runs[1].p[-1] - runs[1].reference[-1]).max() < 20e-6
    held = malta.Scenario("hold", 0.01, malta.references.hold, noise=1.0)
    first, second = (malta.simulate(plant, c, held).v.std(axis=0) for c in (table2, again))
    assert second == pytest.approx(first, rel=0.01)


def test_the_law_of_errors_as_a_system(ball: Plant) -> None:
    given = control.ss(
        [[0.5, 0.1], [0.0, 0.2]], [[1.0], [2.0]], [[3.0, 4.0]], [[5.0]], 1e-4, states=["a", "b"]
    )
    controller = malta.synthesis.controller_of(given, ball)
    assert [s.name for s in controller.states] == ["a", "b", "x[e]"]
    assert (controller.delay, controller.observed) == (0, 0)
    found, z = controller.sys, np.exp(0.3j)
    assert found.state_labels == ["a", "b"]
    assert found(z) == pytest.approx(np.array([[-given(z), given(z)]]), rel=1e-12)


@pytest.mark.parametrize(
    ("sys", "found"),
    [
        (control.ss([[-1]], [[1]], [[1]], 0), "sys: found dt = 0"),
        (control.ss([[0.5]], [[1]], [[1]], 0, True), "sys: found dt = True"),
        (control.ss([[0.5]], [[1, 1]], [[1]], 0, 1e-3), "sys: found 2 inputs and 1 outputs"),
        (np.eye(1), "sys: found a ndarray"),
    ],
)
def test_bad_systems_get_one_sentence(sys: Any, found: str, ball: Plant) -> None:
    with pytest.raises(malta.InputError, match=found):
        malta.synthesis.controller_of(sys, ball)


def test_what_a_law_of_errors_cannot_do(ball: Plant) -> None:
    controller = malta.synthesis.controller_of(control.ss([], [], [], [[3000.0]], 1e-4), ball)
    for option, found in (("scheduled", "a law of errors"), ("estimator", "a law of errors")):
        value: Any = True if option == "scheduled" else "kalman"
        scenario = malta.Scenario("hold", 0.01, malta.references.hold, fidelity="force", **{option: value})
        with pytest.raises(malta.InputError, match=found):
            malta.simulate(ball, controller, scenario)


@pytest.mark.parametrize(
    ("table", "key"),
    [
        (k.partition(".")[0], k.partition(".")[2])
        for k in ("model.Ad", "model.Bd", "model.Cd", "gains.Ki", "gains.L")
    ],
)
def test_a_file_whose_law_is_not_of_errors(table: str, key: str, ball: Plant, tmp_path: Path) -> None:
    lead = control.c2d(control.ss(control.tf([30.0, 4000.0], [5e-4, 1])), 1e-4, "tustin")
    controller = malta.synthesis.controller_of(lead, ball)
    path = tmp_path / "law.json"
    malta.gains.write(controller, malta.verify(malta.linearize(ball, ball.at()), controller), path)
    content = json.loads(path.read_text())
    content[table][key][-1][-1] += 0.5
    content["sha256"] = encodings.content_sha256(content)
    path.write_text(json.dumps(content))
    assert refusal(lambda: malta.gains.read(path), path).field == f"{table}.{key}"


def test_a_compensator_is_made_of_the_fields_of_a_law(table2: malta.synthesis.Controller) -> None:
    """The attribute of before answers with what to write."""
    law = malta.proof.Compensator(**table2.compensator_fields)
    assert (law.sample_time, law.D.shape) == (table2.sample_time, (5, 5))
    with pytest.raises(malta.InputError, match="compensator_fields"):
        _ = table2.compensator
