"""The ring buffer of an exported controller: its last samples at the rate of the law, with the state before each block.

A sample is read and commanded in its place in the ring: the caller's `in` and `out` are the ring's. Beside that a step
copies the reference, and at the begin of each block what the law remembers, so that a replay can begin there.
docs/formats/log.md describes the dump.
"""

from __future__ import annotations

import math
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.firmware.ctext import c_number
from malta.firmware.export import comment, render
from malta.firmware.program import TYPES
from malta.firmware.signals import Field, Target, input_fields, output_fields, reference_fields, state_fields
from malta.model.plant import Signal

MAGIC = b"MALTALOG"
LAYOUT = 1  # version of the record
ORDER = 0x01020304
SHARE = 8  # blocks that hold the samples that are asked for; one more is being written
LARGEST = 2_000_000_000  # bytes of a ring
CAUSES = ("RUNS", "CALL", "FAULT", "THRESHOLD")
FLOWN = Field("flown", (Signal("flown", "1"),), "1 where the law ran")
MEMBERS = (
    ("period", "samples of a period of the excitation; 0: none, or the caller does not say"),
    ("watched", "output whose used reading is a trigger beyond `threshold`; -1: none"),
    ("next", "row of the sample that comes"),
    ("wrapped", "1 where the rows from `next` on have older samples"),
    ("in_block", "samples since the begin of the block"),
    ("cause", "of the trigger"),
    ("triggered", "row of the sample with the trigger; -1: none"),
    ("left", "samples that follow a trigger still"),
    ("stopped", "1 where the ring has stopped"),
)
HEAD = 8 + 4 * (3 + len(MEMBERS))  # bytes before the text


class Ring(NamedTuple):
    """The size of a ring: samples of a block, numbers of a sample and of a state, the lines that describe them."""

    block: int
    sample: tuple[tuple[str, Field], ...]  # "in.y" and so on
    state: tuple[Field, ...]
    text: tuple[str, ...]
    real_bytes: int

    @property
    def blocks(self) -> int:
        return SHARE + 1

    @property
    def rows(self) -> int:
        return self.block * self.blocks

    @property
    def text_bytes(self) -> int:
        """Of all lines with their ends, up to a multiple of 8: what follows is aligned."""
        return -(-sum(len(line) + 1 for line in self.text) // 8) * 8

    @property
    def numbers(self) -> int:
        """Of a sample."""
        return sum(field.size for _, field in self.sample)

    @property
    def remembered(self) -> int:
        """Numbers of a state."""
        return sum(field.size for field in self.state)

    @property
    def memory(self) -> int:
        """Bytes of the whole record."""
        reals = 1 + self.blocks * self.remembered + (self.rows + 1) * self.numbers
        return HEAD + self.text_bytes + self.real_bytes * reals


def ring_of(t: Target, sha256: str) -> Ring:
    """The ring of an export. Raises InputError for a time that no memory holds.

    ring_of(Target(controller, logged=0.1), sha256).memory
    """
    c = t.controller
    parts = {"reference": reference_fields(t), "in": input_fields(t), "out": output_fields(t)}
    sample = tuple((f"{part}.{f.name}", f) for part, fields in parts.items() for f in fields if f.size)
    sample += (("flown", FLOWN),)
    state = tuple(f for f in state_fields(t) if f.size)
    # Of a huge time the block is not computed: its memory is refused.
    block = math.ceil(min(t.logged / c.sample_time, LARGEST) / SHARE - 1e-9)
    head = {
        "machine": t.believed.name,
        "controller": c.name,
        "gains": sha256,
        "sample_time": repr(float(c.sample_time)),
        "precision": t.precision,
        "fidelity": t.fidelity,
        "excited": str(int(t.excited)),
        "tunable": str(int(t.tunable)),
        "block": str(block),
        "blocks": str(SHARE + 1),
    }
    lines = [[key, value] for key, value in head.items()]
    lines += [[name, *_headings(f)] for name, f in sample]
    lines += [[f"state.{f.name}", *_headings(f)] for f in state]
    text = tuple("\t".join(comment(word).replace('"', "'") for word in line) for line in lines)
    ring = Ring(block, sample, state, text, TYPES[t.precision]().itemsize)
    if ring.memory > LARGEST:
        found = f"{t.logged:g} s of {ring.numbers * ring.real_bytes} bytes a sample"
        raise InputError("export", "log", found, f"at most {LARGEST:.0e} bytes in all")
    return ring


def _headings(field: Field) -> list[str]:
    return [f"{s.name} [{s.unit}]" for s in field.signals]


def ring_sources(t: Target, sha256: str, name: str) -> dict[str, str]:
    """The C files of the ring by name; none of an export without."""
    if not t.logged:
        return {}
    ring = ring_of(t, sha256)
    starts = np.cumsum([0, *(f.size for f in ring.state)]).tolist()
    context: dict[str, Any] = {
        "name": name,
        "NAME": name.upper(),
        "title": comment(t.controller.name),
        "version": version("malta"),
        "log_version": LAYOUT,
        "seconds": f"{t.logged:g}",
        "rows": ring.rows,
        "block": ring.block,
        "blocks": ring.blocks,
        "memory": ring.memory,
        "remembered": ring.remembered,
        "text_bytes": ring.text_bytes,
        "text": [line.replace("\t", "\\t") for line in ring.text],
        "causes": CAUSES,
        "members": MEMBERS,
        "magic": ", ".join(f"'{letter}'" for letter in MAGIC.decode()),
        "placed_state": list(zip(ring.state, starts, strict=False)),
        "reference": reference_fields(t),
        "outputs": len(t.controller.measurements),
        "zero": c_number(0.0, t.precision),
    }
    return {f"{name}_log.{end}": render(f"log.{end}", context) for end in ("h", "c")}
