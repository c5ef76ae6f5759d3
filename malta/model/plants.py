"""The plant of a record of parameters, built by its machine's module and checked."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from malta.model.checks import check_numbers
from malta.model.machines import build_plant, module_of
from malta.model.plant import Parameters, Plant
from malta.model.readings import require_readings
from malta.model.traced import check_values, is_checked, register


def plant_of(parameters: Parameters) -> Plant:
    """Build the plant with these parameters, by the function `plant` of the module that defines their class.

    parameters : a machine's Parameters record, SI

    Returns a Plant; equal records of parameters have the same one.

    Raises InputError when the module has no such function, and when the fields of its plant do not fit each other.

    >>> import malta
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> plant.name, len(plant.states), [s.name for s in plant.outputs]
    ('tubular', 12, ['x1', 'y1', 'x2', 'y2', 'z'])
    """
    return _plant_of(parameters)


@lru_cache(maxsize=64)
def _plant_of(parameters: Any) -> Plant:
    plant, build = build_plant(parameters), module_of(parameters).plant
    checked = is_checked(plant, build)
    if not checked:
        check_numbers(plant)
    register(plant, build)
    if checked:
        check_values(plant)
    require_readings(plant)
    return plant
