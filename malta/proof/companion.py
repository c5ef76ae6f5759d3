"""A polynomial with coefficients in p as a loop in which every parameter enters linearly, for multipliers.

    x_k' = x_(k+1),  x_n' = d,    sum_m p^m c_m (x, d) = 0

The last equation is a sum over monomials. With p^m = p_i p^m' each monomial is p_i times a shorter one, so that sums
over monomials with equal beginnings are signals z: z = c (x, d) + sum_i p_i z_i. d and z are outputs that are fed back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from malta.proof.expressions import Program
from malta.proof.groups import UncertainLoop
from malta.proof.uncertain import Compensator, UncertainSystem

MOST = 30  # signals z beyond which families are cheaper

Monomial = tuple[int, ...]  # the parameters that are multiplied, in order


def companion(
    names: tuple[str, ...], a: Sequence[Mapping[Any, Any]], T: float | None
) -> UncertainLoop | None:
    """The loop of a polynomial; None where it takes more than MOST signals.

    a : for each power, the lowest first, the terms of its coefficient: rational numbers by exponents of p
    T : sample time of a polynomial in z; None: in s
    """
    rows = _rows(len(names), a)
    if len(rows) > MOST + 1:
        return None
    n, made = len(a) - 1, _Steps(len(names))
    place = {monomial: k for k, monomial in enumerate(rows)}  # d first
    C: dict[tuple[int, int], Any] = {}
    D: dict[tuple[int, int], Any] = {(0, 0): {(): 1}}
    for monomial, own in rows.items():
        k, sign = place[monomial], 1 if monomial else -1  # d = d - sum
        for i, x in own.items():
            if isinstance(i, tuple):
                D.setdefault((k, place[i]), {})[i[-1:]] = sign
                continue
            for power, c in x.items():
                at, table = ((k, power), C) if power < n else ((k, 0), D)
                terms = table.setdefault(at, {})
                terms[() if i < 0 else (i,)] = terms.get(() if i < 0 else (i,), 0) + sign * c
    one, m = made.constant(1), len(rows)
    entries: Any = (
        tuple((k, k + 1, one) for k in range(n - 1)),
        ((n - 1, 0, one),),
        tuple((*at, made.sum(terms)) for at, terms in C.items()),
        tuple((*at, made.sum(terms)) for at, terms in D.items()),
    )
    shapes = ((n, n), (n, m), (m, n), (m, m))
    none = np.zeros((0, 0))
    law = Compensator(none, np.zeros((0, m)), np.zeros((m, 0)), np.eye(m), sample_time=T)
    system = UncertainSystem(names, np.zeros(len(names)), None, sample_time=T)
    return UncertainLoop(system, law, Program(tuple(made.steps), entries, shapes, len(names)))


def _rows(count: int, a: Sequence[Mapping[Any, Any]]) -> dict[Monomial, dict[Any, Any]]:
    """Of each signal, by its beginning: what is without (-1) and with (i) one more parameter; or the next signal."""
    terms: dict[Monomial, dict[int, Any]] = {}
    for power, coefficient in enumerate(a):
        for exponents, c in coefficient.items():
            monomial = tuple(i for i in range(count) for _ in range(int(exponents[i])))
            terms.setdefault(monomial, {})[power] = c
    inner = {m[:k] for m in terms for k in range(len(m))} | {()}
    rows: dict[Monomial, dict[Any, Any]] = {m: {} for m in sorted(inner, key=lambda m: (len(m), m))}
    for m, c in terms.items():
        if m in rows:
            rows[m][-1] = c
        else:
            rows[m[:-1]][m[-1]] = c
    for m in rows:
        if m:
            rows[m[:-1]][m] = None
    return rows


class _Steps:
    """The steps of a program of entries that are linear in p."""

    def __init__(self, count: int) -> None:
        self.steps: list[tuple[str, int, tuple[int, ...], float]] = [
            ("input", i, (), 0.0) for i in range(count)
        ]

    def _add(self, name: str, *operands: int, value: float = 0.0) -> int:
        self.steps.append((name, 0, operands, value))
        return len(self.steps) - 1

    def constant(self, c: Any) -> int:
        """A rational number as the sum of two doubles, to 1e-31 of it: pencils allow for 1e-15."""
        high = _double(c)
        low = _double(c - _exact(high, c))
        one = self._add("const", value=high)
        return self._add("add", one, self._add("const", value=low)) if low else one

    def sum(self, terms: Mapping[Monomial, Any]) -> int:
        """The sum of constants times 1 or a parameter."""
        total: int | None = None
        for monomial, c in terms.items():
            term = self.constant(c)
            term = self._add("mul", monomial[0], term) if monomial else term
            total = term if total is None else self._add("add", total, term)
        assert total is not None
        return total


def _double(c: Any) -> float:
    return float(c) if isinstance(c, int) else int(c.p) / int(c.q)


def _exact(x: float, like: Any) -> Any:
    """x as a number of the same kind."""
    return int(x) if isinstance(like, int) else type(like)(*x.as_integer_ratio())
