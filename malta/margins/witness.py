"""The nearest loss of stability: the smallest t with a(jw; p) = 0 for some w and some p in box(t).

From a start (w, p) the equation is linearized and the smallest t that solves it found by a linear program, within a
trust region; repeated, that is Newton's method with the freedom that is left used to make t small. At w = 0 and at
infinity (the Nyquist frequency) the equation is real.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.margins.exclusion import Cell, Growth
from malta.margins.family import Family, basis
from malta.margins.frequency import cover

if TYPE_CHECKING:
    from malta.plant import ComplexArray, FloatArray

STEPS = 8  # of the frequency grid in an octave
SPACING = 0.6 / STEPS  # half a step and more, in ln w
ENDS = ((0, 0.0), (1, 0.0))  # w = 0 and w = infinity


@dataclass(frozen=True, eq=False)
class Zero:
    """f = 0 at frequency x of a branch and parameters u, which first are in box(t)."""

    t: float
    branch: int
    x: float
    u: FloatArray

    def frequency(self, f: Family) -> float:
        """s / j, in the units of s; exactly zero or infinite where the first or last coefficient vanishes."""
        if len(self.u):
            ends = np.abs(coefficients_at(f, self.u)[0]) <= 1e-9 * f.size()
            if ends[0] or ends[-1]:
                return 0.0 if ends[0] else np.inf
        x = np.inf if self.branch and self.x == 0 else 1 / self.x if self.branch else self.x
        return float(np.ldexp(x, f.scale)) if np.isfinite(x) else x


def coefficients_at(f: Family, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """a_k at u, and its derivatives: K and P x K."""
    values = f.values.reshape(len(f.values), *f.shape)
    axes = [basis(n - 1, np.array(x)) for n, x in zip(f.shape, u, strict=True)]
    slopes = [_slope(n - 1, float(x)) for n, x in zip(f.shape, u, strict=True)]

    def contract(vectors: list[FloatArray]) -> FloatArray:
        found = values
        for v in reversed(vectors):
            found = found @ v
        return np.asarray(found)

    moved = [
        contract([*axes[:i], slopes[i], *axes[i + 1 :]]) if n > 1 else np.zeros(len(f.values))
        for i, n in enumerate(f.shape)
    ]
    return contract(axes), np.array(moved).reshape(len(u), -1)


def _slope(degree: int, u: float) -> FloatArray:
    if degree == 0:
        return np.zeros(1)
    low = basis(degree - 1, np.array(u))
    return np.asarray(degree * (np.append(0.0, low) - np.append(low, 0.0)))


def _rows(f: Family, branch: int, x: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Weights of a_k in f(x) and in x f'(x) at points x of a branch, scaled alike: points x K each."""
    n = f.degree
    k = np.arange(n + 1)
    power = n - k if branch else k
    x = np.atleast_1d(np.asarray(x, dtype=float))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.where(power == 0, 0.0, power * np.log2(x)) + np.array(f.exponents)
        size = np.abs(f.values).max(axis=1)
        shift = np.where(size > 0, logs + np.log2(np.where(size > 0, size, 1)), -np.inf).max(
            axis=1, keepdims=True
        )
        turn = (k - n if branch else k) % 4  # the last coefficient, alone at infinity, is real there
        weights = np.exp2(np.clip(logs - shift, -1070, 1000)) * 1j**turn
    return weights, weights * power


def linear_distance(f: Family, g: Growth, u: FloatArray, branch: int, x: FloatArray) -> FloatArray:
    """t at which the linearization about u first vanishes, at each of the frequencies x."""
    a, slopes = coefficients_at(f, u)
    rows, by_x = _rows(f, branch, x)
    value, moved = rows @ a, rows @ slopes.T
    grows: Any = g.grows
    slope = g.slopes(u)
    moved = moved / np.where(slope == 0, 1, slope)  # by p
    p = g.parameters(u)
    value = value - moved[:, grows] @ (p - g.nominal)[grows]
    turn = np.exp(-1j * np.pi * np.arange(32) / 32)
    along = (value[:, None] * turn).real
    pulls = (moved[:, None, :] * turn[:, None]).real
    sign = -np.sign(along)[:, :, None] * pulls
    # frequency is free between the points of the grid
    along = np.maximum(np.abs(along) - SPACING * np.abs(((by_x @ a)[:, None] * turn).real), 0)
    rate = (np.abs(pulls) * np.where(sign > 0, g.up, g.down))[:, :, grows].sum(axis=2)
    fixed = (np.abs(pulls) * np.abs(slope))[:, :, ~grows].sum(axis=2)
    with np.errstate(all="ignore"):
        left = np.maximum(along - fixed, 0)
        t = np.where(left == 0, 0, np.where(rate > 0, left / rate, np.inf))
    return np.asarray(np.nanmax(t, axis=1))


def starts(f: Family, g: Growth, most: int = 6) -> list[tuple[float, int, float, FloatArray]]:
    """Where to begin (t as it looks, branch, x, u): small linear distances along frequency, and unstable corners."""
    cells = cover(f)
    inner = cells[(cells[:, 0] == 0) & (cells[:, 1] > 0)]
    found: list[tuple[float, int, float, FloatArray]] = []
    centre = g.shares(g.nominal)
    fixed = [
        np.array([c]) if grows or n == 1 else np.array([0.5, 0.0, 1.0])
        for c, grows, n in zip(centre, g.grows, f.shape, strict=True)
    ]
    places = [np.array(place) for place in itertools.islice(itertools.product(*fixed), 27)]
    x = np.geomspace(inner[0, 1], inner[-1, 2], STEPS * len(inner)) if len(inner) else np.ones(1)
    for u in places:
        t = linear_distance(f, g, u, 0, x)
        low = np.flatnonzero((t <= np.r_[np.inf, t[:-1]]) & (t <= np.r_[t[1:], np.inf]) & np.isfinite(t))
        for k in low[np.argsort(t[low])][:most]:
            found.append((float(t[k]), 0, float(x[k]), u))
        for branch, end in ENDS:
            found.append((float(linear_distance(f, g, u, branch, np.array([end]))[0]), branch, end, u))
    found += _corners(f, g, most)
    found.sort(key=lambda s: s[0])
    return [start for start in found[: 2 * most] if np.isfinite(start[0])]


def _corners(f: Family, g: Growth, most: int) -> list[tuple[float, int, float, FloatArray]]:
    """Where stability is first lost on the way from the nominal values to corners of the box, by the roots."""
    free = [i for i, n in enumerate(f.shape) if n > 1]
    if not free:
        return []
    rng = np.random.default_rng(0)
    signs = (
        np.array(list(itertools.product((0.0, 1.0), repeat=len(free))))
        if len(free) <= 6
        else rng.integers(0, 2, (64, len(free))).astype(float)
    )
    centre, grows = g.shares(g.nominal), g.grows
    found = []
    for row in signs:
        end = centre.copy()
        end[free] = row
        start = np.where(grows, centre, end)
        if _worst_root(f, end)[0] <= 0:
            continue
        low, high = 0.0, 1.0
        for _ in range(14):
            middle = (low + high) / 2
            low, high = (
                (low, middle) if _worst_root(f, start + middle * (end - start))[0] > 0 else (middle, high)
            )
        u = start + high * (end - start)
        at = _worst_root(f, u)[1]
        found.append((float(g.margin(g.parameters(u))), 0, at, u))
    found.sort(key=lambda s: s[0])
    return found[:most]


def _worst_root(f: Family, u: FloatArray) -> tuple[float, float]:
    """Real part of the rightmost root, over its size, and |imaginary part|, in units of x."""
    a, _ = coefficients_at(f, u)
    exponents = np.array(f.exponents) - max(f.exponents)
    roots = np.roots(np.ldexp(a, np.maximum(exponents, -1000))[::-1])
    if not len(roots):
        return -1.0, 0.0
    worst = roots[(roots.real / np.maximum(np.abs(roots), 1e-300)).argmax()]
    return float(worst.real / max(abs(worst), 1e-300)), float(abs(worst.imag))


def nearest(f: Family, g: Growth, branch: int, x: float, u: FloatArray, below: float) -> Zero | None:
    """Descend to a zero of f of smallest t from a start; None where none is found with t below `below`."""
    trust, best, failures = 0.5, None, 0
    for k in range(120):
        step = _step(f, g, branch, x, u, trust)
        if step is None:  # nothing within the trust region solves the equation
            trust, failures = 2 * trust, failures + 1
            if failures > 8 or trust > 2:
                break
            continue
        value, size, t, new_x, new_u = step
        if (k > 2 and t > 1.2 * below) or (value > 5e-3 * size and k > 24):
            break  # a start that leads further out, or nowhere
        change = float(np.abs(new_u - u).max(initial=0.0)) + (abs(new_x / x - 1) if x else 0.0)
        residual = _value(f, branch, new_x, new_u)[0]
        if residual > 0.9 * value and residual > 1e-9 * size:
            trust /= 3
            failures += 1
            if trust < 1e-7 or failures > (8 if value > 5e-3 * size else 40):
                break
            continue
        x, u = new_x, new_u
        t = float(g.margin(g.parameters(u)))
        if residual <= 1e-11 * size:
            if best is None or t < best.t * (1 - 1e-12):
                best = Zero(t, branch, x, u)
            elif change < 1e-6:
                break
        if change < 1e-10:
            break
    return best if best is None or best.t < below else None


def _value(f: Family, branch: int, x: float, u: FloatArray) -> tuple[float, float]:
    """|f|, and the sum of its terms' sizes."""
    a, _ = coefficients_at(f, u)
    rows, _ = _rows(f, branch, np.array([x]))
    return float(np.abs(rows @ a)[0]), float((np.abs(rows) @ f.size())[0])


def _step(
    f: Family, g: Growth, branch: int, x: float, u: FloatArray, trust: float
) -> tuple[float, float, float, float, FloatArray] | None:
    """|f|, its size, and the t, x, u that the linear program finds."""
    from scipy.optimize import linprog

    a, slopes = coefficients_at(f, u)
    rows, along = _rows(f, branch, np.array([x]))
    value, size = complex((rows @ a)[0]), float((np.abs(rows) @ f.size())[0])
    moved, turned = (rows @ slopes.T)[0], complex((along @ a)[0])
    k = len(u)
    real = x == 0
    # unknowns: du, d ln x, t
    columns = np.concatenate([moved, [0 if real else turned], [0]])
    scale = np.abs(columns).max()
    if not (0 < scale < np.inf and abs(value) < 1e12 * scale):
        return None
    equations = [columns.real / scale] if real else [columns.real / scale, columns.imag / scale]
    right = [-value.real / scale] if real else [-value.real / scale, -value.imag / scale]
    limits, free = [], []
    bounds: list[tuple[float, float | None]] = []
    p, slope, grows = g.parameters(u), g.slopes(u), g.grows
    for i in range(k):
        if f.shape[i] == 1:
            bounds.append((0.0, 0.0))
            continue
        bounds.append((max(-trust, -float(u[i])), min(trust, 1 - float(u[i]))))
        if grows[i]:
            for sign, room in ((1.0, g.up[i]), (-1.0, g.down[i])):
                row = np.zeros(k + 2)
                row[i], row[-1] = sign * slope[i], -room
                unit = 1 / max(abs(slope[i]), room)
                limits.append(row * unit)
                free.append(sign * (g.nominal[i] - p[i]) * unit)
    bounds += [(-trust, trust), (0, None)]
    cost = np.zeros(k + 2)
    cost[-1] = 1
    found = linprog(
        cost,
        np.array(limits) if limits else None,
        free or None,
        np.array(equations),
        right,
        bounds,
        method="highs",
    )
    if found.status != 0:
        return None
    moves: Any = found.x
    return abs(value), size, float(moves[-1]), x * float(np.exp(moves[k])), np.clip(u + moves[:k], 0, 1)


def from_cell(f: Family, g: Growth, cell: Cell, below: float) -> Zero | None:
    """A zero of t below `below` out of a cell where zero was not excluded: the next one, and the descent from there."""
    low, high = cell.interval
    u, best = cell.box.mean(axis=1), None
    for x in ((low + high) / 2, *([0.0] if low == 0 else [])):
        near = projected(f, g, cell.branch, x, u)
        if near is not None and near.t < (best.t if best is not None else below):
            best = near
    if best is None:
        return None
    if best.t <= 1.01 * cell.smallest:
        return best
    further = nearest(f, g, best.branch, best.x, best.u, best.t)
    return further if further is not None and further.t < best.t else best


def projected(f: Family, g: Growth, branch: int, x: float, u: FloatArray) -> Zero | None:
    """The zero next to a place, by Newton's method with steps of least norm; None where it leads out of the box."""
    free = np.array([n > 1 for n in f.shape])
    for _ in range(30):
        a, slopes = coefficients_at(f, u)
        rows, along = _rows(f, branch, np.array([x]))
        value, size = complex((rows @ a)[0]), float((np.abs(rows) @ f.size())[0])
        if abs(value) <= 1e-12 * size:
            return Zero(float(g.margin(g.parameters(u))), branch, x, u)
        moved, turned = (rows @ slopes.T)[0] * free, complex((along @ a)[0])
        columns = moved if x == 0 else np.append(moved, turned)
        J = columns.real[None] if x == 0 else np.array([columns.real, columns.imag])
        right = np.array([value.real]) if x == 0 else np.array([value.real, value.imag])
        if not np.isfinite(J).all():
            return None
        step = -np.linalg.lstsq(J / size, right / size, rcond=1e-12)[0]
        if np.abs(step).max() > 0.5:
            return None
        u = u + step[: len(u)]
        if (u < -1e-9).any() or (u > 1 + 1e-9).any():
            return None
        u = np.clip(u, 0, 1)
        x = x if x == 0 else x * float(np.exp(step[-1]))
    return None


def gradients(f: Family, zero: Zero) -> tuple[ComplexArray, complex]:
    """Derivatives of f at a zero: by u, and by ln w."""
    _, slopes = coefficients_at(f, zero.u)
    a, _ = coefficients_at(f, zero.u)
    rows, along = _rows(f, zero.branch, np.array([zero.x]))
    by_x = complex((along @ a)[0]) * (-1 if zero.branch else 1)
    return np.asarray((rows @ slopes.T)[0]), by_x
