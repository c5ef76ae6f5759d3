"""The files of a design under edit: what stands in them, what an edit makes of them, and how they are written again.

A design that is edited and a design that is saved go the same way: the content of the files with other numbers, read by
synthesis.design_file. What the page shows is thus what `malta design` makes of the saved file, to the bit.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from malta.app.fields import MACHINE, Field, check_value, fields_of
from malta.errors import InputError
from malta.model.parameters import check_range
from malta.synthesis.design_file import resolve_published, spec_of
from malta.synthesis.spec import integral_signals
from malta.tables import load_toml
from malta.units import to_si

if TYPE_CHECKING:
    from malta.model.plant import Parameters
    from malta.synthesis.spec import Spec

Value = float | int | bool | str


@dataclass(frozen=True)
class Edit:
    """Other values for some fields of a design, in the units of its files.

    values : by key, as "bases.state.x" or "machine.m"
    redesign : whether the controller is designed for the machine's other parameters; else the machine alone has them
    """

    values: Mapping[str, Value] = field(default_factory=dict)
    redesign: bool = True

    @property
    def design(self) -> dict[str, Value]:
        """The values of the design file."""
        return {key: value for key, value in self.values.items() if not key.startswith(MACHINE)}

    @property
    def machine(self) -> dict[str, Value]:
        """The values of the machine's parameters, by name."""
        return {k.removeprefix(MACHINE): v for k, v in self.values.items() if k.startswith(MACHINE)}


class Edited(NamedTuple):
    """A design with an edit: what is designed, and the parameters of the machine that it runs on."""

    spec: Spec
    truth: Parameters


@dataclass(frozen=True, eq=False)
class DesignFiles:
    """A design file and its machine's data file, as they stand."""

    path: Path
    raw: Mapping[str, Any]  # the design file, as TOML gives it
    machine_raw: Mapping[str, Any]
    spec: Spec

    @cached_property
    def content(self) -> dict[str, Any]:
        """The design file with its published numbers."""
        return resolve_published(self.raw, self.path)

    @cached_property
    def fields(self) -> dict[str, Field]:
        """What can be edited, by key."""
        return {f.key: f for f in fields_of(self)}

    def expand(self, table: str) -> dict[str, Any]:
        """A table that stands as "SI" or as a published one, with an entry for every signal."""
        node: Any = self.content
        for name in table.split("."):
            node = node[name]
        if node != "SI":
            return copy.deepcopy(dict(node))
        plant, weights = self.spec.plant, self.spec.weights
        signals = {
            "bases.state": plant.design_states,
            "bases.input": plant.inputs,
            "bases.integral": integral_signals(plant, weights.coordinates),
        }[table]
        return {s.name: {"value": 1.0, "unit": s.unit} for s in signals}

    def machine_entry(self, name: str) -> dict[str, Any] | None:
        """The entry of a parameter in the data file: of the design's preset, else of all; None: the default."""
        preset = self.machine_raw.get("presets", {}).get(self.spec.parameters.preset, {})
        found: dict[str, Any] | None = preset.get(name, self.machine_raw.get("parameters", {}).get(name))
        return found

    def edit(self, values: object, *, redesign: object = True) -> Edit:
        """The edit that a client sent, without values that are those of the files.

        Raises InputError for keys that are no fields, and for values of another kind.
        """
        where = self.path.name
        if not isinstance(values, Mapping) or not isinstance(redesign, bool):
            raise InputError(where, "edit", "another kind of document", "values by key, and redesign")
        checked: dict[str, Value] = {}
        for key, value in values.items():
            if key not in self.fields:
                raise InputError(where, str(key), "an unknown entry", "a field of the page")
            found = check_value(self.fields[key], value, where)
            if found != self.fields[key].value:
                checked[key] = found
        return Edit(checked, redesign)

    def apply(self, edit: Edit) -> Edited:
        """Read the design with an edit. Raises InputError, as `read_design`, for what no design file may have."""
        own = self.spec.parameters
        truth = self._parameters(edit) if edit.machine else own
        spec = spec_of(edited_content(self, edit), self.path, truth if edit.redesign else own)
        return Edited(spec, truth)

    def _parameters(self, edit: Edit) -> Parameters:
        """The machine's parameters with an edit, in SI and within their limits."""
        own: Any = self.spec.parameters
        changed = {}
        for f in fields(own):
            if f.name in edit.machine:
                unit, si, value = self.fields[MACHINE + f.name].unit, f.metadata["unit"], edit.machine[f.name]
                assert not isinstance(value, str)
                changed[f.name] = (
                    to_si(value, unit, si, self.spec.machine_file.name, f.name) if unit else value
                )
                check_range(f, changed[f.name], self.spec.machine_file.name, f.name)
        made: Parameters = replace(own, **changed)
        return made


def open_design(path: Path, spec: Spec | None = None) -> DesignFiles:
    """Read a design file to edit it. Raises InputError as `read_design`."""
    raw = load_toml(path)
    spec = spec_of(raw, path) if spec is None else spec
    return DesignFiles(path, raw, load_toml(spec.machine_file), spec)


def fingerprint(spec: Spec, truth: Parameters) -> str:
    """Everything that a design and its machine are, but for their places: a proof of another text is of another design.

    spec, truth : as in `Edited`
    """
    numbers = asdict(spec) | {"path": "", "machine_file": ""}
    return json.dumps([numbers, asdict(truth), type(truth).__module__], default=_plain, sort_keys=True)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def edited_content(files: DesignFiles, edit: Edit) -> dict[str, Any]:
    """The content of the design file with an edit."""
    content = copy.deepcopy(dict(files.raw))
    for key, value in edit.design.items():
        set_entry(content, key, value, files)
    return content


def set_entry(content: Any, key: str, value: Value, files: DesignFiles) -> None:
    """Put a value into the content of a design file, a dict or a document of tomlkit; its unit stays.

    A table that stands as "SI" or as a published one is written out before.
    """
    *tables, name = key.split(".")
    node: Any = content
    for k, table in enumerate(tables):
        if not isinstance(node[table], Mapping) or "published" in node[table]:
            node[table] = files.expand(".".join(tables[: k + 1]))
        node = node[table]
    if isinstance(node.get(name), Mapping):
        node[name]["value"] = value
    else:
        node[name] = value
