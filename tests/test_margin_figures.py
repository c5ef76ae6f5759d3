"""The figure of margins: what it says, and that it can be drawn of any loop."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import matplotlib.text
import pytest
from matplotlib.patches import Rectangle

from malta import gains
from malta.chain import Robustness, robustness
from malta.data import plant_of
from malta.margin_figures import chain_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BOX = {"m": 0.2, "K_B": 0.1}


def _texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text)]


@pytest.fixture(scope="module")
def found() -> Robustness:
    c = gains.read("design/gains/calibrated.json")
    return robustness(plant_of(c.parameters), c, BOX)


def test_the_figure_names_what_it_shows(found: Robustness) -> None:
    figure = chain_figure(found, "calibrated", BOX)
    figure.draw_without_rendering()
    texts = _texts(figure)
    assert "calibrated: where the margin goes" in texts
    assert "100 %: m ±20 %, K_B ±10 %, all at once" in texts
    left, right = figure.axes[:2]
    names = [tick.get_text() for tick in left.get_yticklabels()]
    assert names == [*(link.name for link in found.chain), "all of the travel"]
    widths = [bar.get_bbox().width for bar in left.patches[: len(names)] if isinstance(bar, Rectangle)]
    assert widths == pytest.approx(
        [100 * (m.lower or 0) for m in (*(k.margin for k in found.chain), found.travel)]
    )
    assert [bar.get_bbox().width for bar in right.patches if isinstance(bar, Rectangle)] == pytest.approx(
        [link.peak for link in found.chain]
    )
    assert {"A | B", "B | C", "C | D"} <= set(texts)
    along = figure.axes[2].lines[0]
    assert along.get_xdata().tolist() == pytest.approx([-15, -10, -5, 0, 5, 10, 15])  # type: ignore[union-attr]
    # bars stay below the right edge, no text beyond the picture
    assert max(widths) < left.get_xlim()[1]


def test_unstable_loops_and_unproven_margins_are_drawn(found: Robustness) -> None:
    c = gains.read("design/gains/calibrated.json")
    unstable = robustness(plant_of(replace(c.parameters, K_A=3e4)), c, BOX)
    chain_figure(unstable, "unstable", BOX).draw_without_rendering()
    nothing = replace(found.travel, lower=None, upper=float("inf"), reason="not settled")
    figure = chain_figure(replace(found, travel=nothing), "unproven", BOX)
    figure.draw_without_rendering()
    assert "none" in _texts(figure)
