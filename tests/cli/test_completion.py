"""What a shell offers at the Tab key."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import ROOT, Run, forget_machines

import malta
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
        ("simulate design/gains/robust.json --controller ", ["own", "c"]),
        ("verify design/gains/robust.json --current-loops p", ["pi"]),
        ("verify design/gains/robust.json --uncertain l_", ["l_B=", "l_S="]),
        ("verify design/gains/robust.json --machine examples/ball/ba", ["examples/ball/ball.py"]),
        ("export design/gains/robust.json --to f", ["fmu"]),
        ("export design/gains/robust.json --part m", ["machine"]),
        ("plot design/gains/robust.json ny", ["nyquist"]),
        ("compare design/gains/table", [f"design/gains/table2{form}" for form in GAINS]),
        ("identify design/gains/robust.json log.npz -p l_", ["l_B", "l_S"]),
        ("campaign design/gains/robust.json --study t", ["tolerances"]),
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


def test_scenarios_of_a_machine_of_ones_own_are_offered_where_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    """Its module runs only where the user has typed its name, or set MALTA_MACHINE."""
    folder = ROOT / "tests" / "foreign" / "disk"
    spec = malta.read_design(folder / "design" / "disk.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    law = malta.synthesize(spec, model)
    malta.gains.write(law, malta.verify(model, law), tmp_path / "disk.json")
    forget_machines()
    monkeypatch.setenv("_MALTA_COMPLETE", "complete_bash")
    for named, offered in (("", []), (f"--machine {folder / 'disk.py'} ", ["step"])):
        words = f"malta simulate {tmp_path / 'disk.json'} {named}--scenario st"
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        assert run().out.split() == offered
    forget_machines()
