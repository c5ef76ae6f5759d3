"""Exports of machines unlike the shipped ones: one axis, no stroke, four coupled axes, single precision, PID, states
that are not positions and rates, laws without integrals, forces without limits."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import angle_lag
import flux_magnet
import numpy as np
import pytest
from conftest import ROOT
from exported import EXACT, require, run

import malta
from malta.firmware.export import folder_files
from malta.firmware.program import Precision
from malta.firmware.signals import Target
from malta.firmware.supervisor import reference_limits
from malta.firmware.vectors import out_of_reach
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
    "modes of bending": "examples/flexible_rotor/design/flexible_rotor.toml",
}
SLOW = ("four axes", "four axes, PID", "planar", "planar, PID", "modes of bending")


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


@pytest.mark.slow_for("one axis-double", "one axis, PID-float")
@pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=pytest.mark.slow) if name in SLOW else (name, precision)
        for name, precision in zip(DESIGNS, cycle(("double", "float")), strict=False)
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


LAG = ([[0, 1, 0], [400, 0, 1], [0, 0, -200]], [[0], [0], [200]], [[1, 0, 0]])  # of a force by a voltage
TWO_LAGS = (
    [[*A, *(0, 0, 0)] for A in LAG[0]] + [[*(0, 0, 0), *A] for A in ([0, 1, 0], [300, 0, 1], [0, 0, -200])],
    [[0, 0], [0, 0], [200, 0], [0, 0], [0, 0], [0, 200]],
    [[1, 0, 0, 0.3, 0, 0], [0.2, 0, 0, 1, 0, 0]],
)
STATE = ([[3]], [[1]], [[1]])
CART = ([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])


def law_of(matrices: Any, **details: Any) -> malta.Controller:
    """An LQG without integrals, of a machine from matrices whose sensors read up to 10 V."""
    outputs = [f"y{k} [V]" for k in range(len(matrices[2]))]
    plant = malta.linear_machine(*matrices, outputs=outputs, range=10, **details)
    n, m, p = (len(matrices[0]), len(matrices[1][0]), len(matrices[2]))
    weights = malta.synthesis.weights(q=[1.0] * n, r=[1.0] * m, w=[1.0] * m, v=[1e-8] * p)
    return malta.lqg(malta.linearize(plant, plant.at()), weights, Ts=1e-3)


@pytest.mark.parametrize(
    ("matrices", "details"),
    [
        (STATE, {"limit": 10.0}),
        (STATE, {"noise": 1e-3}),
        (CART, {"limit": 10.0, "noise": 1e-3}),
        (LAG, {"limit": 10.0, "noise": 1e-3}),
        (LAG, {}),
        (TWO_LAGS, {"limit": 10.0}),
        pytest.param(TWO_LAGS, {"limit": 10.0, "noise": 1e-3}, marks=pytest.mark.slow),
    ],
)
def test_any_states_pass_their_own_test(matrices: Any, details: Any, tmp_path: Path) -> None:
    passes(Target(law_of(matrices, **details), "double", "force"), tmp_path)


def test_limits_of_references_follow_from_what_forces_reach() -> None:
    """y^(3) = 200 u of the lag: T = (d / J)^(1/3), d = 10 V, J = 200 u; y^(1) = u, and y^(2) = u of the cart."""
    T = (10 / 2000) ** (1 / 3)
    expected = {"lag": (2 * 10 / T, 10 / T**2), "state": (10.0, 10.0), "cart": (20.0, 10.0)}
    for name, matrices in (("lag", LAG), ("state", STATE), ("cart", CART)):
        limits = reference_limits(Target(law_of(matrices, limit=10.0), "double", "force"))
        assert limits.position.tolist() == [10.0]
        assert (limits.speed[0], limits.acceleration[0]) == pytest.approx(expected[name])


def test_a_magnet_without_references_passes_its_own_test(tmp_path: Path) -> None:
    """Its limits were 85 m/s, from which no reference stops within the clearance."""
    spec = malta.read_design(ROOT / "examples" / "magnet" / "design" / "with_current.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    t = Target(replace(law, references=np.zeros((0, 0))), "double", "force")
    assert reference_limits(t).speed[0] < 1
    passes(t, tmp_path)


def test_a_law_of_errors_without_integrals_passes_its_own_test(tmp_path: Path) -> None:
    """What it sums up is among its states: they hold a force at its limit."""
    c = malta.gains.read(ROOT / "design" / "gains" / "structured.json")
    assert c.tracks == "errors"
    assert not c.Ki.any()
    passes(Target(c, "double", "force"), tmp_path)


def law_of_machine(par: Any, Ts: float, **scales: list[float]) -> malta.Controller:
    plant = malta.plant_of(par)
    return malta.lqg(malta.linearize(plant, plant.at()), malta.synthesis.weights(**scales), Ts=Ts)


def test_a_magnet_of_which_no_reading_meets_a_contact_passes_its_own_test(tmp_path: Path) -> None:
    """What a lost filter expects of a flux is no multiple of its states; and a landing without its temperature goes on,
    though the other readings are where they rest all the time."""
    scales = {"q": [1e7, 1e3, 1.0, 1e-2], "r": [0.1], "w": [0.1], "v": [4e-8, 1e-6, 1e-4]}
    t = Target(law_of_machine(flux_magnet.Parameters(), 250e-6, **scales), "double", "force")
    assert "ASTRAY" not in {one.key for one in out_of_reach(t)}
    passes(t, tmp_path)


def test_a_reading_that_is_bounded_passes_its_own_test(tmp_path: Path) -> None:
    """Whatever the filter remembers, it expects an angle that can be read: no fault makes ASTRAY act."""
    scales = {"q": [1.0], "r": [1.0], "w": [1e-2], "v": [1e-8]}
    t = Target(law_of_machine(angle_lag.Parameters(), 1e-3, **scales), "double", "force")
    assert ("ASTRAY", "OPERATE") in {one[:2] for one in out_of_reach(t)}
    passes(t, tmp_path)
