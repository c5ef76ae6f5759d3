"""The XCP slave of an export: what its addresses mean, and its files.

An address is an area in its upper 16 bits and an offset in bytes below, so that no linker's map is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from ipaddress import AddressValueError, IPv4Address
from typing import Any

from malta.errors import InputError
from malta.firmware.calibration import counts_of, parameters_of
from malta.firmware.ctext import c_number
from malta.firmware.signals import Target, XcpPort as XcpPort
from malta.firmware.sources import render
from malta.firmware.supervisor import bounds_of
from malta.firmware.wiring import wiring_members

PARAMETERS, OUTPUTS, INPUTS, SUPERVISOR, REFERENCE, COMMITS, NAME, WIRED, FOUND = range(1, 10)  # areas
AREAS = {
    OUTPUTS: ("outputs", "x->out"),
    INPUTS: ("inputs", "x->in"),
    SUPERVISOR: ("supervisor", "x->supervisor"),
    REFERENCE: ("reference", "&x->state->reference"),
    COMMITS: ("", "&x->calibration->used"),  # used, reason, entry, commits
}
PACKET, LISTS, ODTS, ENTRIES, QUEUE = 128, 4, 32, 256, 64  # bytes; of all lists together; packets
SILENCE = 5.0  # s, after which another master may connect
BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
UNITS = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # s, of time stamps and cycles, by code
COMMANDS = {
    0xFF: 2,
    0xFE: 1,
    0xFD: 1,
    0xFC: 1,
    0xFB: 1,
    0xFA: 2,
    0xF6: 8,
    0xF5: 2,
    0xF4: 8,
    0xF0: 3,
    0xEB: 4,
    0xEA: 3,
    0xE9: 1,
    0xE4: 5,
    0xDA: 1,
    0xD9: 1,
    0xD7: 4,
    0xD6: 1,
    0xD5: 4,
    0xD4: 5,
    0xD3: 6,
    0xE2: 6,
    0xE1: 8,
    0xE0: 8,
    0xDE: 4,
    0xDD: 2,
    0xDC: 1,
}  # bytes that a command has at least


def read_port(text: str, baud: int | None) -> XcpPort:
    """A port as `--xcp` has it. Raises InputError for another text.

    >>> read_port("192.168.1.10:5556", None)
    XcpPort(address='192.168.1.10', port=5556, baud=115200)
    """
    own = XcpPort()
    address, _, port = text.rpartition(":")
    expected = "ADDRESS:PORT, as 192.168.1.10:5555, or a port alone"
    try:
        number, host = int(port), str(IPv4Address(address or own.address))
    except (ValueError, AddressValueError):
        raise InputError("--xcp", "", repr(text), expected) from None
    if not 0 < number < 65536:
        raise InputError("--xcp", "", f"port {number}", "1 to 65535")
    if baud is not None and baud not in BAUDS:
        raise InputError("--baud", "", str(baud), "one of " + " ".join(map(str, BAUDS)))
    return XcpPort(host, number, baud or own.baud)


def time_stamps(Ts: float) -> tuple[int, int]:
    """The unit of time stamps by its code, the coarsest of which a sample is a whole number, and that number."""
    for code, unit in reversed(list(enumerate(UNITS))):
        ticks = Ts / unit
        if 1 <= round(ticks) < 65536 and abs(ticks - round(ticks)) < 1e-6:
            return code, round(ticks)
    return 3, max(1, min(65535, round(Ts / 1e-6)))


def xcp_sources(t: Target, name: str, context: Mapping[str, Any]) -> dict[str, str]:
    """<name>_xcp.h, <name>_xcp.c and the program for a computer; none of an export without.

    context : of the folder's files
    """
    if t.xcp is None:
        return {}
    Ts, port = t.controller.sample_time, t.xcp
    unit, ticks = time_stamps(Ts)
    areas = [
        {"number": number, "place": place, "type": f"{name}_{kind}" if kind else "int32_t[4]"}
        for number, (kind, place) in AREAS.items()
    ]
    if t.wiring:
        whole, reals = wiring_results(t)
        for number, first, kind, members in (
            (WIRED, "&x->supervisor->wired", "int32_t", whole),
            (FOUND, "x->supervisor->gain", f"{name}_real", reals),
        ):
            size = sum(max(count, 1) for _, count in members)
            areas.append({"number": number, "place": first, "type": f"{kind}[{size}]"})
    filled = (
        dict(context)
        | port._asdict()
        | {
            **_board(t),
            "packet": PACKET,
            "lists": LISTS,
            "odts": ODTS,
            "entries": ENTRIES,
            "queue": QUEUE,
            "silence": f"{SILENCE:g}",
            "silent_samples": round(SILENCE / Ts),
            "areas": areas,
            "parameter_area": PARAMETERS,
            "name_area": f"0x{NAME:x}",
            "letters": [f"(uint8_t)'{letter}'" for letter in name],
            "reals": sum(p.field.size for p in parameters_of(t)),
            "counts": len(counts_of(t)),
            "real_bytes": t.real_bytes,
            "entry_bytes": t.real_bytes,
            "stamp_mode": f"0x{(unit << 4) | 4:02x}",
            "stamp_ticks": ticks,
            "cycle": min(ticks, 255),
            "cycle_unit": unit,
            "commands": list(COMMANDS.items()),
        }
    )
    files = {f"{name}_xcp.{end}": render(f"xcp.{end}", filled) for end in ("h", "c")}
    files |= {f"{name}_port.h": render("port.h", filled), f"{name}_main.c": render("main.c", filled)}
    return files | {f"{name}_xcp_pc.c": render("xcp_pc.c", filled)}


def _board(t: Target) -> dict[str, Any]:
    """What a board has to have: currents that can be read, steps of the duty cycles, and a delay."""
    a, n = t.believed.actuator, t.precision
    steps = (
        0.5 / t.believed.drive.pwm_step if t.driven and t.believed.drive.pwm_step else 1.0
    )  # half as many do
    delay = max(float(t.controller.sample_time), 1.5 * float(a.loop_delay or 0.0))
    return {
        "largest_current": c_number(min(bounds_of(t).current, 1e9), n),
        "pwm_steps": c_number(steps, n),
        "most_delay": c_number(delay, n),
        "timer_error": c_number(1e-4, n),
    }


def wiring_results(t: Target) -> tuple[list[tuple[str, int]], list[tuple[str, int]]]:
    """Names and sizes of what a supervisor has found of its wiring: whole numbers, then reals, each side by side."""
    members = [(kind, name, size) for kind, name, size, _ in wiring_members(t)]
    whole = [("wired", 0), *((name, size) for kind, name, size in members if kind == "int32_t")]
    reals = [(name, size) for kind, name, size in members if kind == "real"]
    return whole, reals[: [name for name, _ in reals].index("scale") + 1]


def if_data(t: Target) -> dict[str, Any]:
    """What the A2L says of the slave; `xcp` alone where there is none."""
    if t.xcp is None:
        return {"xcp": None}
    unit, ticks = time_stamps(t.controller.sample_time)
    names = ("1NS", "10NS", "100NS", "1US", "10US", "100US", "1MS", "10MS", "100MS", "1S")
    return {
        "xcp": t.xcp._asdict()
        | {"packet": PACKET, "lists": LISTS, "ticks": ticks, "unit": f"UNIT_{names[unit]}"},
        "entry_bytes": t.real_bytes,
        "cycle": min(ticks, 255),
        "cycle_unit": unit,
    }
