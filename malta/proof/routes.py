"""The ways to prove a bound over a box, in the order in which they are tried: `ROUTES`.

Each adds to an `Attempt` what it proves; which is due depends on what is known so far. Cells of frequency and
parameters come first and settle most questions. Multipliers need few cells of parameters, Hurwitz's determinant none of
frequency.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from malta.proof.exclusion import BoxPart, advance, start
from malta.proof.exclusion.hurwitz import raise_bound, signs_over
from malta.proof.exclusion.witness import from_cell
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.question import Findings, Question
from malta.work import WorkUp, is_past, work_done, work_limit

if TYPE_CHECKING:
    from malta.proof.question import Searches

MAX_CHEAP_CELLS = 4000  # cells below which the proof is brought closer to the witness than the tolerance
FINEST_TOLERANCE = 3e-7  # how close, relative
PATIENCE = 20_000  # cells without progress after which the proof is given up
HARD_CELLS = 4000  # cells after which smaller boxes are proven first
FEW_CELLS = 100  # cells of many parameters, of which each may be dear, before multipliers take their turn
MAX_CHEAP_NODES = 128_000  # coefficients of polynomials on these cells, where each has few
LEVELS = 5  # of smaller boxes, each half of the next
SMALLER_BOXES = 4  # boxes, each half of the last one, that Hurwitz's determinant is tried on
LAST_WORK = 20.0  # work of a proof that has no other limit, or comes after what cells have proven
SIGNS = 0.5  # share of the work that is left for Hurwitz's determinant where cells do not settle the question
TURN, TURN_AFTER = 0.5, 4.0  # share for multipliers in their turn, and how many times what was spent before
REST = 0.9  # their share where they have proven more than the cells
MULTIPLIER_SHARE = 0.8  # their share where there are no families

BOUNDED_TEXT = "what the position does is bounded, not followed"


@dataclass(frozen=True, eq=False)
class Attempt:
    """A proof over box(reach), as far as it is.

    parts : the families over the box; none where it cannot be enclosed
    goal : the bound that was wanted when it began; of the last routes the t at which the loop is lost
    lower, searches : what the cells of the whole box prove, and how far they are searched
    smaller : the same of a smaller box
    is_hard : whether the first cells left the question to other routes
    """

    known: Findings
    parts: Sequence[BoxPart]
    reach: float
    goal: float
    lower: float = 0.0
    searches: Searches = field(default_factory=list)
    smaller: tuple[float, Searches] = (0.0, [])
    is_hard: bool = False

    def is_covered(self, q: Question) -> bool:
        """Whether as much is proven without cells as those of the box can prove."""
        return self.known.is_covered(q, self.reach)


@dataclass(frozen=True)
class Route:
    """A way to raise the proven bound. is_due : whether it is tried; prove : the attempt with what it proves."""

    name: str
    is_due: Callable[[Question, Attempt], bool]
    prove: Callable[[Question, Attempt], Attempt]


def prove_over(
    q: Question, known: Findings, parts: Sequence[BoxPart], reach: float
) -> tuple[Findings, float, Searches]:
    """What is known when all routes were tried, and the largest t for which cells exclude zero, with these cells."""
    a = Attempt(known, parts, reach, known.target(reach))
    a = follow(ROUTES if parts else ROUTES_WITHOUT_FAMILIES, q, a)
    if _is_open(a.searches) and not (a.is_hard and a.is_covered(q)):
        a = replace(a, known=_explain_rest(q, a.known, a.searches))
    return (a.known, a.lower, a.searches) if a.lower >= a.smaller[0] else (a.known, *a.smaller)


def follow(routes: Sequence[Route], q: Question, a: Attempt) -> Attempt:
    """The attempt after the routes that are due, one after the other."""
    for route in routes:
        if route.is_due(q, a):
            a = route.prove(q, a)
    return a


def _by_first_cells(q: Question, a: Attempt) -> Attempt:
    """So many cells as are cheap."""
    begun = _start(a.parts, a.known.target(a.reach), min(a.reach, a.known.upper))
    most = min(q.most_cells, _first_cells(q, a.parts))
    known, lower, searches = _advance(q, a.known, begun, a.reach, most)
    is_hard = _is_open(searches) and not known.is_near(lower, q)
    return replace(a, known=known, lower=lower, searches=searches, is_hard=is_hard)


def _by_cells(q: Question, a: Attempt) -> Attempt:
    """All cells. Where the whole box takes long, smaller ones are proven first: each is a bound that stands."""
    known, smaller, top = a.known, a.smaller, a.known.target(a.reach)
    for level in range(0 if known.is_near(a.lower, q) else LEVELS, 0, -1):
        t = top * 0.5**level
        known, found, small = _advance(q, known, _start(a.parts, t, t), t, HARD_CELLS, rest=0.3)
        if found > smaller[0]:
            smaller = found, small
        if _is_open(small) or q.is_late():
            break
    known, lower, searches = _advance(q, known, a.searches, a.reach, q.most_cells)
    return replace(a, known=known, lower=lower, searches=searches, smaller=smaller, is_hard=False)


def _by_multipliers(q: Question, a: Attempt, share: float, most: float = math.inf) -> Attempt:
    return replace(a, known=_multiply(q, a.known, a.known.target(a.reach), share, most))


def _by_signs(q: Question, a: Attempt) -> Attempt:
    return replace(a, known=_compare_signs(q, a.known, a.lower))


def _alone(q: Question, a: Attempt, share: float) -> Attempt:
    return replace(a, known=_multiply(q, a.known, a.goal, share))


def _is_last_due(q: Question, a: Attempt) -> bool:
    return max(a.lower, a.known.beside) < min(q.box.limit, a.goal) * (1 - 2 * q.tolerance)


def _at_last(q: Question, a: Attempt) -> Attempt:
    most = max(LAST_WORK, 0.5 * work_done()) if a.lower > 0 and not q.patient else math.inf
    target = min(q.box.limit, a.goal * (1 - a.known.tolerance))
    return replace(a, known=_multiply(q, a.known, target, 1.0, most))


def _are_cells_due(q: Question, a: Attempt) -> bool:
    done = (a.is_hard and a.is_covered(q)) or not _is_open(a.searches)
    return not (done or q.is_late() or _is_blocked(a.searches))


ROUTES = (
    Route("first cells", lambda _q, _a: True, _by_first_cells),
    Route(
        "multipliers in their turn",
        lambda q, a: a.is_hard and q.is_many,
        lambda q, a: _by_multipliers(q, a, TURN, TURN_AFTER * work_done()),
    ),
    Route("Hurwitz's determinant", lambda q, a: a.is_hard and not a.is_covered(q), _by_signs),
    Route(
        "multipliers",
        lambda q, a: a.is_hard and q.is_many and not a.is_covered(q) and a.known.beside > a.lower,
        lambda q, a: _by_multipliers(q, a, REST),
    ),
    Route("cells", _are_cells_due, _by_cells),
)
ROUTES_WITHOUT_FAMILIES = (
    Route("multipliers", lambda q, _a: q.is_many, lambda q, a: _alone(q, a, MULTIPLIER_SHARE)),
    Route("Hurwitz's determinant", lambda q, a: not a.known.is_settled(q), _by_signs),
    Route("multipliers", lambda q, a: not a.known.is_settled(q), lambda q, a: _alone(q, a, 1.0)),
)
LAST_ROUTES = (Route("multipliers at last", _is_last_due, _at_last),)


def _first_cells(q: Question, parts: Sequence[BoxPart]) -> int:
    """The number of cells after which other proofs take their turn."""
    nodes = max((part.family.values.shape[1] for part in parts), default=1)
    return min(HARD_CELLS, max(FEW_CELLS, MAX_CHEAP_NODES // nodes)) if q.is_many else HARD_CELLS


def _multiply(q: Question, known: Findings, target: float, share: float, most: float = math.inf) -> Findings:
    """Raise the proven bound by multipliers, for a share of the work that is left, and at most `most`."""
    now = work_done()
    if known.structured is None or not now < q.end:
        return known
    until = now + min(share * (q.end - now), most)
    with suppress(WorkUp), work_limit(until):
        known.structured.raise_bound(target, until, lambda t: known.report(q, t))
    return replace(known, stands=max(known.stands, known.structured.lower))


def _compare_signs(q: Question, known: Findings, proven: float) -> Findings:
    """Raise the proven bound by Hurwitz's determinant, which needs no cells of frequency for light damping.

    Where the cells have proven as much as was asked for, it may take half as much as they did.
    """
    if known.signs is not None or q.problem.traits.is_bounded:
        return known
    now = work_done()
    until = now + SIGNS * (q.end - now) if math.isfinite(q.end) else now + LAST_WORK
    if proven >= min(known.upper, q.box.limit) * (1 - q.tolerance):
        until = min(until, now + SIGNS * now)
    t, signs = min(q.box.limit, 1.05 * known.upper), None
    for _ in range(SMALLER_BOXES):
        with suppress(Unproven, WorkUp), work_limit(until):
            signs = signs_over(q.problem, q.box, t)
            break
        t /= 2
    if signs is None:
        return known
    with suppress(WorkUp), work_limit(until):
        if not q.fixed:
            raise_bound(signs, FINEST_TOLERANCE, MAX_CHEAP_CELLS)
        raise_bound(signs, q.tolerance, q.most_cells)
    return replace(known, signs=signs, upper=min(known.upper, signs.upper)).report(q, signs.lower)


def _start(parts: Sequence[BoxPart], target: float, until: float) -> Searches:
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
    now = work_done()
    until = q.end if math.isinf(q.end) else now + rest * (q.end - now)
    while True:
        lower = min((s.lower for _, s in searches), default=reach)
        q.standing.searches = searches
        known = known.report(q, lower)
        count = sum(s.count for _, s in searches)
        if lower > stood * (1 + known.tolerance / 10):
            stood, since = lower, count
        patience = MAX_CHEAP_CELLS if known.tolerance != q.tolerance else math.inf if q.patient else PATIENCE
        over = is_past(until) or count >= most or count - since > patience
        if over or _is_blocked(searches):
            return known, lower, searches
        n = min(range(len(searches)), key=lambda n: (searches[n][1].finished, searches[n][1].lower))
        part, s = searches[n]
        if s.finished:
            if rest < 1 or not _is_cheap(q, known, count):
                return known, lower, searches
            known = replace(known, tolerance=FINEST_TOLERANCE)
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
    return not (
        q.fixed or count > MAX_CHEAP_CELLS or known.tolerance <= FINEST_TOLERANCE or math.isinf(known.upper)
    )


ADVICE = "a smaller box or a parameter less may be"


def _explain_rest(q: Question, known: Findings, searches: Searches) -> Findings:
    worst = min((s for _, s in searches), key=lambda s: s.lower)
    if known.is_near(worst.lower, q):
        return known
    if q.problem.traits.is_bounded:
        return known.because(BOUNDED_TEXT)
    count = sum(s.count for _, s in searches)
    where = replace(q.standing, searches=searches).where(q.problem)
    if q.is_late():
        return known.because(f"not settled within the work{where}")
    return known.because(f"not settled within {count} cells{where}; {ADVICE}")
