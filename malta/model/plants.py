"""The plant of a record of parameters, built by its machine's module and checked."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

from malta.errors import CheckError, InputError
from malta.model.checks import check_numbers, line_of
from malta.model.machines import file_of, module_of, name_of
from malta.model.plant import Parameters, Plant
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


@lru_cache(maxsize=64)  # records are immutable, and building a plant is slow
def _plant_of(parameters: Any) -> Plant:
    module = module_of(parameters)
    build: Callable[[Any], Plant] | None = getattr(module, "plant", None)
    if build is None:
        raise InputError(module.__name__, "plant", "nothing", "a function of Parameters -> Plant beside them")
    name = name_of(module)
    try:
        plant = build(parameters)
    except (InputError, CheckError):
        raise
    except Exception as error:  # a user's function may raise anything
        found = f"{type(error).__name__}: {error}{(line := line_of(error)) and f', at {line}'}"
        raise InputError(f"{name}.py", "plant", found, "a function that makes a Plant") from error
    if not isinstance(plant, Plant):
        raise InputError(
            f"{name}.py", "plant", f"a function that returns {plant!r}", "one that returns a Plant"
        )
    if file_of(name) is not None and plant.name != name:
        raise InputError(f"{name}.py", "plant: name", repr(plant.name), f"{name!r}, as the file is called")
    checked = is_checked(plant, build)
    if not checked:
        check_numbers(plant)
    register(plant, build)
    if checked:
        check_values(plant)
    return plant
