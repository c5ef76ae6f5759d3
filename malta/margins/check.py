"""A margin certificate checked: in balls with outward rounding, from the certificate's matrices alone.

This file shares no code with the search that found the margin, and trusts no floating-point number. For every loop
and every group of states it

1. builds the characteristic polynomial a_0 + a_1 s + ... of the closed loop (sampled: of v = (z - 1) / (z + 1)),
2. encloses each a_k over a box of v (v: p or 1 / p): Bernstein coefficients of the interpolant at Chebyshev nodes, and
   Cauchy's bound of what that leaves out,
3. shows by Routh's scheme that the nominal loop is stable,
4. shows that the cells tile all frequencies x box(lower): a stable loop can only become unstable through a(jw; p) = 0,
5. shows on each cell that all Bernstein coefficients (in w and v) of Re(conj(c) a(jw; p)) are above zero.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flint import acb, arb, arb_mat, arb_poly, ctx, fmpq, fmpq_mat

from malta.margins.checked_file import Document, Part, read
from malta.margins.checked_loop import (
    Polynomial,
    Refused,
    height,
    split,
)

BITS = 400  # of the coefficients; cells need fewer
CELL_BITS = 160
HIGHEST = 24  # degree of an interpolant along one parameter
MOST_NODES = 12_500
TAIL = -26.0  # log2 of what interpolation should leave out, relative to each coefficient
RADII = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, *(2.0**k for k in (4, 5, 6, 8, 10, 14, 20, 30, 50, 100)))

Box = Sequence[tuple[Any, Any]]


@dataclass(frozen=True)
class Verdict:
    """What a certificate claims, and whether it holds."""

    ok: bool
    claim: float  # every p in box(claim) is stable
    groups: tuple[str, ...]  # one line for each
    failures: tuple[str, ...]


def check(path: str | Path, gains: str | Path | None = None, seconds: float = 600.0) -> Verdict:
    """Whether a certificate holds; with `gains`, whether it is of that gain file.

    Raises InputError for files that are no certificates.
    """
    document, changed = read(Path(path), None if gains is None else Path(gains))
    claim = float(int(document.lower.p) / int(document.lower.q))
    if changed:
        return Verdict(False, claim, (), (changed,))
    lines, failures = [], []
    until = time.monotonic() + seconds
    before = ctx.prec
    try:
        for k, loop in enumerate(document.loops):
            name = f"loop {k + 1}" if len(document.loops) > 1 else "loop"
            try:
                tables = split(loop, until)
            except (Refused, ArithmeticError) as error:
                failures.append(f"{name}: {error}")
                continue
            for n, (group, table) in enumerate(zip(loop.groups, tables, strict=True)):
                try:
                    found = _proven(document, Polynomial(loop, group, table), until)
                except (Refused, ArithmeticError) as error:
                    failures.append(f"{name}, group {n + 1}: {error}")
                else:
                    lines.append(f"{name}, group {n + 1}: {found}")
    finally:
        ctx.prec = before
    return Verdict(not failures, claim, tuple(lines), tuple(failures))


# enclosures over a box


@dataclass(frozen=True)
class Enclosure:
    """a_k over a box of v: Bernstein coefficients as balls, k after k, each over degrees (d_1 + 1) x (d_2 + 1) x ..."""

    shape: tuple[int, ...]
    values: list[Any]
    count: int  # N + 1


def enclose(f: Polynomial, box: Box, until: float = math.inf) -> Enclosure:
    """Raises Refused where that is not possible on the box."""
    ctx.prec = BITS
    middle = [arb((a + b) / 2) for a, b in box]
    size = [height(c) for c in f.at(middle)]
    axes = [_axis(f, i, box, size) for i in range(len(box))]
    shape = tuple(d + 1 for d, _ in axes)
    if math.prod(shape) > MOST_NODES:
        raise Refused(f"{math.prod(shape)} places are too many to interpolate at")
    nodes = [[fmpq(2 * i + 1, 2 * n) for i in range(n)] for n in shape]  # angles over pi
    points = []
    for place in itertools.product(*nodes):
        if time.monotonic() > until:
            raise Refused("time is up")
        shares = ((1 - arb(u).cos_pi()) / 2 for u in place)
        points.append(f.at([a + (b - a) * u for (a, b), u in zip(box, shares, strict=True)]))
    values = [point[k] for k in range(len(size)) for point in points]
    for i, n in enumerate(shape):  # coefficients of Chebyshev polynomials T_k(1 - 2 u)
        table = [arb(u * k).cos_pi() * fmpq(2 - (k == 0), n) for k in range(n) for u in nodes[i]]
        values = along(values, n, math.prod(shape[i + 1 :]), arb_mat(n, n, table))
    left, growth = [arb(0)] * len(size), arb(1)
    for degree, tail in axes:
        lebesgue = 1 + 2 * (arb(degree + 1)).log() / arb.pi()  # of Chebyshev nodes, at most (Rivlin)
        left = [x + growth * (1 + lebesgue) * y for x, y in zip(left, tail, strict=True)]
        growth *= lebesgue if degree else 1
    return _shortened(values, shape, left)


def _shortened(values: list[Any], shape: tuple[int, ...], left: list[Any]) -> Enclosure:
    """Chebyshev coefficients -> Bernstein ones of the degrees that matter; the others, |T_k| <= 1, join the rest."""
    count, new = len(left), list(shape)
    places = list(itertools.product(range(count), *(range(n) for n in shape)))
    heights = [height(x) for x in values]
    top = [max(h for h, at in zip(heights, places, strict=True) if at[0] == k) for k in range(count)]
    for i in range(len(shape)):
        matter = (at[i + 1] + 1 for h, at in zip(heights, places, strict=True) if h > top[at[0]] + TAIL)
        new[i] = max(matter, default=1)
    kept, rest = [], list(left)
    for x, at in zip(values, places, strict=True):
        if all(a < n for a, n in zip(at[1:], new, strict=True)):
            kept.append(x)
        else:
            rest[at[0]] += abs(x)
    for i, n in enumerate(new):
        u = [fmpq(k, max(n - 1, 1)) for k in range(n)]
        bernstein = fmpq_mat(
            [[math.comb(n - 1, k) * x**k * (1 - x) ** (n - 1 - k) for k in range(n)] for x in u]
        )
        chebyshev = fmpq_mat([[_chebyshev(k, 1 - 2 * x) for k in range(n)] for x in u])
        kept = along(kept, n, math.prod(new[i + 1 :]), arb_mat(bernstein.inv() * chebyshev))
    each = math.prod(new)
    return Enclosure(tuple(new), [x + arb(0, rest[k // each].upper()) for k, x in enumerate(kept)], count)


def _chebyshev(k: int, x: Any) -> Any:
    one, two = fmpq(1), x
    for _ in range(k):
        one, two = two, 2 * x * two - one
    return one


def _axis(f: Polynomial, i: int, box: Box, size: list[float]) -> tuple[int, list[Any]]:
    """The degree along v_i, and bounds of the distance of each a_k to polynomials of that degree (Cauchy)."""
    zero = [arb(0)] * len(size)
    if i not in f.used or box[i][0] == box[i][1]:
        return 0, zero
    best: tuple[float, int, list[Any]] | None = None
    for radius in RADII:
        v = [acb(arb((a + b) / 2, arb((b - a) / 2))) for a, b in box]
        reach = arb(0, (arb((box[i][1] - box[i][0]) / 2) * radius).upper())
        middle = arb((box[i][0] + box[i][1]) / 2)
        v[i] = acb(middle + reach, reach)
        ctx.prec = 64
        try:
            most = f.bounds(v)
        except Refused:
            break
        finally:
            ctx.prec = BITS
        share = max((height(m) - s for m, s in zip(most, size, strict=True) if s > -math.inf), default=0.0)
        rate, start = math.log2(radius), share - math.log2(radius - 1)
        degree = min(max(math.ceil((start - TAIL) / rate), 0), HIGHEST)
        rank = (max(start - degree * rate - TAIL, 0.0), degree)
        if best is None or rank < best[:2]:
            scale = arb(radius) ** -degree / (arb(radius) - 1)
            best = (*rank, [m * scale for m in most])
    if best is None or best[0] > 16:
        raise Refused(f"parameter {i + 1} varies too much for one interpolation")
    return best[1], best[2]


def along(values: list[Any], n: int, after: int, matrix: Any) -> list[Any]:
    """A matrix applied along one axis, of length n, of a flat tensor; `after`: the product of the axes after it."""
    before, m = len(values) // (n * after), matrix.nrows()
    gathered = [
        values[(b * n + i) * after + a] for i in range(n) for b in range(before) for a in range(after)
    ]
    made = (matrix * arb_mat(n, before * after, gathered)).entries()
    return [made[(i * before + b) * after + a] for b in range(before) for i in range(m) for a in range(after)]


def _restriction(n: int, low: Any, high: Any) -> Any:
    """Bernstein coefficients of degree n - 1 over [0, 1] -> over [low, high], by blossoms."""
    d = n - 1
    rows = []
    for i in range(n):  # the blossom at low (d - i times) and high (i times)
        p = arb_poly([1 - low, low]) ** (d - i) * arb_poly([1 - high, high]) ** i
        rows += [p[k] for k in range(n)]
    return arb_mat(n, n, rows)


def _powers(n: int, low: Any, high: Any) -> list[list[Any]]:
    """Bernstein coefficients over [low, high] of the monomials x^k, k < n, as polynomials of degree n - 1."""
    d = n - 1
    rows = []
    for i in range(n):
        p = arb_poly([1, low]) ** (d - i) * arb_poly([1, high]) ** i
        rows.append([p[k] / math.comb(d, k) for k in range(n)])
    return rows


# the proof


def _proven(document: Document, f: Polynomial, until: float) -> str:
    """One line of what was shown. Raises Refused."""
    group = f.group
    ctx.prec = 2 * BITS
    nominal = [
        1 / p.nominal if inv else p.nominal
        for p, inv in zip(document.parameters, group.inverted, strict=True)
    ]
    if not _stable(f.at([arb(x) for x in nominal])):
        raise Refused("the nominal loop is not shown to be stable")
    wanted = [
        (p.nominal - document.lower * p.down + p.over[0], p.nominal + document.lower * p.up + p.over[1])
        for p in document.parameters
    ]
    if not tiled([tuple(part.box) for part in group.parts], wanted, until):
        raise Refused("the parts of the box leave a gap")
    count = 0
    for k, part in enumerate(group.parts):
        if any(a <= 0 <= b for (a, b), inv in zip(part.box, group.inverted, strict=True) if inv):
            raise Refused("a parameter that divides reaches zero")
        reach = _frequencies(part)
        for branch in (0, 1):
            own = [((c.low, c.high), *c.box) for c in part.cells if c.branch == branch]
            unit = (fmpq(0), fmpq(1))
            if not tiled(own, [(fmpq(0), reach[branch]), *([unit] * len(part.box))], until):
                raise Refused(f"the cells of part {k + 1} leave a gap")
        box = [
            (1 / b, 1 / a) if inv else (a, b) for (a, b), inv in zip(part.box, group.inverted, strict=True)
        ]
        _cells(enclose(f, box, until), part, until)
        count += len(part.cells)
    return f"{len(group.states)} + {len(group.own)} states, {count} cells, all above zero"


def _frequencies(part: Part) -> tuple[Any, Any]:
    """How far the cells of both branches reach: w = x 2^scale up to the one, 2^scale / x up to the other."""
    ends = [max((c.high for c in part.cells if c.branch == branch), default=fmpq(0)) for branch in (0, 1)]
    if ends[0] * ends[1] < 1:
        raise Refused("frequencies between the two branches are missing")
    return ends[0], ends[1]


def tiled(cells: list[Any], whole: Sequence[tuple[Any, Any]], until: float = math.inf) -> bool:
    """Whether boxes that come from cuts right through, one after another, cover a box."""
    todo = [(cells, list(whole))]
    while todo:
        own, box = todo.pop()
        if time.monotonic() > until:
            raise Refused("time is up")
        if len(own) == 1 and all(c[0] <= b[0] and b[1] <= c[1] for c, b in zip(own[0], box, strict=True)):
            continue
        cut = _cut(own, len(box)) if len(own) > 1 else None
        if cut is None:
            return False
        axis, at = cut
        for side in (0, 1):
            part = list(box)
            part[axis] = (box[axis][0], at) if side == 0 else (at, box[axis][1])
            todo.append(([c for c in own if (c[axis][0] >= at) == bool(side)], part))
    return True


def _cut(cells: list[Any], axes: int) -> tuple[int, Any] | None:
    """Where no cell is cut in two, with about as many on either side."""
    best: tuple[int, int, Any] | None = None
    for axis in range(axes):
        order = sorted((c[axis] for c in cells), key=lambda side: side[0])
        end = order[0][1]
        for k in range(1, len(order)):
            if (
                end <= order[k][0]
                and order[k - 1][0] < order[k][0]
                and (best is None or abs(2 * k - len(order)) < best[0])
            ):
                best = (abs(2 * k - len(order)), axis, order[k][0])
            end = max(end, order[k][1])
    return None if best is None else best[1:]


def _cells(e: Enclosure, part: Part, until: float) -> None:
    """Re(conj(c) a(jw; p)) > 0 on each cell. Raises Refused."""
    ctx.prec = CELL_BITS
    unit, n = arb(2) ** part.scale, e.count
    values = [x * unit ** (k // math.prod(e.shape)) for k, x in enumerate(e.values)]
    tables: dict[Any, Any] = {}
    for number, cell in sorted(enumerate(part.cells), key=lambda pair: str(pair[1].box)):
        if time.monotonic() > until:
            raise Refused("time is up")
        if cell.box not in tables:
            own = values
            for i, (low, high) in enumerate(cell.box):
                if e.shape[i] > 1 and (low, high) != (0, 1):
                    after = math.prod(e.shape[i + 1 :])
                    own = along(own, e.shape[i], after, _restriction(e.shape[i], arb(low), arb(high)))
            tables = {cell.box: arb_mat(n, math.prod(e.shape), own)}
        c = (cell.re, cell.im, -cell.re, -cell.im)  # Re(conj(c) j^k)
        rows = _powers(n, arb(cell.low), arb(cell.high))
        weights = [[row[n - 1 - k if cell.branch else k] * c[k % 4] for k in range(n)] for row in rows]
        if not all(x > 0 for x in (arb_mat(weights) * tables[cell.box]).entries()):
            raise Refused(f"zero is not excluded from cell {number + 1}")


def _stable(a: list[Any]) -> bool:
    """Whether all roots of a_0 + a_1 s + ... are left of the axis, by Routh's scheme in balls."""
    one, two = a[::-1][::2], a[::-1][1::2]
    sign = 1 if one[0] > 0 else -1
    if not sign * one[0] > 0:
        return False
    while two:
        if not sign * two[0] > 0:
            return False
        q = one[0] / two[0]
        one, two = two, [x - q * (two[k + 1] if k + 1 < len(two) else 0) for k, x in enumerate(one[1:])]
    return True
