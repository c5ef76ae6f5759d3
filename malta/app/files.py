"""The files of a design under edit: what stands in them, what an edit makes of them, and how they are written again.

A design that is edited and a design that is saved go the same way: the content of the files with other numbers, read by
synthesis.design_file. What the page shows is thus what `malta design` makes of the saved file, to the bit.
"""

from __future__ import annotations

import copy
import os
import re
import subprocess
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit

from malta.app.fields import MACHINE, PageField, check_value, fields_of
from malta.errors import CheckError, InputError
from malta.files import file_exists
from malta.gains import SUFFIXES
from malta.model.fingerprint import fingerprint as record_fingerprint
from malta.model.parameters import check_range
from malta.model.plant import Parameters
from malta.processes import environment, python_module
from malta.synthesis.design_file import resolve_published, spec_of
from malta.synthesis.spec import Spec, integral_signals
from malta.tables import load_toml
from malta.units import to_si
from malta.writing import replace_files

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
    def fields(self) -> dict[str, PageField]:
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
                raise InputError(where, str(key), "an unknown entry", "a field of the page", self.fields)
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


def is_design(path: Path) -> bool:
    """Whether a TOML file says that it is a design: a machine, and a sample time."""
    try:
        content = load_toml(path)
    except InputError:
        return False
    return "machine" in content and "sample_time" in content


def fingerprint(spec: Spec, truth: Parameters) -> str:
    """Everything that a design and its machine are, but for their places: a proof of another text is of another design.

    spec, truth : as in `Edited`
    """
    nowhere = replace(spec, path=Path(), machine_file=Path())
    return record_fingerprint((nowhere, truth, type(truth).__module__))


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


# Saving a design that was edited: the design file with its comments, its machine's data, and gain files.
#
# Files are written inside the folder that the page was started in, and nowhere else.


NAME = r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}"  # of a design, as design files have it
DESIGN_TIMEOUT = 600  # s, of `malta design`


class TakenError(Exception):
    """Files of these names exist, and nobody said that they may be replaced."""

    def __init__(self, files: list[str]) -> None:
        self.files = files
        super().__init__(", ".join(files))


def inside(root: Path, relative: str) -> Path:
    """A path inside a folder. Raises InputError for any other, and for one that links lead away from.

    root : the folder, resolved
    """
    given = Path(relative)
    target = root / given
    usable = not given.is_absolute() and ".." not in given.parts and "\0" not in relative
    try:
        if usable and target.resolve() == target:
            return target
    except (OSError, RuntimeError, UnicodeError):  # links in a loop, no permission, half a letter
        pass
    raise InputError(
        "save", "file", repr(relative), "a file inside the folder that malta app was started in, no link"
    )


def default_file(root: Path, path: Path) -> str:
    """The file that a design is saved as: its own, or one of its name in the folder where it lies outside."""
    here = path.resolve()
    return here.relative_to(root).as_posix() if here.is_relative_to(root) else here.name


def save_design(
    files: DesignFiles, edit: Edit, target: Path, root: Path, *, replace: bool
) -> tuple[DesignFiles, list[str]]:
    """Write the design file of an edit, and beside it the machine's data where the design is for other parameters.

    target : NAME.toml; NAME becomes the design's name
    replace : whether files of these names may be replaced

    Returns the design as it is saved, and the files by their names in `root`. Raises TakenError, and InputError for a
    name that no design may have and a design that cannot be read again.
    """
    if target.suffix != ".toml" or not re.fullmatch(NAME, target.stem):
        raise InputError("save", "name", repr(target.name), "NAME.toml, NAME of letters, digits, - and _")
    moved = bool(edit.machine) and edit.redesign
    data = _data_file(files.spec.machine_file, target, root) if moved else files.spec.machine_file
    texts = {target: design_text(files, edit, target, data)}
    if moved:
        texts[data] = machine_text(files, edit, data)
    names = [inside(root, path.relative_to(root).as_posix()).relative_to(root).as_posix() for path in texts]
    taken = [name for name, path in zip(names, texts, strict=True) if file_exists(path)]
    if taken and not replace:
        raise TakenError(taken)
    before = {path: path.read_bytes() if path.exists() else None for path in texts}
    replace_files({path: text.encode() for path, text in texts.items()})
    try:
        saved = open_design(target)
        _require_same(files, edit, saved.spec)
    except (InputError, CheckError):
        for path, old in before.items():
            path.unlink() if old is None else path.write_bytes(old)
        raise
    return saved, names


def _data_file(machine_file: Path, target: Path, root: Path) -> Path:
    """Where other parameters of a machine are saved: beside its data; beside the design where these lie outside."""
    beside = machine_file.resolve().parent
    folder = beside if beside.is_relative_to(root) else target.parent
    return folder / f"{target.stem}_machine.toml"


def design_text(files: DesignFiles, edit: Edit, target: Path, data: Path) -> str:
    """The text of the design file with an edit; comments, order and all other values stay."""
    document: Any = tomlkit.parse(files.path.read_text(encoding="utf-8"))
    for key, value in edit.design.items():
        set_entry(document, key, value, files)
    if data != files.spec.machine_file:  # what the machine's papers print does not come along
        for table in ("weights", "bases", "noise", "pid", "uncertainty"):
            if table in document:
                document[table] = _without_references(document[table], files.content[table])
    document["name"] = target.stem
    document["machine"] = Path(os.path.relpath(data.resolve(), target.parent)).as_posix()
    return tomlkit.dumps(document)


def _without_references(node: Any, content: Any) -> Any:
    """A table in which published numbers stand for every `{ published = "..." }`."""
    if not isinstance(node, Mapping):
        return node
    if set(node) == {"published"}:
        return content
    table: Any = node
    for name in list(node):
        plain = _without_references(node[name], content[name])
        if plain is not node[name]:
            table[name] = plain
    return table


def machine_text(files: DesignFiles, edit: Edit, data: Path) -> str:
    """The text of the machine's data file with the parameters of an edit, for another folder."""
    old = files.spec.machine_file
    document: Any = tomlkit.parse(old.read_text(encoding="utf-8"))
    preset = document.get("presets", {}).get(files.spec.parameters.preset, {})
    for name, value in edit.machine.items():
        if name in preset or name in document["parameters"]:
            entry = preset[name] if name in preset else document["parameters"][name]
            entry["value"] = value
            entry["tag"], entry["source"] = "assumed", "changed in malta app"
            entry.pop("interval", None)
        else:
            unit = files.fields[MACHINE + name].unit or "1"
            made = {"value": value, "unit": unit, "tag": "assumed", "source": "changed in malta app"}
            inline = tomlkit.inline_table()
            inline.update(made)
            document["parameters"][name] = inline
    if str(document["machine"]).endswith(".py"):
        module = (old.parent / str(document["machine"])).resolve()
        document["machine"] = Path(os.path.relpath(module, data.parent)).as_posix()
    return tomlkit.dumps(document)


def _require_same(files: DesignFiles, edit: Edit, saved: Spec) -> None:
    """Raise CheckError unless the saved files hold the edited design, number by number."""
    wanted = files.apply(edit).spec
    content = tomllib.loads(saved.path.read_text(encoding="utf-8"))
    mine = edited_content(files, edit)
    same = saved.parameters == wanted.parameters and all(
        content.get(key) == value for key, value in mine.items() if not isinstance(value, Mapping | str)
    )
    fields = wanted.law.__dataclass_fields__
    if not same or any(repr(_plain_field(wanted.law, f)) != repr(_plain_field(saved.law, f)) for f in fields):
        raise CheckError(
            f"{saved.path.name}: the saved design differs from the one on the page; nothing was written"
        )


def _plain_field(law: Any, name: str) -> Any:
    value = getattr(law, name)
    return value.tolist() if hasattr(value, "tolist") else value


def save_gains(design: Path, root: Path, machine: Path | None, *, replace: bool) -> list[str]:
    """Run `malta design` on a saved design file: the same checks, the same gain files.

    replace : whether gain files of its name may be replaced

    Returns the files by their names in `root`. Raises TakenError, and CheckError with the sentence of `malta design`
    when it refuses.
    """
    gains = inside(root, (design.parent / "gains").relative_to(root).as_posix())
    written = [gains / f"{design.stem}{suffix}" for suffix in SUFFIXES]
    taken = [path.relative_to(root).as_posix() for path in written if file_exists(path)]
    if taken and not replace:
        raise TakenError(taken)
    options = ["--out", str(gains), "--figures", str(inside(root, "build")), "--json"]
    command = python_module("malta", "design", str(design), *options)
    own = environment(**({"MALTA_MACHINE": str(machine.resolve())} if machine else {}))
    try:
        done = subprocess.run(
            command, cwd=root, env=own, capture_output=True, text=True, timeout=DESIGN_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise CheckError(
            f"malta design took more than {DESIGN_TIMEOUT:g} s and was ended; old gain files stand"
        ) from error
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"malta design ended with code {done.returncode}"]
        raise CheckError(said[-1].removeprefix("malta: "))
    return [path.relative_to(root).as_posix() for path in written]
