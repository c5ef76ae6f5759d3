"""The notebooks run as scripts; their own asserts check what their texts claim."""

from __future__ import annotations

import runpy
from pathlib import Path

import matplotlib
import pytest
from conftest import ROOT
from matplotlib import pyplot

pytestmark = pytest.mark.usefixtures("proven_once")

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
SLOW = {name: [pytest.mark.slow] for name in ("03_experiments", "05_halbach", "06_planar", "08_firmware")} | {
    "04_robustness": [pytest.mark.slow, pytest.mark.xdist_group("chain")]  # where its margins are proven once
}


def test_there_are_notebooks() -> None:
    assert [n.name for n in NOTEBOOKS][:3] == ["00_your_machine.py", "01_model.py", "02_lqg.py"]


@pytest.mark.parametrize(
    "notebook",
    [pytest.param(n, marks=SLOW.get(n.stem, []), id=n.stem) for n in NOTEBOOKS],
)
def test_notebook_runs_from_its_own_folder(notebook: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Jupyter starts it."""
    monkeypatch.chdir(notebook.parent)
    matplotlib.use("Agg")
    runpy.run_path(str(notebook), run_name="__main__")
    pyplot.close("all")
    text = notebook.read_text(encoding="utf-8")
    assert "\ndef " not in text  # functions belong in malta/
    assert "assert " in text
    assert text.startswith("# %% [markdown]\n# # ")
