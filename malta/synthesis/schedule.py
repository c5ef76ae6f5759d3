"""Gain scheduling: the matrices of a law at places of a reference, linear between them and constant beyond.

    M(r) = M_0 + sum_k s_k (M_k+1 - M_k),   s_k = (r - p_k) / (p_k+1 - p_k), held within 0 .. 1

for M = Ad, Bd, Cd, K, Ki and L, at the rising places p_0 .. p_g of the reference r of one output. It is the reference
that schedules, not the reading: at a constant reference the law is linear and its loop is that of M(r), without a slope
of M. A machine far off its reference has the law of its reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.display import display
from malta.errors import InputError

SCHEDULED_MATRICES = ("Ad", "Bd", "Cd", "K", "Ki", "L")


@display
@dataclass(frozen=True, eq=False)
class Schedule:
    """The matrices of a law at rising places of the reference of an output; g places.

    variable : the output
    output : its index
    places : g, SI
    Ad, Bd, Cd, K, Ki, L : matrices of a Controller, g of each

    >>> import numpy as np
    >>> from malta.synthesis.schedule import Schedule
    >>> one = np.ones((2, 1, 1))
    >>> K = np.array([[[1.0]], [[3.0]]])
    >>> made = Schedule("y", 0, np.array([0.0, 1e-3]), one, one, one, K, one, one)
    >>> made.at(0.25e-3)["K"].tolist(), made.at(5e-3)["K"].tolist()
    ([[1.5]], [[3.0]])
    """

    variable: str
    output: int
    places: FloatArray
    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    K: FloatArray
    Ki: FloatArray
    L: FloatArray

    def __post_init__(self) -> None:
        for name in ("places", *SCHEDULED_MATRICES):
            object.__setattr__(self, name, readonly(getattr(self, name)))
        p = self.places
        if len(p) < 2 or not (np.isfinite(p).all() and (np.diff(p) > 0).all()):
            raise InputError("schedule", "places", str(p.tolist()), "at least two rising places")

    @property
    def cells(self) -> list[tuple[float, float]]:
        """The intervals between neighbouring places."""
        return list(pairwise(self.places.tolist()))

    def at(self, r: float) -> dict[str, Any]:
        """The matrices at a reference r of the output, SI."""
        shares = [min(max((r - a) / (b - a), 0.0), 1.0) for a, b in self.cells]
        found = {}
        for name in SCHEDULED_MATRICES:
            matrices = getattr(self, name)
            M = np.array(matrices[0])
            for share, step in zip(shares, np.diff(matrices, axis=0), strict=True):
                M = M + share * step
            found[name] = M
        return found

    def numbers(self) -> dict[str, ca.DM]:
        """What the law computes with, sparse: the first matrices, and the steps to the next ones beside each other."""
        found = {"places": ca.DM(self.places)}
        for name in SCHEDULED_MATRICES:
            matrices = getattr(self, name)
            found[name] = ca.sparsify(ca.DM(matrices[0]))
            found[f"{name}_steps"] = ca.sparsify(ca.DM(np.hstack([*np.diff(matrices, axis=0)])))
        return found
