"""Processor in the loop: the recorded vectors over a serial line, and what a target makes of them.

The target runs NAME_pil.c of an exported folder. Every bit of its outputs and its whole state is compared, by the
checksum that NAME_test.c compares as well.
"""

from __future__ import annotations

import math
import os
import select
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from malta.arguments import positive
from malta.errors import InputError
from malta.files import locate
from malta.firmware.program import Precision
from malta.firmware.signals import Target, fidelity_of
from malta.firmware.vectors import SAMPLES, Vector, record_vectors
from malta.gains.file import content_of
from malta.gains.stable import read_stable
from malta.model.plants import plant_of
from malta.simulation.layout import Fidelity

# A serial line: its port, and frames on it with a checksum, which are asked for again when they are lost.
#
# The program at the other end is templates/pil.c, whose head says what a frame is.


termios: Any = import_module("termios") if find_spec("termios") else None  # of POSIX systems
PORT_ERRORS: tuple[type[Exception], ...] = (OSError,) if termios is None else (OSError, termios.error)
START = b"\xa5\x5a"
ANSWER, GARBLED = 128, 255  # added to the kind of a request; the kind that answers a garbled one
TRIES = 4  # of each request
PADDING = bytes(4096)  # before a request is sent again: more than what the target may still wait for


class Port(Protocol):
    """A serial port."""

    def write(self, data: bytes) -> None:
        """Send bytes."""

    def read(self, seconds: float) -> bytes:
        """The bytes that are there, after `seconds` none."""

    def clear(self) -> None:
        """Forget what has come."""


class Posix:
    """A port of Linux or macOS."""

    def __init__(self, number: int) -> None:
        self.number = number

    def write(self, data: bytes) -> None:
        while data:
            select.select([], [self.number], [])
            data = data[os.write(self.number, data) :]

    def read(self, seconds: float) -> bytes:
        ready, _, _ = select.select([self.number], [], [], max(seconds, 0.0))
        return os.read(self.number, 4096) if ready else b""

    def clear(self) -> None:
        termios.tcflush(self.number, termios.TCIFLUSH)


class PySerial:
    """A port of pyserial, for other systems."""

    def __init__(self, port: Any) -> None:
        self.port = port

    def write(self, data: bytes) -> None:
        self.port.write(data)

    def read(self, seconds: float) -> bytes:
        self.port.timeout = max(seconds, 0.0)
        first = bytes(self.port.read(1))
        return first + bytes(self.port.read(self.port.in_waiting)) if first else b""

    def clear(self) -> None:
        self.port.reset_input_buffer()


@contextmanager
def serial_port(name: str, baud: int) -> Iterator[Port]:
    """An open port: 8 bits, no parity, one stop bit, no flow control.

    Raises InputError for a port that cannot be opened or is none, for a speed that it does not have, and where the line
    breaks.
    """
    try:
        if termios is None:
            with _serial_module().Serial(name, baud, write_timeout=10) as port:
                yield PySerial(port)
            return
        number = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            _set_up(number, baud)
            yield Posix(number)
        finally:
            os.close(number)
    except PORT_ERRORS as error:  # those of pyserial are an OSError
        found = getattr(error, "strerror", None) or str(error.args[-1] if error.args else error)
        raise InputError(
            name, "", found, "a serial port, as /dev/ttyUSB0, that no other program uses"
        ) from error


def _serial_module() -> Any:
    try:
        return import_module("serial")
    except ImportError:
        raise InputError("--port", "", "a system without termios", "pyserial: pip install pyserial") from None


def _set_up(number: int, baud: int) -> None:
    """Raw bytes at a speed."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        known = sorted(int(key[1:]) for key in dir(termios) if key[0] == "B" and key[1:].isdigit())
        raise InputError("--baud", "", str(baud), "one of " + " ".join(str(b) for b in known if b >= 9600))
    state = termios.tcgetattr(number)
    state[0] = state[1] = state[3] = 0
    state[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    state[4] = state[5] = speed
    termios.tcsetattr(number, termios.TCSANOW, state)
    termios.tcflush(number, termios.TCIOFLUSH)


class Frame(NamedTuple):
    """What is sent at once."""

    kind: int
    number: int
    payload: bytes


def frame_bytes(f: Frame) -> bytes:
    """A frame as bytes.

    >>> frame_bytes(Frame(1, 0, b"")).hex(" ")
    'a5 5a 01 00 00 00 79 b8 f8 99'
    """
    body = struct.pack("<BBH", f.kind, f.number, len(f.payload)) + f.payload
    return START + body + struct.pack("<I", zlib.crc32(body))


class SerialLine:
    """Requests and their answers over a port.

    seconds : to wait for an answer; repeated : how often a request was sent again
    """

    def __init__(self, port: Port, where: str, seconds: float) -> None:
        self.port, self.where, self.seconds = port, where, seconds
        self.number, self.repeated, self.rest = 0, 0, b""

    def ask(self, kind: int, payload: bytes) -> bytes:
        """The answer to a request. Raises InputError where none comes, or none that is whole."""
        self.number = (self.number + 1) % 256
        request, heard = frame_bytes(Frame(kind, self.number, payload)), False
        for attempt in range(TRIES):
            if attempt:
                self.repeated += 1
                self.port.clear()
            self.rest = b""
            self.port.write(PADDING + request if attempt else request)
            answer = self._answer(kind)
            if answer is not None:
                return answer
            heard |= bool(self.rest)
        found, expected = f"no answer in {self.seconds:g} s", "a target that runs NAME_pil.c of its export"
        if heard:
            found, expected = "garbled frames", "a line without errors"
        raise InputError(self.where, "", f"{found}, {TRIES} times", f"{expected}, at this speed")

    def _answer(self, kind: int) -> bytes | None:
        """The payload; None where nothing whole comes in time, and where a frame was garbled on its way."""
        end = time.monotonic() + self.seconds
        at, wanted = 0, (kind + ANSWER, self.number)
        while True:
            f, at = next_frame(self.rest, at)
            if f is None:
                left = end - time.monotonic()
                more = self.port.read(left) if left > 0 else b""
                if not more:
                    return None
                self.rest += more
            elif (f.kind, f.number) == wanted:
                return f.payload
            elif f.kind == GARBLED:
                return None


def next_frame(data: bytes, at: int) -> tuple[Frame | None, int]:
    """The first frame from a place on, and the place behind it; None where it is not whole yet.

    A frame whose checksum is wrong is one of kind GARBLED.

    >>> data = b"noise" + frame_bytes(Frame(1, 7, b"ab"))
    >>> next_frame(data, 0), next_frame(data[:-1], 0)
    ((Frame(kind=1, number=7, payload=b'ab'), 17), (None, 5))
    """
    found = data.find(START, at)
    if found < 0:
        return None, max(at, len(data) - 1)
    body = data[found + 2 :]
    length = struct.unpack_from("<H", body, 2)[0] if len(body) >= 4 else 0
    if len(body) < length + 8:
        return None, found
    (crc,) = struct.unpack_from("<I", body, length + 4)
    whole = zlib.crc32(body[: length + 4]) == crc
    f = Frame(body[0], body[1], body[4 : length + 4]) if whole else Frame(GARBLED, 0, b"")
    return f, found + length + 10


BAUD, SECONDS = 115200, 2.0
MAX_ANSWER_TIME = 600.0  # s to wait for an answer
PROTOCOL = 1
HELLO, BEGIN, STEP = 1, 2, 3  # requests
HEAD = "<BBBBHH64s"  # of the answer to HELLO
ORDERS: dict[Precision, str] = {"double": "<f8", "float": "<f4"}  # of numbers on the line


@dataclass(frozen=True)
class ReplayedVector:
    """What a target made of a recorded vector.

    name : of the vector
    samples : of the vector
    differs : the first sample whose bits differ, -1 where none does
    largest : difference of a force (N or N m) or a command to what is expected
    """

    name: str
    samples: int
    differs: int
    largest: float


@dataclass(frozen=True)
class Replay:
    """What a target made of all vectors.

    precision : of the target's numbers
    vectors : one for each
    seconds : that the samples took, with the line, s
    repeated : requests that were sent again
    counts : of the target's timer in its slowest step; 0 where it has none

    >>> import malta
    >>> one = malta.firmware.pil.ReplayedVector("stroke", 60, differs=-1, largest=0.0)
    >>> found = malta.firmware.Replay("float", (one,), seconds=0.5, repeated=0, counts=0)
    >>> found.samples_per_second
    120.0
    """

    precision: Precision
    vectors: tuple[ReplayedVector, ...]
    seconds: float
    repeated: int
    counts: int

    @property
    def agrees(self) -> bool:
        """Whether all bits are those that are expected."""
        return all(v.differs < 0 for v in self.vectors)

    @property
    def samples_per_second(self) -> float:
        """How fast the samples were, with the line."""
        return sum(v.samples for v in self.vectors) / self.seconds


class _Hello(NamedTuple):
    """What a target says of itself."""

    protocol: int
    real_bytes: int
    commands: int
    self_test: int
    readings: int
    answers: int
    sha256: bytes


def replay_on_target(
    gains: str | Path,
    port: str,
    *,
    baud: int = BAUD,
    seconds: float = SECONDS,
    tell: Callable[[float], None] | None = None,
) -> Replay:
    """Replay the recorded vectors of a gain file's controller on a target, over a serial line.

    gains : the gain file that the target's C was exported from
    port : of the serial line, as "/dev/ttyUSB0"
    baud : its speed, bits / s
    seconds : to wait for each answer
    tell : is called with the share that is done

    Returns what the target made of them.

    Raises InputError for a port that cannot be used, and for a target that is silent or whose frames are garbled. It
    also refuses C that was exported from another gain file, and a compiler that changed its arithmetic.

    >>> import malta
    >>> try:
    ...     malta.firmware.replay_on_target("design/gains/halbach.json", "/dev/nothing")
    ... except malta.InputError as error:
    ...     print(error.found)
    No such file or directory
    """
    path = locate(gains)
    positive("replay", "seconds", seconds, below=MAX_ANSWER_TIME)
    sha256 = content_of(path)[0].sha256
    with serial_port(port, baud) as opened:
        line = SerialLine(opened, port, seconds)
        t = _target_of(line, path, sha256)
        vectors = record_vectors(t)
        begin, counts, found = time.perf_counter(), 0, []
        for k, v in enumerate(vectors):
            report = None if tell is None else lambda share, k=k: tell((k + share) / len(vectors))
            one, slowest = _replay(line, t, v, report)
            found.append(one)
            counts = max(counts, slowest)
        return Replay(t.precision, tuple(found), time.perf_counter() - begin, line.repeated, counts)


def _target_of(line: SerialLine, path: Path, sha256: str) -> Target:
    """The export that a target runs. Raises InputError where it is not that of the gain file."""
    answer = line.ask(HELLO, b"")
    if len(answer) != struct.calcsize(HEAD) or answer[0] != PROTOCOL:
        raise InputError(
            line.where, "", f"another protocol than {PROTOCOL}", "NAME_pil.c of this malta's export"
        )
    h = _Hello._make(struct.unpack(HEAD, answer))
    if h.sha256 != sha256.encode():
        found = f"the controller of a gain file with sha256 {h.sha256[:12].decode('ascii', 'replace')}..."
        raise InputError(
            line.where, "", found, f"that of {path.name}, {sha256[:12]}...: export and flash it again"
        )
    if h.self_test != 1:
        raise InputError(
            line.where, "", "a self-test that fails", "C that is compiled as the export's Makefile does"
        )
    c = read_stable(path)
    depth: Fidelity = fidelity_of(plant_of(c.parameters)) if h.commands else "force"
    t = Target(c, "double" if h.real_bytes == 8 else "float", depth)
    read_at_once = sum(f.size for f in (*t.reference_fields, *t.input_fields))
    return replace(t, excited=h.readings > read_at_once)


def _replay(
    line: SerialLine, t: Target, v: Vector, tell: Callable[[float], None] | None
) -> tuple[ReplayedVector, int]:
    """What the target makes of a vector, and the counts of its slowest step."""
    real, order = t.real, ORDERS[t.precision]
    line.ask(BEGIN, bytes([int(v.warm)]))
    differs, largest, slowest = -1, 0.0, 0
    for k in range(SAMPLES):
        answer = line.ask(STEP, np.asarray(v.readings[k], dtype=order).tobytes())
        expected: Any = np.asarray(v.expected[k], dtype=real)
        if len(answer) != 1 + expected.nbytes + 8:
            size = f"an answer of {len(answer)} bytes to a step"
            raise InputError(
                line.where, "", size, f"{1 + expected.nbytes + 8}: NAME_pil.c of this malta's export"
            )
        found = np.frombuffer(answer, dtype=order, count=len(expected), offset=1)
        counts, checksum = struct.unpack_from("<II", answer, 1 + expected.nbytes)
        same = answer[0] == 1 and checksum == v.checksums[k] and np.array_equal(found, expected)
        if not same and differs < 0:
            differs = k
        off = float(np.max(np.abs(found - expected)))
        largest = max(largest, off) if math.isfinite(off) else math.inf
        slowest = max(slowest, counts)
        if tell is not None:
            tell((k + 1) / SAMPLES)
    return ReplayedVector(v.name, SAMPLES, differs, largest), slowest
