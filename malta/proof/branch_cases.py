"""A margin of matrices with branches: each choice of branches is a smooth loop of its own, proven over the whole box.

At every p the loop is that of a case whose conditions hold at p. So what is proven of each case on the box, or of no
case that a box(t) can meet, holds for the loop:

    lower = min over cases of max(lower of the case, t up to which the box meets none of its values)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np

from malta.linear.branches import BranchCase, Interval
from malta.linear.expressions import program
from malta.linear.uncertain import UncertainSystem
from malta.proof.box import BEYOND_LOSS, Box, every_part, last_passed
from malta.proof.margin import IDLE_TEXT, Margin

PARTS_ASKED = 4  # parts of a box on which a case is asked for where it may act
CUTS = 12  # bisections of the end of such a part
PART_LIMIT = 1.05  # of such a part, which is asked for as a whole
MAX_REACH = 1e6  # of a box, up to which a case is looked for


def margin_by_cases(
    system: UncertainSystem,
    cases: Sequence[BranchCase],
    box: Box,
    lost: Margin,
    ask: Callable[[UncertainSystem, Box, int], Margin],
) -> Margin:
    """The margin of a system by its cases; `upper` is of witnesses that their own case has.

    lost : with the first loss that the poles of the loop show, beyond which no case is looked at
    ask : the margin of a system without branches over a box, in one of so many parts of the effort
    """
    end = min(box.limit, BEYOND_LOSS * lost.upper) or box.limit
    reaches = sorted((_reach_without(case, box, end), k) for k, case in enumerate(cases))
    near = [(reach, cases[k]) for reach, k in reaches if reach < end]
    reason, found, within = "", [lost], replace(box, most=min(box.most, end))

    def asked(loop: UncertainSystem, parts: int, some: Box) -> Margin:
        found.append(ask(loop, some, parts * len(near)))
        return found[-1]

    lower = within.limit
    for reach, case in near:
        if reach >= lower:
            break
        loop = replace(system, matrices=case.matrices)
        one = asked(loop, 2, within)
        meets = one.witness is not None and _meets(case, [one.witness[name] for name in box.names])
        if meets and one.upper < lost.upper:
            lost = one
        if meets and one.upper == 0:
            return one  # unstable at nominal parameters
        proven = max(reach, math.inf if one.reason.startswith(IDLE_TEXT) else one.lower or 0.0)
        top = min(within.limit, lost.upper, lower)
        if not meets and proven < top:
            parts = partial(asked, loop, 2 * PARTS_ASKED)
            proven = _proven_where_it_acts(case, within, (proven, top), parts)
        if proven < lower:
            lower, reason = proven, "" if meets and not one.reason else _open_text(one, reach)
    lower = min(lower, lost.upper)
    return replace(
        lost,
        lower=lower if lower or not lost.upper else None, certificate=(), reason=reason,
        seconds=sum(one.seconds for one in found), work=sum(one.work for one in found),
    )  # fmt: skip


def _proven_where_it_acts(
    case: BranchCase, box: Box, between: tuple[float, float], ask: Callable[[Box], Margin]
) -> float:
    """The t up to which a case is proven on the part of box(t) where it may act: between these two."""
    low, high = between

    def passes(t: float) -> bool:
        return (ask(_part(case, box, t)).lower or 0.0) >= 1

    return high if passes(high) else last_passed(passes, low, high, PARTS_ASKED - 1)


def _part(case: BranchCase, box: Box, t: float) -> Box:
    """The part of box(t) outside of which a case acts nowhere, as a box about its middle whose size is 1."""
    conditions, sides = program(case.positive), box.sides(t)

    def misses(i: int, end: float, cut: float) -> bool:
        part = sides.copy()
        part[i] = sorted((end, cut))
        return every_part(conditions, part, _is_excluded)

    for i in np.flatnonzero(box.down + box.up > 0).tolist():
        for side in (0, 1):
            end, other = sides[i, side], sides[i, 1 - side]
            sides[i, side] = last_passed(partial(misses, i, end), end, other, CUTS)
    grows = box.down + box.up > 0
    middle = np.where(grows, sides.mean(axis=1), box.nominal)
    half = np.nextafter(np.maximum(sides[:, 1] - middle, middle - sides[:, 0]), math.inf)
    half = np.where(grows, half, 0.0)
    over = np.where(grows[:, None], middle[:, None], box.over)
    return replace(box, nominal=middle, down=half, up=half, over=over, most=PART_LIMIT, ends="")


def _is_excluded(values: Sequence[tuple[int, int, Interval]]) -> bool:
    return any(x.high < 0 for _, _, x in values)


def _open_text(one: Margin, reach: float) -> str:
    """Why no more is proven than what the margin of a case says."""
    if one.lower == 0:
        return "the branch of the model behind a switch is unstable"
    if one.reason:
        return f"behind a switch of the model: {one.reason}" if reach else one.reason
    return "a branch of the model is unstable beyond it, where another one acts"


def _meets(case: BranchCase, p: Sequence[float]) -> bool:
    """Whether a case holds at p, in floating point."""
    return bool((np.array(case.positive(ca.DM(p))) >= 0).all())


def _reach_without(case: BranchCase, box: Box, end: float) -> float:
    """The t, at most `end`, up to which no p of box(t) has this case: a condition is below zero on each part of it."""
    conditions = program(case.positive)

    def misses(t: float) -> bool:
        return every_part(conditions, box.sides(t), _is_excluded)

    high = min(end, MAX_REACH)
    if misses(high):
        return end
    return last_passed(misses, 0.0, high) if misses(0.0) else 0.0
