"""Which channels of a loop need a panel of their own: mirror images have the same curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from malta.loops.curves import LoopCurves

ALIKE = 1e-3  # relative difference of curves that a plot does not show


class Panels(NamedTuple):
    """The channels to draw, and a sentence on those that have the curves of others; it begins with a space."""

    channels: tuple[str, ...]
    note: str


def distinct_channels(loops: Mapping[str, LoopCurves]) -> Panels:
    """Choose the channels at the sensors whose curves differ in some loop from those of the channels before them."""
    names = dict.fromkeys(s.name for curves in loops.values() for s in curves.channels())
    like: dict[str, list[str]] = {}
    for name in names:
        twin = next((other for other in like if _are_alike(loops, name, other)), None)
        like.setdefault(name if twin is None else twin, []).append(name)
    notes = []
    for name, (_, *others) in like.items():
        if others:
            listed = others[0] if len(others) == 1 else f"{', '.join(others[:-1])} and {others[-1]}"
            notes.append(f"{listed} {'has' if len(others) == 1 else 'have'} the curves of {name}")
    return Panels(tuple(like), f" {'; '.join(notes)}." if notes else "")


def _are_alike(loops: Mapping[str, LoopCurves], one: str, other: str) -> bool:
    """Whether two channels have the same curves in every loop."""
    for curves in loops.values():
        known = [s.name for s in curves.channels()]
        if one not in known or other not in known:
            return False
        alone = curves.responses.alone("sensors")
        a, b = alone[:, known.index(one)], alone[:, known.index(other)]
        if not np.allclose(a, b, rtol=ALIKE, atol=0.0, equal_nan=True):
            return False
    return True
