"""A margin certificate checked: in balls with outward rounding, from the certificate's matrices alone.

Whose matrices and whose box these are, the certificate cannot know: a caller says it by `compare`.

This folder shares no code with the search that found the margin, and trusts no floating-point number. A stable loop
becomes unstable over a connected box only where its characteristic polynomial a(s; p) has a zero s = jw, w = infinity
among them. So for every loop and every group of states (`loop`)

0. the machine has the rest whose matrices these are, within its limits, on all of box(lower),
1. the nominal loop is stable, by Routh's scheme,
2. the cells of the certificate tile all frequencies x box(lower), 1 / w for the high ones,
3. the coefficients a_k, as functions of the parameters v (p or 1 / p) over a part of the box, are enclosed by
   polynomials in Bernstein's form: interpolants at Chebyshev nodes, and Cauchy's bound of what these leave out,
4. on each cell the Bernstein coefficients, in w and v, of Re(conj(c) a(jw; p)) are above zero: then so is all of it.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flint import acb, arb, arb_mat, arb_poly, ctx, fmpq, fmpq_mat, fmpq_poly, fmpz_poly

from .file import AxisEnclosure, Document, StabilityClaim, StatedConditions, StatedPart, double, inside, read
from .loop import STEPS, CheckedPolynomial, Refused, split

BITS = 256  # of the coefficients; cells need fewer
CELL_BITS = 160
MOST_NODES = 12_500
MOST_CONDITION_PARTS = 4096  # of the box, on which conditions are looked at

Box = Sequence[tuple[Any, Any]]


@dataclass(frozen=True)
class CertificateVerdict:
    """What a certificate claims, and whether it holds.

    ok : whether it does
    claim : multiple of the uncertainty in which every loop is stable
    groups : one line for each group of states
    failures : one sentence for each that does not hold
    stated : the claim with its box, in exact numbers; of the certificate's own making unless `compared`
    compared : whether `compare` found this machine, law, stage, box and travel to be those that are wanted
    """

    ok: bool
    claim: float
    groups: tuple[str, ...]
    failures: tuple[str, ...]
    stated: StabilityClaim
    compared: bool


def check(
    path: str | Path, seconds: float = 600.0, compare: Callable[[Document], str] | None = None
) -> CertificateVerdict:
    """Whether a certificate holds.

    path : of the certificate
    seconds : s, the longest check of the proof
    compare : says in a sentence where the claim is not the one that its reader wants, "" where it is; None: loops and
        box in the certificate are believed

    Raises Unreadable for files that are no certificates.
    """
    document = read(Path(path))
    refused = _contradiction(document)
    if not refused and compare is not None:
        refused = compare(document)
    lines, failures = ([], [refused]) if refused else _proofs(document, time.monotonic() + seconds)
    claim, compared = double(document.claim.lower), compare is not None and not refused
    return CertificateVerdict(not failures, claim, tuple(lines), tuple(failures), document.claim, compared)


def _contradiction(document: Document) -> str:
    """Where a certificate contradicts itself; empty if it does not."""
    claim = document.claim
    if not document.sealed:
        return "the file was changed after it was written (sha256)"
    for p in claim.parameters:
        low, high = inside(*p.sides(claim.lower))
        if p.interval != (fmpq(*low.as_integer_ratio()), fmpq(*high.as_integer_ratio())):
            return f"{p.name}: the interval is not the one that is claimed, {low:.7g} .. {high:.7g}"
    if any(loop.sample_time != claim.sample_time for loop in document.loops):
        return "the sample time is not that of the loops"
    return ""


def _proofs(document: Document, until: float) -> tuple[list[str], list[str]]:
    """What was shown of each group, and what was not."""
    lines: list[str] = []
    failures, before = [], ctx.prec
    try:
        for k, loop in enumerate(document.loops):
            name = where = f"loop {k + 1}" if len(document.loops) > 1 else "loop"
            try:
                require_conditions(
                    loop.conditions, [p.sides(document.claim.lower) for p in document.claim.parameters]
                )
                for n, polynomial in enumerate(split(loop, until)):
                    where = f"{name}, group {n + 1}"
                    lines.append(f"{where}: {proven(document.claim, polynomial, until)}")
            except (Refused, ArithmeticError) as error:
                failures.append(f"{where}: {error}")
    finally:
        ctx.prec = before
    return lines, failures


def require_conditions(conditions: StatedConditions, box: Box) -> None:
    """Refuse a loop whose conditions are not above zero on the box, cut into parts where that is needed."""
    ctx.prec = CELL_BITS
    todo, count = [list(box)], 0
    while todo and conditions.above:
        own = todo.pop()
        cells: list[Any] = []
        for name, target, on, value in conditions.steps:
            if name in ("input", "const"):
                low, high = own[target] if name == "input" else (value, value)
                cells.append(arb((low + high) / 2, arb((high - low) / 2)))
            else:
                cells.append(
                    cells[on[0]] ** int(value.p)
                    if name == "constpow"
                    else STEPS[name](*(cells[i] for i in on))
                )
        if all(cells[k] > 0 for k in conditions.above):
            continue
        count += 1
        widths = [(b - a) / max(abs(a), abs(b)) if b > a else fmpq(0) for a, b in own]
        axis = widths.index(max(widths))
        if count > MOST_CONDITION_PARTS or not widths[axis]:
            raise Refused("the machine is not shown to have a rest within its limits on the box")
        low, high = own[axis]
        for half in ((low, (low + high) / 2), ((low + high) / 2, high)):
            todo.append([*own[:axis], half, *own[axis + 1 :]])


def proven(claim: StabilityClaim, f: CheckedPolynomial, until: float) -> str:
    """One line of what was shown. Raises Refused."""
    group, parameters, unit = f.group, claim.parameters, (fmpq(0), fmpq(1))
    ctx.prec = 2 * BITS
    nominal = [1 / p.nominal if inv else p.nominal for p, inv in zip(parameters, group.inverted, strict=True)]
    if not stable(f.at([arb(x) for x in nominal])):
        raise Refused("the nominal loop is not shown to be stable")
    if not tiles_box([part.box for part in group.parts], [p.sides(claim.lower) for p in parameters], until):
        raise Refused("the parts of the box leave a gap")
    for k, part in enumerate(group.parts):
        ends = [max((c.high for c in part.cells if c.branch == branch), default=fmpq(0)) for branch in (0, 1)]
        if ends[0] * ends[1] < 1:  # s = jx up to the one, s = j / x up to the other, in units of 2^scale
            raise Refused("frequencies between the two branches are missing")
        for branch in (0, 1):
            cells = [((c.low, c.high), *c.box) for c in part.cells if c.branch == branch]
            if not tiles_box(cells, [(fmpq(0), ends[branch]), *([unit] * len(part.box))], until):
                raise Refused(f"the cells of part {k + 1} leave a gap")
        if any(a <= 0 <= b for (a, b), inv in zip(part.box, group.inverted, strict=True) if inv):
            raise Refused("a parameter that divides reaches zero")
        box = [
            (1 / b, 1 / a) if inv else (a, b) for (a, b), inv in zip(part.box, group.inverted, strict=True)
        ]
        over = balls(box)
        if not all(abs(r.at(over)) > 0 for r in f.leading):
            raise Refused("E is not shown to be invertible")
        values, left = interpolate(f, box, part.axes, until)
        check_exclusion(*bernstein(values, left, part.axes), f.dust_bounds(over), part, until)
    count = sum(len(part.cells) for part in group.parts)
    return f"{len(group.states)} + {len(group.own)} states, {count} cells, all above zero"


def balls(box: Box) -> list[Any]:
    """The sides of a box, each as a ball."""
    return [acb(arb((a + b) / 2, arb((b - a) / 2))) for a, b in box]


def stable(a: list[Any]) -> bool:
    """Whether all roots of a_0 + a_1 s + ... are left of the axis: the first column of Routh's scheme has one sign."""
    one, two = a[::-1][::2], a[::-1][1::2]
    sign = 1 if one[0] > 0 else -1
    while two and sign * one[0] > 0:
        q = one[0] / two[0]
        one, two = two, [x - q * (two[k + 1] if k + 1 < len(two) else 0) for k, x in enumerate(one[1:])]
    return bool(sign * one[0] > 0)


def tiles_box(cells: Sequence[Any], whole: Box, until: float = math.inf) -> bool:
    """Whether boxes cover a box: within it they do not overlap, and their volumes add up to its volume."""
    wide = [i for i, (a, b) in enumerate(whole) if a < b]
    own = [[(max(a, c), min(b, d)) for (a, b), (c, d) in zip(cell, whole, strict=True)] for cell in cells]
    own = [cell for cell in own if all(a <= b for a, b in cell)]
    if not wide or not own:
        return bool(own)
    own.sort(key=lambda cell: cell[wide[0]])
    for k, one in enumerate(own):
        if time.monotonic() > until:
            raise Refused("time is up")
        for two in own[k + 1 :]:
            if two[wide[0]][0] >= one[wide[0]][1]:
                break
            if all(max(one[i][0], two[i][0]) < min(one[i][1], two[i][1]) for i in wide):
                return False
    volumes = [math.prod((cell[i][1] - cell[i][0] for i in wide), start=fmpq(1)) for cell in (*own, whole)]
    return bool(sum(volumes[:-1], fmpq(0)) == volumes[-1])


def interpolate(
    f: CheckedPolynomial, box: Box, axes: Sequence[AxisEnclosure], until: float = math.inf
) -> tuple[list[Any], list[Any]]:
    """a_0, a_1, ... in products of Chebyshev polynomials T_k(1 - 2 u), and bounds of what is left out of each.

    Along one axis: |a| <= M within Bernstein's ellipse rho leaves 2 M rho^-d / (rho - 1), at most, out of the best
    polynomial of degree d, and 1 + Lambda times that of the interpolant (Trefethen, Approximation Theory and
    Approximation Practice, theorems 8.2 and 15.1); Lambda <= 1 + 2 / pi log(d + 1) (Rivlin).
    """
    ctx.prec = BITS
    left, growth = [arb(0)] * f.count, arb(1)
    for i, (axis, (a, b)) in enumerate(zip(axes, box, strict=True)):
        if i in f.used and a < b:
            best = [2 * m * axis.rho**-axis.degree / (axis.rho - 1) for m in within(f, box, i, axis.rho)]
            constant = 1 + 2 * arb(axis.degree + 1).log() / arb.pi()
            left = [x + growth * (1 + constant) * y for x, y in zip(left, best, strict=True)]
            growth *= constant
    shape = [axis.degree + 1 for axis in axes]
    if math.prod(shape) > MOST_NODES:
        raise Refused(f"{math.prod(shape)} places of {len(shape)} parameters are too many to interpolate at")
    nodes = [[fmpq(2 * i + 1, 2 * n) for i in range(n)] for n in shape]  # angles over pi
    points = []
    for place in itertools.product(*nodes):
        if time.monotonic() > until:
            raise Refused("time is up")
        shares = ((1 - arb(u).cos_pi()) / 2 for u in place)
        points.append(f.at([a + (b - a) * u for (a, b), u in zip(box, shares, strict=True)]))
    values = [point[k] for k in range(f.count) for point in points]
    for i, n in enumerate(shape):
        table = [arb(u * k).cos_pi() * fmpq(2 - (k == 0), n) for k in range(n) for u in nodes[i]]
        values = along(values, n, math.prod(shape[i + 1 :]), arb_mat(n, n, table))
    return values, left


def within(f: CheckedPolynomial, box: Box, i: int, rho: Any) -> list[Any]:
    """Bounds of |a_k| with v_i in the rectangle about Bernstein's ellipse rho."""
    v = balls(box)
    half, middle = arb((box[i][1] - box[i][0]) / 2), arb((box[i][0] + box[i][1]) / 2)
    v[i] = acb(
        middle + arb(0, (half * (rho + 1 / rho) / 2).upper()), arb(0, (half * (rho - 1 / rho) / 2).upper())
    )
    ctx.prec = 64
    try:
        return f.bounds(v)
    finally:
        ctx.prec = BITS


def bernstein(
    values: list[Any], left: list[Any], axes: Sequence[AxisEnclosure]
) -> tuple[list[Any], tuple[int, ...]]:
    """Bernstein coefficients of the degrees that are kept; the other terms, |T_k| <= 1, join what is left out."""
    shape, kept, rest = [axis.degree + 1 for axis in axes], [], list(left)
    new = tuple(axis.kept + 1 for axis in axes)
    for x, (k, *at) in zip(values, itertools.product(range(len(left)), *map(range, shape)), strict=True):
        if all(a < n for a, n in zip(at, new, strict=True)):
            kept.append(x)
        else:
            rest[k] += abs(x)
    for i, n in enumerate(new):
        u, d = [fmpq(k, max(n - 1, 1)) for k in range(n)], n - 1
        own = fmpq_mat([[math.comb(d, k) * x**k * (1 - x) ** (d - k) for k in range(n)] for x in u])
        chebyshev = fmpq_mat([[fmpq_poly(fmpz_poly.chebyshev_t(k))(1 - 2 * x) for k in range(n)] for x in u])
        kept = along(kept, n, math.prod(new[i + 1 :]), arb_mat(own.inv() * chebyshev))
    each = math.prod(new)
    return [x + arb(0, rest[k // each].upper()) for k, x in enumerate(kept)], new


def along(values: list[Any], n: int, after: int, matrix: Any) -> list[Any]:
    """A matrix applied along one axis, of length n, of a flat tensor; `after`: the product of the axes after it."""
    before, m = len(values) // (n * after), matrix.nrows()
    gathered = [
        values[(b * n + i) * after + a] for i in range(n) for b in range(before) for a in range(after)
    ]
    made = (matrix * arb_mat(n, before * after, gathered)).entries()
    return [made[(i * before + b) * after + a] for b in range(before) for i in range(m) for a in range(after)]


def check_exclusion(
    values: list[Any], shape: tuple[int, ...], b: list[Any], part: StatedPart, until: float
) -> None:
    """Re(conj(c) a(jw; p)) > |c| b(w) on each cell. Raises Refused.

    A polynomial lies between its Bernstein coefficients; those over a part of an interval are values of its blossom.
    """
    ctx.prec = CELL_BITS
    each, unit = math.prod(shape), arb(2) ** part.scale
    n = len(values) // each
    values = [x * unit ** (k // each) for k, x in enumerate(values)]
    beside = arb_mat(n, 1, [x * unit**k for k, x in enumerate(b)] + [arb(0)] * (n - len(b)))
    last: tuple[Any, Any] = (None, None)
    for number, cell in sorted(enumerate(part.cells), key=lambda pair: str(pair[1].box)):
        if time.monotonic() > until:
            raise Refused("time is up")
        if last[0] != cell.box:
            own = values
            for i, (low, high) in enumerate(cell.box):
                if shape[i] > 1 and (low, high) != (0, 1):
                    own = along(own, shape[i], math.prod(shape[i + 1 :]), restriction(shape[i], low, high))
            last = cell.box, arb_mat(n, each, own)
        monomials = arb_mat(n, n, [  # Bernstein coefficients of x^k over [low, high], k after k; branch 1: x^(N - k)
            (arb_poly([1, cell.low]) ** (n - 1 - i) * arb_poly([1, cell.high]) ** i)[e] / math.comb(n - 1, e)
            for i in range(n) for k in range(n) for e in (n - 1 - k if cell.branch else k,)
        ])  # fmt: skip
        c = (cell.re, cell.im, -cell.re, -cell.im)  # Re(conj(c) j^k)
        turn = arb_mat(n, n, [c[k % 4] * (i == k) for i in range(n) for k in range(n)])
        found = (monomials * turn * last[1]).tolist()
        least = (monomials * beside * arb(cell.re**2 + cell.im**2).sqrt()).entries()
        if not all(x > y for row, y in zip(found, least, strict=True) for x in row):
            raise Refused(f"zero is not excluded from cell {number + 1}")


def restriction(n: int, low: Any, high: Any) -> Any:
    """Bernstein coefficients of degree n - 1 over [0, 1] -> over [low, high]: the blossom at low, ..., high, ..."""
    rows = [arb_poly([1 - low, low]) ** (n - 1 - i) * arb_poly([1 - high, high]) ** i for i in range(n)]
    return arb_mat(n, n, [row[k] for row in rows for k in range(n)])
