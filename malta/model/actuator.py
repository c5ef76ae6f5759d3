"""The actuator of a plant: coils, what currents and forces make of each other, limits, and the current loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca

from malta.model.drive import Drive, Electronics
from malta.model.sensors import require_short
from malta.model.signals import DEFAULT, CasadiFn, Signal


@dataclass(frozen=True, eq=False)
class Actuator:
    """The coils that make the inputs: their currents, forces and limits, and their current loops.

    `currents(y, v)` returns the coil currents for the forces v at the measured position y. They are held for one
    sample, while the forces of these currents, `forces(x, i)`, change with the state.

    The current loop is a PI controller on 1 / (L s + R), designed for `crossover` and `phase_margin`. Without a
    crossover currents follow their commands at once, and of the fields from `voltage_limit` to `loop_delay` none
    counts.

    coils : their currents, A
    force_constant : N/A, of each input; empty when inputs share coils
    current_limit : A, of each coil
    force_limit : of each input, N or N m; (): by the current limit
    voltage_limit : V; inf: none
    R : ohm
    L : H
    crossover : rad/s, of the current loops; inf: currents follow their commands at once
    phase_margin : rad, of the current loops
    sample_time : s, of the current loops
    loop_delay : s, dead time of the current loops
    dead_time : s, from measurement to force
    currents : (y, inputs) -> coil currents, A; default: by the force constants
    forces : (x, coil currents) -> inputs; default: by the force constants
    limited : coil currents -> coil currents within their limits; default: each within `current_limit`
    tabulated : whether `currents` uses a look-up table, so that only CasADi MX works
    windings : model of the windings; None: none
    electronics : options of the machine -> electronics; None: those of the drive

    >>> import malta
    >>> current = malta.model.Signal("i", "A")
    >>> coil = malta.model.Actuator((current,), (38.0,), current_limit=3, dead_time=1e-4)
    >>> coil.force_limit, coil.delay(Ts=50e-6)  # N; samples
    ((114.0,), 2)
    """

    coils: tuple[Signal, ...]
    force_constant: tuple[float, ...]
    current_limit: float
    force_limit: tuple[float, ...] = ()
    voltage_limit: float = math.inf
    R: float = 0.0
    L: float = 0.0
    crossover: float = math.inf
    phase_margin: float = math.pi / 2
    sample_time: float = 0.0
    loop_delay: float = 0.0
    dead_time: float = 0.0
    currents: CasadiFn = DEFAULT
    forces: CasadiFn = DEFAULT
    limited: CasadiFn = DEFAULT
    tabulated: bool = False
    windings: Drive | None = None
    electronics: Callable[[Any], Electronics] | None = None

    def __post_init__(self) -> None:
        constants, limit = self.force_constant, self.current_limit
        if not self.force_limit:
            object.__setattr__(self, "force_limit", tuple(limit * constant for constant in constants))
        self._follow("currents", _currents_by, constants)
        self._follow("forces", _forces_by, constants)
        self._follow("limited", _within, limit)

    def _follow(self, name: str, function: CasadiFn, own: Any) -> None:
        """Set a function that nobody gave, also that of the actuator of which this one is a changed copy."""
        given = getattr(self, name)
        if given is DEFAULT or getattr(given, "func", None) is function:
            object.__setattr__(self, name, partial(function, own))

    def delay(self, Ts: float) -> int:
        """Whole samples of delay from measurement to force: the dead time minus the half sample of the hold.

        Ts : sample time, s

        Raises InputError for more than MOST_DELAY.
        """
        return require_short("machine", "dead time", max(0, round(self.dead_time / Ts - 0.5)))


def _currents_by(constants: tuple[Any, ...], _: Any, v: Any) -> Any:
    return v / ca.vertcat(*constants)


def _forces_by(constants: tuple[Any, ...], _: Any, i: Any) -> Any:
    return ca.vertcat(*constants) * i


def _within(limit: Any, i: Any) -> Any:
    return ca.fmax(ca.fmin(i, limit), -limit)
