"""How a simulation ended: completed, diverged, or at the first contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.model.plant import Plant
from malta.simulation.layout import layout_of
from malta.simulation.scenario import Simulation

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


class Verdict(NamedTuple):
    """How a simulation ended, and when (s).

    The name is "completed", "diverged", "interrupted", "not lifted", or the contact that was touched.
    """

    name: str
    time: float

    @property
    def completed(self) -> bool:
        return self.name == "completed"


def judge(run: Simulation, rows: FloatArray, t: FloatArray) -> tuple[FloatArray, Verdict | None]:
    """The rows up to the first contact or the first NaN, and the verdict; None where neither occurs.

    A machine with touchdown bearings goes on after it touches one of them; only other contacts end its run.
    """
    plant, contact = run.plant, columns_of(run, rows, "contact")
    if np.isfinite(rows[-1]).all() and contact.max(initial=0.0) < 1:
        return rows, None  # a state that is no number stays none
    lost = np.atleast_1d(~np.isfinite(rows).all(axis=1))
    touching = contact >= 1
    if run.setup.bearing:
        touching = touching & ~np.array(plant.cushioned)
    stopped = np.flatnonzero(lost | touching.any(axis=1))
    if not len(stopped):
        return rows, None
    k = int(stopped[0])
    name = "diverged" if lost[k] else plant.contacts[int(np.where(touching[k], contact[k], 0).argmax())]
    return rows[: k + 1], Verdict(name, float(t[k]))


def bearing_verdict(plant: Plant, contact: FloatArray, t: FloatArray) -> Verdict | None:
    """The verdict of a run with touchdown bearings.

    None where the mover never touched them, or where it rested on them at the start and is free at the end.
    """
    touching = contact >= 1
    if not touching.any():
        return None
    if touching[0].any():  # a lift-off
        if not touching[-1].any():
            return None
        return Verdict("not lifted", float(t[len(contact) - 1]))
    k = int(touching.any(axis=1).argmax())
    return Verdict(plant.contacts[int(contact[k].argmax())], float(t[k]))


def columns_of(run: Simulation, rows: FloatArray, name: str) -> FloatArray:
    """The columns of one signal of `layout_of(...).row`; rows has any number of leading axes."""
    sizes = layout_of(run.plant, run.controller, run.setup).row
    first = sum(size for key, size in list(sizes.items())[: list(sizes).index(name)])
    return rows[..., first : first + sizes[name]]
