"""Zeros of a(jw; p): the values and derivatives of a family at points, and starts for a descent to a zero."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.proof.exclusion import Growth, OpenCell, cover
from malta.proof.polynomial.family import Family, basis
from malta.work import is_past

STEPS = 8  # of the frequency grid in an octave
SPACING = 0.6 / STEPS  # half a step and more, in ln w
HALVINGS = 6  # of the way to a corner, of which the descent follows the rest
STARTS = 6  # of descents, of each kind
DESCENT, POINT = 9e-4, 1.4e-5  # work of a step of a descent, and of linear distances at a frequency
ROOTS = 6e-5  # work of the roots at a place
VALUE = 2e-8  # work of each coefficient of the family at a place
ENDS = ((0, 0.0), (1, 0.0))  # w = 0 and w = infinity


@dataclass(frozen=True, eq=False)
class Zero:
    """A zero of f at frequency x of a branch and parameters u; t is the smallest box that contains them."""

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
    found = f.values.reshape(1, len(f.values), *f.shape)  # a, then its derivatives, last parameters first
    for n, x in zip(reversed(f.shape), reversed(u.tolist()), strict=True):
        moved = found[:1] @ _slope(n - 1, x) if n > 1 else np.zeros((1, *found.shape[1:-1]))
        found = np.concatenate([found @ basis(n - 1, np.array(x)) if n > 1 else found[..., 0], moved])
    return found[0], found[:0:-1]


def _slope(degree: int, u: float) -> FloatArray:
    if degree == 0:
        return np.zeros(1)
    low = basis(degree - 1, np.array(u))
    return np.asarray(degree * (np.append(0.0, low) - np.append(low, 0.0)))


def rows_and_slopes(f: Family, branch: int, x: Any) -> tuple[ComplexArray, ComplexArray]:
    """Weights of a_k in f(x) and in x f'(x) at points x of a branch, scaled alike: points x K each."""
    n = f.degree
    k = np.arange(n + 1)
    power = n - k if branch else k
    x = np.atleast_1d(np.asarray(x))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.where(power == 0, 0.0, power * np.log2(np.abs(x)))
        shift = (logs + f.levels).max(axis=1, keepdims=True)
        turn = (k - n if branch else k) % 4  # the last coefficient, alone at infinity, is real there
        weights = np.exp2(np.clip(logs + f.powers - shift, -1070, 1000)) * 1j**turn
    if np.iscomplexobj(x):
        weights = weights * np.exp(1j * power * np.angle(x))
    return weights, weights * power


def linear_distance(
    f: Family, g: Growth, u: FloatArray, branch: int, x: FloatArray, at: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """The smallest t at which the linearization about u vanishes, at each of the frequencies x.

    at : `coefficients_at` u
    """
    a, slopes = at
    rows, by_x = rows_and_slopes(f, branch, x)
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


def starts(f: Family, g: Growth) -> list[tuple[float, int, float, FloatArray]]:
    """Starts of descents (estimated t, branch, x, u): small linear distances along frequency, and unstable corners."""
    cells = cover(f)
    inner = cells[(cells[:, 0] == 0) & (cells[:, 1] > 0)]
    found: list[tuple[float, int, float, FloatArray]] = []
    centre = g.shares(g.nominal)
    fixed = [
        np.array([c]) if grows or not width or n == 1 else np.array([0.5, 0.0, 1.0])
        for c, grows, width, n in zip(centre, g.grows, g.high - g.low, f.shape, strict=True)
    ]
    places = [np.array(place) for place in itertools.islice(itertools.product(*fixed), 27)]
    x = np.geomspace(inner[0, 1], inner[-1, 2], STEPS * len(inner)) if len(inner) else np.ones(1)
    for u in places:
        if is_past(price=POINT * len(x) + VALUE * f.values.size):
            break
        at = coefficients_at(f, u)
        t = linear_distance(f, g, u, 0, x, at)
        low = np.flatnonzero((t <= np.r_[np.inf, t[:-1]]) & (t <= np.r_[t[1:], np.inf]) & np.isfinite(t))
        for k in low[np.argsort(t[low])][:STARTS]:
            found.append((float(t[k]), 0, float(x[k]), u))
        for branch, end in ENDS:
            found.append((float(linear_distance(f, g, u, branch, np.array([end]), at)[0]), branch, end, u))
    found.sort(key=lambda s: s[0])
    crossings = _corners(f, g)  # first: these do cross, where a small linear distance may lead nowhere
    return [*crossings, *(start for start in found[: 2 * STARTS] if np.isfinite(start[0]))]


def _corners(f: Family, g: Growth) -> list[tuple[float, int, float, FloatArray]]:
    """The first loss of stability, by the roots, on the ways from the nominal values to corners of the box."""
    free = [i for i, n in enumerate(f.shape) if n > 1 and g.high[i] > g.low[i]]
    if not free:
        return []
    rng = np.random.default_rng(0)
    signs = (
        np.array(list(itertools.product((0.0, 1.0), repeat=len(free))))
        if len(free) <= 6
        else rng.integers(0, 2, (64, len(free))).astype(float)
    )
    centre, grows = g.shares(g.nominal), g.grows
    if grows[free].sum() == 1:  # its ends in the middle of all others as well
        signs = np.vstack([signs, np.where(grows[free], [[0.0], [1.0]], centre[free])])
    found = []
    for row in signs:
        if is_past(price=(HALVINGS + 2) * (ROOTS + VALUE * f.values.size)):
            break
        end = centre.copy()
        end[free] = row
        start = np.where(grows, centre, end)
        if _worst_root(f, end)[0] <= 0:
            continue
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (
                (low, middle) if _worst_root(f, start + middle * (end - start))[0] > 0 else (middle, high)
            )
        u = start + high * (end - start)
        at = _worst_root(f, u)[1]
        found.append((float(g.margin(g.parameters(u))), 0, at, u))
    found.sort(key=lambda s: s[0])
    return found[:STARTS]


def _worst_root(f: Family, u: FloatArray) -> tuple[float, float]:
    """The real part of the rightmost root over its size, and |imaginary part| in units of x."""
    a, _ = coefficients_at(f, u)
    exponents = np.array(f.exponents) - max(f.exponents)
    roots = np.roots(np.ldexp(a, np.maximum(exponents, -1000))[::-1])
    if not len(roots):
        return -1.0, 0.0
    worst = roots[(roots.real / np.maximum(np.abs(roots), 1e-300)).argmax()]
    return float(worst.real / max(abs(worst), 1e-300)), float(abs(worst.imag))


def gradients(f: Family, zero: Zero) -> tuple[ComplexArray, complex]:
    """The derivatives of f at a zero, with respect to u and to ln w."""
    a, slopes = coefficients_at(f, zero.u)
    rows, along = rows_and_slopes(f, zero.branch, np.array([zero.x]))
    by_x = complex((along @ a)[0]) * (-1 if zero.branch else 1)
    return np.asarray((rows @ slopes.T)[0]), by_x


# The descent to the nearest loss of stability: the smallest t with a(jw; p) = 0 for some w and some p in box(t).
#
# A root x of a(jx; p) is followed as p moves. Its angle Im ln x is zero on the boundary of stability and a smooth
# function of p: one real equation. Each step linearizes this equation and finds in closed form the smallest t that
# solves it within a trust region: Newton's method, which uses its free directions to reduce t. At w = 0 and at
# infinity (the Nyquist frequency) the equation is that of one real coefficient.


MAX_DESCENT_STEPS = 60  # steps of a descent
DESCENT_LIMIT = 1.2  # a descent ends beyond this multiple of the smallest t known
MIN_DESCENT_GAIN = 1e-9  # relative gain of a step below which a descent ends
MAX_ROOT_MOVE = 1.5  # |change of ln x| beyond which a root counts as another one
SAME_ROOT_DISTANCE = 0.3  # |change of ln x| within which a root belongs to its start


class _Place(NamedTuple):
    """A root at u, or an end of the frequencies: value + moved du = 0 is the linearized equation."""

    x: complex
    u: FloatArray
    t: float
    value: float
    moved: FloatArray


def nearest(f: Family, g: Growth, branch: int, x: float, u: FloatArray, below: float) -> Zero | None:
    """Descend from a start to a zero of f of smallest t; None when none with t below `below` is found."""
    here = _find_root(f, g, branch, x, u, below)
    trust, widest, best = 0.5, 1.0, None
    for k in range(MAX_DESCENT_STEPS if here is not None else 0):
        assert here is not None
        if is_past(price=DESCENT + 3 * VALUE * f.values.size):
            break
        found = _smallest_step(f, g, here, trust)
        if found is None:  # nothing within the trust region solves the equation
            if trust >= widest:
                break
            trust = min(2 * trust, widest)
            continue
        t, cost, du = found
        left = here.t + cost * abs(here.value) - t
        if (k > 2 and t > DESCENT_LIMIT * below) or t - 3 * left > below:
            break
        there = _follow_root(f, g, branch, here.x, np.clip(here.u + du, 0, 1))
        gain = -np.inf if there is None else left - (there.t + cost * abs(there.value) - t)
        if abs(here.value) < 1e-9:
            zero = _as_zero(f, branch, here)
            best = zero if zero is not None and (best is None or zero.t < best.t) else best
            if zero is not None and left <= MIN_DESCENT_GAIN * here.t:
                break
        if there is None or gain < 0.1 * left:
            trust = widest = min(trust, float(np.abs(du).max(initial=0.0))) / 3
            if trust < 1e-8:
                break
            continue
        here, widest = there, 1.0
        if gain > 0.6 * left:
            trust = min(2 * trust, 1.0)
    return best if best is None or best.t < below else None


def _as_zero(f: Family, branch: int, here: _Place) -> Zero | None:
    """The place as a zero if f vanishes there to rounding, else None."""
    x = abs(here.x)
    a, _ = coefficients_at(f, here.u)
    rows, _ = rows_and_slopes(f, branch, x)
    small = _modulus(complex((rows @ a)[0])) <= 1e-11 * float((np.abs(rows) @ f.size())[0])
    return Zero(here.t, branch, x, here.u) if small else None


def _find_root(f: Family, g: Growth, branch: int, x: complex, u: FloatArray, below: float) -> _Place | None:
    """The root next to x if it is near the boundary, else one near a place that the linearized equation leads to."""
    if x == 0:
        return _follow_root(f, g, branch, 0.0, u)
    for _ in range(12):
        here = _follow_root(f, g, branch, x, u, SAME_ROOT_DISTANCE)
        if here is not None:
            return here
        a, slopes = coefficients_at(f, u)
        rows, along = rows_and_slopes(f, branch, x)
        value, turned, moved = complex((rows @ a)[0]), complex((along @ a)[0]), (rows @ slopes.T)[0]
        turn = np.conj(1j * turned)
        t = float(g.margin(g.parameters(u)))
        place = _Place(x, u, t, float((turn * value).real), (turn * moved).real)
        found = _smallest_step(f, g, place, 0.5)
        if found is None or found[0] > below:
            return None
        u = np.clip(u + found[2], 0, 1)
        x *= float(np.exp(np.clip(-((value + moved @ found[2]) / turned).real, -0.5, 0.5)))
    return None


def _follow_root(
    f: Family, g: Growth, branch: int, x: complex, u: FloatArray, far: float = MAX_ROOT_MOVE
) -> _Place | None:
    """The root next to x at u, by Newton's method in ln x; None when ln x changes by more than `far`."""
    a, slopes = coefficients_at(f, u)
    t = float(g.margin(g.parameters(u)))
    if x == 0:
        rows, _ = rows_and_slopes(f, branch, 0.0)
        value, moved = float((rows @ a).real[0]), (rows @ slopes.T).real[0]
        scale = max(float(np.abs(moved).max(initial=0.0)), 1e-300)
        return _Place(0.0, u, t, value / scale, moved / scale)
    first = x
    for _ in range(15):
        rows, along = rows_and_slopes(f, branch, complex(x))
        turned = complex((along @ a)[0])
        step = complex((rows @ a)[0]) / turned if turned else np.inf
        if not np.isfinite(step) or abs(np.log(x / first)) > far:
            return None
        x = x * np.exp(-step if abs(step) < 0.5 else -0.5 * step / abs(step))
        if abs(step) < 1e-9:  # the next step would be below rounding
            moved = -(rows @ slopes.T)[0] / turned
            return _Place(complex(x), u, t, float(np.angle(x)), moved.imag)
    return None


class _Sides(NamedTuple):
    """The sides of box(t) seen from u: middle - t below <= du <= middle + t above on the axes that grow."""

    grows: Any
    middle: FloatArray
    below: FloatArray
    above: FloatArray


def _sides(g: Growth, u: FloatArray, free: Any) -> _Sides:
    slope, grows = g.slopes(u), g.grows & free
    unit = np.where(slope == 0, 1, slope)
    below, above = np.where(unit > 0, g.down, g.up), np.where(unit > 0, g.up, g.down)
    return _Sides(grows, (g.nominal - g.parameters(u)) / unit, below / np.abs(unit), above / np.abs(unit))


def _smallest_step(
    f: Family, g: Growth, here: _Place, trust: float
) -> tuple[float, float, FloatArray] | None:
    """The smallest t whose box contains a solution du of the linearized equation, t per unit of the value, and du.

    The equation is s du = h, and the largest s du in box(t) is piecewise linear in t. None: no t solves it.
    """
    free = np.array([n > 1 for n in f.shape], dtype=bool)
    u, sides = here.u, _sides(g, here.u, free)
    low, high = np.where(free, np.maximum(-trust, -u), 0), np.where(free, np.minimum(trust, 1 - u), 0)
    h, s = -here.value, np.where(free, here.moved, 0)
    s = np.where(np.abs(s) > 1e-12 * np.abs(s).max(initial=0.0), s, 0)
    grows, middle, below, above = sides
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
        rest = np.clip(np.where(grows, middle, 0), bottom, top)  # axes without effect stay nominal, or at u
        return np.asarray(np.where(s > 0, top, np.where(s < 0, bottom, rest)))

    most, least = end(t, s), end(t, -s)
    if s @ most < h:
        t, du = _grow_box(t, s, h, end, sides, (low, high))
    elif s @ least > h:
        t, du = _grow_box(t, -s, -h, end, sides, (low, high))
    else:
        span = float(s @ (most - least))
        du = least + (most - least) * ((h - s @ least) / span if span > 0 else 0.5)
    if not t < np.inf:
        return None
    pull = float(np.where(grows, np.abs(s) * np.minimum(below, above), 0).sum())
    return t, 2 / max(pull, 1e-9), du


def _grow_box(
    t: float, s: FloatArray, h: float, end: Any, sides: _Sides, room: tuple[FloatArray, FloatArray]
) -> tuple[float, FloatArray]:
    """The smallest t whose box contains a du with s du = h; infinite when the trust region ends before."""
    (low, high), (grows, middle, below, above) = room, sides
    with np.errstate(all="ignore"):
        full = np.where(s > 0, (high - middle) / above, (middle - low) / below)  # t of the trust region
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


def from_cell(f: Family, g: Growth, cell: OpenCell, below: float) -> Zero | None:
    """A zero with t below `below` in a cell that resists: the zero next to its middle, and the descent from there."""
    low, high = cell.interval
    u, best = cell.box.mean(axis=1), None
    for x in ((low + high) / 2, *([0.0] if low == 0 else [])):
        is_past(price=DESCENT + 5 * VALUE * f.values.size)
        near = project(f, g, cell.branch, x, u)
        if near is not None and near.t < (best.t if best is not None else below):
            best = near
    if best is None:
        return None
    if best.t <= 1.01 * cell.smallest:
        return best
    further = nearest(f, g, best.branch, best.x, best.u, best.t)
    return further if further is not None and further.t < best.t else best


def project(f: Family, g: Growth, branch: int, x: float, u: FloatArray) -> Zero | None:
    """The zero next to a place, by Newton's method with steps of least norm; None when it leaves the box."""
    free = np.array([n > 1 for n in f.shape])
    for _ in range(30):
        a, slopes = coefficients_at(f, u)
        rows, along = rows_and_slopes(f, branch, x)
        value, size = complex((rows @ a)[0]), float((np.abs(rows) @ f.size())[0])
        if _modulus(value) <= 1e-12 * size:
            return Zero(float(g.margin(g.parameters(u))), branch, x, u)
        moved, turned = (rows @ slopes.T)[0] * free, complex((along @ a)[0])
        columns = moved if x == 0 else np.append(moved, turned)
        J = columns.real[None] if x == 0 else np.array([columns.real, columns.imag])
        right = np.array([value.real]) if x == 0 else np.array([value.real, value.imag])
        if not (np.isfinite(J).all() and np.isfinite(right).all()):
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


def _modulus(z: complex) -> float:
    """|z|; infinite on overflow, for which abs() raises an error."""
    return math.hypot(z.real, z.imag)
