"""The figures that a machine's paper prints, from published.toml files, each with its unit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from malta.errors import InputError
from malta.files import file_exists, locate, shipped_path
from malta.model.machines import file_of
from malta.tables import load_toml
from malta.units import unit_factor


def published(machine_file: str | Path) -> dict[str, Any]:
    """Read the figures that a machine's paper prints: published/NAME.toml or published.toml beside its data file.

    machine_file : the machine's data file, as data/tubular.toml

    Returns the tables of the file; a quantity is {"value": ..., "unit": ...}, in the paper's own unit.

    Raises InputError when neither file exists.

    >>> import malta
    >>> printed = malta.published("data/tubular.toml")
    >>> printed["table_I"]["poles"]["x"], printed["table_I"]["unit"]
    (218.92, 'rad/s')
    """
    return load_toml(_published_file(Path(machine_file)))


def published_beside(machine_file: str | Path) -> dict[str, Any] | None:
    """Read the published figures beside a data file; None when there is no such file."""
    file = _published_file(locate(machine_file))
    return load_toml(file) if file_exists(file) else None


def published_figures(machine: str) -> dict[str, Any] | None:
    """Read the published figures of a machine by its name, from malta's data or beside the user's own machine file."""
    file = file_of(machine)
    return published_beside(
        shipped_path("data", f"{machine}.toml") if file is None else file.with_suffix(".toml")
    )


def _published_file(data_file: Path) -> Path:
    data_file = locate(data_file)
    alone = data_file.parent / "published.toml"
    of_its_name = data_file.parent / "published" / data_file.name
    return alone if file_exists(alone) and not file_exists(of_its_name) else of_its_name


def published_value(content: Mapping[str, Any], key: str) -> float:
    """A published quantity in SI units by its dotted key: `{ value, unit }`, or a number in a table with a unit.

    Raises InputError when the key is missing, the entry is no number, or its unit is unknown.
    """
    where, unit = "data/published", None
    entry: Any = content
    for part in key.split("."):
        if not isinstance(entry, Mapping) or part not in entry:
            raise InputError(where, key, "nothing", "what the paper prints")
        unit = entry.get("unit", unit)
        entry = entry[part]
    if isinstance(entry, Mapping):
        unit, entry = entry.get("unit"), entry.get("value")
    if isinstance(entry, bool) or not isinstance(entry, int | float) or not isinstance(unit, str):
        raise InputError(where, key, f"{entry!r} in {unit}", "a number with a unit")
    return float(entry) * unit_factor(unit, f"{key}.unit")
