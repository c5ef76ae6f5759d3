"""How a simulation ended: completed, diverged, or at the first contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.model.plant import Plant
from malta.simulation.layout import Setup, layout_of
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


class Verdict(NamedTuple):
    """How a simulation ended: "completed", "diverged", or what was touched; and when (s)."""

    name: str
    time: float

    @property
    def completed(self) -> bool:
        return self.name == "completed"


def judge(
    plant: Plant, c: Controller, setup: Setup, rows: FloatArray, t: FloatArray
) -> tuple[FloatArray, Verdict | None]:
    """The rows up to the first at which the machine touches something or its state is no number."""
    contact = columns_of(plant, c, setup, rows, "contact")
    if np.isfinite(rows[-1]).all() and contact.max(initial=0.0) < 1:
        return rows, None  # a state that is no number stays none
    lost = np.atleast_1d(~np.isfinite(rows).all(axis=1))
    touching = contact >= 1
    if setup.bearing:  # the touchdown bearings hold it: only what has no bearing ends the run
        touching = touching & ~np.array(plant.cushioned)
    stopped = np.flatnonzero(lost | touching.any(axis=1))
    if not len(stopped):
        return rows, None
    k = int(stopped[0])
    name = "diverged" if lost[k] else plant.contacts[int(np.where(touching[k], contact[k], 0).argmax())]
    return rows[: k + 1], Verdict(name, float(t[k]))


def bearing_verdict(plant: Plant, contact: FloatArray, t: FloatArray) -> Verdict | None:
    """With touchdown bearings: None where the mover stayed off them, or lifted off and is free at the end."""
    touching = contact >= 1
    if not touching.any():
        return None
    if touching[0].any():  # a lift-off
        if not touching[-1].any():
            return None
        return Verdict("not lifted", float(t[len(contact) - 1]))
    k = int(touching.any(axis=1).argmax())
    return Verdict(plant.contacts[int(contact[k].argmax())], float(t[k]))


def columns_of(plant: Plant, c: Controller, setup: Setup, rows: FloatArray, name: str) -> FloatArray:
    sizes = layout_of(plant, c, setup).row
    first = sum(size for key, size in list(sizes.items())[: list(sizes).index(name)])
    return rows[..., first : first + sizes[name]]
