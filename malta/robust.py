"""Robust stability against real parameters: how far they may all deviate before the loop can become unstable.

    margin = the largest t for which every p with  nominal - t (nominal - low) <= p <= nominal + t (high - nominal)
             is stable; 1: the whole modelled box; 3: three times it ("300 %"), as MATLAB's robstab counts.

A stable loop becomes unstable only where its characteristic function f(jw; p) = 0 for some w. `upper` is a p at which
it does, checked by the eigenvalues of the loop. `lower` is proven: zero is excluded from f over the whole box and over
*intervals* of frequency that cover all of them, w = 0 and the Nyquist frequency (or infinity) included.

    f(s; p) = det( N(s; p) - B(p) H(s) F(s) C(s; p) ),   N = s^2 - s A22 - A21  (or s - A)

N, B, C come from the CasADi model. F is the controller's own frequency response, of sampled ones at z = e^(jwT), H what
stands between: current loops, hold and delay, exactly. A hold's images at w + 2 pi k / T are bounded, not computed.

Each group of states that closes a loop by itself is treated alone. Where it is a single mode, f = mu(w, p) - nu(p) h(w)
with real mu and nu > 0: zero needs Im h(w) = 0, so the boundary of stability is a plane in p at each phase crossover,
in closed form. Where modes couple, f is a polynomial in p: its Bernstein coefficients enclose it over a box, and boxes
and frequency intervals are split until zero is outside of all of them (branch and bound).
Arithmetic is floating point with a guard of 1e-9; the tests repeat the proofs in ball arithmetic.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import linalg, sparse

from malta.enclose import (
    GUARD,
    ROUNDING,
    Block,
    Enclosure,
    Polynomial,
    actuator,
    along,
    characteristic_values,
    coefficients,
    cover,
    enclosure,
    excludes_zero,
    frequencies,
    polynomial,
    products,
    restrictions,
)
from malta.errors import CheckError, InputError
from malta.uncertain import Compensator, UncertainSystem, critical, differences, instability

if TYPE_CHECKING:
    from malta.plant import ComplexArray, FloatArray

DUST = 1e-11  # entries of the balanced closed loop below this, relative, are rounding
FAR = 1e2  # multiples of the modelled box beyond which nobody looks
EDGE = 1e-4  # how far from the end of what a parameter can be the search stays, relative
# How close the proven bound comes to the witness, relative:
EXACT = 5e-7  # where all modes are single, and of sampled loops at one position
TOLERANCE = 9.98e-4  # else: upper / lower <= 1.001
CLOSE = 0.01  # where what is only bounded keeps the proof away from the witness


@dataclass(frozen=True, eq=False)
class Certificate:
    """What proves the lower bound: zero is excluded on each cell."""

    cells: int
    frequencies: tuple[float, float]  # rad/s, covered without a gap
    intervals: FloatArray  # of each cell: branch (0: of w, 1: of 1/w), from, to
    boxes: FloatArray  # of each cell: of the parameters, as shares of the proven box


@dataclass(frozen=True, eq=False)
class Margin:
    """A robust stability margin in multiples of the modelled box.

    lower: proven; None where nothing is, `reason` says why. upper: reached by `witness`; infinite where no parameter
    of the range that exists destabilizes.
    """

    lower: float | None
    upper: float
    frequency: float | None  # rad/s, at which the witness loses stability
    witness: Mapping[str, float] | None  # SI
    moved: Mapping[str, float]  # the witness less the nominal values
    sensitivity: Mapping[str, float]  # share of each parameter in the margin; they add up to 1
    certificate: tuple[Certificate, ...]  # one for each group of states
    seconds: float
    reason: str = ""

    @property
    def exhausted(self) -> bool:
        """Stable as far as the parameters exist (a mass above zero)."""
        return math.isinf(self.upper)

    def __str__(self) -> str:
        low = "nothing proven" if self.lower is None else f"proven {100 * self.lower:.2f} %"
        if self.exhausted:
            return f"{low}: stable as far as was looked, or as the parameters exist"
        where = "" if self.frequency is None else f" at {self.frequency:.4g} rad/s"
        return f"{low}, lost at {100 * self.upper:.2f} %{where}"


def robust_margin(
    system: UncertainSystem,
    compensator: Compensator,
    ranges: Mapping[str, float | tuple[float, float]],
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float | None = None,
    most_cells: int = 100_000,
) -> Margin:
    """How far the parameters may deviate together, in multiples of their modelled range, before the loop is unstable.

    Parameters
    ----------
    ranges : by name; 0.2 is +-20 % of the nominal value, (low, high) an interval in SI. With t the lower side is
        nominal - t (nominal - low), the upper one nominal + t (high - nominal): linear on each side.
    over : intervals that do not grow with t, in SI: the bound holds anywhere in them (`z` over the travel)
    tolerance : how close the proven bound shall come to the witness, relative; None: 5e-7, or 1e-3 over
        intervals and in continuous loops whose modes couple
    most_cells : where the proof is given up

    Raises InputError for names that the system does not have and ranges that are none.
    """
    start = time.perf_counter()
    box = _box(system, ranges, over or {})
    unstable = instability(system, compensator, _standing(box)) >= 0
    if unstable.any():
        where = dict(zip(system.names, _standing(box)[unstable.argmax()].tolist(), strict=True))
        spent = time.perf_counter() - start
        return Margin(0.0, 0.0, None, where, {}, {}, (), spent, "the nominal loop is unstable")
    reach = min(box.most * (1 - EDGE), FAR)
    found: list[_Bound] = []
    blocks = _blocks(system, compensator, box)
    same = _alike(blocks, box)
    for block, twin in zip(blocks, same, strict=True):
        found.append(_search(block, box, reach) if twin is None else replace(found[twin], block=block))
        reach = min(reach, found[-1].upper)
    if any(b.reason for b in found):
        found = _by_eigenvalues(system, compensator, box, reach, found)
        reach = min(reach, *(b.upper for b in found))
    # What is beyond the smallest witness needs no proof.
    easy = all(b.exact for b in found) or (compensator.sample_time is not None and not over)
    close = tolerance or (EXACT if easy else TOLERANCE)
    if any(math.isfinite(b.upper) for b in found):
        reach *= 1 - close
    bounds: list[_Bound] = []
    for b, twin in zip(found, same, strict=True):
        if twin is not None and bounds[twin].lower is not None:
            bounds.append(replace(bounds[twin], block=b.block))
            continue
        bounds.append(_branch_and_bound(b, box, reach, close, most_cells))
        reach = min(reach, bounds[-1].upper * (1 - close))
    return _merged(system, compensator, box, bounds, start)


@dataclass(frozen=True, eq=False)
class _Box:
    """Nominal values and how far each grows downwards and upwards with t; `over` stays."""

    names: tuple[str, ...]
    nominal: FloatArray
    down: FloatArray
    up: FloatArray
    over: FloatArray  # names x 2: added to nominal, whatever t
    most: float  # t at which a parameter leaves what it can be

    def sides(self, t: float) -> FloatArray:
        """Low and high of every parameter: names x 2."""
        return np.column_stack([self.nominal - t * self.down, self.nominal + t * self.up]) + self.over


def _box(
    system: UncertainSystem,
    ranges: Mapping[str, float | tuple[float, float]],
    over: Mapping[str, tuple[float, float]],
) -> _Box:
    k = len(system.names)
    down, up, fixed = np.zeros(k), np.zeros(k), np.zeros((k, 2))
    most = math.inf
    for name, value in (*ranges.items(), *over.items()):
        if name not in system.names:
            raise InputError(
                "robust_margin", name, "an unknown parameter", "one of " + " ".join(system.names)
            )
        i = system.names.index(name)
        nominal = float(system.nominal[i])
        pair = (
            value
            if isinstance(value, tuple)
            else (nominal - abs(nominal) * value, nominal + abs(nominal) * value)
        )
        sound = len(pair) == 2 and all(math.isfinite(v) for v in pair) and pair[0] <= nominal <= pair[1]
        if not sound or pair[0] == pair[1] or (not isinstance(value, tuple) and not value > 0):
            raise InputError(
                "robust_margin",
                name,
                repr(value),
                f"a share above 0, or (low, high) about the nominal {nominal:g}",
            )
        if name in ranges and name in over:
            raise InputError("robust_margin", name, "in ranges and in over", "in one of them")
        if name in over:
            fixed[i] = pair[0] - nominal, pair[1] - nominal
            continue
        down[i], up[i] = nominal - pair[0], pair[1] - nominal
        low, high = system.limits[i]
        for room, rate in ((nominal - low, down[i]), (high - nominal, up[i])):
            most = min(most, room / rate) if rate > 0 else most
    if not ranges:
        raise InputError("robust_margin", "ranges", "no parameters", "at least one uncertain parameter")
    return _Box(system.names, system.nominal, down, up, fixed, most)


def _standing(box: _Box) -> FloatArray:
    """Nominal values, at both ends and the middle of everything that stays; the nominal ones first."""
    sides = (np.unique([0.0, low, (low + high) / 2, high]) for low, high in box.over)
    places = np.array(list(itertools.product(*sides)))
    order = np.argsort(np.abs(places).sum(axis=1), kind="stable")
    return np.asarray(box.nominal + places[order])


def _blocks(system: UncertainSystem, c: Compensator, box: _Box) -> list[Block]:
    """The strongly connected groups of the closed loop, at any parameters: their factors are independent."""
    rng = np.random.default_rng(0)
    sides = box.sides(min(1.0, 0.9 * box.most))
    rows = np.vstack([_standing(box), sides.T, rng.uniform(sides[:, 0], sides[:, 1], (8, len(sides)))])
    n = system.matrices.size1_out(0)
    A, B, C = system.at(rows)
    k = len(rows)
    size, terms = np.zeros((2, k, n + len(c.A), n + len(c.A)))
    size[:, :n, :n], size[:, :n, n:], size[:, n:, :n], size[:, n:, n:] = (
        A + B @ c.D @ C,
        B @ c.C,
        c.B @ C,
        c.A,
    )
    size = np.abs(size)
    terms[:, :n, :n] = abs(A) + abs(B) @ abs(c.D) @ abs(C)
    terms[:, :n, n:], terms[:, n:, :n] = abs(B) @ abs(c.C), abs(c.B) @ abs(C)
    # whatever the units of the states
    _, (units, _) = linalg.matrix_balance(size.max(axis=0), permute=False, separate=True)
    size, terms = size * units / units[:, None], terms * units / units[:, None]
    reference = np.sqrt(size.max(axis=2)[:, :, None] * size.max(axis=1)[:, None, :])
    touch = (size > DUST * np.maximum(terms, reference)).any(axis=0)
    _, label = sparse.csgraph.connected_components(touch, directed=True, connection="strong")
    blocks = []
    positions = n // 2 if system.second_order else n
    for k in dict.fromkeys(label.tolist()):
        own = np.flatnonzero(label[n:] == k)
        states = tuple(np.flatnonzero(label[:positions] == k).tolist())
        if states:
            integrals = int((own >= len(c.A) - c.integrals).sum())
            inner = replace(c, A=c.A[np.ix_(own, own)], B=c.B[own], C=c.C[:, own], integrals=integrals)
            blocks.append(Block(system, inner, states))
    return blocks


def _alike(blocks: list[Block], box: _Box) -> list[int | None]:
    """For each group an earlier one whose f is the same function up to a factor, as those of a round body's planes are.

    Two analytic functions of frequency and parameters that agree at 48 places chosen at random are one.
    """
    rng = np.random.default_rng(2)
    sides = box.sides(min(1.0, 0.9 * box.most))
    rows = rng.uniform(sides[:, 0], sides[:, 1], (4, len(sides)))
    if not blocks:
        return []
    T = blocks[0].own.sample_time
    w = np.exp(rng.uniform(-6, 0, 12)) * (1e4 if T is None else np.pi / T)
    seen: list[ComplexArray] = []
    found: list[int | None] = []
    for block in blocks:
        f = characteristic_values(block, rows, w)
        f = f / f[0, 0]
        close = 10 * ROUNDING * np.abs(f).max(axis=1, keepdims=True)  # at each frequency: f spans decades
        found.append(next((k for k, g in enumerate(seen) if (np.abs(f - g) <= close).all()), None))
        seen.append(f if found[-1] is None else np.full_like(f, np.inf))
    return found


@dataclass(frozen=True, eq=False)
class _Bound:
    """What is known of one group."""

    block: Block
    poly: Polynomial | None = None  # None where f is none
    upper: float = math.inf
    frequency: float | None = None  # rad/s
    witness: FloatArray | None = None
    exact: bool = False  # in closed form, at the phase crossovers
    lower: float | None = None
    certificate: Certificate | None = None
    reason: str = ""  # why nothing is proven


def _search(block: Block, box: _Box, goal: float) -> _Bound:
    """The first loss of stability below `goal`: at the phase crossovers of a mode, or along the box's diagonals."""
    poly = polynomial(block, box.names, box.sides(goal))
    if isinstance(poly, str):
        return _Bound(block, reason=poly)
    found = _Bound(block, poly)
    for _ in range(8):
        e = enclosure(block, box.nominal, box.sides(goal), poly)
        exact = _at_crossovers(e, box, goal)
        better = exact if exact is not None else _worst_ray(e, box, goal)
        if better is None or not better[0] < found.upper:
            return replace(found, exact=exact is not None)
        upper, frequency, witness = better
        found = _Bound(block, poly, upper, frequency, witness, exact is not None)
        if found.exact:
            return found
        goal = upper * (1 - TOLERANCE)
    return found


def _at_crossovers(e: Enclosure, box: _Box, goal: float) -> tuple[float, float, FloatArray] | None:
    """t, w, p where a single mode first loses its stability; t is infinite where it does not below goal.

    f = -(w^2 M(p) + S(p) + nu(p) h(w)) with M, S, nu affine in p, so f = 0 where Im h = 0 is a plane in p. None where f
    is not of this form.
    """
    M, c = e.matrices, e.block.own
    if M.N1 is None or M.N0.shape[1] > 1 or M.N1.any() or any(size > 2 for size in e.shape):
        return None
    C = M.C0 if M.C1 is None else np.concatenate([M.C0, M.C1], axis=2)
    paths = np.einsum("jk,jlc->jklc", M.B[:, 0], C).reshape(len(M.B), M.B.shape[2], -1)
    largest = np.unravel_index(np.abs(paths[0]).argmax(), paths[0].shape)
    nu = paths[:, *largest] / paths[0][largest]
    if (
        paths[0][largest] == 0
        or np.abs(paths - nu[:, None, None] * paths[0]).max() > GUARD * np.abs(paths).max()
    ):
        return None
    free = [i for i, size in enumerate(e.shape) if size > 1]
    unit = np.abs(e.sides[free]).max(axis=1)
    corners = np.column_stack([np.ones(len(e.rows)), e.rows[:, free] / unit])
    parts = np.column_stack([e.weights, e.weights * M.N0[:, 0, 0], e.weights * nu])
    affine = np.linalg.lstsq(corners, parts, rcond=None)[0]
    if (np.abs(corners @ affine - parts) > GUARD * np.abs(parts).max(axis=0)).any() or not (nu > 0).all():
        return None
    C1 = None if M.C1 is None else M.C1[0, :, 0]

    A, B = differences(c)
    out, eye = M.B[0, 0] @ c.C, np.eye(len(c.A))

    def h(w: FloatArray) -> ComplexArray:
        cells = np.column_stack([0 * w, w, w])
        f = frequencies(c, cells)
        s = 1j * w if f.delta is None else f.delta.c
        total = np.zeros(len(w), dtype=complex)
        with np.errstate(all="ignore"):  # only centres count here
            for order, C in ((2, M.C0[0, :, 0]), (1, C1)):
                if C is not None:
                    H = actuator(c, f, cells, order)
                    inner = np.linalg.solve(s[:, None, None] * eye - A, (B @ C)[:, None])[..., 0]
                    path = (inner @ out + M.B[0, 0] @ c.D @ C) * (1.0 if H is None else H.c)
                    total += path * (1.0 if order == 2 else 1j * w)
        return total

    top = cover(c, M.stiffest)[:, 2].max()
    w = np.geomspace(1e-9, 1, 600) * top
    turned = h(w).imag
    k = np.flatnonzero(np.sign(turned[1:]) != np.sign(turned[:-1]))
    low, high, left = w[k], w[k + 1], turned[k]
    for _ in range(7):  # sixteen parts of each at a time, all crossovers at once
        inside = np.linspace(0, 1, 18)[1:-1]
        points = low + (high - low) * inside[:, None]
        side = np.sign(h(points.ravel()).imag.reshape(points.shape)) == np.sign(left)
        count = np.where(side.all(axis=0), len(inside), side.argmin(axis=0))
        edges = np.vstack([low, points, high])
        low, high = (np.take_along_axis(edges, (count + i)[None], axis=0)[0] for i in (0, 1))
    ends = h(np.concatenate([low, high])).imag.reshape(2, -1)
    crossings = low + (high - low) * ends[0] / (ends[0] - ends[1])
    if not c.integrals:
        crossings = np.r_[0.0, crossings]
    values = h(crossings).real
    own, down, up = (of[free] / unit for of in (box.nominal, box.down, box.up))
    stay = box.over[free].T / unit
    best: tuple[float, float, FloatArray] = (math.inf, 0.0, box.nominal)
    for at, value in zip(crossings.tolist(), values.tolist(), strict=True):
        plane = affine @ np.array([at**2, 1.0, value])
        now = float(plane[0] + plane[1:] @ own)
        toward = -np.sign(now) * plane[1:]
        rate, there = np.where(toward > 0, up, -down), np.where(toward > 0, stay[1], stay[0])
        t = max(0.0, abs(now) - float(toward @ there)) / max(float(toward @ rate), 1e-300)
        if t < min(best[0], goal):
            p = box.nominal.copy()
            pulls = np.abs(toward) > GUARD * np.abs(plane[1:]).max()
            p[free] += unit * np.where(pulls, there + t * rate, 0)
            best = t, at, p
    return best


def _branch_and_bound(found: _Bound, box: _Box, goal: float, tolerance: float, most_cells: int) -> _Bound:
    """Prove the box at `goal`, which is below the witness, or a smaller one.

    Where a proof gets stuck, stability may be lost off the diagonals: the witness is looked for around that place.
    Between the largest box that is proven and the smallest that is not, the proof is tried to within a percent.
    """
    if found.poly is None:
        return found
    looked, reason, failed = 0, "", math.inf
    shares = iter((1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9, 0.99))
    top = goal
    while True:
        e = enclosure(found.block, box.nominal, box.sides(goal), found.poly)
        proved = _prove(e, most_cells, found.frequency)
        if isinstance(proved, Certificate):
            found = replace(found, lower=goal, certificate=proved)
            if failed - goal <= CLOSE * goal or math.isinf(failed):
                return found
            goal = (goal + failed) / 2
            continue
        reason, place = proved
        failed = goal
        if found.lower is not None:
            if failed - found.lower <= CLOSE * found.lower:
                return found
            goal = (found.lower + failed) / 2
            continue
        looked += 1
        better = _around(e, box, goal, place) if looked <= 4 else None
        if better is not None and better[0] < min(goal, found.upper):
            found = replace(found, upper=better[0], frequency=better[1], witness=better[2], exact=False)
            goal = top = better[0] * (1 - tolerance)
            failed = math.inf
            continue
        share = next(shares, None)
        if share is None:
            return replace(found, reason=reason)
        goal = top * (1 - share)


def _stability(e: Enclosure) -> tuple[FloatArray, ComplexArray, Callable[[FloatArray], Any]]:
    """A grid of frequencies, f's coefficients on it, and what says of rows of parameters whether they are unstable.

    Stable where f turns as often as at the nominal parameters between w = 0 and the end (argument principle).
    """
    intervals = cover(e.block.own, e.matrices.stiffest)
    parts = [
        np.column_stack([np.full(10, b), *(2 * [np.linspace(lo, hi, 11)[:-1]])]) for b, lo, hi in intervals
    ]
    if e.block.own.sample_time is None:
        parts[-1] = parts[-1][::-1]
    grid = np.vstack(parts)
    values = coefficients(e, grid).c
    own = products(e, e.nominal[None, :]) @ values.T

    def unstable(rows: FloatArray) -> Any:
        ratio = (products(e, rows) @ values.T) / own
        turned = np.unwrap(np.angle(ratio), axis=1)
        return (ratio[:, 0].real < 0) | (np.abs(turned[:, -1] - np.angle(ratio[:, 0])) > np.pi / 2)

    return grid, values, unstable


def _first(unstable: Callable[[FloatArray], Any], P: FloatArray, D: FloatArray, goal: float) -> FloatArray:
    """Where the first of the rays p + t d become unstable: t of each, infinite of the others."""
    scan = goal * np.unique(np.r_[np.geomspace(1e-3, 1, 9), np.linspace(0, 1, 17)[1:]])
    t, before = np.full(len(P), math.inf), 0.0
    for at in scan.tolist():
        rays = np.flatnonzero(unstable(P + at * D))
        if len(rays):
            low, high = np.full(len(rays), before), np.full(len(rays), at)
            for _ in range(26):
                middle = (low + high) / 2
                bad = unstable(P[rays] + middle[:, None] * D[rays])
                low, high = np.where(bad, low, middle), np.where(bad, middle, high)
            t[rays] = high
            break
        before = at
    return t


def _worst_ray(e: Enclosure, box: _Box, goal: float) -> tuple[float, float, FloatArray] | None:
    """The first loss of stability along the diagonals of the box: t, w, p. None when there is none below goal."""
    grid, values, unstable = _stability(e)
    P, D = _rays(box, [i for i, size in enumerate(e.shape) if size > 1])
    t = _first(unstable, P, D, goal)
    k = int(t.argmin())
    return None if math.isinf(t[k]) else _sharpened(e, grid, values, P[k], D[k], float(t[k]))


def _around(
    e: Enclosure, box: _Box, goal: float, place: FloatArray
) -> tuple[float, float, FloatArray] | None:
    """The first loss of stability on rays about the one through `place`: t, w, p. None where none is below goal."""
    grid, values, unstable = _stability(e)
    free = [i for i, size in enumerate(e.shape) if size > 1]
    grown = np.array([box.down[i] + box.up[i] > 0 for i in free])
    low = np.where(grown, -1.0, box.over[free, 0])
    high = np.where(grown, 1.0, box.over[free, 1])
    down, up = box.down[free], box.up[free]

    def rays(u: FloatArray) -> tuple[FloatArray, FloatArray]:
        P, D = np.tile(box.nominal, (len(u), 1)), np.zeros((len(u), len(box.nominal)))
        P[:, free] += np.where(grown, 0, u)
        D[:, free] = np.where(grown, np.where(u > 0, u * up, u * down), 0)
        return P, D

    moved = place[free] - box.nominal[free]
    u = np.where(grown, moved / np.where(grown, np.where(moved > 0, up, down), 1), moved)
    size = np.abs(u[grown]).max(initial=0.0)
    if size == 0:
        return None
    u = np.clip(np.where(grown, u / size, u), low, high)
    best, step = math.inf, 0.5
    while step > 1e-3:
        moves = np.vstack([0 * u, *(s * step * np.diag(high - low) / 2 for s in (1, -1))])
        trial = np.clip(u + moves, low, high)
        t = _first(unstable, *rays(trial), min(goal, best))
        k = int(t.argmin())
        if t[k] < best * (1 - 1e-9):
            best, u = float(t[k]), trial[k]
        else:
            step /= 2
        if math.isinf(best) and step < 0.1:
            return None
    (p,), (d,) = rays(u[None, :])
    return _sharpened(e, grid, values, p, d, best)


def _sharpened(
    e: Enclosure, grid: FloatArray, values: ComplexArray, p: FloatArray, d: FloatArray, t: float
) -> tuple[float, float, FloatArray]:
    """t, w, p + t d where f vanishes near t."""
    size = np.abs(products(e, (p + t * d)[None, :]) @ values.T)[0]
    at = grid[int((size / np.abs(products(e, e.nominal[None, :]) @ values.T)[0]).argmin())]
    t, cell = _polished(e, p, d, t, at)
    w = cell[1] if cell[0] == 0 else 1 / cell[1] if cell[1] > 1e-12 / e.matrices.stiffest else math.inf
    if w < 1e-9 * e.matrices.stiffest:  # Newton's method does not land on zero itself
        w = 0.0
    return t, float(w), p + t * d


def _rays(box: _Box, free: list[int]) -> tuple[FloatArray, FloatArray]:
    """Starts p and directions d of p + t d: to the corners, from both ends and the middle of what stays."""
    grown = [i for i in free if box.down[i] + box.up[i] > 0]
    stay = [i for i in free if i not in grown]
    places = np.array(
        list(itertools.product(*(np.linspace(box.over[i, 0], box.over[i, 1], 3) for i in stay)))
    )
    signs = np.array(list(itertools.product((-1, 1), repeat=len(grown))))
    start = np.tile(box.nominal, (len(places) * len(signs), 1))
    step = np.zeros_like(start)
    start[:, stay] += np.repeat(places, len(signs), axis=0)
    step[:, grown] = np.tile(np.where(signs > 0, box.up[grown], -box.down[grown]), (len(places), 1))
    return start, step


def _by_eigenvalues(
    system: UncertainSystem, c: Compensator, box: _Box, goal: float, found: list[_Bound]
) -> list[_Bound]:
    """With the first loss of stability along the box's diagonals, where f is no polynomial."""
    t, frequency, p = _by_poles(system, c, box, goal)
    if frequency is None or p is None:
        return found
    w = np.array([frequency])
    sizes = [
        math.inf
        if not b.reason
        else np.abs(characteristic_values(b.block, p[None, :], w)).item()
        / np.abs(characteristic_values(b.block, box.nominal[None, :], w)).item()
        for b in found
    ]
    i = int(np.argmin(sizes))
    worse = replace(found[i], upper=t, frequency=frequency, witness=p)
    return [*found[:i], worse, *found[i + 1 :]]


def _polished(
    e: Enclosure, p: FloatArray, d: FloatArray, t: float, cell: FloatArray
) -> tuple[float, FloatArray]:
    """Newton's method for f = 0 in t and frequency along p + t d; the start where it does not settle nearby."""
    first, at, step = t, cell[1], 1e-6
    for _ in range(12):
        half = step * max(at, 1e-12)
        f = coefficients(e, np.array([[cell[0], at - half, at + half]]))
        rows = p + np.array([t, t * (1 + step)])[:, None] * d
        weights = products(e, rows)
        value, moved = (weights @ f.c[0]).tolist()
        slopes = [(moved - value) / (t * step), complex(weights[0] @ f.g[0]) / half]
        J = np.array([[g.real for g in slopes], [g.imag for g in slopes]])
        if not np.isfinite(J).all() or np.linalg.cond(J) > 1e15:
            return first, cell
        dt, dw = np.linalg.solve(J, [-value.real, -value.imag])
        t, at = t + dt, at + dw
        if not (0.98 * first < t < 1.02 * first and at > 0):
            return first, cell
        if abs(dt) <= 1e-14 * t and abs(dw) <= 1e-14 * at:
            break
    return float(t), np.array([cell[0], at, at])


def _prove(e: Enclosure, most_cells: int, near: float | None = None) -> Certificate | tuple[str, FloatArray]:
    """Exclude zero from f over the whole box and all frequencies, or say why not, and at which parameters.

    near : rad/s, where it is hardest; the first intervals are narrow there
    """
    free = [axis for axis, size in enumerate(e.shape) if size > 1]
    cells = cover(e.block.own, e.matrices.stiffest)
    if near is not None and 0 < near < cells[cells[:, 0] == 0, 2].max():
        away = 4.0 ** -np.arange(1, 12)
        low = cells[:, 0] == 0
        edges = np.unique(np.concatenate([[0.0], cells[low, 2], near * (1 - away), near * (1 + away)]))
        edges = edges[edges <= cells[low, 2].max()]
        cells = np.vstack([np.column_stack([0 * edges[1:], edges[:-1], edges[1:]]), cells[~low]])
    ends = (0.0, float(cells[:, 2].max()) if e.block.own.sample_time is not None else math.inf)
    lost = _hopeless(e, cells)
    if lost is not None:
        return lost
    boxes = np.tile([0.0, 1.0], (len(cells), len(e.shape), 1))
    done_cells, done_boxes, count = [], [], 0
    while len(cells):
        batch, rest = slice(-4096, None), slice(None, -4096)
        own, own_boxes = cells[batch], boxes[batch]
        cells, boxes = cells[rest], boxes[rest]
        unique, index = np.unique(own, axis=0, return_inverse=True)
        whole = coefficients(e, unique)[index.ravel()]
        with np.errstate(invalid="ignore"):
            f = along(whole, e.shape, restrictions(e.shape, own_boxes))
        good = excludes_zero(f)
        done_cells.append(own[good])
        done_boxes.append(own_boxes[good])
        count += len(own)
        bad = ~good
        if not bad.any():
            continue
        own, own_boxes, f = own[bad], own_boxes[bad], f[bad]
        narrow = np.diff(own[:, 1:], axis=1)[:, 0] < 1e-13 * np.maximum(own[:, 2], 1e-9 * ends[0])
        if count > most_cells or narrow.any():
            k = int(np.argmax(narrow)) if narrow.any() else -1
            middle = float(own[k, 1:].mean())
            w = middle if own[k, 0] == 0 else 1 / middle
            place = e.sides[:, 0] + np.diff(e.sides)[:, 0] * own_boxes[k].mean(axis=1)
            settled = (
                f"not settled within {most_cells} cells" if count > most_cells else "zero is not excluded"
            )
            return f"{settled}, near {w:.6g} rad/s", place
        # split what moves f most: frequency, or a parameter
        moves = [np.abs(f.g).sum(axis=1) + f.r.sum(axis=1)]
        values = f.c.reshape(-1, *e.shape)
        for axis in free:
            moves.append(np.abs(np.diff(values, axis=axis + 1)).reshape(len(own), -1).sum(axis=1) / 2)
        moves[0] = np.where(np.isfinite(moves[0]), moves[0], np.inf)
        choice = np.argmax(moves, axis=0)
        for k in range(1 + len(free)):
            chosen = choice == k
            if not chosen.any():
                continue
            for side in (0, 1):
                c, b = own[chosen].copy(), own_boxes[chosen].copy()
                if k == 0:
                    c[:, 2 - side] = c[:, 1:].mean(axis=1)
                else:
                    b[:, free[k - 1], 1 - side] = b[:, free[k - 1]].mean(axis=1)
                cells, boxes = np.vstack([cells, c]), np.vstack([boxes, b])
    return Certificate(count, ends, np.vstack(done_cells), np.vstack(done_boxes))


def _hopeless(e: Enclosure, cells: FloatArray) -> tuple[str, FloatArray] | None:
    """Where f is smaller than what of it is only bounded, as images of a slow hold are: why, and at which parameters.

    No split makes that smaller. Looked for at the corners and in the middle of the box, at the edges of the cells.
    """
    if e.block.own.sample_time is None:
        return None
    edges = np.unique(cells[:, [0, 2]], axis=0)
    f = coefficients(e, np.column_stack([edges, edges[:, 1]]))
    shares = np.array(list(itertools.product(*((0.0, 0.5, 1.0) if n > 1 else (0.5,) for n in e.shape))))
    places = e.sides[:, 0] + np.diff(e.sides, axis=1)[:, 0] * shares
    at = products(e, places).T
    with np.errstate(all="ignore"):
        left = np.abs(f.c @ at) - f.r @ np.abs(at)
    k, place = np.unravel_index(np.where(np.isfinite(left), left, np.inf).argmin(), left.shape)
    if not left[k, place] < 0:
        return None
    w = edges[k, 1] if edges[k, 0] == 0 else 1 / edges[k, 1]
    return f"zero is not excluded, near {w:.6g} rad/s", places[place]


def _merged(system: UncertainSystem, c: Compensator, box: _Box, bounds: list[_Bound], start: float) -> Margin:
    """The smallest bounds, the witness beyond the boundary far enough for the eigenvalues of the loop to say so."""
    worst = min(bounds, key=lambda b: b.upper)
    reasons = list(dict.fromkeys(b.reason for b in bounds if b.reason))
    lower = (
        None if any(b.lower is None for b in bounds) else min(b.lower for b in bounds if b.lower is not None)
    )
    upper, frequency, witness, shares = worst.upper, worst.frequency, None, {}
    if worst.witness is not None:
        shares = _shares(worst, box)
        beyond = _confirmed(system, c, box, worst.witness, box.most / worst.upper)
        if beyond is not None:
            upper, witness = worst.upper * beyond, _stretched(box, worst.witness, beyond)
        elif c.sample_time is None:
            reasons.append("the eigenvalues do not confirm the witness")
            upper, frequency, lower = math.inf, None, None
        else:  # with a slow hold it may not be one: the proof counts its images in, the search did not
            upper, frequency, witness = _by_poles(system, c, box, min(box.most * (1 - EDGE), FAR))
            shares = {} if witness is None else shares
    named = None if witness is None else dict(zip(system.names, witness.tolist(), strict=True))
    moved = {name: value - float(system.nominal[i]) for i, (name, value) in enumerate((named or {}).items())}
    proofs = tuple(b.certificate for b in bounds if b.certificate is not None)
    return Margin(
        lower, upper, frequency, named, moved, shares, proofs, time.perf_counter() - start, "; ".join(reasons)
    )


def _by_poles(
    system: UncertainSystem, c: Compensator, box: _Box, reach: float
) -> tuple[float, float | None, FloatArray | None]:
    """The first loss of stability along the box's diagonals, by the poles of the loop alone: t, w, p; or infinity."""
    P, D = _rays(box, list(range(len(box.nominal))))
    try:
        t = _first(lambda rows: instability(system, c, rows) >= 0, P, D, reach)
    except CheckError:  # a machine that is faster than numbers
        return math.inf, None, None
    k = int(t.argmin())
    if math.isinf(t[k]):
        return math.inf, None, None
    p = P[k] + t[k] * D[k]
    return float(t[k]), critical(system, c, p), p


def _stretched(box: _Box, p: FloatArray, share: float) -> FloatArray:
    """Parameters that deviate `share` times as far, those that stay as they are."""
    return np.where(box.down + box.up > 0, box.nominal + share * (p - box.nominal), p)


def _confirmed(
    system: UncertainSystem, c: Compensator, box: _Box, p: FloatArray, most: float
) -> float | None:
    """How much further the eigenvalues of the loop say that p has to go to be unstable, as a factor; None: they do not.

    `most` is as far as parameters exist. f leaves out the images of a hold but for those of a free mass: it may be
    a few percent off where the hold is slow.
    """

    def unstable(share: float) -> bool:
        return float(instability(system, c, _stretched(box, p, share))[0]) > 0

    last = 1 - 1e-3
    if unstable(last):
        found, last = last, 0.0
    else:
        for found in (1 + 2e-7, 1 + 1e-6, 1 + 1e-5, 1 + 1e-4, 1.001, 1.01, 1.03, 1.1, 1.3):
            if found >= most:
                return None
            if unstable(found):
                break
            last = found
        else:
            return None
    while found - last > 1e-6:
        middle = (found + last) / 2
        found, last = (middle, last) if unstable(middle) else (found, middle)
    return found


def _shares(bound: _Bound, box: _Box) -> dict[str, float]:
    """What each parameter contributes to reaching the boundary: d ln(margin) = -sum of share x d ln(range).

    Along f(jw, p) = 0 the margin moves by Im(conj(f_w) f_p dp); at the witness all of them pull the same way.
    """
    assert bound.witness is not None
    assert bound.frequency is not None
    w = bound.frequency
    p, moved = bound.witness, bound.witness - box.nominal
    names = [i for i in range(len(p)) if box.down[i] + box.up[i] > 0 and moved[i] != 0]
    if math.isinf(w) or len(names) == 1:
        return {box.names[i]: 1 / len(names) for i in names}
    h = 1e-6
    rows = np.vstack([p, *(p - h * moved * (np.arange(len(p)) == i) for i in names)])
    at = np.array([w, w * (1 + h) if w > 0 else 1e-6])
    f = characteristic_values(bound.block, rows, at)
    slope, pulls = f[1, 0] - f[0, 0], f[0, 1:] - f[0, 0]
    size = (np.conj(slope) * pulls).imag if w > 0 else pulls.real
    total = size.sum()
    return {box.names[i]: float(s / total) for i, s in zip(names, size, strict=True)} if total else {}
