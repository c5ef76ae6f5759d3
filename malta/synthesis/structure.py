"""[structure] and [goals] of a design file: a law of named elements, with the numbers at which a search starts.

[structure.law]                                # by sensor, or by coordinate: elements, one behind the other
x1 = ["radial", "roll_off"]
y1 = ["radial", "roll_off"]                    # one element in several places has its numbers once
all = ["regulator"]                            # an LQG, of all errors

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

Where the elements of a law stand between errors and forces, and the law as a function of their numbers.

    v = K(s) (p* - y),    K = sum of L_k E_k(s) R_k        E_k: an element; R_k: what of the errors it takes,
                                                           L_k: the forces that it acts with

A law of errors is sampled by Tustin's rule, as malta.synthesis.controller_of recommends: with
z = (1 + s T/2) / (1 - s T/2) it has the same matrices in s as the continuous law.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.linear.system import System
from malta.model.linearize import LinearModel
from malta.model.plant import Plant, Signal
from malta.synthesis import elements
from malta.synthesis.controller import Controller
from malta.synthesis.design_tables import ElementTable, GoalTable, StructureTable
from malta.synthesis.elements import CALLER, Element, Parameter, Solve, keep_sign, side_by_side
from malta.synthesis.pid import axes_of
from malta.synthesis.spec import PidAxes, StructuredElement, StructuredGoal, StructuredLaw, pid_signals
from malta.synthesis.state_space import law_of_errors
from malta.synthesis.tunable_lqg import lqg
from malta.synthesis.weighting import Weights, weights
from malta.tables import Quantity
from malta.units import to_si


class Place(NamedTuple):
    """Where an element stands: forces = left E (right errors).

    left : m x outputs of the element
    element : E
    right : inputs of the element x p

    >>> from malta import structured
    >>> axis = structured.gain("axis", 2e3)
    >>> structured.Place([[1.0], [1.0]], axis, [[0.5, 0.5]]).element.order  # of two
    0
    """

    left: FloatArray
    element: Element
    right: FloatArray


Layout = Mapping[str, Element] | Element | Sequence[Place]


def places_of(layout: Any, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[Place, ...]:
    """The places of a layout.

    layout : elements by the outputs whose errors they take, for the input of the same index; one element from all
        errors to all forces; or places, as of the coordinates of the centre of gravity

    Raises InputError for outputs that the machine does not have, for other shapes, and for two elements of one name.
    """
    m, p = len(inputs), len(outputs)
    if isinstance(layout, Element):
        found: tuple[Place, ...] = (Place(np.eye(m), layout, np.eye(p)),)
    elif isinstance(layout, Mapping):
        unknown = next((name for name in layout if name not in outputs), None)
        if unknown is not None or m != p:
            expected = (
                "one of " + " ".join(outputs)
                if m == p
                else "an element or places, where inputs are no outputs"
            )
            raise InputError(
                CALLER, "law", f"an element of {unknown}" if unknown else "elements by output", expected
            )
        one = np.eye(p)
        found = tuple(
            Place(one[:, [k]], layout[name], one[[k]]) for k, name in enumerate(outputs) if name in layout
        )
    else:
        found = tuple(Place(np.asarray(a, dtype=float), e, np.asarray(b, dtype=float)) for a, e, b in layout)
    known: dict[str, Element] = {}
    for left, element, right in found:
        if known.setdefault(element.name, element) is not element:
            raise InputError(CALLER, element.name, "two elements of one name", "names that tell them apart")
        rows, columns = element.system.D.shape
        if left.shape != (m, rows) or right.shape != (columns, p):
            shape = f"{left.shape}, {rows} x {columns}, {right.shape}"
            raise InputError(CALLER, element.name, shape, f"a product of {m} forces x {p} errors")
    if not found:
        raise InputError(CALLER, "law", "no element", "one at least")
    return found


@dataclass(frozen=True, eq=False)
class Structure:
    """A law of elements in their places, as a function of the numbers x of its parameters.

    x : parameters of all elements, an element in several places once; 0 is where the search starts
    """

    places: tuple[Place, ...]

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """Each element once, in the order of its first place."""
        return tuple({place.element.name: place.element for place in self.places}.values())

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters of all elements."""
        return tuple(p for e in self.elements for p in e.parameters)

    @cached_property
    def bounds(self) -> FloatArray:
        """The bounds of x, parameters x 2."""
        return np.array([p.bounds for p in self.parameters]).reshape(-1, 2)

    @cached_property
    def order(self) -> int:
        """The number of states of the whole law."""
        return sum(place.element.order for place in self.places)

    @cached_property
    def _theta(self) -> ca.Function:
        """What the elements solve -> [D C; B A], and its derivative by that."""
        numbers = ca.SX.sym("numbers", sum(len(e.numbers) for e in self.elements))
        first, made = 0, {}
        for e in self.elements:
            own = [numbers[first + k] for k in range(len(e.numbers))]
            made[e.name] = [ca.SX(M) for M in e.matrices(own)]
            first += len(own)
        (m, _), (_, p) = self.places[0].left.shape, self.places[0].right.shape
        D, A, B, C = ca.SX(m, p), list[Any](), list[Any](), list[Any]()
        for left, element, right in self.places:
            a, b, c, d = made[element.name]
            D = D + left @ d @ right
            A, B, C = [*A, a], [*B, b @ right], [*C, left @ c]
        theta = ca.densify(system_matrix(D, ca.horzcat(*C), ca.vertcat(*B), ca.diagcat(*A)))
        return ca.Function("theta", [numbers], [theta, ca.jacobian(theta, numbers)])

    @cached_property
    def _solve(self) -> Solve:
        return side_by_side(*self.elements)

    def theta(self, x: FloatArray) -> tuple[FloatArray, Any]:
        """[D C; B A] of the continuous law at x, and its derivative by x: entries, column by column, x parameters.

        Raises CheckError where an LQG has no solution.
        """
        pairs = list(zip(self.parameters, x.tolist(), strict=True))
        numbers, by_value = self._solve(np.array([p.value(one) for p, one in pairs]))
        theta, slope = self._theta(numbers)
        by_x = by_value * np.array([p.slope(one) for p, one in pairs])
        return np.array(theta), slope.sparse() @ by_x

    def system(self, x: FloatArray) -> System:
        """The continuous law at x."""
        theta, _ = self.theta(x)
        (m, _), (_, p) = self.places[0].left.shape, self.places[0].right.shape
        return System(theta[m:, p:], theta[m:, :p], theta[:m, p:], theta[:m, :p])

    def at(self, x: FloatArray) -> Structure:
        """The same structure with the values at x as its present ones."""
        values: dict[str, float] = {}
        first = 0
        for e in self.elements:
            k = len(e.parameters)
            own = x[first : first + k].tolist()
            numbers = (p.value(v) for p, v in zip(e.parameters, own, strict=True))
            values |= dict(zip(e.values, numbers, strict=True))
            first += k
        new = {e.name: e.at(values) for e in self.elements}
        return Structure(tuple(Place(p.left, new[p.element.name], p.right) for p in self.places))


def sample_law(law: System, Ts: float) -> System:
    """Sample a continuous law by Tustin's rule: s+ = A s + B e, v = C s + D e.

    Raises InputError for a law with a pole at 2 / Ts.
    """
    one, half = np.eye(len(law.A)), law.A * Ts / 2
    if not len(one):
        return replace(law, dt=Ts)
    if np.abs(np.linalg.eigvals(one - half)).min() < 1e-12:
        raise InputError(CALLER, "law", "a pole at 2 / Ts", "poles that a sampled law can have")
    back = linalg.inv(one - half)
    D = law.D + law.C @ back @ law.B * Ts / 2
    return System(back @ (one + half), back @ law.B * Ts, law.C @ back, D, None, Ts)


INPUT_CHANNELS = ("reference", "load", "disturbance")
OUTPUT_CHANNELS = ("error", "output", "force", "acting")


class ElementKind(NamedTuple):
    """A kind of elements or goals: its entries, those that have to stand, and their units."""

    units: Mapping[str, str]  # "axis": of the axis' gain; "signals": of outputs over inputs; "": no number
    required: tuple[str, ...]


WHOLE_TABLES = ("input", "process", "sensor")  # tables of an LQG with an entry of every signal
ELEMENTS = {
    "gain": ElementKind({"value": "Kp"}, ("value",)),
    "pid": ElementKind({"Kp": "Kp", "Ki": "Ki", "Kd": "Kd", "filter": "s"}, ("Kp",)),
    "lead": ElementKind({"zero": "rad/s", "pole": "rad/s"}, ("zero", "pole")),
    "notch": ElementKind(
        {"frequency": "rad/s", "depth": "1", "damping": "1"}, ("frequency", "depth", "damping")
    ),
    "transfer": ElementKind({"numerator": "", "denominator": ""}, ("numerator", "denominator")),
    "lqg": ElementKind(
        dict.fromkeys(("state", "integral", "input", "process", "sensor"), "by signal"), WHOLE_TABLES
    ),
}
ALL_AXES = "all"  # in place of an axis: all errors, to all inputs
SENSORS = {"at": "", "channels": ""}
POLES = {"decay": "1/s", "damping": "1", "fastest": "rad/s"}
GOALS = {
    "sensitivity": ElementKind({"peak": "1", **SENSORS}, ("peak",)),
    "disk_margin": ElementKind({"least": "1", **SENSORS}, ("least",)),
    "gain_limit": ElementKind(
        {"inputs": "", "outputs": "", "limit": "signals", "weight": ""}, ("inputs", "outputs", "limit")
    ),
    "noise_limit": ElementKind({"levels": "", "outputs": "", "limit": "outputs"}, ("outputs", "limit")),
    "tracking": ElementKind({"time": "s", "peak": "1", "steady": "1", "channels": ""}, ("time",)),
    "poles": ElementKind(POLES, ()),
    "stable_law": ElementKind(POLES, ()),
}
PLAIN_UNITS = {"Kp": "1", "Ki": "1/s", "Kd": "s"}  # of an element behind one that has the axis' unit
DIMENSIONED_ELEMENTS = ("gain", "pid", "transfer")


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
    units = {ALL_AXES: _units_of_lqg(plant)} | (
        dict(_units_by_axis(plant, axes)) if any(axis != ALL_AXES for axis in table.law) else {}
    )
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
            if (one.kind == "lqg") != (axis == ALL_AXES) or (axis == ALL_AXES and len(names) > 1):
                found_here = f"{' '.join(names)} with a {one.kind}"
                raise where.refuse(
                    axis, found_here, f"one lqg under {ALL_AXES}, other elements under an axis"
                )
            element = _element(name, one, own, Ts, _Where(path, f"structure.elements.{name}"))
            if found.setdefault(name, element) != element:
                raise where.refuse(axis, f"{name} of another unit", "axes of one unit for one element")
            own = PLAIN_UNITS if one.kind in DIMENSIONED_ELEMENTS else own
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
        yield name, {key: gains[key][k].unit for key in PLAIN_UNITS}


def _units_of_lqg(plant: Plant) -> Mapping[str, str]:
    """The units of an LQG's sizes and standard deviations: by "state.x" and so on."""
    sums = [Signal(s.name, f"{s.unit} s") for s in plant.outputs]
    tables = {
        "state": plant.design_states, "integral": sums, "input": plant.inputs,
        "process": plant.inputs, "sensor": plant.outputs,
    }  # fmt: skip
    return {f"{table}.{s.name}": s.unit for table, signals in tables.items() for s in signals}


def _entries(table: Any, kind: ElementKind, where: _Where) -> Iterator[tuple[str, Any, str]]:
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
        if unit == "by signal":
            units |= axis
            numbers |= _sizes(key, value, axis, where)
            continue
        units[key] = axis.get(unit, unit)
        numbers[key] = _si(value, units[key], where, key) if unit else tuple(value)
    bounds: dict[str, tuple[float, float]] = {}
    for side, table_of in enumerate((table.low, table.high)):
        for key, value in table_of.items():
            able = [k for k, number in numbers.items() if isinstance(number, float)]
            if key not in able:
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
        if table.kind == "lqg":  # made on a model, later
            keep_sign(name, bounds, **numbers)
        else:
            make_element(made)
    except InputError as error:  # the element does not know the file
        raise where.refuse(error.field.partition(".")[2], error.found, error.expected) from error
    return made


def _sizes(
    key: str, table: Mapping[str, Quantity], units: Mapping[str, str], where: _Where
) -> dict[str, float]:
    """A table of an LQG's numbers, SI. Raises InputError for unknown signals, missing ones, and numbers not above 0."""
    known = [name.partition(".")[2] for name in units if name.startswith(f"{key}.")]
    _require_known(list(table), known, where, key)
    missing = next((name for name in known if name not in table), None)
    if missing is not None and key in WHOLE_TABLES:
        raise where.refuse(key, f"no {missing}", "an entry of " + " ".join(known))
    found = {
        f"{key}.{name}": _si(q, units[f"{key}.{name}"], where, f"{key}.{name}") for name, q in table.items()
    }
    low = next((name for name, value in found.items() if not value > 0), None)
    if low is not None:
        raise where.refuse(low, f"{found[low]:g} {units[low]}", "more than 0; leave out what has no weight")
    return found


def _goal(name: str, table: GoalTable, plant: Plant, where: _Where) -> StructuredGoal:
    """A goal with its numbers in SI."""
    arguments: dict[str, Any] = {}
    for key, value, unit in _entries(table, GOALS[table.kind], where):
        if unit in ("signals", "outputs"):
            of = _unit_of(table.outputs or [], OUTPUT_CHANNELS, plant, where, "outputs")
            over = (
                _unit_of(table.inputs or [], INPUT_CHANNELS, plant, where, "inputs")
                if unit == "signals"
                else "1"
            )
            arguments[key] = _si(value, of if over == "1" else f"({of}) / ({over})", where, key)
        elif key == "levels":
            arguments[key] = {
                s: _si(q, _unit_of([s], INPUT_CHANNELS, plant, where, key), where, f"{key}.{s}")
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


def make_element(given: StructuredElement, model: LinearModel | None = None) -> Element:
    """Make the element of a design file. Raises InputError for numbers that it cannot have.

    model : that an LQG is designed for
    """
    bounds = {"bounds": dict(given.bounds)} if given.bounds else {}
    if given.kind == "lqg":
        assert model is not None
        return lqg(given.name, model, _weights_of(given, model.plant), **bounds)
    made: Element = getattr(elements, given.kind)(given.name, **given.numbers, **bounds)
    return made


def _weights_of(given: StructuredElement, plant: Plant) -> Weights:
    """The weights and variances of an LQG's sizes; what has no size has no weight."""
    q, r, q_i, w, v = (
        np.array([given.numbers.get(f"{table}.{s.name}", math.inf) for s in signals]) ** power
        for table, signals, power in (
            ("state", plant.design_states, -2.0),
            ("input", plant.inputs, -2.0),
            ("integral", plant.outputs, -2.0),
            ("process", plant.inputs, 2.0),
            ("sensor", plant.outputs, 2.0),
        )
    )
    return weights(q, r, w, v, q_i=q_i)


def places_in(law: StructuredLaw, model: LinearModel) -> tuple[Place, ...]:
    """The elements of a design file in their places on a machine."""
    own = {one.name: make_element(one, model) for one in law.elements}
    products: dict[tuple[str, ...], Element] = {}  # of the same elements: one product, with its numbers once
    found = []
    for axis, series in law.law.items():
        if series not in products:
            product = own[series[0]]
            for name in series[1:]:
                product = product * own[name]
            products[series] = product
        found.append(_place(axis, products[series], model, law.axes))
    return tuple(found)


def _place(axis: str, element: Element, model: LinearModel, axes: PidAxes) -> Place:
    """An element on its axis, or of all errors."""
    m, p = len(model.plant.inputs), len(model.plant.outputs)
    if axis == ALL_AXES:
        return Place(np.eye(m), element, np.eye(p))
    sides, names = axes_of(model, axes), [name for name, _ in _units_by_axis(model.plant, axes)]
    k = names.index(axis)
    return Place(sides.inputs[:, [k]], element, sides.of_outputs[[k]])


def with_values(law: StructuredLaw, values: Mapping[str, float]) -> StructuredLaw:
    """The same law with other numbers, by "element.parameter"."""
    changed = []
    for one in law.elements:
        new = {key: values.get(f"{one.name}.{key}", value) for key, value in one.numbers.items()}
        if one.kind == "transfer":
            made = make_element(one).at(values).values
            new = {key.partition(".")[2]: value for key, value in made.items()}
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
    sampled = replace(sampled, states=tuple(labels))
    return law_of_errors(sampled, model, Ts, name=name, position_feedforward=position_feedforward)
