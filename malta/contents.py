"""The public names of a package: a dict of what each module gives, loaded at its first use (PEP 562)."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from operator import attrgetter
from typing import Any


def contents(
    package: str, names: Mapping[str, str], old: Mapping[str, str] | None = None
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """What a package names `__all__`, `__getattr__` and `__dir__`.

    package : its `__name__`; type checkers and editors see the same names by its imports under TYPE_CHECKING
    names : by module, the names that the package takes from it, with spaces between; from itself: its modules
    old : names that go with the next minor version, and what to write for them

    Returns the three. A name is loaded at its first use; an old one warns.
    """
    places = {name: module for module, own in names.items() for name in own.split()}
    gone = old or {}

    def load(name: str) -> Any:
        if name in gone:
            told = f"{package}.{name} goes: write {gone[name]}"
            warnings.warn(told, DeprecationWarning, stacklevel=3)  # of who calls the package's `__getattr__`
            return attrgetter(gone[name].removeprefix(f"{package}."))(import_module(package))
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        place = places[name]  # `fromlist`: a module as well, as `from place import name` finds it
        of_itself = place == package
        value = (
            import_module(f"{place}.{name}")
            if of_itself
            else getattr(__import__(place, fromlist=[name]), name)
        )
        setattr(sys.modules[package], name, value)
        return value

    return [*places], load, lambda: sorted(places)
