"""The search of one margin: the nearest witness, the proof, and witnesses found in cells that resist the proof."""

from __future__ import annotations

import math
import time as clock
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import CheckError
from malta.proof.box import EDGE, Box
from malta.proof.box_parts import Part
from malta.proof.exclusion.exclusion import Search, advance, start
from malta.proof.exclusion.hurwitz import Signs, raise_bound, signs_over
from malta.proof.exclusion.witness import Zero, from_cell, gradients, nearest, starts
from malta.proof.families import is_nominal_stable, parts_over
from malta.proof.loss import corner_loss, corner_of, first_loss
from malta.proof.margin import TIME_UP, Certificate, Margin, Progress
from malta.proof.multipliers.structured import Proof, Structured, rows_of
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.problem import OfLoop, OfPolynomial, Problem
from malta.proof.time_limit import TimeUp, time_limit
from malta.proof.weak_coupling.weak_coupling import HeldLoop

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.loss import Loss


# Witnesses confirmed by the poles of the loop, and the share of each parameter in them.


BISECTIONS = 16  # of the way to a witness
COARSE = 1e-5  # how far beyond a zero, relative, the poles may become unstable without a bisection


def confirm(problem: Problem, box: Box, zero: Zero, part: Part) -> Loss | None:
    """The t, frequency and p just beyond a zero at which the poles are unstable; None where they stay stable."""
    p = part.growth.parameters(zero.u)
    w = problem.physical(zero.frequency(part.family))
    stable = 1.0
    for share in 1 + 10.0 ** np.arange(-9, -0.9, 0.5):
        there = box.stretch(p, share)
        if _is_unstable(problem, there):
            if isinstance(problem, HeldLoop):  # the zero is that of uncoupled axes
                p = corner_of(problem, box, there)
                there = box.stretch(p, _first_unstable(problem, box, p, 0.95, 1.0))
                return float(box.margin(there)), w, there
            if share > 1 + COARSE:  # a double zero, which is found to the root of rounding
                share = _first_unstable(problem, box, p, stable, float(share))
                there = box.stretch(p, share)
            return float(zero.t * share), w, there
        stable = float(share)
    return None


def _first_unstable(problem: Problem, box: Box, p: FloatArray, low: float, high: float) -> float:
    """The share of the way to p, between low and high, from which on the loop is unstable: bisected."""
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if _is_unstable(problem, box.stretch(p, middle)) else (middle, high)
    return high


def _is_unstable(problem: Problem, p: FloatArray) -> bool:
    """Whether the poles at p are unstable; False where the loop has no poles there."""
    try:
        return bool(problem.instability(p[None])[0] > 0)
    except (CheckError, np.linalg.LinAlgError):
        return False


def contributions(zero: Zero, part: Part, names: tuple[str, ...]) -> dict[str, float]:
    """The share of each parameter in reaching the boundary: d ln(margin) = -sum of share x d ln(range).

    Along f(jw, p) = 0 the margin moves by Im(conj(f_w) f_p dp); at the witness all parameters pull the same way.
    """
    g = part.growth
    p = g.parameters(zero.u)
    moved = np.where(g.grows, p - g.nominal, 0)
    by_u, by_x = gradients(part.family, zero)
    slope = g.slopes(zero.u)
    pulls = by_u / np.where(slope == 0, 1, slope) * moved
    size = pulls.real if zero.x == 0 else (np.conj(by_x) * pulls).imag
    total = size.sum()
    used = [i for i in range(len(p)) if abs(moved[i]) > 1e-9 * abs(p[i]) and size[i] != 0]
    return {names[i]: float(size[i] / total) for i in used} if total else {}


FIRST = 3.97  # the first box that is searched, in multiples of the modelled one
CHEAP = 4000  # cells below which the proof is brought closer to the witness than the tolerance
FINEST = 3e-7  # how close, relative
DEAR = 3.0  # s that families take beyond which their boxes grow in small steps
BRIEF, SMALL = 0.5, 0.015  # s, and share of the time, that a wider box may take at least
PATIENCE = 20_000  # cells without progress after which the proof is given up
HARD = 4000  # cells after which smaller boxes are proven first
FEW = 100  # cells of many parameters, of which each may be dear, before multipliers take their turn
CHEAP_NODES = 128_000  # coefficients of polynomials on these cells, where each has few
NEAR = 1.005  # box of couplings, in multiples of where axes by themselves are lost
LEVELS = 5  # of these boxes, each half of the next
SMALLER = 4  # boxes, each half of the last one, that Hurwitz's determinant is tried on
# of the time for families, by the number of parameters, the last for MANY
SHARES = (0.6, 0.6, 0.6, 0.6, 0.4, 0.3)
OF_HOLDS = 0.12  # of many parameters under a hold, where each family takes long
MANY = 5  # parameters from which on multipliers come before many cells
MANY_OF_POLYNOMIALS = 11  # whose cells are cheap
LOOK = 0.2  # share of the time for a first look at the poles of corners
LOOK_AGAIN = 0.3  # share of what is left for another, or GRACE and LATE of the time beyond its end
GRACE, LATE = 0.4, 0.1  # s, share
LAST = 20.0  # s that they may take at the end where cells have proven something
SIGNS = (
    0.5  # share of the time that is left for Hurwitz's determinant where cells of frequency do not settle it
)
TURN, TURN_AFTER = 0.5, 4.0  # their share of the time in that turn, and how many times what was spent before
ALONE = 0.8  # their share where there are no families

BOUNDED = "what the position does is bounded, not followed"

Searches = list[tuple[Part, Search]]


@dataclass(eq=False)
class Job:
    """The search of one margin, and the bounds found so far.

    stands : the proven bound; upper, zero : the nearest witness; asked, end : the tolerance and the time of the caller
    """

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
        self.signs: Signs | None = None

    @property
    def _count(self) -> int:
        """The number of parameters whose ranges grow."""
        return int((self.box.down + self.box.up > 0).sum())

    @property
    def _is_many(self) -> bool:
        """Whether the parameters are so many that multipliers come before many cells."""
        return self._count >= (MANY_OF_POLYNOMIALS if isinstance(self.problem, OfPolynomial) else MANY)

    def late(self) -> bool:
        return clock.monotonic() > self.until

    # witness

    def look(self, part: Part, zero: Zero | None) -> bool:
        """Keep a zero when it is nearer than the nearest so far, and return whether it is."""
        if zero is None or not zero.t < self.upper:
            return False
        self.upper, self.zero = zero.t, (zero, part)
        return True

    def search(self) -> tuple[list[Part], float]:
        """The families over a box that holds the nearest witness, or over the largest box that can be enclosed.

        Returns the parts of the box and its size t.
        """
        parts, reach, done, refused = [], self._first(), 0.0, math.inf
        why, begun = "", clock.monotonic()
        while True:
            spent = clock.monotonic() - begun
            now = clock.monotonic()
            hurried = why.startswith(TIME_UP)  # a smaller box takes as long
            last = now + (1.0 if hurried else 0.3) * (self.end - now)
            if done or FIRST < reach >= self.limit:
                last = min(last, now + max(BRIEF, SMALL * (self.end - self.begun), 2 * spent))
            try:
                found = parts_over(self.problem, self.box, reach, min(self.until, last))
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
        room = NEAR if isinstance(self.problem, HeldLoop) else 1.05  # couplings grow with the box
        if self.upper < done / (3 if room > NEAR else room) and not self.late():
            with suppress(Unproven):  # narrower families over a smaller box; the larger ones remain valid
                parts = parts_over(self.problem, self.box, room * self.upper, self.until)
                done = room * self.upper
        return parts, done

    def _first(self) -> float:
        """The size of the first box: a little beyond the loss by the poles of its corners.

        Of several parameters at most FIRST: families of a larger box are dear, and the nearest loss may be no corner.
        """
        one = np.count_nonzero(self.box.down) + np.count_nonzero(self.box.up) == 1
        most = self.limit if one else min(self.limit, FIRST)
        now = clock.monotonic()
        with time_limit(now + LOOK * (self.end - now)):
            t = corner_loss(self.problem, self.box, most)
        return most if t is None else min(most, 1.02 * t)

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
        searches = self._start(parts, self.target(reach), min(reach, self.upper))
        final = self._advance(searches, reach, min(self.most_cells, self._first_cells(parts)))
        best, kept = 0.0, searches
        if self._is_open(searches) and not self._is_near(final):
            if self._is_many:
                self._multiply(self.target(reach), TURN, TURN_AFTER * (clock.monotonic() - self.begun))
            if not self._is_covered(reach):
                self._compare_signs(final)
            if self._is_many and not self._is_covered(reach) and self._bound_beside() > final:
                self._multiply(self.target(reach), 0.9)
            if self._is_covered(reach):
                return final, searches
        if self._is_open(searches) and not self.late() and not _is_blocked(searches):
            top = self.target(reach)
            for level in range(0 if self._is_near(final) else LEVELS, 0, -1):
                small = self._start(parts, top * 0.5**level, top * 0.5**level)
                found = self._advance(small, top * 0.5**level, HARD, rest=0.3)
                if found > best:
                    best, kept = found, small
                if self._is_open(small) or self.late():
                    break
            final = self._advance(searches, reach, self.most_cells)
        if self._is_open(searches):
            self._explain_rest(searches)
        return (final, searches) if final >= best else (best, kept)

    def _first_cells(self, parts: list[Part]) -> int:
        """The number of cells after which other proofs take their turn."""
        if not self._is_many:
            return HARD
        nodes = max((part.family.values.shape[1] for part in parts), default=1)
        return min(HARD, max(FEW, CHEAP_NODES // nodes))

    def _is_near(self, lower: float) -> bool:
        """Whether a bound is as close to the witness as was asked for."""
        return lower >= self.upper * (1 - self.asked)

    @cached_property
    def structured(self) -> Structured | None:
        """The proof by multipliers; None for a loop without a pencil of rational functions."""
        rows = None
        with suppress(TimeUp), time_limit(self.until):
            rows = rows_of(self.problem)
        return None if rows is None else Structured(rows, self.box, self.until, self.most_cells, self._report)

    def _multiply(self, target: float, share: float, most: float = math.inf) -> None:
        """Raise the proven bound by multipliers, for a share of the time that is left, and `most` seconds."""
        now = clock.monotonic()
        if self.structured is not None and now < self.until:
            self.structured.until = now + min(share * (self.until - now), most)
            with suppress(TimeUp), time_limit(self.structured.until):
                self.structured.raise_bound(target)

    def _compare_signs(self, proven: float = 0.0) -> None:
        """Raise the proven bound by Hurwitz's determinant, which needs no cells of frequency for light damping.

        Where the cells have proven as much as was asked for, it may take half as long as they did.
        """
        if self.signs is not None or isinstance(self.problem, HeldLoop):
            return
        now = clock.monotonic()
        until = now + SIGNS * (self.until - now) if math.isfinite(self.until) else now + LAST
        if proven >= min(self.upper, self.limit) * (1 - self.asked):
            until = min(until, now + SIGNS * (now - self.begun))
        t = min(self.limit, 1.05 * self.upper)
        for _ in range(SMALLER):
            with suppress(Unproven, TimeUp), time_limit(until):
                self.signs = signs_over(self.problem, self.box, t, until)
                break
            t /= 2
        if self.signs is not None:
            with suppress(TimeUp), time_limit(until):
                if not self.fixed:
                    raise_bound(self.signs, FINEST, until, CHEAP)
                raise_bound(self.signs, self.asked, until, self.most_cells)
            self.upper = min(self.upper, self.signs.upper)
            self._report(self.signs.lower)

    def _report(self, t: float) -> None:
        self.stands = max(self.stands, t)
        if self.progress is not None:
            self.progress(self.stands, self.upper)

    def _multiplier_bound(self) -> float:
        return 0.0 if self.structured is None else self.structured.lower

    def _bound_beside(self) -> float:
        """The bound that is proven without cells of frequency: by multipliers, or by Hurwitz's determinant."""
        return max(self._multiplier_bound(), 0.0 if self.signs is None else self.signs.lower)

    def _is_settled(self) -> bool:
        return self._bound_beside() >= min(self.upper * (1 - self.asked), self.limit * (1 - self.asked))

    def _is_covered(self, reach: float) -> bool:
        """Whether as much is proven beside the cells as those of box(reach) can prove."""
        return self._is_settled() or self._bound_beside() >= self.target(reach)

    def _start(self, parts: list[Part], target: float, until: float) -> Searches:
        begun = [
            (part, replace(start(part.family, part.growth, target, until), hasty=True)) for part in parts
        ]
        for part, search in begun:
            search.around = part.around
        return begun

    def _is_open(self, searches: Searches) -> bool:
        """Whether a search has not yet come as close to the witness as the tolerance asks."""
        return any(not s.finished for _, s in searches)

    def _advance(self, searches: Searches, reach: float, most: int, rest: float = 1.0) -> float:
        """Exclude zero from cell after cell, and return the t for which that proves stability.

        It ends when all cells are excluded, after `most` cells, or after the share `rest` of the remaining time.
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
            if over or _is_blocked(searches):
                return lower
            part, s = min(searches, key=lambda pair: (pair[1].finished, pair[1].lower))
            if s.finished:
                if rest < 1 or not self._tighten(count):
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

    def _tighten(self, count: int) -> bool:
        """Lower the tolerance after a cheap proof to which the caller gave none, and return whether it is lower now."""
        if self.fixed or count > CHEAP or self.tolerance <= FINEST or math.isinf(self.upper):
            return False
        self.tolerance = FINEST
        return True

    def _explain_rest(self, searches: Searches) -> None:
        worst = min((s for _, s in searches), key=lambda s: s.lower)
        if worst.lower >= self.upper * (1 - self.asked):
            return
        if isinstance(self.problem, HeldLoop):
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
            share = SHARES[min(self._count, MANY)]
            if self._is_many and isinstance(self.problem, OfLoop) and self.problem.loop.sampled:
                share = OF_HOLDS
            self.until = begun + share * (self.end - begun)
        with time_limit(self.until):
            parts, reach = self.search()
        self.until = self.end
        if not parts:
            return self._by_poles(begun)
        with time_limit(self.end):
            lower, looked, searches = self._prove_all(parts, reach)
        upper, frequency, witness = self._loss(looked)
        if max(lower, self._bound_beside()) < min(self.limit, upper) * (1 - 2 * self.asked):
            most = max(LAST, 0.5 * (clock.monotonic() - self.begun)) if lower > 0 else math.inf
            self._multiply(min(self.limit, upper * (1 - self.tolerance)), 1.0, most)
        proofs = [self._certificate(part, s) for part, s in searches]
        return self._margin(lower, (upper, frequency, witness), proofs, begun)

    def _prove_all(self, parts: list[Part], reach: float) -> tuple[float, float, Searches]:
        """The proven bound, the box that was looked at, and the searches of the proof."""
        looked = reach
        lower, searches = self.prove(parts, reach)
        # where the enclosure over the whole box is too wide, those over smaller ones may do
        for _ in range(3):
            reach /= 2
            if lower > reach or self.late() or self._bound_beside() > reach:
                break
            try:
                inner = self.prove(parts_over(self.problem, self.box, reach, self.until), reach)
            except Unproven:
                continue
            if inner[0] > lower:
                lower, searches = inner
        return lower, looked, searches

    def _margin(
        self,
        lower: float,
        loss: Loss,
        proofs: list[Certificate],
        begun: float,
    ) -> Margin:
        upper, frequency, witness = loss
        if self.structured is not None and self._multiplier_bound() > lower:
            lower, proofs = (
                self._multiplier_bound(),
                [self._whole_proof(self.structured.count, self.structured.lower, self.structured.proof())],
            )
        if self.signs is not None and self.signs.lower > lower:
            lower, proofs = self.signs.lower, [self._whole_proof(self.signs.count, self.signs.lower)]
        if lower > 0 and not is_nominal_stable(self.problem, self.box):
            lower = 0.0
            self.reasons.append("the nominal loop is not proven stable")
        if not lower <= upper:
            raise CheckError(f"the proof ({lower:.9g}) and the witness ({upper:.9g}) contradict each other")
        if lower >= upper * (1 - self.asked):
            self.reasons.clear()
        names, nominal = self.box.names, self.box.nominal
        if not (lower > 0 or self.reasons):
            self.reasons.append("not settled")
        named = None if witness is None else dict(zip(names, witness.tolist(), strict=True))
        moved = {} if witness is None else dict(zip(names, (witness - nominal).tolist(), strict=True))
        return Margin(
            lower if lower > 0 else None, upper, frequency, named, moved,
            {} if self.zero is None or witness is None else contributions(*self.zero, names),
            tuple(proofs), clock.monotonic() - begun, "; ".join(dict.fromkeys(self.reasons)),
            self.box.searched if math.isinf(upper) else "",
        )  # fmt: skip

    def _whole_proof(self, count: int, lower: float, multipliers: Proof | None = None) -> Certificate:
        axes, top = len(self.box.names), self.problem.physical(math.inf)
        return Certificate(
            count, (0.0, top), np.zeros((0, 3)), np.zeros((0, axes, 2)), np.zeros(0),
            self.box.sides(lower), (False,) * axes, 0, multipliers,
        )  # fmt: skip

    def _certificate(self, part: Part, s: Search) -> Certificate:
        axes = len(part.family.shape)
        cells, boxes, c = s.excluded(axes)
        top = self.problem.physical(math.inf)
        return Certificate(
            s.count, (0.0, top), cells, boxes, np.angle(c), part.sides, part.of.inverted, part.family.scale
        )

    def _loss(self, reach: float) -> Loss:
        """The witness, confirmed by the poles; else the first loss beyond `reach`, the box that was searched."""
        touched = self._loss_by_signs()
        if self.zero is not None:
            loss = confirm(self.problem, self.box, *self.zero)
            if loss is not None and (touched is None or loss[0] <= touched[0]):
                return loss
            if touched is None:
                self.reasons.append("the poles of the loop do not confirm the witness")
        if touched is not None:
            self.zero = None
            return touched
        return self._first_loss() if reach < self.limit else (math.inf, None, None)

    def _first_loss(self) -> Loss:
        """The first loss along the box's diagonals that is found in LOOK_AGAIN of the time left, or a little more."""
        now = clock.monotonic()
        longest = max(LOOK_AGAIN * (self.end - now), GRACE + LATE * (self.end - self.begun))
        with time_limit(now + longest):
            return first_loss(self.problem, self.box, self.limit)

    def _loss_by_signs(self) -> Loss | None:
        """The witness of Hurwitz's determinant, which may touch the boundary and not cross it."""
        if self.signs is None or self.signs.witness is None:
            return None
        p, frequency = self.signs.witness, None
        with suppress(np.linalg.LinAlgError):  # matrices that overflow have no poles to take a frequency from
            frequency = self.problem.critical_frequency(p)
        return self.signs.upper, frequency, p

    def _by_poles(self, begun: float) -> Margin:
        """The margin without families: the first loss along the box's diagonals, and a proof by multipliers."""
        loss = self._first_loss()
        self.upper = loss[0]
        target = min(self.limit, self.upper * (1 - self.tolerance))
        if self._is_many:
            self._multiply(target, ALONE)
        if not self._is_settled():
            self._compare_signs()
        if not self._is_settled():
            self._multiply(target, 1.0)
        touched = self._loss_by_signs()
        loss = touched if touched is not None and touched[0] < loss[0] else loss
        return self._margin(0.0, loss, [], begun)


def _is_blocked(searches: Searches) -> bool:
    """Whether the smallest t belongs to a cell that no splitting settles."""
    return any(s.lower >= s.blocked for _, s in searches)
