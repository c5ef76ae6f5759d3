"""Sensors that read late: a first-order lag of each output, and a dead time of all of them.

    lag s' = p - s,     y(t) = s(t - dead_time)

Noise and resolution come after the lag. Simulations have both. Linear loops have the lag exactly, as further states of
the machine, and the dead time where it is whole samples: a delay of all readings is one of all forces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca

from malta.errors import InputError

if TYPE_CHECKING:
    from malta.model.plant import Plant


@dataclass(frozen=True, eq=False)
class LateSensors:
    """How late the sensors of a plant read. A lag of 0.0 is none; others may be CasADi symbols."""

    lag: tuple[Any, ...]  # s, of each output
    dead_time: float  # s

    @property
    def lagging(self) -> list[int]:
        """The outputs whose sensors have a lag."""
        return [k for k, lag in enumerate(self.lag) if not (isinstance(lag, (int, float)) and lag == 0)]


def late_sensors(lag: tuple[Any, ...], dead_time: float) -> LateSensors | None:
    """The sensors of a plant; None where all of them read at once."""
    sensors = LateSensors(lag, dead_time)
    return sensors if sensors.lagging or dead_time else None


MOST_DELAY = 100  # samples: each one has states of its own in the loop and in what is compiled


def require_short(where: str, name: str, samples: int) -> int:
    """The same number of samples of delay. Raises InputError for more than MOST_DELAY."""
    if samples > MOST_DELAY:
        raise InputError(where, name, f"{samples} samples", f"at most {MOST_DELAY}")
    return samples


def split_dead_time(dead_time: float, Ts: float) -> tuple[int, float]:
    """Whole samples of a dead time, and the rest of it, s. Raises InputError for more than MOST_DELAY samples."""
    whole = require_short("machine", "dead time of its sensors", int(dead_time / Ts + 1e-9))
    rest = dead_time - whole * Ts
    return whole, rest if rest > 1e-9 * Ts else 0.0


def whole_samples(plant: Plant, Ts: float) -> int:
    """The dead time of a plant's sensors in samples, as a linear loop has it.

    Raises InputError for a dead time that is not a whole number of samples.
    """
    if plant.sensors is None:
        return 0
    whole, rest = split_dead_time(plant.sensors.dead_time, Ts)
    if rest:
        found = f"{plant.sensors.dead_time * 1e6:g} us of dead time of its sensors"
        expected = f"whole samples of {Ts * 1e6:g} us in a linear loop; simulations take any"
        raise InputError(plant.name, "sensors", found, expected)
    return whole


def with_lags(sensors: LateSensors | None, A: Any, B: Any, C: Any) -> tuple[Any, Any, Any]:
    """A, B and C (CasADi) of a system whose outputs are read behind lags; the readings s are states after x."""
    late = [] if sensors is None else sensors.lagging
    if sensors is None or not late:
        return A, B, C
    n, k, kind = A.shape[0], len(late), ca.SX
    rate = ca.diag(ca.vertcat(*(1 / kind(sensors.lag[i]) for i in late)))
    A = ca.blockcat([[kind(A), kind(n, k)], [rate @ kind(C)[late, :], -rate]])
    out = ca.horzcat(kind(C), kind(C.shape[0], k))
    for row, i in enumerate(late):
        out[i, :] = 0
        out[i, n + row] = 1
    return A, ca.vertcat(kind(B), kind(k, B.shape[1])), out
