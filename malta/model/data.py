"""Machine data: TOML files into parameter records, in SI units, each value with its source.

    data/tubular.toml -> read() -> the Parameters record of the machine that the file names

A parameter stands in the file as `{ value = 0.360, unit = "kg", tag = "printed", source = "Table IV" }`.
`tag` says how far to trust it: printed (in the source), computed (from what is printed), assumed (ours)
or identified (from a log, with its 95 % interval). The unit may be any of the right dimension; it is converted to SI
here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from decimal import Decimal
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field as Checked, StrictStr

from malta.arguments import is_number
from malta.errors import InputError
from malta.files import file_exists, locate, shipped_path
from malta.model.machines import file_of, machine, machine_names, parameters_record
from malta.model.parameters import check_range
from malta.tables import Finite, Quantity, Record, entry, load_toml, validate
from malta.units import to_si, unit_factor


class Sourced(Quantity):
    """A quantity with its source and how far to trust it."""

    tag: Literal["printed", "computed", "assumed", "identified"] = entry(
        "how far to trust it: in the source, from what the source prints, ours, or from a log"
    )
    source: StrictStr = entry("where the number comes from")
    interval: list[Finite] | None = entry(
        "low and high end of the 95 % interval, in the unit beside the value", default=None
    )


class IdentifiedTable(Record):
    """What a data file says of the identification that its parameters come from."""

    log: StrictStr = entry("the log")
    sha256: StrictStr = entry("of the log's file")
    chi2: Finite = entry("of the residuals over their degrees of freedom")
    joint: Finite = entry("times the intervals: the box that holds all parameters together with 95 %")
    names: list[StrictStr] = entry("the identified parameters")
    correlation: list[list[Finite]] = entry("of the parameters, in the order of names")


class MachineFile(Record):
    """A data file: the parameters of a machine, each with its unit and its source."""

    machine: Annotated[StrictStr, Checked(pattern=r"^[^\x00-\x1f]+$")] = entry(
        "name of an installed machine, or the file of its module, as rotor.py"
    )
    default_preset: StrictStr = entry("preset that is read where none is named", default="")
    parameters: dict[str, Sourced] = entry("parameters by name")
    presets: dict[str, dict[str, Sourced]] = entry(
        "by name: parameters that replace those of parameters", default={}
    )
    identified: IdentifiedTable | None = entry("written by malta identify", default=None)


def read(path: str | Path, preset: str | None = None) -> Any:
    """Read a machine's data file into the Parameters record of its module, in SI units.

    The key `machine` names the module: "tubular" is a machine of an installed package, "rotor.py" is a file beside
    the data file, which is imported.

    path : the data file, as data/tubular.toml
    preset : a table of `presets`, whose entries replace those of `parameters`; the file's default_preset if None. A
        file without presets has the single preset "data": all of its parameters.

    Returns the record, whose fields are numbers in SI.

    Raises InputError, which names file and field, for a missing, unknown or doubled key, an unknown preset, a wrong
    unit, NaN, a value out of range, and a machine that is unknown or cannot be imported.

    >>> import malta
    >>> parameters = malta.read("data/tubular.toml")
    >>> parameters.m, parameters.preset  # kg
    (0.36, 'table1')
    """
    path = locate(path)
    content = validate(MachineFile, load_toml(path), path)
    presets = content.presets or {ONLY_PRESET: {}}
    if content.presets and not content.default_preset:
        raise InputError(path, "default_preset", "nothing", "this key, one of " + ", ".join(presets))
    name = content.default_preset or next(iter(presets)) if preset is None else preset
    if name not in presets:
        raise InputError(path, "presets", f"no preset {name!r}", "one of " + ", ".join(presets))
    record = parameters_record(machine_beside(content.machine, Path(path)), path)
    known = {f.name: f for f in fields(record) if "unit" in f.metadata}
    tables = {"parameters": content.parameters} | {f"presets.{k}": v for k, v in presets.items()}
    values: dict[str, float] = {}
    for table, entries in tables.items():  # every preset is checked, the chosen one is used
        for key, given in entries.items():
            if key not in known:
                raise InputError(path, f"{table}.{key}", "an unknown parameter", "one of " + " ".join(known))
            unit = known[key].metadata["unit"]
            value = to_si(given.value, given.unit, unit, path, f"{table}.{key}")
            check_range(known[key], value, path, f"{table}.{key}")
            if table in ("parameters", f"presets.{name}"):
                values[key] = value
    for key, f in known.items():
        if key not in values and f.default is MISSING:
            unit = f.metadata["unit"]
            raise InputError(path, f"parameters.{key}", "nothing", f"a value in {unit}")
    return record(**values, preset=name)  # type: ignore[call-arg]


ONLY_PRESET = "data"  # name of the preset of a file that has none


def machine_beside(name: str, data_file: Path) -> ModuleType:
    """The module that a data file names, by the machine's name or by a path relative to the data file."""
    try:
        return machine(data_file.parent / name if name.endswith(".py") else name)
    except InputError as error:
        if error.where != "machine":
            raise
        known = ", ".join(map(repr, machine_names()))
        raise InputError(
            data_file, "machine", repr(name), f"one of {known}, or the file of its module, as rotor.py"
        ) from error


# The figures that a machine's paper prints, from published.toml files, each with its unit.


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
