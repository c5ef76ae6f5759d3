"""The README's example runs, and its table of claims shows what the code computes."""

from __future__ import annotations

import re

import pytest
from conftest import ROOT

import malta

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.search(r"```python\n(.*?)```", README, re.S)
    assert block is not None
    assert len(block[1].split("\n")) - block[1].count("\n\n") - 1 == 5
    exec(block[1], {})
    assert capsys.readouterr().out.startswith("stable with hold, delay and current loops")


def _cells(table: str) -> dict[str, list[str]]:
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return {row[0]: row[1:] for row in rows}


def _is_noisy(subject: str) -> bool:
    """Noise and steps of 1 um: the last bit of a processor's arithmetic decides which step a sample falls on."""
    return subject.startswith(("at rest", "tilt", "thermal: left"))


def test_the_table_of_claims_is_computed() -> None:
    specs = [malta.read_design(f"design/{name}.toml") for name in ("table2", "calibrated", "robust")]
    found = _cells(malta.ledger(specs, malta.published("data/tubular.toml")).markdown())
    start = README.index("| claim |")
    shown = _cells(README[start : README.index("\n\n", start)])
    assert list(shown) == list(found)
    assert len(found) > 35
    for subject, cells in found.items():
        if _is_noisy(subject):
            assert shown[subject][0] == cells[0]
            numbers = [[float(cell) for cell in row[1:-1]] for row in (shown[subject], cells)]
            assert numbers[0] == pytest.approx(numbers[1], rel=0.2)
        else:
            assert shown[subject] == cells
