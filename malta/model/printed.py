"""The figures that a machine's paper prints, from published.toml files, each with its unit."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

from malta.arguments import is_number
from malta.errors import InputError
from malta.files import file_exists, locate, shipped_path
from malta.model.machines import file_of
from malta.tables import load_toml
from malta.units import unit_factor


def read_published(machine_file: str | Path) -> dict[str, Any]:
    """Read the figures that a machine's paper prints: published/NAME.toml or published.toml beside its data file.

    machine_file : the machine's data file, as data/tubular.toml

    Returns the tables of the file; a quantity is {"value": ..., "unit": ...}, in the paper's own unit.

    Raises InputError when neither file exists.

    >>> import malta
    >>> printed = malta.model.read_published("data/tubular.toml")
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


MOST_DIGITS = 20  # of a published figure behind its point


class PublishedFigure(NamedTuple):
    """A figure as a paper prints it."""

    value: float  # SI
    half: float = 0.0  # SI, half a unit of its last printed digit
    about: bool = False  # whether the paper says "about", "around" or "approximately"


def published_figure(content: Mapping[str, Any], key: str) -> PublishedFigure:
    """A published quantity by its dotted key: `{ value, unit }`, or a number in a table with a unit; SI units.

    Its digits are those of the file; `digits` beside it, or in a table above it, counts decimals that end in zeros.
    `about = true` marks what the paper calls about, around or approximately so much.

    Raises InputError when the key is missing, the entry is no finite number, or its unit or digits are none.
    """
    where, unit, digits, about = "data/published", None, None, False
    entry: Any = content
    for part in key.split("."):
        if not isinstance(entry, Mapping) or part not in entry:
            raise InputError(where, key, "nothing", "what the paper prints")
        unit, digits = entry.get("unit", unit), entry.get("digits", digits)
        entry = entry[part]
    if isinstance(entry, Mapping):
        digits, about = entry.get("digits", digits), entry.get("about", False)
        unit, entry = entry.get("unit"), entry.get("value")
    if not is_number(entry) or not isinstance(unit, str):
        raise InputError(where, key, f"{entry!r} in {unit}", "a number with a unit")
    if digits is not None and (type(digits) is not int or abs(digits) > MOST_DIGITS):
        raise InputError(where, f"{key}.digits", repr(digits), f"decimals, at most {MOST_DIGITS}")
    factor = unit_factor(unit, f"{key}.unit")
    half = half_of_last_digit(repr(entry)) if digits is None else 0.5 * 10.0**-digits
    return PublishedFigure(float(entry) * factor, half * factor, about is True)


def half_of_last_digit(text: str) -> float:
    """Half a unit of the last digit of a number as it is written.

    >>> half_of_last_digit("25.67"), half_of_last_digit("205"), half_of_last_digit("2.62e-05")
    (0.005, 0.5, 5e-08)
    """
    exponent = Decimal(text).as_tuple().exponent
    return float(Decimal(5).scaleb(int(exponent) - 1))


def published_value(content: Mapping[str, Any], key: str) -> float:
    """The value of `published_figure`."""
    return published_figure(content, key).value
