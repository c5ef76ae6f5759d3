"""Machine data: TOML files into parameter records, in SI units, each value with its source.

    data/tubular.toml -> read() -> the Parameters record of the machine that the file names

A parameter stands in the file as `{ value = 0.360, unit = "kg", tag = "printed", source = "Table IV" }`.
`tag` says how far to trust it: printed (in the source), computed (from what is printed), assumed (ours)
or identified (from a log, with its 95 % interval). The unit may be any of the right dimension; it is converted to SI
here.
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

from pydantic import Field as Checked, StrictStr

from malta.errors import InputError
from malta.files import locate
from malta.model.machines import machine, machine_names, parameters_record
from malta.model.parameters import check_range
from malta.tables import Finite, Quantity, Record, entry, load_toml, validate
from malta.units import to_si


class Sourced(Quantity):
    """A quantity with its source and how far to trust it."""

    tag: Literal["printed", "computed", "assumed", "identified"] = entry(
        "how far to trust it: in the source, from what the source prints, ours, or from a log"
    )
    source: StrictStr = entry("where the number comes from")
    interval: list[Finite] | None = entry(
        "low and high end of the 95 % interval, in the unit beside the value", default=None
    )


class UnmodelledTable(Record):
    """A bound of the dynamics that an identified machine lacks: of (Y - G I) over G I, readings over their sizes."""

    frequency: list[Finite] = entry("of the excited lines, Hz")
    bound: list[Finite] = entry("of the deviation there, beside noise, with 95 % at all lines")
    sizes: list[Finite] = entry("of the readings, SI")
    shares: list[Finite] = entry("of the bound, by which each reading may deviate")
    between: StrictStr = entry("why the bound does not hold between lines", default="")


class IdentifiedTable(Record):
    """What a data file says of the identification that its parameters come from."""

    log: StrictStr = entry("the log")
    sha256: StrictStr = entry("of the log's file")
    chi2: Finite = entry("of the residuals over their degrees of freedom")
    joint: Finite = entry("times the intervals: the box that holds all parameters together with 95 %")
    names: list[StrictStr] = entry("the identified parameters")
    noise: list[Finite] = entry("by parameter: half of the interval that noise alone leaves, SI", default=[])
    left: Finite = entry("share of the response at the lines that nothing explains", default=0.0)
    verdict: StrictStr = entry("what explains the log, and whether S is as predicted", default="")
    correlation: list[list[Finite]] = entry("of the parameters, in the order of names")
    unmodelled: UnmodelledTable | None = entry("a bound of the dynamics that the machine lacks", default=None)


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

    Raises InputError, which names file and field, for a missing, unknown or doubled key, an unknown preset, and a
    machine that is unknown or cannot be imported. It also refuses a wrong unit, NaN, and a value out of range.

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
