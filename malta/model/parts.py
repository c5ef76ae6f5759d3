"""The optional parts of a machine, found beside its model.

EXPERIMENTS, FIGURES, CLAIMS, REQUIREMENTS, WORDS and other names are those
of the module itself, or of the modules `experiments`, `figures`, `claims`, `requirements` beside it; claims may stand
in `paper`, a module or a folder, with what they are computed from.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from malta.errors import InputError
from malta.model.machines import machine, machine_names, module_of

if TYPE_CHECKING:
    from malta.model.plant import Plant

Part = Literal["experiments", "figures", "claims", "requirements"]


def part_of(part: Part, name: str) -> ModuleType | None:
    """The module of a machine's optional part; None without such a part or machine."""
    if name not in machine_names():
        return None
    module = machine(name)
    folder = module.__name__ if hasattr(module, "__path__") else module.__name__.rpartition(".")[0]
    for target in (*([f"{folder}.paper"] if part == "claims" else []), f"{folder}.{part}"):
        try:
            return import_module(target)
        except ModuleNotFoundError as error:
            if error.name not in (target, folder):  # a module that the part imports
                raise
    return None


def attribute_of(plant: Plant, part: Part, name: str, default: Any = None) -> Any:
    """The value of an optional name, from the module of the plant or of the part; else `default`."""
    model = module_of(plant.parameters)
    if hasattr(model, name):
        return getattr(model, name)
    return getattr(part_of(part, plant.name), name, default)


def require_part(part: Part, name: str) -> ModuleType:
    """The module of a machine's part. Raises InputError when the machine has none."""
    module = part_of(part, name)
    if module is None:
        known = ", ".join(other for other in machine_names() if part_of(part, other) is not None)
        raise InputError(part, "machine", repr(name), f"one of {known}, or another that has {part}")
    return module
