"""How a plant is pickled: as its parameters, of which its machine's module makes it again, and what was changed beside.

The functions of a plant are closures, which pickle does not take. They are those of the module where their code is the
same and what they close over is equal; a plant with functions of its own does not pickle.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import partial
from types import FunctionType
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.model.plants import plant_of

if TYPE_CHECKING:
    from malta.model.plant import Plant

GROUPS = ("actuator", "sensors", "contacts", "stroke")


def recipe_of(plant: Plant) -> tuple[Any, ...]:
    """The function and the arguments with which pickle rebuilds a plant."""
    base = plant_of(plant.parameters)
    changed: dict[str, Any] = {}
    for name in () if plant is base else (f.name for f in fields(plant)):
        mine, own = getattr(plant, name), getattr(base, name)
        if name in GROUPS:
            entries = {f.name: getattr(mine, f.name) for f in fields(mine)}
            more = {key: value for key, value in entries.items() if not _same(value, getattr(own, key))}
            changed |= {name: more} if more else {}
        elif not _same(mine, own):
            changed[name] = mine
    return rebuild_plant, (plant.parameters, changed)


def rebuild_plant(parameters: Any, changed: dict[str, Any]) -> Plant:
    """The plant of these parameters with other fields; of groups with other entries."""
    base = plant_of(parameters)
    whole = {
        name: replace(getattr(base, name), **value) if name in GROUPS else value
        for name, value in changed.items()
    }
    return replace(base, **whole) if whole else base


def _same(a: Any, b: Any, compared: frozenset[tuple[int, int]] = frozenset()) -> bool:
    """Whether two values are equal; functions by their code and what they close over, expressions by their shape.

    compared : pairs that are being compared: a plant's defaults close over the plant
    """
    if a is b or (id(a), id(b)) in compared:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, ca.SX | ca.MX | ca.Function):  # of symbols that each plant has its own of
        return str(a) == str(b)
    if isinstance(a, ca.DM | np.ndarray):
        return np.array_equal(np.array(a), np.array(b))
    if isinstance(a, dict):
        a, b = sorted(a.items()), sorted(b.items())
    one, two = _parts(a), _parts(b)
    if one is None or two is None:
        return bool(a == b)
    pairs = compared | {(id(a), id(b))}
    return len(one) == len(two) and all(_same(*pair, pairs) for pair in zip(one, two, strict=True))


def _parts(value: Any) -> tuple[Any, ...] | None:
    """What a value consists of; None of one that is compared as a whole."""
    if isinstance(value, FunctionType):
        cells = (cell.cell_contents for cell in value.__closure__ or ())
        return id(value.__code__), value.__defaults__, value.__kwdefaults__, *cells
    if isinstance(value, partial):
        return value.func, value.args, value.keywords
    if hasattr(value, "__wrapped__"):
        return (value.__wrapped__,)
    if is_dataclass(value):
        return tuple(getattr(value, f.name) for f in fields(value))
    return tuple(value) if isinstance(value, tuple | list) else None
