"""What a bounded load uses up of a machine's clearances: a contact along the direction in which it uses most.

A load moves the design states by d = H w, |w| <= size, with their impulse responses H. A contact's share of its
clearance that is used is a convex function of d on all machines here, so that the ascent ends where the load that
does most along its slope is the one that was tried: exact where planes do not couple, else a load that exists.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.model.plant import Plant

TOUCH_SHARE = 1e-6  # of a clearance, that is left where it counts as used up
LEAST_SHARE = 1e-12  # of a clearance, which counts as no motion
TOUCHES = 30  # steps to the size of a load that uses it up
ASCENTS = 8  # steps to the direction in which a clearance is used up most


class ClearanceUse(NamedTuple):
    """What a load uses of a clearance.

    share : of the clearance, with what rest uses
    n : along which the load moves furthest, of the clearance's states; none: it does not move them
    place : index of the response
    """

    share: float
    n: FloatArray
    place: int


class Clearance(NamedTuple):
    """A contact of a machine at rest, as a function of a motion d of the design states that it depends on."""

    name: str
    rows: tuple[int, ...]  # of these states, among those that may move
    rest: float  # the share that is used at rest
    share: Callable[[FloatArray], float]
    slope: Callable[[FloatArray], FloatArray]

    def share_of_rest(self, size: float, responses: Sequence[FloatArray]) -> float:
        """What a load of this size uses of what is left at rest; all of it where nothing is."""
        return (self.most(size, responses).share - self.rest) / (1 - self.rest) if self.rest < 1 else 1.0

    def most(self, size: float, responses: Sequence[FloatArray]) -> ClearanceUse:
        """What a load of this size uses at most, by an ascent from each state.

        responses : of all states that may move to the signal's parts, states x parts; one for each place of a sample
        """
        found = ClearanceUse(self.rest, np.zeros(0), 0)
        for k, every in enumerate(responses):
            H = every[list(self.rows)]
            for n in (sign * row for row in np.eye(len(H))[np.abs(H).max(axis=1) > 0] for sign in (1, -1)):
                for _ in range(ASCENTS):
                    d = size * H @ np.where(n @ H < 0, -1.0, 1.0)
                    if not (share := self.share(d)) > found.share * (1 + 1e-12):
                        break
                    n = self.slope(d)
                    found = ClearanceUse(share, n, k)
        return found

    def size_at_share(self, responses: Sequence[FloatArray], limit: float = 1.0) -> float:
        """The size of a load from which on some waveform of it uses a share of the clearance; infinite: none does."""
        if self.rest >= limit:
            return 0.0
        size = 1.0
        for _ in range(TOUCHES):  # a share grows by more than in proportion
            share, n, _ = self.most(size, responses)
            if not len(n) or share - self.rest < LEAST_SHARE:
                return math.inf
            size *= (limit - self.rest) / (share - self.rest)
            if abs(share - limit) < TOUCH_SHARE:
                break
        return size


def clearances_of(plant: Plant, x0: FloatArray, moving: Sequence[int] | None = None) -> list[Clearance]:
    """All contacts of a machine.

    x0 : its states at rest
    moving : the design states that may move; none: all of them
    """
    indices = list(plant.controlled) if moving is None else [plant.controlled[k] for k in moving]
    return [_clearance(plant, x0, k, indices) for k in range(len(plant.contacts.names))]


def _clearance(plant: Plant, x0: FloatArray, contact: int, indices: Sequence[int]) -> Clearance:
    """A contact as a function of those of some states that it depends on."""
    slopes = ca.jacobian(*_used_along(plant, x0, contact, indices))
    rows = np.unique(slopes.sparsity().get_triplet()[1]).astype(int).tolist()
    used, d = _used_along(plant, x0, contact, [indices[k] for k in rows])
    value, slope = ca.Function("used", [d], [used]), ca.Function("slope", [d], [ca.jacobian(used, d)])

    def share(motion: FloatArray) -> float:
        return float(value(motion))

    return Clearance(
        plant.contacts.names[contact],
        tuple(rows),
        share(np.zeros(len(rows))),
        share,
        lambda motion: np.nan_to_num(np.array(slope(motion)).ravel()),
    )


def _used_along(plant: Plant, x0: FloatArray, contact: int, indices: Sequence[int]) -> tuple[Any, Any]:
    """The share of a clearance that is used as an expression of some states' motion, and this motion."""
    d, x = ca.SX.sym("d", len(indices)), ca.SX(x0)
    for k, index in enumerate(indices):
        x[index] += d[k]
    return ca.SX(plant.contacts.contact(x))[contact], d
