"""The README's example runs, and its table of claims shows what the code computes."""

from __future__ import annotations

import re

import pytest
from conftest import DESIGNS, ROOT

import malta

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.search(r"```python\n(.*?)```", README, re.S)
    assert block is not None
    assert len(block[1].split("\n")) - block[1].count("\n\n") - 1 == 5
    exec(block[1], {})
    assert capsys.readouterr().out.startswith("stable with hold, delay and current loops")


def test_the_table_of_claims_is_computed() -> None:
    specs = [malta.read_design(f"design/{name}.toml") for name in DESIGNS]
    table = malta.ledger(specs, malta.published("data/tubular.toml")).markdown()
    assert table in README
    assert len(table.splitlines()) > 35
