"""The page on the numbers of the designs names every number once, and shows what moves when it does."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import malta
from malta.model.parts import require_part

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import free_numbers as numbers  # noqa: E402  # a script of docs/
from page_examples import agrees  # noqa: E402

BASES = "bases of the planes' integrals"


def section(name: str) -> list[str]:
    """The table of a design on the page."""
    text = numbers.PAGE.read_text(encoding="utf-8")
    return [line for line in text.split(f"## {name}\n")[1].split("\n## ")[0].splitlines() if line[:1] == "|"]


def test_every_design_that_is_judged_has_its_numbers_here() -> None:
    for machine in ("tubular", "halbach", "planar"):
        assert set(require_part("claims", machine).REPRODUCING) <= set(numbers.OF_DESIGN)


@pytest.mark.parametrize("name", list(numbers.OF_DESIGN))
def test_every_number_has_one_line_with_what_the_design_file_has(name: str) -> None:
    shown = section(name)
    lines = numbers.lines_of(name)  # raises where a number has none, or two
    assert len(shown) == 3 + len(lines)
    for row, (line, entries) in zip(shown[3:], lines, strict=True):
        cells = row.split(" | ")
        assert cells[0].removeprefix("| ") == line.name
        assert cells[1] == numbers.quantity(entries)
        assert line.origin.startswith(("printed", "solved", "fitted", "free", "there are no"))


def test_a_number_without_a_line_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(numbers.OF_DESIGN, "table2", numbers.OF_DESIGN["table2"][1:])
    with pytest.raises(LookupError, match=r"table2\.toml: weights\.state\.x has not exactly one line"):
        numbers.lines_of("table2")


def test_the_slow_design_differs_in_its_integrals_alone() -> None:
    ((line, entries),) = numbers.lines_of("calibrated_slow")
    assert line.name == BASES
    assert dict.fromkeys(entries, 52.2441) == {key: numbers.value_of(e) for key, e in entries.items()}


def test_the_fitted_number_moves_what_it_is_fitted_on() -> None:
    """As the page has it: half the base lets plane 2 deviate by half as much, and |S| peak higher."""
    found = numbers.table_of("calibrated", (BASES,)).splitlines()
    shown = section("calibrated")
    on_page = [*shown[:3], *(line for line in shown if line.startswith(f"| {BASES}"))]
    assert agrees("\n".join(on_page), "\n".join(found))
    *_, before = (float(cell) for cell in found[2].strip("| ").split(" | ")[1:] if cell.strip())
    peak, *_, moved = found[3].strip("| ").split(" | ")[4:]
    twice, half = (float(one) for one in moved.split(" / "))
    assert half < 0.65 * before < before < 4 < 1.5 * before < twice
    assert float(peak.split(" / ")[0]) < 2.3 < float(peak.split(" / ")[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", list(numbers.OF_DESIGN))
def test_the_page_is_what_is_computed(name: str) -> None:
    assert agrees("\n".join(section(name)), numbers.table_of(name))
    assert malta.read_design(ROOT / "design" / f"{name}.toml").summary in numbers.PAGE.read_text("utf-8")
