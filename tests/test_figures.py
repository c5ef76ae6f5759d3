"""Every figure: nothing empty, nothing on top of something else, every input drawn, readable in grey."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from figure_checks import defects

from malta.report import new_figure

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes

X = np.linspace(0, 1, 50)


def _plain(axes: Axes) -> None:
    axes.plot(X, X, color="#000000")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("height [m]")


def _bare(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.set_ylim(2, 8)
    axes.yaxis.set_minor_formatter("")


def _alike(axes: Axes) -> None:
    axes.plot(X, X**2, label="a", color="#c1440e")
    axes.plot(X, X**3, label="b", color="#1f77b4", linestyle="-")
    axes.lines[0].set_label("c")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 0.6), ncols=3)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda axes: axes.lines[0].remove(), ["panel 0 is empty"]),
        (lambda axes: axes.set_ylabel("height"), ["the y axis of panel 0 has no unit: 'height'"]),
        (_bare, ["the y axis of panel 0 has no number at its ticks"]),
        (_alike, ["'a' and 'b' look alike without colour"]),
        (lambda axes: axes.plot(X, X, color="#000000"), ["panel 0 draws one line twice: '_child0' and '_child1'"]),
        (lambda axes: axes.plot(X, X**2, "--"), ["panel 0 has 2 looks of lines without a name"]),
        (lambda axes: axes.text(0.5, 0.45, "here"), ["'here' in panel 0 is crossed by a line"]),
        (lambda axes: axes.text(0.5, 1.9, "up"), ["'up' of panel 0 leaves the page"]),
        (lambda axes: axes.set_title("a title\n", fontsize=15), ["'found' of found lies on 'a title\\n' of panel 0"]),
    ],
)  # fmt: skip
def test_the_checks_find_what_is_wrong(spoil: Callable[[Axes], object], said: list[str]) -> None:
    figure = new_figure("title", "found", size=(4.5, 3.0), left=0.2, bottom=0.2)
    _plain(figure.subplots())
    assert defects(figure) == []
    spoil(figure.axes[0])
    assert defects(figure) == said
