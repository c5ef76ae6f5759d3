"""The notebooks run as scripts; their own asserts check what their texts claim."""

from __future__ import annotations

import ast
import re
import runpy
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from conftest import ROOT
from matplotlib import pyplot

from malta.report import new_figure, save

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
PAGES = [*NOTEBOOKS, *sorted((ROOT / "examples").glob("*/notebook.py"))]
DRAWING = (
    "stroke",
    "experiment",
    "front",
    "robustness",
    "loads",
    "sensitivity",
    "campaign",
)  # of malta.report
KERNEL = """
import malta
from malta.report.figures.campaign import CampaignFigures
def drawn():
    figure = malta.report.new_figure("title", "found")
    figure.subplots().plot([1, 2])
    return figure
"""


def cells_of(notebook: Path) -> list[str]:
    """The cells with code of a text notebook."""
    parts = notebook.read_text(encoding="utf-8").split("# %%")
    return [part for part in parts if part.strip() and not part.startswith(" [markdown]")]


def calls_of(tree: ast.AST) -> list[ast.Call]:
    """Calls of the functions of malta.report that draw."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in DRAWING
        and ast.unparse(node.func.value) == "malta.report"
    ]


def test_there_are_notebooks() -> None:
    assert [n.name for n in NOTEBOOKS][:3] == ["00_your_machine.py", "01_model.py", "02_lqg.py"]


@pytest.mark.slow
@pytest.mark.parametrize("notebook", [pytest.param(n, id=n.stem) for n in NOTEBOOKS])
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


@pytest.mark.parametrize("notebook", [pytest.param(n, id=f"{n.parent.name}/{n.stem}") for n in PAGES])
def test_every_picture_that_a_notebook_draws_is_shown(notebook: Path) -> None:
    """Each call of malta.report that draws is the value of its cell, or an argument of `display`."""
    for cell in cells_of(notebook):
        tree = ast.parse(cell)
        shown = [
            argument
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "display"
            for argument in node.args
        ]
        if tree.body and isinstance(tree.body[-1], ast.Expr):
            shown.append(tree.body[-1].value)
        for call in calls_of(tree):
            assert call in shown, ast.unparse(call)


def pictures(cell: dict[str, Any]) -> int:
    """Number of pictures below a cell that was executed."""
    return sum("image/png" in output.get("data", {}) for output in cell["outputs"])


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel imports the package that is tested."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.mark.slow
@pytest.mark.usefixtures("kernel")
@pytest.mark.parametrize("first", ["", "%matplotlib inline"])
def test_a_notebook_shows_a_figure_once(first: str) -> None:
    """As the value of a cell, by display, and all three of a campaign; with and without pyplot's own way."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    sources = (
        "drawn()",
        "for _ in range(2):\n    display(drawn())",
        "figure = drawn()",
        "drawn();",
        "CampaignFigures(drawn(), drawn(), drawn())",
    )
    cells = [nbformat.v4.new_code_cell(source) for source in (first + KERNEL, *sources)]
    page = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(page, kernel_name="python3").execute()
    assert [pictures(cell) for cell in page.cells] == [0, 1, 2, 0, 0, 3]


@pytest.mark.slow
@pytest.mark.usefixtures("kernel")
@pytest.mark.parametrize(
    "notebook", [pytest.param(n, id=f"{n.parent.name}/{n.stem}") for n in PAGES if n.stem == "notebook"]
)
def test_pictures_are_on_the_pages(notebook: Path) -> None:
    """Executed in a kernel, below each cell at least as many pictures as the cell has calls that draw."""
    jupytext, nbclient = pytest.importorskip("jupytext"), pytest.importorskip("nbclient")
    page = jupytext.read(notebook)
    folder = {"metadata": {"path": str(notebook.parent)}}
    nbclient.NotebookClient(page, kernel_name="python3", timeout=600, resources=folder).execute()
    found = 0
    for cell in page.cells:
        if cell["cell_type"] == "code":
            shown, found = pictures(cell), found + pictures(cell)
            assert shown >= len(calls_of(ast.parse(cell["source"])))
    assert found


@pytest.mark.parametrize("notebook", [pytest.param(n, id=n.stem) for n in NOTEBOOKS])
def test_the_published_page_is_that_of_the_notebook(notebook: Path) -> None:
    """The same code in the same order, every picture at its place, and at least one."""
    folder = ROOT / "docs" / "notebooks"
    page = (folder / f"{notebook.stem}.md").read_text(encoding="utf-8")
    code = re.findall(r"^(```|~~~)python\n(.*?)\n\1$", page, re.MULTILINE | re.DOTALL)
    assert [cell for _, cell in code] == [part.partition("\n")[2].strip("\n") for part in cells_of(notebook)]
    shown = re.findall(r"^!\[.+\]\((\S+)\)$", page, re.MULTILINE)
    assert shown
    assert {*shown} == {file.name for file in folder.glob(f"{notebook.stem}_*.png")}
    assert all((folder / name).stat().st_size < 100_000 for name in shown)


def test_the_picture_of_a_figure_is_its_file(tmp_path: Path) -> None:
    figure = new_figure("title", "found")
    figure.subplots().plot([1, 2])
    content: bytes = figure._repr_png_()  # type: ignore[attr-defined]
    assert content.startswith(b"\x89PNG")
    save(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == content
    assert not pyplot.get_fignums()  # pyplot would show it a second time
