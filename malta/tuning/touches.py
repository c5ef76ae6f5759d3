"""Which load of any waveform touches no contact, as a trial of the search estimates it in a part of the machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from malta.linear.impulses import impulses
from malta.loops.clearances import Clearance, clearances_of
from malta.synthesis.requirements import CLEARANCES_OF

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.synthesis.spec import Spec


def asked_loads(spec: Spec) -> tuple[tuple[str, str, float], ...]:
    """The loads of any waveform that are asked for: key of [specification], load, size."""
    keys = ((*key.partition(" ")[::2], size) for key, size in spec.specification.items())
    return tuple(one for one in keys if one[0] in CLEARANCES_OF)


def touched_contacts(spec: Spec, x0: FloatArray, states: Sequence[int]) -> tuple[Clearance, ...]:
    """The contacts that some design states move, where a load is asked for; x0: the machine at rest."""
    if not asked_loads(spec):
        return ()
    return tuple(one for one in clearances_of(spec.plant, x0, states) if one.rows)


def largest_trial_load(
    contacts: Sequence[Clearance], closed: FloatArray, pushed: FloatArray, states: int, limit: float
) -> float | None:
    """The largest load, held over each sample, that touches none of some contacts; None: it moves none of them.

    closed : of the machine and its law, n x n; the design states are the first
    pushed : what a unit load leaves in the states in a sample, n
    limit : share of a clearance, which counts as touched

    Raises CheckError for an unstable loop.
    """
    if not contacts or not pushed.any():
        return None
    found = impulses(closed, np.eye(states, len(closed)), pushed[:, None], np.zeros((states, 1)))
    size = min(one.size_at_share([found.values], limit) for one in contacts)
    return size if math.isfinite(size) else None
