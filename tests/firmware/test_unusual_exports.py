"""Exports of machines unlike the shipped ones: one axis, no stroke, four coupled axes, single precision, PID."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import ROOT
from exported import EXACT, require, run

import malta
from malta.firmware.export import folder_files
from malta.firmware.program import Precision
from malta.firmware.signals import Target
from malta.simulation.layout import fidelities

pytestmark = pytest.mark.usefixtures("proven_once")

STRICT = ("-Wall", "-Wextra", "-Werror")
DESIGNS = {
    "one axis": "examples/ball/design/ball.toml",
    "one axis, PID": "examples/ball/design/ball_pid.toml",
    "four axes": "examples/rotor/design/rotor.toml",
    "four axes, PID": "examples/rotor/design/rotor_pid.toml",
    "planar, PID": "design/planar_pid.toml",
    "planar": "design/planar.toml",
}
SLOW = ("four axes", "four axes, PID", "planar", "planar, PID")


def passes(t: Target, folder: Path) -> None:
    """The files of a target compile without a warning, and their own test passes."""
    require("gcc")
    files = folder_files(t, "0" * 64, proof=False)
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    programs = ("_example.c", "_pil.c")  # which have a main of their own
    sources = [file for file in files if file.endswith(".c") and not file.endswith(programs)]
    done = run(["gcc", *EXACT, *STRICT, *sources, "-o", "t"], folder)
    assert done.returncode == 0, done.stderr[:2000]
    done = run(["./t"], folder)
    assert done.returncode == 0, done.stdout
    assert "pass: " in done.stdout


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=pytest.mark.slow) if name in SLOW else (name, precision)
        for name, precision in zip(DESIGNS, ("double", "float") * 3, strict=True)
    ],
)
def test_a_designed_machine_passes_its_own_test(name: str, precision: Precision, tmp_path: Path) -> None:
    spec = malta.read_design(ROOT / DESIGNS[name])
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    passes(Target(controller, precision, fidelities(spec.plant)[-1]), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"), [("tubular_pid", "float"), ("halbach_pid", "double"), ("halbach_late", "float")]
)
def test_every_depth_of_an_export_passes_its_own_test(
    name: str, precision: Precision, tmp_path: Path
) -> None:
    """Down to forces, currents or duty cycles."""
    c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    for fidelity in fidelities(malta.plant_of(c.parameters)):
        folder = tmp_path / fidelity
        folder.mkdir()
        passes(Target(c, precision, fidelity), folder)
