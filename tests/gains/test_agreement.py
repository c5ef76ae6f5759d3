"""A gain file is left as it is where nothing but rounding and provenance would change."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import malta
from malta.gains import agrees
from malta.gains.encodings import content_sha256

if TYPE_CHECKING:
    from conftest import Design

    from malta.margins.loop_report import LoopReport


@pytest.fixture
def margins(designs: dict[str, Design]) -> LoopReport:
    design = designs["calibrated"]
    return malta.verify(design.model, design.controller)


def edited(path: Path, edit: str, share: float) -> Path:
    """The file with one table's numbers a share larger, its poles in another order, and another provenance."""
    content = json.loads(path.read_text(encoding="utf-8"))
    table, key = edit.split(".")
    content[table][key] = [[x * (1 + share) for x in row] for row in content[table][key]]
    poles = content["verification"]["poles"]
    poles["closed_loop"] = [[re, -im] for re, im in reversed(poles["closed_loop"])]
    content["provenance"]["python"] = "3.99"
    content["sha256"] = content_sha256(content)
    other = path.with_name("other.json")
    other.write_text(json.dumps(content), encoding="utf-8")
    return other


@pytest.mark.parametrize(("edit", "share", "same"), [
    ("gains.K", 0.0, True), ("gains.K", 1e-10, True), ("gains.K", 1e-8, False), ("gains.L", -1e-8, False),
    ("model.Ad", 1e-8, False), ("feedforward.v0", 1e-8, False),
])  # fmt: skip
def test_last_digits_and_provenance_are_no_reason(
    designs: dict[str, Design], margins: LoopReport, tmp_path: Path, edit: str, share: float, same: bool
) -> None:
    controller, path = designs["calibrated"].controller, tmp_path / "mine.json"
    malta.gains.write(controller, margins, path)
    assert agrees(controller, margins, path)
    assert agrees(controller, margins, path, edited(path, edit, share)) is same


def test_a_missing_or_damaged_file_is_written_anew(
    designs: dict[str, Design], margins: LoopReport, tmp_path: Path
) -> None:
    controller, path = designs["calibrated"].controller, tmp_path / "mine.json"
    assert not agrees(controller, margins, path)
    malta.gains.write(controller, margins, path)
    path.write_text(path.read_text(encoding="utf-8").replace("calibrated", "tampered"), encoding="utf-8")
    assert not agrees(controller, margins, path)


def test_bounds_that_contradict_or_are_narrower_are_written(
    designs: dict[str, Design], margins: LoopReport, tmp_path: Path
) -> None:
    """A proof that ran out of time is no reason; a better one is, and one that contradicts the file."""
    controller, path = designs["calibrated"].controller, tmp_path / "mine.json"
    bound = malta.proof.Margin(2.0, 2.5, 1.0, None, {}, {}, (), 0.0, "")
    proven = replace(margins, robust=bound, uncertainty={"m": 0.2})
    malta.gains.write(controller, proven, path)
    for lower, upper, same in ((1.5, 2.5, True), (2.0, 2.6, True), (2.2, 2.5, False), (2.6, 2.7, False)):
        now = replace(proven, robust=replace(bound, lower=lower, upper=upper))
        assert agrees(controller, now, path) is same
