"""FMUs of the controller, its machine, or the loop of both: C for co-simulation by FMI 2.0 and 3.0, in one archive.

The archive has the sources, this computer's binary where there is a C compiler or those of other platforms, and a
model description with units and start values. The same gain file gives the same bytes: dates are fixed, and the token
that ties binary and description together is the SHA-256 of the sources and the description. Python is not needed where
an FMU runs.

A unit of co-simulation: the controller, with its supervisor, its machine, or both, as variables and C without FMI.

A sample takes the inputs at its beginning and leaves the outputs at its end, also where steps are shorter than it or
end within it. A master that lets the controller step first hands its commands to the machine in the same sample, and
the machine delays them (`late`). A master that lets both step at once adds a sample by itself: with a delay of one
sample, `late` is 0 there.
"""

from __future__ import annotations

import hashlib
import io
import platform
import re
import struct
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple, get_args
from xml.sax.saxutils import quoteattr

import casadi as ca
import numpy as np

from malta.errors import CheckError, InputError, on_one_line
from malta.files import read_packaged, version
from malta.firmware.calibration import parameters_of
from malta.firmware.ctext import c_name, c_number
from malta.firmware.flight import FLAGS
from malta.firmware.machine import (
    FirmwareMachine,
    command_field,
    machine_functions,
    machine_sources,
    noise_channels,
    parameter_field,
    reading_fields,
    state_field,
    wrench_fields,
)
from malta.firmware.signals import CField, Target
from malta.firmware.sources import comment, head_context, render, sources
from malta.firmware.supervisor import STATES
from malta.firmware.supervisor_text import request_members, supervisor_sources
from malta.model.plant import Signal
from malta.processes import python_module
from malta.simulation.engine.compiled import shared_library
from malta.simulation.period import initial_state
from malta.units import base_exponents, unit_factor

Part = Literal["controller", "supervised", "machine", "loop"]
PARTS: tuple[Part, ...] = get_args(Part)
SWITCH = (0.0, 1.0)  # least and most of what is on or off
COLD_FIELD = CField(
    "cold", (Signal("", "1"),), "1: starts without current, 0: with the currents that hold it"
)
NOISE = CField("noise", (Signal("", "1"),), "of the sensors, in multiples of the machine's own")
SEED = CField("seed", (Signal("", "1"),), "whole number, of the noise: that of simulations with this seed")
FLYING_FIELD = CField(
    "flying", (Signal("", "1"),), "1: the machine flies at its reference at the start, 0: it rests"
)
GATES_FIELD = CField(
    "gates", (Signal("", "1"),), "1: as commanded, 0: all switches open, as supervisor.enable says"
)
LATE_FIELD = CField("late", (Signal("", "1"),), "1: commands act a delay later, 0: at once")
UNLIMITED_PARAMETER = 1e30  # of a parameter without a limit
MOST_NOISE, MOST_SEED = 1e6, 2.0**53
_WORDS = ("valid ", "refused ", "limited ")  # before the names of signals that belong to others


class FmuVariable(NamedTuple):
    """A variable of a unit; its place among the others is its value reference."""

    name: str
    causality: str
    variability: str
    unit: str
    start: float | None
    description: str
    reference: int
    least: float | None = None  # of a parameter that has a range
    most: float | None = None

    @property
    def initial(self) -> str:
        """How the variable begins; "" where its causality says it."""
        return {"parameter": "exact", "output": "calculated", "local": "calculated"}.get(self.causality, "")

    @property
    def role(self) -> str:
        """One letter for the C text: t time, i input, p parameter, q one that may change, o output or local."""
        letters = {
            "independent": "t",
            "input": "i",
            "parameter": "q" if self.variability == "tunable" else "p",
        }
        return letters.get(self.causality, "o")


class VariableGroup(NamedTuple):
    """A field as variables."""

    field: CField
    causality: str
    variability: str
    start: Any = None  # numbers, or one for all
    least: Any = None  # of parameters, likewise
    most: Any = None


class Unit(NamedTuple):
    """A part of the loop as a unit; the names begin the names of its C files."""

    target: Target
    part: Part
    variables: tuple[FmuVariable, ...]
    at: dict[str, int]  # value reference of each group's first variable
    name: str
    machine: FirmwareMachine | None  # None for a controller alone

    @property
    def has_controller(self) -> bool:
        return self.part != "machine"

    @property
    def is_supervised(self) -> bool:
        return self.part == "supervised"


def unit_of(t: Target, part: Part) -> Unit:
    """A unit and its variables. Raises InputError for an unknown part."""
    if part not in PARTS:
        raise InputError("export", "part", repr(part), "one of " + ", ".join(PARTS))
    m = FirmwareMachine(t) if part in ("machine", "loop") and not t.look_ups else None
    if part in ("machine", "loop") and m is None:
        found = f"a {t.believed.name} whose currents come from a table"
        raise InputError("export", part, found, "the controller alone, or a coil model without a table")
    variables = [FmuVariable("time", "independent", "continuous", "s", None, "simulation time", 0)]
    at: dict[str, int] = {}
    for group in _groups(t, part, m):
        at[group.field.name] = len(variables)
        size = group.field.size
        numbers = (np.broadcast_to(v, size) for v in (group.start, group.least, group.most))
        for signal, label, *known in zip(group.field.signals, _labels(group.field), *numbers, strict=True):
            start, least, most = (None if v is None else float(v) for v in known)
            variables.append(
                FmuVariable(
                    label,
                    group.causality,
                    group.variability,
                    "" if signal.unit == "SI" else signal.unit,
                    start,
                    on_one_line(f"{group.field.meaning}{': ' if signal.name else ''}{signal.name}"),
                    len(variables),
                    least,
                    most,
                )
            )
    return Unit(t, part, tuple(variables), at, c_name(t.controller.name), m)


def _groups(t: Target, part: Part, m: FirmwareMachine | None) -> Iterator[VariableGroup]:
    """The fields of a part in the order of their value references: inputs, parameters, outputs, what is inside."""
    if part != "machine":
        for f in t.reference_fields:
            yield VariableGroup(f._replace(name=f"{f.name}_ref"), "input", "continuous", 0.0)
    if part == "supervised":
        yield VariableGroup(request_field(), "input", "discrete", 0.0)
    if m is None:
        for f in t.input_fields:
            valid = f.name.endswith("_valid")
            start = 1.0 if valid else t.believed.drive.link_voltage if f.name == "link" else 0.0
            yield VariableGroup(f, "input", "discrete" if valid else "continuous", start)
    elif part == "machine":
        yield VariableGroup(command_field(t), "input", "discrete", _command_at_rest(m))
        yield VariableGroup(GATES_FIELD, "input", "discrete", 1.0)
    for f in wrench_fields(m) if m is not None else []:
        yield VariableGroup(f, "input", "continuous", 0.0)
    if part == "supervised":
        yield VariableGroup(FLYING_FIELD, "parameter", "fixed", 0.0, *SWITCH)
        rest = CField(
            "rest", t.controller.measurements, "readings of the machine where it lands, if it flies"
        )
        yield VariableGroup(rest, "parameter", "fixed", 0.0)
    if m is not None:
        yield from _machine_parameters(m, part)
    for p in parameters_of(t):
        yield VariableGroup(p.field, "parameter", "tunable", p.values, p.least, p.most)
    if part != "machine":
        for f in t.output_fields:
            yield VariableGroup(f, "output", "discrete")
    if part == "supervised":
        yield VariableGroup(supervision_field(), "output", "discrete")
    for f in reading_fields(m) if m is not None else []:
        yield VariableGroup(f, "local" if f.name == "x" else "output", "continuous")


def _machine_parameters(m: FirmwareMachine, part: Part) -> Iterator[VariableGroup]:
    """How a machine starts, with what noise, and what it is."""
    if part == "machine":
        yield VariableGroup(state_field(m, "x_start", "at the start"), "parameter", "fixed", _at_rest(m))
        yield VariableGroup(COLD_FIELD, "parameter", "fixed", 0.0, *SWITCH)
        if m.setup.delay:
            yield VariableGroup(LATE_FIELD, "parameter", "fixed", 1.0, *SWITCH)
    else:
        meaning = "at the start, beyond what the reference gives"
        yield VariableGroup(state_field(m, "offset", meaning), "parameter", "fixed", 0.0)
    if noise_channels(m):
        yield VariableGroup(NOISE, "parameter", "tunable", 0.0, 0.0, MOST_NOISE)
        yield VariableGroup(SEED, "parameter", "fixed", 0.0, 0.0, MOST_SEED)
    if not m.parameters:
        return
    values = [getattr(m.plant.parameters, name) for name in m.parameters]
    least, most = zip(*(_range(m, name) for name in m.parameters), strict=True)
    yield VariableGroup(parameter_field(m), "parameter", "tunable", values, least, most)


def _range(m: FirmwareMachine, name: str) -> tuple[float, float]:
    """The least and the largest value of a parameter that its record accepts."""
    known = next(f.metadata for f in fields(m.plant.parameters) if f.name == name)
    above, least, below = (known[key] for key in ("above", "at_least", "below"))
    if above is not None:
        least = np.finfo(float).tiny if above == 0 else np.nextafter(above, np.inf)
    most = UNLIMITED_PARAMETER if below is None else np.nextafter(below, -np.inf)
    return float(-UNLIMITED_PARAMETER if least is None else least), float(most)


def request_field() -> CField:
    """What a supervisor is asked for, beside its reference."""
    members = [member for member in request_members() if member.kind == "int32_t"]
    return CField("request", tuple(Signal(member.name, "1") for member in members), "request")


def supervision_field() -> CField:
    """What a supervisor says."""
    words = ", ".join(f"{k} {state.lower()}" for k, state in enumerate(STATES))
    names = ("state", "enable", "monitor", "reaction")
    return CField("supervisor", tuple(Signal(name, "1") for name in names), f"states: {words}")


def _labels(field: CField) -> list[str]:
    """The names of a field's variables, as `y.z`; numbers as `y[1]` where names of signals do not serve."""
    if field.size == 1 and not field.signals[0].name:
        return [field.name]
    labels = []
    for s in field.signals:
        text = s.name.rstrip("'").removesuffix("*")
        for word in _WORDS:
            text = text.removeprefix(word)
        labels.append(re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_"))
    if len(set(labels)) < len(labels) or any(not label or label[0].isdigit() for label in labels):
        return [f"{field.name}[{k}]" for k in range(1, field.size + 1)]
    return [f"{field.name}.{label}" for label in labels]


def _at_rest(m: FirmwareMachine) -> list[float]:
    """The states that a reference of zero gives."""
    place = machine_functions(m)["place"]
    zeros = [ca.DM.zeros(place.size1_in(k)) for k in range(place.n_in())]
    return [float(v) for v in np.array(place(*zeros)).ravel()]


def _command_at_rest(m: FirmwareMachine) -> list[float]:
    """The commands that hold the machine there."""
    plant, c = m.plant, m.target.controller
    x = ca.DM(_at_rest(m))
    z = float(x[plant.stroke_state]) if plant.has_stroke else 0.0
    current = plant.actuator.currents(plant.h(x, 0), ca.DM(c.feedforward.at(z)))
    whole = initial_state(plant, c, replace(m.setup, delay=1), x, ca.DM.zeros(len(c.states)), current)
    held = command_field(m.target).size
    return [float(v) for v in np.array(ca.evalf(whole[-held:])).ravel()]


def unit_sources(u: Unit, sha256: str, token: str) -> dict[str, str]:
    """The C files of a unit by name, without those of an interface. sha256 : of the gain file; token : of the unit"""
    files: dict[str, str] = {}
    if u.has_controller:
        files |= sources(u.target, sha256, f"{u.name}_controller")
    if u.is_supervised:
        files |= supervisor_sources(u.target, f"{u.name}_controller")
    if u.machine is not None:
        more = ("place", "shift") if u.has_controller else ()
        files |= machine_sources(u.machine, f"{u.name}_machine", ("begin", "substep", "read", *more))
    context = _library_context(u, token)
    return files | {f"unit.{end}": render(f"fmu_unit.{end}", context) for end in ("h", "c")}


def _library_context(u: Unit, token: str) -> dict[str, Any]:
    t, c, m = u.target, u.target.controller, u.machine
    roles = "".join(v.role for v in u.variables)
    starts = [c_number(v.start or 0.0, "double") for v in u.variables]
    inputs = [f for f in t.input_fields if f.size]

    def places(fields: list[CField], suffix: str = "") -> list[dict[str, Any]]:
        return [
            {"field": f.name, "at": u.at.get(f.name + suffix, 0), "size": f.size, "name": f.name}
            for f in fields
            if f.size
        ]

    checked = [] if m is None else wrench_fields(m) + ([] if u.has_controller else [command_field(t)])
    return (
        head_context(t, f"{u.name}_controller")
        | {
            "plant": f"{u.name}_machine",
            "token": token,
            "controller": u.has_controller,
            "supervised": u.is_supervised,
            "tunable": t.tunable,
            "tuned": places([p.field for p in parameters_of(t)]),
            "default_record": f"{u.name}_controller_default_parameters",
            "requests": [signal.name for signal in request_field().signals],
            "supervision": [signal.name for signal in supervision_field().signals],
            "limits": [(v.reference, v.least, v.most) for v in u.variables if v.least is not None],
            "noises": 0 if m is None else noise_channels(m),
            "rests": len(c.measurements),
            "machine": m is not None,
            "variables": u.variables,
            "at": u.at,
            "sample_time": c_number(c.sample_time, "double"),
            "roles": [roles[k : k + 80] for k in range(0, len(roles), 80)],
            "starts": ",\n".join("  " + ", ".join(starts[k : k + 8]) for k in range(0, len(starts), 8)),
            "one": c_number(1.0, t.precision),
            "reference": places(t.reference_fields, "_ref"),
            "inputs": places(inputs),
            "outputs": places(t.output_fields),
            "readings": [] if m is None else places(reading_fields(m)),
            "checked": places(checked),
            "states": len(t.believed.states),
            "filtered": len(c.states),
            "currents": sum(f.size for f in inputs if f.name == "i"),
            "volts": 0 if m is None else m.sizes.controller.get("u_integral", 0),
            "wrench": 0 if m is None else sum(f.size for f in wrench_fields(m)),
            "delay": 0 if m is None else m.setup.delay,
        }
        | ({} if m is None else {"at": u.at | {"command": u.at[command_field(t).name]}})
    )


# Binaries of an FMU for other computers than this one: which there are, and the cross compiler of ziglang.


PATIENCE = 1800.0  # s; zig builds the C library of a system at its first use, that of Windows in minutes
ALL_PLATFORMS = "all"
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
        if name not in (ALL_PLATFORMS, *known):
            raise InputError(
                "export", "platforms", repr(name), f"{ALL_PLATFORMS}, or some of {', '.join(known)}"
            )
    chosen = PLATFORMS if ALL_PLATFORMS in names else [known[name] for name in names]
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
STOP_TIME = 0.1  # s, of the default experiment
TOKEN = "@token@"  # in place of the token while it is computed


class Fmu(NamedTuple):
    """An FMU as a file's content, and a sentence where it has no binary."""

    content: bytes
    note: str


def build_fmu(
    t: Target, sha256: str, *, part: Part = "controller", fmi: int = 2, platforms: Sequence[str] | None = None
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
        members[f"binaries/{platform_of(fmi)}/{identifier_of(unit)}{_library_suffix()}"] = binary
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


def _library_suffix() -> str:
    return ".dylib" if sys.platform == "darwin" else ".so"


def _texts(u: Unit, sha256: str, fmi: int) -> dict[str, str]:
    """All text files of an FMU by their place in it."""
    context = _context(u, sha256)
    own = unit_sources(u, sha256, TOKEN) | {f"fmi{fmi}.c": render(f"fmu_fmi{fmi}.c", context)}
    context |= {"files": sorted(name for name in own if name.endswith(".c"))}
    texts = {f"sources/{name}": text for name, text in own.items()}
    for name in HEADERS[fmi]:
        texts[f"sources/{name}"] = read_packaged(f"firmware/templates/fmi/{name}").decode()
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
        "version": version(),
        "sha256": sha256,
        "token": TOKEN,
        "part": u.part,
        "identifier": identifier_of(u),
        "sample_time": repr(c.sample_time),
        "stop": repr(max(STOP_TIME, 10 * c.sample_time)),
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
