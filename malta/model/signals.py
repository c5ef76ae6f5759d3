"""Signals of a machine, windings and electronics: records that stand below a plant.

Among them whether commanded values are those that currents make. This module imports none of a model's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

Coordinates = Literal[
    "signals", "positions"
]  # of integrals and process noise: of the outputs, or of the positions
CasadiFn = Callable[..., Any]  # takes and returns casadi SX, MX or DM
DEFAULT: Any = None  # stands for a function that follows from the other fields
LIMIT_TOLERANCE = 1e-9  # of the limit of a command
SHOWN_STATES = 7  # states


class Signal(NamedTuple):
    """A named scalar with its SI unit.

    name : as it stands in files and figures
    unit : SI, "1" for a pure number

    >>> import malta
    >>> malta.model.Signal("z", "m")
    Signal(name='z', unit='m')
    """

    name: str
    unit: str


class Mismatch(NamedTuple):
    """Along one state: the command whose currents miss it most."""

    state: Signal
    low: float  # ends of the clearance, SI
    high: float
    place: float  # the state there
    input: Signal
    command: float
    made: float  # what the currents of the command make
    share: float  # the difference, of the limit of the input, or of 1 N or 1 N m where it has none


@dataclass(frozen=True)
class InverseCheck:
    """Whether `currents` is the inverse of `forces` along the states of a machine.

    machine : its name
    mismatches : of each state with a clearance or a travel, where currents miss their command most
    undefined : commands without currents at the states' zero, in words; "": none

    >>> import malta
    >>> malta.plant_of(malta.read("data/halbach.toml")).check().exact
    True
    """

    machine: str
    mismatches: tuple[Mismatch, ...]
    undefined: str = ""

    @property
    def exact(self) -> bool:
        """Whether every command was made within rounding."""
        return all(m.share <= LIMIT_TOLERANCE for m in self.mismatches)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        word = "is" if self.exact else "is not"
        along = ", ".join(m.state.name for m in self.mismatches)
        lines = [f"{self.machine}: `currents` {word} the inverse of `forces` along {along}"]
        worst = sorted((m for m in self.mismatches if m.share > LIMIT_TOLERANCE), key=lambda m: -m.share)
        for m in worst[:SHOWN_STATES]:
            s, u = m.state, m.input
            room = f"in {m.low:.4g} .. {m.high:.4g} {s.unit}: at {m.place:.4g}" if m.low < m.high else "= 0:"
            lines.append(
                f"  {s.name} {room} the currents of {u.name} = "
                f"{m.command:.4g} {u.unit} make {m.made:.4g} {u.unit}, {100 * m.share:.3g} % of its limit apart"
            )
        if len(worst) > SHOWN_STATES:
            lines.append(f"  and along {len(worst) - SHOWN_STATES} more states, less than these")
        return "\n".join([*lines, f"  {self.undefined}"] if self.undefined else lines)


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
