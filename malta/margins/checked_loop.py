"""The characteristic polynomial of a certificate's loop: its matrices as rational functions, at balls and bounded."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from flint import Ordering, arb, arb_mat, fmpq_mpoly_ctx

from malta.margins.checked_file import Group, Loop

MOST_TERMS = 2000  # of an expression

Rows = list[list[Any]]


class Refused(Exception):
    """Why a certificate does not hold."""


# expressions: rational functions of v, in lowest terms


class Ratio:
    """num / den"""

    def __init__(self, num: Any, den: Any) -> None:
        common = num.gcd(den)
        if not common.is_constant():
            num, den = num / common, den / common
        self.num, self.den = num, den
        terms = [*num.to_dict().values(), *den.to_dict().values()]
        if len(terms) > MOST_TERMS or max(c.height_bits() for c in terms) > 50_000:
            raise Refused("expressions that are too long")
        self.terms: tuple[Any, ...] = ()

    def __add__(self, other: Ratio) -> Ratio:
        return Ratio(self.num * other.den + other.num * self.den, self.den * other.den)

    def __mul__(self, other: Ratio) -> Ratio:
        return Ratio(self.num * other.num, self.den * other.den)

    def __truediv__(self, other: Ratio) -> Ratio:
        if other.num.is_zero():
            raise Refused("a division by zero")
        return Ratio(self.num * other.den, self.den * other.num)

    def at(self, v: Sequence[Any]) -> Any:
        """The value at balls."""
        if not self.terms:
            self.terms = tuple(
                [(c, [(i, int(e)) for i, e in enumerate(m) if e]) for m, c in part.to_dict().items()]
                for part in (self.num, self.den)
            )
        found = []
        for part in self.terms:
            total = v[0] * 0
            for c, powers in part:
                term = v[0] * 0 + c
                for i, e in powers:
                    term *= v[i] ** e
                total += term
            found.append(total)
        return found[0] if self.den == 1 else found[0] / found[1]


Table = dict[tuple[int, int], Ratio]


@dataclass
class Tables:
    """Of a group: A; B D_c C and B C_c, by rows of x; B_c C. Rows of x that are acted on. Zeros are left out."""

    A: Table
    K: Table
    F: Table
    H: Table


def split(loop: Loop, until: float = math.inf) -> list[Tables]:
    """The expressions of each group, which is for each in its own v.

    Raises Refused unless all states are in one group, and no group acts on one before it.
    """
    n, k = loop.states, len(loop.law_a)
    place = {
        i: g for g, group in enumerate(loop.groups) for i in (*group.states, *(n + j for j in group.own))
    }
    if len(place) != n + k or sum(len(g.states) + len(g.own) for g in loop.groups) != n + k:
        raise Refused("groups that do not hold each state once")
    whole: dict[tuple[bool, ...], Tables] = {}
    found = []
    for group in loop.groups:
        if group.inverted not in whole:
            whole[group.inverted] = coupled(loop, group.inverted, until)
        t, x = whole[group.inverted], {i: a for a, i in enumerate(group.states)}
        own = {j: a for a, j in enumerate(group.own)}
        for table, rows, columns in ((t.A, 0, 0), (t.K, 0, 0), (t.F, 0, n), (t.H, n, 0)):
            if any(place[rows + i] < place[columns + j] for i, j in table):
                raise Refused("groups that act on one another")
        pick = [
            {(left[i], right[j]): r for (i, j), r in table.items() if i in left and j in right}
            for table, left, right in ((t.A, x, x), (t.K, x, x), (t.F, x, own), (t.H, own, x))
        ]
        found.append(Tables(*pick))
    for i, row in enumerate(loop.law_a):
        if any(value != 0 and place[n + i] < place[n + j] for j, value in enumerate(row)):
            raise Refused("groups that act on one another")
    return found


def coupled(loop: Loop, inverted: tuple[bool, ...], until: float = math.inf) -> Tables:
    """The program run on rational functions, and the products of its matrices with the compensator's."""
    context = fmpq_mpoly_ctx.get([f"v{i}" for i in range(len(inverted))], Ordering.lex)
    one, gens = context.constant(1), context.gens()
    cells: list[Ratio] = []
    for name, target, on, value in loop.steps:
        if time.monotonic() > until:
            raise Refused("time is up")
        a = cells[on[0]] if on else None
        b = cells[on[-1]] if on else None
        if name == "input":
            cells.append(Ratio(one, gens[target]) if inverted[target] else Ratio(gens[target], one))
        elif name == "const":
            cells.append(Ratio(context.constant(value), one))
        else:
            cells.append(_operation(name, a, b, int(value.p), Ratio(one, one)))
    A, B, C = ({(i, j): cells[s] for i, j, s in entries} for entries in loop.entries)

    def times(one: Table, gain: Rows, two: Table | None) -> Table:
        """one * gain, or one * gain * two; zeros left out."""
        left: Table = {}
        for (i, a), r in one.items():
            for b, g in enumerate(gain[a]):
                if g != 0:
                    _add(left, (i, b), r * Ratio(context.constant(g), context.constant(1)))
        if two is None:
            return _without_zeros(left)
        both: Table = {}
        for (i, b), r in left.items():
            for (c, j), q in two.items():
                if b == c:
                    _add(both, (i, j), r * q)
        return _without_zeros(both)

    # B_c C is the transpose of C' B_c'
    back = [[row[b] for row in loop.law_b] for b in range(len(loop.law_d[0]))]
    turned = times({(j, i): r for (i, j), r in C.items()}, back, None)
    return Tables(
        _without_zeros(A),
        times(B, loop.law_d, C),
        times(B, loop.law_c, None),
        {(i, j): r for (j, i), r in turned.items()},
    )


def _operation(name: str, a: Any, b: Any, power: int, one: Ratio) -> Ratio:
    minus = Ratio(-one.num, one.den)
    if name == "constpow":
        found = one
        for _ in range(abs(power)):
            found = found * a
        return found if power >= 0 else one / found
    table: dict[str, Any] = {
        "assign": lambda: a, "add": lambda: a + b, "sub": lambda: a + minus * b, "mul": lambda: a * b,
        "div": lambda: a / b, "neg": lambda: minus * a, "sq": lambda: a * a, "twice": lambda: a + a,
        "inv": lambda: one / a,
    }  # fmt: skip
    found = table[name]()
    assert isinstance(found, Ratio)
    return found


def _add(table: Table, at: tuple[int, int], r: Ratio) -> None:
    table[at] = table[at] + r if at in table else r


def _without_zeros(table: Table) -> Table:
    return {at: r for at, r in table.items() if not r.num.is_zero()}


# the characteristic polynomial of a group


class Polynomial:
    """a_0 ... a_N of a group, at balls of v; and bounds of |a_k| over complex balls."""

    def __init__(self, loop: Loop, group: Group, tables: Tables) -> None:
        self.loop, self.group, self.tables = loop, group, tables
        self.acted = sorted({i for i, _ in (*tables.K, *tables.F)})
        self.used = {
            i
            for table in (tables.A, tables.K, tables.F, tables.H)
            for r in table.values()
            for part in (r.num, r.den)
            for i, e in enumerate(part.degrees())
            if e
        }

    def at(self, v: Sequence[Any]) -> list[Any]:
        """Coefficients at real balls."""
        t, n = self.tables, len(self.group.states)
        values = [{at: r.at(v) for at, r in table.items()} for table in (t.A, t.K, t.F, t.H)]
        m = self._closed(_dense(n, n, values[0].items()), None, values[1:])
        a = list(m.charpoly().coeffs())
        a += [arb(0)] * (m.nrows() + 1 - len(a))
        return a if self.loop.sample_time is None else _mapped(a, -1)

    def bounds(self, v: Sequence[Any]) -> list[Any]:
        """At least |a_k| for all complex v in balls."""
        t, n = self.tables, len(self.group.states)
        values = [{at: r.at(v) for at, r in table.items()} for table in (t.A, t.K, t.F, t.H)]
        if not all(z.is_finite() for table in values for z in table.values()):
            raise Refused("a division by what may be zero")
        sizes = [{at: _upper(abs(z)) for at, z in table.items()} for table in values]
        diagonal = [_top(values[0][i, i].real) if (i, i) in values[0] else arb(0) for i in range(n)]
        m = self._closed(_dense(n, n, sizes[0].items()), diagonal, sizes[1:])
        if not all(x.is_finite() for x in m.entries()):
            raise Refused("numbers that overflow")
        a = determinant_bounds([[_upper(m[i, j]) for j in range(m.ncols())] for i in range(m.nrows())])
        return a if self.loop.sample_time is None else _mapped(a, 1)

    def _closed(self, a: Rows, diagonal: list[Any] | None, tables: list[dict[tuple[int, int], Any]]) -> Any:
        """The closed loop's matrix (sampled: less 1); with `diagonal`, bounds of its entries from bounds of them."""
        loop, acted = self.loop, self.acted
        n, r, k = len(a), len(acted), len(self.group.own)
        sign = -1 if diagonal is None else 1
        s = _dense(n, r, (((i, q), 1) for q, i in enumerate(acted)))
        if loop.lag is not None:  # a lag of each force, as further states
            a = [a[i] + s[i] for i in range(n)] + [
                [0] * n + [sign * loop.lag * (i == q) for q in range(r)] for i in range(r)
            ]
            s = [[0] * r for _ in range(n)] + [[loop.lag * (i == q) for q in range(r)] for i in range(r)]
            diagonal = None if diagonal is None else [*diagonal, *([-loop.lag] * r)]
        if loop.sample_time is not None:
            a, s = self._sampled(a, s, diagonal)
            for _ in range(loop.delay):  # forces under way: the latest enters last
                width = len(a)
                a = [a[i] + s[i] for i in range(width)] + [
                    [0] * width + [sign * (i == q) for q in range(r)] for i in range(r)
                ]
                s = [[0] * r for _ in range(width)] + [[int(i == q) for q in range(r)] for i in range(r)]
        width, one = len(a), int(loop.sample_time is not None)
        row = {i: q for q, i in enumerate(acted)}
        K, F = ({(row[i], j): z for (i, j), z in table.items()} for table in tables[:2])
        into = arb_mat(width, r, [x for line in s for x in line])
        inner = arb_mat(width, width, [x for line in a for x in line])
        inner += into * arb_mat(r, width, _flat(_dense(r, width, K.items())))
        outer = into * arb_mat(r, k, _flat(_dense(r, k, F.items())))
        own = [
            [_less(loop.law_a[i][j], one * (i == j), diagonal) for j in self.group.own]
            for i in self.group.own
        ]
        left = _dense(k, width, tables[2].items())
        rows = [
            [*(inner[i, j] for j in range(width)), *(outer[i, j] for j in range(k))] for i in range(width)
        ]
        return arb_mat(width + k, width + k, _flat(rows + [left[i] + own[i] for i in range(k)]))

    def _sampled(self, a: Rows, s: Rows, diagonal: list[Any] | None) -> tuple[Rows, Rows]:
        """Held and sampled, less 1; bounds where `diagonal` has upper bounds of the real parts of A's diagonal.

        |e^(A t)| <= e^(M t) with |A| for M beside its diagonal; e^(A T) - 1 = A V, V the integral of e^(A t).
        """
        n, r, T = len(a), len(self.acted), self.loop.sample_time
        if self.loop.discrete:
            return [
                [_less(x, int(i == j), diagonal) for j, x in enumerate(row)] for i, row in enumerate(a)
            ], s
        if diagonal is None:
            both = (
                arb_mat(n + r, n + r, _flat([a[i] + s[i] for i in range(n)] + [[0] * (n + r)] * r)) * arb(T)
            ).exp()
            phi = [[both[i, j] - int(i == j) for j in range(n)] for i in range(n)]
            return phi, [[both[i, n + q] for q in range(r)] for i in range(n)]
        top = [
            [*(diagonal[i] if i == j else x for j, x in enumerate(row)), *(int(i == j) for j in range(n))]
            for i, row in enumerate(a)
        ]
        whole = arb_mat(2 * n, 2 * n, _flat(top + [[0] * (2 * n)] * n)) * arb(T)
        if not all(abs(x) < 3000 for x in whole.entries()):
            raise Refused("numbers that overflow")
        both = whole.exp()
        V = arb_mat(n, n, [_upper(both[i, n + j]) for i in range(n) for j in range(n)])
        both, into = arb_mat(n, n, _flat(a)) * V, V * arb_mat(n, r, _flat(s))
        return [[both[i, j] for j in range(n)] for i in range(n)], [
            [into[i, q] for q in range(r)] for i in range(n)
        ]


def _less(x: Any, one: int, bounds: Any) -> Any:
    """x - one; its size, where bounds are asked for (of x in the compensator: exact)."""
    if bounds is None:
        return x - one
    return abs(x) + one if isinstance(x, arb) else abs(x - one)


def _dense(rows: int, columns: int, entries: Iterable[tuple[tuple[int, int], Any]]) -> Rows:
    table: Rows = [[0] * columns for _ in range(rows)]
    for (i, j), value in entries:
        table[i][j] = value
    return table


def _flat(rows: Rows) -> list[Any]:
    return [arb(x) for row in rows for x in row]


def _upper(x: Any) -> Any:
    return arb(x.abs_upper())


def _top(x: Any) -> Any:
    return arb(x.upper())


def _mapped(a: list[Any], sign: int) -> list[Any]:
    """Coefficients of g = z - 1 = 2 v / (1 - v) -> those of (1 - v)^N a; sign 1: bounds of their sizes."""
    n = len(a) - 1
    found = [arb(0)] * (n + 1)
    for k, c in enumerate(a):
        for j in range(n - k + 1):
            found[k + j] += c * (2**k * math.comb(n - k, j) * sign**j)
    return found


def determinant_bounds(m: Rows) -> list[Any]:
    """Bounds of the coefficients of det(s + M) from m >= |M|, entry by entry.

    |a_k| rho^k is at most the product over i of sum_j (rho + m)_ij d_j / d_i, for any rho, d > 0; those tried are
    powers of two, found in floating point, which is harmless.
    """
    n = len(m)
    heights = [[height(x) for x in row] for row in m]
    known = [h for row in heights for h in row if h > -math.inf] or [0.0]
    low, high = math.floor(min(known)) - 2, math.ceil(max(known)) + 4
    best: list[Any] = [None] * (n + 1)
    for rho in sorted({round(low + (high - low) * k / 15) for k in range(16)}):
        d = _balanced(
            [[max(h, rho) if i == j else h for j, h in enumerate(row)] for i, row in enumerate(heights)]
        )
        total = arb(1)
        for i, row in enumerate(m):
            line = arb(2) ** rho
            for j, x in enumerate(row):
                line += x * arb(2) ** (d[j] - d[i])
            total *= line
        for k in range(n + 1):
            bound = _upper(total * arb(2) ** (-rho * k))
            best[k] = bound if best[k] is None or bound < best[k] else best[k]
    return best


def _balanced(heights: list[list[float]]) -> list[int]:
    """log2 of column scales that make the row sums small."""
    n = len(heights)
    d = [0.0] * n
    for _ in range(6):
        rows = [max(h + d[j] for j, h in enumerate(row)) for row in heights]
        d = [-max(heights[i][j] - rows[i] for i in range(n)) for j in range(n)]
    return [round(x) for x in d]


def height(x: Any) -> float:
    """About log2 |x|."""
    m, e = (int(i) for i in x.abs_upper().man_exp())
    return math.log2(m) + e if m > 0 else -math.inf
