"""Functions of a machine, traced once for all records of its parameters.

A slider gives a machine new numbers at each move, and tracing its equations takes longer than what is computed with
them. A recipe says how inputs and outputs are made of a plant; its function has the machine's parameters as further
inputs, so that machines which differ in numbers alone share it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import fields
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from malta.model.checks import check_equations, check_signals, check_symbols
from malta.model.parameters import acting_names
from malta.model.plant import Plant

Expressions = list[Any]
Recipe = Callable[..., tuple[Expressions, Expressions]]  # plant, believed one, options -> ins, outs


class Traced(NamedTuple):
    """A function of a machine, with the values of the parameters that are inputs of it."""

    function: ca.Function
    values: tuple[Any, ...] = ()  # columns
    anew: Callable[[], ca.Function] | None = None  # the same function of numbers

    def __call__(self, *given: Any) -> list[Any]:
        """The outputs."""
        return self._evaluate([ca.DM(value) for value in given], 1)

    def each(self, *given: Any) -> list[Any]:
        """The outputs side by side; of each argument the rows are taken one by one."""
        return self._evaluate([ca.DM(rows.T) for rows in given], len(given[0]))

    def _evaluate(self, given: Expressions, count: int) -> list[Any]:
        values = [ca.repmat(value, 1, count) for value in self.values]
        function = self.function if count == 1 else self.function.map(count)
        found = [np.array(value) for value in function.call([*given, *values])]
        if self.anew is None or all(np.isfinite(value).all() for value in found):
            return found
        # The slope of sqrt(e x) by x is 0 where e is the number 0, and 0/0 where it is an input.
        return Traced(self.anew())._evaluate(given, count)


class _Family(NamedTuple):
    """What machines have in common that differ in numbers alone."""

    build: Callable[[Any], Plant]
    kind: type
    names: tuple[str, ...]  # of the parameters that differ
    others: tuple[tuple[str, Hashable], ...]


_families: WeakKeyDictionary[Plant, _Family] = WeakKeyDictionary()  # plants compare by identity
_checked: deque[_Family] = deque(maxlen=64)


def register(plant: Plant, build: Callable[[Any], Plant]) -> None:
    """Say that a plant is build(parameters), and check that parameters may be symbols, but those with `shapes`.

    The check is of the functions, not of numbers: one for all plants that differ in numbers. Raises InputError as
    `checks.check_symbols`.
    """
    if plant.actuator.tabulated:  # its table holds numbers, and symbols raise an error there
        return
    family = _family_of(plant, build)
    if family not in _checked:
        check_symbols(plant)
        _checked.append(family)
    _families[plant] = family


def is_checked(plant: Plant, build: Callable[[Any], Plant]) -> bool:
    """Whether a plant of the same family, whose functions have the same sizes, was registered before."""
    return not plant.actuator.tabulated and _family_of(plant, build) in _checked


def check_values(plant: Plant) -> None:
    """`checks.check_numbers` of a registered plant whose family is checked: its functions, where one is not finite."""
    check_signals(plant)
    sizes = [len(getattr(plant, key)) for key in ("states", "inputs", "disturbances", "outputs")]
    at = [np.zeros(size) for size in (*sizes, len(plant.actuator.coils))]
    if not all(np.isfinite(found).all() for found in trace(_functions, plant)(*at)):
        check_equations(plant)


def _functions(plant: Plant, _believed: None) -> tuple[Expressions, Expressions]:
    """(x, u, w, y, i) -> all functions of a plant."""
    sizes = {key: len(getattr(plant, key)) for key in ("states", "inputs", "disturbances", "outputs")}
    x, u, w, y, i = (
        ca.SX.sym(name, size)
        for name, size in zip("xuwyi", (*sizes.values(), len(plant.actuator.coils)), strict=True)
    )
    own = (plant.f(x, u, w), plant.h(x, u), plant.load(x))
    found = (*own, plant.actuator.currents(y, u), plant.actuator.forces(x, i), plant.contacts.contact(x))
    return [x, u, w, y, i], [ca.densify(ca.SX(one)) for one in found]


def _family_of(plant: Plant, build: Callable[[Any], Plant]) -> _Family:
    record: Any = plant.parameters
    names = tuple(acting_names(record))
    others = (f.name for f in fields(record) if f.name not in (*names, "preset"))
    return _Family(build, type(record), names, tuple((name, getattr(record, name)) for name in others))


def with_parameters(plant: Plant, parameters: Any) -> Plant:
    """The machine of another record of parameters, in the family of this one where it has one."""
    family = _families.get(plant)
    if family is None:
        return plant.variant(parameters)
    made = family.build(parameters)
    register(made, family.build)
    return made


def trace(recipe: Recipe, plant: Plant, believed: Plant | None = None, *options: Hashable) -> Traced:
    """The function of a recipe for a machine, and for the machine that its controller believes in.

    recipe : called with the plants and the options; the same function object for what is the same
    """
    machines = (plant,) if believed is None else (plant, believed)
    families = tuple(_families[one] for one in machines if one in _families)

    def of_numbers() -> ca.Function:
        return ca.Function(recipe.__name__.lstrip("_"), *recipe(plant, believed, *options))

    if len(families) < len(machines):
        return Traced(of_numbers())
    values = [
        ca.DM([getattr(m.parameters, n) for n in f.names]) for m, f in zip(machines, families, strict=True)
    ]
    return Traced(_function(recipe, families, options), tuple(values), of_numbers)


@lru_cache(maxsize=64)  # a page asks some ten recipes of a machine
def _function(recipe: Recipe, families: tuple[_Family, ...], options: tuple[Hashable, ...]) -> ca.Function:
    machines, columns = [], []
    for family in families:
        symbols = {name: ca.SX.sym(name) for name in family.names}
        record: Any = object.__new__(family.kind)
        for name, value in {**dict(family.others), **symbols, "preset": "symbols"}.items():
            object.__setattr__(record, name, value)
        machines.append(family.build(record))
        columns.append(ca.vertcat(*symbols.values()))
    inputs, outputs = recipe(*machines, *[None] * (2 - len(machines)), *options)
    return ca.Function(recipe.__name__.lstrip("_"), [*inputs, *columns], outputs)
