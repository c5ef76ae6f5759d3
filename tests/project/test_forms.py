"""Second forms of arguments: LinearModel, Plant or StateSpace where a model is asked for, a Controller as a law."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import control
import numpy as np
import pytest
from conftest import ROOT
from scipy.io import loadmat, savemat

import malta
from malta import structured
from malta.synthesis import weights

A, B, C = [[0.0, 1.0], [4.0, -0.1]], [[0.0], [1.0]], [[1.0, 0.0]]
COST = weights(q=[1e2, 0], r=[1], w=[1], v=[1e-6], q_i=[1e2])


def cart() -> Any:
    return malta.uncertain(lambda k: ([[0, 1], [k, -0.1]], B, C), {"k": 4.0})


def test_a_loop_of_a_model_is_that_of_its_plant_at_its_point() -> None:
    law = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
    plant = malta.plant_of(law.parameters)
    places: list[dict[str, Any]] = [{}, {"z": 5e-3}]
    for at in places:
        model = malta.linearize(plant, plant.at(**at))
        assert malta.loop(model, law).at == malta.loop(plant, law, **at).at
        assert np.array_equal(malta.loop(model, law).poles, malta.loop(plant, law, **at).poles)
    moved = malta.loop(malta.linearize(plant, plant.at()), law, z=5e-3)
    assert moved.at == {"z": 5e-3}
    with pytest.raises(
        malta.InputError, match="loop: plant: found a list, expected a Plant or a LinearModel"
    ):
        malta.loop([[1.0]], law)  # type: ignore[arg-type]


def test_an_lqg_takes_any_form_of_a_model() -> None:
    plant = malta.linear_machine(A, B, C)
    own = malta.lqg(malta.linearize(plant, plant.at()), COST, Ts=1e-3)
    for form in (plant, control.ss(A, B, C, 0)):
        found = malta.lqg(form, COST, Ts=1e-3)
        assert np.array_equal(found.K, own.K)
        assert np.array_equal(found.L, own.L)
        assert found.parameters.system.matrices == plant.parameters.system.matrices  # type: ignore[attr-defined]
    with pytest.raises(
        malta.InputError, match="lqg: model: found a list, expected a LinearModel, a Plant or a"
    ):
        malta.lqg([A, B, C], COST, Ts=1e-3)
    with pytest.raises(malta.InputError, match="linear_machine: A: found a discrete system"):
        malta.lqg(control.ss(A, B, C, 0, 1e-3), COST, Ts=1e-3)


@pytest.mark.parametrize("dead_time", [0.0, 1.5e-3])
def test_a_controller_is_a_compensator(dead_time: float) -> None:
    """The margin of matrices and a gain file's law is that of the loop of both, with the machine's delay."""
    plant = malta.linear_machine(cart(), dead_time=dead_time)
    law = malta.lqg(plant, COST, Ts=1e-3, delay=1 if dead_time else 0)
    ranges = {"k": 0.2}
    ours, whole = (
        malta.robust_margin(cart(), law, ranges),
        malta.robust_margin(malta.loop(plant, law), ranges),
    )
    assert ours.lower is not None
    assert ours.lower == pytest.approx(whole.lower, rel=2e-3)
    assert ours.upper == pytest.approx(whole.upper, rel=2e-3)


def test_a_scheduled_law_is_no_compensator() -> None:
    spec = malta.read_design(ROOT / "examples" / "magnet" / "design" / "scheduled.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    with pytest.raises(malta.InputError, match="compensator: found a scheduled law"):
        malta.robust_margin(cart(), law, {"k": 0.2})


COMPLEX: Any = np.array([[0, 1], [100 + 50j, 0]])
REFUSING: dict[str, Callable[[], Any]] = {
    "linear_machine: A": lambda: malta.linear_machine(COMPLEX, B, C),
    "linear_machine: C": lambda: malta.linear_machine(A, B, COMPLEX[1:]),
    "linear_machine: noise": lambda: malta.linear_machine(A, B, C, noise=COMPLEX[1, :1]),
    "weights: q": lambda: weights(q=COMPLEX[1], r=[1], w=[1], v=[1]),
    "compensator: law": lambda: malta.robust_margin(cart(), COMPLEX[1:, :1], {"k": 0.2}),
    "structured: law": lambda: structured.states("law", (COMPLEX, B, C, [[0]])),
    "structured: shape": lambda: structured.transfer("shape", COMPLEX[1], [1.0, 50.0]),
}


@pytest.mark.parametrize("name", REFUSING)
def test_complex_numbers_are_refused_by_name(name: str) -> None:
    with pytest.raises(
        malta.InputError, match=rf"{name}.*found complex numbers, as \S*50j, expected real numbers"
    ):
        REFUSING[name]()


def test_limits_of_commands_have_the_unit_of_the_commands() -> None:
    for name, limit in (("magnet", "12 V"), ("ball", "1.5 A")):
        plant = malta.read_design(ROOT / "examples" / name / "design" / f"{name}.toml").plant
        assert dict(plant.description.rows)["current limit"] == limit


def test_matrices_of_matlab_are_a_system_as_the_page_says(tmp_path: Path) -> None:
    """savemat writes numbers as 1 x 1, as MATLAB does."""
    page = (ROOT / "docs" / "howto" / "matlab.md").read_text(encoding="utf-8")
    assert "`control.ss(A, B, C, D, Ts.item())`" in page
    savemat(tmp_path / "K.mat", {"A": [[0.5]], "B": [[1.0]], "C": [[2.0]], "D": [[0.1]], "Ts": 1e-3})
    found = loadmat(tmp_path / "K.mat")
    law = control.ss(found["A"], found["B"], found["C"], found["D"], found["Ts"].item())
    assert (law.dt, law.D.tolist()) == (1e-3, [[0.1]])


# --- every public function that takes a machine, a law, shares or a file, with the second forms of these ---


class Ball(NamedTuple):
    """The ball's machine, its model at rest, its law, and the law's gain file."""

    plant: Any
    model: Any
    law: Any
    file: Path


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Ball:
    plant = malta.read_design(BALL / "design" / "ball.toml").plant
    model = malta.linearize(plant, plant.at())
    law = malta.synthesize(malta.read_design(BALL / "design" / "ball.toml"), model)
    file = tmp_path_factory.mktemp("ball") / "ball.json"
    malta.gains.write(law, malta.verify(model, law), file)
    return Ball(plant, model, law, file)


BALL = ROOT / "examples" / "ball"
HOLD = malta.Scenario("hold", 4e-3, malta.references.hold, fidelity="force", noise=0.0, quantize=False)
LOADS = {"push": {"w": 0.1}}
OF_MACHINES: dict[
    str, Callable[[Any, Any], Any]
] = {  # what a Plant and a LinearModel at rest have to make the same
    "loop": lambda plant, law: malta.loop(plant, law).poles,
    "verify": lambda plant, law: malta.verify(plant, law).poles.closed_loop,
    "simulate": lambda plant, law: malta.simulate(plant, law, HOLD).p,
    "simulate_many": lambda plant, law: (
        malta.simulation.simulate_many(plant, law, HOLD, {"m": np.array([0.05])}).deviation
    ),
    "choose_steps": lambda plant, law: malta.simulation.choose_steps(plant, law, HOLD).count,
    "experiment": lambda plant, law: malta.experiment("hold", plant, law, time=4e-3, noise=0.0).run.p,
    "loop_systems": lambda plant, law: malta.loops.loop_systems(plant, law).P.A,
    "recovery": lambda plant, law: malta.loops.recovery(plant, law, LOADS)[0].outputs[0].largest,
    "trim": lambda plant, _: malta.trim(plant).u,
    "linearize": lambda plant, _: malta.linearize(plant, malta.trim(plant)).A,
    "inspect": lambda plant, _: malta.inspect(plant).proves,
    "lqg": lambda plant, _: malta.lqg(plant, COST, Ts=1e-3).K,
    "block_diagram": lambda plant, law: len(malta.report.block_diagram(law, plant).axes),
}


@pytest.mark.parametrize("name", OF_MACHINES)
def test_a_model_stands_for_its_machine(name: str, ball: Ball) -> None:
    make = OF_MACHINES[name]
    np.testing.assert_array_equal(make(ball.model, ball.law), make(ball.plant, ball.law))
    with pytest.raises(malta.InputError, match=r"found .*, expected a .*(Plant|LinearModel)"):
        make([[1.0]], ball.law)


def test_a_system_of_python_control_is_a_law_of_a_loop() -> None:
    cart_plant = malta.linear_machine(A, B, C)
    sys = control.ss([[0.5]], [[1.0]], [[20.0]], [[-60.0]], 1e-3)
    own = malta.loop(cart_plant, malta.synthesis.controller_of(sys, cart_plant))
    for plant in (cart_plant, malta.linearize(cart_plant, cart_plant.at())):
        assert np.array_equal(malta.loop(plant, sys).poles, own.poles)


LAWLESS: dict[
    str, Callable[[Ball, Any], Any]
] = {  # a law is asked for: the name of its file is refused by name
    "loop": lambda b, law: malta.loop(b.plant, law),
    "simulate": lambda b, law: malta.simulate(b.plant, law, HOLD),
    "simulate_many": lambda b, law: malta.simulation.simulate_many(b.plant, law, HOLD, {"m": np.ones(1)}),
    "experiment": lambda b, law: malta.experiment("hold", b.plant, law),
    "identify": lambda _, law: malta.identify(law, None),  # type: ignore[arg-type]
    "identify_record": lambda _, law: malta.identification.identify_record(law, None),  # type: ignore[arg-type]
    "weigh": lambda _, law: malta.identification.weigh(law, None, None, {}),  # type: ignore[arg-type]
    "measure": lambda _, law: malta.measure(law),
    "replay_law": lambda _, law: malta.identification.replay_law(law, None),  # type: ignore[arg-type]
    "learn": lambda _, law: malta.learn(law, None),  # type: ignore[arg-type]
    "learn_v0": lambda _, law: malta.identification.learn_v0(law, None),  # type: ignore[arg-type]
    "learn_strokes": lambda b, law: malta.identification.learn_strokes(b.plant, law),
    "next_stroke": lambda _, law: malta.identification.next_stroke(law, None),  # type: ignore[arg-type]
    "campaign": lambda _, law: malta.campaigns.Plan(law, "hold", {"m": 0.1}),
    "block_diagram": lambda b, law: malta.report.block_diagram(law, b.plant),
}


@pytest.mark.parametrize("name", LAWLESS)
def test_the_name_of_a_gain_file_is_no_law(name: str, ball: Ball) -> None:
    for form in (str(ball.file), ball.file):
        with pytest.raises(
            malta.InputError,
            match=rf"{name}: controller: found .*, expected a Controller, as malta.gains.read gives",
        ):
            LAWLESS[name](ball, form)


def test_an_excitation_is_of_a_loop_and_an_export_of_a_file(ball: Ball, tmp_path: Path) -> None:
    with pytest.raises(malta.InputError, match=r"excite: loop: found .*, expected a Loop"):
        malta.excite(ball.law)
    for export in (malta.export_c, malta.export_fmu):
        with pytest.raises(
            malta.InputError, match=r"gains: found .*Controller, expected the name of a gain file"
        ):
            export(ball.law, tmp_path / "out")


OF_FILES: dict[str, Callable[[Any, Ball, Path], Any]] = {  # a path may be a text
    "gains.read": lambda form, b, _: malta.gains.read(form(b.file)).K,
    "gains.write": lambda form, b, to: malta.gains.write(
        b.law, malta.verify(b.model, b.law), form(to / "x.mat")
    ),
    "gains.agrees": lambda form, b, _: malta.gains.agrees(b.law, malta.verify(b.model, b.law), form(b.file)),
    "verify": lambda form, b, _: malta.verify(form(b.file), stages=False).poles.closed_loop,
    "read_design": lambda form, _, __: malta.read_design(form(BALL / "design" / "ball.toml")).sha256,
    "read": lambda form, _, __: malta.read(form(BALL / "ball.toml")).m,
    "read_published": lambda form, _, __: len(
        malta.model.read_published(form(ROOT / "data" / "halbach.toml"))
    ),
}


@pytest.mark.parametrize("name", OF_FILES)
def test_a_path_may_be_a_text(name: str, ball: Ball, tmp_path: Path) -> None:
    found = [OF_FILES[name](form, ball, tmp_path) for form in (Path, str)]
    np.testing.assert_array_equal(*found)


def test_intervals_stand_for_shares_wherever_a_box_is_asked_for(ball: Ball) -> None:
    """Values (low, high) about the nominal one; a spread of a campaign is one number, and says so."""
    plant = malta.linear_machine(cart())
    law, m = malta.lqg(plant, COST, Ts=1e-3), ball.plant.parameters.m
    proofs: list[Callable[[Any], Any]] = [
        lambda box: malta.robust_margin(cart(), law, box).lower,
        lambda box: malta.robust_margin(malta.loop(plant, law), box).lower,
        lambda box: malta.worst_case_gain(cart(), law, box).upper,
    ]
    for prove in proofs:
        assert prove({"k": (3.2, 4.8)}) == pytest.approx(prove({"k": 0.2}), rel=1e-3)
    both = (malta.verify(ball.model, ball.law, {"m": form}).robust for form in (0.2, (0.8 * m, 1.2 * m)))
    one, two = (margin.lower for margin in both if margin is not None)
    assert one == pytest.approx(two, rel=1e-3)
    with pytest.raises(
        malta.InputError, match=r"campaign: spread m: found \(0.1, 0.3\), expected one number"
    ):
        malta.campaigns.Plan(ball.law, "hold", {"m": (0.1, 0.3)})  # type: ignore[dict-item]
    with pytest.raises(malta.InputError, match="found no parameters"):
        malta.robust_margin(cart(), law, {})
