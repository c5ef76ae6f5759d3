"""The records of a machine: signals, plant, operating point; and trim().

A plant is x' = f(x, u, w), y = h(x, u), with external forces and torques w. The known static loads of the machine
(gravity, cogging) are a separate function load(x), because the feedforward v0(z) of the controller cancels them: the
machine moves by f(x, u, w + load(x)), and the controller is designed for f(x, u, 0).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import casadi as ca
import numpy as np

from malta.errors import CheckError, InputError
from malta.model.checks import DEFAULT, defaults
from malta.model.drive import CasadiFn, Drive, Electronics
from malta.model.sensors import LateSensors, require_short

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    FloatArray = NDArray[np.floating[Any]]
    ComplexArray = NDArray[np.complexfloating[Any, Any]]


class Parameters(Protocol):
    """A frozen dataclass whose physical fields are declared with `parameters.si(unit)`."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __hash__(self) -> int: ...

    @property
    def preset(self) -> str: ...


class Signal(NamedTuple):
    """A named scalar with its SI unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Actuator:
    """The coils that make the inputs: their current loops and limits.

    The current loop is a PI controller on 1 / (L s + R), designed for `crossover` and `phase_margin`. Without a
    crossover currents follow their commands at once, and of the fields after `current_limit` only `dead_time` counts.

    Example: `Actuator(coils=(Signal("i", "A"),), force_constant=(38.0,), current_limit=3.0)`
    """

    coils: tuple[Signal, ...]  # their currents, A
    force_constant: tuple[float, ...]  # N/A, of each input; empty when inputs share coils
    current_limit: float  # A, of each coil
    force_limit: tuple[float, ...] = ()  # of each input, N or N m; (): by the current limit
    voltage_limit: float = math.inf  # V; inf: none
    R: float = 0.0  # ohm
    L: float = 0.0  # H
    crossover: float = math.inf  # rad/s; inf: currents follow their commands at once
    phase_margin: float = math.pi / 2  # rad
    sample_time: float = 0.0  # s, of the current loops
    loop_delay: float = 0.0  # s, their dead time
    dead_time: float = 0.0  # s, from measurement to force

    def __post_init__(self) -> None:
        if not self.force_limit:
            limits = tuple(self.current_limit * constant for constant in self.force_constant)
            object.__setattr__(self, "force_limit", limits)

    def delay(self, Ts: float) -> int:
        """Whole samples of delay from measurement to force: the dead time minus the half sample of the hold.

        Raises InputError for more than MOST_DELAY.
        """
        return require_short("machine", "dead time", max(0, round(self.dead_time / Ts - 0.5)))


@dataclass(frozen=True, eq=False)
class Plant:
    """A machine: equations of motion that CasADi can trace, and the names and units of its signals.

    `states` are positions, then their rates in the same order (`second_order`); a machine with other states has no
    natural frequencies, no PID and no feedforward of speeds. `uncontrolled` are states that no input reaches, as the
    rotation of a round mover: they are simulated, but not part of the design model.

    The inputs are forces. `currents(y, v)` returns the coil currents for the forces v at the measured position y. They
    are held for one sample, while the forces of these currents, `forces(x, i)`, change with the state.

    Only the fields without a default are required. A machine without a `stroke` has no travel, thrust and mass. A
    machine that runs at any value of a parameter, as a rotor at any speed, gives the interval in `over`: margins are
    proven for the whole interval, as they are for the travel.

    `data.plant_of` checks that the fields fit each other. Examples: malta/machines/, the module of `malta new`.
    """

    name: str
    parameters: Parameters
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    f: CasadiFn  # (x, u, w) -> x'
    h: CasadiFn  # (x, u) -> y
    actuator: Actuator
    variant: Callable[[Any], Plant]  # the same machine with other parameters: its own function `plant`
    disturbances: tuple[Signal, ...] = ()  # w: forces and torques from outside
    uncontrolled: tuple[str, ...] = ()
    load: CasadiFn = DEFAULT  # x -> w of gravity and cogging; default: zero
    # y -> controlled positions at rest (of other states than (q, q'): all states), the inverse of h; default: y
    position_of: CasadiFn = DEFAULT
    preload: CasadiFn = DEFAULT  # x -> inputs at the operating point of the design model; default: zero
    currents: CasadiFn = DEFAULT  # (y, inputs) -> coil currents, A; default: by the force constants
    forces: CasadiFn = DEFAULT  # (x, coil currents) -> inputs; default: by the force constants
    limited: CasadiFn = DEFAULT  # coil currents -> coil currents within their limits
    tabulated: bool = False  # whether `currents` uses a look-up table, so that only CasADi MX works
    windings: Drive | None = None  # None: no model of the windings
    electronics: Callable[[Any], Electronics] | None = (
        None  # options of the machine -> electronics; None: those of the drive
    )
    contacts: tuple[str, ...] = ()  # surfaces that the mover may touch
    contact: CasadiFn = DEFAULT  # x -> used share of each clearance; 1 at contact
    cushioned: tuple[bool, ...] = ()  # of each contact: whether a touchdown bearing carries it
    bearing: CasadiFn = DEFAULT  # x -> w of the touchdown bearings; zero without contact
    sense: CasadiFn = DEFAULT  # (x, sensor errors) -> y without noise; default: h
    sensor_errors: tuple[Signal, ...] = ()
    sensors: LateSensors | None = None  # None: they read at once
    noise: tuple[float, ...] = ()  # of each sensor, rms of a sample, in the unit of the output; default: zero
    uniform: bool = False  # whether the noise is uniform; else normal
    resolution: tuple[float, ...] = ()  # of each sensor, in the unit of the output; 0: not quantized
    inertia: tuple[float, ...] = ()  # of each input: factor of p*'' of the same output in the feedforward
    mass: float = 0.0  # kg, moved by the `thrust` input
    thrust: str = ""  # the input that drives the stroke
    stroke: str = ""  # the output that the stroke moves; "": the machine has no stroke
    travel: float = 0.0  # of the stroke, either way, m
    over: Mapping[str, tuple[float, float]] = field(
        default_factory=dict
    )  # intervals of parameters that proofs cover, SI

    def __post_init__(self) -> None:
        for name, value in defaults(self).items():
            given = getattr(self, name)
            if given is DEFAULT or given == ():
                object.__setattr__(self, name, value)

    @property
    def drive(self) -> Drive:
        """The windings. Raises InputError for a machine without a model of them."""
        if self.windings is None:
            raise InputError(self.name, "drive", "none", "a machine whose windings are modelled")
        return self.windings

    @property
    def controlled(self) -> tuple[int, ...]:
        """Indices of the states of the design model."""
        return tuple(i for i, s in enumerate(self.states) if s.name not in self.uncontrolled)

    @property
    def design_states(self) -> tuple[Signal, ...]:
        """The states of the design model."""
        return tuple(self.states[i] for i in self.controlled)

    @cached_property
    def second_order(self) -> bool:
        """Whether the states are (q, q'): the first half of f equals the second half of x as expressions."""
        half, odd = divmod(len(self.states), 2)
        x, u = ca.SX.sym("x", len(self.states)), ca.SX.sym("u", len(self.inputs))
        rate = ca.SX(ca.vertcat(self.f(x, u, ca.SX.sym("w", len(self.disturbances)))))
        return not odd and all(ca.is_equal(rate[k], x[half + k], 1) for k in range(half))

    @property
    def coordinates(self) -> int:
        """The number of positions q in the design model's states (q, q'); 0 for other states."""
        return len(self.controlled) // 2 if self.second_order else 0

    def require_second_order(self, what: str) -> None:
        """Raise InputError unless the states are (q, q'), which `what` requires."""
        if not self.second_order:
            found = "states that are not positions and then their rates"
            raise InputError(self.name, what, found, "x = (q, q')")

    @property
    def has_stroke(self) -> bool:
        """Whether one of the outputs is a stroke."""
        return bool(self.stroke)

    @property
    def stroke_output(self) -> int:
        """The index of the stroke among the outputs. Raises InputError for a machine without a stroke."""
        if not self.stroke:
            raise InputError(self.name, "stroke", "none", "a machine with a stroke")
        return [s.name for s in self.outputs].index(self.stroke)

    @property
    def leading_output(self) -> int:
        """The index of the stroke among the outputs; 0 for a machine without a stroke."""
        return self.stroke_output if self.stroke else 0

    @property
    def leading_input(self) -> int:
        """The index of the thrust among the inputs; 0 for a machine without a stroke."""
        return self.thrust_input if self.stroke else 0

    @property
    def stroke_state(self) -> int:
        """The index of the stroke among the states. Raises InputError for a machine without a stroke."""
        if not self.stroke:
            raise InputError(self.name, "stroke", "none", "a machine with a stroke")
        return [s.name for s in self.states].index(self.stroke)

    @property
    def thrust_input(self) -> int:
        """The index of the thrust among the inputs. Raises InputError for a machine without a stroke."""
        if not self.thrust:
            raise InputError(self.name, "thrust", "none", "a machine with a stroke")
        return [s.name for s in self.inputs].index(self.thrust)

    def nlsys(self) -> Any:
        """The machine as a continuous control.NonlinearIOSystem with named signals, evaluated by CasADi.

        x' = f(x, u, w + load(x)), y = h(x, u); the inputs of the machine come first, then the disturbances w.
        """
        import control  # imports matplotlib and takes a second: only where it is used

        m, kind = len(self.inputs), ca.MX if self.tabulated else ca.SX
        x, u = kind.sym("x", len(self.states)), kind.sym("u", m + len(self.disturbances))
        rate = ca.Function("rate", [x, u], [ca.densify(self.f(x, u[:m], u[m:] + self.load(x)))])
        outputs = ca.Function("outputs", [x, u], [ca.densify(self.h(x, u[:m]))])
        return control.nlsys(
            lambda _, x, u, __: np.array(rate(x, u)).ravel(),
            lambda _, x, u, __: np.array(outputs(x, u)).ravel(),
            name=self.name,
            states=[s.name for s in self.states],
            inputs=[s.name for s in (*self.inputs, *self.disturbances)],
            outputs=[s.name for s in self.outputs],
        )

    def at(self, /, **positions: float) -> OperatingPoint:
        """The operating point at these states (SI), the others zero, with the preload of the design model.

        The loads do not act, because v0(z) cancels them at every position. Raises InputError for unknown states.

        Example: `plant.at(z=5e-3)`
        """
        return self._operating_point(self.state(positions))

    def point(self, design: ArrayLike) -> OperatingPoint:
        """The operating point at these states of the design model (SI), the uncontrolled states zero."""
        x = np.zeros(len(self.states))
        x[list(self.controlled)] = design
        return self._operating_point(x)

    def _operating_point(self, x: FloatArray) -> OperatingPoint:
        u = np.array(ca.DM(self.preload(ca.DM(x))), dtype=float).ravel()
        return OperatingPoint(x, u, loaded=False)

    def state(self, values: Mapping[str, float]) -> FloatArray:
        """The state vector with these entries (SI), the others zero.

        Raises InputError for unknown names and values that are not finite.
        """
        names = [s.name for s in self.states]
        x = np.zeros(len(names))
        for name, value in values.items():
            if name not in names:
                raise InputError(self.name, name, "an unknown state", "one of " + " ".join(names))
            try:
                x[names.index(name)] = value
            except (TypeError, ValueError, OverflowError):
                x[names.index(name)] = np.nan
            if not np.isfinite(x[names.index(name)]):
                raise InputError(self.name, name, repr(value), "a finite number")
        return x


def position_in(plant: Plant, x: ArrayLike) -> float:
    """The position along the stroke in a state; 0 for a machine without a stroke."""
    return float(np.asarray(x)[plant.stroke_state]) if plant.has_stroke else 0.0


def position_at(plant: Plant, x: ArrayLike) -> dict[str, float]:
    """The position along the stroke by name, an argument of `plant.at`; empty for a machine without a stroke."""
    return {plant.stroke: position_in(plant, x)} if plant.has_stroke else {}


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A state and inputs to linearize at; `loaded`: whether the loads act and u balances them (trim)."""

    x: FloatArray
    u: FloatArray
    loaded: bool

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", readonly(self.x))
        object.__setattr__(self, "u", readonly(self.u))


def readonly(array: ArrayLike) -> FloatArray:
    """A read-only copy as floats; a read-only array of floats is returned unchanged."""
    if isinstance(array, np.ndarray) and array.dtype == float and not array.flags.writeable:
        return array
    copy = np.array(array, dtype=float)
    copy.flags.writeable = False
    return copy


def trace(name: str, arguments: list[Any], expression: Any) -> CasadiFn:
    """A function of `arguments` for an expression; symbols of parameters in the expression stay symbols."""
    body = ca.cse(expression)
    known = {symbol.__hash__() for a in arguments for symbol in ca.symvar(a)}
    free = [symbol for symbol in ca.symvar(body) if symbol.__hash__() not in known]
    function = ca.Function(name, [*arguments, *free], [body])
    return lambda *given: function(*given, *free)


def symbolic(parameters: Any, symbols: Mapping[str, Any]) -> Any:
    """A parameter record with CasADi symbols in place of numbers, without the checks of its class."""
    record = object.__new__(type(parameters))
    for f in fields(parameters):
        object.__setattr__(record, f.name, symbols.get(f.name, getattr(parameters, f.name)))
    return record


def trim(plant: Plant, /, **positions: float) -> OperatingPoint:
    """The inputs that hold the machine at rest at these states (SI) against its loads.

    Solves 0 = f(x, u, load(x)) for u, in the least-squares sense, by Newton's method. Accelerations of uncontrolled
    states are left: a mover whose centre of gravity is off its axis rolls.

    Raises InputError for unknown states, CheckError when no input holds the machine there.

    Example: `malta.trim(plant, z=5e-3).u`
    """
    x = plant.at(**positions).x
    return OperatingPoint(x, _hold(plant, x[None, :])[0], loaded=True)


def load_balance(plant: Plant, states: FloatArray) -> FloatArray:
    """The inputs that cancel the loads alone at rest: f(x, u, load(x)) = f(x, 0, 0); one row for each row of states.

    The controller balances the other forces, as the pull of a magnetic bearing off its centre.

    Raises CheckError when no input cancels the loads.
    """
    return _hold(plant, states, loads_alone=True)


def holding_forces(plant: Plant) -> FloatArray:
    """The forces v to command at the states' zero, so that their currents hold the machine there at rest.

    Solves 0 = f(0, forces(0, currents(h(0), v)), load(0)) by Newton's method, in the least-squares sense. A plant that
    is written about a point off its centre is thus held there, whatever its magnets pull with.

    Raises CheckError when no forces hold it.
    """
    kind = ca.MX if plant.tabulated else ca.SX
    x, v = kind(ca.DM.zeros(len(plant.states))), kind.sym("v", len(plant.inputs))
    i = plant.currents(plant.h(x, kind.zeros(len(plant.inputs))), v)
    rate = ca.densify(plant.f(x, plant.forces(x, i), plant.load(x)))
    residual = ca.Function("residual", [v], [rate, ca.jacobian(rate, v)])
    return _inputs_at_rest(plant, residual, "it at rest", steps=30)


def _hold(plant: Plant, states: FloatArray, *, loads_alone: bool = False) -> FloatArray:
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    rate = plant.f(x, u, plant.load(x))
    if loads_alone:
        rate -= plant.f(x, ca.SX.zeros(len(plant.inputs)), ca.SX.zeros(len(plant.disturbances)))
    if plant.second_order:
        for index in set(range(len(plant.states) // 2, len(plant.states))) - set(plant.controlled):
            rate[index] = 0  # an acceleration that no input holds
    residual = ca.Function("residual", [x, u], [rate, ca.jacobian(rate, u)])
    return np.array(
        [
            # f is affine in the inputs of most machines: the second step only polishes
            _inputs_at_rest(plant, partial(residual, state), f"the state {state.tolist()}", steps=2)
            for state in states
        ]
    )


def _inputs_at_rest(plant: Plant, residual: CasadiFn, held: str, *, steps: int) -> FloatArray:
    """The inputs where the rates vanish, by at most so many steps of Newton's method.

    residual : inputs -> rates and their derivatives by the inputs

    Raises CheckError, which names what is `held`, when some rate is left.
    """
    u = np.zeros(len(plant.inputs))
    for _ in range(steps):
        r, J = (np.array(value) for value in residual(u))
        if not r.any() or not np.isfinite(r).all():
            break
        u -= np.linalg.lstsq(J, r, rcond=None)[0].ravel()
    left = float(np.abs(np.array(residual(u)[0])).max())
    if not left <= 1e-9:  # m/s, rad/s, m/s2 or rad/s2
        raise CheckError(f"{plant.name}: no input holds {held}: it changes at up to {left:.3g} (SI) a second")
    return u
