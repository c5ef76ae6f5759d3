"""The problems of a margin, a loop or a polynomial with coefficients in p: both have characteristic polynomials."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from flint import acb, arb, arb_mat, fmpq

from malta.linear.balls import BALLS, POINTS
from malta.linear.closed_loops import (
    closed_loop as closed_matrices,
    critical_frequency,
    instability,
    worst_frequency,
)
from malta.linear.expressions import EXACT_ARITHMETIC, MatrixProgram, NotAnalytic, exact
from malta.linear.rational import Symbolic, TooLarge, over_common_denominator, symbolic
from malta.linear.uncertain import Compensator, StateGroup, UncertainSystem
from malta.proof.groups import UncertainLoop, groups
from malta.proof.polynomial.characteristic import Characteristic, map_bilinear, map_bounds, pair
from malta.proof.polynomial.closed_loop import Couplings, closed_loop, driven_group, loop_parts
from malta.proof.polynomial.enclosure import Polynomial, precision
from malta.proof.polynomial.family import binary
from malta.work import WorkUp

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.proof.box import Box
    from malta.proof.exclusion import BoxPart


# A polynomial with coefficients in p as a loop in which every parameter enters linearly, for multipliers.
#
#     x_k' = x_(k+1),  x_n' = d,    sum_m p^m c_m (x, d) = 0
#
# The last equation is a sum over monomials. With p^m = p_i p^m' each monomial is p_i times a shorter one, so that
# sums over monomials with equal beginnings are signals z: z = c (x, d) + sum_i p_i z_i. d and z are outputs that are
# fed back.


MAX_SIGNALS = 30  # signals z beyond which families are cheaper

Monomial = tuple[int, ...]  # the parameters that are multiplied, in order


def companion(
    names: tuple[str, ...], a: Sequence[Mapping[Any, Any]], T: float | None
) -> UncertainLoop | None:
    """The loop of a polynomial; None where it takes more than MAX_SIGNALS signals.

    a : for each power, the lowest first, the terms of its coefficient: rational numbers by exponents of p
    T : sample time of a polynomial in z; None: in s
    """
    rows = _rows(len(names), a)
    if len(rows) > MAX_SIGNALS + 1:
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
    return UncertainLoop(system, law, MatrixProgram(tuple(made.steps), entries, shapes, len(names)))


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


POLES = 6e-7  # work of poles in doubles, times the square of the states
ROW = 6e-4  # work of a row in balls
EXACT_STEP = 1e-6  # work of an operation in exact numbers
STEP, STATES_WORK = 4e-6, 1e-6  # work of an operation of the model in balls, and times the cube of the states
MAX_QUICK_OPERATIONS = 300  # operations of matrices whose exact expressions take no time
MAX_SEEN = 64  # arrays of rows whose worst poles are remembered
MAX_WHOLE_ROWS = 2  # of parameters: the poles of the whole loop take less time than those of its groups


@dataclass(frozen=True, eq=False)
class Traits:
    """What the search of a margin takes into account of a problem.

    approximate : why its matrices are no exact functions of p, so that nothing is proven of them; "" where they are
    is_cheap : whether cells of its polynomials take little time
    is_held : whether families take long, as those of loops under a hold
    poles : work of the poles at one row of parameters
    enclose : the families over box(t) where couplings between groups are bounded, and no part of their polynomials
    """

    approximate: str = ""
    is_cheap: bool = False
    is_held: bool = False
    poles: float = 1e-4
    enclose: Callable[[Box, float], list[BoxPart]] | None = None

    @property
    def is_bounded(self) -> bool:
        """Whether the polynomials are those of uncoupled groups."""
        return self.enclose is not None


class Problem(Protocol):
    """The interface of a problem that has a margin: all that a search asks."""

    @property
    def traits(self) -> Traits: ...

    @property
    def loops(self) -> tuple[UncertainLoop | None, ...]:
        """The loops whose pencils multipliers take; None for one that has no pencil."""

    def parts(
        self, p: Sequence[Any], *, neglect: bool = True
    ) -> Sequence[tuple[Polynomial, tuple[Any, ...]]]:
        """The characteristic polynomials over real balls p, each with bounds of the effect of neglected couplings.

        neglect : whether couplings of the size of rounding are taken as zero and bounded
        """

    def instability(self, rows: FloatArray) -> FloatArray:
        """The distance of the worst root beyond the boundary at rows of parameters, in floating point."""

    def critical_frequency(self, p: FloatArray) -> float:
        """The frequency of the worst root at parameters p, rad/s."""

    def physical(self, x: float) -> float:
        """s / j of the polynomials -> rad/s."""


@dataclass(frozen=True, eq=False)
class OfLoop:
    """A closed loop."""

    loop: UncertainLoop
    known: dict[Any, Characteristic] = field(default_factory=dict)
    seen: dict[bytes, FloatArray] = field(default_factory=dict)  # worst poles: several margins begin alike

    @property
    def traits(self) -> Traits:
        size = self.loop.states + len(self.loop.law.A)
        dear = ROW + STEP * len(self.loop.program.steps) + STATES_WORK * size**3
        poles = POLES * size**2 if self._plain else dear
        return Traits(self.loop.system.approximate, is_held=self.loop.sampled, poles=poles)

    @property
    def loops(self) -> tuple[UncertainLoop | None, ...]:
        return (self.loop,)

    @cached_property
    def couplings(self) -> Couplings | None:
        return None if self.loop.symbolic is None else Couplings(self.loop, self.loop.symbolic)

    def parts(
        self, p: Sequence[Any], *, neglect: bool = True
    ) -> list[tuple[Characteristic, tuple[Any, ...]]]:
        found = []
        for part in loop_parts(self.loop, self.couplings if neglect else None, p):
            key = (part.group.states, part.group.own)
            if key not in self.known:
                self.known[key] = Characteristic(self.loop, part.group)
            found.append((self.known[key], part.moves))
        return found

    @cached_property
    def _groups(self) -> Sequence[StateGroup]:
        """The states that close loops by themselves, where these are found at once; else none."""
        if len(self.loop.program.steps) > MAX_QUICK_OPERATIONS:
            return ()
        with suppress(WorkUp):
            return groups(self.loop)
        return ()

    @property
    def _plain(self) -> bool:
        """Whether the loop is A, B, C alone, in continuous time or sampled."""
        return not (self.loop.direct or self.loop.descriptor or self.loop.system.sample_time)

    def _poles(self, p: FloatArray) -> Any:
        """The poles of x' = A x, or of differences x+ - x; empty when the matrices have no value."""
        n, k = self.loop.states, len(self.loop.law.A)
        whole = StateGroup(tuple(range(n)), tuple(range(k)), None)
        try:
            entries = self.loop.program.run([arb(x) for x in p.tolist()], POINTS)
            matrix, _ = closed_loop(driven_group(self.loop, whole, entries, arb_mat))
        except NotAnalytic:
            return np.zeros(0)
        found = np.array(
            [[float(matrix[i, j].mid()) for j in range(matrix.ncols())] for i in range(matrix.nrows())]
        )
        return np.linalg.eigvals(found) if np.isfinite(found).all() else np.zeros(0)

    def instability(self, rows: FloatArray) -> FloatArray:
        key = rows.tobytes()
        if key not in self.seen:
            if len(self.seen) >= MAX_SEEN:
                self.seen.clear()
            self.seen[key] = self._instability(rows)
        return self.seen[key]

    def _instability(self, rows: FloatArray) -> FloatArray:
        if self._plain:
            with suppress(np.linalg.LinAlgError):  # numbers that overflow at some row: each by itself
                several = len(np.atleast_2d(rows)) > MAX_WHOLE_ROWS and len(self._groups) > 1
                return instability(self.loop.system, self.loop.law, rows, self._groups if several else ())
        worst = []
        for p in np.atleast_2d(rows):
            poles = self._poles(p)
            sizes = poles.real if self.loop.law.sample_time is None else 2 * poles.real + np.abs(poles) ** 2
            worst.append(float(sizes.max(initial=-math.inf)))
        return np.array(worst)

    def poles(self, p: FloatArray) -> Any:
        """The closed loop's poles in s; of sampled loops ln z / T."""
        T = self.loop.law.sample_time
        if self._plain:
            (found,) = np.linalg.eigvals(closed_matrices(self.loop.system, self.loop.law, p))
            found = found if T is None else T * found
        else:
            found = self._poles(p)
        if T is None:
            return found
        with np.errstate(divide="ignore"):
            return np.log(1 + found.astype(complex)) / T

    def critical_frequency(self, p: FloatArray) -> float:
        if self._plain:
            return critical_frequency(self.loop.system, self.loop.law, p)
        return worst_frequency(self._poles(p), self.loop.law.sample_time)

    def physical(self, x: float) -> float:
        return physical(x, self.loop.law.sample_time)


@dataclass(frozen=True, eq=False)
class OfSeveral:
    """Several loops in the same parameters, with equal sample times, which must all be stable."""

    problems: tuple[Problem, ...]

    @property
    def traits(self) -> Traits:
        each = [problem.traits for problem in self.problems]
        why = next((traits.approximate for traits in each if traits.approximate), "")
        return Traits(why, poles=sum(traits.poles for traits in each))

    @property
    def loops(self) -> tuple[UncertainLoop | None, ...]:
        return tuple(loop for problem in self.problems for loop in problem.loops)

    def parts(self, p: Sequence[Any], *, neglect: bool = True) -> list[tuple[Polynomial, tuple[Any, ...]]]:
        return [part for problem in self.problems for part in problem.parts(p, neglect=neglect)]

    def instability(self, rows: FloatArray) -> FloatArray:
        return np.asarray(np.max([problem.instability(rows) for problem in self.problems], axis=0))

    def critical_frequency(self, p: FloatArray) -> float:
        rows = p[None]
        return max(self.problems, key=lambda problem: float(problem.instability(rows)[0])).critical_frequency(
            p
        )

    def physical(self, x: float) -> float:
        return self.problems[0].physical(x)


def physical(x: float, T: float | None) -> float:
    """v = j x -> rad/s."""
    return x if T is None else 2 * math.atan(x) / T


@dataclass(frozen=True, eq=False)
class CoefficientPolynomial:
    """A problem whose polynomial in s (or z) has coefficients, lowest first, that are a program of p."""

    program: MatrixProgram
    names: tuple[str, ...]
    discrete: bool

    @cached_property
    def _symbolic(self) -> Symbolic | None:
        try:
            return symbolic(self.program)
        except (TooLarge, NotAnalytic):
            return None

    @property
    def count(self) -> int:
        return self.program.shapes[0][0]

    @cached_property
    def exact(self) -> bool:
        return self.program.rational and self._symbolic is not None

    @property
    def foreign(self) -> tuple[str, ...]:
        return self.program.foreign

    @property
    def implicit(self) -> bool:
        return self.program.implicit

    @property
    def price(self) -> float:
        return EXACT_STEP * len(self.program.steps)

    @property
    def inverted(self) -> tuple[bool, ...]:
        return (False,) * len(self.names)

    @cached_property
    def _scaled(self) -> tuple[dict[int, Any], Any]:
        """The coefficients as polynomials of p over their common denominator, and this; None for one."""
        assert self._symbolic is not None
        return over_common_denominator({i: r for (i, _), r in self._symbolic.entries[0].items()})

    @cached_property
    def degrees(self) -> tuple[int | None, ...]:
        s = self._symbolic
        if not self.exact or s is None:
            used = self.program.depends[0]
            return tuple(None if i in used else 0 for i in range(len(self.names)))
        found = np.zeros(len(self.names), dtype=int)
        scaled, common = self._scaled
        for polynomial in (*scaled.values(), *([] if common is None else [common])):
            found = np.maximum(found, polynomial.degrees()[: len(self.names)])
        return tuple(int(d) for d in found)

    @cached_property
    def loops(self) -> tuple[UncertainLoop | None]:
        """A loop with this polynomial, linear in p; None where there is no short one."""
        if not self.exact:
            return (None,)
        scaled, _ = self._scaled
        a = [scaled[i].to_dict() if i in scaled else {} for i in range(self.count)]
        return (companion(self.names, a, 1.0 if self.discrete else None),)

    def values(self, v: Sequence[Any]) -> list[Any]:
        """The coefficients as they are given."""
        rational = self.program.rational
        (entries,) = self.program.run(
            v if rational else [arb(x) for x in v], EXACT_ARITHMETIC if rational else POINTS
        )
        a: list[Any] = [fmpq(0) if rational else arb(0)] * self.count
        for i, _, x in entries:
            a[i] = x
        return a

    def at(self, v: Sequence[Any]) -> list[Any]:
        common = self._scaled[1] if self.exact else None
        scale = 1 if common is None else common(*v)
        a = [x * scale for x in self.values(v)]
        return map_bilinear(_about_one(a)) if self.discrete else a

    def majorant(self, v: Sequence[Any]) -> list[tuple[float, int]]:
        (entries,) = self.program.run([acb(x) for x in v], BALLS)
        a = [arb(0)] * self.count
        for i, _, x in entries:
            a[i] = abs(x)
        if self.discrete:  # z = 1 + g
            a = map_bounds(_about_one(a))
        return [pair(x) for x in a]

    def coupling_bounds(
        self, moves: Sequence[Any], sides: Sequence[tuple[Any, Any]]
    ) -> list[tuple[float, int]] | None:
        del moves, sides
        return None

    @property
    def traits(self) -> Traits:
        return Traits(is_cheap=True)

    def parts(
        self, p: Sequence[Any], *, neglect: bool = True
    ) -> list[tuple[CoefficientPolynomial, tuple[Any, ...]]]:
        del p, neglect
        return [(self, ())]

    def _roots(self, p: FloatArray) -> Any:
        """The roots, computed on a scale that the coefficients determine."""
        a = [binary(x) for x in self.values([exact(x) for x in p.tolist()])]
        logs = {k: math.log2(abs(m)) + e for k, (m, _, e) in enumerate(a) if m}
        if not logs:  # zero, whatever s
            return np.ones(1)
        first, last = min(logs), max(logs)
        step = round((logs[first] - logs[last]) / max(last - first, 1))
        step = max(min(step, 1000), -1000)  # that roots are numbers
        top = max(log + k * step for k, log in logs.items())
        scaled = [
            math.copysign(2.0 ** (logs[k] + k * step - top), a[k][0]) if k in logs else 0.0
            for k in range(last + 1)
        ]
        return np.roots(scaled[::-1]) * 2.0**step

    def instability(self, rows: FloatArray) -> FloatArray:
        found = []
        for row in np.atleast_2d(rows):
            roots = self._roots(row)
            sizes = np.abs(roots) - 1 if self.discrete else roots.real
            found.append(float(sizes.max(initial=-math.inf)))
        return np.array(found)

    def critical_frequency(self, p: FloatArray) -> float:
        roots = self._roots(p)
        if self.discrete:
            return float(abs(np.angle(roots[np.abs(roots).argmax()])))
        return float(abs(roots[roots.real.argmax()].imag))

    def physical(self, x: float) -> float:
        return physical(x, 1.0 if self.discrete else None)


def _about_one(a: list[Any]) -> list[Any]:
    """The coefficients of g = z - 1 from those of z."""
    return [sum((c * math.comb(k, j) for k, c in enumerate(a) if k >= j), 0 * a[0]) for j in range(len(a))]


MOST_BITS = 5120  # of the ball arithmetic in which Routh's scheme is tried


def is_nominal_stable(problem: Problem, box: Box) -> bool:
    """Whether the nominal loop is proven stable, by Routh's scheme in exact numbers or balls.

    No coupling is neglected: over a box that is proven, other couplings may be than at the nominal values.
    """
    for f, _ in problem.parts([arb(x) for x in box.nominal.tolist()], neglect=False):
        bits, stable = 160, None
        while stable is None and bits <= MOST_BITS:
            with precision(bits):
                v = [exact(x) for x in box.nominal.tolist()]
                v = [1 / x if inverted else x for x, inverted in zip(v, f.inverted, strict=True)]
                stable = hurwitz(f.at(v))
            bits *= 2
        if not stable:
            return False
    return True


def hurwitz(a: Sequence[Any]) -> bool | None:
    """Whether all roots of a_0 + a_1 s + ... lie left of the axis, by Routh's scheme in exact numbers or balls.

    None when the balls are too wide to decide.
    """
    rows = [list(reversed(a))[::2], list(reversed(a))[1::2]]
    lead = rows[0][0]
    if not (lead > 0 or lead < 0):
        return None if lead == 0 or hasattr(lead, "rad") else False
    positive = lead > 0
    while rows[1]:
        one, two = rows
        if not (two[0] > 0 if positive else two[0] < 0):
            return False if (two[0] < 0 if positive else two[0] > 0) or not hasattr(two[0], "rad") else None
        q = one[0] / two[0]
        rest = [x - q * (two[k + 1] if k + 1 < len(two) else 0) for k, x in enumerate(one[1:])]
        rows = [two, rest]
    return True
