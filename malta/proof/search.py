"""The search of one margin: the nearest witness, the proof, and witnesses found in cells that resist the proof."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import arb

from malta.bound import at_least
from malta.errors import CheckError
from malta.linear.expressions import NotAnalytic
from malta.proof.box import EDGE, Box
from malta.proof.exclusion import Part, Search, advance, cut, growth_over, merge_twins, start
from malta.proof.exclusion.hurwitz import Signs, raise_bound, signs_over
from malta.proof.exclusion.witness import Zero, from_cell, nearest, starts
from malta.proof.loss import confirm, contributions, corner_loss, first_loss
from malta.proof.margin import Certificate, Margin, Progress
from malta.proof.multipliers.structured import Proof, Structured, rows_of
from malta.proof.polynomial.enclosure import NO_COEFFICIENTS, Unproven, family_over
from malta.proof.problem import Problem, is_nominal_stable
from malta.work import WorkUp, is_past, is_stopped, refuse, spent, work_limit

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.proof.loss import Loss
    from malta.proof.polynomial.enclosure import Polynomial


FIRST = 3.97  # the first box that is searched, in multiples of the modelled one
CHEAP = 4000  # cells below which the proof is brought closer to the witness than the tolerance
FINEST = 3e-7  # how close, relative
DEAR = 3.0  # work of families beyond which their boxes grow in small steps
BRIEF, SMALL = 0.5, 0.015  # work, and share of it, that a wider box may take at least
PATIENCE = 20_000  # cells without progress after which the proof is given up
HARD = 4000  # cells after which smaller boxes are proven first
FEW = 100  # cells of many parameters, of which each may be dear, before multipliers take their turn
CHEAP_NODES = 128_000  # coefficients of polynomials on these cells, where each has few
NEAR = 1.005  # box of couplings, in multiples of where axes by themselves are lost
LEVELS = 5  # of these boxes, each half of the next
SMALLER = 4  # boxes, each half of the last one, that Hurwitz's determinant is tried on
# of the work for families, by the number of parameters, the last for MANY
SHARES = (0.6, 0.6, 0.6, 0.6, 0.4, 0.3)
PATIENT, PATIENT_DEAR = 0.8, 0.1  # of the work, for families of a patient search
OF_HOLDS = 0.12  # of many parameters under a hold, where each family takes long
MANY = 5  # parameters from which on multipliers come before many cells
MANY_OF_POLYNOMIALS = 11  # whose cells are cheap
LOOK = 0.2  # share of the work for a first look at the poles of corners
LOOK_AGAIN = 0.3  # share of what is left for another, or GRACE and LATE of the work beyond its end
GRACE, LATE = 0.4, 0.1  # work, share
LAST = 20.0  # work that they may take at the end where cells have proven something
SIGNS = (
    0.5  # share of the work that is left for Hurwitz's determinant where cells of frequency do not settle it
)
TURN, TURN_AFTER = 0.5, 4.0  # their share of the work in that turn, and how many times what was spent before
ALONE = 0.8  # their share where there are no families

BOUNDED = "what the position does is bounded, not followed"

Searches = list[tuple[Part, Search]]


@dataclass(eq=False)
class Standing:
    """What is known of a margin while it is searched: bounds, work, the cells that are left. It changes in place."""

    progress: Progress | None
    lower: float = 0.0
    upper: float = math.inf
    work: float = 0.0
    searches: Searches = field(default_factory=list)

    def report(self, lower: float, upper: float) -> None:
        self.lower, self.upper, self.work = max(self.lower, lower), min(self.upper, upper), spent()
        if self.progress is not None:
            self.progress(self.lower, self.upper)

    def where(self, problem: Problem) -> str:
        """The frequency of the cell that resists, in words."""
        if not self.searches:
            return ""
        worst = min((s for _, s in self.searches), key=lambda s: s.lower)
        cell = worst.hardest() or worst.first()
        if cell is None:
            return ""
        x = Zero(0.0, cell.branch, sum(cell.interval) / 2, np.zeros(0)).frequency(worst.family)
        return f", near {problem.physical(x):.6g} rad/s"


@dataclass(frozen=True, eq=False)
class Question:
    """The margin that is asked for, and what its search may take.

    fixed : whether the tolerance was asked for; end : of the work of the question
    patient : whether all of the work is used, where no earlier round settled the question
    standing : what is known so far, for whoever stops the search
    """

    problem: Problem
    box: Box
    tolerance: float
    fixed: bool
    end: float
    most_cells: int
    patient: bool
    standing: Standing

    @property
    def _count(self) -> int:
        """The number of parameters whose ranges grow."""
        return int((self.box.down + self.box.up > 0).sum())

    @property
    def is_many(self) -> bool:
        """Whether the parameters are so many that multipliers come before many cells."""
        return self._count >= (MANY_OF_POLYNOMIALS if self.problem.traits.is_cheap else MANY)

    @property
    def share(self) -> float:
        """The share of the work that families may take where there are multipliers beside them."""
        if self.patient:
            return PATIENT
        is_dear = self.is_many and self.problem.traits.is_held
        return OF_HOLDS if is_dear else SHARES[min(self._count, MANY)]

    @property
    def dear(self) -> float:
        """Work of families beyond which their boxes grow in small steps."""
        return max(DEAR, PATIENT_DEAR * self.end) if self.patient else DEAR

    def is_late(self) -> bool:
        return is_past(self.end)


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known of a margin so far.

    tolerance : as asked for, or finer; stands : the proven bound; upper, zero : the nearest witness
    structured, signs : proofs without cells of frequency, by multipliers and by Hurwitz's determinant
    """

    tolerance: float
    structured: Structured | None
    signs: Signs | None = None
    stands: float = 0.0
    upper: float = math.inf
    zero: tuple[Zero, Part] | None = None
    reasons: tuple[str, ...] = ()

    def because(self, reason: str) -> Findings:
        return replace(self, reasons=(*self.reasons, reason))

    def nearer(self, part: Part, zero: Zero | None) -> Findings:
        """The zero is kept when it is nearer than the nearest so far."""
        if zero is None or not zero.t < self.upper:
            return self
        return replace(self, upper=zero.t, zero=(zero, part))

    def target(self, reach: float) -> float:
        return min(reach, self.upper * (1 - self.tolerance))

    @property
    def beside(self) -> float:
        """The bound that is proven without cells of frequency."""
        return max((proof.lower for proof in (self.structured, self.signs) if proof is not None), default=0.0)

    def is_near(self, lower: float, q: Question) -> bool:
        """Whether a bound is as close to the witness as was asked for."""
        return lower >= self.upper * (1 - q.tolerance)

    def is_settled(self, q: Question) -> bool:
        return self.beside >= min(self.upper, q.box.limit) * (1 - q.tolerance)

    def is_covered(self, q: Question, reach: float) -> bool:
        """Whether as much is proven beside the cells as those of box(reach) can prove."""
        return self.is_settled(q) or self.beside >= self.target(reach)

    def report(self, q: Question, t: float) -> Findings:
        """box(t) is proven: the caller is told of it."""
        stands = max(self.stands, t)
        q.standing.report(stands, self.upper)
        return replace(self, stands=stands)


def search(q: Question) -> Margin:
    """The margin that is asked for."""
    rows = None
    with suppress(WorkUp), work_limit(q.end):
        rows = rows_of(q.problem)
    known = Findings(q.tolerance, None if rows is None else Structured(rows, q.box, q.most_cells))
    # families may take all the work there is, and not come to be
    until = q.end if rows is None else q.share * q.end
    with work_limit(until):
        known, parts, reach = _families(q, known, until)
    if not parts:
        return _by_poles(q, known)
    with work_limit(q.end):
        known, lower, searches = _prove_all(q, known, parts, reach)
    known, loss = _loss(q, known, reach)
    if max(lower, known.beside) < min(q.box.limit, loss[0]) * (1 - 2 * q.tolerance):
        most = max(LAST, 0.5 * spent()) if lower > 0 and not q.patient else math.inf
        known = _multiply(q, known, min(q.box.limit, loss[0] * (1 - known.tolerance)), 1.0, most)
    return _margin(q, known, lower, loss, [_certificate(q, part, s) for part, s in searches])


# witness


def _families(q: Question, known: Findings, until: float) -> tuple[Findings, list[Part], float]:
    """The families over a box that holds the nearest witness, or over the largest box that can be enclosed.

    Returns the parts of the box and its size t.
    """
    parts, reach, done, refused = list[Part](), _first_reach(q), 0.0, math.inf
    why, begun = "", spent()
    while True:
        now = spent()
        taken = now - begun
        hurried = why == NO_COEFFICIENTS  # a smaller box takes as much
        last = now + (1.0 if hurried else 0.3) * (q.end - now)
        if done or FIRST < reach >= q.box.limit:
            last = min(last, now + max(BRIEF, SMALL * q.end, 2 * taken))
        try:
            parts = parts_over(q.problem, q.box, reach, min(until, last))
        except Unproven as error:
            refused, why = reach, str(error)
            if is_past(until) or reach < 1e-3 or (done and taken > q.dear):
                break
            reach = done + 0.6 * (reach - done) if done else FIRST if reach > 2 * FIRST else 0.5 * reach
        else:
            done = reach
            for part in parts:
                known = _descend(known, part, until)
            taken = spent() - begun
            if known.upper <= done or done >= q.box.limit or taken > min(0.3 * (until - begun), 4 * q.dear):
                break
            wanted = (6 if taken < q.dear else 1.5) * done
            wanted = max(wanted, 1.01 * known.upper if math.isfinite(known.upper) else 0)
            reach = min(q.box.limit, wanted, 0.5 * (done + refused))
        if done and refused - done < EDGE * done:
            break
    if known.upper > done and (why or done < q.box.limit):
        known = known.because(
            why or f"nothing beyond {at_least(done).text()} was looked at: the model is dear to enclose"
        )
        if why in ("", NO_COEFFICIENTS):
            refuse()
    room = NEAR if q.problem.traits.is_bounded else 1.05  # couplings grow with the box
    if known.upper < done / (3 if room > NEAR else room) and not is_past(until):
        with suppress(Unproven):  # narrower families over a smaller box; the larger ones remain valid
            parts = parts_over(q.problem, q.box, room * known.upper, until)
            done = room * known.upper
    return known, parts, done


def parts_over(problem: Problem, box: Box, reach: float, last: float) -> list[Part]:
    """The families of all groups over box(reach), cut into parts where one expansion does not do.

    last : of the work, at which the search gives up

    Raises Unproven when a matrix has no value on the box, or when the work is up.
    """
    sides = box.sides(reach)
    parts: list[Part] = []
    try:
        with work_limit(last):
            if (enclose := problem.traits.enclose) is not None:
                return enclose(box, reach)
            for polynomial, moves in problem.parts([arb(a).union(arb(b)) for a, b in sides.tolist()]):
                parts += cut(sides, box.nominal, partial(_part_over, polynomial, moves, box))
    except NotAnalytic as error:
        raise Unproven(f"the matrices have no value on the box: {error}") from error
    except WorkUp as error:
        raise Unproven(NO_COEFFICIENTS) from error
    return merge_twins(parts)


def _part_over(f: Polynomial, moves: tuple[Any, ...], box: Box, sides: FloatArray) -> list[Part]:
    return [Part(f, sides, family_over(f, sides, moves), growth_over(sides, f.inverted, box))]


def _first_reach(q: Question) -> float:
    """The size of the first box: a little beyond the loss by the poles of its corners.

    Of several parameters at most FIRST: families of a larger box are dear, and the nearest loss may be no corner.
    """
    one = np.count_nonzero(q.box.down) + np.count_nonzero(q.box.up) == 1
    most = q.box.limit if one else min(q.box.limit, FIRST)
    now = spent()
    with work_limit(now + LOOK * (q.end - now)):
        t = corner_loss(q.problem, q.box, most)
    return most if t is None else min(most, 1.02 * t)


def _descend(known: Findings, part: Part, until: float) -> Findings:
    misses = 0
    for distance, branch, x, u in starts(part.family, part.growth):
        if is_past(until) or misses > 4 or (misses > 1 and distance > 3 * known.upper):
            break
        found = known.nearer(part, nearest(part.family, part.growth, branch, x, u, known.upper))
        known, misses = found, misses + 1 if found is known else 0
    return known


# proof


def _prove_all(
    q: Question, known: Findings, parts: list[Part], reach: float
) -> tuple[Findings, float, Searches]:
    """The proven bound and the searches of the proof."""
    known, lower, searches = _prove(q, known, parts, reach)
    # where the enclosure over the whole box is too wide, those over smaller ones may do
    for _ in range(3):
        reach /= 2
        if lower > reach or q.is_late() or known.beside > reach:
            break
        try:
            known, inner, found = _prove(q, known, parts_over(q.problem, q.box, reach, q.end), reach)
        except Unproven:
            continue
        if inner > lower:
            lower, searches = inner, found
    return known, lower, searches


def _prove(q: Question, known: Findings, parts: list[Part], reach: float) -> tuple[Findings, float, Searches]:
    """The largest t for which zero is excluded from all parts, as far as time goes.

    Where the whole box takes long, smaller ones are proven first: each is a bound that stands.
    """
    begun = _start(parts, known.target(reach), min(reach, known.upper))
    known, final, searches = _advance(q, known, begun, reach, min(q.most_cells, _first_cells(q, parts)))
    best, kept = 0.0, searches
    if _is_open(searches) and not known.is_near(final, q):
        if q.is_many:
            known = _multiply(q, known, known.target(reach), TURN, TURN_AFTER * spent())
        if not known.is_covered(q, reach):
            known = _compare_signs(q, known, final)
        if q.is_many and not known.is_covered(q, reach) and known.beside > final:
            known = _multiply(q, known, known.target(reach), 0.9)
        if known.is_covered(q, reach):
            return known, final, searches
    if _is_open(searches) and not q.is_late() and not _is_blocked(searches):
        top = known.target(reach)
        for level in range(0 if known.is_near(final, q) else LEVELS, 0, -1):
            t = top * 0.5**level
            known, found, small = _advance(q, known, _start(parts, t, t), t, HARD, rest=0.3)
            if found > best:
                best, kept = found, small
            if _is_open(small) or q.is_late():
                break
        known, final, searches = _advance(q, known, searches, reach, q.most_cells)
    if _is_open(searches):
        known = _explain_rest(q, known, searches)
    return (known, final, searches) if final >= best else (known, best, kept)


def _first_cells(q: Question, parts: list[Part]) -> int:
    """The number of cells after which other proofs take their turn."""
    nodes = max((part.family.values.shape[1] for part in parts), default=1)
    return min(HARD, max(FEW, CHEAP_NODES // nodes)) if q.is_many else HARD


def _multiply(q: Question, known: Findings, target: float, share: float, most: float = math.inf) -> Findings:
    """Raise the proven bound by multipliers, for a share of the work that is left, and at most `most`."""
    now = spent()
    if known.structured is None or not now < q.end:
        return known
    until = now + min(share * (q.end - now), most)
    with suppress(WorkUp), work_limit(until):
        known.structured.raise_bound(target, until, lambda t: known.report(q, t))
    return replace(known, stands=max(known.stands, known.structured.lower))


def _compare_signs(q: Question, known: Findings, proven: float = 0.0) -> Findings:
    """Raise the proven bound by Hurwitz's determinant, which needs no cells of frequency for light damping.

    Where the cells have proven as much as was asked for, it may take half as much as they did.
    """
    if known.signs is not None or q.problem.traits.is_bounded:
        return known
    now = spent()
    until = now + SIGNS * (q.end - now) if math.isfinite(q.end) else now + LAST
    if proven >= min(known.upper, q.box.limit) * (1 - q.tolerance):
        until = min(until, now + SIGNS * now)
    t, signs = min(q.box.limit, 1.05 * known.upper), None
    for _ in range(SMALLER):
        with suppress(Unproven, WorkUp), work_limit(until):
            signs = signs_over(q.problem, q.box, t)
            break
        t /= 2
    if signs is None:
        return known
    with suppress(WorkUp), work_limit(until):
        if not q.fixed:
            raise_bound(signs, FINEST, CHEAP)
        raise_bound(signs, q.tolerance, q.most_cells)
    return replace(known, signs=signs, upper=min(known.upper, signs.upper)).report(q, signs.lower)


def _start(parts: list[Part], target: float, until: float) -> Searches:
    return [
        (part, replace(start(part.family, part.growth, target, until), hasty=True, around=part.around))
        for part in parts
    ]


def _is_open(searches: Searches) -> bool:
    """Whether a search has not yet come as close to the witness as the tolerance asks."""
    return any(not s.finished for _, s in searches)


def _is_blocked(searches: Searches) -> bool:
    """Whether the smallest t belongs to a cell that no splitting settles."""
    return any(s.lower >= s.blocked for _, s in searches)


def _advance(
    q: Question, known: Findings, searches: Searches, reach: float, most: int, rest: float = 1.0
) -> tuple[Findings, float, Searches]:
    """Exclude zero from cell after cell, and return the t for which that proves stability.

    It ends when all cells are excluded, after `most` cells, or after the share `rest` of the remaining work.
    """
    tried, stood, since, searches = 0, -1.0, 0, list(searches)
    now = spent()
    until = q.end if math.isinf(q.end) else now + rest * (q.end - now)
    while True:
        lower = min((s.lower for _, s in searches), default=reach)
        q.standing.searches = searches
        known = known.report(q, lower)
        count = sum(s.count for _, s in searches)
        if lower > stood * (1 + known.tolerance / 10):
            stood, since = lower, count
        patience = CHEAP if known.tolerance != q.tolerance else math.inf if q.patient else PATIENCE
        over = is_past(until) or count >= most or count - since > patience
        if over or _is_blocked(searches):
            return known, lower, searches
        n = min(range(len(searches)), key=lambda n: (searches[n][1].finished, searches[n][1].lower))
        part, s = searches[n]
        if s.finished:
            if rest < 1 or not _is_cheap(q, known, count):
                return known, lower, searches
            known = replace(known, tolerance=FINEST)
            searches = [(own, replace(other, target=known.target(reach))) for own, other in searches]
            continue
        s = advance(s)
        searches[n] = part, s
        cell = s.hardest()
        if cell is not None and tried < 8 + count // 500:
            tried += 1
            before, known = known, known.nearer(part, from_cell(s.family, s.growth, cell, known.upper))
            if known is not before:
                nearest_t = known.target(reach)
                searches = [
                    (own, replace(other, target=min(other.target, nearest_t))) for own, other in searches
                ]


def _is_cheap(q: Question, known: Findings, count: int) -> bool:
    """Whether a proof took so little that its tolerance is lowered, to which the caller gave none."""
    return not (q.fixed or count > CHEAP or known.tolerance <= FINEST or math.isinf(known.upper))


def _explain_rest(q: Question, known: Findings, searches: Searches) -> Findings:
    worst = min((s for _, s in searches), key=lambda s: s.lower)
    if known.is_near(worst.lower, q):
        return known
    if q.problem.traits.is_bounded:
        return known.because(BOUNDED)
    count = sum(s.count for _, s in searches)
    why = "not settled within the work" if q.is_late() else f"not settled within {count} cells"
    return known.because(why + replace(q.standing, searches=searches).where(q.problem))


# result


def _margin(q: Question, known: Findings, lower: float, loss: Loss, proofs: list[Certificate]) -> Margin:
    upper, frequency, witness = loss
    if known.structured is not None and known.structured.lower > lower:
        lower = known.structured.lower
        proofs = [_whole_proof(q, known.structured.count, lower, known.structured.proof())]
    if known.signs is not None and known.signs.lower > lower:
        lower, proofs = known.signs.lower, [_whole_proof(q, known.signs.count, known.signs.lower)]
    reasons = known.reasons
    if lower > 0 and not is_nominal_stable(q.problem, q.box):
        lower = 0.0
        reasons += ("the nominal loop is not proven stable",)
    if not lower <= upper:
        raise CheckError(f"the proof ({lower:.9g}) and the witness ({upper:.9g}) contradict each other")
    if lower >= upper * (1 - q.tolerance):
        reasons = ()
    if not (lower > 0 or reasons):
        reasons = ("not settled",)
    names = q.box.names
    found = None if witness is None else dict(zip(names, witness.tolist(), strict=True))
    moved = {} if witness is None else dict(zip(names, (witness - q.box.nominal).tolist(), strict=True))
    return Margin(
        lower if lower > 0 else None, upper, frequency, found, moved,
        {} if known.zero is None or witness is None else contributions(*known.zero, names),
        tuple(proofs), 0.0, "; ".join(dict.fromkeys(reasons)),
        q.box.searched if math.isinf(upper) else "",
    )  # fmt: skip


def _whole_proof(q: Question, count: int, lower: float, multipliers: Proof | None = None) -> Certificate:
    axes, top = len(q.box.names), q.problem.physical(math.inf)
    return Certificate(
        count, (0.0, top), np.zeros((0, 3)), np.zeros((0, axes, 2)), np.zeros(0),
        q.box.sides(lower), (False,) * axes, 0, multipliers,
    )  # fmt: skip


def _certificate(q: Question, part: Part, s: Search) -> Certificate:
    cells, boxes, c = s.excluded(len(part.family.shape))
    top = q.problem.physical(math.inf)
    return Certificate(
        s.count, (0.0, top), cells, boxes, np.angle(c), part.sides, part.of.inverted, part.family.scale
    )


def _loss(q: Question, known: Findings, reach: float) -> tuple[Findings, Loss]:
    """The witness, confirmed by the poles; else the first loss beyond `reach`, the box that was searched."""
    touched = _loss_by_signs(q, known)
    if known.zero is not None:
        loss = confirm(q.problem, q.box, *known.zero)
        if loss is not None and (touched is None or loss[0] <= touched[0]):
            return known, loss
        if touched is None:
            known = known.because("the poles of the loop do not confirm the witness")
    if touched is not None:
        return replace(known, zero=None), touched
    return known, _first_loss(q) if reach < q.box.limit else (math.inf, None, None)


def _first_loss(q: Question) -> Loss:
    """The first loss along the box's diagonals that is found in LOOK_AGAIN of the work left, or a little more."""
    now = spent()
    late = GRACE if is_stopped() else GRACE + LATE * q.end
    with work_limit(now + max(LOOK_AGAIN * (q.end - now), late)):
        return first_loss(q.problem, q.box, q.box.limit)


def _loss_by_signs(q: Question, known: Findings) -> Loss | None:
    """The witness of Hurwitz's determinant, which may touch the boundary and not cross it."""
    if known.signs is None or known.signs.witness is None:
        return None
    p, frequency = known.signs.witness, None
    with suppress(np.linalg.LinAlgError):  # matrices that overflow have no poles to take a frequency from
        frequency = q.problem.critical_frequency(p)
    return known.signs.upper, frequency, p


def _by_poles(q: Question, known: Findings) -> Margin:
    """The margin without families: the first loss along the box's diagonals, and a proof by multipliers."""
    loss = _first_loss(q)
    known = replace(known, upper=loss[0])
    target = min(q.box.limit, known.target(math.inf))
    if q.is_many:
        known = _multiply(q, known, target, ALONE)
    if not known.is_settled(q):
        known = _compare_signs(q, known)
    if not known.is_settled(q):
        known = _multiply(q, known, target, 1.0)
    touched = _loss_by_signs(q, known)
    return _margin(q, known, 0.0, touched if touched is not None and touched[0] < loss[0] else loss, [])
