"""Tables of claims in a Markdown file are computed anew where they stand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from conftest import ROOT, Run

from malta.errors import InputError
from malta.report.ledger import Ledger, LedgerClaim
from malta_papers.ledger import find_tables, replace_tables

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.usefixtures("proven_once")

TEXT = """# Claims

### tubular, A. Author, 2021

Some words with 12 figures of speech.

| claim | published | `b` | `a` | verdict |
|---|---|---|---|---|
| old | 1 | 2 | 3 | reproduced |

| claim | other |
|---|---|

### halbach, B. Author, 2018

<details><summary>52 figures</summary>

| claim | published | `c` | verdict |
|---|---|---|---|
| old | 1 | 2 | reproduced |
| older | 1 | 2 | reproduced |

</details>
"""


def _ledger(machine: str, *designs: str) -> Ledger:
    claim = LedgerClaim("new", "4", ("5",) * len(designs), "within 7 %", "near")
    return Ledger(machine, "an author", designs, (claim, claim, claim))


def test_tables_stand_under_their_titles() -> None:
    first, second = find_tables(TEXT, "a.md")
    assert (first.machine, first.designs) == ("tubular", ("b", "a"))
    assert (second.machine, second.designs) == ("halbach", ("c",))
    assert TEXT[first.start : first.end].count("\n") == 3
    assert TEXT[second.start : second.end].endswith("| older | 1 | 2 | reproduced |\n")


def test_nothing_but_tables_and_their_counts_changes() -> None:
    new = replace_tables(TEXT, [_ledger("tubular", "b", "a"), _ledger("halbach", "c")], "a.md")
    assert "old" not in new
    assert new.count("| new | 4 | 5 | 5 | within 7 % |") == new.count("| new | 4 | 5 | within 7 % |") == 3
    assert "<summary>3 figures</summary>" in new
    words = TEXT.replace("52 figures", "3 figures")
    lines, same = ([line for line in text.splitlines() if line[:1] != "|"] for text in (new, words))
    assert lines == same
    again = replace_tables(new, [_ledger("tubular", "b", "a"), _ledger("halbach", "c")], "a.md")
    assert again == new


@pytest.mark.parametrize(
    ("text", "found"), [("words\n", "no table"), (TEXT[TEXT.index("| claim") :], "a table without a title")]
)
def test_a_file_without_tables_is_refused(text: str, found: str) -> None:
    with pytest.raises(InputError, match=found):
        find_tables(text, "a.md")


@pytest.mark.parametrize("machine", ["tubular", "halbach", "planar"])
def test_each_machine_has_a_page_of_its_tables(machine: str) -> None:
    file = ROOT / "docs" / "claims" / f"{machine}.md"
    places = find_tables(file.read_text(encoding="utf-8"), file.name)
    assert {place.machine for place in places} == {machine}
    assert all(place.designs for place in places)


def test_a_title_is_of_the_second_or_third_order() -> None:
    higher = TEXT.replace("### halbach", "## halbach")
    assert [place.machine for place in find_tables(higher, "a.md")] == ["tubular", "halbach"]


@pytest.mark.slow
def test_the_command_writes_the_file(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("malta_papers.tubular.quantities.MACHINES", 16)
    monkeypatch.setattr("malta_papers.tubular.quantities.LEARNERS", 2)
    file = tmp_path / "claims.md"
    head = TEXT[: TEXT.index("### halbach")].replace("`b` | `a`", "`table2`")
    file.write_text(head, encoding="utf-8")
    code, out, err = run("claims", "--update", file)
    assert (code, err) == (0, "")
    assert f"wrote {file}" in out.replace("\n", "")
    text = file.read_text(encoding="utf-8")
    assert "| poles of x, y [rad/s] | ±218.92 | ±218.92 | by construction; K_A solved from it;" in text
    file.write_text(head.replace("`table2`", "`nobody`"), encoding="utf-8")
    code, _, err = run("claims", "--update", file)
    assert code == 2
    assert "found 'nobody', expected one of " in err
    code, _, err = run("claims", "design/table2.toml", "--update", file)
    assert code == 2
