"""Dynamics that nobody modelled, beside real parameters: a stable Delta with |Delta(jw)| <= t |W(jw)| in a channel.

    multiplicative: the channel's gain is 1 + Delta,       lost where |W T| = 1 / t
    feedback:       the channel's gain is 1 / (1 + Delta), lost where |W S| = 1 / t

The loop with Delta has the characteristic function f + Delta N, N of `gain`. It is not zero for any complex Delta of
that size where no point of f comes within t |W N| of zero: one exclusion covers parameters and dynamics together.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from malta.errors import InputError
from malta.margins.box import Box, box_of
from malta.margins.enclosure import Unproven
from malta.margins.gain import (
    MOST_CELLS,
    Channel,
    Pair,
    Question,
    climbed,
    doubled,
    excluded,
    gain_at,
    pairs_of,
)
from malta.margins.robust import Margin, law_of, problem_of
from malta.margins.search import EDGE, FAR, Job
from malta.uncertain import Compensator, UncertainSystem

if TYPE_CHECKING:
    from malta.margins.problem import OfLoop
    from malta.margins.robust import Ranges
    from malta.plant import FloatArray

TOLERANCE = 1e-3
STEPS = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)  # multiples of the tolerance that are tried
HALVINGS = 40


@dataclass(frozen=True, eq=False)
class Dynamic:
    """Unmodelled dynamics in one channel: Delta stable, |Delta(jw)| <= |W(jw)| in the modelled set.

    weight: W, a number or a control.TransferFunction in s; kind: multiplicative or feedback;
    at, channel: sensors or forces, counted from 0.
    """

    weight: Any
    kind: Literal["multiplicative", "feedback"] = "multiplicative"
    at: Channel = "sensors"
    channel: int = 0


def dynamic_margin(
    system: UncertainSystem,
    compensator: Compensator | Any,
    ranges: Ranges,
    dynamic: Dynamic,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float = TOLERANCE,
    time: float | None = None,
) -> Margin:
    """How far real parameters and one block of unmodelled dynamics may go together, as robstab takes ultidyn.

    Parameters
    ----------
    compensator, ranges, over : as robust_margin takes them; ranges may be empty
    dynamic : the block; t times its weight belongs to t times the ranges
    tolerance : how close the proven bound shall come to the loss that was found, relative
    time : s, after which what stands is returned

    `witness` holds the parameters; the block's size there is t |W| at `frequency`.

    Raises InputError as robust_margin does, for channels that the loop does not have and weights that are none.

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> found = malta.dynamic_margin(motor, [[-2.0]], {}, malta.Dynamic(0.5))  # |T| = 2 / 3 at w = 0
    >>> round(found.upper, 3)
    3.0
    """
    begun = clock.monotonic()
    law, over = law_of(system, compensator), dict(over or {})
    if ranges:
        box = box_of(system.names, system.nominal, system.limits, ranges, over)
    else:
        none = np.zeros(len(system.names))
        fixed = [
            np.subtract(over.get(name, (p, p)), p)
            for name, p in zip(system.names, system.nominal, strict=True)
        ]
        box = Box(system.names, system.nominal, none, none, np.array(fixed).reshape(-1, 2), math.inf)
    size = _weight(dynamic.weight)
    until = math.inf if time is None else begun + time
    of: Literal["sensitivity", "complementary"] = (
        "sensitivity" if dynamic.kind == "feedback" else "complementary"
    )
    asked = Question(box, of, dynamic.at, dynamic.channel, tolerance, until)
    asked.check(system, dynamic.kind)
    one, two = problem_of(system, law), problem_of(system, doubled(law, dynamic.at, dynamic.channel))
    if (one.instability(box.standing()) >= 0).any():
        return Margin(
            0.0, 0.0, None, None, {}, {}, (), clock.monotonic() - begun, "the nominal loop is unstable"
        )
    search = _Search(system, law, one, two, asked, size)
    with np.errstate(all="ignore"):  # what is not finite excludes nothing
        return search.margin(begun)


Size = Callable[[float, float], float]  # the largest |W(jw)| on an interval of rad/s


@dataclass(frozen=True, eq=False)
class _Search:
    system: UncertainSystem
    law: Compensator
    one: OfLoop
    two: OfLoop
    asked: Question
    size: Size

    def margin(self, begun: float) -> Margin:
        upper, w, p, pairs, reason = self._lost()
        lower = None
        if pairs:
            lower = self._proven(pairs, min(upper, self._limit))
            if lower is None:
                reason = reason or "not settled"
            elif not Job(self.one, self.asked.box, 1e-3, True, self.asked.until, MOST_CELLS, None).stable():
                lower, reason = None, "the nominal loop is not proven stable"
        names, nominal = self.asked.box.names, self.asked.box.nominal
        named = None if math.isinf(upper) else dict(zip(names, p.tolist(), strict=True))
        moved = {} if math.isinf(upper) else dict(zip(names, (p - nominal).tolist(), strict=True))
        spent = clock.monotonic() - begun
        return Margin(lower, upper, None if math.isinf(upper) else w, named, moved, {}, (), spent, reason)

    @property
    def _limit(self) -> float:
        return min(self.asked.box.most * (1 - EDGE), FAR)

    def _lost(self) -> tuple[float, float, FloatArray, list[Pair], str]:
        """The smallest t that was found to lose stability, where, and f and N over the box that holds it."""
        nominal, box = self.asked.box.nominal, self.asked.box
        best: tuple[float, float, FloatArray] = (math.inf, math.nan, nominal)
        pairs: list[Pair] = []
        reach = min(1.0, self._limit)
        while True:
            try:
                pairs = pairs_of(self.one, self.two, self.asked, reach)
            except Unproven as error:
                return (*best, pairs, str(error))
            best = min(best, self._within(pairs, reach), key=lambda place: place[0])
            if best[0] <= reach or reach >= self._limit or not (box.down + box.up).any():
                return (*best, pairs, "")
            reach = min(4 * reach, self._limit, max(1.05 * best[0], reach * 1.01))

    def _within(self, pairs: list[Pair], reach: float) -> tuple[float, float, FloatArray]:
        """The smallest t within `reach` for which some place of box(t) has t |W N| >= |f|."""

        def worst(t: float) -> tuple[float, float, FloatArray]:
            found = [climbed(pair, self.one, t, self._weighted) for pair in pairs if pair.N is not None]
            places = [(self._gain(p, w) * self.size(w, w), w, p) for p, w in found]
            return max(places, key=lambda place: place[0], default=(0.0, math.nan, self.asked.box.nominal))

        def lost_at(place: tuple[float, float, FloatArray]) -> tuple[float, float, FloatArray]:
            size, w, p = place
            return max(float(pairs[0].growth.margin(p)), 1 / size if size > 0 else math.inf), w, p

        top = worst(reach)
        low, high = 0.0, reach
        best = lost_at(top)
        if not (self.asked.box.down + self.asked.box.up).any() or top[0] * reach < 1:
            return best
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            here = worst(middle)
            if here[0] * middle >= 1:
                high = middle
            else:
                low = middle
            best = min(best, lost_at(here), key=lambda place: place[0])
            if high - low < 1e-9 * high:
                break
        return best

    def _weighted(self, w: FloatArray) -> FloatArray:
        return np.array([self.size(x, x) for x in w.tolist()])

    def _gain(self, p: FloatArray, w: float) -> float:
        return gain_at(self.system, self.law, self.asked, p, w)

    def _proven(self, pairs: list[Pair], upper: float) -> float | None:
        """The largest t of those tried for which stability is proven."""
        for step in STEPS:
            t = upper / (1 + step * self.asked.tolerance)
            if all(self._excluded(pair, t) for pair in pairs):
                return t
            if clock.monotonic() > self.asked.until:
                break
        return None

    def _excluded(self, pair: Pair, t: float) -> bool:
        def share(cells: FloatArray) -> FloatArray:
            return t * np.array([self._largest(cell, pair.f.scale) for cell in cells])

        return excluded(pair, t if pair.growth.grows.any() else 1.0, share, self.asked.until)[0]

    def _largest(self, cell: FloatArray, scale: int) -> float:
        """|W| over a cell's interval of frequency."""
        branch, a, b = cell.tolist()
        ends = [math.inf if x == 0 else 1 / x for x in (b, a)] if branch else [a, b]
        low, high = (self.one.physical(math.ldexp(x, scale) if math.isfinite(x) else x) for x in ends)
        return self.size(low * (1 - 1e-12), high * (1 + 1e-12))


def _weight(weight: Any) -> Size:
    """Bounds of |W(jw)| on intervals. Raises InputError for what is no weight."""
    if isinstance(weight, (int, float)) and not isinstance(weight, bool):
        if not 0 < weight < math.inf:
            raise InputError(
                "dynamic_margin", "weight", f"{weight}", "a number above zero, or a transfer function"
            )
        return partial(_constant, float(weight))
    try:
        num, den = (np.asarray(c[0][0], dtype=float) for c in (weight.num, weight.den))
        stable, continuous = bool((weight.poles().real < 0).all()), not weight.dt
    except (AttributeError, TypeError, ValueError, IndexError):
        raise InputError(
            "dynamic_margin", "weight", type(weight).__name__, "a number or a transfer function"
        ) from None
    if not (stable and continuous and len(num) <= len(den) and np.isfinite([*num, *den]).all()):
        raise InputError(
            "dynamic_margin", "weight", "not stable, not proper or discrete", "a stable, proper one in s"
        )
    num = np.concatenate([np.zeros(len(den) - len(num)), num])

    def largest(low: float, high: float) -> float:
        if math.isinf(high):  # in y = 1 / w, from 0 on
            return _ratio(num[::-1], den[::-1], 0.0, 1 / low if low > 0 else math.inf, -1j)
        return _ratio(num, den, low, high, 1j)

    return largest


def _constant(size: float, low: float, high: float) -> float:
    del low, high
    return size


def _ratio(num: FloatArray, den: FloatArray, low: float, high: float, turn: complex) -> float:
    """At least |num / den| at turn x for x in [low, high], by Taylor's expansions; coefficients highest power first."""
    if not math.isfinite(high):
        return math.inf
    middle, half = (low + high) / 2, (high - low) / 2

    def terms(c: FloatArray) -> list[float]:
        p, found = np.poly1d(c), []
        for m in range(len(c)):
            found.append(abs(complex(p(turn * middle))) * half**m / math.factorial(m))
            p = p.deriv()
        return found

    top, bottom = terms(num), terms(den)
    least = bottom[0] - sum(bottom[1:])
    return math.inf if least <= 0 else (sum(top) / least) * (1 + 1e-9)
