"""A design file with [structure]: the shipped one holds what it asks for, its gain file is its own, refusals."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence, refusal

import malta
from malta.app.files import Edit, open_design
from malta.app.worker import searched_spec
from malta.report.page.analysis import design_entries
from malta.report.page.report import subject_of
from malta.structured.design import design_goals, structured_text, tune_design
from malta.synthesis.linear_law import linear_law
from malta.synthesis.structure import with_values
from malta.tuning.judging import judge
from malta.tuning.search import model_and_controller

if TYPE_CHECKING:
    from malta.synthesis.spec import Spec

pytestmark = pytest.mark.usefixtures("proven_once")

FILE = ROOT / "design" / "structured.toml"
GAINS = ROOT / "design" / "gains" / "structured.json"


@pytest.fixture(scope="module")
def spec() -> Spec:
    return malta.read_design(FILE)


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    """The design file with other text."""
    text = FILE.read_text(encoding="utf-8").replace("../data", (ROOT / "data").as_posix())
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "design.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_gain_file_is_that_of_the_design_file(spec: Spec) -> None:
    made, shipped = model_and_controller(spec)[1], malta.gains.read(GAINS)
    assert shipped.spec_sha256 == spec.sha256
    for name in ("Ad", "K", "L"):
        np.testing.assert_allclose(getattr(made, name), getattr(shipped, name), rtol=1e-9, atol=1e-12)


def test_each_sensor_moves_the_actuator_beside_it_with_three_states(spec: Spec) -> None:
    """The sampled law has the textbook's response: Kp + Ki / s + Kd s / (1 + T s), and a lead behind."""
    assert spec.structure is not None
    one = {e.name: e.numbers for e in spec.structure.elements}
    c = model_and_controller(spec)[1]
    law, z = linear_law(c), np.exp(1j * 2e3 * spec.sample_time)
    found = -(law.C @ np.linalg.solve(z * np.eye(len(law.A)) - law.A, law.B_y) + law.D_y)
    s = 2 / spec.sample_time * (z - 1) / (z + 1)
    expected = []
    for axis in ("radial", "axial"):
        terms, lead = one[axis], one[f"{axis}_lead"]
        pid = terms["Kp"] + terms["Ki"] / s + terms["Kd"] * s / (1 + terms["filter"] * s)
        expected.append(pid * (1 + s / lead["zero"]) / (1 + s / lead["pole"]))
    np.testing.assert_allclose(np.diag(found), [expected[0]] * 4 + [expected[1]], rtol=1e-9)
    assert np.abs(found - np.diag(np.diag(found))).max() == 0
    assert len(c.states) - 5 == 15


@pytest.mark.slow
def test_numbers_that_hold_their_goals_stay_and_are_proven(spec: Spec) -> None:
    """What binds binds, and noise by the law's Lyapunov equation is that by the covariance of the machine's loop."""
    found = tune_design(spec, keep=True)
    assert found.spec is spec
    assert found.tuned.closed
    assert found.tuned.rounds == 0
    assert found.tuned.margin is not None
    assert found.tuned.margin.lower == pytest.approx(3.0617, abs=1e-3)
    bound = [name for name, value in found.tuned.reached.items() if value > 0.99]
    assert bound == ["radial_motion y1", "force_noise fy_B1", "thrust_noise f_D"]
    reached = found.tuned.reached
    judged = {row.name: row.ratio for row in judge(spec, names=["force_noise", "thrust_noise"])}
    force = max(value for name, value in reached.items() if name.startswith("force_noise"))
    assert judged["force_noise"] == pytest.approx(force, rel=5e-3)
    assert judged["thrust_noise"] == pytest.approx(reached["thrust_noise f_D"], rel=5e-3)


def test_goals_are_those_of_the_specification_and_of_the_file(spec: Spec) -> None:
    names = [goal.name for goal in design_goals(spec)]
    assert names[:2] == ["sensitivity 2", "radial_motion x1"]
    assert names[-2:] == ["radial_load", "axial_load"]
    assert [goal.hard for goal in design_goals(spec)].count(False) == 2
    assert len(names) == 1 + 5 + 5 + 2


@pytest.mark.slow
def test_what_the_file_asks_for_is_reached(spec: Spec) -> None:
    assert all(row.holds for row in judge(spec))
    for z in (-5e-3, 0.0, 5e-3):
        loop = malta.loop(spec.plant, malta.gains.read(GAINS), z=z)
        peaks = np.abs(loop.sensitivity(np.geomspace(10, 6e4, 4000)))
        assert max(float(peaks[:, k, k].max()) for k in range(5)) < 2


@pytest.mark.slow
def test_a_worse_start_is_tuned_to_the_same_figures_and_written(spec: Spec, tmp_path: Path) -> None:
    path = written(tmp_path, ("value = 79.917", "value = 103.28"), ("value = 136.303", "value = 150"))
    found = tune_design(malta.read_design(path))
    assert found.tuned.closed
    soft = [found.tuned.reached[name] for name in ("radial_load", "axial_load")]
    assert max(soft) == pytest.approx(0.6275, rel=0.02)
    target = tmp_path / "found.toml"
    target.write_text(structured_text(found.spec, target), encoding="utf-8")
    again = malta.read_design(target)
    assert tune_design(again, keep=True).spec is again
    assert again.sha256 != spec.sha256


def test_a_report_and_the_live_page_show_the_elements(spec: Spec) -> None:
    entries = design_entries(subject_of(GAINS, spec=spec))
    shown = {e.name: (e.value, e.unit) for e in entries if e.group == "elements of the law"}
    assert len(shown) == 12
    assert shown["radial Kp"] == (79917.0, "N/m")
    files = open_design(FILE)
    edited = files.apply(files.edit({"structure.elements.axial.Kp": 15.0})).spec
    assert edited.structure is not None
    assert edited.structure.elements[2].numbers["Kp"] == 15e3


def test_numbers_change_by_their_place(spec: Spec) -> None:
    stiffer = spec.replace({"structure.elements.axial.Kp": 2e4}, name="stiffer")
    assert stiffer.structure is not None
    assert stiffer.structure.elements[2].numbers["Kp"] == 2e4
    assert model_and_controller(stiffer)[1].K[4, -1] != model_and_controller(spec)[1].K[4, -1]
    with pytest.raises(malta.InputError, match=r"structure\.elements\.radial\.Kp"):
        spec.replace({"pid.Kp.f_D": 2e4})


@pytest.mark.slow
def test_commands_take_the_gain_file(run: Run, tmp_path: Path) -> None:
    code, text, _ = run("simulate", GAINS, "--scenario", "lift-off")
    assert (code, "failed" in text) == (0, False)
    code, text, _ = run("export", GAINS, "--out", tmp_path / "c")
    assert code == 0
    assert (tmp_path / "c" / "structured.c").exists()
    code, _, err = run("tune", FILE, "--out", ROOT / "design")
    assert (code, "the design file that was given" in one_sentence(err)) == (2, True)


CENTRED = """
[structure]
axes = "centre-of-gravity"

[structure.law]
x = ["all", "shape"]
y = ["all", "shape"]
z = ["all", "shape"]
alpha = ["all", "shape"]
beta = ["all", "shape"]

[structure.elements.all]
kind = "pid"
Kp = { value = 1e5, unit = "1/s^2" }
Kd = { value = 400, unit = "1/s" }
filter = { value = 0.1, unit = "ms" }

[structure.elements.shape]
kind = "transfer"
numerator = [1, 2000]
denominator = [1, 3000]

"""


def test_laws_of_coordinates_push_with_all_actuators(tmp_path: Path) -> None:
    """v = G^-1 K(s) P^-1 e, where the design model is q'' = .. + G v, y = P q; numbers are changed by their names."""
    text = FILE.read_text(encoding="utf-8").replace("../data", (ROOT / "data").as_posix())
    path = tmp_path / "centred.toml"
    text = text[: text.index("[structure]")] + CENTRED + text[text.index("[goals.") :]
    path.write_text(text, encoding="utf-8")
    spec = malta.read_design(path)
    model, c = model_and_controller(spec)
    law, z = linear_law(c), np.exp(1j * 2e3 * spec.sample_time)
    found = -(law.C @ np.linalg.solve(z * np.eye(len(law.A)) - law.A, law.B_y) + law.D_y)
    s = 2 / spec.sample_time * (z - 1) / (z + 1)
    one = (1e5 + 400 * s / (1 + 1e-4 * s)) * (s + 2000) / (s + 3000)
    G, P = model.force_map, model.C[:, :5]
    np.testing.assert_allclose(found, one * np.linalg.inv(G) @ np.linalg.inv(P), rtol=1e-9, atol=1e-6)
    assert spec.structure is not None
    changed = with_values(spec.structure, {"shape.a0": 5e3, "all.Kp": 2e5})
    assert changed.elements[0].numbers["Kp"] == 2e5
    assert changed.elements[1].numbers == {"numerator": (1.0, 2000.0), "denominator": (1.0, 5000.0)}
    written_text = structured_text(replace(spec, law=changed), tmp_path / "found.toml")
    assert "denominator = [1.0, 5000.0]" in written_text


RADIAL = '[structure.elements.radial]\nkind = "pid"'
GOAL = '[goals.axial_load]\nkind = "gain_limit"'


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ('x1 = ["radial"', 'x3 = ["radial"', "structure.law.x3"),
        ('x1 = ["radial", "radial_lead"]', 'x1 = ["radial", "radial"]', "structure.law.x1"),
        ('z = ["axial", "axial_lead"]', 'z = ["axial"]', "structure.elements.axial_lead"),
        ('z = ["axial", "axial_lead"]', 'z = ["axial", "notch"]', "structure.law.z"),
        ('kind = "lead"', 'kind = "lag"', "structure.elements.radial_lead.kind"),
        ("zero = {", "depth = 1\nzero = {", "structure.elements.radial_lead.depth"),
        ('unit = "N/mm" }\nKi', 'unit = "N" }\nKi', "structure.elements.radial.Kp"),
        ("filter = { value = 53.0264", "# filter = { value = 53.0264", "structure.elements.radial.filter"),
        (RADIAL, RADIAL + '\nlow = { gain = { value = 1, unit = "N/mm" } }', "structure.elements.radial.low.gain"),
        (RADIAL, RADIAL + '\nhigh = { Kp = { value = 1, unit = "N/mm" } }', "structure.elements.radial.Kp"),
        ('axes = "decentralized"', 'axes = "centre-of-gravity"', "structure.law.x1"),
        ("[structure]", "[pid]\nKp = {}\nKi = {}\nKd = {}\n[structure]", "pid"),
        ("[structure]", "[search.numbers]\n[structure]", "search"),
        ("current_loop_delay = true", "current_loop_delay = false", "current_loop_delay"),
        (GOAL, '[goals.axial_load]\nkind = "poles"', "goals.axial_load.inputs"),
        ('inputs = ["load f_D"]', 'inputs = ["load f_X"]', "goals.axial_load.inputs"),
        ('inputs = ["load f_D"]', 'inputs = ["reference z", "load f_D"]', "goals.axial_load.inputs"),
        ('limit = { value = 300, unit = "um/N" }', 'limit = { value = 300, unit = "um" }', "goals.axial_load.limit"),
        ("margin = 3 ", "margin = 7 ", "specification.margin"),
        ("lift_off = true", "noise_motion = { z = { value = 1, unit = \"um\" } }", "specification.noise_motion"),
    ],
)  # fmt: skip
def test_a_wrong_file_gets_one_sentence(tmp_path: Path, old: str, new: str, field: str) -> None:
    path = written(tmp_path, (old, new))
    error = refusal(lambda: malta.read_design(path), path)
    assert error.field.removesuffix(".unit") == field


NOTCH = """
[structure.elements.bending]
kind = "notch"
frequency = { value = 70, unit = "krad/s" }
depth = 0.1
damping = 1
"""


def test_a_structure_that_no_sampled_law_has_is_refused(tmp_path: Path) -> None:
    """A notch above half of sampling, pi / 50 us = 62832 rad/s."""
    path = written(
        tmp_path, ('"axial_lead"]', '"axial_lead", "bending"]'), ("[goals.radial", NOTCH + "[goals.radial")
    )
    error = refusal(lambda: malta.read_design(path), path)
    assert error.field == "structure.elements.bending.frequency"
    assert "62832" in error.expected
    assert malta.read_design(written(tmp_path, ("[goals.radial", "[goals.radial"))).name == "structured"


def test_a_structure_that_does_not_stabilize_is_refused_and_nothing_is_written(
    run: Run, tmp_path: Path
) -> None:
    """Without an axial law the stroke is free: a fixed pole at 0."""
    path = written(tmp_path, ('z = ["axial", "axial_lead"]\n', ""))
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r"(?s)\[structure\.elements\.axial\].*?(?=\[goals)", "", text), encoding="utf-8")
    code, _, err = run("design", path, "--out", tmp_path / "gains")
    assert code == 2
    assert "cannot move the pole" in one_sentence(err)
    assert not (tmp_path / "gains").exists()


@pytest.mark.slow
def test_goals_of_a_file_that_contradict_each_other_are_named(tmp_path: Path) -> None:
    """No law with a margin of three times a fifth has a peak of |S| so near to one."""
    path = written(tmp_path, ("peak_sensitivity = 2 ", "peak_sensitivity = 1.2 "))
    with pytest.raises(malta.CheckError, match=r"hard goals: .+ against ") as caught:
        tune_design(malta.read_design(path))
    assert "sensitivity 1.2" in str(caught.value)


def test_a_search_of_weights_refuses_elements(spec: Spec) -> None:
    with pytest.raises(malta.InputError, match="tune_design"):
        malta.tune(spec)
    files = open_design(FILE)
    with pytest.raises(malta.InputError, match="malta tune"):
        searched_spec(files, files.apply(Edit()))
    with pytest.raises(malta.InputError, match=r"\[structure\]|structure"):
        tune_design(malta.read_design(ROOT / "design" / "table2.toml"))
    assert spec.structure is not None
    bare = replace(spec, specification={}, law=replace(spec.structure, goals=()))
    with pytest.raises(malta.InputError, match="a goal"):
        tune_design(bare)
