"""The windings behind a machine's inputs, and the electronics that run their current loops."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from malta.model.signals import CasadiFn, Signal


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
