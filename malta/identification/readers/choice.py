"""Which columns of a file are which signals: by their names and units, and by what the user says of them.

A choice is written `NAME=COLUMN:UNIT`, as `y1=CH1:10um/V,i1="Coil current":A`. NAME is a signal's, with its prefix
where its unit does not tell the group (`exc.f_D`); COLUMN is what the file calls it; UNIT is what 1 in the file is,
with a factor where a sensor has one. `x*:um` says the unit of all columns of such names, which keep them.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.identification.readers.raster import GAP, even_times, seconds_of
from malta.identification.readers.raw import GROUPS, Decoded, RawColumn, RawLog, is_unit, plain_unit
from malta.identification.readers.stored import StoredTable, store_columns, store_rows
from malta.units import is_unit_of, to_si, unit_factor

TIMES = (
    "t",
    "time",
    "times",
    "timestamp",
    "timestamps",
    "log time",
    "zeit",
    "x_value",
    "x-axis",
    "datetime",
    "seconds",
)
"""Names of columns of times, in small letters."""
OPTION = "--columns"
SIGNAL_UNITS = (("m", "y"), ("rad", "y"), ("N", "v"), ("N m", "v"), ("A", "i"), ("V", "u"))
MAX_RASTER_DIFFERENCE = 0.01  # of a sample time, between the times of two columns


class Chosen(NamedTuple):
    """One item of `--columns`: the signal ("": as the file), the column or a pattern of names, and what 1 in it is."""

    signal: str
    column: str
    unit: str


@dataclass(frozen=True)
class ColumnChoice:
    """How a log of another program is read.

    columns : the items of `--columns`
    time : the column of times, with its unit: NAME or NAME:UNIT; "": found by its name
    sample_time : s, of a file without times; 0: by its times
    excitation : a file with one period of the excitation, or with all of it; None: its columns are in the log

    >>> choice = ColumnChoice.of('y1=CH1:10um/V,i1="Coil current":A')
    >>> [(one.signal, one.column, one.unit) for one in choice.columns]
    [('y1', 'CH1', '10um/V'), ('i1', 'Coil current', 'A')]
    """

    columns: tuple[Chosen, ...] = ()
    time: str = ""
    sample_time: float = 0.0
    excitation: Path | None = None

    @classmethod
    def of(
        cls, columns: str = "", time: str = "", sample_time: float = 0.0, excitation: str | Path | None = None
    ) -> ColumnChoice:
        """A choice of the texts that a user types. Raises InputError for an item of another form."""
        items = tuple(_item(text) for text in _split(columns, ",") if text.strip())
        names = [one.signal for one in items if one.signal]
        twice = next((name for name in names if names.count(name) > 1), "")
        if twice:
            raise InputError(OPTION, twice, "two columns", "one")
        if not 0 <= sample_time < np.inf:
            raise InputError("--period", "", f"{sample_time:g} s", "a sample time above 0, as 50us")
        return cls(items, time, sample_time, None if excitation is None else Path(excitation))

    @property
    def chosen(self) -> bool:
        """Whether columns or their times are named."""
        return bool(self.columns or self.time or self.sample_time)


def _split(text: str, mark: str) -> list[str]:
    """The parts of a text between marks that stand outside of quotes."""
    return re.findall(rf'(?:"[^"]*"|[^"{mark}]|")+', text)


def _item(text: str) -> Chosen:
    """One item. Raises InputError for another form than NAME=COLUMN:UNIT."""
    found = re.fullmatch(r'\s*(?:([^="]+)=)?\s*("[^"]+"|[^:="]+(?::(?=//)[^:="]+)?)\s*(?::\s*([^:]*))?', text)
    if found is None or (found[1] is None and not found[3]):
        expected = 'NAME=COLUMN:UNIT, as y1=CH1:10um/V or i1="Coil current":A'
        raise InputError(OPTION, "", repr(text.strip()), expected)
    return Chosen((found[1] or "").strip(), found[2].strip().strip('"').strip(), (found[3] or "").strip())


class _UsedColumn(NamedTuple):
    """A column that is used: its number, the signal's heading in malta's words, its group, and what it is times."""

    number: int
    name: str
    unit: str
    group: str
    factor: float


def decode_columns(raw: RawLog, choice: ColumnChoice, groups: Collection[str], path: Path) -> Decoded:
    """The tables of a file by the user's choice, and by names and units of the other columns.

    Raises InputError for a choice of what is not there, for columns without a unit, and for no times.
    """
    time, time_unit = _time_column(raw, choice, path)
    named = _named_places(raw, choice, path)
    hidden = {time, *(column.times for column in raw.columns), *(place.number for place in named)}
    left = [k for k, column in enumerate(raw.columns) if k not in hidden and column.name]
    if not choice.columns:
        _require_units([raw.columns[k] for k in left], path)
    own = {k: _own_place(k, raw.columns[k]) for k in left}
    taken = {(place.group, place.name) for place in named}
    others = [place for place in own.values() if place and (place.group, place.name) not in taken]
    unused = [raw.columns[k].heading for k, place in own.items() if place not in others]
    places = [place for place in (*named, *others) if place.group in groups]
    _require_once(places, path)
    tables, headings, t = _load_tables(raw, places, time, time_unit, choice, path)
    notes = [f"not used: {', '.join(unused)}"] if unused else []
    head = dict(raw.head)
    if choice.sample_time:
        head["sample_time"] = choice.sample_time
    return Decoded(head, t[0], tables, headings, (*notes, *filter(None, [t[1]])))


def _load_tables(
    raw: RawLog, places: Sequence[_UsedColumn], time: int, time_unit: str, choice: ColumnChoice, path: Path
) -> tuple[dict[str, FloatArray], dict[str, list[str]], tuple[FloatArray, str]]:
    """Tables and headings by group, the times and a note about them; all columns are loaded in one pass."""
    rasters = sorted({raw.columns[place.number].times for place in places} - {-1, time})
    wanted = [*([] if time < 0 else [time]), *rasters, *(place.number for place in places)]
    behind = len(wanted) - len(places)
    if raw.long:
        columns: Sequence[FloatArray] = _stored_columns(raw, wanted, path)
    else:
        columns = raw.load(wanted)
    count = {len(column) for column in columns}
    if len(count) > 1:
        sizes = ", ".join(f"{raw.columns[k].name} {len(c)}" for k, c in zip(wanted, columns, strict=True))
        found = f"columns of different rasters: {sizes} samples"
        raise InputError(path, "", found, "one raster for all that are used")
    if count in (set(), {0}):
        raise InputError(
            path, "", "headings alone" if places else "no columns", "a row of numbers for each sample"
        )
    t: FloatArray = np.zeros(0)
    note = ""
    if behind:
        t, note = seconds_of(columns[0], time_unit, _time_factor(time_unit, path))
        for k, other in zip(wanted[1:behind], columns[1:behind], strict=True):
            _require_same_raster(np.ravel(columns[0]), np.ravel(other), raw.columns[k].name, path)
    elif choice.sample_time:
        t = even_times(0.0, choice.sample_time, count.pop())
    tables, headings = dict[str, FloatArray](), dict[str, list[str]]()
    for group in dict.fromkeys(place.group for place in places):
        own = [(place, c) for place, c in zip(places, columns[behind:], strict=True) if place.group == group]
        tables[group] = _table_of([c for _, c in own], [place.factor for place, _ in own])
        headings[group] = [f"{place.name} [{place.unit}]" for place, _ in own]
    return tables, headings, (t, note)


def _stored_columns(raw: RawLog, wanted: Sequence[int], path: Path) -> list[FloatArray]:
    """Columns of a long file, each a table of one column of a file of their numbers."""
    if raw.blocks is not None:
        table = store_rows(raw.blocks(wanted), len(wanted), path)
    else:
        table = store_columns(lambda number: raw.load([number])[0], wanted, path)
    return [cast("FloatArray", table.choose([k])) for k in range(len(wanted))]


def _table_of(columns: Sequence[FloatArray], factors: Sequence[float]) -> FloatArray:
    """Columns side by side, each times a factor."""
    first = columns[0]
    if isinstance(first, StoredTable):
        places = tuple(column.columns[0] for column in columns if isinstance(column, StoredTable))
        return cast("FloatArray", replace(first, columns=places, factors=tuple(factors)))
    table = np.empty((len(first), len(columns)))
    for k, (values, factor) in enumerate(zip(columns, factors, strict=True)):
        table[:, k] = values if factor == 1 else factor * values
    return table


def _time_factor(unit: str, path: Path) -> float:
    return to_si(1.0, unit, "s", path, "t") if unit else 1.0


def _require_same_raster(t: FloatArray, other: FloatArray, name: str, path: Path) -> None:
    """Raise InputError for a column whose times are not those of the first one."""
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    off = float(np.abs(t - other).max()) / step if step else np.inf
    if not off <= MAX_RASTER_DIFFERENCE:
        found = f"times that differ by {off:.3g} samples from those of the first column"
        raise InputError(path, name, found, "one raster for all that are used")


def _time_column(raw: RawLog, choice: ColumnChoice, path: Path) -> tuple[int, str]:
    """The number of the column of times and its unit; -1 where a sample time stands for it."""
    if choice.time:
        column, _, unit = (
            choice.time.rpartition(":") if _has_unit(choice.time, raw) else (choice.time, "", "")
        )
        k = _column(raw, column.strip('" '), "--stamps", path)
        return k, unit or raw.columns[k].unit
    own = [column.times for column in raw.columns if column.times >= 0]
    known = [k for k, column in enumerate(raw.columns) if column.name.lower() in TIMES]
    known += [k for k, c in enumerate(raw.columns[:1]) if c.unit and is_unit_of(plain_unit(c.unit), "s")]
    found = next(iter((*own, *known)), -1)
    if choice.sample_time and not own:
        return -1, ""
    if found < 0 and not raw.head.get("sample_time"):
        first = raw.columns[0].heading if raw.columns else "nothing"
        expected = "a column t [s], --stamps COLUMN, or the sample time as --period 50us"
        raise InputError(path, first, "no column of times", expected)
    return found, plain_unit(raw.columns[found].unit) if found >= 0 else ""


def _has_unit(text: str, raw: RawLog) -> bool:
    """Whether a text ends with ":UNIT", and is not a column's own name."""
    return ":" in text and all(text not in (c.name, c.heading) for c in raw.columns)


def _column(raw: RawLog, wanted: str, where: str, path: Path) -> int:
    """The number of a column by its heading, its name, or the end of its path; InputError for none or several."""
    names = [(c.heading, c.name) for c in raw.columns]
    ways = (
        [wanted in both for both in names],
        [wanted.lower() in (both[0].lower(), both[1].lower()) for both in names],
        [re.split(r"[/\\.]", both[1])[-1] == wanted for both in names],
    )
    for fits in ways:
        found = np.flatnonzero(fits).tolist()
        if len(found) == 1:
            return int(found[0])
        if found:
            raise InputError(
                where, wanted, f"{len(found)} such columns in {path.name}", "one, by its whole name"
            )
    known = [repr(c.name) if " " in c.name else c.name for c in raw.columns if c.name]
    raise InputError(where, wanted, f"no such column in {path.name}", f"one of {' '.join(known)}", known)


def _named_places(raw: RawLog, choice: ColumnChoice, path: Path) -> list[_UsedColumn]:
    """The columns that the user names, each as its signal."""
    places: list[_UsedColumn] = []
    for one in choice.columns:
        if one.signal:
            k = _column(raw, one.column, OPTION, path)
            places.append(_place(k, one.signal, raw.columns[k].unit, one.unit))
            continue
        fitting = [k for k, column in enumerate(raw.columns) if fnmatchcase(column.name, one.column)]
        if not fitting:
            raise InputError(
                OPTION, one.column, f"no such column in {path.name}", "a name, or a pattern as x*"
            )
        for k in fitting:
            own = raw.columns[k]
            places.append(_place(k, own.name, own.unit, one.unit))
    return places


def _place(number: int, name: str, own: str, given: str) -> _UsedColumn:
    """A column as a signal: `own` is the file's unit, `given` what the user says that 1 in it is."""
    factor, unit = _quantity(given) if given else (1.0, plain_unit(own))
    if "/" in unit and own:
        above, _, below = unit.rpartition("/")
        if is_unit_of(plain_unit(own), below) and not is_unit_of(plain_unit(own), unit):
            factor, unit = factor * to_si(1.0, plain_unit(own), below, OPTION, name), above
    elif not given and not is_unit(unit):
        raise InputError(OPTION, name, _unknown(own), "what 1 in it is, as NAME=COLUMN:0.1um", ())
    if "/" in unit and not own and re.fullmatch(r"V|mV|counts?|LSB|digits?|1", unit.rpartition("/")[2]):
        unit = unit.rpartition("/")[0]  # of a file that does not say that it has volts
    unit_factor(unit, f"{OPTION}: {name}")
    group = group_of(name, unit)
    if not group:
        expected = "a prefix that tells the group: y. v. i. u. ref. exc. or flag."
        raise InputError(OPTION, name, f"unit {unit!r}", expected)
    return _UsedColumn(number, name.removeprefix(GROUPS[group] or f"{group}."), unit, group, factor)


def _quantity(text: str) -> tuple[float, str]:
    """Factor and unit of "10um/V" or "A". Raises InputError for a factor that is none."""
    found = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)?\s*(.*)", text)
    factor = float(found[1]) if found and found[1] else 1.0
    unit = found[2].strip() if found else ""
    if not (np.isfinite(factor) and factor) or not unit:
        raise InputError(OPTION, "", repr(text), "what 1 in the column is, as 10um/V or A")
    return factor, plain_unit(unit)


def _unknown(unit: str) -> str:
    return f"unit {unit!r}" if unit else "no unit"


def _require_units(columns: Sequence[RawColumn], path: Path) -> None:
    """Raise InputError for columns without a unit, and for one that nobody knows."""
    lost = [c for c in columns if not is_unit(plain_unit(c.unit)) and not c.name.startswith(GROUPS["flags"])]
    if lost:
        first, more = lost[0], f" and {len(lost) - 1} others" if len(lost) > 1 else ""
        found = f"unit {first.unit!r}" if first.unit else "a heading without unit"
        expected = f'one as "{first.name} [um]", or its unit as --columns "{first.name}:um,i_*:A"'
        raise InputError(path, first.heading + more, found, expected)


def _own_place(number: int, column: RawColumn) -> _UsedColumn | None:
    """A column by its own name and unit; None where it is no signal."""
    unit = plain_unit(column.unit)
    if not is_unit(unit) and not column.name.startswith(GROUPS["flags"]):
        return None
    group = group_of(column.name, unit)
    if not group:
        return None
    name = column.name.removeprefix(GROUPS[group] or f"{group}.")
    return _UsedColumn(number, name, unit if is_unit(unit) else "1", group, 1.0)


def group_of(name: str, unit: str) -> str:
    """The group of a column by its prefix, or by its unit; "" where neither tells one."""
    for group, prefix in GROUPS.items():
        if name.startswith(prefix or f"{group}."):
            return group
    return group_by_unit(unit)


def group_by_unit(unit: str) -> str:
    """The group of a column without a prefix; "" for another unit than those that tell one."""
    return next((group for si_unit, group in SIGNAL_UNITS if is_unit_of(unit, si_unit)), "")


def _require_once(places: Sequence[_UsedColumn], path: Path) -> None:
    """Raise InputError for two columns of one signal."""
    seen: set[tuple[str, str]] = set()
    for place in places:
        if (place.group, place.name) in seen:
            raise InputError(path, place.name, f"two columns of {place.group}", "one")
        seen.add((place.group, place.name))


def excitation_table(
    own: Mapping[str, FloatArray], t: FloatArray, given: Decoded, sample_time: float, path: Path
) -> tuple[FloatArray, float]:
    """The excitation of a file over a log, samples x inputs, and its period, s; 0: the file has it over the whole log.

    A file that is shorter than the log is one period, which begins with the log's first sample.

    own : the log's tables
    given : the excitation's file
    """
    table, count = given.tables.get("excitation", np.zeros((0, 0))), len(t)
    if "excitation" in own:
        raise InputError(path, "exc", "columns of an excitation in the log too", "one of them")
    if not table.size:
        raise InputError(path, "exc", "no excitation", "columns as exc.f_D [N], as malta excite --out writes")
    if len(given.t) > 1:
        step = float(given.t[-1] - given.t[0]) / (len(given.t) - 1)
        if abs(step / sample_time - 1) > GAP * 1e-3:
            raise InputError(path, "t", f"samples of {step:.6g} s", f"those of the log, {sample_time:.6g} s")
    if len(table) >= count:
        return table[:count], 0.0
    k = np.round((t - t[0]) / sample_time).astype(int)
    return np.asarray(table[k % len(table)]), len(table) * sample_time
