"""What a search may take, in rounds: work that is counted, with the clock as a guard."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from malta.errors import InputError
from malta.work import MORE_WORK, TICKS, Answer, count_work, current_meter

WORK = 120.0  # units that a search may take
MOST_CELLS = 300_000
GROWTH = 2.0  # times the work of the last round, where the clock alone ends a search
MIN_ROUND_WORK = 0.05  # of the work done, that another round has


@dataclass(frozen=True)
class Budget:
    """What a search may take: work that is counted, with the clock as a guard.

    work : units, each about a second of one core; the same question gives the same answer on every computer and under
        any load. None: 120, and as much as there is time for where `time` is given
    time : s, of the clock; the answer says so where it ends a search. None: no limit
    cells : of a proof by cells
    patient : whether all of it is used where quick ways leave the question open; None: where work or time is named

    Raises InputError for limits that are not above zero.

    >>> from malta.proof import Budget
    >>> Budget(work=10).work
    10
    """

    work: float | None = None
    time: float | None = None
    cells: int = MOST_CELLS
    patient: bool | None = None

    def __post_init__(self) -> None:
        for name in ("work", "time", "cells"):
            limit = getattr(self, name)
            if limit is not None and not (isinstance(limit, int | float) and limit > 0):
                raise InputError("budget", name, repr(limit), "a number above zero")


def in_rounds(
    budget: Budget, ask: Callable[[float, bool], Answer], rank: Callable[[Answer], float]
) -> tuple[Answer, Ended]:
    """The best answer of a search that is asked with its work and whether it is to be patient, and how it ended.

    A patient budget is used: where the first round leaves work undone and its answer is open, patient ones follow,
    until one of them leaves work undone as well.

    rank : of an answer, the higher the better; infinite for one that is decided
    """
    work = budget.work or min(WORK, budget.time or WORK)
    last = math.inf if budget.time is None else time.monotonic() + budget.time
    best, total, patient, outer = None, 0.0, bool(budget.patient), current_meter.get()
    goes_on = (budget.work or budget.time) is not None if budget.patient is None else budget.patient
    while True:
        seconds = None if budget.time is None else max(last - time.monotonic(), 0.0)
        with count_work(work, seconds) as meter:
            found = ask(meter.end / TICKS, patient)
        best = found if best is None or rank(found) >= rank(best) else best
        total += meter.done / TICKS
        work = GROWTH * work if budget.work is None else budget.work - total
        left = work if outer is None else min(work, outer.left / TICKS)
        done = rank(best) == math.inf or (patient and not meter.is_used)
        if done or meter.stopped or not goes_on or left < MIN_ROUND_WORK * total:
            return best, Ended(total, meter.is_used, meter.stopped)
        patient = True


class Ended(NamedTuple):
    """How a search ended: the work that was done, whether it was all there was, and whether the clock ended it."""

    work: float
    is_used: bool
    stopped: bool

    def explain(self, reason: str) -> str:
        """The reason why an answer is open, with what ended the search and the work to go on with."""
        if not reason or reason.endswith(MORE_WORK) or not (self.stopped or self.is_used):
            return reason
        by = "the clock ended the search" if self.stopped else "the search ended"
        return f"{reason}; {by} after {self.work:.3g} units of work, {GROWTH * self.work:.3g} {MORE_WORK}"
