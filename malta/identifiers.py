"""Identifiers of figures, for the keys of JSON documents: a name with its SI unit at the end, as `rise_s`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache

# Units that are not a prefix before an SI unit, in SI; shares are numbers: 0.01 is 1 %.
_OTHERS = {
    "": "", "1": "", "percent": "share", "%": "share", "g": "kg", "kg": "kg", "deg": "rad", "degree": "rad",
    "turn": "rad", "revolution": "rad", "rpm": "rad_per_s", "min": "s", "minute": "s", "inch": "m", "in": "m",
}  # fmt: skip
_SI = ("m", "s", "A", "rad", "Hz", "N", "J", "W", "V", "ohm", "Ohm", "H", "F", "Wb", "T", "K")
_PREFIXES = "nuµμmckM"


@cache
def unit_suffix(unit: str) -> str:
    """The SI unit of a figure that is shown in `unit`, as the end of an identifier; "" of a plain number.

    >>> [unit_suffix(unit) for unit in ("ms", "um/N", "m/s^2", "N m", "percent", "1")]
    ['s', 'm_per_N', 'm_per_s2', 'N_m', 'share', '']
    """
    if unit in _OTHERS:
        return _OTHERS[unit]
    parts = re.findall(r"[^\W\d]+|\d+|/|-", unit)
    words = ["per" if part == "/" else _in_si(part) for part in parts]
    return re.sub(r"_(?=\d)|(?<=_)_", "", "_".join(word for word in words if word))


def _in_si(name: str) -> str:
    """A unit without its prefix."""
    if name in _SI or name.isdigit():
        return name
    if name in _OTHERS:
        return _OTHERS[name]
    return name[1:] if name[:1] in _PREFIXES and name[1:] in _SI else name


def identifier(label: str, unit: str) -> str:
    """The key of a figure in a JSON document: the words of its label, then its SI unit.

    A range in per cent at the end of a label, as that of a rise, is left out.

    >>> identifier("rise, 10-90 %", "ms"), identifier("deviation x1", "um"), identifier("overshoot", "percent")
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
