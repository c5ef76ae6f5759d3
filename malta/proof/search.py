"""The search of one margin: the nearest witness, the proof, and witnesses found in cells that resist the proof."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import arb

from malta.bound import at_least
from malta.errors import CheckError
from malta.linear.expressions import NotAnalytic
from malta.proof.box import EDGE, Box
from malta.proof.exclusion import BoxPart, CellSearch, cut, growth_over, merge_twins
from malta.proof.exclusion.witness import nearest, starts
from malta.proof.loss import confirm, contributions, corner_loss, first_loss
from malta.proof.margin import Certificate, Margin
from malta.proof.multipliers.structured import MultiplierProof, Structured, rows_of
from malta.proof.polynomial.enclosure import NO_COEFFICIENTS, Unproven, family_over
from malta.proof.problem import Problem, is_nominal_stable
from malta.proof.question import Findings, Question
from malta.proof.routes import LAST_ROUTES, Attempt, follow, prove_over
from malta.work import WorkUp, is_past, is_stopped, refuse, work_done, work_limit

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.proof.loss import Loss
    from malta.proof.polynomial.enclosure import Polynomial
    from malta.proof.question import Searches

FIRST_BOX = 3.97  # the first box, in multiples of the modelled one, where no corner says another
NEAR_BOX = 6.0  # the largest that a corner may say
MIN_WIDER_WORK, MIN_WIDER_SHARE = 0.5, 0.015  # work, and share of it, that a wider box may take at least
COUPLED_BOX = 1.005  # box of couplings, in multiples of where axes by themselves are lost
LOOK = 0.2  # share of the work for a first look at the poles of corners
SECOND_LOOK = 0.3  # share of what is left for another, or GRACE and LATE_SHARE of the work beyond its end
GRACE, LATE_SHARE = 0.4, 0.1  # work, share


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
    known = follow(LAST_ROUTES, q, Attempt(known, parts, reach, loss[0], lower)).known
    return _margin(q, known, lower, loss, [_certificate(q, part, s) for part, s in searches])


# witness


def _families(q: Question, known: Findings, until: float) -> tuple[Findings, list[BoxPart], float]:
    """The families over a box that holds the nearest witness, or over the largest box that can be enclosed.

    Returns the parts of the box and its size t.
    """
    parts, reach, done, refused = list[BoxPart](), _first_reach(q), 0.0, math.inf
    why, begun = "", work_done()
    while True:
        now = work_done()
        taken = now - begun
        hurried = why == NO_COEFFICIENTS  # a smaller box takes as much
        last = now + (1.0 if hurried else 0.3) * (q.end - now)
        if done or FIRST_BOX < reach >= q.box.limit:
            last = min(last, now + max(MIN_WIDER_WORK, MIN_WIDER_SHARE * q.end, 2 * taken))
        try:
            parts = parts_over(q.problem, q.box, reach, min(until, last))
        except Unproven as error:
            refused, why = reach, str(error)
            if is_past(until) or reach < 1e-3 or (done and taken > q.dear):
                break
            reach = (
                done + 0.6 * (reach - done) if done else FIRST_BOX if reach > 2 * FIRST_BOX else 0.5 * reach
            )
        else:
            done = reach
            for part in parts:
                known = _descend(known, part, until)
            taken = work_done() - begun
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
    room = COUPLED_BOX if q.problem.traits.is_bounded else 1.05  # couplings grow with the box
    if known.upper < done / (3 if room > COUPLED_BOX else room) and not is_past(until):
        with suppress(Unproven):  # narrower families over a smaller box; the larger ones remain valid
            parts = parts_over(q.problem, q.box, room * known.upper, until)
            done = room * known.upper
    return known, parts, done


def parts_over(problem: Problem, box: Box, reach: float, last: float) -> list[BoxPart]:
    """The families of all groups over box(reach), cut into parts where one expansion does not do.

    last : of the work, at which the search gives up

    Raises Unproven when a matrix has no value on the box, or when the work is up.
    """
    sides = box.sides(reach)
    parts: list[BoxPart] = []
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


def _part_over(f: Polynomial, moves: tuple[Any, ...], box: Box, sides: FloatArray) -> list[BoxPart]:
    return [BoxPart(f, sides, family_over(f, sides, moves), growth_over(sides, f.inverted, box))]


def _first_reach(q: Question) -> float:
    """The size of the first box: a little beyond the loss by the poles of its corners, where that is near.

    Of several parameters else FIRST_BOX: families of a larger box are dear, and the nearest loss may be no corner.
    """
    one = np.count_nonzero(q.box.down) + np.count_nonzero(q.box.up) == 1
    most = q.box.limit if one else min(q.box.limit, FIRST_BOX)
    near = most if one else min(q.box.limit, NEAR_BOX)
    now = work_done()
    with work_limit(now + LOOK * (q.end - now)):
        t = corner_loss(q.problem, q.box, near)
    return most if t is None or t > near else min(near, 1.02 * t)


def _descend(known: Findings, part: BoxPart, until: float) -> Findings:
    misses = 0
    for distance, branch, x, u in starts(part.family, part.growth):
        if is_past(until) or misses > 4 or (misses > 1 and distance > 3 * known.upper):
            break
        found = known.nearer(part, nearest(part.family, part.growth, branch, x, u, known.upper))
        known, misses = found, misses + 1 if found is known else 0
    return known


# proof


def _prove_all(
    q: Question, known: Findings, parts: list[BoxPart], reach: float
) -> tuple[Findings, float, Searches]:
    """The proven bound and the searches of the proof."""
    known, lower, searches = prove_over(q, known, parts, reach)
    # where the enclosure over the whole box is too wide, those over smaller ones may do
    for _ in range(3):
        reach /= 2
        if lower > reach or q.is_late() or known.beside > reach:
            break
        try:
            known, inner, found = prove_over(q, known, parts_over(q.problem, q.box, reach, q.end), reach)
        except Unproven:
            continue
        if inner > lower:
            lower, searches = inner, found
    return known, lower, searches


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


def _whole_proof(
    q: Question, count: int, lower: float, multipliers: MultiplierProof | None = None
) -> Certificate:
    axes, top = len(q.box.names), q.problem.physical(math.inf)
    return Certificate(
        count, (0.0, top), np.zeros((0, 3)), np.zeros((0, axes, 2)), np.zeros(0),
        q.box.sides(lower), (False,) * axes, 0, multipliers,
    )  # fmt: skip


def _certificate(q: Question, part: BoxPart, s: CellSearch) -> Certificate:
    cells, boxes, c = s.excluded_cells(len(part.family.shape))
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
    """The first loss along the box's diagonals that is found in SECOND_LOOK of the work left, or a little more."""
    now = work_done()
    late = GRACE if is_stopped() else GRACE + LATE_SHARE * q.end
    with work_limit(now + max(SECOND_LOOK * (q.end - now), late)):
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
    known, *_ = prove_over(q, known, (), q.box.limit)
    touched = _loss_by_signs(q, known)
    return _margin(q, known, 0.0, touched if touched is not None and touched[0] < loss[0] else loss, [])
