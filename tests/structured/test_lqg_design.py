"""A design file whose [structure] is an LQG with its weights: gains, text, live page, a search, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, refusal

import malta
from malta.app.fields import fields_of
from malta.app.files import open_design
from malta.report.page.analysis import design_entries
from malta.report.page.report import subject_of
from malta.structured.design import structured_text, tune_design
from malta.synthesis.linear_law import linear_law
from malta.synthesis.structure import with_values
from malta.tuning.search import model_and_controller

ELEMENT = "structure.elements.regulator"
BALL = ROOT / "examples" / "ball" / "ball.toml"
DESIGN = f"""
name = "regulator"
summary = "An LQG whose weights are tuned"
machine = "{BALL.as_posix()}"
preset = "data"
sample_time = {{ value = 200, unit = "us" }}
current_loop_delay = true
operating_point = {{}}

[uncertainty]
m = 0.2
C = 0.2

[structure.law]
all = ["regulator"]

[structure.elements.regulator]
kind = "lqg"
state = {{ q = {{ value = 100, unit = "um" }} }}
integral = {{ y = {{ value = 5, unit = "um s" }} }}
input = {{ f = {{ value = 0.5, unit = "N" }} }}
process = {{ f = {{ value = 0.1, unit = "N" }} }}
sensor = {{ y = {{ value = 2, unit = "um" }} }}

[goals.load]
kind = "gain_limit"
inputs = ["load f"]
outputs = ["output y"]
limit = {{ value = 1, unit = "mm/N" }}
soft = true

[specification]
margin = 3
peak_sensitivity = 1.6
"""


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = DESIGN
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "regulator.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_sampled_law_is_the_lqg_of_its_sizes(tmp_path: Path) -> None:
    """(x / state)^2 + (s / integral)^2 + (u / input)^2, by Tustin's rule: its response in s is the continuous one."""
    spec = malta.read_design(written(tmp_path))
    model, c = model_and_controller(spec)
    weights = malta.synthesis.weights([1e8, 0], [4], [0.01], [4e-12], q_i=[1 / 5e-6**2])
    (K, Ki), L = malta.synthesis.lqi(model, weights), malta.synthesis.kalman(model, weights)
    law, z = linear_law(c), np.exp(1j * 300 * spec.sample_time)
    found = -(law.C @ np.linalg.solve(z * np.eye(len(law.A)) - law.A, law.B_y) + law.D_y)
    s = 2 / spec.sample_time * (z - 1) / (z + 1)
    states = np.linalg.solve(s * np.eye(2) - model.A + model.B @ K + L @ model.C, L - model.B @ Ki / s)
    np.testing.assert_allclose(found, K @ states + Ki / s, rtol=1e-9)


def test_numbers_change_by_their_place_and_are_written(tmp_path: Path) -> None:
    path = written(tmp_path)
    spec = malta.read_design(path)
    assert spec.structure is not None
    stiffer = spec.replace({f"{ELEMENT}.state.q": 5e-5}, name="stiffer")
    changed = replace(spec, law=with_values(spec.structure, {"regulator.state.q": 5e-5}))
    assert model_and_controller(stiffer)[1].K[0, 0] == model_and_controller(changed)[1].K[0, 0]
    assert model_and_controller(stiffer)[1].K[0, 0] != model_and_controller(spec)[1].K[0, 0]
    again = tmp_path / "again.toml"
    again.write_text(structured_text(changed, again), encoding="utf-8")
    assert "state = { q = { value = 50" in again.read_text(encoding="utf-8")
    read = malta.read_design(again).structure
    assert read is not None
    assert read.elements[0].numbers == pytest.approx(
        {"state.q": 5e-5, "integral.y": 5e-6, "input.f": 0.5, "process.f": 0.1, "sensor.y": 2e-6}
    )


def test_a_report_and_the_live_page_show_the_sizes(tmp_path: Path) -> None:
    path = written(tmp_path)
    spec = malta.read_design(path)
    model, c = model_and_controller(spec)
    gains = tmp_path / "regulator.json"
    malta.gains.write(c, malta.verify(model, c), gains)
    shown = {e.name: (e.value, e.unit) for e in design_entries(subject_of(gains, spec=spec))}
    assert shown["regulator state.q"] == (1e-4, "m")
    files = open_design(path)
    field = next(f for f in fields_of(files) if f.key == f"{ELEMENT}.integral.y")
    assert (field.value, field.unit, field.kind) == (5, "um s", "log")
    edited = files.apply(files.edit({field.key: 7.0})).spec.structure
    assert edited is not None
    assert edited.elements[0].numbers["integral.y"] == 7e-6


@pytest.mark.slow
def test_sizes_are_tuned_until_the_proof_closes(tmp_path: Path) -> None:
    found = tune_design(malta.read_design(written(tmp_path)))
    assert found.tuned.closed
    assert found.tuned.order == 3
    assert found.tuned.reached["sensitivity 1.6"] <= 1
    assert found.tuned.reached["load"] < 0.15
    c = found.tuned.controller
    assert c is not None
    np.testing.assert_allclose(model_and_controller(found.spec)[1].K, c.K, rtol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ('all = ["regulator"]', 'y = ["regulator"]', "structure.law.y"),
        ('all = ["regulator"]', 'all = ["regulator", "regulator"]', "structure.law.all"),
        ("state = { q = {", "state = { y = {", f"{ELEMENT}.state"),
        ('value = 0.5, unit = "N"', 'value = 0.5, unit = "mm"', f"{ELEMENT}.input.f"),
        ('value = 5, unit = "um s"', 'value = 0, unit = "um s"', f"{ELEMENT}.integral.y"),
        ('process = { f = { value = 0.1, unit = "N" } }', "process = {}", f"{ELEMENT}.process"),
        ('process = { f = { value = 0.1, unit = "N" } }', "", f"{ELEMENT}.process"),
        ("sensor =", 'low = { "state.q" = { value = 1, unit = "mm" } }\nsensor =', f"{ELEMENT}.state.q"),
        ("sensor =", 'low = { q = { value = 1, unit = "mm" } }\nsensor =', f"{ELEMENT}.low.q"),
        ("sensor =", 'Kp = { value = 1, unit = "N/m" }\nsensor =', f"{ELEMENT}.Kp"),
    ],
)  # fmt: skip
def test_a_wrong_file_gets_one_sentence(tmp_path: Path, old: str, new: str, field: str) -> None:
    path = written(tmp_path, (old, new))
    assert refusal(lambda: malta.read_design(path), path).field.removesuffix(".unit") == field


def test_a_pid_of_all_errors_is_refused(tmp_path: Path) -> None:
    pid = '\n[structure.elements.axis]\nkind = "gain"\nvalue = { value = 1, unit = "N/m" }\n[goals.load]'
    path = written(tmp_path, ('all = ["regulator"]', 'all = ["axis"]'), ("\n[goals.load]", pid))
    error = refusal(lambda: malta.read_design(path), path)
    assert (error.field, error.found) == ("structure.law.all", "axis with a gain")


def test_weights_without_an_lqg_are_refused_by_the_file(tmp_path: Path) -> None:
    """Of sensors that say nothing, the filter's equation has no solution that stabilizes."""
    spec = malta.read_design(written(tmp_path))
    model = malta.linearize(spec.plant, spec.plant.at())
    assert spec.structure is not None
    gone = replace(spec, law=with_values(spec.structure, {"regulator.sensor.y": 1e30}))
    with pytest.raises(malta.InputError, match=r"regulator\.toml.*regulator"):
        malta.synthesize(gone, model)
