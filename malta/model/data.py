"""Machine data: TOML files into parameter records, in SI units, each value with its source.

    data/tubular.toml -> read() -> the Parameters record of the machine that the file names

A parameter stands in the file as `{ value = 0.360, unit = "kg", tag = "printed", source = "Table IV" }`.
`tag` says how far to trust it: printed (in the source), computed (from what is printed) or assumed
(ours). The unit may be any of the right dimension; this module is the one place that converts to SI.
"""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from functools import cache, lru_cache
from numbers import Real
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import BaseModel, ConfigDict, StrictStr, ValidationError
from pydantic import Field as Checked

from malta.errors import InputError
from malta.files import located, read_file, shipped
from malta.model.checks import check_plant
from malta.model.machines import file_of, machine, machine_names, name_of

if TYPE_CHECKING:
    from malta.model.plant import Parameters, Plant

_Model = TypeVar("_Model", bound=BaseModel)
Finite = Annotated[float, Checked(strict=True, allow_inf_nan=False)]


class Record(BaseModel):
    """A table of a file that malta reads: no unknown keys, no silent conversions, immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Quantity(Record):
    """A number with its unit, as it stands in a file."""

    value: Finite
    unit: StrictStr


class Sourced(Quantity):
    """A quantity that says where it comes from."""

    tag: Literal["printed", "computed", "assumed"]
    source: StrictStr


class _MachineFile(Record):
    machine: Annotated[StrictStr, Checked(pattern=r"^[^\x00-\x1f]+$")]
    default_preset: StrictStr = ""
    parameters: dict[str, Sourced]
    presets: dict[str, dict[str, Sourced]] = Checked(default_factory=dict)


def si(
    unit: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    twin: str | None = None,
    shapes: bool = False,
) -> Any:
    """Declare a parameter: `m: float = si("kg", above=0)  # mover with magnets, Table IV`.

    twin: another parameter; where both are equal, symbolic models hold one symbol for them.
    shapes: models are shaped by it (a delay, a number of harmonics): it stays a number where others are symbols.
    """
    return field(
        metadata={"unit": unit, "above": above, "at_least": at_least, "twin": twin, "shapes": shapes}
    )


def units_of(record: type[Parameters] | Parameters) -> dict[str, str]:
    """The SI unit of every physical field of a parameter record."""
    return {f.name: f.metadata["unit"] for f in fields(record) if "unit" in f.metadata}


def twins_of(record: Parameters) -> dict[str, str]:
    """The parameters that symbolic models take as one with another: declared twins of equal value."""
    declared = {f.name: f.metadata.get("twin") for f in fields(record)}
    return {k: twin for k, twin in declared.items() if twin and getattr(record, k) == getattr(record, twin)}


def shaping(record: Parameters) -> dict[str, float]:
    """The parameters that shape models, with their values."""
    return {f.name: getattr(record, f.name) for f in fields(record) if f.metadata.get("shapes")}


def check_parameters(record: Parameters, where: str | Path = "parameters") -> None:
    """Refuse values that no machine has (NaN, a negative mass): InputError names the field."""
    for f in fields(record):
        if "unit" in f.metadata:
            _check_range(f, getattr(record, f.name), where, f.name)


def _check_range(f: Field[Any], value: object, where: str | Path, name: str) -> None:
    unit, above, least = f.metadata["unit"], f.metadata["above"], f.metadata["at_least"]
    low = f" above {above:g}" if above is not None else ""
    low = f" of at least {least:g}" if least is not None else low
    real = isinstance(value, Real) and not isinstance(value, bool)
    try:
        number = float(value) if real else math.nan  # type: ignore[arg-type]
    except OverflowError:  # an integer beyond any float
        number = math.inf
    inside = (above is None or number > above) and (least is None or number >= least)
    if not (math.isfinite(number) and inside):
        found = f"{number} {unit}" if real else repr(value)
        raise InputError(where, name, found, f"a finite number{low} in {unit}")


# What a machine is measured in. Angle is a dimension of its own here: taken as 1, as most unit libraries do, it
# lets Hz pass for rad/s and errs by 2 pi.
UNITS = """
nano- = 1e-9 = n-
micro- = 1e-6 = u- = µ- = μ-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
mega- = 1e6 = M-
gram = [mass] = g
meter = [length] = m = metre
second = [time] = s
ampere = [current] = A
radian = [angle] = rad
degree = 0.017453292519943295 * radian = deg
turn = 6.283185307179586 * radian = revolution
inch = 0.0254 * meter
minute = 60 * second = min
rpm = turn / minute
hertz = 1 / second = Hz
newton = kilogram * meter / second ** 2 = N
joule = newton * meter = J
watt = joule / second = W
volt = watt / ampere = V
ohm = volt / ampere
henry = volt * second / ampere = H
farad = ampere * second / volt = F
weber = volt * second = Wb
tesla = weber / meter ** 2 = T
percent = 0.01
"""


@cache
def _units() -> Any:
    import pint  # here, because `malta --help` must not wait for it

    registry: Any = pint.UnitRegistry(None)
    registry.load_definitions(UNITS.strip().splitlines())
    return registry


@cache
def _root_units(unit: str) -> Any:
    return _units().get_root_units(_units().parse_units(unit))


def to_si(value: float, unit: str, si_unit: str, where: str | Path, name: str) -> float:
    """Convert to `si_unit` ("kg", "m/s", "N m", ...).

    Raises InputError that names `where` and `name` when the unit is unknown or of another kind.
    """
    expected = f"a unit of {si_unit}"
    try:
        factor, found_root = _root_units(unit)
    except Exception as error:  # pint raises many kinds, tokenizer errors among them
        raise InputError(where, f"{name}.unit", repr(unit), expected) from error
    si_factor, si_root = _root_units(si_unit)
    if found_root != si_root:
        raise InputError(where, f"{name}.unit", repr(unit), expected)
    ratio = float(factor) / float(si_factor)
    whole = round(1 / ratio) if ratio < 1 else 0
    # Dividing by a power of ten is exact where multiplying is not: 50 us is 5e-05, not 4.9999...e-05.
    return value / whole if whole and abs(whole * ratio - 1) < 1e-12 else value * ratio


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file; InputError when it is missing, unreadable, not text or not TOML."""
    text = read_file(Path(path), "TOML file", lambda p: p.read_text(encoding="utf-8"))
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, endless digits, endless nesting
        raise InputError(path, "", f"a TOML error ({error})", "a complete TOML file") from error


def validated(model: type[_Model], content: object, where: str | Path) -> _Model:
    """Check `content` against a pydantic model; InputError gives the first fault in one sentence."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise explain(error, where) from error


def explain(error: ValidationError, where: str | Path) -> InputError:
    """One sentence for pydantic's first complaint."""
    first = error.errors(include_url=False)[0]
    name = ".".join(str(part) for part in first["loc"] if not str(part).startswith("function-"))
    kind, message = first["type"], first["msg"]
    if kind == "missing":
        return InputError(where, name, "nothing", "this key")
    if kind == "extra_forbidden":
        return InputError(where, name, "an unknown key", "only the keys of its format")
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        message = "a table"
    if kind == "string_pattern_mismatch":
        message = "a name of letters, digits, - and _"
    found = repr(first["input"])
    expected = message.removeprefix("Value error, ").removeprefix("Input should be ")
    return InputError(where, name, found if len(found) <= 60 else found[:57] + "...", expected)


def read(path: str | Path, preset: str | None = None) -> Any:
    """Read a machine's data file into the Parameters record of its module.

    The file names the machine: `machine = "tubular"` is one that an installed package offers, `machine = "rotor.py"`
    the module in this file beside it, which is imported.

    Parameters
    ----------
    path : a file as data/tubular.toml
    preset : a table of its `presets`, laid over `parameters`; the file's default_preset if None. A file without
        presets has one alone, "data", which is all of its parameters.

    Raises InputError, naming file and field: a missing, unknown or doubled key, an unknown preset, a
    wrong unit, NaN, a value out of range, a machine that is not known or cannot be imported.
    """
    path = located(path)
    content = validated(_MachineFile, load_toml(path), path)
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
        for key, entry in entries.items():
            if key not in known:
                raise InputError(path, f"{table}.{key}", "an unknown parameter", ", ".join(known))
            unit = known[key].metadata["unit"]
            value = to_si(entry.value, entry.unit, unit, path, f"{table}.{key}")
            _check_range(known[key], value, path, f"{table}.{key}")
            if table in ("parameters", f"presets.{name}"):
                values[key] = value
    for key, f in known.items():
        if key not in values and f.default is MISSING:
            unit = f.metadata["unit"]
            raise InputError(path, f"parameters.{key}", "nothing", f"a value in {unit}")
    return record(**values, preset=name)  # type: ignore[call-arg]


ONLY_PRESET = "data"  # name of the preset of a file that has none


def machine_beside(name: str, data_file: Path) -> ModuleType:
    """The module of the machine that a data file names: by its name, or by a file relative to the data file."""
    try:
        return machine(data_file.parent / name if name.endswith(".py") else name)
    except InputError as error:
        if error.where != "machine":
            raise
        known = ", ".join(map(repr, machine_names()))
        raise InputError(
            data_file, "machine", repr(name), f"one of {known}, or the file of its module, as rotor.py"
        ) from error


def parameters_record(module: ModuleType, where: str | Path) -> type[Parameters]:
    """The class Parameters of a machine's module. InputError where it is no frozen dataclass with `preset`."""
    record: Any = getattr(module, "Parameters")  # noqa: B009  a user's module
    if not (is_dataclass(record) and isinstance(record, type)):
        raise InputError(
            where, f"{module.__name__.rpartition('.')[2]}.Parameters", repr(record), "a frozen dataclass"
        )
    if not any("unit" in f.metadata for f in fields(record)):
        raise InputError(
            where, "Parameters", "no field with a unit", 'some, as `m: float = si("kg", above=0)`'
        )
    if "preset" not in {f.name for f in fields(record)}:
        raise InputError(where, "Parameters", "no field preset", '`preset: str = "custom"`')
    return cast("type[Parameters]", record)


def plant_of(parameters: Parameters) -> Plant:
    """The plant that these parameters describe: by the function `plant` of the module that defines their record.

    Raises InputError where the module has none, or where its plant does not fit together.
    """
    return _plant_of(parameters)


@lru_cache(maxsize=64)  # records are immutable; building one takes longer than much that is done with it
def _plant_of(parameters: Any) -> Plant:
    module = sys.modules[type(parameters).__module__]
    build: Callable[[Any], Plant] | None = getattr(module, "plant", None)
    if build is None:
        raise InputError(module.__name__, "plant", "nothing", "a function of Parameters -> Plant beside them")
    plant = build(parameters)
    name = name_of(module)
    if file_of(name) is not None and plant.name != name:
        raise InputError(f"{name}.py", "plant: name", repr(plant.name), f"{name!r}, as the file is called")
    check_plant(plant)
    return plant


def published(machine_file: str | Path) -> dict[str, Any]:
    """The figures that the machine's paper prints: published/NAME.toml, or published.toml, beside its data file.

    Raises InputError where there is neither; `published_beside` gives None then.
    """
    return load_toml(_published_file(Path(machine_file)))


def published_beside(machine_file: str | Path) -> dict[str, Any] | None:
    """The same, or None for a machine without published figures."""
    file = _published_file(located(machine_file))
    return load_toml(file) if file.exists() else None


def published_figures(machine: str) -> dict[str, Any] | None:
    """The same by the machine's name: of the data that comes with malta, or beside the file that the user named."""
    file = file_of(machine)
    return published_beside(shipped("data", f"{machine}.toml") if file is None else file.with_suffix(".toml"))


def _published_file(data_file: Path) -> Path:
    data_file = located(data_file)
    alone = data_file.parent / "published.toml"
    of_its_name = data_file.parent / "published" / data_file.name
    return alone if alone.exists() and not of_its_name.exists() else of_its_name


def published_value(content: Mapping[str, Any], key: str) -> float:
    """A published quantity by its dotted key, in SI units: `{ value, unit }`, or a number in a table with a unit.

    Raises InputError when it is not there, no number, or of an unknown unit.
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
    return float(entry) * _scale(unit, f"{key}.unit")


def in_unit(value: float, unit: str) -> float:
    """An SI value in a unit to show it in: 16.2e-3 in "ms" is 16.2."""
    return value / _scale(unit, unit)


@cache
def _scale(unit: str, name: str) -> float:
    """SI units in one of `unit`."""
    registry = _units()
    try:
        factor, root = registry.get_root_units(registry.parse_units("" if unit == "1" else unit))
    except Exception as error:  # pint raises many kinds, tokenizer errors among them
        raise InputError("data", name, repr(unit), "a unit") from error
    grams = registry.get_dimensionality(root).get("[mass]", 0)  # pint's root of mass is the gram
    scale: float = float(factor) / 1000.0 ** float(grams)
    return scale
