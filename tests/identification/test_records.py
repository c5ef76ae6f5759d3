"""Any record of a machine under control: parameters from its prediction errors alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence

import malta
from malta.identification import Log, identify_record, log_of, write_log
from malta.identification.log import sample_excitation

CONTROLLER = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
PLANT = malta.plant_of(CONTROLLER.parameters)
NAMES = ("K_A", "K_B", "K_D")
GAINS = str(ROOT / "design" / "gains" / "robust.json")


def record_of(seed: int, samples: int = 3000) -> tuple[Log, np.ndarray[Any, Any]]:
    """A machine off its gain file by up to 8 %, pushed about by forces that nobody logs, and its parameters."""
    rng = np.random.default_rng(seed)
    own: Any = PLANT.parameters
    own = replace(own, **{name: getattr(own, name) * (1 + 0.08 * rng.uniform(-1, 1)) for name in NAMES})
    pushes = rng.choice([-1.0, 1.0], (samples // 20, 5)) * [2.0, 2.0, 2.0, 2.0, 5.0]
    signal = sample_excitation(CONTROLLER.sample_time, PLANT, np.repeat(pushes, 20, axis=0))
    scenario = malta.Scenario.excited(signal, samples * CONTROLLER.sample_time)
    run = malta.simulate(PLANT.variant(own), CONTROLLER, replace(scenario, noise=1.0, seed=seed))
    log = log_of(run)
    hidden = {k: table for k, table in log.columns.items() if k != "excitation"}
    signals = {k: one for k, one in log.signals.items() if k != "excitation"}
    return replace(log, columns=hidden, signals=signals), np.array([getattr(own, name) for name in NAMES])


def moved_currents(log: Log, shift: int) -> Log:
    """The log with its currents later by so many samples."""
    return replace(log, columns={**log.columns, "i": np.roll(log.columns["i"], shift, axis=0)})


def test_unlogged_pushes_tell_the_parameters() -> None:
    log, true = record_of(1)
    found = identify_record(CONTROLLER, log, parameters=NAMES)
    assert found.refusal == ""
    assert (found.half_widths[:2] < 0.005 * true[:2]).all()
    assert (np.abs(found.values - true) < 2 * found.half_widths).all()


@pytest.mark.slow
def test_intervals_hold() -> None:
    """Of 16 machines, 0.15 s each: 95 % intervals, of which at least 90 % hold the truth."""
    held = []
    for seed in range(100, 116):
        log, true = record_of(seed)
        found = identify_record(CONTROLLER, log, parameters=NAMES)
        assert found.refusal == ""
        held += (np.abs(found.values - true) < found.half_widths).tolist()
    assert np.mean(held) > 0.9


@pytest.mark.parametrize(("shift", "word"), [(1, "late"), (-1, "early")])
def test_currents_of_another_sample_are_refused(shift: int, word: str) -> None:
    log, _ = record_of(1, 1500)
    found = identify_record(CONTROLLER, moved_currents(log, shift), parameters=["K_B"])
    assert f"currents are a sample {word}" in found.refusal


def test_what_a_record_does_not_tell_is_said() -> None:
    """Forces and masses only together; a part that it has not; too few samples."""
    log, _ = record_of(1, 1500)
    with pytest.raises(malta.CheckError, match="identifiable"):
        identify_record(CONTROLLER, log, parameters=["K_A", "K_B", "K_D", "m", "I_xx"])
    with pytest.raises(malta.InputError, match="part: found 2 to 3 s"):
        identify_record(CONTROLLER, log, parameters=["K_B"], part=(2.0, 3.0))
    with pytest.raises(malta.CheckError, match="too short: 100 samples"):
        identify_record(CONTROLLER, log, parameters=["K_B"], part=(0.0, 5e-3))
    found = identify_record(CONTROLLER, log)
    assert {"K_A", "K_B"} <= set(found.names)
    assert set(found.dropped).isdisjoint(found.names)


def test_the_command_writes_a_data_file(tmp_path: Path, run: Run) -> None:
    log, true = record_of(3, 2000)
    file = write_log(log, tmp_path / "record.npz")
    out = tmp_path / "found.toml"
    done = run("identify", GAINS, str(file), "-p", "K_B", "--record", "all", "-o", str(out))
    assert (done.code, done.err) == (0, "")
    assert "from prediction errors alone" in " ".join(done.out.split())
    assert pytest.approx(true[1], rel=0.01) == malta.read(out).K_B
    for span in ("5..2", "x", "..", "-1..2"):
        refused = run("identify", GAINS, str(file), "--record", span)
        assert refused.code == 2
        assert "FROM..UNTIL" in one_sentence(refused.err)
    both = run("identify", GAINS, str(file), "--record", "all", "--validate", str(file))
    assert (both.code, "--validate beside it" in both.err) == (2, True)
