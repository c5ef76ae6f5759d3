"""The data file of a machine that was identified: parameters with intervals, where they come from, and read back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.files import require_suffix
from malta.model.data import MachineFile, read
from malta.model.machines import file_of
from malta.model.parameters import twins_of, units_of, values_of
from malta.tables import load_toml, validate
from malta.units import to_si
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.identification.identify import Identified


def write_data(found: Identified, path: str | Path, *, gains: str, known: Mapping[str, float]) -> Path:
    """Write the parameters of a machine that was identified as a data file.

    Each identified parameter has the tag "identified", its 95 % interval, and the log with its sha256 as its source;
    the others have the values of the gain file.

    found : what was identified
    path : of the file, as robust-identified.toml
    gains : the gain file, for the sources
    known : parameters that the user knew, SI

    Returns the path. Raises InputError for another suffix, and a file that cannot be written.

        write_data(found, "robust-identified.toml", gains="design/gains/robust.json", known={})
    """
    path, par = require_suffix(Path(path), ".toml"), found.plant.parameters
    units, values = units_of(par), values_of(par)
    module = file_of(found.plant.name)
    machine = found.plant.name if module is None else str(Path(module).resolve())
    source = f"log {found.log.source}, sha256 {found.log.sha256 or 'of no file'}"
    lines = [
        f"# Identified from {found.log.source}. The interval of a parameter holds it with 95 %, each by itself;",
        f"# a box {found.joint:.3g} times as wide holds all of them together.",
        "",
        f"machine = {_text(machine)}",
        "",
        "[identified]",
        f"log = {_text(found.log.source)}",
        f"sha256 = {_text(found.log.sha256)}",
        f"chi2 = {found.chi2:.6g}",
        f"joint = {found.joint:.6g}",
        f"names = [{', '.join(map(_text, found.names))}]",
        "correlation = [",
        *(f"    [{', '.join(f'{c:.6g}' for c in row)}]," for row in found.correlation.tolist()),
        "]",
        "",
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


def _text(value: str) -> str:
    """A text as TOML."""
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


class IdentifiedData(NamedTuple):
    """A data file of an identified machine.

    parameters : the machine's record, SI
    shares : by parameter: half of its interval as a share of its value
    joint : times the intervals: the box that holds all parameters together with 95 %
    """

    parameters: Any
    shares: dict[str, float]
    joint: float


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
    return IdentifiedData(parameters, shares, content.identified.joint)
