"""The optional parts of a machine, found beside its model.

EXPERIMENTS, FIGURES, CLAIMS, REQUIREMENTS, WORDS and other names are those of the module itself, or of the modules
`experiments`, `figures`, `claims`, `requirements` beside it. What compares a machine with its paper may stand in a
distribution of its own, which names a package with the same modules by an entry point of the group `malta.papers`:
`tubular = "malta_papers.tubular"`. Mappings and tuples of both are joined. Its entry point `ledger` names the module
that computes claims.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from malta.errors import InputError
from malta.model.machines import machine, machine_names, module_of

if TYPE_CHECKING:
    from malta.model.plant import Plant

Part = Literal["experiments", "figures", "claims", "requirements"]
PAPERS = "malta.papers"
INSTALL_PAPERS = "malta-papers: pip install ./papers in a checkout of malta"


@cache
def _papers() -> Mapping[str, str]:
    """Packages and modules of the group PAPERS by name; empty where no distribution has any, or none with its files."""
    points = ((point.name, point.value) for point in entry_points(group=PAPERS))
    return {name: value for name, value in points if find_spec(value.partition(".")[0]) is not None}


def has_papers() -> bool:
    """Whether a distribution that compares machines with papers is installed."""
    return bool(_papers())


def require_ledger() -> ModuleType:
    """The module that computes claims. Raises InputError where malta-papers is not installed."""
    if "ledger" not in _papers():
        raise InputError("claims", "papers", "no distribution that compares with papers", INSTALL_PAPERS)
    return import_module(_papers()["ledger"])


def parts_of(part: Part, name: str) -> tuple[ModuleType | None, ModuleType | None]:
    """The modules of a machine's optional part, its own and that of its paper; None without such a part or machine."""
    if name not in machine_names():
        return None, None
    module = machine(name)
    folder = module.__name__ if hasattr(module, "__path__") else module.__name__.rpartition(".")[0]
    paper = _papers().get(name)
    return _module_in(folder, part), None if paper is None else _module_in(paper, part)


def _module_in(package: str, part: Part) -> ModuleType | None:
    """A module of a package; None where there is none."""
    target = f"{package}.{part}"
    try:
        return import_module(target)
    except ModuleNotFoundError as error:
        if error.name not in (target, package):  # a module that the part imports
            raise
    return None


def values_of(plant: Plant, part: Part, name: str) -> list[Any]:
    """The values of an optional name: from the module of the plant or of the part, then from that of its paper."""
    model, (own, printed) = module_of(plant.parameters), parts_of(part, plant.name)
    places = (model if hasattr(model, name) else own, printed)
    return [getattr(place, name) for place in places if hasattr(place, name)]


def attribute_of(plant: Plant, part: Part, name: str, default: Any = None) -> Any:
    """The value of an optional name, with what its paper adds to a mapping or a tuple; else `default`."""
    first, *more = values_of(plant, part, name) or [default]
    for other in more:
        if isinstance(first, Mapping):
            first = {**first, **other}
        elif isinstance(first, tuple):
            first = (*first, *other)
    return first


def require_part(part: Part, name: str) -> ModuleType:
    """The module of a machine's part, its own if it has one. Raises InputError when the machine has none."""
    own, printed = parts_of(part, name)
    found = own or printed
    if found is None:
        known = ", ".join(other for other in machine_names() if any(parts_of(part, other)))
        raise InputError(part, "machine", repr(name), f"one of {known}, or another that has {part}")
    return found
