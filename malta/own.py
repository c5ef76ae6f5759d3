"""Where the things of one machine are: a module of its name in experiments/, figures/ and claims/, as in plants/."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Literal

from malta.errors import InputError

Part = Literal["experiments", "figures", "claims"]


def own(part: Part, machine: str) -> Any:
    """The machine's module in a part of malta, or None where it has none."""
    name = f"malta.{part}.{machine}"
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:  # of something that the module imports
            raise
        return None


def required(part: Part, machine: str) -> Any:
    """The same. Raises InputError where the machine has none."""
    module = own(part, machine)
    if module is None:
        plants, modules = (
            [module.name for module in iter_modules(import_module(f"malta.{place}").__path__)]
            for place in ("plants", part)
        )
        known = ", ".join(name for name in modules if name in plants)
        raise InputError(part, "machine", repr(machine), f"one that malta has {part} of: {known}")
    return module
