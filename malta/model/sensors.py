"""Sensors that read late: a first-order lag of each output, and a dead time of all of them.

    lag s' = p - s,     y(t) = s(t - dead_time)

Noise and resolution come after the lag. Simulations have both. Linear loops have the lag exactly, as further states of
the machine, and the dead time where it is whole samples: a delay of all readings is one of all forces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca

from malta.errors import InputError

if TYPE_CHECKING:
    from malta.model.signals import CasadiFn, Signal


@dataclass(frozen=True, eq=False)
class LateSensors:
    """How late the sensors of a plant read: the lag of each output, and the dead time of all.

        lag s' = p - s,     y(t) = s(t - dead_time)

    Simulations take any dead time, linear loops and proofs whole samples of it; the lags are exact in all of them. The
    design model knows neither: a `delay` of the design and the margin proven of the machine's loop account for them.

    lag : s, of each output; 0.0: none. A parameter of the machine may be among them, and then vary in proofs.
    dead_time : s

    `malta.plant_of` raises InputError for another number of lags than of outputs, and for times below 0.

    >>> import malta
    >>> from dataclasses import replace
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    >>> weights = malta.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8])
    >>> law = malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=1e-3)
    >>> late = replace(cart, sensors=malta.LateSensors((2e-3,), dead_time=1e-3))
    >>> margins = [malta.loop(one, law).classical.delay["y1"] for one in (cart, late)]
    >>> [f"{1e3 * margin:.1f} ms" for margin in margins]
    ['68.0 ms', '65.1 ms']
    """

    lag: tuple[Any, ...]
    dead_time: float = 0.0

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


# The windings behind a machine's inputs, and the electronics that run their current loops.


@dataclass(frozen=True, eq=False)
class CurrentSensors:
    """Sensors of the phase currents. The current controllers read i + offset + noise, rounded to steps."""

    noise: Any  # A, rms of a sample
    offset: tuple[Any, ...]  # A, of each phase
    step: Any  # A; 0: none


@dataclass(frozen=True, eq=False)
class Drive:
    """The windings behind the inputs, in transformed axes (as dq) and as phases on an inverter.

    In every axis u = R i + L (i' - coupling(x, i)) + emf(x), with R and L of the actuator. The matrix T(x), phases x
    axes, transforms axis quantities into phase quantities; its pseudo-inverse transforms them back.
    """

    axes: tuple[Signal, ...]  # currents, A
    phases: tuple[Signal, ...]  # currents, A
    command: CasadiFn  # currents of the inputs, A -> currents of the axes, A
    force: CasadiFn  # currents of the axes, A -> inputs
    emf: CasadiFn  # x -> induced voltages of the axes, V
    coupling: CasadiFn  # (x, i) -> contribution of the moving axes to i', A/s
    to_phases: CasadiFn  # x -> T(x)
    to_axes: CasadiFn  # x -> T(x)^+
    turned: CasadiFn  # inputs -> Q: Q i are the currents in axes aligned with the forces, as the paper commands them
    peak: CasadiFn  # axis quantities -> upper bound of the phase quantities of each group of axes
    groups: tuple[tuple[int, ...], ...]  # axes that share phases
    stars: tuple[tuple[int, ...], ...]  # phases that share a star point
    weight: tuple[float, ...]  # of each axis: power = sum of weight u i
    link_voltage: float  # V, of the supply
    link_capacitance: float  # F
    supply_resistance: float  # ohm
    pwm_step: float  # smallest change of a duty cycle
    dead_share: float  # share of a PWM period that dead time takes
    sensors: CurrentSensors | None = None  # None: the current controllers know the currents


@dataclass(frozen=True, eq=False)
class Electronics:
    """Current loops with their sensors and modulators, which run many times in a sample of the control law.

    One period of the electronics is one step of the simulation. `state` is simulated beside the mover's state and the
    coil currents.
    """

    period: float  # s
    state: Mapping[str, int]  # names and sizes
    noises: int  # standard normal numbers that one period uses
    flags: tuple[str, ...]  # names of limits that a simulation may reach
    set_points: tuple[Signal, ...]  # of the loops, until the next sample
    held: CasadiFn  # (currents commanded, y) -> these set points
    start: CasadiFn  # (x, i) -> state by name at rest
    move: CasadiFn  # (x, i, state by name, held, w, noise) -> x, i, state by name one period later
    met: CasadiFn  # state by name -> 1 for each flag whose limit was reached
    duty: CasadiFn  # state by name -> duty cycle of each coil
