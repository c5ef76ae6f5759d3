"""A characteristic polynomial enclosed over a box of parameters: an interpolation and a bound of its error.

With |a_k| <= M on the disc of radius R about the middle of a side (of half width 1), interpolation at the n zeros of
Chebyshev's polynomial T_n leaves out the integral of T_n(x) a(z) / (T_n(z) (z - x)) over the circle, over 2 pi j
(Hermite). There |T_n(x)| <= 1, and |T_n(z)| >= sinh(n arcosh R) as |cosh(n (a + jb))| >= sinh(n a) and
cosh^2 a = R^2 + sin^2 b, so that the error is at most M R / (R - 1) / sinh(n arcosh R).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol
from weakref import WeakKeyDictionary

from flint import acb, arb, ctx, fmpq

from malta.arrays import FloatArray
from malta.linear.expressions import NotAnalytic, exact
from malta.proof.polynomial.characteristic import pair
from malta.proof.polynomial.family import Family, family, nodes
from malta.work import check_clock, remember, spend

MOST_NODES = 20_000  # places of exact coefficients, at most
MOST_BALLS = 10_000  # places where they take an exponential: one family of all is cheaper than its halves
FEW_PLACES_LIMIT = 1500  # places beyond which more may be left out
TAILS = (2e-9, 1e-7, 3e-6)  # what interpolation may leave out, relative to each coefficient
ROUGH_TAILS = 1e-6, 3e-6  # where a thousandth of a bound is enough
MAX_TAIL = 1e-5  # beyond which the box is cut
MAX_DEGREE = 16  # degree of an interpolation along one parameter
ROUNDED_NODES = 1 + 1e-9  # factor of bounds for nodes that lie 2e-15 beside the zeros, see `remainder`
RADII = tuple(2.0**k for k in (0.5, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 14, 17, 20, 25, 32, 40))
FIRST_RADIUS = RADII.index(2.0**12)  # where the search of discs begins
FIRST_IMPLICIT_RADIUS = RADII.index(2.0**1.5)  # of roots of equations, which are not enclosed far from a box
BITS = 128  # of ball arithmetic, in which numbers of up to 128 bits take the least time
MOST_BITS = 640  # beyond which a coefficient is taken as the ball that it is
DISC = 5.0  # times the work of a place, that of a disc


class Polynomial(Protocol):
    """A characteristic polynomial: `Characteristic`, or `CoefficientPolynomial`."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def exact(self) -> bool: ...
    @property
    def foreign(self) -> tuple[str, ...]: ...
    @property
    def implicit(self) -> bool: ...
    @property
    def inverted(self) -> tuple[bool, ...]: ...
    @property
    def degrees(self) -> tuple[int | None, ...]: ...
    @property
    def price(self) -> float: ...  # work of the coefficients at one place
    def at(self, v: Sequence[Any]) -> list[Any]: ...
    def majorant(self, v: Sequence[Any]) -> list[tuple[float, int]]: ...
    def coupling_bounds(
        self, moves: Sequence[Any], sides: Sequence[tuple[Any, Any]]
    ) -> list[tuple[float, int]] | None: ...


NO_COEFFICIENTS = "the work was up before the coefficients were found"


class Unproven(Exception):
    """No enclosure of the characteristic polynomial was found; the message says why."""


class TooWide(Unproven):
    """The box is too wide along this axis for one enclosure; a narrower box may have one."""

    def __init__(self, axis: int, reason: str) -> None:
        super().__init__(reason)
        self.axis = axis


@contextmanager
def precision(bits: int) -> Iterator[None]:
    before, ctx.prec = ctx.prec, bits
    try:
        yield
    finally:
        ctx.prec = before


@dataclass(frozen=True, eq=False)
class Side:
    """The sampling of one parameter's side: degree, Chebyshev or uniform nodes, and bounds of the error."""

    degree: int
    chebyshev: bool
    tails: tuple[tuple[float, int], ...] | None


def over_box(
    f: Polynomial, sides: FloatArray, moves: Sequence[Any] = (), tails: Sequence[float] = TAILS
) -> Family:
    """The family over a box (P x 2, of p); moves: bounds of the effect of neglected couplings (closed_loop.py).

    Raises TooWide when a narrower box may have an enclosure, else Unproven; WorkUp within a work_limit.
    """
    if f.foreign:
        raise Unproven(f"the model has {f.foreign[0]}, which has no enclosure")
    low, high = ends_of(f, sides)
    with precision(BITS):
        known = f.degrees
        plan = _plan(f, low, high, known, tails)
        count = math.prod(side.degree + 1 for side in plan)
        if count > (MOST_NODES if f.exact else MOST_BALLS):
            axis = max(range(len(plan)), key=lambda i: plan[i].degree)
            if plan[axis].chebyshev:
                raise TooWide(axis, f"{count} places are too many to interpolate at")
            raise Unproven(f"{f.names[axis]} enters with degree {plan[axis].degree}: {count} coefficients")
    grid = [
        [low[i] + (high[i] - low[i]) * _share(side, k) for k in range(side.degree + 1)]
        for i, side in enumerate(plan)
    ]
    points = values_within(f, list(itertools.product(*grid)))
    ends = [(arb(a), arb(b)) for a, b in sides.tolist()]
    left = add_bounds(sum_tails(plan), f.coupling_bounds(moves, ends))
    return family([s.degree + 1 for s in plan], [s.chebyshev for s in plan], points, left)


FAMILIES: WeakKeyDictionary[Polynomial, dict[Any, tuple[Family, Sequence[float]]]] = WeakKeyDictionary()
MAX_KEPT_NUMBERS = 4_000_000  # numbers in the families of a polynomial, beyond which the oldest are forgotten


def family_over(
    f: Polynomial, sides: FloatArray, moves: tuple[Any, ...], tails: tuple[float, ...] = TAILS
) -> Family:
    """The family of a polynomial over `sides`, remembered: several margins need it over the same box."""
    known = FAMILIES.setdefault(f, {})
    key = (sides.tobytes(), tuple(pair(m) for m in moves), tails)
    found = remember(known, key, lambda: over_box(f, sides, moves, tails))
    while len(known) > 1 and sum(other.values.size for other, _ in known.values()) > MAX_KEPT_NUMBERS:
        known.pop(next(iter(known)))
    return found


def add_bounds(
    one: list[tuple[float, int]] | None, two: list[tuple[float, int]] | None
) -> list[tuple[float, int]] | None:
    """The sums of two lists of bounds."""
    if one is None or two is None:
        return one if two is None else two
    total = []
    for (a, i), (b, j) in zip(one, two, strict=True):
        top = max(i, j)
        total.append((math.ldexp(a, max(i - top, -1000)) + math.ldexp(b, max(j - top, -1000)), top))
    return total


def ends_of(f: Polynomial, sides: FloatArray) -> tuple[list[Any], list[Any]]:
    """The ends of the box in v, exactly."""
    low, high = [], []
    for (a, b), inverted in zip(sides.tolist(), f.inverted, strict=True):
        if inverted and a <= 0 <= b:
            raise Unproven("a parameter that divides reaches zero")
        ends = [exact(a), exact(b)]
        low.append(1 / ends[1] if inverted else ends[0])
        high.append(1 / ends[0] if inverted else ends[1])
    return low, high


def _share(side: Side, k: int) -> Any:
    if side.degree == 0:
        return fmpq(1, 2)
    return exact(nodes(side.degree, chebyshev=True)[k]) if side.chebyshev else fmpq(k, side.degree)


def values_within(f: Polynomial, places: list[tuple[Any, ...]]) -> list[list[Any]]:
    """The coefficients at the places, as balls accurate to 60 bits."""

    def evaluate(place: tuple[Any, ...]) -> list[Any]:
        check_clock()
        return f.at(place)

    spend(f.price * len(places))
    bits = BITS
    while True:
        try:
            with precision(bits):
                first = f.at(places[len(places) // 2])
                if f.exact or bits >= MOST_BITS or all(_is_accurate(c) for c in first):
                    return [evaluate(place) for place in places]
        except NotAnalytic as error:
            raise Unproven(f"the matrices have no value on the box: {error}") from error
        bits *= 2


def _is_accurate(c: Any) -> bool:
    return bool(c.rel_accuracy_bits() >= 66) if hasattr(c, "rel_accuracy_bits") else True


def _plan(
    f: Polynomial, low: list[Any], high: list[Any], known: tuple[int | None, ...], tails: Sequence[float]
) -> list[Side]:
    """The sampling of each side; the error is smaller when that needs few places."""
    free = [i for i, d in enumerate(known) if d is None and low[i] < high[i]]
    discs: dict[int, list[Disc]] = {}
    if free:
        middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        (nominal,) = values_within(f, [tuple(middle)])
        size = [pair(c if hasattr(c, "abs_upper") else arb(c)) for c in nominal]
        discs = {i: discs_of(f, i, low, high, size) for i in free}
    plan: list[Side] = []
    for tail in tails:
        plan = [
            interpolation_side(f.names[i], i, discs[i], tail) if i in discs
            else Side(0 if low[i] == high[i] else d or 0, False, None)
            for i, d in enumerate(known)
        ]  # fmt: skip
        if math.prod(side.degree + 1 for side in plan) <= FEW_PLACES_LIMIT:
            break
    return plan


class Disc(NamedTuple):
    """Bounds of the coefficients on a disc about the middle of a side."""

    radius: float  # in half widths of the side
    share: float  # log2 of the largest bound over the coefficient in the middle
    most: list[tuple[float, int]]


def discs_of(
    f: Polynomial, i: int, low: list[Any], high: list[Any], size: list[tuple[float, int]]
) -> list[Disc]:
    """Bounds on discs along one parameter on which the matrices are analytic.

    log2 of the bound is convex in that of the radius, so that the degree it asks for falls towards the best one and
    rises beyond.

    Raises TooWide when they are not analytic a little beyond the side.
    """
    found: list[Disc] = []
    refused = NotAnalytic("no disc about its range")
    first = FIRST_IMPLICIT_RADIUS if f.implicit else FIRST_RADIUS
    for radii in (RADII[first:], RADII[:first][::-1]):
        least = min((wanted_degree(disc, TAILS[0]) for disc in found), default=math.inf)
        if least <= 1 or (len(found) > 1 and least < wanted_degree(found[0], TAILS[0])):
            break  # larger discs are the better ones
        for radius in radii:
            spend(DISC * f.price)
            try:
                disc = _disc(f, i, low, high, size, radius)
            except NotAnalytic as error:
                refused = error
                if radius >= RADII[first]:  # nor on larger discs
                    break
                continue
            found.append(disc)
            wanted = wanted_degree(disc, TAILS[0])
            if wanted > least or wanted <= 1:
                break
            least = wanted
    if not found:
        raise TooWide(i, f"{f.names[i]}: {refused}") from refused
    return found


def _disc(
    f: Polynomial, i: int, low: list[Any], high: list[Any], size: list[tuple[float, int]], radius: float
) -> Disc:
    """Bounds on the disc of a radius along one parameter. Raises NotAnalytic where the matrices are not analytic."""
    balls = []
    for k, (a, b) in enumerate(zip(low, high, strict=True)):
        middle, half = arb((a + b) / 2), arb((b - a) / 2)
        if k == i:
            room = arb(0, float((half * radius).upper()) * (1 + 1e-12))
            balls.append(acb(middle + room, room))
        else:
            balls.append(acb(middle + arb(0, float(half.upper()) * (1 + 1e-12))))
    most = f.majorant(balls)
    share = max(_log2(m) - _log2(s) for m, s in zip(most, size, strict=True) if s[0] > 0)
    return Disc(radius, share, most)


def remainder(disc: Disc, degree: int) -> list[tuple[float, int]]:
    """Bounds of what an interpolation of a degree leaves out, by the bounds on a disc: (mantissa, exponent).

    Nodes x_j that lie e beside the zeros multiply T_n(x) by at most exp(n^3 e) on the side: without k of its factors
    T_n is a divided difference, at most T_n^(k)(1) / k! < n^2k, and on the circle T_n loses n e / (R - 1) of itself.
    """
    radius, _, most = disc
    angle = min((degree + 1) * math.acosh(radius), 700.0)  # whose sinh does not overflow
    scale = ROUNDED_NODES * radius / (radius - 1) / math.sinh(angle)
    return [(m * scale, e) for m, e in most]


def wanted_degree(disc: Disc, tail: float) -> float:
    """The degree at which the bound of a disc leaves a relative error of `tail`; 2 sinh as an exponential."""
    height = (disc.share + 1) * math.log(2) + math.log(disc.radius / (disc.radius - 1) / tail)
    return height / math.acosh(disc.radius) - 1


def interpolation_side(name: str, axis: int, discs: list[Disc], tail: float) -> Side:
    """The sampling of the lowest degree with an error of at most `tail` by any disc; else the one of least error."""

    def rank(disc: Disc) -> tuple[bool, int, float]:
        wanted = wanted_degree(disc, tail)
        degree = max(1, min(math.ceil(wanted), MAX_DEGREE))
        left = (wanted - degree) * math.acosh(disc.radius)  # ln of the error over the tail
        return left > 0, degree, left

    disc = min(discs, key=rank)
    _, degree, left = rank(disc)
    if left > math.log(MAX_TAIL / tail):
        raise TooWide(axis, f"{name}: its range is too wide for one expansion")
    return Side(degree, True, tuple(remainder(disc, degree)))


def _log2(pair: tuple[float, int]) -> float:
    return math.log2(pair[0]) + pair[1] if pair[0] > 0 else -math.inf


def lebesgue(degree: int) -> float:
    """A bound of the Lebesgue constant at Chebyshev nodes: how much interpolation may enlarge a function."""
    return (1 + 2 / math.pi * math.log(degree + 1)) * ROUNDED_NODES


def sum_tails(plan: list[Side]) -> list[tuple[float, int]] | None:
    """The sum of the errors of all axes, the largest first: each times the Lebesgue constants of those before it."""
    parts = [(side.tails, side.degree) for side in plan if side.tails is not None]
    parts.sort(key=lambda part: -max(map(_log2, part[0])))
    total, growth = None, 1.0
    for tails, degree in parts:
        total = add_bounds(total, [(m * growth, e) for m, e in tails])
        growth *= lebesgue(degree)
    return total
