"""Hashes by which a campaign recognizes its own runs: of a record's content, and of the revision of engine and law.

Runs of two revisions differ, so a folder keeps the runs of one revision only.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.files import read_file
from malta.model.machines import part_of
from malta.simulation.batch import functions_text

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.simulation.scenario import Scenario
    from malta.synthesis.controller import Controller

PACKAGES = ("model", "synthesis", "simulation")  # whose modules decide a run


def fingerprint(record: Any) -> str:
    """sha256 of every number, name and tuple in a record: equal for a gain file's .json, .npz and .mat.

    Each part is hashed with its kind and its size, so that two records of different structure never give the same
    bytes: ((1, 2), (3,)) and ((1,), (2, 3)) differ.
    """
    marks = hashlib.sha256()
    for part in _parts(record):
        marks.update(part)
    return marks.hexdigest()


def _parts(value: Any) -> Iterator[bytes]:
    """The bytes of a value: its kind, its size, then its content."""
    if isinstance(value, np.ndarray | np.generic | float | int):
        yield f"number {np.shape(value)}:".encode()
        # Files do not store the sign of a zero: + 0.0 drops it.
        yield (np.asarray(value, dtype="<f8") + 0.0).tobytes()
    elif is_dataclass(value):
        # A field that came later is left out at its default: older gain files do not mention it.
        kept = [
            f.name
            for f in fields(value)
            if not (f.metadata.get("later") and _is_usual(f, getattr(value, f.name)))
        ]
        yield f"record {len(kept)}:".encode()
        for name in kept:
            yield from _parts(name)
            yield from _parts(getattr(value, name))
    elif isinstance(value, Mapping):
        yield f"table {len(value)}:".encode()
        for name in sorted(value):
            yield from _parts(name)
            yield from _parts(value[name])
    elif isinstance(value, tuple | list):
        yield f"list {len(value)}:".encode()
        for entry in value:
            yield from _parts(entry)
    else:
        text = repr(value).encode()
        yield f"text {len(text)}:".encode() + text


def _is_usual(f: Field[Any], value: Any) -> bool:
    """Whether a field has its default."""
    usual: Any = f.default if f.default_factory is MISSING else f.default_factory()
    return np.array_equal(value, usual) if isinstance(value, np.ndarray) else bool(value == usual)


@lru_cache(maxsize=8)
def revision_of(plant: Plant, controller: Controller, scenario: Scenario) -> dict[str, str]:
    """The revision of engine and law that decides the runs of a scenario: three hashes, each sha256.

    engine : of the modules of malta that simulate a run, with the C text of the engine
    machine : of the modules of the machine's model and of its experiments
    law : of the functions of a control period as the engine compiles them: machine, controller and digest
    """
    model = type(plant.parameters).__module__
    part = part_of("experiments", plant.name)
    modules = dict.fromkeys([model] if part is None else [model, part.__name__])
    return {
        "engine": _engine_sha256(),
        "machine": _sha256(part for name in modules for part in _module_parts(name)),
        "law": _sha256([functions_text(plant, controller, scenario).encode()]),
    }


@cache
def _engine_sha256() -> str:
    """sha256 of the names and texts of the modules of PACKAGES, and of the engine's C text."""
    return _sha256(_package_parts(PACKAGES))


@cache
def firmware_sha256() -> str:
    """The same of the modules that write the exported C, and of its templates."""
    return _sha256(_package_parts(("firmware", "firmware/templates")))


def _package_parts(packages: tuple[str, ...]) -> list[bytes]:
    """The names and texts of the modules and C files of packages."""
    parts: list[bytes] = []
    for package in packages:
        for file in sorted(files("malta").joinpath(package).iterdir(), key=lambda file: file.name):
            if file.name.endswith((".py", ".c", ".h")):
                parts += [f"{package}/{file.name}".encode(), file.read_bytes()]
    return parts


def _module_parts(name: str) -> list[bytes]:
    """The name of a module and the texts of its files, those of its whole folder for a package.

    The name alone where a module has no file, as in a notebook, and for a script: `law` covers their models.
    """
    found = getattr(sys.modules.get(name), "__file__", None)
    if name == "__main__" or found is None:
        return [name.encode()]
    path = Path(found)
    paths = sorted(path.parent.glob("*.py")) if path.name == "__init__.py" else [path]
    return [name.encode(), *(read_file(p, "module of a machine", Path.read_bytes) for p in paths)]


def _sha256(parts: Iterable[bytes]) -> str:
    """sha256 of parts, each with its length."""
    marks = hashlib.sha256()
    for part in parts:
        marks.update(f"{len(part)}:".encode() + part)
    return marks.hexdigest()
