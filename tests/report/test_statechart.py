"""The statechart of the supervisor against its table of transitions."""

from __future__ import annotations

import pytest
from figure_checks import defects, texts_of

import malta
from malta.firmware.supervisor import transitions_of


@pytest.mark.parametrize("wiring", [False, True])
def test_every_transition_of_the_table_is_drawn(wiring: bool) -> None:
    """One arrow for each, but one for all that lead to LANDING or FAULT, with the names of the others beside it."""
    figure, table = malta.report.statechart(wiring=wiring), transitions_of(wiring=wiring)
    texts = " ".join(texts_of(figure)).split()
    drawn = [text for text in figure.axes[0].texts if getattr(text, "arrow_patch", None) is not None]
    alone = [row for row in table if row[2] not in ("LANDING", "FAULT")]
    assert len(drawn) == len(alone) + 2
    for state in {state for begin, _, end in table for state in (begin, end)}:
        led = sum(begin == state and end in ("LANDING", "FAULT") for begin, _, end in table)
        assert texts.count(state) == 1 + led
    assert {on.lower() for _, on, _ in alone} <= set(texts)
    assert ("WIRING" in texts) is wiring
    assert defects(figure) == []
