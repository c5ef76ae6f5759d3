"""An export whose step is another law than that of simulations is an error: exit code 1, and nothing is written."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT, Run
from exported import KINDS, controller, target

import malta
from malta.firmware import period_functions, step
from malta.firmware.agreement import require_same_law
from malta.firmware.signals import Target, reading_ranges

GAINS = "design/gains/halbach_pid.json"


@pytest.fixture(autouse=True)
def _programs_made_anew() -> Any:
    step.programs_of.cache_clear()
    yield
    step.programs_of.cache_clear()


def narrow(plant: malta.model.Plant) -> Any:
    """A tenth of the ranges: what the C refused before ranges were declared."""
    return reading_ranges(plant) / 10


@pytest.mark.parametrize("name", [name for name, _ in KINDS])
def test_shipped_laws_are_those_of_their_exports(name: str) -> None:
    require_same_law(target(name, "float"))


@pytest.mark.parametrize("name", ["with_current", "scheduled"])
def test_laws_of_other_states_are_those_of_their_exports(name: str) -> None:
    spec = malta.read_design(ROOT / "examples" / "magnet" / "design" / f"{name}.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    require_same_law(Target(law, "double", "force"))


@pytest.mark.parametrize("name", ["halbach_pid", "robust", "structured"])
def test_readings_that_the_export_refuses_are_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(period_functions, "reading_ranges", narrow)
    said = (
        rf"{name}: the exported C makes \w+ of .* where the law makes .*, within the ranges of the readings"
    )
    with pytest.raises(malta.CheckError, match=said):
        require_same_law(Target(controller(name), "double", "force"))


@pytest.mark.parametrize(("piece", "signal"), [("command_forces", "v"), ("sum_errors", "e")])
def test_another_law_is_found(piece: str, signal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces or sums that are a millionth larger."""
    own = getattr(period_functions, piece)

    def larger(*arguments: Any) -> Any:
        found = own(*arguments)
        return (*found[:2], found[2] * (1 + 1e-6)) if isinstance(found, tuple) else found * (1 + 1e-6)

    monkeypatch.setattr(period_functions, piece, larger)
    with pytest.raises(malta.CheckError, match=rf"the exported C makes {signal} of "):
        require_same_law(Target(controller("halbach_pid"), "double", "force"))


@pytest.mark.parametrize("to", [("--to", "c"), ("--to", "fmu")])
def test_the_command_writes_nothing(
    to: tuple[str, str], run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(period_functions, "reading_ranges", narrow)
    done = run("export", GAINS, *to, "--out", tmp_path / "out")
    assert done.code == 1
    assert re.fullmatch(r"malta: halbach_pid: the exported C makes [^\n]* nothing is written\n", done.err)
    assert not (tmp_path / "out").exists()
