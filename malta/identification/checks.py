"""The identified machine checked on its own log, and against the box of its gain file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError
from malta.identification.measure import LAW_TOLERANCE, Measurement, measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from malta.identification.log import Log
    from malta.model.parameters import Parameters
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

MAX_S_ERROR = 0.05  # of |S|, by which the identified machine may miss what is measured, beside its band


@dataclass(frozen=True, eq=False)
class LoopCheck:
    """The identified machine under the law of the gain file, beside the loop as the same log has it.

    measured : the loop, with the identified machine as the prediction
    sensor, frequency : where |S| is predicted worst, name and rad/s
    error : of |S| there, beside the band of noise, as a share of what is predicted
    """

    measured: Measurement
    sensor: str
    frequency: float
    error: float

    @property
    def refusal(self) -> str:
        """Why the identified machine is not that of the log; "": it is."""
        if self.measured.law > LAW_TOLERANCE * 5:
            return self.measured.refusal
        if self.error <= MAX_S_ERROR:
            return ""
        k = int(np.abs(self.measured.w - self.frequency).argmin())
        S = self.measured.S.at(self.measured.sensors.index(self.sensor))
        return (
            f"the identified machine does not have the loop that was measured: |S| of {self.sensor} at "
            f"{self.frequency / (2 * np.pi):.4g} Hz is {S.size[k]:.3g}, predicted {abs(S.predicted[k]):.3g}; currents, "
            "readings or a known value are wrong by a factor"
        )


def check_loop(controller: Controller, plant: Plant, *logs: Log) -> LoopCheck | None:
    """Predict S of the identified machine and measure it on its logs; None for logs that tell no S.

    controller : the gain file that was running
    plant : the identified machine
    logs : in the machine's order
    """
    try:
        found = measure(controller, *logs, parameters=plant.parameters)
    except CheckError:
        return None
    size = np.abs(found.S.predicted)
    # T is small at high and S at low frequencies: either counts beside what it is a part of.
    off = np.maximum(np.abs(found.S.size - size) - found.factor * found.S.deviation, 0.0) / size
    k, i = np.unravel_index(int(off.argmax()), off.shape)
    return LoopCheck(found, found.sensors[i], float(found.w[k]), float(off[k, i]))


def outside_of_box(values: Mapping[str, float], box: Mapping[str, float], par: Parameters) -> str:
    """Why parameters are outside of the gain file's box; "": they are inside."""
    for name, share in box.items():
        middle, value = float(getattr(par, name, 0.0)), values.get(name)
        if value is not None and middle and abs(value / middle - 1) > share:
            low, high = sorted((middle * (1 - share), middle * (1 + share)))
            return f"{name} is {value:.5g}, outside of the gain file's own box, {low:.5g} to {high:.5g}"
    return ""
