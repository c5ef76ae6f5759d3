"""The nearest loss of stability: the smallest t with a(jw; p) = 0 for some w and some p in box(t).

From a start (w, p) the equation is linearized and the smallest t that solves it found by a linear program, within a
trust region; repeated, that is Newton's method with the freedom that is left used to make t small. At w = 0 and at
infinity (the Nyquist frequency) the equation is real.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

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


def rows_at(f: Family, branch: int, x: FloatArray) -> ComplexArray:
    """Weights of a_k in f(x) at points of a branch, on a scale of each point's own: points x K."""
    return _rows(f, branch, x)[0]


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
    found.sort(key=lambda s: s[0])
    crossings = _corners(f, g, most)  # first: these do cross, where a small linear distance may lead nowhere
    return [*crossings, *(start for start in found[: 2 * most] if np.isfinite(start[0]))]


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
    """|f|, its size, and the t, x, u that solve the linearized equation with the smallest t."""
    a, slopes = coefficients_at(f, u)
    rows, along = _rows(f, branch, np.array([x]))
    value, size = complex((rows @ a)[0]), float((np.abs(rows) @ f.size())[0])
    turned = None if x == 0 else complex((along @ a)[0])
    free = np.array([n > 1 for n in f.shape], dtype=bool)
    moved = np.where(free, (rows @ slopes.T)[0], 0)
    scale = max(np.abs(moved).max(initial=0.0), abs(turned or 0.0))
    if not (0 < scale < np.inf and abs(value) < 1e12 * scale):
        return None
    line = _Line(value / scale, moved / scale, None if turned is None else turned / scale)
    room = np.where(free, np.maximum(-trust, -u), 0), np.where(free, np.minimum(trust, 1 - u), 0)
    found = _reached(line, _sides(g, u, free), room, trust) or _programmed(
        line, _sides(g, u, free), room, trust
    )
    if found is None:
        return None
    t, du, dx = found
    return abs(value), size, t, x * float(np.exp(dx)), np.clip(u + du, 0, 1)


class _Line(NamedTuple):
    """value + moved du + turned d ln x = 0; none of the last where x stands."""

    value: complex
    moved: ComplexArray
    turned: complex | None


class _Sides(NamedTuple):
    """Of box(t) as seen from u: middle - t below <= du <= middle + t above on the axes that grow."""

    grows: Any
    middle: FloatArray
    below: FloatArray
    above: FloatArray


def _sides(g: Growth, u: FloatArray, free: Any) -> _Sides:
    slope, grows = g.slopes(u), g.grows & free
    unit = np.where(slope == 0, 1, slope)
    below, above = np.where(unit > 0, g.down, g.up), np.where(unit > 0, g.up, g.down)
    return _Sides(grows, (g.nominal - g.parameters(u)) / unit, below / np.abs(unit), above / np.abs(unit))


Move = tuple[float, "FloatArray", float]  # t, du, d ln x


def _reached(line: _Line, sides: _Sides, room: tuple[FloatArray, FloatArray], trust: float) -> Move | None:
    """The smallest t in closed form, where d ln x is free; None where there is none within the trust region.

    Without ln x one real equation s du = h is left, and the largest s du in box(t) is piecewise linear in t.
    """
    turn = 1.0 if line.turned is None else 1j * np.conj(line.turned) / max(abs(line.turned), 1e-300)
    h, s = -(turn * line.value).real, (turn * line.moved).real
    s = np.where(np.abs(s) > 1e-12 * np.abs(s).max(initial=0.0), s, 0)
    (low, high), (grows, middle, below, above) = room, sides
    with np.errstate(all="ignore"):
        outside = np.where(
            middle > high, (middle - high) / below, np.where(middle < low, (low - middle) / above, 0)
        )
    t = float(np.where(grows, outside, 0).max(initial=0.0))
    if not t < np.inf:
        return None

    def end(t: float, s: FloatArray) -> FloatArray:
        """du of the largest s du in box(t)."""
        top = np.where(grows, np.minimum(high, middle + t * above), high)
        bottom = np.where(grows, np.maximum(low, middle - t * below), low)
        rest = np.clip(
            np.where(grows, middle, 0), bottom, top
        )  # what does not act stays nominal, or where it is
        return np.asarray(np.where(s > 0, top, np.where(s < 0, bottom, rest)))

    most, least = end(t, s), end(t, -s)
    if s @ most < h:
        t, du = _grown(t, s, h, end, sides, room)
    elif s @ least > h:
        t, du = _grown(t, -s, -h, end, sides, room)
    else:
        span = float(s @ (most - least))
        du = least + (most - least) * ((h - s @ least) / span if span > 0 else 0.5)
    if not t < np.inf:
        return None
    left = line.value + line.moved @ du
    if line.turned is None:
        return t, du, 0.0
    dx = -float((np.conj(line.turned) * left).real) / max(abs(line.turned) ** 2, 1e-300)
    return (t, du, dx) if abs(dx) <= trust else None


def _grown(
    t: float, s: FloatArray, h: float, end: Any, sides: _Sides, room: tuple[FloatArray, FloatArray]
) -> tuple[float, FloatArray]:
    """The smallest t from which on box(t) holds a du with s du = h; infinite where the trust region ends before."""
    (low, high), (grows, middle, below, above) = room, sides
    with np.errstate(all="ignore"):
        full = np.where(
            s > 0, (high - middle) / above, (middle - low) / below
        )  # where an axis has no more room
        rate = np.where(grows & (s != 0), np.abs(s) * np.where(s > 0, above, below), 0)
    for stop in [*np.sort(full[(rate > 0) & (full > t)]).tolist(), np.inf]:
        pull = float(rate[full > t].sum())
        missing = h - float(s @ end(t, s))
        if pull > 0 and t + missing / pull <= stop:
            t += missing / pull
            return t, end(t, s)
        t = stop
        if not np.isfinite(t):
            break
    return np.inf, np.zeros(len(s))


def _programmed(line: _Line, sides: _Sides, room: tuple[FloatArray, FloatArray], trust: float) -> Move | None:
    """The smallest t with d ln x within the trust region, by a linear program."""
    from scipy.optimize import linprog

    k = len(line.moved)
    if line.turned is None:
        return None
    columns = np.concatenate([line.moved, [line.turned, 0]])
    limits, most = [], []
    for i in np.flatnonzero(sides.grows):
        for sign, rate in ((1.0, sides.above[i]), (-1.0, sides.below[i])):
            row = np.zeros(k + 2)
            row[i], row[-1] = sign, -rate
            limits.append(row / max(1.0, rate))
            most.append(sign * sides.middle[i] / max(1.0, rate))
    bounds: list[tuple[float, float | None]] = list(zip(*(side.tolist() for side in room), strict=True))
    found = linprog(
        np.eye(k + 2)[-1],
        np.array(limits) if limits else None,
        most or None,
        np.array([columns.real, columns.imag]),
        [-line.value.real, -line.value.imag],
        [*bounds, (-trust, trust), (0, None)],
        method="highs",
    )
    if found.status != 0:
        return None
    moves: Any = found.x
    return float(moves[-1]), np.asarray(moves[:k]), float(moves[k])


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
