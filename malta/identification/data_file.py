"""The data file of a machine that was identified: parameters with intervals, where they come from, and read back."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.files import require_suffix
from malta.identification.unmodelled import Unmodelled
from malta.model.data import MachineFile, UnmodelledTable, read
from malta.model.machines import file_of
from malta.model.parameters import twins_of, units_of, values_of
from malta.tables import load_toml, validate
from malta.units import to_si
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.identification.identified import Identified


def write_data(found: Identified, path: str | Path, *, gains: str, known: Collection[str]) -> Path:
    """Write the parameters of a machine that was identified as a data file.

    Each identified parameter has the tag "identified", its total 95 % interval, and the log with its sha256 as its
    source; the others have the values of the gain file.

    found : what was identified
    path : of the file, as robust-identified.toml
    gains : the gain file, for the sources
    known : names of parameters that the user knew

    Returns the path. Raises InputError for another suffix, and a file that cannot be written.

        write_data(found, "robust-identified.toml", gains="design/gains/robust.json", known=())
    """
    path, par = require_suffix(Path(path), ".toml"), found.plant.parameters
    units, values = units_of(par), values_of(par)
    module = file_of(found.plant.name)
    machine = found.plant.name if module is None else str(Path(module).resolve())
    source = f"log {found.log.source}, sha256 {found.log.sha256 or 'of no file'}"
    lines = [
        f"# Identified from {found.log.source}. The interval of a parameter holds it with 95 %, each by itself, with",
        "# everything else as uncertain as it is; [identified] has the halves that noise alone leaves, SI;",
        f"# a box {found.joint:.3g} times as wide holds all of them together.",
        "",
        f"machine = {_text(machine)}",
        "",
        "[identified]",
        f"log = {_text(found.log.source)}",
        f"sha256 = {_text(found.log.sha256)}",
        f"chi2 = {found.chi2:.6g}",
        f"joint = {found.joint:.6g}",
        f"noise = [{', '.join(f'{half:.6g}' for half in found.half_widths.tolist())}]",
        f"left = {0.0 if found.explanation is None else found.explanation.share:.6g}",
        f"verdict = {_text(found.verdict)}",
        f"names = [{', '.join(map(_text, found.names))}]",
        "correlation = [",
        *(f"    [{', '.join(f'{c:.6g}' for c in row)}]," for row in found.correlation.tolist()),
        "]",
        "",
        *_unmodelled_lines(found),
        "[parameters]",
    ]
    alike = {name: twin for name, twin in twins_of(par).items() if twin in found.names}
    for name, value in values.items():
        which = alike.get(name, name)
        tag, of, interval = "assumed", f"gain file {gains}, preset {par.preset}", ""
        if which in found.intervals:
            low, high = found.intervals[which]
            tag, of, interval = "identified", source, f", interval = [{low!r}, {high!r}]"
        elif name in known:
            of = "known beside the log"
        quoted = f"unit = {_text(units[name])}, tag = {_text(tag)}, source = {_text(of)}"
        lines.append(f"{name} = {{ value = {float(value)!r}, {quoted}{interval} }}")
    replace_files({path: ("\n".join(lines) + "\n").encode()})
    return path


def _unmodelled_lines(found: Identified) -> list[str]:
    """The bound of unmodelled dynamics as TOML."""
    if found.unmodelled is None:
        return []
    u = found.unmodelled
    columns = {"frequency": u.w / (2 * np.pi), "bound": u.bound, "sizes": u.sizes, "shares": u.shares}
    rows = [
        f"{name} = [{', '.join(f'{x:.9g}' for x in values.tolist())}]" for name, values in columns.items()
    ]
    return ["[identified.unmodelled]", *rows, f"between = {_text(u.between)}", ""]


def _text(value: str) -> str:
    """A text as TOML."""
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


class IdentifiedData(NamedTuple):
    """A data file of an identified machine.

    parameters : the machine's record, SI
    shares : by parameter: half of its interval as a share of its value
    joint : times the intervals: the box that holds all parameters together with 95 %
    left : share of the response at the lines that nothing explains
    unmodelled : a bound of the dynamics that the machine lacks; None: the file has none
    """

    parameters: Any
    shares: dict[str, float]
    joint: float
    left: float = 0.0
    unmodelled: Unmodelled | None = None


def read_identified(path: str | Path) -> IdentifiedData:
    """Read a data file that `malta identify` wrote, for a proof over its intervals.

    Raises InputError as `malta.read`, and for a file without intervals, or one whose interval is not about its value.

        data = read_identified("robust-identified.toml")
    """
    path = Path(path)
    parameters = read(path)
    content = validate(MachineFile, load_toml(path), path)
    units, alike = units_of(parameters), twins_of(parameters)
    shares: dict[str, float] = {}
    for name, entry in content.parameters.items():
        if entry.interval is None or name in alike:
            continue
        value = float(getattr(parameters, name))
        ends = [to_si(end, entry.unit, units[name], path, f"parameters.{name}") for end in entry.interval]
        if len(ends) != 2 or not ends[0] < value < ends[1]:
            raise InputError(
                path, f"parameters.{name}.interval", str(entry.interval), "[low, high] about the value"
            )
        if value:
            shares[name] = float(np.max(np.abs(np.array(ends) - value))) / abs(value)
    if not shares or content.identified is None:
        raise InputError(
            path, "identified", "nothing", "parameters with an interval, as malta identify writes them"
        )
    of = content.identified
    return IdentifiedData(parameters, shares, of.joint, of.left, _unmodelled_of(of.unmodelled, path))


def _unmodelled_of(table: UnmodelledTable | None, path: Path) -> Unmodelled | None:
    """The bound that a file has. Raises InputError for one that is none."""
    if table is None:
        return None
    columns = (table.frequency, table.bound, table.sizes, table.shares)
    f, bound, sizes, shares = (np.array(column) for column in columns)
    for name, values, count, expected in (
        ("frequency", f, len(f), "rising frequencies above 0"),
        ("bound", bound, len(f), "a bound above 0 for each frequency"),
        ("sizes", sizes, len(sizes), "a size above 0 for each reading"),
        ("shares", shares, len(sizes), "a share above 0 for each reading"),
    ):
        falls = name == "frequency" and (np.diff(values) < 0).any()
        if not len(values) or len(values) != count or falls or not (values > 0).all():
            raise InputError(path, f"identified.unmodelled.{name}", "other numbers", expected)
    return Unmodelled(2 * np.pi * f, bound, sizes, shares, table.between)
