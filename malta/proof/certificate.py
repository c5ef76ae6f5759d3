"""The proof of a margin as a file, which `check` confirms: matrices, parameters, claim, and the cells of each group.

The cells come from the same branch and bound as the margin, for the polynomial that malta/checker builds by itself. The
claim is a little below the lower bound of the margin: the largest of a few shares that is proven.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import arb, ctx
from scipy import linalg, sparse

from malta.checker import file as checked_file
from malta.checker.check import BITS, MOST_NODES, balls, bernstein, interpolate, within
from malta.checker.file import StatedLoop, double
from malta.checker.loop import (
    SIDES,
    CheckedPolynomial,
    Refused,
    Table,
    balance_units,
    expressions,
    height,
    split,
)
from malta.errors import CheckError, InputError
from malta.files import version
from malta.linear.compensators import compensator_of
from malta.linear.expressions import FIELD, MatrixProgram, exact, program as expressions_of
from malta.linear.sampling import split_delay
from malta.proof.box import Box, below, box_of
from malta.proof.exclusion import Growth, advance, start
from malta.proof.groups import E, UncertainLoop, loop_of
from malta.proof.polynomial.family import Family, binary
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.linear.uncertain import Compensator, UncertainSystem
    from malta.proof.margin import Margin, Ranges


# How a certificate splits a loop: groups of states, the sizes in which couplings between these count least, and v.


COUPLING_TOLERANCE = 1e-11  # relative, of couplings that may be rounding


def groups_of(loop: StatedLoop, t: dict[str, Table], box: Box) -> list[dict[str, Any]]:
    """States that act on one another.

    A group is only acted on by those before it; or couplings that are rounding are left between groups.
    """
    n, count = loop.states, loop.states + len(loop.law[0])
    at = [arb(x) for x in box.nominal.tolist()]
    size = np.full((count, count), -np.inf)
    for name, (row, column) in SIDES.items():
        for (i, j), r in t[name].items():
            size[n * row + i, n * column + j] = max(height(r.at(at)), -1000.0)
    touch = np.isfinite(size)
    _, (scales, _) = linalg.matrix_balance(np.exp2(size), permute=False, separate=True)
    size += np.log2(scales) - np.log2(scales)[:, None]
    level = (size.max(axis=1)[:, None] + size.max(axis=0)[None, :]) / 2
    large = touch & (size > math.log2(COUPLING_TOLERANCE) + level)
    if loop.held:
        for i, j in t["A"]:
            large[i, j] = True
    number, label = sparse.csgraph.connected_components(touch, directed=True, connection="strong")
    _, apart = sparse.csgraph.connected_components(large, directed=False)
    if any(len(set(apart[label == g].tolist())) > 1 for g in range(number)):
        order, label = list(dict.fromkeys(apart.tolist())), apart
    else:
        order = _order_groups(touch, label, number)
    members = [np.flatnonzero(label == g).tolist() for g in order]
    return [
        {
            "states": [i for i in own if i < n],
            "own": [i - n for i in own if i >= n],
            "inverted": [False] * len(box.names),
            "parts": [],
        }
        for own in members
    ]


def units_of(read: Callable[[], StatedLoop], described: dict[str, Any], box: Box) -> list[int]:
    """log2 of sizes of the states in which couplings between groups count least."""
    loop = read()
    n, best = loop.states, (math.inf, [0] * (loop.states + len(loop.law[0])))
    polynomials = split(loop)
    if not any(f.dust for f in polynomials):
        return best[1]
    at = [
        [arb(1 / x if inv else x) for x, inv in zip(box.nominal.tolist(), f.group.inverted, strict=True)]
        for f in polynomials
    ]
    for share in (0.0, 0.25, 0.5, 0.75):
        units = [0] * len(best[1])
        for f, v in zip(polynomials, at, strict=True):
            for i, d in zip(f.group.members(n), _lengths(f, v, share), strict=True):
                units[i] = d
        for _ in range(4):
            described["units"] = units
            ratios = [_ratio(f, v) for f, v in zip(split(read()), at, strict=True)]
            best = min(best, (max(ratios), list(units)))
            for f, ratio in zip(polynomials, ratios, strict=True):
                for i in f.group.members(n):
                    units[i] += round((ratio - min(ratios)) / 2)
    return best[1]


def _lengths(f: CheckedPolynomial, v: list[Any], share: float) -> list[int]:
    """log2 of the states' sizes where |g| has a place among the sizes of the entries."""
    m, dynamic = f.sizes(v)
    known = sorted(height(x) for row in m for x in row if x > 0)
    g = known[int(share * (len(known) - 1))]
    logs = [
        (i, j, max(height(x), g) if i == j and dynamic[i] else height(x))
        for i, row in enumerate(m)
        for j, x in enumerate(row)
        if x > 0 or (i == j and dynamic[i])
    ]
    d = [0.0] * len(m)
    for _ in range(8):
        d = balance_units(len(m), logs, d)
    own = len(f.group.own)
    return [round(x) for x in (*d[: len(f.group.states)], *d[len(d) - own :])]


def _ratio(f: CheckedPolynomial, v: list[Any]) -> float:
    """log2 of how large couplings between groups are beside the coefficients."""
    return max(
        (height(b) - height(a) for a, b in zip(f.at(v), f.dust_bounds(v), strict=False) if b > 0),
        default=-1000.0,
    )


def _order_groups(touch: Any, label: Any, number: int) -> list[int]:
    """Strongly connected groups, each acted on by those before it alone."""
    left, order = set(range(number)), []
    while left:
        ready = sorted(
            g
            for g in left
            if not any((label[touch[i]] == h).any() for i in np.flatnonzero(label == g) for h in left - {g})
        )
        order += ready
        left -= set(ready)
    return order


def divides(f: CheckedPolynomial, i: int) -> bool:
    """Whether the entries are polynomials of 1 / p_i, as of an inertia; q takes other denominators."""
    found = list(f.tables["A"].values())
    below = [{m[i] for m in r.den.monoms()} for r in found]
    return any(max(b) > 0 for b in below) and all(
        len(b) == 1 and r.num.degrees()[i] <= max(b) for r, b in zip(found, below, strict=True)
    )


# Of the margin's lower bound: the first that is proven is claimed.
SHARES = (0.999, 0.97, 0.9, 0.75, 0.5, 0.25)
MOST_CELLS = 20_000  # cells of one group at most
MOST_PARTS = 64
MAX_DEGREE = 24  # degree of an interpolant along one parameter
TAIL = -26.0  # log2 of what interpolation should leave out, relative to each coefficient
RADII = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, *(2.0**k for k in (4, 5, 6, 8, 10, 14, 20, 30, 50, 99)))

Places = Sequence[tuple["UncertainSystem", "Compensator"]]


DERIVED_UNIT = "1"  # of parameters that follow the position


@dataclass(frozen=True)
class LoopOrigin:
    """The machine and the law that loops are of, as the claim names them."""

    named: checked_file.StatedOrigin
    units: Mapping[str, str]  # SI, of the parameters and of the travel
    places: checked_file.StatedPlaces | None  # of the loops, where they are several


def write_certificate(
    path: str | Path,
    places: Places,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None,
    margin: Margin,
    origin: LoopOrigin | None = None,
) -> Path:
    """Write the certificate of a margin.

    path : of the file
    places : its loops, one, or one for each place at which it holds
    ranges, over : the box and the intervals that do not grow, as for `robust_margin`
    margin : from `malta.robust_margin` of these loops
    origin : the machine and the law, from `malta.gains.certified.origin_of`; None: matrices of no machine

    Returns the path. `malta check`, or the folder malta/checker wherever it lies, proves the claim again.

    Raises InputError for loops that certificates do not cover, CheckError when nothing is proven.

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> box, loops = {"k": 0.1}, [(motor, [[0.5]])]  # lost at k = 2
    >>> margin = malta.robust_margin(*loops[0], box)
    >>> malta.proof.write_certificate("build/motor.json", loops, box, None, margin).name
    'motor.json'
    """
    content = certificate_of(places, ranges, over, margin, origin)
    replace_files({Path(path): (json.dumps(content, separators=(",", ":")) + "\n").encode()})
    return Path(path)


def certificate_of(
    places: Places,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None,
    margin: Margin,
    origin: LoopOrigin | None = None,
) -> dict[str, Any]:
    """The certificate of a margin as a JSON document."""
    if margin.lower is None:
        raise CheckError(f"no certificate: nothing is proven ({margin.reason})")
    if lost := next((system.left_out for system, _ in places if system.left_out), ""):
        raise CheckError(f"no certificate: the margin is {lost}")
    system = places[0][0]
    box = box_of(system.names, system.nominal, system.limits, ranges, over or {})
    lower, proven = _prove(places, box, margin.lower)
    T = proven[0]["sample_time"]
    content: dict[str, Any] = {
        "format": checked_file.FORMAT,
        "version": checked_file.VERSION,
        "malta": version(),
        "claim": {
            "lower": lower,
            **_origin(origin),
            "sample_time": None if T is None else float.fromhex(T),
            "parameters": _parameters(box, lower, origin),
        },
        "loops": proven,
    }
    return content | {"sha256": checked_file.digest(content)}


def _origin(origin: LoopOrigin | None) -> dict[str, Any]:
    """What a claim says of machine, law, stage and places."""
    if origin is None:
        return dict.fromkeys(("machine", "law", "current_loops", "places"))
    named, places = origin.named, origin.places
    return {
        "machine": {"name": named.machine, "preset": named.preset},
        "law": {"name": named.law, "sha256": named.sha256},
        "current_loops": named.current_loops,
        "places": None
        if places is None
        else {"name": places.name, "unit": places.unit, "at": [double(x) for x in places.at]},
    }


def _parameters(box: Box, lower: float, origin: LoopOrigin | None) -> list[dict[str, Any]]:
    """The box of a claim: of each parameter what it is at first, how it grows, and where it is at `lower`."""
    ends = _ends(box, lower)
    rows = (x.tolist() for x in (box.nominal, box.down, box.up))
    made = []
    for name, nominal, down, up, over, sides in zip(box.names, *rows, _over(box), ends, strict=True):
        unit = origin and origin.units.get(name, DERIVED_UNIT)
        interval = list(checked_file.inside(*sides))
        made.append(
            {
                "name": name, "unit": unit, "nominal": nominal, "down": down, "up": up, "over": over,
                "interval": interval,
            }
        )  # fmt: skip
    return made


def _over(box: Box) -> list[list[float]]:
    """The intervals that do not grow, less the nominal values, rounded outwards."""
    return [
        [below(exact(low) - exact(c)) + 0.0, -below(exact(c) - exact(high)) + 0.0]
        for c, (low, high) in zip(box.nominal.tolist(), box.over.tolist(), strict=True)
    ]


def _ends(box: Box, lower: float) -> list[tuple[Any, Any]]:
    """The ends of each parameter's interval at `lower`, from the numbers that the claim has: exact."""
    rows, t = (
        zip(*(x.tolist() for x in (box.nominal, box.down, box.up)), _over(box), strict=True),
        exact(lower),
    )
    return [
        (exact(c) - t * exact(down) + exact(over[0]), exact(c) + t * exact(up) + exact(over[1]))
        for c, down, up, over in rows
    ]


def _prove(places: Places, box: Box, margin: float) -> tuple[float, list[dict[str, Any]]]:
    """The claim, and the loops with their proofs. Raises CheckError, InputError."""
    for share in SHARES:
        try:
            return share * margin, [_loop(*place, box, share * margin) for place in places]
        except CheckError as error:
            last = error
    raise last


def loops_of(places: Places) -> tuple[StatedLoop, ...]:
    """Loops as a certificate has them, without their groups. Raises InputError for those that it cannot have."""
    found = []
    for system, law in places:
        described = _description(loop_of(system, _law(system, law)))
        states = len(described["compensator"]["A"]) + described["shape"][0]
        found.append(_as_read(described | {"groups": [], "units": [0] * states}, len(system.names)))
    return tuple(found)


def _as_read(described: dict[str, Any], inputs: int) -> StatedLoop:
    """A loop as the checker reads it. Raises InputError for what no certificate may have."""
    with refused_as_input():
        return checked_file.loop(checked_file.DocumentValue(Path("certificate"), "", described), inputs)


@contextmanager
def refused_as_input() -> Iterator[None]:
    """Within the block what the checker cannot read is an InputError, as of every other reader."""
    try:
        yield
    except checked_file.Unreadable as error:
        raise InputError(error.where, error.field, error.found, error.expected) from error


def _law(system: UncertainSystem, law: Any) -> Compensator:
    return compensator_of(law, system.matrices.size1_out(2), system.matrices.size2_out(1))


def _description(loop: UncertainLoop) -> dict[str, Any]:
    """The description of a loop in a certificate, without its groups."""
    law, program = loop.law, loop.program
    n, positive = loop.states, loop.system.positive
    conditions = None if positive is None else expressions_of(positive)
    if loop.direct:
        raise InputError("certificate", "system", "a matrix D", "outputs y = C x alone")
    if loop.descriptor and sorted((i, j) for i, j, _ in program.entries[E]) != [(i, i) for i in range(n)]:
        raise InputError("certificate", "system", "a matrix E that couples states", "a diagonal E, or none")
    if not (program.rational and (conditions is None or conditions.rational)):
        program = program if conditions is None or not program.rational else conditions
        foreign = sorted({name for name, *_ in program.steps} - {*FIELD, "const", "input", "constpow"})
        raise InputError("certificate", "system", " ".join(foreign) or "a power", "+ - * / and whole powers")
    matrices = "ABCE" if loop.descriptor else "ABC"
    T = law.sample_time if loop.system.sample_time is None else loop.system.sample_time
    whole = split_delay(law.delay)[0]
    return {
        "shape": [n, program.shapes[1][1], program.shapes[2][0]],
        "steps": _steps(program),
        "conditions": {
            "steps": [] if conditions is None else _steps(conditions),
            "above": [] if conditions is None else [k for _, _, k in conditions.entries[0]],
        },
        **{key: [list(e) for e in program.entries[i]] for i, key in enumerate("ABCDE") if key in matrices},
        "compensator": {
            key: [[float(x).hex() for x in row] for row in getattr(law, key).tolist()] for key in "ABCD"
        },
        "sample_time": None if T is None else float(T).hex(),
        "discrete": loop.system.sample_time is not None,
        "delay": law.delay if law.delay == whole else float(law.delay).hex(),
        "lag": None if law.lag is None else float(law.lag).hex(),
    }


def _steps(program: MatrixProgram) -> list[list[Any]]:
    return [[name, target, list(on), float(value).hex()] for name, target, on, value in program.steps]


def _loop(system: UncertainSystem, law: Any, box: Box, lower: float) -> dict[str, Any]:
    """One loop with the proof of each of its groups. Raises InputError, CheckError."""
    described = _description(loop_of(system, _law(system, law)))
    count, before = len(box.names), ctx.prec

    def read() -> StatedLoop:
        return _as_read(described, count)

    try:
        described |= {
            "groups": [],
            "units": [0] * (len(described["compensator"]["A"]) + described["shape"][0]),
        }
        groups = described["groups"] = groups_of(read(), expressions(read(), (False,) * count, math.inf), box)
        for g, f in zip(groups, split(read()), strict=True):
            g["inverted"] = [divides(f, i) for i in range(count)]
        described["units"] = units_of(read, described, box)
        for g, f in zip(groups, split(read()), strict=True):
            g["parts"] = _parts(f, box, lower)
    except Refused as error:
        raise CheckError(f"no certificate: {error}") from error
    finally:
        ctx.prec = before
    return described


def _parts(f: CheckedPolynomial, box: Box, lower: float) -> list[dict[str, Any]]:
    """The parts of the box with their cells, cut where it is too wide. Raises InputError, CheckError, Refused."""
    todo = [np.array([(below(low), -below(-high)) for low, high in _ends(box, lower)])]
    moving = len(f.used & set(np.flatnonzero(todo[0][:, 0] < todo[0][:, 1]).tolist()))
    if 2**moving > MOST_NODES:
        most = math.floor(math.log2(MOST_NODES))
        raise InputError("certificate", "parameters", f"{moving} that act on one group", f"at most {most}")
    if any(
        low <= 0 <= high for (low, high), inv in zip(todo[0].tolist(), f.group.inverted, strict=True) if inv
    ):
        raise Refused("a parameter that divides reaches zero")
    made: list[dict[str, Any]] = []
    while todo:
        sides = todo.pop()
        v = [(exact(a), exact(b)) for a, b in sides.tolist()]
        v = [(1 / b, 1 / a) if inv else (a, b) for (a, b), inv in zip(v, f.group.inverted, strict=True)]
        try:
            proof = _enclose(f, v, box, lower)
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
        made.append({"box": [[a.hex(), b.hex()] for a, b in sides.tolist()]} | proof)
    return made


def _widest(f: CheckedPolynomial, sides: FloatArray) -> int:
    """The parameter to cut: the widest beside its middle."""
    width = sides[:, 1] - sides[:, 0]
    share = width / np.maximum(np.abs(sides.sum(axis=1)), width)
    return int(np.argmax([s if i in f.used else -1.0 for i, s in enumerate(share)]))


def _enclose(f: CheckedPolynomial, v: list[tuple[Any, Any]], box: Box, lower: float) -> dict[str, Any]:
    """The enclosure of one part, and its cells.

    Raises Refused when it cannot be enclosed, CheckError when zero is not excluded.
    """
    ctx.prec = BITS
    middle = tuple((a + b) / 2 for a, b in v)
    corners = itertools.product(*([a, b] if i in f.used and a < b else [a] for i, (a, b) in enumerate(v)))
    places = [f.at([arb(x) for x in place]) for place in (middle, *corners)]
    # of each coefficient the largest: one that cancels in the middle asks for no more digits than its neighbours
    size = [max(map(height, each)) for each in zip(*places, strict=True)]
    axes = [_axis(f, v, i, size, box.names[i]) for i in range(len(v))]
    values, left = interpolate(f, v, axes)
    heights = np.array([height(x) for x in values]).reshape(f.count, *(axis.degree + 1 for axis in axes))
    matters = heights > heights.reshape(f.count, -1).max(axis=1).reshape(-1, *[1] * len(axes)) + TAIL
    kept = [max(np.nonzero(matters)[i + 1].tolist(), default=0) for i in range(len(axes))]
    axes = [replace(axis, kept=k) for axis, k in zip(axes, kept, strict=True)]
    family = _family(*bernstein(values, left, axes), f.dust_bounds(balls(v)))
    return {
        "axes": [[axis.degree, double(axis.rho).hex(), axis.kept] for axis in axes],
        "scale": family.scale,
        "cells": _cells(family, v, f.group.inverted, box, lower),
    }


def _axis(
    f: CheckedPolynomial, v: list[tuple[Any, Any]], i: int, size: list[float], name: str
) -> checked_file.AxisEnclosure:
    """The ellipse along v_i that takes the lowest degree. Raises Refused."""
    if i not in f.used or v[i][0] == v[i][1]:
        return checked_file.AxisEnclosure(0, exact(RADII[0]), 0)
    best: tuple[float, int, float] | None = None
    for rho in RADII:
        try:
            most = within(f, v, i, exact(rho))
        except (Refused, OverflowError):
            break
        share = max((height(m) - s for m, s in zip(most, size, strict=True) if s > -math.inf), default=0.0)
        rate, start = math.log2(rho), share + 1 - math.log2(rho - 1)
        degree = min(max(math.ceil((start - TAIL) / rate), 0), MAX_DEGREE)
        rank = (max(start - degree * rate - TAIL, 0.0), degree, rho)
        best = rank if best is None else min(best, rank)
    if best is None or best[0] > 16:
        raise Refused(f"{name} varies too much for one interpolation")
    return checked_file.AxisEnclosure(best[1], exact(best[2]), best[1])


def _cells(
    family: Family, v: list[tuple[Any, Any]], inverted: Sequence[bool], box: Box, lower: float
) -> list[list[Any]]:
    """Cells from which zero is excluded. Raises CheckError."""
    low, high = (np.array([double(x) for x in ends]) for ends in zip(*v, strict=True))
    growth = Growth(low, high, tuple(inverted), box.nominal, box.down, box.up)
    search = start(family, growth, 2 * lower + 1)
    while not search.finished:
        if search.count > MOST_CELLS or search.blocked < search.target:
            raise CheckError(f"no certificate: not proven within {search.count} cells")
        search = advance(search)
    cells, boxes, c = search.excluded_cells(len(v))
    return [
        [int(branch), a, b, own, z.real, z.imag]
        for (branch, a, b), own, z in zip(cells.tolist(), boxes.tolist(), c.tolist(), strict=True)
    ]


def _family(bernstein: list[Any], shape: tuple[int, ...], dust: list[Any]) -> Family:
    """An enclosure in doubles; bounds of the couplings between groups are part of its radius."""
    each = math.prod(shape)
    count = len(bernstein) // each
    beside = [arb(0, x.upper()) for x in dust] + [arb(0)] * (count - len(dust))
    parts = np.array([binary(x + beside[k // each]) for k, x in enumerate(bernstein)]).reshape(count, each, 3)
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
    return Family(shape, values, radius, moved, scale)
