"""Tables on terminals of any width: headings and cells fold at spaces, wide tables are split, nothing is cut."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import assert_folds, printed

from malta.cli import output
from malta.report.tables import add_row, fold, new_table


def _table() -> object:
    table = new_table(
        "A title of more words than fit", "stage", "proven", "lost at", "rad/s", "first to give"
    )
    add_row(table, "+ current loops", "161.99 %", "162.01 %", "32.29", "K_B- K_A+")
    add_row(table, "all of the travel", "161.73 %", "161.75 %", "32.61", "")
    return table


def test_texts_fold_at_spaces_and_keep_units_with_their_numbers() -> None:
    assert fold("moves by 353.3 um in all", 12) == ["moves by", "353.3 µm in", "all"]
    assert fold("1 N m T_x", 5) == ["1 N m", "T_x"]
    assert fold("0.73 kg, not 0.75", 8) == ["0.73 kg,", "not 0.75"]
    assert fold("largest compliance [um / N]", 12) == ["largest", "compliance", "[µm / N]"]
    assert fold("held >= 20 % of it", 9) == ["held", ">= 20 %", "of it"]
    assert fold("-665.1 (x2)  -10  -328.3+-189.6j", 16) == ["-665.1 (x2)  -10", "-328.3+-189.6j"]
    assert fold("a\nb c", 80) == ["a", "b c"]
    assert fold("", 80) == [""]


def test_headings_fold_first_then_cells_then_the_table_is_split() -> None:
    def lines(width: int) -> list[str]:
        return [line.strip() for line in printed(_table(), width).splitlines()]

    assert "+ current loops     161.99 %   162.01 %   32.29       K_B- K_A+" in lines(100)
    assert "+ current loops     161.99 %   162.01 %   32.29   K_B- K_A+" in lines(63)
    assert "+ current loops    161.99 %  162.01 %" in lines(40)
    assert "+ current loops    32.29  K_B- K_A+" in lines(40)
    assert lines(18)[3:7] == ["+ current loops", "proven: 161.99 %", "lost at:", "162.01 %"]


@pytest.mark.parametrize("width", [20, 30, 40, 60, 80, 100])
def test_tables_of_any_shape_are_shown_whole(width: int) -> None:
    rng = np.random.default_rng(width)
    for columns in (1, 2, 5, 12):
        table = new_table("", *(f"heading {'of some length ' * (k % 3)}[mm]" for k in range(columns)))
        for _ in range(3):
            add_row(table, *(f"{x:.6g} mm" for x in rng.normal(size=columns) * 10.0 ** rng.integers(-3, 6)))
        assert_folds(table, width)


@pytest.mark.parametrize(
    ("columns", "width"), [("80", 80), ("132", 132), ("5", 20), (None, 100), ("wide", 100), ("0", 100)]
)
def test_files_and_pipes_have_the_width_that_columns_says(
    columns: str | None, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if columns is None:
        monkeypatch.delenv("COLUMNS", raising=False)
    else:
        monkeypatch.setenv("COLUMNS", columns)
    assert output.make_console().width == width
