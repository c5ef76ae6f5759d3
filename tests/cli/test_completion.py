"""What a shell offers at the Tab key."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Run

from malta.cli.options import GAINS

ROBUST = ("robust", "robust_observer")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("cam", ["campaign"]),
        ("verify design/gains/rob", [f"design/gains/{name}{form}" for name in ROBUST for form in GAINS]),
        ("verify des", ["design/"]),
        ("tune design/rob", ["design/robust.toml", "design/robust_observer.toml"]),
        ("design nowhere/x", []),
        ("verify design/gains/robust.json --set l_", ["l_B=", "l_S="]),
        ("verify nothing.json --set l_", []),
        ("simulate design/gains/halbach.json --scenario ra", ["ramp"]),
        ("simulate --scenario ra", []),
    ],
)  # fmt: skip
def test_completion(typed: str, offered: list[str], monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    words = ["malta", *typed.split(" ")]
    monkeypatch.setenv("_MALTA_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", " ".join(words))
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    said = run()
    assert (said.code, said.err) == (0, "")
    assert sorted(said.out.split()) == sorted(offered)


def test_a_folder_without_designs_offers_its_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine.toml").write_text("", encoding="utf-8")
    (tmp_path / "mine.txt").write_text("", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_MALTA_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "malta design mi")
    monkeypatch.setenv("COMP_CWORD", "2")
    assert run().out.split() == ["mine.toml", "mine/"]
