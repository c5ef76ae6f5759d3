"""Which load of any waveform touches no contact, as a trial of the search estimates it in a part of the machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from malta.linear.impulses import impulses
from malta.loops.clearances import Clearance, clearances_of

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.synthesis.spec import Spec

KEY = "never_touches"  # of [specification]


def asked_loads(spec: Spec) -> dict[str, float]:
    """The loads by name, with the size that may touch nothing."""
    return {
        key.partition(" ")[2]: size for key, size in spec.specification.items() if key.startswith(f"{KEY} ")
    }


def touched_contacts(spec: Spec, x0: FloatArray, states: Sequence[int]) -> tuple[Clearance, ...]:
    """The contacts that some design states move, where a load is asked for; x0: the machine at rest."""
    if not asked_loads(spec):
        return ()
    return tuple(one for one in clearances_of(spec.plant, x0, states) if one.rows)


def largest_trial_load(
    contacts: Sequence[Clearance], closed: FloatArray, pushed: FloatArray, states: int
) -> float | None:
    """The largest load, held over each sample, that touches none of some contacts; None: it moves none of them.

    closed : of the machine and its law, n x n; the design states are the first
    pushed : what a unit load leaves in the states in a sample, n

    Raises CheckError for an unstable loop.
    """
    if not contacts or not pushed.any():
        return None
    found = impulses(closed, np.eye(states, len(closed)), pushed[:, None], np.zeros((states, 1)))
    size = min(one.size_at_touch([found.values]) for one in contacts)
    return size if math.isfinite(size) else None
