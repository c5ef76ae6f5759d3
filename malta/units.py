"""Units: quantities, as a mass in g, converted to SI, as kg, when they are read, and back when they are shown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from malta.errors import InputError

# The units of machine data, as pint reads them. Angle is a dimension of its own: libraries that take a radian as 1
# accept Hz for rad/s, an error of 2 pi.
UNITS = """
pico- = 1e-12 = p-
nano- = 1e-9 = n-
micro- = 1e-6 = u- = µ- = μ-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
gram = [mass] = g
meter = [length] = m = metre
second = [time] = s
ampere = [current] = A
radian = [angle] = rad
kelvin = [temperature] = K
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
coulomb = ampere * second = C
pascal = newton / meter ** 2 = Pa
bar = 1e5 * pascal
liter = 1e-3 * meter ** 3 = l = litre
percent = 0.01
"""
# Units of deviations.
FINE_UNITS: Mapping[str, str] = {"m": "um", "rad": "urad", "V": "mV", "A": "mA", "T": "mT", "K": "mK"}


@cache
def _units() -> Any:
    import pint  # here, because `malta --help` must not wait for it

    registry: Any = pint.UnitRegistry(None)
    registry.load_definitions(UNITS.strip().splitlines())
    return registry


# pint evaluates numbers and powers of powers, so that a short text could keep it busy for ever. It gets products of
# names and 1 with powers of one digit, in few parentheses: "kg m^2", "N m / (rad/s)", "1/s".
MAX_UNIT_LENGTH = 200  # characters
MAX_NESTING = 3  # parentheses in parentheses
MAX_FACTOR = 1e100  # of SI units
_FACTOR = r"(?:[^\W\d_]{1,30}|1|%)(?:\s*(?:\^|\*\*)\s*-?[1-9])?"
_PRODUCT = rf"\s*{_FACTOR}(?:(?:\s*[*/]\s*|\s+){_FACTOR})*\s*"


def _is_unit(text: str) -> bool:
    """Whether a text has the form of a unit, whatever its names mean; no text at all is the unit of a plain number."""
    if len(text) > MAX_UNIT_LENGTH:
        return False
    for _ in range(MAX_NESTING):
        text = re.sub(rf"\({_PRODUCT}\)", "group", text)
    return not text.strip() or re.fullmatch(_PRODUCT, text) is not None


# The symbols that nearly every file has, as UNITS defines them, for which nobody waits for pint: by scales of which the
# root units of gram, meter, second, ampere, radian and kelvin are a product, and by the powers of these.
_PREFIXES = {
    "p": 1e-12,
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "m": 1e-3,
    "c": 1e-2,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
}
_ROOTS = ("gram", "meter", "second", "ampere", "radian", "kelvin")
_KILO = ((1e3, 1),)
_Symbol: TypeAlias = tuple[tuple[tuple[float, int], ...], tuple[int, ...]]
_SYMBOLS: dict[str, _Symbol] = {
    "g": ((), (1,)),
    "m": ((), (0, 1)),
    "s": ((), (0, 0, 1)),
    "A": ((), (0, 0, 0, 1)),
    "rad": ((), (0, 0, 0, 0, 1)),
    "Hz": ((), (0, 0, -1)),
    "N": (_KILO, (1, 1, -2)),
    "J": (_KILO, (1, 2, -2)),
    "W": (_KILO, (1, 2, -3)),
    "V": (_KILO, (1, 2, -3, -1)),
    "H": (_KILO, (1, 2, -2, -2)),
    "Wb": (_KILO, (1, 2, -2, -1)),
    "T": (_KILO, (1, 0, -2, -1)),
    "ohm": (_KILO, (1, 2, -3, -2)),
    "F": (((1e3, -1),), (-1, -2, 4, 2)),
    "K": ((), (0, 0, 0, 0, 0, 1)),
    "C": ((), (0, 0, 1, 1)),
    "Pa": (_KILO, (1, -1, -2)),
    "l": (((1e-3, 1),), (0, 3)),
}
_UNPREFIXED_SYMBOLS: dict[str, _Symbol] = {  # names without a prefix
    "1": ((), ()),
    "%": (((0.01, 1),), ()),
    "percent": (((0.01, 1),), ()),
    "deg": (((0.017453292519943295, 1),), (0, 0, 0, 0, 1)),
    "rpm": (((6.283185307179586, 1), (60.0, -1)), (0, 0, -1, 0, 1)),
}
_TOKEN = r"[()/*]|[^\W\d_]+(?:\^-?\d)?|\S"


def _find_symbol(name: str) -> _Symbol | None:
    """A symbol of the tables, with its prefix as the first scale; None for any other name."""
    found = _SYMBOLS.get(name) or _UNPREFIXED_SYMBOLS.get(name)
    if found is None and name[:1] in _PREFIXES and name[1:] in _SYMBOLS:
        scales, powers = _SYMBOLS[name[1:]]
        return ((_PREFIXES[name[0]], 1), *scales), powers
    return found


def _plain_root_units(unit: str) -> tuple[float, dict[str, int]] | None:
    """Factor and root units of a product of known symbols; None for other names, and for parentheses in parentheses."""
    exponents: dict[str, int] = {}
    sign, group = 1, 1  # of the next factor, and of the parentheses that it stands in
    unit = re.sub(r"\(\s*([^\W\d_]+)\s*\)", r" \1 ", unit)  # a name in parentheses
    for token in re.findall(_TOKEN, re.sub(r"\s*(?:\*\*|\^)\s*", "^", unit)):
        if token == "(":
            if group != 1:
                return None
            group, sign = sign, 1
        elif token in (")", "*", "/"):
            group, sign = (1, 1) if token == ")" else (group, -1 if token == "/" else 1)
        else:
            name, _, power = token.partition("^")
            if _find_symbol(name) is None:
                return None
            exponents[name] = exponents.get(name, 0) + group * sign * int(power or 1)
            sign = 1
    factor, root = 1.0, dict.fromkeys(_ROOTS, 0)
    for name, exponent in exponents.items():
        scales, powers = _find_symbol(name) or ((), ())
        for scale, power in scales if exponent else ():
            factor *= scale ** (power * exponent)
        for base, power in zip(_ROOTS, powers, strict=False):
            root[base] += power * exponent
    return factor, {base: power for base, power in root.items() if power}


@cache
def _root_units(unit: str) -> tuple[float, dict[str, int]]:
    """The factor of a unit, and the powers of the root units."""
    if not _is_unit(unit):
        raise ValueError("a text that is no product of units")
    found = _plain_root_units(unit)
    factor, root = _pint_root_units(unit) if found is None else found
    if not 1 / MAX_FACTOR < factor < MAX_FACTOR:
        raise ValueError("a unit beyond all measure")
    return factor, root


def _pint_root_units(unit: str) -> tuple[float, dict[str, int]]:
    factor, root = _units().get_root_units(_units().parse_units(unit))
    return float(factor), dict(root._units)


def _quote(unit: str) -> str:
    return repr(unit if len(unit) <= 40 else f"{unit[:37]}...")


NO_PREFIX = ("min", "minute")  # which nobody writes with a prefix


def units_like(unit: str, si_unit: str) -> list[str]:
    """Units of the dimension of another, each with one name in the place of one that is like it; for a refusal."""
    from difflib import get_close_matches  # where something is wrong already

    known, others = [], [si_unit]
    columns = [line.split(" = ") for line in UNITS.strip().splitlines()]
    for names in ([column[0] for column in columns], [column[min(2, len(column) - 1)] for column in columns]):
        prefixes = ["", *(name[:-1] for name in names if name.endswith("-"))]
        known += [
            p + name for name in names if name.isalpha() for p in prefixes if not p or name not in NO_PREFIX
        ]
    for token in set(re.findall(r"[^\W\d_]+", unit[:MAX_UNIT_LENGTH])):
        near = get_close_matches(token, known, n=20, cutoff=0.4)
        others += [re.sub(rf"(?<![^\W\d_]){token}(?![^\W\d_])", name, unit) for name in near]
    return [other for other in others if is_unit_of(other, si_unit)]


def is_unit_of(unit: str, si_unit: str) -> bool:
    """Whether a text is a unit of the dimension of another, as "um" of "m"."""
    try:
        return _root_units(unit)[1] == _root_units(si_unit)[1]
    except Exception:  # pint raises many kinds, tokenizer errors among them
        return False


def to_si(value: float, unit: str, si_unit: str, where: str | Path, name: str) -> float:
    """Convert a value to `si_unit` ("kg", "m/s", "N m", ...).

    where, name : the file and the key that an error names

    Units are products of names with powers, as "kg m^2", "N s/m" or "m / (s * A)". Raises InputError for any other
    text, and when the unit is unknown or of another dimension.

    >>> to_si(50, "us", "s", "rotor.toml", "T_s")
    5e-05
    """
    expected = f"a unit of {si_unit}"
    try:
        factor, found_root = _root_units(unit)
    except Exception as error:  # pint raises many kinds, tokenizer errors among them
        raise InputError(where, f"{name}.unit", _quote(unit), expected, units_like(unit, si_unit)) from error
    try:
        si_factor, si_root = _root_units(si_unit)
    except Exception as error:  # as above, of what a machine's module declares
        raise InputError(
            where, name, f"{_quote(si_unit)} as its unit in SI", "a unit that malta knows"
        ) from error
    if found_root != si_root:
        if "radian" in si_root and found_root == {key: n for key, n in si_root.items() if key != "radian"}:
            turns = re.sub(r"\b[a-zA-Z]*Hz\b", lambda hertz: f"{hertz[0][:-2]}turn/s", unit)
            expected += f", as {turns}" if turns != unit and is_unit_of(turns, si_unit) else ""
        raise InputError(where, f"{name}.unit", _quote(unit), expected, units_like(unit, si_unit))
    ratio: float = factor / si_factor
    whole = round(1 / ratio) if ratio < 1 else 0
    # Dividing by a power of ten is exact where multiplying is not: 50 us is 5e-05, not 4.9999...e-05.
    return value / whole if whole and abs(whole * ratio - 1) < 1e-12 else value * ratio


def in_unit(value: float, unit: str) -> float:
    """Convert an SI value to a unit of choice.

    value : in SI
    unit : products of names with powers, as "um", "kg m^2", "N s/m" or "m / (s * A)"

    Returns the value in this unit.

    Raises InputError for an unknown unit.

    >>> import malta
    >>> round(malta.model.in_unit(16.2e-3, "ms"), 9)
    16.2
    """
    return value / unit_factor(unit, "unit")


@cache
def unit_factor(unit: str, name: str) -> float:
    """The size of one `unit` in SI units: 0.001 for "ms". Raises InputError, which names the key `name`."""
    try:
        factor, root = _root_units("" if unit == "1" else unit)
        return float(factor / 1000.0 ** float(root.get("gram", 0)))  # the root of mass is the gram
    except Exception as error:  # pint raises many kinds, tokenizer errors among them
        raise InputError("data", name, _quote(unit), "a unit") from error


@cache
def si_unit_of(unit: str) -> str:
    """The SI unit of the dimension of a unit: itself where it is one. Raises InputError for an unknown unit.

    >>> [si_unit_of(unit) for unit in ("mm/s^2", "T", "g", "kHz")]
    ['m/s^2', 'T', 'kg', '1/s']
    """
    if unit_factor(unit, "unit") == 1:
        return unit
    powers = base_exponents(unit)
    above = " ".join(name if power == 1 else f"{name}^{power}" for name, power in powers.items() if power > 0)
    below = [name if power == -1 else f"{name}^{-power}" for name, power in powers.items() if power < 0]
    under = f"({' '.join(below)})" if len(below) > 1 else "".join(below)
    return (above or "1") + (f"/{under}" if under else "")


@cache
def base_exponents(unit: str) -> Mapping[str, int]:
    """The exponents of kg, m, s, A, rad and K in a unit. Raises InputError for an unknown unit.

    >>> base_exponents("N m")
    {'kg': 1, 'm': 2, 's': -2}
    """
    symbols = {"gram": "kg", "meter": "m", "second": "s", "ampere": "A", "radian": "rad", "kelvin": "K"}
    unit_factor(unit, "unit")
    _, root = _root_units("" if unit == "1" else unit)
    powers = {symbols[name]: int(power) for name, power in root.items()}
    return dict(sorted(powers.items()))


# Identifiers of figures, for the keys of JSON documents: a name with its SI unit at the end, as `rise_s`.


# Units that are not a prefix before an SI unit, in SI; shares are numbers: 0.01 is 1 %.
_OTHER_UNITS = {
    "": "", "1": "", "percent": "share", "%": "share", "g": "kg", "kg": "kg", "deg": "rad", "degree": "rad",
    "turn": "rad", "revolution": "rad", "rpm": "rad_per_s", "min": "s", "minute": "s", "inch": "m", "in": "m",
    "bar": "Pa", "mbar": "Pa", "l": "m3", "ml": "m3",
}  # fmt: skip
_SI = ("m", "s", "A", "rad", "Hz", "N", "J", "W", "V", "ohm", "Ohm", "H", "F", "Wb", "T", "K", "C", "Pa")
_PREFIX_LETTERS = "pnuµμmckM"


@cache
def unit_suffix(unit: str) -> str:
    """The SI unit of a figure that is shown in `unit`, as the end of an identifier; "" of a plain number.

    >>> [unit_suffix(unit) for unit in ("ms", "um/N", "m/s^2", "N m", "percent", "1")]
    ['s', 'm_per_N', 'm_per_s2', 'N_m', 'share', '']
    """
    if unit in _OTHER_UNITS:
        return _OTHER_UNITS[unit]
    parts = re.findall(r"[^\W\d]+|\d+|/|-", unit)
    words = ["per" if part == "/" else _in_si(part) for part in parts]
    return re.sub(r"_(?=\d)|(?<=_)_", "", "_".join(word for word in words if word))


def _in_si(name: str) -> str:
    """A unit without its prefix."""
    if name in _SI or name.isdigit():
        return name
    if name in _OTHER_UNITS:
        return _OTHER_UNITS[name]
    return name[1:] if name[:1] in _PREFIX_LETTERS and name[1:] in _SI else name


def identifier(label: str, unit: str) -> str:
    """The key of a figure in a JSON document: the words of its label, then its SI unit.

    A range in per cent at the end of a label, as that of a rise, is left out.

    >>> (
    ...     identifier("rise, 10-90 %", "ms"),
    ...     identifier("deviation x1", "um"),
    ...     identifier("overshoot", "percent"),
    ... )
    ('rise_s', 'deviation_x1_m', 'overshoot_share')
    """
    words = re.findall(r"\w+", re.sub(r",? \d+-\d+ %$", "", label))
    name = "_".join([*words, *filter(None, [unit_suffix(unit)])]) or "figure"
    return name if name.isidentifier() else f"_{name}"


def distinct(names: Iterable[str]) -> list[str]:
    """Names of which the second one of a kind ends in _2, the third one in _3.

    >>> distinct(["rise_s", "rise_s", "force_N"])
    ['rise_s', 'rise_s_2', 'force_N']
    """
    seen: dict[str, int] = {}
    found: list[str] = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return found
