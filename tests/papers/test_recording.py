"""v0(z) from logs: exact on functions that the table holds, close to the machine's statics, refused in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import refusal

import malta
from malta.simulation.experiments import Experiment
from malta.simulation.scenario import Scenario
from malta.simulation.trajectory_file import save
from malta.synthesis.feedforward import static_feedforward
from malta_papers.tubular.recording import (
    OWN_TABLE,
    RECORDED_TABLE,
    SLOW_STROKE,
    ForceLog,
    force_log,
    forces_of,
    record,
    slow_stroke,
    with_recorded,
)

if TYPE_CHECKING:
    from conftest import Run

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

ROBUST = "design/gains/robust.json"
HEADINGS = ("t [s]", "z [m]", "fx_B1 [N]", "fy_B1 [N]", "fx_B2 [N]", "fy_B2 [N]", "f_D [N]")
FORCES = np.array([0.1, 1.0, -0.2, 2.0, 0.5])


def _log(plant: Plant, way: float = 3.0, friction: float = 0.0, reach: float = 1.0) -> ForceLog:
    """A slow stroke at exact positions, with forces linear in z and a friction that changes its sign with the way."""
    t = np.arange(0, 2 * way, way / 6000)
    motion = slow_stroke(plant, way)(t)
    z, speed = reach * motion.p[:, 4], motion.dp[:, 4]
    v = FORCES * (1 + z[:, None] / plant.stroke.travel) + friction * np.sign(speed)[:, None]
    return ForceLog("stand.csv", t, z, v)


def _write_csv(log: ForceLog, path: Path, headings: tuple[str, ...], scale: float = 1.0) -> Path:
    rows = np.column_stack([log.t, scale * log.z, log.v])
    np.savetxt(path, rows, delimiter=",", header=",".join(headings), comments="", fmt="%.17g")
    return path


# The record


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_what_the_table_can_hold_is_recorded_exactly(plant: Plant, friction: float) -> None:
    """Friction is in the difference between the ways and not in v0."""
    found = record(_log(plant, friction=friction), plant)
    wanted = FORCES * (1 + found.z_grid[:, None] / plant.stroke.travel)
    assert np.abs(found.v0 - wanted).max() < 1e-9 + 1e-3 * friction  # at the ends of the stroke the sign is 0
    assert np.abs(found.apart - friction).max() < 1e-9 + 1e-3 * friction
    assert found.z_grid[-1] == -found.z_grid[0] == pytest.approx(0.98 * plant.stroke.travel)
    assert np.diff(found.z_grid).max() <= 0.25e-3


def test_several_strokes_are_averaged(plant: Plant) -> None:
    """Their turning points are found, also under noise and where the log begins half-way."""
    one = _log(plant)
    rng = np.random.default_rng(0)
    z = np.concatenate([one.z, one.z])[3000:]
    v = np.concatenate([one.v + 0.2, one.v - 0.2])[3000:]
    log = ForceLog("two.csv", np.arange(len(z)) * 5e-4, z + 15e-6 * rng.standard_normal(len(z)), v)
    found = record(log, plant)
    wanted = FORCES * (1 + found.z_grid[:, None] / plant.stroke.travel)
    late = found.z_grid > 0.1e-3  # the first way up lacks the lower half
    assert np.abs(found.v0 - wanted)[late].max() < 0.02


@pytest.mark.slow
def test_the_simulated_record_is_the_machines_statics() -> None:
    """Sensors as built; cogging displaced by 0.5 rad. Inertia and noise leave less than a tenth of the cogging."""
    controller = malta.gains.read(ROBUST)
    displaced = malta.plant_of(replace(controller.parameters, phi_c=0.5))
    reference = partial(slow_stroke, way=3.0)
    run = malta.simulate(displaced, controller, Scenario("slow", 6.0, reference, noise=1.0, quantize=True))
    found = record(force_log(run), displaced)
    truth = static_feedforward(displaced)
    off = np.abs(found.v0 - np.array([truth.at(float(z)) for z in found.z_grid])).max(axis=0)
    assert off[4] < 0.05
    assert off[:4].max() < 0.015  # 0.009 to 0.013 by the seed of the noise
    wrong = np.abs(controller.feedforward.v0 - truth.v0).max(axis=0)
    assert wrong[4] == pytest.approx(2 * 0.5 * np.sin(0.25), rel=1e-3)  # 0.247 N


@pytest.mark.slow
def test_observed_disturbances_record_as_well() -> None:
    spec = malta.read_design("design/robust.toml")
    weights = replace(spec.weights, q_i=np.zeros(5), drift_variance=np.full(5, 1e-3))
    model = malta.linearize(spec.plant, spec.plant.at())
    observing = malta.lqg(model, weights, spec.sample_time, delay=1, current_lag=True)
    assert observing.observed
    assert not observing.integrating
    heavier = malta.plant_of(replace(spec.parameters, m=0.40))
    run = malta.simulate(heavier, observing, Scenario("slow", 6.0, partial(slow_stroke, way=3.0)))
    assert run.verdict.completed
    found = record(force_log(run), heavier)
    truth = static_feedforward(heavier)
    off = np.abs(found.v0 - np.array([truth.at(float(z)) for z in found.z_grid]))
    assert off[:, :4].max() < 0.03
    assert np.abs(truth.v0 - observing.feedforward.v0)[:, :4].max() > 0.25


# Files


def _read(path: Path, plant: Plant) -> ForceLog:
    return forces_of(malta.identification.read_log(path), plant)


def test_a_log_reads_as_it_was_written(plant: Plant, tmp_path: Path) -> None:
    log = _log(plant)
    for name, scale in (("z [m]", 1.0), ("z [mm]", 1e3)):
        path = _write_csv(log, tmp_path / "a.csv", (HEADINGS[0], name, *HEADINGS[2:]), scale)
        found = _read(path, plant)
        assert np.allclose(found.z, log.z, rtol=1e-12, atol=1e-18)
        assert np.array_equal(found.v, log.v)
        assert np.array_equal(found.t, log.t)


def test_a_saved_run_is_a_log(plant: Plant, tmp_path: Path) -> None:
    run = malta.simulate(plant, malta.gains.read(ROBUST), Scenario.stroke(noise=1.0))
    found = _read(save(run, tmp_path / "run.npz"), plant)
    for one, other in zip(found[1:], force_log(run)[1:], strict=True):
        assert np.array_equal(one, other)


Spoil = Callable[[ForceLog], ForceLog]
REFUSED: dict[str, tuple[Spoil, str]] = {
    "one way": (lambda log: ForceLog(log.source, log.t[:6000], log.z[:6000], log.v[:6000]), "no way back"),
    "short": (
        lambda log: log._replace(z=0.5 * log.z),
        "found positions from -7.425 to 7.425 mm, expected the",
    ),
    "half": (lambda log: log._replace(z=np.maximum(log.z, 0.0)), "positions from 0 to 14.85 mm"),
    "fast": (lambda log: log._replace(t=log.t / 30), "a slow one: at most 0.1 N"),
}


@pytest.mark.parametrize(("spoil", "sentence"), REFUSED.values(), ids=REFUSED)
def test_a_log_that_is_no_slow_stroke_is_refused(plant: Plant, spoil: Spoil, sentence: str) -> None:
    error = refusal(lambda: record(spoil(_log(plant)), plant), Path("stand.csv"))
    assert error.field == "z"
    assert sentence in str(error)


def test_a_log_without_its_forces_is_refused(plant: Plant, tmp_path: Path) -> None:
    log = _log(plant)
    path = _write_csv(log, tmp_path / "a.csv", (*HEADINGS[:-1], "thrust [N]"))
    assert refusal(lambda: _read(path, plant), path).field == "f_D"
    log.v[17, 1] = np.nan
    path = _write_csv(log, tmp_path / "b.csv", HEADINGS)
    assert "fy_B1: found no finite number in row 18" in str(refusal(lambda: _read(path, plant), path))


# The experiment and its gain file


@pytest.fixture(scope="module")
def recorded() -> Experiment:
    controller = malta.gains.read(ROBUST)
    return malta.experiment("record-v0", malta.plant_of(controller.parameters), controller)


def _axial_error(e: Experiment, label: str) -> float:
    case = next(case for case in e.cases if case.label == label)
    return next(merit.value for merit in case.merits if merit.label == "axial error")


@pytest.mark.slow
def test_the_recorded_v0_takes_an_error_of_the_cogging_off(recorded: Experiment) -> None:
    """The stroke is as good as with the right v0, whichever way the cogging is displaced."""
    right = _axial_error(recorded, OWN_TABLE)
    assert _axial_error(recorded, RECORDED_TABLE) == pytest.approx(right, rel=0.05)
    for side in ("more", "less"):
        known = _axial_error(recorded, f"phi_c 0.5 rad {side}: {RECORDED_TABLE}")
        assert known == pytest.approx(right, rel=0.05)
        assert abs(_axial_error(recorded, f"phi_c 0.5 rad {side}: {OWN_TABLE}") / right - 1) > 0.1
    assert [case.label for case in recorded.cases[:3]] == [SLOW_STROKE, OWN_TABLE, RECORDED_TABLE]
    assert recorded.merits[4].value < 0.05  # N of thrust, of a cogging of 0.5 N


def test_a_recording_needs_integral_action(plant: Plant) -> None:
    integrating = malta.gains.read(ROBUST)
    c: Controller = replace(integrating, Ki=np.zeros_like(integrating.Ki))
    with pytest.raises(malta.InputError, match="without integral action"):
        malta.experiment("record-v0", plant, c)
    for way in (0.1, 100.0):
        with pytest.raises(malta.InputError, match="way: found"):
            malta.experiment("record-v0", plant, integrating, way=way)


@pytest.mark.slow
def test_the_gain_file_holds_the_recorded_v0(run: Run, recorded: Experiment, tmp_path: Path) -> None:
    """From the log of the experiment's own slow stroke, by the command line, to a gain file that runs."""
    log = save(recorded.cases[0].run, tmp_path / "stand.npz")
    once = ("simulate", ROBUST, "--scenario", "record-v0", "--option", "phase_error=0", "--out", tmp_path)
    code, out, err = run(*once, "--option", f"log={log}")
    assert (code, err) == (0, "")
    assert "slow stroke" not in out
    c = malta.gains.read(tmp_path / "robust_recorded.json")
    wanted = recorded.controller
    assert wanted is not None
    assert c.name == wanted.name == "robust_recorded"
    assert np.array_equal(c.feedforward.v0, wanted.feedforward.v0)
    assert np.array_equal(c.feedforward.z_grid, wanted.feedforward.z_grid)
    assert np.array_equal(c.K, malta.gains.read(ROBUST).K)
    assert f"wrote {tmp_path}/robust_recorded.mat" in out
    code, out, err = run(*once[:6], "--option", "log=none.csv")
    assert (code, out) == (2, "")
    assert err == "malta: none.csv: found no such file, expected a log\n"


def test_a_second_record_keeps_the_name(recorded: Experiment) -> None:
    assert recorded.controller is not None
    table: Any = record(force_log(recorded.cases[0].run), recorded.run.plant)
    again = with_recorded(recorded.controller, table)
    assert again.name == recorded.controller.name
    values: FloatArray = again.feedforward.v0
    assert np.array_equal(values, recorded.controller.feedforward.v0)
