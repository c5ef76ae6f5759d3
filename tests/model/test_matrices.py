"""Machines from plain matrices: design, margin, gain file, simulation and campaign in a few lines of Python."""

from __future__ import annotations

import doctest
import json
import pickle
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np
import pytest
from conftest import refusal

import malta
from malta.gains import encodings
from malta.loops.parametric_loops import machine_system
from malta.model.linear.formulas import value_of
from malta.model.linear.machine import formula
from malta.model.plant import Plant, Signal
from malta.simulation.experiments.catalogue import jump
from malta.synthesis.pid import pid as design_pid

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.model.linearize import LinearModel
    from malta.synthesis.controller import Controller

PAGE = Path("docs/howto/margin.md")
SUFFIXES = (".json", ".npz", ".mat")
A = [[0, 1, 0], [0, -1, 2], [0, 0, -30]]  # a motor: angle, speed, current
B = [[0], [0], [30]]
C = [[1, 0, 0]]
TURNED_BY = [[0, 0, 0], [0, 0, 1], [0, 0, 0]]
LABELS: dict[str, Any] = {
    "states": ["phi [rad]", "w [rad/s]", "i [A]"],
    "inputs": ["u [V]"],
    "outputs": ["phi [rad]"],
}


@pytest.fixture(scope="module")
def motor() -> Plant:
    """The motor; what the current turns it by is uncertain: 2 + k."""
    return malta.linear_machine(
        A, B, C, name="motor", **LABELS, nominal={"k": 0.5}, terms={"k": [TURNED_BY]}, noise=1e-6
    )


@pytest.fixture(scope="module")
def driven(motor: Plant) -> Controller:
    """Its LQG with an integral."""
    model = malta.linearize(motor, motor.at())
    return malta.lqg(
        model, malta.synthesis.weights([10, 1, 0], [1], [1e-2], [1e-8], q_i=[10]), 1e-3, name="driven"
    )


def test_design_margin_and_gain_file_in_five_lines(tmp_path: Path) -> None:
    """An unstable pole at 10 rad/s."""
    plant = malta.linear_machine(
        [[0, 1], [100, 0]], [[0], [1]], [[1, 0]], nominal={"k": 0}, terms={"k": [[[0, 0], [1, 0]]]}
    )
    model = malta.linearize(plant, plant.at())
    controller = malta.lqg(model, malta.synthesis.weights([1e4, 1], [1], [1], [1e-8]), Ts=1e-3)
    margin = malta.robust_margin(*machine_system(plant, controller, ["k"], {}), {"k": (-50, 50)})
    malta.gains.write(controller, malta.verify(model, controller), tmp_path / "plain.json")

    assert margin.lower is not None
    assert margin.lower <= margin.upper <= margin.lower * 1.001
    content = json.loads((tmp_path / "plain.json").read_text())
    assert (content["version"], content["law"], content["plant"]["name"]) == (
        2,
        {"tracks": "states"},
        "linear",
    )
    assert content["plant"]["linear"]["matrices"] == {"A": [[0, 1], [100, 0]], "B": [[0], [1]], "C": [[1, 0]]}
    assert malta.gains.read(tmp_path / "plain.json").parameters == plant.parameters


def test_the_lines_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = (
        b for b in re.findall(r"```pycon\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S) if "by_k" in b
    )
    example = doctest.DocTestParser().get_doctest(block, {"malta": malta}, PAGE.name, None, 0)
    monkeypatch.chdir(tmp_path)
    assert doctest.DocTestRunner().run(example) == (0, 6)
    assert malta.gains.read(tmp_path / "plain.json").integrating is False


def test_the_margin_is_lost_where_the_poles_say(motor: Plant, driven: Controller) -> None:
    found = malta.verify(malta.linearize(motor, motor.at()), driven, {"k": 1.0}).robust
    assert found is not None
    assert found.lower == pytest.approx(found.upper, rel=1e-3)
    (k,) = found.witness.values() if found.witness else (np.nan,)
    lost = malta.linear_machine(A, B, C, nominal={"k": k}, terms={"k": [TURNED_BY]})
    radius = malta.verify(malta.linearize(lost, lost.at()), driven).stages[-1].spectral_radius
    assert radius == pytest.approx(1, abs=1e-7)
    assert abs(k - 0.5) == pytest.approx(found.upper * 0.5, rel=1e-9)


def test_matrices_of_a_shipped_machine_give_its_gains(model: LinearModel) -> None:
    spec = malta.read_design("design/calibrated.toml")
    shipped = malta.synthesize(spec, model)
    plain = malta.linear_machine(model.sys, name="plain")
    assert [s.name for s in plain.states] == [s.name for s in model.plant.design_states]
    found = malta.lqg(malta.linearize(plain, plain.at()), spec.weights, spec.sample_time, spec.discretization)
    for name in ("Ad", "Bd", "Cd", "K", "Ki", "L"):
        assert np.array_equal(getattr(found, name), getattr(shipped, name)), name


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_gain_file_brings_the_machine_along(
    motor: Plant, driven: Controller, suffix: str, tmp_path: Path
) -> None:
    path = tmp_path / f"driven{suffix}"
    margins = malta.verify(malta.linearize(motor, motor.at()), driven, {"k": 0.5})
    malta.gains.write(driven, margins, path)
    found = malta.gains.read(path)
    assert found.parameters == driven.parameters
    assert malta.plant_of(found.parameters) is motor
    assert malta.gains.document(found, margins)["sha256"] == encodings.decode(path)["sha256"]
    assert found.limits.force == np.inf


@pytest.mark.parametrize("value", [2, 2.0, np.int64(2), np.float64(2)])
def test_any_number_is_a_nominal_value(value: Any, tmp_path: Path) -> None:
    plant = malta.linear_machine([[0]], [[1]], [[1]], nominal={"k": value}, terms={"k": [[[1]]]})
    model = malta.linearize(plant, plant.at())
    controller = malta.lqg(model, malta.synthesis.weights([1], [1], [1], [1]), 0.01)
    malta.gains.write(controller, malta.verify(model, controller), tmp_path / "k.json")
    assert malta.gains.read(tmp_path / "k.json").parameters == plant.parameters


def test_pickle_keeps_the_parameters(motor: Plant) -> None:
    assert pickle.loads(pickle.dumps(motor.parameters)) == motor.parameters


def test_simulation_is_the_step_response_of_the_loop(motor: Plant, driven: Controller) -> None:
    at = partial(jump, output=0, size=1e-3, at=9.5e-3)
    run = malta.simulate(motor, driven, malta.Scenario("step", 0.4, at, fidelity="force", substeps=4))
    first = int(np.argmax(run.reference[:, 0] > 0))
    response = control.step_response(malta.loops.loop_systems(motor, driven).tracking, run.t[:-first])
    assert np.abs(run.p[first:, 0] - 1e-3 * response.outputs.ravel()).max() < 1e-12 * 1e-3
    assert run.p[-1, 0] == pytest.approx(0.44e-3, abs=0.01e-3)


def test_the_reference_is_the_rest_with_these_outputs(motor: Plant, driven: Controller) -> None:
    """phi = 0.2 rad wants neither speed nor current: the machine that starts there stays."""

    def lateral_outputs(plant: Plant) -> Any:
        return jump(plant, output=0, size=0.2, at=0)

    run = malta.simulate(motor, driven, malta.Scenario("aside", 0.05, lateral_outputs, fidelity="force"))
    assert np.abs(run.x - [0.2, 0, 0]).max() < 1e-15
    stable = malta.linear_machine([[-2.0, 1], [0, -3]], [[0], [3]], [[1, 0]])  # x2 = 2 y at rest
    assert np.array(ca.DM(stable.position_of(ca.DM([0.5])))).ravel() == pytest.approx([0.5, 1.0], rel=1e-14)


def test_a_campaign_varies_the_entries(driven: Controller) -> None:
    plan = malta.campaigns.Plan(driven, "step", {"k": 0.2}, samples=24, options={"time": 0.1})
    found = malta.campaign(plan)
    assert found.rate.passed == 24
    one, values = found.batch.deviation[5, 0], dict(zip(found.names, found.values[5], strict=True))
    other = malta.linear_machine(
        A, B, C, name="motor", **LABELS, nominal=values, terms={"k": [TURNED_BY]}, noise=1e-6
    )
    assert not np.array_equal(found.batch.deviation, found.batch.deviation[:1].repeat(24, axis=0))
    alone = malta.experiment("step", other, driven, time=0.1, noise=0.0).cases[0].run
    assert np.abs(alone.p - alone.reference).max() == pytest.approx(one, rel=0.05)  # there with noise


def test_machines_of_the_same_names_share_no_functions(motor: Plant, driven: Controller) -> None:
    """What is compiled for one must not serve another whose matrices differ."""
    doubled = np.array(A) * [[1], [2], [1]]
    other = malta.linear_machine(
        doubled, B, C, name="other", **LABELS, nominal={"k": 0.5}, terms={"k": [TURNED_BY]}
    )
    scenario = malta.Scenario("step", 0.1, partial(jump, output=0, size=1e-3, at=0.01), fidelity="force")
    first, second = (malta.simulate(plant, driven, scenario) for plant in (motor, other))
    expected = malta.simulate(other, driven, scenario, engine="virtual machine")
    assert np.abs(second.p - expected.p).max() < 1e-12
    assert np.abs(second.p - first.p).max() > 1e-6


@pytest.mark.parametrize("engine", ["auto", "virtual machine"])
def test_one_state_is_enough(engine: Any) -> None:
    """x' = x + u, a column of one entry everywhere."""
    plant = malta.linear_machine([[1]], [[1]], [[1]])
    controller = malta.lqg(
        malta.linearize(plant, plant.at()), malta.synthesis.weights([1], [1], [1], [1e-6]), 0.01
    )
    scenario = malta.Scenario("let go", 1.0, malta.references.hold, start={"x1": 1.0}, fidelity="force")
    run = malta.simulate(plant, controller, scenario.replace(substeps=4), engine=engine)
    expected = [1.0]
    K, L, Ad, Bd = (float(M[0, 0]) for M in (controller.K, controller.L, controller.Ad, controller.Bd))
    predicted = 1.0
    for _ in run.t[1:]:
        estimate = predicted + L * (expected[-1] - predicted)
        v = -K * estimate
        predicted = Ad * estimate + Bd * v
        expected.append(np.exp(0.01) * expected[-1] + np.expm1(0.01) * v)
    assert run.x[:, 0] == pytest.approx(expected, rel=1e-11)


def test_what_needs_positions_and_rates_says_so(motor: Plant, driven: Controller) -> None:
    model = malta.linearize(motor, motor.at())
    assert not motor.second_order
    assert set(malta.verify(model, driven).bandwidth) == {"sigma_max_T", "sigma_min_T", "crossover_max"}
    assert driven.feedforward.rate.shape == (0, 1)
    kalman = malta.Scenario("hold", 0.01, malta.references.hold, fidelity="force", estimator="kalman")
    attraction = malta.Scenario(
        "hold", 0.01, malta.references.hold, fidelity="force", feedforward="attraction"
    )
    pid = malta.synthesis.spec.Pid(np.ones(1), np.ones(1), np.ones(1), 0.0)
    asked: dict[str, Callable[[], object]] = {
        "stiffness": lambda: model.stiffness,
        "pid": lambda: design_pid(model, pid, 1e-3),
        "estimator kalman": lambda: malta.simulate(motor, driven, kalman),
        "feedforward attraction": lambda: malta.simulate(motor, driven, attraction),
    }
    for field, ask in asked.items():
        with pytest.raises(malta.InputError) as caught:
            ask()
        assert str(caught.value) == (
            f"motor: {field}: found states that are not positions and then their rates, expected x = (q, q')"
        )


def test_robustness_finds_every_stage(motor: Plant, driven: Controller) -> None:
    found = malta.verify(motor, driven, {"k": 0.2}, stages=True, proof=False)
    assert [link.name for link in found.chain] == ["LQR", "LQI", "LQG", "LQGI", "sampled"]
    assert found.chain[0].peak == pytest.approx(1, abs=1e-6)  # Kalman's inequality


def test_every_shipped_machine_is_of_second_order() -> None:
    for name in ("table2", "halbach", "planar"):
        plant = malta.read_design(f"design/{name}.toml").plant
        assert plant.second_order
        assert 2 * plant.coordinates == len(plant.controlled)


def test_labels_come_from_the_system() -> None:
    named = control.ss(A, B, C, 0, states=["a", "b", "c"], inputs=["u"], outputs=["a"], name="named")
    plant = malta.linear_machine(named)
    assert plant.name == "named"
    assert plant.states == (Signal("a", "1"), Signal("b", "1"), Signal("c", "1"))
    numbered = malta.linear_machine(control.ss(A, B, C, 0))
    assert numbered.name == "linear"
    assert [s.name for s in numbered.states] == ["x1", "x2", "x3"]


ONE: dict[str, Any] = {"A": [[1.0]], "B": [[1.0]], "C": [[1.0]]}


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"A": [[1, 2]]}, "A: found shape (1, 2), expected (1, 1), at least 1 x 1"),
        ({"B": [1]}, "B: found 1 dimensions, expected a matrix of finite numbers, as [[0, 1], [2, 0]]"),
        (
            {"A": [[np.nan]]},
            "A: found NaN or infinity, expected a matrix of finite numbers, as [[0, 1], [2, 0]]",
        ),
        ({"C": "no"}, "C: found a str, expected a matrix of numbers"),
        ({"nominal": {"k": 1}}, "terms.k: found nothing, expected a nominal value and its terms"),
        ({"terms": {"k": [[[1]]]}}, "nominal.k: found nothing, expected a nominal value and its terms"),
        (
            {"nominal": {"k": 1}, "terms": {"k": [[[1, 2]]]}},
            "terms.k: A: found shape (1, 2), expected (1, 1)",
        ),
        (
            {"nominal": {"a b": 1}, "terms": {"a b": []}},
            "nominal.a b: found this name, expected a name as Python has them",
        ),
        ({"nominal": {"k": "1"}, "terms": {"k": [[[1]]]}}, "k: found '1', expected a finite number in 1"),
        ({"states": ["a", "b"]}, "states: found 2 names, expected 1 names in a list"),
        ({"outputs": ["a.b"]}, "outputs: found 'a.b', expected a name without dots, or \"z [m]\""),
        ({"limit": 0}, "limit: found 0, expected a number above 0, or 1 of them"),
        ({"noise": -1}, "noise: found -1, expected a number of at least 0, or 1 of them"),
        ({"name": "tubular"}, "name: found 'tubular', expected a name that no other machine has"),
        (
            {"nose": 1},
            "nose: found an unknown detail, expected one of "
            "name states inputs outputs nominal terms formulas limits limit noise dead_time computation_time range "
            "(did you mean 'noise'?)",
        ),
    ],
)
def test_bad_matrices_get_one_sentence(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        malta.linear_machine(**(ONE | given))
    assert str(caught.value) == f"linear_machine: {sentence}"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            {"formulas": {"A_2_1": "k"}},
            "formulas.A_2_1: found no entry of A, B or C, expected A_2_1 for row 2",
        ),
        ({"formulas": {"A_1_1": 2}}, "formulas.A_1_1: found a int, expected a formula"),
        ({"formulas": {"A_1_1": "q / 2"}}, "formulas.A_1_1: found 'q', which is none of the parameters k"),
        ({"formulas": {"A_1_1": "__import__('os')"}}, "found \"__import__('os')\", which no formula has"),
        ({"formulas": {"A_1_1": "1 / (k - 1)"}}, "found no value (float division by zero)"),
        ({"formulas": {"A_1_1": "(" * 300 + "k" + ")" * 300}}, "found no formula"),
        ({"formulas": {"A_1_1": "-" * 3000 + "k"}}, "found too many brackets in brackets"),
        ({"formulas": {"A_1_1": "k" * 4001}}, "found 4001 characters, of at most 4000"),
        ({"formulas": {"A_1_1": "9**9**9**9"}}, "found no value"),
        ({"formulas": {"A_1_1": "(-k)**0.5"}}, "not a finite number"),
        ({"limits": {"q": (0, 1)}}, "limits.q: found an unknown parameter, expected k"),
        ({"limits": {"k": (2, 0)}}, "limits.k: found (2, 0), expected (above, below), the lower one first"),
        ({"limits": {"k": 1}}, "limits.k: found 1, expected (above, below), two numbers"),
        ({"limits": {"k": (1, 2)}}, "k: found 1"),
    ],
)
def test_bad_formulas_get_one_sentence(given: dict[str, Any], sentence: str) -> None:
    details = {**ONE, "nominal": {"k": 1}, "formulas": {"A_1_1": "k"}, **given}
    with pytest.raises(malta.InputError) as caught:
        malta.linear_machine(**details)
    assert sentence in str(caught.value)


k, m = ca.SX.sym("k"), ca.SX.sym("m")
EXPRESSIONS = [
    -2 * k / (m + 1) ** 2, k - (m - k), -(k * m), -(k**2), k**-1.5, 1 / (k * m), 2 * (k + m), k / (m / k), k * -m,
    ca.sqrt(k) * ca.sin(-m), ca.exp(-k / m), m**k, (m**k) ** k, m ** (k**m), k + (m + k), 0.1 + k, ca.tanh(k) - 1e-30,
]  # fmt: skip


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_a_formula_gives_back_its_expression_to_the_bit(expression: Any) -> None:
    text = formula(expression, ca.vertcat(k, m), ["k", "m"])
    back = ca.Function("both", [k, m], [expression, value_of(text, {"k": k, "m": m})])
    rng = np.random.default_rng(1)
    for one in rng.uniform(0.2, 3, (5, 2)).tolist():
        wanted, found = map(float, back(*one))
        assert wanted == found
        assert value_of(text, dict(zip("km", one, strict=True))) == pytest.approx(wanted, rel=1e-14)


def geared(J: Any, b: Any, k: Any) -> Any:
    """A motor on a negative spring: every entry depends on J, and not linearly."""
    return [[0, 1], [k / J, -b / J]], [[0], [1 / J]], [[1, 0]]


@pytest.mark.slow_for(".json")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_uncertain_system_is_a_machine(suffix: str, tmp_path: Path) -> None:
    """It is designed, proven, simulated and stored, with the poles and the margin of the uncertain system."""
    system = malta.uncertain(geared, {"J": 2e-3, "b": 0.1, "k": 5.0}, limits={"J": (0, np.inf)})
    machine = malta.linear_machine(system, name="geared", states=["q [rad]", "w [rad/s]"])
    model = malta.linearize(machine, machine.at())
    (A,), (B,), _ = system.at(system.nominal)
    assert np.array_equal(model.A, A)
    assert np.array_equal(model.B, B)
    law = malta.lqg(model, malta.synthesis.weights([1e6, 0], [1], [1e-2], [1e-12]), Ts=1e-3, name="geared")
    report = malta.verify(model, law, {"J": 0.2, "b": 0.2, "k": 0.3})
    assert report.robust is not None
    malta.gains.write(law, report, tmp_path / f"geared{suffix}")
    found = malta.gains.read(tmp_path / f"geared{suffix}")
    assert found.parameters == law.parameters
    assert pickle.loads(pickle.dumps(found.parameters)) == law.parameters
    again = malta.uncertain(malta.plant_of(found.parameters), ["J", "b", "k"])
    assert again.limits[0] == (0, np.inf)
    for row in np.random.default_rng(2).uniform(0.5, 2, (4, 3)) * system.nominal:
        for one, other in zip(again.at(row), system.at(row), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-15)
    assert report.robust.witness is not None
    lost = malta.linear_machine(
        malta.uncertain(geared, dict(report.robust.witness), limits={"J": (0, np.inf)}),
        name="geared", states=["q [rad]", "w [rad/s]"],
    )  # fmt: skip
    radius = malta.verify(malta.linearize(lost, lost.at()), law).stages[-1].spectral_radius
    assert radius == pytest.approx(1, abs=1e-7)


def test_a_campaign_varies_what_formulas_have() -> None:
    machine = malta.linear_machine(malta.uncertain(geared, {"J": 2e-3, "b": 0.1, "k": 5.0}), name="geared")
    model = malta.linearize(machine, machine.at())
    law = malta.lqg(model, malta.synthesis.weights([1e6, 0], [1], [1e-2], [1e-12]), Ts=1e-3)
    found = malta.campaign(malta.campaigns.Plan(law, "step", {"J": 0.2}, samples=12, options={"time": 0.05}))
    values = dict(zip(found.names, found.values[3], strict=True))
    other = malta.linear_machine(malta.uncertain(geared, {"b": 0.1, "k": 5.0} | values), name="geared")
    alone = malta.experiment("step", other, law, time=0.05, noise=0.0).cases[0].run
    rms = float(np.sqrt(((alone.p - alone.reference) ** 2).mean()))
    assert rms == pytest.approx(found.batch.rms[3, 0], rel=1e-6)
    assert np.ptp(found.batch.rms[:, 0]) > 1e-3 * rms


@pytest.mark.parametrize(
    ("source", "options", "sentence"),
    [
        (lambda k: ([[k]], [[1]], [[1]], [[1]]), {}, "D: found inputs that the outputs follow at once"),
        (
            lambda k: ([[k]], [[1]], [[1]]),
            {"sample_time": 0.1},
            "A: found an uncertain system in discrete time",
        ),
        (
            lambda k: (np.eye(2) * k, np.eye(2), np.eye(2), np.zeros((2, 2)), [[1, k], [0, 1]]),
            {},
            "E: found an E",
        ),
        (lambda k: ([[ca.fabs(k)]], [[1]], [[1]]), {}, "A_1_1: found operation"),
    ],
)
def test_uncertain_systems_that_are_no_machine_get_one_sentence(
    source: Any, options: Any, sentence: str
) -> None:
    with pytest.raises(malta.InputError, match=sentence):
        malta.linear_machine(malta.uncertain(source, {"k": 1.0}, **options))


def test_a_mass_in_E_divides_its_row() -> None:
    machine = malta.linear_machine(
        malta.uncertain(lambda k: ([[3.0]], [[2.0]], [[1]], [[0]], [[k]]), {"k": 4.0}), name="divided"
    )
    assert malta.linearize(machine, machine.at()).A.item() == 0.75


@pytest.mark.parametrize(
    ("source", "field"),
    [
        (lambda k: k, "A: found a function, expected what malta.uncertain"),
        (control.ss([[0.5]], [[1]], [[1]], 0, 0.1), "A: found a discrete system, dt = 0.1"),
        (control.ss([[0.5]], [[1]], [[1]], 1), "D: found inputs that the outputs follow at once"),
        (np.eye(2), "A: found a ndarray alone"),
    ],
)
def test_bad_systems_get_one_sentence(source: Any, field: str) -> None:
    with pytest.raises(malta.InputError, match=field):
        malta.linear_machine(source)


def test_names_of_shipped_machines_are_taken(model: LinearModel) -> None:
    with pytest.raises(malta.InputError, match="name: found 'tubular'"):
        malta.linear_machine(model.sys, name="tubular")


def changed(edit: Callable[[dict[str, Any]], object], path: Path, sound: Path) -> Path:
    content = json.loads(sound.read_text())
    edit(content)
    content["sha256"] = encodings.content_sha256(content)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("edit", "field"),
    [
        (lambda d: d.update(version=1), "version"),
        (lambda d: (d.pop("law"), d.update(version=1)), "plant.linear"),
        (lambda d: d["law"].update(tracks="nothing"), "law.tracks"),
        (lambda d: d["plant"].update(name="tubular"), "plant.linear"),
        (lambda d: d["plant"].pop("linear"), "plant.name"),
        (lambda d: d["plant"]["linear"]["matrices"]["A"].pop(), "plant.linear.A"),
        (lambda d: d["plant"]["linear"]["terms"].pop("k"), "plant.linear.terms.k"),
        (lambda d: d["plant"]["parameters"]["k"].update(unit="kg"), "plant.parameters.k.unit"),
        (lambda d: d["feedforward"].update(rate=[[0.0]]), "feedforward.rate"),
        (lambda d: d["limits"].update(force=[-1.0]), "limits.force"),
    ],
)
def test_damaged_tables_get_one_sentence(
    edit: Any, field: str, motor: Plant, driven: Controller, tmp_path: Path
) -> None:
    sound = tmp_path / "sound.json"
    malta.gains.write(driven, malta.verify(malta.linearize(motor, motor.at()), driven), sound)
    path = changed(edit, tmp_path / "changed.json", sound)
    assert refusal(lambda: malta.gains.read(path), path).field == field
