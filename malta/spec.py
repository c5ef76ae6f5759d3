"""Design files: what a controller is asked to be. design/NAME.toml -> read_design() -> Spec.

Weights are dimensionless and stand on explicit bases (Bryson's rule): Q = diag(q / base^2). Noise is given as the
standard deviation or the variance of one sample. Wherever numbers are expected, `{ published = "table_II.state" }`
stands for what the machine's paper prints under that name in data/published/.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, StrictBool, StrictInt, StrictStr

from malta.data import (
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
from malta.errors import InputError
from malta.plant import Plant, Signal, readonly

if TYPE_CHECKING:
    from malta.plant import FloatArray, Parameters

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
    weights: Weights
    uncertainty: Mapping[str, float]  # relative, either way, by parameter

    @property
    def plant(self) -> Plant:
        """The machine that the controller is designed for."""
        return plant_of(self.parameters)


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


class _DesignFile(Record):
    name: Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
    summary: StrictStr
    machine: StrictStr
    preset: StrictStr
    sample_time: Quantity
    discretization: Discretization
    delay: Annotated[StrictInt, Field(ge=0, le=10)]
    current_loop_delay: StrictBool
    operating_point: dict[StrictStr, Quantity]
    weights: _WeightsTable
    bases: _BasesTable
    noise: _NoiseTable
    uncertainty: dict[StrictStr, Annotated[Finite, Field(gt=0, lt=1)]]


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
    par = read(machine_file, content.preset)
    plant = plant_of(par)
    states, inputs, outputs = plant.design_states, plant.inputs, plant.outputs
    integrals = [Signal(s.name, f"{s.unit} s") for s in outputs]
    q, bases, noise = content.weights, content.bases, content.noise
    for name in content.uncertainty:
        if name not in units_of(par):
            raise InputError(path, f"uncertainty.{name}", "an unknown parameter", ", ".join(units_of(par)))
    shaping = json.dumps(content.model_dump(exclude={"summary", "machine"}), sort_keys=True)
    Ts = to_si(content.sample_time.value, content.sample_time.unit, "s", path, "sample_time")
    if not Ts > 0:
        raise InputError(path, "sample_time", f"{Ts:g} s", "more than 0 s")
    if content.delay and content.discretization == "backward-euler":
        raise InputError(
            path, "delay", f"{content.delay} with backward-euler, which has none", "0, or zoh or sampled-data"
        )
    try:
        weights = Weights(
            q=_numbers(q.state, states, path, "weights.state", "states"),
            q_base=_bases(bases.state, states, path, "bases.state", "states"),
            r=_numbers(q.input, inputs, path, "weights.input", "inputs", above=True),
            r_base=_bases(bases.input, inputs, path, "bases.input", "inputs"),
            q_i=_numbers(q.integral, outputs, path, "weights.integral", "measured signals"),
            q_i_base=_bases(bases.integral, integrals, path, "bases.integral", "measured signals"),
            process_variance=_variances(noise.process, inputs, path, "noise.process", "inputs"),
            sensor_variance=_variances(noise.sensor, outputs, path, "noise.sensor", "measured signals"),
        )
    except InputError as error:  # the record does not know the file
        raise InputError(path, error.field, error.found, error.expected) from error
    return Spec(
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
        weights=weights,
        uncertainty=dict(content.uncertainty),
    )


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
    """Along the stroke only: elsewhere the attraction leaves no equilibrium that v0(z) could hold."""
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
