"""The control law, stated once; the controller, which is all that a digital implementation needs.

                     v_ff, v0(z)
                         |            w
  p*, xi* --> [ law ] ---+--> v --> [ current loops ] --> [ plant ] --+--> p
                ^                                                     |
                +------------------------ y = p + noise <-------------+

At every sample:
  1. y = measured outputs;                      e += Ts (p* - y), frozen on the axes that saturated last, and on
                                                those whose reference moves faster than `pause`, where there is one,
                                                and on those that are farther off than `braking`, where there is one
  2. xi_hat = xi_pred + L (y - Cd xi_pred)                                     (steady-state Kalman filter)
  3. v_fb = K (xi* - xi_hat) + Ki e             with xi* = (P(z*)^-1 p*, its derivative)
  4. v = saturate(v_fb + v_ff + v0(z)),         v_ff = inertia p*'' + speed p*' + position q*, z the measured stroke
  5. currents = those that make v where y says the machine is, held until the next sample
  6. xi_pred = Ad xi_hat + Bd (v - v0(z))
Where an axis has a `braking`, b, an error xi* - xi_hat of its position that is larger counts in step 3 as
sqrt(b (2 |error| - b)), with its sign: a far end is approached at the speed from which a constant deceleration stops,
as limits of the force allow, and not in proportion to the distance. Within b the law is the linear one.

The mechanical states stand first in xi. Where the design models the lag of the current loops, the forces that act at
the sample follow: v - v0 behind first-order lags. Where it models a delay of d samples, forces of the last d samples
follow, the oldest first: v - v0, and what currents commutated for an old reading make beside it. Of a `fraction` of a
sample beyond, one sample more is stored: Ad and Bd say how long each force acts. The reference of both
is what was commanded then, lagging. Last come constant forces of disturbance, where the filter observes them, with
zero for a reference. Where a disturbance is known in advance, the forces that cancel it are added to v0(z).

An axis is the force and the output of one index, where there are as many of both. Else a sum of errors waits while
any force that it drives saturates, by its column of Ki; outputs whose column is zero have no sum in the loop.

Where the controller has a `commutation`, the currents of step 5 are those of y + lead p*', the place where they will
act on the way of the reference. The filter knows what that does to the forces that pull back between readings:
xi_pred = Ad xi_hat + Bd (v - v0 + pull lead p*'). The reference is not fed back, so the loop stays the same.

A PID controller is the same law: its filter takes positions as measured and rates as filtered differences,
Ad = diag(1, a), Bd = 0, L = (P^-1, (1 - a) P^-1 / Ts), and it has neither a cost nor noise that it was designed for.

So is any discrete linear system s+ = A s + B u, v = C s + D u of the errors u = p* - y, as an H-infinity controller
(`tracks` = "errors", state_space.controller_of). Step 2 takes y - p* in place of y, and xi* = 0:
xi = (s, y - p*), Ad = [[A, -B], [0, 0]], Bd = 0, Cd = 0, L = (0, 1), K = (-C, D), Ki = 0.

Where a law has a `schedule`, its matrices are those at the reference p* of one output (schedule.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal, NoReturn

import numpy as np

from malta.arguments import describe as describe_value
from malta.arrays import FloatArray, readonly
from malta.display import display
from malta.errors import InputError
from malta.model.parameters import Parameters
from malta.model.plant import Plant
from malta.model.signals import Coordinates, Signal
from malta.synthesis.schedule import Schedule

Tracks = Literal["states", "errors"]


@dataclass(frozen=True, eq=False)
class Feedforward:
    """v_ff = inertia p*'' + speed p*' + position q*; v0(z), linear between grid points, constant beyond.

    Where currents are held that were commutated for the last reading, what they pull back with is periodic with the
    samples: a steady ramp then takes a force, and passes the readings faster than on average.
    """

    inertia: FloatArray  # kg or kg m^2, m inputs; times the output of the same index, where there is one
    speed: FloatArray  # m x p, N s/m
    rate: FloatArray  # n0 / 2 x p (none without q'), rates at the samples beyond P^-1 p*', per unit of p*'
    z_grid: FloatArray  # m, g points
    v0: FloatArray  # N, g x m
    # m x n0 / 2, N/m: forces that hold the machine at q* = P^-1 p*; none: nothing is fed forward of q*
    position: FloatArray = field(default_factory=lambda: np.zeros((0, 0)), metadata={"later": True})

    def __post_init__(self) -> None:
        for name in ("inertia", "speed", "rate", "z_grid", "v0", "position"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def inertias(self) -> FloatArray:
        """The inertias as the matrix from p*'' to forces, m x p."""
        return np.eye(*self.speed.shape) * self.inertia[:, None]

    def at(self, z: float) -> FloatArray:
        """v0(z), N, m forces."""
        return np.array([np.interp(z, self.z_grid, column) for column in self.v0.T])

    def at_rest(self, z: float, q: FloatArray) -> FloatArray:
        """What is fed forward, N, of a machine at rest at its reference, with positions q: m forces."""
        moved = self.position @ q[: self.position.shape[1]] if self.position.size else 0.0
        return np.asarray(self.at(z) + moved)

    def slope(self, z: float) -> FloatArray:
        """dv0/dz, N/m, m forces, across the grid interval about z, at its ends the last one; zero beyond the grid."""
        if len(self.z_grid) < 2 or not self.z_grid[0] <= z <= self.z_grid[-1]:
            return np.zeros(self.v0.shape[1])
        k = min(int(np.searchsorted(self.z_grid, z, side="right")), len(self.z_grid) - 1)
        return np.asarray((self.v0[k] - self.v0[k - 1]) / (self.z_grid[k] - self.z_grid[k - 1]))


@dataclass(frozen=True)
class CurrentLoop:
    """PI controller of the current in each axis, u = Kp e + Ki integral of e."""

    Kp: float  # V/A
    Ki: float  # V/(A s)
    sample_time: float  # s


@dataclass(frozen=True, eq=False)
class Commutation:
    """Currents are commutated for y + lead p*', the place in the middle of the time for which they will be held.

    Currents that are held pull back to the place that they were commutated for. With y alone that place is lead p*'
    behind the machine, on average: a force of pull lead p*' that the reference does not want.
    """

    lead: float  # s, from a reading to the middle of the time for which its currents are held
    pull: FloatArray  # m x p, N/m: what currents that are commutated further by p add to the design model's forces

    def __post_init__(self) -> None:
        object.__setattr__(self, "pull", readonly(self.pull))


@dataclass(frozen=True, eq=False)
class Limits:
    """Of each coil, and of each input."""

    current: FloatArray  # A, coils
    voltage: FloatArray  # V, coils; inf: none
    force: FloatArray  # N or N m, m inputs

    def __post_init__(self) -> None:
        for name in ("current", "voltage", "force"):
            object.__setattr__(self, name, readonly(getattr(self, name)))


@display
@dataclass(frozen=True, eq=False)
class Noise:
    """Variances that the filter was designed for: white over a sample."""

    process: FloatArray  # N^2, m forces; in the coordinates of the positions m^2 / s^4, n0 / 2 accelerations
    sensor: FloatArray  # m^2, p measurements
    drift: FloatArray  # the same, of a constant force of disturbance from sample to sample: m, or none
    # n0 / 2, or none: see filters.py
    correlation: FloatArray = field(default_factory=lambda: np.zeros(0), metadata={"later": True})

    def __post_init__(self) -> None:
        for name in ("process", "sensor", "drift", "correlation"):
            object.__setattr__(self, name, readonly(getattr(self, name)))


@dataclass(frozen=True, eq=False)
class Cost:
    """Diagonals of the weights that the regulator minimizes: Q, R and Q_i."""

    state: FloatArray  # n0 mechanical states
    input: FloatArray  # m forces, 1/N^2
    integral: FloatArray  # p integrals of errors, or n0 / 2 in the coordinates of the positions
    # of the integrals and of the process noise
    coordinates: Coordinates = field(default="signals", metadata={"later": True})

    def __post_init__(self) -> None:
        for name in ("state", "input", "integral"):
            object.__setattr__(self, name, readonly(getattr(self, name)))


@dataclass(frozen=True, eq=False, repr=False)
class Controller:
    """Gains, models and limits of one controller; n states, m forces, p measurements.

        xi_hat = xi_pred + L (y - Cd xi_pred),    e += Ts (p* - y)
        v = saturate(K (xi* - xi_hat) + Ki e + v_ff + v0(z)),    xi_pred = Ad xi_hat + Bd (v - v0(z))

    With p = m force i and measurement i are of the same axis: when force i saturates, error integral i waits. Else an
    integral waits while any force saturates that its column of Ki drives. Behind the n0 states of the machine stand
    forces behind the lag of the current loops, stored forces, and observed disturbances, where the design models them.

    name : of the design
    spec_sha256 : digest of all in the design file that shapes the design
    parameters : of the machine that it was designed for
    operating_point : x (n0 states) and u
    sample_time : Ts, s
    states : n
    forces : m
    measurements : p
    A, B, C : continuous model of the machine alone, n0 x n0, n0 x m, p x n0
    Ad, Bd, Cd : sampled design model, n x n, n x m, p x n
    K : m x n
    Ki : m x p
    L : n x p, filter form
    cost : diagonals that the regulator minimizes; None for a PID or a law of errors
    noise : variances that the filter was designed for; None for a PID or a law of errors
    feedforward : v_ff = inertia p*'' + speed p*' + position q*, and v0(z) in N, linear between the points of z_grid (m)
    current_loop : PI gains Kp (V/A) and Ki (V/(A s)); None: currents follow their commands at once
    limits : current (A) and voltage (V) of each coil, force (N or N m) of each input
    pause : p, m/s: sums of errors wait while `|p*'|` is above it, 0: never; none: nothing waits. A stroke that the
        machine follows late or early by its own mass and force constants would charge the sums, which would push it
        past its end.
    references : 3 x p, SI: limits of positions, speeds and accelerations of references, which exported controllers
        obey; 0: those of the machine; none: all of them
    braking : p, m or rad: errors of positions beyond which an axis brakes along the parabola of a constant deceleration
        and its sum of errors waits, 0: never; none: no axis does. Only of outputs that are the state of their index.
    tracks : what the filter takes: "states" (y) or "errors" (y - p*)
    commutation : place for which currents are commutated; None: the reading y
    schedule : matrices at places of the reference of an output; Ad, Bd, Cd, K, Ki and L are those at the operating
        point; None: one set of matrices
    fraction : of a sample, for which the oldest of the stored forces acts, and the next one after it; 0: for all of it

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> controller
    Controller('calibrated', preset 'table1', 10 states, 5 forces, 20 kHz, delay 0)
    >>> controller.K.shape, controller.integrating, controller.measurements[0]
    ((5, 10), True, Signal(name='x1', unit='m'))
    """

    name: str
    spec_sha256: str
    parameters: Parameters
    operating_point: tuple[FloatArray, FloatArray]
    sample_time: float
    states: tuple[Signal, ...]
    forces: tuple[Signal, ...]
    measurements: tuple[Signal, ...]
    A: FloatArray
    B: FloatArray
    C: FloatArray
    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    K: FloatArray
    Ki: FloatArray
    L: FloatArray
    cost: Cost | None
    noise: Noise | None
    feedforward: Feedforward
    current_loop: CurrentLoop | None
    limits: Limits
    pause: FloatArray = field(default_factory=lambda: np.zeros(0), metadata={"later": True})
    references: FloatArray = field(default_factory=lambda: np.zeros((0, 0)), metadata={"later": True})
    braking: FloatArray = field(default_factory=lambda: np.zeros(0), metadata={"later": True})
    tracks: Tracks = field(default="states", metadata={"later": True})
    commutation: Commutation | None = field(default=None, metadata={"later": True})
    schedule: Schedule | None = field(default=None, metadata={"later": True})
    fraction: float = field(default=0.0, metadata={"later": True})

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, f.name, readonly(value))
        x, u = self.operating_point
        object.__setattr__(self, "operating_point", (readonly(x), readonly(u)))
        for k in np.flatnonzero(self.braking):
            if self.tracks == "errors" or k >= len(self.forces) or not is_own_state(self.C[k], int(k)):
                found = f"one of {self.measurements[k].name}"
                raise InputError(
                    self.name, "braking", found, "one of an output that is the state of its index"
                )

    def __repr__(self) -> str:
        return (
            f"Controller({self.name!r}, preset {self.parameters.preset!r}, {len(self.states)} states, "
            f"{len(self.forces)} forces, {1e-3 / self.sample_time:g} kHz, delay {self.delay:g}"
            f"{', current lag' if self.lagging else ''}"
            f"{f', scheduled over {self.schedule.variable}' if self.schedule else ''})"
        )

    @property
    def delay(self) -> float:
        """Samples of delay in the design model; 0 of a law of errors, which says nothing of its model."""
        return self.stored - 1 + self.fraction if self.fraction else self.stored

    @cached_property
    def stored(self) -> int:
        """The samples whose forces are among the states."""
        if self.tracks == "errors":
            return 0
        return (len(self.Ad) - len(self.A)) // len(self.forces) - self.lagging - self.observed

    @cached_property
    def lagging(self) -> int:
        """1 where forces behind the lag of the current loops are among the states, else 0."""
        n, lagging = len(self.A), lagging_forces(self.forces)
        return int(self.tracks == "states" and self.states[n : n + len(lagging)] == lagging)

    @cached_property
    def observed(self) -> int:
        """1 where forces of disturbance are among the states, else 0."""
        return int(self.tracks == "states" and self.states[-len(self.forces) :] == disturbances(self.forces))

    @cached_property
    def summed(self) -> tuple[int, ...]:
        """The outputs whose sums of errors are fed back, by index."""
        return summed_columns(self.Ki)

    @property
    def integrating(self) -> bool:
        """Whether sums of errors are fed back."""
        return bool(self.summed)

    @cached_property
    def sys(self) -> Any:
        """The law without saturation as a discrete control.StateSpace: see law_system.law_system."""
        from malta.synthesis.law_system import law_system

        return law_system(self)

    @cached_property
    def compensator_fields(self) -> dict[str, Any]:
        """The law without saturation, with its machine's delay and current loops: fields of a Compensator of proofs."""
        from malta.synthesis.law_system import compensator_fields

        return compensator_fields(self)

    @property
    def compensator(self) -> NoReturn:
        """Moved: `malta.proof.Compensator(**controller.compensator_fields)`. Raises InputError, which says so."""
        moved = "malta.proof.Compensator(**controller.compensator_fields)"
        raise InputError(self.name, "compensator", "a name that has moved", moved)


def lag_shares(c: Controller) -> list[tuple[int, float]]:
    """How much of commands a lagging force takes on in a sample, with their age in samples: of one, or of two."""
    n, m = len(c.A), len(c.forces)
    whole = 1 - float(c.Ad[n, n])
    if not c.fraction:
        return [(c.stored, whole)]
    newer = float(c.Ad[n, n + 2 * m] if c.stored > 1 else c.Bd[n, 0])
    return [(c.stored, whole - newer), (c.stored - 1, newer)]


def summed_columns(Ki: FloatArray) -> tuple[int, ...]:
    """The columns of Ki that are not zero."""
    return tuple(np.flatnonzero(Ki.any(axis=0)).tolist())


def is_own_state(row: FloatArray, k: int) -> bool:
    """Whether an output, a row of C, is the state of its index k."""
    return k < len(row) // 2 and bool(np.array_equal(row, np.eye(len(row))[k]))


def stored_forces(inputs: tuple[Signal, ...], samples: int) -> tuple[Signal, ...]:
    """The states that hold the forces of the last samples, the oldest first."""
    return tuple(Signal(f"{s.name}[k-{age}]", s.unit) for age in range(samples, 0, -1) for s in inputs)


def lagging_forces(inputs: tuple[Signal, ...]) -> tuple[Signal, ...]:
    """The states that hold the forces behind the lag of the current loops."""
    return tuple(Signal(f"{s.name}[i]", s.unit) for s in inputs)


def disturbances(inputs: tuple[Signal, ...]) -> tuple[Signal, ...]:
    """The states that hold constant forces of disturbance."""
    return tuple(Signal(f"{s.name}[d]", s.unit) for s in inputs)


def noise_input(B: FloatArray, coordinates: Coordinates) -> FloatArray:
    """G of x' = A x + B v + G w: the map of the inputs, or of accelerations of the positions, n x n / 2."""
    half = len(B) // 2
    return B if coordinates == "signals" else np.vstack([np.zeros((half, half)), np.eye(half)])


def holding_gain(A: FloatArray, B: FloatArray) -> FloatArray:
    """Forces that hold q'' = k q + G v at rest at a position: -G^-1 k, m x n / 2, N/m."""
    half = len(A) // 2
    return np.asarray(-np.linalg.lstsq(B[half:], A[half:, :half], rcond=None)[0])


def given_law(caller: str, law: Any) -> Controller:
    """A law that is a Controller. Raises InputError for anything else, as the name of a gain file."""
    if not isinstance(law, Controller):
        raise InputError(caller, "controller", describe_value(law), "a Controller, as malta.gains.read gives")
    return law


def require_law_of(caller: str, law: Controller, plant: Plant, *, by_name: bool = True) -> None:
    """Raise InputError for a law that reads or commands other signals than a machine has.

    by_name : False: signals without a name of their own, y1 y2 and u1 u2, may be those of any law with as many
    """
    sides = (("y", law.measurements, plant.outputs), ("u", law.forces, plant.inputs))
    for letter, own, of_plant in sides:
        names, wanted = ([s.name for s in signals] for signals in (own, of_plant))
        unnamed = not by_name and wanted == [f"{letter}{k + 1}" for k in range(len(names))]
        if names != wanted and not unnamed:
            expected = f"one of the {plant.name}, {' '.join(wanted)}"
            raise InputError(caller, "controller", f"one of {' '.join(names)}", expected)
