"""The characteristic polynomial of a certificate's loop: its matrices as rational functions, at balls and bounded.

Each group of states closes a loop; f are the forces, the inputs as they act on the rows of x, and P(g) is its pencil:

    g x = Phi x + Gamma f     g = s: x' = A x + f. Sampled: g = z - 1, Phi = e^(A T) - 1. Lag, delay: further states.
    q f = q (K x + F xi)      K = B D_c C, F = B C_c; q(p), their denominators, so that a mass may divide
    g xi = H x + L xi         H = B_c C, L = A_c (sampled: A_c - 1)

det P = q det(g - closed loop) is the polynomial; sampled it is one of v = (z - 1) / (z + 1), after (1 - v)^N.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

from flint import Ordering, acb, arb, arb_mat, arb_poly, fmpq_mpoly_ctx

from .file import StatedGroup, StatedLoop

MOST_TERMS = 2000  # of an expression
SIDES = {"A": (0, 0), "K": (0, 0), "F": (0, 1), "H": (1, 0), "L": (1, 1)}  # rows, columns: 0 of x, 1 of xi

Rows = list[list[Any]]
Table = dict[tuple[int, int], Any]


class Refused(Exception):
    """Why a certificate does not hold."""


class CheckedRatio:
    """num / den, polynomials of v in lowest terms."""

    def __init__(self, num: Any, den: Any) -> None:
        common = num.gcd(den)
        self.num, self.den = (num, den) if common.is_constant() else (num / common, den / common)
        terms = [*self.num.to_dict().values(), *self.den.to_dict().values()]
        if len(terms) > MOST_TERMS or max(c.height_bits() for c in terms) > 50_000:
            raise Refused("expressions that are too long")

    def __add__(self, other: CheckedRatio) -> CheckedRatio:
        return CheckedRatio(self.num * other.den + other.num * self.den, self.den * other.den)

    def __neg__(self) -> CheckedRatio:
        return CheckedRatio(-self.num, self.den)

    def __mul__(self, other: CheckedRatio) -> CheckedRatio:
        return CheckedRatio(self.num * other.num, self.den * other.den)

    def __truediv__(self, other: CheckedRatio) -> CheckedRatio:
        if other.num.is_zero():
            raise Refused("a division by zero")
        return CheckedRatio(self.num * other.den, self.den * other.num)

    def __pow__(self, power: int) -> CheckedRatio:
        whole = CheckedRatio(self.num ** abs(power), self.den ** abs(power))
        return whole if power >= 0 else whole / (whole * whole)

    @cached_property
    def terms(self) -> list[list[tuple[Any, list[tuple[int, int]]]]]:
        """Of num and den: coefficients, and which v has which power."""
        parts = [part.to_dict().items() for part in (self.num, self.den)]
        return [[(c, [(i, int(e)) for i, e in enumerate(m) if e]) for m, c in part] for part in parts]

    @cached_property
    def constant(self) -> Any:
        """The value of what does not depend on v; None for the rest."""
        return self.num.leading_coefficient() if self.num.is_constant() and self.den == 1 else None

    def at(self, v: Sequence[Any]) -> Any:
        """The value at balls."""
        zero = v[0] * 0
        if self.constant is not None:
            return zero + self.constant
        num, den = (
            sum((math.prod((v[i] ** e for i, e in m), start=zero + c) for c, m in part), zero)
            for part in self.terms
        )
        return num if self.den == 1 else num / den


STEPS: dict[str, Any] = {
    "assign": lambda a: a, "neg": lambda a: -a, "sq": lambda a: a * a, "twice": lambda a: a + a, "inv": lambda a: a**-1,
    "add": lambda a, b: a + b, "sub": lambda a, b: a + -b, "mul": lambda a, b: a * b, "div": lambda a, b: a / b,
}  # fmt: skip


def expressions(loop: StatedLoop, inverted: Sequence[bool], until: float) -> dict[str, Table]:
    """A, K, F, H and L as rational functions of v: the program run on them, and products with the compensator's."""
    context = fmpq_mpoly_ctx.get([f"v{i}" for i in range(len(inverted))], Ordering.lex)
    unit = context.constant(1)
    cells: list[CheckedRatio] = []
    for name, target, on, value in loop.steps:
        if time.monotonic() > until:
            raise Refused("time is up")
        if name in ("input", "const"):
            v = CheckedRatio(context.gens()[target] if name == "input" else context.constant(value), unit)
            cells.append(v**-1 if name == "input" and inverted[target] else v)
        else:
            operands = [cells[i] for i in on]
            cells.append(operands[0] ** int(value.p) if name == "constpow" else STEPS[name](*operands))
    A, B, C, E = ({(i, j): cells[s] for i, j, s in entries} for entries in loop.entries)
    A, B = ({(i, j): r / E[i, i] if E else r for (i, j), r in m.items()} for m in (A, B))
    a, b, c, d = (
        {
            (i, j): CheckedRatio(context.constant(x), unit)
            for i, row in enumerate(m)
            for j, x in enumerate(row)
            if x != 0
        }
        for m in loop.law
    )
    A = {at: r for at, r in A.items() if not r.num.is_zero()}
    return {"A": A, "K": times(times(B, d), C), "F": times(B, c), "H": times(b, C), "L": a, "E": E}


def times(one: Table, two: Table) -> Table:
    """The product of two matrices; zeros are left out."""
    found: Table = {}
    for (i, a), r in one.items():
        for (b, j), s in two.items():
            if a == b:
                found[i, j] = found[i, j] + r * s if (i, j) in found else r * s
    return {at: r for at, r in found.items() if not r.num.is_zero()}


def split(loop: StatedLoop, until: float = math.inf) -> list[CheckedPolynomial]:
    """The characteristic polynomial of each group, in its own v.

    Where couplings only lead from groups to later ones, the loop's pencil is block triangular: its determinant is the
    product of the groups'. Where some lead back, all between groups are dust (`CheckedPolynomial.moved`), which holds
    cannot have within their exponential. Raises Refused.
    """
    n, whole = loop.states, {g.inverted: expressions(loop, g.inverted, until) for g in loop.groups}
    place = {i: k for k, group in enumerate(loop.groups) for i in group.members(n)}
    if not sum(len(g.members(n)) for g in loop.groups) == len(place) == n + len(loop.law[0]):
        raise Refused("groups that do not hold each state once")
    found = []
    for k, group in enumerate(loop.groups):
        local = [{i: a for a, i in enumerate(members)} for members in (group.states, group.own)]
        inside: dict[str, Table] = {name: {} for name in SIDES}
        dust, back = [], False
        for name, (row, column) in SIDES.items():
            for (i, j), r in whole[group.inverted][name].items():
                one, two = place[i + n * row], place[j + n * column]
                back |= one < two
                if one == two == k:
                    inside[name][local[row][i], local[column][j]] = r
                elif one == k:
                    dust.append((name, local[row][i], j + n * column, r))
        if back and loop.held and any(name == "A" for name, *_ in dust):
            raise Refused("groups that act on one another between samples")
        leading = [whole[group.inverted]["E"][i, i] for i in group.states if loop.entries[3]]
        found.append(CheckedPolynomial(loop, group, inside, dust if back else [], leading))
    return found


class CheckedPolynomial:
    """a_0 ... a_N of det P at balls of v, and bounds over complex balls."""

    def __init__(
        self,
        loop: StatedLoop,
        group: StatedGroup,
        inside: dict[str, Table],
        dust: list[Any],
        leading: list[CheckedRatio],
    ) -> None:
        self.loop, self.group, self.leading = loop, group, leading
        forces = [(i, r) for name in "KF" for (i, _), r in inside[name].items()]
        forces += [(i, r) for name, i, _, r in dust if name in "KF"]
        q: dict[int, Any] = {}
        for i, r in sorted(forces, key=lambda force: force[0]):
            q[i] = r.den if i not in q else q[i] * r.den / q[i].gcd(r.den)
        self.q = {i: CheckedRatio(x, x * 0 + 1) for i, x in q.items()}
        row = {i: k for k, i in enumerate(q)}
        self.tables = inside | {
            name: {(row[i], j): self.q[i] * r for (i, j), r in inside[name].items()} for name in "KF"
        }
        n, r = len(group.states), len(q)
        whole, part = loop.split
        w = n + r * (whole + (part != 0) + (loop.lag is not None))
        self.shape, self.count = (w, r, len(group.own)), w + len(group.own) + 1
        self.units = {a: loop.units[i] for a, i in enumerate(group.states)}
        self.units |= {w + r + a: loop.units[loop.states + i] for a, i in enumerate(group.own)}
        self.dust = [
            (w + row[i], j, self.q[i] * x) if name in "KF" else (i if name == "A" else w + r + i, j, x)
            for name, i, j, x in dust
        ]
        entries = [part for t in self.tables.values() for x in t.values() for part in (x.num, x.den)]
        self.used = {i for part in (*entries, *q.values()) for i, e in enumerate(part.degrees()) if e}

    def values(self, v: Sequence[Any]) -> tuple[dict[str, Table], list[Any]]:
        """A, H, L, q K and q F at balls, and q. Raises Refused for poles."""
        found = {name: {at: r.at(v) for at, r in t.items()} for name, t in self.tables.items()}
        if not all(x.is_finite() for table in found.values() for x in table.values()):
            raise Refused("a division by what may be zero")
        return found, [r.at(v) for r in self.q.values()]

    def at(self, v: Sequence[Any]) -> list[Any]:
        """Coefficients at real balls: of the closed loop, without f."""
        (t, q), (w, r, k) = self.values(v), self.shape
        phi, gamma = (matrix(x) for x in self._windings(t["A"], bounds=False))
        K, F = ({(i, j): x / q[i] for (i, j), x in t[name].items()} for name in "KF")
        inner, outer = phi + gamma * matrix(dense(r, w, K), w), gamma * matrix(dense(r, k, F), k)
        closed = matrix(blocks([inner.tolist(), outer.tolist()], [dense(k, w, t["H"]), self._law(t["L"])]))
        a = [x * math.prod(q, start=arb(1)) for x in closed.charpoly().coeffs()]
        a += [arb(0)] * (w + k + 1 - len(a))
        return a if self.loop.sample_time is None else map_to_disc(a, [1, -1])

    def bounds(self, v: Sequence[Any]) -> list[Any]:
        """At least |a_k| for all complex v in balls."""
        a = determinant_bounds(*self.sizes(v))
        return a if self.loop.sample_time is None else map_to_disc(a, [1, 1])

    def dust_bounds(self, v: Sequence[Any]) -> list[Any]:
        """Coefficients of b such that dust e leaves the loop's pencil regular where |a(jw)| > b(w) in each group.

        P + e is regular where in some units d of the states the row sums of |P^-1 e| are below one. By Cramer's rule
        that is sum_l |cofactor_lj| e_l / d_j < |det P| for each j, e_l = sum_m |e_lm| d_m. Then also P + tau e is,
        tau from 0 to 1: no pole of the loop crosses the boundary. v: real balls.
        """
        if not self.dust:
            return [arb(0)]
        m, dynamic = self.sizes(v)
        e = [arb(0)] * len(m)
        for row, j, r in self.dust:
            e[row] += upper(r.at(v)) * arb(2) ** self.loop.units[j]
        if not all(x.is_finite() for x in e):
            raise Refused("a division by what may be zero")
        b = determinant_bounds(m, dynamic, e, self.units)
        return b if self.loop.sample_time is None else map_to_disc(b, [1, 1], [1, 0, 1])

    def sizes(self, v: Sequence[Any]) -> tuple[Rows, list[bool]]:
        """Bounds of the entries of P, and in which rows g stands."""
        (t, q), (w, r, k) = self.values(v), self.shape
        m = blocks(
            [*self._windings(t["A"], bounds=True), dense(w, k)],
            [dense(r, w, t["K"]), dense(r, r, {(i, i): x for i, x in enumerate(q)}), dense(r, k, t["F"])],
            [dense(k, w, t["H"]), dense(k, r), self._law(t["L"])],
        )
        return [[upper(x) for x in row] for row in m], [True] * w + [False] * r + [True] * k

    def _law(self, L: Table) -> Rows:
        k, one = self.shape[2], int(self.loop.sample_time is not None)
        return [[x - one * (i == j) for j, x in enumerate(row)] for i, row in enumerate(dense(k, k, L))]

    def _windings(self, table: Table, *, bounds: bool) -> tuple[Rows, Rows]:
        """Phi and Gamma: of x, then a lag of each force, then forces under way, of which the latest enters last.

        Of a fraction of a sample of delay, forces under way act for it, and newer ones for the rest of the sample.
        """
        loop, n, r = self.loop, len(self.group.states), len(self.q)
        a, b = dense(n, n, table), dense(n, r, {(i, k): arb(1) for k, i in enumerate(self.q)})
        if loop.lag is not None:
            a, b = blocks([a, b], [dense(r, n), eye(r, -loop.lag)]), blocks([dense(n, r)], [eye(r, loop.lag)])
        whole, part = loop.split
        newest = dense(len(a), r)
        if loop.held and a:
            T = arb(loop.sample_time)
            if part:
                newest = hold(a, b, T * (1 - part), bounds)[1]
            a, b = hold(a, b, T, bounds)
        elif loop.discrete:
            a = [[x - (i == j) for j, x in enumerate(row)] for i, row in enumerate(a)]
        for k in range(whole + (part != 0)):
            w, here = len(a), newest if k == 0 else dense(len(a), r)
            if not bounds:  # of entries: either part is below that of the whole sample
                b = [[x - y for x, y in zip(*rows, strict=True)] for rows in zip(b, here, strict=True)]
            a, b = blocks([a, b], [dense(r, w), eye(r, -1)]), blocks([here], [eye(r, 1)])
        return a, b


def hold(a: Rows, b: Rows, T: Any, bounds: bool) -> tuple[Rows, Rows]:
    """e^(A T) - 1 = A V and V B, V the integral of e^(A t) over a sample; or bounds of their entries.

    |e^(A t)| <= e^(M t), entry by entry, with |A| for M, and on its diagonal the real part.
    """
    n, r = len(a), len(b[0])
    if not bounds:
        both = (matrix(blocks([a, b], [dense(r, n + r)])) * T).exp().tolist()[:n]
        return [[x - (i == j) for j, x in enumerate(row[:n])] for i, row in enumerate(both)], [
            row[n:] for row in both
        ]
    size, into = ([[upper(x) for x in row] for row in m] for m in (a, b))
    top = [
        [arb(acb(x).real.upper()) if i == j else upper(x) for j, x in enumerate(row)]
        for i, row in enumerate(a)
    ]
    whole = matrix(blocks([top, eye(n, 1)], [dense(n, 2 * n)])) * T
    if not all(abs(x) < 3000 for x in whole.entries()):
        raise Refused("numbers that overflow")
    V = matrix([[upper(x) for x in row[n:]] for row in whole.exp().tolist()[:n]])
    return (matrix(size) * V).tolist(), (V * matrix(into, r)).tolist()


# matrices as lists of rows


def dense(rows: int, columns: int, entries: Mapping[tuple[int, int], Any] | None = None) -> Rows:
    return [[(entries or {}).get((i, j), arb(0)) for j in range(columns)] for i in range(rows)]


def eye(n: int, value: Any) -> Rows:
    return dense(n, n, {(i, i): arb(value) for i in range(n)})


def blocks(*rows: list[Rows]) -> Rows:
    """A matrix of blocks."""
    return [[x for part in line for x in part] for row in rows for line in zip(*row, strict=True)]


def matrix(rows: Rows, columns: int = 0) -> Any:
    return arb_mat(len(rows), len(rows[0]) if rows else columns, [x for row in rows for x in row])


def upper(x: Any) -> Any:
    """At least the size of a ball."""
    return arb(abs(x).upper())


def height(x: Any) -> float:
    """About log2 |x|."""
    m, e = (int(i) for i in x.abs_upper().man_exp())
    return math.log2(m) + e if m > 0 else -math.inf


# polynomials and determinants


def map_to_disc(a: list[Any], one: list[int], square: list[int] | None = None) -> list[Any]:
    """(1 - v)^N a(g) for g = z - 1 = 2 v / (1 - v), where `one` is 1 - v.

    With 1 + v in its place: bounds of these coefficients. With 1 + v^2 for its square: of |(1 - v)^N a|, v on the axis.
    """
    n, single = len(a) - 1, arb_poly(one)
    double = single**2 if square is None else arb_poly(square)
    parts = [
        arb_poly([0, 2]) ** k * c * double ** ((n - k) // 2) * single ** ((n - k) % 2)
        for k, c in enumerate(a)
    ]
    found = sum(parts, arb_poly([]))
    return [found[k] for k in range(n + 1)]


def determinant_bounds(
    m: Rows, dynamic: Sequence[bool] = (), e: Sequence[Any] = (), units: Mapping[int, int] | None = None
) -> list[Any]:
    """Bounds of the coefficients of det(g I + M) from m >= |M|, entry by entry; g in the dynamic rows alone, or in all.

    Hadamard: |det| <= product of the rows' lengths, in any units d of the states; Cauchy: |a_k| rho^k is at most that
    for |g| = rho. The rho and d that are tried are powers of two, found in floating point, which is harmless.
    With e: bounds of sum_l |cofactor_lj| e_l / 2^units_j, the largest of all j that have units.
    """
    n = len(m)
    best: list[Any] = []
    dynamic = dynamic or [True] * n
    known = [height(x) for row in m for x in row if x > 0] or [0.0]
    low, high = math.floor(min(known)) - 2, math.ceil(max(known)) + 4
    d = [0.0] * n
    for rho in sorted({round(low + (high - low) * k / 23) for k in range(24)}):
        full = [
            (i, j, x + arb(2) ** rho if i == j and dynamic[i] else x)
            for i, row in enumerate(m)
            for j, x in enumerate(row)
            if x > 0 or (i == j and dynamic[i])
        ]
        d = balance_units(n, [(i, j, max(height(x), -250.0)) for i, j, x in full], d)
        own, lines = [round(x) for x in d], [arb(0)] * n
        for i, j, x in full:
            lines[i] += (x * arb(2) ** (own[j] - own[i])) ** 2
        total = math.prod((x.sqrt() for x in lines), start=arb(1))
        if e:
            total *= sum((x * arb(2) ** -own[i] / lines[i].sqrt() for i, x in enumerate(e)), arb(0))
            total *= arb(2) ** max(own[j] - unit for j, unit in (units or {}).items())
        bounds = [upper(total * arb(2) ** (-rho * k)) for k in range(sum(dynamic) + 1)]
        best = [x if x < y else y for x, y in zip(bounds, best or bounds, strict=True)]
    return best


def balance_units(n: int, heights: list[tuple[int, int, float]], d: list[float]) -> list[float]:
    """log2 of units in which the product of the rows' lengths is small: Sinkhorn's iteration, from d."""
    for _ in range(6):
        rows, columns = [0.0] * n, [0.0] * n
        for i, j, h in heights:
            rows[i] += 4.0 ** (h + d[j])
        for i, j, h in heights:
            columns[j] += 4.0**h / rows[i]
        d = [-math.log2(x) / 2 for x in columns]
    return d
