"""How far a floor of a class moves a machine, beside flights on one that shakes; bounds of clearances by name."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence
from jsonschema import Draft202012Validator

import malta
from malta.cli.documents.published import schema_of
from malta.loops.loop import Loop
from malta.loops.waveforms import largest_load
from malta.model.vibration import CLEARANCE_PRESETS
from malta.synthesis.requirements import CLEARANCES_OF
from malta.tuning.groups import figures_of, groups_of
from malta.tuning.outcomes import judge_controller

MIDDLES = [
    7.943,
    10,
    12.59,
    15.85,
    19.95,
    25.12,
    31.62,
    39.81,
    50.12,
    63.10,
    79.43,
]  # Hz, of thirds of octaves


@cache
def ball() -> Loop:
    spec = malta.read_design("examples/ball/design/ball.toml")
    return malta.loop(spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())))


@cache
def structured() -> Loop:
    controller = malta.gains.read("design/gains/structured.json")
    return malta.loop(malta.plant_of(controller.parameters), controller)


def flown_rms(frequencies: list[float], mass: float, velocity: float) -> np.ndarray:
    """The rms of the ball in each band, on a floor with one sine of this rms velocity in each, once it has settled."""
    loop, w = ball(), 2 * np.pi * np.array(frequencies)
    phases = np.random.default_rng(3).uniform(0, 2 * np.pi, len(w))

    def force(t: np.ndarray) -> np.ndarray:
        return np.asarray(mass * math.sqrt(2) * velocity * np.sin(np.outer(t, w) + phases) @ w)[:, None]

    scenario = malta.Scenario("floor", 3.0, malta.references.hold, disturbance=force, fidelity="force")
    run = malta.simulate(loop.plant, loop.controller, scenario)
    t, y = run.t[run.t > 1.0], run.p[run.t > 1.0, 0]
    sines = np.hstack([np.sin(np.outer(t, w)), np.cos(np.outer(t, w)), np.ones((len(t), 1))])
    fitted = np.linalg.lstsq(sines, y, rcond=None)[0][:-1].reshape(2, -1)
    return np.asarray(np.hypot(*fitted) / math.sqrt(2))


@pytest.mark.slow
def test_floors_of_sines_move_the_ball_less_than_the_bound_and_the_worst_of_them_reach_it() -> None:
    velocity, rng = 400e-6, np.random.default_rng(1)
    found, mass = malta.loops.floor_motion(ball(), velocity), vars(ball().plant.parameters)["m"]
    assert [*found] == ["w"]
    bound = found["w"]["y"]
    lowest, highest, other = (
        flown_rms([f * 10**shift for f in MIDDLES], mass, velocity)
        for shift in (-0.0499, 0.0499, float(rng.uniform(-0.05, 0.05)))
    )
    assert np.linalg.norm(other) < bound
    assert 0.98 * bound < np.linalg.norm(np.maximum(lowest, highest)) < 1.001 * bound


def test_the_bound_grows_with_the_floor_and_leaves_out_directions_that_do_not_act() -> None:
    one = malta.loops.floor_motion(structured(), 1e-5)
    three = malta.loops.floor_motion(structured(), 3e-5)
    assert [*one] == ["F_x", "F_y", "F_z"]
    for along, outputs in one.items():
        for name, rms in outputs.items():
            assert three[along][name] == pytest.approx(3 * rms, rel=1e-9, abs=1e-20)
    assert one["F_x"]["z"] < 1e-3 * one["F_x"]["x1"]


def test_floors_that_cannot_be_judged_are_refused() -> None:
    for velocity in (0.0, math.nan):
        with pytest.raises(malta.InputError, match="floor_motion: velocity"):
            malta.loops.floor_motion(ball(), velocity)
    with pytest.raises(malta.InputError, match="a Loop, from"):
        malta.loops.floor_motion(ball().plant, 1e-6)  # type: ignore[arg-type]
    plant = dataclasses.replace(ball().plant, disturbances=(malta.model.Signal("w", "N m"),))
    with pytest.raises(malta.InputError, match="a force that accelerates one state alone"):
        malta.loops.floor_motion(malta.loop(plant, ball().controller), 1e-6)
    slow = malta.gains.read("design/gains/halbach.json")
    with pytest.raises(
        malta.InputError, match=r"halbach: sample_time: found 0\.055 s, expected at most 0\.0011 s"
    ):
        malta.loops.floor_motion(malta.loop(malta.plant_of(slow.parameters), slow), 1e-6)
    unstable = malta.loop(structured().plant, structured().controller, parameters={"K_A": 1e6})
    with pytest.raises(malta.CheckError, match="unstable loop"):
        malta.loops.floor_motion(unstable, 1e-6)


def test_every_preset_has_its_source_and_either_a_clearance_or_a_floor() -> None:
    table = tomllib.loads((ROOT / "data/published/vibration.toml").read_text(encoding="utf-8"))
    found = {name: malta.model.vibration_preset(name) for name in table}
    assert tuple(name for name, one in found.items() if one.clearance < 1) == CLEARANCE_PRESETS
    for one in found.values():
        assert (one.clearance < 1) != (one.velocity > 0)
        assert len(one.source) >= 5
    zones = tomllib.loads((ROOT / "examples/flexible_rotor/source/limits.toml").read_text(encoding="utf-8"))
    for zone, name in zip("ABC", CLEARANCE_PRESETS[1:], strict=True):
        assert malta.model.vibration_preset(name).clearance == pytest.approx(
            zones["zones"][zone]["value"] / 100
        )
    with pytest.raises(malta.InputError, match="vibration_preset: found 'vc_q', expected one of api617"):
        malta.model.vibration_preset("vc_q")


def test_a_load_that_may_use_a_share_of_the_clearance_is_smaller_and_uses_no_more() -> None:
    share = malta.model.vibration_preset("iso14839_2_a").clearance
    size, contact = largest_load(structured(), "F_x", share)
    assert malta.worst_waveform(structured(), "F_x", contact, size).value == pytest.approx(share, abs=1e-5)
    safe = malta.safe_load(structured(), "F_x", clearance=share)
    assert safe.limit is not None
    assert 0.9 * share < max(safe.used.values()) < share
    assert 0.85 * size < safe.limit < size
    assert f"{contact} may use more than 30 % of its clearance" in safe.ends or "touchdown" in safe.ends
    assert "uses more than 30 % of a clearance or saturates" in str(safe)
    for wrong in (0.0, 1.5, math.nan):
        with pytest.raises(malta.InputError, match="safe_load: clearance"):
            malta.safe_load(structured(), "F_x", clearance=wrong)


@pytest.mark.slow
def test_a_design_file_asks_for_clearances_of_a_standard(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples/ball", tmp_path / "ball")
    file = tmp_path / "ball/design/ball.toml"
    keys = "".join(f'{key} = {{ w = {{ value = 0.5, unit = "N" }} }}\n' for key in CLEARANCES_OF)
    file.write_text(
        file.read_text(encoding="utf-8").replace("margin = 3\n", f"margin = 3\n{keys}"), encoding="utf-8"
    )
    spec = malta.read_design(file)
    loop = malta.loop(spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())))
    rows = judge_controller(spec, loop.controller, [f"{key} w" for key in CLEARANCES_OF])
    (group,) = groups_of(spec)
    trial = figures_of(spec, group, spec.weights, 1)
    for row, (key, name) in zip(rows, CLEARANCES_OF.items(), strict=True):
        share = malta.model.vibration_preset(name).clearance if name else 1.0
        size, contact = largest_load(loop, "w", share)
        assert row.found == pytest.approx(size)
        assert trial[f"{key} w"] == pytest.approx(size, rel=1e-3)
        used = malta.worst_waveform(loop, "w", contact, size).value
        assert used == pytest.approx(share, abs=1e-5)


def test_the_command_prints_a_floor_and_a_share_of_clearances(run: Run) -> None:
    gains = "design/gains/structured.json"
    code, out, _ = run("loads", gains, "--preset", "vc_c")
    assert (code, "Floor of VC-C: 12.5 µm/s rms" in out, "Source: Gordon 1999" in out) == (0, True, True)
    code, out, _ = run("loads", gains, "--preset", "vc_c", "--json")
    document = json.loads(out)
    Draft202012Validator(schema_of("loads-output")).validate(document)
    rms = malta.loops.floor_motion(structured(), 12.5e-6)["F_x"]["x1"]
    (first, *_) = document["linear"]
    assert (first["by"], first["signal"], first["unit"]) == ("F_x", "x1", "m")
    assert first["value"] == pytest.approx(rms)
    code, out, err = run("loads", gains, "--preset", "vc_c", "--load", "F_x")
    assert (code, out) == (2, "")
    assert "found --load, --uncertain or --out, expected none with requests or a floor" in one_sentence(err)
    code, out, _ = run("loads", gains, "--load", "F_x", "--preset", "api617")
    text = " ".join(out.split())
    assert code == 0
    assert "uses at most 75 % of any clearance and saturates nothing" in text
    assert "API 617, running clearances. Source: 9th edition" in text
    code, out, err = run("loads", gains, "--preset", "vc_q")
    assert (code, out) == (2, "")
    assert "--preset: found 'vc_q'" in one_sentence(err)
