"""Design files: what a controller is asked to be. design/NAME.toml -> read_design() -> Spec.

Weights are dimensionless and stand on explicit bases (Bryson's rule): Q = diag(q / base^2). Noise is given as the
standard deviation or the variance of one sample. Wherever numbers are expected, `{ published = "table_II.state" }`
stands for what the machine's paper prints under that name in data/published/.

What `malta tune` is to reach and what it may vary stand in [specification] and [search], and what it makes small for a
PID in [cost]; they shape no gains by themselves.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, StrictBool, StrictInt, StrictStr

from malta.errors import CheckError, InputError
from malta.model.data import (
    Finite,
    Quantity,
    Record,
    load_toml,
    plant_of,
    published,
    read,
    to_si,
    units_of,
    validated,
)
from malta.model.plant import Plant, Signal, readonly

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Parameters

Discretization = Literal["backward-euler", "zoh", "sampled-data"]


@dataclass(frozen=True, eq=False)
class Weights:
    """Dimensionless weights with their bases, and the noise of one sample.

    Q = diag(q / q_base^2) and so on; n states, m inputs, p outputs, in the order of the plant's signals.
    """

    q: FloatArray  # n, states
    q_base: FloatArray  # n, SI unit of each state
    r: FloatArray  # m, inputs
    r_base: FloatArray  # m, N
    q_i: FloatArray  # p, integrals of p* - p
    q_i_base: FloatArray  # p, m s
    process_variance: FloatArray  # m, N2, of the forces held over a sample
    sensor_variance: FloatArray  # p, m2, of each sample
    drift_variance: FloatArray = dataclass_field(
        default_factory=lambda: np.zeros(0)
    )  # m, N2: how far a constant force of disturbance goes in a sample; none: the filter observes none

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = readonly(getattr(self, name))
            zero_allowed = name in ("q", "q_i")
            if (
                value.ndim != 1
                or not (np.isfinite(value) & ((value > 0) | (zero_allowed & (value == 0)))).all()
            ):
                wanted = "finite and not negative" if zero_allowed else "finite and above 0"
                raise InputError("Weights", name, str(value.tolist()), f"a vector of numbers, {wanted}")
            object.__setattr__(self, name, value)
        if (
            len(self.q) != len(self.q_base)
            or len(self.r) != len(self.r_base)
            or len(self.q_i) != len(self.q_i_base)
        ):
            raise InputError(
                "Weights", "bases", "another length than the weights'", "one base for each weight"
            )
        with np.errstate(all="ignore"):
            for weight, base in ((self.q, self.q_base), (self.r, self.r_base), (self.q_i, self.q_i_base)):
                size = weight / base**2
                if not (np.isfinite(size) & ((size > 0) | (weight == 0))).all():
                    raise InputError("Weights", "bases", str(base.tolist()), "bases whose square is a number")

    @property
    def Q(self) -> FloatArray:
        """State weight, n x n."""
        return np.diag(self.q / self.q_base**2)

    @property
    def R(self) -> FloatArray:
        """Input weight, m x m, 1/N2."""
        return np.diag(self.r / self.r_base**2)

    @property
    def Q_i(self) -> FloatArray:
        """Weight of the error integrals, p x p, 1/(m s)2."""
        return np.diag(self.q_i / self.q_i_base**2)


@dataclass(frozen=True, eq=False)
class Pid:
    """Gains of a PID controller for each output and the input of the same index."""

    Kp: FloatArray  # m, N/m
    Ki: FloatArray  # m, N/(m s)
    Kd: FloatArray  # m, N s/m
    filter: float  # s, time constant of the measured rate; 0: plain differences

    def __post_init__(self) -> None:
        for name in ("Kp", "Ki", "Kd"):
            value = readonly(getattr(self, name))
            object.__setattr__(self, name, value)
            if value.ndim != 1 or not np.isfinite(value).all() or value.shape != np.shape(self.Kp):
                raise InputError("Pid", name, str(value.tolist()), "finite numbers, one for each input")
        object.__setattr__(self, "filter", float(self.filter))
        if not 0 <= self.filter < math.inf:
            raise InputError("Pid", "filter", f"{self.filter} s", "a time of 0 s or more")


@dataclass(frozen=True)
class Loads:
    """What a PID is judged by: [cost]. White noise, a force's spread over the sample, a sensor's of each reading."""

    load: tuple[float, ...]  # m, N or N m: a constant force from outside on each input, one at a time
    force_noise: tuple[float, ...]  # m, N or N m rms of one sample
    sensor_noise: tuple[float, ...]  # p, m or rad rms of one sample


@dataclass(frozen=True)
class Specification:
    """What a design shall reach; None: not asked for. Bounds from below: margin, bandwidth."""

    margin: float | None = None  # multiples of the box of `uncertainty`, anywhere in the travel
    peak_sensitivity: float | None = None  # of every sensor, on the machine
    bandwidth: float | None = None  # rad/s, by every definition
    radial_motion: float | None = None  # m rms, of the true outputs, from the sensors' noise and steps
    axial_motion: float | None = None  # m rms, of the stroke's
    force_noise: float | None = None  # N rms, commanded bearing forces
    thrust_noise: float | None = None  # N rms, commanded thrust
    tracking_error: float | None = (
        None  # m, largest in the stroke with 5 % too much or too little drive force
    )
    radial_deviation: float | None = None  # m, largest in these strokes
    tilt_deviation: float | None = None  # m, of the sensor plane that a tilt holds
    payload: float | None = None  # kg, picked up and carried through the stroke without touchdown
    lift_off: bool = False  # from rest on the touchdown bearing, by every start-up estimator
    noise_motion: Mapping[str, float] = dataclass_field(
        default_factory=dict
    )  # m or rad rms by output, of a PID's true outputs, from the noise of [cost]


OF_A_PID = ("margin", "peak_sensitivity", "bandwidth", "noise_motion")  # what can be asked of one
SPECIFIED = {  # SI units
    "margin": "1",
    "peak_sensitivity": "1",
    "bandwidth": "rad/s",
    "radial_motion": "m",
    "axial_motion": "m",
    "force_noise": "N",
    "thrust_noise": "N",
    "tracking_error": "m",
    "radial_deviation": "m",
    "tilt_deviation": "m",
    "payload": "kg",
}


class Variable(NamedTuple):
    """A number that the search may choose: entries of the design file that share it."""

    name: str
    entries: tuple[str, ...]  # as "bases.state.x"
    low: float
    high: float
    unit: str  # of low and high, as the file will hold it


@dataclass(frozen=True, eq=False)
class Spec:
    """A design file, read and checked."""

    name: str
    summary: str
    path: Path
    machine_file: Path
    sha256: str  # of everything in the file that shapes the design, published references resolved
    parameters: Parameters
    operating_point: Mapping[str, float]
    sample_time: float  # s
    discretization: Discretization
    delay: int  # samples between measurement and force in the design model
    current_loop_delay: bool  # whether the current loops are designed with the machine's dead time
    law: Weights | Pid  # of an LQG, or the gains of a PID
    uncertainty: Mapping[str, float]  # relative, either way, by parameter
    loads: Loads | None = None  # what a PID is judged by
    specification: Specification = Specification()
    search: tuple[Variable, ...] = ()
    delays: tuple[int, ...] = ()  # that the search may choose from

    @property
    def plant(self) -> Plant:
        """The machine that the controller is designed for."""
        return plant_of(self.parameters)

    @property
    def weights(self) -> Weights:
        """Of an LQG. InputError for a PID, which has none."""
        if isinstance(self.law, Pid):
            raise InputError(self.path, "pid", "a PID controller", "weights, bases and noise of an LQG")
        return self.law

    @property
    def pid(self) -> Pid | None:
        """Gains of a PID; None for an LQG."""
        return self.law if isinstance(self.law, Pid) else None

    def varied(self, values: Sequence[float]) -> Spec:
        """The same with these values (in their own units) of the variables of the search."""
        fields = {name: np.array(getattr(self.law, name)) for name in self.law.__dataclass_fields__}
        for variable, value in zip(self.search, values, strict=True):
            for entry in variable.entries:
                field, index, unit, squared = _place(entry, self.plant, self.path)
                si = value if unit == "1" else to_si(value, variable.unit, unit, self.path, entry)
                fields[field][index] = si * si if squared else si
        law: Any = type(self.law)
        return replace(self, law=law(**fields))

    def value_of(self, variable: Variable) -> float:
        """What the file holds now for a variable of the search, in its unit."""
        field, index, unit, squared = _place(variable.entries[0], self.plant, self.path)
        si = float(np.asarray(getattr(self.law, field))[index])
        si = math.sqrt(si) if squared else si
        return si if unit == "1" else si / to_si(1.0, variable.unit, unit, self.path, variable.name)


def _table_or_SI(value: Any) -> Any:
    if isinstance(value, str) and value != "SI":
        raise ValueError('a table of quantities, or "SI"')
    return None if value == "SI" else value


_Bases = Annotated[dict[StrictStr, Quantity] | None, BeforeValidator(_table_or_SI)]


class _WeightsTable(Record):
    state: dict[StrictStr, Finite]
    input: dict[StrictStr, Finite]
    integral: dict[StrictStr, Finite]


class _BasesTable(Record):
    state: _Bases
    input: _Bases
    integral: _Bases


class _NoiseTable(Record):
    process: dict[StrictStr, Quantity]
    sensor: dict[StrictStr, Quantity]
    drift: dict[StrictStr, Quantity] | None = None


class _PidTable(Record):
    Kp: dict[StrictStr, Quantity]
    Ki: dict[StrictStr, Quantity]
    Kd: dict[StrictStr, Quantity]
    filter: Quantity


class _CostTable(Record):
    load: dict[StrictStr, Quantity]
    force_noise: dict[StrictStr, Quantity] | None = None
    sensor_noise: dict[StrictStr, Quantity] | None = None


class _Range(Record):
    vary: Annotated[list[StrictStr], Field(min_length=1)]
    low: Annotated[Finite, Field(gt=0)]
    high: Annotated[Finite, Field(gt=0)]
    unit: StrictStr = "1"


class _SearchTable(Record):
    delay: list[Annotated[StrictInt, Field(ge=0, le=10)]] = Field(default_factory=list)
    numbers: dict[StrictStr, _Range]


class _SpecificationTable(Record):
    margin: Annotated[Finite, Field(gt=0)] | None = None
    peak_sensitivity: Annotated[Finite, Field(gt=1)] | None = None
    bandwidth: Quantity | None = None
    radial_motion: Quantity | None = None
    axial_motion: Quantity | None = None
    force_noise: Quantity | None = None
    thrust_noise: Quantity | None = None
    tracking_error: Quantity | None = None
    radial_deviation: Quantity | None = None
    tilt_deviation: Quantity | None = None
    payload: Quantity | None = None
    lift_off: StrictBool = False
    noise_motion: dict[StrictStr, Quantity] = Field(default_factory=dict)


class _DesignFile(Record):
    name: Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
    summary: StrictStr
    machine: StrictStr
    preset: StrictStr
    sample_time: Quantity
    discretization: Discretization = "sampled-data"
    delay: Annotated[StrictInt, Field(ge=0, le=10)] = 0
    current_loop_delay: StrictBool
    operating_point: dict[StrictStr, Quantity]
    weights: _WeightsTable | None = None
    bases: _BasesTable | None = None
    noise: _NoiseTable | None = None
    pid: _PidTable | None = None
    uncertainty: dict[StrictStr, Annotated[Finite, Field(gt=0, lt=1)]]
    cost: _CostTable | None = None
    specification: _SpecificationTable | None = None
    search: _SearchTable | None = None


def read_design(path: str | Path) -> Spec:
    """Read a design file as design/table2.toml, and the data of the machine that it names.

    Raises InputError, naming file and field, for anything missing, unknown, of a wrong unit or out of range.
    """
    path = Path(path)
    raw = load_toml(path)
    machine = raw.get("machine")
    if not isinstance(machine, str):
        found = "nothing" if machine is None else repr(machine)
        raise InputError(path, "machine", found, "the path of the machine's data file")
    machine_file = Path(os.path.normpath(path.parent / machine))
    printed = cache(partial(published, machine_file))  # read once, and only where something refers to it
    content = validated(_DesignFile, _resolve(raw, printed, machine_file, path), path)
    _require_law(content, raw, path)
    par = read(machine_file, content.preset)
    try:
        plant = plant_of(par)
    except CheckError as error:
        raise InputError(path, "preset", str(error), "a machine that can be controlled") from error
    for name in content.uncertainty:
        if name not in units_of(par):
            raise InputError(path, f"uncertainty.{name}", "an unknown parameter", ", ".join(units_of(par)))
    shaping = json.dumps(
        content.model_dump(
            exclude={"summary", "machine", "cost", "specification", "search"}, exclude_none=True
        ),
        sort_keys=True,
    )
    Ts = to_si(content.sample_time.value, content.sample_time.unit, "s", path, "sample_time")
    if not Ts > 0:
        raise InputError(path, "sample_time", f"{Ts:g} s", "more than 0 s")
    if content.delay and content.discretization == "backward-euler":
        raise InputError(
            path, "delay", f"{content.delay} with backward-euler, which has none", "0, or zoh or sampled-data"
        )
    try:
        law = _weights(content, plant, path) if content.pid is None else _pid(content.pid, plant, path)
    except InputError as error:  # the record does not know the file
        raise InputError(path, error.field, error.found, error.expected) from error
    spec = Spec(
        name=content.name,
        summary=content.summary,
        path=path,
        machine_file=machine_file,
        sha256=hashlib.sha256(shaping.encode()).hexdigest(),
        parameters=par,
        operating_point=_operating_point(content.operating_point, plant, path),
        sample_time=Ts,
        discretization=content.discretization,
        delay=content.delay,
        current_loop_delay=content.current_loop_delay,
        law=law,
        uncertainty=dict(content.uncertainty),
    )
    return replace(
        spec,
        loads=_loads(content, spec),
        specification=_specification(content, spec),
        **_search(content.search, raw, spec),
    )


LQG = ("discretization", "delay", "weights", "bases", "noise")


def _require_law(content: _DesignFile, raw: Mapping[str, Any], path: Path) -> None:
    """InputError unless the file describes an LQG or a PID, whole and alone."""
    for name in LQG:
        if content.pid is None and name not in raw:
            raise InputError(path, name, "nothing", "this key")
        if content.pid is not None and name in raw:
            raise InputError(path, name, "this key beside [pid]", "one of them: an LQG, or a PID")


def _weights(content: _DesignFile, plant: Plant, path: Path) -> Weights:
    states, inputs, outputs = plant.design_states, plant.inputs, plant.outputs
    integrals = [Signal(s.name, f"{s.unit} s") for s in outputs]
    q, bases, noise = content.weights, content.bases, content.noise
    assert q is not None
    assert bases is not None
    assert noise is not None
    drift = {}
    if noise.drift is not None:
        drift["drift_variance"] = _variances(noise.drift, inputs, path, "noise.drift", "inputs")
    return Weights(
        q=_numbers(q.state, states, path, "weights.state", "states"),
        q_base=_bases(bases.state, states, path, "bases.state", "states"),
        r=_numbers(q.input, inputs, path, "weights.input", "inputs", above=True),
        r_base=_bases(bases.input, inputs, path, "bases.input", "inputs"),
        q_i=_numbers(q.integral, outputs, path, "weights.integral", "measured signals"),
        q_i_base=_bases(bases.integral, integrals, path, "bases.integral", "measured signals"),
        process_variance=_variances(noise.process, inputs, path, "noise.process", "inputs"),
        sensor_variance=_variances(noise.sensor, outputs, path, "noise.sensor", "measured signals"),
        **drift,
    )


def _pid(table: _PidTable, plant: Plant, path: Path) -> Pid:
    gains = {}
    for name, signals in _pid_signals(plant).items():
        entries = _ordered(getattr(table, name), signals, path, f"pid.{name}", "inputs")
        gains[name] = np.array(
            [
                to_si(q.value, q.unit, s.unit, path, f"pid.{name}.{s.name}")
                for q, s in zip(entries, signals, strict=True)
            ]
        )
    return Pid(**gains, filter=to_si(table.filter.value, table.filter.unit, "s", path, "pid.filter"))


def _pid_signals(plant: Plant) -> dict[str, list[Signal]]:
    """The gains of a PID, by input, with their units."""
    pairs = list(zip(plant.inputs, plant.outputs, strict=True))
    return {
        "Kp": [Signal(i.name, f"({i.unit}) / ({o.unit})") for i, o in pairs],
        "Ki": [Signal(i.name, f"({i.unit}) / ({o.unit}) / s") for i, o in pairs],
        "Kd": [Signal(i.name, f"({i.unit}) s / ({o.unit})") for i, o in pairs],
    }


def _loads(content: _DesignFile, spec: Spec) -> Loads | None:
    """What a PID is judged by, in SI. Noise that is not given: none of forces, the machine's own of sensors."""
    table, path, plant, terms = content.cost, spec.path, spec.plant, spec.pid
    if table is None:
        return None
    if terms is None:
        raise InputError(
            path, "cost", "this table without [pid]", "the weights of an LQG, which are its cost"
        )
    for signal, gain in zip(plant.inputs, terms.Ki, strict=True):
        if not gain:
            expected = "an integral gain, as a constant force leaves an error without one"
            raise InputError(path, "cost.load", f"pid.Ki.{signal.name} of 0", expected)
    force: FloatArray = np.zeros(len(plant.inputs))
    if table.force_noise is not None:
        force = _bases(table.force_noise, plant.inputs, path, "cost.force_noise", "inputs")
    sensor: FloatArray = np.sqrt(np.square(plant.noise) + np.square(plant.resolution) / 12)
    if table.sensor_noise is not None:
        sensor = _bases(table.sensor_noise, plant.outputs, path, "cost.sensor_noise", "measured signals")
    load = _bases(table.load, plant.inputs, path, "cost.load", "inputs")
    return Loads(tuple(load.tolist()), tuple(force.tolist()), tuple(sensor.tolist()))


def _specification(content: _DesignFile, spec: Spec) -> Specification:
    """What is asked for, in SI; InputError for what no design could reach or what contradicts itself."""
    table, path = content.specification, spec.path
    if table is None:
        return Specification()
    for name in sorted(table.model_fields_set):
        if spec.pid is not None and name not in OF_A_PID:
            raise InputError(path, f"specification.{name}", "a wish for an LQG", " ".join(OF_A_PID))
        if spec.pid is None and name == "noise_motion":
            raise InputError(path, f"specification.{name}", "a wish for a PID", " ".join(SPECIFIED))
    values: dict[str, float] = {}
    for name, unit in SPECIFIED.items():
        given = getattr(table, name)
        if given is not None:
            field = f"specification.{name}"
            values[name] = (
                to_si(given.value, given.unit, unit, path, field)
                if isinstance(given, Quantity)
                else float(given)
            )
            _positive(values[name], path, field, unit)
    motion = _noise_motion(table.noise_motion, spec)
    if not (values or table.lift_off or motion):
        expected = "at least one of " + " ".join(OF_A_PID if spec.pid else [*SPECIFIED, "lift_off"])
        raise InputError(path, "specification", "nothing to reach", expected)
    found = Specification(**values, lift_off=table.lift_off, noise_motion=motion)
    if found.margin is not None:
        if not spec.uncertainty:
            raise InputError(path, "specification.margin", "no uncertainty in the file", "its parameters")
        widest = max(spec.uncertainty, key=lambda name: spec.uncertainty[name])
        most = 1 / spec.uncertainty[widest]
        if found.margin >= most:
            raise InputError(
                path,
                "specification.margin",
                f"{found.margin:g}",
                f"less than {most:g}, where {widest} is zero",
            )
    if found.bandwidth is not None and found.bandwidth >= math.pi / spec.sample_time:
        nyquist = math.pi / spec.sample_time
        raise InputError(
            path,
            "specification.bandwidth",
            f"{found.bandwidth:g} rad/s",
            f"less than half of sampling, {nyquist:.0f}",
        )
    return found


def _noise_motion(entries: Mapping[str, Quantity], spec: Spec) -> dict[str, float]:
    """Bounds of some outputs, in SI."""
    units = {s.name: s.unit for s in spec.plant.outputs}
    values = {}
    for name, q in entries.items():
        field = f"specification.noise_motion.{name}"
        if name not in units:
            raise InputError(spec.path, field, "an unknown output", "one of " + " ".join(units))
        value = to_si(q.value, q.unit, units[name], spec.path, field)
        values[name] = _positive(value, spec.path, field, units[name])
    return values


def _search(table: _SearchTable | None, raw: Mapping[str, Any], spec: Spec) -> dict[str, Any]:
    """Variables and delays. An entry belongs to one variable, and stands in the file as a number of its own."""
    if table is None:
        return {}
    path, seen, variables = spec.path, set[str](), []
    for name, given in table.numbers.items():
        where = f"search.numbers.{name}"
        for entry in given.vary:
            _, _, unit, _ = _place(entry, spec.plant, path, f"{where}.vary")
            if unit == "1" and given.unit != "1":
                raise InputError(path, f"{where}.unit", repr(given.unit), f"no unit, as {entry} has none")
            if unit != "1":
                to_si(1.0, given.unit, unit, path, where)
            if not _stands(entry, raw):
                expected = "a number of the file itself, not SI or published"
                raise InputError(path, f"{where}.vary", f"{entry}, which is none", expected)
            if entry in seen:
                raise InputError(path, f"{where}.vary", f"{entry} a second time", "each entry once")
            seen.add(entry)
        if not given.low < given.high:
            raise InputError(path, where, f"{given.low:g} to {given.high:g}", "low below high")
        variables.append(Variable(name, tuple(given.vary), given.low, given.high, given.unit))
    if not variables:
        raise InputError(path, "search.numbers", "nothing to vary", "at least one number")
    if table.delay and spec.pid is not None:
        raise InputError(path, "search.delay", str(table.delay), "none, as a PID has no model of a delay")
    if any(table.delay) and spec.discretization == "backward-euler":
        raise InputError(path, "search.delay", str(table.delay), "0 with backward-euler, which has no delay")
    return {"search": tuple(variables), "delays": tuple(dict.fromkeys(table.delay)) or (spec.delay,)}


def _stands(entry: str, raw: Mapping[str, Any]) -> bool:
    node: Any = raw
    for key in entry.split("."):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node is not None and (not isinstance(node, Mapping) or "value" in node)


def _place(
    entry: str, plant: Plant, where: Path, field: str = "search"
) -> tuple[str, int | tuple[()], str, bool]:
    """Where an entry of the design file stands in Weights or Pid: field, index, SI unit, whether as its square."""
    integrals = [Signal(s.name, f"{s.unit} s") for s in plant.outputs]
    plain = [Signal(s.name, "1") for s in plant.design_states + plant.inputs + plant.outputs]
    tables: dict[str, tuple[str, Sequence[Signal], bool]] = {
        "bases.state": ("q_base", plant.design_states, False),
        "bases.input": ("r_base", plant.inputs, False),
        "bases.integral": ("q_i_base", integrals, False),
        "noise.process": ("process_variance", plant.inputs, True),
        "noise.sensor": ("sensor_variance", plant.outputs, True),
        "weights.state": ("q", plain[: len(plant.design_states)], False),
        "weights.input": ("r", plain[len(plant.design_states) :][: len(plant.inputs)], False),
        "weights.integral": ("q_i", plain[-len(plant.outputs) :], False),
        "noise.drift": ("drift_variance", plant.inputs, True),
    }
    tables |= {f"pid.{name}": (name, signals, False) for name, signals in _pid_signals(plant).items()}
    if entry == "pid.filter":
        return "filter", (), "s", False
    table, _, name = entry.rpartition(".")
    if table not in tables:
        raise InputError(where, field, repr(entry), "an entry as bases.state.x: " + " ".join(tables))
    weight, signals, squared = tables[table]
    names = [s.name for s in signals]
    if name not in names:
        raise InputError(where, field, repr(entry), f"one of {table}: {' '.join(names)}")
    index = names.index(name)
    return weight, index, signals[index].unit, squared


def _resolve(
    node: Any, printed: Callable[[], dict[str, Any]], machine_file: Path, where: Path, field: str = ""
) -> Any:
    """Put the published numbers in the place of every `{ published = "..." }`."""
    if isinstance(node, dict):
        if set(node) == {"published"}:
            found: Any = printed()
            for key in str(node["published"]).split("."):
                if not isinstance(found, dict) or key not in found:
                    source = machine_file.parent / "published" / machine_file.name
                    raise InputError(where, field, repr(node["published"]), f"a table of {source}")
                found = found[key]
            return found
        return {
            k: _resolve(v, printed, machine_file, where, f"{field}.{k}".lstrip(".")) for k, v in node.items()
        }
    return node


def _ordered(
    entries: Mapping[str, Any], signals: Sequence[Signal], where: Path, field: str, what: str
) -> list[Any]:
    """The entries in the order of the signals, one for each."""
    names = [s.name for s in signals]
    if set(entries) != set(names):
        raise InputError(
            where,
            field,
            f"{len(entries)} entries ({' '.join(entries)})",
            f"one for each of the {len(names)} {what} ({' '.join(names)})",
        )
    return [entries[name] for name in names]


def _numbers(
    entries: Mapping[str, float],
    signals: Sequence[Signal],
    where: Path,
    field: str,
    what: str,
    *,
    above: bool = False,
) -> FloatArray:
    values = _ordered(entries, signals, where, field, what)
    for signal, value in zip(signals, values, strict=True):
        if value < 0 or (above and value == 0):
            wanted = "a number above 0" if above else "a number of at least 0"
            raise InputError(where, f"{field}.{signal.name}", f"{value:g}", wanted)
    return np.array(values, dtype=float)


def _bases(
    entries: Mapping[str, Quantity] | None, signals: Sequence[Signal], where: Path, field: str, what: str
) -> FloatArray:
    """Bases by name; one SI unit each where the file says "SI"."""
    if entries is None:
        return np.ones(len(signals))
    return np.array(
        [
            _positive(
                to_si(q.value, q.unit, s.unit, where, f"{field}.{s.name}"), where, f"{field}.{s.name}", s.unit
            )
            for q, s in zip(_ordered(entries, signals, where, field, what), signals, strict=True)
        ]
    )


def _variances(
    entries: Mapping[str, Quantity], signals: Sequence[Signal], where: Path, field: str, what: str
) -> FloatArray:
    """Variances: given as such (unit squared), or as standard deviations (the signal's unit)."""
    variances = []
    for q, s in zip(_ordered(entries, signals, where, field, what), signals, strict=True):
        name = f"{field}.{s.name}"
        try:
            deviation = _positive(to_si(q.value, q.unit, s.unit, where, name), where, name, s.unit)
            variances.append(_positive(deviation * deviation, where, name, f"({s.unit})^2"))
        except InputError as error:
            if not error.field.endswith(".unit"):
                raise
            squared = f"({s.unit})^2"
            try:
                variance = to_si(q.value, q.unit, squared, where, name)
            except InputError:
                expected = f"a unit of {s.unit} (standard deviation) or {s.unit}^2 (variance)"
                raise InputError(where, f"{name}.unit", repr(q.unit), expected) from None
            variances.append(_positive(variance, where, name, squared))
    return np.array(variances)


def _positive(value: float, where: Path, field: str, unit: str) -> float:
    if not 0 < value < math.inf:
        raise InputError(where, field, f"{value:g} {unit}", f"a finite number above 0 {unit}")
    return value


def _operating_point(entries: Mapping[str, Quantity], plant: Plant, where: Path) -> dict[str, float]:
    """Along the stroke only: elsewhere v0(z) knows no equilibrium."""
    units = {s.name: s.unit for s in plant.design_states if s.name == plant.stroke}
    values = {}
    for name, q in entries.items():
        if name not in units:
            raise InputError(
                where, f"operating_point.{name}", "another state", f"{plant.stroke}, the stroke, alone"
            )
        values[name] = to_si(q.value, q.unit, units[name], where, f"operating_point.{name}")
        if not math.isfinite(values[name]):
            raise InputError(where, f"operating_point.{name}", str(values[name]), "a finite number")
    return values
