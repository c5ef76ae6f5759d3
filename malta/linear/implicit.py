"""Functions r(p) that equations F(p, r) = 0 define: their values, and enclosures over complex balls of p.

r(p) is the root that is reached from a known one, r(p_0), along the straight line from p_0 to p. Over a ball P of
parameters it is enclosed in tubes c + S (p - m) + w, each with exactly one root for every p of its region (Krawczyk):

    |Y F(p, c + S (p - m))| + |1 - Y F_r| w < w        Y: about F_r^-1;  S: about -Y F_p

The regions cover the convex hull of p_0 and P, and two that follow each other have the same root at a point of both.
So r is one analytic function there, and of all balls that are enclosed the same. Once all of a real box is enclosed so,
the line from p_0 to a point of the box is enough for a ball about it, complex ones included: the box is convex.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from flint import acb, acb_mat, arb, ctx

from malta.arrays import ComplexArray, FloatArray
from malta.work import check_clock

TRIES = 6  # of radii of a tube
GROWTH = 1.25  # of these from one try to the next
BEGINNINGS = tuple(k / 16 for k in range(15, 3, -1))  # of the way to a ball, that a known tube may have
MOST_SLICES, MIN_SLICE = 64, 2.0**-20  # of the way to a ball, that are tried; and how short one may be
NEWTON_STEPS = 80  # of a centre, each of which finds some twelve digits
MOST_HALVES = 5  # times that a ball is cut
MOST_TUBES = 256  # that are remembered
POINT_BITS, TUBE_BITS = 8, 10  # of the radius of what is enclosed: units in the last place
LOOSE_BITS = 44  # that are enough in the middle of a region: a root in floating point has them
WIDENING = 1.0625  # times a region that further balls will be in

Slopes = tuple[Any, Any, Any]  # F (k x 1), F_r (k x k), F_p (k x n) as acb_mat
# at balls of p and r; None where they are not analytic
Equations = Callable[[Sequence[Any], Sequence[Any]], "Slopes | None"]


class RootTube(NamedTuple):
    """For each p of a region one root r in discs of radius w about c + S (p - m), and this one within `most`."""

    region: tuple[Any, ...]
    m: tuple[Any, ...]  # the middle of the region, exactly
    c: tuple[Any, ...]  # exactly
    S: Any
    w: tuple[Any, ...]
    most: tuple[Any, ...]

    def centre(self, p: Sequence[Any]) -> list[Any]:
        """c + S (p - m)."""
        moved = self.S * acb_mat(len(p), 1, [x - m for x, m in zip(p, self.m, strict=True)])
        return [c + moved[i, 0] for i, c in enumerate(self.c)]

    def at(self, p: Sequence[Any]) -> list[Any]:
        """An enclosure of the root for all p of a part of the region."""
        real = _are_real([*p, *self.c])
        return [c + _disc(w, real) for c, w in zip(self.centre(p), self.most, strict=True)]

    def has(self, other: RootTube) -> bool:
        """Whether the root of another tube, at the one point that is its region, is the root of this one there."""
        gaps = zip(self.centre(other.m), other.c, other.most, self.w, strict=True)
        return all(abs(c - own) + most < w for c, own, most, w in gaps)


@dataclass(frozen=True, eq=False)
class ImplicitRoot:
    """The root that is `near` at nominal p, with the tubes that are known."""

    equations: Equations
    root: Callable[[FloatArray], FloatArray]  # in floating point; not a number where none is found
    nominal: FloatArray
    near: FloatArray
    known: list[RootTube] = field(default_factory=list)  # with all lines from nominal p
    along: list[RootTube] = field(default_factory=list)  # with one line from there
    last: dict[Any, list[Any] | None] = field(default_factory=dict)  # what was asked for

    @cached_property
    def start(self) -> RootTube | None:
        """The root at nominal p."""
        p = tuple(acb(x) for x in self.nominal.tolist())
        return self._over(p, [acb(x) for x in self.near.tolist()])

    def enclose(self, p: Sequence[Any], *, is_one: bool = True) -> list[Any] | None:
        """An enclosure of r over balls of p; None where it is not proven that there is one function.

        p : n complex balls
        is_one : whether the middle of p is among real balls that were enclosed before, where the function is known to
            be one: then the line to it is enough. Else all lines are looked at.
        """
        P = tuple(acb(x) for x in p)
        check_clock()
        parts = (part for x in P for one in (x.real, x.imag) for part in (one.mid(), one.rad()))
        key = (ctx.prec, is_one, *parts)
        if key not in self.last:  # each entry of the root is asked for by itself
            if len(self.last) >= MOST_TUBES:
                self.last.clear()
            self.last[key] = self._enclosure(P, is_one=is_one)
        return self.last[key]

    def _enclosure(self, P: tuple[Any, ...], *, is_one: bool) -> list[Any] | None:
        lists = (self.known, self.along) if is_one else (self.known,)
        known = next((t for tubes in lists for t in tubes if _contains(t.region, P)), None)
        if known is None:
            reach = self._reach_along if is_one else self._reach
            known = next((t for t in map(reach, self._regions(P)) if t is not None), None)
            if known is None:
                return self._by_halves(P, is_one=is_one)
            lists[-1].insert(0, known)
            del lists[-1][MOST_TUBES:]
        tube = self._over(P, known, TUBE_BITS)
        if tube is None:
            return known.at(P)
        is_point = all(x == y for x, y in zip(P, tube.m, strict=True))
        same = known.has(tube) if is_point else self._are_same(known, tube, tube.m)
        return (tube if same else known).at(P)

    def _by_halves(self, P: tuple[Any, ...], *, is_one: bool) -> list[Any] | None:
        """An enclosure by those over parts of P, whose roots agree on what they share; None for too many parts."""
        tubes = self._cover(P, None, MOST_HALVES) if is_one and self._has_ends(P) else None
        m = _real_middle(P)
        own = None if tubes is None else next((tube for tube in tubes if _contains(tube.region, m)), None)
        if tubes is None or own is None or not self._is_linked(own, m):
            return None
        self.along[:0] = tubes
        del self.along[MOST_TUBES:]
        found = [tube.at(tube.region) for tube in tubes]
        return [_union(values) for values in zip(*found, strict=True)]

    def _has_ends(self, P: tuple[Any, ...]) -> bool:
        """Whether the root is found at the ends of each side of P, in floating point."""
        middle = np.array([float(x.real.mid()) for x in P])
        for k, x in enumerate(P):
            for end in (x.real.lower(), x.real.upper()):
                p = middle.copy()
                p[k] = float(end)
                if not np.isfinite(self.root(p)).all():
                    return False
        return True

    def _cover(self, P: tuple[Any, ...], beside: RootTube | None, depth: int) -> list[RootTube] | None:
        """Tubes of one root over parts of P, which is cut in halves `depth` times at most.

        beside : a tube from which the root is looked for
        """
        tube = self._whole(P) if beside is None else self._over(P, beside)
        if tube is not None:
            return [tube]
        if depth == 0:
            return None
        one, two, shared = _halves(P, self.nominal)
        first = self._cover(one, beside, depth - 1)
        near = None if first is None else next((t for t in first if _contains(t.region, shared)), None)
        if first is None or near is None:
            return None
        second = self._cover(two, near, depth - 1)
        other = None if second is None else next((t for t in second if _contains(t.region, shared)), None)
        if second is None or other is None or not self._are_same(near, other, shared):
            return None
        return first + second

    def _regions(self, P: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        """Regions that hold P, the largest first, as what is asked for next may be in them."""
        hull = [acb(x).union(y) for x, y in zip(self.nominal.tolist(), P, strict=True)]
        return [tuple(m + WIDENING * (x - m) for x, m in zip(hull, _middle(hull), strict=True)), P]

    def _reach(self, P: tuple[Any, ...]) -> RootTube | None:
        """A tube over P whose root is that of the nominal p, along all lines from there."""
        whole = self._whole(P)
        if self.start is None or whole is None:
            return None
        if _contains(P, self.start.m):  # P is the hull itself
            return whole if self._are_same(self.start, whole, self.start.m) else None
        last = self._follow(P, *self._find_beginning(P, self.known))
        return whole if last is not None and self._are_same(last, whole, _middle(P)) else None

    def _reach_along(self, P: tuple[Any, ...]) -> RootTube | None:
        """A tube over P whose root is that of the nominal p along the line to its middle, which has to be real."""
        whole = self._whole(P)
        return whole if whole is not None and self._is_linked(whole, _real_middle(P)) else None

    def _is_linked(self, tube: RootTube, m: tuple[Any, ...]) -> bool:
        """Whether the root of a tube at a real point m is that of the nominal p along the line from there."""
        tubes = (*self.known, *self.along)
        last = next((one for one in tubes if _contains(one.region, m)), None)
        if last is None and self.start is not None:
            last = self._follow(m, *self._find_beginning(m, tubes))
        return last is not None and self._are_same(last, tube, m)

    def _find_beginning(self, P: tuple[Any, ...], tubes: Sequence[RootTube]) -> tuple[float, RootTube]:
        """How far on the way to P one of these tubes reaches, and this one; else where the way begins."""
        assert self.start is not None
        for t in BEGINNINGS:
            there = self._slice(P, t, t)
            for tube in tubes:
                if _contains(tube.region, there):
                    return t, tube
        return 0.0, self.start

    def _whole(self, P: tuple[Any, ...]) -> RootTube | None:
        """A tube over P about a root in its middle."""
        near = self.root(np.array([complex(x.mid()).real for x in P]))
        return self._over(P, [acb(x) for x in near.tolist()]) if np.isfinite(near).all() else None

    def _follow(self, P: tuple[Any, ...], t: float, tube: RootTube) -> RootTube | None:
        """The last of the tubes over slices of the way to P, from a known one on; None where they end before."""
        size = 1.0 - t
        for _ in range(MOST_SLICES):
            end = min(t + size, 1.0)
            following = self._over(self._slice(P, t, end), tube)
            if following is not None and self._are_same(tube, following, self._on_line(P, t)):
                tube, t, size = following, end, 1.2 * size
            else:
                size /= 4 if t == 0 else 1.6
            if t == 1 or size < MIN_SLICE:
                break
        return tube if t == 1 else None

    def _slice(self, P: Sequence[Any], t: float, end: float) -> tuple[Any, ...]:
        """p_0 + s (P - p_0) for all s from t to the end."""
        share = acb(arb(t).union(arb(end)))
        return tuple(acb(x) + share * (y - x) for x, y in zip(self.nominal.tolist(), P, strict=True))

    def _on_line(self, P: Sequence[Any], t: float) -> tuple[Any, ...]:
        """A point about p_0 + t (middle of P - p_0), which is in every slice that begins or ends there."""
        line = (acb(x) + t * (m - x) for x, m in zip(self.nominal.tolist(), _middle(P), strict=True))
        return _middle(list(line))

    def _are_same(self, one: RootTube, two: RootTube, p: Sequence[Any]) -> bool:
        """Whether the roots of two tubes are the same at a point p of both regions."""
        if not (_contains(one.region, p) and _contains(two.region, p)):
            return False
        here = self._over(tuple(p), two.centre(p), POINT_BITS)
        return here is not None and one.has(here) and two.has(here)

    def _over(
        self, P: tuple[Any, ...], start: RootTube | Sequence[Any], bits: int | None = None
    ) -> RootTube | None:
        """A tube over P about the root in its middle that Newton's method finds from there; None where there is none.

        bits : of rounding that its radius has at least, as units in the last place of the root; None: many, for a tube
            that others are compared with
        """
        m = _middle(P)
        middle = self._centre(m, start.centre(m) if isinstance(start, RootTube) else start, bits)
        if middle is None:
            return None
        c, at, Y = middle
        S = _numbers(-(Y * at[2]))
        left, k, n = Y * at[0], len(c), len(P)
        dp = acb_mat(n, 1, [x - y for x, y in zip(P, m, strict=True)])
        real, line = _are_real([*P, *c]), S * dp
        least = [_rounding(x, bits) for x in c]
        w = [GROWTH * _above(left[i, 0]) + least[i] for i in range(k)]
        for _ in range(TRIES):
            found = self.equations(P, [c[i] + line[i, 0] + _disc(w[i], real) for i in range(k)])
            if found is None:
                return None
            _, J, D = found
            moved, slope = Y * (D + J * S) * dp, Y * J
            N = [[_above((i == j) - slope[i, j]) for j in range(k)] for i in range(k)]
            if not _is_below_one(N):
                return None
            need = [
                _above(left[i, 0] + moved[i, 0]) + sum((a * b for a, b in zip(N[i], w, strict=True)), arb(0))
                for i in range(k)
            ]
            if all(a < b for a, b in zip(need, w, strict=True)):
                return RootTube(P, m, tuple(c), S, tuple(w), tuple(a.upper() for a in need))
            w = [(GROWTH * a).upper() + x for a, x in zip(need, least, strict=True)]
            if not all(x.is_finite() for x in w):
                return None
        return None

    def _centre(
        self, m: Sequence[Any], start: Sequence[Any], bits: int | None
    ) -> tuple[list[Any], Slopes, Any] | None:
        """About the root at a point, without radii, the equations there, and about the inverse of their slope."""
        c, before = list(_middle(start)), None
        for _ in range(NEWTON_STEPS):
            at = self.equations(m, c)
            Y = None if at is None else _inverse(at[1])
            if at is None or Y is None:
                return None
            step = Y * at[0]
            size = [_above(step[i, 0]) for i in range(len(c))]
            if all(a <= _rounding(x, bits) for a, x in zip(size, c, strict=True)):
                return c, at, Y
            if before is not None and not any(a < b / 2 for a, b in zip(size, before, strict=True)):
                return c, at, Y
            c, before = list(_middle([x - step[i, 0] for i, x in enumerate(c)])), size
        return None


def _middle(p: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(acb(x.real.mid(), x.imag.mid()) for x in p)


def _real_middle(p: Sequence[Any]) -> tuple[Any, ...]:
    """The middle without imaginary parts: around complex points a line from nominal p may pass either side of one."""
    return tuple(acb(x.real.mid()) for x in p)


def _are_real(values: Sequence[Any]) -> bool:
    return all(x.imag == 0 for x in values)


def _contains(outer: Sequence[Any], inner: Sequence[Any]) -> bool:
    return all(x.contains(y) for x, y in zip(outer, inner, strict=True))


def _is_below_one(N: Sequence[Sequence[Any]]) -> bool:
    """Whether the spectral radius of a matrix is below one, in doubles: it grows with the radii."""
    values = np.array([[float(x) for x in row] for row in N])
    return bool(np.isfinite(values).all() and np.abs(np.linalg.eigvals(values)).max() < 1)


def _halves(P: Sequence[Any], sizes: FloatArray) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    """The halves of a ball across its widest side, in multiples of `sizes`, and the middle of what they share."""
    widths = [
        (float(one.rad()) / (abs(size) or 1.0), k, part)
        for k, (x, size) in enumerate(zip(P, sizes.tolist(), strict=True))
        for part, one in enumerate((x.real, x.imag))
    ]
    _, k, part = max(widths)
    middle = _middle(P)
    cut = (middle[k].real, middle[k].imag)[part]
    side = (P[k].real, P[k].imag)[part]
    found = []
    for end in (side.lower(), side.upper()):
        half = end.union(cut)
        found.append((*P[:k], acb(half, P[k].imag) if part == 0 else acb(P[k].real, half), *P[k + 1 :]))
    return found[0], found[1], middle


def _union(values: Sequence[Any]) -> Any:
    """A ball that holds all of them."""
    found = values[0]
    for one in values[1:]:
        found = found.union(one)
    return found


def _above(z: Any) -> Any:
    """A number that is |z| or more."""
    return abs(z).upper()


def _disc(w: Any, real: bool) -> Any:
    """A rectangle about the disc of radius w; an interval where all is real."""
    side = arb(0, w)
    return acb(side) if real else acb(side, side)


def _rounding(x: Any, bits: int | None) -> Any:
    """2^bits units in the last place of x; None: half of all bits, or what a double has without some."""
    digits = max(ctx.prec // 2, ctx.prec - LOOSE_BITS) if bits is None else bits
    return _above(x) * arb(2) ** (digits - ctx.prec) + arb(2) ** (-4 * ctx.prec)


def _numbers(M: Any) -> Any:
    """The entries as doubles."""
    return acb_mat(M.nrows(), M.ncols(), [acb(complex(x)) for x in M.entries()])


def _inverse(M: Any) -> Any | None:
    """About the inverse of a matrix, by doubles; None where it has none."""
    k = M.nrows()
    values: ComplexArray = np.array([complex(x) for x in M.entries()]).reshape(k, k)
    if not np.isfinite(values).all():
        return None
    real = _are_real(M.entries())  # of which all that follows is, too
    try:
        found = np.linalg.inv(values.real if real else values)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(found).all():
        return None
    return acb_mat(k, k, [acb(x) for x in found.ravel().tolist()])
