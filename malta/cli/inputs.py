"""What commands read before they begin: design files, the changed machine, published figures, scenarios."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING

from malta.cli.assignments import GENERAL, read_assignments, read_entries
from malta.cli.output import make_console, print_note
from malta.errors import CheckError, InputError
from malta.files import locate, shipped_path
from malta.tables import load_toml

if TYPE_CHECKING:
    from malta.model.plant import Parameters, Plant
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec


LONGEST_NAME = 48  # letters of the changes in the name of a design; more are shortened to a number


def design_files(
    command: str, named: list[Path] | None, *, reverse: bool = False, or_shipped: bool = False
) -> list[Path]:
    """The design files that were named, or all of design/ in alphabetical or reverse order.

    or_shipped : where there is no folder design/ here, those that come with malta

    Data of machines among them are named on the standard error and left out, unless they were named as designs.
    Raises InputError, naming the command, where design/ has none.
    """
    if named:
        return named
    folder = Path("design")
    if or_shipped and not folder.is_dir():
        folder = shipped_path("design")
    files = []
    for file in sorted(folder.glob("*.toml"), reverse=reverse):
        if _is_machine_data(file):
            print_note(f"{file}: data of a machine, no design: left out")
        else:
            files.append(file)
    if not files:
        raise InputError(
            command, "", "no design files (*.toml) here", "a folder design/ with some, or their names"
        )
    return files


def _is_machine_data(file: Path) -> bool:
    """Whether a file has what data of machines have and designs have not; a file that cannot be read is no data."""
    try:
        content = load_toml(file)
    except InputError:
        return False
    return "parameters" in content and not {"weights", "pid", "sample_time"} & set(content)


def gains_folder(design_file: Path) -> Path:
    """Where the gain files of a design go: gains/ beside it; design/gains/ here, where it comes with malta."""
    return design_file.parent / "gains" if locate(design_file) == design_file else Path("design", "gains")


def read_controller(gains: Path, machine_file: Path | None) -> Controller:
    """Read a gain file. `machine_file` models the machine that it names, where that is the user's own.

    Raises InputError as `malta.machine` and `gains.read`; an unknown machine is named with the option that tells it.
    """
    from malta import gains as gain_files
    from malta.model.machines import machine

    if machine_file is not None:
        machine(machine_file)
    return gain_files.read(gains)


def verify_and_write(controller: Controller, gains: Path, folder: Path) -> list[Path]:
    """Verify a controller over the uncertainty of the gain file that it comes from, and write it in all encodings."""
    from malta import gains as gain_files
    from malta.gains.file import content_of
    from malta.tuning.verify import verify

    margins = verify(controller, uncertainty=content_of(gains)[0].uncertainty)
    paths = [folder / f"{controller.name}{suffix}" for suffix in gain_files.SUFFIXES]
    gain_files.write(controller, margins, *paths)
    return paths


def design_of(gains: Path, controller: Controller, named: Path | None) -> Spec | None:
    """The design of a gain file: the file that was named, else NAME.toml beside its folder; None where there is none.

    Raises InputError for a named file that is no design of the machine.
    """
    from malta.synthesis.design_file import read_design

    try:
        spec = read_design(named or gains.parent.parent / f"{controller.name}.toml")
    except InputError:
        if named is None:
            return None
        raise
    own, other = controller.parameters, spec.parameters
    if type(own) is type(other):
        return spec
    if named is None:
        return None
    raise InputError(named, "machine", spec.plant.name, "that of the gain file")


def read_changed_design(file: Path, changes: list[str] | None) -> Spec:
    """Read a design file with `--set NAME=VALUE`: parameters of the machine, and entries of the file.

    The design has a name of its own then, with its changes: `calibrated_m_0_56`.

    Raises InputError for a change of the design's name or machine, and as `read_design` does.
    """
    from dataclasses import replace

    from malta.model.parameters import units_of
    from malta.synthesis.design_file import read_design
    from malta.synthesis.design_tables import DesignFile

    spec = read_design(file)
    if not changes:
        return spec
    units = units_of(spec.parameters)
    of_machine = [text for text in changes if text.partition("=")[0].strip() in units]
    others = read_entries("--set", [text for text in changes if text not in of_machine])
    for name in others:
        if name in ("name", "machine"):
            raise InputError("--set", name, "a change of it", "another design file")
        if name.partition(".")[0] not in DesignFile.model_fields:
            expected = f"one of {' '.join(units)}, or an entry of the design file"
            raise InputError("--set", name, "an unknown parameter", expected)
    values = read_assignments("--set", of_machine, units)
    change_machine(spec.parameters, of_machine)  # which says what is wrong with a value
    changed = read_design(file, values, others)
    return replace(
        changed, name=f"{spec.name}_{_name_of(changes)}", summary=f"{spec.summary}; with {', '.join(changes)}"
    )


def _name_of(changes: list[str]) -> str:
    """The changes as a part of a file's name: `m=.4` is m_0_4, `m=4` is m_4 and `m=4%` m_4percent."""
    words = re.sub(r"(?<!\d)\.(?=\d)", "0.", " ".join(changes)).replace("%", "percent")
    words = re.sub(r"[\u00b5\u03bc]", "u", words)  # micro
    words = re.sub(r"[^A-Za-z0-9-]+", "_", words).strip("_")
    return words if len(words) <= LONGEST_NAME else hashlib.sha256(words.encode()).hexdigest()[:8]


def change_machine(parameters: Parameters, changes: list[str] | None) -> Parameters:
    """Apply `--set NAME=VALUE` to a machine's parameters and name the preset accordingly.

    Raises InputError for an unknown parameter, a value it cannot have, or a machine that cannot be controlled.
    """
    from dataclasses import replace

    from malta.model.data import plant_of
    from malta.model.parameters import units_of

    values = read_assignments("--set", changes, units_of(parameters))
    try:
        preset = f"{parameters.preset}, changed" if values else parameters.preset
        machine = replace(parameters, **values, preset=preset)
        plant_of(machine)
    except InputError as error:
        raise InputError("--set", error.field, error.found, error.expected) from error
    except CheckError as error:
        raise InputError("--set", "", str(error), "a machine that can be controlled") from error
    return machine


def print_scenarios(plant: Plant, *, campaigns: bool = False) -> None:
    """Print the scenarios of a machine: all of them, or those that campaigns can run."""
    from malta import report
    from malta.simulation.catalogue import series_of

    console = make_console()
    console.print(report.scenarios_table(plant, series_of(plant) if campaigns else None))
    console.print("Every scenario takes, as --option NAME=VALUE:")
    for name, option in GENERAL.items():
        console.print(f"  {name:12}  {option.meaning}", highlight=False)
