"""Where the parts of a machine are: modules of its folder in malta/machines/."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any, Literal

from malta.errors import InputError

Part = Literal["experiments", "figures", "claims"]


def own(part: Part, machine: str) -> Any:
    """The machine's module of a part, or None where it has none."""
    name = f"malta.machines.{machine}.{part}"
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in (name, f"malta.machines.{machine}"):  # of something that the module imports
            raise
        return None


def required(part: Part, machine: str) -> Any:
    """The same. Raises InputError where the machine has none."""
    module = own(part, machine)
    if module is None:
        machines = [m.name for m in iter_modules(import_module("malta.machines").__path__)]
        known = ", ".join(name for name in machines if find_spec(f"malta.machines.{name}.{part}"))
        raise InputError(part, "machine", repr(machine), f"one that malta has {part} of: {known}")
    return module
