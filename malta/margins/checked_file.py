"""A certificate file as `check` reads it: every field checked, every number an exact rational.

Numbers are hex floats or JSON numbers that are doubles; their sizes and counts are limited, so that no file takes
unbounded time or memory.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flint import fmpq

from malta.errors import InputError

FORMAT, VERSION = "malta margin certificate", 1
LARGEST = 4_000_000  # bytes
ARITY = {
    "assign": 1, "neg": 1, "sq": 1, "twice": 1, "inv": 1, "constpow": 1,
    "add": 2, "sub": 2, "mul": 2, "div": 2, "input": 0, "const": 0,
}  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """p in [nominal - t down, nominal + t up], or in nominal + over whatever t is."""

    name: str
    nominal: Any
    down: Any
    up: Any
    over: tuple[Any, Any]


@dataclass(frozen=True)
class Cell:
    """Where Re(conj(re + j im) a) > 0 is claimed: x in [low, high], v in its shares of the part's box.

    Branch 0: s = j x 2^scale; branch 1: s = j 2^scale / x.
    """

    branch: int
    low: Any
    high: Any
    box: tuple[tuple[Any, Any], ...]
    re: Any
    im: Any


@dataclass(frozen=True)
class Part:
    """A part of the box of p, and its cells."""

    box: tuple[tuple[Any, Any], ...]
    scale: int
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Group:
    """States of the system and of the compensator; parameters whose v is 1 / p."""

    states: tuple[int, ...]
    own: tuple[int, ...]
    inverted: tuple[bool, ...]
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Loop:
    """x' = A x + B u (x+ where discrete), y = C x, u = F y after hold, delay (samples) and lag (rad/s)."""

    states: int
    steps: tuple[tuple[str, int, tuple[int, ...], Any], ...]
    entries: tuple[tuple[tuple[int, int, int], ...], ...]  # of A, B, C: row, column, step
    law_a: list[list[Any]]
    law_b: list[list[Any]]
    law_c: list[list[Any]]
    law_d: list[list[Any]]
    sample_time: Any
    discrete: bool
    delay: int
    lag: Any
    groups: tuple[Group, ...]


@dataclass(frozen=True)
class Document:
    """What is claimed: box(lower) is stable, of each loop."""

    parameters: tuple[Parameter, ...]
    lower: Any
    loops: tuple[Loop, ...]


class Reader:
    """Fields of one file, with its name in every complaint."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def wrong(self, field: str, found: Any, expected: str) -> InputError:
        return InputError(self.path, field, repr(found)[:60], expected)

    def get(self, table: Any, key: str) -> Any:
        if not isinstance(table, dict):
            raise self.wrong(key, table, "a table that holds it")
        if key not in table:
            raise InputError(self.path, key, "nothing", "a value")
        return table[key]

    def items(self, value: Any, field: str, least: int, most: int) -> list[Any]:
        if not isinstance(value, list) or not least <= len(value) <= most:
            raise self.wrong(field, value, f"a list of {least} to {most} items")
        return value

    def whole(self, value: Any, field: str, low: int, high: int) -> int:
        if type(value) is not int or not low <= value <= high:
            raise self.wrong(field, value, f"a whole number from {low} to {high}")
        return value

    def number(self, value: Any, field: str) -> Any:
        """A double as a rational."""
        found = value
        if isinstance(value, str) and len(value) <= 40:
            try:
                found = float.fromhex(value)
            except (ValueError, OverflowError):
                found = None
        if type(found) is int and abs(found) <= 2**53:
            found = float(found)
        if type(found) is not float or not (found == 0 or 1e-90 < abs(found) < 1e90):
            raise self.wrong(field, value, "a finite number, zero or of a size from 1e-90 to 1e90")
        return fmpq(*found.as_integer_ratio())

    def pair(self, value: Any, field: str) -> tuple[Any, Any]:
        low, high = (self.number(x, field) for x in self.items(value, field, 2, 2))
        if not low <= high:
            raise self.wrong(field, value, "low, high")
        return low, high

    def matrix(self, value: Any, field: str, rows: int | None, columns: int | None) -> list[list[Any]]:
        table = self.items(value, field, 0 if rows is None else rows, 60 if rows is None else rows)
        wanted = len(table) if columns is None else columns
        return [[self.number(x, field) for x in self.items(row, field, wanted, wanted)] for row in table]

    def indices(self, value: Any, field: str, count: int) -> tuple[int, ...]:
        return tuple(self.whole(i, field, 0, count - 1) for i in self.items(value, field, 0, max(count, 1)))

    # records

    def parameter(self, value: Any) -> Parameter:
        name = self.get(value, "name")
        if not isinstance(name, str) or len(name) > 100:
            raise self.wrong("name", name, "a parameter's name")
        nominal, down, up = (
            self.number(self.get(value, key), f"{name}.{key}") for key in ("nominal", "down", "up")
        )
        over = self.pair(self.get(value, "over"), f"{name}.over")
        if down < 0 or up < 0 or not over[0] <= 0 <= over[1]:
            raise self.wrong(name, value, "a range about the nominal value")
        return Parameter(name, nominal, down, up, over)

    def steps(self, value: Any, inputs: int) -> tuple[tuple[str, int, tuple[int, ...], Any], ...]:
        found = []
        for k, row in enumerate(self.items(value, "steps", 0, 20_000)):
            name, target, on, constant = self.items(row, f"steps[{k}]", 4, 4)
            if not isinstance(name, str) or name not in ARITY:
                raise self.wrong(f"steps[{k}]", name, "one of " + " ".join(ARITY))
            operands = self.indices(on, f"steps[{k}]", k)
            if len(operands) != ARITY[name]:
                raise self.wrong(f"steps[{k}]", on, f"{ARITY[name]} operands")
            amount = self.number(constant, f"steps[{k}]")
            if name == "constpow" and (amount.q != 1 or abs(amount) > 32):
                raise self.wrong(f"steps[{k}]", constant, "a whole power up to 32")
            place = self.whole(target, f"steps[{k}]", 0, inputs - 1 if name == "input" else 0)
            found.append((name, place, operands, amount))
        return tuple(found)

    def entries(
        self, value: Any, field: str, shape: tuple[int, int], count: int
    ) -> tuple[tuple[int, int, int], ...]:
        found = {}
        for row in self.items(value, field, 0, shape[0] * shape[1]):
            i, j, step = self.items(row, field, 3, 3)
            at = self.whole(i, field, 0, shape[0] - 1), self.whole(j, field, 0, shape[1] - 1)
            found[at] = self.whole(step, field, 0, count - 1)
        return tuple((*at, step) for at, step in found.items())

    def loop(self, value: Any, inputs: int) -> Loop:
        n, m, p = (self.whole(x, "shape", 1, 60) for x in self.items(self.get(value, "shape"), "shape", 3, 3))
        steps = self.steps(self.get(value, "steps"), inputs)
        shapes = {"A": (n, n), "B": (n, m), "C": (p, n)}
        entries = tuple(
            self.entries(self.get(value, key), key, shape, len(steps)) for key, shape in shapes.items()
        )
        law = self.get(value, "compensator")
        a = self.matrix(self.get(law, "A"), "compensator.A", None, None)
        k = len(a)
        b, c, d = (
            self.matrix(self.get(law, key), f"compensator.{key}", *shape)
            for key, shape in (("B", (k, p)), ("C", (m, k)), ("D", (m, p)))
        )
        T, lag = (
            None if self.get(value, key) is None else self.number(value[key], key)
            for key in ("sample_time", "lag")
        )
        discrete = self.get(value, "discrete")
        if type(discrete) is not bool or (discrete and (T is None or lag is not None)):
            raise self.wrong("discrete", discrete, "true or false, with a sample time and without a lag")
        delay = self.whole(self.get(value, "delay"), "delay", 0, 20 if T is not None else 0)
        for key, x in (("sample_time", T), ("lag", lag)):
            if x is not None and not x > 0:
                raise self.wrong(key, value[key], "a number above zero")
        groups = tuple(
            self.group(g, n, k, inputs) for g in self.items(self.get(value, "groups"), "groups", 0, n + k)
        )
        return Loop(n, steps, entries, a, b, c, d, T, discrete, delay, lag, groups)

    def group(self, value: Any, n: int, k: int, inputs: int) -> Group:
        inverted = self.items(self.get(value, "inverted"), "inverted", inputs, inputs)
        if not all(type(x) is bool for x in inverted):
            raise self.wrong("inverted", inverted, "true or false for each parameter")
        parts = tuple(self.part(x, inputs) for x in self.items(self.get(value, "parts"), "parts", 0, 256))
        states = self.indices(self.get(value, "states"), "states", n)
        own = self.indices(self.get(value, "own"), "own", k)
        return Group(states, own, tuple(inverted), parts)

    def part(self, value: Any, inputs: int) -> Part:
        box = tuple(self.pair(x, "box") for x in self.items(self.get(value, "box"), "box", inputs, inputs))
        cells = []
        for row in self.items(self.get(value, "cells"), "cells", 1, 20_000):
            branch, low, high, own, re, im = self.items(row, "cells", 6, 6)
            x = self.pair([low, high], "cells")
            shares = tuple(self.pair(s, "cells") for s in self.items(own, "cells", inputs, inputs))
            if x[0] < 0 or any(s[0] < 0 or s[1] > 1 for s in shares):
                raise self.wrong("cells", row, "frequencies from 0, shares from 0 to 1")
            c = self.number(re, "cells"), self.number(im, "cells")
            cells.append(Cell(self.whole(branch, "cells", 0, 1), *x, shares, *c))
        return Part(box, self.whole(self.get(value, "scale"), "scale", -300, 300), tuple(cells))


def digest(content: dict[str, object]) -> str:
    """sha256 of everything in a certificate but that."""
    rest = {key: value for key, value in content.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def content_of(path: Path) -> dict[str, Any]:
    """The JSON of a certificate. Raises InputError for what is none."""
    reader = Reader(path)
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(path, "", "a file that is too large", f"at most {LARGEST} bytes")
        content = json.loads(path.read_bytes().decode())
    except OSError as error:
        raise InputError(path, "", error.strerror or "an unreadable file", "a certificate") from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", f"no JSON ({str(error)[:80]})", "a certificate") from error
    if reader.get(content, "format") != FORMAT or reader.get(content, "version") != VERSION:
        raise reader.wrong("format", [content["format"], content["version"]], f"{FORMAT}, version {VERSION}")
    assert isinstance(content, dict)
    return content


def read(path: Path, gains: Path | None) -> tuple[Document, str]:
    """A certificate, and why it is refused before its proof is looked at: empty if it is not.

    Raises InputError for files that cannot be read, and fields that are missing or wrong.
    """
    content, reader = content_of(path), Reader(path)
    own, of = reader.get(content, "sha256"), reader.get(reader.get(content, "gains"), "sha256")
    refused = "" if own == digest(content) else "the file was changed after it was written (sha256)"
    if gains is not None and not refused:
        try:
            found = hashlib.sha256(gains.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(gains, "", error.strerror or "an unreadable file", "a gain file") from error
        if found != of:
            refused = f"the certificate is of another gain file than {gains} (sha256)"
    parameters = tuple(
        reader.parameter(x) for x in reader.items(reader.get(content, "parameters"), "parameters", 1, 20)
    )
    lower = reader.number(reader.get(content, "lower"), "lower")
    if not 0 < lower < 10_000:
        raise reader.wrong("lower", content["lower"], "a number above zero, up to 10000")
    loops = tuple(
        reader.loop(x, len(parameters)) for x in reader.items(reader.get(content, "loops"), "loops", 1, 20)
    )
    return Document(parameters, lower, loops), refused
