"""The parameters of a machine: fields of a frozen dataclass with SI units and ranges. Fingerprints of records."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, field, fields, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

from malta.display import quantity
from malta.errors import InputError


class Parameters(Protocol):
    """A frozen dataclass whose physical fields are declared with `parameters.si(unit)`."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __hash__(self) -> int: ...

    @property
    def preset(self) -> str: ...


if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")


def si(
    unit: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    twin: str | None = None,
    shapes: bool = False,
    default: float | None = None,
) -> Any:
    """Declare a parameter of a machine: a field of its frozen dataclass Parameters.

    unit : the SI unit, "1" for a pure number; with words before it in brackets, as "magnet stiffness [N/m]"
    above : the lower limit of the value, exclusive
    at_least : the lower limit of the value, inclusive
    below : the upper limit of the value, exclusive
    twin : the name of another parameter; where both have the same value, symbolic models use one symbol for the two
    shapes : the parameter sets the size of the model (a delay, a number of harmonics), so it is never a symbol
    default : the value that leaves an effect out, as 0 of a difference. Gain files and manifests do not list a
        parameter with its default, so a machine may get new ones and its old files stay as they are.

    Returns a dataclass field.

    >>> import malta
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Parameters:
    ...     m: float = malta.model.si("mass of the sphere [kg]", above=0)
    ...     C: float = malta.model.si("N m^2/A^2", above=0)  # constant of each magnet
    ...     preset: str = "custom"
    >>> Parameters(m=0.1, C=2e-5)
    Parameters(m=0.1, C=2e-05, preset='custom')
    """
    limits = {"above": above, "at_least": at_least, "below": below}
    words, bracket, rest = unit.rpartition("[")
    unit, words = (rest.rstrip(" ]"), words.strip()) if bracket else (unit, "")
    known = {"unit": unit, "words": words, **limits, "twin": twin, "shapes": shapes}
    if default is None:
        return field(metadata=known)
    return field(default=float(default), metadata=known | {"later": True})


def units_of(record: type[Parameters] | Parameters) -> dict[str, str]:
    """The SI unit of every physical field of a parameter record."""
    return {f.name: f.metadata["unit"] for f in fields(record) if "unit" in f.metadata}


def words_of(record: type[Parameters] | Parameters) -> dict[str, str]:
    """Every physical field with the words that it is declared with before its name: "magnet stiffness K_A".

    >>> from malta.machines.tubular.parameters import Parameters
    >>> words_of(Parameters)["K_A"], words_of(Parameters)["I_max"]
    ('magnet stiffness K_A', 'I_max')
    """
    return {f.name: f"{f.metadata['words']} {f.name}".strip() for f in fields(record) if "unit" in f.metadata}


def later_parameters(record: type[Parameters] | Parameters) -> dict[str, float]:
    """The default values of the parameters that came later, by name: older files do not mention them."""
    return {f.name: float(f.default) for f in fields(record) if f.metadata.get("later")}  # type: ignore[arg-type]


def values_of(record: Parameters) -> dict[str, float]:
    """The values of all parameters by name (SI), without those that came later and have their default values."""
    return {name: getattr(record, name) for name in units_of(record) if not is_default(record, name)}


def twins_of(record: Parameters) -> dict[str, str]:
    """The parameters that share the symbol of another one, {name: twin}: declared twins of equal value."""
    declared = {f.name: f.metadata.get("twin") for f in fields(record)}
    return {k: twin for k, twin in declared.items() if twin and getattr(record, k) == getattr(record, twin)}


def shape_parameters(record: Parameters) -> dict[str, float]:
    """The values of the parameters that set the size of the model, by name: those declared with `shapes`."""
    return {f.name: getattr(record, f.name) for f in fields(record) if f.metadata.get("shapes")}


def symbolic_names(record: type[Parameters] | Parameters) -> list[str]:
    """The names of the parameters that symbolic models hold as symbols: all but those declared with `shapes`."""
    return [f.name for f in fields(record) if "unit" in f.metadata and not f.metadata["shapes"]]


def is_default(record: Parameters, name: str) -> bool:
    """Whether a parameter has the default that its field declares; False for fields without a default."""
    default = next(f.default for f in fields(record) if f.name == name)
    return default is not MISSING and bool(getattr(record, name) == default)


def describe(record: Parameters) -> str:
    """The text of a record, as repr has it, without the parameters that have their defaults."""
    entries = [
        f"{f.name}={getattr(record, f.name)!r}"
        for f in fields(record)
        if "unit" not in f.metadata or not is_default(record, f.name)
    ]
    return f"{type(record).__qualname__}({', '.join(entries)})"


def acting_names(record: Parameters) -> list[str]:
    """The names of the parameters that are symbols in simulations: those of `symbolic_names` without their defaults."""
    given = [f.name for f in fields(record) if f.default is MISSING or getattr(record, f.name) != f.default]
    return [name for name in symbolic_names(record) if name in given]


def check_parameters(record: Parameters, where: str | Path = "parameters") -> None:
    """Check every physical field of a record: call it in `__post_init__` of a machine's Parameters.

    record : a frozen dataclass whose fields are declared with `malta.model.si`
    where : what an error names

    Raises InputError for NaN, infinity and values out of range.

    >>> import malta
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Parameters:
    ...     m: float = malta.model.si("kg", above=0)
    ...     preset: str = "custom"
    >>> malta.model.check_parameters(Parameters(m=0.1), "cart.Parameters")
    >>> malta.model.check_parameters(Parameters(m=-1.0), "cart.Parameters")
    Traceback (most recent call last):
        ...
    malta.errors.InputError: cart.Parameters: m: found -1.0 kg, expected a finite number above 0 in kg
    """
    for f in fields(record):
        if "unit" in f.metadata:
            check_range(f, getattr(record, f.name), where, f.name)


def check_range(f: Field[Any], value: object, where: str | Path, name: str) -> None:
    """Check one value against the unit and the limits that its field declares.

    where, name : the file and the key that an error names

    Raises InputError for anything but a finite number within the limits.
    """
    unit, above, least = f.metadata["unit"], f.metadata["above"], f.metadata["at_least"]
    below = f.metadata.get("below")
    low = f" above {above:g}" if above is not None else ""
    low = f" of at least {least:g}" if least is not None else low
    high = "" if below is None else f"{' and' if low else ''} below {below:g}"
    real = isinstance(value, Real) and not isinstance(value, bool)
    try:
        number = float(value) if real else math.nan  # type: ignore[arg-type]
    except OverflowError:  # an integer beyond any float
        number = math.inf
    inside = (above is None or number > above) and (least is None or number >= least)
    if not (math.isfinite(number) and inside and (below is None or number < below)):
        found = f"{number} {unit}" if real else repr(value)
        raise InputError(where, name, found, f"a finite number{low}{high} in {unit}")


def replace_fields(record: Record, where: str, fields: Mapping[str, Any]) -> Record:
    """A frozen record with other fields. Raises InputError, named after `where`, for a field that it lacks."""
    known = record.__dataclass_fields__
    for name in fields:
        if name not in known:
            raise InputError(where, name, "a field that it lacks", "one of " + " ".join(known))
    return replace(record, **fields)


def differences(record: type[Parameters] | Parameters) -> dict[str, str]:
    """The SI units of the parameters that scatter about 0, by name: those of either sign with the default 0.

    Such a parameter is a difference or an offset. How far it varies is given in its own unit, not as a share of 0.
    """
    units = {}
    for f in fields(record):
        if "unit" in f.metadata and f.default is not MISSING and f.default == 0:
            above, least = f.metadata["above"], f.metadata["at_least"]
            if all(limit is None or limit < 0 for limit in (above, least)):
                units[f.name] = f.metadata["unit"]
    return units


def box_words(box: Mapping[str, Any], parameters: Parameters | None = None) -> str:
    """An uncertainty in words: parameters with their half ranges, those of one half range together; "" of none.

    box : shares of the parameters; of differences and offsets half ranges in SI; or intervals (low, high), SI
    parameters : of the machine, which tell the two apart; None: all are shares

    >>> box_words({"m": 0.2, "K_A": 0.2, "R": 0.05})
    'm K_A ±20 %, R ±5 %'
    """
    units = {} if parameters is None else differences(parameters)
    known = {} if parameters is None else units_of(parameters)
    together: dict[str, list[str]] = {}
    for name, half in box.items():
        if isinstance(half, tuple | list):
            size = f"{half[0]:.4g} to {half[1]:.4g} {known.get(name, '1')}".removesuffix(" 1")
        else:
            size = f"±{quantity(half, units[name]) if name in units else f'{100 * half:.4g} %'}"
        together.setdefault(size, []).append(name)
    return ", ".join(f"{' '.join(names)} {size}" for size, names in together.items())
