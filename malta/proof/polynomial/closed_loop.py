"""The closed loop's state matrix in exact numbers, or balls, at given parameters; and entrywise bounds of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from flint import acb, acb_mat, arb
from scipy import linalg, sparse

from malta.arrays import FloatArray
from malta.linear.balls import BALLS, finite
from malta.linear.expressions import NotAnalytic, exact
from malta.linear.rational import Ratio, Symbolic, value
from malta.linear.sampling import split_delay
from malta.linear.uncertain import StateGroup
from malta.proof.groups import (
    A,
    B,
    C,
    D,
    E,
    UncertainLoop,
    divide_by_descriptor,
    groups,
    hold_bounds,
    rational,
    upper,
)
from malta.work import spend


class DrivenGroup(NamedTuple):
    """A group of a loop at given parameters: its system with lag, hold and delay, and its law, as flint matrices."""

    matrix: Any  # their type
    a: Any
    b: Any
    c: Any
    d: Any  # None for none
    f_a: list[list[Any]]  # rows of the law's A and B (of differences where discrete)
    f_b: list[list[Any]]
    out: Any  # C of the law, to the inputs of the group; None for a law without states
    through: Any  # D of the law
    det_E: Any


def driven_group(
    loop: UncertainLoop, g: StateGroup, entries: list[list[tuple[int, int, Any]]], matrix: Any
) -> DrivenGroup:
    """A group with its law, from the entries of A, B, C, D and E as numbers of `matrix`, a type of flint.

    Raises NotAnalytic when E is singular or numbers overflow.
    """
    law, x = loop.law, {state: k for k, state in enumerate(g.states)}
    m, p, n = loop.program.shapes[B][1], loop.program.shapes[C][0], len(x)
    a = dense(matrix, n, n, ((x[i], x[j], r) for i, j, r in entries[A] if i in x and j in x))
    b = dense(matrix, n, m, ((x[i], j, r) for i, j, r in entries[B] if i in x))
    c = dense(matrix, p, n, ((i, x[j], r) for i, j, r in entries[C] if j in x))
    d = dense(matrix, p, m, entries[D]) if loop.direct else None
    factor: Any = 1
    if loop.descriptor:
        e = dense(matrix, n, n, ((x[i], x[j], r) for i, j, r in entries[E] if i in x and j in x))
        factor = e.det()
        ab = solve(e, join_columns(matrix, a, b))
        a, b = columns(matrix, ab, range(n)), columns(matrix, ab, range(n, n + m))
    out, through = matrix(rational(law.C[:, list(g.own)])) if g.own else None, matrix(rational(law.D))
    if g.inputs is not None:
        picked = [x[i] for i in g.inputs]
        rows = rows_of(matrix, b, picked)
        out = None if out is None else rows * out
        through = rows * through
        b = dense(matrix, n, len(picked), ((k, j, 1) for j, k in enumerate(picked)))
    a, b, c, d = drive(loop, matrix, a, b, c, d)
    a, b, c, d = add_delay(matrix, a, b, c, d, split_delay(law.delay)[0])
    f_b = rational(law.B[list(g.own)])
    return DrivenGroup(matrix, a, b, c, d, law_matrix(loop, g), f_b, out, through, factor)


def drive(loop: UncertainLoop, matrix: Any, a: Any, b: Any, c: Any, d: Any) -> tuple[Any, Any, Any, Any]:
    """A system with the loop's lag, held and sampled, a fraction of a sample of its delay included.

    In differences x+ - x where it is discrete.
    """
    law = loop.law
    if law.lag is not None:
        a, b, c, d = add_lag(matrix, a, b, c, d, arb(law.lag) if loop.sampled else exact(law.lag))
    if loop.sampled:
        T, (_, part) = arb(law.sample_time), split_delay(law.delay)
        newest = hold(matrix, a, b, (1 - arb(part)) * T)[1] if part else None
        a, b = hold(matrix, a, b, T)
        if newest is not None:  # inputs stored for a sample act for the fraction, new ones for the rest of it
            a, old, c, d = add_delay(matrix, a, b - newest, c, d, 1)
            b = old + _stack(matrix, [[newest], [zeros(matrix, b.ncols(), b.ncols())]])
    elif law.sample_time is not None:
        a = a - _identity(matrix, a.nrows())
    return a, b, c, d


def law_matrix(loop: UncertainLoop, g: StateGroup) -> list[list[Any]]:
    """The rows of the law's own A, of differences where it is discrete."""
    rows = rational(loop.law.A[np.ix_(g.own, g.own)])
    if loop.law.sample_time is None:
        return rows
    return [[v - (i == j) for j, v in enumerate(row)] for i, row in enumerate(rows)]


def dense(matrix: Any, rows: int, columns: int, entries: Any) -> Any:
    table = [[0] * columns for _ in range(rows)]
    for i, j, entry in entries:
        table[i][j] = entry
    return matrix(rows, columns, [entry for row in table for entry in row])


def _identity(matrix: Any, n: int) -> Any:
    return dense(matrix, n, n, ((i, i, 1) for i in range(n)))


def rows_of(matrix: Any, m: Any, picked: Sequence[int]) -> Any:
    n, values = m.ncols(), m.entries()
    return matrix(len(picked), n, [x for i in picked for x in values[i * n : (i + 1) * n]])


def columns(matrix: Any, m: Any, picked: Sequence[int]) -> Any:
    n, values = m.ncols(), m.entries()
    return matrix(m.nrows(), len(picked), [values[i + j] for i in range(0, m.nrows() * n, n) for j in picked])


def join_columns(matrix: Any, *parts: Any) -> Any:
    rows, wide = parts[0].nrows(), [(part.ncols(), part.entries()) for part in parts]
    values = [x for i in range(rows) for n, own in wide for x in own[i * n : (i + 1) * n]]
    return matrix(rows, sum(n for n, _ in wide), values)


def _stack(matrix: Any, blocks: list[list[Any]]) -> Any:
    rows = [join_columns(matrix, *row) for row in blocks if row[0].nrows()]
    if not rows:
        return matrix(0, 0, [])
    values = [x for row in rows for x in row.entries()]
    return matrix(sum(row.nrows() for row in rows), rows[0].ncols(), values)


def zeros(matrix: Any, n: int, m: int) -> Any:
    return matrix(n, m, [0] * (n * m))


def solve(e: Any, right: Any) -> Any:
    try:
        return e.solve(right)
    except ZeroDivisionError as error:
        raise NotAnalytic("E(p) that is singular") from error


def add_lag(matrix: Any, a: Any, b: Any, c: Any, d: Any, rate: Any) -> tuple[Any, Any, Any, Any]:
    """The system behind first-order lags of its inputs; the states of the lags follow x."""
    n, m = a.nrows(), b.ncols()
    eye, p = _identity(matrix, m), c.nrows()
    a = _stack(matrix, [[a, b], [zeros(matrix, m, n), eye * (-rate)]])
    b = _stack(matrix, [[zeros(matrix, n, m)], [eye * rate]])
    return a, b, join_columns(matrix, c, zeros(matrix, p, m) if d is None else d), None


def hold(matrix: Any, a: Any, b: Any, T: Any) -> tuple[Any, Any]:
    """The system under a zero-order hold, exactly: e^(A T) - I and the integral of e^(A t) B."""
    n, m = a.nrows(), b.ncols()
    own, into, held = a.entries(), b.entries(), list[Any]()
    for i in range(n):
        held += own[i * n : (i + 1) * n] + into[i * m : (i + 1) * m]
    both = (matrix(n + m, n + m, held + [0] * (m * (n + m))) * T).exp().entries()
    own, into = [], []
    for i in range(n):
        row = both[i * (n + m) : (i + 1) * (n + m)]
        own += row[:n]
        into += row[n:]
    for i in range(0, n * n, n + 1):
        own[i] -= 1
    phi, gamma = matrix(n, n, own), matrix(n, m, into)
    if not all(x.is_finite() for x in own):
        raise NotAnalytic("numbers that overflow: a system too fast for its sample time")
    return phi, gamma


def add_delay(matrix: Any, phi: Any, gamma: Any, c: Any, d: Any, delay: int) -> tuple[Any, Any, Any, Any]:
    """The system, in differences x+ - x, behind a delay of `delay` samples; stored inputs are oldest first."""
    if delay == 0:
        return phi, gamma, c, d
    n, m, p = phi.nrows(), gamma.ncols(), c.nrows()
    stored = m * delay
    shift = dense(
        matrix, stored, stored,
        [(i, i, -1) for i in range(stored)] + [(i, i + m, 1) for i in range(stored - m)],
    )  # fmt: skip
    a = _stack(matrix, [[phi, gamma, zeros(matrix, n, stored - m)], [zeros(matrix, stored, n), shift]])
    b = dense(matrix, n + stored, m, ((n + stored - m + j, j, 1) for j in range(m)))
    late = join_columns(
        matrix, c, *([d] if d is not None else [zeros(matrix, p, m)]), zeros(matrix, p, stored - m)
    )
    return a, b, late, None


def closed_loop(group: DrivenGroup) -> tuple[Any, Any]:
    """The closed loop's state matrix (of differences where discrete), and det(I - D_c D)."""
    matrix, a, b, c, d, *_ = group
    out, through, k = group.out, group.through, len(group.f_a)
    factor: Any = 1
    if d is not None:
        w = _identity(matrix, b.ncols()) - through * d
        factor = w.det()
        right = through * c if out is None else join_columns(matrix, through * c, out)
        both = solve(w, right)
        into = columns(matrix, both, range(c.ncols()))
        out = None if out is None else columns(matrix, both, range(c.ncols(), both.ncols()))
    else:
        into = through * c
    plant = a + b * into
    if not k:
        return plant, factor
    f_a, f_b = matrix(group.f_a), matrix(group.f_b)
    y_x = c if d is None else c + d * into
    own = f_a if d is None else f_a + f_b * (d * out)
    return _stack(matrix, [[plant, b * out], [f_b * y_x, own]]), factor


def coefficients(closed: tuple[Any, Any]) -> list[Any]:
    m, factor = closed
    if m.nrows() == 0:
        return [factor]
    found = list(m.charpoly().coeffs())
    found += [0 * found[0]] * (m.nrows() + 1 - len(found))
    return [c * factor for c in found]


def entry_bounds(
    entries: list[list[tuple[int, int, Any]]],
    states: Sequence[int],
    inputs: Sequence[int],
    outputs: Sequence[int],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Entrywise bounds of E^-1 A, E^-1 B and C between these signals, and of the real parts of A's diagonal.

    entries : balls of A, B, C, and of D and E where there are any

    Raises NotAnalytic where E is singular.
    """
    x, u, y = ({signal: k for k, signal in enumerate(side)} for side in (states, inputs, outputs))
    n, m = len(x), len(u)
    a = [(x[i], x[j], z) for i, j, z in entries[A] if i in x and j in x]
    b = [(x[i], u[j], z) for i, j, z in entries[B] if i in x and j in u]
    if len(entries) > E:
        e = dense(acb_mat, n, n, ((x[i], x[j], z) for i, j, z in entries[E] if i in x and j in x))
        ab = solve(e, join_columns(acb_mat, dense(acb_mat, n, n, a), dense(acb_mat, n, m, b)))
        a = [(i, j, ab[i, j]) for i in range(n) for j in range(n)]
        b = [(i, j, ab[i, n + j]) for i in range(n) for j in range(m)]
    diagonal = np.zeros(n)
    for i, j, z in a:
        if i == j:
            diagonal[i] = upper(z)
    c = ((y[i], x[j], z) for i, j, z in entries[C] if i in y and j in x)
    return _sizes(n, n, a), _sizes(n, m, b), _sizes(len(y), n, c), diagonal


def _sizes(rows: int, columns: int, entries: Iterable[tuple[int, int, Any]]) -> FloatArray:
    found = np.zeros((rows, columns))
    for i, j, z in entries:
        found[i, j] = float(abs(z).upper()) * (1 + 1e-9)
    return found


def majorant_matrix(
    loop: UncertainLoop, g: StateGroup, entries: list[list[tuple[int, int, Any]]]
) -> FloatArray:
    """Entrywise bounds of the closed loop's state matrix (of differences where discrete), from balls of the entries.

    Raises NotAnalytic when numbers overflow, or the direct feedthrough is too large.
    """
    law, x = loop.law, {state: k for k, state in enumerate(g.states)}
    m, p, n = loop.program.shapes[B][1], loop.program.shapes[C][0], len(x)
    a, b, c, diagonal = entry_bounds(entries, g.states, range(m), range(p))
    d = _sizes(p, m, entries[D]) if loop.direct else None
    out, through = np.abs(law.C[:, list(g.own)]), np.abs(law.D)
    if not all(np.isfinite(part).all() for part in (a, b, c, d) if part is not None):
        raise NotAnalytic("numbers that overflow")
    if g.inputs is not None:
        picked = [x[i] for i in g.inputs]
        out, through, b = b[picked] @ out, b[picked] @ through, np.eye(n)[:, picked]
    a, b, c, d = driven_bounds(loop, (a, b, c, d), diagonal)
    if whole := split_delay(law.delay)[0]:
        n, r = len(a), b.shape[1]
        stored = r * whole
        big = np.zeros((n + stored, n + stored))
        big[:n, :n], big[:n, n : n + r] = a, b
        big[n:, n:] = np.eye(stored) + np.eye(stored, k=r)
        late = np.zeros((p, stored))
        if d is not None:
            late[:, :r] = d
        a, b, c, d = big, np.eye(n + stored)[:, -r:], np.hstack([c, late]), None
    if d is not None:
        loops = through @ d
        if not np.abs(np.linalg.eigvals(loops)).max(initial=0.0) < 0.99:
            raise NotAnalytic("a direct feedthrough around the loop that may reach one")
        inverse = np.linalg.inv(np.eye(len(loops)) - loops)
        out, through = inverse @ out, inverse @ through
    f_a, f_b = law.A[np.ix_(g.own, g.own)], np.abs(law.B[list(g.own)])
    own = np.abs(f_a - (0 if law.sample_time is None else np.eye(len(f_a))))
    y_x = c if d is None else c + d @ through @ c
    own = own if d is None else own + f_b @ d @ out
    return np.block([[a + b @ through @ c, b @ out], [f_b @ y_x, own]]) * (1 + 1e-9)


Bounds = tuple["FloatArray", "FloatArray", "FloatArray", "FloatArray | None"]


def driven_bounds(loop: UncertainLoop, abcd: Bounds, diagonal: FloatArray) -> Bounds:
    """Bounds of the system with its lag, held and sampled (as differences), from those of A, B, C and D."""
    law, (a, b, c, d) = loop.law, abcd
    r, p = b.shape[1], len(c)
    rate = law.lag
    if loop.sampled:
        assert law.sample_time is not None
        a, V = hold_bounds(a, diagonal, law.sample_time)
        b = V @ b  # of either part of a split sample, too
        if rate is not None:  # V bounds both parts of the held input, the state of the lag and the rest
            rate = float(-np.expm1(-rate * law.sample_time)) * (1 + 1e-12)
            b_late = np.vstack([b, rate * np.eye(r)])
    elif rate is not None:
        b_late = np.vstack([np.zeros_like(b), rate * np.eye(r)])
    elif law.sample_time is not None:
        a = a + np.eye(len(a))
    if rate is not None:
        a = np.block([[a, b], [np.zeros((r, len(a))), rate * np.eye(r)]])
        b, c, d = b_late, np.hstack([c, np.zeros((p, r)) if d is None else d]), None
    if loop.sampled and split_delay(law.delay)[1]:
        a = np.block([[a, b], [np.zeros((r, len(a))), np.eye(r)]])
        b, c, d = np.vstack([b, np.eye(r)]), np.hstack([c, np.zeros((p, r)) if d is None else d]), None
    return a, b, c, d


# Upper bounds of the coefficients of det(g + A) from bounds of |A| alone.
#
# With column scales d and any rho > 0, |a_k| rho^k is at most the product of the row sums of (rho I + |A|) d / d_i.
# The scales are found for each rho by balancing, and each k takes the rho that suits it best: a determinant whose
# entries and roots spread over decades is bounded to a few bits for each row, where one scaling for all k loses
# dozens.


ROUNDS, RELAXATION = 14, 1.7  # of the iteration, over-relaxed: plain, it takes 25
ROUNDING_FACTOR = 1 + 1e-9


def coefficient_bounds(m: FloatArray, roots: FloatArray) -> list[Any]:
    """Bounds of a_0, a_1, ... of det(g diag(roots) + M), roots 0 or 1 in each row, from m >= |M|: exact powers of two.

    Raises NotAnalytic where numbers overflow.
    """
    return all_bounds(m[None], roots)[0]


def all_bounds(m: FloatArray, roots: FloatArray) -> list[list[Any]]:
    """`coefficient_bounds` of several matrices: rows x n x n."""
    if not np.isfinite(m).all():
        raise NotAnalytic("numbers that overflow")
    count, n = int(roots.sum()), m.shape[1]
    low = np.log2(np.where(m > 0, m, np.inf).min(axis=(1, 2), initial=1.0)) - 2
    high = np.log2(m.max(axis=(1, 2), initial=1.0)) + 3 + math.log2(max(n, 1))
    rho = np.exp2(np.linspace(np.maximum(low, -400), np.minimum(high, 400), 28, axis=1))
    full = m[:, None] + rho[:, :, None, None] * np.diag(roots)
    heights = _heights(full.reshape(-1, n, n)).reshape(rho.shape)
    logs = (heights[:, :, None] - np.arange(count + 1) * np.log2(rho)[:, :, None]).min(axis=1)
    return [[power_of_two(x) for x in row] for row in logs.tolist()]


def power_of_two(x: float) -> Any:
    """2^x, from above."""
    if x == -math.inf:
        return arb(0)
    if not math.isfinite(x):
        raise NotAnalytic("numbers that overflow")
    whole = math.floor(x)
    return arb(2.0 ** (x - whole) * ROUNDING_FACTOR) * arb(2) ** whole


def _heights(full: FloatArray) -> FloatArray:
    """log2 of the product of row sums of F d / d_i, d by Sinkhorn's iteration: rows x n x n -> rows.

    Any d > 0 gives a bound.
    """
    d = np.ones(full.shape[:2])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(ROUNDS):
            rows = (full @ d[:, :, None])[:, :, 0]
            columns = ((1 / np.where(rows > 0, rows, 1))[:, None] @ full)[:, 0]
            new = 1 / np.where(columns > 0, columns, 1)
            d = new * (new / d) ** (RELAXATION - 1) if k else new
        d = np.exp2(np.round(np.log2(np.clip(d, 1e-200, 1e200))))
        rows = (full @ d[:, :, None])[:, :, 0]
        heights = np.log2(rows * ROUNDING_FACTOR).sum(axis=1) - np.log2(d).sum(axis=1)
    return np.where(np.isnan(heights), np.inf, heights)


# Couplings of the size of rounding, as gains leave them that should cancel: taken as zero, and bounded.
#
# On the boundary of stability the loop is M = diag(M_k) + e with small e. det M is not zero where the row sums of
# |diag(M_k)^-1 e| are below one: where |det M_k| > sum_i |cofactor_ij| e_i for every k and column j, e_i row sums of e.
# The sum is the determinant of M_k with e in column j. It is bounded like coefficients and becomes part of the radius
# of det M_k. Lag, hold and delay have |h| <= 1 there and are left out of M.


COUPLING_TOLERANCE = 1e-11  # relative size below which a coupling may be rounding
TERM = 4e-6  # work of a term in balls


@dataclass(frozen=True, eq=False)
class Couplings:
    """The couplings of a closed loop as exact expressions: x to x, commands to x, y to the compensator."""

    loop: UncertainLoop
    symbolic: Symbolic

    @cached_property
    def entries(self) -> tuple[dict[tuple[int, int], Ratio], ...]:
        """The entries of A, of B (D_c C, C_c) and of B_c C; sums are added before they are bounded."""
        loop, s, law = self.loop, self.symbolic, self.loop.law
        n, k = loop.states, len(law.A)
        own, into, out = divide_by_descriptor(loop, s)[A], divide_by_descriptor(loop, s)[B], s.entries[C]
        held: dict[tuple[int, int], Ratio] = {}
        measured: dict[tuple[int, int], Ratio] = {}

        def add(table: dict[tuple[int, int], Ratio], at: tuple[int, int], r: Ratio, gain: float) -> None:
            if gain:
                part = r * s.constant(gain)
                table[at] = table[at] + part if at in table else part

        for (i, a), r in into.items():
            for (b, j), q in out.items():
                add(held, (i, j), r * q, float(law.D[a, b]))
            for j in range(k):
                add(held, (i, n + j), r, float(law.C[a, j]))
        for (b, j), q in out.items():
            for i in range(k):
                add(measured, (i, j), q, float(law.B[i, b]))
        return own, held, measured

    @cached_property
    def terms(self) -> int:
        """The number of terms of all entries."""
        ratios = [r for table in self.entries for r in table.values()]
        return sum(len(r.num) + (0 if r.den is None else len(r.den)) for r in ratios)

    @np.errstate(over="ignore", invalid="ignore")  # bounds that overflow are refused
    def bounds(self, p: Sequence[Any]) -> FloatArray:
        """Entrywise bounds of M without its diagonal s (or g) over real balls p; the states x come first."""
        spend(TERM * self.terms)
        loop, law = self.loop, self.loop.law
        n, k = loop.states, len(law.A)
        values = [acb(x) for x in p]
        if self.symbolic.atoms:
            steps = loop.program.cells(values, BALLS)
            values += [steps[i] for i in self.symbolic.atoms]
        size: FloatArray = np.zeros((n + k, n + k))
        own: FloatArray = np.zeros((n, n))
        diagonal = np.zeros(n)
        for table, matrix, row in zip(self.entries, (own, size, size), (0, 0, n), strict=True):
            for (i, j), r in table.items():
                z = _ratio(r, values)
                matrix[row + i, j] = float(abs(z).upper()) * (1 + 1e-9)
                if matrix is own and i == j:
                    diagonal[i] = upper(z)
        size[n:, n:] = np.abs(law.A - (0 if law.sample_time is None else np.eye(k)))
        if loop.sampled:
            assert law.sample_time is not None
            own, V = hold_bounds(own, diagonal, law.sample_time)
            size[:n] = V @ size[:n]
        elif law.sample_time is not None:
            own = own + np.eye(n)
        size[:n, :n] += own
        return size


def _ratio(r: Ratio, values: list[Any]) -> Any:
    top = value(r.num.to_dict(), values)
    return finite(top if r.den is None else top / value(r.den.to_dict(), values))


@dataclass(frozen=True, eq=False)
class GroupPart:
    """A group, and bounds of the coefficients (of s or g) by which neglected couplings can move its determinant."""

    group: StateGroup
    moves: tuple[Any, ...]


def loop_parts(loop: UncertainLoop, couplings: Couplings | None, p: Sequence[Any]) -> list[GroupPart]:
    """The groups of a loop over real balls p, split further at couplings of the size of rounding."""
    exact = groups(loop)
    if couplings is None or loop.direct or _is_coupled(loop) or not any(len(g.states) > 1 for g in exact):
        return [GroupPart(g, ()) for g in exact]
    try:
        size = couplings.bounds(p)
    except NotAnalytic:
        return [GroupPart(g, ()) for g in exact]
    if not np.isfinite(size).all():
        return [GroupPart(g, ()) for g in exact]
    found: list[GroupPart] = []
    for g in exact:
        members = [*g.states, *(loop.states + i for i in g.own)]
        found += _split(loop, g, members, size[np.ix_(members, members)])
    return found


def _is_coupled(loop: UncertainLoop) -> bool:
    """Whether E has entries beside its diagonal, by which the rows of the couplings are not divided."""
    return loop.descriptor and any(i != j for i, j, _ in loop.program.entries[E])


def _split(loop: UncertainLoop, g: StateGroup, members: list[int], size: FloatArray) -> list[GroupPart]:
    _, (units, _) = linalg.matrix_balance(size, permute=False, separate=True)
    size = size * units / units[:, None]
    rows, columns = size.max(axis=1), size.max(axis=0)
    touch = size > COUPLING_TOLERANCE * np.sqrt(rows[:, None] * columns[None, :])
    n = loop.states
    if loop.sampled or loop.descriptor:  # couplings inside the exponential are all kept
        s = loop.symbolic
        assert s is not None
        place = {state: k for k, state in enumerate(members)}
        for i, j in s.entries[A]:
            if i in place and j in place:
                touch[place[i], place[j]] = True
    # a coupling above rounding in one direction joins two groups
    _, label = sparse.csgraph.connected_components(touch, directed=False)
    if label.max() == 0:
        return [GroupPart(g, ())]
    acting = sorted({i for i, _, _ in loop.program.entries[B]})
    found = []
    for k in range(int(label.max()) + 1):
        mine = np.flatnonzero(label == k)
        states = tuple(members[i] for i in mine if members[i] < n)
        own = tuple(members[i] - n for i in mine if members[i] >= n)
        inputs = tuple(i for i in acting if i in states)
        group = StateGroup(states, own, inputs if len(inputs) < loop.program.shapes[B][1] else None)
        outside = size[mine][:, label != k].sum(axis=1)
        found.append(GroupPart(group, _moves(size[np.ix_(mine, mine)], outside)))
    return found


def _moves(size: FloatArray, outside: FloatArray) -> tuple[Any, ...]:
    """Bounds of the coefficients of det(g I + M) with `outside` in column j, the largest over all j."""
    n = len(size)
    if not outside.any():
        return ()
    most = [arb(0)] * n
    for j in range(n):
        m, roots = size.copy(), np.ones(n)
        m[:, j], roots[j] = outside, 0
        most = [x.max(y) for x, y in zip(most, coefficient_bounds(m, roots), strict=True)]
    return tuple(most)
