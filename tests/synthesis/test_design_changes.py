"""`malta design --set`: parameters of the machine and entries of the design file, without an edit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run, one_sentence

import malta
from malta.cli.options import name_of_changes, read_changed_design

pytestmark = pytest.mark.usefixtures("proven_once")

FILE = Path("design/calibrated.toml")
PUSHED = "inertia_feedforward=1.8"


def test_changes_reach_the_machine_and_the_design() -> None:
    plain = read_changed_design(FILE, None)
    heavy = read_changed_design(FILE, ["m=400g"])
    assert (heavy.parameters.m, heavy.name) == (0.4, "calibrated_m_400g")  # type: ignore[attr-defined]
    assert heavy.parameters.preset == "table1, changed"
    assert heavy.sha256 == plain.sha256  # of the design file alone
    other = read_changed_design(FILE, ["weights.state.z=2", "bases.state.x = 60 um", "uncertainty.m=30%"])
    names = [s.name for s in plain.plant.design_states]
    x, z = names.index("x"), names.index("z")
    assert (other.weights.q[z], other.weights.q_base[x]) == (2, pytest.approx(60e-6))
    assert np.delete(other.weights.q, z).tolist() == np.delete(plain.weights.q, z).tolist()
    assert other.uncertainty == {**plain.uncertainty, "m": 0.3}
    assert other.sha256 != plain.sha256
    assert other.summary.endswith("; with weights.state.z=2, bases.state.x = 60 um, uncertainty.m=30%")
    later = read_changed_design(FILE, ["discretization=zoh", "delay=1", "current_loop_delay=false"])
    assert (later.discretization, later.delay, later.current_loop_delay) == ("zoh", 1, False)
    many = read_changed_design(FILE, [f"weights.state.{name}=1" for name in names])
    assert len(many.name) < 60


def test_more_inertia_is_fed_forward() -> None:
    """1.8 times: the same gains; the heaviest mover with a weak drive overshoots less, the nominal one errs more."""
    plain, pushed = (read_changed_design(Path("design/robust.toml"), changes) for changes in (None, [PUSHED]))
    assert (plain.inertia_feedforward, pushed.inertia_feedforward) == (1.0, 1.8)
    assert plain.sha256 == malta.gains.read("design/gains/robust.json").spec_sha256 != pushed.sha256
    model = malta.linearize(plain.plant, plain.plant.at())
    first, second = (malta.synthesize(spec, model) for spec in (plain, pushed))
    np.testing.assert_array_equal(first.K, second.K)
    np.testing.assert_allclose(second.feedforward.inertia, 1.8 * first.feedforward.inertia, rtol=1e-12)
    par: Any = plain.parameters
    machines = {"m": par.m * np.array([1.0, 1.2]), "K_D": par.K_D * np.array([1.0, 0.85])}
    found = [
        malta.simulation.simulate_many(plain.plant, c, malta.Scenario.stroke(), machines)
        for c in (first, second)
    ]
    assert 0.7 * found[0].overshoot[1] > found[1].overshoot[1]
    assert found[0].overshoot[1] > 0.015 > found[1].overshoot[1]
    assert found[0].deviation[0, 4] < 0.1e-3 < found[1].deviation[0, 4] < 0.3e-3


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("inertia_feedforward=-1", "design/calibrated.toml: inertia_feedforward: found -1"),
        ("l_B=3kg", "--set: l_B.unit: found 'kg', expected a unit of m"),
        ("m=-1", "--set: m: found -1.0 kg, expected a finite number above 0 in kg"),
        ("nix=3", "--set: nix: found an unknown parameter, expected one of m "),
        ("m", "--set: found 'm', expected NAME=VALUE, as m=0.56 or l_B=45mm"),
        ("name=x", "--set: name: found a change of it, expected another design file"),
        (
            "weights.state.q=3",
            "design/calibrated.toml: weights.state.q: found none of the 10 states, expected one of x y ",
        ),
        ("bases.state.x=60", "design/calibrated.toml: bases.state.x: found 60, expected a table"),
        ("bases.input.x=3N", "design/calibrated.toml: bases.input: found 'SI', expected a table, to change "),
    ],
)
def test_changes_that_are_none(run: Run, tmp_path: Path, change: str, sentence: str) -> None:
    code, out, err = run("design", FILE, "--set", change, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert one_sentence(err).startswith(sentence)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_gain_files_of_the_unchanged_design_stand(run: Run, tmp_path: Path) -> None:
    folders = ("--out", tmp_path, "--figures", tmp_path)
    assert run("design", "design/table2.toml", *folders).code == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    code, out, err = run("design", "design/table2.toml", "--set", "m=0.4", *folders, "--json")
    assert (code, err) == (0, "")
    (made,) = json.loads(out)["designs"]
    assert (made["design"], made["changes"]) == ("table2_m_0_4", ["m=0.4"])
    assert {path: path.read_bytes() for path in before} == before
    content = json.loads((tmp_path / "table2_m_0_4.json").read_text(encoding="utf-8"))
    assert content["design"]["name"] == "table2_m_0_4"
    assert content["plant"]["preset"] == "table1, changed"
    assert content["plant"]["parameters"]["m"] == {"value": 0.4, "unit": "kg"}
    assert run("verify", tmp_path / "table2_m_0_4.json", "--no-proof").code == 0


@pytest.mark.parametrize(
    ("one", "other"), [("m=.4", "m=4"), ("uncertainty.m=30%", "uncertainty.m=30"), ("x=5µm", "x=5m")]
)
def test_designs_of_other_changes_have_other_names(one: str, other: str) -> None:
    """Else the gain files of one would take the place of those of the other."""
    assert name_of_changes([one]) != name_of_changes([other])
    assert name_of_changes(["m=.4"]) == name_of_changes(["m=0.4"])


@pytest.mark.parametrize("name", ["m", "weights.state.z"])
def test_a_change_is_given_once(run: Run, tmp_path: Path, name: str) -> None:
    code, _, err = run("design", FILE, "--set", f"{name}=0.3", "--set", f"{name}=0.4", "--out", tmp_path)
    assert code == 2
    assert one_sentence(err) == f"--set: {name}: found '0.4' for the second time, expected it once"
    assert not list(tmp_path.iterdir())
