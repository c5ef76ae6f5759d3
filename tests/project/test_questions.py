"""The questions of CONTRIBUTING.md: files exist, hold the names, and say in their first sentence what they answer."""

from __future__ import annotations

import ast
import math
import re
from collections import Counter

import pytest
from conftest import ROOT

ROW = re.compile(r"^\| (.+\?) \| `(malta/\S+\.py)` \| `(\w+)` \|$", re.M)
ROWS = ROW.findall((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
FILLERS = {
    *("where", "is", "the", "of", "a", "that", "does", "it", "in", "who", "do", "i", "how", "what", "which"),
    *("order", "are", "by", "and", "its", "one"),
}


def stems(text: str) -> set[str]:
    """The beginnings of the words that carry a sentence: simulated and simulation are one."""
    return {word[:4] for word in re.findall(r"[a-z]+", text.lower()) if word not in FILLERS}


def first_sentence(tree: ast.Module) -> str:
    """Of a module, up to the first empty line."""
    return (ast.get_docstring(tree) or "").partition("\n\n")[0]


def test_there_are_fourteen() -> None:
    assert len(ROWS) == 14
    assert len({file for _, file, _ in ROWS}) == 14


@pytest.mark.parametrize(("question", "file", "name"), ROWS)
def test_a_question_is_answered_by_its_file(question: str, file: str, name: str) -> None:
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert name in {getattr(node, "name", "") for node in tree.body}
    asked, said = stems(question), stems(f"{first_sentence(tree)} {file}")
    assert len(asked & said) >= min(2, len(asked)), (asked, said)


def test_the_first_file_that_fits_is_the_right_one_in_ten() -> None:
    """Files are ordered by the words that path and first sentence share with a question; rare words count more."""
    paths = {path.relative_to(ROOT).as_posix(): path for path in sorted((ROOT / "malta").rglob("*.py"))}
    says = {
        file: stems(f"{first_sentence(ast.parse(path.read_text(encoding='utf-8')))} {file}")
        for file, path in paths.items()
    }
    count = Counter(stem for said in says.values() for stem in said)
    right = 0
    for question, file, _ in ROWS:
        asked = stems(question)
        fit = {
            name: sum(math.log(len(says) / count[stem]) for stem in sorted(asked & said))
            for name, said in says.items()
        }
        right += max(fit, key=lambda name: fit[name]) == file
    assert right >= 10
