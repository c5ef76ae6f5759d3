"""FMUs of the controller, its machine, or the loop of both: C for co-simulation by FMI 2.0 and 3.0, in one archive.

The archive has the sources, this computer's binary where there is a C compiler or those of other platforms, and a
model description with units and start values. The same gain file gives the same bytes: dates are fixed, and the token
that ties binary and description together is the SHA-256 of the sources and the description. Python is not needed where
an FMU runs.
"""

from __future__ import annotations

import hashlib
import io
import platform
import struct
import sys
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files as resources
from importlib.util import find_spec
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from malta.errors import CheckError, InputError
from malta.firmware.export import comment, render
from malta.firmware.flight import FLAGS
from malta.firmware.signals import Target
from malta.firmware.unit import Part, Unit, unit_of, unit_sources
from malta.processes import python_module
from malta.simulation.engine.compiled import shared_library
from malta.units import base_exponents, unit_factor

# Binaries of an FMU for other computers than this one: which there are, and the cross compiler of ziglang.


PATIENCE = 1800.0  # s; zig builds the C library of a system at its first use, that of Windows in minutes
ALL = "all"
OWN_FLAGS = (*FLAGS, "-fvisibility=hidden", "-fno-sanitize=undefined", "-g0", "-s")
FAT_MAGIC, FAT_ALIGNMENT = 0xCAFEBABE, 14  # of Mach-O files of several processors; pages of 2^14 bytes
DARWIN_CPUS = {"x86_64": (0x01000007, 3), "aarch64": (0x0100000C, 0)}


class Platform(NamedTuple):
    """A computer that an FMU can have a binary for."""

    name: str  # of FMI 3; FMI 2 takes it for all that is not x86
    second: str  # of FMI 2
    target: str  # of zig: the oldest system that the binary runs on
    ending: str

    def folder(self, fmi: int) -> str:
        """The name of its folder of binaries."""
        return self.second if fmi == 2 else self.name


PLATFORMS = (
    Platform("x86_64-linux", "linux64", "x86_64-linux-gnu.2.17", ".so"),
    Platform("aarch64-linux", "aarch64-linux", "aarch64-linux-gnu.2.17", ".so"),
    Platform("x86_64-windows", "win64", "x86_64-windows-gnu", ".dll"),
    Platform("x86_64-darwin", "darwin64", "x86_64-macos.11.0", ".dylib"),
    Platform("aarch64-darwin", "aarch64-darwin", "aarch64-macos.11.0", ".dylib"),
)


def platforms_named(names: Sequence[str]) -> tuple[Platform, ...]:
    """Platforms by their names in FMI 2 or 3, or all of them.

    Raises InputError for a name that none has.

    >>> [p.target for p in platforms_named(["win64", "aarch64-linux"])]
    ['aarch64-linux-gnu.2.17', 'x86_64-windows-gnu']
    """
    known = {name: p for p in PLATFORMS for name in (p.name, p.second)}
    for name in names:
        if name not in (ALL, *known):
            raise InputError("export", "platforms", repr(name), f"{ALL}, or some of {', '.join(known)}")
    chosen = PLATFORMS if ALL in names else [known[name] for name in names]
    return tuple(p for p in PLATFORMS if p in chosen)


def cross_compile(
    files: Mapping[str, bytes], platforms: Sequence[Platform], identifier: str, fmi: int
) -> dict[str, bytes]:
    """The shared libraries of C files for platforms, by their places in an FMU. The same files give the same bytes.

    Importers of FMI 2 look into `darwin64` on every Mac: where both processors are asked for, that library has both.

    Raises InputError without ziglang, CheckError where it compiles nothing.
    """
    if find_spec("ziglang") is None:
        raise InputError(
            "export", "platforms", "no cross compiler", "ziglang: pip install ziglang, or malta[platforms]"
        )
    made = {}
    for p in platforms:
        cc = (*python_module("ziglang", "cc"), "-target", p.target)
        binary = shared_library(files, OWN_FLAGS, cc, PATIENCE)
        if binary is None:
            raise CheckError(f"ziglang compiled nothing for {p.name}: try {' '.join(cc[2:])} on a file of C")
        made[p.name] = binary
    darwin = {name: binary for name, binary in made.items() if name.endswith("-darwin")}
    if fmi == 2 and len(darwin) == 2:
        made["x86_64-darwin"] = _of_both_processors(darwin)
    return {f"binaries/{p.folder(fmi)}/{identifier}{p.ending}": made[p.name] for p in platforms}


def _of_both_processors(binaries: Mapping[str, bytes]) -> bytes:
    """A Mach-O file of the libraries of several processors: a head in big endian that says where each begins."""
    page = 1 << FAT_ALIGNMENT
    head, body = struct.pack(">II", FAT_MAGIC, len(binaries)), b""
    for name, binary in binaries.items():
        cpu, kind = DARWIN_CPUS[name.partition("-")[0]]
        head += struct.pack(">5I", cpu, kind, page + len(body), len(binary), FAT_ALIGNMENT)
        body += binary + bytes(-len(binary) % page)
    return head + bytes(page - len(head)) + body


VERSIONS = (2, 3)
HEADERS = {
    2: ("fmi2FunctionTypes.h", "fmi2Functions.h", "fmi2TypesPlatform.h"),
    3: ("fmi3FunctionTypes.h", "fmi3Functions.h", "fmi3PlatformTypes.h"),
}
ARCHITECTURES = {"arm64": "aarch64", "amd64": "x86_64"}  # as FMI calls them
WITHOUT_COMPILER = (
    "without a binary, because no C compiler works here: the importing tool has to compile the sources"
)
DATE = (1980, 1, 1, 0, 0, 0)  # of all members
STOP = 0.1  # s, of the default experiment
TOKEN = "@token@"  # in place of the token while it is computed


class Fmu(NamedTuple):
    """An FMU as a file's content, and a sentence where it has no binary."""

    content: bytes
    note: str


def build_fmu(
    t: Target,
    sha256: str,
    *,
    part: Part = "controller",
    fmi: int = 2,
    platforms: Sequence[str] | None = None,
) -> Fmu:
    """An FMU.

    sha256 : of the gain file
    part : "controller", "supervised", "machine" or "loop"
    fmi : version of the interface, 2 or 3
    platforms : names of those that it has binaries of, or "all", by ziglang; None: this computer's, by its compiler

    Raises InputError for another part, version or platform, and for a machine that cannot be exported.

        c = malta.gains.read("design/gains/robust.json")
        build_fmu(Target(c), "0" * 64, part="loop", fmi=3).content
    """
    if fmi not in VERSIONS:
        raise InputError("export", "fmi", repr(fmi), "2 or 3")
    chosen = None if platforms is None else platforms_named(platforms)
    unit = unit_of(t, part)
    texts = _texts(unit, sha256, fmi)
    whole = "".join(f"{name}\n{text}\n" for name, text in sorted(texts.items()))
    token = hashlib.sha256(whole.encode()).hexdigest()
    members = {name: text.replace(TOKEN, token).encode() for name, text in texts.items()}
    own = {
        name.removeprefix("sources/"): data for name, data in members.items() if name.endswith((".c", ".h"))
    }
    if chosen is not None:
        return Fmu(_archive(members | cross_compile(own, chosen, identifier_of(unit), fmi)), "")
    binary = shared_library(own, (*FLAGS, "-fvisibility=hidden"))
    if binary is not None:
        members[f"binaries/{platform_of(fmi)}/{identifier_of(unit)}{_ending()}"] = binary
    return Fmu(_archive(members), "" if binary is not None else WITHOUT_COMPILER)


def identifier_of(u: Unit) -> str:
    """The model identifier, which names the binary."""
    return f"{u.name}_{u.part}"


def platform_of(fmi: int) -> str:
    """The folder of this computer's binaries in an FMU."""
    system = "darwin" if sys.platform == "darwin" else "linux"
    if fmi == 2:
        return f"{system}64"
    machine = platform.machine().lower()
    return f"{ARCHITECTURES.get(machine, machine)}-{system}"


def _ending() -> str:
    return ".dylib" if sys.platform == "darwin" else ".so"


def _texts(u: Unit, sha256: str, fmi: int) -> dict[str, str]:
    """All text files of an FMU by their place in it."""
    context = _context(u, sha256)
    own = unit_sources(u, sha256, TOKEN) | {f"fmi{fmi}.c": render(f"fmu_fmi{fmi}.c", context)}
    context |= {"files": sorted(name for name in own if name.endswith(".c"))}
    texts = {f"sources/{name}": text for name, text in own.items()}
    for name in HEADERS[fmi]:
        texts[f"sources/{name}"] = (
            (resources("malta.firmware") / "templates" / "fmi" / name).read_bytes().decode()
        )
    if fmi == 3:
        texts["sources/buildDescription.xml"] = render("fmu_build.xml", context)
    texts["documentation/index.html"] = render("fmu_index.html", context)
    return texts | {"modelDescription.xml": render(f"fmu_fmi{fmi}.xml", context)}


def _context(u: Unit, sha256: str) -> dict[str, Any]:
    t, c = u.target, u.target.controller
    words = {
        "controller": "The controller",
        "supervised": "The controller with its supervisor",
        "machine": "The machine",
        "loop": "The controller and the machine",
    }
    return {
        "title": comment(f"{c.name} {u.part}"),
        "description": f"{words[u.part]} of a {t.believed.name}, sampled every {c.sample_time * 1e6:g} us",
        "version": version("malta"),
        "sha256": sha256,
        "token": TOKEN,
        "part": u.part,
        "identifier": identifier_of(u),
        "sample_time": repr(c.sample_time),
        "stop": repr(max(STOP, 10 * c.sample_time)),
        "variables": u.variables,
        "units": _units(u),
    }


def _units(u: Unit) -> list[dict[str, str]]:
    """The units of all variables, with the exponents of their base units as attributes."""
    found = []
    for name in sorted({v.unit for v in u.variables if v.unit}):
        factor = unit_factor(name, "unit")
        numbers = dict(base_exponents(name)) | ({} if factor == 1 else {"factor": repr(factor)})
        base = "".join(f" {key}={quoteattr(str(value))}" for key, value in sorted(numbers.items()))
        found.append({"name": name, "base": base})
    return found


def _archive(members: Mapping[str, bytes]) -> bytes:
    """A zip archive whose bytes depend on its members alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in sorted(members):
            info = zipfile.ZipInfo(name, DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, members[name])
    return buffer.getvalue()
