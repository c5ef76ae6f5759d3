"""Parameters of a loop along the travel, with those that follow the position."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.linear.uncertain import UncertainSystem


def at_place(system: UncertainSystem, shares: FloatArray, z: float) -> FloatArray:
    """The nominal parameters times 1 + shares, of the first ones, at a position along the travel."""
    p = system.nominal.copy()
    p[: len(shares)] *= 1 + shares
    at = {"z": z} | (system.derived.at(z) if system.derived is not None else {})
    for name, value in at.items():
        p[system.names.index(name)] = value
    return np.asarray(p)
