"""The notebooks run as scripts; their own asserts check what their texts claim."""

from __future__ import annotations

import runpy
from pathlib import Path

import matplotlib
import pytest
from conftest import ROOT
from matplotlib import pyplot

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


def test_there_are_notebooks() -> None:
    assert [n.name for n in NOTEBOOKS][:2] == ["01_model.py", "02_lqg.py"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda n: n.stem)
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
