"""The check of a proof by multipliers, in balls, from what the proof keeps: pencils, cells, and D and G of each.

For every cell, an interval of frequency and a part of the box, with the channels M = L + B Delta C + R of its pencil,

1. L + R is regular on the interval, for every R within its bounds: a Taylor series of (L + R)^-1 about the middle,
2. D > 0 and D - N* D N - j (G N - N* G) > 0 for N = -C (L + R)^-1 B at every frequency of the interval,

so that 1 - N Delta, and with it M, is regular. The cells tile all frequencies x the box. Nothing is shared with the
floating-point formulas that found the multipliers but the pencils and how their slopes are factored.
"""

from __future__ import annotations

import time as clock
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import acb, acb_mat, arb, arb_mat, fmpq

from malta.checker.check import tiles_box
from malta.linear.expressions import exact
from malta.proof.multipliers import FACTOR_TOLERANCE, MAX_ROUNDED_REST, Branch
from malta.proof.polynomial.enclosure import precision

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.proof.multipliers.pencil import Pencil
    from malta.proof.multipliers.structured import MultiplierCell, MultiplierProof, Shown

BITS = 128
TERMS = 4  # of Taylor series along frequency
MIN_INTERVAL_SHARE = 2.0**-9  # part of an interval of frequency


def refusal(proof: MultiplierProof, until: float = np.inf) -> str:
    """Why a proof by multipliers does not hold, in words; empty when all of it was confirmed until a time."""
    before: FloatArray | None = None
    with precision(BITS):
        for layer in proof.layers:
            sides = proof.box.sides(layer.t)
            for k, rows in enumerate(proof.rows):
                own = [shown for shown in layer.cells if shown.cell.rows == k]
                if why := _gap(own, sides):
                    return f"t = {layer.t:.6g}, group {k + 1}: {why}"
                for cell, multiplier in own:
                    if clock.monotonic() > until:
                        return "time was up"
                    if before is not None and multiplier is None and _within(cell.sides, before):
                        continue
                    pencil = rows.over(cell.sides)
                    if pencil is None or not _is_regular(pencil, cell, multiplier):
                        return (
                            f"t = {layer.t:.6g}, group {k + 1}: a cell from {cell.low:.6g} to {cell.high:.6g}"
                        )
            before = sides
    return ""


def _within(sides: FloatArray, outer: FloatArray) -> bool:
    return bool((sides[:, 0] >= outer[:, 0]).all() and (sides[:, 1] <= outer[:, 1]).all())


def _gap(shown: list[Shown], sides: FloatArray) -> str:
    """Where cells leave out a frequency or a part of the box; empty: nowhere."""
    cells = [shown.cell for shown in shown]
    ends = [max((exact(c.high) for c in cells if c.branch == b), default=fmpq(0)) for b in (0, 1)]
    if ends[0] * ends[1] < 1:  # x up to the one, 1 / x up to the other
        return "frequencies are missing"
    box = [(exact(a), exact(b)) for a, b in sides.tolist()]
    for branch in (0, 1):
        tiles = [
            ((exact(c.low), exact(c.high)), *((exact(a), exact(b)) for a, b in c.sides.tolist()))
            for c in cells
            if c.branch == branch
        ]
        if not tiles_box(tiles, [(fmpq(0), ends[branch]), *box]):
            return "the cells leave a gap"
    return ""


def _is_regular(pencil: Pencil, cell: MultiplierCell, multiplier: Any) -> bool:
    """Whether the pencil is regular on a cell, or on parts of its interval one by one."""
    branch = Branch(pencil, cell.branch, cell.top)
    todo = [(exact(cell.low), exact(cell.high))]
    while todo:
        low, high = todo.pop()
        try:
            if _is_positive_on(branch, low, high, multiplier):
                continue
        except ZeroDivisionError:  # a matrix of balls that may be singular
            pass
        middle = (low + high) / 2
        if high - low <= exact(MIN_INTERVAL_SHARE) * (exact(cell.high) - exact(cell.low)):
            return False
        todo += [(low, middle), (middle, high)]
    return True


def _is_positive_on(branch: Branch, low: Any, high: Any, multiplier: Any) -> bool:
    series = _response(branch, low, high)
    if series is None:
        return False
    terms, rest = series
    n = rest.nrows()
    if not n:
        return True
    if multiplier is None or multiplier.blocks != branch.channels[0].blocks:
        return False
    x0, h = (low + high) / 2, (high - low) / 2
    D, G = _pair(multiplier.D, multiplier.G, multiplier.blocks)
    if multiplier.slopes is None:
        dD = dG = acb_mat(n, n)
    else:
        away = x0 - exact(multiplier.x)
        dD, dG = _pair(multiplier.slopes[0], multiplier.slopes[1], multiplier.blocks)
        D, G = D + dD * acb(arb(away)), G + dG * acb(arb(away))
        dD, dG = dD * acb(arb(h)), dG * acb(arb(h))
    turn = acb(0, 1)
    F = [acb_mat(n, n) for _ in range(2 * len(terms) + 1)]
    F[0], F[1] = F[0] + D, F[1] + dD
    for a, M in enumerate((D, dD)):
        for i, one in enumerate(terms):
            for j, two in enumerate(terms):
                F[a + i + j] -= one.conjugate().transpose() * M * two
    for a, M in enumerate((G, dG)):
        for i, one in enumerate(terms):
            F[a + i] -= (M * one - one.conjugate().transpose() * M) * turn
    size = sum((_sizes(N) for N in terms), arb_mat(n, n))
    d, g = _sizes(D) + _sizes(dD), _sizes(G) + _sizes(dG)
    left = (size + rest).transpose() * d * rest + g * rest
    F[0] = _widen(F[0], left + left.transpose())
    return _is_positive(D + dD) and _is_positive(D - dD) and _is_positive_series(F)


def _response(branch: Branch, low: Any, high: Any) -> tuple[list[Any], Any] | None:
    """N = N_0 + t N_1 + ... + rest on an interval x_0 + h t, |t| <= 1; None where the series may not converge."""
    one, two = branch.parts
    n, x0, h = len(one.middle), acb(arb((low + high) / 2)), acb(arb((high - low) / 2))
    channels = branch.channels[0]
    (B0, B1), (C0, C1) = ([_complex(M) for M in pair] for pair in (channels.B, channels.C))
    turn = acb(0, 1)
    rest = _bound_remainder(branch, arb(high))
    if rest is None:
        return None
    L = _widen(_complex(one.middle) + _complex(two.middle) * (turn * x0), rest)
    columns = len(channels.B[0].T)
    wide = acb_mat(
        n, n + 2 * columns,
        _row_by_row(_complex(two.middle) * (turn * h), B0 + B1 * (turn * x0), B1 * (turn * h)),
    )  # fmt: skip
    found = L.solve(wide)
    S, g0, g1 = (_part(found, a, b) for a, b in ((0, n), (n, n + columns), (n + columns, n + 2 * columns)))
    K = _sizes(S)
    w = (_eye(n) - K).solve(arb_mat(n, 1, [1] * n))
    if not all(x > 0 and y < x for x, y in zip(w.entries(), (K * w).entries(), strict=True)):
        return None  # |S| may have an eigenvalue of one or more
    if not columns:
        return [], arb_mat(0, 0)
    g = [g0, g1 - S * g0]
    while len(g) <= TERMS:
        g.append(-(S * g[-1]))
    beyond = _upper((_eye(n) - K).solve(K * _sizes(g[-1])))
    C, moved = C0 + C1 * (turn * x0), C1 * (turn * h)
    terms = [-(C * x) - (moved * g[k - 1] if k else acb_mat(columns, columns)) for k, x in enumerate(g)]
    return terms, _sizes(C) * beyond + _sizes(moved) * (beyond + _sizes(g[-1]))


def _bound_remainder(branch: Branch, high: Any) -> Any:
    """Entrywise bounds of R; None where its larger entries are more than the complex block at the end covers."""
    one, two = branch.parts
    channels, n = branch.channels[0], len(one.middle)
    total = _real(one.rest) + _real(two.rest) * high
    for i, (a, b) in enumerate(zip(one.slopes, two.slopes, strict=True)):
        own = np.flatnonzero(channels.owners == i).tolist()
        b0, b1 = (_real(M[:, own]) for M in channels.B)
        c0, c1 = (_real(M[own]) for M in channels.C)
        for k, part in enumerate((_real(a) - b0 * c0, _real(b) - b0 * c1 - b1 * c0, b1 * c1)):
            total += _sizes(part) * high**k
    other = np.flatnonzero(channels.owners == -1).tolist()
    table = [[total[i, j] for j in range(n)] for i in range(n)]
    if other:
        u, v = np.abs(channels.B[0][:, other]).sum(axis=1), np.abs(channels.C[0][other]).sum(axis=0)
        rows, columns = [arb(0)] * n, [arb(0)] * n
        least = MAX_ROUNDED_REST if branch.pencil.curved else FACTOR_TOLERANCE
        for i in range(n):
            for j in range(n):
                if u[i] and v[j] and not table[i][j] < least:
                    rows[i], columns[j] = rows[i] + table[i][j], columns[j] + table[i][j]
                    table[i][j] = arb(0)
        # |R_ij| / (u_i v_j) has a largest singular value of one at most (Schur's test)
        fits = all(x <= arb(float(y)) ** 2 for x, y in zip([*rows, *columns], [*u, *v], strict=True))
        if not fits:
            return None
    return arb_mat(table)


def _is_positive_series(F: list[Any]) -> bool:
    """Whether sum F_k t^k > 0 for all |t| <= 1, on parts of that interval."""
    todo = [(fmpq(-1), fmpq(1))]
    while todo:
        a, b = todo.pop()
        t, total = acb(arb((a + b) / 2, (b - a) / 2)), F[-1]
        for M in reversed(F[:-1]):
            total = total * t + M
        if _is_positive(total):
            continue
        if b - a < fmpq(1, 256):
            return False
        todo += [(a, (a + b) / 2), ((a + b) / 2, b)]
    return True


def _is_positive(F: Any) -> bool:
    """Whether all Hermitian matrices within balls are positive: X* F X has a heavy diagonal, X of Cholesky."""
    n = F.nrows()
    middle: ComplexArray = np.array([[complex(F[i, j].mid()) for j in range(n)] for i in range(n)])
    try:
        X = np.linalg.inv(np.linalg.cholesky((middle + middle.conj().T) / 2)).conj().T
    except np.linalg.LinAlgError:
        return False
    if not np.isfinite(X).all():
        return False
    X = _complex(X)
    Z = X.conjugate().transpose() * F * X
    sizes = _sizes(Z)
    return all(Z[i, i].real > sum((sizes[i, j] for j in range(n) if j != i), arb(0)) for i in range(n))


def _pair(D: ComplexArray, G: ComplexArray, blocks: Any) -> tuple[Any, Any]:
    return _structure(D, blocks, beside=True), _structure(G, blocks, beside=False)


def _structure(M: ComplexArray, blocks: Any, *, beside: bool) -> Any:
    """The Hermitian part of M within its real blocks; `beside`, as D has, one multiple of the identity."""
    kept, at = np.zeros_like(M), 0
    for r in blocks.real:
        own = slice(at, at + r)
        kept[own, own] = M[own, own]
        at += r
    found = _complex(kept)
    found = (found + found.conjugate().transpose()) * acb(0.5)
    for k in range(at, len(M)):
        found[k, k] = acb(float(M[at, at].real) if beside else 0.0)
    return found


def _complex(M: Any) -> Any:
    return acb_mat(len(M), M.shape[1], [acb(complex(x).real, complex(x).imag) for x in M.ravel().tolist()])


def _real(M: FloatArray) -> Any:
    return arb_mat(len(M), M.shape[1], M.ravel().tolist())


def _eye(n: int) -> Any:
    return arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])


def _row_by_row(*parts: Any) -> list[Any]:
    return [M[i, j] for i in range(parts[0].nrows()) for M in parts for j in range(M.ncols())]


def _part(M: Any, a: int, b: int) -> Any:
    return acb_mat(M.nrows(), b - a, [M[i, j] for i in range(M.nrows()) for j in range(a, b)])


def _sizes(M: Any) -> Any:
    """Entrywise upper bounds of moduli."""
    return arb_mat(M.nrows(), M.ncols(), [arb(abs(x).upper()) for x in M.entries()])


def _upper(M: Any) -> Any:
    return arb_mat(M.nrows(), M.ncols(), [arb(x.upper()) for x in M.entries()])


def _widen(M: Any, by: Any) -> Any:
    """Balls about those of M with radii `by` more."""
    radii = [acb(arb(0, r.upper()), arb(0, r.upper())) for r in by.entries()]
    return M + acb_mat(M.nrows(), M.ncols(), radii)
