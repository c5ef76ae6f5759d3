"""How far any load moves an output of a sampled loop, anywhere in a box of parameters: proven.

    x' = A(p) x + B(p) u + b(p) w,   y = c x,   u = F y held,   |w| <= 1        h: the impulse response, w -> y

At a vertex of a cell |h|_1 is enclosed (impulse_bounds.py). Between vertices h is interpolated, an affine function of
each parameter, whose norm is largest at a vertex; what it leaves is at most the sum of r_i^2 / 2 |h_ii|_1, with r_i
half the cell's width and h_ii the second derivative. With d the rate that other parameters add to the states,

    d = dA x + dB u + db w,   |h_ii| <= |G_yd| (2 |G_zd| |G_zw| + ...),   z = A_i x + B_i u + b_i w

where G are the responses anywhere in the cell: those of its centre, times (1 - K)^-1 with K = |dA G_xd + dB G_ud|, the
gains of the change in the loop with itself. All of them are l1 norms, so that nothing is sampled in frequency. Where K
has an eigenvalue of 1 or more, or the first bound |G_yw| + |G_yd| (1 - K)^-1 |..| is too large, the cell is split.
"""

from __future__ import annotations

import heapq
import itertools
import math
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from flint import arb, arb_mat
from scipy import linalg

from malta.arrays import FloatArray
from malta.bound import at_least, at_most
from malta.display import Description, display
from malta.linear.balls import POINTS
from malta.linear.closed_loops import close_loop, difference_form
from malta.linear.expressions import NotAnalytic, program
from malta.linear.matrices import system_matrix
from malta.linear.sampling import split_delay
from malta.linear.uncertain import Compensator, StateGroup, UncertainSystem
from malta.proof.box import Box, within_branches
from malta.proof.groups import loop_of
from malta.proof.impulse_bounds import UP, Enclosed, enclose, l1_norms, push_in_parts, reach_of, sizes_of
from malta.proof.polynomial.closed_loop import add_lag, closed_loop, dense, driven_group, hold
from malta.proof.polynomial.enclosure import Unproven, precision
from malta.work import count_work, is_past

BITS = 96  # of balls at a vertex
PARTS = 2  # of a sample in which a load is taken as constant, and the rest is bounded
VERTEX_SHARE, CENTRE_SHARE = 1e-4, 1e-2  # of norms, left to samples that are not computed
VERTEX_WORK, CENTRE_WORK = 0.0075, 0.07
WORK = 30.0
TOLERANCE = 0.05  # between what is reached and what is proven
ROUGH_SHARE = 0.01  # of a bound, that the interpolation may leave without a look at the cell's own centre


@display
@dataclass(frozen=True, eq=False)
class LoadBound:
    """How far a load of unit size, whatever its waveform, moves an output anywhere in a box.

    lower : reached at `witness`, SI per unit of the load
    upper : proven; None: nothing is, and `reason` says why
    witness : parameters, SI
    cells : of the box that were looked at
    seconds : s;  work : units of work
    """

    lower: float
    upper: float | None
    witness: Mapping[str, float]
    cells: int
    seconds: float
    work: float
    reason: str = ""

    @property
    def description(self) -> Description:
        """Both bounds, and where the lower one is reached."""
        at = ", ".join(f"{name} = {value:.4g}" for name, value in self.witness.items())
        rows = (("reached", f"{at_least(self.lower).text()} at {at}"),)
        why = f" ({self.reason})" if self.reason else ""
        return Description(f"Any load of 1 moves it by at most {at_most(self.upper).text()}{why}", rows)


class _Point(NamedTuple):
    """The loop at one row of parameters."""

    M: Enclosed
    columns: tuple[Enclosed, ...]  # of each part of a sample: what unit inputs leave in the states
    spread: FloatArray  # by how much this may differ from its mean within a part: states x inputs
    size: FloatArray  # of the rates of the plant with its lags, entry by entry
    unit: FloatArray  # of these inputs, likewise
    into: FloatArray  # of what commands add to them
    within: Sequence[
        tuple[Enclosed, Enclosed]
    ]  # e^(A t) - 1 and the integral of e^(A t) B, at times in a sample


@dataclass(frozen=True, eq=False)
class _LoadedLoop:
    """A loop with a load and an output, over a box."""

    system: UncertainSystem
    law: Compensator
    load: ca.Function  # p -> b
    output: FloatArray  # c
    box: FloatArray  # parameters x 2

    @cached_property
    def loop(self) -> Any:
        return loop_of(self.system, self.law)

    @property
    def T(self) -> float:
        return float(self.law.sample_time or 0.0)

    @cached_property
    def rates(self) -> Any:
        """The program of [A B b], and of its first and second slopes by each parameter."""
        p = ca.SX.sym("p", len(self.system.names))
        A, B = self.system.matrices(p)[:2]
        Q = ca.densify(ca.horzcat(A, B, self.load(p)))
        flat, tables = ca.vec(Q), [Q]
        for i in range(p.numel()):
            one = ca.jacobian(flat, p[i])
            tables += [ca.reshape(M, *Q.shape) for M in (one, ca.jacobian(one, p[i]))]
        return program(ca.Function("rates", [p], [ca.densify(M) for M in tables]))

    def over(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The smallest and largest entries of these tables over a cell: tables x states x signals. Raises Unproven."""
        balls = [arb(low).union(arb(high)) for low, high in sides.tolist()]
        found = np.zeros((2, len(self.rates.shapes), *self.rates.shapes[0]))
        try:
            tables = self.rates.run(balls, POINTS)
        except NotAnalytic as error:
            raise Unproven(f"{error}") from error
        for k, entries in enumerate(tables):
            for i, j, x in entries:
                ends = float(arb(x).lower()), float(arb(x).upper())
                found[:, k, i, j] = np.nextafter(ends, (-math.inf, math.inf))
        if not np.isfinite(found).all():
            raise Unproven("matrices that are not bounded over the box")
        return found[0], found[1]

    @cached_property
    def changing(self) -> list[int]:
        """The states whose rates depend on the parameters."""
        low, high = self.over(self.box)
        slopes = np.maximum(np.abs(low), np.abs(high))[1:]
        return [i for i in np.flatnonzero(slopes.any(axis=(0, 2))).tolist() if i in set(self.kept)]

    @cached_property
    def inputs(self) -> FloatArray:
        """What the plant's inputs are of the loop's states, m x states: as it holds them."""
        n, (m, k), law = self.loop.states, self.law.C.shape, self.law
        stored, lags = m * split_delay(law.delay)[0], m * (law.lag is not None)
        rows = np.zeros((m, n + lags + stored + k))
        if stored:
            rows[:, n + lags : n + lags + m] = np.eye(m)
        else:
            rows[:, :n], rows[:, n + lags :] = law.D @ self.measured, law.C
        return rows

    @cached_property
    def measured(self) -> FloatArray:
        """C, which no parameter of the box changes. Raises Unproven otherwise."""
        if self.system.matrices.n_out() > 3:
            raise Unproven("outputs that inputs reach at once")
        if split_delay(self.law.delay)[1]:
            raise Unproven("a dead time that is not whole samples")
        p = ca.SX.sym("p", len(self.system.names))
        if ca.jacobian(ca.vec(self.system.matrices(p)[2]), p).nnz():
            raise Unproven("outputs that depend on the parameters")
        return np.asarray(self.system.at(self.system.nominal)[2][0])

    @cached_property
    def kept(self) -> list[int]:
        """The states that the load reaches anywhere in the box, and that reach the output: by sizes, none cancel."""
        n, law, m = self.loop.states, self.law, len(self.law.C)
        Q = np.abs(np.array(self.over(self.box))[:, 0]).max(axis=0) > 0
        A, B = Q[:, :n].astype(float), Q[:, n : n + m].astype(float)
        sizes = replace(law, A=np.abs(law.A), B=np.abs(law.B), C=np.abs(law.C), D=np.abs(law.D))
        parts = *difference_form(sizes), sizes.C, sizes.D
        (M,) = close_loop(sizes, A[None], B[None], np.abs(self.measured)[None], *parts)
        joins = reach_of(M != 0)
        return [int(i) for i in np.flatnonzero(joins[:, :n] @ Q[:, -1] & (self.output != 0) @ joins[:n])]

    def at(self, p: FloatArray, units: list[int], parts: int) -> _Point:
        """The loop at parameters p, with the inputs of some states' rates, and the load last. Raises Unproven."""
        n, m, law, kept = self.loop.states, len(self.law.C), self.law, self.kept
        with precision(BITS):
            balls = [arb(x) for x in p.tolist()]
            try:
                entries = self.loop.program.run(balls, POINTS)
                (b,) = program(self.load).run(balls, POINTS)
                every = StateGroup(tuple(range(n)), tuple(range(len(law.A))), None)
                M = enclose(closed_loop(driven_group(self.loop, every, entries, arb_mat))[0])
            except (NotAnalytic, ZeroDivisionError) as error:
                raise Unproven(f"{error}") from error
            a, into = (dense(arb_mat, n, columns, own) for columns, own in zip((n, m), entries, strict=False))
            if law.lag is not None:
                a, into, *_ = add_lag(arb_mat, a, into, dense(arb_mat, 1, n, ()), None, arb(law.lag))
            x = a.nrows()
            unit = dense(
                arb_mat, x, len(units) + 1,
                [*((i, k, 1) for k, i in enumerate(units)), *((i, len(units), v) for i, _, v in b)],
            )  # fmt: skip
            columns, spread = push_in_parts(a, unit, self.T, parts)
            within = _within_sample(a, into, self.T) if units else ()  # a vertex is looked at at samples
            point = M.part(kept, kept), sizes_of(a), sizes_of(unit), sizes_of(into), within
        blank = np.zeros((len(M.mid) - x, len(units) + 1))
        whole = [Enclosed(*(np.vstack([part, blank])[kept] for part in one)) for one in columns]
        closed = Enclosed(point[0].mid + np.eye(len(kept)), point[0].rad)
        return _Point(closed, tuple(whole), np.vstack([spread, blank])[kept], *point[1:])

    def norm(self, p: FloatArray) -> tuple[float, float]:
        """|h|_1 at parameters p, enclosed. Raises Unproven."""
        point = self.at(p, [], PARTS)
        row = np.zeros((1, len(self.inputs[0])))
        row[0, : len(self.output)] = self.output
        E = Enclosed(*(np.hstack([getattr(one, kind) for one in point.columns]) for kind in ("mid", "rad")))
        spread = np.hstack([point.spread] * PARTS)
        low, high = l1_norms(
            point.M, Enclosed(row[:, self.kept], 0 * row[:, self.kept]), E, spread, VERTEX_SHARE
        )
        return float(low.sum()), float(high.sum())

    def curvatures(self, sides: FloatArray) -> tuple[FloatArray, float]:
        """Bounds of |h_ii|_1 for each parameter over a cell, and of |h|_1 itself. Raises Unproven."""
        rows, (low, high) = self.changing, self.over(sides)
        if not rows:  # of which the loop does not depend
            return np.zeros(len(sides)), math.inf
        q, k, r = len(sides), len(rows), UP * np.nextafter((sides[:, 1] - sides[:, 0]) / 2, math.inf)
        low, high = low[:, rows], high[:, rows]
        V = (low[1::2] + high[1::2]) / 2  # slopes, parameters x rows x signals
        dev = UP * np.maximum(high[1::2] - V, V - low[1::2])
        second = np.maximum(np.abs(low[2::2]), np.abs(high[2::2]))
        b = np.abs(V[:, :, -1]) + dev[:, :, -1]
        N = self._centre_norms(sides.mean(axis=1), V[:, :, :-1].reshape(q * k, -1))
        z, s = (
            N[1 : 1 + q * k].reshape(q, k, k + 1),
            N[1 + q * k :],
        )  # of d and w: slopes x signals, and signals
        rest = np.einsum("i,ias->as", r, dev[:, :, :-1])  # of the change, beyond r V
        K = np.einsum("i,iab->ab", r, z[:, :, :k]) + rest @ s[:, :k]
        if not float(np.abs(np.linalg.eigvals(K)).max(initial=0.0)) < 1:
            raise Unproven("parameters that change the loop too much")
        grow = UP * np.linalg.inv(np.eye(k) - K).clip(0)
        d = grow @ (r @ (z[:, :, k] + b) + rest @ s[:, k])  # what w adds to the rates, anywhere in the cell
        s_d, s_w = s[:, :k] @ grow, s[:, k] + s[:, :k] @ d
        z_d = z[:, :, :k] @ grow + dev[:, :, :-1] @ s_d
        z_w = z[:, :, k] + z[:, :, :k] @ d + dev[:, :, :-1] @ s_w + b
        bent = 2 * np.einsum("iab,ib->ia", z_d, z_w) + second[:, :, :-1] @ s_w + second[:, :, -1]
        return UP * bent @ (N[0, :k] @ grow), UP * float(N[0, k] + N[0, :k] @ d)

    def _centre_norms(self, p: FloatArray, V: FloatArray) -> FloatArray:
        """Norms at parameters p from the rates of changing states, and from the load.

        V : functions of the signals x and u. Rows: the output at samples; these functions, and the signals, at any time

        At times within a sample x = e^(A t) x_k + the integral of e^(A t) B u_k + what has come in since, whose norm is
        added up; between these times sizes stand in place of all numbers.
        """
        point = self.at(p, self.changing, 1)
        x, k, size = len(point.size), point.unit.shape[1], self.inputs.shape[1]
        first, held = 1 + len(V), V.shape[1] > x  # whether commands are among the signals
        own, U = np.eye(x, size), self._enclosed_inputs()
        step = linalg.expm(
            self.T / len(point.within) * system_matrix(point.size, np.hstack([point.unit, point.into]))
        )
        grown, into = step[:x, :x] - np.eye(x), step[:x, x:]
        output = np.pad(self.output, (0, size - len(self.output)))[None]
        rows = []
        for moved, driven in point.within:
            X = _add_enclosed(
                _times(moved, Enclosed(own, 0 * own)), _times(driven, U), Enclosed(own, 0 * own)
            )
            signals = _stack_enclosed(X, U) if held else X
            rows += [Enclosed(output, 0 * output), _times(Enclosed(V, 0 * V), signals), X, U]
        every = self._row_norms(point, _stack_enclosed(*rows)).reshape(len(point.within), -1, k)
        since, found = np.zeros((x, k)), np.zeros((first + V.shape[1], k))
        next_time = point.within[-1 if len(every) < 2 else 1][
            0
        ]  # with one time nothing is carried to another
        carried = np.abs(next_time.mid + np.eye(x)) + next_time.rad
        for N in every:
            at = N[first : first + x] + since
            more = since + UP * (grown @ at + into[:, :k] + into[:, k:] @ N[first + x :])
            N[1:first] += UP * np.abs(V[:, :x]) @ more
            N[first : first + x] += more
            found = np.maximum(found, N[: len(found)])
            since = UP * (carried @ since + into[:, :k])
        return found

    def _enclosed_inputs(self) -> Enclosed:
        """`inputs`, whose sums of products were rounded."""
        size, m = self.inputs.shape[1], len(self.inputs)
        sums = np.abs(self.law.D) @ np.abs(self.measured)
        rad = np.abs(self.inputs) + np.pad(sums, ((0, 0), (0, size - sums.shape[1])))
        return Enclosed(self.inputs, 4 * (size + m) * np.finfo(float).eps * rad)

    def _row_norms(self, point: _Point, rows: Enclosed) -> FloatArray:
        """Upper bounds of the norms of rows of all states from the load and its like; 0 of rows that are zero."""
        kept = Enclosed(rows.mid[:, self.kept], rows.rad[:, self.kept])
        used = (kept.mid != 0).any(axis=1) | (kept.rad != 0).any(axis=1)
        found = np.zeros((len(used), point.unit.shape[1]))
        if used.any():
            some = Enclosed(kept.mid[used], kept.rad[used])
            found[used] = l1_norms(point.M, some, point.columns[0], point.spread, CENTRE_SHARE)[1]
        return found


MAX_GROWTH, MAX_TIMES = (
    0.5,
    64,
)  # of e^(|A| t) between times within a sample, as an exponent; and their number


def _within_sample(a: Any, into: Any, T: float) -> tuple[tuple[Enclosed, Enclosed], ...]:
    """e^(a t) - 1 and the integral of e^(a t) b at times within a sample, more of them the faster its states are."""
    fastest = float(np.abs(np.linalg.eigvals(sizes_of(a))).max(initial=0.0))
    count = min(max(math.ceil(fastest * T / MAX_GROWTH), 1), MAX_TIMES)
    pairs = [hold(arb_mat, a, into, arb(T) * k / count) for k in range(count)]
    return tuple((enclose(phi), enclose(gamma)) for phi, gamma in pairs)


def _times(one: Enclosed, two: Enclosed) -> Enclosed:
    """The product of enclosed matrices, rounding included."""
    sizes = np.abs(one.mid) @ np.abs(two.mid)
    rad = one.rad @ (np.abs(two.mid) + two.rad) + np.abs(one.mid) @ two.rad
    return Enclosed(one.mid @ two.mid, UP * (rad + 4 * (one.mid.shape[1] + 2) * np.finfo(float).eps * sizes))


def _add_enclosed(*parts: Enclosed) -> Enclosed:
    """The sum of enclosed matrices, rounding included."""
    mids, rads = np.array([one.mid for one in parts]), np.array([one.rad for one in parts])
    rad = rads.sum(axis=0) + 4 * len(parts) * np.finfo(float).eps * np.abs(mids).sum(axis=0)
    return Enclosed(mids.sum(axis=0), UP * rad)


def _stack_enclosed(*parts: Enclosed) -> Enclosed:
    return Enclosed(np.vstack([one.mid for one in parts]), np.vstack([one.rad for one in parts]))


class _LoadCell(NamedTuple):
    """A part of the box; the largest first."""

    rank: float  # minus its upper bound
    number: int
    sides: FloatArray
    curvature: FloatArray
    known: float  # an upper bound of its parent


def _bound_between(top: float, r: FloatArray, curvature: FloatArray, known: float) -> float:
    """A bound over a cell of half widths r whose corners lie below `top`."""
    return min(known, UP * (top + float((r * r / 2)[r > 0] @ curvature[r > 0])))


@dataclass(eq=False)
class _LoadSearch:
    """A search of the largest norm in a box. It changes in place."""

    loop: _LoadedLoop
    end: float  # of the work
    norms: dict[tuple[float, ...], tuple[float, float]] = field(default_factory=dict)
    count: int = 0

    def norm(self, p: tuple[float, ...]) -> tuple[float, float]:
        if p not in self.norms:
            is_past(self.end, VERTEX_WORK)
            self.norms[p] = self.loop.norm(np.array(p))
        return self.norms[p]

    def cell(self, sides: FloatArray, curvature: FloatArray, known: float) -> _LoadCell:
        """A cell with its bound. Raises Unproven where the loop at a vertex is not proven stable."""
        self.count += 1
        corners = [self.norm(p) for p in itertools.product(*(np.unique(side).tolist() for side in sides))]
        r = UP * (sides[:, 1] - sides[:, 0]) / 2
        top = max(upper for _, upper in corners)
        bound = _bound_between(top, r, curvature, known)
        rough = bound - top > ROUGH_SHARE * max(lower for lower, _ in self.norms.values())
        if rough and not is_past(self.end, CENTRE_WORK):
            try:
                own, whole = self.loop.curvatures(sides)
                curvature, known = np.minimum(own, curvature), min(known, whole)
                bound = _bound_between(top, r, curvature, known)
            except Unproven:
                pass  # too wide a cell: its parts
        return _LoadCell(-bound, self.count, sides, curvature, known)

    @property
    def best(self) -> tuple[float, tuple[float, ...]]:
        return max(((one[0], p) for p, one in self.norms.items()), default=(0.0, ()))


def prove_load(
    system: UncertainSystem,
    law: Compensator,
    load: ca.Function,
    output: FloatArray,
    box: Box,
    *,
    tolerance: float = TOLERANCE,
    work: float = WORK,
    time: float | None = None,
) -> LoadBound:
    """Prove how far a load of at most 1, whatever its waveform, moves an output at samples, anywhere in box(1).

    load : p -> b(p), how it acts on the rates of the system's states
    output : c, of these states
    tolerance : share of the proven bound that is left between it and what is reached
    work : units that the search may take; time : s, None: no limit
    """
    begun, ends = clock.monotonic(), within_branches(box, system)
    reason = system.approximate or ("" if ends.most >= 1 else f"the box ends: {ends.ends}")
    upper: float | None = None
    search = _LoadSearch(_LoadedLoop(system, law, load, output, box.sides(1.0)), work)
    with count_work(work, time) as meter:
        try:
            search.norm(tuple(system.nominal.tolist()))
            if not reason:
                upper = _narrow(search, tolerance)
        except Unproven as error:
            reason = f"{error}"
    if upper is None or math.isinf(upper):
        upper, reason = None, reason or "too little work for a box of this size"
    lower, p = search.best
    witness = dict(zip(system.names, p, strict=True)) if p else {}
    return LoadBound(
        lower, upper, witness, search.count, clock.monotonic() - begun, meter.work, system.reason(reason)
    )


def _narrow(search: _LoadSearch, tolerance: float) -> float:
    """Split the box until what is proven is near to what is reached, or the work is up: the proven bound."""
    sides = search.loop.box
    widths = np.maximum(sides[:, 1] - sides[:, 0], 1e-300)
    cells = [search.cell(sides, np.full(len(sides), math.inf), math.inf)]
    while True:
        worst = cells[0]
        if (1 - tolerance) * -worst.rank <= search.best[0] or is_past(search.end):
            return -worst.rank
        r = worst.sides[:, 1] - worst.sides[:, 0]
        open_end = np.isinf(worst.curvature)
        weight = np.where(open_end, (r / widths), r * r * np.where(open_end, 0.0, worst.curvature))
        axis = int(weight.argmax())
        middle = float(worst.sides[axis].mean())
        halves = []
        for side in (0, 1):
            half = worst.sides.copy()
            half[axis, 1 - side] = middle
            halves.append(search.cell(half, worst.curvature, worst.known))
        heapq.heapreplace(cells, halves[0])
        heapq.heappush(cells, halves[1])
