"""The sensors that a plant declares: how late they read, and the sizes of their errors and steps.

Sensors that read late have a first-order lag of each output, and a dead time of all of them:

    lag s' = p - s,     y(t) = s(t - dead_time)

Noise and resolution come after the lag. Simulations and linear loops have both exactly: the lag by further states of
the machine, the dead time by readings that are stored. In a proof, a delay of all readings is one of all forces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.linear.sampling import split_delay, whole_or_not
from malta.model.signals import DEFAULT, CasadiFn, Signal


@dataclass(frozen=True, eq=False)
class Sensors:
    """What the sensors of a plant add to its outputs: lag, dead time, errors, noise and steps.

        lag s' = p - s,     y(t) = s(t - dead_time)

    Lags and dead time are exact in simulations, linear loops and proofs. There is one exception: proofs with PI current
    loops, which read currents at once, take only whole samples of dead time. The design model has neither: a `delay` of
    the design and the margin proven of the machine's loop account for them.

    lag : s, of each output; 0.0: none; default: zero. A parameter of the machine may be among them, and vary in proofs.
    dead_time : s
    noise : of each sensor, rms of a sample, in the unit of the output; default: zero
    uniform : whether the noise is uniform; else normal
    resolution : of each sensor, in the unit of the output; 0: not quantized; default: zero
    range : of each sensor, its largest reading either way, in the unit of the output; 0: not declared; default: zero.
        Exported controllers refuse readings beyond it.
    sense : (x, sensor errors) -> y without noise; default: h of the plant
    errors : systematic errors of the sensors, arguments of `sense`

    `malta.plant_of` raises InputError for another number of entries than of outputs, and for times below 0.

    >>> import malta
    >>> from dataclasses import replace
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    >>> weights = malta.synthesis.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8])
    >>> law = malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=1e-3)
    >>> late = replace(cart, sensors=malta.model.Sensors(lag=(2e-3,), dead_time=1e-3))
    >>> margins = [malta.loop(one, law).classical.delay["y1"] for one in (cart, late)]
    >>> [f"{1e3 * margin:.1f} ms" for margin in margins]
    ['68.0 ms', '65.1 ms']
    """

    lag: tuple[Any, ...] = ()
    dead_time: float = 0.0
    noise: tuple[float, ...] = ()
    uniform: bool = False
    resolution: tuple[float, ...] = ()
    range: tuple[float, ...] = ()
    sense: CasadiFn = DEFAULT
    errors: tuple[Signal, ...] = ()

    @property
    def lagging(self) -> list[int]:
        """The outputs whose sensors have a lag."""
        return [k for k, lag in enumerate(self.lag) if not (isinstance(lag, (int, float)) and lag == 0)]

    @property
    def late(self) -> bool:
        """Whether a sensor has a lag or a dead time."""
        return bool(self.lagging or self.dead_time)

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of readings: noise, and steps of the resolution as even noise, q / sqrt(12)."""
        return np.asarray(np.hypot(np.array(self.noise), np.array(self.resolution) / np.sqrt(12)))


MOST_DELAY = 100  # samples: each one has states of its own in the loop and in what is compiled


def require_short(where: str, name: str, samples: float) -> float:
    """The same number of samples of delay. Raises InputError for more than MOST_DELAY."""
    if samples > MOST_DELAY:
        raise InputError(where, name, f"{samples:.10g} samples", f"at most {MOST_DELAY}")
    return samples


def split_dead_time(dead_time: float, Ts: float) -> tuple[int, float]:
    """Whole samples of a dead time, and the rest of it, s. Raises InputError for more than MOST_DELAY samples."""
    samples = require_short("machine", "dead time of its sensors", whole_or_not(dead_time / Ts))
    whole, part = split_delay(samples)
    return whole, part * Ts


def with_lags(sensors: Sensors, A: Any, B: Any, C: Any) -> tuple[Any, Any, Any]:
    """A, B and C (CasADi) of a system whose outputs are read behind lags; the readings s are states after x."""
    late = sensors.lagging
    if not late:
        return A, B, C
    n, k, kind = A.shape[0], len(late), ca.SX
    rate = ca.diag(ca.vertcat(*(1 / kind(sensors.lag[i]) for i in late)))
    A = system_matrix(kind(A), None, rate @ kind(C)[late, :], -rate)
    out = ca.horzcat(kind(C), kind(C.shape[0], k))
    for row, i in enumerate(late):
        out[i, :] = 0
        out[i, n + row] = 1
    return A, ca.vertcat(kind(B), kind(k, B.shape[1])), out
