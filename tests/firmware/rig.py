"""A supervised controller flies with its machine in compiled C, while one fault or request strikes: see rig.c."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.firmware.ctext import function_text
from malta.firmware.machine import (
    FirmwareMachine,
    command_field,
    machine_sources,
    noise_channels,
    wrench_fields,
)
from malta.firmware.program import build_program, lower
from malta.firmware.signals import Target, place_of_readings
from malta.firmware.sources import sources
from malta.firmware.supervisor import MONITORS, STATES, WIRING_STATES
from malta.firmware.supervisor_text import supervisor_members, supervisor_sources

KINDS = (
    *("NOTHING", "LOST", "STUCK", "JUMP", "DRIFT", "NOISY", "GAIN", "CURRENT_BIAS", "CURRENT_STUCK"),
    *("CURRENT_FROZEN", "CURRENT_GAIN", "CURRENT_LOST", "LINK", "MISSED", "HALF_BRIDGE", "EXCITED", "STO"),
    *("BIT", "BURST", "PAIR_DRIFT", "CURRENT_DRIFT", "SAG"),
    *("ASK_SINE", "ASK_ACCELERATION", "ASK_RAMP", "ASK_STEP", "ASK_RATE", "ASK_TOGGLE", "ASK_NAN"),
)
HERE = Path(__file__).parent
FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-D_DEFAULT_SOURCE")


class Plan(ctypes.Structure):
    """What is asked for: start, operation and landing; a stroke back and forth to `end`, each way in `rise`. s, m"""

    _fields_ = [(name, ctypes.c_double) for name in ("start", "operate", "land", "stroke", "rise", "end")]


class Strike(ctypes.Structure):
    """A fault or request: what, where (-1: all radial sensors, or all currents), how large, how fast, when."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("kind", "place")),
        *((name, ctypes.c_double) for name in ("size", "rate", "at", "until")),
    ]


class Outcome(ctypes.Structure):
    """What came of it: contact speeds (m/s), currents (A), times (s); see rig.c."""

    _fields_ = [
        *((name, ctypes.c_double) for name in ("radial", "axial", "current", "beyond", "noticed", "off")),
        *((name, ctypes.c_int) for name in ("monitor_number", "state_number", "spoiled")),
    ]

    @property
    def monitor(self) -> str:
        number = int(self.monitor_number)
        return (*MONITORS, "WIRING")[number] if number >= 0 else ""

    @property
    def state(self) -> str:
        name: str = [*STATES, *WIRING_STATES][self.state_number]
        return name

    def __repr__(self) -> str:
        return (
            f"radial {1e3 * self.radial:.1f} axial {1e3 * self.axial:.1f} mm/s, {self.current:.2f} A, over for "
            f"{1e3 * self.beyond:.2f} ms, {self.monitor or '-'} after {1e3 * self.noticed:.2f} ms, off after "
            f"{1e3 * self.off:.2f}, {self.state}{', no number' if self.spoiled else ''}"
        )


def strike(
    kind: str, at: float, place: int = 0, size: float = 0.0, rate: float = 0.0, until: float = np.inf
) -> Strike:
    return Strike(KINDS.index(kind), place, size, rate, at, until)


NONE = strike("NOTHING", np.inf)
PLAN = {"start": 1e-3, "operate": 0.0, "land": np.inf, "stroke": np.inf, "rise": 0.02, "end": 8e-3}


class Wires(NamedTuple):
    """What each reading, current sensor and half-bridge is connected to, times what; of outputs, plus what."""

    y: tuple[int, ...]
    gain: tuple[float, ...]
    more: tuple[float, ...]
    i: tuple[int, ...]
    i_gain: tuple[float, ...]
    out: tuple[int, ...]
    out_gain: tuple[float, ...]


class Moment(NamedTuple):
    """A flight so far."""

    world: Any
    plan: Plan


class Rig:
    """A design's exported C with the C of its machine."""

    def __init__(self, t: Target, noise: float = 1.0, seed: int = 1) -> None:
        self.t, self.noise, self.seed = t, noise, seed
        self.outputs = len(t.controller.measurements)
        self.lib = _library(t)

    def begin(self, place: float = 0.0, **plan: float) -> Moment:
        """The machine rests where its plan's start finds it: on its bearings below, at a place of its stroke."""
        plant = self.t.believed
        x = np.zeros(len(plant.states))
        names = [s.name for s in plant.states]
        if "y" in names:
            x[names.index("y")] = -plant.parameters.r_max  # type: ignore[attr-defined]
        if plant.has_stroke:
            x[plant.stroke_state] = place
        world = ctypes.create_string_buffer(self.lib.rig_bytes())
        self.lib.rig_rest(world, (ctypes.c_double * len(x))(*x))
        return Moment(world, Plan(**(PLAN | plan)))

    def begin_in_flight(self, x: Any, rest: Any) -> Moment:
        """The machine flies at x, held by its currents, and its supervisor has taken over; it lands at rest."""
        world = ctypes.create_string_buffer(self.lib.rig_bytes())
        rows = [(ctypes.c_double * len(v))(*map(float, v)) for v in (x, rest)]
        self.lib.rig_fly_at(world, *rows)
        return Moment(world, Plan(**(PLAN | {"start": np.inf})))

    def fly(
        self, moment: Moment, until: float, strike: Strike = NONE, trace: Any = None
    ) -> tuple[Outcome, Moment]:
        """From a moment to another; the first stays as it is."""
        world = ctypes.create_string_buffer(moment.world.raw, len(moment.world))
        found = Outcome()
        numbers = [ctypes.c_double(v) for v in (self.noise, self.seed, until)]
        self.lib.rig_fly(
            world, ctypes.byref(moment.plan), ctypes.byref(strike), *numbers, ctypes.byref(found), trace
        )
        return found, Moment(world, moment.plan)

    @property
    def wires(self) -> Wires:
        """As it should be."""
        p, q, m = (
            self.outputs,
            len(self.t.current_readings) if self.t.driven else 0,
            command_field(self.t).size,
        )
        return Wires(
            tuple(range(p)), (1.0,) * p, (0.0,) * p, tuple(range(q)), (1.0,) * q, tuple(range(m)), (1.0,) * m
        )

    def wire(self, w: Wires | None) -> None:
        """Connect readings, currents and half-bridges so; None: as they should be."""
        own = w or self.wires
        whole, real = ctypes.c_int, ctypes.c_double
        kinds: list[Any] = [whole, real, real, whole, real, whole, real]
        arrays = [(kind * max(len(v), 1))(*v) for kind, v in zip(kinds, own, strict=True)]
        sizes = (ctypes.c_int * 3)(*(len(v) if w else 0 for v in (own.y, own.i, own.out)))
        self.lib.rig_wire(*arrays, sizes)

    def supervisor(self, moment: Moment) -> Any:
        """What the supervisor remembers at a moment, by name."""
        self.lib.rig_member.restype = ctypes.c_void_p
        found = {}
        for k, member in enumerate(supervisor_members(self.t)):
            if member.kind not in ("int32_t", "real"):
                continue
            kind = ctypes.c_int32 if member.kind == "int32_t" else ctypes.c_double
            at = self.lib.rig_member(moment.world, k)
            values = (kind * max(member.size, 1)).from_address(at)
            found[member.name] = list(values) if member.size else values[0]
        return found

    def trace(self, moment: Moment, until: float, strike: Strike = NONE) -> FloatArray:
        """Rows (t, state, p, y, reference, rate, expected) of each sample of a flight from its beginning."""
        rows = np.zeros((round(until / self.t.controller.sample_time) + 1, 2 + 5 * self.outputs))
        self.fly(moment, until, strike, rows.ctypes.data_as(ctypes.c_void_p))
        return rows[rows[:, 0] > 0]


@cache
def _library(t: Target) -> Any:
    """The compiled rig of a target; the folder stays as long as the tests run."""
    m = FirmwareMachine(t)
    files = sources(t, "", "ctl") | supervisor_sources(t, "ctl")
    files |= machine_sources(m, "plant", ("begin", "substep", "read"))
    head = "".join(f"#define {key} {value}\n" for key, value in _macros(t, m).items())
    own = '#include "plant.h"\n#include <stdbool.h>\n' + head + _axes_text(t)
    folder = Path(tempfile.mkdtemp(prefix="rig"))
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "rig.c").write_text(own + (HERE / "rig.c").read_text(encoding="utf-8"), encoding="utf-8")
    texts = [
        name for name in files if name.endswith(".c") and name != "ctl_supervisor.c"
    ]  # rig.c includes it
    command = ["gcc", *FLAGS, *texts, "rig.c", "-lm", "-o", "rig.so"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[:3000]
    library = ctypes.CDLL(str(folder / "rig.so"))
    shutil.rmtree(folder)
    library.rig_bytes.restype = ctypes.c_size_t
    return library


def _macros(t: Target, m: FirmwareMachine) -> dict[str, str]:
    """What rig.c is compiled with."""
    plant = t.believed
    reals = [member for member in supervisor_members(t) if member.kind == "real"]
    limits = np.ones(1)
    if t.driven:
        limits = np.abs(np.array(ca.DM(plant.drive.command(ca.DM(t.controller.limits.current))))).ravel()
        limits = np.where(limits > 0, limits, limits.max())
    return {
        "COMMAND": command_field(t).name,
        "DRIVEN": str(int(t.driven)),
        "EXCITATION": str(int(t.excited)),
        "STROKE": str(plant.stroke_output if plant.has_stroke else -1),
        "NOISES": str(noise_channels(m)),
        "DELAY": str(m.setup.delay),
        "UNIFORM": f"((double[]){{ {', '.join(repr(float(v)) for v in _uniform(t, m))} }})",
        "SOFT": str(int(any(plant.contacts.cushioned))),
        "LENGTHS": str(sum(s.unit == "m" for s in plant.outputs)),
        "WRENCH": str(sum(f.size for f in wrench_fields(m))),
        "PARAMETERS": ", ".join(repr(float(getattr(m.plant.parameters, name))) for name in m.parameters),
        "CUSHIONED": f"((int[]){{ {', '.join(str(int(c)) for c in plant.contacts.cushioned)} }})",
        "REALS": ", ".join(f"{'' if member.size else '&'}sup->{member.name}" for member in reals),
        "MEMBERS": ", ".join(f"offsetof(ctl_supervisor, {member.name})" for member in supervisor_members(t)),
        "REAL_SIZES": ", ".join(str(member.size or 1) for member in reals),
        "CURRENT_LIMITS": ", ".join(repr(float(v)) for v in limits),
    }


def _uniform(t: Target, m: FirmwareMachine) -> FloatArray:
    """Half the width of the noise of sensors whose machine's C has none."""
    noise = np.array(t.believed.sensors.noise, dtype=float)
    return np.zeros_like(noise) if noise_channels(m) else np.sqrt(3) * noise


def _axes_text(t: Target) -> str:
    """C of the currents of the axes from those of the phases, at a place."""
    if not t.driven:
        return ""
    drive = t.believed.drive
    i, y = ca.SX.sym("i", len(t.current_readings)), ca.SX.sym("y", len(t.believed.outputs))
    axes = drive.to_axes(place_of_readings(t.believed, y)) @ i if t.fidelity == "phase" else i
    f = ca.Function("axes", [i, y], [ca.densify(axes)], ["i", "y"], ["axes"])
    text = function_text(build_program(lower(f, "double")), "rig", "double", static=True)
    return "typedef double rig_real;\n" + text
