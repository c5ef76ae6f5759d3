"""A master for the XCP slave of an export: any of its signals at every sample of the law, live, and its wiring.

pyxcp and other masters talk to the same slave; this one needs nothing but sockets or a serial line.
"""

from __future__ import annotations

import re
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.files import read_file
from malta.firmware.pil import serial_port
from malta.firmware.program import Precision
from malta.firmware.signals import Target
from malta.firmware.xcp import FOUND, PACKET, WIRED, wiring_results

ANSWER_TIME, TRIES = 1.0, 3  # s for an answer, and how often a request is sent
ADDRESS = "ADDRESS:PORT with a port of 1 to 65535, as 127.0.0.1:5555, or a serial port, as /dev/ttyUSB0"
REASONS = {
    0x20: "a command that the slave does not have",
    0x21: "a frame cut short",
    0x22: "a number out of its range, or of another type",
    0x23: "what may not be written",
    0x29: "a command out of its turn",
    0x30: "more signals than the slave has room for",
    0x33: "another master is connected",
}
FORMATS = {"FLOAT64_IEEE": "d", "FLOAT32_IEEE": "f", "SLONG": "i", "ULONG": "I"}
MAX_A2L_BYTES = 20_000_000  # bytes


class LiveSignal(NamedTuple):
    """A signal of an A2L: name, unit, address, struct letter, and what its number is divided by for the unit."""

    name: str
    unit: str
    address: int
    letter: str


class A2l(NamedTuple):
    """What a master takes from an A2L: signals by name, and the time of a sample, s."""

    signals: dict[str, LiveSignal]
    sample_time: float


class Frames(Protocol):
    """Packets over a line."""

    def send(self, packet: bytes) -> None: ...

    def receive(self, seconds: float) -> bytes:
        """The next packet; b"" where none came in time."""


def read_a2l(path: str | Path) -> A2l:
    """The signals of an A2L that `malta export --xcp` wrote. Raises InputError for another one."""
    text = read_file(Path(path), "file NAME.a2l", Path.read_bytes, MAX_A2L_BYTES).decode("utf-8", "replace")
    units = dict(re.findall(r'COMPU_METHOD (\S+) ""\s+LINEAR "[^"]*" "([^"]*)"', text))
    found = {
        name: LiveSignal(name, units.get(method, ""), int(address, 16), FORMATS[kind])
        for name, kind, method, address in re.findall(
            r'/begin MEASUREMENT (\S+) "[^"]*"\s+(\S+) (\S+) [^\n]*\s+ECU_ADDRESS 0x([1-9A-F][0-9A-F]*)', text
        )
        if kind in FORMATS
    }
    stamps = re.search(r"TIMESTAMP_SUPPORTED (\d+) SIZE_DWORD UNIT_(\d+)(NS|US|MS|S)", text)
    if not found or stamps is None:
        raise InputError(path, "", "no addresses of an XCP slave", "NAME.a2l of malta export --xcp")
    unit = int(stamps[2]) * {"NS": 1e-9, "US": 1e-6, "MS": 1e-3, "S": 1.0}[stamps[3]]
    return A2l(found, int(stamps[1]) * unit)


class _Udp:
    """Packets as datagrams."""

    def __init__(self, s: socket.socket) -> None:
        self.s, self.sent = s, 0

    def send(self, packet: bytes) -> None:
        self.s.send(struct.pack("<HH", len(packet), self.sent & 0xFFFF) + packet)
        self.sent += 1

    def receive(self, seconds: float) -> bytes:
        ready, _, _ = select.select([self.s], [], [], max(seconds, 0.0))
        try:
            return self.s.recv(2048)[4:] if ready else b""
        except ConnectionRefusedError:
            return b""


class _Serial:
    """Packets between a length, a counter and a sum."""

    def __init__(self, port: Any) -> None:
        self.port, self.sent, self.rest = port, 0, b""

    def send(self, packet: bytes) -> None:
        frame = struct.pack("<HH", len(packet), self.sent & 0xFFFF) + packet
        self.port.write(frame + bytes([sum(frame) & 0xFF]))
        self.sent += 1

    def receive(self, seconds: float) -> bytes:
        end = time.monotonic() + seconds
        while True:
            if len(self.rest) >= 2:
                length = int.from_bytes(self.rest[:2], "little")
                if not 0 < length <= PACKET:
                    self.rest = b""
                elif len(self.rest) >= length + 5:
                    frame, self.rest = self.rest[: length + 5], self.rest[length + 5 :]
                    if sum(frame[:-1]) & 0xFF == frame[-1]:
                        return frame[4:-1]
                    self.rest = b""
            left = end - time.monotonic()
            more = self.port.read(left) if left > 0 else b""
            if not more:
                return b""
            self.rest += more


class XcpMaster:
    """Requests to a slave, with data that comes between their answers."""

    def __init__(self, frames: Frames, where: str) -> None:
        self.frames, self.where, self.data = frames, where, list[bytes]()

    def ask(self, packet: bytes) -> bytes:
        """The answer to a request, without its first byte. Raises InputError for a refusal, and where none comes."""
        for _ in range(TRIES):
            self.frames.send(packet)
            end = time.monotonic() + ANSWER_TIME
            while (left := end - time.monotonic()) > 0:
                answer = self.frames.receive(left)
                if answer[:1] == b"\xff":
                    return answer[1:]
                if answer[:1] == b"\xfe":
                    code = answer[1] if len(answer) > 1 else 0
                    reason = REASONS.get(code, f"error 0x{code:02x}")
                    raise InputError(
                        self.where, "", f"refused: {reason}", "a request that the slave can answer"
                    )
                if answer:
                    self.data.append(answer)
        raise InputError(self.where, "", "no answer", "an XCP slave of malta export --xcp, at this address")

    @property
    def law(self) -> str:
        """The name of the law that the slave runs."""
        size = int.from_bytes(self.ask(b"\xfa\x01")[3:7], "little")
        return self.ask(bytes([0xF5, size]))[:size].decode("ascii", "replace")

    @property
    def precision(self) -> Precision:
        """That of the slave's numbers."""
        return "double" if self.ask(b"\xd9")[1] == struct.calcsize("d") else "float"

    def read(self, address: int, count: int) -> bytes:
        """So many bytes."""
        found, step = b"", PACKET - 8
        while len(found) < count:
            some = min(step, count - len(found))
            found += self.ask(struct.pack("<BBBBI", 0xF4, some, 0, 0, address + len(found)))[:some]
        return found


@contextmanager
def xcp_master(where: str, baud: int = 115200) -> Iterator[XcpMaster]:
    """A master that is connected: ADDRESS:PORT of UDP, or the name of a serial port.

    Raises InputError for an address that is none, a port that cannot be opened, and a slave that does not answer or is
    another master's.
    """
    host, _, number = where.rpartition(":")
    if not where or (set(where) & set(":.") and not set(where) & set("/\\")):
        udp_port = int(number) if number.isdecimal() and len(number) < 6 else 0
        if not host or not 0 < udp_port < 65536:
            raise InputError("address of an XCP slave", "", repr(where), ADDRESS)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            try:
                s.connect((host, udp_port))
            except (OSError, UnicodeError) as error:  # a name that is none, or too long for one
                found = getattr(error, "strerror", None) or str(error)
                raise InputError(where, "", found, ADDRESS) from error
            with _connect(XcpMaster(_Udp(s), where)) as master:
                yield master
        return
    with serial_port(where, baud) as port, _connect(XcpMaster(_Serial(port), where)) as master:
        yield master


@contextmanager
def _connect(master: XcpMaster) -> Iterator[XcpMaster]:
    master.ask(b"\xff\x00")
    try:
        yield master
    finally:
        master.frames.send(b"\xfe")


class LiveRecord(NamedTuple):
    """What a live log has: times (s), a column for each signal, samples that the line lost, whether it broke."""

    t: FloatArray
    signals: tuple[LiveSignal, ...]
    values: FloatArray  # samples x signals
    lost: int
    broken: bool = False  # the slave fell silent before the end


def record_live(
    master: XcpMaster,
    a2l: A2l,
    names: Sequence[str],
    seconds: float,
    *,
    every: int = 1,
    show: Callable[[float, Sequence[float]], None] | None = None,
) -> LiveRecord:
    """Signals at every sample of the law, or at each of so many.

    names : as the A2L has them; seconds : how long; show : is called with time and values of the last sample that came

    Where the slave falls silent, what came until then is returned. Raises InputError for names that there are not, more
    signals than the slave has room for, and where nothing comes at all.

        with xcp_master("127.0.0.1:5555") as master:
            record_live(master, read_a2l("build/robust_c/robust.a2l"), ["y_used.x1"], 1.0)
    """
    for name in names:
        if name not in a2l.signals:
            raise InputError("--signal", "", repr(name), "one of " + " ".join(a2l.signals))
    signals = tuple(a2l.signals[name] for name in names)
    tables = _tables_of(signals)
    _allocate(master, tables, every)
    rows: dict[int, dict[int, tuple[float, ...]]] = {}
    stamp, end, shown = -1, time.monotonic() + seconds, 0.0
    master.ask(b"\xdd\x01")
    patience = max(ANSWER_TIME * TRIES, 3 * every * a2l.sample_time)
    heard = time.monotonic()
    while (left := min(end, heard + patience) - time.monotonic()) > 0:
        packet = master.data.pop(0) if master.data else master.frames.receive(min(left, 0.1))
        if not packet or packet[0] >= len(tables):
            continue
        heard = time.monotonic()
        number, head = packet[0], 5 if packet[0] == 0 else 1
        if number == 0:
            stamp = int.from_bytes(packet[1:5], "little")
        form = "<" + "".join(s.letter for s in tables[number])
        if stamp >= 0 and len(packet) == head + struct.calcsize(form):
            rows.setdefault(stamp, {})[number] = struct.unpack_from(form, packet, head)
        if (
            show is not None
            and number == len(tables) - 1
            and time.monotonic() - shown > 0.25
            and stamp in rows
        ):
            shown = time.monotonic()
            show(stamp * a2l.sample_time, [v for part in sorted(rows[stamp].items()) for v in part[1]])
    found = _record(a2l, signals, len(tables), rows, every)
    try:
        master.ask(b"\xdd\x00")
    except InputError:
        if not len(found.t):
            raise
        return found._replace(broken=True)
    return found


def _record(
    a2l: A2l, signals: tuple[LiveSignal, ...], count: int, rows: dict[int, Any], every: int
) -> LiveRecord:
    """Samples of which all parts came, in the order of time."""
    whole = [stamp for stamp, parts in sorted(rows.items()) if len(parts) == count]
    values = [[v for number in range(count) for v in rows[stamp][number]] for stamp in whole]
    expected = 1 + (whole[-1] - whole[0]) // every if whole else 0
    table = np.array(values, dtype=float).reshape(len(values), len(signals))
    return LiveRecord(np.array(whole) * a2l.sample_time, signals, table, expected - len(whole))


def _tables_of(signals: Sequence[LiveSignal]) -> list[list[LiveSignal]]:
    """The signals of each packet; the first one has a time stamp."""
    tables: list[list[LiveSignal]] = [[]]
    room = PACKET - 5
    for s in signals:
        size = struct.calcsize(s.letter)
        if size > room:
            tables.append([])
            room = PACKET - 1
        tables[-1].append(s)
        room -= size
    return tables


def _allocate(master: XcpMaster, tables: list[list[LiveSignal]], every: int) -> None:
    """One list of these packets, ready to start."""
    master.ask(b"\xd6")
    master.ask(struct.pack("<BBH", 0xD5, 0, 1))
    master.ask(struct.pack("<BBHB", 0xD4, 0, 0, len(tables)))
    for k, table in enumerate(tables):
        master.ask(struct.pack("<BBHBB", 0xD3, 0, 0, k, len(table)))
    for k, table in enumerate(tables):
        master.ask(struct.pack("<BBHBB", 0xE2, 0, 0, k, 0))
        for s in table:
            master.ask(struct.pack("<BBBBI", 0xE1, 0xFF, struct.calcsize(s.letter), 0, s.address))
    master.ask(struct.pack("<BBHHBB", 0xE0, 0x10, 0, 0, every, 0))
    master.ask(struct.pack("<BBH", 0xDE, 2, 0))


def read_wiring(master: XcpMaster, t: Target) -> dict[str, Any]:
    """What the slave's supervisor has found of its wiring, as `wiring_sentences` takes it; wired: 1, -1 or 0."""
    found: dict[str, Any] = {}
    real = "d" if t.precision == "double" else "f"
    for area, letter, members in zip((WIRED, FOUND), ("i", real), wiring_results(t), strict=True):
        count = sum(max(size, 1) for _, size in members)
        data = master.read(area << 16, struct.calcsize(f"{count}{letter}"))
        values = list(struct.unpack(f"<{count}{letter}", data))
        for name, size in members:
            found[name] = values[:size] if size else values[0]
            del values[: max(size, 1)]
    return found
