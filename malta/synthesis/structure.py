"""[structure] and [goals] of a design file: a law of named elements, with the numbers at which a search starts.

[structure.law]                                # by sensor, or by coordinate: elements, one behind the other
x1 = ["radial", "roll_off"]
y1 = ["radial", "roll_off"]                    # one element in several places has its numbers once

[structure.elements.radial]
kind = "pid"
Kp = { value = 98, unit = "N/mm" }
Kd = { value = 111, unit = "N s/m" }
filter = { value = 0.12, unit = "ms" }
low = { filter = { value = 0.05, unit = "ms" } }

[goals.stiffness]                              # beside [specification]; soft ones are made small
kind = "gain_limit"
inputs = ["load fx_B1"]
outputs = ["output x1"]
limit = { value = 30, unit = "um/N" }
soft = true
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.model.linearize import LinearModel
from malta.model.plant import Plant
from malta.synthesis import elements
from malta.synthesis.controller import Controller
from malta.synthesis.design_tables import ElementTable, GoalTable, StructureTable
from malta.synthesis.elements import Element, Place, Structure, sample_law
from malta.synthesis.pid import axes_of
from malta.synthesis.spec import PidAxes, StructuredElement, StructuredGoal, StructuredLaw, pid_signals
from malta.synthesis.state_space import law_of_errors
from malta.tables import Quantity
from malta.units import to_si

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

OF_INPUTS = ("reference", "load", "disturbance")
OF_OUTPUTS = ("error", "output", "force", "acting")


class Kind(NamedTuple):
    """A kind of elements or goals: its entries, those that have to stand, and their units."""

    units: Mapping[str, str]  # "axis": of the axis' gain; "signals": of outputs over inputs; "": no number
    required: tuple[str, ...]


ELEMENTS = {
    "gain": Kind({"value": "Kp"}, ("value",)),
    "pid": Kind({"Kp": "Kp", "Ki": "Ki", "Kd": "Kd", "filter": "s"}, ("Kp",)),
    "lead": Kind({"zero": "rad/s", "pole": "rad/s"}, ("zero", "pole")),
    "notch": Kind({"frequency": "rad/s", "depth": "1", "damping": "1"}, ("frequency", "depth", "damping")),
    "transfer": Kind({"numerator": "", "denominator": ""}, ("numerator", "denominator")),
}
SENSORS = {"at": "", "channels": ""}
POLES = {"decay": "1/s", "damping": "1", "fastest": "rad/s"}
GOALS = {
    "sensitivity": Kind({"peak": "1", **SENSORS}, ("peak",)),
    "disk_margin": Kind({"least": "1", **SENSORS}, ("least",)),
    "gain_limit": Kind(
        {"inputs": "", "outputs": "", "limit": "signals", "weight": ""}, ("inputs", "outputs", "limit")
    ),
    "noise_limit": Kind({"levels": "", "outputs": "", "limit": "outputs"}, ("outputs", "limit")),
    "tracking": Kind({"time": "s", "peak": "1", "steady": "1", "channels": ""}, ("time",)),
    "poles": Kind(POLES, ()),
    "stable_law": Kind(POLES, ()),
}
PLAIN = {"Kp": "1", "Ki": "1/s", "Kd": "s"}  # of an element behind one that has the axis' unit
DIMENSIONED = ("gain", "pid", "transfer")


@dataclass(frozen=True)
class _Where:
    """A file, and a table in it."""

    path: Path
    field: str

    def refuse(self, key: str, found: str, expected: str) -> InputError:
        return InputError(self.path, f"{self.field}.{key}".rstrip("."), found, expected)


def read_structure(
    table: StructureTable, goals: Mapping[str, GoalTable], plant: Plant, Ts: float, path: Path
) -> StructuredLaw:
    """Read the law of a design file and its goals.

    Raises InputError for axes that the machine does not have, elements that are not there or in no place, other units,
    signals that no loop has, and notches that no law of this sample time has.
    """
    axes = table.axes or "decentralized"
    units = dict(_units_by_axis(plant, axes))
    law: dict[str, tuple[str, ...]] = {}
    found: dict[str, StructuredElement] = {}
    for axis, names in table.law.items():
        where = _Where(path, "structure.law")
        if axis not in units:
            raise where.refuse(axis, "an unknown axis", "one of " + " ".join(units))
        twice = next((n for n in names if names.count(n) > 1), None)
        if twice is not None or not names:
            raise where.refuse(axis, repr(twice) + " twice" if twice else "no element", "elements, each once")
        own = units[axis]
        for name in names:
            if name not in table.elements:
                raise where.refuse(axis, repr(name), "one of " + " ".join(table.elements))
            one = table.elements[name]
            element = _element(name, one, own, Ts, _Where(path, f"structure.elements.{name}"))
            if found.setdefault(name, element) != element:
                raise where.refuse(axis, f"{name} of another unit", "axes of one unit for one element")
            own = PLAIN if one.kind in DIMENSIONED else own
        law[axis] = tuple(names)
    idle = next((name for name in table.elements if name not in found), None)
    if idle is not None:
        raise InputError(
            path, f"structure.elements.{idle}", "an element in no place", "its name in [structure.law]"
        )
    read = tuple(_goal(name, one, plant, _Where(path, f"goals.{name}")) for name, one in goals.items())
    return StructuredLaw(law, tuple(found.values()), read, axes)


def _units_by_axis(plant: Plant, axes: PidAxes) -> Iterator[tuple[str, Mapping[str, str]]]:
    """The units of a PID's gains by axis: a sensor, or a coordinate."""
    gains = pid_signals(plant, axes)
    for k, signal in enumerate(gains["Kp"]):
        name = plant.outputs[k].name if axes == "decentralized" else signal.name
        yield name, {key: gains[key][k].unit for key in PLAIN}


def _entries(table: Any, kind: Kind, where: _Where) -> Iterator[tuple[str, Any, str]]:
    """The entries that a table has, with their units. Raises InputError for those of other kinds, and missing ones."""
    for key in type(table).model_fields:
        value = getattr(table, key)
        if key in ("kind", "low", "high", "soft") or (value is None and key not in kind.required):
            continue
        if value is None:
            raise where.refuse(key, "nothing", f"this key of a {table.kind}")
        if key not in kind.units:
            raise where.refuse(key, f"a key that a {table.kind} lacks", "one of " + " ".join(kind.units))
        yield key, value, kind.units[key]


def _si(value: Any, unit: str, where: _Where, key: str) -> float:
    """A number in SI. Raises InputError for a number without its unit."""
    if isinstance(value, Quantity):
        return to_si(value.value, value.unit, unit, where.path, f"{where.field}.{key}")
    if unit != "1":
        raise where.refuse(key, f"{value}", f'a table with its unit, as {{ value = 1, unit = "{unit}" }}')
    return float(value)


def _element(
    name: str, table: ElementTable, axis: Mapping[str, str], Ts: float, where: _Where
) -> StructuredElement:
    kind = ELEMENTS[table.kind]
    numbers: dict[str, Any] = {}
    units: dict[str, str] = {}
    for key, value, unit in _entries(table, kind, where):
        units[key] = axis.get(unit, unit)
        numbers[key] = _si(value, units[key], where, key) if unit else tuple(value)
    bounds: dict[str, tuple[float, float]] = {}
    for side, table_of in enumerate((table.low, table.high)):
        for key, value in table_of.items():
            if key not in numbers or not kind.units[key]:
                able = [k for k in numbers if kind.units[k]]
                raise where.refuse(
                    f"{('low', 'high')[side]}.{key}", "an unknown number", "one of " + " ".join(able)
                )
            ends = list(bounds.get(key, (-math.inf, math.inf)))
            ends[side] = _si(value, units[key], where, f"{('low', 'high')[side]}.{key}")
            bounds[key] = (ends[0], ends[1])
    nyquist = math.pi / Ts
    if table.kind == "notch" and numbers["frequency"] >= nyquist:
        found = f"{numbers['frequency']:g} rad/s"
        raise where.refuse(
            "frequency", found, f"less than half of sampling, {nyquist:.0f} rad/s: no sampled law has more"
        )
    made = StructuredElement(name, table.kind, numbers, units, bounds)
    try:
        make_element(made)
    except InputError as error:  # the element does not know the file
        raise where.refuse(error.field.partition(".")[2], error.found, error.expected) from error
    return made


def _goal(name: str, table: GoalTable, plant: Plant, where: _Where) -> StructuredGoal:
    """A goal with its numbers in SI."""
    arguments: dict[str, Any] = {}
    for key, value, unit in _entries(table, GOALS[table.kind], where):
        if unit in ("signals", "outputs"):
            of = _unit_of(table.outputs or [], OF_OUTPUTS, plant, where, "outputs")
            over = (
                _unit_of(table.inputs or [], OF_INPUTS, plant, where, "inputs") if unit == "signals" else "1"
            )
            arguments[key] = _si(value, of if over == "1" else f"({of}) / ({over})", where, key)
        elif key == "levels":
            arguments[key] = {
                s: _si(q, _unit_of([s], OF_INPUTS, plant, where, key), where, f"{key}.{s}")
                for s, q in value.items()
            }
        elif key == "weight":
            arguments[key] = (tuple(value.numerator), tuple(value.denominator))
        elif key == "channels":
            _require_known(value, [s.name for s in (*plant.outputs, *plant.inputs)], where, key)
            arguments[key] = tuple(value)
        else:
            arguments[key] = (
                _si(value, unit, where, key) if unit else (value if isinstance(value, str) else tuple(value))
            )
    return StructuredGoal(name, table.kind, table.soft, arguments)


def _unit_of(signals: Sequence[str], kinds: Sequence[str], plant: Plant, where: _Where, key: str) -> str:
    """The unit that these signals of a loop share. Raises InputError for unknown ones, and for several units."""
    of = {"disturbance": plant.disturbances}
    known = {
        f"{kind} {s.name}": s.unit
        for kind in kinds
        for s in of.get(kind, plant.inputs if kind in ("load", "force", "acting") else plant.outputs)
    }
    units = set()
    for signal in signals:
        own = [unit for name, unit in known.items() if name == signal or name.partition(" ")[0] == signal]
        _require_known([signal] if not own else [], list(known), where, key)
        units |= set(own)
    if len(units) != 1:
        raise where.refuse(
            key, f"signals in {' and '.join(sorted(units))}" if units else "none", "signals of one unit"
        )
    return units.pop()


def _require_known(names: Sequence[str], known: Sequence[str], where: _Where, key: str) -> None:
    unknown = next((name for name in names if name not in known), None)
    if unknown is not None:
        raise where.refuse(key, repr(unknown), "one of " + ", ".join(known))


# The law as elements in their places, and as a controller.


def make_element(given: StructuredElement) -> Element:
    """Make the element of a design file. Raises InputError for numbers that it cannot have."""
    bounds = {"bounds": dict(given.bounds)} if given.bounds else {}
    made: Element = getattr(elements, given.kind)(given.name, **given.numbers, **bounds)
    return made


def places_in(law: StructuredLaw, model: LinearModel) -> tuple[Place, ...]:
    """The elements of a design file in their places on a machine."""
    axes = axes_of(model, law.axes)
    own = {one.name: make_element(one) for one in law.elements}
    products: dict[tuple[str, ...], Element] = {}  # of the same elements: one product, with its numbers once
    names = [name for name, _ in _units_by_axis(model.plant, law.axes)]
    found = []
    for axis, series in law.law.items():
        if series not in products:
            product = own[series[0]]
            for name in series[1:]:
                product = product * own[name]
            products[series] = product
        k = names.index(axis)
        found.append(Place(axes.inputs[:, [k]], products[series], axes.of_outputs[[k]]))
    return tuple(found)


def with_values(law: StructuredLaw, values: Mapping[str, float]) -> StructuredLaw:
    """The same law with other numbers, by "element.parameter"."""
    changed = []
    for one in law.elements:
        made = make_element(one).at(values).values
        new: dict[str, Any] = {key.partition(".")[2]: value for key, value in made.items()}
        if one.kind == "transfer":
            n = len(one.numbers["denominator"]) - 1
            new = {
                "numerator": tuple(new[f"b{k}"] for k in range(n, -1, -1)),
                "denominator": (1.0, *(new[f"a{k}"] for k in range(n - 1, -1, -1))),
            }
        changed.append(replace(one, numbers=new))
    return replace(law, elements=tuple(changed))


def structured_controller(
    model: LinearModel, law: StructuredLaw, Ts: float, *, name: str, position_feedforward: bool = False
) -> Controller:
    """The law of errors with the numbers of the design file, sampled by Tustin's rule.

    Raises InputError for a pole at 2 / Ts.
    """
    places = places_in(law, model)
    structure = Structure(places)
    x: FloatArray = np.zeros(len(structure.parameters))
    labels = [
        f"{axis}_{k + 1}"
        for axis, place in zip(law.law, places, strict=True)
        for k in range(place.element.order)
    ]
    sampled = sample_law(structure.system(x), Ts)
    return law_of_errors(sampled, labels, model, Ts, name=name, position_feedforward=position_feedforward)
