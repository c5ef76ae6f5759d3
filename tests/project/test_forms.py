"""Second forms of arguments: LinearModel, Plant or StateSpace where a model is asked for, a Controller as a law."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

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
