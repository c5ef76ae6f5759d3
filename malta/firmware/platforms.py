"""Binaries of an FMU for other computers than this one: which there are, and the cross compiler of ziglang."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import NamedTuple

from malta.errors import CheckError, InputError
from malta.firmware.native import FLAGS
from malta.processes import python_module
from malta.simulation.compiled import shared_library

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
