"""How a simulation ended: completed, diverged, or at the first contact."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.model.plant import Plant
from malta.simulation.layout import columns_of_row
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


def judge(
    run: Simulation, rows: FloatArray, t: FloatArray, ended: bool = False
) -> tuple[FloatArray, Verdict | None]:
    """The rows up to the first contact or the first NaN, and the verdict; None where neither occurs.

    A machine with touchdown bearings goes on after it touches one of them; only other contacts end its run.

    ended : rows end with the first in which a contact ends the run, as the compiled engine's do
    """
    columns, last = columns_of_row(run.plant, run.controller, run.setup)["contact"], rows[-1].tolist()
    if all(map(math.isfinite, last)):  # a state that is no number stays none
        largest = max(last[columns], default=0.0) if ended else rows[:, columns].max(initial=0.0)
        if largest < 1:
            return rows, None
    plant, contact = run.plant, rows[:, columns]
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
    return rows[..., columns_of_row(run.plant, run.controller, run.setup)[name]]
