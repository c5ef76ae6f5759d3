"""What a log's file holds before its columns are signals: names, units, numbers, as another program wrote them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.units import si_unit_of

GROUPS = {"y": "", "v": "", "i": "", "u": "", "reference": "ref.", "excitation": "exc.", "flags": "flag."}
"""The groups of columns, and what stands before the signal's name in a heading."""


MAX_READING = 1e30  # SI: no reading is beyond it, and squares and sums of those within are numbers


class RawColumn(NamedTuple):
    """A column of a file.

    name : as the file has it, without the unit
    unit : as the file has it; "": it names none
    times : the column with its times, by number; -1: none
    """

    name: str
    unit: str = ""
    times: int = -1

    @property
    def heading(self) -> str:
        """Name and unit, as they are typed."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


class RawLog(NamedTuple):
    """A file of columns: its head, the columns in their order, and how some of them are loaded, in one pass.

    head : machine, controller, and sample_time and period, s, where the file says them
    load : (numbers of columns) -> their values, each a vector of doubles, NaN where nothing stands
    blocks : (numbers of columns) -> their rows by blocks, of a file that has rows; None of others
    long : whether the file is too long for memory: its numbers are kept in a file beside it
    """

    head: Mapping[str, Any]
    columns: Sequence[RawColumn]
    load: Callable[[Sequence[int]], list[FloatArray]]
    blocks: Callable[[Sequence[int]], Iterator[FloatArray]] | None = None
    long: bool = False


class Decoded(NamedTuple):
    """What a log's file holds by group: the head, times, tables and their headings, and what was not used."""

    head: Mapping[str, Any]
    t: FloatArray  # s; empty: the head's sample_time makes them
    tables: Mapping[str, FloatArray]
    headings: Mapping[str, Sequence[str]]
    notes: tuple[str, ...] = ()


_SPELLINGS = {
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("ampere", "amperes", "amp", "amps"), "A"),
    **dict.fromkeys(("second", "seconds", "sec", "secs"), "s"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("degree", "degrees", "\u00b0"), "deg"),
    **dict.fromkeys(("nm", "n*m", "n.m", "n\u00b7m", "newton meter"), "N m"),
    **dict.fromkeys(("milliseconds", "millisecond", "msec"), "ms"),
    **dict.fromkeys(("microseconds", "microsecond", "usec"), "us"),
    **dict.fromkeys(("-", "--", "none", "n/a", "nan", "no_unit", "unknown"), ""),
}
OTHER_UNITS = (
    "degc",
    "\u00b0c",
    "c",
    "k",
    "degf",
    "\u00b0f",
    "celsius",
    "kelvin",
    "bar",
    "mbar",
    "psi",
    "pa",
    "kpa",
    "db",
)
"""Units of what no machine's model has, in small letters: their columns are left out."""


def plain_unit(text: str) -> str:
    """A unit as malta spells it, of one as instruments do: "V" of "Volt", "N m" of "Nm"."""
    text = text.strip().strip('"').strip()
    plain = (
        text.replace("\u00b2", "^2").replace("\u00b3", "^3").replace("\u00b7", " ").replace("\u2126", "ohm")
    )
    key = text.lower()
    return plain if text == "nm" else _SPELLINGS.get(key, plain)  # nm: a nanometre


def is_unit(text: str) -> bool:
    """Whether a text is a unit that malta knows, and no plain number."""
    text = plain_unit(text)
    if not text or text[0].isdigit():
        return text == "1"
    try:
        si_unit_of(text)
    except InputError:
        return text.lower() in OTHER_UNITS
    return True


def heading_parts(heading: str) -> tuple[str, str]:
    """Name and unit of a heading: "x1 [um]", "x1 (um)", "x1 / um" or "x1"; the unit is "" where none stands."""
    heading = heading.strip()
    if found := re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", heading):
        return found[1].strip("_ "), found[2].strip()
    found = re.fullmatch(r"(.*?)\s*\(([^()]*)\)", heading) or re.fullmatch(r"(.*\S)\s+/\s+(\S.*)", heading)
    if found and found[1].strip() and is_unit(found[2]) and not found[2].strip()[0].isdigit():
        return found[1].strip(), found[2].strip()
    return heading, ""


def raw_log(
    head: Mapping[str, Any], columns: Sequence[RawColumn], values: Sequence[Any], path: Path
) -> RawLog:
    """A file whose columns are in memory. Raises InputError where one is no vector of numbers."""

    def load(numbers: Sequence[int]) -> list[FloatArray]:
        return [numbers_of(values[k], columns[k].name, path) for k in numbers]

    return RawLog(head, columns, load)


def numbers_of(values: Any, name: str, path: Path) -> FloatArray:
    """A vector of doubles of what a file holds: numbers, truth values, or instants, s after the first of them."""
    table = np.ravel(np.asarray(values))
    if table.dtype.kind == "M":
        return np.asarray((table - table[:1]).astype("m8[ns]").astype(float) / 1e9)
    if table.dtype.kind not in "fiub":
        raise InputError(path, name, f"an array of {table.dtype}", "numbers")
    if table.dtype.kind in "iu" and table.itemsize == 8 and table.size:
        first = int(table[0])
        if abs(first) > 2**53:  # stamps of nanoseconds, of which a double keeps 256
            return np.asarray((table - table[0]).astype(float))
    return np.asarray(table, dtype=float)


def module(name: str, path: Path | str, package: str, extra: str = "formats") -> Any:
    """A module of an optional package. Raises InputError that says how it is installed."""
    try:
        return import_module(name)
    except ImportError:
        found = f"a {Path(path).suffix or 'such a'} file without {package}"
        expected = f"{package}, as by pip install {package}, or pip install 'malta[{extra}]'"
        raise InputError(path, "", found, expected) from None


def refuse_damage(path: Path, kind: str, error: Exception) -> InputError:
    """The refusal of a file that its library cannot read."""
    if isinstance(error, InputError | CheckError):
        raise error
    return InputError(path, "", f"a damaged file ({type(error).__name__}: {str(error)[:80]})", f"a {kind}")
