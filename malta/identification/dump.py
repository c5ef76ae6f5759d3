"""Dumps of the ring buffer of an exported controller: read as logs, and replayed to the bit with the same C.

docs/formats/log.md describes the bytes. A replay begins with the state that the ring kept before its oldest block, and
runs through: where the state kept before a later block is another one (a supervisor started the law anew), it goes on
from that.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import InputError
from malta.files import read_file
from malta.firmware.flight import compile_controller, new_state
from malta.firmware.signals import Target
from malta.firmware.sources import (
    CAUSES,
    HEAD,
    LAYOUT,
    MAGIC,
    MAX_RING_BYTES,
    MEMBERS,
    ORDER,
    RingLayout,
    ring_of,
)
from malta.synthesis.controller import Controller

WORDS = ("machine", "controller", "gains", "sample_time", "precision", "fidelity")
COUNTS = ("excited", "tunable", "block", "blocks")
PARTS = ("reference.", "in.", "out.", "flown")
COMPARED_COLUMNS = ("out.v", "out.command")
MOST_TEXT = 10_000_000  # bytes that name signals


class Dump(NamedTuple):
    """A dump in the order of time: what it says of itself, its samples, and the states before its blocks."""

    words: Mapping[str, str]
    headings: Mapping[str, list[str]]  # of each vector of a sample, as "in.y", and of a state, as "state.e"
    rows: Any  # k, a structured array with these vectors
    states: Mapping[int, FloatArray]  # before these samples
    period: int  # samples; 0: none
    trigger: int | None  # sample
    cause: str


def read_dump(content: bytes, path: Path) -> Dump:
    """A dump from its bytes. Raises InputError for what is none, for another version, and for damage."""
    if content[:8] != MAGIC:
        raise InputError(path, "magic", repr(content[:8]), f"{MAGIC!r}: the bytes of a ring buffer")
    ends = [end for end in "<>" if content[8:12] == np.array(ORDER, f"{end}u4").tobytes()]
    if not ends or len(content) < HEAD:
        raise InputError(path, "order", f"bytes {content[8:12].hex()}", "the order of a processor's bytes")
    numbers = np.frombuffer(content, f"{ends[0]}i4", offset=12, count=2 + len(MEMBERS)).tolist()
    version, text_bytes = numbers[:2]
    member = dict(zip([name for name, _ in MEMBERS], numbers[2:], strict=True))
    if version != LAYOUT:
        raise InputError(path, "version", str(version), f"{LAYOUT}, of this version of malta")
    if not 0 < text_bytes <= MOST_TEXT:
        raise InputError(path, "text_bytes", str(text_bytes), f"1 to {MOST_TEXT}")
    words, headings, real, at = _read_description(content, text_bytes, path)
    of = np.dtype(f"{ends[0]}f{real}")
    sample = np.dtype([(n, of, (len(h),)) for n, h in headings.items() if n.startswith(PARTS)])
    kept = sum(len(h) for n, h in headings.items() if n.startswith("state."))
    block, blocks = int(words["block"]), int(words["blocks"])
    size = at + real * blocks * kept + (block * blocks + 1) * sample.itemsize
    if not 0 <= len(content) - size < 8:  # a compiler may align the end
        raise InputError(path, "", f"{len(content)} bytes", f"{size}, by the sizes that the dump names")
    memory = np.frombuffer(content, of, offset=at, count=blocks * kept).reshape(blocks, kept)
    rows = np.frombuffer(content, sample, offset=at + memory.nbytes, count=block * blocks)
    order = _order(member, block, blocks, path)
    native = rows.dtype.newbyteorder("=")
    places = {k: memory[row // block] for k, row in enumerate(order.tolist()) if row % block == 0}
    triggered = np.flatnonzero(order == member["triggered"]).tolist()
    states = {k: values.astype(of.newbyteorder("=")) for k, values in places.items()}
    cause = CAUSES[member["cause"]]
    return Dump(
        words, headings, rows[order].astype(native), states,
        member["period"], triggered[0] if triggered and cause != "RUNS" else None, cause.lower(),
    )  # fmt: skip


def _read_description(
    content: bytes, count: int, path: Path
) -> tuple[dict[str, str], dict[str, list[str]], int, int]:
    """What the text of a dump says: words, headings by vector, bytes of a number, and where the text ends."""
    where = {real: content[HEAD + real : HEAD + real + count] for real in (8, 4)}
    named = [real for real, text in where.items() if text.startswith(b"machine\t")]
    if not named:
        raise InputError(path, "text", "no names of signals", "those that the ring writes")
    real = named[0]
    try:
        lines = [line.split("\t") for line in where[real].rstrip(b"\0").decode("ascii").splitlines()]
    except UnicodeDecodeError as error:
        raise InputError(path, "text", "bytes that are not ASCII", "names of signals") from error
    words = {line[0]: line[1] for line in lines if len(line) == 2 and line[0] in (*WORDS, *COUNTS)}
    headings = {line[0]: line[1:] for line in lines if line[0].startswith((*PARTS, "state."))}
    for name in (*WORDS, *COUNTS):
        if name not in words or (name in COUNTS and not words[name].isdecimal()):
            raise InputError(path, name, repr(words.get(name, "nothing")), "a word that the ring writes")
    if words["precision"] != {8: "double", 4: "float"}[real]:
        raise InputError(path, "precision", words["precision"], f"numbers of {real} bytes")
    for name in ("reference.p", "in.y", "in.y_valid", "out.v", "out.saturated", "state.xi_pred", "flown"):
        if name not in headings:
            raise InputError(path, name, "no such signals", "those that the ring writes")
    return words, headings, real, HEAD + real + count


def _order(member: Mapping[str, int], block: int, blocks: int, path: Path) -> Any:
    """The rows with samples in the order of time, from the first whose state is known."""
    rows, following = block * blocks, member["next"]
    limits = {"next": rows, "in_block": block, "cause": len(CAUSES), "stopped": 2, "wrapped": 2}
    for name, limit in limits.items():
        if not 0 <= member[name] < limit:
            raise InputError(path, name, str(member[name]), f"0 to {limit - 1}")
    if not member["wrapped"]:
        begin, count = 0, following
    elif member["stopped"] and following % block == 0:
        begin, count = following, rows
    else:
        begin = (following // block + 1) * block % rows
        count = (following - begin) % rows
    if count < 2:
        raise InputError(path, "next", f"{count} samples", "two at least")
    return (begin + np.arange(count)) % rows


@np.errstate(over="ignore", invalid="ignore")  # of damaged bytes; what is no reading is refused
def decode_dump(content: bytes, path: Path) -> Any:
    """Head, times, tables and headings of a dump, as `malta.identification.read_log` has them of every file.

    Readings that are called invalid are missing; voltages are duty cycles or shares of the link times its voltage;
    while gates are off forces are zero.
    """
    dump = read_dump(content, path)
    rows, given = dump.rows, dump.headings
    Ts = math.nan
    with suppress(ValueError):
        Ts = float(dump.words["sample_time"])
    if not 0 < Ts < math.inf:
        raise InputError(path, "sample_time", dump.words["sample_time"], "a number of seconds")

    def readings(name: str) -> FloatArray:
        sound = np.isfinite(rows[name]) & (rows[f"{name}_valid"] == 1)
        return np.asarray(np.where(sound, rows[name], np.nan), dtype=float)

    off = rows["flown"] == 0
    tables = {"y": readings("in.y"), "v": np.where(off, 0.0, rows["out.v"])}
    headings = {"y": given["in.y"], "v": given["out.v"]}
    if "in.i" in given and "in.link" in given and "out.command" in given:
        tables["i"], headings["i"] = readings("in.i"), given["in.i"]
        middle = 0.5 if given["out.command"][0].startswith("d_") else 0.0
        tables["u"] = (np.asarray(rows["out.command"], dtype=float) - middle) * rows["in.link"]
        headings["u"] = [h.replace("i_", "u_", 1).replace("[A]", "[V]") for h in _currents(given)]
    tables["reference"] = np.asarray(rows["reference.p"], dtype=float)
    headings["reference"] = given["in.y"]
    if "in.excitation" in given:
        tables["excitation"] = np.asarray(rows["in.excitation"], dtype=float)
        headings["excitation"] = given["out.v"]
    trigger = np.arange(len(rows)) == (-1 if dump.trigger is None else dump.trigger)
    tables["flags"] = np.column_stack([rows["out.saturated"], trigger, off]).astype(float)
    forces = [heading.split(" [")[0] for heading in given["out.v"]]
    headings["flags"] = [*(f"{name}_limit [1]" for name in forces), "trigger [1]", "off [1]"]
    head = {name: dump.words[name] for name in ("machine", "controller")}
    return head | {"sample_time": Ts, "period": dump.period * Ts}, Ts * np.arange(len(rows)), tables, headings


def _currents(given: Mapping[str, list[str]]) -> list[str]:
    """Headings of the currents that the commands drive, in their order."""
    return ["i_" + heading[2:].replace("[1]", "[A]") for heading in given["out.command"]]


@display
@dataclass(frozen=True)
class ExactReplay:
    """The exported C on the samples of a dump.

    samples : that were computed again: those in which the law ran, but for the rest of a block in which it started
    same : of these, with the commands of the dump to the bit
    first : the first one that differs, s; None: none does
    difference : by input: the largest difference of commands, N or N m
    restarts : how often the state before a block was not the one that the replay had

    >>> import malta
    >>> malta.identification.ExactReplay(2000, 2000, None, {"f_D": 0.0}, 0).same
    2000
    """

    samples: int
    same: int
    first: float | None
    difference: Mapping[str, float]
    restarts: int

    @property
    def description(self) -> Description:
        """How many samples agree."""
        rows = [("to the bit", f"{self.same} of {self.samples}"), ("restarts", f"{self.restarts}")]
        if self.first is not None:
            rows.append(("differs from", f"{self.first:.6g} s"))
        return Description("Replay of a dump", tuple(rows))


def replay_dump(controller: Controller, path: str | Path) -> ExactReplay:
    """Run the exported C of a gain file on the samples of a dump, and compare its commands to the bit.

    The C is written and compiled for this computer: its bits are those of every processor. It begins with the state
    that the ring kept before its oldest block, with the v0(z) and the parameters of the gain file.

    controller : the gain file whose export wrote the dump
    path : of the dump

    Returns an ExactReplay, also where commands differ.

    Raises InputError for a file that is no dump, for the dump of another export, and without a C compiler.

    >>> import malta
    >>> malta.identification.replay_dump.__annotations__["return"]
    'ExactReplay'
    """
    path = Path(path)
    dump = read_dump(read_file(path, "dump", Path.read_bytes, MAX_RING_BYTES), path)
    words, Ts = dump.words, controller.sample_time
    marks: dict[str, Any] = {name: words[name] == "1" for name in ("excited", "tunable")}
    t = Target(
        controller, cast("Any", words["precision"]), cast("Any", words["fidelity"]), **marks, logged=Ts
    )
    _require_same_fields(ring_of(t, ""), dump, path)
    out, known, restarts = _recompute(t, dump)
    if not known.any():
        raise InputError(path, "flown", "no sample of a law whose state is known", "one at least")
    alike = np.ones(len(out), dtype=bool)
    for name in (name for name in COMPARED_COLUMNS if name in dump.headings):
        alike &= (_bits(out[name]) == _bits(dump.rows[name])).all(axis=1)
    off = np.abs(out["out.v"][known].astype(float) - dump.rows["out.v"][known]).max(axis=0)
    difference = dict(zip([s.name for s in controller.forces], off.tolist(), strict=True))
    other = np.flatnonzero(known & ~alike)
    first = float(other[0] * Ts) if len(other) else None
    return ExactReplay(int(known.sum()), int((known & alike).sum()), first, difference, restarts)


def _bits(table: Any) -> Any:
    """Numbers as whole numbers with their bits."""
    table = np.ascontiguousarray(table)
    return table.view(f"u{table.dtype.itemsize}")


def _require_same_fields(ring: RingLayout, dump: Dump, path: Path) -> None:
    """Raise InputError where a dump has other vectors than the export of the gain file."""
    own = {line.split("\t")[0]: line.split("\t")[1:] for line in ring.text}
    for name, headings in dump.headings.items():
        if own.get(name) != headings:
            found = f"{len(headings)} signals, {' '.join(headings[:3])} ..."
            expected = " ".join(own[name][:3]) + " ..." if name in own else "none in this export"
            raise InputError(path, name, found, f"those of the gain file's export: {expected}")


def _recompute(t: Target, dump: Dump) -> tuple[Any, Any, int]:
    """What the C commands at each sample, as a structured array; where its state is known; how often it was set."""
    native = compile_controller(t)
    step, state = getattr(native.lib, f"{native.name}_step"), new_state(native)
    rows = np.ascontiguousarray(dump.rows)
    fields: Mapping[str, Any] = rows.dtype.fields or {}
    names = [name for name in fields if name.startswith("out.")]
    out = np.zeros(len(rows), dtype=[(name, fields[name][0]) for name in names])
    read, asked = fields["in.y"][1], fields["reference.p"][1]
    reference = ctypes.addressof(state) + native.State.reference.offset
    count, restarts = ctypes.sizeof(native.Reference), -1
    flown, sure, known = rows["flown"].ravel() == 1, False, np.zeros(len(rows), dtype=bool)
    for k in range(len(rows)):
        kept = dump.states.get(k)
        if kept is not None and kept.tobytes() != ctypes.string_at(ctypes.addressof(state), kept.nbytes):
            ctypes.memmove(ctypes.addressof(state), kept.tobytes(), kept.nbytes)
            restarts += 1
        sure = bool(flown[k]) and (k == 0 or bool(flown[k - 1])) and (sure or kept is not None)
        if not sure:
            continue
        known[k] = True
        place = rows.ctypes.data + k * rows.itemsize
        ctypes.memmove(reference, place + asked, count)
        step(
            ctypes.byref(state),
            ctypes.c_void_p(place + read),
            ctypes.c_void_p(out.ctypes.data + k * out.itemsize),
        )
    return out, known, max(restarts, 0)
