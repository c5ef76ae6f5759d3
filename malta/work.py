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
from functools import wraps
from typing import Any, ParamSpec, TypeVar

Answer = TypeVar("Answer")
P = ParamSpec("P")


TICKS = 1e9  # of a unit: sums of whole ticks do not depend on their order
ENDLESS_TICKS = 1e18  # ticks
NO_TIME = "no time was left for it"
MORE_WORK = "may decide it"  # ends the reason of a search that ended with its work or its time


class WorkUp(Exception):
    """The work of a search was up within a step that has no partial result."""


@dataclass(eq=False)
class WorkEnd:
    """When all work of a command ends with what is known, s of time.monotonic(): whoever waits may bring it forward."""

    at: float = math.inf


@dataclass(eq=False)
class Meter:
    """The work of a question so far, in ticks. It changes in place.

    end : of the work of the question, which a last look may exceed; limit : of the innermost share of it
    deadline : of time.monotonic(); stopped : whether the clock ended it, after so much work, in ticks
    refused : whether a step was too dear
    whole : the end of the work that the question is part of
    """

    end: float
    deadline: float = math.inf
    whole: WorkEnd = field(default_factory=WorkEnd)
    limit: float = math.inf
    ticks: int = 0
    stopped_after: int | None = None
    refused: bool = False
    prices: list[float] = field(default_factory=list)  # of steps that were counted before they were done

    def charge(self, ticks: int) -> None:
        self.ticks += ticks
        if not self.stopped and time.monotonic() > min(self.deadline, self.whole.at):
            self.stopped_after = self.ticks
            self.ticks = max(self.ticks, math.ceil(self.end) + 1)

    @property
    def stopped(self) -> bool:
        return self.stopped_after is not None

    @property
    def work(self) -> float:
        """The work so far, units; of a question that the clock ended, all that it had."""
        return self.ticks / TICKS

    @property
    def done(self) -> int:
        """The work that was done, ticks."""
        return self.ticks if self.stopped_after is None else self.stopped_after

    @property
    def left(self) -> float:
        return min(self.limit, self.end) - self.ticks

    @property
    def is_used(self) -> bool:
        """Whether the work of the question is up, or was too little for a step, so that more may find more."""
        return self.ticks >= self.end or self.refused


current_meter: ContextVar[Meter | None] = ContextVar("meter", default=None)


@contextmanager
def count_work(work: float, seconds: float | None = None, whole: WorkEnd | None = None) -> Iterator[Meter]:
    """Count the work of the block from zero, whatever was done before; its sum counts outside.

    The block may take what a block around it leaves, of its work and of its time.
    """
    outer, end = current_meter.get(), min(work * TICKS, ENDLESS_TICKS)
    deadline = math.inf if seconds is None else time.monotonic() + seconds
    if outer is not None:
        end, deadline = min(end, max(outer.left, 0.0)), min(deadline, outer.deadline)
        whole = whole or outer.whole
    own = Meter(end, deadline, whole or WorkEnd())
    token = current_meter.set(own)
    try:
        yield own
    finally:
        current_meter.reset(token)
        if outer is not None:
            outer.charge(own.done)
            outer.refused |= own.refused


@contextmanager
def work_limit(end: float) -> Iterator[None]:
    """Within the block the work is up at `end`, as counted by `work_done`, if it is not up before."""
    own = current_meter.get()
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
    own = current_meter.get()
    return 0.0 if own is None else own.work


def refuse() -> None:
    """Note that a step was left undone as it would take too much: more work may find more."""
    own = current_meter.get()
    if own is not None:
        own.refused = True


def is_stopped() -> bool:
    """Whether the clock ended the question."""
    own = current_meter.get()
    if own is not None:
        own.charge(0)
    return own is not None and own.stopped


@contextmanager
def share_time(share: float) -> Iterator[None]:
    """Within the block the clock ends the question after a share of the time that is left."""
    own = current_meter.get()
    left = math.inf if own is None else own.deadline - time.monotonic()
    with nullcontext() if math.isinf(left) else count_work(math.inf, share * left):
        yield


def cut_error() -> BaseException:
    """What a result that was cut short is raised as: WorkUp where the clock ended the question, else as by Ctrl-C."""
    return WorkUp() if is_stopped() else KeyboardInterrupt()


def answer_in_time(nothing: Answer) -> Callable[[Callable[P, Answer]], Callable[P, Answer]]:
    """A function that answers `nothing` where the clock ended the question before, or ends it while it is prepared."""

    def decorate(function: Callable[P, Answer]) -> Callable[P, Answer]:
        @wraps(function)
        def answer(*args: P.args, **kwargs: P.kwargs) -> Answer:
            if is_stopped():
                return nothing
            try:
                return function(*args, **kwargs)
            except WorkUp:
                if not is_stopped():
                    raise
                return nothing

        return answer

    return decorate


@contextmanager
def without_limit() -> Iterator[None]:
    """Steps that no answer can do without, as the models that a report is of: neither counted nor ended."""
    token = current_meter.set(None)
    try:
        yield
    finally:
        current_meter.reset(token)


def is_past(end: float = math.inf, price: float = 0.0) -> bool:
    """Count a step, and say whether the work is up with it, at `end` or before."""
    own = current_meter.get()
    if own is None:
        return False
    own.charge(round(price * TICKS))
    return own.ticks >= min(end * TICKS, own.limit)


def spend(price: float) -> None:
    """Count a step before it is done. Raises WorkUp, and counts nothing, where too little is left for it."""
    own = current_meter.get()
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
    if is_stopped():
        raise WorkUp


def remember(
    known: MutableMapping[Any, tuple[Answer, Sequence[float]]], key: Any, made: Callable[[], Answer]
) -> Answer:
    """The result of steps that are done once; they count each time, so that no answer depends on earlier ones."""
    if key not in known:
        own = current_meter.get()
        with count_work(math.inf) if own is None else nullcontext(own) as meter:
            begun = len(meter.prices)
            known[key] = made(), tuple(meter.prices[begun:])
        return known[key][0]
    found, prices = known[key]
    for price in prices:
        spend(price)
    return found
