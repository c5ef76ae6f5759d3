"""What a design file holds once it is read: weights or PID gains, loads, requirements, and what a search may vary.

    design/NAME.toml -> synthesis.design_file.read_design() -> Spec

Weights are dimensionless and stand on explicit bases (Bryson's rule): Q = diag(q / base^2). Noise is the variance of
one sample. All numbers are in SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field as dataclass_field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from malta.arrays import FloatArray, readonly
from malta.display import Description, display, quantity
from malta.errors import InputError, require_known
from malta.model.fingerprint import fingerprint
from malta.model.parameters import box_words
from malta.model.plant import Parameters, Plant, Signal
from malta.model.plants import plant_of
from malta.model.signals import Coordinates
from malta.synthesis.weighting import Weights
from malta.units import to_si

if TYPE_CHECKING:
    from malta.synthesis.recovery import RecoveryBound

Discretization = Literal["backward-euler", "zoh", "sampled-data"]
# What integrals are taken of and process noise acts on: errors of outputs and forces of inputs, or errors of positions
# and their accelerations.
PidAxes = Literal["decentralized", "centre-of-gravity"]
Place = Literal["measured", "predicted"]
Law = Literal["LQG", "PID", "structure"]


@dataclass(frozen=True, eq=False)
class Pid:
    """Gains of a PID controller of each axis.

    axes : "decentralized": output k with input k, gains in N/m, N/(m s), N s/m (of a torque N m/rad and so on).
        "centre-of-gravity": coordinate k with the acceleration that all inputs together give it, gains in 1/s^2,
        1/s^3 and 1/s.

    Raises InputError for gains that are not finite or not as many as axes, and for a time below 0 s.
    """

    Kp: FloatArray  # m
    Ki: FloatArray  # m
    Kd: FloatArray  # m
    filter: FloatArray | float  # s, of the measured rates: m, or one of all; 0: plain differences
    axes: PidAxes = "decentralized"

    def __post_init__(self) -> None:
        for name in ("Kp", "Ki", "Kd"):
            value = readonly(getattr(self, name))
            object.__setattr__(self, name, value)
            if value.ndim != 1 or not np.isfinite(value).all() or value.shape != np.shape(self.Kp):
                raise InputError("Pid", name, str(value.tolist()), "finite numbers, one for each input")
        times = float(self.filter) if np.ndim(self.filter) == 0 else readonly(np.asarray(self.filter))
        object.__setattr__(self, "filter", times)
        if np.shape(times) not in ((), self.Kp.shape):
            raise InputError("Pid", "filter", f"{np.size(times)} times", "one, or one for each axis")
        if not (np.isfinite(times) & (np.asarray(times) >= 0)).all():
            raise InputError("Pid", "filter", f"{np.asarray(times).tolist()} s", "a time of 0 s or more")

    @property
    def filters(self) -> FloatArray:
        """Time constant of each axis, s, m of them."""
        return np.broadcast_to(np.asarray(self.filter, dtype=float), self.Kp.shape)


@dataclass(frozen=True)
class Loads:
    """What a PID is judged by: [cost]. White noise, a force's spread over the sample, a sensor's of each reading."""

    load: tuple[float, ...]  # m, N or N m: a constant force from outside on each input, one at a time
    force_noise: tuple[float, ...]  # m, N or N m rms of one sample
    sensor_noise: tuple[float, ...]  # p, m or rad rms of one sample


@dataclass(frozen=True)
class StructuredElement:
    """An element of [structure.elements].

    kind : "gain", "pid", "lead", "notch", "transfer" or "lqg"
    numbers : SI, by the names of malta.structured; coefficients of a transfer function as tuples; of an lqg by
        "state.x" and so on
    units : SI units of the numbers
    bounds : (low, high) of some of them, SI
    """

    name: str
    kind: str
    numbers: Mapping[str, Any]
    units: Mapping[str, str]
    bounds: Mapping[str, tuple[float, float]]


class StructuredGoal(NamedTuple):
    """An entry of [goals]: the arguments of a goal of malta.structured, SI."""

    name: str
    kind: str
    soft: bool
    arguments: Mapping[str, Any]


@display
@dataclass(frozen=True)
class StructuredLaw:
    """A law of named elements, and its goals.

    law : by axis, elements one behind the other
    axes : "decentralized": an output with the input of its index; "centre-of-gravity": a coordinate with all inputs
    """

    law: Mapping[str, tuple[str, ...]]
    elements: tuple[StructuredElement, ...]
    goals: tuple[StructuredGoal, ...]
    axes: PidAxes = "decentralized"


class Variable(NamedTuple):
    """A number that the search may choose: entries of the design file that share it."""

    name: str
    entries: tuple[str, ...]  # as "bases.state.x"
    low: float
    high: float
    unit: str  # of low and high, as the file will hold it


@display
@dataclass(frozen=True, eq=False)
class Spec:
    """A design file, read and checked. SI.

    name : of the design
    summary : one line of text
    path : the design file
    machine_file : the machine's data file
    sha256 : of everything in the file that shapes the design, published references resolved
    parameters : of the machine
    operating_point : states by name
    sample_time : s
    discretization : "sampled-data", "zoh" or "backward-euler"
    delay : samples between measurement and force in the design model
    current_loop_delay : whether the current loops are designed with the machine's dead time
    law : the weights of an LQG, the gains of a PID, or elements of a given structure with their goals
    uncertainty : relative, either way, by parameter
    current_lag : whether the lag of the current loops is in the design model
    pause : p, m/s: of the reference, above which sums of errors wait; 0: never
    braking : p, m/s^2: deceleration at which the law brakes from far errors; 0: it does not
    references : 3 x p, SI: limits of positions, speeds and accelerations; 0: those of the machine
    position_feedforward : whether the forces that hold the machine at its reference are fed forward
    inertia_feedforward : multiple of the machine's inertia in the feedforward of p*''
    commutation : the place for which currents are commutated: "measured" or "predicted"
    loads : what a PID is judged by; None: nothing
    specification : SI, by requirement: "margin"; by requirement and signal: "noise_motion x"
    recovery : what the entries "recovery NAME" of the specification bound, by NAME
    search : numbers that a search may choose
    delays : that a search may choose from
    schedule : an output and its places, SI, at which the law is designed; None: at the operating point alone

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> spec.weights.q_base.tolist(), spec.uncertainty  # m and m/s; shares
    ([0.0001, 0.01], {'m': 0.2, 'C': 0.2})
    >>> spec.plant is malta.plant_of(spec.parameters)
    True
    """

    name: str
    summary: str
    path: Path
    machine_file: Path
    sha256: str
    parameters: Parameters
    operating_point: Mapping[str, float]
    sample_time: float
    discretization: Discretization
    delay: float
    current_loop_delay: bool
    law: Weights | Pid | StructuredLaw
    uncertainty: Mapping[str, float]
    current_lag: bool = False
    pause: tuple[float, ...] = ()
    braking: tuple[float, ...] = ()
    references: tuple[tuple[float, ...], ...] = ()
    position_feedforward: bool = False
    inertia_feedforward: float = 1.0
    commutation: Place = "measured"
    loads: Loads | None = None
    specification: Mapping[str, float] = dataclass_field(default_factory=dict)
    recovery: Mapping[str, RecoveryBound] = dataclass_field(default_factory=dict)
    search: tuple[Variable, ...] = ()
    delays: tuple[float, ...] = ()
    schedule: tuple[str, tuple[float, ...]] | None = None

    @property
    def plant(self) -> Plant:
        """The machine that the controller is designed for."""
        return plant_of(self.parameters)

    @property
    def lag(self) -> float | None:
        """The lag in the design model, rad/s; None: none."""
        return self.plant.actuator.crossover if self.current_lag else None

    @property
    def weights(self) -> Weights:
        """Of an LQG. InputError for other laws, which have none."""
        if not isinstance(self.law, Weights):
            found = ("pid", "a PID controller") if self.pid else ("structure", "a law of a given structure")
            raise InputError(self.path, *found, "weights, bases and noise of an LQG")
        return self.law

    @property
    def pid(self) -> Pid | None:
        """Gains of a PID; None for other laws."""
        return self.law if isinstance(self.law, Pid) else None

    @property
    def structure(self) -> StructuredLaw | None:
        """Elements and goals of a law of a given structure; None for other laws."""
        return self.law if isinstance(self.law, StructuredLaw) else None

    @property
    def kind(self) -> Law:
        """The kind of the law: "LQG", "PID" or "structure"."""
        return "PID" if self.pid else "structure" if self.structure else "LQG"

    @property
    def axes(self) -> PidAxes:
        """What the axes of the law are; of an LQG, which has none, as of a PID that does not say."""
        return "decentralized" if isinstance(self.law, Weights) else self.law.axes

    def place_of(self, entry: str, field: str = "search") -> Entry:
        """Find where an entry of the file stands in the law.

        entry : as "bases.state.x"
        field : the field of the file that an error names

        Raises InputError for an entry that no design file has.
        """
        return place_of(entry, self.plant, self.path, field, self.law)

    def vary(self, values: Sequence[float]) -> Spec:
        """Return the design with other numbers.

        values : one for each variable of the search, in its own unit

        >>> import malta
        >>> spec = malta.read_design("examples/ball/design/ball.toml")
        >>> [variable.name for variable in spec.search]
        ['position', 'integral', 'force']
        >>> float(spec.vary([50.0, 5.0, 0.1]).weights.q_base[0])  # 50 um
        5e-05
        """
        found = {}
        for variable, value in zip(self.search, values, strict=True):
            for entry in variable.entries:
                unit = self.place_of(entry)[2]
                found[entry] = value if unit == "1" else to_si(value, variable.unit, unit, self.path, entry)
        return replace(self, law=self._law_with(found, "search"))

    def replace(self, numbers: Mapping[str, float] | None = None, **fields: Any) -> Spec:
        """Return the design with other numbers or fields; its sha256 is another one, so that gain files differ.

        numbers : of the law, SI, by their place in the design file, as {"bases.state.x": 50e-6}
        fields : of this record, by name

        Raises InputError for a place that no design file has, a number that the law cannot have, and an unknown field.

        >>> import malta
        >>> spec = malta.read_design("examples/ball/design/ball.toml")
        >>> stiffer = spec.replace({"bases.state.q": 50e-6}, name="stiffer")
        >>> stiffer.name, float(stiffer.weights.q_base[0]), stiffer.sha256 == spec.sha256
        ('stiffer', 5e-05, False)
        """
        known = [name for name in self.__dataclass_fields__ if name not in ("sha256", "path", "machine_file")]
        require_known(fields, known, self.path, found="a field that a design lacks")
        law = self._law_with(numbers, "numbers") if numbers else self.law
        own = fingerprint((self.sha256, numbers or {}, fields))
        return replace(self, **({"law": law, "sha256": own} | fields))

    def _law_with(self, numbers: Mapping[str, float], field: str) -> Weights | Pid | StructuredLaw:
        """The law with other numbers, SI, by their place in the file. Raises InputError as `place_of` does."""
        if isinstance(self.law, StructuredLaw):
            return self._structure_with(self.law, numbers, field)
        names = [name for name in self.law.__dataclass_fields__ if name not in ("axes", "coordinates")]
        fields: dict[str, Any] = {name: np.array(getattr(self.law, name)) for name in names}
        for entry, si in numbers.items():
            place, index, _, squared = self.place_of(entry, field)
            if not fields[place].size:
                raise InputError(self.path, entry, "an entry that this design leaves out", "one that it has")
            fields[place][index] = si * si if squared else si
        return replace(self.law, **fields)

    def _structure_with(self, law: StructuredLaw, numbers: Mapping[str, float], field: str) -> StructuredLaw:
        """A law of elements with other numbers, SI, by their place, as "structure.elements.radial.Kp"."""
        own = {
            f"structure.elements.{e.name}.{key}": (k, key)
            for k, e in enumerate(law.elements)
            for key, value in e.numbers.items()
            if isinstance(value, float)
        }
        changed = list(law.elements)
        for entry, si in numbers.items():
            require_known([entry], own, self.path, field)
            k, key = own[entry]
            changed[k] = replace(changed[k], numbers={**changed[k].numbers, key: float(si)})
        return replace(law, elements=tuple(changed))

    def value_of(self, variable: Variable) -> float:
        """Return the number that the file holds for a variable of the search, in the variable's unit.

        variable : one of `search`
        """
        field, index, unit, squared = self.place_of(variable.entries[0])
        si = float(np.asarray(getattr(self.law, field))[index])
        si = math.sqrt(si) if squared else si
        return si if unit == "1" else si / to_si(1.0, variable.unit, unit, self.path, variable.name)

    @property
    def description(self) -> Description:
        """Its machine, its law and what is asked of it."""
        rows = [("machine", f"{self.plant.name}, preset {self.parameters.preset!r}")]
        kind = {"structure": "given structure"}.get(self.kind, self.kind)
        kind += f", {self.discretization}" if self.kind == "LQG" else ""
        rows.append(("law", f"{kind}, every {quantity(self.sample_time, 's')}, delay {self.delay:g}"))
        if self.schedule is not None:
            rows.append(("schedule", f"{len(self.schedule[1])} places of {self.schedule[0]}"))
        rows.append(("uncertainty", box_words(self.uncertainty, self.parameters) or "none"))
        asked = ", ".join(f"{name} {value:g}" for name, value in self.specification.items())
        rows += [("specification", asked or "none"), ("sha256", self.sha256[:12])]
        return Description(f"Spec {self.name!r} of {self.path.name}", tuple(rows))


def require_pairs(plant: Plant) -> None:
    """Raise InputError unless a machine has as many forces as measurements."""
    if len(plant.inputs) != len(plant.outputs):
        found = f"{len(plant.inputs)} forces and {len(plant.outputs)} measurements"
        expected = "as many of both: a PID has one of each for every axis; an LQG takes any numbers"
        raise InputError(plant.name, "pid", found, expected)


def pid_signals(plant: Plant, axes: PidAxes = "decentralized") -> dict[str, list[Signal]]:
    """Name the gains of a PID, and its filters: each table with one signal for every axis, and the gain's unit.

    An axis bears the name of its input; at the centre of gravity, the name of its coordinate.
    """
    if axes == "centre-of-gravity":
        names = [s.name for s in plant.design_states[: plant.coordinates]]
        units = {"Kp": "1/s^2", "Ki": "1/s^3", "Kd": "1/s", "filters": "s"}
        return {table: [Signal(name, unit) for name in names] for table, unit in units.items()}
    require_pairs(plant)
    pairs = list(zip(plant.inputs, plant.outputs, strict=True))
    return {
        "Kp": [Signal(i.name, f"({i.unit}) / ({o.unit})") for i, o in pairs],
        "Ki": [Signal(i.name, f"({i.unit}) / ({o.unit}) / s") for i, o in pairs],
        "Kd": [Signal(i.name, f"({i.unit}) s / ({o.unit})") for i, o in pairs],
        "filters": [Signal(i.name, "s") for i, _ in pairs],
    }


Entry = tuple[str, int | tuple[()], str, bool]  # field of the law, index, SI unit, whether as its square


def integral_signals(plant: Plant, coordinates: Coordinates) -> list[Signal]:
    """Name the integrals that can be weighed, with the units of their bases."""
    of = plant.outputs if coordinates == "signals" else plant.design_states[: plant.coordinates]
    return [Signal(s.name, f"{s.unit} s") for s in of]


def process_signals(plant: Plant, coordinates: Coordinates) -> list[Signal]:
    """Name the sources of process noise with their units: forces of the inputs, or accelerations of the positions."""
    if coordinates == "signals":
        return list(plant.inputs)
    return [Signal(s.name, f"{s.unit} / s^2") for s in plant.design_states[: plant.coordinates]]


def place_of(
    entry: str,
    plant: Plant,
    where: Path,
    field: str = "search",
    law: Weights | Pid | StructuredLaw | None = None,
) -> Entry:
    """Find where an entry of the design file stands in Weights or Pid.

    law : whose coordinates or axes count; None: signals and single sensors

    Raises InputError for an entry that no design file has, and for a law of elements, which is not searched so.
    """
    if isinstance(law, StructuredLaw):
        raise InputError(where, field, repr(entry), "none beside [structure]: its elements have low and high")
    if entry == "pid.filter":
        return "filter", (), "s", False
    coordinates: Coordinates = law.coordinates if isinstance(law, Weights) else "signals"
    axes: PidAxes = law.axes if isinstance(law, Pid) else "decentralized"
    tables = _entries(plant, coordinates, axes)
    table, _, name = entry.rpartition(".")
    if table not in tables:
        raise InputError(
            where, field, repr(entry), "an entry as bases.state.x, in one of " + " ".join(tables)
        )
    weight, signals, squared = tables[table]
    names = [s.name for s in signals]
    if name not in names:
        raise InputError(where, field, repr(entry), f"one of {table}: {' '.join(names)}")
    index = names.index(name)
    return weight, index, signals[index].unit, squared


@lru_cache(maxsize=8)  # a file names dozens of entries; plants compare by identity
def _entries(
    plant: Plant, coordinates: Coordinates, axes: PidAxes
) -> dict[str, tuple[str, Sequence[Signal], bool]]:
    """The tables of a law by name: the field of Weights or Pid, its entries, and whether they count as squares."""
    integrals = integral_signals(plant, coordinates)
    plain = [Signal(s.name, "1") for s in plant.design_states + plant.inputs + plant.outputs]
    tables: dict[str, tuple[str, Sequence[Signal], bool]] = {
        "bases.state": ("q_base", plant.design_states, False),
        "bases.input": ("r_base", plant.inputs, False),
        "bases.integral": ("q_i_base", integrals, False),
        "noise.process": ("process_variance", process_signals(plant, coordinates), True),
        "noise.sensor": ("sensor_variance", plant.outputs, True),
        "weights.state": ("q", plain[: len(plant.design_states)], False),
        "weights.input": ("r", plain[len(plant.design_states) :][: len(plant.inputs)], False),
        "weights.integral": ("q_i", [Signal(s.name, "1") for s in integrals], False),
        "noise.drift": ("drift_variance", process_signals(plant, coordinates), True),
    }
    if coordinates == "positions":
        tables["noise.correlation"] = ("correlation", [Signal(s.name, "1") for s in integrals], False)
    pairs = len(plant.inputs) == len(plant.outputs) or axes != "decentralized"
    for name, gains in pid_signals(plant, axes).items() if pairs else ():
        tables[f"pid.{name}"] = ("filter" if name == "filters" else name, gains, False)
    return tables
