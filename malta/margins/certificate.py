"""The proof of a margin as a file, which `check` confirms: matrices, parameters, claim, and the cells of each group.

The cells are found here, by the same branch and bound as the margin but for the polynomial that `check` builds by
itself, and without couplings taken as zero: a claim a little below the margin's own lower bound.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import ctx
from scipy import sparse

from malta.errors import CheckError, InputError
from malta.files import replace_files
from malta.margins import checked_file
from malta.margins import loop as loops
from malta.margins.box import Box, box_of
from malta.margins.check import Enclosure, enclose
from malta.margins.checked_loop import (
    Polynomial,
    Refused,
    Tables,
    coupled,
    split,
)
from malta.margins.exclusion import Growth, advance, start
from malta.margins.expressions import FIELD, exact
from malta.margins.family import Family, binary
from malta.margins.systems import compensator_of

if TYPE_CHECKING:
    from malta.margins.robust import Margin, Ranges
    from malta.margins.uncertain import Compensator, UncertainSystem
    from malta.model.plant import FloatArray

SHARE = 0.999  # of the margin's lower bound that is claimed
MOST_CELLS = 60_000  # that are looked at for one group
MOST_PARTS = 64

Places = Sequence[tuple["UncertainSystem", "Compensator"]]


def write(
    path: str | Path,
    places: Places,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None,
    margin: Margin,
    gains: str | Path | None = None,
) -> Path:
    """Write the certificate of a margin; `places`: its loops, several where it holds at several places.

    Raises InputError for loops that certificates do not cover, CheckError where nothing is proven or no proof found.
    """
    content = certificate_of(places, ranges, over, margin, gains)
    replace_files({Path(path): (json.dumps(content, separators=(",", ":")) + "\n").encode()})
    return Path(path)


def certificate_of(
    places: Places,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None,
    margin: Margin,
    gains: str | Path | None = None,
) -> dict[str, Any]:
    """What `write` writes, as one JSON document."""
    if margin.lower is None:
        raise CheckError(f"no certificate: nothing is proven ({margin.reason})")
    lower = SHARE * margin.lower
    system = places[0][0]
    box = box_of(system.names, system.nominal, system.limits, ranges, over or {})
    content: dict[str, Any] = {
        "format": checked_file.FORMAT,
        "version": checked_file.VERSION,
        "malta": version("malta"),
        "gains": {"name": None, "sha256": None},
        "lower": lower.hex(),
        "parameters": [
            {
                "name": name,
                "nominal": box.nominal[i].hex(),
                "down": box.down[i].hex(),
                "up": box.up[i].hex(),
                "over": [x.hex() for x in box.over[i].tolist()],
            }
            for i, name in enumerate(box.names)
        ],
        "loops": [_loop(*place, box, lower) for place in places],
    }
    if gains is not None:
        found = hashlib.sha256(Path(gains).read_bytes()).hexdigest()
        content["gains"] = {"name": Path(gains).name, "sha256": found}
    return content | {"sha256": checked_file.digest(content)}


def matches(path: str | Path, places: Places) -> bool:
    """Whether a certificate's loops and nominal values are these, to the last digit."""
    content = checked_file.content_of(Path(path))
    found = content["loops"]
    own = [_described(loops.loop_of(s, _law(s, law))) for s, law in places]
    nominal = [float(x).hex() for x in places[0][0].nominal]
    return (
        len(found) == len(own)
        and [p["nominal"] for p in content["parameters"]] == nominal
        and all({key: one.get(key) for key in two} == two for one, two in zip(found, own, strict=True))
    )


def _law(system: UncertainSystem, law: Any) -> Compensator:
    return compensator_of(law, system.matrices.size1_out(2), system.matrices.size2_out(1))


def _described(loop: loops.Loop) -> dict[str, Any]:
    """A loop as it stands in a certificate, without its groups."""
    law, program = loop.law, loop.program
    if loop.direct or loop.descriptor:
        raise InputError("certificate", "system", "a matrix D or E", "A, B and C alone")
    if not program.rational:
        foreign = sorted({name for name, *_ in program.steps} - {*FIELD, "const", "input", "constpow"})
        raise InputError("certificate", "system", " ".join(foreign) or "a power", "+ - * / and whole powers")
    T = law.sample_time if loop.system.sample_time is None else loop.system.sample_time
    return {
        "shape": [loop.states, program.shapes[1][1], program.shapes[2][0]],
        "steps": [[name, target, list(on), float(value).hex()] for name, target, on, value in program.steps],
        **{key: [list(e) for e in program.entries[i]] for i, key in enumerate("ABC")},
        "compensator": {
            key: [[float(x).hex() for x in row] for row in getattr(law, key).tolist()] for key in "ABCD"
        },
        "sample_time": None if T is None else float(T).hex(),
        "discrete": loop.system.sample_time is not None,
        "delay": law.delay,
        "lag": None if law.lag is None else float(law.lag).hex(),
    }


def _loop(system: UncertainSystem, law: Any, box: Box, lower: float) -> dict[str, Any]:
    """One loop with the proof of each of its groups. Raises InputError, CheckError."""
    described, reader = (
        _described(loops.loop_of(system, _law(system, law))),
        checked_file.Reader(Path("certificate")),
    )
    count, before = len(box.names), ctx.prec

    def read(groups: list[dict[str, Any]]) -> checked_file.Loop:
        return reader.loop(described | {"groups": groups}, count)

    try:
        tables = coupled(read([]), (False,) * count)
        groups = _groups(read([]), tables, count)
        for g, own in zip(groups, split(read(groups)), strict=True):
            g["inverted"] = [_divides(own, i) for i in range(count)]
        loop = read(groups)
        for g, group, own in zip(groups, loop.groups, split(loop), strict=True):
            g["parts"] = _parts(Polynomial(loop, group, own), box, lower)
    except Refused as error:
        raise CheckError(f"no certificate: {error}") from error
    finally:
        ctx.prec = before
    return described | {"groups": groups}


def _groups(loop: checked_file.Loop, t: Tables, count: int) -> list[dict[str, Any]]:
    """States that act on one another; a group is only acted on by those before it."""
    n, k = loop.states, len(loop.law_a)
    touch = np.zeros((n + k, n + k), dtype=bool)
    for table, row, column in ((t.A, 0, 0), (t.K, 0, 0), (t.F, 0, n), (t.H, n, 0)):
        for i, j in table:
            touch[row + i, column + j] = True
    touch[n:, n:] = [[x != 0 for x in row] for row in loop.law_a] if k else touch[n:, n:]
    number, label = sparse.csgraph.connected_components(touch, directed=True, connection="strong")
    left, order = set(range(number)), []
    while left:
        ready = sorted(
            g
            for g in left
            if not any((label[touch[i]] == h).any() for i in np.flatnonzero(label == g) for h in left - {g})
        )
        order += ready
        left -= set(ready)
    members = [np.flatnonzero(label == g).tolist() for g in order]
    return [
        {
            "states": [i for i in own if i < n],
            "own": [i - n for i in own if i >= n],
            "inverted": [False] * count,
            "parts": [],
        }
        for own in members
    ]


def _divides(t: Tables, i: int) -> bool:
    """Whether the entries are polynomials of 1 / p_i, as of a mass."""
    found = [r for table in (t.A, t.K, t.F, t.H) for r in table.values()]
    below = [{m[i] for m in r.den.monoms()} for r in found]
    return any(max(b) > 0 for b in below) and all(
        len(b) == 1 and r.num.degrees()[i] <= max(b) for r, b in zip(found, below, strict=True)
    )


def _parts(f: Polynomial, box: Box, lower: float) -> list[dict[str, Any]]:
    """The box cut where one enclosure does not do, each part with its cells. Raises Refused."""
    t = exact(lower)
    todo = [
        np.array([
            (_below(exact(c) - t * exact(d) + exact(o[0])), -_below(-(exact(c) + t * exact(u) + exact(o[1]))))
            for c, d, u, o in zip(*(x.tolist() for x in (box.nominal, box.down, box.up, box.over)), strict=True)
        ])
    ]  # fmt: skip
    made: list[dict[str, Any]] = []
    while todo:
        sides = todo.pop()
        v = [(exact(a), exact(b)) for a, b in sides.tolist()]
        v = [(1 / b, 1 / a) if inv else (a, b) for (a, b), inv in zip(v, f.group.inverted, strict=True)]
        try:
            e = enclose(f, v)
        except Refused:
            if len(todo) + len(made) >= MOST_PARTS:
                raise
            axis = _widest(f, sides)
            middle = float(sides[axis].mean())
            for k in (0, 1):
                half = sides.copy()
                half[axis, 1 - k] = middle
                todo.append(half)
            continue
        made.append(_proof(e, sides, v, f.group.inverted, box, lower))
    return made


def _below(x: Any) -> float:
    """A double at or below an exact number."""
    found = int(x.p) / int(x.q)
    return found if exact(found) <= x else math.nextafter(found, -math.inf)


def _widest(f: Polynomial, sides: FloatArray) -> int:
    """The parameter to cut: the widest beside its middle."""
    width = sides[:, 1] - sides[:, 0]
    share = width / np.maximum(np.abs(sides.sum(axis=1)), width)
    return int(np.argmax([s if i in f.used else -1.0 for i, s in enumerate(share)]))


def _proof(
    e: Enclosure, sides: FloatArray, v: Any, inverted: Sequence[bool], box: Box, lower: float
) -> dict[str, Any]:
    """The cells of one part. Raises Refused where zero is not excluded."""
    family = _family(e)
    low, high = (np.array([float(int(x.p) / int(x.q)) for x in ends]) for ends in zip(*v, strict=True))
    growth = Growth(low, high, tuple(inverted), box.nominal, box.down, box.up)
    search = start(family, growth, 2 * lower + 1)
    while not search.finished:
        if search.count > MOST_CELLS:
            raise CheckError(f"no certificate: not proven within {MOST_CELLS} cells")
        advance(search)
    cells, boxes, c = search.excluded(len(v))
    rows = [
        [int(branch), a, b, own, z.real, z.imag]
        for (branch, a, b), own, z in zip(cells.tolist(), boxes.tolist(), c.tolist(), strict=True)
    ]
    return {"box": [[a.hex(), b.hex()] for a, b in sides.tolist()], "scale": family.scale, "cells": rows}


def _family(e: Enclosure) -> Family:
    """An enclosure in doubles."""
    each = math.prod(e.shape)
    parts = np.array([binary(x) for x in e.values]).reshape(e.count, each, 3)
    mantissas, radii, powers = parts[..., 0], parts[..., 1], parts[..., 2].astype(int)
    with np.errstate(divide="ignore"):
        sizes = np.where(mantissas == 0, -np.inf, powers + np.log2(np.abs(mantissas)))
    top = sizes.max(axis=1)
    known = np.flatnonzero(np.isfinite(top))
    scale = round((top[known[0]] - top[known[-1]]) / (known[-1] - known[0])) if len(known) > 1 else 0
    exponents = np.where(np.isfinite(top), np.ceil(np.where(np.isfinite(top), top, 0)), 0).astype(int)
    shift = np.clip(powers - exponents[:, None], -1020, 1020)
    values, radius = np.ldexp(mantissas, shift), np.ldexp(radii, shift).max(axis=1)
    moved = tuple(int(x) + scale * k for k, x in enumerate(exponents))
    return Family(e.shape, values, radius, moved, scale)
