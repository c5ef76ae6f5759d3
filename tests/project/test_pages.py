"""Pages of docs/: their examples run and show what comes out, and their links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from conftest import ROOT
from page_examples import agrees, renew, run_page

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)#\s]+)")
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
TEXT = re.compile(r"<text[^>]*>([^<]*)</text>")
BEGIN = re.compile(r"```(console|pycon)\n")


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning")  # of python-control's own libraries
@pytest.mark.parametrize("page", [p for p in PAGES if BEGIN.search(p.read_text(encoding="utf-8"))], ids=_name)
def test_the_examples_of_a_page_show_what_comes_out(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    text = page.read_text(encoding="utf-8")
    if "hinfsyn" in text:
        pytest.importorskip("slycot", reason="control.hinfsyn needs slycot")
    for block in run_page(text):
        for example in block:
            assert example.agrees, f"{example.typed}\nshown:\n{example.shown}\nfound:\n{example.found}"


@pytest.mark.slow
def test_figures_of_the_theory_are_those_that_are_drawn(tmp_path: Path) -> None:
    """The words and numbers in them; lines differ in their last digits between processors."""
    from page_figures import FOLDER, draw

    drawn = {file.name: file for file in draw(tmp_path)}
    shown = {file.name: file for file in FOLDER.glob("*.svg")}
    assert set(drawn) == set(shown)
    for name in shown:
        one, two = (" ".join(TEXT.findall(f[name].read_text(encoding="utf-8"))) for f in (shown, drawn))
        assert one.count(" ") > 5
        assert agrees(one, two), name


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_of_a_page_lead_to_files(page: Path) -> None:
    for target in LINK.findall(FENCED.sub("", page.read_text(encoding="utf-8"))):
        assert (page.parent / target).exists(), target


def test_outputs_are_compared_by_words_and_numbers() -> None:
    assert agrees("proven 350.3 %, lost at 12", "proven   350.27 %,  lost at 12")
    assert agrees("head\n ...\n tail 2", "head 1 2 3 tail 2")
    assert not agrees("proven 350.3 %", "proven 300.3 %")
    assert not agrees("head ... tail", "head 1 2 tail 3")
    assert not agrees("one", "one two")


def test_outputs_are_written_anew_where_they_differ() -> None:
    page = "# Page\n\n```pycon\n>>> x = 2\n>>> x + 1\n4\n>>> [x,\n...  1.00001]\n[2, 1.0]\n```\n\nEnd.\n"
    assert renew(page) == page.replace("4", "3")
    shell = "```console\n$ printf 'a b  \\n'\nold\n$ exit 3\n$ echo 1 | cat\n```\n"
    assert renew(shell) == shell.replace("old", "a b").replace("cat\n", "cat\n1\n")


def test_numbers_that_are_drawn_are_only_numbers() -> None:
    page = "<!-- drawn -->\n```console\n$ echo found -0.5 to 17 mm\nfound 0.03 to 2 mm\n```\n"
    assert renew(page) == page
    assert "-0.5" in renew(page.replace("<!-- drawn -->\n", ""))
    assert "-0.5" in renew(page.replace("found 0.03", "seen 0.03"))


def test_tables_are_shown_by_their_titles() -> None:
    page = "<!-- only: Two -->\n```console\n$ cd /; X=1; export X; printf 'One\\n\\na\\n\\nTwo\\n\\nb\\n\\nend'\n```\n"
    shown = renew(page + "\n```console\n$ pwd; echo $X\n```\n")
    assert "end'\n...\nTwo\n\nb\n...\n```" in shown
    assert shown.endswith("$ pwd; echo $X\n/\n1\n```\n")
    assert renew(shown) == shown
