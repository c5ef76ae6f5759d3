"""Signals of a machine and the sensors that read them: records that stand below a plant.

Among them whether commanded values are those that currents make. This module imports none of a model's.

Sensors that read late have a first-order lag of each output, and a dead time of all of them:

    lag s' = p - s,     y(t) = s(t - dead_time)

Noise and resolution come after the lag. Simulations have both. Linear loops have the lag exactly, as further states of
the machine, and the dead time where it is whole samples: a delay of all readings is one of all forces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca

from malta.errors import InputError
from malta.linear.matrices import system_matrix

CasadiFn = Callable[..., Any]  # takes and returns casadi SX, MX or DM
EXACT = 1e-9  # of the limit of a command
SHOWN = 7  # states


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
        return all(m.share <= EXACT for m in self.mismatches)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        word = "is" if self.exact else "is not"
        along = ", ".join(m.state.name for m in self.mismatches)
        lines = [f"{self.machine}: `currents` {word} the inverse of `forces` along {along}"]
        worst = sorted((m for m in self.mismatches if m.share > EXACT), key=lambda m: -m.share)
        for m in worst[:SHOWN]:
            s, u = m.state, m.input
            room = f"in {m.low:.4g} .. {m.high:.4g} {s.unit}: at {m.place:.4g}" if m.low < m.high else "= 0:"
            lines.append(
                f"  {s.name} {room} the currents of {u.name} = "
                f"{m.command:.4g} {u.unit} make {m.made:.4g} {u.unit}, {100 * m.share:.3g} % of its limit apart"
            )
        if len(worst) > SHOWN:
            lines.append(f"  and along {len(worst) - SHOWN} more states, less than these")
        return "\n".join([*lines, f"  {self.undefined}"] if self.undefined else lines)


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
    >>> weights = malta.synthesis.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8])
    >>> law = malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=1e-3)
    >>> late = replace(cart, sensors=malta.model.LateSensors((2e-3,), dead_time=1e-3))
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
    A = system_matrix(kind(A), None, rate @ kind(C)[late, :], -rate)
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
