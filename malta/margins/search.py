"""The search of one margin: families over a box, the nearest witness, the proof, and witnesses out of stuck cells."""

from __future__ import annotations

import math
import time as clock
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from flint import arb

from malta.errors import CheckError
from malta.margins.box import EDGE, Box
from malta.margins.characteristic import pair
from malta.margins.descent import from_cell, nearest
from malta.margins.enclosure import Unproven, over_box, precision
from malta.margins.exclusion import (
    Search,
    advance,
    growth_over,
    start,
)
from malta.margins.expressions import NotAnalytic, exact
from malta.margins.family import Family, narrowed
from malta.margins.loss import corner_of, first_loss, loss_of_one
from malta.margins.parts import Part, cut, without_twins
from malta.margins.problem import Polynomial, Problem, hurwitz
from malta.margins.robust import Certificate, Margin, Progress
from malta.margins.structured import Structured, rows_of
from malta.margins.weak import AnywhereHeld
from malta.margins.witness import Zero, gradients, starts

if TYPE_CHECKING:
    from malta.margins.loss import Loss
    from malta.model.plant import FloatArray

FIRST = 3.97  # the first box that is searched, in multiples of the modelled one
CHEAP = 4000  # cells below which the proof is brought closer to the witness than the tolerance
FINEST = 3e-7  # how close, relative
DEAR = 3.0  # s that families take beyond which their boxes grow in small steps
BRIEF = 0.5  # s that a wider box may take at least
PATIENCE = 20_000  # cells without progress after which the proof is given up
REMEMBERED = 4_000_000  # numbers in the families of a polynomial, beyond which the oldest are forgotten
HARD = 4000  # cells after which smaller boxes are proven first
FEW = 100  # cells of many parameters, of which each is dear, before multipliers take their turn
BISECTIONS = 16  # of the way to a witness
NEAR = 1.005  # box of couplings, in multiples of where axes by themselves are lost
LEVELS = 5  # of these boxes, each half of the next
# of the time for families, by the number of parameters, the last for MANY
SHARES = (0.6, 0.6, 0.6, 0.6, 0.4, 0.3)
MANY = 5  # parameters from which on multipliers come before many cells
LAST = 20.0  # s that they may take at the end where cells have proven something
TURN, TURN_AFTER = 0.5, 4.0  # their share of the time in that turn, and how many times what was spent before

BOUNDED = "what the position does is bounded, not followed"

Searches = list[tuple[Part, Search]]
FAMILIES: WeakKeyDictionary[Polynomial, dict[Any, Family]] = WeakKeyDictionary()


@dataclass(eq=False)
class Job:
    """What is known of one margin so far."""

    problem: Problem
    box: Box
    tolerance: float
    fixed: bool  # whether the tolerance was asked for
    until: float
    most_cells: int
    progress: Progress | None

    def __post_init__(self) -> None:
        self.asked, self.end, self.begun = self.tolerance, self.until, clock.monotonic()
        self.limit = self.box.limit
        self.stands = 0.0
        self.upper = math.inf
        self.zero: tuple[Zero, Part] | None = None
        self.reasons: list[str] = []

    @property
    def _count(self) -> int:
        """Parameters whose ranges grow."""
        return int((self.box.down + self.box.up > 0).sum())

    def late(self) -> bool:
        return clock.monotonic() > self.until

    # families

    def parts(self, reach: float, last: float) -> list[Part]:
        """Families of all groups over box(reach), cut where one expansion does not do, until the time `last`.

        Raises Unproven.
        """
        sides = self.box.framed(reach)
        if isinstance(self.problem, AnywhereHeld):
            return self.problem.enclosed(self.box, reach)
        made: list[Part] = []
        try:
            for polynomial, moves in self.problem.parts([arb(a).union(arb(b)) for a, b in sides.tolist()]):
                made += self._cut(polynomial, sides, moves, last)
        except NotAnalytic as error:
            raise Unproven(f"the matrices have no value on the box: {error}") from error
        return without_twins(made)

    def _cut(self, f: Polynomial, sides: FloatArray, moves: tuple[Any, ...], last: float) -> list[Part]:
        return cut(sides, self.box.nominal, last, lambda own: self._part(f, own, moves, last))

    def _part(self, f: Polynomial, sides: FloatArray, moves: tuple[Any, ...], last: float) -> list[Part]:
        """The part of a box that lies in the frame's part `sides`, if any."""
        made = self._family(f, sides, moves, last)
        whole = growth_over(sides, f.inverted, self.box)
        own = sides.copy()
        for i in self.box.frame:
            own[i] = self.box.nominal[i] + self.box.over[i]
            if not sides[i, 0] <= own[i, 0] <= own[i, 1] <= sides[i, 1]:
                return []
            ends = [
                float(whole.shares(np.where(np.arange(len(own)) == i, p, self.box.nominal))[i])
                for p in own[i]
            ]
            made = narrowed(made, i, min(ends), max(ends))
        return [Part(f, own, made, growth_over(own, f.inverted, self.box))]

    def _family(self, f: Polynomial, sides: FloatArray, moves: tuple[Any, ...], last: float) -> Family:
        """Over the same box several questions are asked of the same polynomial."""
        known = FAMILIES.setdefault(f, {})
        key = (sides.tobytes(), tuple(pair(m) for m in moves))
        if key not in known:
            made = over_box(f, sides, moves, last)
            while sum(family.values.size for family in known.values()) > REMEMBERED:
                known.pop(next(iter(known)))
            known[key] = made
        return known[key]

    def stable(self) -> bool:
        """Whether the nominal loop is stable, by Routh's scheme in exact numbers or balls."""
        nominal = self.box.nominal
        for f, _ in self.problem.parts([arb(x) for x in nominal.tolist()]):
            bits, found = 160, None
            while found is None and bits <= 5120:
                with precision(bits):
                    v = [exact(x) for x in nominal.tolist()]
                    v = [1 / x if inverted else x for x, inverted in zip(v, f.inverted, strict=True)]
                    found = hurwitz(f.at(v))
                bits *= 2
            if not found:
                return False
        return True

    # witness

    def look(self, part: Part, zero: Zero | None) -> bool:
        """Keep the zero of smallest t."""
        if zero is None or not zero.t < self.upper:
            return False
        self.upper, self.zero = zero.t, (zero, part)
        return True

    def search(self) -> tuple[list[Part], float]:
        """Families over a box that holds the nearest witness found, or all there is to look at."""
        parts, reach, done, refused = [], self._first(), 0.0, math.inf
        why, begun = "", clock.monotonic()
        while True:
            spent = clock.monotonic() - begun
            now = clock.monotonic()
            last = now + 0.3 * (self.end - now)
            if done or FIRST < reach >= self.limit:
                last = min(last, now + max(BRIEF, 2 * spent))
            try:
                found = self.parts(reach, min(self.until, last))
            except Unproven as error:
                refused, why = reach, str(error)
                if self.late() or reach < 1e-3 or (done and spent > DEAR):
                    break
                reach = done + 0.6 * (reach - done) if done else FIRST if reach > 2 * FIRST else 0.5 * reach
            else:
                parts, done = found, reach
                for part in parts:
                    self._descend(part)
                spent = clock.monotonic() - begun
                if (
                    self.upper <= done
                    or done >= self.limit
                    or spent > min(0.3 * (self.until - begun), 4 * DEAR)
                ):
                    break
                wanted = (6 if spent < DEAR else 1.5) * done
                wanted = max(wanted, 1.01 * self.upper if math.isfinite(self.upper) else 0)
                reach = min(self.limit, wanted, 0.5 * (done + refused))
            if done and refused - done < EDGE * done:
                break
        if self.upper > done and (why or done < self.limit):
            self.reasons.append(
                why or f"nothing beyond {done:.3g} was looked at: the model is dear to enclose"
            )
        room = NEAR if isinstance(self.problem, AnywhereHeld) else 1.05  # couplings grow with the box
        if self.upper < done / (3 if room > NEAR else room) and not self.late():
            with suppress(Unproven):  # families over a smaller box are narrower; the larger ones do as well
                parts, done = self.parts(room * self.upper, self.until), room * self.upper
        return parts, done

    def _first(self) -> float:
        """The first box: of a single parameter a little beyond where the poles are lost, or all there is to look at."""
        t = loss_of_one(self.problem, self.box, self.limit)
        return min(self.limit, FIRST if t is None else 1.02 * t)

    def _descend(self, part: Part) -> None:
        misses = 0
        for distance, branch, x, u in starts(part.family, part.growth):
            if self.late() or misses > 4 or (misses > 1 and distance > 3 * self.upper):
                return
            better = self.look(part, nearest(part.family, part.growth, branch, x, u, self.upper))
            misses = 0 if better else misses + 1

    # proof

    def target(self, reach: float) -> float:
        return min(reach, self.upper * (1 - self.tolerance))

    def prove(self, parts: list[Part], reach: float) -> tuple[float, Searches]:
        """The largest t for which zero is excluded from all parts, as far as time goes.

        Where the whole box takes long, smaller ones are proven first: each is a bound that stands.
        """
        searches = self._begin(parts, self.target(reach), min(reach, self.upper))
        final = self._advance(searches, reach, min(self.most_cells, FEW if self._count >= MANY else HARD))
        best, kept = 0.0, searches
        if self._open(searches) and self._count >= MANY:
            self._multiply(self.target(reach), TURN, TURN_AFTER * (clock.monotonic() - self.begun))
            if self._multiplied() > final:
                self._multiply(self.target(reach), 0.9)
            if self._settled():
                return final, searches
        if self._open(searches) and not self.late() and not _blocked(searches):
            top = self.target(reach)
            for level in range(LEVELS, 0, -1):
                small = self._begin(parts, top * 0.5**level, top * 0.5**level)
                found = self._advance(small, top * 0.5**level, HARD, rest=0.3)
                if found > best:
                    best, kept = found, small
                if self._open(small) or self.late():
                    break
            final = self._advance(searches, reach, self.most_cells)
        if self._open(searches):
            self._unsettled(searches)
        return (final, searches) if final >= best else (best, kept)

    @cached_property
    def structured(self) -> Structured | None:
        """What proves by multipliers; None where the loop has no pencil of rational functions."""
        rows = None if self.box.frame else rows_of(self.problem)
        return None if rows is None else Structured(rows, self.box, self.until, self.most_cells, self._report)

    def _multiply(self, target: float, share: float, most: float = math.inf) -> None:
        """Raise the proven bound by multipliers, for a share of the time that is left, and `most` seconds."""
        now = clock.monotonic()
        if self.structured is not None and now < self.until:
            self.structured.until = now + min(share * (self.until - now), most)
            self.structured.raise_bound(target)

    def _report(self, t: float) -> None:
        self.stands = max(self.stands, t)
        if self.progress is not None:
            self.progress(self.stands, self.upper)

    def _multiplied(self) -> float:
        return 0.0 if self.structured is None else self.structured.lower

    def _settled(self) -> bool:
        return self._multiplied() >= self.upper * (1 - self.asked)

    def _begin(self, parts: list[Part], target: float, until: float) -> Searches:
        begun = [
            (part, replace(start(part.family, part.growth, target, until), hasty=True)) for part in parts
        ]
        for part, search in begun:
            search.beside = part.around
        return begun

    def _open(self, searches: Searches) -> bool:
        """Whether the proof has not come as close to the witness as was asked."""
        return any(not s.finished for _, s in searches)

    def _advance(self, searches: Searches, reach: float, most: int, rest: float = 1.0) -> float:
        """Exclude zero from cells until all are, or `most` were looked at, or a share of the time that is left is gone.

        Returns t for which that proves stability.
        """
        tried, stood, since = 0, -1.0, 0
        now = clock.monotonic()
        until = self.until if math.isinf(self.until) else now + rest * (self.until - now)
        while True:
            lower = min((s.lower for _, s in searches), default=reach)
            self.stands = max(self.stands, lower)
            if self.progress is not None:
                self.progress(self.stands, self.upper)
            count = sum(s.count for _, s in searches)
            if lower > stood * (1 + self.tolerance / 10):
                stood, since = lower, count
            patience = PATIENCE if self.tolerance == self.asked else CHEAP
            over = clock.monotonic() > until or count >= most or count - since > patience
            if over or _blocked(searches):
                return lower
            part, s = min(searches, key=lambda pair: (pair[1].finished, pair[1].lower))
            if s.finished:
                if rest < 1 or not self._tightened(count):
                    return lower
                for _, other in searches:
                    other.target = self.target(reach)
                continue
            advance(s)
            cell = s.hardest()
            if cell is not None and tried < 8 + count // 500:
                tried += 1
                if self.look(part, from_cell(s.family, s.growth, cell, self.upper)):
                    for _, other in searches:
                        other.target = min(other.target, self.target(reach))

    def _tightened(self, count: int) -> bool:
        """Whether the proof shall come closer to the witness, as it may where that costs little."""
        if self.fixed or count > CHEAP or self.tolerance <= FINEST or math.isinf(self.upper):
            return False
        self.tolerance = FINEST
        return True

    def _unsettled(self, searches: Searches) -> None:
        worst = min((s for _, s in searches), key=lambda s: s.lower)
        if worst.lower >= self.upper * (1 - self.asked):
            return
        if isinstance(self.problem, AnywhereHeld):
            self.reasons.append(BOUNDED)
            return
        count = sum(s.count for _, s in searches)
        why = "not settled in time" if self.late() else f"not settled within {count} cells"
        cell = worst.hardest() or worst.first()
        if cell is not None:
            x = Zero(0.0, cell.branch, sum(cell.interval) / 2, np.zeros(0)).frequency(worst.family)
            why += f", near {self.problem.physical(x):.6g} rad/s"
        self.reasons.append(why)

    # result

    def margin(self, begun: float) -> Margin:
        if self.structured is not None:  # families may take all the time there is, and not come to be
            self.until = begun + SHARES[min(self._count, MANY)] * (self.end - begun)
        parts, reach = self.search()
        self.until = self.end
        if not parts:
            return self._by_poles(begun)
        lower, searches = self.prove(parts, reach)
        looked = reach
        # where the enclosure over the whole box is too wide, those over smaller ones may do
        for _ in range(3):
            reach /= 2
            if lower > reach or self.late() or self._multiplied() > reach:
                break
            try:
                inner = self.prove(self.parts(reach, self.until), reach)
            except Unproven:
                continue
            if inner[0] > lower:
                lower, searches = inner
        upper, frequency, witness = self._confirmed()
        if witness is None and looked < self.limit:
            upper, frequency, witness = first_loss(self.problem, self.box, self.limit)
        if max(lower, self._multiplied()) < min(self.limit, upper * (1 - 2 * self.asked)):
            most = max(LAST, 0.5 * (clock.monotonic() - self.begun)) if lower > 0 else math.inf
            self._multiply(min(self.limit, upper * (1 - self.tolerance)), 1.0, most)
        proofs = [self._certificate(part, s) for part, s in searches]
        return self._margin(lower, (upper, frequency, witness), proofs, begun)

    def _margin(
        self,
        lower: float,
        loss: Loss,
        proofs: list[Certificate],
        begun: float,
    ) -> Margin:
        upper, frequency, witness = loss
        if self.structured is not None and self._multiplied() > lower:
            lower, proofs = self._multiplied(), [self._multiplier_proof(self.structured)]
        if lower > 0 and not self.stable():
            lower = 0.0
            self.reasons.append("the nominal loop is not proven stable")
        if not lower <= upper:
            raise CheckError(f"the proof ({lower:.9g}) and the witness ({upper:.9g}) contradict each other")
        if lower >= upper * (1 - self.asked):
            self.reasons.clear()
        names, nominal = self.box.names, self.box.nominal
        named = None if witness is None else dict(zip(names, witness.tolist(), strict=True))
        moved = {} if witness is None else dict(zip(names, (witness - nominal).tolist(), strict=True))
        return Margin(
            lower if lower > 0 else None, upper, frequency, named, moved,
            {} if self.zero is None or witness is None else self._shares(),
            tuple(proofs), clock.monotonic() - begun, "; ".join(dict.fromkeys(self.reasons)),
        )  # fmt: skip

    def _multiplier_proof(self, s: Structured) -> Certificate:
        axes, top = len(self.box.names), self.problem.physical(math.inf)
        return Certificate(
            s.count, (0.0, top), np.zeros((0, 3)), np.zeros((0, axes, 2)), np.zeros(0),
            self.box.sides(s.lower), (False,) * axes, 0,
        )  # fmt: skip

    def _certificate(self, part: Part, s: Search) -> Certificate:
        axes = len(part.family.shape)
        cells, boxes, c = s.excluded(axes)
        top = self.problem.physical(math.inf)
        return Certificate(
            s.count, (0.0, top), cells, boxes, np.angle(c), part.sides, part.of.inverted, part.family.scale
        )

    def _confirmed(self) -> tuple[float, float | None, FloatArray | None]:
        """The witness, moved outwards until the poles of the loop are unstable."""
        if self.zero is None:
            return math.inf, None, None
        zero, part = self.zero
        p = part.growth.parameters(zero.u)
        w = self.problem.physical(zero.frequency(part.family))
        for share in 1 + 10.0 ** np.arange(-9, -1.5, 0.5):
            there = self.box.stretched(p, share)
            if self._unstable(there):
                if isinstance(self.problem, AnywhereHeld):  # the zero is that of axes by themselves
                    p = corner_of(self.problem, self.box, there)
                    there = self.box.stretched(p, self._first_unstable(p))
                    return float(self.box.margin(there)), w, there
                return float(self.upper * share), w, there
        self.reasons.append("the poles of the loop do not confirm the witness")
        return math.inf, None, None

    def _first_unstable(self, p: FloatArray) -> float:
        """About the smallest share of the way to p, which is unstable, from where the loop is so on."""
        low, high = 0.95, 1.0
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            low, high = (low, middle) if self._unstable(self.box.stretched(p, middle)) else (middle, high)
        return high

    def _unstable(self, p: FloatArray) -> bool:
        try:
            return bool(self.problem.instability(p[None])[0] > 0)
        except (CheckError, np.linalg.LinAlgError):
            return False

    def _shares(self) -> dict[str, float]:
        """What each parameter contributes to reaching the boundary: d ln(margin) = -sum of share x d ln(range).

        Along f(jw, p) = 0 the margin moves by Im(conj(f_w) f_p dp); at the witness all of them pull the same way.
        """
        assert self.zero is not None
        zero, part = self.zero
        g = part.growth
        p = g.parameters(zero.u)
        moved = np.where(g.grows, p - g.nominal, 0)
        by_u, by_x = gradients(part.family, zero)
        slope = g.slopes(zero.u)
        pulls = by_u / np.where(slope == 0, 1, slope) * moved
        size = pulls.real if zero.x == 0 else (np.conj(by_x) * pulls).imag
        total = size.sum()
        used = [i for i in range(len(p)) if abs(moved[i]) > 1e-9 * abs(p[i]) and size[i] != 0]
        return {self.box.names[i]: float(size[i] / total) for i in used} if total else {}

    def _by_poles(self, begun: float) -> Margin:
        """Without families: the first loss of stability along the box's diagonals, and what multipliers prove."""
        loss = first_loss(self.problem, self.box, self.limit)
        self.upper = loss[0]
        self._multiply(min(self.limit, self.upper * (1 - self.tolerance)), 1.0)
        return self._margin(0.0, loss, [], begun)


def _blocked(searches: Searches) -> bool:
    """Whether the smallest t is that of a cell which no splitting settles."""
    return any(s.lower >= s.blocked for _, s in searches)
