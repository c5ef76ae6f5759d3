"""`malta export`: the controller of a gain file as C, or a part of the loop as an FMU."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, GainFile, MachineFile
from malta.cli.output import make_console, print_json, print_note, print_written
from malta.errors import InputError
from malta.files import file_exists, replace_files

Until = Literal["currents", "duty-cycles"]


def export(
    gains: GainFile,
    to: Annotated[str, typer.Option("--to", metavar="FORM", help="c: a folder of C99.")] = "c",
    precision: Annotated[str, typer.Option(help="float or double, of the C.")] = "double",
    until: Annotated[
        str | None,
        typer.Option(
            help="How far down the C goes: currents, or duty-cycles. [as far as the machine is modelled]"
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The folder, new or empty. [build/NAME_c]")] = None,
    proof: Annotated[
        bool, typer.Option(help="Prove the margin again with the coefficients that float holds.")
    ] = True,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Write the controller as C that computes the same bits on every processor, with its test and a report.

    \b
    Example:  malta export design/gains/robust.json --to c --precision float --out build/robust_c
    """
    if to != "c":
        raise InputError("--to", "", repr(to), "c")
    files = _write_c(gains, precision, until, out, proof=proof, machine=machine, quiet=as_json)
    if as_json:
        print_json({"gains": str(gains), "to": to, "files": [str(file) for file in files]})
    else:
        print_written(make_console(), files)


def _write_c(
    gains: Path,
    precision: str,
    until: str | None,
    out: Path | None,
    *,
    proof: bool,
    machine: Path | None,
    quiet: bool,
) -> list[Path]:
    """Write the folder of C files; the files. Raises InputError for a folder that is not empty, and bad options."""
    from malta.firmware.folder import folder_files
    from malta.firmware.signals import Target, fidelity_of
    from malta.gains.file import content_of
    from malta.model.data import plant_of

    if precision not in ("double", "float"):
        raise InputError("--precision", "", repr(precision), "double or float")
    if until not in (None, "currents", "duty-cycles"):
        raise InputError("--until", "", repr(until), "currents or duty-cycles")
    controller = read_controller(gains, machine)
    deepest = fidelity_of(plant_of(controller.parameters))
    fidelity = {None: deepest, "currents": "force", "duty-cycles": "phase"}[until]
    target = Target(controller, cast("Any", precision), cast("Any", fidelity))
    folder = require_empty(out or Path("build") / f"{controller.name}_c")
    content = content_of(gains)[0]
    robust = content.verification.robust
    if not quiet and proof and precision == "float" and robust is not None:
        print_note("proving the margin with the coefficients that float holds; --no-proof leaves it out")
    texts = folder_files(target, content.sha256, {} if robust is None else robust.uncertainty, proof=proof)
    files = {folder / name: text.encode() for name, text in sorted(texts.items())}
    replace_files(files)
    return list(files)


def require_empty(folder: Path) -> Path:
    """The folder, which is new or empty. Raises InputError for one with files, whatever they are."""
    if file_exists(folder):
        if not folder.is_dir():
            raise InputError(folder, "", "a file of that name", "a folder, new or empty")
        try:
            if any(folder.iterdir()):
                raise InputError(folder, "", "a folder with files in it", "one that is new or empty")
        except OSError as error:
            raise InputError(folder, "", error.strerror or str(error), "a folder that can be read") from error
    return folder
