"""What `malta export` writes: a gain file's controller as a folder of C, or a part of its loop as an FMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

from malta.errors import InputError
from malta.files import file_exists, locate, replace_files
from malta.firmware.elementary import Precision
from malta.firmware.fmu import build_fmu
from malta.firmware.folder import folder_files
from malta.firmware.rounding import rounded
from malta.firmware.signals import Target, fidelity_of
from malta.firmware.unit import Part
from malta.gains.file import content_of, read
from malta.model.data import plant_of
from malta.proof.arguments import positive
from malta.simulation.layout import Fidelity
from malta.synthesis.controller import Controller

FASTEST = 1e12  # Hz, of a clock
Until = Literal["currents", "duty-cycles"]


def export_c(
    gains: str | Path,
    out: str | Path,
    *,
    precision: Precision = "double",
    until: Until | None = None,
    proof: bool = True,
    clock: float | None = None,
    tunable: bool = False,
) -> list[Path]:
    """Write the controller of a gain file as a folder of C99 with its test and a report.

    gains : the gain file
    out : the folder, new or empty
    precision : of all numbers, "double" or "float"
    until : how far down the C goes: "currents" or "duty-cycles"; None: as far as the machine is modelled
    proof : prove the margin again with the coefficients that single precision holds, and with other gains if tunable
    clock : of the processor, Hz, with which the report turns instructions into a share of the sample; None: 667 MHz
    tunable : gains, limits, references and monitors are in a record that the target may change, with an ASAP2 file

    Returns the files.

    Raises InputError for a clock that is not above 0, a folder that has files, an unknown precision, and duty cycles of
    a machine without windings.

    >>> import malta
    >>> gains = "design/gains/tubular_pid.json"
    >>> files = malta.export_c(gains, "build/pid_c", until="currents")
    >>> [file.name for file in files if file.suffix == ".h"]
    ['tubular_pid.h', 'tubular_pid_supervisor.h']
    """
    path = locate(gains)
    if clock is not None:
        positive("export", "clock", clock, below=FASTEST)
    target = replace(_target(read(path), precision, until), tunable=tunable)
    folder, content = require_empty(Path(out)), content_of(path)[0]
    robust = content.verification.robust
    uncertainty = {} if robust is None else robust.uncertainty
    if tunable and proof:
        from malta.margins.tuned_gains import gain_box  # flint, which no other export needs

        held = rounded(target.controller) if precision == "float" else target.controller
        target = replace(target, gains=gain_box(target.believed, held, uncertainty))
    texts = folder_files(target, content.sha256, uncertainty, proof=proof, clock=clock)
    files = {folder / name: text.encode() for name, text in sorted(texts.items())}
    replace_files(files)
    return list(files)


def export_fmu(
    gains: str | Path,
    out: str | Path,
    *,
    part: Part = "controller",
    fmi: int = 2,
    until: Until | None = None,
    platforms: Sequence[str] | None = None,
    tunable: bool = False,
) -> str:
    """Write a part of a gain file's loop as an FMU, for co-simulation.

    gains : the gain file
    out : the file
    part : "controller", "supervised" (with its supervisor), "machine" or "loop" (controller and machine)
    fmi : version of the interface, 2 or 3
    until : how far down the controller goes: "currents" or "duty-cycles"; None: as far as the machine is modelled
    platforms : what it has binaries of, by the names of FMI 2 or 3, as "win64" or "aarch64-linux", or "all",
        compiled by ziglang (the extra malta[platforms]); None: this computer
    tunable : the controller's gains, limits, references and monitors are parameters of the FMU

    Returns "", or a sentence that says why the FMU has sources but no binary.

    Raises InputError for another part, version or platform, without ziglang where it is asked for, and for
    duty cycles of a machine without windings; CheckError where ziglang fails.

    >>> import malta
    >>> from zipfile import ZipFile
    >>> gains = "design/gains/calibrated.json"
    >>> note = malta.export_fmu(gains, "build/calibrated.fmu", fmi=3)
    >>> "modelDescription.xml" in ZipFile("build/calibrated.fmu").namelist()
    True
    """
    path = locate(gains)
    target = replace(_target(read(path), "double", until), tunable=tunable and part != "machine")
    fmu = build_fmu(target, content_of(path)[0].sha256, part=part, fmi=fmi, platforms=platforms)
    replace_files({Path(out): fmu.content})
    return fmu.note


def _target(c: Controller, precision: Precision, until: Until | None) -> Target:
    """What is exported. Raises InputError for what a machine does not have."""
    if until not in (None, *get_args(Until)):
        raise InputError("export", "until", repr(until), "one of " + ", ".join(get_args(Until)))
    deepest = fidelity_of(plant_of(c.parameters))
    depths: dict[str | None, Fidelity] = {None: deepest, "currents": "force", "duty-cycles": "phase"}
    return Target(c, precision, depths[until])


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
