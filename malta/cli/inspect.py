"""`malta inspect`: what a machine declares, and whether its linear model is the machine's."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import DESIGNS, AsJson, MachineFile, is_machine_data, read_controller
from malta.cli.output import make_console, print_document, print_line, print_note
from malta.errors import InputError, shorten
from malta.files import locate
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.model.plant import Plant


def inspect(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A machine's module, its data file, a design or a gain file."),
    ],
    machine_file: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Look at what a machine declares: does it act, do its parts agree, is its linear model the machine's at rest.

    A line for each thing to change; exit code 1 where nothing is proven because of it.

    \b
    Example:  malta inspect rotor.py
    """
    from malta.cli.documents.others import InspectOutput, InspectRow
    from malta.model.inspection import inspect as look

    found = look(_plant_of(file, machine_file))
    if as_json:
        rows = [InspectRow(**row._asdict()) for row in found.rows]
        print_document(
            InspectOutput(
                machine=found.machine, proves=found.proves, rows=rows, switches=list(found.switches)
            )
        )
    else:
        console = make_console()
        for row in found.rows:
            print_line(console, f"{row}{'; nothing is proven' * row.unproven}")
        for text in found.switches:
            print_line(console, f"nearest switch, {text}")
        print_line(
            console, f"{found.machine}: {'proofs hold of it' if found.proves else 'nothing is proven of it'}"
        )
    raise typer.Exit(0 if found.proves else 1)


def _plant_of(file: Path, machine_file: Path | None) -> Plant:
    """The machine of a module, whose data file stands beside it, of a data file, a design or a gain file."""
    from malta.model.data import read
    from malta.model.machines import machine
    from malta.model.plants import plant_of
    from malta.synthesis.design_file import read_design

    if machine_file is not None:
        machine(machine_file)
    path = locate(file)
    if path.suffix == ".py":
        machine(path)
        path = path.with_suffix(".toml")
        if not path.exists():
            raise InputError(path, "", "no such file", f"the data of {file} beside it")
    if path.suffix not in DESIGNS:
        return plant_of(read_controller(path, None).parameters)
    return plant_of(read(path)) if is_machine_data(path) else read_design(path).plant


def note_machine(plant: Plant) -> None:
    """Say once for each source of a machine's own file what makes nothing proven of it, on standard error."""
    from malta.model.machines import sources_of
    from malta.model.soundness import unproven
    from malta.simulation.engine.compiled import cache_folder, open_private

    sources = sources_of(plant.name)
    if not sources:
        return
    key = hashlib.sha256("\n".join((*sources.values(), repr(plant.parameters))).encode()).hexdigest()
    try:
        folder = open_private(cache_folder())
        seen = None if folder is None else folder / f"{key}.inspected"
        if seen is not None and seen.exists():
            return
        if why := unproven(plant, tuple(plant.at().x.tolist())):
            print_note(shorten(f"{plant.name}: nothing is proven of it: {why}; malta inspect says more"))
        if seen is not None:
            replace_files({seen: b""})
    except OSError:
        return
