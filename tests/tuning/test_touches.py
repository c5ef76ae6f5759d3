"""A search sees which load of any waveform touches nothing, as the finished design is judged by it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from conftest import ROOT, Run

import malta
from malta.loops.waveforms import largest_load
from malta.synthesis.spec import Spec
from malta.tuning.groups import figures_of, groups_of


def asking(design: Path, load: str, size: float) -> None:
    """Write into a design file which load may touch nothing."""
    wanted = f'[specification]\nnever_touches = {{ {load} = {{ value = {size}, unit = "N" }} }}\n'
    text = design.read_text(encoding="utf-8")
    head, _, rest = text.partition("[specification]")
    design.write_text(head + wanted + rest.partition("\n")[2], encoding="utf-8")


def estimates(spec: Spec, load: str, delay: int) -> list[float]:
    """The figure of each part of a machine that has one."""
    figures = [figures_of(spec, group, spec.weights, delay) for group in groups_of(spec)]
    return [one[f"never_touches {load}"] for one in figures if f"never_touches {load}" in one]


@pytest.mark.parametrize(
    ("design", "load", "delay"),
    [
        ("examples/ball/design/ball.toml", "w", 1),
        pytest.param("design/robust.toml", "F_y", 0, marks=pytest.mark.slow),
    ],
)
def test_a_trial_estimates_the_load_of_the_finished_design(
    design: str, load: str, delay: int, tmp_path: Path
) -> None:
    shutil.copytree(ROOT / design.removesuffix(Path(design).name), tmp_path / "all" / "design")
    shutil.copytree(ROOT / "data", tmp_path / "all" / "data")
    shutil.copytree(ROOT / "examples/ball", tmp_path / "all", dirs_exist_ok=True)
    file = tmp_path / "all/design" / Path(design).name
    asking(file, load, 1.0)
    spec = malta.read_design(file)
    (found,) = estimates(spec, load, delay)
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    size, _ = largest_load(malta.loop(spec.plant, controller), load)
    assert found == pytest.approx(size, rel=1e-3)  # held over samples, where the load that is judged is not


@pytest.mark.slow
def test_a_search_reaches_a_load_that_the_design_does_not_bear(tmp_path: Path, run: Run) -> None:
    shutil.copytree(ROOT / "examples/ball", tmp_path / "ball")
    file = tmp_path / "ball/design/ball.toml"
    asking(file, "w", 4.0)
    before = malta.read_design(file)
    (start,) = estimates(before, "w", 1)
    assert start < 4
    code, out, _ = run("tune", file, "--out", tmp_path / "tuned")
    assert code == 0
    assert "never touches w       >= 4 N" in out
    after = malta.read_design(tmp_path / "tuned/ball.toml")
    controller = malta.synthesize(after, malta.linearize(after.plant, after.plant.at()))
    assert largest_load(malta.loop(after.plant, controller), "w")[0] >= 4
