"""The mutants of `make mutants` still apply: each text stands once in its file, and its tests are there."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from mutants import ROOT, Mutant, mutants

ALL = mutants()


def test_there_are_many() -> None:
    assert len(ALL) >= 60
    assert len({(one.file, one.old, one.new) for one in ALL}) == len(ALL)


@pytest.mark.parametrize("mutant", ALL, ids=[one.name for one in ALL])
def test_a_mutant_applies(mutant: Mutant) -> None:
    changed = mutant.applied((ROOT / mutant.file).read_text(encoding="utf-8"))
    ast.parse(changed)
    assert mutant.tests
    for test in mutant.tests:
        path, _, name = test.partition("::")
        text = (ROOT / path).read_text(encoding="utf-8")
        assert not name or f"def {name.partition('[')[0]}(" in text


def test_a_text_that_is_not_there_is_no_mutant() -> None:
    one = Mutant("x.toml 1", "a.py", "old", "new", (), "")
    for text in ("", "old old"):
        with pytest.raises(ValueError, match=r"a\.py has"):
            one.applied(text)
    with pytest.raises(ValueError, match="no fault"):
        one._replace(new="old").applied("old")
    assert one.applied("(old)") == "(new)"
    assert Path(ROOT / "malta").is_dir()
