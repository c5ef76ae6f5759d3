"""Trial -> design file: the file that was given with other numbers, all else as it stands."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Item

from malta.synthesis.spec import Spec
from malta.tuning.search import DIGITS, Trial


def design_text(spec: Spec, trial: Trial, target: Path) -> str:
    """Write the text of the design file with the numbers of a trial, for another folder.

    Comments, the order of keys and all other values stay as they stand in spec.path.
    """
    document = tomlkit.parse(spec.path.read_text(encoding="utf-8"))
    document["machine"] = Path(
        os.path.relpath(spec.machine_file.resolve(), target.resolve().parent)
    ).as_posix()
    if spec.pid is None:
        document["delay"] = trial.delay
    for variable, value in zip(spec.search, trial.values, strict=True):
        for entry in variable.entries:
            *tables, name = entry.split(".")
            table: Any = document
            for key in tables:
                table = table[key]
            if isinstance(table[name], dict):
                table[name]["value"] = _number(value)
                table[name]["unit"] = variable.unit
            else:
                table[name] = _number(value)
    return tomlkit.dumps(document)


def _number(value: float) -> Item:
    """A number as the file shall hold it, in as many digits as were tried."""
    return tomlkit.value(f"{value:.{DIGITS}g}")
