"""What commands read before they begin: design files, the changed machine, published figures, scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from malta.cli.assignments import read_assignments
from malta.cli.output import make_console, print_note
from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from malta.model.plant import Parameters, Plant


def design_files(command: str, named: list[Path] | None, *, reverse: bool = False) -> list[Path]:
    """The design files that were named, or all of design/ in alphabetical or reverse order.

    Raises InputError, naming the command, where design/ has none.
    """
    files = named or sorted(Path("design").glob("*.toml"), reverse=reverse)
    if not files:
        raise InputError(
            command, "", "no design files (*.toml) here", "a folder design/ with some, or their names"
        )
    return files


def change_machine(parameters: Parameters, changes: list[str] | None) -> Parameters:
    """Apply `--set NAME=VALUE` to a machine's parameters and name the preset accordingly.

    Raises InputError for an unknown parameter, a value it cannot have, or a machine that cannot be controlled.
    """
    from dataclasses import replace

    from malta.model.data import plant_of, units_of

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


def published_figures(machine: str) -> dict[str, Any] | None:
    """The figures that a machine's paper prints; None, and a note, where the working folder has no data/ of it."""
    from malta.model.data import published

    file = Path("data") / f"{machine}.toml"
    printed = file.parent / "published" / file.name
    if printed.exists():
        return published(file)
    print_note(f"no {printed} here: published figures are left out")
    return None


def print_scenarios(plant: Plant, *, campaigns: bool = False) -> None:
    """Print the scenarios of a machine: all of them, or those that campaigns can run."""
    from malta import report
    from malta.simulation.experiments import said

    make_console().print(report.scenarios_table(plant, said(plant, "CASES", {}) if campaigns else None))
