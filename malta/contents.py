"""The public names of a package: one list in its own file, loaded at their first use."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

LINE = re.compile(r"^    from (\S+) import (\w+) as", re.MULTILINE)


def contents(
    package: str, file: str, modules: Sequence[str] = (), old: Mapping[str, str] | None = None
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """What a package names `__all__`, `__getattr__` and `__dir__`.

    package, file : `__name__` and `__file__` of the package, whose lines `from place import name as name` under
        TYPE_CHECKING are the one list, as type checkers and readers see it
    modules : those of its names that are modules
    old : names that go with the next minor version, and what to write for them

    Returns the three. A name is looked for where its line says, at its first use; an old one warns.
    """
    places = {name: place for place, name in LINE.findall(Path(file).read_text("utf-8"))}
    gone = old or {}

    def load(name: str) -> Any:
        if name in gone:
            warnings.warn(
                f"{package}.{name} goes: write {gone[name]}", DeprecationWarning, stacklevel=3
            )  # of the caller of the package's own `__getattr__`
            return attrgetter(gone[name].partition(".")[2])(import_module(package))
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        place = places[name]
        value = import_module(f"{place}.{name}") if name in modules else getattr(import_module(place), name)
        setattr(sys.modules[package], name, value)
        return value

    return [*places], load, lambda: sorted(places)
