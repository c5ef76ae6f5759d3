"""Fuzzing with a fixed seed: 2000 cases of all kinds of input, 100 of them in the fast set."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import Phase

from fuzz.cases import Case
from fuzz.edits import Cut
from fuzz.kinds import KINDS
from fuzz.session import cases_of

SMOKE = 20  # the fast set has one case of so many


def test_the_shares_of_the_kinds_are_2000_cases() -> None:
    assert sum(kind.share for kind in KINDS.values()) == 2000


@pytest.mark.slow_for("gains.npz", "gains.mat", "design", "campaign", "certificate", "rare")
@pytest.mark.parametrize("name", KINDS)
def test_input_is_read_or_refused_in_a_sentence(name: str) -> None:
    _read_all(name, KINDS[name].share // SMOKE)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_much_input_is_read_or_refused_in_a_sentence(name: str) -> None:
    read = _read_all(name, KINDS[name].share)
    assert read > KINDS[name].share / 2, "most cases have to reach the reader"


def test_shifted_samples_of_a_dump_are_refused_without_a_warning(tmp_path: Path) -> None:
    """A byte more in the middle: some numbers are signalling NaNs, which numpy warns of where it converts them."""
    ended = KINDS["dump"].read(Case("dump", cuts=(Cut("insert", 0.5, 2),)), tmp_path)
    assert ended is not None
    assert ended.code == 2


def _read_all(name: str, count: int) -> int:
    """Read the cases of a kind; how many of them could be written."""
    reached = 0

    def read(case: object) -> None:
        nonlocal reached
        with tempfile.TemporaryDirectory() as folder:
            reached += KINDS[name].read(case, Path(folder)) is not None

    cases_of(KINDS[name], read, count, phases=(Phase.generate, Phase.shrink))()
    return reached
