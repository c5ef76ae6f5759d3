"""Machines with unlike numbers of forces and measurements: laws, loops, proofs, flights, C; a current as a state."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from test_unusual_exports import passes

import malta
from malta.errors import CheckError, InputError
from malta.firmware.flight import view
from malta.firmware.signals import Target
from malta.firmware.supervised_flight import Flown, Interference, Requests, supervised_engine
from malta.firmware.supervisor import STATES, prediction_correction
from malta.synthesis.law import law
from malta.synthesis.pid import pid
from malta.synthesis.separation import controller_poles
from malta.synthesis.spec import Pid

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

pytestmark = pytest.mark.usefixtures("proven_once")

G = 9.81  # m/s^2


def cart_pole() -> Plant:
    """One force, two measurements: a pole that stands on a cart."""

    def matrices(M: Any, m: Any, l: Any) -> Any:  # noqa: E741
        fall, tip = -m * G / M, (M + m) * G / (M * l)
        A = [[0, 0, 1, 0], [0, 0, 0, 1], [0, fall, 0, 0], [0, tip, 0, 0]]
        return A, [[0], [0], [1 / M], [-1 / (M * l)]], [[1, 0, 0, 0], [0, 1, 0, 0]]

    system = malta.uncertain(matrices, {"M": 1.0, "m": 0.2, "l": 0.5})
    states = ["x [m]", "phi [rad]", "dx [m/s]", "dphi [rad/s]"]
    outputs = ["x [m]", "phi [rad]"]
    return malta.linear_machine(
        system, name="cart_pole", states=states, inputs=["F [N]"], outputs=outputs, noise=1e-5, limit=30.0
    )


def two_sensors() -> Plant:
    """One force, a position that two sensors read."""
    system = malta.uncertain(
        lambda k, b: ([[0, 1], [k, 0]], [[0], [b]], [[1, 0], [1, 0]]), {"k": 900.0, "b": 2.0}
    )
    outputs = ["y1 [m]", "y2 [m]"]
    return malta.linear_machine(
        system, name="pair", states=["z [m]", "dz [m/s]"], outputs=outputs, noise=1e-6, limit=5.0
    )


def three_forces() -> Plant:
    """Three forces, height and tilt measured."""

    def matrices(k: Any, b: Any) -> Any:
        A = [[0, 0, 1, 0], [0, 0, 0, 1], [400 * k, 0, 0, 0], [0, 900 * k, 0, 0]]
        return A, [[0] * 3, [0] * 3, [b, b, b], [2 * b, -b, -b]], [[1, 0, 0, 0], [0, 1, 0, 0]]

    system = malta.uncertain(matrices, {"k": 1.0, "b": 1.0})
    states = ["z [m]", "a [rad]", "dz [m/s]", "da [rad/s]"]
    outputs = ["z_y [m]", "a_y [rad]"]
    return malta.linear_machine(system, name="three", states=states, outputs=outputs, noise=1e-6, limit=5.0)


Case = tuple[Callable[[], "Plant"], dict[str, Any], float, dict[str, float]]
BALL: dict[str, Any] = {"q": [1e8, 1e4], "r": [1], "w": [1e-2], "v": [1e-12] * 2, "q_i": [1e10, 0]}
CART: dict[str, Any] = {"q": [10, 1, 0, 0], "r": [1], "w": [1e-2], "v": [1e-8] * 2, "q_i": [3, 0]}
PLATE: dict[str, Any] = {
    "q": [1e8, 1e8, 1e4, 1e4], "r": [1] * 3, "w": [1e-2] * 3, "v": [1e-12] * 2, "q_i": [1e10] * 2,
}  # fmt: skip
CASES: dict[str, Case] = {
    "cart": (cart_pole, CART, 5e-3, {"M": 0.1, "m": 0.2, "l": 0.1}),
    "pair": (two_sensors, BALL, 1e-3, {"k": 0.2, "b": 0.2}),
    "three": (three_forces, PLATE, 1e-3, {"k": 0.2, "b": 0.2}),
}


def designed(name: str, **changes: Any) -> tuple[Plant, Controller]:
    make, weights, Ts, _ = CASES[name]
    plant = make()
    model = malta.linearize(plant, plant.at())
    return plant, malta.lqg(model, malta.synthesis.weights(**(weights | changes)), Ts)


@pytest.mark.parametrize("name", CASES)
def test_the_loop_has_the_poles_of_regulator_and_filter(name: str) -> None:
    """Separation: the loop by the control period, and both designs by themselves; sums without a weight have none."""
    plant, c = designed(name)
    found = np.sort(np.abs(np.linalg.eigvals(malta.loop(plant, c).matrix)))
    wanted = np.sort(np.abs(np.concatenate(controller_poles(c))))
    assert found == pytest.approx(wanted, rel=1e-6)
    assert found[-1] < 1
    assert c.summed == tuple(np.flatnonzero(CASES[name][1]["q_i"]))


@pytest.mark.slow_for("three")
@pytest.mark.parametrize("name", CASES)
def test_what_is_proven_is_lost_at_the_witness(name: str) -> None:
    plant, c = designed(name)
    margin = malta.robust_margin(malta.loop(plant, c), CASES[name][3])
    assert margin.lower is not None
    assert 3 < margin.lower <= margin.upper < 5
    assert margin.witness is not None
    lost = malta.loop(plant, c, parameters={k: float(v) for k, v in margin.witness.items()})
    assert np.abs(np.linalg.eigvals(lost.matrix)).max() == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(("name", "start"), [("cart", 0.05), ("pair", 1e-4), ("three", 1e-4)])
def test_it_comes_to_rest(name: str, start: float) -> None:
    plant, c = designed(name)
    lasts = 4000 * c.sample_time
    scenario = malta.Scenario(
        "rest", lasts, malta.references.hold, fidelity="force", start={plant.states[0].name: start}
    )
    run = malta.simulate(plant, c, scenario)
    assert run.verdict.completed
    assert np.abs(run.x[-1]).max() < 1e-4 * start
    assert run.saturated.shape[1] == len(plant.inputs)


def test_integrals_and_filter_are_those_of_python_control() -> None:
    import control

    plant = cart_pole()
    model, w = malta.linearize(plant, plant.at()), malta.synthesis.weights(**CART)
    K, Ki = malta.synthesis.lqi(model, w)
    Q = np.diag([10, 1, 0, 0, 3])
    wanted = control.lqr(model.A, model.B, Q, w.R, integral_action=model.C[:1])[0]
    assert np.abs(np.hstack([K, Ki[:, :1]])) == pytest.approx(np.abs(wanted), rel=1e-6)
    assert (Ki[:, 1] == 0).all()
    L = malta.synthesis.kalman(model, w)
    lqe = control.lqe(model.A, model.B, model.C, np.diag(w.process_variance), np.diag(w.sensor_variance))[0]
    assert np.asarray(lqe) == pytest.approx(L, rel=1e-6, abs=1e-9)


def test_two_equal_sensors_are_one_of_half_the_variance() -> None:
    _, c = designed("pair")
    one = malta.linear_machine([[0, 1], [900, 0]], [[0], [2]], [[1, 0]])
    weights = malta.synthesis.weights(q=[1e8, 1e4], r=[1], w=[1e-2], v=[0.5e-12], q_i=[1e10])
    single = malta.lqg(malta.linearize(one, one.at()), weights, 1e-3)
    assert c.L.sum(axis=1) == pytest.approx(single.L[:, 0], rel=1e-9)
    assert pytest.approx(single.K, rel=1e-9) == c.K


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("cart", {"q_i": [3, 1]}, "F cannot hold x phi at rest, each at a reference of its own"),
        ("pair", {"q_i": [1e10, 1e10]}, "u1 cannot hold y1 y2 at rest"),
    ],
)
def test_outputs_that_no_force_holds_are_refused(name: str, changes: Any, words: str) -> None:
    with pytest.raises(CheckError, match=words):
        designed(name, **changes)


def test_a_pid_is_refused() -> None:
    plant = two_sensors()
    terms = Pid(np.ones(1), np.ones(1), np.ones(1), 0.0)
    with pytest.raises(InputError, match="1 forces and 2 measurements"):
        pid(malta.linearize(plant, plant.at()), terms, 1e-3)


@pytest.mark.parametrize(("name", "waits"), [("cart", [1, 0]), ("three", [1, 1])])
def test_sums_wait_while_a_force_that_they_drive_saturates(name: str, waits: list[int]) -> None:
    _, c = designed(name)
    n, m, p = len(c.states), len(c.forces), len(c.measurements)
    step, zeros = law(c), np.zeros
    at_rest = [zeros(n), zeros(p), zeros(p), zeros(p), zeros(p), zeros(n), zeros(m), zeros(m)]
    assert np.array(step(*at_rest)[2]).ravel().tolist() == [0, 0]
    at_rest[6] = np.eye(m)[0] * 2 * c.limits.force  # v_ff of one force beyond its limit
    assert np.array(step(*at_rest)[2]).ravel().tolist() == waits


def test_the_reference_of_more_outputs_than_forces_is_a_rest_near_it() -> None:
    assert np.array(two_sensors().position_of(np.array([2.0, 4.0]))).ravel() == pytest.approx([3.0])
    assert np.array(cart_pole().position_of(np.array([2.0, 4.0]))).ravel() == pytest.approx([2.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_exported_c_passes_its_own_test(name: str, tmp_path: Path) -> None:
    """Bit by bit the numbers of the simulation's expressions."""
    passes(Target(designed(name)[1], "double", "force"), tmp_path)


# --- a voltage as command: examples/magnet ---


@pytest.mark.parametrize("name", ["magnet", "with_current"])
def test_the_magnets_model_is_that_of_its_energy(name: str) -> None:
    """q'' = 2 g (q / s + i / I), L i' = u - R i - L' I q' about the current I that holds the sphere."""
    spec = malta.read_design(f"examples/magnet/design/{name}.toml")
    par: Any = spec.parameters
    model = malta.linearize(spec.plant, spec.plant.at())
    held = par.s * np.sqrt(par.m * par.g / par.C)
    L, slope = par.L_s + 2 * par.C / par.s, 2 * par.C / par.s**2
    A = [[0, 1, 0], [2 * G / par.s, 0, 2 * G / held], [0, -slope * held / L, -par.R / L]]
    assert pytest.approx(np.array(A), rel=1e-12, abs=1e-9) == model.A
    assert model.B[:, 0] == pytest.approx([0, 0, 1 / L])
    c = malta.synthesize(spec, model)
    assert c.summed == (0,)  # of the current no integral is asked
    run = malta.simulate(
        spec.plant, c, malta.Scenario("rest", 0.4, malta.references.hold, fidelity="force", start={"q": 2e-4})
    )
    assert np.abs(run.x[-1]).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["magnet", "with_current"])
def test_what_is_proven_of_the_magnet(name: str) -> None:
    spec = malta.read_design(f"examples/magnet/design/{name}.toml")
    c = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    margin = malta.robust_margin(malta.loop(spec.plant, c), {"m": 0.1, "C": 0.1})
    assert margin.lower is not None
    assert 3.5 < margin.lower <= margin.upper


@pytest.mark.slow
@pytest.mark.parametrize("name", ["magnet", "with_current"])
def test_the_magnets_c_passes_its_own_test(name: str, tmp_path: Path) -> None:
    spec = malta.read_design(f"examples/magnet/design/{name}.toml")
    c = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    passes(Target(c, "double", "force"), tmp_path)


def test_the_equations_of_a_filter_without_a_sensor_rest_where_the_magnet_does() -> None:
    """Beside the voltage that holds the sphere they add nothing to the linear model there, and no slope to it."""
    spec = malta.read_design("examples/magnet/design/with_current.toml")
    t = Target(malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())), "double", "force")
    xi = ca.SX.sym("xi", len(t.controller.states))
    more = prediction_correction(t)(xi)
    rest, slope = ca.Function("more", [xi], [more, ca.jacobian(more, xi)])(0)
    assert np.abs(np.array(rest)).max() < 1e-15
    assert np.abs(np.array(slope)).max() < 1e-12 * np.abs(t.controller.A).max()


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
def test_the_magnet_that_loses_a_sensor_is_held_by_the_other_until_it_lands(lost: int) -> None:
    """Its position is known by what motion induces in its current: the sphere stays within 0.1 mm for 11.5 ms."""
    spec = malta.read_design("examples/magnet/design/with_current.toml")
    c = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))

    def lose(t: float, inputs: Any, _: Any) -> None:
        if t >= 0.1:
            view(inputs, "y")[lost] = np.nan

    flights: list[Flown] = []
    requests = Requests(take_over=(1.5e-3, 0.0), operate=0.0, start=9.0)
    engine = supervised_engine(flights, requests, faults=Interference(lose, lambda _t, _o: None))
    scenario = malta.Scenario("hold", 0.2, malta.references.hold, fidelity="force", noise=1.0, seed=1)
    run = malta.simulate(spec.plant, c, scenario, engine=engine)
    (flown,) = flights
    states = [list(STATES)[k] for k in flown.state]
    seen = [one for one, before in zip(states, ["", *states], strict=False) if one != before]
    assert seen[:3] == ["OPERATE", "HOLD", "LANDING"]
    assert "FAULT" not in seen
    landing = flown.t[states.index("LANDING")]
    assert landing == pytest.approx(0.1 + 11.5e-3, abs=1e-3)
    assert np.abs(run.x[run.t <= landing, 0]).max() < 1e-4
