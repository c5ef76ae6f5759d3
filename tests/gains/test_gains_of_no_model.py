"""A PID has no model: its file is read as it stands, and who takes it for a machine refuses gains that lose it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from conftest import ROOT, Run

import malta
from malta.gains import encodings
from malta.gains.certified import disagreement
from malta.gains.schema import GainFile
from malta.gains.stable import read_stable

PID = ROOT / "design/gains/tubular_pid.json"
SENTENCE = "gains.K: found a pole of the loop on the file's own machine at |lambda| = "


@pytest.fixture
def wild(tmp_path: Path) -> Path:
    """The shipped PID with its proportional and derivative gains of the other sign, and its seal renewed."""
    document = encodings.decode(PID)
    document["gains"]["K"] = [[-x for x in row] for row in document["gains"]["K"]]
    read = GainFile.model_validate(document).model_dump(by_alias=True, exclude_unset=True)
    path = tmp_path / "wild.json"
    path.write_text(json.dumps(document | {"sha256": encodings.content_sha256(read)}), encoding="utf-8")
    return path


def test_the_file_is_read_as_it_stands(wild: Path) -> None:
    assert np.array_equal(malta.gains.read(wild).K, -malta.gains.read(PID).K)


@pytest.mark.parametrize(
    "command",
    [
        ("verify",),
        ("simulate",),
        ("campaign",),
        ("excite",),
        ("plot", "bode"),
        ("report",),
        ("motion",),
        ("export",),
        ("export", "--to", "fmu"),
        ("compare", str(PID)),
        ("replay", "log.csv"),
        ("learn", "log.csv"),
        ("commission",),
        ("measure", "log.csv"),
    ],
    ids=" ".join,
)
def test_a_command_refuses_what_does_not_hold_the_machine(
    command: tuple[str, ...], wild: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(wild.parent)
    code, out, err = run(command[0], wild, *command[1:])
    assert (code, out) == (2, "")
    assert SENTENCE in " ".join(err.split())


def test_functions_refuse_it_in_the_same_words(wild: Path, tmp_path: Path) -> None:
    for use in (
        read_stable,
        malta.verify,
        lambda path: malta.export_c(path, tmp_path / "c"),
        lambda path: malta.export_fmu(path, tmp_path / "wild.fmu"),
        lambda path: disagreement(cast("Any", SimpleNamespace(claim=None)), path),  # of `malta check --gains`
    ):
        with pytest.raises(malta.InputError, match=r"gains\.K: found a pole of the loop on the file's own"):
            use(wild)


def test_reading_lights_no_loop_and_no_search_for_rest() -> None:
    """Of a machine from plain matrices not even a plant's checks; what is loaded is what the machine's module names."""
    code = f"""
import sys, malta
malta.gains.read({str(PID)!r})
print(*sorted(name for name in sys.modules if name.startswith("malta.")))
"""
    said = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    rooms = {name.split(".")[1] for name in said.stdout.split()}
    assert not rooms & {"loops", "margins", "proof", "simulation", "report"}
    assert not {"malta.model.equilibrium", "malta.model.linearize"} & set(said.stdout.split())
