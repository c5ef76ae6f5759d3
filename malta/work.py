"""The work of a search: counted, not timed, so that its answer does not depend on how busy a computer is.

Each long step has a price, which follows from sizes alone: cells times coefficients, places times operations, rows of
poles. A unit of work is about what one core of a server does in a second. A step whose result can be had in part asks
`is_past`, and returns what it has; any other calls `spend`, which raises WorkUp. The clock is a guard that a user sets:
where it ends a search, the rest of the work counts as done.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

from malta.errors import InputError

WORK = 120.0  # units that a search may take
MOST_CELLS = 300_000
GROWTH = 2.0  # times the work of the last round, where the clock alone ends a search
TICKS = 1e9  # of a unit: sums of whole ticks do not depend on their order
ENDLESS_TICKS = 1e18  # ticks
MIN_ROUND_WORK = 0.05  # of the work done, that another round has
MORE_WORK = "may decide it"  # ends the reason of a search that ended with its work or its time

Answer = TypeVar("Answer")


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


class WorkUp(Exception):
    """The work of a search was up within a step that has no partial result."""


@dataclass(eq=False)
class Meter:
    """The work of a question so far, in ticks. It changes in place.

    end : of the work of the question, which a last look may exceed; limit : of the innermost share of it
    deadline : of time.monotonic(); stopped : whether the clock ended it; refused : whether a step was too dear
    """

    end: float
    deadline: float = math.inf
    limit: float = math.inf
    ticks: int = 0
    stopped: bool = False
    refused: bool = False
    prices: list[float] = field(default_factory=list)  # of steps that were counted before they were done

    def charge(self, ticks: int) -> None:
        self.ticks += ticks
        if not self.stopped and time.monotonic() > self.deadline:
            self.stopped = True
            self.ticks = max(self.ticks, math.ceil(self.end) + 1)

    @property
    def work(self) -> float:
        return self.ticks / TICKS

    @property
    def left(self) -> float:
        return min(self.limit, self.end) - self.ticks

    @property
    def is_used(self) -> bool:
        """Whether the work of the question is up, or was too little for a step, so that more may find more."""
        return self.ticks >= self.end or self.refused


_meter: ContextVar[Meter | None] = ContextVar("meter", default=None)


@contextmanager
def count_work(work: float, seconds: float | None = None) -> Iterator[Meter]:
    """Count the work of the block from zero, whatever was done before; its sum counts outside.

    The block may take what a block around it leaves, of its work and of its time.
    """
    outer, end = _meter.get(), min(work * TICKS, ENDLESS_TICKS)
    deadline = math.inf if seconds is None else time.monotonic() + seconds
    if outer is not None:
        end, deadline = min(end, max(outer.left, 0.0)), min(deadline, outer.deadline)
    own = Meter(end, deadline)
    token = _meter.set(own)
    try:
        yield own
    finally:
        _meter.reset(token)
        if outer is not None:
            outer.charge(own.ticks)
            outer.refused |= own.refused


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
    best, total, patient, outer = None, 0.0, bool(budget.patient), _meter.get()
    goes_on = (budget.work or budget.time) is not None if budget.patient is None else budget.patient
    while True:
        seconds = None if budget.time is None else max(last - time.monotonic(), 0.0)
        with count_work(work, seconds) as meter:
            found = ask(meter.end / TICKS, patient)
        best = found if best is None or rank(found) >= rank(best) else best
        total += meter.work
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


@contextmanager
def work_limit(end: float) -> Iterator[None]:
    """Within the block the work is up at `end`, as counted by `work_done`, if it is not up before."""
    own = _meter.get()
    if own is None:
        with count_work(end), work_limit(end):
            yield
        return
    before, own.limit = own.limit, min(end * TICKS, ENDLESS_TICKS, own.limit)
    try:
        yield
    finally:
        own.limit = before


def work_done() -> float:
    """The work of the question so far."""
    own = _meter.get()
    return 0.0 if own is None else own.work


def refuse() -> None:
    """Note that a step was left undone as it would take too much: more work may find more."""
    own = _meter.get()
    if own is not None:
        own.refused = True


def is_stopped() -> bool:
    """Whether the clock ended the question."""
    own = _meter.get()
    return own is not None and own.stopped


def is_past(end: float = math.inf, price: float = 0.0) -> bool:
    """Count a step, and say whether the work is up with it, at `end` or before."""
    own = _meter.get()
    if own is None:
        return False
    own.charge(round(price * TICKS))
    return own.ticks >= min(end * TICKS, own.limit)


def spend(price: float) -> None:
    """Count a step before it is done. Raises WorkUp, and counts nothing, where too little is left for it."""
    own = _meter.get()
    if own is None:
        return
    own.charge(0)
    ticks = round(price * TICKS)
    if own.stopped or own.ticks + ticks > own.limit:
        own.refused = True
        raise WorkUp
    own.ticks += ticks
    own.prices.append(price)


def check_clock() -> None:
    """Raise WorkUp where the clock ended the question. Steps that are done once for many questions are not counted."""
    own = _meter.get()
    if own is not None:
        own.charge(0)
        if own.stopped:
            raise WorkUp


def remember(
    known: MutableMapping[Any, tuple[Answer, Sequence[float]]], key: Any, made: Callable[[], Answer]
) -> Answer:
    """The result of steps that are done once; they count each time, so that no answer depends on earlier ones."""
    if key not in known:
        own = _meter.get()
        with count_work(math.inf) if own is None else nullcontext(own) as meter:
            begun = len(meter.prices)
            known[key] = made(), tuple(meter.prices[begun:])
        return known[key][0]
    found, prices = known[key]
    for price in prices:
        spend(price)
    return found
