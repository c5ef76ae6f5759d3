"""Work that takes long is refused before it has taken long, unless the user said --yes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Run, one_sentence

import malta
from malta.cli import output
from malta.cli.output import duration_text, limit_time
from malta.simulation.scenario import MOST_SUBSTEPS
from malta.simulation.simulate import integration_error

GAINS = "design/gains/calibrated.json"


class _Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> _Clock:
    made = _Clock()
    monkeypatch.setattr(output, "monotonic", made)
    return made


def _reports(clock: _Clock, seconds: float, *, agreed: bool = False, times: float = 1.0) -> list[float]:
    """The shares that are shown of work of so many seconds that begins with half an hour of something else."""
    shown: list[float] = []
    report = limit_time(shown.append, "stroke", agreed=agreed, times=times)
    assert report is not None
    for tick in range(41):
        clock.now = 1800.0 + tick
        report(min(1.0, tick / seconds))
    return shown


def test_an_estimate_begins_at_the_first_report(clock: _Clock) -> None:
    assert len(_reports(clock, 599.0)) == 41


@pytest.mark.parametrize(("seconds", "times", "said"), [(7200.0, 1.0, "2 h"), (250.0, 3.0, "12 min")])
def test_long_work_is_refused_in_seconds(clock: _Clock, seconds: float, times: float, said: str) -> None:
    with pytest.raises(
        malta.InputError, match=rf"^stroke: found about {said} of work, expected at most 10 min, or"
    ):
        _reports(clock, seconds, times=times)
    assert clock.now == 1800.0 + output.ESTIMATE_INTERVAL


def test_who_agreed_may_wait(clock: _Clock) -> None:
    assert len(_reports(clock, 7200.0, agreed=True)) == 41


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.25, "0.25 s"),
        (42.0, "42 s"),
        (600.0, "10 min"),
        (5000.0, "1.4 h"),
        (1e5, "28 h"),
        (1e9, "11574 days"),
    ],
)
def test_durations_are_told_as_people_tell_them(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


@pytest.mark.slow
@pytest.mark.parametrize("command", ["simulate", "campaign"])
def test_the_commands_refuse_and_obey(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr(output, "ESTIMATE_INTERVAL", 0.0)
    monkeypatch.setattr(output, "UNCONFIRMED_TIME", 1e-9)
    monkeypatch.setattr("malta.simulation.engine.batch.PROGRESS_INTERVAL", 1e-3)
    own = {
        "simulate": ("--option", "substeps=500", "--option", "fidelity=force", "--out", tmp_path),
        "campaign": ("--samples", "1024", "--option", "fidelity=force", "--spread", "1%", "--out", tmp_path),
    }[command]
    said = run(command, GAINS, *own)
    assert said.code == 2
    assert "or --yes" in one_sentence(said.err)
    assert [path.name for path in tmp_path.glob("*.n*")] == []
    assert run(command, GAINS, *own, "--yes").code == 0


def test_too_many_substeps_are_named(run: Run) -> None:
    said = run("simulate", GAINS, "--option", "substeps=100000")
    assert said.code == 2
    assert one_sentence(said.err) == "scenario stroke: substeps: found 100000, expected at most 10000"


def test_the_error_is_estimated_from_below_where_twice_as_many_are_too_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both ways to the error of four steps a sample agree: it falls with the fourth power of the step."""
    controller = malta.gains.read(GAINS)
    scenario = malta.Scenario.stroke(fidelity="force", duration=0.05, rise=3e-3, substeps=4)
    found = malta.simulate(malta.plant_of(controller.parameters), controller, scenario)
    above = integration_error(found)
    monkeypatch.setattr("malta.simulation.simulate.MOST_SUBSTEPS", 4)
    assert MOST_SUBSTEPS == 10_000
    assert np.log2(integration_error(found) / above) == pytest.approx(0, abs=1)
