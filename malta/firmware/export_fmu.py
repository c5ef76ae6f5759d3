"""Exporting a part of a gain file's loop as an FMU: the file, its target and what it is built of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from malta.firmware.agreement import require_same_law
from malta.firmware.export import Until, locate_gains, target_of
from malta.firmware.fmu import Part, build_fmu
from malta.gains.file import content_of
from malta.gains.stable import read_stable
from malta.writing import replace_files


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
    duty cycles of a machine without windings; CheckError where ziglang fails, and where the controller answers readings
    within their ranges otherwise than the law of simulations.

    >>> import malta
    >>> from zipfile import ZipFile
    >>> gains = "design/gains/calibrated.json"
    >>> note = malta.export_fmu(gains, "build/calibrated.fmu", fmi=3)
    >>> "modelDescription.xml" in ZipFile("build/calibrated.fmu").namelist()
    True
    """
    path = locate_gains("export_fmu", gains)
    target = replace(target_of(read_stable(path), "double", until), tunable=tunable and part != "machine")
    if part != "machine":
        require_same_law(target)
    fmu = build_fmu(target, content_of(path)[0].sha256, part=part, fmi=fmi, platforms=platforms)
    replace_files({Path(out): fmu.content})
    return fmu.note
