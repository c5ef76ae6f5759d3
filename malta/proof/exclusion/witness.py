"""Zeros of a(jw; p): the values and derivatives of a family at points, and starts for a descent to a zero."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.proof.exclusion.exclusion import Growth
from malta.proof.exclusion.frequency import cover
from malta.proof.polynomial.family import Family, basis
from malta.proof.time_limit import is_late

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

STEPS = 8  # of the frequency grid in an octave
SPACING = 0.6 / STEPS  # half a step and more, in ln w
HALVINGS = 6  # of the way to a corner, of which the descent follows the rest
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


def rows_at(f: Family, branch: int, x: FloatArray) -> ComplexArray:
    """Weights of a_k in f(x) at points of a branch, on a scale of each point's own: points x K."""
    return rows_and_slopes(f, branch, x)[0]


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


def linear_distance(f: Family, g: Growth, u: FloatArray, branch: int, x: FloatArray) -> FloatArray:
    """The smallest t at which the linearization about u vanishes, at each of the frequencies x."""
    a, slopes = coefficients_at(f, u)
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


def starts(f: Family, g: Growth, most: int = 6) -> list[tuple[float, int, float, FloatArray]]:
    """Starts of descents (estimated t, branch, x, u): small linear distances along frequency, and unstable corners."""
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
        if is_late():
            break
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
    """The first loss of stability, by the roots, on the ways from the nominal values to corners of the box."""
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
        if is_late():
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
    return found[:most]


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
