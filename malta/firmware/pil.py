"""Processor in the loop: the recorded vectors over a serial line, and what a target makes of them.

The target runs NAME_pil.c of an exported folder. Every bit of its outputs and its whole state is compared, by the
checksum that NAME_test.c compares as well.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.files import locate
from malta.firmware.elementary import Precision
from malta.firmware.program import TYPES
from malta.firmware.serial_line import Line, serial_port
from malta.firmware.signals import Target, fidelity_of
from malta.firmware.vectors import SAMPLES, Vector, record_vectors
from malta.gains.file import content_of, read
from malta.model.data import plant_of
from malta.proof.arguments import positive
from malta.simulation.layout import Fidelity

BAUD, SECONDS = 115200, 2.0
LONGEST = 600.0  # s to wait for an answer
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
    >>> found = malta.Replay("float", (one,), seconds=0.5, repeated=0, counts=0)
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

    Raises InputError for a port that cannot be used, a target that is silent or whose frames are garbled, that was
    exported from another gain file, or whose compiler changed its arithmetic.

    >>> import malta
    >>> try:
    ...     malta.replay_on_target("design/gains/halbach.json", "/dev/nothing")
    ... except malta.InputError as error:
    ...     print(error.found)
    No such file or directory
    """
    path = locate(gains)
    positive("replay", "seconds", seconds, below=LONGEST)
    sha256 = content_of(path)[0].sha256
    with serial_port(port, baud) as opened:
        line = Line(opened, port, seconds)
        t = _target_of(line, path, sha256)
        vectors = record_vectors(t)
        begin, counts, found = time.perf_counter(), 0, []
        for k, v in enumerate(vectors):
            report = None if tell is None else lambda share, k=k: tell((k + share) / len(vectors))
            one, slowest = _replay(line, t, v, report)
            found.append(one)
            counts = max(counts, slowest)
        return Replay(t.precision, tuple(found), time.perf_counter() - begin, line.repeated, counts)


def _target_of(line: Line, path: Path, sha256: str) -> Target:
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
    c = read(path)
    depth: Fidelity = fidelity_of(plant_of(c.parameters)) if h.commands else "force"
    return Target(c, "double" if h.real_bytes == 8 else "float", depth)


def _replay(
    line: Line, t: Target, v: Vector, tell: Callable[[float], None] | None
) -> tuple[ReplayedVector, int]:
    """What the target makes of a vector, and the counts of its slowest step."""
    real, order = TYPES[t.precision], ORDERS[t.precision]
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
