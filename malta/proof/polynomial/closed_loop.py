"""The closed loop's state matrix in exact numbers, or balls, at given parameters; and entrywise bounds of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from flint import acb_mat, arb

from malta.proof.expressions import NotAnalytic, exact
from malta.proof.groups import A, B, C, D, E, UncertainLoop, hold_bounds, rational, upper
from malta.proof.uncertain import Group

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


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
    loop: UncertainLoop, g: Group, entries: list[list[tuple[int, int, Any]]], matrix: Any
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
    if loop.sampled:
        if law.lag is not None:
            a, b, c, d = add_lag(matrix, a, b, c, d, arb(law.lag))
        a, b = hold(matrix, a, b, arb(law.sample_time))
        a, b, c, d = add_delay(matrix, a, b, c, d, law.delay)
    else:
        if law.lag is not None:
            a, b, c, d = add_lag(matrix, a, b, c, d, exact(law.lag))
        if law.sample_time is not None:
            a = a - _identity(matrix, a.nrows())
            a, b, c, d = add_delay(matrix, a, b, c, d, law.delay)
    own = list(g.own)
    f_a = rational(law.A[np.ix_(own, own)])
    if law.sample_time is not None:
        f_a = [[v - (i == j) for j, v in enumerate(row)] for i, row in enumerate(f_a)]
    f_b = rational(law.B[own])
    return DrivenGroup(matrix, a, b, c, d, f_a, f_b, out, through, factor)


def dense(matrix: Any, rows: int, columns: int, entries: Any) -> Any:
    table = [[0] * columns for _ in range(rows)]
    for i, j, value in entries:
        table[i][j] = value
    return matrix(rows, columns, [value for row in table for value in row])


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
    a = _stack(
        matrix,
        [[phi, gamma, zeros(matrix, n, stored - m)], [zeros(matrix, stored, n), shift]],
    )
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


def majorant_matrix(loop: UncertainLoop, g: Group, entries: list[list[tuple[int, int, Any]]]) -> FloatArray:
    """Entrywise bounds of the closed loop's state matrix (of differences where discrete), from balls of the entries.

    Raises NotAnalytic when numbers overflow, or the direct feedthrough is too large.
    """
    law, x = loop.law, {state: k for k, state in enumerate(g.states)}
    m, p, n = loop.program.shapes[B][1], loop.program.shapes[C][0], len(x)

    def sizes(rows: int, columns: int, values: Any) -> FloatArray:
        found = np.zeros((rows, columns))
        for i, j, z in values:
            found[i, j] = float(abs(z).upper()) * (1 + 1e-9)
        return found

    a_balls = [(x[i], x[j], r) for i, j, r in entries[A] if i in x and j in x]
    b_balls = [(x[i], j, r) for i, j, r in entries[B] if i in x]
    if len(entries) > E:
        e = dense(acb_mat, n, n, ((x[i], x[j], r) for i, j, r in entries[E] if i in x and j in x))
        ab = solve(e, join_columns(acb_mat, dense(acb_mat, n, n, a_balls), dense(acb_mat, n, m, b_balls)))
        a_balls = [(i, j, ab[i, j]) for i in range(n) for j in range(n)]
        b_balls = [(i, j, ab[i, n + j]) for i in range(n) for j in range(m)]
    diagonal = np.zeros(n)
    for i, j, z in a_balls:
        if i == j:
            diagonal[i] = upper(z)
    a, b = sizes(n, n, a_balls), sizes(n, m, b_balls)
    c = sizes(p, n, ((i, x[j], r) for i, j, r in entries[C] if j in x))
    d = sizes(p, m, entries[D]) if loop.direct else None
    out, through = np.abs(law.C[:, list(g.own)]), np.abs(law.D)
    if not all(np.isfinite(part).all() for part in (a, b, c, d) if part is not None):
        raise NotAnalytic("numbers that overflow")
    if g.inputs is not None:
        picked = [x[i] for i in g.inputs]
        out, through, b = b[picked] @ out, b[picked] @ through, np.eye(n)[:, picked]
    a, b, c, d = driven_bounds(loop, (a, b, c, d), diagonal)
    if law.delay:
        n, r = len(a), b.shape[1]
        stored = r * law.delay
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
        b = V @ b
        if rate is not None:  # V bounds both parts of the held input, the state of the lag and the rest
            rate = float(-np.expm1(-rate * law.sample_time)) * (1 + 1e-12)
            b_late = np.vstack([b, rate * np.eye(r)])
    elif rate is not None:
        b_late = np.vstack([np.zeros_like(b), rate * np.eye(r)])
    elif law.sample_time is not None:
        a = a + np.eye(len(a))
    if rate is None:
        return a, b, c, d
    a = np.block([[a, b], [np.zeros((r, len(a))), rate * np.eye(r)]])
    return a, b_late, np.hstack([c, np.zeros((p, r)) if d is None else d]), None


# Upper bounds of the coefficients of det(g + A) from bounds of |A| alone.
#
# With column scales d and any rho > 0, |a_k| rho^k is at most the product of the row sums of (rho I + |A|) d / d_i.
# The scales are found for each rho by balancing, and each k takes the rho that suits it best: a determinant whose
# entries and roots spread over decades is bounded to a few bits for each row, where one scaling for all k loses
# dozens.


ROUNDS = 20
SAFE = 1 + 1e-9


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
    return arb(2.0 ** (x - whole) * SAFE) * arb(2) ** whole


def _heights(full: FloatArray) -> FloatArray:
    """log2 of the product of row sums of F d / d_i, d by Sinkhorn's iteration: rows x n x n -> rows."""
    d = np.ones(full.shape[:2])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(ROUNDS):
            rows = (full @ d[:, :, None])[:, :, 0]
            columns = ((1 / np.where(rows > 0, rows, 1))[:, None] @ full)[:, 0]
            d = 1 / np.where(columns > 0, columns, 1)
        d = np.exp2(np.round(np.log2(np.clip(d, 1e-200, 1e200))))
        rows = (full @ d[:, :, None])[:, :, 0]
        heights = np.log2(rows * SAFE).sum(axis=1) - np.log2(d).sum(axis=1)
    return np.where(np.isnan(heights), np.inf, heights)
