"""`malta inspect`: what a machine declares, and whether its linear model is the machine's. `malta new`: a first one."""

from __future__ import annotations

import ast
import hashlib
import keyword
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import DESIGNS, AsJson, MachineFile, is_machine_data, read_controller
from malta.cli.output import make_console, print_document, print_line, print_note, print_written
from malta.errors import InputError, shorten
from malta.files import locate, shipped_path
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


# `malta new`: a folder with a machine of one's own that runs at once.


EXAMPLE = "ball"  # the folder of examples/ that a new machine begins as
NEXT_STEPS = """
Try it, from the folder {name}/:
    malta design
    malta verify design/gains/{name}.json --machine {name}.py
    malta simulate design/gains/{name}.json --machine {name}.py --scenario step --out build
    python notebook.py

Then make it yours:
    {name}.py           parameters with units, and x' = f(x, u, w), y = h(x, u)
    {name}.toml         values, each with its unit and where it comes from
    design/{name}.toml  weights, noise, and how far parameters vary
    test_{name}.py      numbers that you know by another way
"""


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the machine: letters, digits and _.")],
) -> None:
    """Write a folder NAME with a machine that runs at once, a levitated sphere, and say what to change.

    \b
    Example:  malta new rotor
    """
    from malta.model.machines import machine_names

    folder = Path(name)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError("malta new", "NAME", repr(name), "small letters, digits and _, as rotor")
    if name in machine_names():
        raise InputError(
            "malta new", "NAME", repr(name), "another name than that of a machine that malta has"
        )
    if folder.exists():
        raise InputError(folder, "", "a file or folder of that name", "a name that is free here")
    source = shipped_path("examples", EXAMPLE)
    files = [
        path for path in sorted(source.rglob("*")) if path.suffix in (".py", ".toml") and _is_source(path)
    ]
    if name in _taken_names(files):
        found = f"{name!r}, which Python, the module or the notebook has for something else"
        raise InputError("malta new", "NAME", found, "another name")
    renamed = {
        folder / path.relative_to(source).with_name(path.name.replace(EXAMPLE, name)): path for path in files
    }
    replace_files(
        {
            target: re.sub(
                rf"(?<![A-Za-z]){EXAMPLE}(?![A-Za-z])", name, path.read_text(encoding="utf-8")
            ).encode()
            for target, path in renamed.items()
        }
    )
    console = make_console()
    print_written(console, renamed)
    console.print(NEXT_STEPS.format(name=name), soft_wrap=True)  # commands stay whole, to be copied


def _taken_names(files: Sequence[Path]) -> set[str]:
    """Names under which a copy of these files would not work: words of Python, modules, and what the files name."""
    from importlib.metadata import packages_distributions  # here: it brings email

    texts = [path.read_text(encoding="utf-8") for path in files if path.suffix == ".py"]
    trees = [node for text in texts for node in ast.walk(ast.parse(text))]
    own = {node.id for node in trees if isinstance(node, ast.Name)}
    own |= {node.arg for node in trees if isinstance(node, ast.arg | ast.keyword) and node.arg}
    own |= {path.stem for path in files}
    installed = set(packages_distributions()) | set(sys.stdlib_module_names)
    return (own | installed | set(keyword.kwlist)) - {EXAMPLE}


def _is_source(path: Path) -> bool:
    return not {"build", "gains", "__pycache__"} & set(
        path.parts[len(shipped_path("examples", EXAMPLE).parts) :]
    )
