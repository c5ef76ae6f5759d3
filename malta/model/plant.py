"""The records of a machine: signals, plant, operating point.

A plant is x' = f(x, u, w), y = h(x, u), with external forces and torques w. The known static loads of the machine
(gravity, cogging) are a separate function load(x), because the feedforward v0(z) of the controller cancels them: the
machine moves by f(x, u, w + load(x)), and the controller is designed for f(x, u, 0).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from malta.arrays import FloatArray, readonly
from malta.display import Description, display, quantity
from malta.errors import InputError
from malta.linear.sampling import whole_or_not
from malta.model.actuator import Actuator
from malta.model.contacts import Contacts
from malta.model.drive import Drive
from malta.model.flat_fields import GROUPS, refuse_flat, refuse_reading
from malta.model.inverse import InverseCheck
from malta.model.parameters import Parameters as Parameters
from malta.model.sensors import Sensors, split_dead_time
from malta.model.signals import DEFAULT, CasadiFn, Signal as Signal
from malta.model.stroke import Stroke

if TYPE_CHECKING:
    from malta.model.rigid_body import Body


@display
@dataclass(frozen=True, eq=False)
class Plant:
    """A machine: equations of motion that CasADi can trace, and the names and units of its signals. SI.

        x' = f(x, u, w + load(x)),    y = h(x, u)

    `states` are positions, then their rates in the same order (`second_order`); a machine with other states has no
    natural frequencies, no PID and no feedforward of speeds. The inputs are forces; what makes and limits them is the
    `actuator`, what reads the outputs the `sensors`.

    Only the fields without a default are required. `malta.plant_of` checks that the fields fit each other.

    name : of the machine
    parameters : its Parameters record
    states : n
    inputs : m, forces and torques
    outputs : p
    f : (x, u, w) -> x'
    h : (x, u) -> y
    actuator : `Actuator`: coils, their currents, forces and limits, current loops
    variant : the same machine with other parameters: its own function `plant`
    disturbances : w, forces and torques from outside
    uncontrolled : states that no input reaches, as the rotation of a round mover: simulated, but not designed for
    load : x -> w of gravity and cogging; default: zero
    position_of : y -> controlled positions at rest (of other states than (q, q'): all states), inverse of h; default: y
    preload : x -> inputs that act at the operating point of the design model; default: those of commands of zero
    sensors : `Sensors`: noise, resolution, range, errors, lags and dead time
    contacts : `Contacts`: surfaces that the mover may touch
    stroke : `Stroke`: the output that travels, and what drives it; default: the machine has none
    inertia : of each input: factor of p*'' of the same output in the feedforward
    over : intervals of parameters that proofs cover, SI, as any speed of a rotor: {"Omega": (0, 2094)}
    bodies : () -> what pictures of the machine in motion show, see `malta motion`; None: no pictures

    Raises InputError for a field of a group that stands at the machine itself, as noise=..., and names its group.

    >>> import malta
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> plant.second_order, plant.stroke.travel, plant.uncontrolled
    (True, 0.015, ('gamma', 'gamma_dot'))
    """

    name: str
    parameters: Parameters
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    f: CasadiFn
    h: CasadiFn
    actuator: Actuator
    variant: Callable[[Any], Plant]
    disturbances: tuple[Signal, ...] = ()
    uncontrolled: tuple[str, ...] = ()
    load: CasadiFn = DEFAULT
    position_of: CasadiFn = DEFAULT
    preload: CasadiFn = DEFAULT
    sensors: Sensors = field(default_factory=Sensors)
    contacts: Contacts = field(default_factory=Contacts)
    stroke: Stroke = field(default_factory=Stroke)
    inertia: tuple[float, ...] = ()
    over: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bodies: Callable[[], Sequence[Body]] | None = None

    if not TYPE_CHECKING:

        def __new__(cls, *_: Any, **given: Any) -> Plant:
            """Refuse the fields that are in groups now, with a sentence. It goes with version 0.4, as __getattr__."""
            refuse_flat(given)
            return super().__new__(cls)

        def __getattr__(self, name: str) -> Any:
            """Say in which group a field is, for the names that a plant had before it had groups."""
            return refuse_reading(name)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the parameters, and what was changed beside them."""
        from malta.model.pickling import recipe_of  # which builds plants

        return recipe_of(self)

    def __post_init__(self) -> None:
        refuse_flat({name: getattr(self, name) for name in GROUPS}, self.name)
        for name, value in _defaults(self).items():
            group, _, entry = name.rpartition(".")
            record = getattr(self, group) if group else self
            given = getattr(record, entry)
            if given is DEFAULT or given == ():
                if group:
                    record, entry, value = self, group, replace(record, **{entry: value})
                object.__setattr__(record, entry, value)
        if getattr(self.load, "func", None) not in (_zeros, _column):
            object.__setattr__(self, "load", partial(_column, self.load))

    @property
    def drive(self) -> Drive:
        """The windings. Raises InputError for a machine without a model of them."""
        if self.actuator.windings is None:
            raise InputError(self.name, "drive", "none", "a machine whose windings are modelled")
        return self.actuator.windings

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
        """Raise InputError unless the states are (q, q').

        what : the part that requires it, which the error names
        """
        if not self.second_order:
            found = "states that are not positions and then their rates"
            raise InputError(self.name, what, found, "x = (q, q')")

    @property
    def has_stroke(self) -> bool:
        """Whether one of the outputs is a stroke."""
        return bool(self.stroke.name)

    @property
    def stroke_output(self) -> int:
        """The index of the stroke among the outputs. Raises InputError for a machine without a stroke."""
        return self._index(self.stroke.name, self.outputs)

    def _index(self, name: str, signals: tuple[Signal, ...]) -> int:
        """The index of the stroke or the thrust among signals."""
        if not name:
            raise InputError(self.name, "stroke", "none", "a machine with a stroke")
        return [s.name for s in signals].index(name)

    @property
    def leading_output(self) -> int:
        """The index of the stroke among the outputs; 0 for a machine without a stroke."""
        return self.stroke_output if self.has_stroke else 0

    @property
    def leading_input(self) -> int:
        """The index of the thrust among the inputs; 0 for a machine without a stroke."""
        return self.thrust_input if self.has_stroke else 0

    @property
    def stroke_state(self) -> int:
        """The index of the stroke among the states. Raises InputError for a machine without a stroke."""
        return self._index(self.stroke.name, self.states)

    @property
    def thrust_input(self) -> int:
        """The index of the thrust among the inputs. Raises InputError for a machine without a stroke."""
        return self._index(self.stroke.thrust, self.inputs)

    def nlsys(self) -> Any:
        """The machine as a continuous control.NonlinearIOSystem with named signals, evaluated by CasADi.

        x' = f(x, u, w + load(x)), y = h(x, u); the inputs of the machine come first, then the disturbances w.

        >>> import malta
        >>> ball = malta.read_design("examples/ball/design/ball.toml").plant
        >>> ball.nlsys().input_labels
        ['f', 'w']
        """
        import control  # imports matplotlib and takes a second: only where it is used

        m, kind = len(self.inputs), ca.MX if self.actuator.tabulated else ca.SX
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
        """The operating point at these states, the others zero, with the preload of the design model.

        The loads do not act, because v0(z) cancels them at every position.

        positions : states by name, SI

        Raises InputError for unknown states.

        >>> import malta
        >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
        >>> plant.at(z=5e-3).x.tolist()[:3]
        [0.0, 0.0, 0.005]
        """
        return self._operating_point(self.state(positions))

    def point(self, design: ArrayLike) -> OperatingPoint:
        """The operating point at these states of the design model, the uncontrolled states zero.

        design : the states of the design model, SI

        >>> import malta
        >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
        >>> len(plant.design_states), len(plant.point([0.0] * 10).x)
        (10, 12)
        """
        x = np.zeros(len(self.states))
        x[list(self.controlled)] = design
        return self._operating_point(x)

    def _operating_point(self, x: FloatArray) -> OperatingPoint:
        u = np.array(ca.DM(self.preload(ca.DM(x))), dtype=float).ravel()
        return OperatingPoint(x, u, loaded=False)

    def check(self) -> InverseCheck:
        """Check whether `currents` is the inverse of `forces`: forces(x, currents(h(x), v)) = v.

        Commands up to half of each limit beside the preload are tried along each position, as far as contacts and the
        travel leave room, where their currents are within the machine's limits. A design is right where it is no
        inverse, too: `malta.linearize` and `malta.trim` take the slopes and the command of what the currents make.

        Returns an InverseCheck, which prints where the two differ most.

        >>> import malta
        >>> print(malta.read_design("examples/ball/design/ball.toml").plant.check())
        ball: `currents` is not the inverse of `forces` along q
          q in -0.002 .. 0.002 m: at -0.002 the currents of f = -3.6 N make -11.02 N, 103 % of its limit apart
        """
        from malta.model.currents import check_inverse  # which imports plants

        return check_inverse(self)

    def state(self, values: Mapping[str, float]) -> FloatArray:
        """The state vector with these entries, the others zero.

        values : states by name, SI

        Raises InputError for unknown names and values that are not finite.

        >>> import malta
        >>> malta.read_design("examples/ball/design/ball.toml").plant.state(
        ...     {"q": 1e-3}
        ... ).tolist()
        [0.001, 0.0]
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

    @property
    def description(self) -> Description:
        """Its signals, travel and limits."""
        names = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        rows = [(kind, " ".join(signal.name for signal in signals)) for kind, signals in names.items()]
        rows.append(("disturbances", " ".join(signal.name for signal in self.disturbances)))
        if self.has_stroke:
            rows.append(("stroke", f"{self.stroke.name}, {quantity(self.stroke.travel, 'm')} either way"))
        rows.append(("contacts", " ".join(self.contacts.names) or "none"))
        coil = self.actuator.coils[0].unit if self.actuator.coils else "A"
        limits = (
            quantity(limit, s.unit) for limit, s in zip(self.actuator.force_limit, self.inputs, strict=False)
        )
        rows += [
            ("limits", ", ".join(limits)),
            ("current limit", quantity(self.actuator.current_limit, coil)),
        ]
        return Description(f"Plant {self.name!r}, preset {self.parameters.preset!r}", tuple(rows))


def _defaults(plant: Plant) -> dict[str, Any]:
    """The defaults of a plant's optional fields, by name."""
    m, p, w = len(plant.inputs), len(plant.outputs), len(plant.disturbances)
    actuator = plant.actuator
    return {
        "load": partial(_zeros, w),
        "position_of": outputs_themselves,
        "preload": lambda x: actuator.forces(
            x, actuator.currents(plant.h(x, ca.DM.zeros(m)), ca.DM.zeros(m))
        ),
        "inertia": (0.0,) * m,
        "contacts.contact": partial(_zeros, 0),
        "contacts.cushioned": (False,) * len(plant.contacts.names),
        "contacts.bearing": partial(_zeros, w),
        "sensors.sense": lambda x, _: plant.h(x, 0),
        "sensors.lag": (0.0,) * p,
        "sensors.noise": (0.0,) * p,
        "sensors.resolution": (0.0,) * p,
        "sensors.range": (0.0,) * p,
    }


def _zeros(size: int, x: Any) -> Any:
    return type(x).zeros(size) if isinstance(x, ca.SX | ca.MX | ca.DM) else ca.DM.zeros(size)


def _column(load: CasadiFn, x: Any) -> Any:
    """The loads as a column, of a plain number or a list too, so that `f` may take w[0] of them."""
    return ca.vertcat(load(x))


def outputs_themselves(y: Any) -> Any:
    """The default of `position_of`: the outputs are the positions."""
    return y


@lru_cache(maxsize=64)  # plants compare by identity
def has_feedthrough(plant: Plant) -> bool:
    """Whether readings follow the inputs at once: h(x, u) has a part of u."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    x, u = kind.sym("x", len(plant.states)), kind.sym("u", len(plant.inputs))
    return bool(ca.jacobian(ca.vertcat(plant.h(x, u)), u).nnz())


def whole_samples(plant: Plant, Ts: float) -> int:
    """The dead time of a plant's sensors in samples, as a proof with PI current loops has it.

    Raises InputError for a dead time that is not a whole number of samples.
    """
    whole, rest = split_dead_time(plant.sensors.dead_time, Ts)
    if rest:
        found = f"{plant.sensors.dead_time * 1e6:g} us"
        expected = f"whole samples of {Ts * 1e6:g} us in a proof with PI current loops; all else takes any"
        raise InputError(plant.name, "sensors.dead_time", found, expected)
    return whole


@display
@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A state and inputs to linearize at.

    x : all states, SI
    u : inputs that act on the machine, N
    loaded : whether the loads act and u balances them, as after `malta.trim`
    v : inputs to command, so that the currents of the controller make u; None: `malta.linearize` finds them. They are
        u where `currents` is the inverse of `forces`.

    >>> import malta
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> point = plant.at(z=5e-3)
    >>> point.loaded, float(point.x[2]), malta.trim(plant, z=5e-3).loaded
    (False, 0.005, True)
    """

    x: FloatArray
    u: FloatArray
    loaded: bool
    v: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", readonly(self.x))
        object.__setattr__(self, "u", readonly(self.u))
        if self.v is not None:
            object.__setattr__(self, "v", readonly(self.v))


def trace(name: str, arguments: list[Any], expression: Callable[..., Any]) -> CasadiFn:
    """A function of `arguments` for expression(*arguments), traced at its first call: machines that differ in numbers
    alone share what is traced of one of them. Symbols of parameters in the expression stay symbols."""

    @cache
    def traced() -> tuple[ca.Function, list[Any]]:
        body = ca.cse(expression(*arguments))
        known = {symbol.__hash__() for a in arguments for symbol in ca.symvar(a)}
        free = [symbol for symbol in ca.symvar(body) if symbol.__hash__() not in known]
        return ca.Function(name, [*arguments, *free], [body]), free

    def call(*given: Any) -> Any:
        function, free = traced()
        return function(*given, *free)

    return call


def symbolic(parameters: Any, symbols: Mapping[str, Any]) -> Any:
    """A parameter record with CasADi symbols in place of numbers, without the checks of its class."""
    record = object.__new__(type(parameters))
    for f in fields(parameters):
        object.__setattr__(record, f.name, symbols.get(f.name, getattr(parameters, f.name)))
    return record


def total_delay(plant: Plant, Ts: float) -> float:
    """Samples from a motion to its force: a delay of all readings is one of all forces."""
    return whole_or_not(plant.actuator.delay(Ts) + plant.sensors.dead_time / Ts)


def given_plant(caller: str, given: Any) -> Plant:
    """The machine of an argument: a Plant, or that of a LinearModel. Raises InputError for anything else."""
    plant = given.plant if hasattr(given, "operating_point") and hasattr(given, "plant") else given
    if not isinstance(plant, Plant):
        raise InputError(caller, "plant", f"a {type(plant).__name__}", "a Plant or a LinearModel")
    return plant
