"""A loop in the coordinates in which its parameters act apart: x = S x', exactly, found from how the parameters enter.

    S_1 E S x'' = S_1 A S x' + S_1 B u,    y = C S x',      S_1 = (E_0 S)^-1,  E_0: E at the nominal values

Each product of parameters has a matrix of coefficients in [E A B], whose range is where it acts: a mass on the motions
of the centre of gravity, whatever the coordinates. The ranges, and what A makes of them, are the basis S. All numbers
are rationals, so that the loop is the same and only entries that cancel are gone.
"""

from __future__ import annotations

import math
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from flint import arb, fmpq, fmpq_mat
from scipy import linalg

from malta.proof.expressions import NotAnalytic, Program, exact
from malta.proof.groups import A, B, C, E, UncertainLoop
from malta.proof.polynomial.rational import Ratio, Symbolic

LARGEST = 16  # states
ROUNDING = 1e-11  # relative size of what rounding may leave of terms that cancel
APART = 1e-6  # singular value of independent vectors of size one, at least
FEWER = 0.8  # share of the terms from which on another basis is worth it


_KNOWN: WeakKeyDictionary[Program, Program | None] = WeakKeyDictionary()


def in_plain_basis(loop: UncertainLoop) -> UncertainLoop:
    """The loop in the basis in which its matrices have clearly fewer terms; the loop itself when none is found."""
    if loop.direct or not 1 < loop.states <= LARGEST:
        return loop
    s = loop.symbolic
    if s is None or s.atoms:
        return loop
    if loop.program not in _KNOWN:  # laws change, the system stays
        try:
            _KNOWN[loop.program] = _transformed(loop, s)
        except (ZeroDivisionError, NotAnalytic, np.linalg.LinAlgError):
            _KNOWN[loop.program] = None
    found = _KNOWN[loop.program]
    return loop if found is None else UncertainLoop(loop.system, loop.law, found)


def _transformed(loop: UncertainLoop, s: Symbolic) -> Program | None:
    n, E_0 = loop.states, _identity(loop.states)
    nominal = [exact(x) for x in loop.system.nominal.tolist()]
    if loop.descriptor:
        E_0 = _matrix(n, n, {at: _value(r, nominal) for at, r in s.entries[E].items()})
    S = _basis(loop, s, E_0.inv())
    if S is None:
        return None
    S_1 = (E_0 * S).inv()
    made = [_left(S_1, _right(s.entries[A], S)), _left(S_1, s.entries[B]), _right(s.entries[C], S)]
    if loop.descriptor:
        made += [{}, _left(S_1, _right(s.entries[E], S))]
    if _terms(made, nominal) > FEWER * _terms(s.entries, nominal):
        return None
    return _program(made, loop.program)


def _identity(n: int) -> Any:
    return fmpq_mat([[fmpq(int(i == j)) for j in range(n)] for i in range(n)])


def _matrix(rows: int, columns: int, entries: dict[tuple[int, int], Any]) -> Any:
    return fmpq_mat(
        rows, columns, [entries.get((i, j), fmpq(0)) for i in range(rows) for j in range(columns)]
    )


def _laurent(
    entries: dict[tuple[int, int], Ratio],
) -> dict[tuple[int, ...], dict[tuple[int, int], Any]] | None:
    """The coefficients of each product of powers of p; None where a sum stands below."""
    found: dict[tuple[int, ...], dict[tuple[int, int], Any]] = {}
    for at, r in entries.items():
        below, unit = (None, fmpq(1)) if r.den is None else next(iter(r.den.to_dict().items()))
        if r.den is not None and len(r.den) > 1:
            return None
        for powers, c in r.num.to_dict().items():
            own = tuple(int(e) for e in powers)
            if below is not None:
                own = tuple(e - int(d) for e, d in zip(own, below, strict=True))
            found.setdefault(own, {})[at] = c / unit
    return found


def _basis(loop: UncertainLoop, s: Symbolic, left: Any) -> Any:
    """The columns of S: the ranges, smallest first, and what A makes of them; None for sums below."""
    n, m = loop.states, loop.program.shapes[B][1]
    wide: dict[tuple[int, ...], list[Any]] = {}
    constant = None
    for which, columns in ((A, n), (B, m), *([(E, n)] if loop.descriptor else [])):
        parts = _laurent(s.entries[which])
        if parts is None:
            return None
        for powers, entries in parts.items():
            M = left * _matrix(n, columns, entries)
            if any(powers):
                wide.setdefault(powers, []).append(M)
            elif which == A:
                constant = M
    ranges = sorted((_range(parts, n) for parts in wide.values()), key=len)
    columns_of_S: list[list[Any]] = []
    for one in ranges:
        _extend(columns_of_S, one)
    for x in columns_of_S:  # grows while it is walked
        if constant is not None:
            _extend(columns_of_S, [(constant * fmpq_mat(n, 1, x)).entries()])
    _extend(columns_of_S, _identity(n).tolist())
    return fmpq_mat(columns_of_S).transpose()


def _range(parts: list[Any], n: int) -> list[list[Any]]:
    """A basis of what the columns of matrices span, in echelon form, without directions of the size of rounding."""
    columns = [[M[i, j] for i in range(n)] for M in parts for j in range(M.ncols())]
    sizes = [max(abs(c) for c in x) for x in columns]
    top = max(sizes)
    values = np.array([[float(arb(c / top)) for c in x] for x in columns])
    _, s, V = np.linalg.svd(values)
    rank = int((s > ROUNDING * s[0]).sum())
    reduced, exact_rank = fmpq_mat(columns).rref()
    if rank == int(exact_rank):
        return [list(row) for row in reduced.tolist()[:rank]]
    _, _, pivots = linalg.qr(V[:rank], pivoting=True)
    echelon = np.linalg.solve(V[:rank][:, np.sort(pivots[:rank])], V[:rank])
    echelon[np.abs(echelon) < ROUNDING] = 0
    return [[exact(x) for x in row] for row in echelon.tolist()]


def _extend(vectors: list[list[Any]], more: list[list[Any]]) -> None:
    """Append those of `more` that the vectors do not span, of size one."""
    for x in more:
        size = max(abs(c) for c in x)
        if not size:
            continue
        unit = [c / size for c in x]
        values = np.array([[float(arb(c)) for c in y] for y in (*vectors, unit)])
        if np.linalg.svd(values, compute_uv=False)[-1] > APART and len(values) <= values.shape[1]:
            vectors.append(unit)


def _value(r: Ratio, p: list[Any]) -> Any:
    return r.num(*p) / (1 if r.den is None else r.den(*p))


def _left(M: Any, entries: dict[tuple[int, int], Ratio]) -> dict[tuple[int, int], Ratio]:
    """M times a matrix."""
    found: dict[tuple[int, int], Ratio] = {}
    for (k, j), r in entries.items():
        for i in range(M.nrows()):
            if M[i, k] != 0:
                _add(found, (i, j), r, M[i, k])
    return {at: r for at, r in found.items() if not r.is_zero()}


def _right(entries: dict[tuple[int, int], Ratio], M: Any) -> dict[tuple[int, int], Ratio]:
    """A matrix times M."""
    turned = _left(M.transpose(), {(j, i): r for (i, j), r in entries.items()})
    return {(j, i): r for (i, j), r in turned.items()}


def _add(found: dict[tuple[int, int], Ratio], at: tuple[int, int], r: Ratio, factor: Any) -> None:
    part = Ratio(r.num * factor, r.den)
    found[at] = found[at] + part if at in found else part


def _terms(matrices: Any, p: list[Any]) -> int:
    """The number of terms above rounding: of the largest of their row at the nominal values."""
    count = 0
    for entries in matrices:
        sizes: dict[int, list[float]] = {}
        for (i, _), r in entries.items():
            below = 1 if r.den is None else r.den(*p)
            terms = [c * math.prod(x**int(e) for x, e in zip(p, powers, strict=True)) / below
                     for powers, c in r.num.to_dict().items()]  # fmt: skip
            sizes.setdefault(i, []).extend(abs(float(arb(x))) for x in terms)
            sizes[i] += [math.inf] * (0 if r.den is None else len(r.den))
        for row in sizes.values():
            top = max((x for x in row if math.isfinite(x)), default=0.0)
            count += sum(x > ROUNDING * top for x in row)
    return count


def _program(matrices: list[dict[tuple[int, int], Ratio]], old: Program) -> Program:
    """The instructions of matrices of rational functions."""
    steps: list[tuple[str, int, tuple[int, ...], Any]] = [("input", i, (), 0.0) for i in range(old.inputs)]

    def step(name: str, *on: int, value: Any = 0.0) -> int:
        steps.append((name, 0, on, value))
        return len(steps) - 1

    def polynomial(f: Any) -> int:
        total = None
        for powers, c in f.to_dict().items():
            term = step("const", value=c)
            for i, e in enumerate(powers):
                if e:
                    power = i if e == 1 else step("constpow", i, value=float(e))
                    term = step("mul", term, power)
            total = term if total is None else step("add", total, term)
        assert total is not None
        return total

    entries = []
    for matrix in matrices:
        made = []
        for (i, j), r in sorted(matrix.items(), key=lambda pair: pair[0]):
            top = polynomial(r.num)
            made.append((i, j, top if r.den is None else step("div", top, polynomial(r.den))))
        entries.append(tuple(made))
    return Program(tuple(steps), tuple(entries), old.shapes, old.inputs)
