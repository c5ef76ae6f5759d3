"""`malta new`: a folder with a machine of one's own that runs at once."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from malta.cli.output import make_console, print_written
from malta.errors import InputError
from malta.files import replace_files, shipped_path

EXAMPLE = "ball"  # the folder of examples/ that a new machine begins as
NEXT = """
Try it, from the folder {name}/:
    malta design
    malta verify design/gains/{name}.json --machine {name}.py
    malta simulate design/gains/{name}.json --machine {name}.py --scenario step --out build
    python notebook.py

Then make it yours:
    {name}.py           parameters with their units, and the equations x' = f(x, u, w), y = h(x, u)
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
    console.print(NEXT.format(name=name))


def _is_source(path: Path) -> bool:
    return not {"build", "gains", "__pycache__"} & set(
        path.parts[len(shipped_path("examples", EXAMPLE).parts) :]
    )
