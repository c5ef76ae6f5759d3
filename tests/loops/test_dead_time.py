"""Dead times of any length: the hold split at a fraction of a sample, against a sample that is cut into many steps.

dense(...) has no split hold: a command begins to act some whole steps after its sample, each step being exact.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import control
import numpy as np
import pytest
from scipy import linalg

import malta
from malta.checker.check import check
from malta.linear.closed_loops import closed_loop, instability
from malta.linear.open_loops import open_systems, responses
from malta.linear.sampling import sample, split_delay, stored_blocks
from malta.linear.system import System
from malta.linear.uncertain import Compensator
from malta.loops.parametric_loops import machine_system
from malta.loops.sampled_loops import SampledLoop
from malta.model.sensors import Sensors
from malta.proof.certificate import write_certificate

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

Ts, STEPS = 1e-3, 20  # steps of a sample
DELAYS = (0.0, 0.05, 0.4, 0.95, 1.0, 1.35, 2.0, 2.6)  # samples: whole steps


def dense(
    plant: tuple[FloatArray, FloatArray, FloatArray], lag: float | None, delay: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The sampled plant from commands to readings: states x, of the lag, and commands under way from the oldest."""
    A, B, C = plant
    n, m = B.shape
    if lag is not None:
        A, B = np.block([[A, B], [np.zeros((m, n)), -lag * np.eye(m)]]), np.vstack([0 * B, lag * np.eye(m)])
        n += m
    late, steps = math.ceil(delay - 1e-9), round(delay * STEPS)
    E = linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * Ts / STEPS)
    x, *commands = np.split(np.eye(n + m * (late + 1)), np.cumsum([n, *[m] * late]))  # of samples -late .. 0
    after = x
    for j in range(STEPS):
        after = E[:n, :n] @ after + E[:n, n:] @ commands[late + (j - steps) // STEPS]
    whole = np.vstack([after, *commands[1:]])
    size = n + m * late
    return whole[:, :size], whole[:, size:], np.hstack([C, np.zeros((len(C), size - C.shape[1]))])


def drawn(
    seed: int, lag: float | None, delay: float
) -> tuple[Any, tuple[FloatArray, FloatArray, FloatArray], Compensator]:
    rng = np.random.default_rng(seed)
    n, m, p, k = rng.integers(1, 5, 4)
    A, B, C = rng.normal(size=(n, n)) / Ts / 2, rng.normal(size=(n, m)) / Ts, rng.normal(size=(p, n))
    F: Any = [rng.normal(size=shape) / 3 for shape in ((k, k), (k, p), (m, k), (m, p))]
    system = malta.uncertain(lambda q: (q * A, B, C), {"q": 1.0})
    return system, (A, B, C), Compensator(F[0], F[1], F[2], F[3], sample_time=Ts, delay=delay, lag=lag)


@pytest.mark.parametrize("lag", [None, 2e3])
@pytest.mark.parametrize("delay", DELAYS)
def test_the_split_hold_is_the_sample_cut_into_steps(delay: float, lag: float | None) -> None:
    """Traces of powers, to which rounding adds what it adds to the entries, are those of the eigenvalues."""
    for seed in range(8):
        system, plant, law = drawn(seed, lag, delay)
        ours = np.eye(len(closed_loop(system, law, system.nominal[None])[0]))
        ours += Ts * closed_loop(system, law, system.nominal[None])[0]
        Ad, Bd, Cd = dense(plant, lag, delay)
        other = np.block([[Ad + Bd @ law.D @ Cd, Bd @ law.C], [law.B @ Cd, law.A]])
        assert ours.shape == other.shape
        for power in range(1, 6):
            one, two = (np.linalg.matrix_power(M, power) for M in (ours, other))
            size = np.abs(np.linalg.matrix_power(np.abs(other), power)).sum()
            assert abs(np.trace(one) - np.trace(two)) < 1e-12 * size
    w = np.array([3.0, 300.0, 3000.0])
    P, _ = open_systems(system, law, system.nominal)
    G = P.response(np.asarray(np.expm1(1j * w * Ts) / Ts, dtype=complex))
    np.testing.assert_allclose(responses(system, law, system.nominal, w).G_y, G, rtol=1e-9, atol=1e-12)
    if lag is None:
        A, B, C = plant
        sampled = System(A, B, C, np.zeros((len(C), B.shape[1]))).sampled(Ts, delay * Ts)
        np.testing.assert_allclose(sampled.response(np.exp(1j * w * Ts)), G, rtol=1e-8, atol=1e-12)


def body(**times: Any) -> Plant:
    return malta.linear_machine(
        [[0, 1], [0, 0]], [[0], [10]], [[1, 0]], name="body", states=["x [m]", "x_dot [m/s]"], inputs=["f [N]"],
        outputs=["x [m]"], nominal={"k": 2e4}, terms={"k": [[[0, 0], [1, 0]]]}, noise=1e-7, limit=40.0, **times,
    )  # fmt: skip


def lead(machine: Plant) -> Controller:
    law = control.c2d(control.ss(6e3 * control.tf([0.01, 1], [1 / 3e3, 1])), Ts, "tustin")
    return malta.synthesis.controller_of(law, machine, name="lead")


@pytest.mark.parametrize(("samples", "peak"), [(0.5, 1.631), (1.0, 2.454), (1.5, 4.548), (2.0, 24.83)])
def test_peak_sensitivity_at_dead_times_of_any_length(samples: float, peak: float) -> None:
    """Of 1 / (1 - P F), P of a sample cut into steps; the dead time has the hold's half sample in it."""
    machine = body(dead_time=samples * Ts)
    c = lead(machine)
    Ad, Bd, Cd = dense(
        (np.array([[0, 1], [2e4, 0]]), np.array([[0], [10.0]]), np.eye(1, 2)), None, samples - 0.5
    )
    z = np.exp(1j * np.linspace(100, 0.999 * math.pi / Ts, 8000) * Ts)
    P = System(Ad, Bd, Cd, np.zeros((1, 1)), dt=Ts).response(z)
    F = System(LEAD.A, LEAD.B, LEAD.C, LEAD.D, dt=Ts).response(z)
    found = malta.verify(machine, c, {"k": 0.2}).peak_sensitivity["x"]
    assert found == pytest.approx(np.abs(1 / (1 + P * F)).max(), rel=2e-4)
    assert found == pytest.approx(peak, rel=1e-3)
    assert malta.loop(machine, c).stable


def test_a_dead_time_turns_the_phase_by_its_length() -> None:
    """At any frequency below that of sampling's images, -w T_d: to the half percent that these images add."""
    w, T = 150.0, Ts
    z = np.array([np.exp(1j * w * T)])

    def phase(delay: float) -> float:
        machine = body(computation_time=delay * T)
        L = malta.loops.loop_systems(malta.loop(machine, lead(machine))).L
        return float(np.angle(L(z[0]).item()))

    for delay in (0.1, 0.5, 0.999, 1.0, 1.001, 1.7):
        assert phase(0.0) - phase(delay) == pytest.approx(w * delay * T, rel=5e-3)


def test_rounding_makes_no_fraction_of_whole_samples() -> None:
    for k in range(1, 9):
        total, computed = body(dead_time=(k + 0.5) * 5e-5), body(computation_time=k * 5e-5)
        assert total.actuator.delay(5e-5) == computed.actuator.delay(5e-5) == k
        assert isinstance(total.actuator.delay(5e-5), int)
    assert (
        body(computation_time=6 * 5e-5).actuator.delay(5e-5)
        == body(computation_time=3e-4).actuator.delay(5e-5)
        == 6
    )
    assert body(dead_time=0.3 * Ts).actuator.delay(Ts) == body().actuator.delay(Ts) == 0
    assert split_delay(2 + 1e-12) == (2, 0.0)
    assert split_delay(1.25) == (1, 0.25)
    assert [stored_blocks(d) for d in (0, 0.2, 1, 1.2)] == [0, 1, 1, 2]


def test_a_machine_has_one_of_two_times() -> None:
    for times in (
        {"dead_time": 1e-3, "computation_time": 1e-3},
        {"dead_time": -1e-3},
        {"computation_time": -1.0},
    ):
        with pytest.raises(malta.InputError, match=r"one time above 0 s, or none|at least 0"):
            body(**times)


@pytest.mark.parametrize("lag", [None, 3e3])
def test_margins_move_evenly_and_are_those_of_eigenvalues(lag: float | None, tmp_path: Path) -> None:
    """Through a whole number of samples, too; each is confirmed by the checker, which has the hold of its own."""
    system = malta.uncertain(
        lambda k, m: ([[0, 1], [k / m, 0]], [[0], [10 / m]], [[1, 0]]), {"k": 2e3, "m": 1.0}
    )
    one = np.ones((1, 1))
    law = Compensator(0.3 * one, one, 2500 * one, -4500 * one, sample_time=Ts, lag=lag)
    box, lower = {"k": 0.2, "m": 0.1}, []
    delays = (0.0, 1e-3, 0.4, 0.999, 1.0, 1.001, 1.5)
    for delay in delays:
        late = replace(law, delay=delay)
        margin = malta.robust_margin(system, late, box)
        assert margin.lower is not None
        assert margin.lower > 0.9999 * margin.upper
        lower.append(margin.lower)
        moved = np.array([margin.moved[name] for name in system.names])
        for share, stable in ((0.999, True), (1.001, False)):
            assert (instability(system, late, system.nominal[None] + share * moved)[0] < 0) == stable
        if delay in (0.4, 1.0, 1.5):
            path = write_certificate(tmp_path / f"{delay}.json", [(system, late)], box, None, margin)
            assert check(path).ok
    slope = np.diff(lower) / np.diff(delays)
    assert (slope < 0).all()
    assert slope[0] == pytest.approx(slope[1], rel=0.3)
    assert slope[3] == pytest.approx(slope[4], rel=0.02)


def stiff(**times: Any) -> Plant:
    return malta.linear_machine(
        [[0, 1], [2e4, 0]], [[0], [10]], [[1, 0]], name="stiff", states=["x [m]", "x_dot [m/s]"],
        inputs=["f [N]"], outputs=["x [m]"], limit=400.0, **times,
    )  # fmt: skip


WEIGHTS = malta.synthesis.weights([1e8, 1e4], [1.0], [1e-2], [1e-12], q_i=[1e9])


@pytest.mark.parametrize("delay", [0.05, 0.7, 0.95, 1.0, 1.35, 2.6])
def test_a_law_that_knows_the_delay_flies_as_the_sample_cut_into_steps(delay: float) -> None:
    """Its estimate of what it does not know is exact without noise; simulated, compiled and not, and by exported C."""
    machine = stiff(computation_time=delay * Ts)
    c = malta.lqg(malta.linearize(machine, machine.at()), WEIGHTS, Ts, delay=machine.actuator.delay(Ts))
    assert c.delay == pytest.approx(delay)
    assert c.stored == stored_blocks(delay)
    hold = malta.Scenario(
        "hold", 0.05, malta.references.hold, start={"x": 1e-4}, fidelity="force", substeps=20
    )
    run = malta.simulate(machine, c, hold)
    Ad, Bd, Cd = dense((np.array([[0, 1], [2e4, 0]]), np.array([[0], [10.0]]), np.eye(1, 2)), None, delay)
    x, xi, e = np.zeros(len(Ad)), np.zeros(len(c.states)), np.zeros(1)
    x[0] = xi[0] = 1e-4
    for k in range(len(run.t)):
        y = Cd @ x
        assert abs(run.p[k, 0] - y[0]) < 1e-13
        np.testing.assert_allclose(xi, x, rtol=0, atol=1e-12 * max(1.0, np.abs(x).max()))
        e, xi_hat = e - Ts * y, xi + c.L @ (y - c.Cd @ xi)
        v = c.Ki @ e - c.K @ xi_hat
        x, xi = Ad @ x + Bd @ v, c.Ad @ xi_hat + c.Bd @ v
    few = malta.simulate(machine, c, replace(hold, substeps=2))
    assert np.abs(few.p - run.p).max() < 1e-4 * np.abs(run.p).max()
    engines: tuple[Any, ...] = ("virtual machine", malta.firmware.engine_of_c())
    for engine in engines:
        other = malta.simulate(machine, c, hold, engine=engine)
        assert np.abs(other.p - run.p).max() < 1e-15


def test_lanes_of_a_campaign_are_the_runs_alone() -> None:
    machine = body(computation_time=1.35 * Ts)
    c = malta.lqg(malta.linearize(machine, machine.at()), WEIGHTS, Ts, delay=1.35)
    hold = malta.Scenario("hold", 0.05, malta.references.hold, start={"x": 1e-4}, fidelity="force")
    values = np.linspace(1.9e4, 2.1e4, 5)
    batch = malta.simulation.simulate_many(machine, c, hold, {"k": values}, workers=1)
    for i, k in enumerate(values.tolist()):
        own = malta.simulate(malta.plant_of(replace(machine.parameters, k=k)), c, hold)
        np.testing.assert_allclose(batch.deviation[i], np.abs(own.p).max(axis=0), rtol=1e-9)


def test_the_law_of_a_fraction_minimizes_the_cost_of_the_sample_cut_into_steps() -> None:
    """K of dare for the cost summed over steps, in which each force acts when it does."""
    delay = 1.35
    machine = stiff()
    model = malta.linearize(machine, machine.at())
    weights = malta.synthesis.weights([1e8, 1e4], [1.0], [1e-2], [1e-12])
    c = malta.lqg(model, weights, Ts, delay=delay)
    A, B, _ = dense((model.A, model.B, model.C), None, delay)
    E = linalg.expm(np.block([[model.A, model.B], [np.zeros((1, 3))]]) * Ts / STEPS)
    fine = [
        linalg.expm(np.block([[model.A, model.B], [np.zeros((1, 3))]]) * Ts / STEPS * s) for s in GAUSS[0]
    ]
    x, old, new, _ = np.split(np.eye(5), [2, 3, 4])
    Q = np.zeros((5, 5))
    for j in range(STEPS):
        u = old if j < round((delay - 1) * STEPS) else new
        for part, weight in zip(fine, GAUSS[1], strict=True):
            inside = part[:2, :2] @ x + part[:2, 2:] @ u
            Q += weight * Ts / STEPS * inside.T @ weights.Q @ inside
        x = E[:2, :2] @ x + E[:2, 2:] @ u
    X = linalg.solve_discrete_are(A, B, Q[:4, :4], weights.R * Ts)
    K = np.linalg.solve(weights.R * Ts + B.T @ X @ B, B.T @ X @ A)
    np.testing.assert_allclose(c.K, K, rtol=1e-6)


GAUSS = (
    tuple((np.polynomial.legendre.leggauss(6)[0] + 1) / 2),
    tuple(np.polynomial.legendre.leggauss(6)[1] / 2),
)
LEAD = control.c2d(control.ss(6e3 * control.tf([0.01, 1], [1 / 3e3, 1])), Ts, "tustin")


def test_a_gain_file_keeps_the_fraction(tmp_path: Path) -> None:
    machine = stiff(computation_time=1.3 * Ts)
    model = malta.linearize(machine, machine.at())
    c = malta.lqg(model, WEIGHTS, Ts, delay=1.3)
    malta.gains.write(c, malta.verify(model, c), tmp_path / "late.json")
    back = malta.gains.read(tmp_path / "late.json")
    assert (back.fraction, back.delay) == (c.fraction, c.delay)
    assert malta.plant_of(back.parameters).actuator.delay(Ts) == machine.actuator.delay(Ts)
    wrong = (tmp_path / "late.json").read_text(encoding="utf-8")
    assert '"computation_time"' in wrong
    whole = malta.lqg(malta.linearize(stiff(), stiff().at()), WEIGHTS, Ts, delay=1)
    malta.gains.write(
        whole, malta.verify(malta.linearize(stiff(), stiff().at()), whole), tmp_path / "whole.json"
    )
    text = (tmp_path / "whole.json").read_text(encoding="utf-8")
    assert '"fraction"' not in text
    assert '"computation_time"' not in text


@pytest.mark.parametrize(("delay", "late"), [(0.25, 0.6), (1.0, 1.7), (0.0, 2.2), (1.3, 0.7)])
def test_readings_that_are_late_are_forces_that_are(delay: float, late: float) -> None:
    """The loop that catches readings within a sample, and the loop of a proof, where both delays are one of forces."""
    plant = body(dead_time=(delay + 0.5) * Ts)
    plant = replace(plant, sensors=replace(plant.sensors, dead_time=late * Ts))
    c = malta.lqg(malta.linearize(plant, plant.at()), WEIGHTS, Ts, delay=1)
    system, law = machine_system(plant, c, ("k",), {})
    assert law.delay == pytest.approx(delay + late)
    z = 1 + Ts * np.linalg.eigvals(closed_loop(system, law, system.nominal[None])[0])
    loop = malta.loop(plant, c)
    ours = np.linalg.eigvals(loop.matrix)
    for pole in z[np.abs(z) > 0.05]:
        assert np.abs(ours - pole).min() < 1e-7


def test_late_readings_of_a_push_within_the_sample() -> None:
    """What a force from outside leaves in a reading that is caught before the end of the sample."""
    machine = replace(stiff(), sensors=Sensors(dead_time=0.3 * Ts, lag=(0.0,)))
    c = malta.lqg(malta.linearize(stiff(), stiff().at()), WEIGHTS, Ts)
    loop: SampledLoop = malta.loop(machine, c).sampled
    assert loop.pushed is not None
    _, pushed = sample(np.array([[0, 1], [2e4, 0]]), np.array([[0], [10.0]]), 0.7 * Ts)
    assert loop.pushed[2, 0] == pytest.approx(pushed[0, 0], rel=1e-12)


def test_what_cannot_be_carried_is_refused() -> None:
    halbach = malta.gains.read("design/gains/halbach.json")
    plant = malta.plant_of(halbach.parameters)
    hold = malta.Scenario("hold", 1e-3, malta.references.hold, fidelity="phase", delay=0.5)
    with pytest.raises(malta.InputError, match=r"0\.5 samples of delay beside electronics of their own pace"):
        malta.simulate(plant, halbach, hold)
    system, _, law = drawn(0, None, 0.5)
    discrete = replace(system, sample_time=Ts)
    with pytest.raises(malta.InputError, match="whole samples before a system in discrete time"):
        malta.robust_margin(discrete, law, {"q": 0.1})
